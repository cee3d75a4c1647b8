"""Learning: the scan over trials, and the same loop by hand for a real machine."""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jax import lax

from ..plants import Plant
from ..pytree.ranges import brief, require
from ..runtime.capacity import check_size
from ..schemes import Scheme
from ..signals.task import Task, Trial
from .divergence import course
from .known_metrics import Metrics, bytes_of_metrics
from .machine import Machine
from .rehearsal import need_pytrees, rehearse
from .sample_layout import for_carry
from .within_trial import run_and_measure

LITTLE = 2**24  # bytes, below which no size is looked at
# signals of its length that a trial takes while it runs, its schedule and its copies among them
OF_A_TRIAL = 32
PROGRAMS = 8  # of different `save` that stay compiled


class History(NamedTuple):
    """What learning left behind, J trials.

    metrics: each field with a leading axis of J;  saved: what `save` returned, likewise
    diverged, diverged_at, grown_from: (J,), (), () how learning went, see `divergence.Course`
    final: the last Trial;  memory: the state of knowledge to go on from
    """

    metrics: Metrics
    saved: Any
    diverged: jax.Array
    diverged_at: jax.Array
    grown_from: jax.Array
    final: Trial
    memory: Any

    def __getattr__(self, name: str) -> jax.Array:
        """A metric of each trial by its name: `rms` is (J, n_y), see `metrics.Metrics`."""
        if name in Metrics._fields:
            return getattr(self.metrics, name)
        raise AttributeError(f"History has no {name!r}; its metrics are {Metrics._fields}")


def learn(
    machine: Machine,
    scheme: Scheme,
    task: Task,
    trials: int,
    *,
    key: jax.Array | None = None,
    memory: Any = None,
    first: int = 1,
    save: Callable[[Trial], Any] | None = None,
) -> History:
    """Repeat the task, learning after each trial.

    trials: J >= 1;  key: of the noise, trial j uses `fold_in(key, j)`; None is a fixed key
    memory: to go on from (`history.memory`), None to start afresh;  first: number j of the first
    trial, so that the noise goes on too
    save: what to keep of each trial, besides its metrics
    Differentiable and vmappable; a gradient stores no samples, but the memories of B + J / B
    trials, B the largest divisor of J up to its root (20 for J = 100; a prime J takes J).
    Raises ValueError, before anything is compiled, where machine, scheme and task do not fit.
    """
    require("learn", "trials", trials, "[1, inf)", whole=True)
    if not isinstance(first, jax.core.Tracer):
        require("learn", "first", first, "[1, inf)", whole=True)
    if save is not None and not (callable(save) and isinstance(save, Hashable)):
        raise ValueError(
            f"learn: save = {save!r} is not a function of a trial; allowed are functions, and "
            "objects that can be hashed"
        )
    check(machine, scheme, task)
    size = bytes_of_metrics(task)
    if trials * size > LITTLE:
        check_size("learn", lambda trials: 2 * size * trials, trials=trials)
    key = jax.random.key(0) if key is None else key
    return _program(save or _nothing)(
        machine, scheme, task, int(trials), key, memory, jnp.asarray(first, int)
    )


def check(machine: Machine, scheme: Scheme, task: Task) -> None:
    """Raises ValueError, naming the parameter, where machine, scheme and task do not fit, and for a
    task that memory cannot hold.
    """
    for name, given, wanted in (
        ("machine", machine, Machine),
        ("scheme", scheme, Scheme),
        ("task", task, Task),
    ):
        if not isinstance(given, wanted):
            hint = ": write Machine(plant)" if isinstance(given, Plant) else ""
            raise ValueError(
                f"{name} = {brief(given)} is a {type(given).__name__}; "
                f"allowed is a {wanted.__name__}{hint}"
            )
    need_pytrees(machine, scheme)
    check_length(task, scheme)
    machine.check(task)
    scheme.check(task)
    rehearse(machine, scheme, task)


@lru_cache(maxsize=PROGRAMS)
def _program(save: Callable[[Trial], Any]) -> Any:
    """`_learn` to be compiled with this `save`. Each new lambda is another one, so those that were
    used longest ago are let go.
    """
    return jax.jit(partial(_learn, save=save), static_argnames="trials")


def check_length(task: Task, scheme: Scheme) -> None:
    """Raises ValueError where a single trial of the task does not fit into memory, or what the
    scheme sees ahead of each sample.
    """
    signals, seen = (
        8 * OF_A_TRIAL * max(task.outputs, task.inputs),
        8 * 2 * task.outputs * (task.N + 1),
    )
    if task.N * signals + seen * scheme.preview > LITTLE:
        check_size("one trial", lambda samples: signals * samples, samples=task.N)
        check_size("one trial", lambda preview: seen * preview, preview=scheme.preview)


