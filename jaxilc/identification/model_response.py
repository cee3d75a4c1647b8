"""The frequency response of a fitted plant, its exact derivatives, and the band of a fit around it.

Which transfer function is fitted depends on the sample time:

    dt given:  P(z) at z = exp(j 2 pi f dt), from the samples of u, held over each sample, to the
               samples of y. That is what a controller measures that puts out u[k] and reads y[k]:
               hold and delay are within the response. It is the response of `plant.sampled(dt)`,
               so the fitted plant, simulated at dt, has the measured response.
    dt None:   G(s) at s = j 2 pi f, from u to y in continuous time, such as an analyser measures
               between two voltages. A hold in the path would be fitted as poles and delay.
"""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
import scipy

from ..plants import ModalModel
from ..plants.process_model import ProcessModel, cascade, samples_of
from ..pytree.named_paths import replaced

if TYPE_CHECKING:
    from .verdict import Identified

Lines: TypeAlias = tuple[np.ndarray, np.ndarray, np.ndarray]
# Of the complex step; the derivative is exact to rounding, since nothing is subtracted.
STEP = 1e-30
FIELDS = ("gain", "zeros", "poles", "frequencies", "dampings", "delay")
LINES, LOWEST = 400, 1e-4  # frequencies, and the lowest one as a share of the sample rate
MOST = 5.0  # standard deviation of log |P| that is told at most


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


# The band
# --------------------------------------------------------------------------------------------------


class ResponseBand(NamedTuple):
    """A frequency response with its 95 % band.

    f:      (F,) frequencies [Hz]
    P:      (F,) complex response
    phase:  (F,) its phase without jumps [deg]
    factor: (F,) the band is from |P| / factor to |P| factor; None where a parameter is not
        determined by the record
    half:   (F,) half of the band of the phase [deg]; None likewise
    """

    f: np.ndarray
    P: np.ndarray
    phase: np.ndarray
    factor: np.ndarray | None
    half: np.ndarray | None


def response_band(identified: Identified, dt: float) -> ResponseBand:
    """The response of the plant up to half of the sample rate, with its 95 % band.

    With the covariance S of the parameters and the derivatives g of log P by them, the standard
    deviations of log |P| and of the phase are those of Re(g)^T S Re(g) and Im(g)^T S Im(g).

    dt: sample time of the record [s]
    Raises ValueError for a plant that is not a `ProcessModel` or a `ModalModel` of one input and
    one output.
    """
    plant = identified.plant
    if not isinstance(plant, ProcessModel | ModalModel) or plant.n_u != 1 or plant.n_y != 1:
        raise ValueError(
            f"response_band: the plant is a {type(plant).__name__}; allowed is a ProcessModel or a "
            "ModalModel of one input and one output"
        )
    f = np.geomspace(LOWEST / dt, 0.5 / dt, LINES)
    if isinstance(plant, ModalModel):
        P, g, S = _of_modes(identified, plant, dt, f)
    else:
        P, g, S = _of_process(identified, plant, dt, f)
    phase = np.unwrap(np.angle(P)) * 180 / np.pi
    if not np.all(np.isfinite(S)):
        return ResponseBand(f, P, phase, None, None)
    variances = [np.einsum("fi,ij,fj->f", part, S, part) for part in (g.real, g.imag)]
    of_log, of_phase = np.sqrt(np.maximum(variances, 0))
    factor = np.exp(1.96 * np.minimum(of_log, MOST))
    return ResponseBand(f, P, phase, factor, 1.96 * np.minimum(of_phase, np.pi) * 180 / np.pi)


def _of_modes(identified: Identified, plant: ModalModel, dt: float, f: np.ndarray) -> Lines:
    """(F,) P, (F, n) derivatives of log P by the fitted numbers, and (n, n) their covariance."""
    names = tuple(name for name in identified.parameters if not name.startswith("bias"))
    values = np.array([identified.parameters[name].value for name in names])
    (real, imag), (by_real, by_imag) = _sampled_response(values, names, plant, dt, f)
    P = np.asarray(real) + 1j * np.asarray(imag)
    g = (np.asarray(by_real) + 1j * np.asarray(by_imag)) / P[:, None]
    return P, g, np.asarray(identified.covariance)[: len(names), : len(names)]


@functools.partial(jax.jit, static_argnames=("names", "dt"))
def _sampled_response(values, names, plant, dt, f):
    def at(values):
        system = replaced(plant, dict(zip(names, values, strict=True))).sampled(dt)
        z = jnp.exp(2j * jnp.pi * f * dt)[:, None, None]
        P = system.C @ jnp.linalg.solve(z * jnp.eye(len(system.A)) - system.A, system.B + 0j)
        return P[:, 0, 0].real, P[:, 0, 0].imag

    return at(values), jax.jacfwd(at)(values)


def _of_process(identified: Identified, plant: ProcessModel, dt: float, f: np.ndarray) -> Lines:
    """The same, of a ProcessModel."""
    fields = [np.atleast_1d(np.asarray(getattr(plant, name), float)) for name in FIELDS]
    counts = (len(fields[1]), len(fields[2]), len(fields[3]))
    P, slopes = response_and_slopes(np.concatenate(fields), counts, f, dt)
    names = [f"{n}[{i}]" for n, of in zip(FIELDS, fields, strict=True) for i in range(len(of))]
    place = {name: i for i, name in enumerate(names)}
    place |= {name: place[f"{name}[0]"] for name in FIELDS if f"{name}[0]" in place}
    known = [(k, place[n]) for k, n in enumerate(identified.parameters) if n in place]
    rows, columns = (np.array(x, int) for x in zip(*known, strict=True))
    return (
        P,
        (slopes / P[:, None])[:, columns],
        np.asarray(identified.covariance)[np.ix_(rows, rows)],
    )
