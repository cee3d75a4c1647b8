"""Learning over many trials: as a scan in simulation, and step by step for a real machine."""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable
from functools import lru_cache, partial
from typing import NamedTuple

import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jax import lax

from ..plants import Plant
from ..plants.structure import obstacle
from ..pytree.aliases import Array, Tree, Value
from ..pytree.in_short import in_short
from ..pytree.ranges import brief, concrete, native, require
from ..runtime.capacity import bytes_of, check_size
from ..runtime.jax_internals import of_any_ranks
from ..runtime.lanes import STORED_BESIDES, machines_side_by_side, usual_stored
from ..schemes import Scheme
from ..schemes.scheme import trials_of_step
from ..signals.rows import for_carry
from ..signals.task import Task, Trial
from .divergence import course
from .known_metrics import Metrics, bytes_of_metrics
from .machine import Machine
from .metrics import Watch
from .rehearsal import fitting_memory, need_double, need_fitting_memory, need_pytrees, rehearse
from .within_trial import first_start, run_and_measure

LITTLE = 2**24  # bytes, below which the size is not checked
# number of signals that a trial holds in RAM while it runs, with its schedule and its copies
OF_A_TRIAL = 32
PROGRAMS = 8  # number of compiled programs, of different `save`, that are kept


class History(NamedTuple):
    """The results of learning over J trials.

    metrics: metrics of the trials, each field with a leading axis of length J
    saved: what `save` returned for the trials, each leaf with a leading axis of length J
    diverged: (J,) whether each trial diverged, see `divergence.Course`
    diverged_at: () number of the first trial that diverged, 0 if none did
    grown_from: () number of the trial from which on the error has grown, 0 if it has not
    memory: the memory after the last trial, from which learning can be continued
    start: where the next trial would start, of a machine that carries its state; else None
    watched: what the `watch` of `learn` found, by name: () numbers, and (J,) of the trials
    """

    metrics: Metrics
    saved: Tree
    diverged: Array
    diverged_at: Array
    grown_from: Array
    final: Trial
    memory: Tree
    start: Tree = None
    watched: Tree = None

    def __repr__(self) -> str:
        return in_short(self)

    def __getattr__(self, name: str) -> Array:
        """A metric of each trial by its name, such as `rms` (J, n_y), see `metrics.Metrics`."""
        if name in Metrics._fields:
            return getattr(self.metrics, name)
        raise AttributeError(f"History has no {name!r}; its metrics are {Metrics._fields}")


@of_any_ranks
def learn(
    machine: Machine,
    scheme: Scheme,
    task: Task,
    trials: int,
    *,
    key: Array | None = None,
    memory: Tree = None,
    first: int = 1,
    save: Callable[[Trial], Tree] | None = None,
    start: Tree = None,
    trials_a_pass: int = 1,
    watch: Watch | None = None,
) -> History:
    """Repeat the task J times, with a learning step after each trial.

    machine: the machine that repeats the task
    scheme: the scheme that learns
    trials: J >= 1
    key: random key of the noise; trial j uses `fold_in(key, j)`; None: a fixed key
    memory: memory to continue from, such as `history.memory`; None: start without knowledge
    first: number j of the first trial, up to 2e9, so that the noise is continued too
    save: function of a trial that returns what to keep of it besides its metrics; None: nothing
    start: where the first trial starts, such as `history.start`; None: where the machine rests
    trials_a_pass: trials in each pass of the compiled loop. With 2, the second reads what the first
        wrote without a copy: a long run takes up to an eighth less time, compiling takes twice as
        long, and a gradient gains nothing. It counts as 1 where it does not divide J / B, see below
    watch: what looks at each trial beside the one before it; None: nothing

    The function is compatible with `grad` and `vmap`. A gradient stores no samples (see also
    `outputs_suffice`), but the memories of all trials where they take up to 4 MiB (on a CPU).
    Beyond that, it stores those of B + J / B trials, where B is the largest divisor of J that is
    not larger than its square root (20 memories for J = 100; for a prime J about J), and runs all
    trials once more.
    Raises ValueError, before anything is compiled, where machine, scheme, task, memory and start do
    not fit.
    """
    trials, first, trials_a_pass = map(concrete, (trials, first, trials_a_pass))
    require("learn", "trials", trials, "[1, inf)", whole=True)
    require("learn", "trials_a_pass", trials_a_pass, "[1, inf)", whole=True)
    if not isinstance(first, jax.core.Tracer):
        require("learn", "first", first, "[1, 2e9]", whole=True)
    if save is not None and not (callable(save) and isinstance(save, Hashable)):
        raise ValueError(
            f"learn: save = {save!r} is not a function of a trial; allowed are functions, and "
            "objects that can be hashed"
        )
    check(machine, scheme, task)
    if watch is not None:
        need_kinds(watch=watch)
    memory, start = jax.tree.map(native, (memory, start))
    _check_what_goes_on(machine, scheme, task, key, memory, start)
    trials, size = int(trials), bytes_of_metrics(task)
    if trials * size > LITTLE:
        check_size("learn", 2 * size, trials=trials)
    key = jax.random.key(0) if key is None else key
    return _program(save or _nothing, int(trials_a_pass), watch, usual_stored())(
        machine, scheme, task, trials, key, memory, jnp.asarray(first, int), start
    )


