"""A user's own machine from a TOML or JSON file: plant, limits, task, schemes and uncertainty, as a
`Scenario`.

    trials = 20                              # all keys before the first table are optional: name,
    title, trials, tolerance,
                                             # shown_unit, shown_scale, show_trials
    [plant]
    kind = "transfer_function"               # or zeros_poles_gain, state_space, identified, or a
    class of jaxilc.plants num = [4000.0]
    den = [1.0, 80.0, 4000.0]                # dt = 0.001 for one in z; none, in s

    [machine.actuator]                       # limit, rate, resolution
    limit = 10.0
    [machine.sensor]                         # resolution, noise
    resolution = 1e-4
    [machine.disturbance]                    # input_noise, output_noise
    input_noise = 1e-3

    [task]                                   # dt, unit, input_unit, settle, inputs
    dt = 0.001
    unit = "mm"
    input_unit = "V"
    [task.reference]                         # a function of jaxilc.references with its parameters,
    or csv = FILE and column = NAME;
    function = "sinusoid"                    # [[task.reference]] for each of several outputs
    amplitude = 1.0
    frequency = 0.5
    duration = 2.0

    [schemes.ilc]                            # class = any of jaxilc.schemes; its fields, its parts
    as tables class = "WithFeedback"
    learning = { class = "PIDType", gamma_p = 0.5, lead = 2 }
    feedback = { class = "PID", kp = 1.0 }

    [uncertainty]                            # distribution = uniform (low, high), normal (mean,
    std) or log_uniform (low, high) "plant.B" = { distribution = "uniform", low = 0.9, high = 1.1,
    relative = true }

Paths are relative to the file. A key that means nothing is refused, with those that are allowed.
"""

from __future__ import annotations

import dataclasses
import functools
import re
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.signal import BadCoefficients

from .. import identification, plants, scenarios
from ..identification.records import read_record
from ..learning.machine import Actuator, Disturbance, Machine, Sensor
from ..learning.over_trials import check
from ..plants import Plant, from_control
from ..pytree.ranges import brief, require
from ..signals import references
from ..signals.task import Task
from ..storage.reading import PARSERS, read_tree
from ..uncertainty import LogUniform, Normal, Uniform
from ..uncertainty import check as check_uncertainty
from . import Scenario
from .specification import (
    Table,
    built,
    called,
    classes,
    flag,
    list_of,
    list_of_numbers,
    number,
    numbers,
    one_of,
    scheme,
    text,
    whole,
)

REFERENCES = ("sinusoid", "multisine", "chirp", "s_curve", "noncircular")
DISTRIBUTIONS = {"uniform": Uniform, "normal": Normal, "log_uniform": LogUniform}


def load_scenario(name: str | Path, settings: Mapping[str, object] | None = None) -> Scenario:
    """A scenario by its name, or from a TOML or JSON file.

    settings: options of a scenario and paths within it, as `--set` takes them; values may be text
    Raises ValueError naming the scenarios there are, what can be set, or the file's key that is
    wrong and what is allowed.
    """
    settings = dict(settings or {})
    if str(name) in scenarios.SCENARIOS:
        known = scenarios.options(str(name))
        chosen = scenarios.load(
            str(name), **{path: settings.pop(path) for path in list(settings) if path in known}
        )
    elif Path(name).suffix in PARSERS:
        chosen = read_scenario(name)
    else:
        allowed = ", ".join(scenarios.SCENARIOS)
        raise ValueError(
            f"scenario = {brief(str(name))} is not one of {allowed}, nor a file {' or '.join(PARSERS)}"
        )
    return chosen.with_values(settings)


def read_scenario(path: str | Path) -> Scenario:
    """The scenario that a file describes, see the module. Raises FileNotFoundError, and ValueError
    naming the key that is wrong.

    Its name, if it gives none, is that of the file, with dashes for what a name cannot have.
    """
    path = Path(path)
    file = Table(read_tree(path), f"{path}:")
    stem = re.sub(r"[^\w .+()-]", "-", path.stem).lstrip(" _-.+()")[:50].strip() or "plant"
    notes: list[str] = []
    plant = file.take("plant", lambda v, at: _plant(v, at, path.parent, notes))
    task = file.take("task", lambda v, at: _task(v, at, path.parent, plant))
    machine = file.take("machine", lambda v, at: _machine(v, at, plant), Machine(plant))
    found = file.take(
        "schemes",
        lambda v, at: {
            n: scheme(s, f"{at}.{n}", plant, task.dt) for n, s in Table(v, at).values.items()
        },
        {},
    )
    uncertainty = file.take("uncertainty", lambda v, at: dict(_uncertainty(v, at)), {})
    given: dict[str, Any] = {
        "name": file.take("name", text, stem),
        "title": file.take("title", text, f"{stem}: {type(plant).__name__}"),
        "trials": file.take("trials", whole, 20),
        "tolerance": file.take("tolerance", number, 1.0),
        "shown_unit": file.take("shown_unit", text, task.unit),
        "shown_scale": file.take("shown_scale", number, 1.0),
        "show_trials": tuple(file.take("show_trials", list_of(whole), [])),
    }
    file.done()
    for name, allowed in (
        ("trials", "[1, inf)"),
        ("tolerance", "(0, inf)"),
        ("shown_scale", "(0, inf)"),
        ("show_trials", "[1, inf)"),
    ):
        _check(
            path,
            "",
            lambda name=name, allowed=allowed: require(
                "", name, given[name], allowed, many=name == "show_trials"
            ),
        )
    parts: dict[str, Any] = {
        "machine": machine,
        "task": task,
        "schemes": found,
        "uncertainty": uncertainty,
    }
    made = _check(path, "", lambda: Scenario(**given, **parts, chosen=tuple(notes)))
    _check(path, "machine", lambda: machine.check(task))
    _check(path, "uncertainty", lambda: check_uncertainty(machine, uncertainty))
    for name, one in found.items():
        _check(path, f"schemes.{name}", lambda one=one: check(machine, one, task))
    return made


