"""Li 2020: an axis of a CNC machine under iterative learning.

High-frequency noise makes learning diverge; the paper proposes three remedies.

Li, Wang, Chen, Ma: Iterative Learning Controller Design for CNC Machine Tools, Journal of Harbin
Institute of Technology (2020). Lengths in mm, input in the unit of the identified model, errors
shown in µm. The first trial runs under feedback only.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..filters.switching import segments
from ..filters.zero_phase import ZeroPhaseButterworth
from ..learning.machine import Actuator, Disturbance, Machine, Sensor
from ..learning.metrics import largest, root_mean_square
from ..learning.quantities import contour_metrics
from ..plants import TwoAxes, cnc_axis
from ..plants.cnc_axis import SAMPLE_TIME
from ..pytree.ranges import need_one_of
from ..schemes import (
    PID,
    ErrorFiltered,
    HigherOrder,
    Ladder,
    OnReference,
    PIDType,
    Scheme,
    StopWhen,
    WithFeedback,
)
from ..signals import paths
from ..signals.task import Task
from ..uncertainty import Uniform
from .published import printed
from .scenario import Quantity, Scenario

# With these gains the loop's spectral radius is 0.913.
PROPORTIONAL = 1.66  # [1/mm]
DERIVATIVE = 16.9 * SAMPLE_TIME  # [s/mm]
SPEED_FEEDFORWARD = 0.72  # share of the reference's speed in the derivative, fitted to 18 µm
CUTOFFS = (10.0, 50.0)  # [Hz], printed
FILTFILT = 9  # samples of odd extension, as `filtfilt` takes them for these filters
# Width of the butterfly [mm], fitted to 60 µm; feed, acceleration and jerk are proportional to it.
WIDTH = 13.8
# Samples before the motion, so that its sharp points lie at 2915, 4788, 5248, 5708 and 7581.
REST = 497


class Setting(NamedTuple):
    """The differences between the paper's runs; gain and noise are fitted (`printed/li-2020.toml`).

    gain: gain phi of the learning law
    noise: standard deviation of the encoder noise [mm]
    trials: number J of trials
    pulse: height of the repetitive disturbance [unit of u]
    """

    gain: float
    noise: float
    trials: int
    pulse: float


SETTINGS = {
    "simulation": Setting(gain=0.45, noise=2.5e-4, trials=40, pulse=0.0),
    "experiment": Setting(gain=1.0, noise=1.1e-3, trials=30, pulse=0.0),
    "disturbance": Setting(gain=0.06, noise=0.0, trials=100, pulse=0.3),
}


@lru_cache
def butterfly_path() -> np.ndarray:
    """(N+1, 2) the planned butterfly [mm], after a second of rest."""
    planned = paths.plan(
        paths.butterfly(WIDTH), (0.0, 1.0), feed=WIDTH / 4.793, acceleration=WIDTH / 0.09716,
        jerk=WIDTH / 0.0009716, dt=SAMPLE_TIME,
    )  # fmt: skip
    return np.concatenate([np.zeros((REST, 2)), planned.reference])


def position_loop(feedforward: float) -> PID:
    """The position controller.

    feedforward: share of the reference's speed in its derivative, from 0 to 1
    """
    return PID(kp=PROPORTIONAL, kd=DERIVATIVE, kv=(feedforward - 1.0) * DERIVATIVE)


def schemes_for(gain: float, reference: np.ndarray, tolerance: float = 2e-3) -> dict[str, Scheme]:
    """The paper's schemes by name.

    gain: gain phi of the learning law
    reference: (N+1,) or (N+1, n_y) reference [mm]
    tolerance: RMS error at which learning stops [mm]
    """
    feedback, law = position_loop(0.0), PIDType(gamma_p=gain)
    fixed = ZeroPhaseButterworth(CUTOFFS[0], padding=FILTFILT)
    switchable = segments(
        reference, SAMPLE_TIME, cutoffs=CUTOFFS, threshold=2.0, shortest=0.05, width=0.05,
        window=0.2, padding=FILTFILT,
    )  # fmt: skip
    return {
        "feedback": feedback,
        "feedforward": position_loop(SPEED_FEEDFORWARD),
        "p-type": WithFeedback(law, feedback),
        "higher-order": WithFeedback(HigherOrder(alpha=(0.6, 0.4), gamma=(gain, 0.0)), feedback),
        "fixed-filter": WithFeedback(ErrorFiltered(law, fixed), feedback),
        "switchable": WithFeedback(ErrorFiltered(law, switchable), feedback),
        "stop": StopWhen(WithFeedback(law, feedback), rms=tolerance, growth=0.02),
        "ladder": Ladder(WithFeedback(law, feedback), repeats=5),
        "series": OnReference(ErrorFiltered(PIDType(gamma_p=gain / PROPORTIONAL), fixed), feedback),
    }


def li_2020(
    setting: str = "simulation", plant: str = "double_integrator", axes: str = "x"
) -> Scenario:
    """The runs of Li 2020, sections 3 to 6, at 2 ms along a butterfly.

    setting: `simulation`, `disturbance` (a repetitive one at sample 625) or `experiment`
    plant: `double_integrator` or `printed` (eq. 3)
    axes: `x`, or `xy` with a second axis of 90 % of the gain
    Raises ValueError for another setting, plant or choice of axes.
    """
    need_one_of("li-2020", "setting", setting, SETTINGS)
    need_one_of("li-2020", "axes", axes, ("x", "xy"))
    gain, noise, trials, pulse = SETTINGS[setting]
    axis, path = cnc_axis(plant), butterfly_path()
    two = axes == "xy"
    r = path if two else path[:, :1]
    machine = Machine(
        TwoAxes(axis, cnc_axis(plant, gain=0.9)) if two else axis,
        Actuator(limit=10.0),
        Sensor(noise=noise) if noise else None,
        Disturbance(input=half_sine(len(r) - 1, pulse) * np.ones(r.shape[1])) if pulse else None,
    )
    quantities = {
        "feedback_effort": Quantity(feedback_effort, "", 1.0),
        "learned_effort": Quantity(learned_effort, "", 1.0),
    }
    if two:
        quantities |= {
            metric: Quantity(of) for metric, of in contour_metrics(Task(r, dt=SAMPLE_TIME)).items()
        }
    name = "plant.x.B" if two else "plant.B"
    return Scenario(
        **printed("li-2020", title=f"CNC axis along a butterfly, {setting} (Li 2020)",
                  trials=trials),
        machine=machine, task=Task(r, dt=SAMPLE_TIME, unit="mm", names=("x", "y") if two else ()),
        schemes=schemes_for(gain, r),
        uncertainty={name: Uniform(0.9, 1.1, relative=True)}, tolerance=5.0, shown_unit="µm",
        shown_scale=1e3, show_trials=(1, 2, 3, 4, 5, 9, 15, 22, 30, 40, 60, 100),
        quantities=quantities, judged_by="rms",
    )  # fmt: skip


def half_sine(N: int, height: float) -> np.ndarray:
    """(N, 1) signal: half a sine over 250 samples from sample 625 on, zero elsewhere."""
    k = np.arange(N) - 625
    return np.where((k >= 0) & (k < 250), height * np.sin(np.pi * k / 250), 0.0)[:, None]


def feedback_effort(trial) -> jax.Array:
    """Root mean square of the proportional share of the input (Li 2020, Fig. 38).

    The damping by speed feedback counts as a part of the drive.
    """
    return PROPORTIONAL * largest(root_mean_square(trial.e[:-1]))


def learned_effort(trial) -> jax.Array:
    """Root mean square of the learned share of the input, largest over axes (Li 2020, Fig. 37)."""
    return (
        largest(root_mean_square(trial.u - trial.signals["feedback"]))
        if "feedback" in trial.signals
        else jnp.zeros(())
    )
