"""Machine, task and uncertainty of a TOML or JSON file.

[machine.variation] has the fields of `Variation`, but for

    change       the plant from trial `first` on, reached in `over` trials: values to `set`, and
                 factors by which to `scale`, by their names in the plant
    references   a list of further ones: `reference`, from trial `first` on; without it in turns
"""

from __future__ import annotations

import dataclasses
import functools
import re
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from ..identification.record_files import read_record_file
from ..learning.machine import Actuator, Disturbance, Machine, Sensor
from ..learning.variation import PlantChange, References, Variation
from ..plants import Plant
from ..plants.cnc_axis import Axes
from ..pytree.aliases import Value
from ..pytree.named_paths import get_at, overlapping, replaced
from ..schemes.at_samples import windows_of
from ..signals import references
from ..signals.task import Task
from ..storage.columns import need_unit
from ..uncertainty import Distribution, LogUniform, Normal, Uniform
from .file_path import Setting, planned_path
from .specification import (
    Table,
    at_place,
    built,
    by_name,
    called,
    flag,
    list_of,
    named_in,
    number,
    numbers,
    of_record,
    one_of,
    text,
    whole,
)

UNITS = "lengths in the `unit` of the task, times in s, frequencies in Hz, angles in rad"
REFERENCES = ("sinusoid", "multisine", "chirp", "s_curve", "noncircular")
DISTRIBUTIONS: dict[str, type[Distribution]] = {
    "uniform": Uniform,
    "normal": Normal,
    "log_uniform": LogUniform,
}


def machine_of(
    values: Value, where: str, plant: Plant, task: Task, folder: Path, notes: list[str]
) -> Machine:
    """The plant with the actuator, sensor, disturbance and variation that a table describes."""
    table = Table(values, where)
    parts = {"actuator": Actuator, "sensor": Sensor, "disturbance": Disturbance}
    made = {
        key: table.take(key, functools.partial(built, cls=cls), None) for key, cls in parts.items()
    }
    setting = Setting(folder, plant, task.names, task.unit, task.dt, notes)
    variation = table.take("variation", functools.partial(variation_of, setting, task), None)
    table.done()
    return Machine(plant, **made, variation=variation)


def task_of(values: Value, where: str, folder: Path, plant: Plant, notes: list[str]) -> Task:
    """The task that a table describes.

    notes: list to which a text on how a path is followed is appended
    """
    table = Table(values, where)
    in_units = functools.partial(number, units=UNITS)
    dt = table.take("dt", functools.partial(in_units, allowed="(0, inf)"))
    unit = table.take("unit", text, "")
    names = tuple(table.take("names", list_of(text), list(names_of(plant))))
    if names and len(names) != plant.n_y:
        raise ValueError(
            f"{table.at('names')} = {list(names)} are {len(names)} names; the plant has "
            f"{plant.n_y} outputs"
        )
    setting, given = Setting(folder, plant, names, unit, dt, notes), table.values.get("reference")
    reference = table.take("reference", functools.partial(reference_of, setting))
    settle = table.take("settle", list_of(in_units), None)
    inputs, input_unit = table.take("inputs", whole, plant.n_u), table.take("input_unit", text, "")
    table.take("windows", lambda v, at: windows_of(at, list_of(_window)(v, at)), ())
    table.done()
    if settle is not None and len(settle) != 2:
        raise ValueError(f"{table.at('settle')} = {settle} is not a pair [start, stop]")
    with at_place(where):
        return Task(
            reference, dt=dt, settle=None if settle is None else (settle[0], settle[1]),
            inputs=inputs, unit=unit, input_unit=input_unit,
            names=setting.axes if is_path(given) else names,
        )  # fmt: skip


def reference_of(setting: Setting, value: Value, at: str) -> np.ndarray:
    """(N+1, n_y) the reference of all outputs: a path, or one for each of them."""
    if is_path(value):
        return planned_path(value, at, setting)
    each = value if isinstance(value, list) else [value]
    columns = [
        _reference(v, f"{at}[{i}]" if isinstance(value, list) else at, setting)
        for i, v in enumerate(each)
    ]
    if len({len(column) for column in columns}) > 1:
        lengths = ", ".join(str(len(column)) for column in columns)
        raise ValueError(f"{at}: the outputs have {lengths} samples; allowed is one length")
    if len(columns) != setting.plant.n_y:
        named = f" ({', '.join(setting.names)})" if setting.names else ""
        raise ValueError(
            f"{at}: the plant has {setting.plant.n_y} outputs{named}, and "
            f"{len(columns)} of them {'has' if len(columns) == 1 else 'have'} a reference; "
            "needed is a list with one for each output, or a path"
        )
    return np.stack(columns, axis=1)


def _window(value: Value, where: str) -> float | list[float]:
    """A time, or a pair of times [s]."""
    if isinstance(value, list):
        return list_of(number)(value, where)
    return number(value, where)


def names_of(plant: Plant) -> tuple[str, ...]:
    """The names of the outputs: those of axes side by side that have one output each, or none."""
    if isinstance(plant, Axes) and all(axis.n_y == 1 for axis in plant.axes.values()):
        return tuple(plant.axes)
    return ()


def is_path(reference: Value) -> bool:
    return isinstance(reference, Mapping) and "path" in reference


