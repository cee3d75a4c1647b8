"""What theory says of a machine, a scheme and a task: conditions of convergence with their
premises.

    structure    what is linear in a program, read off the program;  linearity: of machine, feedback
    and learning law by name
    loop, law    the loop and the learning law far from the ends of a trial;  enclosure: largest
    values over frequency, enclosed
    frequency    |Q (keep - L P)| < 1: of one machine (by_frequency), for every plant within a bound
    (robust), for a set (family)
    lifted       G, L and Q as matrices of the simulator and the scheme; singular values, spectral
    radius, transient growth
    outlook      all trials to come of a linear law: its limit, how fast, which limits of the
    machine it meets contraction  the gain of the learning step of any scheme, without a matrix;
    iteration: by Lanczos and Arnoldi certificates many machines at once, against simulation;
    bounds: d1 and d2 of Cao 2019;  sliding: Xu 2024

Each condition is a `Condition`: value, margin, premises, theorem, verdict.
"""

from . import condition, contraction, frequency, lifted, outlook, structure
from .bounds import CFDLBounds, FFDLBounds, cfdl_bounds, ffdl_bounds
from .bounds_of_machines import PremiseShare, premises
from .certificates import CLAIMS, COURSES, Certificate, certify
from .condition import Condition, Premise
from .to_python_control import to_control

__all__ = [
    "CLAIMS",
    "COURSES",
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
    "outlook",
    "premises",
    "structure",
    "to_control",
]
