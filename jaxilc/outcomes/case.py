"""What a verdict needs to know of a scenario and of what was asked."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from ..learning.known_metrics import ERRORS
from ..scenarios import Scenario
from ..schemes.scheme import trials_of_step
from .request import Request
from .words import number

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


def output_names(scenario: Scenario) -> list[str]:
    """What the outputs are called: their names, or `output 0`, `output 1`, ..."""
    labels = scenario.task.labels
    return [one if isinstance(one, str) else f"output {one}" for one in labels]


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
        """The errors by scheme; an experiment has that of the learned trial before it."""
        every = {name: self.steps.get(name, 1) for name in errors}
        return {
            name: [of_scheme[j - j % every[name]] for j in range(len(of_scheme))]
            for name, of_scheme in errors.items()
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
