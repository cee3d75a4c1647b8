"""The links of the guide and the start page lead to pages that exist.

Their Python code passes type checkers as a user's script.
"""

import dataclasses
import importlib
import inspect
import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import tomlkit
from cases import CASES

import jaxilc
from jaxilc.cli.entry import OLD_NAME
from jaxilc.scenarios import file_plant, file_task, from_file
from jaxilc.scenarios.from_file import load_scenario
from jaxilc.scenarios.specification import HIDDEN, classes

ROOT = Path(__file__).parents[1]
DOCS = ROOT / ".ci" / "docs"
CODE = re.compile(r"^```python\n(.*?)^```$", re.MULTILINE | re.DOTALL)
WITH_PYTHON = ["README.md", ".ci/docs/guide/library.md", ".ci/docs/guide/theory.md"]
SHORTEST = """
import numpy as np

from jaxilc import Machine, Task, learn
from jaxilc.plants import DifferenceEquation
from jaxilc.schemes import PIDType

r = np.sin(np.arange(101) / 10)
p = DifferenceEquation((1.6, -0.65), (0.06, 0.03), dt=1e-3)
dt = 1e-3
learn(Machine(p), PIDType(gamma_p=0.5), Task(r, dt), trials=2)
learn(Machine(p), PIDType(gamma_p=np.array(0.5)), Task(list(r), dt), trials=2)
"""
# mypy has read the package and what it imports with the project's settings, so that it reads the
# scripts alone here. What these settings ask of a package, nobody asks of a script.
PACKAGE_ALONE = ("untyped_defs", "incomplete_defs", "untyped_calls", "any_generics")
CONFIG = "pyproject.toml"
CHECKERS = {  # the words before the scripts on the command line
    "mypy": [
        *("--config-file", CONFIG, "--cache-dir", str(ROOT / ".mypy_cache")),
        *("--python-executable", sys.executable),
    ],
    "pyright": ["--pythonpath", sys.executable],
    "ty": ["check", "--quiet", "--python", sys.prefix, "--extra-search-path", str(ROOT)],
}


def code_of(file: str) -> str:
    """Return the Python blocks of a page, one after another."""
    return "\n".join(CODE.findall((ROOT / file).read_text(encoding="utf-8")))


@pytest.fixture(scope="module")
def scripts(tmp_path_factory) -> list[Path]:
    """Return the Python code of each page as one script, and the shortest script of a user."""
    folder = tmp_path_factory.mktemp("scripts")
    texts = [code_of(file) for file in WITH_PYTHON]
    assert all("learn(" in text for text in texts)
    names = [*(Path(file).stem for file in WITH_PYTHON), "shortest"]
    settings = tomllib.loads((ROOT / CONFIG).read_text(encoding="utf-8"))["tool"]["mypy"]
    del settings["files"]
    settings["overrides"].append(
        {"module": names} | {f"disallow_{x}": False for x in PACKAGE_ALONE}
    )
    (folder / CONFIG).write_text(tomlkit.dumps({"tool": {"mypy": settings}}))
    for name, text in zip(names, [*texts, SHORTEST], strict=True):
        (folder / f"{name}.py").write_text(text)
    return sorted(folder.glob("*.py"))


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=[] if n == "ty" else pytest.mark.slow) for n in CHECKERS]
)
def test_a_users_script_passes_type_checkers(name, scripts):
    beside = Path(sys.executable).parent / name
    checker = str(beside) if beside.exists() else shutil.which(name)
    if checker is None:  # mypy and ty are among the pinned versions; pyright needs Node.js
        pytest.skip(f"needs {name}: pip install {name}, or npm install --global pyright")
    path = {"MYPYPATH": str(ROOT), "PYTHONPATH": str(ROOT)}
    found = subprocess.run(
        [checker, *CHECKERS[name], *map(str, scripts)], cwd=scripts[0].parent,
        env=os.environ | path, capture_output=True, text=True,
    )  # fmt: skip
    assert found.returncode == 0, found.stdout + found.stderr


def test_the_shortest_script_of_a_user_runs():
    exec(SHORTEST, {})


