"""A frequency response that was measured on a machine, line by line, with its scatter."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class MeasuredResponse(NamedTuple):
    """The response of one output to one input, measured at some frequencies.

    frequencies: (F,) ascending, above 0 [Hz]
    response:    (F,) complex P(j w) [unit of the output per unit of the input]
    std:         (F,) sqrt(E |measured - true|^2) of each line [the same unit]; 0 where not known
    """

    frequencies: np.ndarray
    response: np.ndarray
    std: np.ndarray
