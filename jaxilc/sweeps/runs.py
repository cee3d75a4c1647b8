"""One machine under several schemes: every trial kept, as a dataset."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import jax
import numpy as np

from ..learning.divergence import Course
from ..learning.known_metrics import METRICS
from ..learning.machine import Machine
from ..learning.metrics import Keep, best_trial
from ..learning.over_trials import History, check, learn
from ..pytree.aliases import Value
from ..pytree.ranges import brief
from ..runtime.capacity import check_size
from ..runtime.provenance import describe, environment
from ..schemes import Scheme
from ..signals.task import Task, Trial
from ..storage.sealed import as_json

if TYPE_CHECKING:
    import xarray as xr


# Copies of y and u in the RAM: as learned, stacked over the schemes, the error, and as written.
COPIES = 4


def run_schemes(
    machine: Machine,
    schemes: Mapping[str, Scheme],
    task: Task,
    trials: int,
    *,
    key: jax.Array | None = None,
    quantities: Mapping[str, Callable[[Trial], jax.Array]] | None = None,
    progress: Callable[[int, str], object] | None = None,
) -> tuple[xr.Dataset, dict[str, History]]:
    """Learn with each scheme and keep the signals of every trial.

    quantities: further metrics by name, each a function from a trial to a number
    progress: called before each scheme with the number of schemes done and its name
    Returns the dataset and the histories by the name of the scheme. With the `memory` of a history
    learning can be continued. The dataset has the dimensions scheme, trial, time, channel,
    input_time and input; its variables are r, y, e, u, the metrics and the quantities. Where the
    reference changes, r has the dimension trial, too.
    Raises as `learn` does, and ValueError, before anything runs, for more trials than the RAM can
    hold.
    """
    need_schemes("run_schemes", schemes)
    for scheme in schemes.values():
        check(machine, scheme, task)
    changes = machine.variation is not None and machine.variation.references is not None
    keep = Keep.of(quantities or {}, "y", "u", *(["r"] if changes else []))
    signals = (task.N + 1) * (task.outputs * (1 + changes) + task.inputs)
    check_size("run", 8 * COPIES * signals * len(schemes), trials=trials)
    histories = {}
    for done, (name, scheme) in enumerate(schemes.items()):
        if progress is not None:
            progress(done, name)
        histories[name] = jax.block_until_ready(
            learn(machine, scheme, task, trials, key=key, save=keep)
        )
    return history_dataset(histories, task), histories


def need_schemes(who: str, schemes: Value) -> None:
    """Raises ValueError unless there are schemes by name."""
    if not isinstance(schemes, Mapping):
        raise ValueError(
            f"{who}: schemes = {brief(schemes)} is a {type(schemes).__name__}; "
            "allowed are schemes by name, such as {'name': scheme}"
        )
    if not schemes:
        raise ValueError(f"{who}: schemes is empty; at least one is needed")


def configuration(scenario: object, seed: int) -> dict[str, Value]:
    """All that determines the numbers and the figures of a run of a scenario, as JSON."""
    parts = ("machine", "schemes", "task", "trials", "judged_by")
    found = {name: describe(getattr(scenario, name)) for name in parts}
    return as_json(found | {"seed": seed, "precision": environment()["precision"]})


def made_with(store: Path) -> dict[str, Value]:
    """The configuration that a dataset of a run was stored with; empty where it has none."""
    try:
        attributes = json.loads((store / "zarr.json").read_bytes())["attributes"]
        return dict(json.loads(attributes["configuration"]))
    except (OSError, ValueError, TypeError, KeyError):
        return {}


def history_dataset(histories: Mapping[str, History], task: Task) -> xr.Dataset:
    """The dataset of histories by name, with y, u and each quantity of every trial in `saved`.

    The reference is that of each trial if it is in `saved`, too; if not, that of the task.
    """
    import xarray as xr

    def stacked(saved: str) -> np.ndarray:
        return np.stack([np.asarray(h.saved[saved]) for h in histories.values()])

    def known(history: History) -> dict[str, jax.Array | np.ndarray]:
        judged = {name: getattr(history, name) for name in Course._fields}
        return history.metrics._asdict() | {"best_trial": best_trial(history.rms)} | judged

    of_each = [known(h) for h in histories.values()]
    metrics = {
        m.name: (
            ("scheme", *m.axes),
            np.stack([np.asarray(of[m.name]) for of in of_each]),
            {"units": m.unit_of(task)} if m.unit else {},
        )
        for m in METRICS
    }
    of_y, of_u = {"units": task.unit}, {"units": task.input_unit}
    saved, y = next(iter(histories.values())).saved, stacked("y")
    r, of_r = np.asarray(saved.get("r", task.reference)), ("trial", "time", "channel")
    further = [name for name in saved if name not in ("r", "y", "u")]
    along = ("scheme", "trial", "time", "channel")
    return xr.Dataset(
        {
            "r": (of_r[-r.ndim :], r, of_y),
            "y": (along, y, of_y),
            "e": (along, r - y, of_y),
            "u": (("scheme", "trial", "input_time", "input"), stacked("u"), of_u),
            **metrics,
            **{name: (("scheme", "trial"), stacked(name)) for name in further},
        },
        coords={
            "scheme": _as_text(np.array(list(histories))),
            "trial": np.arange(1, y.shape[1] + 1),
            "time": task.time,
            "input_time": task.time[:-1],
            "channel": _as_text(np.array(task.labels)),
            "input": np.arange(task.inputs),
        },
    )


def _as_text(labels: np.ndarray) -> np.ndarray:
    """Labels as a Zarr store keeps them: text of any length, or numbers."""
    return labels.astype(np.dtypes.StringDType()) if labels.dtype.kind == "U" else labels
