"""The voice-coil linear motor from its physics (Cao 2019, eq. 1 to 6).

It has a coil, a carriage with the forces on it, and the current loop and speed loop of its drive.
"""

from __future__ import annotations

import math
from types import ModuleType
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from ..pytree.aliases import Array, Leaf, Numbers, Tree
from ..pytree.fields import child, pytree, scalar, static
from ..pytree.needs import known
from ..pytree.ranges import need_one_of, require
from ..signals.task import Task
from .friction import StribeckFriction
from .integration import RK4_RADIUS, runge_kutta
from .linear import StateSpace
from .plant import Plant
from .voice_coil import VoiceCoil

MOST_STEPS = 10_000  # of the integrator in a sample


class MotorState(NamedTuple):
    """The state of the motor.

    position: () [m]
    speed:    () [m/s]
    current:  () of the coil [A]
    integral: () integral part of the speed controller [A]
    delay:    () state of the delay [V]; None where there is no delay
    """

    position: Array
    speed: Array
    current: Array
    integral: Array
    delay: Tree


class DriveSignals(NamedTuple):
    """What the drive commands.

    speed:          () [m/s]
    wanted_current: () before the limit [A]
    current:        () after the limit [A]
    voltage:        () at the terminals [V]
    """

    speed: Array
    wanted_current: Array
    current: Array
    voltage: Array


@pytree
class Cogging:
    """Force of the magnets on the iron, periodic in the position.

        F(x) = -A sin(2 pi x / pitch + phase)

    amplitude: () A [N]
    pitch:     () period [m]
    phase:     () [rad]; 0 makes x = 0 a stable rest
    """

    amplitude: Leaf = scalar(interval="[0, inf)")
    pitch: Leaf = scalar(interval="(0, inf)")
    phase: Leaf = scalar(default=0.0)

    def force(self, position: Array) -> Array:
        """The force () [N] at a position () [m]."""
        return -self.amplitude * jnp.sin(2 * jnp.pi * position / self.pitch + self.phase)


@pytree
class EndEffect:
    """What happens toward the ends of the stroke, and beyond them.

    The coil leaves the field, and beyond the ends the carriage meets a buffer:

        k_f(x) = k_f (1 - drop (x/x_max)^2) within |x| <= x_max, constant beyond
        F(x) = -k_b (x - clip(x, -x_max, x_max))

    stroke: () x_max, half the stroke [m]
    drop:   () share of the force constant that is lost at the end
    buffer_stiffness: () k_b [N/m]; None is no buffer
    """

    stroke: Leaf = scalar(interval="(0, inf)")
    drop: Leaf = scalar(interval="[0, 1)")
    buffer_stiffness: Leaf | None = scalar(default=None, interval="(0, inf)", optional=True)

    def factor(self, position: Array) -> Array:
        """The share () of the force constant that is left at a position () [m]."""
        return 1.0 - self.drop * (jnp.clip(position, -self.stroke, self.stroke) / self.stroke) ** 2

    def force(self, position: Array) -> Array | float:
        """The force () of the buffer [N] at a position () [m]."""
        beyond = position - jnp.clip(position, -self.stroke, self.stroke)
        return 0.0 if self.buffer_stiffness is None else -self.buffer_stiffness * beyond


