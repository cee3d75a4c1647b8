"""Model-free adaptive control along the time axis is compared with scalar loops.

The loops follow Dai 2014, and eq. 25 and 27 of Cao 2019.
"""

from collections import Counter

import jax
import numpy as np
import pytest
from cases import ALGEBRA, ARX, DT, PRINTED, assert_close
from refusals import refused

from jaxilc.learning import Disturbance, Machine, check, run_trial
from jaxilc.plants import DifferenceEquation, StateSpace
from jaxilc.schemes import CFDLMFAC, CFDLMFAPC, FFDLMFAC, PFDLMFAC
from jaxilc.schemes.mfac import _quotient, reset_estimate
from jaxilc.signals import Task

N = 70
K = np.arange(N + 1)
R = 0.5 - 0.5 * np.cos(3 * np.pi * K / N) + 0.1 * np.sin(1.3 * K) + 0.3 * (K > 40)
# The plants have one order, so that a program is compiled once for both.
PLANTS = {"printed": PRINTED, "arx": tuple((*c, 0.0) for c in ARX)}
SIGN = {"printed": -1.0, "arx": 1.0}  # of the plant's gain

one_trial = jax.jit(run_trial)


@pytest.mark.parametrize("of", [jax.jacfwd, jax.jacrev, jax.hessian])
def test_the_derivatives_of_a_quotient_are_those_of_a_division(of):
    rng = np.random.default_rng(1)
    both = rng.uniform(-2.0, 2.0, 5), rng.uniform(0.1, 3.0)
    by_rule, plain = (of(f, (0, 1))(*both) for f in (_quotient, lambda a, b: a / b))
    for x, y in zip(jax.tree.leaves(by_rule), jax.tree.leaves(plain), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-14, atol=1e-14)


def test_a_quotient_takes_one_division_with_its_derivatives():
    def divisions(f):
        return str(jax.make_jaxpr(jax.value_and_grad(f, (0, 1)))(1.0, 2.0)).count(" div ")

    assert divisions(_quotient) == 1 < divisions(lambda a, b: a / b)


@pytest.mark.parametrize(("dtype", "low", "high"), [("float64", -307, 307), ("float32", -37, 37)])
def test_a_quotient_that_is_differentiated_is_that_of_a_division(dtype, low, high):
    """Its product with a reciprocal is off by its rounding, as far as the reciprocal is normal."""
    rng = np.random.default_rng(2)
    b = (10.0 ** rng.uniform(low, high, 500)).astype(dtype)
    a = (b * rng.uniform(0.5, 1.0, 500)).astype(dtype)
    found, _ = jax.jvp(_quotient, (a, b), (np.ones_like(a), np.ones_like(b)))
    np.testing.assert_allclose(found, a / b, rtol=2 * np.finfo(dtype).eps)


def run(machine, scheme, r=R):
    """Return outputs (N+1, n), inputs (N, n) and estimates (N, n) of the package."""
    task = Task(r, dt=DT)
    check(machine, scheme, task)
    trial = one_trial(machine, scheme, task, scheme.initial_memory(task), jax.random.key(0))
    return np.asarray(trial.y), np.asarray(trial.u), np.asarray(trial.signals["phi"])


def machine_of(plant, offset=None):
    """Return the machine of a plant, whose output is `offset` off, also at the start."""
    disturbance = None if offset is None else Disturbance(output=np.full((N + 1, 1), offset))
    return Machine(DifferenceEquation(*PLANTS[plant], dt=DT), disturbance=disturbance)


