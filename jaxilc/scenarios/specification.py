"""Values and objects of a TOML or JSON file: tables that are read key by key, classes by name."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import inspect
import re
import typing
from collections.abc import Callable, Collection, Generator, Iterable, Iterator, Mapping
from types import UnionType
from typing import TYPE_CHECKING, NamedTuple, TypeAlias, TypeVar

import numpy as np

from .. import filters, plants, schemes
from ..plants import Plant
from ..pytree.aliases import Tree, Value
from ..pytree.closest import closest, known_names, listed, not_one_of
from ..pytree.ranges import as_numbers, brief, is_whole, require
from ..schemes import Scheme

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

T = TypeVar("T")
D = TypeVar("D")
Kind: TypeAlias = Callable[[Value, str], T]  # of a value of a file, at a place that messages name

# Tables and kinds of values
# --------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def at_place(
    *places: object, owner: str = "", also: type[Exception] = ValueError
) -> Generator[None]:
    """A ValueError from within is one that begins with the place in a file.

    places: such as the file and the table; empty ones are left out
    owner: name of a function with which its messages begin, and which a reader of a file does not
        know; empty for the last place, which is told once
    also: a further error that values of a file cause where they are arguments; elsewhere it is a
        mistake in a program, such as a user's own scheme, and stays as it is
    """
    try:
        with np.errstate(all="ignore"):  # infinite results are refused where they are used
            yield
    except (ValueError, also) as error:
        said = str(error).removeprefix(f"{owner or places[-1]}: ")
        raise ValueError(": ".join(str(part) for part in (*places, said) if part)) from None


class Table:
    """A table of a file, whose values are read key by key.

    where: name of the table in messages
    such_as: what a table has in this place, for the message on what is no table
    known: keys that are allowed besides those that are read, for the message on a missing one
    read: keys that were read; `done` refuses all others
    """

    def __init__(self, values: Value, where: str, such_as: str = "", known: Collection[str] = ()):
        if not isinstance(values, Mapping):
            what = (
                f"{where} {brief(values)}" if where.endswith(":") else f"{where} = {brief(values)}"
            )
            example = such_as and f", such as {such_as}"
            raise ValueError(f"{what} is not a table of keys and values{example}")
        self.values, self.where, self.known = dict(values), where, known
        self.read: set[str] = set()

    def __contains__(self, key: str) -> bool:
        return key in self.values

    def at(self, key: str) -> str:
        return f"{self.where}{' ' if self.where.endswith(':') else '.'}{listed([key])}"

    @typing.overload
    def take(self, key: str, kind: Kind[T]) -> T: ...
    @typing.overload
    def take(self, key: str, kind: Kind[T], default: D) -> T | D: ...
    def take(self, key: str, kind: Kind[Value], default: Value = dataclasses.MISSING) -> Value:
        """The value of a key, as `kind(value, where)` returns it.

        Raises ValueError where a key without default is missing; a key that is close to it, and
        not known, is taken for a mistake in writing it. Also for a file that cannot be read.
        """
        self.read.add(key)
        if key in self.values:
            try:
                return kind(self.values[key], self.at(key))
            except OSError as error:  # of a file that is named there
                said = f"{error.filename}: {error.strerror.lower()}" if error.strerror else error
                raise ValueError(f"{self.at(key)}: {said}") from None
        if default is dataclasses.MISSING:
            others = [name for name in self.values if name not in {*self.known, *self.read}]
            for written in closest(key, others)[:1]:
                raise ValueError(
                    f"{self.at(written)} is not a key here; did you mean {key}? It is missing"
                )
            allowed = self.known and f"; allowed are {listed(self.known)}"
            raise ValueError(
                f"{self.at(key)} is missing; present are {listed(self.values)}{allowed or ''}"
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


def of_record(error: ValueError) -> str:
    """What was wrong with a record, with keys of a file in place of the options of a command."""
    said = str(error).removeprefix("read_record: ")
    said = re.sub(
        r"(?<![\w.-])--[\w-]+( [\d.e+-]+)? \((\w+)\)",
        lambda found: f"`{found[2]}{' =' if found[1] else ''}{found[1] or ''}`",
        said,
    )
    option = r"(?<![\w.-])--([a-z-]+)"  # and no part of a path
    return re.sub(option, lambda found: f"`{found[1].replace('-', '_')}`", said)


def named_in(
    values: Value, where: str, is_value: Callable[[Value], bool]
) -> Iterator[tuple[str, str, Value]]:
    """Names such as "plant.B", their places and values; a name is a key, or tables in each other.

    is_value: whether what stands at a key is a value, and no table of further names
    """
    table = Table(values, where)
    for name, of in table.values.items():
        if is_value(of):
            yield name, table.at(name), of
        else:
            for rest, place, value in named_in(of, table.at(name), is_value):
                yield f"{name}.{rest}", place, value


def by_name(found: Iterable[tuple[str, str, T]]) -> dict[str, T]:
    """Values by name, of names, places and values.

    Raises ValueError for a name that is given twice, such as "plant.B" and `B` in a table `plant`.
    """
    values: dict[str, T] = {}
    for name, place, value in found:
        if name in values:
            raise ValueError(f"{place} gives {name} a second time; allowed is once")
        values[name] = value
    return values


# Kinds of values
# --------------------------------------------------------------------------------------------------


def number(
    value: Value, where: str, units: str = "", allowed: str = "(-inf, inf)", note: str = ""
) -> float:
    """One finite number in an interval.

    units: the units of numbers in this place, for the message on text such as `"1 mm"`
    note: text of the message after the interval
    """
    found = array(value, where, units, "a number", 0)
    require("", where, found, allowed, note=note)
    return float(found)


def whole(value: Value, where: str) -> int:
    if not is_whole(value):
        raise ValueError(f"{where} = {brief(value)} is not a whole number")
    return value


def text(value: Value, where: str) -> str:
    if not isinstance(value, str):
        raise ValueError(f"{where} = {brief(value)} is not text")
    return value


def flag(value: Value, where: str) -> bool:
    if not isinstance(value, bool):
        raise ValueError(f"{where} = {brief(value)} is not true or false")
    return value


def numbers(value: Value, where: str, units: str = "", allowed: str = "(-inf, inf)") -> np.ndarray:
    """A number, or nested lists of numbers that form an array; all in an interval.

    units: as for `number`
    """
    found = array(value, where, units)
    require("", where, found, allowed, many=True)
    return found


def list_of_numbers(value: Value, where: str) -> np.ndarray:
    """One list of finite numbers."""
    array(value, where, said="a list of numbers", ndim=1)
    return numbers(value, where)


def array(
    value: Value,
    where: str,
    units: str = "",
    said: str = "a number or a list of numbers",
    ndim: int | None = None,
) -> np.ndarray:
    """A number, or nested lists of numbers; who reads them says which are allowed.

    units: as for `number`
    ndim: number of axes, None for any, as `said`
    """
    found = None if isinstance(value, bool | np.bool_ | str) else as_numbers(value)
    if found is None or (ndim is not None and found.ndim != ndim):
        plain = "; numbers are written without quotes and without a unit" + (units and f": {units}")
        note = plain if isinstance(value, str) else ""
        raise ValueError(f"{where} = {brief(value)} is not {said}{note}")
    return found


def one_of(choices: Iterable[str]) -> Kind[str]:
    """The kind of a value that must be one of these words."""

    def kind(value: Value, where: str) -> str:
        if not isinstance(value, str) or value not in choices:
            raise ValueError(not_one_of(f"{where} = {brief(value)}", value, choices))
        return value

    return kind


def list_of(kind: Kind[T]) -> Kind[list[T]]:
    """The kind of a list whose elements are of one kind."""

    def of_list(value: Value, where: str) -> list[T]:
        if not isinstance(value, list):
            raise ValueError(f"{where} = {brief(value)} is not a list")
        return [kind(element, f"{where}[{i}]") for i, element in enumerate(value)]

    return of_list


# Objects from tables with the name of a class and its fields as keys
# --------------------------------------------------------------------------------------------------


HIDDEN = {"solved"}  # computed by the scheme itself
_MODELS: dict[str, Callable[..., plants.StateSpace]] = {
    "direct_model": plants.direct_model,
    "multivariable_model": plants.multivariable_model,
    "with_jerk": schemes.with_jerk,
}


@functools.cache
def classes() -> dict[str, type[DataclassInstance]]:
    """Every class that a file may name: schemes, filters, plants and their parts."""
    rooms = (schemes, filters, plants)
    found = {name: getattr(module, name) for module in rooms for name in module.__all__}
    return {n: c for n, c in found.items() if isinstance(c, type) and dataclasses.is_dataclass(c)}


class Own(NamedTuple):
    """What "plant" stands for: the plant of the file, and the task's sample time [s]."""

    plant: Plant
    dt: float


