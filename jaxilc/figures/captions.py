"""Captions of the figures that commands write, as sentences, from the names of their files."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

CAPTIONS = (
    (r"error-by-trial", "The errors by trial, a curve for each scheme; circles are published."),
    (r"error-band", "Each panel is a scheme: median, 5 to 95 % and worst machine by trial. Beside "
     "them stands which share of the machines ends within a tolerance."),
    (r"grid", "The error of the last trial that 95 % of the machines do not exceed, at each point "
     "of the grid; the star is the best one, and a line encloses where a machine diverges."),
    (r"grid-best-trial", "The trial of the least error at each point, in the median."),
    (r"grid-yield", "The share of machines within the tolerance at each point."),
    (r"contraction", "The change of the error in a trial at each point of the grid, in the median; "
     "on the lines a bound is 1, and in the hatched regions a premise of d2 fails."),
    (r"tracking-(.+)", "{0}: output, error and input within chosen trials; the right column shows "
     "the shaded part."),
    (r"spectrum-(.+)", "{0}: the amplitude of the error at each frequency, for chosen trials."),
    (r"time-frequency-(.+)", "{0}: when within the trial which frequencies of the error are large; "
     "all maps have the same colours."),
    (r"contour-(.+)", "{0}: the path with the motion, whose distance from it is drawn larger, and "
     "the contour error along the path."),
    (r"worst-case", "The share of drawn machines that err no more than so much, and the errors of "
     "the machines that were searched for."),
    (r"loss", "The loss at each step of the tuning, on the machines tuned on and on others."),
    (r"learning", "The errors by trial over machines that no step has seen, for each law."),
    (r"design", "The errors by trial of the laws over machines that no step has seen."),
    (r"front", "The trade-off: each point is a tuning, with the share of the first objective."),
    (r"trials", "The last error with the weights as given, and with those tuned for so many "
     "trials."),
    (r"record", "The recorded experiment: what was put in, and what was measured."),
    (r"validation", "The measured and the simulated output, and their difference."),
    (r"response", "The frequency response of the plant that was found, with its 95 % band."),
    (r"filter", "Whether the Q-filter is safe: |Q (1 - L P)| must stay below 1."),
    (r"law", "The learned law in time and in frequency, beside the inverse of the plant."),
)  # fmt: skip


def caption_of(drawing: Any) -> str:
    """The caption of a drawing: of a file by its name, of axes their title."""
    if not isinstance(drawing, str | Path):
        return np.ravel(drawing)[0].get_title()
    name = Path(drawing).stem
    for pattern, sentence in CAPTIONS:
        found = re.fullmatch(pattern, name)
        if found:
            return sentence.format(*found.groups())
    return name.replace("-", " ")
