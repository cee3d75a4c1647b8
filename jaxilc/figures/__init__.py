"""Figures as engineers read them. Each function takes a dataset, or what its name says, and returns
the axes it drew on.

    by_trial      errors against the trial: one machine, many machines, theory against simulation
    within_trial  signals against time with a zoom, and the contour of two axes
    by_frequency  spectrum and time-frequency map of the error, |Q (keep - L P)|
    searches      tunings, trade-offs, worst machines
    experiments   identification: the record, and the model against it

Schemes keep colour, line style and mark through all figures of a dataset, trials are shades of
grey, so that both can be told apart in print. Figures are made without pyplot's global state.
"""

from . import report
from .by_frequency import frequency_tests, spectrum, time_frequency
from .by_trial import certificate, error_band, error_by_trial
from .experiments import record_figure, validation_figure
from .searches import final_error_by_trials, loss_by_step, pareto_front, worst_against_chance
from .style import COLOURS, DASHES, MARKS, save
from .within_trial import contour, tracking

__all__ = [
    "COLOURS",
    "DASHES",
    "MARKS",
    "certificate",
    "contour",
    "error_band",
    "error_by_trial",
    "final_error_by_trials",
    "frequency_tests",
    "loss_by_step",
    "pareto_front",
    "record_figure",
    "report",
    "save",
    "spectrum",
    "time_frequency",
    "tracking",
    "validation_figure",
    "worst_against_chance",
]
