"""The interface of a scheme, which acts within a trial and learns between trials."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import ClassVar, NamedTuple, Self, TypeAlias, TypeVar

import jax
import jax.numpy as jnp

from ..pytree.aliases import Array, Leaf, Tree, Value
from ..pytree.fields import need_decorated
from ..pytree.named_paths import named_leaves
from ..signals.task import Limit, Sample, Task, Trial

Memory: TypeAlias = Tree
Schedule: TypeAlias = Tree  # each leaf has N rows
State: TypeAlias = Tree
STOPPED = 1e-30  # step of an estimator with which its estimate does not change


T = TypeVar("T")


class Feedforward(NamedTuple):
    """The memory or schedule of a scheme that only plays back its learned input u (N, n_u)."""

    u: Array


class Law:
    """What a scheme plays in a trial, and what it learns from it: all that most authors override.

        initial_memory(task)     what is known before the first trial: by default a zero input
        learn(memory, trial)     what is known after a trial
        initial_state(task)      the state before the first sample of a trial: by default none
        act(state, sample)       the state after a sample, and the input of that sample

    A law that learns overrides `learn`; it needs `initial_memory` too if it keeps more than the
    input that it plays next. A feedback overrides `act`, and `initial_state` if it has a state.
    Memory and state are any pytrees.

    preview: number of samples of the reference after k that `act` needs
    trials_a_step: number of trials that are run before the scheme learns once
    grows: times the factor j / (j - 1) by which an error that stays makes the learned input grow
        after trial j, at most, see `hardware.checks.larger`
    elementwise: whether all that it computes at a sample follows from the memory, the inputs and
        the outputs at this sample and a few others, see `learning.over_trials.outputs_suffice`
    """

    # `@pytree` makes a dataclass of each subclass
    __dataclass_fields__: ClassVar[dict[str, dataclasses.Field[Value]]]
    preview: int = 1
    trials_a_step: int = 1
    grows: float = 1.0
    elementwise: bool = False

    def __init__(self, *values: Value, **named: Value) -> None:
        if type(self) is not Scheme or values or named:
            need_decorated(type(self))

    @property
    def learns(self) -> bool:
        """Whether the scheme carries anything from trial to trial."""
        return type(self).learn is not Law.learn

    @property
    def plays_back(self) -> bool:
        """Whether `act` only plays back the `u` of the schedule, whatever happens in the trial."""
        return type(self).act is Law.act

    # Between trials
    # ----------------------------------------------------------------------------------------------

    def initial_memory(self, task: Task) -> Memory:
        """The memory before the first trial: of a law that plays back what it learns, zero input.

        A scheme that does not learn, or acts within the trial, has none by default.
        """
        overridden = type(self).learn is not Law.learn and type(self).act is Law.act
        return Feedforward(jnp.zeros((task.N, task.inputs))) if overridden else ()

    def learn(self, memory: Memory, trial: Trial) -> Memory:
        """The memory after a simulated or measured trial."""
        return memory

    def schedule(self, memory: Memory, task: Task) -> Schedule:
        """The rows that `act` sees: a pytree of which each leaf has N rows, one for each sample.

        By default it is the feedforward alone where the memory has a field `u` (N, n_u), else the
        memory itself.
        """
        return Feedforward(memory.u) if hasattr(memory, "u") else memory

    def feedforward(self, memory: Memory, task: Task) -> Array:
        """The learned input (N, n_u) that the next trial plays back.

        Raises ValueError for a scheme that learns no input.
        """
        schedule = self.schedule(memory, task)
        if not hasattr(schedule, "u"):
            raise ValueError(f"{type(self).__name__} learns no feedforward input")
        return schedule.u

    # Within a trial
    # ----------------------------------------------------------------------------------------------

    def initial_state(self, task: Task) -> State:
        """The state before the first sample of a trial."""
        return ()

    def act(self, state: State, sample: Sample) -> tuple[State, Array]:
        """The state after the sample k, and the input u[k] (n_u,) of this sample."""
        return state, sample.row.u

    def signals(self, state: State) -> dict[str, Array]:
        """Internal signals to record, by name, taken from the state after `act`."""
        return {}


class Part(NamedTuple):
    """A scheme that is a part of another scheme, with the task and the memory that it sees."""

    scheme: Scheme
    task: Task
    memory: Memory


class _Unasked:
    """A placeholder for a memory that is not used; each of its fields and elements is itself."""

    def __getattr__(self, name: str) -> _Unasked:
        if name.startswith("__"):
            raise AttributeError(name)
        return self

    def __getitem__(self, index: object) -> _Unasked:
        return self


UNASKED: Memory = _Unasked()


class Scheme(Law):
    """A control scheme, whose weights are the fields of a `@pytree` class.

    A user's own scheme is a subclass, which overrides methods of `Law`. What is defined below
    answers questions of machines and of theory; most schemes need none of it.

    A scheme that is composed of other schemes returns them from `parts`, and returns from `shown`
    the trial from which each of them learns. Preparation, checks, limits and what a machine plays
    then follow from those of the parts.

    `theory.structure` finds from the program itself whether a scheme is linear and whether it
    learns in the same way in every trial. What cannot be found from the program, the class says:

    estimator_steps: fields that are the step of an estimator; with 0, nothing adapts
    clips: fields that are a limit; with None, there is no limit
    compares: fields that, unless they are 0, make `act` compare the output of the running trial
        with the one that `learn` was shown
    experiments: whether all but the first of `trials_a_step` are experiments, with errors of
        their own
    of_one_length: whether the law, also far from its ends, belongs to one length of the trial
    weighs: whether it is another law for each set of samples that are measured
    first_derivatives_only: whether what it learns must not be differentiated twice
    """

    estimator_steps: ClassVar[tuple[str, ...]] = ()
    clips: ClassVar[tuple[str, ...]] = ()
    compares: ClassVar[tuple[str, ...]] = ()
    experiments: bool = False
    weighs: ClassVar[bool] = False
    first_derivatives_only: ClassVar[bool] = False
    of_one_length: bool = False

    def parts(self, task: Task, memory: Memory) -> dict[str, Part]:
        """The schemes that this one is composed of, each with the task and the memory that it sees.

        They are named by the fields that hold them; a plain scheme has none. By default they are
        all fields that are schemes, each with the same task and with the field of its name in the
        memory. A scheme for which the memory has no such field is left out; override `parts` if its
        limits shall count. `memory` may be the placeholder `UNASKED`: select from it, do not
        compute with it.
        """
        return {
            name: Part(scheme, task, getattr(memory, name))
            for name, scheme in self._fields_that_are_schemes().items()
            if hasattr(memory, name)
        }

    def shown(self, trial: Trial) -> dict[str, Trial]:
        """The trial as each part learns from it, by the field that holds the part."""
        return dict.fromkeys(self._fields_that_are_schemes(), trial)

    def check(self, task: Task) -> None:
        """Raises ValueError where the scheme, or one of its parts, does not fit the task."""
        for scheme, seen, _ in self.parts(task, UNASKED).values():
            scheme.check(seen)

    def prepared(self, task: Task) -> Self:
        """This scheme with all that depends on weights and task alone computed before the scans."""
        parts = self.parts(task, UNASKED).items()
        return self._with({name: scheme.prepared(seen) for name, (scheme, seen, _) in parts})

    def resumed(self, memory: Memory) -> Memory:
        """The memory with which a trial begins in `learn`; by default the one that was learned.

        Only the scheme that `learn` is given is asked, not its parts.
        """
        return memory

    def frozen(self) -> Scheme:
        """The linear law with which this scheme starts.

        Its estimators stay at their start values, and rules that decide when to learn are left out.
        """
        parts = {name: one.frozen() for name, one in self._fields_that_are_schemes().items()}
        steps = {name: getattr(self, name) for name in self.estimator_steps}
        return self._with(
            parts | {name: STOPPED * jnp.ones_like(step) for name, step in steps.items()}
        )

    def unlimited(self) -> Self:
        """This scheme without its limits and those of its parts."""
        parts = {name: one.unlimited() for name, one in self._fields_that_are_schemes().items()}
        return self._with(parts | dict.fromkeys(self.clips))

    def _fields_that_are_schemes(self) -> dict[str, Scheme]:
        fields = dataclasses.fields(self) if dataclasses.is_dataclass(self) else ()
        values = {field.name: getattr(self, field.name) for field in fields}
        return {name: value for name, value in values.items() if isinstance(value, Scheme)}

    def _with(self, changed: dict[str, Tree]) -> Self:
        return dataclasses.replace(self, **changed) if changed else self

    # What a machine plays, and what theory makes of a scheme
    # ----------------------------------------------------------------------------------------------

    def played(self, schedule: Schedule, task: Task) -> dict[str, Array]:
        """The parts of the schedule that a real machine needs in a trial, by name, each (N, ...).

        For a scheme that only plays back, this is `u`. For a scheme whose schedule has a field for
        each of its parts, it is what each part plays, as `PART.NAME`. Otherwise it is the rows that
        the controller needs to compute the law, as `table.NAME`.
        """
        if self.plays_back and hasattr(schedule, "u"):
            return {"u": schedule.u}
        parts = self.parts(task, UNASKED)
        if not parts or not all(hasattr(schedule, name) for name in parts):
            return under("table", named_leaves(schedule))
        found: dict[str, Array] = {}
        for name, (scheme, seen, _) in parts.items():
            found |= under(name, scheme.played(getattr(schedule, name), seen))
        return found

    def limits(self, task: Task, memory: Memory, trial: Trial) -> dict[str, Limit]:
        """The signals that must stay within their bounds so that no limit has an effect, by name.

        memory: the memory before a trial of the `unlimited` scheme
        By default a field `limit` is the largest |u| that a law learns which plays it back, and the
        largest |u| within the trial of another. The limits of a part are under its name. A scheme
        in a field that `parts` leaves out cannot be asked, so its limits count as met.
        """
        own: dict[str, Limit] = {}
        if "limit" in self.clips and (bound := getattr(self, "limit", None)) is not None:
            learned = self.learns and type(self).act is Law.act
            own["limit"] = Limit(
                next_unlimited(self, task, memory, trial) if learned else trial.u, bound
            )
        parts = self.parts(task, memory)
        for name, scheme in self._fields_that_are_schemes().items():
            free = scheme.unlimited()
            limited = jax.tree.structure(scheme) != jax.tree.structure(free)  # type: ignore[operator]  # of JAX
            if name not in parts and limited:
                left_out = f"{name}, which {type(self).__name__}.parts leaves out,"
                own[left_out] = Limit(jnp.full_like(trial.u, 2.0), jnp.ones(()))
        return own | limits_of_parts(parts, self.shown(trial) if parts else {})

    def play(self, learned: Array, memory: Memory, task: Task) -> Schedule:
        """The `schedule` with `learned`, of the shape of `feedforward`, as the learned signal."""
        return self.schedule(memory, task)._replace(u=learned)

    def record(self, learned: Array, e: Array, task: Task) -> Trial:
        """The record for `learn` of a trial that played `learned` with the error e (N+1, n_y).

        A feedback contributed nothing in this trial.
        """
        r = jnp.asarray(task.reference)
        return Trial(r, r - e, learned, task.dt)


class Wrapper(Scheme):
    """A scheme around another scheme, which behaves like it except for what the wrapper overrides.

    A wrapper whose inner scheme sees another task, or has another memory, overrides `parts`; what
    is done within a trial follows from that. A wrapper whose inner scheme learns from another trial
    overrides `shown`.

    limits_again: what it does to an input that was learned and limited, before it limits that, too
    """

    limits_again: ClassVar[str] = ""
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

    def limits(self, task: Task, memory: Memory, trial: Trial) -> dict[str, Limit]:
        found = super().limits(task, memory, trial)
        if self.limits_again and self.limit is not None:
            learned = next_unlimited(self, task, memory, trial)
            found[f"{self.limits_again}.limit"] = Limit(learned, self.limit)
        return found


def under(name: str, found: dict[str, T]) -> dict[str, T]:
    """The entries of a part under the name of the part, as `NAME.KEY`."""
    return {f"{name}.{key}": value for key, value in found.items()}


def limits_of_parts(parts: dict[str, Part], shown: dict[str, Trial]) -> dict[str, Limit]:
    """The limits of each part under its name; `shown` is the trial as each part acted in it."""
    found: dict[str, Limit] = {}
    for name, (scheme, task, memory) in parts.items():
        found |= under(name, scheme.limits(task, memory, shown[name]))
    return found


def next_unlimited(scheme: Scheme, task: Task, memory: Memory, trial: Trial) -> Array:
    """(N, n_u) what the scheme would learn from a trial if it had no limits."""
    free = scheme.unlimited()
    return free.feedforward(free.learn(memory, trial), task)


def need_square(scheme: Scheme, task: Task) -> None:
    """Raises ValueError unless the task has as many inputs as outputs, one pair a channel."""
    if task.inputs != task.outputs:
        raise ValueError(
            f"{type(scheme).__name__} works channel by channel and needs as many inputs as "
            f"outputs, not {task.inputs} and {task.outputs}; pick the outputs it shall see with "
            "OnOutputs"
        )


def limited(u: Array, limit: Array | None) -> Array:
    """The signal u, clipped to +-limit; with None there is no limit."""
    return u if limit is None else jnp.clip(u, -limit, limit)


def silent(scheme: Law, task: Task) -> dict[str, Array]:
    """The signals of a scheme over a trial in which they are all zero."""
    shapes = jax.eval_shape(lambda: scheme.signals(scheme.initial_state(task)))
    return {name: jnp.zeros((task.N, *one.shape), one.dtype) for name, one in shapes.items()}


# What is asked of all parts of a scheme
# --------------------------------------------------------------------------------------------------


def with_all_parts(scheme: Scheme, task: Task, memory: Memory = UNASKED) -> Iterator[Part]:
    """The scheme, its parts, the parts of these parts, and so on."""
    yield Part(scheme, task, memory)
    for part in scheme.parts(task, memory).values():
        yield from with_all_parts(*part)


def trials_of_step(scheme: Scheme, task: Task) -> int:
    """The number of trials of a learning step of which the first alone plays what was learned.

    It is 1 for a scheme that makes no experiments.
    """
    experiments = any(part.scheme.experiments for part in with_all_parts(scheme, task))
    return scheme.trials_a_step if experiments else 1


def growth_of(scheme: Scheme, task: Task) -> float:
    """The most by which a part makes what is learned grow faster than j / (j - 1), see `Law`."""
    return max(part.scheme.grows for part in with_all_parts(scheme, task))


def need_learned_at_last(owner: str, scheme: Scheme, task: Task, trials: int) -> None:
    """Raises ValueError where the last trial is an experiment, which says nothing of learning."""
    each = trials_of_step(scheme, task)
    if (trials - 1) % each:
        raise ValueError(
            f"{owner}: trials = {trials} ends with an experiment, whose error says nothing of what "
            f"was learned; allowed are 1, {1 + each}, {1 + 2 * each} and so on"
        )


def need_no_experiments(wrapper: Scheme, task: Task, why: str) -> None:
    """Raises ValueError where a part of the scheme makes experiments between its steps."""
    for scheme, _, _ in with_all_parts(wrapper, task):
        if scheme.experiments:
            raise ValueError(
                f"{type(wrapper).__name__}: {type(scheme).__name__} makes experiments between its "
                f"steps, {why}"
            )


def need_second_derivatives(scheme: Scheme) -> None:
    """Raises ValueError where a part of the scheme has first derivatives only."""

    def first_only(one: object) -> bool:
        return isinstance(one, Scheme) and one.first_derivatives_only

    for one in filter(first_only, jax.tree.leaves(scheme, is_leaf=first_only)):
        raise ValueError(
            "Contraction: the slope of a contraction needs second derivatives, and "
            f"{type(one).__name__} has first ones only; allowed are other objectives"
        )
