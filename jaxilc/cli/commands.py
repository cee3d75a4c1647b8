"""The commands that are one call of the library: each reads its options and presents an outcome."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from typer import Argument, Option

from ..outcomes.terms import OBJECTIVES, numbers_of
from .console import begin, between, prefer
from .options import (
    IN_PYTHON,
    SCENARIO,
    FileToWrite,
    Machines,
    MetricName,
    OneScheme,
    OneSimulated,
    Pages,
    Sampling,
    Schemes,
    Seed,
    Simulated,
    Tuned,
    Written,
    asked,
    at_least,
    file_to_write,
    folder_to_write,
    left,
    names_in,
    of_list,
    scenarios_from,
)
from .present import present, tell
from .progress import run_search, run_sweep

if TYPE_CHECKING:
    from ..pytree.aliases import Value


def init(
    file: Annotated[Path, Argument(callback=file_to_write)] = Path("axis.toml"),
    set_point: bool = False,
    record: Path | None = None,
    time: str = "t",
    input: str = "u",
    output: str = "y",
    force: bool = False,
) -> None:
    """Write a plant file with comments: a machine, its task, schemes and uncertainty.

    With --set-point and --record the machine is fitted to the record, whose set-point is the task,
    and the law is one that learns on it.

    file [FILE]: The file to write.
    set_point: Correct the set-point of a closed drive: u is r in trial 1.
    record FILE: With --set-point: a recorded move of the drive, as columns.
    force: Replace a file that exists.

    Example: jaxilc init axis.toml
    """
    from ..outcomes import beginning

    if record is not None:
        begin()
    columns = {"time": time, "input": input, "output": output}
    made = beginning.init(file, set_point=set_point, record=record, force=force, **columns)
    present(made, Pages())


def demo(written: Written) -> None:
    """A law that looks good and diverges, the certificate that knew, a tuned one.

    A made-up axis learns; theory is asked; a law is tuned by gradient and judged
    on a thousand machines. Half a minute, nothing to prepare.

    Example: jaxilc demo --report demo.html
    """
    tell("demo", written)


def list_(scenario: Annotated[str | None, Argument(autocompletion=scenarios_from)] = None) -> None:
    """List the scenarios, or all that can be set in one.

    scenario [SCENARIO]: Show all that can be set.

    Example: jaxilc list cao-2019
    """
    from ..outcomes import beginning

    if scenario is not None:
        begin()
    present(beginning.scenarios() if scenario is None else beginning.settings(scenario), Pages())


def run(
    what: Simulated,
    written: Written,
    metric: MetricName = None,
    seed: Seed = 0,
    replace: bool = False,
    details: bool = False,
) -> None:
    """Learn on the nominal machine: errors beside the published ones, figures, dataset.

    replace: Replace the run of other settings in the folder.

    Example: jaxilc run cao-2019 --scheme ffdl-mfailc --set ffdl-mfailc.lam=0.5
    """
    tell("run", written, what.request(metric=metric), details=details, seed=seed, replace=replace)


def sweep(
    what: Simulated,
    written: Written,
    machines: Machines = 1024,
    seed: Seed = 0,
    spread: float | None = None,
    metric: MetricName = None,
    tolerance: float | None = None,
    grid: list[str] | None = None,
    resume: bool = False,
    dask: str | None = None,
    bounds: bool = False,
    sampling: Annotated[str | None, left("Sweep(sampling=...) does it")] = None,
    keep: Annotated[list[str] | None, left("Sweep(keep=...) does it")] = None,
) -> None:
    """Schemes against many uncertain machines: yield, quantiles, worst case, figure, dataset.

    With --grid they run at every point of a grid; tables and figure are those of the best point.

    tolerance: Largest metric that passes, the one tables show, in its unit.
    dask ADDRESS: Compute on workers of this Dask scheduler: its address, or the file it wrote.
    bounds: Contraction of each trial; d1, d2 and premises of Cao 2019, on each machine.

    Example: jaxilc sweep cao-2019 --machines 4096 --spread 0.2 --out out/wide
    """
    tell(
        "sweep", written, what.request(spread=spread, metric=metric, tolerance=tolerance),
        bar=False, machines=machines, seed=seed, sampling=sampling, grid=grid, keep=keep,
        bounds=bounds, resume=resume, run=partial(run_sweep, cluster=dask),
    )  # fmt: skip


def certify(
    what: Simulated,
    written: Written,
    machines: Machines = 64,
    seed: Seed = 0,
    spread: float | None = None,
    sampling: Sampling = "monte-carlo",
) -> None:
    """Theory beside simulation: claims for the long run, and predictions of J trials.

    For schemes with the bounds of Cao 2019, their premises are checked too. Of
    repetitive control it tells the condition, what grows between the harmonics,
    and what a wrong period costs.

    Example: jaxilc certify cao-2019 --scheme cfdl-mfailc --trials 200 --machines 256
    """
    at_least(1, machines=machines)
    tell(
        "certify", written, what.request(spread=spread), machines=machines, seed=seed,
        sampling=sampling,
    )  # fmt: skip


def potential(
    record: Annotated[list[str], Argument()],
    written: Written,
    error: str = "e",
    output: str = "y",
    reference: str = "r",
    time: str = "t",
    dt: float | None = None,
    unit: str = "",
    columns: str | None = None,
    into: FileToWrite = None,
) -> None:
    """Is learning worth it, up to which frequency, and when is it done?

    From two or more repeats of a motion with the same input: the part of the
    error that repeats, and what is new in each trial and is left by any law, with
    intervals. A first trial unlike the others, and a drift, are told apart. It says
    whether what repeats does so in a period or in the position within the trial, and
    which law follows.

    record RECORD...: Files with one trial each or with several, or the folder of a campaign.
    error NAME: Column or array of the error; e_0, e_1 ... too.
    reference NAME: Of the reference, for a file without the error.
    dt: Sample time in s, without times.
    unit: Of the error, where no heading tells it.
    into FILE: Plant file that gets what is found, for `design` and `next`.

    Example: jaxilc potential trial-1.csv trial-2.csv trial-3.csv trial-4.csv
    """
    tell(
        "potential", written, record, into=into, unit=unit, error=error, output=output,
        reference=reference, time=time, dt=dt, columns=names_in(columns),
    )  # fmt: skip


def worst_case(
    what: OneSimulated,
    written: Written,
    trial: int | None = None,
    starts: int = 16,
    steps: int = 30,
    evaluations: int | None = None,
    draws: int | None = None,
    seed: Seed = 0,
) -> None:
    """The worst machine by climbing the gradient of its error, against machines drawn by chance.

    A gradient counts as three evaluations on top of the one that it belongs to.

    trial: Trial whose metric is to be large; the scenario's last if not given.
    starts: Places to climb from.
    steps: Steps of each climb.
    evaluations: Learning processes to spend on either search, in place of --steps.
    draws: A larger search by chance besides.

    Example: jaxilc worst-case cao-2019 --scheme cfdl-mfailc --trial 40 --draws 10000
    """
    at_least(1, trial=trial, starts=starts, steps=steps, draws=draws)
    tell(
        "worst_case", written, what.request(trial), starts=starts, steps=steps,
        evaluations=evaluations, draws=draws, seed=seed,
    )  # fmt: skip


TERMS = f"Terms NAME[:NUMBER][@METRIC] with + between, each WEIGHT* or 1; NAME of {OBJECTIVES}."


def tune(
    what: OneSimulated,
    how: Tuned,
    written: Written,
    objective: Annotated[str, Option(help=TERMS)] = "final",
    limit: list[str] | None = None,
    compare_trials: Annotated[int | None, IN_PYTHON] = None,
) -> None:
    """Tune weights by gradient through the learning, and compare them on machines not seen.

    limit NAME=MOST: Largest d2 (Cao 2019, every machine) or contraction (nominal); repeatable.

    Example: jaxilc tune cao-2019 --scheme cfdl-mfailc --weights lam,eta,mu,phi0
    --set cfdl-mfailc.lead=3 --objective holding:20
    """
    at_least(1, compare_trials=compare_trials)
    tell(
        "tune", written, what.request(how.trials), **how.arguments(), objective=objective,
        limits=limit, compare_trials=compare_trials, run=run_search,
    )  # fmt: skip


def pareto(
    what: OneSimulated,
    how: Tuned,
    written: Written,
    objective: Annotated[
        list[str] | None, Option(metavar="TERMS", help=f"Give two, or one and --budgets. {TERMS}")
    ] = None,
    budgets: str | None = None,
    first: Annotated[str | None, left("--objective, given first, does it")] = None,
    second: Annotated[str | None, left("--objective, given twice, does it")] = None,
    shares: Annotated[str | None, IN_PYTHON] = None,
) -> None:
    """Two objectives against each other, or one against the number of trials.

    Give --objective twice for the former, --budgets for the latter. Each point is a tuning by
    itself, from the weights as given, and leaves a parameter file. With --resume, more may follow.

    budgets J,K,L: Numbers of trials to tune for.

    Example: jaxilc pareto li-2020 --scheme fixed-filter --weights learning.filter.cutoff=2:200
    --objective final --objective effort --trials 15 --steps 20
    """
    given = objective or ["final"]
    tell(
        "pareto",
        written,
        what.request(how.trials),
        **how.arguments(),
        objectives=(first or given[0], *given[1:], *([second] if second else ())),
        shares=numbers_of("--shares", shares) if shares else (),
        budgets=[int(J) for J in numbers_of("--budgets", budgets, whole=True)] if budgets else (),
        run=run_search,
    )


def reproduce(
    written: Written,
    scenario: Annotated[list[str] | None, Argument(autocompletion=scenarios_from)] = None,
    reading: str | None = None,
    details: bool = False,
) -> None:
    """Every published number and conclusion beside ours, and how the paper was read.

    Printed are a line for each paper, and what is not met; --details says why. With --out there is
    a picture for each paper, with the printed numbers and ours; a report has all rows.

    scenario [SCENARIO]...: Scenarios; all if none is given.
    reading NAME: Reading of a paper that has several; the one that is taken if none is given.

    Example: jaxilc reproduce cao-2019 --reading amplitude --report out/cao-2019.html
    """
    tell("reproduce", written, scenarios=scenario, details=details, reading=reading)


def export(
    pages: Pages,
    source: Annotated[str | None, SCENARIO] = None,
    format: Annotated[str, Option(autocompletion=of_list("c", "fmu", "hal", "st"))] = "c",
    out: Annotated[Path, Option(callback=folder_to_write)] = Path("law"),
    check: Path | None = None,
    state: Path | None = None,
    limit: float | None = None,
    number: Annotated[str, Option(autocompletion=of_list("double", "float"))] = "double",
    scheme: Schemes = None,
    machines: Machines = 64,
    seed: Seed = 0,
    set_: list[str] | None = None,
    params: Path | None = None,
) -> None:
    """A learning law as a program for a controller, with its guard and certificate.

    The law is the traced program itself: C99 without allocation, an FMU, a
    component of LinuxCNC or a function block in Structured Text. Its guard goes
    back to the last good input where `next` refuses a trial.

    format: c, fmu, hal (LinuxCNC) or st (Structured Text).
    out FOLDER: Where it is written.
    check FOLDER: Prove that code, vectors and certificate of a folder belong together.
    state FOLDER: Start with what a campaign has learned.
    limit: Largest |input|, never exceeded; the machine's own if not given.
    number: double or float.

    Example: jaxilc export axis.design.toml --limit 10 --out law
    """
    if check is not None:
        if source is not None:
            raise ValueError(f"{source} and --check exclude each other; the folder has its own law")
        given = {"state": state, "limit": limit, "scheme": scheme, "set": set_, "params": params}
        _only_for("a law to write", **given)
        tell("check_export", pages, check, bar=False)
        return
    if state is not None:
        _only_for("a scenario", scheme=scheme, set=set_, params=params)
    request = None if source is None else asked(source, scheme, set_, params=params)
    tell(
        "export", pages, request, format=format, state=state, limit=limit, number=number,
        machines=machines, seed=seed, folder=out,
    )  # fmt: skip


def _place_to_write(param: typer.CallbackParam, path: Path | None) -> Path | None:
    """The path of a plant file, or of a folder, that can be written."""
    return (file_to_write if _is_plant_file(path) else folder_to_write)(param, path)


Averages = Annotated[int | None, left("the heading `coherence (N averages)` of the file does it")]


def _is_plant_file(path: Path | None) -> bool:
    return path is not None and path.suffix == ".toml"


def _zeros(zeros: str | None) -> int | str | None:
    """The number of zeros, or `any`."""
    if zeros is None or zeros == "any":
        return zeros
    if not zeros.isdecimal():
        raise ValueError(f"--zeros {zeros} is neither a whole number nor `any`")
    return int(zeros)


def identify(
    pages: Pages,
    record: Annotated[Path | None, Argument()] = None,
    state: Path | None = None,
    poles: int | None = None,
    pairs: int | None = None,
    zeros: str | None = None,
    delay: int | None = None,
    auto: bool = False,
    time: str = "t",
    time_unit: Annotated[str | None, left("the unit in the heading of the times does it")] = None,
    input: str = "u",
    output: str = "y",
    columns: str | None = None,
    dt: float | None = None,
    validate: Path | None = None,
    resample: Annotated[float | None, left("--dt DT does it")] = None,
    averages: Averages = None,
    out: Annotated[Path | None, Option(callback=_place_to_write)] = None,
    force: bool = False,
) -> None:
    """A plant from a recorded experiment or a measured frequency response, with its reliability.

    A frequency response is known by its header: frequency, then re and im, or magnitude and phase,
    each with its unit, or complex text; std, variance or coherence if there is one.
    With --out axis.toml it also writes a plant file that every other command takes.
    With --state the record is what a campaign of `jaxilc next` has measured; the plant
    file is then that of the campaign, with the fitted plant in it.

    record RECORD: Columns of time, input, output; or of a frequency response; or .npz, .mat.
    state: Folder of a campaign, whose trials are the record, in place of one.
    poles: Real poles; 1 if not given.
    pairs: Pairs of poles, real or complex; 1 if not given.
    zeros N|any: Real zeros, or `any`, real and complex ones; 1 if not given.
    delay: Dead time in samples; chosen by --auto, fitted to a response, else 0.
    auto: Choose poles, zeros and delay, complex zeros, too; with --state real zeros.
    dt: Sample time in s: of a file without times, of a response's hold; new for others.
    validate FILE: A second record, of the same columns, which judges.
    out: Plant file FILE.toml to write; or folder for figures, out/identify otherwise.
    force: Replace a plant file.

    Example: jaxilc identify record.csv --auto --out axis.toml
    """
    counts = {"poles": poles, "pairs": pairs, "zeros": _zeros(zeros)}
    for name, value in counts.items():
        if auto and value is not None:
            raise ValueError(f"--{name} {value} is not allowed with --auto, which chooses it")
    at_least(0, delay=delay)
    at_least(2, averages=averages)
    plant_file = out if _is_plant_file(out) else None
    if plant_file is not None and plant_file.exists() and not force:
        raise FileExistsError(f"{plant_file} exists already; add --force to replace it")
    folder = None if plant_file is not None else out
    if state is not None:
        if zeros == "any":
            raise ValueError("--zeros any is for a RECORD; with --state it is a number")
        for_files = {
            "dt": dt, "resample": resample, "columns": columns, "averages": averages,
            "validate": validate,
        }  # fmt: skip
        wrong = [f"--{name}" for name, value in for_files.items() if value is not None]
        if record is not None or wrong:
            raise ValueError(f"{', '.join(wrong) or 'RECORD'} and --state exclude each other")
        tell(
            "identify_campaign", pages, state, counts=counts, delay=delay, auto=auto,
            plant_file=plant_file, folder=folder,
        )  # fmt: skip
        return
    if record is None:
        raise ValueError("RECORD is missing; give a file, or --state and the folder of a campaign")
    structure = {name: 1 if value is None else value for name, value in counts.items()}
    reading = {
        "structure": {} if auto else structure, "delay": delay, "dt": dt, "averages": averages,
        "time": time, "input": input, "output": output, "time_unit": time_unit,
        "columns": names_in(columns), "resample": resample,
    }  # fmt: skip
    tell(
        "identify", pages, record, reading=reading, validate=validate,
        plant_file=plant_file, folder=folder,
    )  # fmt: skip


RECORDS = (".csv", ".txt", ".dat", ".frf")
FILTER_DOES = "outcomes.filter_{}(...) in Python does it"
MEASURED = FILTER_DOES.format("measured")
TAPS = 41  # of each filter that --synthesise finds


def filter_(
    source: Annotated[list[str], Argument()],
    written: Written,
    scheme: Schemes = None,
    margin: float = 0.1,
    vary: list[str] | None = None,
    spread: float | None = None,
    machines: int | None = None,
    seed: Seed = 0,
    set_: list[str] | None = None,
    params: Path | None = None,
    gain: float | None = None,
    lead: int | None = None,
    cutoff: float | None = None,
    dt: float | None = None,
    taps: int | None = None,
    sampling: Annotated[str | None, left(FILTER_DOES.format(""))] = None,
    order: Annotated[int | None, left(MEASURED)] = None,
    sigmas: Annotated[float | None, left(MEASURED)] = None,
    averages: Averages = None,
    synthesise: Annotated[bool, left("--taps N does it")] = False,
    band: Annotated[float | None, left(FILTER_DOES.format(""))] = None,
) -> None:
    """Is my Q-filter safe, by how much, and how far may I go?

    |Q (1 - L P)| below 1 at every frequency, for every machine of the uncertainty or every line of
    a measured response, with the largest cutoff, gain and lead that keep a margin.

    source SCENARIO|FRF.csv...: Of `jaxilc list`, a TOML or JSON file, or measured frequency
        responses.
    margin: 1 - |Q (1 - L P)| that an offer keeps.
    vary PATH=SHARE: Instead of the file's uncertainty: plant.gain=15%; repeatable.
    machines: Machines drawn, beside all corners; 32 if not given.
    gain: Learning gain, for an FRF.
    lead: Lead of the learning [samples], for an FRF; 0 if not given.
    cutoff: Of the filter [Hz], for an FRF.
    dt: Sample time [s], for an FRF.
    taps N: Find filters Q and L of N taps by convex optimisation too.

    Example: jaxilc filter axis.toml --vary plant.B=15%
    """
    taps = TAPS if synthesise and taps is None else taps
    how: dict[str, Value] = {"margin": margin, "taps": taps, "band": band}
    law: dict[str, Value] = {"gain": gain, "cutoff": cutoff, "dt": dt}
    of_record: dict[str, Value] = {
        "lead": lead, "order": order, "sigmas": sigmas, "averages": averages,
    }  # fmt: skip
    drawn: dict[str, Value] = {"vary": vary, "machines": machines, "sampling": sampling}
    records = [Path(one).suffix.lower() in RECORDS for one in source]
    if all(records):
        _only_for("a scenario", scheme=scheme, spread=spread, set=set_, params=params, **drawn)
        missing = [f"--{name}" for name, value in law.items() if value is None]
        if missing:
            raise ValueError(
                f"a measured response needs a law: {', '.join(missing)} not given; u is learned by "
                "u + gain e[k + 1 + lead] with a low-pass of --cutoff"
            )
        tell("filter_measured", written, source, **how, **law, **of_record)
    elif any(records) or len(source) > 1:
        raise ValueError(
            f"filter takes one scenario, or measured responses {', '.join(RECORDS)}; given are "
            f"{', '.join(source)}"
        )
    else:
        _only_for("a measured response", **law, **of_record)
        request = asked(source[0], scheme, set_, params=params, spread=spread)
        tell("filter_", written, request, seed=seed, **drawn, **how)


def _only_for(what: str, **given: object) -> None:
    """Raises ValueError for an option that belongs to the other kind of source."""
    for name, value in given.items():
        if value is not None:
            raise ValueError(f"--{name} is for {what} only")


LAWS = ("p-type", "pd-type", "p-type-notch", "model-inverse", "norm-optimal", "learned")
INSTEAD = "outcomes.learn_law({}=...) in Python does it"


@dataclasses.dataclass(frozen=True)
class ForMachine:
    """The machine that a law is for, and how the law is judged.

    plant_file FILE: Plant file, TOML or JSON; see `jaxilc init`.
    scheme: Scheme of the file whose feedback is taken.
    margin: Least distance of |Q (1 - L P)| from 1, on every machine.
    machines: Machines that judge.
    """

    plant_file: Annotated[str, Argument()]
    scheme: OneScheme = None
    margin: float = 0.05
    trials: int | None = None
    machines: int = 257
    spread: float | None = None
    seed: Seed = 0
    set_: list[str] | None = None


@dataclasses.dataclass(frozen=True)
class LawWritten(Written):
    """The plant file that is left, the folder of the state, and where else results go.

    out_dir: Folder for the state; out/COMMAND-NAME if not given.
    out FILE: Plant file to write; beside the one given, as axis.design.toml or axis.learned.toml,
        if not given.
    force: Replace that file, and its state.
    """

    out_dir: Annotated[Path | None, Option("--state", callback=folder_to_write)] = None
    out: FileToWrite = None
    force: bool = False
    resume: bool = False


def design(
    what: ForMachine,
    written: LawWritten,
    law: Annotated[list[str] | None, Option(autocompletion=of_list(*LAWS))] = None,
    steps: int = 30,
    record: list[str] | None = None,
) -> None:
    """Which learning law for this machine, with which weights, is it safe, and what will it reach.

    It tries several laws: safe weights by the frequency response of all machines,
    tuned by gradient, one of them by its taps (see `learn-law`), and judged on machines
    that were not used. The best one is written to a plant file that every other command
    takes. With --record it says whether the error repeats from trial to trial, in a
    period or in the position, and writes the law that follows beside it.

    law LAW: Law to try; repeatable. All if not given.
    steps: Steps of each tuning at most.
    record FILE: Trial without learning, with columns e or y and r; repeatable. It tells in what the
        error repeats.

    Example: jaxilc design axis.toml
    """
    _tell("design", what, written, laws=law, steps=steps, record=record)


def learn_law(
    what: ForMachine,
    written: LawWritten,
    taps: str = "61,31",
    limit: float | None = None,
    steps: int = 60,
    start: Annotated[str | None, left(INSTEAD)] = None,
    segments: Annotated[str, left(INSTEAD)] = "",
    decentralised: Annotated[bool, left(INSTEAD.format("coupled"))] = False,
    trained_on: Annotated[int | None, left(INSTEAD)] = None,
    objective: Annotated[str | None, left(INSTEAD)] = None,
    risk: Annotated[str | None, left(INSTEAD)] = None,
) -> None:
    """Learn the update law itself, the taps of L and Q, and prove it safe before it is written.

    The taps come from gradients through the learning of many machines. A law that
    is not safe on every machine of a dense family is taken back, or not written. Of
    several channels the taps are matrices.

    taps L,Q: Odd numbers of taps of L and of Q.
    limit: Largest |u| that is learned; none if not given.
    steps: Steps through learning; 0 for the frequency response alone.

    Example: jaxilc learn-law axis.toml --taps 61,31
    """
    _tell(
        "learn_law", what, written,
        taps=_numbers("taps", taps, int, "two odd numbers, as in 61,31", 2),
        segments=_numbers("segments", segments, float, "times in seconds, as in 0.2,0.5"),
        coupled=not decentralised, limit=limit, steps=steps, start=start, trained_on=trained_on,
        objective=objective, risk=risk,
    )  # fmt: skip


def _tell(command: str, what: ForMachine, written: LawWritten, **how: Value) -> None:
    """Ask for a law, and print sentences on the way to it."""
    prefer("float64")  # what is proved of a law holds in it
    schemes = [] if what.scheme is None else [what.scheme]
    tell(
        command, written,
        asked(what.plant_file, schemes, what.set_, trials=what.trials, spread=what.spread),
        margin=what.margin, machines=what.machines, seed=what.seed, out=written.out,
        force=written.force, resume=written.resume, say=between, **how,
    )  # fmt: skip


def _numbers(
    option: str, text: str, kind: Callable[[str], float], allowed: str, count: int | None = None
) -> tuple[float, ...]:
    """Numbers with commas between. Raises ValueError for other text, and for another count."""
    with suppress(ValueError):
        found = tuple(kind(part) for part in text.split(",") if part.strip())
        if count in (None, len(found)):
            return found
    raise ValueError(f"--{option} {text!r} is not allowed; allowed are {allowed}")
