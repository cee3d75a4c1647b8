"""Dataclasses that are JAX pytrees, so that an object consists of its parameters alone.

`@pytree` turns a class into a frozen dataclass. Its float fields are leaves, which `vmap` batches
and `grad` differentiates; its `static` fields are part of the compiled program. Each field declares
its allowed range once; the constructor, the command line and the tuner all use this declaration.
Values are validated only when a user constructs an object: unflattening inside a transformation
bypasses `__init__`, so tracers are never inspected.
"""

from __future__ import annotations

import dataclasses
from typing import TypeVar, dataclass_transform

import jax.core
import numpy as np

from .aliases import Tree, Value
from .in_short import in_short
from .ranges import (
    TRACED,
    Interval,
    allowed,
    annotations_of,
    as_annotated,
    as_numbers,
    brief,
    concrete,
    fits,
    is_number,
    is_whole,
    outside,
)

T = TypeVar("T")
DEEPEST = 8  # level of nested tuples up to which a static value is looked at


def leaf(
    default: Value = dataclasses.MISSING, interval: str = "(-inf, inf)", *, optional: bool = False
) -> Value:
    """A float leaf, which is a scalar or an array.

    default: default value; a type checker sees it only if it is given by name: `leaf(default=0.5)`
    interval: allowed range of each element
    optional: whether None is allowed, which switches the feature off at no cost
    """
    metadata = {"kind": "leaf", "interval": Interval.parse(interval), "optional": optional}
    return dataclasses.field(default=default, metadata=metadata)


def scalar(
    default: Value = dataclasses.MISSING, interval: str = "(-inf, inf)", *, optional: bool = False
) -> Value:
    """A float leaf that is one number, such as a mass; `need_scalars` refuses an array.

    default, interval, optional: as for `leaf`
    """
    metadata = {"kind": "leaf", "interval": Interval.parse(interval), "optional": optional}
    return dataclasses.field(default=default, metadata=metadata | {"scalar": True})


def static(
    default: Value = dataclasses.MISSING,
    interval: str | None = None,
    *,
    choices: tuple[Value, ...] = (),
    whole: bool = False,
    optional: bool = False,
) -> Value:
    """A static field, such as a length, a window or a mode; another value needs another program.

    The value must have the type with which the field is annotated. Lists become tuples; 0-d arrays
    and numbers of NumPy become numbers of Python, which are equal only where they are the same.

    default: default value
    interval: allowed range of a number; None: no range
    choices: allowed values; an empty tuple: any value
    optional: whether None is allowed
    """
    parsed = Interval.parse(interval) if interval else None
    metadata = {
        "kind": "static",
        "interval": parsed,
        "choices": tuple(choices),
        "whole": whole,
        "optional": optional,
    }
    return dataclasses.field(default=default, metadata=metadata)


def child(default: Value = dataclasses.MISSING) -> Value:
    """A nested pytree, such as a plant in a machine or a scheme in a scheme.

    The value must be of the class, or of one of the classes, with which the field is annotated. If
    it is annotated with Any or with a class of another library, any pytree that is registered with
    JAX is allowed, such as a network of equinox. The float leaves of such a pytree have names too.
    """
    return dataclasses.field(default=default, metadata={"kind": "child"})


@dataclass_transform(frozen_default=True, field_specifiers=(leaf, scalar, static, child))
def pytree(cls: type[T]) -> type[T]:
    """A class decorator that makes the class a frozen dataclass and a pytree.

    Fields are declared with `leaf`, `scalar`, `static` or `child`. The constructor raises
    ValueError for a value that is not allowed. The message names the class, the field, its value
    and the allowed range.
    """
    made: Value = cls
    if "__post_init__" in cls.__dict__:
        made._own_check = made.__post_init__

    def __post_init__(self: Value) -> None:
        need_decorated(type(self))
        for field in dataclasses.fields(self):
            object.__setattr__(
                self, field.name, _settled(type(self), field, getattr(self, field.name))
            )
        if hasattr(self, "_own_check"):
            self._own_check()

    made.__post_init__ = __post_init__
    if "__repr__" not in vars(cls):
        made.__repr__ = in_short
    made = dataclasses.dataclass(frozen=True, eq=False)(cls)
    made._made_by_pytree = True
    fields = dataclasses.fields(made)
    children = tuple(f.name for f in fields if kind_of(f) != "static")
    statics = tuple(f.name for f in fields if kind_of(f) == "static")
    both = (*children, *statics)

    def flatten(tree: Tree) -> tuple[Tree, Tree]:
        return tuple(getattr(tree, n) for n in children), tuple(getattr(tree, n) for n in statics)

    def flatten_with_keys(tree: Tree) -> tuple[Tree, Tree]:
        values, aux = flatten(tree)
        return tuple(zip(map(jax.tree_util.GetAttrKey, children), values, strict=True)), aux

    def unflatten(aux: Value, values: Value) -> Value:
        tree = object.__new__(made)
        for name, value in zip(both, (*values, *aux), strict=True):
            object.__setattr__(tree, name, value)
        return tree

    jax.tree_util.register_pytree_with_keys(made, flatten_with_keys, unflatten, flatten)
    return made


