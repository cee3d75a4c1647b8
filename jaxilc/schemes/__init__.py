"""Control schemes: feedback, learning, and compositions of them."""

from .compose import Filtered, OnOutputs, OnReference, WithFeedback
from .mfac import CFDLMFAC, CFDLMFAPC, FFDLMFAC, PFDLMFAC
from .mfailc import CFDLMFAILC, FFDLMFAILC, PFDLMFAILC
from .pid import PID
from .pid_type import PIDType
from .scheme import Scheme

__all__ = [
    "CFDLMFAC",
    "CFDLMFAILC",
    "CFDLMFAPC",
    "FFDLMFAC",
    "FFDLMFAILC",
    "PFDLMFAC",
    "PFDLMFAILC",
    "PID",
    "Filtered",
    "OnOutputs",
    "OnReference",
    "PIDType",
    "Scheme",
    "WithFeedback",
]
