"""Schemes made of schemes."""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import jax

from ..filters import Filter
from ..pytree import part, pytree, static
from ..signals import Sample, Task, Trial
from .scheme import Scheme, State


class Pair(NamedTuple):
    """What the learning and the feedback part keep, and the feedback's last input."""

    learning: Any
    feedback: Any


class PairState(NamedTuple):
    """States of the two parts;  u: (n_u,) what the feedback part contributed last."""

    learning: State
    feedback: State
    u: jax.Array


@pytree
class WithFeedback(Scheme):
    """u = u_learning + u_feedback: learned feedforward over a feedback loop (the parallel structure of Li 2020, eq. 2).

    The learning part is shown the input less the feedback's share, so that it learns its own contribution only; the signal
    `feedback` of the trial records that share.
    """

    learning: Scheme = part()
    feedback: Scheme = part()

    @property
    def preview(self) -> int:
        return max(self.learning.preview, self.feedback.preview)

    def check(self, task: Task) -> None:
        self.learning.check(task)
        self.feedback.check(task)

    def memory(self, task: Task) -> Pair:
        return Pair(self.learning.memory(task), self.feedback.memory(task))

    def table(self, memory: Pair, task: Task) -> Pair:
        return Pair(self.learning.table(memory.learning, task), self.feedback.table(memory.feedback, task))

    def init(self, task: Task) -> PairState:
        return PairState(self.learning.init(task), self.feedback.init(task), jax.numpy.zeros(task.inputs))

    def act(self, state: PairState, sample: Sample):
        learning, u_learning = self.learning.act(state.learning, sample._replace(row=sample.row.learning))
        feedback, u_feedback = self.feedback.act(state.feedback, sample._replace(row=sample.row.feedback))
        return PairState(learning, feedback, u_feedback), u_learning + u_feedback

    def signals(self, state: PairState):
        return self.learning.signals(state.learning) | self.feedback.signals(state.feedback) | {"feedback": state.u}

    def learn(self, memory: Pair, trial: Trial) -> Pair:
        if "feedback" not in trial.signals:
            raise ValueError("WithFeedback: the trial has no signal 'feedback' (N, n_u), so its learned part cannot be told from u")
        own = trial._replace(u=trial.u - trial.signals["feedback"])
        return Pair(self.learning.learn(memory.learning, own), self.feedback.learn(memory.feedback, trial))


@pytree
class Filtered(Scheme):
    """u_{j+1} = Q(u_j + L e_j): a robustness filter on what any learning scheme is about to apply.

    scheme: one whose table has a field `u`;  filter: zero-phase, applied to each channel of `u`
    """

    scheme: Scheme = part()
    filter: Filter = part()

    @property
    def preview(self) -> int:
        return self.scheme.preview

    def check(self, task: Task) -> None:
        self.scheme.check(task)
        self.filter.check(task.N, task.dt)
        if not hasattr(jax.eval_shape(lambda: self.scheme.table(self.scheme.memory(task), task)), "u"):
            raise ValueError(f"Filtered: {type(self.scheme).__name__} learns no feedforward input u that could be filtered")

    def memory(self, task: Task):
        return self.scheme.memory(task)

    def table(self, memory, task: Task):
        table = self.scheme.table(memory, task)
        return table._replace(u=self.filter(table.u, task.dt))

    def init(self, task: Task):
        return self.scheme.init(task)

    def act(self, state, sample: Sample):
        return self.scheme.act(state, sample)

    def signals(self, state):
        return self.scheme.signals(state)

    def learn(self, memory, trial: Trial):
        return self.scheme.learn(memory, trial)


@pytree
class OnOutputs(Scheme):
    """A scheme that sees only some of the outputs: a motor-side loop on a machine that also measures its table.

    scheme: acts on all inputs;  outputs: indices of the outputs it sees
    """

    scheme: Scheme = part()
    outputs: tuple[int, ...] = static()

    @property
    def preview(self) -> int:
        return self.scheme.preview

    def _task(self, task: Task) -> Task:
        return dataclasses.replace(task, reference=task.reference[..., list(self.outputs)])

    def check(self, task: Task) -> None:
        if not self.outputs or not all(0 <= i < task.outputs for i in self.outputs):
            raise ValueError(f"OnOutputs: outputs = {self.outputs} is not a choice among the task's outputs 0..{task.outputs - 1}")
        self.scheme.check(self._task(task))

    def memory(self, task: Task):
        return self.scheme.memory(self._task(task))

    def table(self, memory, task: Task):
        return self.scheme.table(memory, self._task(task))

    def init(self, task: Task):
        return self.scheme.init(self._task(task))

    def act(self, state, sample: Sample):
        seen = list(self.outputs)
        return self.scheme.act(state, sample._replace(r=sample.r[..., seen], ahead=sample.ahead[..., seen], y=sample.y[..., seen]))

    def signals(self, state):
        return self.scheme.signals(state)

    def learn(self, memory, trial: Trial):
        seen = list(self.outputs)
        return self.scheme.learn(memory, trial._replace(r=trial.r[..., seen], y=trial.y[..., seen]))
