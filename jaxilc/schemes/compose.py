"""Schemes that are composed of other schemes: beside a feedback, with a filter, on some outputs."""

from __future__ import annotations

import dataclasses
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp

from ..filters.zero_phase import Filter
from ..pytree.aliases import Array, Leaf, Tree
from ..pytree.fields import child, pytree, static
from ..signals.rows import ahead_of, delay
from ..signals.task import Limit, Sample, Task, Trial
from .guards import Ladder
from .scheme import (
    UNASKED,
    Memory,
    Part,
    Schedule,
    Scheme,
    State,
    Wrapper,
    limited,
    limits_of_parts,
    need_no_experiments,
    silent,
    under,
)
from .weights import need_no_true_outputs


class Pair(NamedTuple):
    """The memory of the learning part and that of the feedback part, or the schedule of each."""

    learning: Memory
    feedback: Memory


class LearningAndFeedback(Scheme):
    """A scheme that learns what a feedback gets: the base class of those with these two parts.

    `shown` gives the learning part its own contribution, which signals of the trial tell. The
    contribution of the feedback to the input is the signal `feedback`, or all of the input.
    """

    learning: Scheme
    feedback: Scheme

    @property
    def preview(self) -> int:
        return self.feedback.preview

    @property
    def limit(self) -> Leaf | None:
        return getattr(self.learning, "limit", None)

    @property
    def trials_a_step(self) -> int:
        return math.lcm(self.learning.trials_a_step, self.feedback.trials_a_step)

    def frozen(self) -> Scheme:
        """As of any scheme, but parts that learn after different numbers of trials keep these."""
        law, names = super().frozen(), ("learning", "feedback")
        each = {
            name: getattr(self, name).trials_a_step // getattr(law, name).trials_a_step
            for name in names
            if getattr(self, name).learns
        }
        if len(set(each.values())) < 2:
            return law
        steps = {name: Ladder(getattr(law, name), n) for name, n in each.items() if n > 1}
        return law._with(steps)

    def initial_memory(self, task: Task) -> Pair:
        parts = self.parts(task, UNASKED).items()
        return Pair(**{name: scheme.initial_memory(seen) for name, (scheme, seen, _) in parts})

    def learn(self, memory: Pair, trial: Trial) -> Pair:
        shown = self.shown(trial)
        return Pair(
            self.learning.learn(memory.learning, shown["learning"]),
            self.feedback.learn(memory.feedback, shown["feedback"]),
        )

    def schedule(self, memory: Pair, task: Task) -> Schedule:
        return self.play(self.feedforward(memory, task), memory, task)

    def feedforward(self, memory: Pair, task: Task) -> Array:
        learning, seen, known = self.parts(task, memory)["learning"]
        return learning.feedforward(known, seen)

    def limits(self, task: Task, memory: Pair, trial: Trial) -> dict[str, Limit]:
        shown = self.shown(trial)
        own = trial.signals.get("feedback", trial.u)
        acted = {"feedback": shown["feedback"]._replace(u=own)}
        return limits_of_parts(self.parts(task, memory), shown | acted)

    def signals(self, state: State) -> dict[str, Array]:
        return state.told | under("feedback", self.feedback.signals(state.feedback))

    def _of_feedback(self, schedule: Schedule, task: Task) -> dict[str, Array]:
        """What a machine must know of the feedback of a schedule, by name."""
        feedback, seen, _ = self.parts(task, UNASKED)["feedback"]
        return under("feedback", feedback.played(schedule.feedback, seen))

    def _need_playback(self) -> None:
        """Raises ValueError unless the learning part plays back what it has learned."""
        if not self.learning.plays_back:
            raise ValueError(
                f"{type(self).__name__}: {type(self.learning).__name__} acts within the trial; "
                "allowed are schemes that play back a learned signal"
            )


