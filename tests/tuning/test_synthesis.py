"""Filters by convex optimisation: their margin on every line, and that they are optimal."""

import sys

import numpy as np
import pytest

from jaxilc.theory.on_lines import Lines
from jaxilc.tuning import synthesis
from jaxilc.tuning.synthesis import synthesised

DT = 1e-3
F = np.linspace(2.0, 500.0, 120)
ONE = np.ones(len(F), complex)


def lines(scatter=0.0, f=F):
    s, w = 2j * np.pi * f, 2 * np.pi * 60
    P = np.array([g / (1 + 0.4 * s / w + (s / w) ** 2) * np.exp(-s * DT) for g in (1.0, 0.8, 1.2)])
    return Lines(f, P, scatter * np.abs(P), ONE[: len(f)], ONE[: len(f)], DT)


def response(scheme, f):
    """Q and M, by the sums over their taps."""
    z = np.exp(2j * np.pi * f * DT)
    Q, M = np.asarray(scheme.keep), np.asarray(scheme.L)
    m, n = len(Q) // 2, len(M) // 2
    return (
        sum(q * z ** (i - m) for i, q in enumerate(Q)),
        sum(t * z ** (1 + scheme.lead + i - n) for i, t in enumerate(M)),
    )


def test_the_margin_is_kept_on_every_line_by_every_plant():
    pytest.importorskip("cvxpy", reason="needs CVXPY: pip install 'jaxilc[synthesis]'")
    family = lines(0.05)
    found = synthesised([family], band=40.0, margin=0.2, taps=21, lead=3)
    Q, M = response(found.scheme, F)
    sizes = np.abs(Q - M * family.P) + np.abs(M) * family.scatter
    assert np.max(sizes) == pytest.approx(found.peak, abs=1e-9)
    assert found.peak <= 0.8 + 1e-6
    assert np.max(np.abs(Q.imag)) < 1e-12
    assert response(found.scheme, np.array([0.0]))[0] == pytest.approx(1.0, abs=1e-6)
    assert np.mean(np.abs(1 - Q[F <= 40])) == pytest.approx(found.loss, abs=1e-9)
    assert found.scheme.dt == DT


def test_a_narrower_margin_loses_less_of_the_band():
    pytest.importorskip("cvxpy", reason="needs CVXPY: pip install 'jaxilc[synthesis]'")
    s, resonances = 2j * np.pi * F, 2 * np.pi * np.array([[48.0], [72.0]])
    P = np.exp(-s * DT) / (1 + 0.4 * s / resonances + (s / resonances) ** 2)
    two = Lines(F, P, 0 * np.abs(P), ONE, ONE, DT)
    wide, narrow = (synthesised([two], band=80.0, margin=m, taps=31) for m in (0.7, 0.5))
    assert 0.299 - 1e-6 < wide.peak < 0.3  # the margin decides
    assert 0.499 - 1e-6 < narrow.peak < 0.5
    assert narrow.loss < 0.6 * wide.loss


def test_beyond_the_last_line_the_plant_may_be_any_that_is_no_larger():
    pytest.importorskip("cvxpy", reason="needs CVXPY: pip install 'jaxilc[synthesis]'")
    short = lines(f=F[F < 200])
    found = synthesised([short], band=40.0, taps=15, lead=3)
    f = np.linspace(F[F < 200][-1], 500.0, 301)
    Q, M = response(found.scheme, f)
    assert np.max(np.abs(Q) + np.abs(M) * np.abs(short.P[:, -1:])) <= 0.91


def test_a_missing_extra_names_the_command(monkeypatch):
    monkeypatch.setitem(sys.modules, "cvxpy", None)
    with pytest.raises(ValueError, match=r'pip install "jaxilc\[synthesis\]"'):
        synthesis.need_solver()


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"band": 600.0}, r"band = 600 Hz is outside its allowed range \(2, 500\]"),
        ({"band": 40.0, "taps": 4}, "taps = 4 is even"),
        ({"band": 40.0, "margin": 1.0}, "margin"),
        ({"band": 40.0, "lead": -1}, "lead"),
    ],
)
def test_numbers_out_of_range_are_named(given, said):
    with pytest.raises(ValueError, match=said):
        synthesised([lines()], **given)
