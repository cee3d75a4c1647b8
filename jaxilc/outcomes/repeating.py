"""What repeats from trial to trial, from records: of `potential` and `design`.

Learning can gain what repeats. An error that repeats from trial to trial is learned between trials.
One that repeats in a period is learned by `RepetitiveControl` without a stop, by the taps that were
found safe between trials: its condition is nearly theirs. One that repeats in the position is
learned as a map over it.
"""

from __future__ import annotations

import dataclasses
import shlex
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from .. import figures
from ..hardware.campaign import repeats_of
from ..identification.pitch import Recurrence, recurrence_of
from ..identification.potential import LEVEL, Potential, potential_of
from ..identification.record_files import Repeats, read_repeats
from ..plants import Harmonics, StateSpace
from ..pytree.aliases import Value
from ..scenarios import Scenario
from ..scenarios.campaigns import Given, open_campaign
from ..scenarios.design_file import write_potential
from ..schemes import (
    BasisFunctions,
    JoinedBasis,
    LearningFilter,
    PolynomialBasis,
    PositionBasis,
    RepetitiveControl,
    Scheme,
    WithFeedback,
)
from ..storage.reading import printable
from ..theory.condition import HOLDS
from ..theory.law import Taps, law_of
from ..theory.linearity import alike_trials
from ..theory.loop import linear_loop, minimal
from ..theory.visits import visits
from ..uncertainty import Population
from .certifying import of_periods, period_sentences
from .outcome import Figure, Numbers, Outcome, Progress, Table, Verdict, silent
from .words import number, sized

FEW = 4  # trials, from which on a drift can be told from what is new
SURE = 1.5  # end of an interval over its estimate, from which on more trials are asked for
USUAL = {"error": "e", "output": "y", "reference": "r", "time": "t"}
OF_DENSITY = (
    "What repeats, which learning can remove, and what is new in each trial, which no law can."
)
ORDERS = 1, 2, 3  # of the pitch
MACHINES = 17  # on which repetitive control is judged
LEAST = 1e-6  # share of the largest tap that is left out
PERIODIC, BY_PLACE = "repetitive", "by-position"  # names of the schemes that are offered


