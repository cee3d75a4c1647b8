"""What identification fits: free parameters, their coordinates, and the least-squares problem."""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import numpy as np
import scipy

from ..learning.machine import Machine
from ..plants import Plant, ProcessModel
from ..pytree.aliases import Numbers, Value
from ..pytree.closest import known_names
from ..pytree.named_paths import get_at, interval_at, named_leaves, replaced
from ..pytree.ranges import Interval, require, shown
from ..signals.task import Task
from .records import Record, as_columns, first_of, output_from_rest, task_of

# With fewer samples for each parameter, the intervals would be wrong: they hold for long records.
SAMPLES_PER_PARAMETER = 5
SAME = 1e-12  # of a bias: what is left of it, below which a slow free motion is the same
LARGEST = 1e100  # of a signal or a response, whose square must be a number
LEAST_POSITIVE = 1e-100  # a positive number may shrink to, before it would round to 0


def _output(values, names, plant, task, u):
    """(N+1, n_y) the plant's output without noise, its parameters `names` set to values (P,)."""
    machine = Machine(replaced(plant, dict(zip(names, values, strict=True))))
    return output_from_rest(machine, task, u)


simulated_output = jax.jit(_output, static_argnames="names")
# (N+1, n_y, P), exact
sensitivity_of_output = jax.jit(jax.jacfwd(_output), static_argnames="names")


@functools.partial(jax.jit, static_argnames="names")
def poles_at(values, names, plant):
    """(rows, poles) of the plant with its parameters `names` set to each row of values."""
    return jax.vmap(lambda row: replaced(plant, dict(zip(names, row, strict=True))).all_poles)(
        values
    )


@functools.partial(jax.jit, static_argnames="names")
def slopes_of_poles(values, names, plant):
    """(poles, P) derivatives of the poles of the plant by its parameters `names`."""
    return jax.jacfwd(lambda row: poles_at(row[None], names, plant)[0])(values)


class Coordinates(NamedTuple):
    """The coordinates in which the optimiser works, one for each of P parameters.

    The logarithm stands for a value that must be positive. The reciprocal stands for a zero of a
    ProcessModel, so that the zero can change its sign through infinity. Any other value is taken
    as it is.

    log, reciprocal: (P,) true where this coordinate is used
    low, high: (P,) bounds of the coordinates
    """

    log: np.ndarray
    reciprocal: np.ndarray
    low: np.ndarray
    high: np.ndarray

    @classmethod
    def of(cls, plant: Plant, names: tuple[str, ...]) -> Coordinates:
        """The coordinates for the elements `names` of the plant and one bias for each output."""
        free = Interval(-np.inf, np.inf, False, False)
        allowed = [interval_at(plant, name) or free for name in names] + [free] * plant.n_y
        log = np.array([tuple(a) == (0.0, np.inf, False, False) for a in allowed])
        reciprocal = np.array(
            [isinstance(plant, ProcessModel) and n.startswith("zeros") for n in names]
            + [False] * plant.n_y
        )
        return cls(
            log,
            reciprocal,
            np.where(log, -np.inf, [a.low for a in allowed]),
            np.array([a.high for a in allowed]),
        )

    def from_values(self, theta):
        return self._mapped(theta, np.log)

    def to_values(self, x):
        # A step that is too long gives values that are not finite; the optimiser then shortens it.
        with np.errstate(over="ignore", divide="ignore"):
            values = self._mapped(x, np.exp)
        return np.where(self.log, np.maximum(values, LEAST_POSITIVE), values)

    def slope(self, theta):
        """(P,) d value / d coordinate."""
        return np.where(self.log, theta, np.where(self.reciprocal, -(theta**2), 1.0))

    def _mapped(self, values, function):
        mapped = np.array(values, dtype=float)
        mapped[self.log] = function(mapped[self.log])
        mapped[self.reciprocal] = 1.0 / mapped[self.reciprocal]
        return mapped


class Minimum(NamedTuple):
    """The point at which the optimiser stopped.

    theta: (P,) values at this point
    cost: half the sum of squares at this point
    converged: whether the tolerances were met before the budget of simulations was used up
    """

    theta: np.ndarray
    cost: float
    converged: bool


