"""Multivariable learning of control and reference for a drive with a motor and a table side."""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from ..filters.zero_phase import Filter
from ..pytree.fields import child, pytree, static
from ..signals.task import Limit, Sample, Task, Trial
from .compose import Pair, signals_of_part, silent_signals
from .on_reference import ReferenceSchedule
from .scheme import UNASKED, Part, Scheme, State, limits_of_parts, under
from .shifts import delay


class LearnedState(NamedTuple):
    """The state of MILC within a trial.

    feedback: state of the feedback
    u: (n_u,) contribution of the feedback to the input [unit of u]
    reference: (1,) r[k+1], the learned reference that the feedback follows [unit of y]
    """

    feedback: State
    u: jax.Array
    reference: jax.Array


@pytree
class MultivariableILC(Scheme):
    """MILC learns the input u and the reference r of the position loop (MILC 2024, eq. 23 to 29).

        v = u_j + C_P (r_j - y_M),   errors (r_j - y_M, r_d - y_T),   start r_0 = r_d / P_Z, u_0 = 0

    v is the whole input, y_M and y_T are the positions of motor and table. Learning from the error
    of the table alone cannot reduce the error of the motor and that of the table together
    (Proposition 1 there): the feedback, whose aim is y_M = r_d, acts against the learned input.
    Here the reference of the feedback is learned too.

    learning: scheme with two inputs (u, r) and two outputs, usually `NormOptimal` with
        `plants.multivariable_model`; it must play back what it learned. As printed, its second
        input is the whole reference and not a correction.
    feedback: scheme that makes the motor follow the learned reference
    prefilter: filter 1 / P_Z on the reference; None: r_0 = r_d
    motor_output: index of the motor's position among the outputs of the task
    table_output: index of the table's position among the outputs of the task

    The reference of the sample k = 0 remains r_d[0]. The signal `feedback` of a trial records the
    contribution of the feedback to the input, the signal `reference` records the learned r[k+1].
    `check` raises ValueError for a task or a learning scheme that does not fit; `learn` raises it
    for a trial without these signals.
    """

    learning: Scheme = child()
    feedback: Scheme = child()
    prefilter: Filter | None = child(default=None)
    motor_output: int = static(default=0, interval="[0, inf)", whole=True)
    table_output: int = static(default=1, interval="[0, inf)", whole=True)

    @property
    def preview(self) -> int:
        return self.feedback.preview

    def learning_task(self, task: Task) -> Task:
        """The task as the learning part sees it, with two inputs and two outputs."""
        return dataclasses.replace(
            task.of_outputs((self.table_output, self.table_output)), inputs=2
        )

    def parts(self, task: Task, memory: Pair) -> dict[str, Part]:
        motor = task.of_outputs((self.motor_output,))
        return {
            "learning": Part(self.learning, self.learning_task(task), memory.learning),
            "feedback": Part(self.feedback, motor, memory.feedback),
        }

    def shown(self, trial: Trial) -> dict[str, Trial]:
        for name in ("feedback", "reference"):
            if name not in trial.signals:
                raise ValueError(
                    f"MultivariableILC: the trial has no signal {name!r} (N, 1), so what was "
                    "learned cannot be told from it"
                )
        start, r = trial.r[:1, self.table_output, None], trial.signals["reference"]
        y = trial.y[:, [self.motor_output, self.table_output]]
        seen, W = [self.motor_output, self.table_output], trial.weight
        W = W if W is None else W[..., seen, :][..., seen]
        followed, wanted = jnp.concatenate([start, r]), trial.r[:, self.table_output, None]
        own = Trial(
            jnp.concatenate([followed, wanted], axis=1),
            y,
            jnp.concatenate([trial.u - trial.signals["feedback"], r], axis=1),
            trial.dt,
            weight=W,
        )
        signals = signals_of_part("feedback", trial.signals)
        of_motor = trial._replace(r=followed, y=y[:, :1], signals=signals, weight=None)
        return {"learning": own, "feedback": of_motor}

    def check(self, task: Task) -> None:
        if (
            task.inputs != 1
            or self.motor_output == self.table_output
            or max(self.motor_output, self.table_output) >= task.outputs
        ):
            raise ValueError(
                f"MultivariableILC: motor_output = {self.motor_output} and table_output = "
                f"{self.table_output} must be two of the task's {task.outputs} outputs, and its "
                f"inputs one, not {task.inputs}"
            )
        super().check(task)
        name = type(self.learning).__name__
        if not self.learning.plays_back:
            raise ValueError(
                f"MultivariableILC: {name} acts within the trial; allowed are schemes that play "
                "back a learned signal"
            )
        if not hasattr(
            jax.eval_shape(lambda: self.learning.initial_memory(self.learning_task(task))), "u"
        ):
            raise ValueError(
                f"MultivariableILC: the memory of {name} has no field u that could start at r_0"
            )
        if self.prefilter is not None:
            self.prefilter.check(task.N + 1, task.dt)

    def initial_memory(self, task: Task) -> Pair:
        learning = self.learning.initial_memory(self.learning_task(task))
        r = jnp.asarray(task.reference)[:, [self.table_output]]
        r = r if self.prefilter is None else self.prefilter(r, task.dt)
        feedback, motor, _ = self.parts(task, UNASKED)["feedback"]
        return Pair(
            learning._replace(u=learning.u.at[:, 1:].set(r[1:])), feedback.initial_memory(motor)
        )

    def learn(self, memory: Pair, trial: Trial) -> Pair:
        shown = self.shown(trial)
        return Pair(
            self.learning.learn(memory.learning, shown["learning"]),
            self.feedback.learn(memory.feedback, shown["feedback"]),
        )

    def schedule(self, memory: Pair, task: Task) -> ReferenceSchedule:
        learning, seen, known = self.parts(task, memory)["learning"]
        return self.play(learning.schedule(known, seen).u, memory, task)

    def play(self, learned, memory: Pair, task: Task) -> ReferenceSchedule:
        u, r = learned[:, :1], learned[:, 1:]
        held = jnp.pad(r, ((0, self.preview - 1), (0, 0)), mode="edge")
        window = jnp.stack([held[i : i + task.N] for i in range(self.preview)], axis=1)
        now = delay(r, 1).at[0].set(task.reference[0, self.table_output])
        feedback, motor, known = self.parts(task, memory)["feedback"]
        return ReferenceSchedule(u, now, window, feedback.schedule(known, motor))

    def feedforward(self, memory: Pair, task: Task) -> jax.Array:
        """The learned input u[k] and reference r[k+1] of the next trial, as (N, 2)."""
        return self.learning.feedforward(memory.learning, self.learning_task(task))

    def initial_state(self, task: Task) -> LearnedState:
        feedback, motor, _ = self.parts(task, UNASKED)["feedback"]
        return LearnedState(feedback.initial_state(motor), jnp.zeros(1), jnp.zeros(1))

    def act(self, state: LearnedState, sample: Sample) -> tuple[Any, jax.Array]:
        row = sample.row
        seen = sample._replace(
            r=row.now, ahead=row.ahead, y=sample.y[self.motor_output][None], row=row.feedback
        )
        feedback, u = self.feedback.act(state.feedback, seen)
        return LearnedState(feedback, u, row.ahead[0]), row.u + u

    def signals(self, state: LearnedState) -> dict[str, jax.Array]:
        feedback = self.feedback.signals(state.feedback)
        return {"feedback": state.u, "reference": state.reference} | under("feedback", feedback)

    def played(self, schedule: ReferenceSchedule, task: Task) -> dict[str, jax.Array]:
        """What a machine plays in a trial, by name.

        feedforward: (N, 1) the learned input [unit of u]
        reference: (N+1, 1) the reference that the feedback of the motor follows [unit of y]
        """
        reference = jnp.concatenate([schedule.now, schedule.ahead[-1:, 0]])
        feedback, motor, _ = self.parts(task, UNASKED)["feedback"]
        own = {"feedforward": schedule.u, "reference": reference}
        return own | under("feedback", feedback.played(schedule.feedback, motor))

    @property
    def trials_a_step(self) -> int:
        return self.learning.trials_a_step

    def limits(self, task: Task, memory: Pair, trial: Trial) -> dict[str, Limit]:
        shown = self.shown(trial)
        acted = shown["feedback"]._replace(u=trial.signals["feedback"])
        return limits_of_parts(self.parts(task, memory), shown | {"feedback": acted})

    def record(self, learned, e, task: Task) -> Trial:
        r = jnp.asarray(task.reference)
        return Trial(
            r,
            r - e,
            learned[:, :1],
            task.dt,
            silent_signals(self, task) | {"reference": learned[:, 1:]},
        )
