"""The map of a grid shows the errors of its points, and its best one."""

import numpy as np
import pytest
import xarray as xr
from made_datasets import sweep_of

from jaxilc import figures
from jaxilc.figures.grid_map import PREMISES, live_map
from jaxilc.sweeps import best_points


def dataset_of(errors, b):
    """Return a sweep of one scheme over the axes a and b, three machines a point, two trials."""
    last = np.asarray(errors, float)[..., None] * [0.5, 1.0, 0.8]
    whole = np.stack([np.ones_like(last), last], axis=-1)[None]
    return sweep_of(whole, a=([10.0, 0.1, 1.0][: len(errors)], {"units": "V"}), b=b)


def test_a_map_has_the_error_of_each_point_and_a_star_at_the_best():
    errors = [[9, 4, 3], [9, 1, 2], [np.inf, 9, 9]]
    (ax,) = figures.grid_map(dataset_of(errors, ["p", "q", "r"]), metric="rms", scale=2.0)[:1]
    shown = ax.collections[0].get_array()
    by_a = [errors[1], errors[2], errors[0]]  # in the order of a
    np.testing.assert_allclose(shown.filled(np.inf), 2.0 * np.transpose(by_a))
    assert (ax.lines[1].get_xdata()[0], ax.lines[1].get_ydata()[0]) == (0.1, 1)
    assert named(ax) == ["around where a machine diverges", "best"]
    assert (ax.get_xlabel(), ax.get_xscale()) == ("a [V]", "log")
    edges = ax.collections[0].get_coordinates()[0, :, 0]
    np.testing.assert_allclose(edges[1:] * edges[:-1], np.square([0.1, 1.0, 10.0]))  # around each
    colours = ax.collections[0].norm
    assert 1 < colours.vmin < 2, "the colours end at what is shown, not at the best machine"
    assert [label.get_text() for label in ax.get_yticklabels()] == ["p", "q", "r"]


def test_a_single_axis_is_a_line_with_a_band():
    (ax,) = figures.grid_map(dataset_of([[4.0], [1.0], [np.inf]], ["p"]), metric="rms")
    high, star = ax.lines
    np.testing.assert_allclose(high.get_ydata(), [1.0, np.nan, 4.0])
    assert (list(star.get_xdata()), list(star.get_ydata())) == ([0.1], [1.0])
    assert len(ax.patches) == 1  # the value at which machines diverge


def test_values_of_a_scheme_that_fall_along_an_axis_have_their_stripe_and_their_star():
    dataset = dataset_of([[np.inf], [1.0], [4.0]], ["p"]).assign_coords({"law.c": ("a", [1, 3, 2])})
    (ax,) = figures.grid_map(dataset, metric="rms")
    assert (list(ax.lines[1].get_xdata()), list(ax.lines[1].get_ydata())) == ([3], [1.0])
    (stripe,) = ax.patches
    assert sorted([stripe.get_x(), stripe.get_x() + stripe.get_width()]) == [1.0, 1.5]


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


def test_the_best_trial_of_a_selection_has_its_own_number():
    rms = np.array([9.0, 1, 8, 4, 5, 6])  # of trials 3 to 6 the fourth is best
    dataset = sweep_of(np.broadcast_to(rms, (1, 2, 2, 1, 6)), a=[1.0, 2], b=[1.0, 2])
    (ax,) = figures.grid_map(dataset.isel(trial=slice(2, 6)), shows="best_trial", metric="rms")
    assert set(ax.collections[0].get_array().ravel()) == {4}
    assert ax.collections[0].get_clim() == (3, 6)


def test_where_all_diverges_no_point_is_best():
    dataset = dataset_of([[np.inf, np.inf], [np.inf, np.inf]], ["p", "q"])
    (ax,) = figures.grid_map(dataset, metric="rms", marks={"off": {"a": 99.0, "b": "p"}})
    assert (list(ax.lines), ax.figure.legends) == ([], [])


