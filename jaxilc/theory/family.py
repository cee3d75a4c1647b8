"""A condition over a parametric set of plants: the worst plant of those that were tried.

The condition of each plant is enclosed over frequency.
"""

from __future__ import annotations

import itertools
from functools import lru_cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from ..learning.machine import Machine
from ..learning.over_trials import check
from ..pytree.in_short import in_short
from ..runtime.earlier_names import takes_also
from ..runtime.tiles import tiled
from ..schemes import Scheme
from ..signals.task import Task
from ..uncertainty import Uncertainty, draw, drawn_machine, drawn_machines
from .by_frequency import CAUSAL, LEARNING, largest_of
from .condition import Condition, condition, premise
from .law import Taps, at_points, law_of
from .law_and_loop import STABLE, of_trial, parts_of
from .loop import Loop, linear_loop, minimal, on_circle, response
from .over_frequency import lines

TRIED = (
    "sup |Q (keep - L P)| < 1 for each of the plants that were tried: samples of the box, its "
    "corners, and where gradient ascent from the "
    "worst of them ended. Of the plants between them nothing is proved. For each one tried: "
)
BETWEEN = 65  # lines of the ascent between those next to the largest
CORNERS = 8  # names up to which all corners of the box are tried


class FamilyTest(NamedTuple):
    """A condition over a parametric set of plants.

    condition: on the supremum over the plants tried and over all frequencies
    at:        the numbers of the worst plant, by name
    worst:     the frequency at which it is worst [Hz]
    values:    (S,) supremum of each plant tried
    critical:  (S,) critical frequency of each plant tried [Hz]
    drawn:     {name: (S,)} the numbers of each plant tried
    """

    condition: Condition
    at: dict[str, float]
    worst: float
    values: np.ndarray
    critical: np.ndarray
    drawn: dict[str, np.ndarray]
    __repr__ = in_short


@takes_also(samples="machines")
def family_condition(
    machine: Machine,
    uncertainty: Uncertainty,
    scheme: Scheme,
    task: Task,
    *,
    machines: int = 128,
    sampling: str = "latin-hypercube",
    seed: int = 0,
    climbers: int = 8,
    steps: int = 60,
    frequencies=None,
) -> FamilyTest:
    """sup |Q (keep - L P)| over the box of numbers that the distributions span.

    Plants are drawn at random, the corners of the box are added, and from the worst of them
    gradient ascent goes on:

        p <- clip(p + h g / |g|),  g = d/dp max_w |Q (keep - L P(p))|

    h grows by 1.5 after a gain and is halved after a loss. The ascent runs on a grid of frequencies
    for each plant it starts from, and keeps a plant only if it is worse than the one before. Every
    plant that is tried is then enclosed over all frequencies, so that the worst of them is found
    reliably.

    machines, sampling, seed: as for `uncertainty.draw`; a number that a normal distribution puts
                  outside the box is moved into it; `samples` is an earlier name of `machines`
    climbers:    how many of the worst plants the ascent starts from; 0 for no ascent
    steps:       of each ascent
    frequencies: (F,) at which the ascent looks [Hz]; None for a `grid`

    Premises that differ from plant to plant are looked at for every plant tried. Raises ValueError
    as `draw` does.
    """
    found = tried_plants(
        machine,
        uncertainty,
        scheme,
        task,
        machines=machines,
        sampling=sampling,
        seed=seed,
        climbers=climbers,
        steps=steps,
        frequencies=frequencies,
    )
    top, parts = found.top, parts_of(machine, scheme, task)
    radius = np.max(found.radii)
    stable = premise(STABLE, found.radii < 1 - 1e-9, f"largest |pole| {radius:.6g}")
    held = [stable if p.name == STABLE else p for p in parts.premises]
    if found.values[top] < 1:
        every = drawn_machines(machine, uncertainty, found.drawn)
        held += of_trial(every, scheme, task, parts.causal)
    claimed = condition(
        found.values[top], TRIED + (CAUSAL if parts.causal else LEARNING), premises=held
    )
    return FamilyTest(
        claimed, found.at, float(found.worst[top]), found.values, found.critical, found.drawn
    )


class Tried(NamedTuple):
    """The plants of a box that were tried, without the premises of a claim.

    names:    of the numbers that differ
    points:   (S, names) the numbers of each plant
    values, worst, critical: (S,) supremum, its frequency and the critical frequency [Hz]
    radii:    (S,) largest |pole| of each loop
    loops:    the minimal loop of each plant
    """

    names: tuple[str, ...]
    points: np.ndarray
    values: np.ndarray
    worst: np.ndarray
    critical: np.ndarray
    radii: np.ndarray
    loops: list[Loop]

    @property
    def top(self) -> int:
        """The index of the worst plant."""
        return int(np.argmax(self.values))

    @property
    def at(self) -> dict[str, float]:
        """The numbers of the worst plant, by name."""
        return dict(zip(self.names, map(float, self.points[self.top]), strict=True))

    @property
    def drawn(self) -> dict[str, np.ndarray]:
        return {name: self.points[:, i] for i, name in enumerate(self.names)}


