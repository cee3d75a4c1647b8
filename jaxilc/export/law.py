"""What is exported: three functions of a law, traced from the scheme, and the fields they work on.

    begin     the state before the first sample of a trial
    sample    a measured output -> the input of this sample
    end       the last output of the trial -> what is known after it, and what is played next

These are `Scheme.initial_state`, `Scheme.act` with the actuator, and `Scheme.learn` with
`Scheme.schedule`, inside the guard. No scheme is written again for the export.
"""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import compress
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import ArrayLike, DTypeLike

from ..learning.machine import Actuator, Machine
from ..learning.over_trials import check_length
from ..learning.playback import unit_of
from ..learning.within_trial import first_start, run_and_measure
from ..native.program import Program, Step, read, without_dead
from ..pytree.aliases import Array, Leaf, Tree
from ..pytree.named_paths import named_leaves
from ..pytree.ranges import require
from ..schemes import Scheme
from ..schemes.scheme import with_all_parts
from ..signals.task import Sample, Task, Trial
from . import guard
from .interpreter import interpret
from .steps import program_and_result, program_of


class Within(NamedTuple):
    """What is known within a trial.

    scheme: state of the scheme
    v: state of the actuator [unit of u]
    u: the last input as it was applied [unit of u]
    y: the last finite output, before the first one the reference at its start [unit of y]
    """

    scheme: Tree
    v: Array
    u: Array
    y: Array


class Record(NamedTuple):
    """The record of the trial that runs.

    y: (N+1, n_y) output as the law saw it [unit of y]
    u: (N, n_u) input as it was applied [unit of u]
    signals: signals of the scheme that its learning reads, each with N rows
    """

    y: Array
    u: Array
    signals: dict[str, Array]


class Known(NamedTuple):
    """All that a law keeps in RAM.

    memory: what was learned
    schedule: what is played in this trial
    good: memory, schedule and `seen.learned` of the last trial that was not refused
    within, record: of the trial that runs
    seen: what the guard remembers
    """

    memory: Tree
    schedule: Tree
    good: tuple[Tree, Tree, Array]
    within: Within
    record: Record
    seen: guard.Seen


class Field(NamedTuple):
    """An array that a law keeps.

    first: its value before the first trial
    unit: its unit, empty where it has none
    """

    first: np.ndarray
    unit: str


@dataclasses.dataclass(frozen=True)
class Function:
    """A function of a law.

    name: begin, sample or end
    ins, outs: names of its operands and results: fields, or `k`, `y`, `u` and `code`
    """

    name: str
    program: Program
    ins: tuple[str, ...]
    outs: tuple[str, ...]

    def call(self, given: Mapping[str, Leaf], real: DTypeLike = np.float64) -> dict[str, Leaf]:
        """The results by name, as the interpreter finds them; `real` is the type of numbers."""
        found = interpret(self.program, [given[name] for name in self.ins], real)
        return dict(zip(self.outs, found, strict=True))

    def in_place(self) -> dict[str, Step]:
        """The steps by which a result is its operand with a part replaced, by field."""
        found, program = {}, self.program
        made = {step.outs[0]: step for step in program.steps}
        read = [y for step in program.steps for y in step.ins] + program.outs
        for name, x in zip(self.outs, program.outs, strict=True):
            step = made.get(x)
            if step is None or step.name != "dynamic_update_slice" or name not in self.ins:
                continue
            before = program.ins[self.ins.index(name)]
            if step.ins[0] is before and read.count(before) == read.count(x) == 1:
                found[name] = step
        return found


@dataclasses.dataclass(frozen=True)
class Law:
    """A law as it is exported.

    scheme, task: what it was traced from; the scheme is prepared for the task
    fields: by name, what it keeps
    functions: begin, sample and end
    limit: (n_u,) largest |u| that it plays
    tracer, known: what makes the functions, and all that is kept before the first trial
    """

    scheme: Scheme
    task: Task
    fields: Mapping[str, Field]
    functions: Sequence[Function]
    limit: np.ndarray
    tracer: _Tracer
    known: Known

    def codes(self, machine: Machine, trials: int, key: Array) -> np.ndarray:
        """(trials,) the code of each trial that a machine makes with the law, as in `guard.CODES`.

        machine: whose actuator limits the input as the law does
        """
        scheme, task, machine = self.scheme, self.task, machine.sampled(self.task.dt)
        start = first_start(machine, scheme, task, key) if machine.carries else None

        def trial(now: tuple[Known, Tree], j: Array) -> tuple[tuple[Known, Tree], Array]:
            (known, start), drawn = now, jax.random.fold_in(key, j)
            memory = scheme.resumed(known.memory)
            one, _, start = run_and_measure(
                machine, scheme, task, memory, drawn, j, start, measured=False
            )
            known = known._replace(memory=memory)
            known, code = self.tracer.after(known, machine.shown(one, drawn))
            return (known, start), code

        first = self.known, start
        return np.asarray(jax.jit(partial(lax.scan, trial))(first, 1 + jnp.arange(trials))[1])

    def played(self, real: DTypeLike = np.float64) -> Played:
        """The law as the interpreter plays it, before its first trial."""
        return Played(self, real)


