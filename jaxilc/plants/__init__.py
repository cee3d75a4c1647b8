"""Plants: each is its parameters, with a pure `init`, `step` and `output`."""

from .linear import DifferenceEquation, StateSpace, from_control
from .plant import Plant
from .voice_coil import VoiceCoil, voice_coil

__all__ = ["DifferenceEquation", "Plant", "StateSpace", "VoiceCoil", "from_control", "voice_coil"]
