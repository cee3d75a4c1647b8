"""`filter`: whether a Q-filter is safe, by how much, and how far one may go."""

from __future__ import annotations

import dataclasses
import shlex
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from .. import figures
from ..identification.frequency_response import read_frequency_response
from ..scenarios import Scenario
from ..scenarios.design_file import write_with_scheme
from ..schemes import Scheme
from ..theory import q_filter
from ..theory.loop import responses
from ..theory.on_lines import Curves, Lines
from ..theory.q_filter import (
    MeasuredQuestion,
    Offer,
    PLaw,
    Question,
    RecordTest,
    lines_of,
    with_law,
)
from ..tuning.synthesis import need_taps, synthesised
from ..uncertainty import Uncertainty, Uniform, check
from .outcome import Figure, Numbers, Outcome, Progress, Table, Verdict, silent
from .request import Request
from .words import beside_1, machine_said, number, several

ORDER = 2  # of one pass of the filter of a measured law
LINES_A_TAP = 4  # of the grid on which filters are synthesised
UNSEEN = 0.05  # |Q| beyond the last line that is worth a warning
PASSED = 0.1  # |Q| from which on a resonance lies inside the band
_answers = partial(Table, "", "", show_header=False)  # of a title, and rows of two texts
NO_SCATTER = (
    "{}: no scatter of its lines is told, so that none is allowed for, and the law may be unsafe "
    "on a machine off them; add a column std, variance or coherence."
)
CAPTION = "Whether the Q-filter is safe: |Q (1 - L P)| must stay below 1."


def filter_(
    request: Request | str | Path,
    *,
    margin: float = 0.1,
    vary: Sequence[str] = (),
    machines: int = 32,
    seed: int = 0,
    sampling: str = "latin-hypercube",
    taps: int | None = None,
    band: float | None = None,
    folder: str | Path | None = None,
    progress: Progress = silent,
) -> Outcome:
    """Whether the filters of a scenario are safe on all machines, and how far they may go.

    |Q (1 - L P)| below 1 at every frequency, with the largest cutoff, gain and lead that keep a
    margin, for each scheme with a linear law.

    request: a scenario or a plant file; schemes that are named must have a linear law
    margin: 1 - |Q (1 - L P)| that an offer keeps
    vary: texts PATH=SHARE in place of the uncertainty, as plant.gain=15%
    machines, seed, sampling: of the machines drawn, beside all corners
    taps: of each filter that is found by convex optimisation besides; None for none
    band: up to where these filters learn [Hz]; twice the largest cutoff if not given
    folder: for the figures and the plant files; out/filter-NAME if not given
    Raises ValueError naming what is allowed, and where no scheme has a linear law.
    """
    request = Request.of(request)
    _check(margin, taps, machines)
    chosen, beside = _varied(request, vary)
    place = Path(folder or f"out/filter-{chosen.name}")
    ask = partial(
        q_filter.question, chosen.machine, task=chosen.task, uncertainty=chosen.uncertainty,
        machines=machines, sampling=sampling, seed=seed,
    )  # fmt: skip
    answers: dict[str, Outcome] = {}
    refused = []
    for done, (name, scheme) in enumerate(chosen.schemes.items()):
        progress(name, done, len(chosen.schemes))
        asked = _Asked(request, beside, chosen, name, scheme, ask, margin, taps, band, place)
        try:
            answers[name] = _scheme_answer(asked)
        except ValueError as error:
            known = "needs:" in str(error) or "not learn" in str(error)
            if request.schemes or not known:
                raise
            refused.append(f"{name} is left out: {error}")
    if not answers:
        why = ". ".join(refused)
        raise ValueError(f"no scheme of {request.source} has a linear law. {why}")
    *others, last = (one.verdict for one in answers.values())
    before = [*refused, *(line for one in others for line in one.lines)]
    return Outcome(
        command="filter",
        numbers={
            "source": [request.source],
            "margin": margin,
            "schemes": {name: one.numbers for name, one in answers.items()},
            "lines": [*before, *last.lines],
        },
        verdict=last._replace(said=(*before, *last.said)),
        folder=place,
        scenario=chosen,
        tables=[table for one in answers.values() for table in one.tables],
        figures={name: one.figures[name] for name, one in answers.items()},
        kept=[file for one in answers.values() for file in one.kept],
    )


