"""A tool path of segments as a reference: corners, feed, and rests, planned within limits.

Each corner is either a stop, or rounded within a tolerance. Between two stops, the path is planned
by `paths.plan`, or in closed form (`s_curves`) where it is one straight segment.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from ..pytree.aliases import Value
from ..pytree.ranges import require
from .paths import LONGEST, plan
from .s_curves import s_curve, s_curve_move
from .sample_times import POSITIVE
from .segments import Chain, Segment, Straight, turn

SMOOTH = np.radians(1.0)  # a joint that turns by less is no corner, and is never a stop
REVERSAL = np.radians(150.0)  # a corner that turns by more is always a stop
JOINT = 1e-3  # the tolerance within which a joint that is no corner is smoothed [mm]
_POINTS = 12.0  # points of the table of a curve within half the width of a rounding


@dataclasses.dataclass(frozen=True)
class Move:
    """A segment that is passed at a feed.

    feed: largest path speed [mm/s]
    what: name of the move in messages, such as `line 3`
    """

    segment: Segment
    feed: float
    what: str = ""


@dataclasses.dataclass(frozen=True)
class Dwell:
    """A rest at the place that was reached.

    seconds: its duration [s], made up to whole samples
    """

    seconds: float


class Followed(NamedTuple):
    """A path in time.

    reference: (N+1, d) positions [mm]
    stops:     number of stops between both ends
    rounded:   number of corners that are rounded
    length:    of the path without rounding [mm]
    """

    reference: np.ndarray
    stops: int
    rounded: int
    length: float


def follow(
    steps: Sequence[Move | Dwell],
    *,
    corner: float | None,
    acceleration: Value,
    jerk: Value,
    dt: float,
) -> Followed:
    """The reference along moves and dwells, from rest to rest.

    A joint of two moves is passed without a stop where both have one feed and it turns by less than
    1 deg, or is a corner of up to 150 deg and `corner` is a tolerance. A joint of less than 1 deg
    is smoothed within `corner`, or within 0.001 mm where corners are stops.

    corner:       None to stop at each corner; otherwise the tolerance of rounding [mm]: the path
                  that is followed and the path as given are within it of each other
    acceleration: () largest length of the acceleration vector, or (d,) of each axis [mm/s^2]
    jerk:         () or (d,) likewise [mm/s^3]
    dt:           sample time [s]

    Raises ValueError for a value outside its range, a path without a move, and for more than a
    million samples.
    """
    moves = [step for step in steps if isinstance(step, Move)]
    if not moves:
        raise ValueError("the path has no move")
    if corner is not None:
        require("", "corner", corner, POSITIVE, ' mm, or "stop"')
    for move in moves:
        require("", f"{move.what}: feed" if move.what else "feed", move.feed, POSITIVE, " mm/s")
    limits: dict[str, Value] = {"acceleration": acceleration, "jerk": jerk, "dt": dt}
    parts, stops, rounded, samples = [moves[0].segment.start[None]], -1, 0, 0
    for piece in _pieces(steps, corner):
        if isinstance(piece, Dwell):
            hold = int(np.ceil(piece.seconds / dt - 1e-9))
            _require_room(samples + hold, dt)
            parts.append(np.repeat(parts[-1][-1:], hold, axis=0))
        else:
            stops += 1
            segments = [move.segment for move in piece]
            rounded += sum(int(turn(a, b) >= SMOOTH) for a, b in itertools.pairwise(segments))
            parts.append(_planned(piece, JOINT if corner is None else corner, limits)[1:])
        samples += len(parts[-1])
        _require_room(samples, dt)
    length = sum(move.segment.length for move in moves)
    return Followed(np.concatenate(parts), stops, rounded, float(length))


def _require_room(samples: int, dt: float) -> None:
    if samples > LONGEST:
        raise ValueError(
            f"the path needs more than {LONGEST} samples of dt = {dt:g} s; allowed are up to "
            f"{LONGEST}"
        )


def _pieces(steps: Sequence[Move | Dwell], corner: float | None) -> Iterator[Dwell | list[Move]]:
    """Lists of moves that are passed without a stop, and the dwells between them."""
    piece: list[Move] = []
    for step in steps:
        if piece and not (isinstance(step, Move) and _goes_on(piece[-1], step, corner)):
            yield piece
            piece = []
        if isinstance(step, Dwell):
            yield step
        else:
            piece.append(step)
    if piece:
        yield piece


def _goes_on(before: Move, after: Move, corner: float | None) -> bool:
    angle = turn(before.segment, after.segment)
    return before.feed == after.feed and angle <= (SMOOTH if corner is None else REVERSAL)


def _planned(piece: list[Move], tolerance: float, limits: Mapping[str, Value]) -> np.ndarray:
    """(N+1, d) the reference along moves without a stop between them."""
    segments, feed = [move.segment for move in piece], piece[0].feed
    try:
        if len(segments) == 1 and isinstance(segments[0], Straight):
            return _straight(segments[0], feed, **limits)
        chain = Chain(segments, tolerance)
        points = int(max(20001, np.ceil(_POINTS * chain.length / chain.finest)))
        if points > LONGEST:
            raise ValueError(
                f"a path of {chain.length:g} mm without a stop has details of {chain.finest:g} mm, "
                "its smallest radius or rounding; raise `corner`, or divide the path"
            )
        return plan(chain, (0.0, chain.length), feed=feed, points=points, **limits).reference
    except ValueError as error:
        said = str(error).removeprefix("plan: ")
        raise ValueError(f"{piece[0].what}: {said}" if piece[0].what else said) from None


def _straight(
    segment: Straight, feed: float, *, acceleration: Value, jerk: Value, dt: float
) -> np.ndarray:
    """(N+1, d) the time-optimal reference along one straight segment."""
    d = len(segment.start)
    for name, value in (("acceleration", acceleration), ("jerk", jerk)):
        if np.shape(value) not in ((), (d,)):
            raise ValueError(f"{name} has shape {np.shape(value)}; allowed are () and ({d},)")
        require("", name, value, POSITIVE, many=True)
    acceleration, jerk = np.asarray(acceleration, float), np.asarray(jerk, float)
    share = np.abs(segment.slopes[0])
    moving = share > 0

    def along(limit: Value) -> float:
        """The limit of the length covered: of the vector, or of the axis that allows the least."""
        return float(np.min(limit[moving] / share[moving]) if np.ndim(limit) else limit)

    length = segment.length
    of_length = {"acceleration": along(acceleration), "jerk": along(jerk)}
    needed = s_curve_move(length, velocity=feed, **of_length).duration
    if not needed / dt <= LONGEST:
        raise ValueError(
            f"feed = {feed:g} mm/s, acceleration = {of_length['acceleration']:g} mm/s^2, jerk = "
            f"{of_length['jerk']:g} mm/s^3 need {needed:.3g} s for {length:g} mm; allowed are up "
            f"to {LONGEST} samples of dt = {dt:g} s"
        )
    s = s_curve([0.0, length], velocity=feed, **of_length, dt=dt)
    reference = segment.at(s)
    reference[-1] = segment.end
    return reference
