"""The fast tool servo and its hysteresis (Xu 2024), against python-control, scipy and the print."""

import dataclasses
from functools import partial

import control
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from refusals import refused
from scipy.integrate import solve_ivp

from jaxilc.learning import Machine, learn
from jaxilc.plants import (
    BoucWen,
    Creep,
    CuttingForce,
    Dahl,
    FastToolServo,
    FlexibleMode,
    InputHysteresis,
    PeriodicForce,
    StateSpace,
    fast_tool_servo,
    motion,
)
from jaxilc.schemes import PIDType
from jaxilc.signals import Task

DT = 1e-4
N = 100
TIME = np.arange(N + 1) * DT
U = np.random.default_rng(7).normal(size=N)
G = control.tf([2.229e7], [1.0, 70.16, 2.413e6])
GAIN = 2.229e7 / 2.413e6
TOLERANCES = {"method": "DOP853", "rtol": 1e-12, "atol": 1e-13}


@partial(jax.jit, static_argnames="dt")
def outputs(plant, u, dt=DT):
    """Return the outputs (N+1,) [um] from rest; the input u (N,) is held over each sample."""
    return motion(plant, jnp.asarray(u)[:, None], dt)[:, 0]


def assert_close(y, expected, relative):
    """Check that the difference is a small part of the largest output."""
    assert np.max(np.abs(expected)) > 1e-3
    np.testing.assert_allclose(y, expected, rtol=0, atol=relative * np.max(np.abs(expected)))


# The linear servo
# --------------------------------------------------------------------------------------------------


def as_control(plant):
    return control.ss(*(np.asarray(M) for M in (plant.A, plant.B, plant.C)), 0)


def test_identified_servo_is_the_printed_one():
    """Section 5.2 prints G(s) and a1, a2, b: a resonance at 247 Hz with a damping of 0.0226."""
    servo = fast_tool_servo()
    for gain in (1, 2):  # that of the amplifier is part of b
        found = FastToolServo(amplifier_gain=gain * 20.0).coefficients
        np.testing.assert_allclose(found, (2.413e6, 70.16, gain * 2.229e7), rtol=1e-14)
    s = 2j * np.pi * np.array([0.1, 40.0, 247.0, 1000.0])
    np.testing.assert_allclose(as_control(servo.linear())(s), G(s), rtol=1e-10)
    frequencies, dampings, _ = control.damp(as_control(servo.linear()), doprint=False)
    np.testing.assert_allclose(frequencies / (2 * np.pi), 247.2, atol=0.05)
    np.testing.assert_allclose(dampings, 0.0226, atol=5e-5)


LAG = control.tf([1.0], [1 / (2 * np.pi * 3000.0), 1.0])
MODE = control.tf([-0.2 * GAIN], [1 / (2 * np.pi * 900.0) ** 2, 0.06 / (2 * np.pi * 900.0), 1.0])
CREEP = control.tf([0.1 * GAIN], [1e-3, 1.0]) + control.tf([0.3 * GAIN], [4e-3, 1.0])
LINEAR = {
    "amplifier": ({"amplifier_bandwidth": 3000.0}, G * LAG),
    "mode": ({"mode": FlexibleMode(900.0, 0.03, -0.2)}, G + MODE),
    "creep": ({"creep": Creep((0.1, 0.3), (1e-3, 4e-3))}, G + CREEP),
}
ALL = {name: part for parts, _ in LINEAR.values() for name, part in parts.items()}


@pytest.mark.thorough
@pytest.mark.parametrize(("parts", "system"), LINEAR.values(), ids=LINEAR)
def test_each_part_has_its_transfer_function(parts, system):
    s = 2j * np.pi * np.array([0.1, 40.0, 247.0, 900.0, 3000.0])
    np.testing.assert_allclose(as_control(FastToolServo(**parts).linear())(s), system(s), rtol=1e-9)


# The system is built block by block, since a transfer function of order 7 has lost half its digits.
TOGETHER = control.ss(LAG) * (control.ss(G) + control.ss(MODE) + control.ss(CREEP))


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("parts", "system"), [({}, control.ss(G)), (ALL, TOGETHER)], ids=["identified", "all_parts"]
)
def test_response_is_the_zero_order_hold_of_the_transfer_function(parts, system):
    """The responses of parts add up, and the lag of the amplifier acts on each."""
    discrete = control.sample_system(system, DT, method="zoh")
    y = control.forced_response(discrete, TIME, np.append(U, 0.0)).outputs
    assert_close(outputs(FastToolServo(**parts), U), y, 1e-12)


