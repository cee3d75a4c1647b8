from . import timing
from .contests import compare, compare_long, compare_plant, cost_by_size, opponents
from .gradients import compare_gradients, gradient_opponents
from .ours_alone import ALONE, alone, of_scenario
from .settings import SCHEMES, setting

__all__ = [
    "ALONE",
    "SCHEMES",
    "alone",
    "compare",
    "compare_gradients",
    "compare_long",
    "compare_plant",
    "cost_by_size",
    "gradient_opponents",
    "of_scenario",
    "opponents",
    "setting",
    "timing",
]
