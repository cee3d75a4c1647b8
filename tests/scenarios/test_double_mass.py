"""The double mass of IterativeLearningControl2.jl: its loops against python-control, its rows."""

import control
import numpy as np
import pytest

from jaxilc.scenarios import load, reproduce
from jaxilc.scenarios.double_mass import SAMPLE_TIME, closed_loop


def test_the_loops_are_those_that_python_control_closes():
    loop, of_load = closed_loop(1.5), np.array([100, 1, -100, -2]) / 1.5
    A = [[0, 1, 0, 0], [-100, -2, 100, 1], [0, 0, 0, 1], of_load]
    G = control.ss(A, [[0], [1], [0], [0]], [[1, 0, 0, 0]], 0)
    C = control.ss(control.tf([10, 20, 10], [SAMPLE_TIME, 1, 0]))
    f = np.geomspace(0.1, 100, 30)
    for B, row, direct, theirs in (
        (loop.of_reference, loop.states[:1], 0.0, control.feedback(G * C)),
        (loop.of_input, loop.states[:1], 0.0, control.feedback(G, C)),
        (loop.of_reference, loop.controller, loop.direct, control.feedback(C, G)),
        (loop.of_input, -loop.controller, 0.0, control.feedback(C * G)),
    ):
        ours = control.ss(loop.A, B, row, direct)
        np.testing.assert_allclose(ours(2j * np.pi * f), theirs(2j * np.pi * f), rtol=1e-8)


def test_all_numbers_agree_to_the_digits_that_they_have():
    rows = reproduce(["double-mass"])
    assert [row.verdict for row in rows] == ["agrees"] * 11
    digits = [abs(row.ratio - 1) for row in rows if row.published.agreement < 1e-5]
    assert len(digits) == 8
    assert max(digits) < 1e-9


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"load": -1.0}, "load = -1.0 is outside its allowed range"),
        ({"at": "output"}, "at = 'output' is not one of 'input', 'reference'"),
        ({"second": "torque"}, "second = 'torque' is not one of"),
    ],
)
def test_other_options_are_named(options, said):
    with pytest.raises(ValueError, match=said):
        load("double-mass", **options)
