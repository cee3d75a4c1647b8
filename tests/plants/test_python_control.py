"""Systems of python-control and scipy.signal as plants and back, against their simulators."""

from functools import partial

import control
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal
from cases import ALGEBRA, DRIVE, DT, PLANTS

from jaxilc.learning import Machine, learn
from jaxilc.plants import (
    BallScrewDrive,
    Plant,
    StateSpace,
    TwoAxes,
    VoiceCoil,
    VoiceCoilMotor,
    fast_tool_servo,
    from_control,
    motion,
    to_control,
    voice_coil_motor,
)
from jaxilc.plants.from_python_control import Linear, canonical_form, from_linear
from jaxilc.plants.to_python_control import initial_state
from jaxilc.pytree import leaf, pytree
from jaxilc.schemes import PID
from jaxilc.signals import Task
from jaxilc.uncertainty import Uniform, drawn_machines

N = 40
U = np.random.default_rng(8).normal(size=(N, 2))
NONLINEAR = (
    *("fast_tool_servo_nonlinear", "ball_screw_real", "motor_real", "three_axes"),
    *("pendulum", "time_varying", "by_position"),
)
LINEAR = {
    name: plant
    for name, plant in PLANTS.items()
    if name not in (*NONLINEAR, "voice_coil_printed", "voice_coil_dai")
} | {
    "two_axes": TwoAxes(VoiceCoil(), PLANTS["continuous"]),
    "two_axes_discrete": TwoAxes(PLANTS["arx"], VoiceCoil()),
}  # fmt: skip
# of the others, the response is compared with python-control in the files of the plants
LEAVING = (
    "arx", "ball_screw", "discrete", "fast_tool_servo_linear", "in_blocks", "mimo", "modal",
    "motor_and_table", "two_axes",
)  # fmt: skip


@partial(jax.jit, static_argnames="dt")
def simulated(plant, u, dt=DT):
    """Return the output (N+1, n_y) of the simulator."""
    return motion(plant, jnp.asarray(u), dt)


def forced(system, u, x0=0.0):
    """Return the output (N+1, n_y) of a system by python-control; the input is held."""
    if system.isctime():
        system = control.sample_system(control.ss(system), DT)
    held = np.vstack([u, u[-1:]]).T
    time = np.arange(len(u) + 1) * system.dt
    return control.forced_response(system, time, held, X0=x0, squeeze=False).outputs.T


@pytest.mark.thorough(but=LEAVING)
@pytest.mark.parametrize("name", LINEAR)
def test_a_linear_plant_leaves_as_the_system_that_the_simulator_steps(name):
    """In its own time, too: python-control holds the continuous system to the one sampled here."""
    plant = LINEAR[name]
    sampled, u = to_control(plant, DT), U[:, : plant.n_u]
    assert sampled.dt == DT
    assert (sampled.ninputs, sampled.noutputs) == (plant.n_u, plant.n_y)
    own, y = forced(sampled, u, initial_state(plant, DT)), simulated(plant, u)
    np.testing.assert_allclose(own, y, rtol=1e-8, atol=1e-10)
    assert np.max(np.abs(y)) > 1e-4
    if "ball_screw" in name or name == "modal":  # it has a delay and a direct term
        with pytest.raises(ValueError, match=r"no form in continuous time .* give dt"):
            to_control(plant)
        return
    system = to_control(plant)
    assert system.dt == (0 if plant.continuous() is not None else DT)
    y = forced(system, u, initial_state(plant))
    # Runge-Kutta steps integrate the motor; their length is as large as its fastest pole allows.
    tolerance = 5e-2 if name == "motor" else 1e-9
    np.testing.assert_allclose(y, own, rtol=0, atol=tolerance * np.max(np.abs(own)))


@pytest.mark.parametrize("seed", range(4))
def test_a_random_system_comes_back_as_it_left(seed):
    rng = np.random.default_rng(seed)
    n, n_u, n_y = rng.integers(1, 5), rng.integers(1, 3), rng.integers(1, 3)
    for dt in (0.0, 0.02):
        system = control.rss(n, n_y, n_u, dt=dt, strictly_proper=True)
        back = to_control(from_control(system, allow_unstable=True))
        for name in "ABCD":
            np.testing.assert_array_equal(getattr(back, name), getattr(system, name))
        assert back.dt == system.dt


