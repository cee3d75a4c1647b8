"""`jaxilc demo`: the story in half a minute."""

from __future__ import annotations

import typer

from .groups import add
from .options import SIMULATE, Written
from .present import tell


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""
    add(app, demo, SIMULATE)


def demo(written: Written) -> None:
    """A law that looks good and diverges, the certificate that knew, a tuned one.

    A made-up axis learns; theory is asked; a law is tuned by gradient and judged
    on a thousand machines. Half a minute, nothing to prepare.

    Example: jaxilc demo --report demo.html
    """
    tell("demo", written.out_dir, written)