def built(
    values: Value,
    where: str,
    *,
    cls: type[DataclassInstance] | None = None,
    hint: object = None,
    own: Own | None = None,
) -> Tree:
    """The object that a table describes: `class` names its class, the other keys are its fields.

    A nominal model may be the text "plant", which stands for the plant of the file, or a table with
    `function` = "direct_model" or "multivariable_model", `C_P`, `P`, or "with_jerk", `P`. A scheme
    that needs a linear model gets the linear plant at the task's sample time.

    cls: the class, where the table does not name it
    hint: what the object must be, where a table names another class
    own: None where "plant" stands for nothing
    Raises ValueError naming the key: for an unknown class or field, for a missing field, and for a
    value of another kind or outside its range.
    """
    known = [field.name for field in dataclasses.fields(cls)] if cls else []
    table = Table(values, where, ", ".join(known), known)
    if cls is None:
        suited, named = _suited(hint), table.values.get("class")
        if isinstance(named, str) and named in classes() and named not in suited:
            raise ValueError(f"{where} is a {named}; {_kinds(hint, values, own)}")
        cls = classes()[table.take("class", one_of(suited))]
        table.known = [field.name for field in dataclasses.fields(cls)]
    hints, fields = typing.get_type_hints(cls), {}
    for field in dataclasses.fields(cls):
        if field.name in HIDDEN:
            continue
        kind = functools.partial(_field, field, hints[field.name], own)
        default = dataclasses.MISSING if field.default is dataclasses.MISSING else _DEFAULT
        value = table.take(field.name, kind, default)
        if value is not _DEFAULT:
            fields[field.name] = value
    table.done()
    with at_place(where, also=TypeError):
        return cls(**fields)


