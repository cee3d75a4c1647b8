"""The map of a grid shows the errors of its points, and its best one."""

import numpy as np
import pytest
import xarray as xr

from jaxilc import figures


def dataset_of(errors, b):
    """Return a sweep of one scheme over the axes a and b, three machines a point, two trials."""
    last = np.asarray(errors, float)[..., None] * [0.5, 1.0, 0.8]
    whole = np.stack([np.ones_like(last), last], axis=-1)[None]
    dims = ("scheme", "a", "b", "sample", "trial")
    return xr.Dataset(
        {
            "rms": (dims, whole),
            "finite": (dims, np.isfinite(whole)),
            "diverged_at": (dims[:-1], 2 * ~np.isfinite(last)[None]),
        },
        {"scheme": ["law"], "a": ("a", [10.0, 0.1, 1.0][: len(errors)], {"units": "V"}), "b": b},
    )


def test_a_map_has_the_error_of_each_point_and_a_star_at_the_best():
    errors = [[9, 4, 3], [9, 1, 2], [np.inf, 9, 9]]
    (ax,) = figures.grid_map(dataset_of(errors, ["p", "q", "r"]), metric="rms", scale=2.0)[:1]
    shown = ax.collections[0].get_array()
    by_a = [errors[1], errors[2], errors[0]]  # in the order of a
    np.testing.assert_allclose(shown.filled(np.inf), 2.0 * np.transpose(by_a))
    (star,) = ax.lines
    assert (star.get_xdata()[0], star.get_ydata()[0]) == (0.1, 1)
    assert (ax.get_xlabel(), ax.get_xscale()) == ("a [V]", "log")
    assert [label.get_text() for label in ax.get_yticklabels()] == ["p", "q", "r"]


def test_a_single_axis_is_a_line_with_a_band():
    (ax,) = figures.grid_map(dataset_of([[4.0], [1.0], [np.inf]], ["p"]), metric="rms")
    median, star = ax.lines
    np.testing.assert_allclose(median.get_ydata(), [0.8, np.inf, 3.2])
    assert (list(star.get_xdata()), list(star.get_ydata())) == ([0.1], [1.0])
    assert len(ax.patches) == 1  # the value at which machines diverge


def test_what_has_no_axis_is_refused():
    with pytest.raises(ValueError, match="no axis of a grid with several values"):
        figures.grid_map(dataset_of([[1.0]], ["p"]), metric="rms")
    with pytest.raises(ValueError, match=r"has a grid over a, b; allowed is one point"):
        figures.error_band(dataset_of([[1.0, 2.0]], ["p", "q"]), metric="rms")
