"""A CNC axis as identified in Li 2020, and machines of several axes."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import jax.scipy.linalg

from ..pytree.aliases import Array, Tree
from ..pytree.fields import child, pytree
from ..pytree.ranges import need_one_of
from ..signals.task import Task
from .linear import StateSpace
from .plant import Plant

SAMPLE_TIME = 2e-3  # [s]


def cnc_axis(form: str = "double_integrator", gain: float = 1.0) -> StateSpace:
    """The X axis of Li 2020 from control input to position [mm], sampled at 2 ms.

        printed            x' = [[2.85, -1.35, 0.8502], [2, 0, 0], [0, 0.5, 0]] x + [0.25, 0, 0] u
                           y = [0.19, 0, -0.01899] x    (eq. 3)
        double_integrator  the same with 0.85 for 0.8502

    The poles of the first form, 1.0331, 0.9567 and 0.8602, are unstable, from the rounding of the
    last digit printed. The second is what it stands for: (z - 1)^2 (z - 0.85), a force on a mass
    and a lag of 12.3 ms. Both have CB = 0.0475 and need a feedback.

    gain: relative to the identified one, for a second axis

    Raises ValueError for another form.
    """
    coefficients = {"printed": 0.8502, "double_integrator": 0.85}
    need_one_of("cnc_axis", "form", form, coefficients)
    A = [[2.85, -1.35, coefficients[form]], [2.0, 0.0, 0.0], [0.0, 0.5, 0.0]]
    return StateSpace(A, [[0.25 * gain], [0.0], [0.0]], [[0.19, 0.0, -0.01899]], dt=SAMPLE_TIME)


class Axes(Plant):
    """Axes side by side, each with its inputs and outputs, in the order of the fields.

    The state is the tuple of those of the axes.
    """

    @property
    def axes(self) -> dict[str, Plant]:
        """The axes by name."""
        return {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}

    @property
    def n_u(self) -> int:
        return sum(axis.n_u for axis in self.axes.values())

    @property
    def n_y(self) -> int:
        return sum(axis.n_y for axis in self.axes.values())

    def check(self, task: Task) -> None:
        for axis in self.axes.values():
            axis.check(task)

    def sampled(self, dt: float) -> Axes:
        return type(self)(*(axis.sampled(dt) for axis in self.axes.values()))

    def continuous(self) -> StateSpace | None:
        each = [axis.continuous() for axis in self.axes.values()]
        if any(axis is None for axis in each):
            return None
        A, B, C = (
            jax.scipy.linalg.block_diag(*(getattr(axis, name) for axis in each))
            for name in ("A", "B", "C")
        )
        return StateSpace(A, B, C, jnp.concatenate([axis.initial_state() for axis in each]))

    @property
    def input_names(self) -> tuple[str, ...]:
        return self._names("input_names")

    @property
    def output_names(self) -> tuple[str, ...]:
        return self._names("output_names")

    def _names(self, of: str) -> tuple[str, ...]:
        """The names of the channels of all axes, none unless all axes name theirs."""
        each = [(name, getattr(axis, of)) for name, axis in self.axes.items()]
        if not all(names for _, names in each):
            return ()
        return tuple(f"{axis}_{name}" for axis, names in each for name in names)

    def initial_state(self) -> Tree:
        return tuple(axis.initial_state() for axis in self.axes.values())

    def step(self, x: Tree, u: Array, dt: float) -> Tree:
        after, first = [], 0
        for axis, state in zip(self.axes.values(), x, strict=True):
            after.append(axis.step(state, u[first : first + axis.n_u], dt))
            first += axis.n_u
        return tuple(after)

    def output(self, x: Tree) -> Array:
        return jnp.concatenate(
            [axis.output(state) for axis, state in zip(self.axes.values(), x, strict=True)]
        )


@pytree
class TwoAxes(Axes):
    """Two axes side by side, each with its inputs and outputs: an XY table whose contour matters.

    x, y: any plants; the inputs and outputs of x come first
    """

    x: Plant = child()
    y: Plant = child()


@pytree
class ThreeAxes(Axes):
    """Three axes side by side, each with its inputs and outputs.

    x, y, z: any plants; the inputs and outputs come in this order
    """

    x: Plant = child()
    y: Plant = child()
    z: Plant = child()
