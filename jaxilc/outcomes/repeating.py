"""`potential`: what learning can gain, from repeats of a motion."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from .. import figures
from ..identification.potential import LEVEL, Potential, potential_of
from ..identification.repeats import Repeats
from ..pytree.aliases import Value
from ..scenarios.design_file import write_potential
from ..storage.printable import printable
from .outcome import Figure, Numbers, Outcome, Progress, Table, Verdict, silent
from .recurring import recurs, repeats_in, within_numbers, within_trial
from .words import number, sized

FEW = 4  # trials, from which on a drift can be told from what is new
SURE = 1.5  # end of an interval over its estimate, from which on more trials are asked for
USUAL = {"error": "e", "output": "y", "reference": "r", "time": "t"}
OF_DENSITY = (
    "What repeats, which learning can remove, and what is new in each trial, which no law can."
)


def potential(
    records: str | Path | Sequence[str | Path],
    *,
    into: str | Path | None = None,
    folder: Path | None = None,
    unit: str = "",
    progress: Progress = silent,
    **reading: Value,
) -> Outcome:
    """What learning can gain, from M >= 2 repeats of a motion with the same input.

    records: files with one or several trials each, or the folder of a campaign
    into: plant file that gets a table [potential], which `design` and `next` use
    folder: for the figure; out/potential if not given
    unit: of the error, where no file tells one
    reading: how files are read, as for `identification.read_repeats`
    Raises ValueError naming what is missing in a file, and for trials that are no repeats.
    """
    paths = [Path(one) for one in ([records] if isinstance(records, str | Path) else records)]
    progress("reading")
    repeats = repeats_in(paths, **reading)
    repeats = repeats._replace(unit=printable(repeats.unit or unit))
    found = potential_of(repeats.e, repeats.dt)
    within = within_trial(repeats, found)
    kept = [] if into is None else [write_potential(into, table_of(found), repeats.unit)]
    following = _next(paths, reading | {"unit": unit}, found, into)
    shown = partial(figures.potential_figure, repeats, found)
    return Outcome(
        command="potential",
        numbers=_numbers(repeats, found) | within_numbers(within),
        verdict=Verdict(_said(repeats, found), *following),
        folder=folder or Path("out") / "potential",
        tables=[_table(repeats, found)],
        lines=[*_lines(repeats, found), *recurs(within, repeats)],
        figures={"potential": Figure(OF_DENSITY, shown, live=True)},
        live=lambda: [figures.potential_figure.described(repeats, found)],
        kept=kept,
        asked={"records": ", ".join(map(str, paths))},
    )


def table_of(found: Potential) -> dict[str, float]:
    """The numbers of a table [potential] of a plant file."""
    return {"floor": found.new.value, "stop": found.stop, "cutoff": found.cutoff.value}


# What is said
# --------------------------------------------------------------------------------------------------


def _range(of, unit: str) -> str:
    return f"{sized(of.low, unit)} to {sized(of.high, unit)}"


def _table(repeats: Repeats, found: Potential) -> Table:
    M, unit = found.trials, repeats.unit
    size, cutoff = partial(sized, unit=unit), found.cutoff
    band = f"{number(cutoff.low)} to {number(cutoff.high)} Hz"
    rows = [
        ("repeats: learning can remove it", size(found.repeatable.value),
         _range(found.repeatable, unit)),
        ("new in each trial: no law can", size(found.new.value), _range(found.new, unit)),
        ("of the first trial alone", size(found.start) if found.start else "", ""),
        ("drift from trial to trial", size(found.drift) if found.drift else "", ""),
        ("left with the cutoff below", size(found.left), ""),
        ("bandwidth worth learning", f"{number(cutoff.value)} Hz", band),
        ("trials to average", str(found.averages), ""),
        ("stop when a trial is below", size(found.stop), ""),
    ]  # fmt: skip
    return Table(
        "part of the error",
        right=("value", "interval"),
        title=f"{M} trials of {repeats.e.shape[1]} samples: rms values, {LEVEL:.0%}",
        rows=(row for row in rows if row[1]),
    )


def _said(repeats: Repeats, found: Potential) -> tuple[str, ...]:
    """The verdict in one sentence."""
    unit, new = repeats.unit, found.new
    if found.cutoff.value == 0:
        return (
            "Learning has nothing to gain: at no frequency does more of the error repeat than is "
            f"new in each trial, {sized(new.value, unit)} ({_range(new, unit)}).",
        )
    return (
        f"Learning can bring the error from {sized(found.repeatable.value, unit)} to "
        f"{sized(found.left, unit)} rms, a factor of "
        f"{number(found.repeatable.value / found.left)}, by what lies below "
        f"{number(found.cutoff.value)} Hz; no law leaves less than what is new in each trial, "
        f"{sized(new.value, unit)} ({_range(new, unit)}).",
    )


def _lines(repeats: Repeats, found: Potential) -> list[str]:
    """What was told apart, and what cannot be told."""
    unit, lines = repeats.unit, []
    if found.start:
        lines.append(
            f"The first trial is unlike the others, by {sized(found.start, unit)} rms, and is left "
            "out: it began elsewhere. Let the machine make the motion once before each series."
        )
    if found.drift:
        lines.append(
            f"The trials drift, by {sized(found.drift, unit)} rms from one to the next: it is not "
            "counted as new, since a law that goes on learning follows it."
        )
    if found.trials < FEW:
        lines.append(
            f"With {found.trials} trials "
            + ("a first trial that is unlike the others and " if found.trials < 3 else "")
            + f"a drift cannot be told from what is new; measure {FEW} or more."
        )
    if found.new.high > SURE * found.new.value:
        needed = max(found.trials + 1, int(np.ceil(12 / found.freedom)) + 1 + bool(found.start))
        lines.append(
            "The interval is wide, since what is new is slow: one trial tells no more than "
            f"{number(found.freedom)} independent numbers would; measure {needed} trials or more."
        )
    return lines


def _next(
    paths: Sequence[Path], reading: Mapping[str, Value], found: Potential, into: str | Path | None
) -> tuple[str, str]:
    """What to do next, in words, and the command."""
    if found.cutoff.value == 0:
        return "", ""
    if into is not None:
        what = "a law up to this bandwidth"
        return what, f"jaxilc design {shlex.quote(str(into))}"
    words = ["jaxilc", "potential", *map(str, paths)]
    for name, value in reading.items():
        given = ",".join(value) if name == "columns" else value
        if given and given != USUAL.get(name):
            words += [f"--{name}", str(given)]
    return "for `design` and `next` to use it", shlex.join([*words, "--into", "axis.toml"])


def _numbers(repeats: Repeats, found: Potential) -> Numbers:
    values: Numbers = {
        name: dict(of._asdict()) if hasattr(of, "_asdict") else of
        for name, of in found._asdict().items()
        if name != "spectrum"
    }
    spectrum = {name: np.asarray(of).tolist() for name, of in found.spectrum._asdict().items()}
    read = {"dt": repeats.dt, "unit": repeats.unit, "samples": repeats.e.shape[1]}
    about = read | {"names": list(repeats.names), "about_the_mean": found.spread(found.trials)}
    return values | about | {"spectrum": spectrum}
