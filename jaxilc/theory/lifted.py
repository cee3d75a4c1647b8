"""The lifted form: a whole trial as one vector, and what one trial of learning does to it as one matrix.

    y = G u + d,  u_{j+1} = Q (keep u_j + L e_j)   =>   u_{j+1} - u_inf = Q (keep - L G)(u_j - u_inf)
                                                 =>   e_{j+1} = (I - G L) e_j  where Q = keep = I

Rows of G and L count samples first and channels second: row k n + c is channel c of y[k+1], and of u[k]. Every matrix is taken from
the simulator and from the scheme itself by linearisation, none is written down a second time. Dense, for N up to a few thousand;
beyond that `contraction` gives the same numbers without a matrix.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jax import lax
from scipy.sparse.csgraph import connected_components

from ..filters import Filter
from ..learning import check
from ..machine import Machine
from ..schemes import MultivariableILC, OnReference, Scheme, WithFeedback
from ..schemes.compose import Pair
from ..schemes.scheme import Feedforward
from ..signals import Task
from ..trial import run_trial
from .condition import Condition, Premise, condition, departure, is_linear, learner, linear, linear_law, next_input, premise

MONOTONE = (
    "sigma_max < 1: the 2-norm of the deviation falls by at least this factor in every trial (Bristow 2006; Norrlöf, Gunnarsson 2002)"
)
ASYMPTOTIC = "rho < 1: the deviation goes to zero in the end, whatever it does before (Bristow 2006; Norrlöf, Gunnarsson 2002)"
TRANSIENT = "||M_j ... M_1|| bounds how large the deviation is after j trials, for any start (sub-multiplicativity; tight for each j)"

MARGIN = 10.0  # on what rounding does to an eigenvalue, which is known to first order only


def noiseless(machine: Machine) -> Machine:
    """The machine without what differs from trial to trial: noise of the sensors and of the disturbances."""
    sensor, disturbance = machine.sensor, machine.disturbance
    sensor = None if sensor is None else dataclasses.replace(sensor, noise=None)
    disturbance = None if disturbance is None else dataclasses.replace(disturbance, input_noise=None, output_noise=None)
    return dataclasses.replace(machine, sensor=sensor, disturbance=disturbance)


def lifted_plant(
    machine: Machine, scheme: Scheme | None, task: Task, *, about=None, memory: Any = None, time_invariant: bool | None = None
) -> np.ndarray:
    """(N n_y, N n_u) G = d y[1..N] / d w[0..N-1], where w is a feedforward added to the input: exact, from the simulator.

    scheme: feedback that acts within the trial, None for none; a scheme that learns keeps its `memory` (None: that of its start), so
            for `WithFeedback(learning, feedback)` G is the closed loop that the learning sees, P / (1 + C P). Of `OnReference` w is
            the correction of the reference, (N, n_y), and G is C P / (1 + C P).
    about:  (N, n_u) w at which a machine that is not linear is linearised, None for zero
    time_invariant: True takes one impulse response for all columns; False takes every column by itself;
            None takes one if it also explains the answer to a random input, which for no time-varying loop happens but by accident
    Raises ValueError where machine, scheme and task do not fit, or for `about` of another shape.
    """
    arguments = _arguments("lifted_plant", machine, scheme, task, about, memory)
    if time_invariant is not False:
        impulse, probe, answer = map(np.asarray, _impulse_response(*arguments))
        G = _toeplitz(impulse)
        miss = np.max(np.abs(G @ probe.ravel() - answer.ravel()))
        if time_invariant or is_linear(miss / np.max(np.abs(answer))):
            return G
    return np.asarray(_columns(*arguments))


def linear_trial(machine: Machine, scheme: Scheme | None, task: Task, *, about=None, memory: Any = None) -> Premise:
    """The premise that the trial is a linear function of its feedforward, so that G holds for all of them; see `lifted_plant`.

    Looked at for a feedforward that departs from `about` by as much as its own size, or by 1 where it is zero.
    """
    departed = _trial_departure(*_arguments("linear_trial", machine, scheme, task, about, memory))
    return linear("machine and feedback linear", departed, "the output of a trial, for a random change of the feedforward")


class Law(NamedTuple):
    """u_{j+1} = Q (keep u_j + L e_j) + const. keep, Q: (N n_u, N n_u);  L: (N n_u, N n_y)"""

    keep: np.ndarray
    L: np.ndarray
    Q: np.ndarray


def learning_law(scheme: Scheme, task: Task, memory: Any = None) -> Law:
    """The learning law of a scheme with a feedforward, by linearising its own `learn` and `feedforward`; Q of its filters.

    memory: what it knows, None for its start. A law that adapts (MFAILC) is frozen at what it knows; `linear_law` tells.
    Raises ValueError for a scheme that learns no feedforward.
    """
    filters, *law = learner(scheme, task, memory)
    keep, L = map(np.asarray, _law(*law))
    Q = np.eye(len(keep))
    for q in filters:
        Q = Q @ filter_matrix(q, law[1])
    return Law(keep, L, Q)


def filter_matrix(q: Filter, task: Task) -> np.ndarray:
    """(N n_u, N n_u) the matrix of a filter of the input: what it makes of each unit impulse."""
    q.check(task.N, task.dt)
    return np.kron(_filtered(q, np.eye(task.N), task.dt), np.eye(task.inputs))


def error_map(G, L) -> np.ndarray:
    """I - G L, of e_{j+1} = (I - G L) e_j, where the law keeps all of u_j and filters nothing. G: (N n_y, N n_u);  L: (N n_u, N n_y)"""
    _need_product("error_map", "L", L, (G.shape[-1], G.shape[-2]))
    return np.eye(G.shape[-2]) - G @ L


def input_map(G, L, *, Q=None, keep=None) -> np.ndarray:
    """Q (keep - L G), of u_{j+1} - u_inf. G, L: as in `error_map`;  Q, keep: (N n_u, N n_u), None for the identity"""
    _need_product("input_map", "L", L, (G.shape[-1], G.shape[-2]))
    M = (np.eye(G.shape[-1]) if keep is None else keep) - L @ G
    return M if Q is None else Q @ M


def mfailc_map(G, phi, lam, rho=1.0, *, lead: int = 0) -> np.ndarray:
    """(..., N n, N n) I - G diag(gamma) S^lead of e_{j+1} under CFDL-MFAILC (Cao 2019, eq. 12), gamma = rho phi / (lam + phi^2).

    G: (N n, N n);  phi: (N, n) or (N,) the estimate, frozen; with leading axes one map for each, so (J, N, n) gives those of J trials
    lam, rho: (), or (n,) of each channel;  lead: samples by which learning looks further ahead, S e[k] = e[k+1]
    This is the exact map of a linear machine. |1 - rho phi phi_hat / (lam + phi_hat^2)| < 1 (15) is its diagonal only: it ignores that
    y[k+1] also depends on the inputs before u[k]. Raises ValueError for a phi that does not fit G.
    """
    G, phi = np.asarray(G), np.asarray(phi, float)
    size = G.shape[-1]
    if G.shape != (size, size) or not (phi.shape[-1:] == (size,) or (phi.ndim > 1 and phi.shape[-2] * phi.shape[-1] == size)):
        raise ValueError(f"mfailc_map: phi has shape {phi.shape}, G {G.shape}; allowed are (..., N) and (..., N, n) with G (N n, N n)")
    phi = phi[..., None] if phi.shape[-1] == size else phi
    gamma = np.asarray(rho * phi / (lam + phi**2)).reshape(*phi.shape[:-2], 1, size)
    weighted, shift = G * gamma, lead * phi.shape[-1]
    return np.eye(size) - np.concatenate([np.zeros_like(weighted[..., :shift]), weighted[..., : size - shift]], axis=-1)


def sigma_max(M) -> np.ndarray:
    """(...) largest singular value of (..., n, n)."""
    return np.linalg.norm(np.asarray(M), 2, axis=(-2, -1))


def spectral_radius(M) -> np.ndarray:
    """(...) largest |eigenvalue| of (..., n, n); of triangular matrices, also permuted and block by block, exactly."""
    M = np.asarray(M)
    return np.reshape([_radius(m)[0] for m in M.reshape(-1, *M.shape[-2:])], M.shape[:-2])


def transient_growth(M, trials: int | None = None) -> np.ndarray:
    """(J,) ||M_j ... M_1||_2 for j = 1..J, by how much a deviation can have grown after j trials.

    M: (n, n), the same in each trial, then `trials` is J; or (J, n, n), the map of each trial. Raises ValueError for anything else.
    """
    M = np.asarray(M)
    if (M.ndim == 2) != (trials is not None) or M.ndim not in (2, 3) or (trials is not None and trials < 1):
        raise ValueError(f"transient_growth: M {M.shape}, trials = {trials}; allowed are (n, n) with trials in [1, inf), or (J, n, n)")
    product, norms = np.eye(M.shape[-1]), []
    for m in M if M.ndim == 3 else (M,) * (trials or 0):
        product = m @ product
        norms.append(np.linalg.norm(product, 2))
    return np.array(norms)


def monotone(M, *, premises: Iterable[Premise] = ()) -> Condition:
    """sigma_max(M) < 1 of one (n, n) or several (S, n, n) maps of the input's or the error's deviation."""
    return condition(sigma_max(M), MONOTONE, premises=premises)


def asymptotic(M, *, premises: Iterable[Premise] = ()) -> Condition:
    """rho(M) < 1 of one (n, n) or several (S, n, n) maps.

    Where a map is far from normal its eigenvalues cannot be had from its entries in floating point. Then rho < 1 is claimed only if a
    power of M contracts, since rho^k <= ||M^k||; else a premise is broken.
    """
    M = np.asarray(M)
    maps = M.reshape(-1, *M.shape[-2:])
    value, doubt = np.array([_radius(m) for m in maps]).T
    clear = [abs(v - 1) > d or (v < 1 and _power_contracts(m)) for m, v, d in zip(maps, value, doubt, strict=True)]
    detail = f"to first order rounding may move rho by {np.max(doubt):.1e}"
    resolved = premise("eigenvalues resolved", np.reshape(clear, M.shape[:-2]), detail, plants=M.ndim > 2)
    return condition(value.reshape(M.shape[:-2]), ASYMPTOTIC, premises=(*premises, resolved))


def transient(M, trials: int | None = None, *, allowed: float = 1.0, premises: Iterable[Premise] = ()) -> Condition:
    """max_j ||M_j ... M_1||_2 < allowed: no deviation ever grows by this factor. M, trials: as for `transient_growth`"""
    return condition(np.max(transient_growth(M, trials)), TRANSIENT, limit=allowed, premises=premises)


def learning_conditions(machine: Machine, scheme: Scheme, task: Task, *, about=None, memory: Any = None) -> dict[str, Condition]:
    """`monotone` and `asymptotic` of the input, Q (keep - L G), and `monotone_error`, I - G L, where nothing is filtered or forgotten.

    about, memory: where a machine or law that is not linear is linearised; a premise then says that it is not
    """
    G, law = lifted_plant(machine, scheme, task, about=about, memory=memory), learning_law(scheme, task, memory)
    premises = (linear_trial(machine, scheme, task, about=about, memory=memory), linear_law(scheme, task, memory))
    M = input_map(G, law.L, Q=law.Q, keep=law.keep)
    found = {"monotone": monotone(M, premises=premises), "asymptotic": asymptotic(M, premises=premises)}
    if np.array_equal(law.Q @ law.keep, np.eye(len(law.Q))):
        found["monotone_error"] = monotone(error_map(G, law.L), premises=premises)
    return found


# How it is done ------------------------------------------------------------------------------------------------------------


def _arguments(function, machine, scheme, task, about, memory):
    """What the compiled functions take, checked."""
    if scheme is None:
        machine.check(task)
    else:
        check(machine, scheme, task)
        memory = scheme.memory(task) if memory is None else memory
    widths = {OnReference: task.outputs, MultivariableILC: 2}
    shape = (task.N, widths.get(type(scheme), task.inputs))
    about = jnp.zeros(shape) if about is None else jnp.asarray(about, float)
    if about.shape != shape:
        raise ValueError(f"{function}: about has shape {about.shape}; this task needs {shape}")
    return noiseless(machine), scheme, task, memory, about


def played_trial(machine, scheme, task, memory, w):
    """(N, n_y) y[1..N] with the feedforward w added; of OnReference, to the reference.

    Of MultivariableILC (N, 2) y_M - r and y_T, for w = (u, r).
    """
    if isinstance(scheme, MultivariableILC):
        played = dataclasses.replace(scheme, learning=Scheme())
        trial = run_trial(machine, played, task, Pair(Feedforward(w), memory.feedback), jax.random.key(0))
        followed, seen = trial.signals["reference"], trial.y[1:, [scheme.motor_output, scheme.table_output]]
        return jnp.stack([seen[:, 0] - followed[:, 0], seen[:, 1]], axis=1)
    if scheme is None:
        played, knows = Scheme(), Feedforward(w)
    elif isinstance(scheme, OnReference):
        played, knows = OnReference(Scheme(), scheme.feedback), Pair(Feedforward(w), memory.feedback)
    else:
        played, knows = WithFeedback(Scheme(), scheme), Pair(Feedforward(w), memory)
    return run_trial(machine, played, task, knows, jax.random.key(0)).y[1:]


@jax.jit
def _impulse_response(machine, scheme, task, memory, about):
    """(N, n_y, n_u) of an impulse at k = 0, a random (N, n_u) input, and the (N, n_y) answer to it."""
    _, push = jax.linearize(partial(played_trial, machine, scheme, task, memory), about)
    impulses = jnp.zeros((about.shape[1], *about.shape)).at[:, 0].set(jnp.eye(about.shape[1]))
    probe = jnp.asarray(np.random.default_rng(1).standard_normal(about.shape), about.dtype)
    answers = jax.vmap(push)(jnp.concatenate([impulses, probe[None]]))
    return jnp.moveaxis(answers[:-1], 0, -1), probe, answers[-1]


@jax.jit
def _columns(machine, scheme, task, memory, about):
    _, push = jax.linearize(partial(played_trial, machine, scheme, task, memory), about)
    impulses = jnp.eye(about.size).reshape(-1, *about.shape)
    return lax.map(lambda impulse: push(impulse).reshape(-1), impulses, batch_size=64).T


@jax.jit
def _trial_departure(machine, scheme, task, memory, about):
    return departure(partial(played_trial, machine, scheme, task, memory), about)


def _toeplitz(impulse):
    """(N n_y, N n_u) from an (N, n_y, n_u) impulse response."""
    N, n_y, n_u = impulse.shape
    lag = np.arange(N)[:, None] - np.arange(N)
    blocks = np.where(lag[..., None, None] >= 0, impulse[lag], 0.0)
    return blocks.transpose(0, 2, 1, 3).reshape(N * n_y, N * n_u)


@jax.jit
def _filtered(q, signal, dt):
    return q(signal, dt)


@jax.jit
def _law(scheme, task, memory):
    u, e = jnp.zeros((task.N, task.inputs)), jnp.zeros((task.N, task.outputs))
    keep, L = jax.jacfwd(next_input(scheme, task, memory), argnums=(0, 1))(u, e)
    return keep.reshape(u.size, u.size), L.reshape(u.size, e.size)


def _radius(M):
    """rho of (n, n), and how far rounding may have moved it: 10 eps ||M|| over the cosine between left and right eigenvector.

    Taken over the irreducible diagonal blocks: of a triangular matrix far from normal, and I - gamma G is one, the QR algorithm
    finds eigenvalues that are wrong in the first digit, while they are simply its diagonal.
    """
    if not np.all(np.isfinite(M)):
        return np.nan, np.nan
    blocks, block_of = connected_components(M != 0, connection="strong")
    singles = np.bincount(block_of, minlength=blocks)[block_of] == 1
    found = [(np.max(np.abs(np.diag(M)[singles]), initial=0.0), 0.0)]
    for i in np.unique(block_of[~singles]):
        block = M[np.ix_(block_of == i, block_of == i)]
        values, left, right = scipy.linalg.eig(block, left=True)
        top = np.argmax(np.abs(values))
        cosine = np.abs(np.vdot(left[:, top], right[:, top]))  # LAPACK gives unit vectors
        found.append((np.abs(values[top]), MARGIN * np.finfo(M.dtype).eps * np.linalg.norm(block) / max(cosine, 1e-300)))
    radius, doubt = max(found)
    return radius, max(doubt, max(sum(one) for one in found) - radius)


def _power_contracts(M) -> bool:
    """Whether ||M^k|| < 1 for some k = 1, 2, 4, ..., 64, rounding of the powers included."""
    power, size = M, np.linalg.norm(M, 2)
    for k in 2 ** np.arange(7):
        rounding = k * len(M) * np.finfo(M.dtype).eps * max(size, 1.0) ** k
        if not rounding < 1:
            return False
        if np.linalg.norm(power, 2) + rounding < 1:
            return True
        power = power @ power
    return False


def _need_product(function, name, matrix, shape):
    if np.shape(matrix) != shape:
        raise ValueError(f"{function}: {name} has shape {np.shape(matrix)}; allowed with this G is {shape}")
