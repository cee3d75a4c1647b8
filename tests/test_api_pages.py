"""Each public class and function has an example on the pages of the API, which prints what it says.

The signatures of these pages are such that a person can read them.
"""

import importlib
import inspect
import os
import tomllib
from pathlib import Path

import pytest
from test_examples import parts_of, printed_by
from turns import due

ROOT = Path(__file__).parents[1]
DOCS = ROOT / ".ci" / "docs"
FILES = sorted((DOCS / "examples").glob("*.py"))
PUBLIC = tomllib.loads((ROOT / "tests/public_names.toml").read_text(encoding="utf-8"))


@pytest.fixture
def api(monkeypatch):
    """Return the module that writes the pages, which is outside the package."""
    monkeypatch.syspath_prepend(str(DOCS))
    return importlib.import_module("api")


@pytest.mark.parametrize("file", due(FILES, 1), ids=lambda file: file.stem)
def test_an_example_prints_what_the_page_says(file, api, compiled_once, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    begin, examples = api.examples_of(file.stem)
    known: dict = {}
    exec(begin, known)
    for example in examples:
        if not example.slow or os.environ.get("JAXILC_ALL") == "1":
            for code, said in parts_of(example.code):
                assert printed_by(lambda code=code: exec(code, known)) == said, example.names


def shown_by(api, family):
    """Return the names that have an example on the page of a family, in which they occur."""
    _, examples = api.examples_of(family)
    for example in examples:
        for name in example.names:
            assert name in example.code, f"{family}: the example of {name} does not name it"
    return {name for example in examples for name in example.names}


def test_the_source_of_each_public_name_has_a_page():
    """What a class has of Python itself, such as a default that is a type, would have none."""
    for family, names in PUBLIC.items():
        for name in names:
            one = getattr(importlib.import_module(family), name)
            of = [one, *(getattr(one, n) for n in dir(one) if n[0] != "_" and inspect.isclass(one))]
            assert "builtins" not in {getattr(part, "__module__", "") for part in of}, name


def test_each_public_class_and_function_has_an_example(api):
    """One that several families have needs it once."""
    shown = {family: shown_by(api, family) for family in PUBLIC}
    told = {id(getattr(importlib.import_module(f), n)) for f, names in shown.items() for n in names}
    for family, names in PUBLIC.items():
        module = importlib.import_module(family)
        assert shown[family] <= {*names}, "an example of a name that is not public"
        needed = {name: getattr(module, name) for name in names}
        without = {n for n, one in needed.items() if callable(one) and id(one) not in told}
        assert not without, f"{family}: without an example"


def test_a_signature_can_be_read(api):
    """No address, no class of Python's insides and no type stands in it."""
    for family, names in PUBLIC.items():
        module = importlib.import_module(family)
        for found in (getattr(module, name) for name in names):
            if inspect.isfunction(found) or inspect.isclass(found):
                parameters, _ = api.signature(found) or ("()", None)
                assert not {"<", ">", ": "} & {*parameters}, parameters
                assert "_MISSING" not in parameters
    from jaxilc import Sweep, learn

    assert api.signature(learn)[0].startswith("(machine, scheme, task, trials, *, key=None,")
    assert "machines=1024, seed=0, sampling='monte-carlo'" in api.signature(Sweep)[0]
