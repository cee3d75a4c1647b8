"""Where cutoff, gain and lead of a law stand in a scheme, and the scheme with other ones."""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import numpy as np

from ..filters import ZeroPhaseButterworth
from ..pytree.named_paths import child_of, get_at, replaced
from ..schemes import Filtered, LearningFilter, PIDType, Scheme
from .filtered_law import Change

GAINS = {PIDType: ("gamma_p", "gamma_i", "gamma_d"), LearningFilter: ("L",)}
DIGITS = 3  # of cutoffs and gains that are offered


class Places(NamedTuple):
    """The paths of the numbers that a change of the law sets; empty where there is no such number.

    cutoff: of the zero-phase Butterworth filter
    gains:  all the gains of the learning
    lead:   of the learning
    order:  of the filter
    """

    cutoff: str
    gains: tuple[str, ...]
    lead: str
    order: int

    def of(self, scheme: Scheme, change: Change) -> dict[str, Any]:
        """The values by path that make a change: only those that differ from the scheme's."""
        values: dict[str, Any] = {}
        if self.cutoff and np.isfinite(change.cutoff):
            values[self.cutoff] = change.cutoff
        for path in self.gains if change.gain != 1 else ():
            values[path] = np.asarray(get_at(scheme, path)) * change.gain
        if self.lead and change.lead:
            values[self.lead] = get_at(scheme, self.lead) + change.lead
        return {p: v for p, v in values.items() if not np.array_equal(v, get_at(scheme, p))}


def places_in(scheme: Scheme) -> Places:
    """Where cutoff, gain and lead of a scheme stand."""
    path, found = _first(scheme, _is_low_pass)
    of_law, law = _first(scheme, lambda one: isinstance(one, tuple(GAINS)))
    names = () if law is None else next(v for k, v in GAINS.items() if isinstance(law, k))
    gains = tuple(f"{of_law}{name}" for name in names if np.any(np.asarray(getattr(law, name))))
    return Places(
        "" if found is None else f"{path}filter.cutoff",
        gains,
        f"{of_law}lead" if law is not None else "",
        2 if found is None else found.filter.order,
    )


def without_low_pass(scheme: Scheme) -> Scheme:
    """The scheme without its zero-phase Butterworth filter on what is learned."""
    if _is_low_pass(scheme):
        return child_of(scheme, "scheme")
    for name, part in scheme._fields_that_are_schemes().items():
        changed = without_low_pass(part)
        if changed is not part:
            return dataclasses.replace(scheme, **{name: changed})
    return scheme


def with_change(scheme: Scheme, values: dict[str, Any]) -> Scheme:
    """The scheme with the values that `Places.of` gives."""
    return replaced(scheme, values)


def with_low_pass(scheme: Scheme, q: ZeroPhaseButterworth) -> Scheme | None:
    """The scheme with a filter around its learning part; None where it has no part known here."""
    if isinstance(scheme, tuple(GAINS)):
        return Filtered(scheme, q)
    for name, part in scheme._fields_that_are_schemes().items():
        made = with_low_pass(part, q)
        if made is not None:
            return dataclasses.replace(scheme, **{name: made})
    return None


def with_law(scheme: Scheme, law: Scheme) -> Scheme:
    """The scheme with another learning law in place of its own and the filter around that.

    Raises ValueError where the scheme has no part of a kind that is known here.
    """
    if _is_low_pass(scheme) or isinstance(scheme, tuple(GAINS)):
        return law
    for name, part in scheme._fields_that_are_schemes().items():
        if part.learns:
            return dataclasses.replace(scheme, **{name: with_law(part, law)})
    known = ", ".join(kind.__name__ for kind in GAINS)
    raise ValueError(
        f"{type(scheme).__name__} has no learning part that can be replaced; allowed is one of "
        f"{known}, or a Filtered around it"
    )


def rounded(value: float) -> float:
    """The value rounded towards 0 to three significant digits."""
    if not value or not np.isfinite(value):
        return value
    unit = 10.0 ** (np.floor(np.log10(abs(value))) - DIGITS + 1)
    return float(f"{np.trunc(value / unit * (1 + 1e-12)) * unit:.{DIGITS}g}")


def _is_low_pass(scheme) -> bool:
    return isinstance(scheme, Filtered) and isinstance(scheme.filter, ZeroPhaseButterworth)


def _first(scheme: Scheme, wanted, at: str = "") -> tuple[str, Any]:
    """The first part that is wanted, from the outside in, with the path before its fields."""
    if wanted(scheme):
        return at, scheme
    for name, part in scheme._fields_that_are_schemes().items():
        path, found = _first(part, wanted, f"{at}{name}.")
        if found is not None:
            return path, found
    return "", None
