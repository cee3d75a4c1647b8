"""Where an experiment leaves its rows and figures: out/experiments/NAME."""

import csv
from pathlib import Path

from matplotlib.figure import Figure


def folder(script: str) -> Path:
    """The folder of a script, given its __file__."""
    path = Path("out") / "experiments" / Path(script).stem
    path.mkdir(parents=True, exist_ok=True)
    return path


def write_rows(path: Path, rows: list[dict]) -> None:
    """Rows as CSV, and on the screen."""
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, fieldnames=list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    for row in rows:
        print(
            "  ".join(
                f"{name} {value:.4g}" if isinstance(value, float) else f"{name} {value}"
                for name, value in row.items()
            )
        )


def axes(rows: int = 1, columns: int = 1, *, size=(7.2, 4.2)):
    """Axes of a new figure."""
    return Figure(figsize=size, layout="constrained", dpi=150).subplots(rows, columns)
