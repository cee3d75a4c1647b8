"""Design under a budget is tested: fronts and budgets are compared with closed forms.

Finished points are kept when a run is interrupted. The tests also check what is refused.
"""

import dataclasses
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from gain_case import STATIC, TASK, Killed

from jaxilc.schemes import PIDType
from jaxilc.tuning import Tuning, pareto
from jaxilc.tuning.objectives import Effort, Final, Growth, Objective
from jaxilc.tuning.trade_off import by_trials

R2 = 0.5  # mean square of the reference; u_2 = gamma_p r + gamma_d dr, and e_2 = r - u_2
GIVEN = {"gamma_p": 0.3, "gamma_d": 1.5}
SCALE = 0.7


@dataclasses.dataclass(frozen=True)
class SquaredError(Objective):
    """Return the mean square error of the last trial."""

    def __call__(self, run):
        return run.history.rms[-1, 0] ** 2


OPTIONS = {"machines": 1, "held_out": 0, "optimiser": "lbfgs", "steps": 15, "patience": 15}
PROBLEM = Tuning(
    STATIC, PIDType(**GIVEN), TASK, 2, list(GIVEN), objective=SquaredError(), **OPTIONS
)


pytestmark = pytest.mark.usefixtures("compiled_once", "tuned_by_one_program")


def both(p, d):
    """Return mean square error and effort of the second trial, from the signals."""
    r = np.asarray(TASK.reference)[:, 0]
    u = p * r[1:] + d * np.diff(r)
    return np.array([np.mean((r[1:] - u) ** 2), np.mean((u / SCALE) ** 2)])


@pytest.fixture(scope="module")
def front(tuned_by_one_program):
    return pareto(PROBLEM, SquaredError(), Effort(SCALE), (0.2, 0.6))


@pytest.mark.thorough
def test_a_quadratic_front_meets_the_analytic_one(front):
    # Both objectives are quadratic in u_2, so the best points lie on the line from 0 to r,
    # u_2 = gamma r, where sqrt(first) + scale sqrt(second) = |r|. There share / first_0
    # (1 - gamma)^2 + (1 - share) / second_0 (gamma / scale)^2 is least at gamma = a / (a + b).
    first, second = both(p=GIVEN["gamma_p"], d=GIVEN["gamma_d"])
    assert [p.share for p in front] == [0.6, 0.2]
    for point in front:
        a, b = point.share / first, (1 - point.share) / second / SCALE**2
        gamma = a / (a + b)
        np.testing.assert_allclose(list(point.tuned.values.values()), [gamma, 0.0], atol=1e-5)
        np.testing.assert_allclose([point.first, point.second], both(gamma, 0.0), rtol=1e-5)
        np.testing.assert_allclose(
            np.sqrt(point.first) + SCALE * np.sqrt(point.second), np.sqrt(R2), rtol=1e-8
        )
    assert np.sqrt(first) + SCALE * np.sqrt(second) > 1.2 * np.sqrt(R2), (
        "the weights as given lie off the front"
    )


@pytest.mark.thorough
def test_what_one_point_beats_in_both_is_left_out():
    # No gain gives growth, so the points differ in their error only. The share of the effort makes
    # the first point the worse one.
    problem = dataclasses.replace(
        PROBLEM, weights={"gamma_p": (0.1, 0.9)}, steps=3, optimiser="adam", rate=0.5
    )
    points = pareto(problem, SquaredError(), Growth(), (0, 1))
    assert [str(p.share) for p in points] == ["1.0"]  # names the folder of its state
    assert points[0].second == 0.0


