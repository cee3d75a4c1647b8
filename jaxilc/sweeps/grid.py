"""Grids of a sweep: axes of values, and at each of their points the same machines.

    {"ffdl-mfailc.lam": "0.1:10:25log", "machine.plant.gain": np.linspace(0.5, 2, 31),
     "ffdl-mfailc.lead": [0, 2, 4], "cfdl-mfailc.rho / ffdl-mfailc.rho": "0.2, 0.5, 1"}

A key is the path of a leaf or a static field of the machine, the task or a scheme, as `--set` has
it, or `trials`. Several names with `/` between them are one axis, either with values of their own
(as text also with `/` between them) or with the same ones. An axis of leaves is one more factor of
the machines, in the same compiled program. Each value of a static axis has a program of its own.
"""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sized
from contextlib import suppress
from functools import cached_property
from itertools import combinations, product
from typing import TYPE_CHECKING, NamedTuple, Protocol, TypeAlias, TypeVar

import numpy as np

from ..learning.known_metrics import METRICS
from ..learning.machine import Machine
from ..learning.over_trials import check
from ..learning.quantities import CountedMetric
from ..pytree.aliases import Json, Tree, Value
from ..pytree.closest import known_names, listed
from ..pytree.named_paths import (
    get_at,
    interval_at,
    kind_at,
    need_leaf,
    owner_of,
    read_at,
    replaced,
    settable,
    unit_at,
)
from ..pytree.ranges import Interval, as_numbers, brief, fits, outside, require
from ..runtime.capacity import check_size
from ..runtime.provenance import describe
from ..schemes import Scheme
from ..signals.task import Task
from ..uncertainty import Population, drawn_machine, need_ranges

if TYPE_CHECKING:
    import xarray as xr

T = TypeVar("T")
Values: TypeAlias = list[Value] | np.ndarray  # along an axis

_RANGE = re.compile(r"([^:]+):([^:]+):\s*(\d+)\s*(log)?")
_COMMA = re.compile(r",(?![^(\[]*[)\]])")  # none within brackets
WAYS = "LOW:HIGH:COUNT, LOW:HIGH:COUNTlog, or values with commas between them"
OF_A_VALUE = 64  # bytes
MANY = 1000  # places of a grid that are checked in about a second
TRIALS = "trials"
STEPS = "trials_of_step"  # coordinate of schemes that make experiments
EARLIEST = "variation.shortest"
_OTHERS = {"machine", "task"}  # first parts of a path that are no schemes
_TAKEN = {TRIALS, STEPS, "scheme", "sample", "trial", "channel", "input", "time", "input_time"}
_TAKEN |= {"y", "e", "u", *(metric.name for metric in METRICS)}


class HasParts(Protocol):
    """What a sweep runs at a point: `Parts`, or a scenario."""

    @property
    def machine(self) -> Machine: ...
    @property
    def schemes(self) -> Mapping[str, Scheme]: ...
    @property
    def task(self) -> Task: ...
    @property
    def trials(self) -> int: ...


class Parts(NamedTuple):
    machine: Machine
    schemes: Mapping[str, Scheme]
    task: Task
    trials: int


class Variant(NamedTuple):
    """What one program computes: a scheme at one value of each static axis.

    fixed: the positions of these values in their axes
    """

    name: str
    fixed: tuple[int, ...]
    machine: Machine
    scheme: Scheme
    task: Task
    trials: int


@dataclasses.dataclass(frozen=True, eq=False)
class Axis:
    """One axis of a grid.

    values: values by name; the first name is that of the dimension. A name is a path that begins
        with `machine`, `task` or a scheme, or it is `trials`, or that of values which have a
        machine, schemes and a task each
    units: units by name, empty where there is none
    static: whether each value needs a program of its own
    """

    values: Mapping[str, Values]
    units: Mapping[str, str]
    static: bool

    @property
    def name(self) -> str:
        return next(iter(self.values))

    @property
    def size(self) -> int:
        return len(self.values[self.name])

    @property
    def ends(self) -> list[int]:
        """The positions of the least and the largest value; of what is no number the first one."""
        numbers = as_numbers(self.values[self.name])
        if numbers is None:
            return [0]
        by_size = np.argsort(np.reshape(numbers, (self.size, -1))[:, 0])
        return sorted({int(by_size[0]), int(by_size[-1])})

    @cached_property
    def labels(self) -> dict[str, np.ndarray]:
        """The values by name as a coordinate has them: numbers, or text for all others."""
        return {name: labels_along(of) for name, of in self.values.items()}


