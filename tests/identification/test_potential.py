"""What learning can gain: unbiased numbers, intervals that hold, and what is told apart."""

import json
import os
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
from command import call, write_columns
from scipy.io import savemat
from scipy.signal import lfilter

import jaxilc
from jaxilc.design import Design
from jaxilc.identification import potential_of, read_repeats
from jaxilc.scenarios import load_scenario

DT, N = 1e-3, 2000


def repeats(rng, trials, pole=0.9, size=1.0):
    """Return errors that repeat up to 20 Hz, with noise of an AR(1) process on top."""
    t = np.arange(N) * DT
    m = 30 * np.sin(2 * np.pi * 3 * t) + 3 * np.sin(2 * np.pi * 20 * t)
    white = size * np.sqrt(1 - pole**2) * rng.standard_normal((trials, N + 500))
    return m + lfilter([1.0], [1.0, -pole], white, axis=1)[:, 500:]


def test_what_is_new_is_unbiased_and_its_interval_holds():
    rng, squares, parts, inside, within = np.random.default_rng(1), [], [], 0, 0
    repeated = 30**2 / 2 + 3**2 / 2
    for _ in range(200):
        found = potential_of(repeats(rng, 3), DT)
        squares.append(found.new.value**2)
        parts.append(found.repeatable.value**2)
        inside += found.new.low < 1 < found.new.high
        within += found.repeatable.low**2 < repeated < found.repeatable.high**2
    for values, true in ((squares, 1.0), (parts, repeated)):
        assert abs(np.mean(values) - true) < 6 * np.std(values) / np.sqrt(200)
    assert 0.88 <= inside / 200 <= 0.99
    assert 0.90 <= within / 200 <= 0.99


@pytest.mark.thorough
def test_the_interval_of_what_repeats_knows_that_the_noise_is_strong_where_it_is():
    rng, t, inside = np.random.default_rng(8), np.arange(1000) * DT, 0
    pulse = np.exp(-(((t - 0.3) / 0.07) ** 2)) - np.exp(-(((t - 0.7) / 0.07) ** 2))
    size = 0.1 + np.abs(pulse)
    for _ in range(200):
        noise = lfilter([1.0], [1.0, -0.5], rng.standard_normal((4, 1000)), axis=1)
        found = potential_of(9 * pulse + size * noise, DT)
        inside += found.repeatable.low**2 < np.mean((9 * pulse) ** 2) < found.repeatable.high**2
    assert 0.88 <= inside / 200 <= 0.99


@pytest.mark.parametrize("drift", [0.0, 20.0])
def test_the_error_that_learning_begins_from_is_that_of_a_trial(tmp_path, drift):
    rng, t = np.random.default_rng(9), np.arange(N) * DT
    e = np.sqrt(2) * np.sin(4 * np.pi * t) + 2 * rng.standard_normal((4, N))
    e += drift * np.arange(4)[:, None] * np.sin(np.pi * t)
    np.savez(tmp_path / "e.npz", e=e, t=t)
    said = jaxilc.potential(tmp_path / "e.npz", unit="mm")
    start, left = np.sqrt(np.mean(e**2)), said.numbers["left"]
    numbers = [float(of) for of in re.findall(r"\d+\.\d+", said.verdict.lines[0])[:3]]
    np.testing.assert_allclose(numbers, [start, left, start / left], rtol=6e-3)
    assert numbers[2] > 1


def test_the_cutoff_lies_above_what_repeats_and_nothing_is_gained_from_noise():
    rng = np.random.default_rng(2)
    found = potential_of(repeats(rng, 5), DT)
    assert 20 <= found.cutoff.value < 30
    assert found.left == pytest.approx(1, rel=0.1)
    noise = potential_of(repeats(rng, 5) - repeats(np.random.default_rng(), 1, size=0.0), DT)
    assert noise.repeatable.value < 0.3 * noise.new.value
    assert noise.left < 1.1 * noise.new.value


def test_a_first_trial_that_began_elsewhere_is_no_noise():
    rng = np.random.default_rng(3)
    e = repeats(rng, 5)
    e[0] += 40 * np.exp(-np.arange(N) / 200)
    three, five = potential_of(e[:3], DT), potential_of(e, DT)
    assert five.new.low < 1 < five.new.high
    assert five.alike == 4
    about = np.sqrt(np.mean((e - e.mean(axis=0)) ** 2))
    assert five.spread(5) == pytest.approx(about, rel=0.02)
    assert three.spread(5) == pytest.approx(about, rel=0.1)
    assert potential_of(e[1:], DT).start == 0