@pytest.mark.thorough
def test_a_load_of_one_newton_moves_the_tool_by_one_micrometre():
    """It is the step -F/k (1 - e^(-zeta w t) (cos + zeta/sqrt(1 - zeta^2) sin))."""
    w, zeta = np.sqrt(2.413e6), 70.16 / (2 * np.sqrt(2.413e6))
    root = np.sqrt(1 - zeta**2)
    step = 1 - np.exp(-zeta * w * TIME) * (
        np.cos(root * w * TIME) + zeta / root * np.sin(root * w * TIME)
    )
    assert_close(outputs(FastToolServo(load=1.0), np.zeros(N)), -step, 1e-12)
    assert_close(outputs(FastToolServo(load=-0.5, damping=1e-3), np.zeros(3 * N))[-1], 0.5, 1e-12)


@pytest.mark.thorough
def test_drift_adds_a_ramp():
    y, still = outputs(FastToolServo(drift=300.0), U), outputs(FastToolServo(), U)
    assert_close(y - still, 300.0 * TIME, 1e-11)


@pytest.mark.thorough
def test_periodic_force_is_the_sum_of_its_sines():
    """The forced motion, and the free one that makes position and speed zero at the start."""
    a, f, phase = np.array([[1.0, 0.5, 0.2], [40.0, 120.0, 700.0], [0.3, -1.0, 2.0]])
    s = 2j * np.pi * f
    # From N to um/s^2 the factor is 1e6 / m, with m = 1 / 2.413.
    forced = -a * np.exp(1j * phase) / (0.41442 * 1e-6) / (s**2 + 70.16 * s + 2.413e6)
    forced *= 0.41442 * 2.413
    poles = np.roots([1.0, 70.16, 2.413e6])
    free = np.linalg.solve(
        [[1.0, 1.0], poles], -np.array([np.sum(forced.imag), np.sum((s * forced).imag)])
    )
    y = np.imag(np.exp(np.outer(TIME, s)) @ forced) + np.real(np.exp(np.outer(TIME, poles)) @ free)
    assert_close(outputs(FastToolServo(periodic=PeriodicForce(a, f, phase)), np.zeros(N)), y, 1e-11)


@pytest.mark.thorough
def test_creep_spaced_by_decades_is_logarithmic():
    """y / y(t_0) = 1 + c log10(t / t_0): each decade of time adds the share c, within 1 %, between
    the fastest and the slowest operator.
    """
    tau = 10.0 ** np.arange(-3, 5)
    y = outputs(FastToolServo(creep=Creep(np.full(8, 0.02), tau)).linear(), np.ones(1000), 0.1)
    # From 1 s to 10 s to 100 s the servo is nearly at rest.
    growth = np.diff(np.asarray(y)[[10, 100, 1000]]) / GAIN
    np.testing.assert_allclose(growth, 0.02, rtol=0.01)


def test_an_absent_part_costs_nothing():
    plant, full = (
        jax.eval_shape(lambda form=form: fast_tool_servo(form).sampled(DT))
        for form in ("identified", "full")
    )
    assert isinstance(plant, StateSpace)
    assert plant.A.shape == (2, 2)
    assert plant.x0 is None
    assert full.plant.A.shape == (6, 6)


# The nonlinear servo
# --------------------------------------------------------------------------------------------------

PARTS = {
    "amplifier_bandwidth": 2000.0,
    "load": 0.3,
    "drift": 20.0,
    "mode": FlexibleMode(900.0, 0.03, 0.1),
    "creep": Creep((0.1,), (2e-3,)),
    "periodic": PeriodicForce((0.4,), (130.0,), (0.7,)),
}
HYSTERESIS = BoucWen(0.3, 1.1, 0.4)
FRICTION = Dahl(0.4, 1.5, exponent=1.5)
CUT = CuttingForce(0.3, -1.0, blur=4.0)


def path_of(h, x):
    """Return z along straight lines from 0 to x[0], x[1] and so on, by solve_ivp."""
    n, slope = (float(1.0 if v is None else v) for v in (h.exponent, h.initial_slope))

    def bouc_wen(t, z, way):
        drag = h.beta * abs(way) * z * abs(z) ** (n - 1) + h.gamma * way * abs(z) ** n
        return slope * way - drag

    def dahl(t, z, way):
        left = 1 - np.sign(way) * z / h.limit
        return slope * abs(left) ** n * np.sign(left) * way

    h = jax.tree.map(float, h)
    rate, z, passed = bouc_wen if isinstance(h, BoucWen) else dahl, 0.0, []
    for way in np.diff(x, prepend=0.0):
        z = solve_ivp(rate, (0.0, 1.0), [z], args=(way,), **TOLERANCES).y[0, -1]
        passed.append(z)
    return np.array(passed)


