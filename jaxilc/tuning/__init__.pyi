from . import objectives, risks
from .problem import Tuning
from .trade_off import pareto
from .weights import Tuned
from .worst_case import GRADIENT_COST, monte_carlo_search, worst_case_search

__all__ = [
    "GRADIENT_COST",
    "Tuned",
    "Tuning",
    "monte_carlo_search",
    "objectives",
    "pareto",
    "risks",
    "worst_case_search",
]
