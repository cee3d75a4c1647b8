"""Each scheme is compared with scalar loops over trials j and samples k.

The loops are written from the papers' equations.
"""

import math

import jax
import numpy as np
import pytest
import scipy.signal
from cases import ALGEBRA, ARX, DT, PRINTED, assert_close
from refusals import refused

from jaxilc.filters import ZeroPhaseButterworth, ZeroPhaseFIR
from jaxilc.learning import Actuator, Machine, learn, replay, run_trial
from jaxilc.plants import DifferenceEquation, StateSpace
from jaxilc.schemes import (
    CFDLMFAILC,
    FFDLMFAILC,
    PFDLMFAILC,
    PID,
    Filtered,
    HigherOrder,
    LearningFilter,
    OnOutputs,
    PIDType,
    RepetitiveControl,
    WithFeedback,
)
from jaxilc.signals import Task
from jaxilc.tuning.objectives import Bounded

N, TRIALS = 60, 6
R = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(N + 1) / N) + 0.05 * np.sin(1.3 * np.arange(N + 1))
# The plants have one order, so that a program is compiled once for both.
PLANTS = {"printed": PRINTED, "arx": tuple((*c, 0.0) for c in ARX)}
SIGN = {"printed": -1.0, "arx": 1.0}  # of the plant's gain


def everything(trial):
    return trial.y, trial.u


def machine_of(plant, **actuator):
    return Machine(
        DifferenceEquation(*PLANTS[plant], dt=DT), Actuator(**actuator) if actuator else None
    )


def run(plant, scheme, trials=TRIALS, **actuator):
    """Return outputs (J, N+1) and inputs (J, N) of the package."""
    history = learn(machine_of(plant, **actuator), scheme, Task(R, dt=DT), trials, save=everything)
    return tuple(np.asarray(signal)[..., 0] for signal in history.saved)


def loops(plant, learning=None, feedback=None, trials=TRIALS, applied=lambda k, u: u):
    """Return the same outputs and inputs by hand.

    Before trial j learning.prepare(j, Y, W) is called, and within it learning.input(k, j, Y, W) and
    feedback(k, e). applied(k, u) is what the actuator makes of a command.

    Row j of Y, U, W is trial j: outputs, applied inputs, and these less the share of the feedback.
    Row 0 is the state before the first trial.
    """
    a, b = PLANTS[plant]
    Y, U, W = np.zeros((trials + 1, N + 1)), np.zeros((trials + 1, N)), np.zeros((trials + 1, N))
    for j in range(1, trials + 1):
        if learning:
            learning.prepare(j, Y, W)
        for k in range(N):
            share = feedback(k, R[k] - Y[j, k]) if feedback else 0.0
            U[j, k] = applied(k, share + (learning.input(k, j, Y, W) if learning else 0.0))
            W[j, k] = U[j, k] - share
            for i in range(len(a)):
                Y[j, k + 1] += a[i] * Y[j, k - i] if k >= i else 0.0
                Y[j, k + 1] += b[i] * U[j, k - i] if k >= i else 0.0
    return Y[1:], U[1:]


def error(Y, j, k):
    """Return e(k, j), which is zero beyond the end of the trial."""
    return R[k] - Y[j, k] if k <= N else 0.0


def clip(u, limit):
    return u if limit is None else min(max(u, -limit), limit)


