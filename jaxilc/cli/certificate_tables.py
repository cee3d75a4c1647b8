"""Tables and sentences of `jaxilc certify`: claims, expected errors, and premises."""

from __future__ import annotations

from typing import Any

from ..theory.certificates import CONVERGES, COURSES, DIVERGES, GROWS, MONOTONE, NOTHING, TURNS
from ..theory.chance import STILL
from .tables import number
from .titled_table import Table

COURSE_WORDS = {TURNS: "have a best trial and then turn", GROWS: "end above their start"}


def certificate_sentence(
    name: str, trials: int, numbers: dict[str, Any], scale: float, unit: str
) -> str:
    """The content of a certificate in words.

    name: name of the scheme
    trials: number J of trials
    numbers: result of `certificate_numbers`
    scale, unit: scale and unit in which errors are shown
    """
    in_the_long_run, within = _claimed(numbers, scale, unit), _expected(numbers)
    return f"{name}: {in_the_long_run}. Within {trials} trials {within}.{transient_words(numbers)}"


def transient_words(numbers: dict[str, Any]) -> str:
    """A sentence on how far the error grows before it falls; empty where it does not.

    numbers: result of `certificate_numbers`
    """
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


def _claimed(numbers: dict[str, Any], scale: float, unit: str) -> str:
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
            f"in the long run {certified} of {machines} machines come nearer to their limit"
            f"{senses_words(numbers) or ','} {' and '.join(which)}; "
            f"it leaves {left_words(numbers, scale, unit)}"
        )
    if claims[DIVERGES]:
        parts.append(f"{claims[DIVERGES]} diverge")
    if claims[NOTHING]:
        some = f"of {claims[NOTHING]}" if parts else "of the long run"
        parts.append(f"{some} nothing is claimed")
    return ", ".join(parts)


def senses_words(numbers: dict[str, Any]) -> str:
    """In which senses claims hold for single runs, between commas; empty where nothing is drawn."""
    senses = numbers["senses"]
    if len(senses) < 2:
        return "".join(f", {sense}," for sense in senses)
    return ", " + " and ".join(f"{sense} on {count}" for sense, count in senses.items()) + ","


def left_words(numbers: dict[str, Any], scale: float, unit: str) -> str:
    """What learning leaves in the long run, in words."""
    floor = scale * numbers["floor"]
    if floor == float("inf"):
        return "an error whose square has no mean"
    if floor != floor:
        return "an error whose size is not known"
    size = f"{number(floor)} {unit}".rstrip() + rounding_words(numbers, scale, unit)
    if not numbers["senses"] or STILL in numbers["senses"]:
        return f"an rms error of at most {size}"
    last = f"{number(scale * numbers['quantile'])} {unit}".rstrip()
    most = ""
    if numbers["most"] is not None:
        most = f", and in 95 of 100 late trials of at most {number(scale * numbers['most'])} {unit}"
    return (
        f"an rms error of at most {size} over all that is drawn{most.rstrip()} "
        f"(95 % of the simulated runs end below {last})"
    )


def rounding_words(numbers: dict[str, Any], scale: float, unit: str) -> str:
    """How much of an error is due to rounding, after a comma; empty where nothing is rounded."""
    if numbers["rounding"] is None:
        return ""
    size = f"{number(scale * numbers['rounding'])} {unit}".rstrip()
    return f", of which {numbers['held_by']} makes up to {size}"


def _expected(numbers: dict[str, Any]) -> str:
    """The course of the error within the trials, by theory and by simulation, in words."""
    expected, observed, turning = numbers["expected"], numbers["observed"], numbers["turning"]
    bad = {c: (expected[c], observed[c]) for c in (TURNS, GROWS) if expected[c] or observed[c]}
    if not bad:
        return "the error of every machine ends no higher than it began, by theory and simulation"
    courses = ", ".join(
        f"{e} machines {COURSE_WORDS[c]} by theory and {o} by simulation"
        for c, (e, o) in bad.items()
    )
    best = (
        f"the best trial is {turning['predicted']:g} by theory "
        f"and {turning['observed']:g} by simulation (median)"
    )
    return f"{courses}; {best}"


