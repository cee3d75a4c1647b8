"""The live map of a grid has the numbers of `grid_map`, and a click shows how a point learns."""

import warnings

import numpy as np
import pytest
from bokeh.models import HoverTool
from browser import needs_chromium, opened
from made_datasets import sweep_of

from jaxilc import figures
from jaxilc.figures.grid_map import _of_bounds, live_grid, live_map
from jaxilc.figures.report import html_report, write_report
from jaxilc.sweeps import best_points


def dataset_of(errors, b, trials=3):
    """A sweep of one scheme over the axes a and b, two machines a point, the last one half."""
    last = np.asarray(errors, float)[..., None] * [1.0, 0.5]
    whole = last[None, ..., None] * np.arange(trials, 0, -1)
    return sweep_of(whole, **{"law.a": [0.1, 1.0, 10.0][: len(errors)], "b": b})


def live_of(dataset, **options):
    best = best_points(dataset, options.get("tolerance"), metric="rms")
    return best, live_map(dataset, best[0], metric="rms", **options)


def test_each_cell_has_the_numbers_of_the_picture_and_lies_around_its_point():
    dataset = dataset_of([[8, 4], [2, 1], [np.inf, 4]], ["p", "q"])
    _, live = live_of(dataset, scale=1e3, unit="µm", tolerance=1.0)
    (ax,) = figures.grid_map(dataset, metric="rms", scale=1e3, unit="µm")
    shown = ax.collections[0].get_array().filled(np.nan).T.ravel()
    of = live.points.data
    np.testing.assert_allclose(of["value"] / live.factor * 1e3, shown)
    tips = [of[f"t{i}"].tolist() for i in range(8)]
    assert tips[:2] == [[0.1, 0.1, 1.0, 1.0, 10.0, 10.0], ["p", "q"] * 3]
    assert tips[2] == ["8 mm", "4 mm", "2 mm", "1 mm", "diverged", "4 mm"]
    assert tips[5] == ["0.0%", "0.0%", "50.0%", "100.0%", "0.0%", "0.0%"]
    assert tips[7][4] == "100.0%"
    assert live.points.selected.indices == [3]
    assert live.at(3) == {"law.a": 1.0, "b": "q"}
    np.testing.assert_allclose(of["left"] * of["right"], np.repeat([0.1, 1, 10], 2) ** 2)
    np.testing.assert_allclose(of["top"], [0.5, 1.5] * 3)
    np.testing.assert_allclose(of["right"][:4], of["left"][2:])
    assert live.figure.yaxis[0].major_label_overrides == {0: "p", 1: "q"}
    watched = {"contraction_norm": dataset["rms"] / 4, "d2": dataset["diverged_at"] + 0.5}
    _, live = live_of(dataset.assign(watched | {"claimed": watched["d2"] < 1}))
    called = [*_of_bounds(live.dataset)]
    ratio, d2, claimed = (live.points.data[f"t{i}"] for i in (7, 8, 9))
    assert (ratio[3], d2[3], claimed[3]) == ("0.2652", "0.5", "1")  # mean of 2/4, 1/4; of half
    hovers = [one.tooltips for one in live.figure.select({"type": HoverTool})]
    rows = [f"{name}:</span> @t{i}<" for i, name in enumerate(called, 7)]
    assert any(all(row in one for row in rows) for one in hovers)


def test_the_marks_of_a_logarithmic_map_are_not_its_ends():
    b = [0.5, 1.0, 2.0, 4.0]
    _, live = live_of(dataset_of(np.arange(1.0, 13.0).reshape(3, 4), b))
    assert type(live.figure.y_scale).__name__ == "LogScale"
    ends = live.figure.y_range.start, live.figure.y_range.end
    assert np.all(np.isnan(ends)), "they are not those of all cells, which the page finds itself"


