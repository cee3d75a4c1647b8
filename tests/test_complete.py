"""What is added is added everywhere: the lists of `.github/CONTRIBUTING.md` agree.

`PLACES` has what a place must name, and what it names. The second half of this file adds a thing of
each kind, and sees that each place where it is forgotten says so.
"""

import ast
import contextlib
import dataclasses
import functools
import importlib
import inspect
import pkgutil
import re
import runpy
from collections import namedtuple
from pathlib import Path
from typing import get_args

import cases
import pytest
import test_imports
from typer.main import get_command

import jaxilc
from jaxilc import filters, plants, scenarios, schemes, uncertainty
from jaxilc.cli import app, options
from jaxilc.filters import Filter
from jaxilc.learning import known_metrics
from jaxilc.learning.divergence import Course
from jaxilc.learning.known_metrics import Metric
from jaxilc.outcomes import terms
from jaxilc.plants import Plant
from jaxilc.pytree import pytree
from jaxilc.scenarios import file_task
from jaxilc.schemes import Basis, Scheme
from jaxilc.signals import references
from jaxilc.tuning import objectives, risks
from jaxilc.tuning.objectives import Objective
from jaxilc.tuning.risks import Risk

ROOT = Path(__file__).parents[1]
GUIDE = ".ci/docs/guide"
MADE = {"ForcedServo", "NonlinearSystem"}  # by another plant and by `from_control`, never by name
NO_REFERENCE = {"SCurveMove", "s_curve_move", "m_sequence"}  # a part of one, and an input
OF_COURSE = {*Course._fields, "best_trial"}  # metrics that follow from those of several trials


def files(pattern):
    """Return the files of the repository that match."""
    return sorted(ROOT.glob(pattern))


@functools.cache
def said(*patterns, form="{}"):
    """Return all names in the files, as whole words, with quotes or the like where asked for."""
    text = "\n".join(path.read_text(encoding="utf-8") for one in patterns for path in files(one))
    return set(re.findall(form.format(r"(?<![\w-])([\w-]+)(?![\w-])"), text))


@functools.cache
def of_file(file, name):
    """Return a list of a module that is no part of the package."""
    return runpy.run_path(str(ROOT / file))[name]


@functools.cache
def load_all(room):
    for module in pkgutil.iter_modules(room.__path__):
        importlib.import_module(f"{room.__name__}.{module.name}")


def defined_in(room, *bases):
    """Return the names of all subclasses in the modules of a family, but for private ones."""
    load_all(room)
    found, todo = set(), [*bases]
    while todo:
        cls = todo.pop()
        todo += cls.__subclasses__()
        if cls.__module__.startswith(f"{room.__name__}.") and "__dataclass_fields__" in vars(cls):
            found.add(cls.__name__)
    return {name for name in found - MADE if not name.startswith("_")}


def public(*rooms):
    """Return the names of the public classes of families that can be built."""
    named = {name: getattr(room, name) for room in rooms for name in room.__all__}
    return {name for name, one in named.items() if dataclasses.is_dataclass(one)}


def parts_of(tree):
    """Return the names of all classes within a plant or a scheme."""
    if dataclasses.is_dataclass(tree):
        values = [getattr(tree, field.name) for field in dataclasses.fields(tree)]
        return {type(tree).__name__}.union(*map(parts_of, values))
    return set().union(*map(parts_of, tree)) if isinstance(tree, tuple | list) else set()


@functools.cache
def in_cases():
    """Return the names of all classes that get the generic tests."""
    return set().union(*map(parts_of, (*cases.PLANTS.values(), *cases.SCHEMES.values())))


def by_case():
    """Return the names of the plants that tests of plants call by their entry in cases.py."""
    called = said("tests/plants/*.py", form='"{}"')
    return {type(plant).__name__ for name, plant in cases.PLANTS.items() if name in called}


def scenario_modules():
    """Return the functions that return a scenario and have the name of their module."""
    texts = {path.stem: path.read_text(encoding="utf-8") for path in files("jaxilc/scenarios/*.py")}
    made = r"^def {}\([^)]*\) -> Scenario:"
    return {name for name, text in texts.items() if re.search(made.format(name), text, re.M)}


def scenario_functions():
    return {function.__name__ for function in scenarios.SCENARIOS.values()}


