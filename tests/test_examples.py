"""What the pages say that their examples print is what these print.

On a page, in a block of Python or of a shell, a comment that begins a line is what the code or the
command above it prints: of Python all of it, of a command a part, with `...` for what is left out.
"""

import contextlib
import functools
import io
import json
import re
import shlex
import sys
import tomllib
from pathlib import Path

import pytest
from turns import due
from typer.main import get_command

from jaxilc import run_schemes
from jaxilc.cli import app, main
from jaxilc.outcomes import running
from jaxilc.scenarios.from_file import read_scenario

ROOT = Path(__file__).parents[1]
AXIS = ROOT / "jaxilc/scenarios/axis.toml"
PAGES = [ROOT / "README.md", *sorted((ROOT / ".ci/docs/guide").glob("*.md"))]
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
NAMED = re.compile(r"[#(] ?(\w+\.\w+)\)?$")  # first line of a block that is a file
LEARNS = re.compile(r"\b(learn|run|next_memory|certify)\(")
SMALLER = {"machines=1024": "machines=16"}  # it prints the same
TRIALS = 60  # of tables, in which some things happen late
# What is not run, by its first words, and why.
LONG, RECORD = "it takes minutes: tests/cli runs it smaller", "it needs a record of a real machine"
NOT_RUN = {
    "README.md: pip": "it changes the environment",
    "README.md: jaxilc demo": "half a minute: tests/cli/test_cli.py runs it smaller",
    "README.md: jaxilc sweep cao-2019": LONG,
    "five_minutes.md: jaxilc design": LONG,
    "how_to.md: jaxilc sweep": "the sweep of five_minutes.md, with a page",
    "grids.md: jaxilc explore": "it serves a page until it is stopped",
    "grids.md: jaxilc tune": "it takes minutes: tests/outcomes/test_stored_grid.py runs it smaller",
    "how_to.md: pip": "it changes the environment",
    "how_to.md: jaxilc explore": "it serves a page until it is stopped",
    "how_to.md: jaxilc init": "it needs a recorded move: tests/cli/test_init.py makes one",
    "how_to.md: jaxilc run drive.toml": RECORD,
    "how_to.md: jaxilc next": RECORD,
    "how_to.md: jaxilc trials": RECORD,
    "potential.md: jaxilc potential": RECORD,
    "printer.md: JAXILC_MEASURED": RECORD,
    "export.md: jaxilc": "it writes programs: tests/cli/test_export_command.py runs it",
    "export.md: cc": "it compiles: tests/export/test_export.py does",
    "many_hosts.md: dask": "it needs hosts: tests/sweeps runs workers",
    "many_hosts.md: jaxilc sweep": "it needs hosts: tests/sweeps runs workers",
    "many_hosts.md: #!/bin/bash": "it needs SLURM",
    "notebooks.md: cd": "tests/test_notebooks.py runs the notebooks",
    "command_line.md: jaxilc": "a list of commands: tests/cli runs each",
}


def blocks_of(page: Path) -> list[tuple[str, str]]:
    """Return the language and the text of each block of a page."""
    return BLOCK.findall(page.read_text(encoding="utf-8"))


def pages_with(language: str) -> list[Path]:
    """Return the pages that have blocks of a language."""
    return [page for page in PAGES if language in {of for of, _ in blocks_of(page)}]


def parts_of(text: str) -> list[tuple[str, str]]:
    """Return each piece of code of a block with the comment below it, which is what it prints."""
    parts = re.findall(r"((?:^(?!# ).*\n)+)((?:^# .*\n)*)", text, re.MULTILINE)
    return [(code, re.sub(r"^# ", "", comment, flags=re.MULTILINE)) for code, comment in parts]


def printed_by(call) -> str:
    """Return what a function prints."""
    with contextlib.redirect_stdout(io.StringIO()) as text:
        call()
    return text.getvalue()


