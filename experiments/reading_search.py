"""How the readings of a paper are judged: the rows they meet, against the choices they need.

A reading settles what a paper leaves open: units, windows, resets, what is fed back. Some of its
numbers are free, and are fitted to some printed rows; the other rows are held out. Its price is
that of the Bayesian information criterion (Schwarz 1978),

    BIC = n ln(mean of ln(ours / printed)^2 + ROUNDING^2) + k ln n,

over n rows, where k counts the free numbers and the places at which the reading departs from the
words of the paper. Smaller is better; a difference beyond 10 is very strong (Kass, Raftery 1995).

A search has seen the rows that it is judged by. So each table of the print, a column or a figure,
is left out as well, and predicted by the reading and the numbers that the others choose.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

MET = 0.3
ROUNDING = 0.1  # printed numbers have one or two digits: half a unit of 0.5 is 10 %
HELD_OUT = ("held out", "held out met", "held out off")
WORST = np.log(100.0)  # a row that diverged, or is off by more than this, counts as this


class Reading(NamedTuple):
    """A reading, simulated with many values of its free numbers.

    places: what was read, by place
    departures: number of places at which it departs from the words of the paper
    values: (S, m) values of the m free numbers
    ours: (S, n) simulated numbers, one for each printed row [unit of the rows]
    """

    places: Mapping[str, object]
    departures: int
    values: np.ndarray
    ours: np.ndarray


def misfits(ours, printed) -> np.ndarray:
    """|ln(ours / printed)| of each row, at most `WORST`."""
    ours = np.where(np.isfinite(ours) & (np.asarray(ours) > 0), ours, np.inf)
    with np.errstate(over="ignore"):
        return np.minimum(np.abs(np.log(ours / np.asarray(printed, float))), WORST)


def bic(ours, printed, choices: int, rows: int | None = None) -> np.ndarray:
    """The criterion over the rows along the last axis.

    choices: k, number of free numbers and of departures
    rows: number of rows that prices a choice, where these are a part of them
    """
    n = np.shape(printed)[-1]
    spread = np.mean(misfits(ours, printed) ** 2, axis=-1) + ROUNDING**2
    return n * np.log(spread) + choices * np.log(rows or n)


def met(ours, printed) -> np.ndarray:
    """Whether each row is within 30 %."""
    ours = np.where(np.isfinite(ours), ours, np.inf)
    return np.abs(ours / np.asarray(printed, float) - 1) <= MET


def judged(reading: Reading, printed, fitted: Sequence[bool]) -> dict[str, object]:
    """A reading with its free numbers fitted to some rows, as a row of a table.

    fitted: of each row, whether the free numbers are fitted to it
    """
    printed, fitted = np.asarray(printed, float), np.asarray(fitted, bool)
    cost = np.sum(misfits(reading.ours, printed)[:, fitted] ** 2, axis=1)
    best = int(np.argmin(cost)) if fitted.any() else 0
    ours, choices = reading.ours[best], reading.values.shape[1] + reading.departures
    right, off, n = met(ours, printed), misfits(ours, printed), len(printed)
    of_fit = bic(ours[fitted], printed[fitted], choices, n) if fitted.any() else choices * np.log(n)
    return {
        **reading.places,
        "free": " ".join(f"{value:.4g}" for value in reading.values[best]),
        "k": choices,
        "BIC": float(bic(ours, printed, choices)),
        "met": int(right.sum()),
        "criterion of the fit": float(of_fit),
        "held out": int((~fitted).sum()),
        "held out met": int(right[~fitted].sum()),
        "held out off": float(np.sqrt(np.mean(off[~fitted] ** 2))) if not fitted.all() else 0.0,
        "ours": " ".join(f"{value:.3g}" for value in ours),
    }


def left_out(name: str, readings: Sequence[Reading], printed, tables) -> list[dict[str, object]]:
    """The readings by how they predict each table from the others, and how the whole search does.

    tables: of each row, its table; the free numbers are fitted to the rows of all other tables
    The sentence is on the whole search: the reading, too, is chosen by the other tables' criterion.
    """
    printed, tables = np.asarray(printed, float), np.asarray(tables)
    ours, criteria = np.empty((len(readings), len(printed))), {}
    for table in dict.fromkeys(tables):
        out = tables == table
        for i, reading in enumerate(readings):
            cost = np.sum(misfits(reading.ours, printed)[:, ~out] ** 2, axis=1)
            best, choices = int(np.argmin(cost)), reading.values.shape[1] + reading.departures
            ours[i, out] = reading.ours[best, out]
            kept = reading.ours[best, ~out]
            criteria[table, i] = bic(kept, printed[~out], choices, len(printed))
    chosen = {t: min(range(len(readings)), key=lambda i, t=t: criteria[t, i]) for t in tables}
    whole = np.array([ours[chosen[table], k] for k, table in enumerate(tables)])

    def told(ours) -> dict[str, object]:
        return {
            "off": float(np.sqrt(np.mean(misfits(ours, printed) ** 2))),
            "met": int(met(ours, printed).sum()),
            "ours": " ".join(f"{value:.3g}" for value in ours),
        }

    print(
        f"{name}, each of {len(set(tables))} tables left out, of {len(printed)} rows: {told(whole)}"
    )
    rows = [{**reading.places, **told(of)} for reading, of in zip(readings, ours, strict=True)]
    return sorted(rows, key=lambda row: row["off"])


def search(name: str, readings: Sequence[Reading], printed, fitted) -> list[dict[str, object]]:
    """The readings, the best first, and a sentence on what the whole space can meet at all.

    The sentence is about every candidate, that is every reading with every value of its free
    numbers, chosen with all rows in sight: no fit can do better than that within the space.
    """
    rows = [judged(reading, printed, fitted) for reading in readings]
    right = np.concatenate([met(reading.ours, printed) for reading in readings])
    together = right.sum(axis=1)
    shares = ", ".join(
        f"{value:g}: {share:.2%}" for value, share in zip(printed, right.mean(axis=0), strict=True)
    )
    print(
        f"{name}: {len(readings)} readings, {len(right)} candidates. At most {together.max()} of "
        f"{right.shape[1]} rows are met together, by {np.sum(together == together.max())} of them; "
        f"share of candidates that meet each row: {shares}"
    )
    return sorted(rows, key=lambda row: row["BIC"])