def commands():
    return commands_of(tuple(app.registered_commands))


@functools.cache
def commands_of(registered):
    return get_command(app).commands


def with_verdict():
    """Return the commands that tell of an outcome, or print a verdict of their own."""
    called = {name: inspect.getsource(inspect.unwrap(c.callback)) for name, c in commands().items()}
    tells = r"(tell|present|verdict|_close)\("
    return {name for name, text in called.items() if re.search(tells, text)}


def kinds_of(base):
    """Return the objectives or the risks; a sum is none of its own."""
    found = [one for one in base.__subclasses__() if one.__module__ == base.__module__]
    return {one.__name__: one for one in found if one is not objectives.Sum}


def forms(listed):
    """Return the terms of the command line by name, with a number where they take one."""
    numbered = {form.partition("[")[0].partition(":")[0]: form for form in listed.split(", ")}
    return {name: f"{name}:0.5" if ":" in form else name for name, form in numbered.items()}


def read_terms():
    """Return the objectives by the names of their terms, but for terms that cannot be read."""

    def read(term):
        whole = term.replace("0.5", "1")  # a number of a trial
        return terms.objective_of(whole, "rms", lambda _: 1.0).terms[0][1]

    return readable(read, terms.OBJECTIVES)


def read_risks():
    return readable(terms.risk_of, terms.RISKS)


def readable(read, listed):
    found = {}
    for name, term in forms(listed).items():
        with contextlib.suppress(ValueError):
            found[name] = read(term)
    return found


def classes(made):
    return {type(one).__name__ for one in made}


def numbers_of_objectives():
    """Return the fields of objectives that are numbers."""
    fields = [f for kind in kinds_of(Objective).values() for f in dataclasses.fields(kind)]
    return {field.name for field in fields if re.match(r"int|float", str(field.type))}


def distributions():
    """Return the names of all distributions."""
    return {n for n, one in vars(uncertainty).items() if hasattr(one, "spread")} - {"np", "jnp"}


def metrics():
    return {metric.name for metric in known_metrics.METRICS}


def notebooks():
    return {path.name[:2] for path in files("notebooks/*.py")}