def seen_of(trial: Trial, outputs: tuple[int, ...]) -> Trial:
    """The trial as a scheme sees it that sees only these outputs."""
    seen, W = list(outputs), trial.weight
    W = W if W is None else W[..., seen, :][..., seen]
    return trial._replace(r=trial.r[..., seen], y=trial.y[..., seen], weight=W)


def signals_of_part(name: str, signals: dict[str, Array]) -> dict[str, Array]:
    """The signals of a part, under the names that the part itself gave them."""
    return {
        signal.removeprefix(f"{name}."): value
        for signal, value in signals.items()
        if signal.startswith(f"{name}.")
    }


def need_signals(scheme: Scheme, trial: Trial, **shapes: str) -> None:
    """Raises ValueError where a trial lacks a signal, of the shape given, that tells the parts."""
    for name, shape in shapes.items():
        if name not in trial.signals:
            raise ValueError(
                f"{type(scheme).__name__}: the trial has no signal {name!r} {shape}, so what was "
                "learned cannot be told from it"
            )


class PairState(NamedTuple):
    """The states of the two parts, and the last input of the feedback part.

    learning: state of the learning part
    feedback: state of the feedback part
    u: (n_u,) last contribution of the feedback part to the input [unit of u]
    """

    learning: State
    feedback: State
    u: Array


class Followed(NamedTuple):
    """The state of a feedback that follows what was learned, and the signals of the last sample."""

    feedback: State
    told: dict[str, Array]


@pytree
class WithFeedback(LearningAndFeedback):
    """Learned feedforward and feedback in parallel (Li 2020, eq. 2).

        u = u_learning + u_feedback

    learning: scheme that learns the feedforward input
    feedback: scheme that acts within the trial

    The learning part is shown the input minus the contribution of the feedback, so that it learns
    its own contribution only, and the contribution of the feedback as the signal `beside`. A
    feedback that learns is shown its own contribution as the input. What an actuator cuts off from
    u is counted as cut off from the learned part, also within the trial.
    The signal `feedback` of the trial records the contribution of the feedback. The signals of the
    parts are recorded as `learning.NAME` and `feedback.NAME`.
    `learn` raises ValueError for a trial without the signal `feedback`.
    """

    learning: Scheme = child()
    feedback: Scheme = child()

    @property
    def preview(self) -> int:
        return max(self.learning.preview, self.feedback.preview)

    @property
    def learns(self) -> bool:
        return self.learning.learns or self.feedback.learns

    def shown(self, trial: Trial) -> dict[str, Trial]:
        need_signals(self, trial, feedback="(N, n_u)")
        learning, feedback = (
            trial._replace(signals=signals_of_part(name, trial.signals))
            for name in ("learning", "feedback")
        )
        beside = {"beside": trial.signals["feedback"]} | learning.signals
        own = learning._replace(u=trial.u - trial.signals["feedback"], signals=beside)
        return {"learning": own, "feedback": feedback._replace(u=trial.signals["feedback"])}

    def schedule(self, memory: Pair, task: Task) -> Pair:
        return Pair(
            self.learning.schedule(memory.learning, task),
            self.feedback.schedule(memory.feedback, task),
        )

    def initial_state(self, task: Task) -> PairState:
        return PairState(
            self.learning.initial_state(task),
            self.feedback.initial_state(task),
            jnp.zeros(task.inputs),
        )

    def act(self, state: PairState, sample: Sample) -> tuple[PairState, Array]:
        own = of_feedback = None
        if sample.applied is not None:
            own, of_feedback = sample.applied - state.u, state.u
        learning, u_learning = self.learning.act(
            state.learning, sample._replace(row=sample.row.learning, applied=own)
        )
        feedback, u_feedback = self.feedback.act(
            state.feedback, sample._replace(row=sample.row.feedback, applied=of_feedback)
        )
        return PairState(learning, feedback, u_feedback), u_learning + u_feedback

    def signals(self, state: PairState) -> dict[str, Array]:
        learning = under("learning", self.learning.signals(state.learning))
        feedback = under("feedback", self.feedback.signals(state.feedback))
        return {"feedback": state.u} | learning | feedback

    def played(self, schedule: Pair, task: Task) -> dict[str, Array]:
        """What a machine plays; `feedforward` is added to the output of the feedback.

        A learning part that has a feedback, too, is under `learning` where its names are those of
        the feedback.
        """
        learning = self.learning.played(schedule.learning, task)
        renamed = {"feedforward" if name == "u" else name: rows for name, rows in learning.items()}
        of_feedback = self._of_feedback(schedule, task)
        if renamed.keys() & of_feedback.keys():
            renamed = under("learning", learning)
        return renamed | of_feedback

    def play(self, learned: Array, memory: Pair, task: Task) -> Pair:
        return Pair(
            self.learning.play(learned, memory.learning, task),
            self.feedback.schedule(memory.feedback, task),
        )

    def record(self, learned: Array, e: Array, task: Task) -> Trial:
        trial = self.learning.record(learned, e, task)
        return trial._replace(signals=silent(self, task) | under("learning", trial.signals))


