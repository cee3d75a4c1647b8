"""Figures over frequency: spectrum, time-frequency map, convergence, filters and learned laws."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from .description import (
    FREQUENCY,
    TIME,
    Axis,
    Band,
    Cells,
    Colours,
    Curve,
    Figure,
    Layer,
    Panel,
    Rule,
)
from .paper import draw, drawn
from .style import (
    COLOURS,
    DASHES,
    GREY,
    colour_of,
    limits_of,
    marks_of,
    numbers_of,
    placed,
    shades_of,
    style_of,
    written,
)
from .within_trial import outputs_of, signal_of

if TYPE_CHECKING:
    import xarray as xr

    from ..design import Learned
    from ..theory.frequency import FrequencyTest
    from ..theory.on_lines import Curves


DECADES, SHADES = 8, 3  # decades of amplitude that all maps show at most, and the faintest one
SEEN = 6  # decades of amplitude that a spectrum shows at most
BEYOND = 2.0  # a spectrum ends so many times above the last frequency at which it is seen
SLOWEST = 2  # line of a map from which on it is shown: a Hann window spreads a line over two others


@drawn
def spectrum(
    dataset: xr.Dataset, scheme: str, trials: Sequence[int], *, scale: float = 1.0, unit: str = ""
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
    time, layers = dataset["time"].values, []
    for trial, shade in zip(trials, shades_of(trials), strict=True):
        e = scale * placed(signal_of(dataset, "e", scheme, trial)[1:])
        names = outputs_of(dataset)
        _, size = np.frexp(np.nanmax(np.abs(e), initial=0.0))  # whose square may be too large
        f = np.fft.rfftfreq(len(e), time[1] - time[0])
        # scipy.signal.periodogram does the same, but takes a second to import
        scaled = np.ldexp(e, -size)
        lines = np.abs(np.fft.rfft(scaled - np.mean(scaled, axis=0), axis=0))
        lines *= np.where(2 * np.arange(len(f)) == len(e), np.sqrt(2.0), 2.0)[:, None] / len(e)
        amplitudes = np.ldexp(np.where(lines > 0, lines, np.nan)[1:], size)
        for i, amplitude in enumerate(amplitudes.T):
            at, dash = _peaks(f[1:], amplitude), DASHES[i % len(DASHES)]
            name = f"trial {trial}" + f", {names[i]}" * (len(names) > 1)
            layers.append(Curve(f[1 + at], amplitude[at], dash, 1, name=name, colour=shade))
    x, y = (np.concatenate([getattr(of, way) for of in layers]) for way in "xy")
    held = limits_of(y)
    ends = held and (max(held[0], held[1] * 10.0**-SEEN), held[1])
    last = np.max(x, where=y >= (ends[0] if ends else 0.0), initial=0.0)
    along = FREQUENCY
    if len(f) > 2:
        along = along._replace(ends=(f[1], min(max(BEYOND * last, 10 * f[1]), f[-1])))
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
    if N < 2 * SLOWEST:
        raise ValueError(f"time_frequency: a trial of {N} samples is too short; needed are 4")
    samples = max(N // 16, least) if window is None else round(window / dt)
    if not least <= samples <= N:
        raise ValueError(
            f"time_frequency: window = {samples * dt:g} s is outside its allowed range "
            f"[{least * dt:g}, {N * dt:g}] s"
        )
    transform = ShortTimeFFT.from_window(
        "hann", 1.0 / dt, samples, samples - max(samples // 8, 1), fft_mode="onesided2X",
        scale_to="magnitude",
    )  # fmt: skip
    slices = {"p0": 0, "p1": N // transform.hop + 1}
    maps = []
    for trial in trials:
        e = _without_slow(scale * placed(signal_of(dataset, "e", scheme, trial)[1:]), samples)
        whole = np.abs(transform.stft(e, **slices, padding="even", axis=0))
        if samples % 2 == 0:
            whole[-1] *= np.sqrt(2.0)  # the last line is the Nyquist frequency, as in `spectrum`
        maps.append(np.max(whole, axis=1)[SLOWEST:])
    tops = [np.max(one, where=np.isfinite(one), initial=0.0) for one in maps]
    top = max(tops, default=0.0) or 1.0
    lowest = min((one for one in tops if one > 0), default=top)
    ends = max(lowest * 10.0**-SHADES, top * 10.0**-DECADES), top
    shows = Colours("amplitude of the error", unit, ends, palette="viridis", cut=True)
    t, lines = transform.t(N, **slices), transform.f[SLOWEST:]
    edges = np.append(lines - transform.delta_f / 2, lines[-1] + transform.delta_f / 2)
    times = np.append(t - transform.delta_t / 2, t[-1] + transform.delta_t / 2)
    along = TIME._replace(ends=(0.0, N * dt))
    panels: list[Panel] = []
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
    most = max(float(test.condition.value) for test in tests.values())
    above = max(min(most - 1.0, 0.5), 0.01)
    last = max(float(test.frequencies[-1]) for test in tests.values())
    along = FREQUENCY._replace(ends=(1e-4 * last, last))
    near = Axis("the same near 1", ends=(1.0 - 3.0 * above, 1.0 + 1.5 * above))
    whole = Panel(along, Axis("|Q (1 − L P)|", ends=(0.0, None)), layers, legend="above", columns=2)
    return Figure([whole, Panel(along, near, layers, legend="")])


def _without_slow(e, samples: int):
    """A signal less the straight line that fits it best under a moving Hann window, at its middle.

    The line follows what is slower, which would otherwise leak into the lines 2, 3, 4 ... shown.
    Under a whole window it is the mean, to which these add nothing. At an end of the trial, where
    only a part of the window has samples, it has a slope, which a mean would leave as an error.
    """
    from scipy.ndimage import correlate1d
    from scipy.signal import get_window

    weights, at = get_window("hann", samples), (np.arange(samples) - samples // 2) / samples
    weights = weights / weights.sum()

    def moments(of):
        return [correlate1d(of, weights * at**n, axis=0, mode="constant") for n in range(3)]

    (zeroth, first, second), (mean, slope, _) = moments(np.ones((len(e), 1))), moments(e)
    return e - (mean - slope * first / second) / (zeroth - first**2 / second)


def _peaks(f, amplitude):
    """The indices of the lines that are the largest within their sixtieth of a decade."""
    parts = np.floor(60 * np.log10(f / f[:1]))
    groups = np.split(np.arange(len(f)), np.flatnonzero(np.diff(parts)) + 1) if len(f) else ()
    return np.array([group[np.argmax(np.nan_to_num(amplitude[group]))] for group in groups], int)


# Whether a Q-filter is safe: plant, filter, L P and |Q (1 - L P)| of a family
# --------------------------------------------------------------------------------------------------


PASSED = 1e-2  # |Q| below which nothing of L P is shown
SLOWEST_SHOWN = 1e-3  # of the last frequency shown
LEAST = 1e-3  # least magnitude of P shown, against the largest
SIZES = (0.01, 10.0)  # of |Q| and |L P| that are shown


@drawn
def q_filter_figure(
    families: Mapping[str, Curves], *, margin: float = 0.0, unit: str = ""
) -> Figure:
    """|P|, then |Q| and |L P|, then |Q (1 - L P)| with its band, against frequency; three axes.

    The band is from the least to the largest value of the family; of a measured response it is its
    scatter. The largest value is marked. The frequencies shown end where |Q| has fallen to 0.01.

    families: curves by name, from `theory.q_filter`
    margin:   that was asked for; 0 for no line
    unit:     of P, output per input
    """
    plants: list[Layer] = []
    parts: list[Layer] = []
    sizes: list[Layer] = []
    looks = numbers_of(families)
    for i, (name, curves) in enumerate(families.items()):
        f, style = curves.f, style_of(looks[i])
        if not any(_same_plant(curves, other) for other in list(families.values())[:i]):
            plants.append(Curve(f, np.abs(curves.P), name=name, **style))
        LP = np.where(np.abs(curves.Q) > PASSED, np.abs(curves.LP), np.nan)
        parts.append(Curve(f, LP, name=f"|L P|, {name}", **style))
        shade = f"#{3 * f'{127 * i // len(families):02x}'}"
        parts.append(Curve(f, np.abs(curves.Q), style["dash"], name=f"|Q|, {name}", colour=shade))
        top = int(np.argmax(curves.high))
        said = f"{name}; shaded: its family\nat most {curves.high[top]:.3g} at {f[top]:.3g} Hz"
        hue = style["colour"]
        sizes += [
            Curve(f, curves.nominal, name=said, **style),
            Band(f, curves.low, curves.high, alpha=0.2, name=said, colour=hue),
            Curve([f[top]], [curves.high[top]], dash="", mark="o", size=5, name=said, colour=hue),
        ]
    first = next(iter(families.values()))
    without = "|1 − L P| without Q,\nlargest"
    sizes += [Curve(first.f, first.without, dash=":", name=without, colour=GREY)]
    sizes.append(Rule(1.0, name="1: learning may diverge"))
    if margin:
        sizes.append(Rule(1 - margin, dash="--", name=f"{1 - margin:g}: asked for"))
    found, of_P, tall = _ends_of_families([*families.values()])
    along = FREQUENCY._replace(ends=found)
    return Figure(
        [Panel(along, Axis("|P|", unit, log=True, ends=of_P), plants),
         Panel(along, Axis("|Q|, |L P|", log=True, ends=SIZES), parts),
         Panel(along, Axis("|Q (1 − L P)|", ends=(0, max(1.3, min(1.2 * tall, 5.0)))), sizes)],
        "Whether the Q-filter is safe: |Q (1 − L P)| must stay below 1.",
        size=(7.2, 7.6),
    )  # fmt: skip


def _ends_of_families(
    families: Sequence[Curves],
) -> tuple[tuple[float, float], tuple[float, float] | None, float]:
    """Frequencies up to which Q passes anything, |P| within three decades, and the largest test.

    A plant that stands still has no such decades.
    """
    passed = max(np.max(c.f[np.abs(c.Q) > PASSED], initial=c.f[0]) for c in families)
    lowest = max(min(c.f[0] for c in families), SLOWEST_SHOWN * passed)
    sizes = np.concatenate([np.abs(c.P[(c.f >= lowest) & (c.f <= passed)]) for c in families])
    largest = float(np.max(sizes))
    least = max(float(np.min(sizes)), LEAST * largest)
    tall = max(float(np.max(c.high)) for c in families)
    return (lowest, passed), (least / 2, 2 * largest) if largest > 0 else None, tall


def _same_plant(one: Curves, other: Curves) -> bool:
    seen = np.interp(one.f, other.f, np.abs(other.P))
    return bool(np.allclose(np.abs(one.P), seen, rtol=0.02))


# A learned law in time and in frequency, beside the inverse of the plant
# --------------------------------------------------------------------------------------------------


SHOWN_OF_L = 1e-3  # share of the largest |L| down to which it is shown
SLOWEST_OF_LAW = 2e-4  # of the last frequency
DARK = "#333333"
PALEST = 0.4  # opacity of the last segment


@drawn
def learned_law_figure(learned: Learned, dt: float, *, unit: str = "") -> Figure:
    """The taps of L and Q over time, and their responses beside 1 / P; four axes.

    The law is u_{j+1} = Q u_j + L e_j, so that L is Q / P where it inverts the plant. Below stand
    |L| with |1 / P| and |Q / P| of the nominal machine, and |Q| with |Q - L P| of the nominal
    machine and the largest of the family. Of several channels each pair has a colour of its own,
    and the segments of a scheduled law are the paler the later they are; |Q| and |Q - L P| are then
    the largest singular values.

    dt: sample time [s]
    unit: of L, input per output
    Raises ValueError for a law that was refused at its gate, which has no taps.
    """
    if learned.passed is None:
        raise ValueError(f"learned_law_figure: the law was refused: {learned.refused}")
    filters, window, family = learned.passed.filters, learned.window, learned.family
    L, keep = (_whole(taps, bool(window.starts)) for taps in filters)
    taps = [_taps(L, 1 + window.lead, dt, "L", unit), _taps(keep, 0, dt, "Q", "")]
    f = family.frequencies
    of_L, of_keep = window.responses(f, dt)
    L, keep = (
        np.einsum("fp,spij->sfij", of, taps) for of, taps in ((of_L, L), (of_keep + 0j, keep))
    )
    P = family.P[:, :, None, None] if family.P.ndim == 2 else family.P
    along, top = (
        FREQUENCY._replace(ends=(max(f[0], SLOWEST_OF_LAW * f[-1]), f[-1])),
        np.max(np.abs(L)),
    )
    of_law = Axis("magnitude", unit, log=True, ends=(SHOWN_OF_L * top, 10 * top))
    of_sizes = Axis("magnitude", ends=(0, 1.25))
    return Figure(
        [*taps, Panel(along, of_law, _inverses(f, L, keep, P[0]), legend="best"),
         Panel(along, of_sizes, _sizes(f, L, keep, P), legend="best")],
        "The law in time, the look-ahead of each tap, and in frequency, beside the inverse of the "
        "plant.",
        columns=2, size=(9.0, 6.4), shares="",
    )  # fmt: skip


def _taps(taps, middle: int, dt: float, name: str, unit: str) -> Panel:
    """The taps (S, p, n, m) over the time by which they look ahead."""
    p = taps.shape[1]
    shift = 1e3 * dt * (middle + np.arange(p) - p // 2)
    layers: list[Layer] = [
        Curve(shift, line, mark=".", size=3, width=0.8, colour=hue, alpha=pale, name=label)
        for hue, pale, label, line in _each(taps, name)
    ]
    layers += [
        Curve([], [], colour=GREY, alpha=_opacity(s, len(taps)), name=f"segment {s + 1}")
        for s in range(len(taps) if len(taps) > 1 else 0)
    ]
    layers.append(Rule(0.0, "x"))
    several = taps[:, 0].size > 1
    return Panel(
        Axis("looks ahead by [ms]"), Axis("L" * (name == "L"), unit), layers, f"{p} taps of {name}",
        "best" if several else "", 2 if taps[0, 0].size > 1 else 1,
    )  # fmt: skip


def _inverses(f, L, keep, P) -> list[Layer]:
    """|L| of each segment and pair beside |Q / P|, and beside |1 / P| of one channel."""
    alone = L[:, 0].size == 1
    layers: list[Layer] = []
    for values, dash, name, colour in (
        (L, "-", "|L|, learned", COLOURS[0]),
        (keep @ np.linalg.pinv(P), "--", "|Q / P|", COLOURS[1]),
    ):
        for hue, pale, label, line in _each(values, ""):
            hue, label = (colour, name) if alone else (hue, label)
            layers.append(Curve(f, np.abs(line), dash, alpha=pale, colour=hue, name=label))
        if not alone:
            layers.append(Curve([], [], dash, colour=GREY, name=name))
    if L[0, 0].size == 1:
        inverse = 1 / np.abs(P[:, 0, 0])
        layers.append(Curve(f, inverse, ":", colour=GREY, name="|1 / P|, the inverse"))
    return layers


def _sizes(f, L, keep, P) -> list[Layer]:
    """|Q|, |Q - L P| of the nominal machine, and the largest of the family and of all segments."""

    def size(matrices):
        return np.linalg.norm(matrices, ord=2, axis=(-2, -1))

    sizes = np.max([size(Q - one @ P) for Q, one in zip(keep, L, strict=True)], axis=0)
    layers: list[Layer] = []
    for i, Q in enumerate(size(keep)):
        name = "|Q|" if len(keep) == 1 else f"|Q|, segment {i + 1}"
        pale = _opacity(i, len(keep))
        layers.append(Curve(f, Q, "--", colour=DARK, alpha=pale, name=name))
    largest = np.max(sizes, axis=0)
    return [
        *layers,
        Curve(f, sizes[0], name="|Q − L P|, nominal"),
        Curve(f, largest, colour=COLOURS[1], name=f"largest of {len(P)}"),
        Rule(1.0),
    ]


def _each(values, name: str) -> Iterator[tuple[str, float, str, np.ndarray]]:
    """Colour, opacity, name (in the first segment) and line of each pair of values (S, K, n, m)."""
    S, _, n, m = values.shape
    for s in range(S):
        for pair, (i, j) in enumerate(np.ndindex(n, m)):
            label = f"{name}{i + 1}{j + 1}" if n * m > 1 else name
            yield colour_of(pair), _opacity(s, S), label * (not s), values[s, :, i, j]


def _opacity(segment: int, segments: int) -> float:
    return float(np.linspace(1.0, PALEST, segments)[segment])


def _whole(taps, scheduled: bool) -> np.ndarray:
    """Taps as (S, p, n, m), also of one segment and of one channel."""
    taps = np.asarray(taps, float)
    taps = taps if scheduled else taps[None]
    return taps if taps.ndim == 4 else taps[:, :, None, None]
