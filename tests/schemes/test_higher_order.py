"""Higher-order learning is compared with a scalar loop.

Its errors are compared with their recursion along the trials.
"""

import numpy as np
import pytest
from cases import ALGEBRA, ARX, DT

from jaxilc.learning import Machine, learn
from jaxilc.plants import DifferenceEquation, StateSpace
from jaxilc.schemes import HigherOrder, PIDType
from jaxilc.signals import Task

N = 40
R = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(N + 1) / N) + 0.05 * np.sin(1.3 * np.arange(N + 1))
TASK = Task(R, dt=DT)
SERVO = Machine(DifferenceEquation(*ARX, dt=DT))
TWO = Machine(StateSpace([[0.7, 0.1], [0.0, 0.5]], [[0.3, 0.0], [0.1, 0.5]], np.eye(2), dt=DT))
TASK_2 = Task(np.stack([R, R[::-1]], axis=1), dt=DT)


def run(machine, scheme, trials, task=TASK):
    """Return outputs (J, N+1, n) and inputs (J, N, n)."""
    return tuple(map(np.asarray, learn(machine, scheme, task, trials, save=everything).saved))


def everything(trial):
    return trial.y, trial.u


class HigherOrderLoop:
    def __init__(self, alpha, gamma, lead=0, limit=np.inf):
        self.alpha, self.gamma, self.lead, self.limit = alpha, gamma, lead, limit

    def trials(self, a, b, trials):
        """Return outputs (J, N+1) and inputs (J, N), computed sample by sample."""
        Y, U = np.zeros((trials, N + 1)), np.zeros((trials, N))
        for j in range(trials):
            for k in range(N if j else 0):
                for i in range(len(self.alpha)):
                    if j - 1 - i >= 0:
                        at = k + 1 + self.lead
                        U[j, k] += self.alpha[i] * U[j - 1 - i, k] + self.gamma[i] * (
                            R[at] - Y[j - 1 - i, at] if at <= N else 0.0
                        )
                U[j, k] = min(max(U[j, k], -self.limit), self.limit)
            for k in range(N):
                for i in range(len(a)):
                    if k >= i:
                        Y[j, k + 1] += a[i] * Y[j, k - i] + b[i] * U[j, k - i]
        return Y, U


ORDERS = {
    "one": {"alpha": (1.0,), "gamma": (0.6,)},
    "two": {"alpha": (0.7, 0.3), "gamma": (0.6, -0.2)},
    "lead_limit": {"alpha": (1.5, -0.8, 0.3), "gamma": (0.6, -0.2, 0.1), "lead": 2, "limit": 0.3},
    "leaky": {"alpha": (0.5, 0.4), "gamma": (0.6, 0.3)},
}


@pytest.mark.parametrize("weights", ORDERS.values(), ids=ORDERS)
def test_higher_order(weights):
    Y, U = HigherOrderLoop(**weights).trials(*ARX, 6)
    y, u = run(SERVO, HigherOrder(**weights), 6)
    np.testing.assert_allclose(y[..., 0], Y, **ALGEBRA)
    np.testing.assert_allclose(u[..., 0], U, **ALGEBRA)
    assert np.max(np.abs(U)) > 0.2
    assert "limit" not in weights or 5 < np.sum(np.abs(U) == weights["limit"]) < U.size


def test_higher_order_takes_gains_for_each_channel():
    both = run(TWO, HigherOrder((1.0,), ((0.8, -0.2),)), 8, TASK_2)
    np.testing.assert_allclose(
        both[0], run(TWO, PIDType(gamma_p=(0.8, -0.2)), 8, TASK_2)[0], **ALGEBRA
    )


def test_higher_order_converges_as_its_characteristic_roots_say():
    """Higher-order learning converges as its characteristic roots say.

    On y[k+1] = u[k] every sample obeys e_{j+1} = sum_i (alpha_i - gamma_i) e_{j-i}. Where all of
    these coefficients are zero, learning is deadbeat.
    """
    machine, e_1 = Machine(StateSpace([[0.0]], [[1.0]], [[1.0]], dt=DT)), R[1:, None]
    for alpha, gamma in (
        ((0.8, 0.2), (0.5, 0.1)),
        ((0.8, 0.2), (0.8, 0.2)),
        ((0.8, 0.2), (-0.4, 0.1)),
    ):
        y, _ = run(machine, HigherOrder(alpha, gamma), 30)
        step = np.array([[alpha[0] - gamma[0], alpha[1] - gamma[1]], [1.0, 0.0]])
        # u_1 is zero, and so is the input before it.
        e = [e_1, alpha[0] * e_1 - gamma[0] * e_1 + (1 - alpha[0]) * e_1]
        for _ in range(28):
            e.append(step[0, 0] * e[-1] + step[0, 1] * e[-2])
        np.testing.assert_allclose(R[1:, None] - y[:, 1:], e, rtol=1e-8, atol=1e-12)
        assert (np.max(np.abs(e[-1])) < 1e-3) == (np.max(np.abs(np.linalg.eigvals(step))) < 1)


ERRORS = {
    "no_order": (
        lambda: HigherOrder((), ()),
        r"HigherOrder: alpha \(0,\) and gamma \(0,\) do not fit",
    ),
    "orders": (
        lambda: HigherOrder((0.5, 0.5), (1.0,)),
        r"alpha \(2,\) and gamma \(1,\) do not fit",
    ),
    "sum": (
        lambda: HigherOrder((0.8, 0.3), (1.0, 1.0)),
        r"sum of alpha = 1.1 is outside its allowed range \(0, 1\]",
    ),
    "sum_zero": (
        lambda: HigherOrder((0.5, -0.5), (1.0, 1.0)),
        r"sum of alpha = 0 is outside its allowed range \(0, 1\]",
    ),
    "lead": (lambda: HigherOrder(lead=N), f"HigherOrder: lead = {N} is outside"),
}


@pytest.mark.parametrize(("build", "message"), ERRORS.values(), ids=ERRORS)
def test_what_cannot_be_done_is_named(build, message):
    with pytest.raises(ValueError, match=message):
        build().check(TASK)