class ReferenceSchedule(NamedTuple):
    """The rows of a feedback whose reference is learned.

    u: (N, n_y) correction w[k] of the reference r[k+1] [unit of y]
    now: (N, n_y) correction of r[k] [unit of y]
    ahead: (N, preview, n_y) corrections of r[k+1], r[k+2], ... [unit of y]
    feedback: schedule of the feedback
    """

    u: Array
    now: Array
    ahead: Array
    feedback: Schedule


@pytree
class OnReference(LearningAndFeedback):
    """The feedback follows r + w, and w is learned (the series structure of Li 2020, Fig. 1).

    learning: pure feedforward scheme, whose `u` is the correction w; w[k] is added to r[k+1]
    The signal `correction` of the trial records w. The scheme learns from the error r - y, without
    w.
    `check` raises ValueError for a learning scheme that acts within the trial; `learn` raises it
    for a trial without the signal `correction`.
    """

    learning: Scheme = child()
    feedback: Scheme = child()

    def parts(self, task: Task, memory: Pair) -> dict[str, Part]:
        corrections = dataclasses.replace(task, inputs=task.outputs)
        return {
            "learning": Part(self.learning, corrections, memory.learning),
            "feedback": Part(self.feedback, task, memory.feedback),
        }

    def shown(self, trial: Trial) -> dict[str, Trial]:
        need_signals(self, trial, correction="(N, n_y)")
        own = trial._replace(u=trial.signals["correction"], signals={})
        of_feedback = trial._replace(signals=signals_of_part("feedback", trial.signals))
        return {"learning": own, "feedback": of_feedback}

    def check(self, task: Task) -> None:
        super().check(task)
        need_feedforward(self, self.learning, self.parts(task, UNASKED)["learning"].task)
        self._need_playback()

    def play(self, learned: Array, memory: Pair, task: Task) -> ReferenceSchedule:
        feedback = self.feedback.schedule(memory.feedback, task)
        ahead = ahead_of(learned, self.preview)
        return ReferenceSchedule(learned, delay(learned, 1), ahead, feedback)

    def initial_state(self, task: Task) -> Followed:
        told = {"correction": jnp.zeros(task.outputs)}
        return Followed(self.feedback.initial_state(task), told)

    def act(self, state: Followed, sample: Sample) -> tuple[Followed, Array]:
        row = sample.row
        seen = sample._replace(
            r=sample.r + row.now, ahead=sample.ahead + row.ahead, row=row.feedback
        )
        feedback, u = self.feedback.act(state.feedback, seen)
        return Followed(feedback, {"correction": row.u}), u

    def played(self, schedule: ReferenceSchedule, task: Task) -> dict[str, Array]:
        """What a machine plays; the feedback follows `reference` (N+1, n_y), not the task's r.

        A feedback that learns on its reference, too, follows its own, to which both have added.
        """
        reference = jnp.asarray(task.reference).at[1:].add(schedule.u)
        seen = dataclasses.replace(task, reference=reference)
        return {"reference": reference} | self._of_feedback(schedule, seen)

    def record(self, learned: Array, e: Array, task: Task) -> Trial:
        still = super().record(jnp.zeros((task.N, task.inputs)), e, task)
        return still._replace(signals=silent(self, task) | {"correction": learned})


