"""`make matrix`: a Python that is missing is named, and speed stands side by side."""

import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path
from types import SimpleNamespace

import by_environment
import pytest
from timing import OURS

ROOT = Path(__file__).parents[2]


def test_speed_stands_side_by_side_with_the_median_ratio_of_the_turns():
    turns = [
        [("one", {"run": one}), ("other", {"run": other})]
        for one, other in ((2.0, 3.0), (4.0, 4.0), (8.0, 20.0))
    ]
    head, row = by_environment.table(turns)
    assert head.split()[-2:] == ["one", "other"]
    assert row.split() == ["run", "2.00", "(1.00)", "3.00", "(1.50)"]


@pytest.mark.thorough
def test_an_environment_measures_runs_and_gradients(monkeypatch):
    rows = {OURS: 2.0, "1 weight forward": 6.0, "2 weights reverse": 5.0}
    took = {name: SimpleNamespace(cpu=cpu) for name, cpu in rows.items()}
    monkeypatch.setattr("gradients.compare_gradients", lambda setting, opponents: took)
    name, found = by_environment.measured(2, 2, 20)
    assert name.startswith(f"Python {sys.version.split()[0]}, JAX 0.")
    assert found == {"cfdl": 2.0, "cfdl gradient": 5.0, "ffdl": 2.0, "ffdl gradient": 5.0}


def run_matrix(
    folder: Path, script: Path = ROOT / ".ci" / "matrix", **named: str
) -> subprocess.CompletedProcess:
    """Run the matrix where each Python on PATH is a shim that does not run, as pyenv has some."""
    for version in ("3.11", "3.12", "3.13"):
        shim = folder / f"python{version}"
        shim.write_text("#!/bin/sh\nexit 127\n")
        shim.chmod(0o755)
    return subprocess.run(
        [script],
        env={"PATH": f"{folder}:/usr/bin:/bin", "PYENV_ROOT": str(folder), **named},
        capture_output=True,
        text=True,
        timeout=60,
    )


@pytest.mark.skipif(os.name == "nt", reason="the matrix is a script for a POSIX shell")
def test_a_python_that_is_missing_is_named_and_a_matrix_without_lines_fails(tmp_path):
    found = run_matrix(tmp_path)
    assert found.stdout.splitlines() == [
        f"Python 3.{minor} is left out: no interpreter (PYTHON3_{minor} names one)"
        for minor in (11, 12, 13)
    ]
    assert found.returncode != 0


@pytest.mark.skipif(os.name == "nt", reason="the matrix is a script for a POSIX shell")
@pytest.mark.parametrize("named", ["/nonexistent", sys.executable], ids=["none", "another version"])
def test_a_named_python_that_is_not_of_its_version_stops_the_matrix(named, tmp_path):
    """Else another one would be tested silently in its place. All are looked at before any runs."""
    version = "3.13" if sys.version_info[:2] != (3, 13) else "3.12"
    variable = f"PYTHON{version.replace('.', '_')}"
    found = run_matrix(tmp_path, **{variable: named})
    assert found.returncode != 0
    assert found.stdout == ""
    assert found.stderr.startswith(f"{variable} is {named}, which does not run as Python {version}")


@pytest.mark.skipif(os.name == "nt", reason="the matrix is a script for a POSIX shell")
def test_an_environment_of_another_interpreter_is_made_anew(tmp_path):
    """It was kept, and tests ran with the old one."""
    shutil.copytree(ROOT / ".ci", tmp_path / ".ci")
    one, other, make = (tmp_path / name for name in ("one", "other", "make"))
    for python in (one, other):
        python.write_text(f"#!/bin/sh\ncase $2 in *base_prefix*) echo {python.name};; esac\n")
    make.write_text('#!/bin/sh\neval "$2" "$4"; mkdir -p $VENV/bin; cp -n $PYTHON $VENV/bin/python')
    for program in (one, other, make):
        program.chmod(0o755)
    home = tmp_path / ".matrix" / "3.13"
    for python, kept in ((one, False), (one, True), (other, False)):
        found = run_matrix(tmp_path, tmp_path / ".ci" / "matrix", PYTHON3_13=str(python))
        assert found.returncode == 0, found.stderr
        assert (home / "bin" / "python").read_text() == python.read_text()
        assert (home / "kept").exists() == kept
        (home / "kept").touch()


def test_the_other_lists_replace_packages_of_the_pinned_one():
    """The versions of JAX are those that pyproject.toml says are tested, the oldest its bounds."""
    pinned, newest, oldest = (
        dict(line.split("==") for line in (ROOT / ".ci" / name).read_text().split())
        for name in ("requirements.txt", "requirements-newest.txt", "requirements-oldest.txt")
    )
    assert newest.keys() - pinned.keys() == {"msgspec"}  # which that Zarr needs
    assert oldest.keys() < pinned.keys()
    text = (ROOT / "pyproject.toml").read_text()
    assert f'"jax>=0.10.2,!=0.11.1",  # tested: {pinned["jax"]} and {newest["jax"]};' in text
    project = tomllib.loads(text)["project"]
    extras = project["optional-dependencies"]
    used = [one for name, some in extras.items() if name not in ("test", "docs") for one in some]
    versions_of = {name.lower(): version for name, version in oldest.items()}
    for one in (*project["dependencies"], *used):
        name, least = re.match(r"([\w-]+)>=([\d.]+)", one).groups()
        if name in versions_of:
            assert re.fullmatch(rf"{re.escape(least)}(\.0)*", versions_of[name])
        else:
            assert name in ("jupytext", "nbclient", "nbconvert", "ipykernel")
    versions = {one.rpartition(" ")[2] for one in project["classifiers"]}
    assert {"3.11", "3.12", "3.13"} <= versions