def numbers(part, names, absent):
    """Return the named fields of a part as numbers; of an array, the first element."""
    return (
        absent
        if part is None
        else [float(np.ravel(getattr(part, name))[0]) for name in names.split()]
    )


def integrated(p, u, dt=DT):
    """Return the output (N+1,) of a nonlinear servo, its equations written again, by solve_ivp."""
    m, k_c, k_f, T, k_b = numbers(p, "mass damping stiffness conversion amplifier_gain", None)
    load, drift = (0.0 if x is None else float(x) for x in (p.load, p.drift))
    v = u if p.hysteresis is None else u - path_of(p.hysteresis, u)
    tau = None if p.amplifier_bandwidth is None else 1 / (2 * np.pi * float(p.amplifier_bandwidth))
    f_mode, zeta, share = numbers(p.mode, "frequency damping share", (1.0, 0.0, 0.0))
    creep, tau_c = numbers(p.creep, "shares time_constants", (0.0, 1.0))
    a, f, phase = numbers(p.periodic, "amplitudes frequencies phases", (0.0, 0.0, 0.0))
    sigma, F_c, i = numbers(p.friction, "initial_slope limit exponent", (0.0, 1.0, 1.0))
    K, depth, blur = numbers(p.cutting, "stiffness depth blur", (0.0, 0.0, 1.0))
    w, static = 2 * np.pi * f_mode, T * k_b / k_f

    def output(t, x):
        return x[0] + x[4] + x[6] + drift * t

    def rates(t, x, held):
        y, speed, F, lagged, q, rate, crept = x
        volt = held if tau is None else lagged
        engaged = depth + output(t, x)
        cut = K * (engaged + np.sqrt(engaged**2 + blur**2)) / 2
        push = a * np.sin(2 * np.pi * f * t + phase)
        left = 1 - F / F_c * np.sign(speed)
        return [
            speed,
            1e6 / m * (T * k_b * volt - k_c * speed - k_f * y - F - cut - load - push),
            sigma * abs(left) ** i * np.sign(left) * speed,
            0.0 if tau is None else (held - lagged) / tau,
            rate,
            w**2 * (share * static * volt - q) - 2 * zeta * w * rate,
            (creep * static * volt - crept) / tau_c,
        ]

    x, y = np.zeros(7), [0.0]
    for k, held in enumerate(v):
        x = solve_ivp(rates, (k * dt, (k + 1) * dt), x, args=(held,), **TOLERANCES).y[:, -1]
        y.append(output((k + 1) * dt, x))
    return np.array(y)


def slope_of_error(servo, u, substeps):
    """Return the slope of the log error to solve_ivp over the log step, and the smallest error."""
    exact = integrated(servo, u)
    errors = [
        np.max(np.abs(outputs(dataclasses.replace(servo, substeps=s), u) - exact)) for s in substeps
    ]
    return np.polyfit(-np.log(substeps), np.log(errors), 1)[0], errors[-1]


@pytest.mark.thorough
def test_friction_costs_order_where_the_motion_turns():
    slope, smallest = slope_of_error(FastToolServo(friction=FRICTION), U[:40], (2, 8, 32))
    assert 1.7 < slope < 3.0
    assert smallest < 1e-6


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("parts", "relative"),
    [
        ({"hysteresis": HYSTERESIS}, 1e-10),
        ({"hysteresis": HYSTERESIS, "cutting": CUT, "substeps": 4}, 1e-8),
        ({"hysteresis": HYSTERESIS, "cutting": CUT, "friction": FRICTION, "substeps": 16}, 1e-6),
    ],
    ids=["hysteresis", "cutting", "friction"],
)
def test_full_servo_moves_as_by_solve_ivp(parts, relative):
    servo = FastToolServo(**PARTS, **parts)
    u = 2.0 * np.sin(2 * np.pi * 200.0 * TIME[:60]) + 0.2 * U[:60]
    y = integrated(servo, u)
    assert_close(outputs(servo, u), y, relative)
    # each part changes the output by far more than that
    for name in parts.keys() - {"substeps"}:
        assert np.max(
            np.abs(integrated(dataclasses.replace(servo, **{name: None}), u) - y)
        ) > 1e-2 * np.max(np.abs(y))


