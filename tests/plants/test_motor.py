"""The physical motor against python-control, closed forms, printed data and the fitted model."""

import dataclasses
import re
from functools import partial

import control
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import ALGEBRA, DT
from jax import lax

from jaxilc.learning import Machine, learn
from jaxilc.plants import (
    Cogging,
    EndEffect,
    StateSpace,
    StribeckFriction,
    VoiceCoil,
    VoiceCoilMotor,
    voice_coil_motor,
)
from jaxilc.plants.motor import MotorState
from jaxilc.pytree import named_leaves, pytree, replaced
from jaxilc.schemes import CFDLMFAILC
from jaxilc.signals import Task

# Cao 2019, section II-A, in SI
CONTINUOUS_CURRENT, PEAK_CURRENT, ACCELERATION, SPEED = 8.66, 23.0, 431.0, 3.44
UNLIMITED = {"current_limit": None, "voltage_limit": None, "speed_limit": None}
N = 80
U = 2.0 * np.random.default_rng(5).choice([-1.0, 1.0], N)


def rest(motor, position=0.0, speed=0.0):
    return motor.initial_state()._replace(
        position=jnp.asarray(position, float), speed=jnp.asarray(speed, float)
    )


@partial(jax.jit, static_argnames="dt")
def states(motor, u, start, dt=DT) -> MotorState:
    """Return N+1 rows of states of any plant under the command u (N,), held over each sample."""
    _, passed = lax.scan(lambda x, u: (motor.step(x, u[None], dt), x), start, jnp.append(u, 0.0))
    return passed


@jax.jit
def linear_form(motor):
    return motor.linear().sampled(DT)


def positions(motor, u, dt=DT):
    """Return the positions (N+1,) [mm] of a motion from rest."""
    return np.asarray(jax.vmap(motor.output)(states(motor, u, rest(motor), dt)))[:, 0]


# The linear motor
# --------------------------------------------------------------------------------------------------


def wired(motor):
    """Return the motor as a block diagram of python-control, built as in Cao 2019, Fig. 1."""
    p = {name: float(value) for name, value in named_leaves(motor).items()}
    b, K_p, K_i = p["setpoint_weight"], p["speed_gain"], p["speed_integral_gain"]

    def block(num, den, of, to):
        return control.tf(num, den, inputs=of, outputs=to)

    T = p.get("command_delay", 0.0)
    blocks = [
        block([-T, 2.0], [T, 2.0], "u", "w") if T else block([1.0], [1.0], "u", "w"),
        block([p["command_scale"]], [1.0], "w", "scaled"),
        block([p["holding_gain"]], [1.0], "x", "hold"),
        control.summing_junction(["scaled", "-hold"], "v_ref"),
        block([b * K_p], [1.0], "v_ref", "forward"),
        block([K_p], [1.0], "v", "braking"),
        control.summing_junction(["v_ref", "-v"], "speed_error"),
        block([K_i], [1.0, 0.0], "speed_error", "q"),
        control.summing_junction(["forward", "-braking", "q"], "i_ref"),
        control.summing_junction(["i_ref", "-i"], "current_error"),
        block([p["current_gain"]], [1.0], "current_error", "U"),
        block([p["force_constant"]], [1.0], "v", "emf"),
        control.summing_junction(["U", "-emf"], "coil_voltage"),
        block([1.0], [p["inductance"], p["resistance"]], "coil_voltage", "i"),
        block([p["force_constant"]], [1.0], "i", "F"),
        block([p.get("stiffness", 0.0)], [1.0], "x", "spring"),
        control.summing_junction(["F", "-spring"], "net"),
        block([1.0], [p["mass"], p["viscous_damping"]], "net", "v"),
        block([1.0], [1.0, 0.0], "v", "x"),
        block([1e3], [1.0], "x", "y"),
    ]
    system = control.interconnect(blocks, inputs="u", outputs="y")
    return control.ss(system.A, system.B, system.C, system.D)


def as_control(plant):
    """Return a VoiceCoil, or a continuous StateSpace, as a system of python-control."""
    if isinstance(plant, VoiceCoil):
        return control.tf(
            [float(plant.gain), -float(plant.gain * plant.zero)], np.poly(-plant.poles)
        )
    return control.ss(np.asarray(plant.A), np.asarray(plant.B), np.asarray(plant.C), 0)


