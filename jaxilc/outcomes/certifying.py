"""`certify`: the claims of theory for each machine, beside simulation."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from .. import figures
from ..learning.divergence import GROWTH
from ..plants import Harmonics
from ..scenarios import Scenario
from ..theory.bounds import OF_MACHINES, OF_TRIALS, checked
from ..theory.certificates import (
    CLAIMS,
    CONVERGES,
    COURSES,
    DIVERGES,
    GROWS,
    MONOTONE,
    NOTHING,
    TURNS,
    Certificate,
    OfScheme,
    certify_schemes,
    printed_conditions,
)
from ..theory.chance import STILL, SURELY
from ..theory.condition import HOLDS, NOT_CLAIMED, Condition
from ..theory.learning_map import LARGEST
from ..theory.repetitive import (
    POINTS,
    basis_condition,
    basis_of,
    largest_gain,
    repetitive_condition,
    side_by_side,
)
from ..uncertainty import Population
from .outcome import Figure, Numbers, Outcome, Progress, Table, Verdict, silent
from .request import Request
from .words import Case, beside_1, counted, machine_said, number, several

if TYPE_CHECKING:
    import xarray as xr

    from ..theory.bounds import Checked

MACHINES = 64  # that are drawn where no number is asked for
COURSE_WORDS = {TURNS: "turned after a best trial", GROWS: "ended above the start"}


def certify(
    request: Request | str,
    *,
    machines: int = MACHINES,
    seed: int = 0,
    sampling: str = "monte-carlo",
    folder: str | Path | None = None,
    progress: Progress = silent,
) -> Outcome:
    """Theory beside simulation: claims for the long run, and predictions of J trials.

    For schemes with the bounds of Cao 2019, their premises are checked too. Of repetitive control
    its condition is told, what it does between harmonics, and what a wrong period costs.

    request: what is simulated; the name of a scenario or a plant file stands for all of it
    machines, seed, sampling: of the machines drawn, as for `Sweep`
    folder: for the figures; out/certify-NAME if not given
    Raises ValueError naming what is allowed.
    """
    request = Request.of(request)
    chosen = request.scenario()
    population = Population(
        chosen.machine, chosen.uncertainty, count=machines, seed=seed, sampling=sampling
    )
    drawn = population.drawn
    periods = of_periods(chosen, population, progress) | of_bases(chosen, population, progress)
    learning = sum(scheme.learns for scheme in chosen.schemes.values())
    found: dict[str, OfScheme] = {}
    if learning or not periods:
        found = certify_schemes(
            chosen.machine, chosen.schemes, chosen.task, chosen.trials, chosen.uncertainty, drawn,
            progress=lambda done, name: progress(name, done, learning),
        )  # fmt: skip
    numbers = {
        name: certificate_numbers(one) | {"printed": _printed(chosen, name)}
        for name, one in found.items()
    }
    scale, unit = chosen.shown_scale, chosen.shown_unit
    case = Case.of(chosen, request)._replace(unit=unit)  # that of an error, of any metric
    tables, lines = [], []
    for name, of_scheme in numbers.items():
        tables += certificate_tables(name, chosen.trials, of_scheme)
        lines.append(certificate_sentence(name, chosen.trials, of_scheme, scale, unit))
        lines += reason_lines(name, of_scheme)
        lines += printed_lines(name, of_scheme)
    if not chosen.uncertainty and machines not in (1, MACHINES):
        lines.append(f"machines = {machines} has no effect: without an uncertainty the nominal "
                     "machine is the only one")  # fmt: skip
    broken = [name for name, row in numbers.items() if row["contradicted"]]
    what = "simulation contradicts what was claimed: please report this"
    of_all = {"scenario": request.source, "trials": chosen.trials, "samples": machines}
    said = [line for name, one in periods.items() for line in period_sentences(name, one)]
    shown = {
        name: Figure(
            f"{name}: the error by trial, simulated and predicted, and what is claimed.",
            partial(
                figures.certificate, one.certificate, scale=scale, unit=unit, title=name,
                parameters=drawn,
            ),
        )
        for name, one in found.items()
    }  # fmt: skip
    if numbers:
        verdict = certify_verdict(case, numbers, scale, said)
    else:
        following = case.on("sweep", next(iter(periods)))
        verdict = Verdict(tuple(said), "many machines by simulation", following)
    return Outcome(
        command="certify",
        numbers=of_all | {"schemes": numbers} | ({"periods": periods} if periods else {}),
        verdict=verdict,
        folder=Path(folder or f"out/certify-{chosen.name}"),
        scenario=chosen,
        tables=tables,
        lines=lines,
        figures=shown,
        live=lambda: [one.described() for one in shown.values()],
        asked={"machines": machines, "seed": seed, "sampling": sampling},
        failed=f"{', '.join(broken)}: {what}" if broken else "",
    )


def _printed(chosen: Scenario, name: str) -> dict[str, Numbers]:
    """The conditions that papers print for a scheme: their values, verdicts and broken premises."""
    found = printed_conditions(chosen.schemes[name], chosen.task, chosen.machine)
    return {
        place: {
            "value": float(one.value),
            "verdict": str(one.verdict),
            "broken": [p.name for p in one.broken],
            "theorem": one.theorem,
        }
        for place, one in found.items()
    }


def certificate_numbers(of_scheme: OfScheme) -> Numbers:
    """The content of a certificate, as counts of machines.

    The keys of the dictionary are:

    claims, reasons: claims for an unlimited number of trials, with their reasons
    floor: largest error left in the long run on the machines with a claim; where something is drawn
        for each trial, its root mean square over all that is drawn; NaN where it is not known
    rounding: largest part of it that is due to rounding or hysteresis; None without it
    held_by: which of them; likewise
    senses: number of machines with a claim, by the sense in which it holds for single runs; empty
        where nothing is drawn
    most: largest error that a late trial of one of these machines exceeds with a chance of 5 % or
        less, by theory; None where nothing is drawn, or where it is not known
    first, quantile: largest root mean square error of the first trial, where something is drawn or
        rounded, and that of the last one below which 95 % of the simulated runs end, where
        something is drawn; else None
    ends: number of trials after which they end, not yet late perhaps; None where nothing is drawn
    since: number of the trial from which on nothing changes; all that is told here begins with it,
        courses with nothing learned
    expected, observed, confusion: course of the error in J trials, by theory and by simulation
    transient: how far the error grows before it falls, where learning is claimed to converge, in
        units of the first error, in which trial, and on how many machines; and about how far noise
        grows where no power of the learning map is known to contract
    printed: conditions that a paper prints for the scheme, by their places, added by `certify`
    premises, bound, care: see `bounds_numbers`, for a scheme that has bounds
    """
    found = of_scheme.certificate
    claimed = np.isin(found.claim, (MONOTONE, CONVERGES))
    drawn = ~np.isin(found.sense, (SURELY, STILL))
    ball = np.zeros(len(claimed)) if found.ball is None else found.ball.error
    floor = np.where(drawn, found.left, found.floor + found.doubt + ball)
    known = np.isfinite(found.most[claimed])
    rounds = found.ball is not None and bool(np.any(claimed))
    last = None if found.runs is None else np.quantile(found.runs[:, :, -1], 0.95, axis=1)
    numbers = {
        "since": of_scheme.since,
        "claims": {claim: int(np.sum(found.claim == claim)) for claim in CLAIMS},
        "monotone_in_the_error": int(np.sum(found.of_error)),
        "reasons": {
            claim: counted(found.reason[found.claim == claim])
            for claim in CLAIMS
            if np.any(found.claim == claim)
        },
        "floor": float(np.max(floor[claimed])) if np.any(claimed) else None,
        "rounding": float(np.max(ball[claimed])) if rounds else None,
        "held_by": found.ball.of[0] if found.ball is not None and np.any(claimed) else None,
        "senses": counted(found.sense[(found.sense != SURELY) & (found.claim != NOTHING)]),
        "most": float(np.max(found.most[claimed])) if np.all(known) and np.any(claimed) else None,
        "first": None if last is None and not rounds else float(np.max(found.simulated[:, 0])),
        "quantile": None if last is None else float(np.max(last)),
        "ends": None if last is None else found.simulated.shape[1],
        "expected": {course: int(np.sum(found.expected == course)) for course in COURSES},
        "observed": {course: int(np.sum(found.observed == course)) for course in COURSES},
        "confusion": found.confusion(),
        "growth": {"median": float(np.median(found.growth)), "max": float(np.max(found.growth))},
        "transient": _transient(found, claimed),
        "turning": {
            "predicted": float(np.median(found.turning)),
            "observed": float(np.median(found.observed_turning)),
        },
        "contradicted": found.broken_promises().tolist(),
        "seconds_a_machine": of_scheme.seconds / len(found.claim),
    }
    if of_scheme.checked is not None:
        numbers |= bounds_numbers(of_scheme.checked)
    return numbers


def _transient(found: Certificate, claimed: np.ndarray) -> Numbers:
    grows, of_any = claimed & (found.peak > 1 + GROWTH), np.zeros(len(claimed))
    grows &= ~(found.peak * found.predicted[:, 0] <= found.left)  # else it does not fall afterwards
    if found.outlook is not None:
        decay = found.outlook.decay
        of_any = np.where(claimed & (decay.trials == 0) & ~found.of_error, decay.growth, 0.0)
    worst = int(np.argmax(np.where(grows, found.peak, 0.0)))
    return {
        "growth": float(found.peak[worst]) if np.any(grows) else None,
        "trial": int(found.peak_trial[worst]) if np.any(grows) else None,
        "of_noise": float(np.max(of_any)) if np.any(of_any) else None,
        "machines": int(np.sum(grows | (of_any > 0))),
    }


def certificate_tables(name: str, trials: int, numbers: Numbers) -> list[Table]:
    """The tables of claims, of the course by theory and simulation, and of premises."""
    claims = Table(
        "in the long run",
        right=["machines"],
        title=f"{name}: what is claimed, however many trials are run",
        rows=((claim, str(count)) for claim, count in numbers["claims"].items()),
    )
    what = f"machines by their error within {several(trials, 'trial')}"
    title = f"{name}: {what}, by theory and simulation"
    courses = Table("by theory", right=COURSES, title=title)
    for course, row in numbers["confusion"].items():
        head = f"{course} ({numbers['expected'][course]})"
        courses.add_row(head, *(str(row[c]) for c in COURSES))
    return [claims, courses, *([premises_table(name, numbers)] if "premises" in numbers else [])]


def certificate_sentence(name: str, trials: int, numbers: Numbers, scale: float, unit: str) -> str:
    """The content of a certificate in words."""
    in_the_long_run, within = _claimed(numbers, scale, unit), _expected(numbers)
    changes = numbers.get("since", 1) > 1
    begun = ", begun after the last change with nothing learned," if changes else ""
    said = f"{name}: {since_words(numbers)}{in_the_long_run}. "
    said += f"Within {several(trials, 'trial')}{begun} {within}."
    return f"{said}{transient_words(numbers)}"


def since_words(numbers: Numbers) -> str:
    """From which trial on something is claimed, before a comma; empty for all trials."""
    return f"from trial {numbers['since']} on, " if numbers.get("since", 1) > 1 else ""


def reason_lines(name: str, numbers: Numbers) -> list[str]:
    """A sentence on each reason of a claim, or of its absence, with its number of machines."""
    return [
        f"{name}, {claim} on {count}: {reason}."
        for claim, reasons in numbers["reasons"].items()
        for reason, count in reasons.items()
    ]


def printed_lines(name: str, numbers: Numbers) -> list[str]:
    """A sentence on each condition that a paper prints for a scheme, of its nominal model alone."""
    return [
        f"{name}, by {place}, of the nominal model alone: {beside_1(of['value'])} is "
        + ("" if of["value"] < 1 else "not ")
        + f"below 1: {of['verdict']}"
        + (f", since it presumes: {'; '.join(of['broken'])}." if of["broken"] else ".")
        for place, of in numbers["printed"].items()
    ]


def transient_words(numbers: Numbers) -> str:
    """A sentence on how far the error grows before it falls; empty where it does not."""
    transient, machines = numbers["transient"], sum(numbers["claims"].values())
    if not transient["machines"]:
        return ""
    whose = "" if machines == 1 else f" of {transient['machines']} of {machines} machines"
    grown = []
    if transient["growth"]:
        grown.append(
            f"the error{whose} grows up to {number(transient['growth'])} times, until trial "
            f"{transient['trial']}"
        )
    if transient["of_noise"]:
        noise = "noise" if grown else f"noise in the error{whose}"
        grown.append(f"{noise} can grow about {number(transient['of_noise'])} times")
    return f" Before it falls, {', and '.join(grown)}."


def _claimed(numbers: Numbers, scale: float, unit: str) -> str:
    """The claims for an unlimited number of trials, in words."""
    claims, machines = numbers["claims"], sum(numbers["claims"].values())
    certified = claims[MONOTONE] + claims[CONVERGES]
    parts = []
    if certified:
        in_error = numbers["monotone_in_the_error"]
        which = []
        if claims[MONOTONE]:
            rounded = "" if not numbers["held_by"] else f" until {numbers['held_by']} holds it"
            every = f"{claims[MONOTONE]} in every trial{rounded}"
            which.append(f"{every} ({in_error} in the error itself)")
        if claims[CONVERGES]:
            which.append(f"{claims[CONVERGES]} in the end")
        parts.append(
            f"in the long run {certified} of {several(machines, 'machine')} "
            f"{'comes nearer to its' if machines == 1 else 'come nearer to their'} limit"
            f"{senses_words(numbers) or ','} {' and '.join(which)}; "
            f"it leaves {left_words(numbers, scale, unit)}"
        )
    if claims[DIVERGES]:
        parts.append(f"{claims[DIVERGES]} diverge{'s' * (claims[DIVERGES] == 1)}")
    if claims[NOTHING]:
        some = f"of {claims[NOTHING]}" if parts else "of the long run"
        parts.append(f"{some} nothing is claimed")
    return ", ".join(parts)


def senses_words(numbers: Numbers) -> str:
    """In which senses claims hold for single runs, between commas; empty where nothing is drawn."""
    senses = numbers["senses"]
    if len(senses) < 2:
        return "".join(f", {sense}," for sense in senses)
    return ", " + " and ".join(f"{sense} on {count}" for sense, count in senses.items()) + ","


def left_words(numbers: Numbers, scale: float, unit: str) -> str:
    """What learning leaves in the long run, in words."""
    floor = scale * numbers["floor"]
    if floor == float("inf"):
        return "an error whose square has no mean"
    if floor != floor:
        return "an error whose size is not known"
    size = f"{number(floor)} {unit}".rstrip() + rounding_words(numbers, scale, unit)
    if not numbers["senses"]:
        return f"an rms error of at most {size}"
    if STILL in numbers["senses"]:
        noise = f"its noise, which is followed for up to {LARGEST} inputs only"
        return f"without {noise}, an rms error of at most {size}"
    last = f"{number(scale * numbers['quantile'])} {unit}".rstrip()
    most = ""
    if numbers["most"] is not None:
        most = f", and in 95 of 100 late trials of at most {number(scale * numbers['most'])} {unit}"
    return (
        f"an rms error of at most {size} over all that is drawn{most.rstrip()} "
        f"(95 % of the simulated runs are below {last} after {numbers['ends']} trials)"
    )


def rounding_words(numbers: Numbers, scale: float, unit: str) -> str:
    """How much of an error is due to rounding, after a comma; empty where nothing is rounded."""
    if numbers["rounding"] is None:
        return ""
    size = f"{number(scale * numbers['rounding'])} {unit}".rstrip()
    return f", of which {numbers['held_by']} makes up to {size}"


def _expected(numbers: Numbers) -> str:
    """The course of the error within the trials, by theory and by simulation, in words."""
    expected, observed, turning = numbers["expected"], numbers["observed"], numbers["turning"]
    bad = {c: (expected[c], observed[c]) for c in (TURNS, GROWS) if expected[c] or observed[c]}
    if not bad:
        return "the error of every machine ends no higher than it began, by theory and simulation"
    of = several(sum(expected.values()), "machine")
    courses = ", ".join(
        f"{e} of {of} by theory and {o} by simulation {COURSE_WORDS[c]}"
        for c, (e, o) in bad.items()
    )
    best = (
        f"the best trial is {turning['predicted']:g} by theory "
        f"and {turning['observed']:g} by simulation (median)"
    )
    return f"{courses}; {best}"


def certify_verdict(
    case: Case, numbers: Mapping[str, Numbers], scale: float, besides: Sequence[str] = ()
) -> Verdict:
    """Which schemes are certified on every machine, which are not, and why."""
    certified, said = [], []
    for name, row in numbers.items():
        claims, machines = row["claims"], sum(row["claims"].values())
        if claims[MONOTONE] + claims[CONVERGES] == machines:
            what = (
                f"{since_words(row)}learning {_how(row)}{senses_words(row)} and leaves "
                f"{left_words(row, scale, case.unit)}"
            )
            first, does = row["first"], "is certified"
            if first is not None and (row["floor"] >= first or (row["quantile"] or 0.0) >= first):
                does = "is no gain"
                what += f", where the first trial has {case.size(scale * first)}"
            else:
                certified.append(name)
            said.append(f"{name} {does} on {_all(machines)}: {what}.{transient_words(row)}")
        else:
            claim = DIVERGES if claims[DIVERGES] else NOTHING
            does = "diverges" if claims[DIVERGES] else "is not certified"
            reasons = row["reasons"][claim]
            why = max(reasons, key=lambda reason: reasons[reason])
            where = _all(1) if machines == 1 else f"{claims[claim]} of {machines} machines"
            said.append(f"{name} {does} on {where}: {why}.")
    return Verdict((*said, *besides), *_after_certify(case, numbers, certified))


def _all(machines: int) -> str:
    return "the nominal machine" if machines == 1 else f"all {machines} machines"


def _how(row: Numbers) -> str:
    claims = row["claims"]
    if not claims[CONVERGES]:
        return "is monotone" + (f" until {row['held_by']} holds it" if row["held_by"] else "")
    every = claims[MONOTONE]
    return f"converges, on {every} of them in every trial" if every else "converges"


def _after_certify(
    case: Case, numbers: Mapping[str, Numbers], certified: Sequence[str]
) -> tuple[str, str]:
    known = [name for name in certified if STILL not in numbers[name]["senses"]]
    fit = [name for name in known if not numbers[name]["transient"]["machines"]]
    if fit:
        best = min(fit, key=lambda name: numbers[name]["floor"])
        if case.request.of_file:
            words = ("--state", "out/campaign", "--out", "trial-1.csv")
            scheme = case.request.name_of(best, [*case.learns])
            return "on the machine", case.request.following("next", *words, scheme=scheme)
        return "the worst machine", case.on("worst-case", best)
    lost = [name for name, row in numbers.items() if _ends_badly(row)]
    if lost:
        if case.designable:
            return case.remedy(lost[0])
        return "the worst machine", case.on("worst-case", lost[0])
    return "many machines by simulation", case.on("sweep", next(iter(certified or numbers)))


def _ends_badly(row: Numbers) -> bool:
    """Whether a scheme diverges, or its error grows before it falls or at the end, somewhere."""
    grows = row["observed"][TURNS] or row["observed"][GROWS] or row["transient"]["machines"]
    return bool(row["claims"][DIVERGES] or grows)


# Repetitive control: its condition, the waterbed, and a wrong period
# --------------------------------------------------------------------------------------------------


WRONG = 0.01  # relative error of a period whose price is told
ENOUGH = 2**14  # frequencies, about


def of_periods(chosen: Scenario, population: Population, progress: Progress) -> dict[str, Numbers]:
    """The condition of each scheme of repetitive control, as numbers by its name.

    tracked: largest change of a period that is tracked [s per s]; None where it stays
    in_parallel: the number of those that stand side by side
    times: by how much the condition is stricter for it
    verdict, reasons: of the condition on the worst machine, and the premises that are broken
    machines, at, worst: number of machines, and the numbers of the worst one, also in words
    condition, condition_at: its largest value, and where [Hz]
    grows, grows_at: the largest growth of what does not repeat in the period, and where [Hz]
    left, left_if_wrong: shares of the first harmonic that are left of the nominal machine, with the
        right period and with a true one that is WRONG longer
    no_gain_if_wrong: the first harmonic that is then not made smaller [Hz]; None if there is none
    """
    found = {}
    for name, scheme in chosen.schemes.items():
        beside, _ = side_by_side(scheme)
        if not beside:
            continue
        progress(name)
        harmonics = 0.5 * sum(float(np.sum(one.period)) for one in beside) / float(chosen.task.dt)
        points = int(np.clip(ENOUGH / harmonics, 2, POINTS))
        ask = partial(repetitive_condition, scheme=scheme, task=chosen.task, points=points)
        worst, right = ask(population), ask(chosen.machine)
        wrong = ask(chosen.machine, wrong=WRONG)
        tracking, periods = beside[0].tracking, [np.atleast_1d(one.period) for one in beside]
        condition, lost = worst.test.condition, wrong.harmonics[wrong.left >= 1]
        found[name] = {
            "tracked": None if tracking is None else float(tracking.fastest),
            "times": largest_gain(0.0 if tracking is None else float(tracking.fastest)),
            "period": np.concatenate(periods).astype(float).tolist(),
            "in_parallel": len(beside),
            "verdict": str(condition.verdict),
            "reasons": _reasons(condition),
            "machines": population.size,
            "at": worst.at,
            "worst": machine_said(worst.at, chosen.uncertainty),
            "condition": float(condition.value),
            "condition_at": worst.test.worst,
            "grows": worst.worst,
            "grows_at": worst.worst_at,
            "left": float(right.left[0]),
            "left_if_wrong": float(wrong.left[0]),
            "no_gain_if_wrong": float(lost[0]) if len(lost) else None,
        }
    return found


def of_bases(chosen: Scenario, population: Population, progress: Progress) -> dict[str, Numbers]:
    """What `basis_condition` tells of each `RepetitiveBasis`, as numbers by its name.

    map: the largest |eigenvalue| of the map of a period, on the worst machine; None where the
        functions have no such map, as `reasons` tells
    keep: what is left of a weight after a step
    harmonic: whether the functions are harmonics
    verdict, reasons, machines, at, worst: as in `of_periods`
    """
    found = {}
    for name, scheme in chosen.schemes.items():
        basis, _ = basis_of(scheme)
        if basis is None:
            continue
        progress(name)
        about = {"keep": float(basis.keep), "harmonic": isinstance(basis.functions, Harmonics)}
        told: Numbers = {"map": None, "verdict": NOT_CLAIMED, "at": {}}
        try:
            condition, period, at = basis_condition(population, scheme, chosen.task)
        except ValueError as error:
            told["reasons"] = [str(error)]
        else:
            told |= {"map": float(condition.value), "period": [period], "at": at}
            told |= {"verdict": str(condition.verdict), "reasons": _reasons(condition)}
        said = machine_said(told["at"], chosen.uncertainty)
        found[name] = about | told | {"machines": population.size, "worst": said}
    return found


def _reasons(condition: Condition) -> list[str]:
    return [f"{one.name}: {one.detail}" for one in condition.broken]


def _machines(numbers: Numbers) -> tuple[str, str]:
    """On which machines a condition holds, and the numbers of the worst one, in words."""
    worst = numbers["worst"]
    return _all(numbers["machines"]), f" on the worst ({worst})" if worst else ""


def _basis_sentence(name: str, numbers: Numbers) -> str:
    """The content of `of_bases` for one scheme, in words."""
    whose, worst = _machines(numbers)
    if numbers["map"] is None:
        return f"{name} is not certified from period to period: {numbers['reasons'][0]}."
    period = f"from period to period of {number(numbers['period'][0])} s"
    value = f"the largest eigenvalue of its map is {number(numbers['map'])}{worst}"
    if numbers["verdict"] != HOLDS:
        why = f"; not held is {'; '.join(numbers['reasons'])}" if numbers["reasons"] else ""
        return f"{name} is not certified {period}: {value}{why}."
    keep, of = numbers["keep"], "" if numbers["harmonic"] else " of a disturbance at the input"
    left = "nothing" if keep == 1 else f"a part, as keep = {number(keep)} forgets,"
    return (
        f"{name} converges {period} on {whose}: {value}. Of what its functions hold{of} {left} "
        "is left."
    )


def period_sentences(name: str, numbers: Numbers) -> list[str]:
    """The content of `of_periods` or `of_bases` for one scheme, in words."""
    if "map" in numbers:
        return [_basis_sentence(name, numbers)]
    parallel = numbers["in_parallel"]
    several = 1 if parallel > 1 else 2 ** len(numbers["period"]) - 1
    several = numbers["times"] if numbers["tracked"] else several
    period = " and ".join(number(one) for one in numbers["period"]) + " s"
    if numbers["tracked"]:
        period += f", which is tracked and changes by {number(numbers['tracked'])} s/s at most,"
    whose, worst = _machines(numbers)
    times = f"{number(several)} " if several > 1 else ""
    L = "L" if parallel == 1 else f"{parallel} L"
    value = (
        f"{times}|Q (1 - {L} T)| is at most "
        f"{number(numbers['condition'])}, at {number(numbers['condition_at'])} Hz{worst}"
    )
    if numbers["verdict"] == HOLDS:
        moving = "stays bounded whatever is tracked, and once that is constant "
        moving *= bool(numbers["tracked"])
        head = f"{moving}converges from period to period of {period} on {whose}: {value}"
    else:
        why = f"; not held is {'; '.join(numbers['reasons'])}" if numbers["reasons"] else ""
        head = f"is not certified from period to period of {period.rstrip(',')}: {value}{why}"
    lost = numbers["no_gain_if_wrong"]
    beyond = "" if lost is None else f"; that at {number(lost)} Hz is then no smaller"
    return [
        f"{name} {head}.",
        f"{name}: what does not repeat in the period grows up to {number(numbers['grows'])} times, "
        f"at {number(numbers['grows_at'])} Hz. Of the first harmonic {number(numbers['left'])} is "
        f"left, or {number(numbers['left_if_wrong'])} if the true period is {100 * WRONG:g} % "
        f"longer{beyond}.",
    ]


# The bounds of Cao 2019 over machines, also of a sweep
# --------------------------------------------------------------------------------------------------


GREW = 1e-9  # of an error, below which it is rounding that has grown


def bounds_numbers(found: Checked) -> Numbers:
    """The numbers of the bounds of Cao 2019 over machines.

    premises: on how many machines each held, and where it was broken
    bound: on how many it is claimed and holds, is claimed and fails, and is not claimed
    care: how many times the bound is above what was observed; None without a claim or an error
    """
    of_premises = {p.name: {"held": p.held, "share_broken": p.share_broken} for p in found.premises}
    return {"premises": of_premises, "bound": found.verdicts, "care": found.care}


def watched_numbers(scenario: Scenario, dataset: xr.Dataset) -> dict[str, Numbers]:
    """What a `BoundsWatch` found of each scheme that learns, over machines and trials, by scheme.

    Over a grid each machine counts at each point, and the last trial of a point with fewer trials
    than another counts again. Besides those of `bounds_numbers` there are:

    d2, left_out: smallest, median and largest over the machines; null where nothing is proved
    norm, pointwise: median over the machines of the median and of the largest ratio over the trials
    growing: share of the trials, of all machines, after which the 2-norm of the error was larger,
        of those before which it was above rounding
    """
    trial, found = dataset["trial"], {}
    if "trials" in dataset.coords:
        dataset = dataset.sel(trial=np.minimum(trial, dataset["trials"]))
    for name in (name for name, scheme in scenario.schemes.items() if scheme.learns):
        of = dataset.sel(scheme=name).transpose(..., "trial")
        sizes = dict.fromkeys(OF_TRIALS, (-1, trial.size)) | dict.fromkeys(OF_MACHINES, (-1,))
        one = {key: of[key].values.reshape(size) for key, size in sizes.items() if key in of}
        norm, worst, median = (
            one[f"contraction_{of}"][:, 1:] for of in ("norm", "worst", "median")
        )
        grown = norm[~np.isnan(norm)] > 1.0 + GREW
        found[name] = bounds_numbers(checked(one)) | {
            "d2": _spread(one["d2"]),
            "left_out": _spread(one["left_out"]),
            "norm": _typical(norm, norm),
            "pointwise": _typical(median, worst),
            "growing": float(np.mean(grown)) if grown.size else math.nan,
        }
    return found


def _typical(of_most, of_worst) -> list[float] | None:
    """The median over machines of the median, and of the largest, over the trials (S, J)."""
    if np.any(np.all(np.isnan(of_most), axis=1)):
        return None
    typical, worst = np.nanmedian(of_most, axis=1), np.nanmax(of_worst, axis=1)
    return [float(np.median(typical)), float(np.median(worst))]


def _spread(values) -> list[float] | None:
    values = np.asarray(values, float)
    if not np.all(np.isfinite(values)):
        return None
    return [float(of(values)) for of in (np.min, np.median, np.max)]


def premises_table(name: str, numbers: Numbers) -> Table:
    """The number of machines on which each premise of the bounds held, and where it failed."""
    machines = sum(numbers["bound"].values())
    tested = "; ".join(
        f"it {verdict} on {count}"
        for verdict, count in numbers["bound"].items()
        if count and verdict != "not claimed"
    )
    if numbers["care"]:
        tested += f"; d2 is {numbers['care']:.4g} times the largest ratio, in the median"
    nothing = f"it was claimed on none of {machines} machines, so nothing of it was tested"
    title = f"{name}: the bound of Cao 2019: {tested or nothing}"
    table = Table("premise", right=("held on", "broken at, of all samples"), title=title)
    for premise, row in numbers["premises"].items():
        held = f"{row['held']} of {machines}" if row["held"] else "no machine"
        table.add_row(premise, held, _of_all(row["share_broken"]))
    return table


def contraction_table(numbers: dict[str, Numbers]) -> Table:
    """How much smaller each trial made the error, beside d2 of the plant, by scheme."""
    title = "contraction of a trial: d2 of the plant, and |e_j| / |e_j-1| as observed"
    observed = ("norm, median", "norm, worst", "samples, median", "samples, worst")
    columns = ("d2", "left out by its theory", *observed, "trials that grew")
    table = Table("scheme", right=columns, title=title)
    for name, row in numbers.items():
        d2 = "not proved" if row["d2"] is None else f"{row['d2'][0]:.5g} to {row['d2'][2]:.5g}"
        left = "" if row["left_out"] is None else f"{100 * row['left_out'][1]:.5g} %"
        pairs = [row[of] or ("", "") for of in ("norm", "pointwise")]
        ratios = [value and f"{value:.4g}" for pair in pairs for value in pair]
        table.add_row(name, d2, left, *ratios, _of_all(row["growing"]))
    return table


def _of_all(share: float) -> str:
    """A share in percent as text; one above zero is never shown as zero, one of none not at all."""
    if math.isnan(share):
        return ""
    return "nowhere" if share == 0 else "< 0.01 %" if share < 1e-4 else f"{100 * share:.2f} %"


def bounds_tables(numbers: Numbers) -> list[Table]:
    """The tables of `watched_numbers`, none without any; the premises are those of all points."""
    at_best = numbers.get("bounds", {})
    of_all = numbers.get("grid", {}).get("bounds", at_best)
    where = " at all points" if "grid" in numbers else ""
    proved = [name for name, row in of_all.items() if row["d2"] is not None]
    tables = [premises_table(f"{name}{where}", of_all[name]) for name in proved]
    return [contraction_table(at_best), *tables] if at_best else []
