"""The prediction of a campaign as a file in its folder, which is computed once.

The file has a checksum and names what it was computed from. One that is missing, damaged, of
another machine or too short is computed again; nothing else depends on it.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
from pathlib import Path
from typing import Any, cast

import numpy as np

from ..pytree.ranges import is_number, is_whole
from ..runtime.provenance import describe
from ..storage.sealed import Damaged, read_json, sealed, unsealed, write_json
from .prediction import MACHINES, SEED, Band, Prediction, Subject, longest, predict

FILE, FORMAT = "prediction.json", 1


def of_campaign(
    folder: Path,
    subject: Subject,
    needed: int,
    *,
    expected: int,
    configuration: str,
    store: bool = True,
) -> Prediction:
    """The prediction of a campaign, from its folder, or computed and stored there.

    needed: number of trials that it must reach
    expected: number of trials that the scenario expects; it is doubled until it reaches `needed`
    configuration: hash of the campaign's configuration, for `kept`
    store: whether the folder may be written to
    Raises ValueError as `predict` does.
    """
    key, needed = key_of(subject), min(needed, longest(subject))
    found = kept(folder, configuration, key)
    if found is not None and found.trials >= needed:
        return found
    trials = max(1, expected)
    while trials < needed:
        trials *= 2
    prediction = predict(subject, trials)
    if store:
        content = _as_json(prediction) | {"of": key, "configuration": configuration}
        with contextlib.suppress(OSError):  # it is computed again at the next call
            write_json(folder / FILE, sealed(content))
    return prediction


def kept(folder: Path, configuration: str, key: str | None = None) -> Prediction | None:
    """The stored prediction of a campaign, None where there is none that can be used.

    configuration: hash of the campaign's configuration
    key: `key_of` what it must be computed from, None if that is not known
    """
    try:
        content = unsealed(read_json(folder / FILE))
    except (OSError, Damaged):
        return None
    of = {"format": FORMAT, "configuration": configuration} | ({"of": key} if key else {})
    if any(content.get(name) != value for name, value in of.items()):
        return None
    return _from_json(content)


def key_of(subject: Subject) -> str:
    """A hash of all that the prediction depends on, besides the number of trials."""
    described = describe([*subject, MACHINES, SEED])
    return hashlib.sha256(json.dumps(described, sort_keys=True).encode()).hexdigest()


def _as_json(prediction: Prediction) -> dict[str, Any]:
    bands = {
        name: {end: values.tolist() for end, values in getattr(prediction, name)._asdict().items()}
        for name in ("rms", "largest")
    }
    return {"format": FORMAT, **prediction._asdict(), **bands}


def _from_json(content: dict[str, Any]) -> Prediction | None:
    """The prediction; None for content that somebody made by hand and that does not fit."""
    bands = [_band_of(content.get(name)) for name in ("rms", "largest")]
    machines, course, smallest = (content.get(n) for n in ("machines", "course", "smallest"))
    known = is_whole(machines) and is_number(course) and is_number(smallest)
    rms, largest = bands
    if not known or rms is None or largest is None or len(rms.low) != len(largest.low):
        return None
    course, smallest = (float(cast(float, x)) for x in (course, smallest))
    noisy = content.get("noisy") is True
    return Prediction(int(cast(int, machines)), noisy, rms, largest, course, smallest)


def _band_of(content: Any) -> Band | None:
    ends = [content.get(end) if isinstance(content, dict) else None for end in Band._fields]
    lists = [end for end in ends if isinstance(end, list) and end and all(map(is_number, end))]
    if len(lists) < len(ends) or len({len(end) for end in lists}) > 1:
        return None
    return Band(*(np.array(end, float) for end in lists))
