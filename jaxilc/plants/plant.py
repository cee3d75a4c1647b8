"""What a plant is."""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar

import jax

from ..pytree.fields import need_decorated
from ..signals.task import Task

State = Any


class Plant:
    """A plant steps. Its parameters are the fields of a `@pytree` class; a user's own plant
    subclasses this.

    `step` gets the sample time, so a continuous plant may integrate over it; whatever depends on
    the sample time alone is worked out in `sampled`, which runs once per simulation, outside the
    scans.
    response: `response(u, dt)`, of a plant that knows its outputs y[0..N] (N+1, n_y) from all
    inputs u (N, n_u) at once; asked for
              where the input is known before the trial. None where it can only step.
    """

    __dataclass_fields__: ClassVar[
        dict[str, dataclasses.Field]
    ]  # `@pytree` makes a dataclass of each subclass
    n_u: int = 1
    n_y: int = 1
    response: Any = None

    def __init__(self, *values: Any, **named: Any):
        need_decorated(type(self))

    def sampled(self, dt: float) -> Plant:
        """The plant prepared for sample time dt [s]."""
        return self

    def check(self, task: Task) -> None:
        """Raises ValueError where the plant cannot do this task."""

    def initial_state(self) -> State:
        """The state at rest before the first sample."""
        raise NotImplementedError

    def step(self, x: State, u, dt: float) -> State:
        """The state one sample later under the input u (n_u,), held over the sample."""
        raise NotImplementedError

    def output(self, x: State) -> jax.Array:
        """(n_y,) the output in state x. There is no feedthrough: u[k] acts on y[k+1]."""
        raise NotImplementedError
