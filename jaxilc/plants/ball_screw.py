"""A flexible ball-screw drive (MILC 2024, section 3 and 5).

It has two masses, a spring, friction, the error of its lead, and the speed loop and current loop of
its drive with a table that compensates friction.
"""

from __future__ import annotations

import dataclasses
import math
from functools import partial
from typing import NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from ..pytree.aliases import Array, Leaf, Tree, Value
from ..pytree.fields import child, leaf, pytree, scalar, static
from ..pytree.needs import known
from ..pytree.ranges import require
from ..signals.task import Task, product, quantise
from .along_motion import flat
from .friction import StribeckFriction
from .integration import RK4_RADIUS, Propagator, exponential_runge_kutta, propagator
from .linear import StateSpace, matching
from .plant import Plant


class DriveState(NamedTuple):
    """The state of the drive.

    mechanics: (4,) or (5,) x_M [m], v_M [m/s], x_T [m], v_T [m/s], and the force [N] where it lags
    integral:  () of the speed controller [V]
    measured:  () motor position as measured a sample ago [mm]
    """

    mechanics: Array
    integral: Array
    measured: Array


@pytree
class LeadError:
    """The screw's deviation from its nominal lead, periodic in the motor's position.

        l(x) = A sin(2 pi x / period + phase)

    amplitude: () A [m]
    period:    () [m], the pitch or a part of it
    phase:     () [rad]
    """

    amplitude: Leaf = scalar(interval="[0, inf)")
    period: Leaf = scalar(interval="(0, inf)")
    phase: Leaf = scalar(default=0.0)

    def at(self, position: Array) -> tuple[Array, Array]:
        """l () [m] and dl/dx () at a position () [m]."""
        k = 2 * jnp.pi / self.period
        angle = k * position + self.phase
        return self.amplitude * jnp.sin(angle), self.amplitude * k * jnp.cos(angle)


@pytree
class FrictionTable:
    """Look-up table of the drive that compensates friction.

    It gives the force to add at a commanded velocity, interpolated.

    velocity: (M,) increasing [m/s]
    force:    (M,) [N]; beyond the ends the end values hold

    Raises ValueError for a velocity that does not increase, or shapes that differ.
    """

    velocity: Leaf = leaf()
    force: Leaf = leaf()

    def __post_init__(self) -> None:
        if (
            self.velocity.ndim != 1
            or self.velocity.shape != self.force.shape
            or len(self.velocity) < 2
        ):
            raise ValueError(
                f"FrictionTable: velocity {self.velocity.shape} and force {self.force.shape} must "
                "both have shape (M,), M >= 2"
            )
        if known(self) and np.any(np.diff(self.velocity) <= 0):
            raise ValueError(f"FrictionTable: velocity = {np.asarray(self.velocity)} must increase")

    def at(self, velocity: Array) -> Array:
        """The force () [N] at a velocity () [m/s]."""
        return jnp.interp(velocity, self.velocity, self.force)

    @classmethod
    def of(cls, friction: StribeckFriction, velocity: Leaf) -> FrictionTable:
        """The table that an identification experiment at given velocities (M,) [m/s] leaves."""
        velocity = np.asarray(velocity, float)
        return cls(velocity, np.asarray(friction.force(velocity)))


