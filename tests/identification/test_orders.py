"""The choice of an order is compared with statistics in closed form, on fits made by hand."""

import numpy as np
import pytest

from jaxilc.identification import Estimate, Identified, Record, estimation, not_significant
from jaxilc.identification.estimation import (
    Order,
    best_order,
    compare_orders,
    information,
    long_enough,
)
from jaxilc.plants import ProcessModel

RECORD = Record(np.ones((200, 1)), np.sin(np.arange(201.0))[:, None], 1e-3)


def made(parameters, plant=None, samples=140, simulated=None, converged=True):
    """An identification with these estimates (value, half-width)."""
    return Identified(
        plant=plant or ProcessModel(1.0, (), (60.0,)),
        parameters={name: Estimate(v, v - h, v + h) for name, (v, h) in parameters.items()},
        covariance=np.eye(len(parameters)), poles=(), samples=samples,
        simulated=np.zeros((201, 1)) if simulated is None else simulated, fit=np.array([99.0]),
        validation_fit=np.array([98.0]), residual_std=np.array([0.01]), whiteness=np.array([1.0]),
        white=True, converged=converged,
    )  # fmt: skip


def test_the_criterion_charges_ln_n_for_each_parameter():
    e = np.random.default_rng(0).normal(size=500)
    likelihood = np.sum(-0.5 * np.log(2 * np.pi * np.mean(e**2)) - e**2 / (2 * np.mean(e**2)))
    # -2 ln(likelihood) + p ln n, without the constant n (1 + ln 2 pi)
    expected = -2 * likelihood + 4 * np.log(500) - 500 * (1 + np.log(2 * np.pi))
    assert information(e, 4) == pytest.approx(expected, rel=1e-12)
    assert information(0 * e, 4, 1e-9) == information(1e-12 * e, 4, 1e-9)


def test_a_parameter_that_only_fits_noise_is_not_chosen(monkeypatch):
    """The residual of (0, 1, 0) is smaller than that of (1, 0, 0) by less than a parameter pays."""
    y = RECORD.y[:140, 0]
    factor = {(1, 0, 0): 0.1, (0, 1, 0): 0.0999, (1, 1, 0): 0.05, (0, 2, 0): 0.0499}
    asked = []

    def identified(record, *, poles, pairs, zeros, delay, starts, seed):
        asked.append((poles, pairs, zeros))
        names = ["gain", *map(str, range(poles + 2 * pairs + zeros)), "bias"]
        simulated = (1 - factor[poles, pairs, zeros]) * record.y
        return made(dict.fromkeys(names, (1.0, 0.1)), simulated=simulated)

    monkeypatch.setattr(estimation, "identify", identified)
    found = compare_orders(RECORD, structures=tuple(factor))
    assert asked == list(factor)
    assert [one.parameters for one in found] == [3, 4, 5, 6]
    rms = np.sqrt(np.mean(y**2)) * np.array([*factor.values()])
    np.testing.assert_allclose([one.rms for one in found], rms, rtol=1e-12)
    assert found[1].bic > found[0].bic
    best = best_order(found)
    assert (best.poles, best.pairs, best.zeros) == (1, 1, 0)
    # of 24 samples 17 are fitted: enough for three parameters
    assert not long_enough(RECORD._replace(y=RECORD.y[:24]), 4)
    assert long_enough(RECORD._replace(y=RECORD.y[:24]), 3)


def test_a_fit_that_did_not_converge_is_a_last_resort():
    one = Order(1, 0, 0, 3, 0.1, 5.0, 90.0, made({}))
    other = one._replace(bic=-5.0, found=made({}, converged=False))
    assert best_order([other, one]) is one
    assert best_order([other]) is other
    with pytest.raises(ValueError, match="is empty"):
        best_order([])


PLANT = ProcessModel(1.0, (-60.0,), (60.0,), (300.0,), (0.5,))


@pytest.mark.parametrize(
    ("parameters", "said"),
    [
        ({"zeros[0]": (-900.0, 100.0), "poles[0]": (60.0, 1.0)}, []),
        # 1 / zero within (1 +- 1.2) / -900
        ({"zeros[0]": (-900.0, 1080.0)}, ["the zero zeros[0] = -900 rad/s is not significant"]),
        ({"poles[0]": (60.0, np.inf)}, ["the pole poles[0] = 60 rad/s is not significant"]),
        ({"frequencies[0]": (300.0, 400.0)}, ["the pair of poles frequencies[0] = 300"]),
        (
            {"zeros[0]": (-61.0, 2.0), "poles[0]": (58.0, 2.0)},
            ["the zero zeros[0] and the pole poles[0] are not significant"],
        ),
        ({"zeros[0]": (61.0, 2.0), "poles[0]": (60.0, 2.0)}, []),  # in the right half-plane
        ({"gain": (1.0, 5.0), "bias": (0.0, 1.0), "dampings[0]": (0.5, 1.0)}, []),
    ],
)
def test_what_the_record_does_not_show_is_named(parameters, said):
    found = not_significant(made(parameters, PLANT))
    assert len(found) == len(said)
    assert all(sentence.startswith(start) for sentence, start in zip(found, said, strict=True))
