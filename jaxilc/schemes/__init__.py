"""Control schemes: feedback, learning, and compositions of them."""

from .at_samples import AtSamples, with_jerk
from .bases import Basis, GivenBasis, PolynomialBasis, SelectedBasis
from .basis_functions import BasisFunctions, fitted
from .compose import ErrorFiltered, Filtered, OnOutputs, WithFeedback
from .constrained_norm_optimal import ConstrainedNormOptimal
from .cross_coupled import CrossCoupled
from .estimated_disturbance import EstimatedDisturbance
from .exponential import ExponentialPD
from .gradient import GradientILC
from .guards import Ladder, StopWhen
from .higher_order import HigherOrder
from .keep_unmeasured import KeepUnmeasured
from .learning_filter import LearningFilter, learning_filter
from .mfac import CFDLMFAC, CFDLMFAPC, FFDLMFAC, PFDLMFAC
from .mfailc import CFDLMFAILC, FFDLMFAILC, PFDLMFAILC
from .model_free_gradient import ModelFreeGradient
from .multivariable import MultivariableILC
from .norm_optimal import NormOptimal
from .on_basis import OnBasis
from .on_reference import OnReference
from .pid import PID
from .pid_type import PIDType
from .rational_basis import RationalBasis
from .scheme import Feedforward, Scheme
from .sliding_mode import ASMC, SMC
from .sparse_basis import Selection, select_basis
from .two_step import TwoStep
from .warm_start import WarmStart, started

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
    "PolynomialBasis",
    "RationalBasis",
    "Scheme",
    "SelectedBasis",
    "Selection",
    "StopWhen",
    "TwoStep",
    "WarmStart",
    "WithFeedback",
    "fitted",
    "learning_filter",
    "select_basis",
    "started",
    "with_jerk",
]
