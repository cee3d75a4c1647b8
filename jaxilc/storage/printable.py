"""Text that is safe to print: what a terminal would act on, such as a colour code, is escaped."""

from __future__ import annotations

import unicodedata


def printable(text: str) -> str:
    """The text; what cannot be printed is escaped as Python does it, except for line ends."""
    return "".join(
        c if c == "\n" or c.isprintable() or unicodedata.category(c) == "Zs" else _written(c)
        for c in text
    )


def _written(character: str) -> str:
    return character.encode("unicode_escape").decode()
