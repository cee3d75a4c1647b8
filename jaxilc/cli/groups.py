"""Options in groups: a command that takes a group has its options, which are declared once."""

from __future__ import annotations

import dataclasses
import functools
import inspect
from collections.abc import Callable
from typing import Any, get_type_hints

import typer


def add(app: typer.Typer, function: Callable[..., None], panel: str, name: str = "") -> None:
    """Add a command to the command line.

    A parameter of the function whose type is a dataclass is a group: the command has an option for
    each of its fields, and the function gets the object.

    panel: the group of commands in `jaxilc --help`
    name: name of the command; that of the function if not given
    """
    hints = get_type_hints(function, include_extras=True)
    shown, groups = {}, {}
    for parameter in inspect.signature(function).parameters.values():
        kind = hints[parameter.name]
        if dataclasses.is_dataclass(kind):
            of_group = get_type_hints(kind, include_extras=True)
            groups[parameter.name] = kind, [one.name for one in dataclasses.fields(kind)]
            for one in dataclasses.fields(kind):
                missing = one.default is dataclasses.MISSING
                default = inspect.Parameter.empty if missing else one.default
                shown[one.name] = _option(one.name, of_group[one.name], default)
        else:
            shown[parameter.name] = _option(parameter.name, kind, parameter.default)

    @functools.wraps(function)
    def command(**values: Any) -> None:
        of_groups = {
            group: kind(**{name: values.pop(name) for name in names})
            for group, (kind, names) in groups.items()
        }
        function(**of_groups, **values)

    ordered = sorted(shown.values(), key=lambda one: one.default is not inspect.Parameter.empty)
    command.__signature__ = inspect.Signature(ordered)  # ty: ignore[missing-attribute]
    command.__annotations__ = {one.name: one.annotation for one in ordered}
    app.command(name or None, rich_help_panel=panel)(command)


def _option(name: str, kind: Any, default: Any) -> inspect.Parameter:
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=kind)
