"""A campaign runs on a machine that is known only by the files that it reads and writes.

The tests run ten trials, stop the process, undo trials, and check everything that is refused.
"""

import csv
import dataclasses
import errno
import json
import os
import re
import shutil
import subprocess
import sys
from functools import partial
from itertools import pairwise
from pathlib import Path

import control
import jax
import numpy as np
import pytest
import scipy.signal
from cases import ALGEBRA, case
from command import invoked as call

from jaxilc.cli import console
from jaxilc.cli.hardware import verdict
from jaxilc.figures.experiments import campaign_figure
from jaxilc.filters import ZeroPhaseButterworth
from jaxilc.hardware import (
    Campaign,
    Journal,
    Measured,
    Rules,
    controller_files,
    journal,
    read_measured,
)
from jaxilc.hardware import campaign as of_campaign
from jaxilc.hardware.campaign import learned
from jaxilc.hardware.checks import ACCEPTED, beyond_limits, larger, saturation, too_fast
from jaxilc.learning import Actuator, Machine, Sensor, learn, run_trial
from jaxilc.plants import StateSpace, from_control
from jaxilc.scenarios import load_scenario
from jaxilc.schemes import (
    CFDLMFAILC,
    AtSamples,
    Filtered,
    HigherOrder,
    Ladder,
    ModelFreeGradient,
    PIDType,
    PolynomialBasis,
    Scheme,
    WarmStart,
    WithFeedback,
)
from jaxilc.schemes.compose import Pair
from jaxilc.schemes.scheme import Feedforward
from jaxilc.signals import Task, Trial
from jaxilc.storage import files

TRIALS, KEY = 10, jax.random.key(3)
FACTOR = 40  # the error of the session falls by this factor
AXIS = """
[plant]
kind = "transfer_function"
num = [4000.0]
den = [1.0, 80.0, 4000.0]
[machine.actuator]
limit = 10.0
resolution = 3e-4
[task]
dt = 0.001
unit = "mm"
input_unit = "V"
[task.reference]
function = "s_curve"
positions = [0.0, 1.0, 0.0]
velocity = 20.0
acceleration = 600.0
jerk = 3e4
duration = 0.25
[schemes.pid]
class = "PID"
kp = 1.0
[schemes.ilc]
class = "WithFeedback"
feedback = { class = "PID", kp = 1.0, ki = 20.0 }
[schemes.ilc.learning]
class = "Filtered"
scheme = { class = "PIDType", gamma_p = 1.1, gamma_d = 18.0, lead = 4 }
filter = { class = "ZeroPhaseButterworth", cutoff = 60.0 }
"""
PROGRAM = "import sys; from jaxilc.cli import entry; {} entry.main()"


def real_machine(axis):
    """Return a machine that has another plant than the file's, an encoder and noise."""
    plant = from_control(control.tf([4600.0], [1.0, 60.0, 4000.0]))
    encoder = Sensor(resolution=1e-4, noise=5e-5)
    return dataclasses.replace(axis.machine, plant=plant, sensor=encoder)


@jax.jit
def _play(machine, feedback, task, u, key):
    return run_trial(machine, WithFeedback(Scheme(), feedback), task, Pair(Feedforward(u), ()), key)


def read_table(path):
    """Return the columns of a file by the names in its header."""
    with open(path, newline="") as file:
        header, *rows = csv.reader(file)
    return dict(zip(header, np.array(rows, float).T, strict=True))


def write_trial(path, t, r, y, u, units=("s", "mm", "mm", "V")):
    """Write a trial as a machine's trace, with 17 digits and an empty last input."""
    header = ",".join(f"{name} [{unit}]" for name, unit in zip("tryu", units, strict=True))
    rows = [",".join(f"{v:.17g}" for v in row) for row in zip(t[:-1], r, y, u, strict=False)]
    path.write_text("\n".join([header, *rows, f"{t[-1]:.17g},{r[-1]:.17g},{y[-1]:.17g},"]) + "\n")


class Rig:
    """The machine at the other end of the files."""

    def __init__(self, folder):
        self.folder = folder
        self.file = folder / "axis.toml"
        self.file.write_text(AXIS)
        self.axis = load_scenario(self.file)
        self.scheme, self.task = self.axis.schemes["ilc"], self.axis.task
        self.machine = real_machine(self.axis)

    def measure(self, table, trial, path):
        """Play the table of a file, and write the trace of a trial."""
        played, key = read_table(table), jax.random.fold_in(KEY, trial)
        u = played["feedforward [V]"][:-1, None]
        made = _play(self.machine, self.scheme.feedback, self.task, u, key)
        y, u = (np.asarray(signal)[:, 0] for signal in (made.y, made.u))
        write_trial(path, played["t [s]"], played["r [mm]"], y, u)
        return y, u


def go_on(state, out, *more):
    """Return what `next` of the campaign in a folder prints, as `call` does."""
    return call("next", "--state", state, "--out", out, *more)


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    """Run a campaign of ten trials through files only; the folder keeps tables and traces."""
    folder = tmp_path_factory.mktemp("session")
    rig = Rig(folder)
    state, played = folder / "state", []
    assert go_on(state, folder / "next-1.csv", "--scenario", rig.file, "--scheme", "ilc")[0] == 0
    for j in range(1, TRIALS + 1):
        y, u = rig.measure(folder / f"next-{j}.csv", j, folder / f"trial-{j}.csv")
        played.append((y, u))
        then = folder / f"next-{j + 1}.csv"
        assert go_on(state, then, "--measured", folder / f"trial-{j}.csv")[0] == 0
        if j == 7:  # a process of its own writes the same table
            program = PROGRAM.format("sys.argv[0] = 'jaxilc';")
            words = ("next", "--state", state, "--out", folder / "again.csv")
            subprocess.run([sys.executable, "-c", program, *map(str, words)], check=True)
            assert (folder / "again.csv").read_bytes() == then.read_bytes()
    rig.measure(then, TRIALS + 1, folder / f"trial-{TRIALS + 1}.csv")
    return rig, state, played


@pytest.fixture
def copied(session, tmp_path):
    """Return a copy of the session's campaign in another folder, with `trial.csv` to go on."""
    rig, state, _ = session
    shutil.copytree(state, tmp_path / "state")
    shutil.copy(rig.folder / "trial-11.csv", tmp_path / "trial.csv")
    return rig, tmp_path / "state", tmp_path


