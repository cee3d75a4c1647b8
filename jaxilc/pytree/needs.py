"""Checks of a pytree before a computation: known values, one number a channel, single numbers."""

from __future__ import annotations

from collections.abc import Container, Iterable

import jax
import jax.core
import numpy as np

from .aliases import Tree
from .named_paths import child_of, field_names, field_of
from .ranges import shown


def known(tree: Tree) -> bool:
    """Whether every leaf has a known value, and none is traced by a transformation."""
    return not any(isinstance(x, jax.core.Tracer) for x in jax.tree.leaves(tree))


def need_channels(tree: Tree, channels: int, *names: str) -> None:
    """Raises ValueError unless each named field is one number, one for each channel, or None."""
    _need_shapes(tree, names, ((), (channels,)), f"allowed are () and ({channels},)")


def need_numbers(tree: Tree, *names: str) -> None:
    """Raises ValueError unless each named field is one number, or None."""
    _need_shapes(tree, names, ((),), "allowed is one number")


def _need_shapes(
    tree: Tree, names: Iterable[str], shapes: Container[tuple[int, ...]], allowed: str
) -> None:
    for name in names:
        shape = np.shape(getattr(tree, name))
        if getattr(tree, name) is not None and shape not in shapes:
            raise ValueError(f"{type(tree).__name__}: {name} has shape {shape}; {allowed}")


def need_scalars(tree: Tree) -> None:
    """Raises ValueError where a `scalar` of the tree, or of a part of it, is not one number."""
    for name in field_names(tree):
        value, field = child_of(tree, name), field_of(tree, name)
        if field is not None and field.metadata.get("scalar") and np.shape(value):
            given = "" if isinstance(value, jax.core.Tracer) else f" = {shown(value)}"
            raise ValueError(
                f"{type(tree).__name__}: {name}{given} has shape {np.shape(value)}; allowed is "
                "one number"
            )
        need_scalars(value)
