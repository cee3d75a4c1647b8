"""One shape for every condition of convergence: a number, its margin, and what the claim rests on.

A condition claims nothing where a premise of its theorem is broken. The numbers come from compiled
code; the verdict is given here, outside of it, where the numbers are known. Premises are looked at,
not assumed: `linearity` reads them off the program, and `outlook` bounds all trials to come.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from ..pytree.in_short import in_short

MONOTONE, CONVERGES, DIVERGES, NOT_CLAIMED = "monotone", "converges", "diverges", "not claimed"
CLAIMS = MONOTONE, CONVERGES, DIVERGES, NOT_CLAIMED
HOLDS, FAILS = "holds", "fails"
ROUNDING = 1000.0  # in units of the last place
ALIKE = 100.0  # likewise, of numbers that are the same but for rounding


class Premise(NamedTuple):
    """What a theorem presumes.

    name:   as in "plant stable"
    detail: what was looked at, and what was found
    held:   () or (S,) whether it holds throughout, for each of S plants
    share_broken: the share of samples, trials or plants for which it does not hold
    """

    name: str
    held: bool | np.ndarray
    share_broken: float | np.ndarray
    detail: str = ""


class Condition(NamedTuple):
    """A condition `value < limit`.

    value:    () or (S,) what was computed
    margin:   limit - value, positive where the condition holds
    theorem:  what follows from the condition, and its source
    verdict:  'holds', 'fails' or 'not claimed'; of several plants an (S,) array of these
    """

    value: float | np.ndarray
    margin: float | np.ndarray
    premises: tuple[Premise, ...]
    theorem: str
    verdict: str | np.ndarray
    __repr__ = in_short

    @property
    def holds(self) -> bool:
        """Whether the condition is claimed to hold, for every plant."""
        return bool(np.all(np.asarray(self.verdict) == HOLDS))

    @property
    def broken(self) -> tuple[Premise, ...]:
        """The premises that are broken for some plant."""
        return tuple(p for p in self.premises if not np.all(p.held))


def premise(name: str, holds, detail: str = "", *, plants: bool = False) -> Premise:
    """A premise from what was looked at.

    holds:  booleans of any shape, such as (J, N) of trials and samples
    plants: whether the first axis counts plants
    """
    holds = np.asarray(holds, dtype=bool)
    within = tuple(range(1 if plants else 0, holds.ndim))
    return Premise(
        name, _plain(np.all(holds, axis=within)), _plain(np.mean(~holds, axis=within)), detail
    )


def condition(
    value, theorem: str, *, limit: float = 1.0, premises: Iterable[Premise] = ()
) -> Condition:
    """The condition `value < limit` with its verdict.

        a premise is broken, or the value is not a number   ->  'not claimed'
        value < limit                                       ->  'holds'
        otherwise                                           ->  'fails'

    value:    () or (S,); computed with JAX, whose precision counts if `value` has a better one
    premises: their `held` is () or (S,)

    A value that lies below the limit by no more than rounding does not hold: a singular value that
    is 1 in theory, as of a law that leaves a sample alone, may be computed as 1 - 1e-15.
    """
    value, premises = np.asarray(value), tuple(premises)
    of_type = value.dtype if value.dtype.kind == "f" else float
    unit = max(float(np.finfo(of_type).eps), _last_place())
    rounding, value = ROUNDING * unit * abs(limit), value.astype(float)
    claimed = ~np.isnan(value)
    for p in premises:
        claimed = claimed & p.held
    verdict = np.where(claimed, np.where(value < limit - rounding, HOLDS, FAILS), NOT_CLAIMED)
    return Condition(_plain(value), _plain(limit - value), premises, theorem, _plain(verdict))


def share_alike(share: float) -> float:
    """A share of double precision that rounding explains, or that of the precision of JAX."""
    return max(share, ALIKE * _last_place())


def _last_place() -> float:
    return float(jnp.finfo(jnp.result_type(float)).eps)


def _plain(array):
    """A Python value for an array without dimensions."""
    array = np.asarray(array)
    return array.item() if array.ndim == 0 else array
