"""Where the taps of a learned law begin: their leads, both ends of a trial, and the exchange."""

import numpy as np
import pytest

from jaxilc import Machine, Sensor, Task, Uniform
from jaxilc.design.by_response import (
    best_of_leads,
    by_response,
    exchanged,
    radius_in_a_trial,
    sizes_of,
)
from jaxilc.design.responses import designed_on, family_of
from jaxilc.design.window import Filters, leads_of, window_of
from jaxilc.plants import ProcessModel, StateSpace
from jaxilc.tuning.risks import CVaR, Mean

DT, N, TRIALS, BELOW = 1e-3, 240, 5, 0.9
TASK = Task(np.sin(np.linspace(0, 6 * np.pi, N + 1)) ** 2, dt=DT)
LAG = Machine(StateSpace([[0.99]], [[0.01]], [[1.0]], dt=DT), None, Sensor(noise=1e-5))


def resonant_machine(damping):
    plant = ProcessModel(1.0, frequencies=[400.0, 1100.0], dampings=[0.7, damping])
    return Machine(plant, None, Sensor(noise=1e-5))


RESONANT, SHARP = resonant_machine(0.02), resonant_machine(0.015)
SPREAD = {"plant.frequencies[1]": Uniform(0.85, 1.15, relative=True)}


def of(machine, spread, besides=None, **drawn):
    population = designed_on(machine, spread, **drawn)
    return family_of(population, None, TASK, points=60, taps=21, besides=besides)


@pytest.fixture(scope="module")
def lag():
    return of(LAG, {})


@pytest.mark.thorough
def test_a_slow_pole_delays_what_is_slow_and_its_inverse_lies_at_the_start(lag):
    """P = 0.01 / (z - 0.99): a delay of some 100 samples at rest, and P^-1 = 100 z - 99."""
    slow, middle, inverse = leads_of(lag, TASK)
    assert slow > 20 > middle > inverse
    a, angle = 0.99, 2 * np.pi * lag.frequencies * DT
    delay = 1 + (a * np.cos(angle) - a * a) / (1 - 2 * a * np.cos(angle) + a * a)
    size = np.abs(0.01 / (np.exp(1j * angle) - a))
    weight = size**2 * np.gradient(angle)
    assert abs(slow - (np.sum(weight * delay) / np.sum(weight) - 1)) < 3


@pytest.mark.thorough
def test_lines_for_taps_leave_no_gap_in_which_a_response_could_rise(lag):
    coarse = family_of(designed_on(LAG, {}), None, TASK, points=60)
    assert (
        np.max(np.diff(lag.frequencies)) <= 1 / (4 * 21 * DT) < np.max(np.diff(coarse.frequencies))
    )
    assert set(np.round(coarse.frequencies, 9)) <= set(np.round(lag.frequencies, 9))


def test_the_radius_in_a_trial_is_that_of_matrices(lag):
    window = window_of(lag, TASK, (5, 3), lead=1)
    L, keep = np.array([0.5, -1.0, 3.0, 2.0, -0.5]), np.array([0.05, 0.9, 0.05])
    M, P = np.zeros((N, N)), np.zeros((N, N))
    for k in range(N):
        P[k, : k + 1] = 0.01 * 0.99 ** np.arange(k, -1, -1)  # y[k + 1] of u
    for k in range(N):
        for i in range(3):
            M[k, min(max(k + i - 1, 0), N - 1)] += keep[i]  # mirrored at both ends
        for i in range(5):
            if 0 <= k + 1 + i - 2 < N:  # e[k + 1 + lead + i - 2] is row k + lead + i - 2
                M[k] -= L[i] * P[k + 1 + i - 2]
    expected = np.max(np.abs(np.linalg.eigvals(M)))
    found = radius_in_a_trial(lag, window, Filters(L, keep), TASK)
    np.testing.assert_allclose(found, expected, rtol=1e-9)


@pytest.mark.thorough
def test_of_the_leads_one_with_safe_ends_is_taken_and_of_these_the_best(lag, monkeypatch):
    def at(lead):
        return window_of(lag, TASK, (21, 11), lead=lead)

    losses, args = {}, (TASK, TRIALS, BELOW)
    for lead in leads_of(lag, TASK):
        losses[at(lead).lead] = by_response(lag, at(lead), at(lead).nothing(), *args, steps=150)[1]
    lead, filters = best_of_leads(lag, at, [None], *args, Mean())
    assert lead == min(losses, key=losses.get)
    assert sizes_of(lag, at(lead), filters, DT).max() < 1
    monkeypatch.setattr(
        "jaxilc.design.by_response.radius_in_a_trial", lambda f, w, *_: float(w.lead == lead)
    )
    assert best_of_leads(lag, at, [None], *args, Mean())[0] != lead


@pytest.mark.thorough
def test_machines_between_those_of_a_family_join_it_until_none_breaks_the_bound():
    def joined(besides):
        return of(SHARP, SPREAD, besides, machines=2)

    resonant = joined({})
    window = window_of(resonant, TASK, (21, 11))
    watch = of(SHARP, SPREAD, machines=33, seed=4)
    args = (TASK, TRIALS, BELOW)
    alone, _ = by_response(resonant, window, window.nothing(), *args)
    assert sizes_of(watch, window, alone, DT).max() > BELOW + 0.1

    found = exchanged(
        resonant, joined, lambda turn: watch, window, window.nothing(), *args, BELOW + 0.03, Mean()
    )
    assert sizes_of(watch, window, found.filters, DT).max() <= BELOW + 0.03
    (numbers,) = found.besides.values()
    assert set(numbers) <= set(watch.drawn["plant.frequencies[1]"])
    wider = joined(found.besides)
    assert len(wider.P) == len(resonant.P) + len(numbers)
    np.testing.assert_array_equal(wider.drawn["plant.frequencies[1]"][-len(numbers) :], numbers)


@pytest.mark.thorough
def test_another_risk_makes_the_worst_machines_better():
    resonant = of(RESONANT, SPREAD, machines=2)
    window = window_of(resonant, TASK, (21, 11))
    args = (resonant, window, window.nothing(), TASK, TRIALS, BELOW)
    to_L, to_keep = window.responses(resonant.frequencies, DT)
    worst = []
    for risk in (Mean(), CVaR(0.9)):
        filters, _ = by_response(*args, risk=risk)
        keep = to_keep @ filters.keep
        worst.append(np.max(resonant.rms(keep, (to_L @ filters.L) / keep, TRIALS)))
    assert worst[1] < worst[0]
