"""The answer of `jaxilc filter` for the schemes of a scenario."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from .console import out
from .q_filter_tables import (
    answer_table,
    best_of,
    changes_said,
    curve_numbers,
    first_above,
    inside,
    intervals_said,
    machine_said,
    offer_numbers,
    offers_table,
    settings_of,
)
from .tables import number

if TYPE_CHECKING:
    from ..scenarios import Scenario
    from ..theory.q_filter import Offer, Question

LINES_A_TAP = 4  # of the grid on which filters are synthesised


def scenario_answer(
    source: str, chosen: Scenario, asked: dict[str, Any], *, named: bool, place: Callable[[], Path]
) -> tuple[dict[str, Any], list[Path]]:
    """Print the answer for each scheme with a linear law; its numbers, and the files written.

    named: whether schemes were asked for by name, which then must be linear
    place: makes the folder for results
    Raises ValueError where no scheme has a linear law.
    """
    numbers: dict[str, Any] = {"schemes": {}, "lines": []}
    paths, refused = [], []
    for name, scheme in chosen.schemes.items():
        try:
            found, files = _scheme_answer(source, chosen, name, scheme, asked, place)
        except ValueError as error:
            if named or ("needs:" not in str(error) and "not learn" not in str(error)):
                raise
            refused.append(f"{name} is left out: {error}")
            continue
        numbers["lines"] += found.pop("lines")
        numbers["schemes"][name] = found
        paths += files
    if not numbers["schemes"]:
        raise ValueError(f"no scheme of {source} has a linear law. " + ". ".join(refused))
    numbers["lines"] = [*refused, *numbers["lines"]]
    return numbers, paths


def _scheme_answer(source, chosen, name, scheme, asked, place):
    from .. import figures
    from ..theory.offers import offers_of
    from ..theory.q_filter import question

    how = {key: asked[key] for key in ("machines", "sampling", "seed")}
    machine, task, uncertainty = chosen.machine, chosen.task, chosen.uncertainty
    margin, scale, unit = asked["margin"], chosen.shown_scale, chosen.shown_unit
    found, inner = question(machine, scheme, task, uncertainty, **how)
    offers = offers_of(found, inner, machine, scheme, task, margin)
    best = best_of(offers)
    title = f"{name}: |Q (1 - L P)| of {len(found.tried.loops)} machines"
    out.print(answer_table(title, _rows(found, uncertainty, scale, unit)))
    out.print(offers_table(found.now, offers, margin, scale, unit))
    lines = [_verdict(name, found, uncertainty), _how_far(found, best, margin, scale, unit)]
    curves, files, made = {name: found.curves}, [], None
    if asked["synthesise"]:
        made, more, path = _synthesised(
            source, chosen, name, scheme, found, inner, best, asked, place()
        )
        curves[f"{name}, synthesised"] = more.curves
        files.append(path)
        lines.append(made.pop("line"))
    figure = figures.q_filter_figure(curves, margin=margin, unit=_unit_of_plant(task))
    files.append(figures.save(figure, place() / f"{name}.png"))
    if best is not None and best.adds_filter:
        line, path = _with_filter(source, name, scheme, found, best, place())
        files.append(path)
    else:
        line = _next(source, name, found, best)
    numbers = _numbers(found, offers, scale, [*lines, line]) | {"synthesis": made}
    return numbers, files


def _with_filter(source, name, scheme, found: Question, best: Offer, folder: Path):
    """Write the law with the filter that is offered; the next command, and the file."""
    from ..scenarios.scheme_table import write_with_scheme
    from ..theory.offers import scheme_of

    filtered, named = scheme_of(scheme, found.places, best.change), f"{name}-filtered"
    path, ready = write_with_scheme(folder / f"{named}.toml", source, named, filtered)
    certify = f"jaxilc certify {path} --scheme {named}"
    return f"Next: {certify if ready else f'add {path} to a plant file and certify it'}", path


def _rows(found: Question, uncertainty, scale, unit) -> list[tuple[str, str]]:
    tried, curves, top = found.tried, found.curves, found.tried.top
    rows = [
        ("largest", f"{number(tried.values[top])} at {number(tried.worst[top])} Hz"),
        ("its machine", machine_said(tried.at, uncertainty) or "the nominal one"),
        ("nominal machine", f"{number(tried.values[0])} at {number(tried.worst[0])} Hz"),
        ("of the whole set", _proved(found)),
        ("margin", f"{number(1 - found.peak)}, least at {number(tried.worst[top])} Hz"),
        ("|1 - L P| above 1 without Q", first_above(curves)),
    ]
    at = [one.frequency for one in found.resonances]
    shown = [
        f"{number(one.frequency)} Hz (damping {number(one.damping)})"
        for one, passed in zip(found.resonances, inside(curves, at), strict=True)
        if passed
    ]
    rows.append(("resonances that Q passes", ", ".join(shown) or "none"))
    if found.peak < 1:
        rows.append(("error learned to 1/10", f"up to {number(curves.learned_up_to)} Hz"))
    if np.isfinite(found.now.floor):
        left = f"{number(scale * found.now.floor)} {unit or 'units of y'} rms, nominal machine"
        rows.append(("error left at the limit", left))
    if found.rounding > 0:
        left = f"{number(scale * found.rounding)} {unit or 'units of y'} rms, nominal machine"
        bounded = np.isfinite(found.rounding)
        rows.append(("rounding adds", f"at most {left}" if bounded else "no bound is known"))
    return rows


def _proved(found: Question) -> str:
    if found.proof.proved:
        return f"at most {number(found.proof.bound)}, proved: {found.proof.how}"
    return f"not proved: {found.proof.how}"


def _verdict(name: str, found: Question, uncertainty) -> str:
    tried, value = found.tried, found.peak
    over = f" for {intervals_said(uncertainty)}" if uncertainty else " for the nominal machine"
    where = f"at {number(tried.worst[tried.top])} Hz"
    at = machine_said(tried.at, uncertainty)
    where += f" on the machine {at}" if at else ""
    if np.max(tried.radii) >= 1 - 1e-9:
        return f"{name}: nothing is claimed{over}: a loop without learning is not stable."
    if value < 1:
        rest = "proved for all of them" if found.proof.proved else "on the machines tried"
        return (
            f"{name}: safe{over}: |Q (1 - L P)| is at most {number(value)} ({rest}), a margin of "
            f"{number(1 - value)}; it is largest {where}."
        )
    return (
        f"{name}: not safe{over}: |Q (1 - L P)| reaches {number(value)} {where}; what is learned "
        "there grows, or never comes nearer to its limit."
    )


def _how_far(found: Question, best: Offer | None, margin: float, scale, unit) -> str:
    if best is None:
        return f"No cutoff, gain or lead keeps a margin of {margin:g}: another law is needed."
    bought = f"a repeated error is learned to a tenth up to {number(best.learned_up_to)} Hz"
    if np.isfinite(best.floor) and np.isfinite(found.now.floor):
        bought += (
            f", and {number(scale * best.floor)} {unit} rms is left instead of "
            f"{number(scale * found.now.floor)} {unit}"
        )
    return f"With a margin of {margin:g} it may go to {changes_said(best)}: {bought}."


def _next(source: str, name: str, found: Question, best: Offer | None) -> str:
    command = ["jaxilc", "certify", source, "--scheme", name]
    if found.peak >= 1 and best is None:
        return f"Next: a lower gain or another law in {source}; `jaxilc tune --help` says how."
    if best is not None and best.settings and (found.peak >= 1 or best.peak < 1):
        for setting in settings_of(best.settings, f"{name}."):
            command += ["--set", setting]
    return f"Next, the whole trial with its ends: {shlex.join(command)}"


def _numbers(found: Question, offers, scale, lines) -> dict[str, Any]:
    tried, top = found.tried, found.tried.top
    return {
        "safe": bool(found.peak < 1),
        "peak": found.peak,
        "margin": 1 - found.peak,
        "largest_found": float(tried.values[top]),
        "frequency": float(tried.worst[top]),
        "machine": tried.at,
        "nominal": float(tried.values[0]),
        "machines": len(tried.loops),
        "proved": found.proof.proved,
        "proof": found.proof.how,
        "bound": found.proof.bound,
        "without_filter_above_1_from": found.curves.first_above,
        "resonances": [one._asdict() for one in found.resonances],
        "now": offer_numbers(found.now, scale),
        "rounding": scale * found.rounding,
        "offers": [offer_numbers(one, scale) for one in offers],
        "curves": curve_numbers(found.curves),
        "lines": lines,
    }


def _unit_of_plant(task) -> str:
    return f"{task.unit}/{task.input_unit}" if task.unit and task.input_unit else ""


def _synthesised(source, chosen, name, scheme, found, inner, best, asked, folder):
    """Synthesise filters, test them, and write them: numbers, question and file."""
    from ..scenarios.scheme_table import write_with_scheme
    from ..theory.filtered_law import Lines
    from ..theory.loop import responses
    from ..theory.parts_of_law import with_law
    from ..theory.q_filter import question
    from ..tuning.synthesis import synthesised

    dt, tried = float(chosen.task.dt), found.tried
    f = np.linspace(0, 0.5 / dt, LINES_A_TAP * asked["taps"] + 1)[1:]
    poles = [one.frequency for one in found.resonances]
    f = np.unique(np.r_[f[0] / 10, f, poles])
    f = f[(f > 0) & (f <= 0.5 / dt)]
    P = responses(tried.loops, f, dt)
    one = np.ones(len(f), complex)
    band = asked["band"] or min(2 * (best.change.cutoff if best else 0.025 / dt), 0.4 / dt)
    lead = int(np.max(inner.L.size and np.round(_lead_of(inner, best)), initial=0))
    made = synthesised(
        [Lines(f, P, np.zeros(P.shape), one, one, dt)],
        band=band,
        margin=asked["margin"],
        taps=asked["taps"],
        lead=lead,
    )
    whole = with_law(scheme, made.scheme)
    how = {key: asked[key] for key in ("machines", "sampling", "seed")}
    tested, _ = question(chosen.machine, whole, chosen.task, chosen.uncertainty, **how)
    path, ready = write_with_scheme(
        folder / f"{name}-synthesised.toml", source, f"{name}-fir", whole
    )
    scale, unit = chosen.shown_scale, chosen.shown_unit
    take = f"jaxilc certify {path} --scheme {name}-fir" if ready else f"add {path} to a plant file"
    take = take if tested.peak < 1 else "not safe: more --taps or a smaller --band"
    line = (
        f"Synthesised with {asked['taps']} taps: |Q (1 - L P)| is at most {number(tested.peak)}, "
        f"learned to a tenth up to {number(tested.curves.learned_up_to)} Hz, "
        f"{number(scale * tested.now.floor)} {unit} rms left; {take}."
    )
    numbers = {
        "peak": tested.peak,
        "band": band,
        "loss": made.loss,
        "now": offer_numbers(tested.now, scale),
    }
    return numbers | {"line": line, "file": str(path)}, tested, path


def _lead_of(inner, best) -> float:
    """The lead of the law as it is, by the slope of its phase at low frequencies, with the best."""
    slow = inner.f < 0.02 / inner.dt
    turn = np.unwrap(np.angle(inner.L[slow]))
    slope = np.polyfit(2 * np.pi * inner.f[slow] * inner.dt, turn, 1)[0]
    return max(slope - 1 + (best.change.lead if best else 0), 0.0)
