"""The fields of nested pytrees under their paths, such as `plant.poles[2]`: listed, looked up,
replaced.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

from .fields import kind_of
from .ranges import Interval, annotations_of, brief

_INDEX = re.compile(r"^(\w[\w-]*)((?:\[\d+\])*)$")


def named_leaves(tree) -> dict[str, Any]:
    """Every leaf under its path, for instance `{"plant.gain": ..., "sensor.resolution": ...}`."""
    return {
        _path_name(path): value for path, value in jax.tree_util.tree_flatten_with_path(tree)[0]
    }


def settable(tree) -> dict[str, Any]:
    """Every leaf *and* every static field under its path: what `replaced` accepts."""
    found: dict[str, Any] = {}
    for name in field_names(tree):
        value, field = child_of(tree, name), field_of(tree, name)
        if field_names(value):
            found |= {f"{name}.{path}": v for path, v in settable(value).items()}
        elif field is None or kind_of(field) != "child":
            found[name] = value
    return found


def interval_at(tree, path: str) -> Interval | None:
    """The allowed range declared for the field at `path` (None for a field without one)."""
    _, field = _field_at(tree, path)
    return field.metadata.get("interval") if field is not None else None


def allowed_at(tree, path: str) -> str:
    """What the field at `path` accepts, as text: a range, or a choice."""
    _, field = _field_at(tree, path)
    choices = field.metadata.get("choices") if field is not None else None
    return " | ".join(map(str, choices)) if choices else str(interval_at(tree, path) or "")


def kind_at(tree, path: str) -> tuple[str, Any]:
    """`leaf`, `static` or `child`, and the annotation, of the field at `path`; an element is of its
    field's kind.
    """
    owner, field = _field_at(tree, path)
    return (
        ("child", Any)
        if field is None
        else (kind_of(field), annotations_of(type(owner)).get(field.name, Any))
    )


def get_at(tree, path: str) -> Any:
    """The leaf, element or static field at `path`: `"plant.poles[2]"`. Raises KeyError naming what
    exists.
    """
    value = tree
    for head in path.split("."):
        name, index = _split_index(head)
        if name not in field_names(value):
            raise KeyError(
                f"{path!r} is not a parameter here; known: {', '.join(settable(tree)) or 'none'}"
            )
        value = child_of(value, name)
        for i in index:
            if not np.shape(value) or i >= len(value):
                raise KeyError(f"{path!r}: {name} has shape {np.shape(value)}")
            value = value[i]
    return value


def replaced(tree, changes: Mapping[str, Any]) -> Any:
    """A copy of `tree` with the fields or elements at the given paths replaced together; validated
    like a construction.
    """
    inner: dict[str, dict[str, Any]] = {}
    new: dict[str, Any] = {}
    for path, value in changes.items():
        get_at(tree, path)
        head, _, rest = path.partition(".")
        name, index = _split_index(head)
        if rest:
            inner.setdefault(name, {})[rest] = value
        else:
            new[name] = (
                _with_element(new.get(name, child_of(tree, name)), index, value) if index else value
            )
    new |= {name: replaced(child_of(tree, name), below) for name, below in inner.items()}
    return {**tree, **new} if isinstance(tree, dict) else dataclasses.replace(tree, **new)


def field_names(tree) -> list[str]:
    if isinstance(tree, dict):
        return list(tree)
    return [f.name for f in dataclasses.fields(tree)] if dataclasses.is_dataclass(tree) else []


def field_of(tree, name):
    return (
        None
        if isinstance(tree, dict)
        else next((f for f in dataclasses.fields(tree) if f.name == name), None)
    )


def _field_at(tree, path: str):
    """The object that has the field at `path`, and that field."""
    head, _, rest = path.partition(".")
    name, _ = _split_index(head)
    return _field_at(child_of(tree, name), rest) if rest else (tree, field_of(tree, name))


def child_of(tree, name):
    return tree[name] if isinstance(tree, dict) else getattr(tree, name)


def _split_index(head: str) -> tuple[str, tuple[int, ...]]:
    match = _INDEX.match(head)
    if not match:
        raise KeyError(f"{head!r} is not a parameter name such as gain or poles[2]")
    return match.group(1), tuple(int(i) for i in re.findall(r"\d+", match.group(2)))


def _with_element(old, index, value):
    if isinstance(old, jax.Array) or isinstance(value, jax.Array):
        return jax.numpy.asarray(old).at[index].set(value)
    new = np.array(old)
    try:
        new[index] = value
    except TypeError:
        raise ValueError(f"{brief(value)} is not a number, which an element must be") from None
    return new


def _path_name(path) -> str:
    text = ""
    for key in path:
        match key:
            case jax.tree_util.GetAttrKey(name=name) | jax.tree_util.DictKey(key=name):
                text += f".{name}"
            case jax.tree_util.SequenceKey(idx=i) | jax.tree_util.FlattenedIndexKey(key=i):
                text += f"[{i}]"
    return text.removeprefix(".")
