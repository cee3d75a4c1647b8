"""Records are read from the files of scopes, samplers and MATLAB, and put onto uniform times."""

import numpy as np
import pytest
import scipy.io
from command import write_columns

from jaxilc.identification import read_record, read_repeats
from jaxilc.identification.record_files import Signal, read_record_file, resampled
from jaxilc.scenarios.file_plant import is_response
from jaxilc.storage.mat_files import Other

U, Y = np.array([1.0, -2.0, 0.5, 4.0]), np.array([0.0, 0.25, -1.5, 2.0])


def check(found, dt=1e-3):
    np.testing.assert_allclose(found.u, U[:-1, None], rtol=1e-12)
    np.testing.assert_allclose(found.y, Y[:, None], rtol=1e-12)
    assert found.dt == pytest.approx(dt, rel=1e-9)


def rows(separator=",", decimal=".", times=(0.0, 1.0, 2.0, 3.0)):
    lines = [separator.join(f"{v:.14g}" for v in row) for row in zip(times, U, Y, strict=True)]
    return "\n".join(lines).replace(".", decimal) + "\n"


# Text
# --------------------------------------------------------------------------------------------------

TEXTS = {
    "names of units below": "x-axis,u,y\nSecond,Volt,Volt\n" + rows(times=1e-3 * np.arange(4.0)),
    "absolute clock": "t,u [V],y [mm]\n" + rows(times=1732999999 + 1e-3 * np.arange(4.0)),
    "comments": "# drive 3\n% 2024-05-06\n; axis x\nt [ms],u [V],y [mm]\n" + rows(),
    "units below": "t,u,y\n[ms],[V],[mm]\n" + rows(),
    "plain units below": "t;u;y\nms;V;mm\n" + rows(";"),
    "decimal commas": "t [ms];u [V];y [mm]\n" + rows(";", ","),
    "tabs": "t [ms]\tu [V]\ty [mm]\n" + rows("\t", ","),
    "blanks": "t [ms]  u [V] y (mm)\n" + rows("   "),
    "numpy.savetxt": "# t [ms],u [V],y [mm]\n" + rows(),
    "round brackets": "Time (ms);u (V);y (mm)\n" + rows(";"),
    "first line of Excel": "\ufeffsep=|\r\nt [ms]|u [V]|y [mm]\r\n" + rows("|", ","),
    "comment within": "t [ms],u [V],y [mm]\n" + rows().replace("2,0.5", "# a pause\n2,0.5"),
}


@pytest.mark.parametrize("kind", TEXTS)
def test_columns_are_understood(tmp_path, kind):
    path = tmp_path / "record.csv"
    path.write_text(TEXTS[kind])
    for output in ("y", "y (mm)") if kind in ("blanks", "round brackets") else ("y",):
        scope = kind == "names of units below"
        found = read_record_file(path, output=output, time="x-axis" if scope else "t")
        check(found.record)
        assert (found.input_units, found.output_units) == (("V",), ("V" if scope else "mm",))


def test_round_brackets_around_no_unit_are_part_of_a_name(tmp_path):
    path = tmp_path / "record.csv"
    path.write_text("t [ms],u [V],y (set),y (actual)\n0,1,2,3\n1,1,2,3\n")
    with pytest.raises(ValueError, match=r"no column 'y'; present are .*y \(set\), y \(actual"):
        read_record_file(path)
    found = read_record_file(path, output="y (actual)")
    assert (found.output_units, found.record.y[0, 0]) == (("",), 3.0)


