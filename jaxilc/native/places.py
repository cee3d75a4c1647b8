"""The places from which a compiled program reads numbers."""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

import numpy as np


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
