"""The ball-screw drive against python-control, formulas of two masses, scipy, and its energy."""

import dataclasses
from functools import partial

import control
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
from cases import ALGEBRA, DRIVE, DT, task_for

from jaxilc.learning import Machine, learn
from jaxilc.plants import BallScrewDrive, FrictionTable, LeadError, StribeckFriction
from jaxilc.plants.ball_screw import DriveState
from jaxilc.pytree import replaced
from jaxilc.schemes import PID, OnOutputs
from jaxilc.signals import Task

N = 100
LINEAR = BallScrewDrive(**DRIVE)
LAGGING = BallScrewDrive(**DRIVE, current_bandwidth=80.0)
COMMAND = 4.0 * np.sin(2 * np.pi * 9.0 * DT * np.arange(N)) ** 3 + 0.5  # [V]
S = 1j * np.linspace(3.0, 900.0, 23) - 4.0  # away from the poles
GREASE = StribeckFriction(
    coulomb_force=4.0,
    static_force=6.0,
    transition_velocity=0.02,
    stribeck_velocity=0.05,
    viscous=1.0,
)


@partial(jax.jit, static_argnames="dt")
def simulate(drive, u, dt=DT, start=None):
    """Return positions (N+1, 2) [mm] and stacked states of a drive for the commands u (N,) [V]."""
    drive = drive.sampled(dt)

    def tick(x, u):
        x = drive.step(x, u[None], dt)
        return x, x

    start = drive.initial_state() if start is None else start
    after = jax.lax.scan(tick, start, jnp.asarray(u))[1]
    states = jax.tree.map(
        lambda first, rest: jnp.concatenate([jnp.asarray(first)[None], rest]), start, after
    )
    return jax.vmap(drive.output)(states), states


linear = jax.jit(lambda drive: drive.linear(DT))
sampled = jax.jit(lambda drive: drive.sampled(DT))


def system(plant, D=0.0):
    return control.ss(*(np.asarray(M) for M in (plant.A, plant.B, plant.C)), D, plant.dt)


def assert_close(found, expected, rtol):
    np.testing.assert_allclose(found, expected, rtol=0, atol=rtol * np.max(np.abs(expected)))


# Linear
# --------------------------------------------------------------------------------------------------


def test_resonance_and_antiresonance_are_poles_and_zeros_of_the_undamped_mechanics():
    free = BallScrewDrive(
        motor_mass=3.0, table_mass=1.3, stiffness=5e4, damping=0.0, force_gain=1.0
    )
    plant = system(free.mechanics())
    poles, zeros = (
        roots[np.argsort(roots.imag)] for roots in (plant.poles(), control.zeros(plant[0, 0]))
    )
    np.testing.assert_allclose(
        poles[[0, -1]], 2j * np.pi * float(free.resonance) * np.array([-1, 1]), atol=1e-5
    )
    # A double pole is found to half of the digits only.
    np.testing.assert_allclose(np.abs(poles[1:3]), 0.0, atol=1e-4)
    np.testing.assert_allclose(
        zeros, 2j * np.pi * float(free.antiresonance) * np.array([-1, 1]), atol=1e-5
    )
    assert free.resonance > 1.1 * free.antiresonance


@pytest.mark.parametrize("drive", [LINEAR, LAGGING])
def test_transfer_functions_are_those_of_the_paper(drive):
    m_M, m_T, k, c, c_M, c_T = (
        DRIVE[n]
        for n in (
            "motor_mass",
            "table_mass",
            "stiffness",
            "damping",
            "motor_damping",
            "table_damping",
        )
    )
    q = [
        m_M * m_T,
        (m_T + m_M) * c + m_M * c_T + m_T * c_M,
        (m_T + m_M) * k + c_M * c_T + (c_M + c_T) * c,
        (c_M + c_T) * k,
        0.0,
    ]
    lag = 1.0 if drive is LINEAR else 1 / (1 + S / (2 * np.pi * 80.0))
    motor, table = np.asarray(system(drive.mechanics())(S))[:, 0]
    np.testing.assert_allclose(
        motor, lag * np.polyval([m_T, c + c_T, k], S) / np.polyval(q, S), rtol=1e-9
    )
    above, below = drive.transmission()
    np.testing.assert_allclose(
        table / motor, np.polyval(above, S) / np.polyval(below, S), rtol=1e-9
    )