@pytest.mark.thorough
def test_a_measured_trial_takes_four_programs(tmp_path):
    # An operation on arrays of JAX would be a program of its own: there were 17 of the metrics.
    (tmp_path / "axis.toml").write_text(AXIS.replace("duration = 0.25", "duration = 0.251"))
    axis, compiled = load_scenario(tmp_path / "axis.toml"), []
    campaign = Campaign.start(tmp_path / "state", axis.schemes["ilc"], axis.task)
    y, u = np.linspace(0.0, 0.9, axis.task.N + 1)[:, None], np.ones((axis.task.N, 1))

    def listen(event, _, **about):
        if event == console.COMPILED:
            compiled.append(about["fun_name"])

    jax.monitoring.register_event_duration_secs_listener(listen)
    turn = campaign.turn(Measured(y, u, {}, (), "trial.csv"))
    names = {"jit(_compiled)", "jit(replay)", "jit(learned)", "jit(measure)"}
    assert names - {"jit(_compiled)"} <= set(compiled)  # the start has compiled the schedules
    assert set(compiled) <= names | {"jit(broadcast_in_dim)", "jit(stage)"}
    largest = np.max(np.abs(y - axis.task.reference)[1:])
    np.testing.assert_allclose(turn.metrics["max_error"], [largest], rtol=1e-12)


@pytest.mark.thorough
def test_ten_trials_through_files_are_the_loop_in_memory(session):
    rig, state, played = session
    history = learn(
        rig.machine, rig.scheme, rig.task, TRIALS, key=KEY, save=lambda trial: (trial.y, trial.u)
    )
    for ours, saved in zip(zip(*played, strict=True), history.saved, strict=True):
        np.testing.assert_allclose(np.stack(ours)[..., None], saved, rtol=0, atol=1e-12)
    memory = Campaign.open(state, rig.scheme, rig.task, actuator=rig.axis.machine.actuator).memory()
    np.testing.assert_allclose(memory.learning.u, history.memory.learning.u, rtol=0, atol=1e-12)
    rms = [np.sqrt(np.mean((rig.task.reference[1:, 0] - y[1:]) ** 2)) for y, _ in played]
    assert rms[-1] < rms[0] / FACTOR
    rows = Journal(state).log()
    np.testing.assert_allclose([row["rms_error"] for row in rows[1:]], rms, rtol=1e-12)
    assert [row["trial"] for row in rows] == list(range(TRIALS + 1))