@of_any_ranks
def check(machine: Machine, scheme: Scheme, task: Task) -> None:
    """Raises ValueError where machine, scheme and task do not fit together or not into RAM.

    The message names the parameter.
    """
    need_kinds(machine=machine, scheme=scheme, task=task)
    if task.reference.ndim != 2:
        raise ValueError(
            f"Task: reference has shape {task.reference.shape}; allowed is (N+1, n_y), and "
            "of tasks that are stacked each by itself: write jax.vmap"
        )
    need_pytrees(machine, scheme)
    check_length(task, scheme)
    machine.check(task)
    try:
        scheme.check(task)
        rehearse(machine, scheme, task)
    except TypeError as error:
        need_double(scheme, error)
        raise
    _need_one_reference_a_step(machine, scheme)


def _need_one_reference_a_step(machine: Machine, scheme: Scheme) -> None:
    """Raises ValueError where the reference changes within the trials of one learning step."""
    references, every = getattr(machine.variation, "references", None), scheme.trials_a_step
    if references is None or every == 1 or len(references.values) == 1:
        return
    within = [j for j in references.first if (j - 1) % every]
    if within or not references.first:
        when = f"in trial {within[0]}" if within else "after each trial"
        raise ValueError(
            f"{type(scheme).__name__} learns from {every} trials together, of one reference, and "
            f"variation.references changes it {when}; allowed are changes with the first trial of "
            f"a step, {1 + every}, {1 + 2 * every} and so on"
        )


def need_kinds(**given: Value) -> None:
    """Raises ValueError unless each is what it is called: machine, scheme, task or watch."""
    kinds = {"machine": Machine, "scheme": Scheme, "task": Task, "watch": Watch}
    for name, value in given.items():
        if not isinstance(value, kinds[name]):
            hint = ": write Machine(plant)" if isinstance(value, Plant) else ""
            raise ValueError(
                f"{name} = {brief(value)} is a {type(value).__name__}; "
                f"allowed is a {kinds[name].__name__}{hint}"
            )


def _check_what_goes_on(
    machine: Machine, scheme: Scheme, task: Task, key: Tree, memory: Tree, start: Tree
) -> None:
    """Raises ValueError for a key, a memory or a start that `learn` cannot begin with."""
    kind = getattr(key, "dtype", np.dtype(object))
    if key is not None and kind != np.uint32 and not jnp.issubdtype(kind, jax.dtypes.prng_key):
        raise ValueError(f"learn: key = {brief(key)} is no random key, as jax.random.key(0) is")
    if isinstance(memory, History):
        raise ValueError("learn: memory is a History; allowed is the memory in it, history.memory")
    if memory is not None:
        need_fitting_memory(scheme, task, memory)
    if start is not None and not machine.carries:
        raise ValueError(
            f"learn: start = {brief(start)} is for a machine that carries its state; this one "
            "rests before each trial, so allowed is None"
        )


@lru_cache(maxsize=PROGRAMS)
def _program(
    save: Callable[[Trial], Tree], trials_a_pass: int, watch: Watch | None = None, stored: int = 0
) -> Tree:
    """The compiled `_learn` for this `save`, this `watch`, and the bytes that a gradient stores.

    Each new lambda is another `save`, so the programs that were not used for longest are dropped.
    """
    program = partial(_learn, save=save, watch=watch, trials_a_pass=trials_a_pass, stored=stored)
    return jax.jit(program, static_argnames="trials")


