"""Parameter files in JSON: the values found for the schemes of a scenario, and how they were found.

{"scenario": "cao-2019", "schemes": {"cfdl-mfailc": {"lam": 0.003, "lead": 3}},
 "versions": {...}, "obtained": {...}}
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from ..pytree.aliases import Value
from ..pytree.closest import first_of, need_known
from ..pytree.named_paths import settable
from ..pytree.ranges import brief
from ..runtime.provenance import describe, differences, environment
from ..schemes import Scheme
from ..storage.sealed import as_json, read_json, write_json
from . import Scenario
from .specification import at_place


def differing(scheme: Scheme, printed: Scheme) -> dict[str, Value]:
    """Leaves and static fields of a scheme that differ from another scheme, by path, as JSON.

    A leaf that the other scheme does not have is included, so that values set by hand before tuning
    are not lost.
    """
    before, now = settable(printed), settable(scheme)
    changed = {
        path: value
        for path, value in now.items()
        if path not in before or not same(value, before[path])
    }
    return {path: plain(value) for path, value in changed.items()}


def write_parameters(
    path: Path,
    scenario: str,
    schemes: Mapping[str, Mapping[str, Value]],
    obtained: Mapping[str, object],
) -> Path:
    """Write a parameter file.

    scenario: name of the scenario
    schemes: values by the scheme's name and the path within it
    obtained: how the values were found, as JSON
    """
    versions = environment()["versions"]
    found = {"scenario": scenario, "schemes": schemes, "versions": versions, "obtained": obtained}
    write_json(path, found)
    return path


def with_parameters(scenario: Scenario, path: Path, asked: Sequence[str] = ()) -> Scenario:
    """The scenario with the values of a parameter file.

    asked: names of the schemes that are used, all if empty
    Raises ValueError for a file that is not a parameter file, is of another scenario, has none of
    the schemes asked for, or names what cannot be set, and FileNotFoundError for a file that does
    not exist.
    """
    try:
        content = read_json(path)
        name, schemes = content["scenario"], content["schemes"]
        values = {
            f"{scheme}.{leaf}": value
            for scheme, of in schemes.items()
            for leaf, value in of.items()
        }
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        why = f" ({str(error).removeprefix(f'{path}: ')})" if isinstance(error, ValueError) else ""
        raise ValueError(
            f"{path} is not a parameter file: it needs `scenario` and `schemes`, as `jaxilc tune` "
            f"writes them{why}"
        ) from None
    if name != scenario.name:
        raise ValueError(f"{path} has parameters of {brief(name)}, not of {scenario.name!r}")
    for scheme in schemes:
        need_known(f"{path}: scheme = {brief(scheme)}", scheme, scenario.schemes)
    used = asked or scenario.schemes
    if not {*used} & {*schemes}:
        has = f"parameters of {', '.join(schemes)}, and " if schemes else ""
        raise ValueError(f"{path} has {has}none of {', '.join(used)}")
    with at_place(path):
        return scenario.with_values(values)


def warn_of_another(scenario: Scenario, path: Path, settings: Iterable[str] = ()) -> None:
    """Warn of parameters that were found for other options, or for a machine with other numbers.

    settings: paths that were set, whose numbers are known to be others
    """
    obtained = read_json(path).get("obtained")
    there = obtained if isinstance(obtained, Mapping) else {}
    made = there.get("configuration")
    machine = made.get("machine") if isinstance(made, Mapping) else None
    given = {path.removeprefix("machine.").partition("[")[0] for path in settings}
    here = as_json(describe(scenario.machine))
    lines = [
        line
        for then, now in ((there.get("options"), dict(scenario.options)), (machine, here))
        if isinstance(then, Mapping)
        for line in differences(then, now, besides=given)
    ]
    if lines:
        said = f"{path} was found for another machine: {first_of(lines, between='; ')}"
        warnings.warn(said, RuntimeWarning, stacklevel=3)


def same(one: Value, other: Value) -> bool:
    """Whether two values of a field are the same text, the same object, or equal numbers."""
    if one is None or other is None or isinstance(one, str) or isinstance(other, str):
        return one is other or (isinstance(one, str) and one == other)
    return np.shape(one) == np.shape(other) and bool(np.all(np.asarray(one) == np.asarray(other)))


def plain(value: Value) -> Value:
    """A value of a field as JSON: a number, text, a list or None."""
    if value is None or isinstance(value, str | bool | int):
        return value
    return list(value) if isinstance(value, tuple) else np.asarray(value).tolist()
