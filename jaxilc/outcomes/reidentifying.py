"""`identify --state`: the plant of a campaign again, from its trials, and never made worse."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from .. import figures, identification
from ..hardware.campaign import record_of
from ..identification.refitting import Refit, beyond_nyquist, held_out, refit
from ..identification.sentences import NOT_WHITE, sentence
from ..plants import ProcessModel
from ..scenarios.campaigns import Given, Opened, open_campaign
from ..scenarios.identified_file import write_refitted
from ..theory.q_filter import question
from .identifying import (
    CAPTIONS,
    identification_table,
    live_of,
    numbers_of,
    orders_table,
)
from .outcome import Figure, Outcome, Progress, silent
from .verdict import Verdict

if TYPE_CHECKING:
    from ..identification import Identified, Record
    from ..plants import Plant
    from ..scenarios import Scenario

CLOSED = (
    "note: a loop was closed in these trials, so that the noise of the output is in the input; the "
    "intervals hold only if this noise is white"
)
ENOUGH = 90.0  # [%] of the output that a fit explains, from which on no other start is tried


def identify_campaign(
    state: Path,
    counts: Mapping[str, int | None],
    *,
    delay: int | None = None,
    auto: bool = False,
    plant_file: Path | None = None,
    folder: Path | None = None,
    progress: Progress = silent,
) -> Outcome:
    """A plant from the trials of a campaign, and the campaign's plant file with it.

    state: folder of the campaign
    counts: numbers of poles, pairs and zeros; without any, those of the campaign's own plant
    delay: dead time in samples; None: that of the campaign's own plant
    auto: whether the structure is chosen by a table
    plant_file: plant file to write
    folder: for the figure; out/identify if not given
    """
    opened = open_campaign(state, Given(), new=False)
    measured = record_of(opened.campaign, opened.scenario.machine)
    record, known = measured.record, opened.scenario.machine.plant
    numbers = ", ".join(map(str, measured.trials))
    source = f"{len(measured.trials)} of {measured.measured} trials of {state}: {numbers}"
    progress("fitting")
    tables = []
    if auto:
        late = _delay_of(known, record.dt) if delay is None else delay
        orders = identification.compare_orders(record, delay=late)
        best = identification.best_order(orders)
        again = _judged(record, known, best.found)
        tables.append(orders_table(orders, best, record.dt))
    else:
        again = _fitted(record, opened.scenario, counts, delay)
    found, unit = again.found, opened.campaign.task.unit
    tables.append(identification_table(source, found.summary()))
    lines = [] if found.white else [NOT_WHITE]
    lines += map(sentence, identification.not_significant(found))
    lines += [f"{name} keeps its value and its interval: {why}" for name, why in again.kept.items()]
    lines += [CLOSED] * measured.closed
    beyond = sorted(beyond_nyquist(found, record.dt))
    lines.append(_verdict(again, beyond, unit))
    better = again.better and not beyond
    warnings, kept, margins = [], [], {}
    if not better:
        lines.append(
            "next: go on with the plant file as it is: jaxilc next --state "
            f"{shlex.quote(str(state))} --measured TRIAL --out next.csv"
        )
    elif plant_file is not None:
        kept = [_write(plant_file, opened, again, source)]
        after, warnings, margins = _after(plant_file, state, opened)
        lines += after
    sound = {"white": bool(found.white), "converged": bool(found.converged)}
    used = {"trials": list(measured.trials), "closed_loop": measured.closed, "verdict": lines}
    judged = {"kept": again.kept, "before": again.before, "after": again.after, "better": better}
    units = opened.campaign.task.input_unit, unit
    return Outcome(
        command="identify",
        numbers=numbers_of(found) | sound | used | judged | {"margin": margins},
        verdict=Verdict(tuple(lines)),
        folder=folder or Path("out") / "identify",
        tables=tables,
        warnings=warnings,
        figures={
            "validation": Figure(
                CAPTIONS["validation"], partial(figures.validation_figure, record, found), live=True
            )
        },
        kept=kept,
        live=partial(live_of, record, found, record.dt, units),
        asked=counts,
    )


def _verdict(again: Refit, beyond: list[str], unit: str) -> str:
    """Which of the two plants predicts the trials that were not fitted better."""
    before, after = (f"{of:.3g} {unit}".rstrip() for of in (again.before, again.after))
    fit = f"{float(np.min(again.found.fit)):.4g} %"
    if beyond:
        return (
            f"verdict: the fit puts {', '.join(beyond)} beyond the Nyquist frequency, where no "
            "sample can have seen it, so it is refused and the plant file stays; give a smaller "
            "structure (--poles, --pairs)"
        )
    if not again.better:
        return (
            f"verdict: the plant file stays, since it predicts the last trials, which were not "
            f"fitted, as well: rms error {before}, of the new fit {after}"
        )
    return (
        f"verdict: the plant of these trials explains {fit} of their output, and predicts the last "
        f"ones, which were not fitted, better: rms error {after} in place of {before}"
    )


def _delay_of(plant, dt: float) -> int:
    """The dead time of a plant in whole samples; 0 of a plant that has none."""
    return round(getattr(plant, "delay", 0.0) / dt)


def _judged(record: Record, known: Plant, found: Identified) -> Refit:
    """A fit that begins anew, beside the known plant."""
    return Refit(found, {}, held_out(record, known), held_out(record, found.plant))


def _fitted(
    record: Record, scenario: Scenario, counts: Mapping[str, int | None], delay: int | None
) -> Refit:
    """The fit of the structure that was asked for, or else of that of the campaign's plant.

    A ProcessModel is fitted from its own values. Where the result explains little, the campaign's
    plant is no start, and many others are tried.
    """
    plant = scenario.machine.plant
    structure: dict[str, Any] = {
        name: 1 if value is None else value for name, value in counts.items()
    }
    own = delay is None and all(value is None for value in counts.values())
    if isinstance(plant, ProcessModel) and own:
        again = refit(record, plant, scenario.uncertainty)
        if np.min(again.found.fit) >= ENOUGH:
            return again
        structure = {
            "poles": len(plant.poles),
            "pairs": len(plant.frequencies),
            "zeros": len(plant.zeros),
        }
    late = _delay_of(plant, record.dt) if delay is None else delay
    return _judged(record, plant, identification.identify(record, **structure, delay=late))


def _write(path: Path, opened: Opened, again: Refit, source: str) -> Path:
    """Write the plant file of the campaign with the fitted plant, and what it is known by."""
    recipe = opened.recipe
    own = Path(recipe["scenario"])
    if "file" not in recipe or own.suffix != ".toml":
        raise ValueError(
            f"the campaign belongs to {recipe['scenario']}, which is no plant file in TOML; the "
            "fitted plant is above, and --out FOLDER takes its figure"
        )
    found = again.found
    noise = float(max(found.residual_std)) if found.white else None
    notes = [] if found.white else [NOT_WHITE]
    notes += [f"{name}: as before, since {why}" for name, why in again.kept.items()]
    notes.append(
        f"rms error of prediction of the last trials: {again.after:.4g}, before {again.before:.4g}"
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    return write_refitted(path, own, found, fitted_to=source, noise=noise, notes=notes)


def _after(
    path: Path, state: Path, opened: Opened
) -> tuple[list[str], list[str], dict[str, float]]:
    """What to do with the new plant file, a warning where the campaign cannot go on, margins."""
    file, folder = shlex.quote(str(path)), shlex.quote(str(state))
    try:
        now = open_campaign(state, Given(scenario=str(path)), new=False)
    except ValueError as error:
        name = shlex.quote(opened.recipe["scheme"])
        start = (
            "next: the scheme of the new file is another one, so start a campaign with it: jaxilc "
            f"next --state FOLDER --scenario {file} --scheme {name} --out next.csv"
        )
        return [start], [f"warning: {error}"], {}
    try:
        before, after = map(_margin, (opened, now))
    except ValueError as error:
        said, margins = [f"note: the margin of the law is not computed: {error}"], {}
    else:
        margins = {"before": before, "after": after}
        said = [
            f"the law: |Q (1 - L P)| is at most {after:.3f} on the new plant and within its "
            f"intervals, {before:.3f} by the old file"
            + ", so neither is proved safe"
            * (min(before, after) >= 1)
        ]
        if before < 1 <= after:
            said.append(f"next: this is no longer safe, a new law: jaxilc design {file}")
            why = "the law of the campaign is not safe on the new plant; do not go on with it"
            return said, [f"warning: {why}"], margins
    on = (
        f"next: go on with the new file: jaxilc next --state {folder} --scenario {file} "
        "--measured TRIAL --out next.csv; its uncertainty is what is predicted from then on"
    )
    return [*said, on], [], margins


def _margin(opened: Opened) -> float:
    """The largest |Q (1 - L P)| of a campaign's law over the machines of its plant file."""
    of, campaign = opened.scenario, opened.campaign
    answered, _ = question(of.machine, campaign.scheme, campaign.task, of.uncertainty)
    return float(answered.now.peak)
