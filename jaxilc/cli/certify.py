"""`jaxilc certify`: the claims of theory for each machine, compared with simulation."""

from __future__ import annotations

import dataclasses

import typer

from .console import err, out
from .options import (
    PROVE,
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
from .results import folder_of, written


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
    precision: Precision = "float64",
) -> None:
    """Theory beside simulation: claims for the long run, and predictions of J trials.

    For schemes with the bounds of Cao 2019, their premises are checked too.

    Example: jaxilc certify cao-2019 --scheme cfdl-mfailc --trials 200 --machines 256
    """
    from .asked import begin, chosen_scenario, spread_of

    begin(precision)
    from .. import figures
    from ..figures.report import command_report
    from ..theory.of_schemes import certify_schemes
    from ..uncertainty import draw
    from .certificate_tables import certificate_sentence, certificate_tables
    from .numbers import certificate_numbers
    from .progress import progress_bar

    chosen = chosen_scenario(scenario, scheme, trials, set_, params)
    wide = dataclasses.replace(chosen, uncertainty=spread_of(chosen, spread))
    drawn = draw(chosen.machine, wide.uncertainty, machines, seed=seed, sampling=sampling)
    learning = sum(one.learns for one in chosen.schemes.values())
    with progress_bar("scheme") as bar:
        schemes = bar.add_task("certify", total=learning, scheme="")
        found = certify_schemes(
            chosen.machine,
            chosen.schemes,
            chosen.task,
            chosen.trials,
            wide.uncertainty,
            drawn,
            progress=lambda done, name: bar.update(schemes, completed=done, scheme=name),
        )
        bar.update(schemes, completed=learning)

    numbers = {name: certificate_numbers(one) for name, one in found.items()}
    scale, unit = chosen.shown_scale, chosen.shown_unit
    shown, lines = [], []
    for name, of_scheme in numbers.items():
        shown += certificate_tables(name, chosen.trials, of_scheme)
        lines.append(certificate_sentence(name, chosen.trials, of_scheme, scale, unit))
    for table in shown:
        out.print(table)
    for line in lines:
        out.print(line, highlight=False, markup=False, soft_wrap=True)
    folder = folder_of(out_dir, f"certify-{chosen.name}")
    paths = {
        name: figures.save(
            figures.certificate(one.certificate, scale=scale, unit=unit, title=name),
            folder / f"{name}.png",
        )
        for name, one in found.items()
    }
    page = command_report(
        report,
        "certify",
        shown,
        [(f"{name}: error by trial, predicted and simulated", p) for name, p in paths.items()],
        scenario=wide,
        lines=lines,
        asked={"machines": machines, "seed": seed, "sampling": sampling},
    )
    asked = {"scenario": scenario, "trials": chosen.trials, "samples": machines}
    written([*paths.values(), *page], json_file, asked | {"schemes": numbers})
    broken = [name for name, row in numbers.items() if row["contradicted"]]
    if broken:
        err.print(
            f"{', '.join(broken)}: simulation contradicts what was claimed: please report this",
            highlight=False,
        )
        raise typer.Exit(1)
