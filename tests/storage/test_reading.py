"""Devices, pipes, deep nesting and packed bombs are refused at once, with little RAM."""

import json
import os
import tracemalloc
import zlib

import jax
import numpy as np
import pytest
import scipy.io
from cases import DT

from jaxilc.cli.options import schemes_from
from jaxilc.hardware import read_measured
from jaxilc.identification import read_frequency_response, read_record
from jaxilc.runtime.start import keep_programs
from jaxilc.scenarios import load
from jaxilc.scenarios.from_file import read_scenario
from jaxilc.scenarios.parameters import with_parameters
from jaxilc.signals import Task
from jaxilc.storage.mat_files import Other, read_mat
from jaxilc.storage.reading import DEEPEST, read_tree
from jaxilc.sweeps import cluster

TASK = Task(np.sin(0.3 * np.arange(21)), dt=DT, unit="mm", input_unit="V")
READERS = {
    "plant.toml": read_scenario,
    "plant.json": read_scenario,
    "params.json": lambda path: with_parameters(load("dai-2014"), path),
    "params": lambda path: with_parameters(load("dai-2014"), path),
    "scheduler.json": cluster._address,
    "record.csv": read_record,
    "trial.csv": lambda path: read_measured(path, TASK),
    "trial.mat": lambda path: read_measured(path, TASK),
}


@pytest.mark.parametrize("name", READERS)
@pytest.mark.parametrize("kind", ["endless", "pipe", "folder", "loop"])
def test_what_is_no_file_is_refused_at_once(tmp_path, name, kind):
    path = tmp_path / name
    match kind:
        case "endless":
            path.symlink_to("/dev/zero")
        case "pipe":
            os.mkfifo(path)
        case "folder":
            path.mkdir()
        case "loop":
            path.symlink_to(path)
    with pytest.raises((ValueError, OSError), match=name):
        READERS[name](path)
    context = type("Context", (), {"params": {"scenario": str(path)}, "args": ()})()
    assert schemes_from(context, "") == [], "a shell that completes is not held up either"


@pytest.mark.parametrize("name", ["plant.toml", "plant.json", "params.json", "scheduler.json"])
@pytest.mark.parametrize("depth", [DEEPEST + 1, 900, 100_000])
def test_deep_nesting_is_refused(tmp_path, name, depth):
    path = tmp_path / name
    nested = "[" * depth + "]" * depth
    path.write_text(f"plant = {nested}" if name.endswith("toml") else nested)
    with pytest.raises(ValueError, match=f"nested too deeply; allowed are {DEEPEST} levels"):
        READERS[name](path)


def test_a_key_of_very_many_parts_is_refused(tmp_path):
    """Its parser would take the square of their number, in time and in RAM."""
    path = tmp_path / "plant.toml"
    for text in (f"{'a.' * 100_000}a = 1", f"x = {{ {'a . ' * 40}a = 1 }}", f"[{'a.' * 33}a]"):
        path.write_text(text)
        with pytest.raises(ValueError, match=f"nested too deeply; allowed are {DEEPEST} levels"):
            read_scenario(path)
    numbers = [k / 8 for k in range(100)]
    path.write_text(f"x = {numbers}\n" + "\n".join(f"a{k}.b.c = 1" for k in range(1000)))
    assert read_tree(path)["x"] == numbers


def test_a_line_of_very_many_columns_is_refused(tmp_path):
    path = tmp_path / "record.csv"
    for text in ("c," * 10**6, "t,u,y\n" + "1," * 10**6):
        path.write_text(text)
        with pytest.raises(ValueError, match=r"line [12] has 2,000,000 characters; allowed are 1,"):
            read_record(path)


def test_what_is_no_file_of_data_is_not_quoted(tmp_path):
    """A plant file may name any file as its record or program, and a link may lead to any."""
    secret = tmp_path / "passwd"
    secret.write_text("toor:x:0:0\nadmin,secret\n")
    for name in ("plant.toml", "plant.json", "record.csv"):
        (tmp_path / name).symlink_to(secret)
    (tmp_path / "path.toml").write_text(
        "trials = 2\n[plant]\nkind = 'transfer_function'\nnum = [1]\nden = [0.1, 1]\n[task]\n"
        "dt = 0.01\nunit = 'mm'\n[task.reference]\npath = 'gcode'\nfile = 'passwd'\n"
        "acceleration = 9\njerk = 99\n"
    )
    reads = {name: READERS[name] for name in ("plant.toml", "plant.json", "record.csv")}
    for name, read in (reads | {"passwd": read_record, "path.toml": read_scenario}).items():
        with pytest.raises(ValueError, match="not shown") as caught:
            read(tmp_path / name)
        assert "toor" not in str(caught.value).lower()
    (tmp_path / "lines").write_text("f [Hz],re,im\n1,toor,0\n")
    with pytest.raises(ValueError, match=r"line 2: re = \(not shown"):
        read_frequency_response(tmp_path / "lines")
    (tmp_path / "named.csv").write_text(secret.read_text())
    with pytest.raises(ValueError, match="present are toor:x:0:0"):
        read_record(tmp_path / "named.csv")


