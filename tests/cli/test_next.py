"""`jaxilc next`, `trials` and `identify --state` on the shop floor: one campaign through files."""

import json
import re
import shutil

import numpy as np
import pytest
import scipy.signal
from cases import follows, lag, p_type
from command import invoked, write_columns

from jaxilc.cli.hardware import _log_table
from jaxilc.hardware import Campaign, Journal, Measured, campaign, prediction
from jaxilc.hardware.prediction import Place
from jaxilc.learning import Machine
from jaxilc.learning.variation import Variation
from jaxilc.outcomes import export
from jaxilc.plants import StateSpace
from jaxilc.runtime import provenance
from jaxilc.runtime.provenance import describe
from jaxilc.scenarios import load_scenario
from jaxilc.scenarios.campaigns import need_recorded
from jaxilc.schemes import PID, PIDType, WithFeedback
from jaxilc.signals import Task
from jaxilc.storage.files import only_one
from jaxilc.storage.sealed import json_text, sealed

N, DT, POLE = 40, 0.01, 20.0
AXIS = f"""trials = 8
{lag(POLE, DT, gain=1.0)}input_unit = "V"
{follows(2.5, N * DT)}[machine.sensor]
noise = 1e-3
{p_type(1.0)}lead = 3
[uncertainty]
"plant.gain" = {{ distribution = "uniform", low = 0.95, high = 1.05 }}
"""
PARAMS = {"scenario": "axis", "schemes": {"ilc": {"gamma_p": 1.2}}}


def call(*words):
    """Return standard output and standard error of a command; a mistake raises."""
    return invoked(*words)[1:]


def measure(folder, j, gain):
    """Play next.csv on a machine of this gain, by SciPy, and write trial-J.csv."""
    t, r, u = np.genfromtxt(folder / "next.csv", delimiter=",", skip_header=1).T
    kept = np.exp(-POLE * DT)
    y = scipy.signal.lfilter([0.0, gain * (1 - kept)], [1.0, -kept], u)
    y += 1e-3 * np.random.default_rng(j).normal(size=len(y))
    path = folder / f"trial-{j}.csv"
    write_columns(path, "t [s],r [mm],y [mm],u [V]", t, r, y, u)
    return path, float(np.sqrt(np.mean((r - y)[1:] ** 2)))


@pytest.fixture(scope="module")
def begun(tmp_path_factory):
    """Return the folder of a campaign with its first two trials, and what its calls printed."""
    folder = tmp_path_factory.mktemp("floor")
    (folder / "axis.toml").write_text(AXIS)
    (folder / "tuned.json").write_text(json.dumps(PARAMS))
    start = ("--scenario", folder / "axis.toml", "--params", folder / "tuned.json")
    said = [call("next", "--state", folder / "x", *start, "--out", folder / "next.csv")]
    for j in (1, 2):
        path, _ = measure(folder, j, 1.02)
        said.append(
            call("next", "--state", folder / "x", "--measured", path, "--out", folder / "next.csv")
        )
    return folder, said


@pytest.fixture
def copied(begun, here):  # where figures without a folder of their own go
    """Return a copy of the folder, in which a call of `next` goes on."""
    folder = shutil.copytree(begun[0], here / "floor")

    def go_on(*arguments):
        return call("next", "--state", folder / "x", "--out", folder / "next.csv", *arguments)

    return folder, go_on


def test_the_parameters_are_those_of_the_file_and_of_no_other(copied):
    folder, go_on = copied
    recipe = Journal(folder / "x").last_known()["recipe"]
    assert recipe["parameters"]["values"] == {"gamma_p": 1.2}
    assert Journal(folder / "x").last_known()["configuration"]["scheme"]["gamma_p"] == 1.2
    (folder / "other.json").write_text(json.dumps(PARAMS | {"schemes": {"ilc": {"lead": 1}}}))
    with pytest.raises(ValueError, match=r"other.json has other parameters than .* gamma_p: 1.2 t"):
        go_on("--params", folder / "other.json")
    go_on("--params", folder / "tuned.json")
    (folder / "tuned.json").unlink()
    assert "gamma_p = 1.2" in go_on()[0]  # the values are in the journal


def test_a_trial_stands_beside_its_prediction(begun):
    folder, said = begun
    texts = [out for out, _ in said]
    assert all("the campaign belongs to" in out and "sha256" in out for out in texts)
    assert "the plant file predicts an RMS error of" in texts[0]
    assert "95 % of 256 drawn machines" in texts[2]
    assert "outside" not in "".join(texts)
    measured = f"--measured {folder / 'trial-3.csv'} --out {folder / 'next.csv'}"
    assert texts[2].rstrip().endswith(measured)


