from .campaign import Campaign, Turn
from .checks import Finding, Rules
from .journal import Journal
from .trial_files import Measured, read_measured, write_schedules

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