def pid(form, kp, ki, kd, tau=0.0, limit=None, kv=0.0, ka=0.0):
    """Return u = kp e + ki integral e dt + kd s + f.

    tau s' + s = e' is solved by the backward difference: tau (s - s_)/dt + s = (e - e_)/dt.

    f = kv r' + ka r'' uses central differences at the middle of the interval from k to k+1. Beyond
    its ends r is constant.
    """
    was = {}
    r = np.concatenate([R[:1], R, R[-1:]])  # r[k] is R[k-1]
    velocity = np.diff(R) / DT
    # This is (r[k+2] - r[k+1] - (r[k] - r[k-1])) / (2 dt^2).
    acceleration = (np.diff(r[2:]) - np.diff(r[:-2])) / (2 * DT**2)
    f = np.concatenate([kv * velocity + ka * acceleration, [0.0]])

    def feedback(k, e):
        e_, s_, u_, integral = (0.0, 0.0, 0.0, 0.0) if k == 0 else was["last"]
        s = (tau * s_ / DT + (e - e_) / DT) / (tau / DT + 1)
        if form == "increment":
            u = clip(
                u_ + kp * (e - e_) + ki * DT * e + kd * (s - s_) + f[k] - (f[k - 1] if k else 0.0),
                limit,
            )
        else:
            u = kp * e + (integral + ki * DT * e) + kd * s + f[k]
            winds_up = (
                limit is not None
                and abs(u) > limit
                and math.copysign(1, u) == math.copysign(1, ki * e)
                and ki * e != 0
            )
            integral = integral if winds_up else integral + ki * DT * e
            was["held"] = was.get("held", 0) + winds_up
            u = clip(kp * e + integral + kd * s + f[k], limit)
        was["last"] = (e, s, u, integral)
        return u

    feedback.was = was
    return feedback


class PIDTypeLoop:
    q = None

    def __init__(self, gamma_p=0.0, gamma_i=0.0, gamma_d=0.0, leak=0.0, lead=0, limit=None):
        self.weights, self.m, self.limit = (gamma_p, gamma_i, gamma_d, leak), lead, limit

    def prepare(self, j, Y, W):
        p, i, d, leak = self.weights
        self.u, total = np.zeros(N), 0.0
        for k in range(N if j > 1 else 0):
            ahead = error(Y, j - 1, k + 1 + self.m)
            # No difference extends beyond the end of the trial.
            difference = ahead - error(Y, j - 1, k + self.m) if k + 1 + self.m <= N else 0.0
            total += error(Y, j - 1, k + 1)
            self.u[k] = clip(
                (1 - leak) * W[j - 1, k] + p * ahead + i * total + d * difference, self.limit
            )
        self.u = self.q(self.u) if self.q else self.u

    def input(self, k, j, Y, W):
        return self.u[k]


class HigherOrderLoop:
    def __init__(self, alpha, gamma, lead=0, limit=None):
        self.weights, self.m, self.limit = (alpha, gamma), lead, limit

    def prepare(self, j, Y, W):
        """Nothing is known of the trials before the first one."""

    def input(self, k, j, Y, W):
        before = zip(range(j - 1, 0, -1), *self.weights, strict=False)
        terms = (a * W[i, k] + g * error(Y, i, k + 1 + self.m) for i, a, g in before)
        return clip(sum(terms), self.limit)


class MFAILCLoop:
    """MFAILC by Cao 2019, eq. 12 and 13, 25 and 27, with the reset of Dai 2014, eq. 12."""

    q = None

    def __init__(
        self, L_y, L_u, phi0, lam, rho, eta, mu, epsilon=1e-5, mode="book", lead=0, limit=None
    ):
        self.L, self.phi0, self.m, self.limit = (L_y, L_u), np.atleast_1d(phi0), lead, limit
        self.lam, self.rho, self.eta, self.mu = lam, np.broadcast_to(rho, L_y + L_u), eta, mu
        self.epsilon, self.mode = epsilon, mode
        self.phi = np.tile(self.phi0, (N, 1)).astype(float)
        self.resets = {"small phi": 0, "small du": 0, "sign": 0}

    def prepare(self, j, Y, W):
        L_y, L_u = self.L
        for k in range(N if j > 2 else 0):  # two trials are needed for the first increment
            if k + 1 + self.m > N:
                continue
            dy = [Y[j - 1, k - i] - Y[j - 2, k - i] if k >= i else 0.0 for i in range(L_y)]
            du = [W[j - 1, k - i] - W[j - 2, k - i] if k >= i else 0.0 for i in range(L_u)]
            dh, phi = np.array(dy + du), self.phi[k]
            target = Y[j - 1, k + 1 + self.m] - Y[j - 2, k + 1 + self.m]
            phi = phi + self.eta * dh / (self.mu + dh @ dh) * (target - phi @ dh)
            clauses = {
                "small phi": abs(phi[L_y]) <= self.epsilon,
                "sign": np.sign(phi[L_y]) != np.sign(self.phi0[L_y]),
            }
            if self.mode == "book":
                clauses["small du"] = abs(du[0]) <= self.epsilon
            if self.mode != "none" and any(clauses.values()):
                phi = self.phi0
            for name, fired in clauses.items():
                self.resets[name] += fired
            self.phi[k] = phi
        c = L_y
        gain = self.phi[:, c] / (self.lam + self.phi[:, c] ** 2)
        self.known = np.zeros(N)
        for k in range(N if j > 1 else 0):
            self.known[k] = W[j - 1, k] + gain[k] * self.rho[c] * error(Y, j - 1, k + 1 + self.m)
        self.known, self.gain = self.q(self.known) if self.q else self.known, gain

    def input(self, k, j, Y, W):
        L_y, L_u = self.L
        if j == 1:
            return 0.0
        total = 0.0
        for i in range(1, L_y + L_u + 1):  # the index of the papers
            of, at = (Y, k - i + 1) if i <= L_y else (W, k + L_y - i + 1)
            if i != L_y + 1 and at >= 0:
                total += self.rho[i - 1] * self.phi[k, i - 1] * (of[j, at] - of[j - 1, at])
        return clip(self.known[k] - self.gain[k] * total, self.limit)


