"""These tests read back from the axes what the figures show.

The signals have known amplitudes, times and frequencies, or closed forms. No pixels are compared.
"""

import ast
import itertools
import math
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr
from made_datasets import run_of, sweep_of
from matplotlib import image
from matplotlib.colors import to_hex
from matplotlib.text import Text

from jaxilc import figures
from jaxilc.design import Learned
from jaxilc.design.learned import Passed
from jaxilc.design.responses import Family
from jaxilc.design.window import Filters, window_of
from jaxilc.figures import browsers
from jaxilc.figures.by_frequency import _without_slow
from jaxilc.figures.paper import LIGHTER
from jaxilc.figures.style import marks_of, numbers_of, style_of, written
from jaxilc.figures.within_trial import _around_the_largest
from jaxilc.learning import Machine
from jaxilc.plants import DifferenceEquation
from jaxilc.scenarios import Published
from jaxilc.schemes import PIDType
from jaxilc.signals import Task
from jaxilc.sweeps.summary import explained_shares
from jaxilc.theory import frequency
from jaxilc.theory.condition import condition
from jaxilc.theory.on_lines import MeasuredResponse
from jaxilc.uncertainty import Population

DT = 1e-3
TIME = np.arange(1001) * DT


def dataset_of(errors, reference=None, u=None):
    """Return a dataset of one scheme, `a`; errors: (trial, time, channel) [mm]."""
    return run_of(np.asarray(errors)[None], reference, None if u is None else u[None])


def ticks_of(axis):
    low, high = axis.get_view_interval()
    return [at for at in axis.get_ticklocs() if low <= at <= high]


def line_of(ax, label):
    return next(line for line in ax.lines if line.get_label() == label)


def sinusoid(amplitude, hertz):
    return (amplitude * np.sin(2 * np.pi * hertz * TIME))[:, None]


# Against the trial
# --------------------------------------------------------------------------------------------------


def test_no_two_of_49_schemes_look_alike():
    styles = [tuple(style_of(i).values()) for i in range(49)]
    assert len(set(styles)) == 49
    in_grey = [
        (style_of(i)["dash"], marks_of(i, 80)["mark"], marks_of(i, 80)["marked"]) for i in range(9)
    ]
    assert len(set(in_grey)) == 9  # no scenario has more schemes


def test_a_scheme_keeps_its_look_alone_and_beside_others():
    paper = ["pid", "cfdl-mfailc", "pfdl-mfailc", "ffdl-mfailc"]
    assert numbers_of(paper) == [0, 1, 2, 3]
    assert numbers_of(paper[3:]) == [3]
    assert numbers_of(["tuned", "given"]) == [0, 1]
    assert numbers_of(["given", "mine", "other"]) == [1, 0, 2]
    assert numbers_of(["pid", "feedback", "milc"]) == [0, 2, 1]  # two that have the same


def test_a_tuning_is_judged_by_the_ratio_of_each_machine():
    """The ratios are 2, 4, 1, and 0 where the tuned law diverges."""
    errors = np.array([[4.0, 4.0, 4.0, 4.0], [2.0, 1.0, 4.0, np.inf]])[..., None]
    dataset = sweep_of(errors, ("given", "tuned"))
    _, below = figures.given_and_tuned.described(dataset, metric="rms").panels
    band, median, least, one = below.layers
    assert (band.low[0], band.high[0], median.y[0], least.y[0], one.at) == (0, 4, 1, 0, 1)


def test_a_trial_in_which_every_machine_diverges_has_no_ratio():
    errors = np.full((2, 3, 2), [4.0, np.inf])
    dataset = sweep_of(errors, ("given", "tuned"))
    _, below = figures.given_and_tuned.described(dataset, metric="rms").panels
    assert np.array_equal(below.layers[1].y, [1.0, np.nan], equal_nan=True)


@pytest.mark.thorough
def test_names_of_schemes_stand_over_their_own_panels():
    long = [f"a-very-long-name-of-a-learning-law-{i}" for i in range(2)]
    axes = figures.error_band(sweep_of([[[1.0]]] * 5, [*long, *"abc"]), metric="rms")
    axes[0].figure.draw_without_rendering()
    texts = [{of.get_text(): of for of in ax.findobj(Text)} for ax in axes[:3]]
    titles = [of[ax.get_title("left")] for of, ax in zip(texts, axes[:3], strict=True)]
    left, right = np.transpose([title.get_window_extent().intervalx for title in titles])
    assert np.all(right[:-1] < left[1:])