CONSTRUCTORS = "tests/learning/test_fuzz_constructors.py"
PLACES = {
    # plants, schemes, filters
    "plants/__init__.py": lambda: (defined_in(plants, Plant), plants.__all__),
    "schemes/__init__.py": lambda: (defined_in(schemes, Scheme, Basis), schemes.__all__),
    "filters/__init__.pyi": lambda: (defined_in(filters, Filter), filters.__all__),
    "tests/cases.py": lambda: (public(plants, schemes, filters), in_cases()),
    "tests/plants": lambda: (public(plants), said("tests/plants/*.py") | by_case()),
    "tests/schemes": lambda: (public(schemes), said("tests/schemes/*.py")),
    "tests/filters": lambda: (public(filters), said("tests/filters/*.py")),
    "contents.md": lambda: (
        public(plants, schemes, filters).union(
            scenarios.SCENARIOS, file_task.REFERENCES, file_task.DISTRIBUTIONS
        ),
        said(f"{GUIDE}/contents.md", form="`{}`"),
    ),
    # scenarios
    "SCENARIOS of from_file.py": lambda: (scenario_modules(), scenario_functions()),
    "scenarios/__init__.pyi": lambda: (scenario_functions(), scenarios.__all__),
    "LISTED of catalogue.py": lambda: (scenarios.SCENARIOS, scenarios.LISTED),
    "tests/scenarios": lambda: (scenarios.SCENARIOS, said("tests/scenarios/*.py", form='"{}"')),
    "experiments, notebooks": lambda: (
        scenarios.SCENARIOS,
        said("experiments/*.py", "notebooks/*.py"),
    ),
    # commands
    "COMMANDS of entry.py": lambda: (
        said("jaxilc/cli/*.py", form=r"Example: jaxilc (?:--quiet )?{}"),
        commands(),
    ),
    "an example in its help": lambda: (
        commands(),
        {name for name, one in commands().items() if f"Example: jaxilc {name}" in one.help},
    ),
    "a verdict": lambda: ({*commands()} - {"explore"}, with_verdict()),
    "COMMANDS of test_fuzz_commands.py": lambda: (
        commands(),
        {words[0] for words in of_file("tests/cli/test_fuzz_commands.py", "COMMANDS")},
    ),
    "tests/cli": lambda: (commands(), said("tests/cli/test_[!f]*.py", "tests/cli/test_filter*.py")),
    "command_line.md": lambda: (commands(), said(f"{GUIDE}/command_line.md", form="jaxilc {}")),
    # objectives and risks
    "TERMS of terms.py": lambda: (kinds_of(Objective), classes(read_terms().values())),
    "objective_of of terms.py": lambda: (forms(terms.OBJECTIVES), read_terms()),
    "RISKS of terms.py": lambda: (kinds_of(Risk), classes(read_risks().values())),
    "risk_of of terms.py": lambda: (forms(terms.RISKS), read_risks()),
    "_RANGES of objectives.py": lambda: (numbers_of_objectives(), objectives._RANGES),
    "OBJECTIVES of test_fuzz_constructors.py": lambda: (
        {
            name
            for base in (Objective, Risk)
            for name, kind in kinds_of(base).items()
            if dataclasses.fields(kind)
        },
        classes(of_file(CONSTRUCTORS, "OBJECTIVES")),
    ),
    "test_slopes.py": lambda: (kinds_of(Objective), said("tests/learning/test_slopes.py")),
    "test_tuning.py": lambda: (kinds_of(Risk), said("tests/tuning/test_tuning.py")),
    "test_cli_tuning.py": lambda: (
        forms(f"{terms.OBJECTIVES}, {terms.RISKS}"),
        said("tests/cli/test_cli_tuning.py"),
    ),
    # metrics
    "Metrics of known_metrics.py": lambda: (metrics() - OF_COURSE, known_metrics.Metrics._fields),
    "METRICS of known_metrics.py": lambda: (
        OF_COURSE.union(known_metrics.Metrics._fields),
        metrics(),
    ),
    "tests/learning": lambda: (metrics(), said("tests/learning/test_*.py")),
    # references, distributions, samplings
    "REFERENCES of file_task.py": lambda: (
        {*references.__all__} - NO_REFERENCE,
        file_task.REFERENCES,
    ),
    "test_references.py": lambda: (references.__all__, said("tests/signals/test_references.py")),
    "Distribution of uncertainty.py": lambda: (
        distributions(),
        {one.__name__ for one in get_args(uncertainty.Distribution)},
    ),
    "DISTRIBUTIONS of file_task.py": lambda: (
        distributions(),
        {one.__name__ for one in file_task.DISTRIBUTIONS.values()},
    ),
    "DISTRIBUTIONS of test_fuzz_constructors.py": lambda: (
        distributions(),
        classes(of_file(CONSTRUCTORS, "DISTRIBUTIONS")),
    ),
    "jaxilc/__init__.pyi": lambda: (distributions(), jaxilc.__all__),
    "plant_file.md": lambda: (file_task.DISTRIBUTIONS, said(f"{GUIDE}/plant_file.md", form="`{}`")),
    "--sampling": lambda: (
        uncertainty.SAMPLINGS,
        re.findall(r"[\w-]+", re.findall(r"(?m)^sampling: (.+)$", options.SHARED)[0]),
    ),
    # families, pages, notebooks
    "the order of imports in CONTRIBUTING.md": lambda: (
        test_imports.ORDER,
        said(".github/CONTRIBUTING.md", form=r"(?m){}(?=(?:, \w+)*(?: →.*)?$)"),
    ),
    "the order of imports in design.md": lambda: (
        test_imports.ORDER,
        said(f"{GUIDE}/design.md", form=r"(?m){}(?=(?:, \w+)*(?: →.*)?$)"),
    ),
    "CHAPTERS of pages.py": lambda: (
        {path.relative_to(ROOT).as_posix() for path in files(f"{GUIDE}/*.md")},
        of_file(".ci/docs/pages.py", "PAGES"),
    ),
    "FIGURES of test_notebooks.py": lambda: (
        notebooks(),
        of_file("tests/test_notebooks.py", "FIGURES"),
    ),
    "notebooks.md": lambda: (
        notebooks(),
        {f"{int(n):02}" for n in said(f"{GUIDE}/notebooks.md", form=r"(?m)^{}\. ") if n.isdigit()},
    ),
}


