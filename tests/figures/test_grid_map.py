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
    high, star = ax.lines
    np.testing.assert_allclose(high.get_ydata(), [1.0, np.inf, 4.0])
    assert (list(star.get_xdata()), list(star.get_ydata())) == ([0.1], [1.0])
    assert len(ax.patches) == 1  # the value at which machines diverge


@pytest.mark.parametrize(
    ("shows", "expected"),
    [
        ("median", [[0.8, 3.2], [1.6, np.inf]]),
        ("worst", [[1, 4], [2, np.inf]]),
        ("yield", [[1, 0], [2 / 3, 0]]),
        ("best_trial", [[2, 1], [1, 1]]),
        ("diverged", [[0, 0], [0, 1]]),
    ],
)
def test_a_map_shows_other_numbers_of_each_point(shows, expected):
    dataset = dataset_of([[2.0, np.inf], [1.0, 4.0]], ["p", "q"])
    (ax,) = figures.grid_map(dataset, shows=shows, metric="rms", tolerance=1.9)
    shown = ax.collections[0].get_array().filled(np.inf)
    np.testing.assert_allclose(shown[:, ::-1].T, np.array(expected)[::-1])


def test_where_all_diverges_no_point_is_best():
    dataset = dataset_of([[np.inf, np.inf], [np.inf, np.inf]], ["p", "q"])
    (ax,) = figures.grid_map(dataset, metric="rms", marks={"off": {"a": 99.0, "b": "p"}})
    assert (list(ax.lines), ax.get_legend()) == ([], None)


def test_a_third_axis_has_panels_and_marks_stand_where_they_are():
    """The least error is at (2, 5, 4); of the eight values of c five have a panel, 4 among them."""
    of = {name: np.arange(float(count)) for name, count in (("a", 9), ("b", 10), ("c", 8))}
    at = np.meshgrid(*of.values(), indexing="ij")
    error = sum((x - best) ** 2 for x, best in zip(at, (2, 5, 4), strict=True)) + 1.0
    dims = ("scheme", *of, "sample", "trial")
    rms = error[None, ..., None, None] * np.ones((1, 9, 10, 8, 3, 2))
    dataset = xr.Dataset(
        {
            "rms": (dims, rms),
            "finite": (dims, np.isfinite(rms)),
            "diverged_at": (dims[:-1], np.zeros(rms.shape[:-1], int)),
        },
        {"scheme": ["law"], **of},
    )
    marks = {
        "printed": {"a": 7.0, "b": 2.5, "c": 1.9},
        "off": {"a": 100.0, "b": 1.0},
        "half": {"a": 1.0},
    }
    panels = figures.grid_map(dataset, metric="rms", marks=marks)
    names = [text.get_text() for text in panels[0].get_legend().get_texts()]
    assert sorted(names) == ["best", "printed"]
    assert [ax.get_title() for ax in panels] == [f"law, c = {c}" for c in (0, 2, 4, 5, 7)]
    for c, ax in zip((0, 2, 4, 5, 7), panels, strict=True):
        found = {x.get_label(): (x.get_xdata()[0], x.get_ydata()[0]) for x in ax.lines}
        assert found == {2: {"printed": (7.0, 2.5)}, 4: {"best": (2.0, 5.0)}}.get(c, {})
        shown = ax.collections[0].get_array()
        np.testing.assert_allclose(shown, error[:, :, c].T)


def test_an_axis_of_several_schemes_has_the_name_and_the_values_of_each():
    errors = [[9, 4], [9, 1], [5, 9]]
    dataset = xr.concat([dataset_of(errors, ["p", "q"])] * 2, "scheme")
    dataset = dataset.assign_coords(scheme=["law", "other"], a=[1.0, 2.0, 3.0])
    dataset = dataset.rename(a="law.a").assign_coords({"other.a": ("law.a", [10.0, 20.0, 30.0])})
    panels = figures.grid_map(dataset, metric="rms")
    assert [ax.get_xlabel() for ax in panels] == ["law.a", "other.a"]
    assert [ax.lines[0].get_xdata()[0] for ax in panels] == [2.0, 20.0]


def test_what_has_no_axis_is_refused():
    with pytest.raises(ValueError, match="no axis of a grid with several values"):
        figures.grid_map(dataset_of([[1.0]], ["p"]), metric="rms")
    grid = dataset_of([[1.0, 2.0]], ["p", "q"])
    with pytest.raises(ValueError, match="shows = 'least' is not one of high, median"):
        figures.grid_map(grid, shows="least", metric="rms")
    with pytest.raises(ValueError, match="shows = 'yield' needs a tolerance, and it is None"):
        figures.grid_map(grid, shows="yield", metric="rms")
    with pytest.raises(ValueError, match=r"has a grid over a, b; allowed is one point"):
        figures.error_band(dataset_of([[1.0, 2.0]], ["p", "q"]), metric="rms")
