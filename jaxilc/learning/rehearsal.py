"""A check of the shapes of a plant and a scheme before anything is compiled.

One sample and one learning step are evaluated with shapes alone. Where a user's own plant or scheme
returns a wrong shape, the error names it.
"""

from __future__ import annotations

import numbers
from functools import partial

import jax
import jax.numpy as jnp

from ..plants import Plant
from ..pytree.aliases import Tree
from ..pytree.named_paths import named_leaves
from ..pytree.needs import known
from ..pytree.ranges import brief, native
from ..schemes import Scheme
from ..schemes.scheme import Part
from ..signals.task import Sample, Task, Trial
from .machine import Machine, as_computed, is_single


def need_pytrees(*trees: Tree) -> None:
    """Raises ValueError for an object that is neither a number nor a pytree.

    An example is an object whose class lacks `@pytree`.
    """
    for tree in trees:
        for path, leaf in named_leaves(tree).items():
            if isinstance(leaf, str):
                raise ValueError(
                    f"{type(tree).__name__}: {path} = {brief(leaf)} is text, which is no number; "
                    "declare its field with static() (from jaxilc.pytree)"
                )
            if not hasattr(leaf, "dtype") and not isinstance(leaf, numbers.Number):
                name = type(leaf).__name__
                raise ValueError(
                    f"{brief(leaf)} is no pytree; write @pytree (from jaxilc.pytree) above `class "
                    f"{name}`, or register the class with JAX"
                )


def rehearse(machine: Machine, scheme: Scheme, task: Task) -> None:
    """Raises ValueError where a method of the plant or of the scheme returns a wrong shape."""
    _step.eval_shape(as_computed(machine.plant), task.dt)
    _turn.eval_shape(scheme, task, actuated=machine.actuator is not None)


def need_fitting_memory(scheme: Scheme, task: Task, memory: Tree) -> None:
    """Raises ValueError for a memory to continue from that is not one of this scheme and task."""
    if not _of_numbers(memory):
        raise ValueError(f"memory = {brief(memory)} is no memory, as history.memory is")
    _continued.eval_shape(scheme, task, memory)


def fitting_memory(
    scheme: Scheme, task: Task, memory: Tree, machine: Machine | None = None
) -> Tree:
    """The memory to begin a trial with; None is that before the first one.

    Raises ValueError for one that does not fit, or a machine, unless something of them is traced.
    """
    memory = jax.tree.map(native, memory)
    if known((machine, scheme, task, memory)):
        if machine is not None:
            machine.check(task)
        if memory is not None and _of_numbers(scheme):  # the plain Scheme is no pytree
            need_fitting_memory(scheme, task, memory)
    return scheme.initial_memory(task) if memory is None else memory


def _of_numbers(tree: Tree) -> bool:
    return all(hasattr(x, "dtype") or isinstance(x, numbers.Number) for x in jax.tree.leaves(tree))


def need_double(scheme: Scheme, error: TypeError) -> None:
    """Raises ValueError where JAX's error tells of parameters that are in single precision."""
    single = [name for name, x in named_leaves(scheme).items() if is_single(x)]
    if single and "float32" in str(error) and jnp.result_type(float) != jnp.float32:
        raise ValueError(
            f"{type(scheme).__name__}: {', '.join(single)} in float32 cannot be computed with in "
            "float64; allowed is float64"
        ) from error


@partial(jax.jit, static_argnames="dt")
def _step(plant: Plant, dt: float) -> None:
    """The state at rest, the state after one step, and the output."""
    plant, name = plant.sampled(dt), type(plant).__name__
    before = plant.initial_state()
    after, y = plant.step(before, jnp.zeros(plant.n_u), dt), plant.output(before)
    was, now = (jax.tree.map(jnp.shape, state) for state in (before, after))
    if was != now:
        raise ValueError(
            f"{name}: a step makes a state of {brief(now)} of one of {brief(was)}; "
            "allowed is the same again"
        )
    _need_alike(f"{name}: a step", "state", before, after, "initial_state gives")
    _need_vector(f"{name}: the output has", y, "n_y", plant.n_y)


