"""In what an error repeats: `potential` on records whose errors are made one way or another."""

import dataclasses

import numpy as np
import pytest
from cases import follows, known_to, lag
from command import write_columns

from jaxilc import Task, learn
from jaxilc.filters import ZeroPhaseButterworth
from jaxilc.identification.pitch import Recurrence, recurrence_of
from jaxilc.identification.record_files import Repeats
from jaxilc.outcomes import design, potential, repeating
from jaxilc.outcomes.outcome import silent
from jaxilc.outcomes.repeating import following, recurs, within_trial
from jaxilc.plants import ByPosition, Harmonics, PositionMap, StateSpace
from jaxilc.scenarios.from_file import read_scenario
from jaxilc.schemes import PID, BasisFunctions, Filtered, PIDType, PolynomialBasis, WithFeedback
from jaxilc.signals.task import Trial
from jaxilc.theory.condition import HOLDS, NOT_CLAIMED

DT = 4e-3
t = DT * np.arange(751)
BACK_AND_FORTH = 60 * np.sin(np.pi * t / 2.1) ** 2 + 4 * t  # [mm], at many speeds
STEADY = 20 * t
BUMP = np.exp(-(((t - 0.7) / 0.1) ** 2)) - np.exp(-(((t - 2.3) / 0.25) ** 2))
BY_PLACE = np.sin(2 * np.pi * BACK_AND_FORTH / 7.3) + 0.4 * np.cos(4 * np.pi * BACK_AND_FORTH / 7.3)


AXIS = lag() + follows(1.0, 1.0, amplitude=20.0) + known_to(0.1, "plant.gain")


@pytest.mark.thorough(but=["position0-of_trial0-repeats in a period, so Rep-period0"])
@pytest.mark.parametrize(
    ("position", "of_trial", "said", "period"),
    [
        (
            BACK_AND_FORTH,
            np.sin(2 * np.pi * t / 0.23),
            "repeats in a period, so Rep",
            ("time", 0.23),
        ),
        (BACK_AND_FORTH, BY_PLACE, "in the position, so a map of Pos", ("position", 7.3)),
        (BACK_AND_FORTH, BUMP, "repeats from trial to trial only", None),
        (BACK_AND_FORTH, 3 * t, "repeats from trial to trial only", None),
        (STEADY, np.sin(2 * np.pi * STEADY / 5), "at one speed the two are one", ("time", 0.25)),
        # few periods of many harmonics
        (BACK_AND_FORTH, np.exp(-((t % 0.91 / 0.06 - 3) ** 2)), "in a period, so", ("time", 0.91)),
    ],
)
def test_what_the_error_repeats_in_is_told_with_the_law(tmp_path, position, of_trial, said, period):
    rng, files = np.random.default_rng(0), []
    for j in range(4):
        e = of_trial + 0.1 * rng.normal(size=len(t))
        np.savez(file := tmp_path / f"trial-{j}.npz", t=t, e=e, r=position)
        files.append(file)
    found = potential(files, unit="mm")
    line = found.lines[-1]
    assert said in line
    if period:
        name, size = period
        assert found.numbers["within"][name]["period"] == pytest.approx(size, rel=0.02)


@pytest.mark.thorough
def test_the_pitch_is_told_in_the_unit_of_the_position(tmp_path):
    """A pitch of 16 mm, of y in m, was told as 16 µm and written where the error was in mm."""
    rng, files = np.random.default_rng(2), []
    y = 1e-3 * BACK_AND_FORTH
    for j in range(3):
        e = 0.05 * np.sin(2 * np.pi * y / 0.016) + 1e-3 * rng.standard_normal(len(t))
        write_columns(path := tmp_path / f"{j}.csv", "t [s],e [mm],y [m]", t, e, y)
        files.append(path)
    found = potential(files)
    assert "a period of 16 mm in the position foretells" in found.lines[-1]
    np.savez(tmp_path / "all.npz", e=[e, 1.001 * e], y=[y, y])  # whose one unit is given
    found = potential(tmp_path / "all.npz", dt=DT, unit="m")
    assert "a period of 16 mm in the position foretells" in found.lines[-1]
    (axis := tmp_path / "axis.toml").write_text(AXIS)
    with pytest.raises(ValueError, match="record has the unit of its position 'm', the task has"):
        design(axis, record=files)


@pytest.mark.thorough
@pytest.mark.parametrize("count", [60, 90, 150, 200])
def test_a_smooth_error_of_few_samples_has_no_period_of_two(count):
    x = np.linspace(0, 1, count)
    for e in (
        np.sin(np.pi * x),
        np.sin(1.4 * np.pi * x + 0.3),
        np.exp(-3 * x),
        np.sin(2 * np.pi * x),
    ):
        found = recurrence_of(x, e)
        assert not found.repeats
        assert found.period > 6 * x[1]
    found = recurrence_of(x, np.sin(2 * np.pi * 7.3 * x))
    assert found.repeats
    assert found.period == pytest.approx(1 / 7.3, rel=0.01)


