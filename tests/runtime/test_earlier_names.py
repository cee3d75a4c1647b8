"""Configurations of earlier versions are those of today, where nothing else has changed."""

import numpy as np

from jaxilc.learning import Machine
from jaxilc.plants import ProcessModel
from jaxilc.runtime.provenance import describe, differences
from jaxilc.signals import Task


def without(described, *names):
    return {name: value for name, value in described.items() if name not in names}


def test_fields_that_were_added_since_are_no_difference_until_they_are_used():
    task, plant = Task(np.zeros(9), dt=1e-3), ProcessModel(2.0, poles=[60.0])
    machine = Machine(plant)
    of_machine = without(describe(machine), "variation")
    found = {"task": without(describe(task), "names"), "plant": without(describe(plant), "delay")}
    today = {"task": describe(task), "plant": describe(plant)}
    assert differences(found, today) == []
    assert differences({"machine": of_machine}, {"machine": describe(machine)}) == []
    delayed = ProcessModel(2.0, poles=[60.0], delay=0.004)
    assert differences(found, {"task": describe(task), "plant": describe(delayed)}) == [
        "plant.delay: 0.0 there, 0.004 here"
    ]
