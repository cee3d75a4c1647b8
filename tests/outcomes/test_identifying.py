"""`identify`: a second record judges the plant; mass and friction are told of a force."""

import re
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.signal
from command import write_columns

from jaxilc import Machine, outcomes
from jaxilc.design import feedback_among
from jaxilc.identification import Identified, Record
from jaxilc.outcomes import identifying
from jaxilc.outcomes.identifying import _fitted
from jaxilc.plants import ModalModel, StateSpace
from jaxilc.scenarios.from_file import read_scenario

DT, N = 0.01, 300
STRUCTURE = {"poles": 1, "pairs": 0, "zeros": 0}


def write(path, seed, gain=2.0, dt=DT, noise=1e-3):
    """Write a record of a lag, by SciPy."""
    rng, t = np.random.default_rng(seed), np.arange(N + 1) * dt
    u = np.repeat(rng.choice([-1.0, 1.0], N // 10 + 1), 10)[: N + 1]
    kept = np.exp(-5.0 * dt)
    y = scipy.signal.lfilter([0, gain * (1 - kept)], [1, -kept], u)
    y += noise * rng.standard_normal(N + 1)
    write_columns(path, "t,u,y [mm]", t, u, y)
    return path


def test_a_second_record_judges(tmp_path):
    first, other = write(tmp_path / "a.csv", 0), write(tmp_path / "b.csv", 1)
    another = write(tmp_path / "c.csv", 2, gain=1.8)
    told = {}
    for file in (other, another):
        found = outcomes.identify(first, reading={"structure": STRUCTURE}, validate=file)
        told[file] = found.numbers["validate"], " ".join(found.verdict.said)
    (same, said), (differs, doubted) = told[other], told[another]
    assert same["rms"][0] == pytest.approx(1e-3, rel=0.15)
    assert same["fit"][0] > 99.8
    assert "which was not fitted, it fits 99.88 %" in said
    assert "times the residual" not in said
    assert differs["fit"][0] < 95
    assert "times the residual of the fit: the machine is not the same there" in doubted
    assert found.figures["second"].draw() is not None
    with pytest.raises(ValueError, match="--input and --output are both 'u'"):
        outcomes.identify(first, reading={"output": "u"})
    slow = write(tmp_path / "d.csv", 3, dt=0.02)
    with pytest.raises(ValueError, match=r"--dt 0.01 resamples both"):
        outcomes.identify(first, reading={"structure": STRUCTURE}, validate=slow)
    slow.write_text(other.read_text().replace("[mm]", "[µm]"))
    with pytest.raises(ValueError, match=r"d.csv: y is in 'µm', in the record .* fitted in 'mm'"):
        outcomes.identify(first, reading={"structure": STRUCTURE}, validate=slow)


def test_no_loop_is_told_of_a_record_at_another_rate_than_its_own(tmp_path):
    """A pair of 60 Hz in an open loop, by SciPy, at 1 kHz; times of 4 decimals at 3 kHz."""
    for rate, digits, other in ((1000, 9, 8e-4), (3000, 4, 3e-4)):
        rng, pair = np.random.default_rng(1), [1.0, 0.2 * 377, 377.0**2]
        b, a, _ = scipy.signal.cont2discrete(([377.0**2], pair), 1 / rate)
        u = np.repeat(rng.choice([-1.0, 1.0], 100), 10)
        y = scipy.signal.lfilter(np.ravel(b), a, u) + 5e-3 * rng.standard_normal(1000)
        file = tmp_path / f"{rate}.csv"
        write_columns(file, "t [s],u,y", np.round(np.arange(1000) / rate, digits), u, y)
        asked = {"structure": {"poles": 0, "pairs": 1, "zeros": 0}}
        if digits == 4:
            with pytest.raises(ValueError, match=r"dt = 0.00033333. s; .* or --dt 0.00033333"):
                outcomes.identify(file, reading=asked)
        for step in (other, float(f"{1 / rate:.6g}"))[: 1 + (digits == 4)]:
            said = " ".join(outcomes.identify(file, reading=asked | {"dt": step}).verdict.said)
            assert "A loop was closed" not in said
            assert (f"own sample time is {1 / rate:.5g}" in said) == (step == other)


@pytest.mark.thorough
def test_a_campaign_whose_plant_is_a_transfer_function_is_fitted_in_its_structure():
    """SciPy's plant of a gain 5 % lower; no pole and zero that cancel are added to its pair."""
    A, B, C, _ = scipy.signal.tf2ss([4000.0], [1.0, 80.0, 4000.0])
    b, a, _ = scipy.signal.cont2discrete(([3800.0], [1.0, 80.0, 4000.0]), 2e-3)
    rng = np.random.default_rng(0)
    u = np.repeat(rng.choice([-1.0, 1.0], 51), 10)[:501]
    y = scipy.signal.lfilter(np.ravel(b), a, u) + 1e-4 * rng.standard_normal(501)
    known = SimpleNamespace(machine=Machine(StateSpace(A, B, C)), uncertainty={})
    again = _fitted(Record(u[:-1], y, 2e-3), known, dict.fromkeys(STRUCTURE), None)
    fitted = again.found.parameters
    assert {*fitted} == {"gain", "frequencies[0]", "dampings[0]", "bias"}
    assert fitted["gain"].low < 0.95 < fitted["gain"].high
    assert fitted["gain"].high - fitted["gain"].low < 1e-3
    assert again.after < 0.1 * again.before


@pytest.mark.thorough
def test_a_campaign_of_a_sum_of_modes_is_fitted_in_its_structure():
    """Two modes with a pair of complex zeros, by SciPy, whose gains are 10 % lower than known."""
    (w, v), z = (37.0, 80.0), 0.02
    one, two = [1, 2 * z * w, w * w], [1, 2 * z * v, v * v]
    top = np.polyadd(0.27 * w * w * np.array(two), 0.18 * v * v * np.array(one))
    b, a, _ = scipy.signal.cont2discrete((top, np.polymul(one, two)), DT)
    assert np.all(np.abs(np.roots(top).imag) > 1)
    rng = np.random.default_rng(0)
    u = np.repeat(rng.choice([-1.0, 1.0], 51), 10)[:501]
    y = scipy.signal.lfilter(np.ravel(b), a, u) + 1e-4 * rng.standard_normal(501)
    known = ModalModel([], [], [w, v], [z, z], [0.3, 0.2], [0.0, 0.0])
    campaign = SimpleNamespace(machine=Machine(known), uncertainty={})
    again = _fitted(Record(u[:-1], y, DT), campaign, dict.fromkeys(STRUCTURE), None)
    for name, value in (("mode_gains[0]", 0.27), ("mode_gains[1]", 0.18)):
        assert again.found.parameters[name].value == pytest.approx(value, rel=1e-3)
    assert {*again.kept} >= {"mode_rates[0]", "mode_rates[1]"}, "0 without an interval"
    assert again.after < 0.1 * again.before


@pytest.mark.thorough
@pytest.mark.parametrize("rests_at", [0.0, 100.0])
def test_a_machine_that_rests_at_its_first_input_is_fitted_from_there(rests_at, tmp_path):
    """A plant here rests at an input of 0, so that a position of 100 mm looks like a start."""
    rng, kept = np.random.default_rng(4), np.exp(-5.0 * DT)
    moved = np.repeat([0.0, *rng.choice([-1.0, 1.0], N // 10)], 10)[: N + 1]
    y = scipy.signal.lfilter([0, 1 - kept], [1, -kept], moved) + rests_at
    y += 1e-3 * rng.standard_normal(len(y))
    write_columns(tmp_path / "a.csv", "t,u,y", DT * np.arange(len(y)), moved + rests_at, y)
    found = outcomes.identify(tmp_path / "a.csv", reading={"structure": STRUCTURE})
    said = [line for line in found.verdict.said if "does not begin at rest" in line]
    assert len(said) == (rests_at > 0)
    assert found.numbers["white"]
    assert found.numbers["gain"]["low"] < 1.0 < found.numbers["gain"]["high"]


def test_mass_and_friction_of_a_record_of_force_are_told(here):
    t = np.arange(2000) * 1e-3
    x = 0.05 * np.sin(6.0 * t) + 0.02 * np.sin(15.0 * t)
    v, a = np.gradient(x, 1e-3), np.gradient(np.gradient(x, 1e-3), 1e-3)
    force = 20.0 * a + 30.0 * v + 5.0 * np.tanh(v / 1e-3) - 1.0
    write_columns("r.csv", "t [s],u [N],y [m]", t, force, x)
    found = outcomes.identify("r.csv", reading={"structure": STRUCTURE})
    for name, value in {"mass": 20.0, "viscous": 30.0, "coulomb": 5.0, "offset": -1.0}.items():
        assert found.numbers["friction"][name] == pytest.approx(value, rel=0.1)
    (said,) = [line for line in found.verdict.lines if "mass with friction" in line]
    assert said.endswith("hold if nothing else acts; a second motion tells how far they differ.")
    titles = [str(table.title) for table in found.tables if "95 %" in str(table.title)]
    assert titles == [
        "r.csv: identified, with 95 % intervals; zeros, poles, frequencies in rad/s",
        "mass and friction: identified, with 95 % intervals",
    ]


@pytest.mark.thorough
def test_set_points_of_a_closed_drive_are_no_force_on_a_mass_with_friction(tmp_path):
    """Of steps up and down the speed has the sign, to 94 %, although nothing rubs."""
    rng, w = np.random.default_rng(7), 2 * np.pi * 25
    b, a, _ = scipy.signal.cont2discrete(([w**2], [1, 1.4 * w, w**2]), 1e-3)
    u = np.repeat(rng.choice([-0.5, 0.5], 60), 20)
    y = scipy.signal.lfilter(b.ravel(), a, u) + 5e-4 * rng.standard_normal(len(u))
    write_columns(tmp_path / "r.csv", "t [s],u [mm],y [mm]", 1e-3 * np.arange(len(u)), u, y)
    found = outcomes.identify(
        tmp_path / "r.csv", reading={"structure": {"poles": 0, "pairs": 1, "zeros": 0}}
    )
    assert found.numbers["white"]
    assert "friction" not in found.numbers
    assert not any("mass with friction" in line for line in found.verdict.lines)


def test_a_plant_that_integrates_is_told_to_get_a_feedback_first(tmp_path, monkeypatch):
    """`jaxilc design` was the next command, which refused the file at once."""
    path = tmp_path / "axis.toml"
    monkeypatch.setattr(identifying, "write_plant_file", lambda *_, **__: None)
    empty = {"poles": [], "pole_gains": [], "frequencies": [], "dampings": [], "mode_gains": []}
    for parts, rests in (
        ({"double_integrator": 50.0}, False),
        ({"poles": [1e-7], "pole_gains": [2.0]}, False),  # exp(-1e-10) a sample: as good as 1
        ({"poles": [3.0], "pole_gains": [2.0]}, True),
    ):
        plant = ModalModel(**(empty | parts))
        found = Identified(plant, *[None] * (len(Identified._fields) - 1))
        fitted = identifying.Fitted(None, found, 1e-3, {}, [])
        said, has_law = identifying._plant_file(path, fitted, "r.csv")
        what, _ = identifying._next(path, identifying.Reading(), fitted, path, has_law)
        assert ("a feedback comes first" in said) == ("feedback" in what) == (not rests)
        if rests:
            continue
        told = re.search(r"(\[schemes.loop\]) with (class .*), (feedback .*) and (learn.*);", said)
        scheme = "\n".join(told.groups()).replace("KP", "20.0").replace("KD", "0.5")
        gains = "\n".join(f"{name} = {value}" for name, value in (empty | parts).items())
        shape = "function = 'sinusoid', amplitude = 1.0, frequency = 2.0, duration = 1.0"
        task = f"[task]\ndt = 1e-3\nreference = {{ {shape} }}"
        path.write_text(f'[plant]\nkind = "ModalModel"\n{gains}\n{task}\n{scheme}')
        feedback = feedback_among(read_scenario(path).schemes)
        assert (float(feedback.kp), float(feedback.kd)) == (20.0, 0.5)


@pytest.mark.thorough
def test_the_plant_file_of_the_next_command_is_not_there_yet(here, tmp_path):
    """--out replaces no plant file, so that a second record ended in an error."""
    path = write(tmp_path / "a.csv", 0)
    for name in ("axis", "axis-2", "axis-3"):
        found = outcomes.identify(path, reading={"structure": STRUCTURE})
        assert found.verdict.following.endswith(f" --out {name}.toml")
        (tmp_path / f"{name}.toml").touch()
