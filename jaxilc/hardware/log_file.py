"""The log of a campaign as a CSV file, and the units of its signals."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..storage.files import atomically
from .journal import Journal


def write_log(path: str | Path, rows: Sequence[dict[str, Any]]) -> Path:
    """Write the rows of `Journal.log` with a column for each name; missing values are empty."""
    text = io.StringIO()
    names = list(dict.fromkeys(name for row in rows for name in row))
    writer = csv.DictWriter(text, names, restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    atomically(path, lambda file: file.write(text.getvalue().encode()))
    return Path(path)


def units(journal: Journal) -> tuple[str, str]:
    """The units of the output and of the input; empty texts where the campaign has none."""
    task = journal.last_known()["configuration"].get("task")
    task = task if isinstance(task, dict) else {}
    return str(task.get("unit", "")), str(task.get("input_unit", ""))
