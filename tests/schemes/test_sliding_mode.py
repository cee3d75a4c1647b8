"""Sliding mode control, learning over it and their theory are tested.

They are compared with scalar loops written from Xu 2024, and with closed forms.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal
from refusals import refused

from jaxilc.filters import ZeroPhaseFIR
from jaxilc.learning import (
    Disturbance,
    Machine,
    Variation,
    chattering,
    check,
    learn,
    measured_trial,
    run_trial,
    total_variation,
)
from jaxilc.plants import StateSpace
from jaxilc.schemes import ASMC, PID, SMC, ExponentialPD, Filtered, PIDType, WithFeedback
from jaxilc.schemes.sliding_mode import filtered_difference
from jaxilc.signals import Task, Trial
from jaxilc.theory import frequency
from jaxilc.theory.sliding import printed_condition, sampled_condition, sliding, within_layer

# The numbers are from Xu 2024, section 5.2, in um and V.
A1, A2, B = 2.413e6, 70.16, 2.229e7
MODEL = {"a1": A1, "a2": A2, "b": B}
DT, N = 1e-4, 250  # a period of the paper's 40 Hz
LAM1, LAM2 = 500.0, 0.3


def plant(dt=DT):
    """Return the printed second-order system, sampled by scipy."""
    continuous = (
        np.array(M) for M in ([[0.0, 1.0], [-A1, -A2]], [[0.0], [B]], [[1.0, 0.0]], [[0.0]])
    )
    A, Bd, C, _, _ = scipy.signal.cont2discrete(tuple(continuous), dt)
    return StateSpace(A, Bd, C, dt=dt)


def bump(n=N, dt=DT):
    """Return a motion of 20 um peak to peak at 40 Hz that starts and ends at rest."""
    return 10.0 * (1 - np.cos(2 * np.pi * 40 * dt * np.arange(n + 1)))


T = DT * np.arange(N)
# a disturbance at the input that is the same in each trial [V]
FORCE = 0.05 * np.sin(2 * np.pi * 40 * T - 1) + 0.03 * np.sin(2 * np.pi * 120 * T)
PLANT = plant()
TASK = Task(bump(), dt=DT)
FREE = Machine(PLANT, disturbance=Disturbance(input=np.zeros((N, 1))))
# The structure is the same, so that a program is compiled once for both.
FORCED = Machine(PLANT, disturbance=Disturbance(input=FORCE[:, None]))

one_trial, loop_of = jax.jit(run_trial), jax.jit(frequency.linear_loop)


def run(machine, scheme, task=TASK) -> Trial:
    check(machine, scheme, task)
    return one_trial(machine, scheme, task, scheme.initial_memory(task), jax.random.key(0))


def control(weights, eq, fast, eta_hat, integral, *, grows):
    """Return sigma, eta_hat and u of eq. 6 to 13, with fast = e' + lam1 e."""
    sigma, layer = fast + LAM2 * integral, weights.get("Delta", 0.0)
    gain = eta_hat + DT * weights["phi"] * abs(sigma) if grows else eta_hat
    switch = sigma / layer if abs(sigma) < layer else np.sign(sigma)
    return sigma, gain, (eq - gain * switch - weights["k_n"] * sigma) / weights["b"]


