"""Values of a TOML or JSON file: tables that are read key by key, and the kinds of their values."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Collection, Iterable, Mapping
from typing import Any

import numpy as np

from ..pytree.closest import closest, known_names, listed, not_one_of
from ..pytree.ranges import as_numbers, brief, is_whole


class Table:
    """A table of a file, whose values are read key by key.

    where: name of the table in messages
    such_as: what a table has in this place, for the message on what is no table
    known: keys that are allowed besides those that are read, for the message on a missing one
    read: keys that were read; `done` refuses all others
    """

    def __init__(self, values: Any, where: str, such_as: str = "", known: Collection[str] = ()):
        if not isinstance(values, Mapping):
            what = (
                f"{where} {brief(values)}" if where.endswith(":") else f"{where} = {brief(values)}"
            )
            example = such_as and f", such as {such_as}"
            raise ValueError(f"{what} is not a table of keys and values{example}")
        self.values, self.where, self.known, self.read = dict(values), where, known, set()

    def __contains__(self, key: str) -> bool:
        return key in self.values

    def at(self, key: str) -> str:
        return f"{self.where}{' ' if self.where.endswith(':') else '.'}{listed([key])}"

    def take(
        self, key: str, kind: Callable[[Any, str], Any], default: Any = dataclasses.MISSING
    ) -> Any:
        """The value of a key, as `kind(value, where)` returns it.

        Raises ValueError where a key without default is missing; a key that is close to it, and
        not known, is taken for a mistake in writing it.
        """
        self.read.add(key)
        if key in self.values:
            return kind(self.values[key], self.at(key))
        if default is dataclasses.MISSING:
            others = [name for name in self.values if name not in {*self.known, *self.read}]
            for written in closest(key, others)[:1]:
                raise ValueError(
                    f"{self.at(written)} is not a key here; did you mean {key}? It is missing"
                )
            raise ValueError(f"{self.at(key)} is missing; present are {listed(self.values)}")
        return default

    def done(self) -> None:
        """Raises ValueError for a key that was not read, naming those that are allowed."""
        for key in self.values:
            if key not in self.read:
                raise ValueError(
                    f"{self.at(key)} is not a key here; "
                    f"{known_names(key, sorted(self.read), 'allowed are')}"
                )


# Kinds of values
# --------------------------------------------------------------------------------------------------


def number(value: Any, where: str, units: str = "") -> float:
    """One finite number.

    units: the units of numbers in this place, for the message on text such as `"1 mm"`
    """
    return float(_finite(value, where, "a number", (), units)[()])


def whole(value: Any, where: str) -> int:
    if not is_whole(value):
        raise ValueError(f"{where} = {brief(value)} is not a whole number")
    return value


def text(value: Any, where: str) -> str:
    if not isinstance(value, str):
        raise ValueError(f"{where} = {brief(value)} is not text")
    return value


def flag(value: Any, where: str) -> bool:
    if not isinstance(value, bool):
        raise ValueError(f"{where} = {brief(value)} is not true or false")
    return value


def numbers(value: Any, where: str, units: str = "") -> np.ndarray:
    """A number, or nested lists of numbers that form an array; all must be finite.

    units: as for `number`
    """
    return _finite(value, where, "a number or a list of numbers", units=units)


def list_of_numbers(value: Any, where: str) -> np.ndarray:
    """One list of finite numbers."""
    return _finite(value, where, "a list of numbers", (-1,))


def _finite(
    value: Any, where: str, said: str, shape: tuple | None = None, units: str = ""
) -> np.ndarray:
    """The value as a finite array of the shape (), (-1,), or any shape for None."""
    found = None if isinstance(value, bool | np.bool_ | str) else as_numbers(value)
    if found is None or (shape is not None and found.ndim != len(shape)):
        plain = "; numbers are written without quotes and without a unit" + (units and f": {units}")
        note = plain if isinstance(value, str) else ""
        raise ValueError(f"{where} = {brief(value)} is not {said}{note}")
    if not np.all(np.isfinite(found)):
        raise ValueError(f"{where} = {brief(value)} is not finite")
    return found


def one_of(choices: Iterable[str]) -> Callable[[Any, str], str]:
    """The kind of a value that must be one of these words."""

    def kind(value: Any, where: str) -> str:
        if not isinstance(value, str) or value not in choices:
            raise ValueError(not_one_of(f"{where} = {brief(value)}", value, choices))
        return value

    return kind


def list_of(kind: Callable[[Any, str], Any]) -> Callable[[Any, str], list]:
    """The kind of a list whose elements are of one kind."""

    def of_list(value: Any, where: str) -> list:
        if not isinstance(value, list):
            raise ValueError(f"{where} = {brief(value)} is not a list")
        return [kind(element, f"{where}[{i}]") for i, element in enumerate(value)]

    return of_list
