"""Norm-optimal learning is compared with independent computations.

These are its dense equation in NumPy, closed forms, finite differences, and a measurement of its
RAM.
"""

import dataclasses

import jax
import numpy as np
import pytest
from cases import DT, PLANTS
from dense import lifted, relative
from refusals import refused

from jaxilc.learning import Machine, learn
from jaxilc.plants import StateSpace, TimeVaryingStateSpace
from jaxilc.schemes import NormOptimal
from jaxilc.schemes.norm_optimal import LARGEST_LIFTED
from jaxilc.signals import Task

N, TRIALS = 24, 5
RANDOM = np.random.default_rng(5)
MODEL = StateSpace(
    [[0.8, 0.3, 0.0], [-0.3, 0.7, 0.1], [0.1, 0.0, 0.5]],
    [[0.2, 0.0], [0.1, 0.3], [0.0, 1.0]],
    [[1.0, 0.2, 0.0], [0.1, 0.5, 0.4]],
    dt=DT,
)
REFERENCE = np.cumsum(RANDOM.standard_normal((N + 1, 2)), axis=0) * 0.3
TASK = Task(REFERENCE, dt=DT)


def wandering(model, size):
    """Return a time-varying system that differs a little from a constant one."""
    A, B, C = (
        np.asarray(M) * (1 + size * RANDOM.standard_normal((N, *M.shape)))
        for M in (model.A, model.B, model.C)
    )
    return TimeVaryingStateSpace(A, B, C, dt=DT)


MACHINE = Machine(wandering(StateSpace(0.95 * MODEL.A, 1.2 * MODEL.B, MODEL.C, dt=DT), 0.05))
MODELS = {"invariant": MODEL, "varying": wandering(MODEL, 0.1)}
WEIGHTS = {
    "scalar": {"w_q": 2.0, "w_r": 0.05, "w_s": 0.01},
    "diagonal": {"w_q": (2.0, 0.5), "w_r": (0.05, 0.2), "w_s": (0.01, 0.0)},
    "full": {
        "w_q": ((2.0, -0.6), (-0.6, 0.9)),
        "w_r": ((0.1, 0.04), (0.04, 0.05)),
        "w_s": ((0.02, -0.01), (-0.01, 0.01)),
    },
}


def next_input(scheme, H, e, u):
    """Return the equation of norm-optimal learning (MILC 2024, eq. 7 and 8), in lifted matrices."""
    n_u, n_y = scheme.model.n_u, scheme.model.n_y
    per_sample = ((scheme.w_q, n_y), (scheme.w_r, n_u), (scheme.w_s, n_u))
    Q, R, S = (np.kron(np.eye(N), w if w.ndim == 2 else w * np.eye(n)) for w, n in per_sample)
    new = np.linalg.solve(H.T @ Q @ H + S + R, (H.T @ Q @ H + R) @ u.ravel() + H.T @ Q @ e.ravel())
    return new.reshape(u.shape)


def signals(trial):
    return trial.e[1:], trial.u


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("kind", "weights"),
    [
        ("invariant", "scalar"),
        ("invariant", "diagonal"),
        ("invariant", "full"),
        ("varying", "full"),
    ],
)
def test_riccati_is_lifted_is_the_equation(kind, weights):
    model = MODELS[kind]
    H, inputs = lifted(model, N), {}
    for form in ("riccati", "lifted"):
        scheme = NormOptimal(model, **WEIGHTS[weights], form=form)
        history = learn(MACHINE, scheme, TASK, TRIALS, save=signals)
        e, u = map(np.asarray, history.saved)
        np.testing.assert_array_equal(u[0], 0.0)
        for j in range(TRIALS - 1):
            assert relative(u[j + 1], next_input(scheme, H, e[j], u[j])) < 1e-9
        assert relative(history.memory.u, next_input(scheme, H, e[-1], u[-1])) < 1e-9
        assert (
            relative(lifted(MACHINE.plant, N) @ u[-1].ravel(), (REFERENCE[1:] - e[-1]).ravel())
            < 1e-12
        )
        inputs[form] = u
    assert relative(inputs["riccati"], inputs["lifted"]) < 1e-9
    assert np.linalg.norm(e[-1]) < 0.3 * np.linalg.norm(e[0])
    assert relative(H, lifted(MACHINE.plant, N)) > 0.1, "the model should be wrong"


@pytest.mark.parametrize("w_r", [1e-3, 1e-6, 1e-9])
def test_small_weights_cost_the_recursion_no_digits(w_r):
    """Where the equation is badly conditioned, both forms lose the same digits, and no more."""
    schemes = [NormOptimal(MODEL, w_q=1.0, w_r=w_r, form=form) for form in ("riccati", "lifted")]
    found = [np.asarray(learn(Machine(MODEL), scheme, TASK, 3).memory.u) for scheme in schemes]
    assert relative(*found) < 1e-15 * np.linalg.cond(lifted(MODEL, N)) ** 2 + 1e-12


