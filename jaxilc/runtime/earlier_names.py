"""Names that were changed, and fields that were added, so that earlier files can still be read.

A drawn member of an uncertain set was called a sample and is now called a machine. A number that
judges a trial was called a figure and is now called a metric. Stores and folders that were made
before this change have the earlier names in their configurations.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import TypeVar, cast

from ..pytree.aliases import Json, Value

EARLIER = {"samples": "machines", "figure": "metric"}  # in configurations
# Fields of classes that earlier configurations do not have, with the value that changes nothing.
ADDED: dict[str, dict[str, Json]] = {
    "Task": {"names": []},
    "ProcessModel": {"delay": 0.0},
    "Machine": {"variation": None},
    "Variation": {"delayed": None, "delay": 1},
    "PlantChange": {"course": None},
    "BallScrewDrive": {"substeps": 1},
}

T = TypeVar("T")


def in_todays_names(configuration: object) -> object:
    """A configuration, as JSON, with the present names in place of those in `EARLIER`.

    It also has the fields in `ADDED`.
    """
    if isinstance(configuration, dict):
        added = ADDED.get(str(configuration.get("class")), {})
        return added | {EARLIER.get(n, n): in_todays_names(of) for n, of in configuration.items()}
    if isinstance(configuration, list):
        return [in_todays_names(of) for of in configuration]
    return configuration


def takes_also(**earlier: str) -> Callable[[T], T]:
    """A decorator of a class or a function that then accepts keywords under earlier names, too.

    earlier: the present name for each earlier name
    A call then raises TypeError where both names are given.
    """

    def decorated(known: T) -> T:
        """The same class with another constructor, or a function around the given one."""
        of: Value = known
        is_class = isinstance(known, type)
        call = of.__init__ if is_class else of

        @wraps(call)
        def under_todays_names(*arguments: Value, **options: Value) -> Value:
            for name, today in earlier.items():
                if name in options and today in options:
                    raise TypeError(f"{of.__name__}: {name} is now {today}; both were given")
                if name in options:
                    options[today] = options.pop(name)
            return call(*arguments, **options)

        if not is_class:
            return cast("T", under_todays_names)
        of.__init__ = under_todays_names
        return known

    return decorated
