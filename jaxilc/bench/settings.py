"""The setting of the contests with opponents: MFAILC on the motor of Cao 2019, in any size."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np

from .. import scenarios
from ..learning.over_trials import learn
from ..learning.within_trial import bytes_of_trial
from ..pytree.named_paths import replaced
from ..runtime.capacity import check_size
from ..runtime.lanes import usual_lanes
from ..runtime.tiles import tiled
from ..signals import references
from ..signals.task import Task
from ..sweeps.host import TRIALS_A_PASS
from .peers import METRICS, Problem

SCHEMES = {"cfdl": "cfdl-mfailc", "ffdl": "ffdl-mfailc"}
# Plants and trials that are enough to measure the time of a sample-step.
SLOW = {"NumPy loop": (1, 20), "NumPy batch": (1024, 5)}
SPREAD = 0.1  # half-width of the relative uncertainty of the gain


class Setting(NamedTuple):
    """MFAILC on the motor of Cao 2019, eq. 29, whose gain is uncertain by 10 %.

    trials: number J of trials
    gains: (S,) gains of the plants, relative to the printed one
    """

    machine: Any
    scheme: Any
    task: Task
    trials: int
    gains: np.ndarray

    @property
    def b(self) -> np.ndarray:
        """(S, 3) numerator coefficients of the plants."""
        return self.gains[:, None] * np.asarray(self.machine.plant.b)

    @property
    def problem(self) -> Problem:
        s, a = self.scheme, self.machine.plant.a
        weights = np.array([float(x) for x in (s.lam, s.rho, s.eta, s.mu, s.epsilon)])
        settled = self.task.settled.start
        return Problem(
            np.asarray(a),
            self.b,
            np.asarray(self.task.reference)[:, 0],
            self.trials,
            settled,
            weights,
            np.atleast_1d(s.phi0),
        )

    def ours(self, lanes: int | None = None) -> Callable[[], np.ndarray]:
        """(S, J, 4) metrics by `learn`, with the plants in tiles as in a sweep."""
        lanes = lanes or usual_lanes(bytes_of_trial(self.scheme, self.task))
        run = tiled(partial(_metrics, trials=self.trials), lanes=lanes)
        common, b = (self.machine, self.scheme, self.task), self.b
        return lambda: np.asarray(run(common, b))

    def part(self, plants: int) -> Setting:
        """The same setting with the first plants only."""
        return self._replace(gains=self.gains[:plants])


def setting(scheme: str, plants: int, trials: int, samples: int) -> Setting:
    """The scenario `cao-2019` in a given size, with one period of the sinusoid in each trial.

    scheme: `cfdl` or `ffdl`
    plants: number S of plants
    trials: number J of trials
    samples: number N of samples of a trial
    Raises ValueError for another scheme, and for a size that is too small or too large.
    """
    if scheme not in SCHEMES:
        raise ValueError(f"bench: scheme = {scheme!r} is not one of {', '.join(SCHEMES)}")
    for name, value, least in (
        ("plants", plants, 1),
        ("trials", trials, 1),
        ("samples", samples, 4),
    ):
        if value < least:
            raise ValueError(f"bench: {name} = {value} is outside its allowed range [{least}, inf)")
    need_room(plants, trials, samples)
    chosen = scenarios.load("cao-2019", plant="printed")
    task = Task(sinusoid(samples, chosen.task.dt), dt=chosen.task.dt)
    gains = np.random.default_rng(0).uniform(1 - SPREAD, 1 + SPREAD, plants)
    return Setting(chosen.machine, chosen.schemes[SCHEMES[scheme]], task, trials, gains)


def need_room(plants: int, trials: int, samples: int) -> None:
    """Check that all contenders fit into the RAM together.

    They keep the metrics of every trial, signals of a few plants, and the outputs of the plants.

    Raises ValueError where they do not fit.
    """

    def need(plants: float, trials: float, samples: float) -> float:
        of_signals = 20 * min(plants, SLOW["NumPy batch"][0]) + 6 * plants
        return 8 * (32 * plants * trials + of_signals * samples)

    check_size("bench", need, plants=plants, trials=trials, samples=samples)


def sinusoid(samples: int, dt: float) -> np.ndarray:
    """(N+1,) one period of a sinusoid with the amplitude 1."""
    return np.asarray(
        references.sinusoid(1.0, 1 / (samples * dt), duration=samples * dt, dt=dt), float
    ).ravel()


def _metrics(common, b, *, trials: int):
    machine, scheme, task = common
    drawn = replaced(machine, {"plant.b": b})
    history = learn(drawn, scheme, task, trials, trials_a_pass=TRIALS_A_PASS)
    return jax.numpy.concatenate([getattr(history, name) for name in METRICS], axis=-1)
