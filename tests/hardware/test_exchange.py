"""Files of measured trials are those of other programs.

Tables to play are read by a C compiler, and played by the feedback alone.
"""

import dataclasses
import re
import shutil
import subprocess

import jax
import numpy as np
import pytest
import scipy.io
from cases import ALGEBRA, DT, case

from jaxilc.hardware import read_measured, write_schedules
from jaxilc.learning import Actuator, learn, replay, run_trial
from jaxilc.learning.playback import schedules
from jaxilc.schemes import OnOutputs, Scheme, WithFeedback
from jaxilc.schemes.compose import Pair
from jaxilc.schemes.scheme import Feedforward
from jaxilc.signals import Task

N = 20
K = np.arange(N + 1)
ONE = Task(np.sin(0.3 * K), dt=DT, unit="mm", input_unit="V")
TWO = Task(np.stack([np.sin(0.3 * K), np.cos(0.3 * K)], axis=1), dt=DT, inputs=1, unit="µm")


def mat(path, task=ONE, units=None, **signals):
    """Write a file as MATLAB's `save` does."""
    if units is None:
        units = {"t": "s", "y": task.unit, "r": task.unit, "u": task.input_unit}
    told = {"units": units} if units else {}
    scipy.io.savemat(path, {"t": task.time[:, None], **signals, **told})
    return path


def text(path, header, *columns):
    """Write a file of columns, separated by semicolons."""
    rows = [";".join(repr(float(v)) for v in row) for row in zip(*columns, strict=True)]
    path.write_text("\n".join([header, *rows]) + "\n", encoding="utf-8-sig")
    return path


def test_a_mat_file_is_read_with_its_units(tmp_path):
    y, u = K**2 / 7, np.arange(N) / 3
    for held in (u, u[:, None], np.append(u, 99.0)):
        file = mat(tmp_path / "a.mat", y=y[None], u=held, r=np.asarray(ONE.reference), current=u)
        found = read_measured(file, ONE)
        np.testing.assert_array_equal(found.y[:, 0], y)
        np.testing.assert_array_equal(found.u[:, 0], u)
        assert found.ignored == ("current",)


TIMES = 1e3 * DT * K  # [ms]
Y, U = K**2 / 8 - 3.0, np.append(K[:-1] / 4, 0.0)


def commas(values):
    return [f"{v:.6f}".replace(".", ",") for v in values]


def scope(path):
    """Write an export of TwinCAT Scope with the channels `pos_act` and `set`."""
    heads = [
        ("Name", "pos_act", "Name", "set"),
        ("SampleTime[ms]", f"{1e3 * DT:g}", "SampleTime[ms]", f"{1e3 * DT:g}"),
        ("Unit", "mm (Length)", "Unit", "(None)"),
    ]
    rows = zip(commas(TIMES), commas(Y), commas(TIMES), commas(U), strict=True)
    lines = [
        "Name\tscope", "File\tscope.csv", "", *map("\t".join, heads), "", *map("\t".join, rows),
    ]  # fmt: skip
    path.write_text("\n".join(lines) + "\n")


def structures(path):
    signals = {name: {"Time": TIMES / 1e3, "Data": of} for name, of in (("pos", Y), ("set", U))}
    scipy.io.savemat(path, {"log": signals})


OTHER_FORMATS = {
    "milliseconds.csv": (
        lambda path: text(path, "t [ms];pos_act [mm];u [V]", TIMES, Y, U), {"y": "pos_act"}, (),
    ),
    "time.csv": (
        lambda path: text(path, "time_ms;pos_act;u", TIMES, Y, U),
        {"y": "pos_act [mm]", "u": "u [V]"}, (),
    ),
    "comma.csv": (
        lambda path: path.write_text("\n".join(["t [ms];y [mm];u [V]", *map(
            ";".join, zip(*map(commas, (TIMES, Y, U)), strict=True))])), {}, (),
    ),
    "sample.csv": (lambda path: text(path, "sample;y [mm];u [V]", 7 + K, Y, U), {}, ()),
    "halsampler.txt": (
        lambda path: np.savetxt(path, np.column_stack([7 + K, U, Y])), {},
        ("sample", "u [V]", "y [mm]"),
    ),
    "rows.txt": (lambda path: np.savetxt(path, np.column_stack([U, Y])), {}, ("u [V]", "y [mm]")),
    "scope.csv": (scope, {"y": "pos_act", "u": "set [V]"}, ()),
    "log.mat": (structures, {"y": "log.pos [mm]", "u": "log.set [V]"}, ()),
}  # fmt: skip


