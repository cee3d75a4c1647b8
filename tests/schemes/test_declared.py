"""What each field of each scheme, plant and filter may be: its range, its choices, its shape."""

import dataclasses

import numpy as np
import pytest
from cases import PLANTS, SCHEMES, case

from jaxilc import filters, plants, schemes
from jaxilc.pytree.ranges import Interval
from jaxilc.schemes.scheme import with_all_parts

RANGES = {
    "[0, inf)": """ASMC.eta ASMC.phi ASMC.epsilon FFDLMFAILC.lead PID.tau SMC.eta SMC.k_n SMC.lam2
        SMC.tau AtSamples.weight CrossCoupled.contour CrossCoupled.own
        EstimatedDisturbance.measurement_std EstimatedDisturbance.initial_std ExponentialPD.lam0
        ExponentialPD.lead HigherOrder.lead LearningFilter.lead MultivariableILC.motor_output
        MultivariableILC.table_output PIDType.lead PeriodTracking.angle RepetitiveBasis.angle
        StopWhen.growth BallScrewDrive.damping BallScrewDrive.dt BallScrewDrive.motor_damping
        BallScrewDrive.speed_gain BallScrewDrive.speed_integral_gain BallScrewDrive.table_damping
        ByPosition.backlash ByPosition.position Cogging.amplitude CuttingForce.stiffness
        FastToolServo.damping LeadError.amplitude ModalModel.delay Pendulum.damping Pendulum.inertia
        ProcessModel.delay StateSpace.dt StribeckFriction.coulomb_force
        StribeckFriction.static_force StribeckFriction.viscous SwitchableFilter.padding
        SwitchableFilter.width VoiceCoilMotor.holding_gain VoiceCoilMotor.stiffness
        VoiceCoilMotor.viscous_damping ZeroPhaseButterworth.padding ZeroPhaseIIR.padding""",
    "(0, inf)": """ASMC.Delta CFDLMFAILC.lam CFDLMFAILC.mu CFDLMFAPC.lam CFDLMFAPC.mu
        CFDLMFAPC.epsilon CFDLMFAPC.theta_limit CFDLMFAPC.limit FFDLMFAC.lam FFDLMFAC.mu
        FFDLMFAC.epsilon FFDLMFAC.limit FFDLMFAILC.lam FFDLMFAILC.mu FFDLMFAILC.epsilon
        FFDLMFAILC.limit PID.limit SMC.lam1 SMC.limit AtSamples.jerk_time BasisFunctions.limit
        ConstrainedNormOptimal.limit ConstrainedNormOptimal.rate ConstrainedNormOptimal.total
        ConstrainedNormOptimal.contour EstimatedDisturbance.process_std ExponentialPD.limit
        GradientILC.step GradientILC.limit HigherOrder.limit LearningFilter.limit LearningFilter.dt
        ModelFreeGradient.step ModelFreeGradient.amplitude ModelFreeGradient.limit NormOptimal.limit
        PIDType.limit PolynomialBasis.coulomb PositionBasis.turning RepetitiveControl.period
        RepetitiveControl.longest StopWhen.max_error StopWhen.rms TwoStep.limit TwoStep.rate
        BallScrewDrive.current_bandwidth BallScrewDrive.encoder_step BallScrewDrive.force_gain
        BallScrewDrive.force_limit BallScrewDrive.longest_dt BallScrewDrive.motor_mass
        BallScrewDrive.stiffness BallScrewDrive.table_mass BoucWen.beta BoucWen.initial_slope
        Cogging.pitch Creep.time_constants CuttingForce.blur Dahl.initial_slope Dahl.limit
        DifferenceEquation.dt EndEffect.buffer_stiffness EndEffect.stroke
        FastToolServo.amplifier_bandwidth FastToolServo.amplifier_gain FastToolServo.conversion
        FastToolServo.longest_dt FastToolServo.mass FastToolServo.stiffness FlexibleMode.frequency
        Harmonics.pitch LeadError.period ModalModel.dampings ModalModel.frequencies ModalModel.poles
        Pendulum.length Pendulum.mass PeriodicForce.frequencies PositionMap.turning
        ProcessModel.dampings ProcessModel.frequencies ProcessModel.poles
        StribeckFriction.stribeck_velocity StribeckFriction.transition_velocity
        SwitchableFilter.cutoff SwitchableFilter.times TimeVaryingStateSpace.dt VoiceCoil.poles
        VoiceCoilMotor.command_delay VoiceCoilMotor.current_gain VoiceCoilMotor.current_limit
        VoiceCoilMotor.force_constant VoiceCoilMotor.inductance VoiceCoilMotor.mass
        VoiceCoilMotor.resistance VoiceCoilMotor.speed_gain VoiceCoilMotor.speed_integral_gain
        VoiceCoilMotor.speed_limit VoiceCoilMotor.substep VoiceCoilMotor.voltage_limit
        StableInverse.dt ZPETC.dt ZeroPhaseBandStop.high ZeroPhaseBandStop.low
        ZeroPhaseButterworth.cutoff""",
    "(0, inf]": "ConstrainedNormOptimal.tube TwoStep.tube",
    "[-inf, inf)": "ConstrainedNormOptimal.y_low TwoStep.y_low",
    "(-inf, inf]": "ConstrainedNormOptimal.y_high TwoStep.y_high",
    "(0, 0.5]": "PeriodTracking.fastest",
    "(0, 1)": "FlexibleMode.damping Ladder.slow PeriodTracking.within RationalBasis.least",
    "[0, 1)": "EndEffect.drop PIDType.leak",
    "[0, 1]": "VoiceCoilMotor.setpoint_weight",
    "(0, 1]": """CFDLMFAC.eta CFDLMFAILC.rho CFDLMFAILC.eta CFDLMFAPC.eta CFDLMFAPC.delta
        FFDLMFAC.rho FFDLMFAILC.rho RepetitiveBasis.keep""",
    "(0, 2)": "BasisFunctions.step ConstrainedNormOptimal.step",
    "(0, 2]": "FFDLMFAC.eta FFDLMFAILC.eta PeriodTracking.rate",
    "[0, 0]": "CFDLMFAC.L_y CFDLMFAILC.L_y PFDLMFAC.L_y PFDLMFAILC.L_y",
    "[1, 1]": "CFDLMFAC.L_u CFDLMFAILC.L_u",
    "[1, 4]": "RationalBasis.order",
    "[0, 500]": "FFDLMFAC.L_y FFDLMFAILC.L_y",
    "[1, 500]": "CFDLMFAPC.P_u CFDLMFAPC.n_p FFDLMFAC.L_u FFDLMFAILC.L_u",
    "[1, 100]": """BasisFunctions.iterations OnBasis.iterations SwitchableFilter.order
        ZeroPhaseBandStop.order ZeroPhaseButterworth.order""",
    "[1, 10000]": "BallScrewDrive.substeps BoucWen.substeps FastToolServo.substeps",
    "[2, 10000]": "InBlocks.length",
    "[2, 1e+06]": "Splines.count",
    "[1, 1e+06]": "CFDLMFAPC.P ModelFreeGradient.inputs ModelFreeGradient.outputs",
    "[1, 1e+09]": "Ladder.repeats",
    "[0, 1e+07]": "StableInverse.extension",
    "[0, 1e+09]": "ModelFreeGradient.seed",
    "[1, inf)": "BoucWen.exponent Dahl.exponent Ladder.growth_of_gain Ladder.largest",
    "0 1 2 3": "Splines.degree",
    "False True": "ASMC.carry",
    "book sign none smooth": "CFDLMFAPC.reset FFDLMFAC.reset FFDLMFAILC.reset",
    "preview constant": "CFDLMFAPC.reference",
    "position increment": "PID.form",
    "sample hold": "SMC.centre",
    "norm_optimal gradient": "BasisFunctions.update",
    "trial mean": "ModelFreeGradient.about",
    "exact stochastic joint": "ModelFreeGradient.method",
    "riccati lifted": "NormOptimal.form",
    "input output": "TwoStep.correction",
}
# taps may be of any odd number; what else is refused depends on other fields, or comes later
NOT_BY_SHAPE = {
    ("LearningFilter", "L"),
    ("LearningFilter", "keep"),
    ("RepetitiveBasis", "keep"),
    ("ConstrainedNormOptimal", "total"),
}