@dataclasses.dataclass(frozen=True, eq=False)
class Grid:
    """The axes of a sweep; none for a sweep of a single point.

    In a store the static axes multiply the schemes, and the others the machines: member m of a
    variant is machine m % machines at the point m // machines.
    """

    axes: tuple[Axis, ...] = ()

    @cached_property
    def static(self) -> tuple[Axis, ...]:
        return tuple(axis for axis in self.axes if axis.static)

    @cached_property
    def leaves(self) -> tuple[Axis, ...]:
        return tuple(axis for axis in self.axes if not axis.static)

    @property
    def points(self) -> int:
        """The number of points of a variant."""
        return math.prod(axis.size for axis in self.leaves)

    @property
    def size(self) -> int:
        """The number of all points."""
        return math.prod(axis.size for axis in self.axes)

    def places(self, points: np.ndarray) -> Iterator[tuple[Axis, np.ndarray]]:
        """Each axis of leaves with the positions in it of points of a variant, by their numbers."""
        if self.leaves:
            at = np.unravel_index(points, [axis.size for axis in self.leaves])
            yield from zip(self.leaves, at, strict=True)

    def leaves_at(self, points: np.ndarray, scheme: str) -> dict[str, dict[str, np.ndarray]]:
        """The values of leaves at points of a variant: by `machine`, `scheme` or `task`, and path.

        Those of other schemes are left out; a part without values is.
        """
        found: dict[str, dict[str, np.ndarray]] = {}
        for axis, at in self.places(points):
            for name, values in axis.values.items():
                owner, path = name.split(".", 1)
                if owner in (scheme, *_OTHERS):
                    part = "scheme" if owner == scheme else owner
                    found.setdefault(part, {})[path] = values[at]
        return found

    def variants(self, parts: Parts) -> dict[str, Variant]:
        """The variants by their names, scheme by scheme; raises ValueError as `replaced` does."""
        found, positions = {}, product(*(range(axis.size) for axis in self.static))
        for name, fixed in product(parts.schemes, positions):
            place = dict(zip((axis.name for axis in self.static), fixed, strict=True))
            made = self.at(place, parts)
            found[", ".join([name, *([self._told(place)] if place else [])])] = Variant(
                name, fixed, made.machine, made.schemes[name], made.task, made.trials
            )
        return found

    def at(self, place: Mapping[str, int], parts: Parts) -> Parts:
        """The parts with the values of some axes.

        place: positions in the axes by the first name of each
        """
        machine, schemes, task, trials = parts
        changes: dict[str, dict[str, Value]] = {}
        for axis in (axis for axis in self.axes if axis.name in place):
            for name, values in axis.values.items():
                value, (owner, _, path) = values[place[axis.name]], name.partition(".")
                if name == TRIALS:
                    trials = value
                elif isinstance(value, _Whole):
                    machine, task = value.of.machine, value.of.task
                    schemes = {n: value.of.schemes[n] for n in schemes}
                else:
                    changes.setdefault(owner, {})[path] = value
        objects: dict[str, Tree] = {"machine": machine, "task": task, **schemes}
        for owner, changed in changes.items():
            objects[owner] = _named(replaced, objects[owner], changed)
        return Parts(
            objects.pop("machine"), task=objects.pop("task"), schemes=objects, trials=trials
        )

    def place_of(self, point: Mapping[str, Value]) -> dict[str, int]:
        """The positions of a point that is given by a value of each axis.

        Raises ValueError for a value that is missing, or not one of its axis, and for a name that
        no axis has.
        """
        if not isinstance(point, Mapping) or {*point} - {axis.name for axis in self.axes}:
            axes = listed(axis.name for axis in self.axes)
            raise ValueError(
                f"grid: point = {brief(point)}; allowed is a value of each axis, which are: {axes}"
            )
        found = {}
        for name, labels in ((axis.name, axis.labels[axis.name].tolist()) for axis in self.axes):
            if point.get(name) not in labels:
                raise ValueError(
                    f"grid: {name} = {brief(point.get(name))} is not one of {brief(labels)}"
                )
            found[name] = labels.index(point.get(name))
        return found

    def check(self, population: Population, parts: Parts, quantities: Mapping[str, Value]) -> None:
        """Raises ValueError, naming the axis, for values with which a sweep cannot run.

        At all ends of the axes of leaves all values of the static ones are checked, their ends
        first, and of drawn ends of trials the earliest. Where these are more than MANY, values
        between the ends of the static axes are checked at the first end of the leaves alone. The
        numbers of the population are drawn. What the axes replace is not checked: it is not run.
        """
        drawn = population.drawn

        def allow(machine: Machine, task: Task) -> None:
            need_ranges(machine, population.uncertainty, drawn)
            if EARLIEST in drawn:
                i = int(np.argmin(drawn[EARLIEST]))
                numbers = {name: values[i] for name, values in drawn.items()}
                machine = drawn_machine(machine, population.uncertainty, numbers)
                machine.check(task)
            for of in quantities.values():
                if isinstance(of, CountedMetric):
                    of.check(machine, task)

        if not self.axes:
            allow(parts.machine, parts.task)
            return
        taken = [name for axis in self.axes for name in axis.values]
        for one, other in combinations(taken, 2):
            if _overlap(one, other):
                raise ValueError(
                    f"grid: {one} is set a second time, by {other}; allowed is one axis"
                )
        for axis_name, (of, d) in product(taken, population.uncertainty.items()):
            if _overlap(axis_name, f"machine.{of}") and not d.relative:
                raise ValueError(
                    f"grid: {axis_name} is drawn from {d}, which replaces the value of the axis; "
                    "allowed is a relative distribution, which scales it"
                )
        options = [axis.name for axis in self.axes if isinstance(axis.values[axis.name][0], _Whole)]
        if len(options) > 1:
            raise ValueError(
                f"grid: {' and '.join(options)} are options of the scenario, each value of which "
                "replaces machine, task and schemes as a whole; allowed is one such axis, and the "
                "other option set to one value"
            )
        names = [axis.name for axis in self.axes]
        ends = [axis.ends for axis in self.axes]
        every = [range(axis.size) if axis.static else axis.ends for axis in self.axes]
        if math.prod(map(len, every)) > MANY:
            every = [one if axis.static else one[:1]
                     for axis, one in zip(self.axes, every, strict=True)]  # fmt: skip
        # all take a minute where they are many
        for positions in (ends, every) if self.static else (ends,):
            for place in (dict(zip(names, at, strict=True)) for at in product(*positions)):
                here = self.at(place, parts)
                _same_shape(self._told(place), parts.task, here.task)
                for name, scheme in here.schemes.items():
                    _named(check, here.machine, scheme, here.task, said=f"grid: {name}")
                _named(allow, here.machine, here.task)

    def _told(self, place: Mapping[str, int]) -> str:
        """The values at these positions, as a name of a variant and a message have them."""
        labels = {axis.name: axis.labels[axis.name] for axis in self.axes}
        return ", ".join(f"{name} = {labels[name][i]}" for name, i in place.items())

    def described(self, schemes: Mapping[str, Scheme]) -> Json:
        """All that determines the numbers of a grid, and how its store is laid out, as JSON."""
        axes = [
            {
                "name": axis.name,
                "units": dict(axis.units),
                "static": axis.static,
                "size": axis.size,
                "values": describe(axis.values),
            }
            for axis in self.axes
        ]
        return {"schemes": list(schemes), "axes": axes}


