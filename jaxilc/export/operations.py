"""The operations that an exported law consists of, and what each of them means.

Every printer writes these and no others. The arithmetic of single numbers is that of the table
`INSTRUCTIONS` of `native.operations`; a step on arrays carries it out element by element. `ARRAYS`
says what the other steps on arrays do. All sums are taken in the order of their index.
"""

from __future__ import annotations

import numpy as np
from jax.typing import DTypeLike

from ..native import operations as native
from ..native.operations import Node, Number, Numbers, elementwise, one_by_one
from ..native.program import Step

ARRAYS = {
    "slice": "the elements from start_indices to limit_indices by strides",
    "reshape": "the same elements in row-major order in another shape",
    "squeeze": "the same elements without axes of length one",
    "expand_dims": "the same elements with further axes of length one",
    "transpose": "the same elements with the axes in the order of permutation",
    "rev": "the same elements, those of an axis of dimensions in reverse order",
    "broadcast_in_dim": "the elements repeated along new axes and those of length one",
    "concatenate": "the operands one after another along an axis",
    "pad": "the elements with `low` and `high` others around them and `inner` between them",
    "iota": "the place of each element along an axis, counted from 0",
    "take": "the elements at the places of a table, counted in row-major order",
    "dynamic_slice": "a part whose start is clamped so that the part lies within the array",
    "dynamic_update_slice": "the array with such a part replaced",
    "reduce_sum": "0 + x[0] + x[1] + ... along the axes, row-major",
    "reduce_prod": "1 * x[0] * x[1] * ...",
    "reduce_max": "the largest, beginning with -infinity; NaN if one is NaN",
    "reduce_min": "the smallest, beginning with +infinity; NaN if one is NaN",
    "reduce_and": "whether all are true",
    "reduce_or": "whether one is true",
    "cumsum": "x[0], x[0] + x[1], ...; from the end with `reverse`",
    "cumprod": "the same for products",
    "cummax": "the same for the largest",
    "cummin": "the same for the smallest",
    "dot_general": "0 + a[0] b[0] + a[1] b[1] + ... over the contracted axes, row-major",
    "scan": "its body for each row in order, or from the last one on with `reverse`",
    "while": "its body as long as its condition holds, and `bound` times at most",
}
FIRST, RUNNING = native.GATHERED, native.RUNNING
TOGETHER = {name: how for name, (how, _) in FIRST.items()} | RUNNING


def first(name: str, dtype: DTypeLike) -> Number:
    """What a gathering begins with: of whole numbers, their largest and smallest."""
    return native.start(Numbers(dtype), name, np.dtype(dtype)).value


def known(name: str) -> bool:
    """Whether a step of this name can be exported."""
    return name in ARRAYS or elementwise(name)


def formula(step: Step) -> Node:
    """What a step computes element by element: a tree of operations of `INSTRUCTIONS`.

    Its operands are nodes of the name `operand`. Raises Unknown for other steps.
    """
    numbers = Numbers(np.float64)
    places = [numbers.place("operand", np.dtype(x.dtype), i) for i, x in enumerate(step.ins)]
    if step.name == "convert_element_type":
        return numbers.of("convert", *places, dtype=step.outs[0].dtype)
    return one_by_one(numbers, step)(*places)
