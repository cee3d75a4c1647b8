"""Nominal models of a drive under its position loop, for a model-based scheme (MILC 2024, Lemma 1).

The blocks are systems of python-control or `StateSpace`, and the result is a discrete `StateSpace`
(see also Lemma A1). A controller that is a number and a drive that is a `StateSpace` may be traced.
The model then has gradients by them, and is not checked for stability. A position loop feeds the
motor's position back; the table is measured beside it:

    y_M = P_M v,  y_T = P_Z y_M,  v = u + C_P (r - y_M),  S = 1 / (1 + C_P P_M)

Everywhere u[k] acts on y[k+1], and a learned reference likewise: its row k is r[k+1], what the
feedback sees a sample later.
"""

from __future__ import annotations

from types import ModuleType

import jax
import jax.numpy as jnp
import numpy as np

from ..pytree.aliases import Tree, Value
from ..pytree.needs import known
from .from_python_control import Matrices, system_matrices
from .linear import StateSpace
from .to_python_control import as_system


def cascade(P_M: Value, P_Z: Value, dt: float) -> StateSpace:
    """The drive u -> (y_M, y_T) from its motor side and its transmission.

    P_M: strictly proper, velocity command to motor position, one input and one output
    P_Z: proper, motor to table position, one input and one output
    dt:  sample time [s]; continuous blocks are sampled with a zero-order hold

    Raises ValueError for blocks that do not fit.
    """
    (A_m, B_m, C_m, D_m), (A_z, B_z, C_z, D_z) = (
        _block(name, P, dt) for name, P in (("P_M", P_M), ("P_Z", P_Z))
    )
    if np.any(D_m):
        raise ValueError(
            f"cascade: P_M has the feedthrough {D_m.tolist()}; allowed is none, since u[k] acts on "
            "y[k+1]"
        )
    n, m = len(A_m), len(A_z)
    A = np.block([[A_m, np.zeros((n, m))], [B_z @ C_m, A_z]])
    B = np.vstack([B_m, np.zeros((m, 1))])
    C = np.block([[C_m, np.zeros((1, m))], [D_z @ C_m, C_z]])
    return StateSpace(A, B, C, dt=dt)


def direct_model(C_P: Value, P: StateSpace) -> StateSpace:
    """H_D = S P_M P_Z from u to y_T: what learning on the table's error sees (MILC 2024, Lemma A1).

    C_P: position controller, a gain or a discrete system of one input and one output
    P:   the drive u -> (y_M, y_T), see `cascade`

    Raises ValueError for blocks that do not fit, or a closed loop that is unstable.
    """
    A, B, _, C_T = _loop("direct_model", C_P, P)
    return StateSpace(A, B[:, :1], C_T, dt=P.dt)


def multivariable_model(C_P: Value, P: StateSpace) -> StateSpace:
    """H_M from (u, r) to (y_M - r, y_T) (MILC 2024, eq. 27 and Lemma 1).

        H_M = [[P_M S, -S], [P_Z P_M S, C_P P_Z P_M S]]

    Lemma 1 has r[k] act on the error of the same sample. Here row k of the input is r[k+1], which
    one more state holds for a sample, and there is no feedthrough. C_P, P and errors are as for
    `direct_model`.
    """
    A, B, C_e, C_T = _loop("multivariable_model", C_P, P)
    xp: ModuleType = np if known(C_e) else jnp
    return StateSpace(A, B, xp.vstack([-C_e, C_T]), dt=P.dt)


def _loop(function: str, C_P: Value, P: StateSpace) -> Tree:
    """The closed loop of the states (controller, drive, held reference).

    It returns A and B of (u, r), and the rows of e = r - y_M and of y_T.
    """
    if not P.dt or (P.n_u, P.n_y) != (1, 2):
        raise ValueError(
            f"{function}: P is {P.n_u} -> {P.n_y} with dt = {P.dt:g}; allowed is a discrete drive "
            "1 -> 2, see `cascade`"
        )
    host = known((C_P, P.A, P.B, P.C))
    xp: ModuleType = np if host else jnp
    A_m, B_m, C = (xp.asarray(M) for M in (P.A, P.B, P.C))
    C_M, C_T = C[:1], C[1:]
    if isinstance(C_P, int | float | np.number | np.ndarray | jax.Array):
        A_c, B_c, C_c = np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0))
        D_c = xp.asarray(C_P, float).reshape(1, 1)
    else:
        A_c, B_c, C_c, D_c = _block("C_P", C_P, P.dt)
    n_c, n = len(A_c), len(A_m)
    A = xp.block(
        [
            [A_c, -B_c @ C_M, B_c],
            [B_m @ C_c, A_m - B_m @ D_c @ C_M, B_m @ D_c],
            [np.zeros((1, n_c)), np.zeros((1, n)), np.zeros((1, 1))],
        ]
    )
    B = xp.vstack([np.zeros((n_c, 2)), xp.hstack([B_m, np.zeros((n, 1))]), np.array([[0.0, 1.0]])])
    radius = np.max(np.abs(np.linalg.eigvals(A))) if host else 0.0
    if radius > 1 + 1e-7:
        raise ValueError(
            f"{function}: C_P makes the position loop unstable (spectral radius {radius:.6g}); "
            "allowed is at most 1"
        )
    return (
        A,
        B,
        xp.hstack([np.zeros((1, n_c)), -C_M, np.ones((1, 1))]),
        xp.hstack([np.zeros((1, n_c)), C_T, np.zeros((1, 1))]),
    )


def _block(name: str, system: Value, dt: float) -> Matrices:
    """A, B, C, D of a block of one input and one output, sampled at dt [s]."""
    import control

    if isinstance(system, StateSpace):
        system = as_system(system.A, system.B, system.C, system.dt)
    if not isinstance(system, control.StateSpace | control.TransferFunction) or (
        system.ninputs,
        system.noutputs,
    ) != (1, 1):
        number = "a number, nor " if name == "C_P" else ""
        raise ValueError(
            f"{name} is not {number}a system of one input and one output, of python-control or a "
            "StateSpace"
        )
    if system.dt == 0:
        system = control.sample_system(control.ss(system), dt, "zoh")
    elif system.dt is None or system.dt is True or abs(system.dt - dt) > 1e-9 * dt:
        raise ValueError(
            f"{name} has the sample time {system.dt}; allowed are 0 (continuous) and {dt:g} s"
        )
    return system_matrices(system)