def test_what_the_guide_changes_in_the_file_of_init_is_there():
    """A command on `axis.toml` names values that the file which `jaxilc init` writes has."""
    known = load_scenario(Path(jaxilc.scenarios.__file__).with_name("axis.toml")).settable()
    sources = [ROOT / "README.md", *DOCS.glob("guide/*.md"), *ROOT.glob("jaxilc/cli/*.py")]
    text = "\n".join(file.read_text(encoding="utf-8") for file in sources)
    lines = "\n".join(re.findall(r"jaxilc [a-z-]+ axis\.toml\b.*", text))
    named = re.findall(r"--(?:vary|grid|set) '?([^\s=]+)=", lines)
    assert {re.sub(r"\[\d\]", "", path) for path in named} <= set(known)
    assert len(named) > 4


def test_no_page_and_no_notebook_names_an_option_that_help_does_not():
    for file in [ROOT / "README.md", *DOCS.glob("**/*.md"), *ROOT.glob("notebooks/*.py")]:
        assert OLD_NAME not in file.read_text(encoding="utf-8"), file


@pytest.fixture
def pages(monkeypatch):
    """Return the module that writes the guide, which is outside the package."""
    monkeypatch.syspath_prepend(str(DOCS))
    return importlib.import_module("pages")


def test_every_link_of_the_guide_leads_somewhere(pages):
    found = {file: pages.links(file) for file in pages.PAGES}
    assert len(found["README.md"]) >= 8
    read = {leads for links in found.values() for _, leads, _ in links} | {"CHANGELOG.md"}
    assert set(pages.PAGES) <= read | {"README.md"}, "a page that no other page leads to"


def test_a_broken_link_is_refused(pages, monkeypatch, tmp_path):
    monkeypatch.setattr(pages, "ROOT", tmp_path)
    (tmp_path / "a.md").write_text("# A\n\n[b](b.md)\n")
    with pytest.raises(
        ValueError, match=r"a\.md: the link b\.md leads to b\.md, which is not there"
    ):
        pages.links("a.md")
    (tmp_path / "b.md").write_text("# The b\n")
    assert pages.links("a.md") == [("b.md", "b.md", "")]
    (tmp_path / "a.md").write_text("# A\n\n[b](b.md#the-c)\n")
    with pytest.raises(ValueError, match=r"b\.md#the-c leads to a heading that is not there"):
        pages.links("a.md")


@pytest.mark.parametrize("lost", ["% away, by", "  % away", "- % away", "> % away"])
def test_a_line_that_a_page_would_lose_is_refused(lost, pages, monkeypatch, tmp_path):
    monkeypatch.setattr(pages, "ROOT", tmp_path)
    monkeypatch.setattr(pages, "PAGES", {"a.md": "a"})
    kept = "# A\n\nTuning takes 4 % away.\n\n```matlab\n% of a program\n```\n"
    (tmp_path / "a.md").write_text(kept)
    assert pages.linked("a.md") == kept
    (tmp_path / "a.md").write_text(f"{kept}\nTuning takes these 4\n{lost}\n")
    with pytest.raises(ValueError, match=rf"a\.md: the line '{lost}' begins with %, and pages"):
        pages.linked("a.md")


def test_no_page_and_no_notebook_loses_a_line(pages):
    assert all(pages.linked(file) for file in pages.PAGES)
    for path in ROOT.glob("notebooks/*.py"):
        text = path.read_text(encoding="utf-8")
        for cell in re.findall(r"^# %% \[markdown\]\n((?:#.*\n)+)", text, re.MULTILINE):
            assert not re.search(r"^# *%", cell, re.MULTILINE), path.name


def test_a_page_loads_nothing_from_elsewhere(pages, tmp_path):
    """A link that is clicked may lead to another site; what a page loads by itself may not."""
    page = tmp_path / "a.html"
    page.write_text('<a href="https://example.org">x</a><a href="#b">y</a><p id="b"></p>')
    pages.check_built(tmp_path)
    page.write_text('<script src="https://cdn.example.org/x.js"></script>')
    with pytest.raises(ValueError, match=r"a\.html loads https://cdn\.example\.org/x\.js"):
        pages.check_built(tmp_path)
    page.write_text('<a href="#c">y</a>')
    with pytest.raises(ValueError, match="the link #c leads to an anchor not there"):
        pages.check_built(tmp_path)