def schemes_and_tasks():
    """One object of each class of scheme in cases.py, with the task that it sees."""
    found = {}
    for name in SCHEMES:
        _, scheme, task = case(name)
        for part in with_all_parts(scheme, task):
            found.setdefault(type(part.scheme), (part.scheme, part.task))
    return found.values()


def objects():
    """One object of each class in cases.py, those within others among them."""
    found, todo = {}, [*PLANTS.values(), *SCHEMES.values()]
    while todo:
        one = todo.pop()
        if dataclasses.is_dataclass(one):
            found.setdefault(type(one), one)
            todo += [getattr(one, field.name) for field in dataclasses.fields(one)]
        elif isinstance(one, tuple):
            todo += one
    return found.values()


def test_each_field_has_its_range():
    found = {}
    public = {
        name: getattr(room, name) for room in (plants, filters, schemes) for name in room.__all__
    }
    for name, cls in public.items():
        for field in dataclasses.fields(cls) if dataclasses.is_dataclass(cls) else ():
            if field.name in vars(cls).get("__annotations__", {}):
                choices, interval = (field.metadata.get(key) for key in ("choices", "interval"))
                said = " ".join(map(str, choices)) if choices else str(interval)
                if interval is not None and interval.low < interval.high:
                    whole = str(field.type).startswith("int")
                    assert field.metadata.get("whole", False) == whole, f"{name}.{field.name}"
                if said not in ("None", "(-inf, inf)"):
                    found.setdefault(said, set()).add(f"{name}.{field.name}")
    assert found == {said: set(names.split()) for said, names in RANGES.items()}


