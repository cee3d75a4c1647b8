"""Files from outside are damaged or invalid: plant files, parameter files, CSV, .mat.

A file is refused with a ValueError, or read to finite numbers. fuzz.py says how to run more cases.
"""

import json
import tomllib

import jax
import numpy as np
import pytest
import scipy.io
from cases import DT
from fuzz import bytes_damaged, damaged, dumped, fuzz, pick

from jaxilc import learning
from jaxilc.hardware import read_measured
from jaxilc.identification import read_record
from jaxilc.scenarios import load
from jaxilc.scenarios.from_file import read_scenario
from jaxilc.scenarios.parameters import with_parameters
from jaxilc.signals import Task, references

TEXTS = (
    """
[plant]
kind = "transfer_function"
num = [4000.0]
den = [1.0, 80.0, 4000.0]
[machine]
actuator = { limit = 10.0, rate = 1e4 }
sensor = { resolution = 1e-4 }
disturbance = { input_noise = 1e-3 }
[task]
dt = 0.001
unit = "mm"
input_unit = "V"
reference = { function = "sinusoid", amplitude = 1.0, frequency = 10.0, duration = 0.05 }
settle = [0.01, 0.05]
[schemes]
pid = { class = "PID", kp = 0.5 }
ffdl.class = "StopWhen"
ffdl.rms = 0.1
ffdl.scheme = { class = "FFDLMFAILC", phi0 = [0.5, 0.0, -0.1, 0.0], lam = 0.5 }
[schemes.ilc]
class = "WithFeedback"
feedback = { class = "PID", kp = 0.4, ki = 1.0 }
learning.class = "Filtered"
learning.scheme = { class = "PIDType", gamma_p = 0.5, lead = 1 }
learning.filter = { class = "ZeroPhaseButterworth", cutoff = 90.0 }
[uncertainty."plant.B"]
distribution = "uniform"
low = 0.9
high = 1.1
relative = true
""",
    """
name = "two"
title = "Two axes"
trials = 3
tolerance = 0.1
shown_unit = "µm"
shown_scale = 1e3
show_trials = [1, 3]
[plant]
kind = "state_space"
A = [[0.9, 0.0], [0.0, 0.8]]
B = [[0.1, 0.0], [0.0, 0.2]]
C = [[1, 0], [0, 1]]
dt = 0.001
[task]
dt = 0.001
unit = "mm"
input_unit = "V"
[[task.reference]]
function = "sinusoid"
amplitude = 1.0
frequency = 10.0
duration = 0.05
[[task.reference]]
function = "multisine"
amplitudes = [1, 2]
frequencies = [20, 40]
duration = 0.05
[schemes]
ilc = { class = "PIDType", gamma_p = [0.5, 0.4] }
""",
    """
[plant]
kind = "zeros_poles_gain"
zeros = [-50.0]
poles = [[-20, 30], [-20, -30], -90]
gain = 3e4
[task]
dt = 0.001
unit = "mm"
input_unit = "V"
[task.reference]
function = "s_curve"
positions = [0, 1]
velocity = 90
acceleration = 9e3
jerk = 2e6
[schemes]
noilc = { class = "NormOptimal", model = "plant", w_q = 1.0, w_r = [[0.1]] }
""",
    """
[plant]
kind = "VoiceCoilMotor"
friction = { class = "StribeckFriction", coulomb_force = 1.0, static_force = 1.5 }
[task]
dt = 0.001
unit = "mm"
input_unit = "V"
reference = { csv = "r.csv", column = "r" }
inputs = 1
[schemes.on]
class = "OnOutputs"
outputs = [0]
scheme = { class = "CFDLMFAPC", P = 5 }
""",
)
FILES = tuple(map(tomllib.loads, TEXTS))


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Return a folder, and make trials short; their length is planned elsewhere."""
    whole = references.sample_times

    def of_moderate_length(function, duration, dt, *arrays):
        if np.all(np.asarray(duration, float) > 1e5 * np.asarray(dt, float)):
            raise ValueError(f"{function}: too long for this test")
        return whole(function, duration, dt, *arrays)

    monkeypatch.setattr(references, "sample_times", of_moderate_length)
    time = np.arange(51) * DT
    np.savetxt(
        tmp_path / "r.csv",
        np.column_stack([time, np.sin(60 * time), 0 * time]),
        delimiter=",",
        header="t,r,u",
        comments="",
    )
    return tmp_path


def test_plant_files(folder):
    def attempt(rng):
        path = folder / "plant.json"
        path.write_text(
            dumped(damaged(rng, pick(rng, FILES))), encoding="utf-8", errors="surrogatepass"
        )
        scenario = read_scenario(path)
        if rng.random() < 0.1:
            for scheme in scenario.schemes.values():
                jax.eval_shape(
                    lambda scheme=scheme: learning.learn(scenario.machine, scheme, scenario.task, 2)
                )

    for tree in FILES:
        (folder / "good.json").write_text(json.dumps(tree))
        read_scenario(folder / "good.json")
    # A damaged file may name another file that does not exist.
    assert fuzz(60, attempt, (ValueError, OSError)) > 1


@pytest.mark.parametrize("suffix", [".toml", ".json"])
def test_bytes_of_plant_files(folder, suffix):
    whole = (TEXTS[0] if suffix == ".toml" else json.dumps(FILES[1], indent=1)).encode()

    def attempt(rng):
        path = folder / f"plant{suffix}"
        path.write_bytes(bytes_damaged(rng, whole))
        read_scenario(path)

    fuzz(40, attempt)


def test_parameter_files(folder):
    scenario = load("cao-2019")
    whole = {
        "scenario": "cao-2019",
        "schemes": {
            "cfdl-mfailc": {"lam": 0.003, "lead": 3},
            "pid": {"form": "increment", "kp": -1.0},
        },
    }

    def attempt(rng):
        path = folder / "params.json"
        path.write_text(dumped(damaged(rng, whole)), encoding="utf-8", errors="surrogatepass")
        with_parameters(scenario, path)

    fuzz(60, attempt)


ONE = Task(np.sin(0.3 * np.arange(21)), dt=DT, unit="mm", input_unit="V")


def table(header):
    rows = np.column_stack(
        [ONE.time, ONE.reference[:, 0], ONE.reference[:, 0] * 0.9, np.cos(ONE.time)]
    )
    return "\n".join([header, *(",".join(map(repr, row)) for row in rows.tolist())]).encode()


def test_tables_of_text(folder):
    whole, record = table("t [s],r [mm],y [mm],u [V]"), table("t,r,y,u")

    def attempt(rng):
        path = folder / "trial.csv"
        if rng.random() < 0.5:
            path.write_bytes(bytes_damaged(rng, whole))
            found = read_measured(path, ONE)
            assert found.y.shape == (21, 1)
            assert np.all(np.isfinite(found.y))
        else:
            path.write_bytes(bytes_damaged(rng, record))
            assert np.all(np.isfinite(read_record(path).y))

    assert fuzz(150, attempt) > 1


@pytest.mark.parametrize("packed", [False, True], ids=["v6", "v7"])
def test_mat_files(folder, packed):
    path = folder / "trial.mat"
    signals = {
        "t": ONE.time[:, None],
        "r": ONE.reference,
        "y": 0.9 * ONE.reference,
        "u": np.cos(ONE.time)[:, None],
    }
    others = {
        "units": {"t": "s", "r": "mm", "y": "mm", "u": "V"},
        "note": "a text",
        "list": np.array([1, "a"], dtype=object),
        "c": 1j,
    }
    scipy.io.savemat(path, signals | others, do_compression=packed)
    whole = path.read_bytes()
    np.testing.assert_array_equal(read_measured(path, ONE).y, signals["y"])

    def attempt(rng):
        path.write_bytes(bytes_damaged(rng, whole))
        found = read_measured(path, ONE)
        assert found.y.shape == (21, 1)
        assert np.all(np.isfinite(found.y))
        if packed:  # the checksum of zlib finds every change
            np.testing.assert_array_equal(found.y, signals["y"])

    fuzz(200, attempt)
