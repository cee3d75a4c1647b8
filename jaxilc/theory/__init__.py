"""What theory says of a machine, a scheme and a task: conditions of convergence and their premises.

Each condition is a `Condition`: value, margin, premises, theorem and verdict. The modules, from the
ground up:

    linearity        whether machine, feedback and learning law are linear, each by name, read off
                     their programs (`structure`)
    trials, loop, law  a trial without noise; machine and feedback as one linear system from sample
                     to sample; the learning law far from the ends of a trial
    to_python_control  that loop as a system of python-control
    spectrum         singular values, eigenvalues and growth of matrices and of maps
    learning_map     one trial and its learning as a map of what is played, of many machines: as
                     matrices, and without a matrix
    outlook          all trials to come of a linear law: its limit, how fast it comes there, and
                     which limits of the machine it meets
    lifted           G, L and Q of a whole trial as matrices of the simulator and the scheme
    contraction      gain and growth of the map of all that any scheme knows
    enclosure        what a response is on arcs of frequency, and its largest value from above
    frequency        |Q (keep - L P)| < 1 of one machine, of every plant within a bound, of the
                     plants of a set that are tried, and what is proved of all
    on_lines         a law on the lines of a response, modelled or measured, and how far it may go
    q_filter         whether a Q-filter is safe, for a family of machines or on records
    chance           what holds for single runs where something is drawn for each trial, by the
                     moments of what reaches the law
    repetitive       within one long trial: repetitive control and what it does between harmonics,
                     and basis functions, by the map of a period
    visits           which parameters of a basis a trial tells, as of the places it visits
    rounding         how far from its limit a machine that rounds is held
    certificates     claims and predictions of many machines against simulation; the conditions that
                     papers print for a scheme; learning where each trial starts from the end of the
                     one before
    bounds           d1 and d2 of Cao 2019 from the plant, and contraction as observed
    sliding          the conditions of Xu 2024
"""

from ..plants import structure
from . import condition, contraction, frequency, lifted, outlook
from .bounds import (
    Bounds,
    BoundsWatch,
    Checked,
    PremiseShare,
    PseudoGradient,
    bounds_of,
    checked,
    checked_machines,
    frozen_growth,
    ppd_bound,
    pseudo_gradient_of,
)
from .certificates import (
    CLAIMS,
    COURSES,
    CarriedRadius,
    Certificate,
    carried_radius,
    certify,
    certify_each,
)
from .condition import Condition, Premise
from .repetitive import PeriodTest, RepetitiveTest, basis_condition, repetitive_condition
from .to_python_control import to_control
from .visits import Visits, visits

__all__ = [
    "CLAIMS",
    "COURSES",
    "Bounds",
    "BoundsWatch",
    "CarriedRadius",
    "Certificate",
    "Checked",
    "Condition",
    "PeriodTest",
    "Premise",
    "PremiseShare",
    "PseudoGradient",
    "RepetitiveTest",
    "Visits",
    "basis_condition",
    "bounds_of",
    "carried_radius",
    "certify",
    "certify_each",
    "checked",
    "checked_machines",
    "condition",
    "contraction",
    "frequency",
    "frozen_growth",
    "lifted",
    "outlook",
    "ppd_bound",
    "pseudo_gradient_of",
    "repetitive_condition",
    "structure",
    "to_control",
    "visits",
]
