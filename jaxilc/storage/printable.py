"""Text that a terminal can be given: what it would act on, such as a code for a colour, is written
out.
"""

from __future__ import annotations

import unicodedata


def printable(text: str) -> str:
    """The text with its line ends, and everything else that cannot be printed as Python would write
    it.
    """
    return "".join(
        c if c == "\n" or c.isprintable() or unicodedata.category(c) == "Zs" else _written(c)
        for c in text
    )


def _written(character: str) -> str:
    return character.encode("unicode_escape").decode()