def law_of(
    scheme: Scheme,
    task: Task,
    limit: ArrayLike,
    *,
    actuator: Actuator | None = None,
    correction: float | None = None,
    memory: Tree = None,
    trials: guard.Trials | None = None,
    guarded: bool = True,
) -> Law:
    """The law of a scheme, fresh or in the state that a campaign has reached.

    limit: () or (n_u,) largest |u| that is played, finite and above 0 [unit of u]
    correction: largest distance of a learned reference from the task's [unit of y]
    memory: what was learned; None: nothing yet
    trials: what the guard knows of the trials in which it was learned
    Raises ValueError where limit, scheme and task do not fit, and Unknown for what cannot be
    exported.
    """
    check_length(task, scheme)
    scheme.check(task)
    require("law_of", "limit", limit, "(0, inf)", many=True)
    limit = np.broadcast_to(np.asarray(limit, float), (task.inputs,))
    ready = scheme.prepared(task)
    tracer = _Tracer(ready, task, jnp.asarray(limit), actuator, correction, guarded)
    known = tracer.first(memory)
    if trials is not None:
        known = known._replace(seen=guard.begun_by(trials, known.seen))
    signals = _signals_that_are_read(tracer, known)
    known = known._replace(record=known.record._replace(signals=signals))
    fields = {
        name: Field(np.asarray(value), _unit(name, task))
        for name, value in named_leaves(known).items()
    }
    k, y = jnp.int32(0), jnp.zeros(task.outputs)
    functions = [
        _function("begin", tracer.begin, known, {}),
        _function("sample", tracer.sample, known, {"k": k, "y": y}),
        _function("end", tracer.end, known, {"y": y}),
    ]
    return Law(ready, task, fields, functions, limit, tracer, known)


def _function(
    name: str,
    function: Callable[..., tuple[Known, dict[str, Array]]],
    known: Known,
    given: dict[str, Array],
) -> Function:
    """A function of what is known, with only the operands that it reads and what it changes."""
    program, result = program_and_result(function, known, *given.values())
    ins = [*named_leaves(known), *given]
    outs = [*named_leaves(result[0]), *result[1]]
    at_first = dict(zip(program.ins, ins, strict=True))
    changed = [at_first.get(x) != to and 0 not in x.shape
               for x, to in zip(program.outs, outs, strict=True)]  # fmt: skip
    kept = without_dead(program, changed)
    live = read(kept)
    kept = Program([*compress(kept.ins, live)], kept.steps, kept.outs)
    return Function(name, kept, (*compress(ins, live),), (*compress(outs, changed),))


