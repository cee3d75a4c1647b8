"""Schemes made of schemes."""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from ..filters.zero_phase import Filter
from ..pytree.fields import child, pytree, static
from ..signals.task import Limit, Sample, Task, Trial
from .scheme import Scheme, State, limit_of, limited, limits_below


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
    """u = u_learning + u_feedback: learned feedforward over a feedback loop (the parallel structure
    of Li 2020, eq. 2).

    The learning part is shown the input less the feedback's share, so that it learns its own
    contribution only: what an actuator takes away counts as taken from it. The trial's signal
    `feedback` is that share; those of the parts are `learning.NAME`, `feedback.NAME`.
    """

    learning: Scheme = child()
    feedback: Scheme = child()

    @property
    def preview(self) -> int:
        return max(self.learning.preview, self.feedback.preview)

    def check(self, task: Task) -> None:
        self.learning.check(task)
        self.feedback.check(task)

    def initial_memory(self, task: Task) -> Pair:
        return Pair(self.learning.initial_memory(task), self.feedback.initial_memory(task))

    def table(self, memory: Pair, task: Task) -> Pair:
        return Pair(
            self.learning.table(memory.learning, task), self.feedback.table(memory.feedback, task)
        )

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
        learning = of_part("learning", self.learning, state.learning)
        return {"feedback": state.u} | learning | of_part("feedback", self.feedback, state.feedback)

    def learn(self, memory: Pair, trial: Trial) -> Pair:
        own, of_feedback = self._shown(trial)
        return Pair(
            self.learning.learn(memory.learning, own),
            self.feedback.learn(memory.feedback, of_feedback),
        )

    def _shown(self, trial: Trial) -> Pair:
        """The trial as each part learns from it."""
        if "feedback" not in trial.signals:
            raise ValueError(
                "WithFeedback: the trial has no signal 'feedback' (N, n_u), so its learned part cannot be told from u"
            )
        of_learning, of_feedback = (
            trial._replace(signals=signals_of_part(name, trial.signals))
            for name in ("learning", "feedback")
        )
        return Pair(of_learning._replace(u=trial.u - trial.signals["feedback"]), of_feedback)

    def feedforward(self, memory: Pair, task: Task) -> jax.Array:
        return self.learning.feedforward(memory.learning, task)

    @property
    def trials_a_step(self) -> int:
        return self.learning.trials_a_step

    def limits(self, task: Task, memory: Pair, trial: Trial) -> dict[str, Limit]:
        own, of_feedback = self._shown(trial)
        of_feedback = of_feedback._replace(u=trial.signals["feedback"])
        return limits_below(
            "learning", self.learning.limits(task, memory.learning, own)
        ) | limits_below("feedback", self.feedback.limits(task, memory.feedback, of_feedback))

    def play(self, learned, memory: Pair, task: Task) -> Pair:
        return Pair(
            self.learning.play(learned, memory.learning, task),
            self.feedback.table(memory.feedback, task),
        )

    def record(self, learned, e, task: Task) -> Trial:
        trial = self.learning.record(learned, e, task)
        own = {f"learning.{name}": signal for name, signal in trial.signals.items()}
        return trial._replace(signals=silent_signals(self, task) | own)


def silent_signals(scheme: Scheme, task: Task) -> dict[str, jax.Array]:
    """The signals of a scheme over a trial in which they are all zero."""
    shapes = jax.eval_shape(lambda: scheme.signals(scheme.initial_state(task)))
    return {name: jnp.zeros((task.N, *one.shape), one.dtype) for name, one in shapes.items()}


def of_part(name: str, scheme: Scheme, state: State) -> dict[str, jax.Array]:
    """The signals of a part, under its name."""
    return {f"{name}.{signal}": value for signal, value in scheme.signals(state).items()}


def signals_of_part(name: str, signals: dict[str, jax.Array]) -> dict[str, jax.Array]:
    """The signals of a part, as it named them itself."""
    return {
        signal.removeprefix(f"{name}."): value
        for signal, value in signals.items()
        if signal.startswith(f"{name}.")
    }


class Wrapper(Scheme):
    """A scheme put around another, `scheme`, that does as that one does but for what it overrides."""

    scheme: Scheme

    @property
    def preview(self) -> int:
        return self.scheme.preview

    @property
    def learns(self) -> bool:
        return self.scheme.learns

    @property
    def plays_back(self) -> bool:
        return self.scheme.plays_back

    @property
    def limit(self) -> Any:
        return getattr(self.scheme, "limit", None)

    @property
    def trials_a_step(self) -> int:
        return self.scheme.trials_a_step

    def check(self, task: Task) -> None:
        self.scheme.check(task)

    def initial_memory(self, task: Task) -> Any:
        return self.scheme.initial_memory(task)

    def table(self, memory, task: Task) -> Any:
        return self.scheme.table(memory, task)

    def feedforward(self, memory, task: Task) -> jax.Array:
        return self.scheme.feedforward(memory, task)

    def initial_state(self, task: Task) -> Any:
        return self.scheme.initial_state(task)

    def act(self, state, sample: Sample) -> tuple[Any, jax.Array]:
        return self.scheme.act(state, sample)

    def signals(self, state) -> dict[str, jax.Array]:
        return self.scheme.signals(state)

    def learn(self, memory, trial: Trial) -> Any:
        return self.scheme.learn(memory, trial)

    def limits(self, task: Task, memory, trial: Trial) -> dict[str, Limit]:
        return limits_below("scheme", self.scheme.limits(task, memory, trial))

    def play(self, learned, memory, task: Task) -> Any:
        return self.scheme.play(learned, memory, task)

    def record(self, learned, e, task: Task) -> Trial:
        return self.scheme.record(learned, e, task)


