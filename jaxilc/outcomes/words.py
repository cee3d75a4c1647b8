"""What a sentence needs: numbers, counts, the course of an error, and what was simulated."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from statistics import median
from typing import NamedTuple

import numpy as np

from ..figures.style import prefixed
from ..learning.divergence import GROWTH
from ..learning.known_metrics import ERRORS
from ..scenarios import Scenario
from ..schemes.scheme import trials_of_step
from ..uncertainty import Uncertainty
from .request import Request

NUMBER = re.compile(r"(?<![\w.])\d+(?:\.\d+)?(?:e[+-]?\d+)?(?![\w])")


def number(value: float, digits: int = 3) -> str:
    """A number with three significant digits; ∞ for an error that diverged, – for NaN."""
    if not np.isfinite(value):
        return "∞" if value == np.inf else "–"
    if value == 0 or 1e-3 <= abs(value) < 1e5:
        return np.format_float_positional(value, precision=digits, fractional=False, trim="-")
    return f"{value:.{digits - 1}e}"


def beside_1(value: float) -> str:
    """A number with the digits that tell on which side of 1 it is, three at least."""
    texts = (number(value, digits) for digits in range(3, 18))
    return next((text for text in texts if text != "1" or value == 1), "1")


def sized(value: float, unit: str) -> str:
    """A number with its unit, with a prefix such as µ."""
    return " ".join(filter(None, (number((of := prefixed(value, unit))[0]), of[1])))


def several(count: int, one: str) -> str:
    """A count with its noun, in the plural unless it is one."""
    return f"{count} {one}{'s' * (count != 1)}"


def machine_said(at: Mapping[str, float], uncertainty: Uncertainty) -> str:
    """The numbers of a machine in words; relative ones as factors."""
    return ", ".join(
        f"{name} {'x ' if uncertainty[name].relative else '= '}{value:.4g}"
        for name, value in at.items()
    )


def counted(reasons: Iterable[str]) -> dict[str, int]:
    """How often each reason is given; where numbers alone differ, as one with their ranges."""
    groups: dict[str, list[list[float]]] = {}
    for reason in reasons:
        groups.setdefault(NUMBER.sub("{}", reason), []).append(
            [float(x) for x in NUMBER.findall(reason)]
        )
    return {
        text.format(*map(_range, zip(*rows, strict=True))): len(rows)
        for text, rows in groups.items()
    }


def _range(values) -> str:
    low, high = (f"{end(values):.6g}" for end in (min, max))
    return low if low == high else f"{low} to {high}"


# The course of an error over the trials
# --------------------------------------------------------------------------------------------------


DIVERGES, GROWS, FALLS, SETTLED, SINGLE = "diverges", "grows", "falls", "settled", "single"
CHANGE = 0.05  # share of an error that counts as a change, as in `jaxilc design`
EXACT = 1e-9
WINDOW = 3  # trials


class Trend(NamedTuple):
    """The course of an error over the trials.

    kind: `diverges`, `grows`, `falls`, `settled`, or `single` for one trial
    words: the end of a sentence whose subject is the error, empty for one trial
    """

    kind: str
    words: str


def trend_of(errors: Sequence[float]) -> Trend:
    """The trend of the errors of J trials, infinite where a trial diverged."""
    first, J = errors[0], len(errors)
    if diverged(errors):
        return Trend(DIVERGES, "diverges")
    if J == 1:
        return Trend(SINGLE, "")
    level = [max(error, EXACT * first) for error in errors]
    best = 1 + level.index(min(level))
    if level[-1] > (1 + GROWTH) * level[best - 1]:
        times = f" {number(level[-1] / level[best - 1])} times" if level[best - 1] > 0 else ""
        return Trend(GROWS, f"has grown{times} since trial {best}")
    window = min(max(WINDOW, J // 10), J - 1)
    last = median(level[-window:])
    if last < (1 - CHANGE) * min(level[:-window]):
        return Trend(FALLS, "is still falling")
    since = 1 + next(i for i, error in enumerate(level) if error <= last / (1 - CHANGE))
    if since == 1:
        return Trend(SETTLED, f"has not fallen by {CHANGE:.0%} since trial 1")
    return Trend(SETTLED, f"has settled since trial {since}")


# What a run and a sweep show of a scenario
# --------------------------------------------------------------------------------------------------


WORDS = {  # of metrics whose names are not what a sentence calls them
    "max error": "largest error",
    "rms": "rms error",
    "contour max": "largest contour error",
    "contour rms": "rms contour error",
}
OF_CONTOUR = {"max_error": "contour_max", "rms": "contour_rms"}  # metrics of an axis, of a contour
HEADS = tuple(m.head or m.name.replace("_", " ") for m in ERRORS)


def shown_trials(scenario: Scenario) -> list[int]:
    """The trials of tables: those that the scenario names, or 1, 2, 5, 10 ..., and the last."""
    decades = range(len(str(scenario.trials)))
    named = scenario.show_trials or [n * 10**k for k in decades for n in (1, 2, 5)]
    return sorted({j for j in named if j <= scenario.trials} | {scenario.trials})


def size_of(scenario: Scenario, value: float) -> str:
    """A value of the metric that judges, in the unit in which it is shown."""
    scale, unit = scenario.shown(scenario.judged_by)
    return f"{value * scale:.3g} {unit}".rstrip()


def experiment_lines(scenario: Scenario) -> list[str]:
    """A line for each scheme that makes experiments, with the trials that are none."""
    lines = []
    for name, scheme in scenario.schemes.items():
        each = trials_of_step(scheme, scenario.task)
        if each > 1:
            lines.append(
                f"{name}: what was learned is played in trials 1, {1 + each}, {1 + 2 * each} and "
                "so on; the trials between are experiments, whose errors say nothing of it"
            )
    return lines


# The case
# --------------------------------------------------------------------------------------------------


class Case(NamedTuple):
    """What was simulated, as far as a verdict needs it.

    request: what is asked
    learns: whether each scheme learns, by name
    uncertain: whether there are machines to draw
    designable: whether `jaxilc design` takes it: a plant file with one input and one output
    metric: name of the metric by which schemes are judged, in words
    unit: in which it is shown
    tolerance: largest value that passes, None if none is known
    steps: trials of a learning step by name, see `schemes.scheme.trials_of_step`
    """

    request: Request
    learns: Mapping[str, bool]
    uncertain: bool = True
    designable: bool = False
    metric: str = "settled error"
    unit: str = ""
    tolerance: float | None = None
    steps: Mapping[str, int] = {}

    @classmethod
    def of(cls, chosen: Scenario, request: Request) -> Case:
        """The case of a scenario."""
        single = chosen.task.inputs == chosen.task.outputs == 1
        return cls(
            request,
            {name: scheme.learns for name, scheme in chosen.schemes.items()},
            uncertain=bool(chosen.uncertainty),
            designable=request.of_file and single and ".design." not in request.source,
            metric=chosen.judged_by.replace("_", " "),
            unit=chosen.shown(chosen.judged_by)[1],
            tolerance=chosen.tolerance,
            steps={n: trials_of_step(s, chosen.task) for n, s in chosen.schemes.items()},
        )

    def of_learned(self, errors: Mapping[str, Sequence[float]]) -> dict[str, list[float]]:
        """The errors by scheme; an experiment has that of the learned trial before it, or ∞."""
        every = {name: self.steps.get(name, 1) for name in errors}
        return {
            name: [
                of[j - j % every[name]] if math.isfinite(of[j]) else of[j] for j in range(len(of))
            ]
            for name, of in errors.items()
        }

    @property
    def error(self) -> str:
        """What a sentence calls the metric."""
        return WORDS.get(self.metric, self.metric)

    @property
    def an_error(self) -> str:
        """The same with its article."""
        return f"{'an' if self.error.startswith(('rms', *'aeiou')) else 'a'} {self.error}"

    def size(self, value: float) -> str:
        """A value of the metric with its unit."""
        return f"{number(value)} {self.unit}".rstrip()

    def beside_tolerance(self, value: float) -> str:
        """A sentence that compares a value with the tolerance; empty if none is known."""
        if self.tolerance is None:
            return ""
        side = "within" if value <= self.tolerance else "beyond"
        return f"It is {side} the tolerance of {self.size(self.tolerance)}."

    def head(self, best: str, alike: Sequence[str] = ()) -> str:
        """The beginning of a sentence on the best scheme, and on those that end alike."""
        others = len(self.learns)
        is_best = f" is best of {others} schemes" if others > 1 else ""
        if alike:
            return f"{' and '.join((best, *alike))} end alike, best of {others} schemes: {best} in "
        still = "" if self.learns[best] else " (it does not learn)"
        return f"{best}{is_best}{still}: "

    def on(self, command: str, best: str, **changed: object) -> str:
        """The next command, on one scheme."""
        scheme = best if command == "worst-case" else self.request.name_of(best, [*self.learns])
        return self.request.following(command, scheme=scheme, **changed)

    def remedy(self, best: str) -> tuple[str, str]:
        """What to do where no scheme will do: it in words, and the command."""
        if self.designable:
            return "a law that suits the machine", self._redesigned().following("design")
        if any(self.learns.values()):
            name = best if self.learns[best] else next(n for n, yes in self.learns.items() if yes)
            return "what theory claims", self.on("certify", name)
        if self.request.schemes:
            return "all schemes", self.request.following("run")
        return "what can be set", self.request.following("list")

    def _redesigned(self) -> Request:
        """What was asked, of the schemes the feedback alone, which a design keeps."""
        kept = (
            one
            for one in self.request.set
            if ".feedback." in one or one.strip().partition(".")[0] not in self.learns
        )
        return dataclasses.replace(self.request, set=tuple(kept))


def said(*sentences: str) -> tuple[str, ...]:
    """The sentences that are not empty."""
    return tuple(filter(None, sentences))


def diverged(errors: Sequence[float]) -> bool:
    """Whether an error of a trial is not finite."""
    return not all(math.isfinite(error) for error in errors)