def grid_of(
    given: Mapping[Value, Value], machine: Machine, schemes: Mapping[str, Scheme], task: Task
) -> Grid:
    """The grid that a mapping of names to values describes, see the docstring of this module.

    Where the values of a name are a mapping, its values have a `machine`, `schemes` and a `task`
    each, such as a scenario, and its keys are labels.
    Raises ValueError, naming the axis, for a name that is not a leaf or a static field, and for
    values that are missing, not finite, equal, outside the range of their leaf, or too many.
    """
    for name in {*_OTHERS, TRIALS} & {*schemes} if given else ():
        raise ValueError(f"grid: a scheme is called {name}, as what is no scheme is; rename it")
    for name in schemes:
        if {".", "/"} & {*name} and any(f"{name}." in str(key) for key in given):
            raise ValueError(
                f"grid: a scheme is called {name!r}, whose weights cannot be axes; allowed is a "
                "name without . and /"
            )
    objects = {"machine": machine, "task": task, **schemes}
    return Grid(tuple(_axis(key, values, objects) for key, values in given.items()))


def values_at(names: Collection[str], of: HasParts) -> dict[str, Value]:
    """The values that axes of these names have; a name that is no number or field is left out."""
    objects: dict[str, Tree] = {"machine": of.machine, "task": of.task, **of.schemes}
    found = {}
    for name in names:
        with suppress(KeyError, ValueError):
            at = _canonical(name, objects)
            value = of.trials if at == TRIALS else get_at(*_in(at, objects))
            found[name] = labels_along([np.asarray(value).tolist()]).tolist()[0]
    return found