def filter_measured(
    records: str | Path | Sequence[str | Path],
    *,
    gain: float,
    cutoff: float,
    dt: float,
    lead: int = 0,
    order: int = ORDER,
    sigmas: float = 3.0,
    averages: int | None = None,
    margin: float = 0.1,
    taps: int | None = None,
    band: float | None = None,
    folder: str | Path | None = None,
    progress: Progress = silent,
) -> Outcome:
    """Whether a P-type law with a Q-filter is safe on measured frequency responses.

    records: files of frequency responses of one machine or of a family
    gain, cutoff, dt, lead, order: of the law, see `PLaw`
    sigmas: scatter allowed for [standard deviations of a line]
    averages: behind the coherence of a record; None for those in its heading
    margin, taps, band, folder: as for `filter_`
    Raises ValueError for a number out of its range, and as `measured_question`.
    """
    _check(margin, taps)
    records = [records] if isinstance(records, str | Path) else records
    law = PLaw(gain, lead, cutoff, order, dt)
    law.check()
    read = [read_frequency_response(one, averages=averages) for one in records]
    for path, one in zip(records, read, strict=True):
        if not one.averages_known:
            raise ValueError(
                f"{path}: the coherence gives a standard deviation together with the number of "
                "averages only; write it into the heading, as `coherence [16 averages]`"
            )
    progress("on the lines of the records")
    answered = q_filter.measured_question(read, law, sigmas=sigmas, margin=margin)
    names, files = [Path(one).name for one in records], [str(one) for one in records]
    names = names if len({*names}) == len(names) else files  # of several folders
    of_each = dict(zip(names, answered.tests, strict=True))
    place = Path(folder or f"out/filter-{Path(records[0]).stem}")
    told = [bool(np.any(one.std)) for one in read]
    untold = ", ".join(name for name, of in zip(names, told, strict=True) if not of)
    said = [_records_verdict(names, answered, told, sigmas, read[answered.top].averages)]
    said += [NO_SCATTER.format(untold)] * bool(untold) + [_between(answered)]
    numbers, kept = _law_numbers(answered, answered.offers), []
    numbers["records"] = {
        name: {
            "peak": test.peak,
            "frequency": test.worst,
            "resonances": [one._asdict() for one in test.resonances],
            "without_filter_above_1_from": test.curves.first_above,
            "curves": _curve_numbers(test.curves),
        }
        for name, test in of_each.items()
    }
    if taps is not None:
        lines = [lines_of(one, law, sigmas) for one in read]
        numbers["synthesis"], more = _records_synthesised(
            lines, law, answered, place, taps=taps, band=band, margin=margin
        )
        said.append(more)
        kept.append(Path(numbers["synthesis"]["file"]))
    besides: Numbers = {"sigmas": sigmas, "averages": averages, "margin": margin}
    verdict = _records_next(said, files, law, answered, besides)
    curves = {name: test.curves for name, test in of_each.items()}
    return Outcome(
        command="filter",
        numbers={"source": files, "margin": margin} | numbers | {"lines": verdict.lines},
        verdict=verdict,
        folder=place,
        tables=[
            *(
                _answers(title=f"{name}: {_size(of)} on its lines", rows=_record_rows(test, of))
                for name, test, of in zip(names, answered.tests, told, strict=True)
            ),
            _offers_table(answered.now, answered.offers, margin),
        ],
        figures={
            "filter": Figure(CAPTION, partial(figures.q_filter_figure, curves, margin=margin))
        },
        kept=kept,
    )


