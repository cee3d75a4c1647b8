"""This file lists every plant and every scheme once, by name.

What is listed here gets every test of test_conformance.py.
"""

import os

import numpy as np

from jaxilc.filters import (
    SwitchableFilter,
    ZeroPhaseBandStop,
    ZeroPhaseButterworth,
    ZeroPhaseFIR,
    ZeroPhaseIIR,
    stable_inverse,
    zpetc,
)
from jaxilc.learning import Machine
from jaxilc.plants import (
    BallScrewDrive,
    BoucWen,
    ByPosition,
    Cogging,
    Creep,
    CuttingForce,
    Dahl,
    DifferenceEquation,
    EndEffect,
    FastToolServo,
    FlexibleMode,
    FrictionTable,
    Harmonics,
    InBlocks,
    InputHysteresis,
    LeadError,
    ModalModel,
    Pendulum,
    PeriodicForce,
    PositionMap,
    ProcessModel,
    Splines,
    StateSpace,
    StribeckFriction,
    ThreeAxes,
    TimeVaryingStateSpace,
    TwoAxes,
    VoiceCoilMotor,
    direct_model,
    multivariable_model,
    voice_coil,
)
from jaxilc.plants.voice_coil import CAO_2019_EQ_29, DAI_2014_EQ_24
from jaxilc.schemes import (
    ASMC,
    CFDLMFAC,
    CFDLMFAILC,
    CFDLMFAPC,
    FFDLMFAC,
    FFDLMFAILC,
    PFDLMFAC,
    PFDLMFAILC,
    PID,
    SMC,
    AtSamples,
    BasisFunctions,
    ConstrainedNormOptimal,
    CrossCoupled,
    ErrorFiltered,
    EstimatedDisturbance,
    ExponentialPD,
    Filtered,
    GivenBasis,
    GradientILC,
    HigherOrder,
    JoinedBasis,
    KeepUnmeasured,
    Ladder,
    LearningFilter,
    ModelFreeGradient,
    MultivariableILC,
    NormOptimal,
    OnBasis,
    OnOutputs,
    OnReference,
    PeriodTracking,
    PIDType,
    PolynomialBasis,
    PositionBasis,
    RationalBasis,
    RepetitiveBasis,
    RepetitiveControl,
    SelectedBasis,
    StopWhen,
    TwoStep,
    WarmStart,
    WithFeedback,
    with_jerk,
)
from jaxilc.signals import Task

# The three tolerance tiers: rounding, central differences, and random scatter in units of one
# standard error.
ALGEBRA = {"rtol": 1e-10, "atol": 1e-12}
DIFFERENCES = {"rtol": 2e-6, "atol": 1e-8}
SIGMAS = 6.0


def assert_close(found, expected, name=""):
    """Compare to rounding, in units of the largest number that is expected where it is above 1."""
    scale = max(1.0, np.max(np.abs(expected), initial=0.0))
    np.testing.assert_allclose(
        found, expected, rtol=ALGEBRA["rtol"], atol=ALGEBRA["atol"] * scale, err_msg=name
    )


DT = 1e-3
PRINTED = ((2.2386, -1.6246, 0.385), (0.0018, -0.0036, -0.0025))  # Cao 2019, eq. 29
ARX = ((1.6, -0.65), (0.06, 0.03))  # stable, with its zero at -0.5: minimum phase
SAMPLES = 32  # of a trial, unless a test sets another number or the case is one of the slow ones
FEW = 12

# a low-mass drive with an antiresonance at 32 Hz, soft enough for 1 ms: its speed loop is 50 Hz
# wide
DRIVE = {
    "motor_mass": 2.0,
    "table_mass": 1.0,
    "stiffness": 4e4,
    "damping": 20.0,
    "force_gain": 4.0,
    "motor_damping": 3.0,
    "table_damping": 2.0,
    "command_scale": 10.0,
}
_GREASE = StribeckFriction(
    coulomb_force=2.0,
    static_force=3.0,
    transition_velocity=0.02,
    stribeck_velocity=0.05,
    viscous=1.0,
)
_WAVE = 1 + 0.05 * np.sin(np.arange(FEW))[:, None, None]