@pytest.mark.thorough
def test_default_step_is_enough_for_the_task():
    """At 40 Hz (section 5) one step a sample errs by less than the 1 nm of the encoder."""
    servo = FastToolServo(damping=3e-4, friction=Dahl(0.2, 0.5, exponent=1.0))
    u = 2.0 * np.sin(2 * np.pi * 40.0 * np.arange(160) * DT)
    exact = integrated(servo, u)
    assert np.max(np.abs(exact)) > 15
    np.testing.assert_allclose(outputs(servo, u), exact, rtol=0, atol=1e-3)


def gain_at_40_hz(servo, amplitude):
    """Return the ratio of the fundamentals of y and u in the second half of the trial."""
    u = amplitude * np.sin(2 * np.pi * 40.0 * np.arange(3000) * DT)
    wave = np.exp(-2j * np.pi * 40.0 * np.arange(1500) * DT)
    return (np.asarray(outputs(servo, u))[1500:3000] @ wave) / (u[1500:] @ wave)


@pytest.mark.thorough
def test_full_form_answers_small_strokes_like_the_identified_one():
    """Section 5.2 identified G with 10 mV; at 20 um the gain and the lag are larger."""
    small, large = (gain_at_40_hz(fast_tool_servo("full"), amplitude) for amplitude in (0.01, 2.16))
    expected = complex(G(80j * np.pi))
    assert abs(small / expected - 1) < 0.03  # creep adds the most, 1.5 % per decade
    assert 1.05 < abs(large / small) < 1.25
    assert np.angle(large / expected) < np.angle(small / expected) - 0.02


def test_full_form_has_the_loop_and_the_mode_that_it_states():
    """The loop is 8 % of the stroke wide at 20 um, and the mode adds 40 % at 900 Hz."""
    servo = fast_tool_servo("full")
    u = loop(40, amplitude=1.93)
    v = u - np.asarray(along(servo.hysteresis, u))
    assert float(servo.coefficients.b / servo.coefficients.a1) * np.max(v) == pytest.approx(
        20.0, rel=0.01
    )
    assert (v[99] - v[119]) / np.ptp(v) == pytest.approx(0.08, abs=0.005)
    at_900 = abs(as_control(servo.linear())(1800j * np.pi)) * (
        1 - float(servo.hysteresis.initial_slope)
    )
    assert at_900 / abs(G(1800j * np.pi)) == pytest.approx(1.4, abs=0.05)


# Hysteresis
# --------------------------------------------------------------------------------------------------

BOUC_WEN = {
    "bouc_wen": BoucWen(0.3, 1.1, 0.4),
    "bent": BoucWen(0.3, 1.1, -0.8),
    "no_decay_below": BoucWen(0.3, 0.7, 0.7),
    "smooth": BoucWen(0.5, 0.4, 0.1, exponent=2.0, substeps=40),
    "fractional": BoucWen(0.4, 0.9, -0.2, exponent=1.3, substeps=40),
}
DAHL = {
    "dahl": Dahl(2.0, 0.7),
    "ductile": Dahl(2.0, 0.7, exponent=2.5),
    "nearly_linear": Dahl(2.0, 0.7, exponent=1.0 + 1e-7),
}


@jax.jit
def along(h, x):
    """Return z (M,) along straight lines from 0 to x[0], x[1] and so on."""
    return lax.scan(
        lambda z, dx: ((z := h.over(z, dx)), z),
        jnp.zeros(()),
        jnp.diff(jnp.asarray(x), prepend=0.0),
    )[1]


def loop(samples, turns=3, amplitude=1.5):
    """Return a sinusoid of some turns; x = 0 is at the samples 0 and `samples`/2 of a turn."""
    return amplitude * np.sin(2 * np.pi * np.arange(1, turns * samples + 1) / samples)


@pytest.mark.parametrize("h", [*BOUC_WEN.values(), *DAHL.values()], ids=[*BOUC_WEN, *DAHL])
def test_hysteresis_is_that_of_solve_ivp_for_any_jumps(h):
    x = 1.5 * np.random.default_rng(2).normal(size=25)
    exact = path_of(h, x)
    by_steps = isinstance(h, BoucWen) and h.exponent is not None
    np.testing.assert_allclose(along(h, x), exact, rtol=0, atol=1e-5 if by_steps else 1e-10)
    assert np.ptp(exact) > 1.3 * h.limit  # the path passed branches below and above zero