def unfolded(flat: xr.Dataset, of: Value) -> xr.Dataset:
    """The dataset with a dimension for each axis, of one as it is stored; see `Grid.described`."""
    import xarray as xr

    sizes = {axis["name"]: axis["size"] for axis in of["axes"]}
    static = {axis["name"]: axis["size"] for axis in of["axes"] if axis["static"]}
    leaves = {name: size for name, size in sizes.items() if name not in static}
    machines = flat.sizes["sample"] // math.prod(leaves.values())
    inner = {"scheme": {"scheme": len(of["schemes"])} | static,
             "sample": leaves | {"sample": machines}}  # fmt: skip
    order = ("scheme", *sizes, "sample")

    def whole(array: xr.Variable) -> xr.Variable:
        parts = [inner.get(dim, {dim: flat.sizes[dim]}) for dim in map(str, array.dims)]
        shape = {dim: size for part in parts for dim, size in part.items()}
        made = xr.Variable(tuple(shape), array.values.reshape(tuple(shape.values())), array.attrs)
        return made.transpose(*(d for d in order if d in shape), ...)

    of_axes = {name: (axis["name"], unit) for axis in of["axes"]
               for name, unit in axis["units"].items()}  # fmt: skip
    coords: dict[str, np.ndarray | tuple[Value, ...]] = {
        "scheme": np.array(of["schemes"], flat["scheme"].dtype),
        "sample": np.arange(machines),
    }
    for name, array in flat.coords.items():
        if name in coords:
            continue
        dim, unit = of_axes.get(str(name), ("sample", ""))
        made = whole(array.variable)
        if name in of_axes or "sample" in made.dims:  # the same everywhere but along one dimension
            made = made.isel({d: 0 for d in made.dims if d != dim})
        coords[str(name)] = (made.dims, made.values, {"units": unit} if unit else {})
    data = {name: whole(array.variable) for name, array in flat.data_vars.items()}
    return xr.Dataset(data, coords, flat.attrs)


# Reading of axes
# --------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class _Whole:
    """A value of an axis that is a whole: a machine, schemes and a task."""

    label: str
    of: HasParts


def _axis(key: Value, given: Value, objects: Mapping[str, Tree]) -> Axis:
    keys = key.split("/") if isinstance(key, str) else key
    if not (isinstance(keys, list | tuple) and keys and all(isinstance(k, str) for k in keys)):
        raise ValueError(f"grid: {brief(key)} is not a name, or names with / between them")
    if isinstance(given, Mapping):
        return _axis_of_wholes("/".join(keys), given, objects)
    names = [_canonical(one.strip(), objects) for one in keys]
    values = {n: _values(n, of, objects) for n, of in zip(names, _parts(given, names), strict=True)}
    counts = {name: len(of) for name, of in values.items()}
    if len(values) < len(names) or len({*counts.values()}) > 1:
        said = " and ".join(f"{name} has {count}" for name, count in counts.items())
        raise ValueError(f"grid: {said} values; allowed are different names with as many each")
    # A single value is set as by hand, and then gives the same numbers to the last bit.
    static = counts[names[0]] == 1 or any(
        name == TRIALS or kind_at(*_in(name, objects))[0] == "static" or any(v is None for v in of)
        for name, of in values.items()
    )
    if not static:
        values = {name: _leaf(name, of, objects) for name, of in values.items()}
    labels, times = np.unique(labels_along(values[names[0]]), return_counts=True)
    if times.max() > 1:
        said = f"{labels[times.argmax()]} {times.max()} times"
        raise ValueError(f"grid: {names[0]} has {said}; allowed are different values")
    units = {name: "" if name == TRIALS else unit_at(*_in(name, objects)) for name in names}
    return Axis(values, units, static)