def lacking(place):
    """Return the names that a place should have and does not."""
    needed, there = PLACES[place]()
    assert needed
    return {name for name in needed if name not in there}


@pytest.mark.parametrize("place", PLACES)
def test_nothing_is_left_out(place):
    assert not lacking(place), f"{place} lacks {', '.join(sorted(lacking(place)))}"


SECOND_LISTS = {  # modules that list names again, with what compares them, or why they may
    "jaxilc/outcomes/terms.py": "how objectives are written; places above",
    "jaxilc/outcomes/request.py": "what a next command repeats; few commands are one",
    "jaxilc/scenarios/catalogue.py": "known without JAX; a place above",
    "jaxilc/scenarios/file_task.py": "references that a file may name; a place above",
    "jaxilc/signals/references.py": "the references themselves",
    "jaxilc/scenarios/from_file.py": "the list of scenarios, and those with several readings",
    "jaxilc/cli/progress.py": "how long a command often takes; none is needed",
}


def lists_in(path, kinds):
    """Return whether a module has a literal with three names of a kind as text."""
    text = path.read_text(encoding="utf-8")
    kinds = [kind for kind in kinds if len(kind.intersection(re.findall(r'"([\w-]+)"', text))) > 2]
    for node in ast.walk(ast.parse(text)) if kinds else ():
        items = getattr(node, "keys", None) or getattr(node, "elts", ())
        texts = {one.value for one in items if isinstance(one, ast.Constant)}
        if any(len(kind & texts) > 2 for kind in kinds):
            return True
    return False


def test_no_names_are_listed_twice():
    kinds = [
        {*known_metrics.Metrics._fields},
        {*commands()},
        {*scenarios.SCENARIOS},
        {*file_task.REFERENCES},
        {*forms(terms.OBJECTIVES)},
        public(plants),
        public(schemes),
        public(filters),
    ]
    listed = {path for path in files("jaxilc/**/*.py") if path.name != "__init__.py"}
    found = {path.relative_to(ROOT).as_posix() for path in listed if lists_in(path, kinds)}
    assert found == set(SECOND_LISTS)


# Each of these adds one thing, and names all places that must then say that they lack it.
# --------------------------------------------------------------------------------------------------


def subclass(monkeypatch, base, room):
    """A class that belongs to a module of the package as long as the test runs."""
    cls = type("UnheardOf", (base,), {"__annotations__": {}})
    made = pytree(cls) if base in (Plant, Scheme, Basis, Filter) else dataclasses.dataclass(cls)
    monkeypatch.setattr(made, "__module__", room)
    return made


def hidden(base, room):
    return lambda m: subclass(m, base, f"{room.__name__}.unheard_of")


def shown(base, room):
    def add(m):
        m.setattr(room, "UnheardOf", hidden(base, room)(m), raising=False)
        m.setattr(room, "__all__", [*room.__all__, "UnheardOf"])

    return add


def longer(owner, name, *more):
    """Make a list longer; a name in a dictionary has the value of its first entry."""

    def add(m):
        now = getattr(owner, name)
        if isinstance(now, dict):
            m.setattr(owner, name, now | dict.fromkeys(more, next(iter(now.values()))))
        else:
            m.setattr(owner, name, type(now)([*now, *more]))

    return add


def scenario(m):
    def unheard_of():
        """A scenario."""

    m.setitem(scenarios.SCENARIOS, "unheard-of", unheard_of)


def command(m):
    m.setattr(app, "registered_commands", [*app.registered_commands])
    app.command("unheard-of", help="A command.")(lambda: None)


def with_field(base, module):
    def add(m):
        made = dataclasses.make_dataclass(
            "UnheardOf", [("strength", "float", 1.0)], bases=(base,), frozen=True
        )
        m.setattr(made, "__module__", module.__name__)

    return add


def field_of_metrics(m):
    fields = (*known_metrics.Metrics._fields, "unheard_of")
    m.setattr(known_metrics, "Metrics", namedtuple("Metrics", fields))


def distribution(m):
    m.setattr(uncertainty, "UnheardOf", uncertainty.Uniform, raising=False)


def file(folder, name):
    def add(m):
        listed = files
        m.setitem(
            globals(),
            "files",
            lambda one: [*listed(one), *([ROOT / folder / name] if one.startswith(folder) else [])],
        )

    return add


