"""Constrained norm-optimal learning is compared with an independent solver.

This is least distance programming by non-negative least squares (Lawson and Hanson 1974), on dense
matrices that NumPy makes from the definitions.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
import scipy.optimize
import scipy.signal
from cases import DT
from dense import lifted
from refusals import refused

from jaxilc.learning import Machine, learn
from jaxilc.plants import StateSpace
from jaxilc.schemes import PID, ConstrainedNormOptimal, NormOptimal, OnOutputs, WithFeedback
from jaxilc.signals import Task
from jaxilc.signals.task import Trial
from jaxilc.theory.certificates import long_run

N, PROBLEMS = 14, 12
NAMES = ("input", "rate", "total", "y_high", "y_low", "contour")


@jax.jit
def learned(scheme, memory, r, y, u, beside):
    return scheme.learn(memory, Trial(r, y, u, DT, {"beside": beside}))


batched = jax.jit(jax.vmap(learned.__wrapped__))


def walk(rng, *shape):
    path = np.cumsum(rng.standard_normal(shape), axis=0)
    return path - path[0]


def problem(seed, n, size):
    """Return a scheme and a trial whose bounds are met by some input, and tight around it."""
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((n, n))
    A *= 0.9 / np.max(np.abs(np.linalg.eigvals(A)))
    model = StateSpace(A, rng.standard_normal((n, size)), rng.standard_normal((size, n)), dt=DT)
    F = 0.2 * rng.standard_normal((size, n))
    r, y = walk(rng, N + 1, size), 0.3 * walk(rng, N + 1, size)
    u, beside = 0.1 * rng.standard_normal((2, N, size))
    # an input that shall be within the bounds
    some = 0.15 * walk(rng, N, size)
    change = (some - u).ravel()
    total = some + beside
    total[1:] += (lifted(model, N, F) @ change).reshape(N, size)[:-1]
    out = y[1:] + (lifted(model, N) @ change).reshape(N, size)
    if size == 2:  # close to the path, so that a bound across it is tight
        r[1:] = out + 0.2 * rng.standard_normal((N, size))
    room = rng.uniform(0.05, 2.0, (2, N, size))
    low, high = np.full((2, N + 1, size), [[[-10.0]], [[10.0]]])
    low[1:], high[1:] = np.where(rng.random((N, size)) < 0.3, -np.inf, out - room[0]), out + room[1]
    slack = rng.uniform(1.02, 1.5, 3)
    bounds = {
        "limit": slack[0] * np.max(np.abs(some), axis=0),
        "rate": slack[1] * np.max(np.abs(np.diff(some, axis=0, prepend=0.0)), axis=0) / DT,
        "total": slack[2] * np.max(np.abs(total), axis=0),
        "y_low": low,
        "y_high": high,
    }
    if size == 2:
        off = np.sum(normals(r)[1:] * (out - r[1:]), axis=1)
        bounds["contour"] = 1.02 * np.max(np.abs(off))
    weights = {
        "w_q": rng.uniform(0.5, 5.0) if size == 1 else rng.uniform(0.01, 0.5),
        "w_r": 10 ** rng.uniform(-3, 0),
        "w_s": 10 ** rng.uniform(-4, -1),
        "w_d": rng.uniform(0.0, 0.1),
        "step": rng.uniform(0.4, 1.0),
    }
    scheme = ConstrainedNormOptimal(model, **weights, **bounds, feedback=F)
    scheme.check(Task(r, dt=DT))
    return scheme, (r, y, u, beside)


def normals(r):
    along = np.vstack([r[1] - r[0], r[2:] - r[:-2], r[-1] - r[-2]])
    return np.stack([-along[:, 1], along[:, 0]], axis=1) / np.linalg.norm(along, axis=1)[:, None]


def dense(scheme, trial):
    """Return P, q, c, G, h, and the rows of G of each bound: x'P x/2 + q'x + c with G x <= h."""
    r, y, u, beside = trial
    model, size = scheme.model, u.shape[1]
    H, eye = lifted(model, N), np.eye(N * size)
    D = eye - np.eye(N * size, k=-size)
    total = eye.copy()
    total[size:] += lifted(model, N, scheme.feedback)[:-size]
    e, v = (r - y)[1:].ravel(), u.ravel()
    P = scheme.w_q * H.T @ H + (scheme.w_r + scheme.w_s) * eye + scheme.w_d * D.T @ D
    q = scheme.step * (-scheme.w_q * H.T @ e + scheme.w_s * v + scheme.w_d * D.T @ D @ v)
    cost = scheme.w_q * e @ e + scheme.w_s * v @ v + scheme.w_d * v @ D.T @ D @ v
    bounds = {
        "input": (eye, v, scheme.limit),
        "rate": (D, D @ v, scheme.rate * DT),
        "total": (total, v + beside.ravel(), scheme.total),
    }
    if scheme.contour is not None:
        across = scipy.linalg.block_diag(*normals(r)[1:, None])
        bounds["contour"] = (across @ H, -across @ e, scheme.contour)
    rows = {}
    for name, (M, now, most) in bounds.items():
        most = np.broadcast_to(most, (N, size)).ravel()[: len(M)]
        rows[name] = np.vstack([M, -M]), np.concatenate([most - now, most + now])
    rows["y_high"] = H, (scheme.y_high - y)[1:].ravel()
    there = np.isfinite(scheme.y_low[1:]).ravel()
    rows["y_low"] = -H[there], (y - scheme.y_low)[1:].ravel()[there]
    return P, q, scheme.step * cost / 2, rows


def least_distance(P, q, G, h):
    """Return the x that minimises x'P x/2 + q'x subject to G x <= h."""
    L = np.linalg.cholesky(P)
    still = np.linalg.solve(L, q)
    M = -np.linalg.solve(L, G.T).T
    E = np.vstack([M.T, -h + M @ still])
    f = np.append(np.zeros(len(P)), 1.0)
    u, _ = scipy.optimize.nnls(E, f, maxiter=10_000)
    residual = E @ u - f
    return np.linalg.solve(L.T, -residual[:-1] / residual[-1] - still)


def stacked(several):
    return jax.tree.map(lambda *leaves: np.stack(leaves), *several)


@pytest.mark.thorough(but=["4-2"])
@pytest.mark.parametrize(("n", "size"), [(3, 1), (4, 2)])
def test_the_optimum_is_that_of_another_solver(n, size):
    problems = [problem(seed, n, size) for seed in range(PROBLEMS)]
    memory = problems[0][0].initial_memory(Task(problems[0][1][0], dt=DT))
    memories = stacked([memory] * PROBLEMS)
    found = batched(
        stacked([one for one, _ in problems]), memories, *stacked([trial for _, trial in problems])
    )
    np.testing.assert_array_equal(found.converged, 1.0)
    np.testing.assert_array_equal(found.unsolved, 0.0)
    met = dict.fromkeys(NAMES[: 4 + size], 0)
    for i, (scheme, trial) in enumerate(problems):
        P, q, constant, rows = dense(scheme, trial)
        G, h = (np.concatenate(parts) for parts in zip(*rows.values(), strict=True))
        best = least_distance(P, q, G, h)
        x = (np.asarray(found.u[i]) - trial[2]).ravel()
        costs = [x @ P @ x / 2 + q @ x + constant for x in (x, best)]
        assert abs(costs[0] / costs[1] - 1) < 1e-8
        assert np.max(G @ x - h) < 1e-9
        np.testing.assert_allclose(x, best, atol=2e-4 * np.max(np.abs(best)))
        for name, (M, most) in rows.items():
            met[name] += np.sum(M @ best > most - 1e-7)
    assert all(met.values()), met


@pytest.mark.thorough
def test_what_cannot_be_met_is_flagged_and_spoils_no_other():
    """The output must be above 1e3, the input may not: the input stays, its derivative is zero."""
    problems = [problem(seed, 3, 1) for seed in range(PROBLEMS)]
    schemes, trials = stacked([one for one, _ in problems]), stacked([t for _, t in problems])
    memory = problems[0][0].initial_memory(Task(problems[0][1][0], dt=DT))
    memories = stacked([memory] * PROBLEMS)._replace(u=np.full((PROBLEMS, N, 1), 0.01))
    low, high = (np.array(getattr(problems[4][0], name)) for name in ("y_low", "y_high"))
    low[7], high[7] = 1e3, 1e4
    worse = [one for one, _ in problems]
    worse[4] = dataclasses.replace(worse[4], y_low=low, y_high=high)
    bad = stacked(worse)
    alone, together = batched(schemes, memories, *trials), batched(bad, memories, *trials)
    others = np.arange(PROBLEMS) != 4
    for one, other in zip(alone, together, strict=True):
        np.testing.assert_array_equal(np.asarray(one)[others], np.asarray(other)[others])
    np.testing.assert_array_equal(together.converged, np.where(others, 1.0, 0.0))
    np.testing.assert_array_equal(together.unsolved, np.where(others, 0.0, 1.0))
    np.testing.assert_array_equal(together.u[4], 0.01)
    assert together.violation[4] > 1e-3
    slope = jax.jit(jax.grad(lambda s: jnp.sum(batched(s, memories, *trials).u ** 2)))(bad).w_q
    assert np.all(np.isfinite(slope))
    assert slope[4] == 0.0
    assert np.all(np.asarray(slope)[others] != 0.0)


@jax.jit
@jax.vmap
def few_against_many(model, r, y, u):
    """Five samples of three inputs and two outputs, of which several bounds are active at once."""
    law = ConstrainedNormOptimal(model, w_r=1e-4, rate=0.3 / DT, contour=0.8, y_low=-0.8)
    memory = law.initial_memory(Task(r, dt=DT, inputs=3))
    return law.learn(memory, Trial(r, y, u, DT, {}))


@pytest.mark.thorough
def test_an_optimum_that_rounding_keeps_away_is_told_from_bounds_that_cannot_be_met():
    """`violation` is zero where SciPy's linear programme finds an input within all bounds."""
    rng, count = np.random.default_rng(0), 30
    A, B = 0.2 * rng.normal(size=(count, 2, 2)), 3 * rng.normal(size=(count, 2, 3))
    r, y = rng.normal(size=(2, count, 6, 2)) * [[[[1.0]]], [[[0.3]]]]
    r[:, 0] = y[:, 0] = 0
    u, C = 0.1 * rng.normal(size=(count, 5, 3)), rng.normal(size=(count, 2, 2))
    models = [StateSpace(*of, dt=DT) for of in zip(A, B, C, strict=True)]
    found, met = few_against_many(stacked(models), r, y, u), []
    for i, model in enumerate(models):
        H, D = lifted(model, 5), np.kron(np.eye(5) - np.eye(5, k=-1), np.eye(3))
        across = np.gradient(r[i], axis=0)[1:, ::-1] * [-1, 1]
        across /= np.linalg.norm(across, axis=1, keepdims=True)
        across = scipy.linalg.block_diag(*across[:, None])
        rows = np.vstack([D, -D, across @ H, -across @ H, -H])
        step, off = D @ u[i].ravel(), across @ (y - r)[i, 1:].ravel()
        room = np.concatenate(
            [0.3 - step, 0.3 + step, 0.8 - off, 0.8 + off, 0.8 + y[i, 1:].ravel()]
        )
        least = scipy.optimize.linprog(
            np.eye(16)[-1], np.hstack([rows, -np.ones((len(rows), 1))]), room,
            bounds=[(None, None)] * 15 + [(-1, None)],
        )  # fmt: skip
        met.append(least.fun < 0)
        assert np.all(rows @ (found.u - u)[i].ravel() <= room + 1e-7) or not found.converged[i]
    assert np.all(np.isfinite(found.gap))
    np.testing.assert_array_equal(found.violation < 1e-8, met)
    assert np.mean(found.converged[np.array(met)]) > 0.9