def test_what_is_nested_as_a_file_may_be_is_read(tmp_path):
    path = tmp_path / "nested.json"
    path.write_text("[" * DEEPEST + "]" * DEEPEST)
    assert json.dumps(read_tree(path)) == path.read_text()


def test_a_text_of_another_kind_or_size_is_refused(tmp_path, monkeypatch):
    path = tmp_path / "record.csv"
    path.write_bytes("t,u,y\n0,1,2\n1,1,ü\n".encode("latin-1"))
    with pytest.raises(
        ValueError,
        match=r"record\.csv is no text in UTF-8: invalid .* 0xfc at byte 16; save it as UTF-8",
    ):
        read_record(path)
    path.write_text("t,u,y\n0,1,2\n1,1," + '"' + "2" * 200_000 + '"')
    with pytest.raises(ValueError, match=r"record\.csv, line 3: field larger than field limit"):
        read_record(path)
    monkeypatch.setattr("jaxilc.storage.columns.LARGEST_TABLE", 100)
    with pytest.raises(
        ValueError, match=r"record\.csv has more than the 100 bytes that are allowed"
    ):
        read_record(path)


def test_more_rows_than_a_trial_could_have_are_not_gathered(tmp_path):
    path = tmp_path / "trial.csv"
    path.write_text("t [s],y [mm]\n" + "0,1\n" * 5000)
    with pytest.raises(
        ValueError, match=r"has more than 1042 rows of data; this task needs N \+ 1 = 21"
    ):
        read_measured(path, TASK)


# MATLAB
# --------------------------------------------------------------------------------------------------


def saved(path, packed=False, **variables):
    scipy.io.savemat(path, variables, do_compression=packed)
    return path


