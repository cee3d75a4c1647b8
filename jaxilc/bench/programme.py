"""The programme of `jaxilc bench`: every contest for every scheme and number of plants, in turn.

SCHEME, plants    MFAILC against all opponents, or a scheme alone (`contests.ALONE`)
plant, plants     the plants alone
long, samples     one plant in one long trial
cost, SCHEME      the time of our run by its size
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax

from . import contests
from .timing import OURS, Cost, Row, as_json, machine

ByTheSize = dict[str, tuple[dict[int, float], Cost]]  # result of `contests.cost_by_size`


class Programme(NamedTuple):
    """The sizes of a benchmark.

    plants: numbers S of plants
    trials: number J of trials
    samples: number N of samples of a trial
    schemes: names from `SCHEMES` and `ALONE`
    long: number of samples of the long trial, 0 for no such trial
    repeats: number of turns of every contender
    """

    plants: Sequence[int]
    trials: int
    samples: int
    schemes: Sequence[str]
    long: int
    repeats: int

    def check(self) -> None:
        """Raises ValueError, before anything runs, for an unknown scheme or a wrong size."""
        allowed = (*contests.SCHEMES, *contests.ALONE)
        for name in self.schemes:
            if name not in allowed:
                raise ValueError(f"--schemes {name!r} is not one of {', '.join(allowed)}")
        if self.long and self.long < 4:
            raise ValueError(f"--long {self.long} is not 0 or a whole number from 4 on")
        for size in self.plants:
            contests.need_room(size, self.trials, self.samples)
        contests.need_room(1, 1, self.long)


def measure(
    programme: Programme,
    *,
    note: Callable[[str], object],
    rows: Callable[[str, dict[str, Row]], object],
    costs: Callable[[str, ByTheSize], object],
) -> dict[str, Any]:
    """Run the programme, and return all measurements in a form for JSON.

    note: function that is called with a text on each opponent that does not run here
    rows: function that is called with the title and the rows of each contest when it ends
    costs: function that is called with a scheme and its times by size
    Raises ValueError as `Programme.check` does, and ArithmeticError where numbers differ.
    """
    programme.check()
    jax.config.update("jax_enable_compilation_cache", False)  # compiling is measured too
    plants, trials, samples, schemes, long, repeats = programme
    opponents, notes = contests.opponents()
    numbers: dict[str, Any] = {
        "machine": machine(),
        "precision": "float64" if jax.config.jax_enable_x64 else "float32",
        "trials": trials,
        "samples": samples,
        "rows": {},
        "cost": {},
    }
    for text in notes:
        note(text)

    def keep(key: str, title: str, found: dict[str, Row]) -> None:
        rows(title, found)
        numbers["rows"][key] = as_json(found)

    for name in schemes:
        for size in plants:
            if name in contests.ALONE:
                found = {OURS: contests.alone(name, size, repeats=repeats)}
            else:
                setting = contests.setting(name, size, trials, samples)
                found = contests.compare(setting, opponents, repeats=repeats)
            keep(f"{name}/{size}", f"{name}, {size} plants", found)
    for size in plants:
        setting = contests.setting("cfdl", size, 1, samples)
        found = contests.compare_plant(setting, repeats=repeats)
        keep(f"plant/{size}", f"the plant alone, {size} plants", found)
    if long:
        found = contests.compare_long(long, repeats=repeats)
        keep(f"long/{long}", f"one plant, one trial of {long} samples", found)
    for name in schemes:
        if name in contests.SCHEMES:
            size = min(max(plants), 1024)
            by_size = contests.cost_by_size(name, size, trials, samples, repeats=repeats)
            costs(name, by_size)
            numbers["cost"][name] = {
                what: {"seconds": best, **line._asdict()} for what, (best, line) in by_size.items()
            }
    numbers["machine_after"] = machine()
    return numbers
