"""What a campaign should measure: the band by trial, its alarms, and the file that holds it."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from cases import ALGEBRA
from fuzz import flipped, fuzz
from gain_case import GAINS, STATIC, TASK

from jaxilc.cli.hardware import coming, new_plant_file, next_command, verdict
from jaxilc.figures.experiments import Bands, bands_by_trial, campaign_figure
from jaxilc.hardware import checks
from jaxilc.hardware import prediction as predictions
from jaxilc.hardware.calibration import Expected
from jaxilc.hardware.prediction import Band, Subject, distance, place_of, prediction_of
from jaxilc.learning import Variation
from jaxilc.schemes import ModelFreeGradient, PIDType
from jaxilc.signals import Task
from jaxilc.storage.sealed import sealed
from jaxilc.uncertainty import draw

TRIALS, GAMMA = 6, 0.4
SUBJECT = Subject(STATIC, PIDType(gamma_p=GAMMA), TASK, GAINS)


@pytest.fixture(scope="module")
def predicted():
    return predictions.predict(SUBJECT, TRIALS)


def test_the_band_is_that_of_machines_that_each_learn_by_themselves(predicted):
    # On a gain g the error is (1 - gamma g)^(j-1) r.
    gains = draw(STATIC, GAINS, predictions.MACHINES + 1, seed=predictions.SEED)["plant.B"][1:]
    left = np.abs(1 - GAMMA * gains)[:, None] ** np.arange(TRIALS)
    r = np.asarray(TASK.reference)[1:]
    errors, largest = predictions.simulated(SUBJECT, TRIALS)
    np.testing.assert_allclose(errors, left * np.sqrt(np.mean(r**2)), **ALGEBRA)
    np.testing.assert_allclose(largest, left * np.max(np.abs(r)), **ALGEBRA)
    # Six of 256 lie below the lower end, or on it, and as many above; the first errors are equal.
    inside = (errors > predicted.rms.low) & (errors < predicted.rms.high)
    assert list(np.sum(~inside, axis=0)) == [0] + [12] * (TRIALS - 1)
    np.testing.assert_allclose(predicted.rms.high[0] / predicted.rms.median[0], 1.01)


def test_what_is_drawn_for_each_trial_gives_a_band():
    """Of one machine it was predicted without, as of a file that draws nothing."""
    alone = SUBJECT._replace(uncertainty={})
    assert alone.machines == 1
    for of, machines in (
        (Variation(scatter=0.1), predictions.MACHINES),
        (Variation(late=1), predictions.MACHINES),
        (Variation(scatter=0.0, shortest=1.0, dropped=0.0), 1),
    ):
        varied = dataclasses.replace(STATIC, variation=of)
        assert alone._replace(machine=varied).machines == machines


def noisy_machines(rng, count, trials=20):
    """Return errors of machines that differ by a factor, by a rate and by noise."""
    rate = rng.uniform(0.5, 0.8, (count, 1))
    return rng.lognormal(0, 0.1, (count, 1)) * rate ** np.arange(trials) * rng.lognormal(
        0, 0.05, (count, trials)
    ) + rng.uniform(1e-3, 2e-3, (count, trials))


def test_how_often_an_alarm_is_false_and_that_a_true_one_is_raised():
    rng = np.random.default_rng(4)
    outside, alarms, campaigns, drawn = 0, 0, 0, 256
    for _ in range(100):  # plant files, each with 200 machines that are as it says
        errors, largest = noisy_machines(rng, drawn), noisy_machines(rng, drawn)
        prediction = prediction_of(errors, largest, SUBJECT)
        e, m = noisy_machines(rng, 200), noisy_machines(rng, 200)
        far = np.abs([distance(prediction.rms, e), distance(prediction.largest, m)])
        outside += int(np.sum(far > 1))
        alarms += int(np.sum(np.max(far, axis=(0, 2)) > prediction.course))
        campaigns += len(e)
        other = [place_of(prediction, j + 1, 3 * e[0, j], 3 * m[0, j]) for j in range(20)]
        assert any(place.level == "clear" for place in other)
    # Each end of a band is an order statistic of 256 machines, whose share beyond it varies with a
    # standard deviation of 0.009, and that of an alarm with 0.0055; here are six of them for 100.
    assert outside / (2 * 20 * campaigns) == pytest.approx(12 / 257, abs=0.01)
    assert alarms / campaigns == pytest.approx(2 / 257, abs=0.005)


def test_a_place_names_the_error_that_lies_further_out(predicted):
    low, median, high = (float(end[3]) for end in predicted.rms)
    largest = float(predicted.largest.median[3])
    assert place_of(predicted, 4, median, largest).level == "within"
    beyond = high * (high / median) ** (0.5 * (predicted.course - 1))
    place = place_of(predicted, 4, beyond, largest)
    assert (place.level, place.error, place.distance > 1) == ("slight", "RMS error", True)
    place = place_of(predicted, 4, median, 3 * largest)
    assert (place.level, place.error) == ("clear", "largest error")
    place = place_of(predicted, 4, low / 3, largest)
    assert (place.level, place.distance < -1) == ("clear", True)
    assert place_of(predicted, TRIALS + 1, median, largest) is None
    assert place_of(predicted, 4, np.nan, largest).level == "clear"


def test_machines_that_diverge_are_beyond_every_end():
    errors = np.tile(np.linspace(1.0, 2.0, 256)[:, None], (1, 3))
    errors[:20, 2], errors[20:25, 1] = np.nan, np.inf
    prediction = prediction_of(errors, errors, SUBJECT)
    assert np.isfinite(prediction.rms.high[0])
    assert np.isinf(prediction.rms.high[2])
    assert place_of(prediction, 3, 1e6, 1.5).level == "within"
    assert place_of(prediction, 3, 1e-6, 1.5).level != "within"
    assert not np.any(np.isnan(distance(prediction.rms, errors)))


def journal_of(*learned, errors=(), parts=()):
    """Return manifests of trials that were learned from or not, some of which ended early."""
    live = [{"trial": 0, "serial": 0}]
    for j, x in enumerate(learned, 1):
        note = [["note", "the trial ended after 3 of 9 samples"]] if j in parts else []
        live.append({"trial": j, "serial": j, "learned": x, "findings": note, "peaks": {"u": j}})
    for manifest, error in zip(live[1:], errors, strict=False):
        manifest["figures"] = {"error": error}
    return live


def test_a_trial_that_was_only_looked_at_repeats_its_step(predicted):
    live = journal_of(True, False, False, True)
    assert (predictions.steps(live), predictions.next_step(live)) == ([1, 2, 2, 2], 3)
    assert (predictions.steps(live[:1]), predictions.next_step(live[:1])) == ([], 1)
    bands = bands_by_trial(live, predicted)
    assert list(bands.trial) == [1, 2, 3, 4, 5, 6, 7, 8]  # steps 3 to 6 are ahead
    np.testing.assert_array_equal(bands.high, predicted.rms.high[[0, 1, 1, 1, 2, 3, 4, 5]])


def test_what_a_part_of_a_trial_teaches_is_not_predicted(predicted):
    live = journal_of(True, True, False, True, parts=(2,))
    assert (predictions.steps(live), predictions.next_step(live)) == ([1, 2, 0, 0], 0)
    assert predictions.next_step(journal_of(True, False, parts=(2,))) == 2
    assert coming(live, (predicted, None), 5, "mm") == ""
    assert list(bands_by_trial(live, predicted).trial) == [1, 2]
    own = Expected(
        0, *(Band(*np.full((3, 1), x)) for x in (1.0, 2.0)), np.ones((2, 2)), np.zeros(0)
    )
    bands = bands_by_trial(live, predicted, own)
    assert (list(bands.trial), bands.high[-1]) == ([1, 2, 5], 1.0)
    assert list(bands.own) == [False, False, True]


def test_the_band_of_the_file_and_that_of_the_trials_are_told_apart():
    """Each trial has a block; between two blocks of one band there is that of the other."""
    own = np.array([False, False, True, False])
    bands = Bands(np.arange(1.0, 5), np.full(4, 2.0), np.full(4, 3.0), np.full(4, 4.0), own)
    file, trials, median = campaign_figure.described([], bands=bands).panels[0].layers
    assert file.name == "95 % of drawn machines"
    assert trials.name == "90 % by the trials so far"
    np.testing.assert_array_equal(file.x, [0.5, 1.5, 1.5, 2.5, 2.5, 3.5, 3.5, 4.5])
    np.testing.assert_array_equal(file.low, [2, 2, 2, 2, np.nan, np.nan, 2, 2])
    np.testing.assert_array_equal(trials.high, [np.nan] * 4 + [4, 4] + [np.nan] * 2)
    np.testing.assert_array_equal(median.y, [3.0] * 4)


def test_the_error_of_a_part_is_not_that_of_a_trial():
    live = journal_of(True, True, True, errors=(2.0, 1e-5, 1.0), parts=(2,))
    law, task = PIDType(gamma_p=1.0), Task(np.linspace(0, 1, 5), dt=0.1)
    assert checks.comparable(law, task, live) == [(1, 2.0), (3, 1.0)]
    assert verdict(live, None, None, "mm", 0.02, stop=1e-3) == [
        "verdict: trial 3 has an RMS error of 1 mm, 50.00% of that of trial 1"
    ]
    (said,) = verdict(live[:3], None, None, "mm", 0.02, stop=1e-3)
    assert "trial 2 ended early" in said
    assert said.endswith("trial 1 had an RMS error of 2 mm")
    first = journal_of(True, errors=(1e-5,), parts=(1,))
    assert "no whole trial is measured yet" in verdict(first, None, None, "mm", 0.02, stop=1e-3)[0]
    # of each trial u is as large as its number; what a part has taught bounds nothing
    assert checks.learned_so_far(live) == (2, {"u": 3}, {"u": 1})
    parts = journal_of(True, True, parts=(1, 2))
    assert checks.learned_so_far(parts, {"u": 3}) == (0, {"u": 3}, {"u": 3})


def test_the_file_is_computed_once_and_again_where_it_is_damaged(tmp_path, predicted, monkeypatch):
    asked = []

    def computed(subject, trials):
        asked.append(trials)
        return predicted

    monkeypatch.setattr(predictions, "predict", computed)

    def ask(folder, needed=3, subject=SUBJECT):
        asked.clear()
        known = {"expected": TRIALS, "configuration": "c"}
        found = predictions.of_campaign(folder, subject, needed, **known)
        np.testing.assert_array_equal(found.rms.high, predicted.rms.high)
        assert found.course == predicted.course
        return list(asked)

    whole = tmp_path / "whole"
    whole.mkdir()
    file = whole / predictions.FILE
    assert ask(whole) == [TRIALS]
    assert ask(whole) == []
    assert predictions.kept(whole, "c") is not None
    monkeypatch.setattr(Subject, "machines", 1)  # as if the file drew nothing
    assert ask(whole) == [TRIALS]
    monkeypatch.undo()
    monkeypatch.setattr(predictions, "predict", computed)
    assert predictions.kept(whole, "another configuration") is None
    content = file.read_bytes()
    for part in (b"", content[:100], b"{}", b"[]", b"\xff"):
        file.write_bytes(part)
        assert ask(whole) == [TRIALS]
    made = json.loads(content)
    for change in (
        {"rms": 3}, {"largest": {"low": [1], "median": [1], "high": ["x"]}}, {"machines": 1e300},
        {"course": None}, {"format": 0},
    ):  # fmt: skip
        broken = {name: of for name, of in (made | change).items() if name != "sha256"}
        file.write_text(json.dumps(sealed(broken)))
        assert ask(whole) == [TRIALS]
    fuzz(20, lambda rng: ask(flipped(rng, whole, tmp_path / "flipped")), ())
    assert ask(whole, needed=TRIALS + 1) == [2 * TRIALS]
    assert ask(whole, subject=SUBJECT._replace(uncertainty={})) == [TRIALS]
    assert ask(Path("/proc/none")) == [TRIALS]  # where it cannot be written, it is not kept


def test_the_names_of_the_next_files_follow_those_of_this_call():
    for measured, out, found in (
        ("trial-3.csv", "next.csv", "--measured trial-4.csv --out next.csv"),
        ("a b/t03.csv", "next-4.csv", "--measured 'a b/t4.csv' --out next-5.csv"),
        ("log.mat", "n.h", "--measured log-4.mat --out n.h"),
        ("t.csv", "axis4.csv", "--measured t-4.csv --out axis4.csv"),
    ):
        assert found in next_command(Path("x"), 4, Path(measured), Path(out))
    assert "--measured trial-4.csv --out next.csv" in next_command(Path("x"), 4, None, None)
    for given, name in (
        ("axis.toml", "axis-2.toml"),
        ("d/axis-2.toml", "d/axis-3.toml"),
        ("x1.toml", "x1-2.toml"),
    ):
        assert new_plant_file({"file": {"given": given}}) == name
    assert new_plant_file({}) == "axis-2.toml"


def test_a_verdict_says_whether_learning_goes_on():
    def said(*errors, of_step=1, looked_at=(), accepted=()):
        learned = [j not in looked_at for j in range(1, 1 + len(errors))]
        live = journal_of(*learned, errors=errors)
        for j in accepted:
            live[j]["findings"].append(["warning", "9 times the best; suspected is (accepted)"])
        if accepted:
            task, since = Task(np.linspace(0, 1, 5), dt=0.1), accepted[-1]
            compared = checks.comparable(PIDType(), task, live)
            assert compared[0][0] == since, "those before are of another machine"
            for j in range(since, len(live)):  # all but every second one are experiments
                last = checks.of_learning(ModelFreeGradient(1.0), task, live[: j + 1])
                assert [k for k, _ in last] == [k for k in range(since, j + 1) if k % 2]
        return verdict(live, None, None, "mm", 0.02, of_step)[0]

    assert said() == "no trial is measured yet"
    assert said(2.0, 1.0).endswith("trial 2 has an RMS error of 1 mm, 50.00% of that of trial 1")
    assert "the best was trial 2 with 1 mm" in said(2.0, 1.0, 1.5)
    assert said(2.0, 1.0, 1.0, 0.995, 0.99).endswith(
        "learning has ended, and the input of trial 5 may be played from now on: "
        "jaxilc next --state STATE --undo 4 --out best.csv"
    )
    assert said(31.74, 5e-4).endswith("0.0016% of that of trial 1"), "it was told as 0.00%"
    assert "has ended" not in said(2.0, 1.0, 0.99, 0.98, 0.97)
    slow = 2.0 * 0.994 ** np.arange(9)  # which goes on
    assert all("in any 3 trials: learning is slow" in said(*slow[:j]) for j in range(4, 10))
    assert "has ended" not in said(2.0, 2.0, 2.0, 2.0, looked_at=(1, 2, 3, 4)), "nothing is learned"
    repeats = (2.0, 1.0, 1.0, 1.0, 1.0)  # trials 2 to 5 played one input
    assert "has ended" not in said(*repeats, 1.0, 1.0, looked_at=(2, 3, 4))
    assert "has ended" in said(*repeats, 1.0, 1.0, 1.0, looked_at=(2, 3, 4))
    assert "trial 4 has an" in said(*repeats[:3], 9.0, accepted=(2, 4))
    assert said(*repeats, 9.0, 8.0, 7.0, 6.0, accepted=(6,)).endswith("3 times that of trial 1")
    assert "the input of trial 8" in said(*repeats, 9.0, *[8.0, 7.0, 7.0, 7.0, 7.0], accepted=(6,))
    found = said(2.0, 3.0, of_step=2)
    assert "trial 2 is experiment 1 between" in found
    assert "trial 1 had an RMS error of 2 mm" in found
    assert said(2.0, 3.0, 1.0, of_step=2).endswith("50.00% of that of trial 1")