@pytest.mark.thorough
@pytest.mark.parametrize("drive", [LINEAR, LAGGING])
def test_the_three_loop_drive_is_that_of_python_control(drive):
    """The mechanics are sampled with a zero-order hold, the PI controller integrates backward, and
    the speed is a backward difference of the motor position.
    """
    P = 1e3 * control.sample_system(system(drive.mechanics()), DT, "zoh")
    difference = control.ss(0.0, 1.0, -1 / DT, 1 / DT, DT)
    K_p, K_i = float(drive.speed_gain), float(drive.speed_integral_gain) * DT
    # The controller is K_p + K_i z / (z - 1).
    controller = DRIVE["force_gain"] * control.ss(1.0, 1.0, K_i, K_p + K_i, DT)
    force = control.feedback(controller, difference * P[0, 0])
    time = DT * np.arange(N + 1)
    expected = control.forced_response(
        P * force * DRIVE["command_scale"], time, np.append(COMMAND, 0.0)
    ).outputs.T
    assert_close(simulate(drive, COMMAND)[0], expected, 1e-9)
    model = linear(drive)
    assert_close(
        control.forced_response(system(model), time, np.append(COMMAND, 0.0)).outputs.T,
        expected,
        1e-9,
    )
    assert np.ptp(expected[:, 0] - expected[:, 1]) > 0.01 * np.ptp(expected[:, 1]), (
        "the table should not follow the motor rigidly"
    )


@pytest.mark.thorough
def test_the_model_is_differentiable_in_every_parameter():
    """Along one direction that changes them all, each by a share of its own."""
    rng = np.random.default_rng(6)
    way = jax.tree.map(lambda x: x * rng.uniform(0.5, 1.5), LAGGING)
    slope = jax.jit(lambda drive: jax.jvp(linear, (drive,), (way,))[1])(LAGGING)
    above, below = (
        linear(jax.tree.map(lambda x, d, h=h: x + h * d, LAGGING, way)) for h in (1e-5, -1e-5)
    )
    for name in "ABC":
        difference = (getattr(above, name) - getattr(below, name)) / 2e-5
        np.testing.assert_allclose(getattr(slope, name), difference, rtol=1e-6, atol=1e-9)


# Friction, lead error, limits
# --------------------------------------------------------------------------------------------------

REAL = dataclasses.replace(
    LAGGING,
    motor_friction=GREASE,
    table_friction=dataclasses.replace(GREASE, coulomb_force=1.5, static_force=1.5),
    lead_error=LeadError(amplitude=1e-4, period=2e-3, phase=0.4),
    compensation=FrictionTable([-0.05, -0.01, 0.01, 0.06], [-5.0, -4.0, 4.0, 6.0]),
    force_limit=14.0,
)


def friction(part, v):
    """Return the Stribeck curve by NumPy."""
    level = part.coulomb_force + (part.static_force - part.coulomb_force) * np.exp(
        -((v / part.stribeck_velocity) ** 2)
    )
    return level * np.tanh(v / part.transition_velocity) + part.viscous * v