STEPS = "{},u,y\n0,1,0\n2,1,1\n4,1,2\n"
REFUSED = [
    ("t [ms],u,y\n" + rows(",", ","), r"line 3: 4 cells where the header has 3; are these d"),
    ("t [ms];u;y\n0;1,5;2\n1;2.5;3\n", r"decimal commas \(line 2\) and decimal points \(line 3"),
    (rows(), r"no header: its line 1 holds 3 numbers. Name the columns .* --columns t,u,y"),
    ("# nothing\n\n", "is empty; allowed is a line of headings with numbers below it"),
    ("t,u,y\n0,1,2\n", "has 1 rows of data; allowed are at least 2"),
    ("t [ms],u,y,u\n0,1,2,3\n1,2,3,4\n", "has 2 columns 'u'; allowed is one of a signal"),
    ("t [ms],u,y [mm],y (um)\n0,1,2,3\n1,2,3,4\n", "has 2 columns 'y'; allowed is one"),
    ("t,u,z\n0,1,2\n1,1,2\n",
     r"no column 'y'; present are t, u, z; --output \(output\) names another"),
    ("t,u,y\n12:00:00.1,1,2\n", "line 2: t = '12:00:00.1' is not a finite number; allowed are num"),
    ("t,u,y\n0,1,2\n1,x,2\n", "line 3: u = 'x' is not a finite number"),
    ("t,u,y\n0,1,2\n\n1,1,2\n2,1,nan\n", "line 5: y = 'nan' is not a finite number"),
    ("t,u,y\n0,1,2\n1,1\n", "line 3: y = '' is not a finite number"),
    ("t [s],u [V],y [mm]\n0,1,0\n1,,2\n2,1,2\n", "line 3: u = '' is not a finite number"),
    ("t [s],u,y\n1732999999.25,1,2\n1732999999.5,1,2\n1732999999.25,1,2\n",
     "line 4: t = 1732999999.25 s does not increase from 1732999999.5 s; allowed .* Cut the file"),
    ("t [s],u,y\n0,1,2\n1,1,2\n1,1,2\n", "line 4: t = 1 s does not .* Keep one row"),
    ("t [s],u,y\n0,1,2\n1,1,2\n2,1,2\n4,1,2\n",
     "line 5: t steps by 2 s where the sample time is dt = 1 s; allowed is a deviation of 1%"),
    ("t [ms],u,y\n" + rows(times=(0, 1, 2, 3.5)),
     r"line 5: t steps by 0.0015 s where .* dt = 0.001 s; .* or --dt 0.001"),
    (STEPS.format("t"),
     r"t steps by 2 and has no unit; in seconds .* 0.5 samples a second, in milli.*"
     r"Write its unit into the heading, as `t \[ms\]`, .* as t_ms; or tell it by --time"),
    (STEPS.format("t [furlong]"), r"the unit 'furlong' of 't \[furlong\]' is not one of s, ms, us"),
]  # fmt: skip


@pytest.mark.parametrize(("text", "said"), REFUSED)
def test_what_is_wrong_or_not_clear_is_refused_with_the_file_and_the_line(tmp_path, text, said):
    (tmp_path / "record.csv").write_text(text)
    with pytest.raises(ValueError, match=f"record.csv.*{said}"):
        read_record(tmp_path / "record.csv")


def test_a_unit_of_time_that_is_another_one_or_none_is_refused(tmp_path):
    path = tmp_path / "record.csv"
    path.write_text(STEPS.format("t [ms]"))
    with pytest.raises(
        ValueError, match=r"the heading 't \[ms\]' has another unit than --time-unit"
    ):
        read_record(path, time_unit="s")
    with pytest.raises(ValueError, match="time_unit = 'h' is not one of s, ms, us"):
        read_record(path, time_unit="h")


# halsampler
# --------------------------------------------------------------------------------------------------


def hal(samples=(7, 8, 9, 10), tag=True):
    """The lines of LinuxCNC's sampler, with a pin of type bit at the end."""
    lines = [f"{u:f} {y:f} 1 " for u, y in zip(U, Y, strict=True)]
    return "\n".join(f"{n} " * tag + line for n, line in zip(samples, lines, strict=True)) + "\n"


def test_halsampler_is_read_with_names_and_a_sample_time(tmp_path):
    path = tmp_path / "hal.txt"
    path.write_text(hal())
    check(read_record(path, columns=["sample", "u", "y", "on"], dt=1e-3))
    path.write_text(hal(tag=False))
    check(read_record(path, columns=["u", "y", "on"], dt=1e-3))
    with pytest.raises(ValueError, match=r"line 1 holds 3 numbers. Name the columns in their"):
        read_record(path)
    with pytest.raises(ValueError, match=r"has no column 't'; present are u, y, on"):
        read_record(path, columns=["u", "y", "on"])
    with pytest.raises(ValueError, match=r"line 1: 3 cells where the header has 2"):
        read_record(path, columns=["u", "y"], dt=1e-3)
    path.write_text(hal((7, 8, 10, 11)))
    with pytest.raises(ValueError, match=r"line 3: t steps by 0.002 s"):
        read_record(path, columns=["sample", "u", "y", "on"], dt=1e-3)
    path.write_text(hal(tag=False).replace("0.5", "overrun\n0.5"))
    with pytest.raises(ValueError, match=r"line 3: `overrun` of halsampler: samples were lost"):
        read_record(path, columns=["u", "y", "on"], dt=1e-3)
    path.write_text("t [ms],u,y\n" + rows())
    assert read_record(path, dt=2e-4).dt == 2e-4  # it has times of its own
    assert len(read_record(path, dt=1e-3).y) == 4  # the same ones
    with pytest.raises(ValueError, match=r"has a header, t \[ms\], u, y; allowed are names"):
        read_record(path, columns=["t", "x", "y"])
    with pytest.raises(ValueError, match=r"dt = 0 is outside"):
        read_record(path, dt=0.0)


