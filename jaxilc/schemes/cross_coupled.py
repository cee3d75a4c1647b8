"""Learning from the contour error of two or three axes, beside or in place of their own errors."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import lax

from ..pytree.aliases import Array, Leaf
from ..pytree.fields import child, leaf, pytree
from ..pytree.needs import need_numbers
from ..signals.task import Task, Trial
from .scheme import Scheme, Wrapper, need_no_comparing, need_no_experiments
from .weights import weighed

RESTS = 1e-6  # share of the largest step of a reference, up to which it counts as rest


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

    `check` raises ValueError for a task of one output, and for a scheme that makes experiments or
    compares outputs within the trial (FFDL-MFAILC).
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
        super().check(task)
        need_no_experiments(self, task, "whose errors are not those of the path")
        need_no_comparing(self, task)

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
