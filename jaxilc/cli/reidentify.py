"""`jaxilc identify --state`: the plant of a campaign, fitted to the campaign's own trials."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Any

from .console import err, out
from .options import Json, Report
from .results import folder_of, written

CLOSED = (
    "note: a loop was closed in these trials, so that the noise of the output is in the input; the "
    "intervals hold only if this noise is white"
)


def reidentify(
    state: Path,
    given: dict[str, int | None],
    delay: int | None,
    auto: bool,
    out_dir: Path | None,
    json_file: Json,
    report: Report,
) -> None:
    """Fit a plant to the trials of a campaign, print it, and write it into a plant file.

    given: numbers of poles, pairs and zeros; without any, those of the campaign's own plant
    delay: dead time in samples; None: that of the campaign's own plant
    auto: whether the structure is chosen by a table
    out_dir: plant file to write, or folder for figures
    """
    from .asked import begin

    begin("float64")
    from .. import figures, identification
    from ..figures.report import command_report
    from ..hardware.as_record import record_of
    from ..identification.sentences import NOT_WHITE, sentence
    from ..scenarios.campaigns import Given, open_campaign
    from .tables import identification_table, orders_table

    opened = open_campaign(state, Given(), new=False)
    found_in = record_of(opened.campaign, opened.scenario.machine)
    record, tables = found_in.record, []
    numbers = ", ".join(map(str, found_in.trials))
    source = f"{len(found_in.trials)} of {found_in.measured} trials of {state}: {numbers}"
    if auto:
        late = _delay_of(opened.scenario.machine.plant, record.dt) if delay is None else delay
        orders = identification.compare_orders(record, delay=late)
        best = identification.best_order(orders)
        found = best.found
        tables.append(orders_table(orders, best, record.dt))
        out.print(tables[0])
    else:
        found = _fitted(record, opened.scenario.machine.plant, given, delay)
    tables.append(identification_table(source, found.summary()))
    out.print(tables[-1])
    lines = [] if found.white else [NOT_WHITE]
    lines += map(sentence, identification.not_significant(found))
    lines += [CLOSED] * found_in.closed
    unit = opened.campaign.task.unit
    lines.append(
        f"verdict: the plant of these trials explains {float(min(found.fit)):.4g} % of their "
        f"output; the residual is {float(max(found.residual_std)):.3g} {unit}".rstrip()
    )
    plant_file = out_dir if out_dir is not None and out_dir.suffix == ".toml" else None
    folder = folder_of(None if plant_file else out_dir, "identify")
    paths = [figures.save(figures.validation_figure(record, found), folder / "validation.png")]
    if plant_file is not None:
        paths.append(_write(plant_file, opened, found, source))
        lines.append(_after(plant_file, state, opened))
    for line in lines:
        out.print(line, highlight=False, soft_wrap=True)
    live = _live(report, record, found, unit, opened.campaign.task.input_unit)
    page = command_report(report, "identify", tables, (), lines=lines, asked=given, live=live)
    rows = {n: {"value": v, "low": low, "high": high} for n, v, low, high in found.summary()}
    sound: dict[str, Any] = {"white": bool(found.white), "converged": bool(found.converged)}
    used = {"trials": list(found_in.trials), "closed_loop": found_in.closed, "verdict": lines}
    written([*paths, *page], json_file, rows | sound | used)


def _live(report: Path | None, record, found, unit: str, input_unit: str) -> list[Any]:
    """The interactive figures of a fit; none where no page is asked for."""
    if report is None:
        return []
    from ..figures import live_records

    units = {"input_unit": input_unit, "output_unit": unit}
    shown = live_records.validation(record, found, **units)
    return [shown, live_records.response(found, record.dt, **units)]


def _delay_of(plant, dt: float) -> int:
    """The dead time of a plant in whole samples; 0 of a plant that has none."""
    return round(getattr(plant, "delay", 0.0) / dt)


def _fitted(record, plant, given: dict[str, int | None], delay: int | None):
    """The fit of the structure that was asked for, or else of that of the campaign's plant.

    A ProcessModel is fitted from its own values. Where the result explains little, the campaign's
    plant is no start, and many others are tried.
    """
    from .. import identification
    from ..plants import ProcessModel

    structure: dict[str, Any] = {
        name: 1 if value is None else value for name, value in given.items()
    }
    own = delay is None and all(value is None for value in given.values())
    if isinstance(plant, ProcessModel) and own:
        found = identification.identify(record, plant)
        if min(found.fit) >= ENOUGH:
            return found
        structure = {
            "poles": len(plant.poles),
            "pairs": len(plant.frequencies),
            "zeros": len(plant.zeros),
        }
    late = _delay_of(plant, record.dt) if delay is None else delay
    return identification.identify(record, **structure, delay=late)


ENOUGH = 90.0  # [%] of the output that a fit explains, from which on no other start is tried


def _write(path: Path, opened, found, source: str) -> Path:
    """Write the plant file of the campaign with the fitted plant, or a new one for a scenario."""
    from ..scenarios.refitted_file import write_refitted

    recipe = opened.recipe
    own = Path(recipe["scenario"])
    if "file" not in recipe or own.suffix != ".toml":
        raise ValueError(
            f"the campaign belongs to {recipe['scenario']}, which is no plant file in TOML; the "
            "fitted plant is above, and --out FOLDER takes its figure"
        )
    noise = float(max(found.residual_std)) if found.white else None
    path.parent.mkdir(parents=True, exist_ok=True)
    return write_refitted(path, own, found, fitted_to=source, noise=noise)


def _after(path: Path, state: Path, opened) -> str:
    """What to do with the new plant file: whether the campaign can go on with it."""
    from ..scenarios.campaigns import Given, open_campaign

    file, folder = shlex.quote(str(path)), shlex.quote(str(state))
    try:
        open_campaign(state, Given(plant_file=path), new=False)
    except ValueError as error:
        err.print(f"warning: {error}", highlight=False, soft_wrap=True)
        name = shlex.quote(opened.recipe["scheme"])
        return (
            "next: the scheme of the new file is another one, so start a campaign with it: jaxilc "
            f"next --state FOLDER --plant-file {file} --scheme {name} --out next.csv"
        )
    return (
        f"next: go on with the new file: jaxilc next --state {folder} --plant-file {file} "
        "--measured TRIAL --out next.csv; its uncertainty is what is predicted from then on"
    )
