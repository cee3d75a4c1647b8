"""A scenario by its name, or with a user's own machine from a TOML or JSON file.

`axis.toml` beside this module is such a file, with a comment on each key. Besides these there are:

    name, judged_by (the metric to which the tolerance belongs), shown_unit, shown_scale
    [machine.variation], how the trials differ, see `file_task`
    [task]: inputs, names, a path of all axes as `reference` (see `file_path`), and windows: times
        [s] or pairs of them at which the error counts (`counted_max`, `counted_rms`)
    [potential], what `jaxilc potential` measured: floor and stop, rms errors, and cutoff [Hz]

Names of files are relative to the folder of this file. An unknown key is refused, and the message
names the allowed ones.
"""

from __future__ import annotations

import dataclasses
import inspect
import re
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

from ..learning.machine import Machine
from ..learning.over_trials import check
from ..learning.quantities import contour_metrics, counted_metrics
from ..plants.cnc_axis import Axes
from ..pytree.aliases import Value
from ..pytree.closest import need_known, not_one_of
from ..pytree.ranges import brief, require
from ..schemes.at_samples import windows_of
from ..storage.reading import PARSERS, read_tree
from ..sweeps.grid import Parts, grid_of
from ..uncertainty import check as check_uncertainty
from .cao_2019 import cao_2019
from .cao_2019_rig import cao_2019_rig
from .dai_2014 import dai_2014
from .double_mass import double_mass
from .file_plant import plant_of
from .file_task import is_path, machine_of, task_of, uncertainty_of
from .li_2020 import li_2020
from .milc_2024 import milc_2024
from .pendulum import pendulum
from .scenario import Learnable, Quantity, Scenario, judged
from .specification import (
    Kind,
    Table,
    at_place,
    by_name,
    list_of,
    named_in,
    number,
    scheme,
    text,
    whole,
)
from .xu_2024 import xu_2024

# Scenarios of papers, by name
# --------------------------------------------------------------------------------------------------


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
    if Path(str(name)).suffix in PARSERS:
        raise ValueError(f"scenario = {brief(name)} is a file; jaxilc.load_scenario takes one")
    need_known(f"scenario = {brief(name)}", name, SCENARIOS)
    allowed = options(name)
    for option, value in chosen.items():
        need_known(f"{name}: option {brief(option)}", option, allowed)
        if isinstance(allowed[option], str) and not isinstance(value, str):
            raise ValueError(f"{name}: option {option} = {brief(value)} is not text")
        if isinstance(allowed[option], float):
            try:
                chosen[option] = float(value)
            except (TypeError, ValueError, OverflowError):
                raise ValueError(
                    f"{name}: option {option} = {brief(value)} is not a number"
                ) from None
    found = SCENARIOS[name](**chosen)
    found = dataclasses.replace(found, options=allowed | chosen, usual=allowed)
    parts = [found.title]
    for option in JUDGED:
        if found.options.get(option) != allowed.get(option):
            parts.append(f"{option}: {found.options[option]}")
    return dataclasses.replace(found, title=", ".join(parts))


def options(name: str) -> dict[str, object]:
    """The options of a scenario with their defaults."""
    return {p.name: p.default for p in inspect.signature(SCENARIOS[name]).parameters.values()}


# Scenarios of files
# --------------------------------------------------------------------------------------------------


def load_scenario(name: str | Path, settings: Mapping[str, object] | None = None) -> Scenario:
    """A scenario by its name, or from a TOML or JSON file.

    settings: options of the scenario and values by path, as `--set` takes them; values may be text
    Raises ValueError naming the known scenarios, what can be set, or the wrong key of the file and
    what is allowed.
    """
    chosen, values = with_options(name, settings or {})
    return chosen.with_values(values)


def with_options(
    name: str | Path, settings: Mapping[str, object]
) -> tuple[Scenario, dict[str, object]]:
    """A scenario with its options among the settings, and the values by path that are left.

    Raises ValueError as `load_scenario`.
    """
    rest = dict(settings)
    if str(name) in SCENARIOS:
        own = {path: rest.pop(path) for path in settings if path in options(str(name))}
        return load(str(name), **own), rest
    if Path(name).suffix in PARSERS:
        return read_scenario(name), rest
    said = not_one_of(f"scenario = {brief(str(name))}", str(name), SCENARIOS)
    raise ValueError(f"{said}; a file {' or '.join(PARSERS)} may stand in its place")