@pytree
class MultivariableILC(LearningAndFeedback):
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
        need_signals(self, trial, feedback="(N, 1)", reference="(N, 1)")
        start, r = trial.r[:1, self.table_output, None], trial.signals["reference"]
        seen = seen_of(trial, (self.motor_output, self.table_output))
        followed = jnp.concatenate([start, r])
        y = seen.y
        if seen.weight is not None:  # by which the error from the learned reference counts, too
            y = y + (jnp.eye(2)[0] - seen.weight[..., 0]) * (followed - seen.r[:, :1])
        own = seen._replace(
            r=seen.r.at[:, :1].set(followed),
            y=y,
            u=jnp.concatenate([trial.u - trial.signals["feedback"], r], axis=1),
            signals={},
        )
        signals = signals_of_part("feedback", trial.signals)
        of_motor = seen_of(own, (0,))._replace(u=trial.signals["feedback"], signals=signals)
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
        self._need_playback()
        if not hasattr(
            jax.eval_shape(lambda: self.learning.initial_memory(self.learning_task(task))), "u"
        ):
            raise ValueError(
                f"MultivariableILC: the memory of {type(self.learning).__name__} has no field u "
                "that could start at r_0"
            )
        if self.prefilter is not None:
            self.prefilter.check(task.N + 1, task.dt)

    def initial_memory(self, task: Task) -> Pair:
        memory = super().initial_memory(task)
        r = jnp.asarray(task.reference)[:, [self.table_output]]
        r = r if self.prefilter is None else self.prefilter(r, task.dt)
        u = memory.learning.u.at[:, 1:].set(r[1:])
        return memory._replace(learning=memory.learning._replace(u=u))

    def play(self, learned: Array, memory: Pair, task: Task) -> ReferenceSchedule:
        u, r = learned[:, :1], learned[:, 1:]
        now = delay(r, 1).at[0].set(task.reference[0, self.table_output])
        feedback, motor, known = self.parts(task, memory)["feedback"]
        schedule = feedback.schedule(known, motor)
        return ReferenceSchedule(u, now, ahead_of(r, self.preview), schedule)

    def initial_state(self, task: Task) -> Followed:
        feedback, motor, _ = self.parts(task, UNASKED)["feedback"]
        told = {"feedback": jnp.zeros(1), "reference": jnp.zeros(1)}
        return Followed(feedback.initial_state(motor), told)

    def act(self, state: Followed, sample: Sample) -> tuple[Followed, Array]:
        row = sample.row
        own = None if sample.applied is None else state.told["feedback"]
        y = sample.y[self.motor_output][None]
        seen = sample._replace(r=row.now, ahead=row.ahead, y=y, row=row.feedback, applied=own)
        feedback, u = self.feedback.act(state.feedback, seen)
        return Followed(feedback, {"feedback": u, "reference": row.ahead[0]}), row.u + u

    def played(self, schedule: ReferenceSchedule, task: Task) -> dict[str, Array]:
        """What a machine plays in a trial, by name.

        feedforward: (N, 1) the learned input [unit of u]
        reference: (N+1, 1) the reference that the feedback of the motor follows [unit of y]
        """
        reference = jnp.concatenate([schedule.now, schedule.ahead[-1:, 0]])
        own = {"feedforward": schedule.u, "reference": reference}
        return own | self._of_feedback(schedule, task)

    def record(self, learned: Array, e: Array, task: Task) -> Trial:
        signals = silent(self, task) | {"reference": learned[:, 1:]}
        return super().record(learned[:, :1], e, task)._replace(signals=signals)