def _check(path: Path, where: str, check: Callable[[], Any]) -> Any:
    try:
        return check()
    except ValueError as error:
        raise ValueError(
            ": ".join(part for part in (str(path), where, str(error).removeprefix(": ")) if part)
        ) from None


# Plants
# --------------------------------------------------------------------------------------------------


def _plant(values: Any, where: str, folder: Path, notes: list[str]) -> Plant:
    table = Table(values, where)
    kinds = {
        "transfer_function": _transfer_function,
        "zeros_poles_gain": _zeros_poles_gain,
        "state_space": _state_space,
    }
    named = sorted(name for name, c in classes().items() if issubclass(c, Plant))
    kind = table.take("kind", one_of((*kinds, "identified", *named)))
    if kind == "identified":
        return _identified(table, folder, notes)
    if kind in kinds:
        allow_unstable = table.take("allow_unstable", flag, False)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error", BadCoefficients)
                return from_control(kinds[kind](table), allow_unstable=allow_unstable)
        except (ValueError, BadCoefficients) as error:
            said = str(error).removeprefix("from_control: ")
            raise ValueError(said if where in said else f"{where}: {said}") from None
    return built(
        {key: value for key, value in table.values.items() if key != "kind"},
        where,
        cls=getattr(plants, kind),
    )


def _transfer_function(table: Table):
    """Descending powers of s, or of z with dt; num and den of several channels are lists
    [output][input] of lists.
    """
    import control

    def polynomial(value, where):
        several = isinstance(value, list) and value and isinstance(value[0], list)
        if several:
            return list_of(list_of(list_of_numbers))(value, where)
        coefficients = np.atleast_1d(numbers(value, where))
        if coefficients.ndim != 1 or not coefficients.size:
            raise ValueError(f"{where} = {brief(value)} is not a list of coefficients")
        return coefficients

    num, den, dt = (
        table.take("num", polynomial),
        table.take("den", polynomial),
        table.take("dt", _sample_time, 0.0),
    )
    table.done()
    try:
        return control.tf(num, den, dt)
    except (TypeError, IndexError) as error:
        raise ValueError(f"{table.where}: num and den do not fit: {error}") from None


def _zeros_poles_gain(table: Table):
    """gain prod (s - zeros) / prod (s - poles); complex ones as [re, im], with their conjugates. A
    chain of sections of second order, since the coefficients of one polynomial lose the digits of
    poles that lie close together.
    """
    import control
    from scipy.signal import zpk2sos

    zeros, poles = (table.take(key, list_of(_root), []) for key in ("zeros", "poles"))
    gain, dt = table.take("gain", number), table.take("dt", _sample_time, 0.0)
    table.done()
    if len(zeros) >= len(poles):
        raise ValueError(
            f"{table.where}: {len(zeros)} zeros over {len(poles)} poles; allowed are fewer zeros than poles"
        )
    try:
        sections = zpk2sos(
            zeros, poles, gain, analog=True
        )  # so that it takes z, too, for a variable like any other
    except ValueError as error:
        raise ValueError(f"{table.where}: {error}") from None
    chain = [
        control.ss(control.tf(np.trim_zeros(row[:3], "f"), np.trim_zeros(row[3:], "f"), dt))
        for row in sections
    ]
    return functools.reduce(lambda system, section: section * system, chain)


def _sample_time(value: Any, where: str) -> float:
    dt = number(value, where)
    if dt < 0:
        raise ValueError(
            f"{where} = {dt:g} is outside its allowed range [0, inf), 0 for continuous time"
        )
    return dt


def _root(value: Any, where: str) -> complex:
    parts = np.atleast_1d(numbers(value, where))
    if parts.shape not in ((1,), (2,)):
        raise ValueError(f"{where} = {value!r} is not a number or a pair [re, im]")
    return complex(*parts)


