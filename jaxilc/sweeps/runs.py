"""One machine under several schemes: every trial kept, as a dataset."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

import jax
import numpy as np

from ..learning.machine import Machine
from ..learning.metrics import Keep, best_trial
from ..learning.over_trials import History, check, learn
from ..runtime.capacity import check_size
from ..schemes import Scheme
from ..signals.task import Task, Trial

if TYPE_CHECKING:
    import xarray as xr


COPIES = (
    4  # of y and u: as learned, stacked over the schemes, the error, and on their way to the disk
)


def run_schemes(
    machine: Machine,
    schemes: Mapping[str, Scheme],
    task: Task,
    trials: int,
    *,
    key: jax.Array | None = None,
    quantities: Mapping[str, Callable[[Trial], jax.Array]] | None = None,
) -> tuple[xr.Dataset, dict[str, History]]:
    """Learn with each scheme and keep every trial's signals.

    quantities: further figures, each a function of a trial to a number
    Returns the dataset (dims scheme, trial and time, channel, input_time, input; r, y, e, u, the
    metrics and the quantities) and the histories, whose `memory` lets each scheme go on. Raises as
    `learn` does, and ValueError, before anything runs, for more trials than fit into memory.
    """
    for scheme in schemes.values():
        check(machine, scheme, task)
    keep, signals = Keep.of(quantities or {}, "y", "u"), (task.N + 1) * (task.outputs + task.inputs)
    each = 8 * COPIES * signals * len(schemes)
    check_size("run", lambda trials: each * trials, trials=trials)
    histories = {
        name: learn(machine, scheme, task, trials, key=key, save=keep)
        for name, scheme in schemes.items()
    }
    return history_dataset(histories, task), histories


def history_dataset(histories: Mapping[str, History], task: Task) -> xr.Dataset:
    """The dataset of histories whose `saved` has y, u, and each quantity of each trial."""
    import xarray as xr

    def stacked(pick):
        return np.stack([np.asarray(pick(h)) for h in histories.values()])

    def of_y(dims, values):
        return dims, values, {"units": task.unit}

    def of_u(dims, values):
        return dims, values, {"units": task.input_unit}

    r, y, u = (
        np.asarray(task.reference),
        stacked(lambda h: h.saved["y"]),
        stacked(lambda h: h.saved["u"]),
    )
    further = [name for name in next(iter(histories.values())).saved if name not in ("y", "u")]
    per_output, per_input = ("scheme", "trial", "channel"), ("scheme", "trial", "input")
    return xr.Dataset(
        {
            "r": of_y(("time", "channel"), r),
            "y": of_y(("scheme", "trial", "time", "channel"), y),
            "e": of_y(("scheme", "trial", "time", "channel"), r - y),
            "u": of_u(("scheme", "trial", "input_time", "input"), u),
            "max_error": of_y(per_output, stacked(lambda h: h.max_error)),
            "rms": of_y(per_output, stacked(lambda h: h.rms)),
            "settled_error": of_y(per_output, stacked(lambda h: h.settled_error)),
            "effort": of_u(per_input, stacked(lambda h: h.effort)),
            "best_trial": (("scheme", "trial"), stacked(lambda h: best_trial(h.rms))),
            "finite": (("scheme", "trial"), stacked(lambda h: h.finite)),
            "diverged": (("scheme", "trial"), stacked(lambda h: h.diverged)),
            "diverged_at": (("scheme",), stacked(lambda h: h.diverged_at)),
            "grown_from": (("scheme",), stacked(lambda h: h.grown_from)),
            **{
                name: (("scheme", "trial"), stacked(lambda h, name=name: h.saved[name]))
                for name in further
            },
        },
        coords={
            "scheme": np.array(list(histories), dtype=np.dtypes.StringDType()),
            "trial": np.arange(1, y.shape[1] + 1),
            "time": task.time,
            "input_time": task.time[:-1],
            "channel": np.arange(task.outputs),
            "input": np.arange(task.inputs),
        },
    )
