"""The piezo fast tool servo (Xu 2024, eq. 1 to 4).

It has a servo, an amplifier, hysteresis, creep, a flexible mode, and the forces on its tool.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from typing import NamedTuple, TypeVar

import jax.numpy as jnp
import numpy as np
from jax import lax

from ..pytree.aliases import Array, Leaf, Tree
from ..pytree.fields import child, leaf, pytree, scalar, static
from ..pytree.needs import known
from ..pytree.ranges import need_one_of, require
from .hysteresis import BoucWen, Dahl, InputHysteresis
from .integration import Propagator, exponential_runge_kutta, propagator
from .linear import StateSpace, matching
from .plant import Plant

# Xu 2024, section 5.2: G(s) = b / (s^2 + a2 s + a1) [um/V], amplifier included
A1, A2, B = 2.413e6, 70.16, 2.229e7
AMPLIFIER_GAIN = 20.0
STIFFNESS, MASS = 1.0, 1e6 / A1  # N/um, chosen, and the kg that make a1
SAMPLES_PER_PERIOD = 5


class ServoCoefficients(NamedTuple):
    """y'' = -a1 y - a2 y' + b u + f (Xu 2024, eq. 4): what a model-based scheme is given.

    a1: () [1/s^2]
    a2: () [1/s]
    b:  () [um/(V s^2)]
    """

    a1: Array
    a2: Array
    b: Array


@pytree
class FlexibleMode:
    """A resonance beside the servo's, which the second-order model leaves out (Xu 2024, sec. 5.2).

        G_mode(s) = share G(0) w^2 / (s^2 + 2 zeta w s + w^2), added to G(s)

    frequency: () w / 2 pi [Hz]
    damping:   () zeta
    share:     () of the servo's static deflection. Positive: an antiresonance lies between the two
               resonances (drive and encoder move alike). Negative: there is none, and the phase
               goes on falling

    The mode is excited by the drive, not by forces on the tool.
    """

    frequency: Leaf = scalar(interval="(0, inf)")
    damping: Leaf = scalar(interval="(0, 1)")
    share: Leaf = scalar()


@pytree
class Creep:
    """The piezo goes on extending under a held voltage v.

        tau_i y_i' = share_i G(0) v - y_i, summed and added to the output

    A few operators spaced by decades stand for the logarithmic law y (1 + c log10(t / t_0)), each
    with the share c.

    shares:         (n,) of the servo's static deflection
    time_constants: (n,) tau [s]
    """

    shares: Leaf = leaf()
    time_constants: Leaf = leaf(interval="(0, inf)")

    def __post_init__(self) -> None:
        _need_alike(self, "shares", "time_constants")


@pytree
class PeriodicForce:
    """Force on the tool against +y that repeats in each trial.

        F(t) = sum_i a_i sin(2 pi f_i t + phase_i), t from the start of the trial

    amplitudes:  (n,) [N]
    frequencies: (n,) [Hz]
    phases:      (n,) [rad]
    """

    amplitudes: Leaf = leaf()
    frequencies: Leaf = leaf(interval="(0, inf)")
    phases: Leaf = leaf()

    def __post_init__(self) -> None:
        _need_alike(self, "amplitudes", "frequencies", "phases")


@pytree
class CuttingForce:
    """Force of the cut against +y, proportional to the depth of cut.

        F(y) = K p(depth + y),    p(d) = (d + sqrt(d^2 + blur^2)) / 2, a smooth max(d, 0)

    It acts while the tool is in the workpiece.

    stiffness: () K, force per depth of cut [N/um]
    depth:     () of cut at y = 0 [um]
    blur:      () width of the transition at the surface [um], not less than the tool moves in a
               step of the integrator
    """

    stiffness: Leaf = scalar(interval="[0, inf)")
    depth: Leaf = scalar()
    blur: Leaf = scalar(default=0.5, interval="(0, inf)")

    def force(self, position: Array) -> Array:
        """The force () [N] at a position () [um]."""
        d = self.depth + position
        return self.stiffness * (d + jnp.sqrt(d * d + self.blur**2)) / 2


@pytree
class FastToolServo(Plant):
    """Piezo stack with amplifier and flexure, from voltage [V] to tool position [um].

        m y'' + k_c y' + k_f y = T k_b v - F_friction - F_cut(y) - F_load - F_periodic(t)
        v = u - H(u)

    This is Xu 2024, eq. 1 to 3.

    mass:       () m [kg]
    damping:    () k_c [N s/um]
    stiffness:  () k_f [N/um]
    conversion: () T, force per volt at the piezo [N/V]
    amplifier_gain: () k_b
    amplifier_bandwidth: () of a first-order lag after v [Hz]
    load:       () constant force against +y [N]
    drift:      () of the output [um/s]
    hysteresis: H, a `BoucWen` or `Dahl` of the voltage, z in V
    friction:   a `BoucWen` or `Dahl` of the position, z in N
    mode, creep: added to y
    cutting, periodic: forces against +y
    substeps:   equal steps of the integrator in a sample
    longest_dt: sample times beyond it are refused [s]

    None leaves a part out, and an absent part costs nothing. A disturbance that is given as a
    signal, such as Xu 2024, Fig. 10, belongs in `Disturbance`.

    Printed are only the ratios a1 = k_f/m, a2 = k_c/m and b = k_b T/m, see `coefficients`; b
    contains the amplifier's 20. Chosen is k_f = 1 N/um, so that the 1 N of Xu 2024, Table 2, moves
    the free tool by 1 um, 5 % of its 20 um. Then m = 0.414 kg and T = 0.462 N/V.

    A piezo is hysteretic between voltage and charge, hardly between charge and force (Goldfarb and
    Celanovic 1997), so H belongs to the voltage. As u is held over a sample, z jumps with it and
    rests: this takes one exact update a sample. H acts on u ahead of the amplifier's lag. The slope
    A of a small stroke makes the static gain (1 - A) T k_b / k_f; that of a large stroke tends to T
    k_b / k_f. `friction` is for guides, or for H as a force of the position (Xu and Li 2010, with
    Dahl's model); it goes on changing within the sample.

    All that is linear is exact at any sample time; friction and cutting force are integrated, see
    `sampled`.

    Raises ValueError, where the values are known, for a `longest_dt` above a fifth of the period of
    the fastest mode (samples farther apart hardly show the oscillation that a scheme has to damp),
    or a hysteresis with A >= 1, which would reverse the gain.
    """

    input_names = ("voltage",)
    output_names = ("position",)

    mass: Leaf = scalar(default=MASS, interval="(0, inf)")
    damping: Leaf = scalar(default=1e-6 * A2 * MASS, interval="[0, inf)")
    stiffness: Leaf = scalar(default=STIFFNESS, interval="(0, inf)")
    conversion: Leaf = scalar(default=1e-6 * B * MASS / AMPLIFIER_GAIN, interval="(0, inf)")
    amplifier_gain: Leaf = scalar(default=AMPLIFIER_GAIN, interval="(0, inf)")
    amplifier_bandwidth: Leaf | None = scalar(default=None, interval="(0, inf)", optional=True)
    load: Leaf | None = scalar(default=None, optional=True)
    drift: Leaf | None = scalar(default=None, optional=True)
    hysteresis: BoucWen | Dahl | None = child(default=None)
    friction: BoucWen | Dahl | None = child(default=None)
    mode: FlexibleMode | None = child(default=None)
    creep: Creep | None = child(default=None)
    cutting: CuttingForce | None = child(default=None)
    periodic: PeriodicForce | None = child(default=None)
    substeps: int = static(default=1, interval="[1, 1e4]", whole=True)
    longest_dt: float = static(default=2e-4, interval="(0, inf)")

    def __post_init__(self) -> None:
        if not known(self):
            return
        parts = (
            (self.friction, "initial_slope"),
            (self.cutting, "stiffness"),
            (self.mode, "frequency"),
            (self.periodic, "frequencies"),
        )
        sprung, cut, *forced = (
            0.0 if part_ is None else getattr(part_, name) for part_, name in parts
        )
        resonance = np.sqrt(1e6 * (self.stiffness + sprung + cut) / self.mass) / (2 * np.pi)
        fastest = max(float(np.max(f, initial=0.0)) for f in (resonance, *forced))
        longest = 1 / (SAMPLES_PER_PERIOD * fastest)
        if self.longest_dt > longest * (1 + 1e-9):
            raise ValueError(
                f"FastToolServo: longest_dt = {self.longest_dt:g} s leaves "
                f"{1 / (self.longest_dt * fastest):.3g} samples a period of the "
                f"fastest mode, {fastest:.4g} Hz; its allowed range with these parameters is (0, "
                f"{longest:.3g}]"
            )
        if self.hysteresis is not None:
            name, slope = "hysteresis.initial_slope", np.max(self.hysteresis.initial_slope)
            require("FastToolServo", name, slope, "(0, 1)", note=", in V of z per V")

    @property
    def coefficients(self) -> ServoCoefficients:
        """a1, a2, b of these parameters, each ()."""
        per_newton = 1e6 / self.mass
        return ServoCoefficients(
            self.stiffness * per_newton,
            self.damping * per_newton,
            self.amplifier_gain * self.conversion * per_newton,
        )

    def linear(self) -> StateSpace:
        """The plant in continuous time without hysteresis and cutting force.

        Its friction is a spring of the friction's initial slope. The states are position, and speed
        over w = (k_f/m)^(1/2), both in um, since exp(A dt) of a badly scaled A loses digits. Then
        follow, for the parts that are present: friction z [N], amplifier [V], position and scaled
        speed of the mode [um], creep [um], a sine and a cosine of each periodic force [N], and for
        load or drift a constant 1 and the drift [um]. What the input does not drive starts from x0.
        """
        a1, a2, b = self.coefficients
        w = jnp.sqrt(a1)
        gain, per_newton = b / a1, 1e6 / self.mass / w
        new = itertools.count(2).__next__
        u = -1  # the last column of [A B]
        A: dict[tuple[int, int], Leaf] = {(0, 1): w, (1, 0): -w, (1, 1): -a2}
        start: dict[tuple[int], Leaf] = {}
        outputs = [0]
        if self.friction is not None:
            z = new()
            A |= {(1, z): -per_newton, (z, 1): w * self.friction.initial_slope}
        if self.amplifier_bandwidth is not None:
            v, pole = new(), 2 * math.pi * self.amplifier_bandwidth
            A |= {(v, v): -pole, (v, u): pole}
            u = v
        A[1, u] = b / w
        if self.mode is not None:
            x, speed, w = new(), new(), 2 * math.pi * self.mode.frequency
            A |= {
                (x, speed): w,
                (speed, x): -w,
                (speed, speed): -2 * self.mode.damping * w,
                (speed, u): self.mode.share * gain * w,
            }
            outputs.append(x)
        if self.creep is not None:
            for share, tau in zip(self.creep.shares, self.creep.time_constants, strict=True):
                x = new()
                A |= {(x, x): -1 / tau, (x, u): share * gain / tau}
                outputs.append(x)
        if self.periodic is not None:
            forces = self.periodic
            for a, f, phase in zip(
                forces.amplitudes, forces.frequencies, forces.phases, strict=True
            ):
                sine, cosine, w = new(), new(), 2 * math.pi * f
                A |= {(sine, cosine): w, (cosine, sine): -w, (1, sine): -per_newton}
                start |= {(sine,): a * jnp.sin(phase), (cosine,): a * jnp.cos(phase)}
        if self.load is not None or self.drift is not None:
            one = new()
            start[one,] = 1.0
            if self.load is not None:
                A[1, one] = -per_newton * self.load
            if self.drift is not None:
                x = new()
                A[x, one] = self.drift
                outputs.append(x)
        n = new()
        A_B = _filled(A, (n, n + 1), self.mass)
        C = _filled({(0, x): 1.0 for x in outputs}, (1, n), self.mass)
        return StateSpace(
            A_B[:, :n], A_B[:, n:], C, _filled(start, (n,), self.mass) if start else None
        )

    def continuous(self) -> StateSpace:
        return self.linear()

    def sampled(self, dt: float) -> Plant:
        """The plant for sample time dt: a plain `StateSpace` as long as it is linear.

        Under a cutting force the error falls as (dt / substeps)^4; with friction as its square,
        because of the kink where the motion turns. Raises ValueError for dt beyond `longest_dt`.
        """
        allowed = f"(0, {self.longest_dt * (1 + 1e-9)}]"
        require("FastToolServo", "dt", dt, allowed, " s", note=", see longest_dt")
        linear = self.linear()
        plant: StateSpace | ForcedServo = linear.sampled(dt)
        if self.friction is not None or self.cutting is not None:
            steps = propagator(linear.A, linear.B, dt / self.substeps)
            plant = ForcedServo(linear, steps, self, dt)
        return plant if self.hysteresis is None else InputHysteresis(plant, self.hysteresis)


@pytree
class ForcedServo(Plant):
    """A `FastToolServo` with friction or cutting force, for one sample time.

    linear:     its linear part in continuous time
    propagator: of that linear part
    """

    linear: StateSpace = child()
    propagator: Propagator = child()
    servo: FastToolServo = child()
    dt: float = static(default=0.0)

    def sampled(self, dt: float) -> ForcedServo:
        return matching(self, dt)

    def initial_state(self) -> Tree:
        return self.linear.initial_state()

    def step(self, x: Tree, u: Array, dt: float) -> Tree:
        n, h = self.servo.substeps, self.dt / self.servo.substeps
        return lax.fori_loop(
            0, n, lambda _, x: exponential_runge_kutta(self.propagator, self._nonlinear, x, u, h), x
        )

    def output(self, x: Tree) -> Array:
        return self.linear.output(x)

    def _nonlinear(self, x: Tree) -> Array:
        """(n,) what friction and cutting force add to the rates of the linear part."""
        servo, rates, w = self.servo, jnp.zeros_like(x), jnp.sqrt(self.servo.coefficients.a1)
        if servo.cutting is not None:
            rates = rates.at[1].set(-1e6 / servo.mass / w * servo.cutting.force(self.output(x)[0]))
        if servo.friction is not None:
            speed, z = w * x[1], x[2]
            slope = servo.friction.slope(z, jnp.where(speed < 0, -1.0, 1.0))
            rates = rates.at[2].set((slope - servo.friction.initial_slope) * speed)
        return rates


def fast_tool_servo(form: str = "identified") -> FastToolServo:
    """The servo of Xu 2024 in one of two forms.

        identified  G(s) of section 5.2, linear
        full        with what the section names and leaves out, at values that are chosen and wait
                    for a fit: Bouc-Wen hysteresis (a loop as wide as 8 % of the stroke at 20 um,
                    z_max = 0.25 V), a mode that raises the gain at 900 Hz by 40 %, and creep of
                    1.5 % a decade of time

    In the full form the conversion is 1 / (1 - A) larger, so that G(s) is the response to small
    strokes, with which it was identified. The amplifier is a constant, as in section 2.2. Loads and
    cutting are for the task to add. Raises ValueError for another form.
    """
    need_one_of("fast_tool_servo", "form", form, ("identified", "full"))
    if form == "identified":
        return FastToolServo()
    A = 0.2
    return FastToolServo(
        conversion=1e-6 * B * MASS / AMPLIFIER_GAIN / (1 - A),
        hysteresis=BoucWen(initial_slope=A, beta=0.7, gamma=0.1),
        mode=FlexibleMode(frequency=900.0, damping=0.03, share=0.005),
        creep=Creep(shares=(0.015, 0.015), time_constants=(0.05, 0.5)),
    )


Index = TypeVar("Index", bound=tuple[int, ...])


def _filled(entries: Mapping[Index, Leaf], shape: tuple[int, ...], like: Array) -> Array:
    """Zeros of that shape and the type of `like`, with the entries {index: value}."""
    blank = jnp.zeros_like(like, shape=shape)
    return blank.at[tuple(np.array(list(entries)).T)].set(
        jnp.stack([jnp.asarray(a, blank.dtype) for a in entries.values()])
    )


def _need_alike(tree: Tree, *names: str) -> None:
    """Raises ValueError unless the named fields have one shape (n,)."""
    shapes = {name: np.shape(getattr(tree, name)) for name in names}
    if len(set(shapes.values())) > 1 or not shapes[names[0]]:
        raise ValueError(f"{type(tree).__name__}: {shapes} must have one shape (n,)")
