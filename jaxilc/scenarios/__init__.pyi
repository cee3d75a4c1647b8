from .catalogue import LISTED, Listed
from .from_file import load_scenario
from .loading import SCENARIOS, load, options
from .reproduction import reproduce
from .scenario import Fit, Published, Quantity, Scenario

__all__ = [
    "LISTED",
    "SCENARIOS",
    "Fit",
    "Listed",
    "Published",
    "Quantity",
    "Scenario",
    "load",
    "load_scenario",
    "options",
    "reproduce",
]
