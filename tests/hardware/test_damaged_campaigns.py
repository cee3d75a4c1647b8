"""A damaged campaign leads to the same input, or says in one line how to go back.

A trial that was measured once is also counted once.
"""

import contextlib
import functools
import json
import shutil
import sys
from pathlib import Path

import campaigns_with_faults as faults
import jax
import numpy as np
import pytest
from cases import case, first_order, follows, p_type
from fuzz import damaged, dumped, flipped, fuzz, pick, refusal

from jaxilc.cli.hardware import _bind
from jaxilc.hardware import Campaign, Journal, Measured, Rules
from jaxilc.hardware import campaign as of_campaign
from jaxilc.hardware import journal as of_journal
from jaxilc.hardware.checks import ACCEPTED, same
from jaxilc.storage.sealed import archive, json_text, read_arrays, sealed

pytestmark = pytest.mark.usefixtures("quickly_and_quietly")

_, SCHEME, TASK = case("p_type")
RULES = Rules(accept=ACCEPTED)  # the trials below are no machine's
Y, U = 0.1 * np.asarray(TASK.reference), np.full((TASK.N, 1), 0.1)
TRIALS = [Measured(j * Y, j * U, {}, (), f"trial-{j}.csv") for j in range(1, 5)]


def made(folder, size=1.0):
    """Make a campaign of three trials; return what the machine plays after each."""
    running = Campaign.start(folder, SCHEME, TASK, recipe={"scenario": "axis"}, rules=RULES)
    played = [running.schedules()["u"]]
    for trial in TRIALS[:3]:
        running.keep(running.turn(trial._replace(y=size * trial.y)))
        played.append(running.schedules()["u"])
    return played


@pytest.fixture(scope="module")
def campaign(tmp_path_factory):
    folder = tmp_path_factory.mktemp("campaign") / "state"
    return folder, made(folder)


@pytest.fixture
def copied(campaign, tmp_path):
    shutil.copytree(campaign[0], tmp_path / "state")
    return tmp_path / "state", campaign[1]


def opened(folder):
    return Campaign.open(folder, SCHEME, TASK, rules=RULES)


def unbound(folder):
    """Make of a campaign one of before, in which nothing says which files belong to an entry."""
    (folder / "head.json").unlink()
    for file in folder.glob("*/manifest*.json"):
        manifest = json.loads(file.read_text())
        for name in ("files", "previous", "sha256"):
            del manifest[name]
        file.write_text(json_text(sealed(manifest | {"format": 2})))


def emptied(folder, entry):
    """Damage both manifests of an entry."""
    for name in ("manifest.json", "manifest.copy.json"):
        (folder / f"{entry:06d}" / name).write_bytes(b"")


def goes_on_or_back(folder, played):
    """Check that a campaign goes on from its third trial, or refuses in one line and goes back."""

    def goes_on():
        np.testing.assert_array_equal(opened(folder).schedules()["u"], played[3])
        opened(folder).keep(opened(folder).turn(TRIALS[3]))

    said = refusal(goes_on)
    if said is None:
        return
    assert "--undo goes back" in said
    assert "a second line" not in said
    last = max(m["trial"] for m in Journal(folder).behind())
    np.testing.assert_array_equal(opened(folder).schedules(last)["u"], played[last])
    opened(folder).undo(last)
    np.testing.assert_array_equal(opened(folder).schedules()["u"], played[last])
    opened(folder).keep(opened(folder).turn(TRIALS[last]))


def test_a_trial_is_stored_after_that_whose_memory_it_learned_from(copied):
    folder, slow = copied[0], opened(copied[0])
    turn = slow.turn(TRIALS[3])
    opened(folder).undo(2)
    opened(folder).keep(opened(folder).turn(TRIALS[3]))  # trial 3 anew, by a quicker call
    with pytest.raises(ValueError, match="trial 4 does not follow on trial 3, which another proc"):
        slow.keep(turn)
    assert [m["serial"] for m in Journal(folder).live()] == [0, 1, 2, 5]


