"""The fields of nested pytrees by their paths, such as `plant.poles[2]`.

They can be listed, looked up and replaced. A path leads through dictionaries, through classes of
`@pytree`, and through pytrees of other libraries that are registered with JAX. The children of the
latter have the keys that JAX gives them: `plant.law.layers[0].weight[1][2]`.
"""

from __future__ import annotations

import dataclasses
import inspect
import itertools
import re
import typing
from collections.abc import Callable, Iterable, Mapping

import jax
import numpy as np

from .aliases import Tree, Value
from .closest import known_names
from .fields import is_decorated, kind_of
from .ranges import Interval, annotations_of, as_numbers, brief, named

_INDEX = re.compile(r"^(\w[\w-]*)((?:\[\d+\])*)$")
_ANY = Interval.parse("(-inf, inf)")
_READ: dict[Value, Callable[[str], Value]] = {
    int: int,
    bool: lambda text: {"true": True, "1": True, "false": False, "0": False}[text.lower()],
}

Key = str | int  # a name, or the number of an element


def named_leaves(tree: Tree) -> dict[str, Value]:
    """All leaves by their paths, for instance `{"plant.gain": ..., "sensor.resolution": ...}`."""
    return {
        _path_of(map(_key, path)): value
        for path, value in jax.tree_util.tree_flatten_with_path(tree)[0]
    }


def settable(tree: Tree) -> dict[str, Value]:
    """All leaves and all static fields by their paths, which are those that `replaced` accepts."""
    return {_path_of(keys): value for keys, value in _settable(tree).items()}


def interval_at(tree: Tree, path: str) -> Interval | None:
    """The allowed range of the field at `path`, or None for a field without an allowed range.

    A leaf of a pytree of another library may be any number.
    """
    owner, field = _field_at(tree, path)
    if _is_foreign(owner):
        return _ANY
    return field.metadata.get("interval") if field is not None else None


def allowed_at(tree: Tree, path: str) -> str:
    """The allowed range or the allowed choices of the field at `path`, as text."""
    _, field = _field_at(tree, path)
    choices = field.metadata.get("choices") if field is not None else None
    return " | ".join(map(str, choices)) if choices else str(interval_at(tree, path) or "")


def kind_at(tree: Tree, path: str) -> tuple[str, Value]:
    """The kind (`leaf`, `static` or `child`) and the annotation of the field at `path`.

    An element has the kind of its field.
    """
    owner, field = _field_at(tree, path)
    if _is_foreign(owner):
        return "leaf", Tree
    if field is None:
        return "child", Tree
    kind: type = type(owner)
    return kind_of(field), annotations_of(kind).get(field.name, Tree)


def need_leaf(said: str, tree: Tree, path: str) -> None:
    """Raises ValueError for a number in a field that its class does not declare as a leaf.

    Such a field has no range, and its class may refuse a number that is traced.
    """
    owner, field = _field_at(tree, path)
    if field is None or kind_of(field) != "child":
        return
    value = get_at(tree, path)
    if as_numbers(value) is not None:
        raise ValueError(
            f"{said}: {path} = {brief(value)} is no leaf of {type(owner).__name__}; declare its "
            "field with leaf() (from jaxilc.pytree)"
        )


def get_at(tree: Tree, path: str) -> Value:
    """The leaf, element or static field at `path`, such as `"plant.poles[2]"`.

    Raises KeyError for a path that does not exist; the message names those that exist.
    """
    value, name = tree, ""
    for key in _keys(path):
        below = _below(value)
        if isinstance(key, str):
            if key not in below:
                raise KeyError(
                    f"{path!r} is not a parameter here; {known_names(path, settable(tree))}"
                )
            value, name = below[key], key
        elif key in below:
            value = below[key]
        else:
            shape = (len(value),) if isinstance(value, list | tuple) else np.shape(value)
            if not shape or key >= shape[0]:
                raise KeyError(f"{path!r}: {name} has shape {shape}")
            with jax.ensure_compile_time_eval():  # a known array has a known element inside `jit`
                value = value[key]
    return value


def replaced(tree: Tree, changes: Mapping[str, Value]) -> Value:
    """A copy of `tree` with the fields or elements at the given paths replaced together.

    The new values are validated as in a constructor. A leaf of a pytree of another library keeps
    its shape and its precision.
    Raises KeyError for a path that does not exist, and ValueError for a value that is not allowed.
    """
    for path in changes:
        get_at(tree, path)
    return _rebuilt(tree, {_keys(path): value for path, value in changes.items()})