def _check(margin: float, taps: int | None, machines: int = 1) -> None:
    if not 0 < margin < 1:
        raise ValueError(f"--margin {margin:g} is outside its allowed range (0, 1)")
    if machines < 1:
        raise ValueError(f"--machines {machines} is outside its allowed range [1, inf)")
    if taps is not None:
        need_taps(taps)


def _varied(request: Request, vary: Sequence[str]) -> tuple[Scenario, str]:
    """The scenario, with an uncertainty PATH=SHARE if given, and what `certify` has instead."""
    if vary and request.spread is not None:
        raise ValueError("--vary and --spread exclude each other")
    shares, own = dict(map(_share, vary)), request.scenario()
    if not shares:
        return own, ""
    found = {name: Uniform(1 - s, 1 + s, relative=True) for name, s in shares.items()}
    check(own.machine, found)
    drawn = "those of [uncertainty]" if own.uncertainty else "the nominal one alone"
    beside = f" (certify has no --vary: its machines are {drawn})"
    return dataclasses.replace(own, uncertainty=found), beside


def _share(text: str) -> tuple[str, float]:
    """PATH=SHARE, where the share is a number as 0.15 or a percentage as 15%."""
    path, _, value = text.partition("=")
    try:
        share = float(value.removesuffix("%")) / (100 if value.endswith("%") else 1)
    except ValueError:
        share = float("nan")
    if not path or not 0 < share < 1:
        raise ValueError(
            f"--vary {text!r} is not PATH=SHARE with a share in (0, 1), as 0.15 or 15%"
        )
    return path.strip().removeprefix("machine."), share


# Schemes on machines
# --------------------------------------------------------------------------------------------------


class _Asked(NamedTuple):
    """What is asked of one scheme; `question` asks it of the machines that are drawn."""

    request: Request
    beside: str  # which machines `certify` has in place of these
    chosen: Scenario
    name: str
    scheme: Scheme
    question: Callable[[Scheme], tuple[Question, Lines]]
    margin: float
    taps: int | None
    band: float | None
    folder: Path

    def write(self, what: str, name: str, scheme: Scheme) -> tuple[Path, bool]:
        """Write a plant file with a scheme, and say whether a command can take it."""
        self.folder.mkdir(parents=True, exist_ok=True)
        file = self.folder / f"{self.name}-{what}.toml"
        return write_with_scheme(file, self.request.source, name, scheme)

    def certified(self, said: Sequence[str], source: str, scheme: str, *more: str) -> Verdict:
        """The verdict with the command that certifies a scheme of a file, with more settings."""
        new = {setting.partition("=")[0] for setting in more}
        given = tuple(x for x in self.request.set if x.partition("=")[0].strip() not in new)
        if source != self.request.source:  # where the scheme is new, with all of its weights
            given = tuple(x for x in given if not x.strip().startswith(f"{self.name}."))
        here = dataclasses.replace(self.request, source=source, set=(*given, *more))
        what = f"the whole trial with its ends{self.beside}"
        return Verdict(tuple(said), what, here.following("certify", scheme=scheme))


def _scheme_answer(asked: _Asked) -> Outcome:
    chosen, name, margin, scheme = asked.chosen, asked.name, asked.margin, asked.scheme
    task, over, in_unit = chosen.task, chosen.uncertainty, (chosen.shown_scale, chosen.shown_unit)
    answered, inner = asked.question(scheme)
    offered = q_filter.offers_of(answered, inner, chosen.machine, scheme, task, margin)
    best = _best_of(offered)
    said = [_scheme_verdict(name, answered, over), _how_far(answered, best, margin, *in_unit)]
    curves, kept, made = {name: answered.curves}, [], None
    if asked.taps is not None:
        made, line, better = _scheme_synthesised(asked, asked.taps, answered, inner, best)
        curves[f"{name}, synthesised"] = better
        said.append(line)
        kept.append(Path(made["file"]))
    if best is not None and best.adds_filter:
        law = q_filter.scheme_of(scheme, answered.places, best.change)
        path, ready = asked.write("filtered", f"{name}-filtered", law)
        kept.append(path)
        verdict = Verdict((*said, f"Next: add {path} to a plant file and certify it"))
        if ready:
            verdict = asked.certified(said, str(path), f"{name}-filtered")
    else:
        verdict = _scheme_next(said, asked, answered, best)
    per = f"{task.unit}/{task.input_unit}" if task.unit and task.input_unit else ""
    draw = partial(figures.q_filter_figure, curves, margin=margin, unit=per)
    title = f"{name}: |Q (1 - L P)| of {several(len(answered.tried.loops), 'machine')}"
    return Outcome(
        command="filter",
        numbers=_scheme_numbers(answered, offered, chosen.shown_scale) | {"synthesis": made},
        verdict=verdict,
        tables=[
            _answers(title=title, rows=_scheme_rows(answered, over, *in_unit)),
            _offers_table(answered.now, offered, margin, *in_unit),
        ],
        figures={name: Figure(f"{name}. {CAPTION}", draw)},
        kept=kept,
    )


