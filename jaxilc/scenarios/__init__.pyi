from . import cao_2019, cao_2019_rig, dai_2014, double_mass, li_2020, milc_2024, pendulum, xu_2024
from .catalogue import LISTED, Listed
from .from_file import SCENARIOS, load, load_scenario, options
from .published import Fit, Published
from .reproduction import reproduce
from .scenario import Quantity, Scenario

__all__ = [
    "LISTED",
    "SCENARIOS",
    "Fit",
    "Listed",
    "Published",
    "Quantity",
    "Scenario",
    "cao_2019",
    "cao_2019_rig",
    "dai_2014",
    "double_mass",
    "li_2020",
    "load",
    "load_scenario",
    "milc_2024",
    "options",
    "pendulum",
    "reproduce",
    "xu_2024",
]
