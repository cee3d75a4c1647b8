"""The metrics of a trial, computed while it runs or from its record, and further quantities.

The metrics are declared in `known_metrics`. A metric knows one trial; a `Watch` looks at each trial
beside the trial before it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Hashable, Mapping
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from ..pytree.aliases import Array, Tree
from ..pytree.ranges import brief, native
from ..runtime.jax_internals import with_slope
from ..runtime.lanes import over_samples, stored
from ..signals.rows import for_scan
from ..signals.task import Task, Trial, root
from .known_metrics import GATHERED, METRICS, Gathering, Metrics

if TYPE_CHECKING:
    from ..schemes import Scheme
    from .machine import Machine

# number of samples up to which a plain sum in single precision is right to 2e-5; to note what it
# loses takes up to a fifth of the time of a trial
LONG = 2048
SIGNALS = (*Trial._fields, "e")  # of a trial


class Tally(NamedTuple):
    """The running values from which metrics are computed, updated at each sample of a trial.

    A second pass over the record would take as much time as the trial itself.

    gathered: (n_y,) or (n_u,) for each of `GATHERED`, the largest absolute value or the sum of
        squares so far
    lost: the same of what each sum lost by rounding, for a trial of more than `LONG` samples in
        single precision; None for others, and for the largest values. With it the rms of a constant
        error is right to 1e-7 for 1e5 samples and to 5e-5 for 1e6, without it to 3e-4 and 7e-3
    """

    gathered: tuple[Array, ...]
    lost: tuple[Array | None, ...]

    @classmethod
    def start(cls, e: Array, inputs: int, samples: int, settled: bool) -> Tally:
        """The tally after sample 0, which no input can reach.

        Sample 0 counts only in metrics of the settled window, if this window begins with it.

        e: (n_y,) error of sample 0 [unit of y]
        samples: N, number of samples that follow
        settled: whether the settled window begins with sample 0
        """
        none = {"e": jnp.zeros_like(e), "u": jnp.zeros_like(e, shape=inputs)}
        first = {"largest": jnp.abs(e), "root mean square": e * e}
        lost = none if samples > LONG and jnp.finfo(e.dtype).bits < 64 else {}
        return cls(
            tuple(
                first[how.of] if how.settled and settled and how.signal == "e" else none[how.signal]
                for _, how in GATHERED
            ),
            tuple(None if how.of == "largest" else lost.get(how.signal) for _, how in GATHERED),
        )

    def add(self, e: Array, u: Array, settled: Array) -> Tally:
        """The tally with one more sample.

        e: (n_y,) error of the sample [unit of y]
        u: (n_u,) input that led to it [unit of u]
        settled: () whether the sample is in the settled window
        """
        signals, added = {"e": e, "u": u}, []
        for (_, how), so_far, lost in zip(GATHERED, self.gathered, self.lost, strict=True):
            x, before = signals[how.signal], (so_far, lost)
            more = jnp.maximum(so_far, jnp.abs(x)) if how.of == "largest" else so_far + x * x
            if lost is not None:
                lost = lost + (x * x - (more - so_far))
            now = more, lost
            added.append(
                jax.tree.map(partial(jnp.where, settled), now, before) if how.settled else now
            )
        return Tally(*zip(*added, strict=True))

    def metrics(self, trial: Trial, task: Task) -> Metrics:
        """The metrics of the trial of this tally, with their derivative by its signals e and u.

        A metric is NaN where none of its samples was measured.
        """
        e, u = trial.e, trial.u
        found, finite = {}, jnp.all(jnp.isfinite(e[0]))
        # of a sum that is infinite, what it lost is no number
        sums = [
            x if lost is None else jnp.where(jnp.isfinite(lost), x + lost, x)
            for x, lost in zip(self.gathered, self.lost, strict=True)
        ]
        gathered = _of_signals(tuple(sums), e, u, task.settled)
        for (name, how), value in zip(GATHERED, gathered, strict=True):
            count = self._samples(how, trial, task)
            whole = isinstance(count, int)  # each sample was measured
            if how.of == "root mean square":
                value = root(value / (count if whole else jnp.maximum(count, 1.0)))
                # if the sum of the squares of all samples is finite, each sample is finite
                finite = finite if how.settled else finite & jnp.all(jnp.isfinite(value))
            found[name] = value if whole else jnp.where(count > 0, value, jnp.nan)
        return Metrics(**found, finite=finite)

    def _samples(self, how: Gathering, trial: Trial, task: Task) -> Tree:
        """The number of samples that count in a metric, for each channel."""
        if how.signal == "u" or trial.weight is None:
            rows = range(len(trial.u) + (how.signal == "e"))
            return len(rows[_window(how, len(trial.u), task.settled)])
        there = jnp.diagonal(trial.weight, axis1=1, axis2=2)
        there = _rows(how, there, trial.u, task.settled)
        return jnp.sum(there, axis=0)


def _rows(how: Gathering, e: Array, u: Array, settled: slice) -> Array:
    """The rows of e (N+1, n_y) or u (N, n_u) that a metric uses."""
    return {"e": e, "u": u}[how.signal][_window(how, len(u), settled)]


def _window(how: Gathering, N: int, settled: slice) -> slice:
    """Where these rows are; u[k] leads to e[k+1]."""
    start, stop, _ = settled.indices(N + 1)
    if how.signal == "e":
        return slice(start, stop) if how.settled else slice(1, None)
    return slice(max(start - 1, 0), stop - 1) if how.settled else slice(None)


def _of_signals(
    gathered: tuple[Array, ...], e: Array, u: Array, settled: slice
) -> tuple[Array, ...]:
    """The values gathered from e (N+1, n_y) and u (N, n_u), with a derivative rule of their own.

    The rule uses the whole signals. A derivative sample by sample would store every intermediate
    value.
    """

    def slope(at: Tree, by: Tree) -> tuple[Array, ...]:
        (_, e, u), (_, de, du) = at, by
        slopes: dict[str, Array] = {}
        for signal, x, dx in (("e", e, de), ("u", u, du)):
            of_signal = {name: how for name, how in GATHERED if how.signal == signal}
            counted = [np.zeros(len(x), bool) for _ in of_signal]
            for row, how in zip(counted, of_signal.values(), strict=True):
                row[_window(how, len(u), settled)] = True
            largest = [how.of == "largest" for how in of_signal.values()]
            slopes |= zip(of_signal, _slopes(x, dx, counted, largest), strict=True)
        return tuple(slopes[name] for name, _ in GATHERED)

    return with_slope(lambda gathered, e, u: gathered, slope)(gathered, e, u)


def _slopes(x: Array, dx: Array, counted: list[np.ndarray], largest: list[bool]) -> list[Array]:
    """The derivatives along dx of several values that are gathered from one signal x (K, n).

    counted: (K,) each, whether a value uses a row
    largest: whether a value is the largest |x|; otherwise it is the sum of x^2

    The slopes, (n,) each, are gathered in a scan over the samples for the reason that
    `signals.rows` gives. The place of a largest value is found anew: the value in the tally may
    be rounded differently from the same error here, and would then be equal to none of the errors.
    """
    rows = np.arange(len(x)), np.stack(counted, axis=1)
    x, dx = for_scan((x, dx))
    zero = jnp.zeros_like(x[0])

    def place(best: Tree, now: Tree) -> tuple[Tree, Tree]:
        (k, counts), x = now
        better = [(jnp.abs(x) > size) & c for (size, _), c in zip(best, counts, strict=True)]
        return [
            (jnp.where(b, jnp.abs(x), size), jnp.where(b, k, at))
            for b, (size, at) in zip(better, best, strict=True)
        ], None

    @jax.checkpoint  # so that a gradient stores nothing for each row
    def slopes_of_row(places: list[Array], now: Tree, dx: Array) -> list[Array]:
        (k, counts), x = now
        slopes = [
            jnp.where(k == at, jnp.where(x < 0, -1.0, 1.0), 0.0) if is_largest else 2.0 * x
            for at, is_largest in zip(places, largest, strict=True)
        ]
        return [jnp.where(c, slope, 0.0) * dx for slope, c in zip(slopes, counts, strict=True)]

    def tick(sums: Tree, now: Tree) -> tuple[Tree, Tree]:
        return jax.tree.map(jnp.add, sums, slopes_of_row(places, *now)), None

    first = [(zero, zero.astype(int))] * len(largest)
    found = over_samples(place, first, (rows, x))[0]
    places = [stored(jnp.where(size > 0, at, -1)) for size, at in found]  # none if all are zero
    return over_samples(tick, [zero] * len(largest), ((rows, x), dx))[0]


def measure(trial: Trial, task: Task) -> Metrics:
    """The metrics of one trial, from its record.

    Where |e| or |u| of a sample is not finite, the metrics that use this sample are not finite.
    """
    e, u = lax.stop_gradient((trial.e, trial.u))

    def gathered(how: Gathering) -> Array:
        x = _rows(how, e, u, task.settled)
        if how.of == "largest":
            return jnp.max(jnp.abs(x), axis=0)
        return jnp.einsum("kn,kn->n", x, x)  # `jnp.sum` would add one product after another

    found = tuple(gathered(how) for _, how in GATHERED)
    return Tally(found, (None,) * len(found)).metrics(trial, task)


@dataclasses.dataclass(frozen=True)
class Keep:
    """A `save` for `learn`: a dictionary of signals and further metrics of each trial.

    Two equal objects share a compiled program.

    signals: names of fields of `Trial`, or "e"
    quantities: pairs of a name and a function of a trial. A function that will be differentiated
        must use `largest` instead of `jnp.max`.
    Raises ValueError for a signal that a trial does not have.
    """

    signals: tuple[str, ...] = ()
    quantities: tuple[tuple[str, Callable[[Trial], Array]], ...] = ()

    def __post_init__(self) -> None:
        for name in self.signals:
            if name not in SIGNALS:
                raise ValueError(f"Keep: signal {name!r} is not one of {', '.join(SIGNALS)}")

    @classmethod
    def of(cls, quantities: Mapping[str, Callable[[Trial], Array]], *signals: str) -> Keep:
        """The `Keep` of these quantities and signals.

        Raises ValueError for what is no function by a name, and for the name of a metric or of a
        signal.
        """
        if not isinstance(quantities, Mapping):
            raise ValueError(
                f"quantities = {brief(quantities)} is a {type(quantities).__name__}; allowed are "
                "functions of a trial by name, such as {'name': function}"
            )
        for name, of in quantities.items():
            if not (isinstance(name, str) and callable(of) and isinstance(of, Hashable)):
                raise ValueError(
                    f"quantity = {brief(name)}: {brief(of)}; allowed is text, and by it a function "
                    "of a trial that can be hashed"
                )
            if name in (*(metric.name for metric in METRICS), *SIGNALS):
                raise ValueError(
                    f"quantity = {name!r} is a metric or a signal that every trial has; choose "
                    "another name"
                )
        return cls(signals, tuple(quantities.items()))

    def __call__(self, trial: Trial) -> dict[str, Array]:
        return {name: getattr(trial, name) for name in self.signals} | {
            name: of(trial) for name, of in self.quantities
        }


def largest(x: Array, axis: int | None = None) -> Array:
    """The largest value of x, or those along an axis, with a derivative that uses its index.

    Where several values are equal, the first of them has the derivative. The derivative of
    `jnp.max` instead compares all values with the largest one. A compiled program may compute them
    twice and round them differently. Then no value is equal to the largest one, and a part of the
    derivative is zero without a warning.
    """
    x, axis = (jnp.ravel(x), 0) if axis is None else (jnp.asarray(x), axis)
    place = jnp.argmax(lax.stop_gradient(x), axis=axis, keepdims=True)
    # with a selection and a sum: the derivative of a gather is a scatter, on which XLA's
    # partitioner crashes if x is distributed over many devices
    return jnp.sum(
        jnp.where(lax.broadcasted_iota(place.dtype, x.shape, axis % x.ndim) == place, x, 0.0),
        axis=axis,
    )


def best_trial(rms: Array) -> np.ndarray:
    """The number of the best trial among the first j trials, for j = 1..J, as (J,).

    The best trial has the smallest error of the output with the largest error. A trial that is not
    finite is never the best. Where the number remains below j, the error has grown again.

    rms: (J, n_y) root mean square errors [unit of y]
    """
    errors = np.max(np.nan_to_num(np.asarray(rms, float), nan=np.inf, posinf=np.inf), axis=1)
    better = errors < np.concatenate([[np.inf], np.minimum.accumulate(errors)[:-1]])
    return 1 + np.maximum.accumulate(np.where(better, np.arange(len(errors)), 0))


class Repeatability(NamedTuple):
    """How well repeated runs agree.

    mean: (n_y,) mean of the rms errors [unit of y]
    spread: (n_y,) difference of the largest and the smallest rms error [unit of y]
    share: (n_y,) spread / mean
    """

    mean: Array
    spread: Array
    share: Array


def repeatability(rms: Array) -> Repeatability:
    """How well the same input leads to the same error in each run (Li 2020, section 6.1).

    Learning assumes that it does. Li found a spread of 0.0003 mm over 10 runs.

    rms: (J, n_y) or (J,) root mean square errors of J >= 2 runs without learning between them, such
        as `History.rms` of pure feedback [unit of y]
    Raises ValueError for fewer runs.
    """
    rms = jnp.asarray(native(rms))
    if rms.ndim not in (1, 2) or len(rms) < 2:
        raise ValueError(
            f"repeatability: rms has shape {rms.shape}; allowed are (J,) and (J, n_y) with J >= 2"
        )
    mean, spread = jnp.mean(rms, axis=0), jnp.max(rms, axis=0) - jnp.min(rms, axis=0)
    return Repeatability(mean, spread, spread / mean)


def total_variation(signal: Array) -> Array:
    """The total variation sum_k |x[k+1] - x[k]| of a (N, n) signal, as (n,)."""
    return jnp.sum(jnp.abs(jnp.diff(signal, axis=0)), axis=0)


def chattering(trial: Trial) -> Array:
    """The total variation of u per second, as (n_u,) [unit of u per s].

    For a smooth u it is about the mean of |u'|. For a u that switches it is much larger.
    """
    return total_variation(trial.u) / (trial.u.shape[0] * trial.dt)


def root_mean_square(signal: Array) -> Array:
    """The root mean square (n,) of a (N, n) signal; where it is zero, its gradient is also zero."""
    return root(jnp.mean(signal**2, axis=0))


# What looks at each trial beside the one before it
# --------------------------------------------------------------------------------------------------


class Watched(NamedTuple):
    """A variable that a watch finds: whether there is one for each trial, its unit, its meaning."""

    of_trials: bool
    unit: str
    text: str


class Watch:
    """What looks at each trial beside the one before it, and keeps numbers but no signals.

    A metric knows one trial; how much smaller the error of a sample has become is seen in two. A
    subclass is a frozen dataclass: equal ones share a compiled program.
    """

    def variables(self, task: Task) -> dict[str, Watched]:
        """What is found, by name."""
        raise NotImplementedError

    def known(self, machine: Machine, scheme: Scheme, task: Task) -> Mapping[str, Array]:
        """Numbers () by name that are computed once, before the first trial."""
        raise NotImplementedError

    def continued(
        self, known: Mapping[str, Array], machine: Machine, scheme: Scheme, task: Task, memory: Tree
    ) -> Mapping[str, Array]:
        """What is known of a run that goes on from a memory, maybe of another machine."""
        del machine, scheme, task, memory
        return known

    def seen(
        self, known: Mapping[str, Array], scheme: Scheme, before: Trial, trial: Trial
    ) -> Mapping[str, Array]:
        """Numbers () by name of a trial and the one before it.

        The first trial that `learn` runs has none before it; there `learn` keeps NaN.
        """
        raise NotImplementedError