@pytree
class Filtered(Wrapper):
    """u_{j+1} = Q(u_j + L e_j): a robustness filter on what any learning scheme is about to apply.

    scheme: one whose table has a field `u`, and whose `limit`, if it has one, holds for the
    filtered u too
    filter: zero-phase, applied to each channel of `u`
    """

    scheme: Scheme = child()
    filter: Filter = child()

    def check(self, task: Task) -> None:
        self.scheme.check(task)
        self.filter.check(task.N, task.dt)
        need_feedforward(self, self.scheme, task)

    def table(self, memory, task: Task) -> Any:
        table = self.scheme.table(memory, task)
        return table._replace(u=limited(self.filter(table.u, task.dt), self.limit))

    def feedforward(self, memory, task: Task) -> jax.Array:
        return self.table(memory, task).u

    def limits(self, task: Task, memory, trial: Trial) -> dict[str, Limit]:
        free = self.unlimited()
        filtered = limit_of(free.feedforward(free.learn(memory, trial), task), self.limit)
        return super().limits(task, memory, trial) | limits_below("filtered", filtered)


@pytree
class ErrorFiltered(Wrapper):
    """u_{j+1} = u_j + L F e_j: the error is filtered between trials, before any scheme learns from
    it (Li 2020, eq. 11 and Fig. 17).

    What F blocks is not learned, but nothing that was learned is forgotten either: there the error
    is multiplied by 1 - P L F, about 1, where `Filtered` leaves |Q (1 - P L)|. Noise that F lets
    through still adds up.
    scheme: any that learns from the error;  filter: zero-phase, applied to each channel of e
    """

    scheme: Scheme = child()
    filter: Filter = child()

    def check(self, task: Task) -> None:
        self.scheme.check(task)
        self.filter.check(task.N + 1, task.dt)

    def learn(self, memory, trial: Trial) -> Any:
        return self.scheme.learn(memory, self._shown(trial))

    def limits(self, task: Task, memory, trial: Trial) -> dict[str, Limit]:
        return super().limits(task, memory, self._shown(trial))

    def _shown(self, trial: Trial) -> Trial:
        return trial._replace(y=trial.r - self.filter(trial.e, trial.dt))


@pytree
class OnOutputs(Wrapper):
    """A scheme that sees only some of the outputs: a motor-side loop on a machine that also
    measures its table.

    scheme: acts on all inputs;  outputs: indices of the outputs it sees
    """

    scheme: Scheme = child()
    outputs: tuple[int, ...] = static()

    def _task(self, task: Task) -> Task:
        return dataclasses.replace(task, reference=task.reference[..., list(self.outputs)])

    def check(self, task: Task) -> None:
        if not self.outputs or not all(0 <= i < task.outputs for i in self.outputs):
            raise ValueError(
                f"OnOutputs: outputs = {self.outputs} is not a choice among the task's outputs 0..{task.outputs - 1}"
            )
        self.scheme.check(self._task(task))

    def prepared(self, task: Task) -> OnOutputs:
        return dataclasses.replace(self, scheme=self.scheme.prepared(self._task(task)))

    def initial_memory(self, task: Task) -> Any:
        return self.scheme.initial_memory(self._task(task))

    def table(self, memory, task: Task) -> Any:
        return self.scheme.table(memory, self._task(task))

    def feedforward(self, memory, task: Task) -> jax.Array:
        return self.scheme.feedforward(memory, self._task(task))

    def initial_state(self, task: Task) -> Any:
        return self.scheme.initial_state(self._task(task))

    def act(self, state, sample: Sample) -> tuple[Any, jax.Array]:
        seen = list(self.outputs)
        return self.scheme.act(
            state,
            sample._replace(
                r=sample.r[..., seen], ahead=sample.ahead[..., seen], y=sample.y[..., seen]
            ),
        )

    def learn(self, memory, trial: Trial) -> Any:
        return self.scheme.learn(memory, self._shown(trial))

    def _shown(self, trial: Trial) -> Trial:
        seen = list(self.outputs)
        return trial._replace(r=trial.r[..., seen], y=trial.y[..., seen])

    def limits(self, task: Task, memory, trial: Trial) -> dict[str, Limit]:
        return super().limits(self._task(task), memory, self._shown(trial))

    def play(self, learned, memory, task: Task) -> Any:
        return self.scheme.play(learned, memory, self._task(task))

    def record(self, learned, e, task: Task) -> Trial:
        r = jnp.asarray(task.reference)
        return self.scheme.record(learned, e[:, list(self.outputs)], self._task(task))._replace(
            r=r, y=r - e
        )


def need_feedforward(scheme: Scheme, learning: Scheme, task: Task) -> None:
    """Raises ValueError unless the table of `learning` has a feedforward signal `u`."""
    if not hasattr(
        jax.eval_shape(lambda: learning.table(learning.initial_memory(task), task)), "u"
    ):
        raise ValueError(
            f"{type(scheme).__name__}: {type(learning).__name__} learns no feedforward signal u"
        )
