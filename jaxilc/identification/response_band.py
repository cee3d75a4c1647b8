"""The frequency response of an identified plant, and how far its covariance lets it lie."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from .model_response import response_and_slopes

if TYPE_CHECKING:
    from .verdict import Identified

FIELDS = ("gain", "zeros", "poles", "frequencies", "dampings", "delay")
LINES, LOWEST = 400, 1e-4  # frequencies, and the lowest one as a share of the sample rate
MOST = 5.0  # standard deviation of log |P| that is told at most


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
    Raises ValueError for a plant that is not a `ProcessModel` of one input and one output.
    """
    from ..plants import ProcessModel

    plant = identified.plant
    if not isinstance(plant, ProcessModel) or plant.n_u != 1 or plant.n_y != 1:
        raise ValueError(
            f"response_band: the plant is a {type(plant).__name__}; allowed is a ProcessModel of "
            "one input and one output"
        )
    fields = [np.atleast_1d(np.asarray(getattr(plant, name), float)) for name in FIELDS]
    f = np.geomspace(LOWEST / dt, 0.5 / dt, LINES)
    counts = (len(fields[1]), len(fields[2]), len(fields[3]))
    P, slopes = response_and_slopes(np.concatenate(fields), counts, f, dt)
    phase, std = np.unwrap(np.angle(P)) * 180 / np.pi, _std_of_log(identified, fields, slopes, P)
    if std is None:
        return ResponseBand(f, P, phase, None, None)
    factor = np.exp(1.96 * np.minimum(std.real, MOST))
    return ResponseBand(f, P, phase, factor, 1.96 * np.minimum(std.imag, np.pi) * 180 / np.pi)


def _std_of_log(identified: Identified, fields, slopes, P) -> np.ndarray | None:
    """(F,) standard deviations of log |P|, the real part, and of the phase, the imaginary part.

    fields: the parameters of the plant, each an array
    slopes: (F, n) derivatives of P by them
    """
    g = slopes / P[:, None]
    names = [f"{n}[{i}]" for n, of in zip(FIELDS, fields, strict=True) for i in range(len(of))]
    place = {name: i for i, name in enumerate(names)}
    place |= {name: place[f"{name}[0]"] for name in FIELDS if f"{name}[0]" in place}
    known = [(k, place[n]) for k, n in enumerate(identified.parameters) if n in place]
    rows, columns = (np.array(x, int) for x in zip(*known, strict=True))
    S = np.asarray(identified.covariance)[np.ix_(rows, rows)]
    if not np.all(np.isfinite(S)):
        return None
    parts = (g[:, columns].real, g[:, columns].imag)
    variances = [np.einsum("fi,ij,fj->f", part, S, part) for part in parts]
    return np.sqrt(np.maximum(variances[0], 0)) + 1j * np.sqrt(np.maximum(variances[1], 0))