def sampled_loop(drive, u, dt=DT):
    """Return (N+1, 2) positions [mm], of a speed loop in NumPy around a drive that scipy solves."""
    drive = jax.tree.map(
        lambda leaf: float(leaf) if np.ndim(leaf) == 0 else np.asarray(leaf), drive
    )
    p = {f.name: getattr(drive, f.name) for f in dataclasses.fields(drive)}
    lead, table = p["lead_error"], p["compensation"]

    def rates(t, x, commanded):
        x_M, v_M, x_T, v_T, force = x
        angle = 2 * np.pi * x_M / lead.period + lead.phase
        s = x_M + lead.amplitude * np.sin(angle) - x_T
        slope = lead.amplitude * 2 * np.pi / lead.period * np.cos(angle)
        spring = p["stiffness"] * s + p["damping"] * ((1 + slope) * v_M - v_T)
        on_motor = (
            force
            - spring * (1 + slope)
            - p["motor_damping"] * v_M
            - friction(p["motor_friction"], v_M)
        )
        on_table = spring - p["table_damping"] * v_T - friction(p["table_friction"], v_T)
        lag = 2 * np.pi * p["current_bandwidth"] * (commanded - force)
        return v_M, on_motor / p["motor_mass"], v_T, on_table / p["table_mass"], lag

    x, integral, before, rows, clipped = np.zeros(5), 0.0, 0.0, [[0.0, 0.0]], 0
    for command in p["command_scale"] * u:
        deviation = command - (1e3 * x[0] - before) / dt
        ahead = integral + p["speed_integral_gain"] * dt * deviation
        force = p["force_gain"] * (p["speed_gain"] * deviation + ahead) + np.interp(
            1e-3 * command, table.velocity, table.force
        )
        if not (abs(force) > p["force_limit"] and force * deviation > 0):
            integral = ahead
        clipped += abs(force) > p["force_limit"]
        before = 1e3 * x[0]
        force = np.clip(force, -p["force_limit"], p["force_limit"])
        x = scipy.integrate.solve_ivp(
            rates, (0.0, dt), x, "DOP853", rtol=1e-9, atol=1e-13, args=(force,)
        ).y[:, -1]
        rows.append([1e3 * x[0], 1e3 * x[2]])
    return np.array(rows), clipped


@pytest.mark.thorough
def test_the_real_drive_is_its_differential_equation_under_a_sampled_speed_loop():
    expected, clipped = sampled_loop(REAL, COMMAND)
    found = np.asarray(simulate(REAL, COMMAND)[0])
    assert_close(found, expected, 2e-5)
    assert 5 < clipped < N / 2, "the limit should act, though not always"
    forces = ("coulomb_force", "static_force", "viscous")
    absent = [{f"{part}_friction.{name}": 0.0 for name in forces} for part in ("motor", "table")]
    absent += [
        {"lead_error.amplitude": 0.0},
        {"compensation.force": np.zeros(4)},
        {"force_limit": 1e9},
        {"current_bandwidth": 1e5},
    ]
    for changes in absent:
        other = np.asarray(simulate(replaced(REAL, changes), COMMAND)[0])
        assert np.max(np.abs(other - found)) > 5e-3 * np.max(np.abs(expected)), (
            f"{changes} should matter"
        )


def test_a_stiff_drive_with_a_lead_error_takes_several_steps_a_sample():
    """A resonance of 390 Hz at 1 ms: with one step the lead error made the positions wrong."""
    stiff = dataclasses.replace(REAL, stiffness=4e6, lead_error=LeadError(5e-6, 1e-2, phase=0.3))
    fine, u = dataclasses.replace(stiff, substeps=3), COMMAND[:40]
    expected = sampled_loop(stiff, u)[0]
    assert_close(np.asarray(simulate(fine, u)[0]), expected, 1e-5)
    error = np.max(np.abs(np.asarray(simulate(stiff, u)[0]) - expected))
    assert error > 1e-4 * np.max(np.abs(expected))
    task = Task(np.zeros((41, 2)), DT)
    jax.jit(lambda x: (fine.check(task), x)[1]).eval_shape(1.0)  # though JAX traces
    with pytest.raises(ValueError, match=r"substeps = 1 of dt = 0.001 s .* 389.8 Hz, .* 3 or more"):
        stiff.check(task)


