"""Errors and learning by frequency: spectrum, time-frequency map, and the test of convergence."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from .description import FREQUENCY, TIME, Axis, Cells, Colours, Curve, Figure, Layer, Panel, Rule
from .paper import draw, drawn
from .style import DASHES, limits_of, marks_of, numbers_of, shades_of, style_of
from .units import written
from .within_trial import outputs_of, signal_of

if TYPE_CHECKING:
    import xarray as xr

    from ..theory.frequency import FrequencyTest

DECADES, SHADES = 8, 3  # decades of amplitude that all maps show at most, and the faintest one
SEEN = 6  # decades of amplitude that a spectrum shows at most
BEYOND = 2.0  # a spectrum ends so many times above the last frequency at which it is seen
SLOWEST = 2  # line of a map from which on it is shown: a Hann window spreads a line over two others


@drawn
def spectrum(
    dataset: xr.Dataset,
    scheme: str,
    trials: Sequence[int],
    *,
    scale: float = 1.0,
    unit: str = "",
) -> Figure:
    """Amplitude of the error against frequency for chosen trials, with log axes.

    The amplitude is one-sided and without a window, so that no part of the trial is hidden: half of
    the squares of all lines is the mean square of the error. A sinusoid of whole periods shows its
    amplitude at its frequency, and noise of standard deviation s has lines of about 2 s / N^(1/2).
    An error at an end of the trial, or one that begins and ends differently, has lines at all
    frequencies. Of the lines within a sixtieth of a decade the largest is
    drawn. The first sample, which no input reaches, and the mean are left out. Outputs other than
    the first are dashed. The axis ends where no line is within six decades of the largest any more.

    dataset: dataset with e, as for `signal_of`
    scale, unit: the error is shown as `scale` times that of the dataset, in `unit`
    Raises as `signal_of` does.
    """
    from scipy.signal import periodogram

    time, layers = dataset["time"].values, []
    for trial, shade in zip(trials, shades_of(trials), strict=True):
        e = scale * signal_of(dataset, "e", scheme, trial)[1:]
        names = outputs_of(dataset, e.shape[1])
        f, power = periodogram(
            e, 1.0 / (time[1] - time[0]), window="boxcar", detrend="constant", scaling="spectrum",
            axis=0,
        )  # fmt: skip
        for i, amplitude in enumerate(np.sqrt(2.0 * np.where(power > 0, power, np.nan)[1:]).T):
            at, dash = _peaks(f[1:], amplitude), DASHES[i % len(DASHES)]
            name = f"trial {trial}" + f", {names[i]}" * (len(names) > 1)
            layers.append(Curve(f[1 + at], amplitude[at], dash, 1, name=name, colour=shade))
    held = limits_of([v for of in layers for v in of.y])
    ends = held and (max(held[0], held[1] * 10.0**-SEEN), held[1])
    last = max((_last_seen(of, ends[0] if ends else 0.0) for of in layers), default=f[-1])
    along = FREQUENCY._replace(ends=(f[1], min(max(BEYOND * last, 10 * f[1]), f[-1])))
    up = Axis("amplitude of the error", unit, log=True, ends=ends)
    return Figure([Panel(along, up, layers, f"{scheme}: spectrum of the error")])


def time_frequency(
    dataset: xr.Dataset,
    scheme: str,
    trials: Sequence[int],
    *,
    window: float | None = None,
    scale: float = 1.0,
    unit: str = "",
    ax=None,
) -> np.ndarray:
    """Amplitude of the error over time and frequency, a map for each trial; axes (trials,).

    It is the short-time Fourier transform under a Hann window, scaled as in `spectrum`. With
    several outputs the largest amplitude is shown. All maps have the same colours. A window of
    length T cannot tell what is slower than 2 / T from a constant, so this is taken away first,
    the maps begin there, and the title says so. A change within the trial is felt one window
    before and after it.

    dataset: dataset with e, as for `signal_of`
    window: length T of the window [s], None for a sixteenth of the trial; the resolution is T / 2
        in time and 2 / T in frequency
    scale, unit: the error is shown as `scale` times that of the dataset, in `unit`
    Raises ValueError for a window shorter than 8 samples or longer than the trial, and as
    `signal_of` does.
    """
    from scipy.signal import ShortTimeFFT

    time = dataset["time"].values
    dt, N = time[1] - time[0], len(time) - 1
    least = min(8, N)
    samples = max(N // 16, least) if window is None else round(window / dt)
    if not least <= samples <= N:
        raise ValueError(
            f"time_frequency: window = {samples * dt:g} s is outside its allowed range "
            f"[{least * dt:g}, {N * dt:g}] s"
        )
    transform = ShortTimeFFT.from_window(
        "hann",
        1.0 / dt,
        samples,
        samples - max(samples // 8, 1),
        fft_mode="onesided2X",
        scale_to="magnitude",
    )
    slices = {"p0": 0, "p1": N // transform.hop + 1}
    maps = []
    for trial in trials:
        e = _without_slow(scale * signal_of(dataset, "e", scheme, trial)[1:], samples)
        whole = np.abs(transform.stft(e, **slices, padding="even", axis=0))
        maps.append(np.max(whole, axis=1)[SLOWEST:])
    top = np.max(maps, where=np.isfinite(maps), initial=0.0) or 1.0
    tops = [np.max(one, where=np.isfinite(one), initial=0.0) for one in maps]
    least = min((one for one in tops if one > 0), default=top)
    ends = max(least * 10.0**-SHADES, top * 10.0**-DECADES), top
    shows = Colours("amplitude of the error", unit, ends, palette="viridis", cut=True)
    t, lines = transform.t(N, **slices), transform.f[SLOWEST:]
    edges = np.append(lines - transform.delta_f / 2, lines[-1] + transform.delta_f / 2)
    times = np.append(t - transform.delta_t / 2, t[-1] + transform.delta_t / 2)
    along, panels = TIME._replace(ends=(0.0, N * dt)), []
    for trial, amplitude, largest in zip(trials, maps, tops, strict=True):
        said = [f"{scheme}, trial {trial}"]
        if not panels:
            said.append(f"slower than {edges[0]:.3g} Hz is not shown")
        if largest < ends[0]:
            said.append(f"at most {written(largest, unit)}")
        cells = Cells(times, edges, amplitude.T, shows)
        up = FREQUENCY._replace(ends=(edges[0], edges[-1]))
        panels.append(Panel(along, up, [cells], "; ".join(said)))
    figure = Figure(panels, size=(7.2, 0.8 + 2.4 * len(trials)))
    return np.atleast_1d(draw(figure, ax))


@drawn
def frequency_tests(tests: Mapping[str, FrequencyTest]) -> Figure:
    """|Q (keep - L P)|, which must stay below 1, against frequency; two axes.

    The lower axes show the part near 1. The frequency at which a test first reaches 1 is marked.
    The frequencies shown are the four decades below the Nyquist frequency.

    tests: tests by name, from `theory.frequency.learning_condition`, `robust_condition` or
        `norm_optimal_condition`
    """
    layers: list[Layer] = []
    for i, (name, test) in zip(numbers_of(tests), tests.items(), strict=True):
        style, magnitude = style_of(i), test.magnitude
        reached = f"1 at {test.critical:.3g} Hz, " if np.isfinite(test.critical) else ""
        said = f"{name}: {reached}at most {test.condition.value:.6g}"
        finite = np.where(np.isfinite(magnitude), magnitude, np.nan)
        layers.append(Curve(test.frequencies, finite, name=said, **style))
        if np.isfinite(test.critical):
            mark, colour = marks_of(i, 1)["mark"], style["colour"]
            here = [test.critical], [1.0]
            layers.append(Curve(*here, "", mark=mark, size=7, filled=False, colour=colour))
    layers.append(Rule(1.0))
    above = max(min(max(test.condition.value for test in tests.values()) - 1.0, 0.5), 0.01)
    last = max(test.frequencies[-1] for test in tests.values())
    along = FREQUENCY._replace(ends=(1e-4 * last, last))
    near = Axis("the same near 1", ends=(1.0 - 3.0 * above, 1.0 + 1.5 * above))
    whole = Panel(along, Axis("|Q (1 − L P)|", ends=(0.0, None)), layers, legend="above", columns=2)
    return Figure([whole, Panel(along, near, layers, legend="")])


def _without_slow(e, samples: int):
    """A signal less its mean under a moving Hann window of so many samples.

    This mean is zero for the lines 2, 3, 4 ... of the window, so that these do not change, and it
    follows what is slower, which would otherwise leak into them.
    """
    from scipy.ndimage import convolve1d
    from scipy.signal import get_window

    weights = get_window("hann", samples)
    return e - convolve1d(e, weights / weights.sum(), axis=0, mode="mirror")


def _last_seen(of: Curve, floor: float) -> float:
    """The last frequency at which a curve is above the floor of its axes."""
    return max(of.x[of.y >= floor], default=0.0)


def _peaks(f, amplitude):
    """The indices of the lines that are the largest within their sixtieth of a decade."""
    groups = np.split(
        np.arange(len(f)), np.flatnonzero(np.diff(np.floor(60 * np.log10(f / f[0])))) + 1
    )
    return np.array([group[np.argmax(np.nan_to_num(amplitude[group]))] for group in groups])
