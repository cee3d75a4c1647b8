"""What theory says of a machine, a scheme and a task: conditions of convergence and their premises.

Each condition is a `Condition`: value, margin, premises, theorem and verdict. The modules, from the
ground up:

    structure        which outputs of a program are affine in its inputs, read off the program
    linearity        whether machine, feedback and learning law are linear, each by name
    loop             machine and feedback as one linear system from sample to sample
    to_python_control  that loop as a system of python-control
    law              the learning law far from the ends of a trial
    law_and_loop     both, with the premises that conditions on them share
    enclosure        the largest value of a frequency response, enclosed from above
    over_frequency   a curve over frequency, its largest value and where it reaches 1
    frequency        |Q (keep - L P)| < 1 of one machine (`by_frequency`), of every plant within a
                     bound (`robust`) and of a set of plants (`family`)
    q_filter         whether a Q-filter is safe for a family (`measured_law`: on measured lines),
                     how far one may go (`offers`, `filtered_law`, `parts_of_law`), and what is
                     proved of the whole set (`whole_set`, `process_boxes`, `discs`)
    lifted           G, L and Q of a whole trial as matrices of the simulator and the scheme
    spectrum         singular values, spectral radius and transient growth of given matrices
    affine           one trial and its learning as a map of what is played
    as_matrix, as_map  these maps of many machines, as matrices and without a matrix
    outlook          all trials to come of a linear law: its limit, how fast it comes there, and
                     which limits of the machine it meets
    chance           what holds for single runs where something is drawn for each trial, by the
                     moments of what reaches the law (`record_moments`)
    rounding         how far from its limit a machine that rounds is held
    maps             one trial and its learning as a map of all that any scheme knows
    contraction      the gain of these maps, without a matrix
    iteration        singular values and eigenvalues by the methods of Lanczos and Arnoldi
    forecast         the error of each trial, as predicted and as simulated
    certificates     many machines at once, against simulation
    carried          learning where each trial starts from the end of the one before
    bounds           d1 and d2 of Cao 2019 from the plant, and contraction as observed
                     (`bounds_of_machines`: over many machines)
    sliding          the conditions of Xu 2024 (`sliding_run`: along a run)
"""

from . import condition, contraction, frequency, lifted, outlook, structure
from .bounds import (
    Bounds,
    BoundsWatch,
    PseudoGradient,
    bounds_of,
    frozen_growth,
    ppd_bound,
    pseudo_gradient_of,
)
from .bounds_of_machines import Checked, PremiseShare, checked, checked_machines
from .carried import CarriedRadius, carried_radius
from .certificates import CLAIMS, COURSES, Certificate, certify, certify_each
from .condition import Condition, Premise
from .to_python_control import to_control

__all__ = [
    "CLAIMS",
    "COURSES",
    "Bounds",
    "BoundsWatch",
    "CarriedRadius",
    "Certificate",
    "Checked",
    "Condition",
    "Premise",
    "PremiseShare",
    "PseudoGradient",
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
    "structure",
    "to_control",
]