# a fast tool servo slow enough for 1 ms, with a gain of 1 um/V
_SERVO = {"mass": 10.0, "damping": 1.3e-3, "conversion": 0.05, "longest_dt": DT}

_ARX = DifferenceEquation(*ARX, dt=DT)
_LAG = StateSpace([[0.9, 0.1], [-0.2, 0.8]], [[0.01], [0.1]], [[1.0, 0.5]], dt=DT)

PLANTS = {
    "voice_coil_exact": voice_coil(),
    "voice_coil_printed": DifferenceEquation(*CAO_2019_EQ_29, dt=DT),
    "voice_coil_dai": DifferenceEquation(*DAI_2014_EQ_24, dt=DT),
    "arx": _ARX,
    "continuous": StateSpace(
        [[0.0, 1.0], [-4e3, -80.0]], [[0.0], [4e3]], [[1.0, 0.0]], x0=(0.02, -1.0)
    ),
    "discrete": _LAG,
    "mimo": StateSpace(
        [[-50.0, 20.0], [5.0, -90.0]], [[50.0, 5.0], [-10.0, 80.0]], [[1.0, 0.1], [0.2, 1.0]]
    ),
    # A limit that is not reached has a gradient of zero, so this motor has no limits. Its current
    # loop is slow, so one substep for each sample is enough.
    "motor": VoiceCoilMotor(
        current_gain=30.0, substep=1e-3, current_limit=None, voltage_limit=None, speed_limit=None
    ),
    "process_model": ProcessModel(
        gain=-4.8, zeros=(900.0,), poles=(6.4,), frequencies=(470.0,), dampings=(0.9,)
    ),
    "modal": ModalModel(
        poles=(60.0,),
        pole_gains=[[[0.6, 0.1], [-0.2, 0.5]]],
        frequencies=(180.0, 700.0),
        dampings=(0.05, 1.3),
        mode_gains=[[[0.3, 0.1], [0.1, 0.2]], [[0.2, 0.0], [0.1, 0.4]]],
        mode_rates=[[[0.0, 0.1], [0.0, -0.1]], [[0.2, 0.1], [0.0, 0.1]]],
        integrator=[[2.0, 0.0], [1.0, 3.0]],
        double_integrator=[[40.0, 10.0], [0.0, 20.0]],
        direct=[[0.05, 0.0], [0.02, 0.1]],
        delay=0.7 * DT,
    ),
    "fast_tool_servo_linear": FastToolServo(
        **_SERVO,
        amplifier_bandwidth=80.0,
        load=0.2,
        drift=3.0,
        mode=FlexibleMode(130.0, 0.05, -0.1),
        creep=Creep((0.1,), (0.005,)),
        periodic=PeriodicForce((0.1,), (40.0,), (0.3,)),
    ),
    "fast_tool_servo_nonlinear": FastToolServo(
        **_SERVO,
        hysteresis=BoucWen(0.3, 1.2, -0.3, exponent=1.6, substeps=1),
        friction=Dahl(0.3, 0.1, exponent=1.4),
        cutting=CuttingForce(0.3, -0.1, blur=0.2),
    ),
    "ball_screw": BallScrewDrive(**DRIVE),
    "ball_screw_real": BallScrewDrive(
        **DRIVE,
        current_bandwidth=80.0,
        motor_friction=_GREASE,
        table_friction=_GREASE,
        lead_error=LeadError(amplitude=2e-5, period=5e-4, phase=0.4),
        compensation=FrictionTable.of(_GREASE, np.linspace(-0.1, 0.1, 7)),
    ),
    "time_varying": TimeVaryingStateSpace(
        np.array([[0.9, 0.1], [-0.2, 0.8]]) * _WAVE,
        np.array([[0.05], [0.1]]) / _WAVE,
        np.array([[1.0, 0.5]]) * _WAVE[::-1],
        dt=DT,
    ),
    # The end of the stroke lies within the motion, and the buffer beyond it is reached.
    "motor_real": VoiceCoilMotor(
        current_gain=30.0,
        substep=1e-3,
        current_limit=None,
        voltage_limit=None,
        speed_limit=None,
        command_delay=None,
        stiffness=50.0,
        friction=_GREASE,
        cogging=Cogging(amplitude=2.0, pitch=1e-3, phase=0.4),
        end_effect=EndEffect(stroke=2e-4, drop=0.3, buffer_stiffness=5e3),
    ),
    "in_blocks": InBlocks(TwoAxes(_LAG, _ARX), length=5),
    "three_axes": ThreeAxes(_LAG, _ARX, InputHysteresis(_LAG, Dahl(0.4, 0.3))),
    "by_position": ByPosition(
        _LAG,
        PositionMap(Splines(-0.1, 0.9, 4), 0.3 * np.cos(np.arange(8)), turning=40.0),
        ripple=PositionMap(Harmonics(0.7, (0, 1)), (0.1, -0.2, 0.1)),
        error=PositionMap(Harmonics(0.4, (1,)), (0.01, 0.02)),
        backlash=0.02,
    ),
    # so heavy that it swings within a few samples of 1 ms, far from where it is linear
    "pendulum": Pendulum(mass=0.02, damping=0.1, inertia=1e-3, length=0.2, gravity=9e4),
    "motor_and_table": StateSpace(
        [[0.9, 0.1], [0.3, 0.6]], [[0.2], [0.0]], [[1.0, 0.0], [0.0, 1.0]], dt=DT
    ),
}

