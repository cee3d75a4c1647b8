"""The modal model of a flexible machine: a sum of lags, modes and integrators with shared poles."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import scipy

from ..pytree.aliases import Array, Leaf, Numbers, Value
from ..pytree.fields import leaf, pytree, static
from .from_python_control import system_matrices
from .linear import LARGEST_ORDER, StateSpace
from .plant import Plant
from .process_model import ProcessModel, all_poles, held_late

CLOSE = 1e-3  # relative distance below which two real poles of a system are taken as a pair
AT_REST = 1e-7  # of the fastest pole, up to which one of a system is an integrator
CANCEL = 1e6  # times the response, beyond which parts cancel each other
EXACT = 1e-6  # relative error up to which a sum of parts is the system that it was made of
POINTS = 8  # a state, at which the numerators of a system are found
BEYOND = 1e8  # times the fastest pole, from which on a zero is one at infinity that was rounded
NEAR = 0.1  # of |1 - zeta^2| (w t)^2, below which a pair of damping below 2 is held by its series


@pytree
class ModalModel(Plant):
    """A stable transfer function as a sum of parts, with any number of real and complex zeros.

        G(s) = [D + sum_r R_r / (1 + s / p_r)
                  + sum_q (a_q + b_q s / w_q) / (1 + 2 zeta_q s / w_q + (s / w_q)^2)
                  + I_1 / s + I_2 / s^2] exp(-s delay)

    The poles belong to the machine, and every input and output shares them; where zeros lie follows
    from the numerators (`all_zeros`), so that antiresonances need no parameters of their own. Each
    numerator is an (n_y, n_u) matrix; with one input and one output it may be a number.

    poles: (n,) rates p of the lags [rad/s], positive
    pole_gains: (n, n_y, n_u) or (n,) R, the DC gain of each lag [unit of y per unit of u]
    frequencies, dampings: (q,) natural frequency w [rad/s] and damping ratio zeta of each mode,
        both positive; at a damping from 1 on, a mode is two real poles
    mode_gains: (q, n_y, n_u) or (q,) a, the DC gain of each mode
    mode_rates: (q, n_y, n_u) or (q,) b, what a mode gives of its rate, in the same unit
    integrator, double_integrator: (n_y, n_u) or () I_1 and I_2; None for none
    direct: (n_y, n_u) or () D, direct feedthrough; None for none
    delay: dead time between input and output [s]; it need not be a whole number of samples

    It is sampled by an exact zero-order hold, in closed form for each part. y[k] is the output just
    before u[k] is put out, so a direct term is seen in y[k+1] as D u[k], and no approximation is
    made. Where a record has y[k] measured just after u[k] was put out, such as an acceleration,
    give it as y[k+1]: a proper function of z, delayed by one sample, is again a sum of such parts
    with the same poles.

    A state is held for each pole and input: exact, not minimal. Raises ValueError for shapes that
    do not fit, no part at all and more than 1000 states; and, when it is sampled, for a delay of
    more than 1000 samples.
    """

    poles: Leaf = leaf(default=(), interval="(0, inf)")
    pole_gains: Leaf = leaf(default=())
    frequencies: Leaf = leaf(default=(), interval="(0, inf)")
    dampings: Leaf = leaf(default=(), interval="(0, inf)")
    mode_gains: Leaf = leaf(default=())
    mode_rates: Leaf = leaf(default=())
    integrator: Leaf | None = leaf(default=None, optional=True)
    double_integrator: Leaf | None = leaf(default=None, optional=True)
    direct: Leaf | None = leaf(default=None, optional=True)
    delay: float = static(default=0.0, interval="[0, inf)")

    def __post_init__(self) -> None:
        shapes = {}
        for name, per in (
            ("pole_gains", self.poles),
            ("mode_gains", self.frequencies),
            ("mode_rates", self.frequencies),
        ):
            found = np.shape(getattr(self, name))
            if np.ndim(per) != 1 or found[:1] != np.shape(per) or len(found) not in (1, 3):
                raise ValueError(
                    f"ModalModel: {name} has shape {found} for {np.shape(per)} parts; allowed are "
                    "(parts,), with one input and one output, and (parts, n_y, n_u)"
                )
            if found[0]:
                shapes[name] = found[1:]
        if np.shape(self.frequencies) != np.shape(self.dampings):
            raise ValueError(
                f"ModalModel: frequencies {np.shape(self.frequencies)} and dampings "
                f"{np.shape(self.dampings)} must have one shape (q,)"
            )
        for name in ("integrator", "double_integrator", "direct"):
            if getattr(self, name) is not None:
                shapes[name] = np.shape(getattr(self, name))
        wrong = [f"{name} {shape}" for name, shape in shapes.items() if len(shape) not in (0, 2)]
        if wrong or not shapes or len(set(shapes.values())) > 1:
            said = ", ".join(wrong) or ", ".join(f"{n} {s}" for n, s in shapes.items()) or "none"
            raise ValueError(
                f"ModalModel: the parts have the numerators {said}; allowed is one or more, each a "
                "number, or each (n_y, n_u)"
            )
        if self.order * self.n_u > LARGEST_ORDER:
            raise ValueError(
                f"ModalModel: {self.order} poles of {self.n_u} inputs are {self.order * self.n_u} "
                f"states; allowed are at most {LARGEST_ORDER}"
            )

    @property
    def order(self) -> int:
        """Number of poles, those of the integrators with them."""
        return self._integrators + self.poles.shape[-1] + 2 * self.frequencies.shape[-1]

    @property
    def n_y(self) -> int:
        return self._channels[0]

    @property
    def n_u(self) -> int:
        return self._channels[1]

    @property
    def _integrators(self) -> int:
        return 2 if self.double_integrator is not None else int(self.integrator is not None)

    @property
    def _channels(self) -> tuple[int, int]:
        """(n_y, n_u), also of models that are stacked: `poles` tells their number of axes."""
        stacked = np.ndim(self.poles) - 1
        per_part = ((self.pole_gains, self.poles), (self.mode_gains, self.frequencies))
        of_parts = [np.shape(N)[stacked + 1 :] for N, per in per_part if np.shape(per)[-1]]
        single = (self.integrator, self.double_integrator, self.direct)
        shape = [*of_parts, *(np.shape(N)[stacked:] for N in single if N is not None)][0]
        return (shape[0], shape[1]) if shape else (1, 1)

    @property
    def all_poles(self) -> Array:
        """(order,) complex poles [rad/s]: integrators, lags and modes, in this order."""
        moving = all_poles(self.poles, self.frequencies, self.dampings)
        return jnp.concatenate([jnp.zeros(self._integrators) + 0j, moving])

    def all_zeros(self, output: int = 0, input: int = 0) -> Numbers:
        """The complex zeros [rad/s] from one input to one output, by their absolute value.

        They are the finite generalised eigenvalues of the matrix [[A, B], [C, D]] of this path,
        without the delay and the parts that it does not have. It is not for use inside `jit`.
        """
        poles, C = np.asarray(self.all_poles), np.asarray(self._numerators()[:, output, input])
        A, B = (np.asarray(M)[:: self.n_u, :: self.n_u] for M in self._generator())
        there = C != 0
        there[: self._integrators] = np.cumsum(there[: self._integrators][::-1])[::-1] > 0
        first = len(C) - 2 * self.frequencies.shape[-1]
        there[first:] = np.repeat(there[first:].reshape(-1, 2).any(axis=1), 2)
        A, B, C = A[np.ix_(there, there)], B[there], C[None, there]
        D = 0.0 if self.direct is None else np.reshape(self.direct, self._channels)[output, input]
        fastest = max(float(np.max(np.abs(poles), initial=0.0)), np.finfo(float).tiny)
        size = max(float(np.max(np.abs(C), initial=abs(D))), np.finfo(float).tiny)
        left = np.block([[A / fastest, B / fastest], [C / size, np.full((1, 1), D / size)]])
        right = np.diag([*np.ones(len(A)), 0.0])
        # a zero at infinity is alpha / beta with a beta of rounding
        alpha, beta = scipy.linalg.eigvals(left, right, homogeneous_eigvals=True)
        finite = np.abs(alpha) < BEYOND * np.abs(beta)
        zeros = fastest * alpha[finite] / beta[finite]
        return zeros[np.lexsort((zeros.imag, np.abs(zeros)))]

    def transfer(self, s: Value) -> Array:
        """(F, n_y, n_u) G at the complex frequencies s (F,) [rad/s]; differentiable."""
        s = jnp.asarray(s)[:, None]
        w, zeta = jnp.asarray(self.frequencies), jnp.asarray(self.dampings)
        second = 1 + 2 * zeta * s / w + (s / w) ** 2
        basis = [s**-1.0, s**-2.0][: self._integrators]
        basis += [1 / (1 + s / jnp.asarray(self.poles))]
        basis += [jnp.stack([1 / second, s / w / second], axis=-1).reshape(len(s), -1)]
        G = jnp.einsum("fn,nyu->fyu", jnp.concatenate(basis, axis=1), self._numerators())
        if self.direct is not None:
            G = G + jnp.reshape(jnp.asarray(self.direct), self._channels)
        return G * jnp.exp(-s * self.delay)[:, :, None]

    def sampled(self, dt: float) -> StateSpace:
        """Exact zero-order hold of each part, behind the dead time, see `held_late`."""
        D = None if self.direct is None else jnp.reshape(self.direct, self._channels)
        return held_late("ModalModel", self._held, self._output(), self.delay, dt, D)

    def continuous(self) -> StateSpace | None:
        """One block for each part. None with a delay or a direct term, which it cannot hold."""
        if self.delay or self.direct is not None:
            return None
        A, B = self._generator()
        return StateSpace(A, B, self._output())

    def as_process_model(self) -> ProcessModel:
        """The same plant as a gain with real zeros and poles, for numbers that are short to read.

        Raises ValueError for several channels, integrators, a direct term and complex zeros.
        """
        zeros = self.all_zeros() if self._channels == (1, 1) else np.zeros(0)
        complex_zeros = np.any(np.abs(zeros.imag) > EXACT * np.abs(zeros))
        why = (
            f"{self.n_u} inputs and {self.n_y} outputs" * (self._channels != (1, 1))
            or "an integrator" * (self._integrators > 0)
            or "a direct term" * (self.direct is not None)
            or "complex zeros" * bool(complex_zeros)
        )
        if why:
            raise ValueError(
                f"as_process_model: the model has {why}; allowed are stable poles and real zeros "
                "of one input and one output"
            )
        R, a, b = (np.ravel(N) for N in (self.pole_gains, self.mode_gains, self.mode_rates))
        lags, modes = R != 0, (a != 0) | (b != 0)  # those of which anything is seen
        w, zeta = self.frequencies[modes], self.dampings[modes]
        return ProcessModel(
            np.sum(R) + np.sum(a), zeros.real, self.poles[lags], w, zeta, self.delay
        )

    def _numerators(self) -> Array:
        """(order, n_y, n_u) the numerators by state: integrators, lags, modes (a and b by turns).

        Of two integrators, the first holds the integral of u and the second that of the first.
        """
        channels = self._channels
        rows = [
            jnp.zeros(channels) if N is None else jnp.reshape(jnp.asarray(N), channels)
            for N in (self.integrator, self.double_integrator)[: self._integrators]
        ]
        both = (self.mode_gains, self.mode_rates)
        a, b = (jnp.reshape(jnp.asarray(N), (-1, *channels)) for N in both)
        modes = jnp.stack([a, b], axis=1).reshape(-1, *channels)
        lags = jnp.reshape(jnp.asarray(self.pole_gains), (-1, *channels))
        return jnp.concatenate([*(row[None] for row in rows), lags, modes])

    def _output(self) -> Array:
        """C (n_y, order n_u): the states of a part stand together, one for each input."""
        return jnp.swapaxes(self._numerators(), 0, 1).reshape(self.n_y, -1)

    def _generator(self) -> tuple[Array, Array]:
        """A and B in continuous time; all states but those of integrators have the size of u."""
        p, w, zeta = self.poles, self.frequencies, self.dampings
        pairs = (jnp.zeros_like(w), w, -w, -2.0 * zeta * w), (jnp.zeros_like(w), w)
        return self._of_blocks(((0.0, 0.0), (1.0, 0.0)), (1.0, 0.0), (-p, p), *pairs)

    def _held(self, t: float) -> tuple[Array, Array]:
        """A and B of the states after a time t under an input that is held."""
        w, zeta = jnp.asarray(self.frequencies), jnp.asarray(self.dampings)
        moved = -jnp.expm1(-jnp.asarray(self.poles) * t)
        stepped, g = _pair_after(w * t, zeta)
        pairs = (1.0 - stepped, g, -g, 1.0 - stepped - 2.0 * zeta * g), (stepped, g)
        return self._of_blocks(((1.0, 0.0), (t, 1.0)), (t, t**2 / 2), (1.0 - moved, moved), *pairs)

    def _of_blocks(
        self, double: Value, into_double: Value, lags: Value, pairs: Value, into_pairs: Value
    ) -> tuple[Array, Array]:
        """A (order n_u, order n_u) and B from those of each part.

        double, into_double: of two integrators (2, 2) and (2,)
        lags: diagonal and input (n,) of the lags
        pairs, into_pairs: four and two entries (q,) of the states (x, x' / w) of the modes
        """
        m, n, q = self._integrators, self.poles.shape[-1], self.frequencies.shape[-1]
        kind = jnp.result_type(*jax.tree.leaves(self))
        A, B = jnp.zeros((self.order, self.order), kind), jnp.zeros(self.order, kind)
        A = A.at[:m, :m].set(jnp.array(double, kind)[:m, :m])
        B = B.at[:m].set(jnp.array(into_double, kind)[:m])
        at = m + np.arange(n)
        A, B = A.at[at, at].set(lags[0]), B.at[at].set(lags[1])
        x = m + n + 2 * np.arange(q)
        for (i, j), entry in zip(((0, 0), (0, 1), (1, 0), (1, 1)), pairs, strict=True):
            A = A.at[x + i, x + j].set(entry)
        for i, entry in enumerate(into_pairs):
            B = B.at[x + i].set(entry)
        for_each = jnp.eye(self.n_u, dtype=kind)
        return jnp.kron(A, for_each), jnp.kron(B[:, None], for_each)


def _pair_after(theta: Array, zeta: Array) -> tuple[Array, Array]:
    """What 1 / (1 + 2 zeta s + s^2) has reached a time theta after a unit step, and its rate.

        x = 1 - exp(-a) (cos r + a sin r / r),  x' = exp(-a) theta sin r / r,
        a = zeta theta,  r^2 = (1 - zeta^2) theta^2

    Both are smooth at zeta = 1, where r = 0: there the functions of r^2 are series. Nothing small
    is a difference of large numbers, so that modes far slower than the samples keep their digits;
    nothing overflows for modes that are far overdamped.
    """
    a, square = zeta * theta, (1.0 - zeta) * (1.0 + zeta) * theta**2
    near = (jnp.abs(square) < NEAR) & (zeta < 2.0)
    apart = (square < 0) & ~near
    r = jnp.sqrt(jnp.where(near, 1.0, jnp.abs(square)))
    quarter = jnp.where(near, square, 0.0)  # sin r / r and 2 (1 - cos r) / r^2 as series of r^2
    sinc, cosc = jnp.ones_like(r), jnp.ones_like(r)
    for k in range(6, 0, -1):
        sinc = 1.0 - quarter * sinc / ((2 * k) * (2 * k + 1))
        cosc = 1.0 - quarter * cosc / ((2 * k + 1) * (2 * k + 2))
    sinc = jnp.where(near, sinc, jnp.sin(r) / r)
    cosc = jnp.where(near, square / 2 * cosc, 2.0 * jnp.sin(r / 2) ** 2)
    decay = jnp.exp(-a)
    stepped = (-jnp.expm1(-a) - a * decay) + decay * (cosc + a * (1.0 - sinc))
    # Overdamped: two real rates, slow * fast = theta^2.
    fast = jnp.where(apart, a + r, 1.0)
    slow = jnp.where(apart, theta**2 / fast, 0.5)
    gap = fast - slow
    two = (slow * jnp.expm1(-fast) - fast * jnp.expm1(-slow)) / gap
    rate = theta * (jnp.exp(-slow) - jnp.exp(-fast)) / gap
    return jnp.where(apart, two, stepped), jnp.where(apart, rate, decay * theta * sinc)


# From other forms
# --------------------------------------------------------------------------------------------------


def modal_model(system: Value, delay: float = 0.0) -> ModalModel:
    """The sum of parts of a linear plant or of a system of python-control, in continuous time.

    The poles are the eigenvalues of A: those at 0 are integrators, and two real ones that nearly
    coincide one mode. The numerators follow by least squares on a grid of complex frequencies.

    system: a `ProcessModel`, `StateSpace` or another plant with `continuous`, or a
        `control.StateSpace` or `control.TransferFunction`, which may have a direct term
    delay: dead time [s] of the result; that of a ProcessModel is taken over

    Raises ValueError for a system in discrete time, one that is unstable, and one that is no such
    sum.
    """
    if isinstance(system, ProcessModel):
        delay, system = system.delay, dataclasses.replace(system, delay=0.0)
    A, B, C, D = _continuous_matrices(system)
    poles = np.linalg.eigvals(A)
    zero = np.abs(poles) <= AT_REST * float(np.max(np.abs(poles), initial=0.0))
    if np.any(poles[~zero].real >= 0):
        raise ValueError(
            f"modal_model: the poles {np.array2string(poles, precision=4)} are not all stable, but "
            "for integrators; close a loop first"
        )
    direct = np.reshape(D, _numerator_shape(D)) if np.any(D) or not len(A) else None
    integrators = min(int(np.sum(zero)), 2)
    for count, together in ((1, True), (2, True), (2, False)):
        lags, modes = _grouped(poles[~zero], together)
        found = _summed(A, B, C, direct, min(count, integrators), lags, modes)
        if found is not None:
            return dataclasses.replace(found, delay=delay)
    raise ValueError(
        "modal_model: the system is no sum of lags, modes and two integrators up to rounding: more "
        "poles coincide than a pair of real ones; give it as a StateSpace"
    )


def _summed(
    A: Numbers,
    B: Numbers,
    C: Numbers,
    direct: Numbers | None,
    integrators: int,
    lags: Numbers,
    modes: Numbers,
) -> ModalModel | None:
    """The model with these poles that is C (s I - A)^-1 B + D; None if there is none."""
    w, zeta = modes
    rates = np.array([*lags, *w, *(() if len(lags) + len(w) else (1.0,))])
    s = (0.3 + 1j) * np.geomspace(0.1 * rates.min(), 10 * rates.max(), POINTS * (len(A) + 1))
    second = 1 + 2 * zeta * s[:, None] / w + (s[:, None] / w) ** 2
    real = [s[:, None] ** -np.arange(1.0, 1 + integrators), 1 / (1 + s[:, None] / lags)]
    basis = np.hstack([*real, 1 / second, s[:, None] / w / second])
    G = (C @ np.linalg.solve(s[:, None, None] * np.eye(len(A)) - A, B)).reshape(len(s), -1)
    size = np.maximum(np.linalg.norm(G, axis=1, keepdims=True), np.finfo(float).tiny)
    X, Y = (np.vstack([M.real, M.imag]) for M in (basis / size, G / size))
    length = np.linalg.norm(X, axis=0)
    N = np.linalg.lstsq(X / length, Y)[0]
    error = np.linalg.norm(Y - X / length @ N)
    # parts that cancel each other to so many digits are poles that coincide
    if error > EXACT * np.linalg.norm(Y) or np.max(np.abs(N), initial=0.0) > CANCEL:
        return None
    N = (N / length[:, None]).reshape(-1, *_numerator_shape(C @ B))
    single, R, a, b = np.split(N, np.cumsum([integrators, len(lags), len(w)]))
    I_1, I_2 = (*single, None, None)[:2]
    return ModalModel(lags, R, w, zeta, a, b, I_1, I_2, direct)


def _numerator_shape(D: Numbers) -> tuple[int, ...]:
    """() for one input and one output, else (n_y, n_u)."""
    return () if D.shape == (1, 1) else D.shape


def _continuous_matrices(system: Value) -> tuple[Numbers, ...]:
    """A, B, C, D of a plant, or of a system of python-control, in continuous time."""
    if isinstance(system, Plant):
        own = system.continuous()
        if own is None:
            raise ValueError(
                f"modal_model: {type(system).__name__} has no form in continuous time; allowed are "
                "linear plants that have one"
            )
        A, B, C = (np.asarray(M, float) for M in (own.A, own.B, own.C))
        return A, B, C, np.zeros((own.n_y, own.n_u))
    if getattr(system, "dt", None) != 0:
        raise ValueError(
            f"modal_model: {type(system).__name__} is not a plant of jaxilc or a system of "
            "python-control in continuous time"
        )
    return tuple(np.asarray(M, float) for M in system_matrices(system))


def _grouped(poles: Numbers, together: bool) -> tuple[Numbers, Numbers]:
    """Stable poles as rates of lags (n,), and as frequencies and dampings (2, q) of modes.

    together: whether poles that coincide are one, as those of several channels may be; else two
        real ones that nearly do are a mode
    """
    real = np.abs(poles.imag) <= CLOSE**2 * np.abs(poles)
    upper = poles[~real & (poles.imag > 0)]
    apart = [i for i, p in enumerate(upper) if np.all(np.abs(upper[:i] - p) > CLOSE**2 * abs(p))]
    modes = [(abs(p), -p.real / abs(p)) for p in upper[apart]]
    lags: list[float] = []
    for p in np.sort(-poles[real].real):
        if not lags or p > (1 + (CLOSE**2 if together else CLOSE)) * lags[-1]:
            lags.append(p)
        elif not together:
            near = lags.pop()
            modes.append((np.sqrt(p * near), (p + near) / (2 * np.sqrt(p * near))))
    return np.array(lags), np.reshape(sorted(modes), (-1, 2)).T
