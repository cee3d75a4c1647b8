"""A learned law: its taps against NumPy, its gate, its resumption, and machines not seen."""

import dataclasses
import shutil
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from jaxilc import Machine, Normal, Sensor, Task, Uniform
from jaxilc.design import LearnedLaw, judging
from jaxilc.design.by_response import FirstTaps, by_response, sizes_of
from jaxilc.design.candidates import UNSAFE, Candidate, candidates, contraction, penalty
from jaxilc.design.judging import Proof, _further
from jaxilc.design.learned import Passed, better_of, gate, kept_or
from jaxilc.design.responses import designed_on, family_of, under
from jaxilc.design.window import Filters, ShapedFilter, window_of
from jaxilc.outcomes.designing import safety_said
from jaxilc.plants import ProcessModel, StateSpace
from jaxilc.scenarios.parameters import differing
from jaxilc.schemes import PID, PIDType
from jaxilc.storage.sealed import sealed, write_json
from jaxilc.theory.law import law_of, learning_law

DT, N, TRIALS, MARGIN = 1e-3, 120, 5, 0.1
MACHINE = Machine(
    ProcessModel(2.0, poles=[150.0], frequencies=[900.0], dampings=[0.1]), None, Sensor(noise=1e-5)
)
TASK = Task(np.sin(np.linspace(0, 6 * np.pi, N + 1)) ** 2, dt=DT, unit="mm")
WIDE = {
    "plant.gain": Uniform(0.85, 1.15, relative=True),
    "plant.frequencies[0]": Uniform(0.9, 1.1, relative=True),
}
TAPS = (21, 11)


@pytest.fixture(scope="module")
def family():
    return family_of(designed_on(MACHINE, WIDE, machines=5), None, TASK, points=60)


@pytest.fixture(scope="module")
def window(family):
    return window_of(family, TASK, TAPS)


@pytest.fixture(scope="module")
def safe(family):
    (found,) = candidates(family, None, TASK, TRIALS, MARGIN, ("p-type",))
    assert isinstance(found, Candidate)
    return found


@pytest.fixture(scope="module")
def found(family, window):
    return by_response(family, window, window.nothing(), TASK, TRIALS, 1 - MARGIN)[0]


@pytest.mark.thorough
def test_the_sizes_of_taps_are_those_of_the_matrix_of_the_scheme(family, window, found):
    """The middle row of the law as a matrix holds its taps."""
    law, middle = learning_law(window.of(found), Task(np.zeros(402), dt=DT)), 200
    z = np.exp(2j * np.pi * DT * np.outer(family.frequencies, np.arange(401) - middle))
    keep, L = (
        z @ law.keep[middle],
        np.exp(2j * np.pi * family.frequencies * DT) * (z @ law.L[middle]),
    )
    expected = np.abs(keep - L * family.P)
    np.testing.assert_allclose(sizes_of(family, window, found, DT), expected, atol=1e-10)
    np.testing.assert_allclose(contraction(family, window.of(found), TASK), expected.max())


@pytest.mark.thorough
def test_the_directions_are_peaks_of_one_frequency(family, window):
    """A step along one of them changes |L P| by 1 at its frequency, where |P| is not small."""
    of_L, _ = window.responses(np.arange(1, 10) / (21 * DT), DT)
    P = np.interp(np.arange(1, 10) / (21 * DT), family.frequencies, np.abs(family.P[0]))
    height = np.abs(of_L @ window.of_L[:, 1:19:2]).diagonal() * P
    strong = np.max(np.abs(family.P[0])) < 10 * P
    assert strong.sum() >= 3
    np.testing.assert_allclose(height[strong], 1.0, rtol=1e-6)


def test_no_step_changes_keep_at_rest_nor_its_curvature(window):
    k = np.arange(11) - 5
    np.testing.assert_allclose(np.sum(window.of_keep, axis=0), 0, atol=1e-12)
    np.testing.assert_allclose(k**2 @ window.of_keep, 0, atol=1e-11)
    assert np.linalg.matrix_rank(window.of_keep, tol=1e-9) == 4


@pytest.mark.thorough
def test_a_law_of_a_few_weights_is_held_by_a_window_that_is_wide_enough(family, safe):
    wide = window_of(family, TASK, (101, 101))
    held = wide.of(wide.holding(law_of(safe.scheme, TASK)))
    np.testing.assert_allclose(contraction(family, held, TASK), safe.largest, atol=3e-3)


