"""Moves of a G-code program: straight lines and arcs in millimetres, after RS274/NGC.

Read are G0, G1, G2, G3, G4 (P in seconds), G17, G18, G19, G20, G21, G90, G91, and the words X, Y,
Z, I, J, K, R, P and F (a minute). I, J and K are measured from the start of the arc. Comments,
block numbers, and words that move no axis (M, S, T, G64 with its P and Q, and G codes that are off
at the start of a program, such as G40) have no effect here, but M2, M30 and a % after the first
step end the program, and after G80 the next move names its motion. All else is refused with the
number of its line, a call of another program (M97, M98, M99) too.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Sequence

import numpy as np

from ..pytree.aliases import Numbers, Tree
from ..pytree.ranges import brief, require
from .references import POSITIVE
from .segments import FARTHEST, SHORTEST, Arc, Straight
from .tool_path import Dwell, Move

INCH = 25.4  # mm
# Both radii of an arc may differ by this much, or by this share: programs have rounded numbers.
RADII, RADII_SHARE = 5e-3, 1e-3
_WORD = re.compile(r"([A-Z])\s*([+-]?(?:\d+\.?\d*|\.\d+))\s*")
_COMMENT = re.compile(r"\([^()]*\)|;.*")
_MOTIONS = {0.0: "G0", 1.0: "G1", 2.0: "G2", 3.0: "G3"}
# The axes of each plane, in the order in which G3 turns the first one to the second one, and the
# words of the centre.
_PLANES = {17.0: ("XY", "IJ"), 18.0: ("ZX", "KI"), 19.0: ("YZ", "JK")}
_NO_EFFECT = {21.0, 40.0, 49.0, 54.0, 64.0, 80.0, 91.1, 94.0}
_CALLS = {97.0, 98.0, 99.0}  # M codes: of other programs, and the return from them
_SUPPORTED = "G0, G1, G2, G3, G4, G17, G18, G19, G20, G21, G90, G91"


def read_gcode(text: str, axes: Sequence[str], *, rapid: float | None = None) -> list[Move | Dwell]:
    """The moves and dwells of a program, from the origin.

    text:  the program
    axes:  names of the axes, of X, Y and Z, in either case, in the order of the outputs
    rapid: the feed of G0 [mm/s]; None for a program that has none

    Raises ValueError, with the number of the line, for what is not supported or not a program: an
    axis that is not there, a move without a feed, an arc whose radii differ or whose radius is too
    small, an unknown code.
    """
    letters = [name.upper() for name in axes]
    if not set(letters) <= set("XYZ"):
        raise ValueError(
            f"the axes are called {', '.join(axes)}; a program has words for x, y and z only"
        )
    reader = _Reader(letters, rapid)
    for number, raw in enumerate(text.splitlines(), 1):
        try:
            if not reader.read(raw, f"line {number}"):
                break
        except ValueError as error:
            raise ValueError(f"line {number}: {error}") from None
    if not any(isinstance(step, Move) for step in reader.steps):
        raise ValueError("the program has no move; needed is G0, G1, G2 or G3 at least")
    return reader.steps


@dataclasses.dataclass
class _Reader:
    """The state of a program: what the lines before have set."""

    letters: list[str]
    rapid: float | None
    motion: float | None = None
    plane: float = 17.0
    unit: float = 1.0
    relative: bool = False
    feed: float | None = None

    def __post_init__(self) -> None:
        self.position = np.zeros(len(self.letters))
        self.steps: list[Move | Dwell] = []

    def read(self, raw: str, what: str) -> bool:
        """Read a line; return whether the program goes on after it."""
        block = _COMMENT.sub(" ", raw).strip().upper()
        if not block or block == "%":
            return not (block and self.steps)
        codes, words = _words(block)
        if ("G", 64.0) in codes:  # its tolerances
            words = {letter: value for letter, value in words.items() if letter not in "PQ"}
        dwell, ended = False, False
        if ("G", 80.0) in codes:  # ends the motion of the lines before
            self.motion = None
        for letter, value in codes:
            if letter == "M" and value in _CALLS:
                raise ValueError(f"M{value:g} belongs to a call of another program; allowed is one")
            elif letter == "M":
                ended |= value in (2.0, 30.0)
            elif value in _MOTIONS:
                self.motion = value
            elif value in _PLANES:
                self.plane = value
            elif value in (20.0, 21.0):
                self.unit = INCH if value == 20.0 else 1.0
            elif value in (90.0, 91.0):
                self.relative = value == 91.0
            elif value == 4.0:
                dwell = True
            elif value not in _NO_EFFECT:
                raise ValueError(f"G{value:g} is not supported; allowed are {_SUPPORTED}")
        if "F" in words:
            self.feed = words.pop("F") * self.unit / 60
            require("", "F", self.feed * 60, POSITIVE)
        if dwell:
            self._dwell(words)
        elif words:
            self._move(words, what)
        return not ended

    def _dwell(self, words: dict[str, float]) -> None:
        seconds = words.pop("P", None)
        if seconds is None or not 0 <= seconds < np.inf or words:
            raise ValueError("G4 needs its duration, P in seconds >= 0, and nothing else")
        self.steps.append(Dwell(seconds))

    def _move(self, words: dict[str, float], what: str) -> None:
        name = _MOTIONS.get(self.motion) if self.motion is not None else None
        if name is None:
            raise ValueError(f"{_said(words)} without G0, G1, G2 or G3")
        arc = name in ("G2", "G3")
        for letter in words:
            if letter not in ("XYZIJKR" if arc else "XYZ"):
                raise ValueError(f"{letter} is no word of {name}")
            if letter in "XYZ" and letter not in self.letters:
                raise ValueError(
                    f"{letter} is no axis here; the machine has {', '.join(self.letters)}"
                )
        # Plain numbers: a program has up to a million moves.
        before = self.position.tolist()
        there = [
            (self.relative * x + words[letter] * self.unit) if letter in words else x
            for letter, x in zip(self.letters, before, strict=True)
        ]
        arcs = [words[letter] * self.unit for letter in "IJKR" if letter in words] if arc else []
        if not max(map(abs, [*there, *arcs])) <= FARTHEST:
            raise ValueError(f"{_said(words)} leads beyond {FARTHEST:g} mm")
        feed = self.rapid if name == "G0" else self.feed
        if feed is None:
            missing = "the key `rapid`, its feed" if name == "G0" else "a feed, F in a minute"
            raise ValueError(f"{name} needs {missing}")
        start, end = self.position, np.array(there)
        if arc:
            segment: Arc | Straight = self._arc(name, words, start, end)
        elif max(abs(a - b) for a, b in zip(before, there, strict=True)) <= SHORTEST:
            return
        else:
            segment = Straight(start, end)
        self.steps.append(Move(segment, feed, what))
        self.position = end

    def _arc(self, name: str, words: dict[str, float], start: Tree, end: Numbers) -> Arc:
        axes, centres = _PLANES[self.plane]
        if not set(axes) <= set(self.letters):
            raise ValueError(
                f"{name} in G{self.plane:g} needs the axes {' and '.join(sorted(axes))}; the "
                f"machine has {', '.join(self.letters)}"
            )
        plane = (self.letters.index(axes[0]), self.letters.index(axes[1]))
        a, b = start[list(plane)], end[list(plane)]
        turn = 1.0 if name == "G3" else -1.0
        given = [letter for letter in "IJK" if letter in words]
        if "R" in words:
            if given:
                raise ValueError(f"{name} has R and {', '.join(given)}; allowed is one of both")
            centre = _centre_of(name, a, b, words["R"] * self.unit, turn)
        else:
            if not given or not set(given) <= set(centres):
                raise ValueError(
                    f"{name} in G{self.plane:g} needs {' and '.join(sorted(centres))}, or R; it "
                    f"has {', '.join(given) or 'none of them'}"
                )
            centre = a + self.unit * np.array([words.get(letter, 0.0) for letter in centres])
        _require_radii(name, a - centre, b - centre)
        sweep = float(np.diff([np.arctan2(*(p - centre)[::-1]) for p in (a, b)])[0])
        sweep = turn * ((turn * sweep) % (2 * np.pi))
        if np.array_equal(a, b) or abs(sweep) < 1e-9:
            sweep = turn * 2 * np.pi
        return Arc(start, end, centre, plane, sweep)


def _centre_of(name: str, a: Numbers, b: Numbers, radius: float, turn: float) -> np.ndarray:
    """The centre of an arc by its radius; a negative radius means more than half a circle."""
    chord = b - a
    length = float(np.linalg.norm(chord))
    if length == 0:
        raise ValueError(f"{name} with R ends where it starts; a full circle needs its centre")
    if length > 2 * abs(radius) + RADII:
        raise ValueError(
            f"{name}: R = {radius:g} mm is too small for ends that are {length:g} mm apart; "
            f"allowed is {length / 2:g} mm or more"
        )
    apart = np.sqrt(max(radius**2 - length**2 / 4, 0.0))
    left = np.array([-chord[1], chord[0]]) / length
    return (a + b) / 2 + turn * np.sign(radius) * apart * left


def _require_radii(name: str, first: Numbers, last: Numbers) -> None:
    radii = float(np.linalg.norm(first)), float(np.linalg.norm(last))
    if not min(radii) > 0 or abs(radii[0] - radii[1]) > max(RADII, RADII_SHARE * radii[0]):
        raise ValueError(
            f"{name}: the radius is {radii[0]:.6g} mm at its start and {radii[1]:.6g} mm at its "
            f"end; allowed is a difference of {RADII:g} mm or {RADII_SHARE:.1%}"
        )


def _words(block: str) -> tuple[list[tuple[str, float]], dict[str, float]]:
    """The G and M codes of a line, and its other words that have a meaning, by letter."""
    codes: list[tuple[str, float]] = []
    words: dict[str, float] = {}
    at = 0
    while at < len(block):
        found = _WORD.match(block, at)
        if found is None:
            raise ValueError(f"{brief(block[at:])} is no word, a letter and a number")
        at, letter, value = found.end(), found[1], float(found[2])
        if letter in "GM":
            codes.append((letter, value))
        elif letter in words:
            raise ValueError(f"{letter} is given twice")
        elif letter in "XYZIJKRPQF":
            words[letter] = value
        elif letter not in "NOST":
            raise ValueError(f"{letter} is not supported; allowed are X, Y, Z, I, J, K, R, P, F")
    motions = [f"G{v:g}" for c, v in codes if c == "G" and (v in _MOTIONS or v == 4.0)]
    if len(motions) > 1:
        raise ValueError(f"{' and '.join(motions)} in one line; allowed is one")
    return codes, words


def _said(words: dict[str, float]) -> str:
    return " ".join(f"{letter}{value:g}" for letter, value in words.items())
