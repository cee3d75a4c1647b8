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

The matrices of an affine map are taken from its derivative, which a program may set to another one
than that of its values: `stop_gradient` leaves a part of it out, and a function may have a rule of
its own (`jax.custom_jvp`). Such a rule is compared with the derivative of the program that it
stands for, at random numbers; where they differ, the map counts as not affine.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from hashlib import sha256
from typing import NamedTuple, TypeAlias

import jax
import jax.core
import jax.numpy as jnp
import numpy as np

from ..pytree.aliases import Function, Tree, Value
from ..runtime.xla_options import QUICKLY

CONSTANT, AFFINE, OTHERWISE = 0, 1, 2
MADE_UP = "a part whose derivative is made up, as by stop_gradient"
DRAWS, SIZES = 64, (1e-2, 1e3)  # of numbers at which a rule for a derivative is looked at
FEW = 50_000  # of such numbers in all, on which a program that is compiled quickly runs as fast

Step: TypeAlias = Value  # a `jax.core.JaxprEqn`
Ruled: TypeAlias = tuple[Step, tuple[bool, ...]]  # and which of its operands depend on the inputs


class Dependence(NamedTuple):
    """How a value depends on the inputs.

    order: CONSTANT, AFFINE or OTHERWISE
    why:   the operation that made it OTHERWISE, in words
    ruled: the operations through which its derivative may be another than that of its values, as
           in a quantiser with a straight-through gradient
    """

    order: int = CONSTANT
    why: str = ""
    ruled: frozenset[Ruled] = frozenset()


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
RULED = ("custom_jvp_call", "custom_vjp_call")  # functions with a rule for their derivative
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

    Whole numbers and flags must be constant, and the derivative that of the values.
    """
    shapes = jax.tree.leaves(jax.eval_shape(f, fixed, varying))
    for one, shape in zip(_of_each(f, fixed, varying), shapes, strict=True):
        allowed = AFFINE if jnp.issubdtype(shape.dtype, jnp.inexact) else CONSTANT
        if one.order > allowed:
            return one.why or "a whole number that depends on a signal"
        if any(_made_up(*rule) for rule in one.ruled):
            return MADE_UP
    return ""


def depends(f: Function, fixed: Tree, varying: Tree) -> bool:
    """Whether some output of f(fixed, varying) may depend on `varying`."""
    return any(one.order > CONSTANT for one in _of_each(f, fixed, varying))


def blind(f: Function, fixed: Tree, varying: Tree) -> bool:
    """Whether the derivative of f by `varying` is made up, as that of rounding is."""
    return any(_made_up(*rule) for one in _of_each(f, fixed, varying) for rule in one.ruled)


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
    inner, together = _called(step), _joined(operands)
    ruled = frozenset({(step, tuple(one.order > CONSTANT for one in operands))})
    if name == "stop_gradient":
        return [together._replace(ruled=ruled)] * results
    if inner is not None:
        found = _through(inner, operands)
        if name not in RULED:
            return found
        return [one._replace(ruled=one.ruled | ruled) if one.order else one for one in found]
    if name == "optimization_barrier":
        return operands
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
        together = together._replace(order=OTHERWISE, why=why)
    if name in DECISIONS:
        # what only decides has the derivative zero, which is correct
        together = together._replace(ruled=frozenset())
    if name == "select_n":
        together = together._replace(ruled=_joined(operands[1:]).ruled)
    return [together] * results


def _joined(several: Sequence[Dependence]) -> Dependence:
    """The dependence of what is made of several values at once."""
    worst = max(several, key=lambda one: one.order)
    return worst._replace(ruled=frozenset().union(*(one.ruled for one in several)))


# Whether two slopes were alike, by the program that computes both: the same rule is met in each
# trace of the same loop, and its program takes a tenth of a second to compile.
_COMPARED: dict[tuple[bytes, tuple[bool, ...]], bool] = {}


@lru_cache(maxsize=64)
def _made_up(step: Step, moving: tuple[bool, ...]) -> bool:
    """Whether the derivative of an operation by some of its operands is not that of its values.

    Of a function with a rule for it, that is seen where the rule and the program that it stands for
    differ, at some of `DRAWS` random numbers of the sizes `SIZES`. Where nothing can be compared,
    the rule counts as made up.
    """
    if step.primitive.name != "custom_jvp_call":
        return True
    inner, random = step.params["call_jaxpr"], np.random.default_rng(8)
    operands = {v: m for v, m in zip(step.invars, moving, strict=True) if not hasattr(v, "val")}
    call = inner.jaxpr.replace(constvars=[], invars=[*operands], outvars=step.outvars, eqns=[step])

    def ruled(*x: Value) -> list[Value]:
        return jax.core.eval_jaxpr(call, [], *x)

    def plain(*x: Value) -> list[Value]:
        known = dict(zip(operands, x, strict=True))
        given = [v.val if hasattr(v, "val") else known[v] for v in step.invars]
        return jax.core.eval_jaxpr(inner.jaxpr, inner.consts, *given)

    def drawn(v: Value, sizes: np.ndarray) -> np.ndarray:
        of_each = random.standard_normal((*v.aval.shape, DRAWS)) * sizes
        return np.moveaxis(of_each, -1, 0).astype(v.aval.dtype)

    at = [drawn(v, np.geomspace(*SIZES, DRAWS)) for v in operands]
    by = [drawn(v, np.full(DRAWS, float(moves))) for v, moves in operands.items()]
    slopes = jax.vmap(lambda *x: [jax.jvp(f, *x)[1] for f in (ruled, plain)])
    try:
        with jax.ensure_compile_time_eval():
            lowered = jax.jit(slopes).lower(at, by)
            text = lowered.as_text()
            asked = sha256(text.encode()).digest(), moving
            if asked not in _COMPARED or "callback" in text:  # what is called back has no text
                small = sum(x.size for x in at) < FEW
                run = lowered.compile(QUICKLY if small else None)
                pairs = zip(*map(jax.device_get, run(at, by)), strict=True)
                _COMPARED[asked] = all(_alike(x, y) for x, y in pairs)
        return not _COMPARED[asked]
    except Exception:  # as of a rule that holds a number of another trace, or of whole numbers
        return True


def _alike(x: np.ndarray, y: np.ndarray) -> bool:
    """Whether numbers are the same up to rounding where they are known, and some are."""
    known = np.isfinite(y)
    near = np.finfo(y.dtype).eps ** 0.5 * np.max(np.abs(y), where=known, initial=0)
    return bool(known.any() and np.allclose(x[known], y[known], rtol=0, atol=near))


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
    return [Dependence(OTHERWISE, WORDS["while"], one.ruled) for one in following]


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
    return [Dependence(OTHERWISE, WORDS["cond"], one.ruled) for one in joined]


LOOPS_AND_CALLS = {"scan": _scan, "while": _while, "cond": _cond}