def _learn(machine, scheme, task, trials, key, memory, first, save) -> History:
    machine, scheme = machine.sampled(task.dt), scheme.prepared(task)
    memory = scheme.initial_memory(task) if memory is None else memory

    @jax.checkpoint
    def trial_and_learning(memory, j):
        trial, metrics = run_and_measure(machine, scheme, task, memory, jax.random.fold_in(key, j))
        return scheme.learn(memory, trial), trial, (metrics, save(trial))

    def body(carry, j):
        memory, trial, kept = trial_and_learning(for_carry(carry[0]), j)
        return (for_carry(memory), trial), kept

    blank = jax.tree.map(
        lambda s: jnp.zeros(s.shape, s.dtype), jax.eval_shape(trial_and_learning, memory, 1)[1]
    )
    blocks = max(d for d in range(1, math.isqrt(trials) + 1) if trials % d == 0)
    # two trials a turn: what one wrote the next reads, and nothing is copied to where it came from
    block = partial(lax.scan, body, unroll=1 if trials // blocks % 2 else 2)
    # a gradient goes back block by block, each run again from the memory at its start
    (memory, final), kept = lax.scan(
        jax.checkpoint(block) if blocks > 1 else block,
        (memory, blank),
        (first + jnp.arange(trials)).reshape(blocks, -1),
    )
    metrics, saved = jax.tree.map(lambda rows: rows.reshape(trials, *rows.shape[2:]), kept)
    return History(metrics, saved, *course(metrics, task, first), final, memory)


def _nothing(trial: Trial) -> None:
    return None


def truncated(
    machine: Machine, scheme: Scheme, task: Task, trials: int, last: int, **options
) -> History:
    """Learning, of which the gradient sees the last trials alone (truncated back-propagation:
    Williams and Peng 1990).
    """
    first = trials - last + 1
    before = learn(*lax.stop_gradient((machine, scheme)), task, first - 1, **options)
    after = learn(machine, scheme, task, last, memory=before.memory, first=first, **options)
    metrics, saved = jax.tree.map(
        lambda *both: jnp.concatenate(both),
        (before.metrics, before.saved),
        (after.metrics, after.saved),
    )
    return after._replace(metrics=metrics, saved=saved, **course(metrics, task)._asdict())


def measured_trial(task: Task, y, u, **signals) -> Trial:
    """The record of a trial measured on a real machine.

    y: (N+1, n_y) or (N+1,) output, y[0] before the first input;  u: (N, n_u) or (N,) input as
    applied
    signals: (N, n_u) or (N,) what the scheme needs besides, by name: `feedback`, the feedback's
    share of u, for `WithFeedback`
    Raises ValueError naming the signal where its length, channels or values are not those of the
    task.
    """
    shapes = {"y": (task.N + 1, task.outputs)} | dict.fromkeys(
        ("u", *signals), (task.N, task.inputs)
    )
    measured = {}
    for name, values in {"y": y, "u": u, **signals}.items():
        shape = shapes[name]
        values = np.asarray(values, dtype=float)
        values = values[:, None] if values.ndim == 1 else values
        if values.shape != shape:
            raise ValueError(
                f"measured_trial: {name} has shape {np.shape(values)}; this task needs {shape}"
            )
        if not np.all(np.isfinite(values)):
            raise ValueError(
                f"measured_trial: {name} is not finite at sample "
                f"{int(np.argmin(np.isfinite(values).all(axis=1)))}"
            )
        measured[name] = jnp.asarray(values)
    return Trial(
        jnp.asarray(task.reference), measured.pop("y"), measured.pop("u"), task.dt, measured
    )


def next_memory(scheme: Scheme, task: Task, memory, y, u, **signals) -> Any:
    """One turn of the loop by hand: what the scheme knows after a measured trial; `feedforward`
    then gives the next input.

    Raises as `measured_trial` does.
    """
    return scheme.learn(memory, measured_trial(task, y, u, **signals))


def feedforward(scheme: Scheme, task: Task, memory) -> jax.Array:
    """(N, n_u) the input that the scheme will play back in the next trial; feedback within the
    trial comes on top.

    Of `OnReference` it is the correction of the reference. Raises ValueError for a scheme that
    learns no feedforward.
    """
    return scheme.feedforward(memory, task)
