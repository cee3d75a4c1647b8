"""Compiled programs: built from a function that learns, run on many machines, and checked."""

from __future__ import annotations

import ctypes
import hashlib
import itertools
import logging
import math
import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import cache, partial
from importlib import metadata
from pathlib import Path
from typing import Any

import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jax import lax

from ..learning.machine import Machine
from ..learning.over_trials import learn
from ..runtime.capacity import host_bytes, shown
from ..runtime.lanes import all_stored, usual_lanes
from ..runtime.start import native_wanted
from ..runtime.tiles import tiled
from ..schemes import Scheme
from ..signals.task import Task
from .llvm import ALIGNED, Text
from .operations import foreign
from .program import Const, Program, Step, Unknown, Value, by_jax, flat, in_order, of_trials
from .rows import Trials

log = logging.getLogger("jaxilc")

WIDEST = {"avx512f": 64, "avx": 32, "neon": 16}  # bytes of a register, by a feature
ONCE = "trials that are all alike, of which XLA computes one"
FEW = 64  # numbers of an operand that are written into the program where they never change
SHARE = 0.25  # of the RAM that is free, which may be taken by what is held from loop to loop
AT_ONCE = 2**27  # bytes of operands and of what is held, that are in the RAM at once
WAITING = 8  # tickets, of tiles that several devices compute at once
TOLERANCE = 1e-9  # of the largest number of a machine, by which the check may find a difference