def outside(field):
    """Values that a field must refuse."""
    if field.metadata.get("choices"):
        return ["none of them", -1]
    interval: Interval | None = field.metadata.get("interval")
    if interval is None or str(interval) == "(-inf, inf)":
        return []
    step = 1 if field.metadata.get("whole") else 1e-3
    ends = ((interval.low, interval.closed_low, -step), (interval.high, interval.closed_high, step))
    near = [end + by if closed else end for end, closed, by in ends]
    more = [1.5] if field.metadata.get("whole") and interval.contains(1.5) else []
    return [x for x in near if not np.isinf(x)] + more + [np.nan]


def test_what_is_outside_is_refused_and_named():
    for one in objects():
        for field in dataclasses.fields(one):
            for value in outside(field):
                with pytest.raises(ValueError, match=r"is outside its|is not one of") as caught:
                    dataclasses.replace(one, **{field.name: value})
                assert f"{type(one).__name__}: {field.name} = " in str(caught.value)
                assert str(field.metadata.get("interval") or "") in str(caught.value)


def test_a_leaf_of_seven_numbers_is_refused_and_named():
    for scheme, task in schemes_and_tasks():
        for field in dataclasses.fields(scheme):
            at = type(scheme).__name__, field.name
            if field.metadata.get("kind") != "leaf" or at in NOT_BY_SHAPE:
                continue
            seven = np.full(7, 0.5 if field.metadata["interval"].contains(0.5) else 1.0)
            with pytest.raises(ValueError, match=rf"\b{field.name}\b.*\(7,\)"):
                dataclasses.replace(scheme, **{field.name: seven}).check(task)
