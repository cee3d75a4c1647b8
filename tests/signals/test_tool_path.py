"""References of tool paths and G-code programs, against geometry and averages of polygons."""

from __future__ import annotations

import itertools
import time

import numpy as np
import pytest
from dense import derivatives
from numpy.testing import assert_allclose

from jaxilc.signals.gcode import read_gcode
from jaxilc.signals.references import s_curve
from jaxilc.signals.segments import Arc, Chain, Straight
from jaxilc.signals.tool_path import Dwell, Move, follow

LIMITS = {"acceleration": 500.0, "jerk": 2e4, "dt": 2e-3}
SLACK = 1e-6
# 10 mm to the right, a quarter circle up, a sharp corner to the left, an arc by R back to the start
PROGRAM = """%
O1 (a part)
N10 G21 G17 G90 ; millimetres
N20 G1 X10 Y0 F1200 M3 S8000
N30 G3 X15 Y5 I0 J5
G91 X-5 Y0 R2.5
G90 G1 X0 Y5
G3 X0 Y0 R-2.5
M30
G77 (never read)
"""


def arc(centre, radius, first, last):
    """Return points on an arc from one angle to another, in degrees."""
    angle = np.radians(np.linspace(first, last, 4001))
    return np.asarray(centre) + radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def straight(a, b):
    return np.linspace(a, b, 4001)


DENSE = [
    straight((0, 0), (10, 0)),
    arc((10, 5), 5, -90, 0),
    arc((12.5, 5), 2.5, 0, 180),
    straight((10, 5), (0, 5)),
    arc((0, 2.5), 2.5, 90, 270),
]


def farthest(points, path):
    """Return the largest distance of the points from dense points of a path, by a full search."""
    return max(np.min(np.linalg.norm(path - p, axis=1)) for p in points)


def used(reference):
    """Return the largest speed of a reference, and the shares of the limits that it uses."""
    v, a, j = (np.linalg.norm(x, axis=1).max() for x in derivatives(reference, LIMITS["dt"]))
    return v, a / LIMITS["acceleration"], j / LIMITS["jerk"]


@pytest.mark.thorough
def test_a_program_is_the_path_that_geometry_says_and_keeps_its_limits():
    steps = read_gcode(PROGRAM, ("x", "y"))
    lengths = [10, 2.5 * np.pi, 2.5 * np.pi, 10, 2.5 * np.pi]
    for step, length, dense in zip(steps, lengths, DENSE, strict=True):
        alone = Chain([step.segment], 0.05)
        assert_allclose(alone.length, length, rtol=1e-12)
        assert_allclose(alone(np.linspace(0, length, 4001)), dense, atol=1e-12)
    path = np.concatenate(DENSE)
    # the second arc goes on from the first one in its direction, so only one corner is left
    for corner, stops, rounded in ((None, 1, 0), (0.05, 0, 1)):
        made = follow(steps, corner=corner, **LIMITS)
        assert (made.stops, made.rounded) == (stops, rounded)
        assert farthest(made.reference[::5], path) < (0.05 if corner else 0) + 2e-3
        assert farthest(path[::50], made.reference) < (0.05 if corner else 0) + 0.021  # 0.04 apart
        assert max(*used(made.reference)[1:], used(made.reference)[0] / 20) < 1 + SLACK
        assert_allclose(made.reference[[0, -1]], 0.0, atol=1e-9)


ROUND = np.linspace(0, 2 * np.pi, 61)
POLYGONS = {
    "corners far apart": ([[0, 0], [4, 0], [4, 3], [3, 3], [3, 1.0], [0, 1]], 0.049),
    "corners within reach": (10 * np.stack([np.cos(ROUND), np.sin(ROUND)], axis=1), 0.037),
}