def test_a_worst_machine_that_leaves_the_panel_is_told():
    """One of 41 machines doubles its error from 1 mm on while the others halve theirs."""
    errors = np.array([*[0.5 ** np.arange(8)] * 40, 2.0 ** np.arange(8)])
    panel, _ = figures.error_band(sweep_of([errors]), metric="rms", unit="mm")
    assert panel.get_ylim()[1] == pytest.approx(1.5)
    said = "worst machine beyond the top\nfrom trial 2 on, 128 mm in the last"
    assert [text.get_text() for text in panel.texts] == [said]
    dots = next(line for line in panel.lines if line.get_linestyle() == ":")
    np.testing.assert_array_equal(dots.get_ydata(), errors[-1])
    errors[-1, 3:] = 0.5
    panel, _ = figures.error_band(sweep_of([errors]), metric="rms", unit="mm")
    said = "worst machine beyond the top\nin 2 of 8 trials, 0.5 mm in the last"
    assert [text.get_text() for text in panel.texts] == [said.replace("0.5 mm", "500 µm")]


def test_a_single_trial_is_seen():
    """Of 100 machines the errors 1 .. 100: the median, the band and the worst are level lines."""
    errors = np.arange(1.0, 101.0)[:, None]
    panel, _ = figures.error_band(sweep_of([errors]), metric="rms")
    assert [line.get_ydata().tolist() for line in panel.lines] == [[100.0, 100.0], [50.0, 50.0]]
    heights = panel.collections[0].get_paths()[0].vertices[:, 1]
    assert (heights.min(), heights.max()) == (5.0, 95.0)
    assert ticks_of(panel.xaxis) == [1]
    assert panel.figure.get_suptitle() == "100 machines, 1 trial"
    both = sweep_of([errors, errors], ("given", "tuned"))
    above, below = figures.given_and_tuned(both, metric="rms")
    assert all(line.get_marker() in ("o", ".") for line in (*above.lines, *below.lines[:2]))
    assert above.collections[0].get_segments()[0][:, 1].tolist() == [5.0, 95.0]
    assert ticks_of(above.xaxis) == [1]


def test_the_trials_of_a_selection_keep_their_numbers():
    rms = np.array([[9.0, 8, 4, 5, 6], [9, 8, 4, 500, 600]])
    panel, _ = figures.error_band(sweep_of(rms[None]).isel(trial=slice(2, 5)), metric="rms")
    assert [line.get_xdata().tolist() for line in panel.lines][:2] == [[3, 4, 5]] * 2
    assert panel.get_xlim() == (2.5, 5.5)
    assert "from trial 4 on" in panel.texts[0].get_text()
    alone, _ = figures.error_band(sweep_of(rms[None]).isel(trial=[2]), metric="rms")
    np.testing.assert_allclose(alone.lines[0].get_xdata(), [2.8, 3.2])


def test_many_machines_are_for_the_band():
    many = dataset_of([sinusoid(a, 10.0) for a in (4.0, 2.0)]).expand_dims(sample=3)
    with pytest.raises(ValueError, match="has 3 machines; allowed is one, and error_band"):
        figures.error_by_trial(many, metric="rms")


def test_a_printed_bound_is_no_printed_number():
    dataset = dataset_of([sinusoid(a, 10.0) for a in (4.0, 2.0)])
    rows = [
        Published("a", 1, "rms", 3.0, ""),
        Published("a", 2, "rms", 1.5, "", at_most=True),
        Published("a", None, "rms", 7.0, ""),
        Published("a", 9, "rms", 9.0, ""),  # this trial was not run
        Published("a", 1, "max_error", 8.0, ""),
        Published("b", 1, "rms", 6.0, ""),
    ]
    ax = figures.error_by_trial(dataset, metric="rms", scale=1e3, unit="µm", published=rows)
    drawn = [
        (*point, line.get_marker())
        for line in ax.lines
        if line.get_linestyle() == "None"
        for point in line.get_xydata()
    ]
    circles, others = [d[:2] for d in drawn if d[2] == "o"], [d for d in drawn if d[2] != "o"]
    assert circles == [(1, 3.0), (1, 7.0)]
    assert [d[:2] for d in others] == [(2, 1.5)]
    np.testing.assert_allclose(
        line_of(ax, "a").get_ydata(), np.array([4e3, 2e3]) / np.sqrt(2), rtol=1e-3
    )
    # 4000 µm are 4 mm, so that each tick has its own unit
    assert ax.get_ylabel() == "rms"
    assert ax.yaxis.get_major_formatter()(2e3) == "2 mm"
    said = [text.get_text() for text in ax.get_legend().get_texts()]
    assert said == ["a", "published", "published: less"]