def test_the_canonical_form_is_that_of_python_control():
    rng = np.random.default_rng(0)
    for _ in range(50):
        n = rng.integers(1, 6)
        den = rng.standard_normal(n + 1) * 10.0 ** rng.integers(-3, 4)
        num = rng.standard_normal(rng.integers(1, n + 1)) * 10.0 ** rng.integers(-3, 4)
        num, den = (np.r_[np.zeros(rng.integers(0, 2)), of] for of in (num, den))
        found, system = canonical_form(num, den, 0.02), control.tf2ss(num, den)
        for name in "ABCD":
            np.testing.assert_array_equal(getattr(found, name), getattr(system, name))


def test_many_poles_in_continuous_time_respond_as_their_factors_and_can_be_sampled():
    poles = -np.random.default_rng(0).uniform(10.0, 300.0, 40)
    den = np.poly(poles)
    plant = from_linear(canonical_form(den[-1:], den, 0.0))
    for s in 1j * np.array([0.0, 20.0, 100.0]):
        found = plant.C @ np.linalg.solve(s * np.eye(40) - plant.A, plant.B)
        np.testing.assert_allclose(found[0, 0], np.prod(poles / (poles - s)), rtol=1e-9)
    assert np.isfinite(plant.sampled(DT).A).all()


def test_poles_that_rounding_makes_unstable_are_refused_with_the_cause():
    poles = np.random.default_rng(0).uniform(0.1, 0.9, 60)
    with pytest.raises(ValueError, match=r"Rounding its 60 coefficients .* give zeros, poles and"):
        from_linear(canonical_form([1.0], np.poly(poles), DT))
    with pytest.raises(ValueError, match=r"allow_unstable=True$"):
        from_linear(canonical_form([1.0], [1.0, -1.2], DT))
    with pytest.raises(ValueError, match="the system is unstable"):  # its squares overflow
        from_linear(Linear(np.diag([1e200, 1.0]), np.ones((2, 1)), np.ones((1, 2)), 0.0, 0.0))


@pytest.mark.parametrize(
    ("num", "den"),
    [
        ([0.0], [1.0, 1.0]),
        ([1.0, 1.0], [1.0, 1.0]),
        ([1.0], [2.0]),
        ([1.0], [0.0, 0.0]),
        ([1e-20], [1.0, 1.0]),
        ([np.nan], [1.0, 1.0]),
    ],
)
def test_other_transfer_functions_are_left_to_python_control(num, den):
    assert canonical_form(num, den, 0.0) is None


def test_the_channels_keep_their_names():
    drive = to_control(BallScrewDrive(**DRIVE), DT)
    assert drive.input_labels == ["velocity_command"]
    assert drive.output_labels == ["motor_position", "table_position"]
    both = to_control(TwoAxes(VoiceCoil(), VoiceCoil()))
    assert both.input_labels == ["x_voltage", "y_voltage"]
    assert to_control(PLANTS["mimo"]).input_labels == ["u[0]", "u[1]"]


@pytree
class Offset(Plant):
    """A plant of a user, which is affine and not linear."""

    c: jax.Array = leaf(default=0.3)

    def initial_state(self):
        return jnp.zeros(1)

    def step(self, x, u, dt):
        return 0.5 * x + u + self.c

    def output(self, x):
        return x


@pytree
class Cubic(Offset):
    def step(self, x, u, dt):
        return 0.5 * x - self.c * x**3 + u


@pytest.mark.parametrize(
    ("plant", "message"),
    [
        (
            voice_coil_motor(),
            r"VoiceCoilMotor is not linear, because of current_limit \(a limit\), voltage_limit "
            r"\(a limit\), speed_limit \(a limit\); allowed",
        ),
        (
            PLANTS["ball_screw_real"],
            r"because of motor_friction \(.*\), table_friction \(.*\), lead_error \(",
        ),
        (fast_tool_servo("full"), r"FastToolServo is not linear, because of hysteresis \("),
        (
            TwoAxes(VoiceCoil(), VoiceCoilMotor(current_limit=None, speed_limit=None)),
            r"TwoAxes is not linear, because of y.voltage_limit \(a limit\);",
        ),
        (PLANTS["time_varying"], "varies over the trial"),
        (Cubic(), r"Cubic is not linear, because of a power of a signal"),
        (Offset(), "Offset has no form in continuous time and no sample time of its own; give dt"),
        ((Offset(), DT), "Offset adds a constant"),
        (control.tf([1.0], [1.0, 1.0]), "TransferFunction is not a plant of jaxilc"),
    ],
)
def test_what_is_not_linear_is_refused_by_name(plant, message):
    with pytest.raises(ValueError, match="to_control: .*" + message):
        to_control(*plant) if isinstance(plant, tuple) else to_control(plant)


