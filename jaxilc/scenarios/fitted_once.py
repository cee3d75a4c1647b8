"""The plant of a file whose kind is `identified`: fitted once, then read from a file beside it.

The fit is kept in `RECORD.KEY.fit.json` in the folder of the plant file, where KEY follows from the
options. It is sealed, and holds the checksum of the record: where the record has changed, or the
file is damaged, the plant is fitted again. The file may be removed at any time. In a folder that
cannot be written, each command fits again.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np

from .. import identification
from ..identification.frequency_response import is_frequency_response
from ..identification.record_files import is_twincat, read_record
from ..plants import ProcessModel
from ..storage.columns import LARGEST_TABLE
from ..storage.reading import read_bytes, read_tree
from ..storage.sealed import json_text, sealed, unsealed, write_json

FORMAT = 1  # of the file, and of the way in which a plant is fitted
LEAVES = tuple(field.name for field in dataclasses.fields(ProcessModel))


class Options(NamedTuple):
    """How a record is read and fitted, as `read_record` and `identify` have it.

    reading: options of `read_record`
    structure: poles, pairs, zeros
    delay: in samples; None: 0 for a record, fitted for a frequency response
    averages: of the coherence of a frequency response
    """

    reading: dict[str, Any]
    structure: dict[str, Any]
    delay: int | None
    averages: int | None


def identified_plant(record: Path, options: Options, folder: Path) -> tuple[ProcessModel, str]:
    """The plant, and a sentence on its fit.

    folder: where the fit is kept
    Raises ValueError as `read_record`, `read_frequency_response` and `identify`, and OSError for a
    record that cannot be read.
    """
    asked = {"format": FORMAT, **options._asdict()}
    key = hashlib.sha256(json_text(asked).encode()).hexdigest()[:8]
    checksum = hashlib.sha256(read_bytes(record, LARGEST_TABLE)).hexdigest()
    kept = folder / f"{record.name}.{key}.fit.json"
    known = {"record": checksum, "options": asked}
    with contextlib.suppress(ValueError, OSError, KeyError, TypeError):
        found = unsealed(read_tree(kept, ".json"))
        if found["record"] == checksum:
            plant = ProcessModel(**{name: found["plant"][name] for name in LEAVES})
            return plant, f"{found['said']} (kept in {kept.name})"
    plant, said = _fitted(record, options)
    values = {name: np.asarray(getattr(plant, name)).tolist() for name in LEAVES}
    if kept.is_file() or not kept.exists():
        with contextlib.suppress(OSError):  # a folder that cannot be written
            write_json(kept, sealed({**known, "plant": values, "said": said}))
    return plant, said


def _fitted(record: Path, options: Options) -> tuple[ProcessModel, str]:
    """The plant, fitted to the record, and a sentence on it."""
    if _is_response(record, options):
        dt = options.reading["dt"]
        if dt is None:
            raise ValueError(
                f"{record} is a frequency response: give dt, the sample time of the hold in it [s]"
            )
        found = identification.identify_response(
            identification.read_frequency_response(record, averages=options.averages),
            **options.structure,
            dt=dt,
            delay=None if options.delay is None else options.delay * dt,
        )
    else:
        found = identification.identify(
            read_record(record, **options.reading), **options.structure, delay=options.delay or 0
        )
    values = ", ".join(f"{name} = {one.value:.6g}" for name, one in found.parameters.items())
    plant = cast(ProcessModel, found.plant)
    if plant.delay and "delay" not in found.parameters:
        values += f", delay = {plant.delay:.6g}"
    fit = float(np.min(found.fit))
    return plant, f"the plant was identified from {record.name}: {values}; fit {fit:.4g} %"


def _is_response(record: Path, options: Options) -> bool:
    if record.suffix.lower() == ".mat" or options.reading["columns"] or is_twincat(record):
        return False
    return is_frequency_response(record)