def assert_equal(of_package, by_hand):
    for name, a, b in zip("yu", of_package, by_hand, strict=True):
        assert_close(a, b, name)
    assert np.max(np.abs(by_hand[0])) < 1e3
    assert np.max(np.abs(by_hand[1])) > 0.1


def assert_limit_acts(options, u):
    """A limit, where the options have one, acts at some samples, though not at all of them."""
    assert "limit" not in options or 5 < np.sum(np.abs(u) == options["limit"]) < u.size


PIDS = {
    "plain": {},
    "limited": {"limit": 0.5},
    "filtered_limited": {"tau": 2e-3, "limit": 0.5},
    "velocity": {"kv": 0.02},
    "velocity_acceleration_limited": {"kv": 0.02, "ka": -5e-5, "limit": 0.5},
    "acceleration": {"ka": -5e-5},
}


@pytest.mark.parametrize("form", ["position", "increment"])
@pytest.mark.parametrize("options", PIDS.values(), ids=PIDS)
def test_pid(form, options):
    for plant, sign in SIGN.items():
        weights = {"kp": 6.0 * sign, "ki": 300.0 * sign, "kd": 1e-3 * sign} | options
        feedback = pid(form, **weights)
        by_hand = loops(plant, feedback=feedback, trials=2)
        assert_equal(run(plant, PID(**weights, form=form), trials=2), by_hand)
        if "limit" in options:
            assert 5 < np.sum(np.abs(by_hand[1]) == options["limit"]) < 2 * N - 5, (
                "the limit should act, though not always"
            )
            assert form == "increment" or feedback.was["held"] > 5, "anti-windup should act"


@pytest.mark.parametrize("kp", [2.0, -2.0])
@pytest.mark.parametrize("ki", [0.0, 1.0, -1.0, 40.0, -40.0, 3e3, -3e3, 1e6])
def test_no_gain_winds_the_integral_up(ki, kp):
    """The error does not depend on u, stays on both sides of zero, and is mirrored in a channel."""
    e = np.repeat(np.random.default_rng(1).choice([-1.0, 1.0], 12), 20) * (1 + np.arange(240) / 240)
    held = StateSpace(np.eye(2), np.zeros((2, 2)), np.eye(2))
    task = Task(np.stack([e, -e], axis=1), dt=DT)
    u = np.asarray(learn(Machine(held), PID(kp=kp, ki=ki, limit=2.5), task, 1).final.u)
    np.testing.assert_array_equal(u[:, 1], -u[:, 0])
    by_hand, integral = [], 0.0
    for now in e[:-1]:
        free = kp * now + integral + ki * DT * now
        if not (abs(free) > 2.5 and np.sign(ki * now) == np.sign(free)):
            integral += ki * DT * now
        by_hand.append(np.clip(kp * now + integral, -2.5, 2.5))
    np.testing.assert_allclose(u[:, 0], by_hand, rtol=1e-12, atol=1e-12)
    assert {-2.5, 2.5} <= {*u[:, 0].tolist()}, "both limits act"