@pytest.mark.parametrize("name", OTHER_FORMATS)
def test_what_identify_reads_is_read_of_a_trial_too(tmp_path, name):
    write, names, columns = OTHER_FORMATS[name]
    write(tmp_path / name)
    found = read_measured(tmp_path / name, ONE, names=names, columns=columns)
    np.testing.assert_allclose(found.y[:, 0], Y, rtol=1e-12)
    np.testing.assert_allclose(found.u[:, 0], U[:-1], rtol=1e-12)


def test_a_lost_sample_and_a_missing_unit_are_seen_in_other_formats_too(tmp_path):
    np.savetxt(tmp_path / "a.txt", np.column_stack([np.where(K > 9, K + 1, K), U, Y]))
    with pytest.raises(ValueError, match="a gap of 1 samples"):
        read_measured(tmp_path / "a.txt", ONE, columns=("sample", "u [V]", "y [mm]"))
    with pytest.raises(ValueError, match="y declares no unit"):
        read_measured(tmp_path / "a.txt", ONE, columns=("sample", "u", "y"))
    scope(tmp_path / "scope.csv")
    with pytest.raises(ValueError, match="has no channel 'z'; present are pos_act, set"):
        read_measured(tmp_path / "scope.csv", ONE, names={"y": "z"})
    with pytest.raises(ValueError, match=r"set declares no unit; .* --input 'set \[V\]'"):
        read_measured(tmp_path / "scope.csv", ONE, names={"y": "pos_act", "u": "set"})


@pytest.mark.parametrize(
    ("contents", "message"),
    [
        ({"y": K, "units": {}}, "has no struct 'units'"),
        ({"y": K, "units": {"t": "s"}}, r"y declares no unit; this task needs 'y \[mm\]'"),
        ({"y": K, "units": {"t": "min", "y": "mm"}}, "t is in 'min'; this task needs 's'"),
        ({"y": K, "units": {"t": "ms", "y": "mm"}}, "is sampled at 1e-06 s but the task at"),
        ({"x": K}, "has no variable 'y'; present are t, x, units"),
        ({"y": np.stack([K, K], axis=1)}, r"y has shape \(21, 2\); allowed are real .* 1 columns"),
        ({"y": K * 1j}, "allowed are real numbers"),
        ({"y": K[:-1]}, "y has 20 rows; this task needs 21"),
        ({"y": K, "u": K[:-3]}, "u has 18 rows; this task needs 20"),
        ({"y": np.where(K == 4, np.nan, K)}, "sample 4: y is not a finite number"),
        ({"y": K, "r": K}, "r is .* mm away from the task's reference"),
    ],
)
def test_a_mat_file_that_does_not_fit_is_refused(tmp_path, contents, message):
    file = mat(tmp_path / "trial.mat", **contents)
    with pytest.raises(ValueError, match=message):
        read_measured(file, ONE)


def test_channels_are_numbered_and_share_a_unit(tmp_path):
    y0, y1, u = np.asarray(K / 3), np.asarray(K / 9), np.asarray(K * 2.0)
    # Unicode has two micro signs. A quantity without a unit has no brackets, or has `[-]`.
    for header in ("t [s];y1 [µm];y0 [μm];u;note", "t [s];y_1 [µm];y_0 [µm];u [-];note"):
        found = read_measured(text(tmp_path / "trial.csv", header, TWO.time, y1, y0, u, u), TWO)
        np.testing.assert_array_equal(found.y, np.stack([y0, y1], axis=1))
        np.testing.assert_array_equal(found.u[:, 0], u[:-1])
        assert found.ignored == ("note",)
    for header, message in (
        ("t [s];y1 [µm];y [µm];u;note", "has no column 'y0'"),
        ("t [s];y1 [µm];y0 [µm];u;y0 [µm]", "has 2 columns 'y0'; allowed is one"),
        ("t [s];y1 [µm];y0 [µm];u;y0 [mm]", "has 2 columns 'y0'; allowed is one"),
        ("t [s];y1 [µm];y0 [mm];u;note", "the channels of y have the units mm, µm; allowed is one"),
    ):
        with pytest.raises(ValueError, match=message):
            read_measured(text(tmp_path / "trial.csv", header, TWO.time, y1, y0, u, u), TWO)