def test_a_flipped_bit_in_a_campaign_is_refused_or_changes_nothing(campaign, tmp_path):
    folder, played = campaign
    fuzz(45, lambda rng: goes_on_or_back(flipped(rng, folder, tmp_path / "state"), played), ())


@pytest.mark.parametrize(
    "content",
    [
        b"", b"{}", b"[]", b"3", b'{"format": 1}', b'{"format": 2, "serial": 2, "event": "trial"}',
        b"\xff",
    ],
)  # fmt: skip
@pytest.mark.parametrize("entry", ["000000", "000002", "000003"])
def test_a_manifest_that_is_none_is_passed_by(copied, entry, content):
    folder, played = copied
    (folder / entry / "manifest.json").write_bytes(content)
    np.testing.assert_array_equal(opened(folder).schedules()["u"], played[3])  # it is stored twice
    (folder / entry / "manifest.copy.json").write_bytes(content)
    goes_on_or_back(folder, played)
    assert [row["event"] for row in Journal(folder).log()].count("damaged") == 1


@pytest.mark.parametrize("later", [0, 1])
def test_a_trial_that_was_undone_does_not_come_back_where_its_successor_is_damaged(copied, later):
    folder, played = copied
    opened(folder).undo(1)
    for trial in TRIALS[3:] + TRIALS[:later]:
        trial = trial._replace(y=1.1 * trial.y)
        opened(folder).keep(opened(folder).turn(trial))  # trial 2 anew, and one more
    emptied(folder, 5)
    for trial in (2, 3):
        with pytest.raises(ValueError, match=rf"{trial} is not one to go back to; .* are 0 to 1, "):
            opened(folder).undo(trial)
    opened(folder).undo(1)
    np.testing.assert_array_equal(opened(folder).schedules()["u"], played[1])


def test_an_entry_that_cannot_be_read_may_be_an_undo_and_a_trial_before_it_undone(copied):
    folder, _ = copied
    opened(folder).undo(1)
    emptied(folder, 4)
    doubted = [opened(folder).doubt(trial) for trial in range(4)]
    told = [f"entry 4 cannot be read, and may be an undo of trial {j}, " for j in (1, 2, 3)]
    assert [text[: len(told[0])] for text in doubted] == ["", *told]
    opened(folder).undo(3)
    opened(folder).keep(opened(folder).turn(TRIALS[3]))
    assert opened(folder).doubt(3) == ""
    emptied(folder, 6)
    (told,) = {opened(folder).doubt(trial)[:23] for trial in (1, 2, 3)}
    assert told == "entry 6 cannot be read,"
    shutil.rmtree(folder / "000006")
    (folder / "head.json").unlink()
    assert [opened(folder).doubt(trial) for trial in (1, 2)] == ["", ""], "no entry is damaged"


def test_where_nothing_can_be_gone_back_to_the_refusal_says_so(copied):
    folder, _ = copied
    (folder / "head.json").unlink()
    for entry, said in enumerate(("allowed are 1 to 3, ", "none can be read; start")):
        emptied(folder, entry)
        with pytest.raises(ValueError, match=f"trial = 0 is not one to go back to; {said}"):
            opened(folder).undo(0)


def test_without_its_head_a_campaign_goes_on_from_its_last_trial(copied):
    folder, played = copied
    (folder / "head.json").unlink()
    with pytest.raises(ValueError, match=r"head.json is missing"):
        opened(folder).schedules()
    opened(folder).undo(3)
    np.testing.assert_array_equal(opened(folder).schedules()["u"], played[3])
    assert len(Journal(folder).live()) == 4


CHANGES = {
    "parent": lambda m: m | {"parent": m["serial"]}, "later parent": lambda m: m | {"parent": 7},
    "no parent": lambda m: m | {"parent": None},
    "no recipe": lambda m: {name: of for name, of in m.items() if name != "recipe"},
    "another event": lambda m: m | {"event": "rewind"}, "figures": lambda m: m | {"figures": {}},
    "serial": lambda m: m | {"serial": 1}, "to": lambda m: m | {"event": "undo", "to": m["serial"]},
}  # fmt: skip