def test_derivatives_forwards_and_backwards_equal_differences():
    scheme, trial = problem(1, 4, 2)
    memory = scheme.initial_memory(Task(trial[0], dt=DT))
    rng = np.random.default_rng(8)
    toward = rng.standard_normal((N, 2))
    fields = ("w_q", "w_d", "limit", "rate", "total", "contour", "feedback", "y_high")
    at = {name: jnp.asarray(getattr(scheme, name)) for name in fields}
    way = {name: np.asarray(x) * rng.uniform(-1, 1, x.shape) for name, x in at.items()}

    def value(at):
        return jnp.sum(toward * learned(dataclasses.replace(scheme, **at), memory, *trial).u)

    @jax.jit
    def both_ways(at):
        found, forwards = jax.linearize(value, at)
        return found, forwards(way), jax.linear_transpose(forwards, at)(1.0)[0]

    _, forwards, gradient = both_ways(at)
    backwards = sum(np.sum(gradient[name] * way[name]) for name in fields)
    np.testing.assert_allclose(forwards, backwards, rtol=2e-6)
    near = [
        both_ways({name: at[name] + sign * 1e-6 * way[name] for name in fields})[0]
        for sign in (1, -1)
    ]
    np.testing.assert_allclose(forwards, (near[0] - near[1]) / 2e-6, rtol=1e-5)


