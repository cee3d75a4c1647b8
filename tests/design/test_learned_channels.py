"""Learned laws of several channels and of several segments, against NumPy's matrices."""

import dataclasses

import numpy as np
import pytest

from jaxilc import Machine, Sensor, Task, Uniform
from jaxilc.design import LearnedLaw
from jaxilc.design.by_response import by_response, of_matrices, sizes_of
from jaxilc.design.judging import Proof
from jaxilc.design.responses import designed_on, family_of
from jaxilc.design.window import ShapedFilter, along, window_of
from jaxilc.plants import StateSpace
from jaxilc.schemes import PID, LearningFilter, WithFeedback
from jaxilc.schemes.learning_filter import segments_of
from jaxilc.tuning.over_family import OverFamily

DT, N, BELOW = 1e-3, 80, 0.9
A, B = np.diag([0.9, 0.8]), np.array([[0.1, 0.05], [-0.06, 0.2]])
T = np.linspace(0, 1, N + 1)
TASK = Task(np.stack([np.sin(np.pi * T) ** 2, 0.1 * np.sin(2 * np.pi * T) ** 2], 1), dt=DT)
MACHINE = Machine(StateSpace(A, B, np.eye(2), dt=DT), None, Sensor(noise=1e-4))
SPREAD = {"plant.B": Uniform(0.9, 1.1, relative=True)}
RNG = np.random.default_rng(4)


@pytest.fixture(scope="module")
def family():
    return family_of(designed_on(MACHINE, SPREAD, machines=3), None, TASK, points=40, several=True)


@pytest.fixture(scope="module")
def window(family):
    return window_of(family, TASK, (7, 5))


@pytest.fixture(scope="module")
def found(family, window):
    return by_response(family, window, window.nothing(), TASK, 4, BELOW, steps=200)[0]


def response(taps, middle, f):
    """(F, n, m) sum_i taps_i z^(middle + i)"""
    powers = middle + np.arange(len(taps)) - len(taps) // 2
    return np.einsum("fp,pij->fij", np.exp(2j * np.pi * DT * np.outer(f, powers)), taps)


@pytest.mark.thorough
def test_the_responses_and_the_first_error_are_those_of_the_matrices(family):
    z = np.exp(2j * np.pi * DT * family.frequencies)[:, None, None]
    P = np.linalg.solve(z * np.eye(2) - A, B + 0j)
    gains = family.drawn["plant.B"]
    np.testing.assert_allclose(family.P, gains[:, None, None, None] * P, rtol=1e-9)
    square = np.sum(np.abs(family.error) ** 2, axis=(0, 2))
    np.testing.assert_allclose(square, np.mean(TASK.reference[1:] ** 2, axis=0), rtol=1e-9)


def test_the_sizes_are_the_largest_singular_values(family, window):
    filters = window.nothing()
    filters = filters._replace(L=RNG.standard_normal(filters.L.shape))
    f = family.frequencies
    keep, L = response(filters.keep, 0, f), response(filters.L, 1 + window.lead, f)
    expected = np.linalg.norm(keep - L @ family.P, ord=2, axis=(-2, -1))
    np.testing.assert_allclose(sizes_of(family, window, filters, DT), expected, rtol=1e-9)


def test_the_predicted_error_is_that_of_the_recursion(family, window):
    """Each root of the cross spectrum is learned, trial after trial, by the law itself."""
    filters = window.nothing()
    filters = filters._replace(L=0.2 * RNG.standard_normal(filters.L.shape))
    of_L, of_keep = window.responses(family.frequencies, DT)
    keep, L = along(of_keep + 0j, filters.keep), along(of_L, filters.L)
    quiet, near = family._replace(noise=0 * family.noise), 1e9
    units = 1 / np.max(np.abs(family.first_error), axis=0)
    u = e = np.zeros((*family.P.shape[:3], 2), complex)
    for _ in range(4):
        e = family.error - family.P @ u
        u = keep @ u + L @ e
    expected = np.sum(np.abs(units[:, None] * e) ** 2, axis=(1, 2, 3))
    _, (square,) = of_matrices(quiet, keep, L, (4,), near)
    np.testing.assert_allclose(square, expected, rtol=1e-8)