class Loop:
    """The loop runs a trial by hand.

    It holds y and u over the samples, the increments between samples, and how often each reset was
    due. Before the first sample the increments and the input are zero.
    """

    def __init__(self, plant, *, epsilon, reset="book", limit=None, offset=0.0):
        self.a, self.b = PLANTS[plant]
        self.epsilon, self.reset, self.limit = epsilon, reset, limit
        self.motion, self.offset, self.u, self.due = np.zeros(N + 1), offset, np.zeros(N), Counter()
        self.phi = np.zeros(N)

    def y(self, k):
        return self.motion[k] + self.offset

    def dy(self, k):
        return self.y(k) - self.y(k - 1) if k >= 1 else 0.0

    def du(self, k):
        return self.u[k] - (self.u[k - 1] if k >= 1 else 0.0) if k >= 0 else 0.0

    def useless(self, phi, phi0, du=None):
        """Say whether an estimate is useless, by Dai 2014, eq. 12.

        Without a du the rule is that of eq. 16.
        """
        clauses = {"small phi": abs(phi) <= self.epsilon, "sign": np.sign(phi) != np.sign(phi0)}
        if self.reset == "book" and du is not None:
            clauses["small du"] = abs(du) <= self.epsilon
        for name, fired in clauses.items():
            self.due[name if du is not None else f"forecast {name}"] += fired
        return any(clauses.values())

    def apply(self, k, u):
        self.u[k] = u if self.limit is None else min(max(u, -self.limit), self.limit)
        for i in range(min(k + 1, len(self.a))):
            self.motion[k + 1] += self.a[i] * self.motion[k - i] + self.b[i] * self.u[k - i]

    @property
    def signals(self):
        return self.motion + self.offset, self.u, self.phi


def mfac_loop(plant, L_y, L_u, *, lam, rho, eta, mu, phi0, **options):
    """Run a trial in full form; component i of the papers is [i - 1] here."""
    phi0, rho = np.atleast_1d(phi0).astype(float), np.broadcast_to(rho, L_y + L_u)
    loop, phi = Loop(plant, **options), phi0
    for k in range(N):
        dh = np.array(
            [loop.dy(k - i) for i in range(1, L_y + 1)]
            + [loop.du(k - i) for i in range(1, L_u + 1)]
        )
        phi = phi + eta * dh / (mu + dh @ dh) * (loop.dy(k) - phi @ dh)
        if loop.reset != "none" and loop.useless(phi[L_y], phi0[L_y], loop.du(k - 1)):
            phi = phi0
        miss = rho[L_y] * (R[k + 1] - loop.y(k))
        for i in range(1, L_y + 1):
            miss -= rho[i - 1] * phi[i - 1] * loop.dy(k - i + 1)
        for i in range(L_y + 2, L_y + L_u + 1):
            miss -= rho[i - 1] * phi[i - 1] * loop.du(k + L_y - i + 1)
        loop.phi[k] = phi[L_y]
        loop.apply(k, (loop.u[k - 1] if k else 0.0) + phi[L_y] / (lam + phi[L_y] ** 2) * miss)
    return loop


def mfapc_loop(
    plant,
    *,
    P,
    lam,
    eta,
    mu,
    phi0,
    delta,
    theta0,
    theta_limit,
    P_u=1,
    n_p=3,
    reference="preview",
    closed_form=False,
    **options,
):
    """Run a trial by Dai 2014, eq. 11 to 18, with the matrix A_1 (P, P_u), or by eq. 10."""
    theta0 = np.eye(n_p)[0] if theta0 is None else np.asarray(theta0)
    # `before` holds phi(k-1), ..., phi(k-n_p).
    loop, theta, before = Loop(plant, **options), theta0, [phi0] * n_p
    for k in range(N):
        du = loop.du(k - 1)
        phi = before[0] + eta * du / (mu + du**2) * (loop.dy(k) - before[0] * du)  # (11)
        if loop.reset != "none" and loop.useless(phi, phi0, du):  # (12)
            phi = phi0
        regressor = np.array(before)
        # Dai 2014, (13)
        theta = theta + regressor / (delta + regressor @ regressor) * (phi - regressor @ theta)
        if np.linalg.norm(theta) >= theta_limit:  # (14)
            theta = theta0
            loop.due["theta"] += 1
        before = [phi, *before[:-1]]
        line = before[::-1]  # phi(k-n_p+1), ..., phi(k), followed by the forecasts
        for _ in range(P_u - 1):
            forecast = sum(theta[i - 1] * line[-i] for i in range(1, n_p + 1))  # (15)
            line.append(phi0 if loop.useless(forecast, phi0) else forecast)  # (16)
        wanted = np.array(
            [R[min(k + i, N) if reference == "preview" else k + 1] for i in range(1, P + 1)]
        )
        if closed_form:
            move = phi * np.sum(wanted - loop.y(k)) / P / (phi**2 + lam / P)  # (10)
        else:
            A = np.zeros((P, P_u))
            for i in range(P_u):
                A[i:, i] = line[n_p - 1 + i]
            # Dai 2014, (17)
            move = np.linalg.solve(A.T @ A + lam * np.eye(P_u), A.T @ (wanted - loop.y(k)))[0]
        loop.phi[k] = phi
        loop.apply(k, (loop.u[k - 1] if k else 0.0) + move)  # (18)
    return loop