def test_a_third_axis_has_panels_and_marks_stand_where_they_are():
    """The least error is at (2, 5, 4); of the eight values of c five have a panel, 4 among them."""
    of = {name: np.arange(float(count)) for name, count in (("a", 9), ("b", 10), ("c", 8))}
    at = np.meshgrid(*of.values(), indexing="ij")
    error = sum((x - best) ** 2 for x, best in zip(at, (2, 5, 4), strict=True)) + 1.0
    dataset = sweep_of(error[None, ..., None, None] * np.ones((1, 9, 10, 8, 3, 2)), **of)
    marks = {
        "printed": {"a": 7.0, "b": 2.5, "c": 1.9},
        "off": {"a": 100.0, "b": 1.0},
        "half": {"a": 1.0},
    }
    panels = figures.grid_map(dataset, metric="rms", marks=marks)
    assert sorted(named(panels[0])) == ["best", "printed"]
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
    dataset = dataset.rename(a="law.g_p").assign_coords({"other.a": ("law.g_p", [9.0, 20.0, 30.0])})
    panels = figures.grid_map(dataset, metric="rms")
    assert [ax.get_xlabel() for ax in panels] == ["law.g_p", "other.a"]
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


def test_a_sweep_of_which_a_part_is_computed_has_no_map_and_no_best_point():
    whole = dataset_of([[1.0, 2.0], [3.0, 4.0]], ["p", "q"])
    (best,) = best_points(whole, metric="rms")
    gone = whole["diverged_at"].copy()
    gone[0, 1, 1, 2] = -1  # what the store of a sweep has for a machine that is not computed
    part = whole.assign(diverged_at=gone)
    for refuses in (
        lambda: best_points(part, metric="rms"),
        lambda: figures.grid_map(part, metric="rms", shows="yield", tolerance=5.0, best=[best]),
        lambda: live_map(part, best, metric="rms"),
    ):
        with pytest.raises(ValueError, match="1 of 12 results of the dataset are not computed"):
            refuses()
    figures.grid_map(part.isel(a=[0]), metric="rms")


# The map of contraction
# --------------------------------------------------------------------------------------------------


def watched(factor, b, **bounds):
    """Return what a watch sees where the error of each trial is `factor` of the one before it."""
    last = np.asarray(factor, float)[None, ..., None] * [0.5, 1.0, 2.0]
    norm = np.stack([np.full_like(last, np.nan), last, last], axis=-1)
    dims = ("scheme", "a", "b", "sample", "trial")
    held = dict.fromkeys(PREMISES, 1.0) | bounds
    return xr.Dataset(
        {
            "contraction_norm": (dims, norm),
            "finite": (dims, np.isfinite(norm)),
            "diverged_at": (dims[:-1], np.where(last > 100, 2, 0)),
        }
        | {
            name: (dims[:-1], np.broadcast_to(np.asarray(x)[..., None], last.shape))
            for name, x in held.items()
        },
        {"scheme": ["law"], "a": [1.0, 2.0][: len(factor)], "b": b},
    )


def named(ax):
    legend = ax.get_legend() or ax.figure.legends[0]
    return [text.get_text() for text in legend.get_texts()]


def test_contraction_is_the_mean_of_the_trials_and_infinite_where_a_machine_diverges():
    """Over two trials a factor of 4 and one of 1/9 are 2/3; a trial at rounding does not count."""
    dataset = watched([[1.0, 1.0], [60.0, np.nan]], [1.0, 2.0])
    dataset["contraction_norm"][0, 0, 0, 1, 1:] = [4.0, 1 / 9]
    dataset["contraction_norm"][0, 0, 1, 1, 1:] = [0.25, np.nan]
    found = figures.contraction_of(dataset).isel(scheme=0)
    np.testing.assert_allclose(found[0, :, 1], [2 / 3, 0.25])
    np.testing.assert_allclose(found[1, 0], [30, 60, np.inf])
    assert np.isnan(found[1, 1]).all()


def test_the_map_of_contraction_has_the_lines_and_the_regions_that_were_put_in():
    d2, signs = [[0.5, 2.0], [0.5, 2.0]], [[1.0, 0.0], [1.0, 0.0]]
    dataset = watched([[0.5, 2.0], [60.0, np.nan]], ["p", "q"], d2=d2, signs=signs, alone=0.0)
    bounds = dataset.isel(sample=[0]).assign(sigma_max=3 * dataset["d2"].isel(sample=[0]))
    marks = {"own": {"a": 1.0, "b": "q"}, "off": {"a": 9.0, "b": "q"}}
    (ax,) = figures.contraction_map(dataset, bounds=bounds, marks=marks)
    shown = ax.collections[0].get_array().filled(np.nan)
    np.testing.assert_allclose(shown.T, [[0.5, 2.0], [10.0, np.nan]])  # the colours end at 10
    assert named(ax) == [
        "d2 = 1", "sigma_max from 1.5 to 6", "signs fails", "own", "fails everywhere: alone",
    ]  # fmt: skip
    assert [text.get_text() for text in ax.get_yticklabels()] == ["p", "q"]
    (hatched,) = (x for x in ax.collections if x.get_hatch())
    assert hatched.get_array().mask.tolist() == [[True, True], [False, False]]  # of p, of q
    (ax,) = figures.contraction_map(dataset.isel(b=[0]))
    np.testing.assert_allclose(ax.lines[0].get_ydata(), [0.5, 60.0])
    assert named(ax) == ["observed", "d2", "fails everywhere: alone"]


