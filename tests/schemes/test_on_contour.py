"""Contour learning, against the equations of cross-coupled learning in NumPy."""

import jax.numpy as jnp
import numpy as np
import pytest
from cases import ALGEBRA, DT

from jaxilc import Machine, Task, learn
from jaxilc.learning.contour_metrics import contour_metrics
from jaxilc.plants import StateSpace
from jaxilc.scenarios import specification
from jaxilc.schemes import PID, GradientILC, NormOptimal, OnContour, PIDType, WithFeedback
from jaxilc.signals.contour import contour_error, to_the_path
from jaxilc.signals.task import Trial
from jaxilc.theory.certificates import NOTHING, certify

N = 60
ANGLE = 2 * np.pi * (0.5 - 0.5 * np.cos(np.pi * np.arange(N + 1) / N))
CIRCLE = np.stack([np.cos(ANGLE), np.sin(ANGLE)], axis=1)
TASK = Task(CIRCLE, DT, names=("x", "y"))
# two axes that lag differently
PLANT = StateSpace(np.diag([0.7, 0.55]), np.diag([0.3, 0.45]), np.eye(2), dt=DT)


def trial(rng, r):
    y = r + 0.01 * rng.standard_normal(r.shape)
    return Trial(jnp.asarray(r), jnp.asarray(y), jnp.zeros((len(r) - 1, r.shape[1])), DT)


@pytest.mark.parametrize("own", [1.0, 0.0])
def test_each_axis_learns_from_its_own_and_the_cross_coupled_error(own):
    rng = np.random.default_rng(1)
    record = trial(rng, CIRCLE)
    scheme = OnContour(PIDType(gamma_p=0.5), own=own, contour=0.8)
    e = np.asarray(record.e)
    along = np.gradient(CIRCLE, axis=0)
    theta = np.arctan2(along[:, 1], along[:, 0])
    eps = -np.sin(theta) * e[:, 0] + np.cos(theta) * e[:, 1]
    expected = own * e + 0.8 * eps[:, None] * np.stack([-np.sin(theta), np.cos(theta)], axis=1)
    found = scheme.learn(scheme.initial_memory(TASK), record).u
    np.testing.assert_allclose(found, 0.5 * expected[1:], **ALGEBRA)


def test_in_space_the_part_along_the_path_is_left_out():
    rng, s = np.random.default_rng(2), np.linspace(0, 1, N + 1)
    r = np.stack([s, 2 * s**2, np.sin(s)], axis=1)
    record = trial(rng, r)
    shown = OnContour(PIDType(), own=0.0).shown(record)["scheme"]
    along = np.gradient(r, axis=0)
    t = along / np.linalg.norm(along, axis=1)[:, None]
    e = np.asarray(record.e)
    expected = e - np.sum(e * t, axis=1)[:, None] * t
    np.testing.assert_allclose(shown.e, expected, rtol=1e-9, atol=1e-12)
    still = record._replace(r=jnp.zeros_like(record.r))
    np.testing.assert_allclose(OnContour(PIDType(), own=0.0).shown(still)["scheme"].e, still.e)


def test_the_nearest_place_of_the_path_is_that_of_the_contour_error():
    rng = np.random.default_rng(3)
    y = CIRCLE[np.maximum(np.arange(N + 1) - 2, 0)] * (1 + 0.1 * rng.standard_normal((N + 1, 1)))
    vector = np.asarray(to_the_path(y, CIRCLE, window=10))
    distance = np.asarray(contour_error(y, CIRCLE, window=10))
    np.testing.assert_allclose(np.linalg.norm(vector, axis=1), np.abs(distance), **ALGEBRA)
    assert np.max(np.abs(contour_error(y + vector, CIRCLE, window=10))) < 1e-12
    record = trial(rng, CIRCLE)._replace(y=jnp.asarray(y))
    scheme = OnContour(PIDType(), own=0.3, contour=2.0, estimate="nearest", window=10)
    e = scheme.shown(record)["scheme"].e
    np.testing.assert_allclose(e, 0.3 * (CIRCLE - y) + 2.0 * vector, rtol=1e-9, atol=1e-12)


def test_a_law_with_a_model_minimises_the_combination():
    scheme = OnContour(NormOptimal(PLANT, w_s=0.05), own=0.2, contour=1.0)
    history = learn(Machine(PLANT), scheme, TASK, 2)
    A, B = np.asarray(PLANT.A), np.asarray(PLANT.B)
    powers = [np.linalg.matrix_power(A, k) @ B for k in range(N)]
    H = np.zeros((2 * N, 2 * N))
    for i in range(N):
        for k in range(i + 1):
            H[2 * i : 2 * i + 2, 2 * k : 2 * k + 2] = powers[i - k]
    along = np.gradient(CIRCLE, axis=0)
    t = along / np.linalg.norm(along, axis=1)[:, None]
    W = np.zeros((2 * N, 2 * N))
    for k in range(N):
        P = np.eye(2) - np.outer(t[k + 1], t[k + 1])
        W[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = 0.2 * np.eye(2) + P
    r = CIRCLE[1:].ravel()
    cost = H.T @ W.T @ W @ H + 0.05 * np.eye(2 * N)
    expected = np.linalg.solve(cost, H.T @ W.T @ W @ r)
    np.testing.assert_allclose(np.asarray(history.memory.u).ravel(), expected, rtol=1e-7, atol=1e-9)


LAWS = {
    "p_type": PIDType(gamma_p=0.5),
    "gradient": GradientILC(PLANT),
    "with_feedback": WithFeedback(PIDType(gamma_p=0.3), PID(kp=0.5)),
}


@pytest.mark.parametrize("name", LAWS)
def test_contour_learning_makes_the_contour_better_than_the_axes_alone(name):
    metric = contour_metrics(TASK)["contour_rms"]
    machine, law = Machine(PLANT), LAWS[name]
    alone = learn(machine, law, TASK, 4, save=metric).saved
    coupled = learn(machine, OnContour(law, own=1.0, contour=0.7), TASK, 4, save=metric).saved
    if name == "p_type":
        assert float(coupled[-1]) < 0.9 * float(alone[-1])
    else:
        assert float(coupled[-1]) < float(coupled[0])


def test_theory_reads_the_law_and_a_plant_file_names_it():
    table = {"class": "OnContour", "own": 0.5, "scheme": {"class": "PIDType", "gamma_p": 0.3}}
    scheme = specification.scheme(table, "schemes.c", PLANT, DT)
    found = certify(Machine(PLANT), scheme, TASK, 4, {}, {})
    assert found.claim[0] != NOTHING
    np.testing.assert_allclose(found.predicted, found.simulated, rtol=1e-6)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: OnContour(PIDType()).check(Task(np.ones(9), DT)), "has 1 outputs"),
        (lambda: OnContour(PIDType(), window=0), "window = 0 is outside"),
        (lambda: OnContour(PIDType(), own=(1.0, 2.0)), "allowed is one number"),
        (lambda: OnContour(PIDType(), estimate="far"), "is not one of 'normal', 'nearest'"),
    ],
)
def test_what_does_not_fit_is_named(make, said):
    with pytest.raises(ValueError, match=said):
        make()
