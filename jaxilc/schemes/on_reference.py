"""Learning that corrects the reference of a feedback instead of its output."""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from ..pytree.fields import child, pytree
from ..signals.task import Sample, Task, Trial
from .compose import Pair, need_feedforward, signals_of_part, silent_signals
from .scheme import UNASKED, Part, Scheme, State, under
from .shifts import delay


class ReferenceSchedule(NamedTuple):
    """The rows of a feedback whose reference is learned.

    u: (N, n_y) correction w[k] of the reference r[k+1] [unit of y]
    now: (N, n_y) correction of r[k] [unit of y]
    ahead: (N, preview, n_y) corrections of r[k+1], r[k+2], ... [unit of y]
    feedback: schedule of the feedback
    """

    u: jax.Array
    now: jax.Array
    ahead: jax.Array
    feedback: Any


class ReferenceState(NamedTuple):
    """The state of `OnReference`.

    feedback: state of the feedback
    correction: (n_y,) w[k] [unit of y]
    """

    feedback: State
    correction: jax.Array


@pytree
class OnReference(Scheme):
    """The feedback follows r + w, and w is learned (the series structure of Li 2020, Fig. 1).

    learning: pure feedforward scheme, whose `u` is the correction w; w[k] is added to r[k+1]
    feedback: any scheme
    The signal `correction` of the trial records w. The scheme learns from the error r - y, without
    w.
    `check` raises ValueError for a learning scheme that acts within the trial; `learn` raises it
    for a trial without the signal `correction`.
    """

    learning: Scheme = child()
    feedback: Scheme = child()

    @property
    def preview(self) -> int:
        return self.feedback.preview

    @property
    def trials_a_step(self) -> int:
        return self.learning.trials_a_step

    def parts(self, task: Task, memory: Pair) -> dict[str, Part]:
        corrections = dataclasses.replace(task, inputs=task.outputs)
        return {
            "learning": Part(self.learning, corrections, memory.learning),
            "feedback": Part(self.feedback, task, memory.feedback),
        }

    def shown(self, trial: Trial) -> dict[str, Trial]:
        if "correction" not in trial.signals:
            raise ValueError(
                "OnReference: the trial has no signal 'correction' (N, n_y), so what was learned "
                "cannot be told"
            )
        own = trial._replace(u=trial.signals["correction"], signals={})
        of_feedback = trial._replace(signals=signals_of_part("feedback", trial.signals))
        return {"learning": own, "feedback": of_feedback}

    def check(self, task: Task) -> None:
        super().check(task)
        need_feedforward(self, self.learning, self.parts(task, UNASKED)["learning"].task)
        if not self.learning.plays_back:
            raise ValueError(
                f"OnReference: {type(self.learning).__name__} acts within the trial; allowed are "
                "schemes that play back a learned signal"
            )

    def initial_memory(self, task: Task) -> Pair:
        corrections = self.parts(task, UNASKED)["learning"].task
        return Pair(self.learning.initial_memory(corrections), self.feedback.initial_memory(task))

    def learn(self, memory: Pair, trial: Trial) -> Pair:
        shown = self.shown(trial)
        return Pair(
            self.learning.learn(memory.learning, shown["learning"]),
            self.feedback.learn(memory.feedback, shown["feedback"]),
        )

    def schedule(self, memory: Pair, task: Task) -> ReferenceSchedule:
        learning, corrections, known = self.parts(task, memory)["learning"]
        return self.play(learning.schedule(known, corrections).u, memory, task)

    def play(self, learned, memory: Pair, task: Task) -> ReferenceSchedule:
        w = learned
        held = jnp.pad(w, ((0, self.preview - 1), (0, 0)), mode="edge")
        window = jnp.stack([held[i : i + task.N] for i in range(self.preview)], axis=1)
        feedback = self.feedback.schedule(memory.feedback, task)
        return ReferenceSchedule(w, delay(w, 1), window, feedback)

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
        feedback = self.feedback.signals(state.feedback)
        return {"correction": state.correction} | under("feedback", feedback)

    def played(self, schedule: ReferenceSchedule, task: Task) -> dict[str, jax.Array]:
        """What a machine plays; the feedback follows `reference` (N+1, n_y), not the task's r."""
        reference = jnp.asarray(task.reference).at[1:].add(schedule.u)
        feedback = self.feedback.played(schedule.feedback, task)
        return {"reference": reference} | under("feedback", feedback)

    def record(self, learned, e, task: Task) -> Trial:
        r = jnp.asarray(task.reference)
        return Trial(
            r,
            r - e,
            jnp.zeros((task.N, task.inputs)),
            task.dt,
            silent_signals(self, task) | {"correction": learned},
        )