class Compiled:
    """A program of a function of what is common to all machines, and of one machine.

    It has one or more loops over trials, each compiled for this processor, between which JAX
    computes. Rows that only a later loop reads, such as what a gradient needs on its way back, are
    held for it as they are.

    fn: the function; it learns over trials
    common, one: its arguments, of which shapes and types are read
    lanes: number of machines in a group; None: as many as a register of the processor holds
    learns: whether the trials differ, see `ONCE`
    Raises Unknown, which says why, where the function cannot be compiled.
    """

    def __init__(self, fn: Callable[[Any, Any], Any], common: Any, one: Any,
                 lanes: int | None = None):  # fmt: skip
        if not jax.config.jax_enable_x64:
            raise Unknown("single precision")
        with all_stored():
            closed, shape = jax.make_jaxpr(fn, return_shape=True)(common, one)
        self._tree = jax.tree.structure(shape)
        self._program: Program = flat(closed)
        self._varying = {*self._program.ins[len(jax.tree.leaves(common)) :]}
        self.lanes = _width() // np.dtype(float).itemsize if lanes is None else lanes
        left: list[int] = []
        while not self._compiled(left):
            pass
        self.learns = any(_learns(loop.step) for loop in self._loops)
        self._holding = sum(loop.holding for loop in self._loops)
        self._check_room()
        for loop in self._loops:
            axes = [0 if x in loop.each else None for x in loop.given]
            loop.first = self._by_jax(loop.before, loop.given, axes, loop.moved)
        self._last = self._by_jax(self._after, self._program.outs, 0, {})
        self._rooms = _Rooms()

    def _compiled(self, left: list[int]) -> bool:
        """Whether all loops over trials could be compiled but those that are left to JAX.

        An earlier one of which nothing waits for a later one, such as what prepares a scheme, is
        added to those that are left, and all are to be compiled again. Raises Unknown for others.
        """
        parts, after = of_trials(self._program, foreign, left)
        held = _held(parts, after, self._program.outs)
        befores = (*(before for before, _ in parts), after)
        read = {x for steps in befores for of in steps for x in of.ins}
        read |= {*self._program.outs, *held.values(), *(x for _, step in parts for x in step.ins)}
        varying, where = {*self._varying}, {}
        self._loops: list[_Loop] = []
        steps: list[Step] = []
        for number, (before, step) in enumerate(parts):
            steps = steps + before
            for of in before:
                varying.update(of.outs if any(x in varying for x in of.ins) else ())
            try:
                self._loops.append(_Loop(steps, step, varying, read, held, self.lanes))
            except Unknown:
                last = number == len(parts) - 1
                if last or not {*held.values()}.isdisjoint(step.outs):
                    raise
                numbers = (n for n in itertools.count() if n not in left)
                left.append(next(itertools.islice(numbers, number, None)))
                return False
            where |= self._loops[-1].found_at
            for x in (x for x in step.ins if x in held):
                here, there = self._loops[-1].moved[x], where[held[x]]
                turned = here[0] != here[1] or there[0] != there[1]
                if turned and (x.shape, here) != (held[x].shape, there):
                    raise Unknown("a memory whose axis of samples changes")
            varying.update(step.outs)
        self._after = steps + after
        return True

    def _by_jax(self, steps: list[Step], wanted: list[Value], out_axes: Any, moved: dict) -> Any:
        """The function of the operands, and of what loops found, that JAX computes for a batch.

        moved: from which axis that of the samples of a value moves where
        """
        of_loops = [(x, loop.found_at[x]) for loop in self._loops for x in loop.shown]

        def of_one(shared: list, one: list, found: list) -> list:
            known = dict(zip(self._program.ins, [*shared, *one], strict=True))
            known |= {x: _turned(array, (to, at))
                      for (x, (at, to)), array in zip(of_loops, found, strict=False)}  # fmt: skip
            value = by_jax(steps, known)
            return [_turned(jnp.asarray(value(x)), moved.get(x, (0, 0))) for x in wanted]

        return jax.jit(jax.vmap(of_one, (None, 0, 0), out_axes))

    def _check_room(self) -> None:
        """Raises Unknown where what is held for a group of machines takes too much of the RAM."""
        room, needed = host_bytes(), self._holding * _cores()
        if room is not None and needed > SHARE * room:
            raise Unknown(f"the memories of all trials of {self.lanes * _cores()} machines, which "
                          f"take {shown(needed)} of the RAM")  # fmt: skip

    @property
    def tile(self) -> int:
        """The number of machines that are computed at once."""
        of_one = self._holding + sum(loop.drawn for loop in self._loops) * self.lanes
        groups = max(1, AT_ONCE // max(of_one, 1) // _cores()) * _cores()
        return groups * self.lanes

    def __call__(self, common: Any, batch: Any) -> Any:
        """The results of all machines, whose numbers are along the leading axis of the batch.

        Under `jit` and `vmap` the compiled loops are callbacks.
        """
        shared, each = jax.tree.leaves(common), jax.tree.leaves(batch)
        machines, tile = len(each[0]), self.tile
        traced = any(isinstance(x, jax.core.Tracer) for x in (*shared, *each))
        of_tile = partial(self._of_tile, shared, traced=traced)
        if machines <= tile:
            found = of_tile(each)
        else:
            count = -(-machines // tile)
            at = np.minimum(np.arange(count * tile), machines - 1).reshape(count, tile)
            if traced:
                found = lax.map(of_tile, [jnp.asarray(x)[at] for x in each])
                found = [x.reshape(count * tile, *x.shape[2:])[:machines] for x in found]
            else:
                parts = [of_tile([np.asarray(x)[i] for x in each]) for i in at]
                found = [np.concatenate(of)[:machines] for of in zip(*parts, strict=True)]
        return jax.tree.unflatten(self._tree, found)

    def _of_tile(self, shared: list, each: list, *, traced: bool) -> list:
        machines, ticket = len(each[0]), jnp.zeros((), jnp.uint32)
        found: list = []
        for i, loop in enumerate(self._loops):
            operands = loop.first(shared, each, found)
            run = partial(self._run, i, machines)
            if traced:
                shapes = [jax.ShapeDtypeStruct((machines, *x.shape), x.dtype) for x in loop.found]
                like = [jax.ShapeDtypeStruct((), jnp.uint32), *shapes]
                ticket, *new = jax.pure_callback(run, like, ticket, *operands,
                                                 vmap_method="sequential")  # fmt: skip
            else:
                ticket, *new = run(ticket, *operands)
            found += new
        return self._last(shared, each, found)

    def _run(self, i: int, machines: int, ticket: Any, *operands: Any) -> list:
        """The results of a loop, after the ticket under which others wait for later loops."""
        loop, groups = self._loops[i], -(-machines // self.lanes)
        ticket, held = self._rooms.of(int(ticket))
        outs = loop.run(groups, operands, held)
        if i + 1 == len(self._loops):
            self._rooms.free(ticket)
        pairs = zip(loop.shown, loop.found, strict=True)
        return [np.uint32(ticket), *(_apart(outs[x], like, machines) for x, like in pairs)]

    def bytes_of(self, machines: int) -> int:
        """The bytes that these machines take: what passes JAX, twice, and what loops need."""
        tile = min(machines, self.tile)
        passing = [_size(x) for loop in self._loops for x in (*loop.each, *loop.shown)]
        results = [_size(x) for x in self._program.outs]
        work = max(loop.text.work for loop in self._loops) * _cores()
        held = self._holding * -(-tile // self.lanes)
        return 2 * (sum(passing) * tile + sum(results) * machines) + held + work


class _Loop:
    """A loop over trials, compiled.

    before: the steps by JAX before it, with those before earlier loops
    step: the loop, lowered
    varying: the values that differ from machine to machine
    read: the values that somebody reads after this loop
    held: the value of a result of an earlier loop for each operand that waits for this one
    lanes: number of machines in a group
    given: the operands that JAX computes
    each: those of them that differ from machine to machine
    shown: the results that JAX reads
    holding: bytes that the results for later loops take for a group
    drawn: bytes of the operands of a machine
    """

    def __init__(self, before: list[Step], step: Step, varying: set[Value], read: set[Value],
                 held: dict[Value, Value], lanes: int):  # fmt: skip
        self.before, self.step, self._held, self._lanes = before, step, held, lanes
        alike = [isinstance(x, Const) or (x not in varying and x not in held) for x in step.ins]
        real = np.dtype(float)
        plan = Trials(step, alike, _fixed(before, step), real)
        kept = self._kept = {*held.values()}
        self.shown = [x for x in step.outs if x in read and x not in kept]
        wanted = [x in read for x in step.outs]
        self.text = Text(plan, lanes, wanted, partial(_in_vectors, lanes))
        self._constants = [_contiguous(x) for x in plan.given]
        self.moved: dict[Value, tuple[int, int]] = {}
        for i, x in enumerate(step.ins):
            if self.moved.setdefault(x, plan.moved(i)) != plan.moved(i):
                raise Unknown("an array with two axes of samples")
        self.found_at = {x: plan.moved(i, out=True) for i, x in enumerate(step.outs)}
        self.found = [Value(_moved(x.shape, *self.found_at[x]), x.dtype) for x in self.shown]
        self._code = _Code(self.text.text)
        self.given = [x for x in step.ins if x not in held]
        self.each = [x for x, same in zip(step.ins, alike, strict=True)
                     if not same and x not in held]  # fmt: skip
        self.holding = sum(_size(x) for x in step.outs if x in kept) * lanes
        self.drawn = sum(_size(x) for x in self.each)
        self.first: Any = None

    def run(self, groups: int, operands: Sequence[Any], held: dict[Value, np.ndarray]) -> dict:
        """The results for groups of machines by value, each (groups, numbers, lanes).

        operands: those of `given`, with machines along the leading axis if they differ
        held: what waits for later loops, to which that of this one is added
        """
        computed = iter(operands)
        given = []
        for x in self.step.ins:
            if x in self._held:
                given.append(held[self._held[x]])
                continue
            value = np.asarray(next(computed))
            given.append(_grouped(value, groups, self._lanes) if x in self.each
                         else _contiguous(value))  # fmt: skip
        outs = {}
        for x in self.step.outs:
            shape, dtype = (groups, math.prod(x.shape), self._lanes), _stored(x.dtype)
            if x not in self._kept:
                outs[x] = _aligned(shape if x in self.shown else (0,), dtype)
            else:
                if x not in held or held[x].shape != shape:
                    held[x] = _aligned(shape, dtype)
                outs[x] = held[x]
        self._code.run(groups, given + self._constants, [*outs.values()], self.text.work)
        return outs


class _Rooms:
    """Rows that wait in the RAM from one loop over trials to the next, by the number of a ticket.

    A room is used again for the next machines.
    """

    def __init__(self):
        self._count, self._lock = itertools.count(1), threading.Lock()
        self._taken: dict[int, dict] = {}
        self._free: list[dict] = []

    def of(self, ticket: int) -> tuple[int, dict]:
        """The ticket and its room; a new one for the ticket 0."""
        with self._lock:
            if ticket == 0:
                ticket = next(self._count)
                self._taken[ticket] = self._free.pop() if self._free else {}
                while len(self._taken) > WAITING:
                    self._taken.pop(next(iter(self._taken)))
            return ticket, self._taken[ticket]

    def free(self, ticket: int) -> None:
        """Leave the room of a ticket to the next one."""
        with self._lock:
            self._free = [self._taken.pop(ticket)]


class Native:
    """A function of what is common and of one machine, compiled where that is possible.

    fn: the function
    xla: the function of what is common and of a batch that computes the same by XLA
    """

    def __init__(self, fn: Callable[[Any, Any], Any], xla: Callable[[Any, Any], Any]):
        self._fn, self._xla = fn, xla
        self._programs: dict[Any, Compiled | str] = {}

    def why_not(self, common: Any, batch: Any) -> str | None:
        """The reason why XLA computes these arguments; None where a compiled program does.

        A new program first computes this batch, and its results are compared with those of XLA.
        """
        key = _key(common, batch)
        if key not in self._programs:
            self._programs[key] = self._tried(common, batch)
        found = self._programs[key]
        return found if isinstance(found, str) else None

    def program(self, common: Any, batch: Any) -> Compiled:
        """The program of arguments for which `why_not` gave no reason."""
        found = self._programs[_key(common, batch)]
        assert isinstance(found, Compiled)
        return found

    def _tried(self, common: Any, batch: Any) -> Compiled | str:
        try:
            program = Compiled(self._fn, common, jax.tree.map(lambda x: x[0], batch))
            if not program.learns:
                return ONCE
        except Unknown as unknown:
            return str(unknown)
        except Exception as error:  # of ours, which is no reason not to learn
            log.warning("native: %s: %s; XLA computes instead", type(error).__name__, error)
            return f"an error of the compiler, {type(error).__name__}: {error}"
        off = differs(program(common, batch), self._xla(common, batch))
        if off is None:
            return program
        log.warning("native: %s, as XLA computes it; XLA computes instead", off)
        return f"another result than that of XLA: {off}"


def fastest(
    fn: Callable[[Any, Any], Any], common: Any, batch: Any, *, lanes: int | None = None
) -> tuple[Callable[[Any, Any], Any], bool]:
    """`tiled(fn)`, or a compiled program that does the same, and whether it is the latter.

    A program is compiled where `setup` asks for it. It first computes a tile of this batch, and its
    results are compared with those of XLA.

    common, batch: arguments, of which a program may be called with others of the same shapes
    """
    by_xla = tiled(fn, lanes=lanes)
    if not native_wanted() or jax.default_backend() != "cpu":
        return by_xla, False
    native = Native(fn, by_xla)
    few = jax.tree.map(lambda x: x[: lanes or usual_lanes() or 1], batch)
    reason = native.why_not(common, few)
    log.info("native: computed by %s", f"XLA: {reason}" if reason else "a program for this "
             "processor")  # fmt: skip
    return (by_xla, False) if reason else (native.program(common, few), True)


def why_not(machine: Machine, scheme: Scheme, task: Task, trials: int = 2) -> str | None:
    """The reason why this learning cannot be compiled; None where it can.

    Nothing is compared with XLA, and nothing is run. Raises ValueError as `learn` does.
    """

    def metrics(common: Any, one: Any) -> Any:
        machine, scheme, task = common
        return learn(machine, scheme, task, trials, key=jax.random.key(one)).metrics

    try:
        return None if Compiled(metrics, (machine, scheme, task), np.uint32(0)).learns else ONCE
    except Unknown as unknown:
        return str(unknown)


def _key(common: Any, batch: Any) -> Any:
    """What a program depends on: the structure, shapes and types of its arguments."""
    shared, of_shared = jax.tree.flatten(common)
    each, of_each = jax.tree.flatten(batch)
    shapes = [(x.shape[1:], x.dtype) for x in each]
    return of_shared, of_each, (*map(jax.typeof, shared),), (*shapes,)


def differs(found: Any, wanted: Any) -> str | None:
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
                near = np.abs(x - y) <= TOLERANCE * scale
            off = ~np.where(finite, near, (x == y) | (np.isnan(x) & np.isnan(y)))
        if off.any():
            machine, at = (int(i) for i in np.argwhere(off)[0])
            return f"{name} of machine {machine} is {x[machine, at]} in place of {y[machine, at]}"
    return None


# The operands
# --------------------------------------------------------------------------------------------------


def _held(parts: list[tuple[list[Step], Step]], after: list[Step],
          outs: Sequence[Value]) -> dict[Value, Value]:  # fmt: skip
    """The result of an earlier loop for each operand of a loop that reads it as it is.

    Of these, no step by JAX reads one but to give it another shape.
    """
    origin: dict[Value, Value] = {}
    by_jax, operands = [*outs], []
    for before, loop in [*parts, (after, None)]:
        for step in before:
            if in_order(step) and step.ins[0] in origin:
                origin[step.outs[0]] = origin[step.ins[0]]
            else:
                by_jax += step.ins
        if loop is not None:
            operands += loop.ins
            origin |= {x: x for x in loop.outs}
    seen = {origin[x] for x in by_jax if x in origin}
    return {x: origin[x] for x in operands if x in origin and origin[x] not in seen}


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


def _fixed(before: Sequence[Step], step: Step) -> list[Any]:
    """The values of operands of the loop over trials that depend on no argument; else None."""
    known: dict[Value, Any] = {}
    by_jax(before, known)
    found = [x.array if isinstance(x, Const) else known.get(x) for x in step.ins]
    return [None if x is None or np.size(x) > FEW else np.asarray(x) for x in found]


def _size(x: Value) -> int:
    """The bytes of an array of one machine."""
    return math.prod(x.shape) * np.dtype(x.dtype).itemsize


def _turned(x: Any, move: tuple[int, int]) -> Any:
    return x if move[0] == move[1] else jnp.moveaxis(x, *move)


def _moved(shape: Sequence[int], at: int, to: int) -> tuple[int, ...]:
    """The shape of an array of which one axis is moved."""
    rest = [n for i, n in enumerate(shape) if i != at]
    return (*rest[:to], *shape[at : at + 1], *rest[to:])


def _stored(dtype: Any) -> Any:
    """The type of numbers as they are in RAM."""
    return np.dtype(np.uint8) if np.dtype(dtype) == bool else np.dtype(dtype)


def _aligned(shape: Sequence[int], dtype: Any) -> np.ndarray:
    """An array whose first number is aligned."""
    dtype = np.dtype(dtype)
    size = int(np.prod(shape, dtype=int)) * dtype.itemsize
    room = np.empty(size + ALIGNED, np.uint8)
    start = -room.ctypes.data % ALIGNED
    return room[start : start + size].view(dtype).reshape(shape)


def _contiguous(x: Any) -> np.ndarray:
    x = np.asarray(x)
    x = x.astype(_stored(x.dtype), copy=False)
    out = _aligned(x.shape, x.dtype)
    out[...] = x
    return out


def _grouped(x: np.ndarray, groups: int, lanes: int) -> np.ndarray:
    """(groups, ..., lanes) the numbers of (machines, ...); the last machine fills its group."""
    x = x.astype(_stored(x.dtype), copy=False)
    flat = x.reshape(len(x), math.prod(x.shape[1:]))
    size, whole = flat.shape[1], len(x) // lanes
    out = _aligned((groups, size, lanes), x.dtype)
    out[:whole] = flat[: whole * lanes].reshape(whole, lanes, size).transpose(0, 2, 1)
    if whole < groups:
        rest = flat[whole * lanes :]
        out[whole, :, : len(rest)] = rest.T
        out[whole, :, len(rest) :] = rest[-1][:, None]
    return out


def _apart(out: np.ndarray, like: Value, machines: int) -> np.ndarray:
    """(machines, ...) the numbers of (groups, ..., lanes)."""
    groups, size, lanes = out.shape
    apart = out.transpose(0, 2, 1).reshape(groups * lanes, size)[:machines]
    apart = apart.reshape(machines, *like.shape)
    return apart.astype(bool) if np.dtype(like.dtype) == bool else apart


# The processor
# --------------------------------------------------------------------------------------------------


@cache
def _llvm() -> Any:
    """The module of llvmlite, ready for this processor; raises Unknown without it."""
    try:
        import llvmlite.binding as llvm
    except ImportError as error:
        raise Unknown("llvmlite is not installed: pip install jaxilc[native]") from error
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    return llvm


@cache
def _width() -> int:
    """The bytes of a register of this processor."""
    known = _llvm().get_host_cpu_features()
    return next((size for name, size in WIDEST.items() if known.get(name)), 16)


class _Code:
    """The machine code of a text."""

    def __init__(self, text: str):
        llvm = _llvm()
        machine = llvm.Target.from_default_triple().create_target_machine(
            cpu=llvm.get_host_cpu_name(),
            features=llvm.get_host_cpu_features().flatten(),
            opt=3,
            jit=True,
        )
        try:
            module = llvm.parse_assembly(text)
        except RuntimeError as error:
            raise Unknown(f"LLVM refuses the program: {error}".replace("\n", " ")) from error
        module.triple, module.data_layout = machine.triple, str(machine.target_data)
        module.verify()
        place = _place_of(text)
        known = None if place is None else _kept(place)
        if known is None:
            options = llvm.create_pipeline_tuning_options(speed_level=2)
            options.loop_vectorization = options.slp_vectorization = False
            builder = llvm.create_pass_builder(machine, options)
            builder.getModulePassManager().run(module, builder)
        for function in module.functions:
            if function.is_declaration and not function.name.startswith("llvm."):
                llvm.add_symbol(function.name, _address(function.name))
        self._engine = llvm.create_mcjit_compiler(module, machine)
        if place is not None:
            self._engine.set_object_cache(
                lambda _, compiled: _keep(place, compiled), lambda _: known
            )
        self._engine.finalize_object()
        pointer, whole = ctypes.c_void_p, ctypes.c_int64
        kind = ctypes.CFUNCTYPE(None, whole, whole, pointer, pointer, pointer)
        self._call = kind(self._engine.get_function_address("run"))

    def run(self, groups: int, given: list[np.ndarray], outs: list[np.ndarray], work: int) -> None:
        """Run all groups, on as many threads as there are cores."""
        pointers = [(ctypes.c_void_p * max(len(of), 1))(*(x.ctypes.data for x in of))
                    for of in (given, outs)]  # fmt: skip
        threads = min(_cores(), groups)
        ends = [groups * i // threads for i in range(threads + 1)]

        def part(i: int) -> None:
            room = _aligned((max(work, 1),), np.uint8)
            self._call(ends[i], ends[i + 1], *pointers, room.ctypes.data)

        if threads == 1:
            part(0)
        else:
            with ThreadPoolExecutor(threads) as pool:
                list(pool.map(part, range(threads)))


def _place_of(text: str) -> Path | None:
    """The file of the machine code of a text, beside the programs that JAX keeps; None for none."""
    folder = _folder()
    if not folder:
        return None
    processor = _llvm().get_host_cpu_name(), _llvm().get_host_cpu_features().flatten()
    of = "\0".join((metadata.version("llvmlite"), *processor, text))
    key = hashlib.sha256(of.encode()).hexdigest()
    return Path(folder) / f"native-{key}"


def _folder() -> str | None:
    """The folder in which JAX keeps its programs."""
    kept = jax.config.jax_enable_compilation_cache
    return jax.config.jax_compilation_cache_dir if kept else None


def _kept(place: Path) -> bytes | None:
    """The machine code of a file; None where there is none, or not what was written under its name.

    Machine code that was damaged, or exchanged for another, would do anything.
    """
    try:
        found = place.read_bytes()
    except OSError:
        return None
    return found[32:] if found[:32] == _seal(place, found[32:]) else None


def _keep(place: Path, compiled: bytes) -> None:
    """Write machine code at once or not at all."""
    beside = place.with_name(f"{place.name}.{os.getpid()}.{threading.get_ident()}")
    with suppress(OSError):
        beside.write_bytes(_seal(place, compiled) + compiled)
        beside.replace(place)


def _seal(place: Path, compiled: bytes) -> bytes:
    return hashlib.sha256(place.name.encode() + b"\0" + compiled).digest()


def _in_vectors(lanes: int, name: str, operands: int) -> str | None:
    """The name of a function of the C library for a vector of numbers; None where it has none."""
    letter, feature = {8: ("e", "avx512f"), 4: ("d", "avx2"), 2: ("b", "sse2")}.get(lanes, ("", ""))
    if not _llvm().get_host_cpu_features().get(feature):
        return None
    found = f"_ZGV{letter}N{lanes}{'v' * operands}_{name}"
    try:
        _address(found)
    except Unknown:
        return None
    return found


def _address(name: str) -> int:
    """The address of a function of the C library; raises Unknown where there is none."""
    for library in (None, "libm.so.6", "libmvec.so.1"):
        try:
            found = getattr(ctypes.CDLL(library), name)
        except (OSError, AttributeError, TypeError):
            continue
        return ctypes.cast(found, ctypes.c_void_p).value or 0
    raise Unknown(f"{name}, which is not in the C library")


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
