"""The verdict of `bench`: how fast, beside the fastest other program, and the next command."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from typing import Any

from ...bench.ours_alone import GRADIENT
from ...bench.timing import OURS
from ..tables import number
from .next_command import Verdict


def bench_verdict(rows: Mapping[str, Mapping[str, Any]], asked: Sequence[str]) -> Verdict:
    """How long a sample takes, and how much longer or shorter with the fastest other program.

    rows: times by contest, such as `cfdl/1024`, then by contender
    asked: scenarios whose schemes were timed, in place of contests
    """
    what = "with which machines" if asked else "the schemes of a scenario"
    words = ["sweep", asked[0]] if asked else ["bench", "--scenario", "cao-2019"]
    following = shlex.join(["jaxilc", *words])
    whole = {name: row for name, row in rows.items() if f" {GRADIENT}/" not in name}
    if not whole:
        return Verdict((), what, following)
    contest, times = max(whole.items(), key=lambda item: (len(item[1]), item[1][OURS]["plants"]))
    name, plants = contest.rpartition("/")[0], times[OURS]["plants"]
    count = f"{plants} plant{'s' * (plants != 1)}"
    first = f"{name}, {count}: {number(times[OURS]['ns_best'])} ns for each sample of each"
    said = [f"{first} trial of each plant."]
    if GRADIENT in times:
        ratio = number(times[GRADIENT]["ns_best"] / times[OURS]["ns_best"])
        said.append(f"A gradient takes as long as {ratio} runs.")
    others = {name: row for name, row in times.items() if name not in (OURS, GRADIENT)}
    if others:
        fastest = min(others, key=lambda name: others[name]["ns_best"])
        ratio = number(others[fastest]["ns_best"] / times[OURS]["ns_best"])
        said.append(f"The fastest of {len(others)} others, {fastest}, takes {ratio} times as long.")
    return Verdict(tuple(said), what, following)