def test_what_the_weights_as_given_beat_is_left_out_and_no_number_counts_as_infinite(monkeypatch):
    """The worst of a sum may fall where the worst of both terms rise, on different machines."""
    monkeypatch.setattr(Tuning, "run", lambda *_, **__: SimpleNamespace(values={}))
    inf, nan = np.inf, np.nan
    for tuned, kept in (((2, 1.5), []), ((0.9, 1.5), [0.9]), ((nan, 0.9), [inf]), ((nan, 1.1), [])):
        losses = lambda values, tuned=tuned: np.array((1, 1) if values else tuned)  # noqa: E731
        points = pareto(PROBLEM, Final(), Effort(), (0.3, 0.6), losses=losses)
        assert [p.first for p in points] == 2 * kept


def test_an_objective_without_a_share_does_not_count_where_it_is_no_number():
    run = SimpleNamespace(history=SimpleNamespace(rms=np.array([[np.nan]]), effort=np.ones((1, 1))))
    assert (0.0 * SquaredError() + 1.0 * Effort())(run) == 1.0


def test_an_interrupted_front_keeps_its_points(tmp_path):
    problem = dataclasses.replace(PROBLEM, optimiser="adam")  # it is compiled in less time

    def kill_in_the_second(name, step, losses, best):
        if name == "share-0.6" and step == 2:
            raise Killed

    asked = problem, SquaredError(), Effort(SCALE), (0.2, 0.6)
    whole, out, seen = pareto(*asked), tmp_path / "front", []
    with pytest.raises(Killed):
        pareto(*asked, out, progress=kill_in_the_second)
    with pytest.raises(FileExistsError, match="exists already"):
        pareto(*asked, out)
    again = pareto(*asked, out, resume=True, progress=lambda *of: seen.append(of[:2]))
    assert seen == [("share-0.6", step) for step in range(3, 16)]
    for one, other in zip(whole, again, strict=True):
        assert one[:3] == other[:3]
        jax.tree.map(np.testing.assert_array_equal, one.tuned.weights, other.tuned.weights)
    with pytest.raises(ValueError, match="another configuration; it differs in: objective"):
        pareto(problem, SquaredError(), Final(), (0.2, 0.6), out, resume=True)


@pytest.mark.thorough
def test_budgets_of_trials_meet_the_closed_form(tmp_path):
    # u_J = (1 - q) r and e_J = q r with q = (1 - gamma)^(J-1), so q^2 + (1 - q)^2 / scale^2 is
    # least at q = 1 / (1 + scale^2).
    problem = dataclasses.replace(
        PROBLEM,
        scheme=PIDType(gamma_p=0.3),
        weights=["gamma_p"],
        objective=SquaredError() + Effort(SCALE),
    )
    found = by_trials(problem, (2, 4), tmp_path / "budgets")
    for J, tuned in found.items():
        np.testing.assert_allclose(
            tuned.values["gamma_p"], 1 - (1 / (1 + SCALE**2)) ** (1 / (J - 1)), rtol=1e-5
        )
    assert sorted(place.name for place in (tmp_path / "budgets").iterdir()) == [
        "trials-2",
        "trials-4",
    ]


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda out: pareto(PROBLEM, Final(), Effort(), (0.1, 0.1), out),
         r"shares = \[0.1, 0.1\] are not different"),
        (lambda out: pareto(PROBLEM, Final(), Effort(), (), out),
         r"shares = \[\] are not different"),
        (lambda out: pareto(PROBLEM, Final(), Effort(), np.array([0.1, 1.2]), out),
         r"shares = .*0.1.*1.2.* are not different numbers in \[0, 1\]"),
        (lambda out: by_trials(PROBLEM, np.array([5, 0]), out),
         r"budgets = .*5.*0.* are not different numbers of trials in \[1, inf\)"),
        (
            lambda out: by_trials(
                dataclasses.replace(PROBLEM, objective=Final(trial=2)), (5, 1), out
            ),
            r"trial = 2 is outside .* \[1, 1\]",
        ),
    ],
)  # fmt: skip
def test_bad_input_is_named_before_anything_is_written(call, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        call(tmp_path / "out")
    assert not (tmp_path / "out").exists()