@pytest.mark.parametrize("polygon", POLYGONS)
def test_a_rounded_polygon_is_its_average_and_uses_its_tolerance(polygon):
    corners, used = POLYGONS[polygon]
    segments = [Straight(a, b) for a, b in itertools.pairwise(np.array(corners))]
    chain = Chain(segments, 0.05)
    s = np.linspace(0, chain.length, 4001)
    off = np.linalg.norm(chain(s) - chain.exact(s), axis=1)
    assert used < np.max(off) <= 0.05
    a = chain.reach
    nodes, weights = np.polynomial.legendre.leggauss(400)
    inner = s[(s > a) & (s < chain.length - a)][::200]
    kernel = weights * 15 / 16 * (1 - nodes**2) ** 2
    averaged = [kernel @ chain.exact(at + a * nodes) for at in inner]
    assert_allclose(chain(inner), averaged, atol=1e-5)
    assert_allclose(chain(np.array([0.0, chain.length])), np.array(corners)[[0, -1]], atol=1e-12)


TURN = 100 + 100 * np.exp(1j * np.radians(149.0))
NEARLY_REVERSED = {
    "a corner of 149 degrees": ([(100, 0), (TURN.real, TURN.imag)], 1),
    "a narrow slot": ([(20, 0), (20, 0.005), (0, 0.005)], 2),
}


@pytest.mark.thorough
@pytest.mark.parametrize("name", NEARLY_REVERSED)
def test_a_rounding_that_nearly_reverses_is_followed_within_its_tolerance(name):
    corners, rounded = NEARLY_REVERSED[name]
    places = [np.zeros(2), *map(np.array, corners)]
    moves = [Move(Straight(a, b), 100.0) for a, b in itertools.pairwise(places)]
    made = follow(moves, corner=0.02, **LIMITS)
    assert (made.stops, made.rounded) == (0, rounded)
    assert max(used(made.reference)[1:]) < 1 + SLACK
    near = made.reference[np.linalg.norm(made.reference - corners[0], axis=1) < 1.0]
    dense = np.concatenate([straight(a, b) for a, b in itertools.pairwise(places)])
    dense = dense[np.linalg.norm(dense - corners[0], axis=1) < 1.1]
    assert farthest(near, dense) < np.hypot(0.02, 0.0125)  # dense points are 0.025 apart


def test_a_radius_too_small_for_the_length_of_its_path_is_refused_with_what_helps():
    moves = read_gcode("G1 X200 F1800\nG3 Y0.002 R0.001\nG1 X0", "xy")
    with pytest.raises(ValueError, match=r"details of 0\.001 mm, .* stop at that place \(G4 P0 in"):
        follow(moves, corner=0.02, **LIMITS)


def test_stops_dwells_and_reversals():
    there = np.array([5.0, 0])
    go, turn_back = Straight(np.zeros(2), there), Straight(there, np.zeros(2))
    made = follow([Move(go, 20.0), Dwell(0.1), Move(turn_back, 20.0)], corner=0.05, **LIMITS)
    at_end = np.flatnonzero(np.all(made.reference == [5.0, 0.0], axis=1))
    assert (made.stops, len(at_end)) == (1, 51)  # 0.1 s after the sample of arrival
    made = follow([Move(go, 20.0), Move(turn_back, 20.0)], corner=0.05, **LIMITS)
    assert (made.stops, made.rounded) == (1, 0)  # a reversal cannot be rounded
    other = Straight(there, np.array([9.0, 0]))
    assert follow([Move(go, 20.0), Move(other, 10.0)], corner=None, **LIMITS).stops == 1
    assert follow([Move(go, 20.0), Move(other, 20.0)], corner=None, **LIMITS).stops == 0


def test_limits_of_each_axis_hold_on_a_straight_line():
    steep = Straight(np.zeros(2), np.array([8.0, 6.0]))
    limits = LIMITS | {"acceleration": (500.0, 60.0), "jerk": (2e4, 2e3)}
    made = follow([Move(steep, 20.0)], corner=None, **limits).reference
    _, a, j = (np.abs(x).max(axis=0) for x in derivatives(made, limits["dt"]))
    assert np.all(a <= np.array([500, 60]) * (1 + SLACK))
    assert a[1] > 0.95 * 60
    assert np.all(j <= np.array([2e4, 2e3]) * (1 + SLACK))


