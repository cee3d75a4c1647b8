"""Control schemes: feedback, learning, and compositions of them."""

from .compose import ErrorFiltered, Filtered, OnOutputs, WithFeedback
from .constrained_norm_optimal import ConstrainedNormOptimal
from .cross_coupled import CrossCoupled
from .estimated_disturbance import EstimatedDisturbance
from .exponential import ExponentialPD
from .gradient import GradientILC
from .guards import Ladder, StopWhen
from .higher_order import HigherOrder
from .learning_filter import LearningFilter, learning_filter
from .mfac import CFDLMFAC, CFDLMFAPC, FFDLMFAC, PFDLMFAC
from .mfailc import CFDLMFAILC, FFDLMFAILC, PFDLMFAILC
from .model_free_gradient import ModelFreeGradient
from .multivariable import MultivariableILC
from .norm_optimal import NormOptimal
from .on_reference import OnReference
from .pid import PID
from .pid_type import PIDType
from .scheme import Feedforward, Scheme
from .sliding_mode import ASMC, SMC
from .two_step import TwoStep

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
    "ConstrainedNormOptimal",
    "CrossCoupled",
    "ErrorFiltered",
    "EstimatedDisturbance",
    "ExponentialPD",
    "Feedforward",
    "Filtered",
    "GradientILC",
    "HigherOrder",
    "Ladder",
    "LearningFilter",
    "ModelFreeGradient",
    "MultivariableILC",
    "NormOptimal",
    "OnOutputs",
    "OnReference",
    "PIDType",
    "Scheme",
    "StopWhen",
    "TwoStep",
    "WithFeedback",
    "learning_filter",
]