def test_one_trial_tells_less_than_two():
    rng = np.random.default_rng(1)
    for e, said in (
        (np.sin(2 * np.pi * t / 0.23), "a resonance that rings; a second one does"),
        (rng.normal(size=len(t)), "one trial does not tell whether it repeats"),
    ):
        one = Repeats(e[None], DT, "mm", ("a",), BACK_AND_FORTH)
        assert said in recurs(within_trial(one), one)[0]
    e = np.random.default_rng(41).normal(size=(3, 1501))  # some is taken as repeating, by chance
    position = 60 * np.sin(np.pi * np.arange(1501) / 1050) ** 2 + 8e-3 * np.arange(1501)
    assert within_trial(Repeats(e, 2e-3, "mm", ("a", "b", "c"), position)) == {}


@pytest.fixture
def axis(tmp_path, monkeypatch):
    monkeypatch.setattr(repeating, "MACHINES", 3)
    (path := tmp_path / "axis.toml").write_text(AXIS)
    return read_scenario(path)


P_TYPE = WithFeedback(Filtered(PIDType(gamma_p=0.3, lead=4), ZeroPhaseButterworth(40.0)), PID(0.2))


@pytest.mark.thorough
def test_a_law_between_trials_learns_from_period_to_period(axis):
    """With the same taps, and the worst machine of the family judged."""
    found = following(axis, {"time": Recurrence(0.2, 0.9)}, [P_TYPE], silent)
    scheme = found.schemes["repetitive"]
    assert "converges from period to period of 0.2 s on all 3 machines" in found.lines[0]
    laws, task = (P_TYPE.learning, scheme.learning.law), axis.task
    e = np.random.default_rng(0).normal(size=(1001, 1))
    trial = Trial(e, 0 * e, 0 * e[1:], 1e-3)
    wanted, got = (law.schedule(law.learn(law.initial_memory(task), trial), task).u for law in laws)
    inner = slice(300, 700)
    np.testing.assert_allclose(got[inner], wanted[inner], atol=1e-5 * np.max(np.abs(wanted)))
    shape = np.sin(2 * np.pi * np.arange(2001) / 200)
    whole = learn(axis.machine, scheme, Task(shape, dt=1e-3), 1).final.e[:, 0]
    assert np.std(whole[-200:]) < 0.05 * np.std(whole[:200])


def test_a_period_that_is_too_short_or_a_law_without_taps_is_told(axis, monkeypatch):
    """The first law that has its condition, which other tests compute, is taken."""
    short = following(axis, {"time": Recurrence(0.01, 0.9)}, [P_TYPE], silent)
    assert not short.schemes
    assert "repetitive is not written: RepetitiveControl: period" in short.lines[0]
    model = StateSpace([[0.82]], [[0.28]], [[1.0]], dt=1e-3)
    no_taps = WithFeedback(BasisFunctions(PolynomialBasis((0, 1)), model), PID(0.2))
    period = {"time": Recurrence(0.2, 0.9)}
    alone = following(axis, period, [no_taps], silent)
    assert "repetitive is not written: the law is none of taps" in alone.lines[0]
    answers = iter([{"verdict": NOT_CLAIMED, "condition": 2.0}, {"verdict": HOLDS}])
    monkeypatch.setattr(repeating, "of_periods", lambda *_: {"repetitive": next(answers)})
    monkeypatch.setattr(repeating, "period_sentences", lambda name, _: [name])
    found = following(axis, period, [no_taps, P_TYPE, P_TYPE], silent)
    assert (list(found.schemes), found.lines) == (["repetitive"], ["repetitive"])
    assert found.numbers == {"repetitive": {"verdict": HOLDS}}
    assert following(axis, {"time": Recurrence(0.2, 0.3)}, [P_TYPE], silent).lines == []


def test_an_error_by_place_gets_a_map(axis):
    found = following(axis, {"position": Recurrence(7.0, 0.9)}, [P_TYPE], silent)
    assert "by-position, a map with a pitch of 7 mm" in found.lines[0]
    cogging = PositionMap(Harmonics(7.0, (1,)), (0.5, 0.3))
    machine = dataclasses.replace(axis.machine, plant=ByPosition(axis.machine.plant, cogging))
    rms = learn(machine, found.schemes["by-position"], axis.task, 5).rms[:, 0]
    assert rms[-1] < 0.05 * rms[0]
