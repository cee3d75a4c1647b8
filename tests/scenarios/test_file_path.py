"""Paths of several axes in plant files, against geometry, and `run` and `sweep` along them."""

from __future__ import annotations

import io
import json

import numpy as np
import pytest
from numpy.testing import assert_allclose

from jaxilc import figures
from jaxilc.outcomes.outcome import Console
from jaxilc.outcomes.running import axes_table, run_numbers
from jaxilc.outcomes.sweeping import axes_numbers, sweep_numbers, swept_axes_table
from jaxilc.scenarios.from_file import read_scenario
from jaxilc.scenarios.scenario import judged
from jaxilc.signals import contour_error
from jaxilc.sweeps import Sweep
from jaxilc.sweeps.runs import run_schemes
from jaxilc.sweeps.summary import summarise

AXIS = {"kind": "state_space", "A": [[0.6]], "B": [[0.4]], "C": [[1.0]], "dt": 0.004}
OTHER = {"kind": "transfer_function", "num": [0.3], "den": [1.0, -0.7], "dt": 0.004}
LIMITS = {"feed": 20.0, "acceleration": 800.0, "jerk": 5e4}
POINTS = "x [mm];y [mm]\n1;1\n3;1\n3;2\n3;2\n1;1\n"
PROGRAM = "G1 X2 Y0 F1200\nG3 X2 Y2 I0 J1\nG1 X0\nG1 Y0\n"
ROOT = np.sqrt(0.5)
KINDS = {
    "circle": {"path": "circle", "radius": 1.0} | LIMITS,
    # a quarter of a circle of 2 mm about (-2, 0), as a rational Bezier curve
    "nurbs": {
        "path": "nurbs",
        "points": [[0, 0], [0, 2], [-2, 2]],
        "weights": [1, ROOT, 1],
        "knots": [0, 0, 0, 1, 1, 1],
        "degree": 2,
    }
    | LIMITS,
    "butterfly": {"path": "butterfly", "width": 4.0} | LIMITS,
    "lines": {"path": "points", "file": "p.csv", "corner": 0.02} | LIMITS,
    "spline": {"path": "points", "file": "p.csv", "join": "spline"} | LIMITS,
    "gcode": {"path": "gcode", "file": "p.ngc", "acceleration": 800.0, "jerk": 5e4},
}


def write(folder, reference, **tables):
    """Write a plant file of two axes with this reference."""
    (folder / "p.csv").write_text(POINTS)
    (folder / "inch.csv").write_text(POINTS.replace("y [mm]", "y [in]"))
    (folder / "p.ngc").write_text(PROGRAM)
    task = {"dt": 0.004, "unit": "mm", "reference": reference} | tables.pop("task", {})
    file = {
        "trials": 2,
        "plant": {"kind": "TwoAxes", "x": AXIS, "y": OTHER},
        "task": task,
        "schemes": {"ilc": {"class": "PIDType", "gamma_p": 0.5}},
        "uncertainty": {
            "plant.y.B": {"distribution": "uniform", "low": 0.9, "high": 1.1, "relative": True}
        },
    }
    path = folder / "table.json"
    path.write_text(json.dumps(file | tables))
    return path


def from_lines(points, corners):
    """Return the distance of each point from a polygon."""
    a, b = np.array(corners[:-1])[:, None], np.array(corners[1:])[:, None]
    share = np.sum((points - a) * (b - a), axis=-1) / np.sum((b - a) ** 2, axis=-1)
    apart = points - a - np.clip(share, 0, 1)[..., None] * (b - a)
    return np.min(np.linalg.norm(apart, axis=-1), axis=0)


@pytest.mark.parametrize("kind", KINDS)
def test_a_path_is_a_reference_from_its_start(kind, tmp_path):
    made = read_scenario(write(tmp_path, KINDS[kind]))
    r = np.asarray(made.task.reference)
    assert made.task.names == ("x", "y")
    assert made.judged_by == "contour_max"
    assert_allclose(r[0], 0.0, atol=1e-12)
    speed = np.linalg.norm(np.diff(r, axis=0), axis=1) / 0.004
    assert 15 < np.max(speed) <= 20 * (1 + 1e-6) or kind == "butterfly"
    (note,) = made.chosen
    triangle = [(0, 0), (2, 0), (2, 1), (0, 0)]
    if kind == "circle":
        assert_allclose(np.linalg.norm(np.add(r, [1, 0]), axis=1), 1.0, rtol=1e-9)
    elif kind == "nurbs":
        assert_allclose(np.linalg.norm(np.add(r, [2, 0]), axis=1), 2.0, rtol=1e-9)
    elif kind == "lines":
        assert np.max(from_lines(r, triangle)) <= 0.02
        assert "2 corners rounded within 0.02 mm" in note or "1 corner rounded" in note
    elif kind == "spline":
        assert np.min(np.linalg.norm(r - [2, 1], axis=1)) < 0.05  # within a sample of the point
    elif kind == "gcode":
        straight = from_lines(r, [(2, 2), (0, 2), (0, 0), (2, 0)])
        on_arc = np.abs(np.linalg.norm(r - [2, 1], axis=1) - 1.0)
        assert np.max(np.where(r[:, 0] > 2, on_arc, straight)) < 1e-9
        assert "1 stop on the way, none rounded" in note