def energy(drive, x):
    """Return the kinetic energy [J] of states (..., 4), and that of the spring."""
    x_M, v_M, x_T, v_T = np.moveaxis(np.asarray(x), -1, 0)
    stretch = (
        x_M
        + drive.lead_error.amplitude
        * np.sin(2 * np.pi * x_M / drive.lead_error.period + drive.lead_error.phase)
        - x_T
    )
    return (
        drive.motor_mass * v_M**2 + drive.table_mass * v_T**2
    ) / 2, drive.stiffness * stretch**2 / 2


@pytest.mark.thorough
@pytest.mark.parametrize("damping", [0.0, 30.0])
def test_the_lead_error_does_no_work(damping):
    """While it coasts, lost motion is in the spring, or in its damper, which returns none."""
    coasting = BallScrewDrive(
        motor_mass=2.0, table_mass=1.0, stiffness=4e4, damping=damping, force_gain=1.0,
        speed_gain=0.0, speed_integral_gain=0.0,
        lead_error=LeadError(amplitude=3e-4, period=2e-3),
    )  # fmt: skip
    start = DriveState(np.array([0.0, 0.1, 2e-4, 0.1]), np.zeros(()), np.zeros(()))
    _, states = simulate(coasting, np.zeros(2000), 1e-4, start)
    kinetic, potential = energy(coasting, states.mechanics)
    total = kinetic + potential
    assert np.ptp(kinetic) > 0.1 * total[0]
    if damping:
        assert np.all(np.diff(total) < 1e-9 * total[0])
        assert total[-1] < 0.9 * total[0]
    else:
        np.testing.assert_allclose(total, total[0], rtol=1e-6)


@pytest.mark.thorough
def test_at_the_force_limit_the_drive_falls_freely_and_its_integral_stops():
    """The centre of mass of an undamped drive moves as F t^2 / 2 m.

    The force changes its sign in the sample in which the error does.
    """
    drive = dataclasses.replace(LINEAR, motor_damping=0.0, table_damping=0.0, force_limit=30.0)
    y, states = simulate(drive, np.concatenate([np.full(60, 80.0), np.full(60, 50.0)]))
    centre, integral, t = (
        np.asarray(y) @ [2 / 3, 1 / 3],
        np.asarray(states.integral),
        DT * np.arange(61),
    )
    np.testing.assert_allclose(centre[:61], 1e3 * 30.0 / 3.0 * t**2 / 2, rtol=1e-9, atol=1e-12)
    np.testing.assert_array_equal(integral[:62], 0.0)
    np.testing.assert_allclose(np.diff(centre, 2)[60] / DT**2, -1e3 * 30.0 / 3.0, rtol=1e-6)
    assert integral[-1] != 0.0
    # If it had integrated the 60 samples of at least 200 mm/s, the integral alone would command
    # more than the limit.
    assert (
        np.max(np.abs(integral)) * DRIVE["force_gain"]
        < 0.5 * 30.0
        < 8.18 * 60 * DT * 200 * DRIVE["force_gain"]
    )


@pytest.mark.thorough
def test_the_encoder_is_rounded_and_its_gradient_is_not():
    step = 0.02
    coarse = dataclasses.replace(LINEAR, encoder_step=step)
    y, states = simulate(coarse, COMMAND)
    measured, y = np.asarray(states.measured), np.asarray(y)
    np.testing.assert_allclose(measured[1:], step * np.round(y[:-1, 0] / step), atol=1e-12)
    assert np.max(np.abs(y - simulate(LINEAR, COMMAND)[0])) > 0.1 * step, "it should matter"
    plants = [sampled(drive) for drive in (coarse, LINEAR)]
    np.testing.assert_array_equal(linear(plants[0]).A, linear(LINEAR).A)
    x = plants[0].initial_state()._replace(mechanics=np.array([3e-5, 0.01, 2e-5, 0.01]))
    slopes = [
        jax.jit(jax.jacfwd(lambda x, plant=plant: plant.step(x, jnp.ones(1), DT)))(x)
        for plant in plants
    ]
    jax.tree.map(partial(np.testing.assert_allclose, **ALGEBRA), *slopes)