# These are models of discrete, of mimo, and of motor_and_table.
MODEL = StateSpace([[0.88, 0.12], [-0.15, 0.8]], [[0.02], [0.09]], [[1.0, 0.4]], dt=DT)
_MODEL_OF_TWO = StateSpace(
    [[0.94, 0.03], [0.01, 0.9]], [[0.06, 0.01], [-0.02, 0.07]], [[1.0, 0.05], [0.25, 1.0]], dt=DT
)
_NOMINAL = StateSpace([[0.87, 0.12], [0.33, 0.58]], [[0.22], [0.0]], np.eye(2), dt=DT)
# These numbers are close to the model of arx.
_SLIDING = {"a1": 5.8e4, "a2": 400.0, "b": 1.15e5, "k_n": 200.0, "lam1": 150.0, "lam2": 300.0}
_ADAPTIVE = _SLIDING | {"eta": 1e3, "phi": 2e4, "epsilon": 0.03, "Delta": 6.0}
_CFDL = {"phi0": -0.065, "lam": 0.02, "mu": 0.05, "rho": 0.9}
_PFDL = {"phi0": (-0.065, 0.02), "lam": 0.02, "mu": 0.05, "rho": (0.9, 0.7)}
_FFDL = {"phi0": (0.5, -0.1, -0.06, 0.03), "lam": 0.02, "mu": 0.05, "rho": (0.9, 0.6, 0.8, 0.7)}
_MFAILC = {"cfdl": (CFDLMFAILC, _CFDL), "pfdl": (PFDLMFAILC, _PFDL), "ffdl": (FFDLMFAILC, _FFDL)}

