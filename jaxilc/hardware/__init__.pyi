from .campaign import Campaign, Turn
from .checks import Finding, Rules
from .input_files import write_schedules
from .journal import Journal
from .trial_files import Measured, read_measured

__all__ = [
    "Campaign",
    "Finding",
    "Journal",
    "Measured",
    "Rules",
    "Turn",
    "read_measured",
    "write_schedules",
]