def test_figures_of_errors_take_a_tolerance_in_the_unit_of_the_dataset():
    dataset, look = dataset_of([sinusoid(a, 10.0) for a in (4.0, 2.0)]), {"metric": "rms"}
    alone = figures.error_by_trial(dataset, **look, tolerance=3.0, scale=1e3, unit="µm")
    many = sweep_of(np.ones((1, 2, 2)), ("a",))
    (band, _) = figures.error_band(many, **look, tolerance=3.0, scale=1e3, unit="µm")
    for ax in (alone, band):
        assert any(np.array_equal(line.get_ydata(), [3e3, 3e3]) for line in ax.lines)


# Numbers with prefixes, colours, formats
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("value", "unit", "said"),
    [
        (6.3e-5, "mm", "63 nm"),
        (1.0, "µm", "1 µm"),
        (999.99999999999, "nm", "1 µm"),
        (0.9996, "mm", "1 mm"),
        (-9.997e-7, "m", "-1 µm"),
        (2000.0, "m", "2e+03 m"),  # nobody reads kilometres on a machine tool
        (-0.02, "rad", "-20 mrad"),
        (0.004, "deg", "0.004 deg"),
        (0.0, "mm", "0 mm"),
        (np.inf, "mm", "inf mm"),
        (5e-16, "m", "0.0005 pm"),
        (3.0, "", "3"),
    ],
)
def test_numbers_have_the_prefix_that_is_read(value, unit, said):
    assert written(value, unit) == said


def test_a_linear_axis_changes_its_unit_and_keeps_its_data():
    ax = figures.tracking(dataset_of([sinusoid(2e-4, 5.0)]), "a", (1,), unit="mm")[1, 0]
    assert ax.get_ylabel() == "error [nm]"
    assert ax.yaxis.get_major_formatter()(2e-4) == "200"
    assert np.max(ax.lines[0].get_ydata()) == pytest.approx(2e-4)


def test_a_dark_figure_has_light_ink_and_the_same_hues(tmp_path):
    ax = figures.error_by_trial(dataset_of([sinusoid(a, 10.0) for a in (4.0, 2.0)]), metric="rms")
    figures.save(ax, tmp_path / "print.png")
    figures.save(ax, tmp_path / "dark.png", dark=True)
    light, dark = (image.imread(tmp_path / n)[..., :3] for n in ("print.png", "dark.png"))
    assert light[0, 0] == pytest.approx(1.0)
    assert max(dark[0, 0]) < 0.15
    ink = dark.max(axis=(0, 1))
    assert min(ink) > 0.8  # text is light
    assert to_hex(ax.lines[0].get_color()) in LIGHTER.values()


def test_a_format_is_chosen_for_all_files(tmp_path):
    ax = figures.error_by_trial(dataset_of([sinusoid(1.0, 10.0)] * 2), metric="rms")
    try:
        figures.choose("svg, dark")
        path = figures.save(ax, tmp_path / "error.png")
    finally:
        figures.choose(None)
    assert path == tmp_path / "error.svg"
    assert b"<svg" in path.read_bytes()
    with pytest.raises(ValueError, match=r"figures = 'gif' is not a format \(png, svg, pdf\)"):
        figures.choose("gif")


# Many machines
# --------------------------------------------------------------------------------------------------


def test_a_band_of_a_selected_scheme_is_that_of_it_alone():
    both = sweep_of([[[3.0, 1.0], [4.0, 2.0]], [[5.0, 6.0], [7.0, 8.0]]], ("one", "other"))
    panel, share = figures.error_band(both.sel(scheme="other"), metric="rms")
    (wanted, _) = figures.error_band(both.sel(scheme=["other"]), metric="rms")
    assert panel.get_title(loc="left") == "other"
    for line, of in zip(panel.lines, wanted.lines, strict=True):
        np.testing.assert_array_equal(line.get_xydata(), of.get_xydata())
    assert len(share.lines) == 1


