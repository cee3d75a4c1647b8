"""What theory says of a machine, a scheme and a task: conditions of convergence with their premises.

    lifted       G, L and Q as matrices of the simulator and the scheme; singular values, spectral radius, transient growth
    frequency    |Q (1 - L z P)| < 1 and its robust versions, over one plant or a parametric set of plants
    contraction  the gain of the learning step of any scheme, without a matrix

Each condition is a `Condition`: value, margin, premises, theorem, verdict.
"""

from . import condition, contraction, frequency, lifted
from .bounds import CFDLBounds, FFDLBounds, cfdl_bounds, ffdl_bounds
from .certificates import VERDICTS, Certificate, PremiseShare, certify, premises
from .condition import Condition, Premise

__all__ = [
    "VERDICTS",
    "CFDLBounds",
    "Certificate",
    "Condition",
    "FFDLBounds",
    "Premise",
    "PremiseShare",
    "certify",
    "cfdl_bounds",
    "condition",
    "contraction",
    "ffdl_bounds",
    "frequency",
    "lifted",
    "premises",
]
