"""Errors that do not count alike: the weight of a record, what laws with a model make of it, and
learning from the contour error of two or three axes, beside or in place of their own errors.

A wrapper that lets some errors count less, or turns them to the normal of a path, shows its scheme

    e'[k] = W[k] e[k],    by the output  y' = r - W (r - y),  with `Trial.weight` = W

A law without a model learns from e' as from any error. A law with a model predicts e', by what its
model answers times W (H -> W H), so that it makes use of the motion where errors do not count.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import lax

from ..plants import Plant, StateSpace, TimeVaryingStateSpace
from ..plants.plant import Around
from ..pytree.aliases import Array, Function, Leaf, Tree
from ..pytree.fields import child, leaf, pytree
from ..pytree.needs import need_numbers
from ..signals.task import Task, Trial
from .scheme import Scheme, Wrapper, need_no_experiments, with_all_parts

BOUNDS = ("y_low", "y_high", "tube", "contour")  # of outputs


def weighed(trial: Trial, W: Array) -> Trial:
    """The trial with the errors W e, on top of a weight that it has already.

    W: (N+1, n_y, n_y), or (N+1, n_y) for a weight of each output by itself
    """
    W = W if W.ndim == 3 else W[:, :, None] * jnp.eye(W.shape[1], dtype=W.dtype)
    before = trial.weight
    return trial._replace(
        y=trial.r - jnp.einsum("kij,kj->ki", W, trial.e), weight=W if before is None else W @ before
    )


def output_weighed(trial: Trial, y: Array) -> Array:
    """(N+1, n_y) an output y of a model as the weight of the trial shows it."""
    if trial.weight is None:
        return y
    return trial.r - jnp.einsum("kij,kj->ki", trial.weight, trial.r - y)


def model_weighed(model: Tree, trial: Trial) -> Tree:
    """The linear model, sampled, from the input to the outputs as the weight shows them."""
    if trial.weight is None:
        return model
    N, W = len(trial.u), trial.weight[1:]
    if isinstance(model, StateSpace):
        A, B, C = (jnp.broadcast_to(M, (N, *M.shape)) for M in (model.A, model.B, model.C))
    else:
        A, B, C = model.A, model.B, model.C
    return TimeVaryingStateSpace(A, B, W @ C, dt=model.dt)


def answers_weighed(push: Function, pull: Function, trial: Trial) -> tuple[Function, Function]:
    """The linear maps G and G* of a model, as the weight of the trial shows its output."""
    if trial.weight is None:
        return push, pull
    W = trial.weight[1:]
    return (
        lambda u: jnp.einsum("kij,kj->ki", W, push(u)),
        lambda e: pull(jnp.einsum("kij,ki->kj", W, e)),
    )


def counts_at_all(trial: Trial) -> Array | float:
    """(N, n_y) whether the error of each sample from k = 1 on counts; 1 without a weight."""
    if trial.weight is None:
        return 1.0
    return jnp.where(jnp.any(trial.weight[1:] != 0, axis=2), 1.0, 0.0)


def need_no_true_outputs(
    wrapper: Wrapper, task: Task, why: str, found: str = "", instead: str = "is"
) -> None:
    """Raises ValueError where a part of the scheme needs the outputs as the machine gives them.

    Such are those that bound outputs, weigh their jerk, or compare them within the trial.

    why: what a bound would do
    found, instead: what of the wrapper does not allow it, and what is allowed instead
    """
    for part, _, _ in with_all_parts(wrapper.scheme, task):
        owner, of = f"{type(wrapper).__name__}: {found}", type(part).__name__
        for name in BOUNDS:
            if name in part.clips and getattr(part, name) is not None:
                raise ValueError(
                    f"{owner}{name} of {of} bounds the output, which {why}; allowed {instead} "
                    f"{name} = None, with bounds of the input in its place"
                )
        jerk_time = getattr(part, "jerk_time", None)
        if jerk_time is not None:
            raise ValueError(
                f"{owner}jerk_time = {jerk_time} of {of} weighs the jerk of the outputs, which it "
                f"would not be shown as they are; allowed {instead} jerk_time = None"
            )
        for name in part.compares:
            if getattr(part, name):
                raise ValueError(
                    f"{owner}{name} = {getattr(part, name)} of {of}, which compares outputs within "
                    f"the trial; allowed {instead} {name} = 0"
                )


@pytree
class WeighedOutput(Around):
    """A plant whose outputs are seen by a weight, W[k] y[k].

    weight: (N+1, n_y, n_y)
    """

    plant: Plant = child()
    weight: Leaf = leaf()

    def initial_state(self) -> Tree:
        """The number of the sample, as a float, and the state of the plant."""
        return jnp.zeros_like(self.weight, shape=()), self.plant.initial_state()

    def step(self, x: Tree, u: Array, dt: float) -> Tree:
        return x[0] + 1.0, self.plant.step(x[1], u, dt)

    def output(self, x: Array) -> Array:
        return self.weight[x[0].astype(int)] @ self.plant.output(x[1])


RESTS = 1e-6  # share of the largest step of a reference, up to which it counts as rest


# Learning from the contour error
# --------------------------------------------------------------------------------------------------


@pytree
class CrossCoupled(Wrapper):
    """Cross-coupled learning: a scheme learns from the contour error too (Barton, Alleyne 2008).

        e~_j = own e_j + contour (I - t t') e_j

    t is the unit tangent of the reference at the sample, so (I - t t') e is the part of the error
    across the path, the linear contour error as a vector. In the plane it is n eps with the normal
    n = (-sin theta, cos theta) and eps = -sin theta e_x + cos theta e_y, and P-type learning is

        u_{x,j+1} = u_{x,j} + gamma (own e_x - contour sin theta eps)
        u_{y,j+1} = u_{y,j} + gamma (own e_y + contour cos theta eps)

    The scheme inside sees an output whose error is e~, and learns as it does from any error. A law
    with a model, such as `NormOptimal`, predicts e~ too, and so minimises |e~|^2_Wq. With
    own = 0 it does not learn what lies along the path, so a lag there stays: learning may be
    certified to converge, and the error that is left at the limit includes the lag.

    scheme:  any scheme that learns from the error of two or three axes
    contour: () weight of the error across the path
    own:     () weight of the whole error

    Where the reference rests, t is that of the motion before, or of the first motion after; slower
    than a millionth of its largest step counts as rest. Where it never moves, the whole error
    counts as across. The tangent is that of the reference at sample
    k, not of the nearest point of the path: a lag of s along a path of radius R adds s^2 / (2 R).
    The metrics `contour_max` and `contour_rms` look for the nearest point.

    `check` raises ValueError for a task of one output, and for a scheme that makes experiments,
    compares outputs within the trial (FFDL-MFAILC), weighs their jerk (`jerk_time`) or bounds them.
    """

    scheme: Scheme = child()
    contour: Leaf = leaf(default=1.0, interval="[0, inf)")
    own: Leaf = leaf(default=1.0, interval="[0, inf)")

    def check(self, task: Task) -> None:
        need_numbers(self, "contour", "own")
        if task.outputs not in (2, 3):
            raise ValueError(
                f"CrossCoupled: the task has {task.outputs} outputs; allowed are the 2 or 3 axes "
                "of a path"
            )
        need_no_true_outputs(self, task, "would hold for e~ in place of the error")
        super().check(task)
        need_no_experiments(self, task, "whose errors are not those of the path")

    def shown(self, trial: Trial) -> dict[str, Trial]:
        t, eye = tangents(trial.r), jnp.eye(trial.r.shape[1])
        P = eye - t[:, :, None] * t[:, None, :]
        return {"scheme": weighed(trial, self.own * eye + self.contour * P)}


def across(e: Array, r: Array) -> Array:
    """(N+1, d) the part of errors e (N+1, d) that is perpendicular to the reference r (N+1, d)."""
    t = tangents(r)
    return e - t * jnp.sum(t * e, axis=-1, keepdims=True)


def tangents(r: Array) -> Array:
    """(N+1, d) unit tangents of a path r (N+1, d), zero where it never moves.

    They are central differences, one-sided at the ends. A sample at rest has the tangent of the
    last motion before it, or of the first one after it.
    """
    ends = jnp.concatenate([r[:1], r, r[-1:]])
    step = ends[2:] - ends[:-2]
    squared = jnp.sum(step**2, axis=-1)
    moving = squared > RESTS**2 * jnp.max(squared)
    t = step / jnp.sqrt(jnp.where(moving, squared, 1.0))[:, None]
    last = len(r) - 1
    k = np.arange(last + 1)
    before = lax.cummax(jnp.where(moving, k, -1))
    after = lax.cummin(jnp.where(moving, k, last + 1), reverse=True)
    return t[jnp.where(before >= 0, before, jnp.minimum(after, last))]
