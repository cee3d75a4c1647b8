"""The plant file of a campaign with another plant in it, fitted to the campaign's own trials.

The tables `[plant]` and `[uncertainty]` are replaced, and a table `[grid]`, whose axes may be those
of the plant, is left out; task, machine, schemes and comments stay as they are, so that the
campaign can go on with the new file, and its predictions are those of the fitted plant.
"""

from __future__ import annotations

import json
import re
import tomllib
from pathlib import Path
from typing import Any

import numpy as np

from ..identification import Identified
from ..storage.files import atomically
from ..storage.reading import LARGEST_TREE, read_text, tree_of
from .identified_file import LEAVES, comment, intervals

REPLACED = ("plant", "uncertainty", "grid")
_BARE = re.compile(r"[A-Za-z0-9_-]+")
_HEADER = re.compile(r"""^\s*\[{1,2}\s*(["']?)([\w-]+)\1\s*(?:\.[^\]]*)?\]{1,2}\s*(?:\#.*)?$""")


def write_refitted(
    path: Path, source: Path, found: Identified, *, fitted_to: str, noise: float | None = None
) -> Path:
    """Write the plant file of a campaign with the fitted plant in place of its own.

    path: file to write, in TOML
    source: plant file of the campaign, in TOML
    fitted_to: what the plant was fitted to, for a comment
    noise: standard deviation of the noise of the sensor [unit of y], None to state none; it is left
        out where the file has a table `[machine]` with a sensor or a disturbance
    Intervals of leaves that are not of the plant stay in `[uncertainty]`.
    Raises ValueError for a file that cannot be changed in this way, with the reason.
    """
    text = read_text(source, LARGEST_TREE)
    before = tree_of(text, tomllib.loads, source)
    if path.absolute().parent != source.absolute().parent and _names_files(before):
        raise ValueError(
            f"{source} names files relative to its folder; write the new plant file there"
        )
    wanted = {name: value for name, value in before.items() if name not in REPLACED}
    wanted |= {"plant": _plant(found), "uncertainty": _uncertainty(found, before)}
    rest = _without(text, REPLACED)
    machine = before.get("machine", {})
    if noise and not {"sensor", "disturbance"} & set(machine):
        wanted["machine"] = {**machine, "sensor": {"noise": float(noise)}}
        rest += ["", "[machine.sensor]", f"noise = {float(noise)!r}  # of the residual of the fit"]
    lines = [
        *rest,
        "",
        f"[plant]  # fitted to {comment(fitted_to)} by `jaxilc identify`; "
        f"fit {float(np.min(found.fit)):.4g} %",
        *(f"{key} = {_value(value)}" for key, value in wanted["plant"].items()),
        "",
        "[uncertainty]  # of the plant: the 95 % intervals of the fit",
        *(f"{_key(name)} = {_value(of)}" for name, of in wanted["uncertainty"].items()),
    ]
    new = "\n".join(lines).strip("\n") + "\n"
    try:
        sound = tomllib.loads(new) == wanted
    except tomllib.TOMLDecodeError:
        sound = False
    if not sound:
        raise ValueError(
            f"{source}: its tables [plant] and [uncertainty] cannot be replaced as they are "
            "written; write each under a heading of its own, such as [plant]"
        )
    atomically(path, lambda file: file.write(new.encode()))
    return path


def _plant(found: Identified) -> dict[str, Any]:
    plant = found.plant
    values = {name: np.asarray(getattr(plant, name), float).tolist() for name in LEAVES}
    delay = float(getattr(plant, "delay", 0.0))
    return {"kind": "ProcessModel", **values} | ({"delay": delay} if delay else {})


def _uncertainty(found: Identified, before: dict[str, Any]) -> dict[str, Any]:
    """The intervals of the fit, and those of the file that are not of the plant."""
    kept = {
        name: of
        for name, of in dict(before.get("uncertainty", {})).items()
        if name.partition(".")[0] != "plant"
    }
    return kept | {
        name: {"distribution": "uniform", "low": one.low, "high": one.high}
        for name, one in intervals(found)[0].items()
    }


def _without(text: str, tables: tuple[str, ...]) -> list[str]:
    """The lines of a TOML text that do not stand in these tables."""
    kept, within = [], False
    for line in text.splitlines():
        header = _HEADER.match(line)
        if header:
            within = header[2] in tables
        if not within:
            kept.append(line)
    return kept


def _names_files(value: Any) -> bool:
    """Whether a part of a plant file that stays names another file."""
    if isinstance(value, list):
        return any(map(_names_files, value))
    if not isinstance(value, dict):
        return False
    return "csv" in value or any(
        _names_files(of) for name, of in value.items() if name not in REPLACED
    )


def _key(name: str) -> str:
    return name if _BARE.fullmatch(name) else json.dumps(name, ensure_ascii=False)


def _value(value: Any) -> str:
    """A value of a plant file as TOML."""
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{_key(k)} = {_value(v)}" for k, v in value.items()) + " }"
    if isinstance(value, list):
        return "[" + ", ".join(map(_value, value)) + "]"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)
    return json.dumps(value) if isinstance(value, bool) else repr(value)