def test_docstrings_become_pages_as_they_are_written(monkeypatch):
    """A formula stays a block, fields become a list, and signs of markup stay text."""
    monkeypatch.syspath_prepend(str(DOCS))
    plain = importlib.import_module("plain_docstrings")
    text = """The error: |e| * 2 of `dt`.

        y = a * x   (eq. 1)

    dt: sample time [s]; a line
        that goes on
    u_, y: signals
    Raises ValueError."""
    assert plain.as_rst(text) == [
        "The error: \\|e\\| \\* 2 of ``dt``.", "", "::", "", "        y = a * x   (eq. 1)", "",
        "``dt``", "    sample time [s]; a line that goes on", "``u_, y``", "    signals", "",
        "Raises ValueError.", "",
    ]  # fmt: skip


def test_the_file_that_init_writes_is_the_start_page_s_example():
    """The plant file of `jaxilc init` has the content of the start page's, less the comments."""
    written = (ROOT / "jaxilc/scenarios/axis.toml").read_text(encoding="utf-8")
    shown = re.findall(r"^```toml\n(.*?)^```$", (ROOT / "README.md").read_text(), re.M | re.S)
    assert tomllib.loads(written) == tomllib.loads(shown[0])
    assert max(map(len, written.splitlines())) <= 100


def test_the_page_of_plant_files_has_every_class_and_field(monkeypatch, tmp_path):
    monkeypatch.syspath_prepend(str(DOCS))
    page = tmp_path / "plant_file.md"
    importlib.import_module("plant_file").extend(page)
    parts = page.read_text(encoding="utf-8").split("\n### ")[1:]
    rows = {part.partition("\n")[0]: set(re.findall(r"^\| `(\w+)`", part, re.M)) for part in parts}
    assert set(rows) == set(classes())
    for name, cls in classes().items():
        fields = {field.name for field in dataclasses.fields(cls) if field.init}
        assert rows[name] == fields - set(HIDDEN), name


READERS = (from_file.read_scenario, file_plant.plant_of, file_task.machine_of, file_task.task_of)


def test_the_page_of_plant_files_has_every_key():
    text = (DOCS / "guide" / "plant_file.md").read_text(encoding="utf-8")
    named = set(re.findall(r"\w+", " ".join(re.findall(r"`([^`]*)`", text))))
    sources = "".join(map(inspect.getsource, (*READERS, file_task._reference)))
    keys = {*re.findall(r'take\(\s*"(\w+)"', sources)}
    keys |= {*re.findall(r'"(\w\w+)"', inspect.getsource(file_plant._identified))}
    assert {"windows", "csv", "averages", "allow_unstable", "variation"} < keys
    assert keys <= named, keys - named


def test_every_public_name_is_there():
    for name in jaxilc.__all__:
        assert getattr(jaxilc, name) is not None


def test_the_start_page_is_short():
    lines = (ROOT / "README.md").read_text(encoding="utf-8").splitlines()
    assert len(lines) <= 150
    assert max(map(len, lines)) <= 100


def test_files_that_the_pages_name_are_there():
    """They are paths such as `jaxilc/cli/entry.py` or `experiments/...py` in backquotes."""
    for file in [*DOCS.glob("guide/*.md"), ROOT / "README.md", ROOT / ".github/CONTRIBUTING.md"]:
        text = file.read_text(encoding="utf-8")
        named = re.findall(r"`((?:jaxilc|tests|experiments|notebooks|\.ci)/[\w./]*)`", text)
        for path in named:
            if "NAME" not in path:
                assert (ROOT / path).exists(), f"{file.name} names {path}"


@pytest.mark.parametrize("name", ["quick", "shipped"])
def test_listed_tests_are_there(name):
    """Each entry of a list in pyproject.toml is a file, a case of one, or a test that it has."""
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    listed = settings["tool"]["pytest"]["ini_options"][name]
    assert len(listed) == len(set(listed))
    for entry in listed:
        file, _, test = entry.removeprefix("not ").partition("[")[0].partition("::")
        assert (ROOT / file).exists(), entry
        assert not test or f"def {test}(" in (ROOT / file).read_text(encoding="utf-8"), entry
        assert "[" not in entry or entry.split("[")[1].rstrip("]") in CASES, entry