def test_a_signal_may_have_another_name_in_the_file(tmp_path):
    y0, y1, u = np.asarray(K / 3), np.asarray(K / 9), np.asarray(K * 2.0)
    names = {"t": "clock", "y": "north, east", "u": "volts"}
    header = "clock [s];north [µm];volts;east [µm];y"
    path = text(tmp_path / "trial.csv", header, TWO.time, y0, u, y1, u)
    found = read_measured(path, TWO, names=names)
    np.testing.assert_array_equal(found.y, np.stack([y0, y1], axis=1))
    np.testing.assert_array_equal(found.u[:, 0], u[:-1])
    assert found.ignored == ("y",)
    for wrong, message in (
        ({"u": "amperes"}, "has no column 'amperes'; present are .*; --input names another"),
        ({"y": "north"}, "has no column 'north0'"),
        ({"y": "north,east,up"}, "--output 'north,east,up' names 3 columns; allowed are the 2"),
    ):
        with pytest.raises(ValueError, match=message):
            read_measured(path, TWO, names=names | wrong)
    matlab = mat(tmp_path / "trial.mat", x=K, units={"t": "s", "x": "mm"})
    np.testing.assert_array_equal(read_measured(matlab, ONE, names={"y": "x"}).y[:, 0], K)
    with pytest.raises(ValueError, match=r"has no variable 'z'; .*; --output names another"):
        read_measured(matlab, ONE, names={"y": "z"})


def test_a_clock_that_drifts_is_refused_and_one_that_starts_late_is_not(tmp_path):
    task = Task(np.zeros(1001), dt=DT)
    y = np.zeros(1001)
    read_measured(text(tmp_path / "trial.csv", "t [s];y", 5.0 + task.time, y), task)
    drifts = "the clock drifts by 0.0009 s over the trial; allowed is half a sample, 0.0005 s"
    with pytest.raises(ValueError, match=drifts):
        read_measured(text(tmp_path / "trial.csv", "t [s];y", 1.0009 * task.time, y), task)
    with pytest.raises(ValueError, match=r"has 0 rows of data; this task needs N \+ 1 = 1001"):
        read_measured(text(tmp_path / "trial.csv", "t [s];y", [], []), task)


def two_schedules():
    rng = np.random.default_rng(1)
    return {
        "feedforward": rng.standard_normal((N, 1)) * 1e-3,
        "reference": 1e9 * rng.standard_normal((N + 1, 2)),
    }


def test_written_files_keep_every_digit(tmp_path):
    given = two_schedules()
    for name in ("next.csv", "next.mat"):
        write_schedules(tmp_path / name, given, TWO, trial=4)
    header, *rows = (tmp_path / "next.csv").read_text().splitlines()
    assert header == "t [s],r0 [µm],r1 [µm],feedforward [],reference0 [µm],reference1 [µm]"
    columns = np.array([row.split(",") for row in rows], float)
    np.testing.assert_array_equal(columns[:, 1:3], TWO.reference)
    np.testing.assert_array_equal(columns[:-1, 3:4], given["feedforward"])
    np.testing.assert_array_equal(columns[:, 4:], given["reference"])
    stored = scipy.io.loadmat(tmp_path / "next.mat", simplify_cells=True)
    np.testing.assert_array_equal(stored["feedforward"], given["feedforward"][:, 0])
    np.testing.assert_array_equal(stored["reference"], given["reference"])
    assert (stored["trial"], stored["dt"], stored["units"]["reference"]) == (4, DT, "µm")
    assert sorted(f.name for f in tmp_path.iterdir()) == ["next.csv", "next.mat"], (
        "no unfinished file stays"
    )


