"""How the trials differ, from a TOML or JSON file.

[machine.variation]          # offset, scatter, carried, shortest, dropped, late, delayed, delay
scatter = 1e-3
shortest = 0.8

# the plant from trial 21 on: values that are set, or multiplied, by their names in the plant
[machine.variation.change]
first = 21
over = 1
set = { "x0" = [0.0, 0.0] }
scale = { "B" = 1.2 }

# further references, each from a trial on; without `first` they change after each trial
[[machine.variation.references]]
first = 11
reference = { function = "sinusoid", amplitude = 2.0, frequency = 0.5, duration = 2.0 }
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from ..learning.variation import PlantChange, References, Variation
from ..plants import Plant
from ..pytree.named_paths import get_at, replaced
from ..signals.task import Task
from .specification import built
from .values import Table, flag, list_of, numbers, whole

_PARTS = ("change", "references", "averaged")


def variation_of(
    values: Any, where: str, plant: Plant, task: Task, reference: Callable[[Any, str], np.ndarray]
) -> Variation:
    """The variation that a table describes.

    reference: reads a reference (N+1, n_y) from its value and its place in the file
    Raises ValueError naming the key that is wrong.
    """
    table = Table(values, where)
    change = table.take("change", lambda v, at: _change(v, at, plant), None)
    references = table.take("references", lambda v, at: _references(v, at, task, reference), None)
    table.take("averaged", flag, False)
    numbers_of = {key: value for key, value in table.values.items() if key not in _PARTS}
    made = built(numbers_of, where, cls=Variation)
    fields = {f: getattr(made, f) for f in numbers_of}
    return Variation(**fields, change=change, references=references)


def _change(values: Any, where: str, plant: Plant) -> PlantChange:
    table = Table(values, where)
    first, over = table.take("first", whole), table.take("over", whole, 1)
    given = table.take("set", _named_numbers, {})
    factors = table.take("scale", _named_numbers, {})
    table.done()
    if not given and not factors:
        raise ValueError(f"{where}: set and scale are missing; at least one is needed")
    try:
        scaled = {name: np.asarray(get_at(plant, name)) * x for name, x in factors.items()}
        return PlantChange(replaced(plant, scaled | given), first, over, plant)
    except (KeyError, ValueError) as error:
        raise ValueError(f"{where}: {error.args[0]!s}") from None


def _named_numbers(value: Any, where: str) -> dict[str, Any]:
    if not isinstance(value, Mapping):
        raise ValueError(f"{where} is no table of names and numbers")
    return {name: numbers(x, f"{where}.{name}") for name, x in value.items()}


def _references(values: Any, where: str, task: Task, reference: Callable) -> References:
    def one(value, at):
        table = Table(value, at)
        first = table.take("first", whole, None)
        r = table.take("reference", reference)
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
    try:
        return References(np.stack([np.asarray(task.reference), *(r for _, r in found)]), first)
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from None
