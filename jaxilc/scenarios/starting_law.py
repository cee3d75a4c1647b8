"""A first learning law for a plant that is known within intervals: P-type with a lead, filtered."""

from __future__ import annotations

from typing import NamedTuple

import jax
import numpy as np

from ..filters import ZeroPhaseButterworth
from ..learning.machine import Machine
from ..plants import ModalModel, ProcessModel
from ..schemes import Filtered, PIDType
from ..signals import references
from ..signals.task import Task
from ..theory.frequency import Largest, Loop, grid, largest_of, linear_loop, response
from ..theory.law import law_of
from ..theory.loop import minimal
from ..theory.on_lines import Lines, low_pass, widest
from ..uncertainty import Population, Uncertainty

ORDER = 2  # of the filter, in one pass
LARGEST = (0.9, 0.97)  # values of |Q (1 - L P)| that are allowed; the second if the first fails
SHARES = (0.15, 0.25, 0.4, 0.6, 0.8, 1.0)  # of the inverse of the DC gain, tried as learning gain
CORNERS = 8  # parameters up to which all corners of their intervals are taken
DRAWN = 129  # machines that are taken for more parameters
NEAREST = 4  # of the worst machines on the grid, whose largest value is enclosed


class StartingLaw(NamedTuple):
    """A learning law, and what the theory says about it.

    gamma_p: learning gain [unit of u per unit of y]
    lead: samples of look-ahead
    cutoff: of the robustness filter [Hz]
    machines: number of machines for which it was chosen, the fitted one included
    nominal, worst: sup |Q (1 - L P)| of the fitted plant and of the worst of these machines
    at: frequency of the worst value [Hz]
    """

    gamma_p: float
    lead: int
    cutoff: float
    machines: int
    nominal: float
    worst: float
    at: float

    @property
    def scheme(self) -> Filtered:
        learning = PIDType(gamma_p=self.gamma_p, lead=self.lead)
        return Filtered(learning, ZeroPhaseButterworth(cutoff=self.cutoff, order=ORDER))


class StartingTask(NamedTuple):
    """A sinusoid from rest to 2 amplitude and back, which the law learns.

    amplitude: [unit of y];  frequency: [Hz];  duration: [s], two periods
    """

    amplitude: float
    frequency: float
    duration: float

    def task(self, dt: float) -> Task:
        r = references.sinusoid(
            self.amplitude,
            self.frequency,
            duration=self.duration,
            dt=dt,
            phase=-np.pi / 2,
            offset=self.amplitude,
        )
        return Task(r, dt=dt)


def starting_law(
    plant: ProcessModel | ModalModel, uncertainty: Uncertainty, dt: float, samples: int
) -> StartingLaw | None:
    """The filtered P-type law of the largest cutoff that learns on every plant of the intervals.

        u_{j+1} = Q (u_j + gamma_p e_j[k+1+lead]),    sup_w |Q (1 - gamma_p z^(1+lead) P)| <= 0.9

    The largest value of the condition is looked for over the corners of the intervals (over draws
    where there are many parameters), on a grid of frequencies; those of the fitted plant and of the
    worst corners are then enclosed between the lines of the grid, with the law of the scheme's own
    program. Among laws whose
    cutoff is at least 0.7 of the largest possible one, the one that learns low frequencies fastest
    is taken. Where 0.9 cannot be reached, 0.97 is allowed.

    uncertainty: distributions of leaves, named as in a plant file, such as `plant.gain`
    dt: sample time [s]
    samples: length of the record, which limits lead and cutoff
    The result is None where there is no such law, for instance where the sign of the DC gain is
    not known.
    """
    machine, long = Machine(plant), Task(np.zeros(max(samples, 16)), dt=dt)
    corners = "corners" if len(uncertainty) <= CORNERS else "sobol"
    machines = Population(machine, uncertainty, count=DRAWN, sampling=corners).machines
    f = grid(long, points=300, near=np.exp(np.asarray(plant.all_poles) * dt))
    loops, P = _responses(machines, Task(np.zeros(16), dt=dt), f)
    for largest in LARGEST:
        law = _largest_cutoff(P, f, dt, long, largest, round(plant.delay / dt))
        for _ in range(4):
            if law is None:
                break
            kept = 1 - law.gamma_p * np.exp(2j * np.pi * f * dt * (1 + law.lead)) * P
            sizes = np.max(low_pass(f, law.cutoff, dt, ORDER) * np.abs(kept), axis=1)
            nominal, *others = _enclosed(loops, [0, *np.argsort(-sizes)[:NEAREST]], law, dt)
            worst = max(others, key=lambda one: one.value)
            law = law._replace(
                nominal=float(nominal.value), worst=float(worst.value), at=float(worst.worst)
            )
            if law.worst < (1 + largest) / 2:
                return law
            law = law._replace(cutoff=_rounded(0.7 * law.cutoff, 2))
    return None


