"""The answer of `jaxilc filter` for measured frequency responses."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .console import out
from .q_filter_tables import (
    answer_table,
    best_of,
    curve_numbers,
    first_above,
    offer_numbers,
    offers_table,
)
from .tables import number

if TYPE_CHECKING:
    from ..theory.measured_law import MeasuredQuestion, RecordTest

UNSEEN = 0.05  # |Q| beyond the last line that is worth a warning


def records_answer(
    source: list[str], given: dict[str, Any], asked: dict[str, Any], place: Callable[[], Path]
) -> tuple[dict[str, Any], list[Path]]:
    """Print the answer for a P-type law on records; its numbers, and the files written.

    place: makes the folder for results
    Raises ValueError for an option that is missing or out of its range, as `measured_question`.
    """
    from .. import figures
    from ..identification.frequency_response import read_frequency_response
    from ..theory.measured_law import PLaw, lines_of, measured_question

    missing = [f"--{name}" for name in ("gain", "cutoff", "dt") if given[name] is None]
    if missing:
        raise ValueError(
            f"a measured response needs a law: {', '.join(missing)} not given; u is learned by "
            "u + gain e[k + 1 + lead] with a low-pass of --cutoff"
        )
    law = PLaw(**given)
    law.check()
    averages = asked["averages"]
    records = [read_frequency_response(one, averages=averages) for one in source]
    found = measured_question(records, law, sigmas=asked["sigmas"], margin=asked["margin"])
    names = [Path(one).name for one in source]
    for name, test in zip(names, found.tests, strict=True):
        out.print(answer_table(f"{name}: |Q (1 - L P)| + |Q L| s on its lines", _rows(test)))
    out.print(offers_table(found.now, found.offers, asked["margin"]))
    curves = {name: test.curves for name, test in zip(names, found.tests, strict=True)}
    figure = figures.q_filter_figure(curves, margin=asked["margin"])
    paths = [figures.save(figure, place() / "filter.png")]
    lines = [_verdict(names, found, asked["sigmas"]), _between(found)]
    numbers = _numbers(names, found)
    if asked["synthesise"]:
        made, line, path = _synthesised(
            [lines_of(one, law, asked["sigmas"]) for one in records], law, found, asked, place()
        )
        lines.append(line)
        paths.append(path)
        numbers["synthesis"] = made
    lines += _next(source, law, found, asked["margin"])
    return numbers | {"lines": lines}, paths


def _rows(test: RecordTest) -> list[tuple[str, str]]:
    resonances = [
        f"{number(one.frequency)} Hz: {one.lines:.1f} lines in its width of {number(one.width)} Hz"
        + ("" if one.fine else ", too few")
        for one in test.resonances
    ]
    rows = [
        ("lines", f"{len(test.curves.f)}, {number(test.ends[0])} to {number(test.ends[1])} Hz"),
        ("largest", f"{number(test.peak)} at {number(test.worst)} Hz, scatter included"),
        ("margin", number(1 - test.peak)),
        ("|1 - L P| above 1 without Q", first_above(test.curves)),
        ("resonances", "; ".join(resonances) or "none stands out by 3 dB"),
        ("error learned to 1/10", f"up to {number(test.curves.learned_up_to)} Hz"),
    ]
    if test.unseen > UNSEEN:
        beyond = f"above {number(test.ends[1])} Hz, where Q still is {number(test.unseen)}"
        rows.append(("not measured", beyond))
    return rows


def _verdict(names: list[str], found: MeasuredQuestion, sigmas: float) -> str:
    test = found.tests[found.top]
    where = f"at {number(test.worst)} Hz" + (f" in {names[found.top]}" if len(names) > 1 else "")
    law = f"with {sigmas:g} standard deviations of scatter"
    if found.peak < 1:
        return (
            f"Safe on every line {law}: |Q (1 - L P)| + |Q L| s is at most {number(found.peak)}, "
            f"a margin of {number(1 - found.peak)}; it is largest {where}."
        )
    return f"Not safe {law}: |Q (1 - L P)| + |Q L| s reaches {number(found.peak)} {where}."


def _between(found: MeasuredQuestion) -> str:
    """What is not proved, in words."""
    coarse = [one for test in found.tests for one in test.resonances if not one.fine]
    said = "Between the lines, below the first and above the last nothing is proved"
    if coarse:
        one = min(coarse, key=lambda one: one.lines)
        return (
            f"{said}, and the resonance at {number(one.frequency)} Hz has {one.lines:.1f} lines in "
            f"its width of {number(one.width)} Hz: measure it with lines of "
            f"{number(one.width / 4)} Hz or less."
        )
    return f"{said}; the lines are fine enough for the resonances that they show."


def _next(source: list[str], law, found: MeasuredQuestion, margin: float) -> list[str]:
    """How far the law may go, and the next command, each a line."""
    best = best_of(found.offers)
    if best is None:
        return [f"No cutoff keeps a margin of {margin:g}: take a lower --gain or another --lead."]
    values = law._asdict() | best.settings
    command = ["jaxilc", "filter", *source]
    for name in ("gain", "lead", "cutoff", "order", "dt"):
        command += [f"--{name}", f"{values[name]:g}"]
    return [
        f"With a margin of {margin:g} a repeated error may be learned to a tenth up to "
        f"{number(best.learned_up_to)} Hz.",
        f"Next: {shlex.join(command)}",
    ]


def _numbers(names: list[str], found: MeasuredQuestion) -> dict[str, Any]:
    return {
        "safe": bool(found.peak < 1),
        "peak": found.peak,
        "margin": 1 - found.peak,
        "records": {
            name: {
                "peak": test.peak,
                "frequency": test.worst,
                "resonances": [one._asdict() for one in test.resonances],
                "without_filter_above_1_from": test.curves.first_above,
                "curves": curve_numbers(test.curves),
            }
            for name, test in zip(names, found.tests, strict=True)
        },
        "now": offer_numbers(found.now),
        "offers": [offer_numbers(one) for one in found.offers],
    }


def _synthesised(lines, law, found: MeasuredQuestion, asked, folder: Path):
    """Synthesise filters on the lines and write their table."""
    from ..scenarios.scheme_table import write_with_scheme
    from ..tuning.synthesis import synthesised

    best = best_of(found.offers)
    furthest = min(float(one.f[-1]) for one in lines)
    band = asked["band"] or min(2 * (best.change.cutoff if best else law.cutoff), furthest)
    lead = law.lead + (best.change.lead if best else 0)
    made = synthesised(lines, band=band, margin=asked["margin"], taps=asked["taps"], lead=lead)
    path, _ = write_with_scheme(folder / "synthesised.toml", "", "fir", made.scheme)
    said = (
        f"Synthesised with {asked['taps']} taps: |Q - M P| + |M| s is at most "
        f"{number(made.peak)} on the lines; {path} is its table for a plant file."
    )
    if made.spacing > 0.5:
        said += (
            f" The lines lie {made.spacing:.2g} / (duration of the taps) apart: fewer --taps or "
            "finer lines, or the filters may be large between them."
        )
    return {"peak": made.peak, "loss": made.loss, "band": band, "file": str(path)}, said, path
