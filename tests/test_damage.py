"""Damaged files: whatever bit is flipped, whatever is cut off or gone, no number is another one without a word.

JAXILC_FUZZ=10000 pytest tests/test_damage.py flips as many bits in each kind of folder.
"""

import dataclasses
import json
import logging
import os
import random
import shutil

import jax
import numpy as np
import pytest
import xarray as xr
from cases import case
from gain_case import PROBLEM
from store_case import filled
from sweep_case import PLAN

from jaxilc import campaign as of_campaign
from jaxilc import files, open_dataset, summarise
from jaxilc.campaign import Campaign
from jaxilc.exchange import Measured
from jaxilc.journal import Journal
from jaxilc.sealed import archive, read_arrays
from jaxilc.states import Folder
from jaxilc.sweep import Sweep

TIMES = int(os.environ.get("JAXILC_FUZZ", "0"))


@pytest.fixture(autouse=True)
def quickly_and_quietly(monkeypatch, caplog):
    monkeypatch.setattr(files.os, "fsync", lambda _: None)  # a kill loses nothing that was written, only a power failure does
    caplog.set_level(logging.ERROR, "jaxilc")


def files_of(folder):
    return sorted(f.relative_to(folder) for f in folder.rglob("*") if f.is_file())


def flipped(folder, to, times, seed):
    """Copies of a folder, each with a bit flipped in one of its files, every file in turn."""
    generator, names = random.Random(seed), files_of(folder)
    for n in range(times):
        shutil.rmtree(to, ignore_errors=True)
        shutil.copytree(folder, to)
        name = names[n % len(names)]
        content = bytearray((to / name).read_bytes())
        bit = generator.randrange(8 * len(content))
        content[bit // 8] ^= 1 << bit % 8
        (to / name).write_bytes(content)
        yield name


def refusal(call):
    """What a call is refused with, in one line; None where it is not."""
    try:
        call()
    except ValueError as error:
        return str(error).replace("\n", "a second line")
    return None


# Stores ----------------------------------------------------------------------------------------------------------------------


def test_a_flipped_bit_in_a_store_is_refused_or_computed_again(tmp_path):
    whole, _ = filled(tmp_path / "store.zarr")
    for name in flipped(tmp_path / "store.zarr", tmp_path / "flipped.zarr", TIMES or 28, seed=1):
        said = refusal(lambda: xr.testing.assert_identical(open_dataset(tmp_path / "flipped.zarr"), whole))
        assert said is None or "flipped.zarr is damaged" in said
        dataset, _ = filled(tmp_path / "flipped.zarr")
        xr.testing.assert_identical(dataset, whole)
        assert files_of(tmp_path / "flipped.zarr") == files_of(tmp_path / "store.zarr"), name
        xr.testing.assert_identical(open_dataset(tmp_path / "flipped.zarr"), whole)


@pytest.fixture(scope="module")
def swept(tmp_path_factory):
    """A small sweep, its finished store and its dataset; its chunks are compiled once."""
    plan = dataclasses.replace(PLAN, schemes={"feedback": PLAN.schemes["feedback"]}, samples=5, chunk=3, keep=(), trials=2)
    host, store = plan.host(), tmp_path_factory.mktemp("swept") / "store.zarr"
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(Sweep, "host", lambda self: host)
        yield plan, store, plan.run(store)


def cut(file):
    file.write_bytes(file.read_bytes()[:-7])


DAMAGES = {
    "settled_error/c/0/1/0": os.remove,
    "rms/c/0/0/0": cut,
    "diverged_at/c/0/0": os.remove,
    "finite/c/0/1/0": cut,
    "chunk_done": shutil.rmtree,
    "chunk_done/c/0/0": cut,
    "chunk_done/zarr.json": os.remove,
    "plant.gain/c/0": os.remove,
    "sample": shutil.rmtree,
    "scheme/c/0": cut,
    "zarr.json": lambda file: file.write_text("{"),
}


@pytest.mark.parametrize("damaged", DAMAGES)
def test_what_is_gone_or_cut_short_is_refused_and_computed_again(swept, tmp_path, damaged):
    plan, store, dataset = swept
    shutil.copytree(store, tmp_path / "store.zarr")
    DAMAGES[damaged](tmp_path / "store.zarr" / damaged)
    with pytest.raises(ValueError, match=r"store.zarr is damaged: .*; resuming the sweep mends it"):
        open_dataset(tmp_path / "store.zarr")
    if damaged.startswith("settled_error"):  # whoever reads it with xarray alone sees a hole, not zeros that pass every tolerance
        read = xr.open_zarr(tmp_path / "store.zarr", chunks=None, consolidated=False)
        assert summarise(read, 1e9)[0].yield_share == 0.6
    resumed = plan.run(tmp_path / "store.zarr", resume=True)
    xr.testing.assert_identical(resumed, dataset)
    assert resumed["settled_error"].values.tobytes() == dataset["settled_error"].values.tobytes()


def test_a_store_without_its_configuration_is_refused(swept, tmp_path):
    plan, store, _ = swept
    shutil.copytree(store, tmp_path / "store.zarr")
    for name in ("zarr.json", "chunk_done/zarr.json"):
        cut(tmp_path / "store.zarr" / name)
    with pytest.raises(ValueError, match="not a store that can be resumed; remove it and start again"):
        plan.run(tmp_path / "store.zarr", resume=True)


def test_a_chunk_is_marked_when_its_figures_are_on_the_disk(tmp_path, monkeypatch):
    done = []
    replace = os.replace

    def noted(what, path):
        replace(what, path)
        done.append(path)

    monkeypatch.setattr(files.os, "fsync", lambda descriptor: done.append(os.readlink(f"/proc/self/fd/{descriptor}")))
    monkeypatch.setattr(files.os, "replace", noted)
    filled(tmp_path / "store.zarr")
    store = tmp_path / "store.zarr"
    for chunk in (0, 1):
        mark = done.index(store / f"chunk_done/c/0/{chunk}")
        for name in ("rms", "finite"):
            renamed = done.index(store / f"{name}/c/0/{chunk}")
            assert files.UNFINISHED in done[renamed - 1], "the file is on the disk before it has its name"
            assert str(store / f"{name}/c/0") in done[renamed:mark], "and its name before the mark"


def test_a_store_is_in_use_by_one_process_at_a_time(swept, tmp_path):
    plan, store, _ = swept
    with files.only_one(store), pytest.raises(ValueError, match=r"store.zarr is in use by another process; wait for its end"):
        plan.run(store, resume=True)
    assert plan.run(store, resume=True).sizes["sample"] == 5


# Tunings ---------------------------------------------------------------------------------------------------------------------


class Killed(Exception):
    pass


@pytest.fixture(scope="module")
def tuned(tmp_path_factory):
    """A problem, the folder of a tuning that was stopped after the third of four steps, and what it would have ended with."""
    problem, folder = dataclasses.replace(PROBLEM, steps=4, clip=np.inf), tmp_path_factory.mktemp("tuned") / "state"

    def stop(step, losses, best):
        if step == 3:
            raise Killed

    with pytest.raises(Killed):
        problem.run(folder, progress=stop)
    return problem, folder, problem.run()


def assert_equal(one, other):
    for field in dataclasses.fields(one):
        if field.name != "scheme":
            jax.tree.map(np.testing.assert_array_equal, getattr(one, field.name), getattr(other, field.name))


def test_a_flipped_bit_in_a_tuning_changes_nothing(tuned, tmp_path):
    problem, folder, whole = tuned
    for _ in flipped(folder, tmp_path / "state", TIMES or 30, seed=2):
        assert_equal(problem.run(tmp_path / "state", resume=True), whole)


@pytest.mark.parametrize("content", [b"", b"{}", b"[]", b"null", b'{"sha256": 1}', b"\xff"])
def test_a_damaged_tuning_falls_back_or_is_refused_in_one_line(tuned, tmp_path, content):
    problem, folder, whole = tuned
    names = {name.name for name in files_of(folder)}
    assert names == {"configuration.json", "state.npz", "previous.npz"}
    for name in names:
        shutil.copytree(folder, tmp_path / name)
        (tmp_path / name / name).write_bytes(content)
        assert_equal(problem.run(tmp_path / name, resume=True), whole)
    shutil.copytree(folder, tmp_path / "state")
    for name in names - {"configuration.json"}:
        (tmp_path / "state" / name).write_bytes(content)
    with pytest.raises(ValueError, match=r"state.npz is damaged: .*; remove .*state and start again") as refusal:
        problem.run(tmp_path / "state", resume=True)
    assert "\n" not in str(refusal.value)
    (tmp_path / "state/configuration.json").write_bytes(content)
    with pytest.raises(ValueError, match="not a tuning that can be resumed"):
        problem.run(tmp_path / "state", resume=True)


def test_a_state_that_is_damaged_again_falls_back_again(tuned, tmp_path):
    """What was damaged does not take the place of the state that was fallen back on."""
    problem, folder, whole = tuned
    shutil.copytree(folder, tmp_path / "state")
    for content in (b"", b"PK"):
        (tmp_path / "state/state.npz").write_bytes(content)
        assert_equal(problem.run(tmp_path / "state", resume=True), whole)


def test_two_tunings_do_not_share_a_folder(tuned, tmp_path):
    problem, folder, whole = tuned
    shutil.copytree(folder, tmp_path / "state")
    used = pytest.raises(ValueError, match="state is in use by another process; wait for its end, or choose another folder")
    with Folder(tmp_path / "state", problem.configuration(), True), used:
        problem.run(tmp_path / "state", resume=True)
    assert_equal(problem.run(tmp_path / "state", resume=True), whole)


# Campaigns -------------------------------------------------------------------------------------------------------------------

_, SCHEME, TASK = case("p_type")
TRIALS = [Measured(0.1 * j * np.asarray(TASK.reference), np.full((TASK.N, 1), 0.1 * j), {}, (), f"trial-{j}.csv") for j in range(1, 5)]


@pytest.fixture(scope="module")
def campaign(tmp_path_factory):
    """The folder of a campaign of three trials, and what the machine plays after each."""
    folder = tmp_path_factory.mktemp("campaign") / "state"
    running = Campaign.start(folder, SCHEME, TASK, recipe={"scenario": "axis"})
    played = [running.tables()["u"]]
    for trial in TRIALS[:3]:
        running.keep(running.turn(trial))
        played.append(running.tables()["u"])
    return folder, played


@pytest.fixture
def copied(campaign, tmp_path):
    shutil.copytree(campaign[0], tmp_path / "state")
    return tmp_path / "state", campaign[1]


def opened(folder):
    return Campaign.open(folder, SCHEME, TASK)


def goes_on_or_back(folder, played):
    """The campaign goes on from its third trial, or says in one line that it cannot, and goes back to an earlier one."""

    def goes_on():
        np.testing.assert_array_equal(opened(folder).tables()["u"], played[3])
        opened(folder).keep(opened(folder).turn(TRIALS[3]))

    said = refusal(goes_on)
    if said is None:
        return
    assert "--undo goes back" in said
    assert "a second line" not in said
    last = max(m["trial"] for m in Journal(folder).behind())
    np.testing.assert_array_equal(opened(folder).tables(last)["u"], played[last])
    opened(folder).undo(last)
    np.testing.assert_array_equal(opened(folder).tables()["u"], played[last])
    opened(folder).keep(opened(folder).turn(TRIALS[last]))


def test_a_flipped_bit_in_a_campaign_is_refused_or_changes_nothing(campaign, tmp_path):
    folder, played = campaign
    for _ in flipped(folder, tmp_path / "state", TIMES or 45, seed=3):
        goes_on_or_back(tmp_path / "state", played)


@pytest.mark.parametrize("content", [b"", b"{}", b"[]", b"3", b'{"format": 1}', b'{"format": 2, "serial": 2, "event": "trial"}', b"\xff"])
@pytest.mark.parametrize("entry", ["000000", "000002", "000003"])
def test_a_manifest_that_is_none_is_passed_by(copied, entry, content):
    folder, played = copied
    (folder / entry / "manifest.json").write_bytes(content)
    np.testing.assert_array_equal(opened(folder).tables()["u"], played[3])  # it is there twice
    (folder / entry / "manifest.copy.json").write_bytes(content)
    goes_on_or_back(folder, played)
    assert [row["event"] for row in Journal(folder).log()].count("damaged") == 1


CHANGES = {
    "parent": lambda m: m | {"parent": m["serial"]},
    "later parent": lambda m: m | {"parent": 7},
    "no parent": lambda m: m | {"parent": None},
    "no recipe": lambda m: {name: of for name, of in m.items() if name != "recipe"},
    "another event": lambda m: m | {"event": "rewind"},
    "figures": lambda m: m | {"figures": {}},
    "serial": lambda m: m | {"serial": 1},
    "to": lambda m: m | {"event": "undo", "to": m["serial"]},
}


@pytest.mark.parametrize("change", CHANGES)
def test_a_manifest_without_a_checksum_is_looked_at(copied, change):
    """Campaigns of the format that had none go on; what does not fit is refused."""
    folder, played = copied
    for entry in folder.iterdir():
        manifest = {name: of for name, of in json.loads((entry / "manifest.json").read_text()).items() if name != "sha256"}
        (entry / "manifest.copy.json").unlink()
        (entry / "manifest.json").write_text(json.dumps(manifest | {"format": 1}))
        for file in entry.glob("*.npz"):
            np.savez(file, **read_arrays(file))
    np.testing.assert_array_equal(opened(folder).tables()["u"], played[3])
    last = folder / "000003" / "manifest.json"
    last.write_text(json.dumps(CHANGES[change](json.loads(last.read_text()))))
    goes_on_or_back(folder, played)
    assert Journal(folder).manifests()[3]["event"] == "damaged"


def test_a_memory_that_is_not_a_number_is_refused(copied):
    folder, played = copied
    file = folder / "000003" / "memory.npz"
    lost = {name: np.full_like(of, np.nan) for name, of in read_arrays(file).items()}
    np.savez(file, **lost)
    with pytest.raises(ValueError, match=r"memory.npz cannot be read .*its checksum is missing"):
        opened(folder).tables()
    file.write_bytes(archive(lost))  # with a checksum of its own
    with pytest.raises(ValueError, match="the memory after trial 3 is not a number in 000 u"):
        opened(folder).tables()
    file.write_bytes(archive({name: of[:-1] for name, of in lost.items()}))
    with pytest.raises(ValueError, match=r"the memory holds 000 u .*; this scheme needs 000 u"):
        opened(folder).tables()
    goes_on_or_back(folder, played)


def rounded(trial, digits):
    return trial._replace(y=np.array([[float(f"{v:.{digits}g}")] for v in trial.y[:, 0]]), source="again.csv")


def test_one_measured_trial_is_one_trial(copied):
    folder, _ = copied
    for again in (TRIALS[0], TRIALS[2], rounded(TRIALS[1], 9), TRIALS[1]._replace(u=None)):
        for learn in (True, False):
            with pytest.raises(ValueError, match=r"is trial \d, which was learned from already; measure trial 4"):
                opened(folder).turn(again, learn=learn, replay_input=True)
    running = opened(folder)
    running.keep(running.turn(TRIALS[3], learn=False))
    for again in (TRIALS[3], rounded(TRIALS[3], 9)):
        for learn in (True, False):
            with pytest.raises(ValueError, match="is trial 4, which was looked at already; --undo 3 forgets it, so that it can be"):
                opened(folder).turn(again, learn=learn)
    other = TRIALS[3]._replace(y=TRIALS[3].y * (1 + 1e-6))  # a machine's trials of one table differ by more
    assert opened(folder).turn(other).trial == 5
    opened(folder).undo(3)
    opened(folder).keep(opened(folder).turn(TRIALS[3]))
    assert opened(folder).trials == 4


def test_what_would_not_be_a_number_is_not_learned(copied, monkeypatch):
    folder, _ = copied
    monkeypatch.setattr(of_campaign, "_learned", lambda scheme, task, memory, trial: jax.tree.map(lambda x: np.nan * x, memory))
    turn = opened(folder).turn(TRIALS[3])
    assert turn.refusals[0] == "what would be learned is not a number in 000 u"
    with pytest.raises(ValueError, match="not a number"):
        opened(folder).keep(turn)
