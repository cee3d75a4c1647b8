"""Everything on the frequency response, by the name it is known under. Frequencies are in Hz.

learning_condition       |Q (keep - L P)| < 1 of one machine
norm_optimal_condition   of norm-optimal learning with a model
robust_condition         of every plant within a bound
family_condition         over a parametric set of plants
linear_loop, response    P(z) of machine and feedback
law_response, filter_response  of the learning law, and of a filter
"""

from .by_frequency import learning_condition, norm_optimal_condition
from .family import FamilyTest, family_condition
from .law import filter_response, law_response
from .loop import Loop, linear_loop, pole_radius, response
from .over_frequency import FrequencyTest, grid
from .robust import robust_condition

__all__ = [
    "FamilyTest",
    "FrequencyTest",
    "Loop",
    "family_condition",
    "filter_response",
    "grid",
    "law_response",
    "learning_condition",
    "linear_loop",
    "norm_optimal_condition",
    "pole_radius",
    "response",
    "robust_condition",
]
