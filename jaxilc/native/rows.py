"""The plan of a loop over trials: which loops over samples there are, and what each computes.

An array with an axis of samples is a `Row`: a rule for its elements at a sample, which may be
evaluated in any loop over samples, once for each sample that is asked for. Nothing is stored
between two operations. Stored are the memories from trial to trial, and the results of a scan that
are read later. Everything between two scans is computed in the loop of the first of them, a few
samples behind it where it reads ahead.
"""

from __future__ import annotations

import itertools
import math
import operator
from collections.abc import Callable, Iterable, Sequence
from functools import partial, reduce
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from .operations import (
    GATHERED,
    MOVES,
    RUNNING,
    TO_PLACES,
    Array,
    At,
    AtIndex,
    Buffer,
    Cell,
    Given,
    Node,
    Numbers,
    Sample,
    applied,
    at_places,
    check_size,
    constants,
    counted,
    known,
    neutral,
    numbered,
    places_of,
)
from .program import Const, Program, Step, Unknown, Value, loops, lowered

MOST_NODES = 60_000  # of all loops; a compiler takes seconds for so many
LATELY = 3  # samples back to which what a scan found stays in registers
FEW_RUNS = 4  # of a constant condition, at whose ends a loop over samples is divided
TAKES = {"div": 13, "sqrt": 20}  # cycles until a result is there
USUALLY = 4
EARLY = 0.45  # of the longest chain of a sample, what is computed a sample early
MOST_EARLY = 40  # numbers of it, more of which would cost more to hand on than the wait
FEW_SAMPLES = 100  # for which a loop over samples is not printed in two forms
RUNS = 18  # into which samples that are gathered may fall apart
MOST = {"concatenate": math.inf, "scatter": 2 * RUNS}  # a sample that is set parts what it is among


class Row:
    """An array with an axis of samples.

    shape, axis, dtype: its shape, which of its axes is that of the samples, and its type
    loop: the first loop in which it can be evaluated
    fresh: the last loop whose scan it reads; -1 for none
    """

    loop: int

    def __init__(self, shape: Sequence[int], axis: int, dtype: np.dtype, *rows: Item):
        self.shape, self.axis, self.dtype = tuple(shape), axis, np.dtype(dtype)
        self.loop = max([0, *(loop_of(x) for x in rows)])
        self.fresh: int = max([-1, *(x.fresh for x in rows if isinstance(x, Row))])

    @property
    def length(self) -> int:
        return self.shape[self.axis]

    @property
    def of_one(self) -> tuple[int, ...]:
        """The shape of one row."""
        return _with(self.shape, self.axis, 1)


class Stored(Row):
    """Rows of a buffer."""

    def __init__(self, shape: Sequence[int], axis: int, buffer: Buffer):
        super().__init__(shape, axis, buffer.dtype)
        self.buffer = buffer


class Count(Row):
    """The number of the sample."""


class Taken(Row):
    """Some rows of others: row k is row sign k + first of those.

    In the reverse order, with sign -1, those of a scan are there when its loop has ended.
    """

    def __init__(self, row: Row, first: int, length: int, sign: int = 1):
        super().__init__(_with(row.shape, row.axis, length), row.axis, row.dtype, row)
        self.row, self.first, self.sign = row, first, sign
        if sign < 0:
            self.loop = max(self.loop, row.fresh + 1)


class Part(NamedTuple):
    """Some rows among others, from a sample on."""

    first: int
    length: int
    rows: Row


class Joined(Row):
    """Rows one after another."""

    def __init__(self, shape: Sequence[int], axis: int, dtype: np.dtype, parts: list[Part]):
        super().__init__(shape, axis, dtype, *(part.rows for part in parts))
        self.parts = parts


class Computed(Row):
    """A function of the elements of rows at the same sample, and of small arrays."""

    def __init__(self, shape: Sequence[int], axis: int, dtype: np.dtype,
                 function: Callable[..., Array], operands: Sequence[Item]):  # fmt: skip
        super().__init__(shape, axis, dtype, *operands)
        self.function, self.operands = function, operands


class Result(Row):
    """The results of a scan.

    kept: where they are kept for those who read them later, once somebody does
    """

    def __init__(self, shape: Sequence[int], dtype: np.dtype, scan: Scan, number: int):
        super().__init__(shape, 0, dtype)
        self.scan, self.number, self.loop, self.fresh = scan, number, scan.loop, scan.loop
        self.kept: Buffer | None = None


def rows_of(x: Item) -> Row:
    """The rows; raises Unknown for a small array in their place."""
    if not isinstance(x, Row):
        raise Unknown("a small array where rows are expected")
    return x


def small(x: Item) -> Array:
    """The small array; raises Unknown for rows in its place."""
    if isinstance(x, Row):
        raise Unknown("rows where a small array is expected")
    return x


def loop_of(x: Item) -> int:
    """The loop before which, or in which, a row or an array is known."""
    return x.loop if isinstance(x, Row) else max([0, *(node.loop for node in x.flat)])


Item: TypeAlias = Row | Array  # an array with an axis of samples, or a small one


class Scan:
    """A scan over samples; a sum over all samples is one that only carries.

    loop: the number of the loop that it belongs to
    offset: the sample of it that is computed at sample k of the loop is k + offset
    consts: what it reads whole at each sample: small arrays, and tables
    begun: what it carries into its first sample
    rows: what it reads row by row
    cells: by their number among the carried, arrays of nodes that samples change
    """

    def __init__(self, step: Step, operands: list[Item], loop: int):
        self.body, self.length, self.loop, self.offset = step.body, step.length, loop, 0
        self.consts, self.begun, rows = step.apart(operands)
        self.rows = [*map(rows_of, rows)]
        self.cells: dict[int, Array] = {}
        self.results: list[Result] = []

    def carried(self, row: Result) -> int | None:
        """Which of the carried numbers a result is, too; None if it is none of them."""
        outs = self.body.outs
        return next((i for i in self.cells if outs[i] is outs[row.number]), None)

    def begin(self, i: int) -> Array:
        """What it carries into its first sample."""
        return small(self.begun[i])

    def unchanged(self, i: int) -> bool:
        """Whether each sample carries on what it was given."""
        return self.body.outs[i] is self.body.ins[len(self.consts) + i]


class Sink:
    """Rows that are written to a buffer."""

    def __init__(self, row: Row, buffer: Buffer):
        self.rows: list[Row] = [row]
        self.buffer, self.offset, self.length = buffer, 0, row.length


class Segment(NamedTuple):
    """A range of samples at which a loop computes the same.

    first, last: the samples from which and before which it runs, in either direction
    stores: buffer, offset, and the elements that are written there
    cells: pairs of nodes: a cell, and what is then in it
    results: the elements of results of scans, by scan and number, with the offset
    """

    first: int
    last: int
    stores: list[tuple[Buffer, int, Array]]
    cells: list[tuple[Node, Node]]
    results: list[tuple[Result, int, Array]]

    @property
    def wanted(self) -> list[Node]:
        """The nodes that it stores, carries, or has as results."""
        arrays = (x for *_, x in (*self.stores, *self.results))
        return [*(x for array in arrays for x in array.flat), *(x for _, x in self.cells)]