def test_an_unstable_scheme_does_not_hide_the_others():
    """One scheme grows without bound; the limits are those of the one that learns.

    The share within a tolerance is the distribution of the last errors, counted by hand.
    """
    rng = np.random.default_rng(3)
    good = np.exp(rng.normal(size=(40, 1))) * 0.5 ** np.arange(12)
    bad = np.full((40, 1), 1.0) * 1e3 ** np.arange(12)
    bad[:4, 6:] = np.inf
    *panels, share = figures.error_band(
        sweep_of([good, bad], ("good", "bad")), metric="rms", tolerance=0.001, scale=1e3, unit="µm"
    )
    low, high = panels[0].get_ylim()
    assert panels[1].get_ylim() == (low, high)
    assert high < 20 * 1e3 * np.max(np.quantile(good[:, 0], 0.95))
    assert low > 0.1 * 1e3 * np.quantile(good[:, -1], 0.05)
    said = [text.get_text() for text in panels[1].texts]
    assert said == [
        "0.0% within tolerance\n10.0% diverged\nband cut off at the top\nfrom trial 2 on"
    ]
    best = [line.get_xdata()[0] for line in panels[0].lines if line.get_marker() == "o"]
    assert best[0] == 12
    at, counted = share.lines[0].get_data()
    for x in (0.2, 1.0):
        of_curve = counted[np.searchsorted(at, x, side="right") - 1]
        assert of_curve == pytest.approx(100 * np.mean(1e3 * good[:, -1] <= x))


def test_what_a_parameter_explains_is_its_share_of_the_variance():
    """y = 2 a + b with uniform a and b: a explains 4 / 5 of the variance, b 1 / 5, c nothing."""
    rng = np.random.default_rng(0)
    a, b, c = rng.uniform(size=(3, 20_000))
    shares = explained_shares({"a": a, "b": b, "c": c}, 2 * a + b)
    # ranks are not quite proportional to values; the tolerance holds the difference
    assert [shares[n] for n in "abc"] == pytest.approx([0.8, 0.2, 0.0], abs=0.03)
    assert explained_shares({"a": a}, np.exp(50 * (a - 0.5) ** 2))["a"] > 0.95  # not monotone
    corner = np.array([[i, j] for i in (0, 1) for j in (0, 1)] * 100)
    found = explained_shares({"i": corner[:, 0], "j": corner[:, 1]}, corner @ [2.0, 1.0])
    assert list(found.values()) == pytest.approx([0.8, 0.2], abs=0.1)
    assert explained_shares({"a": a}, np.ones(20_000)) == {"a": 0.0}
    assert np.isnan(explained_shares({"a": a[:11]}, 3 * a[:11])["a"])
    assert explained_shares({"a": a[:12]}, 3 * a[:12])["a"] > 0.9
    with pytest.raises(ValueError, match="a has 2 values; allowed are 3"):
        explained_shares({"a": a[:2]}, np.ones(3))


# Within a trial
# --------------------------------------------------------------------------------------------------


def test_tracking_zooms_in_on_the_largest_error():
    bump = 5e-3 * np.exp(-(((TIME - 0.7) / 0.01) ** 2))[:, None]
    reference, u = sinusoid(1.0, 1.0), np.stack([np.full((1000, 1), 0.5), np.full((1000, 1), 0.25)])
    axes = figures.tracking(
        dataset_of([np.ones((1001, 1)), bump], reference, u), "a", (1, 2), scale=1e3, unit="µm"
    )
    assert axes.shape == (3, 2)
    low, high = axes[1, 1].get_xlim()
    assert (low, high) == pytest.approx((0.675, 0.725))
    # The first trial, with 1 mm, does not determine the scale.
    assert axes[1, 1].get_ylim()[1] == pytest.approx(6.0)
    for column in axes.T:
        for ax, signal in zip(column, (reference - bump, 1e3 * bump), strict=False):
            at, drawn = line_of(ax, "trial 2").get_data()
            np.testing.assert_allclose(drawn, np.interp(at, TIME, signal[:, 0]), atol=1e-9)
        assert set(line_of(column[2], "trial 2").get_ydata()) == {0.25}
    assert len(line_of(axes[1, 0], "trial 2").get_xdata()) == 1001
    assert [ax.get_ylabel() for ax in axes[:, 0]] == ["output [mm]", "error [µm]", "input [V]"]
    zoomed = figures.tracking(dataset_of([bump]), "a", (1,), zoom=(0.1, 0.2))[0, 1]
    assert zoomed.get_xlim() == pytest.approx((0.1, 0.2))


def test_each_output_has_its_own_error():
    axes = figures.tracking(
        dataset_of([np.hstack([sinusoid(1.0, 5.0), sinusoid(1e-3, 5.0)])]), "a", (1,)
    )
    assert axes.shape == (4, 2)
    assert [axes[i, 0].get_ylim()[1] for i in (1, 2)] == pytest.approx([1.2, 1.2e-3])


