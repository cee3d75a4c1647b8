"""What the operations of a learning process alone would cost, as a limit for its time.

The program of one machine is traced, and its arithmetic is counted for one trial. Each kind of
operation is timed on a tile of numbers that stays in the cache of a core. The limit is

    sum over kinds of (operations of a sample) x (time of one operation) / devices

without any time to read or write signals, to start a pass of a loop, or to lay out an array.
Operations that only move numbers count as nothing. Each number of a sum counts as one operation,
and so does each product and each sum of a matrix product. A loop whose number of passes depends on
its numbers counts with one pass, and of branches the dearest counts, so the limit is then a guess.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxilc.runtime.lanes import usual_lanes

SIMPLE, DIVISION, RANDOM = "simple", "division", "random number"
CHAIN = 16  # operations on a tile in one pass of the loop that times them
KINDS: dict[str, Callable[[Any, int], Any]] = {  # one operation of a chain, by its place
    SIMPLE: lambda x, i: x * 0.999 if i % 2 else x + 0.001,
    DIVISION: lambda x, i: 1.0 / (1.0 + x),
    RANDOM: lambda x, i: x + jax.random.uniform(jax.random.key(i), x.shape),
    "pow": lambda x, i: (0.5 + x) ** 1.1,
    "atan2": lambda x, i: lax.atan2(0.5 + x, 0.7 + x),
}
DIVISIONS = {"div", "rem", "sqrt", "rsqrt", "cbrt"}
FUNCTIONS = {  # of one number each, and each a kind of its own
    *("exp", "exp2", "expm1", "log", "log1p", "sin", "cos", "tan", "asin", "acos", "atan"),
    *("sinh", "cosh", "tanh", "asinh", "acosh", "atanh", "logistic", "erf", "erf_inv"),
}
ARITHMETIC = {
    *("add", "add_any", "sub", "mul", "neg", "abs", "sign", "max", "min", "clamp", "square", "not"),
    *("select_n", "eq", "ne", "lt", "le", "gt", "ge", "and", "or", "xor", "is_finite", "floor"),
    *("ceil", "round", "integer_pow", "nextafter", "cumsum", "cumprod", "cummax", "cummin"),
    *("conj", "real", "imag", "complex"),
}
SUMS = {
    "reduce_sum",
    "reduce_max",
    "reduce_min",
    "reduce_prod",
    "reduce_and",
    "reduce_or",
    "argmax",
}
PASSES = 500  # of the loop that times a kind of operation
WIDTH = 64  # vectors of a tile of numbers; all of them fit into the nearest cache


def of_a_trial(run: Callable[..., Any], *arguments: Any) -> Counter[str]:
    """The number of operations of each kind in one more trial of `run(trials, *arguments)`.

    What is computed once, before all trials, does not count.
    """
    few, more = (
        counted(jax.make_jaxpr(partial(run, trials))(*arguments).jaxpr) for trials in (2, 4)
    )
    return Counter({kind: (more[kind] - few[kind]) / 2 for kind in more})


def counted(jaxpr: Any) -> Counter[str]:
    """The number of operations of each kind of a traced program."""
    found: Counter[str] = Counter()
    for step in jaxpr.eqns:
        name, size = step.primitive.name, _size(step.outvars)
        if name in ARITHMETIC:
            found[SIMPLE] += size
        elif name in SUMS:
            found[SIMPLE] += _size(step.invars)
        elif name in DIVISIONS:
            found[DIVISION] += size
        elif name in FUNCTIONS or name in KINDS:
            found[name] += size
        elif name in ("random_bits", "threefry2x32"):
            found[RANDOM] += size
        elif name == "dot_general":
            ((left, _), _) = step.params["dimension_numbers"]
            shape = step.invars[0].aval.shape
            found[SIMPLE] += (2 * int(np.prod([shape[i] for i in left])) - 1) * size
        elif name == "by_columns":
            found[SIMPLE] += (2 * step.invars[0].aval.shape[-1] - 1) * size
        elif name == "cond":
            found += max(map(counted, _programs(step)), key=lambda each: sum(each.values()))
        elif name == "scan":
            for kind, number in counted(step.params["jaxpr"].jaxpr).items():
                found[kind] += step.params["length"] * number
        else:
            for inside in _programs(step):
                found += counted(inside)
    return found


def cost(operations: Counter[str], devices: int | None = None) -> float:
    """The seconds of these operations on all devices at once."""
    spread = jax.device_count() if devices is None else devices
    return sum(number * seconds_of(kind) for kind, number in operations.items()) / spread


@cache
def seconds_of(kind: str) -> float:
    """The seconds that one operation of this kind takes on a device, in the best of five turns."""

    def within(x, _):  # the function of a number between 0.25 and 0.75, where all are defined
        return getattr(lax, kind)(jnp.clip(x, 0.25, 0.75))

    def chain(x):
        for place in range(CHAIN):
            x = KINDS.get(kind, within)(x, place)
        return x

    start_values = jnp.full((WIDTH, usual_lanes() or WIDTH), 0.5)
    program = jax.jit(lambda x: lax.fori_loop(0, PASSES, lambda _, x: chain(x), x))
    turns = []
    for _ in range(6):  # the first one compiles
        start = time.perf_counter()
        jax.block_until_ready(program(start_values))
        turns.append(time.perf_counter() - start)
    return min(turns[1:]) / (PASSES * CHAIN * start_values.size)


def _size(values) -> int:
    return sum(int(np.prod(value.aval.shape)) for value in values)


def _programs(step: Any) -> Iterator[Any]:
    """The programs inside of one step of a program."""
    for value in step.params.values():
        for part in value if isinstance(value, tuple | list) else (value,):
            if hasattr(part, "eqns"):
                yield part
            elif hasattr(getattr(part, "jaxpr", None), "eqns"):
                yield part.jaxpr