@pytest.mark.thorough
def test_feedforward_of_the_reference_in_closed_form():
    """An integrator follows exactly.

    A double integrator is moved by the mean acceleration, y[k] = (r[k+1] + 2 r[k] + r[k-1]) / 4.
    """
    t = np.linspace(0.0, 1.0, N - 1)
    # The reference is at rest for the first two samples.
    r = np.concatenate([[0.0, 0.0], t**3 * (10 - 15 * t + 6 * t**2)])
    integrator = StateSpace([[0.0]], [[1.0]], [[1.0]])
    y = learn(Machine(integrator), PID(kv=1.0), Task(r, dt=DT), 1).final.y[:, 0]
    np.testing.assert_allclose(y, r, **ALGEBRA)
    mass = StateSpace([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]], [[1.0, 0.0]])
    y = learn(Machine(mass), PID(ka=1.0), Task(r, dt=DT), 1).final.y[:, 0]
    held = np.append(r, r[-1])
    np.testing.assert_allclose(
        y[1:], (held[2:] + 2 * held[1:-1] + held[:-2]) / 4, rtol=1e-9, atol=1e-11
    )
    # With the feedback added, the error stays near the curvature of the reference within a sample,
    # dt^2 r'' / 4.
    e = learn(Machine(mass), PID(kp=400.0, kd=40.0, ka=1.0), Task(r, dt=DT), 1).final.e[:, 0]
    assert np.max(np.abs(e)) < 1.1 * np.max(np.abs(np.diff(r, 2))) / 4
    assert np.max(np.abs(e)) < 1e-2 * np.max(
        np.abs(learn(Machine(mass), PID(kp=400.0, kd=40.0), Task(r, dt=DT), 1).final.e)
    )


GAINS = {"gamma_p": 0.6, "gamma_i": 0.02, "gamma_d": 1.5}
P_TYPES = {
    "p": {"gamma_p": 0.6},
    "pd": {"gamma_p": 0.6, "gamma_d": 1.5},
    "pid": GAINS,
    "leak": {"gamma_p": 0.6, "gamma_i": 0.02, "leak": 0.1},
    "lead": GAINS | {"lead": 3},
    "lead_leak_limit": GAINS | {"lead": 3, "leak": 0.1, "limit": 0.8},
}


ORDERS = {
    "one": {"alpha": (1.0,), "gamma": (0.6,)},
    "two": {"alpha": (0.7, 0.3), "gamma": (0.6, -0.2)},
    "lead_limit": {"alpha": (1.5, -0.8, 0.3), "gamma": (0.6, -0.2, 0.1), "lead": 2, "limit": 0.3},
    "leaky": {"alpha": (0.5, 0.4), "gamma": (0.6, 0.3)},
}


@pytest.mark.parametrize("weights", ORDERS.values(), ids=ORDERS)
def test_higher_order(weights):
    by_hand = loops("arx", HigherOrderLoop(**weights))
    assert_equal(run("arx", HigherOrder(**weights)), by_hand)
    assert_limit_acts(weights, by_hand[1])


def test_higher_order_takes_gains_for_each_channel():
    plant = StateSpace([[0.7, 0.1], [0.0, 0.5]], [[0.3, 0.0], [0.1, 0.5]], np.eye(2), dt=DT)
    task, gains = Task(np.stack([R, R[::-1]], axis=1), dt=DT), (0.8, -0.2)
    laws = HigherOrder((1.0,), (gains,)), PIDType(gamma_p=gains)
    one, other = (learn(Machine(plant), law, task, 8).rms for law in laws)
    np.testing.assert_allclose(one, other, **ALGEBRA)


