"""The frequency response of a ProcessModel and its exact derivatives, for fits to measured lines.

Which transfer function is fitted depends on the sample time:

    dt given:  P(z) at z = exp(j 2 pi f dt), from the samples of u, held over each sample, to the
               samples of y. That is what a controller measures that puts out u[k] and reads y[k]:
               hold and delay are within the response. It is the response of `plant.sampled(dt)`,
               so the fitted plant, simulated at dt, has the measured response.
    dt None:   G(s) at s = j 2 pi f, from u to y in continuous time, such as an analyser measures
               between two voltages. A hold in the path would be fitted as poles and delay.
"""

from __future__ import annotations

import numpy as np
import scipy

from ..plants.process_model import cascade, samples_of

STEP = (
    1e-30  # of the complex step; the derivative is exact to rounding, since nothing is subtracted
)


def response_and_slopes(
    values: np.ndarray, counts: tuple[int, int, int], f: np.ndarray, dt: float | None
) -> tuple[np.ndarray, np.ndarray]:
    """(F,) response and (F, P) its derivatives by the parameters.

        P(z) = z^-d C (z I - A)^-1 (B_0 + z^-1 B_1)

    The derivatives of A, B_0, B_1 and C are found by a complex step (Squire, Trapp 1998), those of
    P follow from them.

    values: (P,) gain, zeros, poles, frequencies, dampings, delay [s]
    counts: numbers of zeros, poles and pairs
    f: (F,) frequencies [Hz]
    dt: sample time of the zero-order hold [s]; None for continuous time
    """
    s = 2j * np.pi * f
    whole = 0 if dt is None else samples_of(values[-1], dt)[0]
    z = s if dt is None else np.exp(s * dt)
    A, B, C = _matrices(values, counts, dt, whole)
    steps = values + 1j * STEP * np.eye(len(values))
    slopes = [[M.imag / STEP for M in _matrices(row, counts, dt, whole)] for row in steps]
    outer = np.exp(-s * values[-1]) if dt is None else z ** (-whole)
    powers = np.stack([np.ones_like(z), 1 / z])[: B.shape[1]]
    inner = z[:, None, None] * np.eye(len(A)) - A
    x = np.linalg.solve(inner, (B @ powers).T[:, :, None])[:, :, 0]
    left = np.linalg.solve(np.swapaxes(inner, 1, 2), np.broadcast_to(C.T, (len(f), len(A), 1)))
    left = left[:, :, 0]
    response = outer * (x @ C[0])
    derivatives = np.empty((len(f), len(values)), complex)
    for i, (dA, dB, dC) in enumerate(slopes):
        driven = x @ dA.T + (dB @ powers).T
        derivatives[:, i] = outer * (x @ dC[0] + np.sum(left * driven, axis=1))
    if dt is None:
        derivatives[:, -1] = -s * response
    return response, derivatives


def _matrices(values, counts, dt, whole):
    """A (n, n), B (n, 1) or (n, 2) with B_0 and B_1, and C (1, n)."""
    m, n, q = counts
    gain, zeros, poles, frequencies, dampings, delay = np.split(values, np.cumsum([1, m, n, q, q]))
    A, B, C = cascade(gain[0], zeros, poles, frequencies, dampings, array=np.array)
    if dt is None:
        return A, B, C
    rest = delay[0] - whole * dt
    A_d, B_now = _held(A, B, dt - rest)
    A_rest, B_rest = _held(A, B, rest)
    return A_rest @ A_d, np.hstack([B_now, A_d @ B_rest]), C


def _held(A, B, dt):
    """Exact zero-order hold over a time dt, as `plants.linear.zoh` has it."""
    n = len(A)
    block = np.zeros((n + 1, n + 1), np.result_type(A, B, dt))
    block[:n, :n], block[:n, n:] = A * dt, B * dt
    transition = scipy.linalg.expm(block)
    return transition[:n, :n], transition[:n, n:]