@pytest.mark.parametrize("change", CHANGES)
def test_a_manifest_without_a_checksum_is_looked_at(copied, change):
    """Campaigns of the first format, which had no checksum, go on."""
    folder, played = copied
    unbound(folder)
    for entry in folder.iterdir():
        manifest = json.loads((entry / "manifest.json").read_text())
        del manifest["sha256"]
        (entry / "manifest.copy.json").unlink()
        (entry / "manifest.json").write_text(json.dumps(manifest | {"format": 1}))
        for file in entry.glob("*.npz"):
            np.savez(file, **read_arrays(file))
    np.testing.assert_array_equal(opened(folder).schedules()["u"], played[3])
    last = folder / "000003" / "manifest.json"
    last.write_text(json.dumps(CHANGES[change](json.loads(last.read_text()))))
    goes_on_or_back(folder, played)
    assert Journal(folder).manifests()[3]["event"] == "damaged"


def test_a_memory_that_is_not_a_number_is_refused(copied):
    folder, played = copied
    unbound(folder)
    file = folder / "000003" / "memory.npz"
    lost = {name: np.full_like(of, np.nan) for name, of in read_arrays(file).items()}
    np.savez(file, **lost)
    with pytest.raises(ValueError, match=r"memory.npz cannot be read .*its checksum is missing"):
        opened(folder).schedules()
    file.write_bytes(archive(lost))  # the archive has a valid checksum
    with pytest.raises(ValueError, match="the memory after trial 3 is not a number in 000 u"):
        opened(folder).schedules()
    file.write_bytes(archive({name: of[:-1] for name, of in lost.items()}))
    with pytest.raises(ValueError, match=r"the memory holds 000 u .*; this scheme needs 000 u"):
        opened(folder).schedules()
    goes_on_or_back(folder, played)


def plays_as_before(state, played):
    np.testing.assert_array_equal(opened(state).schedules()["u"], played[3])


@pytest.fixture(scope="module")
def alike(tmp_path_factory):
    """Return the folder of another campaign of the same scheme and task."""
    folder = tmp_path_factory.mktemp("alike") / "state"
    made(folder, size=0.9)
    return folder


def test_what_is_whole_but_in_a_wrong_place_is_refused_or_changes_nothing(
    campaign, alike, tmp_path
):
    """Every file is exchanged with every other of its name, and every file and entry removed."""
    folder, played = campaign
    others = [folder, alike]
    names = ("memory.npz", "trial.npz", "manifest.json", "manifest.copy.json", "head.json")
    exchanges = [
        (target.relative_to(folder), source)
        for name in names
        for target in sorted(folder.rglob(name))
        for other in others
        for source in sorted(other.rglob(name))
        if source != target
    ]
    entries = [Path(f"{serial:06d}") for serial in range(4)]
    exchanges += [(entry, other / of) for entry in entries for of in entries for other in others]
    exchanges += [(f.relative_to(folder), None) for f in sorted(folder.rglob("*"))]
    refused = 0
    for target, source in exchanges:
        state = tmp_path / "state"
        shutil.rmtree(state, ignore_errors=True)
        shutil.copytree(folder, state)
        if (state / target).is_dir():
            shutil.rmtree(state / target)
        else:
            (state / target).unlink()
        if source is not None:
            (shutil.copytree if source.is_dir() else shutil.copyfile)(source, state / target)
        here = target == Path("000000")  # without its start a campaign cannot go back
        said = refusal(functools.partial(plays_as_before, state, played))
        if said is not None and not (here and source != folder / target):
            refused += 1
            assert "--undo goes back" in said
            last = max(m["trial"] for m in Journal(state).behind())
            opened(state).undo(last)
            np.testing.assert_array_equal(opened(state).schedules()["u"], played[last])
    assert len(exchanges) == 152
    assert refused >= 30  # the others are read by nobody, or stand there twice


def test_a_campaign_of_before_goes_on_and_is_bound_from_then_on(copied):
    folder, _ = copied
    unbound(folder)
    journal = Journal(folder)
    assert not journal.bound
    opened(folder).keep(opened(folder).turn(TRIALS[3]))
    assert journal.bound
    assert [m["format"] for m in journal.manifests()] == [2, 2, 2, 2, 3]
    shutil.copyfile(folder / "000002" / "manifest.json", folder / "000003" / "manifest.json")
    (folder / "000003" / "manifest.copy.json").unlink()
    with pytest.raises(ValueError, match=r"000003/manifest.json cannot be read"):
        journal.live()