def _axis_of_wholes(name: str, given: Mapping[Value, Value], objects: Mapping[str, Tree]) -> Axis:
    _need_some(name, given)
    if name in _TAKEN or not re.fullmatch(r"[\w -]+", name):
        raise ValueError(f"grid: {brief(name)} cannot be the name of a dimension; choose another")
    for label, of in given.items():
        has = getattr(of, "schemes", None)
        if not isinstance(has, Mapping) or not {*objects} - _OTHERS <= {*has}:
            raise ValueError(
                f"grid: {name} = {brief(label)}: {brief(of)}; allowed is what has a machine, a "
                "task and the schemes of the sweep, such as a scenario"
            )
    return Axis({name: [_Whole(str(x), of) for x, of in given.items()]}, {name: ""}, True)


def _canonical(name: str, objects: Mapping[str, Tree]) -> str:
    """The name with its owner before it; raises ValueError for one that is not there."""
    if name == TRIALS:
        return name
    owner, path = owner_of(name, objects)
    try:
        get_at(objects[owner], path)
        if kind_at(objects[owner], path)[0] != "child":
            return f"{owner}.{path}"
        need_leaf("grid", objects[owner], path)
    except KeyError:
        pass
    known = [TRIALS, *(f"{of}.{at}" for of, tree in objects.items() for at in settable(tree))]
    raise ValueError(f"grid: {name!r} cannot be an axis; {known_names(name, known)}")


def _in(name: str, objects: Mapping[str, Tree]) -> tuple[Tree, str]:
    """The object and the path within it."""
    owner, _, path = name.partition(".")
    return objects[owner], path


def _parts(given: Value, names: list[str]) -> list[Value]:
    """The values of each of several names, which may be the same for all."""
    if isinstance(given, str):
        parts = given.split("/")
    else:
        nested = isinstance(given, list | tuple) and len(given) == len(names) > 1
        own = nested and all(isinstance(of, str | list | tuple | np.ndarray) for of in given)
        if own and all(isinstance(of, str) and not {*",:"} & {*of} for of in given):
            raise ValueError(
                f"grid: {' / '.join(names)} = {brief(given)} may be a value of each name or values "
                f"of all; allowed are a list for each name, or the text {'/'.join(given)!r} or "
                f"{','.join(given)!r}"
            )
        parts = list(given) if own else [given]
    if len(parts) not in (1, len(names)):
        raise ValueError(
            f"grid: {' / '.join(names)} has values for {len(parts)} names; allowed is one part for "
            f"all of them, or {len(names)} with / between them"
        )
    return parts if len(parts) == len(names) else parts * len(names)


def _values(name: str, given: Value, objects: Mapping[str, Tree]) -> Values:
    """The values of a name, converted to its type; raises ValueError naming them."""
    if isinstance(given, str):
        text = _RANGE.fullmatch(given.strip())
        if text is None and ":" in given:
            raise ValueError(f"grid: {name} = {brief(given)} is not {WAYS}")
        texts = [] if text else [one for one in _COMMA.split(given) if one.strip()]
        given = _spread(name, *text.groups()) if text else texts
    elif not isinstance(given, list | tuple) and np.ndim(given) == 0:
        given = [given]
    _need_some(name, given)
    many = isinstance(given, np.ndarray) and name != TRIALS
    if many and kind_at(*_in(name, objects))[0] == "leaf":
        return given
    return [_one(name, value, objects) for value in given]


