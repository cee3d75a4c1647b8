"""Compiled loops over trials: whole ones, and the two of a gradient in blocks of trials.

The way back of a gradient reads the memories of each trial, which the way there stores. Those of
all trials may be too many for the cache, or for the RAM. In blocks, the way there (`There`) stores
only what is carried from block to block. The way back (`Back`) begins with the last block: it runs
the trials of a block once more, this time with their memories, and then goes back through them.
Each thread has room for the memories of one block, which it uses again for the next one.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property, partial
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from .code import callable_by_xla, in_vectors, room, target
from .llvm import OPERANDS, Lines, Text, aligned, module
from .program import (
    Const,
    Known,
    Parts,
    Step,
    Value,
    by_jax,
    in_order,
    made_from,
    without_dead_of_loop,
)
from .rows import Trials, in_turn

FEW = 64  # real numbers of an operand that are written into the program where they never change
ByValue: TypeAlias = dict[Value, jax.Array]


class Function:
    """A loop over trials, planned and printed as a function of LLVM.

    before: the steps by XLA before it, with those before earlier loops
    step: the loop, lowered
    varying: the values that differ from machine to machine
    wanted: whether each result is written
    lanes: number of machines in a group
    name: that of the function
    blocks: whether it is called for blocks of trials; each group then has what it carries for its
        own, even where it is the same for all machines
    constants: further operands
    """

    def __init__(self, before: list[Step], step: Step, varying: set[Value], wanted: Sequence[bool],
                 lanes: int, name: str = "run", *, blocks: bool = False):  # fmt: skip
        self.step, self.lanes = step, lanes
        self._varies = [not isinstance(x, Const) and x in varying for x in step.ins]
        whole, carried, rows = step.apart([not x for x in self._varies])
        self._alike = [*whole, *(x and not blocks for x in carried), *rows]
        self.plan = Trials(step, self._alike, _fixed(before, step), real())
        self.text = Text(self.plan, lanes, wanted, partial(in_vectors, lanes, real().itemsize),
                         name)  # fmt: skip
        self.constants = [np.ascontiguousarray(x) for x in self.plan.given]

    @property
    def operations(self) -> int:
        """The operations of a trial that are not known before its loops over samples."""
        segments = [segment for loop in self.plan.loops for segment in loop.segments]
        return sum((of.last - of.first) * sum(x.varies and bool(x.args) for x in in_turn(of.wanted))
                   for of in segments)  # fmt: skip

    def operands(self, known: ByValue, groups: int, without: Iterable[int] = ()) -> list[jax.Array]:
        """What it reads, for groups of machines, but for some operands; and the constants."""
        found = []
        for i, x in enumerate(self.step.ins):
            if i in without:
                continue
            array = jnp.asarray(x.array) if isinstance(x, Const) else known[x]
            at, to = self.plan.moved(i)
            if self._varies[i] or self._alike[i]:
                one = int(self._varies[i])  # the axis of the groups
                found.append(_turned(array, at + one, to + one))
            else:
                array = _turned(array, at, to)[None, ..., None]
                found.append(jnp.broadcast_to(array, (groups, *array.shape[1:-1], self.lanes)))
        return [*found, *map(jnp.asarray, self.constants)]

    def each(self, without: Iterable[int] = ()) -> list[Value]:
        """The operands that differ from machine to machine, but for some."""
        return [x for i, x in enumerate(self.step.ins) if self._varies[i] and i not in without]

    def bytes_of(self, i: int) -> int:
        """The bytes of a result of a group of machines: of all trials, or what is carried."""
        return self.lanes * size_of(self.step.outs[i])

    def like(self, i: int, groups: int, *blocks: int) -> jax.ShapeDtypeStruct:
        """The shape and type of a result of XLA's call, with axes of groups and of blocks."""
        x, (at, to) = self.step.outs[i], self.plan.moved(i, out=True)
        one = jax.eval_shape(partial(_turned, at=at, to=to), jax.ShapeDtypeStruct(x.shape, x.dtype))
        return jax.ShapeDtypeStruct((groups, *blocks, *one.shape, self.lanes), x.dtype)

    def turned_back(self, i: int, array: jax.Array) -> jax.Array:
        """A result of XLA's call with its axes in order."""
        at, to = self.plan.moved(i, out=True)
        return _turned(array, to + 1, at + 1)


