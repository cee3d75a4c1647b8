"""The program `jaxilc`: its commands, the options for all of them, and its exit codes."""

from __future__ import annotations

import gc
import re
import sys
import traceback
import warnings
from collections.abc import Callable
from contextlib import suppress
from typing import Annotated, Any, cast

import typer
import typer.core
from rich.markup import escape
from typer import Option

from . import INTERRUPTED, commands, leave
from .console import ended, err, prefer, speak, tracebacks, warn
from .explore import explore
from .hardware import SETTINGS, Refused, next_, trials
from .options import DESIGN, MACHINE, PROVE, SIMULATE, Commands, command_of, figures_as, of_list

LONGEST = 2000  # characters of the message of an error
WITHOUT_DOCSTRINGS = (
    "python -OO drops docstrings, by which help explains options and tables have their units; -O "
    "keeps them"
)
LONG_WORD = re.compile(r"(\S{60})\S{200,}(\S{40})")  # such as a value that was given by mistake
# What is allowed in place of a value that Typer could not read, by the name of its error.
NO_VALUE = {
    "int_parsing": "is no whole number",
    "int_parsing_size": "is too long for a whole number",
    "float_parsing": "is no number",
    "string_unicode": "is no text in UTF-8",
}
EXIT_CODES = (
    "Exit codes:",
    "0    done",
    "1    an error of jaxilc itself, with its traceback; without one, design or learn-law found no"
    " safe law, simulation contradicts a claim, or no worker could compute a chunk of a sweep",
    "2    a mistake in what was asked: one line that names what is allowed",
    "3    next: the measured trial, or the input after it, is refused",
    "130  stopped by Ctrl-C: sweep, tune, pareto, design and learn-law go on with --resume",
)

app = typer.Typer(
    cls=Commands,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Iterative learning control of machine-tool feed drives.",
    epilog="\n\n".join(EXIT_CODES),
)


def _version(asked: bool) -> None:
    if asked:
        from importlib.metadata import version
        from platform import python_version

        typer.echo(f"jaxilc {version('jaxilc')} (jax {version('jax')}, Python {python_version()})")
        raise typer.Exit


@app.callback()
@command_of
def options(
    quiet: Annotated[bool, Option("--quiet", "-q")] = False,
    verbose: Annotated[bool, Option("--verbose", "-v")] = False,
    precision: Annotated[str | None, Option(autocompletion=of_list("float64", "float32"))] = None,
    figures: Annotated[str | None, Option(callback=figures_as)] = None,
    version: Annotated[bool, Option(callback=_version, is_eager=True)] = False,
) -> None:
    """What holds for every command; before its name.

    quiet: Print warnings and errors only; files are written all the same.
    verbose: Log versions, devices and every program compiled, with times; show tracebacks.
    precision: float64, if not given, or float32.
    figures FORMAT: Format and style of figures: png, svg or pdf; print or dark; both as svg,dark.
    version: Show the version and exit.

    Example: jaxilc --quiet run cao-2019 --report out/run.json
    """
    speak(quiet=quiet, verbose=verbose)
    prefer(precision or "float64")


OLD_NAME = "--samples"  # of --machines, which is still understood


class Command(typer.core.TyperCommand):
    """A command whose help is shown as it is written: Rich would take `[s]` for one of its tags.

    The lines of a paragraph are joined, since Rich would break long ones and keep their ends too.
    Without old names of options there is more room for what they mean.
    """

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.help = escape(re.sub(r"(?<!\n)\n(?!\n)", " ", self.help or ""))
        for one in self.params:
            if isinstance(one, typer.core.TyperOption | typer.core.TyperArgument):
                one.help = escape(one.help or "")

    def format_help(self, *args: Any, **kwargs: Any) -> None:
        named = {one: one.opts for one in self.params}
        for one in named:
            one.opts = [name for name in one.opts if name != OLD_NAME]
        super().format_help(*args, **kwargs)
        for one, names in named.items():
            one.opts = names


# What one wants, and its commands, in the order of `--help`.
COMMANDS: dict[str, list[Callable[..., None]]] = {
    SIMULATE: [commands.demo, commands.init, commands.list_, commands.run, commands.sweep, explore],
    DESIGN: [
        commands.potential,
        commands.identify,
        commands.design,
        commands.learn_law,
        commands.tune,
        commands.pareto,
        commands.worst_case,
    ],
    PROVE: [commands.certify, commands.filter_],
    MACHINE: [next_, trials, commands.export],
    "Published results": [commands.reproduce],
}
for panel, of_panel in COMMANDS.items():
    for function in of_panel:
        command, below = command_of(function), escape(SETTINGS) if function is next_ else None
        name = command.__name__.strip("_").replace("_", "-")
        app.command(name, cls=Command, epilog=below, rich_help_panel=panel)(command)


def main() -> None:
    """Run the command line.

    A mistake of the user gives one line on standard error without a traceback, and exit code 2. A
    measured trial that is refused gives exit code 3. A warning of the library is one line, too.
    """
    warnings.showwarning = cast(Any, _in_one_line)
    if sys.flags.optimize > 1:
        warn("warning: " + WITHOUT_DOCSTRINGS)
    gc.set_threshold(200_000, 20, 100)  # tracing makes many objects, few of them in circles
    try:
        words = sys.argv[1:] or ["--help"]
        code = app(words, prog_name="jaxilc", standalone_mode=False)
        if code == INTERRUPTED:
            leave()
        sys.exit(code or 0)
    except Exception as error:
        usage = hasattr(error, "format_message")  # raised by Typer
        if not (usage or isinstance(error, ValueError | OSError)):
            raise
        said = f"error: {_of_usage(error) if usage else _said(error)}"
        with suppress(OSError):  # a full disk takes no message either
            for text in (traceback.format_exc(), said) if tracebacks() else (said,):
                err.print(text, soft_wrap=True)
        sys.exit(3 if isinstance(error, Refused) else 2)
    finally:
        ended()


def _in_one_line(message: Warning | str, *_: Any, **__: Any) -> None:
    """Print a warning of Python's kind, without the line of code that gave it."""
    warn(f"warning: {_short(str(message))}")


def _of_usage(error: Any) -> str:
    """The message of an error that Typer raises, with the option and its value."""
    said, cause = error.format_message(), getattr(error.__cause__, "errors", None)
    if cause is not None:  # which leave out the value
        names, wrong = error.param.opts or [error.param.human_readable_name], cause()[0]
        said = f"{max(names, key=len)} {wrong['input']!r} {NO_VALUE.get(wrong['type'], '')}"
    context = getattr(error, "ctx", None)
    asked = f"; {context.command_path} -h tells what is allowed" if context else ""
    return _short(f"{said[:1].lower()}{said[1:].rstrip('.')}{asked}")


def _said(error: Exception) -> str:
    """The message of an error in a short line; for an OSError the file, then what is wrong."""
    said = str(error)
    if isinstance(error, OSError) and error.strerror:
        place = error.filename2 or error.filename or "input or output"
        said = f"{place}: {error.strerror.lower()}"
    return _short(said)


def _short(said: str) -> str:
    """A message in one line, without the middle of long words."""
    said = LONG_WORD.sub(r"\1...\2", " ".join(said.split("\n")))
    return said if len(said) <= LONGEST else f"{said[: LONGEST - 4]} ..."