def test_a_friction_table_holds_its_ends_and_is_linear_between_its_points():
    velocity = np.linspace(-0.1, 0.1, 6)
    table = FrictionTable.of(GREASE, velocity)
    np.testing.assert_allclose(table.force, friction(GREASE, velocity), rtol=1e-12)
    np.testing.assert_allclose(table.at(0.0), (table.force[2] + table.force[3]) / 2, atol=1e-12)
    np.testing.assert_allclose(
        table.at(0.07), 0.75 * table.force[4] + 0.25 * table.force[5], rtol=1e-12
    )
    np.testing.assert_allclose([table.at(-3.0), table.at(3.0)], table.force[[0, -1]])


@pytest.mark.thorough
def test_at_constant_speed_the_integral_carries_what_the_table_does_not():
    """The balance of forces is g q + F_table(v) = F_friction,M(v) + F_friction,T(v) + (c_M + c_T)
    v.
    """
    v = 0.02
    drive = dataclasses.replace(
        LAGGING,
        motor_friction=GREASE,
        table_friction=GREASE,
        compensation=FrictionTable([-0.1, 0.1], [-9.0, 9.0]),
    )
    _, states = simulate(drive, np.full(2500, 1e3 * v / DRIVE["command_scale"]))
    damping = DRIVE["motor_damping"] + DRIVE["table_damping"]
    expected = (2 * friction(GREASE, v) + damping * v - 90.0 * v) / DRIVE["force_gain"]
    np.testing.assert_allclose(states.integral[-1], expected, rtol=1e-6)
    # The tolerance is 1e-6 only. An explicit step holds the friction at its stages, so a constant
    # force is met by a slightly different stretch of the spring.
    np.testing.assert_allclose(states.mechanics[-1, [1, 3]], v, rtol=1e-5)


# Errors
# --------------------------------------------------------------------------------------------------

STIFF = dataclasses.replace(GREASE, transition_velocity=1e-3)
BAD = [
    (lambda: FrictionTable([0.0, 1.0], [0.0, 1.0, 2.0]),
     r"FrictionTable: velocity \(2,\) and force \(3,\) must both"),
    (lambda: FrictionTable([0.0], [0.0]),
     r"FrictionTable: velocity \(1,\) and force \(1,\) must both"),
    (lambda: FrictionTable([0.0, 1.0, 1.0], [0.0, 1.0, 2.0]),
     r"FrictionTable: velocity = \[0. 1. 1.\] must increase"),
    # 6 N / 1 mm/s + 1 N s/m on 1 kg, compared with 2.6 / 1 ms
    (lambda: BallScrewDrive(**DRIVE, table_friction=STIFF),
     r"BallScrewDrive: table_friction damps at rest with 6001 1/s, .* longest_dt = 0.001 s "
     r".* lower longest_dt to 0.000433"),
    (lambda: BallScrewDrive(**DRIVE, motor_friction=STIFF),
     "BallScrewDrive: motor_friction damps at rest with 3000 1/s"),
    (lambda: REAL.sampled(2e-3),
     r"BallScrewDrive: dt = 0.002 s is outside its allowed range \(0, 0.001\]"),
    (lambda: LINEAR.sampled(1e-3).sampled(2e-3),
     "BallScrewDrive is sampled at 0.001 s but the task at 0.002 s"),
]  # fmt: skip


@pytest.mark.parametrize(("build", "message"), BAD)
def test_bad_parameters_are_named(build, message):
    with pytest.raises(ValueError, match=message):
        build()


def test_a_task_too_slow_for_the_friction_is_refused_before_anything_is_compiled():
    task = dataclasses.replace(task_for(REAL, 10), dt=2e-3)
    with pytest.raises(ValueError, match="longest_dt"):
        learn(Machine(REAL), OnOutputs(PID(kp=1.0), (0,)), task, 1)
    assert BallScrewDrive(**DRIVE, table_friction=STIFF, longest_dt=4e-4).sampled(4e-4).dt == 4e-4