@pytest.mark.thorough
@pytest.mark.parametrize("form", ["riccati", "lifted"])
def test_a_limit_is_respected_and_learning_goes_on(form):
    free = np.asarray(
        learn(
            MACHINE, NormOptimal(MODEL, **WEIGHTS["scalar"], form=form), TASK, TRIALS, save=signals
        ).saved[1]
    )
    limit = 0.6 * np.max(np.abs(free[-1]), axis=0)
    scheme = NormOptimal(MODEL, **WEIGHTS["scalar"], limit=limit, form=form)
    e, u = map(np.asarray, learn(MACHINE, scheme, TASK, TRIALS, save=signals).saved)
    H = lifted(MODEL, N)
    for j in range(TRIALS - 1):
        np.testing.assert_allclose(
            u[j + 1], np.clip(next_input(scheme, H, e[j], u[j]), -limit, limit), atol=1e-9
        )
    at_limit = np.abs(u[-1]) == limit
    assert np.all(at_limit.any(axis=0))
    assert np.mean(at_limit) < 0.5
    assert np.linalg.norm(e[-1]) < 0.5 * np.linalg.norm(e[0])
    assert np.max(np.abs(u[-1] - u[1])[~at_limit]) > 0.05 * np.max(limit), (
        "what is not at the limit should go on learning"
    )


@pytest.mark.thorough
def test_without_a_weight_on_the_change_one_trial_is_enough():
    """With w_r = 0 and the right model, u_2 = (H' W_q H + W_s)^-1 H' W_q r, and it stays there.

    With w_r > 0 learning ends at the same input.
    """
    H, r = lifted(MODEL, N), REFERENCE[1:].ravel()
    scheme = NormOptimal(MODEL, w_q=2.0, w_s=0.3)
    best = np.linalg.solve(2.0 * H.T @ H + 0.3 * np.eye(2 * N), 2.0 * H.T @ r)
    u = np.asarray(learn(Machine(MODEL), scheme, TASK, 3, save=signals).saved[1]).reshape(3, -1)
    np.testing.assert_allclose(u[1:], [best, best], rtol=1e-9, atol=1e-12)
    u = learn(Machine(MODEL), dataclasses.replace(scheme, w_r=0.2), TASK, 99).memory.u
    np.testing.assert_allclose(np.ravel(u), best, rtol=1e-9, atol=1e-12)


@pytest.mark.thorough
def test_memory_of_the_recursion_is_linear_in_the_length_of_the_trial():
    def temporaries(form, N):
        task, scheme = Task(np.zeros((N + 1, 2)), dt=DT), NormOptimal(MODEL, w_r=0.1, form=form)
        program = (
            jax.jit(lambda scheme, task: learn(Machine(MODEL), scheme, task, 3))
            .lower(scheme, task)
            .compile()
        )
        return program.memory_analysis().temp_size_in_bytes

    short, long = (temporaries("riccati", N) for N in (4000, 16000))
    np.testing.assert_allclose(long / short, 4.0, rtol=0.02)
    assert short / 4000 < 1000, "bytes a sample"
    assert temporaries("lifted", 500) / temporaries("lifted", 250) > 3.5


UNSTABLE = StateSpace(1.3 * MODEL.A, MODEL.B, MODEL.C, dt=DT)
RISING = StateSpace([[0.2]], [[1.0]], [[1.0]])
BAD = {
    r"NormOptimal: w_q has shape \(3,\); allowed are \(\), \(2,\) and \(2, 2\)": {
        "w_q": (1.0, 1.0, 1.0)
    },
    r"NormOptimal: w_s = \[\[1.0, 0.1\], \[0.2, 1.0\]\] is not symmetric": {
        "w_s": ((1.0, 0.1), (0.2, 1.0))
    },
    r"NormOptimal: w_q has the eigenvalues \[-1.  3.\]; allowed are none below 0": {
        "w_q": ((1.0, 2.0), (2.0, 1.0))
    },
    r"NormOptimal: w_s has the eigenvalues \[-0.1 -0.1\]": {"w_s": -0.1, "w_r": 1.0},
    r"NormOptimal: w_r \+ w_s has the eigenvalues \[0. 0.\]; allowed are positive ones only": {},
    r"NormOptimal: w_r \+ w_s has the eigenvalues \[0. 1.\]": {"w_r": (0.0, 1.0)},
    "NormOptimal: model is a DifferenceEquation; allowed are StateSpace and TimeVaryingStateSpace": {  # noqa: E501
        "model": PLANTS["arx"],
        "w_r": 1.0,
    },
    r"NormOptimal: the model is unstable \(a pole 0.0\d+ outside the unit circle\)": {
        "model": UNSTABLE,
        "w_r": 1.0,
    },
    r"NormOptimal: the model is unstable \(a pole 0.2 right of the imaginary axis\)": {
        "model": RISING,
        "w_r": 1.0,
    },
}
test_bad_weights_and_models_are_named = refused(
    BAD, lambda given: NormOptimal(**{"model": MODEL} | given)
)


