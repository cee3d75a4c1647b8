"""The allowed values of a parameter: its interval, its type, and the message that states them."""

from __future__ import annotations

import functools
import numbers
import re
import types
import typing
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from .aliases import Value

_INTERVAL = re.compile(r"^([\[(])\s*(\S+)\s*,\s*(\S+)\s*([\])])$")
_LONG = 60  # number of characters of a value that a message shows
MOST_WORDS = 8  # of a text, such as the numbers of an array, that are shown
TRACED = "is traced; allowed is a static value, no argument of jit, vmap or grad"
SEEDS = "[0, 9e18]"  # what random generators accept, with room for the seeds that follow


class Interval(NamedTuple):
    """An interval of the real line, written as in a paper: `(0, 1]`."""

    low: float
    high: float
    closed_low: bool
    closed_high: bool

    @classmethod
    def parse(cls, text: str) -> Interval:
        match = _INTERVAL.match(text)
        if not match:
            raise ValueError(f"{text!r} is not an interval such as '(0, 1]'")
        left, low, high, right = match.groups()
        return cls(float(low), float(high), left == "[", right == "]")

    def contains(self, value: Value) -> bool:
        """Whether every element is in the interval; NaN never is."""
        value = np.asarray(value)
        # the bounds may be beyond the largest number of half precision, 65,504
        value = value.astype(float) if value.dtype.kind == "f" and value.itemsize < 4 else value
        above = value >= self.low if self.closed_low else value > self.low
        below = value <= self.high if self.closed_high else value < self.high
        return bool(np.all(above & below))

    def __str__(self) -> str:
        return self.text(6)

    def text(self, digits: int) -> str:
        """The interval with its ends to a number of digits."""
        opening, closing = "[" if self.closed_low else "(", "]" if self.closed_high else ")"
        return f"{opening}{self.low:.{digits}g}, {self.high:.{digits}g}{closing}"


def require(
    owner: str,
    name: str,
    values: Value,
    interval: str,
    unit: str = "",
    *,
    whole: bool = False,
    many: bool = False,
    optional: bool = False,
    note: str = "",
) -> None:
    """Raises ValueError for a value that is not a number in the interval.

    owner: class or function that has the parameter, the first word of the message; may be empty
    many: whether an array is allowed; the message names its first number outside the interval
    optional: whether None is allowed, too
    note: text of the message after the interval, for instance `, the order`
    """
    if optional and values is None:
        return
    wanted = Interval.parse(interval)
    name = f"{owner}: {name}" if owner else name
    found = None if isinstance(values, bool | np.bool_) else as_numbers(values)
    if found is None or (found.ndim and not many):
        said = f"= {brief(values)} is not a number{' or an array of numbers' * many}"
        raise ValueError(f"{name} {TRACED if hasattr(values, 'aval') else said}")
    for i, value in np.ndenumerate(found) if whole or not wanted.contains(found) else ():
        if not wanted.contains(value) or (whole and value % 1):
            said = f"{outside(value, wanted, unit)}{' of whole numbers' * whole}{note}"
            raise ValueError(f"{name}{list(i) or ''} = {said}")
    if whole and not is_whole(values):
        raise ValueError(
            f"{name} = {brief(values)} is a {type(values).__name__}; allowed is a whole number in "
            f"{wanted}{note}"
        )


def need_one_of(owner: str, name: str, value: str, choices: Iterable[str]) -> None:
    """Raises ValueError for a value that is none of its choices, naming them; owner: as above."""
    names = list(choices)
    if value not in names:
        name, allowed = f"{owner}: {name}" if owner else name, ", ".join(map(repr, names))
        raise ValueError(f"{name} = {value!r} is not one of {allowed}")


def as_numbers(value: Value) -> np.ndarray | None:
    """The value as an array of floats, or None if it does not consist of real numbers.

    An array of half to double precision keeps its precision, not the byte order of another machine.
    What is masked is no number.
    """
    if np.ma.is_masked(value):
        return None
    try:
        array = np.asarray(value)
        # integers that are too large for an integer type of NumPy
        if array.dtype == object and array.size and all(isinstance(x, int) for x in array.flat):
            return array.astype(float)
    # rows of different lengths, or a list that contains itself
    except (ValueError, TypeError, OverflowError, RecursionError):
        return None
    if array.dtype.kind not in "fiu":
        return None
    kept = hasattr(value, "dtype") and array.dtype.kind == "f" and array.dtype.itemsize <= 8
    return native(array) if kept else array.astype(float)


def native(value: Value) -> Value:
    """An array in the byte order of this machine, the only one in which JAX computes.

    Files of LabVIEW, FITS and MATLAB hold others. What is no array of NumPy stays as it is.
    """
    foreign = isinstance(value, np.ndarray) and not value.dtype.isnative
    return value.astype(value.dtype.newbyteorder("=")) if foreign else value


def concrete(value: Value) -> Value:
    """The number or text in a scalar of NumPy or a 0-d array; any other value itself.

    NumPy's np.float16(1e-3) is equal to 1e-3 and has its hash, so that a compiled program of one of
    them would be taken for the other, but it is a number 4e-4 larger.
    """
    if getattr(value, "shape", None) != () or np.ma.is_masked(value):
        return value
    try:
        return value.item()
    except (TypeError, AttributeError, NotImplementedError):  # traced, or without a number
        return value


