"""Cross-coupled learning is compared with its printed equations, written out in NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal
from cases import ALGEBRA, DT
from dense import lifted

from jaxilc.learning import Machine, learn
from jaxilc.learning.quantities import contour_metrics
from jaxilc.plants import DifferenceEquation, StateSpace, TwoAxes
from jaxilc.schemes import CrossCoupled, NormOptimal, PIDType
from jaxilc.schemes.weights import across, tangents
from jaxilc.signals import Task
from jaxilc.theory import certify

N, TRIALS = 60, 5
S = np.clip((np.arange(N + 1) - 6) / 44, 0, 1)  # at rest, once around, at rest
PATH = np.stack([np.cos(2 * np.pi * S) - 1, 0.6 * np.sin(2 * np.pi * S)], axis=1)
POLES, GAINS = (0.6, 0.85), (0.4, 0.15)
MACHINE = Machine(
    TwoAxes(*(DifferenceEquation((a,), (b,), dt=DT) for a, b in zip(POLES, GAINS, strict=True)))
)
AXES = StateSpace(np.diag(POLES), np.diag(GAINS), np.eye(2), dt=DT)  # the same
TASK = Task(PATH, dt=DT)


def plays(u):
    """The outputs (N+1, 2) of both axes, by SciPy."""
    y = [
        scipy.signal.lfilter([0.0, b], [1.0, -a], np.append(u[:, i], 0.0))
        for i, (a, b) in enumerate(zip(POLES, GAINS, strict=True))
    ]
    return np.stack(y, axis=1)


def angles():
    """theta (N+1,) of the path; before it moves that of its start, after it that of its end."""
    theta = np.empty(N + 1)
    for k in range(N + 1):
        i = min(max(k, 6), 50)  # the first and the last sample whose neighbours are not both there
        step = PATH[min(i + 1, N)] - PATH[max(i - 1, 0)]
        theta[k] = np.arctan2(step[1], step[0])
    return theta


@pytest.mark.parametrize(("own", "contour"), [(1.0, 0.0), (0.4, 1.2), (0.0, 1.0)])
def test_the_printed_equations_give_the_same_inputs(own, contour):
    theta, gamma, lead = angles(), 0.7, 2
    u, worst = np.zeros((N, 2)), []
    for _ in range(TRIALS):
        e = PATH - plays(u)
        worst.append(np.max(np.abs(e[1:]), axis=0))
        eps = -np.sin(theta) * e[:, 0] + np.cos(theta) * e[:, 1]
        seen = own * e + contour * np.stack([-np.sin(theta) * eps, np.cos(theta) * eps], axis=1)
        step = np.zeros((N, 2))
        step[: N - lead] = gamma * seen[1 + lead :]
        u += step
    scheme = CrossCoupled(PIDType(gamma_p=gamma, lead=lead), contour=contour, own=own)
    history = learn(MACHINE, scheme, TASK, TRIALS)
    np.testing.assert_allclose(history.memory.u, u, **ALGEBRA)
    np.testing.assert_allclose(history.max_error, worst, **ALGEBRA)


def test_in_space_what_is_left_is_the_cross_product_with_the_direction():
    s = np.linspace(0, 4, 41)
    path = np.stack([np.sin(s), np.cos(2 * s), 0.3 * s**2], axis=1)
    e = np.random.default_rng(3).standard_normal(path.shape)
    direction = path[2:] - path[:-2]
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    expected = np.cross(np.cross(direction, e[1:-1]), direction)
    np.testing.assert_allclose(across(e, path)[1:-1], expected, **ALGEBRA)


def test_a_path_at_rest_keeps_its_direction_and_one_that_never_moves_has_none():
    still = np.repeat([[0.0, 0.0], [3.0, 4.0], [3.0, 5.0]], [5, 6, 4], axis=0)
    still += 1e-12 * np.random.default_rng(0).standard_normal(still.shape)  # no direction
    t = np.asarray(jax.jit(tangents)(still))
    np.testing.assert_allclose(t[[0, 3, 4, 5, 9]], np.tile([0.6, 0.8], (5, 1)), atol=1e-9)
    np.testing.assert_allclose(t[[10, 11, 14]], np.tile([0.0, 1.0], (3, 1)), atol=1e-9)
    e = np.random.default_rng(1).standard_normal((7, 2))
    np.testing.assert_array_equal(jax.jit(across)(e, np.ones((7, 2))), e)


@pytest.mark.thorough
def test_without_its_own_part_what_lies_along_the_path_stays():
    """A lag of s along the path leaves a contour error of s^2 / (2 R) that the law does not see."""
    plants = [DifferenceEquation((a,), (1 - a,), dt=DT) for a in (0.2, 0.4)]
    machine, law = Machine(TwoAxes(*plants)), PIDType(gamma_p=0.8)
    late = law.initial_memory(TASK)._replace(u=jnp.asarray(np.roll(PATH[1:], 1, axis=0)))
    save = contour_metrics(TASK)["contour_max"]
    own, contour = (
        learn(machine, one, TASK, 30, memory=late, save=save)
        for one in (law, CrossCoupled(law, contour=1.0, own=0.0))
    )
    lag = np.max(np.linalg.norm(contour.final.e, axis=1))
    assert lag > 0.14  # the longest step of the path
    assert np.max(np.abs(across(contour.final.e, PATH))) < 1e-6
    assert 0.01 < contour.saved[-1] < lag**2 / (2 * 0.36)  # 0.36 is the smallest radius
    assert own.saved[-1] < 1e-5


@pytest.mark.thorough
def test_a_certificate_counts_what_lies_along_the_path():
    """Without a part of its own, learning converges where it acts, and leaves a lag along the path.

    That is what the dense map of the inputs that the law moves shows.
    """
    task = Task(PATH[:31], dt=DT)
    n, G = 2 * task.N, lifted(AXES, task.N)
    t = np.asarray(tangents(task.reference))[1:]
    for own, contour in ((0.5, 1.0), (0.0, 1.0)):
        L = np.zeros((n, n))
        for k in range(task.N):
            across_it = np.eye(2) - np.outer(t[k], t[k])
            L[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = 0.9 * (own * np.eye(2) + contour * across_it)
        M = np.eye(n) - L @ G
        V, values, _ = np.linalg.svd(L)
        V = V[:, values > 1e-9]
        assert V.shape[1] == (n if own else n // 2)
        assert (np.max(np.abs(np.linalg.eigvals(M))) < 1 - 1e-9) == bool(own)
        assert np.max(np.abs(np.linalg.eigvals(V.T @ M @ V))) < 1 - 1e-9
        scheme = CrossCoupled(PIDType(gamma_p=0.9), contour=contour, own=own)
        found = certify(MACHINE, scheme, task, 5, {}, {})
        assert found.claim[0] in ("converges", "monotone")
        assert found.broken_promises().size == 0
        left = np.sqrt(np.mean(np.square(learn(MACHINE, scheme, task, 400).final.e[1:])))
        np.testing.assert_allclose(found.floor[0], left, rtol=1e-6, atol=1e-9)
        assert (found.floor[0] > 1e-3) == (own == 0)


def test_a_path_of_one_axis_is_refused():
    with pytest.raises(ValueError, match="1 outputs; allowed are the 2 or 3 axes"):
        CrossCoupled(PIDType()).check(Task(PATH[:, 0], dt=DT))


@pytest.mark.thorough
def test_a_law_with_a_model_minimises_the_error_that_it_is_shown():
    task = Task(PATH[6:27] - PATH[6], dt=DT)
    scheme = CrossCoupled(NormOptimal(AXES, w_s=0.05), own=0.2, contour=1.0)
    found = learn(Machine(AXES), scheme, task, 2).memory.u
    n = task.N
    H, W = lifted(AXES, n), np.zeros((2 * n, 2 * n))
    t = np.asarray(tangents(task.reference))[1:]
    for k in range(n):
        W[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = 1.2 * np.eye(2) - np.outer(t[k], t[k])
    Q = W.T @ W
    cost = H.T @ Q @ H + 0.05 * np.eye(2 * n)
    expected = np.linalg.solve(cost, H.T @ Q @ np.asarray(task.reference)[1:].ravel())
    np.testing.assert_allclose(np.asarray(found).ravel(), expected, rtol=1e-7, atol=1e-9)
