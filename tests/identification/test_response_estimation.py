"""Fits to frequency responses are compared with scipy.signal, and with noise of known scatter."""

import numpy as np
import pytest
import scipy.signal

from jaxilc.identification import compare_response_orders, identify_response
from jaxilc.identification.estimation import best_order, not_significant
from jaxilc.identification.response_estimation import response_and_slopes
from jaxilc.theory.on_lines import MeasuredResponse

DT = 1e-3
F = np.linspace(2.0, 400.0, 90)
# gain, zero, pole, frequency, damping, delay
TRUE = np.array([2.0, -900.0, 80.0, 500.0, 0.15, 2.3 * DT])
COUNTS = (1, 1, 1)
NAMES = ("gain", "zeros[0]", "poles[0]", "frequencies[0]", "dampings[0]", "delay")


def from_scipy(values, f, dt):
    """Return the response by scipy.signal; a held input is simulated at ten times the rate."""
    gain, zero, pole, w, zeta, delay = values
    num = gain * np.array([-1 / zero, 1.0])
    den = np.polymul([1 / pole, 1.0], [1 / w**2, 2 * zeta / w, 1.0])
    if dt is None:
        return scipy.signal.freqs(num, den, 2 * np.pi * f)[1] * np.exp(-2j * np.pi * f * delay)
    # the samples of y after each pulse of u, simulated to the end of the answer
    fine = 10
    A, B, C, _, _ = scipy.signal.cont2discrete(scipy.signal.tf2ss(num, den), dt / fine)
    late, samples = round(delay / dt * fine), 1500
    u = np.zeros(samples * fine)
    u[late : late + fine] = 1.0
    y = scipy.signal.dlsim((A, B, C, [[0.0]], dt / fine), u)[1][::fine, 0]
    return np.exp(-2j * np.pi * np.outer(f, np.arange(samples)) * dt) @ y


@pytest.mark.parametrize("dt", [None, DT])
@pytest.mark.parametrize("delay", [0.0, 2.3 * DT, 3.0 * DT])
def test_the_response_is_that_of_scipy(dt, delay):
    values = np.append(TRUE[:-1], delay)
    found, slopes = response_and_slopes(values, COUNTS, F, dt)
    np.testing.assert_allclose(found, from_scipy(values, F, dt), rtol=1e-7)
    # to the right, where the delay is at a whole number of samples
    for i, step in enumerate(1e-6 * np.maximum(np.abs(values), 1e-3)):
        moved = values + step * np.eye(6)[i]
        twice = values + 2 * step * np.eye(6)[i]
        ahead, further = (response_and_slopes(v, COUNTS, F, dt)[0] for v in (moved, twice))
        difference = (4 * ahead - 3 * found - further) / (2 * step)
        scale = np.max(np.abs(difference))
        np.testing.assert_allclose(slopes[:, i], difference, atol=1e-5 * scale)


def measured(dt, seed=0, share=0.01, floor=1e-4):
    G, rng = from_scipy(TRUE, F, dt), np.random.default_rng(seed)
    std = share * np.abs(G) + floor
    noise = rng.normal(size=(2, len(F)))
    return MeasuredResponse(F, G + std / np.sqrt(2) * (noise[0] + 1j * noise[1]), std)


@pytest.fixture(scope="module")
def sampled():
    return identify_response(measured(DT), dt=DT, starts=32)


@pytest.mark.thorough
def test_the_parameters_lie_within_their_errors(sampled):
    """The squared errors by the covariance are chi-square of 6 degrees: 22.5 is 1 in 1000."""
    error = np.array([sampled.parameters[name].value for name in NAMES]) - TRUE
    assert error @ np.linalg.solve(sampled.covariance, error) < 22.5
    assert tuple(sampled.parameters) == NAMES
    assert sampled.plant.delay == sampled.parameters["delay"].value
    assert sampled.white
    assert sampled.converged
    # chi-square of 2 * 90 - 6 degrees: its root is 1 within 4 / sqrt(2 * 174)
    assert sampled.residual_std[0] == pytest.approx(1.0, abs=0.21)
    assert not_significant(sampled) == []
    rows = [name for name, *_ in sampled.summary()][-3:]
    assert rows == ["fit [%]", "residual / std", "residual white, share of lags"]


