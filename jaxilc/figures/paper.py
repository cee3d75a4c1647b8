"""Figures on paper: a description becomes axes of Matplotlib, which are saved as a file.

They do not use the state of pyplot.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, ParamSpec, Protocol, TypeAlias

import numpy as np

from ..storage.figure_format import choose as choose
from ..storage.figure_format import chosen
from ..storage.files import atomically
from .description import Axis, Band, Bars, Cells, Curve, Figure, Layer, Panel, Rule, Shade, Where
from .style import edges_of, limits_of, name_axis, placed, readable

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis as AxisOfPaper
    from matplotlib.figure import Figure as Paper
    from matplotlib.typing import LegendLocType

    from ..pytree.aliases import Value
    from .description import Points

Drawing: TypeAlias = Any  # axes, or an array of those of one figure, as of `pyplot.subplots`
Handles: TypeAlias = "dict[str, Artist]"  # of a legend, by name
P = ParamSpec("P")
BAR = 12.0  # width of a band at a single point [pt]
PLACES: Mapping[str, tuple[LegendLocType, tuple[float, float] | None]] = {  # corner, and where
    "beside": ("upper left", (1.0, 1.02)),
    "above": ("lower left", (0.0, 1.0)),
    "best": ("best", None),
    "lower left": ("lower left", None),
    "upper right": ("upper right", None),
}


class Drawn(Protocol[P]):
    """A function that draws what another one describes, and that one."""

    described: Callable[P, Figure]

    def __call__(self, *args: Value, ax: Drawing = None, **named: Value) -> Drawing: ...


def drawn(describe: Callable[P, Figure]) -> Drawn[P]:
    """The function that draws a described figure, on axes `ax` or new ones, which it returns.

    The description itself is what its `described` returns, which a page takes.
    """

    @functools.wraps(describe)
    def of_axes(*args: Value, ax: Drawing = None, **named: Value) -> Drawing:
        return draw(describe(*args, **named), ax)

    made: Value = of_axes
    made.described = describe
    return made


def draw(figure: Figure, ax: Drawing = None) -> Drawing:
    """The axes of a figure, new ones without `ax`: one, or rows as in `pyplot.subplots`."""
    rows = math.ceil(len(figure.panels) / figure.columns)
    if ax is None:
        from matplotlib.figure import Figure as Paper

        size = figure.size or (7.2, 1.6 + 2.6 * rows)
        ax = Paper(figsize=size, layout="constrained", dpi=150).subplots(
            rows, figure.columns,
            sharex="x" in figure.shares and (figure.columns == 1 or "col"),
            sharey="y" in figure.shares and "row",
            height_ratios=figure.heights, width_ratios=figure.widths,
        )  # fmt: skip
    flat = np.ravel(ax)
    for one, panel in zip(flat, figure.panels, strict=True):
        one.set_xscale("log" if panel.x.log else "linear")
        one.set_yscale("log" if panel.y.log else "linear")
        if panel.y.log and not panel.is_map:
            one.set_ylim(*(limits_of(panel.heights()) or (0.1, 10.0)))
        for layer in panel.layers:
            DRAW[type(layer)](one, layer)
        _finish(one, panel)
    _colour_bar(figure, flat)
    all_named: Handles = {}
    for one, panel in zip(flat, figure.panels, strict=True):
        here = named(one)
        if figure.below:
            all_named = here | all_named
        elif here and panel.legend:
            _legend(one, here, panel.columns, *PLACES[panel.legend])
    if all_named:
        of = flat[0].figure  # a page, or a part of one
        columns = max(1, min(6, int(of.bbox.width / of.figure.dpi) - 1))
        _legend(of, all_named, columns, "outside lower center")
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


def named(ax: Axes) -> Handles:
    """What the legend of axes shows, by name; of several of one name the first."""
    found: Handles = {}
    for handle, name in zip(*ax.get_legend_handles_labels(), strict=True):
        found.setdefault(name, handle)
    return found


def _legend(of: Axes | Paper, found: Handles, columns: int, loc: LegendLocType, at=None) -> None:
    handles, names = [*found.values()], [*found]
    of.legend(handles, names, fontsize="small", loc=loc, ncols=columns, bbox_to_anchor=at)


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


def _finish(ax: Axes, panel: Panel) -> None:
    """Ends, ticks, labels and the title, after all layers are drawn."""
    ax.set_title(panel.title, fontsize="medium")
    ax.grid(True, alpha=0.25)
    ax.set_axisbelow(True)
    for way, of in (("x", panel.x), ("y", panel.y)):
        if of.ends:
            getattr(ax, f"set_{way}lim")(*of.ends)
        _ticks(getattr(ax, f"{way}axis"), of)
    if panel.equal:
        ax.set_aspect("equal", adjustable="datalim")
        ax.apply_aspect()
    for axis, of in ((ax.xaxis, panel.x), (ax.yaxis, panel.y)):
        if not of.names:
            name_axis(axis, of.name, of.unit)
        low, high = sorted(axis.get_view_interval())
        if of.log and high < 1e2 * low:
            axis.grid(True, which="minor", alpha=0.15)
    if panel.note:
        ground = {"facecolor": "w", "edgecolor": "none", "alpha": 0.7, "pad": 1.5}
        ax.text(
            0.98, 0.96, panel.note, transform=ax.transAxes,
            ha="right", va="top", fontsize="x-small", bbox=ground,
        )  # fmt: skip


def _ticks(axis: AxisOfPaper, of: Axis) -> None:
    from matplotlib.ticker import MaxNLocator

    if of.names:
        axis.set_ticks(range(len(of.names)), of.names)
        axis.set_label_text(of.name)
    elif of.ticks:
        axis.set_ticks(of.ticks)
    elif of.most:
        axis.set_major_locator(MaxNLocator(of.most, integer=of.whole, min_n_ticks=1))


# Layers
# --------------------------------------------------------------------------------------------------


def _look(layer: Layer) -> dict[str, Value]:
    alpha = None if layer.alpha == 1 else layer.alpha
    return {"color": layer.colour, "alpha": alpha, "label": layer.name or None}


def _curve(ax: Axes, of: Curve) -> None:
    lines = ax.plot(
        placed(of.x), placed(of.y).T, linestyle=of.dash or "none", linewidth=of.width,
        drawstyle="steps-post" if of.steps else "default", **_look(of),
    )  # fmt: skip
    for line in lines:
        if of.shown_mark:
            line.set(marker=of.shown_mark, markersize=of.size, markevery=of.marked)
            line.set(**({} if of.filled else {"mfc": "none"}))
            line.set(**({"mec": of.rim, "zorder": 5} if of.rim else {}))
        if line is not lines[0]:
            line.set_label(None)
    for x, y, text in zip(of.x, of.y, of.texts, strict=True) if of.texts else ():
        right = x > np.mean(ax.get_xlim())
        if text:
            ax.annotate(
                text, (x, y), textcoords="offset points", xytext=(-6 if right else 6, 5),
                ha="right" if right else "left", fontsize="small",
            )  # fmt: skip


def _band(ax: Axes, of: Band) -> None:
    x, low, high = map(placed, (of.x, of.low, of.high))
    if len(x) == 1:
        ax.vlines(x, low, high, linewidth=BAR, **_look(of))
        return
    ax.fill_between(x, low, high, step="post" if of.steps else None, linewidth=0, **_look(of))


def _rule(ax: Axes, of: Rule) -> None:
    line = ax.axvline if of.across == "x" else ax.axhline
    line(float(placed(of.at)), linestyle=of.dash, linewidth=of.width, **_look(of))


def _shade(ax: Axes, of: Shade) -> None:
    span = ax.axvspan if of.across == "x" else ax.axhspan
    span(of.low, of.high, linewidth=0, **_look(of))


def _bars(ax: Axes, of: Bars) -> None:
    bars = ax.barh(range(len(of.values)), of.values, color=of.colours, height=0.6)
    ax.bar_label(bars, padding=4, fontsize="small")


def _cells(ax: Axes, of: Cells) -> None:
    from matplotlib.colors import LogNorm, Normalize

    norm = (LogNorm if of.shows.log else Normalize)(*of.shows.ends)
    edges = (of.x, of.y) if len(of.x) > len(of.values) else edges_on(ax, of.x, of.y)
    values = np.ma.masked_invalid(of.values).T
    ax.pcolormesh(*edges, values, norm=norm, cmap=of.shows.palette, rasterized=True)


def edges_on(ax: Axes, x: Points, y: Points) -> list[np.ndarray]:
    """The edges of cells with these centres on the axes."""
    both = ((x, ax.xaxis), (y, ax.yaxis))
    return [edges_of(at, axis.get_scale() == "log") for at, axis in both]


def _where(ax: Axes, of: Where) -> None:
    if np.any(of.holds) and not np.all(of.holds):
        ax.contour(of.x, of.y, np.asarray(of.holds).T, [0.5], colors=of.colour, linewidths=1.0)


DRAW: dict[type[Layer], Callable[..., None]] = {
    Curve: _curve, Band: _band, Rule: _rule, Shade: _shade, Bars: _bars, Cells: _cells,
    Where: _where,
}  # fmt: skip


# Files
# --------------------------------------------------------------------------------------------------


GROUND, INK = "#14171c", "#e8e6e3"  # of a dark figure
SEEN = 3.0  # contrast that a line needs (WCAG 2.2, for what is not text)
GREY = 0.12  # spread of red, green and blue up to which a colour counts as a grey
# Colours too dark for a dark ground, and the one that they would then be mistaken for.
LIGHTER = {"#0072b2": "#3d9be0", "#56b4e9": "#b8e2f8"}


def save(axes, path: str | Path, *, dark: bool | None = None) -> Path:
    """Write the figure of the axes, completely or not at all, and return the path of the file.

    path: its end is the format: png, svg, pdf; `choose` may have replaced it
    dark: whether lines are light on a dark ground; None for what was chosen, else for print
    """
    look, figure = chosen(), np.ravel(axes)[0].figure
    path = Path(path) if look.kind is None else Path(path).with_suffix(f".{look.kind}")
    kind = path.suffix.removeprefix(".") or None
    if look.dark if dark is None else dark:
        darken(figure)
    # No date is written, so that the same figure gives the same file.
    about = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}.get(kind or "")
    atomically(path, lambda file: figure.savefig(file, format=kind, metadata=about))
    return path


def darken(figure) -> None:
    """Turn a figure dark: the ground becomes dark, and blacks and greys become light."""
    from matplotlib.colors import to_rgba
    from matplotlib.text import Text

    if figure.get_facecolor()[:3] == to_rgba(GROUND)[:3]:
        return
    figure.set_facecolor(GROUND)
    for artist in figure.findobj():
        for name in ("color", "facecolor", "edgecolor", "markeredgecolor", "markerfacecolor"):
            get, set_ = (getattr(artist, f"{way}_{name}", None) for way in ("get", "set"))
            if get is not None and set_ is not None and not hasattr(artist, "get_cmap"):
                _change(get, set_)
        if isinstance(artist, Text):
            artist.set_color(readable(artist.get_color(), GROUND))
        box = getattr(artist, "get_bbox_patch", lambda: None)()
        if box is not None:
            box.set_facecolor(GROUND)
    for ax in figure.axes:
        ax.set_facecolor(GROUND)
        ax.tick_params(which="both", colors=INK, grid_color="#8a8f98")
    figure.patch.set_facecolor(GROUND)


def _change(get, set_) -> None:
    """Make the colour of an artist light if it is a grey, and lighter where it is not seen."""
    from matplotlib.colors import to_hex, to_rgba, to_rgba_array

    colours = get()
    if colours is None or (isinstance(colours, str) and colours in ("none", "auto")):
        return
    found = to_rgba_array(colours)
    if not len(found):
        return
    changed = found.copy()
    for i, rgba in enumerate(found):
        if np.ptp(rgba[:3]) <= GREY:
            shade = 0.08 + 0.84 * (1.0 - np.mean(rgba[:3]))
            changed[i, :3] = shade
        else:
            named = LIGHTER.get(to_hex(rgba[:3]), tuple(rgba[:3]))
            changed[i, :3] = to_rgba(readable(named, GROUND, SEEN))[:3]
    if not np.array_equal(found, changed):
        set_(changed if len(changed) > 1 else tuple(changed[0]))
