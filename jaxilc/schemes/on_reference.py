"""Learning that corrects the reference of a feedback, instead of its output."""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from ..pytree.fields import child, pytree
from ..signals.task import Limit, Sample, Task, Trial
from .compose import Pair, need_feedforward, of_part, signals_of_part, silent_signals
from .scheme import Scheme, State, delay, limits_below


class ReferenceTable(NamedTuple):
    """u: (N, n_y) correction w[k] of the reference r[k+1];  now: (N, n_y) that of r[k];  ahead: (N,
    preview, n_y) those of r[k+1], ...
    feedback: the feedback's own table"""

    u: jax.Array
    now: jax.Array
    ahead: jax.Array
    feedback: Any


class ReferenceState(NamedTuple):
    """The feedback's state;  correction: (n_y,) w[k]"""

    feedback: State
    correction: jax.Array


@pytree
class OnReference(Scheme):
    """The feedback follows r + w, and w is what is learned (the series structure of Li 2020, Fig.
    1).

    learning: pure feedforward, its `u` is the correction w, with w[k] added to r[k+1];  feedback:
    any scheme The signal `correction` of the trial records w. The error is that from r itself.
    """

    learning: Scheme = child()
    feedback: Scheme = child()

    @property
    def preview(self) -> int:
        return self.feedback.preview

    def _task(self, task: Task) -> Task:
        return dataclasses.replace(task, inputs=task.outputs)

    def check(self, task: Task) -> None:
        self.learning.check(self._task(task))
        need_feedforward(self, self.learning, self._task(task))
        if not self.learning.plays_back:
            name = type(self.learning).__name__
            raise ValueError(
                f"OnReference: {name} acts within the trial; allowed are schemes that play back a learned signal"
            )
        self.feedback.check(task)

    def prepared(self, task: Task) -> OnReference:
        return dataclasses.replace(
            self,
            learning=self.learning.prepared(self._task(task)),
            feedback=self.feedback.prepared(task),
        )

    def initial_memory(self, task: Task) -> Pair:
        return Pair(
            self.learning.initial_memory(self._task(task)), self.feedback.initial_memory(task)
        )

    def table(self, memory: Pair, task: Task) -> ReferenceTable:
        return self.play(self.learning.table(memory.learning, self._task(task)).u, memory, task)

    def play(self, learned, memory: Pair, task: Task) -> ReferenceTable:
        w = learned
        held = jnp.pad(w, ((0, self.preview - 1), (0, 0)), mode="edge")
        window = jnp.stack([held[i : i + task.N] for i in range(self.preview)], axis=1)
        return ReferenceTable(w, delay(w, 1), window, self.feedback.table(memory.feedback, task))

    def initial_state(self, task: Task) -> ReferenceState:
        return ReferenceState(self.feedback.initial_state(task), jnp.zeros(task.outputs))

    def act(self, state: ReferenceState, sample: Sample) -> tuple[Any, jax.Array]:
        row = sample.row
        seen = sample._replace(
            r=sample.r + row.now, ahead=sample.ahead + row.ahead, row=row.feedback
        )
        feedback, u = self.feedback.act(state.feedback, seen)
        return ReferenceState(feedback, row.u), u

    def signals(self, state: ReferenceState) -> dict[str, jax.Array]:
        return {"correction": state.correction} | of_part("feedback", self.feedback, state.feedback)

    def learn(self, memory: Pair, trial: Trial) -> Pair:
        own, of_feedback = self._shown(trial)
        return Pair(
            self.learning.learn(memory.learning, own),
            self.feedback.learn(memory.feedback, of_feedback),
        )

    def _shown(self, trial: Trial) -> Pair:
        """The trial as each part learns from it."""
        if "correction" not in trial.signals:
            raise ValueError(
                "OnReference: the trial has no signal 'correction' (N, n_y), so what was learned cannot be told"
            )
        own = trial._replace(u=trial.signals["correction"], signals={})
        return Pair(own, trial._replace(signals=signals_of_part("feedback", trial.signals)))

    @property
    def trials_a_step(self) -> int:
        return self.learning.trials_a_step

    def limits(self, task: Task, memory: Pair, trial: Trial) -> dict[str, Limit]:
        own, of_feedback = self._shown(trial)
        return limits_below(
            "learning", self.learning.limits(self._task(task), memory.learning, own)
        ) | limits_below("feedback", self.feedback.limits(task, memory.feedback, of_feedback))

    def record(self, learned, e, task: Task) -> Trial:
        r = jnp.asarray(task.reference)
        return Trial(
            r,
            r - e,
            jnp.zeros((task.N, task.inputs)),
            task.dt,
            silent_signals(self, task) | {"correction": learned},
        )