def test_each_entry_of_a_long_campaign_is_checked_once(tmp_path, monkeypatch):
    """From the 1025th on all of them were checked anew at each of thirty readings."""
    plain = {"format": 1, "recipe": {}, "configuration": {}, "hashes": {}, "findings": []}
    plain |= {"figures": {"error": 1.0}, "source": "", "learned": True}
    for k in range(1100):
        (tmp_path / f"{k:06d}").mkdir()
        of = {"event": "trial" if k else "start", "serial": k, "trial": k, "parent": k - 1}
        (tmp_path / f"{k:06d}" / "manifest.json").write_text(json.dumps(plain | of))
    assert len(Journal(tmp_path).live()) == 1100
    monkeypatch.setattr(of_journal, "_checked", None)
    assert len(Journal(tmp_path).live()) == 1100


def test_a_campaign_that_was_stopped_at_its_start_is_not_called_older(tmp_path, capsys):
    journal = Campaign.start(tmp_path / "state", SCHEME, TASK).journal
    (journal.path / "head.json").unlink()
    _bind(journal)
    assert journal.bound
    assert capsys.readouterr().out == ""
    unbound(journal.path)
    _bind(journal)
    assert "which is older than that" in " ".join(capsys.readouterr().out.split())


def test_a_folder_that_is_named_like_an_entry_far_behind_all_is_named(copied):
    (copied[0] / "999999").mkdir()
    with pytest.raises(ValueError, match="999999 is no entry of this campaign, which has 4 others"):
        opened(copied[0])


def rounded(trial, digits):
    return trial._replace(
        y=np.array([[float(f"{v:.{digits}g}")] for v in trial.y[:, 0]]), source="again.csv"
    )


def test_one_measured_trial_is_one_trial(copied):
    folder, _ = copied
    coarse = TRIALS[1]._replace(y=np.round(TRIALS[1].y, 4))
    for again in (
        TRIALS[0], TRIALS[2], *(rounded(TRIALS[1], digits) for digits in (4, 6, 8, 9)), coarse,
        TRIALS[1]._replace(y=TRIALS[1].y.astype(np.float32)), TRIALS[1]._replace(u=None),
    ):  # fmt: skip
        for learn in (True, False):
            with pytest.raises(
                ValueError, match=r"is trial \d, which was learned from alr.*trial 4"
            ):
                opened(folder).turn(again, learn=learn, replay_input=True)
    running = opened(folder)
    running.keep(running.turn(TRIALS[3], learn=False))
    for again in (TRIALS[3], rounded(TRIALS[3], 9)):
        for learn in (True, False):
            with pytest.raises(
                ValueError, match="which was looked at already; --undo 3 forgets it"
            ):
                opened(folder).turn(again, learn=learn)
    with pytest.raises(ValueError, match="leave out a new trial that is the same up to the resol"):
        opened(folder).turn(TRIALS[3]._replace(source="of a coarse encoder"), learn=False)
    # On a real machine two trials of the same table differ by more.
    other = TRIALS[3]._replace(y=TRIALS[3].y * (1 + 1e-6))
    assert opened(folder).turn(other).trial == 5
    stored = folder / "000001" / "trial.npz"
    content = stored.read_bytes()
    stored.write_bytes(b"")
    assert opened(folder).turn(TRIALS[0]._replace(y=TRIALS[0].y * (1 + 1e-6))).trial == 5
    stored.write_bytes(content)
    assert opened(folder).turn(rounded(TRIALS[3]._replace(y=other.y + 1e-4), 4)).trial == 5
    opened(folder).undo(3)
    few = rounded(TRIALS[3], 6)
    opened(folder).keep(opened(folder).turn(few))
    with pytest.raises(ValueError, match="is trial 4, which"):
        opened(folder).turn(few._replace(y=np.round(few.y, 6)))
    opened(folder).undo(3)
    opened(folder).keep(opened(folder).turn(TRIALS[3]))
    assert opened(folder).trials == 4


