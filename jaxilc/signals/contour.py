"""The contour error: the distance of a measured motion from a path, whatever its time."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from ..pytree.aliases import Array, Tree, Value
from ..pytree.ranges import require
from .task import root


def contour_error(y: Value, path: Value, *, window: int, closed: bool | None = None) -> Array:
    """(M,) normal distance of each measured point from the path.

        e_k = distance of y_k from the chords path_i path_{i+1}
        i = max(c_k - window, 0) .. min(c_k + window, L) - 1

    L is the path's last index, and c_k = round(k L / (M - 1)), which is k itself for the reference
    of a trial. Unlike the tracking error it does not see a lag along the path. In the plane it is
    signed, positive on the left of the path.

    y:      (M, d) measured positions [mm]
    path:   (L+1, d) points along the path, a reference or denser, not moving with y
    window: half width in points of the path, static: the cost is M window, and the result does not
            depend on a lag up to it. Of a larger lag the distance to the end of the window is
            returned, which is too large, never too small; where the path comes near itself a wide
            window may find the other branch
    closed: whether the window goes on over the path's ends, so that a tool that lags at the start
            is measured from the path's last part; None: where the ends meet, to a millionth of the
            path's width

    The path between points is their chord, which errs by curvature h^2 / 8 at a spacing h. The sign
    needs corners below 90 deg. The function is differentiable in y and path and can be vmapped: the
    gradient is the path's unit normal, or at a corner points away from it. It is zero at zero
    distance from a corner or, in space, from the path. Where the path dwells, the points that
    coincide must move together: the distance has a kink, and no gradient, where they part.

    Raises ValueError where the shapes do not fit, window is not a whole number >= 1, or closed is
    not True, False or None.
    """
    if closed is not None and not isinstance(closed, bool):
        raise ValueError(f"contour_error: closed = {closed!r} is not one of True, False, None")
    require("contour_error", "window", window, "[1, inf)", whole=True)
    shape, path_shape = np.shape(y), np.shape(path)
    if (
        len(shape) != 2
        or len(path_shape) != 2
        or shape[1] != path_shape[1]
        or shape[1] < 2
        or path_shape[0] < 2
        or not shape[0]
    ):
        raise ValueError(
            f"contour_error: y {shape} and path {path_shape} must be (M, d) and (L+1, d) with d >= "
            "2, L >= 1"
        )
    y, path = jnp.asarray(y), jnp.asarray(path)
    kind = jnp.result_type(y, path, float)
    return _contour_error(y.astype(kind), path.astype(kind), int(window), closed)


@partial(jax.jit, static_argnums=(2, 3))
def _contour_error(y: Array, path: Array, window: int, closed: bool | None) -> Array:
    round_it = jnp.asarray(bool(closed))
    if closed is None:  # where the ends meet
        round_it = jnp.max(jnp.abs(path[-1] - path[0])) <= 1e-6 * jnp.max(jnp.ptp(path, axis=0))
    # Which chord is the nearest one is a choice, and has no derivative.
    search = _nearest_of_as_many if len(y) == len(path) > 2 * window else _nearest
    i = search(*lax.stop_gradient((y, path)), window, round_it)
    start, step = path[:-1][i], (path[1:] - path[:-1])[i]
    apart, inside, squared = _away(y, start, step)
    distance = root(jnp.sum(apart**2, axis=-1))
    if y.shape[1] > 2:
        return distance
    tangent = step / jnp.sqrt(jnp.where(squared > 0, squared, 1.0))[:, None]
    left = tangent[:, 0] * apart[:, 1] - tangent[:, 1] * apart[:, 0]
    return jnp.where(inside, left, jnp.where(left < 0, -distance, distance))


def _away(point: Array, start: Tree, step: Array) -> Tree:
    """The vector from the nearest place of a chord, whether that lies inside, and its square."""
    squared = jnp.sum(step**2, axis=-1)
    along = jnp.sum((point - start) * step, axis=-1) / jnp.where(squared > 0, squared, 1.0)
    nearest = start + jnp.clip(along, 0.0, 1.0)[..., None] * step
    return point - nearest, (along > 0) & (along < 1), squared


def _nearest(y: Array, path: Array, window: int, closed: Array) -> Array:
    """(M,) the number of the nearest chord of each point, for a path of any number of points."""
    last = len(path) - 1
    centres = np.rint(np.arange(len(y)) * (last / max(len(y) - 1, 1))).astype(int)
    width = min(2 * window, last)
    # Near the ends of an open path the window is moved inside, which widens it: harmless, and every
    # sample then has as many chords.
    inside_it, over_it = np.clip(centres - window, 0, last - width), centres - width // 2
    first = jnp.where(closed, over_it, inside_it)
    chords = (first[:, None] + np.arange(width)) % last
    best = _nearest_among(y, path[:-1][chords], (path[1:] - path[:-1])[chords])
    return jnp.take_along_axis(chords, best[:, None], axis=1)[:, 0]


def _nearest_of_as_many(y: Array, path: Array, window: int, closed: Array) -> Array:
    """The same for a path of as many points, where the chords of a sample are its neighbours.

    Then each step of the search is a shift of whole signals, which takes a tenth of the time of
    picking the chords one by one.
    """
    last = len(path) - 1
    steps = path[1:] - path[:-1]
    around = np.arange(-window, last + 1 + window)
    wrapped = around % last
    there = ((around >= 0) & (around < last)) | closed
    start, step = list(path[:-1][wrapped].T), list(steps[wrapped].T)
    squared = sum(x**2 for x in step)
    allowed = jnp.where(there & (squared > 0), 0.0, jnp.inf)
    inverse = 1.0 / jnp.where(squared > 0, squared, 1.0)
    points = list(y.T)

    def nearer(i: Array, best: tuple[Array, Array]) -> tuple[Tree, Tree]:
        distance, at = best

        def there_now(x: Array) -> Array:
            return lax.dynamic_slice_in_dim(x, i, last + 1)

        v = [there_now(x) for x in step]
        apart = [p - there_now(x) for p, x in zip(points, start, strict=True)]
        along = sum(a * b for a, b in zip(apart, v, strict=True)) * there_now(inverse)
        share = jnp.clip(along, 0.0, 1.0)
        found = sum((a - share * b) ** 2 for a, b in zip(apart, v, strict=True))
        found += there_now(allowed)
        return jnp.where(found < distance, found, distance), jnp.where(found < distance, i, at)

    none = jnp.full(last + 1, jnp.inf, y.dtype), jnp.full(last + 1, window)
    at = lax.fori_loop(0, 2 * window, nearer, none)[1]
    near = (np.arange(last + 1) - window + at) % last
    # at the ends of an open path, among all chords there
    at_start = _nearest_among(y[:window], path[: 2 * window], steps[: 2 * window])
    at_end = _nearest_among(y[-window:], path[-2 * window - 1 : -1], steps[-2 * window :])
    at_end += last - 2 * window
    of_open = jnp.concatenate([at_start, near[window:-window], at_end])
    return jnp.where(closed, near, of_open)


def _nearest_among(y: Array, start: Array, step: Array) -> Array:
    """(M,) the nearest of some chords (W, d), or (M, W, d).

    A path that dwells has chords of no direction; one is chosen only where there is nothing else.
    """
    candidates, _, squared = _away(y[:, None], start, step)
    return jnp.argmin(jnp.where(squared > 0, jnp.sum(candidates**2, axis=-1), jnp.inf), axis=1)
