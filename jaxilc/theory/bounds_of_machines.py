"""The bounds of Cao 2019 over many machines: how often each premise held, and each bound."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from ..learning.machine import Machine
from ..learning.over_trials import learn
from ..runtime.tiles import tiled
from ..schemes import Scheme
from ..signals.task import Task
from ..uncertainty import Uncertainty, drawn_machines
from .bounds import BoundsWatch

PREMISES = {
    "linear": "machine linear, without limit, rounding, noise or change",
    "alone": "y(k+1) depends on u(k) alone",
    "signs": "constant sign of phi, and of the estimate",
    "damped": "lam > b^2 / 4",
    "printed": "the law as printed: no lead, no limit",
    "share_lipschitz": "Lipschitz in the run: |Dy(k+1)| <= b |DH(k)|",
    "share_sign": "sign of phi in the run: that of the plant",
    "share_excited": "|DH| >= epsilon in the run, for d1",
}


class PremiseShare(NamedTuple):
    """A premise over S machines.

    name:         of the premise
    held:         number of machines on which it held throughout
    share_broken: mean share of samples and trials that broke it; of a premise on the plant or on
                  the law, the share of machines
    """

    name: str
    held: int
    share_broken: float


class Checked(NamedTuple):
    """The premises of the bounds over S machines, and the bounds beside what was observed.

    premises: those that the scheme has
    verdicts: on how many machines |e_j| <= d2 |e_(j-1)| is claimed and holds at every sample of
              every trial, is claimed and fails, and is not claimed
    care:     median over the machines with a claim of d2 / the largest ratio observed, which is 1
              where the bound is met exactly; None without a claim
    """

    premises: list[PremiseShare]
    verdicts: dict[str, int]
    care: float | None


def checked(found: Mapping[Any, Any]) -> Checked:
    """The premises and the bounds of machines, from what a `BoundsWatch` found of them.

    found: (S,) and (S, J) by the names of the watch
    """
    shares = []
    for key, name in PREMISES.items():
        values = np.asarray(found[key], float)
        values = values[:, 1:] if values.ndim == 2 else values[:, None]
        if not np.all(np.isnan(values)):
            held, broken = int(np.sum(np.all(values == 1.0, axis=1))), 1.0 - np.nanmean(values)
            shares.append(PremiseShare(name, held, float(broken)))
    claimed = np.asarray(found["claimed"]) == 1.0
    holds = claimed & np.all(np.asarray(found["share_kept"])[:, 1:] == 1.0, axis=1)
    verdicts = {"holds": holds, "fails": claimed & ~holds, "not claimed": ~claimed}
    counts = {verdict: int(np.sum(of)) for verdict, of in verdicts.items()}
    if not np.any(claimed):
        return Checked(shares, counts, None)
    worst = np.nanmax(np.asarray(found["contraction_worst"])[claimed, 1:], axis=1)
    return Checked(shares, counts, float(np.median(np.asarray(found["d2"])[claimed] / worst)))


def checked_machines(
    machine: Machine,
    scheme: Scheme,
    task: Task,
    trials: int,
    uncertainty: Uncertainty,
    drawn: Mapping[str, Any],
) -> Checked:
    """The premises and the bounds on each machine's run without noise.

    trials: J >= 2, as two trials are compared
    drawn: machines of `uncertainty.draw`
    """
    run = tiled(partial(_watched, trials=trials))
    return checked(run((scheme, task), drawn_machines(machine, uncertainty, drawn)))


def _watched(common, machine, *, trials):
    return learn(machine.noiseless(), *common, trials, watch=BoundsWatch()).watched
