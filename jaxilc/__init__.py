"""A differentiable batch simulator for iterative learning control of machine-tool feed drives.

A plant steps. A scheme acts within a trial and learns between trials. `learn` repeats trials. Everything is a pytree of float
arrays, so `vmap` runs thousands of plants at once and `grad` goes through the whole learning process.

    import jaxilc
    jaxilc.setup()                                     # float64, all cores
    s = jaxilc.scenarios.load("cao-2019")
    history = jaxilc.learn(s.machine, s.schemes["ffdl-mfailc"], s.task, trials=60)
    history.settled_error                              # (60, 1), in mm

The names below are imported on first use, so that `jaxilc --help` need not wait for JAX.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from . import figures, filters, inversion, objectives, paths, plants, pytree, references, risks, scenarios, schemes, theory
    from .batch import tiled
    from .campaign import Campaign
    from .contour import contour_error
    from .identification import identify
    from .learning import History, feedforward, learn, measured_trial, next_memory
    from .machine import Actuator, Disturbance, Machine, Sensor
    from .metrics import Keep, Metrics, measure, repeatability
    from .plant_files import load_scenario
    from .records import Record, excite, read_record, write_record
    from .reproduction import reproduce
    from .runs import run_schemes
    from .runtime import setup
    from .signals import Sample, Task, Trial
    from .store import open_dataset
    from .summary import summarise
    from .sweep import Sweep
    from .switching import SwitchableFilter, instantaneous_frequency, segments
    from .trade_off import pareto
    from .trial import run_trial
    from .tuning import Tuned, Tuning
    from .uncertainty import LogUniform, Normal, Uniform
    from .worst_case import monte_carlo_search, worst_case_search

_MODULES = (
    *("figures", "filters", "inversion", "objectives", "paths", "plants", "pytree", "references", "risks", "scenarios", "schemes"),
    "theory",
)
_NAMES = {
    "batch": ("tiled",),
    "campaign": ("Campaign",),
    "contour": ("contour_error",),
    "identification": ("identify",),
    "learning": ("History", "feedforward", "learn", "measured_trial", "next_memory"),
    "machine": ("Actuator", "Disturbance", "Machine", "Sensor"),
    "metrics": ("Keep", "Metrics", "measure", "repeatability"),
    "plant_files": ("load_scenario",),
    "records": ("Record", "excite", "read_record", "write_record"),
    "reproduction": ("reproduce",),
    "store": ("open_dataset",),
    "runs": ("run_schemes",),
    "runtime": ("setup",),
    "signals": ("Sample", "Task", "Trial"),
    "summary": ("summarise",),
    "sweep": ("Sweep",),
    "switching": ("SwitchableFilter", "instantaneous_frequency", "segments"),
    "trade_off": ("pareto",),
    "trial": ("run_trial",),
    "tuning": ("Tuned", "Tuning"),
    "uncertainty": ("LogUniform", "Normal", "Uniform"),
    "worst_case": ("monte_carlo_search", "worst_case_search"),
}
_HOME = {name: module for module, names in _NAMES.items() for name in names}

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
    "Record",
    "Sample",
    "Sensor",
    "Sweep",
    "SwitchableFilter",
    "Task",
    "Trial",
    "Tuned",
    "Tuning",
    "Uniform",
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
    "pytree",
    "read_record",
    "references",
    "repeatability",
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
    "worst_case_search",
    "write_record",
]


def __getattr__(name: str):
    if name in _MODULES:
        return importlib.import_module(f"{__name__}.{name}")
    if name in _HOME:
        return getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__():
    return __all__
