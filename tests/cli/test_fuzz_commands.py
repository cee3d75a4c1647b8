"""Every command gets invalid options, and runs up to the point where it would compute.

A command ends without an error, or with a message of one line that names an option, or what was
given, and never with exit code 1. fuzz.py says how to run more cases.
"""

import contextlib
import os
import re
import shlex
import sys

import jax
import numpy as np
import pytest
import typer
from cases import first_order, follows, known_to, p_type
from command import write_columns
from fuzz import LONGEST, fuzz, pick

from jaxilc import cli, runtime
from jaxilc.design import Design, LearnedLaw
from jaxilc.figures import explorer
from jaxilc.identification import estimation
from jaxilc.learning import over_trials
from jaxilc.outcomes import certifying, demonstrating, exporting, filtering, identifying
from jaxilc.outcomes import tuning as of_tuning
from jaxilc.scenarios import reproduction
from jaxilc.sweeps import Sweep
from jaxilc.theory import certificates, q_filter
from jaxilc.tuning import Tuning, worst_case

PLANT = f"""trials = 3
{first_order(0.5, 1.0)}{follows(50.0, 0.02)}{p_type(0.3)}[schemes.mf]
class = "CFDLMFAILC"
{known_to(0.02)}"""
# Modules that are loaded while a function is replaced would keep what stands for it.
LOADED = certifying, exporting, filtering, identifying, of_tuning
TUNED = "--scheme ilc --weights gamma_p --machines 4 --held-out 3 --unseen 4 --steps 2"
COMMANDS = [
    shlex.split(line)
    for line in f"""
run p.toml
sweep p.toml --machines 4
certify p.toml --machines 4
filter p.toml --machines 4 --scheme ilc
tune p.toml {TUNED}
pareto p.toml {TUNED} --budgets 2,3
worst-case p.toml --scheme ilc --starts 2 --steps 2
demo
potential repeats.csv
identify record.csv --poles 1 --pairs 0 --zeros 0
design p.toml --machines 4 --steps 2
learn-law p.toml --taps 5,3 --machines 4 --steps 2
reproduce dai-2014
export p.toml --scheme ilc --limit 9 --machines 4 --out law
next --state campaign --scenario p.toml --scheme ilc --out n.csv
trials --state campaign
list p.toml
init p.toml
explore p.toml --machines 2 --port 0 --no-browser
""".strip().split("\n")
]
NUMBERS = (
    "0", "-1", "1", "2", "1.5", "1e9", str(10**9), str(10**12), str(10**23), "1e300", "1e-300",
    "nan", "inf", "-inf", "1,2", "1:2",
)  # fmt: skip
NAMES = (
    "", "x", "lam", "gamma_p", "plant.B", "ilc", "ilc,mf", "cao-2019", "final", "final:0",
    "2*final+effort", "effort", "cvar:0.5", "worst",
)  # fmt: skip
CHOICES = (
    "sobol", "corners", "lbfgs", "least-squares", "float32", "settled_error", "growth", "none",
    "a=b", "ilc.gamma_p=nan", "ilc.lead=3",
)  # fmt: skip
FILES = (
    "p.toml", "bad.json", "bad.toml", "fifo", "folder", "../x", "/dev/null", "/dev/zero", "o.mat",
    "o.h", "record.csv", "-", "--",
)  # fmt: skip
LETTERS = ("\x1b[31m", "[bold]", ":x:", "\u202e", "\n", "\udcff", "é", "a" * 300, "b" * 5000)


class Computes(BaseException):
    """All options were accepted, and the command is about to compute."""


def computes(*_, **__):
    raise Computes


def ended():
    """Return the exit code of the command."""
    try:
        return cli.main()
    except SystemExit as stop:
        return stop.code


@pytest.fixture(autouse=True)
def settings_kept():
    """Restore the settings of JAX, since a command changes them for the whole process."""
    kept = jax.config.jax_enable_compilation_cache
    yield
    runtime.setup()
    jax.config.update("jax_enable_compilation_cache", kept)


