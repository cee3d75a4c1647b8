"""What a command found, in sentences, and the command to type next.

This module does not import NumPy or JAX, so that commands that need neither stay fast.
"""

from __future__ import annotations

from typing import NamedTuple


class Verdict(NamedTuple):
    """What a command found, and what to do next.

    said: one or two sentences
    what: what the next command does, in words
    following: the next command, quoted for a shell; empty if there is none
    """

    said: tuple[str, ...]
    what: str = ""
    following: str = ""

    @property
    def lines(self) -> list[str]:
        """The lines to print."""
        head = f"Next, {self.what}: " if self.what else "Next: "
        return [*self.said, *([head + self.following] if self.following else [])]

    def as_json(self) -> dict[str, object]:
        """The entries for the file of the numbers."""
        return {"verdict": list(self.said), "next": self.following}