def at(system, hertz):
    return system(2j * np.pi * np.asarray(hertz))


MOTORS = {
    "identified": voice_coil_motor(),
    "printed": voice_coil_motor("printed"),
    "sprung": VoiceCoilMotor(
        stiffness=4e3, setpoint_weight=0.4, viscous_damping=30.0, command_delay=2e-3, mass=2.0
    ),
}


@pytest.mark.thorough(but=["sprung"])
@pytest.mark.parametrize("motor", MOTORS.values(), ids=MOTORS)
def test_response_is_that_of_python_control(motor):
    """For commands that reach no limit; the default step errs by 1e-5 of the largest output."""
    u = 0.1 * U
    discrete = control.sample_system(wired(motor), DT, method="zoh")
    y = control.forced_response(discrete, np.arange(N + 1) * DT, np.append(u, u[-1])).outputs
    assert np.max(np.abs(y)) > 0.03
    np.testing.assert_allclose(positions(motor, u), y, rtol=0, atol=1e-5 * np.max(np.abs(y)))

    linear = linear_form(motor)
    exact = np.asarray(states(linear, u, linear.initial_state())) @ np.asarray(linear.C[0])
    np.testing.assert_allclose(exact, y, rtol=0, atol=1e-9 * np.max(np.abs(y)))


# The reduction
# --------------------------------------------------------------------------------------------------

EQ_7 = control.tf([7437.7769, -7437.7769 * 928.2], np.poly([-474.0, -474.0, -6.404]))


def test_reduced_motor_is_the_identified_one():
    reduced = voice_coil_motor().reduced()
    assert isinstance(reduced, VoiceCoil)
    np.testing.assert_allclose(reduced.poles, (474.0, 474.0, 6.404), rtol=0.02)
    assert reduced.zero == pytest.approx(928.2, rel=0.01)
    assert float(as_control(reduced).dcgain()) == pytest.approx(-4.798, rel=1e-3)
    low = np.geomspace(0.1, 200, 30)
    np.testing.assert_array_less(np.abs(at(as_control(reduced), low) / at(EQ_7, low) - 1), 0.01)
    np.testing.assert_array_less(
        np.abs(at(wired(voice_coil_motor()), low[low < 30]) / at(EQ_7, low[low < 30]) - 1), 0.022
    )


# up to this frequency [Hz] the reduced form is accurate to 3 %
@pytest.mark.parametrize(("name", "up_to"), [("identified", 35), ("printed", 50), ("sprung", 22)])
def test_reduction_keeps_poles_gain_and_delay(name, up_to):
    full, reduced = wired(MOTORS[name]), as_control(MOTORS[name].reduced())
    slowest = sorted(full.poles(), key=abs)[:3]
    # Rounding makes this pair real or complex. Eigenvalues of a nearly double pole are accurate to
    # 1e-5 where the numbers are accurate to 1e-16.
    for pole in reduced.poles():
        assert np.min(np.abs(pole - slowest)) < 1e-5 * max(abs(pole), 1.0)
    low = np.geomspace(0.1, up_to, 30)
    error = np.abs(at(reduced, low) / at(full, low) - 1)
    np.testing.assert_array_less(error, 0.03)
    # G and its slope agree at 0, so the error grows as the square of the frequency
    ratio = np.abs(at(reduced, [2.0, 4.0]) / at(full, [2.0, 4.0]) - 1)
    assert ratio[1] / ratio[0] == pytest.approx(4.0, rel=0.02)


def test_printed_bandwidths():
    """Those of section II-A: 500 Hz from command to speed, 2 kHz of the current loop."""
    motor = voice_coil_motor("printed")
    speed = np.abs(
        at(wired(motor), np.array([500.0, 1e-3]))
        * 2
        * np.pi
        * np.array([500.0, 1e-3])
        / 1e3
        / float(motor.command_scale)
    )
    assert speed[0] == pytest.approx(np.sqrt(0.5), rel=0.01)
    assert speed[1] == pytest.approx(1.0, rel=1e-6)
    assert (motor.resistance + motor.current_gain) / motor.inductance == pytest.approx(
        2 * np.pi * 2000, rel=0.01
    )
    reduced = motor.reduced()
    assert isinstance(reduced, StateSpace)
    assert np.min(np.abs(as_control(reduced).poles())) < 1e-9