_DEFAULT = object()


def _field(
    field: dataclasses.Field, hint: object, own: Own | None, value: Value, where: str
) -> Value:
    kind = field.metadata.get("kind", "child")
    if kind == "leaf":
        return array(value, where)
    if kind == "static":
        return tuple(value) if isinstance(value, list) else value
    if typing.get_origin(hint) is tuple and isinstance(value, list):  # parts of one kind
        kind_of = functools.partial(_field, field, typing.get_args(hint)[0], own)
        return tuple(kind_of(one, f"{where}[{i}]") for i, one in enumerate(value))
    if value == "plant":
        value = own.plant if hint is Plant and own else _nominal(where, own)
    elif isinstance(value, Mapping) and "function" in value:
        value = _model(value, where, own)
    elif isinstance(value, Mapping):
        value = built(value, where, hint=hint, own=own)
    if isinstance(hint, type | UnionType) and not isinstance(value, hint):
        plain = isinstance(value, str | int | float | list)
        found = f" = {brief(value)}" if plain else f" is a {type(value).__name__}"
        raise ValueError(f"{where}{found}{' is no table' * plain}; {_kinds(hint, value, own)}")
    return value


def _wanted(hint: object) -> tuple[type, ...]:
    """The classes of a hint."""
    parts = typing.get_args(hint) or (hint,)
    return tuple(c for c in parts if isinstance(c, type) and c is not type(None))