def test_higher_order_converges_as_its_characteristic_roots_say():
    """On y[k+1] = u[k] every sample obeys e_{j+1} = sum_i (alpha_i - gamma_i) e_{j-i}.

    Where all of these coefficients are zero, learning is deadbeat.
    """
    machine, e_1 = Machine(StateSpace([[0.0]], [[1.0]], [[1.0]], dt=DT)), R[1:, None]
    for alpha, gamma in (
        ((0.8, 0.2), (0.5, 0.1)),
        ((0.8, 0.2), (0.8, 0.2)),
        ((0.8, 0.2), (-0.4, 0.1)),
    ):
        saved = learn(machine, HigherOrder(alpha, gamma), Task(R, dt=DT), 30, save=everything).saved
        first, second = np.subtract(alpha, gamma)
        # u_1 is zero, and so is the input before it
        e = [e_1, first * e_1 + (1 - alpha[0]) * e_1]
        for _ in range(28):
            e.append(first * e[-1] + second * e[-2])
        np.testing.assert_allclose(R[1:, None] - saved[0][:, 1:], e, rtol=1e-8, atol=1e-12)
        roots = np.roots([1, -first, -second])
        assert (np.max(np.abs(e[-1])) < 1e-3) == np.all(np.abs(roots) < 1)


WRONG_ORDERS = {
    r"HigherOrder: alpha \(0,\) and gamma \(0,\) do not fit": ((), ()),
    r"alpha \(2,\) and gamma \(1,\) do not fit": ((0.5, 0.5), (1.0,)),
    r"sum of alpha = 1.1 is outside its allowed range \(0, 1\]": ((0.8, 0.3), (1.0, 1.0)),
    r"sum of alpha = 0 is outside its allowed range \(0, 1\]": ((0.5, -0.5), (1.0, 1.0)),
}
test_orders_that_cannot_be_are_named = refused(WRONG_ORDERS, lambda given: HigherOrder(*given))


@pytest.mark.parametrize("options", P_TYPES.values(), ids=P_TYPES)
def test_pid_type(options):
    for plant, sign in SIGN.items():
        weights = {k: v * sign if k.startswith("gamma") else v for k, v in options.items()}
        by_hand = loops(plant, PIDTypeLoop(**weights))
        assert_equal(run(plant, PIDType(**weights)), by_hand)
        assert_limit_acts(options, by_hand[1])


WINDOWS = {
    "cfdl": (CFDLMFAILC, 0, 1),
    "pfdl": (PFDLMFAILC, 0, 3),
    "ffdl": (FFDLMFAILC, 2, 2),
    "ffdl_long": (FFDLMFAILC, 1, 3),
}
OPTIONS = {
    "book": {"mode": "book", "epsilon": 2e-2},
    "sign": {"mode": "sign", "epsilon": 2e-2},
    "none": {"mode": "none"},
    "lead": {"mode": "sign", "lead": 2},
    "limit": {"mode": "none", "limit": 0.7},
}


def mfailc(plant, law, options):
    """Return a scheme and its loop; the start value has the right sign, but is inaccurate."""
    kind, L_y, L_u = WINDOWS[law]
    start = {"printed": [0.5, -0.1, -0.06, 0.02, 0.01], "arx": [0.5, -0.1, 0.2, 0.05, 0.02]}[plant]
    phi0 = start[:L_y] + start[2 : 2 + L_u]
    weights = {
        "phi0": phi0,
        "lam": 0.05,
        "rho": np.linspace(0.9, 0.6, L_y + L_u),
        "eta": 0.9,
        "mu": 0.02,
    }
    windows = {} if law == "cfdl" else {"L_y": L_y, "L_u": L_u}
    renamed = {("reset" if k == "mode" else k): v for k, v in options.items()}
    return kind(**weights, **windows, **renamed), MFAILCLoop(L_y, L_u, **weights, **options)


@pytest.mark.thorough(
    but=["book-cfdl", "book-ffdl", "sign-pfdl", "none-ffdl_long", "lead-ffdl", "limit-pfdl"]
)
@pytest.mark.parametrize("law", WINDOWS)
@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS)
def test_mfailc(law, options):
    for plant in PLANTS:
        scheme, loop = mfailc(plant, law, options)
        by_hand = loops(plant, loop)
        assert_equal(run(plant, scheme), by_hand)
        if options["mode"] != "none" and plant == "printed":
            assert loop.resets["sign"] > 5
            assert options["mode"] == "sign" or loop.resets["small du"] > 5
            assert "lead" in options or law == "cfdl" or loop.resets["small phi"] > 5
        assert_limit_acts(options, by_hand[1])


KP, RANDOM_ACTUATORS = 0.4, 12


