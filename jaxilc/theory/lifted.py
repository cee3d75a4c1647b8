"""The lifted form: a whole trial as one vector, and one trial of learning as one matrix.

    y = G u + d,  u_{j+1} = keep u_j + L e_j     =>   u_{j+1} - u_inf = (keep - L G)(u_j - u_inf)
                                                 =>   e_{j+1} = (I - G L) e_j  where keep = I

u is what is learned and played back; keep and L contain the filters of the law. Rows of G and L
count samples first and channels second: row k n + c is channel c of y[k+1], and of u[k]. Every
matrix is taken from the simulator and from the scheme itself by linearisation; none is written down
a second time. The matrices are dense, for N up to a few thousand. Beyond that `contraction` gives
the same numbers without a matrix.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from ..learning.machine import Machine
from ..learning.over_trials import check
from ..pytree.ranges import require
from ..schemes import NormOptimal, Scheme
from ..schemes.scheme import Memory
from ..signals.task import Task
from ..uncertainty import drawn_machines
from .condition import Condition, condition, premise
from .law import learning_law
from .learning_map import limit_names
from .linearity import alike_trials, keeps_all, linear_law, linear_trial, of_last_trial
from .outlook import outlooks
from .spectrum import asymptotic, monotone, sigma_max, spectral_radius, transient, transient_growth
from .trials import learned_shape, played, starts_off

__all__ = [
    "asymptotic",
    "error_map",
    "input_map",
    "learning_conditions",
    "learning_law",
    "lifted_plant",
    "mfailc_map",
    "monotone",
    "sigma_max",
    "spectral_radius",
    "transient",
    "transient_growth",
    "weights_condition",
]

BY_WEIGHTS = "the input of the model converges monotonically (MILC 2024, Theorem 2)"

NO_REST = "no error is left that the law reads"


def lifted_plant(
    machine: Machine,
    scheme: Scheme | None,
    task: Task,
    *,
    about=None,
    memory: Memory = None,
    time_invariant: bool | None = None,
) -> np.ndarray:
    """(N n_y, N n_w) G = d y[1..N] / d w[0..N-1] of what is played, w, exactly from the simulator.

    scheme: plays w (N, n_w) in place of what it learned. For `WithFeedback(learning, feedback)` G
            is the closed loop that the learning sees, P / (1 + C P). For `OnReference` w is the
            correction of the reference, and G is C P / (1 + C P). For `MultivariableILC` w is input
            and reference. A scheme that learns nothing has w added to its input; None is no scheme
    about:  (N, n_w) w at which a machine that is not linear is linearised; None for what is learned
            so far
    memory: what the scheme knows; None for its start
    time_invariant: True takes one impulse response for all columns; False takes every column by
                  itself; None takes one if it also explains the answer to a random input, which
                  under a time-varying loop it does not

    Raises ValueError where machine, scheme and task do not fit, or for `about` of another shape.
    """
    arguments = _arguments(machine, scheme, task, about, memory)
    if time_invariant is not False:
        impulse, probe, answer = map(np.asarray, _impulse_response(*arguments))
        G = _toeplitz(impulse)
        miss = np.max(np.abs(G @ probe.ravel() - answer.ravel()))
        if time_invariant or miss <= np.sqrt(np.finfo(G.dtype).eps) * np.max(np.abs(answer)):
            return G
    return np.asarray(_columns(*arguments))


def error_map(G, L) -> np.ndarray:
    """(N n_y, N n_y) I - G L of e_{j+1} = (I - G L) e_j, where the law keeps all of u_j.

    G: (N n_y, N n_w)
    L: (N n_w, N n_y)
    """
    _need_product("error_map", G, L)
    return np.eye(G.shape[-2]) - G @ L


def input_map(G, L, *, keep=None) -> np.ndarray:
    """(N n_w, N n_w) keep - L G, the map of u_j - u_inf to u_{j+1} - u_inf.

    G, L: as in `error_map`
    keep: (N n_w, N n_w); None for the identity
    """
    _need_product("input_map", G, L)
    return (np.eye(G.shape[-1]) if keep is None else keep) - L @ G


def weights_condition(learning: NormOptimal) -> Condition:
    """|M| < 1 of norm-optimal learning by its weights alone (MILC 2024, Theorem 2).

        M = (H' W_q H + W_s + W_r)^-1 W_r,    |M| <= w_r / (w_r + min eig W_s)

    for every model H, where W_q >= 0, W_s > 0 and W_r = w_r I. It is a claim on the model that the
    scheme learns with; `learning_conditions` looks at the plant.
    """
    channels = {"w_q": learning.model.n_y, "w_r": learning.model.n_u, "w_s": learning.model.n_u}
    found = {}
    for name, n in channels.items():
        weight = np.asarray(getattr(learning, name))
        square = weight if weight.ndim == 2 else np.diag(np.broadcast_to(weight, (n,)))
        found[name] = np.linalg.eigvalsh((square + square.T) / 2)
    (w_q, w_r, w_s), most = found.values(), found["w_r"][-1]
    premises = (
        premise("W_q is positive semidefinite", w_q[0] >= 0, f"least eigenvalue {w_q[0]:.4g}"),
        premise("W_s is positive definite", w_s[0] > 0, f"least eigenvalue {w_s[0]:.4g}"),
        premise(
            "W_r = w_r I", most - w_r[0] <= 1e-9 * most, f"eigenvalues {w_r[0]:.4g}, {most:.4g}"
        ),
    )
    least = most + w_s[0]
    return condition(most / least if least else np.nan, BY_WEIGHTS, premises=premises)


def mfailc_map(G, phi, lam, rho=1.0, *, lead: int = 0) -> np.ndarray:
    """(..., N n, N n) I - G diag(gamma) S^lead of e_{j+1} under CFDL-MFAILC (Cao 2019, eq. 12).

        gamma = rho phi / (lam + phi^2),    S e[k] = e[k+1]

    G:        (N n, N n)
    phi:      (N, n) or (N,) the estimate, frozen; leading axes give one map for each, so (J, N, n)
              gives those of J trials
    lam, rho: (), or (n,) of each channel
    lead:     samples by which learning looks further ahead, as many as the trial has at most

    This is the exact map of a linear machine. |1 - rho phi phi_hat / (lam + phi_hat^2)| < 1 (eq.
    15) looks at its diagonal only: it ignores that y[k+1] also depends on the inputs before u[k].
    Raises ValueError for a phi that does not fit G, and for a lead outside of the trial.
    """
    G, phi = np.asarray(G), np.asarray(phi, float)
    size = G.shape[-1]
    fits = phi.shape[-1:] == (size,) or (phi.ndim > 1 and phi.shape[-2] * phi.shape[-1] == size)
    if G.shape != (size, size) or not fits:
        raise ValueError(
            f"mfailc_map: phi has shape {phi.shape}, G {G.shape}; allowed are (..., N) and (..., "
            "N, n) with G (N n, N n)"
        )
    phi = phi[..., None] if phi.shape[-1] == size else phi
    require("mfailc_map", "lead", lead, f"[0, {phi.shape[-2]}]", whole=True)
    gamma = np.asarray(rho * phi / (lam + phi**2)).reshape(*phi.shape[:-2], 1, size)
    weighted, shift = G * gamma, lead * phi.shape[-1]
    shifted = np.zeros_like(weighted[..., :shift]), weighted[..., : size - shift]
    return np.eye(size) - np.concatenate(shifted, axis=-1)


def learning_conditions(
    machine: Machine, scheme: Scheme, task: Task, *, about=None, memory: Memory = None
) -> dict[str, Condition]:
    """The conditions `monotone` and `asymptotic` of the input, and `monotone_error` of the error.

    The first two are of keep - L G. The last is of I - G L, where nothing is filtered or forgotten.
    They hold for all trials to come: a premise says whether a limit of machine or scheme is ever
    met.

    about, memory: where a machine or law that is not linear is linearised; a premise then says that
                  it is not linear
    """
    G = lifted_plant(machine, scheme, task, about=about, memory=memory)
    task = machine.at_trial(task, None)[1]
    law, one = learning_law(scheme, task, memory), drawn_machines(machine, {}, {})
    premises = [
        linear_trial(machine, scheme, task, memory=memory),
        linear_law(scheme, task, memory),
        alike_trials(machine, scheme, task),
    ]
    if premises[1].held:  # one that adapts remembers anyway
        premises.append(of_last_trial(scheme, task))
    if limit_names(one, scheme, task):
        premises.append(outlooks(one, scheme, task).of_limits)
    M = input_map(G, law.L, keep=law.keep)
    found = {
        "monotone": monotone(M, premises=premises),
        "asymptotic": asymptotic(M, premises=premises),
    }
    if np.array_equal(law.keep, np.eye(len(law.keep))):
        off = not keeps_all(scheme, task, off=True) and bool(starts_off(machine, scheme, task))
        said = "the law reads e[0], which no input reaches" if off else ""
        premises.append(premise(NO_REST, not off, said))
        found["monotone_error"] = monotone(error_map(G, law.L), premises=premises)
    return found


# How it is done
# --------------------------------------------------------------------------------------------------


def _arguments(machine, scheme, task, about, memory):
    """The arguments of the compiled functions, checked."""
    if scheme is None:
        machine.check(task)
    else:
        check(machine, scheme, task)
        task = machine.at_trial(task, None)[1]
        memory = scheme.initial_memory(task) if memory is None else memory
    learned = learned_shape(scheme, task)
    shape = learned or (task.N, task.inputs)
    if about is None:
        about = jnp.zeros(shape) if learned is None else scheme.feedforward(memory, task)
    about = jnp.asarray(about, float)
    if about.shape != shape:
        raise ValueError(f"lifted_plant: about has shape {about.shape}; this task needs {shape}")
    return machine, scheme, task, memory, about


def _output(machine, scheme, task, memory, w):
    """(N, n_y) y[1..N] of a trial."""
    return played(machine, scheme, task, memory, w).y[1:]


@jax.jit
def _impulse_response(machine, scheme, task, memory, about):
    """The answer (N, n_y, n_u) to impulses at k = 0, and a random (N, n_u) input with its answer.

    The last is (N, n_y); it tests whether the impulse response explains other inputs.
    """
    _, push = jax.linearize(partial(_output, machine, scheme, task, memory), about)
    impulses = jnp.zeros((about.shape[1], *about.shape)).at[:, 0].set(jnp.eye(about.shape[1]))
    probe = jnp.asarray(np.random.default_rng(1).standard_normal(about.shape), about.dtype)
    answers = jax.vmap(push)(jnp.concatenate([impulses, probe[None]]))
    return jnp.moveaxis(answers[:-1], 0, -1), probe, answers[-1]


@jax.jit
def _columns(machine, scheme, task, memory, about):
    _, push = jax.linearize(partial(_output, machine, scheme, task, memory), about)
    impulses = jnp.eye(about.size).reshape(-1, *about.shape)
    return lax.map(lambda impulse: push(impulse).reshape(-1), impulses, batch_size=64).T


def _toeplitz(impulse):
    """(N n_y, N n_u) from an (N, n_y, n_u) impulse response."""
    N, n_y, n_u = impulse.shape
    lag = np.arange(N)[:, None] - np.arange(N)
    blocks = np.where(lag[..., None, None] >= 0, impulse[lag], 0.0)
    return blocks.transpose(0, 2, 1, 3).reshape(N * n_y, N * n_u)


def _need_product(function, G, L):
    shape = (G.shape[-1], G.shape[-2])
    if np.shape(L) != shape:
        raise ValueError(f"{function}: L has shape {np.shape(L)}; allowed with this G is {shape}")