@pytree
class VoiceCoilMotor(Plant):
    """Voice-coil motor with its drive, from speed command [V] to position [mm] (Cao 2019, eq. 1-5).

        coil (1):       U = L di/dt + R i + k_f(x) v
        carriage (2):   m dv/dt = k_f(x) i - d v - k x - F_friction(v) + F_cogging(x) + F_buffer(x)
                        dx/dt = v
        current loop:   U = clip(K_c (i* - i), U_max)
        speed loop (5): i* = clip(i°, i_max),  i° = b K_p v* - K_p v + q
                        dq/dt = K_i (v* - v) + (K_i/K_p) (i* - i°)
        command:        v* = clip(S w - k_h x, v_max),  w = (2 - T s)/(2 + T s) u

    In SI units the back-EMF constant is the force constant N B l. The integral q of the PI speed
    loop has anti-windup by back-calculation. The command is scaled, the carriage is held, and the
    delay T is a first-order Padé form.

    mass:            () m, everything that moves [kg]
    resistance:      () R [ohm]
    inductance:      () L [H]
    force_constant:  () k_f [N/A]
    viscous_damping: () d [N s/m]
    stiffness:       () k of cables or a weight-balancing spring [N/m]
    current_gain:    () K_c [V/A]
    speed_gain:      () K_p [A s/m]
    speed_integral_gain: () K_i [A/m]
    setpoint_weight: () b, the share of the command that the proportional part sees: 1 is eq. 5, 0
                     leaves no zero (I-P controller)
    command_scale:   () S [m/(s V)]
    holding_gain:    () k_h [1/s]
    command_delay:   () T [s]
    current_limit:   () i_max [A]
    voltage_limit:   () U_max of the bus [V]
    speed_limit:     () v_max [m/s]
    friction, cogging, end_effect: further forces
    substep:         longest step of the integrator, Runge-Kutta of order 4 [s]; a sample takes
                     ceil(dt / substep) equal steps

    None leaves a part out. A limit is a clip: beyond it the gradient is zero.

    Printed for the DTL85/708 are the force constant, 23 A (peak) and 3.44 m/s. Inferred is 3.0 kg,
    since 56.2 N/A 23 A / 3.0 kg = 430.9 is the printed 431 m/s^2. Chosen are R and L (L/R = 5 ms,
    iron-core motors of this size), d, and 560 V (the rectified 400 V supply of the drive). K_c
    makes the current loop 2 kHz wide, as printed; T is one sample. K_p, K_i, k_h and S are then
    placed for eq. 7; see `reduced` for how close they come, and `voice_coil_motor("printed")` for
    the printed 500 Hz speed loop, whose poles lie far from eq. 7.

    Two features of eq. 7 are in no block of the paper. First, a PI speed loop leaves a free
    integrator from command to position, whatever its gains. Neither a spring (the integral part
    pushes it away) nor a leaky integrator (nothing restores the position) makes that a pole at -6.4
    rad/s; only both together, or a feedback of the position, do. Here the drive holds the carriage
    at mid-stroke with the gain k_h, as an M-sequence test on a carriage that is free to drift would
    need. Second, the zero of the PI controller lies in the left half-plane, that of eq. 7 in the
    right one. So the zero of eq. 7 stands for the delay and the current loop, T + 0.09 ms, and the
    PI's zero is absent (b = 0).

    Raises ValueError, where the values are known, for a substep that the fastest pole makes
    unstable.
    """

    input_names = ("speed_command",)
    output_names = ("position",)

    mass: Leaf = scalar(default=3.0, interval="(0, inf)")
    resistance: Leaf = scalar(default=4.0, interval="(0, inf)")
    inductance: Leaf = scalar(default=0.02, interval="(0, inf)")
    force_constant: Leaf = scalar(default=56.2, interval="(0, inf)")
    viscous_damping: Leaf = scalar(default=10.0, interval="[0, inf)")
    stiffness: Leaf | None = scalar(default=None, interval="[0, inf)", optional=True)
    current_gain: Leaf = scalar(default=247.0, interval="(0, inf)")
    speed_gain: Leaf = scalar(default=48.5, interval="(0, inf)")
    speed_integral_gain: Leaf = scalar(default=11602.0, interval="(0, inf)")
    setpoint_weight: Leaf = scalar(default=0.0, interval="[0, 1]")
    command_scale: Leaf = scalar(default=-0.0299)
    holding_gain: Leaf = scalar(default=6.232, interval="[0, inf)")
    command_delay: Leaf | None = scalar(default=1e-3, interval="(0, inf)", optional=True)
    current_limit: Leaf | None = scalar(default=23.0, interval="(0, inf)", optional=True)
    voltage_limit: Leaf | None = scalar(default=560.0, interval="(0, inf)", optional=True)
    speed_limit: Leaf | None = scalar(default=3.44, interval="(0, inf)", optional=True)
    friction: StribeckFriction | None = child(default=None)
    cogging: Cogging | None = child(default=None)
    end_effect: EndEffect | None = child(default=None)
    substep: float = static(default=1.25e-4, interval="(0, inf)")

    def __post_init__(self) -> None:
        if known(self):
            fastest = _fastest_pole(self)
            if fastest * self.substep > RK4_RADIUS:
                raise ValueError(
                    f"VoiceCoilMotor: substep = {self.substep:g} s is unstable for the fastest "
                    f"pole, {fastest:.4g} rad/s; "
                    f"its allowed range with these parameters is (0, {RK4_RADIUS / fastest:.3g}]"
                )

    def check(self, task: Task) -> None:
        allowed = f"[{task.dt / MOST_STEPS}, inf)"
        note = f", {MOST_STEPS} steps a sample of dt = {task.dt:g} s"
        require("VoiceCoilMotor", "substep", self.substep, allowed, " s", note=note)

    def initial_state(self) -> MotorState:
        rest = jnp.zeros_like(self.mass, shape=())
        return MotorState(rest, rest, rest, rest, None if self.command_delay is None else rest)

    def step(self, x: MotorState, u: Array, dt: float) -> MotorState:
        steps = max(math.ceil(dt / self.substep - 1e-9), 1)

        # a gradient recomputes the substeps of a sample instead of storing their 4 stages for every
        # sample of the trial
        @jax.checkpoint
        def sample(motor: VoiceCoilMotor, x: MotorState, u: Array) -> Tree:
            return lax.scan(
                lambda x, _: (runge_kutta(lambda z: motor._rates(z, u), x, dt / steps), None),
                x,
                length=steps,
            )[0]

        return sample(self, x, u[0])

    def output(self, x: MotorState) -> Array:
        return 1e3 * x.position[None]

    def drive(self, x: MotorState, u: Array) -> DriveSignals:
        """The drive's commands in state x under the command u () [V]."""
        b, K_p = self.setpoint_weight, self.speed_gain
        w = u if self.command_delay is None else 2 * x.delay - u
        speed = _clip(self.command_scale * w - self.holding_gain * x.position, self.speed_limit)
        wanted = b * K_p * speed - K_p * x.speed + x.integral
        current = _clip(wanted, self.current_limit)
        return DriveSignals(
            speed,
            wanted,
            current,
            _clip(self.current_gain * (current - x.current), self.voltage_limit),
        )

    def _rates(self, x: MotorState, u: Array) -> MotorState:
        """Time derivatives of the state."""
        k_f, K_p, K_i = self.force_constant, self.speed_gain, self.speed_integral_gain
        if self.end_effect is not None:
            k_f = k_f * self.end_effect.factor(x.position)
        drive = self.drive(x, u)
        force = k_f * x.current - self.viscous_damping * x.speed
        if self.stiffness is not None:
            force = force - self.stiffness * x.position
        if self.friction is not None:
            force = force - self.friction.force(x.speed)
        for field in (self.cogging, self.end_effect):
            if field is not None:
                force = force + field.force(x.position)
        return MotorState(
            x.speed,
            force / self.mass,
            (drive.voltage - self.resistance * x.current - k_f * x.speed) / self.inductance,
            K_i * (drive.speed - x.speed) + K_i / K_p * (drive.current - drive.wanted_current),
            None if self.command_delay is None else 2 * (u - x.delay) / self.command_delay,
        )

    def linear(self) -> StateSpace:
        """The motor at mid-stroke without limits, friction, cogging and end effect.

        It is exact, of full order, in continuous time, and differentiable in every parameter. The
        state is that of `MotorState`.
        """
        A, B, C = _matrices(
            jnp, self, self.viscous_damping, 0.0 if self.stiffness is None else self.stiffness
        )
        return StateSpace(A, B[:, None], C[None, :])

    def continuous(self) -> StateSpace:
        return self.linear()

    def reduced(self) -> VoiceCoil | StateSpace:
        """The third-order form, Cao 2019, eq. 6: three slowest poles of `linear()`, one zero.

            G(s) = N(s) / (D_slow(s) D_fast(s))  ->  (c_0 + c_1 s) / D_slow(s)
            N(s) / D_fast(s) = c_0 + c_1 s + O(s^2)

        Poles are kept, so it is stable when the motor is, and G and its slope agree at s = 0: the
        DC gain (or, with a free integrator, the velocity gain) and the total delay. What is fast,
        current loop and delay, merges into the zero, at about +1/(T + L/(R + K_c)).

        The default motor reduces to eq. 7 with its DC gain within 0.1 %, its poles within 2 % (482,
        467 and 6.404 rad/s) and its zero within 1 % (920.6); this is 1 % in frequency response up
        to 200 Hz. The full motor departs from that as the square of the frequency, by 2 % at 30 Hz
        and 5.5 % at 50 Hz, where the delay of a reduced zero also amplifies.

        It is a `VoiceCoil` where the poles are real and stable, and else the same form as a
        `StateSpace`. It is meant for design and is not differentiable. Raises ValueError where the
        third and fourth pole are a conjugate pair, so that no third-order form exists.
        """
        N, D = _polynomials(self)
        poles = np.roots(D)
        poles = poles[np.argsort(np.abs(poles), kind="stable")]
        slow, next_one = poles[:3], poles[3]
        if not np.isclose(slow.sum().imag, 0.0, atol=1e-9 * abs(next_one)):
            raise ValueError(
                "VoiceCoilMotor: no third-order form, since its third and fourth pole are a pair "
                f"{next_one:.4g}; current_gain or speed_gain must set them apart"
            )
        D_slow, D_fast = np.poly(slow).real, D[0] * np.poly(poles[3:]).real
        c_0 = N[-1] / D_fast[-1]
        c_1 = (N[-2] - c_0 * D_fast[-2]) / D_fast[-1]
        # rounding alone splits a double pole by 1e-8 of its size into a pair
        if np.all(np.abs(slow.imag) <= 1e-6 * np.abs(slow)) and np.all(slow.real < 0) and c_1 != 0:
            return VoiceCoil(gain=c_1, zero=-c_0 / c_1, poles=-slow.real[::-1])
        return StateSpace(
            np.vstack([np.eye(2, 3, 1), -D_slow[:0:-1]]),
            np.eye(3)[:, 2:],
            np.array([[c_0, c_1, 0.0]]),
        )


