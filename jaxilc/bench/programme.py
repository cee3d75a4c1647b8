"""The programme of `jaxilc bench`: every contest for every scheme and number of plants, in turn.

SCHEME, plants             MFAILC against all opponents, or a scheme alone (`ours_alone.ALONE`)
SCHEME gradient, plants    the gradient of MFAILC against its opponents
plant, plants              the plants alone
long, samples              one plant in one long trial
cost, SCHEME               the time of our run by its size
SCENARIO, machines         each scheme of a scenario that learns, alone, in place of all others
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax

from ..scenarios import Scenario
from . import contests, gradients, ours_alone, settings
from .computer import computer, in_words
from .ours_alone import Alone
from .timing import Cost, Row, as_json

ByTheSize = dict[str, tuple[dict[int, float], Cost]]  # result of `contests.cost_by_size`


class Programme(NamedTuple):
    """The sizes of a benchmark.

    plants: numbers S of plants
    trials: number J of trials
    samples: number N of samples of a trial
    schemes: names from `SCHEMES` and `ALONE`
    long: number of samples of the long trial, 0 for no such trial
    repeats: number of turns of every contender
    gradients: whether gradients are timed
    scenarios: scenarios whose schemes are timed, in place of everything else
    """

    plants: Sequence[int]
    trials: int
    samples: int
    schemes: Sequence[str]
    long: int
    repeats: int
    gradients: bool = True
    scenarios: Sequence[Scenario] = ()

    def check(self) -> None:
        """Raises ValueError, before anything runs, for an unknown scheme or a wrong size."""
        allowed = (*settings.SCHEMES, *ours_alone.ALONE)
        for name in self.schemes:
            if name not in allowed:
                raise ValueError(f"--schemes {name!r} is not one of {', '.join(allowed)}")
        if self.long and self.long < 4:
            raise ValueError(f"--long {self.long} is not 0 or a whole number from 4 on")
        if self.repeats < 1:
            raise ValueError(
                f"bench: repeats = {self.repeats} is outside its allowed range [1, inf)"
            )
        for chosen in self.scenarios:
            ours_alone.schemes_of(chosen)
            for size in self.plants:
                ours_alone.need_room(chosen, size)
        if not self.scenarios:
            for size in self.plants:
                settings.need_room(size, self.trials, self.samples)
            settings.need_room(1, 1, self.long)


class Show(NamedTuple):
    """Functions that show the results as soon as they are measured.

    note: shows a text, such as why an opponent does not run here
    rows: shows the title and the rows of a contest, and what its ratios count
    costs: shows a scheme and its times by size
    alone: shows the title and the times of schemes by their names
    begins: shows what is timed next, which may take minutes
    """

    note: Callable[[str], object]
    rows: Callable[[str, Mapping[str, Row], str], object]
    costs: Callable[[str, ByTheSize], object]
    alone: Callable[[str, Mapping[str, Alone]], object]
    begins: Callable[[str], object]


def measure(programme: Programme, show: Show) -> dict[str, Any]:
    """Run the programme, and return all measurements in a form for JSON.

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
    show.note(in_words(numbers["machine"]))
    turns = f"the best of {programme.repeats} turns" if programme.repeats > 1 else "one turn"
    show.note(f"ns: for each sample of each trial of each plant, in {turns}")
    if programme.scenarios:
        _measure_scenarios(programme, show, numbers)
    else:
        numbers |= {"trials": programme.trials, "samples": programme.samples}
        _measure_schemes(programme, show, numbers)
        _measure_plants(programme, show, numbers)
        _measure_costs(programme, show, numbers)
    numbers["machine_after"] = computer()
    return numbers


