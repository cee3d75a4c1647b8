from .beginning import init, scenarios, settings
from .certifying import certify
from .demonstrating import demo
from .designing import design, learn_law
from .exporting import check_export, export
from .filtering import filter_, filter_measured
from .identifying import Reading, identify, identify_campaign
from .outcome import Outcome, Verdict
from .repeating import potential
from .reproducing import reproduce
from .request import Request
from .running import run
from .sweeping import sweep
from .tuning import pareto, tune, worst_case

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
    "init",
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