@pytest.mark.parametrize("resolution", [5e-4, 2.5e-4, 1e-6, None])  # of an encoder [mm]
def test_a_record_is_known_by_its_digits_whatever_the_encoder(resolution):
    y = 10 * np.linspace(0, 1, 1001) ** 2 * (3 - 2 * np.linspace(0, 1, 1001))
    y = y if resolution is None else np.round(y / resolution) * resolution
    y, single = y[:, None], y.astype(np.float32)[:, None]
    for numbers, of in ((y, "%.3f"), (y, "%.4f"), (y, "%.4g"), (single, "%.6g"), (single, "%.9g")):
        file = np.array([[float(of % v)] for v in numbers[:, 0]])
        assert same(y, file)
        assert same(file, y)
        assert not same(y + 1e-3 * np.sin(np.arange(1001))[:, None], file)


def test_trials_that_are_a_count_apart_are_two_where_one_has_a_digit_more():
    rng = np.random.default_rng(0)
    one = np.minimum(np.round(1000 - 50 * np.linspace(-1, 1, 501) ** 2, 4), 1000.0)
    other = np.round(one + 1e-4 * rng.choice([-1, 0, 0, 1], 501), 4)
    other[250] = 1000.0001
    assert not same(one, other)
    assert not same(other, one)


def test_what_would_not_be_a_number_is_not_learned(copied, monkeypatch):
    folder, _ = copied

    def learned(scheme, task, memory, trial):
        return jax.tree.map(lambda x: np.nan * x, memory)

    monkeypatch.setattr(of_campaign, "learned", learned)
    turn = opened(folder).turn(TRIALS[3])
    assert turn.refusals[0] == "what would be learned is not a number in 000 u"
    with pytest.raises(ValueError, match="not a number"):
        opened(folder).keep(turn)


def command(*arguments):
    """Return the exit code of a command."""
    return faults.call(*arguments)[0]


def test_a_manifest_that_somebody_made_is_refused_in_one_line(here, tmp_path, monkeypatch):
    """It has a correct checksum, or is in the first format, without one."""
    monkeypatch.setattr(sys, "argv", [])
    (tmp_path / "axis.toml").write_text(first_order(0.5, 0.5) + follows(50.0, 0.02) + p_type(0.0))
    (tmp_path / "trial.csv").write_text(
        "t [s],y,u\n" + "".join(f"{k * 0.001},{0.1 * k},{0.2 * k}\n" for k in range(21))
    )
    for more in (
        ("--scenario", "axis.toml", "--limit", 100.0),
        ("--measured", "trial.csv", "--set", "campaign.accept=schedule"),
    ):
        assert command("next", "--state", "whole", *more, "--out", "a.csv") == 0

    def attempt(rng):
        shutil.rmtree("state", ignore_errors=True)
        shutil.copytree("whole", "state")
        if rng.random() < 0.9:
            unbound(Path("state"))
        entry = Path("state") / pick(rng, ("000000", "000001"))
        manifest = json.loads((entry / "manifest.json").read_text())
        manifest = {name: of for name, of in manifest.items() if name != "sha256"}
        part = pick(rng, (None, "recipe", "figures"))
        changed = (
            manifest | {part: damaged(rng, manifest[part])}
            if part in manifest
            else damaged(rng, manifest)
        )
        if rng.random() < 0.5 and isinstance(changed, dict):
            changed["format"] = 1
        # A value that strict JSON cannot hold is written as it is.
        with contextlib.suppress(ValueError, RecursionError):
            changed = changed if changed.get("format") == 1 else sealed(changed)
        for name in ("manifest.json", "manifest.copy.json"):
            (entry / name).write_text(dumped(changed), encoding="utf-8", errors="surrogatepass")
        assert command("trials", "--state", "state") in (0, 2)
        assert command(
            "next", "--state", "state", "--dry-run",
            *pick(rng, ((), ("--undo", 0), ("--measured", "trial.csv"))),
        ) in (0, 2, 3)  # fmt: skip

    fuzz(25, attempt, ())
