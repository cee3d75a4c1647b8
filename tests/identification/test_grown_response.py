"""Models of flexible machines from measured lines: oracles, simulated machines, a measured one."""

import os
from pathlib import Path

import numpy as np
import pytest
from command import write_columns

from jaxilc.identification import (
    grow_response,
    grown_response,
    identified_response,
    read_frequency_response,
)
from jaxilc.identification.grown_response import numbers, parts_at, response_band
from jaxilc.identification.problem import Parts
from jaxilc.outcomes import identify
from jaxilc.pytree.named_paths import replaced
from jaxilc.theory.on_lines import MeasuredResponse

DT = 1e-3
F = np.linspace(3.0, 300.0, 200)
MEASURED = os.environ.get("JAXILC_MEASURED")


def held(plant, f, dt):
    """Return the response of a plant that is sampled at dt."""
    sampled = plant.sampled(dt)
    A, B, C = (np.asarray(M) for M in (sampled.A, sampled.B, sampled.C))
    z = np.exp(2j * np.pi * f * dt)[:, None, None]
    return (C @ np.linalg.solve(z * np.eye(len(A)) - A, B))[:, 0, 0]


def drawn(lags, modes, integrators=0, direct=False, *, delay=2.3e-3):
    """Return so many parts with their numerators."""
    rng = np.random.default_rng(0)
    rates = rng.uniform(20, 2000, lags + modes)
    of_modes = np.log(np.column_stack([rates[lags:], rng.uniform(0.02, 1.5, modes)]))
    parts = Parts(of_modes, np.log(rates[:lags]), integrators, direct, delay)
    return parts, rng.normal(size=parts.numerators)


@pytest.mark.thorough(but=["double-None", "double-0.001", "lags-None"])
@pytest.mark.parametrize("dt", [None, DT])
@pytest.mark.parametrize(
    "counts", [(1, 2), (0, 2, 2, True), (2, 0, 1)], ids=["modes", "double", "lags"]
)
def test_the_columns_are_those_of_the_plant_and_the_slopes_their_differences(counts, dt):
    parts, N = drawn(*counts)
    values = grown_response.values_of(parts, N)
    plant = grown_response.model_of(parts, N)
    assert (plant.order, len(values)) == (parts.order, numbers(parts))
    found = grown_response.columns(parts, F, dt) @ N
    if dt is None:
        expected = np.asarray(plant.transfer(2j * np.pi * F))[:, 0, 0]
    else:
        expected = held(plant, F, dt)
    np.testing.assert_allclose(found, expected, rtol=1e-10)
    J = grown_response.jacobian(parts, N, F, dt)
    direction = np.random.default_rng(1).normal(size=len(values)) * 1e-6 * np.abs(values)
    n = len(parts.x)
    units = values[n:-1] / N
    moved = []
    for sign in (1, -1):
        new = values + sign * direction
        there = parts_at(parts, np.append(np.log(new[:n]), new[-1]))
        moved.append(grown_response.columns(there, F, dt) @ (new[n:-1] / units))
    slope = (moved[0] - moved[1]) / 2
    np.testing.assert_allclose(J @ direction, slope, atol=1e-6 * np.max(np.abs(slope)))