def _measure_scenarios(programme: Programme, show: Show, numbers: dict[str, Any]) -> None:
    options = {"gradients": programme.gradients, "repeats": programme.repeats}
    numbers["scenarios"] = {
        chosen.name: {"trials": chosen.trials, "samples": chosen.task.N}
        for chosen in programme.scenarios
    }
    for chosen in programme.scenarios:
        for size in programme.plants:
            found = {}
            for name in ours_alone.schemes_of(chosen):
                show.begins(f"{chosen.name}, {size} machines: {name}")
                found[name] = ours_alone.of_scenario(chosen, name, size, **options)
            trials, samples = chosen.trials, chosen.task.N
            size_of = f"{size} machines, {trials} trials of {samples} samples"
            show.alone(f"{chosen.name}: {size_of}", found)
            for name, times in found.items():
                _keep_alone(f"{chosen.name}/{name}/{size}", times, numbers)
                if times.dropped:
                    show.note(f"{name}: {times.dropped} of {size} machines have no finite slope")


def _measure_schemes(programme: Programme, show: Show, numbers: dict[str, Any]) -> None:
    options = {"repeats": programme.repeats}
    contested = [name for name in programme.schemes if name in settings.SCHEMES]
    opponents, of_gradients = _opponents(programme, show, numbers) if contested else ({}, {})
    for name in programme.schemes:
        for size in programme.plants:
            show.begins(f"{name}, {size} plants")
            if name in ours_alone.ALONE:
                times = ours_alone.alone(name, size, gradients=programme.gradients, **options)
                show.alone(f"{size} plants, 10 trials of 2000 samples", {name: times})
                _keep_alone(f"{name}/{size}", times, numbers)
                continue
            setting = settings.setting(name, size, programme.trials, programme.samples)
            found = contests.compare(setting, opponents, **options)
            of_trials = f"{programme.trials} trials of {programme.samples} samples"
            show.rows(f"{name}, {size} plants, {of_trials}", found, "times ours")
            numbers["rows"][f"{name}/{size}"] = as_json(found)
            if not programme.gradients:
                continue
            show.begins(f"gradient of {name}, {size} plants")
            try:
                found = gradients.compare_gradients(setting, of_gradients, **options)
            except gradients.Diverges as error:
                show.note(f"gradient of {name}, {size} plants, left out: {error}")
                continue
            title = f"gradient of {name}, {size} plants, in runs of jaxilc without it"
            show.rows(title, found, "runs")
            numbers["rows"][f"{name} gradient/{size}"] = as_json(found)


def _opponents(programme: Programme, show: Show, numbers: dict[str, Any]) -> tuple[dict, dict]:
    """The opponents that run here, and those of gradients; `numbers` gets the notes on them."""
    found, notes = contests.opponents()
    of_gradients, more = gradients.gradient_opponents(found) if programme.gradients else ({}, [])
    numbers["notes"] = [*notes, *more]
    for text in numbers["notes"]:
        show.note(text)
    return found, of_gradients


def _keep_alone(key: str, times: Alone, numbers: dict[str, Any]) -> None:
    numbers["rows"][key] = as_json(times.rows)
    numbers["operations_ns"][key] = times.limit
    if times.weights:
        numbers["gradients"][key] = {"weights": times.weights, "dropped": times.dropped}


def _measure_plants(programme: Programme, show: Show, numbers: dict[str, Any]) -> None:
    for size in programme.plants:
        setting = settings.setting("cfdl", size, 1, programme.samples)
        found = contests.compare_plant(setting, repeats=programme.repeats)
        show.rows(f"the plant alone, {size} plants", found, "times ours")
        numbers["rows"][f"plant/{size}"] = as_json(found)
    if programme.long:
        found = contests.compare_long(programme.long, repeats=programme.repeats)
        show.rows(f"one plant, one trial of {programme.long} samples", found, "times ours")
        numbers["rows"][f"long/{programme.long}"] = as_json(found)


def _measure_costs(programme: Programme, show: Show, numbers: dict[str, Any]) -> None:
    size = min(max(programme.plants), 1024)
    for name in programme.schemes:
        if name in settings.SCHEMES:
            show.begins(f"{name} by size")
            by_size = contests.cost_by_size(
                name, size, programme.trials, programme.samples, repeats=programme.repeats
            )
            show.costs(name, by_size)
            numbers["cost"][name] = {
                what: {"seconds": best, **line._asdict()} for what, (best, line) in by_size.items()
            }