def test_a_sample_of_a_sweep_is_drawn_and_what_it_lacks_is_said():
    whole = dataset_of([sinusoid(2.0, 10.0)] * 3)
    kept = (
        whole.drop_vars("r")
        .isel(trial=-1, drop=True)
        .squeeze("channel")
        .expand_dims(sample=[0, 1], axis=1)
        .assign_coords(trial=[1, 2, 3])
    )
    ax = figures.spectrum(kept.sel(sample=1), "a", (3,))
    assert np.max(ax.lines[0].get_ydata()) == pytest.approx(2.0)
    reference = figures.tracking(kept.sel(sample=1), "a", (3,))[0, 0].lines[0].get_ydata()
    assert reference == pytest.approx(np.zeros(1001), abs=1e-12)
    for dataset, trial, scheme, message in (
        (kept, 3, "a", "choose one, as in dataset.sel"),
        (kept.sel(sample=0), 2, "a", "trial = 2 is not one of those kept, 3 to 3"),
        (whole, 4, "a", "trial = 4 is not one of those kept, 1 to 3"),
        (whole, 1, "b", "scheme = 'b' is not one of a"),
        (whole.drop_vars("e"), 1, "a", "no signal 'e'"),
    ):
        with pytest.raises(ValueError, match=message):
            figures.spectrum(dataset, scheme, (trial,))
    with pytest.raises(ValueError, match=r"zoom = \(0.5, 2\) is not a part of the trial, 0 to 1 s"):
        figures.tracking(whole, "a", (1,), zoom=(0.5, 2.0))


def circle_at(radius):
    angle = 2 * np.pi * TIME
    return radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def test_the_contour_error_is_drawn_magnified():
    """A circle that is 10 µm too large, and a hundredth of a turn late, is 10 µm off the path."""
    path, late = circle_at(20.0), 10
    motion = circle_at(20.01)[np.maximum(np.arange(len(TIME)) - late, 0)]
    top, bottom = figures.contour(
        dataset_of([path - motion], path), "a", (1,), scale=1e3, unit="µm"
    )
    error = line_of(bottom, "trial 1")
    # Outside is the right side; the sagitta of a chord is 0.1 µm.
    np.testing.assert_allclose(error.get_ydata(), -10.0, atol=0.11)
    assert error.get_xdata()[-1] == pytest.approx(2 * np.pi * 20.0, rel=1e-5)
    magnification = float(top.get_title().split()[-2])
    assert magnification == 200.0  # 2 mm is 5 % of the 40 mm; with 500 it would be 12.5 %
    drawn = np.linalg.norm(line_of(top, "trial 1").get_xydata(), axis=1)
    np.testing.assert_allclose(drawn, 20.0 + 2.0, atol=0.03)
    with pytest.raises(ValueError, match="the dataset has 1 outputs; allowed are 2"):
        figures.contour(dataset_of([sinusoid(1.0, 1.0)]), "a", (1,))


# By frequency
# --------------------------------------------------------------------------------------------------


def test_what_is_slower_than_the_window_is_not_painted_as_faster():
    """0.5 Hz under a window of 0.25 s: the map begins at 6 Hz, and shows less than a hundredth."""
    slow = 1e3 * np.sin(np.pi * np.linspace(0, 4, 4001))[:, None]
    (ax,) = figures.time_frequency(dataset_of([slow]), "a", (1,), window=0.25)
    _, f, amplitude = shown_in(ax)
    assert f[0] == pytest.approx(8.0)  # two lines of 4 Hz
    assert "slower than 6 Hz" in ax.get_title()
    assert np.max(amplitude) < 10.0


def test_a_slope_is_no_error_at_the_ends_of_the_trial():
    (ax,) = figures.time_frequency(dataset_of([TIME[:, None]]), "a", (1,), window=0.1)
    assert np.max(shown_in(ax)[2]) < 1e-12
    for samples in (8, 9):  # the line is read at the sample, also where the window has no middle
        np.testing.assert_allclose(_without_slow(np.arange(40.0)[:, None], samples), 0, atol=1e-12)


def test_the_map_is_scaled_as_the_spectrum_up_to_the_last_line():
    """At the Nyquist frequency, too, half of the square of the amplitude is the mean square."""
    dataset = dataset_of([np.where(np.arange(1001) % 2, -1.0, 1.0)[:, None]])
    (ax,) = figures.time_frequency(dataset, "a", (1,), window=0.1)
    shown = figures.spectrum(dataset, "a", (1,)).lines[0].get_ydata()[-1], shown_in(ax)[2][-1, 5]
    assert shown == pytest.approx((2**0.5, 2**0.5), rel=1e-6)