# TwinCAT Scope
# --------------------------------------------------------------------------------------------------

SCOPE = "Name\taxis\nFile\tC:\\axis.csv\nStarttime of export\t132959733843760000\tMontag\n\n\n"


def scope(*data, shared=False, sample=("1", "1")):
    """An export of two channels with their own times, or with one column of times."""
    keys = {
        "Name": ("torque", "position"),
        "SampleTime[ms]": sample,
        "SymbolName": ("MAIN.u", "MAIN.y"),
        "Unit": ("(None)", "mm (Length)"),
    }
    head = [
        f"{key}\t{a}\t{b}" if shared else f"{key}\t{a}\t{key}\t{b}" for key, (a, b) in keys.items()
    ]
    lines = ["\t".join(f"{v:.17g}" for v in row).replace(".", ",") for row in data]
    return SCOPE + "\n".join([*head, "", *lines, "EOF", ""])


T = np.arange(4.0)


def test_a_scope_of_twincat_is_read(tmp_path):
    path = tmp_path / "scope.csv"
    path.write_text(scope(*zip(T, U, T, Y, strict=True)))
    found = read_record_file(path, input="torque", output="position")
    check(found.record)
    assert (found.input_units, found.output_units) == (("",), ("mm",))
    check(read_record(path, input="MAIN.u", output="MAIN.y"))
    path.write_text(scope(*zip(T, U, Y, strict=True), shared=True))
    check(read_record(path, input="torque", output="position"))
    path.write_text(scope(*zip(T, U, T, Y, strict=True)).replace(",", ".").replace("\t", ","))
    check(read_record(path, input="torque", output="position"))
    # ticks of 100 ns, and the late times of a second task are within the tolerance
    ticks = [132959733843760000 + 10000 * k for k in range(4)]
    lines = [f"{n}\t{u}\t{n + 10}\t{y}" for n, u, y in zip(ticks, U, Y, strict=True)]
    path.write_text(scope().replace("EOF", "\n".join(lines).replace(".", ",") + "\nEOF"))
    check(read_record(path, input="torque", output="position"))


def test_a_scope_of_twincat_holds_a_trial(tmp_path):
    """`potential` told of 4 cells where the header has 2, of an export that `identify` reads."""
    path = tmp_path / "scope.csv"
    path.write_text(scope(*zip(T, U, T, Y, strict=True)))
    found = read_repeats([path], error="torque", output="MAIN.y")
    np.testing.assert_array_equal(found.e, [U])
    np.testing.assert_array_equal(found.position, Y)
    assert (found.dt, found.unit, found.place) == (1e-3, "", "mm")
    with pytest.raises(ValueError, match=r"--dt .dt. is 0.002 s"):
        read_repeats([path], error="torque", dt=2e-3)
    with pytest.raises(ValueError, match=r"has neither 'e' nor .* present are .*torque"):
        read_repeats([path])
    path.write_text(scope(*zip(T, U, T + 0.5, Y, strict=True)))
    with pytest.raises(ValueError, match="torque, position have different times; export them"):
        read_repeats([path], error="torque", output="position")


