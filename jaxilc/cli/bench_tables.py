"""The tables of `jaxilc bench`, narrow enough for 80 columns; `--json` has all numbers.

ns           wall time of the best turn for each sample of each trial of each plant
times ours   wall time divided by that of our run; the median and the range of all turns
runs         the same for a gradient, in runs without one
limit ns     what the operations of a scheme alone would cost, see `bench.operations`
build s      time to compile
MB           peak of the RAM that the first call added
"""

from __future__ import annotations

from collections.abc import Mapping
from statistics import median
from typing import TYPE_CHECKING

from .titled_table import Table

if TYPE_CHECKING:
    import numpy as np

    from ..bench.ours_alone import Alone
    from ..bench.programme import ByTheSize
    from ..bench.timing import Row


def contest_table(title: str, rows: Mapping[str, Row], counted: str) -> Table:
    """A table with a row for each contender.

    counted: what the ratios of wall times to that of our run count
    """
    from ..bench.timing import OURS

    table = _table("", "ran", "ns", counted, "range", "build s", "MB", title=title)
    for row in rows.values():
        ratios = row.ratios(rows[OURS])
        table.add_row(
            row.name,
            f"{row.plants} x {row.trials}",
            _short(row.best),
            _short(median(ratios)),
            _ends(ratios),
            _seconds(row),
            _megabytes(row),
        )
    return table


def alone_table(title: str, schemes: Mapping[str, Alone]) -> Table:
    """A table with a row for each scheme: its run, the limit of it, its gradient in runs."""
    from ..bench.ours_alone import GRADIENT
    from ..bench.timing import OURS

    columns = ("scheme", "run ns", "limit ns", "times", "gradient", "weights", "build s", "MB")
    table = _table(*columns, title=title)
    for name, times in schemes.items():
        run, gradient = times.rows[OURS], times.rows.get(GRADIENT)
        if gradient is None:
            cells = ("", "", _seconds(run), _megabytes(run))
        else:
            cells = (
                f"{_short(median(gradient.ratios(run)))} runs",
                str(len(times.weights)),
                f"{_seconds(run)} + {_seconds(gradient)}",
                _megabytes(gradient),
            )
        limit = (_short(times.limit), _short(run.best / times.limit))
        table.add_row(name, _short(run.best), *limit, *cells)
    return table


def cost_table(name: str, by_size: ByTheSize) -> Table:
    """A table with a row for each size that was varied, and the line fitted to its times."""
    columns = ("", "sizes", "ms", "start ms", "us each", "off by")
    table = _table(*columns, title=f"{name}: times by size, and the line through them")
    for what, (best, line) in by_size.items():
        table.add_row(
            what,
            ", ".join(map(str, best)),
            ", ".join(_short(1e3 * seconds) for seconds in best.values()),
            f"{1e3 * line.start:.2g}",
            f"{1e6 * line.slope:.3g}",
            f"{100 * line.residual:.0f} %",
        )
    return table


def _table(*headers: str, title: str) -> Table:
    """A table without rows, whose first two columns are folded only after all others."""
    table = Table(title=title)
    for place, header in enumerate(headers):
        table.add_column(header, whole=place < 2)
    return table


def _short(number: float) -> str:
    """A number with three digits, or all of its whole part, without an exponent."""
    return f"{number:.0f}" if number >= 1000 else f"{number:.3g}"


def _ends(ratios: np.ndarray) -> str:
    return f"{_short(min(ratios))}-{_short(max(ratios))}"


def _seconds(row: Row) -> str:
    seconds = row.compile_seconds if row.compile_seconds >= 0.005 else 0.0
    return f"{seconds:.0f}" if seconds >= 10 else f"{seconds:.2g}"


def _megabytes(row: Row) -> str:
    return "" if row.peak_bytes is None else f"{row.peak_bytes / 1e6:.0f}"
