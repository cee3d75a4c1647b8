"""The criterion by which the readings of a paper are judged (`experiments/reading_search.py`)."""

import numpy as np
import output
import pytest
from reading_search import ROUNDING, WORST, Reading, bic, judged, left_out, met, misfits, search

PRINTED = np.array([8.0, 4.0, 1.0])


def test_a_misfit_is_the_same_for_twice_and_half_and_bounded():
    found = misfits(np.array([[16.0, 2.0, 1.0], [np.inf, np.nan, 0.0]]), PRINTED)
    np.testing.assert_allclose(found, [[np.log(2), np.log(2), 0.0], [WORST] * 3])


def test_the_criterion_prices_each_choice_by_the_logarithm_of_the_rows():
    """An exact reading is no better than the digits of the print, and a choice costs ln n."""
    exact = bic(PRINTED, PRINTED, 0)
    assert exact == pytest.approx(3 * np.log(ROUNDING**2))
    assert bic(PRINTED, PRINTED, 2) - exact == pytest.approx(2 * np.log(3))
    assert bic(2 * PRINTED, PRINTED, 0) == pytest.approx(3 * np.log(np.log(2) ** 2 + ROUNDING**2))


def test_free_numbers_are_fitted_to_the_fitted_rows_alone():
    """Of two values, that is taken which meets the fitted row, though the other meets more rows."""
    ours = np.array([[8.0, 40.0, 10.0], [9.0, 4.0, 1.0]])
    reading = Reading({"unit": "mm"}, 1, np.array([[0.1], [0.2]]), ours)
    row = judged(reading, PRINTED, [True, False, False])
    assert row["free"] == "0.1"
    assert (row["k"], row["met"], row["held out"], row["held out met"]) == (2, 1, 2, 0)
    np.testing.assert_array_equal(met(ours, PRINTED).sum(axis=1), [1, 3])


def test_a_table_that_is_left_out_is_predicted_by_the_others_alone(capsys):
    """A number that only a table's own rows can tell is not found; one that all share is.

    The search as a whole takes the reading with fewer choices, although both fit the other rows.
    """
    scale = np.geomspace(0.5, 2.0, 9)[:, None]
    shared = Reading({"gain": "shared"}, 0, scale, scale * PRINTED)
    own = np.repeat(scale * PRINTED, 9, axis=0)
    own[:, 2] = np.tile(scale[:, 0] * PRINTED[2], 9)
    apart = Reading({"gain": "one more"}, 0, np.zeros((81, 2)), own)
    rows = left_out("made up", [apart, shared], PRINTED, ["a", "a", "b"])
    assert [(row["gain"], row["met"]) for row in rows] == [("shared", 3), ("one more", 0)]
    np.testing.assert_allclose([float(x) for x in rows[0]["ours"].split()], PRINTED)
    assert rows[1]["off"] == pytest.approx(np.log(2))
    said = capsys.readouterr().out
    assert "each of 2 tables left out, of 3 rows" in said
    assert "'met': 3" in said


def test_the_space_says_what_any_of_its_candidates_meets(capsys):
    """The best reading is first; the sentence is on all candidates, with all rows in sight."""
    good = Reading({"unit": "mm"}, 0, np.zeros((2, 0)), np.array([PRINTED, 3 * PRINTED]))
    bad = Reading({"unit": "m"}, 0, np.zeros((1, 0)), 5 * PRINTED[None])
    rows = search("made up", [bad, good], PRINTED, [False] * 3)
    assert [row["unit"] for row in rows] == ["mm", "m"]
    said = capsys.readouterr().out
    assert "2 readings, 3 candidates. At most 3 of 3 rows are met together, by 1 of them" in said


def test_an_experiment_refuses_a_name_that_it_does_not_have():
    assert output.asked([], {"P": 1, "PD": 2}) == ["P", "PD"]
    assert output.asked(["PD"], {"P": 1, "PD": 2}) == ["PD"]
    with pytest.raises(SystemExit, match="NAME = 'nosuch' is not one of P, PD"):
        output.asked(["P", "nosuch"], {"P": 1, "PD": 2})
