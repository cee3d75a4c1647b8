"""The contest of gradients: by jaxilc, as a tuning computes them, and by opponents.

For each plant the loss is that of the objective `Final("rms")`, and the slopes are by z, the
coordinates of the weights lam, rho, eta, mu and phi0 in which a tuning descends:

    l = 1/2 log(mean e^2 / peak^2 + floor^2) - log floor        in the last trial

A row takes as many `times ours` as runs of `learn` without derivatives would take.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np
import peers
from contests import SPREAD, Setting
from ours import Learning, of_each
from peers import METRICS, Peer, Problem
from timing import OURS, Entry, Row, cores, difference, in_turns, limit, need_agreement

from jaxilc.learning.divergence import CEILING
from jaxilc.native.program import Unknown
from jaxilc.pytree.named_paths import replaced
from jaxilc.runtime.capacity import check_size
from jaxilc.tuning.objectives import FLOOR, Final
from jaxilc.tuning.weights import Weights
from jaxilc.uncertainty import Population, Uniform

BY_DIFFERENCES, BY_ADJOINT = "Numba, P+1 runs", "C adjoint"
WEIGHTS = ("lam", "rho", "eta", "mu", "phi0")
ENOUGH = 256  # plants that are enough to measure derivatives that cost a run for each weight
STEP = 1e-6  # step of the differences
# Forward differences differ from the slopes by about STEP l'' / 2 + 2 d / STEP, where d is the
# rounding error of a loss. With STEP = 1e-6, in settings of 1 to 64 plants, 2 to 200 trials and 8
# to 2000 samples, this was 3e-7 to 3e-6 of the largest slope of all weights.
DIFFERENCES = 1e-4


class Diverges(ArithmeticError):
    """Learning diverges, so that a tuning bounds the errors and opponents have other numbers."""


class Slope(NamedTuple):
    """What an opponent of the contest computes: losses and slopes of the plants of a problem.

    problem: the plants and their trials; its weights are those at which the slopes are
    by_z: (P,) derivatives of lam, rho, eta, mu and phi0 by their coordinates
    """

    problem: Problem
    by_z: np.ndarray

    @classmethod
    def of(cls, setting: Setting, weights: Weights) -> Slope:
        """The slopes of a setting by these weights of its scheme."""
        (z,), maps = weights.starts(1, 0.0, 0), weights.bijections.values()
        by_z = [float(jax.grad(f)(x)) for f, x in zip(maps, z, strict=True)]
        return cls(setting.problem, np.array(by_z))

    def moved(self, dz) -> Problem:
        """The problem with the weights moved by dz (P,) along their derivatives."""
        *known, epsilon = self.problem.weights
        moved = np.array([*known, *self.problem.phi0]) + self.by_z * dz
        weights, phi0 = np.append(moved[:4], epsilon), moved[4:]
        return self.problem._replace(weights=weights, phi0=phi0)

    def losses(self, squares) -> np.ndarray:
        """The losses for mean square errors of the last trials."""
        return 0.5 * np.log(squares / self._peak**2 + FLOOR**2) - np.log(FLOOR)

    def by_squares(self, squares) -> np.ndarray:
        """The derivatives of the losses by the mean square errors."""
        return 0.5 / (squares + (FLOOR * self._peak) ** 2)

    @property
    def _peak(self) -> float:
        return float(np.max(np.abs(self.problem.r)))


GradientPeer = Callable[[Slope], np.ndarray]  # -> (S, 1, 1+P) losses and slopes


def by_differences(peer: Peer) -> GradientPeer:
    """Forward differences of the losses by P + 1 runs of an opponent without derivatives."""

    def run(of: Slope) -> np.ndarray:
        steps = STEP * np.eye(len(of.by_z))
        here, *there = (
            of.losses(peer(of.moved(step))[:, -1, METRICS.index("rms")] ** 2)
            for step in (0.0, *steps)
        )
        return np.stack([here, *((loss - here) / STEP for loss in there)], axis=1)[:, None]

    return run


def by_adjoint(adjoint: Peer) -> GradientPeer:
    """The chain rule around a program for mean squares of the last trial and their slopes.

    adjoint: function of a problem that returns (S, 1+P), see `peers.c_adjoint`
    """

    def run(of: Slope) -> np.ndarray:
        found = adjoint(of.problem)
        squares, slopes = found[:, :1], found[:, 1:]
        slopes = of.by_squares(squares) * slopes * of.by_z
        return np.concatenate([of.losses(squares), slopes], axis=1)[:, None]

    return run


def gradient_opponents(
    opponents: Mapping[str, tuple[Peer, float]],
) -> tuple[dict[str, tuple[GradientPeer, float]], list[str]]:
    """The opponents that run here with the seconds to build them, and a note on each other one.

    opponents: those without derivatives
    """
    found, notes = {}, []
    if "Numba parallel" in opponents:
        found[BY_DIFFERENCES] = (by_differences(opponents["Numba parallel"][0]), 0.0)
    start = time.perf_counter()
    try:
        adjoint = by_adjoint(peers.c_adjoint(cores()))
        found[BY_ADJOINT] = (adjoint, time.perf_counter() - start)
    except OSError as error:
        notes.append(f"{BY_ADJOINT} left out: {error}")
    return found, notes


def compare_gradients(
    of: Setting, opponents: Mapping[str, tuple[GradientPeer, float]], *, repeats: int = 5
) -> dict[str, Row]:
    """The times of a gradient by jaxilc and by every opponent, and of our run without derivatives.

    Raises ArithmeticError naming an opponent that computes other numbers, `Diverges` where
    learning diverges, and ValueError where the gradients do not fit into RAM.
    """
    (J, N), start = (of.trials, of.task.N), Weights.of(of.scheme, WEIGHTS).inside
    of = of._replace(scheme=replaced(of.scheme, start))
    weights, few = Weights.of(of.scheme, WEIGHTS), of.part(ENOUGH)
    P = len(weights.start)
    if BY_ADJOINT in opponents:
        check_size("bench: a gradient", lambda samples: bytes_of_adjoint(J) * samples, samples=N)
    of_all, of_few = Slope.of(of, weights), Slope.of(few, weights)
    entries = {OURS: Entry(of.ours(), len(of.b), J, N)}
    for name, which, by, forward in (
        ("1 weight forward", few, Weights.of(of.scheme, WEIGHTS[:1]), True),
        (f"{P} weights forward", few, weights, True),
        (reverse := f"{P} weights reverse", of, weights, False),
    ):
        program = _learning(which).derivatives(by, forward=forward)
        entries[name] = Entry(_called(program.run), len(which.b), J, N, program.built)
    with suppress(Unknown):  # where llvmlite is missing
        program = _learning(of).derivatives(weights, forward=False, native=True)
        name = f"{P} weights native"
        entries[name] = Entry(_called(program.run), len(of.b), J, N, program.built)
    for name, (peer, built) in opponents.items():
        slope = of_few if name == BY_DIFFERENCES else of_all
        entries[name] = Entry(partial(peer, slope), len(slope.problem.b), J, N, built)
    return in_turns(entries, repeats=repeats, agreement=partial(_agreement, of_all, reverse))


def bytes_of_adjoint(trials: int) -> float:
    """The bytes that the program in C stores for each sample, in all threads."""
    memories = 2 * math.ceil(math.sqrt(trials)) + 2
    return cores() * memories * 6 * 8 * peers.target_of_c().lanes


@dataclasses.dataclass(frozen=True, eq=False)
class _Given(Population):
    """Machines whose relative gains are given, the same for all programs, and not drawn."""

    gains: Any = ()

    @property
    def drawn(self) -> dict[str, np.ndarray]:
        return {"plant.b": np.asarray(self.gains)}


def _learning(of: Setting) -> Learning:
    gain = {"plant.b": Uniform(1 - SPREAD, 1 + SPREAD, relative=True)}
    population = _Given(of.machine, gain, count=len(of.gains), gains=of.gains)
    return Learning(population, of.scheme, of.task, of.trials, Final("rms"), {})


def _called(run: Callable[[], Any]) -> Callable[[], np.ndarray]:
    return lambda: of_each(run())


def _agreement(of: Slope, reverse: str, results: Mapping[str, np.ndarray]) -> dict[str, float]:
    """How far the results differ from the reverse gradient; raises as `compare_gradients` does."""
    metrics, off = results[OURS], {}
    largest = np.max(metrics[..., METRICS.index("max_error")])
    if not largest <= CEILING * np.max(np.abs(of.problem.r)):
        raise Diverges("learning diverges in this size; a tuning would bound its errors")
    rms = metrics[:, -1:, METRICS.index("rms"), None]
    for name, result in {**results, OURS: of.losses(rms**2)}.items():
        whole = results[reverse]
        if name == BY_DIFFERENCES:  # as a share of the largest slope of all weights
            slopes = (x[..., 1:].reshape(len(x), -1, 1) for x in (result, whole))
            off[name] = need_agreement(name, difference(*slopes), max(DIFFERENCES, limit()))
        else:
            off[name] = need_agreement(name, difference(result, whole), limit())
    return off
