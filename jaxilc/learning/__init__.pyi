from .known_metrics import Metrics
from .machine import Actuator, Disturbance, Machine, Sensor
from .metrics import (
    Keep,
    Repeatability,
    Watch,
    Watched,
    best_trial,
    chattering,
    measure,
    repeatability,
    root_mean_square,
    total_variation,
)
from .over_trials import History, check, feedforward, learn, measured_trial, next_memory, truncated
from .playback import replay
from .variation import PlantChange, References, Variation
from .within_trial import run_trial

__all__ = [
    "Actuator",
    "Disturbance",
    "History",
    "Keep",
    "Machine",
    "Metrics",
    "PlantChange",
    "References",
    "Repeatability",
    "Sensor",
    "Variation",
    "Watch",
    "Watched",
    "best_trial",
    "chattering",
    "check",
    "feedforward",
    "learn",
    "measure",
    "measured_trial",
    "next_memory",
    "repeatability",
    "replay",
    "root_mean_square",
    "run_trial",
    "total_variation",
    "truncated",
]
