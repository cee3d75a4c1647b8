"""Figures on paper: a description becomes axes of Matplotlib, which do not use pyplot's state."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any, ParamSpec, Protocol

import numpy as np

from .description import Axis, Band, Bars, Cells, Curve, Figure, Layer, Panel, Rule, Shade, Where
from .style import limits_of
from .units import name_axis

P = ParamSpec("P")


class Drawn(Protocol[P]):
    """A function that draws what another one describes, and that one."""

    described: Callable[P, Figure]

    def __call__(self, *args: Any, ax: Any = None, **named: Any) -> Any: ...


def drawn(describe: Callable[P, Figure]) -> Drawn[P]:
    """The function that draws a described figure and returns its axes, those given as `ax` or new.

    The description itself is what its `described` returns, which a page takes.
    """

    @functools.wraps(describe)
    def of_axes(*args: Any, ax: Any = None, **named: Any) -> Any:
        return draw(describe(*args, **named), ax)

    made: Any = of_axes
    made.described = describe
    return made


def draw(figure: Figure, ax: Any = None) -> Any:
    """The axes of a figure: one, or an array in rows and columns as in `pyplot.subplots`.

    ax: axes to draw on; None for those of a new figure
    """
    rows = math.ceil(len(figure.panels) / figure.columns)
    if ax is None:
        ax = new_axes(
            rows, figure.columns, size=figure.size,
            sharex="x" in figure.shares and (figure.columns == 1 or "col"),
            sharey="y" in figure.shares and "row",
            height_ratios=figure.heights, width_ratios=figure.widths,
        )  # fmt: skip
    flat = np.ravel(ax)
    for one, panel in zip(flat, figure.panels, strict=True):
        one.set_xscale("log" if panel.x.log else "linear")
        one.set_yscale("log" if panel.y.log else "linear")
        if panel.y.log:
            one.set_ylim(*(limits_of(panel.heights()) or (0.1, 10.0)))
        for layer in panel.layers:
            DRAW[type(layer)](one, layer)
        _finish(one, panel)
    _colour_bar(figure, flat)
    all_named: dict[str, Any] = {}
    for one, panel in zip(flat, figure.panels, strict=True):
        if figure.below:
            all_named = named(one) | all_named
        elif panel.legend and named(one):
            place: dict[str, Any] = {
                "beside": {"loc": "upper left", "bbox_to_anchor": (1.0, 1.02)},
                "above": {"loc": "lower left", "bbox_to_anchor": (0.0, 1.0)},
            }.get(panel.legend, {"loc": panel.legend})
            _legend(one, named(one), ncols=panel.columns, **place)
    if figure.below:
        _legend(flat[0].figure, all_named, ncols=6, loc="outside lower center")
    _leave_out_labels(figure, flat)
    return ax


def _leave_out_labels(figure: Figure, axes: np.ndarray) -> None:
    """Name a shared axis once, at the bottom, and rows whose labels are the same at the left."""
    wide = figure.columns
    if "x" in figure.shares:
        for one in axes[:-wide]:
            one.set_xlabel("")
    for i in reversed(range(len(axes))):
        if i % wide and axes[i].get_ylabel() == axes[i - 1].get_ylabel():
            axes[i].set_ylabel("")
    if len(axes) > wide:
        axes[0].figure.align_ylabels(axes[::wide])


def named(ax: Any) -> dict[str, Any]:
    """What the legend of axes shows, by name; of several of one name the first."""
    found: dict[str, Any] = {}
    for handle, name in zip(*ax.get_legend_handles_labels(), strict=True):
        found.setdefault(name, handle)
    return found


def _legend(of: Any, found: dict[str, Any], *, loc: str, **place: Any) -> None:
    of.legend([*found.values()], [*found], fontsize="small", loc=loc, **place)


def _colour_bar(figure: Figure, axes: np.ndarray) -> None:
    """The colours of all panels with maps, which have the same."""
    shown = [(of.shows, ax) for ax, panel in zip(axes, figure.panels, strict=True)
             for of in panel.layers if isinstance(of, Cells)]  # fmt: skip
    if shown:
        of, beside = shown[0][0], [ax for _, ax in shown]
        maps = [ax.collections[0] for ax in beside]
        for one in maps:
            one.set_norm(maps[0].norm)
        extend = "min" if of.cut else "neither"
        bar = beside[0].figure.colorbar(maps[0], ax=beside, extend=extend)
        name_axis(bar.ax.yaxis, of.name, of.unit)


def new_axes(
    rows: int = 1, columns: int = 1, *, size: tuple[float, float] | None = None, **named: Any
) -> Any:
    """The axes of a new figure.

    size: width and height [in]; None for a height of 2.6 in for each row
    named: further arguments of `Figure.subplots`
    """
    from matplotlib.figure import Figure as Paper

    paper = Paper(figsize=size or (7.2, 1.6 + 2.6 * rows), layout="constrained", dpi=150)
    return paper.subplots(rows, columns, **named)


def _finish(ax: Any, panel: Panel) -> None:
    """Ends, ticks, labels and the title, after all layers are drawn."""
    ax.set_title(panel.title, fontsize="medium")
    for way, of in (("x", panel.x), ("y", panel.y)):
        axis = getattr(ax, f"{way}axis")
        if of.ends:
            getattr(ax, f"set_{way}lim")(*of.ends)
        _ticks(axis, of)
    grid(ax)
    if panel.equal:
        ax.set_aspect("equal", adjustable="datalim")
        ax.apply_aspect()
    for axis, of in ((ax.xaxis, panel.x), (ax.yaxis, panel.y)):
        if not of.names:
            name_axis(axis, of.name, of.unit)
    if panel.note:
        ground = {"facecolor": "w", "edgecolor": "none", "alpha": 0.7, "pad": 1.5}
        look: dict[str, Any] = {"ha": "right", "va": "top", "fontsize": "x-small", "bbox": ground}
        ax.text(0.98, 0.96, panel.note, transform=ax.transAxes, **look)


def _ticks(axis: Any, of: Axis) -> None:
    from matplotlib.ticker import MaxNLocator

    if of.names:
        axis.set_ticks(range(len(of.names)), of.names)
        axis.set_label_text(of.name)
    elif of.ticks:
        axis.set_ticks(of.ticks)
    elif of.most:
        axis.set_major_locator(MaxNLocator(of.most, integer=of.whole))


def grid(ax: Any) -> None:
    """Add a pale grid after all curves are drawn, and plain numbers on logarithmic axes."""
    ax.grid(True, alpha=0.25)
    ax.set_axisbelow(True)
    for axis in (ax.xaxis, ax.yaxis):
        if axis.get_scale() == "log":
            name_axis(axis, axis.get_label_text(), "")
            low, high = sorted(axis.get_view_interval())
            if high < 1e2 * low:
                axis.grid(True, which="minor", alpha=0.15)


# Layers
# --------------------------------------------------------------------------------------------------


def _look(layer: Layer) -> dict[str, Any]:
    return {"color": layer.colour, "alpha": None if layer.alpha == 1 else layer.alpha,
            "label": layer.name or None}  # fmt: skip


def _curve(ax: Any, of: Curve) -> None:
    look = _look(of) | {
        "linestyle": of.dash or "none", "linewidth": of.width,
        "drawstyle": "steps-post" if of.steps else "default",
    }  # fmt: skip
    if of.mark:
        look |= {"marker": of.mark, "markersize": of.size, "markevery": of.marked}
        look |= {} if of.filled else {"mfc": "none"}
        look |= {"mec": of.rim, "zorder": 5} if of.rim else {}
    for line in ax.plot(of.x, np.asarray(of.y).T, **look)[1:]:
        line.set_label(None)
    for x, y, text in zip(of.x, of.y, of.texts, strict=True) if of.texts else ():
        right = x > np.mean(ax.get_xlim())
        if text:
            ax.annotate(
                text, (x, y), textcoords="offset points", xytext=(-6 if right else 6, 5),
                ha="right" if right else "left", fontsize="small",
            )  # fmt: skip


def _band(ax: Any, of: Band) -> None:
    look = _look(of) | {"linewidth": 0, "step": "post" if of.steps else None}
    ax.fill_between(of.x, of.low, of.high, **look)


def _rule(ax: Any, of: Rule) -> None:
    line = ax.axvline if of.across == "x" else ax.axhline
    line(of.at, linestyle=of.dash, linewidth=of.width, **_look(of))


def _shade(ax: Any, of: Shade) -> None:
    span = ax.axvspan if of.across == "x" else ax.axhspan
    span(of.low, of.high, linewidth=0, **_look(of))


def _bars(ax: Any, of: Bars) -> None:
    bars = ax.barh(range(len(of.values)), of.values, color=of.colours, height=0.6)
    ax.bar_label(bars, padding=4, fontsize="small")


def _cells(ax: Any, of: Cells) -> None:
    from matplotlib.colors import LogNorm, Normalize

    norm = (LogNorm if of.shows.log else Normalize)(*of.shows.ends)
    shading = "nearest" if len(of.x) == len(of.values) else "flat"
    ax.pcolormesh(
        of.x, of.y, np.ma.masked_invalid(of.values).T, norm=norm, cmap=of.shows.palette,
        shading=shading, rasterized=True,
    )  # fmt: skip


def _where(ax: Any, of: Where) -> None:
    if np.any(of.holds) and not np.all(of.holds):
        ax.contour(of.x, of.y, np.asarray(of.holds).T, [0.5], colors=of.colour, linewidths=1.0)


DRAW: dict[type, Callable[[Any, Any], None]] = {
    Curve: _curve, Band: _band, Rule: _rule, Shade: _shade, Bars: _bars, Cells: _cells,
    Where: _where,
}  # fmt: skip
