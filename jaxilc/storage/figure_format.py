"""How figures are written: which format, for print or on a dark ground.

It stands here, and not with the figures, so that an option of the command line can be checked
before Matplotlib and JAX are imported.
"""

from __future__ import annotations

from contextvars import ContextVar
from typing import NamedTuple

KINDS = ("png", "svg", "pdf")


class Look(NamedTuple):
    """How figures are written.

    kind: png, svg or pdf in place of the end of a file's name; None leaves the name
    dark: light lines on a dark ground
    """

    kind: str | None = None
    dark: bool = False


_chosen: ContextVar[Look | None] = ContextVar("look", default=None)


def choose(text: str | None) -> None:
    """Choose how figures are written from now on, as `svg`, `dark` or `pdf,dark`.

    Raises ValueError naming what is allowed.
    """
    words = [word.strip() for word in (text or "").split(",") if word.strip()]
    kinds = [word for word in words if word in KINDS]
    if len(kinds) > 1 or any(word not in (*KINDS, "dark", "print") for word in words):
        raise ValueError(
            f"figures = {text!r} is not a format ({', '.join(KINDS)}), a style (print, dark), or "
            "both with a comma, as in svg,dark"
        )
    _chosen.set(Look(kinds[0] if kinds else None, "dark" in words))


def chosen() -> Look:
    """What was chosen last."""
    return _chosen.get() or Look()
