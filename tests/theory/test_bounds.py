"""The bounds d1 and d2 of Cao 2019 are tested on simulated runs.

They are met exactly on a static plant, and never claimed where a premise does not hold.
"""

import dataclasses

import numpy as np
import pytest

import jaxilc
from jaxilc import Disturbance, Machine, Task
from jaxilc.plants import DifferenceEquation, StateSpace, voice_coil
from jaxilc.schemes import CFDLMFAILC, FFDLMFAILC
from jaxilc.theory import cfdl_bounds, ffdl_bounds

DT, N = 1e-3, 50
TASK = Task(reference=0.3 + np.sin(2 * np.pi * np.arange(N + 1) / N), dt=DT)


def static_plant(gain):
    """Return the plant y(k+1) = gain u(k)."""
    return DifferenceEquation((0.0,), (gain,), dt=DT)


def run(plant, scheme, trials=12, task=TASK, **parts):
    history = jaxilc.learn(Machine(plant, **parts), scheme, task, trials, save=y_and_u)
    return np.asarray(history.saved[0]), np.asarray(history.saved[1])


def y_and_u(trial):
    return trial.y, trial.u


SCHEME = CFDLMFAILC(lam=0.5, rho=0.8, eta=0.7, mu=0.2, phi0=0.4, reset="sign")


def test_a_static_plant_meets_d2_exactly():
    bounds = cfdl_bounds(SCHEME, TASK, *run(static_plant(1.2), SCHEME))
    assert bounds.condition.verdict == "holds"
    np.testing.assert_allclose(bounds.phi[~np.isnan(bounds.phi)], 1.2, rtol=1e-7)
    seen = ~np.isnan(bounds.d2)
    np.testing.assert_allclose(bounds.observed[seen], bounds.d2[seen], rtol=1e-6)
    # The bound is clearly below 1, and it is what eq. 15 gives by hand for the least accurate
    # estimate.
    assert bounds.d2_worst < 0.6
    worst = np.nanmin(1.2 * bounds.estimate / (0.5 + bounds.estimate**2))
    np.testing.assert_allclose(bounds.d2_worst, 1 - 0.8 * worst, rtol=1e-6)
    assert np.nanmax(bounds.observed) <= bounds.d2_worst * (1 + 1e-9)


def test_the_estimation_error_keeps_its_bound():
    y, u = run(static_plant(1.2), SCHEME)
    bounds = cfdl_bounds(SCHEME, TASK, y, u)
    seen = ~np.isnan(bounds.ppd_bound) & ~np.isnan(bounds.ppd_error)
    assert np.all(bounds.ppd_error[seen] <= bounds.ppd_bound[seen])
    # For constant phi the estimation error is reduced by the computed d1 alone, trial after trial.
    step = bounds.d1[:-1] * bounds.ppd_error[:-1]
    both = ~np.isnan(step) & ~np.isnan(bounds.ppd_error[1:])
    np.testing.assert_allclose(bounds.ppd_error[1:][both], step[both], rtol=1e-5, atol=1e-9)
    assert bounds.d1_worst == pytest.approx(1 - 0.7 * 1e-10 / (0.2 + 1e-10), rel=1e-12)


def test_the_bound_is_never_violated_where_it_is_claimed():
    rng = np.random.default_rng(3)
    claimed = 0
    for _ in range(20):
        scheme = CFDLMFAILC(
            lam=rng.uniform(0.1, 2),
            rho=rng.uniform(0.2, 1),
            eta=rng.uniform(0.2, 1),
            phi0=rng.uniform(0.1, 1),
            reset="sign",
        )
        plant = DifferenceEquation((rng.choice([0.0, 0.3]),), (rng.uniform(0.2, 2),), dt=DT)
        bounds = cfdl_bounds(scheme, TASK, *run(plant, scheme))
        if bounds.condition.verdict == "holds":
            claimed += 1
            assert np.nanmax(bounds.observed[~np.isnan(bounds.d2)]) <= bounds.d2_worst * (1 + 1e-6)
    assert claimed >= 3


def premise_of(bounds, start):
    return next(p for p in bounds.condition.premises if p.name.startswith(start))


BROKEN = {
    "sign of the estimate": (
        static_plant(1.2),
        dataclasses.replace(SCHEME, phi0=-0.4, eta=0.01),
        {},
    ),
    "lam > b^2 / 4": (static_plant(1.2), dataclasses.replace(SCHEME, lam=0.3), {}),
    "phi bounded away": (static_plant(1e-6), SCHEME, {}),
    "constant sign": (DifferenceEquation((1.2, -0.5), (1.0, -1.3), dt=DT), SCHEME, {}),
    "the law acts": (static_plant(1.2), dataclasses.replace(SCHEME, limit=0.3), {}),
}


@pytest.mark.parametrize("name", BROKEN)
def test_each_premise_can_break_and_then_nothing_is_claimed(name):
    plant, scheme, parts = BROKEN[name]
    bounds = cfdl_bounds(scheme, TASK, *run(plant, scheme, trials=6, **parts))
    broken = premise_of(bounds, name)
    assert not broken.held
    assert 0 < broken.share_broken <= 1
    assert bounds.condition.verdict == "not claimed"