def test_the_log_is_printed_written_and_plotted(copied):
    _, state, folder = copied
    go_on(state, folder / "next.csv", "--undo", 6)
    code, out, _ = call(
        "trials", "--state", state, "--csv", folder / "log.csv", "--plot", folder / "log.png"
    )
    assert code == 0
    assert out.count("trial, undone") == 4
    assert "state: errors in mm, effort in V" in " ".join(out.split())
    with open(folder / "log.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["event"] for row in rows] == ["start"] + ["trial"] * TRIALS + ["undo"]
    assert [row["live"] for row in rows] == ["True"] * 7 + ["False"] * 4 + ["False"]
    assert (folder / "log.png").stat().st_size > 10_000
    top, _ = campaign_figure(Journal(state).log(), unit="mm", input_unit="V")
    counts = {line.get_label(): len(line.get_xdata()) for line in top.lines}
    assert counts == {
        "rms error": 6, "rms error, undone": 4, "max error": 6, "max error, undone": 4,
    }  # fmt: skip


def test_undo_goes_back_to_the_table_that_was_played_and_on_from_there(copied, session):
    rig, state, folder = copied
    go_on(state, folder / "next.csv", "--undo", 7)
    assert (folder / "next.csv").read_bytes() == (rig.folder / "next-8.csv").read_bytes()
    # The same trial is measured again, and its data are learned from once more.
    rig.measure(folder / "next.csv", 8, folder / "again.csv")
    go_on(state, folder / "next.csv", "--measured", folder / "again.csv")
    assert (folder / "next.csv").read_bytes() == (rig.folder / "next-9.csv").read_bytes()
    go_on(state, folder / "next.csv", "--undo", 0)
    assert (folder / "next.csv").read_bytes() == (rig.folder / "next-1.csv").read_bytes()
    assert len(Journal(state).manifests()) == TRIALS + 4, "nothing is thrown away"
    with pytest.raises(
        ValueError, match=r"trial = 0 is not one to go back to; there is none before the start$"
    ):
        go_on(state, folder / "next.csv", "--undo", 0)


class Killed(BaseException):
    """This exception is not caught by any handler."""


KILLED_IN = {
    "arrays": (journal, "archive"),
    "manifest": (journal, "json_text"),
    "rename": (files.os, "rename"),
    "table": (files.os, "replace"),
}


@pytest.mark.thorough(but=["manifest"])
@pytest.mark.parametrize("when", KILLED_IN)
def test_killed_at_any_moment_nothing_is_lost(copied, monkeypatch, when):
    _, state, folder = copied
    before = {f: f.read_bytes() for f in state.rglob("*") if f.is_file()}

    def killed(*_, **__):
        raise Killed

    with monkeypatch.context() as broken:
        # A killed process does not remove its temporary files.
        broken.setattr(files.shutil, "rmtree", lambda *_, **__: None)
        broken.setattr(*KILLED_IN[when], killed)
        with pytest.raises(Killed):
            go_on(state, folder / "next.csv", "--measured", folder / "trial.csv")
    assert all(f.read_bytes() == content for f, content in before.items())
    assert not (folder / "next.csv").exists()
    stored = when == "table"  # the entry was complete, but its table was not
    assert Journal(state).live()[-1]["trial"] == TRIALS + stored
    arguments = ("--measured", folder / "trial.csv") * (not stored)
    go_on(state, folder / "next.csv", *arguments)
    assert Journal(state).live()[-1]["trial"] == TRIALS + 1
    go_on(state, folder / "other.csv", "--undo", TRIALS)
    go_on(state, folder / "other.csv", "--measured", folder / "trial.csv")
    assert (folder / "next.csv").read_bytes() == (folder / "other.csv").read_bytes()


def test_two_calls_at_once_are_one_entry(copied, monkeypatch):
    rig, state, folder = copied
    campaign = Campaign.open(state, rig.scheme, rig.task, actuator=rig.axis.machine.actuator)
    turn = campaign.turn(read_measured(folder / "trial.csv", rig.task))

    def meanwhile():
        for other in (lambda: campaign.keep(turn), lambda: campaign.undo(3)):
            with pytest.raises(ValueError, match=r"in use by process .* was learned .* call again"):
                other()
        return {}

    with monkeypatch.context() as slow:
        slow.setattr(of_campaign, "environment", meanwhile)
        campaign.keep(turn)
        campaign.undo(TRIALS)
    assert [m["event"] for m in Journal(state).manifests()[TRIALS + 1 :]] == ["trial", "undo"]
    quicker = Journal(state)
    quicker.append({**quicker.manifests()[-2], "parent": TRIALS}, {})
    with pytest.raises(ValueError, match="trial 11 does not follow on trial 11"):
        campaign.keep(turn)
    stale = dataclasses.replace(quicker)
    object.__setattr__(stale, "_next", lambda: 13)
    for at_once in (Path.exists, lambda path: path.name != "000013" and os.path.exists(path)):
        monkeypatch.setattr(Path, "exists", at_once)
        with pytest.raises(ValueError, match=r"entry 13 could not be written .another process has"):
            stale.append({}, {})


def test_of_two_starts_at_once_one_is_refused(tmp_path, monkeypatch):
    """Both wrote an entry, and the campaign could never go on."""
    state, (_, scheme, task), make = tmp_path / "state", case("p_type"), Journal.create

    def slowly(of):
        make(of)
        monkeypatch.undo()
        Campaign.start(state, scheme, task)

    monkeypatch.setattr(Journal, "create", slowly)
    with pytest.raises(FileExistsError, match="or go on with the campaign there"):
        Campaign.start(state, scheme, task)
    assert [m["event"] for m in Journal(state).live()] == ["start"]


def test_a_dry_run_reports_and_changes_nothing(copied):
    rig, state, folder = copied
    before = sorted(folder.rglob("*"))
    code, out, _ = go_on(
        state, folder / "next.csv", "--measured", folder / "trial.csv", "--dry-run"
    )
    assert code == 0
    assert "trial 11: RMS error" in out
    assert "dry run: nothing was written" in out
    assert "play" not in out  # next.csv would be that of an earlier trial, or none
    assert out.splitlines()[-1] == "without --dry-run, the same call writes the input of trial 12"
    _, out, _ = call("next", "--state", folder / "new", "--scenario", rig.file, "--dry-run")
    assert out.splitlines()[-1] == (
        "with --out NEXT in place of --dry-run, the same call writes the input of trial 1"
    )
    assert sorted(folder.rglob("*")) == before


def test_a_trial_of_the_same_table_tells_how_repeatable_the_machine_is(copied):
    rig, state, folder = copied
    y21 = read_trace(folder / "trial.csv")
    go_on(state, folder / "next.csv", "--measured", folder / "trial.csv", "--no-learn")
    assert (folder / "next.csv").read_bytes() == (rig.folder / "next-11.csv").read_bytes()
    rig.measure(folder / "next.csv", 12, folder / "again.csv")
    difference = np.sqrt(np.mean((read_trace(folder / "again.csv") - y21) ** 2))
    again = ("--measured", folder / "again.csv", "--repeatability")
    with pytest.raises(ValueError, match=r"RMS difference of the outputs .* allowed is 1e-06 mm"):
        go_on(state, folder / "next.csv", *again, 1e-6)
    code, out, _ = go_on(state, folder / "next.csv", *again, 1e-3)
    assert code == 0
    assert f"RMS difference of the outputs {difference:.3g} mm" in out
    assert Journal(state).manifests()[-1]["recipe"]["rules"] == {"repeatability": 1e-3}, (
        "kept for the calls to come"
    )


def read_trace(path):
    return np.genfromtxt(path, delimiter=",", skip_header=1)[:, 2]


def test_growth_and_saturation_warn_or_refuse_with_numbers(copied):
    rig, state, folder = copied
    y, u = rig.measure(rig.folder / "next-11.csv", 11, folder / "trial.csv")
    t, r = rig.task.time, rig.task.reference[:, 0]
    write_trial(folder / "worse.csv", t, r, y + 0.01, u)
    measured = partial(go_on, state, folder / "next.csv", "--measured")
    grew = r"the RMS error grew from .* by .*%; the best was trial 10 with .* --undo 9 goes back"
    with pytest.raises(ValueError, match=grew):
        measured(folder / "worse.csv", "--set", "campaign.stop_on_growth=true")
    write_trial(folder / "far.csv", t, r, y + 0.04, u)
    with pytest.raises(ValueError, match=r"times the best; .*accept=growth accepts it.*--undo 9"):
        measured(folder / "far.csv")
    _, _, err = measured(folder / "worse.csv", "--dry-run")
    assert "warning: the RMS error grew" in err
    assert "another schedule played" in err, (
        "u is not what the feedback would have done about this y"
    )
    k = np.arange(len(u))
    write_trial(folder / "saturated.csv", t, r, y, np.where((k >= 40) & (k < 90), 10.0, u))
    limit = "at its limit 10 in 20.00% of the samples, first at sample 40; allowed are 5.00%"
    with pytest.raises(ValueError, match=f"input 0 is {limit}"):
        measured(folder / "saturated.csv")
    # Saturation is accepted, but the table that would follow is not.
    with pytest.raises(ValueError, match="the next feedforward is") as error:
        measured(folder / "saturated.csv", "--set", "campaign.accept_saturation=true")
    assert "at its limit" not in str(error.value)
    write_trial(folder / "saturated.csv", t, r, y, np.where(k == 40, 10.0, u))
    accepted = ("--set", "campaign.accept=input", "--dry-run")
    _, _, err = measured(folder / "saturated.csv", *accepted)
    assert "warning: input 0 is at its limit 10 in 0.40% of the samples, first at sample 40" in err
    assert Journal(state).live()[-1]["trial"] == TRIALS


def test_an_input_that_is_too_fast_is_told_wherever_it_is_written(copied):
    rig, _, folder = copied
    (folder / "slow.toml").write_text(AXIS.replace("limit = 10.0", "limit = 10.0\nrate = 1.0"))
    state, out = folder / "slow", folder / "next.csv"
    go_on(state, out, "--scenario", folder / "slow.toml", "--scheme", "ilc")
    trial = ("--measured", rig.folder / "trial-1.csv", "--set", "campaign.predict=false")
    for more in (trial, (), ("--undo", 0)):
        warned = "warning: the next feedforward changes by up to" in go_on(state, out, *more)[2]
        assert warned == ("--undo" not in more), "trial 1 plays 0"


def test_an_input_beyond_the_limit_is_refused_by_sample_and_value(copied):
    rig, state, folder = copied
    table = read_table(rig.folder / "next-11.csv")["feedforward [V]"]
    k = int(np.argmax(np.abs(table)))
    limit = round(0.9 * abs(table[k]), 3)
    rig.measure(rig.folder / "next-10.csv", 10, folder / "trial.csv")
    go_on(state, folder / "next.csv", "--undo", 9)
    more = ("--limit", limit, "--set", "campaign.accept_saturation=true")
    with pytest.raises(ValueError, match="the next feedforward") as error:
        go_on(state, folder / "next.csv", "--measured", folder / "trial.csv", *more)
    said = f"is {table[k]:.6g} V at sample {k}; allowed are +-{limit:g} V (campaign.limit)"
    assert said in str(error.value)
    assert Journal(state).live()[-1]["trial"] == 9


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda rows: rows[:100] + rows[101:],
         r"line 101: a gap of 1 samples before t = 0.1 s; allowed are steps of dt = 0.001 s"),
        (lambda rows: rows[:-3], r"has 248 samples; this task needs N \+ 1 = 251"),
        (lambda rows: rows[:1] + rows[1::2],
         r"is sampled at 0.002 s but the task at 0.001 s; nothing is resampled"),
        (lambda rows: [*rows[:9], rows[8], *rows[9:]],
         r"line 10: t = 0.007 s does not increase from 0.007 s"),
        (lambda rows: [rows[0].replace("y [mm]", "y"), *rows[1:]],
         r"y declares no unit; this task needs 'y \[mm\]' in the file, or --output 'y \[mm\]'"),
        (lambda rows: [rows[0].replace("y [mm]", "y [µm]"), *rows[1:]],
         r"y is in 'µm'; this task needs 'mm', and nothing is converted"),
        (lambda rows: [rows[0].replace("y [mm]", "x [mm]"), *rows[1:]],
         r"has no column 'y'; present are t, r, x, u"),
        (lambda rows: [rows[0].replace("u [V]", "i [A]"), *rows[1:]],
         r"has no input u; record it, name it by --input, or add --set campaign.replayed"),
        (lambda rows: [*rows[:50], cut(rows[50], 3), *rows[51:]],
         r"line 51: u is not a finite number"),
        (lambda rows: [*rows[:50], cut(rows[50], 2, "nan"), *rows[51:]],
         r"line 51: y is not a finite number"),
        (lambda rows: [*rows[:-1], cut(rows[-1], 2)], r"line 252: y is not a finite number"),
        (
            lambda rows: [
                rows[0], *(cut(a, 1, b.split(",")[1]) for a, b in pairwise([*rows[1:], rows[-1]])),
            ],
            "shifted by 1 sample",
        ),
    ],
)  # fmt: skip
def test_a_trace_that_is_not_of_this_task_is_refused(copied, change, message):
    _, state, folder = copied
    (folder / "trial.csv").write_text(
        "\n".join(change((folder / "trial.csv").read_text().splitlines()))
    )
    with pytest.raises(ValueError, match=message):
        go_on(state, folder / "next.csv", "--measured", folder / "trial.csv")
    assert Journal(state).live()[-1]["trial"] == TRIALS
    assert not (folder / "next.csv").exists()


