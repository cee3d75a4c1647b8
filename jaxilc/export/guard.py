"""The guard of an exported law: what `jaxilc next` refuses, as a part of the traced program.

Each function changes nothing where the law stays inside: it selects between two values, and then
that of the law to the last bit. The limits are those of `hardware.checks`.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from ..hardware.checks import (
    DEAD,
    GROWN,
    INPUTS,
    LARGER,
    LEARNED,
    LEAST,
    from_references,
    kind,
    peak,
)
from ..pytree.aliases import Array, Tree
from ..schemes import Scheme
from ..schemes.scheme import growth_of, trials_of_step
from ..signals.task import Task, Trial

MOVES = 0.1  # share of the limit; an input that reaches it moves its axis, if that sticks
# what the end of a trial tells, by its code
CODES = ("LEARNED", "SENSOR", "STUCK", "GROWN", "TOO_LARGE")
MEANINGS = (
    "the law has learned from the trial",
    "refused: an output or an input was not finite",
    "refused: an output stood still while the input moved",
    f"refused: the rms error is more than {GROWN:g} times the best",
    "refused: the next input is beyond its limit, grows too fast, or is not a number",
)


class Seen(NamedTuple):
    """What the guard remembers.

    best: smallest rms error of a trial so far, infinite before the first one [unit of y]
    learned: number of trials that the present memory was learned from
    largest: largest value of each learned schedule that was played [its unit]
    begun: that before anything was learned
    moved: (n_y,) whether each output has moved in a trial that was not refused
    fine: whether every output and input of the present trial was finite
    """

    best: Array
    learned: Array
    largest: dict[str, Array]
    begun: dict[str, Array]
    moved: Array
    fine: Array


class Trials(NamedTuple):
    """What the trials of a campaign tell the guard.

    best: smallest rms error of those that played what was learned, since the last accepted change;
        infinite without one [unit of y]
    learned: number of trials that were learned from
    largest: largest value of each schedule that was played, by name
    begun: that until the first trial that was learned from
    moved: (n_y,) whether each output moved in the last one
    """

    best: float
    learned: int
    largest: dict[str, float]
    begun: dict[str, float]
    moved: np.ndarray


def begun_by(trials: Trials, nothing: Seen) -> Seen:
    """What the guard knows after the trials of a campaign.

    nothing: what it knows before the first trial
    """
    largest, begun = (
        {name: jnp.asarray(of.get(name, 0.0), float) for name in nothing.largest}
        for of in (trials.largest, trials.begun)
    )
    best, learned = jnp.asarray(trials.best, float), jnp.asarray(trials.learned, float)
    return Seen(best, learned, largest, begun, jnp.asarray(trials.moved), nothing.fine)


def nothing_seen(scheme: Scheme, task: Task, schedule: Tree) -> Seen:
    """What the guard knows before the first trial."""
    largest = dict.fromkeys(_learned(scheme, task, schedule), jnp.zeros(()))
    return Seen(jnp.asarray(jnp.inf), jnp.zeros(()), largest, largest,
                jnp.zeros(task.outputs, bool), jnp.asarray(True))  # fmt: skip


def output(y: Array, last: Array) -> tuple[Array, Array]:
    """The output that the law sees, the last finite one in place of another; whether it was one."""
    return jnp.where(jnp.isfinite(y), y, last), jnp.all(jnp.isfinite(y))


def applied(u: Array, last: Array, limit: Array) -> tuple[Array, Array]:
    """The input within its limit, the last one in place of one that is not finite; likewise."""
    there = jnp.isfinite(u)
    return jnp.clip(jnp.where(there, u, last), -limit, limit), jnp.all(there)


def still(task: Task, y: ArrayLike) -> Array:
    """(n_y,) whether each output (N+1, n_y) stood still in a trial; y[0] is not an answer to u."""
    return jnp.ptp(jnp.asarray(y)[1:], axis=0) < DEAD * np.ptp(task.reference, axis=0)


def of_trial(scheme: Scheme, task: Task, seen: Seen, schedule: Tree, trial: Trial,
             limit: Array) -> tuple[Array, Seen]:  # fmt: skip
    """The code of a trial before it is learned from, and what the guard remembers of it.

    An axis that sticks has not moved yet, and learns until its input has reached `MOVES`: that of
    its own number where there are as many inputs as outputs, else any.
    """
    e, span = trial.r[1:] - trial.y[1:], float(np.ptp(task.reference))
    rms = jnp.sqrt(jnp.sum(e**2) / e.size)
    u, stood = trial.u, still(task, trial.y)
    driven = jnp.max(u, axis=0) > jnp.min(u, axis=0)
    hard = driven & (jnp.max(jnp.abs(u), axis=0) >= MOVES * limit)
    hard = hard if len(hard) == len(stood) else jnp.any(hard)
    stuck = jnp.any(driven) & jnp.any(stood & (seen.moved | hard))
    # a trial that was an experiment is compared with none
    turns = seen.learned / trials_of_step(scheme, task)
    compared = turns == jnp.floor(turns)
    grown = compared & (rms > GROWN * jnp.maximum(seen.best, LEAST * span))
    fine = seen.fine & jnp.isfinite(rms)
    code = jnp.where(~fine, 1, jnp.where(stuck, 2, jnp.where(grown, 3, 0))).astype(jnp.int32)
    best = jnp.where((code == 0) & compared, jnp.minimum(seen.best, rms), seen.best)
    peaks = {name: peak(name, of, task) for name, of in _learned(scheme, task, schedule).items()}
    largest = {name: jnp.maximum(seen.largest[name], of) for name, of in peaks.items()}
    begun = {name: jnp.where(seen.learned == 0, jnp.maximum(seen.begun[name], of), seen.begun[name])
             for name, of in peaks.items()}  # fmt: skip
    moved = seen.moved | ((code == 0) & ~stood)
    return code, Seen(best, seen.learned, largest, begun, moved, seen.fine)


def of_next(scheme: Scheme, task: Task, seen: Seen, memory: Tree, schedule: Tree, limit: Array,
            correction: float | None) -> Array:  # fmt: skip
    """Whether what was learned is played: a number, within its limit, and no larger than learned.

    peak <= 1.1 g (largest + (largest + |u_1|) / j),    as in `hardware.checks.larger`
    """
    of_reals = [x for x in jax.tree.leaves(memory) if jnp.issubdtype(x.dtype, jnp.floating)]
    good = [jnp.all(~jnp.isnan(x)) for x in of_reals]
    for name, of in scheme.played(schedule, task).items():
        good.append(jnp.all(jnp.isfinite(of)))
        if kind(name) in INPUTS:
            good.append(jnp.all(jnp.abs(of) <= limit))
        if kind(name) == "reference" and correction is not None:
            away = jnp.min(jnp.max(jnp.abs(from_references(of, task)), axis=0), axis=-1)
            good.append(jnp.all(away <= correction))
    steps = jnp.floor(seen.learned / scheme.trials_a_step)
    most, j = LARGER * growth_of(scheme, task), jnp.maximum(1.0, steps)
    for name, of in _learned(scheme, task, schedule).items():
        largest = seen.largest[name]
        allowed = most * (largest + (largest + seen.begun[name]) / j)
        good.append((steps == 0) | (largest == 0) | (peak(name, of, task) <= allowed))
    return jnp.all(jnp.stack(good)) if good else jnp.asarray(True)


def _learned(scheme: Scheme, task: Task, schedule: Tree) -> dict[str, Array]:
    found = scheme.played(schedule, task) if scheme.learns else {}
    return {name: of for name, of in found.items() if kind(name) in LEARNED}
