"""Compiled programs: built from a function that learns, run on many machines, and checked."""

from __future__ import annotations

import itertools
import logging
import re
from collections.abc import Callable, Hashable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import TYPE_CHECKING, Generic, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from ..learning.known_metrics import Metrics
from ..learning.machine import Machine
from ..learning.over_trials import learn
from ..runtime.capacity import cache_bytes, host_bytes, shown
from ..runtime.lanes import all_stored
from ..runtime.start import cores, native_unwanted
from ..runtime.tiles import tiled
from ..runtime.xla_options import QUICKLY
from ..schemes import Scheme
from ..signals.task import Task
from .code import WIDEST, agree, agreed, key_of, of_compiler, width
from .loops import Back, Blocks, ByValue, Loop, Memories, There, Whole, real, size_of
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
    jaxprs_within,
    loops,
    made_from,
    of_trials,
    read_alone,
    spared,
)

if TYPE_CHECKING:
    from ..runtime.jax_internals import ClosedJaxpr, Jaxpr

log = logging.getLogger("jaxilc")
Common = TypeVar("Common")  # trees of arrays: what is common to all machines,
One = TypeVar("One")  # one machine, or several, which are along the leading axis,
Found = TypeVar("Found")  # and results

ONCE = "trials that are all alike, of which XLA computes one"
SHARE = 0.25  # of the RAM that is free, which may be taken by what is held from loop to loop
AT_ONCE = 2**27  # bytes of operands that are in the RAM at once
# Bytes of what is held from loop to loop, that are in the RAM at once. With 2**27, slopes of eight
# trials of FFDL-MFAILC took half again as long, most of it to get pages from the system.
HELD_AT_ONCE = 2**24
# Operations of a trial for each number that it stores for the way back, up to which it takes less
# time to compute trials again than to wait for the RAM, on a processor with registers of 64 bytes;
# with shorter ones, which hold fewer machines, as many fewer. MFAILC has 15, laws with filters 190
# and more, which took 1.1 to 1.3 times as long. With AVX-512, value and slopes of FFDL took 0.9 of
# the time on one core and 0.7 to 0.8 on two, with AVX2 1.1 of it on one and as long on two.
FEW_OPERATIONS = 24
# of the largest number of a machine, by which the check may find a difference, by bytes of a number
TOLERANCE = {8: 1e-9, 4: 1e-4}