class Problem(NamedTuple):
    """The least-squares problem: theta (P,) holds the values of `names`, then the n_y biases.

    plant: the plant with its values at the start
    names: elements of the plant that are fitted
    samples: number of samples, from the first one on, that are fitted
    scale: (n_y,) numbers by which the residuals of each output are divided
    from_rest: whether the machine rests at the start. If not, what its state there adds is found
        with each theta, as the rest of the least squares is linear in it (variable projection)
    late: samples of dead time that the plant does not know of
    """

    record: Record
    plant: Plant
    task: Task
    names: tuple[str, ...]
    coordinates: Coordinates
    samples: int
    scale: np.ndarray
    from_rest: bool = True
    late: int = 0

    def residual(self, theta):
        """(N+1, n_y) the recorded output minus the simulated one, with its biases."""
        return self._without_start(theta, self._beyond_rest(theta))

    def _beyond_rest(self, theta):
        """(N+1, n_y) the recorded output minus the one from rest, with its biases."""
        n = len(self.names)
        of_plant = simulated_output(theta[:n], self.names, self.plant, self.task, self.record.u)
        return self.record.y - np.asarray(of_plant) - theta[n:]

    def sensitivity(self, theta):
        """(samples, n_y, P) derivatives of the simulated output, exact.

        Without those along what the start may add, which the residual is orthogonal to.
        """
        n, n_y = len(self.names), self.plant.n_y
        of_plant = np.asarray(
            sensitivity_of_output(theta[:n], self.names, self.plant, self.task, self.record.u)
        )[: self.samples]
        if not self.from_rest:
            of_plant = of_plant + self._slopes_of_start(theta)
        of_bias = np.broadcast_to(np.eye(n_y), (self.samples, n_y, n_y))
        return self._without_start(theta, np.concatenate([of_plant, of_bias], axis=2))

    def answers_to_start(self, theta):
        """(N+1, c) what a state at the start may add: a part for each pole, after the dead time."""
        t, (poles, moves) = np.arange(len(self.record.y)) * self.record.dt, self._poles(theta)
        moving = poles[moves]
        modes = np.exp(np.outer(t, moving))
        ramps = [t] if np.sum(poles == 0) > 1 else []
        found = np.column_stack([modes.real, modes.imag[:, moving.imag > 0], *ramps])
        found[: self.past] = 0.0
        return found

    @property
    def past(self):
        """Number of samples of dead time, which answer inputs before the record if it moves."""
        delay = float(getattr(self.plant, "delay", 0.0)) / self.record.dt
        return self.late + int(np.ceil(delay - 1e-6))

    def parameters_of_start(self, theta):
        """How many numbers are fitted, besides theta, where the machine does not rest."""
        return (self.answers_to_start(theta).shape[1] + self.past) * self.plant.n_y

    def _poles(self, theta):
        """(poles,) the poles of the plant, and which of them have free motions to fit."""
        poles = np.asarray(poles_at(theta[None, : len(self.names)], self.names, self.plant))[0]
        # An integrator that rests is a bias; a step of the search may be far too long.
        sound = np.isfinite(poles) & (poles.real <= 0) & (poles != 0)
        return poles, sound & (poles.imag >= 0)

    def _slopes_of_start(self, theta):
        """(samples, n_y, P) derivatives of what the start adds, whose sizes do not move."""
        n, (poles, moves) = len(self.names), self._poles(theta)
        X, length = unit_columns(self.answers_to_start(theta)[: self.samples])
        left = self._beyond_rest(theta)[: self.samples]
        left[: self.past] = 0.0
        N = np.linalg.lstsq(X, left, rcond=1e-10)[0] / length[:, None]
        t, moving = np.arange(self.samples) * self.record.dt, poles[moves]
        turning = moving.imag > 0
        sizes = N[: len(moving)].astype(complex)
        sizes[turning] -= 1j * N[len(moving) : len(moving) + np.sum(turning)]
        dp = np.asarray(slopes_of_poles(theta[:n], self.names, self.plant))[moves]
        dp[~np.isfinite(dp)] = 0.0  # of two poles that are just equal
        later = t[:, None] * np.exp(np.outer(t, moving))
        return np.real(np.einsum("tp,py,pn->tyn", later, sizes, dp, optimize=True))

    def _without_start(self, theta, of):
        """What is left of the rows `of` without what the state at the start may add to the output.

        of: (rows, ...) from the first sample on; the rows to fit decide
        """
        if self.from_rest or not np.all(np.isfinite(of)):
            return of
        X = unit_columns(self.answers_to_start(theta)[: len(of)])[0]
        flat = of.reshape(len(of), -1).copy()
        flat[: self.past] = 0.0
        N = np.linalg.lstsq(X[: self.samples], flat[: self.samples], rcond=1e-10)[0]
        return (flat - X @ N).reshape(of.shape)

    def start(self, plant):
        """The vector theta of a plant, with the biases that leave the least squares."""
        values = np.array([float(get_at(plant, name)) for name in self.names])
        theta = np.append(values, np.zeros(plant.n_y))
        left = self.residual(theta)[: self.samples]
        ones = self._without_start(theta, np.ones((self.samples, 1)))
        size = np.sum(ones**2)
        size = size if size > SAME * self.samples else np.inf  # a free motion as slow as a bias
        bias = np.sum(ones * left, axis=0) / size
        if not np.all(np.isfinite(bias)):
            name = type(plant).__name__
            raise ValueError(
                f"identify: the output of the given {name} does not stay finite over this record"
            )
        return np.append(values, bias)

    def plant_at(self, theta):
        return replaced(self.plant, dict(zip(self.names, map(float, theta), strict=False)))