def test_the_log_tells_which_error_is_outside():
    """A largest error outside its band made an rms error within its own seem outside."""
    row = {"serial": 2, "trial": 2, "event": "trial", "live": True, "learned": True}
    row |= {"rms_error": 2.34, "max_error": 4.0, "source": "a.csv", "warnings": ""}
    place = Place(2, (2.06, 3.35), (4.03, 6.83), -1.1, "largest error", "slight")
    for error, mark in {"largest error": "largest outside", "RMS error": "outside"}.items():
        table = _log_table("", [row], {2: place._replace(error=error)})
        assert [*map(str, table.columns[4].cells)] == [f"2.06 to 3.35 ({mark})"]


def test_another_machine_is_told_and_its_plant_is_found(copied, unpainted):
    folder, go_on = copied
    go_on("--undo", 0)
    for j in (1, 2):
        path, _ = measure(folder, 10 + j, 1.6)
        _, warned = go_on("--measured", path, "--report", folder / "n.json")
    assert "warning: trial 2 lies outside the 95 % band" in warned
    assert re.search(r"its \w+ error is [\d.]+ times the upper end of it, further out", warned)
    assert f"jaxilc identify --state {folder / 'x'} --out" in warned
    found = json.loads((folder / "n.json").read_text())
    assert found["predicted"]["level"] == "clear"
    assert found["source"]["weights"] == {"ilc.gamma_p": 1.2}
    assert [f[0] for f in Journal(folder / "x").last_known()["findings"]] == ["note", "warning"]
    # Its own trials give the plant, and the campaign goes on with the new file.
    new = folder / "axis-2.toml"
    out, _ = call("identify", "--state", folder / "x", "--out", new, "--report", folder / "i.json")
    numbers = json.loads((folder / "i.json").read_text())
    assert numbers["gain"]["low"] < 1.6 < numbers["gain"]["high"]
    assert numbers["poles[0]"]["low"] < POLE < numbers["poles[0]"]["high"]
    assert numbers["trials"] == [1, 2]
    assert "next: go on with the new file" in out
    assert numbers["better"]
    assert numbers["after"] < 0.1 * numbers["before"]
    assert f"at most {numbers['margin']['after']:.3f} on the new plant" in out
    fitted = load_scenario(new)
    np.testing.assert_allclose(fitted.machine.plant.gain, numbers["gain"]["value"], rtol=1e-12)
    own = load_scenario(folder / "axis.toml")
    assert describe([fitted.schemes, fitted.task]) == describe([own.schemes, own.task])
    path, _ = measure(folder, 13, 1.6)
    out, warned = go_on("--scenario", new, "--measured", path)
    assert "axis-2.toml" in out.splitlines()[0]
    assert warned == ""


def test_a_changed_plant_file_is_told_with_what_it_means(copied):
    folder, go_on = copied
    file = folder / "axis.toml"
    path, _ = measure(folder, 3, 1.02)
    _, warned = go_on("--scenario", file, "--measured", path)
    assert warned == ""
    moved = file.rename(folder / "moved.toml")
    with pytest.raises(FileNotFoundError, match="if it was moved, name it by --scenario"):
        go_on()
    assert "next: trial 4" in go_on("--scenario", moved)[0]
    file.write_text(AXIS.replace("gain = 1.0", "gain = 1.01"))
    _, warned = go_on()
    assert "has changed since the campaign took it" in warned
    assert "learning goes on as before" in warned
    file.write_text(AXIS.replace("frequency = 2.5", "frequency = 5.0"))
    told = r"in: task.reference.*; go on with that one, or start .* folder; .*axis.toml has changed"
    with pytest.raises(ValueError, match=told):
        go_on()
    out, warned = call("trials", "--state", folder / "x", "--plot", folder / "t.png")
    assert "has changed" in warned
    assert "neither reference nor experiments of the campaign are known" in warned
    assert (folder / "t.png").stat().st_size > 10_000
    assert "verdict: trial 3" in out


def test_a_call_that_computes_otherwise_than_the_last_one_is_told(copied, monkeypatch):
    """In single precision, or after an update, a campaign went on without a word."""
    now = provenance.environment()
    other = now | {"precision": "float32", "devices": 7}
    other["versions"] = now["versions"] | {"jax": "0.1"}
    monkeypatch.setattr(provenance, "environment", lambda: other)
    (warned,) = copied[1]()[1].splitlines()
    assert re.search("x: precision: float64 there, float32 here; versions.jax: .* 0.1 here", warned)