def _suited(hint: object) -> list[str]:
    """The names of the classes that a hint allows; of all where it names none."""
    wanted = _wanted(hint) or (object,)
    return sorted(name for name, c in classes().items() if issubclass(c, wanted))


def _kinds(hint: object, value: Value, own: Own | None) -> str:
    """What is allowed for a part, as text for a message on a value that is not.

    Text that is close to a class, or to "plant", is answered with it first.
    """
    wanted, named = _wanted(hint), _suited(hint)
    if not named:
        return f"allowed is {', '.join(c.__name__ for c in wanted)}"
    allowed = f"a table with class = {' | '.join(named)}"
    written = {name: f'{{ class = "{name}", ... }}' for name in named}
    if issubclass(plants.StateSpace, wanted):
        allowed += f", or a table with function = {' | '.join(_MODELS)}"
        if own is not None:
            written["plant"] = '"plant"'
            allowed = f'"plant", which stands for the plant of this file, {allowed}'
    near = [written[name] for name in closest(value, written)]
    return (f"did you mean {' or '.join(near)}? Allowed is " if near else "allowed is ") + allowed


def _model(values: Mapping, where: str, own: Own | None) -> plants.StateSpace:
    table = Table(values, where)
    function = _MODELS[table.take("function", one_of(sorted(_MODELS)))]
    gains = () if function is schemes.with_jerk else (table.take("C_P", number),)
    model = table.take("P", functools.partial(_state_space, own))
    table.done()
    with at_place(where, also=TypeError):
        return function(*gains, model)


def _state_space(own: Own | None, value: Value, where: str) -> plants.StateSpace:
    if value == "plant":
        return _nominal(where, own)
    if isinstance(value, str):
        raise ValueError(
            f'{where} = {brief(value)} is no table; allowed is "plant", which stands for the plant '
            "of this file, or a table with A, B, C, dt of a discrete model"
        )
    return built(value, where, cls=plants.StateSpace)


def _nominal(where: str, own: Own | None) -> plants.StateSpace:
    """The file's own plant as a discrete linear model."""
    if own is None:
        raise ValueError(f"{where} = 'plant' has no plant to stand for")
    with at_place(where, also=TypeError):
        linear = getattr(own.plant, "linear", own.plant.sampled)(own.dt)
    if not isinstance(linear, plants.StateSpace):
        name = type(own.plant).__name__
        raise ValueError(
            f"{where} = 'plant' is a {name}, which is no linear model; allowed is a table with "
            "class = StateSpace"
        )
    return linear


def scheme(values: Value, where: str, plant: Plant, dt: float) -> Scheme:
    """The scheme with its parts that a table describes; raises ValueError as `built` does."""
    return built(values, where, hint=Scheme, own=Own(plant, dt))


def called(function: Callable[..., T], table: Table, units: str, **given: Value) -> T:
    """The result of a function whose arguments are the remaining keys of a table.

    An argument is text where its default is text, and otherwise numbers.

    units: units of the numbers, for messages
    given: further arguments of the function
    Raises ValueError naming the argument that does not fit.
    """

    def in_units(value: Value, where: str) -> np.ndarray:
        return array(value, where, units)[()]

    arguments, parameters = {}, inspect.signature(function).parameters
    table.known = [name for name in parameters if name not in given]
    for name, parameter in parameters.items():
        if name in given:
            continue
        default = dataclasses.MISSING if parameter.default is parameter.empty else _DEFAULT
        read = text if isinstance(parameter.default, str) else in_units
        value = table.take(name, read, default)
        if value is not _DEFAULT:
            arguments[name] = value
    table.done()
    with at_place(table.where, also=TypeError):
        return function(**arguments, **given)
