"""The variables and coordinates of a sweep's dataset.

The dimension over the machines is called `sample`, as in existing datasets.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import jax
import numpy as np

from ..learning.known_metrics import METRICS
from ..learning.watch import Watch
from ..signals.task import Task
from .layout import Variable
from .plan import Plan

SIGNALS = {"y": ("time", "channel"), "e": ("time", "channel"), "u": ("input_time", "input")}


def variables(
    task: Task, keep: tuple[str, ...], quantities: Iterable[str], watch: Watch | None = None
) -> dict[str, Variable]:
    """The variables by name: metrics, further quantities, the signals that are kept, and a watch's.

    A task with one output has no dimension `channel`, one with one input no dimension `input`.
    Raises ValueError for a quantity with the name of a variable of the watch.
    """
    dropped = {"channel"} if task.outputs == 1 else set()
    dropped |= {"input"} if task.inputs == 1 else set()
    real = "f8" if jax.config.jax_enable_x64 else "f4"

    def along(*axes: str) -> tuple[str, ...]:
        return ("scheme", "sample", *(axis for axis in axes if axis not in dropped))

    found = {
        m.name: Variable(
            along(*m.axes), real if m.dtype == "float" else m.dtype, m.unit_of(task), m.text
        )
        for m in METRICS
        if m.swept
    }
    found |= {name: Variable(along("trial"), real, "", "figure of a trial") for name in quantities}
    for name in keep:
        unit = task.input_unit if name == "u" else task.unit
        found[name] = Variable(along(*SIGNALS[name]), real, unit, f"{name} of the last trial")
    for name, one in ({} if watch is None else watch.variables(task)).items():
        if name in found:
            raise ValueError(f"quantity = {name!r} is a variable of the watch; choose another name")
        found[name] = Variable(along(*["trial"][: one.of_trials]), real, one.unit, one.text)
    return found


def sizes(task: Task, schemes: int, machines: float, trials: float) -> dict[str, Any]:
    """The length of every dimension that a variable may have."""
    return {
        "scheme": schemes,
        "sample": machines,
        "trial": trials,
        "channel": task.outputs,
        "input": task.inputs,
        "time": task.N + 1,
        "input_time": task.N,
    }


def labels_of(task: Task) -> np.ndarray:
    """(n_y,) the names of the outputs, or their numbers where they have none."""
    return np.array(task.labels)


def coordinates(plan: Plan) -> dict[str, tuple]:
    """Dimensions and values of each coordinate, with the drawn numbers and the axes of a grid."""
    task = plan.task
    known = {
        "scheme": np.array(list(plan.variants)),
        "sample": np.arange(plan.members),
        "trial": np.arange(1, plan.longest + 1),
        "channel": labels_of(task),
        "input": np.arange(task.inputs),
        "time": task.time,
        "input_time": task.time[:-1],
    }
    known_variables = variables(task, plan.keep, plan.quantities, plan.watch)
    used = {d for v in known_variables.values() for d in v.dims}
    found = {name: ((name,), values) for name, values in known.items() if name in used}
    found |= {
        name: (("sample",), np.tile(values, plan.axes.points))
        for name, values in plan.drawn.items()
    }
    points = np.arange(plan.members) // plan.machines
    for axis, at in plan.axes.places(points):
        found |= {name: (("sample",), labels[at]) for name, labels in axis.labels.items()}
    at_all = np.array([variant.fixed for variant in plan.variants.values()])
    for axis, at in zip(plan.axes.static, at_all.T, strict=True):
        found |= {name: (("scheme",), labels[at]) for name, labels in axis.labels.items()}
    return found
