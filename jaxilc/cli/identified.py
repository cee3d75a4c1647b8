"""The fits behind `jaxilc identify`: of a record in time, and of a frequency response."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Any, NamedTuple

from .console import out
from .tables import identification_table, orders_table


class Asked(NamedTuple):
    """What was asked for.

    structure: poles, pairs and zeros; empty: chosen by a table
    delay: dead time in samples; None: chosen, or none
    dt: sample time [s]
    averages: number of averages of a coherence
    reading: further options of `read_record_file`
    """

    structure: dict[str, Any]
    delay: int | None
    dt: float | None
    averages: int | None
    reading: dict[str, Any]

    def options(self) -> str:
        """The options on reading as they are typed, each after a blank."""
        reading = self.reading
        usual = {"time": "t", "input": "u", "output": "y"}
        given = {name: of for name, of in reading.items() if of and of != usual.get(name)}
        given |= {"columns": ",".join(reading["columns"])} if reading["columns"] else {}
        given |= {"dt": self.dt, "averages": self.averages}
        return "".join(
            f" --{name.replace('_', '-')} {shlex.quote(format(of))}"
            for name, of in given.items()
            if of is not None
        )


class Fitted(NamedTuple):
    """What was found.

    measured: the record or the response
    found: the identification
    dt: sample time [s], None where it is not known
    tables: tables that were printed
    axes: figures by the name of their file
    units: units of input and output
    structure: the structure that was fitted, with the delay where it is whole
    """

    measured: Any
    found: Any
    dt: float | None
    tables: list
    axes: dict[str, Any]
    units: tuple[str, str]
    structure: dict[str, Any]


def of_record(path: Path, asked: Asked) -> Fitted:
    """The fit to a record, after the table of orders where the structure is to be chosen."""
    from .. import figures, identification
    from ..identification.record_files import read_record_file
    from ..identification.resampling import RESAMPLED
    from ..plants import ProcessModel

    if asked.averages is not None:
        raise ValueError(f"--averages {asked.averages} is for a frequency response; {path} is none")
    read = read_record_file(path, dt=asked.dt, **asked.reading)
    if asked.reading["resample"] is not None:
        out.print(RESAMPLED.format(dt=asked.reading["resample"]), highlight=False)
    record, tables, structure, delay = read.record, [], asked.structure, asked.delay or 0
    if not structure:
        if asked.delay is None:
            orders = identification.orders_and_delays(record)
        else:
            orders = identification.compare_orders(record, delay=delay)
        best = identification.best_order(orders)
        structure, delay = _structure(best), best.delay
        tables.append(orders_table(orders, best, record.dt))
        out.print(tables[0])
    found = identification.identify(record, **structure, delay=delay)
    tables.append(_printed(path, found))
    units = (read.input_units[0], read.output_units[0])
    axes = {
        "record.png": figures.record_figure(record, input_unit=units[0], output_unit=units[1]),
        "validation.png": figures.validation_figure(
            record, found, output_unit=units[1], unit=units[1]
        ),
    }
    if isinstance(found.plant, ProcessModel) and found.plant.n_u == found.plant.n_y == 1:
        axes["response.png"] = figures.response_figure(
            found, record.dt, input_unit=units[0], output_unit=units[1]
        )
    structure = structure | {"delay": delay} if delay else structure
    return Fitted(record, found, record.dt, tables, axes, units, structure)


def of_response(path: Path, asked: Asked) -> Fitted:
    """The fit to a frequency response, after the table of orders as for a record."""
    from .. import figures, identification

    for name, value in asked.reading.items():
        if name in ("time_unit", "columns", "resample") and value:
            option = name.replace("_", "-")
            raise ValueError(f"--{option} is for a record in time; {path} is a frequency response")
    if asked.delay is not None and asked.dt is None:
        raise ValueError(f"--delay {asked.delay} counts samples of a response: give --dt, too")
    measured = identification.read_frequency_response(path, averages=asked.averages)
    fixed = None if asked.delay is None else asked.delay * (asked.dt or 0.0)
    tables, structure = [], asked.structure
    if not structure:
        orders = identification.compare_response_orders(measured, dt=asked.dt, delay=fixed)
        best = identification.best_order(orders)
        structure = _structure(best)
        tables.append(orders_table(orders, best, asked.dt))
        out.print(tables[0])
    found = identification.identify_response(measured, **structure, dt=asked.dt, delay=fixed)
    tables.append(_printed(path, found))
    axes = {"response.png": figures.response_fit_figure(measured, found)}
    structure = structure if asked.delay is None else structure | {"delay": asked.delay}
    return Fitted(measured, found, asked.dt, tables, axes, ("", ""), structure)


def _structure(best) -> dict[str, Any]:
    return {"poles": best.poles, "pairs": best.pairs, "zeros": best.zeros}


def _printed(path: Path, found):
    table = identification_table(str(path), found.summary())
    out.print(table)
    return table
