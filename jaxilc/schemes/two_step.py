"""Learning with a nonlinear model in two steps: correct the model, then find the best input."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp

from ..plants import Plant, StateSpace, motion
from ..pytree.aliases import Array, Leaf, Value
from ..pytree.fields import child, leaf, pytree, static
from ..pytree.needs import need_channels
from ..signals.task import Limit, Task, Trial
from .constrained_norm_optimal import limits_of_rows
from .constraints import bounds_where_measured, need_feasible, rows_of
from .gauss_newton import Problem, optimum
from .quadratic_cost import (
    need_convex,
    need_definite,
    need_model_of,
    need_weight,
    need_weights,
    symmetric_of,
    weights_of,
)
from .scheme import Scheme
from .weights import WeighedOutput, output_weighed


class TwoStepMemory(NamedTuple):
    """What `TwoStep` knows.

    u: (N, n_u) next input [unit of u]
    alpha: (N, n_u) or (N, n_y) correction of the model, at its input or at its output
    converged: () 1 where both steps of the last trial were solved, else 0; u is then that of the
        trial before
    unsolved: () number of trials after which a step was not solved
    estimation_steps, control_steps: () iterations of the two steps after the last trial
    moved: () the last iteration, as a share of the root of the cost; the larger of the two steps
    violation: () largest distance of what was found last beyond a bound, by the corrected model, in
        units of the largest bound of its kind; u is not that where a step was not solved
    """

    u: Array
    alpha: Array
    converged: Array
    unsolved: Array
    estimation_steps: Array
    control_steps: Array
    moved: Array
    violation: Array


@pytree
class TwoStep(Scheme):
    """Two-step learning with a nonlinear model (Volckaert, Diehl, Swevers 2013).

    After each trial with the input u and the output y, a correction alpha of the model f is
    estimated, and then the input u' is found that is best for the corrected model:

        alpha = argmin |y - f(u, alpha)|^2_Wy + |alpha|^2_Wa + |D alpha|^2_Wc
        u' = argmin |r - f(u', alpha)|^2_Wq + |u' - u|^2_Wr + |u'|^2_Ws

        subject to  |u'| <= limit,  |u'[k] - u'[k-1]| <= rate dt,
                    y_low <= f(u', alpha) <= y_high,  |r - f(u', alpha)| <= tube

    where (D alpha)[k] = alpha[k] - alpha[k-1]. The correction is added to the model's input,
    f(u, alpha) = f(u + alpha), or to its output, f(u) + alpha. The input of the first trial is
    already that of the second step, with alpha = 0 and u = 0.

    Both steps are solved by Gauss and Newton's method with Riccati steps along the motion of the
    model (see `gauss_newton`), in time and memory linear in N. The model may be unstable, as a
    pendulum that stands upright, because the solver never trusts an input alone to follow a motion.
    As all local methods it finds the optimum next to where it starts, which need not be the best.
    It needs a model with derivatives: where friction or hysteresis switches with the sign of a
    speed, the iterations may end at the kink, without an optimum.

    Where the bounds cannot be met, or a step does not reach its tolerance, the input of the trial
    before stays, and the memory says so: `converged` of the last trial, `unsolved` for all. Bounds
    on the output hold for the corrected model; the machine may leave them. The result may be
    differentiated once, in weights, bounds and model.

    model: any plant of n_u inputs and n_y outputs, where u[k] acts on y[k+1] or later. Under
        feedback it is the model of the closed loop
    correction: `input` or `output`, where the model is corrected
    w_y: () or (n_y,) or (n_y, n_y), positive semidefinite
    w_alpha, w_change: () or (n,) or (n, n) for n values of alpha a sample, positive semidefinite;
        their sum positive definite. w_change smooths alpha where y is noisy
    w_q: () or (n_y,) or (n_y, n_y), positive semidefinite
    w_r, w_s: () or (n_u,) or (n_u, n_u), positive semidefinite; w_r + w_s positive definite. They
        may be tiny: the model is then inverted as exactly as the bounds allow
    limit: () or (n_u,) largest |u| that is learned [unit of u]
    rate: () or (n_u,) largest |du/dt| that is learned, from u[-1] = 0 on [unit of u/s]
    y_low, y_high: () or (n_y,) or (N+1, n_y) bounds of the output, may be infinite [unit of y]
    tube: () or (n_y,) or (N+1, n_y) largest |error|, may be infinite [unit of y]

    Raises ValueError for weights that are not symmetric or not semidefinite, for a model of other
    channels than the task, and for bounds that leave nothing or exclude the start of the model.
    """

    model: Plant = child()
    w_y: Leaf = leaf(default=1.0)
    w_alpha: Leaf = leaf(default=0.0)
    w_change: Leaf = leaf(default=0.0)
    w_q: Leaf = leaf(default=1.0)
    w_r: Leaf = leaf(default=0.0)
    w_s: Leaf = leaf(default=0.0)
    limit: Leaf | None = leaf(default=None, interval="(0, inf)", optional=True)
    rate: Leaf | None = leaf(default=None, interval="(0, inf)", optional=True)
    y_low: Leaf | None = leaf(default=None, interval="[-inf, inf)", optional=True)
    y_high: Leaf | None = leaf(default=None, interval="(-inf, inf]", optional=True)
    tube: Leaf | None = leaf(default=None, interval="(0, inf]", optional=True)
    correction: str = static(default="input", choices=("input", "output"))
    first_derivatives_only = True
    weighs = True
    clips = ("limit", "rate", "y_low", "y_high", "tube")

    def __post_init__(self) -> None:
        need_convex(self)
        need_weights(self, "w_y")
        of_alpha = {"w_alpha": self.w_alpha, "w_change": self.w_change}
        for name, weight in of_alpha.items():
            need_weight("TwoStep", name, weight, self._corrections)
        need_definite("TwoStep", of_alpha, self._corrections)

    @property
    def _corrections(self) -> int:
        """Number of values of alpha a sample."""
        return self.model.n_u if self.correction == "input" else self.model.n_y

    def check(self, task: Task) -> None:
        need_model_of(self, task)
        self.model.check(task)
        need_channels(self, task.inputs, "limit", "rate")
        need_feasible(self, task)

    def initial_memory(self, task: Task) -> TwoStepMemory:
        return _first(self, jnp.asarray(task.reference), float(task.dt))

    def learn(self, memory: TwoStepMemory, trial: Trial) -> TwoStepMemory:
        dt, u = trial.dt, trial.u
        model = self.model.sampled(dt)
        estimated = optimum(self._estimation(model, trial), memory.alpha, dt)
        alpha = jnp.where(estimated.converged > 0, estimated.w, memory.alpha)
        # from here the corrected model follows what it was to follow before
        start = u + memory.alpha - alpha if self.correction == "input" else u
        found = optimum(_seen(self._control(model, trial.r, u, alpha), trial), start, dt)
        good = estimated.converged * found.converged
        return TwoStepMemory(
            jnp.where(good > 0, found.w, memory.u),
            alpha,
            good,
            memory.unsolved + 1 - good,
            estimated.steps,
            found.steps,
            jnp.maximum(estimated.moved, found.moved),
            found.violation,
        )

    def _estimation(self, model: Plant, trial: Trial) -> Problem:
        """The problem of the first step, with alpha as its unknown."""
        size, y, u = self._corrections, trial.y, trial.u
        none = jnp.zeros((len(u), size), y.dtype)
        weights = (self.w_y, self.model.n_y), (self.w_alpha, size), (self.w_change, size)
        Q, S, change = (symmetric_of(weight, n) for weight, n in weights)
        added, beside = u, jnp.zeros_like(y)
        if self.correction == "output":
            # what alpha does to the output: it is the output, one sample later
            added, beside = none, motion(model, u, trial.dt)
            model = _delay(size, y.dtype, trial.dt)
        problem = Problem(model, y, none, added, beside, Q, jnp.zeros_like(S), S, change)
        return _seen(problem, trial)

    def _control(self, model: Plant, r: Array, u: Array, alpha: Array) -> Problem:
        """The problem of the second step, with the next input as its unknown."""
        Q, R, S = weights_of(self, "w_q", "w_r", "w_s")
        added, beside = alpha, jnp.zeros_like(r)
        if self.correction == "output":
            added, beside = jnp.zeros_like(u), beside.at[1:].set(alpha)
        bounds = (self.limit, self.rate, self.y_low, self.y_high, self.tube)
        return Problem(model, r, u, added, beside, Q, R, S, None, *bounds)

    def limits(self, task: Task, memory: TwoStepMemory, trial: Trial) -> dict[str, Limit]:
        following = self.unlimited().learn(memory, trial)
        model = self.model.sampled(trial.dt)
        problem = self._control(model, trial.r, trial.u, following.alpha)
        y = motion(model, following.u + problem.added, trial.dt) + problem.beside
        return limits_of_rows(self, rows_of(problem, Trial(trial.r, y, following.u, trial.dt)))


@partial(jax.jit, static_argnums=2)
def _first(scheme: TwoStep, r: Array, dt: float) -> TwoStepMemory:
    """The memory before the first trial, with the best input of the model as it is."""
    u = jnp.zeros((len(r) - 1, scheme.model.n_u), r.dtype)
    alpha = jnp.zeros((len(u), scheme._corrections), r.dtype)
    found = optimum(scheme._control(scheme.model.sampled(dt), r, u, alpha), u, dt)
    zero, good = jnp.zeros((), r.dtype), found.converged
    return TwoStepMemory(
        found.w, alpha, good, 1 - good, zero, found.steps, found.moved, found.violation
    )


def _seen(problem: Problem, trial: Trial) -> Problem:
    """The problem with the outputs as the weight of the trial shows them."""
    if trial.weight is None:
        return problem
    beside = output_weighed(trial, problem.beside)
    model = WeighedOutput(problem.model, trial.weight)
    return problem._replace(model=model, beside=beside, **bounds_where_measured(problem, trial))


def _delay(size: int, dtype: Value, dt: float) -> StateSpace:
    """The plant whose output is its input of the sample before."""
    eye = jnp.eye(size, dtype=dtype)
    return StateSpace(jnp.zeros_like(eye), eye, eye, dt=dt)
