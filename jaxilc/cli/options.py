"""The arguments and options that several commands share, and the checks of their values.

This module does not import JAX, so that `--help` and the completion of a shell are fast.
"""

from __future__ import annotations

import copy
import dataclasses
import functools
import inspect
import os
import re
from collections.abc import Callable
from pathlib import Path
from types import FunctionType
from typing import TYPE_CHECKING, Annotated, get_args, get_type_hints

import typer
import typer.core
from typer import Argument, Option
from typer.models import OptionInfo

from ..learning.known_metrics import TUNED
from ..outcomes.request import Request
from ..outcomes.terms import RISKS
from ..scenarios.catalogue import SCHEMES
from ..storage.reading import read_tree
from .console import warn

if TYPE_CHECKING:
    from ..pytree.aliases import Value

# Completion by a shell
# --------------------------------------------------------------------------------------------------


def scenarios_from(incomplete: str) -> list[str]:
    """Scenarios whose name begins with this text; if none does, the shell completes a file name."""
    return [name for name in SCHEMES if name.startswith(incomplete)]


def schemes_from(ctx: typer.Context, incomplete: str) -> list[str]:
    """Schemes, of the scenario or file of the command, whose name begins with this text."""
    # While the value of an option is completed, the arguments are not yet parsed.
    scenario = ctx.params.get("scenario") or next(iter(ctx.args), "")
    return [
        name for name in SCHEMES.get(scenario) or _of_file(scenario) if name.startswith(incomplete)
    ]


def of_list(*words: str) -> Callable[[str], list[str]]:
    """A completion function that offers those of the words that begin with the text."""
    return lambda incomplete: [word for word in words if word.startswith(incomplete)]


def _of_file(path: str) -> list[str]:
    """The names of the schemes in a scenario file; an empty list where it cannot be read."""
    try:
        return list(read_tree(path)["schemes"])
    except (OSError, ValueError, KeyError, TypeError):
        return []  # the file does not exist, or is not complete


# Checks of values
# --------------------------------------------------------------------------------------------------


# What one wants: groups of commands in `jaxilc --help`.
SIMULATE = "Simulate"
DESIGN = "Design"
PROVE = "Prove"
MACHINE = "Learn on a real machine"


def file_to_write(param: typer.CallbackParam, path: Path | None) -> Path | None:
    """The path of a file; raises ValueError at once if none can be written there."""
    if path is not None and (path.is_dir() or not _may_write(path)):
        raise ValueError(
            f"{_called(param)} {path} cannot be written; allowed is a file in a folder that can"
        )
    return path


def figure_to_write(param: typer.CallbackParam, path: Path | None) -> Path | None:
    """The path of a figure; raises ValueError as `file_to_write`, and for another ending."""
    from ..storage.figure_format import KINDS, chosen

    file_to_write(param, path)
    if path is None or chosen().kind or path.suffix[1:] in KINDS:
        return path
    raise ValueError(f"--plot {path} is none of the formats {', '.join(KINDS)}, by its ending")


def reports_to_write(param: typer.CallbackParam, paths: list[Path] | None) -> list[Path] | None:
    """The files of `--report`; raises ValueError as `file_to_write`, and for another ending."""
    for path in paths or []:
        file_to_write(param, path)
        if path.suffix not in (".html", ".json"):
            raise ValueError(f"--report {path} is neither .html, a page, nor .json, the numbers")
        if sum(one.suffix == path.suffix for one in paths or []) > 1:
            raise ValueError(f"--report {path} is one of several {path.suffix}; allowed is one")
    return paths


def folder_to_write(param: typer.CallbackParam, path: Path | None) -> Path | None:
    """The path of a folder for results; raises ValueError as `file_to_write`."""
    if path is not None and (not _may_write(path) or (path.exists() and not path.is_dir())):
        raise ValueError(
            f"{_called(param)} {path} cannot be a folder for results; allowed is one that can be "
            "made or written to"
        )
    return path


def _called(param: typer.CallbackParam) -> str:
    return max(param.opts, key=len) if param.opts[0].startswith("-") else "the argument"


def _may_write(path: Path) -> bool:
    """Whether the path is writable; if it does not exist, whether the nearest folder above is."""
    there = next(p for p in (path.absolute(), *path.absolute().parents) if p.exists())
    return os.access(there, os.W_OK) and (there == path.absolute() or there.is_dir())


def seed_in_range(seed: int) -> int:
    """The seed; raises ValueError for one that the random generators do not accept."""
    from ..pytree.ranges import SEEDS, Interval, brief

    if not Interval.parse(SEEDS).contains(seed):
        raise ValueError(f"--seed {brief(seed)} is outside its allowed range {SEEDS}")
    return seed


