"""One trial and its learning as a map: of all that a scheme knows, and of the error.

    learning_map   memory -> trial -> next memory, of all that a scheme knows, estimates included,
                   or of the parts of it that are named
    error_map      e_j -> e_{j+1}, ..., e_{j+J}, what becomes of the error of a trial; I - G L for
                   a linear law, and defined for any scheme

Both can be differentiated through the simulator, forward (`jvp`) and backward (`vjp`), each at the
cost of a trial. All functions are pure and may be vmapped over machines.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from ..learning.machine import Machine
from ..pytree.named_paths import named_leaves
from ..runtime.tiles import tiled
from ..schemes import Scheme
from ..signals.task import Task
from ..uncertainty import Uncertainty, drawn_machine
from .iteration import SingularValue, singular_value
from .structure import followers
from .trials import Prescribed, learned_from, learned_memory, step, trial_of, with_output

# leaves of a memory that are no state: they only tell the first trial from the others
FLAGS = ("seen",)


OF_OUTPUT = ("y",)  # leaves of a memory that have the unit of the output


class Map(NamedTuple):
    """A map and where to linearise it: f from (n,) to (m,) or (J, m), at a point (n,)."""

    f: Callable[[jax.Array], jax.Array]
    at: jax.Array


def learning_map(
    machine: Machine,
    scheme: Scheme,
    task: Task,
    memory: Any = None,
    *,
    leaves: tuple[str, ...] | None = None,
    weights: Mapping[str, Any] | None = None,
) -> Map:
    """One trial and its learning, as a map on the weighted memory.

    memory:  where to linearise; None for the memory after 3 trials
    leaves:  names of what varies, while all else is held: "u", or "learning.phi", which is all of
             phi[0], phi[1], ...; None for all on which a trial to come depends, but flags. What
             only tells of the past is no state: a counter would be an eigenvalue 1. ("u", "y") of
             MFAILC leaves out its estimates. That matters: at a fixed point without error
             nothing moves phi, so the full map has the eigenvalue 1 there, once for each phi that
             no reset holds. u alone says nothing, as y goes with it
    weights: {name: number} by which leaves are multiplied before they are compared, as u, y and phi
             have different units. Spectral radii do not depend on them, singular values do. A leaf
             without a weight is brought to the size of the output by rms(y) / rms(leaf), or by 1 if
             either is zero; `y` keeps its unit. Of several names that fit a leaf, the longest
             counts

    Raises ValueError for a name that is not in the memory, or a memory without anything that
    varies.
    """
    scheme = scheme.prepared(task)
    memory = learned_memory(machine, scheme, task) if memory is None else memory
    found = named_leaves(memory)
    names, values = list(found), [jnp.asarray(v) for v in found.values()]
    for name in (*(leaves or ()), *(weights or ())):
        if not any(_names(name, of) for of in names):
            raise ValueError(
                f"learning_map: {name!r} is not in this memory; known: "
                f"{', '.join(names) or 'nothing'}"
            )
    if leaves is not None:
        varies = [any(_names(name, of) for name in leaves) for of in names]
    else:
        acting = _acting(machine, scheme, task, memory)
        varies = [
            acts and of.split(".")[-1] not in FLAGS for of, acts in zip(names, acting, strict=True)
        ]
    varies = [
        v and jnp.issubdtype(value.dtype, jnp.floating)
        for v, value in zip(varies, values, strict=True)
    ]
    if not any(varies):
        raise ValueError(
            f"learning_map: the memory of {type(scheme).__name__} has no floating leaf that varies"
        )
    size_y = _rms(trial_of(machine, scheme, task, memory).y)
    scales = [
        _weight(of, value, weights or {}, size_y) for of, value in zip(names, values, strict=True)
    ]
    shape = jax.tree.structure(memory)

    def flat(of_memory):
        return jnp.concatenate(
            [
                (w * v).ravel()
                for v, w, free in zip(jax.tree.leaves(of_memory), scales, varies, strict=True)
                if free
            ]
        )

    def unflat(x):
        rest, at = [], 0
        for value, w, free in zip(values, scales, varies, strict=True):
            rest.append(x[at : at + value.size].reshape(value.shape) / w if free else value)
            at += value.size if free else 0
        return shape.unflatten(rest)

    return Map(lambda x: flat(step(machine, scheme, task, unflat(x))), flat(memory))


def error_map(
    machine: Machine, scheme: Scheme, task: Task, memory: Any = None, *, trials: int = 1
) -> Map:
    """From the error of a trial, (N n_y,), to those of the next `trials` trials, (J, N n_y).

    Another error e[1..N] is brought about by the repetitive disturbance of the output that causes
    it, which then stays. So it is the error that is prescribed, not the input: that trial is run
    with the prescribed output fed back, and nothing has to be inverted. For a linear law under a
    linear loop G the derivative is (I - G L)^j. A scheme that adapts also learns from the change,
    which is part of the derivative.

    memory: with which the trial is entered; None for the memory after 3 trials
    """
    scheme = scheme.prepared(task)
    memory = learned_memory(machine, scheme, task) if memory is None else memory
    r, first = jnp.asarray(task.reference), trial_of(machine, scheme, task, memory)

    def f(e):
        y = jnp.concatenate([first.y[:1], r[1:] - e.reshape(task.N, -1)])
        trial = trial_of(machine, Prescribed(scheme), task, (memory, y))
        disturbed = with_output(machine, y - trial.y)

        def following(memory, _):
            trial = trial_of(disturbed, scheme, task, memory)
            return learned_from(disturbed, scheme, memory, trial), trial.e[1:].ravel()

        known = learned_from(machine, scheme, memory, trial._replace(y=y))
        return lax.scan(following, known, length=trials)[1]

    return Map(f, first.e[1:].ravel())


def error_growth(
    f: Callable, at, trials: int, *, steps: int = 300, tolerance: float = 1e-6
) -> SingularValue:
    """The largest |e_{j+i}| / |e_j| for i = 1..J: fields with a leading axis of J.

    f, at: an `error_map` over J `trials`
    """
    return lax.map(
        lambda row: singular_value(f, at, steps=steps, tolerance=tolerance, row=row),
        jnp.arange(trials),
    )


def over_plants(
    quantity: Callable[[Machine], Any],
    machine: Machine,
    uncertainty: Uncertainty,
    drawn: Mapping[str, Any],
    lanes: int = 4,
):
    """quantity(machine) for every plant drawn, tiled over devices.

    drawn: as from `uncertainty.draw`
    """
    run = tiled(
        lambda common, values: quantity(drawn_machine(common, uncertainty, values)), lanes=lanes
    )
    return run(machine, {name: jnp.asarray(values) for name, values in drawn.items()})


def _acting(machine: Machine, scheme: Scheme, task: Task, memory) -> list[bool]:
    """Of each leaf of a memory, whether a trial to come may depend on it, as the program tells."""

    def turn(fixed, memory):
        machine, scheme, task = fixed
        trial = trial_of(machine, scheme, task, memory)
        return scheme.learn(memory, trial), trial.y, trial.u

    found = followers(turn, (machine, scheme, task), memory)
    leaves = len(found)
    acting = [any(of_leaf[leaves:]) for of_leaf in found]
    while True:
        grown = [
            acts or any(follows and acting[i] for i, follows in enumerate(of_leaf[:leaves]))
            for acts, of_leaf in zip(acting, found, strict=True)
        ]
        if grown == acting:
            return acting
        acting = grown


def _names(name: str, leaf: str) -> bool:
    """Whether a name means this leaf, or an object that this leaf is a part of."""
    return leaf == name or leaf.startswith((f"{name}.", f"{name}["))


def _weight(leaf: str, value, weights: Mapping[str, Any], size_y):
    named = [name for name in weights if _names(name, leaf)]
    if named:
        return weights[max(named, key=len)]
    size = _rms(value)
    usable = (size > 0) & (size_y > 0) & (leaf.split(".")[-1] not in OF_OUTPUT)
    return jnp.where(usable, size_y / jnp.where(size > 0, size, 1.0), 1.0)


def _rms(signal):
    return jnp.sqrt(jnp.mean(signal**2))