@pytest.mark.thorough
def test_where_no_bound_matters_it_is_norm_optimal_learning():
    scheme, (r, y, u, beside) = problem(2, 4, 2)
    plain = {"w_d": None, "step": 1.0, "y_low": None, "y_high": None, "contour": None}
    free = dataclasses.replace(scheme, **plain, limit=None, rate=None, total=None)
    far = dataclasses.replace(free, limit=1e6, rate=1e9, total=1e6, tube=1e6)
    task = Task(r, dt=DT)
    by_recursion = NormOptimal(scheme.model, scheme.w_q, scheme.w_r, scheme.w_s)
    expected = by_recursion.learn(by_recursion.initial_memory(task), Trial(r, y, u, DT)).u
    for one in (free, far):
        found = learned(one, one.initial_memory(task), r, y, u, beside)
        np.testing.assert_allclose(found.u, expected, rtol=1e-9, atol=1e-11)
        assert found.converged == 1
        assert found.steps == 0


FIRST = StateSpace([[0.6]], [[0.4]], [[1.0]], dt=0.01)


def test_theory_claims_what_it_does_without_bounds_as_long_as_none_is_met():
    task = Task(np.sin(np.linspace(0, 3, 9)), dt=0.01)
    gains = np.array([0.3, 0.5])
    machines = jax.vmap(lambda b: Machine(StateSpace(FIRST.A, b[None, None], FIRST.C, dt=0.01)))(
        gains
    )
    scheme = ConstrainedNormOptimal(FIRST, w_r=0.2, w_s=0.01, limit=1.1)
    found = long_run(machines, scheme, task)
    assert found.claim.tolist() == ["not claimed", "monotone"]
    assert found.reason[0].startswith("limit is met in trial ")
    one = jax.tree.map(lambda leaf: leaf[1], machines)
    u = learn(one, scheme, task, 5, save=lambda trial: trial.u).saved[..., 0]
    far = np.linalg.norm(u - found.outlook.limit[1], axis=1)
    assert np.all(far[1:] < far[:-1])