def overlapping(paths: Iterable[str]) -> tuple[str, str] | None:
    """Two paths of which the first leads to all that the second does; None where there are none."""
    pairs = itertools.permutations([(path, _keys(path)) for path in paths], 2)
    return next(((one, two) for (one, a), (two, b) in pairs if b[: len(a)] == a), None)


def owner_of(path: str, owners: Iterable[str]) -> tuple[str, str]:
    """The owner of a path, one of several or else `machine`, and the path within it.

    `machine.` before a path within the machine may be left out.
    """
    head, _, rest = path.partition(".")
    return (head, rest) if head in ("machine", *owners) else ("machine", path)


def unit_at(tree: Tree, path: str) -> str:
    """The unit of the field at `path`, as the docstring of its class has it; empty if it has none.

    It is the first text in square brackets behind the name that is no interval: `[N/m]`.
    """
    owner, field = _field_at(tree, path)
    line = rf"^ *(?:\w+, )*{field.name if field else ' '}(?:, \w+)*:(.*(?:\n {{5,}}\S.*)*)"
    found = re.search(line, inspect.getdoc(type(owner)) or "", re.M)
    unit = re.search(r" \[([^\[\],\d][^\[\],]*)\]", found[1]) if found else None
    return unit[1] if unit else ""


def read_at(tree: Tree, path: str, value: Value, shown: str) -> Value:
    """The value, which may be text, converted to the type of the field at the path.

    A static field has the type of its annotation; all others are numbers.

    Raises KeyError for the path of a part, and ValueError for text that is no such value.
    """
    kind, annotation = kind_at(tree, path)
    if kind == "child":
        raise KeyError(path)
    if not isinstance(value, str):
        return value
    choices = [
        one for one in (typing.get_args(annotation) or (annotation,)) if one is not type(None)
    ]
    if kind == "static" and str in choices:
        return value
    if value.lower() == "none":
        return None
    parts = [part.strip() for part in value.strip("()[] ").split(",")]
    try:
        read = float if kind == "leaf" else _READ.get(choices[0], float)
        origin: Value = typing.get_origin(annotation)
        if kind == "static" and origin is tuple:
            return tuple(read(part) for part in parts if part)
        numbers = [read(part) for part in parts]
        return numbers if len(numbers) > 1 else numbers[0]
    except (ValueError, KeyError):
        said = (
            "a number, or numbers with commas between them" if kind == "leaf" else named(annotation)
        )
        raise ValueError(f"{shown} = {brief(value)} is not {said}") from None


def field_names(tree: Tree) -> list[str]:
    if isinstance(tree, dict):
        return list(tree)
    return [f.name for f in dataclasses.fields(tree)] if dataclasses.is_dataclass(tree) else []


def field_of(tree: Tree, name: Key) -> dataclasses.Field[Value] | None:
    """The declaration of a field; None if it has none, such as an entry of a dictionary."""
    if isinstance(tree, dict) or not dataclasses.is_dataclass(tree) or _is_foreign(tree):
        return None
    return next((f for f in dataclasses.fields(tree) if f.name == name), None)


def child_of(tree: Tree, name: Key) -> Value:
    return tree[name] if isinstance(tree, dict) else getattr(tree, str(name))


# Implementation
# --------------------------------------------------------------------------------------------------


def _is_foreign(tree: Tree) -> bool:
    """Whether `tree` is a pytree that another library registered with JAX, or a list or a tuple."""
    if isinstance(tree, dict) or is_decorated(type(tree)):
        return False
    return not jax.tree_util.all_leaves([tree])


def _one_level(tree: Tree) -> tuple[list[Key], list[Value], Value]:
    """The keys and values of the children of a pytree, and its structure with these as leaves."""
    pairs, structure = jax.tree_util.tree_flatten_with_path(tree, lambda node: node is not tree)
    return [_key(path[0]) for path, _ in pairs], [value for _, value in pairs], structure


def _below(tree: Tree) -> dict[Key, Value]:
    """The children of a pytree, by name or number; an array has none."""
    if not _is_foreign(tree):
        return {name: child_of(tree, name) for name in field_names(tree)}
    keys, values, _ = _one_level(tree)
    return dict(zip(keys, values, strict=True))


def _settable(tree: Tree) -> dict[tuple[Key, ...], Value]:
    found: dict[tuple[Key, ...], Value] = {}
    for key, value in _below(tree).items():
        field = field_of(tree, key)
        is_child = field is None or kind_of(field) == "child"
        deeper = _settable(value) if is_child or field_names(value) else {}
        if deeper:
            found |= {(key, *keys): below for keys, below in deeper.items()}
        elif not is_child or isinstance(tree, dict) or hasattr(value, "dtype"):
            found[(key,)] = value
    return found