METRIC = Metric("unheard_of", ("trial", "channel"), "output", "a number")
ADDED = {
    "plant": (hidden(Plant, plants), {"plants/__init__.py"}),
    "public plant": (shown(Plant, plants), {"tests/cases.py", "tests/plants", "contents.md"}),
    "scheme": (hidden(Scheme, schemes), {"schemes/__init__.py"}),
    "basis": (hidden(Basis, schemes), {"schemes/__init__.py"}),
    "public scheme": (shown(Scheme, schemes), {"tests/cases.py", "tests/schemes", "contents.md"}),
    "filter": (hidden(Filter, filters), {"filters/__init__.pyi"}),
    "public filter": (shown(Filter, filters), {"tests/cases.py", "tests/filters", "contents.md"}),
    "module of a scenario": (
        lambda m: m.delitem(scenarios.SCENARIOS, "pendulum"),
        {"SCENARIOS of from_file.py"},
    ),
    "scenario": (
        scenario,
        {
            *("scenarios/__init__.pyi", "LISTED of catalogue.py", "tests/scenarios"),
            *("experiments, notebooks", "contents.md"),
        },
    ),
    "command of the list": (
        lambda m: m.setattr(app, "registered_commands", app.registered_commands[1:]),
        {"COMMANDS of entry.py"},
    ),
    "command": (
        command,
        {
            *("an example in its help", "a verdict", "tests/cli", "command_line.md"),
            "COMMANDS of test_fuzz_commands.py",
        },
    ),
    "objective": (
        with_field(Objective, objectives),
        {
            *("TERMS of terms.py", "_RANGES of objectives.py", "test_slopes.py"),
            "OBJECTIVES of test_fuzz_constructors.py",
        },
    ),
    "risk": (
        with_field(Risk, risks),
        {"RISKS of terms.py", "OBJECTIVES of test_fuzz_constructors.py", "test_tuning.py"},
    ),
    "term": (
        lambda m: m.setattr(terms, "OBJECTIVES", f"{terms.OBJECTIVES}, unheard-of[:x]"),
        {"test_cli_tuning.py", "objective_of of terms.py"},
    ),
    "term of a risk": (
        lambda m: m.setattr(terms, "RISKS", f"{terms.RISKS}, unheard-of"),
        {"test_cli_tuning.py", "risk_of of terms.py"},
    ),
    "metric": (
        longer(known_metrics, "METRICS", METRIC),
        {"Metrics of known_metrics.py", "tests/learning"},
    ),
    "field of the metrics": (field_of_metrics, {"METRICS of known_metrics.py"}),
    "reference": (
        longer(references, "__all__", "unheard_of"),
        {"REFERENCES of file_task.py", "test_references.py"},
    ),
    "reference of files": (longer(file_task, "REFERENCES", "unheard_of"), {"contents.md"}),
    "distribution": (
        distribution,
        {
            *("Distribution of uncertainty.py", "DISTRIBUTIONS of file_task.py"),
            *("DISTRIBUTIONS of test_fuzz_constructors.py", "jaxilc/__init__.pyi"),
        },
    ),
    "distribution of files": (
        longer(file_task, "DISTRIBUTIONS", "unheard_of"),
        {"plant_file.md", "contents.md"},
    ),
    "sampling": (longer(uncertainty, "SAMPLINGS", "unheard-of"), {"--sampling"}),
    "family": (
        longer(test_imports, "ORDER", "unheard_of"),
        {"the order of imports in CONTRIBUTING.md", "the order of imports in design.md"},
    ),
    "page": (file(GUIDE, "unheard_of.md"), {"CHAPTERS of pages.py"}),
    "notebook": (
        file("notebooks", "99_unheard_of.py"),
        {"FIGURES of test_notebooks.py", "notebooks.md"},
    ),
}


@pytest.mark.parametrize("kind", ADDED)
def test_a_place_where_it_is_forgotten_says_so(kind, monkeypatch):
    add, forgotten = ADDED[kind]
    assert not any(map(lacking, PLACES))  # and all files are read, to which an unwritten one comes
    add(monkeypatch)
    assert {place for place in PLACES if lacking(place)} == forgotten


def test_every_place_is_forgotten_once():
    assert set().union(*(forgotten for _, forgotten in ADDED.values())) == set(PLACES)
