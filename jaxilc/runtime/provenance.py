"""A description, as JSON, of what the numbers of a result depend on, and a comparison of two.

A run that is resumed compares the stored description with its own, to detect whether it was started
with the same parameters.
"""

from __future__ import annotations

import dataclasses
import inspect
import json
import sys
from collections.abc import Collection, Mapping
from enum import Enum
from functools import partial
from importlib.metadata import version
from logging import Logger
from types import CodeType, ModuleType
from typing import NotRequired, TypedDict

import jax
import jax.numpy as jnp
import numpy as np

from ..pytree.aliases import Json, Value
from ..pytree.closest import listed
from ..storage.sealed import checksum
from .earlier_names import in_todays_names

LONG = 120  # characters of a value in a difference that is told
# Of a user's class, in a description; no field has such a name.
CODE, CONSTANTS = "its code", "its constants"
# Of an object: what is not among its attributes, and that nothing tells it from others.
STATE, UNKNOWN = "its state", "not described"
# What JAX and Python write into a function and a class; earlier versions stored it.
WRITTEN = frozenset({"_jit_info", "_abc_impl", "_is_protocol", "_is_runtime_protocol"})
OF_PICKLE = ("__reduce_ex__", "__reduce__", "__getstate__")
ORDERED = ("schemes", "uncertainty", "weights")  # mappings whose order the numbers depend on


class Environment(TypedDict):
    """What numbers depend on besides parameters.

    native: the variants of a sweep that programs compiled for this processor compute, or whether
        one computes a tuning
    random: how random numbers are drawn, where JAX has been set to another way than its own
    """

    versions: dict[str, str]
    backend: str
    devices: int
    precision: str
    native: NotRequired[list[str] | bool]
    random: NotRequired[str]


def environment(*packages: str) -> Environment:
    """The environment of this process, with the versions of these packages too."""
    found: Environment = {
        "versions": {
            name: version(name) for name in ("jaxilc", "jax", "jaxlib", "numpy", *packages)
        },
        "backend": jax.default_backend(),
        "devices": jax.device_count(),
        "precision": "float64" if jax.config.jax_enable_x64 else "float32",
    }
    random = jax.config.jax_default_prng_impl
    random += "" if jax.config.jax_threefry_partitionable else ", not partitionable"
    if random != "threefry2x32":
        found["random"] = random
    return found


def differences(found: object, wanted: object, besides: Collection[str] = ()) -> list[str]:
    """The differences of two configurations, one line for each, such as `seed: 1 there, 2 here`.

    Earlier names of a field are no difference.

    besides: paths of what is known to differ, and is left out
    """
    known = tuple(f"{path}{end}" for path in besides for end in ":.")
    lines = _differences(in_todays_names(found), in_todays_names(wanted), "")
    return [line for line in lines if not line.startswith(known)]


def need_same(
    path: object,
    found: object,
    wanted: object,
    made: str = "made with another configuration",
    then: str = "",
) -> None:
    """Raises ValueError, naming what differs, for a path made with another configuration."""
    differing = differences(found, wanted) or _reordered(found, wanted)
    if differing:
        raise ValueError(f"{path} was {made}; it differs in: {'; '.join(differing)}{then}")


def need_described(configuration: object, name: str = "") -> None:
    """Raises ValueError, naming it, for what holds an object that cannot be told from others.

    An object that tells something of itself may hold such an object, as in a cache.
    """
    if isinstance(configuration, dict):
        if UNKNOWN in configuration:
            raise ValueError(
                f"{name} holds a {configuration['name']}, of which nothing can be stored, so that "
                "another one could not be told from it; allowed are numbers, arrays, functions, "
                "and objects of these"
            )
        if {"name", "attributes"} <= configuration.keys() and _tells(configuration):
            return
        for key, of in configuration.items():
            need_described(of, f"{name}.{key}" if name else key)
    elif isinstance(configuration, list):
        for i, of in enumerate(configuration):
            need_described(of, f"{name}[{i}]")


def _tells(described: Json) -> bool:
    """Whether a description has a value besides names and what is not described."""
    if isinstance(described, dict):
        parts = [of for name, of in described.items() if name != "name"]
        return UNKNOWN not in described and any(map(_tells, parts))
    return any(map(_tells, described)) if isinstance(described, list) else described is not None


