"""The answers of `jaxilc filter`: for the schemes of a scenario, and for measured responses."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from .console import out
from .tables import number
from .titled_table import Table

if TYPE_CHECKING:
    from ..scenarios import Scenario
    from ..theory.on_lines import Change
    from ..theory.q_filter import Curves, MeasuredQuestion, Offer, Question, RecordTest

LINES_A_TAP = 4  # of the grid on which filters are synthesised
UNSEEN = 0.05  # |Q| beyond the last line that is worth a warning
PASSED = 0.1  # |Q| from which on a resonance lies inside the band


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
            of_scheme, files = _scheme_answer(source, chosen, name, scheme, asked, place)
        except ValueError as error:
            if named or ("needs:" not in str(error) and "not learn" not in str(error)):
                raise
            refused.append(f"{name} is left out: {error}")
            continue
        numbers["lines"] += of_scheme.pop("lines")
        numbers["schemes"][name] = of_scheme
        paths += files
    if not numbers["schemes"]:
        raise ValueError(f"no scheme of {source} has a linear law. " + ". ".join(refused))
    numbers["lines"] = [*refused, *numbers["lines"]]
    return numbers, paths


def _scheme_answer(source, chosen, name, scheme, asked, place):
    from .. import figures
    from ..theory.q_filter import offers_of, question

    how = {key: asked[key] for key in ("machines", "sampling", "seed")}
    machine, task, uncertainty = chosen.machine, chosen.task, chosen.uncertainty
    margin, scale, unit = asked["margin"], chosen.shown_scale, chosen.shown_unit
    answered, inner = question(machine, scheme, task, uncertainty, **how)
    offers = offers_of(answered, inner, machine, scheme, task, margin)
    best = _best_of(offers)
    title = f"{name}: |Q (1 - L P)| of {len(answered.tried.loops)} machines"
    out.print(_answer_table(title, _scheme_rows(answered, uncertainty, scale, unit)))
    out.print(_offers_table(answered.now, offers, margin, scale, unit))
    lines = [
        _scheme_verdict(name, answered, uncertainty),
        _how_far(answered, best, margin, scale, unit),
    ]
    curves, files, made = {name: answered.curves}, [], None
    if asked["synthesise"]:
        made, more, path = _scheme_synthesised(
            source, chosen, name, scheme, answered, inner, best, asked, place()
        )
        curves[f"{name}, synthesised"] = more.curves
        files.append(path)
        lines.append(made.pop("line"))
    figure = figures.q_filter_figure(curves, margin=margin, unit=_unit_of_plant(task))
    files.append(figures.save(figure, place() / f"{name}.png"))
    if best is not None and best.adds_filter:
        line, path = _with_filter(source, name, scheme, answered, best, place())
        files.append(path)
    else:
        line = _scheme_next(source, name, answered, best)
    numbers = _scheme_numbers(answered, offers, scale, [*lines, line]) | {"synthesis": made}
    return numbers, files


def _with_filter(source, name, scheme, answered: Question, best: Offer, folder: Path):
    """Write the law with the filter that is offered; the next command, and the file."""
    from ..scenarios.scheme_table import write_with_scheme
    from ..theory.q_filter import scheme_of

    filtered, named = scheme_of(scheme, answered.places, best.change), f"{name}-filtered"
    path, ready = write_with_scheme(folder / f"{named}.toml", source, named, filtered)
    certify = f"jaxilc certify {path} --scheme {named}"
    return f"Next: {certify if ready else f'add {path} to a plant file and certify it'}", path


def _scheme_rows(answered: Question, uncertainty, scale, unit) -> list[tuple[str, str]]:
    tried, curves, top = answered.tried, answered.curves, answered.tried.top
    rows = [
        ("largest", f"{number(tried.values[top])} at {number(tried.worst[top])} Hz"),
        ("its machine", _machine_said(tried.at, uncertainty) or "the nominal one"),
        ("nominal machine", f"{number(tried.values[0])} at {number(tried.worst[0])} Hz"),
        ("of the whole set", _proved(answered)),
        ("margin", f"{number(1 - answered.peak)}, least at {number(tried.worst[top])} Hz"),
        ("|1 - L P| above 1 without Q", _first_above(curves)),
    ]
    at = [one.frequency for one in answered.resonances]
    shown = [
        f"{number(one.frequency)} Hz (damping {number(one.damping)})"
        for one, passed in zip(answered.resonances, _inside(curves, at), strict=True)
        if passed
    ]
    rows.append(("resonances that Q passes", ", ".join(shown) or "none"))
    if answered.peak < 1:
        rows.append(("error learned to 1/10", f"up to {number(curves.learned_up_to)} Hz"))
    if np.isfinite(answered.now.floor):
        left = f"{number(scale * answered.now.floor)} {unit or 'units of y'} rms, nominal machine"
        rows.append(("error left at the limit", left))
    if answered.rounding > 0:
        left = f"{number(scale * answered.rounding)} {unit or 'units of y'} rms, nominal machine"
        bounded = np.isfinite(answered.rounding)
        rows.append(("rounding adds", f"at most {left}" if bounded else "no bound is known"))
    return rows


def _proved(answered: Question) -> str:
    if answered.proof.proved:
        return f"at most {number(answered.proof.bound)}, proved: {answered.proof.how}"
    return f"not proved: {answered.proof.how}"


def _scheme_verdict(name: str, answered: Question, uncertainty) -> str:
    tried, value = answered.tried, answered.peak
    over = f" for {_intervals_said(uncertainty)}" if uncertainty else " for the nominal machine"
    where = f"at {number(tried.worst[tried.top])} Hz"
    at = _machine_said(tried.at, uncertainty)
    where += f" on the machine {at}" if at else ""
    if np.max(tried.radii) >= 1 - 1e-9:
        return f"{name}: nothing is claimed{over}: a loop without learning is not stable."
    if value < 1:
        rest = "proved for all of them" if answered.proof.proved else "on the machines tried"
        return (
            f"{name}: safe{over}: |Q (1 - L P)| is at most {number(value)} ({rest}), a margin of "
            f"{number(1 - value)}; it is largest {where}."
        )
    return (
        f"{name}: not safe{over}: |Q (1 - L P)| reaches {number(value)} {where}; what is learned "
        "there grows, or never comes nearer to its limit."
    )


def _how_far(answered: Question, best: Offer | None, margin: float, scale, unit) -> str:
    if best is None:
        return f"No cutoff, gain or lead keeps a margin of {margin:g}: another law is needed."
    bought = f"a repeated error is learned to a tenth up to {number(best.learned_up_to)} Hz"
    if np.isfinite(best.floor) and np.isfinite(answered.now.floor):
        bought += (
            f", and {number(scale * best.floor)} {unit} rms is left instead of "
            f"{number(scale * answered.now.floor)} {unit}"
        )
    return f"With a margin of {margin:g} it may go to {_changes_said(best)}: {bought}."


def _scheme_next(source: str, name: str, answered: Question, best: Offer | None) -> str:
    command = ["jaxilc", "certify", source, "--scheme", name]
    if answered.peak >= 1 and best is None:
        return f"Next: a lower gain or another law in {source}; `jaxilc tune --help` says how."
    if best is not None and best.settings and (answered.peak >= 1 or best.peak < 1):
        for setting in _settings_of(best.settings, f"{name}."):
            command += ["--set", setting]
    return f"Next, the whole trial with its ends: {shlex.join(command)}"


def _scheme_numbers(answered: Question, offers, scale, lines) -> dict[str, Any]:
    tried, top = answered.tried, answered.tried.top
    return {
        "safe": bool(answered.peak < 1),
        "peak": answered.peak,
        "margin": 1 - answered.peak,
        "largest_found": float(tried.values[top]),
        "frequency": float(tried.worst[top]),
        "machine": tried.at,
        "nominal": float(tried.values[0]),
        "machines": len(tried.loops),
        "proved": answered.proof.proved,
        "proof": answered.proof.how,
        "bound": answered.proof.bound,
        "without_filter_above_1_from": answered.curves.first_above,
        "resonances": [one._asdict() for one in answered.resonances],
        "now": _offer_numbers(answered.now, scale),
        "rounding": scale * answered.rounding,
        "offers": [_offer_numbers(one, scale) for one in offers],
        "curves": _curve_numbers(answered.curves),
        "lines": lines,
    }


def _unit_of_plant(task) -> str:
    return f"{task.unit}/{task.input_unit}" if task.unit and task.input_unit else ""


def _scheme_synthesised(source, chosen, name, scheme, answered, inner, best, asked, folder):
    """Synthesise filters, test them, and write them: numbers, question and file."""
    from ..scenarios.scheme_table import write_with_scheme
    from ..theory.loop import responses
    from ..theory.on_lines import Lines
    from ..theory.q_filter import question, with_law
    from ..tuning.synthesis import synthesised

    dt, tried = float(chosen.task.dt), answered.tried
    f = np.linspace(0, 0.5 / dt, LINES_A_TAP * asked["taps"] + 1)[1:]
    poles = [one.frequency for one in answered.resonances]
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
        "now": _offer_numbers(tested.now, scale),
    }
    return numbers | {"line": line, "file": str(path)}, tested, path


def _lead_of(inner, best) -> float:
    """The lead of the law as it is, by the slope of its phase at low frequencies, with the best."""
    slow = inner.f < 0.02 / inner.dt
    turn = np.unwrap(np.angle(inner.L[slow]))
    slope = np.polyfit(2 * np.pi * inner.f[slow] * inner.dt, turn, 1)[0]
    return max(slope - 1 + (best.change.lead if best else 0), 0.0)


# Measured responses
# --------------------------------------------------------------------------------------------------


def records_answer(
    source: list[str], law_options: dict[str, Any], asked: dict[str, Any], place: Callable[[], Path]
) -> tuple[dict[str, Any], list[Path]]:
    """Print the answer for a P-type law on records; its numbers, and the files written.

    place: makes the folder for results
    Raises ValueError for an option that is missing or out of its range, as `measured_question`.
    """
    from .. import figures
    from ..identification.frequency_response import read_frequency_response
    from ..theory.q_filter import PLaw, lines_of, measured_question

    missing = [f"--{name}" for name in ("gain", "cutoff", "dt") if law_options[name] is None]
    if missing:
        raise ValueError(
            f"a measured response needs a law: {', '.join(missing)} not given; u is learned by "
            "u + gain e[k + 1 + lead] with a low-pass of --cutoff"
        )
    law = PLaw(**law_options)
    law.check()
    averages = asked["averages"]
    records = [read_frequency_response(one, averages=averages) for one in source]
    answered = measured_question(records, law, sigmas=asked["sigmas"], margin=asked["margin"])
    names = [Path(one).name for one in source]
    for name, test in zip(names, answered.tests, strict=True):
        out.print(
            _answer_table(f"{name}: |Q (1 - L P)| + |Q L| s on its lines", _record_rows(test))
        )
    out.print(_offers_table(answered.now, answered.offers, asked["margin"]))
    curves = {name: test.curves for name, test in zip(names, answered.tests, strict=True)}
    figure = figures.q_filter_figure(curves, margin=asked["margin"])
    paths = [figures.save(figure, place() / "filter.png")]
    lines = [_records_verdict(names, answered, asked["sigmas"]), _between(answered)]
    numbers = _records_numbers(names, answered)
    if asked["synthesise"]:
        made, line, path = _records_synthesised(
            [lines_of(one, law, asked["sigmas"]) for one in records], law, answered, asked, place()
        )
        lines.append(line)
        paths.append(path)
        numbers["synthesis"] = made
    lines += _records_next(source, law, answered, asked["margin"])
    return numbers | {"lines": lines}, paths


def _record_rows(test: RecordTest) -> list[tuple[str, str]]:
    resonances = [
        f"{number(one.frequency)} Hz: {one.lines:.1f} lines in its width of {number(one.width)} Hz"
        + ("" if one.fine else ", too few")
        for one in test.resonances
    ]
    rows = [
        ("lines", f"{len(test.curves.f)}, {number(test.ends[0])} to {number(test.ends[1])} Hz"),
        ("largest", f"{number(test.peak)} at {number(test.worst)} Hz, scatter included"),
        ("margin", number(1 - test.peak)),
        ("|1 - L P| above 1 without Q", _first_above(test.curves)),
        ("resonances", "; ".join(resonances) or "none stands out by 3 dB"),
        ("error learned to 1/10", f"up to {number(test.curves.learned_up_to)} Hz"),
    ]
    if test.unseen > UNSEEN:
        beyond = f"above {number(test.ends[1])} Hz, where Q still is {number(test.unseen)}"
        rows.append(("not measured", beyond))
    return rows


def _records_verdict(names: list[str], answered: MeasuredQuestion, sigmas: float) -> str:
    test = answered.tests[answered.top]
    where = f"at {number(test.worst)} Hz" + (f" in {names[answered.top]}" if len(names) > 1 else "")
    law = f"with {sigmas:g} standard deviations of scatter"
    if answered.peak < 1:
        return (
            f"Safe on every line {law}: |Q (1 - L P)| + |Q L| s is at most "
            f"{number(answered.peak)}, a margin of {number(1 - answered.peak)}; it is largest "
            f"{where}."
        )
    return f"Not safe {law}: |Q (1 - L P)| + |Q L| s reaches {number(answered.peak)} {where}."


def _between(answered: MeasuredQuestion) -> str:
    """What is not proved, in words."""
    coarse = [one for test in answered.tests for one in test.resonances if not one.fine]
    said = "Between the lines, below the first and above the last nothing is proved"
    if coarse:
        one = min(coarse, key=lambda one: one.lines)
        return (
            f"{said}, and the resonance at {number(one.frequency)} Hz has {one.lines:.1f} lines in "
            f"its width of {number(one.width)} Hz: measure it with lines of "
            f"{number(one.width / 4)} Hz or less."
        )
    return f"{said}; the lines are fine enough for the resonances that they show."


def _records_next(source: list[str], law, answered: MeasuredQuestion, margin: float) -> list[str]:
    """How far the law may go, and the next command, each a line."""
    best = _best_of(answered.offers)
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


def _records_numbers(names: list[str], answered: MeasuredQuestion) -> dict[str, Any]:
    return {
        "safe": bool(answered.peak < 1),
        "peak": answered.peak,
        "margin": 1 - answered.peak,
        "records": {
            name: {
                "peak": test.peak,
                "frequency": test.worst,
                "resonances": [one._asdict() for one in test.resonances],
                "without_filter_above_1_from": test.curves.first_above,
                "curves": _curve_numbers(test.curves),
            }
            for name, test in zip(names, answered.tests, strict=True)
        },
        "now": _offer_numbers(answered.now),
        "offers": [_offer_numbers(one) for one in answered.offers],
    }


def _records_synthesised(lines, law, answered: MeasuredQuestion, asked, folder: Path):
    """Synthesise filters on the lines and write their table."""
    from ..scenarios.scheme_table import write_with_scheme
    from ..tuning.synthesis import synthesised

    best = _best_of(answered.offers)
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


# Both
# --------------------------------------------------------------------------------------------------


def _answer_table(title: str, rows: Sequence[tuple[str, str]]) -> Table:
    """The table of what was found, a row for each."""
    table = Table(title=title, show_header=False)
    table.add_column()
    table.add_column()
    for row in rows:
        table.add_row(*row)
    return table


def _offers_table(now: Offer, offers: Sequence[Offer], margin: float, scale=1.0, unit="") -> Table:
    """The table of how far the law may go; the error that is left only where it is known."""
    known = any(np.isfinite(one.floor) for one in (now, *offers))
    table = Table(title=f"how far it may go with a margin of {margin:g}, and what that buys")
    table.add_column("law")
    table.add_column("set")
    table.add_column("largest", justify="right")
    table.add_column("learned to 1/10 up to", justify="right")
    if known:
        table.add_column(f"rms left [{unit or 'y'}]", justify="right")
    for one in (now, *offers):
        reach = f"{number(one.learned_up_to)} Hz" if one.peak < 1 else "–"
        left = [number(scale * one.floor)] if known else []
        table.add_row(
            one.what,
            _changes_said(one),
            number(one.peak),
            reach,
            *left,
        )
    return table


def _changes_said(one: Offer) -> str:
    """What an offer sets, and the filter that it adds where the law has none."""
    parts = _settings_of(one.settings)
    if one.adds_filter:
        parts.append(f"a filter of {one.change.cutoff:g} Hz")
    return ", ".join(parts) or "–"


def _settings_of(values: Mapping[str, Any], before: str = "") -> list[str]:
    """Values as `--set` takes them."""
    return [f"{before}{path}={_plain(value)}" for path, value in values.items()]


def _plain(value) -> str:
    array = np.asarray(value)
    if array.ndim:
        return "[" + ",".join(f"{v:.4g}" for v in array) + "]"
    return f"{array.item():.6g}"


def _inside(curves: Curves, frequencies: Sequence[float]) -> list[bool]:
    """Whether the filter passes a frequency."""
    return [bool(np.interp(f, curves.f, np.abs(curves.Q)) > PASSED) for f in frequencies]


def _first_above(curves: Curves) -> str:
    """Where |1 - L P| first exceeds 1 without the filter, in words."""
    at = curves.first_above
    return f"from {number(at)} Hz" if np.isfinite(at) else "nowhere"


def _best_of(offers: Sequence[Offer]) -> Offer | None:
    """The offer that learns furthest."""
    return max(offers, key=lambda one: one.learned_up_to, default=None)


def _offer_numbers(one: Offer, scale: float = 1.0) -> dict[str, Any]:
    """An offer as JSON; the error that is left in the unit shown."""
    change: Change = one.change
    return {
        "what": one.what,
        "set": {path: np.asarray(value).tolist() for path, value in one.settings.items()},
        "gain_factor": change.gain,
        "lead_change": change.lead,
        "cutoff": change.cutoff,
        "peak": one.peak,
        "margin": 1 - one.peak,
        "learned_to_a_tenth_up_to": one.learned_up_to,
        "rms_left": scale * one.floor,
    }


def _curve_numbers(curves: Curves) -> dict[str, list[float]]:
    """The curves of the figure as JSON."""
    lists = {name: getattr(curves, name).tolist() for name in ("f", "nominal", "low", "high")}
    return lists | {"Q": np.abs(curves.Q).tolist(), "LP": np.abs(curves.LP).tolist()}


def _intervals_said(uncertainty: Mapping[str, Any]) -> str:
    """The uncertainty in words, as `plant.gain ±15 %`."""
    parts = []
    for name, d in uncertainty.items():
        low, high = sorted(map(float, d.corners()))
        even = d.relative and abs((low + high) / 2 - 1) < 1e-9
        parts.append(
            f"{name} ±{50 * (high - low):.3g} %"
            if even
            else f"{name} {'x ' if d.relative else ''}{low:.4g} to {high:.4g}"
        )
    return " and ".join(parts)


def _machine_said(at: Mapping[str, float], uncertainty: Mapping[str, Any]) -> str:
    """The numbers of a machine in words; relative ones as factors."""
    return ", ".join(
        f"{name} {'x ' if uncertainty[name].relative else '= '}{value:.4g}"
        for name, value in at.items()
    )
