"""Dataclasses that are JAX pytrees: an object *is* its parameters.

`@pytree` turns a class into a frozen dataclass whose float fields are leaves (batched by `vmap`, differentiated by `grad`)
and whose `static` fields are part of the compiled program. Each field states its allowed range once; construction, the
command line and the tuner all read it from there. Validation runs only when a user constructs an object: unflattening inside
a transformation bypasses `__init__`, so tracers are never inspected.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeAlias, TypeVar, dataclass_transform

import jax.core
import numpy as np
from jax.typing import ArrayLike

from .ranges import Interval, allowed, annotations_of, as_numbers, brief, fits, is_number, is_whole, shown

Numbers: TypeAlias = ArrayLike | Sequence[Any] | None
T = TypeVar("T")
_INDEX = re.compile(r"^(\w[\w-]*)((?:\[\d+\])*)$")


def _stored(value: Numbers) -> Any:
    """What construction makes of a leaf, in the eyes of a type checker; `_settled` does it."""


def leaf(
    default: Any = dataclasses.MISSING,
    interval: str = "(-inf, inf)",
    *,
    optional: bool = False,
    converter: Callable[[Numbers], Any] = _stored,  # a type checker reads it: numbers and lists are accepted where an array is stored
) -> Any:
    """A float leaf (scalar or array). With `optional`, None switches the feature off at no cost."""
    metadata = {"kind": "leaf", "interval": Interval.parse(interval), "optional": optional}
    return dataclasses.field(default=default, metadata=metadata)


def scalar(
    default: Any = dataclasses.MISSING,
    interval: str = "(-inf, inf)",
    *,
    optional: bool = False,
    converter: Callable[[Numbers], Any] = _stored,
) -> Any:
    """A float leaf that is one number, such as a mass; `need_scalars` says so, since a batch of objects has many of each."""
    metadata = {"kind": "leaf", "interval": Interval.parse(interval), "optional": optional, "scalar": True}
    return dataclasses.field(default=default, metadata=metadata)


def static(
    default: Any = dataclasses.MISSING, interval: str | None = None, *, choices: tuple = (), whole: bool = False, optional: bool = False
) -> Any:
    """A static field: a length, a window, a mode, of the kind that it is annotated with. Changing it compiles another program.

    `whole` admits whole numbers only. Lists become tuples.
    """
    parsed = Interval.parse(interval) if interval else None
    metadata = {"kind": "static", "interval": parsed, "choices": tuple(choices), "whole": whole, "optional": optional}
    return dataclasses.field(default=default, metadata=metadata)


def part(default: Any = dataclasses.MISSING) -> Any:
    """A nested pytree (a plant in a machine, a scheme in a scheme), of the class or the classes that it is annotated with."""
    return dataclasses.field(default=default, metadata={"kind": "part"})


@dataclass_transform(frozen_default=True, field_specifiers=(leaf, scalar, static, part))
def pytree(cls: type[T]) -> type[T]:
    """Make the class a frozen dataclass and a pytree. Fields are declared with `leaf`, `scalar`, `static` or `part`.

    Raises at construction: ValueError naming the class, the field, its value and the allowed range.
    """
    made: Any = cls
    if "__post_init__" in cls.__dict__:
        made._own_check = made.__post_init__

    def __post_init__(self):
        for field in dataclasses.fields(self):
            object.__setattr__(self, field.name, _settled(type(self), field, getattr(self, field.name)))
        if hasattr(self, "_own_check"):
            self._own_check()

    made.__post_init__ = __post_init__
    made = dataclasses.dataclass(frozen=True, eq=False)(cls)
    fields = dataclasses.fields(made)
    children = tuple(f.name for f in fields if _kind(f) != "static")
    statics = tuple(f.name for f in fields if _kind(f) == "static")

    def flatten(tree):
        return tuple(getattr(tree, n) for n in children), tuple(getattr(tree, n) for n in statics)

    def flatten_with_keys(tree):
        values, aux = flatten(tree)
        return tuple(zip(map(jax.tree_util.GetAttrKey, children), values, strict=True)), aux

    def unflatten(aux, values):
        tree = object.__new__(made)
        for name, value in zip(children, values, strict=True):
            object.__setattr__(tree, name, value)
        for name, value in zip(statics, aux, strict=True):
            object.__setattr__(tree, name, value)
        return tree

    jax.tree_util.register_pytree_with_keys(made, flatten_with_keys, unflatten, flatten)
    return made


def named_leaves(tree) -> dict[str, Any]:
    """Every leaf under its path, for instance `{"plant.gain": ..., "sensor.resolution": ...}`."""
    return {_path_name(path): value for path, value in jax.tree_util.tree_flatten_with_path(tree)[0]}


def settable(tree) -> dict[str, Any]:
    """Every leaf *and* every static field under its path: what `replaced` accepts."""
    found: dict[str, Any] = {}
    for name in _names(tree):
        value, field = _child(tree, name), _field(tree, name)
        if _names(value):
            found |= {f"{name}.{path}": v for path, v in settable(value).items()}
        elif field is None or _kind(field) != "part":
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
    """`leaf`, `static` or `part`, and the annotation, of the field at `path`; an element is of its field's kind."""
    owner, field = _field_at(tree, path)
    return ("part", Any) if field is None else (_kind(field), annotations_of(type(owner)).get(field.name, Any))


