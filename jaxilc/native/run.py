"""Compiled programs: built from a function that learns, run on many machines, and checked."""

from __future__ import annotations

import itertools
import logging
import math
import re
from collections.abc import Callable, Hashable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Generic, TypeAlias, TypeGuard, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from ..learning.known_metrics import Metrics
from ..learning.machine import Machine
from ..learning.over_trials import learn
from ..runtime.capacity import host_bytes, shown
from ..runtime.lanes import all_stored, usual_lanes
from ..runtime.start import native_unwanted
from ..runtime.tiles import tiled
from ..schemes import Scheme
from ..signals.task import Task
from .code import (
    agree,
    agreed,
    callable_by_xla,
    cores,
    in_vectors,
    key_of,
    of_compiler,
    room,
    target,
    width,
)
from .llvm import Text
from .operations import foreign
from .program import (
    Const,
    Known,
    Program,
    Step,
    Unknown,
    Value,
    by_jax,
    flat,
    in_order,
    of_trials,
)
from .rows import Trials

if TYPE_CHECKING:
    from jax.extend.core import ClosedJaxpr, Jaxpr

log = logging.getLogger("jaxilc")
Common = TypeVar("Common")  # trees of arrays: what is common to all machines,
One = TypeVar("One")  # one machine, or several, which are along the leading axis,
Found = TypeVar("Found")  # and results
Arrays: TypeAlias = dict[Value, jax.Array]

ONCE = "trials that are all alike, of which XLA computes one"
FEW = 64  # real numbers of an operand that are written into the program where they never change
SHARE = 0.25  # of the RAM that is free, which may be taken by what is held from loop to loop
AT_ONCE = 2**27  # bytes of operands and of what is held, that are in the RAM at once
QUICKLY: dict[str, str | bool] = {"xla_backend_optimization_level": "0"}  # half the time to compile
# of the largest number of a machine, by which the check may find a difference, by bytes of a number
TOLERANCE = {8: 1e-9, 4: 1e-4}