def read_scenario(path: str | Path) -> Scenario:
    """The scenario that a file describes, in the format that this module's docstring tells.

    A scenario without a name takes that of the file, with dashes for characters that are not
    allowed in a name.

    Raises FileNotFoundError, and ValueError naming the key that is wrong.
    """
    path = Path(path)
    file = Table(read_tree(path), f"{path}:")
    stem = re.sub(r"[^\w .+()-]", "-", path.stem).lstrip(" _-.+()")[:50].strip() or "plant"
    notes: list[str] = []
    given = file.values.get("task")
    units = (given.get(u) if isinstance(given, Mapping) else "" for u in ("input_unit", "unit"))
    of_u, of_y = (unit if isinstance(unit, str) else "" for unit in units)
    plant = file.take("plant", lambda v, at: plant_of(v, at, path.parent, notes, (of_u, of_y)))
    task = file.take("task", lambda v, at: task_of(v, at, path.parent, plant, notes))
    machine = file.take(
        "machine", lambda v, at: machine_of(v, at, plant, task, path.parent, notes), Machine(plant)
    )
    found = file.take(
        "schemes",
        lambda v, at: {
            n: scheme(s, f"{at}.{n}", plant, task.dt) for n, s in Table(v, at).values.items()
        },
        {},
    )
    path_given = is_path(file.values["task"].get("reference"))
    of_contour = task.outputs in (2, 3) and (path_given or isinstance(plant, Axes))
    further = contour_metrics(task) if of_contour else {}
    usual = "contour_max" if further and path_given else "settled_error"
    windows = file.values["task"].get("windows")
    if windows:
        with at_place(path, "task"):
            further |= counted_metrics(task, windows_of("task.windows", windows))
        usual = "counted_max"
    keys: dict[str, tuple[Kind[Value], Value]] = {  # what each is, and what it is if left out
        "uncertainty": (uncertainty_of, {}),
        "name": (text, stem),
        "title": (text, f"{stem}: {type(plant).__name__}"),
        "trials": (whole, 20),
        "tolerance": (number, None),
        "shown_unit": (text, task.unit),
        "shown_scale": (number, 1.0),
        "judged_by": (text, usual),
        "show_trials": (lambda v, at: tuple(list_of(whole)(v, at)), ()),
        "grid": (_axes, {}),
        "potential": (_potential, None),
    }
    of_file = {key: file.take(key, *of) for key, of in keys.items()}
    file.done()
    with at_place(path, ""):
        require("", "trials", of_file["trials"], "[1, inf)")
        require("", "show_trials", of_file["show_trials"], "[1, inf)", many=True)
        made = Scenario(
            machine=machine, task=task, schemes=found, chosen=tuple(notes),
            quantities={metric: Quantity(of) for metric, of in further.items()}, **of_file,
        )  # fmt: skip
    parts = Parts(machine, found, task, made.trials)
    with at_place(path, "grid"):
        grid_of(made.grid, machine, found, task).variants(parts)
    with at_place(path, "judged_by"):
        judged(made, made.judged_by)
    with at_place(path, "machine"):
        machine.check(task)
    with at_place(path, "uncertainty"):
        check_uncertainty(machine, made.uncertainty)
    for called, one in found.items():
        with at_place(path, f"schemes.{called}"):
            check(machine, one, task)
    return made


def _potential(values: Value, where: str) -> Learnable:
    """What repeats of the motion told."""
    table = Table(values, where)
    positive = partial(number, allowed="(0, inf)")
    found = Learnable(*(table.take(name, positive) for name in Learnable._fields))
    table.done()
    return found


def _axes(values: Value, where: str) -> dict[str, Value]:
    """Axes of a grid by name."""
    return by_name(named_in(values, where, lambda of: not isinstance(of, Mapping)))