class Loop:
    """A loop over samples.

    direction: 1 forward, -1 backward, 0 for either
    """

    def __init__(self) -> None:
        self.direction = 0
        self.scans: list[Scan] = []
        self.sinks: list[Sink] = []
        self.segments: list[Segment] = []

    @property
    def items(self) -> list[Scan | Sink]:
        return [*self.scans, *self.sinks]


class Trials:
    """The plan of a loop over trials.

    step: the loop, lowered
    alike: whether each of its operands is the same for all machines
    fixed: the values of operands that are the same whenever it runs; None for the others
    real: the floating point type
    Raises Unknown for what cannot be compiled.
    """

    def __init__(self, step: Step, alike: Sequence[bool], fixed: Sequence[np.ndarray | None],
                 real: np.dtype):  # fmt: skip
        self.n, self.alike = Numbers(real), alike
        self.body, self.fixed = step.body, fixed
        self.trials, self.reverse = step.length, step.params["reverse"]
        self.consts, self.carry = step.params["consts"], step.params["carry"]
        lengths = [of.length for of in loops(self.body)]
        if not lengths:
            raise Unknown("there is no loop over samples whose results are read")
        self.shortest = -(-3 * min(lengths) // 4)
        self.loops: list[Loop] = []
        self.picks: dict[int, list[Node]] = {}  # by the loop before which they are read
        self.given: list[np.ndarray] = []  # constants with rows, further operands of the program
        self.buffers: list[Buffer] = []
        self.reads: list[tuple[Buffer, int, int, int]] = []  # with loop, sign and offset
        self._cells = itertools.count(1)
        self._known: dict[Value, Item] = {}
        self._tables: dict[tuple[Node, ...], Row] = {}
        self._plan()

    # The arrays
    # ----------------------------------------------------------------------------------------------

    def axis_of(self, shape: Sequence[int]) -> int | None:
        """Which axis of an array is that of the samples; None where it has none."""
        long = [i for i, n in enumerate(shape) if n >= self.shortest]
        if len(long) > 1:
            raise Unknown(f"an array of the shape {tuple(shape)}, with two axes of samples")
        return long[0] if long else None

    def _buffer(self, kind: str, shape: Sequence[int], axis: int, dtype: np.dtype, *,
                number: int | None = None, alike: bool = False,
                by_trial: bool = False) -> Buffer:  # fmt: skip
        width = math.prod(shape) // shape[axis]
        number = len(self.body.ins) + len(self.buffers) if number is None else number
        buffer = Buffer(kind, number, shape[axis], width, np.dtype(dtype), alike, by_trial)
        self.buffers.append(buffer)
        return buffer

    def new_cells(self, shape: Sequence[int], dtype: np.dtype, *, loop: int) -> Array:
        """An array of new cells, which are known before a loop."""
        return numbered(shape, lambda _: self.n.place("cell", dtype, Cell(next(self._cells)),
                                                      loop=loop, alike=False))  # fmt: skip

    def value(self, x: Value) -> Item:
        """The rows or the small array of a value."""
        if not isinstance(x, Const):
            return self._known[x]
        if x not in self._known:
            axis = self.axis_of(x.shape)
            if axis is None or not math.prod(x.shape):
                self._known[x] = self.n.array(np.asarray(x.array))
            else:
                self._known[x] = self._constant_rows(np.asarray(x.array), axis)
        return self._known[x]

    def _constant_rows(self, array: np.ndarray, axis: int) -> Row:
        """The rows of an array of constants; where it has few runs of equal rows, those."""
        rows = np.moveaxis(array, axis, 0).reshape(array.shape[axis], -1)
        ends = [0, *(np.flatnonzero((rows[1:] != rows[:-1]).any(axis=1)) + 1), len(rows)]
        if len(ends) - 1 > (FEW_RUNS if array.dtype.kind == "b" else 1):
            return self._given(array, axis)
        return _joined([
            Computed(_with(array.shape, axis, b - a), axis, array.dtype, lambda x: x,
                     [self.n.array(array.take([a], axis))])
            for a, b in itertools.pairwise(ends)
        ])  # fmt: skip

    def _given(self, array: np.ndarray, axis: int) -> Row:
        """The rows of an array of constants, which becomes a further operand of the program."""
        self.given.append(np.moveaxis(array, axis, 0))
        number = len(self.body.ins) + len(self.given) - 1
        return Stored(array.shape, axis, self._buffer("given", array.shape, axis, array.dtype,
                                                      alike=True, number=number))  # fmt: skip

    def _operand(self, i: int, x: Value) -> Item:
        """The rows or the small array of an operand of the loop over trials."""
        if jnp.issubdtype(x.dtype, jax.dtypes.extended):
            raise Unknown("random numbers that depend on what is learned")
        axis, carried = self.axis_of(x.shape), self.consts <= i < self.consts + self.carry
        fixed = self.fixed[i]
        by_trial = i >= self.consts + self.carry
        if axis is not None:
            if fixed is not None and not (carried or by_trial) and x.dtype.kind in "biu":
                return self._constant_rows(fixed, axis)
            kind = "carried" if carried else "given"
            alike = self.alike[i] and not carried
            return Stored(x.shape, axis, self._buffer(kind, x.shape, axis, x.dtype, number=i,
                                                      alike=alike, by_trial=by_trial))  # fmt: skip
        if carried:
            return self.new_cells(x.shape, x.dtype, loop=0)
        if fixed is not None and not by_trial:
            return self.n.array(fixed)
        if math.prod(x.shape) > 4096:
            raise Unknown(f"an operand of the shape {x.shape}")
        kind, alike = "by_trial" if by_trial else "input", self.alike[i]
        return numbered(x.shape, lambda m: self.n.place(kind, x.dtype, Given(i, m), alike=alike))

    def moved(self, i: int, *, out: bool = False) -> tuple[int, int]:
        """From which axis that of the samples of an operand, or of a result, moves where in RAM."""
        x = (self.outs if out else self.ins)[i]
        by_trial = i >= (0 if out else self.consts) + self.carry
        return (x.axis if isinstance(x, Row) else 0) + by_trial, int(by_trial)

    # The steps
    # ----------------------------------------------------------------------------------------------

    def _plan(self) -> None:
        self.ins = [self._operand(i, x) for i, x in enumerate(self.body.ins)]
        self._known |= zip(self.body.ins, self.ins, strict=True)
        for step in self.body.steps:
            self._step(step)
        self.outs = [self.value(x) for x in self.body.outs]
        for i, (x, out) in enumerate(zip(self.outs, self.body.outs, strict=True)):
            self._out(i, x, out)
        for number, loop in enumerate(self.loops):
            if loop.items:
                loop.direction = loop.direction or 1
                _Build(self, number, loop).run()

    def _out(self, i: int, x: Item, out: Value) -> None:
        """A row among the results is written; one that is carried, if it is another than before."""
        if not isinstance(x, Row):
            return
        if i >= self.carry:
            buffer = self._buffer("out", x.shape, x.axis, x.dtype, number=i, by_trial=True)
        else:
            before = self.ins[self.consts + i]
            if not isinstance(before, Stored) or before.axis != x.axis:
                raise Unknown("a memory whose axis of samples changes")
            if x is before:
                return
            buffer = before.buffer
        self._sink(x, buffer)

    def _sink(self, row: Row, buffer: Buffer) -> None:
        self.loop(row.loop).sinks.append(Sink(row, buffer))

    def loop(self, number: int) -> Loop:
        while len(self.loops) <= number:
            self.loops.append(Loop())
        return self.loops[number]

    def _step(self, step: Step) -> None:
        if step.name == "scan":
            return self._scan(step, [self.value(x) for x in step.ins])
        if len(step.outs) != 1:
            raise Unknown(step.name)
        self._known[step.outs[0]] = self._result(step, [self.value(x) for x in step.ins])
        return None

    def _result(self, step: Step, operands: list[Item]) -> Item:
        out, rows = step.outs[0], [x for x in operands if isinstance(x, Row)]
        axis = self.axis_of(out.shape)
        if not math.prod(out.shape) and axis is None:
            return np.empty(out.shape, object)
        if not rows:
            return self._from_small(step, [*map(small, operands)], axis)
        if step.name not in HANDLED and not known(step.name):
            raise Unknown(step.name)
        if step.name in HANDLED and (found := HANDLED[step.name](self, step, operands)) is not None:
            return found
        if axis is None or any(x.length != out.shape[axis] for x in rows):
            raise Unknown(f"{step.name} of samples")
        # Each sample stays where it is: no other axis of an array of rows is as long as theirs.
        of_rows = [isinstance(x, Row) for x in operands]
        numbers = [x for x in operands if not isinstance(x, Row)]
        apart = step.name in TO_PLACES and of_rows != [True, False, True][: len(operands)]
        if apart or any(self.axis_of(x.shape) is not None for x in numbers):
            raise Unknown(f"{step.name} that moves the axis of samples")
        if step.name == "gather":
            sizes = {"slice_sizes": _with(step.params["slice_sizes"], rows[0].axis, 1)}
            step = Step("gather", step.params | sizes, step.ins, step.outs, lax.gather_p)
        shape = _with(out.shape, axis, 1)
        return Computed(out.shape, axis, out.dtype,
                        lambda *arrays: applied(self.n, step, arrays, shape), operands)  # fmt: skip

    def _from_small(self, step: Step, operands: list[Array], axis: int | None) -> Item:
        if axis is None:
            return applied(self.n, step, operands)
        out = step.outs[0]
        if step.name in MADE:
            return _moves(self, step, [*operands])
        if step.name != "iota":
            raise Unknown(f"{step.name} that makes samples")
        if step.params["dimension"] != axis:
            raise Unknown("iota beside samples")
        return Count(out.shape, axis, out.dtype)

    def whole_numbers(self, x: Item) -> np.ndarray | None:
        """The whole numbers of an array or of rows; None where they are not known beforehand."""
        if not isinstance(x, Row):
            return constants(x, int)
        found: list[np.ndarray] = []
        for i in range(x.length):
            one = constants(_Picked(self, save=False).row(x, 0, i), int)
            if one is None:
                return None
            found.append(one)
        return np.concatenate(found, x.axis)

    def picked(self, buffer: Buffer, row: Row, i: int, loop: int) -> Array:
        nodes = numbered(row.of_one, lambda m: self.n.place(
            "pick", buffer.dtype, At(buffer, 0, i, m), loop=loop, alike=buffer.alike
        ))  # fmt: skip
        picks = self.picks.setdefault(loop, [])
        picks += [node for node in nodes.flat if node not in picks]
        return nodes

    def kept(self, row: Result) -> Buffer:
        """Where the results of a scan are kept."""
        if row.kept is None:
            row.kept = self._buffer("kept", row.shape, row.axis, row.dtype)
        return row.kept

    def _scan(self, step: Step, operands: list[Item], *, either: bool = False) -> None:
        """Add a scan to the first loop that can hold it; `either` if it may run backward, too."""
        whole, begun, rows = step.apart(operands)
        if any(isinstance(x, Row) for x in begun):
            raise Unknown("rows that are carried from sample to sample")
        for i, x in enumerate(whole):
            if isinstance(x, Row) and not (isinstance(x, Stored) and x.axis == 0):
                whole[i] = self.table_of(x)
        operands = [*whole, *begun, *rows]
        number = max([0, *map(loop_of, operands)])
        if not either:
            direction = -1 if step.params["reverse"] else 1
            while self.loop(number).direction not in (0, direction):
                number += 1
            self.loop(number).direction = direction
        scan = Scan(step, operands, number)
        self.loop(number).scans.append(scan)
        last, each = step.results_apart(step.outs)
        for i, out in enumerate(last):
            if scan.unchanged(i):
                self._known[out] = scan.begin(i)
            else:
                self._known[out] = scan.cells[i] = self.new_cells(
                    out.shape, out.dtype, loop=number + 1
                )
        for i, out in enumerate(each, len(last)):
            scan.results.append(Result(out.shape, out.dtype, scan, i))
            self._known[out] = scan.results[-1]

    def table(self, operands: Sequence[Array]) -> Item:
        """A small array as rows, where it is known before all trials and the place is not."""
        array, *places = operands
        if array.ndim != 1 or constants(places[0], int) is not None:
            return array
        first, key = array[0], tuple(array)
        i = first.what.operand if first.name == "input" else 0
        if key not in self._tables:
            values = constants(array, first.dtype)
            if values is not None:
                self._tables[key] = self._given(values, 0)
            elif [x.what for x in array] == [Given(i, m) for m in range(len(array))]:
                buffer = self._buffer("given", array.shape, 0, first.dtype, alike=first.alike,
                                      number=i)  # fmt: skip
                self._tables[key] = Stored(array.shape, 0, buffer)
        return self._tables.get(key, array)

    def table_of(self, row: Row) -> Stored:
        """The rows in a buffer of their own, for the loops after the one that computes them."""
        buffer = self._buffer("kept", row.shape, row.axis, row.dtype)
        self._sink(row, buffer)
        table = Stored(row.shape, row.axis, buffer)
        table.loop = row.loop + 1
        return table


# Steps that move numbers among the rows
# --------------------------------------------------------------------------------------------------


def _with(values: Sequence[int], at: int, value: int) -> tuple[int, ...]:
    return (*values[:at], value, *values[at + 1 :])


def _joined(rows: Sequence[Row]) -> Row:
    """Rows one after another."""
    if len(rows) == 1:
        return rows[0]
    firsts = itertools.accumulate((x.length for x in rows), initial=0)
    parts = [Part(first, x.length, x) for first, x in zip(firsts, rows, strict=False)]
    shape = _with(rows[0].shape, rows[0].axis, sum(x.length for x in rows))
    return Joined(shape, rows[0].axis, rows[0].dtype, parts)


def _moved(of: Trials, step: Step, operands: Sequence[Item]) -> Item | None:
    """The result of a step that only moves numbers; None where places are not known beforehand.

    The numbers of the elements, counted through all operands, are moved in their place.
    """
    out, name = step.outs[0], step.name
    found = [of.whole_numbers(x) for x in operands[TO_PLACES.get(name, slice(0))]]
    places = [x for x in found if x is not None]
    if len(places) < len(found):
        return None
    if name == "scatter-add":
        return _added(of, step, operands, places[0])
    firsts = itertools.accumulate((math.prod(x.shape) for x in operands), initial=0)
    numbers = [first + np.arange(math.prod(x.shape)).reshape(x.shape)
               for first, x in zip(firsts, operands, strict=False)]  # fmt: skip
    source = (MOVES[name](step.params, numbers, out.shape) if name in MOVES
              else at_places(step, numbers, places, out.shape))  # fmt: skip
    return _from_elements(of, step, operands, source, MOST.get(name, RUNS))


def _added(of: Trials, step: Step, operands: Sequence[Item], places: np.ndarray) -> Item:
    """The rows to which others are added, each time to other elements."""
    (row, _, new), out = operands, step.outs[0]
    found = places_of(step, out.shape, places, new.shape).ravel()
    zero, added = of.n.array(np.zeros((), out.dtype)), [rows_of(row)]
    left = np.flatnonzero(found >= 0)
    while left.size:
        first = np.unique(found[left], return_index=True)[1]
        source = np.zeros(out.shape, int)
        source.flat[found[left[first]]] = 1 + left[first]
        added.append(rows_of(_from_elements(of, step, [zero, new], source, MOST["scatter"])))
        left = np.delete(left, first)
        if len(added) > RUNS:
            raise Unknown("samples in so many parts")
    return Computed(out.shape, added[0].axis, out.dtype,
                    lambda *x: reduce(of.n.elements("add"), x), added)  # fmt: skip


def _from_elements(of: Trials, step: Step, operands: Sequence[Item], source: np.ndarray,
                   most: float = RUNS) -> Item:  # fmt: skip
    """The result of a step, of elements of the operands by numbers counted through all of these.

    most: parts into which its samples may fall apart, in each of which all come from as far away,
        or from a small array
    """
    out, axis = step.outs[0], of.axis_of(step.outs[0].shape)
    labels = np.concatenate([_labels(i, x) for i, x in enumerate(operands)], axis=1)
    wide = [x for x in operands if isinstance(x, Row) and of.axis_of(x.of_one) is not None]
    if wide and axis is not None:  # of as many channels as there are samples
        samples = np.moveaxis(labels[1][source], axis, 0)
        axis = None if np.all(samples == samples[0]) else axis
    if axis is None:
        check_size(step, out.shape)
    along, shape = axis or 0, out.shape if axis is not None else (1, *out.shape)
    at = np.moveaxis(source.reshape(shape), along, 0).reshape(shape[along], -1)
    owner, sample, place = labels[:, at]
    moving, k = sample >= 0, np.arange(len(at))[:, None]
    turns = np.diff(sample, axis=0)[moving[1:] & moving[:-1]]
    sign = -1 if turns.size and np.all(turns == -1) else 1
    away = np.where(moving, sample - sign * k, 0)
    turned = np.any(np.diff([owner, away, place], axis=1), axis=2)
    ends = [0, *(np.flatnonzero(turned.any(axis=0)) + 1), len(at)]
    if np.count_nonzero(turned[:2].any(axis=0)) >= most:
        raise Unknown("samples in so many parts")

    def part(first: int, last: int) -> Row:
        pairs, which = np.unique([owner[first], away[first]], axis=1, return_inverse=True)
        given = [_some(operands[i], by + sign * first, last - first, sign) for i, by in pairs.T]
        widths = [math.prod(x.of_one if isinstance(x, Row) else x.shape) for x in given]
        index = np.cumsum([0, *widths])[which] + place[first]
        rows, of_part = given[0] if len(given) == 1 else None, _with(shape, along, last - first)
        if isinstance(rows, Row) and rows.shape == of_part and rows.axis == along and (
            np.array_equal(index, np.arange(widths[0]))
        ):  # fmt: skip
            return rows
        return Computed(of_part, along, out.dtype, partial(_chosen, index), given)

    found = _joined([part(a, b) for a, b in itertools.pairwise(ends)])
    return found if axis is not None else _Picked(of).row(found, 0, 0).reshape(out.shape)


def _labels(i: int, x: Item) -> np.ndarray:
    """(3, size) of each element: which operand, which of its samples or -1, which number there."""
    one = x.of_one if isinstance(x, Row) else x.shape
    sample = counted({"dimension": x.axis}, x.shape) if isinstance(x, Row) else np.full(one, -1)
    place = np.broadcast_to(np.arange(math.prod(one)).reshape(one), x.shape)
    return np.stack([np.full(x.shape, i), sample, place]).reshape(3, -1)


def _some(x: Item, first: int, length: int, sign: int) -> Item:
    """Some samples of rows, see `Taken`; a small array as it is."""
    if not isinstance(x, Row) or (first, length, sign) == (0, x.length, 1):
        return x
    return Taken(x, int(first), int(length), sign)


def _chosen(index: np.ndarray, *arrays: Array) -> Array:
    """The elements of arrays by their numbers, counted through all of these."""
    return np.concatenate([np.empty(0, object), *(x.ravel() for x in arrays)])[index]


def _moves(of: Trials, step: Step, operands: list[Item]) -> Item:
    found = _moved(of, step, operands)
    if found is None:
        raise Unknown(f"{step.name} of samples that are found while it runs")
    return found


def _scatter(of: Trials, step: Step, operands: list[Item]) -> Item | None:
    """Rows of which some are replaced, or have others added; None for places in each row."""
    axis, to = of.axis_of(step.outs[0].shape), step.params["dimension_numbers"]
    if axis in to.scatter_dims_to_operand_dims or isinstance(operands[1], Row):
        return _moves(of, step, [rows_of(operands[0]), *operands[1:]])
    return _moved(of, step, operands)


def _gather_rows(of: Trials, step: Step, operands: list[Item]) -> Item | None:
    """Samples at other places; None for what is gathered at each sample."""
    row, index = operands
    kept, out = step.params["dimension_numbers"], step.outs[0]
    if not isinstance(row, Row):
        return None
    if (found := _moved(of, step, operands)) is not None:
        return found
    if row.axis not in kept.start_index_map:
        return None
    axis = of.axis_of(out.shape)
    if kept.start_index_map != (row.axis,):
        raise Unknown("gather of samples and channels")
    if row.axis not in kept.collapsed_slice_dims:  # one window
        raise Unknown("gather of this kind of samples")
    read = _rows_at(of, step, row)
    if axis is None:
        picked = np.concatenate(read(small(index)), row.axis)
        new = np.arange(picked.shape[row.axis], dtype=step.ins[1].dtype).reshape(index.shape)
        return applied(of.n, step, [picked, of.n.array(new)])
    batch = [i for i in range(len(out.shape)) if i not in kept.offset_dims]
    if batch != [row.axis] or out.shape != _with(row.shape, row.axis, index.shape[0]):
        raise Unknown("gather that moves the axis of samples")
    rows = Computed(out.shape, axis, out.dtype, lambda i: read(i)[0], [index])
    rows.loop = max(rows.loop, row.loop + 1)
    return rows


def _rows_at(of: Trials, step: Step, row: Row) -> Callable[[Array], list[Array]]:
    """What reads rows at places that are found while the program runs."""
    table, n = of.table_of(row), of.n
    beyond = step.params["mode"] == lax.GatherScatterMode.FILL_OR_DROP
    if beyond and (step.params["fill_value"] is not None or row.dtype.kind != "f"):
        raise Unknown("gather beyond the end")

    def at(place: Node) -> Array:
        inside = n.clipped(place, row.length - 1)

        def number(m: int) -> Node:
            x = n.row(inside, row.dtype, AtIndex(table.buffer, m, table.loop))
            if not beyond:
                return x
            return n.of("select", n.of("eq", inside, place), n.const(np.nan, row.dtype), x)

        return numbered(row.of_one, number)

    return lambda places: [at(place) for place in places.flat]


def _gather(of: Trials, step: Step, operands: list[Item]) -> Item | None:
    """Rows put together to one, where the samples are among the axes of a reduction."""
    inside = rows_of(operands[0]).axis in step.params["axes"]
    return _gathered(of, step, GATHERED[step.name], operands) if inside else None


def _gathered(of: Trials, step: Step, name: str, operands: list[Item]) -> Array:
    """The results of a step for each sample, put together by an operation."""
    row, out = next(x for x in operands if isinstance(x, Row)), step.outs[0]

    def of_row(*arrays: Array) -> Array:
        return applied(of.n, step, arrays, out.shape).reshape(1, *out.shape)

    one = Computed((row.length, *out.shape), 0, out.dtype, of_row, operands)
    begin = np.full(out.shape, of.n.const(neutral(name, out.dtype), out.dtype), object)
    sum_, x, more = (Value(out.shape, out.dtype) for _ in range(3))
    body = Program([sum_, x], [Step(name, {}, [sum_, x], [more])], [more])
    params = {"length": row.length, "reverse": False, "body": body, "consts": 0, "carry": 1}
    of._scan(Step("scan", params, [], [out]), [begin, one], either=True)
    return small(of.value(out))


def _by_jax(of: Trials, function: Callable[..., jax.Array], *operands: Item) -> Item:
    """The result of a function of JAX on rows and small arrays."""
    like = [jax.ShapeDtypeStruct(x.shape, x.dtype if isinstance(x, Row) else x.flat[0].dtype)
            for x in operands]  # fmt: skip
    program = lowered(jax.make_jaxpr(function)(*like))
    of._known |= zip(program.ins, operands, strict=True)
    for step in program.steps:
        of._step(step)
    return of.value(program.outs[0])


def _running(of: Trials, step: Step, operands: list[Item]) -> Item | None:
    """A running sum, product, maximum or minimum along the samples, as a scan."""
    row, name = rows_of(operands[0]), RUNNING[step.name]
    if step.params["axis"] != row.axis:
        return None
    if row.axis != 0:
        raise Unknown(f"{step.name} along samples that are not the first axis")

    def tick(before: jax.Array, x: jax.Array) -> tuple[jax.Array, jax.Array]:
        after = getattr(lax, name)(before, x)
        return after, after

    begin = jnp.full(row.shape[1:], neutral(name, row.dtype), row.dtype)
    return _by_jax(of, lambda x: lax.scan(tick, begin, x, reverse=step.params["reverse"])[1], row)


def _place_of_best(of: Trials, step: Step, operands: list[Item]) -> Item | None:
    """The first sample with the largest or smallest number, or with one that is not a number."""
    row, (axis,), out = rows_of(operands[0]), step.params["axes"], step.outs[0]
    if axis != row.axis:
        raise Unknown(f"{step.name} at each sample")
    if axis != 0:
        raise Unknown(f"{step.name} along samples that are not the first axis")
    if row.dtype.kind not in "fb":
        raise Unknown(f"{step.name} of {row.dtype}")
    largest, shape = step.name == "argmax", row.shape[1:]
    begin = neutral("max" if largest else "min", row.dtype)

    def tick(
        before: tuple[jax.Array, jax.Array], now: tuple[jax.Array, jax.Array]
    ) -> tuple[tuple[jax.Array, jax.Array], None]:
        (best, at), (x, k) = before, now
        beyond = x > best if largest else x < best
        new = beyond | ((x != x) & (best == best))
        return (jnp.where(new, x, best), jnp.where(new, k, at)), None

    def place(rows: jax.Array) -> jax.Array:
        first = jnp.full(shape, begin, row.dtype), jnp.zeros(shape, out.dtype)
        return lax.scan(tick, first, (rows, jnp.arange(row.length, dtype=out.dtype)))[0][1]

    return _by_jax(of, place, row)


def _dot(of: Trials, step: Step, operands: list[Item]) -> Item | None:
    """A product that is summed over the samples; None for one that is not."""
    contracted = step.params["dimension_numbers"][0]
    rows = [(x, i) for i, x in enumerate(operands) if isinstance(x, Row)]
    summed = [x.axis in contracted[i] for x, i in rows]
    if not any(summed):
        return None
    if len(rows) != 2 or not all(summed) or (
        contracted[0].index(rows[0][0].axis) != contracted[1].index(rows[1][0].axis)
    ):  # fmt: skip
        raise Unknown("dot_general of samples and something else")
    if of.axis_of(step.outs[0].shape) is not None:
        raise Unknown("dot_general over samples, for each sample")
    return _gathered(of, step, "add", operands)


def _convolved(of: Trials, step: Step, operands: list[Item]) -> Item | None:
    """A filter with a few taps along the samples; or the slopes of its taps, a sum over samples."""
    row, kernel = operands
    params, numbers = step.params, step.params["dimension_numbers"]
    out, to = step.outs[0], numbers.out_spec
    ones = (*params["window_strides"], *params["lhs_dilation"], *params["rhs_dilation"],
            params["batch_group_count"], params["feature_group_count"])  # fmt: skip
    slopes = isinstance(kernel, Row)
    if set(ones) != {1} or len(to) != 3 or not isinstance(row, Row):
        raise Unknown("conv_general_dilated of this kind")

    def summed(x: jax.Array, taps: jax.Array) -> jax.Array:
        x, taps = x.transpose(numbers.lhs_spec), taps.transpose(numbers.rhs_spec)
        x = lax.pad(x, jnp.zeros((), x.dtype), [(0, 0, 0), (0, 0, 0), (*params["padding"][0], 0)])
        few, many = sorted((taps.shape[2], out.shape[to[2]]))
        shifted = [x[:, :, i : i + many] for i in range(few)]
        if slopes:
            each = [jnp.tensordot(part, taps, ((1, 2), (1, 2))) for part in shifted]
            return jnp.stack(each, axis=-1).transpose(np.argsort(to))
        each = [jnp.tensordot(part, taps[:, :, i], (1, 1)) for i, part in enumerate(shifted)]
        return reduce(jnp.add, each).transpose(0, 2, 1).transpose(np.argsort(to))

    return _by_jax(of, summed, row, kernel)


MADE = ("concatenate", "pad", "broadcast_in_dim")  # of which small arrays make rows, too
HANDLED: dict[str, Callable[[Trials, Step, list[Item]], Item | None]] = {
    **dict.fromkeys((*MOVES, "dynamic_slice", "dynamic_update_slice"), _moves),
    **dict.fromkeys(("scatter", "scatter-add"), _scatter),
    "gather": _gather_rows,
    "argmax": _place_of_best,
    "argmin": _place_of_best,
    "dot_general": _dot,
    "conv_general_dilated": _convolved,
    **dict.fromkeys(GATHERED, _gather),
    **dict.fromkeys(RUNNING, _running),
}


# The segments of a loop
# --------------------------------------------------------------------------------------------------


class _Build:
    """What builds the segments of a loop from its scans and sinks."""

    def __init__(self, of: Trials, number: int, loop: Loop):
        self.of, self.n, self.number, self.loop = of, of.n, number, loop
        self.direction = loop.direction
        self.reached: dict[Row, dict[Scan, int]] = {}
        self.lately: dict[Result, list[Array]] = {}

    def run(self) -> None:
        d, loop = self.direction, self.loop
        for item in loop.items:
            read = (x for row in item.rows for x in self._reach(row).items())
            item.offset = d * min([0, *(d * scan.offset - c for scan, c in read)])
        cuts: set[int] = set()
        for item in loop.items:
            cuts |= {-item.offset, item.length - item.offset}
            for row in item.rows:
                self._cuts(row, 1, item.offset, cuts, set())
        low = min(-item.offset for item in loop.items)
        high = max(item.length - item.offset for item in loop.items)
        ends = sorted(c for c in cuts if low <= c <= high)
        pairs = list(itertools.pairwise(ends))
        for first, last in pairs if d > 0 else pairs[::-1]:
            loop.segments.append(self._segment(first, last))
        for segment in loop.segments:
            self._pass_on(segment)

    def before(self, row: Result, back: int) -> Array:
        """The cells with the results of a scan of this loop that many samples before."""
        carried = row.scan.carried(row)
        own = [] if carried is None else [row.scan.cells[carried]]  # which the scan itself fills
        cells = self.lately.setdefault(row, own)
        while len(cells) < back:
            cells.append(self.of.new_cells(row.of_one, row.dtype, loop=self.number + 1))
        return cells[back - 1]

    def _pass_on(self, segment: Segment) -> None:
        """Let the cells of `before` hold what the next sample sees there."""
        here = {row: x for row, _, x in segment.results}
        for row, cells in self.lately.items():
            if row in here and row.scan.carried(row) is None:
                segment.cells.extend(zip(cells[0].flat, here[row].flat, strict=True))
            for newer, older in itertools.pairwise(cells):
                inside = _inside_loop(self.n, newer)
                segment.cells.extend(zip(older.flat, inside.flat, strict=True))

    def _reach(self, row: Row) -> dict[Scan, int]:
        """How far a row reads ahead of itself in the results of each scan of this loop."""
        if row not in self.reached:
            found: dict[Scan, int] = {}
            for inner, _, by in _inner(row):
                for scan, c in self._reach(inner).items():
                    ahead = c + self.direction * by
                    found[scan] = max(found.get(scan, ahead), ahead)
            if isinstance(row, Result) and row.scan.loop == self.number:
                found[row.scan] = 0
            if found and isinstance(row, Taken) and row.sign < 0:
                raise Unknown("a scan that is read in both directions at once")
            self.reached[row] = found
        return self.reached[row]

    def _cuts(self, row: Row, sign: int, c: int, cuts: set[int],
              seen: set[tuple[Row, int, int]]) -> None:  # fmt: skip
        """Add the samples k at which row sign k + c begins to be computed in another way."""
        if (row, sign, c) in seen:
            return
        seen.add((row, sign, c))
        if isinstance(row, Joined):
            for first, length, _ in row.parts:
                cuts.update(p - c if sign > 0 else c - p + 1 for p in (first, first + length))
        for inner, turned, by in _inner(row):
            self._cuts(inner, sign * turned, c * turned + by, cuts, seen)

    def _segment(self, first: int, last: int) -> Segment:
        stores: list[tuple[Buffer, int, Array]] = []
        cells: list[tuple[Node, Node]] = []
        at = _At(self, first, last)
        for scan in self.loop.scans:
            if at.active(scan):
                outs = at.run(scan)
                for i, old in scan.cells.items():
                    cells += zip(old.flat, outs[i].flat, strict=True)
        for sink in self.loop.sinks:
            if at.active(sink):
                stores.append((sink.buffer, sink.offset, at.row(sink.rows[0], 1, sink.offset)))
        results = [
            (result, scan.offset, at.done[scan][result.number])
            for scan in self.loop.scans if scan in at.done for result in scan.results
        ]  # fmt: skip
        if len(self.n._known) > MOST_NODES:
            raise Unknown("a trial of so many operations")
        return Segment(first, last, stores, cells, results)


def _inner(row: Row) -> list[tuple[Row, int, int]]:
    """The rows that a row reads, each with a sign and a number: row sign k + number at sample k."""
    if isinstance(row, Taken):
        return [(row.row, row.sign, row.first)]
    if isinstance(row, Joined):
        return [(part, 1, -first) for first, _, part in row.parts]
    if isinstance(row, Computed):
        return [(x, 1, 0) for x in row.operands if isinstance(x, Row)]
    return []


class _Rows:
    """What evaluates rows at the samples from `first` to before `last`."""

    def __init__(self, first: int, last: int):
        self.first, self.last = first, last
        self.rows: dict[tuple[Row, int, int], Array] = {}

    def row(self, row: Row, sign: int, c: int) -> Array:
        """The elements of row sign k + c, at sample k."""
        key = row, sign, c
        if key not in self.rows:
            self.rows[key] = self._row(row, sign, c).reshape(row.of_one)
        return self.rows[key]

    def _row(self, row: Row, sign: int, c: int) -> Array:
        if isinstance(row, Taken):
            return self.row(row.row, sign * row.sign, c * row.sign + row.first)
        if isinstance(row, Joined):
            ends = sign * self.first + c, sign * (self.last - 1) + c  # which one part holds
            part = next(x for x in row.parts if x.first <= min(ends) < x.first + x.length)
            assert max(ends) < part.first + part.length
            return self.row(part.rows, sign, c - part.first)
        if isinstance(row, Computed):
            return row.function(*(self.row(x, sign, c) if isinstance(x, Row) else x
                                  for x in row.operands))  # fmt: skip
        return self.read(row, sign, c)

    def read(self, row: Row, sign: int, c: int) -> Array:
        """The elements of stored rows, of the results of a scan, or the number of the sample."""
        raise NotImplementedError


class _Picked(_Rows):
    """What evaluates rows at a sample that is known beforehand; its sign is 0.

    save: whether what it reads is needed
    """

    def __init__(self, of: Trials, *, save: bool = True):
        super().__init__(0, 1)
        self.of, self.save = of, save

    def read(self, row: Row, sign: int, c: int) -> Array:
        if isinstance(row, Stored):
            given = row.buffer.number - len(self.of.body.ins)
            if row.buffer.kind == "given" and given >= 0:
                return self.of.n.array(self.of.given[given][c].reshape(row.of_one))
            return self._picked(row.buffer if self.save else None, row, c, 0)
        if isinstance(row, Count):
            return np.full(row.of_one, self.of.n.const(c, row.dtype), object)
        assert isinstance(row, Result)
        return self._picked(self.of.kept(row) if self.save else None, row, c, row.scan.loop + 1)

    def _picked(self, buffer: Buffer | None, row: Row, c: int, loop: int) -> Array:
        if buffer is not None:
            return self.of.picked(buffer, row, c, loop)
        nothing = self.of.n.place("nothing", row.dtype, None)
        return np.full(row.of_one, nothing, object)


def _inside_loop(n: Numbers, cells: Array) -> Array:
    """The nodes of cells within the loop that changes them."""
    return n.each(lambda x: n.place("now", x.dtype, x.what, varies=True, alike=False), cells)


class _At(_Rows):
    """What evaluates rows at the samples of a segment."""

    def __init__(self, of: _Build, first: int, last: int):
        super().__init__(first, last)
        self.of, self.n = of, of.n
        self.done: dict[Scan, list[Array]] = {}

    def active(self, item: Scan | Sink) -> bool:
        return self.first + item.offset >= 0 and self.last + item.offset <= item.length

    def read(self, row: Row, sign: int, c: int) -> Array:
        if isinstance(row, Stored):
            return self._load(row.buffer, row, sign, c)
        if isinstance(row, Count):
            index = self.n.place("index", row.dtype, Sample(sign, c), varies=True)
            return np.full(row.of_one, index, object)
        assert isinstance(row, Result)
        scan = row.scan
        if scan.loop == self.of.number:
            assert sign == 1
            if c == scan.offset and self.active(scan):
                return self.run(scan)[row.number]
            back = self.of.direction * (scan.offset - c)
            assert back > 0
            if back <= LATELY:
                return _inside_loop(self.n, self.of.before(row, back))
        return self._load(self.of.of.kept(row), row, sign, c)

    def _load(self, buffer: Buffer, row: Row, sign: int, c: int) -> Array:
        self.of.of.reads.append((buffer, self.of.number, sign, c))
        return numbered(row.of_one, lambda m: self.n.place(
            "load", buffer.dtype, At(buffer, sign, c, m), varies=True, alike=buffer.alike
        ))  # fmt: skip

    def run(self, scan: Scan) -> list[Array]:
        """The results of one sample of a scan."""
        if scan in self.done:
            return self.done[scan]
        body = scan.body
        given = [
            *scan.consts,
            *(_inside_loop(self.n, scan.cells[i]) if i in scan.cells else x
              for i, x in enumerate(scan.begun)),
            *(self.row(x, 1, scan.offset).reshape(x.shape[1:]) for x in scan.rows),
        ]  # fmt: skip
        known: dict[Value, Item] = dict(zip(body.ins, given, strict=True))

        def value(x: Value) -> Item:
            return self.n.array(np.asarray(x.array)) if isinstance(x, Const) else known[x]

        for step in body.steps:
            operands = [value(x) for x in step.ins]
            if step.name == "dynamic_slice" and not isinstance(operands[0], Row):
                operands[0] = self.of.of.table([*map(small, operands)])
            if any(isinstance(x, Row) for x in operands):
                known[step.outs[0]] = self._read(step, operands)
            elif len(step.outs) == 1:
                known[step.outs[0]] = applied(self.n, step, [*map(small, operands)])
            else:
                raise Unknown(step.name)
        self.done[scan] = [small(value(x)) for x in body.outs]
        return self.done[scan]

    def _read(self, step: Step, operands: list[Item]) -> Array:
        """Rows of a table that a scan reads at a sample that is found while it runs."""
        table = operands[0]
        if step.name != "dynamic_slice" or not isinstance(table, Stored):
            raise Unknown(f"{step.name} of all samples within a sample")
        sizes, shape = step.params["slice_sizes"], table.shape
        if tuple(sizes[1:]) != tuple(shape[1:]):
            raise Unknown("dynamic_slice of some channels")
        self.of.of.reads.append((table.buffer, self.of.number, 0, 0))
        index = self.n.clipped(small(operands[1]).item(), shape[0] - sizes[0])
        return numbered(sizes, lambda m: self.n.row(
            index, table.dtype, AtIndex(table.buffer, m, table.loop)
        ))  # fmt: skip


# What a sample hands on
# --------------------------------------------------------------------------------------------------


class Handed(NamedTuple):
    """A number that each sample of a loop hands on to the next one, which would compute it again.

    cell: in which it is handed on
    node: what a sample would compute
    ahead: what the sample before computes, which is the same
    """

    cell: Node
    node: Node
    ahead: Node


def handed_on(of: Trials, segment: Segment, wanted: Sequence[Node], d: int) -> list[Handed]:
    """What the samples of a segment hand on.

    A law that reads the increments du[k] and du[k-1] asks for the same number twice: du[k-1] is
    what the sample before has computed as du[k]. So the nodes of a sample are compared with those
    of the sample before, and what both compute is carried in a cell.
    What is only read is read again, since that takes no longer, and products are computed again,
    since they are a part of a sum that is rounded once.

    wanted: the nodes that the segment needs
    d: 1 if it runs forward, -1 if backward
    """
    n, new = of.n, {cell.what: x for cell, x in segment.cells}
    moved: dict[Node, Node | None] = {}  # each node, as the sample before calls it
    for node in in_turn(wanted):
        if not node.varies:
            moved[node] = node
        elif isinstance(node.what, At):
            first = node.what.first + d * node.what.sign
            moved[node] = n.known(node, (), node.what._replace(first=first))
        elif isinstance(node.what, Cell):
            moved[node] = new.get(node.what)
        else:
            args = [x for x in map(moved.get, node.args) if x is not None]
            whole = len(args) == len(node.args) > 0
            moved[node] = n.known(node, args, node.what) if whole else None
    handed = {x: y for x, y in moved.items() if y is not None and y in moved
              and x.varies and x.args and not is_product(x)}  # fmt: skip
    found = reached(wanted, lambda x: [handed[x]] if x in handed else x.args)
    return [Handed(of.new_cells((1,), x.dtype, loop=0).item(), x, handed[x])
            for x in found if x in handed]  # fmt: skip


def begun_early(of: Trials, stores: Sequence[tuple[Buffer, int, Array]], wanted: Sequence[Node],
                handed: Sequence[Handed], d: int) -> list[tuple[Node, Node]]:  # fmt: skip
    """What a sample computes for the next one, each with the cell in which it is handed on.

    A division waits for another one, and a processor looks only some hundred operations ahead. So
    the first part of a sample that depends on no sample before is computed one sample early, while
    the rest of the sample before waits. CFDL-MFAILC took 0.9 of the time, and the slopes of
    FFDL-MFAILC, of which 18 numbers are handed on, 0.91 to 0.97.

    stores: what the loop writes;  wanted: the nodes that it needs
    handed: what is handed on from sample to sample;  d: 1 if it runs forward, -1 if backward
    """
    ahead = {x.node: x.ahead for x in handed}

    def known(x: Node) -> bool:
        """Whether it can be read a sample early."""
        if not isinstance(x.what, At):
            return not isinstance(x.what, Cell | AtIndex)
        offsets = [offset for buffer, offset, _ in stores if buffer == x.what.buffer]
        return not offsets or (x.what.sign == 1 and d * x.what.first >= max(d * y for y in offsets))

    free, time = dict[Node, bool](), dict[Node, int]()
    for x in in_turn(wanted):
        free[x] = not x.varies or (known(x) and all(free[y] for y in x.args))
        waits = x.varies and x not in ahead and len(x.args) > 0
        time[x] = max(time[y] for y in x.args) + TAKES.get(x.name, USUALLY) if waits else 0
    last = EARLY * max(time.values(), default=0)

    def is_early(x: Node) -> bool:
        alone = x not in ahead and not is_product(x)  # which a sum is rounded with
        return alone and free[x] and 2 * USUALLY <= time[x] <= last

    found = reached(wanted, lambda x: () if x in ahead or is_early(x) else x.args)
    early = dict.fromkeys(filter(is_early, found))
    if TAKES.keys().isdisjoint(x.name for x in reached(early)):
        return []
    for x in reached(early, lambda x: () if x in ahead else [ahead.get(y, y) for y in x.args]):
        handed_to = [] if x in ahead else [ahead[y] for y in x.args if y in ahead]
        early |= dict.fromkeys(y for y in handed_to if y not in ahead)
    if len(early) > MOST_EARLY:
        return []
    return [(of.new_cells((1,), x.dtype, loop=0).item(), x) for x in early]


def without_choices(of: Trials, segment: Segment) -> tuple[list[Node], Segment]:
    """The conditions of choices that are the same at each sample, and the segment without them.

    Where no machine of a group meets any of them, as none has passed a level yet, the rest computes
    the same with fewer operations. A choice is one of two numbers, of which the other is only read:
    a product would become a part of a sum that is rounded once, and a machine would have other
    digits beside some machines than beside others. Or it is one of constants, times a share that is
    zero for all machines, in a sum: the slope of a largest error, on which nothing depends while no
    error is too large. Elsewhere the sign of this zero could count.
    """
    if segment.last - segment.first < FEW_SAMPLES:
        return [], segment
    n, conditions = of.n, dict[Node, None]()
    nodes = in_turn(segment.wanted)
    elsewhere = {*segment.wanted}.union(*(x.args for x in nodes if x.name not in ("add", "sub")))

    def put(node: Node, args: list[Node]) -> Node | None:
        if node.name == "select" and not node.args[0].varies and isinstance(args[1].what, At):
            conditions[node.args[0]] = None
            return args[1]
        if node.name != "mul" or node in elsewhere:
            return None
        for choice, share in (node.args, node.args[::-1]):
            if not share.varies and choice.varies and _of_constants(choice):
                nothing = n.const(0, node.dtype)
                conditions[n.of("ne", share, nothing)] = None
                return nothing
        return None

    rest = _rewritten(of, segment, put)  # which finds the conditions
    return [*conditions], rest


def _of_constants(node: Node) -> bool:
    """Whether a node is a choice among finite numbers that are known beforehand."""
    if node.name == "const":
        return node.dtype.kind == "f" and bool(np.isfinite(node.value))
    return node.name == "select" and all(map(_of_constants, node.args[1:]))


def _rewritten(of: Trials, segment: Segment,
               put: Callable[[Node, list[Node]], Node | None]) -> Segment:  # fmt: skip
    """The segment with other nodes in the place of some.

    put: what stands for a node, whose operands are given as they are now; None for the same
        operation on these
    """
    n, new = of.n, dict[Node, Node]()
    for node in in_turn(segment.wanted):
        args = [new[x] for x in node.args]
        found = put(node, args)
        if found is None and not all(map(operator.is_, args, node.args)):
            found = n.again(node, args)
        new[node] = found or node
    putting = partial(n.each, new.__getitem__)
    return segment._replace(
        stores=[(buffer, offset, putting(x)) for buffer, offset, x in segment.stores],
        results=[(result, offset, putting(x)) for result, offset, x in segment.results],
        cells=[(cell, new[x]) for cell, x in segment.cells],
    )


def is_product(node: Node) -> bool:
    """Whether it is a product of real numbers, which is rounded with a sum that reads it."""
    return node.name == "mul" and node.dtype.kind == "f"


def reached(
    nodes: Iterable[Node], onward: Callable[[Node], Iterable[Node]] = lambda node: node.args
) -> list[Node]:
    """Nodes and all that are reached from them.

    onward: those that are reached from one; without it, what it is computed from
    """
    found: dict[Node, None] = {}
    todo = [*nodes]
    while todo:
        node = todo.pop()
        if node not in found:
            found[node] = None
            todo += onward(node)
    return [*found]


def in_turn(
    nodes: Iterable[Node], known: Callable[[Node], bool] = lambda node: False
) -> list[Node]:
    """Nodes and all that they are computed from, operands first, but for those that are known."""
    found: dict[Node, None] = {}
    todo = [node for node in nodes if not known(node)]
    while todo:
        node = todo[-1]
        missing = [x for x in node.args if x not in found and not known(x)]
        if missing and node not in found:
            todo += missing
        else:
            found[todo.pop()] = None
    return [*found]
