"""Objects as tables of a plant file: what `specification.built` reads, the other way round."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from ..pytree.fields import kind_of
from .specification import HIDDEN, classes


def table_of(made: Any) -> dict[str, Any]:
    """The table of a scheme, a filter or a model, with the name of its class.

    Fields that have their default value are left out. Raises ValueError for a class that a file
    cannot name.
    """
    cls = type(made)
    if classes().get(cls.__name__) is not cls:
        raise ValueError(f"{cls.__name__} is no class that a plant file can name")
    table: dict[str, Any] = {"class": cls.__name__}
    for field in dataclasses.fields(made):
        value = getattr(made, field.name)
        if field.name in HIDDEN or value is None or _is_default(value, field.default):
            continue
        table[field.name] = table_of(value) if kind_of(field) == "child" else _plain(value)
    return table


def _is_default(value: Any, default: Any) -> bool:
    if default is dataclasses.MISSING or default is None:
        return False
    try:
        return bool(np.shape(value) == np.shape(default) and np.all(np.asarray(value) == default))
    except (TypeError, ValueError):
        return value == default


def _plain(value: Any) -> Any:
    """A number, text or list."""
    if isinstance(value, str | bool | int):
        return value
    return list(value) if isinstance(value, tuple) else np.asarray(value).tolist()