def test_trials_that_settle_are_said_to():
    """The start swings out: what it leaves in the second trial is not new in each trial."""
    rng = np.random.default_rng(5)
    left = 8 * rng.standard_normal(N) * (-0.35) ** np.arange(4)[:, None]
    found = potential_of(repeats(rng, 4, pole=0.5) + left, DT)
    assert found.alike == 3
    assert found.settling == pytest.approx(np.hypot(8 * (0.35 + 0.0398), np.sqrt(1.5)), rel=0.1)
    for pole in (0.5, 0.98):
        assert not any(potential_of(repeats(rng, 4, pole), DT).settling for _ in range(50))


@pytest.mark.skipif(
    "JAXILC_MEASURED" not in os.environ, reason="JAXILC_MEASURED names no folder of records"
)
@pytest.mark.parametrize("motion", range(1, 8))
def test_three_measured_trials_predict_the_fourth(motion):
    with np.load(Path(os.environ["JAXILC_MEASURED"]) / "arizona_x_trials.npz") as file:
        e = file[f"exp{motion}_e"]
    found = potential_of(e[:3], DT)
    about = np.sqrt(np.mean((e - e.mean(axis=0)) ** 2))
    assert found.spread(4) == pytest.approx(about, rel=0.1)
    fourth = np.sqrt(np.mean((e[3] - e[1:3].mean(axis=0)) ** 2) / 1.5)
    assert 0.5 < fourth / found.new.value < 2


def test_a_drift_is_told_apart():
    rng = np.random.default_rng(4)
    shape = np.sin(2 * np.pi * np.arange(N) * DT)
    e = repeats(rng, 6) + 3 * np.arange(6)[:, None] * shape
    found = potential_of(e, DT)
    assert found.drift == pytest.approx(3 / np.sqrt(2), rel=0.1)
    assert found.new.low < 1 < found.new.high
    assert found.averages == 1
    assert potential_of(repeats(rng, 6), DT).drift == 0
    with pytest.raises(ValueError, match=r"dt = 0 is outside its allowed range \(0, inf\)"):
        potential_of(e, 0)


def test_files_of_every_kind_hold_the_same_trials(tmp_path):
    e, t = repeats(np.random.default_rng(5), 3), np.arange(N) * DT
    np.savez(tmp_path / "a.npz", e=e, t=t)
    savemat(tmp_path / "b.mat", {"y": -e.T, "r": np.zeros((N, 1)), "t": t})
    write_columns(tmp_path / "c.csv", "t [s],e_1 [mm],e_2 [mm],e_3 [mm]", t, *e)
    for j in range(3):
        write_columns(tmp_path / f"{j}.csv", "t,e", t, e[j])
    several = [tmp_path / f"{j}.csv" for j in range(3)]
    for files in ([tmp_path / "a.npz"], [tmp_path / "b.mat"], [tmp_path / "c.csv"], several):
        read = read_repeats(files)
        np.testing.assert_allclose(read.e, e, rtol=1e-12)
        assert read.dt == DT
    assert read_repeats([tmp_path / "c.csv"]).unit == "mm"


@pytest.mark.parametrize("kind", ["npz", "mat", "csv"])
def test_times_are_those_of_the_file_in_its_unit(tmp_path, kind):
    """Milliseconds of .npz and .mat were seconds, and any --dt went before the times of a file."""
    e, k, path = repeats(np.random.default_rng(5), 2), np.arange(N), tmp_path / f"a.{kind}"

    def read(name, times, dt=None):
        if kind == "csv":
            write_columns(path, f"{name},e_0,e_1", times, *e)
        elif kind == "mat":
            savemat(path, {name: times, "e": e})
        else:
            np.savez(path, **{name: times, "e": e})
        return read_repeats([path], dt=dt).dt

    with pytest.raises(ValueError, match=r"t steps by 1 and has no unit; .* as `t \[ms\]`"):
        read("t", 1.0 * k)
    assert read("t_ms", 1.0 * k) == pytest.approx(1e-3)
    for name, unit in (("t_ms", 1.0), ("t", 1e-3)):
        with pytest.raises(ValueError, match=f"{name} step by 0.001 s, and --dt .* is 0.01 s"):
            read(name, unit * k, 0.01)
        assert read(name, unit * k, 1.001e-3) == 1.001e-3
    assert read("other", 1.0 * k, 0.01) == 0.01


