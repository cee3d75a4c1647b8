"""The figure of a learned law shows its taps, and the sizes that NumPy finds."""

import numpy as np
import pytest

from jaxilc import Task, figures
from jaxilc.design import Learned
from jaxilc.design.learned import Passed
from jaxilc.design.responses import Family
from jaxilc.design.window import Filters, window_of
from jaxilc.uncertainty import Population

DT, F = 1e-3, np.geomspace(1.0, 500.0, 40)
Z = np.exp(2j * np.pi * F * DT)
P = np.stack([0.2 / (Z - 0.8), 0.25 / (Z - 0.7)])
FAMILY = Family(F, P, np.ones(40), np.ones(101), np.zeros(40), [], {}, Population(None))
WINDOW = window_of(FAMILY, Task(np.zeros(101), dt=DT), (7, 5))
TAPS = Filters(np.arange(7.0) / 10, np.array([0.0, 0.1, 0.8, 0.1, 0.0]))


def of(passed, refused=""):
    return Learned(None, refused, None, {}, None, passed, WINDOW, FAMILY, 3, 9, 5)


def test_the_figure_shows_the_taps_and_their_responses():
    axes = figures.learned_law_figure(of(Passed(TAPS, 0.0, 0.9)), DT, unit="V/mm")
    shift, taps = axes[0, 0].lines[0].get_data()
    np.testing.assert_allclose(taps, TAPS.L)
    np.testing.assert_allclose(shift, 1.0 + WINDOW.lead + np.arange(-3, 4))  # ms
    L = np.sum(TAPS.L * Z[:, None] ** (1 + WINDOW.lead + np.arange(-3, 4)), axis=1)
    Q = 0.8 + 0.2 * np.cos(2 * np.pi * F * DT)
    shown = {line.get_label(): line.get_ydata() for one in axes[1] for line in one.lines}
    np.testing.assert_allclose(shown["|L|, learned"], np.abs(L), rtol=1e-9)
    np.testing.assert_allclose(shown["|Q / P|"], np.abs(Q / P[0]), rtol=1e-9)
    np.testing.assert_allclose(shown["|Q − L P|, nominal"], np.abs(Q - L * P[0]), rtol=1e-9)
    largest = np.max(np.abs(Q - L * P), axis=0)
    np.testing.assert_allclose(shown["largest of 2"], largest, rtol=1e-9)
    assert "V/mm" in axes[1, 0].get_ylabel()


def test_a_law_that_was_refused_has_no_figure():
    with pytest.raises(ValueError, match="refused: it is not safe"):
        figures.learned_law_figure(of(None, "it is not safe"), DT)
