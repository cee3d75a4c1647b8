from .campaign import Campaign, Turn
from .checks import Finding, Rules
from .controller_files import MapTable, read_map, write_map, write_schedules
from .journal import Journal
from .trial_files import Measured, read_measured

__all__ = [
    "Campaign",
    "Finding",
    "Journal",
    "MapTable",
    "Measured",
    "Rules",
    "Turn",
    "read_map",
    "read_measured",
    "write_map",
    "write_schedules",
]