def minimum(problem, theta, **options) -> Minimum:
    """The minimum that least squares within a trust region reaches from theta.

    problem: with `residual(theta)` and `sensitivity(theta)` as `Problem` has them, its `samples`,
        `scale` and `coordinates`
    """
    coordinates, scale = problem.coordinates, problem.scale

    def residual(x):
        return np.ravel(-problem.residual(coordinates.to_values(x))[: problem.samples] / scale)

    def jacobian(x):
        theta = coordinates.to_values(x)
        J = problem.sensitivity(theta) / scale[:, None]
        return J.reshape(-1, len(theta)) * coordinates.slope(theta)

    options = {"ftol": 1e-12, "xtol": 1e-10, "gtol": 1e-12, "max_nfev": 200} | options
    found = scipy.optimize.least_squares(
        residual,
        np.clip(coordinates.from_values(theta), coordinates.low, coordinates.high),
        jacobian,
        (coordinates.low, coordinates.high),
        x_scale="jac",
        **options,
    )
    return Minimum(coordinates.to_values(found.x), found.cost, found.status > 0)


def unit_columns(X) -> tuple[np.ndarray, np.ndarray]:
    """X with columns of length 1, and their lengths before; a column of zeros stays as it is."""
    length = np.linalg.norm(X, axis=0)
    length[length == 0] = 1.0
    return X / length, length


def checked_record(record: Record) -> Record:
    """The record with u (N, n_u) and y (N+1, n_y); raises ValueError for an invalid record."""
    u, y = as_columns("identify", "u", record.u), as_columns("identify", "y", record.y)
    require("identify", "trials", record.trials, "[1, inf)", whole=True)
    trials = int(record.trials)
    if len(y) != len(u) + trials or len(u) % trials:
        of_each = f" in each of {trials} trials of equal length" if trials > 1 else ""
        raise ValueError(
            f"identify: u has {len(u)} rows and y {len(y)}; allowed is one more row in y than in u"
            f"{of_each}"
        )
    for name, of in (("u", u), ("y", y)):
        largest = np.max(np.abs(of), initial=0.0)
        if largest and not 1 / LARGEST <= largest <= LARGEST:
            raise ValueError(
                f"identify: the largest |{name}| is {largest:.3g}; allowed is "
                f"[{1 / LARGEST:g}, {LARGEST:g}]"
            )
    if not 0 < record.dt < np.inf:
        raise ValueError(f"identify: dt = {record.dt} is outside its allowed range (0, inf)")
    return Record(u, y, float(record.dt), trials)