class ActuatorLoop:
    """Limit, rate limit and resolution; at random, one of them, or none, is nearly absent."""

    def __init__(self, rng):
        limit, rate, step = rng.uniform(0.4, 2.0), rng.uniform(100.0, 600.0), rng.uniform(1e-3, 0.2)
        absent = rng.integers(4)
        self.values = {
            "limit": 1e6 if absent == 0 else limit,
            "rate": 1e9 if absent == 1 else rate,
            "resolution": 1e-9 if absent == 2 else step,
        }

    def __call__(self, k, u):
        limit, rate, step = self.values.values()
        last = self.moved if k else 0.0
        self.moved = np.clip(last + np.clip(u - last, -rate * DT, rate * DT), -limit, limit)
        return np.clip(np.round(self.moved / step) * step, -limit, limit)


@pytest.mark.thorough(but=["ffdl-over_feedback"])
@pytest.mark.parametrize("over", [False, True], ids=["alone", "over_feedback"])
@pytest.mark.parametrize("law", ["pfdl", "ffdl", "ffdl_long"])
def test_increments_are_of_what_the_actuator_applied(law, over):
    """Both increments of the input are: that of the last trial, and that of the running one."""
    rng, acted = np.random.default_rng(5), 0
    for _ in range(RANDOM_ACTUATORS):
        actuator = ActuatorLoop(rng)
        scheme, loop = mfailc("arx", law, {"mode": "none"})
        scheme = WithFeedback(scheme, PID(kp=KP)) if over else scheme
        feedback = pid("position", KP, 0.0, 0.0) if over else None
        expected = loops("arx", loop, feedback, 5, actuator)
        assert_equal(run("arx", scheme, 5, **actuator.values), expected)
        free = loops("arx", mfailc("arx", law, {"mode": "none"})[1], feedback, 5)
        acted += np.max(np.abs(free[1] - expected[1])) > 0.01
    assert acted > RANDOM_ACTUATORS // 2, "most of the actuators change the input"


SLOW = {"limit": 0.5, "rate": 200.0, "resolution": 0.05}


@pytest.mark.parametrize(
    "wrapped",
    [lambda s: OnOutputs(s, (0,)), lambda s: Bounded.around(s, Task(R, dt=DT))],
    ids=["outputs", "bounded"],
)
def test_a_wrapper_hands_on_what_was_applied(wrapped):
    scheme, _ = mfailc("arx", "ffdl", {"mode": "none"})
    assert_equal(run("arx", wrapped(scheme), 5, **SLOW), run("arx", scheme, 5, **SLOW))


def test_an_actuator_that_cuts_nothing_off_changes_nothing_of_a_feedback_that_learns():
    """It took what was learned beside it for its own."""
    ffdl, _ = mfailc("arx", "ffdl", {"mode": "none"})
    repeats = RepetitiveControl(LearningFilter((0.4,)), period=12 * DT)
    for feedback in (ffdl, WithFeedback(repeats, PID(kp=0.3))):
        scheme = WithFeedback(PIDType(gamma_p=0.6, lead=1), feedback)
        assert_equal(run("arx", scheme, 4, limit=1e6), run("arx", scheme, 4))


def test_a_replay_knows_what_the_actuator_applied():
    machine, task = machine_of("arx", **SLOW), Task(R, dt=DT)
    scheme, _ = mfailc("arx", "ffdl", {"mode": "none"})
    memory = learn(machine, scheme, task, 3).memory
    trial = run_trial(machine, scheme, task, memory, jax.random.key(0))
    found = replay(scheme, task, memory, trial.y, machine.actuator)[0]
    np.testing.assert_allclose(found, trial.u, **ALGEBRA)


def fir(u):
    """Return u by taps 0.05, 0.2, 0.5, 0.2, 0.05, with the end values held."""
    taps = {0: 0.5, 1: 0.2, -1: 0.2, 2: 0.05, -2: 0.05}
    return np.array(
        [sum(tap * u[min(max(k + i, 0), N - 1)] for i, tap in taps.items()) for k in range(N)]
    )


def butterworth(u):
    return scipy.signal.sosfiltfilt(scipy.signal.butter(3, 70.0, fs=1 / DT, output="sos"), u)


FILTERS = {
    "fir": (ZeroPhaseFIR((0.5, 0.2, 0.05)), fir),
    "butterworth": (ZeroPhaseButterworth(70.0, order=3, padding=12), butterworth),
}


