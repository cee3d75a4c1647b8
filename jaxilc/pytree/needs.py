"""Checks of a pytree before a computation: known values, one number a channel, single numbers."""

from __future__ import annotations

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
    for name in names:
        value = getattr(tree, name)
        if value is not None and np.shape(value) not in ((), (channels,)):
            raise ValueError(
                f"{type(tree).__name__}: {name} has shape {np.shape(value)}; allowed are () and "
                f"({channels},)"
            )


def need_numbers(tree: Tree, *names: str) -> None:
    """Raises ValueError unless each named field is one number, or None."""
    for name in names:
        value = getattr(tree, name)
        if value is not None and np.shape(value):
            raise ValueError(
                f"{type(tree).__name__}: {name} has shape {np.shape(value)}; allowed is one number"
            )


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
