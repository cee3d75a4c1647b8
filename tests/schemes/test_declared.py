"""What each field of each scheme may be: its range or its choices, and its shape."""

import dataclasses

import numpy as np
import pytest
from cases import SCHEMES, case

from jaxilc import schemes
from jaxilc.pytree.ranges import Interval
from jaxilc.schemes.scheme import with_all_parts

RANGES = {
    "[0, inf)": """ASMC.eta ASMC.phi ASMC.epsilon FFDLMFAILC.lead PID.tau SMC.eta SMC.k_n SMC.lam2
        SMC.tau AtSamples.weight CrossCoupled.contour CrossCoupled.own
        EstimatedDisturbance.measurement_std EstimatedDisturbance.initial_std ExponentialPD.lam0
        ExponentialPD.lead HigherOrder.lead LearningFilter.lead MultivariableILC.motor_output
        MultivariableILC.table_output PIDType.lead PeriodTracking.angle RepetitiveBasis.angle
        StopWhen.growth""",
    "(0, inf)": """ASMC.Delta CFDLMFAILC.lam CFDLMFAILC.mu CFDLMFAPC.lam CFDLMFAPC.mu
        CFDLMFAPC.epsilon CFDLMFAPC.theta_limit CFDLMFAPC.limit FFDLMFAC.lam FFDLMFAC.mu
        FFDLMFAC.epsilon FFDLMFAC.limit FFDLMFAILC.lam FFDLMFAILC.mu FFDLMFAILC.epsilon
        FFDLMFAILC.limit PID.limit SMC.lam1 SMC.limit AtSamples.jerk_time BasisFunctions.limit
        ConstrainedNormOptimal.limit ConstrainedNormOptimal.rate ConstrainedNormOptimal.total
        ConstrainedNormOptimal.contour EstimatedDisturbance.process_std ExponentialPD.limit
        GradientILC.step GradientILC.limit HigherOrder.limit LearningFilter.limit LearningFilter.dt
        ModelFreeGradient.step ModelFreeGradient.amplitude ModelFreeGradient.limit NormOptimal.limit
        PIDType.limit PolynomialBasis.coulomb PositionBasis.turning RepetitiveControl.period
        RepetitiveControl.longest StopWhen.max_error StopWhen.rms TwoStep.limit TwoStep.rate""",
    "(0, inf]": "ConstrainedNormOptimal.tube TwoStep.tube",
    "[-inf, inf)": "ConstrainedNormOptimal.y_low TwoStep.y_low",
    "(-inf, inf]": "ConstrainedNormOptimal.y_high TwoStep.y_high",
    "(0, 0.5]": "PeriodTracking.fastest",
    "(0, 1)": "Ladder.slow PeriodTracking.within RationalBasis.least",
    "[0, 1)": "PIDType.leak",
    "(0, 1]": """CFDLMFAC.eta CFDLMFAILC.rho CFDLMFAILC.eta CFDLMFAPC.eta CFDLMFAPC.delta
        FFDLMFAC.rho FFDLMFAILC.rho RepetitiveBasis.keep""",
    "(0, 2)": "BasisFunctions.step ConstrainedNormOptimal.step",
    "(0, 2]": "FFDLMFAC.eta FFDLMFAILC.eta PeriodTracking.rate",
    "[0, 0]": "CFDLMFAC.L_y CFDLMFAILC.L_y PFDLMFAC.L_y PFDLMFAILC.L_y",
    "[1, 1]": "CFDLMFAC.L_u CFDLMFAILC.L_u",
    "[1, 4]": "RationalBasis.order",
    "[1, 100]": "BasisFunctions.iterations OnBasis.iterations",
    "[0, 500]": "FFDLMFAC.L_y FFDLMFAILC.L_y",
    "[1, 500]": "CFDLMFAPC.P_u CFDLMFAPC.n_p FFDLMFAC.L_u FFDLMFAILC.L_u",
    "[1, 1e+06]": "CFDLMFAPC.P ModelFreeGradient.inputs ModelFreeGradient.outputs",
    "[1, 1e+09]": "Ladder.repeats",
    "[0, 1e+09]": "ModelFreeGradient.seed",
    "[1, inf)": "Ladder.growth_of_gain Ladder.largest",
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


def parts():
    """One object of each class of scheme in cases.py, with the task that it sees."""
    found = {}
    for name in SCHEMES:
        _, scheme, task = case(name)
        for part in with_all_parts(scheme, task):
            found.setdefault(type(part.scheme), (part.scheme, part.task))
    return found.values()


def test_each_field_has_its_range():
    found = {}
    for name, cls in vars(schemes).items():
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
        return ["none of them", 2]
    interval: Interval | None = field.metadata.get("interval")
    if interval is None or str(interval) == "(-inf, inf)":
        return []
    step = 1 if field.metadata.get("whole") else 1e-3
    ends = ((interval.low, interval.closed_low, -step), (interval.high, interval.closed_high, step))
    near = [end + by if closed else end for end, closed, by in ends]
    more = [1.5] if field.metadata.get("whole") and interval.contains(1.5) else []
    return [x for x in near if not np.isinf(x)] + more + [np.nan]


def test_what_is_outside_is_refused_and_named():
    for scheme, _ in parts():
        for field in dataclasses.fields(scheme):
            for value in outside(field):
                with pytest.raises(ValueError, match=r"is outside its|is not one of") as caught:
                    dataclasses.replace(scheme, **{field.name: value})
                assert f"{type(scheme).__name__}: {field.name} = " in str(caught.value)


def test_a_leaf_of_seven_numbers_is_refused_and_named():
    for scheme, task in parts():
        for field in dataclasses.fields(scheme):
            at = type(scheme).__name__, field.name
            if field.metadata.get("kind") != "leaf" or at in NOT_BY_SHAPE:
                continue
            seven = np.full(7, 0.5 if field.metadata["interval"].contains(0.5) else 1.0)
            with pytest.raises(ValueError, match=rf"\b{field.name}\b.*\(7,\)"):
                dataclasses.replace(scheme, **{field.name: seven}).check(task)