def figures_as(text: str | None) -> str | None:
    """Choose how figures are written; raises ValueError, before anything is computed."""
    from ..storage.figure_format import choose

    try:
        choose(text)
    except ValueError as error:
        raise ValueError(str(error).replace("figures =", "--figures")) from None
    return text


def at_least(low: int, **given: int | None) -> None:
    """Raises ValueError naming the first option, with `_` for `-`, whose number is too low."""
    for name, value in given.items():
        if value is not None and value < low:
            option = name.replace("_", "-")
            raise ValueError(f"--{option} {value} is outside its allowed range [{low}, inf)")


# Options of several commands: what each means, and what completes or checks its value
# --------------------------------------------------------------------------------------------------


SHARED = f"""\
scenario SCENARIO: Of `jaxilc list`, or a TOML or JSON file.
source SCENARIO: Of `jaxilc list`, or a TOML or JSON file.
scheme NAME: Scheme to use; repeatable. All if not given.
trials: Trials J; the scenario's own if not given.
set_ PATH=VALUE: Set a leaf, a field or an option of the scenario; repeatable.
params FILE: Parameters that `tune` wrote, or the folder of a `sweep --grid` for its best point.
grid PATH=...: An axis of a grid: LOW:HIGH:COUNT, LOW:HIGH:COUNTlog or values with commas, for what
    --set can set, or trials; PATH/PATH is one axis of two; repeatable.
metric: Metric that tables show and --tolerance limits: {", ".join(TUNED)} or one of the
    scenario, such as contour_max; its own if not given.
seed: Seed of noise and machines.
machines: Machines, the nominal one included.
spread: Half-width of all relative uncertainties: 0.2 is 20 %.
sampling: monte-carlo, latin-hypercube, sobol or corners.
time: Column of the time.
input: Column of the input.
output: Column of the output.
columns A,B,C: Names of the columns of a file without a header.
out_dir: Folder for results; out/COMMAND-SCENARIO if not given.
details: Print what the tables are a summary of, too.
resume: Go on with what is in the folder.
"""
SCENARIO = Argument(autocompletion=scenarios_from)
Schemes = Annotated[list[str] | None, Option(autocompletion=schemes_from)]
OneScheme = Annotated[str | None, Option(autocompletion=schemes_from)]
MetricName = Annotated[str | None, Option(autocompletion=of_list(*TUNED))]
Seed = Annotated[int, Option(callback=seed_in_range)]
Machines = Annotated[int, Option("--machines", "--samples")]
Sampling = Annotated[
    str, Option(autocompletion=of_list("monte-carlo", "latin-hypercube", "sobol", "corners"))
]
FileToWrite = Annotated[Path | None, Option(callback=file_to_write)]
OutFolder = Annotated[Path | None, Option("--out", callback=folder_to_write)]

# What `--set campaign.NAME=VALUE` sets, with the type of the value and what it means.
OF_CAMPAIGN = {
    "limit": (float, "largest |input| played; the machine's own if not given"),
    "largest_correction": (float, "largest departure of a learned reference"),
    "saturation": (float, "share of samples at that limit or the machine's that is accepted"),
    "repeatability": (float, "largest rms difference of two trials of one schedule"),
    "growth": (float, "share by which the rms error may grow without a warning"),
    "accept_saturation": (bool, "learn in spite of saturation"),
    "stop_on_growth": (bool, "refuse a trial whose error grew"),
    "accept": (str, "what is not refused in this call: frozen,sign,jump,schedule,growth,input"),
    "replayed_input": (bool, "without u: the scheme's input over the measured y"),
    "short_trial": (bool, "the trial may have ended early: learn from its part"),
    "predict": (bool, "whether errors of trials are predicted by the plant file, from now on"),
    "reference": (str, "column of the reference, which need not be there"),
    "columns": (str, "names of the columns of a file without a header: sample,u [V],y [mm]"),
    "number": (str, "numbers of a C header: double or float"),
}

# Options that left the command line; they are taken for one version, with a warning.
# --------------------------------------------------------------------------------------------------


def left(instead: str) -> OptionInfo:
    """An option that is not shown any more, and warns where it is given: what does the same now.

    instead: what does; `{}` in it is the name of the parameter
    """

    def check(param: typer.CallbackParam, value: object) -> object:
        if value or (value == 0 and value is not False):
            warn(f"warning: {_called(param)} will go: {instead.format(param.name)}")
        return value

    return Option(hidden=True, help=f"Left: {instead}.", callback=check)


IN_PYTHON = left("{}=... in Python, of jaxilc.outcomes, does it")


