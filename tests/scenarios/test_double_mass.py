"""The double mass of IterativeLearningControl2.jl: its loops against python-control, its rows."""

import control
import numpy as np
import pytest

from jaxilc.outcomes.running import reading_lines
from jaxilc.scenarios import load, reproduction
from jaxilc.scenarios.double_mass import SAMPLE_TIME, closed_loop
from jaxilc.scenarios.published import published


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


ROWS = {
    " ".join([p.scheme, *(f"{option}={value}" for option, value in p.options)]): p
    for p in published("double-mass")
}


@pytest.mark.thorough(
    but=[
        "inverse-filter at=reference", "inverse-filter", "norm-optimal", "model-free",
        "constrained load=1.0 second=velocity",
    ]
)  # fmt: skip
@pytest.mark.parametrize("name", ROWS)
def test_a_number_agrees_to_the_digits_that_it_has(name):
    row = ROWS[name]
    ours = reproduction._simulated(load("double-mass", **dict(row.options)), [row])[row]
    assert abs(ours / row.value - 1) < (1e-9 if row.agreement < 1e-5 else row.agreement)


@pytest.mark.parametrize(
    ("name", "options", "values"),
    [
        ("double-mass", {"load": 1.0, "reference": "square", "second": "controller"}, [4.94069]),
        ("double-mass", {}, [1.41639, 0.561513, 0.885191, 0.934732]),
        ("double-mass", {"load": 1.0}, []),
        ("dai-2014", {"frequency": 2.5, "plant": "exact"}, [0.061, 0.047]),
        ("cao-2019", {"frequency": 1.0}, []),
    ],
)
def test_a_run_has_the_rows_of_its_own_setting(name, options, values):
    """An option that a row does not name is as it usually is; a plant may have another form."""
    assert [p.value for p in load(name, **options).due] == pytest.approx(values, rel=1e-5)


def test_what_is_said_of_numbers_beside_ours_is_how_they_are_judged():
    def said(**rows):
        kinds = {"printed": None, "software": 1e-3}
        of = [{"met": met, "agreement": kinds[k]} for k, several in rows.items() for met in several]
        return reading_lines(load("double-mass"), {"schemes": {"a": {"published": of}}})

    assert said(printed=[True, None], software=[True]) == []
    end = "jaxilc reproduce double-mass says how each number was read."
    one = "1 of 2 numbers of other software agree. "
    assert said(software=[True, False, None]) == [one + end]
    two = "0 of 1 published numbers are met within 30 %. "
    assert said(printed=[False], software=[True, False]) == [two + one + end]