def flexible(seed, modes, integrators, lines, dt, averages, known):
    """A mass with resonances and a delay, measured with a coherence that falls with its size."""
    rng = np.random.default_rng(seed)
    f = np.linspace(3.0, 307.0, lines)
    w = 2 * np.pi * np.geomspace(18, 250, modes) * rng.uniform(0.93, 1.07, modes)
    of_modes = np.log(np.column_stack([w, rng.uniform(0.01, 0.06, modes)]))
    parts = Parts(of_modes, integrators=integrators, delay=2.6e-3)
    gains = rng.uniform(0.4, 1.5, modes) * rng.choice([1, 1, -1], modes) / w**2
    numerators = np.ravel(np.column_stack([gains, np.zeros(modes)]))
    numerators = np.concatenate([np.zeros(integrators - 1), [1 / (2 * np.pi) ** 2], numerators])
    P = grown_response.columns(parts, f, dt) @ numerators
    c = 1 / (1.02 + 0.3 * np.median(np.abs(P)) / np.abs(P))
    std = np.abs(P) * np.sqrt((1 - c) / (c * averages))
    G = P + std * ([1, 1j] @ rng.normal(size=(2, lines))) / np.sqrt(2)
    own = np.abs(G) * np.sqrt((1 - c) / (c * (averages if known else 1)))
    return parts, numerators, P, MeasuredResponse(f, G, own, c, known)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("seed", "modes", "dt", "known"), [(1, 3, DT, False), (2, 3, None, True)], ids=str
)
def test_the_order_of_a_simulated_machine_is_found_and_its_intervals_hold(seed, modes, dt, known):
    parts, N, P, measured = flexible(seed, modes, 2, 200, dt, 20, known)
    _, chosen = grow_response(measured, dt=dt, highest=parts.order + 4)
    assert chosen.parts.counts == parts.counts
    if not known:
        assert 1 / chosen.scale == pytest.approx(20, rel=0.3)  # the averages
    found = identified_response(measured, chosen, dt, None)
    assert (found.white, found.converged) == (True, True)
    relative = np.sqrt(np.mean(np.abs(found.simulated[:, 0] / P - 1) ** 2))
    noise = np.sqrt(np.mean(np.abs(measured.response / P - 1) ** 2))
    assert relative < 0.3 * noise
    names, values = grown_response.names_of(parts), grown_response.values_of(parts, N)
    true = dict(zip(names, values, strict=True))
    order = np.argsort([found.parameters[f"frequencies[{i}]"].value for i in range(modes)])
    of_modes = ("frequencies", "dampings", "mode_gains", "mode_rates")
    pairs = [(f"{n}[{i}]", f"{n}[{j}]") for j, i in enumerate(order) for n in of_modes]
    pairs += [(n, n) for n in ("delay", "double_integrator", "integrator")]
    intervals = [(found.parameters[ours], true[theirs]) for ours, theirs in pairs]
    within = [one.low <= value <= one.high for one, value in intervals]
    assert np.mean(within) > 0.8  # 95 % are expected, of numbers that are not independent


def test_machines_drawn_as_if_independent_spread_as_far_as_the_lines_are_from_the_fit():
    """Here a mode is missing in the model, so that most of the error is its own."""
    parts, _, P, measured = flexible(1, 3, 2, 150, DT, 200, True)
    growing = grown_response._Growing(measured, DT, None)
    one = growing._refined(parts.without_mode(2), (0.1, 1.0), P)
    found, rng = identified_response(measured, one, DT, None), np.random.default_rng(0)
    names = grown_response.names_of(one.parts)
    low, high = (
        np.array([getattr(found.apart.get(n, found.parameters[n]), end) for n in names])
        for end in ("low", "high")
    )
    low[-1] = high[-1] = found.plant.delay
    far = []
    for values in rng.uniform(low, high, (40, len(low))):
        there = parts_at(one.parts, np.append(np.log(values[:4]), values[-1]))
        N = values[4:-1] / grown_response._units(one.parts)
        P = grown_response.columns(there, measured.frequencies, DT) @ N
        far.append(np.abs(P - found.simulated[:, 0]))
    error = np.abs(measured.response - found.simulated[:, 0])
    assert np.mean(error <= np.quantile(far, 0.95, axis=0)) > 0.8
    assert np.median(np.quantile(far, 0.95, axis=0)) < 10 * np.median(error)


def test_a_given_delay_is_kept():
    measured = flexible(2, 1, 2, 60, None, 20, True)[-1]
    _, chosen = grow_response(measured, delay=2.6e-3, highest=4)
    found = identified_response(measured, chosen, None, 2.6e-3)
    assert found.plant.delay == 2.6e-3
    assert "delay" not in found.parameters


def test_the_band_of_the_response_knows_a_delay_that_was_fitted():
    """It was refused, as no number; the phase has that of the delay and of all numbers together."""
    measured = flexible(2, 1, 2, 60, DT, 20, True)[-1]
    found = identified_response(measured, grow_response(measured, dt=DT, highest=2)[1], DT, None)
    band = response_band(found, DT)
    slopes = []
    for name, of in found.parameters.items():
        ends = (replaced(found.plant, {name: of.value * by}) for by in (1 + 1e-6, 1 - 1e-6))
        ahead, behind = (held(end, band.f, DT) for end in ends)
        slopes.append((ahead - behind) / (2e-6 * of.value) / band.P)
    late = np.array(slopes).imag
    wanted = np.sqrt(np.einsum("if,ij,jf->f", late, found.covariance, late))
    np.testing.assert_allclose(band.half, np.rad2deg(1.96 * np.minimum(wanted, np.pi)), rtol=1e-4)


