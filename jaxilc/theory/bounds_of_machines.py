"""The premises of the bounds of Cao 2019, counted over many machines."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np

from ..learning.machine import Machine
from ..learning.over_trials import learn
from ..runtime.tiles import tiled
from ..schemes import CFDLMFAILC, FFDLMFAILC
from ..signals.task import Task, Trial
from ..uncertainty import Uncertainty, drawn_machines
from .bounds import CHUNK, cfdl_bounds, ffdl_bounds, need_room


class PremiseShare(NamedTuple):
    """A premise over S machines.

    name:         of the premise
    held:         number of machines on which it held throughout
    share_broken: mean share of samples and trials that broke it
    """

    name: str
    held: int
    share_broken: float


def premises(
    machine: Machine,
    scheme: FFDLMFAILC,
    task: Task,
    trials: int,
    uncertainty: Uncertainty,
    drawn: Mapping[str, Any],
    *,
    chunk: int = CHUNK,
) -> tuple[list[PremiseShare], dict[str, int]]:
    """The premises of Cao 2019's bounds on each machine's run, and the verdicts on the bound.

    The verdicts are counted: how often the bound holds, fails or is not claimed. Machines whose run
    is not finite are left out of both. Raises ValueError for trials whose signals exceed the RAM.
    """
    need_room(task, trials, chunk)
    bounds: Any = cfdl_bounds if isinstance(scheme, CFDLMFAILC) else ffdl_bounds
    run, machines = (
        tiled(partial(_signals, trials=trials)),
        drawn_machines(machine, uncertainty, drawn),
    )
    total, conditions = len(jax.tree.leaves(machines)[0]), []
    for start in range(0, total, chunk):
        batch = jax.tree.map(lambda leaf, start=start: leaf[start : start + chunk], machines)
        for y, u in zip(*(np.asarray(s) for s in run((scheme, task), batch)), strict=True):
            if np.all(np.isfinite(y)) and np.all(np.isfinite(u)):
                conditions.append(bounds(scheme, task, y, u).condition)
    names = [p.name for p in conditions[0].premises] if conditions else []
    shares = [
        PremiseShare(
            name,
            sum(bool(c.premises[i].held) for c in conditions),
            float(np.mean([c.premises[i].share_broken for c in conditions])),
        )
        for i, name in enumerate(names)
    ]
    return shares, {
        v: sum(c.verdict == v for c in conditions) for v in ("holds", "fails", "not claimed")
    }


def _signals(common, machine, *, trials):
    return learn(machine.noiseless(), *common, trials, save=_y_and_u).saved


def _y_and_u(trial: Trial):
    return trial.y, trial.u
