"""What the frequency responses of a family of machines predict of a learning law.

    u_{j+1} = Q (u_j + L e_j),     e_j = e_1 - P u_j

Frequency by frequency the error after j trials of machine P is

    e_j = e_inf + (Q (1 - L P))^(j-1) (e_1 - e_inf),     e_inf = (1 - Q) / (1 - Q (1 - L P)) e_1

What does not repeat, n, is learned too: of |n|^2 each trial has the part

    (1 + |P Q L|^2 / (1 - |Q (1 - L P)|^2)) |n|^2

This holds far from the ends of a long trial. It takes microseconds, where a simulation takes
milliseconds, so that many laws can be looked at. For several channels `by_response.of_matrices`
predicts the same.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import NamedTuple

import jax
import numpy as np

from ..learning.machine import Machine
from ..learning.within_trial import run_trial
from ..pytree.aliases import Tree
from ..schemes import PIDType, Scheme, WithFeedback
from ..signals.task import Task
from ..theory.frequency import grid, response
from ..theory.law import Law, Taps
from ..theory.loop import Loop, loops_of, minimal, pole_radius, radius_of, stable
from ..uncertainty import Population, Uncertainty, drawn_machines

CORNERS = 5  # uncertain numbers up to which all corners of their intervals are taken
MACHINES = 33  # machines that are drawn, the nominal one included, besides the corners
LINES = 300  # frequencies
NOT_REPEATED = 1e-4  # share of the first error that counts as noise, if the machine has none
FLANKS = np.array([-1.0, -0.5, 0.0, 0.5, 1.0])  # of a resonance, in half its width
RESOLVED = 5  # lines to a period of the fastest response of taps
SAME_LINE = 1e-9  # relative distance of two lines that count as one
LIGHT = 0.3  # damping below which a pair of poles is a resonance
APART = 1.15  # ratio of two neighbouring frequencies that belong to different resonances
SHORT = 64  # samples of a trial that is long enough to read the loop of a sample off it


class Family(NamedTuple):
    """The responses of S machines at F frequencies, and the first error to be learned.

    frequencies: (F,) ascending up to the Nyquist frequency [Hz]
    P:     (S, F) from what is learned to the output; the first machine is the nominal one
    error: (F,) size of the error of the first trial of the nominal machine near each frequency, so
           that the root of the sum of the squares is its root mean square [unit of y]
    first_error: (N+1,) that error itself
    noise: (F,) size of what does not repeat from trial to trial, in the same way

    Of several channels P is (S, F, n_y, n_u), first_error (N+1, n_y), noise (F, n_y), and error
    (F, n_y, n_y) holds roots R of the cross spectra, so that the sum of the squares of T R is the
    mean square of what a response T makes of the error.
    loops: (S) the machines from what is learned to the output, as linear systems
    drawn: {name: (S,)} the numbers of each machine
    population: those that are drawn, without the corners and those that joined
    highest: largest cutoff that is looked for [Hz]
    metric: by which a law is judged
    """

    frequencies: np.ndarray
    P: np.ndarray
    error: np.ndarray
    first_error: np.ndarray
    noise: np.ndarray
    loops: list[Loop]
    drawn: dict[str, np.ndarray]
    population: Population
    highest: float = np.inf
    metric: str = "rms"

    def advance(self, samples, dt: float) -> np.ndarray:
        """(..., F) z^samples for numbers of samples (...)."""
        return np.exp(2j * np.pi * dt * np.multiply.outer(np.asarray(samples), self.frequencies))

    def of_taps(self, taps: Taps, dt: float) -> np.ndarray:
        """(F,) the response of the taps of a law of one channel."""
        return np.asarray(taps.taps)[:, 0, 0] @ self.advance(np.asarray(taps.powers), dt)

    def sizes(self, keep, L) -> np.ndarray:
        """(S, F) |keep - L P| of responses (F,), of matrices their largest singular value."""
        if self.P.ndim == 2:
            return np.abs(keep - L * self.P)
        return np.linalg.norm(keep - L @ self.P, ord=2, axis=(-2, -1))

    def sizes_of_law(self, law: Law, dt: float) -> np.ndarray:
        """(S, F) the same of a law by its taps."""
        parts = law.keep, law.L
        if self.P.ndim == 2:
            return self.sizes(*(self.of_taps(part, dt) for part in parts))
        return self.sizes(
            *(
                np.tensordot(self.advance(part.powers, dt).T, np.asarray(part.taps), axes=1)
                for part in parts
            )
        )

    def largest(self, Q, L) -> np.ndarray:
        """(...) the largest |Q (1 - L P)| of laws Q (..., F) and L (..., F) on the machines."""
        Q, L = (np.asarray(x)[..., None, :] for x in (Q, L))
        return np.max(np.abs(Q * (1 - L * self.P)), axis=(-2, -1))

    def rms(self, Q, L, trial: int, machines=slice(None)) -> np.ndarray:
        """(..., S) root mean square error of a trial, as predicted for each of these machines."""
        Q, L = (np.asarray(x)[..., None, :] for x in (Q, L))
        QLP = Q * L * self.P[machines]
        M = Q - QLP
        with np.errstate(all="ignore"):
            left = (1 - Q) / (1 - M)
            share = left + M ** (trial - 1) * (1 - left)
            noise = 1 + np.abs(QLP) ** 2 / (1 - np.abs(M) ** 2)
            square = np.abs(share * self.error) ** 2 + noise * self.noise**2
        return np.sqrt(np.sum(square, axis=-1))


def designed_on(
    machine: Tree, uncertainty: Uncertainty, *, machines: int = MACHINES, seed: int = 0
) -> Population:
    """The machines by which laws are designed; those that judge them are not spread as evenly."""
    count = machines if uncertainty else 1
    return Population(machine, uncertainty, count=count, seed=seed, sampling="sobol")


def family_of(
    population: Population,
    feedback: Scheme | None,
    task: Task,
    *,
    points: int = LINES,
    several: bool = False,
    besides: Mapping[str, np.ndarray] | None = None,
    taps: int = 0,
) -> Family:
    """The responses of the machines of a population, and of those at its corners.

    points: number of frequencies, besides those near the poles
    several: whether the machine may have several inputs and outputs
    besides: {name: (S,)} numbers of further machines;  taps: that the frequencies must resolve
    Raises ValueError for a machine of more inputs or outputs than are allowed, one that is not
    stable or does not move, and one whose first trial has no error.
    """
    one = task.inputs == task.outputs == 1
    if not (one or several):
        raise ValueError(
            f"design: the machine has {task.inputs} inputs and {task.outputs} outputs; allowed is "
            "one of each: design each axis by itself, or learn a law of matrices (jaxilc learn-law)"
        )
    machine, uncertainty, drawn = population.machine, population.uncertainty, population.drawn
    if 0 < len(uncertainty) <= CORNERS:
        corners = dataclasses.replace(population, sampling="corners").drawn
        drawn = {name: np.concatenate([drawn[name], corners[name][1:]]) for name in drawn}
    if besides:
        drawn = {name: np.concatenate([drawn[name], besides[name]]) for name in drawn}
    machines = drawn_machines(machine, uncertainty, drawn)
    machines = jax.vmap(lambda each: each.unlimited().noiseless())(machines)  # limits may be drawn
    short = Task(np.zeros((SHORT, task.outputs)), dt=task.dt, inputs=task.inputs)
    free = None if feedback is None else feedback.unlimited()
    loops = loops_of(machines, free, short)
    _need_stable(loops, task)
    f = _lines(task, loops, points, taps)
    P = np.asarray(_responses(Loop(*map(np.stack, zip(*loops, strict=True))), f, task.dt))
    if not np.any(np.abs(P[0]) ** 2):
        raise ValueError(
            "design: the machine does not answer its input, its response is 0 at all frequencies; "
            "give its plant a gain"
        )
    P = P[..., 0, 0] if one else P
    e = _first_error(machine, feedback, task)
    e = e[:, 0] if one else e
    error = gathered(e, f, task.dt)
    if not np.any(error):
        raise ValueError(
            "design: the error of the first trial is 0, so there is nothing to learn; give the "
            "task a reference that the machine does not follow by itself"
        )
    least = NOT_REPEATED * np.sqrt(np.sum(np.abs(error) ** 2, axis=0 if one else (0, 2)))
    noise = _noise(machine, task, f, P[0].reshape(len(f), task.outputs, task.inputs), least)
    noise = noise[:, 0] if one else noise
    return Family(f, P, error, e, noise, loops, drawn, population)


def under(scheme: Scheme, feedback: Scheme | None) -> Scheme:
    """A scheme with the feedback of the machine, if it has one."""
    return scheme if feedback is None else WithFeedback(scheme, feedback)


def resonance_band(family: Family, dt: float) -> np.ndarray | None:
    """(2,) ends [Hz] of the highest resonance over all machines; None without one below `LIGHT`."""
    found: list[tuple[float, float]] = []
    for loop, P in zip(family.loops, np.abs(family.P), strict=True):
        s = np.log(_pairs(loop.A)) / dt
        light = s[-s.real < LIGHT * np.abs(s)]
        f = light.imag / (2 * np.pi)
        found += zip(f, np.interp(f, family.frequencies, P), strict=True)
    if not found:
        return None
    f, height = np.array(sorted(found)).T
    gaps = np.flatnonzero(f[1:] > APART * f[:-1]) + 1
    one = max(np.split(np.arange(len(f)), gaps), key=lambda some: np.max(height[some]))
    return f[one[[0, -1]]]


# How it is done
# --------------------------------------------------------------------------------------------------


_responses = jax.jit(lambda loops, f, dt: jax.vmap(lambda loop: response(loop, f, dt))(loops))


def _lines(task: Task, loops: list[Loop], points: int, taps: int) -> np.ndarray:
    """(F,) frequencies: dense near the poles of the nominal machine, and at those of the others.

    A lightly damped resonance is narrower than the distance of two lines elsewhere, so each
    machine's is met at its peak and at both flanks. For taps there are more lines on the flanks,
    and `RESOLVED` to a period of their response everywhere.
    """
    f = grid(task, points=points, near=np.linalg.eigvals(minimal(loops[0], task.N).A))
    poles = _pairs(np.stack([loop.A for loop in loops]))
    width, angle = -np.log(np.abs(poles)), np.angle(poles)
    flanks = FLANKS if taps else FLANKS[::2]
    peaks = (angle[:, None] + width[:, None] * flanks).ravel() / (2 * np.pi * task.dt)
    even = np.arange(1, (RESOLVED * taps + 1) // 2) / (max(RESOLVED * taps, 1) * task.dt)
    more = np.concatenate([peaks, even])
    f = np.unique(np.concatenate([f, more[(more > f[0]) & (more < f[-1])]]))
    return f[np.diff(f, prepend=0.0) > SAME_LINE * f]


def _pairs(A) -> np.ndarray:
    """Poles of matrices (..., n, n), of each pair the one above the real axis."""
    poles = np.linalg.eigvals(A).ravel()
    return poles[(poles.imag > 0) & (np.abs(poles) > 1e-3)]


def _need_stable(loops: list[Loop], task: Task) -> None:
    radius = 0.0
    for loop in loops:
        own = radius_of(loop)
        radius = max(radius, own if stable(own) else pole_radius(loop, task.N))
    if not stable(radius):
        raise ValueError(
            f"design: the machine has a pole of size {radius:.6g}, so it does not come to rest "
            "after a trial; give a scheme with class = WithFeedback whose feedback makes it "
            "stable, or model the axis with its position loop closed"
        )


def _first_error(machine: Machine, feedback: Scheme | None, task: Task) -> np.ndarray:
    """(N+1,) the error of a trial of the nominal machine in which nothing is learned."""
    scheme = under(PIDType(), None if feedback is None else feedback.unlimited())  # learns nothing
    machine, key = machine.unlimited().noiseless(), jax.random.key(0)
    trial = jax.jit(run_trial)(machine, scheme, task, scheme.initial_memory(task), key)
    return np.asarray(trial.e)


def gathered(e, f, dt: float) -> np.ndarray:
    """(F,) the spectrum of an error (N+1,), gathered at the nearest of the frequencies.

    Of several channels (N+1, n_y): (F, n_y, n_y) roots of the cross spectra.
    """
    e = e[1:]
    spectrum = np.fft.rfft(e, axis=0) / len(e) * np.sqrt(2)
    spectrum[0] /= np.sqrt(2)
    lines = np.fft.rfftfreq(len(e), dt)
    places = np.argmin(np.abs(np.subtract.outer(np.log(lines + f[0]), np.log(f + f[0]))), axis=1)
    if e.ndim == 1:
        return np.sqrt(np.bincount(places, np.abs(spectrum) ** 2, minlength=len(f)))
    cross = np.zeros((len(f), e.shape[1], e.shape[1]), complex)
    np.add.at(cross, places, spectrum[:, :, None] * spectrum[:, None, :].conj())
    sizes, vectors = np.linalg.eigh(cross)
    return vectors * np.sqrt(np.maximum(sizes, 0.0))[:, None, :]


def _noise(machine: Machine, task: Task, f, P, least) -> np.ndarray:
    """(F, n_y) what sensor and disturbances add to each trial anew, white within it."""

    def variance(part, name):
        value = None if part is None else getattr(part, name)
        return 0.0 if value is None else np.asarray(value, float) ** 2

    sensor, disturbance = machine.sensor, machine.disturbance
    at_output = variance(sensor, "noise") + variance(disturbance, "output_noise")
    at_output += variance(sensor, "resolution") / 12
    of_input = variance(disturbance, "input_noise") * np.abs(P) ** 2
    share = np.gradient(f)[:, None] / (0.5 / task.dt)
    density = at_output + np.sum(of_input, axis=2)
    return np.sqrt(np.where(np.max(density, axis=0) > 0, density, least**2) * share)
