"""Names that were changed, so that what was written under the earlier ones is still understood.

A drawn member of an uncertain set was called a sample, and is a machine; a number that judges a
trial was called a figure, and is a metric. Stores and folders made before say so in their
configurations.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any, TypeVar

EARLIER = {"samples": "machines", "figure": "metric"}  # in configurations

T = TypeVar("T")


def in_todays_names(configuration: Any) -> Any:
    """A configuration, as JSON, with today's names for those in `EARLIER`."""
    if isinstance(configuration, dict):
        return {EARLIER.get(n, n): in_todays_names(of) for n, of in configuration.items()}
    if isinstance(configuration, list):
        return [in_todays_names(of) for of in configuration]
    return configuration


def takes_also(**earlier: str) -> Callable[[type[T]], type[T]]:
    """A decorator of classes whose constructor takes keywords under earlier names, too.

    earlier: today's name of each. The constructor then raises TypeError where both are given.
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