def test_channels_of_different_times_are_named(tmp_path):
    path = tmp_path / "scope.csv"
    names = {"input": "torque", "output": "position"}
    path.write_text(scope(*zip(2 * T, U, T, Y, strict=True), sample=("2", "1")))
    with pytest.raises(ValueError, match=r"signals have different times; .* --dt 0.002"):
        read_record(path, **names)
    path.write_text(scope(*zip(T, U, T, Y, strict=True), sample=("0,25", "1")))
    with pytest.raises(ValueError, match=r"times of torque step by 1 ms where its .* is 0.25"):
        read_record(path, **names)
    with pytest.raises(ValueError, match=r"has no channel 'u'; present are torque, position"):
        read_record(path)
    path.write_text(scope(*zip(T, U, T, Y, strict=True)).replace("\t", " "))
    with pytest.raises(ValueError, match="separated by blanks; export it with tabs"):
        read_record(path, **names)
    path.write_text(SCOPE + "Name\ta\tName\tb\n")
    with pytest.raises(ValueError, match="without channels or without data"):
        read_record(path)


# MATLAB
# --------------------------------------------------------------------------------------------------

SECONDS = 1e-3 * T[:, None]
MATS = {
    "arrays": {"t": SECONDS, "u": U, "y": Y[:, None]},
    "a structure": {"log": {"Time": SECONDS, "u": U, "y": Y}},
    "times beside it": {"tout": SECONDS, "log": {"u": U, "y": Y}},
    "times of its own": {"t": 2 * SECONDS, "log": {"Time": SECONDS, "u": U, "y": Y}},
    "Time and Data": {n: {"Time": SECONDS, "Data": v} for n, v in (("u", U), ("y", Y))},
    "page": {"u": {"Time": SECONDS, "Data": U.reshape(1, 1, 4)}, "y": {"Time": SECONDS, "Data": Y}},
    "with time": {
        n: {"time": SECONDS, "signals": {"values": v, "label": n}} for n, v in (("u", U), ("y", Y))
    },
}


@pytest.mark.parametrize("kind", MATS)
def test_matlab_files_are_read(tmp_path, kind):
    scipy.io.savemat(tmp_path / "r.mat", MATS[kind], do_compression=True)
    check(read_record(tmp_path / "r.mat"))


def test_arrays_of_numpy_are_read_as_those_of_matlab(tmp_path):
    """`identify` asked to save a .npz file, which `potential` reads, as a text in UTF-8."""
    path = tmp_path / "r.npz"
    np.savez(path, t_ms=T, u=U, y=Y)
    assert not is_response(path, ())
    check(read_record(path, time="t_ms"))
    np.savez(path, t=1e-3 * T, u=U, y=np.array(["a"] * 4))
    with pytest.raises(ValueError, match=r"r.npz: y is no array of numbers"):
        read_record(path)
    np.save(path.with_suffix(".npy"), T)
    for read in (
        read_record,
        lambda path: read_repeats([path]),
        lambda path: is_response(path, ()),
    ):
        with pytest.raises(ValueError, match="is an array of NumPy, whose columns have no names"):
            read(path.with_suffix(".npy"))


def test_the_last_row_of_a_matlab_file_needs_a_time_and_an_output(tmp_path):
    for name, said in (("t", "the time is"), ("y", "y is")):
        signals = {"t": SECONDS.ravel(), "u": U, "y": 1.0 * Y}
        signals[name] = np.append(signals[name][:-1], np.nan)
        scipy.io.savemat(tmp_path / "r.mat", signals)
        with pytest.raises(ValueError, match=f"r.mat, row {len(Y)}: {said} not a finite number"):
            read_record(tmp_path / "r.mat")


def test_a_sample_time_does_not_hide_the_times_of_a_matlab_file(tmp_path):
    """With dt = 0.001 milliseconds were seconds, and another dt than theirs was ignored."""
    k, path = np.arange(40.0), tmp_path / "r.mat"
    for content in (
        {"t": 1e-3 * k, "u": np.ones(40), "y": k},
        {"t": 1e-3 * k, "log": {"u": np.ones(40), "y": k}},
    ):
        scipy.io.savemat(path, content)
        found = read_record_file(path, dt=2e-3)
        assert (found.record.dt, found.resampled) == (2e-3, 2e-3)
        assert found.own == pytest.approx(1e-3)
        np.testing.assert_allclose(found.record.y[:, 0], np.arange(0, 40, 2), atol=1e-9)
        scipy.io.savemat(path, content | {"t": k})
        with pytest.raises(ValueError, match="t steps by 1 and has no unit; in seconds that"):
            read_record(path, dt=1e-3)
        assert read_record(path, dt=1e-3, time_unit="ms").dt == pytest.approx(1e-3)


