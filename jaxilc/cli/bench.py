"""`jaxilc bench`: the speed of jaxilc compared with that of other programs."""

from __future__ import annotations

from statistics import median
from typing import Annotated

import typer

from .console import out
from .options import Json, Precision
from .results import written
from .titled_table import Table

COLUMNS = (
    "",
    "ran",
    "ns best",
    "ns median",
    "times ours",
    "lowest - highest",
    "cpu ns",
    "times ours",
    "compile s",
    "peak MB",
    "off by",
)


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""
    app.command()(bench)


def bench(
    plants: Annotated[
        str, typer.Option(help="Numbers of plants, with commas between them.")
    ] = "1,16,1024",
    trials: Annotated[int, typer.Option(help="Trials J.")] = 80,
    samples: Annotated[int, typer.Option(help="Samples N of a trial.")] = 2000,
    schemes: Annotated[
        str, typer.Option(help="cfdl, ffdl, with opponents; noilc, ilc-asmc, alone; with commas.")
    ] = "cfdl,ffdl",
    long: Annotated[
        int,
        typer.Option(
            help="Samples of one long trial of one plant, by steps and in blocks; 0 for none."
        ),
    ] = 100_000,
    repeats: Annotated[int, typer.Option(help="Turns; contenders take turns.")] = 5,
    json_file: Json = None,
    precision: Precision = "float64",
) -> None:
    """Our speed beside NumPy, Numba, C, SciPy and python-control, for the same numbers.

    Opponents compute in float64, whatever the precision.

    Example: jaxilc bench --plants 1024 --json out/bench.json
    """
    from ..runtime.start import setup

    setup(precision=precision)
    from ..bench.programme import Programme, measure

    names = [name.strip() for name in schemes.split(",")]
    programme = Programme(_numbers(plants), trials, samples, names, long, repeats)
    numbers = measure(
        programme,
        note=lambda text: out.print(text, highlight=False, markup=False),
        rows=lambda title, rows: out.print(_table(rows, title)),
        costs=_print_costs,
    )
    before, after = (numbers[name]["load"] for name in ("machine", "machine_after"))
    out.print(f"load of the machine: {before} before, {after} after", highlight=False)
    written([], json_file, numbers)


def _numbers(text: str) -> list[int]:
    """Whole numbers from a text such as `1,16`; raises ValueError for any other text."""
    try:
        numbers = [int(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if not numbers or min(numbers) < 1:
        raise ValueError(
            f"--plants {text!r} is not whole numbers from 1 on, with commas between them"
        )
    return numbers


def _table(rows, title: str) -> Table:
    """A table with a row for each contender, and ratios to ours by wall time and processor time."""
    from ..bench.timing import OURS

    table = Table(*COLUMNS, title=title)
    for row in rows.values():
        ratios = sorted(row.ratios(rows[OURS]))
        table.add_row(
            row.name,
            f"{row.plants} x {row.trials}",
            f"{row.best:.3g}",
            f"{row.median:.3g}",
            f"{median(ratios):.3g}",
            f"{ratios[0]:.3g} - {ratios[-1]:.3g}",
            f"{row.cpu:.3g}",
            f"{median(row.ratios(rows[OURS], 'cpu_seconds')):.3g}",
            f"{row.compile_seconds:.2f}",
            "" if row.peak_bytes is None else f"{row.peak_bytes / 1e6:.0f}",
            f"{row.difference:.1g}",
        )
    return table


def _print_costs(name: str, by_size) -> None:
    """Print for each size that was varied the times and the straight line fitted to them."""
    for what, (best, line) in by_size.items():
        times = ", ".join(f"{size}: {seconds:.3g} s" for size, seconds in best.items())
        fit = (
            f"{line.start:.3g} s + {1e6 * line.slope:.3g} us each, "
            f"off by {100 * line.residual:.0f} % at most"
        )
        out.print(f"{name} by {what}: {times}; {fit}", highlight=False)