def _spread(name: str, low: str, high: str, count: str, log: str | None) -> np.ndarray:
    """The values of a range that is written as text."""
    try:
        ends = float(low), float(high)
    except ValueError:
        raise ValueError(f"grid: {name} = {low}:{high}:{count} is not {WAYS}") from None
    allowed = "(0, inf)" if log else "(-inf, inf)"
    for what, end in zip(("the low end", "the high end"), ends, strict=True):
        require("grid", f"{name}, {what}", end, allowed)
    check_size(f"grid: {name}", OF_A_VALUE, values=int(count))
    return (np.geomspace if log else np.linspace)(*ends, int(count))


def _one(name: str, value: Value, objects: Mapping[str, Tree]) -> Value:
    """One value of a name, of the type of its field where it is text or a number of NumPy."""
    if isinstance(value, np.generic):
        value = value.item()
    if name == TRIALS:
        with suppress(ValueError, TypeError, OverflowError):
            whole = not isinstance(value, bool) and float(value).is_integer()
            value = int(float(value)) if whole else value
        require("grid", name, value, "[1, inf)", whole=True)
        return value
    tree, path = _in(name, objects)
    value = read_at(tree, path, value.strip() if isinstance(value, str) else value, f"grid: {name}")
    kind, annotation = kind_at(tree, path)
    if kind == "static" and isinstance(value, float) and not fits(value, annotation):
        value = int(value) if value.is_integer() else value
    return tuple(value) if kind == "static" and isinstance(value, list) else value


def _leaf(name: str, values: Values, objects: Mapping[str, Tree]) -> np.ndarray:
    """The values of a leaf as an array; raises ValueError for one that the leaf cannot have."""
    tree, path = _in(name, objects)
    now = get_at(tree, path)
    found, shape = as_numbers(values), () if now is None else np.shape(now)
    if found is None:
        raise ValueError(f"grid: {name} = {brief(values)} are not numbers")
    if found.shape[1:] != shape:
        raise ValueError(
            f"grid: {name} has shape {shape}, and its values {found.shape[1:]}; allowed are values "
            f"of that shape, or one element, say {name}{'[0]' * len(shape)}"
        )
    allowed = interval_at(tree, path) or Interval.parse("(-inf, inf)")
    if not allowed.contains(found):
        wrong = next(value for value in found if not allowed.contains(value))
        raise ValueError(f"grid: {name} = {outside(wrong, allowed)}")
    return found


def labels_along(values: Values) -> np.ndarray:
    """The values of an axis as a coordinate: numbers, whole numbers, truths, or text for others."""
    plain = isinstance(values, np.ndarray) and values.ndim == 1
    if plain or any(all(type(v) is kind for v in values) for kind in (int, float, bool)):
        return np.array(values)
    texts = [_text(value, "g") for value in values]
    equal = len({*texts}) < len(texts)
    return np.array([_text(value, ".15g") for value in values] if equal else texts)


def _text(value: Value, digits: str) -> str:
    if isinstance(value, _Whole):
        return value.label
    if value is None or isinstance(value, str):
        return value or "none"
    numbers = np.ravel(value).tolist()
    return " ".join(f"{x:{digits}}" if isinstance(x, float) else str(x) for x in numbers)


def _need_some(name: str, values: Sized) -> None:
    if not len(values):
        raise ValueError(f"grid: {name} has no values; needed is one at least")


def _overlap(one: str, other: str) -> bool:
    """Whether two paths name one leaf, or one of them a part of the other."""
    first, second = (path.replace("[", ".") for path in (one, other))
    return f"{first}.".startswith(f"{second}.") or f"{second}.".startswith(f"{first}.")


def _same_shape(name: str, task: Task, other: Task) -> None:
    """Raises ValueError for a task whose results have other dimensions or another unit."""
    for what in ("N", "outputs", "inputs", "dt", "unit", "input_unit", "labels"):
        here, there = getattr(task, what), getattr(other, what)
        if here != there:
            raise ValueError(
                f"grid: {name} has a task with {what} = {there}, and the sweep one with {here}; a "
                "dataset needs one for all"
            )


def _named(function: Callable[..., T], *arguments: Value, said: str = "grid") -> T:
    """The result of a function; its ValueError is raised as one of the grid, or what is said."""
    try:
        return function(*arguments)
    except ValueError as error:
        raise ValueError(f"{said}: {error}") from None