# Linear systems of python-control
# --------------------------------------------------------------------------------------------------

LAG, OSCILLATOR = control.tf([40.0], [1.0, 40.0]), control.tf([30.0, 1e4], [1.0, 60.0, 1e4])
NONE = control.tf([0.0], [1.0], 0)
COMING = {
    "siso_tf": OSCILLATOR,
    "siso_tf_discrete": control.tf([0.06, 0.03], [1.0, -1.6, 0.65], DT),
    "siso_ss": control.ss([[0.0, 1.0], [-4e3, -80.0]], [[0.0], [4e3]], [[1.0, 0.0]], 0),
    "siso_ss_discrete": control.ss([[0.9, 0.1], [-0.2, 0.8]], [[0.01], [0.1]], [[1.0, 0.5]], 0, DT),
    "mimo_tf": control.combine_tf([[OSCILLATOR, -0.5 * LAG], [NONE, LAG * LAG]]),
    "mimo_tf_discrete": control.combine_tf(
        [[control.tf([0.1], [1, -0.9], DT), control.tf([0.2, -0.1], [1, -1.1, 0.3], DT)]]
    ),
    "mimo_ss": control.ss(
        *(np.asarray(getattr(PLANTS["mimo"], name)) for name in "ABC"), np.zeros((2, 2))
    ),
    "integrator": control.tf([1.0], [1.0, 0.0]),
    "two_outputs": control.ss([[0.9, 0.1], [0.3, 0.6]], [[0.2], [0.0]], np.eye(2), 0, DT),
}


@pytest.mark.parametrize("name", COMING)
def test_from_control_responds_as_python_control(name):
    system = COMING[name]
    plant = from_control(system)
    assert (plant.n_y, plant.n_u) == (system.noutputs, system.ninputs)
    u = U[:, : plant.n_u]
    y = (
        forced(system, u)
        if isinstance(system, control.StateSpace) or system.ninputs == system.noutputs == 1
        else sum_of_entries(system, u)
    )
    np.testing.assert_allclose(simulated(plant, u), y, rtol=1e-8, atol=1e-10)
    assert np.all(np.max(np.abs(y), axis=0) > 1e-3)


def sum_of_entries(system, u):
    """Return the response of a MIMO transfer function by entries: python-control needs slycot."""
    return np.stack(
        [
            sum(forced(system[i, j], u[:, j : j + 1])[:, 0] for j in range(system.ninputs))
            for i in range(system.noutputs)
        ],
        axis=1,
    )


def test_unstable_plant_under_a_stabilising_loop():
    """x' = 20 x + u under u = -120 x has its pole at -100.

    Sampled, the pole is exp(20 dt) - 120 (exp(20 dt) - 1) / 20.
    """
    plant = from_control(control.tf([1.0], [1.0, -20.0]), allow_unstable=True)
    kicked = StateSpace(plant.A, plant.B, plant.C, np.ones(1) / plant.C[0], plant.dt)
    y = learn(Machine(kicked), PID(kp=120.0), Task(np.zeros(N + 1), dt=DT), 1).final.y[:, 0]
    growth = np.exp(20 * DT)
    np.testing.assert_allclose(y, (growth - 6 * (growth - 1)) ** np.arange(N + 1), **ALGEBRA)


# Nonlinear systems of python-control
# --------------------------------------------------------------------------------------------------


def pendulum_by(xp):
    """Return the update function by jax.numpy or, for python-control, by NumPy."""

    def update(t, x, u, params):
        force = u[0] + 0.3 * xp.cos(9.0 * t)
        return xp.array([x[1], -params["stiffness"] * xp.sin(x[0]) - 2.0 * x[1] + force])

    return update


pendulum, pendulum_in_numpy = pendulum_by(jnp), pendulum_by(np)


def angle(t, x, u, params):
    return x[:1]


SIZES = {"inputs": 1, "outputs": 1, "states": 2, "params": {"stiffness": 30.0}}


