"""The base class of a scheme that is put around another scheme."""

from __future__ import annotations

from ..pytree.aliases import Array, Leaf
from ..signals.task import Sample, Task, Trial
from .scheme import UNASKED, Memory, Part, Schedule, Scheme, State


class Wrapper(Scheme):
    """A scheme around another scheme, which behaves like it except for what the wrapper overrides.

    A wrapper whose inner scheme sees another task, or has another memory, overrides `parts`; what
    is done within a trial follows from that. A wrapper whose inner scheme learns from another trial
    overrides `shown`.
    """

    scheme: Scheme

    def parts(self, task: Task, memory: Memory) -> dict[str, Part]:
        return {"scheme": Part(self.scheme, task, memory)}

    def _inner(self, task: Task, memory: Memory = UNASKED) -> Part:
        return Part(*self.parts(task, memory)["scheme"])

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
    def limit(self) -> Leaf | None:
        return getattr(self.scheme, "limit", None)

    @property
    def trials_a_step(self) -> int:
        return self.scheme.trials_a_step

    def initial_memory(self, task: Task) -> Memory:
        scheme, task, _ = self._inner(task)
        return scheme.initial_memory(task)

    def learn(self, memory: Memory, trial: Trial) -> Memory:
        return self.scheme.learn(memory, self.shown(trial)["scheme"])

    def schedule(self, memory: Memory, task: Task) -> Schedule:
        scheme, task, memory = self._inner(task, memory)
        return scheme.schedule(memory, task)

    def feedforward(self, memory: Memory, task: Task) -> Array:
        scheme, task, memory = self._inner(task, memory)
        return scheme.feedforward(memory, task)

    def initial_state(self, task: Task) -> State:
        scheme, task, _ = self._inner(task)
        return scheme.initial_state(task)

    def act(self, state: State, sample: Sample) -> tuple[State, Array]:
        return self.scheme.act(state, sample)

    def signals(self, state: State) -> dict[str, Array]:
        return self.scheme.signals(state)

    def played(self, schedule: Schedule, task: Task) -> dict[str, Array]:
        scheme, task, _ = self._inner(task)
        return scheme.played(schedule, task)

    def play(self, learned: Array, memory: Memory, task: Task) -> Schedule:
        scheme, task, memory = self._inner(task, memory)
        return scheme.play(learned, memory, task)

    def record(self, learned: Array, e: Array, task: Task) -> Trial:
        scheme, task, _ = self._inner(task)
        return scheme.record(learned, e, task)