@pytest.mark.parametrize("first", [179.0, -179.0])
def test_a_measured_phase_stands_beside_the_fitted_one(first):
    """Of a mass it is about 180 deg, whichever sign the noise of the first line gives it."""
    f, noise = np.geomspace(1.0, 100.0, 60), np.random.default_rng(0).uniform(-3, 3, 60)
    noise[0] = first + 180
    mass = -1 / (2 * np.pi * f) ** 2
    measured = MeasuredResponse(f, mass * np.exp(1j * np.deg2rad(noise)), 0 * f)
    fitted = SimpleNamespace(simulated=(mass * np.exp(0.001j))[:, None], fit=[99.0])
    lower = figures.response_fit_figure(measured, fitted)[1]
    apart = np.subtract(*(line.get_ydata() for line in lower.lines))
    assert np.max(np.abs(apart)) < 4


@pytest.mark.parametrize(("amplitude", "hertz"), [(3e-3, 7.0), (0.2, 125.0)])
def test_a_sinusoid_shows_its_amplitude_at_its_frequency(amplitude, hertz):
    other = sinusoid(0.1 * amplitude, 40.0)
    ax = figures.spectrum(
        dataset_of([sinusoid(amplitude, hertz) + other + 5.0]), "a", (1,), scale=1e3, unit="µm"
    )
    f, shown = line_of(ax, "trial 1").get_data()
    assert f[np.argmax(shown)] == pytest.approx(hertz)
    assert np.max(shown) == pytest.approx(1e3 * amplitude, rel=1e-9)
    assert shown[np.argmin(np.abs(f - 40.0))] == pytest.approx(1e2 * amplitude, rel=1e-9)
    assert ax.get_ylabel() == "amplitude of the error"
    assert [ax.yaxis.get_major_formatter()(v) for v in (0.1, 100.0)] == ["100 nm", "100 µm"]


@pytest.mark.thorough
def test_lines_of_noise_are_those_that_the_docstring_says():
    """The mean of their power is 4 s^2 / N, at low frequencies, where each line is drawn."""
    noise = np.random.default_rng(1).normal(size=(100, 1001, 1))
    lines = [
        figures.spectrum(dataset_of([one]), "a", (1,)).lines[0].get_xydata()[2:20] for one in noise
    ]
    assert [f for f, _ in lines[0]] == pytest.approx(np.arange(3, 21))
    power = np.mean([line[:, 1] ** 2 for line in lines])
    assert power == pytest.approx(4 / 1000, rel=6 / np.sqrt(100 * 18))


def test_an_error_at_the_end_of_the_trial_is_seen_in_its_spectrum():
    """Half of the squares of the lines is the mean square: nothing of a trial is hidden."""
    pulse = np.zeros((61, 1))
    pulse[-3:] = 39.0
    lines = figures.spectrum(dataset_of([pulse]), "a", (1,)).lines[0].get_ydata()
    assert len(lines) == 30, "each line is drawn"
    assert np.sum(lines**2) / 2 == pytest.approx(np.var(pulse[1:]), rel=1e-9)


def shown_in(ax):
    """Return the times, the frequencies and the (F, T) amplitudes of a map."""
    mesh = ax.collections[0]
    edges = mesh.get_coordinates()
    centres = [(line[1:] + line[:-1]) / 2 for line in (edges[0, :, 0], edges[:, 0, 1])]
    return *centres, mesh.get_array().reshape(len(centres[1]), len(centres[0]))


def test_the_map_finds_when_the_frequency_switches():
    switching = np.where(TIME[:, None] < 0.5, sinusoid(2.0, 50.0), sinusoid(0.5, 200.0))
    (ax,) = figures.time_frequency(
        dataset_of([switching]), "a", (1,), window=0.1, scale=1e3, unit="µm"
    )
    t, f, amplitude = shown_in(ax)
    # What is slow is taken away over a window, so a change is felt one window before and after it.
    for when, hertz, height in (((0.11, 0.39), 50.0, 2e3), ((0.61, 0.89), 200.0, 500.0)):
        among = amplitude[:, (t > when[0]) & (t < when[1])]
        np.testing.assert_allclose(f[np.argmax(among, axis=0)], hertz)
        np.testing.assert_allclose(np.max(among, axis=0), height, rtol=1e-6)
    low, high = (amplitude[np.argmin(np.abs(f - hertz))] for hertz in (50.0, 200.0))
    # The tolerance is one time step of the map.
    assert t[np.argmax(high / 500.0 > low / 2e3)] == pytest.approx(0.5, abs=0.013)


