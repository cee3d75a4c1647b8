"""What a plant is."""

from __future__ import annotations

import dataclasses
from typing import ClassVar, Self, TypeAlias

from ..pytree.aliases import Array, Tree, Value
from ..pytree.fields import need_decorated
from ..signals.task import Task

State: TypeAlias = Tree


class Plant:
    """A plant steps: it turns its state and an input into its next state, sample by sample.

    Its parameters are the fields of a `@pytree` class; a user's own plant is a subclass. `step`
    gets the sample time, so that a continuous plant can integrate over it. Whatever depends on the
    sample time alone is worked out in `sampled`, which runs once per simulation, outside the scans.

    n_u, n_y: number of inputs and of outputs
    response: `response(u, dt)` of a plant that knows its outputs y[0..N] (N+1, n_y) from all inputs
              u (N, n_u) at once. It is asked for where the input is known before the trial. None is
              a plant that can only step.
    input_names, output_names: names of the channels for `to_control`; empty for numbered ones
    """

    # `@pytree` makes a dataclass of each subclass
    __dataclass_fields__: ClassVar[dict[str, dataclasses.Field[Value]]]
    n_u: int = 1
    n_y: int = 1
    response: Value = None
    input_names: tuple[str, ...] = ()
    output_names: tuple[str, ...] = ()

    def __init__(self, *values: Value, **named: Value) -> None:
        need_decorated(type(self))

    def sampled(self, dt: float) -> Plant:
        """The plant prepared for sample time dt [s]."""
        return self

    def continuous(self) -> Tree:
        """The continuous `StateSpace` of a linear plant that has one; None for other plants.

        A plant that has nonlinear parts may return its linear form without them.
        """
        return None

    def check(self, task: Task) -> None:
        """Raises ValueError where the plant cannot do this task."""

    def initial_state(self) -> State:
        """The state at rest before the first sample."""
        raise NotImplementedError

    def step(self, x: State, u: Array, dt: float) -> State:
        """The state one sample later under the input u (n_u,), held over the sample."""
        raise NotImplementedError

    def output(self, x: State) -> Array:
        """(n_y,) the output in state x. There is no feedthrough: u[k] acts on y[k+1]."""
        raise NotImplementedError


class Around(Plant):
    """A plant around another one, its field `plant`, whose channels and checks are its own."""

    plant: Plant

    @property
    def n_u(self) -> int:
        return self.plant.n_u

    @property
    def n_y(self) -> int:
        return self.plant.n_y

    @property
    def input_names(self) -> tuple[str, ...]:
        return self.plant.input_names

    @property
    def output_names(self) -> tuple[str, ...]:
        return self.plant.output_names

    def check(self, task: Task) -> None:
        self.plant.check(task)

    def sampled(self, dt: float) -> Self:
        return dataclasses.replace(self, plant=self.plant.sampled(dt))
