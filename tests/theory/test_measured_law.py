"""The test of a law on measured lines, against sums written out here."""

import numpy as np
import pytest

from jaxilc.theory.on_lines import MeasuredResponse
from jaxilc.theory.q_filter import PLaw, measured_question, spacings

DT = 1e-3
F = np.arange(1.0, 300.0)
LAW = PLaw(0.5, 6, 30.0, 2, DT)


def plant(f, gain=1.0, zeta=0.03):
    s, w = 2j * np.pi * f, 2 * np.pi * 60
    return gain / (1 + s / 200) / (1 + 2 * zeta * s / w + (s / w) ** 2) * np.exp(-0.5e-3 * s)


def record(share=0.01, f=F, **plants):
    P = plant(f, **plants)
    return MeasuredResponse(f, P, share * np.abs(P))


def robust(one, law, sigmas):
    Q = 1 / (1 + (np.tan(np.pi * one.frequencies * DT) / np.tan(np.pi * law.cutoff * DT)) ** 4)
    L = law.gain * np.exp(2j * np.pi * one.frequencies * DT * (1 + law.lead))
    return Q * (np.abs(1 - L * one.response) + np.abs(L) * sigmas * one.std)


def test_the_robust_value_of_each_line_and_of_the_worst_record():
    records = [record(), record(0.05, gain=1.2)]
    found = measured_question(records, LAW, sigmas=2.0)
    for one, test in zip(records, found.tests, strict=True):
        np.testing.assert_allclose(test.curves.high, robust(one, LAW, 2.0), rtol=1e-12)
    assert found.peak == pytest.approx(max(np.max(robust(one, LAW, 2.0)) for one in records))
    for offer in found.offers:
        law = LAW._replace(**offer.settings)
        assert max(np.max(robust(one, law, 2.0)) for one in records) <= 0.9


def test_no_plant_within_the_scatter_exceeds_it():
    one, random = record(0.1), np.random.default_rng(2)
    found = measured_question([one], LAW, sigmas=1.0)
    away = random.uniform(size=(50, len(F))) * np.exp(
        2j * np.pi * random.uniform(size=(50, len(F)))
    )
    for P in one.response + one.std * away:
        moved = robust(MeasuredResponse(F, P, 0 * one.std), LAW, 0.0)
        assert np.all(moved <= found.tests[0].curves.high + 1e-12)


def test_the_width_of_a_resonance_and_its_lines():
    fine, coarse = (spacings(record(f=np.arange(1.0, 300.0, d)))[0] for d in (0.25, 1.5))
    # the half-power width of a resonance is 2 zeta f
    assert fine.frequency == pytest.approx(60.0, abs=0.25)
    assert fine.width == pytest.approx(2 * 0.03 * 60, rel=0.05)
    assert fine.lines == pytest.approx(fine.width / 0.25, rel=1e-6)
    assert fine.fine
    assert not coarse.fine
    assert spacings(record(zeta=0.9)) == []


@pytest.mark.parametrize("averages", [4, 16])
def test_a_peak_of_noise_is_no_resonance_and_a_line_lies_beyond_its_scatter_as_often_as_said(
    averages,
):
    rng, shape, beyond = np.random.default_rng(3), (averages, len(F)), []
    for zeta in (0.9,) * 20 + (0.03,):
        P = plant(F, zeta=zeta)
        u, noise = (of[0] + 1j * of[1] for of in rng.normal(size=(2, 2, *shape)))
        y = P * u + 0.03 * noise
        S, S_u, S_y = ((a.conj() * b).sum(0) for a, b in ((u, y), (u, u), (y, y)))
        c = np.abs(S) ** 2 / (S_u * S_y).real
        std = np.abs(S / S_u) * np.sqrt((1 - c) / c / (averages - 1))
        one = MeasuredResponse(F, S / S_u, std, c, averages=averages)
        found = [of.frequency for of in spacings(one)]
        assert found == ([] if zeta == 0.9 else [pytest.approx(60, abs=1)])
        beyond.append(np.abs(one.response - P) > one.scatter(1.5))
    assert np.mean(beyond) == pytest.approx(np.exp(-(1.5**2)), rel=0.1)


@pytest.mark.parametrize(
    ("law", "one", "said"),
    [
        (LAW._replace(cutoff=500.0), record(), r"cutoff = 500 Hz is outside .*\(0, 500\)"),
        (LAW._replace(cutoff=np.nan), record(), "cutoff = nan"),
        (LAW._replace(gain=0.0), record(), "gain = 0 is not allowed"),
        (LAW._replace(lead=-1), record(), "lead"),
        (
            LAW._replace(lead=1001),
            record(),
            r"lead = 1001 is outside its allowed range \[0, 1000\]",
        ),
        (LAW._replace(dt=-1.0), record(), "dt"),
        (LAW._replace(dt=2e-3), record(), "has a line at 299 Hz; allowed is up to 250 Hz"),
        (LAW, record(f=np.arange(50.0, 200.0)), "starts at 50 Hz and has 0 lines up to the cutoff"),
    ],
)
def test_what_does_not_fit_is_named(law, one, said):
    with pytest.raises(ValueError, match=said):
        measured_question([one], law)
