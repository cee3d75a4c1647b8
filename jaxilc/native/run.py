"""Compiled programs: built from a function that learns, run on many machines, and checked."""

from __future__ import annotations

import ctypes
import logging
import math
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..learning.machine import Machine
from ..learning.over_trials import learn
from ..schemes import Scheme
from ..signals.task import Task
from .llvm import ALIGNED, Text
from .operations import foreign
from .program import Const, Program, Step, Unknown, Value, by_jax, flat, of_trials
from .rows import Trials

log = logging.getLogger("jaxilc")

WIDEST = {"avx512f": 64, "avx": 32, "neon": 16}  # bytes of a register, by a feature
ONCE = "trials that are all alike, of which XLA computes one"
FEW = 64  # numbers of an operand that are written into the program where they never change
TOLERANCE = 1e-9  # of the largest number of a machine, by which the check may find a difference


class Compiled:
    """A program of a function of what is common to all machines, and of one machine.

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
        closed, shape = jax.make_jaxpr(fn, return_shape=True)(common, one)
        self._tree = jax.tree.structure(shape)
        self._program: Program = flat(closed)
        self._before, self._trials, self._after = of_trials(self._program, foreign)
        shared = len(jax.tree.leaves(common))
        self._alike = _alike(self._program, self._before, self._trials, shared)
        real = np.dtype(float)
        plan = Trials(self._trials, self._alike, _fixed(self._before, self._trials), real)
        self.lanes = _width() // real.itemsize if lanes is None else lanes
        read = {x for step in self._after for x in step.ins} | {*self._program.outs}
        self._wanted = [x in read for x in self._trials.outs]
        self.text = Text(plan, self.lanes, self._wanted, partial(_in_vectors, self.lanes))
        self.learns = _learns(self._trials)
        self._constants = [_contiguous(x) for x in plan.given]
        self._carry, self._count = plan.carry, plan.trials
        self._code = _Code(self.text.text)
        axes = (None, 0)
        self._first = jax.jit(jax.vmap(self._operands, axes, [None if a else 0
                                                              for a in self._alike]))  # fmt: skip
        self._last = jax.jit(jax.vmap(self._results, (*axes, 0)))

    def __call__(self, common: Any, batch: Any) -> Any:
        """The results of all machines, whose numbers are along the leading axis of the batch."""
        shared, each = jax.tree.leaves(common), jax.tree.leaves(batch)
        machines = len(each[0])
        groups = -(-machines // self.lanes)
        operands = self._first(shared, each)
        given = [
            _contiguous(x) if alike else _grouped(np.asarray(x), groups, self.lanes)
            for x, alike in zip(operands, self._alike, strict=True)
        ] + self._constants  # fmt: skip
        outs = []
        for i, x in enumerate(self._trials.outs):
            size = int(np.prod(x.shape, dtype=int))
            wanted = self._wanted[i] or i >= self._carry
            dtype = np.uint8 if np.dtype(x.dtype) == bool else x.dtype
            outs.append(_aligned((groups if wanted else 0, size, self.lanes), dtype))
        self._code.run(groups, given, outs, self.text.work)
        found = [
            _apart(out, x, machines) if wanted else None
            for out, x, wanted in zip(outs, self._trials.outs, self._wanted, strict=True)
        ]
        return jax.tree.unflatten(self._tree, self._last(shared, each, found))

    def bytes_of(self, machines: int) -> int:
        """The bytes that these machines take: operands and results, twice, and what is carried."""
        sizes = [
            0 if alike else math.prod(x.shape)
            for x, alike in zip(self._trials.ins, self._alike, strict=True)
        ]
        sizes += [math.prod(x.shape) for x in self._trials.outs]
        return 16 * sum(sizes) * machines + self.text.work * _cores()

    def _operands(self, shared: list, one: list) -> list:
        known = dict(zip(self._program.ins, [*shared, *one], strict=True))
        value = by_jax(self._before, known)
        return [jnp.asarray(value(x)) for x in self._trials.ins]

    def _results(self, shared: list, one: list, found: list) -> list:
        known = dict(zip(self._program.ins, [*shared, *one], strict=True))
        by_jax(self._before, known)
        outs = zip(self._trials.outs, found, strict=True)
        known |= {x: value for x, value in outs if value is not None}
        value = by_jax(self._after, known)
        return [jnp.asarray(value(x)) for x in self._program.outs]


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


def _alike(program: Program, before: Sequence[Step], step: Step, shared: int) -> list[bool]:
    """Whether each operand of the loop over trials depends on what is common alone."""
    varying: set[Value] = set(program.ins[shared:])
    for one in before:
        if any(x in varying for x in one.ins):
            varying.update(one.outs)
    return [isinstance(x, Const) or x not in varying for x in step.ins]


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


def _aligned(shape: Sequence[int], dtype: Any) -> np.ndarray:
    """An array whose first number is aligned."""
    dtype = np.dtype(dtype)
    size = int(np.prod(shape, dtype=int)) * dtype.itemsize
    room = np.empty(size + ALIGNED, np.uint8)
    start = -room.ctypes.data % ALIGNED
    return room[start : start + size].view(dtype).reshape(shape)


def _contiguous(x: Any) -> np.ndarray:
    x = np.asarray(x)
    x = x.astype(np.uint8) if x.dtype == bool else x
    out = _aligned(x.shape, x.dtype)
    out[...] = x
    return out


def _grouped(x: np.ndarray, groups: int, lanes: int) -> np.ndarray:
    """(groups, ..., lanes) the numbers of (machines, ...); the last machine fills its group."""
    x = x.astype(np.uint8) if x.dtype == bool else x
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
        options = llvm.create_pipeline_tuning_options(speed_level=2)
        options.loop_vectorization = options.slp_vectorization = False
        builder = llvm.create_pass_builder(machine, options)
        builder.getModulePassManager().run(module, builder)
        for function in module.functions:
            if function.is_declaration and not function.name.startswith("llvm."):
                llvm.add_symbol(function.name, _address(function.name))
        self._engine = llvm.create_mcjit_compiler(module, machine)
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