class _Tracer(NamedTuple):
    """The functions of a law, to be traced."""

    scheme: Scheme
    task: Task
    limit: Array
    actuator: Actuator | None
    correction: float | None
    guarded: bool

    def first(self, memory: Tree) -> Known:
        scheme, task = self.scheme, self.task
        memory = scheme.initial_memory(task) if memory is None else memory
        schedule = scheme.schedule(memory, task)
        within = self.at_rest()
        signals = {name: jnp.zeros((task.N, *jnp.shape(x)))
                   for name, x in scheme.signals(within.scheme).items()}  # fmt: skip
        record = Record(jnp.zeros((task.N + 1, task.outputs)), jnp.zeros((task.N, task.inputs)),
                        signals)  # fmt: skip
        seen = guard.nothing_seen(scheme, task, schedule)
        good = (memory, schedule, seen.learned)
        known = Known(memory, schedule, good, within, record, seen)
        return jax.tree.map(jnp.asarray, known)

    def at_rest(self) -> Within:
        rest = jnp.zeros(self.task.inputs)
        y = jnp.asarray(self.task.reference)[0]
        return Within(self.scheme.initial_state(self.task), rest, rest, y)

    def begin(self, known: Known) -> tuple[Known, dict[str, Array]]:
        seen = known.seen._replace(fine=jnp.asarray(True))
        return known._replace(within=self.at_rest(), seen=seen), {}

    def sample(self, known: Known, k: Array, y: Array) -> tuple[Known, dict[str, Array]]:
        scheme, r, (state, v, u_last, y_last) = self.scheme, self.task.reference, known.within
        measured, fine = guard.output(y, y_last) if self.guarded else (y, jnp.asarray(True))
        future = jnp.pad(jnp.asarray(r)[1:], ((0, scheme.preview - 1), (0, 0)), mode="edge")
        ahead = _rows(future, k, scheme.preview)
        row = jax.tree.map(lambda rows: _rows(rows, k, 1)[0], known.schedule)
        seen = Sample(_rows(jnp.asarray(r), k, 1)[0], ahead, measured, row, self.task.dt,
                      u_last if self.actuator is not None else None)  # fmt: skip
        state, u = scheme.act(state, seen)
        if self.actuator is not None:
            v, u = self.actuator.apply(u, v, self.task.dt)
        if self.guarded:
            u, finite = guard.applied(u, u_last, self.limit)
            v, fine = jnp.where(jnp.isfinite(v), v, u), fine & finite
        signals = scheme.signals(state)
        record = jax.tree.map(
            lambda rows, now: lax.dynamic_update_slice_in_dim(
                rows, jnp.reshape(now, (1, *rows.shape[1:])), k, 0, allow_negative_indices=False
            ),
            known.record,
            Record(measured, u, {name: signals[name] for name in known.record.signals}),
        )
        remembered = known.seen._replace(fine=known.seen.fine & fine)
        within = Within(state, v, u, measured)
        return known._replace(within=within, record=record, seen=remembered), {"u": u}

    def end(self, known: Known, y: Array) -> tuple[Known, dict[str, Array]]:
        task, seen = self.task, known.seen
        measured, fine = guard.output(y, known.within.y) if self.guarded else (y, seen.fine)
        rows = jnp.concatenate([known.record.y[:-1], measured[None]])
        record = known.record
        trial = Trial(jnp.asarray(task.reference), rows, record.u, task.dt, record.signals)
        known, code = self.after(known._replace(seen=seen._replace(fine=seen.fine & fine)), trial)
        return known, {"code": code}

    def after(self, known: Known, trial: Trial) -> tuple[Known, Array]:
        """What is known after a trial, and its code."""
        scheme, task, seen = self.scheme, self.task, known.seen
        learned = scheme.learn(known.memory, trial)
        schedule = scheme.schedule(learned, task)
        new = (learned, schedule, seen.learned + 1)
        now = (known.memory, known.schedule, seen.learned)
        if not self.guarded:
            return known._replace(memory=learned, schedule=schedule), jnp.int32(0)
        code, seen = guard.of_trial(scheme, task, seen, known.schedule, trial, self.limit)
        inside = guard.of_next(scheme, task, seen, learned, schedule, self.limit, self.correction)
        good = code == 0
        code = jnp.where(good & ~inside, 4, code).astype(jnp.int32)

        def chosen(new: Array, now: Array, before: Array) -> Array:
            """What follows: what was learned, or what was played, or what was good before that."""
            return jnp.where(good, jnp.where(inside, new, now), before)

        memory, schedule, count = jax.tree.map(chosen, new, now, known.good)
        kept = jax.tree.map(lambda now, before: jnp.where(good, now, before), now, known.good)
        seen = seen._replace(learned=count)
        known = known._replace(memory=memory, schedule=schedule, good=kept, seen=seen)
        return known, code


def _rows(rows: Array, k: Array, count: int) -> Array:
    return lax.dynamic_slice_in_dim(rows, k, count, allow_negative_indices=False)


def _signals_that_are_read(tracer: _Tracer, known: Known) -> dict[str, Array]:
    """The signals of the scheme that its learning needs."""
    if not known.record.signals:
        return {}
    program = program_of(lambda record: tracer.end(known._replace(record=record),
                                                   known.within.y), known.record)  # fmt: skip
    live = dict(zip(named_leaves(known.record), read(program), strict=True))
    return {name: x for name, x in known.record.signals.items() if live[f"signals.{name}"]}


def _unit(name: str, task: Task) -> str:
    last = name.split(".")[-1].split("[")[0]
    if name == "seen.best":
        return task.unit
    return unit_of(last, task) if last in ("r", "y", "u", "v", "reference", "u_last") else ""


def said_of_scheme(scheme: Scheme, task: Task) -> list[tuple[str, str]]:
    """The class of each part of a scheme, and its docstring, which has the equations."""
    found: dict[str, str] = {}
    for part in with_all_parts(scheme, task):
        cls = type(part.scheme)
        found[cls.__name__] = inspect.cleandoc(cls.__doc__ or "")
    return list(found.items())


class Played:
    """A law that the interpreter carries out, operation by operation."""

    def __init__(self, law: Law, real: DTypeLike = np.float64):
        self.law, self.real = law, np.dtype(real)
        self.known = {name: self._real(f.first) for name, f in law.fields.items()}

    def _real(self, given: ArrayLike) -> np.ndarray:
        x = np.asarray(given)
        return x.astype(self.real) if x.dtype.kind == "f" else x

    def call(self, name: str, **given: ArrayLike) -> dict[str, np.ndarray]:
        """Carry out a function; the results that are no fields are returned."""
        function = next(one for one in self.law.functions if one.name == name)
        values = self.known | {key: self._real(value) for key, value in given.items()}
        results = function.call(values, self.real)
        self.known |= {key: results.pop(key) for key in list(results) if key in self.known}
        return results

    def trial(self, y: np.ndarray) -> tuple[np.ndarray, int]:
        """The inputs (N, n_u) that answer the outputs (N+1, n_y) of a trial, and its code."""
        self.call("begin")
        rows = [self.call("sample", k=np.int32(k), y=y[k])["u"] for k in range(len(y) - 1)]
        return np.array(rows), int(self.call("end", y=y[-1])["code"])
