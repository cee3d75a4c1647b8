"""The dead time of a record, as its first answer tells it."""

from __future__ import annotations

import numpy as np

from .records import Record, as_columns

LONGEST_LOOKED_FOR = 50  # samples, the default of the longest delay that is looked for
BEYOND = 10  # lags beyond the longest delay, so that its answer is seen
SIGNIFICANT = 4.0  # standard errors from which on an answer to the input is no chance


def first_lag(record: Record, longest: int = LONGEST_LOOKED_FOR) -> int:
    """The samples between the input and the first significant answer, less the one of the hold.

    A difference equation of high order is fitted by linear least squares, where the noise is white:

        y[k] = c + sum_{i=1..n} (a_i y[k-i] + b_i u[k-i])

    The estimate is i - 1 of the first b_i that is more than 4 standard errors from 0. It is 0 where
    none is, or where the record is too short for such a fit. Of several experiments, the first is
    taken.
    """
    y, u = (
        as_columns("first_lag", "y", record.y)[:, 0],
        as_columns("first_lag", "u", record.u)[:, 0],
    )
    n = min(longest + BEYOND, (len(u) - 1) // 6)
    if n < 1:
        return 0
    lagged = np.lib.stride_tricks.sliding_window_view
    rows = np.hstack([lagged(y[:-1], n)[:, ::-1], lagged(u, n)[:, ::-1]])
    scale = np.std(rows, axis=0)
    scale[scale == 0] = 1.0
    rows = np.hstack([np.ones((len(rows), 1)), rows / scale])
    wanted = y[n:]
    found, _, rank, _ = np.linalg.lstsq(rows, wanted)
    freedom = len(wanted) - rank
    if freedom < 1:
        return 0
    variance = np.sum((wanted - rows @ found) ** 2) / freedom
    errors = np.sqrt(variance * np.abs(np.diag(np.linalg.pinv(rows.T @ rows))))
    answers = np.abs(found[1 + n :]) > SIGNIFICANT * errors[1 + n :]
    return min(int(np.argmax(answers)), longest) if np.any(answers) else 0
