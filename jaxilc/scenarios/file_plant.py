"""The plant of a TOML or JSON file: transfer function, state space, fit, or a named class."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, TypeAlias, cast

import numpy as np

from .. import identification, plants
from ..identification.frequency_response import is_frequency_response
from ..identification.record_files import is_arrays, is_twincat, read_record_file
from ..identification.sentences import verdict
from ..plants import Plant, ProcessModel, from_control
from ..plants.cnc_axis import Axes
from ..plants.from_python_control import Linear, canonical_form, from_linear
from ..plants.linear import LARGEST_ORDER
from ..pytree.aliases import Value
from ..pytree.ranges import brief
from ..storage.columns import need_unit
from ..storage.reading import LARGEST_TABLE, read_bytes, read_tree
from ..storage.sealed import as_json, checksum, seal_of, sealed, unsealed, write_json
from .specification import (
    Table,
    at_place,
    built,
    classes,
    flag,
    list_of,
    list_of_numbers,
    number,
    numbers,
    of_record,
    one_of,
    text,
    whole,
)

# A plant that is fitted once, then read from a file beside it
# --------------------------------------------------------------------------------------------------


FORMAT = 3  # of the file, and of the way in which a plant is fitted
Units: TypeAlias = tuple[str, str]  # of input and output
LEAVES = tuple(field.name for field in dataclasses.fields(ProcessModel))


class Options(NamedTuple):
    """How a record is read and fitted, as `read_record` and `identify` have it.

    reading: options of `read_record`
    structure: poles, pairs, zeros
    delay: in samples; None: 0 for a record, fitted for a frequency response
    averages: of the coherence of a frequency response
    """

    reading: dict[str, Value]
    structure: dict[str, Value]
    delay: int | None
    averages: int | None


class Fit(NamedTuple):
    """A plant that was fitted, a sentence on it, and the units of its record, "" for none."""

    plant: ProcessModel
    said: str
    units: Units = ("", "")


def identified_plant(
    record: Path, options: Options, folder: Path, wanted: Units = ("", "")
) -> tuple[ProcessModel, str]:
    """The plant, and a sentence on its fit.

    folder: where the fit is kept
    wanted: units that the task needs, "" for any
    Raises ValueError for a record in other units, and as `read_record`, `read_frequency_response`
    and `identify`, and OSError for a record that cannot be read.
    """
    plant, said, units = _kept(record, options, folder)
    for name, told, needed in zip(("input", "output"), units, wanted, strict=True):
        if told and needed:
            need_unit(record, options.reading[name], told, needed)
    return plant, said


def _kept(record: Path, options: Options, folder: Path) -> Fit:
    """The fit that is kept, or a new one."""
    asked = {"format": FORMAT, **options._asdict()}
    kept = folder / f"{record.name}.{seal_of(asked)[:8]}.fit.json"
    known = as_json({"record": checksum(read_bytes(record, LARGEST_TABLE)), "options": asked})
    with contextlib.suppress(ValueError, OSError, KeyError, TypeError):
        found = unsealed(read_tree(kept, ".json"))
        if {name: found[name] for name in known} == known:
            plant = ProcessModel(**{name: found["plant"][name] for name in LEAVES})
            said, (of_u, of_y) = f"{found['said']} (kept in {kept.name})", found["units"]
            return Fit(plant, said, (of_u, of_y))
    plant, said, units = _fitted(record, options)
    values = {name: np.asarray(getattr(plant, name)).tolist() for name in LEAVES}
    if kept.is_file() or not kept.exists():
        with contextlib.suppress(OSError):  # a folder that cannot be written
            write_json(kept, sealed({**known, "plant": values, "said": said, "units": units}))
    return Fit(plant, said, units)


def _fitted(record: Path, options: Options) -> Fit:
    """The plant, fitted to the record."""
    units: Units = ("", "")
    if is_response(record, options.reading["columns"]):
        dt = options.reading["dt"]
        if dt is None:
            raise ValueError(
                f"{record} is a frequency response: give dt, the sample time of the hold in it [s]"
            )
        found = identification.identify_response(
            identification.read_frequency_response(record, averages=options.averages),
            **options.structure,
            dt=dt,
            delay=None if options.delay is None else options.delay * dt,
        )
    else:
        read, delay = read_record_file(record, **options.reading), options.delay or 0
        units = read.input_units[0], read.output_units[0]
        found = identification.identify(read.record, **options.structure, delay=delay)
    values = ", ".join(f"{name} = {one.value:.6g}" for name, one in found.parameters.items())
    plant = cast(ProcessModel, found.plant)
    if plant.delay and "delay" not in found.parameters:
        values += f", delay = {plant.delay:.6g}"
    fit = float(np.min(found.fit))
    said = f"the plant was identified from {record.name}: {values}; fit {fit:.4g} %"
    doubts = verdict(found, options.reading["dt"])[1:]
    return Fit(plant, " ".join([f"{said}.", *doubts]) if doubts else said, units)


def is_response(record: Path, columns: Sequence[str]) -> bool:
    """Whether a file is a frequency response, which its header tells.

    columns: names of the columns of a file without a header
    """
    if is_arrays(record) or columns or is_twincat(record):
        return False
    return is_frequency_response(record)


# The table
# --------------------------------------------------------------------------------------------------


def plant_of(
    values: Value, where: str, folder: Path, notes: list[str], units: Units = ("", "")
) -> Plant:
    """The plant that a table describes.

    notes: list to which texts on the choices for the plant are appended
    units: those of the task, which a record must have, "" for any
    Raises ValueError naming the key that is wrong.
    """
    table = Table(values, where)
    kinds = {
        "transfer_function": _transfer_function,
        "zeros_poles_gain": _zeros_poles_gain,
        "state_space": _state_space,
    }
    named = sorted(name for name, c in classes().items() if issubclass(c, Plant))
    kind = table.take("kind", one_of((*kinds, "identified", *named)))
    if kind == "identified":
        return _identified(table, folder, notes, units)
    if issubclass(cls := classes().get(kind, type(None)), Axes):
        return _axes(table, cls, folder, notes, units)
    if kind in kinds:
        allow_unstable = table.take("allow_unstable", flag, False)
        try:
            with warnings.catch_warnings():
                # that of scipy.signal.BadCoefficients, whose module need not be imported
                warnings.filterwarnings("error", message="Badly conditioned filter coefficients")
                system = kinds[kind](table)
                made = from_linear if isinstance(system, Linear) else from_control
                return made(system, allow_unstable=allow_unstable)
        except (ValueError, UserWarning) as error:
            said = str(error).removeprefix("from_control: ")
            said = said.replace("pass allow_unstable=True", "write allow_unstable = true")
            raise ValueError(said if where in said else f"{where}: {said}") from None
    return built(
        {key: value for key, value in table.values.items() if key != "kind"},
        where,
        cls=getattr(plants, kind),
    )


def _axes(table: Table, cls: type[Axes], folder: Path, notes: list[str], units: Units) -> Plant:
    """Axes side by side, each with a plant table of its own, or all with the table `axis`.

    A table with `class` in place of `kind` is an object of this class.
    """

    def one(value: Value, where: str) -> Plant:
        if isinstance(value, Mapping) and "class" in value:
            return built(value, where, hint=Plant)
        return plant_of(value, where, folder, notes, units)

    names = [field.name for field in dataclasses.fields(cls)]
    shared = table.take("axis", one, None)
    axes = {name: table.take(name, one, shared) for name in names}
    table.done()
    missing = [name for name, axis in axes.items() if axis is None]
    if missing:
        raise ValueError(
            f"{table.at(missing[0])} is missing; needed is a table for each of the axes "
            f"{', '.join(names)}, or the table `axis` for all of them"
        )
    with at_place(table.where):
        return cls(**axes)


def _transfer_function(table: Table):
    """A transfer function from its coefficients of descending powers of s or, with dt, of z.

    With several channels, num and den are lists [output][input] of such lists.
    """

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
    if isinstance(num, np.ndarray) and isinstance(den, np.ndarray):
        found = canonical_form(num, den, dt)
        if found is not None:
            return found
    import control

    try:
        return control.tf(num, den, dt)
    except (TypeError, IndexError) as error:
        raise ValueError(f"{table.where}: num and den do not fit: {error}") from None


ALIKE = 1e-13  # share of a root, by which it may differ from a real one or its conjugate


def _zeros_poles_gain(table: Table):
    """A plant gain prod (s - zeros) / prod (s - poles), as a chain of sections of low order.

    Complex zeros and poles are given as [re, im], together with their conjugates. Sections are used
    because the coefficients of a single polynomial lose digits of poles that are close together.
    """
    import control

    zeros, poles = (table.take(key, list_of(_root), []) for key in ("zeros", "poles"))
    gain, dt = table.take("gain", number), table.take("dt", _sample_time, 0.0)
    table.done()
    if len(poles) > LARGEST_ORDER:
        raise ValueError(
            f"{table.at('poles')} has {len(poles)} numbers; allowed are at most {LARGEST_ORDER}"
        )
    if len(zeros) >= len(poles):
        raise ValueError(
            f"{table.where}: {len(zeros)} zeros over {len(poles)} poles; "
            "allowed are fewer zeros than poles"
        )
    sections = _sections(_parted(zeros, table.at("zeros")), _parted(poles, table.at("poles")))
    gains = [gain, *[1.0] * (len(sections) - 1)]
    chain = [
        control.ss(control.tf(one * np.poly(over).real, np.poly(under).real, dt))
        for one, (over, under) in zip(gains, sections, strict=True)
    ]
    return functools.reduce(lambda system, section: section * system, chain)


def _parted(roots: Sequence[complex], where: str) -> tuple[list[complex], list[float]]:
    """One root of each complex pair, and the real ones."""
    upper, lower = ([z for z in roots if i * z.imag > ALIKE * abs(z)] for i in (1, -1))
    for z in upper:
        match = min(lower, key=lambda other: abs(other.conjugate() - z), default=0.0)
        if abs(match.conjugate() - z) > ALIKE * abs(z):
            lower = [z]
            break
        lower.remove(match)
    if lower:
        raise ValueError(
            f"{where} has [{lower[0].real:g}, {lower[0].imag:g}] without its conjugate; allowed "
            "are real numbers, and pairs of complex ones"
        )
    return upper, [z.real for z in roots if abs(z.imag) <= ALIKE * abs(z)]


def _sections(
    zeros: tuple[list[complex], list[float]], poles: tuple[list[complex], list[float]]
) -> list[tuple[list[complex], list[complex]]]:
    """The zeros and poles of sections of first and second order, none with more zeros than poles.

    A pair of zeros is over the nearest pair of poles that is free, or else over two real poles, and
    a real zero over the nearest poles that are left. There are enough, since there are fewer zeros.

    zeros, poles: as `_parted` has them
    """
    single = list(poles[1])
    sections: list[tuple[list[complex], list[complex]]]
    sections = [([], [p, p.conjugate()]) for p in poles[0]]
    for z in zeros[0]:
        free = [one for one in sections if not one[0]]
        if free:
            over = min(free, key=lambda one: abs(one[1][0] - z))[0]
        else:
            single.sort(key=lambda p: abs(p - z))
            over = []
            sections.append((over, list(single[:2])))
            del single[:2]
        over += [z, z.conjugate()]
    sections += [([], [p]) for p in single]
    for z in zeros[1]:
        free = [one for one in sections if len(one[0]) < len(one[1])]
        min(free, key=lambda one: min(abs(p - z) for p in one[1]))[0].append(z)
    return sections


def _sample_time(value: Value, where: str) -> float:
    return number(value, where, allowed="[0, inf)", note=", 0 for continuous time")


def _root(value: Value, where: str) -> complex:
    parts = np.atleast_1d(numbers(value, where))
    if parts.shape not in ((1,), (2,)):
        raise ValueError(f"{where} = {value!r} is not a number or a pair [re, im]")
    return complex(*parts)


def _state_space(table: Table) -> Linear:
    A, B, C = (np.atleast_2d(table.take(key, numbers)) for key in ("A", "B", "C"))
    n, dt = len(A), table.take("dt", _sample_time, 0.0)
    D = table.take("D", numbers, None)
    table.done()
    if A.shape != (n, n) or B.ndim != 2 or C.ndim != 2 or B.shape[0] != n or C.shape[1] != n:
        raise ValueError(
            f"{table.where}: A {A.shape}, B {B.shape}, C {C.shape} do not fit; "
            "allowed are (n, n), (n, n_u), (n_y, n)"
        )
    D = np.zeros((len(C), B.shape[1])) if D is None else np.atleast_2d(D)
    if D.shape != (len(C), B.shape[1]):
        raise ValueError(f"{table.where}: D has shape {D.shape}; allowed is {(len(C), B.shape[1])}")
    return Linear(A, B, C, D, dt)


def _identified(table: Table, folder: Path, notes: list[str], units: Units) -> Plant:
    """A ProcessModel fitted to a record; the keys are the options of `jaxilc identify`."""
    record = folder / table.take("record", text)
    reading: dict[str, Value] = {
        key: table.take(key, text, default)
        for key, default in (("time", "t"), ("input", "u"), ("output", "y"), ("time_unit", None))
    }
    reading["columns"] = table.take("columns", list_of(text), [])
    reading |= {key: table.take(key, number, None) for key in ("dt", "resample")}
    structure = {key: table.take(key, whole, 1) for key in ("poles", "pairs", "zeros")}
    delay, averages = (table.take(key, whole, None) for key in ("delay", "averages"))
    table.done()
    options = Options(reading, structure, delay, averages)
    try:
        plant, said = identified_plant(record, options, folder, units)
    except ValueError as error:
        raise ValueError(f"{table.where}: {of_record(error)}") from None
    notes.append(said)
    return plant