@pytest.mark.thorough
@pytest.mark.parametrize(("n", "error"), [(1.0, 0.02), (2.5, 0.04), (8.0, 0.12)])
@pytest.mark.parametrize("gamma", [0.7, -0.6])
def test_few_substeps_go_along_travels_of_any_length(n, error, gamma):
    """From one bound to the other, against solve_ivp; gamma makes the way into a stiff one."""
    h = BoucWen(0.5, 0.7, gamma, exponent=n)
    limit = float(h.limit)
    x = np.geomspace(0.02, 40.0, 30) * limit / 0.5
    found = jax.jit(jax.vmap(h.over, (None, 0)))(-limit, np.append(x, 1e6 * limit)) / limit

    def slope(_, z):
        return 0.5 - 0.7 * z * abs(z) ** (n - 1) - gamma * abs(z) ** n

    exact = solve_ivp(slope, (0, x[-1]), [-limit], t_eval=x, method="LSODA", rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(found[:-1], exact.y[0] / limit, rtol=0, atol=error)
    np.testing.assert_allclose(found[-1], 1.0, rtol=1e-12)


@pytest.mark.parametrize(
    "h", [*BOUC_WEN.values(), BoucWen(0.5, 0.4, 0.1, exponent=3.0), *DAHL.values()]
)
def test_hysteresis_stays_within_its_bound(h):
    """Huge jumps end at |z| = (A / (beta + gamma))^(1/n), and none beyond."""
    x = np.random.default_rng(3).normal(size=200) * 10.0 ** np.random.default_rng(4).uniform(
        -2, 3, 200
    )
    limit = float(h.limit)
    if isinstance(h, BoucWen):
        n = 1.0 if h.exponent is None else float(h.exponent)
        assert limit == pytest.approx((float(h.initial_slope) / float(h.beta + h.gamma)) ** (1 / n))
    z = np.abs(along(h, x))
    assert 0.98 * limit < np.max(z) <= limit * (1 + 1e-12)


@pytest.mark.thorough
@pytest.mark.parametrize(
    "h",
    [
        BoucWen(0.3, 1.1, 0.4),
        BoucWen(0.3, 1.1, 0.4, exponent=1.5),
        Dahl(0.3, 0.7),
        Dahl(0.3, 0.7, exponent=1.5),
    ],
)
def test_gradients_are_finite_everywhere(h):
    """At rest, at zero, at the bound and beyond; at rest it is the slope of a travel upward."""
    levels = float(h.limit) * np.array([0.0, -1.01, -1.0, -0.5, 0.5, 1.0, 1.01])
    z, dx = (a.ravel() for a in np.meshgrid(levels, [0.0, -0.1, 0.1]))

    @jax.jit
    @partial(jax.vmap, in_axes=(None, 0, 0))
    def gradients(h, z, dx):
        return jax.grad(lambda h, z, dx: h.over(z, dx), (0, 1, 2))(h, z, dx), jax.grad(
            lambda h, z: h.slope(z, 1.0), (0, 1)
        )(h, z)

    of_over, of_slope = gradients(h, z, dx)
    for gradient in jax.tree.leaves((of_over, of_slope)):
        assert np.all(np.isfinite(gradient))
    assert of_over[2][0] == pytest.approx(0.3, rel=1e-12)
    np.testing.assert_allclose(of_over[1][dx == 0], 1.0, rtol=1e-12)
    upward = h.slope(levels[:-1], 1.0)  # beyond the limit a travel leads back to it
    np.testing.assert_allclose(of_over[2][dx == 0][:-1], upward, rtol=1e-12)


@pytest.mark.thorough
def test_gradient_of_a_servo_at_rest():
    """All speeds and increments are exactly zero, and so is the slope by every parameter."""
    servo = FastToolServo(
        friction=FRICTION,
        cutting=CuttingForce(0.0, 0.0),
        hysteresis=BoucWen(0.3, 1.1, 0.4, exponent=1.5, substeps=1),
    )
    by_servo, by_u = jax.jit(jax.grad(lambda servo, u: outputs(servo, u)[-1], argnums=(0, 1)))(
        servo, np.zeros(20)
    )
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(by_servo))
    assert by_servo.mass == 0.0
    # For small strokes the servo acts through the initial slopes: 1 - A at the input, and friction
    # as a spring of 0.4 N/um.
    spring = control.tf([2.229e7 * 0.7], [1.0, 70.16, 2.413e6 * 1.4])
    _, impulse = control.impulse_response(
        control.sample_system(spring, DT, method="zoh"), np.arange(21) * DT
    )
    np.testing.assert_allclose(by_u, DT * impulse[:0:-1], rtol=1e-6, atol=1e-9)


