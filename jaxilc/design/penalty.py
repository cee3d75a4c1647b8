"""The monotone condition over a family as a penalty of a tuning."""

from __future__ import annotations

from ..tuning.objectives import Objective
from ..tuning.over_family import OverFamily
from .responses import Family

UNSAFE = 20.0  # weight of the logarithm of |keep - L P| beyond what is allowed
SHARPNESS = 4000.0  # with 400, it would ask for 2.5 % less than a law that just keeps the bound


def penalty(family: Family, below: float) -> Objective:
    """What a law costs whose |keep - L P| is above a bound on a machine of the family."""
    return UNSAFE * OverFamily(family.frequencies, family.P, below, SHARPNESS)
