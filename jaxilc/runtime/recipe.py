"""What determines numbers, as JSON, so that a resumed run can tell whether it was started with the
same.
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Mapping
from functools import partial
from types import ModuleType
from typing import Any

import jax
import numpy as np


def describe(value: Any, *, within: tuple[int, ...] = ()) -> Any:
    """A description that changes whenever the numbers do: classes, fields, long arrays by shape and
    hash, functions by their code.

    Functions, and what is made of them such as an optax transformation, are known by names, code
    and the values they close over: two of one name differ where their settings do. Where they stand
    in a file does not count. Not seen is what a function reads from its module, what code it calls
    there, and an object that has no attributes; the code differs between versions of Python.
    within: what this is a part of, for what refers to itself
    """
    again = partial(describe, within=(*within, id(value)))
    if value is None or isinstance(value, str | bool | int):
        return value
    if isinstance(value, float | complex | np.ndarray | np.generic | jax.Array):
        return _of_array(np.asarray(value))
    if isinstance(value, type | ModuleType) or id(value) in within:
        return _name(value)
    if isinstance(value, Mapping):
        return {str(name): again(of) for name, of in value.items()}
    if isinstance(value, list | tuple):
        return [again(of) for of in value]
    if dataclasses.is_dataclass(value):
        return {"class": type(value).__name__} | {
            f.name: again(getattr(value, f.name)) for f in dataclasses.fields(value)
        }
    if isinstance(value, partial):
        return {"partial": again([value.func, value.args, value.keywords])}
    if _name(value).startswith("jax."):
        return _name(value)
    if not hasattr(value, "__code__"):
        return {"name": _name(value), "attributes": again(getattr(value, "__dict__", {}))}
    return {
        "name": _name(value),
        "body": hashlib.sha256(repr(_body(value.__code__)).encode()).hexdigest(),
        "settings": again(
            (value.__defaults__, value.__kwdefaults__, getattr(value, "__self__", None))
        ),
        "closes over": [again(cell.cell_contents) for cell in value.__closure__ or ()],
    }


def _of_array(array: np.ndarray) -> Any:
    if array.size <= 16:
        return array.tolist()
    return {
        "shape": list(array.shape),
        "sha256": hashlib.sha256(np.asarray(array, dtype=float).tobytes()).hexdigest(),
    }


def _name(value: Any) -> str:
    if isinstance(value, ModuleType):
        return value.__name__
    known = value if hasattr(value, "__qualname__") else type(value)
    return f"{known.__module__}.{known.__qualname__}"


def _body(code) -> tuple:
    """Instructions, names and constants, also of the functions within; nothing that tells where
    they lie in a file or in memory.
    """
    constants = [
        _body(c)
        if hasattr(c, "co_code")
        else sorted(map(repr, c))
        if isinstance(c, frozenset)
        else c
        for c in code.co_consts
    ]
    return code.co_code, code.co_names, constants