def _reference(value: Value, where: str, setting: Setting) -> np.ndarray:
    """(N+1,) reference from a function of `references`, or a column in the unit of the task."""
    table = Table(value, where, '{ function = "sinusoid", ... } or { csv = "FILE", column = "r" }')
    if "csv" not in table:
        function = table.take("function", one_of(REFERENCES))
        return np.asarray(called(getattr(references, function), table, UNITS, dt=setting.dt))
    path, column = setting.folder / table.take("csv", text), table.take("column", text, "r")
    time = table.take("time", text, "t")
    table.done()
    try:
        found = read_record_file(path, time=time, input=column, output=column)
    except ValueError as error:
        no_keys = r",? or (add )?`dt = [^`]*`|; or tell it by `time_unit`"
        said = re.sub(no_keys, "", of_record(error))
        raise ValueError(f"{where}: {said.replace('`input`', '`column`')}") from None
    record, (unit,) = found.record, found.output_units
    if abs(record.dt / setting.dt - 1) > 1e-6:
        raise ValueError(
            f"{where}: {path} is sampled at {record.dt:.10g} s but the task at "
            f"{setting.dt:.10g} s; nothing is resampled"
        )
    if unit and setting.unit:
        with at_place(where):
            need_unit(path, column, unit, setting.unit)
    return np.asarray(record.y)[:, 0]


def uncertainty_of(values: Value, where: str) -> dict[str, Distribution]:
    """Distributions by path within the machine."""
    found = distributions_in(values, where)
    return by_name((name, place, _distribution(of, place)) for name, place, of in found)


def distributions_in(values: Value, where: str) -> Iterator[tuple[str, str, Value]]:
    """Paths within the machine, and the places and tables of their distributions.

    `machine.` before a path may be left out in a file, and is left out here.
    """

    def is_one(of: Value) -> bool:
        nested = isinstance(of, Mapping) and all(isinstance(v, Mapping) for v in of.values())
        return not nested or "distribution" in of

    for name, place, of in named_in(values, where, is_one):
        yield name.removeprefix("machine."), place, of


def _distribution(values: Value, where: str) -> Distribution:
    table = Table(values, where)
    cls = DISTRIBUTIONS[table.take("distribution", one_of(DISTRIBUTIONS))]
    named = [f.name for f in dataclasses.fields(cls) if f.name != "relative"]
    fields = {one: table.take(one, number) for one in named}
    relative = table.take("relative", flag, False)
    table.done()
    with at_place(where):
        return cls(**fields, relative=relative)


# How the trials differ
# --------------------------------------------------------------------------------------------------


_PARTS = ("change", "references", "averaged")


def variation_of(setting: Setting, task: Task, values: Value, where: str) -> Variation:
    """The variation that a table describes.

    Raises ValueError naming the key that is wrong.
    """
    table = Table(values, where)
    change = table.take("change", functools.partial(_change, setting.plant), None)
    further = functools.partial(_further_references, setting, task)
    references = table.take("references", further, None)
    if table.take("averaged", flag, False):
        raise ValueError(f"{where}: averaged = true; allowed is false, for only theory averages")
    numbers_of = {key: value for key, value in table.values.items() if key not in _PARTS}
    made = built(numbers_of, where, cls=Variation)
    return dataclasses.replace(made, change=change, references=references)


def _change(plant: Plant, values: Value, where: str) -> PlantChange:
    table = Table(values, where)
    first, over = table.take("first", whole), table.take("over", whole, 1)
    given = table.take("set", _named_numbers, {})
    factors = table.take("scale", _named_numbers, {})
    table.done()
    if not given and not factors:
        raise ValueError(f"{where}: set and scale are missing; at least one is needed")
    if twice := overlapping([*given, *factors]):
        raise ValueError(
            f"{where}: {twice[1]} is changed by {twice[0]} already; allowed is each number once, "
            "in `set` or in `scale`"
        )
    try:
        scaled = {name: np.asarray(get_at(plant, name)) * x for name, x in factors.items()}
        return PlantChange(replaced(plant, scaled | given), first, over, plant)
    except (KeyError, ValueError) as error:
        raise ValueError(f"{where}: {error.args[0]!s}") from None


def _named_numbers(value: Value, where: str) -> dict[str, np.ndarray]:
    if not isinstance(value, Mapping):
        raise ValueError(f"{where} is no table of names and numbers")
    return {name: numbers(x, f"{where}.{name}") for name, x in value.items()}


def _further_references(setting: Setting, task: Task, values: Value, where: str) -> References:
    def one(value: Value, at: str) -> tuple[int | None, np.ndarray]:
        table = Table(value, at)
        first = table.take("first", whole, None)
        r = table.take("reference", functools.partial(reference_of, setting))
        table.done()
        if r.shape != np.shape(task.reference):
            raise ValueError(
                f"{at}: the reference has shape {r.shape}; that of the task has "
                f"{np.shape(task.reference)}, and all need one length"
            )
        return first, r

    found = list_of(one)(values, where)
    first = tuple(first for first, _ in found if first is not None)
    if first and len(first) != len(found):
        raise ValueError(f"{where}: first is needed for each of them, or for none")
    with at_place(where):
        return References(np.stack([np.asarray(task.reference), *(r for _, r in found)]), first)