def test_planes_units_and_a_helix():
    program = "G20 G1 X1 F60\nG21\nG17 G3 X25.4 Y0 Z4 I-5.4 J0\nG18 G3 X25.4 Z8 I0 K2\nG19 G2 Y4 R2"
    moves = read_gcode(program, ("x", "y", "z"))
    assert_allclose([moves[0].feed, moves[0].segment.end[0]], 25.4)
    s = np.linspace(0, 1, 3601)
    helix = np.concatenate([arc((20, 0), 5.4, 0, 360)[::1], np.linspace(0, 4, 4001)[:, None]], 1)
    turned = moves[1].segment
    assert_allclose(turned.at(np.linspace(0, turned.length, 4001)), helix, atol=1e-9)
    # anticlockwise seen from +y: from z to x
    x, y, z = moves[2].segment.at(s * moves[2].segment.length).T
    assert_allclose(
        [x, z], [25.4 + 2 * np.sin(np.pi * (s + 1)), 6 + 2 * np.cos(np.pi * (s + 1))], atol=1e-9
    )
    # clockwise seen from +x: from y = 0 over the larger z
    x, y, z = moves[3].segment.at(s * moves[3].segment.length).T
    assert_allclose([y, z], [2 - 2 * np.cos(np.pi * s), 8 + 2 * np.sin(np.pi * s)], atol=1e-9)


@pytest.mark.parametrize("preamble", ["G21 G90 G64 P0.01 Q0.02 G1", "G1 G64 P0.01\nG64 Q1"])
def test_the_tolerances_of_g64_have_no_effect(preamble):
    (move,) = read_gcode(f"{preamble}\nX3 F60", "xy")
    assert_allclose(move.segment.end, [3, 0])


def test_nothing_is_read_after_the_end_of_the_tape():
    (move,) = read_gcode("%\nG1 X3 F60\n\n%\nX5\nof another tape", "xy")
    assert_allclose(move.segment.end, [3, 0])


def test_a_full_circle_is_one_turn_from_where_it_begins_to_there():
    """No warning comes of its chord of length zero."""
    made = follow(read_gcode("G1 X1 F1200\nG2 I-5", "xy"), corner=None, **LIMITS)
    assert_allclose(made.length, 1 + 10 * np.pi)
    y = made.reference[:, 1]
    assert y[np.argmax(np.abs(y) > 1)] < 0  # clockwise
    dense = np.concatenate([straight((0, 0), (1, 0)), arc((-4, 0), 5, 0, -360)])
    assert farthest(made.reference, dense) < 0.005


REFUSED = {
    "line 2: G1 needs a feed": "G21\nG1 X3",
    "line 1: G0 needs the key `rapid`": "G0 X3",
    r"line 1: F = 0 is outside its allowed range \(0, inf\)": "G1 X3 F0",
    "line 2: G2: the radius is 4 mm at its start and 6 mm at its end": "G1 X10 F9\nG2 X20 I4 J0",
    "line 1: G3: R = 1 mm is too small for ends that are 10 mm apart": "G3 X10 R1 F9",
    "line 1: G2 with R ends where it starts": "G2 R4 F9",
    "line 1: G3 has R and I": "G3 X4 R4 I2 F9",
    "line 1: G2 in G17 needs I and J, or R": "G2 X4 F9",
    "line 1: G2 in G18 needs the axes X and Z": "G18 G2 X4 I2 F9",
    "line 3: G5 is not supported; allowed are G0, G1": "G1 X4 F9\n\nG5 X8",
    "line 1: Z is no axis here; the machine has X, Y": "G1 X4 Z2 F9",
    "line 1: A is not supported": "G1 X4 A2 F9",
    "line 1: X is given twice": "G1 X4 X5 F9",
    "line 1: I is no word of G1": "G1 X4 I5 F9",
    "line 2: P is no word of G1": "G64 P1\nG1 X4 P5 F9",
    "line 1: Q is no word of G1": "G1 X4 Q5 F9",
    "line 1: X4 without G0": "X4",
    "line 3: X8 without G0": "G80 G1 X4 F9\nG80 (which ends a motion)\nX8",
    "line 1: G0 and G1 in one line": "G0 G1 X4 F9",
    "line 2: M98 belongs to a call of another program": "G1 X4 F9\nM98 P100",
    "line 1: 'HELLO' is no word": "G1 X4 F9 hello",
    "line 2: G4 needs its duration": "G1 X4 F9\nG4",
    "line 2: G4 needs its duration, P in seconds >= 0": "G1 X4 F9\nG4 P" + 400 * "9",
    "line 1: X1e.10 leads beyond": "G1 X10000000000 F9",
    "line 2: X5 Rinf leads beyond": "G1 X4 F9\nG2 X5 R" + 400 * "9",
    "line 2: X5 I1e.10 leads beyond": "G1 X4 F9\nG3 X5 I10000000000",
    "the program has no move": "(nothing)",
}


