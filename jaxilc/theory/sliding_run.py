"""The sliding condition of sliding mode control along a simulated or a measured trial (Xu 2024).

    sigma' = f - eta_hat s(sigma) - k_n sigma,    V = sigma^2 / 2

s is sgn, or sat(sigma / Delta) with a boundary layer. The paper takes the disturbance f to be
bounded. Here f is computed from the trial.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..schemes import ASMC, SMC, Scheme, WithFeedback
from ..schemes.compose import signals_of_part
from ..signals.task import Trial
from .condition import Condition, condition, premise

SLIDING = (
    "|f| < eta_hat + k_n Delta: V falls outside the boundary layer, so that sigma reaches it and "
    "stays (Xu 2024, eq. 9 and 17, without the "
    "k_n Delta by which the reaching law helps at the edge of the layer; Delta = 0 for sgn, "
    "sampled: a band in proportion to dt)"
)
RISE = 1e-9  # a relative rise of V that rounding explains


class Sliding(NamedTuple):
    """How a trial slid.

    V:           (N, n) sigma^2 / 2 [y^2/s^2]
    eta_hat:     (N, n) switching gain [y/s^2]
    disturbance: (N-1, n) realised f[k], k = 1..N-1 [y/s^2]: all that the law did not foresee, such
                 as mismatch, loads, the half sample by which u acts late, limits, and b times a
                 learned part of u
    band:        (n,) Delta, or the overshoot (eta_hat + 2 |f|) (dt + tau) of an input that is held,
                 if that is wider [y/s]
    error_band:  (n,) largest |e| that a sigma within the band can bring about [y]
    towards:     share of samples, of those outside the layer, with sigma[k] (sigma[k+1] - sigma[k])
                 <= 0
    falling:     the same with V[k+1] <= V[k]
    dominated:   share of all samples with eta_hat > |f|
    reached:     first sample from which on sigma stays in the band; N if it does not
    condition:   |f| / (eta_hat + k_n Delta) < 1 at every sample
    """

    V: np.ndarray
    eta_hat: np.ndarray
    disturbance: np.ndarray
    band: np.ndarray
    error_band: np.ndarray
    towards: float
    falling: float
    dominated: float
    reached: int
    condition: Condition


def sliding(scheme: Scheme, trial: Trial) -> Sliding:
    """The sliding condition along a trial of `SMC` or `ASMC`, alone or within `WithFeedback`.

        f[k] = e'' + lam1 e' + lam2 e + mean_{i=k-1,k} (eta_hat[i] s(sigma[i]) + k_n sigma[i])

    with central differences of e = y - r. The mean is over the two intervals that the second
    difference spans.

    trial: simulated, or measured with the signals `sigma` and `eta_hat` (of WithFeedback:
           `feedback`, `feedback.sigma`, `feedback.eta_hat`)

    Raises ValueError for another scheme, or a trial without these signals.
    """
    law, signals, u, dt = sliding_mode_of("sliding", scheme), trial.signals, trial.u, trial.dt
    if isinstance(scheme, WithFeedback):
        u, signals = signals.get("feedback", u), signals_of_part("feedback", signals)
    missing = [name for name in ("sigma", "eta_hat") if name not in signals]
    if missing:
        raise ValueError(
            f"sliding: the trial has no signal {' and '.join(map(repr, missing))} (N, n_u)"
        )
    sigma, eta_hat, e = (
        np.asarray(x, float) for x in (signals["sigma"], signals["eta_hat"], -trial.e)
    )
    layer = np.broadcast_to(getattr(law, "Delta", 0.0), sigma.shape[1:])
    acted = eta_hat * np.asarray(law.switching(sigma)) + law.k_n * sigma
    f = (
        np.diff(e, 2, axis=0) / dt**2
        + law.lam1 * (e[2:] - e[:-2]) / (2 * dt)
        + law.lam2 * e[1:-1]
        + (acted[1:] + acted[:-1]) / 2
    )
    size, gain, reserve = np.abs(f), eta_hat[1:], law.k_n * layer
    value = np.max(
        np.divide(
            size, gain + reserve, out=np.where(size > 0, np.inf, 0.0), where=gain + reserve > 0
        )
    )
    band = np.maximum(layer, np.max(gain + 2 * size, axis=0) * (dt + law.tau))
    now, V, step = sigma[:-1], sigma**2 / 2, np.diff(sigma, axis=0)
    outside, beyond = np.abs(now) > layer, np.flatnonzero(np.any(np.abs(sigma) > band, axis=1))
    steepest = (
        law.lam1 + law.k_n + (np.max(eta_hat, axis=0) / layer if isinstance(law, ASMC) else 0.0)
    )
    within = True if law.limit is None else np.abs(np.asarray(u)) < law.limit
    found = (
        f"|f| up to {np.max(size):.4g}, eta_hat {np.min(eta_hat):.4g} to {np.max(eta_hat):.4g}, "
        f"k_n Delta up to {np.max(reserve):.4g}"
    )
    error_band, inside = band * _error_of_sigma(law), np.abs(sigma) <= band
    left = inside[:-1] & ~inside[1:]
    risen = ~inside[:-1] & (V[1:] > V[:-1] * (1 + RISE))
    of_error = (
        f"within it |e| may be up to {np.max(error_band):.4g}, and was up to "
        f"{np.max(np.abs(e)):.4g}"
    )
    premises = (
        premise("u within its limit", within, f"limit {law.limit}; {found}"),
        premise(
            "sampled fast enough: (lam1 + k_n + eta_hat / Delta) dt < 2",
            steepest * dt < 2,
            f"{np.max(steepest) * dt:.3g}",
        ),
        premise(
            "sigma, once in its band, is seen to stay",
            ~left | (value >= 1),
            f"it leaves it {int(np.sum(left))} times; {of_error}",
        ),
        premise(
            "sigma, beyond its band, is seen to fall",
            ~risen | (value >= 1),
            f"it rises {int(np.sum(risen))} times, as it can where the trial starts off its path",
        ),
    )
    return Sliding(
        V=V,
        eta_hat=eta_hat,
        disturbance=f,
        band=band,
        error_band=error_band,
        towards=_share(now * step <= 0, outside),
        falling=_share(V[1:] <= V[:-1], outside),
        dominated=float(np.mean(gain > size)),
        reached=int(beyond[-1]) + 1 if beyond.size else 0,
        condition=condition(value, SLIDING, premises=premises),
    )


def sliding_mode_of(name: str, scheme: Scheme) -> SMC:
    feedback = scheme.feedback if isinstance(scheme, WithFeedback) else scheme
    if not isinstance(feedback, SMC):
        raise ValueError(
            f"{name}: {type(feedback).__name__} is no sliding mode control; allowed are SMC and "
            "ASMC, also within WithFeedback"
        )
    return feedback


def _error_of_sigma(law: SMC):
    """(n,) sup |e| / sup |sigma| of sigma = e' + lam1 e + lam2 int e.

    It is the area under |the impulse response|; 1 / lam1 for lam2 = 0. The step response (exp(-slow
    t) - exp(-fast t)) / (fast - slow) has one hump if the roots are real. If they are complex it
    has many, and each is smaller than the one before by the same factor. The area is its total
    variation, twice the sum of the humps.
    """
    lam1, lam2 = np.broadcast_arrays(np.asarray(law.lam1, float), np.asarray(law.lam2, float))
    # moved off the double root, where the quotients below are 0 / 0
    root = np.sqrt(lam1**2 * (1 + 1e-12) - 4 * lam2 + 0j)
    fast, slow = (lam1 + root) / 2, np.where(lam2 > 0, (lam1 - root) / 2, 1.0)
    top = np.real(np.log(fast / slow) / (fast - slow))
    hump = np.abs((np.exp(-slow * top) - np.exp(-fast * top)) / (fast - slow))
    following = np.exp(-np.pi * lam1 / np.maximum(np.abs(root.imag), 1e-3 * lam1))
    return np.where(lam2 > 0, 2 * hump / (1 - following), 1 / lam1)


def _share(holds, among) -> float:
    """The share of the samples in question for which it holds; 1 if there are none."""
    return float(np.mean(holds[among])) if np.any(among) else 1.0
