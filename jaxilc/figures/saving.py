"""Writing figures to files: as pictures or as vectors, for print or on a dark page."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.colors import to_hex, to_rgba, to_rgba_array
from matplotlib.text import Text

from ..storage.figure_format import choose as choose
from ..storage.figure_format import chosen
from ..storage.files import atomically
from .style import readable

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