def _scheme_rows(answered: Question, uncertainty, scale, unit) -> list[tuple[str, str]]:
    tried, curves, top = answered.tried, answered.curves, answered.tried.top
    bound = f"at most {beside_1(answered.proof.bound)}, proved"
    proved = bound if answered.proof.proved else "not proved"
    rms = f"{unit or 'units of y'} rms, nominal machine"
    rows = [
        ("largest", f"{beside_1(tried.values[top])} at {number(tried.worst[top])} Hz"),
        ("its machine", machine_said(tried.at, uncertainty) or "the nominal one"),
        ("nominal machine", f"{beside_1(tried.values[0])} at {number(tried.worst[0])} Hz"),
        ("of the whole set", f"{proved}: {answered.proof.how}"),
        ("margin", f"{number(1 - answered.peak)}, least at {number(tried.worst[top])} Hz"),
        ("|1 - L P| above 1 without Q", _first_above(curves)),
    ]
    shown = [
        f"{number(one.frequency)} Hz (damping {number(one.damping)})"
        for one in answered.resonances
        if np.interp(one.frequency, curves.f, np.abs(curves.Q)) > PASSED
    ]
    rows.append(("resonances that Q passes", ", ".join(shown) or "none"))
    if answered.peak < 1:
        rows.append(("error learned to 1/10", f"up to {number(curves.learned_up_to)} Hz"))
    if np.isfinite(answered.now.floor):
        rows.append(("error left at the limit", f"{number(scale * answered.now.floor)} {rms}"))
    if answered.rounding > 0:
        most = f"at most {number(scale * answered.rounding)} {rms}"
        known = np.isfinite(answered.rounding)
        rows.append(("rounding adds", most if known else "no bound is known"))
    return rows


def _scheme_verdict(name: str, answered: Question, uncertainty) -> str:
    tried, value = answered.tried, answered.peak
    over = f" for {_intervals_said(uncertainty)}" if uncertainty else " for the nominal machine"
    where = f"at {number(tried.worst[tried.top])} Hz"
    at = machine_said(tried.at, uncertainty)
    where += f" on the machine {at}" if at else ""
    if not answered.stable:
        return f"{name}: nothing is claimed{over}: a loop without learning is not stable."
    if value < 1:
        return (
            f"{name}: safe{over}: |Q (1 - L P)| is at most {_at_most(answered)}, a margin of "
            f"{number(1 - value)}; it is largest {where}."
        )
    return (
        f"{name}: not safe{over}: |Q (1 - L P)| reaches {beside_1(value)} {where}; what is learned "
        "there grows, or never comes nearer to its limit."
    )


def _at_most(answered: Question) -> str:
    rest = "proved for all of them" if answered.proof.proved else "on the machines tried"
    return f"{beside_1(answered.peak)} ({rest})"


