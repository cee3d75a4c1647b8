"""`learn` keeps the programs of its last few `save` functions, not one of every new lambda."""

import gc
import os
import weakref
from pathlib import Path

import numpy as np
import pytest

from jaxilc.learning import learn, over_trials
from jaxilc.schemes import PIDType
from jaxilc.signals import Task

CALLS = 6
LITTLE = 1.5e6  # bytes per call; a program takes twice as much, for longer trials even more


def resident():
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


@pytest.mark.thorough
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="only Linux has /proc")
def test_a_new_lambda_a_call_does_not_fill_the_memory(machine, monkeypatch):
    task, saved = Task(np.sin(np.arange(9.0)), dt=1e-3), []

    def call():
        save = lambda trial: trial.y  # noqa: E731  new in each call, as in a loop of a notebook
        saved.append(weakref.ref(save))
        learn(machine, PIDType(gamma_p=-0.5), task, 2, save=save)

    for _ in range(over_trials.PROGRAMS + 1):
        call()
    gc.collect()
    before = resident()
    for _ in range(CALLS):
        call()
    gc.collect()
    assert resident() - before < CALLS * LITTLE
    assert sum(save() is not None for save in saved) <= over_trials.PROGRAMS


def test_equal_ones_and_none_share_a_program(machine, task):
    from jaxilc.learning import Keep

    assert over_trials._program(Keep(("y",)), 1) is over_trials._program(Keep(("y",)), 1)
    with pytest.raises(ValueError, match=r"learn: save = \[1\] is not a function of a trial"):
        learn(machine, PIDType(), task, 2, save=[1])
