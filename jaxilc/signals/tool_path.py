"""A tool path of segments as a reference: corners, feed, and rests, planned within limits.

Each corner is either a stop, or rounded within a tolerance. Between two stops, the path is planned
by `paths.plan`, or in closed form (`s_curve_moves`) where it is one straight segment.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from ..pytree.aliases import Value
from ..pytree.ranges import require
from .paths import LONGEST, plan
from .references import NONNEGATIVE, POSITIVE, SCurveMove, s_curve_moves
from .segments import Chain, Segment, Straight, lengths_and_slopes, turns

SMOOTH = np.radians(1.0)  # a joint that turns by less is no corner, and is never a stop
REVERSAL = np.radians(150.0)  # a corner that turns by more is always a stop
JOINT = 1e-3  # the tolerance within which a joint that is no corner is smoothed [mm]
# Each part without a stop takes about 0.2 s to plan, and 1 ms for each of its moves.
MOST_PIECES, MOST_MOVES = 300, 50_000
_POINTS = 12.0  # points of the table of a curve within half the width of a rounding, at least


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
    require("", "corner", corner, POSITIVE, ' mm, or "stop"', optional=True)
    for move in moves:
        if not 0 < move.feed < np.inf:
            where = f"{move.what}: feed" if move.what else "feed"
            require("", where, move.feed, POSITIVE, " mm/s")
    for step in steps:
        if isinstance(step, Dwell) and not 0 <= step.seconds < np.inf:
            require("", "Dwell: seconds", step.seconds, NONNEGATIVE, " s")
    limits: dict[str, Value] = {"acceleration": acceleration, "jerk": jerk, "dt": dt}
    lengths, slopes = lengths_and_slopes([move.segment for move in moves])
    angles = turns(slopes)
    pieces = list(_pieces(steps, moves, angles, corner))
    alone = [piece for piece in pieces if isinstance(piece, int)]
    runs = _straights([moves[i] for i in alone], lengths[alone], slopes[alone, 0], limits)
    rests = [int(np.ceil(of.seconds / dt - 1e-9)) for of in pieces if isinstance(of, Dwell)]
    _require_room(sum(map(len, runs)) + sum(rests), dt)
    many = [piece for piece in pieces if isinstance(piece, range)]
    if len(many) > MOST_PIECES or any(len(piece) > MOST_MOVES for piece in many):
        raise ValueError(
            f"the path has {len(many)} parts of rounded corners or arcs without a stop, of up to "
            f"{max(map(len, many))} moves; allowed are {MOST_PIECES} parts of {MOST_MOVES} moves: "
            'divide the program, or stop at its corners (corner = "stop")'
        )
    parts, samples = [moves[0].segment.start[None]], 0
    straights, rest = iter(runs), iter(rests)
    for piece in pieces:
        if isinstance(piece, Dwell):
            parts.append(np.repeat(parts[-1][-1:], next(rest), axis=0))
        elif isinstance(piece, int):
            parts.append(next(straights))
        else:
            of = moves[piece.start : piece.stop]
            parts.append(_planned(of, JOINT if corner is None else corner, limits)[1:])
        samples += len(parts[-1])
        _require_room(samples, dt)
    passed = [i for piece in many for i in piece[:-1]]
    rounded = int(np.sum(angles[passed] >= SMOOTH))
    stops = len(alone) + len(many) - 1
    return Followed(np.concatenate(parts), stops, rounded, float(np.sum(lengths)))


def _require_room(samples: int, dt: float) -> None:
    if samples > LONGEST:
        raise ValueError(
            f"the path needs more than {LONGEST} samples of dt = {dt:g} s; allowed are up to "
            f"{LONGEST}"
        )


def _pieces(
    steps: Sequence[Move | Dwell], moves: Sequence[Move], angles: np.ndarray, corner: float | None
) -> Iterator[Dwell | int | range]:
    """The moves that are passed without a stop, and the dwells between them.

    A straight move by itself, whose plan has a closed form, is its number, and others are a range.

    angles: by which the path turns after each move but the last [rad]
    """

    def passed() -> int | range:
        alone = at == first + 1 and isinstance(moves[first].segment, Straight)
        return first if alone else range(first, at)

    first = at = 0  # of the piece, and the move
    largest, before = SMOOTH if corner is None else REVERSAL, None
    for step in steps:
        if first < at and not (
            isinstance(step, Move)
            and isinstance(before, Move)
            and before.feed == step.feed
            and angles[at - 1] <= largest
        ):
            yield passed()
            first = at
        if isinstance(step, Dwell):
            yield step
        else:
            at += 1
        before = step
    if first < at:
        yield passed()


def _planned(piece: list[Move], tolerance: float, limits: Mapping[str, Value]) -> np.ndarray:
    """(N+1, d) the reference along moves without a stop between them."""
    segments, feed = [move.segment for move in piece], piece[0].feed
    try:
        chain = Chain(segments, tolerance)
        points, interval = _points(chain), (0.0, chain.length)
        return plan(chain, interval, feed=feed, points=points, **limits).reference
    except ValueError as error:
        said = str(error).removeprefix("plan: ")
        raise ValueError(f"{piece[0].what}: {said}" if piece[0].what else said) from None


def _points(chain: Chain) -> int:
    """The number of points of a table of the chain.

    Where a rounded corner nearly reverses, the position moves less than the parameter, and turns as
    much faster.

    Raises ValueError for more points than a table may have.
    """
    finest, points, needed = chain.finest, 0, 20001.0
    while needed > 1.2 * points:
        points = int(max(20001, np.ceil(_POINTS * chain.length / finest)))
        if points > LONGEST:
            raise ValueError(
                f"a path of {chain.length:g} mm without a stop has details of {finest:.3g} mm, its "
                "smallest radius or rounding; stop at that place (G4 P0 in a program, or corner = "
                '"stop"), or divide the path'
            )
        s = np.linspace(0.0, chain.length, points)
        slowest = np.min(np.linalg.norm(np.diff(chain(s), axis=0), axis=1)) / s[1]
        finest = chain.finest * np.clip(2 * slowest, 1e-9, 1.0)
        needed = _POINTS * chain.length / finest
    return points


def _straights(
    moves: Sequence[Move], lengths: np.ndarray, slopes: np.ndarray, limits: Mapping[str, Value]
) -> list[np.ndarray]:
    """For each straight move, its time-optimal reference after its start, from rest to rest.

    lengths: (M,) [mm];  slopes: (M, d)
    """
    if not moves:
        return []
    d, dt, of_length = slopes.shape[1], limits["dt"], {}
    share = np.abs(slopes)
    for name in ("acceleration", "jerk"):
        limit = np.asarray(limits[name], float)
        if limit.shape not in ((), (d,)):
            raise ValueError(f"{name} has shape {limit.shape}; allowed are () and ({d},)")
        require("", name, limit, POSITIVE, many=True)
        # Of the vector, or of the axis that allows the least.
        along = np.divide(limit, share, out=np.full(share.shape, np.inf), where=share > 0)
        of_length[name] = np.min(along, axis=1) if limit.ndim else np.full(len(moves), float(limit))
    feeds = np.array([move.feed for move in moves])
    run = s_curve_moves(lengths, feeds, of_length["acceleration"], of_length["jerk"])
    long = np.flatnonzero(~(run.duration / dt <= LONGEST))
    if len(long):
        i = long[0]
        raise ValueError(
            f"{moves[i].what}: ".removeprefix(": ")
            + f"feed = {feeds[i]:g} mm/s, acceleration = {of_length['acceleration'][i]:g} mm/s^2, "
            f"jerk = {of_length['jerk'][i]:g} mm/s^3 need {run.duration[i]:.3g} s for "
            f"{lengths[i]:g} mm; allowed are up to {LONGEST} samples of dt = {dt:g} s"
        )
    counts = np.maximum(np.ceil(run.duration / dt - 1e-9), 1).astype(int)
    _require_room(int(np.sum(counts)), dt)
    ends = np.cumsum(counts)
    k = np.arange(ends[-1]) - np.repeat(ends - counts, counts) + 1
    each = SCurveMove(
        np.repeat(run.distance, counts), np.repeat(run.jerk, counts),
        tuple(np.repeat(duration, counts) for duration in run.durations),
    )  # fmt: skip
    starts = np.array([move.segment.start for move in moves])
    s = each.at(k * dt)[0]
    s[ends - 1] = lengths
    reference = np.repeat(starts, counts, axis=0) + s[:, None] * np.repeat(slopes, counts, axis=0)
    reference[ends - 1] = [move.segment.end for move in moves]
    return np.split(reference, ends[:-1])
