"""In what an error repeats, from records, and which law follows: of `potential` and `design`.

An error that repeats from trial to trial is learned between trials. One that repeats in a period is
learned by `RepetitiveControl` without a stop, by the taps that were found safe between trials: its
condition is nearly theirs. One that repeats in the position is learned as a map over it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..hardware.campaign import repeats_of
from ..identification.potential import Potential, potential_of
from ..identification.recurrence import Recurrence, recurrence_of
from ..identification.repeats import Repeats, read_repeats
from ..plants import Harmonics, StateSpace
from ..pytree.aliases import Value
from ..scenarios.campaigns import Given, open_campaign
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
from ..theory.condition import HOLDS
from ..theory.law import Taps, law_of
from ..theory.loop import linear_loop, minimal
from ..theory.visits import visits
from ..uncertainty import Population
from .certifying import of_periods, period_sentences
from .outcome import Numbers, Progress
from .words import number, sized

if TYPE_CHECKING:
    from ..scenarios import Scenario

ORDERS = 1, 2, 3  # of the pitch
MACHINES = 17  # on which repetitive control is judged
LEAST = 1e-6  # share of the largest tap that is left out
PERIODIC, BY_PLACE = "repetitive", "by-position"  # names of the schemes that are offered

Within = Mapping[str, Recurrence | None]


def repeats_in(paths: Sequence[str | Path], **reading: Value) -> Repeats:
    """The trials of files, or of the folder of a campaign.

    Raises ValueError as `read_repeats` does, and for a folder beside something else.
    """
    found = [Path(one) for one in paths]
    folder = next((path for path in found if path.is_dir()), None)
    if folder is None:
        return read_repeats(found, **reading)
    if len(found) > 1:
        said = "is a folder, of a campaign, which stands alone; allowed is it, or files of trials"
        raise ValueError(f"{folder} {said}")
    return repeats_of(open_campaign(folder, Given(), new=False).campaign)


def within_trial(repeats: Repeats, found: Potential | None = None) -> Within:
    """How what repeats from trial to trial repeats within the trial, over time and position.

    Empty where of several trials nothing repeats, or by chance alone.
    found: what learning can gain, where it is known already
    """
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
    said = []
    for name, what in (("time", "s"), ("position", repeats.unit)):
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
    """The laws that follow from how an error repeats.

    schemes: by name, those whose condition holds
    lines: what is said of each, and why one is left out
    numbers: of each, as JSON
    """

    schemes: dict[str, Scheme] = dataclasses.field(default_factory=dict)
    lines: list[str] = dataclasses.field(default_factory=list)
    numbers: Numbers = dataclasses.field(default_factory=dict)


def following(
    chosen: Scenario, within: Within, laws: Sequence[Scheme], progress: Progress
) -> Following:
    """The laws for an error that repeats in a period or in the position.

    laws: between trials, the best one first, each with the feedback of the machine
    """
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
