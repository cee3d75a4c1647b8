"""Bounds on the next trial of a norm-optimal law, as rows of a system of its samples.

A row is a signal of the next trial, v = now + change, where `now` is its value in the trial that
was measured, and the change follows from that of the input by the nominal model. There are up to
five kinds, always in this order:

    input    u'[k]                              has the weights w_r and w_s
    output   y'[k+1]                            has the weight w_q
    rate     u'[k] - u'[k-1]                    has the weight w_d; u'[-1] = 0
    total    u'[k] + f'[k]                      f: contribution of the feedback
    contour  n[k+1]' (y'[k+1] - r[k+1])         n: unit normal of the reference
"""

from __future__ import annotations

from types import ModuleType
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import block_diag

from ..plants import TimeVaryingStateSpace
from ..pytree.aliases import Array, Leaf, Tree
from ..pytree.needs import known
from ..signals.task import Task, Trial
from .riccati import System


class Rows(NamedTuple):
    """A signal of the trial that was measured, and its bounds in the next one, each (N, n)."""

    now: Array
    low: Array
    high: Array


# a scheme or a problem with the bounds and the weights of `ConstrainedNormOptimal`
Bounded: TypeAlias = Tree


def kinds(scheme: Bounded) -> tuple[str, ...]:
    """The kinds of rows that a scheme has: one with the bounds of `ConstrainedNormOptimal`."""
    has = {
        "rate": scheme.rate is not None or scheme.w_d is not None,
        "total": scheme.total is not None,
        "contour": scheme.contour is not None,
    }
    return ("input", "output", *(name for name, there in has.items() if there))


def system_of(scheme: Bounded, r: Array) -> System:
    """The system from a change of the input to that of the rows, by the linear `scheme.model`.

    r: (N+1, n_y) reference
    """
    model, with_rate = scheme.model, "rate" in kinds(scheme)
    A, B, C = (jnp.asarray(M) for M in (model.A, model.B, model.C))
    n, n_u, eye = A.shape[-1], model.n_u, jnp.eye(model.n_u, dtype=A.dtype)
    still = jnp.zeros((n_u, n), A.dtype)
    # of each kind: what it sees of the model's state, and of the input d[k]
    seen = {
        "input": (still, eye),
        "output": (C @ A, C @ B),
        "rate": (still, eye),
        "total": (jnp.asarray(still if scheme.feedback is None else scheme.feedback), eye),
    }
    if scheme.contour is not None:
        across = normals(r)[1:, None, :]
        seen["contour"] = (across @ C @ A, across @ C @ B)
    rows = [seen[name] for name in kinds(scheme)]
    G_z, G_d = (stacked([row[i] for row in rows]) for i in (0, 1))
    if not with_rate:
        return System(A, B, G_z, G_d)
    # the input of the sample before is a further state
    before = jnp.concatenate(
        [
            (-eye if name == "rate" else jnp.zeros((row[1].shape[-2], n_u), A.dtype))
            for name, row in zip(kinds(scheme), rows, strict=True)
        ]
    )
    A = jnp.pad(A, [(0, 0)] * (A.ndim - 2) + [(0, n_u), (0, n_u)])
    return System(A, stacked([B, eye]), _beside(G_z, before), G_d)


def normals(r: Array) -> Array:
    """(N+1, 2) the unit normal of the reference, to the left; zero where it stands still."""
    along = jnp.concatenate([r[1:2] - r[:1], r[2:] - r[:-2], r[-1:] - r[-2:-1]])
    squared = jnp.sum(along**2, axis=1, keepdims=True)
    unit = along / jnp.sqrt(jnp.where(squared > 0, squared, 1.0))
    return jnp.stack([-unit[:, 1], unit[:, 0]], axis=1)


def weight_of(scheme: Bounded, weights: tuple[Array, ...]) -> Array:
    """(m, m) the weights of a change of the rows. weights: w_q, w_r, w_s, w_d as matrices."""
    Q, R, S, rate = weights
    of = {"input": R + S, "output": Q, "rate": rate}
    sizes = {"total": scheme.model.n_u, "contour": 1}
    return block_diag(
        *(of[name] if name in of else jnp.zeros((sizes[name],) * 2) for name in kinds(scheme))
    )