def test_the_safe_law_beside_a_limited_one_is_limited_too(family, safe, monkeypatch):
    """It was judged without the limit, and said to be the better one."""
    for feedback, path in ((None, ""), (PID(kp=2.0, limit=9.0), "learning.")):
        law = safe._replace(scheme=under(safe.scheme, feedback))
        monkeypatch.setattr(LearnedLaw, "safe", lambda *_, law=law: ([law], []))
        (one,) = LearnedLaw(MACHINE, TASK, 5, WIDE, feedback, limit=0.3)._safe(family, print)
        assert differing(one.scheme, law.scheme) == {f"{path}scheme.limit": 0.3}


@pytest.mark.thorough
def test_the_steps_from_some_taps_to_others_lead_there(family, window, safe, found):
    held = window.holding(law_of(safe.scheme, TASK))
    there = window.moved(found, window.steps(found, held))
    for one, other in zip(there, held, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-9)


@pytest.mark.parametrize(
    ("losses", "best"), [((1, 0.9), 1), ((1, 1), 0), ((np.nan, 2), 1), ((1, np.nan), 0)]
)
def test_a_tuning_begins_with_the_taps_of_less_loss(window, found, losses, best):
    ends, asked = (found, window.nothing()), []
    names = [f"z[{i}]" for i in range(window.number_of_steps())]

    def held_out_losses(rows):
        asked.extend(np.stack([rows[name] for name in names], axis=1))
        return np.array(losses)

    problem = SimpleNamespace(start=dict.fromkeys(names), held_out_losses=held_out_losses)
    assert better_of(problem, window, *ends) is ends[best]
    for z, end in zip(asked, ends, strict=True):
        np.testing.assert_allclose(window.moved(found, z).L, end.L, atol=1e-9)


def test_by_response_beats_the_safe_law_and_keeps_the_bound(family, window, safe, found):
    assert sizes_of(family, window, found, DT).max() <= 1 - MARGIN + 5e-3
    of_L, of_keep = window.responses(family.frequencies, DT)
    keep = of_keep @ found.keep
    learned = family.rms(keep, (of_L @ found.L) / keep, TRIALS)
    law = law_of(safe.scheme, TASK)
    Q = family.of_taps(law.keep, DT)
    assert np.all(learned < 0.7 * family.rms(Q, family.of_taps(law.L, DT) / Q, TRIALS))


@pytest.mark.thorough
def test_the_penalty_begins_at_the_bound_and_not_before(family, window, found):
    """A law that just keeps the bound is not pushed away from it."""
    largest = sizes_of(family, window, found, DT).max()
    run = SimpleNamespace(scheme=window.of(found), task=TASK)
    assert float(penalty(family, 1.003 * largest)(run)) == 0.0
    beyond = float(penalty(family, largest / 1.05)(run))
    assert UNSAFE * np.log(1.05) <= beyond <= UNSAFE * np.log(1.05 * 1.003)


def test_each_machine_may_differ_from_its_model_by_what_the_proof_says(family, window, found):
    """P (1 + W D) with |D| = 1 in all directions: the largest |keep - L P| is then just 1."""
    law = law_of(window.of(found), TASK)
    W = _further(family, [law], np.array([family.sizes_of_law(law, DT)]), DT)
    turns = 1 + W * np.exp(2j * np.pi * np.arange(72) / 72)
    sizes = [family._replace(P=family.P * D).sizes_of_law(law, DT).max() for D in turns]
    assert 0.99 < max(sizes) <= 1 + 1e-9


@pytest.mark.parametrize(("further", "percent"), [(0.1069, "10.6"), (1.5, "150")])
def test_what_a_machine_may_differ_by_is_rounded_down_and_of_its_closed_loop(further, percent):
    """A drive of twice the gain was called safe, under a feedback that is unstable with it."""
    proof = Proof(0.8, 0.9, 10.0, {}, 1, ("monotone",) * 2, ("",) * 2, further=further)
    what = "each stable response from what is learned to the output may differ from its model by"
    assert f"{what} {percent} % at any frequency that was tried" in safety_said(proof, {})
    proof = proof._replace(without="variation.late = 40", machine={"plant.gain": 0.7})
    told = safety_said(proof, WIDE)
    assert "(of trials without variation.late = 40) is at most 0.9" in told
    assert "of 1 machine (plant.gain x 0.7)" in told, "a factor, and no gain of 0.7"


@pytest.fixture
def without_claims(monkeypatch):
    """Proofs of the frequencies alone: the claims of theory are tested elsewhere."""
    told = SimpleNamespace(claim=("", ""), reason=("", ""))
    monkeypatch.setattr(judging, "long_run", lambda *_: told)