def test_a_limit_of_a_call_without_a_trial_holds_and_is_said_to_be_forgotten(copied):
    """The input was written beyond the limit of the call, and the limit was forgotten."""
    folder, go_on = copied
    for undo in ((), ("--undo", 1)):
        with pytest.raises(ValueError, match=r"next u is .* allowed are \+-0.1 V \(campaign.limit"):
            go_on("--set", "campaign.limit=0.1", *undo)
    _, warned = go_on("--set", "campaign.limit=9", "--set", "campaign.predict=false")
    assert "only a trial or --undo stores --set campaign.predict, --set campaign.limit" in warned
    shutil.copy(folder / "axis.toml", folder / "other.toml")
    assert "--undo stores --scenario, and" in go_on("--scenario", folder / "other.toml")[1]
    same = Journal(folder / "x").last_known()["recipe"]["scenario"]
    assert go_on("--scenario", same)[1] == go_on()[1] == ""
    assert go_on("--undo", 1, "--set", "campaign.limit=9")[1] == ""
    (folder / "same.json").write_text(json.dumps(PARAMS | {"schemes": {"ilc": {"gamma_p": 1.0}}}))
    begin = ("next", "--state", folder / "y", "--out", folder / "y.csv")
    call(*begin, "--scenario", folder / "axis.toml", "--set", "campaign.predict=false")
    assert "--undo stores --params, and" in call(*begin, "--params", folder / "same.json")[1]
    with pytest.raises(ValueError, match=r"begins beyond a limit: the next u .* V \(--limit\)"):
        export(state=folder / "x", folder=folder / "law", limit=0.1)


def test_what_is_written_belongs_to_the_last_entry_since_one_call_goes_on_at_a_time(copied):
    """A slow call wrote the input of before over that of a trial that another had learned from."""
    folder, go_on = copied
    with only_one(folder / "x"):
        for words in ((), ("--undo", 1), ("--measured", measure(folder, 3, 1.02)[0])):
            with pytest.raises(ValueError, match=r"in use by process \d+, .* written; wait for"):
                go_on(*words)
        assert "trial 3, u up to" in call("next", "--state", folder / "x", "--dry-run")[0]
        assert "verdict: trial 2" in call("trials", "--state", folder / "x")[0]
    assert "next: trial 4" in go_on("--measured", folder / "trial-3.csv")[0]


def test_an_undo_in_a_dry_run_says_what_the_undo_says_of_a_damaged_campaign(copied):
    """It judged the trials that would be forgotten, and ended in the error of a damaged one."""
    folder, go_on = copied
    (folder / "x" / "000001" / "trial.npz").write_bytes(b"")
    assert "note: nothing is predicted by the trials so far: " in " ".join(go_on()[0].split())
    for file in (folder / "x" / "000002").glob("manifest*.json"):
        file.write_bytes(b"")
    dry = call("next", "--state", folder / "x", "--undo", 1, "--dry-run")[0]
    verdicts = [re.findall("verdict: trial .*", said) for said in (dry, go_on("--undo", 1)[0])]
    assert verdicts[0] == verdicts[1] != []


def test_trials_are_numbers_and_a_figure(copied):
    folder, go_on = copied
    path, rms = measure(folder, 3, 1.02)
    go_on("--measured", path, "--no-learn", "--plot", folder / "n.png")
    call("trials", "--state", folder / "x", "--report", folder / "t.json")
    found = json.loads((folder / "t.json").read_text())
    assert [row["trial"] for row in found["trials"]] == [0, 1, 2, 3]
    assert found["trials"][3]["rms_error"] == pytest.approx(rms, rel=1e-9)
    assert [place["step"] for place in found["predicted"]["trials"]] == [1, 2, 3]
    path, _ = measure(folder, 4, 1.02)
    (folder / "axis-2.toml").write_text(AXIS.replace("[20.0]", "[14.0]"))
    other = ("--scenario", folder / "axis-2.toml", "--set", "ilc.gamma_p=1.2")
    go_on("--measured", path, "--report", folder / "n.json", *other)
    call(
        "trials", "--state", folder / "x", "--report", folder / "u.json", "--plot", folder / "t.png"
    )
    again = json.loads((folder / "u.json").read_text())["predicted"]
    assert again["rms"]["high"][1] != found["predicted"]["rms"]["high"][1]
    assert again["trials"][:3] == found["predicted"]["trials"], "as when they were measured"
    assert json.loads((folder / "n.json").read_text())["predicted"]["step"] == 3
    assert (folder / "n.png").stat().st_size > 10_000


