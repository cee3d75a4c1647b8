"""Feedforward inversion of a discrete system for a reference that is known in advance.

This is the prefilter r_0 = r_d / P_Z of multivariable ILC. The design is host code in float64
(zeros, poles and a gain, `Factors`); what it returns is a `Filter` that is pure, batched and
differentiable. Of a drive whose *input* is held over a sample, y_T/y_M from sample to sample is
`output_ratio(drive)`. Sampling P_Z(s) by itself would hold the motor's position instead, half a
sample of delay that no drive has: the table then leads by velocity dt / 2.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy

from ..plants import StateSpace
from ..plants.from_python_control import system_matrices
from ..pytree.aliases import Leaf
from ..pytree.fields import leaf, pytree, static
from ..pytree.needs import known
from ..pytree.ranges import need_one_of, require
from ..runtime.lanes import over_samples
from .zero_phase import Filter

EPS = np.finfo(float).eps
# zeros nearer to the unit circle count as on it: they would need more than a million samples of
# rest
CIRCLE = 1e-6


class Inverse(Filter):
    """A prefilter designed for one sample time `dt` [s].

    As it undoes a plant's phase, it is not zero-phase. Raises ValueError at another sample time.
    """

    dt: float
    advance: int

    def check(self, samples: int, dt: float) -> None:
        if known(dt) and abs(self.dt - dt) > 1e-9 * dt:
            raise ValueError(
                f"{type(self).__name__}: dt = {dt:.10g} s is not that of the design; allowed is "
                f"dt = {self.dt:.10g}"
            )
        for name, columns in (("forward", (5,)), ("backward", (5,)), ("gain", ())):
            shape = np.shape(getattr(self, name, np.zeros((0, 5))))
            if len(shape) != 2 * len(columns) or shape[-1:] != columns:
                raise ValueError(
                    f"{type(self).__name__}: {name} has shape {shape}; allowed is "
                    f"{'(m, 5)' if columns else '()'}"
                )
        require(
            type(self).__name__, "advance", self.advance, f"[{-samples}, {samples}]", whole=True
        )


@pytree
class StableInverse(Inverse):
    """Exact inverse by stable inversion (Devasia, Chen, Paden 1996).

    Each zero is recursed in the direction of time in which it decays:

        P = K z^-a B_s B_u / A,   r_0 = z^a A / (K B_s B_u) r

    z^a A is a non-causal sum, 1/B_s runs forward and 1/B_u backward in time. The factors are 1 - p
    z^-1 in A, 1 - z_i z^-1 (|z_i| < 1) in B_s, and 1 - z / z_i (|z_i| > 1) in B_u; a = relative
    degree + order of B_u.

    forward:   (m, 5) sections b0 b1 b2 a1 a2 in z^-1, A / B_s
    backward:  (m', 5) the same in z, 1 / B_u
    gain:      () of both
    advance:   a, samples by which the sum looks ahead
    dt:        sample time of the design [s]
    extension: samples by which the trial is continued beyond its end; the error there is
               (max |z_s| / min |z_u|)^extension

    Beyond its ends the reference keeps its end values for ever, and each recursion starts in the
    steady state that goes with it. What r_0 would be before the first sample is cut off: P starts
    in the steady state of r[0], and y deviates from r by the pre-actuation that is missing. The
    deviation falls as |z_i|^-n where r rests n + a samples before it moves (`pre_actuation`: n +
    a). What is cut off at the end does no harm within the trial. For room to pre-actuate, pad the
    reference with its end values, and cut later.

    A zero at distance delta from the unit circle has its price. To reach 1e-6 it takes 14 / delta
    samples of r_0, before the motion if the zero is outside, ringing after it if it is inside. The
    zero's frequency (near z = -1, from sample to sample) is amplified by 1 / delta, and noise and
    model error with it.
    """

    forward: Leaf = leaf()
    backward: Leaf = leaf()
    gain: Leaf = leaf()
    advance: int = static(whole=True)
    dt: float = static(interval="(0, inf)")
    extension: int = static(default=0, interval="[0, 1e7]", whole=True)

    def __post_init__(self):
        _need_rows(self)

    def __call__(self, signal, dt):
        self.check(signal.shape[0], dt)
        forced = self.gain * _run_ahead(self.forward, signal, self.advance, self.extension)
        if len(self.backward):
            forced = run_sections(self.backward, forced[::-1])[::-1]
        return forced[: signal.shape[0]]

    def pre_actuation(self, tolerance: float = 1e-6) -> int:
        """Samples of rest that the reference needs before it moves.

        What is cut off before the first sample has then decayed to `tolerance`.
        """
        roots = [np.roots([1.0, a1, a2]) for *_, a1, a2 in np.asarray(self.backward)]
        slowest = np.max(np.abs(np.concatenate([[], *roots])), initial=0.0)
        decay = int(np.ceil(np.log(tolerance) / np.log(slowest))) if slowest else 0
        return max(self.advance, 0) + decay


@pytree
class ZPETC(Inverse):
    """Zero phase error tracking control (Tomizuka 1987).

    Zeros that are not cancelled are met by their mirror images:

        P(z) = K B_c(z) B_u(z) / A(z),   r_0 = A(z) B_u(1/z) / (K B_c(z) B_u(1)^2) r
        y = P r_0 = |B_u|^2 / B_u(1)^2 r

    B_u holds the zeros outside the unit circle, on it, or beyond the `radius` of the design. y has
    no phase error at any frequency and the right size at frequency 0. The size departs from 1 as
    frequency squared, and goes to 0 at a zero on the circle. The filter looks ahead by relative
    degree + order of B_u, and no further. Beyond its ends the reference keeps its end values.

    forward: (m, 5) sections b0 b1 b2 a1 a2 in z^-1, A B_u(1/z) / B_c
    gain:    () of the rest
    advance: samples of look-ahead
    dt:      sample time of the design [s]
    """

    forward: Leaf = leaf()
    gain: Leaf = leaf()
    advance: int = static(whole=True)
    dt: float = static(interval="(0, inf)")

    def __post_init__(self):
        _need_rows(self)

    def __call__(self, signal, dt):
        self.check(signal.shape[0], dt)
        return self.gain * _run_ahead(self.forward, signal, self.advance, 0)


def _need_rows(inverse: Inverse) -> None:
    """Give an empty list of sections, as a file may have it, the shape of no rows."""
    for name in ("forward", "backward"):
        if np.shape(vars(inverse).get(name, 0.0)) == (0,):
            object.__setattr__(inverse, name, np.zeros((0, 5)))


def stable_inverse(
    system, dt: float | None = None, *, extension: int | None = None
) -> StableInverse:
    """The exact inverse of a system without zeros on the unit circle.

    system, dt: as in `factors`
    extension:  None for as many samples as leave no more than rounding

    Raises ValueError as `factors`, and naming the zero that lies on the unit circle.
    """
    P = factors(system, dt)
    distance = np.abs(P.zeros) - 1
    for zero in P.zeros[np.abs(distance) < CIRCLE]:
        raise ValueError(
            f"stable_inverse: the zero z = {zero:.6g} lies on the unit circle, where no direction "
            "of time lets it decay; "
            f"allowed is a distance of {CIRCLE:g}; ZPETC can do without cancelling it (but z = 1)"
        )
    inside, outside = P.zeros[distance < 0], P.zeros[distance > 0]
    if extension is None:
        ratio = np.max(np.abs(inside), initial=EPS) / np.min(np.abs(outside), initial=np.inf)
        extension = len(P.poles) + int(np.ceil(np.log(EPS) / np.log(ratio))) if len(outside) else 0
    backward = _sections(np.zeros(0), 1 / outside) if len(outside) else np.zeros((0, 5))
    gain = 1 / (P.gain * np.prod(-outside).real)
    return StableInverse(
        _sections(P.poles, inside), backward, gain, len(P.poles) - len(inside), P.dt, extension
    )


def zpetc(system, dt: float | None = None, *, radius: float = 1.0) -> ZPETC:
    """Zero phase error tracking: any system whose DC gain is not zero.

    system, dt: as in `factors`
    radius:     zeros within it are cancelled, in (0, 1]; less than 1 leaves out lightly damped
                ones, which would ring in r_0

    Raises ValueError as `factors`, for a radius outside its range, and for a zero at z = 1.
    """
    P = factors(system, dt)
    require("zpetc", "radius", radius, "(0, 1]")
    if np.any(np.abs(P.zeros - 1) < CIRCLE):
        raise ValueError(
            "zpetc: the system has a zero at z = 1; allowed is a DC gain other than 0, which ZPETC "
            "scales to 1"
        )
    cancelled = np.abs(P.zeros) < min(radius, 1 - CIRCLE)
    inside, mirrored = P.zeros[cancelled], P.zeros[~cancelled]
    gain = np.real(np.prod(-mirrored) / np.prod(1 - mirrored) ** 2) / P.gain
    return ZPETC(
        _sections(np.append(P.poles, 1 / mirrored), inside), gain, len(P.poles) - len(inside), P.dt
    )


def inverse(
    system, dt: float | None = None, method: str = "stable", **options
) -> StableInverse | ZPETC:
    """`stable_inverse` or `zpetc` by name, with its options.

    Raises ValueError for another method.
    """
    need_one_of("inverse", "method", method, ("stable", "zpetc"))
    return (stable_inverse if method == "stable" else zpetc)(system, dt, **options)


def _sections(zeros, poles):
    """(m, 5) rows b0 b1 b2 a1 a2 of prod (1 - zeros_i z^-1) / prod (1 - poles_i z^-1)."""
    return np.delete(scipy.signal.zpk2sos(zeros, poles, 1.0), 3, axis=1)


def _run_ahead(sections, signal, advance, extension):
    """(N + extension, n) the sections' output `advance` samples later; the ends are held."""
    before, start = max(-advance, 0), max(advance, 0)
    held = jnp.pad(signal, ((before, max(advance + extension, 0)), (0, 0)), mode="edge")
    return run_sections(sections, held)[start : start + signal.shape[0] + extension]


def run_sections(sections, signal) -> jax.Array:
    """Second-order sections over a (N, n) signal, from the steady state of its first sample."""
    settled, level = [], signal[0]
    for b0, b1, b2, a1, a2 in sections:
        gain = (b0 + b1 + b2) / (1.0 + a1 + a2)
        settled.append(((gain - b0) * level, (b2 - a2 * gain) * level))
        level = gain * level

    def tick(states, x):
        following = []
        for (b0, b1, b2, a1, a2), (s1, s2) in zip(sections, states, strict=True):
            y = b0 * x + s1
            following.append((b1 * x - a1 * y + s2, b2 * x - a2 * y))
            x = y
        return following, x

    return over_samples(tick, settled, signal)[1]


# Zeros and poles
# --------------------------------------------------------------------------------------------------


class Factors(NamedTuple):
    """P(z) = gain prod_i (z - zeros_i) / prod_i (z - poles_i), one input and one output.

    zeros: (m,) in conjugate pairs
    poles: (n,) in conjugate pairs; n - m is the relative degree, negative where P is improper
    gain:  of P
    dt:    sample time [s]
    """

    zeros: np.ndarray
    poles: np.ndarray
    gain: float
    dt: float


def factors(system, dt: float | None = None) -> Factors:
    """Zeros, poles and gain of a system with one input and one output.

    A continuous system is sampled with a zero-order hold. Common factors are not cancelled.

    system: jaxilc StateSpace, python-control StateSpace or TransferFunction (a discrete one may be
            improper), or Factors as they are
    dt:     sample time [s]; None for that of a discrete system

    Raises ValueError for a system that is not SISO, is zero, or whose sample time is open or not
    dt.
    """
    own, dt = _sample_time(system, dt)
    if isinstance(system, Factors):
        return system
    of_plant = isinstance(system, StateSpace)
    inputs = system.n_u if of_plant else system.ninputs
    outputs = system.n_y if of_plant else system.noutputs
    if (inputs, outputs) != (1, 1):
        raise ValueError(
            f"factors: the system has {inputs} inputs and {outputs} outputs; allowed is one of "
            "each, pick them: system[i, j]"
        )
    if own and hasattr(system, "num") and np.any(system.num[0][0]):
        above, below = (
            np.trim_zeros(np.atleast_1d(p[0][0]), "f") for p in (system.num, system.den)
        )
        return Factors(np.roots(above), np.roots(below), float(above[0] / below[0]), dt)
    A, B, C, D = _sampled(system, own, dt)
    zeros, gain = zeros_and_gain(A, B, C, D[0, 0])
    return Factors(zeros, np.linalg.eigvals(A), gain, dt)


def output_ratio(system, dt: float | None = None, *, above: int = 1, below: int = 0) -> Factors:
    """P_above / P_below of two outputs under one held input, N_above / N_below exactly.

    It is exact because the denominators of both are the same.

    system: StateSpace of jaxilc or python-control with one input, for example force to motor and
            table position
    dt:     as in `factors`

    Zeros outside the unit circle, sampling zeros among them, mean different things in the two
    numerators. The inverse divides by those in N_above, and so needs pre-actuation. It multiplies
    by those in N_below, which is a finite sum and needs nothing of the kind. The ratio as such is
    then unstable, but it is never run from y_below to y_above; both outputs come from the input.

    Raises ValueError as `factors`, and for several inputs or an output that does not exist.
    """
    own, dt = _sample_time(system, dt)
    A, B, C, D = _sampled(system, own, dt)
    if B.shape[1] != 1:
        raise ValueError(f"output_ratio: the system has {B.shape[1]} inputs; allowed is 1")
    if not {above, below} <= set(range(len(C))):
        raise ValueError(
            f"output_ratio: above = {above!r}, below = {below!r} are not both among the outputs "
            f"0..{len(C) - 1}"
        )
    (zeros, gain), (poles, scale) = (zeros_and_gain(A, B, C[[i]], D[i, 0]) for i in (above, below))
    return Factors(zeros, poles, gain / scale, dt)


def _sampled(system, own, dt):
    """A, B, C, D in discrete time, on the host."""
    if isinstance(system, StateSpace):
        matrices = system.A, system.B, system.C, np.zeros((system.n_y, system.n_u))
    else:
        matrices = system_matrices(system)
    A, B, C, D = (np.asarray(M, float) for M in matrices)
    if len(A):  # balanced, because a companion form would cost its zeros digits
        scale = scipy.linalg.matrix_balance(A, permute=False, separate=True)[1][0]
        A, B, C = A * scale / scale[:, None], B / scale[:, None], C * scale
    return (A, B, C, D) if own else scipy.signal.cont2discrete((A, B, C, D), dt)[:4]


def _sample_time(system, dt) -> tuple[float, float]:
    """The sample time of the system, 0 if it is continuous, and the sample time to work at."""
    if not isinstance(system, Factors | StateSpace):
        import control  # it takes longer to import than many a command

        if not isinstance(system, control.StateSpace | control.TransferFunction):
            raise ValueError(
                f"factors: {type(system).__name__} is not a jaxilc StateSpace, nor a StateSpace or "
                "TransferFunction of control"
            )
    own = system.dt
    if own is None or own is True:
        raise ValueError(
            f"factors: dt = {own} of the system leaves the sample time open; allowed are 0 "
            "(continuous) and a time in s"
        )
    if not own and not 0 < (dt or 0) < np.inf:
        raise ValueError(
            f"factors: dt = {dt} is outside the allowed range (0, inf) of the sample time [s] of a "
            "continuous system"
        )
    if own and dt and abs(own - dt) > 1e-9 * dt:
        raise ValueError(
            f"factors: the system is sampled at {own:.10g} s but dt = {dt:.10g} s; allowed is "
            f"dt = {own:.10g}"
        )
    return float(own), float(own or dt)


def zeros_and_gain(A, B, C, D):
    """Zeros of one output, and its first Markov parameter that is not zero, C A^(d-1) B, or D.

    The zeros are the eigenvalues of A - B (C A^(d-1) B)^-1 C A^d on the states of C x = ... = C
    A^(d-1) x = 0, where y stays 0 for d samples. (The generalised eigenvalues of the Rosenbrock
    pencil lose half the digits of a sampling zero.)
    """
    if D:
        return np.linalg.eigvals(A - B @ C / D), float(D)
    rows, bound = [C], np.abs(C)
    while not np.abs(rows[-1] @ B).item() > 10 * EPS * (bound @ np.abs(B)).item():
        rows, bound = [*rows, rows[-1] @ A], bound @ np.abs(A)
        if len(rows) > len(A):
            raise ValueError("factors: the system is zero")
    gain = (rows[-1] @ B).item()
    held = np.linalg.qr(np.vstack(rows).T, mode="complete")[0][:, len(rows) :]
    return np.linalg.eigvals(held.T @ (A - B @ (rows[-1] @ A) / gain) @ held), gain