def check_length(task: Task, scheme: Scheme) -> None:
    """Raises ValueError where one trial, or the preview of its samples, does not fit in RAM."""
    signals = 8 * OF_A_TRIAL * max(task.outputs, task.inputs)
    seen = 8 * 2 * task.outputs * (task.N + 1)
    if task.N * signals + seen * scheme.preview > LITTLE:
        check_size("one trial", signals, samples=task.N)
        check_size("one trial", seen, preview=scheme.preview)


def _learn(
    machine: Machine,
    scheme: Scheme,
    task: Task,
    trials: int,
    key: Array,
    memory: Tree,
    first: Array,
    start: Tree,
    *,
    save: Callable[[Trial], Tree],
    watch: Watch | None,
    trials_a_pass: int,
    stored: int,
) -> History:
    machine, scheme = machine.sampled(task.dt), scheme.prepared(task)
    known = {} if watch is None else watch.known(machine, scheme, task)
    if memory is not None and watch is not None:
        known = watch.continued(known, machine, scheme, task, memory)
    memory = scheme.initial_memory(task) if memory is None else memory

    if machine.carries and start is None:
        at, of = machine.at_trial(task, first)
        start = first_start(at, scheme, of, jax.random.fold_in(key, first))
    memory, start = jax.tree.map(jnp.asarray, (memory, start))  # users' numbers are arrays, too

    names = [STORED_BESIDES] if outputs_suffice(machine, scheme, task) else []

    @partial(jax.checkpoint, policy=jax.checkpoint_policies.save_only_these_names(*names))
    def trial_and_learning(memory: Tree, start: Tree, j: Array) -> Tree:
        now, memory = jax.random.fold_in(key, j), scheme.resumed(memory)
        trial, metrics, start = run_and_measure(machine, scheme, task, memory, now, j, start)
        learned = scheme.learn(memory, machine.shown(trial, now))
        return learned, trial, start, (metrics, save(trial))

    def body(carry: Tree, j: Array) -> tuple[Tree, Tree]:
        memory, trial, start, kept = trial_and_learning(for_carry(carry[0]), carry[2], j)
        return (for_carry(memory), trial, start), (*kept, compared(carry[1], trial, j))

    def compared(before: Tree, trial: Trial, j: Array) -> dict[str, Value]:
        if watch is None:
            return {}
        seen = watch.seen(known, scheme, *lax.stop_gradient((before, trial)))
        return {name: jnp.where(j == first, jnp.nan, x) for name, x in seen.items()}

    # with a number of the type of j, so that the scan finds the trial traced already
    shape = jax.eval_shape(trial_and_learning, memory, start, first)[1]
    blank = jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shape)
    blocks = _blocks(trials, (memory, start), stored)
    unroll = 1 if trials // blocks % trials_a_pass else trials_a_pass
    block = partial(lax.scan, body, unroll=unroll)
    # a gradient is computed block by block, and each block is run again from the memory at its
    # start
    (memory, final, start), kept = lax.scan(
        jax.checkpoint(block) if blocks > 1 else block,
        (memory, blank, start),
        (first + jnp.arange(trials)).reshape(blocks, -1),
    )
    metrics, saved, seen = jax.tree.map(lambda rows: rows.reshape(trials, *rows.shape[2:]), kept)
    every = trials_of_step(scheme, task)
    judged = course(metrics, task, first, every)
    return History(metrics, saved, *judged, final, memory, start, dict(known) | seen)


def outputs_suffice(machine: Machine, scheme: Scheme, task: Task) -> bool:
    """Whether a gradient stores the outputs of each trial, and numbers gathered from its samples.

    With them, the way back of a compiled program need not run the trial again, where the law is
    elementwise and the plant linear. CFDL-MFAILC takes 0.9 of the time. A gradient of XLA, or of
    another law, would only read more from the RAM.
    """
    if not (machines_side_by_side() and scheme.elementwise) or machine.actuator is not None:
        return False

    def after(plant: Plant, before: tuple[Tree, Array]) -> tuple[Tree, Array]:
        x = plant.step(*before, task.dt)
        return x, plant.output(x)

    plant = machine.plant
    return not obstacle(after, plant, (plant.initial_state(), jnp.zeros(plant.n_u)))


