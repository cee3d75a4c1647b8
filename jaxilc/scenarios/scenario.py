"""What a scenario is: a machine, its task, schemes with their parameters, uncertainty, and what was published about it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax

from ..machine import Machine
from ..metrics import Metrics
from ..pytree import allowed_at, get_at, replaced, settable
from ..schemes import Scheme
from ..signals import Task, Trial
from ..uncertainty import Uncertainty


class Fit(NamedTuple):
    """What was fitted to print before a row could be simulated.

    names: of the free numbers, none if nothing was fitted;  to: the printed numbers that they were fitted to
    among: whether the row is one of these, and so proves nothing
    """

    names: tuple[str, ...] = ()
    to: str = ""
    among: bool = False

    def __str__(self) -> str:
        if not self.names:
            return "nothing fitted"
        free = f"{len(self.names)} free number{'s' * (len(self.names) > 1)} ({', '.join(self.names)})"
        return f"{free} fitted to {self.to}; this row {'is among them' if self.among else 'is predicted'}"


NOTHING = Fit()


class Published(NamedTuple):
    """A printed number: data to compare with, never fed back.

    quantity: `settled_error`, `max_error`, `rms`, `best_trial` (the best of the first `trial` ones) or a quantity of the scenario, in
    the unit it is shown in
    trial: None for a scheme that does not learn
    options: of the scenario, under which the number was obtained;  reading: what the print leaves open there, and how it was read
    at_most: printed as "less than";  fitted: what was fitted to print for it, `NOTHING` if nothing was, None if that is not said
    """

    scheme: str
    trial: int | None
    quantity: str
    value: float
    source: str
    options: tuple[tuple[str, object], ...] = ()
    reading: str = ""
    at_most: bool = False
    fitted: Fit | None = None


class Quantity(NamedTuple):
    """A figure of a trial that this system is judged by, besides the metrics of every trial.

    of: from a trial to a number;  unit, scale: it is shown as `scale` times the number, in `unit`; None for those of the errors
    """

    of: Callable[[Trial], jax.Array]
    unit: str | None = None
    scale: float | None = None


@dataclasses.dataclass(frozen=True)
class Scenario:
    """A system of a paper, ready to run.

    trials: J;  uncertainty: distributions on the machine's leaves;  tolerance: settled error that passes [shown unit]
    published: printed results [shown unit];  chosen: what the paper leaves open, and what was chosen here, as text
    shown_unit, shown_scale: errors are shown as shown_scale times the simulated ones, in shown_unit
    show_trials: trials worth a row in a table or a curve in a figure;  options: with which the scenario was loaded
    quantities: further figures of a trial, by name;  judged_by: the figure that tables show and the tolerance is for
    """

    name: str
    title: str
    machine: Machine
    task: Task
    schemes: Mapping[str, Scheme]
    trials: int
    uncertainty: Uncertainty
    published: tuple[Published, ...] = ()
    chosen: tuple[str, ...] = ()
    tolerance: float = 1.0
    shown_unit: str = ""
    shown_scale: float = 1.0
    show_trials: tuple[int, ...] = ()
    options: Mapping[str, object] = dataclasses.field(default_factory=dict)
    quantities: Mapping[str, Quantity] = dataclasses.field(default_factory=dict)
    judged_by: str = "settled_error"

    @property
    def functions(self) -> dict[str, Callable[[Trial], jax.Array]]:
        """The quantities as functions of a trial."""
        return {name: quantity.of for name, quantity in self.quantities.items()}

    def shown(self, figure: str) -> tuple[float, str]:
        """Scale and unit in which a figure is shown. Raises ValueError naming the figures there are."""
        if figure in self.quantities:
            _, unit, scale = self.quantities[figure]
            return self.shown_scale if scale is None else scale, self.shown_unit if unit is None else unit
        if figure == "best_trial":
            return 1.0, ""
        if figure not in Metrics._fields:
            raise ValueError(f"figure = {figure!r} is not one of {', '.join((*Metrics._fields, *self.quantities))}")
        return (1.0, self.task.input_unit) if figure == "effort" else (self.shown_scale, self.shown_unit)

    @property
    def due(self) -> tuple[Published, ...]:
        """The published rows that belong to this task: those of the same options, whichever form of the plant they were printed for."""
        return tuple(p for p in self.published if all(k == "plant" or self.options.get(k) == v for k, v in p.options))

    def select(self, names: tuple[str, ...]) -> Scenario:
        """Only the schemes named; all if none is. Raises ValueError naming the allowed ones."""
        for name in names:
            if name not in self.schemes:
                raise ValueError(f"scheme = {name!r} is not one of {', '.join(self.schemes)}")
        return dataclasses.replace(self, schemes={n: self.schemes[n] for n in names}) if names else self

    def settable(self) -> dict[str, object]:
        """Everything `with_values` can set: `machine.…`, and each scheme's under its name, `ffdl-mfailc.lam`."""
        found = {f"machine.{path}": value for path, value in settable(self.machine).items()}
        return found | {f"{name}.{path}": value for name, scheme in self.schemes.items() for path, value in settable(scheme).items()}

    def allowed(self, path: str) -> str:
        """What `with_values` accepts at a path, as text."""
        head, _, rest = path.partition(".")
        return allowed_at(self.machine if head == "machine" else self.schemes[head], rest)

    def with_values(self, settings: Mapping[str, object]) -> Scenario:
        """This scenario with leaves or static fields replaced, all at once: {"ffdl-mfailc.lam": 0.5}.

        Values may be text. Raises ValueError naming what can be set, or the allowed range.
        """
        objects = {"machine": self.machine, **self.schemes}
        changes: dict[str, dict[str, object]] = {}
        for path, value in settings.items():
            head, _, rest = path.partition(".")
            try:
                old = get_at(objects[head], rest)
                if dataclasses.is_dataclass(old):  # a part, such as `machine.plant`
                    raise KeyError(path)
                changes.setdefault(head, {})[rest] = _typed(old, value, path)
            except KeyError:
                raise ValueError(f"{path!r} cannot be set; known: {', '.join(self.settable())}") from None
        objects |= {name: replaced(objects[name], below) for name, below in changes.items()}
        machine = objects.pop("machine")
        return dataclasses.replace(self, machine=machine, schemes=objects)


def _typed(old, value, path: str):
    """`value`, which may be text, as what stands at the path: an int stays an int, a mode a mode, the rest are numbers."""
    if not isinstance(value, str):
        return value
    if isinstance(old, str):
        return value
    try:
        if isinstance(old, bool | int):
            return int(value)
        if value.lower() == "none":
            return None
        numbers = [float(part) for part in value.strip("()[] ").split(",")]
    except ValueError:
        kind = "a whole number" if isinstance(old, bool | int) else "a number, or numbers with commas between them"
        raise ValueError(f"{path} = {value!r} is not {kind}") from None
    return numbers if len(numbers) > 1 else numbers[0]
