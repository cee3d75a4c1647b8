"""Plants: each is its parameters, with a pure `initial_state`, `step` and `output`."""

from .along_motion import linearised, motion
from .ball_screw import BallScrewDrive, FrictionTable, LeadError
from .blocks import InBlocks
from .cnc_axis import ThreeAxes, TwoAxes, cnc_axis
from .fast_tool_servo import (
    Creep,
    CuttingForce,
    FastToolServo,
    FlexibleMode,
    PeriodicForce,
    fast_tool_servo,
)
from .friction import StribeckFriction
from .from_python_control import from_control
from .hysteresis import BoucWen, Dahl, InputHysteresis
from .linear import DifferenceEquation, StateSpace, TimeVaryingStateSpace
from .modal_model import ModalModel, modal_model
from .motor import Cogging, EndEffect, VoiceCoilMotor, voice_coil_motor
from .nominal_models import cascade, direct_model, multivariable_model
from .pendulum import Pendulum
from .plant import Plant
from .position import ByPosition, Harmonics, PositionMap, Splines
from .process_model import ProcessModel
from .to_python_control import to_control
from .voice_coil import VoiceCoil, voice_coil

__all__ = [
    "BallScrewDrive",
    "BoucWen",
    "ByPosition",
    "Cogging",
    "Creep",
    "CuttingForce",
    "Dahl",
    "DifferenceEquation",
    "EndEffect",
    "FastToolServo",
    "FlexibleMode",
    "FrictionTable",
    "Harmonics",
    "InBlocks",
    "InputHysteresis",
    "LeadError",
    "ModalModel",
    "Pendulum",
    "PeriodicForce",
    "Plant",
    "PositionMap",
    "ProcessModel",
    "Splines",
    "StateSpace",
    "StribeckFriction",
    "ThreeAxes",
    "TimeVaryingStateSpace",
    "TwoAxes",
    "VoiceCoil",
    "VoiceCoilMotor",
    "cascade",
    "cnc_axis",
    "direct_model",
    "fast_tool_servo",
    "from_control",
    "linearised",
    "modal_model",
    "motion",
    "multivariable_model",
    "to_control",
    "voice_coil",
    "voice_coil_motor",
]