def test_what_matlab_must_export_differently_is_said(tmp_path, monkeypatch):
    path = tmp_path / "r.mat"
    path.write_bytes(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM" + b"\x89HDF")
    with pytest.raises(ValueError, match=r"version 7.3 .*save\('record.mat', 't', 'u', 'y', '-v7'"):
        read_record(path)
    with pytest.raises(ValueError, match=r"save\('record.mat', 'tout', 'log', '-v7'"):
        read_record(path, time="tout", input="log.u", output="log.y")
    with pytest.raises(ValueError, match=r"save\('record.mat', 't', 'e', 'y', 'r', '-v7'"):
        read_repeats([path])
    scipy.io.savemat(path, {"u": U})
    with pytest.raises(ValueError, match=r"no times 't' beside u; .* or give --dt"):
        read_record(path, output="u")
    check(read_record(path, output="u", dt=1e-3)._replace(y=Y[:, None]))
    scipy.io.savemat(path, {"t": SECONDS, "u": {"a": 1.0}, "y": np.eye(4)})
    with pytest.raises(ValueError, match="u is a structure of a; allowed are the fields Time and"):
        read_record(path)
    with pytest.raises(ValueError, match=r"y has the shape \(4, 4\); allowed is a vector"):
        read_record(path, input="t")
    with pytest.raises(ValueError, match="has no variable 'w'; present are t, u, y"):
        read_record(path, input="w")
    monkeypatch.setattr(
        "jaxilc.identification.record_files.read_mat",
        lambda *_: {"u": Other("an object, such as text")},
    )
    with pytest.raises(ValueError, match=r"u = struct\('Time', u.Time, 'Data', u.Data\); save\("):
        read_record(path, dt=1e-3)


# Resampling
# --------------------------------------------------------------------------------------------------


def test_resampling_keeps_the_area_of_the_input_and_interpolates_the_output():
    rng = np.random.default_rng(8)
    t, v = np.cumsum(rng.uniform(0.5, 1.5, 400)), np.cumsum(rng.normal(size=400))
    tu, u = np.cumsum(rng.uniform(0.5, 1.5, 400)), rng.normal(size=400)
    places = [""] * 400
    found_u, found_y = resampled("x", [Signal(tu, u, places)], [Signal(t, v, places)], 2.5)
    start = max(t[0], tu[0])
    grid = start + 2.5 * np.arange(len(found_y))
    np.testing.assert_allclose(found_y[:, 0], np.interp(grid, t, v), rtol=1e-12, atol=1e-12)
    # the mean of the held input, over a fine grid
    fine = np.arange(0, 2.5, 1e-4) + 0.5e-4
    for k in (0, 7, 100):
        held = u[np.searchsorted(tu, grid[k] + fine, side="right") - 1]
        assert found_u[k, 0] == pytest.approx(np.mean(held), abs=1e-3)
    assert len(found_y) == len(found_u) + 1


def test_a_record_of_uneven_times_is_resampled_when_asked(tmp_path):
    rng = np.random.default_rng(9)
    t = np.cumsum(rng.uniform(0.8e-3, 1.2e-3, 200))
    table, path = (t, np.ones(200), 5 * t), tmp_path / "record.csv"
    write_columns(path, "t [s],u,y", *table)
    with pytest.raises(ValueError, match=r"or --dt 0.00\d+ \(dt\)"):
        read_record(path)
    found = read_record(path, resample=1e-3)
    np.testing.assert_allclose(found.u, 1.0, rtol=1e-9)
    np.testing.assert_allclose(np.diff(found.y[:, 0]), 5e-3, rtol=1e-9)
    late = Signal(np.append(t, t[-1] + 5e-3), np.append(np.ones(200), np.nan), [""] * 201)
    held, _ = resampled(path, [late], [late._replace(values=late.times)], 1e-3)
    np.testing.assert_allclose(held, 1.0, rtol=1e-9)  # until the last time, which has no input
    with pytest.raises(ValueError, match=r"--dt 1e-09 \(resample\) is outside its allowed"):
        read_record(path, resample=1e-9)
    write_columns(path, "t,u,y", *np.delete(table, np.s_[50:90], 1))
    with pytest.raises(ValueError, match=r"line 52: 0.04\d* s without a sample"):
        read_record(path, resample=1e-3)