def test_a_click_shows_how_the_point_learns():
    """The curves of all points stand in one array, of which the page takes a part."""
    dataset = dataset_of([[8, 4], [2, 1], [np.inf, 4]], ["p", "q"])
    best = best_points(dataset, metric="rms")
    page = live_grid(dataset, metric="rms", best=best)
    (react,) = live_source(page).selected.js_property_callbacks["change:indices"]
    every, now = react.args["all"].data, react.args["shown"].data
    np.testing.assert_allclose(now["j"], [1, 2, 3])
    np.testing.assert_allclose(now["high"], [3, 2, 1])
    np.testing.assert_allclose(every["low"].reshape(6, 3)[0], [12, 8, 4])
    assert np.all(np.isnan(every["median"].reshape(6, 3)[4]))


def test_a_click_shows_the_trials_of_the_best_point_where_their_number_is_not_drawn():
    """Learning diverges in the third trial, so that two trials are best."""
    errors = np.stack([np.array([4.0, 2, *last]) for last in ([np.nan] * 2, [np.inf] * 2)])
    whole = np.broadcast_to(errors[None, :, None, None, None], (1, 2, 3, 3, 1, 4))
    dataset = sweep_of(whole, trials=[2, 4], a=[1.0, 2, 3], b=[1.0, 2, 3])
    page = live_grid(dataset, metric="rms", best=best_points(dataset, metric="rms"))
    (react,) = live_source(page).selected.js_property_callbacks["change:indices"]
    assert react.args["shown"].data["j"].tolist() == [1, 2]
    assert react.args["all"].data["high"].tolist() == [4.0, 2.0] * 9


def live_source(page):
    from bokeh.models import ColumnDataSource

    return next(m for m in page.model.references()
                if isinstance(m, ColumnDataSource) and "t2" in m.data)  # fmt: skip


@pytest.mark.parametrize(
    ("errors", "b"),
    [
        ([[np.inf, np.inf], [np.inf, np.inf]], ["p", "q"]),  # all diverges
        ([[np.nan, 1.0], [2.0, 3.0]], [1.0, 2.0]),
        ([[1.0, 1.0], [1.0, 1.0]], [-1.0, 2.0]),  # all alike
        ([[3.0], [1.0], [2.0]], ["p"]),  # a line
        ([[np.inf], [np.inf]], [5.0]),
        ([[0.0, 1.0]], [True, False]),
    ],
)
def test_any_grid_makes_a_page(errors, b):
    dataset = dataset_of(errors, b)
    best = best_points(dataset, 1.5, metric="rms")
    live = live_grid(dataset, metric="rms", tolerance=1.5, best=best)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        text = html_report("t", {}, live=[live])
    assert len(text) < 5_000_000


def test_a_large_grid_keeps_its_ends_and_its_best_point():
    error = np.abs(np.arange(200.0)[:, None] - 77) + np.ones((1, 300))
    error[77, 123] = 0.5
    rms = np.broadcast_to(error[None, :, :, None, None], (1, 200, 300, 1, 40))
    dataset = sweep_of(rms, a=np.arange(200.0), b=np.arange(300.0))
    best, live = live_of(dataset)
    assert live.at(live.points.selected.indices[0]) == {"a": 77.0, "b": 123.0}
    assert live.dataset["a"].values[[0, -1]].tolist() == [0.0, 199.0]
    assert len(live.values) <= 65 * 65
    page = html_report("t", {}, live=[live_grid(dataset, metric="rms", best=best)])
    assert len(page) < 5_000_000
    assert "left out" not in page


@needs_chromium
def test_a_browser_shows_the_point_that_is_clicked(tmp_path):
    dataset = dataset_of([[8, 4], [2, 1]], ["p", "q"])
    live = live_grid(dataset, metric="rms", best=best_points(dataset, metric="rms"))
    page, source = write_report(tmp_path / "page.html", "t", {}, live=[live]), live_source(live)
    said = opened(
        page,
        tmp_path,
        f"const s = Bokeh.documents[0].get_model_by_id('{source.id}');"
        "s.selected.indices = [0]; await new Promise(done => setTimeout(done, 500));"
        "for (const m of Bokeh.documents[0]._all_models.values())"
        " if (m.type === 'ColumnDataSource' && m.data.j) return [...m.data.high];",
    )
    np.testing.assert_allclose(said, [24, 16, 8])
