"""Zeros, poles and gain of a discrete system with one input and one output, on the host."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy

from ..plants import StateSpace
from ..plants.from_python_control import system_matrices

EPS = np.finfo(float).eps


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
    zeros, gain = _zeros_and_gain(A, B, C, D[0, 0])
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
    (zeros, gain), (poles, scale) = (_zeros_and_gain(A, B, C[[i]], D[i, 0]) for i in (above, below))
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
            f"factors: the system is sampled at {own:g} s but dt = {dt:g} s; allowed is dt = "
            f"{own:g}"
        )
    return float(own), float(own or dt)


def _zeros_and_gain(A, B, C, D):
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