def test_an_output_that_moves_without_its_input_breaks_lipschitz():
    y, u = (signal.copy() for signal in run(static_plant(1.2), SCHEME, trials=4))
    y[2:, 10] += 0.1  # a change at y(10) in trial 3 without a change of u(9)
    u[2:, 9] = u[1, 9]
    bounds = cfdl_bounds(SCHEME, TASK, y, u)
    assert not premise_of(bounds, "Lipschitz").held
    assert bounds.condition.verdict == "not claimed"


def test_on_the_voice_coil_the_theory_does_not_apply_and_says_so():
    s = jaxilc.scenarios.load("cao-2019")
    scheme = s.schemes["cfdl-mfailc"]
    bounds = cfdl_bounds(scheme, s.task, *run(voice_coil(), scheme, trials=20, task=s.task))
    assert bounds.condition.verdict == "not claimed"
    assert {p.name.split(":")[0].split(" ")[0] for p in bounds.condition.broken} >= {"constant"}


@pytest.mark.parametrize(("lam", "trials"), [(1.0, 100), (3.0, 300)])
def test_lambda_above_b_squared_over_four_guarantees_nothing_on_a_dynamic_plant(lam, trials):
    """lam > b^2/4 guarantees nothing on a dynamic plant.

    On a 60 Hz servo loop the error of CFDL-MFAILC is reduced by a factor of a thousand, and then
    grows. A larger lam only makes the same course take more trials.
    """
    w = 2 * np.pi * 60.0
    servo = StateSpace([[0.0, 1.0], [-w * w, -1.4 * w]], [[0.0], [w * w]], [[1.0, 0.0]])
    task = Task(reference=0.5 - 0.5 * np.cos(2 * np.pi * np.arange(201) / 200), dt=DT)
    scheme = CFDLMFAILC(lam=lam, phi0=0.5, eta=0.01, reset="sign")
    y, u = run(servo, scheme, trials, task)
    errors = np.sqrt(np.mean((np.asarray(task.reference)[:, 0] - y[..., 0]) ** 2, axis=1))
    best = int(np.argmin(errors))
    assert 15 * lam < best < 25 * lam
    assert errors[best] < 1e-3 * errors[0]
    assert errors[-1] > 10 * errors[best]
    bounds = cfdl_bounds(scheme, task, y, u)
    first_markov = 0.0594  # of the sampled loop; lam is more than a thousand times its square / 4
    assert lam > 1000 * first_markov**2 / 4
    assert bounds.condition.verdict == "not claimed"
    assert not premise_of(bounds, "constant sign").held


def test_ffdl_pseudo_gradient_is_bounded_and_its_length_right():
    scheme = FFDLMFAILC(lam=0.5, mu=0.5, phi0=(0.3, 0.0, 0.8, 0.0), reset="sign")
    plant = DifferenceEquation((0.5, 0.1), (1.0, 0.2), dt=DT)
    y, u = run(plant, scheme)
    bounds = ffdl_bounds(scheme, TASK, y, u)
    assert bounds.condition.verdict == "not claimed", "a finite b says nothing of the error"
    # The coefficients of a linear plant are a pseudo gradient of it, and the shortest one is not
    # longer.
    assert bounds.b <= np.linalg.norm([0.5, 0.1, 1.0, 0.2]) * (1 + 1e-9)
    j, k = 2, 20
    DH = np.array(
        [
            y[j, k] - y[j - 1, k],
            y[j, k - 1] - y[j - 1, k - 1],
            u[j, k] - u[j - 1, k],
            u[j, k - 1] - u[j - 1, k - 1],
        ]
    )[:, 0]
    np.testing.assert_allclose(
        bounds.gradient[j - 1, k],
        abs(y[j, k + 1, 0] - y[j - 1, k + 1, 0]) / np.linalg.norm(DH),
        rtol=1e-10,
    )
    np.testing.assert_allclose(bounds.d1[j - 1, k], 1 - DH @ DH / (0.5 + DH @ DH), rtol=1e-10)


@pytest.mark.parametrize(
    ("y", "u", "message"),
    [
        (np.zeros((2, N + 1, 1)), np.zeros((2, N, 1)), r"J >= 3"),
        (np.zeros((4, N, 1)), np.zeros((4, N, 1)), r"y \(4, 50, 1\) and u \(4, 50, 1\) do not fit"),
        (np.full((4, N + 1, 1), np.nan), np.zeros((4, N, 1)), "not finite"),
    ],
)
def test_bad_input_is_named(y, u, message):
    for bounds, scheme in ((cfdl_bounds, SCHEME), (ffdl_bounds, FFDLMFAILC())):
        with pytest.raises(ValueError, match=message):
            bounds(scheme, TASK, y, u)


def test_a_disturbance_that_repeats_changes_nothing():
    parts = {"disturbance": Disturbance(output=np.linspace(0, 0.2, N + 1)[:, None])}
    bounds = cfdl_bounds(SCHEME, TASK, *run(static_plant(1.2), SCHEME, **parts))
    assert bounds.condition.verdict == "holds"