@pytest.mark.thorough
@pytest.mark.usefixtures("without_claims")
def test_the_proof_of_a_whole_set_encloses_its_corners(monkeypatch):
    """A peak lies between the lines of the grid, on a corner that is not the worst on the grid."""
    monkeypatch.setattr(judging, "ENCLOSED", 0)
    drawn = designed_on(MACHINE, {"plant.gain": WIDE["plant.gain"]}, machines=3)
    family, scheme = family_of(drawn, None, TASK, points=4), PIDType(gamma_p=0.3)
    whole = judging.proof_of(family, scheme, TASK, between=True).whole
    dense = family_of(drawn, None, TASK, points=4000)
    z = np.exp(2j * np.pi * DT * dense.frequencies)
    assert whole.bound >= np.abs(1 - 0.3 * z * dense.P).max() - 1e-9


@pytest.mark.thorough
@pytest.mark.usefixtures("without_claims")
def test_the_corners_of_a_normal_distribution_are_found_though_drawn_numbers_lie_beyond():
    """The proof ends at them, and so do its bound and what is said of it."""
    normal = {"plant.gain": Normal(1.0, 0.05, relative=True)}
    family = family_of(designed_on(MACHINE, normal, machines=200), None, TASK, points=4)
    gains = family.drawn["plant.gain"][judging._corners(family)]
    np.testing.assert_allclose(gains, [0.9, 1.1])
    assert np.ptp(family.drawn["plant.gain"]) > 0.2
    proof = judging.proof_of(family, PIDType(gamma_p=0.6), TASK, between=True)
    within = np.abs(family.drawn["plant.gain"] - 1) < 0.1001
    law = family._replace(P=family.P[within]).sizes(1, 0.6 * family.advance(1, DT))
    assert np.max(law) <= proof.whole.bound < np.max(law) * 1.02 < proof.worst
    assert "two standard deviations from the mean of plant.gain" in safety_said(proof, normal)


@pytest.mark.thorough
def test_shaped_is_a_learning_filter(window, found):
    shaped = ShapedFilter.around(window, found)
    np.testing.assert_array_equal(shaped.taps().L, window.of(found).L)
    z = np.random.default_rng(2).standard_normal(shaped.z.shape)
    slope = jax.jacobian(
        lambda z: (
            ShapedFilter(z, shaped.L, shaped.keep, shaped.of_L, shaped.of_keep, shaped.lead)
            .taps()
            .L
        )
    )(z)
    np.testing.assert_allclose(slope[:, :21], window.of_L, atol=1e-12)


def test_the_gate_takes_an_unsafe_law_back_and_refuses_what_stays_unsafe(family, window, found):
    most, wild = 1 - MARGIN / 2, found._replace(L=3.0 * found.L)
    passed = gate(family, window, wild, (found,), DT, most)
    assert isinstance(passed, Passed)
    assert 0 < passed.way <= 1
    assert sizes_of(family, window, passed.filters, DT).max() == passed.largest <= most
    before = wild.towards(found, passed.way - 0.05)
    assert sizes_of(family, window, before, DT).max() > most
    refused = gate(family, window, wild, (wild,), DT, most)
    assert isinstance(refused, str)
    for part in ("|Q (1 - L P)| is", "Hz on the machine with plant.gain = ", "allowed is 0.95"):
        assert part in refused
    asked = []

    def ends(filters, machine):
        asked.append(machine)
        return np.abs(filters.L).sum() < np.abs(passed.filters.L).sum() - 1e-6

    later = gate(family, window, wild, (found,), DT, most, ends)
    assert later.way > passed.way
    assert 0 in asked
    refused = gate(family, window, found, (found,), DT, 1.0, lambda *_: False)
    assert "diverge from an end of the trial" in refused
    nan = Filters(np.full(21, np.nan), found.keep)
    assert isinstance(gate(family, window, nan, (nan,), DT, most), str)


def test_a_law_is_refused_in_a_task_of_another_sample_time(window, found):
    law = window.of(found)
    law.check(TASK)
    with pytest.raises(ValueError, match=f"dt = {DT:g} s is not that of the task, {DT / 2:g} s"):
        law.check(Task(np.zeros(121), dt=DT / 2))


