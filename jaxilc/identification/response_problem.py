"""The least-squares problem of a measured frequency response, and its search from many starts."""

from __future__ import annotations

from typing import NamedTuple

import jax
import numpy as np

from ..plants import ProcessModel
from ..plants.process_model import LONGEST_DELAY
from ..pytree.named_paths import get_at, replaced
from ..theory.on_lines import MeasuredResponse
from .many_starts import REFINED, drawn_plants, with_numerator
from .model_response import response_and_slopes
from .problem import Coordinates, Minimum, free_elements, least_squares_from

SEARCHED = 400  # lines at most in the search from many starts
PERIODS = 25  # of the fastest line, the longest delay that is looked for
STEPS = 8  # delays a period of the fastest line, for the starts


class ResponseProblem(NamedTuple):
    """The least-squares problem of a response: theta (P,) holds the values of `names`.

    measured: the measured lines
    plant: a ProcessModel of the structure that is fitted
    names: elements of the plant that are fitted, and `delay` last where it is
    coordinates: coordinates in which the optimiser works
    weights: (F,) numbers by which the complex residuals are multiplied; sqrt(2) / std makes their
        parts of variance 1
    dt: sample time of the hold [s]; None for continuous time
    delay: the delay where it is fixed [s]
    longest: the longest delay that is allowed [s]
    """

    measured: MeasuredResponse
    plant: ProcessModel
    names: tuple[str, ...]
    coordinates: Coordinates
    weights: np.ndarray
    dt: float | None
    delay: float | None
    longest: float

    @property
    def samples(self) -> int:
        return 2 * len(self.weights)

    @property
    def scale(self) -> np.ndarray:
        return np.ones(1)

    @property
    def counts(self) -> tuple[int, int, int]:
        plant = self.plant
        return np.size(plant.zeros), np.size(plant.poles), np.size(plant.frequencies)

    def _evaluated(self, theta):
        values = theta if self.delay is None else np.append(theta, self.delay)
        response, slopes = response_and_slopes(
            values, self.counts, self.measured.frequencies, self.dt
        )
        return response, slopes[:, : len(theta)]

    def response(self, theta):
        """(F,) the model's response."""
        return self._evaluated(theta)[0]

    def residual(self, theta):
        """(2 F, 1) the weighted measured response minus that of the model: real parts first."""
        with np.errstate(all="ignore"):  # a step that is too long; the optimiser shortens it
            try:
                error = self.weights * (self.measured.response - self.response(theta))
            except np.linalg.LinAlgError:
                error = np.full(len(self.weights), np.inf)
        parts = np.concatenate([error.real, error.imag])
        return np.where(np.isfinite(parts), parts, 1e100)[:, None]

    def sensitivity(self, theta):
        """(2 F, 1, P) derivatives of the weighted response of the model, exact."""
        slopes = self.weights[:, None] * self._evaluated(theta)[1]
        return np.concatenate([slopes.real, slopes.imag])[:, None, :]

    def start(self, plant: ProcessModel, delay: float) -> np.ndarray:
        """The vector theta of a plant."""
        values = [float(get_at(plant, name)) for name in self.names if name != "delay"]
        return np.array(values + ([delay] if self.delay is None else []))

    def plant_at(self, theta) -> ProcessModel:
        """The plant with the values theta, but without its delay."""
        named = zip(self.names, map(float, theta), strict=True)
        return replaced(self.plant, {name: v for name, v in named if name != "delay"})

    def delay_at(self, theta) -> float:
        return float(theta[-1]) if self.delay is None else self.delay

    def solve(self, theta, **options) -> Minimum:
        return least_squares_from(self, theta, **options)


