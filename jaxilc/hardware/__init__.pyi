from .campaign import Campaign
from .checks import Finding, Rules
from .input_files import write_schedules
from .journal import Journal
from .trial_files import Measured, read_measured
from .turn import Turn

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
