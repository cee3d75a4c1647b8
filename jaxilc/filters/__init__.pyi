from . import inversion
from .inversion import (
    ZPETC,
    Inverse,
    StableInverse,
    factors,
    inverse,
    output_ratio,
    stable_inverse,
    zpetc,
)
from .switching import SwitchableFilter, cutoffs_below, instantaneous_frequency, segments
from .zero_phase import Filter, ZeroPhaseBandStop, ZeroPhaseButterworth, ZeroPhaseFIR, ZeroPhaseIIR

__all__ = [
    "ZPETC",
    "Filter",
    "Inverse",
    "StableInverse",
    "SwitchableFilter",
    "ZeroPhaseBandStop",
    "ZeroPhaseButterworth",
    "ZeroPhaseFIR",
    "ZeroPhaseIIR",
    "cutoffs_below",
    "factors",
    "instantaneous_frequency",
    "inverse",
    "inversion",
    "output_ratio",
    "segments",
    "stable_inverse",
    "zpetc",
]