def test_a_search_moves_a_long_delay_as_far_as_a_short_one():
    s = 2j * np.pi * F
    of_lines = F, np.exp(-3e-3 * s) / (1 + s / 100), np.ones(len(F))
    for slower in (1.0, 1e6):
        f, G, weights = of_lines[0] / slower, *of_lines[1:]
        problem = grown_response.Problem(f, G, weights, None, 0.1 * slower, None)
        begin = Parts(lags=np.log([200 / slower]), delay=2e-3 * slower)
        found, *_ = problem.least_squares(begin, 25, 1e-4)
        np.testing.assert_allclose(found.delay, 3e-3 * slower, rtol=1e-3)


def test_numbers_that_the_lines_do_not_determine_have_no_interval(monkeypatch):
    """Of two equal modes, only the sum acts.

    Nothing is searched: from there the fit falls by rounding alone, as the modes move apart.
    """
    P = 1 / (1 + 2j * np.pi * F / 300 - (2 * np.pi * F / 600) ** 2)
    noise = 0.01 * ([1, 1j] @ np.random.default_rng(0).normal(size=(2, len(F))))
    measured = MeasuredResponse(F, P * (1 + noise), np.zeros(len(F)))
    growing = grown_response._Growing(measured, None, 0.0)
    equal = Parts(np.log([[600, 1], [600, 1]]), delay=0.0)

    def stays(of, parts, *_):
        return parts, of.projected(parts), True

    monkeypatch.setattr(grown_response.Problem, "least_squares", stays)
    one = growing._refined(equal, (0.01, 1.0), P)
    found = identified_response(measured, one, None, 0.0)
    assert [found.parameters[f"mode_gains[{i}]"].high for i in (0, 1)] == [np.inf, np.inf]
    assert all(np.isfinite(of.high) for of in found.apart.values())


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"frequencies": [1, 1, 2]}, "sort the lines, and keep one of each"),
        ({"frequencies": [2, 1, 3]}, "sort the lines, and keep one of each"),
        ({"coherence": [0.5, 1.1, 0.5]}, r"a coherence in \(0, 1\] for each line"),
        ({"coherence": [0.5, -0.1, 0.5]}, r"a coherence in \(0, 1\] for each line"),
        ({"response": [1, np.nan, 1]}, "not finite"),
        ({"std": [1, np.nan, 1]}, "not finite"),
        ({"std": [1, -1, 1]}, "and std from 0 on"),
        ({"response": [0, 0, 0]}, "is 0 at all lines"),
        ({"response": [1e-200] * 3}, r"the largest .response. is .*e-200; allowed is"),
        ({"response": [1e200] * 3}, r"the largest .response. is .*e[+]200; allowed is"),
        ({}, "3 lines are too few to fit"),
    ],
    ids=str,
)
def test_lines_that_are_no_response_are_refused_before_anything_is_computed(changed, said):
    lines = {"frequencies": [1, 2, 3], "response": [1, 1, 1j], "std": [0, 0, 0], **changed}
    measured = MeasuredResponse(**{name: np.array(of) for name, of in lines.items()})
    with pytest.raises(ValueError, match=said):
        grow_response(measured, each=lambda order: pytest.fail("computed"))


def test_a_structure_whose_search_fails_does_not_take_the_grown_model_with_it(
    tmp_path, monkeypatch
):
    f = np.linspace(3.0, 300.0, 16)
    s = 2j * np.pi * f
    G = 1 / (1 + 2 * 0.05 * s / 500 + (s / 500) ** 2)
    write_columns(tmp_path / "frf.csv", "f [Hz],re,im,std", f, G.real, G.imag, 0.01 * np.abs(G))

    def failing(*_, **__):
        raise ValueError("ProcessModel: dampings = [0.] is outside its allowed range (0, inf)")

    monkeypatch.setattr("jaxilc.identification.compare_response_orders", failing)
    found = identify(tmp_path / "frf.csv", folder=tmp_path)
    assert found.numbers["frequencies[0]"]["value"] == pytest.approx(500, rel=1e-6)


@pytest.mark.skipif(MEASURED is None, reason="JAXILC_MEASURED names no folder of measured records")
def test_a_measured_printer_is_fitted_better_than_by_vector_fitting():
    """A vector fitting of order 20 has 92.4 %, 7 %, and 71 % and 99 % of the lines."""
    measured = read_frequency_response(Path(MEASURED) / "arizona_x_frf.csv")
    _, chosen = grow_response(measured)
    assert chosen.fit > 92.4
    assert chosen.median < 0.07
    assert np.all(np.array(chosen.within) > (0.71, 0.99))