def test_the_intervals_are_those_of_the_fisher_information(sampled):
    values = np.array([sampled.parameters[name].value for name in NAMES])
    _, slopes = response_and_slopes(values, COUNTS, F, DT)
    J = np.sqrt(2) / measured(DT).std[:, None] * slopes
    information = np.real(J.conj().T @ J)
    half = 1.959964 * np.sqrt(np.diag(np.linalg.inv(information)))
    found = [sampled.parameters[name].high - sampled.parameters[name].value for name in NAMES]
    np.testing.assert_allclose(found, half, rtol=1e-4)


def test_the_intervals_of_few_averages_hold():
    """Squared errors by the covariance are chi-square: their mean is 1 within 4 sqrt(2 / 50)."""
    rng, true, n, found, ratios = np.random.default_rng(5), np.array([2.0, 300.0]), 4, [], []
    P = true[0] / (1 + 2j * np.pi * F / true[1])
    for _ in range(25):
        u, noise = (of[0] + 1j * of[1] for of in rng.normal(size=(2, 2, n, len(F))))
        y = P * u + 0.3 * noise
        S, S_u, S_y = ((a.conj() * b).sum(0) for a, b in ((u, y), (u, u), (y, y)))
        c = np.abs(S) ** 2 / (S_u * S_y).real
        std = np.abs(S / S_u) * np.sqrt((1 - c) / c / (n - 1))
        of = MeasuredResponse(F, S / S_u, std, c, averages=n)
        one = identify_response(of, poles=1, pairs=0, zeros=0, delay=0.0, starts=2)
        error = np.array([one.parameters[name].value for name in ("gain", "poles[0]")]) - true
        found.append(error @ np.linalg.solve(one.covariance, error) / 2)
        ratios.append(one.residual_std[0])
    assert np.mean(found) == pytest.approx(1.0, abs=0.8)
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.05)


@pytest.mark.thorough
def test_without_a_scatter_the_relative_error_is_fitted():
    lines = measured(None, share=0.02, floor=0.0)
    found = identify_response(lines._replace(std=0 * lines.std), starts=32)
    for name, true in zip(NAMES, TRUE, strict=True):
        value, low, high = found.parameters[name]
        assert abs(value - true) < 2 * (high - low)
        assert high - low < 0.3 * abs(true)
    assert found.residual_std[0] == pytest.approx(0.02, rel=0.2)


def test_the_criterion_chooses_the_order_and_a_fixed_delay_is_kept():
    of = ((0, 1, 1), (1, 1, 1))
    given = {"structures": of, "dt": DT, "delay": 2.3 * DT, "starts": 16}
    found = compare_response_orders(measured(DT, seed=2), **given)
    best = best_order(found)
    assert (best.poles, best.pairs, best.zeros) == (1, 1, 1)
    assert best.found.plant.delay == 2.3 * DT
    assert "delay" not in best.found.parameters
    assert not found[0].found.white
    chi2 = 2 * len(F) * best.rms**2
    assert best.bic == pytest.approx(chi2 + 5 * np.log(2 * len(F)), rel=1e-9)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"dt": 2e-3}, "400 Hz is not below 250 Hz, half the rate of dt = 0.002 s"),
        ({"dt": 0.0}, "dt = 0 is outside"),
        ({"delay": -1.0}, "delay = -1 is outside"),
        ({"dt": DT, "delay": 2.0}, "delay = 2 is outside"),
        ({"zeros": 3}, "zeros = 3 is outside .*, the order"),
        ({"pairs": 30}, "90 lines are too few to fit 64 parameters; allowed are at least 160"),
    ],
)
def test_what_cannot_be_fitted_is_refused(change, said):
    with pytest.raises(ValueError, match=said):
        identify_response(measured(None), **change)
