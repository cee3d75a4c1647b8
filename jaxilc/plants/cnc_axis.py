"""A CNC axis as identified in Li 2020, and a machine of two axes."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import jax.scipy.linalg

from ..pytree.fields import child, pytree
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
    if form not in coefficients:
        raise ValueError(
            f"cnc_axis: form = {form!r} is not one of {', '.join(map(repr, coefficients))}"
        )
    A = [[2.85, -1.35, coefficients[form]], [2.0, 0.0, 0.0], [0.0, 0.5, 0.0]]
    return StateSpace(A, [[0.25 * gain], [0.0], [0.0]], [[0.19, 0.0, -0.01899]], dt=SAMPLE_TIME)


class AxesState(NamedTuple):
    """The states of the two axes."""

    x: object
    y: object


@pytree
class TwoAxes(Plant):
    """Two axes side by side, each with its inputs and outputs: an XY table whose contour matters.

    x, y: any plants; the inputs and outputs of x come first
    """

    x: Plant = child()
    y: Plant = child()

    @property
    def n_u(self) -> int:
        return self.x.n_u + self.y.n_u

    @property
    def n_y(self) -> int:
        return self.x.n_y + self.y.n_y

    def sampled(self, dt: float) -> TwoAxes:
        return TwoAxes(self.x.sampled(dt), self.y.sampled(dt))

    def continuous(self) -> StateSpace | None:
        x, y = self.x.continuous(), self.y.continuous()
        if x is None or y is None:
            return None
        blocks = [(getattr(x, name), getattr(y, name)) for name in ("A", "B", "C")]
        x0 = jnp.concatenate([x.initial_state(), y.initial_state()])
        A, B, C = (jax.scipy.linalg.block_diag(*pair) for pair in blocks)
        return StateSpace(A, B, C, x0)

    @property
    def input_names(self) -> tuple[str, ...]:
        return _both(self.x.input_names, self.y.input_names)

    @property
    def output_names(self) -> tuple[str, ...]:
        return _both(self.x.output_names, self.y.output_names)

    def initial_state(self) -> AxesState:
        return AxesState(self.x.initial_state(), self.y.initial_state())

    def step(self, x: AxesState, u, dt: float) -> AxesState:
        n = self.x.n_u
        return AxesState(self.x.step(x.x, u[:n], dt), self.y.step(x.y, u[n:], dt))

    def output(self, x: AxesState) -> jax.Array:
        return jnp.concatenate([self.x.output(x.x), self.y.output(x.y)])


def _both(of_x: tuple[str, ...], of_y: tuple[str, ...]) -> tuple[str, ...]:
    """The names of the channels of both axes, none unless both axes name theirs."""
    named = [f"x_{name}" for name in of_x], [f"y_{name}" for name in of_y]
    return (*named[0], *named[1]) if of_x and of_y else ()
