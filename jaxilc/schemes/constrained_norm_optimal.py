"""Norm-optimal learning within bounds on the input, its rate, the output and the contour."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from ..plants import StateSpace, TimeVaryingStateSpace
from ..pytree.aliases import Array, Leaf, Tree
from ..pytree.fields import child, leaf, pytree
from ..pytree.needs import need_channels, need_numbers
from ..pytree.ranges import brief
from ..signals.task import Limit, Task, Trial
from .constraints import (
    Rows,
    bounds_where_measured,
    need_feasible,
    rows_of,
    side_by_side,
    system_of,
    weight_of,
)
from .interior_point import Problem, solve
from .quadratic_cost import need_convex, need_model_of, need_stable, need_weights, weights_of
from .riccati import Factor, factor, newton
from .scheme import Scheme
from .weights import model_weighed

FIELDS = {"input": ("limit",), "output": ("y_low", "y_high", "tube")}  # where others than its kind
ONE_SIDED = 1e6  # how far away the other side of a bound from one side is taken to be, for theory


class ConstrainedMemory(NamedTuple):
    """What `ConstrainedNormOptimal` knows.

    u: (N, n_u) next input [unit of u]
    converged: () 1 where the last optimum was found, else 0; u is then that of the trial before
    unsolved: () number of trials after which no optimum was found
    steps: () iterations after the last trial; 0 where no bound matters
    gap, stationarity, violation: () residuals after the last trial, see `interior_point.Solution`
    """

    u: Array
    converged: Array
    unsolved: Array
    steps: Array
    gap: Array
    stationarity: Array
    violation: Array


@pytree
class ConstrainedNormOptimal(Scheme):
    """Norm-optimal learning within bounds, which are part of the problem that is solved.

    The next input u' = u + d minimises, with the gradient g of the cost J of `NormOptimal` at d = 0
    (Liao-McPherson, Balta, Rupenyan, Lygeros 2022, arXiv 2203.05291),

        |H d|^2_Wq + |d|^2_Wr + |d|^2_Ws + |D d|^2_Wd + step g' d       (D d)[k] = d[k] - d[k-1]

        subject to  |u'| <= limit,  |u'[k] - u'[k-1]| <= rate dt,  |u' + f'| <= total,
                    y_low <= y' <= y_high,  |r - y'| <= tube,  |contour error| <= contour

    With step = 1 this is the cost of the next trial, J plus |D u'|^2_Wd. y' = y + H d is what
    the model predicts, from the output y that was measured. On a machine that is not the model,
    the output may therefore leave its bounds; the input never does, as far as the scheme commands.
    `y_low` and `y_high` bind no sample that was not measured, whose output is not known.

    An interior point with Riccati steps solves it in time and memory linear in N; see
    `interior_point` for its accuracy. Where the bounds cannot be met together, or the tolerances
    are not, the input of the trial before stays, and the memory says so: `converged` of the last
    trial, `unsolved` for all. Where the bounds could be met, its `violation` is within 1e-8: then
    rounding kept the optimum away, as it may where more bounds are active than there are inputs and
    weights are small; a larger `w_r` helps. Nothing is clipped. A filter around this scheme knows
    no bounds but `limit`, to which it clips. The result may be differentiated once, in weights,
    bounds and model.

    As long as no bound matters, the law is that of `NormOptimal`, and certificates claim the same
    of it. In a trial in which a bound matters, the law is another one, which depends on the bounds
    that are active: of the long run nothing is then claimed, and the certificate names the bound.

    model: nominal model of n_u inputs and n_y outputs, as for `NormOptimal`
    w_q: () or (n_y,) or (n_y, n_y), positive semidefinite
    w_r, w_s, w_d: () or (n_u,) or (n_u, n_u), positive semidefinite; w_r + w_s positive definite
    step: () 1 goes to the optimum as predicted; less is more robust, and slower
    limit: () or (n_u,) largest |u| that is learned [unit of u]
    rate: () or (n_u,) largest |du/dt| that is learned, from u[-1] = 0 on [unit of u/s]
    total: () or (n_u,) largest input, with the contribution f of the feedback [unit of u]; it needs
        `WithFeedback` around this scheme
    y_low, y_high: () or (n_y,) or (N+1, n_y) bounds of the output, may be infinite [unit of y]
    tube: () or (n_y,) or (N+1, n_y) largest |error|, may be infinite [unit of y]
    contour: () largest error across the path of two outputs, by the normal of the reference at the
        same sample; no bound where the reference stands still [unit of y]
    feedback: (n_u, n) contribution of the feedback from the state of the model, f[k] = F x[k]
    solved: leave None

    Raises ValueError as `NormOptimal`, and for bounds that leave nothing, exclude the start of the
    model, or lack what they need.
    """

    model: StateSpace | TimeVaryingStateSpace = child()
    w_q: Leaf = leaf(default=1.0)
    w_r: Leaf = leaf(default=0.0)
    w_s: Leaf = leaf(default=0.0)
    w_d: Leaf | None = leaf(default=None, optional=True)
    step: Leaf = leaf(default=1.0, interval="(0, 2)")
    limit: Leaf | None = leaf(default=None, interval="(0, inf)", optional=True)
    rate: Leaf | None = leaf(default=None, interval="(0, inf)", optional=True)
    total: Leaf | None = leaf(default=None, interval="(0, inf)", optional=True)
    y_low: Leaf | None = leaf(default=None, interval="[-inf, inf)", optional=True)
    y_high: Leaf | None = leaf(default=None, interval="(-inf, inf]", optional=True)
    tube: Leaf | None = leaf(default=None, interval="(0, inf]", optional=True)
    contour: Leaf | None = leaf(default=None, interval="(0, inf)", optional=True)
    feedback: Leaf | None = leaf(default=None, optional=True)
    solved: Tree = child(default=None)
    first_derivatives_only = True
    weighs = True
    clips = ("limit", "rate", "total", "y_low", "y_high", "tube", "contour")

    def __post_init__(self) -> None:
        owner, model = type(self).__name__, self.model
        if not isinstance(self.solved, Factor | None):
            raise ValueError(
                f"{owner}: solved = {brief(self.solved)} is a {type(self.solved).__name__}; "
                "allowed is None"
            )
        need_convex(self)
        need_stable(self)
        if self.w_d is not None:
            need_weights(self, "w_d")
        n = model.A.shape[-1]
        if self.feedback is not None and self.feedback.shape != (model.n_u, n):
            raise ValueError(
                f"{owner}: feedback has shape {self.feedback.shape}; allowed is ({model.n_u}, {n}),"
                " from the state of the model to the input"
            )
        if self.total is not None and self.feedback is None:
            raise ValueError(
                f"{owner}: total needs feedback, the matrix from the state of the model to the "
                "contribution of the feedback"
            )
        need_numbers(self, "step", "contour")
        if self.contour is not None and model.n_y != 2:
            raise ValueError(
                f"{owner}: contour is for a path of two outputs, but the model has {model.n_y}; "
                "allowed is tube, which bounds each of them"
            )

    def check(self, task: Task) -> None:
        need_model_of(self, task)
        need_channels(self, task.inputs, "limit", "rate", "total")
        need_feasible(self, task)

    def initial_memory(self, task: Task) -> ConstrainedMemory:
        none = jnp.zeros(())
        return ConstrainedMemory(
            jnp.zeros((task.N, task.inputs)), jnp.ones(()), none, none, none, none, none
        )

    def prepared(self, task: Task) -> ConstrainedNormOptimal:
        return self._prepared(jnp.asarray(task.reference), task.dt)

    def _prepared(self, r: Array, dt: float) -> ConstrainedNormOptimal:
        if self.solved is not None:
            return self
        ready = dataclasses.replace(self, model=self.model.sampled(dt))
        W = weight_of(ready, ready._weights())
        nothing = jnp.zeros((len(r) - 1, len(W)), W.dtype)
        return dataclasses.replace(ready, solved=factor(system_of(ready, r), W, nothing))

    def _for(self, trial: Trial) -> ConstrainedNormOptimal:
        """This scheme prepared for a trial, with the outputs of its model as they count there."""
        ready = self._prepared(trial.r, trial.dt)
        if trial.weight is None:
            return ready
        bounds: Tree = bounds_where_measured(ready, trial)
        model = model_weighed(ready.model, trial)
        seen = dataclasses.replace(ready, model=model, solved=None, **bounds)
        return seen._prepared(trial.r, trial.dt)

    def _weights(self) -> tuple[Array, ...]:
        """w_q, w_r, w_s and w_d as matrices."""
        rest = jnp.zeros((self.model.n_u,) * 2)
        rate = rest if self.w_d is None else weights_of(self, "w_d")[0]
        return *weights_of(self, "w_q", "w_r", "w_s"), rate

    def learn(self, memory: ConstrainedMemory, trial: Trial) -> ConstrainedMemory:
        if self.total is not None and "beside" not in trial.signals:
            raise ValueError(
                "ConstrainedNormOptimal: total bounds the input with that of a feedback; allowed "
                "is a scheme within WithFeedback"
            )
        ready = self._for(trial)
        if all(getattr(self, name) is None for name in self.clips):
            d, _ = ready._free(trial)
            good, none = jnp.ones(()), jnp.zeros(())
            return ConstrainedMemory(trial.u + d, good, memory.unsolved, none, none, none, none)
        found = solve(ready._problem(trial), ready.solved)
        u = jnp.where(found.converged > 0, trial.u + found.d, memory.u)
        return ConstrainedMemory(
            u,
            found.converged,
            memory.unsolved + 1 - found.converged,
            found.steps,
            found.gap,
            found.stationarity,
            found.violation,
        )

    def _free(self, trial: Trial) -> tuple[Array, Array]:
        """The change of the input and that of the rows, without bounds."""
        return newton(
            system_of(self, trial.r), self.solved, self._slope(rows_of(self, trial), trial)
        )

    def _slope(self, rows: dict[str, Rows], trial: Trial) -> Array:
        """(N, m) the derivative of the cost by a change of the rows, at none."""
        Q, _, S, rate = self._weights()
        of = {"input": trial.u @ S, "output": -trial.e[1:] @ Q}
        if "rate" in rows:
            of["rate"] = rows["rate"].now @ rate
        of |= {name: jnp.zeros_like(rows[name].now) for name in rows if name not in of}
        return self.step * jnp.concatenate([of[name] for name in rows], axis=1)

    def _problem(self, trial: Trial) -> Problem:
        rows = rows_of(self, trial)
        now, low, high = side_by_side(rows)
        Q, _, S, rate = self._weights()
        e, u = trial.e[1:], trial.u
        cost = jnp.sum(e * (e @ Q)) + jnp.sum(u * (u @ S))
        if "rate" in rows:
            cost += jnp.sum(rows["rate"].now * (rows["rate"].now @ rate))
        return Problem(
            system_of(self, trial.r),
            weight_of(self, self._weights()),
            self._slope(rows, trial),
            low - now,
            high - now,
            # not below zero at the optimum, for any step
            self.step * jnp.maximum(self.step, 1.0) * cost / 2,
        )

    def limits(self, task: Task, memory: Tree, trial: Trial) -> dict[str, Limit]:
        ready = self._for(trial)
        rows, (_, change) = rows_of(ready, trial), ready._free(trial)
        ends = np.cumsum([of.now.shape[1] for of in rows.values()])[:-1]
        changes = zip(rows.items(), jnp.split(change, ends, axis=1), strict=True)
        return limits_of_rows(self, {n: of._replace(now=of.now + by) for (n, of), by in changes})


def limits_of_rows(scheme: Scheme, rows: dict[str, Rows]) -> dict[str, Limit]:
    """What `Scheme.limits` returns for the rows of the next trial, by kind."""
    found = {}
    for name, of in rows.items():
        fields = FIELDS.get(name, (name,))
        if any(getattr(scheme, field) is not None for field in fields):
            found["limit" if name == "input" else name] = _as_limit(*of)
    return found


def _as_limit(signal: Array, low: Array, high: Array) -> Limit:
    """The bounds as one on a size, 1, whichever side there is."""
    size = jnp.maximum(*(jnp.where(jnp.isfinite(b), jnp.abs(b), 0.0) for b in (low, high)))
    far = ONE_SIDED * (1.0 + size)
    none = ~jnp.isfinite(low) & ~jnp.isfinite(high)
    below = jnp.where(jnp.isfinite(low), low, jnp.where(none, -far, high - far))
    above = jnp.where(jnp.isfinite(high), high, jnp.where(none, far, low + far))
    middle, half = (below + above) / 2, (above - below) / 2
    return Limit(jnp.where(none, 0.0, (signal - middle) / half), jnp.ones(()))
