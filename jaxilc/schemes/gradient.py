"""Learning down the gradient of a quadratic cost, by a model of any kind."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..plants import Plant, motion
from ..plants.structure import obstacle
from ..pytree.fields import Leaf, child, leaf, pytree, static
from ..pytree.needs import known, need_channels
from ..signals.task import Limit, Task, Trial
from .curvature import largest_eigenvalue
from .quadratic_cost import need_weight, weights_of
from .scheme import Scheme, limit_of, limited
from .weights import answers_weighed


class GradientMemory(NamedTuple):
    """What `GradientILC` knows.

    u: (N, n_u) next input [unit of u]
    step: () step that was taken after the last trial
    share: () this step as a share of its bound: step h / 2, with the h that was found; 0 before
    beyond: () number of trials after which the step was at its bound or beyond it, share >= 1
    """

    u: jax.Array
    step: jax.Array
    share: jax.Array
    beyond: jax.Array


@pytree
class Ready:
    """A model prepared for a sample time.

    curvature: () largest curvature h of the cost; None where it differs from trial to trial
    dt: sample time [s]
    """

    curvature: Leaf | None = leaf(default=None, optional=True)
    dt: float = static(interval="(0, inf)", default=1.0)


@pytree
class GradientILC(Scheme):
    """Gradient learning (Furuta and Yamakita 1987; Owens, Hatonen and Daley 2009).

    The input goes down the gradient of the cost J = (|e|^2_Wq + |u|^2_Ws) / 2 of the last trial:

        u_{j+1} = u_j + step (G*_j W_q e_j - W_s u_j)

    G_j is the derivative of the model's output by its input, along the motion of the model under
    u_j, and G*_j is its transpose. Both are taken anew after each trial, by one pass forward and
    one backward through the model, so no matrix is made, and time is linear in N. For a linear
    model they are the same in every trial, and then the law is linear: theory reads that off the
    model's own program.

    Let h be the largest eigenvalue of the curvature G* W_q G + W_s. On a linear machine that is the
    model, the cost falls in every trial for 0 < step < 2 / h; on a nonlinear one that is true of
    small steps. h is found by ten steps of the Lanczos process from a fixed start. What they give
    is never above h, and mostly within a percent of it. For a linear model that is done once, and
    else after each trial; the memory then says how the step stands to its bound 2 / h, which moves
    with the trajectory. Other machines than the model are for `theory.certify`.

    model: nominal plant of n_u inputs and n_y outputs, linear or not, of the package or the user's,
        which starts from its own initial state. Under feedback it is the model of the closed loop,
        from the learned input to the output
    step: () the step; None: 1 / h, with the h that was found
    w_q: () or (n_y,) or (n_y, n_y), positive semidefinite
    w_s: () or (n_u,) or (n_u, n_u), positive semidefinite; it forgets, and leaves an error
        Weights must be symmetric except for rounding; their symmetric part is used.
    limit: () or (n_u,) largest |u| that is learned [unit of u]; None: no limit
    solved: leave None

    `check` raises ValueError for a model of other channels or another sample time, for a model
    whose answer is not finite or, if it is linear, zero, and for a step of 2 / h or more, with h
    found at the motion without input. A step that passes may still be beyond the bound elsewhere,
    or by what the Lanczos process missed: see `share` and `beyond` of the memory.
    """

    model: Plant = child()
    step: Leaf | None = leaf(default=None, interval="(0, inf)", optional=True)
    w_q: Leaf = leaf(default=1.0)
    w_s: Leaf = leaf(default=0.0)
    limit: Leaf | None = leaf(default=None, interval="(0, inf)", optional=True)
    solved: Ready | None = child(default=None)
    weighs = True
    clips = ("limit",)

    def __post_init__(self):
        if self.step is not None and self.step.shape:
            raise ValueError(
                f"GradientILC: step has shape {self.step.shape}; allowed is one number"
            )
        need_weight("GradientILC", "w_q", self.w_q, self.model.n_y)
        need_weight("GradientILC", "w_s", self.w_s, self.model.n_u)

    @property
    def of_one_length(self) -> bool:
        """Whether the step, which follows from the curvature, belongs to a number of samples."""
        return self.step is None

    def check(self, task: Task) -> None:
        need_answers(self.model, task)
        need_channels(self, task.inputs, "limit")
        if known(self):
            with jax.ensure_compile_time_eval():
                self._need_step(float(_curvature_at_rest(self, task.N, task.dt)), task)

    def _need_step(self, h: float, task: Task) -> None:
        """Raises ValueError where the largest curvature h at rest admits no step, or not this."""
        name = type(self.model).__name__
        if not np.isfinite(h):
            raise ValueError(
                f"GradientILC: the model ({name}) answers with numbers that are not finite within "
                f"N = {task.N} samples; allowed is a model that is stable, under feedback that of "
                "the closed loop"
            )
        if h <= 0 and not varies(self.model, task.N, task.dt):
            raise ValueError(
                f"GradientILC: within N = {task.N} samples the model ({name}) does not answer its "
                "input, or w_q gives its answer no weight; allowed is a model whose output depends "
                "on its input, with a weight above 0"
            )
        if self.step is not None and float(self.step) * h >= 2:
            raise ValueError(
                f"GradientILC: step = {float(self.step):.6g} is beyond its bound; allowed is a "
                f"step below 2 / |G|^2 = {2 / h:.6g}, with the largest gain |G| = {h**0.5:.6g} of "
                "the model, in the norms of the weights; None takes half of it"
            )

    def initial_memory(self, task: Task) -> GradientMemory:
        none = jnp.zeros(())
        return GradientMemory(jnp.zeros((task.N, task.inputs)), none, none, none)

    def prepared(self, task: Task) -> GradientILC:
        """This scheme with its model sampled, and the curvature of a linear model."""
        return self._prepared(task.N, task.dt)

    def _prepared(self, N: int, dt: float) -> GradientILC:
        if self.solved is not None:
            return self
        h = None if varies(self.model, N, dt) else _curvature_at_rest(self, N, dt)
        return dataclasses.replace(self, model=self.model.sampled(dt), solved=Ready(h, dt))

    def learn(self, memory: GradientMemory, trial: Trial) -> GradientMemory:
        u, e = trial.u, trial.e[1:]
        ready = self._prepared(len(u), trial.dt)
        found: Any = ready.solved
        Q, S = weights_of(ready, "w_q", "w_s")
        # A linear model answers alike at any input, so a diverged one has no part in it.
        at = u if found.curvature is None else jnp.zeros_like(u)
        push, pull = answers_weighed(*answers(ready.model, at, found.dt), trial)
        known = found.curvature is not None and trial.weight is None
        h = found.curvature if known else _curvature(push, pull, Q, S, u)
        step = jnp.where(h > 0, 1.0, 0.0) / jnp.where(h > 0, h, 1.0)
        step = step if self.step is None else self.step
        share = step * h / 2
        return GradientMemory(
            limited(u + step * (pull(e @ Q) - u @ S), self.limit),
            step,
            share,
            memory.beyond + jnp.where(share >= 1, 1.0, 0.0),
        )

    def limits(self, task: Task, memory: GradientMemory, trial: Trial) -> dict[str, Limit]:
        return limit_of(self.unlimited().learn(memory, trial).u, self.limit)


# The model
# --------------------------------------------------------------------------------------------------


def answers(model: Plant, u, dt: float) -> tuple[Callable, Callable]:
    """G and G*, as functions: the derivative of y[1..N] (N, n_y) at the input u (N, n_u)."""
    _, push = jax.linearize(lambda u: motion(model, u, dt)[1:], u)
    transposed = jax.linear_transpose(push, u)
    return push, lambda e: transposed(e)[0]


def _curvature(push: Callable, pull: Callable, Q, S, u):
    """() the largest eigenvalue of G* W_q G + W_s, from below."""
    return largest_eigenvalue(lambda v: pull(push(v) @ Q) + v @ S, u)


@partial(jax.jit, static_argnames=("N", "dt"))
def _curvature_at_rest(scheme: GradientILC, N: int, dt: float):
    """() the largest curvature where the model is not driven."""
    u = jnp.zeros((N, scheme.model.n_u))
    push, pull = answers(scheme.model, u, dt)
    return _curvature(push, pull, *weights_of(scheme, "w_q", "w_s"), u)


def varies(model: Plant, N: int, dt: float) -> bool:
    """Whether the derivative of the model depends on its input, as far as its program tells."""
    return bool(obstacle(lambda model, u: motion(model, u, dt), model, jnp.zeros((N, model.n_u))))


def need_answers(model: Plant, task: Task) -> None:
    """Raises ValueError where the model is of another number of channels or samples, or rate."""
    for what, of_model, of_task in (
        ("inputs", model.n_u, task.inputs),
        ("outputs", model.n_y, task.outputs),
    ):
        if of_model != of_task:
            raise ValueError(f"GradientILC: the model has {of_model} {what} but the task {of_task}")
    model.check(task)
    u = jax.ShapeDtypeStruct((task.N, model.n_u), jnp.zeros(()).dtype)
    y = jax.eval_shape(lambda model, u: motion(model, u, task.dt), model, u)
    if y.shape != (task.N + 1, model.n_y):
        raise ValueError(
            f"GradientILC: the model ({type(model).__name__}) answers with the shape {y.shape}; "
            f"allowed is (N+1, n_y) = ({task.N + 1}, {model.n_y})"
        )