SQUARE = StateSpace([[0.5, 0.1], [0.0, 0.6]], np.eye(2), np.eye(2), dt=DT)
PLANE = Task(np.zeros((N + 1, 2)), dt=DT)
LINE = Task(np.zeros(N + 1), dt=DT)
BAD = {
    r"ConstrainedNormOptimal: w_r \+ w_s has the eigenvalues": {"w_r": 0.0},
    r"ConstrainedNormOptimal: w_d has the eigenvalues \[-1.\]": {"w_d": -1.0},
    "ConstrainedNormOptimal: total needs feedback": {"total": 1.0},
    r"feedback has shape \(2,\); allowed is \(1, 1\)": {"feedback": (1.0, 2.0)},
    "contour is for a path of two outputs, but the model has 1": {"contour": 0.1},
    "the model is unstable": {"model": StateSpace([[1.2]], [[1.0]], [[1.0]], dt=DT)},
    "solved = 1 is a int; allowed is None": {"solved": 1},
    "y_low and y_high leave nothing of output 0 at sample 0, from 2 to 1; allowed": {
        "y_low": 2.0,
        "y_high": 1.0,
    },
    r"y_low and y_high are \[1, 2\] for output 0 at sample 0, but the model starts at 0": {
        "y_low": 1.0,
        "y_high": 2.0,
    },
    r"y_high has shape \(3,\); allowed are \(\), \(1,\) and \(15, 1\)": {"y_high": (1.0, 2.0, 3.0)},
    "the model has 2 inputs but the task 1": {"model": SQUARE},
}
SOUND = {"model": dataclasses.replace(FIRST, dt=DT), "w_r": 1.0}
test_bounds_that_cannot_be_are_named = refused(
    BAD, lambda given: ConstrainedNormOptimal(**SOUND | given).check(LINE)
)


def test_the_total_input_needs_a_feedback_around_the_scheme():
    scheme = ConstrainedNormOptimal(SQUARE, w_r=1.0, total=1.0, feedback=-0.1 * np.eye(2))
    with pytest.raises(ValueError, match="total bounds the input with that of a feedback"):
        scheme.learn(
            scheme.initial_memory(PLANE), Trial(*np.zeros((2, N + 1, 2)), np.zeros((N, 2)), DT)
        )
    whole = WithFeedback(scheme, OnOutputs(PID(kp=0.1), (0, 1)))
    trial = Trial(*np.zeros((2, N + 1, 2)), np.zeros((N, 2)), DT, {"feedback": np.ones((N, 2))})
    shown = whole.shown(trial)["learning"]
    np.testing.assert_array_equal(shown.signals["beside"], 1.0)
    np.testing.assert_array_equal(shown.u, -1.0)
