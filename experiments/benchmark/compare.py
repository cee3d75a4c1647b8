"""Our speed beside NumPy, Numba, C, SciPy and python-control, for the same numbers: `make bench`.

    python experiments/benchmark/compare.py --plants 1024 --json out/bench.json
    python experiments/benchmark/compare.py --scenario li-2020 --plants 16

Every contest runs for every scheme and number of plants, in turn:

SCHEME, plants             MFAILC against all opponents, or a scheme alone (`ours.ALONE`)
SCHEME gradient, plants    the gradient of MFAILC, as a tuning computes it, against its opponents
plant, plants              the plants alone
long, samples              one plant in one long trial
cost, SCHEME               the time of our run by its size
SCENARIO, machines         each scheme of a scenario that learns, alone, in place of all others

Opponents compute in float64, whatever the precision. The columns of the tables, of which `--json`
has all numbers:

ns           wall time of the best turn for each sample of each trial of each plant
times ours   wall time divided by that of our run; the median and the range of all turns
runs         the same for a gradient, in runs without one
limit ns     what the operations of a scheme alone would cost, see `operations`
build s      time to compile
MB           peak of the RAM that the first call added
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

import contests
import gradients
import jax
import ours
from ours import GRADIENT, Alone
from timing import OURS, Cost, Row, as_json, computer, in_words

import jaxilc
from jaxilc.cli.console import out
from jaxilc.outcomes.outcome import Table
from jaxilc.scenarios import Scenario
from jaxilc.scenarios.from_file import load_scenario
from jaxilc.storage.sealed import write_json

CONTESTS, OF_SCENARIO = (1, 16, 1024), (64,)  # numbers of plants where none are given


class Programme(NamedTuple):
    """The sizes of a benchmark.

    plants: numbers S of plants
    trials: number J of trials
    samples: number N of samples of a trial
    schemes: names from `contests.SCHEMES` and `ours.ALONE`
    long: number of samples of the long trial, 0 for no such trial
    repeats: number of turns of every contender
    gradients: whether gradients are timed
    costs: whether times are measured by size
    scenarios: scenarios whose schemes are timed, in place of everything else
    """

    plants: Sequence[int]
    trials: int = 80
    samples: int = 2000
    schemes: Sequence[str] = tuple(contests.SCHEMES)
    long: int = 100_000
    repeats: int = 5
    gradients: bool = True
    costs: bool = True
    scenarios: Sequence[Scenario] = ()

    def check(self) -> None:
        """Raises ValueError, before anything runs, for an unknown scheme or a wrong size."""
        allowed = (*contests.SCHEMES, *ours.ALONE)
        for name in self.schemes:
            if name not in allowed:
                raise ValueError(f"--schemes {name!r} is not one of {', '.join(allowed)}")
        if min(self.plants) < 1:
            raise ValueError(f"--plants {min(self.plants)} is outside its allowed range [1, inf)")
        if self.long and self.long < 4:
            raise ValueError(f"--long {self.long} is not 0 or a whole number from 4 on")
        if self.repeats < 1:
            raise ValueError(f"--repeats {self.repeats} is outside its allowed range [1, inf)")
        for chosen in self.scenarios:
            ours.schemes_of(chosen)
            for size in self.plants:
                ours.need_room(chosen, size)
        if not self.scenarios:
            for size in self.plants:
                contests.need_room(size, self.trials, self.samples)
            contests.need_room(1, 1, self.long)


def measure(programme: Programme) -> dict[str, Any]:
    """Run the programme and print its tables, and return all measurements in a form for JSON.

    Raises ValueError as `Programme.check` does, and ArithmeticError where numbers differ.
    """
    programme.check()
    jax.config.update("jax_enable_compilation_cache", False)  # compiling is measured too
    numbers: dict[str, Any] = {
        "machine": computer(),
        "rows": {},
        "operations_ns": {},
        "cost": {},
        "gradients": {},
    }
    tell(in_words(numbers["machine"]))
    turns = f"the best of {programme.repeats} turns" if programme.repeats > 1 else "one turn"
    tell(f"ns: for each sample of each trial of each plant, in {turns}")
    if programme.scenarios:
        _measure_scenarios(programme, numbers)
    else:
        numbers |= {"trials": programme.trials, "samples": programme.samples}
        _measure_schemes(programme, numbers)
        _measure_plants(programme, numbers)
        if programme.costs:
            _measure_costs(programme, numbers)
    numbers["machine_after"] = computer()
    before, after = (numbers[name]["load"] for name in ("machine", "machine_after"))
    tell(f"load of the machine: {before} before, {after} after")
    return numbers


def _measure_scenarios(programme: Programme, numbers: dict[str, Any]) -> None:
    options = {"gradients": programme.gradients, "repeats": programme.repeats}
    numbers["scenarios"] = {
        chosen.name: {"trials": chosen.trials, "samples": chosen.task.N}
        for chosen in programme.scenarios
    }
    for chosen in programme.scenarios:
        for size in programme.plants:
            by_scheme = {}
            for name in ours.schemes_of(chosen):
                begins(f"{chosen.name}, {size} machines: {name}")
                by_scheme[name] = ours.of_scenario(chosen, name, size, **options)
            of_trials = f"{chosen.trials} trials of {chosen.task.N} samples"
            out.print(alone_table(f"{chosen.name}: {size} machines, {of_trials}", by_scheme))
            for name, times in by_scheme.items():
                _keep_alone(f"{chosen.name}/{name}/{size}", times, numbers)
                if times.dropped:
                    tell(f"{name}: {times.dropped} of {size} machines have no finite slope")


def _measure_schemes(programme: Programme, numbers: dict[str, Any]) -> None:
    repeats = programme.repeats
    of_trials = f"{programme.trials} trials of {programme.samples} samples"
    contested = any(name in contests.SCHEMES for name in programme.schemes)
    opponents, of_gradients = _opponents(programme, numbers) if contested else ({}, {})
    for name in programme.schemes:
        for size in programme.plants:
            begins(f"{name}, {size} plants")
            if name in ours.ALONE:
                times = ours.alone(name, size, gradients=programme.gradients, repeats=repeats)
                out.print(alone_table(f"{size} plants, 10 trials of 2000 samples", {name: times}))
                _keep_alone(f"{name}/{size}", times, numbers)
                continue
            setting = contests.setting(name, size, programme.trials, programme.samples)
            rows = contests.compare(setting, opponents, repeats=repeats)
            _keep(f"{name}/{size}", f"{name}, {size} plants, {of_trials}", rows, numbers)
            if not programme.gradients:
                continue
            begins(f"gradient of {name}, {size} plants")
            try:
                rows = gradients.compare_gradients(setting, of_gradients, repeats=repeats)
            except gradients.Diverges as error:
                tell(f"gradient of {name}, {size} plants, left out: {error}")
                continue
            title = f"gradient of {name}, {size} plants, in runs of jaxilc without it"
            _keep(f"{name} gradient/{size}", title, rows, numbers, "runs")


def _opponents(programme: Programme, numbers: dict[str, Any]) -> tuple[dict, dict]:
    """The opponents that run here, and those of gradients; `numbers` gets the notes on them."""
    opponents, notes = contests.opponents()
    of_gradients, more = (
        gradients.gradient_opponents(opponents) if programme.gradients else ({}, [])
    )
    numbers["notes"] = [*notes, *more]
    for text in numbers["notes"]:
        tell(text)
    return opponents, of_gradients


def _measure_plants(programme: Programme, numbers: dict[str, Any]) -> None:
    for size in programme.plants:
        setting = contests.setting("cfdl", size, 1, programme.samples)
        rows = contests.compare_plant(setting, repeats=programme.repeats)
        _keep(f"plant/{size}", f"the plant alone, {size} plants", rows, numbers)
    if programme.long:
        rows = contests.compare_long(programme.long, repeats=programme.repeats)
        title = f"one plant, one trial of {programme.long} samples"
        _keep(f"long/{programme.long}", title, rows, numbers)


def _measure_costs(programme: Programme, numbers: dict[str, Any]) -> None:
    size = min(max(programme.plants), 1024)
    for name in programme.schemes:
        if name in contests.SCHEMES:
            begins(f"{name} by size")
            by_size = contests.cost_by_size(
                name, size, programme.trials, programme.samples, repeats=programme.repeats
            )
            out.print(cost_table(name, by_size))
            numbers["cost"][name] = {
                what: {"seconds": best, **line._asdict()} for what, (best, line) in by_size.items()
            }


def _keep(
    key: str,
    title: str,
    rows: Mapping[str, Row],
    numbers: dict[str, Any],
    counted: str = "times ours",
) -> None:
    out.print(contest_table(title, rows, counted))
    numbers["rows"][key] = as_json(rows)


def _keep_alone(key: str, times: Alone, numbers: dict[str, Any]) -> None:
    numbers["rows"][key] = as_json(times.rows)
    numbers["operations_ns"][key] = times.limit
    if times.weights:
        numbers["gradients"][key] = {"weights": times.weights, "dropped": times.dropped}


# What is printed
# --------------------------------------------------------------------------------------------------


def tell(text: str) -> None:
    out.print(text, highlight=False)


def begins(text: str) -> None:
    """Print on a terminal what is timed next, which may take minutes."""
    if sys.stderr.isatty():
        print(f"{text} ...", file=sys.stderr)


def contest_table(title: str, rows: Mapping[str, Row], counted: str) -> Table:
    """A table with a row for each contender.

    counted: what the ratios of wall times to that of our run count
    """
    table = _table("", "ran", "ns", counted, "range", "build s", "MB", title=title)
    for row in rows.values():
        ratios = row.ratios(rows[OURS])
        table.add_row(
            row.name,
            f"{row.plants} x {row.trials}",
            _short(row.best),
            _short(median(ratios)),
            f"{_short(min(ratios))}-{_short(max(ratios))}",
            _seconds(row),
            _megabytes(row),
        )
    return table


def alone_table(title: str, schemes: Mapping[str, Alone]) -> Table:
    """A table with a row for each scheme: its run, the limit of it, its gradient in runs."""
    columns = ("scheme", "run ns", "limit ns", "times", "gradient", "weights", "build s", "MB")
    table = _table(*columns, title=title)
    for name, times in schemes.items():
        run, gradient = times.rows[OURS], times.rows.get(GRADIENT)
        if gradient is None:
            cells = ("", "", _seconds(run), _megabytes(run))
        else:
            cells = (
                f"{_short(median(gradient.ratios(run)))} runs",
                str(len(times.weights)),
                f"{_seconds(run)} + {_seconds(gradient)}",
                _megabytes(gradient),
            )
        limit = (_short(times.limit), _short(run.best / times.limit))
        table.add_row(name, _short(run.best), *limit, *cells)
    return table


def cost_table(name: str, by_size: Mapping[str, tuple[dict[int, float], Cost]]) -> Table:
    """A table with a row for each size that was varied, and the line fitted to its times."""
    columns = ("", "sizes", "ms", "start ms", "us each", "off by")
    table = _table(*columns, title=f"{name}: times by size, and the line through them")
    for what, (best, line) in by_size.items():
        table.add_row(
            what,
            ", ".join(map(str, best)),
            ", ".join(_short(1e3 * seconds) for seconds in best.values()),
            f"{1e3 * line.start:.2g}",
            f"{1e6 * line.slope:.3g}",
            f"{100 * line.residual:.0f} %",
        )
    return table


def _table(*headers: str, title: str) -> Table:
    """A table without rows, whose first two columns are folded only after all others."""
    table = Table(title=title)
    for place, header in enumerate(headers):
        table.add_column(header, whole=place < 2)
    return table


def _short(number: float) -> str:
    """A number with three digits, or all of its whole part, without an exponent."""
    return f"{number:.0f}" if number >= 1000 else f"{number:.3g}"


def _seconds(row: Row) -> str:
    seconds = row.compile_seconds if row.compile_seconds >= 0.005 else 0.0
    return f"{seconds:.0f}" if seconds >= 10 else f"{seconds:.2g}"


def _megabytes(row: Row) -> str:
    return "" if row.peak_bytes is None else f"{row.peak_bytes / 1e6:.0f}"


# The command
# --------------------------------------------------------------------------------------------------


def asked_of(arguments: Sequence[str] | None) -> argparse.Namespace:
    """The options, from the command line where no arguments are given."""
    options = argparse.ArgumentParser(description=(__doc__ or "").partition(":")[0])
    names: dict[str, Any] = {"type": lambda text: text.split(",")}
    options.add_argument(
        "--plants",
        type=lambda text: [int(number) for number in text.split(",")],
        help="numbers of plants, with commas; if not given, "
        f"{','.join(map(str, CONTESTS))}, or {OF_SCENARIO[0]} of a scenario",
    )
    options.add_argument("--trials", type=int, help="trials J")
    options.add_argument("--samples", type=int, help="samples N of a trial")
    options.add_argument(
        "--schemes", **names, help="cfdl, ffdl, with opponents; noilc, ilc-asmc, alone; with commas"
    )
    options.add_argument(
        "--gradients", action=argparse.BooleanOptionalAction, help="whether gradients are timed too"
    )
    options.add_argument(
        "--scenario",
        dest="scenarios",
        **names,
        help="time only the schemes of these scenarios or files that learn, alone and in their "
        "own size; with commas",
    )
    options.add_argument(
        "--long", type=int, help="samples of one long trial, by steps and in blocks; 0 for none"
    )
    options.add_argument("--repeats", type=int, help="turns; contenders take turns")
    options.add_argument("--json", type=Path, help="file for all numbers")
    options.add_argument("--precision", choices=("float64", "float32"), default="float64")
    options.set_defaults(**Programme(())._asdict())
    return options.parse_args(arguments)


def main(arguments: Sequence[str] | None = None) -> None:
    asked = asked_of(arguments)
    jaxilc.setup(precision=asked.precision)
    asked.scenarios = [load_scenario(name) for name in asked.scenarios]
    asked.plants = asked.plants or (OF_SCENARIO if asked.scenarios else CONTESTS)
    numbers = measure(Programme(**{name: getattr(asked, name) for name in Programme._fields}))
    if asked.json is not None:
        asked.json.parent.mkdir(parents=True, exist_ok=True)
        write_json(asked.json, numbers)
        tell(f"written: {asked.json}")


if __name__ == "__main__":
    try:
        main()
    except (ValueError, OSError) as error:
        sys.exit(f"error: {error}")