def assert_equal(of_package, loop):
    for name, ours, by_hand in zip(("y", "u", "phi"), of_package, loop.signals, strict=True):
        assert_close(ours[:, 0], by_hand, name)
    assert 0.1 < np.max(np.abs(loop.motion)) < 1e2, "the loop should follow, and stay bounded"
    assert np.ptp(loop.phi) > 1e-3, "the estimate should move"


WINDOWS = {
    "cfdl": (CFDLMFAC, 0, 1),
    "pfdl": (PFDLMFAC, 0, 3),
    "ffdl": (FFDLMFAC, 2, 2),
    "ffdl_long": (FFDLMFAC, 1, 3),
}
OPTIONS = {
    "book": {},
    "sign": {"reset": "sign"},
    "none": {"reset": "none", "lam": 0.5},
    "limit": {"limit": 0.6},
}
CLAUSES = {  # of each mode of the reset
    "book": {"small phi", "sign", "small du"},
    "sign": {"small phi", "sign"},
    "none": set(),
}


def mfac(plant, law, **options):
    """Return a scheme and its loop; the start value has the right sign, but is inaccurate."""
    kind, L_y, L_u = WINDOWS[law]
    start = {"printed": [0.5, -0.1, -0.04, 0.02, 0.01], "arx": [0.5, -0.1, 0.08, 0.05, 0.02]}[plant]
    weights = {
        "phi0": start[:L_y] + start[2 : 2 + L_u],
        "lam": 0.2,
        "mu": 0.1,
        "eta": 0.9,
        "rho": np.linspace(0.9, 0.6, L_y + L_u),
    }
    windows = {} if law == "cfdl" else {"L_y": L_y, "L_u": L_u}
    offset = options.pop("offset", 0.0)
    weights |= {"epsilon": 1.5e-2} | options
    return kind(**weights, **windows), mfac_loop(plant, L_y, L_u, **weights, offset=offset)


@pytest.mark.thorough(but=["book-cfdl", "book-ffdl", "sign-pfdl", "none-ffdl_long", "limit-ffdl"])
@pytest.mark.parametrize("law", WINDOWS)
@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS)
def test_mfac(law, options):
    due = Counter()
    for plant in PLANTS:
        scheme, loop = mfac(plant, law, **options)
        assert_equal(run(machine_of(plant), scheme), loop)
        due += loop.due
        assert "limit" not in options or 5 < np.sum(np.abs(loop.u) == options["limit"]) < N
    expected = CLAUSES[options.get("reset", "book")]
    assert set(due) == expected or ("limit" in options and due["small du"]), (
        "every clause should have fired"
    )


MFAPC = {
    "1": {"P_u": 1},
    "1_sign": {"P_u": 1, "reset": "sign"},
    "1_none": {"P_u": 1, "reset": "none"},
    "1_constant": {"P_u": 1, "reference": "constant"},
    "2": {"P_u": 2},
    "3": {"P_u": 3},
    "3_sign": {"P_u": 3, "reset": "sign"},
    "3_constant": {"P_u": 3, "reference": "constant"},
    "3_limit": {"P_u": 3, "limit": 0.6},
    "3_of_order_1": {"P_u": 3, "n_p": 1, "theta0": (-0.8,), "theta_limit": 0.95},
    "3_phi_stays": {"P_u": 3, "theta0": None, "theta_limit": 10.0},
    "5": {"P_u": 5},
    "5_of_order_7": {"P_u": 5, "n_p": 7, "theta0": (-0.5, 0.9, 0.4, 0.1, -0.2, 0.0, 0.1)},
    "5_constant": {"P_u": 5, "reference": "constant"},
    "all": {"P": 4, "P_u": 4},
    "one_step": {"P": 1, "P_u": 1, "lam": 0.3},
}