@pytree
class BallScrewDrive(Plant):
    """Two-mass ball-screw drive, from velocity command [V] to motor and table position [mm].

    The mechanics (MILC 2024, eq. 10, 41 and 42) are

        m_M dv_M/dt = -c_M v_M - F_s (1 + l'(x_M)) - F_friction,M(v_M) + F
        m_T dv_T/dt = -c_T v_T + F_s - F_friction,T(v_T)
        F_s = k_s s + c_s ds/dt,  s = x_M + l(x_M) - x_T

    and the drive, at every sample,

        v[k] = (y_M[k] - y_M[k-1]) / dt,  d = S u - v,  q[k] = q[k-1] + K_vi dt d
        w = K_vp d + q,  F* = clip(g w + F_table(S u), F_max)

    F follows F* as a first-order lag (the current loop), and F* is held over a sample. The print
    has the motor's acceleration in the table's equation; the table's is meant. Its position is the
    backward sum of the speed (G_i), in agreement with v as a backward difference of the encoder; a
    change of position between samples is exact here. The outputs are x_M and x_T: the motor's
    position as the nominal lead has it, and the table's.

    motor_mass:     () m_M [kg], rotor and screw as seen at the table, J (2 pi / pitch)^2
    table_mass:     () m_T [kg]
    stiffness:      () k_s [N/m]
    damping:        () c_s [N s/m]
    force_gain:     () g [N/V]
    motor_damping, table_damping: () c_M, c_T [N s/m]
    speed_gain:     () K_vp [V s/mm]
    speed_integral_gain: () K_vi [V/mm]
    command_scale:  () S [mm/(s V)]
    current_bandwidth: () of the force's lag [Hz]
    force_limit:    () F_max [N]; the integral stops while the limit is met. It is a clip: beyond it
                  the gradient is zero
    encoder_step:   () of the motor position from which v is taken [mm]; its gradient is
                  straight-through
    motor_friction, table_friction, lead_error, compensation (F_table): further parts
    longest_dt:     sample times beyond it are refused where there is friction [s]
    substeps:       equal steps of the integrator in a sample, where there is friction or a lead
                  error. A lead error acts through the spring, whose resonance a step then has to
                  follow: more than 1 rad of it in a step is refused. With friction, too, a motion
                  of 60 um was right to 1.3e-3 at 0.9 rad, and one of 0.75 mm to 1e-4
    linear_part, dt: of the mechanics once sampled, see `sampled`; until then None and 0

    None leaves a part out. Raises ValueError, where the values are known, for friction that an
    explicit step of longest_dt cannot follow, and a task whose steps are too long for a lead error.
    """

    n_y = 2
    input_names = ("velocity_command",)
    output_names = ("motor_position", "table_position")

    motor_mass: Leaf = scalar(interval="(0, inf)")
    table_mass: Leaf = scalar(interval="(0, inf)")
    stiffness: Leaf = scalar(interval="(0, inf)")
    damping: Leaf = scalar(interval="[0, inf)")
    force_gain: Leaf = scalar(interval="(0, inf)")
    motor_damping: Leaf = scalar(default=0.0, interval="[0, inf)")
    table_damping: Leaf = scalar(default=0.0, interval="[0, inf)")
    speed_gain: Leaf = scalar(default=0.216, interval="[0, inf)")
    speed_integral_gain: Leaf = scalar(default=8.18, interval="[0, inf)")
    command_scale: Leaf = scalar(default=1.0)
    current_bandwidth: Leaf | None = scalar(default=None, interval="(0, inf)", optional=True)
    force_limit: Leaf | None = scalar(default=None, interval="(0, inf)", optional=True)
    encoder_step: Leaf | None = scalar(default=None, interval="(0, inf)", optional=True)
    motor_friction: StribeckFriction | None = child(default=None)
    table_friction: StribeckFriction | None = child(default=None)
    lead_error: LeadError | None = child(default=None)
    compensation: FrictionTable | None = child(default=None)
    longest_dt: float = static(default=1e-3, interval="(0, inf)")
    substeps: int = static(default=1, interval="[1, 1e4]", whole=True)
    linear_part: Propagator | None = child(default=None)
    dt: float = static(default=0.0, interval="[0, inf)")

    def __post_init__(self) -> None:
        if not known(self):
            return
        for name, mass in (
            ("motor_friction", self.motor_mass),
            ("table_friction", self.table_mass),
        ):
            friction = jax.tree.map(np.asarray, getattr(self, name))
            pole = 0.0
            if friction is not None:
                pole = float(np.max(friction.damping_at_rest / np.asarray(mass)))
            if pole * self.longest_dt > RK4_RADIUS:
                raise ValueError(
                    f"BallScrewDrive: {name} damps at rest with {pole:.4g} 1/s, more than an "
                    "explicit step of longest_dt = "
                    f"{self.longest_dt:g} s can follow; raise its transition_velocity, or lower "
                    f"longest_dt to {RK4_RADIUS / pole:.3g}"
                )

    def check(self, task: Task) -> None:
        if self.lead_error is None or not known(self):
            return
        with jax.ensure_compile_time_eval():  # the check may be made inside `jit`
            resonance = float(jnp.max(self.resonance))
        angle = 2 * math.pi * resonance * task.dt
        if angle > self.substeps:
            raise ValueError(
                f"BallScrewDrive: substeps = {self.substeps} of dt = {task.dt:g} s cannot follow "
                f"the resonance of {resonance:.4g} Hz, by which the lead error acts; allowed are "
                f"{math.ceil(angle)} or more"
            )

    @property
    def antiresonance(self) -> Array:
        """() sqrt(k_s / m_T) / 2 pi [Hz], undamped.

        There the table takes all of the motor's force.
        """
        return jnp.sqrt(self.stiffness / self.table_mass) / (2 * jnp.pi)

    @property
    def resonance(self) -> Array:
        """() sqrt(k_s (m_T + m_M) / (m_M m_T)) / 2 pi [Hz], undamped, of the free drive."""
        m_M, m_T = self.motor_mass, self.table_mass
        return jnp.sqrt(self.stiffness * (m_T + m_M) / (m_M * m_T)) / (2 * jnp.pi)

    def mechanics(self) -> StateSpace:
        """Force [N] to x_M and x_T [m] without friction and lead error, in continuous time.

        The current loop is included.
        """
        m_M, m_T, k, c = self.motor_mass, self.table_mass, self.stiffness, self.damping
        lag = 0.0 if self.current_bandwidth is None else 2 * jnp.pi * self.current_bandwidth
        A = [
            [0.0, 1.0, 0.0, 0.0, 0.0],
            [-k / m_M, -(c + self.motor_damping) / m_M, k / m_M, c / m_M, 1 / m_M],
            [0.0, 0.0, 0.0, 1.0, 0.0],
            [k / m_T, c / m_T, -k / m_T, -(c + self.table_damping) / m_T, 0.0],
            [0.0, 0.0, 0.0, 0.0, -lag],
        ]
        n = 4 if self.current_bandwidth is None else 5
        B = [0.0, 1 / m_M, 0.0, 0.0] if n == 4 else [0.0, 0.0, 0.0, 0.0, lag]
        return StateSpace(jnp.array(A)[:n, :n], jnp.array(B)[:, None], np.eye(n)[[0, 2]])

    def transmission(self) -> tuple[Array, Array]:
        """Numerator (2,) and denominator (3,) of P_Z(s), from x_M to x_T, high order first.

            P_Z = (c_s s + k_s) / (m_T s^2 + (c_s + c_T) s + k_s)

        This is MILC 2024, eq. 12, with c_T for its c_M.
        """
        return jnp.stack([self.damping, self.stiffness]), jnp.stack(
            [self.table_mass, self.damping + self.table_damping, self.stiffness]
        )

    def linear(self, dt: float) -> StateSpace:
        """The drive without friction, lead error, limit and encoder step, sampled at dt [s].

        It leads from velocity command to both positions; the speed loop is closed, the position
        loop open. This is what a model-based scheme is given. It is differentiable in every
        parameter.
        """
        absent: dict[str, Value] = dict.fromkeys(
            (
                "force_limit",
                "encoder_step",
                "motor_friction",
                "table_friction",
                "lead_error",
                "compensation",
                "linear_part",
            )
        )
        plant = dataclasses.replace(self, **absent, dt=0.0).sampled(dt)
        rest, step, output = flat(plant, dt)
        A, B = jax.jacfwd(step, (0, 1))(rest, jnp.zeros(1))
        return StateSpace(A, B, jax.jacfwd(output)(rest), dt=dt)

    def sampled(self, dt: float) -> BallScrewDrive:
        """The drive for sample time dt.

        Raises ValueError for dt beyond `longest_dt` where there is friction.
        """
        if self.motor_friction is not None or self.table_friction is not None:
            allowed, note = f"(0, {self.longest_dt * (1 + 1e-9)}]", " with friction, see longest_dt"
            require("BallScrewDrive", "dt", dt, allowed, " s", note=note)
        if self.dt:
            return matching(self, dt)
        mechanics, h = self.mechanics(), dt if self._is_linear() else dt / self.substeps
        return dataclasses.replace(
            self, linear_part=propagator(mechanics.A, mechanics.B, h), dt=float(dt)
        )

    def initial_state(self) -> DriveState:
        n = 4 if self.current_bandwidth is None else 5
        return DriveState(
            jnp.zeros_like(self.table_mass, shape=(n,)), *(jnp.zeros_like(self.table_mass),) * 2
        )

    def step(self, x: DriveState, u: Array, dt: float) -> DriveState:
        force, integral, measured = self._speed_loop(x, u[0], dt)
        linear = cast(Propagator, self.linear_part)
        if self._is_linear():
            E, F = linear.whole
            return DriveState(product(E, x.mechanics) + F[:, 0] * force, integral, measured)
        one = partial(exponential_runge_kutta, linear, self._nonlinear)
        mechanics, n = x.mechanics, self.substeps
        mechanics = lax.fori_loop(0, n, lambda _, m: one(m, force[None], dt / n), mechanics)
        return DriveState(mechanics, integral, measured)

    def _is_linear(self) -> bool:
        """Whether the mechanics are, for a given force."""
        parts = (self.motor_friction, self.table_friction, self.lead_error)
        return all(part is None for part in parts)

    def output(self, x: DriveState) -> Array:
        return 1e3 * jnp.stack([x.mechanics[0], x.mechanics[2]])

    def _speed_loop(self, x: DriveState, u: Array, dt: float) -> Tree:
        """The force commanded at a sample [N], the integral and the measured position."""
        position = 1e3 * x.mechanics[0]
        if self.encoder_step is not None:
            position = quantise(position, self.encoder_step)
        command = self.command_scale * u
        deviation = command - (position - x.measured) / dt
        integral = x.integral + self.speed_integral_gain * dt * deviation
        ahead = 0.0 if self.compensation is None else self.compensation.at(1e-3 * command)
        force = self.force_gain * (self.speed_gain * deviation + integral) + ahead
        if self.force_limit is not None:
            winding = (jnp.abs(force) > self.force_limit) & (force * deviation > 0)
            integral = jnp.where(winding, x.integral, integral)
            force = jnp.clip(force, -self.force_limit, self.force_limit)
        return force, integral, position

    def _nonlinear(self, mechanics: Array) -> Array:
        """What friction and lead error add to the rates of the mechanics."""
        x_M, v_M, x_T, v_T = mechanics[:4]
        on_motor, on_table = jnp.zeros_like(v_M), jnp.zeros_like(v_T)
        if self.motor_friction is not None:
            on_motor = on_motor - self.motor_friction.force(v_M)
        if self.table_friction is not None:
            on_table = on_table - self.table_friction.force(v_T)
        if self.lead_error is not None:
            lead, slope = self.lead_error.at(x_M)
            linear = self.stiffness * (x_M - x_T) + self.damping * (v_M - v_T)
            spring = linear + self.stiffness * lead + self.damping * slope * v_M
            on_motor = on_motor + linear - spring * (1.0 + slope)
            on_table = on_table + spring - linear
        still = jnp.zeros_like(v_M)
        return jnp.stack(
            [
                still,
                on_motor / self.motor_mass,
                still,
                on_table / self.table_mass,
                *([still] * (len(mechanics) - 4)),
            ]
        )