def test_nothing_is_predicted_where_it_is_not_wanted(copied):
    folder, go_on = copied
    file = folder / "x" / prediction.FILE
    file.write_text("damaged")
    assert "is predicted" not in go_on()[0]  # it is not computed for a call that measures nothing
    path, _ = measure(folder, 3, 1.02)
    assert "is predicted" not in go_on("--measured", path, "--set", "campaign.predict=false")[0]
    path, _ = measure(folder, 4, 1.02)
    assert "is predicted" not in go_on("--measured", path)[0]  # it is kept
    assert file.read_text() == "damaged"
    path, _ = measure(folder, 5, 1.02)
    assert (
        "90 % by the trials so far"
        in go_on("--measured", path, "--set", "campaign.predict=true")[0]
    )


def test_what_is_not_the_input_of_the_plant_is_not_fitted(copied, tmp_path):
    folder, _ = copied
    new = (
        "--scenario", folder / "loop.toml", "--set", "campaign.predict=false", "--out",
        folder / "next.csv",
    )  # fmt: skip
    law = 'class = "WithFeedback"\nlearning = { class = "PIDType" }\nfeedback = { class = "PID" }'
    (folder / "loop.toml").write_text(
        AXIS.replace('class = "PIDType"\ngamma_p = 1.0\nlead = 3', law)
    )
    call("next", "--state", tmp_path / "loop", *new)
    with pytest.raises(ValueError, match="has no measured trial yet"):
        call("identify", "--state", tmp_path / "loop", "--out", tmp_path)
    t, y = np.arange(N + 1) * DT, np.linspace(0, 1, N + 1)
    write_columns(tmp_path / "t.csv", "t [s],y [mm]", t, y)
    replayed = ("--measured", tmp_path / "t.csv", "--set", "campaign.replayed_input=true")
    call("next", "--state", tmp_path / "loop", *replayed, "--out", folder / "next.csv")
    with pytest.raises(ValueError, match=r"trial 1 was not measured .* In a closed loop"):
        call("identify", "--state", tmp_path / "loop", "--out", tmp_path)
    with pytest.raises(ValueError, match="RECORD and --state exclude each other"):
        call("identify", tmp_path / "t.csv", "--state", tmp_path / "loop")
    with pytest.raises(ValueError, match="RECORD is missing"):
        call("identify")


def test_of_many_trials_some_are_fitted(copied, monkeypatch, unpainted):
    """Where they have more samples than are read, those that are fitted lie evenly spread."""
    folder, go_on = copied
    for j in (3, 4, 5):
        go_on("--measured", measure(folder, j, 1.02)[0])
    monkeypatch.setattr(campaign, "MOST_SAMPLES", 3 * (N + 1))
    call(
        "identify", "--state", folder / "x", "--out", folder / "new", "--report", folder / "i.json"
    )
    assert json.loads((folder / "i.json").read_text())["trials"] == [1, 3, 5]


def test_a_file_without_a_header_is_named_in_the_next_command_too(copied):
    folder, go_on = copied
    path, rms = measure(folder, 3, 1.02)
    t, _, y, u = np.genfromtxt(path, delimiter=",", skip_header=1).T
    np.savetxt(folder / "3.txt", np.column_stack([np.arange(len(t)), u, y]))
    columns = "campaign.columns=sample,u [V],y [mm]"
    said, _ = go_on("--measured", folder / "3.txt", "--set", columns)
    assert f"trial 3: RMS error {rms:.6g} mm" in said
    assert f"--set '{columns}'" in said.splitlines()[-1]
    said, _ = call("trials", "--state", folder / "x")
    assert "record it, name its columns as before, then: jaxilc next" in said