def test_more_marks_than_there_are_signs_are_all_drawn():
    marks = {f"own {i}": {"a": 1.0, "b": "q"} for i in range(6)}
    errors = dataset_of([[1.0, 2.0], [3.0, 4.0]], ["p", "q"])
    maps = figures.grid_map(errors, metric="rms", marks=marks)
    watch = watched([[0.5, 2.0], [0.5, 2.0]], ["p", "q"])
    for ax in (*maps, *figures.contraction_map(watch, marks=marks)):
        assert marks.keys() <= {*named(ax)}
    ends = maps[0].figure.legends[0].get_window_extent().intervalx
    assert 0 <= ends[0] < ends[1] <= maps[0].figure.bbox.width


@pytest.mark.thorough
@pytest.mark.parametrize("factor", [[[1e3, 1e3]] * 2, [[np.nan, np.nan]] * 2, [[0.0, 0.0]] * 2])
def test_a_map_on_which_nothing_contracts_or_nothing_is_known_is_drawn(factor, tmp_path):
    unknown = dict.fromkeys(("d2", *PREMISES), np.nan)
    dataset = watched(factor, [1.0, 2.0], **unknown)
    panels = figures.contraction_map(dataset)
    assert figures.save(panels, tmp_path / "map.png").exists()
    assert named(panels[0]) == []
    figures.save(figures.contraction_map(dataset.isel(b=[0])), tmp_path / "line.png")


def test_a_map_of_contraction_needs_a_watch_and_two_axes():
    dataset = watched([[1.0, 1.0], [1.0, 1.0]], [1.0, 2.0])
    with pytest.raises(ValueError, match="the sweep had no BoundsWatch"):
        figures.contraction_map(dataset.drop_vars("contraction_norm"))
    with pytest.raises(ValueError, match="no axis of a grid with several values"):
        figures.contraction_map(dataset.isel(a=[0], b=[0]))
    three = xr.concat([dataset, dataset], "c").assign_coords(c=[1.0, 2.0])
    with pytest.raises(ValueError, match=r"has the axes .*; allowed are two"):
        figures.contraction_map(three)


@pytest.mark.parametrize(
    ("values", "scale"),
    [
        ([0.5, 1.0, 2.0, 4.0], "log"),
        ([0.3, 0.6, 1.2, 2.5], "log"),  # rounded
        ([1.0, 2.0, 3.0, 4.0], "linear"),
        ([0.999, 1.0, 1.001, 1.002], "linear"),  # nearly even either way
        ([1.0, 2.0], "linear"),
        ([1.0, 21.0], "log"),
        ([-1.0, 0.0, 1.0, 2.0], "linear"),
    ],
)
def test_an_axis_is_logarithmic_whose_values_are_even_on_it(values, scale):
    errors = np.ones((1, len(values), 1, 1, 2))
    (ax,) = figures.grid_map(sweep_of(errors, a=values, b=["p"]), metric="rms")
    assert ax.get_xscale() == scale


def test_a_map_whose_axes_are_both_logarithmic_is_whole():
    """Its marks stand at heights too, which are no limits of it."""
    values = [0.1, 1.0, 10.0]
    errors = np.arange(1.0, 19.0).reshape(1, 3, 3, 1, 2)
    (ax,) = figures.grid_map(sweep_of(errors, a=values, b=values), metric="rms")
    assert (ax.get_xscale(), ax.get_yscale()) == ("log", "log")
    for ends in (ax.get_xlim(), ax.get_ylim()):
        np.testing.assert_allclose(ends, np.array([0.1, 10.0]) * [10**-0.5, 10**0.5])