SCHEMES = {
    "pid_position": PID(kp=-8.0, ki=-40.0, kd=-2e-3),
    "pid_increment": PID(kp=-8.0, ki=-40.0, kd=-2e-3, form="increment"),
    "pid_position_limited": PID(kp=-8.0, ki=-400.0, kd=-2e-3, tau=2e-3, limit=6.0),
    "pid_increment_limited": PID(
        kp=-8.0, ki=-400.0, kd=-2e-3, tau=2e-3, limit=6.0, form="increment"
    ),
    "p_type": PIDType(gamma_p=-1.0),
    "pd_type": PIDType(gamma_p=-1.0, gamma_d=-3.0, lead=2),
    "pid_type_leaky_limited": PIDType(
        gamma_p=-1.0, gamma_i=-0.05, gamma_d=-3.0, leak=0.05, limit=1.7, lead=3
    ),
    **{
        f"{name}_{mode}": law(**weights, reset=mode)
        for name, (law, weights) in _MFAILC.items()
        for mode in ("book", "sign", "none")
    },
    **{
        f"{name}_lead_limited": law(**weights, reset="sign", lead=2, limit=2.0)
        for name, (law, weights) in _MFAILC.items()
    },
    "cfdl_smooth": CFDLMFAILC(phi0=-0.065, lam=0.02, mu=0.05, epsilon=0.02, reset="smooth"),
    "ffdl_smooth": FFDLMFAILC(
        phi0=(0.5, -0.1, -0.06, 0.03), lam=0.02, mu=0.05, epsilon=0.02, reset="smooth"
    ),
    "cfdl_mfac": CFDLMFAC(lam=0.3, phi0=-0.1, reset="sign"),
    "pfdl_mfac": PFDLMFAC(lam=0.3, phi0=(-0.1, 0.02), rho=(0.9, 0.6), reset="sign"),
    "ffdl_mfac": FFDLMFAC(
        lam=0.3, phi0=(0.5, -0.1, -0.1, 0.02), rho=(0.9, 0.6, 0.8, 0.7), reset="none"
    ),
    "cfdl_mfapc": CFDLMFAPC(lam=3.0, phi0=-0.1, P=5, reset="sign"),
    "cfdl_mfapc_moves": CFDLMFAPC(
        lam=3.0, phi0=-0.1, P=5, P_u=3, n_p=2, theta0=(0.8, 0.1), reset="sign", reference="constant"
    ),
    "ilc_mfapc": WithFeedback(
        PIDType(gamma_p=-0.2, gamma_d=-1.0), CFDLMFAPC(lam=3.0, phi0=-0.1, P=5, reset="sign")
    ),
    "p_type_on_reference": OnReference(
        PIDType(gamma_p=0.4, lead=1), CFDLMFAPC(lam=3.0, phi0=-0.1, P=4, reset="sign")
    ),
    "repetitive": WithFeedback(
        RepetitiveControl(
            LearningFilter((-0.1, -0.4, -0.1), keep=(0.2, 0.5, 0.2)),
            4.6e-3,
            tracking=PeriodTracking(),
        ),
        PID(kp=-4.0, ki=-40.0, kd=-2e-3),
    ),
    "repetitive_basis": WithFeedback(
        RepetitiveBasis(Harmonics(5.2e-3, (0, 1, 2)), gain=-0.1, lead=1e-3, keep=0.98),
        PID(kp=-4.0, ki=-40.0, kd=-2e-3),
    ),
    "p_type_over_pid": WithFeedback(
        PIDType(gamma_p=-1.0, lead=2), PID(kp=-4.0, ki=-40.0, kd=-2e-3)
    ),
    "p_type_fir": Filtered(PIDType(gamma_p=-1.0), ZeroPhaseFIR((0.4, 0.2, 0.1))),
    "p_type_butterworth": Filtered(PIDType(gamma_p=-1.0), ZeroPhaseButterworth(80.0)),
    "cfdl_butterworth": Filtered(CFDLMFAILC(**_CFDL), ZeroPhaseButterworth(80.0, order=3)),
    "error_filtered": ErrorFiltered(PIDType(gamma_p=-1.0, lead=1), ZeroPhaseBandStop(90.0, 160.0)),
    # one of a model whose zero, at -1.3, is outside the unit circle
    "inverses": ErrorFiltered(
        ErrorFiltered(
            PIDType(gamma_p=0.01),
            stable_inverse(
                StateSpace([[0.9, 0.1], [-0.2, 0.8]], [[0.01], [0.1]], [[1.0, -0.05]], dt=DT)
            ),
        ),
        zpetc(_LAG, radius=0.7),
    ),
    "ffdl_fir": Filtered(FFDLMFAILC(**_FFDL), ZeroPhaseFIR((0.6, 0.2))),
    "pid_feedforward": PID(kp=-8.0, ki=-40.0, kd=-2e-3, kv=-2e-3, ka=-2e-5),
    "pid_feedforward_increment": PID(
        kp=-8.0, ki=-400.0, kd=-2e-3, limit=5.0, form="increment", kv=-2e-3, ka=-2e-5
    ),
    "learning_filter": LearningFilter(
        (-0.2, -0.7, 0.1), keep=(0.1, 0.25, 0.3, 0.2, 0.1), limit=1.2, lead=1
    ),
    "learning_filter_butterworth": Filtered(
        LearningFilter((0.05, -0.2, -0.5, -0.1, 0.0)), ZeroPhaseButterworth(80.0)
    ),
    "higher_order": HigherOrder((0.7, 0.3), (-0.8, -0.4), lead=1),
    "higher_order_leaky_limited": HigherOrder(
        (0.6, 0.2, 0.1), ((-0.8,), (-0.4,), (-0.2,)), limit=1.2
    ),
    "p_type_switchable": Filtered(
        PIDType(gamma_p=-1.0),
        SwitchableFilter((60.0, 150.0, 90.0), (0.0083, 0.0187), 0.006, order=1, padding=4),
    ),
    # a Butterworth filter of 80 Hz at 1 kHz
    "p_type_iir": Filtered(
        PIDType(gamma_p=-1.0), ZeroPhaseIIR((0.0461, 0.0922, 0.0461), (1.0, -1.3073, 0.4918))
    ),
    # The error is small enough for the first time in the third trial.
    "p_type_stop": StopWhen(
        Filtered(PIDType(gamma_p=-1.0), ZeroPhaseFIR()), max_error=0.85, rms=0.6, growth=0.5
    ),
    # The gain grows after the second trial, and after the third it reaches its largest value.
    "p_type_ladder": Ladder(
        PIDType(gamma_p=-0.3, lead=1), repeats=1, growth_of_gain=1.2, largest=1.3, slow=0.5
    ),
    "p_type_on_table": OnOutputs(PIDType(gamma_p=0.5, lead=1), (1,)),
    "cross_coupled": CrossCoupled(PIDType(gamma_p=0.8), contour=1.5, own=0.4),
    "norm_optimal": NormOptimal(
        _MODEL_OF_TWO, w_q=((4.0, 0.5), (0.5, 3.0)), w_r=(0.02, 0.03), w_s=0.001
    ),
    "norm_optimal_lifted": NormOptimal(MODEL, w_r=0.05, w_s=0.01, limit=0.6, form="lifted"),
    "gradient": GradientILC(MODEL, w_q=2.0, w_s=0.01, limit=1.5),
    # A step takes four trials, and the limit cuts off some of its experiments.
    "model_free": ModelFreeGradient(
        2.0,
        3.0,
        w_q=((1.0, 0.1), (0.1, 0.3)),
        limit=1.2,
        filter=ZeroPhaseFIR((0.6, 0.2)),
        about="mean",
        outputs=2,
    ),
    # Every bound is met: each has a derivative.
    "constrained": ConstrainedNormOptimal(
        MODEL,
        w_r=0.05,
        w_s=0.01,
        w_d=0.02,
        step=0.9,
        limit=2.4,
        rate=1200.0,
        y_low=np.where(np.arange(FEW + 1) == 10, 0.325, -1.0)[:, None],
        y_high=0.6,
        tube=0.47,
    ),
    "estimated_disturbance": EstimatedDisturbance(
        NormOptimal(_MODEL_OF_TWO, w_r=0.02, w_s=0.001),
        process_std=0.05,
        measurement_std=(0.1, 0.04),
        initial_std=0.3,
    ),
    "two_step": TwoStep(
        Pendulum(mass=0.018, damping=0.12, inertia=1.1e-3, length=0.21, gravity=8.5e4),
        w_y=1200.0,
        w_alpha=0.01,
        w_change=0.02,
        w_q=900.0,
        w_r=0.01,
        w_s=2e-3,
    ),
    "dilc": WithFeedback(
        OnOutputs(NormOptimal(direct_model(0.5, _NOMINAL), w_q=2.0, w_r=0.1, w_s=0.05), (1,)),
        OnOutputs(PID(kp=0.5, kd=1e-4), (0,)),
    ),
    "milc": MultivariableILC(
        NormOptimal(
            multivariable_model(0.5, _NOMINAL),
            w_q=(1.0, 2.0),
            w_r=((0.1, 0.02), (0.02, 0.3)),
            w_s=0.01,
        ),
        PID(kp=0.5, kd=1e-4),
        prefilter=ZeroPhaseFIR((0.6, 0.2)),
    ),
    # Units that make each parameter near 1: a reference moves 300 per second, 1e5 per second^2.
    "basis_functions": BasisFunctions(
        PolynomialBasis((0, 2), coulomb=90.0, lead=4e-4),
        _MODEL_OF_TWO,
        w_q=((4.0, 0.5), (0.5, 3.0)),
        w_r=(0.02, 0.03),
        w_s=0.001,
        step=0.9,
    ),
    "basis_gradient": BasisFunctions(
        SelectedBasis(PolynomialBasis((0, 1, 2), lead=2e-4), (0, 1)),
        MODEL,
        start=(0.8, 3e-3),
        step=0.7,
        w_q=2.0,
        w_s=0.01,
        update="gradient",
    ),
    "basis_rational": BasisFunctions(
        RationalBasis(PolynomialBasis((0, 1)), least=0.02), MODEL, w_r=0.05, iterations=2
    ),
    "position_basis": BasisFunctions(
        JoinedBasis(
            (PolynomialBasis((1,)), PositionBasis(Splines(-0.2, 1.2, 4), turning=50.0, lead=3e-4))
        ),
        MODEL,
        w_r=0.05,
        w_s=0.01,
    ),
    "on_basis": OnBasis(
        PIDType(gamma_p=-1.0, lead=2), GivenBasis(np.sin(np.outer(np.arange(FEW), (0.2, 0.4, 0.7))))
    ),
    "warm_start": WarmStart(
        PIDType(gamma_p=-1.0, lead=2), PolynomialBasis((0, 1), lead=3e-4), (-0.5, -2e-3)
    ),
    "at_samples": AtSamples(
        NormOptimal(with_jerk(MODEL), w_r=0.02, w_s=1e-3),
        weight=np.where(np.arange(FEW + 1) % 4 == 0, 1.0, 0.1),
        jerk_time=5e-4,
    ),
    "at_samples_p_type": AtSamples(PIDType(gamma_p=-1.0, lead=2), windows=((3e-3, 6e-3), 9e-3)),
    "keep_unmeasured": KeepUnmeasured(PIDType(gamma_p=-1.0)),
    "smc": SMC(**_SLIDING, eta=4e3, tau=5e-4),
    "smc_hold_limited": SMC(**_SLIDING, eta=4e3, tau=5e-4, limit=0.6, centre="hold"),
    "asmc": ASMC(**_ADAPTIVE),
    "asmc_carried_limited": ASMC(**_ADAPTIVE, tau=5e-4, limit=0.6, centre="hold", carry=True),
    "ilc_asmc": WithFeedback(
        ExponentialPD(K_P=2e4, K_D=200.0, lam0=20.0, b=1.15e5, limit=0.05, lead=1),
        ASMC(**_ADAPTIVE),
    ),
}