def tried_plants(
    machine: Machine,
    uncertainty: Uncertainty,
    scheme: Scheme,
    task: Task,
    *,
    machines: int = 128,
    sampling: str = "latin-hypercube",
    seed: int = 0,
    climbers: int = 8,
    steps: int = 60,
    frequencies=None,
) -> Tried:
    """sup |Q (keep - L P)| of each plant that `family_condition` tries; the arguments are its own.

    Without uncertainty the one plant is the machine itself. Raises ValueError as `draw` does.
    """
    check(machine, scheme, task)
    names, law = tuple(uncertainty.items()), law_of(scheme, task)
    points = _points(machine, uncertainty, machines, sampling, seed)
    common = (machine.unlimited(), scheme.unlimited(), task)

    def tried(points):
        whole = loops_at(machine, scheme, task, uncertainty, points)
        loops = [minimal(one, task.N) for one in whole]
        found = [largest_of(law, loop, task, lines(task, frequencies, [loop])) for loop in loops]
        return [np.array(x) for x in zip(*found, strict=True)], loops

    numbers, loops = tried(points)
    if climbers and names:
        first = np.argsort(-numbers[0])[:climbers]
        f = np.unique(np.concatenate([lines(task, frequencies, []), numbers[1][first]]))
        taps = tuple(Taps(*map(jnp.asarray, part)) for part in (law.keep, law.L))
        ends = (jnp.asarray(end) for end in _box(uncertainty))
        fixed = (*common, jnp.asarray(f), taps, *ends)
        climbed = np.asarray(_climbing(names, steps)(fixed, jnp.asarray(points[first])))
        further, loops_there = tried(climbed)
        points, loops = np.concatenate([points, climbed]), loops + loops_there
        numbers = [np.concatenate(x) for x in zip(numbers, further, strict=True)]
    return Tried(tuple(uncertainty), points, *numbers, loops)


def loops_at(
    machine: Machine, scheme: Scheme, task: Task, uncertainty: Uncertainty, points
) -> list[Loop]:
    """The loop of each plant, with all its states, without limits.

    points: (S, names) the numbers of each plant
    """
    common = (machine.unlimited(), scheme.unlimited(), task)
    matrices = _loops(tuple(uncertainty.items()))(common, jnp.asarray(points))
    return [Loop(*one) for one in zip(*map(np.asarray, matrices), strict=True)]


# How it is done
# --------------------------------------------------------------------------------------------------


def _box(uncertainty: Uncertainty) -> tuple[np.ndarray, np.ndarray]:
    """The least and the largest number by each distribution."""
    corners = [d.corners() for d in uncertainty.values()]
    return np.array([min(ends) for ends in corners]), np.array([max(ends) for ends in corners])


def _points(machine, uncertainty: Uncertainty, machines, sampling, seed) -> np.ndarray:
    """(S, names) the plants drawn, moved into the box, and its corners."""
    if not uncertainty:
        return np.zeros((1, 0))
    low, high = _box(uncertainty)
    drawn = draw(machine, uncertainty, machines, seed=seed, sampling=sampling)
    points = np.clip(np.stack([drawn[name] for name in uncertainty], axis=1), low, high)
    if len(uncertainty) > CORNERS:
        return points
    corners = np.array(list(itertools.product(*zip(low, high, strict=True))))
    return np.concatenate([points, corners])


@lru_cache(maxsize=16)  # what `tiled` returns compiles anew each time it is made
def _loops(names):
    return tiled(partial(_loop_of, names=names))


@lru_cache(maxsize=16)
def _climbing(names, steps):
    return tiled(partial(_climb, names=names, steps=steps))


def _loop_of(common, point, *, names):
    machine, scheme, task = common
    return linear_loop(
        drawn_machine(machine, dict(names), {name: point[i] for i, (name, _) in enumerate(names)}),
        scheme,
        task,
    )


def _climb(common, start, *, names, steps):
    """Where projected gradient ascent from `start` ends.

    Both are in the units of the numbers drawn; the ascent runs in the unit box.
    """
    machine, scheme, task, f, (keep, L), low, high = common
    z = on_circle(f, task.dt)
    law = at_points(keep, z), at_points(L, z)

    def sizes(loop, f, law):
        M = law[0] - law[1] @ response(loop, f, task.dt)
        return (
            jnp.abs(M[:, 0, 0])
            if M.shape[1:] == (1, 1)
            else jnp.linalg.svd(M, compute_uv=False)[:, 0]
        )

    def peak(x):
        """The largest size on the grid, and then between its neighbours.

        So no line of the grid is a local maximum only because it is a line of the grid.
        """
        loop = _loop_of((machine, scheme, task), low + (high - low) * x, names=names)
        i = jnp.argmax(sizes(loop, f, law))
        between = jnp.linspace(f[jnp.maximum(i - 1, 0)], f[jnp.minimum(i + 1, len(f) - 1)], BETWEEN)
        z = on_circle(between, task.dt)
        found = sizes(loop, between, (at_points(keep, z), at_points(L, z)))
        return found[jnp.argmax(found)]

    def ascend(_, now):
        x, value, g, h = now
        free = jnp.where(((x <= 0) & (g < 0)) | ((x >= 1) & (g > 0)), 0.0, g)
        moved = jnp.clip(
            x + h * free / jnp.maximum(jnp.linalg.norm(free), jnp.finfo(float).tiny), 0.0, 1.0
        )
        there, slope = jax.value_and_grad(peak)(moved)
        better = there > value
        return (
            jnp.where(better, moved, x),
            jnp.maximum(there, value),
            jnp.where(better, slope, g),
            h * jnp.where(better, 1.5, 0.5),
        )

    x = (start - low) / (high - low)
    x = lax.fori_loop(0, steps, ascend, (x, *jax.value_and_grad(peak)(x), jnp.asarray(0.1)))[0]
    return low + (high - low) * x
