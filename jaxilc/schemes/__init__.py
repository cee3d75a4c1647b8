"""Control schemes: feedback, learning, and compositions of them."""

from .at_samples import AtSamples, with_jerk
from .bases import (
    Basis,
    GivenBasis,
    JoinedBasis,
    PolynomialBasis,
    PositionBasis,
    RationalBasis,
    SelectedBasis,
    Selection,
    select_basis,
)
from .basis_functions import BasisFunctions, OnBasis, WarmStart, fitted, started
from .compose import ErrorFiltered, Filtered, MultivariableILC, OnOutputs, OnReference, WithFeedback
from .constrained_norm_optimal import ConstrainedNormOptimal
from .estimated_disturbance import EstimatedDisturbance
from .gradient import GradientILC, ModelFreeGradient
from .guards import KeepUnmeasured, Ladder, StopWhen
from .learning_filter import LearningFilter, learning_filter
from .mfac import CFDLMFAC, CFDLMFAILC, CFDLMFAPC, FFDLMFAC, FFDLMFAILC, PFDLMFAC, PFDLMFAILC
from .norm_optimal import NormOptimal
from .pid import PID
from .pid_type import ExponentialPD, HigherOrder, PIDType
from .repetitive import PeriodTracking, RepetitiveBasis, RepetitiveControl, harmonic_taps
from .scheme import Feedforward, Scheme
from .sliding_mode import ASMC, SMC
from .two_step import TwoStep
from .weights import CrossCoupled

__all__ = [
    "ASMC",
    "CFDLMFAC",
    "CFDLMFAILC",
    "CFDLMFAPC",
    "FFDLMFAC",
    "FFDLMFAILC",
    "PFDLMFAC",
    "PFDLMFAILC",
    "PID",
    "SMC",
    "AtSamples",
    "Basis",
    "BasisFunctions",
    "ConstrainedNormOptimal",
    "CrossCoupled",
    "ErrorFiltered",
    "EstimatedDisturbance",
    "ExponentialPD",
    "Feedforward",
    "Filtered",
    "GivenBasis",
    "GradientILC",
    "HigherOrder",
    "JoinedBasis",
    "KeepUnmeasured",
    "Ladder",
    "LearningFilter",
    "ModelFreeGradient",
    "MultivariableILC",
    "NormOptimal",
    "OnBasis",
    "OnOutputs",
    "OnReference",
    "PIDType",
    "PeriodTracking",
    "PolynomialBasis",
    "PositionBasis",
    "RationalBasis",
    "RepetitiveBasis",
    "RepetitiveControl",
    "Scheme",
    "SelectedBasis",
    "Selection",
    "StopWhen",
    "TwoStep",
    "WarmStart",
    "WithFeedback",
    "fitted",
    "harmonic_taps",
    "learning_filter",
    "select_basis",
    "started",
    "with_jerk",
]
