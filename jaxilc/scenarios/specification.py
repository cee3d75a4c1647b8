"""Objects from tables of a TOML or JSON file, with the name of a class and its fields as keys."""

from __future__ import annotations

import dataclasses
import functools
import inspect
import typing
from collections.abc import Callable, Iterable, Mapping
from types import UnionType
from typing import Any

import numpy as np

from .. import plants, schemes
from ..filters import switching, zero_phase
from ..plants import Plant
from ..pytree.closest import known_names, not_one_of
from ..pytree.ranges import as_numbers, brief, is_whole
from ..schemes import Scheme

_HIDDEN = {"solved"}  # computed by the scheme itself
_MODELS = {"direct_model": plants.direct_model, "multivariable_model": plants.multivariable_model}


@functools.cache
def classes() -> dict[str, type]:
    """Every class that a file may name: schemes, filters, plants and their parts."""
    found = {name: getattr(module, name) for module in (schemes, plants) for name in module.__all__}
    found |= {
        name: value for module in (zero_phase, switching) for name, value in vars(module).items()
    }
    return {
        n: c
        for n, c in found.items()
        if dataclasses.is_dataclass(c) and c.__module__.startswith(__name__.partition(".")[0] + ".")
    }


class Table:
    """A table of a file, whose values are read key by key.

    where: name of the table in messages
    read: keys that were read; `done` refuses all others
    """

    def __init__(self, values: Any, where: str):
        if not isinstance(values, Mapping):
            what = (
                f"{where} {brief(values)}" if where.endswith(":") else f"{where} = {brief(values)}"
            )
            raise ValueError(f"{what} is not a table of keys and values")
        self.values, self.where, self.read = dict(values), where, set()

    def __contains__(self, key: str) -> bool:
        return key in self.values

    def at(self, key: str) -> str:
        return f"{self.where}{' ' if self.where.endswith(':') else '.'}{key}"

    def take(
        self, key: str, kind: Callable[[Any, str], Any], default: Any = dataclasses.MISSING
    ) -> Any:
        """The value of a key, as `kind(value, where)` returns it.

        Raises ValueError where a key without default is missing.
        """
        self.read.add(key)
        if key in self.values:
            return kind(self.values[key], self.at(key))
        if default is dataclasses.MISSING:
            raise ValueError(
                f"{self.at(key)} is missing; present are {', '.join(self.values) or 'none'}"
            )
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


def number(value: Any, where: str) -> float:
    return float(_finite(value, where, "a number", ())[()])


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


def numbers(value: Any, where: str) -> np.ndarray:
    """A number, or nested lists of numbers that form an array; all must be finite."""
    return _finite(value, where, "a number or a list of numbers")


def list_of_numbers(value: Any, where: str) -> np.ndarray:
    """One list of finite numbers."""
    return _finite(value, where, "a list of numbers", (-1,))


def _finite(value: Any, where: str, said: str, shape: tuple | None = None) -> np.ndarray:
    """The value as a finite array of the shape (), (-1,), or any shape for None."""
    found = None if isinstance(value, bool | np.bool_ | str) else as_numbers(value)
    if found is None or (shape is not None and found.ndim != len(shape)):
        raise ValueError(f"{where} = {brief(value)} is not {said}")
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


# Objects
# --------------------------------------------------------------------------------------------------


def built(
    values: Any,
    where: str,
    *,
    cls: type | None = None,
    plant: Plant | None = None,
    dt: float | None = None,
) -> Any:
    """The object that a table describes: `class` names its class, the other keys are its fields.

    A nominal model may be the text "plant", which stands for the plant of the file at the task's
    sample time, or a table with `function` = "direct_model" or "multivariable_model", `C_P`, `P`.

    cls: the class, where the table does not name it
    plant, dt: the plant of the file, and the task's sample time [s]
    Raises ValueError naming the key: for an unknown class or field, for a missing field, and for a
    value of another kind or outside its range.
    """
    table = Table(values, where)
    if cls is None:
        cls = classes()[table.take("class", one_of(sorted(classes())))]
    hints, fields = typing.get_type_hints(cls), {}
    for field in dataclasses.fields(typing.cast(Any, cls)):
        if field.name in _HIDDEN:
            continue
        kind = functools.partial(_field, field, hints[field.name], plant, dt)
        value = table.take(
            field.name,
            kind,
            dataclasses.MISSING if field.default is dataclasses.MISSING else _DEFAULT,
        )
        if value is not _DEFAULT:
            fields[field.name] = value
    table.done()
    return _named(where, lambda: cls(**fields))


