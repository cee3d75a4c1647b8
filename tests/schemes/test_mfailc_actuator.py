"""MFAILC is tested over an actuator that limits, slows and rounds.

It is compared with scalar loops over trials and samples, written from Cao 2019, eq. 25 and 27. Both
increments of the input, that of the last trial and that of this one, are of what the actuator
applied.
"""

import jax
import numpy as np
import pytest
from cases import ALGEBRA, ARX, DT

from jaxilc.learning import Actuator, Machine, learn, replay, run_trial
from jaxilc.plants import DifferenceEquation
from jaxilc.schemes import FFDLMFAILC, PFDLMFAILC, PID, OnOutputs, WithFeedback
from jaxilc.signals import Task
from jaxilc.tuning.objectives import Bounded

N, TRIALS, SETS = 40, 5, 12
R = 0.6 * np.sin(2 * np.pi * np.arange(N + 1) / N) + 0.2 * np.sin(0.9 * np.arange(N + 1))
TASK = Task(R, dt=DT)
WEIGHTS = {"lam": 0.05, "eta": 0.9, "mu": 0.02}
WINDOWS = {
    "pfdl": (0, 3, (0.2, 0.05, 0.02)),
    "ffdl": (2, 2, (0.5, -0.1, 0.2, 0.05)),
    "ffdl_long": (1, 3, (0.5, 0.2, 0.05, 0.02)),
}
KP = 0.4


def scheme_of(name, rho):
    L_y, L_u, phi0 = WINDOWS[name]
    windows = {"L_u": L_u} if L_y == 0 else {"L_y": L_y, "L_u": L_u}
    return (FFDLMFAILC if L_y else PFDLMFAILC)(
        phi0=phi0, rho=rho, reset="none", **WEIGHTS, **windows
    )


def actuator_of(rng):
    """Return an actuator with a limit, a rate limit and a resolution.

    At random, one of them, or none, is nearly without effect.
    """
    limit, rate, step = rng.uniform(0.4, 2.0), rng.uniform(100.0, 600.0), rng.uniform(1e-3, 0.2)
    absent = rng.integers(4)
    return {
        "limit": 1e6 if absent == 0 else limit,
        "rate": 1e9 if absent == 1 else rate,
        "resolution": 1e-9 if absent == 2 else step,
    }


def by_hand(name, rho, limit, rate, resolution, *, feedback=False):
    """Return outputs (J, N+1) and applied inputs (J, N).

    The learned part is the applied input minus the command of the feedback.
    """
    L_y, L_u, start = WINDOWS[name]
    (a, b), c = ARX, L_y
    Y, U, W = np.zeros((TRIALS + 1, N + 1)), np.zeros((TRIALS + 1, N)), np.zeros((TRIALS + 1, N))
    phi = np.tile(np.array(start), (N, 1))

    def before(X, j, k):
        return X[j, k] - X[j - 1, k] if k >= 0 else 0.0

    for j in range(1, TRIALS + 1):
        for k in range(N if j > 2 else 0):  # the estimates use the two trials before
            dh = np.array(
                [before(Y, j - 1, k - i) for i in range(L_y)]
                + [before(W, j - 1, k - i) for i in range(L_u)]
            )
            miss = before(Y, j - 1, k + 1) - phi[k] @ dh
            phi[k] = phi[k] + WEIGHTS["eta"] * dh / (WEIGHTS["mu"] + dh @ dh) * miss
        v = 0.0
        for k in range(N):
            command = 0.0
            if j > 1:
                bracket = rho[c] * (R[k + 1] - Y[j - 1, k + 1])
                bracket -= sum(rho[i] * phi[k, i] * before(Y, j, k - i) for i in range(L_y))
                bracket -= sum(
                    rho[c + i] * phi[k, c + i] * before(W, j, k - i) for i in range(1, L_u)
                )
                command = W[j - 1, k] + phi[k, c] / (WEIGHTS["lam"] + phi[k, c] ** 2) * bracket
            share = KP * (R[k] - Y[j, k]) if feedback else 0.0
            v = np.clip(v + np.clip(command + share - v, -rate * DT, rate * DT), -limit, limit)
            U[j, k] = np.clip(np.round(v / resolution) * resolution, -limit, limit)
            W[j, k] = U[j, k] - share
            Y[j, k + 1] = sum(
                a[i] * Y[j, k - i] + b[i] * U[j, k - i] for i in range(min(len(a), k + 1))
            )
    return Y[1:], U[1:]


def everything(trial):
    return trial.y[:, 0], trial.u[:, 0]


@pytest.mark.thorough(but=["ffdl-over_feedback"])
@pytest.mark.parametrize("feedback", [False, True], ids=["alone", "over_feedback"])
@pytest.mark.parametrize("name", WINDOWS)
def test_increments_are_of_what_the_actuator_applied(name, feedback):
    rng, acted = np.random.default_rng(5), 0
    for _ in range(SETS):
        rho, actuator = rng.uniform(0.4, 1.0, len(WINDOWS[name][2])), actuator_of(rng)
        scheme = scheme_of(name, rho)
        scheme = WithFeedback(scheme, PID(kp=KP)) if feedback else scheme
        plant = DifferenceEquation(*ARX, dt=DT)
        found = learn(
            Machine(plant, Actuator(**actuator)), scheme, TASK, TRIALS, save=everything
        ).saved
        expected = by_hand(name, rho, **actuator, feedback=feedback)
        for ours, theirs in zip(found, expected, strict=True):
            np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-9 * np.max(np.abs(theirs)))
        free = by_hand(name, rho, 1e6, 1e9, 1e-9, feedback=feedback)[1]
        acted += np.max(np.abs(free - expected[1])) > 0.01
    assert acted > SETS // 2, "most of the actuators change the input"


@pytest.mark.parametrize(
    "wrapped",
    [lambda s: OnOutputs(s, (0,)), lambda s: Bounded.around(s, TASK)],
    ids=["outputs", "bounded"],
)
def test_a_wrapper_hands_on_what_was_applied(wrapped):
    machine = Machine(
        DifferenceEquation(*ARX, dt=DT), Actuator(limit=0.5, rate=200.0, resolution=0.05)
    )
    scheme = scheme_of("ffdl", (0.9, 0.8, 0.7, 0.6))
    found, expected = (
        learn(machine, one, TASK, TRIALS, save=everything).saved
        for one in (wrapped(scheme), scheme)
    )
    for ours, theirs in zip(found, expected, strict=True):
        np.testing.assert_allclose(ours, theirs, **ALGEBRA)


def test_a_replay_knows_what_the_actuator_applied():
    machine = Machine(
        DifferenceEquation(*ARX, dt=DT), Actuator(limit=0.5, rate=200.0, resolution=0.05)
    )
    scheme = scheme_of("ffdl", (0.9, 0.8, 0.7, 0.6))
    memory = learn(machine, scheme, TASK, 3).memory
    trial = run_trial(machine, scheme, TASK, memory, jax.random.key(0))
    np.testing.assert_allclose(
        replay(scheme, TASK, memory, trial.y, machine.actuator)[0], trial.u, **ALGEBRA
    )
