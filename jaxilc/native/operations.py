"""Operations on single numbers, one of each machine, and steps on small arrays of them.

A `Node` is a number that each machine has, computed or read from a `Place`. `INSTRUCTIONS` is the
table of all operations that a compiled program consists of, `COMPOSED` says which further
primitives of JAX are made from them, and `applied` carries out a step on small arrays of nodes.
What neither knows is `Unknown`.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Hashable, Iterable, Sequence
from functools import partial, reduce
from typing import NamedTuple, TypeAlias
from weakref import WeakKeyDictionary

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from numpy.typing import ArrayLike, DTypeLike

from .program import UNROLLED, Const, Known, Parameters, Step, Unknown

Array: TypeAlias = np.ndarray  # of nodes
Number: TypeAlias = np.bool | np.integer | np.floating
LARGEST = 4096  # elements of a small array
BOOL = np.dtype(bool)
TYPES = {np.dtype(t) for t in ("bool", "int32", "int64", "uint32", "float64", "float32")}


class Buffer(NamedTuple):
    """Rows in RAM.

    kind: `given` to the program, `carried` from trial to trial, `kept` within a trial, or `out`
    number: which of its kind
    length, width: its rows, and the numbers in each
    dtype: the type of the numbers
    alike: whether there is one number for all machines
    by_trial: whether there are such rows for each trial
    """

    kind: str
    number: int
    length: int
    width: int
    dtype: np.dtype
    alike: bool = False
    by_trial: bool = False

    @property
    def size(self) -> int:
        return self.length * self.width


class Cell(NamedTuple):
    """A number that is carried from sample to sample, or from trial to trial."""

    number: int


class Given(NamedTuple):
    """A number of an operand that has no axis of samples."""

    operand: int
    number: int


class At(NamedTuple):
    """A number of the row of a buffer at sample sign k + first; at sample first, if sign is 0."""

    buffer: Buffer
    sign: int
    first: int
    number: int


class AtIndex(NamedTuple):
    """A number of the row of a buffer at an index that is a node; known before that loop."""

    buffer: Buffer
    number: int
    loop: int


class Sample(NamedTuple):
    """The number of the sample: sign k + first."""

    sign: int
    first: int


Place: TypeAlias = Cell | Given | At | AtIndex | Sample


class Node:
    """A number of each machine.

    name: an operation of `INSTRUCTIONS`, `const`, or a place from which it is read
    args: the nodes that an operation is of
    dtype: its type
    what: the number of a constant, which place, or which operand of a formula; else None
    loop: the number of the loop over samples before which it is known
    varies: whether it changes from sample to sample of that loop
    alike: whether it is the same for all machines
    """

    __slots__ = ("alike", "args", "dtype", "loop", "name", "varies", "what")

    def __init__(self, name: str, args: tuple[Node, ...], dtype: np.dtype,
                 what: Number | Place | int | None = None, *,
                 loop: int = 0, varies: bool = False, alike: bool = True):  # fmt: skip
        self.name, self.args, self.dtype, self.what = name, args, np.dtype(dtype), what
        self.loop: int = max([loop, *(x.loop for x in args)])
        self.varies: bool = varies or any(x.varies for x in args)
        self.alike: bool = alike and all(x.alike for x in args)

    @property
    def value(self) -> Number:
        """The number of a constant."""
        assert isinstance(self.what, Number)
        return self.what

    @property
    def operand(self) -> int:
        """Which operand of a formula this is."""
        assert isinstance(self.what, int)
        return self.what


# The table
# --------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Instruction:
    """An operation of the compiled program.

    text: by the kind of the first operand, how LLVM writes it: an instruction, an intrinsic, which
        begins with @llvm, or a function of the C library for each machine alone, which begins
        with @. With one text for several kinds, these are its letters
    exact: the function by which constants are computed beforehand
    tests: whether the result is true or false
    """

    text: dict[str, str]
    exact: Callable[..., Number] | None = None
    tests: bool = False


def _compared(of_floats: str, of_ints: str, exact: Callable[..., Number]) -> Instruction:
    signed = of_ints if of_ints in ("eq", "ne") else f"s{of_ints}"
    unsigned = of_ints if of_ints in ("eq", "ne") else f"u{of_ints}"
    texts = {"f": f"fcmp {of_floats}", "i": f"icmp {signed}", "u": f"icmp {unsigned}"}
    return Instruction(texts | {"b": f"icmp {unsigned}"}, exact, tests=True)


# functions of the C library
LIBRARY = ("exp", "expm1", "log", "log1p", "sin", "cos", "tan", "tanh", "pow")
INSTRUCTIONS = {
    "add": Instruction({"f": "fadd", "iu": "add"}, np.add),
    "sub": Instruction({"f": "fsub", "iu": "sub"}, np.subtract),
    "mul": Instruction({"f": "fmul", "iu": "mul"}, np.multiply),
    "div": Instruction(
        {"f": "fdiv", "i": "sdiv", "u": "udiv"},
        lambda x, y: np.divide(x, y) if x.dtype.kind == "f" else (x - np.fmod(x, y)) // y,
    ),
    "rem": Instruction({"i": "srem", "u": "urem"}, np.fmod),
    "neg": Instruction({"f": "fneg"}, np.negative),
    "max": Instruction(
        {"f": "@llvm.maximum", "i": "@llvm.smax", "u": "@llvm.umax", "b": "or"}, np.maximum
    ),
    "min": Instruction(
        {"f": "@llvm.minimum", "i": "@llvm.smin", "u": "@llvm.umin", "b": "and"}, np.minimum
    ),
    "abs": Instruction({"f": "@llvm.fabs"}, np.abs),
    "sqrt": Instruction({"f": "@llvm.sqrt"}, np.sqrt),
    "floor": Instruction({"f": "@llvm.floor"}, np.floor),
    "ceil": Instruction({"f": "@llvm.ceil"}, np.ceil),
    "round_even": Instruction({"f": "@llvm.roundeven"}, np.rint),
    "round_away": Instruction({"f": "@llvm.round"}),
    "copysign": Instruction({"f": "@llvm.copysign"}, np.copysign),
    "and": Instruction({"biu": "and"}, np.bitwise_and),
    "or": Instruction({"biu": "or"}, np.bitwise_or),
    "xor": Instruction({"biu": "xor"}, np.bitwise_xor),
} | {
    name: _compared(of_floats, name, exact)
    for name, of_floats, exact in (
        ("eq", "oeq", np.equal), ("ne", "une", np.not_equal), ("lt", "olt", np.less),
        ("le", "ole", np.less_equal), ("gt", "ogt", np.greater), ("ge", "oge", np.greater_equal),
    )
} | {name: Instruction({"f": f"@{name}"}) for name in LIBRARY}  # fmt: skip
# conversions, by the kinds from and to
CONVERSIONS = {
    "ff": "", "bf": "uitofp", "if": "sitofp", "uf": "uitofp",
    "bi": "zext", "bu": "zext", "fi": "@llvm.fptosi.sat", "fu": "@llvm.fptoui.sat",
}  # fmt: skip


def instruction(name: str, kind: str) -> str | None:
    """How LLVM writes an operation on operands of a kind; None where it is not known."""
    known = INSTRUCTIONS.get(name)
    texts = {} if known is None else known.text
    return next((text for kinds, text in texts.items() if kind in kinds), None)


class Numbers:
    """The nodes of a program; equal ones are the same one.

    real: the floating point type of the program
    """

    def __init__(self, real: DTypeLike):
        self.real = np.dtype(real)
        self._known: dict[Hashable, Node] = {}
        self._dtypes = {t for t in TYPES if t.kind != "f" or t == self.real}

    def const(self, value: Number | float, dtype: np.dtype) -> Node:
        number: Number = dtype.type(value)
        return self._node("const", (), dtype, number, np.asarray(number).tobytes())

    def place(self, name: str, dtype: np.dtype, what: Place | int | None, *, loop: int = 0,
              varies: bool = False, alike: bool = True) -> Node:  # fmt: skip
        """A number that is read from a place; the same one for the same place."""
        return self._node(name, (), dtype, what, what, loop=loop, varies=varies, alike=alike)

    def row(self, index: Node, dtype: np.dtype, what: AtIndex) -> Node:
        """A number of the row of a table at an index."""
        return self._node("row", (index,), dtype, what, what, loop=what.loop,
                          alike=what.buffer.alike)  # fmt: skip

    def of(self, name: str, *args: Node, dtype: np.dtype | None = None) -> Node:
        """The result of an operation on nodes, by its name in the table."""
        if name == "select":
            no, yes = args[1:]
            if args[0].name == "const":
                return yes if args[0].value else no
            return no if no is yes else self._node(name, args, no.dtype, None, None)
        if name == "convert":
            return self._converted(args[0], np.dtype(dtype))
        if name == "bits":  # of a real number, as a whole one
            whole = np.dtype(f"int{8 * args[0].dtype.itemsize}")
            if args[0].name == "const":
                return self.const(args[0].value.view(whole), whole)
            return self._node(name, args, whole, None, None)
        kind = args[0].dtype.kind
        if instruction(name, kind) is None or any(x.dtype != args[0].dtype for x in args):
            raise Unknown(f"{name} of {' and '.join(str(x.dtype) for x in args)}")
        if (
            name in ("div", "rem")
            and kind != "f"
            and (args[1].name != "const" or args[1].value <= 0)
        ):
            raise Unknown(f"{name} of {args[0].dtype} by what is no positive constant")
        known = INSTRUCTIONS[name]
        dtype = BOOL if known.tests else args[0].dtype
        if known.exact is not None and all(x.name == "const" for x in args):
            with np.errstate(all="ignore"):
                return self.const(known.exact(*(x.value for x in args)), dtype)
        found = self._same(name, args) or (self._of_negative(name, args) if kind == "f" else None)
        return found or self._node(name, args, dtype, None, None)

    def clipped(self, place: Node, last: int) -> Node:
        """The nearest place from 0 to the last one."""
        low, high = self.const(0, place.dtype), self.const(last, place.dtype)
        return self.of("min", self.of("max", place, low), high)

    def _of_negative(self, name: str, args: tuple[Node, ...]) -> Node | None:
        """An operation on negatives as one that a sum takes for nothing, to the last bit."""
        plain = [x.args[0] if x.name == "neg" else x for x in args]
        signs = [x.name == "neg" for x in args]
        if not any(signs):
            return None
        if name == "neg":
            return plain[0]
        if name in ("mul", "div"):
            found = self.of(name, *plain)
            return found if all(signs) else self.of("neg", found)
        if name == "add" and not all(signs):
            return self.of("sub", *(plain[::-1] if signs[0] else plain))
        if name == "sub" and signs[1]:
            return self.of("sub", *plain[::-1]) if signs[0] else self.of("add", *plain)
        return None

    def _same(self, name: str, args: tuple[Node, ...]) -> Node | None:
        """The operand that an operation leaves as it is, to the last bit; else None.

        As XLA does, a division by a constant becomes a product, which takes less time, and a sum
        with zero is left out, though it would make +0 of -0.
        """
        one, other = (args * 2)[:2]
        if name in NEUTRAL:
            nothing = neutral(name, one.dtype)
            if _is(other, nothing) or _is(one, nothing):
                return one if _is(other, nothing) else other
        if name == "div" and other.name == "const" and _has_reciprocal(other.value):
            return self.of("mul", one, self.const(1 / other.value, other.dtype))
        if name == "div" and other.name == "select" and all(map(_is_power_of_two, other.args[1:])):
            which, *cases = other.args  # as in the slopes of a maximum
            inverse = (self.const(1 / x.value, x.dtype) for x in cases)
            return self.of("mul", one, self.of("select", which, *inverse))
        if name == "sub" and _is(other, 0) and not np.signbit(other.value):
            return one
        return None

    def again(self, like: Node, args: Sequence[Node]) -> Node:
        """The node of the same operation on other operands, with the digits that it had.

        What leaves a product as it is stays: else a sum would be rounded with the product. So does
        a quotient, which is no product with a reciprocal.
        """
        if isinstance(like.what, AtIndex):
            return self.row(args[0], like.dtype, like.what)
        if like.name != "convert":
            found = self.of(like.name, *args)
            if found.name == "const" or (found in args and found.name != "mul"):
                return found
        return self._node(like.name, (*args,), like.dtype, None, None)

    def known(
        self, like: Node, args: Iterable[Node], what: Number | Place | int | None
    ) -> Node | None:
        """The node of the same operation on other operands, or place, if the program has it."""
        return self._known.get((like.name, tuple(map(id, args)), like.dtype, what))

    def _converted(self, x: Node, dtype: np.dtype) -> Node:
        if x.dtype == dtype:
            return x
        if x.name == "const":
            if x.dtype.kind == "f" and dtype.kind in "iu" and not np.isfinite(x.value):
                raise Unknown(f"{x.value} as {dtype}")
            return self.const(x.value.astype(dtype), dtype)
        if dtype == BOOL:
            return self.of("ne", x, self.const(0, x.dtype))
        between = x.dtype.kind in "iu" and dtype.kind in "iu"
        if not between and CONVERSIONS.get(x.dtype.kind + dtype.kind, "") == "":
            raise Unknown(f"{x.dtype} as {dtype}")
        return self._node("convert", (x,), dtype, None, None)

    def _node(self, name: str, args: tuple[Node, ...], dtype: np.dtype,
              what: Number | Place | int | None, key: Hashable, *,
              loop: int = 0, varies: bool = False, alike: bool = True) -> Node:  # fmt: skip
        if jnp.issubdtype(dtype, jax.dtypes.extended) or np.dtype(dtype) not in self._dtypes:
            raise Unknown(f"numbers of the type {dtype}")
        known = (name, tuple(map(id, args)), np.dtype(dtype), key)
        if known not in self._known:
            self._known[known] = Node(name, args, dtype, what, loop=loop, varies=varies,
                                      alike=alike)  # fmt: skip
        return self._known[known]

    # Arrays of them
    # ----------------------------------------------------------------------------------------------

    def array(self, values: ArrayLike) -> Array:
        """An array of constants."""
        values = np.asarray(values)
        if values.size > LARGEST:
            raise Unknown(f"an array of {values.size} numbers that are no rows of a trial")
        return _filled(values.shape, [self.const(v, values.dtype) for v in values.ravel()])

    def elements(self, name: str) -> Callable[..., Array]:
        """An operation on arrays, element by element."""
        return partial(self.each, partial(self.of, name))

    def each(self, function: Callable[..., Node], *arrays: Array) -> Array:
        """The function of the elements of arrays, of which some may be single numbers."""
        arrays = tuple(np.broadcast_arrays(*arrays))
        return _filled(
            arrays[0].shape, [function(*x) for x in zip(*(a.flat for a in arrays), strict=True)]
        )


def _has_reciprocal(x: Number) -> bool:
    """Whether the number and its reciprocal are normal real numbers."""
    if not isinstance(x, np.floating):
        return False
    least = np.finfo(x.dtype).tiny
    return bool(least <= abs(x) <= 1 / least)


def _is_power_of_two(x: Node) -> bool:
    """Whether a product with the reciprocal is the quotient, to the last bit."""
    return x.name == "const" and _has_reciprocal(x.value) and abs(np.frexp(x.value)[0]) == 0.5


def _is(x: Node, value: float | Number) -> bool:
    return x.name == "const" and bool(x.value == value)


def _filled(shape: Sequence[int], items: Sequence[Node] | Array) -> Array:
    out = np.empty(len(items), object)
    out[:] = items
    return out.reshape(shape)


def numbered(shape: Sequence[int], node: Callable[[int], Node]) -> Array:
    """An array of nodes by their numbers, in row-major order."""
    return _filled(shape, [node(m) for m in range(math.prod(shape))])


# What is made from them
# --------------------------------------------------------------------------------------------------


def _sign(n: Numbers, _: Parameters, x: Node) -> Node:
    if x.dtype.kind != "f":
        least = n.const(-1 if x.dtype.kind == "i" else 0, x.dtype)
        return n.of("max", n.of("min", x, n.const(1, x.dtype)), least)
    one = n.of("copysign", n.const(1, x.dtype), x)
    return n.of("select", n.of("gt", n.of("abs", x), n.const(0, x.dtype)), x, one)  # 0, NaN: x


def _negative(n: Numbers, x: Node) -> Node:
    return n.of("neg", x) if x.dtype.kind == "f" else n.of("sub", n.const(0, x.dtype), x)


def _power(n: Numbers, x: Node, y: int) -> Node:
    """x to the power of a whole number, by squaring, as JAX does; a negative one divides 1."""
    found, square, left = None, x, abs(y)
    while left:
        if left % 2:
            found = square if found is None else n.of("mul", found, square)
        left //= 2
        square = n.of("mul", square, square) if left else square
    found = n.const(1, x.dtype) if found is None else found
    return n.of("div", n.const(1, x.dtype), found) if y < 0 else found


def _logistic(n: Numbers, _: Parameters, x: Node) -> Node:
    one = n.const(1, x.dtype)
    return n.of("div", one, n.of("add", one, n.of("exp", n.of("neg", x))))


def _one_minus_square(n: Numbers, _: Parameters, x: Node) -> Node:
    """The slope of a hyperbolic tangent x, a primitive of its own in JAX 0.12."""
    one = n.const(1, x.dtype)
    return n.of("mul", n.of("add", one, x), n.of("sub", one, x))  # as JAX does, for x near 1


def _select(n: Numbers, _: Parameters, which: Node, *cases: Node) -> Node:
    if which.dtype == BOOL:
        return n.of("select", which, *cases)
    found = cases[-1]
    for i, case in reversed(list(enumerate(cases[:-1]))):
        found = n.of("select", n.of("le", which, n.const(i, which.dtype)), found, case)
    return found


def _ends(dtype: np.dtype) -> tuple[int, int]:
    """The least and the largest whole number of a type."""
    of = np.iinfo(dtype.name)
    return int(of.min), int(of.max)


def _less_in_order(n: Numbers, x: Node, y: Node) -> Node:
    """x < y in the order of all numbers, in which -0 < 0, and NaN is beyond infinity."""

    def place(x: Node) -> Node:
        bits = n.of("bits", x)
        turned = n.of("xor", bits, n.const(_ends(bits.dtype)[1], bits.dtype))
        return n.of("select", n.of("lt", bits, n.const(0, bits.dtype)), bits, turned)

    return n.of("lt", place(x), place(y))


ROUNDED = ("round_away", "round_even")  # by the number of a method in JAX
# primitives of JAX by name, as functions of the nodes, of the parameters and of the operands
COMPOSED: dict[str, Callable[..., Node]] = {
    "sign": _sign,
    "not": lambda n, _, x: n.of("xor", x, n.const(neutral("and", x.dtype), x.dtype)),
    "neg": lambda n, _, x: _negative(n, x),
    "abs": lambda n, _, x: (
        n.of("abs", x) if x.dtype.kind == "f" else n.of("max", x, _negative(n, x))
    ),
    "is_finite": lambda n, _, x: n.of("lt", n.of("abs", x), n.const(np.inf, x.dtype)),
    "integer_pow": lambda n, params, x: _power(n, x, params["y"]),
    "square": lambda n, _, x: _power(n, x, 2),
    "rsqrt": lambda n, _, x: n.of("div", n.const(1, x.dtype), n.of("sqrt", x)),
    "logistic": _logistic,
    "one_minus_square": _one_minus_square,
    "select_n": _select,
    "clamp": lambda n, _, low, x, high: n.of("min", n.of("max", low, x), high),
    "round": lambda n, params, x: n.of(ROUNDED[int(params["rounding_method"])], x),
    "convert_element_type": lambda n, params, x: n.of("convert", x, dtype=params["new_dtype"]),
    "add_any": lambda n, _, x, y: n.of("add", x, y),
    "lt_to": lambda n, _, x, y: _less_in_order(n, x, y),
    "le_to": lambda n, _, x, y: n.of("xor", _less_in_order(n, y, x), n.const(True, BOOL)),
    "real": lambda n, _, x: x,
}
# by which operation the elements along an axis are put together
GATHERED = {"reduce_sum": "add", "reduce_prod": "mul", "reduce_max": "max", "reduce_min": "min",
            "reduce_and": "and", "reduce_or": "or"}  # fmt: skip
RUNNING = {"cumsum": "add", "cumprod": "mul", "cummax": "max", "cummin": "min"}
TOGETHER = GATHERED | RUNNING
# what these begin with: what leaves the other operand as it is, to the last bit, but for -0 + 0
NEUTRAL = {"add": 0.0, "mul": 1.0, "max": -np.inf, "min": np.inf, "and": np.inf, "or": 0.0}


def neutral(name: str, dtype: np.dtype) -> Number:
    """What an operation of NEUTRAL begins with; of whole numbers, the largest and the smallest."""
    value = NEUTRAL[name]
    if dtype.kind in "iu" and np.isinf(value):
        value = -1 if name == "and" and dtype.kind == "i" else _ends(dtype)[value > 0]
    found: Number = dtype.type(value > 0 if dtype == BOOL else value)
    return found


def known(name: str) -> bool:
    """Whether `applied` knows steps of this name."""
    return elementwise(name) or on_arrays(name) or name in TO_PLACES or name == "iota"


def foreign(step: Step) -> bool:
    """Whether a step is none of these, such as one that draws random numbers."""
    if step.name in INSTRUCTIONS and instruction(step.name, step.ins[0].dtype.kind) is None:
        return True
    types = {x.dtype for x in (*step.ins, *step.outs)}
    return step.name != "scan" and not (known(step.name) and types <= TYPES)


def elementwise(name: str) -> bool:
    """Whether a step of this name is carried out element by element."""
    return name in COMPOSED or name in INSTRUCTIONS


def one_by_one(n: Numbers, step: Step) -> Callable[..., Node]:
    """The function of the elements that an elementwise step computes."""
    if step.name in COMPOSED:
        return partial(COMPOSED[step.name], n, step.params)
    return partial(n.of, step.name)


_formulas: WeakKeyDictionary[Step, Node] = WeakKeyDictionary()  # by step, while it is there


def formula(step: Step) -> Node:
    """What a step computes element by element: a tree of operations of `INSTRUCTIONS`.

    Its operands are nodes of the name `operand`, and those that are one whole number are constants,
    by which others may be divided. It is written once, not for each sample that is played. Raises
    Unknown for other steps.
    """
    if step not in _formulas:
        n = Numbers(np.float64)
        places = [
            n.const(np.ravel(x.array)[0], np.dtype(x.dtype))
            if isinstance(x, Const) and x.dtype.kind in "iu" and uniform(x.array)
            else n.place("operand", np.dtype(x.dtype), i)
            for i, x in enumerate(step.ins)
        ]
        _formulas[step] = one_by_one(n, step)(*places)
    return _formulas[step]


def uniform(array: Known) -> bool:
    """Whether all elements of an array are one number, to the last bit."""
    flat = np.ravel(array)
    return bool(len(flat)) and flat.tobytes() == flat[:1].tobytes() * len(flat)


# Steps on small arrays
# --------------------------------------------------------------------------------------------------


def applied(n: Numbers, step: Step, arrays: Sequence[Array],
            shape: Sequence[int] | None = None) -> Array:  # fmt: skip
    """The result of a step with one result on arrays of nodes.

    shape: that of the result, where it is not that of the step because an array has one row only
    Raises Unknown for a step that is not known.
    """
    out, name, params = step.outs[0], step.name, step.params
    shape = tuple(out.shape if shape is None else shape)
    check_size(step, shape)
    if elementwise(name):
        return n.each(one_by_one(n, step), *arrays)
    if on_arrays(name):
        if name == "dot_general":
            arrays = [n.each(partial(n.of, "convert", dtype=out.dtype), x) for x in arrays]
        number = partial(n.const, dtype=out.dtype)
        return rearranged(step, arrays, shape, n.elements, number).reshape(shape)
    if name in TO_PLACES:
        return _to_places(n, step, arrays, shape)
    if name == "iota":
        return n.array(counted(params, shape).astype(out.dtype))
    raise Unknown(name)


def check_size(step: Step, shape: Sequence[int]) -> None:
    """Raise Unknown for a step whose result of this shape has too many numbers for single ones."""
    if (size := math.prod(shape)) > LARGEST:
        raise Unknown(f"{step.name} with a result of {size} numbers that are no rows")


# What steps do with arrays, of nodes or of numbers
# --------------------------------------------------------------------------------------------------


def on_arrays(name: str) -> bool:
    """Whether `rearranged` knows steps of this name."""
    return name in MOVES or name in TOGETHER or name == "dot_general"


def rearranged(step: Step, arrays: Sequence[Array], shape: Sequence[int],
               elements: Callable[[str], Callable[..., Array]],
               number: Callable[[Number], Node | Number]) -> Array:  # fmt: skip
    """The elements of arrays moved, or put together, up to the shape of the result.

    shape: of the result
    elements: gives the function of arrays for an operation on their elements, by its name
    number: gives the element that is a number
    """
    name, params, dtype = step.name, step.params, step.outs[0].dtype
    if name in MOVES:
        return MOVES[name](params, arrays, shape)
    if name in RUNNING:
        return _running(elements(RUNNING[name]), arrays[0], params["axis"], params["reverse"])
    begin = number(neutral(GATHERED.get(name, "add"), dtype))
    if name in GATHERED:
        return _gathered(elements(GATHERED[name]), arrays[0], params["axes"], begin)
    a, b = arrays
    return _product(params["dimension_numbers"], a, b, elements("mul"), elements("add"), begin)


def _gathered(together: Callable[..., Array], x: Array, axes: Sequence[int],
             begin: Node | Number) -> Array:  # fmt: skip
    """The elements along axes put together, in row-major order: 0 + x[0] + x[1] + ...

    A maximum begins with -infinity, and is NaN if one is NaN.
    """
    front = np.moveaxis(x, sorted(axes), range(len(axes)))
    count, rest = math.prod(front.shape[: len(axes)]), front.shape[len(axes) :]
    return reduce(together, front.reshape(count, *rest), np.full(rest, begin, x.dtype))


def _running(together: Callable[..., Array], x: Array, axis: int, back: bool) -> Array:
    """The elements up to each one along an axis put together; or those from it on."""
    found = np.array(np.moveaxis(x, axis, 0))
    rows = found[::-1] if back else found
    for i in range(1, len(rows)):
        rows[i : i + 1] = together(rows[i - 1 : i], rows[i : i + 1])
    return np.moveaxis(found, 0, axis)


def _product(numbers: lax.DotDimensionNumbers, a: Array, b: Array, multiply: Callable[..., Array],
            add: Callable[..., Array], zero: Node | Number) -> Array:  # fmt: skip
    """(batch, free of a, free of b) 0 + a[0] b[0] + a[1] b[1] + ..., over the contracted axes."""
    (of_a, of_b), (batch_a, batch_b) = numbers
    free_a = [i for i in range(a.ndim) if i not in (*of_a, *batch_a)]
    free_b = [i for i in range(b.ndim) if i not in (*of_b, *batch_b)]

    def size(axes: Sequence[int], x: Array) -> int:
        return math.prod(x.shape[i] for i in axes)

    terms, many, rows, columns = size(of_a, a), size(batch_a, a), size(free_a, a), size(free_b, b)
    left = a.transpose(*of_a, *batch_a, *free_a).reshape(terms, many, rows, 1)
    right = b.transpose(*of_b, *batch_b, *free_b).reshape(terms, many, 1, columns)
    total = np.full((many, rows, columns), zero, a.dtype)
    for x, y in zip(left, right, strict=True):
        total = add(total, multiply(x, y))
    return total


def counted(params: Parameters, shape: Sequence[int]) -> np.ndarray:
    """The place of each element along an axis."""
    return np.indices(shape, sparse=True)[params["dimension"]] + np.zeros(shape, int)


def clamped(
    shape: Sequence[int], sizes: Sequence[int], starts: Sequence[np.ndarray]
) -> tuple[slice, ...]:
    """A part of an array of a shape, whose start is clamped so that the part lies within it."""
    of = zip(starts, shape, sizes, strict=True)
    firsts = [min(max(int(s), 0), n - size) for s, n, size in of]
    return tuple(slice(a, a + size) for a, size in zip(firsts, sizes, strict=True))


def updated(x: Array, new: Array, starts: Sequence[np.ndarray]) -> Array:
    """The array with such a part replaced."""
    found = np.array(x)
    found[clamped(x.shape, new.shape, starts)] = new
    return found


def padded(
    params: Parameters, of: Sequence[int], to: Sequence[int]
) -> tuple[tuple[slice, ...], tuple[slice, ...]]:
    """Which part of the result is an array that is padded, and which part of the array that is."""
    found = []
    for (low, _, between), n, m in zip(params["padding_config"], of, to, strict=True):
        by = 1 + between
        first, last = max(0, -(low // by)), max(0, min(n, 1 + (m - 1 - low) // by))
        found.append((slice(low + by * first, max(0, low + by * last), by), slice(first, last)))
    into, taken = zip(*found, strict=True) if found else ((), ())
    return into, taken


def _broadcast(params: Parameters, arrays: Sequence[Array], shape: Sequence[int]) -> Array:
    wide = [1] * len(shape)
    for axis, to in enumerate(params["broadcast_dimensions"]):
        wide[to] = arrays[0].shape[axis]
    return np.broadcast_to(arrays[0].reshape(wide), shape)


def _slice(params: Parameters, arrays: Sequence[Array], shape: Sequence[int]) -> Array:
    first, last = params["start_indices"], params["limit_indices"]
    strides = params["strides"] or (1,) * len(first)
    return arrays[0][tuple(slice(*x) for x in zip(first, last, strides, strict=True))]


def _pad(params: Parameters, arrays: Sequence[Array], shape: Sequence[int]) -> Array:
    x, value = arrays
    out = np.full(shape, value, x.dtype)
    to, of = padded(params, x.shape, shape)
    out[to] = x[of]
    return out


# steps that only move numbers, by their parameters, the arrays and the shape of the result
MOVES: dict[str, Callable[..., Array]] = {
    "broadcast_in_dim": _broadcast,
    "reshape": lambda _, arrays, shape: arrays[0].reshape(shape),
    "squeeze": lambda _, arrays, shape: arrays[0].reshape(shape),
    "expand_dims": lambda _, arrays, shape: arrays[0].reshape(shape),
    "transpose": lambda params, arrays, _: arrays[0].transpose(params["permutation"]),
    "rev": lambda params, arrays, _: np.flip(arrays[0], params["dimensions"]),
    "concatenate": lambda params, arrays, _: np.concatenate(arrays, params["dimension"]),
    "slice": _slice,
    "pad": _pad,
}


# further ones, with the operands that say where
TO_PLACES = dict.fromkeys(("gather", "scatter", "scatter-add"), slice(1, 2))
TO_PLACES |= {"dynamic_slice": slice(1, None), "dynamic_update_slice": slice(2, None)}


def constants(array: Array, dtype: DTypeLike) -> np.ndarray | None:
    """The values of an array of constants; None where some are not known beforehand."""
    if any(x.name != "const" for x in array.flat):
        return None
    return np.array([x.value for x in array.flat], dtype).reshape(array.shape)


def _to_places(n: Numbers, step: Step, arrays: Sequence[Array], shape: Sequence[int]) -> Array:
    """The result of a step that moves nodes from places, or to them."""
    where = range(len(arrays))[TO_PLACES[step.name]]
    known = {i: constants(arrays[i], step.ins[i].dtype) for i in where}
    places = [x for x in known.values() if x is not None]
    if len(places) < len(known):
        unknown = [i for i, x in known.items() if x is None]
        return _anywhere(n, step, arrays, shape, unknown)
    if step.name != "scatter-add":
        return at_places(step, arrays, places, shape)
    out = arrays[0].copy()
    found = places_of(step, out.shape, places[0], arrays[2].shape)
    turn = in_turn(step, found.ndim)
    of_each = (x.transpose(turn).flat for x in (found, arrays[2]))
    for place, new in zip(*of_each, strict=True):
        if place >= 0:
            out.flat[place] = n.of("add", out.flat[place], new)
    return out


def at_places(step: Step, arrays: Sequence[Array], places: Sequence[np.ndarray],
              shape: Sequence[int]) -> Array:  # fmt: skip
    """The elements of arrays, nodes or numbers, moved from places that are known, or to them.

    A gather of JAX moves the numbers of the elements in place of the elements.
    """
    name, x = step.name, arrays[0]
    if name == "dynamic_slice":
        return x[clamped(x.shape, shape, places)]
    if name == "dynamic_update_slice":
        return updated(x, arrays[1], places)
    found = places_of(step, x.shape, places[0], arrays[-1].shape)
    if name == "gather":
        return x.ravel()[found.ravel()].reshape(shape)
    out, turn = x.copy(), in_turn(step, found.ndim)
    found, new = found.transpose(turn), arrays[2].transpose(turn)
    out.flat[found[found >= 0]] = new[found >= 0]
    return out


def in_turn(step: Step, axes: int) -> list[int]:
    """The axes of what a scatter writes, in the order in which it does: place after place."""
    windows = step.params["dimension_numbers"].update_window_dims
    return [*(i for i in range(axes) if i not in windows), *windows]


def _window(step: Step, axes: int, new: Sequence[int]) -> list[int]:
    """The shape of what a scatter writes at a place, from the shape of all that is new."""
    of = step.params["dimension_numbers"]
    sizes = iter([new[i] for i in of.update_window_dims])
    left_out = (*of.inserted_window_dims, *of.operand_batching_dims)
    return [1 if i in left_out else next(sizes) for i in range(axes)]


def places_of(step: Step, shape: Sequence[int], index: Known, new: Sequence[int]) -> np.ndarray:
    """The numbers of the elements that a gather reads, or in whose place a scatter writes.

    Those of a scatter are -1 beyond the end. Raises Unknown for a gather from there.

    shape: of the array
    index: the places
    new: the shape of what a scatter writes
    """
    numbered = jnp.arange(math.prod(shape)).reshape(shape)
    index = jnp.asarray(index, step.ins[1].dtype)  # which knows what is beyond its largest number
    if step.name == "gather":
        found = np.asarray(step.bound(numbered, index, fill_value=-1)[0])
        if found.size and found.min() < 0:
            raise Unknown("gather beyond the end")
        return found
    of, update = step.params["dimension_numbers"], step.params.get("update_jaxpr")
    if step.name == "scatter" and update is not None:
        raise Unknown("scatter of a function of the numbers")
    clip, fill = lax.GatherScatterMode.CLIP, lax.GatherScatterMode.FILL_OR_DROP
    numbers = lax.GatherDimensionNumbers(
        of.update_window_dims, of.inserted_window_dims, of.scatter_dims_to_operand_dims,
        of.operand_batching_dims, of.scatter_indices_batching_dims,
    )  # fmt: skip
    return np.asarray(lax.gather(
        numbered, index, numbers, _window(step, len(shape), new), fill_value=-1,
        mode=clip if step.params["mode"] == clip else fill,
    ))  # fmt: skip


def _anywhere(n: Numbers, step: Step, arrays: Sequence[Array], shape: Sequence[int],
              unknown: Sequence[int]) -> Array:  # fmt: skip
    """The result of a step at places along one axis that are found while it runs.

    It is chosen among those at all places, or each place has what is added there.
    """
    x, index, name, params = arrays[0], arrays[unknown[0]], step.name, step.params
    refused = f"{name} at places that are found while it runs"
    if name.startswith("dynamic") and len(unknown) == 1:
        axes, windows, wide = (unknown[0] - len(arrays) + x.ndim,), range(x.ndim), shape
        sizes = params["slice_sizes"] if name == "dynamic_slice" else arrays[1].shape
    elif name == "gather" and not (of := params["dimension_numbers"]).operand_batching_dims:
        axes, windows, wide = of.start_index_map, of.offset_dims, shape
        sizes = params["slice_sizes"]
    elif name == "scatter-add" and not (of := params["dimension_numbers"]).operand_batching_dims:
        axes, windows, wide = (
            of.scatter_dims_to_operand_dims, of.update_window_dims, arrays[2].shape
        )  # fmt: skip
        sizes = _window(step, x.ndim, wide)
    else:
        raise Unknown(refused)
    last, dtype = x.shape[axes[0]] - sizes[axes[0]], index.flat[0].dtype
    if len(axes) != 1 or not 0 <= last < UNROLLED:
        raise Unknown(refused)
    batch = iter(index.shape)
    place = index.reshape([1 if i in windows else next(batch) for i in range(len(wide))])
    clipped = name.startswith("dynamic") or params["mode"] == lax.GatherScatterMode.CLIP
    promised = name == "gather" and params["mode"] == lax.GatherScatterMode.PROMISE_IN_BOUNDS
    if clipped or promised:
        place = n.each(lambda p: n.clipped(p, last), place)

    def at(i: int, *arrays: Array) -> Array:
        """The result for all machines at place i."""
        given = [*arrays]
        given[unknown[0]] = n.array(np.full(index.shape, i, dtype))
        return _to_places(n, step, given, shape)

    def here(i: int, no: Array, yes: Array) -> Array:
        is_here = n.each(lambda p: n.of("eq", p, n.const(i, dtype)), place)
        return n.elements("select")(is_here, no, yes)

    if name == "scatter-add":
        found, new = x, arrays[2]
        nothing = n.array(np.zeros(new.shape, new.flat[0].dtype))
        for i in range(last + 1):
            found = at(i, found, index, here(i, nothing, new))
        return found
    found = at(last, *arrays)
    if not (clipped or promised):
        found = np.full(shape, _beyond(n, params["fill_value"], found.flat[0].dtype), object)
        last += 1
    for i in reversed(range(last)):
        found = here(i, found, at(i, *arrays))
    return found


def _beyond(n: Numbers, fill: float | None, dtype: np.dtype) -> Node:
    """What a gather finds beyond the end."""
    if fill is None and dtype.kind != "f":
        raise Unknown(f"gather of {dtype} beyond the end")
    return n.const(np.nan if fill is None else fill, dtype)
