"""Contour learning: the error across the path beside the errors of the axes, or in their place."""

from __future__ import annotations

import jax.numpy as jnp

from ..pytree.fields import Leaf, child, leaf, pytree, static
from ..signals.contour import to_the_path
from ..signals.task import Task, Trial
from .scheme import Scheme
from .weights import weighed
from .wrapper import Wrapper


@pytree
class OnContour(Wrapper):
    """A scheme that learns from the cross-coupled error of axes (Barton and Alleyne 2008).

        e'[k] = own e[k] + contour (I - t t') e[k],    t: unit tangent of the reference at sample k

    In the plane (I - t t') e = n eps with the normal n = (-sin, cos) of the direction of motion and
    the contour error eps = -sin e_x + cos e_y, so each axis learns from own e_x - contour sin eps.
    own = 1 puts the contour error beside the axes' own, own = 0 in their place: then nothing is
    done against a lag along the path, which the workpiece does not show. Where the reference stands
    still, all of its error counts as one of the contour.

    A law with a model predicts the same combination: `NormOptimal` then minimises |e'|^2_Wq.

    scheme: any scheme that learns from the error
    own: () weight of the error of the axes
    contour: () weight of the contour error
    estimate: "normal" takes the contour error by the normal above, exact for small errors; the law
        stays as linear as the scheme is. "nearest" takes the vector from y to the nearest place of
        the path of the reference, exact for errors of any size, also at corners
    window: half width of the part of the path that is searched for the nearest place [samples]
    `check` raises ValueError for a task of one or of more than three outputs.
    """

    scheme: Scheme = child()
    own: Leaf = leaf(default=1.0, interval="[0, inf)")
    contour: Leaf = leaf(default=1.0, interval="[0, inf)")
    estimate: str = static(default="normal", choices=("normal", "nearest"))
    window: int = static(default=64, interval="[1, inf)", whole=True)

    def __post_init__(self):
        for name in ("own", "contour"):
            shape = getattr(self, name).shape
            if shape:
                raise ValueError(f"OnContour: {name} has shape {shape}; allowed is one number")

    def check(self, task: Task) -> None:
        if task.outputs not in (2, 3):
            raise ValueError(
                f"OnContour: the task has {task.outputs} outputs; allowed are the two or three "
                "axes of a path"
            )
        super().check(task)

    def shown(self, trial: Trial) -> dict[str, Trial]:
        eye, P = jnp.eye(trial.r.shape[1]), across(trial.r)
        seen = weighed(trial, self.own * eye + self.contour * P)
        if self.estimate == "nearest":
            vector = to_the_path(trial.y, trial.r, window=self.window)
            e = self.own * trial.e + self.contour * vector
            seen = seen._replace(y=trial.r - e)
        return {"scheme": seen}


def across(r):
    """(N+1, n, n) the part of a vector across the path of a reference r, I - t t'.

    t is the unit tangent by differences over two samples; where the reference stands still, it is
    zero.
    """
    along = jnp.concatenate([r[1:2] - r[:1], r[2:] - r[:-2], r[-1:] - r[-2:-1]])
    squared = jnp.sum(along**2, axis=1)
    moves = squared > 0
    t = along / jnp.sqrt(jnp.where(moves, squared, 1.0))[:, None]
    return jnp.eye(r.shape[1]) - t[:, :, None] * t[:, None, :]
