from .certifying import certify
from .demonstrating import demo
from .designing import design
from .exporting import check_export, export
from .filtering import filter_, filter_measured
from .identifying import Reading, identify
from .learning_laws import learn_law
from .listing import scenarios, settings
from .outcome import Outcome
from .reidentifying import identify_campaign
from .repeating import potential
from .reproducing import reproduce
from .request import Request
from .running import run
from .searching import worst_case
from .sweeping import sweep
from .trading import pareto
from .tuning import tune
from .verdict import Verdict

__all__ = [
    "Outcome",
    "Reading",
    "Request",
    "Verdict",
    "certify",
    "check_export",
    "demo",
    "design",
    "export",
    "filter_",
    "filter_measured",
    "identify",
    "identify_campaign",
    "learn_law",
    "pareto",
    "potential",
    "reproduce",
    "run",
    "scenarios",
    "settings",
    "sweep",
    "tune",
    "worst_case",
]