def _how_far(answered: Question, best: Offer | None, margin: float, scale, unit) -> str:
    if not answered.stable:
        return "Nor is it said how far a law may go: a feedback must first make each loop stable."
    if best is None:
        return f"No cutoff, gain or lead keeps a margin of {margin:g}: another law is needed."
    bought = f"a repeated error is learned to a tenth up to {number(best.learned_up_to)} Hz"
    if np.isfinite(best.floor) and np.isfinite(answered.now.floor):
        bought += (
            f", and {number(scale * best.floor)} {unit} rms is left instead of "
            f"{number(scale * answered.now.floor)} {unit}"
        )
    return f"With a margin of {margin:g} it may go to {_changes_said(best)}: {bought}."


def _scheme_next(
    said: Sequence[str], asked: _Asked, answered: Question, best: Offer | None
) -> Verdict:
    """The verdict with the next command."""
    if not answered.stable:
        return Verdict(tuple(said))
    if answered.peak >= 1 and best is None:
        source = asked.request.source
        lower = f"Next: a lower gain or another law in {source}; `jaxilc tune --help` says how."
        return Verdict((*said, lower))
    settings: Sequence[str] = ()
    if best is not None and best.settings and (answered.peak >= 1 or best.peak < 1):
        settings = _settings_of(best.settings, f"{asked.name}.")
    return asked.certified(said, asked.request.source, asked.name, *settings)


def _scheme_numbers(answered: Question, offered: Sequence[Offer], scale: float) -> Numbers:
    tried, top = answered.tried, answered.tried.top
    return _law_numbers(answered, offered, scale) | {
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
        "rounding": scale * answered.rounding,
        "curves": _curve_numbers(answered.curves),
    }


def _scheme_synthesised(
    asked: _Asked, taps: int, answered: Question, inner: Lines, best: Offer | None
) -> tuple[Numbers, str, Curves]:
    """Synthesise filters, test them, and write them: numbers, sentence and curves."""
    chosen, tried = asked.chosen, answered.tried
    dt = float(chosen.task.dt)
    f = np.linspace(0, 0.5 / dt, LINES_A_TAP * taps + 1)[1:]
    poles = [one.frequency for one in answered.resonances]
    f = np.unique(np.r_[f[0] / 10, f, poles])
    f = f[(f > 0) & (f <= 0.5 / dt)]
    P = responses(tried.loops, f, dt)
    one = np.ones(len(f), complex)
    band = asked.band
    if band is None:
        band = min(2 * (best.change.cutoff if best else 0.025 / dt), 0.4 / dt)
    lead = int(np.max(inner.L.size and np.round(_lead_of(inner, best)), initial=0))
    lines = [Lines(f, P, np.zeros(P.shape), one, one, dt)]
    made = synthesised(lines, band=band, margin=asked.margin, taps=taps, lead=lead)
    whole = with_law(asked.scheme, made.scheme)
    tested, _ = asked.question(whole)
    named = f"{asked.name}-fir"
    path, ready = asked.write("synthesised", named, whole)
    scale, unit = chosen.shown_scale, chosen.shown_unit
    take = f"jaxilc certify {path} --scheme {named}" if ready else f"add {path} to a plant file"
    take = take if tested.peak < 1 else "not safe: more --taps or a smaller --band"
    said = (
        f"Synthesised with {taps} taps: |Q (1 - L P)| is at most {_at_most(tested)}, "
        f"learned to a tenth up to {number(tested.curves.learned_up_to)} Hz, "
        f"{number(scale * tested.now.floor)} {unit} rms left; {take}."
    )
    numbers = {"peak": tested.peak, "band": band, "loss": made.loss, "file": str(path)}
    return numbers | {"now": _offer_numbers(tested.now, scale)}, said, tested.curves


def _lead_of(inner, best) -> float:
    """The lead of the law as it is, by the slope of its phase at low frequencies, with the best."""
    slow = inner.f < 0.02 / inner.dt
    turn = np.unwrap(np.angle(inner.L[slow]))
    slope = np.polyfit(2 * np.pi * inner.f[slow] * inner.dt, turn, 1)[0]
    return max(slope - 1 + (best.change.lead if best else 0), 0.0)


