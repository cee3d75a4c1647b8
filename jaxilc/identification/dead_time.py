"""The choice of a dead time together with the order."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from ..plants.process_model import LONGEST_DELAY
from ..pytree.ranges import require
from .orders import STRUCTURES, Order, best_order, compare_orders, long_enough
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


def orders_and_delays(
    record: Record,
    *,
    structures: Sequence[tuple[int, int, int]] = STRUCTURES,
    longest: int = LONGEST_LOOKED_FOR,
    starts: int = 64,
    seed: int = 0,
    each: Callable[[tuple[int, int, int]], object] = lambda structure: None,
) -> list[Order]:
    """Fits of several structures with several dead times, of which `best_order` chooses one.

    All structures are fitted without a delay and with that of `first_lag`. From the best of these
    the delay goes up and down by one sample for as long as the criterion falls; then all structures
    are fitted with the delay that was found. Within the noise, a delay and fast poles are alike, so
    the criterion charges a delay like a parameter.

    longest: the longest delay that is looked for, in samples
    structures, starts, seed, each: as for `compare_orders`
    Raises ValueError as `compare_orders` does.
    """
    require("orders_and_delays", "longest", longest, f"[0, {LONGEST_DELAY}]", whole=True)
    fitted: dict[tuple[int, int, int, int], Order] = {}

    def fit(of: Sequence[tuple[int, int, int]], delay: int) -> None:
        new = [
            one
            for i, one in enumerate(of)
            if (*one, delay) not in fitted and (not i or long_enough(record, sum(one, one[1] + 2)))
        ]
        for one in compare_orders(
            record, structures=new, delay=delay, starts=starts, seed=seed, each=each
        ):
            fitted[one.poles, one.pairs, one.zeros, delay] = one

    def best() -> Order:
        return best_order(list(fitted.values()))

    longest = min(longest, len(record.u) // record.trials // 3)
    fit(structures, 0)
    fit(structures, first_lag(record, longest))
    for direction in (-1, 1):
        while True:
            now = best()
            delay = int(now.delay) + direction
            if not 0 <= delay <= longest:
                break
            fit([(now.poles, now.pairs, now.zeros)], delay)
            if best() is now:
                break
    fit(structures, int(best().delay))
    return list(fitted.values())