def cut(row, i, value=""):
    """Return a row of text with one cell replaced."""
    cells = row.split(",")
    return ",".join([*cells[:i], value, *cells[i + 1 :]])


def test_a_full_disk_after_the_trial_is_stored_says_how_to_go_on(copied, monkeypatch):
    _, state, folder = copied

    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as broken:
        broken.setattr(controller_files, "write_file", full)
        with pytest.raises(OSError, match="the campaign is stored; a call without --measured"):
            go_on(state, folder / "next.csv", "--undo", 9)
    go_on(state, folder / "next.csv")
    assert Journal(state).live()[-1]["trial"] == 9


def test_mistakes_in_the_call_name_what_is_allowed(copied):
    rig, state, folder = copied
    trial, out = rig.folder / "trial-10.csv", folder / "next.csv"
    (made := folder / "made.csv").mkdir()
    here, new = ("next", "--state", state, "--out"), ("next", "--state", folder / "new", "--out")
    for arguments, message in (
        ((*here, out, "--measured", trial),
         "is trial 10, which was learned from already; measure trial 11, whose input a call "),
        ((*here, out, "--set", "ilc.feedback.kp=2"),
         "it differs in: scheme.feedback.kp: 1.0 there, 2.0 here"),
        ((*here[:3], "--measured", trial), "--out is missing"),
        ((*here, state / ".." / "a.csv", "--measured", folder / "a.csv"),
         "a.csv is the record of --measured; choose another file"),
        ((*here, folder / "next.txt"), "is none of the formats .csv, .mat, .h"),
        ((*here, folder / "no/next.csv"), "the folder does not exist"),
        ((*here, made), "made.csv is a folder; choose another name of the file"),
        ((*here, out, "--undo", 10),
         "allowed are 0 to 9, after which a call without --undo goes on"),
        ((*here, out, "--growth", -1), "growth = -1 is outside its allowed range [0, inf)"),
        ((*new, out, "--scenario", rig.file, "--scheme", "pid"),
         "scheme = 'pid' is not one of those that learn; known: ilc"),
        ((*new, out), "the first call needs --scenario"),
        (("next", "--state", rig.folder, "--scenario", rig.file, "--out", out),
         "exists already; choose another folder"),
        ((*new, out, "--scenario", "cao-2019"), "--scheme is missing; those that learn are cfdl"),
        ((*new, out, "--scenario", rig.file, "--measured", trial),
         "holds no campaign; start one without --measured"),
        (("trials", "--state", folder / "new"),
         "holds no campaign; `jaxilc next` without --measured starts one"),
    ):  # fmt: skip
        with pytest.raises((ValueError, FileExistsError, FileNotFoundError)) as error:
            call(*arguments)
        assert message in str(error.value)
    assert not out.exists()
    assert not (folder / "new").exists()


@pytest.mark.parametrize("begin", [Campaign.start, Campaign.open])
def test_scheme_and_task_are_what_they_are_called(tmp_path, begin):
    task = Task(np.zeros(9), dt=1e-3)
    for scheme, of, said in (
        (PIDType, task, "scheme = .* is a type; allowed is a Scheme"),
        (PIDType(), PIDType(), "task = .* is a PIDType; allowed is a Task"),
    ):
        with pytest.raises(ValueError, match=said):
            begin(tmp_path / "state", scheme, of)
    assert not (tmp_path / "state").exists()


