"""`jaxilc certify`: the claims of theory for each machine, compared with simulation."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from .console import err
from .options import (
    PROVE,
    FigureFormat,
    Json,
    Machines,
    OutFolder,
    Params,
    Precision,
    Report,
    Sampling,
    ScenarioName,
    Schemes,
    Seed,
    Set,
    Spread,
    Trials,
)
from .results import folder_of, show, written
from .verdicts.next_command import Asked

if TYPE_CHECKING:
    from ..scenarios import Scenario
    from ..theory.certificates import OfScheme
    from .titled_table import Table


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""
    app.command(rich_help_panel=PROVE)(certify)


def certify(
    scenario: ScenarioName,
    scheme: Schemes = None,
    trials: Trials = None,
    machines: Machines = 64,
    seed: Seed = 0,
    spread: Spread = None,
    sampling: Sampling = "monte-carlo",
    set_: Set = None,
    params: Params = None,
    out_dir: OutFolder = None,
    json_file: Json = None,
    report: Report = None,
    figures: FigureFormat = None,
    precision: Precision = "float64",
) -> None:
    """Theory beside simulation: claims for the long run, and predictions of J trials.

    For schemes with the bounds of Cao 2019, their premises are checked too.

    Example: jaxilc certify cao-2019 --scheme cfdl-mfailc --trials 200 --machines 256
    """
    from .progress import working

    with working("certify") as told:
        from .asked import begin, chosen_scenario, spread_of

        begin(precision)
        from ..uncertainty import draw

        chosen = chosen_scenario(scenario, scheme, trials, set_, params)
        wide = dataclasses.replace(chosen, uncertainty=spread_of(chosen, spread))
        drawn = draw(chosen.machine, wide.uncertainty, machines, seed=seed, sampling=sampling)
        found = _certified(wide, drawn, told)
    from ..figures.report import command_report
    from .live import of_certificates
    from .numbers import certificate_numbers
    from .verdicts.case import Case
    from .verdicts.certification import certify_verdict

    numbers = {name: certificate_numbers(one) for name, one in found.items()}
    shown, lines = _shown(chosen, numbers)
    show(shown, lines)
    asked = Asked(scenario, tuple(scheme or ()), tuple(set_ or ()), params, trials, spread)
    case = Case.of(wide, asked)._replace(unit=chosen.shown_unit)  # that of an error, of any metric
    verdict = certify_verdict(case, numbers, chosen.shown_scale)
    paths = _figures(chosen, found, folder_of(out_dir, f"certify-{chosen.name}"))
    page = command_report(
        report,
        "certify",
        shown,
        [
            (f"{name}: the error by trial, simulated and predicted, and what is claimed.", path)
            for name, path in paths.items()
        ],
        scenario=wide,
        lines=lines,
        verdict=verdict,
        live=of_certificates(report, chosen, found, drawn),
        asked={"machines": machines, "seed": seed, "sampling": sampling},
    )
    results = {"scenario": scenario, "trials": chosen.trials, "samples": machines}
    written([*paths.values(), *page], json_file, results | {"schemes": numbers}, verdict)
    broken = [name for name, row in numbers.items() if row["contradicted"]]
    if broken:
        err.print(
            f"{', '.join(broken)}: simulation contradicts what was claimed: please report this",
            highlight=False,
        )
        raise typer.Exit(1)


def _certified(
    chosen: Scenario, drawn: dict[str, Any], told: Callable[..., None]
) -> dict[str, OfScheme]:
    """What theory says of each scheme; `told` shows how far it is."""
    from ..theory.certificates import certify_schemes

    learning = sum(one.learns for one in chosen.schemes.values())
    return certify_schemes(
        chosen.machine,
        chosen.schemes,
        chosen.task,
        chosen.trials,
        chosen.uncertainty,
        drawn,
        progress=lambda done, name: told(name, done, learning),
    )


def _shown(
    chosen: Scenario, numbers: Mapping[str, dict[str, Any]]
) -> tuple[list[Table], list[str]]:
    """The tables of all schemes, and the sentences below them."""
    from .certificate_tables import certificate_sentence, certificate_tables, reason_lines

    scale, unit = chosen.shown_scale, chosen.shown_unit
    shown, lines = [], []
    for name, of_scheme in numbers.items():
        shown += certificate_tables(name, chosen.trials, of_scheme)
        lines.append(certificate_sentence(name, chosen.trials, of_scheme, scale, unit))
        lines += reason_lines(name, of_scheme)
    return shown, lines


def _figures(chosen: Scenario, found: Mapping[str, OfScheme], folder: Path) -> dict[str, Path]:
    """Write the figure of each scheme, and return the files by scheme."""
    from .. import figures

    scale, unit = chosen.shown_scale, chosen.shown_unit
    paths = {}
    for name, one in found.items():
        axes = figures.certificate(one.certificate, scale=scale, unit=unit, title=name)
        paths[name] = figures.save(axes, folder / f"{name}.png")
    return paths
