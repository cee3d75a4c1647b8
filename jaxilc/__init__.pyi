from . import figures, filters, plants, pytree, scenarios, schemes, theory, uncertainty
from .figures import report
from .filters import inversion
from .filters.switching import SwitchableFilter, instantaneous_frequency, segments
from .hardware.campaign import Campaign
from .identification.estimation import identify
from .identification.record_files import read_record, write_record
from .identification.records import Record, excite
from .learning.known_metrics import Metrics
from .learning.machine import Actuator, Disturbance, Machine, Sensor
from .learning.metrics import Keep, measure, repeatability
from .learning.over_trials import History, feedforward, learn, measured_trial, next_memory
from .learning.variation import PlantChange, References, Variation
from .learning.within_trial import run_trial
from .outcomes.repeating import potential
from .runtime.start import setup
from .runtime.tiles import tiled
from .scenarios.from_file import load_scenario
from .scenarios.reproduction import reproduce
from .signals import paths, references
from .signals.contour import contour_error
from .signals.task import Sample, Task, Trial
from .sweeps.runs import run_schemes
from .sweeps.store import open_dataset
from .sweeps.summary import summarise
from .sweeps.sweep import Sweep
from .tuning import objectives, risks
from .tuning.problem import Tuning
from .tuning.trade_off import pareto
from .tuning.weights import Tuned
from .tuning.worst_case import monte_carlo_search, worst_case_search
from .uncertainty import LogUniform, Normal, Population, Uniform

__all__ = [
    "Actuator",
    "Campaign",
    "Disturbance",
    "History",
    "Keep",
    "LogUniform",
    "Machine",
    "Metrics",
    "Normal",
    "PlantChange",
    "Population",
    "Record",
    "References",
    "Sample",
    "Sensor",
    "Sweep",
    "SwitchableFilter",
    "Task",
    "Trial",
    "Tuned",
    "Tuning",
    "Uniform",
    "Variation",
    "contour_error",
    "excite",
    "feedforward",
    "figures",
    "filters",
    "identify",
    "instantaneous_frequency",
    "inversion",
    "learn",
    "load_scenario",
    "measure",
    "measured_trial",
    "monte_carlo_search",
    "next_memory",
    "objectives",
    "open_dataset",
    "pareto",
    "paths",
    "plants",
    "potential",
    "pytree",
    "read_record",
    "references",
    "repeatability",
    "report",
    "reproduce",
    "risks",
    "run_schemes",
    "run_trial",
    "scenarios",
    "schemes",
    "segments",
    "setup",
    "summarise",
    "theory",
    "tiled",
    "uncertainty",
    "worst_case_search",
    "write_record",
]