@pytest.mark.skipif(
    shutil.which("cc") is None, reason="needs a C compiler named cc: install gcc or clang"
)
@pytest.mark.parametrize("number", ["double", "float"])
def test_a_compiler_reads_the_c_header_as_it_was_meant(tmp_path, number):
    given, task = two_schedules(), dataclasses.replace(TWO, dt=np.float64(DT))
    write_schedules(tmp_path / "next.h", given, task, trial=4, number=number)
    header = (tmp_path / "next.h").read_text()
    assert re.search(r"/\* reference \[µm\], trial 4 \*/", header)
    (tmp_path / "main.c").write_text(
        '#include <stdio.h>\n#include "next.h"\n#include "next.h"\n'
        "int main(void) { int k; for (k = 0; k < JAXILC_SAMPLES; k++)\n"
        'printf("%.17g %.17g %.17g\\n", jaxilc_feedforward[k], '
        "jaxilc_reference[k][0], jaxilc_reference[k + 1][1]);\n"
        'printf("%d %.17g\\n", JAXILC_TRIAL, JAXILC_SAMPLE_TIME); '
        "return sizeof(jaxilc_reference[0][0]); }\n"
    )
    flags = ["-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror"]
    compiled = ["cc", *flags, "-o", tmp_path / "main", tmp_path / "main.c"]
    subprocess.run(compiled, check=True, capture_output=True)
    done = subprocess.run([tmp_path / "main"], capture_output=True, text=True)
    *rows, last = (line.split() for line in done.stdout.splitlines())
    expected = np.hstack(
        [given["feedforward"], given["reference"][:-1, :1], given["reference"][1:, 1:]]
    )
    np.testing.assert_array_equal(
        np.array(rows, float), expected if number == "double" else expected.astype(np.float32)
    )
    assert last == ["4", "0.001"]
    assert done.returncode == (8 if number == "double" else 4)


def test_another_format_is_refused(tmp_path):
    for path, number, message in (
        (tmp_path / "next.xls", "double", "is none of the formats .csv, .mat, .h"),
        (tmp_path / "next.h", "half", "number = 'half' is not one of 'double', 'float'"),
        (tmp_path / "no/next.h", "float", "the folder does not exist"),
    ):
        with pytest.raises(ValueError, match=message):
            write_schedules(path, two_schedules(), TWO, trial=1, number=number)


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["p_type_on_reference", "milc"])
def test_the_feedback_alone_along_the_learned_reference_makes_the_scheme_s_trial(name):
    machine, scheme, task = case(name)
    memory = learn(machine, scheme, task, 2).memory
    played = schedules(scheme, memory, task)
    motor = name == "milc"
    along = np.hstack([played["reference"], np.asarray(task.reference)[:, 1:]])
    feedback = OnOutputs(scheme.feedback, (0,)) if motor else scheme.feedback
    u = played.get("feedforward", np.zeros((task.N, 1)))
    other = Task(along, dt=task.dt, inputs=1)
    key = jax.random.key(0)
    ours = run_trial(
        machine, WithFeedback(Scheme(), feedback), other, Pair(Feedforward(u), ()), key
    )
    theirs = run_trial(machine, scheme, task, memory, key)
    np.testing.assert_allclose(ours.y, theirs.y, **ALGEBRA)
    np.testing.assert_allclose(ours.u, theirs.u, **ALGEBRA)


@pytest.mark.parametrize("name", ["ilc_asmc", "pfdl_sign", "cfdl_mfapc"])
def test_replay_gives_the_input_and_the_signals_of_the_trial(name):
    machine, scheme, task = case(name)
    machine = machine.__class__(machine.plant, Actuator(limit=0.3, rate=60.0, resolution=0.01))
    memory = learn(machine, scheme, task, 2).memory
    trial = run_trial(machine, scheme, task, memory, jax.random.key(0))
    u, signals = replay(scheme, task, memory, trial.y, machine.actuator)
    np.testing.assert_allclose(u, trial.u, **ALGEBRA)
    assert np.max(np.abs(u)) == 0.3, "the limit is reached"
    assert signals.keys() == trial.signals.keys()
    for signal, values in signals.items():
        np.testing.assert_allclose(values, trial.signals[signal], **ALGEBRA)


def test_only_what_is_learned_can_be_played():
    _, scheme, task = case("pid_position")
    nothing = "PID learns nothing that a machine could play; allowed are schemes that learn"
    with pytest.raises(ValueError, match=nothing):
        schedules(scheme, scheme.initial_memory(task), task)
    _, scheme, task = case("ffdl_none")
    rows = schedules(scheme, scheme.initial_memory(task), task)
    assert list(rows) == [
        "table.u", "table.u_last", "table.weights[0]", "table.weights[1]", "table.weights[2]",
        "table.y",
    ]  # fmt: skip