def test_a_spring_alone_leaves_the_integrator():
    """The integral part overcomes a spring: without a hold the position per volt is unbounded."""
    held = VoiceCoilMotor(stiffness=5e4)
    free = replaced(held, {"holding_gain": 0.0})
    assert np.min(np.abs(wired(free).poles())) < 1e-6
    assert np.min(np.abs(np.linalg.eigvals(free.linear().A))) < 1e-6
    assert np.min(np.abs(wired(held).poles())) > 1.0


def test_reduction_of_a_complex_pair_and_of_none():
    ringing = VoiceCoilMotor(speed_gain=40.0)
    poles = as_control(ringing.reduced()).poles()
    assert isinstance(ringing.reduced(), StateSpace)
    assert np.max(poles.imag) > 100
    with pytest.raises(
        ValueError,
        match=r"no third-order form, since its third and fourth pole are a pair "
        ".*current_gain or speed_gain",
    ):
        VoiceCoilMotor(
            speed_gain=300.0, speed_integral_gain=3e4, setpoint_weight=1.0, command_delay=None
        ).reduced()


def test_linear_is_differentiable():
    """The reduced form is differentiable: d A[speed, current] / d mass = -k_f / m^2."""
    slope = jax.jit(jax.grad(lambda m: VoiceCoilMotor(mass=m).linear().A[1, 2]))(3.0)
    assert slope == pytest.approx(-56.2 / 9.0)


# Integration
# --------------------------------------------------------------------------------------------------

FULL = {
    "friction": StribeckFriction(4.0, 6.0, 0.02, 5.0, 4e-3),
    "cogging": Cogging(20.0, 0.004, 0.3),
    "end_effect": EndEffect(0.003, 0.3),
}


@pytest.mark.thorough
def test_integrator_is_of_order_four():
    """By regression of the log error over the log step, with all smooth forces."""
    motor = VoiceCoilMotor(**UNLIMITED, **FULL)
    steps = DT / np.array([12, 20, 32])
    exact = positions(dataclasses.replace(motor, substep=DT / 256), U)
    errors = [
        np.max(np.abs(positions(dataclasses.replace(motor, substep=h), U) - exact)) for h in steps
    ]
    assert np.polyfit(np.log(steps), np.log(errors), 1)[0] == pytest.approx(4.0, abs=0.3)
    assert errors[-1] > 1e-13


@pytest.mark.thorough
def test_sample_time_does_not_change_the_motion():
    """The same steps are taken within twice as many samples."""
    motor = VoiceCoilMotor(**FULL)
    np.testing.assert_allclose(
        positions(motor, np.repeat(U, 2), DT / 2)[::2], positions(motor, U), **ALGEBRA
    )


def test_unstable_substep_is_refused_where_it_is_known():
    with pytest.raises(
        ValueError,
        match=r"VoiceCoilMotor: substep = 0.0005 s is unstable for the fastest pole, "
        r"1.16e\+04 rad/s",
    ) as refused:
        VoiceCoilMotor(substep=5e-4)
    longest = float(
        re.search(r"range with these parameters is \(0, (\S+)\]", str(refused.value)).group(1)
    )
    assert abs(positions(VoiceCoilMotor(**UNLIMITED, substep=0.99 * longest), U)[-1]) < 10

    @jax.jit
    def unchecked(mass):
        """Simulate with a traced mass, whose value is not checked: what was refused diverges."""
        motor = VoiceCoilMotor(mass=mass, **UNLIMITED, substep=5e-4)
        return states(motor, np.zeros(N), rest(motor, speed=0.1)).position[-1]

    assert not abs(float(unchecked(3.0))) < 1e6


@pytest.mark.parametrize(
    "stiff",
    [
        {"friction": StribeckFriction(10.0, 10.0, transition_velocity=5e-5)},
        {"cogging": Cogging(1e6, 1e-3)},
        {"end_effect": EndEffect(0.01, 0.1, buffer_stiffness=1e10)},
        {"mass": np.array([3.0, 1e-3])},
    ],
    ids=["friction", "cogging", "buffer", "batch"],
)
def test_stiff_parts_count_for_the_substep(stiff):
    with pytest.raises(
        ValueError, match=r"substep = 0.000125 s is unstable for the fastest pole, \d"
    ):
        VoiceCoilMotor(**stiff)