def need_samples(samples: int, parameters: int) -> None:
    """Raises ValueError where the record is too short for so many parameters."""
    least = SAMPLES_PER_PARAMETER * parameters
    if samples < least:
        raise ValueError(
            f"identify: the record is too short: {samples} samples to fit {parameters} parameters; "
            f"allowed are at least {least}, {SAMPLES_PER_PARAMETER} a parameter"
        )


def problem_of(record: Record, plant: Plant, names: tuple[str, ...], fit_share: float) -> Problem:
    """The problem of a record and a plant; raises ValueError where they do not fit together."""
    (_, n_u), (rows, n_y) = record.u.shape, record.y.shape
    if (n_u, n_y) != (plant.n_u, plant.n_y):
        raise ValueError(
            f"identify: the record has {n_u} inputs and {n_y} outputs but the plant "
            f"{type(plant).__name__} has {plant.n_u} and {plant.n_y}"
        )
    samples = round(fit_share * rows)
    need_samples(samples * n_y, len(names) + n_y)
    need_excitation(record, samples)
    return Problem(
        record,
        plant,
        task_of(plant, first_of(record), record.dt),
        names,
        Coordinates.of(plant, names),
        samples,
        np.std(record.y[:samples], axis=0),
    )


def need_excitation(record: Record, samples: int) -> None:
    """Raises ValueError where input or output of the samples to fit say nothing about a plant."""
    y, u = record.y[:samples], record.u[: max(1, samples - record.trials)]
    for i in range(y.shape[1]):
        if np.ptp(y[:, i]) == 0:
            raise ValueError(
                f"identify: output {i} is constant over the {samples} samples to fit; "
                "it says nothing about the plant"
            )
    if not np.any(np.ptp(u, axis=0)):
        raise ValueError(
            f"identify: the input is {shown(u[0] if u.shape[1] > 1 else u[0, 0])} over all of the "
            f"{samples} samples to fit; it excites nothing. A record of a step begins before it"
        )


def free_elements(plant: Plant, free: Sequence[str] | None) -> tuple[str, ...]:
    """The names of the numbers to fit: `poles` becomes `poles[0]`, `poles[1]`, ..."""
    leaves, names = named_leaves(plant), []
    for path in [free] if isinstance(free, str) else leaves if free is None else free:
        if path not in leaves and re.sub(r"(\[\d+\])+$", "", path) not in leaves:
            raise ValueError(
                f"identify: free = {path!r} is not a leaf of {type(plant).__name__}; "
                f"{known_names(path, leaves)}"
            )
        try:
            shape = np.shape(get_at(plant, path))
        except KeyError as error:
            raise ValueError(f"identify: free = {error.args[0]}") from None
        names += [path + "".join(f"[{i}]" for i in index) for index in np.ndindex(shape)]
    if not names:
        raise ValueError(f"identify: free = {free!r} leaves nothing to fit")
    return tuple(dict.fromkeys(names))


# A sum of parts, whose order is grown
# --------------------------------------------------------------------------------------------------


