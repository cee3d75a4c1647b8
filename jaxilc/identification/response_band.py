"""The frequency response of a plant that was identified, with its 95 % band."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..plants import ModalModel, ProcessModel
from ..pytree.aliases import Numbers
from ..pytree.named_paths import get_at
from .grown_response import Response, response_of
from .problem import free_elements
from .response_estimation import counts_of, response_and_slopes
from .verdict import WIDE, Identified

LINES, LOWEST = 400, 1e-4  # frequencies, and the lowest one as a share of the sample rate
MOST_SPREAD = 5.0  # standard deviation of log |P| that is told at most


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
        names, P, slopes = response_of(plant, f, dt)
    else:
        names, P, slopes = _of_process(plant, f, dt)
    bare = (name.replace("[0][0]", "") for name in identified.parameters)  # (1, 1) is one number
    which, columns = np.transpose([(k, names.index(n)) for k, n in enumerate(bare) if n in names])
    g, S = (slopes / P[:, None])[:, columns], identified.covariance[np.ix_(which, which)]
    phase = np.unwrap(np.angle(P)) * 180 / np.pi
    if not np.all(np.isfinite(S)):
        return ResponseBand(f, P, phase, None, None)
    variances = [np.einsum("fi,ij,fj->f", part, S, part) for part in (g.real, g.imag)]
    of_log, of_phase = np.sqrt(np.maximum(variances, 0))
    factor = np.exp(WIDE * np.minimum(of_log, MOST_SPREAD))
    return ResponseBand(f, P, phase, factor, WIDE * np.minimum(of_phase, np.pi) * 180 / np.pi)


def _of_process(plant: ProcessModel, f: Numbers, dt: float) -> Response:
    """What `response_of` answers, of a ProcessModel."""
    names = (*free_elements(plant, None), "delay")
    values = np.array([*(float(get_at(plant, name)) for name in names[:-1]), plant.delay])
    return names, *response_and_slopes(values, counts_of(plant), f, dt)
