"""The command line, run in this process, and what its tests share."""

import contextlib
import io
import shlex
import sys
from unittest import mock

import numpy as np
from typer.testing import CliRunner

from jaxilc.cli import app, main


def call(*words):
    """Run `jaxilc` with these words; return exit code, standard output and standard error."""
    out, err, code = io.StringIO(), io.StringIO(), 0
    with (
        mock.patch.object(sys, "argv", ["jaxilc", *map(str, words)]),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
    ):
        try:
            main()
        except SystemExit as stop:
            code = stop.code or 0
    return code, out.getvalue(), err.getvalue()


def invoked(*words):
    """Run `jaxilc`; return exit code, standard output and standard error. A mistake raises."""
    result = CliRunner().invoke(app, [*map(str, words)])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.exit_code, result.stdout, result.stderr


def done(*words):
    """Run `jaxilc`, which must end without an error; return what it printed."""
    code, out, err = call(*words)
    assert code == 0, err
    return out


def refused(*words):
    """Run `jaxilc`, which must refuse that; return its message, the last line."""
    code, _, err = call(*words)
    *_, said = err.splitlines()
    assert (code, said[:7]) == (2, "error: "), err
    return said


def flat(text):
    """Return a text without the ends of its lines."""
    return " ".join(text.split())


def write_columns(path, header, *columns):
    """Write a measured file: columns of numbers below a header."""
    np.savetxt(path, np.column_stack(columns), delimiter=",", header=header, comments="")


def mistakes(text):
    """Return the words and the expected message of each line `WORDS => MESSAGE`."""
    lines = (line.split(" => ") for line in text.strip().split("\n"))
    return [(shlex.split(words), message) for words, message in lines]
