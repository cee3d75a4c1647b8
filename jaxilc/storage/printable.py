"""Text that is safe to print, in which control characters, such as colour codes, are escaped."""

from __future__ import annotations

import unicodedata


def printable(text: str) -> str:
    """The text with Python's escapes for characters that cannot be printed, except line ends."""
    return "".join(
        c if c == "\n" or c.isprintable() or unicodedata.category(c) == "Zs" else _written(c)
        for c in text
    )


def _written(character: str) -> str:
    return character.encode("unicode_escape").decode()
