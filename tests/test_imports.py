"""These tests check the order of imports, and the names that users import.

Each family imports from those before it in the map of the package, and from none after it.
"""

import ast
import functools
import importlib
import re
import tomllib
from pathlib import Path

import jaxilc

ROOT = Path(jaxilc.__file__).parent
MAP = (ROOT / "README.md").read_text(encoding="utf-8")
ORDER = re.findall(r"^\| \[(\w+)\]", MAP, re.MULTILINE)  # of the families


@functools.cache
def imports_in(file: Path) -> list[ast.Import | ast.ImportFrom]:
    """Return the statements of a file that import, at its head or within a function."""
    tree = ast.parse(file.read_text(encoding="utf-8"))
    return [node for node in ast.walk(tree) if isinstance(node, ast.Import | ast.ImportFrom)]


def imports_of(file: Path) -> set[str]:
    """Return the families that a file imports from."""
    folder, found = [*file.relative_to(ROOT.parent).parts[:-1]], set()
    for node in imports_in(file):
        if isinstance(node, ast.Import):
            assert not any(name.name.split(".")[0] == "jaxilc" for name in node.names), file
        if isinstance(node, ast.ImportFrom) and node.level:
            base = folder[: len(folder) - node.level + 1] + (node.module or "").split(".")
            base = [name for name in base if name]
            found |= {base[1]} if len(base) > 1 else {name.name for name in node.names}
    return found


def test_every_family_imports_from_those_before_it():
    for file in ROOT.rglob("*.py"):
        family = file.relative_to(ROOT).parts[0].removesuffix(".py")
        if family not in ("__init__", "__main__"):
            allowed = ORDER[: ORDER.index(family) + 1]
            assert imports_of(file) <= set(allowed), f"{file}: {imports_of(file) - set(allowed)}"


def test_the_families_are_all_there_is():
    rooms = {p.name.removesuffix(".py") for p in ROOT.iterdir() if p.suffix == ".py" or p.is_dir()}
    assert rooms - {"__init__", "__main__", "__pycache__"} == set(ORDER)
    folders = {p.name for p in Path(__file__).parent.iterdir() if p.is_dir()} - {"__pycache__"}
    assert folders - {"benchmark"} <= set(ORDER)  # of experiments/benchmark


def test_the_public_names_are_those_of_the_list():
    """A name that is added is listed; one that is renamed stays for one version, with a warning."""
    text = Path(__file__).with_name("public_names.toml").read_text(encoding="utf-8")
    listed = tomllib.loads(text)
    for package, names in listed.items():
        assert sorted(importlib.import_module(package).__all__) == names, package
    folders = {f"jaxilc.{path.parent.name}" for path in ROOT.glob("*/__init__.pyi")}
    assert folders <= listed.keys()


def test_experiments_and_notebooks_import_what_is_there():
    """Few of them run as a test."""
    files = [file for folder in ("experiments", "notebooks") for file in
             (ROOT.parent / folder).rglob("*.py")]  # fmt: skip
    asked = {
        (node.module, name.name)
        for file in files
        for node in imports_in(file)
        if isinstance(node, ast.ImportFrom) and (node.module or "").partition(".")[0] == "jaxilc"
        for name in node.names
    }
    assert len(asked) > 200
    for module, name in sorted(asked):
        found = importlib.import_module(module)
        assert hasattr(found, name) or importlib.import_module(f"{module}.{name}"), (module, name)


def test_no_circle_within_a_family():
    """This holds for imports at the head, for a type checker, and within a function."""
    graph: dict[str, set[str]] = {}
    for file in ROOT.rglob("*.py"):
        folder = file.relative_to(ROOT.parent).parts[:-1]
        here = ".".join([*folder, file.stem])
        for node in imports_in(file):
            if isinstance(node, ast.ImportFrom) and node.level == 1:
                names = [node.module] if node.module else [name.name for name in node.names]
                graph.setdefault(here, set()).update(".".join([*folder, n]) for n in names)

    def reached(start: str) -> set[str]:
        found, todo = set(), [start]
        while todo:
            new = graph.get(todo.pop(), set()) - found
            found |= new
            todo += new
        return found

    circles = {name for name in graph if name in reached(name)}
    assert not circles
