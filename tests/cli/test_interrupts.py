"""Ctrl-C ends the program in a moment, also where Python does not see it."""

import re
import subprocess
import sys
import time

import pytest
import typer.main

from jaxilc import cli
from jaxilc.cli import entry

# A shell lets what it starts in the background, such as these tests, ignore interrupts.
BEGIN = """
import os, signal, sys, time
signal.signal(signal.SIGINT, signal.default_int_handler)
def interrupt():
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(0.1)
class Imported:
    def find_spec(self, name, *_):
        if name == "jaxilc.cli.entry":
            try:
                interrupt()
            except KeyboardInterrupt:
                print("half of a module, as NumPy is", file=sys.stderr)
class Unseen:
    def __del__(self):
        interrupt()
def app(*_, **__):
    try:
        interrupt()
    except KeyboardInterrupt:
        return 130
def unseen(*_, **__):
    Unseen()
    time.sleep(60)
from jaxilc import cli
{then}
cli.main()
"""
LATER = "from jaxilc.cli import entry; entry.app = "


@pytest.mark.parametrize(
    "then", [f"{LATER}app", f"{LATER}unseen", "sys.meta_path.insert(0, Imported())"]
)
def test_an_interrupt_ends_the_process_and_says_how_to_go_on(then):
    """In a command that ends by itself; where nobody can catch it; while modules are imported."""
    begun = time.monotonic()
    done = subprocess.run(
        [sys.executable, "-c", BEGIN.format(then=then)],
        check=False, capture_output=True, text=True, timeout=50,
    )  # fmt: skip
    assert done.returncode == 130
    assert done.stderr.startswith("stopped; files that were written are whole: sweep, tune")
    assert done.stderr.count("\n") == 1, "no traceback"
    assert time.monotonic() - begun < 40  # 1 and 3 s on a quiet processor


def test_the_commands_that_go_on_are_those_with_resume():
    named = {one.strip() for one in re.split(r"[:,]| and | go on", cli.STOPPED)}
    commands = typer.main.get_command(entry.app).commands
    able = {name for name, of in commands.items() if "resume" in {one.name for one in of.params}}
    assert able == named & commands.keys()
    (of_code,) = (line for line in entry.EXIT_CODES if line.startswith("130"))
    assert able == {name for name in commands if name in re.findall(r"[a-z-]+", of_code)}
