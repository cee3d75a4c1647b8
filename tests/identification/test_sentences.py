"""The sentences at the end of an identification say what was found."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from jaxilc.identification import Estimate, Identified
from jaxilc.identification.sentences import NOT_CONVERGED, NOT_WHITE, described, on_lines, verdict
from jaxilc.plants import ProcessModel
from jaxilc.theory.on_lines import MeasuredResponse

FOUND = Identified(
    plant=ProcessModel(2.0, (), (60.0,), (200.0,), (0.3,)),
    parameters={"gain": Estimate(2.0, 1.9, 2.1), "poles[0]": Estimate(60.0, 59.0, 61.0)},
    covariance=np.eye(2), poles=(), samples=700, simulated=np.zeros((1001, 1)),
    fit=np.array([98.7]), validation_fit=np.array([98.1]), residual_std=np.array([0.01]),
    whiteness=np.array([0.95]), white=True, converged=True,
)  # fmt: skip
LINES = FOUND._replace(of_response=True, validation_fit=np.array([np.nan]), std_known=True)


def delayed(delay):
    return FOUND._replace(plant=dataclasses.replace(FOUND.plant, delay=delay))


@pytest.mark.parametrize(
    ("found", "dt", "said"),
    [
        (FOUND, 1e-3, "Order 3"),
        (delayed(0.004), 1e-3, "Order 3 with a delay of 4 samples"),
        (delayed(0.001), 1e-3, "Order 3 with a delay of 1 sample"),
        (delayed(0.0024), 1e-3, "Order 3 with a delay of 2.4 samples"),
        (delayed(0.0024), None, "Order 3 with a delay of 2.4 ms"),
    ],
)
def test_a_plant_in_words(found, dt, said):
    assert described(found, dt) == said


def test_a_good_fit_is_one_sentence():
    assert verdict(FOUND, 1e-3) == [
        "Order 3 fits 98.7 % of the output (98.1 % of the part that was not fitted), and the "
        "residual is white."
    ]
    good = LINES._replace(residual_std=np.array([1.1]))
    assert verdict(good, None) == [
        "Order 3 fits 98.7 % of the measured response, and the residual is white."
    ]


@pytest.mark.parametrize(
    ("share", "said"),
    [
        (-0.3, "a constant would fit the part that was not fitted better"),
        (np.nan, "in the part that was not fitted it rests, which tests nothing"),
    ],
)
def test_no_share_of_a_part_is_negative(share, said):
    (line,) = verdict(FOUND._replace(validation_fit=np.array([share])), 1e-3)
    assert f"98.7 % of the output ({said}), and" in line


def test_what_is_wrong_is_said():
    bad = FOUND._replace(
        white=False, converged=False, parameters={"zeros[0]": Estimate(9.0, -90.0, 108.0)}
    )
    first, *others = verdict(bad, 1e-3)
    assert first.endswith("not fitted).")
    assert others[:2] == [NOT_WHITE, NOT_CONVERGED]
    assert others[2].startswith("The zero zeros[0] = 9 rad/s is not significant")
    doubted = LINES._replace(residual_std=np.array([3.2]))
    assert "The residual is 3.2 times the standard deviation of the lines" in verdict(doubted, 1)[1]
    relative = doubted._replace(std_known=False)
    assert len(verdict(relative, 1)) == 1


def test_what_is_left_of_lines_without_scatter_may_be_noise():
    chosen = SimpleNamespace(
        parts=SimpleNamespace(order=3), bic=0.0, held_out=0.0, within=(1.0, 1.0), median=0.008,
        floor=0.0106, scale=0.0, share_of_noise=0.0,
    )  # fmt: skip
    one = np.ones(1)
    left = {
        told: on_lines([chosen], chosen, MeasuredResponse(one, one, told * one, one, False))[-1]
        for told in (True, False)
    }
    assert left[True].startswith("What is left is 1.06 % of the response, and no noise: parts")
    assert "how much of it is noise the lines do not tell" in left[False]
