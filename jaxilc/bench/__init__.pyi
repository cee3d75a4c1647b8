from . import timing
from .contests import (
    ALONE,
    SCHEMES,
    alone,
    compare,
    compare_long,
    compare_plant,
    cost_by_size,
    opponents,
    setting,
)

__all__ = [
    "ALONE",
    "SCHEMES",
    "alone",
    "compare",
    "compare_long",
    "compare_plant",
    "cost_by_size",
    "opponents",
    "setting",
    "timing",
]