# What is simulated: every scheme on a plant with the right shape, and every plant under a scheme.
_SIMULATED_ON = {
    "arx": ("smc", "smc_hold_limited", "asmc", "asmc_carried_limited", "ilc_asmc"),
    "discrete": (
        *("norm_optimal_lifted", "constrained", "gradient", "basis_gradient", "position_basis"),
        *("at_samples", "basis_rational", "inverses"),
    ),
    "mimo": ("norm_optimal", "cross_coupled", "estimated_disturbance", "basis_functions"),
    "motor_and_table": ("p_type_on_table", "model_free", "dilc", "milc"),
    "pendulum": ("two_step",),
}
_PLANT_OF = {name: plant for plant, names in _SIMULATED_ON.items() for name in names}
_SCHEME_OF = {
    "motor_and_table": OnOutputs(PID(kp=0.5, kd=1e-4), (0,)),
    **dict.fromkeys(("ball_screw", "ball_screw_real"), OnOutputs(PID(kp=6.0, kd=1e-3), (0,))),
}
_FEW = {
    "at_samples", "on_basis", "cross_coupled", "norm_optimal", "norm_optimal_lifted", "constrained",
    "gradient", "model_free", "estimated_disturbance", "two_step", "dilc", "milc", "ball_screw",
    "ball_screw_real", "time_varying",
}  # fmt: skip
CASES = {
    name: (PLANTS[_PLANT_OF.get(name, "voice_coil_printed")], scheme)
    for name, scheme in SCHEMES.items()
} | {
    name: (plant, _SCHEME_OF.get(name, PIDType(gamma_p=-0.5 if "coil" in name else 0.5)))
    for name, plant in PLANTS.items()
}