# Measured responses
# --------------------------------------------------------------------------------------------------


def _size(told: bool) -> str:
    """What must stay below 1 on a line, whose scatter s is told or not."""
    return "|Q (1 - L P)|" + " + |Q L| s" * told


def _record_rows(test: RecordTest, told: bool) -> list[tuple[str, str]]:
    largest = f"{beside_1(test.peak)} at {number(test.worst)} Hz" + ", scatter included" * told
    resonances = [
        f"{number(one.frequency)} Hz: {one.lines:.1f} lines in its width of {number(one.width)} Hz"
        + ("" if one.fine else ", too few")
        for one in test.resonances
    ]
    rows = [
        ("lines", f"{len(test.curves.f)}, {number(test.ends[0])} to {number(test.ends[1])} Hz"),
        ("largest", largest),
        ("margin", number(1 - test.peak)),
        ("|1 - L P| above 1 without Q", _first_above(test.curves)),
        ("resonances", "; ".join(resonances) or "none stands out by 3 dB"),
        ("error learned to 1/10", f"up to {number(test.curves.learned_up_to)} Hz"),
    ]
    if test.unseen > UNSEEN:
        beyond = f"above {number(test.ends[1])} Hz, where Q still is {number(test.unseen)}"
        rows.append(("not measured", beyond))
    return rows


def _records_verdict(
    names: list[str],
    answered: MeasuredQuestion,
    told: Sequence[bool],
    sigmas: float,
    averages: float,
) -> str:
    test, size = answered.tests[answered.top], _size(told[answered.top])
    where = f"at {number(test.worst)} Hz" + (f" in {names[answered.top]}" if len(names) > 1 else "")
    law = f" with {sigmas:g} standard deviations of scatter" * any(told)
    law += " where it is told" * (any(told) and not all(told))
    law += f" and the doubt of {averages:g} averages" if np.isfinite(averages) else ""
    if answered.peak < 1:
        return (
            f"Safe on every line{law}: {size} is at most {beside_1(answered.peak)}, a margin of "
            f"{number(1 - answered.peak)}; it is largest {where}."
        )
    return f"Not safe{law}: {size} reaches {beside_1(answered.peak)} {where}."


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


def _records_next(
    said: Sequence[str], records: list[str], law: PLaw, answered: MeasuredQuestion, besides: Numbers
) -> Verdict:
    """The verdict with how far the law may go, and the next command with the options given."""
    best, margin = _best_of(answered.offers), besides["margin"]
    if best is None:
        no = f"No cutoff keeps a margin of {margin:g}: take a lower --gain or another --lead."
        return Verdict((*said, no))
    values = law._asdict() | best.settings | besides
    usual = {"order": ORDER, "sigmas": 3.0, "averages": None, "margin": 0.1}
    command = ["jaxilc", "filter", *records]
    for name in ("gain", "lead", "cutoff", "dt", *(k for k, v in usual.items() if values[k] != v)):
        command += [f"--{name}", f"{values[name]:.15g}"]
    far = (
        f"With a margin of {margin:g} a repeated error may be learned to a tenth up to "
        f"{number(best.learned_up_to)} Hz."
    )
    return Verdict((*said, far), "", shlex.join(command))


def _records_synthesised(
    lines: Sequence[Lines],
    law: PLaw,
    answered: MeasuredQuestion,
    folder: Path,
    *,
    taps: int,
    band: float | None,
    margin: float,
) -> tuple[Numbers, str]:
    """Synthesise filters on the lines and write their table: numbers and a sentence."""
    best = _best_of(answered.offers)
    furthest = min(float(one.f[-1]) for one in lines)
    if band is None:
        band = min(2 * (best.change.cutoff if best else law.cutoff), furthest)
    lead = law.lead + (best.change.lead if best else 0)
    made = synthesised(lines, band=band, margin=margin, taps=taps, lead=lead)
    folder.mkdir(parents=True, exist_ok=True)
    path, _ = write_with_scheme(folder / "synthesised.toml", "", "fir", made.scheme)
    said = (
        f"Synthesised with {taps} taps: |Q - M P| + |M| s is at most "
        f"{number(made.peak)} on the lines; {path} is its table for a plant file."
    )
    if made.spacing > 0.5:
        said += (
            f" The lines lie {made.spacing:.2g} / (duration of the taps) apart: fewer --taps or "
            "finer lines, or the filters may be large between them."
        )
    return {"peak": made.peak, "loss": made.loss, "band": band, "file": str(path)}, said


