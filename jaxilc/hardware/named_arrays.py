"""The leaves of a memory as named arrays, as the journal stores them."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..pytree.named_paths import named_leaves


def arrays_of(tree: Any) -> dict[str, Any]:
    """The leaves in order; each name is a running number and the path of the leaf."""
    return {f"{i:03d} {name}": leaf for i, (name, leaf) in enumerate(named_leaves(tree).items())}


def shapes_of(arrays: dict[str, Any]) -> str:
    """The names and shapes of arrays, as text for a message."""
    return ", ".join(f"{name} {np.shape(values)}" for name, values in arrays.items())


def not_a_number(arrays: dict[str, Any]) -> str:
    """The name of the first array that holds NaN, an empty text if there is none.

    Infinite values are allowed: they stand for values that are not known yet, such as the best
    error before the first trial.
    """
    return next(
        (name for name, values in arrays.items() if np.any(np.isnan(np.asarray(values)))), ""
    )