def test_a_continuous_nonlinear_system_is_integrated():
    dt = 0.02
    plant = from_control(control.nlsys(pendulum, angle, **SIZES), x0=(0.4, -1.0), substep=dt / 4)
    assert plant.timed
    u = 20.0 * U[:, :1]
    # python-control interpolates the input, so every sample needs its own call
    oracle = control.nlsys(pendulum_in_numpy, angle, **SIZES)
    x, y = np.array([0.4, -1.0]), [0.4]
    for k, held in enumerate(u[:, 0]):
        found = control.input_output_response(
            oracle, [k * dt, (k + 1) * dt], np.array([[held, held]]), x,
            solve_ivp_kwargs={"rtol": 1e-11, "atol": 1e-12},
        )  # fmt: skip
        x = found.states[:, -1]
        y.append(x[0])
    errors = []
    for steps in (2, 4):
        plant = from_control(
            control.nlsys(pendulum, angle, **SIZES), x0=(0.4, -1.0), substep=dt / steps
        )
        errors.append(np.max(np.abs(simulated(plant, u, dt)[:, 0] - np.array(y))))
    assert errors[1] < 1e-7 * np.max(np.abs(y))
    assert 3.5 < np.log2(errors[0] / errors[1]) < 4.5  # the method has order 4


def mapped_by(xp):
    def update(t, x, u, params):
        return xp.stack([0.7 * x[0] + xp.tanh(params["gain"] * u[0]), x[0] * u[1] + 0.1 * x[1]])

    return update


def test_a_discrete_nonlinear_system_steps_as_in_python_control():
    given = {"inputs": 2, "outputs": 2, "states": 2, "params": {"gain": 0.8}, "dt": DT}
    plant = from_control(control.nlsys(mapped_by(jnp), None, **given))
    assert not plant.timed
    y = control.input_output_response(
        control.nlsys(mapped_by(np), None, **given), np.arange(N + 1) * DT, np.vstack([U, U[-1:]]).T
    ).outputs.T
    np.testing.assert_allclose(simulated(plant, U), y, **ALGEBRA)
    with pytest.raises(ValueError, match=r"NonlinearSystem is sampled at 0.001 s"):
        simulated(plant, U, 2 * DT)


def test_its_parameters_are_leaves():
    machine = Machine(from_control(control.nlsys(pendulum, angle, **SIZES), substep=0.01))
    name = "plant.parameters.stiffness"
    drawn = drawn_machines(
        machine, {name: Uniform(20.0, 40.0)}, {name: np.array([20.0, 28.0, 36.0])}
    )

    def last(machine):
        return simulated(machine.plant, np.ones((N, 1)), 0.02)[-1, 0]

    ends = jax.vmap(last)(drawn)
    assert len(set(np.asarray(ends).tolist())) == 3
    slope = jax.grad(last)(machine).plant.parameters["stiffness"]
    assert np.isfinite(slope)
    assert slope < 0


def with_feedthrough(t, x, u, params):
    return x[:1] + u


SCIPY = {
    "lti_tf": scipy.signal.TransferFunction([30.0, 1e4], [1.0, 60.0, 1e4]),
    "lti": scipy.signal.lti([40.0], [1.0, 40.0]),
    "lti_zpk": scipy.signal.ZerosPolesGain([-300.0], [-40.0 + 30.0j, -40.0 - 30.0j], 9.0),
    "lti_ss": scipy.signal.StateSpace(
        *(np.asarray(getattr(PLANTS["mimo"], name)) for name in "ABC"), np.zeros((2, 2))
    ),
    "dlti": scipy.signal.dlti([0.06, 0.03], [1.0, -1.6, 0.65], dt=DT),
    "dlti_zpk": scipy.signal.ZerosPolesGain([0.3], [0.9, 0.5], 0.2, dt=DT),
}


@pytest.mark.parametrize("name", SCIPY)
def test_systems_of_scipy_respond_as_in_scipy(name):
    system = SCIPY[name]
    plant = from_control(system)
    discrete = system if isinstance(system, scipy.signal.dlti) else system.to_ss().to_discrete(DT)
    u = U[:, : plant.n_u]
    y = scipy.signal.dlsim(discrete, np.vstack([u, u[-1:]]))[1]
    np.testing.assert_allclose(simulated(plant, u), y, rtol=1e-7, atol=1e-10)
    assert np.max(np.abs(y)) > 1e-3