@pytest.mark.parametrize("said", REFUSED)
def test_what_is_no_program_is_refused_with_its_line(said):
    with pytest.raises(ValueError, match=said):
        read_gcode(REFUSED[said], ("x", "y"))


@pytest.mark.parametrize("seconds", [-1.0, np.inf, np.nan])
def test_a_rest_of_no_duration_is_refused(seconds):
    steps = [Move(Straight(np.zeros(2), np.ones(2)), 20.0), Dwell(seconds)]
    with pytest.raises(ValueError, match=f"Dwell: seconds = {seconds:g} s"):
        follow(steps, corner=None, **LIMITS)


@pytest.mark.thorough
def test_many_straight_moves_are_those_planned_one_by_one():
    """They are planned at once: 20,000 moves took a minute, one by one."""
    rng = np.random.default_rng(7)
    places = np.cumsum(rng.uniform(-3, 3, (20_001, 2)), axis=0)
    limits = LIMITS | {"dt": 5e-3}
    lines = [f"G1 X{x:.6f} Y{y:.6f} F{f:.3f}" for (x, y), f in zip(
        places, rng.uniform(600, 6000, len(places)), strict=True)]  # fmt: skip
    begun = time.process_time()
    steps = read_gcode("\n".join(lines), ("x", "y"))
    made = follow(steps, corner=None, **limits)
    assert time.process_time() - begun < 20  # 1 s on a quiet processor
    assert made.stops == len(steps) - 1
    at = 0
    for move in steps[:200]:
        chord = move.segment.end - move.segment.start
        along = s_curve([0.0, np.linalg.norm(chord)], velocity=move.feed, **limits)
        expected = move.segment.start + np.outer(along / along[-1], chord)
        assert_allclose(made.reference[at : at + len(along)], expected, atol=1e-9)
        at += len(along) - 1


def test_a_path_that_would_take_too_long_is_refused_before_it_is_planned(monkeypatch):
    def never(*args, **options):
        raise AssertionError("planned")

    monkeypatch.setattr("jaxilc.signals.tool_path.plan", never)
    zigzag = "\n".join(f"G1 X{k % 2} Y{k} F{600 + k % 2}" for k in range(1200))
    rounded = zigzag.replace("F601", "F600")  # passed without a stop
    with pytest.raises(ValueError, match="samples of dt = 1e-06 s; allowed are up to 1000000"):
        follow(read_gcode(zigzag, "xy"), corner=None, **LIMITS | {"dt": 1e-6})
    pairs = "\n".join(f"G1 X{k % 2} Y{k} F{600 + k // 2 % 2}" for k in range(1200))
    with pytest.raises(ValueError, match=r"has 599 parts of .* allowed are 300 parts of 50000"):
        follow(read_gcode(pairs, "xy"), corner=0.01, **LIMITS)
    with pytest.raises(AssertionError, match="planned"):
        follow(read_gcode(rounded, "xy"), corner=0.01, **LIMITS)


def test_slopes_of_a_helix_are_its_derivative():
    """Also along the axis that is not in its plane, and where the radius is another in the end."""
    arc = Arc(np.array([3.0, 0.0, 0.5]), np.array([0.0, 2.0, 4.0]), np.zeros(2), (0, 1), np.pi / 2)
    y = arc.at(np.array([0.0, 1e-6, arc.length - 1e-6, arc.length]))
    np.testing.assert_allclose(arc.slopes, (y[[1, 3]] - y[[0, 2]]) / 1e-6, atol=1e-5)