def reason_lines(name: str, numbers: dict[str, Any]) -> list[str]:
    """A sentence on each reason of a claim, or of its absence, with its number of machines.

    The arguments are those of `certificate_sentence`.
    """
    return [
        f"{name}, {claim} on {count}: {reason}."
        for claim, reasons in numbers["reasons"].items()
        for reason, count in reasons.items()
    ]


def certificate_tables(name: str, trials: int, numbers: dict[str, Any]) -> list[Table]:
    """The tables of claims, of the course by theory and simulation, and of premises.

    The arguments are those of `certificate_sentence`.
    """
    claims = Table(title=f"{name}: what is claimed, however many trials are run")
    for column in ("in the long run", "machines"):
        claims.add_column(column, justify="right" if column == "machines" else "left")
    for claim, count in numbers["claims"].items():
        claims.add_row(claim, str(count))
    what = f"machines by their error within {trials} trials"
    courses = Table("by theory", title=f"{name}: {what}, by theory and simulation")
    for course in COURSES:
        courses.add_column(course, justify="right")
    for course, row in numbers["confusion"].items():
        head = f"{course} ({numbers['expected'][course]})"
        courses.add_row(head, *(str(row[c]) for c in COURSES))
    return [claims, courses, *([premises_table(name, numbers)] if "premises" in numbers else [])]


def premises_table(name: str, numbers: dict[str, Any]) -> Table:
    """The number of machines on which each premise of the bounds held, and where it failed.

    numbers: those of `bounds_numbers`
    """
    machines = sum(numbers["bound"].values())
    tested = "; ".join(
        f"it {verdict} on {count}"
        for verdict, count in numbers["bound"].items()
        if count and verdict != "not claimed"
    )
    if numbers["care"]:
        tested += f"; d2 is {numbers['care']:.4g} times the largest ratio, in the median"
    nothing = f"it was claimed on none of {machines} machines, so nothing of it was tested"
    table = Table("premise", title=f"{name}: the bound of Cao 2019: {tested or nothing}")
    table.add_column("held on", justify="right")
    table.add_column("broken at, of all samples", justify="right")
    for premise, row in numbers["premises"].items():
        held = f"{row['held']} of {machines}" if row["held"] else "no machine"
        table.add_row(premise, held, _of_all(row["share_broken"]))
    return table


def _of_all(share: float) -> str:
    """A share in percent as text; a share above zero is never shown as zero."""
    return "nowhere" if share == 0 else "< 0.01 %" if share < 1e-4 else f"{100 * share:.2f} %"


def contraction_table(numbers: dict[str, dict[str, Any]]) -> Table:
    """How much smaller each trial made the error, beside d2 of the plant, by scheme.

    numbers: those of `watched_numbers`
    """
    title = "contraction of a trial: d2 of the plant, and |e_j| / |e_j-1| as observed"
    table = Table("scheme", title=title)
    for column in (
        "d2",
        "left out by its theory",
        "norm, median",
        "norm, worst",
        "samples, median",
        "samples, worst",
        "trials that grew",
    ):
        table.add_column(column, justify="right")
    for name, row in numbers.items():
        d2 = "not proved" if row["d2"] is None else f"{row['d2'][0]:.5g} to {row['d2'][2]:.5g}"
        left = "" if row["left_out"] is None else f"{100 * row['left_out'][1]:.5g} %"
        pairs = [row[of] or ("", "") for of in ("norm", "pointwise")]
        ratios = [value and f"{value:.4g}" for pair in pairs for value in pair]
        table.add_row(name, d2, left, *ratios, _of_all(row["growing"]))
    return table