def potential(
    records: str | Path | Sequence[str | Path],
    *,
    into: str | Path | None = None,
    folder: str | Path | None = None,
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
        folder=Path(folder or "out/potential"),
        tables=[_table(repeats, found)],
        lines=[*_lines(repeats, found), *recurs(within, repeats)],
        figures={"potential": Figure(OF_DENSITY, shown, live=True)},
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
    start = float(np.sqrt(np.mean(repeats.e[-found.alike :] ** 2)))
    return (
        f"Learning can bring the error from {sized(start, unit)} to {sized(found.left, unit)} rms, "
        f"a factor of {number(start / found.left)}, by what lies below "
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
    if found.settling:
        lines.append(
            "The trials settle: the first that is counted differs from those after it by "
            f"{sized(found.settling, unit)} rms, more than they do from one another. What is new "
            "is less than told here; let the machine make the motion more often before the series."
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


# In what an error repeats
# --------------------------------------------------------------------------------------------------


Within = Mapping[str, Recurrence | None]


def repeats_in(paths: str | Path | Sequence[str | Path], **reading: Value) -> Repeats:
    """The trials of files, or of the folder of a campaign; raises as `read_repeats` does."""
    found = [Path(one) for one in ([paths] if isinstance(paths, str | Path) else paths)]
    folder = next((path for path in found if path.is_dir()), None)
    if folder is None:
        return read_repeats(found, **reading)
    if len(found) > 1:
        said = "is a folder, of a campaign, which stands alone; allowed is it, or files of trials"
        raise ValueError(f"{folder} {said}")
    return repeats_of(open_campaign(folder, Given(), new=False).campaign)


def within_trial(repeats: Repeats, found: Potential | None = None) -> Within:
    """How what repeats repeats within the trial, over time and position; empty if by chance."""
    if len(repeats.e) > 1:
        found = found or potential_of(repeats.e, repeats.dt)
        if not found.cutoff.value or not found.repeatable.low:
            return {}
    e = np.mean(repeats.e, axis=0)
    time, position = repeats.dt * np.arange(len(e)), repeats.position
    of_position = None if position is None else recurrence_of(position, e)
    return {"time": recurrence_of(time, e), "position": of_position}


def within_numbers(within: Within) -> Numbers:
    """Period and share of each way in which the error may repeat, as JSON."""
    return {"within": {name: one and dict(one._asdict()) for name, one in within.items()}}


def recurs(within: Within, repeats: Repeats) -> list[str]:
    """In what the error repeats, and which law follows."""
    told = {name: one for name, one in within.items() if one}
    if not told:
        return []
    said, place = [], repeats.unit if repeats.place is None else repeats.place
    for name, what in (("time", "s"), ("position", place)):
        if one := told.get(name):
            said.append(
                f"a period of {sized(one.period, what)} in the {name} foretells "
                f"{100 * one.share:.0f} %"
            )
    head = f"Within the trial, of a third that was not looked at, {' and '.join(said)}: "
    neither = "the error repeats from trial to trial only, so learn between trials."
    if len(repeats.e) == 1:
        neither = (
            "the error repeats in neither, and one trial does not tell whether it repeats from "
            "trial to trial; record the motion again, and learn between trials what does."
        )
    laws = {
        frozenset(): neither,
        frozenset({"time"}): "it repeats in a period, so RepetitiveControl learns it without a "
        "stop.",
        frozenset({"position"}): "it repeats in the position, so a map of PositionBasis learns it "
        "and serves any speed.",
    }
    both = (
        "at one speed the two are one; record a second speed, as a map over the position serves "
        "any and a period only its own."
    )
    over = frozenset(name for name, one in told.items() if one.repeats)
    doubt = " One trial does not tell it from a resonance that rings; a second one does."
    return [head + laws.get(over, both) + (doubt if over and len(repeats.e) == 1 else "")]


# The laws that follow, for `design`
# --------------------------------------------------------------------------------------------------


@dataclasses.dataclass
class Following:
    """The laws whose condition holds, what is said of each law, and its numbers, by name."""

    schemes: dict[str, Scheme] = dataclasses.field(default_factory=dict)
    lines: list[str] = dataclasses.field(default_factory=list)
    numbers: Numbers = dataclasses.field(default_factory=dict)


def following(
    chosen: Scenario, within: Within, laws: Sequence[Scheme], progress: Progress
) -> Following:
    """The laws for an error that repeats within the trial; of laws between trials, best first."""
    found = Following()
    over = {name: one.period for name, one in within.items() if one and one.repeats}
    if laws and "time" in over:
        _in_period(found, chosen, over["time"], laws, progress)
    if laws and "position" in over:
        _in_position(found, chosen, over["position"], laws[0], progress)
    return found


def _in_period(
    found: Following, chosen: Scenario, period: float, laws: Sequence[Scheme], progress: Progress
) -> None:
    """Repetitive control by the taps of the first law that has its condition, if there is one."""
    population = Population(chosen.machine, chosen.uncertainty, count=MACHINES)
    why = ""
    for law in laws:
        scheme = _within_period(law, chosen, period)
        if isinstance(scheme, str):
            why = why or scheme
            continue
        alone = dataclasses.replace(chosen, schemes={PERIODIC: scheme})
        numbers = of_periods(alone, population, progress)[PERIODIC]
        if numbers["verdict"] == HOLDS:
            found.schemes[PERIODIC], found.numbers[PERIODIC] = scheme, numbers
            found.lines += period_sentences(PERIODIC, numbers)
            return
        why = why or f"|Q - L T| is {number(numbers['condition'])}"
    found.lines.append(f"{PERIODIC} is not written: {why}.")


def _within_period(law: Scheme, chosen: Scenario, period: float) -> Scheme | str:
    """A law between trials as one from period to period, or why it is none."""
    task, learning = chosen.task, law.learning if isinstance(law, WithFeedback) else law
    of = law_of(learning, task)
    if not of.invariant.held:
        return f"the law is none of taps: {of.invariant.detail}"
    keep, L = (_trimmed(taps) for taps in (of.keep, of.L))
    middle = max((int(L.powers[0]) + int(L.powers[-1])) // 2, 1)
    filters = LearningFilter(
        _around(L, middle), keep=_around(keep, 0), lead=middle - 1, dt=float(task.dt)
    )
    learned = RepetitiveControl(filters, period)
    scheme = dataclasses.replace(law, learning=learned) if law is not learning else learned
    try:
        scheme.check(task)
    except ValueError as error:
        return str(error)
    return scheme


def _trimmed(taps: Taps) -> Taps:
    values = np.asarray(taps.taps)[:, 0, 0]
    kept = np.flatnonzero(np.abs(values) > LEAST * np.max(np.abs(values), initial=0.0))
    if not len(kept):
        return Taps(np.zeros(1, int), np.zeros(1))
    part = slice(kept[0], kept[-1] + 1)
    return Taps(np.asarray(taps.powers)[part], values[part])


def _around(taps: Taps, middle: int) -> np.ndarray:
    """(2 n + 1,) the taps with that of the power `middle` in the middle."""
    n = int(np.max(np.abs(taps.powers - middle)))
    placed = np.zeros(2 * n + 1)
    placed[taps.powers - middle + n] = taps.taps
    return placed


def _in_position(
    found: Following, chosen: Scenario, pitch: float, law: Scheme, progress: Progress
) -> None:
    """A map over the position beside what the motion needs, if the task's motion tells it."""
    progress(BY_PLACE)
    machine, task = chosen.machine, chosen.task
    model = StateSpace(*minimal(linear_loop(machine, law, task), task.N), dt=task.dt)
    place = PositionBasis(Harmonics(pitch, ORDERS))
    basis = JoinedBasis((PolynomialBasis((0, 1, 2)), place))
    scheme: Scheme = BasisFunctions(basis, model)
    if isinstance(law, WithFeedback):
        scheme = dataclasses.replace(law, learning=scheme)
    alike = alike_trials(machine, scheme, task)
    if not alike.held:
        found.lines.append(f"{BY_PLACE} is not written: {alike.detail}.")
        return
    seen = visits(machine, scheme, task)
    told, count = int(np.sum(seen.told)), len(seen.told)
    found.numbers[BY_PLACE] = {"pitch": pitch, "told": told, "functions": count, "rate": seen.rate}
    if not seen.rate < 1:
        found.lines.append(
            f"{BY_PLACE} is not written: on the motion of {chosen.name} its parameters are not "
            "learned."
        )
        return
    found.schemes[BY_PLACE] = scheme
    found.lines.append(
        f"{BY_PLACE}, a map with a pitch of {sized(pitch, task.unit)} beside the motion's own "
        f"functions, learns {told} of its {count} functions on the motion of {chosen.name}. At "
        f"most {number(max(seen.rate, 1e-3))} of an error of its parameters is left after each "
        "trial, on the nominal machine."
    )
