"""The column of the time in a record: which one it is, and in which unit it counts."""

from __future__ import annotations

import re

import numpy as np

SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
OTHER_NAMES = {"sec": "s", "seconds": "s", "msec": "ms", "µs": "us", "μs": "us"}
# From this mean step on, a time without a unit is doubted: a drive is sampled faster than 10 Hz.
DOUBTFUL = 0.1
# Share of the sample time by which a step of a record's time may differ from the others.
STEP_TOLERANCE = 0.01
_WITH_UNIT = re.compile(r"^(.+?)\s*(?:\[([^\[\]]*)\]|\(([^()]*)\))$")
_WITH_SUFFIX = re.compile(r"^(.+)_([a-zµμ]+)$")


def name_and_unit_of_time(heading: str) -> tuple[str, str | None]:
    """The name and the unit of a heading: `t [ms]`, `t (ms)` and `t_ms` are ("t", "ms").

    The unit is None where there is none. A suffix is a unit only if it is one of time.
    """
    if found := _WITH_UNIT.match(heading):
        unit = (found[2] if found[2] is not None else found[3]).strip()
        return found[1], OTHER_NAMES.get(unit, unit)
    if (found := _WITH_SUFFIX.match(heading)) and (OTHER_NAMES.get(found[2], found[2]) in SECONDS):
        return found[1], OTHER_NAMES.get(found[2], found[2])
    return heading, None


def place_of_time(name: str, header: list[str]) -> int | None:
    """The index of the column of the time, or None.

    It is found by its whole heading, or by its heading without the unit. The name `t` also stands
    for `time`, and capitals do not matter.
    """
    if name in header:
        return header.index(name)
    wanted = {name.lower(), "time"} if name == "t" else {name.lower()}
    for i, heading in enumerate(header):
        if name_and_unit_of_time(heading)[0].lower() in wanted:
            return i
    return None


def seconds_in(path, heading: str, unit: str | None, times: np.ndarray) -> float:
    """Seconds in one unit of the time column.

    heading: heading of the column
    unit: unit that was given, None for that of the heading
    times: the column
    Raises ValueError for a unit that is not known, a given unit that is not that of the heading,
    and a time without a unit whose mean step would be 0.1 s or more.
    """
    named = name_and_unit_of_time(heading)[1]
    if unit is not None and unit not in SECONDS:
        raise ValueError(f"time_unit = {unit!r} is not one of {', '.join(SECONDS)}")
    if unit is not None and named not in (None, unit):
        raise ValueError(
            f"read_record: {path}: the heading {heading!r} has another unit than --time-unit {unit}"
        )
    unit = unit or named
    if unit is not None:
        if unit not in SECONDS:
            raise ValueError(
                f"read_record: {path}: the unit {unit!r} of {heading!r} is not one of "
                f"{', '.join(SECONDS)}; --time-unit has no effect on a heading with a unit"
            )
        return SECONDS[unit]
    step = (times[-1] - times[0]) / max(len(times) - 1, 1)
    if len(times) > 1 and step >= DOUBTFUL:
        raise ValueError(
            f"read_record: {path}: {heading} steps by {step:.6g} and has no unit; in seconds that "
            f"would be {1 / step:.3g} samples a second, in milliseconds {1e3 / step:.3g}. Give "
            f"--time-unit s, ms or us (time_unit), or write the unit into the heading: "
            f"{heading} [ms]"
        )
    return 1.0