def task_for(plant, N=SAMPLES):
    """Return a task whose reference is a smooth bump, a little higher for each further output."""
    bump = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(N + 1) / N)
    return Task(
        np.stack([(1 + 0.3 * i) * bump for i in range(plant.n_y)], axis=1), dt=DT, inputs=plant.n_u
    )


def case(name):
    """Return (machine, scheme, task) of a case."""
    plant, scheme = CASES[name]
    return Machine(plant), scheme, task_for(plant, FEW if name in _FEW else SAMPLES)


# Parts of plant files
# --------------------------------------------------------------------------------------------------


def first_order(pole=0.9, gain=0.1):
    """Return a plant that takes little time, and the beginning of its task."""
    return f"""[plant]
kind = "state_space"
A = [[{pole}]]
B = [[{gain}]]
C = [[1.0]]
dt = 0.001
[task]
dt = 0.001
"""


def lag(pole=150.0, dt=0.001, gain=2.0):
    """Return a plant with a lag in continuous time, and the beginning of its task."""
    return f"""[plant]
kind = "ProcessModel"
gain = {gain}
poles = [{pole}]
[task]
dt = {dt}
unit = "mm"
"""


def follows(hertz, seconds, amplitude=1.0):
    """Return what a task follows."""
    given = f"amplitude = {amplitude}, frequency = {hertz}, duration = {seconds}"
    return f'reference = {{ function = "sinusoid", {given} }}\n'


def p_type(gain, name="ilc"):
    """Return a scheme."""
    return f'[schemes.{name}]\nclass = "PIDType"\ngamma_p = {gain}\n'


def known_to(share, gain="plant.B"):
    """Return that the gain of the plant is known to a share of it."""
    return f"""[uncertainty."{gain}"]
distribution = "uniform"
low = {1 - share}
high = {1 + share}
relative = true
"""


def few(chosen, every):
    """Return the chosen ones of `every`, or with JAXILC_ALL=1, as by `make matrix`, all of them."""
    assert {*chosen} <= {*every}, f"{ {*chosen} - {*every} } are not there"
    return [x for x in every if x in chosen or os.environ.get("JAXILC_ALL") == "1"]