def as_annotated(value: Value, kind: Value) -> Value:
    """A value that fits an annotation, with each number of the type in it."""
    origin: Value = typing.get_origin(kind)
    inside = typing.get_args(kind)
    if origin in (typing.Union, types.UnionType):
        return as_annotated(value, next(one for one in inside if fits(value, one)))
    if origin is tuple:
        kinds = inside[:1] * len(value) if inside[1:] == (...,) else inside
        return tuple(map(as_annotated, value, kinds))
    return kind(value) if kind in (int, float) and value is not None else value


def is_number(value: Value) -> bool:
    """Whether the value is one real number in the range of a float; True and False are not."""
    try:
        return (
            isinstance(value, numbers.Real)
            and not isinstance(value, bool)
            and float(value) is not None
        )
    except OverflowError:
        return False


def is_whole(value: Value) -> bool:
    """Whether the value is of a type of whole numbers: 2 is, and 2.0 is not."""
    return isinstance(value, numbers.Integral) and not isinstance(value, bool)


def brief(value: Value) -> str:
    """The value as one short line of text."""
    try:
        text = repr(value)
    except (ValueError, RecursionError):  # thousands of digits, or a list that contains itself
        text = f"a {type(value).__name__} too long to show"
    text = " ".join(text.split())
    return text if len(text) <= _LONG else f"{text[: _LONG - 4]} ..."


def shown(values: Value, digits: int = 6) -> str:
    """A number, or the numbers of an array, in a few characters."""
    values = np.asarray(values)
    if values.ndim == 0:
        return f"{values:.{digits}g}"
    return np.array2string(values, threshold=8, precision=digits).replace("\n", "")


def outside(values: Value, wanted: Interval, unit: str = "") -> str:
    """What a message says of values outside an interval, with the digits that tell them from it."""
    numbers, ends = np.asarray(values, float).reshape(-1, 1), np.array(wanted[:2])
    for digits in range(6, 18):
        of = [np.array([float(f"{x:.{digits}g}") for x in some.flat]) for some in (numbers, ends)]
        told = of[0][:, None], of[1]
        if all(np.array_equal(by(numbers, ends), by(*told)) for by in (np.less, np.greater)):
            break
    return f"{shown(values, digits)}{unit} is outside its allowed range {wanted.text(digits)}"


def value_text(value: object) -> str:
    """A number, or a text of which long ones are cut, such as a value of an axis."""
    words = str(value).split()
    if len(words) > MOST_WORDS:
        return f"{' '.join(words[:3])} ... {words[-1]} ({len(words)} values)"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def share_text(share: float) -> str:
    """A share in percent, such as 99.98%; 0.0% and 100.0% are of none and of all alone."""
    digits, ends = 1, (0.0, 1.0)
    while 0 < share < 1 and f"{share:.{digits}%}" in [f"{end:.{digits}%}" for end in ends]:
        digits += 1
    return f"{share:.{digits}%}"


# Types, as annotations name them
# ---------------------------------------------------------------------------------------------


@functools.cache
def annotations_of(cls: type) -> dict[str, Value]:
    """The annotations of the fields of a class, by name.

    The result is empty if a name in them cannot be resolved, such as one defined in a function.
    """
    try:
        return typing.get_type_hints(cls)
    except (NameError, AttributeError, TypeError, SyntaxError):
        return {}


def fits(value: Value, kind: Value) -> bool:
    """Whether a value agrees with an annotation.

    Any value agrees with Any, and with an annotation that is not understood as a type.
    """
    origin: Value = typing.get_origin(kind)
    inside = typing.get_args(kind)
    if origin in (typing.Union, types.UnionType):
        return any(fits(value, one) for one in inside)
    if origin is tuple:
        if not isinstance(value, tuple):
            return False
        if len(inside) == 2 and inside[1] is ...:
            return all(fits(x, inside[0]) for x in value)
        return len(value) == len(inside) and all(map(fits, value, inside))
    if kind is None:
        return value is None
    if kind in (int, float):
        return is_whole(value) if kind is int else is_number(value)
    try:
        return isinstance(value, origin or kind)
    except TypeError:  # the annotation is Any or not a class, so nothing can be checked
        return True


def allowed(kind: Value) -> str:
    """The end of a message about a value of a wrong type, such as `allowed is Scheme`."""
    words = named(kind)
    return f"allowed {'are' if ' and ' in words else 'is'} {words}"


def named(kind: Value) -> str:
    """The name of a type in words."""
    origin: Value = typing.get_origin(kind)
    inside = typing.get_args(kind)
    if origin in (typing.Union, types.UnionType):
        return " and ".join(map(named, inside))
    if origin is tuple:
        return "a tuple (" + ", ".join("..." if one is ... else named(one) for one in inside) + ")"
    words = {
        int: "a whole number",
        float: "a number",
        str: "text",
        bool: "True or False",
        type(None): "None",
    }
    own = getattr(kind, "__dict__", {}).get("in_words")  # a class that says where more of it are
    return words.get(kind) or own or str(getattr(kind, "__name__", kind))
