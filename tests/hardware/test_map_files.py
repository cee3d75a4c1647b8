"""Maps in files for machines: each reads back, and C compiles it."""

import re
import shutil
import subprocess

import numpy as np
import pytest

from jaxilc.hardware import read_map, write_map
from jaxilc.plants import Harmonics, PositionMap, Splines

X = np.linspace(-1.0, 12.3, 57)
WEIGHTS = np.random.default_rng(0).normal(size=12) * 10.0 ** np.arange(-8, 4)
MAP = PositionMap(Splines(0.0, 12.0, 6), WEIGHTS, turning=0.3)


@pytest.mark.parametrize("suffix", [".comp", ".csv", ".st", ".h"])
def test_a_map_reads_back_to_the_last_digit(suffix, tmp_path):
    path = tmp_path / f"map{suffix}"
    write_map(path, MAP, X)
    found = read_map(path)
    forward, backward = (PositionMap(MAP.functions, w).at(X) for w in np.split(WEIGHTS, 2))
    np.testing.assert_array_equal(found.position, X)
    np.testing.assert_allclose(found.forward, forward, rtol=1e-12)
    np.testing.assert_allclose(found.backward, backward, rtol=1e-12)
    same = PositionMap(Harmonics(12.0, (1,)), (1.0, 2.0))
    one = write_map(path, same, X)
    np.testing.assert_array_equal(one.forward, one.backward)
    path.write_text("nothing\n")
    with pytest.raises(ValueError, match=r"has no rows of position, forward, backward"):
        read_map(path)


def test_linuxcnc_reads_each_line_as_three_numbers(tmp_path):
    """As `sscanf(line, "%lf %lf %lf")`, which ends at the first line that is none."""
    path = tmp_path / "x.comp"
    table = write_map(path, MAP, X)
    lines = [list(map(float, line.split())) for line in path.read_text().splitlines()]
    np.testing.assert_array_equal(lines, np.column_stack(table))


@pytest.mark.thorough
def test_linuxcnc_comes_to_the_commanded_position(tmp_path):
    """A screw with an error and backlash, under what LinuxCNC makes of the file by its type."""

    def screw(x, way):
        return x + 0.02 * np.sin(2 * np.pi * x / 5.0) - 0.01 * way

    place = np.linspace(0, 10, 200)
    undo = [place - screw(place, way) for way in (1, -1)]
    learned = PositionMap(Splines(0.0, 10.0, 200, degree=1), np.concatenate(undo), turning=0.1)
    write_map(tmp_path / "x.comp", learned, place[::2])
    rows = np.loadtxt(tmp_path / "x.comp")
    x = np.linspace(-0.5, 10.5, 333)
    for kind, most in ((1, 1e-3), (0, np.inf)):
        for way, column in ((1, 1), (-1, 2)):
            trims = rows[:, column] if kind else rows[:, 0] - rows[:, column]
            trim = np.interp(x, rows[:, 0], trims.astype(np.float32))
            off = np.abs(screw(x + trim, way) - x)[(x > 0) & (x < 10)]
            assert np.max(off) < most
    assert np.max(off) > 0.1  # a file of type 1 read as one of type 0, which is the default


@pytest.mark.thorough
def test_a_table_in_structured_text_is_what_the_language_takes(tmp_path):
    """As IEC 61131-3 writes it: a real literal has a point, and the range holds all."""
    table = write_map(tmp_path / "map.st", MAP, np.r_[X, 1e5, 1e22])
    text = (tmp_path / "map.st").read_text().split("\n")
    assert text[0] == "VAR_GLOBAL CONSTANT"
    assert text[-2:] == ["END_VAR", ""]
    declared = r" *map_(\w+) : ARRAY\[0\.\.(\d+)\] OF LREAL := \[(.*)\];"
    for line, name, values in zip(text[1:-2], table._fields, table, strict=True):
        found = re.fullmatch(declared, line)
        assert found
        literals = found[3].split(", ")
        assert all(re.fullmatch(r"[+-]?\d+\.\d+([Ee][+-]?\d+)?", one) for one in literals)
        assert (found[1], int(found[2])) == (name, len(values) - 1)
        np.testing.assert_array_equal(np.array(literals, float), values)


@pytest.mark.skipif(shutil.which("cc") is None, reason="no compiler of C")
def test_a_program_in_c_sees_the_same_numbers(tmp_path):
    table = write_map(tmp_path / "map.h", MAP, X)
    (tmp_path / "main.c").write_text(
        '#include <stdio.h>\n#include "map.h"\nint main(void) {\n'
        "  for (int i = 0; i < JAXILC_MAP; i++)\n"
        '    printf("%.17g %.17g %.17g\\n", jaxilc_map_position[i], jaxilc_map_forward[i],\n'
        "           jaxilc_map_backward[i]);\n  return 0;\n}\n"
    )
    made = tmp_path / "main"
    subprocess.run(
        ["cc", "-std=c99", "-Wall", "-Werror", "-o", made, tmp_path / "main.c"], check=True
    )
    said = subprocess.run([made], capture_output=True, text=True, check=True).stdout
    np.testing.assert_array_equal(np.loadtxt(said.splitlines()), np.column_stack(table))


def test_what_does_not_fit_is_said(tmp_path):
    with pytest.raises(ValueError, match=r"is none of the formats \.comp, \.csv, \.st, \.h"):
        write_map(tmp_path / "map.txt", MAP, X)
    with pytest.raises(ValueError, match=r"300 positions for x\.comp; LinuxCNC keeps no more than"):
        write_map(tmp_path / "x.comp", MAP, np.arange(300))
    with pytest.raises(ValueError, match=r"positions of shape \(2,\); allowed are"):
        write_map(tmp_path / "x.csv", MAP, [1.0, 1.0])
    with pytest.raises(ValueError, match="the folder does not exist"):
        write_map(tmp_path / "no" / "x.csv", MAP, X)
    assert not list(tmp_path.iterdir())
