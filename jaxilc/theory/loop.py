"""Machine and feedback as one linear system, from what is learned to the output.

The system goes from sample to sample. It is the simulator's own step, linearised at rest; so any
plant has one, and it can be differentiated in every leaf. Frequencies are in Hz throughout.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jax.flatten_util import ravel_pytree

from ..learning.machine import Machine
from ..pytree.aliases import Tree
from ..schemes import Scheme
from ..signals.task import Sample, Task
from .trials import learned_shape, shortened

BLOCK = 64  # samples of an impulse response at a time
LOST = 1e-9  # of the largest |y| in a trial, by leaving out states that hardly show
NEGLIGIBLE = (1e-10, 1e-14)  # shares of a direction that are tried for too little to count


class Loop(NamedTuple):
    """x[k+1] = A x[k] + B w[k], y[k] = C x[k], with A (n, n), B (n, n_w) and C (n_y, n)."""

    A: jax.Array | np.ndarray
    B: jax.Array | np.ndarray
    C: jax.Array | np.ndarray


class Now(NamedTuple):
    """What differs from sample to sample.

    x:        (n,) the state of the loop, flat
    w:        (n_w,) what is learned for this sample
    row:      the other entries of the scheme's row
    r:        (n_y,) reference r[k]
    ahead:    (preview, n_y) reference r[k+1], r[k+2], ...
    d_u, d_y: (n_u,) and (n_y,) disturbances of input and output
    """

    x: jax.Array
    w: jax.Array
    row: Tree
    r: jax.Array
    ahead: jax.Array
    d_u: jax.Array
    d_y: jax.Array


def tick_of(machine: Machine, scheme: Scheme | None, task: Task):
    """One sample of the simulator as a function, with its arguments at rest.

    The result (tick, fixed, rest) is a function tick(fixed, now) -> (next flat state, y), the
    machine and scheme that it needs, and `rest`, the `Now` of a loop at rest. A plant that changes
    is that of the trials after its last change.

    Raises ValueError for a scheme that plays several samples of what it learned at once, as
    OnReference over a feedback with preview.
    """
    preview = 1 if scheme is None else scheme.preview
    machine = machine.noiseless().sampled(task.dt).at_trial(task, None)[0]
    short = shortened(task, 3 + preview)
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

    def row_of(scheme, learned, short=short):
        """The second row of a trial that plays `learned`.

        The first row would know nothing of the sample before.
        """
        memory = scheme.initial_memory(short)
        if shape is None:
            rows = scheme.schedule(memory, short)
        else:
            rows = scheme.play(learned, memory, short)
        return jax.tree.map(lambda of: of[1], rows)

    if shape is not None and preview > 1 and _looks_ahead(row_of, scheme, zeros, short):
        raise ValueError(
            f"linear_loop: {type(scheme).__name__} with preview = {preview} plays several samples "
            "of what it learned at once; "
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
    """Machine and feedback from what is learned to y, linearised at rest.

    It is one sample of the simulator, differentiated.

    scheme: the result is the closed loop that its learning sees, P / (1 + C P). For `OnReference`
            what is learned corrects the reference; for `MultivariableILC` it is input and
            reference; for feedback alone it is an input on top. None is the machine alone

    The function is pure: it may be vmapped and differentiated. Raises ValueError as `tick_of` does.
    """
    tick, fixed, rest = tick_of(machine, scheme, task)
    # the output of the next state: what w does to y[k] at once, through a sample's own reference,
    # is no part of the loop
    A, B = jax.jacfwd(lambda x, w: tick(fixed, rest._replace(x=x, w=w))[0], argnums=(0, 1))(
        rest.x, rest.w
    )
    return Loop(A, B, jax.jacfwd(lambda x: tick(fixed, rest._replace(x=x))[1])(rest.x))


def loops_of(machines: Machine, scheme: Scheme | None, task: Task) -> list[Loop]:
    """The loop of each of several machines that are stacked, as `linear_loop` has it."""
    return each_of(_stacked_loops(machines, scheme, task))


def each_of(loops: Loop) -> list[Loop]:
    """Loops that are stacked, each by itself."""
    return [Loop(*one) for one in zip(*map(np.asarray, loops), strict=True)]


@jax.jit
def _stacked_loops(machines, scheme, task) -> Loop:
    return jax.vmap(lambda one: linear_loop(one, scheme, task))(machines)


def response(loop: Loop, frequencies, dt: float) -> jax.Array:
    """(F, n_y, n_w) P(z) = C (z I - A)^-1 B at frequencies (F,) [Hz]."""
    z = on_circle(frequencies, dt)[:, None, None]
    B = jnp.broadcast_to(loop.B, (len(z), *loop.B.shape)) + 0j
    return loop.C @ jnp.linalg.solve(z * jnp.eye(len(loop.A)) - loop.A, B)


def responses(loops: list[Loop], frequencies, dt: float) -> np.ndarray:
    """(S, F) P(z) of loops with one output and one input, without a program to compile."""
    z, found = np.exp(2j * np.pi * dt * np.asarray(frequencies))[:, None, None], []
    for A, B, C in loops:
        found.append((C @ np.linalg.solve(z * np.eye(len(A)) - A, B + 0j))[:, 0, 0])
    return np.array(found)


def on_circle(frequencies, dt) -> jax.Array:
    """(F,) z = exp(2 pi i f dt)"""
    return jnp.exp(2j * jnp.pi * dt * jnp.asarray(frequencies))


def minimal(loop: Loop, samples: int) -> Loop:
    """The part of the loop which w reaches and y shows, balanced.

    An integrator of a PID that is not used is no part of it, for example. States are left out only
    where that changes nothing in a trial of so many samples. An unstable mode, however small its
    weight, would show in the end; where there is one, the whole loop is kept.
    """
    A, B, C = (np.asarray(M, float) for M in loop)
    if not all(np.all(np.isfinite(M)) for M in (A, B, C)):
        return Loop(A, B, C)
    A, (scale, _) = scipy.linalg.matrix_balance(A, permute=False, separate=True)
    whole = B, C = B / scale[:, None], C * scale
    for share in NEGLIGIBLE:
        reduced = A, *whole
        # the reachable part, then the observable part: the reachable part of the transposed system
        for _ in range(2):
            V = _reachable(reduced[0], reduced[1], share)
            reduced = (V.T @ reduced[0] @ V).T, (reduced[2] @ V).T, (V.T @ reduced[1]).T
        difference, size = _apart((A, *whole), reduced, samples)
        if difference <= LOST * size:
            return Loop(*reduced)
    return Loop(A, *whole)


def pole_radius(loop: Loop, samples: int = 2000) -> float:
    """Largest |pole| of P, of that part of the loop that shows in a trial of so many samples.

    See `minimal`.
    """
    return radius_of(minimal(loop, samples))


def radius_of(loop: Loop) -> float:
    """Largest |eigenvalue| of A; infinite where A is not finite."""
    if not np.all(np.isfinite(loop.A)):
        return np.inf
    return float(np.max(np.abs(np.linalg.eigvals(loop.A)), initial=0.0))


def stable(radius):
    """Whether the largest |pole| of a loop is clearly within the unit circle."""
    return radius < 1 - 1e-9


# How it is done
# --------------------------------------------------------------------------------------------------


def _looks_ahead(row_of, *of) -> bool:
    """Whether the row of a sample depends on what is learned for later samples.

    It is looked at with all numbers 1, as those of scheme and task may be traced.
    """
    with jax.ensure_compile_time_eval():
        ones = jax.tree.map(lambda leaf: np.ones(np.shape(leaf), jnp.result_type(leaf)), of)
        slopes = jax.tree.leaves(jax.jacfwd(row_of, 1)(*ones))
        return any(np.any(np.asarray(slope)[..., 2:, :]) for slope in slopes)


def _reachable(A, B, share):
    """Orthonormal basis (n, r) of span(B, A B, A^2 B, ...).

    Directions that add less than a share of the size of A and B are left out.
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
    """Largest difference of two impulse responses over so many samples.

    The second result is the largest value of the first response.
    """
    difference = size = 0.0
    with np.errstate(over="ignore", invalid="ignore"):
        responses = [impulse_blocks(system, samples) for system in (one, other)]
        for y, other_y in zip(*responses, strict=True):
            apart = np.abs(y - other_y)
            if not np.all(np.isfinite(apart)):
                return np.inf, 0.0
            difference = max(difference, np.max(apart, initial=0.0))
            size = max(size, np.max(np.abs(y), initial=0.0))
    return difference, size


def impulse_blocks(system, samples: int):
    """C A^k B for k = 0 ... samples - 1, `BLOCK` samples at a time (k, n_y, n_w)."""
    A, B, C = system
    rows, block = [C], min(BLOCK, samples)
    for _ in range(block - 1):
        rows.append(rows[-1] @ A)
    rows, power = np.concatenate(rows), np.linalg.matrix_power(A, block)
    for first in range(0, samples, block):
        count = min(block, samples - first)
        yield (rows @ B).reshape(block, len(C), B.shape[1])[:count]
        B = power @ B