def test_hysteresis_at_the_inputs_of_any_plant():
    """Of two inputs each has its own z, as for two plants of one input whose outputs are added."""
    mixed = StateSpace([[0.5]], [[1.0, 2.0]], [[1.0]], dt=DT)
    u = np.stack([loop(40)[:60], np.cos(loop(40)[:60])], axis=1)
    plant = InputHysteresis(mixed, HYSTERESIS)
    assert (plant.n_u, plant.n_y) == (2, 1)
    x, y = plant.sampled(DT).initial_state(), []
    step = jax.jit(plant.step, static_argnums=2)
    for held in u:
        x = step(x, held, DT)
        y.append(float(plant.output(x)[0]))
    driven = u - np.stack([path_of(HYSTERESIS, u[:, i]) for i in (0, 1)], axis=1)
    expected = np.zeros(61)
    for k in range(60):
        expected[k + 1] = 0.5 * expected[k] + driven[k] @ [1.0, 2.0]
    np.testing.assert_allclose(y, expected[1:], rtol=1e-9)


# Errors
# --------------------------------------------------------------------------------------------------


def test_too_long_a_sample_time_is_refused_before_anything_runs():
    task = Task(np.zeros(9), dt=5e-4, unit="um", input_unit="V")
    with pytest.raises(
        ValueError,
        match=r"FastToolServo: dt = 0.0005 s is outside its allowed range \(0, 0.0002\], "
        "see longest_dt",
    ):
        learn(Machine(fast_tool_servo()), PIDType(gamma_p=0.1), task, 2)
    jax.eval_shape(lambda: FastToolServo(longest_dt=5e-4).sampled(task.dt))
    with pytest.raises(
        ValueError,
        match=r"ForcedServo is sampled at 0.0001 s but the task at 0.0002 s; "
        r"allowed is dt = 0.0001",
    ):
        jax.eval_shape(lambda: FastToolServo(cutting=CUT).sampled(DT).sampled(2e-4))


FASTEST = [
    ({"longest_dt": 1e-3}, 4.04, r"247.2 Hz; its .* with these parameters is \(0, 0.000809\]"),
    ({"mode": FlexibleMode(1500.0, 0.1, 0.1)}, 3.33, "1500 Hz"),
    ({"periodic": PeriodicForce((1.0,), (2e3,), (0.0,))}, 2.5, "2000 Hz"),
    ({"friction": Dahl(24.0, 1.0)}, 4.04, "1236 Hz"),
    ({"cutting": CuttingForce(24.0, 1.0)}, 4.04, "1236 Hz"),
    ({"mass": np.array([0.4, 0.01])}, 3.14, "1592 Hz"),
]


def test_a_force_of_no_parts_is_none():
    plant, none = FastToolServo(periodic=PeriodicForce((), (), ())), FastToolServo()
    np.testing.assert_array_equal(plant.linear().A, none.linear().A)


@pytest.mark.parametrize(("parts", "samples", "said"), FASTEST)
def test_too_few_samples_a_period_of_the_fastest_mode_are_refused(parts, samples, said):
    said = rf"s leaves {samples} samples a period of the fastest mode, {said}"
    with pytest.raises(ValueError, match=f"FastToolServo: longest_dt = .* {said}"):
        FastToolServo(**parts)


REFUSED = {
    r"FastToolServo: hysteresis.initial_slope = 1.2 is outside .*\(0, 1\)": lambda: FastToolServo(
        hysteresis=BoucWen(1.2, 1.0)
    ),
    r"Creep: \{'shares': \(2,\), 'time_constants': \(1,\)\} must have one shape \(n,\)": lambda: (
        Creep((0.1, 0.2), (1.0,))
    ),
    r"Creep: .* must have one shape \(n,\)": lambda: Creep(0.1, 1.0),
    r"PeriodicForce: .*'phases': \(0,\).* must have one shape \(n,\)": lambda: PeriodicForce(
        (1.0,), (40.0,), ()
    ),
    r"BoucWen: gamma = -1.0 is outside its allowed range \(-beta, beta\], beta = 1.0": lambda: (
        BoucWen(0.3, 1.0, -1.0)
    ),
    r"BoucWen: gamma = 1.1 is outside": lambda: BoucWen(0.3, 1.0, 1.1),
}
test_errors_name_the_parameter = refused(REFUSED)