@pytest.mark.usefixtures("compiled_once", "tuned_by_one_program")
def test_a_run_that_was_killed_and_is_resumed_learns_the_same_taps(tmp_path, monkeypatch):
    monkeypatch.setattr("jaxilc.design.learned.DENSE", 3)
    monkeypatch.setattr("jaxilc.design.learned.WATCH", 3)
    monkeypatch.setattr("jaxilc.design.by_response.leads_of", lambda *_: [4])
    monkeypatch.setattr(LearnedLaw, "_safe", lambda *_: [])
    machine, wide = StateSpace([[0.86]], [[0.28]], [[1.0]], dt=DT), Uniform(0.9, 1.1, relative=True)
    asked = LearnedLaw(
        Machine(machine), TASK, 2, {"plant.B": wide}, taps=(5, 5), start="nothing", metric="rms",
        margin=MARGIN, trained_on=2, held_out=0, steps=4,
    )  # fmt: skip
    whole, killed, passed = tmp_path / "whole", tmp_path / "killed", []

    def told(stage, what):
        if stage == "tuning" and what[0] == 2 and not killed.exists():
            shutil.copytree(whole, killed)  # what a run that is killed now leaves
        if stage == "gate":
            passed.append(what)
            raise InterruptedError

    for folder, resume in ((whole, False), (killed, True)):
        with pytest.raises(InterruptedError):
            asked.run(folder, resume=resume, told=told)
    for one, other in zip(passed[0].filters, passed[1].filters, strict=True):
        np.testing.assert_array_equal(one, other)
    with pytest.raises(FileExistsError, match="resume"):
        asked.run(killed)
    with pytest.raises(ValueError, match=r"another question; it differs in: asked\.margin"):
        dataclasses.replace(asked, margin=0.2).run(killed, resume=True)


@pytest.mark.parametrize("inner", [(), (2, 2)])  # of one channel, and of two
def test_taps_that_an_earlier_version_found_for_each_segment_are_refused(inner, tmp_path):
    def kept(segments, *, resume):
        L, keep = np.ones((2, *segments, 5, *inner))
        of = FirstTaps(Filters(L, keep), 3, {})
        return kept_or(tmp_path / str(segments), "which taps?", lambda: of, resume=resume)

    for segments in ((), (2,)):
        kept(segments, resume=False)
    assert kept((), resume=True).filters.L.shape == (5, *inner)
    with pytest.raises(ValueError, match="earlier version with other taps in each segment"):
        kept((2,), resume=True)


def test_damaged_taps_are_computed_again(tmp_path, caplog):
    made = []

    def first():
        made.append(FirstTaps(Filters(np.arange(5.0), np.ones(3)), 3, {}))
        return made[-1]

    kept_or(tmp_path, "which taps?", first, resume=False)
    file = tmp_path / "start.json"
    whole = file.read_text()
    other = tmp_path / "other.json"
    write_json(other, sealed({"lead": 3}))
    for damage in (whole.replace("4.0", "4.5"), "[]", whole[:50], "", other.read_text()):
        file.write_text(damage)
        caplog.clear()
        found = kept_or(tmp_path, "which taps?", first, resume=True)
        assert found.filters.L.tolist() == [0, 1, 2, 3, 4]
        assert str(file) in caplog.text
        assert file.read_text() == whole
    assert len(made) == 6
    kept_or(tmp_path, "which taps?", first, resume=True)
    assert len(made) == 6


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"taps": (60, 31)}, r"taps = \(60, 31\).*odd"),
        ({"taps": (61, 4001)}, "from 1 to 117 for a trial of 120 samples"),
        ({"start": "safety"}, "safe"),
        ({"margin": 0.0}, "margin = 0"),
        ({"steps": -1}, "steps = -1"),
        ({"trials": 1}, "trials = 1"),
        ({"taps": 61}, "taps = 61 .*odd"),
        ({"taps": (9.0, np.inf)}, r"taps = \(9.0, inf\)"),
        ({"starts": (60.0,)}, r"starts = \(60.0,\) .*whole samples"),
        ({"starts": ("a",)}, "starts"),
        ({"metric": "foo"}, "metric = 'foo' is not one of .*settled_error"),
        ({"limit": [1.0, 2.0]}, "limit"),
        ({"objective": "final"}, "objective = 'final'; allowed"),
        ({"risk": "mean"}, "risk = 'mean'; allowed"),
        ({"coupled": "no"}, "coupled = 'no'; allowed is True or False"),
        ({"highest": np.nan}, "highest = nan"),
    ],
)
def test_a_setting_that_is_not_allowed_is_named_before_anything_runs(setting, message):
    with pytest.raises(ValueError, match=message):
        LearnedLaw(**({"machine": MACHINE, "task": TASK, "trials": 5, "uncertainty": {}} | setting))
