"""What is killed between two operations on its folder goes on to the same numbers."""

import dataclasses
from pathlib import Path

import jax
import numpy as np
import pytest
import xarray as xr
from cases import case
from crash_points import recorded
from gain_case import PROBLEM, assert_same_tuned
from store_case import filled
from sweep_case import PLAN

from jaxilc.hardware import Campaign, Measured, Rules
from jaxilc.hardware.checks import ACCEPTED
from jaxilc.storage.files import UNFINISHED
from jaxilc.sweeps import Sweep, open_dataset
from jaxilc.tuning import trade_off


def nothing_left_over(folder):
    return not list(folder.rglob(f"*{UNFINISHED}*"))


def test_a_state_is_of_one_moment(tmp_path, monkeypatch):
    """Another thread renames a file before it is recorded, and another one after that."""
    out, read = tmp_path / "out", Path.read_bytes
    partial = ["1.partial", "3.partial"]

    def renamed_meanwhile(path):
        if path.name == "2" and partial:
            old = out / partial.pop()
            old.rename(old.with_suffix(""))
        return read(path)

    with recorded(out, tmp_path) as states:
        for name in (*partial, "2"):
            (out / name).write_text(name)
        monkeypatch.setattr(Path, "read_bytes", renamed_meanwhile)
        (out / "next").mkdir()
    found = [{path.name: path.read_text() for path in state.glob("[123]*")} for state in states]
    assert {"1": "1.partial", "2": "2", "3": "3.partial"} in found
    assert all({"1", "2", "3"} == state.keys() for state in found if {"1", "3"} & state.keys())


@pytest.mark.thorough
def test_a_store_is_filled_from_every_state_of_its_folder(tmp_path, quickly_and_quietly):
    with recorded(tmp_path / "out", tmp_path) as states:
        whole, written = filled(tmp_path / "out" / "store.zarr")
    assert written == [0, 1]
    assert len(states) > 60
    left = []
    for state in states:
        dataset, written = filled(state / "store.zarr")
        xr.testing.assert_identical(dataset, whole)
        xr.testing.assert_identical(open_dataset(state / "store.zarr"), whole)
        assert nothing_left_over(state)
        left.append(len(written))
    assert left == sorted(left, reverse=True), "what is marked is not computed again"
    assert left[-1] == 0


@pytest.mark.thorough
def test_a_sweep_resumes_from_states_of_its_folder(tmp_path, quickly_and_quietly, monkeypatch):
    small = dataclasses.replace(
        PLAN, schemes={"feedback": PLAN.schemes["feedback"]}, machines=5, chunk=3, keep=(), trials=2
    )
    host = small.host()
    monkeypatch.setattr(Sweep, "host", lambda self: host)  # compiled once
    with recorded(tmp_path / "out", tmp_path) as states:
        whole = small.run(tmp_path / "out" / "store.zarr")
    for state in states[5::20]:
        xr.testing.assert_identical(small.run(state / "store.zarr", resume=True), whole)
        assert nothing_left_over(state)


@pytest.mark.thorough
def test_a_tuning_resumes_from_every_state_of_its_folder(tmp_path):
    problem = dataclasses.replace(PROBLEM, steps=3)
    with recorded(tmp_path / "out", tmp_path) as states:
        whole = problem.run(tmp_path / "out" / "state")
    assert len(states) > 20
    for state in states:
        assert_same_tuned(problem.run(state / "state", resume=True), whole)
        assert nothing_left_over(state)


@pytest.mark.thorough
def test_a_trade_off_resumes_from_every_state_of_its_folder(tmp_path, tuned_by_one_program):
    problem = dataclasses.replace(PROBLEM, steps=1)
    with recorded(tmp_path / "out", tmp_path) as states:
        whole = trade_off.by_trials(problem, (2, 3), tmp_path / "out" / "state")
    assert len(states) > 20
    for state in states:
        resumed = trade_off.by_trials(problem, (2, 3), state / "state", resume=True)
        for J in (2, 3):
            assert_same_tuned(resumed[J], whole[J])


@pytest.mark.thorough
def test_a_campaign_goes_on_from_every_state_of_its_folder(tmp_path, quickly_and_quietly):
    _, scheme, task = case("p_type")
    y, u = 0.1 * np.asarray(task.reference), np.full((task.N, 1), 0.1)
    measured = [Measured(j * y, j * u, {}, (), f"trial {j}") for j in (1, 2)]

    def go_on(folder):
        """Return what a campaign learned from two trials, from some of them maybe before."""
        begun = folder.is_dir() and any(not f.name.startswith(UNFINISHED) for f in folder.iterdir())
        make = Campaign.open if begun else Campaign.start
        campaign = make(folder, scheme, task, rules=Rules(accept=ACCEPTED))
        for trial in measured[campaign.trials :]:
            campaign.keep(campaign.turn(trial))
        return campaign.memory()

    with recorded(tmp_path / "out", tmp_path) as states:
        whole = go_on(tmp_path / "out" / "state")
    assert len(states) > 40
    for state in states:
        jax.tree.map(np.testing.assert_array_equal, go_on(state / "state"), whole)
        Campaign.open(state / "state", scheme, task).undo(1)  # a stopped head goes with an entry
        assert nothing_left_over(state)
