"""One trial and its learning as a map of what is played.

The map takes w_j, what is learned so far, to w_{j+1} = F(w_j). Limits are left out. Where learning
depends on the last trial alone, w is what the scheme plays back, its `feedforward`, as far as
learning ever changes it: under a law with a lead, the last samples are never learned and do not
deviate from anything. A scheme that remembers more, as learning of higher order does, has all that
it knows for w. For a linear law on a linear machine F is affine; see `linearity`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from ..learning.machine import Machine
from ..schemes import Scheme
from ..signals.task import Task
from .linearity import remembers
from .trials import learned_from, learned_shape, next_learned, played, shown_of, trial_of


class View(NamedTuple):
    """What the vector w of a scheme consists of.

    whole:  whether w is all that the scheme knows, in place of its feedforward
    moving: (n,) which entries of it learning ever changes; all, where it changes none
    """

    whole: bool
    moving: tuple[int, ...]


class Learning(NamedTuple):
    """The learning map and what belongs to it, as functions of the flat vector w (n,).

    start:     (n,) the w of the first trial
    following: F, from w to the w of the next trial
    error:     from w to (N n_y,), the errors e[1..N] of its trial
    output:    from w to ((N+1) n_y,), the output of its trial
    from_record: from w and ((N+1) n_y,), the errors that the record shows, to the w of the next
               trial
    limits:    from w to {name: what a limit acts on, in the trial of w and in learning from it}, in
               units of its bound
    """

    start: jax.Array
    following: Callable[[jax.Array], jax.Array]
    error: Callable[[jax.Array], jax.Array]
    output: Callable[[jax.Array], jax.Array]
    from_record: Callable[[jax.Array, jax.Array], jax.Array]
    limits: Callable[[jax.Array], dict[str, jax.Array]]


def learning_of(
    machine: Machine, scheme: Scheme, task: Task, view: View, key: Any = None
) -> Learning:
    """The learning map F of a machine and a scheme. The function is pure.

    key: of what is drawn of the record of a trial; None for its mean
    """
    bounded = machine, scheme
    machine, scheme = machine.unlimited(), scheme.unlimited().prepared(task)
    first, moving = scheme.initial_memory(task), np.array(view.moving)
    start, unravel = ravel_pytree(first if view.whole else scheme.feedforward(first, task))

    def trial(w):
        known = unravel(start.at[moving].set(w))
        if view.whole:
            return known, trial_of(machine, scheme, task, known, key)
        return first, played(machine, scheme, task, first, known, key)

    def following(w):
        known = learned_from(machine, scheme, *trial(w), key)
        return known_as(known, scheme, task, view)

    def from_record(w, e):
        known, record = trial(w)
        record = shown_of(machine, record, key)
        shown = record._replace(y=record.r - e.reshape(record.r.shape))
        return known_as(scheme.learn(known, shown), scheme, task, view)

    def limits(w):
        known, record = trial(w)
        found = bounded[0].limits(record) | bounded[1].limits(task, known, record)
        return {name: (signal / bound).ravel() for name, (signal, bound) in found.items()}

    return Learning(
        start[moving],
        following,
        lambda w: trial(w)[1].e[1:].ravel(),
        lambda w: trial(w)[1].y.ravel(),
        from_record,
        limits,
    )


def known_as(memory, scheme: Scheme, task: Task, view: View) -> jax.Array:
    """(n,) the vector w of a memory."""
    return ravel_pytree(memory if view.whole else scheme.feedforward(memory, task))[0][
        np.array(view.moving)
    ]


def view_of(scheme: Scheme, task: Task) -> View:
    """What w is for a linear law."""
    if remembers(scheme, task):
        size = sum(
            leaf.size
            for leaf in jax.tree.leaves(jax.eval_shape(lambda: scheme.initial_memory(task)))
        )
        return View(True, tuple(range(size)))
    moves = _moves(scheme, task)
    return View(False, tuple(np.flatnonzero(moves if np.any(moves) else ~moves).tolist()))


def changes_nothing(scheme: Scheme, task: Task) -> bool:
    """Whether a linear law leaves what is played as it is, as one with a gain of 0 does."""
    return not remembers(scheme, task) and not np.any(_moves(scheme, task))


def _moves(scheme: Scheme, task: Task) -> np.ndarray:
    """(N n_w,) which samples learning changes.

    That is seen at a random input, where rounding counts as nothing, and at a random error, where
    nothing does: how much an error moves depends on units. For a linear law one such look at each
    is enough.
    """
    random = np.random.default_rng(7)
    w, e = (
        random.standard_normal(learned_shape(scheme, task)),
        random.standard_normal((task.N, task.outputs)),
    )
    forgotten, learned = (
        np.asarray(_moved(scheme.unlimited(), task, *of)).ravel() for of in ((w, 0 * e), (0 * w, e))
    )
    return (np.abs(forgotten) > 1e-14 * np.abs(w).max()) | (learned != 0)


@jax.jit
def _moved(scheme, task, w, e):
    scheme = scheme.prepared(task)
    memory = scheme.initial_memory(task)
    return (
        next_learned(scheme, task, memory, w, e)
        - next_learned(scheme, task, memory, 0 * w, 0 * e)
        - w
    )


def limit_names(machines: Machine, scheme: Scheme, task: Task) -> list[str]:
    """The names of the limits that machines and scheme have. machines: with a leading axis."""

    def one(machine, scheme, task):
        first = scheme.initial_memory(task)
        trial = trial_of(machine.unlimited(), scheme.unlimited(), task, first)
        return machine.limits(trial) | scheme.limits(task, first, trial)

    return list(jax.eval_shape(jax.vmap(one, in_axes=(0, None, None)), machines, scheme, task))


def limits_as_one(limits: dict[str, jax.Array]) -> jax.Array:
    """What all limits act on, one after the other in one row."""
    return jnp.concatenate(list(limits.values()))