class Loop:
    """A loop over trials that is compiled.

    step: the loop, lowered
    each: the operands that differ from machine to machine
    shown: the results, for those who read them
    work: bytes that a group needs
    """

    step: Step
    each: list[Value]
    shown: list[Value]
    work: int

    @cached_property
    def name(self) -> str:
        """The name under which XLA calls it, which follows from what it computes."""
        raise NotImplementedError

    def __call__(self, known: ByValue, groups: int) -> ByValue:
        """The results for groups of machines by value, from those of what it reads."""
        raise NotImplementedError

    def _called(
        self, operands: list[jax.Array], like: list[jax.ShapeDtypeStruct]
    ) -> list[jax.Array]:
        outs = [*like, jax.ShapeDtypeStruct(room(self.work), np.dtype(np.uint8))]
        return [*jax.ffi.ffi_call(self.name, outs, vmap_method="sequential")(*operands)[:-1]]


class Whole(Loop):
    """A loop through all trials at once.

    read: the values that somebody reads after it
    The other arguments are those of `Function`.
    """

    def __init__(self, before: list[Step], step: Step, varying: set[Value], read: set[Value],
                 lanes: int):  # fmt: skip
        wanted = [x in read for x in step.outs]
        self._function = Function(before, step, varying, wanted, lanes)
        self.step, self.each, self.work = step, self._function.each(), self._function.text.work
        self.operations = self._function.operations
        self._found = [i for i, w in enumerate(wanted) if w]
        self.shown = [step.outs[i] for i in self._found]

    @cached_property
    def name(self) -> str:
        of = self._function
        results = [of.bytes_of(i) if i in self._found else None for i in range(len(self.step.outs))]
        operands = len(self.step.ins) + len(of.constants)
        return target(callable_by_xla(module([of.text]), operands, results, self.work,
                                      self.step.length))  # fmt: skip

    def __call__(self, known: ByValue, groups: int) -> ByValue:
        of = self._function
        found = self._called(of.operands(known, groups), [of.like(i, groups) for i in self._found])
        return {self.step.outs[i]: of.turned_back(i, x)
                for i, x in zip(self._found, found, strict=True)}  # fmt: skip


# In blocks of trials
# --------------------------------------------------------------------------------------------------


class Memories(NamedTuple):
    """What the way back of a gradient reads of each trial, and nobody else.

    there, back: the numbers of the two loops
    tape: the result of the way there that is read, by the number of an operand of the way back
    between: the steps of XLA that only give another shape to it
    """

    there: int
    back: int
    tape: dict[int, Value]
    between: set[Step]

    @classmethod
    def of(cls, parts: Parts, rest: list[Step],
           outs: Sequence[Value]) -> Memories | None:  # fmt: skip
        """Those of a program: its loops with the steps before each, those after, and its results.

        None where there are none.
        """
        ways = ((i, loop) for i, (_, loop) in enumerate(parts) if not loop.params["reverse"])
        return next(filter(None, (cls._of(*way, parts, rest, outs) for way in ways)), None)

    @classmethod
    def _of(cls, there: int, loop: Step, parts: Parts, rest: list[Step],
            outs: Sequence[Value]) -> Memories | None:  # fmt: skip
        later = parts[there + 1 :]
        steps = [*itertools.chain(*(before for before, _ in later)), *rest]
        shaping = [step for step in steps if in_order(step)]
        elsewhere = {*outs, *(x for step in steps if not in_order(step) for x in step.ins)}
        by_row = set[Value]()
        for _, way in later:
            whole, carried, rows = way.apart(way.ins)
            elsewhere |= {*whole, *carried}
            by_row |= {*rows}
        forms: dict[Value, set[Value]] = {}  # of what each trial reads its own row, in any shape
        for x in loop.results_apart(loop.outs)[1]:
            same = made_from([x], shaping)
            if same.isdisjoint(elsewhere) and all(y.shape == x.shape for y in same & by_row):
                forms[x] = same
        for back, (_, way) in enumerate(later, there + 1):
            others = {x for _, other in later if other is not way for x in other.ins}
            alone = {x: same for x, same in forms.items() if same.isdisjoint(others)}
            tape = {i: x for x, same in alone.items() for i, y in enumerate(way.ins) if y in same}
            if tape and way.params["reverse"]:
                kept = set().union(*(alone[x] for x in tape.values()))
                return cls(there, back, tape, {step for step in shaping if step.outs[0] in kept})
        return None