def _field_at(tree: Tree, path: str) -> tuple[Tree, Tree]:
    """The object that has the field at `path`, and that field."""
    node, owner, field = tree, tree, None
    for key in _keys(path):
        below = _below(node) if field is None or kind_of(field) == "child" else {}
        if key in below:
            owner, field, node = node, field_of(node, key), below[key]
        else:
            node = node[key]
    return owner, field


def _rebuilt(tree: Tree, changes: dict[tuple[Key, ...], Value]) -> Value:
    """The tree with new values at the given keys."""
    if not _below(tree):
        if _are_all_elements(tree, changes):
            return _of_elements(tree, changes)
        for index, value in changes.items():
            tree = _with_element(tree, index, value)
        return tree
    whole: dict[Key, Value] = {}
    parts: dict[Key, dict[tuple[Key, ...], Value]] = {}
    for (key, *rest), value in changes.items():
        if rest:
            parts.setdefault(key, {})[tuple(rest)] = value
        else:
            whole[key] = value
            parts.pop(key, None)
    if _is_foreign(tree):
        return _rebuilt_foreign(tree, whole, parts)
    below = _below(tree) | whole
    new = whole | {key: _rebuilt(below[key], deeper) for key, deeper in parts.items()}
    if isinstance(tree, dict):
        return {**tree, **new}
    return dataclasses.replace(tree, **{str(name): value for name, value in new.items()})


def _rebuilt_foreign(
    tree: Tree, whole: dict[Key, Value], parts: dict[Key, dict[tuple[Key, ...], Value]]
) -> Tree:
    keys, values, structure = _one_level(tree)
    for i, key in enumerate(keys):
        if key in whole:
            values[i] = _like(values[i], whole[key], f"{type(tree).__name__}: {key}")
        if key in parts:
            values[i] = _rebuilt(values[i], parts[key])
    return jax.tree.unflatten(structure, values)


def _like(old: Value, new: Value, name: str) -> Value:
    """The new value for a leaf, with the shape and the precision of the old one.

    What is not a leaf may be replaced by anything.
    Raises ValueError for a value of another shape, and for what is not numbers.
    """
    if not hasattr(old, "dtype"):
        return new
    if not hasattr(new, "dtype") and as_numbers(new) is None:
        raise ValueError(f"{name} = {brief(new)} is not a number or an array of numbers")
    if np.shape(new) != np.shape(old):
        raise ValueError(f"{name} has shape {np.shape(new)}; allowed is {np.shape(old)}")
    return jax.numpy.asarray(new, jax.numpy.result_type(old))


def _keys(path: str) -> tuple[Key, ...]:
    if not isinstance(path, str):
        raise KeyError(f"{path!r} is not a parameter name such as gain or poles[2]")
    return tuple(key for head in path.split(".") for key in _split_index(head))


def _split_index(head: str) -> tuple[Key, ...]:
    match = _INDEX.match(head)
    if not match:
        raise KeyError(f"{head!r} is not a parameter name such as gain or poles[2]")
    return match.group(1), *(int(i) for i in re.findall(r"\d+", match.group(2)))


def _with_element(old: Value, index: Value, value: Value) -> Value:
    if isinstance(old, jax.Array) or isinstance(value, jax.Array):
        return jax.numpy.asarray(old).at[index].set(value)
    new = np.array(old)
    try:
        new[index] = value
    except TypeError:
        raise ValueError(f"{brief(value)} is not a number, which an element must be") from None
    return new


def _are_all_elements(old: Value, changes: Value) -> bool:
    """Whether the changes are numbers for all elements of an array, at least one within JAX."""
    return (
        len(changes) == np.size(old) > 1
        and all(len(index) == np.ndim(old) and not np.ndim(v) for index, v in changes.items())
        and any(isinstance(value, jax.Array) for value in changes.values())
    )


def _of_elements(old: Value, changes: Value) -> Value:
    """The array of these elements: one operation, where as many replacements compile for long."""
    dtype = jax.numpy.result_type(old)  # that which JAX can have: float32 in single precision
    values = [jax.numpy.asarray(changes[index], dtype) for index in np.ndindex(np.shape(old))]
    return jax.numpy.stack(values).reshape(np.shape(old))


def _key(entry: Value) -> Key:
    """The name or number by which JAX identifies a child."""
    match entry:
        case jax.tree_util.GetAttrKey(name=name) | jax.tree_util.DictKey(key=name):
            return name
        case jax.tree_util.SequenceKey(idx=i) | jax.tree_util.FlattenedIndexKey(key=i):
            return i
    return str(entry)


def _path_of(keys: Value) -> str:
    text = "".join(f"[{key}]" if isinstance(key, int) else f".{key}" for key in keys)
    return text.removeprefix(".")
