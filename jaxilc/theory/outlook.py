"""All trials to come of a linear law on a linear machine.

The questions are where learning goes, how fast, and which limits it meets on the way. One trial and
its learning take what is played, w, to F(w) = M w + c, with limits left out (`learning_map`). So
w_j - w_inf = M^(j-1) (w_1 - w_inf), and

    ||M^i|| <= growth * factor^(i // trials)    with factor < 1

says that learning converges, what it can do before (`Decay`), and within which distance of w_j all
later trials stay:

    ||w_i - w_j|| <= reach ||w_(j+1) - w_j||,    reach = growth * trials / (1 - factor)

A limit that no trial within that distance can meet is never met. Otherwise the first trial that
meets one is told, or that one cannot be excluded. Where no power of M is seen to contract, its
spectral radius tells whether learning converges in the end, however far it strays before: exactly
if M is triangular, as that of a causal law is, and else with its doubt. M is taken as a matrix up
to 512 rows, and beyond as a map whose norms are bounded from above (`spectrum.largest`). Noise is
left out, and what is drawn for each trial has its mean; `chance` is on single runs.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..learning.machine import Machine
from ..pytree.in_short import in_short
from ..schemes import Scheme
from ..signals.task import Task
from .condition import ROUNDING, Premise, premise
from .learning_map import LearningMaps, in_groups, limit_names, maps_of
from .spectrum import LONGEST

POWERS = (1, 4, 16, 64)  # of M that are looked at, until one contracts
SURELY = 1 - 1e-6  # of eigenvalues on the diagonal of a triangular map, also in single precision
NO_LIMIT = "no limit is met in any trial to come"
WHOLE = "the whole trial converges, its ends included"


class Decay(NamedTuple):
    """||M^i|| <= growth factor^(i // trials) of S machines.

    trials: (S,) 0 where no such bound was found
    factor: (S,) infinite where no such bound was found
    growth: (S,) likewise; but of an M with radius < 1, about max_i ||M^i||
    norm:   (S,) an upper bound of ||M||
    radius: (S,) spectral radius of M, its doubt added; infinite where that is not below 1 and M is
        not triangular, or a bound was found
    inverse: (S,) ||(I - M)^-1|| of an M with radius < 1 and a growth that the digits of the numbers
        can hold; infinite otherwise
    fallen: (S,) power of such an M that is seen to contract; 0 where none is
    """

    trials: np.ndarray
    factor: np.ndarray
    growth: np.ndarray
    norm: np.ndarray
    radius: np.ndarray
    inverse: np.ndarray
    fallen: np.ndarray
    __repr__ = in_short

    @property
    def power(self) -> np.ndarray:
        """(S,) a power of M that contracts; 0 where none is known."""
        return np.maximum(self.trials, self.fallen)

    @property
    def converges(self) -> np.ndarray:
        """(S,) whether learning comes to its limit in the end."""
        return (self.trials > 0) | ((self.radius < SURELY) & np.isfinite(self.inverse))

    @property
    def monotone(self) -> np.ndarray:
        """(S,) whether the distance from the limit falls in every trial."""
        return self.trials == 1

    def of_whole(self, known: bool = False) -> Premise:
        """The premise that the whole trial converges on each machine, as where it is known to."""
        return premise(WHOLE, known | (self.trials > 0), self.told(int(np.argmax(self.factor))))

    def told(self, machine: int) -> str:
        """The decay of one machine in a sentence."""
        k, growth = int(self.trials[machine]), float(self.growth[machine])
        if not k and self.radius[machine] < SURELY:
            far = f"about {growth:.3g} times" if np.isfinite(growth) else "far"
            beyond = "" if self.converges[machine] else ", beyond the digits of the numbers"
            if np.isfinite(growth) and not self.fallen[machine]:
                beyond = f", and was not seen to fall within {LONGEST} trials"
            return (
                f"every eigenvalue of the learning map is at most {self.radius[machine]:.6g} in "
                "size; but the distance from the limit can grow "
                f"{far} before it falls{beyond}"
            )
        if not k:
            return (
                f"no power of the learning map up to {POWERS[-1]} contracts; "
                f"the norm of one trial is up to {self.norm[machine]:.6g}"
            )
        before = f", and grows at most {growth:.3g} times before" if growth > 1 else ""
        within = "every trial" if k == 1 else f"{k} trials"
        falls = (
            f"the distance from the limit falls to {share_words(self.factor[machine])} of itself"
        )
        return f"{falls} in {within}, or below{before}"

    @property
    def reach(self) -> np.ndarray:
        """(S,) how far later trials stray from w_j, in units of ||w_(j+1) - w_j||.

        It is infinite where there is no decay.
        """
        found = self.trials > 0
        growth, left = np.where(found, self.growth, 1.0), np.where(found, 1 - self.factor, 1.0)
        return np.where(found, growth * self.trials / left, np.inf)


def share_words(factor: float) -> str:
    """A factor below 1 in words, in which one that is close to it differs from it."""
    return f"1 - {1 - factor:.3g}" if 1 - factor < 5e-7 else f"{factor:.6g}"


class Outlook(NamedTuple):
    """What linear theory says of all trials to come of S machines.

    decay:  of the distance from the limit
    limit:  (S, n) w_inf
    radius: (S,) distance within which w_inf is known
    floor:  (S,) root mean square error that is left at the limit
    doubt:  (S,) distance within which `floor` is known
    met:    (S,) first trial that meets a limit; 0 if none was seen to
    clear:  (S,) whether no limit is ever met
    which:  name of the limit that is met first, of each machine
    """

    decay: Decay
    limit: np.ndarray
    radius: np.ndarray
    floor: np.ndarray
    doubt: np.ndarray
    met: np.ndarray
    clear: np.ndarray
    which: np.ndarray
    __repr__ = in_short

    @property
    def of_limits(self) -> Premise:
        """The premise that the limits change nothing, so that all stays linear on each machine."""
        return premise(NO_LIMIT, self.clear, self.told(int(np.argmin(self.clear))))

    def told(self, machine: int) -> str:
        """Which limit a machine meets, and when."""
        if self.clear[machine]:
            return "none can be"
        name = self.which[machine] or "a limit"
        if self.met[machine]:
            return f"{name} is met in trial {self.met[machine]}"
        return f"that {name} is met later cannot be excluded"


def outlooks(machines: Machine, scheme: Scheme, task: Task) -> Outlook:
    """The outlook of each machine. machines: with a leading axis.

    Its premises are left to `linearity`: here everything is taken to be linear.
    """
    return in_groups(lambda some, task: outlook_of(maps_of(some, scheme, task)), machines, task)


def outlook_of(maps: LearningMaps, astray: np.ndarray | None = None) -> Outlook:
    """The outlook of each machine of these maps.

    astray: (S, K) by how much what limits act on may differ from this, in units of the bounds
    """
    decay = decay_of(maps)
    limit, left, floor, gain = maps.limit()
    # w_inf - w = (I - M)^-1 (F(w) - w), of which the last digit of w is rounded
    left = left + np.finfo(limit.dtype).eps * np.linalg.norm(limit, axis=1)
    strays = np.minimum(decay.reach, decay.inverse)
    radius = np.where(left > 0, strays * np.where(left > 0, left, 1.0), 0.0)
    names = limit_names(maps.machines, maps.scheme, maps.task)
    met, clear, which = np.zeros(len(left), int), np.ones(len(left), bool), np.zeros(0, int)
    if names:  # of a bound of which nothing is left there is NaN, below which nothing lies
        room = None if astray is None else np.where(astray < 1, 1 - astray, np.nan)
        met, clear, which = maps.first_met(decay.reach, room)
        met = np.where(met > 0, met + maps.machines.last_change - 1, 0)
        if astray is not None and maps.machines.last_change > 1:
            clear = np.zeros_like(clear)  # it is not known where w begins
    if astray is not None:
        met = np.zeros_like(met)  # the trial is that of the machine that does not go astray
    labels = np.array([names[i] for i in which] if names else [""] * len(left))
    astir = np.where(gain > 0, radius, 0.0)  # an error that no input moves is known
    doubt = gain * astir / np.sqrt(maps.task.N * maps.task.outputs)
    nothing = decay.converges & maps.leaves_nothing()
    floor, doubt = (np.where(nothing, 0.0, x) for x in (floor, doubt))
    return Outlook(decay, limit, radius, floor, doubt, met, clear, labels)


def decays(machines: Machine, scheme: Scheme, task: Task) -> Decay:
    """How the distance from the limit falls on each machine. machines: with a leading axis."""
    return in_groups(lambda some, task: decay_of(maps_of(some, scheme, task)), machines, task)


def decay_of(maps: LearningMaps) -> Decay:
    """How the distance from the limit falls on each machine of these maps."""
    norm = late = maps.norm(1)
    trials, between = np.zeros(len(norm), int), np.ones(len(norm))
    factor, growth = np.full((2, len(norm)), np.inf)
    eps = np.finfo(norm.dtype).eps
    for power, following in zip(POWERS, (*POWERS[1:], 0), strict=True):
        of_power = norm if power == 1 else maps.norm(power)
        found = (trials == 0) & (of_power < 1 - ROUNDING * eps * between)
        trials, factor = np.where(found, power, trials), np.where(found, of_power, factor)
        growth = np.where(found, between, growth)
        with np.errstate(over="ignore"):
            between = between * np.maximum(of_power, 1.0) ** max(following // power - 1, 0)
        if power == 1 and not np.all(trials):  # higher ones are of use where the last contracts
            late = maps.late(POWERS[-1])
        if not np.any((trials == 0) & (late < 1)):
            break
    radius, of_radius, fallen, inverse = maps.by_radius(trials == 0)
    growth = np.where(trials == 0, of_radius, growth)
    return Decay(trials, factor, growth, norm, radius, inverse, fallen)