class Blocks(NamedTuple):
    """Trials in blocks, of which the last one may be shorter.

    trials: number of all trials
    each: number of those in a block
    """

    trials: int
    each: int

    @classmethod
    def of(cls, trials: int, count: int | None = None) -> Blocks:
        """So many blocks, or about the square root of all trials."""
        each = math.isqrt(trials - 1) + 1 if count is None else -(-trials // count)
        return cls(trials, each)

    @property
    def count(self) -> int:
        return -(-self.trials // self.each)


class There(Loop):
    """The way there of a gradient in blocks: what is carried out of each block, and the results.

    memories: what the way back reads, which is not stored
    kept: for each value that is carried, the values after all blocks
    """

    def __init__(self, before: list[Step], step: Step, varying: set[Value], read: set[Value],
                 lanes: int, tape: set[Value], blocks: Blocks):  # fmt: skip
        self._carry, self._blocks = step.params["carry"], blocks
        wanted = [i < self._carry or (x in read and x not in tape)
                  for i, x in enumerate(step.outs)]  # fmt: skip
        self.step = without_dead_of_loop(step, wanted)
        self._function = Function(before, self.step, varying, [True] * len(self.step.outs), lanes,
                                  "trials", blocks=True)  # fmt: skip
        self.kept = [Value((blocks.count, *x.shape), x.dtype)
                     for x in self.step.outs[: self._carry]]  # fmt: skip
        self.each, self.work = self._function.each(), self._function.text.work
        self.shown = [*self.kept, *self.step.outs[self._carry :]]
        self._read = read

    @cached_property
    def name(self) -> str:
        of, blocks = self._function, self._blocks
        operands, results = len(self.step.ins) + len(of.constants), len(self.step.outs)
        text = _Driver(blocks)
        given, out = text.pointers("%given", operands), text.pointers("%out", results)
        text.begin()
        for i in range(self._carry):
            n = self.step.params["consts"] + i
            given[n], out[i] = text.carried(given[n], out[i], of.bytes_of(i))
        text.call("trials", given, out, "%work")
        sizes = [of.bytes_of(i) * (blocks.count if i < self._carry else 1) for i in range(results)]
        return target(callable_by_xla(f"{module([of.text])}\n{text.ended()}", operands, sizes,
                                      self.work, blocks.trials))  # fmt: skip

    def __call__(self, known: ByValue, groups: int) -> ByValue:
        of = self._function
        like = [of.like(i, groups, *[self._blocks.count] * (i < self._carry))
                for i in range(len(self.step.outs))]  # fmt: skip
        found = self._called(of.operands(known, groups), like)
        last = [x[:, -1] if i < self._carry else x for i, x in enumerate(found)]
        results = {x: of.turned_back(i, last[i]) for i, x in enumerate(self.step.outs)
                   if x in self._read}  # fmt: skip
        return results | dict(zip(self.kept, found, strict=False))


class Back(Loop):
    """The way back of a gradient in blocks, each of which is run once more.

    there: the way there
    step: the way back
    tape: by the number of an operand of it, the result of the way there
    """

    def __init__(self, before: list[Step], there: Step, kept: list[Value], step: Step,
                 varying: set[Value], lanes: int, tape: Mapping[int, Value],
                 blocks: Blocks):  # fmt: skip
        self.step, self._tape, self._kept, self._blocks = step, tape, kept, blocks
        of_tape, carry = {*tape.values()}, there.params["carry"]
        again = without_dead_of_loop(there, [i < carry or x in of_tape
                                             for i, x in enumerate(there.outs)])  # fmt: skip
        self._carry = carry, step.params["carry"]
        written = [i >= carry for i in range(len(again.outs))]
        self._again = Function(before, again, varying, written, lanes, "again", blocks=True)
        self._back = Function(before, step, varying | of_tape | {step.ins[i] for i in tape},
                              [True] * len(step.outs), lanes, "back", blocks=True)  # fmt: skip
        self._places, place = {}, 0  # of what is on the tape, in the room for work
        for x in again.outs[carry:]:
            self._places[x] = place
            place += aligned(self._of_trial(x) * blocks.each)
        self._beside = place
        self.work = place + max(self._again.text.work, self._back.text.work)
        self.each = [*self._again.each(), *self._back.each(tape), *kept]
        self.shown = [*step.outs]

    def _of_trial(self, x: Value) -> int:
        """The bytes of what a group reads or writes of a value in each trial."""
        return self._back.lanes * size_of(x) // self._blocks.trials

    @cached_property
    def name(self) -> str:
        again, back, blocks = self._again, self._back, self._blocks
        counts = [len(again.step.ins) + len(again.constants), len(self._kept),
                  len(back.step.ins) - len(self._tape) + len(back.constants)]  # fmt: skip
        text = _Driver(blocks, reverse=True)
        every = iter(text.pointers("%given", sum(counts)))
        given = [next(every) for _ in range(counts[0])]
        kept = [next(every) for _ in self._kept]
        ways = ["null" if i in self._tape else next(every) for i in range(len(back.step.ins))]
        ways = [*ways, *every]
        out = text.pointers("%out", len(back.step.outs))
        work = text.place("%work", self._beside)
        text.begin()
        there, carry = self._carry
        for i in range(there):
            n = again.step.params["consts"] + i
            given[n] = text.carried(given[n], kept[i], again.bytes_of(i))[0]
        rows = {
            x: text.rows("%work", place, self._of_trial(x)) for x, place in self._places.items()
        }
        text.call("again", given, ["null"] * there + [*rows.values()], work)
        for i in range(carry):
            n = back.step.params["consts"] + i
            ways[n] = text.first(ways[n], out[i])
        for i, x in self._tape.items():
            ways[i] = rows[x]
        text.call("back", ways, out, work)
        sizes = [back.bytes_of(i) for i in range(len(out))]
        functions = module([again.text, back.text])
        return target(callable_by_xla(f"{functions}\n{text.ended()}", sum(counts), sizes,
                                      self.work, blocks.trials))  # fmt: skip

    def __call__(self, known: ByValue, groups: int) -> ByValue:
        of = self._back
        operands = [*self._again.operands(known, groups), *(known[x] for x in self._kept),
                    *of.operands(known, groups, self._tape)]  # fmt: skip
        found = self._called(operands, [of.like(i, groups) for i in range(len(self.shown))])
        return {x: of.turned_back(i, found[i]) for i, x in enumerate(self.shown)}


class _Driver(Lines):
    """The text of the function that calls others for each block of trials of a group.

    reverse: whether it begins with the last block
    """

    def __init__(self, blocks: Blocks, *, reverse: bool = False):
        super().__init__("d")
        self._blocks, self._reverse = blocks, reverse
        self.lines = [f"define void @run({OPERANDS}) #0 {{", "entry:"]

    def begin(self) -> None:
        """Begin the loop over the blocks."""
        count, each, trials = self._blocks.count, self._blocks.each, self._blocks.trials
        first, last, step = (count - 1, -1, -1) if self._reverse else (0, count, 1)
        self._block, self._end = self.loop(str(first), str(last), step)
        self._begins = self.times(self._block, each)
        whole = self.add(f"add i64 {self._begins}, {each}")
        more = self.add(f"icmp slt i64 {whole}, {trials}")
        self._ends = self.add(f"select i1 {more}, i64 {whole}, i64 {trials}")
        self._trial = self.times("%first", trials, self._begins)
        self._is_first = self.add(f"icmp eq i64 {self._block}, {first}")

    def carried(self, given: str, out: str, size: int) -> tuple[str, str]:
        """What is carried into a block, and where it is carried to; in the call for a group.

        given: before the first block;  out: after all blocks (groups, blocks);  size: bytes
        """
        now = self.times("%first", self._blocks.count - 1, self._block)
        after = self.place(out, self.times(now, size))
        before = self.place(after, -size)
        is_zero = self.add(f"icmp eq i64 {self._block}, 0")
        return self.add(f"select i1 {is_zero}, ptr {given}, ptr {before}"), after

    def first(self, given: str, out: str) -> str:
        """What is carried into a block where the same place holds it between all blocks."""
        return self.add(f"select i1 {self._is_first}, ptr {given}, ptr {out}")

    def rows(self, base: str, offset: int, size: int) -> str:
        """Rows of a block, by the number of the trial among those of all groups."""
        return self.place(base, self.times(self._trial, -size, offset))

    def call(self, name: str, given: Sequence[str], out: Sequence[str], work: str) -> None:
        for kind, values in (("given", given), ("out", out)):
            for i, x in enumerate(values):
                self.do(f"store ptr {x}, ptr {self.place(f'%{name}{kind}', 8 * i)}")
            self.lines.insert(2, f"  %{name}{kind} = alloca ptr, i64 {max(1, len(values))}")
        self.do(f"call void @{name}(i64 %first, i64 %last, ptr %{name}given, "
                f"ptr %{name}out, ptr {work}, i64 {self._begins}, i64 {self._ends})")  # fmt: skip

    def ended(self) -> str:
        return "\n".join([*self.lines, *self._end, "  ret void", "}"])


# The operands
# --------------------------------------------------------------------------------------------------


def _fixed(before: Sequence[Step], step: Step) -> list[np.ndarray | None]:
    """The values of operands of the loop over trials that depend on no argument; else None."""

    def values() -> list[Known | None]:
        known: dict[Value, Known] = {}
        by_jax(before, known)
        found = [x.array if isinstance(x, Const) else known.get(x) for x in step.ins]
        few = (x is not None and (x.size <= FEW or x.dtype.kind in "biu") for x in found)
        return [x if b else None for x, b in zip(found, few, strict=True)]

    return [x if x is None else np.asarray(x) for x in jax.jit(values)()]


def real() -> np.dtype:
    """The floating point type, as the precision is now."""
    return np.dtype(jnp.result_type(float))


def size_of(x: Value) -> int:
    """The bytes of an array of one machine."""
    return math.prod(x.shape) * np.dtype(x.dtype).itemsize


def _turned(x: jax.Array, at: int, to: int) -> jax.Array:
    return x if at == to else jnp.moveaxis(x, at, to)