class Loop:
    """The loop runs one trial of Xu 2024, eq. 5 to 13, by hand.

    It holds y (N+1,) and u, sigma, eta_hat (N,).
    """

    def __init__(self, weights, *, start=None, learned=None, tau=0.0, limit=None, centre="sample"):
        r, A, Bd = bump(), np.asarray(PLANT.A), np.asarray(PLANT.B)[:, 0]
        before = np.concatenate([r[:1], r])  # before[k] = r[k-1]
        x, integral, e_last, slope, second_last = np.zeros(2), 0.0, 0.0, 0.0, 0.0
        eta_hat = weights["eta"] if start is None else start
        self.y, (self.u, self.sigma, self.eta_hat) = np.zeros(N + 1), np.zeros((3, N))
        dead_zone = weights.get("epsilon", np.inf)
        for k in range(N):
            y, e = x[0], x[0] - r[k]
            slope = (tau * slope + e - e_last) / (tau + DT)
            second = (r[k + 1] - 2 * r[k] + before[k]) / DT**2
            if centre == "sample":
                x1, rate, acceleration = y, (r[k + 1] - before[k]) / (2 * DT), second
            else:
                x1, rate = 0.5 * (r[k] + r[k + 1]) + e + slope * DT / 2, (r[k + 1] - r[k]) / DT
                acceleration = 1.5 * second - 0.5 * second_last
            x2 = rate + slope
            eq = (
                weights["a1"] * x1
                + weights["a2"] * x2
                + acceleration
                - LAM1 * (x2 - rate)
                - LAM2 * e
            )

            grown = integral + DT * e
            now = (weights, eq, slope + LAM1 * e, eta_hat)
            sigma, gain, u = control(*now, grown, grows=abs(e) > dead_zone)
            if limit is not None and abs(u) > limit:
                # a rising integral lowers u
                pushes = (u > 0) == (e < 0)
                grown = integral if pushes else grown
                sigma, gain, u = control(*now, grown, grows=False)
                u = min(max(u, -limit), limit)
            integral, eta_hat, e_last, second_last = grown, gain, e, second
            self.y[k], self.u[k], self.sigma[k], self.eta_hat[k] = y, u, sigma, eta_hat
            x = A @ x + Bd * (u + FORCE[k] + (0.0 if learned is None else learned[k]))
        self.y[N] = x[0]


SWITCHING = {"a1": 0.99 * A1, "a2": 90.0, "b": 1.02 * B, "eta": 1.5e6, "k_n": 700.0}
ADAPTIVE = SWITCHING | {"eta": 2e5, "phi": 1e5, "epsilon": 0.4, "Delta": 500.0}
LAWS = {
    "smc": (SWITCHING, {}),
    "smc_filtered_hold": (SWITCHING, {"tau": 8e-5, "centre": "hold"}),
    "smc_limited": (SWITCHING, {"limit": 1.9}),
    "asmc": (ADAPTIVE, {}),
    "asmc_limited_hold": (ADAPTIVE, {"tau": 5e-5, "limit": 1.9, "centre": "hold"}),
}


@pytest.mark.parametrize("name", LAWS)
def test_a_trial_equals_the_equations(name):
    weights, options = LAWS[name]
    trial = run(FORCED, (ASMC if "phi" in weights else SMC)(**weights, **options))
    loop = Loop(weights, **options)
    shown = (trial.y, trial.u, trial.signals["sigma"], trial.signals["eta_hat"])
    for found, expected in zip(shown, (loop.y, loop.u, loop.sigma, loop.eta_hat), strict=True):
        np.testing.assert_allclose(
            found[:, 0], expected, rtol=1e-9, atol=1e-9 * np.max(np.abs(expected))
        )
    if "limit" in options:
        assert np.any(np.abs(loop.u) == options["limit"]), "the limit should act"