@pytest.mark.thorough
@pytest.mark.parametrize(("unit", "scale"), [("m", 1e-3), ("um", 1e3)])
def test_points_in_another_unit_are_followed_as_those_in_millimetres(unit, scale, tmp_path):
    """A joint that is no corner is smoothed within 0.001 mm, not within 0.001 m or 0.001 um."""
    angle = np.linspace(0, 2 * np.pi, 721)
    circle = 50 * np.stack([np.cos(angle) - 1, np.sin(angle)], axis=1)
    made = []
    for of, factor in (("mm", 1.0), (unit, scale)):
        limits = {name: value * factor for name, value in LIMITS.items()}
        file = write(tmp_path, {"path": "points", "file": "p.csv"} | limits, task={"unit": of})
        np.savetxt(tmp_path / "p.csv", circle * factor, delimiter=",", header="x,y")
        made.append(np.asarray(read_scenario(file).task.reference) / factor)
    assert_allclose(made[1], made[0], atol=1e-6)
    assert np.max(np.abs(np.hypot(*(made[1] + [50, 0]).T) - 50)) < 0.0015


@pytest.mark.parametrize("kind", ["circle", "lines"])
def test_what_cannot_be_planned_is_told_in_the_unit_of_the_task(kind, tmp_path):
    file = write(tmp_path, KINDS[kind] | {"jerk": 1e-12}, task={"unit": "rad"})
    (tmp_path / "p.csv").write_text("x,y\n0,0\n3,0\n")
    with pytest.raises(ValueError, match=r"jerk = 1e-12 rad/s\^3 need"):
        read_scenario(file)


def test_a_path_is_run_and_swept_with_the_names_of_its_axes(tmp_path):
    made = read_scenario(write(tmp_path, KINDS["gcode"] | {"rest": 0.02}, tolerance=0.5))
    parts = (made.machine, made.schemes, made.task, made.trials)
    dataset, _ = run_schemes(*parts, quantities=made.functions)
    found = run_numbers(made, dataset)
    of_run = found["schemes"]["ilc"]
    assert list(of_run["axes"]) == ["x", "y"]
    error = np.abs(dataset["e"].sel(scheme="ilc", trial=2, channel="y"))[1:]
    assert of_run["axes"]["y"]["max_error"]["2"] == float(error.max())
    distance = contour_error(dataset["y"].values[0, -1], made.task.reference, window=64)[1:]
    assert of_run["contour_max"]["2"] == pytest.approx(float(np.max(np.abs(distance))))
    assert of_run["contour_rms"]["2"] == pytest.approx(float(np.sqrt(np.mean(distance**2))))
    swept = Sweep(*parts, uncertainty=made.uncertainty, machines=3, quantities=made.functions).run()
    summary = summarise(swept, 0.5, metric=made.judged_by)
    numbers = sweep_numbers(made, summary, 0.5, 3) | axes_numbers(made, swept, 0.5)
    of_sweep = numbers["axes"]["ilc"]
    assert list(of_sweep) == ["x", "y", "contour"]
    assert of_sweep["contour"]["worst"] == numbers["schemes"]["ilc"]["by_trial"]["2"]["worst"]
    assert of_sweep["contour"]["yield"] == numbers["schemes"]["ilc"]["yield"]
    of_y = swept["max_error"].sel(scheme="ilc", channel="y", trial=2)
    assert of_sweep["y"]["worst"] == float(of_y.max())
    for metric, last, said in (("rms", "contour", "rms error"),
                               ("settled_error", "y", "settled error")):  # fmt: skip
        of = axes_numbers(judged(made, metric), swept, 0.5)
        assert ([*of["axes"]["ilc"]][-1], of["axes_of"]) == (last, f"{said} [mm]")
        error = float(swept[metric].sel(scheme="ilc", channel="y", trial=2).max())
        assert of["axes"]["ilc"]["y"]["worst"] == error
    drawn = figures.contour(dataset, "ilc", (1, 2))
    assert [drawn[0].get_xlabel(), drawn[0].get_ylabel()] == ["x [mm]", "y [mm]"]
    for table in (axes_table(found), swept_axes_table(numbers)):
        console = Console(file=io.StringIO(), width=80)
        console.print(table)
        lines = console.file.getvalue().splitlines()
        assert max(map(len, lines)) <= 80
        assert sum("│ contour" in line for line in lines) == 1