def kind_of(field: dataclasses.Field[Value]) -> str:
    return field.metadata.get("kind", "child")


def is_decorated(cls: type) -> bool:
    """Whether `@pytree` was applied to the class itself, not only to one of its base classes."""
    return "_made_by_pytree" in vars(cls)


def need_decorated(cls: type) -> None:
    """Raises ValueError for a class that has no fields of its own because it lacks `@pytree`."""
    if "__dataclass_params__" not in vars(cls):
        raise ValueError(
            f"{cls.__name__}: the class is no pytree, so its fields would not be seen; write "
            f"@pytree (from jaxilc.pytree) above `class {cls.__name__}`"
        )


def _settled(cls: type, field: dataclasses.Field[Value], value: Value) -> Value:
    """The value that a field stores, after it was checked; floats become strongly typed arrays."""
    owner, kind = cls.__name__, kind_of(field)
    if kind == "leaf":
        if value is None and field.metadata["optional"]:
            return None
        return _checked_leaf(owner, field, value)
    wanted = annotations_of(cls).get(field.name, Tree)
    if kind == "static":
        value = _plain(value)
        _check_static(owner, field, value, wanted)
        value = as_annotated(value, wanted)
    elif isinstance(value, jax.core.Tracer) and not fits(value, wanted):
        raise ValueError(
            f"{owner}: {field.name} is traced, and its field is no leaf; declare a number that "
            "jit, vmap or grad may see with leaf() (from jaxilc.pytree)"
        )
    elif not fits(value, wanted):
        given = (
            ""
            if dataclasses.is_dataclass(value) and not isinstance(value, type)
            else f" = {brief(value)}"
        )
        raise ValueError(
            f"{owner}: {field.name}{given} is a {type(value).__name__}; {allowed(wanted)}"
        )
    else:
        value = _without_loose_leaves(value)
    return value


def _plain(value: Value, depth: int = 0) -> Value:
    """Tuples in place of lists, and numbers of Python in place of those of NumPy.

    What is deeper than any field, such as a list that contains itself, is left to be refused.
    """
    if depth > DEEPEST or type(value) not in (list, tuple):
        return concrete(value)
    return tuple(_plain(one, depth + 1) for one in value)


def _without_loose_leaves(value: Value) -> Value:
    """A pytree of another library in which functions and floats of Python are converted.

    Functions, such as an activation, become `jax.tree_util.Partial` and so part of the structure.
    Floats of Python become strongly typed arrays.
    """
    if is_decorated(type(value)) or jax.tree_util.all_leaves([value]):
        return value

    def settled(leaf: Value) -> Value:
        if isinstance(leaf, float):
            return np.asarray(leaf, float)
        is_function = callable(leaf) and not hasattr(leaf, "dtype")
        return jax.tree_util.Partial(leaf) if is_function else leaf

    return jax.tree.map(settled, value)


def _checked_leaf(owner: str, field: dataclasses.Field[Value], value: Value) -> Value:
    value = _as_float(owner, field.name, value)
    if not isinstance(value, jax.core.Tracer) and not field.metadata["interval"].contains(value):
        raise ValueError(f"{owner}: {field.name} = {outside(value, field.metadata['interval'])}")
    return value


def _check_static(owner: str, field: dataclasses.Field[Value], value: Value, wanted: Value) -> None:
    choices, interval, whole = (field.metadata[k] for k in ("choices", "interval", "whole"))
    if value is None and field.metadata["optional"]:
        return
    if isinstance(value, jax.core.Tracer):
        raise ValueError(f"{owner}: {field.name} {TRACED}")
    if choices and not (fits(value, wanted) and value in choices):
        raise ValueError(
            f"{owner}: {field.name} = {brief(value)} is not one of {', '.join(map(repr, choices))}"
        )
    number = is_number(value)
    inside = number and (interval is None or interval.contains(value)) and not (whole and value % 1)
    if interval is not None and (number or is_whole(value)) and not inside:
        raise ValueError(
            f"{owner}: {field.name} = {brief(value)} is outside its allowed range {interval}"
            f"{' of whole numbers' * whole}"
        )
    if interval is not None and wanted is Tree:
        wanted = int if whole else float
    if not fits(value, wanted):
        within = "" if interval is None else f" in {interval}"
        raise ValueError(
            f"{owner}: {field.name} = {brief(value)} is a {type(value).__name__}; "
            f"{allowed(wanted)}{within}"
        )


def _as_float(owner: str, name: str, value: Value) -> Value:
    if (
        isinstance(value, jax.Array)
        and jax.numpy.issubdtype(value.dtype, jax.numpy.number)
        and not jax.numpy.iscomplexobj(value)
    ):
        floating = jax.numpy.issubdtype(value.dtype, jax.numpy.floating)
        # the conversion also makes a weak type strong
        return jax.lax.convert_element_type(value, value.dtype if floating else float)
    found = None if isinstance(value, jax.Array) else as_numbers(value)
    if found is None:
        raise ValueError(f"{owner}: {name} = {brief(value)} is not a number or an array of numbers")
    if found.flags.writeable or not found.flags.owndata:
        found = np.array(found)  # the caller may write into his own
        found.flags.writeable = False
    return found