# Groups
# --------------------------------------------------------------------------------------------------


def asked(source: str, schemes: list[str] | None, set_: list[str] | None, **more: Value) -> Request:
    """What is asked of a scenario by options, of which any may be missing."""
    return Request(source, tuple(schemes or ()), tuple(set_ or ()), **more)


def names_in(text: str | None) -> list[str]:
    """The names in a text with commas; none where there is no text."""
    return [name.strip() for name in text.split(",")] if text else []


@dataclasses.dataclass(frozen=True)
class Simulated:
    """What is simulated."""

    scenario: Annotated[str, SCENARIO]
    scheme: Schemes = None
    trials: int | None = None
    set_: list[str] | None = None
    params: Path | None = None

    def request(self, **more: Value) -> Request:
        """What is asked of the scenario, with further fields of a request."""
        given = {"params": self.params, "trials": self.trials}
        return asked(self.scenario, self.scheme, self.set_, **given, **more)


@dataclasses.dataclass(frozen=True)
class OneSimulated:
    """What is simulated with one scheme.

    scheme: Scheme to use.
    """

    scenario: Annotated[str, SCENARIO]
    scheme: Annotated[str, Option(autocompletion=schemes_from)]
    set_: list[str] | None = None
    params: Path | None = None
    spread: float | None = None

    def request(self, trials: int | None) -> Request:
        """What is asked of the scenario, with a number of trials."""
        given = {"params": self.params, "trials": trials, "spread": self.spread}
        return asked(self.scenario, [self.scheme], self.set_, **given)


@dataclasses.dataclass(frozen=True)
class Tuned:
    """How weights are tuned, on which machines.

    weights A,B,C: To tune, with or without bounds: lam=0.1:10,phi0.
    machines: Machines to tune on, the nominal one included.
    steps: Steps at most.
    """

    weights: str
    risk: Annotated[str, Option(help=f"Over the machines: {RISKS}.")] = "mean"
    trials: int | None = None
    machines: Machines = 32
    steps: int = 100
    seed: Seed = 0
    resume: bool = False
    bounds: Annotated[list[str] | None, left("--weights A=LOW:HIGH does it")] = None
    held_out: Annotated[int | None, IN_PYTHON] = None
    unseen: Annotated[int | None, IN_PYTHON] = None
    starts: Annotated[int | None, IN_PYTHON] = None
    rate: Annotated[float | None, IN_PYTHON] = None
    optimiser: Annotated[str | None, IN_PYTHON] = None
    sampling: Annotated[str | None, IN_PYTHON] = None

    def arguments(self) -> dict[str, Value]:
        """What was asked, as arguments of `outcomes.tune` and `outcomes.pareto`."""
        at_least(1, unseen=self.unseen)
        given = dataclasses.asdict(self) | {"weights": self._with_bounds()}
        return {name: given[name] for name in given if name not in ("trials", "bounds")}

    def _with_bounds(self) -> str:
        """The weights with the bounds of `--bounds`."""
        names = [name.strip() for name in self.weights.split(",")]
        for bound in self.bounds or ():
            name = bound.partition("=")[0].strip()
            if name not in names:
                raise ValueError(f"--bounds: {name!r} is not one of the weights {self.weights}")
            names[names.index(name)] = bound
        return ",".join(names)


@dataclasses.dataclass(frozen=True)
class Pages:
    """The files of `--report`.

    report FILE: What was found, as one self-contained page (.html) or every printed number (.json);
        repeatable.
    """

    report: Annotated[list[Path] | None, Option(callback=reports_to_write)] = None

    def file(self, ending: str) -> Path | None:
        """The file for the page, `.html`, or the numbers, `.json`; None where none is asked for."""
        return next((file for file in self.report or () if file.suffix == ending), None)


@dataclasses.dataclass(frozen=True)
class Written(Pages):
    """Where results go."""

    out_dir: OutFolder = None


# Commands, of which the docstring explains the options as it explains arguments
# --------------------------------------------------------------------------------------------------


LINE = re.compile(r"(\w+)(?: (\S+))?: (.+)")  # of a docstring