class Compiled(Generic[Common, One, Found]):
    """A program of a function of what is common and of one machine.

    It has one or more loops over trials, each compiled for this processor, between which XLA
    computes. All is one function of JAX, in which XLA calls the loops (`jax.ffi`).

    fn: the function; it learns over trials
    common, one: its arguments, of which shapes and types are read
    lanes: number of machines in a group; None: as many as a register of the processor holds
    learns: whether the trials differ, see `ONCE`
    Raises Unknown, which says why, where the function cannot be compiled.
    """

    def __init__(self, fn: Callable[[Common, One], Found], common: Common, one: One,
                 lanes: int | None = None):  # fmt: skip
        with all_stored():
            closed, shape = jax.make_jaxpr(fn, return_shape=True)(common, one)
        self._jaxpr = closed.jaxpr
        self._tree = jax.tree.structure(shape)
        self._program: Program = flat(closed)
        self._shared = len(jax.tree.leaves(common))
        self.lanes = width() // _real().itemsize if lanes is None else lanes
        left: list[int] = []
        while not self._compiled(left):
            pass
        self.learns = any(_learns(loop.step) for loop in self._loops)
        self._holding = sum(_size(x) for of in self._loops[:-1] for x in of.shown) * self.lanes
        self._check_room()
        self._call = jax.jit(self._of_batch)

    def _compiled(self, left: list[int]) -> bool:
        """Whether all loops over trials could be compiled but those that are left to XLA.

        An earlier one of which nothing waits for a later one, such as what prepares a scheme, is
        added to those that are left, and all are to be compiled again. Raises Unknown for others.
        """
        program = self._program
        self._parts, self._after = of_trials(program, foreign, left)
        awaited = _awaited(self._parts)
        stretches = [*(before for before, _ in self._parts), self._after]
        self._read = [{x for step in steps for x in step.ins} for steps in stretches]
        for of, (_, step) in zip(self._read, self._parts, strict=False):
            of.update(step.ins)
        self._read[-1].update(program.outs)
        self._varying = {*program.ins[self._shared :]}
        self._loops: list[_Loop] = []
        steps: list[Step] = []
        for number, (before, step) in enumerate(self._parts):
            steps = steps + before
            self._spread(before)
            read = set().union(*self._read[number + 1 :])
            try:
                self._loops.append(_Loop(steps, step, self._varying, read, self.lanes))
            except Unknown:
                if number == len(self._parts) - 1 or not awaited.isdisjoint(step.outs):
                    raise
                numbers = (n for n in itertools.count() if n not in left)
                left.append(next(itertools.islice(numbers, number, None)))
                return False
            self._varying.update(step.outs)
        self._spread(self._after)
        return True

    def _spread(self, steps: Sequence[Step]) -> None:
        """Add to the values that differ from machine to machine those that steps make of them."""
        for of in steps:
            self._varying.update(of.outs if not self._varying.isdisjoint(of.ins) else ())

    def _check_room(self) -> None:
        """Raises Unknown where what is held for a group of machines takes too much of the RAM."""
        room, needed = host_bytes(), self._holding * cores()
        if room is not None and needed > SHARE * room:
            raise Unknown(f"the memories of all trials of {self.lanes * cores()} machines, which "
                          f"take {shown(needed)} of the RAM")  # fmt: skip

    @property
    def key(self) -> str:
        """What its numbers depend on besides its arguments, in short."""
        text = re.sub("0x[0-9a-f]+", "", str(self._jaxpr))
        return key_of(of_compiler(), text, *(of.name for of in self._loops))

    @property
    def tile(self) -> int:
        """The number of machines that are computed at once."""
        of_one = self._holding + sum(loop.drawn for loop in self._loops) * self.lanes
        groups = max(1, AT_ONCE // max(of_one, 1) // cores()) * cores()
        return groups * self.lanes

    def __call__(self, common: Common, batch: One) -> Found:
        """The results of all machines, whose numbers are along the leading axis of the batch."""
        found = self._call(jax.tree.leaves(common), jax.tree.leaves(batch))
        return jax.tree.unflatten(self._tree, found)

    def _of_batch(self, shared: list[jax.Array], each: list[jax.Array]) -> list[jax.Array]:
        machines, tile = len(each[0]), self.tile
        if machines <= tile:
            return self._of_tile(shared, each)
        count = -(-machines // tile)
        at = np.minimum(np.arange(count * tile), machines - 1).reshape(count, tile)
        found = lax.map(partial(self._of_tile, shared), [jnp.asarray(x)[at] for x in each])
        return [x.reshape(count * tile, *x.shape[2:])[:machines] for x in found]

    def _of_tile(self, shared: list[jax.Array], each: list[jax.Array]) -> list[jax.Array]:
        """The results of machines, of which the last one fills its group."""
        machines = len(each[0])
        groups = -(-machines // self.lanes)
        at = np.minimum(np.arange(groups * self.lanes), machines - 1).reshape(groups, self.lanes)
        known: Arrays = dict(zip(self._program.ins, shared, strict=False))
        grouped = [jnp.moveaxis(jnp.asarray(x)[at], 1, -1) for x in each]
        known |= zip(self._program.ins[self._shared :], grouped, strict=True)
        for number, (before, _) in enumerate(self._parts):
            known |= self._by_xla(before, known, groups, set().union(*self._read[number:]))
            known |= self._loops[number](known, groups)
        outs = self._program.outs
        known |= self._by_xla(self._after, known, groups, {*outs})
        found = []
        for x in outs:
            array = jnp.asarray(x.array) if isinstance(x, Const) else known[x]
            if x not in self._varying:
                found.append(jnp.broadcast_to(array, (machines, *array.shape)))
            else:
                array = jnp.moveaxis(array, -1, 1)
                found.append(array.reshape(groups * self.lanes, *x.shape)[:machines])
        return found

    def _by_xla(self, steps: list[Step], known: Arrays, groups: int, read: set[Value]) -> Arrays:
        """What steps between the loops make that is read later.

        known: by value, arrays of all groups, (groups, ..., lanes), of what varies
        """
        wanted = [x for step in steps for x in step.outs if x in read]
        of = [x for x in known if any(x in step.ins for step in steps)]

        def of_one(arrays: list[jax.Array]) -> list[jax.Array]:
            given: dict[Value, Known] = dict(zip(of, arrays, strict=True))
            return [*map(jnp.asarray, map(by_jax(steps, given), wanted))]

        def axes(values: Sequence[Value], axis: int) -> list[int | None]:
            return [axis if x in self._varying else None for x in values]

        for axis, size in ((-1, self.lanes), (0, groups)):
            of_one = jax.vmap(of_one, (axes(of, axis),), axes(wanted, axis), axis_size=size)
        return dict(zip(wanted, of_one([known[x] for x in of]), strict=True)) if wanted else {}

    def bytes_of(self, machines: int) -> int:
        """The bytes that these machines take: what passes XLA, twice, and what loops need."""
        tile = min(machines, self.tile)
        passing = [_size(x) for loop in self._loops for x in (*loop.each, *loop.shown)]
        results = [_size(x) for x in self._program.outs]
        work = max(loop.work for loop in self._loops) * cores()
        return 2 * (sum(passing) * tile + sum(results) * machines) + work


class _Loop:
    """A loop over trials, compiled.

    before: the steps by XLA before it, with those before earlier loops
    step: the loop, lowered
    varying: the values that differ from machine to machine
    read: the values that somebody reads after this loop
    lanes: number of machines in a group
    each: the operands that differ from machine to machine
    shown: the results that somebody reads
    drawn: bytes of the operands of a machine
    name: the name under which XLA calls it, which follows from what it computes
    work: bytes that a group needs
    """

    def __init__(self, before: list[Step], step: Step, varying: set[Value], read: set[Value],
                 lanes: int):  # fmt: skip
        self.step, self._lanes = step, lanes
        self._alike = [isinstance(x, Const) or x not in varying for x in step.ins]
        plan = Trials(step, self._alike, _fixed(before, step), _real())
        wanted = [x in read for x in step.outs]
        text = Text(plan, lanes, wanted, partial(in_vectors, lanes, _real().itemsize))
        self.work = text.work
        self._constants = [np.ascontiguousarray(x) for x in plan.given]
        self._moved = [plan.moved(i) for i in range(len(step.ins))]
        self.shown = [x for x in step.outs if x in read]
        self._found = {x: plan.moved(i, out=True) for i, x in enumerate(step.outs) if x in read}
        results = [lanes * _size(x) if x in read else None for x in step.outs]
        operands = len(step.ins) + len(plan.given)
        self.name = target(callable_by_xla(text.text, operands, results, text.work))
        self.each = [x for x, same in zip(step.ins, self._alike, strict=True) if not same]
        self.drawn = sum(_size(x) for x in self.each)

    def __call__(self, known: Arrays, groups: int) -> Arrays:
        """The results for groups of machines by value, from those of what it reads."""
        operands = []
        for x, alike, (at, to) in zip(self.step.ins, self._alike, self._moved, strict=True):
            array = jnp.asarray(x.array if isinstance(x, Const) else known[x])
            operands.append(_turned(array, at, to) if alike else _turned(array, at + 1, to + 1))
        like = [
            jax.ShapeDtypeStruct((groups, *_moved(x.shape, *move), self._lanes), x.dtype)
            for x, move in self._found.items()
        ]
        like.append(jax.ShapeDtypeStruct(room(self.work), np.uint8))
        call = jax.ffi.ffi_call(self.name, like, vmap_method="sequential")
        found = call(*operands, *self._constants)
        moves = zip(self._found.items(), found, strict=False)
        return {x: _turned(array, to + 1, at + 1) for (x, (at, to)), array in moves}


class Native(Generic[Common, One, Found]):
    """A function of what is common and of one machine, compiled where that is possible.

    fn: the function
    xla: the function of what is common and of a batch that computes the same by XLA
    """

    def __init__(self, fn: Callable[[Common, One], Found], xla: Callable[[Common, One], Found]):
        self._fn, self._xla = fn, xla
        self._programs: dict[Hashable, Compiled[Common, One, Found] | str] = {}

    def why_not(self, common: Common, batch: One) -> str | None:
        """The reason why XLA computes these arguments; None where a compiled program does.

        A new program first computes this batch, and its results are compared with those of XLA.
        Where machine code is kept on disk, it is noted there that they agree, for later processes.
        """
        key = _key(common, batch)
        if key not in self._programs:
            self._programs[key] = self._tried(common, batch)
        found = self._programs[key]
        return found if isinstance(found, str) else None

    def program(self, common: Common, batch: One) -> Compiled[Common, One, Found]:
        """The program of arguments for which `why_not` gave no reason."""
        found = self._programs[_key(common, batch)]
        assert isinstance(found, Compiled)
        return found

    def _tried(self, common: Common, batch: One) -> Compiled[Common, One, Found] | str:
        try:
            program = Compiled(self._fn, common, jax.tree.map(lambda x: x[0], batch))
            if not program.learns:
                return ONCE
        except Unknown as unknown:
            return str(unknown)
        except Exception as error:  # of ours, which is no reason not to learn
            log.warning("native: %s: %s; XLA computes instead", type(error).__name__, error)
            return f"an error of the compiler, {type(error).__name__}: {error}"
        key = program.key
        if agreed(key):
            return program
        both = jax.jit(lambda *arguments: (program(*arguments), self._xla(*arguments)))
        traced = both.lower(common, batch)
        off = differs(*traced.compile(compiler_options=QUICKLY)(common, batch))
        if off is None:
            agree(key)
            return program
        log.warning("native: %s, as XLA computes it; XLA computes instead", off)
        return f"another result than that of XLA: {off}"


def fastest(
    fn: Callable[[Common, One], Found],
    common: Common,
    batch: One,
    *,
    steps: float,
    lanes: int | None = None,
) -> tuple[Callable[[Common, One], Found], bool]:
    """`tiled(fn)`, or a compiled program that does the same, and whether it is the latter.

    A program is compiled where `setup` asks for it, or the sample-steps are worth it. It first
    computes a tile of this batch, and its results are compared with those of XLA.

    common, batch: arguments, of which a program may be called with others of the same shapes
    steps: number of sample-steps of all calls together, see `native_unwanted`
    """
    by_xla = tiled(fn, lanes=lanes)
    native, reason = Native(fn, by_xla), native_unwanted(steps)
    few = jax.tree.map(lambda x: x[: lanes or usual_lanes() or 1], batch)
    reason = reason or native.why_not(common, few)
    log.info("native: computed by %s", f"XLA: {reason}" if reason else "a program for this "
             "processor")  # fmt: skip
    return (by_xla, False) if reason else (native.program(common, few), True)


def sample_steps(fn: Callable[[Common, One], Found], common: Common, batch: One) -> float:
    """The sample-steps of a function over a batch: the turns of the loops that have none within."""

    def turns(jaxpr: Jaxpr | ClosedJaxpr) -> float:
        found = 0.0
        for step in jaxpr.eqns:
            within = sum(
                turns(x)
                for x in jax.tree.leaves([*step.params.values()], is_leaf=_has_steps)
                if _has_steps(x)
            )
            found += (
                step.params["length"] * max(within, 1) if step.primitive.name == "scan" else within
            )
        return found

    one = jax.tree.map(lambda x: x[0], batch)
    return turns(jax.make_jaxpr(fn)(common, one)) * len(jax.tree.leaves(batch)[0])


def _has_steps(x: object) -> TypeGuard[Jaxpr | ClosedJaxpr]:
    return hasattr(x, "eqns")


def why_not(machine: Machine, scheme: Scheme, task: Task, trials: int = 2) -> str | None:
    """The reason why this learning cannot be compiled; None where it can.

    Nothing is compared with XLA, and nothing is run. Raises ValueError as `learn` does.
    """

    def metrics(common: tuple[Machine, Scheme, Task], one: np.uint32) -> Metrics:
        machine, scheme, task = common
        return learn(machine, scheme, task, trials, key=jax.random.key(one)).metrics

    try:
        return None if Compiled(metrics, (machine, scheme, task), np.uint32(0)).learns else ONCE
    except Unknown as unknown:
        return str(unknown)


def _key(common: Common, batch: One) -> Hashable:
    """What a program depends on: the structure, shapes and types of its arguments."""
    shared, of_shared = jax.tree.flatten(common)
    each, of_each = jax.tree.flatten(batch)
    shapes = [(x.shape[1:], x.dtype) for x in each]
    return of_shared, of_each, (*map(jax.typeof, shared),), (*shapes,)


def differs(found: Found, wanted: Found) -> str | None:
    """What differs between results of a compiled program and those of XLA; None where nothing does.

    found, wanted: trees of arrays with the machines along the leading axis. Whole numbers and truth
    values are equal, other numbers up to TOLERANCE of the largest finite one of a machine.
    """
    paths = jax.tree.flatten_with_path(wanted)[0]
    for x, (path, y) in zip(jax.tree.leaves(found), paths, strict=True):
        x, y = np.asarray(x), np.asarray(y)
        x, y = (a.reshape(len(a), -1) for a in (x, y))
        name = jax.tree_util.keystr(path)
        if y.dtype.kind != "f":
            off = x != y
        else:
            finite = np.isfinite(y)
            scale = np.max(np.abs(np.where(finite, y, 0)), axis=1, keepdims=True, initial=0)
            with np.errstate(invalid="ignore"):
                near = np.abs(x - y) <= TOLERANCE[y.itemsize] * scale
            off = ~np.where(finite, near, (x == y) | (np.isnan(x) & np.isnan(y)))
        if off.any():
            machine, at = (int(i) for i in np.argwhere(off)[0])
            return f"{name} of machine {machine} is {x[machine, at]} in place of {y[machine, at]}"
    return None


# The operands
# --------------------------------------------------------------------------------------------------


def _awaited(parts: list[tuple[list[Step], Step]]) -> set[Value]:
    """The results of loops that a later one reads as they are, or in another shape."""
    origin: dict[Value, Value] = {}
    found: set[Value] = set()
    for before, loop in parts:
        for step in before:
            if in_order(step) and step.ins[0] in origin:
                origin[step.outs[0]] = origin[step.ins[0]]
        found |= {origin[x] for x in loop.ins if x in origin}
        origin |= {x: x for x in loop.outs}
    return found


def _learns(step: Step) -> bool:
    """Whether a loop over samples depends on the trials before, or on the number of the trial."""
    body = step.params["body"]
    moving = set(body.ins[step.params["consts"] :])
    for one in body.steps:
        if any(x in moving for x in one.ins):
            if one.name == "scan":
                return True
            moving.update(one.outs)
    return False


def _fixed(before: Sequence[Step], step: Step) -> list[np.ndarray | None]:
    """The values of operands of the loop over trials that depend on no argument; else None."""
    known: dict[Value, Known] = {}
    by_jax(before, known)
    found = [x.array if isinstance(x, Const) else known.get(x) for x in step.ins]
    return [
        np.asarray(x) if x is not None and (np.size(x) <= FEW or x.dtype.kind in "iu") else None
        for x in found
    ]


def _real() -> np.dtype:
    """The floating point type, as the precision is now."""
    return np.dtype(jnp.result_type(float))


def _size(x: Value) -> int:
    """The bytes of an array of one machine."""
    return math.prod(x.shape) * np.dtype(x.dtype).itemsize


def _turned(x: jax.Array, at: int, to: int) -> jax.Array:
    return x if at == to else jnp.moveaxis(x, at, to)


def _moved(shape: Sequence[int], at: int, to: int) -> tuple[int, ...]:
    """The shape of an array of which one axis is moved."""
    rest = [n for i, n in enumerate(shape) if i != at]
    return (*rest[:to], *shape[at : at + 1], *rest[to:])
