"""Signals within chosen trials: tracking against time with a zoom, and the contour of two axes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from .description import TIME, Axis, Band, Curve, Figure, Layer, Panel, Shade
from .paper import drawn
from .style import BLACK, DASHES, PALE, Dash, placed, shades_of

if TYPE_CHECKING:
    import xarray as xr

ZOOM = 0.05  # share of the trial that the zoom shows
DENSE, COLUMNS = 1500, 300  # samples from which on, and columns in which, noise is a band
NOISY = 0.2  # share of the whole range that noise has within a column
SHOWN = 0.1  # share of the width of a path, with which its largest contour error is drawn


def signal_of(dataset: xr.Dataset, name: str, scheme: str, trial: int) -> np.ndarray:
    """(N+1, channels) y or e, or (N, inputs) u, of one trial of one machine.

    dataset: result of `run_schemes`, or one machine of a sweep, `dataset.sel(sample=17)`; a sweep
        stores only the signals in `keep`, of the last trial
    Raises ValueError for a signal, scheme or trial that is not there, naming those that are.
    """
    if name not in dataset:
        raise ValueError(
            f"the dataset has no signal {name!r}; a sweep stores those it is told to keep"
        )
    if scheme not in dataset["scheme"]:
        raise ValueError(
            f"scheme = {scheme!r} is not one of {', '.join(map(str, dataset['scheme'].values))}"
        )
    found = dataset[name].sel(scheme=scheme)
    last = int(found.coords.get("trials", dataset["trial"][-1]))  # one point has its own
    if "sample" in found.dims:
        raise ValueError(
            f"{name} has {found.sizes['sample']} machines; choose one, as in dataset.sel(sample=0)"
        )
    kept = [int(j) for j in found["trial"]] if "trial" in found.dims else [last]
    if trial not in kept:
        raise ValueError(f"trial = {trial} is not one of those kept, {kept[0]} to {kept[-1]}")
    values = (found.sel(trial=trial) if "trial" in found.dims else found).values
    return values.reshape(len(values), -1)


def outputs_of(dataset: xr.Dataset) -> list[str]:
    """What each output is called: by its name, or `output 1`, counted from 0."""
    numbers = np.arange(dataset.sizes.get("channel", 1))
    found = np.atleast_1d(dataset.coords.get("channel", numbers)).tolist()
    return [one if isinstance(one, str) else f"output {one}" for one in found]


@drawn
def tracking(
    dataset: xr.Dataset,
    scheme: str,
    trials: Sequence[int],
    *,
    zoom: tuple[float, float] | None = None,
    scale: float = 1.0,
    unit: str = "",
) -> Figure:
    """Output, error of each channel and input of one scheme against time; axes (rows, 2).

    The chosen trials are shown, with a zoom beside each plot. With several trials, the axis of the
    error is scaled to all but the first one.

    dataset: dataset with y, e, u, as for `signal_of`
    zoom: (from, to) [s]; None for a twentieth of the trial, around the largest error of the last
        trial chosen
    scale, unit: the error is shown as `scale` times that of the dataset, in `unit`
    Raises ValueError for a zoom that does not lie within the trial, and as `signal_of` does.
    """
    signals = [
        tuple(placed(signal_of(dataset, name, scheme, j)) for name in ("y", "e", "u"))
        for j in trials
    ]
    time, shades = dataset["time"].values, shades_of(trials)
    low, high = _around_the_largest(time, signals[-1][1]) if zoom is None else zoom
    if not time[0] <= low < high <= time[-1]:
        raise ValueError(
            f"tracking: zoom = ({low:g}, {high:g}) is not a part of the trial, {time[0]:g} to "
            f"{time[-1]:g} s"
        )
    found = [_reference(dataset, j, *s[:2]).T for s, j in zip(signals, trials, strict=True)]
    references = list({r.tobytes(): r for r in found}.values()) if "r" in dataset else found[:1]
    channels = signals[0][1].shape[1]
    names = outputs_of(dataset)
    called = names if len(names) > 1 and not names[0].startswith("output ") else None
    of_error = ["error" + f" of {name}" * (channels > 1) for name in names]
    of_y, of_u = (dataset[name].attrs.get("units", "") for name in ("y", "u"))
    shaded = [Shade(low, high, alpha=0.25)]
    panels: list[list[Panel]] = []
    for part in (time >= time[0], (time >= low) & (time <= high)):
        at = time[part]
        r = Curve(at, np.concatenate(references)[:, part], width=3, colour=PALE)
        rows: list[list[Layer]] = [[replace(r, name="reference")], *([] for _ in of_error), []]
        for (y, e, u), j, shade in zip(signals, trials, shades, strict=True):
            for row, values in zip(rows, (y, *(scale * e.T[..., None]), u), strict=True):
                for i, line in enumerate(values.T):
                    which = np.flatnonzero(part[: len(line)])
                    row += _signal(
                        time[which], line[which], colour=shade, name=_label(i, j, called),
                        steps=values is u, dash=DASHES[i % 4],
                    )  # fmt: skip
        along = TIME._replace(ends=(at[0], at[-1]), most=3 * bool(panels))
        fits = [_fit([scale * e[part, c] for _, e, _ in signals[1:] or signals])
                for c in range(channels)]  # fmt: skip
        ups = [Axis("output", of_y),
               *(Axis(name, unit, ends=ends) for name, ends in zip(of_error, fits, strict=True)),
               Axis("input", of_u)]  # fmt: skip
        marked = [] if panels else shaded
        titles = ["zoom on the shaded part" if panels else f"{scheme}: output, error and input"]
        columns = zip(ups, rows, titles + [""] * (channels + 1), strict=True)
        panels.append([Panel(along, up, [*row, *marked], title) for up, row, title in columns])
    return Figure(
        [panel for row in zip(*panels, strict=True) for panel in row],
        f"{scheme}: output, error and input within chosen trials; the right column shows the "
        "shaded part.",
        columns=2, size=(7.2, 1.2 + 1.8 * (channels + 2)), widths=(2, 1), below=True,
    )  # fmt: skip


@drawn
def contour(
    dataset: xr.Dataset,
    scheme: str,
    trials: Sequence[int],
    *,
    window: int = 64,
    magnification: float | None = None,
    scale: float = 1.0,
    unit: str = "",
) -> Figure:
    """The path of two axes with the measured motion, and the contour error along it; two axes.

    The distance of the motion from the path is drawn magnified.

    dataset: dataset with y, e of two channels, as for `signal_of`
    window: half width in points of the path, see `contour_error`
    magnification: None for a number 1, 2 or 5 times a power of ten, with which the largest error is
        drawn as 5 to 10 % of the path's width
    scale, unit: the error is shown as `scale` times that of the dataset, in `unit`
    Raises ValueError for another number of channels, for a machine of a sweep that diverged, and as
    `signal_of` does.
    """
    import jax

    from ..signals.contour import contour_error

    signals = [tuple(signal_of(dataset, name, scheme, j) for name in ("y", "e")) for j in trials]
    references = [_reference(dataset, j, *s) for s, j in zip(signals, trials, strict=True)]
    references = references if "r" in dataset else references[:1] * len(trials)
    path = references[0]
    if path.shape[1] != 2:
        raise ValueError(
            f"contour: the dataset has {path.shape[1]} outputs; allowed are 2, the axes of a plane"
        )
    if not np.all(np.isfinite(path)):
        raise ValueError(
            f"contour: trial {trials[0]} diverged, and a sweep does not keep the path; choose "
            "another sample"
        )
    pairs = [(y, r) for (y, _), r in zip(signals, references, strict=True)]
    errors = [np.asarray(contour_error(y, r, window=window)) for y, r in pairs]
    # the gradient of the distance is its direction, so this is the vector from the path to the tool
    away = jax.grad(lambda y, r: 0.5 * (contour_error(y, r, window=window) ** 2).sum())
    largest = np.max(np.abs(errors), where=np.isfinite(errors), initial=0.0)
    width = np.max(np.ptp(path, axis=0))
    m = magnification or (_one_two_five(SHOWN * width / largest) if largest > 0 else 1.0)
    arcs = [np.append(0.0, np.cumsum(np.linalg.norm(np.diff(r, axis=0), axis=1)))
            for r in references]  # fmt: skip
    paths: list[Layer] = []
    distances: list[Layer] = []
    of_trials = zip(pairs, errors, arcs, trials, shades_of(trials), strict=True)
    for (y, r), error, arc, j, shade in of_trials:
        along_x, along_y = (y + (m - 1.0) * np.asarray(away(y, r))).T
        paths.append(Curve(along_x, along_y, width=0.8, colour=shade, name=f"trial {j}"))
        distances.append(Curve(arc, scale * error, width=0.8, colour=shade, name=f"trial {j}"))
    for r in {r.tobytes(): r for r in references}.values():
        paths.append(Curve(r[:, 0], r[:, 1], width=0.8, colour=BLACK, name="path"))
    length, (of_x, of_y) = dataset["y"].attrs.get("units", ""), outputs_of(dataset)
    if of_x.startswith("output "):
        of_x, of_y = "x", "y"
    title = f"{scheme}: contour error drawn {m:g} times"
    along = Axis("length along the path", length, ends=(0.0, max(arc[-1] for arc in arcs)))
    return Figure(
        [Panel(Axis(of_x, length), Axis(of_y, length), paths, title, equal=True),
         Panel(along, Axis("contour error", unit), distances, legend="")],
        f"{scheme}: the path with the motion, whose distance from it is drawn larger, and the "
        "contour error along the path.",
        size=(7.2, 7.6), shares="", heights=(2.4, 1),
    )  # fmt: skip


def _signal(time, values, *, colour: str, name: str, steps: bool, dash: Dash) -> list[Layer]:
    """A signal; one of many samples that is mostly noise, a filled bar, as its band and mean."""
    if len(values) > DENSE and np.all(np.isfinite(values)):
        starts = np.linspace(0, len(values), COLUMNS + 1).astype(int)[:-1]
        low, high = np.minimum.reduceat(values, starts), np.maximum.reduceat(values, starts)
        if np.median(high - low) > NOISY * np.ptp(values):
            mean = np.add.reduceat(values, starts) / np.diff(np.append(starts, len(values)))
            noise = Band(time[starts], low, high, colour=colour, alpha=0.3)
            line = Curve(time[starts], mean, dash, 1, colour=colour, name=name, steps=steps)
            return [noise, line]
    return [Curve(time, values, dash, 1, colour=colour, name=name, steps=steps)]


def _label(line: int, trial: int, names: list[str] | None) -> str:
    """The label of a line: the trial for the first output, the name of the output for others."""
    if names is None or line >= len(names):
        return f"output {line}" if line else f"trial {trial}"
    return names[line] if line else f"trial {trial}, {names[0]}"


def _reference(dataset, trial: int, y, e) -> np.ndarray:
    """(N+1, channels) the reference of a trial."""
    if "r" not in dataset:
        return y + e
    r = dataset["r"]
    return (r.sel(trial=trial) if "trial" in r.dims else r).values


def _around_the_largest(time, e) -> tuple[float, float]:
    """A window around the largest error: a share ZOOM of the trial, but at least four samples."""
    half = min(max(0.5 * ZOOM * time[-1], 2.0 * time[1]), 0.5 * time[-1])
    at = time[np.argmax(np.max(np.nan_to_num(np.abs(e)), axis=1))]
    low = np.clip(at - half, time[0], time[-1] - 2 * half)
    return low, min(low + 2 * half, time[-1])  # rounding may put the sum beyond the end


def _fit(lines) -> tuple[float, float] | None:
    """Ends that are symmetric about zero and show all of the lines."""
    largest = np.max(np.abs(lines))
    return (-1.2 * largest, 1.2 * largest) if np.isfinite(largest) and largest > 0 else None


def _one_two_five(value: float) -> float:
    """The largest of ..., 1, 2, 5, 10, 20, ... that is not above the value."""
    decade = 10.0 ** np.floor(np.log10(value))
    return decade * max(n for n in (1, 2, 5) if n * decade <= value)