@pytree
class Filtered(Wrapper):
    """A robustness filter Q on the learned input of any learning scheme.

        u_{j+1} = Q(u_j + L e_j)

    scheme: a scheme whose schedule has a field `u`; if it has a `limit`, the filtered u is also
        limited
    filter: zero-phase filter Q, applied to each channel of `u`
    """

    scheme: Scheme = child()
    filter: Filter = child()
    limits_again = "filtered"

    def check(self, task: Task) -> None:
        super().check(task)
        need_no_experiments(self, task, "which must be played as they are; give it the filter")
        self.filter.check(task.N, task.dt)
        need_feedforward(self, self.scheme, task)

    def schedule(self, memory: Memory, task: Task) -> Schedule:
        return self.scheme.play(self.feedforward(memory, task), memory, task)

    def feedforward(self, memory: Tree, task: Task) -> Array:
        learned = self.scheme.feedforward(memory, task)
        return limited(self.filter(learned, task.dt), self.limit)


@pytree
class ErrorFiltered(Wrapper):
    """The error is filtered before a scheme learns from it (Li 2020, eq. 11 and Fig. 17).

        u_{j+1} = u_j + L F e_j

    scheme: any scheme that learns from the error, but none that compares outputs within the trial
        (FFDL-MFAILC), weighs their jerk (`jerk_time`) or bounds them
    filter: zero-phase filter F, applied to each channel of e

    At frequencies that F blocks, nothing is learned, and nothing that was learned is forgotten:
    from trial to trial the error is multiplied by 1 - P L F, which is about 1 there. With
    `Filtered` the factor is |Q (1 - P L)| instead. Noise that F passes still accumulates.
    """

    scheme: Scheme = child()
    filter: Filter = child()

    def check(self, task: Task) -> None:
        need_no_true_outputs(self, task, "would hold for r - F e in its place")
        super().check(task)
        self.filter.check(task.N + 1, task.dt)

    def shown(self, trial: Trial) -> dict[str, Trial]:
        return {"scheme": trial._replace(y=trial.r - self.filter(trial.e, trial.dt))}


@pytree
class OnOutputs(Wrapper):
    """A scheme that sees only some of the outputs of the machine.

    An example is a feedback loop on the motor side of a machine that also measures its table.

    scheme: the scheme, which acts on all inputs
    outputs: indices of the outputs that the scheme sees

    `check` raises ValueError for an index that is not one of the task's outputs.
    """

    scheme: Scheme = child()
    outputs: tuple[int, ...] = static()

    def parts(self, task: Task, memory: Tree) -> dict[str, Part]:
        seen = task.of_outputs(self.outputs)
        return {"scheme": Part(self.scheme, seen, memory)}

    def shown(self, trial: Trial) -> dict[str, Trial]:
        return {"scheme": seen_of(trial, self.outputs)}

    def check(self, task: Task) -> None:
        if not self.outputs or not all(0 <= i < task.outputs for i in self.outputs):
            raise ValueError(
                f"OnOutputs: outputs = {self.outputs} is not a choice among the task's outputs "
                f"0..{task.outputs - 1}"
            )
        super().check(task)

    def act(self, state: State, sample: Sample) -> tuple[State, Array]:
        seen = list(self.outputs)
        r, ahead, y = (signal[..., seen] for signal in (sample.r, sample.ahead, sample.y))
        return self.scheme.act(state, sample._replace(r=r, ahead=ahead, y=y))

    def record(self, learned: Array, e: Array, task: Task) -> Trial:
        r = jnp.asarray(task.reference)
        of_seen = super().record(learned, e[:, list(self.outputs)], task)
        return of_seen._replace(r=r, y=r - e)


def need_feedforward(scheme: Scheme, learning: Scheme, task: Task) -> None:
    """Raises ValueError unless the schedule of `learning` has a feedforward signal `u`."""
    found = jax.eval_shape(lambda: learning.schedule(learning.initial_memory(task), task))
    if not hasattr(found, "u"):
        raise ValueError(
            f"{type(scheme).__name__}: {type(learning).__name__} learns no feedforward signal u"
        )