# Both
# --------------------------------------------------------------------------------------------------


def _offers_table(now: Offer, offers: Sequence[Offer], margin: float, scale=1.0, unit="") -> Table:
    """The table of how far the law may go; the error that is left only where it is known."""
    known = any(np.isfinite(one.floor) for one in (now, *offers))
    columns = ("largest", "learned to 1/10 up to", *([f"rms left [{unit or 'y'}]"] * known))
    title = f"how far it may go with a margin of {margin:g}, and what that buys"
    table = Table("law", "set", right=columns, title=title)
    for one in (now, *offers):
        reach = f"{number(one.learned_up_to)} Hz" if one.peak < 1 else "–"
        left = [number(scale * one.floor)] * known
        table.add_row(one.what, _changes_said(one), beside_1(one.peak), reach, *left)
    return table


def _changes_said(one: Offer) -> str:
    """What an offer sets, and the filter that it adds where the law has none."""
    parts = _settings_of(one.settings)
    if one.adds_filter:
        parts.append(f"a filter of {one.change.cutoff:g} Hz")
    return ", ".join(parts) or "–"


def _settings_of(values: Mapping[str, ArrayLike], before: str = "") -> list[str]:
    """Values as `--set` takes them."""
    return [f"{before}{path}={_plain(value)}" for path, value in values.items()]


def _plain(value) -> str:
    """A number, or those of an array in one list, which those of one channel are by themselves."""
    array = np.asarray(value)
    if array.ndim:
        return "[" + ",".join(f"{v:.6g}" for v in array.ravel()) + "]"
    return f"{array.item():.6g}"


def _first_above(curves: Curves) -> str:
    """Where |1 - L P| first exceeds 1 without the filter, in words."""
    at = curves.first_above
    return f"from {number(at)} Hz" if np.isfinite(at) else "nowhere"


def _best_of(offers: Sequence[Offer]) -> Offer | None:
    """The offer that learns furthest."""
    return max(offers, key=lambda one: one.learned_up_to, default=None)


def _law_numbers(
    answered: Question | MeasuredQuestion, offered: Sequence[Offer], scale: float = 1.0
) -> Numbers:
    """Whether a law is safe, and how far it may go, as JSON."""
    return {
        "safe": bool(answered.peak < 1),
        "peak": answered.peak,
        "margin": 1 - answered.peak,
        "now": _offer_numbers(answered.now, scale),
        "offers": [_offer_numbers(one, scale) for one in offered],
    }


def _offer_numbers(one: Offer, scale: float = 1.0) -> Numbers:
    """An offer as JSON; the error that is left in the unit shown."""
    return {
        "what": one.what,
        "set": {path: np.asarray(value).tolist() for path, value in one.settings.items()},
        "gain_factor": one.change.gain,
        "lead_change": one.change.lead,
        "cutoff": one.change.cutoff,
        "peak": one.peak,
        "margin": 1 - one.peak,
        "learned_to_a_tenth_up_to": one.learned_up_to,
        "rms_left": scale * one.floor,
    }


def _curve_numbers(curves: Curves) -> dict[str, list[float]]:
    """The curves of the figure as JSON."""
    lists = {name: getattr(curves, name).tolist() for name in ("f", "nominal", "low", "high")}
    return lists | {"Q": np.abs(curves.Q).tolist(), "LP": np.abs(curves.LP).tolist()}


def _intervals_said(uncertainty: Uncertainty) -> str:
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