@pytest.mark.parametrize("page", due(pages_with("python"), 1), ids=lambda page: page.stem)
def test_python_prints_what_the_page_says(page, compiled_once, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    known: dict = {}
    for language, text in blocks_of(page):
        if language == "python":
            for given, small in SMALLER.items():
                text = text.replace(given, small)
            assert bool(LEARNS.search(text)) <= ("\n# " in text), f"without an outcome: {text}"
            for code, said in parts_of(text):
                assert printed_by(lambda code=code: exec(code, known)) == said, code


def written(text: str, folder: Path) -> bool:
    """Write a block whose first line names a file; return whether it does."""
    named = NAMED.match(text.partition("\n")[0])
    if named:
        (folder / named[1]).write_text(text, encoding="utf-8")
    return bool(named)


@pytest.fixture
def run_command(monkeypatch, tmp_path):
    """Return a function that runs a command in this process and returns what it prints."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(running, "_figures", lambda *_: {})  # figures have their own tests

    def call(line: str) -> str:
        monkeypatch.setattr(sys, "argv", shlex.split(line, comments=True))
        with pytest.raises(SystemExit) as ended, contextlib.redirect_stdout(io.StringIO()) as text:
            main()
        assert ended.value.code in (None, 0), line
        return text.getvalue()

    return functools.cache(call)


def commands_of(page: Path) -> list[tuple[str, str]]:
    """Return each command of a page with the comment below it; a script counts as a command."""
    found = []
    for language, text in blocks_of(page):
        if language == "sh" and text.startswith("#!"):
            found.append((text, ""))
        elif language == "sh":
            for code, said in parts_of(text.replace("\\\n", "")):
                *before, last = code.splitlines()
                found += [*((line, "") for line in before), (last, said)]
    return [(line.partition("  #")[0].strip(), said) for line, said in found if line]


def parse(line: str) -> None:
    """Have the program read a command; it ends where an option or a value is none of its own."""
    program, *words = shlex.split(line)
    if program == "jaxilc":
        commands = get_command(app).commands
        at = next(i for i, word in enumerate(words) if word in commands)  # after options for all
        with commands[words[at]].make_context(words[at], words[at + 1 :]) as context:
            assert not context.args, line


def test_commands_print_what_the_pages_say(run_command, compiled_once, tmp_path):
    left_out = set()
    for page in PAGES:
        for _, text in blocks_of(page):
            written(text, tmp_path)
        for command, said in commands_of(page):
            where = f"{page.name}: {command}"
            reason = next((one for one in NOT_RUN if where.startswith(one)), None)
            if reason is not None:
                left_out.add(reason)
                parse(command)
                continue
            assert said or command.split()[1] in ("list", "init"), f"{where}: without an outcome"
            found = rest = " ".join(run_command(command).split())
            for part in " ".join(said.split()).split(" ... ") if said else ():
                _, there, rest = rest.partition(part)
                assert there == part, f"{where}: {part!r} is not printed, but {found!r}"
    assert left_out == set(NOT_RUN), "an entry that no page has"


# the start page's is run as a command
@pytest.mark.parametrize("page", due(pages_with("toml")[1:], 1), ids=lambda page: page.stem)
def test_tables_of_a_page_learn(page, tmp_path):
    """A block that is no file by itself is a part of the file of the page, or of the start page's.

    Each law of the file learns then: a tenth of the error that is judged is left at most.
    """
    tables = [text for language, text in blocks_of(page) if language == "toml"]
    others = [text for _, text in blocks_of(page) if written(text, tmp_path)]
    whole = next((t for t in others if t in tables), AXIS.read_text(encoding="utf-8"))
    for text in tables:
        merged = joined(tomllib.loads(whole), tomllib.loads(text))
        (tmp_path / "axis.json").write_text(json.dumps(merged))
        s = read_scenario(tmp_path / "axis.json")
        dataset, _ = run_schemes(s.machine, s.schemes, s.task, TRIALS, quantities=s.functions)
        error = dataset.max("channel")[s.judged_by]
        left = error.sel(trial=TRIALS) / error.sel(trial=1)
        assert (left < 0.1).all(), f"{text}{left}"


def joined(one: dict, other: dict) -> dict:
    """Return two tables as one; where both have a value, that of the second counts."""
    deeper = {k: joined(one[k], v) for k, v in other.items() if isinstance(one.get(k), dict)}
    return one | other | deeper
