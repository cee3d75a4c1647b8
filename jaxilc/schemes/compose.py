"""Schemes that are composed of other schemes."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from ..filters.zero_phase import Filter
from ..pytree.fields import child, pytree, static
from ..signals.task import Limit, Sample, Task, Trial
from .experiments import need_no_experiments
from .scheme import (
    Part,
    Scheme,
    State,
    limit_of,
    limited,
    limits_of_parts,
    under,
)
from .wrapper import Wrapper


class Pair(NamedTuple):
    """The memory of the learning part and that of the feedback part, or the schedule of each."""

    learning: Any
    feedback: Any


class PairState(NamedTuple):
    """The states of the two parts, and the last input of the feedback part.

    learning: state of the learning part
    feedback: state of the feedback part
    u: (n_u,) last contribution of the feedback part to the input [unit of u]
    """

    learning: State
    feedback: State
    u: jax.Array


@pytree
class WithFeedback(Scheme):
    """Learned feedforward and feedback in parallel (Li 2020, eq. 2).

        u = u_learning + u_feedback

    learning: scheme that learns the feedforward input
    feedback: scheme that acts within the trial

    The learning part is shown the input minus the contribution of the feedback, so that it learns
    its own contribution only, and the contribution of the feedback as the signal `beside`. What an
    actuator cuts off from u is counted as cut off from the learned part.
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
    def trials_a_step(self) -> int:
        return self.learning.trials_a_step

    def shown(self, trial: Trial) -> dict[str, Trial]:
        if "feedback" not in trial.signals:
            raise ValueError(
                "WithFeedback: the trial has no signal 'feedback' (N, n_u), so its learned part "
                "cannot be told from u"
            )
        learning, feedback = (
            trial._replace(signals=signals_of_part(name, trial.signals))
            for name in ("learning", "feedback")
        )
        beside = {"beside": trial.signals["feedback"]} | learning.signals
        own = learning._replace(u=trial.u - trial.signals["feedback"], signals=beside)
        return {"learning": own, "feedback": feedback}

    def initial_memory(self, task: Task) -> Pair:
        return Pair(self.learning.initial_memory(task), self.feedback.initial_memory(task))

    def learn(self, memory: Pair, trial: Trial) -> Pair:
        shown = self.shown(trial)
        return Pair(
            self.learning.learn(memory.learning, shown["learning"]),
            self.feedback.learn(memory.feedback, shown["feedback"]),
        )

    def schedule(self, memory: Pair, task: Task) -> Pair:
        return Pair(
            self.learning.schedule(memory.learning, task),
            self.feedback.schedule(memory.feedback, task),
        )

    def feedforward(self, memory: Pair, task: Task) -> jax.Array:
        return self.learning.feedforward(memory.learning, task)

    def initial_state(self, task: Task) -> PairState:
        return PairState(
            self.learning.initial_state(task),
            self.feedback.initial_state(task),
            jnp.zeros(task.inputs),
        )

    def act(self, state: PairState, sample: Sample) -> tuple[Any, jax.Array]:
        own = None if sample.applied is None else sample.applied - state.u
        learning, u_learning = self.learning.act(
            state.learning, sample._replace(row=sample.row.learning, applied=own)
        )
        feedback, u_feedback = self.feedback.act(
            state.feedback, sample._replace(row=sample.row.feedback)
        )
        return PairState(learning, feedback, u_feedback), u_learning + u_feedback

    def signals(self, state: PairState) -> dict[str, jax.Array]:
        learning = under("learning", self.learning.signals(state.learning))
        feedback = under("feedback", self.feedback.signals(state.feedback))
        return {"feedback": state.u} | learning | feedback

    def played(self, schedule: Pair, task: Task) -> dict[str, jax.Array]:
        """What a machine plays; `feedforward` is added to the output of the feedback."""
        learning = self.learning.played(schedule.learning, task)
        renamed = {"feedforward" if name == "u" else name: rows for name, rows in learning.items()}
        return renamed | under("feedback", self.feedback.played(schedule.feedback, task))

    def limits(self, task: Task, memory: Pair, trial: Trial) -> dict[str, Limit]:
        shown = self.shown(trial)
        acted = shown["feedback"]._replace(u=trial.signals["feedback"])
        return limits_of_parts(self.parts(task, memory), shown | {"feedback": acted})

    def play(self, learned, memory: Pair, task: Task) -> Pair:
        return Pair(
            self.learning.play(learned, memory.learning, task),
            self.feedback.schedule(memory.feedback, task),
        )

    def record(self, learned, e, task: Task) -> Trial:
        trial = self.learning.record(learned, e, task)
        own = under("learning", trial.signals)
        return trial._replace(signals=silent_signals(self, task) | own)


