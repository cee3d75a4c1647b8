"""The band that the trials of a campaign give of the next one."""

from types import SimpleNamespace

import campaigns_with_faults as faults
import numpy as np
import pytest
import scipy.signal
from cases import ALGEBRA

from jaxilc.cli.hardware import _unexpected
from jaxilc.hardware import Journal, calibration
from jaxilc.hardware.calibration import expected
from jaxilc.signals import Task

R = np.sin(np.linspace(0, 6, 61))[:, None]
TASK = Task(reference=R, dt=0.01)


def trials(seed, count=10, rate=0.4, gain=0.9, rest=3e-3, varies=0.3):
    """Outputs of a machine and of its model, whose gain is 1, with what is never learned."""
    rng = np.random.default_rng(seed)
    u, never = np.zeros_like(R), rest * rng.standard_normal(R.shape)
    y, s = [], []
    for of in np.broadcast_to(gain, count):
        y.append(of * u + never + rest * varies * rng.standard_normal(R.shape))
        s.append(u)
        u = u + rate * (R - y[-1])
    return np.array(y), np.array([*s, u])


def places(y, s, first=2):
    found = [expected(y[:j], s[: j + 1], TASK, j + 1) for j in range(first, len(y))]
    errors = [(np.sqrt(np.mean((R - x)[1:] ** 2)), np.max(np.abs(R - x)[1:])) for x in y[first:]]
    return [band.place(*error) for band, error in zip(found, errors, strict=True)]


@pytest.mark.thorough
def test_both_errors_of_nine_of_ten_trials_lie_within_and_the_bands_are_narrow():
    """A pole with 10 % less gain in white noise, where the largest error meets it first."""
    found = []
    for seed in range(20):
        rng, u, y, s = np.random.default_rng(seed), np.zeros_like(R), [], [np.zeros_like(R)]
        for _ in range(10):
            y.append(0.9 * pole(u) + 1e-2 * rng.standard_normal(R.shape))
            u[:-1] += 0.7 * (R - y[-1])[1:]
            s.append(pole(u))
        found += places(np.array(y), np.array(s))
    assert 0.85 <= np.mean([place.level == "within" for place in found]) <= 0.95
    assert np.median([place.rms[1] / place.rms[0] for place in found]) < 2.0


def pole(u):
    """y[k+1] = 0.9 y[k] + 0.1 u[k]"""
    return scipy.signal.lfilter([0, 0.1], [1, -0.9], u, axis=0)


def test_one_of_twenty_errors_lies_outside_its_own_band_as_one_of_ten_trials_does():
    """The band of one error held nine of ten, so that both errors did so of fewer trials."""
    left, q = np.array([[1.0, 0.6, 0.3], [0.5, 0.8, 1.5]])
    _, low, _, high, _ = calibration._Level(1.0).ends(np.array([left, q]))
    rng, n, z = np.random.default_rng(0), 200_000, np.linspace(-2, 2, 7)
    weight = np.exp(-(z**2) / 2) / np.sum(np.exp(-(z**2) / 2))
    a, b = 0.35 * np.exp(0.7 * rng.choice(z, n, p=weight)), 0.1 * np.exp(rng.choice(z, n, p=weight))
    w, f = rng.integers(0, 3, n), rng.choice(np.geomspace(1e-4, 0.3, 14), n)
    power = left[w] ** 2 + f**2
    v = f**2 / power
    spread = np.sqrt(0.015**2 + (b * q[w]) ** 2 * (1 - v) + a**2 * v)
    error = np.sqrt(power) * np.exp(spread * rng.standard_normal(n))
    assert abs(np.mean((error < low) | (error > high)) - 0.05) < 0.003


def test_a_lasting_change_is_told_once():
    y, s = trials(1, count=6)
    late = np.roll(y[-1], 6, axis=0)
    y = np.concatenate([y, [late, late + 1e-4, late - 1e-4]])
    s = np.concatenate([s, [s[-1]] * 3])
    told = [place.level == "clear" for place in places(y, s, first=5)]
    assert told == [False, True, False, False]


def test_a_trial_without_any_error_has_a_band():
    """As of a file whose output is its reference."""
    y, s = trials(1, count=4)
    for errorless in (np.arange(4) >= 0, np.arange(4) == 0, np.arange(4) == 3):
        found = expected(np.where(errorless[:, None, None], R, y), s, TASK, 5)
        assert not np.any(np.isnan([found.rms, found.largest]))


@pytest.mark.thorough
def test_after_a_change_of_the_gain_the_bands_begin_anew():
    """It is told once, where every later trial was told to be another machine before."""
    told, within = [], []
    for seed in range(5):
        changed = trials(seed, rate=0.7, gain=[1.0] * 5 + [0.7] * 5, rest=1e-4, varies=0.1)
        found = places(*changed, first=5)
        told.append([place.level == "clear" for place in found])
        within += [place.level == "within" for place in found[1:]]
    assert np.array_equal(told, [[True, False, False, False, False]] * 5)
    assert np.mean(within) >= 0.8


def test_there_is_no_band_before_the_third_trial_or_where_the_model_diverges():
    y, s = trials(2)
    assert expected(y[:1], s[:2], TASK, 2) is None
    assert expected(y, np.full_like(s, np.inf), TASK, 11) is None


def test_a_manifest_keeps_what_was_expected():
    y, s = trials(3)
    found = expected(y, s, TASK, 11)
    again = calibration.kept({"expected": found.as_json()})
    np.testing.assert_allclose(again.rms, found.rms, **ALGEBRA)
    assert again.place(0.1, 0.2) == found.place(0.1, 0.2)
    wrong = ({}, {"expected": 3}, {"expected": found.as_json() | {"far": [[1]]}})
    assert [calibration.kept(manifest) for manifest in wrong] == [None] * 3


@pytest.mark.parametrize("kind", ["note", "refusal"])
def test_a_trial_that_is_refused_begins_no_band(kind):
    known = SimpleNamespace(what_changed=lambda *_: SimpleNamespace(text="", then=""))
    turn = SimpleNamespace(trial=6, findings=[(kind, "")], record=None, expected=None)
    place = SimpleNamespace(error="RMS error", distance=-1.0, level="clear")
    said = _unexpected(known, turn, place, "identify").text
    assert ("the next band begins here" in said) == (kind == "note")


@pytest.mark.thorough
def test_next_takes_the_band_of_its_own_trials_from_the_third_on(tmp_path):
    state, schedule = tmp_path / "x", tmp_path / "next.csv"
    assert faults.begun(tmp_path, faults.PLANT, state, schedule)[0] == 0
    r, told = faults.stroke(), []
    for j, rig in enumerate([faults.IN_ORDER] * 5 + [faults.Rig(coulomb=20.0)] * 2, start=1):
        u = faults.read_schedule(schedule)
        faults.write_trial(tmp_path / "trial.csv", r, rig.play(u, j), u)
        call = ("next", "--state", state, "--measured", tmp_path / "trial.csv", "--out", schedule)
        told.append(" ".join(faults.call(*call, "--set", "campaign.accept=growth")[1].split()))
    assert "95 % of 256 drawn machines" in told[1]
    assert all("90 % by the trials so far" in said for said in told[2:])
    said = "It is told once: the next band begins here. Look at guides, grease and cover"
    assert [said in text for text in told] == [False] * 5 + [True, False]
    assert "suspected is friction (or play) that grew" in told[5]
    live = Journal(state).live()
    kept = [calibration.kept(manifest) for manifest in live[1:]]
    assert [found and found.step for found in kept] == [None, None, 3, 4, 5, 6, 7]