def _differences(found: object, wanted: object, name: str) -> list[str]:
    if isinstance(found, dict) and isinstance(wanted, dict):
        names = found.keys() | wanted.keys()
        names -= {CODE, CONSTANTS} - found.keys() | WRITTEN  # earlier versions did not store them
        return [
            line
            for n in sorted(names)
            for line in _differences(found.get(n), wanted.get(n), f"{name}.{n}" if name else n)
        ]
    there, here = texts = f"{found}", f"{wanted}"
    if isinstance(found, list) and isinstance(wanted, list) and len(found) == len(wanted):
        pairs = [*zip(found, wanted, strict=True)]
        if "{" in there or "{" in here:  # not the rows of an array, which are told as one
            return [x for i, of in enumerate(pairs) for x in _differences(*of, f"{name}[{i}]")]
    if found == wanted or repr(found) == repr(wanted):  # as NaN is not equal to itself
        return []
    if max(map(len, texts)) > LONG:  # then from a little before the first difference
        unlike = (i for i, (a, b) in enumerate(zip(*texts, strict=False)) if a != b)
        first = max(0, next(unlike, min(map(len, texts))) - LONG // 2)
        there, here = (
            "... " * (first > 0) + x[first:][:LONG] + " ..." * (len(x) > first + LONG)
            for x in texts
        )
    return [f"{name}: {there} there, {here} here"]


def _reordered(found: object, wanted: object) -> list[str]:
    """The mappings named in `ORDERED` whose names are in another order, a line each."""
    if not isinstance(found, dict) or not isinstance(wanted, dict):
        return []
    lines = [line for n in found for line in _reordered(found[n], wanted.get(n))]
    for name in ORDERED:
        there, here = found.get(name), wanted.get(name)
        if isinstance(there, dict) and isinstance(here, dict) and [*there] != [*here]:
            lines.append(f"{name}: in the order {listed(there)} there, {listed(here)} here")
    return lines


def describe(value: Value, *, within: tuple[int, ...] = ()) -> Json:
    """A description of a value, as JSON, that changes whenever the numbers of the value change.

    A class is described by its fields, and one of a user also by the code of its methods and by the
    other attributes of the class; a long array is described by its shape and hash. A function, and
    an object made of functions such as an optax transformation, is described by its name, its code
    and the values in its closure. So two functions of the same name differ if their settings
    differ. Their position in a file is not included. What JAX has under a name is described by this
    name, and any other object by what `pickle` would store of it. The description does not contain
    what a function reads from its module, or the code that it calls there. The code of a function
    differs between versions of Python. An object of which nothing is known, such as a lock, is
    described as such, and `need_described` refuses it.

    within: identities of the values that contain this one, for a value that refers to itself
    """
    again = partial(describe, within=(*within, id(value)))
    if value is None or isinstance(value, str | bool | int):
        return value
    if isinstance(value, jax.Array) and jnp.issubdtype(value.dtype, jax.dtypes.prng_key):
        value = jax.random.key_data(value)
    if isinstance(value, float | complex | np.ndarray | np.generic | jax.Array):
        return _of_array(np.asarray(value))
    if isinstance(value, type | ModuleType | Logger) or id(value) in within:
        return _name(value)
    if isinstance(value, Mapping):
        return {str(name): again(of) for name, of in value.items()}
    if isinstance(value, list | tuple):
        return [again(of) for of in value]
    if dataclasses.is_dataclass(value):
        fields = {f.name: again(getattr(value, f.name)) for f in dataclasses.fields(value)}
        own = {name: again(of) for name, of in _own_attributes(type(value)).items()}
        if own:
            own[CODE] = checksum(json.dumps(own[CODE]).encode())
        return {"class": type(value).__name__, **own, **fields}
    if isinstance(value, partial):
        return {"partial": again([value.func, value.args, value.keywords])}
    if isinstance(value, set | frozenset):
        return {_name(value): sorted(map(again, value), key=json.dumps)}
    if isinstance(value, bytes | bytearray):
        return {_name(value): value.hex()}
    if _is_named_in_jax(value):
        return _name(value)
    if not hasattr(value, "__code__"):
        return {"name": _name(value), **{name: again(of) for name, of in _parts(value).items()}}
    return {
        "name": _name(value),
        "body": checksum(repr(_body(value.__code__)).encode()),
        "settings": again(
            (value.__defaults__, value.__kwdefaults__, getattr(value, "__self__", None))
        ),
        "closes over": [again(cell.cell_contents) for cell in value.__closure__ or ()],
    }


def checksum_of(description: Json) -> str:
    """The checksum of a description, whatever the order of the names in its mappings."""
    return checksum(json.dumps(description, sort_keys=True).encode())


def _is_named_in_jax(value: Value) -> bool:
    """Whether JAX has exactly this under its name, so that its version tells all else."""
    module, _, name = _name(value).rpartition(".")
    return module.startswith("jax.") and getattr(sys.modules.get(module), name, None) is value


def _parts(value: Value) -> dict[str, Value]:
    """All that tells an object from others of its class.

    That is its attributes, and for what is not among them, as in a slice or with slots, what
    `pickle` would store. Where its class says itself what is stored, it is that alone, as an
    attribute may be a cache. An object of JAX, and one that cannot be stored, is told by its text.
    NumPy's global generator, which starts anew in each process, is told by its name.
    """
    if value is np.random.mtrand._rand:
        return {"attributes": {}}
    attributes = dict(getattr(value, "__dict__", {}))
    attributes.pop("_jit_info", None)  # of `jax.jit`: the file and the line of a function, too
    text = "" if attributes else repr(value)
    by_text = {} if attributes else {UNKNOWN: True} if " at 0x" in text else {STATE: text}
    of_jax = type(value).__module__.partition(".")[0] in ("jax", "jaxlib")
    if of_jax and UNKNOWN not in by_text:
        return {"attributes": attributes, **by_text}
    try:
        stored = value.__reduce_ex__(2)
    except Exception:  # of any kind, as a class may have a method of its own
        return {"attributes": attributes, **by_text}
    by_name = isinstance(value, Enum) or (isinstance(value, np.dtype) and value.isbuiltin == 1)
    if isinstance(stored, str) or by_name:  # which is described already
        return {"attributes": attributes}
    made_by, arguments, state, *items = (*stored, None, None, None)[:5]
    arguments = [of for of in arguments or () if of is not type(value)]
    arguments += [made_by] if isinstance(made_by, partial) else []  # as of `methodcaller`
    own = any(getattr(type(value), at) is not getattr(object, at) for at in OF_PICKLE)
    if isinstance(state, dict) and (own or state.keys() == attributes.keys()):
        attributes, state = state, None
    elif own:
        attributes = {}
    further = [arguments or None, state, *(one and [*one] for one in items)]
    told = any(one is not None for one in further)
    return {"attributes": attributes, **({STATE: further} if told else {})}


def _is_of_a_user(cls: Value) -> bool:
    """Whether a class or a function is neither of this package nor of Python."""
    known = {__name__.partition(".")[0], *sys.stdlib_module_names}
    return cls.__module__.partition(".")[0] not in known


def _own_attributes(cls: Value) -> dict[str, dict[str, Value]]:
    """The methods, and all else but the fields, that a class and those above it have from a user.

    It is empty for a class of this package. What a dataclass and this package write, such as
    `__init__`, is left out.
    """
    of_a_user = [of for of in reversed(cls.__mro__) if _is_of_a_user(of)]
    methods: dict[str, Value] = {}
    constants: dict[str, Value] = {}
    left_out = {"_made_by_pytree", *WRITTEN, *(f.name for f in dataclasses.fields(cls))}
    for of in of_a_user:
        for name, value in vars(of).items():
            inner = (getattr(value, at, None) for at in ("fget", "func", "__func__"))
            function = inspect.unwrap(next((f for f in inner if callable(f)), value))
            code = getattr(function, "__code__", None)
            made = name.startswith("__") and code and code.co_filename == "<string>"
            if code and not made and _is_of_a_user(function):
                methods[name] = function
            is_data = not code or isinstance(value, partial)
            if is_data and name not in left_out and not name.startswith("__"):
                constants[name] = value
    return {CODE: methods, CONSTANTS: constants} if of_a_user else {}


def _of_array(array: np.ndarray) -> Json:
    if np.iscomplexobj(array):
        return {"real": _of_array(array.real), "imaginary": _of_array(array.imag)}
    if array.dtype.kind not in "biuf":
        return describe(array.tolist())
    if array.size <= 16:
        return array.tolist()
    return {
        "shape": list(array.shape),
        "sha256": checksum(np.asarray(array, dtype=float).tobytes()),
    }


def _name(value: Value) -> str:
    if isinstance(value, ModuleType):
        return value.__name__
    named = hasattr(value, "__qualname__") and hasattr(value, "__module__")
    known = value if named else type(value)
    return f"{known.__module__}.{known.__qualname__}"


def _body(code: CodeType) -> tuple[object, ...]:
    """The instructions, names and constants of a function and of the functions inside it.

    Positions in a file and addresses in RAM are not included.
    """
    constants = [
        _body(c)
        if isinstance(c, CodeType)
        else sorted(map(repr, c))
        if isinstance(c, frozenset)
        else c
        for c in code.co_consts
    ]
    return code.co_code, code.co_names, constants