def get_at(tree, path: str) -> Any:
    """The leaf, element or static field at `path`: `"plant.poles[2]"`. Raises KeyError naming what exists."""
    value = tree
    for head in path.split("."):
        name, index = _split_index(head)
        if name not in _names(value):
            raise KeyError(f"{path!r} is not a parameter here; known: {', '.join(settable(tree)) or 'none'}")
        value = _child(value, name)
        for i in index:
            if not np.shape(value) or i >= len(value):
                raise KeyError(f"{path!r}: {name} has shape {np.shape(value)}")
            value = value[i]
    return value


def replaced(tree, changes: Mapping[str, Any]) -> Any:
    """A copy of `tree` with the fields or elements at the given paths replaced together; validated like a construction."""
    inner: dict[str, dict[str, Any]] = {}
    new: dict[str, Any] = {}
    for path, value in changes.items():
        get_at(tree, path)
        head, _, rest = path.partition(".")
        name, index = _split_index(head)
        if rest:
            inner.setdefault(name, {})[rest] = value
        else:
            new[name] = _with_element(new.get(name, _child(tree, name)), index, value) if index else value
    new |= {name: replaced(_child(tree, name), below) for name, below in inner.items()}
    return {**tree, **new} if isinstance(tree, dict) else dataclasses.replace(tree, **new)


def known(tree) -> bool:
    """Whether every leaf has a value that can be looked at, rather than being traced by a transformation."""
    return not any(isinstance(x, jax.core.Tracer) for x in jax.tree.leaves(tree))


def need_channels(tree, channels: int, *names: str) -> None:
    """Raises ValueError unless each named field is one number, or one for each channel, or absent."""
    for name in names:
        value = getattr(tree, name)
        if value is not None and np.shape(value) not in ((), (channels,)):
            raise ValueError(f"{type(tree).__name__}: {name} has shape {np.shape(value)}; allowed are () and ({channels},)")


def need_scalars(tree) -> None:
    """Raises ValueError for a `scalar` of the tree, or of a part of it, that is several numbers."""
    for name in _names(tree):
        value, field = _child(tree, name), _field(tree, name)
        if field is not None and field.metadata.get("scalar") and np.shape(value):
            given = "" if isinstance(value, jax.core.Tracer) else f" = {shown(value)}"
            raise ValueError(f"{type(tree).__name__}: {name}{given} has shape {np.shape(value)}; allowed is one number")
        need_scalars(value)


def _kind(field) -> str:
    return field.metadata.get("kind", "part")


def _settled(cls: type, field, value):
    """The value a field really stores: floats as strongly typed arrays, everything of its kind and inside its allowed range."""
    owner, kind = cls.__name__, _kind(field)
    if kind == "leaf":
        return None if value is None and field.metadata["optional"] else _checked_leaf(owner, field, value)
    wanted = annotations_of(cls).get(field.name, Any)
    if kind == "static":
        value = tuple(value) if isinstance(value, list) else value
        _check_static(owner, field, value, wanted)
    elif not fits(value, wanted):
        given = "" if dataclasses.is_dataclass(value) and not isinstance(value, type) else f" = {brief(value)}"
        raise ValueError(f"{owner}: {field.name}{given} is a {type(value).__name__}; {allowed(wanted)}")
    return value


def _checked_leaf(owner: str, field, value):
    value = _as_float(owner, field.name, value)
    if not isinstance(value, jax.core.Tracer) and not field.metadata["interval"].contains(value):
        raise ValueError(f"{owner}: {field.name} = {shown(value)} is outside its allowed range {field.metadata['interval']}")
    return value


def _check_static(owner: str, field, value, wanted) -> None:
    choices, interval, whole = (field.metadata[k] for k in ("choices", "interval", "whole"))
    if value is None and field.metadata["optional"]:
        return
    if choices and not (fits(value, wanted) and value in choices):
        raise ValueError(f"{owner}: {field.name} = {brief(value)} is not one of {', '.join(map(repr, choices))}")
    if interval is not None and not (is_number(value) and interval.contains(value) and (is_whole(value) or not whole)):
        said = f"{interval}{' of whole numbers' if whole else ''}"
        raise ValueError(f"{owner}: {field.name} = {brief(value)} is outside its allowed range {said}")
    if not fits(value, wanted):
        raise ValueError(f"{owner}: {field.name} = {brief(value)} is a {type(value).__name__}; {allowed(wanted)}")


def _as_float(owner: str, name: str, value):
    if isinstance(value, jax.Array) and jax.numpy.issubdtype(value.dtype, jax.numpy.number) and not jax.numpy.iscomplexobj(value):
        floating = jax.numpy.issubdtype(value.dtype, jax.numpy.floating)
        return jax.lax.convert_element_type(value, value.dtype if floating else float)  # also makes a weak type strong
    found = None if isinstance(value, jax.Array) else as_numbers(value)
    if found is None:
        raise ValueError(f"{owner}: {name} = {brief(value)} is not a number or an array of numbers")
    return found


def _names(tree) -> list[str]:
    if isinstance(tree, dict):
        return list(tree)
    return [f.name for f in dataclasses.fields(tree)] if dataclasses.is_dataclass(tree) else []


def _field(tree, name):
    return None if isinstance(tree, dict) else next((f for f in dataclasses.fields(tree) if f.name == name), None)


def _field_at(tree, path: str):
    """The object that has the field at `path`, and that field."""
    head, _, rest = path.partition(".")
    name, _ = _split_index(head)
    return _field_at(_child(tree, name), rest) if rest else (tree, _field(tree, name))


def _child(tree, name):
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
