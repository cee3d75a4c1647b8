"""Records of a closed loop: whether the noise of the output is in the input, and a fit without it.

With a feedback the input answers the noise of the output, and least squares of the output's error
is biased where that noise is not white. If the reference was recorded, two stages have no bias,
whatever the noise and the feedback are (Van den Hof and Schrama 1993):

    u_r = F r,  F an impulse response by least squares: the part of u that the reference made
    the plant is fitted from u_r to y; what the feedback added is noise of the output then
"""

from __future__ import annotations

import numpy as np
import scipy
from scipy.stats import f as ratio_of_variances

from .records import Record, as_columns

OWN, LAGS = 60, 20  # past samples of the input, and of the residual, that predict the input
SAMPLES, MOST = 5, 20_000  # for each parameter at least, and of a record at most
CHANCE = 1e-5  # with which an open loop is taken for a closed one
SHARE = 0.1  # of the samples: length of F at most
LONGEST = 400  # samples


def feedback_seen(record: Record, residual) -> bool:
    """Whether the input answers the residual of a fit, so that a loop is closed (Granger's test).

    The input is predicted from its own past, then from the residual too, that of the same sample
    included. In an open loop the second prediction is no better, also where the model is not the
    plant: what it misses is made of the past of the input.

    residual: (N+1, 1) recorded output minus the simulated one; one input and one output
    """
    u = as_columns("feedback_seen", "u", record.u)[:MOST, 0]
    e = np.asarray(residual, float)[: len(u), 0]
    parameters = 1 + OWN + LAGS
    freedom = len(u) - OWN - parameters
    if freedom < SAMPLES * parameters:
        return False
    windows = np.lib.stride_tricks.sliding_window_view
    own = np.column_stack([np.ones(len(u) - OWN), windows(u[:-1], OWN)])
    answered = windows(e[OWN - LAGS + 1 :], LAGS)
    left = [_left(past, u[OWN:]) for past in (own, np.column_stack([own, answered]))]
    if not left[1] > 1e-12 * np.sum((u - np.mean(u)) ** 2):
        return False  # an input that predicts itself, such as a sinusoid
    ratio = (left[0] - left[1]) / LAGS / (left[1] / freedom)
    return bool(ratio_of_variances.sf(ratio, LAGS, freedom) < CHANCE)


def of_reference(record: Record, reference) -> Record:
    """The record with the part of its input that the reference made, in place of the input.

    reference: (N,) recorded reference
    Raises ValueError for a reference that does not move.
    """
    u, r = (as_columns("of_reference", "u", one)[:, 0] for one in (record.u, reference))
    if not np.ptp(r) > 0:
        raise ValueError(
            "identify: the reference does not move, so that nothing but noise excites the loop; "
            "record a motion, or add an excitation to the reference"
        )
    taps = int(min(LONGEST, SHARE * len(u)))
    first = np.concatenate([r[:1], np.zeros(taps - 1)])
    past = scipy.linalg.toeplitz(r - r[0], first - r[0] * (np.arange(taps) == 0))
    past = np.column_stack([past, np.ones(len(u))])
    found, *_ = np.linalg.lstsq(past, u, rcond=1e-8)
    return record._replace(u=(past @ found)[:, None])


def _left(past: np.ndarray, u: np.ndarray) -> float:
    """The sum of squares that a linear prediction leaves."""
    found, *_ = np.linalg.lstsq(past, u, rcond=1e-10)
    return float(np.sum((u - past @ found) ** 2))