def _state_space(table: Table):
    import control

    A, B, C = (np.atleast_2d(table.take(key, numbers)) for key in ("A", "B", "C"))
    n, dt = len(A), table.take("dt", _sample_time, 0.0)
    D = table.take("D", numbers, None)
    table.done()
    if A.shape != (n, n) or B.ndim != 2 or C.ndim != 2 or B.shape[0] != n or C.shape[1] != n:
        raise ValueError(
            f"{table.where}: A {A.shape}, B {B.shape}, C {C.shape} do not fit; allowed are (n, n), (n, n_u), (n_y, n)"
        )
    D = np.zeros((len(C), B.shape[1])) if D is None else np.atleast_2d(D)
    if D.shape != (len(C), B.shape[1]):
        raise ValueError(f"{table.where}: D has shape {D.shape}; allowed is {(len(C), B.shape[1])}")
    return control.ss(A, B, C, D, dt)


def _identified(table: Table, folder: Path, notes: list[str]) -> Plant:
    """A ProcessModel fitted to a record; keys as the options of `jaxilc identify`."""
    record = folder / table.take("record", text)
    columns = {
        key: table.take(key, text, default)
        for key, default in (("time", "t"), ("input", "u"), ("output", "y"))
    }
    structure = {key: table.take(key, whole, 1) for key in ("poles", "pairs", "zeros")}
    table.done()
    found = identification.identify(read_record(record, **columns), **structure)
    values = ", ".join(
        f"{name} = {estimate.value:.6g}" for name, estimate in found.parameters.items()
    )
    notes.append(
        f"the plant was identified from {record.name}: {values}; fit {float(np.min(found.fit)):.4g} %"
    )
    return found.plant


# Machine, task, uncertainty
# -----------------------------------------------------------------------------------------------


def _machine(values: Any, where: str, plant: Plant) -> Machine:
    table = Table(values, where)
    parts = {"actuator": Actuator, "sensor": Sensor, "disturbance": Disturbance}
    made = {
        key: table.take(key, lambda v, at, cls=cls: built(v, at, cls=cls), None)
        for key, cls in parts.items()
    }
    table.done()
    return Machine(plant, **made)


def _task(values: Any, where: str, folder: Path, plant: Plant) -> Task:
    table = Table(values, where)
    dt = table.take("dt", number)
    if not dt > 0:
        raise ValueError(f"{table.at('dt')} = {dt:g} is outside its allowed range (0, inf)")

    def reference(value, at):
        each = value if isinstance(value, list) else [value]
        columns = [
            _reference(v, f"{at}[{i}]" if isinstance(value, list) else at, folder, dt)
            for i, v in enumerate(each)
        ]
        if len({len(column) for column in columns}) > 1:
            raise ValueError(
                f"{at}: the outputs have {', '.join(str(len(c)) for c in columns)} samples; allowed is one length"
            )
        return np.stack(columns, axis=1)

    fields = {
        "reference": table.take("reference", reference),
        "settle": table.take("settle", lambda v, at: tuple(list_of(number)(v, at)), None),
        "inputs": table.take("inputs", whole, plant.n_u),
        "unit": table.take("unit", text, ""),
        "input_unit": table.take("input_unit", text, ""),
    }
    table.done()
    if fields["settle"] is not None and len(fields["settle"]) != 2:
        raise ValueError(
            f"{table.at('settle')} = {list(fields['settle'])} is not a pair [start, stop]"
        )
    try:
        return Task(**fields, dt=dt)
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from None


def _reference(value: Any, where: str, folder: Path, dt: float) -> np.ndarray:
    """(N+1,) from a function of `references`, or a column of a text file with a header."""
    table = Table(value, where)
    if "csv" not in table:
        function = table.take("function", one_of(REFERENCES))
        return np.asarray(called(getattr(references, function), table, dt=dt))
    path, column = folder / table.take("csv", text), table.take("column", text, "r")
    time = table.take("time", text, "t")
    table.done()
    record = read_record(path, time=time, input=column, output=column)
    if abs(record.dt / dt - 1) > 1e-6:
        raise ValueError(
            f"{where}: {path} is sampled at {record.dt:g} s but the task at {dt:g} s; nothing is resampled"
        )
    return np.asarray(record.y)[:, 0]


def _uncertainty(values: Any, where: str):
    """Names and distributions; a name may be one key, "plant.B", or tables within tables."""
    table = Table(values, where)
    for name in table.values:
        below = Table(table.values[name], table.at(name))
        if "distribution" not in below:
            yield from (
                (f"{name}.{rest}", one) for rest, one in _uncertainty(below.values, below.where)
            )
            continue
        cls = DISTRIBUTIONS[below.take("distribution", one_of(DISTRIBUTIONS))]
        fields = {
            f.name: below.take(f.name, number)
            for f in dataclasses.fields(cls)
            if f.name != "relative"
        }
        fields["relative"] = below.take("relative", flag, False)
        below.done()
        try:
            yield name, cls(**fields)
        except ValueError as error:
            raise ValueError(f"{below.where}: {error}") from None