def rows_of(scheme: Bounded, trial: Trial) -> dict[str, Rows]:
    """The rows of a trial, by kind, in the order of `kinds`."""
    r, y, u = trial.r, trial.y, trial.u
    low, high = output_bounds(scheme, r)
    found = {"input": _symmetric(u, scheme.limit), "output": Rows(y[1:], low[1:], high[1:])}
    if "rate" in kinds(scheme):
        steps = jnp.concatenate([u[:1], u[1:] - u[:-1]])
        most = None if scheme.rate is None else scheme.rate * trial.dt
        found["rate"] = _symmetric(steps, most)
    if scheme.total is not None:
        found["total"] = _symmetric(u + trial.signals["beside"], scheme.total)
    if scheme.contour is not None:
        across = normals(r)
        moves = jnp.any(across != 0, axis=1, keepdims=True)
        off = jnp.sum(across * (y - r), axis=1, keepdims=True)[1:]
        bound = jnp.where(moves, scheme.contour, jnp.inf)[1:]
        found["contour"] = Rows(off, -bound, bound)
    return found


def side_by_side(rows: dict[str, Rows]) -> Rows:
    """The rows of all kinds as those of one, each (N, m)."""
    return Rows(*(jnp.concatenate(each, axis=1) for each in zip(*rows.values(), strict=True)))


def output_bounds(scheme: Bounded, r: Leaf, xp: ModuleType = jnp) -> tuple[Leaf, Leaf]:
    """(N+1, n_y) the bounds of the output, from its own bounds and from those of the error."""
    low, high = xp.full_like(r, -xp.inf), xp.full_like(r, xp.inf)
    if scheme.y_low is not None:
        low = xp.maximum(low, scheme.y_low)
    if scheme.y_high is not None:
        high = xp.minimum(high, scheme.y_high)
    if scheme.tube is not None:
        low, high = xp.maximum(low, r - scheme.tube), xp.minimum(high, r + scheme.tube)
    return low, high


def bounds_where_measured(scheme: Bounded, trial: Trial) -> dict[str, Array]:
    """The bounds `y_low` and `y_high` of a scheme, by name, infinite at samples that were lost.

    There the record has the reference, which may lie beyond them, in place of an output.
    """
    lost = jnp.all(trial.weight == 0, axis=2)
    bounds = (("y_low", scheme.y_low, -jnp.inf), ("y_high", scheme.y_high, jnp.inf))
    return {name: jnp.where(lost, far, y) for name, y, far in bounds if y is not None}


def need_feasible(scheme: Bounded, task: Task) -> None:
    """Raises ValueError for bounds of the output that leave nothing, or exclude the start."""
    owner = type(scheme).__name__
    bounds = {name: getattr(scheme, name) for name in ("y_low", "y_high", "tube")}
    for name, value in bounds.items():
        allowed = ((), (task.outputs,), (task.N + 1, task.outputs))
        if value is not None and value.shape not in allowed:
            raise ValueError(
                f"{owner}: {name} has shape {value.shape}; allowed are (), ({task.outputs},) and "
                f"({task.N + 1}, {task.outputs})"
            )
    names = " and ".join(name for name, value in bounds.items() if value is not None)
    if not names or not known((bounds, task.reference)):
        return
    low, high = output_bounds(scheme, np.asarray(task.reference), np)
    empty = np.argwhere(low >= high)
    if len(empty):
        k, i = empty[0]
        raise ValueError(
            f"{owner}: {names} leave nothing of output {i} at sample {k}, from {low[k, i]:g} to "
            f"{high[k, i]:g}; allowed are bounds with low < high"
        )
    if not known(scheme.model):
        return
    start = np.zeros(task.outputs)
    if not isinstance(scheme.model, TimeVaryingStateSpace):
        with jax.ensure_compile_time_eval():
            model = scheme.model.sampled(task.dt)
            start = np.asarray(model.output(model.initial_state()))
    outside = np.flatnonzero((start < low[0]) | (start > high[0]))
    if len(outside):
        i = outside[0]
        raise ValueError(
            f"{owner}: {names} are [{low[0, i]:g}, {high[0, i]:g}] for output {i} at sample 0, but "
            f"the model starts at {start[i]:g}; allowed are bounds that contain the start (x0 of "
            "the model)"
        )


def _symmetric(now: Array, bound: Array | None) -> Rows:
    bound = jnp.broadcast_to(jnp.inf if bound is None else bound, now.shape).astype(now.dtype)
    return Rows(now, -bound, bound)


def stacked(blocks: list[Array]) -> Array:
    """Blocks one below the other, where some have a leading axis of N."""
    lead = next((block.shape[:1] for block in blocks if block.ndim == 3), ())
    return jnp.concatenate([jnp.broadcast_to(b, (*lead, *b.shape[-2:])) for b in blocks], axis=-2)


def _beside(left: Array, right: Array) -> Array:
    return jnp.concatenate(
        [left, jnp.broadcast_to(right, (*left.shape[:-2], *right.shape))], axis=-1
    )