@partial(jax.jit, static_argnames="actuated")
def _turn(scheme: Scheme, task: Task, *, actuated: bool) -> None:
    """The first sample of a trial, and the learning step after the trial."""
    scheme, name = scheme.prepared(task), type(scheme).__name__
    memory = scheme.initial_memory(task)
    _need_rows(scheme, task, memory)
    row = jax.tree.map(lambda rows: rows[0], scheme.schedule(memory, task))
    rest, seen = jnp.zeros(task.inputs), jnp.zeros((scheme.preview, task.outputs))
    before = scheme.initial_state(task)
    sample = Sample(seen[0], seen, seen[0], row, task.dt, rest if actuated else None)
    acted = scheme.act(before, sample)
    if not isinstance(acted, tuple | list) or len(acted) != 2:
        raise ValueError(f"{name}: act gives {_in_words(acted)}; allowed is a pair (state, u)")
    after, u = acted
    _need_vector(f"{name}: act gives an input of", u, "n_u", task.inputs)
    _need_alike(f"{name}: act", "state", before, after, "initial_state gives")
    signals = {
        signal: jnp.zeros((task.N, *jnp.shape(value)), jnp.result_type(value))
        for signal, value in scheme.signals(after).items()
    }
    r = jnp.asarray(task.reference)
    trial = Trial(r, jnp.zeros_like(r), jnp.zeros((task.N, task.inputs)), task.dt, signals)
    _need_learned_alike(scheme, task, memory, scheme.learn(memory, trial))
    if not actuated and u.dtype != rest.dtype:
        raise ValueError(f"{name}: act gives an input of {u.dtype}; allowed is {rest.dtype}")


@jax.jit
def _continued(scheme: Scheme, task: Task, memory: Tree) -> None:
    """The memory to continue from, beside the one before the first trial."""
    clash = _clash("memory", memory, scheme.prepared(task).initial_memory(task))
    if clash is not None:
        where, needed, given = clash
        where = f"memory.{where}" if where not in ("memory", "a memory") else "memory"
        raise ValueError(f"{where} is {given}; {type(scheme).__name__} and this task need {needed}")


def _need_vector(who: str, x: Tree, axis: str, size: int) -> None:
    """Raises ValueError unless x is an array of one axis of this size."""
    if getattr(x, "shape", None) != (size,):
        shape = getattr(x, "shape", type(x).__name__)
        raise ValueError(f"{who} shape {shape}; allowed is ({axis},) = ({size},)")


def _need_rows(scheme: Scheme, task: Task, memory: Tree) -> None:
    """Raises ValueError unless the schedule of the scheme, and of each of its parts, has N rows."""
    for part in scheme.parts(task, memory).values():
        _need_rows(*part)
    name, schedule = type(scheme).__name__, scheme.schedule(memory, task)
    if scheme.plays_back:
        allowed = (task.N, task.inputs)
        if not hasattr(schedule, "u"):
            raise ValueError(
                f"{name}: act plays back the u of the schedule, which has none; give the memory a "
                f"field u (N, n_u) = {allowed}, or override schedule or act"
            )
        if jnp.shape(schedule.u) != allowed:
            raise ValueError(
                f"{name}: the u of its memory or schedule has shape {jnp.shape(schedule.u)}; "
                f"allowed is (N, n_u) = {allowed}"
            )
    for path, rows in named_leaves(schedule).items():
        if jnp.shape(rows)[:1] != (task.N,):
            raise ValueError(
                f"{name}: {path or 'the leaf'} of its schedule has shape {jnp.shape(rows)}; "
                f"allowed are N = {task.N} rows, so override schedule to leave out what act does "
                "not need"
            )


def _need_learned_alike(scheme: Scheme, task: Task, before: Tree, after: Tree) -> None:
    """Raises ValueError unless `learn` gave each part a memory of the same structure as before."""
    name = type(scheme).__name__
    if type(before) is type(after):
        was, now = scheme.parts(task, before), scheme.parts(task, after)
        for part in was:
            inner, seen, memory = was[part]
            _need_learned_alike(inner, seen, memory, Part(*now[part]).memory)
    _need_alike(f"{name}: learn", "memory", before, after, "initial_memory gives")


def _need_alike(who: str, what: str, before: Tree, after: Tree, allowed: str) -> None:
    """Raises ValueError unless two pytrees agree in structure, and in shape and type of leaves."""
    clash = _clash(what, before, after)
    if clash is not None:
        where, found, known = clash
        raise ValueError(f"{who} makes {where} {found} of {known}; allowed is what {allowed}")


def _clash(what: str, before: Tree, after: Tree) -> tuple[str, str, str] | None:
    """Where two pytrees differ in structure, or in shape or type of a leaf; after, and before."""
    if jax.tree.structure(before) != jax.tree.structure(after):  # type: ignore[operator]  # of JAX
        return f"a {what}", _in_words(after), _in_words(before)
    for (path, was), now in zip(named_leaves(before).items(), jax.tree.leaves(after), strict=True):
        known, found = jnp.shape(was), jnp.shape(now)
        types = jnp.result_type(was), jnp.result_type(now)
        weak = getattr(jax.typeof(was), "weak_type", False)  # such as 0.0, which adapts its type
        if known != found or (types[0] != types[1] and not weak):
            return path or what, f"{types[1]}{list(found)}", f"{types[0]}{list(known)}"
    return None


def _in_words(tree: Tree) -> str:
    if hasattr(tree, "dtype"):
        return f"array {tree.dtype}{list(tree.shape)}"
    names = ", ".join(name for name in named_leaves(tree) if name)
    return type(tree).__name__ + (f" ({names})" if names else "")
