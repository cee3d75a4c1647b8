"""Trials as theory runs them: without noise, with a given signal played or a given output."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
from jax import lax

from ..learning.machine import Disturbance, Machine
from ..learning.variation import Variation
from ..learning.within_trial import run_trial
from ..plants import InBlocks
from ..pytree.aliases import Tree, Value
from ..pytree.fields import child, pytree
from ..schemes import Scheme, WithFeedback
from ..schemes.compose import Pair
from ..schemes.scheme import Feedforward, Memory, Schedule, State, Wrapper
from ..signals.task import Sample, Task, Trial

# trials before a scheme that adapts is looked at: by then one of two-trial increments has seen
# data
LEARNED = 3
Key = jax.Array | None  # of what is drawn of the record of a trial; None for its mean


def trial_of(machine: Machine, scheme: Scheme, task: Task, memory, key: Key = None) -> Trial:
    """One trial without noise, sample by sample, in which a linear plant is seen to be linear.

    `InBlocks` would choose by its signals between its blocks and these same steps.
    key: of what is drawn of the record; None for its mean
    """
    machine = machine.noiseless(averaged=key is None)
    if isinstance(machine.plant, InBlocks):
        machine = with_plant_within(machine)
    return run_trial(machine, scheme, task, memory, jax.random.key(0) if key is None else key)


def step(machine: Machine, scheme: Scheme, task: Task, memory):
    """The memory after one more trial, without noise."""
    return learned_from(machine, scheme, memory, trial_of(machine, scheme, task, memory))


def shown_of(machine: Machine, trial: Trial, key: Key = None) -> Trial:
    """The record of a trial as it reaches the law. key: as for `trial_of`"""
    quiet = machine.noiseless(averaged=key is None)
    return quiet.shown(trial, jax.random.key(0) if key is None else key)


def learned_from(machine: Machine, scheme: Scheme, memory, trial: Trial, key: Key = None):
    """The memory after a trial of the machine, of which the law sees what the machine shows."""
    return scheme.learn(memory, shown_of(machine, trial, key))


@jax.jit
def learned_memory(machine: Machine, scheme: Scheme, task: Task):
    """The memory after `LEARNED` trials from the start, without noise."""
    scheme = scheme.prepared(task)
    turn = lambda _, memory: step(machine, scheme, task, memory)  # noqa: E731
    return lax.fori_loop(0, LEARNED, turn, scheme.initial_memory(task))


def memory_at_last_change(machine: Machine, scheme: Scheme, task: Task) -> Memory:
    """The memory before the trial from which on nothing changes, without noise.

    Limits of machine and scheme, which is prepared, count.
    """
    machine, scheme = lax.stop_gradient((machine.noiseless(), scheme))

    def turn(j, memory):
        trial = run_trial(machine, scheme, task, memory, jax.random.key(0), j)
        return learned_from(machine, scheme, memory, trial)

    return lax.fori_loop(1, machine.last_change, turn, scheme.initial_memory(task))


def learned_shape(scheme: Scheme | None, task: Task) -> tuple[int, ...] | None:
    """(N, m) of what a scheme learns and plays back; None for one that learns no feedforward."""
    if scheme is None:
        return None
    try:
        return jax.eval_shape(lambda: scheme.feedforward(scheme.initial_memory(task), task)).shape
    except ValueError:
        return None


def played(
    machine: Machine, scheme: Scheme | None, task: Task, memory, learned, key: Key = None
) -> Trial:
    """A trial that plays `learned` (N, m) in place of what the scheme learned.

    The scheme acts within the trial as usual. Where it learns no feedforward, `learned` (N, n_u) is
    added to its input. None is a machine without a scheme. key: as for `trial_of`
    """
    if scheme is None:
        return trial_of(machine, Scheme(), task, Feedforward(learned), key)
    if learned_shape(scheme, task) is None:
        both = WithFeedback(Scheme(), scheme)
        return trial_of(machine, both, task, Pair(Feedforward(learned), memory), key)
    return trial_of(machine, _Playing(scheme), task, (memory, learned), key)


def next_learned(scheme: Scheme, task: Task, memory, learned, e, e0: Value = 0.0):
    """(N, m) what a scheme plays after a trial that played `learned` (N, m) with errors e (N, n_y).

    e:  (N, n_y) the errors e[1..N]
    e0: (n_y,) e[0], which no input can reach

    Raises ValueError for a scheme that learns no feedforward.
    """
    e = jnp.concatenate([jnp.broadcast_to(e0, (1, e.shape[1])), e])
    return scheme.feedforward(scheme.learn(memory, scheme.record(learned, e, task)), task)


@jax.jit
def starts_off(machine: Machine, scheme: Scheme, task: Task):
    """Whether a trial begins with an error, e[0] other than zero."""
    return jnp.any(trial_of(machine, scheme, task, scheme.initial_memory(task)).e[0] != 0)


def with_plant_within(machine: Machine) -> Machine:
    """The machine with the plant within its own one, also in a change of it."""
    own: Tree = machine.plant
    variation = machine.variation
    if variation is not None and (change := variation.change) is not None:
        plants = {name: getattr(change, name) for name in ("after", "before", "course")}
        inner = {name: getattr(of, "plant", None) for name, of in plants.items()}
        variation = dataclasses.replace(variation, change=dataclasses.replace(change, **inner))
    return dataclasses.replace(machine, plant=own.plant, variation=variation)


def shortened(task: Task, samples: int) -> Task:
    """The first so many samples of the task, or the task with its reference held at its end."""
    r = jnp.asarray(task.reference)[: samples + 1]
    r = jnp.pad(r, ((0, max(samples - task.N, 0)), (0, 0)), mode="edge")
    return dataclasses.replace(task, reference=r, settle=None)


def disturbed(machine: Machine, name: str, d) -> Machine:
    """The machine with d on top of its own repetitive disturbance of this name.

    name: "output", d (N+1, n_y); "input", (N, n_u); or "offset", of the states at the start
    """
    part, kind = ("variation", Variation) if name == "offset" else ("disturbance", Disturbance)
    found = getattr(machine, part) or kind()
    own = getattr(found, name)
    changed = dataclasses.replace(found, **{name: d if own is None else own + d})
    return dataclasses.replace(machine, **{part: changed})


@pytree
class _Playing(Wrapper):
    """A scheme that plays a given signal. Its memory is the scheme's, and what is played."""

    scheme: Scheme = child()

    def schedule(self, memory: Memory, task: Task) -> Schedule:
        return self.scheme.play(memory[1], memory[0], task)


@pytree
class Prescribed(Wrapper):
    """A scheme that is shown a prescribed output instead of the measured one.

    Its memory is the scheme's, and that output (N+1, n_y).
    """

    scheme: Scheme = child()

    @property
    def plays_back(self) -> bool:
        return False

    def schedule(self, memory: Memory, task: Task) -> Schedule:
        return self.scheme.schedule(memory[0], task), memory[1][:-1]

    def act(self, state: State, sample: Sample) -> tuple[State, jax.Array]:
        row, y = sample.row
        return self.scheme.act(state, sample._replace(row=row, y=y))