def test_the_map_follows_a_chirp_and_shares_its_colours_among_trials():
    chirp = np.sin(2 * np.pi * (50.0 * TIME + 100.0 * TIME**2))[:, None]  # 50 Hz + 200 Hz/s t
    axes = figures.time_frequency(dataset_of([chirp, 0.1 * chirp]), "a", (1, 2))
    for ax in axes:
        t, f, amplitude = shown_in(ax)
        middle = (t > 0.1) & (t < 0.9)
        # The tolerance is the distance of two lines, 1 / 62 ms.
        np.testing.assert_allclose(
            f[np.argmax(amplitude, axis=0)][middle], 50.0 + 200.0 * t[middle], atol=16.2
        )
    first, second = (ax.collections[0] for ax in axes)
    assert first.norm is second.norm
    with pytest.raises(
        ValueError, match=r"window = 0.005 s is outside its allowed range \[0.008, 1\] s"
    ):
        figures.time_frequency(dataset_of([chirp]), "a", (1,), window=0.005)


def test_the_crossing_is_marked_where_the_closed_form_has_it():
    """The plant P = b z^(-1-d) learns by u + gamma e[k+1]. With g = gamma b,

        |1 - g z^-d|^2 = 1 - 2 g cos(d w) + g^2,

    which is 1 where cos(d w) = g / 2.
    """
    d, gain, gamma = 3, 0.8, 0.5
    plant = DifferenceEquation(a=(0.0,) * (d + 1), b=(0.0,) * d + (gain,), dt=DT)
    machine, task = Machine(plant), Task(np.zeros((201, 1)), dt=DT)
    critical = np.arccos(0.5 * gamma * gain) / (2 * np.pi * d * DT)
    late = frequency.learning_condition(machine, PIDType(gamma_p=gamma), task)
    led = frequency.FrequencyTest(
        condition(0.6, ""), late.frequencies, np.full(len(late.frequencies), 0.6), 1.0, np.inf
    )
    axes = figures.frequency_tests({"late": late, "led": led})
    for ax in axes:
        marks = [
            line.get_xydata()[0] for line in ax.lines if line.get_marker() not in ("None", None, "")
        ]
        assert len(marks) == 1  # with the lead it is 1 - g at every frequency
        np.testing.assert_allclose(marks[0], (critical, 1.0), rtol=1e-4)
        f, magnitude = ax.lines[0].get_data()
        np.testing.assert_allclose(
            magnitude, np.abs(1 - gamma * gain * np.exp(-2j * np.pi * f * DT * d)), rtol=1e-9
        )
    texts = [t.get_text() for t in axes[0].get_legend().get_texts()]
    assert texts == [f"late: 1 at {critical:.3g} Hz, at most 1.4", "led: at most 0.6"]


# A learned law, and printed numbers beside ours
# --------------------------------------------------------------------------------------------------


F = np.geomspace(1.0, 500.0, 40)
Z_OF_F = np.exp(2j * np.pi * F * DT)
P = np.stack([0.2 / (Z_OF_F - 0.8), 0.25 / (Z_OF_F - 0.7)])
FAMILY = Family(F, P, np.ones(40), np.ones(101), np.zeros(40), [], {}, Population(None))
WINDOW = window_of(FAMILY, Task(np.zeros(101), dt=DT), (7, 5))
TAPS = Filters(np.arange(7.0) / 10, np.array([0.0, 0.1, 0.8, 0.1, 0.0]))


def law_of(passed, refused=""):
    return Learned(None, refused, None, {}, None, passed, WINDOW, FAMILY, 3, 9, 5)


@pytest.mark.thorough
def test_the_figure_shows_the_taps_and_their_responses():
    axes = figures.learned_law_figure(law_of(Passed(TAPS, 0.0, 0.9)), DT, unit="V/mm")
    shift, taps = axes[0, 0].lines[0].get_data()
    np.testing.assert_allclose(taps, TAPS.L)
    np.testing.assert_allclose(shift, 1.0 + WINDOW.lead + np.arange(-3, 4))  # ms
    L = np.sum(TAPS.L * Z_OF_F[:, None] ** (1 + WINDOW.lead + np.arange(-3, 4)), axis=1)
    Q = 0.8 + 0.2 * np.cos(2 * np.pi * F * DT)
    shown = {line.get_label(): line.get_ydata() for one in axes[1] for line in one.lines}
    np.testing.assert_allclose(shown["|L|, learned"], np.abs(L), rtol=1e-9)
    np.testing.assert_allclose(shown["|Q / P|"], np.abs(Q / P[0]), rtol=1e-9)
    np.testing.assert_allclose(shown["|Q − L P|, nominal"], np.abs(Q - L * P[0]), rtol=1e-9)
    largest = np.max(np.abs(Q - L * P), axis=0)
    np.testing.assert_allclose(shown["largest of 2"], largest, rtol=1e-9)
    assert "V/mm" in axes[1, 0].get_ylabel()


