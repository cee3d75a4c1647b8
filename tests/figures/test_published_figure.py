"""The figure of printed numbers beside ours is read back from its axes."""

import math

import numpy as np

from jaxilc import figures

ROW = {"scenario": "a", "scheme": "law", "trial": 5, "quantity": "rms", "unit": "µm"}
ROW |= {"options": {"frequency": 0.5}, "among_fitted": False, "at_most": False}


def test_each_row_has_its_printed_number_ours_and_their_ratio():
    """A row that diverged is at the border of the ratios, and has no number of ours."""
    rows = [
        ROW | {"value": 4.0, "ours": 5.0, "ratio": 1.25, "verdict": "met", "among_fitted": True},
        ROW | {"value": 2.0, "ours": 6.0, "ratio": 3.0, "verdict": "open"},
        ROW | {"value": 1.0, "ours": math.inf, "ratio": math.inf, "verdict": "open"},
        ROW | {"value": 42.0, "ours": -0.1, "ratio": -0.002, "verdict": "open"},
    ]
    left, right = figures.printed_and_ours(rows, title="a")
    printed = next(line for line in left.lines if line.get_label() == "printed")
    np.testing.assert_array_equal(printed.get_xydata(), [[4, 0], [2, 1], [1, 2], [42, 3]])
    ours = {line.get_label(): line.get_xydata().tolist() for line in left.lines}
    assert ours["ours, met"] == [[5.0, 0.0]]
    assert ours["ours, open"] == [[6.0, 1.0]]
    ratios = [line.get_xydata() for line in right.lines if line.get_marker() != "None"]
    np.testing.assert_array_equal(np.vstack(ratios), [[1.25, 0], [3, 1], [10, 2], [0.1, 3]])
    labels = left.get_yticklabels()
    assert [label.get_text() for label in labels] == ["law, trial 5, rms [µm], 0.5 Hz"] * 4
    assert [label.get_style() for label in labels] == ["italic", *["normal"] * 3]
    assert left.get_ylim()[0] > left.get_ylim()[1], "the first row is on top"


def test_one_picture_for_each_paper():
    rows = [ROW | {"value": 1.0, "ours": 1.0, "ratio": 1.0, "verdict": "met"}] * 2
    found = figures.reproduction_figures([*rows, rows[0] | {"scenario": "b"}])
    said = "the printed numbers and ours,"
    assert [caption[:32] for caption, _ in found] == [f"a: {said}", f"b: {said}"]
    assert [len(axes[0].get_yticks()) for _, axes in found] == [2, 1]
