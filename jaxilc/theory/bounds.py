"""The contraction bounds d1 and d2 of Cao 2019, as realised on a run, with every premise checked.

The theory takes D y(k+1, j) = phi(k, j) D u(k, j), for a pseudo partial derivative (PPD) phi that
is bounded, of constant sign and away from zero. On a static plant that holds. On a dynamic plant
D y(k+1, j) depends on the whole past of D u(., j), so phi can change its sign and grow without
bound, and the bounds do not apply. Here phi is computed from the run, and a bound is claimed only
where every premise held at every sample and trial.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from ..pytree.in_short import in_short
from ..runtime.capacity import check_size
from ..schemes import CFDLMFAILC, FFDLMFAILC
from ..signals.task import Task, Trial
from .condition import Condition, condition, premise

CHUNK = 16  # machines whose signals are looked at together
COPIES = 12  # of the signals of a run, while its bounds are looked at
INCREMENT = 1e-9  # increments below this share of the largest one are no excitation


class CFDLBounds(NamedTuple):
    """The bounds on each sample k and trial j = 2..J of CFDL-MFAILC.

    Arrays are (J-1, N), with NaN where the increment of the input is too small to tell anything.

    phi:       realised PPD D y(k+1,j) / D u(k,j)
    estimate:  phi_hat(k,j) as the law used it
    b:         () largest |phi|
    lam_min:   () b^2 / 4
    M1:        () smallest phi phi_hat / (lam + phi_hat^2)
    d1:        realised 1 - eta du^2 / (mu + du^2)
    d2:        realised |1 - rho phi phi_hat / (lam + phi_hat^2)|
    d1_worst:  () 1 - eta epsilon^2 / (mu + epsilon^2), which is all that eq. 14 promises
    d2_worst:  () 1 - rho M1 (eq. 15)
    ppd_bound: d1 |error of trial j-1| + 2 b, a bound of `ppd_error`
    ppd_error: |phi_hat - phi|
    observed:  |e(k+1,j)| / |e(k+1,j-1)|
    condition: eq. 15 with its premises
    """

    phi: np.ndarray
    estimate: np.ndarray
    b: float
    lam_min: float
    M1: float
    d1: np.ndarray
    d2: np.ndarray
    d1_worst: float
    d2_worst: float
    ppd_bound: np.ndarray
    ppd_error: np.ndarray
    observed: np.ndarray
    condition: Condition
    __repr__ = in_short


def cfdl_bounds(scheme: CFDLMFAILC, task: Task, y, u) -> CFDLBounds:
    """d1 and d2 of a run of CFDL-MFAILC on one machine (Cao 2019, eq. 13 to 15).

    The machine has one input and one output.

    y: (J, N+1, 1) outputs of the trials, J >= 3, from the first one on
    u: (J, N, 1) inputs of the trials

    Raises ValueError for shapes that are not those of the task, or a run that is not finite.
    """
    y, u = _run("cfdl_bounds", task, y, u)
    lam, rho, eta, mu = (float(v) for v in (scheme.lam, scheme.rho, scheme.eta, scheme.mu))
    e = np.asarray(task.reference)[None, 1:, 0] - y[:, 1:]
    du, dy = np.diff(u, axis=0), np.diff(y[:, 1:], axis=0)
    excited, lipschitz = _excited(du, dy)
    phi = np.where(excited, dy, np.nan) / np.where(excited, du, 1.0)
    (used,) = _estimates(scheme, task, y, u)
    estimate = np.where(excited, used, np.nan)
    gain = phi * estimate / (lam + estimate**2)
    b, M1 = float(np.nanmax(np.abs(phi))), float(np.nanmin(gain))
    epsilon = float(scheme.epsilon)
    d1, d2 = 1.0 - eta * du**2 / (mu + du**2), np.abs(1.0 - rho * gain)
    ppd_error = np.abs(estimate - phi)
    bound = np.full_like(ppd_error, np.nan)
    bound[1:] = d1[:-1] * ppd_error[:-1] + 2.0 * b
    sign = np.sign(phi)
    reference_sign = np.sign(np.nansum(sign)) or 1.0
    premises = (
        premise("Lipschitz: |Dy(k+1)| <= b |Du(k)|", lipschitz, f"b = {b:.4g} where Du excites"),
        premise(
            "constant sign of phi",
            ~excited | (sign == reference_sign),
            f"phi within [{np.nanmin(phi):.4g}, {np.nanmax(phi):.4g}]",
        ),
        premise(
            "phi bounded away from 0",
            ~excited | (np.abs(phi) > epsilon),
            f"smallest |phi| = {np.nanmin(np.abs(phi)):.4g}",
        ),
        premise(
            "sign of the estimate",
            ~excited | (np.sign(estimate) == sign),
            "sign phi_hat = sign phi",
        ),
        premise(
            "lam > b^2 / 4",
            ~excited | (phi**2 / 4.0 < lam),
            f"lam = {lam:.4g}, b^2 / 4 = {b**2 / 4.0:.4g}",
        ),
        premise(
            "the law acts in every trial, unlimited",
            _lawful(du, used, lam=lam, rho=rho, e=e, lead=scheme.lead),
            "Du = gain e(k+1, j-1)",
        ),
        premise(
            "no lead: u(k) is learned from e(k+1)",
            scheme.lead == 0,
            f"lead = {scheme.lead}; eq. 15 compares e(k+1) alone",
        ),
    )
    d2_worst = 1.0 - rho * M1
    return CFDLBounds(
        phi=phi,
        estimate=estimate,
        b=b,
        lam_min=b**2 / 4.0,
        M1=M1,
        d1=d1,
        d2=d2,
        d1_worst=1.0 - eta * epsilon**2 / (mu + epsilon**2),
        d2_worst=d2_worst,
        ppd_bound=bound,
        ppd_error=ppd_error,
        observed=_ratio(e),
        condition=condition(
            d2_worst, "Cao 2019, eq. 15: |e(k+1,j)| <= d2 |e(k+1,j-1)|", premises=premises
        ),
    )


class FFDLBounds(NamedTuple):
    """What Theorem 2 of Cao 2019 promises of the pseudo gradient.

    Arrays are (J-1, N), for each sample k and trial j = 2..J.

    b:         () largest |Dy(k+1,j)| / |DH(k,j)|, which bounds the shortest pseudo gradient,
               Dy DH / |DH|^2
    gradient:  |Dy| / |DH|, the length of that gradient
    estimate:  length of Phi_hat(k,j)
    d1:        1 - eta |DH|^2 / (mu + |DH|^2), the estimator's contraction along DH (across DH it
               contracts nothing)
    mismatch:  |Dy - Phi_hat . DH| / |DH|, what the estimate misses along DH
    observed:  |e(k+1,j)| / |e(k+1,j-1)|
    condition: the boundedness of the pseudo gradient with its premise
    """

    b: float
    gradient: np.ndarray
    estimate: np.ndarray
    d1: np.ndarray
    mismatch: np.ndarray
    observed: np.ndarray
    condition: Condition
    __repr__ = in_short


def ffdl_bounds(scheme: FFDLMFAILC, task: Task, y, u) -> FFDLBounds:
    """The pseudo gradient of a run of FFDL- or PFDL-MFAILC on one machine.

    It is Cao 2019, eq. 17, 18 and 27. Arguments and errors are those of `cfdl_bounds`.
    """
    y, u = _run("ffdl_bounds", task, y, u)
    eta, mu = float(scheme.eta), float(scheme.mu)
    du, dy = np.diff(u, axis=0), np.diff(y, axis=0)
    windows = [_past(dy[:, :-1], i) for i in range(scheme.L_y)] + [
        _past(du, i) for i in range(scheme.L_u)
    ]
    DH, Dy = np.stack(windows), dy[:, 1:]
    length = np.sqrt(np.sum(DH**2, axis=0))
    excited, lipschitz = _excited(length, Dy)
    estimate = np.stack(_estimates(scheme, task, y, u))
    safe = np.where(excited, length, 1.0)
    gradient = np.where(excited, np.abs(Dy), np.nan) / safe
    b = float(np.nanmax(gradient))
    premises = (
        premise("Lipschitz: |Dy(k+1)| <= b |DH(k)|", lipschitz, f"b = {b:.4g} where DH excites"),
        premise(
            "a statement on convergence",
            False,
            "any finite b fulfils it: Theorem 2 bounds the pseudo gradient and says nothing of the "
            "error",
        ),
    )
    return FFDLBounds(
        b=b,
        gradient=gradient,
        estimate=np.sqrt(np.sum(estimate**2, axis=0)),
        d1=1.0 - eta * length**2 / (mu + length**2),
        mismatch=np.where(excited, np.abs(Dy - np.sum(estimate * DH, axis=0)), np.nan) / safe,
        observed=_ratio(np.asarray(task.reference)[None, 1:, 0] - y[:, 1:]),
        condition=condition(
            b,
            "Cao 2019, Theorem 2: a pseudo gradient with |Phi(k,j)| <= b exists. Nothing follows "
            "of the error",
            limit=np.finfo(float).max,
            premises=premises,
        ),
    )


def need_room(task: Task, trials: int, chunk: int = CHUNK) -> None:
    """Raises ValueError for trials whose signals, for a chunk of machines, exceed the RAM."""
    signals = COPIES * 8 * chunk * (task.N + 1) * (task.outputs + task.inputs)
    check_size("certify: the bounds of Cao 2019", lambda trials: signals * trials, trials=trials)


def _run(name: str, task: Task, y, u):
    """(J, N+1) and (J, N) of a run, checked."""
    y, u = np.asarray(y, float), np.asarray(u, float)
    if task.inputs != 1 or task.outputs != 1:
        raise ValueError(
            f"{name}: the task has {task.inputs} inputs and {task.outputs} outputs; allowed is one "
            "of each"
        )
    J = len(y)
    if y.shape != (J, task.N + 1, 1) or u.shape != (J, task.N, 1) or J < 3:
        raise ValueError(
            f"{name}: y {y.shape} and u {u.shape} do not fit; allowed are (J, {task.N + 1}, 1) and "
            f"(J, {task.N}, 1) with J >= 3"
        )
    if not (np.all(np.isfinite(y)) and np.all(np.isfinite(u))):
        raise ValueError(f"{name}: the run is not finite; cut it before the trial that diverged")
    return y[..., 0], u[..., 0]


def _excited(cause, effect):
    """Where the cause is large enough to divide by, and where the effect is bounded by the cause.

    The effect is not bounded where it comes without a cause.
    """
    excited = np.abs(cause) > INCREMENT * max(np.max(np.abs(cause)), 1e-300)
    still = np.abs(effect) <= INCREMENT * max(np.max(np.abs(effect)), 1e-300)
    return excited, excited | still


def _estimates(scheme, task: Task, y, u):
    """L arrays (J-1, N): the estimates that trial j = 2..J used, computed again from the record."""
    return [
        np.asarray(phi)[..., 0] for phi in _replayed(scheme, task, y[:-1, :, None], u[:-1, :, None])
    ]


@jax.jit
def _replayed(scheme, task: Task, y, u):
    def replay(memory, trial):
        memory = scheme.learn(memory, Trial(jnp.asarray(task.reference), *trial, dt=task.dt))
        return memory, memory.phi

    return lax.scan(replay, scheme.initial_memory(task), (y, u))[1]


def _lawful(du, estimate, *, lam, rho, e, lead):
    """Where the increment that was applied is that of the law.

    It is not where a limit, a quantiser, a filter or a rule of when to learn came between.
    """
    wanted = rho * estimate / (lam + estimate**2) * np.pad(e[:-1, lead:], ((0, 0), (0, lead)))
    return np.abs(du - wanted) <= 1e-6 * np.abs(wanted) + INCREMENT * np.max(np.abs(wanted))


def _ratio(e):
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.abs(e[1:]) / np.abs(e[:-1])


def _past(signal, samples: int):
    """signal[:, k - samples], zero before the trial."""
    return signal if samples == 0 else np.pad(signal, ((0, 0), (samples, 0)))[:, :-samples]
