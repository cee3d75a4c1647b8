"""What the numbers of a result depend on: a description as JSON, and where two of them differ.

A resumed run compares the description that was stored with its own, to tell whether it was started
with the same.
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Mapping
from functools import partial
from importlib.metadata import version
from types import ModuleType
from typing import Any

import jax
import numpy as np

from .earlier_names import in_todays_names


def environment(*packages: str) -> dict[str, Any]:
    """What the numbers depend on besides the parameters: versions, backend, devices, precision.

    packages: further packages whose versions count
    """
    return {
        "versions": {
            name: version(name) for name in ("jaxilc", "jax", "jaxlib", "numpy", *packages)
        },
        "backend": jax.default_backend(),
        "devices": jax.device_count(),
        "precision": "float64" if jax.config.jax_enable_x64 else "float32",
    }


def differences(found: Any, wanted: Any) -> list[str]:
    """Where two configurations differ, one line each: `seed: 1 there, 2 here`.

    Names that were changed since one of them was written make no difference.
    """
    return _differences(in_todays_names(found), in_todays_names(wanted), "")


def _differences(found: Any, wanted: Any, name: str) -> list[str]:
    if isinstance(found, dict) and isinstance(wanted, dict):
        return [
            line
            for n in sorted(found.keys() | wanted.keys())
            for line in _differences(found.get(n), wanted.get(n), f"{name}.{n}" if name else n)
        ]
    return [] if found == wanted else [f"{name}: {found} there, {wanted} here"]


def describe(value: Any, *, within: tuple[int, ...] = ()) -> Any:
    """A description of a value, as JSON, that changes whenever the numbers do.

    It has classes with their fields, long arrays by shape and hash, and functions by their code.
    Functions, and what is made of them such as an optax transformation, are known by their names,
    their code and the values that they close over: two functions of one name differ where their
    settings do. Where they stand in a file does not count. It does not see what a function reads
    from its module, the code that it calls there, or an object that has no attributes. The code
    differs between versions of Python.
    within: the values that this one is a part of, for a value that refers to itself
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
