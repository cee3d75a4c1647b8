"""Loading a scenario by its name, with its options."""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Callable

from ..pytree.closest import not_one_of
from ..pytree.ranges import brief
from .cao_2019 import cao_2019
from .cao_2019_rig import cao_2019_rig
from .dai_2014 import dai_2014
from .double_mass import double_mass
from .li_2020 import li_2020
from .milc_2024 import milc_2024
from .pendulum import pendulum
from .scenario import Scenario
from .xu_2024 import xu_2024

SCENARIOS: dict[str, Callable[..., Scenario]] = {
    "cao-2019": cao_2019,
    "cao-2019-rig": cao_2019_rig,
    "dai-2014": dai_2014,
    "double-mass": double_mass,
    "li-2020": li_2020,
    "milc-2024": milc_2024,
    "pendulum": pendulum,
    "xu-2024": xu_2024,
}

JUDGED = ("reading", "plant")  # options of which `reproduce` judges the default


def with_reading(name: str, reading: str | None) -> dict[str, str]:
    """The options that choose a reading of a scenario; for None none, which is the judged one.

    Raises ValueError where a reading is named for a scenario that has only one.
    """
    if reading is None:
        return {}
    if name in SCENARIOS and "reading" not in options(name):
        several = ", ".join(known for known in SCENARIOS if "reading" in options(known))
        raise ValueError(
            f"reading = {brief(reading)}: {name} has one reading only; several have {several}"
        )
    return {"reading": reading}


def load(name: str, **chosen) -> Scenario:
    """A scenario by name, with its options (`load("cao-2019", plant="exact")`).

    Of a paper that can be read in several ways, the reading that `reproduce` judges is taken, and
    the form of the plant; the title of a scenario names any other.

    Raises ValueError naming the allowed scenarios or options.
    """
    if name not in SCENARIOS:
        raise ValueError(not_one_of(f"scenario = {brief(name)}", name, SCENARIOS))
    allowed = options(name)
    for option in chosen:
        if option not in allowed:
            raise ValueError(not_one_of(f"{name}: option {brief(option)}", option, allowed))
    for option, value in chosen.items():
        if isinstance(allowed[option], str) and not isinstance(value, str):
            raise ValueError(f"{name}: option {option} = {brief(value)} is not text")
        if isinstance(allowed[option], float):
            try:
                chosen[option] = float(value)
            except (TypeError, ValueError, OverflowError):
                raise ValueError(
                    f"{name}: option {option} = {brief(value)} is not a number"
                ) from None
    found = dataclasses.replace(SCENARIOS[name](**chosen), options=allowed | chosen)
    parts = [found.title]
    for option in JUDGED:
        if found.options.get(option) != allowed.get(option):
            parts.append(f"{option}: {found.options[option]}")
    return dataclasses.replace(found, title=", ".join(parts))


def options(name: str) -> dict[str, object]:
    """The options of a scenario with their defaults."""
    return {p.name: p.default for p in inspect.signature(SCENARIOS[name]).parameters.values()}
