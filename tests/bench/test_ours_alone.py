"""Schemes are timed alone: which of them, by which weights, and in which size."""

import json

import pytest
import typer
from typer.testing import CliRunner

from jaxilc import scenarios
from jaxilc.bench import ours_alone, timing
from jaxilc.bench.ours_alone import GRADIENT, tunable
from jaxilc.cli import bench as command
from jaxilc.plants import StateSpace
from jaxilc.schemes import CFDLMFAILC, PID, NormOptimal, PIDType, WithFeedback

PLANT = StateSpace([[0.9]], [[0.1]], [[1.0]], dt=1e-3)
FILE = """
trials = 3
[plant]
kind = "state_space"
A = [[0.9]]
B = [[0.1]]
C = [[1.0]]
dt = 0.001
[task]
dt = 0.001
reference = { function = "sinusoid", amplitude = 1.0, frequency = 50.0, duration = 0.02 }
[schemes.ilc]
class = "PIDType"
gamma_p = 5.0
[schemes.pid]
class = "PID"
kp = 1.0
[uncertainty."plant.B"]
distribution = "uniform"
low = 0.9
high = 1.1
relative = true
"""


def test_a_gradient_is_by_numbers_and_vectors_inside_their_ranges():
    both = WithFeedback(learning=PIDType(gamma_p=5.0), feedback=PID(kp=1.0))
    learned = {"learning.gamma_p", "learning.gamma_i", "learning.gamma_d"}  # leak is 0, an end
    assert set(tunable(both)) == learned | {"feedback.kp", "feedback.ki", "feedback.kd"}
    assert set(tunable(CFDLMFAILC())) == {"lam", "eta", "mu", "phi0", "epsilon"}  # rho is 1
    optimal = NormOptimal(PLANT, w_q=1.0, w_r=1e-4, w_s=1e-3)
    assert set(tunable(optimal)) == {"w_q", "w_r", "w_s"}  # the matrices are the model's


def test_the_command_times_the_schemes_of_a_file_that_learn(tmp_path):
    file, found = tmp_path / "axis.toml", tmp_path / "bench.json"
    file.write_text(FILE)
    app = typer.Typer()
    command.register(app)
    arguments = ["--scenario", str(file), "--plants", "5", "--repeats", "2", "--json", str(found)]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    assert "axis: 5 machines, 3 trials of 20 samples" in result.output
    numbers = json.loads(found.read_text())
    assert numbers["scenarios"] == {"axis": {"trials": 3, "samples": 20}}
    assert list(numbers["rows"]) == ["axis/ilc/5"]  # pid does not learn
    rows = numbers["rows"]["axis/ilc/5"]
    assert list(rows) == [timing.OURS, GRADIENT]
    for row in rows.values():
        assert (row["plants"], row["trials"], row["steps"]) == (5, 3, 5 * 3 * 20)
        assert len(row["seconds"]) == 2
        assert row["difference"] is None
    weights = ["gamma_p", "gamma_i", "gamma_d"]
    assert 0 < numbers["operations_ns"]["axis/ilc/5"] < min(r["ns_best"] for r in rows.values())
    assert numbers["gradients"]["axis/ilc/5"] == {"weights": weights, "dropped": 0}


def test_what_cannot_be_timed_is_refused():
    with pytest.raises(ValueError, match="dai-2014 has no scheme that learns"):
        ours_alone.schemes_of(scenarios.load("dai-2014"))
    with pytest.raises(ValueError, match="machines = 1000000000000 take"):
        ours_alone.of_scenario(scenarios.load("cao-2019"), "ffdl-mfailc", 10**12)
    with pytest.raises(ValueError, match="scheme = 'pid' is not one of noilc, ilc-asmc"):
        ours_alone.alone("pid", 1)