@pytest.mark.thorough
def test_full_matrices_learn_what_crosses_over_and_those_of_each_channel_do_not(
    family, window, found
):
    """The plant mixes its inputs; a law of matrices undoes that within the same bound."""
    alone = window_of(family, TASK, (7, 5), coupled=False)
    diagonal, _ = by_response(family, alone, alone.nothing(), TASK, 4, BELOW, steps=200)
    for own in diagonal:  # what the other channel has learned does not come in by keep either
        assert np.all(own[:, [0, 1], [1, 0]] == 0)
    assert np.all(np.abs(found.L[:, [0, 1], [1, 0]]).max(axis=0) > 0.1)
    squares = []
    for filters in (found, diagonal):
        assert sizes_of(family, window, filters, DT).max() <= BELOW + 0.02
        of_L, of_keep = window.responses(family.frequencies, DT)
        responses = along(of_keep + 0j, filters.keep), along(of_L, filters.L)
        squares.append(of_matrices(family, *responses, (4,), 0.97)[1][0])
    assert np.mean(squares[0]) < 0.5 * np.mean(squares[1])


def test_steps_along_the_directions_lead_from_taps_to_taps_of_channels_and_segments(family):
    for starts in ((), (20, 50)):
        window = window_of(family, TASK, (7, 5), starts=starts)
        start = window.nothing()
        z = RNG.standard_normal(window.number_of_steps())
        there = window.moved(start, z)
        shaped = dataclasses.replace(ShapedFilter.around(window, start), z=z).taps()
        np.testing.assert_allclose(shaped.L, there.L, atol=1e-12)
        back = window.moved(start, window.steps(start, there))
        for one, other in zip(back, there, strict=True):
            np.testing.assert_allclose(one, other, atol=1e-9)
        assert there.L.shape == ((3,) if starts else ()) + (7, 2, 2)


def test_each_segment_of_a_scheduled_law_is_a_law_that_the_penalty_sees():
    L, starts = RNG.standard_normal((2, 5)), (30,)
    law = LearningFilter(L, [0.1, 0.8, 0.1], lead=1, starts=starts)
    under = WithFeedback(law, PID(kp=0.1))
    for scheme in (law, under):
        parts = segments_of(scheme)
        assert [type(part) for part in parts] == [type(scheme)] * 2
        inner = [getattr(part, "learning", part) for part in parts]
        np.testing.assert_array_equal([part.L for part in inner], L)
        assert all(part.starts == () for part in inner)
    assert len(segments_of(inner[0])) == 1
    f, P = np.linspace(5.0, 400.0, 9), RNG.standard_normal((2, 9)) + 0j
    task, sizes = Task(np.zeros(N + 1), dt=DT), []
    for taps in L:
        of_L = np.exp(2j * np.pi * DT * np.outer(f, 2 + np.arange(-2, 3))) @ taps
        sizes.append(np.abs(0.8 + 0.2 * np.cos(2 * np.pi * f * DT) - of_L * P).max())
    term, run = OverFamily(f, P, below=0.1), type("Run", (), {"scheme": law, "task": task})
    least = np.log(max(sizes) / 0.1)
    above = float(term(run)) - least
    assert -1e-9 <= above <= np.log(2 * P.size) / term.sharpness


def test_the_segments_of_a_law_part_in_the_tuning_only(tmp_path):
    """The error of a part of the trial has cut ends, which would mislead the search."""
    asked = LearnedLaw(MACHINE, TASK, 4, {}, taps=(5, 3), steps=0, starts=(50,))
    told = {}

    def stop_when_found(stage, what):
        told[stage] = what
        raise InterruptedError

    family, folder = asked.resolved(), tmp_path / "law"
    with pytest.raises(InterruptedError):
        asked.learned_taps(family, [], folder, resume=False, told=stop_when_found)
    L, keep = told["found"]
    assert L.shape == (2, 5, 2, 2)
    for one, other in (L, keep):
        np.testing.assert_array_equal(one, other)


def test_a_scheduled_law_without_a_claim_is_refused():
    """The test by frequency does not tell what happens where one segment meets the next."""
    told = Proof(0.8, 0.9, 10.0, {}, 1, ("converges", "not claimed"), ("it does", "who knows"))
    assert told.refuted == ""
    assert "because who knows" in told._replace(scheduled=True).refuted


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"starts": (0,)}, r"starts = \(0,\) are not allowed"),
        ({"starts": (50, 20)}, "whole samples that rise within a trial of 80"),
        ({"starts": (80,)}, r"starts = \(80,\)"),
        ({"limit": -1.0}, "limit = -1"),
        ({"start": "inverse"}, "start = 'inverse' is not possible with 2 inputs and 2 outputs"),
    ],
)
def test_what_is_not_possible_is_named(setting, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        LearnedLaw(MACHINE, TASK, 4, SPREAD, taps=(7, 5), **setting).run(tmp_path / "out")