def test_errors_of_several_units_are_refused(tmp_path):
    heads = {"a": "t [s],y [um],r [mm]", "b": "t [s],y [mm],r", "c": "t [s],e [µm]"}
    for name, head in heads.items():
        write_columns(tmp_path / f"{name}.csv", head, *[np.arange(N) * DT] * len(head.split(",")))
    assert read_repeats([tmp_path / "b.csv"]).unit == "mm"
    write_columns(tmp_path / "d.csv", "t [s],y [deg],r [°]", *[np.arange(N) * DT] * 3)
    assert read_repeats([tmp_path / "d.csv"]).unit == "°"
    for files, said in (("a", "a.csv: the errors are in um, mm; "), ("bc", "c.csv: .* in mm, µm;")):
        with pytest.raises(ValueError, match=said):
            read_repeats([tmp_path / f"{name}.csv" for name in files])


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"e": np.zeros((3, N)), "t": np.arange(N) * DT}, "copies of one trial"),
        ({"e": np.ones((1, N)), "t": np.arange(N) * DT}, "without learning in between"),
        ({"x": np.ones((2, N)), "t": np.arange(N) * DT}, "--error"),
        ({"e": np.ones((2, N))}, "--dt"),
        ({"e": np.full((2, N), np.nan), "t": np.arange(N) * DT}, "finite"),
        ({"y": np.ones((2, N)), "r": np.ones((2, 9)), "t": np.arange(N) * DT}, "one reference"),
        ({"e": np.ones((2, N)), "t": np.arange(N) ** 2 * 1e-6}, "uniform"),
    ],
)
def test_what_are_no_repeats_is_refused_in_one_line(tmp_path, given, said):
    np.savez(tmp_path / "e.npz", **given)
    with pytest.raises(ValueError, match=said):
        jaxilc.potential(tmp_path / "e.npz")


def printed(*words):
    """Return what a command prints."""
    code, out, err = call(*words)
    assert code == 0, err
    return " ".join(out.split())


PLANT = """
[plant]
kind = "transfer_function"
num = [4000.0]
den = [1.0, 80.0, 4000.0]
[task]
dt = 0.001
unit = "mm"
reference = { function = "sinusoid", amplitude = 1.0, frequency = 1.0, duration = 1.0 }
"""


@pytest.mark.thorough
def test_the_command_tells_it_and_the_plant_file_carries_it_to_design(
    tmp_path, monkeypatch, unpainted
):
    monkeypatch.chdir(tmp_path)
    e = repeats(np.random.default_rng(6), 4)
    np.savez("e.npz", other=e, t=np.arange(N) * DT)
    (tmp_path / "axis.toml").write_text(PLANT)
    said = printed("potential", "e.npz", "--error", "other", "--unit", "mm", "--report", "p.json")
    found = json.loads((tmp_path / "p.json").read_text())
    expected = potential_of(e, DT)
    assert found["new"]["value"] == pytest.approx(expected.new.value)
    assert "Learning can bring the error from" in said
    assert found["next"] == "jaxilc potential e.npz --error other --unit mm --into axis.toml"
    again = shlex.split(found["next"])[1:]
    for _ in range(2):  # the second time in place of the first
        assert "jaxilc design axis.toml" in printed(*again)
    known = load_scenario("axis.toml").potential
    assert known.cutoff == pytest.approx(expected.cutoff.value)
    assert known.floor == pytest.approx(expected.new.value)
    (tmp_path / "bad.toml").write_text(
        PLANT + "[potential]\nfloor = 1.0\nstop = -1.0\ncutoff = 2.0\n"
    )
    with pytest.raises(ValueError, match=r"stop = -1 is outside"):
        load_scenario("bad.toml")


def test_no_cutoff_is_looked_for_above_the_bandwidth(tmp_path):
    (tmp_path / "axis.toml").write_text(PLANT)
    asked = load_scenario(tmp_path / "axis.toml")
    about = {"trials": 4, "uncertainty": {}, "machines": 4, "laws": ("p-type",)}
    found = {}
    for highest in (np.inf, 5.0):
        question = Design(asked.machine, asked.task, **about, highest=highest)
        ((one,), _) = question.safe(question.family(), ("p-type",), lambda *_: None)
        found[highest] = float(one.scheme.filter.cutoff), one.bounds["filter.cutoff"][1]
    assert found[np.inf][0] > 5
    assert max(found[5.0]) <= 5
