"""Names that were changed, so that files with the earlier names can still be read.

A drawn member of an uncertain set was called a sample and is now called a machine. A number that
judges a trial was called a figure and is now called a metric. Stores and folders that were made
before this change have the earlier names in their configurations.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any, TypeVar

EARLIER = {"samples": "machines", "figure": "metric"}  # in configurations

T = TypeVar("T")


def in_todays_names(configuration: Any) -> Any:
    """A configuration, as JSON, with the present names in place of those in `EARLIER`."""
    if isinstance(configuration, dict):
        return {EARLIER.get(n, n): in_todays_names(of) for n, of in configuration.items()}
    if isinstance(configuration, list):
        return [in_todays_names(of) for of in configuration]
    return configuration


def takes_also(**earlier: str) -> Callable[[type[T]], type[T]]:
    """A class decorator that makes the constructor accept keywords under earlier names, too.

    earlier: the present name for each earlier name
    The constructor then raises TypeError where both names are given.
    """

    def decorated(cls: type[T]) -> type[T]:
        known: Any = cls
        construct = known.__init__

        @wraps(construct)
        def __init__(self, *arguments, **options):
            for name, today in earlier.items():
                if name in options and today in options:
                    raise TypeError(f"{cls.__name__}: {name} is now {today}; both were given")
                if name in options:
                    options[today] = options.pop(name)
            construct(self, *arguments, **options)

        known.__init__ = __init__
        return cls

    return decorated