# Limits
# --------------------------------------------------------------------------------------------------

FINE = 5e-5  # [s], fine enough to show the drive between the samples of the task


def driven(motor, u):
    """Return states and drive signals under u (N,), finely sampled."""
    x = states(motor, u, rest(motor), FINE)
    signals = jax.vmap(motor.drive)(x, jnp.append(u, u[-1]))
    return jax.tree.map(np.asarray, (x, signals))


def test_limits_hold_and_give_the_printed_acceleration():
    """At 23 A it accelerates by 431 m/s^2 up to 3.44 m/s (Cao 2019, section II-A)."""
    motor = VoiceCoilMotor(holding_gain=0.0, command_delay=None)
    assert motor.force_constant * PEAK_CURRENT / motor.mass == pytest.approx(ACCELERATION, abs=0.5)
    u = np.full(400, -200.0)
    x, drive = driven(motor, u)
    assert np.max(np.abs(drive.voltage)) == 560.0
    assert np.max(np.abs(drive.current)) == PEAK_CURRENT == motor.current_limit
    assert np.max(np.abs(x.current)) <= PEAK_CURRENT
    acceleration = np.diff(x.speed) / FINE
    assert np.max(np.abs(acceleration)) <= ACCELERATION
    assert np.max(np.abs(acceleration)) == pytest.approx(ACCELERATION, rel=0.05)
    assert np.max(drive.speed) == SPEED
    # The equation of the coil limits the rate to U_max / L.
    assert np.max(np.abs(np.diff(x.current))) <= 560.0 / 0.02 * FINE
    x, drive = driven(dataclasses.replace(motor, **UNLIMITED), u)
    assert np.max(x.current) > 23.0
    assert np.max(drive.voltage) > 560.0
    assert np.max(drive.speed) > 3.44


@pytree
class WindingUp(VoiceCoilMotor):
    """This is the motor without anti-windup, since it does not report what exceeds the limit."""

    def drive(self, x, u):
        drive = super().drive(x, u)
        return drive._replace(wanted_current=drive.current)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("motor", "low", "high"), [(VoiceCoilMotor, 0.0, 0.05), (WindingUp, 0.5, 1.0)]
)
def test_anti_windup(motor, low, high):
    """It accelerates to 3.44 m/s at the continuous current, and its integral waits at the limit."""
    motor = motor(holding_gain=0.0, command_delay=None, current_limit=CONTINUOUS_CURRENT)
    x = states(motor, np.full(1000, -200.0), rest(motor), 2e-4)
    assert low < float(np.max(x.speed)) / 3.44 - 1 < high


@pytest.mark.thorough
def test_gradient_is_zero_beyond_a_limit():
    motor = VoiceCoilMotor(holding_gain=0.0, command_delay=None)

    def way(motor, volt):
        return states(motor, jnp.full(20, volt), rest(motor)).position[-1]

    slopes = jax.jit(jax.grad(way, argnums=(0, 1)))
    by_motor, by_volt = slopes(motor, -200.0)
    assert by_volt == 0.0
    assert by_motor.current_limit > 0.0
    assert slopes(motor, -1.0)[1] != 0.0


# Friction, cogging, end effect
# ------------------------------------------------------------------------------------------------


def pushed(force, **parts):
    """Return a motor whose weak drive applies a force only, and the command for it [N]."""
    motor = VoiceCoilMotor(
        **UNLIMITED, **parts, command_delay=None, holding_gain=0.0, viscous_damping=0.0,
        command_scale=1.0, setpoint_weight=1.0,
        speed_gain=1e-6, speed_integral_gain=1e-12, substep=5e-5,
    )  # fmt: skip
    gain = motor.force_constant * motor.current_gain / (motor.resistance + motor.current_gain)
    return motor, np.full(N, force / (1e-6 * gain))


