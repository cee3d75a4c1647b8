"""The taps with which a tuning begins, kept in its folder so that a resumed one has the same."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ..runtime.provenance import describe, differences, environment
from ..storage.sealed import as_json, json_text, read_json, sealed, unsealed, write_json
from .first_taps import FirstTaps
from .window import Filters

FILE = "start.json"


def kept_or(
    folder: Path, asked: Any, compute: Callable[[], FirstTaps], *, resume: bool
) -> FirstTaps:
    """The taps that are kept in a folder, or computed and kept there.

    asked: the question that they answer, and all that their numbers depend on
    Raises FileExistsError for a folder with taps without `resume`, and ValueError for taps of
    another question, and for those of an earlier version that differ from segment to segment.
    """
    file = folder / FILE
    question = json.loads(json_text({"asked": describe(asked), "environment": environment()}))
    if file.exists():
        if not resume:
            raise FileExistsError(f"{folder} exists already; resume it or choose another place")
        found = as_json(unsealed(read_json(file)))
        differing = differences(found["question"], question)
        if differing:
            said = f"was made for another question; it differs in: {'; '.join(differing)}"
            raise ValueError(f"{folder} {said}")
        filters = Filters(*(np.asarray(found[name], float) for name in Filters._fields))
        if filters.keep.ndim % 2 == 0:
            raise ValueError(
                f"{folder} was begun by an earlier version with other taps in each segment; "
                "choose another place"
            )
        besides = {name: np.asarray(of, float) for name, of in found["besides"].items()}
        return FirstTaps(filters, int(found["lead"]), besides)
    taps = compute()
    folder.mkdir(parents=True, exist_ok=True)
    kept = {name: np.asarray(values).tolist() for name, values in taps.filters._asdict().items()}
    besides = {name: np.asarray(values).tolist() for name, values in taps.besides.items()}
    write_json(file, sealed({"question": question, "lead": taps.lead, "besides": besides, **kept}))
    return taps