@pytest.fixture
def folder(here, tmp_path, monkeypatch):
    (tmp_path / "p.toml").write_text(PLANT)
    time = np.arange(200) * 1e-3
    for name, header in (("record", "t,u,y"), ("repeats", "t,e_1,e_2")):
        write_columns(f"{name}.csv", header, time, np.sin(40 * time), np.sin(40 * time - 0.1))
    (tmp_path / "bad.json").write_text("{}")
    (tmp_path / "bad.toml").write_text("x = [")
    (tmp_path / "folder").mkdir()
    os.mkfifo(tmp_path / "fifo")
    reader = os.open(tmp_path / "fifo", os.O_RDWR)  # without one a writer would wait for ever
    for owner, name in (
        *(
            (over_trials, "_program"), (Sweep, "run"), (Tuning, "run"), (Design, "safe"),
            (LearnedLaw, "learned_taps"), (reproduction, "_of_scenario"), (certificates, "certify"),
            (worst_case, "worst_case_search"), (q_filter, "question"),
            (q_filter, "measured_question"),
        ),
        *((demonstrating, "learn"), (estimation, "problem_of"), (explorer, "explore")),
    ):  # fmt: skip
        monkeypatch.setattr(owner, name, computes)
    yield tmp_path
    os.close(reader)


FOUND = f"""
run p.toml --seed {10**23}
sweep p.toml --seed {10**23}
run p.toml --set mf.lead={10**23}
run p.toml --set ilc.gamma_p={"1" * 5000}
identify record.csv --poles {10**12}
identify record.csv --delay {10**12}
identify record.csv --resample 1e-300
identify record.csv --poles 1 --pairs 0 --zeros {10**12}
run deep.json
run p.toml --params deep.json
sweep p.toml --samples {10**12}
tune p.toml {TUNED} --starts {10**12}
tune p.toml {TUNED} --steps {10**12}
certify p.toml --samples {10**12}
worst-case p.toml --scheme ilc --starts {10**12}
run p.toml --seed x
certify p.toml --spread a
sweep p.toml --machine 4
run p.toml --replace=1
trials
rum p.toml
next --state campaign --scenario p.toml --scheme ilc --out n.csv --plot n.txt
learn-law p.toml --taps 5,3 --machines 4 --steps 2 --spread 1e-300
explore p.toml --port 0 --no-browser --address {"a" * 300}
"""


@pytest.mark.parametrize("line", FOUND.strip().split("\n"), ids=lambda line: line[:50])
def test_what_was_found(line, folder, monkeypatch, capsys):
    """Each of these once ended in a traceback or several lines, or was not refused in time."""
    (folder / "deep.json").write_text("[" * 100_000)
    monkeypatch.setattr(sys, "argv", ["jaxilc", *line.split()])
    assert ended() == 2
    said = capsys.readouterr().err
    assert of_one_line(said, line.split()), said
    assert not (folder / "campaign").exists()


def of_one_line(said, arguments):
    """Whether an error is one line, the last one, which names an option or something given."""
    *before, last = said.rstrip("\n").split("\n")
    values = [*arguments[1:], *(part for one in arguments[1:] for part in re.split("[=.:]", one))]
    given = [word.lstrip("-").strip() or word.strip() or (" " if word else "''") for word in values]
    escaped = [word.encode("unicode_escape").decode() for word in given]  # \x1b is not printed
    empty = [" . "] if "" in arguments else []  # as a path
    named = any(word[:12] in last for word in given + escaped + empty)
    warned = all(line.startswith(("warning: ", "note: ")) for line in before)
    return last.startswith("error: ") and (named or " -h tells" in last) and warned


def test_commands(folder, monkeypatch, capsys):
    known = typer.main.get_command(cli.app).commands
    options = {
        name: [max(p.opts, key=len) for p in c.params if p.param_type_name == "option"]
        for name, c in known.items()
    }
    flags = {
        name: {max(p.opts, key=len) for p in c.params if getattr(p, "is_flag", False)}
        for name, c in known.items()
    }

    def attempt(rng):
        (folder / "p.toml").write_text(PLANT)  # restored, since a command may have overwritten it
        arguments = list(pick(rng, COMMANDS))
        name = arguments[0]
        for _ in range(1 + rng.integers(3)):
            option = pick(rng, [o for o in options[name] if o != "--dask"] or [None])
            value = pick(rng, pick(rng, (NUMBERS, NAMES, CHOICES, FILES, LETTERS)))
            if option is None or rng.random() < 0.1:
                arguments[1:2] = [value]
            else:
                arguments += [option] if option in flags[name] else [option, value]
        monkeypatch.setattr(sys, "argv", ["jaxilc", *arguments])
        code = None
        with contextlib.suppress(Computes):
            code = ended()
            assert code in (None, 0, 2, 3), arguments
        said = capsys.readouterr().err
        assert len(said) <= LONGEST, arguments
        if code == 2:
            assert of_one_line(said, arguments), (arguments, said)

    fuzz(100, attempt, ())