_DEFAULT = object()


def _field(
    field: dataclasses.Field,
    hint: Any,
    plant: Plant | None,
    dt: float | None,
    value: Any,
    where: str,
) -> Any:
    kind = field.metadata.get("kind", "child")
    if kind == "leaf":
        return numbers(value, where)
    if kind == "static":
        return tuple(value) if isinstance(value, list) else value
    if value == "plant":
        value = _nominal(where, plant, dt)
    elif isinstance(value, Mapping) and "function" in value:
        value = _model(value, where, plant, dt)
    elif isinstance(value, Mapping):
        value = built(value, where, plant=plant, dt=dt)
    if isinstance(hint, type | UnionType) and not isinstance(value, hint):
        raise ValueError(f"{where} is a {type(value).__name__}; allowed is {_kinds(hint)}")
    return value


def _kinds(hint: Any) -> str:
    """The names of the classes that are allowed for a part, as text for a message."""
    wanted = tuple(c for c in typing.get_args(hint) or (hint,) if c is not type(None))
    subclasses = [name for name, c in classes().items() if issubclass(c, wanted)]
    return (
        f"a table with class = {' | '.join(sorted(subclasses))}"
        if subclasses
        else ", ".join(c.__name__ for c in wanted)
    )


def _model(values: Mapping, where: str, plant: Plant | None, dt: float | None) -> plants.StateSpace:
    table = Table(values, where)
    function = _MODELS[table.take("function", one_of(sorted(_MODELS)))]
    gain = table.take("C_P", number)
    model = table.take(
        "P",
        lambda v, at: (
            _nominal(at, plant, dt) if v == "plant" else built(v, at, cls=plants.StateSpace)
        ),
    )
    table.done()
    return _named(where, lambda: function(gain, model))


def _nominal(where: str, plant: Plant | None, dt: float | None) -> plants.StateSpace:
    """The file's own plant as a discrete linear model."""
    if plant is None or dt is None:
        raise ValueError(f"{where} = 'plant' has no plant to stand for")
    linear = _named(where, lambda: getattr(plant, "linear", plant.sampled)(dt))
    if not isinstance(linear, plants.StateSpace):
        name = type(plant).__name__
        raise ValueError(
            f"{where} = 'plant' is a {name}, which is no linear model; allowed is a table with "
            "class = StateSpace"
        )
    return linear


def scheme(values: Any, where: str, plant: Plant, dt: float) -> Scheme:
    """The scheme with its parts that a table describes; raises ValueError as `built` does."""
    made = built(values, where, plant=plant, dt=dt)
    if not isinstance(made, Scheme):
        raise ValueError(f"{where} is a {type(made).__name__}; allowed is {_kinds(Scheme)}")
    return made


def called(function: Callable, table: Table, **given: Any) -> Any:
    """The result of a function whose arguments are the remaining keys of a table.

    given: further arguments of the function
    Raises ValueError naming the argument that does not fit.
    """
    arguments = {}
    for name, parameter in inspect.signature(function).parameters.items():
        if name in given:
            continue
        default = dataclasses.MISSING if parameter.default is parameter.empty else _DEFAULT
        value = table.take(
            name, lambda v, at: v if isinstance(v, str) else numbers(v, at)[()], default
        )
        if value is not _DEFAULT:
            arguments[name] = value
    table.done()
    return _named(table.where, lambda: function(**arguments, **given))


def _named(where: str, make: Callable[[], Any]) -> Any:
    """The result of `make`; its error is raised with the place in the file."""
    try:
        with np.errstate(all="ignore"):  # infinite results are refused where they are used
            return make()
    except (ValueError, TypeError) as error:
        raise ValueError(f"{where}: {error}") from None