TOO_LONG = "den has 1002 coefficients, of order 1001; allowed is an order of at most 1000"
HIGH = [1.0], [1.0, *[0.0] * 1001]
SOFT = SIZES | {"params": {"stiffness": "soft"}}
OPEN, LINEAR_ONLY = "dt = {} leaves the sample time open", r"{} is not a control.StateSpace or "
# system, options of from_control, what is said
NOT_TAKEN = [
    (control.tf([1.0], [1.0, -2.0]), {},
     r"unstable \(a pole 2 right of the imaginary axis\).*allow_unstable=True"),
    (control.tf([1.0], [1.0, -1.25], DT), {}, r"unstable \(a pole 0.25 outside the unit circle\)"),
    (control.tf([1.0, 0.0, 0.0], [1.0, 3.0]), {}, r"entry \(0, 0\) is improper"),
    (control.tf([1.0, 0.0], [1.0, 3.0]), {}, r"direct feedthrough D = \[\[1.0\]\]"),
    (control.ss([[-1.0]], [[1.0]], [[1.0]], [[2.0]]), {}, r"direct feedthrough D = \[\[2.0\]\]"),
    (control.tf([0.1], [1.0, -0.9], True), {}, OPEN.format(True)),
    (control.ss([[-1.0]], [[1.0]], [[1.0]], 0, None), {}, OPEN.format(None)),
    (control.frd([1.0, 0.5], [1.0, 2.0]), {}, LINEAR_ONLY.format("FrequencyResponseData")),
    (np.eye(2), {}, LINEAR_ONLY.format("ndarray") + "control.TransferFunction, a control.nlsys"),
    (control.nlsys(pendulum_in_numpy, angle, **SIZES), {"substep": 1e-3},
     r"JAX cannot trace the update function \(TracerArrayConversionError\); write it with"),
    (control.nlsys(pendulum, angle, **SIZES), {},
     "substep = None for a nonlinear system in continuous time; give the longest step"),
    (control.nlsys(pendulum, angle, **SIZES, dt=DT), {"substep": 1e-3},
     "substep is for a continuous system; this one is discrete"),
    (control.nlsys(pendulum, with_feedthrough, **SIZES), {"substep": 1e-3},
     "the output function uses u, a direct feedthrough"),
    (control.nlsys(pendulum, angle, **SIZES | {"outputs": 2}), {"substep": 1e-3},
     r"the output function returns the shape \(1,\); allowed is \(2,\)"),
    (control.nlsys(pendulum, angle, **SOFT), {"substep": 1e-3},
     "the parameter stiffness = 'soft' is not a number"),
    (control.nlsys(pendulum, angle, **SIZES, dt=True), {}, OPEN.format(True)),
    (control.tf([1.0], [1.0, 1.0]), {"substep": 1e-3},
     "substep is for a nonlinear system; this one is linear"),
    (scipy.signal.lti([1.0, 0.0], [1.0, 1.0]), {}, "direct feedthrough"),
    (scipy.signal.dlti([0.1], [1.0, -0.9]), {}, OPEN.format(True)),
    (scipy.signal.lti([1.0], [1.0, -1.0]), {}, "the system is unstable"),
    (control.tf(*HIGH, dt=1e-3), {}, TOO_LONG),
    (scipy.signal.dlti(*HIGH, dt=1e-3), {}, TOO_LONG),
]  # fmt: skip


@pytest.mark.parametrize(("system", "options", "message"), NOT_TAKEN)
def test_what_cannot_come_in_is_refused_with_the_reason(system, options, message):
    with pytest.raises(ValueError, match="from_control: .*" + message):
        from_control(system, **options)


def test_a_denominator_too_long_for_matrices_is_refused():
    with pytest.raises(ValueError, match=f"from_control: {TOO_LONG}"):
        canonical_form(*HIGH, 1e-3)


def test_an_initial_state_comes_in_with_a_linear_system():
    plant = from_control(control.tf([40.0], [1.0, 40.0]), x0=(2.0,))
    assert isinstance(plant, StateSpace)
    y = simulated(plant, np.zeros((N, 1)))[:, 0]
    start = 2.0 * plant.C[0, 0]
    np.testing.assert_allclose(y, start * np.exp(-40 * DT * np.arange(N + 1)), rtol=1e-9)
    assert start != 0
