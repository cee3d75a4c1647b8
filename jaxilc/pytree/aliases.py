"""What signatures call their values; docstrings tell shapes and units.

Records of a trial, a sample and a task have types of their own in `signals.task`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeAlias

import jax
import numpy as np

Array: TypeAlias = jax.Array  # a signal, a matrix or a number within a computation
Numbers: TypeAlias = np.ndarray  # the same on the host, in NumPy
Leaf: TypeAlias = Any  # a float array as stored; a number, a list or an array when constructed
Tree: TypeAlias = Any  # any pytree, such as a state, a memory, or a row of a scan
Value: TypeAlias = Any  # what a user or a file gives, before it is checked
Function: TypeAlias = Callable[..., Tree]  # of pytrees
Json: TypeAlias = "Mapping[str, Json] | Sequence[Json] | str | float | None"  # to be written
