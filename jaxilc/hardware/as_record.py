"""The measured trials of a campaign as one record, to which a plant is fitted."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ..identification import Record, Repeats
from ..learning.machine import Machine
from .campaign import TRIAL, Campaign

MOST_SAMPLES = 200_000  # of all trials together; more would take long and tell little more


class CampaignRecord(NamedTuple):
    """The record of a campaign.

    record: the trials below each other, each from rest
    trials: the numbers of the trials that it holds
    measured: number of trials that the campaign has; more than `trials` where they are many
    closed: whether the machine's controller closed a loop in these trials, so that the noise of the
        output was in the input
    """

    record: Record
    trials: tuple[int, ...]
    measured: int
    closed: bool


def repeats_of(campaign: Campaign) -> Repeats:
    """The errors of the trials of a campaign that played the same schedule most often.

    Trials that ended early are left out; of several outputs the first one is taken.
    Raises ValueError where no schedule was played twice.
    """
    journal, task = campaign.journal, campaign.task
    played: dict[str, list[dict[str, Any]]] = {}
    for one in journal.live()[1:]:
        played.setdefault(str(one["hashes"].get("played")), []).append(one)
    same = max(played.values(), key=len, default=[])
    read = {one["trial"]: journal.arrays(one, TRIAL) for one in same}
    whole = {trial: of["y"] for trial, of in read.items() if "weight" not in of}
    if len(whole) < 2:
        raise ValueError(
            f"no schedule of {journal.path} was played twice; measure trials without learning in "
            "between: jaxilc next --no-learn"
        )
    e = np.stack([(np.asarray(task.reference) - y)[:, 0] for y in whole.values()])
    names = tuple(f"trial {trial}" for trial in whole)
    return Repeats(e, task.dt, task.unit, names, next(iter(whole.values()))[:, 0])


def record_of(campaign: Campaign, machine: Machine) -> CampaignRecord:
    """The input and the output of all trials of a campaign that were not undone.

    Of many trials some are taken, spread evenly from the first one to the last one. Trials that
    ended early are left out.

    machine: machine of the campaign's plant file
    Raises ValueError where there are no trials, and where the recorded u is not what acted on the
    plant: an input that was not measured but computed, in a closed loop, and a machine with a
    repetitive disturbance.
    """
    journal, live = campaign.journal, campaign.journal.live()[1:]
    if not live:
        raise ValueError(f"{journal.path} has no measured trial yet; there is nothing to fit")
    disturbance = machine.disturbance
    if disturbance is not None and not (disturbance.input is None and disturbance.output is None):
        raise ValueError(
            f"the machine of {journal.path} has a repetitive disturbance, so that u is not all "
            "that acts on its plant; record an experiment without it, and fit that"
        )
    closed = set(campaign.first_schedules()) != {"u"}
    computed = [m["trial"] for m in live if m.get("input") == "replayed"]
    if closed and computed:
        raise ValueError(
            f"the input of trial {computed[0]} was not measured but computed by the scheme's law "
            "(--set campaign.replayed_input=true). In a closed loop it is then not known what "
            "acted on the plant: record u, or fit an experiment (jaxilc identify RECORD)"
        )
    most = max(1, MOST_SAMPLES // (campaign.task.N + 1))
    if len(live) > most:
        taken = np.unique(np.linspace(0, len(live) - 1, most).round().astype(int))
    else:
        taken = np.arange(len(live))
    read = {i: journal.arrays(live[i], TRIAL) for i in taken}
    taken = [i for i in taken if "weight" not in read[i]]  # whole trials only
    if not taken:
        raise ValueError(f"each trial of {journal.path} ended early; there is nothing to fit")
    found = [read[i] for i in taken]
    record = Record(
        np.concatenate([trial["u"] for trial in found]),
        np.concatenate([trial["y"] for trial in found]),
        campaign.task.dt,
        len(found),
    )
    return CampaignRecord(record, tuple(live[i]["trial"] for i in taken), len(live), closed)