def test_a_damaged_entry_is_named_and_can_be_left_behind(copied):
    rig, state, folder = copied
    damaged = state / "000010" / "memory.npz"
    damaged.write_bytes(damaged.read_bytes()[:100])
    back = "cannot be read .*--undo goes back to an earlier trial"
    with pytest.raises(ValueError, match=f"000010/memory.npz {back}"):
        go_on(state, folder / "next.csv")
    go_on(state, folder / "next.csv", "--undo", 9)
    assert (folder / "next.csv").read_bytes() == (rig.folder / "next-10.csv").read_bytes()
    manifest = json.loads((state / "000010" / "manifest.json").read_text())
    assert manifest["trial"] == 10
    shutil.rmtree(state / "000003")
    with pytest.raises(ValueError, match=f"000003/manifest.json {back}"):
        go_on(state, folder / "next.csv")
    assert re.search(f"warning: .*000003/manifest.json {back}", call("trials", "--state", state)[2])
    shutil.rmtree(state / "000011")  # the undo
    _, _, err = go_on(state, folder / "next.csv", "--undo", 2)
    assert "warning: entry 11 cannot be read, and may be an undo of trial 2, " in err


def _ladder():
    machine, scheme, task = case("p_type_over_pid")
    # With noise, two trials of the same table differ.
    noisy = dataclasses.replace(machine, sensor=Sensor(noise=1e-5))
    return noisy, Ladder(scheme, repeats=2), task


@pytest.mark.thorough(but=["milc"])
@pytest.mark.parametrize(
    "name", ["p_type_on_reference", "milc", "ffdl_sign", "asmc_over_ilc", "ladder"]
)
def test_what_a_scheme_learns_from_y_and_u_alone_is_what_it_learns_in_simulation(tmp_path, name):
    machine, scheme, task = (
        _ladder() if name == "ladder" else case("ilc_asmc" if name == "asmc_over_ilc" else name)
    )
    campaign = Campaign.start(tmp_path / "state", scheme, task)
    for j in range(1, 4):
        trial = run_trial(machine, scheme, task, campaign.memory(), jax.random.fold_in(KEY, j))
        turn = campaign.turn(
            Measured(np.asarray(trial.y), np.asarray(trial.u), {}, (), f"trial {j}"),
            replay_input=True,
        )
        assert not any("away" in f.text for f in turn.findings), (
            "the replayed input is the one that was applied"
        )
        campaign.keep(turn)
    expected = learn(machine, scheme, task, 3, key=KEY).memory
    for ours, theirs in zip(
        jax.tree.leaves(campaign.memory()), jax.tree.leaves(expected), strict=True
    ):
        np.testing.assert_allclose(ours, theirs, **ALGEBRA)


def test_a_law_may_sample_its_model_where_it_learns():
    """The sample time of a record is a number there, not one that is known only when it runs."""
    _, scheme, task = case("estimated_disturbance")
    memory, r = scheme.initial_memory(task), task.reference
    record = Trial(r, 0.9 * r, np.ones((task.N, task.inputs)), task.dt)
    known = jax.eval_shape(learned, scheme, task, memory, record)
    assert jax.tree.map(np.shape, known) == jax.tree.map(np.shape, memory)


def test_a_learned_reference_is_held_to_its_largest_correction(tmp_path):
    machine, scheme, task = case("p_type_on_reference")
    campaign = Campaign.start(tmp_path / "state", scheme, task, rules=Rules(correction=0.01))
    trial = run_trial(machine, scheme, task, campaign.memory(), KEY)
    measured = Measured(np.asarray(trial.y), None, {}, (), "trial 1")
    with pytest.raises(ValueError, match="trial 1 has no input u"):
        campaign.turn(measured)
    turn = campaign.turn(measured, replay_input=True)
    correction = 0.4 * np.asarray(trial.e)[2:, 0]  # this is gamma_p e[k+1+lead]
    k = int(np.argmax(np.abs(correction))) + 1  # w[k] is added to r[k+1]
    assert (
        f"the next reference is {correction[k - 1]:.6g} away from the task's at sample {k}"
        in turn.refusals[0]
    )
    with pytest.raises(ValueError, match="the next reference"):
        campaign.keep(turn)


def test_a_law_of_higher_order_may_learn_from_an_error_that_stays(tmp_path):
    """From u_1 = 0 and e = 1 it plays 0.1, then 0.7: seven times as much."""
    task, scheme = case("p_type")[2], HigherOrder((1.0, 0.0), (0.1, 0.5))
    campaign = Campaign.start(tmp_path / "state", scheme, task)
    for noise in (0.0, 1e-6, 2e-6):  # no two trials are the same
        y = np.asarray(task.reference) - 1.0 - noise
        turn = campaign.turn(Measured(y, None, {}, (), "a trial"), replay_input=True)
        assert not [text for text in turn.refusals if "would reach" in text]
        campaign.keep(turn)


