"""Notebooks are executed as notebooks: those that changed lately, and another in turn.

There is no display and no network, no file is left behind, every figure is shown, and no object.
"""

import os
import re
from pathlib import Path

import pytest
from turns import due

NOTEBOOKS = sorted((Path(__file__).parent.parent / "notebooks").glob("*.py"))
LEARNS = re.compile(r"^\w.*\b(learn|run_schemes|certify|reproduce|compare)\(", re.MULTILINE)
LIMIT = 600  # [s] for a cell; far more than a cell takes, for machines that are busy
CELL = re.compile(r"^# %%(?: \[markdown\])?$")
FIRST = """
import socket, warnings

def refuse(*_):
    raise OSError("a notebook asked for the network")

socket.socket.connect = refuse
warnings.simplefilter("error", FutureWarning)
"""
SHOWN = 2, 5, 1, 3, 2, 1, 1, 1, 0, 3, 1, 1, 1, 1, 1, 2, 1, 2, 1  # figures of each notebook
FIGURES = {f"{number:02}": figures for number, figures in enumerate(SHOWN, start=1)}


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


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_section_that_learns_asserts_what_came_out(path):
    sections = re.split(r"^# #+ ", path.read_text(encoding="utf-8"), flags=re.MULTILINE)
    assert any(re.search(r"^ *(assert|np\.testing)", section, re.MULTILINE) for section in sections)
    for section in filter(LEARNS.search, sections):
        title = section.partition("\n")[0]
        assert re.search(r"^ *(assert|np\.testing)", section, re.MULTILINE), title


@pytest.mark.slow
@pytest.mark.parametrize("path", due(NOTEBOOKS, 1), ids=lambda path: path.stem)
def test_runs_as_a_notebook(path, tmp_path):
    jupytext, nbclient, nbformat, _ = (
        pytest.importorskip(name, reason=f"needs {name}: pip install 'jaxilc[notebooks]'")
        for name in ("jupytext", "nbclient", "nbformat", "ipykernel")
    )
    folders = {
        name: tmp_path / name for name in ("TMPDIR", "IPYTHONDIR", "JUPYTER_RUNTIME_DIR", "here")
    }
    for folder in folders.values():
        folder.mkdir()
    here = folders.pop("here")
    environment = {
        name: value for name, value in os.environ.items() if name not in ("DISPLAY", "MPLBACKEND")
    }
    notebook = jupytext.read(path)
    notebook.cells.insert(0, nbformat.v4.new_code_cell(FIRST))
    client = nbclient.NotebookClient(
        notebook, timeout=LIMIT, resources={"metadata": {"path": str(here)}}
    )
    client.execute(env=environment | {name: str(folder) for name, folder in folders.items()})
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", ())]
    assert (
        sum("image/png" in output.get("data", ()) for output in outputs) == FIGURES[path.name[:2]]
    )
    assert [output.text for output in outputs if output.get("name") == "stderr"] == []
    assert not [out for out in outputs if [*out.get("data", ())] == ["text/plain"]], "an object"
    assert list(here.iterdir()) == []
    assert [
        p.name for p in folders["TMPDIR"].iterdir() if not p.name.startswith("matplotlib")
    ] == []