def response_problem(
    measured: MeasuredResponse, plant: ProcessModel, dt: float | None, delay: float | None
) -> ResponseProblem:
    """The problem of a measured response; delay: [s], None where it is fitted."""
    f, G, std = (np.asarray(x) for x in measured[:3])
    names, coordinates = (
        free_elements(plant, None),
        Coordinates.of(plant, free_elements(plant, None)),
    )
    longest = longest_delay(f, dt)
    if delay is None:  # the coordinate of the bias of a record is that of the delay
        names = (*names, "delay")
        coordinates.low[-1], coordinates.high[-1] = 0.0, longest
    else:
        coordinates = Coordinates(*(of[:-1] for of in coordinates))
    scatter = std if std.any() else np.maximum(np.abs(G), 1e-9 * np.max(np.abs(G)))
    scatter = np.maximum(scatter, np.min(scatter[scatter > 0]))
    return ResponseProblem(
        measured, plant, names, coordinates, np.sqrt(2) / scatter, dt, delay, longest
    )


def longest_delay(f: np.ndarray, dt: float | None) -> float:
    """The longest delay [s] that lines at frequencies f [Hz] are searched for."""
    longest = float(min(PERIODS / f[-1], 0.5 / np.median(np.diff(f))))
    return longest if dt is None else min(longest, LONGEST_DELAY * dt)


def best_of_many_starts(problem: ResponseProblem, starts: int, seed: int) -> Minimum:
    """The best fit from many drawn structures, as `from_many_starts` finds it for a record.

    Each structure is scored with each of many delays by the least squares of its numerator. There,
    the hold is (1 - exp(-s dt)) / (s dt), without the aliases. Of more than 400 lines, every n-th
    is taken for the search.
    """
    every = -(-len(problem.weights) // SEARCHED)
    if every > 1:
        f, G, std = (np.asarray(of)[::every] for of in problem.measured[:3])
        measured = MeasuredResponse(f, G, std)
        thinned = problem._replace(measured=measured, weights=problem.weights[::every])
        return problem.solve(best_of_many_starts(thinned, starts, seed).theta)
    f = problem.measured.frequencies
    rates = (np.pi * f[0], 4 * np.pi * f[-1])
    drawn = drawn_plants(problem.plant, rates, starts, seed)
    delays = [problem.delay]
    if problem.delay is None:
        delays = np.linspace(0.0, problem.longest, 2 + int(STEPS * problem.longest * f[-1]))
    scored = [
        _scored(problem, jax.tree.map(lambda leaf, i=i: np.asarray(leaf)[i], drawn), delays)
        for i in range(starts)
    ]
    scored = sorted((one for one in scored if np.isfinite(one[0])), key=lambda one: one[0])
    begin = [problem.start(plant, delay) for _, plant, delay in scored[:REFINED]]
    winner = min(
        (problem.solve(theta, ftol=1e-4, max_nfev=30) for theta in begin),
        key=lambda found: found.cost,
    )
    regrouped = problem.plant_at(winner.theta).regrouped()
    return problem.solve(problem.start(regrouped, problem.delay_at(winner.theta)))


def _scored(problem: ResponseProblem, plant: ProcessModel, delays):
    """The least sum of squares of a denominator, the plant with its numerator, and the delay."""
    measured, w = problem.measured, problem.weights
    s, m = 2j * np.pi * measured.frequencies, problem.counts[0]
    held = 1.0 if problem.dt is None else -np.expm1(-s * problem.dt) / (s * problem.dt)
    slow = np.prod(1 + s[:, None] / plant.poles, axis=1)
    at = s[:, None] / plant.frequencies
    slow = slow * np.prod(1 + 2 * plant.dampings * at + at**2, axis=1)
    zero = 1 - s / (plant.zeros[0] if m else 1.0)
    basis = (w * held / slow)[:, None] * zero[:, None] ** np.arange(m + 1)
    size = np.linalg.norm(basis, axis=0)
    if not (np.all(np.isfinite(size)) and np.all(size)):
        return np.inf, plant, 0.0
    basis = basis / size
    wanted = (w * measured.response)[:, None] * np.exp(np.outer(s, delays))
    products = np.real(basis.conj().T @ wanted)
    weights = np.linalg.pinv(np.real(basis.conj().T @ basis), hermitian=True) @ products
    left = np.sum(np.abs(w * measured.response) ** 2) - np.sum(weights * products, axis=0)
    best = int(np.argmin(left))
    return left[best], with_numerator(plant, weights[:, best] / size), float(delays[best])