class Parts(NamedTuple):
    """The parts of a ModalModel, but for their numerators.

    modes: (q, 2) logarithms of frequency [rad/s] and damping
    lags: (l,) logarithms of the rates [rad/s]
    integrators: 0, 1 or 2
    delay: dead time: of a record in samples beyond the one of the hold, of a response in s
    """

    modes: Numbers = np.zeros((0, 2))
    lags: Numbers = np.zeros(0)
    integrators: int = 0
    direct: bool = False
    delay: Value = 0

    @property
    def order(self) -> int:
        return 2 * len(self.modes) + len(self.lags) + self.integrators

    @property
    def numerators(self) -> int:
        """How many there are of a channel."""
        return self.order + self.direct

    @property
    def counts(self) -> dict[str, Value]:
        """The numbers of lags, modes and integrators, and whether there is a direct term."""
        of_search = {"lags": len(self.lags), "modes": len(self.modes)}
        return of_search | {"integrators": self.integrators, "direct": self.direct}

    @property
    def kind(self) -> tuple[Value, ...]:
        """What is counted, and the delay."""
        return *self.counts.values(), self.delay

    @property
    def x(self) -> Numbers:
        """(2 q + l,) the logarithms."""
        return np.concatenate([self.modes.ravel(), self.lags])

    def at(self, x: Numbers) -> Parts:
        """The parts with other logarithms."""
        q = len(self.modes)
        return self._replace(modes=x[: 2 * q].reshape(q, 2), lags=x[2 * q :])

    def joined(self, other: Parts) -> Parts:
        """These parts with the modes and lags of others."""
        modes, lags = (np.concatenate([self[i], other[i]]) for i in (0, 1))
        return self._replace(modes=modes, lags=lags)

    def without_mode(self, i: int) -> Parts:
        return self._replace(modes=np.delete(self.modes, i, axis=0))

    def without_lag(self, i: int) -> Parts:
        return self._replace(lags=np.delete(self.lags, i))


# Least squares that are linear in some of their unknowns: only the others are searched for
# --------------------------------------------------------------------------------------------------


class Projected(NamedTuple):
    """A place of the search.

    theta: what is searched for;  N: (c,) or (c, n_y) the best linear unknowns there
    Q: (rows, c) orthonormal basis of the columns
    left: (rows,) or (rows, n_y) residual;  cost: its sum of squares
    """

    theta: Numbers
    Q: Numbers
    N: Numbers
    left: Numbers
    cost: float


def projected(theta: Numbers, X: Numbers, y: Numbers) -> Projected:
    """The best N of the columns X (rows, c), and what it leaves of y (rows,) or (rows, n_y).

    That is variable projection (Golub, Pereyra 1973) of y = X(theta) N.
    """
    scaled, length = unit_columns(X)
    Q, R = np.linalg.qr(scaled)
    b = Q.T @ y
    N = (np.linalg.lstsq(R, b, rcond=1e-13)[0].T / length).T
    left = y - Q @ b
    return Projected(theta, Q, N, left, float(np.vdot(left, left)))


def searched(
    at: Callable[[Numbers], Projected],
    slopes: Callable[[Projected], Numbers],
    theta: Numbers,
    bounds: tuple[Numbers, Numbers],
    *,
    steps: int,
    tolerance: float,
    eased: float,
    furthest: float | Numbers = 1.0,
) -> tuple[Projected, bool]:
    """The minimum near theta by Levenberg-Marquardt steps within bounds, and whether it is one.

    The Jacobian is that of Kaufman (1975): `slopes` without what the columns of X span.

    slopes: (rows, [n_y,] theta) derivatives of the residual at constant N
    tolerance: relative decrease of the cost below which a step ends the search
    eased: what the damping is divided by after a step; it is multiplied by 6 where one fails
    furthest: by which an element moves at a step, at most
    """
    low, high = bounds
    now, damping = at(np.clip(theta, low, high)), 1e-3
    for _ in range(steps if len(theta) else 0):
        J = slopes(now)
        J = J - np.tensordot(now.Q, np.tensordot(now.Q.T, J, 1), 1)
        J, size = unit_columns(J.reshape(-1, len(theta)))
        g, H = J.T @ now.left.ravel(), J.T @ J
        at_bound = ((now.theta <= low) & (g > 0)) | ((now.theta >= high) & (g < 0))
        free = np.flatnonzero(~at_bound)
        for _ in range(8):
            step = np.zeros(len(g))
            damped = H[np.ix_(free, free)] + damping * np.eye(len(free))
            step[free] = -np.linalg.solve(damped, g[free])
            new = at(np.clip(now.theta + np.clip(step / size, -furthest, furthest), low, high))
            if new.cost < now.cost:
                break
            damping *= 6
        else:
            return now, True
        gained = (now.cost - new.cost) / now.cost
        now, damping = new, max(damping / eased, 1e-9)
        if gained < tolerance:
            return now, True
    return now, False