def test_a_trial_that_ended_early_is_no_part_of_a_step_of_several(tmp_path):
    """Of a mean of two trials the rest was learned from with half of the error."""
    task = case("p_type")[2]
    campaign = Campaign.start(tmp_path / "state", Ladder(PIDType(gamma_p=0.5), 2), task)
    y = np.asarray(task.reference) * np.linspace(0.5, 1.0, task.N + 1)[:, None]
    short = Measured(y, None, {}, (), "trial 1", samples=task.N // 2)
    with pytest.raises(ValueError, match=r"trial 1 ended after .* learns from 2 trials at a time"):
        campaign.turn(short, replay_input=True)
    assert not campaign.turn(short, replay_input=True, learn=False).learned


@pytest.mark.parametrize(
    "law",
    [Ladder(PIDType(gamma_p=0.5), 2), ModelFreeGradient(step=0.5, amplitude=0.1, about="mean")],
)
def test_a_repeat_that_the_law_asks_for_may_be_the_same_in_all_counts(tmp_path, law):
    """At rest a coarse encoder shows each trial the same, which was refused for ever.

    The same file is no repeat, however its path is spelled; one that was written anew is.
    """
    task = case("p_type")[2]
    campaign = Campaign.start(tmp_path / "state", law, task, rules=Rules(accept=ACCEPTED))
    repeats, file = [], tmp_path / "trial.csv"
    for j in (1, 2, 3):
        file.write_bytes(b"the same counts")
        os.utime(file, (0, j))
        u = np.asarray(campaign.schedules()["u"])
        measured = Measured(np.vstack([np.zeros((1, 1)), u]).round(1), u, {}, (), str(file))
        turn = campaign.turn(measured)
        warned = [of.text for of in turn.findings if of.kind == "warning"]
        repeats += [j for text in warned if "has played again" in text]
        campaign.keep(turn)
        played_again = np.array_equal(campaign.schedules()["u"], u)
        if played_again:
            for same in (file, tmp_path / "state" / ".." / "trial.csv"):
                with pytest.raises(ValueError, match=f"trial.csv is trial {j}, which was learned"):
                    campaign.turn(measured._replace(source=str(same)))
            file.unlink()  # as of an entry of before, which knows its path only
            with pytest.raises(ValueError, match=f"trial.csv is trial {j}, which was learned"):
                campaign.turn(measured)
    assert len(repeats) == 1


@pytest.mark.thorough
def test_an_experiment_that_moves_little_is_no_dead_encoder(tmp_path):
    k, rng = np.arange(101), np.random.default_rng(0)
    task = Task(np.sin(2 * np.pi * k / 100) * np.sin(np.pi * k / 100) ** 2, dt=0.01)
    law = ModelFreeGradient(step=0.8, amplitude=0.1, about="mean")
    campaign = Campaign.start(tmp_path / "state", law, task)
    for _ in range(8):  # the last one is around the mean, with a reversed error of a tenth
        u = np.asarray(campaign.schedules()["u"])
        y = scipy.signal.lfilter([0, 0.185], [1, -0.819], np.append(u, 0.0)) + rng.normal(
            0, 2e-5, 101
        )
        turn = campaign.turn(Measured(y[:, None], u, {}, (), "a trial"))
        dead = campaign.turn(Measured(0 * y[:, None], u, {}, (), "a trial"))
        campaign.keep(turn)
    assert "y is constant up to 0, where a range of 0.0" in dead.refusals[0]


@pytest.fixture
def rests(tmp_path):
    """Return a campaign whose motion rests at both ends, and a function that measures a trial."""
    r = np.interp(np.arange(101), [20, 50], [0, 1])[:, None]
    task, rng = Task(r, dt=0.01), np.random.default_rng(0)
    campaign = Campaign.start(tmp_path / "state", PIDType(gamma_p=1.0), task)

    def measured(samples=None):
        """Play u on y[k+1] = 0.5 y[k] + 0.45 u[k], with noise; the rest is not measured."""
        u = np.array(campaign.schedules()["u"])
        y = scipy.signal.lfilter([0, 0.45], [1, -0.5], np.vstack([u, [[0]]]), axis=0)
        y += 1e-5 * rng.standard_normal(y.shape)
        if samples is not None:  # as `read_measured` tells of a trial that ended early
            y[samples + 1 :], u[samples:] = r[samples + 1 :], np.nan
        return Measured(y, u, {}, (), "a trial", samples)

    return campaign, measured


def warned(turn):
    return [text for kind, text in turn.findings if kind != "note"]


def test_an_output_whose_square_is_infinite_is_refused(rests):
    campaign, measured = rests
    trial = measured()
    with pytest.raises(ValueError, match=r"a trial: y is up to 1e\+160, whose rms is infinite"):
        campaign.turn(trial._replace(y=trial.y + 1e160))


@pytest.mark.thorough
@pytest.mark.parametrize("samples", [10, 40])  # at rest, and in the motion
@pytest.mark.parametrize("first", [1, 2, 3])
def test_a_trial_that_ended_early_is_no_alarm_and_the_next_one_is_none(rests, first, samples):
    campaign, measured = rests
    for j in range(1, first + 3):
        turn = campaign.turn(measured(samples if j == first else None))
        assert warned(turn) == []
        campaign.keep(turn)


@pytest.mark.parametrize("lead", [0, 4])
@pytest.mark.parametrize("cutoff", [None, 5.0])
def test_what_was_not_measured_is_played_as_it_was_or_the_note_says_how_else(rests, cutoff, lead):
    begun, measured = rests
    law = PIDType(gamma_p=0.3, gamma_i=0.05, gamma_d=0.1, leak=0.05, lead=lead)
    scheme = law if cutoff is None else Filtered(law, ZeroPhaseButterworth(cutoff))
    noise = Rules(accept=("frozen",))  # alone is measured
    campaign = Campaign.start(begun.journal.path.parent / "law", scheme, begun.task, rules=noise)
    for samples in (None, None, 60):
        before = campaign.schedules()["u"]
        rest = np.arange(100)[:, None] >= (samples or 100)
        measure = measured(samples)._replace(u=np.where(rest, np.nan, before))
        campaign.keep(turn := campaign.turn(measure))
    change = np.abs(turn.schedules["u"] - before)[:, 0]
    assert np.max(change[:60]) > 0.03
    assert np.max(change[90:] if cutoff else change[60 - lead :]) < (2e-3 if cutoff else 1e-12)
    told = f"u by up to {np.max(change[60:]):.3g} there"
    assert turn.findings[-1].text.endswith(told if cutoff else "but played as it was")
    assert (np.max(change[60:]) > 0.01) == (cutoff is not None)
    y = np.where(np.arange(101)[:, None] > 60, measure.y, np.round(measure.y, 9))
    for again in (measure, measure._replace(y=y)):
        with pytest.raises(ValueError, match="a trial is trial 3, which was learned from already"):
            campaign.turn(again)


def test_no_estimate_is_made_of_what_was_not_measured(rests):
    """The reference stood there for the output, and the next whole trial reset the estimates."""
    begun, measured = rests
    law = CFDLMFAILC(lam=0.1, rho=0.5, mu=0.01, phi0=0.2, eta=0.5)
    campaign = Campaign.start(begun.journal.path.parent / "law", law, begun.task)
    for samples in (30, None, None, None, 60, None):
        before, u = campaign.memory(), campaign.schedules()["u"]
        rest = np.arange(100)[:, None] >= (samples or 100)
        y = scipy.signal.lfilter([0, 0.45], [1, -0.5], np.vstack([u, [[0]]]), axis=0)
        y += measured().y  # which is noise, since `begun` plays nothing
        y[1:][rest] = begun.task.reference[1:][rest]
        campaign.keep(
            turn := campaign.turn(Measured(y, np.where(rest, np.nan, u), {}, (), "x", samples))
        )
        phi = np.asarray(campaign.memory().phi[0])
        if samples == 60:
            kept = (campaign.memory().u, campaign.memory().y[1:], phi)
            for new, old in zip(kept, (before.u, before.y[1:], before.phi[0]), strict=True):
                np.testing.assert_array_equal(new[60:], old[60:])
            assert turn.findings[-1].text.endswith("but played as it was")
        elif samples == 30:  # nothing is known of the rest, so it has no error
            np.testing.assert_array_equal(campaign.schedules()["u"][30:], 0.0)
    assert np.all(phi[60:90] != 0.2), "the estimates go on from there"


def test_points_are_learned_from_after_a_trial_that_ended_early(rests):
    begun, measured = rests
    law = AtSamples(PIDType(gamma_p=0.3, lead=5), ((0.3, 0.3),))
    campaign = Campaign.start(begun.journal.path.parent / "law", law, begun.task)
    trial = measured(60)
    change = campaign.turn(trial).schedules["u"][:, 0]
    assert np.flatnonzero(change).tolist() == [24]
    assert change[24] == pytest.approx(0.3 * (begun.task.reference - trial.y)[30, 0])


def test_what_was_not_measured_is_not_checked_and_what_was_measured_is(rests):
    campaign, measured = rests
    for _ in range(2):
        campaign.keep(campaign.turn(measured()))
    peak = float(np.max(campaign.schedules()["u"]))  # at the end, where the motion rests
    limited = dataclasses.replace(campaign, rules=Rules(limit=peak, saturation=0.0))
    part, whole = measured(40), measured()
    assert not [text for text in limited.turn(part, learn=False).refusals if "is at its" in text]
    assert "is at its limit" in limited.turn(whole, learn=False).refusals[0]
    dead = part.y * (np.arange(101) > 40)[:, None]
    (said,) = campaign.turn(part._replace(y=dead), learn=False).refusals
    assert "y is constant up to 0" in said
    lost = part.y + 0.3 * ((np.arange(101) > 30) & (np.arange(101) <= 40))[:, None]
    (said,) = campaign.turn(part._replace(y=lost), learn=False).refusals
    assert "at sample 31" in said
    campaign.keep(campaign.turn(part, learn=False))
    again = campaign.turn(measured(), learn=False)
    assert not [text for _, text in again.findings if "the same schedule" in text]
    campaign.keep(again)
    campaign.keep(campaign.turn(measured(40), learn=False))
    said = [text for _, text in campaign.turn(measured(), learn=False).findings]
    (said,) = [text for text in said if "the same schedule" in text]
    assert "RMS difference of the outputs 1.4" in said, "of the last whole trial: sqrt(2) 1e-5"


def test_every_table_is_looked_at_before_it_is_played():
    _, _, task = case("milc")
    r = np.asarray(task.reference)
    rows = {
        "reference": r[:, 1:] + 0.2,
        "table.u": np.full((task.N, 1), -0.5),
        "table.weights[0]": np.zeros((task.N, 1)),
    }
    assert beyond_limits(rows, task, None, Rules()) == []
    near = {"reference": r[:, 1:] + 0.05}  # the other output is farther away, and does not count
    assert beyond_limits(near, task, None, Rules(correction=0.1)) == []
    rows["table.weights[0]"][3] = np.nan
    found = beyond_limits(rows, task, None, Rules(limit=0.4, correction=0.1))
    assert [f.kind for f in found] == ["refusal"] * 3
    assert "0.2 away from the task's" in found[0].text
    assert "the next table.u is -0.5 at sample 0; allowed are +-0.4" in found[1].text
    assert found[2].text == "the next table.weights[0] is not finite at sample 3"
    (found,) = beyond_limits({"table.u": rows["table.u"]}, task, Actuator(limit=0.3), Rules())
    assert "allowed are +-0.3 (machine.actuator.limit of the plant; --set campaign" in found.text
    (found,) = too_fast({"table.u": rows["table.u"]}, task, Actuator(rate=0.4 / task.dt))
    assert f"the rate {0.4 / task.dt:g} of the actuator in {1 / task.N:.2%} of" in found.text
    assert too_fast({"table.u": rows["table.u"]}, task, Actuator(rate=0.5 / task.dt)) == []
    clips = Rules(limit=0.6)
    assert beyond_limits({"table.u": rows["table.u"]}, task, Actuator(limit=0.3), clips) == []
    (found,) = saturation(np.clip(rows["table.u"], -0.3, 0.3), Actuator(limit=0.3), clips)
    assert found.text.startswith("input 0 is at its limit 0.3 in 100.00% of the samples")
    of_parts = {"feedback.reference": np.hstack([r, r[:, :1] + 0.2]), "feedback.feedforward": r}
    found = beyond_limits(of_parts, task, None, Rules(limit=0.4, correction=0.1))
    assert "the next feedback.reference is 0.2 away from the task's" in found[0].text
    assert "the next feedback.feedforward" in found[1].text
    grown = larger(of_parts, 1, {"feedback.feedforward": 0.1}, {}, task, ())
    assert ["feedback.feedforward would reach" in one.text for one in grown] == [True]


@pytest.mark.thorough
def test_a_law_that_does_not_begin_with_zero_is_bound_from_there(tmp_path):
    """A constant error of -4 moves u by -2 a trial, from +-1 to -6 +- 1; then to -10.6."""
    law = WarmStart(PIDType(gamma_p=0.5), PolynomialBasis((0,)), theta=[1.0])
    r = np.sin(np.arange(31.0) / 5)[:, None]
    campaign = Campaign.start(tmp_path / "state", law, Task(r, dt=0.1))
    u = np.asarray(campaign.schedules()["u"])
    for _ in range(3):
        turn = campaign.turn(Measured(r + 4, np.asarray(campaign.schedules()["u"]), {}, (), "y"))
        assert turn.refusals == []
        campaign.keep(turn)
    now = np.asarray(campaign.schedules()["u"])
    np.testing.assert_allclose(now, u - 6)
    assert campaign.turn(Measured(r + 7, now, {}, (), "y")).refusals == []
    (said,) = campaign.turn(Measured(r + 9, now, {}, (), "y")).refusals
    assert "the next u would reach" in said


def test_the_steps_of_a_law_that_repeats_its_trials_bound_its_input(tmp_path):
    """An error that stays at 1 moves u by 0.5 in every third trial, to 1; then to 1.65 at most."""
    r, draw = np.sin(np.arange(31.0) / 5)[:, None], np.random.default_rng(0)
    law = Ladder(PIDType(gamma_p=0.5), repeats=3)
    campaign = Campaign.start(tmp_path / "state", law, Task(r, dt=0.1))
    for error, trials in ((1.0, 6), (2.0, 3)):
        for _ in range(trials):
            y = r - error + 1e-4 * draw.normal(size=r.shape)
            turn = campaign.turn(Measured(y, np.asarray(campaign.schedules()["u"]), {}, (), "y"))
            if not turn.refusals:
                campaign.keep(turn)
    np.testing.assert_allclose(campaign.schedules()["u"], 1.0, atol=1e-3)
    assert ["the next u would reach" in one for one in turn.refusals] == [True]


def test_a_table_that_was_not_the_one_to_play_is_refused(tmp_path):
    machine, scheme, task = case("p_type_on_reference")
    campaign = Campaign.start(tmp_path / "state", scheme, task)
    trial = run_trial(machine, scheme, task, campaign.memory(), KEY)
    other = np.asarray(task.reference) + 0.01
    turn = campaign.turn(
        Measured(np.asarray(trial.y), np.asarray(trial.u), {"reference": other}, (), "trial 1")
    )
    assert "reference is 0.01 away at sample" in turn.refusals[0]


def test_a_recorded_feedback_leaves_the_feedforward_to_play_or_is_refused(tmp_path):
    """With another sign it was learned from, and an older schedule was called friction."""
    machine, scheme, task = case("p_type_over_pid")
    campaign = Campaign.start(tmp_path / "state", scheme, task)

    def turn(sign=1.0, actuator=None, memory=None, digits=17, late=0):
        of = dataclasses.replace(machine, actuator=actuator, sensor=Sensor(noise=1e-5))
        key = jax.random.key(campaign.trials + (memory is not None))
        trial = run_trial(of, scheme, task, memory or campaign.memory(), key)
        y, u, fed = (np.asarray(x) for x in (trial.y, trial.u, trial.signals["feedback"]))
        fed = sign * (fed - late * np.diff(fed, axis=0, prepend=fed[:1]))
        record = Measured(y, u.round(digits), {"feedback": fed}, (), "a trial")
        return dataclasses.replace(campaign, actuator=actuator).turn(record), u

    (refused,) = turn(-1.0)[0].refusals
    assert refused.endswith("another sign, unit or file; --set campaign.accept=schedule accepts it")
    (first, u), late = turn(), turn(late=0.3)[0].findings
    assert ["with the recorded feedback" in str(of) for of in (first.findings, late)] == [0, 1]
    top, fastest = np.max(np.abs(u)), np.max(np.abs(np.diff(u, axis=0))) / task.dt
    slow = {"rate": 0.1 * fastest, "resolution": 0.02 * top}
    for limits in ({"limit": 0.2 * top, "rate": 1.0}, slow):
        held, _ = turn(actuator=Actuator(**limits), digits=round(2 - np.log10(top)))
        assert not [one for one in held.refusals if "to play" in one], limits
        assert "recorded feedback" not in str(held.findings)
    assert "to play" in str(turn(-1.0, Actuator(**slow))[0].refusals)
    campaign.keep(first)
    (refused,) = turn(memory=scheme.initial_memory(task))[0].refusals
    assert "it is that of trial 1" in refused
    assert turn()[0].refusals == []


def test_a_campaign_goes_on_from_an_error_that_was_zero(tmp_path):
    """An axis that is held at rest shows one count in its second trial."""
    task, scheme = Task(np.zeros(21), dt=0.01), PIDType(gamma_p=0.5)
    campaign = Campaign.start(tmp_path / "state", scheme, task)
    for count in (0.0, 1e-3):
        y = np.eye(21)[:, 9:10] * count
        measured = Measured(y, np.asarray(campaign.schedules()["u"]), {}, (), "a trial")
        turn = campaign.turn(measured, replay_input=True)
        assert ("error grew from 0 to 0.0002236; the" in str(turn.findings)) == (count > 0)
        campaign.keep(turn)
        (said,) = verdict(campaign.journal.live(), turn, None, "mm", 0.02)
        assert "of that of trial 1" not in said


def test_an_axis_that_has_learned_to_within_half_a_count_is_no_column_of_set_points(tmp_path):
    r = np.round(5 - 5 * np.cos(2 * np.pi * np.arange(41) / 40), 2)[:, None]
    campaign = Campaign.start(tmp_path / "state", PIDType(gamma_p=0.8), Task(r, dt=0.01))
    near = r + 0.01 * (np.arange(41) == 20)[:, None]  # a count of the encoder, once
    for y, refused in ((r, 1), (np.round(0.95 * r, 2), 0), (r, 0), (near, 0)):
        measured = Measured(y, np.asarray(campaign.schedules()["u"]), {}, (), "a trial")
        turn = campaign.turn(measured)
        assert ["y is the reference" in one for one in turn.refusals] == [True] * refused
        if not refused:
            campaign.keep(turn)


def test_learning_that_diverges_smoothly_is_refused_at_ten_times_the_best(tmp_path):
    """The band of the trials so far grows as they do; what was accepted is learned from again."""
    r = np.sin(2 * np.pi * np.arange(101) / 100)
    machine = Machine(StateSpace([[0.9]], [[0.1]], [[1.0]], dt=0.01))
    rng, errors, refused = np.random.default_rng(0), [], 0
    rules = Rules(accept=("jump", "input"))
    campaign = Campaign.start(tmp_path / "x", PIDType(gamma_p=8.0), Task(r, dt=0.01), rules=rules)
    for _ in range(30):
        u = np.asarray(campaign.schedules()["u"])
        y = scipy.signal.lfilter([0, 0.24], [1, -0.82], np.append(u, 0.0))
        measured = Measured((y + rng.normal(0, 1e-4, 101))[:, None], u, {}, (), "a trial")
        error = np.sqrt(np.mean((r - measured.y[:, 0])[1:] ** 2))
        turn = campaign.turn(measured, expected=campaign.expected(machine))
        if error > 10 * min(errors, default=np.inf):
            (said,) = turn.refusals
            assert "times the best; suspected is" in said
            refused += 1
            accepting = Rules(accept=("jump", "input", "growth"))
            turn = dataclasses.replace(campaign, rules=accepting).turn(measured)
            errors = []
        assert turn.refusals == []
        campaign.keep(turn)
        errors.append(error)
    assert refused > 1