def mfapc(plant, offset=0.0, closed_form=False, **options):
    """Return a scheme and its loop, whose forecasts and coefficients leave the allowed region."""
    weights = {
        "lam": 3.0,
        "eta": 0.9,
        "mu": 0.1,
        "phi0": 0.12 * SIGN[plant],
        "delta": 0.05,
        "epsilon": 5e-2,
        "P": 8,
    }
    weights |= {"theta0": (-0.5, 0.9, 0.4), "theta_limit": 1.2} | options
    return CFDLMFAPC(**weights), mfapc_loop(
        plant, **weights, offset=offset, closed_form=closed_form
    )


@pytest.mark.thorough(
    but=["1", "3_sign", "3_limit", "3_of_order_1", "5_constant", "5_of_order_7", "one_step"]
)
@pytest.mark.parametrize("options", MFAPC.values(), ids=MFAPC)
def test_mfapc(options):
    due = Counter()
    for plant in PLANTS:
        scheme, loop = mfapc(plant, **options)
        of_package = run(machine_of(plant), scheme)
        assert_equal(of_package, loop)
        if options["P_u"] == 1:
            assert_equal(of_package, mfapc(plant, **options, closed_form=True)[1])
        due += loop.due
        assert "limit" not in options or 5 < np.sum(np.abs(loop.u) == options["limit"]) < N
    expected = set(CLAUSES[options.get("reset", "book")])
    expected |= {"forecast small phi", "forecast sign"} if options["P_u"] > 1 else set()
    expected |= {"theta"} if "theta_limit" not in options or options["theta_limit"] < 10 else set()
    assert set(due) == expected or ("limit" in options and expected - set(due) == {"sign"}), (
        "every clause should have fired"
    )


@pytest.mark.thorough
def test_mfapc_without_resets():
    """No forecast changes its sign, so that nothing depends on eq. 16 in mode `none`."""
    scheme, loop = mfapc("arx", P_u=3, reset="none", theta0=None, theta_limit=10.0)
    assert_equal(run(machine_of("arx"), scheme), loop)
    assert not +loop.due


@pytest.mark.thorough
@pytest.mark.parametrize("P_u", [1, 2])
def test_a_horizon_of_250_samples_beyond_the_end_of_the_trial(P_u):
    """The reference is held at its end.

    Nothing of size P x P_u is built, but the result is that of the matrix.
    """
    assert N < 250
    for plant in PLANTS:
        scheme, loop = mfapc(plant, P=250, P_u=P_u, lam=90.0)
        assert_equal(run(machine_of(plant), scheme), loop)


@pytest.mark.thorough
@pytest.mark.parametrize("law", ["cfdl", "ffdl", "mfapc"])
def test_a_machine_that_does_not_start_at_zero(law):
    """A machine need not start at zero, and y[0] = 0.3 is not an increment of the output."""
    scheme, loop = mfapc("arx", offset=0.3) if law == "mfapc" else mfac("arx", law, offset=0.3)
    assert_equal(run(machine_of("arx", offset=0.3), scheme), loop)


DEADBEAT = {
    "cfdl": (((0.0, 0.0), (0.5, 0.0)), CFDLMFAC(phi0=0.5, lam=1e-18)),
    "ffdl": (ARX, FFDLMFAC(phi0=ARX[0] + ARX[1], lam=1e-18, L_y=2, L_u=2)),
    "mfapc": (((0.0, 0.0), (0.5, 0.0)), CFDLMFAPC(phi0=0.5, lam=1e-18, P=4, P_u=4)),
}