def test_a_law_that_was_refused_has_no_figure():
    with pytest.raises(ValueError, match="refused: it is not safe"):
        figures.learned_law_figure(law_of(None, "it is not safe"), DT)


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


# All of them
# --------------------------------------------------------------------------------------------------


DRAWN = {
    "zero": np.zeros((1001, 2)),
    "lost": np.full((1001, 2), np.nan),
    "huge": np.where(TIME[:, None] < 0.5, 1e200, [[np.inf, 0]]),
    "finite": TIME[:, None] * [[1.7e308, -1e305]],
    "short": circle_at(1.0)[:6],
}


@pytest.mark.thorough(but=["zero", "huge", "finite"])
@pytest.mark.parametrize("name", DRAWN)
def test_what_is_zero_diverged_or_short_is_drawn_without_complaint(name):
    reference = np.hstack([sinusoid(1.0, 1.0), sinusoid(1.0, 2.0)])
    dataset = dataset_of([DRAWN[name]], reference[: len(DRAWN[name])])
    for figure in (figures.tracking, figures.spectrum, figures.time_frequency, figures.contour):
        np.ravel(figure(dataset, "a", (1,)))[0].figure.draw_without_rendering()
    assert browsers.trials(dataset).caption


def test_a_trial_of_one_sample_has_no_frequency():
    dataset = dataset_of([circle_at(1.0)[:2]], circle_at(2.0)[:2])
    assert [len(line.get_xdata()) for line in figures.spectrum(dataset, "a", (1,)).lines] == [0, 0]
    with pytest.raises(ValueError, match="a trial of 1 samples is too short; needed are 4"):
        figures.time_frequency(dataset, "a", (1,))


def test_a_zoom_at_the_end_of_the_trial_lies_within_it():
    """For each length, some sample times round so that start plus length exceeds the end."""
    for samples in range(10, 60):
        time = np.arange(samples + 1) * DT
        low, high = _around_the_largest(time, np.arange(samples + 1.0)[:, None])
        assert time[0] <= low < high <= time[-1]


@pytest.mark.thorough
def test_labels_do_not_overlap():
    """Ticks, labels of axes and the legend, with as many schemes as a scenario has."""
    dataset = dataset_of([sinusoid(a, 10.0) for a in (4.0, 2.0, 1e-3)])
    names = [f"scheme-number-{i}" for i in range(9)]
    dataset = xr.concat(
        [dataset.assign_coords(scheme=[name]) for name in names], "scheme", data_vars="minimal",
        coords="minimal", compat="equals",
    )  # fmt: skip
    rows = [
        Published(names[0], 1, "rms", 2.0, ""),
        Published(names[0], 2, "rms", 1.0, "", at_most=True),
    ]
    drawn = (
        figures.error_by_trial(dataset, metric="rms", published=rows),
        figures.tracking(dataset, names[1], (1, 2, 3)),
        figures.spectrum(dataset, names[1], (1, 3)),
        figures.time_frequency(dataset, names[1], (1, 3)),
    )
    for axes in drawn:
        np.ravel(axes)[0].figure.draw_without_rendering()
        for ax in np.ravel(axes):
            view, boxes = ax.get_window_extent(), []
            for axis, way in ((ax.xaxis, "intervalx"), (ax.yaxis, "intervaly")):
                low, high = getattr(view, way)
                texts = [text for text in axis.get_ticklabels() if text.get_text()]
                ticks = [text.get_window_extent() for text in texts]
                # labels outside the view are not drawn
                boxes += [box for box in ticks if low <= np.mean(getattr(box, way)) <= high]
                boxes += [axis.label.get_window_extent()] if axis.label.get_text() else []
            overlap = [a.overlaps(b) for a, b in itertools.combinations(boxes, 2)]
            assert not any(overlap), ax.get_title()
    ax = drawn[0]
    assert not ax.get_legend().get_window_extent().overlaps(ax.get_window_extent())


def test_a_legend_has_its_place():
    """For the place "best" Matplotlib searches among all points, and warns where this is slow."""
    texts = {
        file.name: text
        for file in Path(figures.__file__).parents[1].rglob("*.py")
        if "legend" in (text := file.read_text(encoding="utf-8"))
    }
    calls = [
        (name, node.lineno, {k.arg for k in node.keywords})
        for name, text in texts.items()
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Call)
        and isinstance(node.func, ast.Attribute)
        and node.func.attr == "legend"
    ]
    assert len(calls) > 2
    assert [call[:2] for call in calls if "loc" not in call[2]] == []