def _blocks(trials: int, memory: Tree, stored: int) -> int:
    """The number B of blocks of trials for which a gradient stores the memory at the start.

    It is 1 where the memories of all trials may be stored.
    """
    if trials * bytes_of(memory) <= stored:
        return 1
    return max(d for d in range(1, math.isqrt(trials) + 1) if trials % d == 0)


def _nothing(trial: Trial) -> None:
    return None


def truncated(
    machine: Machine,
    scheme: Scheme,
    task: Task,
    trials: int,
    last: int,
    *,
    first: int = 1,
    **options: Value,
) -> History:
    """Learning with truncated back-propagation (Williams and Peng 1990).

    The gradient is that of the last trials alone; the results are those of `learn`.

    trials: J, number of all trials
    last: number of trials at the end that the gradient includes
    first, options: further arguments of `learn`, but for `watch`
    Raises ValueError as `learn` does, for `last` beyond J, and for a `watch`, which compares each
    trial with the one before it, across the two parts too.
    """
    trials, last = map(concrete, (trials, last))
    require("truncated", "last", last, f"[1, {trials}]", whole=True)
    if options.get("watch") is not None:
        raise ValueError("truncated: watch = ... compares trials of both parts; allowed is None")
    if last == trials:
        return learn(machine, scheme, task, trials, first=first, **options)
    before = learn(
        *lax.stop_gradient((machine, scheme)), task, trials - last, first=first, **options
    )
    before = lax.stop_gradient(before)  # also by the task and by a memory to continue from
    goes_on: dict[str, Tree] = options | {"memory": before.memory, "start": before.start}
    after = learn(machine, scheme, task, last, first=first + trials - last, **goes_on)
    metrics, saved = jax.tree.map(
        lambda *both: jnp.concatenate(both),
        (before.metrics, before.saved),
        (after.metrics, after.saved),
    )
    judged = course(metrics, task, first, trials_of_step(scheme, task))
    return after._replace(metrics=metrics, saved=saved, **judged._asdict())


def measured_trial(task: Task, y: Value, u: Value, **signals: Value) -> Trial:
    """The record of a trial measured on a real machine.

    y: (N+1, n_y) or (N+1,) output, with y[0] measured before the first input [unit of y]
    u: (N, n_u) or (N,) input as it was applied [unit of u]
    signals: (N, n_u), (N, n_y) or (N,) further signals that the scheme needs, by name, such as
        `feedback`, the contribution of the feedback to u, for `WithFeedback`
    Raises ValueError, naming the signal, where its length or its number of channels does not fit
    the task, and where a value is not finite.
    """
    of_u, of_y = (task.N, task.inputs), (task.N, task.outputs)
    of_all = dict.fromkeys(signals, (of_u, of_y) if of_u != of_y else (of_u,))
    shapes = of_all | {"y": ((task.N + 1, task.outputs),), "u": (of_u,)}
    measured = {}
    for name, values in {"y": y, "u": u, **signals}.items():
        values = np.ma.filled(np.ma.asarray(values, dtype=float), np.nan)
        values = values[:, None] if values.ndim == 1 else values
        if values.shape not in shapes[name]:
            needed = " or ".join(map(str, shapes[name]))
            raise ValueError(
                f"measured_trial: {name} has shape {np.shape(values)}; this task needs {needed}"
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


def next_memory(
    scheme: Scheme, task: Task, memory: Tree, y: Value, u: Value, **signals: Value
) -> Tree:
    """The memory of the scheme after a measured trial: one step of learning on a real machine.

    `feedforward` then gives the next input. The arguments are those of `measured_trial`, which also
    says what is raised, besides ValueError for a memory of another scheme or task. A memory of None
    is that before the first trial.
    """
    return scheme.learn(fitting_memory(scheme, task, memory), measured_trial(task, y, u, **signals))


def feedforward(scheme: Scheme, task: Task, memory: Tree) -> Array:
    """The input (N, n_u) that the scheme will play back in the next trial.

    Feedback within the trial is added to it. For `OnReference` it is the correction of the
    reference. A memory of None is that before the first trial. Raises ValueError for a scheme that
    learns no feedforward, and for a memory of another scheme or task.
    """
    return scheme.feedforward(fitting_memory(scheme, task, memory), task)