@pytest.mark.thorough(but=["p_type-fir", "cfdl-fir", "ffdl-butterworth"])
@pytest.mark.parametrize("q", FILTERS)
@pytest.mark.parametrize("law", ["p_type", "cfdl", "ffdl"])
def test_filtered(law, q):
    q, q_by_hand = FILTERS[q]
    if law == "p_type":
        scheme, loop = (
            PIDType(gamma_p=0.6, lead=1, leak=0.1),
            PIDTypeLoop(gamma_p=0.6, lead=1, leak=0.1),
        )
    else:
        scheme, loop = mfailc("arx", law, OPTIONS["none"])
    loop.q = q_by_hand
    assert_equal(run("arx", Filtered(scheme, q)), loops("arx", loop))


@pytest.mark.parametrize("law", ["p_type", "filtered", "ffdl"])
def test_with_feedback(law):
    """The learning law gets its own part of the input only."""
    gains = {"kp": 0.8, "ki": 20.0, "kd": 2e-4}
    if law == "ffdl":
        learning, loop = mfailc("arx", "ffdl", OPTIONS["none"])
    else:
        learning, loop = PIDType(gamma_p=0.6, lead=1), PIDTypeLoop(gamma_p=0.6, lead=1)
    if law == "filtered":
        learning, loop.q = Filtered(learning, FILTERS["fir"][0]), fir
    assert_equal(
        run("arx", WithFeedback(learning, PID(**gains))),
        loops("arx", loop, pid("position", **gains)),
    )


def test_feedback_loops_nest():
    """Two nested proportional loops are one loop with the sum of their gains, in either order."""
    law = PIDType(gamma_p=0.6, lead=1)
    expected = run("arx", WithFeedback(law, PID(kp=0.7)))
    assert_equal(run("arx", WithFeedback(WithFeedback(law, PID(kp=0.5)), PID(kp=0.2))), expected)


def test_on_outputs():
    """A scheme that gets output 1 of (0, 1) learns from that output alone."""
    A, B, C = np.array([[0.9, 0.1], [0.3, 0.6]]), np.array([0.2, 0.0]), np.eye(2)
    r = np.stack([0 * R, R], axis=1)
    scheme = OnOutputs(PIDType(gamma_p=0.5, lead=1), (1,))
    of_package = learn(
        Machine(StateSpace(A, B[:, None], C, dt=DT)),
        scheme,
        Task(r, dt=DT, inputs=1),
        TRIALS,
        save=everything,
    ).saved
    u = np.zeros(N)
    for j in range(TRIALS):
        x = np.zeros((N + 1, 2))
        for k in range(N):
            x[k + 1] = A @ x[k] + B * u[k]
        np.testing.assert_allclose(of_package[0][j], x, **ALGEBRA)
        np.testing.assert_allclose(of_package[1][j, :, 0], u, **ALGEBRA)
        u = np.array(
            [u[k] + 0.5 * (R[k + 2] - x[k + 2, 1] if k + 2 <= N else 0.0) for k in range(N)]
        )
    assert np.max(np.abs(u)) > 0.1
    for outputs in ((), (2,), (-1,)):
        with pytest.raises(ValueError, match=r" is not a choice among the task's outputs 0\.\.1$"):
            OnOutputs(PIDType(), outputs).check(Task(r, dt=DT, inputs=1))


def test_ffdl_with_the_true_model_takes_off_a_share_rho_of_the_error_in_each_trial():
    """Equation 25 with Phi the ARX vector and lam -> 0 gives e_{j+1} = (1 - rho_c) e_j.

    For rho_c = 1 it is deadbeat in one trial.
    """
    a, b = ARX
    for rho, share in ((1.0, 0.0), ((1.0, 1.0, 0.6, 1.0), 0.4)):
        y, _ = run("arx", FFDLMFAILC(phi0=a + b, lam=1e-18, rho=rho, L_y=2, L_u=2), trials=4)
        e = R[1:] - y[:, 1:]
        assert np.max(np.abs(e[0])) > 1
        for j in range(1, 4):
            np.testing.assert_allclose(e[j], share * e[j - 1], atol=2e-12)