def command_of(function: Callable[..., None]) -> FunctionType:
    """A function as Typer takes it: each of its parameters is an option.

    The docstring explains its options in a paragraph of lines `name METAVAR: what it means`, and
    `SHARED` those that it does not; the rest of it is the help of the command. A parameter whose
    type is a dataclass is a group: the command has an option for each of its fields, which the
    docstring of the class explains, and the function gets the object.
    """
    about, parameters = _options(function)
    shown: list[inspect.Parameter] = []
    groups: dict[str, tuple[type, list[str]]] = {}
    for one in parameters:
        of_group, kind = [one], one.annotation
        if isinstance(kind, type) and dataclasses.is_dataclass(kind):
            of_group = _options(kind)[1]
            groups[one.name] = kind, [option.name for option in of_group]
        shown += of_group

    @functools.wraps(function)
    def command(**values: Value) -> None:
        of_groups = {
            group: kind(**{name: values.pop(name) for name in names})
            for group, (kind, names) in groups.items()
        }
        function(**of_groups, **values)

    ordered = sorted(shown, key=lambda one: one.default is not inspect.Parameter.empty)
    made: Value = command
    made.__doc__, made.__signature__ = about, inspect.Signature(ordered)
    made.__annotations__ = {one.name: one.annotation for one in ordered}
    return made


def _options(function: Callable[..., object]) -> tuple[str, list[inspect.Parameter]]:
    """The help of a function, and its parameters, or the fields of a class, as options."""
    given, about = inspect.signature(function).parameters, list[str]()
    own: dict[str, Value] = {}
    documented = reversed(getattr(function, "__mro__", (function,)))  # a class after its bases
    for paragraph in "\n\n".join(inspect.getdoc(one) or "" for one in documented).split("\n\n"):
        found = _explained(paragraph)
        if found.keys() & given.keys():
            assert found.keys() <= given.keys(), f"{function} has no {found.keys() - given.keys()}"
            own |= found
        else:
            about.append(paragraph)
    options, hints = [], get_type_hints(function, include_extras=True)
    for name, one in given.items():
        kind = _option(name, hints[name], own.get(name))
        options.append(one.replace(annotation=kind, kind=one.KEYWORD_ONLY))
    return "\n\n".join(about), options


@functools.cache
def _explained(paragraph: str) -> dict[str, Value]:
    """Metavar and meaning by the name of an option; a line that is indented goes on with one."""
    lines = (" ".join(line.split()) for line in re.split(r"\n(?! )", paragraph))
    return {found[1]: (found[2], found[3]) for found in map(LINE.fullmatch, lines) if found}


def _option(name: str, kind: Value, own: tuple[str | None, str] | None) -> Value:
    """The type of an option, with its name and its explanation; groups and contexts as they are."""
    if dataclasses.is_dataclass(kind) or kind is typer.Context:
        return kind
    of, option = get_args(kind) if hasattr(kind, "__metadata__") else (kind, Option())
    option = copy.copy(option)
    if isinstance(option, OptionInfo) and option.default is ...:  # where Typer keeps a given name
        option.param_decls = (f"--{name.strip('_').replace('_', '-')}",)
    if own or not option.help:
        option.metavar, option.help = own or _explained(SHARED).get(name, (None, None))
    typed: Value = Annotated
    return typed[of, option]


# Options that have another name since this version: they are taken, with a warning
# --------------------------------------------------------------------------------------------------


BEFORE = ("--figures", "--precision")  # now stand before the name of the command
# For each command what replaces an option; `{}` is its value, and without it the option is a flag.
OF_ALL = {"--json": "--report {}"}
RENAMED: dict[str, dict[str, str]] = {
    "next": {"--plant-file": "--scenario {}", "--no-predict": "--set campaign.predict=false"}
    | {
        f"--{name.replace('_', '-')}": f"--set campaign.{name}={'true' if kind is bool else '{}'}"
        for name, (kind, _) in OF_CAMPAIGN.items()
        if name not in ("accept", "columns")  # which are newer
    }
}


class Commands(typer.core.TyperGroup):
    """The commands, which also take the names that options had until now."""

    def parse_args(self, ctx, args: list[str]) -> list[str]:
        return super().parse_args(ctx, now_named(args, [*self.commands]))


def now_named(words: list[str], commands: list[str]) -> list[str]:
    """The words after the name of the program, with options as they are called now."""
    at = next((i for i, word in enumerate(words) if word in commands), len(words))
    known = OF_ALL | RENAMED.get(words[at], {}) if words[at:] else {}
    before, after, rest = words[:at], words[at : at + 1], words[at + 1 :]
    while rest:
        word, *rest = rest
        name, equals, value = word.partition("=")
        if name not in (*known, *BEFORE):
            after.append(word)
            continue
        now = known.get(name, f"{name} {{}}")
        if "{}" in now and not equals and rest:
            value, *rest = rest
        said = f"{now.format(value)} ... {words[at]}" if name in BEFORE else now.format(value)
        warn(f"warning: {name} is now {said}")
        option, of = now.split(" ")
        (before if name in BEFORE else after).extend((option, of.format(value)))
    return before + after
