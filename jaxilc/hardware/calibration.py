"""What a campaign should measure next, judged by its own trials: a band around a step of its law.

A plant file leaves out friction, backlash and what differs from trial to trial. After two trials
the campaign knows better: the outputs of its trials, what the nominal machine of the file makes of
the same schedules, and by how much one step was missed so far.

    e_{j+1} = e_j - w (1 + g) (s_{j+1} - s_j)
    log |e_{j+1}| ~ N(log(|e_{j+1}|^2 + f^2) / 2, c^2 + b^2 q^2 (1 - v) + a^2 v)

s_j is the simulated output of trial j, g the gain by which the measured steps exceed the simulated
ones, w the share of the step that the machine makes, and q the step over the error. f is the level
at which learning ends, v its share in the power. The weights of w, f, a, b begin as `GRID` says and
are those that the trials so far make likely (Bayes, on a grid). A trial that lies far outside is
that of another machine: g and the weights begin anew after it, so a change for good is told once.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.special import ndtr, ndtri

from ..pytree.aliases import Json
from ..pytree.ranges import is_whole
from ..signals.task import Task
from . import prediction
from .journal import Manifest
from .prediction import Band, Place, as_lists, band_of

SHARE = 0.9  # of the trials, at least, of which both errors lie within their bands
ALARM = 0.001  # chance of a trial so far outside that the machine must be another
FORGOTTEN = 0.1  # share by which the evidence of a trial counts less in the next one
LEAST = 1e-100  # an error below it counts as this; its square is a number
ROUNDED = 0.015  # c: least standard deviation of a logarithm
_STEPS = (0.0, 0.5, 1.0)  # w
_LEVELS = np.geomspace(1e-4, 0.3, 14)  # f as a share of the error of the first trial
_NORMAL = np.linspace(-2, 2, 7)
_END, _MODEL = 0.35 * np.exp(0.7 * _NORMAL), 0.1 * np.exp(_NORMAL)  # a and b, lognormal


class Expected(NamedTuple):
    """The errors that a campaign expects of its next trial.

    step: number of the predicted trial, see `prediction.steps`
    rms, largest: bands of the RMS error and of the largest error, each of one row [unit of y]
    far: (2, 2) ends beyond which RMS error and largest error are those of another machine
    output: (N+1, n_y) what the machine is expected to do [unit of y]
    """

    step: int
    rms: Band
    largest: Band
    far: np.ndarray
    output: np.ndarray

    def place(self, error: float, largest: float) -> Place:
        """Where a measured trial lies; it is `clear` beyond the far ends."""
        place = prediction.place_in(self.step, (self.rms, self.largest), np.inf, error, largest)
        ends = zip((error, largest), self.far, strict=True)
        within = all(low <= value <= high for value, (low, high) in ends)
        return place if within else place._replace(level="clear")

    def as_json(self) -> dict[str, Json]:
        """Step, bands and far ends, as a manifest keeps them."""
        return {"step": self.step, "far": self.far.tolist(), **as_lists(self.rms, self.largest)}


def kept(manifest: Manifest) -> Expected | None:
    """What was expected of a trial, from its manifest; None where it holds nothing of the kind."""
    found = manifest.get("expected")
    if not isinstance(found, dict):
        return None
    rms, largest = (band_of(found.get(name)) for name in ("rms", "largest"))
    step, far = found.get("step"), found.get("far")
    if rms is None or largest is None or not is_whole(step) or np.shape(far) != (2, 2):
        return None
    return Expected(int(found["step"]), rms, largest, np.array(far, float), np.empty(0))


def expected(measured: np.ndarray, simulated: np.ndarray, task: Task, step: int) -> Expected | None:
    """What the next trial of a campaign should measure; None before the third, or without a model.

    measured: (j, N+1, n_y) outputs of the trials so far [unit of y]
    simulated: (j+1, N+1, n_y) outputs of the nominal machine with the schedules of these trials and
        of the next one [unit of y]
    """
    y, s, r = (np.asarray(x, float) for x in (measured, simulated, task.reference))
    if len(y) < 2 or not (np.all(np.isfinite(y)) and np.all(np.isfinite(s))):
        return None
    steps, taken = np.diff(s, axis=0), np.diff(y, axis=0)
    sizes = np.sum(steps**2, axis=(1, 2))
    more = np.sum(steps[:-1] * (taken - steps[:-1]), axis=(1, 2))
    used = np.ones(len(y) - 1, bool)
    bands = []
    for size in (_rms, _largest):
        errors, level = size(r - y), _Level(size(r - y)[0])
        for i in range(1, len(y)):
            told = _told(r - y[i - 1], steps[i - 1], _gain(more, sizes, used, i - 1), size)
            if not level.learned(told, errors[i]):
                used[:i], level = False, _Level(size(r - y)[0])
        gain = _gain(more, sizes, used, len(more))
        bands.append(level.ends(_told(r - y[-1], steps[-1], gain, size)))
    ends = np.array(bands)
    both = [Band(*(np.array([x]) for x in row[1:4])) for row in ends]
    return Expected(step, *both, ends[:, [0, 4]], y[-1] + (1 + gain) * steps[-1])


def _gain(more, sizes, used, before: int) -> float:
    """By which share the steps that were measured exceed the simulated ones."""
    size = float(np.sum(sizes[:before][used[:before]]))
    return float(np.clip(np.sum(more[:before][used[:before]]) / size, -0.5, 1.0)) if size else 0.0


def _told(e, step, gain: float, size) -> np.ndarray:
    """(2, w) the error that each share of the step leaves, and the step over it."""
    left = np.maximum([size(e - w * (1 + gain) * step) for w in _STEPS], LEAST)
    return np.array([left, size(step) / left])


class _Level:
    """The weights of w, f, a and b, which the trials of a campaign change."""

    def __init__(self, first: float) -> None:
        shape = (len(_STEPS), len(_LEVELS), len(_END), len(_MODEL))
        normal = -(_NORMAL**2) / 2
        self.log = np.broadcast_to(normal[:, None] + normal, shape)
        self.f = max(first, LEAST) * _LEVELS[:, None, None]

    def _at(self, told: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Weights, means and standard deviations of the logarithm of the next error."""
        left, q = (x[:, None, None, None] for x in told)
        power = left**2 + self.f**2
        v = self.f**2 / power
        spread = ROUNDED**2 + _MODEL**2 * q**2 * (1 - v) + _END[:, None] ** 2 * v
        weights = np.exp(self.log - np.max(self.log))
        return weights / np.sum(weights), np.log(power) / 2, np.sqrt(spread)

    def learned(self, told: np.ndarray, error: float) -> bool:
        """Whether an error was not far outside; if so, the weights follow it."""
        weights, mean, spread = self._at(told)
        t = (np.log(max(error, LEAST)) - mean) / spread
        share = float(np.sum(weights * ndtr(t)))
        if not ALARM / 2 <= share <= 1 - ALARM / 2:
            return False
        self.log = (1 - FORGOTTEN) * self.log - t**2 / 2 - np.log(spread)
        return True

    def ends(self, told: np.ndarray) -> list[float]:
        """Far end, lower end, median, upper end and far end of the next error."""
        weights, mean, spread = (np.broadcast_to(x, self.log.shape).ravel() for x in self._at(told))
        tail = (1 - SHARE) / 4  # one of two sides of two bands
        found = []
        for share in (ALARM / 2, tail, 0.5, 1 - tail, 1 - ALARM / 2):
            low, high = (mean + k * spread for k in (ndtri(ALARM / 20), -ndtri(ALARM / 20)))
            low, high = float(np.min(low)), float(np.max(high))
            for _ in range(40):
                middle = (low + high) / 2
                above = np.sum(weights * ndtr((middle - mean) / spread)) > share
                low, high = (low, middle) if above else (middle, high)
            with np.errstate(over="ignore"):  # an end may be infinite
                found.append(float(np.exp(low)))
        return found


def _rms(signal: np.ndarray) -> np.ndarray:
    return np.sqrt(np.mean(signal[..., 1:, :] ** 2, axis=(-2, -1)))


def _largest(signal: np.ndarray) -> np.ndarray:
    return np.max(np.abs(signal[..., 1:, :]), axis=(-2, -1))
