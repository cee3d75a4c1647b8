"""Which outputs of a program are affine functions of its inputs, read off the program itself.

Trying a map at a few points cannot show that it is linear: a limit that matters may lie beyond
them. Here the program that JAX traced is followed instead, operation by operation. Each value in it
is found to be

    constant     the same whatever the inputs are
    affine       M x + c of the inputs x, with M and c constant
    otherwise    with the operation that made it so, such as a product of two signals or a rounding

An operation that is not known to keep a value affine counts as one that does not. So the answer
"affine" is a proof, for plants and schemes of the package as for a user's own. The answer
"otherwise" is not: x * x - x * x is not seen to be 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp

from ..pytree.aliases import Function, Tree, Value

CONSTANT, AFFINE, OTHERWISE = 0, 1, 2


Step: TypeAlias = Value  # a `jax.core.JaxprEqn`


class Dependence(NamedTuple):
    """How a value depends on the inputs.

    order: CONSTANT, AFFINE or OTHERWISE
    why:   the operation that made it OTHERWISE, in words
    blind: whether a derivative misses a part of it, because of `stop_gradient` (as in a quantiser
           with a straight-through gradient)
    """

    order: int = CONSTANT
    why: str = ""
    blind: bool = False


# linear in all operands together
# fmt: off
LINEAR = frozenset((
    "add", "add_any", "sub", "neg", "reshape", "broadcast_in_dim", "transpose", "squeeze",
    "expand_dims", "slice", "split", "concatenate", "stack", "unstack", "pad", "rev", "copy",
    "copy_p", "reduce_sum", "cumsum", "reduce_window_sum", "real", "imag", "complex", "conj", "fft",
    "by_sample", "device_put",
))
# linear in each of two operands by itself
BILINEAR = frozenset(["mul", "dot_general", "by_columns", "conv_general_dilated"])
# linear in the operands counted here, as long as the others are constant
LINEAR_IN = {
    "div": (0,),
    "triangular_solve": (1,),
    "gather": (0,),
    "dynamic_slice": (0,),
    "dynamic_update_slice": (0, 1),
    "scatter": (0, 2),
    "scatter-add": (0, 2),
}
DECISIONS = frozenset((
    "eq", "ne", "lt", "le", "gt", "ge", "lt_to", "le_to", "is_finite", "and", "or", "not", "xor",
    "reduce_and", "reduce_or", "argmax", "argmin",
))
# fmt: on
WORDS = {
    "mul": "a product of two signals",
    "dot_general": "a product of two signals",
    "div": "a division by a signal",
    "integer_pow": "a power of a signal",
    "select_n": "a choice that depends on a signal",
    "max": "a limit",
    "min": "a limit",
    "clamp": "a limit",
    "round": "rounding",
    "abs": "the size of a signal",
    "sign": "the sign of a signal",
    "gather": "a table that is looked up by a signal",
    "dynamic_slice": "a table that is looked up by a signal",
    "cond": "a choice that depends on a signal",
    "while": "a loop that depends on a signal",
    "stop_gradient": "rounding",
    "ruled": "a search for a minimum",
}


def dependence(f: Function, fixed: Tree, varying: Tree) -> Tree:
    """The `Dependence` of each output of f(fixed, varying) on `varying`, in the output's shape.

    f: a pure function, as for `jax.jit`
    """
    program, shape = jax.make_jaxpr(f, return_shape=True)(fixed, varying)
    given = [Dependence()] * len(jax.tree.leaves(fixed))
    given += [Dependence(AFFINE)] * len(jax.tree.leaves(varying))
    return jax.tree.unflatten(jax.tree.structure(shape), _through(program, given))


def _of_each(f: Function, fixed: Tree, varying: Tree) -> list[Dependence]:
    found = dependence(f, fixed, varying)
    return jax.tree.leaves(found, is_leaf=lambda x: isinstance(x, Dependence))


def obstacle(f: Function, fixed: Tree, varying: Tree) -> str:
    """What keeps f(fixed, varying) from being affine in `varying`, in words; empty if it is.

    Whole numbers and flags must be constant.
    """
    shapes = jax.tree.leaves(jax.eval_shape(f, fixed, varying))
    for one, shape in zip(_of_each(f, fixed, varying), shapes, strict=True):
        allowed = AFFINE if jnp.issubdtype(shape.dtype, jnp.inexact) else CONSTANT
        if one.order > allowed:
            return one.why or "a whole number that depends on a signal"
    return ""


def depends(f: Function, fixed: Tree, varying: Tree) -> bool:
    """Whether some output of f(fixed, varying) may depend on `varying`."""
    return any(one.order > CONSTANT for one in _of_each(f, fixed, varying))


def blind(f: Function, fixed: Tree, varying: Tree) -> bool:
    """Whether the derivative of f by `varying` misses a part, such as rounding."""
    return any(one.blind for one in _of_each(f, fixed, varying))


def followers(f: Function, fixed: Tree, varying: Tree) -> list[list[bool]]:
    """For each leaf of `varying`, which leaves of f(fixed, varying) may depend on it."""
    closed = jax.make_jaxpr(f)(fixed, varying)
    of_fixed, leaves = len(jax.tree.leaves(fixed)), len(jax.tree.leaves(varying))
    found = []
    for varies in range(leaves):
        given = [Dependence()] * (of_fixed + leaves)
        given[of_fixed + varies] = Dependence(AFFINE)
        found.append([one.order > CONSTANT for one in _through(closed, given)])
    return found


def acting(f: Function, fixed: Tree, state: Tree) -> list[bool]:
    """Of each leaf of a state, whether what is seen may depend on it, now or later.

    f(fixed, state) -> (state, *seen). What only tells of the past, such as a counter, does not act.
    """
    found = followers(f, fixed, state)
    leaves = len(found)
    acts = [any(of_leaf[leaves:]) for of_leaf in found]
    while True:
        grown = [
            one or any(follows and acts[i] for i, follows in enumerate(of_leaf[:leaves]))
            for one, of_leaf in zip(acts, found, strict=True)
        ]
        if grown == acts:
            return acts
        acts = grown


# How it is done
# --------------------------------------------------------------------------------------------------


def _through(program: Value, of_inputs: Sequence[Dependence]) -> list[Dependence]:
    """The dependence of the results of a jaxpr, closed or not, from that of its inputs."""
    program = getattr(program, "jaxpr", program)
    known = dict.fromkeys(program.constvars, Dependence())
    known |= zip(program.invars, of_inputs, strict=True)

    def look(variable: Value) -> Dependence:
        # a literal has its value with it
        return Dependence() if hasattr(variable, "val") else known[variable]

    for step in program.eqns:
        known |= zip(step.outvars, _after(step, [look(v) for v in step.invars]), strict=True)
    return [look(v) for v in program.outvars]


def _after(step: Step, operands: list[Dependence]) -> list[Dependence]:
    """The dependence of each result of an operation, from that of its operands."""
    name, results = step.primitive.name, len(step.outvars)
    if all(one.order == CONSTANT for one in operands):
        return [Dependence()] * results
    if name in LOOPS_AND_CALLS:
        return LOOPS_AND_CALLS[name](step, operands)
    inner = _called(step)
    if inner is not None:
        return _through(inner, operands)
    together = _joined(operands)
    if name == "optimization_barrier":
        return operands
    if name == "stop_gradient":
        return [together._replace(blind=True)] * results
    keeps = (
        name in LINEAR or _to_float(step) or (name == "select_n" and operands[0].order == CONSTANT)
    )
    if name in BILINEAR:
        keeps = sum(one.order > CONSTANT for one in operands) == 1
    if name in LINEAR_IN:
        keeps = all(
            one.order == CONSTANT for i, one in enumerate(operands) if i not in LINEAR_IN[name]
        )
    if not keeps and together.order == AFFINE:
        why = WORDS["cond"] if name in DECISIONS else WORDS.get(name, f"{name} of a signal")
        together = Dependence(OTHERWISE, why, together.blind)
    if name in DECISIONS:
        # what only decides has the derivative zero, which is correct
        together = together._replace(blind=False)
    if name == "select_n":
        together = together._replace(blind=any(one.blind for one in operands[1:]))
    return [together] * results


def _joined(several: Sequence[Dependence]) -> Dependence:
    """The dependence of what is made of several values at once."""
    worst = max(several, key=lambda one: one.order)
    return worst._replace(blind=any(one.blind for one in several))


def _to_float(step: Step) -> bool:
    return step.primitive.name == "convert_element_type" and all(
        jnp.issubdtype(v.aval.dtype, jnp.inexact) for v in (*step.invars, *step.outvars)
    )


def _called(step: Step) -> Tree:
    """The program that an operation only calls; None for other operations.

    Such operations are jit, checkpoint, and a function with a derivative of its own.
    """
    inner = [p for p in step.params.values() if hasattr(p, "eqns") or hasattr(p, "jaxpr")]
    fits = [p for p in inner if len(getattr(p, "jaxpr", p).invars) == len(step.invars)]
    return fits[0] if len(inner) == 1 and fits else None


def _scan(step: Step, operands: list[Dependence]) -> list[Dependence]:
    """Shapes tell constants, carry and rows apart: the body sees a row without its first axis.

    The parameters that count them have other names since JAX 0.12.
    """
    body = step.params["jaxpr"]

    def whole(outside: list[Value], inside: list[Value]) -> int:
        pairs = zip(outside, inside, strict=True)
        return sum(one.aval.ndim == other.aval.ndim for one, other in pairs)

    until_rows = whole(step.invars, body.jaxpr.invars)
    fixed = until_rows - whole(step.outvars, body.jaxpr.outvars)
    return _repeated(body, operands[:fixed], operands[fixed:until_rows], operands[until_rows:])


def _while(step: Step, operands: list[Dependence]) -> list[Dependence]:
    of_condition, of_body = step.params["cond_nconsts"], step.params["body_nconsts"]
    carry = operands[of_condition + of_body :]
    following = _repeated(
        step.params["body_jaxpr"], operands[of_condition : of_condition + of_body], carry, []
    )
    found = _through(step.params["cond_jaxpr"], [*operands[:of_condition], *following])
    if found[0].order == CONSTANT:
        return following
    return [Dependence(OTHERWISE, WORDS["while"])] * len(following)


def _repeated(
    body: Value, fixed: list[Dependence], carry: list[Dependence], rows: list[Dependence]
) -> list[Dependence]:
    """The dependence of the results of a loop.

    What is carried is joined with what a turn makes of it, until nothing changes.
    """
    while True:
        found = _through(body, [*fixed, *carry, *rows])
        grown = [_joined([old, new]) for old, new in zip(carry, found[: len(carry)], strict=True)]
        if grown == carry:
            return [*carry, *found[len(carry) :]]
        carry = grown


def _cond(step: Step, operands: list[Dependence]) -> list[Dependence]:
    decides, *rest = operands
    branches = [_through(branch, rest) for branch in step.params["branches"]]
    joined = [_joined(several) for several in zip(*branches, strict=True)]
    if decides.order == CONSTANT:
        return joined
    return [Dependence(OTHERWISE, WORDS["cond"], one.blind) for one in joined]


LOOPS_AND_CALLS = {"scan": _scan, "while": _while, "cond": _cond}