@pytest.mark.parametrize("packed", [False, True], ids=["v6", "v7"])
def test_arrays_and_text_are_those_that_scipy_reads(tmp_path, packed):
    rng, kinds = (
        np.random.default_rng(4),
        ("f8", "f4", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8"),
    )
    given = {
        f"{kind}_{i}": (100 * rng.random(shape)).astype(kind)
        for kind in kinds
        for i, shape in enumerate([(3, 1), (1, 4), (2, 3, 2)])
    }
    given |= {
        "none": np.zeros((0, 3)),
        "units": {"y": "µm/s²", "a_very_long_name_of_a_signal": "V", "u": ""},
        "said": "text",
        "yes": np.True_,
    }
    path = saved(
        tmp_path / "x.mat",
        packed,
        **given,
        cell=np.array([1, "a"], dtype=object),
        c=np.array([1j]),
        sparse=scipy.sparse.eye(3),
    )
    plain = list(given.keys() - {"units", "said"})
    ours, theirs = read_mat(path), scipy.io.loadmat(path, variable_names=plain)
    for name in plain:
        np.testing.assert_array_equal(ours[name], theirs[name])
    assert (ours["units"], ours["said"]) == (given["units"], "text")
    assert all(isinstance(ours[name], Other) for name in ("cell", "c", "sparse"))


def test_the_order_of_bytes_is_that_of_the_file(tmp_path):
    """As MATLAB writes it on another processor: `y` of two doubles, `s`, a text of two letters."""

    def element(kind, data):
        return np.array([kind, len(data)], ">u4").tobytes() + data + bytes(-len(data) % 8)

    def array(kind, dims, name, *rest):
        flags = element(6, np.array([kind, 0], ">u4").tobytes())
        return element(
            14,
            flags + element(5, np.array(dims, ">i4").tobytes()) + element(1, name) + b"".join(rest),
        )

    content = (
        b"MATLAB 5.0".ljust(124)
        + b"\x01\x00MI"
        + array(6, (2, 1), b"y", element(9, np.array([1.5, -2.0], ">f8").tobytes()))
    )
    content += array(4, (1, 2), b"s", element(17, "µm".encode("utf-16-be")))
    (tmp_path / "big.mat").write_bytes(content)
    assert read_mat(tmp_path / "big.mat")["s"] == "µm"
    np.testing.assert_array_equal(read_mat(tmp_path / "big.mat")["y"], [[1.5], [-2.0]])


def of_bombs(tmp_path):
    """Return files of a few kB that claim gigabytes, or unpack to 150 MB."""
    y = np.zeros((21, 1))
    whole = saved(tmp_path / "small.mat", y=y, t=y, units={"y": "mm", "t": "s"}).read_bytes()
    at = whole.index(np.array([21, 1], "<i4").tobytes())
    for dims in ((2**31 - 1, 1), (2**31 - 1, 2**31 - 1), (-1, 21), (2**30, 0)):
        yield whole[:at] + np.array(dims, "<i4").tobytes() + whole[at + 8 :]
    for size in (2**32 - 1, 2**31, 2**20):
        yield whole[:132] + np.array(size, "<u4").tobytes() + whole[136:]
    packing = zlib.compressobj(9)
    packed = b"".join([packing.compress(bytes(10**6)) for _ in range(150)]) + packing.flush()
    yield whole[:128] + np.array([15, len(packed)], "<u4").tobytes() + packed
    cells = saved(tmp_path / "cells.mat", y=np.array([1, "a"], dtype=object)).read_bytes()
    at = cells.index(np.array([1, 2], "<i4").tobytes())
    yield cells[:at] + np.array([2**15, 2**15], "<i4").tobytes() + cells[at + 8 :]


def test_a_file_takes_no_more_memory_than_a_trial_could_need(tmp_path):
    path, bombs = tmp_path / "trial.mat", list(of_bombs(tmp_path))
    for bomb in bombs:
        path.write_bytes(bomb)
        tracemalloc.start()
        with pytest.raises(ValueError, match=r"trial\.mat"):
            read_measured(path, TASK)
        assert tracemalloc.get_traced_memory()[1] < 150e6  # the peak: twice the permitted size
        tracemalloc.stop()


def test_what_is_no_mat_file_of_these_versions_says_so(tmp_path):
    path = tmp_path / "trial.mat"
    for content, message in (
        (
            b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM" + bytes(400),
            "of version 7.3; allowed are those saved with -v7",
        ),
        (b"\x89HDF\r\n" + bytes(400), "of version 7.3"),
        (b"t,y\n0,1\n" * 40, "is no MATLAB file of version 5 to 7"),
        (b"", "is no MATLAB file"),
    ):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=message):
            read_measured(path, TASK)
    columns = {"t": TASK.time[:, None], "y": np.zeros((21, 1)), "r": np.array([1j])}
    with pytest.raises(
        ValueError, match="r is complex numbers; allowed are real numbers in 1 columns"
    ):
        read_measured(saved(path, **columns, units={"t": "s", "y": "mm", "r": "mm"}), TASK)
    with pytest.raises(ValueError, match=r"units\.y is no text"):
        read_measured(saved(path, t=columns["t"], y=columns["y"], units={"t": "s", "y": 3.0}), TASK)


# A user without a home
# --------------------------------------------------------------------------------------------------


def test_without_a_home_nothing_is_kept(monkeypatch):
    """An example is a container whose user has no entry in the password file, and no HOME."""

    def nobody(uid):
        raise KeyError(uid)

    monkeypatch.setattr("pwd.getpwuid", nobody)
    for name in ("HOME", "XDG_CACHE_HOME", "JAXILC_CACHE"):
        monkeypatch.delenv(name, raising=False)
    folder = jax.config.jax_compilation_cache_dir
    try:
        jax.config.update("jax_compilation_cache_dir", None)
        assert keep_programs() is None
    finally:
        jax.config.update("jax_compilation_cache_dir", folder)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.toml", "x = 1\ngain = 0,99", "line 2, column 9: found 'gain = 0,99'; .* point, 0.99$"),
        ("a.toml", "g = { low = -1,5e3 } # here", "found 'g = .* here'; .* point, -1.5e3$"),
        (
            "a.json",
            '{"gain": 0,99}',
            "line 1, column 12: found '{\"gain\": 0,99}'; .* point, 0.99$",
        ),
        ("a.toml", "dt = 0.001 s", "column 12: found 'dt = 0.001 s'; expected newline or end of"),
        ("a.toml", "x = [1,2 y", "line 1, column 10: found .*; unclosed array"),
        ("a.toml", "x = [", r"a.toml: Invalid value \(at end of document\)"),
    ],
)
def test_a_text_that_is_no_tree_is_shown_with_what_is_wanted(tmp_path, name, text, message):
    (tmp_path / name).write_text(text)
    with pytest.raises(ValueError, match=message):
        read_tree(tmp_path / name)