def starting_task(
    law: StartingLaw, plant: ProcessModel | ModalModel, largest_input: float, dt: float
) -> StartingTask:
    """Two periods of a sinusoid at a fifth of the law's cutoff, or slower.

    Its amplitude needs at most half of the largest input of the record, by the fitted gain.
    """
    samples = int(np.clip(round(10 / (law.cutoff * dt)), max(100, 8 * law.lead), 20000))
    frequency = 2 / (samples * dt)
    slowest = 1e-3 * frequency  # for the gain at rest, also where the plant integrates
    gain = np.abs([_response_of(plant, 2j * np.pi * f) for f in (slowest, frequency)])
    allowed = 0.5 * largest_input / np.sum(1 / gain)
    return StartingTask(_rounded(float(allowed), 1), float(frequency), samples * dt)


# How it is done
# --------------------------------------------------------------------------------------------------


def _responses(machines, task: Task, f) -> tuple[list[Loop], np.ndarray]:
    """The loop of each machine, and (S, F) P(z) at frequencies f (F,) [Hz]."""
    loops, P = _compiled_responses(machines, task, f)
    return [Loop(*one) for one in zip(*map(np.asarray, loops), strict=True)], np.asarray(P)


@jax.jit
def _compiled_responses(machines, task, f):
    loops = jax.vmap(lambda one: linear_loop(one, None, task))(machines)
    return loops, jax.vmap(lambda loop: response(loop, f, task.dt)[:, 0, 0])(loops)


def _largest_cutoff(P, f, dt, task, largest, delay: int) -> StartingLaw | None:
    """The law that is chosen on the grid, whose largest values are not known yet, or None.

    P: (S, F) responses of the machines at frequencies f (F,) [Hz]
    delay: of the plant, in samples
    """
    steady = P[:, 0].real
    if np.any(steady * steady[0] <= 0) or not np.all(np.isfinite(P)):
        return None
    leads = np.r_[0, np.geomspace(1, max(1, min(500, task.N // 8)), 40).astype(int)]
    leads = np.unique(np.r_[leads, delay + leads])
    unit = 1 / np.max(np.abs(steady))
    gains = [_rounded(share * unit, 3) * np.sign(steady[0]) for share in SHARES]
    lowest = min(2 / task.duration, 0.1 / dt)
    law = widest([_lines(P, f, dt)], ORDER, gains, leads, largest, lowest)
    if law is None:
        return None
    cutoff = _rounded(min(law.cutoff, 0.4 / dt), 2)
    return StartingLaw(law.gain, law.lead, cutoff, len(P), np.inf, np.inf, np.nan)


def _lines(P, f, dt) -> Lines:
    """The responses with a law of gain 1 and lead 0."""
    one = np.exp(2j * np.pi * f * dt)
    return Lines(f, P, np.zeros(P.shape), np.ones(len(f)), one, dt)


def _enclosed(loops: list[Loop], which, law: StartingLaw, dt: float) -> list[Largest]:
    """sup |Q (1 - L P)| of some of the loops, enclosed over all frequencies."""
    task = Task(np.zeros(max(64, 2 * law.lead)), dt=dt)
    taps = law_of(law.scheme, task)
    reduced = [minimal(loops[i], task.N) for i in which]
    return [largest_of(taps, loop, task) for loop in reduced]


def _response_of(plant: ProcessModel | ModalModel, s: complex) -> complex:
    """G(s) without the delay, of which the size does not depend."""
    if isinstance(plant, ModalModel):
        return complex(np.asarray(plant.transfer(np.array([s])))[0, 0, 0])
    zeros, poles, w, zeta = (
        np.asarray(x) for x in (plant.zeros, plant.poles, plant.frequencies, plant.dampings)
    )
    slow = np.prod(1 + s / poles) * np.prod(1 + 2 * zeta * s / w + (s / w) ** 2)
    return complex(float(plant.gain) * np.prod(1 - s / zeros) / slow)


def _rounded(value: float, digits: int) -> float:
    """The value rounded towards 0 to so many significant digits."""
    if not value or not np.isfinite(value):
        return value
    unit = 10.0 ** (np.floor(np.log10(abs(value))) - digits + 1)
    return float(f"{np.trunc(value / unit * (1 + 1e-12)) * unit:.{digits}g}")