def test_friction_curve():
    friction = StribeckFriction(8.0, 12.0, 0.01, 30.0, 1e-5)
    v = np.array([0.002, 0.01, 0.2])
    expected = 8.0 + 4.0 * np.exp(-((v / 0.01) ** 2)) + 30.0 * v
    force, slope = jax.jit(jax.vmap(jax.value_and_grad(friction.force)))(np.array([*v, *-v, 0.0]))
    np.testing.assert_allclose(force[:3], expected, rtol=1e-12)
    np.testing.assert_allclose(force[3:6], -expected, rtol=1e-12)
    assert force[6] == 0.0
    assert slope[6] == pytest.approx(float(friction.damping_at_rest))


def test_friction_holds_against_a_small_force_and_yields_to_a_large_one():
    """Below 12 N it creeps at v_t artanh(F/F_s); above, Coulomb force and back-EMF brake."""
    friction = StribeckFriction(8.0, 12.0, transition_velocity=1e-4, stribeck_velocity=0.01)
    motor, u = pushed(9.0, friction=friction)
    x = states(motor, u, rest(motor))
    # The force rises slowly with the current; F_s - F(v) equals F_s up to a term (v/v_s)^2.
    assert x.speed[-1] == pytest.approx(1e-4 * np.arctanh(9 / 12), rel=2e-3)
    assert x.position[-1] < 1e-4 * N * DT
    motor, u = pushed(100.0, friction=friction)
    x = states(motor, u, rest(motor))
    emf = 56.2**2 / 251.0
    assert (x.speed[-1] - x.speed[-2]) / DT == pytest.approx(
        (100.0 - 8.0 - emf * float(x.speed[-1])) / 3.0, rel=1e-2
    )
    assert x.speed[-1] > 1.0


@pytest.mark.thorough
def test_cogging_is_periodic_in_position():
    motor, u = pushed(5.0, cogging=Cogging(20.0, 0.016, 0.2))
    here, next_pitch, half = (
        np.asarray(states(motor, u, rest(motor, x0)).position) - x0 for x0 in (0.003, 0.019, 0.011)
    )
    np.testing.assert_allclose(next_pitch, here, rtol=1e-9, atol=1e-12)
    assert np.max(np.abs(half - here)) > 1e-3
    still = pushed(0.0, cogging=Cogging(20.0, 0.016))[0]
    assert np.max(np.abs(states(still, np.zeros(N), rest(still)).position)) == 0.0
    # The motion starts from rest at the top of the potential. At its lowest point the energy is
    # m v^2 / 2 = 2 A pitch / (2 pi). The back-EMF takes a little.
    falling = np.asarray(states(still, np.zeros(1000), rest(still, 0.0079)).speed)
    assert np.max(np.abs(falling)) == pytest.approx(
        np.sqrt(2 * 2 * 20.0 * 0.016 / (2 * np.pi) / 3.0), rel=0.25
    )


@pytest.mark.thorough
def test_end_effect_weakens_the_motor_and_the_buffer_stops_it():
    motor, u = pushed(50.0, end_effect=EndEffect(0.05, 0.4))
    speeds = [float(states(motor, u, rest(motor, x0)).speed[4]) for x0 in (0.0, 0.025, 0.05, 0.2)]
    np.testing.assert_allclose(np.array(speeds) / speeds[0], (1.0, 0.9, 0.6, 0.6), rtol=2e-2)
    stopped, _ = pushed(0.0, end_effect=EndEffect(0.002, 0.0, buffer_stiffness=1e5))
    x = states(stopped, np.zeros(N), rest(stopped, speed=0.2))
    # It moves into the buffer by v sqrt(m / k) at most, and comes back.
    assert 0.002 < np.max(x.position) < 0.002 + 0.2 * np.sqrt(3.0 / 1e5)
    assert np.min(x.speed) < -0.1


# In the simulator
# --------------------------------------------------------------------------------------------------


@pytest.mark.thorough
def test_motor_learns_like_its_reduced_form():
    """On Cao 2019's task, shortened to 1 mm at 2 Hz, down to the error of eq. 7's structure."""
    task = Task(np.sin(4 * np.pi * np.arange(501) * DT), dt=DT, unit="mm", input_unit="V")
    motor = voice_coil_motor()
    full, reduced = (
        np.asarray(learn(Machine(p), CFDLMFAILC(), task, 25).rms[:, 0])
        for p in (motor, motor.reduced())
    )
    np.testing.assert_allclose(full, reduced, rtol=0.05)
    assert full[-1] < 0.25 * full[0]