def voice_coil_motor(form: str = "identified") -> VoiceCoilMotor:
    """The motor DTL85/708 of Cao 2019 with one of two tunings of its drive.

        identified  the poles, zero and gain of eq. 7; its speed loop follows a command only up to
                    49 Hz
        printed     section II-A as it is printed: a PI speed loop of 500 Hz (eq. 5, -3 dB), a
                    current loop of 2 kHz, a free integrator, no delay; the velocity gain is that of
                    eq. 7

    In the second form a step of 0.6 V already takes the whole bus voltage, and `reduced` is within
    3 % up to 50 Hz. Raises ValueError for another form.
    """
    need_one_of("voice_coil_motor", "form", form, ("identified", "printed"))
    if form == "identified":
        return VoiceCoilMotor()
    return VoiceCoilMotor(
        speed_gain=130.0,
        speed_integral_gain=26e3,
        setpoint_weight=1.0,
        command_scale=-4.798e-3 * 6.404,
        holding_gain=0.0,
        command_delay=None,
    )


def _clip(x: Array, limit: Leaf) -> Array:
    return x if limit is None else jnp.clip(x, -limit, limit)


# The linear form
# --------------------------------------------------------------------------------------------------


def _matrices(xp: ModuleType, motor: VoiceCoilMotor, d: Leaf, k: Leaf) -> tuple[Leaf, Leaf, Leaf]:
    """A (..., n, n), B (..., n), C (n,) of the linear motor with damping d and stiffness k.

    xp: NumPy or jax.numpy, which computes them
    """
    m = motor.mass
    R = motor.resistance
    L = motor.inductance
    k_f = motor.force_constant
    K_c = motor.current_gain
    K_p = motor.speed_gain
    K_i = motor.speed_integral_gain
    b = motor.setpoint_weight
    S = motor.command_scale
    k_h = motor.holding_gain
    delayed = motor.command_delay is not None
    # the Padé form has a feedthrough: w = 2 z - u
    delay: Leaf = motor.command_delay
    of_z, of_u, lag = (2.0, -1.0, 2 / delay) if delayed else (0.0, 1.0, 0.0)
    A = [
        [0.0, 1.0, 0.0, 0.0, 0.0],
        [-k / m, -d / m, k_f / m, 0.0, 0.0],
        [
            -K_c * b * K_p * k_h / L,
            -(K_c * K_p + k_f) / L,
            -(R + K_c) / L,
            K_c / L,
            K_c * b * K_p * S * of_z / L,
        ],
        [-K_i * k_h, -K_i, 0.0, 0.0, K_i * S * of_z],
        [0.0, 0.0, 0.0, 0.0, -lag],
    ]
    B = [0.0, 0.0, K_c * b * K_p * S * of_u / L, K_i * S * of_u, lag]
    n = 5 if delayed else 4
    entries = xp.broadcast_arrays(
        *(xp.asarray(a) for row in A[:n] for a in row[:n]), *(xp.asarray(a) for a in B[:n])
    )
    entries = xp.stack(entries, -1)
    shape = entries.shape[:-1]
    return (
        entries[..., : n * n].reshape(*shape, n, n),
        entries[..., n * n :],
        xp.asarray([1e3] + [0.0] * (n - 1)),
    )


