"""The meaning of the operations, carried out one after another in NumPy.

This is what printed programs are compared with, to the last bit. It shares no code with printers;
what steps do with arrays are functions of `native.operations`, which compiled programs use too.
Functions such as `exp` are those of the C library, as in the printed programs.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable, Sequence
from functools import cache

import numpy as np
from jax.typing import DTypeLike

from ..native.code import address_of
from ..native.operations import (
    INSTRUCTIONS,
    LIBRARY,
    Node,
    clamped,
    counted,
    elementwise,
    formula,
    on_arrays,
    rearranged,
    updated,
)
from ..native.program import Const, Program, Step, Unknown, Value
from ..pytree.aliases import Function, Leaf


def interpret(
    program: Program, operands: Sequence[Leaf], real: DTypeLike = np.float64
) -> list[np.ndarray]:
    """The results of a program.

    real: the type of its real numbers, float64 or float32
    """
    with np.errstate(all="ignore"):
        return _run(program, operands, np.dtype(real))


def known(name: str) -> bool:
    """Whether a step of this name has a meaning here, and so can be exported."""
    return elementwise(name) or name in ARRAYS or name in ("scan", "while") or on_arrays(name)


def carried_out(step: Step, arrays: Sequence[np.ndarray]) -> list[np.ndarray]:
    """The results of a step in double precision; raises Unknown for one that is not known."""
    if not known(step.name):
        raise Unknown(step.name)
    with np.errstate(all="ignore"):
        return _step(step, list(arrays), np.dtype(np.float64))


def _run(program: Program, operands: Sequence[Leaf], real: np.dtype) -> list[np.ndarray]:
    found = dict(zip(program.ins, operands, strict=True))

    def value(x: Value) -> np.ndarray:
        return _as(x.array if isinstance(x, Const) else found[x], x.dtype, real)

    for step in program.steps:
        found.update(zip(step.outs, _step(step, [value(x) for x in step.ins], real), strict=True))
    return [value(x) for x in program.outs]


def _as(array: Leaf, dtype: DTypeLike, real: np.dtype) -> np.ndarray:
    return np.asarray(array, real if np.dtype(dtype).kind == "f" else dtype)


def _step(step: Step, ins: list[np.ndarray], real: np.dtype) -> list[np.ndarray]:
    if step.name == "scan":
        return _scan(step, ins, real)
    if step.name == "while":
        return _while(step, ins, real)
    if elementwise(step.name):
        found = _node(formula(step), ins, real, {})
        return [np.broadcast_to(found, step.outs[0].shape)]
    if on_arrays(step.name):
        found = rearranged(step, ins, step.outs[0].shape, SINGLE.__getitem__, lambda number: number)
    else:
        found = ARRAYS[step.name](step, ins)
    return [_as(found, step.outs[0].dtype, real).reshape(step.outs[0].shape)]


def _scan(step: Step, ins: list[np.ndarray], real: np.dtype) -> list[np.ndarray]:
    of = step.params
    consts, state = ins[: of["consts"]], ins[of["consts"] : of["consts"] + of["carry"]]
    rows, kept = ins[of["consts"] + of["carry"] :], []
    places = range(of["length"])[:: -1 if of["reverse"] else 1]
    for i in places:
        found = _run(of["body"], [*consts, *state, *(x[i] for x in rows)], real)
        state = found[: of["carry"]]
        kept.append(found[of["carry"] :])
    kept = kept[::-1] if of["reverse"] else kept
    outs = step.outs[of["carry"] :]
    stacked = [np.reshape([row[j] for row in kept], x.shape) for j, x in enumerate(outs)]
    return [*state, *stacked]


def _while(step: Step, ins: list[np.ndarray], real: np.dtype) -> list[np.ndarray]:
    of = step.params
    n, m = of["of_condition"], of["of_body"]
    state = ins[n + m :]
    for _ in range(of["bound"]):
        if not _run(of["condition"], [*ins[:n], *state], real)[0]:
            break
        state = _run(of["body"], [*ins[n : n + m], *state], real)
    return state


# Single numbers
# --------------------------------------------------------------------------------------------------


def _node(
    x: Node, ins: list[np.ndarray], real: np.dtype, made: dict[Node, np.ndarray]
) -> np.ndarray:
    if x not in made:
        args = [_node(one, ins, real, made) for one in x.args]
        if x.name == "operand":
            made[x] = ins[x.operand]
        elif x.name == "const":
            made[x] = _as(x.value, x.dtype, real)
        elif x.name == "convert":
            made[x] = _converted(args[0], x.dtype, real)
        else:
            made[x] = _as(SINGLE[x.name](*args), x.dtype, real)
    return made[x]


def _converted(x: np.ndarray, dtype: np.dtype, real: np.dtype) -> np.ndarray:
    if dtype.kind in "iu" and x.dtype.kind == "f":
        low, high = np.iinfo(dtype).min, np.iinfo(dtype).max
        inside = np.where((x > low) & (x < high), x, 0).astype(dtype)  # towards zero
        return np.where(x >= high, high, np.where(x <= low, low, inside)).astype(dtype)
    return _as(x, dtype, real)


def _library(name: str) -> Callable[..., np.ndarray]:
    """A function of the C library for each element, as it is at the edges of its range too."""
    function: Callable[..., float] = getattr(math, name)
    at_numpy: np.ufunc = np.float_power if name == "pow" else getattr(np, name)

    def one(*x: float) -> float:
        try:
            return float(function(*x))
        except (OverflowError, ValueError):
            return float(at_numpy(*x))

    def each(*given: np.ndarray) -> np.ndarray:
        arrays = np.broadcast_arrays(*given)
        of = _of_float(name) or one if arrays[0].dtype == np.float32 else one
        found = [of(*map(float, x)) for x in zip(*(a.ravel() for a in arrays), strict=True)]
        return np.reshape(np.array(found, float), arrays[0].shape)

    return each


@cache
def _of_float(name: str) -> Callable[..., float] | None:
    """The function of the C library for `float`, which rounds otherwise; None without one."""
    numbers = [ctypes.c_float] * (3 if name == "pow" else 2)
    try:
        return ctypes.CFUNCTYPE(*numbers)(address_of(f"{name}f"))
    except Unknown:
        return None


SINGLE: dict[str, Function] = {
    **{name: of.exact for name, of in INSTRUCTIONS.items() if of.exact is not None},
    **{name: _library(name) for name in LIBRARY},
    "max": lambda a, b: np.where((a != a) | (a > b), a, b),
    "min": lambda a, b: np.where((a != a) | (a < b), a, b),
    "round_away": lambda x: np.copysign(
        np.floor(np.abs(x)) + (np.abs(x) - np.floor(np.abs(x)) >= 0.5), x
    ),
    "select": lambda which, no, yes: np.where(which, yes, no),
}  # fmt: skip


# Arrays
# --------------------------------------------------------------------------------------------------


ARRAYS: dict[str, Callable[[Step, list[np.ndarray]], np.ndarray]] = {
    "iota": lambda step, ins: counted(step.params, step.outs[0].shape),
    "take": lambda step, ins: ins[0].ravel()[step.params["table"]],
    "dynamic_slice": lambda step, ins: ins[0][clamped(ins[0].shape, step.outs[0].shape, ins[1:])],
    "dynamic_update_slice": lambda step, ins: updated(ins[0], ins[1], ins[2:]),
}
