"""What a scheme is: it acts within a trial and learns between trials."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp

from ..signals.task import Limit, Sample, Task, Trial

Memory = Any
State = Any
STOPPED = 1e-30  # an estimator step that moves nothing


class Feedforward(NamedTuple):
    """The table of a scheme that only plays back what it learned. u: (N, n_u)"""

    u: jax.Array


class Scheme:
    """A control scheme. Its weights are the fields of a `@pytree` class; a user's own scheme
    subclasses this.

    Between trials a `memory` is carried (any pytree); within a trial a `state`. `table(memory,
    task)` is what the trial needs of the memory, sample by sample, each leaf (N, ...); where it has
    a field `u`, that is the learned feedforward input. Pure feedback overrides `initial_state`
    and `act`; pure feedforward overrides `initial_memory` and `learn`.

    Theory reads off the program itself whether a scheme is linear and learns alike in every trial
    (`theory.structure`). What it cannot read off, the scheme says: `estimator_steps` (see
    `frozen`), `clips` (see `limits`), `trials_a_step`; and, where it is made of schemes, `play` and
    `record`.
    """

    __dataclass_fields__: ClassVar[
        dict[str, dataclasses.Field]
    ]  # `@pytree` makes a dataclass of each subclass
    estimator_steps: ClassVar[
        tuple[str, ...]
    ] = ()  # fields that are the step of an estimator: at 0 nothing adapts
    clips: ClassVar[tuple[str, ...]] = ()  # fields that are a limit, which None takes away
    preview: int = 1  # samples of the reference ahead of k that `act` wants to see
    trials_a_step: int = 1  # trials that are run before it learns once

    @property
    def learns(self) -> bool:
        """Whether anything is carried from trial to trial."""
        return type(self).learn is not Scheme.learn

    @property
    def plays_back(self) -> bool:
        """Whether `act` only plays back the table's `u`, whatever happens in the trial."""
        return type(self).act is Scheme.act

    def prepared(self, task: Task) -> Scheme:
        """This scheme with what depends on its weights and the task alone worked out, once, outside
        the scans; parts likewise.
        """
        return self._changed(lambda part: part.prepared(task), {})

    def frozen(self) -> Scheme:
        """The linear law that this scheme starts as: estimators stopped at their start values,
        rules of when to learn left out.
        """
        stopped = {
            name: STOPPED * jnp.ones_like(getattr(self, name)) for name in self.estimator_steps
        }
        return self._changed(lambda part: part.frozen(), stopped)

    def unlimited(self) -> Scheme:
        """This scheme without the limits that it and its parts have."""
        return self._changed(lambda part: part.unlimited(), dict.fromkeys(self.clips))

    def _changed(self, of_part: Callable[[Scheme], Scheme], own: dict[str, Any]) -> Scheme:
        """This scheme with each scheme that it is made of changed, and fields of its own."""
        parts = (
            {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
            if dataclasses.is_dataclass(self)
            else {}
        )
        new = {name: of_part(one) for name, one in parts.items() if isinstance(one, Scheme)} | own
        return dataclasses.replace(self, **new) if new else self

    def initial_memory(self, task: Task) -> Memory:
        """What is known before the first trial."""
        return ()

    def table(self, memory: Memory, task: Task) -> Any:
        """The rows that `act` sees, one a sample."""
        return memory

    def feedforward(self, memory: Memory, task: Task) -> jax.Array:
        """(N, n_u) the learned input that the next trial plays back. Raises ValueError for a scheme
        that learns none.
        """
        table = self.table(memory, task)
        if not hasattr(table, "u"):
            raise ValueError(f"{type(self).__name__} learns no feedforward input")
        return table.u

    def initial_state(self, task: Task) -> State:
        """The state before the first sample of a trial."""
        return ()

    def act(self, state: State, sample: Sample) -> tuple[State, jax.Array]:
        """The input u[k] (n_u,) and the state that goes with it."""
        return state, sample.row.u

    def signals(self, state: State) -> dict[str, jax.Array]:
        """Internal signals worth recording, read off the state after `act`."""
        return {}

    def learn(self, memory: Memory, trial: Trial) -> Memory:
        """What is known after a trial, simulated or measured."""
        return memory

    def limits(self, task: Task, memory: Memory, trial: Trial) -> dict[str, Limit]:
        """By name, what must stay within its bound for the limits of this scheme to change nothing.

        memory, trial: with which a trial was entered, and its record, under the `unlimited` scheme
        A field `limit` is taken to be the largest |u| within a trial; a scheme that limits what it
        learns says so.
        """
        return limit_of(trial.u, getattr(self, "limit", None)) if "limit" in self.clips else {}

    def play(self, learned, memory: Memory, task: Task) -> Any:
        """The `table` of a trial that plays `learned` (of the shape of `feedforward`) in place of
        what was learned.
        """
        return self.table(memory, task)._replace(u=learned)

    def record(self, learned, e, task: Task) -> Trial:
        """The record of a trial that played `learned` with the error e (N+1, n_y), as `learn` takes
        it; a feedback added nothing.
        """
        r = jnp.asarray(task.reference)
        return Trial(r, r - e, learned, task.dt)

    def check(self, task: Task) -> None:
        """Raises ValueError where the scheme cannot do this task."""


def need_square(scheme: Scheme, task: Task) -> None:
    """Raises ValueError unless the task has as many inputs as outputs (schemes that work channel by
    channel).
    """
    if task.inputs != task.outputs:
        raise ValueError(
            f"{type(scheme).__name__} works channel by channel and needs as many inputs as outputs, not {task.inputs} and {task.outputs}; "
            "pick the outputs it shall see with OnOutputs"
        )


def limited(u, limit) -> jax.Array:
    """u within +-limit (no limit: None)."""
    return u if limit is None else jnp.clip(u, -limit, limit)


def limit_of(signal, bound) -> dict[str, Limit]:
    """What `Scheme.limits` returns for a scheme of one field `limit`."""
    return {} if bound is None else {"limit": Limit(signal, bound)}


def limits_below(name: str, limits: dict[str, Limit]) -> dict[str, Limit]:
    """The limits of a part, under its name."""
    return {f"{name}.{path}": limit for path, limit in limits.items()}


def advance(signal, samples: int) -> jax.Array:
    """signal[k + samples] for k = 0..N-1, from a (N+1, n) signal; zero where the trial has ended."""
    return jnp.pad(signal[samples:], ((0, samples - 1), (0, 0))) if samples else signal[:-1]


def delay(signal, samples: int) -> jax.Array:
    """signal[k - samples] of a (N, n) signal; zero before the trial."""
    return signal if samples == 0 else jnp.pad(signal, ((samples, 0), (0, 0)))[:-samples]
