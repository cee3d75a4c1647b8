"""Figures: each function draws a dataset or another result, and returns the axes.

    by_trial      errors against the trial: one machine, many machines, theory against simulation
    within_trial  signals against time with a zoom, and the contour of two axes
    by_frequency  spectrum and time-frequency map of the error, |Q (keep - L P)|
    learned       a learned law in time and frequency, beside the inverse of the plant
    q_filter      whether a Q-filter is safe, and by how much
    published     the numbers of a paper and ours
    searches      tunings, trade-offs, worst machines
    experiments   identification: the record, and the model against it
    campaign      a campaign on a real machine
    report        one HTML page with figures and tables

A scheme has the same colour, line style and mark in all figures of a dataset, and trials are shades
of grey, so that both can be distinguished in print. Figures do not use the global state of pyplot.
"""

from . import report
from .by_frequency import frequency_tests, spectrum, time_frequency
from .by_trial import certificate, error_band, error_by_trial
from .campaign import campaign_figure
from .experiments import record_figure, response_fit_figure, validation_figure
from .learned import learned_law_figure
from .published import printed_and_ours, reproduction_figures
from .q_filter import q_filter_figure
from .searches import final_error_by_trials, loss_by_step, pareto_front, worst_against_chance
from .style import COLOURS, DASHES, MARKS, save
from .within_trial import contour, tracking

__all__ = [
    "COLOURS",
    "DASHES",
    "MARKS",
    "campaign_figure",
    "certificate",
    "contour",
    "error_band",
    "error_by_trial",
    "final_error_by_trials",
    "frequency_tests",
    "learned_law_figure",
    "loss_by_step",
    "pareto_front",
    "printed_and_ours",
    "q_filter_figure",
    "record_figure",
    "report",
    "reproduction_figures",
    "response_fit_figure",
    "save",
    "spectrum",
    "time_frequency",
    "tracking",
    "validation_figure",
    "worst_against_chance",
]