@pytest.mark.thorough
@pytest.mark.parametrize("precision", [np.float32, np.float64])
def test_a_weight_is_symmetric_up_to_rounding(precision):
    """A congruence T' D T is symmetric in exact arithmetic only; its symmetric part is used."""
    rng, turned = np.random.default_rng(2), []
    while len(turned) < 20:
        T, D = (
            rng.standard_normal((2, 2)).astype(precision),
            np.diag(rng.uniform(0.0, 3.0, 2)).astype(precision),
        )
        W = (T.T @ D) @ T
        turned += [W] if np.any(W != W.T) else []
    for W in turned:
        NormOptimal(MODEL, w_q=W, w_r=W, w_s=0.1)
    W = turned[0].astype(float)
    ours = [
        learn(Machine(MODEL), NormOptimal(MODEL, w_q=V, w_r=V, w_s=0.1), TASK, 3).memory.u
        for V in (W, (W + W.T) / 2)
    ]
    np.testing.assert_array_equal(*ours)


LONG = Task(np.zeros((LARGEST_LIFTED // 2 + 2, 2)), dt=DT)
MISFITS = {
    "StateSpace is sampled at 0.001 s but the task at 0.002 s": (
        {},
        dataclasses.replace(TASK, dt=2e-3),
    ),
    "NormOptimal: the model has 2 inputs but the task 1": ({}, Task(REFERENCE, dt=DT, inputs=1)),
    "NormOptimal: the model has 2 outputs but the task 1": (
        {},
        Task(REFERENCE[:, 0], dt=DT, inputs=2),
    ),
    "NormOptimal: the model is given for N = 24 samples but the task has N = 23": (
        {"model": MODELS["varying"]},
        Task(REFERENCE[:-1], dt=DT),
    ),
    f"'lifted' would need a dense matrix of {LARGEST_LIFTED + 2} rows .* allowed are {LARGEST_LIFTED}: use form = 'riccati'": (  # noqa: E501
        {"form": "lifted"},
        LONG,
    ),
}
test_a_model_that_does_not_fit_the_task_is_refused = refused(
    MISFITS, lambda given: NormOptimal(**{"model": MODEL, "w_r": 1.0} | given[0]).check(given[1])
)


@pytest.mark.thorough
def test_a_continuous_model_is_sampled_with_the_task():
    """A continuous model is sampled with the task, and equals a discrete one that scipy sampled."""
    import scipy.signal

    A, B, C = (
        np.array([[-50.0, 20.0], [5.0, -90.0]]),
        np.array([[50.0], [30.0]]),
        np.array([[1.0, 0.3]]),
    )
    discrete = scipy.signal.cont2discrete((A, B, C, 0.0), DT)
    task = Task(REFERENCE[:, 0], dt=DT)
    machine = Machine(StateSpace(0.9 * discrete[0], discrete[1], C, dt=DT))
    found = [
        learn(machine, NormOptimal(model, w_r=0.01), task, 3).memory.u
        for model in (StateSpace(A, B, C), StateSpace(*discrete[:3], dt=DT))
    ]
    assert relative(*map(np.asarray, found)) < 1e-10


TALL = StateSpace(MODEL.A, np.asarray(MODEL.B)[:, :1], MODEL.C, dt=DT)


@pytest.mark.parametrize("form", ["riccati", "lifted"])
def test_models_need_not_be_square(form):
    """One input with two outputs, and three, of which LAPACK makes the inverse."""
    wide = StateSpace(
        MODEL.A, np.hstack([np.asarray(MODEL.B), [[0.3], [-0.2], [0.1]]]), MODEL.C, dt=DT
    )
    for model in (TALL, wide):
        scheme, task = (
            NormOptimal(model, w_q=2.0, w_r=0.1, w_s=0.02, form=form),
            Task(REFERENCE, dt=DT, inputs=model.n_u),
        )
        e, u = map(np.asarray, learn(Machine(model), scheme, task, 3, save=signals).saved)
        assert relative(u[2], next_input(scheme, lifted(model, N), e[1], u[1])) < 1e-9


@pytest.mark.thorough
def test_known_weights_are_looked_at_within_a_transformation_too():
    learned = jax.jit(lambda gain: gain * learn(MACHINE, NormOptimal(MODEL, w_r=0.1), TASK, 3).rms)
    np.testing.assert_allclose(
        learned(2.0), 2.0 * learn(MACHINE, NormOptimal(MODEL, w_r=0.1), TASK, 3).rms, rtol=1e-10
    )
    with pytest.raises(ValueError, match=r"NormOptimal: w_r \+ w_s has the eigenvalues"):
        jax.jit(lambda gain: gain * learn(MACHINE, NormOptimal(MODEL), TASK, 3).rms)(2.0)