@pytest.mark.parametrize("phi", [1e5, 5e6])
def test_too_quick_an_adaptation_runs_away(phi):
    """Beyond the limit of the sampled loop the gain grows with the oscillation that it causes."""
    gain = np.asarray(
        run(FORCED, ASMC(**MODEL, k_n=1000.0, phi=phi, epsilon=0.01, Delta=100.0)).signals[
            "eta_hat"
        ]
    )[:, 0]
    steepest, growth = LAM1 + 1000.0 + gain[-1] / 100.0, gain[-1] / gain[N // 2]
    assert (
        (steepest > 10 * 2 / DT and growth > 10)
        if phi == 5e6
        else (steepest < 2 / DT and growth < 2)
    )


def signals(trial):
    return trial.y[:, 0], trial.u[:, 0], trial.signals


@pytest.mark.thorough
@pytest.mark.parametrize("carry", [False, True])
def test_the_gain_is_carried_to_the_next_trial_or_not(carry):
    history = learn(FORCED, ASMC(**ADAPTIVE, carry=carry), TASK, 3, save=signals)
    start = None
    for j in range(3):
        loop = Loop(ADAPTIVE, start=start)
        np.testing.assert_allclose(history.saved[0][j], loop.y, rtol=1e-9, atol=1e-8)
        np.testing.assert_allclose(history.saved[2]["eta_hat"][j, :, 0], loop.eta_hat, rtol=1e-9)
        start = loop.eta_hat[-1] if carry else None
    assert (history.saved[2]["eta_hat"][2, 0, 0] > 1e6) == carry
    assert ASMC(**ADAPTIVE, carry=carry).learns == carry


def test_a_gain_that_the_state_carries_too_is_carried_once():
    scheme = ASMC(**ADAPTIVE | {"epsilon": 1e9, "eta": 2.0}, carry=True)  # it never adapts
    machine = dataclasses.replace(FORCED, variation=Variation(carried=1.0))
    history = learn(machine, scheme, TASK, 3, save=signals)
    np.testing.assert_allclose(history.saved[2]["eta_hat"], 2.0, rtol=1e-12)


LEARNING = {"K_P": 6e5, "K_D": 1.5e3, "lam0": 12.0, "b": B}


@pytest.mark.parametrize(("lead", "limit"), [(0, None), (2, 0.04)])
def test_learning_equals_the_equations(lead, limit):
    """u_ilc / b of eq. 26 is added to the feedback, and the derivative is central."""
    scheme = WithFeedback(ExponentialPD(**LEARNING, lead=lead, limit=limit), ASMC(**ADAPTIVE))
    history = learn(FORCED, scheme, TASK, 3, save=signals)
    learned, r = np.zeros(N), bump()
    for j in range(3):
        loop = Loop(ADAPTIVE, learned=learned)
        np.testing.assert_allclose(history.saved[0][j], loop.y, rtol=1e-9, atol=1e-8)
        np.testing.assert_allclose(history.saved[1][j], loop.u + learned, rtol=1e-9, atol=1e-9)
        e = r - loop.y
        for k in range(N - lead):
            i = k + 1 + lead
            rate = (e[i + 1] - e[i - 1]) / (2 * DT) if i < N else (e[N] - e[N - 1]) / DT
            learned[k] += (
                np.exp(LEARNING["lam0"] * k * DT)
                * (LEARNING["K_P"] * e[i] + LEARNING["K_D"] * rate)
                / B
            )
        if limit is not None:
            assert np.max(np.abs(learned)) > limit, "the limit should act"
            learned = np.clip(learned, -limit, limit)
    np.testing.assert_allclose(history.memory.learning.u[:, 0], learned, rtol=1e-8, atol=1e-9)


def differences(x, tau):
    pairs = jnp.asarray(x[1:]), jnp.asarray(x[:-1])
    return np.array(
        jax.lax.scan(lambda s, now: (filtered_difference(s, *now, tau, DT),) * 2, 0.0, pairs)[1]
    )


@pytest.mark.parametrize("tau", [0.0, 3e-4])
def test_the_velocity_estimate_has_its_amplitude_phase_and_noise(tau):
    i = np.arange(1, 401)
    np.testing.assert_allclose(differences(7.0 * DT * np.arange(401), tau)[200:], 7.0, rtol=1e-9)
    for f in (40.0, 800.0):
        w = 2 * np.pi * f
        settled = differences(np.sin(w * DT * np.arange(401)), tau)[200:]
        z = np.exp(-1j * w * DT)
        amplitude = w * np.sin(w * DT / 2) / (w * DT / 2) / np.abs(1 + tau * (1 - z) / DT)
        phase = np.pi / 2 - w * DT / 2 - np.angle(1 + tau * (1 - z) / DT)
        np.testing.assert_allclose(
            settled, amplitude * np.sin(w * DT * i[200:] + phase), rtol=1e-8, atol=1e-8 * amplitude
        )
    w = 2 * np.pi * 5.0
    late = np.angle(1j * w * np.exp(0j)) - np.angle(
        (1 - np.exp(-1j * w * DT)) / (tau + DT - tau * np.exp(-1j * w * DT))
    )
    np.testing.assert_allclose(late / w, tau + DT / 2, rtol=1e-4)
    impulse = differences((np.arange(401) == 1).astype(float), tau)
    np.testing.assert_allclose(np.sum(impulse**2), 2 / ((tau + DT) * (2 * tau + DT)), rtol=1e-8)


def test_gradients_through_the_switching():
    at = jnp.array([-30.0, 0.3, 40.0])
    smc, asmc = SMC(**MODEL), ASMC(**MODEL, Delta=5.0)
    slope = jax.vmap(jax.grad(smc.switching))(at), jax.vmap(jax.grad(asmc.switching))(at)
    np.testing.assert_array_equal(slope[0], 0.0)
    np.testing.assert_allclose(slope[1], [0.0, 0.2, 0.0])
    np.testing.assert_allclose(smc.switching(jnp.array([-2.0, 0.0, 3.0])), [-1, 0, 1])
    np.testing.assert_allclose(
        asmc.switching(jnp.array([-6.0, -2.5, 0.0, 3.0, 6.0])), [-1, -0.5, 0, 0.6, 1]
    )


# Theory
# --------------------------------------------------------------------------------------------------


@pytest.mark.thorough
def test_sigma_slides_in_a_band_proportional_to_the_sample_time():
    """On the exact model |sigma| <= (eta + 2 |f|) dt, of first order, and |e| < |sigma| / lam1."""
    bands, errors, steps = [], [], (2e-4, 1e-4, 5e-5)
    scheme = SMC(**MODEL, eta=1e6, k_n=500.0, centre="hold")
    for dt in steps:
        n = round(0.025 / dt)
        task = Task(bump(n, dt), dt=dt)
        trial = run(Machine(plant(dt)), scheme, task)
        found = sliding(scheme, trial)
        sigma = np.abs(np.asarray(trial.signals["sigma"])[:, 0])
        assert found.condition.holds
        assert found.reached < n // 4
        assert np.max(sigma[n // 4 :]) <= found.band[0] <= 2 * 1e6 * dt
        assert found.falling == pytest.approx(np.mean((sigma[1:] <= sigma[:-1])[sigma[:-1] > 0]))
        bands.append(np.max(sigma[n // 4 :]))
        errors.append(np.max(np.abs(trial.e[n // 4 :])))
    slope = np.polyfit(np.log(steps), np.log(bands), 1)[0]
    assert 0.8 < slope < 1.2
    assert np.all(np.array(errors) < np.array(bands) / LAM1)
    assert errors[-1] < 0.02


@pytest.mark.parametrize("ratio", [0.7, 1.5])
def test_a_matched_disturbance_is_held_below_eta_and_not_above(ratio):
    """Above, the reaching rate supplies the rest: sigma = (f - eta) / k_n, e = sigma / lam1."""
    eta, k_n = 1e6, 800.0
    machine = Machine(PLANT, disturbance=Disturbance(input=np.full((N, 1), ratio * eta / B)))
    scheme = SMC(**MODEL, eta=eta, k_n=k_n, lam2=0.0)
    trial = run(machine, scheme, Task(np.zeros(N + 1), dt=DT))
    found, sigma = sliding(scheme, trial), np.asarray(trial.signals["sigma"])[:, 0]
    np.testing.assert_allclose(np.mean(found.disturbance[N // 2 :]), ratio * eta, rtol=2e-2)
    if ratio < 1:
        assert found.condition.holds
        assert found.dominated == 1.0
        assert np.max(np.abs(sigma)) <= found.band[0] < (1 + 2.1 * ratio) * eta * DT
        assert found.reached == 0
        assert found.towards > 0.8
    else:
        np.testing.assert_allclose(sigma[-1], (ratio - 1) * eta / k_n, rtol=1e-3)
        np.testing.assert_allclose(trial.y[-1, 0], sigma[-1] / LAM1, rtol=1e-3)
        assert found.condition.verdict == "fails"
        np.testing.assert_allclose(found.condition.value, ratio, rtol=0.03)
        assert found.reached == N
        assert found.dominated == found.towards == 0.0


def test_the_boundary_layer_holds_a_disturbance_with_the_reaching_rate_as_well():
    """A constant f settles at f / (k_n + eta / Delta), even for eta < f < eta + k_n Delta."""
    f, scheme = 1.2e6, ASMC(**MODEL, eta=1e6, phi=0.0, k_n=1000.0, Delta=600.0, lam2=0.0)
    trial = run(
        Machine(PLANT, disturbance=Disturbance(input=np.full((N, 1), f / B))),
        scheme,
        Task(np.zeros(N + 1), dt=DT),
    )
    found = sliding(scheme, trial)
    np.testing.assert_allclose(trial.signals["sigma"][-1, 0], f / (1000 + 1e6 / 600), rtol=1e-3)
    assert found.condition.holds
    np.testing.assert_allclose(found.disturbance[-1, 0], f, rtol=1e-3)
    np.testing.assert_allclose(found.condition.value, f / (1e6 + 1000 * 600), rtol=0.03)
    assert found.dominated == 0.0
    assert found.reached == 0


def test_a_trial_that_hits_the_limit_claims_nothing():
    scheme = SMC(**SWITCHING, limit=1.9)
    assert sliding(scheme, run(FORCED, scheme)).condition.verdict == "not claimed"


def test_what_is_measured_is_judged_like_what_is_simulated():
    scheme = WithFeedback(ExponentialPD(**LEARNING), ASMC(**ADAPTIVE))
    trial = run(FORCED, scheme)
    shown = sliding(scheme, trial)
    again = sliding(scheme, measured_trial(TASK, trial.y, trial.u, **trial.signals))
    alone = sliding(scheme.feedback, run(FORCED, scheme.feedback))
    for other in (again, alone):
        np.testing.assert_allclose(other.disturbance, shown.disturbance, rtol=1e-9, atol=1e-3)
        assert other.condition.value == pytest.approx(shown.condition.value)


def test_within_the_layer_the_loop_is_that_of_a_steeper_reaching_law():
    scheme = ASMC(**MODEL, eta=2e6, phi=0.0, k_n=1000.0, Delta=600.0)
    here, linear = run(FORCED, scheme), run(FORCED, within_layer(scheme))
    assert np.max(np.abs(here.signals["sigma"])) < 600.0
    np.testing.assert_allclose(here.y, linear.y, rtol=1e-9, atol=1e-9)
    assert within_layer(WithFeedback(ExponentialPD(), scheme), 4e6).feedback.k_n == pytest.approx(
        1000 + 4e6 / 600
    )


@pytest.mark.parametrize("tau", [0.0, 2e-4])
def test_the_sampled_loop_is_stable_up_to_two_over_dt(tau):
    """The condition is lam1 + k_n + eta / Delta < 2 / dt, with the velocity from differences.

    It holds for every tau, if lam1 is small.
    """
    for factor, stable in ((0.97, True), (1.08, False)):
        scheme = SMC(**MODEL, eta=0.0, k_n=factor * 2 / DT - 5.0, lam1=5.0, tau=tau)
        assert (frequency.pole_radius(loop_of(FREE, scheme, TASK)) < 1) == stable


@pytest.mark.thorough
def test_the_printed_condition_is_its_inequality():
    """G (K_P^2 + w^2 K_D^2) < 2 (K_P lam2 + w^2 (K_D lam1 - K_P)), at both ends of the trial."""
    rng, w, seen = np.random.default_rng(0), 2 * np.pi * np.geomspace(1.0, 5000.0, 300), set()
    for _ in range(20):
        K_P, K_D, lam0 = rng.choice([0.2, 1e3, 4e4]), rng.uniform(50, 1200), rng.choice([0.0, 30.0])
        lam2 = rng.choice([LAM2, 1e4, 1e5])
        law = SMC(**MODEL | {"lam2": lam2})
        scheme = WithFeedback(ExponentialPD(K_P=K_P, K_D=K_D, lam0=lam0, b=B), law)
        found = printed_condition(scheme, TASK, frequencies=w / (2 * np.pi))
        for curve, G in zip(found.curves, (1.0, np.exp(lam0 * TASK.duration)), strict=True):
            below = G * (K_P**2 + w**2 * K_D**2) < 2 * (K_P * lam2 + w**2 * (K_D * LAM1 - K_P))
            np.testing.assert_array_equal(curve < 1, below)
            seen |= set(below)
        assert found.condition.value == np.max(found.curves)
        assert found.time in (0.0, TASK.duration)
        assert found.condition.verdict == "not claimed", "the reaching law was not counted"
    assert seen == {True, False}


GAINS = {"good": (6e5, 1.5e3), "too_much": (2e6, 3e4)}


@pytest.mark.thorough(but=["too_much"])
@pytest.mark.parametrize("gains", GAINS)
def test_the_conditions_tell_what_learning_does(gains):
    """On a linear loop, with the reaching rate: eq. 36, the sampled condition, and simulation."""
    K_P, K_D = GAINS[gains]
    learning, feedback = (
        ExponentialPD(K_P=K_P, K_D=K_D, lam0=5.0, b=B),
        SMC(**MODEL, eta=0.0, k_n=1500.0, lam2=0.0, centre="hold"),
    )
    filtered = WithFeedback(Filtered(learning, ZeroPhaseFIR((0.9, 0.05))), feedback)
    printed = printed_condition(WithFeedback(learning, feedback), TASK, reaching=1500.0)
    sampled = sampled_condition(FREE, filtered, TASK)
    grown = np.exp(5.0 * TASK.duration)
    at_end = dataclasses.replace(learning, K_P=grown * K_P, K_D=grown * K_D, lam0=0.0)
    steady = dataclasses.replace(
        filtered, learning=dataclasses.replace(filtered.learning, scheme=at_end)
    )
    np.testing.assert_allclose(
        sampled.curves[1], sampled_condition(FREE, steady, TASK).curves[0], rtol=1e-9
    )
    rms = np.asarray(learn(FREE, filtered, TASK, 12).rms)[:, 0]
    slow = sampled.frequencies[(sampled.frequencies > 10) & (sampled.frequencies < 200)]
    there = printed_condition(
        WithFeedback(learning, feedback), TASK, reaching=1500.0, frequencies=slow
    ).curves
    here = np.stack([np.interp(slow, sampled.frequencies, curve) for curve in sampled.curves])
    assert np.all(np.abs(here - there) < 1.5 * 2 * np.pi * slow * DT * (1 + there)), (
        "within the delays of hold and difference"
    )
    if gains == "good":
        assert sampled.condition.verdict == "holds"
        assert printed.condition.value < 1
        assert [p.name for p in printed.condition.broken] == ["the loop as it is sampled agrees"], (
            "without a filter it does not"
        )
        assert sampled.condition.value < 0.9
        assert np.all(rms[1:] < sampled.condition.value * rms[:-1] + 0.01 * rms[0])
    else:
        assert printed.condition.verdict == sampled.condition.verdict == "fails"
        assert printed.time == sampled.time == TASK.duration
        assert rms[-1] > 10 * rms[0]


def test_the_sampled_condition_looks_at_the_layer():
    scheme = WithFeedback(
        ExponentialPD(K_P=6e5, K_D=1.5e3, b=B),
        ASMC(**MODEL, eta=2e6, phi=0.0, k_n=1000.0, Delta=600.0),
    )
    within = sampled_condition(FREE, scheme, TASK, trial=run(FORCED, scheme))
    far = dataclasses.replace(
        scheme, feedback=dataclasses.replace(scheme.feedback, Delta=100.0, phi=1e5, epsilon=0.0)
    )
    beyond = sampled_condition(FREE, far, TASK, trial=run(FORCED, far))
    looked_at = {"sigma within the boundary layer", "eta_hat at rest"}
    assert looked_at <= {p.name for p in beyond.condition.broken}
    assert not looked_at & {p.name for p in within.condition.broken}
    assert within.condition.value != beyond.condition.value


# Metrics and bad input
# --------------------------------------------------------------------------------------------------


def test_total_variation_and_chattering():
    k = np.arange(101)
    signal = np.stack([(-1.0) ** k, np.minimum(k, 100 - k), np.sin(2 * np.pi * k / 100)], axis=1)
    np.testing.assert_allclose(total_variation(jnp.asarray(signal)), [200.0, 100.0, 4.0], rtol=1e-9)
    trial = Trial(jnp.zeros((102, 3)), jnp.zeros((102, 3)), jnp.asarray(signal), 1e-3)
    np.testing.assert_allclose(chattering(trial), np.array([200.0, 100.0, 4.0]) / 0.101, rtol=1e-9)
    sharp = run(FORCED, SMC(**MODEL, eta=2e6, k_n=500.0))
    smooth = run(FORCED, ASMC(**MODEL, eta=2e6, phi=0.0, k_n=500.0, Delta=600.0))
    assert chattering(sharp)[0] > 2 * chattering(smooth)[0]


ONE = {"sigma": np.zeros((1, 1)), "eta_hat": np.zeros((1, 1))}
BAD = {
    "b = 0": lambda: SMC(A1, A2, 0.0),
    "ExponentialPD: b = 0": lambda: ExponentialPD(b=0.0),
    "lead = 250": lambda: check(FREE, ExponentialPD(lead=N), TASK),
    "works channel by channel": lambda: SMC(**MODEL).check(Task(np.zeros((9, 2)), dt=DT, inputs=1)),
    "no signal 'eta_hat'": lambda: ASMC(**MODEL, carry=True).learn(
        None, measured_trial(TASK, bump(), FORCE)
    ),
    "no signal 'sigma'": lambda: sliding(
        SMC(**MODEL), measured_trial(TASK, bump(), FORCE, eta_hat=FORCE)
    ),
    "sliding: the trial has N = 1 sample": lambda: sliding(
        SMC(**MODEL), measured_trial(Task(bump()[:2], dt=DT), bump()[:2], FORCE[:1], **ONE)
    ),
    "sliding: PID": lambda: sliding(PID(), measured_trial(TASK, bump(), FORCE)),
    "within_layer: PIDType": lambda: within_layer(PIDType()),
    "printed_condition: WithFeedback -> PIDType": lambda: printed_condition(
        WithFeedback(PIDType(), SMC(**MODEL)), TASK
    ),
    "sampled_condition: PID": lambda: sampled_condition(
        FREE, WithFeedback(ExponentialPD(), PID()), TASK
    ),
    "frequencies = ": lambda: printed_condition(
        WithFeedback(ExponentialPD(), SMC(**MODEL)), TASK, frequencies=[-1.0]
    ),
    r"a weight has shape \(2,\)": lambda: printed_condition(
        WithFeedback(ExponentialPD(K_P=(1.0, 2.0)), SMC(**MODEL)), TASK
    ),
}
test_bad_input_is_named = refused(BAD)
