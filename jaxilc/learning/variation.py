"""How the trials of a machine differ from one another.

Learning assumes that each trial starts alike, on the same plant, for the same reference, and is
measured as a whole. A `Variation` of a `Machine` takes these assumptions away, one by one. All of
it depends on the number of the trial and on the random key of the machine alone, so sweeps, tuning
and gradients go through it as through any machine.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from ..plants import Plant
from ..pytree.aliases import Array, Leaf, Tree
from ..pytree.fields import child, leaf, pytree, static
from ..pytree.needs import known, need_numbers
from ..runtime.jax_internals import once
from ..schemes.weights import output_weighed, weighed
from ..signals.task import Task, Trial

SALT = 7919  # folded into the key of a trial, so that noise is that of a machine that does not vary


@pytree
class PlantChange:
    """A plant that changes from a trial on, at once or by drifting.

        plant_j = plant + s_j (after - before),    s_j = clip((j - first + 1) / over, 0, 1)

    The sum is that of the parameters, such as frequencies and masses. With `before`, a machine that
    differs from it keeps its difference after the change.

    after: the plant after the change, of the same class and shapes, swept by its own names
    first: number of the first trial that differs
    over: number of trials until the change is complete; 1 is a jump
    before: plant from which `after` differs; None: that of the machine itself
    course: leave None; the plants of trials first, .., first + over - 1, sampled, as one plant
        whose leaves have an axis of trials in front. A plant that is sampled as it is has none
    """

    after: Plant = child()
    first: int = static(interval="[1, inf)", whole=True)
    over: int = static(default=1, interval="[1, inf)", whole=True)
    before: Plant | None = child(default=None)
    course: Plant | None = child(default=None)

    def sampled(self, plant: Plant, dt: float) -> PlantChange:
        """This change of a plant that is not sampled yet, with the plants of its trials."""
        if self.course is not None:
            return self
        shares = (1 + jnp.arange(self.over)) / self.over
        course = jax.vmap(lambda share: self._mixed(plant, share).sampled(dt))(shares)
        return dataclasses.replace(self, course=course)

    def plant_at(self, plant: Plant, j: Array) -> Plant:
        """The plant of trial j, None for the long run: sampled, if plant and change are."""
        if self.course is None:
            since = self.over if j is None else j - self.first + 1
            return self._mixed(plant, jnp.clip(since / self.over, 0.0, 1.0))
        at = -1 if j is None or self.over == 1 else jnp.clip(j - self.first, 0, self.over - 1)
        changed = True if j is None else jnp.asarray(j) >= self.first
        return jax.tree.map(lambda p, x: jnp.where(changed, x[at], p), plant, self.course)

    def _mixed(self, plant: Plant, share: Array) -> Plant:
        before = plant if self.before is None else self.before
        return jax.tree.map(lambda p, a, b: p + share * (b - a), plant, before, self.after)


@pytree
class References:
    """References that change from trial to trial, all of the length of the task.

    values: (M, N+1, n_y) references [unit of y]
    first: number of the first trial of each but the first reference, rising; () changes the
        reference after each trial, and begins again after the last one
    """

    values: Leaf = leaf(interval="[-1e12, 1e12]")
    first: tuple[int, ...] = static(default=())

    def __post_init__(self) -> None:
        if self.values.ndim != 3:
            raise ValueError(
                f"References: values has shape {self.values.shape}; allowed is (M, N+1, n_y)"
            )
        if self.first and (
            len(self.first) != len(self.values) - 1
            or any(type(j) is not int or j < 2 for j in self.first)
            or any(a >= b for a, b in zip(self.first, self.first[1:], strict=False))
        ):
            raise ValueError(
                f"References: first = {self.first}; allowed are {len(self.values) - 1} rising "
                "numbers of trials from 2, one for each reference but the first, or none"
            )

    def at(self, j: Array) -> Array:
        """(N+1, n_y) the reference of trial j, None for the long run."""
        values = jnp.asarray(self.values)
        if j is None:
            return values[-1]
        if not self.first:
            return values[(j - 1) % len(self.values)]
        return values[jnp.sum(j >= np.array(self.first))]


class Start(NamedTuple):
    """Where a trial starts: the states of plant and scheme, and of the actuator."""

    plant: Tree
    scheme: Tree
    v: Tree
    u: Tree


@pytree
class Variation:
    """What differs from trial to trial; with None or the default, nothing does.

    offset: () or (n_x,) what is added to the initial state in every trial [units of the state]
    scatter: () or (n_x,) standard deviation of the initial state, drawn anew for each trial
    carried: () in [0, 1], share of the state at the end of a trial with which the next one starts:
        x[0] = rest + carried (x[N] - rest), of the plant, the feedback and the actuator, with the
        rest of the trial that starts. 0 is a machine that comes to rest, 1 is repetitive control,
        which never stops
    shortest: () in (0, 1]; a trial ends early, after a share of its samples that is drawn uniformly
        from [shortest, 1]. After that, nothing is measured. The settled window of the task must
        begin before that
    dropped: () in [0, 1), chance of each measured sample after k = 0 to be lost before it is
        learned from; the trial itself goes on
    late: largest delay of the record, in samples: it is drawn for each trial from 0 .. late, and
        the record then holds y[k - delay], at its start y[0]
    delayed: () in [0, 1), chance of each measured sample after k = 0 to arrive late, by 1 .. delay
        samples, all alike; until it is there, the record holds the newest sample that has arrived
    delay: largest delay of such a sample, in samples
    change: a plant that changes
    references: references that change
    averaged: leave False; True takes for theory the mean of what is drawn of a record. Each sample
        has for weight its chance to be measured, and the record is the mean over the delays. What a
        law learns from it is the mean of what it learns, if it is linear in the error and is no
        other law for each set of samples

    Samples that are not measured have the error zero in the record, and the weight zero, so that
    nothing is learned from them. A delayed sample has the weight of any other, since a law without
    time stamps does not know better. The state has the order of the plant's leaves, flattened;
    whole numbers in it, such as the number of the sample of a plant, start as they are. What has no
    value before the first sample, and is infinite there, goes on as it ends where carried > 0, as
    no share of it means anything: the clock of `RepetitiveBasis`, the angles of `PeriodTracking`.
    Offset, scatter, carried, the plant and the references have a gradient. The chances shortest,
    dropped and delayed have none, and differentiating by them raises ValueError.
    """

    offset: Leaf | None = leaf(default=None, optional=True)
    scatter: Leaf | None = leaf(default=None, interval="[0, inf)", optional=True)
    carried: Leaf | None = leaf(default=None, interval="[0, 1]", optional=True)
    shortest: Leaf | None = leaf(default=None, interval="(0, 1]", optional=True)
    dropped: Leaf | None = leaf(default=None, interval="[0, 1)", optional=True)
    late: int = static(default=0, interval="[0, inf)", whole=True)
    delayed: Leaf | None = leaf(default=None, interval="[0, 1)", optional=True)
    delay: int = static(default=1, interval="[1, inf)", whole=True)
    change: PlantChange | None = child(default=None)
    references: References | None = child(default=None)
    averaged: bool = static(default=False)

    def check(self, plant: Plant, task: Task) -> None:
        """Raises ValueError where the variation does not fit the plant or the task."""
        state = jax.eval_shape(lambda p: ravel_pytree(p.sampled(task.dt).initial_state())[0], plant)
        for name in ("offset", "scatter"):
            value = getattr(self, name)
            if value is not None and value.shape not in ((), state.shape):
                raise ValueError(
                    f"Variation: {name} has shape {value.shape}; the state of "
                    f"{type(plant).__name__} needs () or {state.shape}"
                )
        need_numbers(self, "carried", "shortest", "dropped", "delayed")
        for name in ("late", "delay"):
            value, most = getattr(self, name), max(task.N - 1, 1)
            if value > most:
                raise ValueError(
                    f"Variation: {name} = {value} is outside its allowed range, up to {most} for "
                    f"N = {task.N}"
                )
        self.need_measured("the settled window", task.settled.start, task)
        self._check_change(plant, task)
        shape = (task.N + 1, task.outputs)
        if self.references is not None and self.references.values.shape[1:] != shape:
            raise ValueError(
                f"References: values has shape {self.references.values.shape}; this task needs "
                f"(M, {shape[0]}, {shape[1]})"
            )

    def need_measured(self, window: str, start: int, task: Task) -> None:
        """Raises ValueError where a trial may end before a window that begins at a sample."""
        share, start = self.shortest, max(start, 1)
        if share is not None and known(share) and float(share) * task.N < start * (1 - 1e-6):
            raise ValueError(
                f"Variation: shortest = {share:g}: a trial may end at {share * task.duration:g} s, "
                f"before {window} begins at {start * task.dt:g} s; allowed is a shortest from "
                f"{np.ceil(1e6 * start / task.N) / 1e6:g} on, or a window that begins earlier"
            )

    def _check_change(self, plant: Plant, task: Task) -> None:
        if self.change is None:
            return
        plants = plant, self.change.after, self.change.before or plant
        shapes = []
        for one in plants:
            both = jax.eval_shape(lambda p: (p, p.sampled(task.dt)), one)
            leaves, structure = jax.tree.flatten(both)
            shapes.append((structure, [np.shape(leaf) for leaf in leaves]))
        if any(of != shapes[0] for of in shapes):
            raise ValueError(
                f"PlantChange: after is a {type(self.change.after).__name__} that does not fit the "
                f"plant, a {type(plant).__name__}; allowed is one of the same class and shapes"
            )

    @property
    def alike(self) -> bool:
        """Whether each trial has the same samples in its record, at the same instants."""
        drawn = (self.shortest, self.dropped, self.delayed)
        return self.late == 0 and all(value is None for value in drawn)

    @property
    def draws(self) -> bool:
        """Whether something is drawn for each trial."""
        return self.scatter is not None or not self.alike

    @property
    def last_change(self) -> int:
        """Number of the trial from which on nothing changes; 1 where nothing does."""
        drifted = 1 if self.change is None else self.change.first + self.change.over - 1
        return max(drifted, *(() if self.references is None else self.references.first), 1)

    # Of a trial
    # ----------------------------------------------------------------------------------------------

    def initial_state(self, plant: Plant, key: Array) -> Tree:
        """The state at the start of a trial, of a machine that does not carry it."""
        rest = plant.initial_state()
        if self.offset is None and self.scatter is None:
            return rest
        flat, unravel = ravel_pytree(rest)
        if self.offset is not None:
            flat = flat + self.offset
        if self.scatter is not None:
            drawn = jax.random.normal(jax.random.fold_in(key, SALT), flat.shape, flat.dtype)
            flat = flat + self.scatter * drawn
        return jax.tree.map(lambda at, x: x if _real(at) else at, rest, unravel(flat))

    def following(self, start: Start, end: Start) -> Start:
        """The start of the next trial: the share `carried` of the way from a start to an end."""

        share: Leaf = self.carried

        def between(a: Array, b: Array) -> Array:
            if not _real(a):
                return a
            known = jnp.isfinite(a)
            rest, last = (jnp.where(known, x, 0.0) for x in (a, b))
            mixed = (1 - share) * rest + share * last  # exact for a share of 0 or 1
            return jnp.where(known, mixed, jnp.where(share > 0, b, a))

        return jax.tree.map(between, start, end)

    def measured(self, task: Task, key: Array) -> Array | None:
        """(N+1,) 1 up to the end of the trial, 0 after it; None where trials have one length."""
        if self.shortest is None:
            return None
        return there_until(self.shortest, task.N, self._of(key, 1))

    def shown(self, trial: Trial, key: Array) -> Trial:
        """The record of a trial as it reaches the learning law."""
        if self.late or self.delayed is not None:
            trial = self._at_last(trial, key)
        if self.dropped is None:
            return trial
        kept = not_lost(self.dropped, len(trial.u), self._of(key, 2))
        return weighed(trial, jnp.broadcast_to(kept[:, None], trial.r.shape))

    def _at_last(self, trial: Trial, key: Array) -> Trial:
        """The record with the samples that are there at each instant."""
        y, e = trial.y, trial.e
        if trial.weight is not None:  # of trials that end early, a number for each sample
            share = trial.weight[:, :1, 0]
            y = trial.r - jnp.where(share > 0, e / jnp.where(share > 0, share, 1.0), e)
        if self.late:
            y = shifted(y, self.late, self._of(key, 3))
        if self.delayed is not None:
            y = newest(y, self.delayed, self.delay, self._of(key, 4))
        return trial._replace(y=output_weighed(trial, y))

    def _of(self, key: Array, number: int) -> Array | None:
        """The random key of one kind of draw of a trial; None for the mean."""
        return None if self.averaged else jax.random.fold_in(key, SALT + number)


# What of a record reaches the learning law, and how late: one draw, or with no key the mean of all
# --------------------------------------------------------------------------------------------------


def there_until(shortest: Array, N: int, key: Array | None) -> Array:
    """(N+1,) 1 up to the end of a trial that is drawn uniformly from [shortest, 1] of N samples."""
    k = np.arange(N + 1) / N
    if key is None:
        room = jnp.where(shortest < 1, 1 - shortest, 1.0)
        return 1 - jnp.clip((k - shortest) / room, 0.0, 1.0)
    shortest = without_slope(shortest)
    share = jax.random.uniform(key)
    last = jnp.floor(N * (shortest + (1 - shortest) * share) + 1e-9)
    return jnp.where(k * N <= last + 0.5, 1.0, 0.0)


def not_lost(dropped: Array, N: int, key: Array | None) -> Array:
    """(N+1,) 1 where a sample arrives, 0 where it is lost, with a chance, after k = 0."""
    if key is None:
        kept = jnp.full(N + 1, 1 - dropped)
    else:
        kept = jnp.where(jax.random.uniform(key, (N + 1,)) >= without_slope(dropped), 1.0, 0.0)
    return kept.at[0].set(1.0)


def shifted(y: Array, late: int, key: Array | None) -> Array:
    """(N+1, n_y) the record y, late as a whole by 0 .. late samples; at its start it is y[0]."""
    held = jnp.pad(y, ((late, 0), (0, 0)), mode="edge")
    if key is None:
        return jnp.stack([held[d : d + len(y)] for d in range(late + 1)]).mean(0)
    return jax.lax.dynamic_slice_in_dim(
        held, late - jax.random.randint(key, (), 0, late + 1), len(y)
    )


def newest(y: Array, delayed: Array, most: int, key: Array | None) -> Array:
    """(N+1, n_y) the newest sample of y that has arrived at each instant, held until the next one.

    Sample k needs delta_k samples to arrive: 0 with the chance 1 - delayed, else 1 .. most, all
    alike. At k the record holds y[m] with the largest m for which m + delta_m <= k; y[0] is known
    at once. With most = 1 that is the random one-step delay (1 - xi_k) y[k] + xi_k y[k-1].
    """
    rows = len(y)
    if key is None:
        held, mean = jnp.pad(y, ((most, 0), (0, 0)), mode="edge"), jnp.zeros_like(y)
        still: Leaf = 1.0
        for age in range(most + 1):  # still: the chance that no sample newer than k - age is there
            missing = delayed * (most - age) / most
            mean = mean + still * (1 - missing) * held[most - age : most - age + rows]
            still = still * missing
        return mean
    of_chance, of_delay = jax.random.split(key)
    slow = jax.random.uniform(of_chance, (rows,)) < without_slope(delayed)
    delay = jnp.where(slow, jax.random.randint(of_delay, (rows,), 1, most + 1), 0).at[0].set(0)
    k = jnp.arange(rows)
    arrives = k + delay
    at = jnp.zeros(rows, int).at[arrives].max(k, mode="drop")
    return jnp.asarray(y)[jax.lax.cummax(at)]


def without_slope(chance: Array) -> Array:
    """The chance itself; raises ValueError where it is differentiated.

    It is compared with a random number, so its slope is zero almost everywhere, and nothing about
    the mean.
    """
    return once(
        jnp.asarray(chance),
        "Variation: shortest, dropped and delayed are chances, of which a drawn trial has no "
        "gradient; allowed are gradients by all other parameters. Sweep a chance, or take "
        "differences of the mean over many machines with the same keys",
    )


def _real(x: Array) -> bool:
    return bool(jnp.issubdtype(jnp.result_type(x), jnp.floating))