def lanes_of(machines: int | None) -> int:
    """The lanes for so many machines: as many as a register holds, fewer where these are few.

    A shorter register divides sooner: with AVX-512, CFDL-MFAILC on one machine takes 0.45 of the
    time with two lanes in place of eight.

    machines: None: any number
    """
    most, least = (size // real().itemsize for size in (width(), 16))
    return most if machines is None else min(most, max(least, 1 << (machines - 1).bit_length()))


class Compiled(Generic[Common, One, Found]):
    """A program of a function of what is common and of one machine.

    It has one or more loops over trials, each compiled for this processor, between which XLA
    computes. All is one function of JAX, in which XLA calls the loops (`jax.ffi`).

    fn: the function; it learns over trials
    common, one: its arguments, of which shapes and types are read
    lanes: number of machines in a group; None: as many as a register of the processor holds
    blocks: number of blocks of trials, of which a gradient stores the memories of one at a time;
        None: 1 where the memories of all trials take at most SHARE of the RAM that is free, and
        blocks would not save time, see `_waits`; else about the square root of the number of trials
    memories: what a gradient stores, in words; empty where nothing waits for a way back
    learns: whether the trials differ, see `ONCE`
    Raises Unknown, which says why, where the function cannot be compiled.
    """

    def __init__(self, fn: Callable[[Common, One], Found], common: Common, one: One,
                 lanes: int | None = None, blocks: int | None = None):  # fmt: skip
        if (backend := jax.default_backend()) != "cpu":
            raise Unknown(f"JAX computes on {backend}")
        with all_stored():
            closed, shape = jax.make_jaxpr(fn, return_shape=True)(common, one)
        self._jaxpr = closed.jaxpr
        self._tree = jax.tree.structure(shape)
        self._program: Program = flat(closed)
        self._shared = len(jax.tree.leaves(common))
        self.lanes = lanes_of(None) if lanes is None else lanes
        left: list[int] = []
        while not self._compiled(left):
            pass
        self.learns = any(_learns(loop.step) for loop in self._loops)
        self.memories = self._remembered(blocks)
        if (needed := self._room_for(self._held)) is not None:
            raise Unknown(f"the memories of {self.lanes * cores()} machines, which take {needed} "
                          "of the RAM")  # fmt: skip
        self._names = [loop.name for loop in self._loops]  # which compiles them
        self._call = jax.jit(self._of_batch)

    def _compiled(self, left: list[int]) -> bool:
        """Whether all loops over trials could be compiled but those that are left to XLA.

        An earlier one of which nothing waits for a later one, such as what prepares a scheme, is
        added to those that are left, and all are to be compiled again. Raises Unknown for others.
        """
        program = self._program
        self._parts, self._after = of_trials(program, foreign, left)
        if (of := Memories.of(self._parts, self._after, program.outs)) is not None:
            before = [x for steps, _ in self._parts[: of.back + 1] for x in steps]
            own, back = self._parts[of.back]
            self._parts[of.back] = own, spared(before, self._parts[of.there][1], back, of.tape)
            every = [*itertools.chain(*([*x, loop] for x, loop in self._parts)), *self._after]
            self._parts, self._after = read_alone(every, program.outs)
        shaping = [x for before, _ in self._parts for x in before if in_order(x)]
        self._read = self._by_stretch()
        self._varying = {*program.ins[self._shared :]}
        self._loops: list[Loop] = []
        steps: list[Step] = []
        for number, (before, step) in enumerate(self._parts):
            steps = steps + before
            self._varying = made_from(self._varying, before)
            read = set().union(*self._read[number + 1 :])
            try:
                self._loops.append(Whole(steps, step, self._varying, read, self.lanes))
            except Unknown:
                later = {x for _, loop in self._parts[number + 1 :] for x in loop.ins}
                if not later or not made_from(step.outs, shaping).isdisjoint(later):
                    raise
                numbers = (n for n in itertools.count() if n not in left)
                left.append(next(itertools.islice(numbers, number, None)))
                return False
            self._varying.update(step.outs)
        self._varying = made_from(self._varying, self._after)
        return True

    def _by_stretch(self) -> list[set[Value]]:
        """The values that are read before and by each loop, and after all of them."""
        stretches = [*(before for before, _ in self._parts), self._after]
        read = [{x for step in steps for x in step.ins} for steps in stretches]
        for of, (_, step) in zip(read, self._parts, strict=False):
            of.update(step.ins)
        read[-1].update(self._program.outs)
        return read

    def _remembered(self, count: int | None) -> str:
        """Divide the two loops of a gradient into blocks, where that is asked for or needed."""
        of = Memories.of(self._parts, self._after, self._program.outs)
        if of is None:
            return ""
        (_, there), (_, back) = self._parts[of.there], self._parts[of.back]
        trials, tape = there.length, {*of.tape.values()}
        stored, fits = shown(sum(map(size_of, tape))), self._room_for(self._held) is None
        if count == 1 or (count is None and fits and not self._waits(of)):
            return f"a gradient stores the memories of all {trials} trials, {stored} a machine"
        blocks = Blocks.of(trials, count)
        self._parts = [([x for x in before if x not in of.between], step)
                       for before, step in self._parts]  # fmt: skip
        self._after = [x for x in self._after if x not in of.between]
        self._read = [x - tape - {back.ins[i] for i in of.tape} for x in self._by_stretch()]
        before = [[x for steps, _ in self._parts[: n + 1] for x in steps]
                  for n in (of.there, of.back)]  # fmt: skip
        read = set().union(*self._read[of.there + 1 :])
        first = There(before[0], there, self._varying, read, self.lanes, tape, blocks)
        last = Back(before[1], there, first.kept, back, self._varying, self.lanes, of.tape, blocks)
        self._loops[of.there], self._loops[of.back] = first, last
        taken = shown(sum(map(size_of, first.kept)) + last.work / self.lanes)
        return (f"a gradient runs the trials once more, in {blocks.count} blocks of {blocks.each}, "
                f"and stores {taken} a machine in place of {stored}")  # fmt: skip

    def _waits(self, of: Memories) -> bool:
        """Whether a way back waits for the RAM, which it would not in blocks that a cache holds."""
        there, step, cache = self._loops[of.there], self._parts[of.there][1], cache_bytes()
        assert isinstance(there, Whole)
        if cache is None:
            return False
        stored, trials = sum(map(size_of, {*of.tape.values()})), step.length
        rows = {*step.apart(step.ins)[2]}
        read = sum(size_of(x) for x in rows.intersection(there.each))  # once more
        numbers = (stored - read) / trials / real().itemsize
        large = self.lanes * stored > 2 * cache
        block = self.lanes * stored * Blocks.of(trials).each / trials
        few = FEW_OPERATIONS * self.lanes * real().itemsize / max(WIDEST.values()) * numbers
        return large and 2 * block <= cache and there.operations <= few

    @property
    def _held(self) -> int:
        """The bytes that a group of machines holds: from loop to loop, and for a loop."""
        return self._between + max(of.work for of in self._loops)

    @property
    def _between(self) -> int:
        """The bytes of what a group of machines holds from loop to loop."""
        return sum(size_of(x) for of in self._loops[:-1] for x in of.shown) * self.lanes

    def _room_for(self, held: int) -> str | None:
        """What the groups that are computed together take, where that is too much of the RAM."""
        room, needed = host_bytes(), held * cores()
        return shown(needed) if room is not None and needed > SHARE * room else None

    @property
    def key(self) -> str:
        """What its numbers depend on besides its arguments, in short."""
        text = re.sub("0x[0-9a-f]+", "", str(self._jaxpr))
        return key_of(of_compiler(), text, *self._names)

    @property
    def tile(self) -> int:
        """The number of machines that are computed at once."""
        drawn = sum(size_of(x) for loop in self._loops for x in loop.each) * self.lanes
        most = min(AT_ONCE // max(drawn, 1), HELD_AT_ONCE // max(self._between, 1))
        groups = max(1, most // cores()) * cores()
        return groups * self.lanes

    def __call__(self, common: Common, batch: One) -> Found:
        """The results of all machines, whose numbers are along the leading axis of the batch."""
        found = self._call(jax.tree.leaves(common), jax.tree.leaves(batch))
        return jax.tree.unflatten(self._tree, found)

    def compile(self, common: Common, batch: One) -> None:
        """Let XLA compile what a later call with arguments of these shapes needs."""
        self._call.lower(jax.tree.leaves(common), jax.tree.leaves(batch)).compile()

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
        known: ByValue = dict(zip(self._program.ins, shared, strict=False))
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

    def _by_xla(self, steps: list[Step], known: ByValue, groups: int, read: set[Value]) -> ByValue:
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
        passing = [size_of(x) for loop in self._loops for x in (*loop.each, *loop.shown)]
        results = [size_of(x) for x in self._program.outs]
        work = max(loop.work for loop in self._loops) * cores()
        return 2 * (sum(passing) * tile + sum(results) * machines) + work


class Native(Generic[Common, One, Found]):
    """A function of what is common and of one machine, compiled where that is possible.

    many: whether a program is called with more machines than those that it is made with
    """

    def __init__(self, fn: Callable[[Common, One], Found], *, many: bool = False):
        self._fn, self._many = fn, many
        self._programs: dict[Hashable, Compiled[Common, One, Found] | str] = {}

    def why_not(self, common: Common, batch: One, *, ahead: bool = False) -> str | None:
        """The reason why XLA computes these arguments; None where a compiled program does.

        A new program first computes a few machines of this batch, a group and one more. Its results
        are compared with those of XLA, which compiles quickly, and once more with its optimiser
        where they differ.
        Where machine code is kept on disk, it is noted there that they agree, for later processes.

        ahead: whether a call that no `jit` is around computes all of the batch next; XLA then
            compiles for it at the same time
        """
        key = self._key(common, batch)
        if key not in self._programs:
            self._programs[key] = self._tried(common, batch, ahead)
        found = self._programs[key]
        return found if isinstance(found, str) else None

    def program(self, common: Common, batch: One) -> Compiled[Common, One, Found]:
        """The program of arguments for which `why_not` gave no reason."""
        found = self._programs[self._key(common, batch)]
        assert isinstance(found, Compiled)
        return found

    def _lanes(self, batch: One) -> int:
        return lanes_of(None if self._many else len(jax.tree.leaves(batch)[0]))

    def _key(self, common: Common, batch: One) -> Hashable:
        """What a program depends on: lanes, and the structure, shapes and types of arguments."""
        shared, of_shared = jax.tree.flatten(common)
        each, of_each = jax.tree.flatten(batch)
        shapes = [(x.shape[1:], x.dtype) for x in each]
        return self._lanes(batch), of_shared, of_each, (*map(jax.typeof, shared),), (*shapes,)

    def _tried(self, common: Common, batch: One, ahead: bool) -> Compiled[Common, One, Found] | str:
        try:
            one = jax.eval_shape(_first, batch)
            program = Compiled(self._fn, common, one, self._lanes(batch))
            if not program.learns:
                return ONCE
            if program.memories:
                log.info("native: %s", program.memories)
        except Exception as error:
            return _reason(error)
        key = program.key
        if agreed(key):
            return program
        few = jax.tree.map(lambda x: x[: program.lanes + 1], batch)
        by_xla = jax.vmap(self._fn, (None, 0))
        both = jax.jit(lambda *arguments: (program(*arguments), by_xla(*arguments)))
        with ThreadPoolExecutor(1) as aside:
            if ahead:
                aside.submit(program.compile, common, batch)
            traced = both.lower(common, few)
            for options in (QUICKLY, None):  # a gradient of XLA was NaN without its optimiser alone
                off = differs(*traced.compile(options)(common, few))
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
    steps: Callable[[], float],
    lanes: int | None = None,
) -> tuple[Callable[[Common, One], Found], bool]:
    """`tiled(fn)`, or a compiled program that does the same, and whether it is the latter.

    A program is compiled where `setup` asks for it, or the sample-steps are worth it, and compared
    with XLA, see `Native.why_not`.

    common, batch: arguments, of which a program may be called with others of the same shapes
    steps: gives the number of sample-steps of all calls together, see `native_unwanted`
    """
    by_xla = tiled(fn, lanes=lanes)
    native, reason = Native(fn), native_unwanted(steps)
    reason = reason or native.why_not(common, batch)
    log.info("native: computed by %s", f"XLA: {reason}" if reason else "a program for this "
             "processor")  # fmt: skip
    return (by_xla, False) if reason else (native.program(common, batch), True)


def sample_steps(fn: Callable[[Common, One], Found], common: Common, batch: One) -> float:
    """The sample-steps of a function over a batch: the turns of the loops that have none within."""

    def turns(jaxpr: Jaxpr | ClosedJaxpr) -> float:
        found = 0.0
        for step in jaxpr.eqns:
            within = sum(map(turns, jaxprs_within(step)))
            scans = step.primitive.name == "scan"
            found += step.params["length"] * max(within, 1) if scans else within
        return found

    one = jax.eval_shape(_first, batch)
    return turns(jax.make_jaxpr(fn)(common, one)) * len(jax.tree.leaves(batch)[0])


def _first(batch: One) -> One:
    return jax.tree.map(lambda x: x[0], batch)


def why_not(machine: Machine, scheme: Scheme, task: Task, trials: int = 2) -> str | None:
    """The reason why this learning cannot be compiled; None where it can.

    Nothing is compared with XLA, and nothing is run. Raises ValueError as `learn` does.
    """

    def metrics(common: tuple[Machine, Scheme, Task], one: np.uint32) -> Metrics:
        machine, scheme, task = common
        return learn(machine, scheme, task, trials, key=jax.random.key(one)).metrics

    arguments = (machine, scheme, task), np.uint32(0)
    jax.eval_shape(metrics, *arguments)  # raises what `learn` raises
    try:
        return None if Compiled(metrics, *arguments).learns else ONCE
    except Exception as error:
        return _reason(error)


def _reason(error: Exception) -> str:
    """What keeps a function from being compiled; errors of ours are no reason not to learn."""
    if isinstance(error, Unknown):
        return str(error)
    log.warning("native: %s: %s; XLA computes instead", type(error).__name__, error)
    return f"an error of the compiler, {type(error).__name__}: {error}"


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


def _learns(step: Step) -> bool:
    """Whether a loop over samples depends on the trials before, or on the number of the trial."""
    _, carried, rows = step.apart(step.body.ins)
    moving = made_from([*carried, *rows], step.body.steps)
    return any(not moving.isdisjoint(of.ins) for of in loops(step.body))
