"""The class of a scenario: machine, task, schemes, uncertainty, and published numbers."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple, TypedDict

import jax

from ..learning.known_metrics import METRICS, TUNED
from ..learning.machine import Machine
from ..learning.over_trials import check
from ..learning.quantities import CountedMetric
from ..pytree.aliases import Tree, Value
from ..pytree.closest import known_names, need_known, not_one_of
from ..pytree.in_short import in_short
from ..pytree.named_paths import allowed_at, get_at, owner_of, read_at, replaced, settable
from ..pytree.ranges import brief, require
from ..schemes import Scheme
from ..signals.task import Task, Trial
from ..storage.reading import printable
from ..uncertainty import Uncertainty
from .published import COMPARED, OVER_TRIALS, Conclusion, Published
from .specification import at_place

# Name of a scheme: it is part of the paths of its parameters and of the names of files.
_NAME = re.compile(r"[^\W_][\w +-]{0,49}")
_FREE_NAME = re.compile(r"[^\W_][\w .+()-]{0,49}")  # name of a scenario


class Quantity(NamedTuple):
    """A metric of a trial for this system, in addition to the common metrics of every trial.

    of: function from a trial to a number
    unit, scale: it is shown as `scale` times the number, in `unit`; None for those of the errors
    """

    of: Callable[[Trial], jax.Array]
    unit: str | None = None
    scale: float | None = None


class Learnable(NamedTuple):
    """What repeats of the motion told, as `jaxilc potential` writes it [unit of y].

    floor: rms of what is new in each trial, which any law leaves
    stop: rms error below which nothing shows that there is more to learn
    cutoff: up to which learning pays [Hz]
    """

    floor: float
    stop: float
    cutoff: float


class Look(TypedDict):
    """The metric that judges, as figures take it: its tolerance in the unit of simulation."""

    metric: str
    tolerance: float | None
    scale: float
    unit: str


@dataclasses.dataclass(frozen=True)
class Scenario:
    """A system of a paper, ready to run.

    name, title: short and long name
    machine, task: the machine that learns, and its task
    schemes: schemes by name
    trials: number J of trials
    uncertainty: distributions of the machine's leaves, by path
    published: printed numbers [shown unit]
    conclusions: what the paper concludes in words
    chosen: texts on what the paper leaves open, and what was chosen here
    tolerance: largest value of `judged_by` that passes [shown unit]; None if none is known
    shown_unit, shown_scale: errors are shown as shown_scale times the simulated ones, in shown_unit
    show_trials: trials that have a row in a table or a curve in a figure
    options: options with which the scenario was loaded
    quantities: further metrics of a trial, by name
    judged_by: the metric that tables show, and to which the tolerance belongs
    grid: values by name, over which a sweep runs; see `sweeps.grid`
    potential: what repeats of the motion told; None where it was not measured
    usual: the options where none is chosen

    Names are used in names of files and in paths of parameters; titles and units are printed.
    Raises ValueError for characters that are not allowed in them.
    """

    name: str
    title: str
    machine: Machine
    task: Task
    schemes: Mapping[str, Scheme]
    trials: int
    uncertainty: Uncertainty
    published: tuple[Published, ...] = ()
    conclusions: tuple[Conclusion, ...] = ()
    chosen: tuple[str, ...] = ()
    tolerance: float | None = None
    shown_unit: str = ""
    shown_scale: float = 1.0
    show_trials: tuple[int, ...] = ()
    options: Mapping[str, object] = dataclasses.field(default_factory=dict)
    quantities: Mapping[str, Quantity] = dataclasses.field(default_factory=dict)
    judged_by: str = "settled_error"
    grid: Mapping[str, Value] = dataclasses.field(default_factory=dict)
    potential: Learnable | None = None
    usual: Mapping[str, object] = dataclasses.field(default_factory=dict)
    __repr__ = in_short

    def __post_init__(self):
        _need_name("name", self.name, _FREE_NAME, "letters, digits, spaces and _ . + - ( )")
        for name in self.schemes:
            _need_name("scheme", name, _NAME, "letters, digits, spaces and _ + -")
            if name in ("machine", "task"):
                raise ValueError(
                    f"scheme = {name!r} is the name of the {name}'s own parameters; choose another"
                )
        _need_shown("title", self.title)
        for name in ("unit", "input_unit"):
            _need_shown(name, getattr(self.task, name), '[],;$"\\')
        _need_shown("shown_unit", self.shown_unit, '[],;$"\\')
        for limit in ("tolerance", "shown_scale"):
            require("", limit, getattr(self, limit), "(0, inf)", optional=True)
        if "contour" in self.task.names and "contour_max" in self.quantities:
            raise ValueError(
                f"task.names = {list(self.task.names)} has 'contour', as tables call the error of "
                "the path; allowed is another name"
            )
        for quantity in self.quantities.values():
            if isinstance(quantity.of, CountedMetric):
                quantity.of.check(self.machine, self.task)

    @property
    def functions(self) -> dict[str, Callable[[Trial], jax.Array]]:
        """The quantities as functions of a trial."""
        return {name: quantity.of for name, quantity in self.quantities.items()}

    def shown(self, metric: str) -> tuple[float, str]:
        """The scale and unit of a metric when shown; raises ValueError naming the known metrics."""
        if metric in self.quantities:
            _, unit, scale = self.quantities[metric]
            return (
                self.shown_scale if scale is None else scale,
                self.shown_unit if unit is None else unit,
            )
        for known in METRICS:
            if known.name == metric:
                of_output = (self.shown_scale, self.shown_unit)
                return of_output if known.unit == "output" else (1.0, known.unit_of(self.task))
        for ending in COMPARED:
            if metric.endswith(ending):
                self.shown(metric.removesuffix(ending))  # raises where there is no such metric
                return 1.0, "%"
        if metric in OVER_TRIALS:
            return self.shown_scale, self.shown_unit
        names = (*(known.name for known in METRICS), *self.quantities)
        raise ValueError(not_one_of(f"metric = {metric!r}", metric, names))

    @property
    def look(self) -> Look:
        """The metric that judges, as figures take it."""
        scale, unit = self.shown(self.judged_by)
        limit = None if self.tolerance is None else self.tolerance / scale
        return {"metric": self.judged_by, "tolerance": limit, "scale": scale, "unit": unit}

    @property
    def due(self) -> tuple[Published, ...]:
        """The published rows of a single run for these options, with any form of the plant.

        A row has the usual value of an option that it does not name.
        """

        def here(row: Published) -> bool:
            of_row = dict(self.usual) | dict(row.options)
            return all(k == "plant" or self.options.get(k) == v for k, v in of_row.items())

        return tuple(p for p in self.published if p.of_one_run and here(p))

    def select(self, names: Sequence[str]) -> Scenario:
        """The scenario with the named schemes only, or with all if `names` is empty.

        A text is the name of one scheme.

        Axes of the grid that belong to the other schemes are left out.

        Raises ValueError naming the allowed schemes.
        """
        names = (names,) if isinstance(names, str) else names
        for name in names:
            need_known(f"scheme = {name!r}", name, self.schemes)
        if not names:
            return self
        left = {*self.schemes} - {*names}
        grid = {
            key: values
            for key, values in self.grid.items()
            if not all(one.strip().partition(".")[0] in left for one in key.split("/"))
        }
        return dataclasses.replace(self, schemes={n: self.schemes[n] for n in names}, grid=grid)

    def check(self) -> None:
        """Raises ValueError, naming the scheme, where one does not fit the machine and the task."""
        for name, scheme in self.schemes.items():
            with at_place(name):
                check(self.machine, scheme, self.task)

    def settable(self) -> dict[str, object]:
        """Everything that `with_values` can set: `plant.gain`, `ffdl-mfailc.lam`, ..."""
        return settable(self.machine) | {
            f"{name}.{path}": value
            for name, scheme in self.schemes.items()
            for path, value in settable(scheme).items()
        }

    def allowed(self, path: str) -> str:
        """What `with_values` accepts at a path, as text."""
        head, rest = owner_of(path, self.schemes)
        return allowed_at(self.machine if head == "machine" else self.schemes[head], rest)

    def with_values(self, settings: Mapping[str, object]) -> Scenario:
        """This scenario with leaves or static fields replaced, all at once.

        settings: values by path, such as {"ffdl-mfailc.lam": 0.5, "plant.gain": 2.0}; they may be
            text, and paths within the machine may begin with `machine.`
        Raises ValueError naming what can be set, or the allowed range.
        """
        objects: dict[str, Tree] = {"machine": self.machine, **self.schemes}
        changes: dict[str, dict[str, object]] = {}
        for path, value in settings.items():
            head, rest = owner_of(path, self.schemes)
            try:
                get_at(objects[head], rest)
                changes.setdefault(head, {})[rest] = read_at(objects[head], rest, value, path)
            except KeyError:
                wanted = rest if head == "machine" else path
                known = [name for name in (*self.options, *self.settable()) if name != wanted]
                raise ValueError(f"{path!r} cannot be set; {known_names(wanted, known)}") from None
        objects |= {name: replaced(objects[name], values) for name, values in changes.items()}
        machine = objects.pop("machine")
        return dataclasses.replace(self, machine=machine, schemes=objects)


def _need_name(what: str, name: str, allowed: re.Pattern, said: str) -> None:
    if not allowed.fullmatch(name) or name.strip() != name:
        raise ValueError(
            f"{what} = {brief(name)} is no name; allowed are up to 50 of {said}, a letter or "
            "digit first"
        )


def _need_shown(what: str, text: str, forbidden: str = "") -> None:
    if (
        printable(text) != text
        or any(c in text for c in ("\n", *forbidden))
        or (forbidden and "*/" in text)
    ):
        besides = f", without {' '.join(forbidden)} and */" if forbidden else ""
        raise ValueError(
            f"{what} = {brief(text)} cannot be shown; allowed are printable characters in one "
            f"line{besides}"
        )


def judged(scenario: Scenario, metric: str | None) -> Scenario:
    """The scenario judged by another metric; None for the one it has.

    Its tolerance belongs to the metric that it had, so another metric has none.
    Raises ValueError naming the metrics that exist.
    """
    if metric is None:
        return scenario
    known = (*TUNED, *scenario.quantities)
    need_known(f"metric = {metric!r}", metric, known)
    tolerance = scenario.tolerance if metric == scenario.judged_by else None
    return dataclasses.replace(scenario, judged_by=metric, tolerance=tolerance)
