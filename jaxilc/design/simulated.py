"""P-type and PD-type laws simulated by transforms, with the ends of the trial, many at a time.

    e_j = e_1 - P u_j,    u_{j+1} = Q (u_j + gamma_p d_j[k+1+m] + gamma_d (d_j[k+1+m] - d_j[k+m]))

with d_j = F e_j. P is a convolution with the impulse response; Q and the band-stop filter F, where
a law has one, mirror the trial at its ends and are products after a cosine transform. Nothing is
compiled, so laws of many leads cost milliseconds each. Noise and limits are left out. A lead beyond
the delay of the plant leaves the last samples of a trial without an error to learn from, of which
the frequency response knows nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
import scipy.fft

from ..filters import ZeroPhaseBandStop
from ..theory.loop import Loop
from ..theory.on_lines import low_pass


def rms_of(
    loops: Sequence[Loop], error, laws: Sequence[dict[str, Any]], dt: float, trial: int, order: int
) -> np.ndarray:
    """(laws, S) root mean square error of a trial, over its samples after the first.

    loops: of S machines
    error: (N+1,) of the first trial, in which nothing was learned
    laws: numbers gamma_p, gamma_d, lead and cutoff of each, and the edges low and high of F
    order: of the filter, in one pass
    """
    error = np.asarray(error, float)
    N = len(error) - 1
    size = scipy.fft.next_fast_len(2 * N, real=True)
    P = scipy.fft.rfft(np.stack([impulse_response(loop, N) for loop in loops]), size)
    cutoffs = np.array([law["cutoff"] for law in laws])
    lines = np.arange(N) / (2 * N * dt)
    Q = low_pass(lines, cutoffs[:, None], dt, order)[:, None]
    angles = np.pi / 2 * np.arange(N + 1) / (N + 1)
    F = np.stack([notch_of(law, angles, dt) for law in laws])[:, None]
    u = np.zeros((len(laws), len(loops), N))
    for _ in range(trial - 1):
        e = _weighted(F, _error(error, P, u, size))
        u = u + np.stack([_step(law, one) for law, one in zip(laws, e, strict=True)])
        u = _weighted(Q, u)
    return np.sqrt(np.mean(_error(error, P, u, size)[..., 1:] ** 2, axis=-1))


def notch_of(law: dict[str, Any], angles, dt: float) -> np.ndarray:
    """(F,) the filter F of a law at pi f dt = angles, 1 if it has none."""
    if "low" not in law:
        return np.ones(len(angles))
    return np.asarray(_response(ZeroPhaseBandStop(law["low"], law["high"]), angles, dt))


_response = jax.jit(lambda notch, angles, dt: notch.response(angles, dt))


def impulse_response(loop: Loop, samples: int) -> np.ndarray:
    """(N,) C A^k B of a loop of one input and output."""
    A, B, C = (np.asarray(M, float) for M in loop)
    found, x = np.empty(samples), B[:, 0]
    for k in range(samples):
        found[k] = C[0] @ x
        x = A @ x
    return found


def _error(error, P, u, size: int) -> np.ndarray:
    """(laws, S, N+1) the error of the trial in which u (laws, S, N) is played."""
    y = scipy.fft.irfft(P * scipy.fft.rfft(u, size), size)[..., : u.shape[-1]]
    return error - np.concatenate([np.zeros((*u.shape[:-1], 1)), y], axis=-1)


def _weighted(response, signal) -> np.ndarray:
    """Signals (..., N), mirrored at their ends, through zero-phase filters."""
    if np.all(response == 1):
        return signal
    return scipy.fft.idct(response * scipy.fft.dct(signal, norm="ortho"), norm="ortho")


def _step(law: dict[str, Any], e) -> np.ndarray:
    """(S, N) L e of errors (S, N+1); beyond the end of the trial they count as zero."""
    lead, N = int(law["lead"]), e.shape[-1] - 1
    step = np.zeros((len(e), N))
    step[:, : N - lead] = law["gamma_p"] * e[:, 1 + lead :]
    change = np.diff(e, axis=-1)[:, lead:]
    step[:, : N - lead] += law["gamma_d"] * change
    return step