@pytest.mark.thorough
@pytest.mark.parametrize("law", DEADBEAT)
def test_the_true_model_without_a_price_on_moves_is_deadbeat(law):
    """The plant is the data model with phi0: y is r wherever the input can reach."""
    (a, b), scheme = DEADBEAT[law]
    y, _, phi = run(Machine(DifferenceEquation(a, b, dt=DT)), scheme)
    np.testing.assert_allclose(y[1:, 0], R[1:], atol=1e-11)
    np.testing.assert_allclose(phi, phi[0, 0], rtol=1e-9)


CHANNELS = {
    "lam": (0.2, 3.0),
    "eta": (0.9, 0.4),
    "mu": (0.1, 0.3),
    "epsilon": (1e-2, 1e-3),
    "limit": (0.9, 1.4),
}
PREDICTIVE = CHANNELS | {"phi0": (0.12, -0.3), "delta": (0.05, 0.6), "theta_limit": (1.2, 1.5)}


@pytest.mark.thorough
@pytest.mark.parametrize(
    "build",
    [
        lambda w: CFDLMFAC(**w, phi0=0.1),
        lambda w: FFDLMFAC(**w, phi0=(0.5, -0.1, 0.1, 0.02), rho=(0.9, 0.8, 0.7, 0.6)),
        lambda w: CFDLMFAPC(**w, P=6, theta0=(-0.5, 0.9, 0.4)),
        lambda w: CFDLMFAPC(**w, P=6, P_u=2, theta0=(-0.5, 0.9, 0.4)),
        lambda w: CFDLMFAPC(**w, P=6, P_u=3, theta0=(-0.5, 0.9, 0.4)),
    ],
    ids=["cfdl", "ffdl", "mfapc_1", "mfapc_2", "mfapc_3"],
)
def test_channels_are_taken_one_by_one(build):
    """Two machines side by side, with weights each, are the two machines alone."""
    weights = PREDICTIVE if isinstance(build(CHANNELS), CFDLMFAPC) else CHANNELS
    poles, gains, r = (
        np.array([0.9, 0.6]),
        np.array([0.2, -0.5]),
        np.stack([R, -0.7 * R[::-1]], axis=1),
    )
    if "phi0" not in weights:
        gains = np.abs(gains)  # the gains have one sign, as the common start value has
    together = run(
        Machine(StateSpace(np.diag(poles), np.diag(gains), np.eye(2), dt=DT)), build(weights), r
    )
    for i in range(2):
        machine = Machine(StateSpace([[poles[i]]], [[gains[i]]], [[1.0]], dt=DT))
        alone = run(machine, build({name: value[i] for name, value in weights.items()}), r[:, i])
        for name, both, one in zip(("y", "u", "phi"), together, alone, strict=True):
            np.testing.assert_allclose(
                both[:, i], one[:, 0], **ALGEBRA, err_msg=f"{name} of channel {i}"
            )


REFUSED = {
    r"CFDLMFAPC: P_u = 4 is outside its allowed range \[1, 3\] for P = 3": (
        lambda: CFDLMFAPC(P=3, P_u=4)
    ),
    r"CFDLMFAPC: theta0 has shape \(2,\); n_p = 3 needs \(3,\)": (
        lambda: CFDLMFAPC(theta0=(1.0, 0.0))
    ),
    r"FFDLMFAC: phi0 has shape \(4,\); L_y = 2 and L_u = 3 need \(5,\)": (lambda: FFDLMFAC(L_u=3)),
    "CFDLMFAPC works channel by channel .* not 1 and 2": (
        lambda: CFDLMFAPC().check(Task(np.zeros((5, 2)), dt=DT, inputs=1))
    ),
}
test_what_is_refused_is_named = refused(REFUSED)


def test_a_smooth_reset_is_weighed_by_its_formula():
    phi, du = np.random.default_rng(6).normal(0.0, 0.1, (2, 2, 30))
    phi0 = np.array([0.2, -0.3])[:, None]
    found = reset_estimate([*phi], du[0], [*phi0], component=1, epsilon=0.04, mode="smooth")
    w = 1 / (1 + np.exp(1 + phi[1] / 0.04)) / (1 + np.exp(1 - np.abs(du[0]) / 0.04))
    np.testing.assert_allclose(found, phi0 + w * (phi - phi0), rtol=1e-12)
