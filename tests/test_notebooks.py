"""The notebooks, each run as the script that it is: no display, no network, nothing left behind, every figure drawn."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

NOTEBOOKS = sorted((Path(__file__).parent.parent / "notebooks").glob("*.py"))
QUICK = ("01", "06", "07")  # each about 10 s on a quiet core
LIMIT = 600  # s; far above what one takes, for machines that are busy
CELL = re.compile(r"^# %%(?: \[markdown\])?$")
# Runs a notebook without a socket, then draws every figure that it left in a variable, and prints how many.
PROGRAM = """
import runpy, socket, sys
import numpy as np
from matplotlib.axes import Axes

def refuse(*_):
    raise OSError("a notebook asked for the network")

socket.socket.connect = refuse
left = runpy.run_path(sys.argv[1], run_name="__main__")
arrays = [np.ravel(v) for v in left.values() if isinstance(v, (Axes, np.ndarray))]
figures = {id(a.figure): a.figure for array in arrays if array.dtype == object for a in array if isinstance(a, Axes)}
for figure in figures.values():
    figure.canvas.draw()
print("figures drawn:", len(figures))
"""
FIGURES = {"01": 2, "02": 2, "03": 1, "04": 2, "05": 1, "06": 1, "07": 1, "08": 1, "09": 0}


def test_the_nine_are_there():
    assert [path.name[:2] for path in NOTEBOOKS] == sorted(FIGURES)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_cells_are_those_of_the_percent_format(path):
    text = path.read_text(encoding="utf-8")
    assert text.startswith("# ---\n# jupyter:\n#   jupytext:\n")
    _, head, *lines = re.split(r"^# ---\n", text, maxsplit=2, flags=re.MULTILINE)
    assert "format_name: percent" in head
    lines = "".join(lines).splitlines()
    cells = [i for i, line in enumerate(lines) if line.startswith("# %%")]
    assert all(CELL.match(lines[i]) for i in cells)
    assert lines[cells[0]] == "# %% [markdown]"
    assert lines[cells[0] + 1].startswith("# # ")  # a title
    for start, stop in zip(cells, [*cells[1:], len(lines)], strict=True):
        body = [line for line in lines[start + 1 : stop] if line]
        assert body
        if lines[start].endswith("[markdown]"):
            assert all(line.startswith("#") for line in body)


@pytest.mark.parametrize(
    "path", [pytest.param(p, marks=[] if p.name[:2] in QUICK else pytest.mark.slow) for p in NOTEBOOKS], ids=lambda path: path.stem
)
def test_runs_as_a_script(path, tmp_path):
    here, temporary = tmp_path / "here", tmp_path / "temporary"
    here.mkdir()
    temporary.mkdir()
    environment = os.environ | {"MPLBACKEND": "agg", "TMPDIR": str(temporary)}
    environment.pop("DISPLAY", None)
    command = [sys.executable, "-W", "error::FutureWarning", "-c", PROGRAM, str(path)]
    done = subprocess.run(command, cwd=here, env=environment, capture_output=True, text=True, timeout=LIMIT)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-4000:]
    assert done.stdout.splitlines()[-1] == f"figures drawn: {FIGURES[path.name[:2]]}"
    assert list(here.iterdir()) == []
    assert [p.name for p in temporary.iterdir() if not p.name.startswith("matplotlib")] == []
