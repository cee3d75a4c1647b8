"""The metrics that every trial has, declared in one place.

`METRICS` declares each with its name, its axes, its unit, its meaning, and how it is computed from
the signals of a trial. To add one that is computed from the signals, add

    1. a line to `METRICS`, and
    2. a field of the same name to `Metrics`, which a type checker reads.

All other places use these two: `Tally` with its derivative, `measure`, the attributes of `History`,
the variables of the datasets of a sweep and of `run_schemes`, the numbers and tables of commands,
the names that `--metric` and an objective may have, the journal of a campaign, and the names that
an additional quantity of the user must not have. This module does not import JAX, so that `--help`
is fast.
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Literal, NamedTuple

if TYPE_CHECKING:
    from ..pytree.aliases import Array
    from ..signals.task import Task


class Gathering(NamedTuple):
    """How a metric is computed from one signal of a trial, for each channel.

    signal: the error e, or the input u
    of: the largest absolute value, or the root mean square
    settled: whether only samples in the settled window count
    """

    signal: Literal["e", "u"]
    of: Literal["largest", "root mean square"]
    settled: bool = False


@dataclasses.dataclass(frozen=True)
class Metric:
    """The declaration of a metric for tables, datasets and objectives.

    axes: the axes of its values for one learning process: trial, and channel (of y) or input (of u)
    unit: the unit of the `output`, that of the `input`, or no unit
    text: its description in a dataset
    dtype: type of its values: `float`, `bool`, or a type of whole numbers
    tuned: whether an objective may minimise it
    swept: whether the dataset of a sweep contains it; that of `run_schemes` contains all metrics
    gathered: how it is computed from the signals; None if it follows from other metrics
    head: its head in a table of several metrics; its name if empty
    """

    name: str
    axes: tuple[str, ...]
    unit: Literal["output", "input", ""]
    text: str
    dtype: str = "float"
    tuned: bool = False
    swept: bool = True
    gathered: Gathering | None = None
    head: str = ""

    def unit_of(self, task: Task) -> str:
        """The unit of the values of this metric for a task."""
        return {"output": task.unit, "input": task.input_unit, "": ""}[self.unit]


_PER_OUTPUT, _PER_INPUT = ("trial", "channel"), ("trial", "input")
METRICS = (
    Metric("max_error", _PER_OUTPUT, "output", "largest error of a trial",
           tuned=True, gathered=Gathering("e", "largest"), head="largest"),
    Metric("rms", _PER_OUTPUT, "output", "root mean square error of a trial",
           tuned=True, gathered=Gathering("e", "root mean square")),
    Metric("settled_error", _PER_OUTPUT, "output", "largest error in the settled window of a trial",
           tuned=True, gathered=Gathering("e", "largest", settled=True),
           head="largest, settled"),
    Metric("effort", _PER_INPUT, "input", "root mean square input of a trial",
           gathered=Gathering("u", "root mean square")),
    Metric("best_trial", ("trial",), "", "trial with the smallest error so far", "i8",
           swept=False),
    Metric("finite", ("trial",), "", "whether the trial stayed finite", "bool"),
    Metric("diverged", ("trial",), "",
           "whether the trial diverged: not finite, or an error far beyond the reference", "bool"),
    Metric("diverged_at", (), "", "first trial that diverged, 0 if none", "i4"),
    Metric("grown_from", (), "",
           "trial from which on the rms error stays far above its least, or 0", "i4"),
)  # fmt: skip
OF_TRIALS = tuple(m for m in METRICS if m.axes[:1] == ("trial",) and m.dtype != "bool")
ERRORS = tuple(m for m in METRICS if m.axes == _PER_OUTPUT and m.unit == "output")
GATHERED = tuple((m.name, m.gathered) for m in METRICS if m.gathered is not None)
TUNED = tuple(m.name for m in METRICS if m.tuned)  # the names that an objective may have


class Metrics(NamedTuple):
    """The metrics of one trial, over the samples that the input can reach (k = 1..N).

    max_error: (n_y,) max |e| [unit of y]
    rms: (n_y,) root mean square of e [unit of y]
    settled_error: (n_y,) max |e| in the settled window [unit of y], NaN where nothing of it was
        measured
    effort: (n_u,) root mean square of u [unit of u]
    finite: () whether all of these, and every y and u, are finite. In single precision the
        square of a number from 1.8e19 on is not, so that its trial is not finite either
    """

    max_error: Array
    rms: Array
    settled_error: Array
    effort: Array
    finite: Array

    def __repr__(self) -> str:
        from ..pytree.in_short import in_short  # imports JAX

        return in_short(self)


def bytes_of_metrics(task: Task) -> int:
    """The bytes that the metrics of one trial of one machine take."""
    channels = {"channel": task.outputs, "input": task.inputs, "trial": 1}
    return 8 * sum(channels[m.axes[-1]] for m in METRICS if m.name in Metrics._fields)