def test_axes_of_their_own_references_have_a_contour_error(tmp_path):
    wave = {"function": "sinusoid", "amplitude": 1.0, "frequency": 10.0, "duration": 0.2}
    made = read_scenario(write(tmp_path, [wave, wave | {"amplitude": 2.0}]))
    assert {"contour_max", "contour_rms"} <= set(made.quantities)
    assert made.judged_by != "contour_max"  # only a file with a path is judged by it


def test_axes_share_a_table_and_take_names(tmp_path):
    plant = {"kind": "ThreeAxes", "axis": AXIS}
    reference = KINDS["nurbs"] | {"points": [[0, 0, 0], [0, 2, 1], [1, 2, 2]]}
    made = read_scenario(write(tmp_path, reference, plant=plant, uncertainty={}))
    assert made.task.names == ("x", "y", "z")
    assert list(made.quantities) == ["contour_max", "contour_rms"]
    named = read_scenario(write(tmp_path, KINDS["circle"], task={"names": ["x", "z"]}))
    assert named.task.names == ("x", "z")
    assert judged(named, "rms").tolerance is None
    with pytest.raises(ValueError, match=r"table.json: task.names = \['contour', 'y'\] has 'conto"):
        read_scenario(write(tmp_path, KINDS["circle"], task={"names": ["contour", "y"]}))


def test_a_metric_that_is_not_there_is_refused(tmp_path):
    made = read_scenario(write(tmp_path, KINDS["circle"]))
    with pytest.raises(ValueError, match=r"metric = 'contour'.*contour_max"):
        judged(made, "contour")
    with pytest.raises(ValueError, match="judged_by: metric = 'effort'"):
        read_scenario(write(tmp_path, KINDS["circle"], judged_by="effort"))


SINE = {"function": "sinusoid", "amplitude": 1.0, "frequency": 5.0, "duration": 0.4}
REFUSED = {
    r"the plant has 2 outputs \(x, y\), and 1 of them has a reference": SINE,
    "task.reference.feed is missing": {**KINDS["circle"], "feed": None},
    r"feed = 0 mm/s is outside its allowed range \(0, inf\)": {**KINDS["circle"], "feed": 0},
    "task.reference.acceleration = 0 is outside": {**KINDS["circle"], "acceleration": 0},
    r"acceleration = \[1, 2, 3\] is not one number": {**KINDS["circle"], "acceleration": [1, 2, 3]},
    "path = 'ellipse' is not one of": {**KINDS["circle"], "path": "ellipse"},
    r"a path of 3 axes for 2 outputs \(x, y\)": {**KINDS["nurbs"], "points": [[0, 0, 0]] * 3},
    "knots has 2 numbers; 3 points of degree 2 need 6": {**KINDS["nurbs"], "knots": [0, 1]},
    r"corner = 'round' is not \"stop\"": {**KINDS["lines"], "corner": "round"},
    "corner = -1 is outside its allowed range": {**KINDS["lines"], "corner": -1},
    "corners is not a key here; did you mean corner": {**KINDS["lines"], "corners": 1},
    "table.json is no .*|has no column 'x'": {**KINDS["lines"], "file": "table.json"},
    "p.csv, line 1: .* is no word": {**KINDS["gcode"], "file": "p.csv"},
    "y is in 'in'; this task needs 'mm'": {**KINDS["lines"], "file": "inch.csv"},
    "is no file": {**KINDS["gcode"], "file": "."},
}


@pytest.mark.parametrize("said", REFUSED)
def test_what_is_no_path_is_refused_by_its_key(said, tmp_path):
    reference = {key: value for key, value in REFUSED[said].items() if value is not None}
    with pytest.raises(ValueError, match=said):
        read_scenario(write(tmp_path, reference))