def silent_signals(scheme: Scheme, task: Task) -> dict[str, jax.Array]:
    """The signals of a scheme over a trial in which they are all zero."""
    shapes = jax.eval_shape(lambda: scheme.signals(scheme.initial_state(task)))
    return {name: jnp.zeros((task.N, *one.shape), one.dtype) for name, one in shapes.items()}


def signals_of_part(name: str, signals: dict[str, jax.Array]) -> dict[str, jax.Array]:
    """The signals of a part, under the names that the part itself gave them."""
    return {
        signal.removeprefix(f"{name}."): value
        for signal, value in signals.items()
        if signal.startswith(f"{name}.")
    }


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

    def check(self, task: Task) -> None:
        super().check(task)
        need_no_experiments(self, task, "which must be played as they are; give it the filter")
        self.filter.check(task.N, task.dt)
        need_feedforward(self, self.scheme, task)

    def schedule(self, memory, task: Task) -> Any:
        schedule = self.scheme.schedule(memory, task)
        return schedule._replace(u=limited(self.filter(schedule.u, task.dt), self.limit))

    def feedforward(self, memory, task: Task) -> jax.Array:
        return self.schedule(memory, task).u

    def limits(self, task: Task, memory, trial: Trial) -> dict[str, Limit]:
        free = self.unlimited()
        filtered = limit_of(free.feedforward(free.learn(memory, trial), task), self.limit)
        return super().limits(task, memory, trial) | under("filtered", filtered)


@pytree
class ErrorFiltered(Wrapper):
    """The error is filtered before a scheme learns from it (Li 2020, eq. 11 and Fig. 17).

        u_{j+1} = u_j + L F e_j

    scheme: any scheme that learns from the error
    filter: zero-phase filter F, applied to each channel of e

    At frequencies that F blocks, nothing is learned, and nothing that was learned is forgotten:
    from trial to trial the error is multiplied by 1 - P L F, which is about 1 there. With
    `Filtered` the factor is |Q (1 - P L)| instead. Noise that F passes still accumulates.
    """

    scheme: Scheme = child()
    filter: Filter = child()

    def check(self, task: Task) -> None:
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

    def parts(self, task: Task, memory) -> dict[str, Part]:
        seen = task.of_outputs(self.outputs)
        return {"scheme": Part(self.scheme, seen, memory)}

    def shown(self, trial: Trial) -> dict[str, Trial]:
        seen, W = list(self.outputs), trial.weight
        W = W if W is None else W[..., seen, :][..., seen]
        return {"scheme": trial._replace(r=trial.r[..., seen], y=trial.y[..., seen], weight=W)}

    def check(self, task: Task) -> None:
        if not self.outputs or not all(0 <= i < task.outputs for i in self.outputs):
            raise ValueError(
                f"OnOutputs: outputs = {self.outputs} is not a choice among the task's outputs "
                f"0..{task.outputs - 1}"
            )
        super().check(task)

    def act(self, state, sample: Sample) -> tuple[Any, jax.Array]:
        seen = list(self.outputs)
        r, ahead, y = (signal[..., seen] for signal in (sample.r, sample.ahead, sample.y))
        return self.scheme.act(state, sample._replace(r=r, ahead=ahead, y=y))

    def record(self, learned, e, task: Task) -> Trial:
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
