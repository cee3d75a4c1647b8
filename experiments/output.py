"""The folder for rows and figures of an experiment: out/experiments/NAME."""

import csv
from pathlib import Path

from matplotlib.figure import Figure

# The readings under which experiments on tuning, advice and the worst machine simulate the papers;
# `reproduce` judges the other one of each.
FIRST_READINGS = {
    "cao-2019": {"reading": "amplitude"},
    "cao-2019-rig": {"reading": "over-trials"},
    "milc-2024": {"reading": "long-stroke"},
    "xu-2024": {"reading": "small-gain"},
}


def folder(script: str) -> Path:
    """The folder for the results of a script, from its `__file__`."""
    path = Path("out") / "experiments" / Path(script).stem
    path.mkdir(parents=True, exist_ok=True)
    return path


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


def axes(rows: int = 1, columns: int = 1, *, size=(7.2, 4.2)):
    """The axes of a new figure."""
    return Figure(figsize=size, layout="constrained", dpi=150).subplots(rows, columns)
