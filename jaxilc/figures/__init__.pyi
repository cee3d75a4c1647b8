from . import report
from .by_frequency import (
    frequency_tests,
    learned_law_figure,
    q_filter_figure,
    spectrum,
    time_frequency,
)
from .by_trial import certificate, error_band, error_by_trial, given_and_tuned
from .experiments import (
    campaign_figure,
    potential_figure,
    record_figure,
    response_figure,
    response_fit_figure,
    validation_figure,
)
from .grid_map import contraction_map, contraction_of, grid_map
from .paper import choose, save
from .published import printed_and_ours, reproduction_figures
from .searches import final_error_by_trials, loss_by_step, pareto_front, worst_against_chance
from .style import COLOURS, DASHES, MARKS
from .within_trial import contour, tracking

__all__ = [
    "COLOURS",
    "DASHES",
    "MARKS",
    "campaign_figure",
    "certificate",
    "choose",
    "contour",
    "contraction_map",
    "contraction_of",
    "error_band",
    "error_by_trial",
    "final_error_by_trials",
    "frequency_tests",
    "given_and_tuned",
    "grid_map",
    "learned_law_figure",
    "loss_by_step",
    "pareto_front",
    "potential_figure",
    "printed_and_ours",
    "q_filter_figure",
    "record_figure",
    "report",
    "reproduction_figures",
    "response_figure",
    "response_fit_figure",
    "save",
    "spectrum",
    "time_frequency",
    "tracking",
    "validation_figure",
    "worst_against_chance",
]
