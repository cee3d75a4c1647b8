"""The loop from what is learned to the output, machine and feedback together, as a linear system
from sample to sample.

It is that of the simulator's own step, linearised at rest; so any plant has one, differentiable in
every leaf. Frequencies are in Hz throughout.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jax.flatten_util import ravel_pytree

from ..learning.machine import Machine
from ..schemes import Scheme
from ..signals.task import Sample, Task
from .trials import learned_shape, shortened

LOST = 1e-9  # of the largest |y| in a trial, by leaving out states that hardly show
NEGLIGIBLE = (1e-10, 1e-14)  # shares of a direction that are tried for too little to count


class Loop(NamedTuple):
    """x[k+1] = A x[k] + B w[k], y[k] = C x[k]. A: (n, n), B: (n, n_w), C: (n_y, n)"""

    A: jax.Array | np.ndarray
    B: jax.Array | np.ndarray
    C: jax.Array | np.ndarray


class Now(NamedTuple):
    """What differs from sample to sample: the flat state x, the learned w, the rest of the scheme's
    row, reference, disturbances.
    """

    x: jax.Array
    w: jax.Array
    row: Any
    r: jax.Array
    ahead: jax.Array
    d_u: jax.Array
    d_y: jax.Array


def tick_of(machine: Machine, scheme: Scheme | None, task: Task):
    """(tick, fixed, rest): a sample of the simulator as a function tick(fixed, now) -> (next flat
    state, y), what it needs, and rest.

    Raises ValueError for a scheme that plays several samples of what it learned at once, as
    OnReference over a feedback with preview.
    """
    preview = 1 if scheme is None else scheme.preview
    machine, short = machine.noiseless().sampled(task.dt), shortened(task, 3 + preview)
    shape = learned_shape(scheme, short)
    width = task.inputs if shape is None else shape[1]
    zeros = jnp.zeros((short.N, width))
    state = (
        machine.plant.initial_state(),
        None if scheme is None else scheme.initial_state(short),
        jnp.zeros(task.inputs),
        jnp.zeros(width),
    )
    flat, unravel = ravel_pytree(state)

    def row_of(scheme, learned):
        """The second row of a trial that plays `learned`: the first would know nothing of the
        sample before.
        """
        memory = scheme.initial_memory(short)
        return jax.tree.map(
            lambda rows: rows[1],
            scheme.schedule(memory, short) if shape is None else scheme.play(learned, memory, short),
        )

    if shape is not None and preview > 1 and _looks_ahead(row_of, scheme, zeros):
        raise ValueError(
            f"linear_loop: {type(scheme).__name__} with preview = {preview} plays several samples of what it learned at once; "
            "allowed is a feedback of preview 1"
        )

    def tick(fixed, now: Now):
        machine, scheme = fixed
        x, act, v_last, w_last = unravel(now.x)
        y, u = machine.measure(machine.plant.output(x) + now.d_y, None), now.w
        if scheme is not None:
            row = jax.tree.map(
                jnp.add, row_of(scheme, zeros.at[0].set(w_last).at[1].set(now.w)), now.row
            )
            act, u = scheme.act(act, Sample(now.r, now.ahead, y, row, task.dt))
            u = u + now.w if shape is None else u
        v, u = machine.actuate(u, v_last, task.dt)
        return ravel_pytree((machine.plant.step(x, u + now.d_u, task.dt), act, v, now.w))[0], y

    shapes = () if scheme is None else jax.eval_shape(row_of, scheme, zeros)
    row = jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shapes)
    signals = (
        jnp.zeros(n) for n in (task.outputs, (preview, task.outputs), task.inputs, task.outputs)
    )
    return tick, (machine, scheme), Now(flat, jnp.zeros(width), row, *signals)


def linear_loop(machine: Machine, scheme: Scheme | None, task: Task) -> Loop:
    """Machine and feedback from what is learned to y, linearised at rest: one sample of the
    simulator, differentiated.

    scheme: the closed loop that its learning sees, P / (1 + C P); of `OnReference` what is learned
    corrects the reference, of
            `MultivariableILC` it is input and reference; of feedback alone it is an input on top;
            None is the machine alone
    Pure: to be vmapped and differentiated. Raises ValueError as `tick_of` does.
    """
    tick, fixed, rest = tick_of(machine, scheme, task)
    # the output of the next state: what w does to y[k] at once, through a sample's own reference,
    # is no part of the loop
    A, B = jax.jacfwd(lambda x, w: tick(fixed, rest._replace(x=x, w=w))[0], argnums=(0, 1))(
        rest.x, rest.w
    )
    return Loop(A, B, jax.jacfwd(lambda x: tick(fixed, rest._replace(x=x))[1])(rest.x))


def response(loop: Loop, frequencies, dt: float) -> jax.Array:
    """(F, n_y, n_w) P(z) = C (z I - A)^-1 B at frequencies (F,) [Hz]."""
    z = on_circle(frequencies, dt)[:, None, None]
    return loop.C @ jnp.linalg.solve(
        z * jnp.eye(len(loop.A)) - loop.A, jnp.broadcast_to(loop.B, (len(z), *loop.B.shape)) + 0j
    )


def on_circle(frequencies, dt) -> jax.Array:
    """(F,) z = exp(2 pi i f dt)"""
    return jnp.exp(2j * jnp.pi * dt * jnp.asarray(frequencies))


def minimal(loop: Loop, samples: int) -> Loop:
    """The part of the loop which w reaches and y shows, balanced: an unused integrator of a PID is
    no part of it.

    States are left out only where that changes nothing in a trial of so many samples: an unstable
    mode of however small a weight, which would show in the end, stays, and then all of the loop
    does.
    """
    A, B, C = (np.asarray(M, float) for M in loop)
    if not all(np.all(np.isfinite(M)) for M in (A, B, C)):
        return Loop(A, B, C)
    A, (scale, _) = scipy.linalg.matrix_balance(A, permute=False, separate=True)
    whole = B, C = B / scale[:, None], C * scale
    for share in NEGLIGIBLE:
        reduced = A, *whole
        for _ in range(
            2
        ):  # the reachable part, then the observable part, as the reachable part of the transposed system
            V = _reachable(reduced[0], reduced[1], share)
            reduced = (V.T @ reduced[0] @ V).T, (reduced[2] @ V).T, (V.T @ reduced[1]).T
        difference, size = _apart((A, *whole), reduced, samples)
        if difference <= LOST * size:
            return Loop(*reduced)
    return Loop(A, *whole)


def pole_radius(loop: Loop, samples: int = 2000) -> float:
    """Largest |pole| of P, that is of the part of the loop that shows in a trial of so many
    samples; see `minimal`.
    """
    A = minimal(loop, samples).A
    return (
        float(np.max(np.abs(np.linalg.eigvals(A)), initial=0.0))
        if np.all(np.isfinite(A))
        else np.inf
    )


# How it is done
# --------------------------------------------------------------------------------------------------


def _looks_ahead(row_of, scheme, zeros) -> bool:
    """Whether the row of a sample depends on what is learned for later ones; looked at for weights
    of 1, as it may be traced.
    """
    with jax.ensure_compile_time_eval():
        ones = jax.tree.map(lambda leaf: np.ones(np.shape(leaf), leaf.dtype), scheme)
        slopes = jax.tree.leaves(jax.jacfwd(row_of, 1)(ones, zeros))
        return any(np.any(np.asarray(slope)[..., 2:, :]) for slope in slopes)


def _reachable(A, B, share):
    """Orthonormal basis (n, r) of span(B, A B, A^2 B, ...), without directions that add less than a
    share of the size of A and B.
    """
    V, fresh = np.zeros((len(A), 0)), B
    size = max(np.linalg.norm(A), np.linalg.norm(B), 1e-300)
    while True:
        for _ in range(2):
            fresh = fresh - V @ (V.T @ fresh)
        U, s, _ = np.linalg.svd(fresh, full_matrices=False)
        U = U[:, s > share * size]
        if U.shape[1] == 0 or V.shape[1] == len(A):
            return V
        V, fresh = np.hstack([V, U]), A @ U


def _apart(one, other, samples: int):
    """Largest difference of two impulse responses over so many samples, and the largest value of
    the first.
    """
    (A, X, C), (a, x, c) = one, other
    difference = size = 0.0
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(samples):
            y = C @ X
            difference, size = (
                max(difference, np.max(np.abs(y - c @ x), initial=0.0)),
                max(size, np.max(np.abs(y), initial=0.0)),
            )
            X, x = A @ X, a @ x
    return (difference, size) if np.isfinite(difference) and np.isfinite(size) else (np.inf, 0.0)
