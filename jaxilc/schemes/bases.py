"""Basis functions: inputs that follow from a reference by a few parameters.

    u = Psi(r) theta

A law that learns theta in place of the samples of u serves references that it has not seen.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import ClassVar, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np

from ..plants.position import Harmonics, PositionMap, Splines, apart
from ..pytree.aliases import Array, Function, Leaf, Numbers, Tree, Value
from ..pytree.fields import child, leaf, need_decorated, pytree, scalar, static
from ..pytree.in_short import in_short
from ..pytree.needs import known, need_numbers
from ..pytree.ranges import require
from ..signals.task import Task

ORDERS = ("position", "velocity", "acceleration", "jerk", "snap")
SEEN = 0.1  # of a function of the position, whose largest value is about 1
MARGIN = 4  # samples beyond each end, which the differences of the highest order need


class Basis:
    """Functions of a reference, of which an input is a sum with the parameters theta as weights.

    A user's own basis is a subclass, decorated with `@pytree`, that overrides `columns` and
    `names`. Its fields are parameters of the basis, which may be tuned by gradient.
    """

    # `@pytree` makes a dataclass of each subclass
    __dataclass_fields__: ClassVar[dict[str, dataclasses.Field[Value]]]
    linear: ClassVar[bool] = True

    def __init__(self, *values: Value, **named: Value) -> None:
        need_decorated(type(self))

    @property
    def keeps(self) -> bool:
        """Whether a parameter stays whose function a trial does not see, in place of becoming 0."""
        return False

    def seen(self, r: Array, dt: float, inputs: int) -> Array:
        """(m,) 1 for each function that a trial tells something of, and 0 for those it does not."""
        return jnp.ones(len(self.names(r.shape[1], inputs)))

    def names(self, outputs: int, inputs: int) -> tuple[str, ...]:
        """(m) the names of the parameters theta."""
        raise NotImplementedError

    def columns(self, r: Array, dt: float, inputs: int) -> Array:
        """(N, inputs, m) the functions Psi of a reference r (N+1, n_y), of which each is an input.

        dt: sample time [s]
        """
        raise NotImplementedError

    def signal(self, theta: Array, r: Array, dt: float, inputs: int) -> Array:
        """(N, inputs) the input Psi(r) theta of the parameters theta (m,)."""
        return self.columns(r, dt, inputs) @ theta

    def regression(
        self, theta: Array, t: Array, push: Function, r: Array, dt: float, inputs: int
    ) -> tuple[Array, Array]:
        """(K, n) the target, and (K, n, m) the columns whose sum is to come near it.

        theta: (m,) parameters so far, of which only a basis that is not linear in theta makes use
        t: (K, n) signal that `push` of the input is to come near
        push: linear map from an input (N, inputs) to a signal (K, n)
        """
        return t, pushed(push, self.columns(r, dt, inputs))

    def check(self, task: Task) -> None:
        """Raises ValueError where the basis does not fit the task."""


def pushed(push: Function, columns: Array) -> Array:
    """(K, n, m) a linear map of each of the columns (N, inputs, m)."""
    return jax.vmap(push, in_axes=-1, out_axes=-1)(columns)


@pytree
class PolynomialBasis(Basis):
    """The reference and its derivatives (Lambrechts, Boerlage and Steinbuch 2005).

        u = theta_1 r' + theta_2 r'' + theta_3 r''' + theta_4 r'''' + theta_c tanh(r' / coulomb)

    The derivatives are central differences in the middle between the samples k and k+1, over which
    u[k] is held. Before and after the trial the reference rests; begin and end it at rest, or the
    jump of its velocity counts as an acceleration. Each input has parameters of its own for the
    reference of its own output, or, with `coupled`, for the references of all outputs.

    orders: the derivatives, of 0 (position), 1 (velocity), 2 (acceleration), 3 (jerk), 4 (snap)
    coulomb: () velocity up to which friction grows, > 0 [unit of y per s]; None: no friction
    lead: () time by which the functions are ahead of the reference [s]; None: none. Both have a
        gradient.
    coupled: whether each input has parameters for the references of all outputs
    """

    orders: tuple[int, ...] = static(default=(1, 2, 3, 4))
    coulomb: Leaf | None = leaf(default=None, interval="(0, inf)", optional=True)
    lead: Leaf | None = leaf(default=None, optional=True)
    coupled: bool = static(default=False)

    def __post_init__(self) -> None:
        allowed = all(type(order) is int and 0 <= order < len(ORDERS) for order in self.orders)
        if not allowed or len(set(self.orders)) != len(self.orders):
            raise ValueError(
                f"PolynomialBasis: orders = {self.orders}; allowed are different ones of 0 "
                "(position), 1 (velocity), 2 (acceleration), 3 (jerk) and 4 (snap)"
            )
        if not self.orders and self.coulomb is None:
            raise ValueError("PolynomialBasis: orders = () without coulomb leaves no function")
        need_numbers(self, "coulomb", "lead")

    def names(self, outputs: int, inputs: int) -> tuple[str, ...]:
        of_one = [ORDERS[order] for order in self.orders] + ["friction"] * (
            self.coulomb is not None
        )
        if self.coupled:
            return tuple(
                f"{f}[{i}<-{o}]" for i in range(inputs) for o in range(outputs) for f in of_one
            )
        return tuple(f if inputs == 1 else f"{f}[{i}]" for i in range(inputs) for f in of_one)

    def columns(self, r: Array, dt: float, inputs: int) -> Array:
        of_each = self._functions(jnp.asarray(r), dt)  # (N, n_y, p)
        if not self.coupled:
            return on_own_inputs(of_each)
        N = len(of_each)
        eye = jnp.eye(inputs, dtype=of_each.dtype)
        return jnp.einsum("kyp,ij->kijyp", of_each, eye).reshape(N, inputs, -1)

    def check(self, task: Task) -> None:
        if not self.coupled and task.inputs != task.outputs:
            raise ValueError(
                f"PolynomialBasis: coupled = False needs as many inputs as outputs, not "
                f"{task.inputs} and {task.outputs}; allowed is coupled = True"
            )
        if self.lead is not None and known(self) and abs(float(self.lead)) >= task.duration:
            raise ValueError(
                f"PolynomialBasis: lead = {float(self.lead):g} s is not shorter than the trial of "
                f"{task.duration:g} s"
            )

    def _functions(self, r: Array, dt: float) -> Array:
        """(N, n_y, p) the functions of the reference of each output."""
        held = jnp.pad(r, ((MARGIN, MARGIN), (0, 0)), mode="edge")
        found = [_difference(held, order, dt) for order in self.orders]
        if self.coulomb is not None:
            found.append(jnp.tanh(_difference(held, 1, dt) / self.coulomb))
        # the middle of the samples k and k+1 is row k + 2 of what is left of the margin
        first = MARGIN - 2
        of_each = jnp.stack(found, axis=-1)
        N = len(r) - 1
        if self.lead is None:
            return of_each[first : first + N]
        last = len(of_each) - 1
        at = jnp.clip(first + np.arange(N) + self.lead / dt, 0, last)
        before = jnp.clip(jnp.floor(at), 0, last - 1).astype(int)
        share = (at - before)[:, None, None]
        return (1 - share) * of_each[before] + share * of_each[before + 1]


def on_own_inputs(of_each: Array) -> Array:
    """(N, n, n p) functions (N, n, p) of each reference, for the input of the same number."""
    N, n, p = of_each.shape
    eye = jnp.eye(n, dtype=of_each.dtype)
    return jnp.einsum("kip,ij->kijp", of_each, eye).reshape(N, n, n * p)


def _difference(signal: Array, order: int, dt: float) -> Array:
    """(M - 5, n) a derivative of a signal (M, n), in the middle between its samples 2+k and 3+k."""
    M = len(signal)
    for _ in range(order // 2):
        signal = (signal[2:] - 2 * signal[1:-1] + signal[:-2]) / dt**2
    signal = signal[2 - order // 2 :][: M - 4]
    if order % 2:
        return (signal[1:] - signal[:-1]) / dt
    return (signal[1:] + signal[:-1]) / 2


@pytree
class PositionBasis(Basis):
    """Functions of the position where the reference is, so that what is learned is a map over it.

        u[k] = F(r + lead v, v),   r and v in the middle of the samples k and k+1

    An error that repeats in the position (cogging, commutation, the pitch of a screw, friction by
    place) needs the same map at any speed, so a map that was learned at one serves the others. Each
    input has a map of its own over the reference of its own output. A place that a trial does not
    visit keeps what was learned of it: the trial tells of a function that reaches a tenth in it.

    functions: `Harmonics` or `Splines` over the position
    turning: () velocity from which on forward and backward motion have maps apart, > 0 [unit of y
        per s]; None: one map
    lead: () time by which the map is ahead [s], such as a dead time that the model of the law does
        not have; None: none
    `map` makes a `PositionMap` of theta.
    """

    functions: Harmonics | Splines = child()
    turning: Leaf | None = scalar(default=None, interval="(0, inf)", optional=True)
    lead: Leaf | None = scalar(default=None, optional=True)

    @property
    def keeps(self) -> bool:
        return True

    def names(self, outputs: int, inputs: int) -> tuple[str, ...]:
        of_one = self.functions.names
        if self.turning is not None:
            of_one = tuple(f"{name} {way}" for way in ("forward", "backward") for name in of_one)
        return tuple(f if inputs == 1 else f"{f}[{i}]" for i in range(inputs) for f in of_one)

    def seen(self, r: Array, dt: float, inputs: int) -> Array:
        # what is hardly touched would follow from rounding and noise
        return jnp.where(jnp.max(jnp.abs(self.columns(r, dt, inputs)), (0, 1)) >= SEEN, 1.0, 0.0)

    def columns(self, r: Array, dt: float, inputs: int) -> Array:
        r = jnp.asarray(r)
        x, v = (r[1:] + r[:-1]) / 2, (r[1:] - r[:-1]) / dt
        x = x if self.lead is None else x + self.lead * v
        return on_own_inputs(apart(self.functions.at(x), v, self.turning))

    def check(self, task: Task) -> None:
        if task.inputs != task.outputs:
            raise ValueError(
                f"PositionBasis: the task has {task.inputs} inputs and {task.outputs} outputs; "
                "allowed are as many of each, one map for each axis"
            )

    def map(self, theta: Leaf) -> PositionMap:
        """The map of the parameters theta (m,) of one axis, as what is added to the input."""
        return PositionMap(self.functions, theta, self.turning)


def need_linear(owner: str, basis: Basis) -> None:
    """Raises ValueError for a basis whose input is not linear in theta."""
    if not basis.linear:
        name = type(basis).__name__
        raise ValueError(f"{owner}: a {name} is not linear in theta; give another or its numerator")


@pytree
class JoinedBasis(Basis):
    """The functions of several bases side by side, such as those of motion and of position.

    bases: two or more that are linear in theta; theta has the parameters of one after the other
    """

    bases: tuple[Basis, ...] = child()

    def __post_init__(self) -> None:
        for basis in self.bases:
            need_linear("JoinedBasis", basis)

    @property
    def keeps(self) -> bool:
        return any(basis.keeps for basis in self.bases)

    def seen(self, r: Array, dt: float, inputs: int) -> Array:
        return jnp.concatenate([basis.seen(r, dt, inputs) for basis in self.bases])

    def names(self, outputs: int, inputs: int) -> tuple[str, ...]:
        return tuple(name for basis in self.bases for name in basis.names(outputs, inputs))

    def columns(self, r: Array, dt: float, inputs: int) -> Array:
        return jnp.concatenate([one.columns(r, dt, inputs) for one in self.bases], axis=-1)

    def check(self, task: Task) -> None:
        for basis in self.bases:
            basis.check(task)


@pytree
class GivenBasis(Basis):
    """Functions of time that are given, such as measured inputs, splines or sines.

    They belong to one reference: unlike a basis of derivatives they do not follow another one.

    functions: (N, n_u, m) or, for one input, (N, m) [unit of u per unit of theta]
    """

    functions: Leaf = leaf()

    def __post_init__(self) -> None:
        if self.functions.ndim == 2:
            object.__setattr__(self, "functions", self.functions[:, None, :])
        if self.functions.ndim != 3 or not self.functions.size:
            raise ValueError(
                f"GivenBasis: functions has shape {self.functions.shape}; allowed are (N, m) and "
                "(N, n_u, m)"
            )

    def names(self, outputs: int, inputs: int) -> tuple[str, ...]:
        return tuple(f"function {i + 1}" for i in range(self.functions.shape[-1]))

    def columns(self, r: Array, dt: float, inputs: int) -> Array:
        return jnp.asarray(self.functions)

    def check(self, task: Task) -> None:
        if self.functions.shape[:2] != (task.N, task.inputs):
            raise ValueError(
                f"GivenBasis: functions has shape {self.functions.shape}; this task needs "
                f"({task.N}, {task.inputs}, m)"
            )


@pytree
class SelectedBasis(Basis):
    """Some functions of another basis, such as those that `select_basis` found to matter.

    basis: a basis that is linear in theta
    kept: the numbers of its functions that are kept, from 0
    """

    basis: Basis = child()
    kept: tuple[int, ...] = static()

    def __post_init__(self) -> None:
        need_linear("SelectedBasis", self.basis)
        good = all(type(i) is int and i >= 0 for i in self.kept)
        if not good or not self.kept or len(set(self.kept)) != len(self.kept):
            raise ValueError(
                f"SelectedBasis: kept = {self.kept}; allowed are different whole numbers from 0"
            )

    @property
    def keeps(self) -> bool:
        return self.basis.keeps

    def seen(self, r: Array, dt: float, inputs: int) -> Array:
        return self.basis.seen(r, dt, inputs)[np.array(self.kept)]

    def names(self, outputs: int, inputs: int) -> tuple[str, ...]:
        of_all = self.basis.names(outputs, inputs)
        return tuple(of_all[i] for i in self.kept)

    def columns(self, r: Array, dt: float, inputs: int) -> Array:
        return self.basis.columns(r, dt, inputs)[..., list(self.kept)]

    def check(self, task: Task) -> None:
        self.basis.check(task)
        count = len(self.basis.names(task.outputs, task.inputs))
        if max(self.kept) >= count:
            raise ValueError(
                f"SelectedBasis: kept = {self.kept}; allowed are numbers of the {count} functions, "
                f"0..{count - 1}"
            )


@pytree
class RationalBasis(Basis):
    """A rational feedforward (Bolder and Oomen 2015), u = B(theta_B) / A(theta_A) r.

        A = 1 + theta_A,1 d + theta_A,2 d^2 + ...,    d: central difference per time

    B is a polynomial basis, A has the same parameters for all inputs. u is not linear in theta. In
    each step of a law, theta is found by iterated weighting (Sanathanan and Koerner 1963): with the
    A of the step before, the columns B / A and -d^i t / A are linear in theta again, and their
    limit is where the weight 1/A and A agree. The law iterates so within each trial.

    1 / A is applied at each frequency of the reference, held before and after the trial: that is
    the inverse which stays bounded, forward in time for stable roots of A and backward for the
    others. Its gain is at most 1 / (2 `least`), so u is bounded at any theta.

    numerator: basis of B
    least: () > 0, regularises 1 / A as conj(A) / (|A|^2 + least^2)
    """

    numerator: PolynomialBasis = child()
    order: int = static(default=1, interval="[1, 4]", whole=True)
    least: Leaf = leaf(default=1e-4, interval="(0, 1)")
    linear = False

    def names(self, outputs: int, inputs: int) -> tuple[str, ...]:
        poles = tuple(f"pole {ORDERS[i + 1]}" for i in range(self.order))
        return self.numerator.names(outputs, inputs) + poles

    def check(self, task: Task) -> None:
        self.numerator.check(task)

    def signal(self, theta: Array, r: Array, dt: float, inputs: int) -> Array:
        b, a = theta[: -self.order], theta[-self.order :]
        return self._divided(self.numerator.columns(r, dt, inputs) @ b, a, dt)

    def columns(self, r: Array, dt: float, inputs: int) -> Array:
        """(N, inputs, m) the derivative of u by theta at theta = 0, where A is 1."""
        of_zeros = self.numerator.columns(r, dt, inputs)
        return jnp.concatenate(
            [of_zeros, jnp.zeros((*of_zeros.shape[:2], self.order), of_zeros.dtype)], axis=-1
        )

    def regression(
        self, theta: Array, t: Array, push: Function, r: Array, dt: float, inputs: int
    ) -> tuple[Array, Array]:
        a = theta[-self.order :]
        of_zeros = self.numerator.columns(r, dt, inputs)
        of_zeros = pushed(push, pushed(lambda u: self._divided(u, a, dt), of_zeros))
        held, pad = self._held(t)
        unit = np.eye(self.order)
        parts = [-self._over(unit[i], held, a, dt) for i in range(self.order)]
        of_poles = jnp.stack([part[pad : pad + len(t)] for part in parts], axis=-1)
        return self._divided(t, a, dt), jnp.concatenate([of_zeros, of_poles], axis=-1)

    def _divided(self, signal: Array, a: Array, dt: float) -> Array:
        """(K, n) the signal over A: the signal less (A - 1) / A of it, which ends at rest."""
        held, pad = self._held(signal)
        return signal - self._over(a, held, a, dt)[pad : pad + len(signal)]

    def _held(self, signal: Array) -> tuple[Tree, Tree]:
        """The signal with a margin on both sides in which it stays, and the width of one."""
        pad = max(len(signal) // 2, 2 * MARGIN)
        return jnp.pad(signal, ((pad, pad), (0, 0)), mode="edge"), pad

    def _over(self, top: Array, held: Array, a: Array, dt: float) -> Array:
        """The signal filtered by (top_1 d + top_2 d^2 + ...) / A.

        A straight line is taken off, so that the signal is periodic. The filter makes the constant
        top_1 times its slope of it, since A is 1 at frequency zero.
        """
        M = len(held)
        slope = (held[-1] - held[0]) / M
        symbols = [_symbol(i + 1, M, dt) for i in range(self.order)]
        A = 1 + sum(a[i] * symbols[i] for i in range(self.order))
        over = sum(top[i] * symbols[i] for i in range(self.order)) * jnp.conj(A)
        over = over / (jnp.abs(A) ** 2 + self.least**2)
        spectrum = jnp.fft.rfft(held - held[0] - slope * np.arange(M)[:, None], axis=0)
        return jnp.fft.irfft(spectrum * over[:, None], n=M, axis=0) + top[0] * slope / dt


def _symbol(order: int, M: int, dt: float) -> Numbers:
    """(M//2+1,) the frequency response of the central difference of an order, for M samples."""
    w = 2 * np.pi * np.arange(M // 2 + 1) / M
    second = 2 * (np.cos(w) - 1) / dt**2
    return second ** (order // 2) * (1j * np.sin(w) / dt if order % 2 else 1.0)


PENALTIES, SMALLEST = 50, 1e-4  # number of penalties, and the smallest in units of the largest
SWEEPS, SETTLED = 10_000, 1e-12  # of the descent, and the relative change at which it ends


class Selection(NamedTuple):
    """What `select_basis` found.

    basis: `SelectedBasis` of the functions that are kept
    theta: (kept,) their parameters, by least squares over all trials
    names: (kept,) the names of these parameters
    penalties: (P,) that were tried, in units of the one at which nothing is left, falling
    errors: (P,) mean square error of the trials left out, as a share of their mean square input
    doubt: (P,) standard error of these over the trials
    counts: (P,) number of functions that all trials together keep
    chosen: number of the penalty that was chosen
    """

    basis: SelectedBasis
    theta: np.ndarray
    names: tuple[str, ...]
    penalties: np.ndarray
    errors: np.ndarray
    doubt: np.ndarray
    counts: np.ndarray
    chosen: int

    def __repr__(self) -> str:
        return in_short(self)


def select_basis(
    basis: Basis, trials: Sequence[tuple[Value, Value]], *, dt: float, penalties: Value = None
) -> Selection:
    """The functions of a basis that predict the input of trials that were left out.

        minimise |Psi theta - u|^2 / (2 K) + penalty sum_i |theta_i| s_i,   s_i: rms of column i

    over all trials but one (Tibshirani 1996), which then tells the error of what was found. Of the
    penalties whose mean error lies within one standard error of the least, the largest is chosen.
    The functions that it keeps are fitted once more, to all trials and without a penalty.

    basis: a basis that is linear in theta
    trials: pairs (r, u) of at least two trials, r (N+1, n_y) and u (N, n_u), of any lengths. r is
        the reference of a learned input u, or the output that was measured under any input u
    dt: sample time [s]
    penalties: falling numbers in (0, 1]; None: 50 from 1 to 1e-4 with equal ratios

    Raises ValueError for fewer trials, for shapes that do not fit, for numbers that are not finite,
    and for inputs that are all zero.
    """
    need_linear("select_basis", basis)
    require("select_basis", "dt", dt, "(0, inf)")
    columns, inputs, names = _equations(basis, trials, dt)
    tried = _penalties(penalties)
    grams = np.stack([X.T @ X for X in columns])
    sums = np.stack([X.T @ u for X, u in zip(columns, inputs, strict=True)])
    lengths = np.array([len(u) for u in inputs], float)
    scale = np.sqrt(np.diagonal(grams.sum(0)) / lengths.sum())
    if not np.any(sums):
        raise ValueError("select_basis: the inputs are zero, or no function has a share in them")
    scale = np.where(scale > 0, scale, 1.0)
    grams, sums = grams / np.outer(scale, scale), sums / scale
    squares = np.array([u @ u for u in inputs])

    errors = np.empty((len(columns), len(tried)))
    for left in range(len(columns)):
        others = np.arange(len(columns)) != left
        K = lengths[others].sum()
        path = _path(grams[others].sum(0) / K, sums[others].sum(0) / K, tried)
        for i, theta in enumerate(path):
            off = squares[left] - 2 * theta @ sums[left] + theta @ grams[left] @ theta
            errors[left, i] = off / max(squares[left], np.finfo(float).tiny)
    mean = errors.mean(0)
    doubt = errors.std(0, ddof=1) / np.sqrt(len(columns))
    best = int(np.argmin(mean))
    chosen = int(np.argmax(mean <= mean[best] + doubt[best]))

    K = lengths.sum()
    path = _path(grams.sum(0) / K, sums.sum(0) / K, tried)
    counts = np.count_nonzero(path, axis=1)
    chosen = max(chosen, int(np.argmax(counts > 0)))
    kept = tuple(int(i) for i in np.flatnonzero(path[chosen]))
    X = np.concatenate(columns)[:, kept] / scale[list(kept)]
    theta = np.linalg.lstsq(X, np.concatenate(inputs), rcond=None)[0] / scale[list(kept)]
    return Selection(
        SelectedBasis(basis, kept),
        theta,
        tuple(names[i] for i in kept),
        tried,
        mean,
        doubt,
        counts,
        chosen,
    )


def _equations(basis: Basis, trials: Sequence[tuple[Value, Value]], dt: float) -> Tree:
    """The columns (K, m) and the input (K,) of each trial, and the names of the functions."""
    if len(trials) < 2:
        raise ValueError(f"select_basis: {len(trials)} trials; allowed are two or more")
    columns, inputs, names = [], [], cast(tuple[str, ...], ())
    for i, (r, u) in enumerate(trials):
        r, u = (np.asarray(x, float) for x in (r, u))
        r, u = (x[:, None] if x.ndim == 1 else x for x in (r, u))
        if r.ndim != 2 or u.ndim != 2 or len(r) != len(u) + 1:
            raise ValueError(
                f"select_basis: r {r.shape} and u {u.shape} of trial {i + 1} do not fit; allowed "
                "are (N+1, n_y) and (N, n_u)"
            )
        if not (np.all(np.isfinite(r)) and np.all(np.isfinite(u))):
            raise ValueError(f"select_basis: r or u of trial {i + 1} is not finite")
        names = basis.names(r.shape[1], u.shape[1])
        found = basis.columns(jnp.asarray(r), dt, u.shape[1])
        columns.append(np.asarray(found, float).reshape(u.size, -1))
        inputs.append(u.ravel())
    return columns, inputs, names


def _penalties(given: Value) -> np.ndarray:
    if given is None:
        return np.geomspace(1.0, SMALLEST, PENALTIES)
    tried = np.atleast_1d(np.asarray(given, float))
    if tried.ndim != 1 or not np.all((tried > 0) & (tried <= 1)) or np.any(np.diff(tried) >= 0):
        raise ValueError(f"select_basis: penalties = {tried}; allowed are falling ones in (0, 1]")
    return tried


def _path(G: Numbers, g: Numbers, tried: Numbers) -> Numbers:
    """(P, m) the minimum of theta' G theta / 2 - g' theta + penalty |theta|_1, for each penalty.

    It is found by descent along one parameter after the other (Friedman, Hastie and Tibshirani
    2010), each from the minimum of the penalty before.
    """
    theta, found, largest = np.zeros(len(g)), [], np.max(np.abs(g))
    for penalty in tried * largest:
        for _ in range(SWEEPS):
            before = theta.copy()
            for i in range(len(g)):
                if G[i, i] > 0:
                    rest = g[i] - G[i] @ theta + G[i, i] * theta[i]
                    theta[i] = np.sign(rest) * max(abs(rest) - penalty, 0.0) / G[i, i]
            if np.max(np.abs(theta - before)) <= SETTLED * np.max(np.abs(theta), initial=1e-300):
                break
        found.append(theta.copy())
    return np.array(found)
