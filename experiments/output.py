"""The folder for rows and figures of an experiment, out/experiments/NAME; names given to one."""

import csv
import os
import sys
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator

from jaxilc.pytree.closest import not_one_of

# The readings under which experiments on tuning, advice and the worst machine simulate the papers;
# `reproduce` judges the other one of each, and eq. 29 in place of the motor of eq. 7.
FIRST_READINGS = {
    "cao-2019": {"reading": "amplitude", "plant": "exact"},
    "cao-2019-rig": {"reading": "over-trials"},
    "dai-2014": {"plant": "exact"},
    "milc-2024": {"reading": "long-stroke"},
    "xu-2024": {"reading": "small-gain"},
}


def folder(script: str) -> Path:
    """The folder for the results of a script, from its `__file__`."""
    path = Path("out") / "experiments" / Path(script).stem
    path.mkdir(parents=True, exist_ok=True)
    return path


def asked(names: list[str], known: Iterable[str]) -> list[str]:
    """The names on a command line, or for none all that are known; the program ends at another."""
    known = list(known)
    for name in names:
        if name not in known:
            sys.exit(not_one_of(f"NAME = {name!r}", name, known))
    return names or known


def measured_folder() -> Path | None:
    """The folder of measured records, from JAXILC_MEASURED; None, told, where it names none."""
    place = os.environ.get("JAXILC_MEASURED")
    if not place:
        print("JAXILC_MEASURED names no folder of measured records: they are left out")
    return Path(place) if place else None


def write_rows(path: Path, rows: list[dict], shown: int | None = None) -> None:
    """Write rows to a CSV file, and print them, or the first `shown` of them."""
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, fieldnames=list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    for row in rows[:shown]:
        print(
            "  ".join(
                f"{name} {value:.4g}" if isinstance(value, float) else f"{name} {value}"
                for name, value in row.items()
            )
        )


def filled(rows: list[dict], missing: object = 0) -> list[dict]:
    """Rows of which each has the keys of all."""
    keys = dict.fromkeys(key for row in rows for key in row)
    return [dict.fromkeys(keys, missing) | row for row in rows]


def sums(rows: list[dict]) -> dict[str, int]:
    """The sums of the counts of rows by name."""
    counted = [name for name, value in rows[0].items() if isinstance(value, int)]
    return {name: sum(row[name] for row in rows) for name in counted}


def axes(rows: int = 1, columns: int = 1, *, size=(7.2, 4.2)):
    """The axes of a new figure."""
    return Figure(figsize=size, layout="constrained", dpi=150).subplots(rows, columns)


def save(axes, path: Path, which: str = "both", **legend) -> None:
    """Write the figure of axes, with a grid, and with a legend where they name something.

    which: ticks that have lines of the grid;  legend: as for `Axes.legend`
    """
    axes = np.ravel(axes)
    for ax in axes:
        ax.grid(True, which=which, alpha=0.25)
        if ax.get_legend_handles_labels()[0]:
            ax.legend(**legend)
    axes[0].figure.savefig(path)


def plain(ax, subs=(1.0, 2.0, 5.0)) -> None:
    """Numbers as they are on a logarithmic ordinate of few decades: 20 and not 2 x 10^1."""
    ax.yaxis.set_major_locator(LogLocator(subs=subs))
    ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    ax.yaxis.set_minor_formatter(FuncFormatter(lambda *_: ""))


def printed_at(ax, value: float, label: str = "") -> None:
    """Dashed lines at a printed largest error, on both sides of zero."""
    for side, text in ((value, label), (-value, "")):
        ax.axhline(side, color="#777777", ls="--", lw=0.8, label=text or None)