def test_a_trial_that_ended_early_is_learned_from_as_far_as_it_goes(copied):
    folder, go_on = copied
    before = np.genfromtxt(folder / "next.csv", delimiter=",", skip_header=1)[:, 2]
    path, _ = measure(folder, 3, 1.02)
    lines = path.read_text().splitlines()
    rows = len(lines) - 1
    kept = rows // 2  # of the samples of the output
    path.write_text("\n".join(lines[: kept + 1]) + "\n")
    with pytest.raises(ValueError, match="short_trial=true accepts fewer"):
        go_on("--measured", path)
    asked = ("--measured", path, "--report", folder / "n.json")
    said = " ".join(go_on(*asked, "--set", "campaign.short_trial=true"))
    assert f"the trial ended after {kept - 1} of {rows - 1} samples" in " ".join(said.split())
    after = np.genfromtxt(folder / "next.csv", delimiter=",", skip_header=1)[:, 2]
    np.testing.assert_allclose(after[kept:], before[kept:], rtol=1e-9)
    assert np.max(np.abs(after[: kept - 2] - before[: kept - 2])) > 0
    journal = Journal(folder / "x")  # it is marked, so that no plant is fitted to it
    assert "weight" in journal.arrays(journal.live()[-1], "trial.npz")
    assert "predicted" not in json.loads((folder / "n.json").read_text())
    call("trials", "--state", folder / "x", "--report", folder / "t.json")
    placed = json.loads((folder / "t.json").read_text())["predicted"]["trials"]
    assert [one["serial"] for one in placed] == [1, 2], "the error of a part lies in no band"


def test_a_feedback_that_goes_on_from_trial_to_trial_must_be_recorded(tmp_path):
    """Computed from rest, it is another one."""
    task = Task(np.linspace(0, 1, 5), dt=DT)
    plant = StateSpace([[0.9]], [[0.1]], [[1.0]], dt=DT)
    carried = Machine(plant, variation=Variation(carried=1.0))
    law = PIDType(gamma_p=0.5)
    of_both = Campaign.start(tmp_path / "x", WithFeedback(law, PID(kp=0.5, ki=5.0)), task)
    bare = Measured(np.ones((5, 1)), np.ones((4, 1)), {}, (), "trial.csv")
    with pytest.raises(ValueError, match=r"trial.csv has no feedback: machine.variation.carried"):
        need_recorded(carried, of_both, bare)
    need_recorded(carried, of_both, bare._replace(others={"feedback": np.ones((4, 1))}))
    need_recorded(Machine(plant), of_both, bare)
    need_recorded(carried, Campaign.start(tmp_path / "y", law, task), bare)


def test_trials_without_learning_tell_when_to_stop(copied, unpainted):
    folder, go_on = copied
    with pytest.raises(ValueError, match="played twice"):
        call("potential", folder / "x")
    go_on("--undo", 0)
    for j in (1, 2, 3):  # trial 1 twice more; noise of 1e-3
        path, _ = measure(folder, j, 1.02)
        go_on("--measured", path, "--no-learn")
    file = folder / "axis.toml"
    call("potential", folder / "x", "--into", file, "--report", folder / "p.json")
    found = json.loads((folder / "p.json").read_text())
    assert found["names"] == ["trial 1", "trial 2", "trial 3"]
    assert found["new"]["low"] < 1e-3 < found["new"]["high"]
    text = file.read_text()
    file.write_text(text.replace(f"stop = {load_scenario(file).potential.stop!r}", "stop = 0.05"))
    for j in range(4, 9):
        path, error = measure(folder, j, 1.02)
        said, _ = go_on("--measured", path, "--scenario", file)
        assert ("what is new in each trial explains all of it" in said) == (error <= 0.05)
    assert error <= 0.05
    (line,) = re.findall("verdict: .*: jaxilc next --state .* --undo", said)
    assert line in call("trials", "--state", folder / "x")[0]


def test_an_experiment_is_none_to_judge_by_in_journals_that_do_not_know_it_either(copied):
    """The log of a campaign of before took the experiment for a trial whose error had grown."""
    folder, _ = copied
    text = AXIS.replace('"PIDType"\ngamma_p = 1.0\nlead = 3', '"ModelFreeGradient"\nstep = 0.8')
    (folder / "axis.toml").write_text(text)
    words = ("next", "--state", folder / "z", "--out", folder / "next.csv")
    said = call(*words, "--scenario", folder / "axis.toml")[0]
    assert "for trial 7" in said, "trial 8 is an experiment"
    for j in (1, 2):
        said = call(*words, "--measured", measure(folder, j, 1.02)[0])[0]
    (folder / "z" / "head.json").unlink()
    for file in (folder / "z").glob("*/manifest*.json"):
        old = json.loads(file.read_text())
        for name in ("files", "previous", "sha256", "trials_of_step"):
            del old[name]
        del old["recipe"]["stop"]
        file.write_text(json_text(sealed(old | {"format": 2})))
    (line,) = re.findall("verdict: trial 2 is experiment 1.*", said)
    assert line in call("trials", "--state", folder / "z")[0]