def _fastest_pole(motor: VoiceCoilMotor) -> float:
    """Largest |pole| [rad/s], over all elements of batched leaves.

    It is looked for in free motion, and where friction, cogging and buffer are stiffest.
    """
    d, k = motor.viscous_damping, 0.0 if motor.stiffness is None else motor.stiffness
    stiff_d, stiff_k = d, k
    if motor.friction is not None:
        stiff_d = d + motor.friction.damping_at_rest
    if motor.cogging is not None:
        stiff_k = stiff_k + 2 * np.pi * motor.cogging.amplitude / motor.cogging.pitch
    if motor.end_effect is not None and motor.end_effect.buffer_stiffness is not None:
        stiff_k = stiff_k + motor.end_effect.buffer_stiffness
    cases = (_matrices(np, motor, d, k)[0], _matrices(np, motor, stiff_d, stiff_k)[0])
    return max(float(np.max(np.abs(np.linalg.eigvals(A)))) for A in cases)


def _polynomials(motor: VoiceCoilMotor) -> tuple[Numbers, Numbers]:
    """N (high order first) and D of the full-order transfer function [mm/V], in closed form.

        N = 1000 S k_f K_c (b K_p s + K_i) (2/T - s)
        D = [s (L s + R + K_c)(m s^2 + d s + k) + k_f^2 s^2
             + k_f K_c (K_p s^2 + (K_i + b K_p k_h) s + K_i k_h)] (2/T + s)

    The last factors are absent where there is no delay.
    """
    m, R, L, k_f = map(
        float, (motor.mass, motor.resistance, motor.inductance, motor.force_constant)
    )
    d, K_c, K_p = map(float, (motor.viscous_damping, motor.current_gain, motor.speed_gain))
    K_i, b = float(motor.speed_integral_gain), float(motor.setpoint_weight)
    S, k_h = float(motor.command_scale), float(motor.holding_gain)
    k = 0.0 if motor.stiffness is None else float(motor.stiffness)
    N: Numbers = 1e3 * S * k_f * K_c * np.array([b * K_p, K_i])
    D: Numbers = np.polymul([L, R + K_c, 0.0], [m, d, k])
    D[2:] += np.array(
        [k_f**2 + k_f * K_c * K_p, k_f * K_c * (K_i + b * K_p * k_h), k_f * K_c * K_i * k_h]
    )
    if motor.command_delay is not None:
        lag = 2 / float(motor.command_delay)
        N, D = np.polymul(N, [-1.0, lag]), np.polymul(D, [1.0, lag])
    return N, D
