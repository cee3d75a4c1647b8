"""Plants: each is its parameters, with a pure `init`, `step` and `output`."""

from .friction import StribeckFriction
from .linear import DifferenceEquation, StateSpace, from_control
from .motor import Cogging, EndEffect, VoiceCoilMotor, voice_coil_motor
from .plant import Plant
from .process_model import ProcessModel
from .voice_coil import VoiceCoil, voice_coil

__all__ = [
    "Cogging",
    "DifferenceEquation",
    "EndEffect",
    "Plant",
    "ProcessModel",
    "StateSpace",
    "StribeckFriction",
    "VoiceCoil",
    "VoiceCoilMotor",
    "from_control",
    "voice_coil",
    "voice_coil_motor",
]
