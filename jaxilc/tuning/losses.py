"""The loss of a tuning over its machines, and its derivatives by the weights.

How learning affects the gradients:

    clips, quantisers, resets     Their docstrings say what the gradient is: zero, straight-through,
                                  or that of the branch that was taken. `reset="smooth"` has the
                                  whole gradient (`schemes.mfac`).
    a diverging learning process  `objectives.Bounded` limits its error to a ceiling. The gradient
                                  is that of the trial that reached the ceiling.
    many trials                   Where learning amplifies, the slope of log e grows with the number
                                  of trials. `clip` bounds the slope of each machine. `truncate`
                                  takes the slope through the last trials only, which is not the
                                  slope of the loss.
    a settled metric              It does not include the start of a trial, where errors may grow:
                                  add a term of `max_error`.
    a slope that is not finite    The slope of that machine is left out of the step, which follows
                                  the worst of the others where the risk asks for the worst. Its
                                  loss still counts, and `dropped` says how many there were.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from functools import partial

import jax
import jax.numpy as jnp

from ..learning.machine import Machine
from ..learning.metrics import Keep
from ..learning.within_trial import bytes_of_trial
from ..native.run import fastest
from ..pytree.aliases import Value
from ..pytree.named_paths import replaced
from ..runtime.lanes import fitting_lanes, usual_lanes
from ..runtime.tiles import tiled
from ..schemes import Scheme
from ..signals.task import Task, Trial
from ..uncertainty import Population
from .descent import Evaluation, counted, repaired
from .objectives import Objective, Sum, judge
from .risks import Risk
from .weights import Weights

FORWARD_UP_TO = 2  # weights


@dataclasses.dataclass(frozen=True, eq=False)
class Losses:
    """The losses of a tuning, with their slopes.

    population: the machines that the tuning is on
    weights: the weights that are tuned, with their maps
    The other fields are those of `Tuning`.
    """

    population: Population
    weights: Weights
    scheme: Scheme
    task: Task
    trials: int
    risk: Risk
    mode: str
    truncate: int | None
    ceiling: float
    quantities: Mapping[str, Callable[[Trial], jax.Array]]
    lanes: int
    starts: int

    def _lanes_of(self, batch) -> int:
        """The lanes of `tiled` over a batch and, under `vmap`, over all starts."""
        of_a_device = -(-len(batch[0]) // jax.device_count())
        wide = usual_lanes() is None  # all machines of all starts in one tile, if they fit
        lanes = self.lanes if wide else min(self.lanes, of_a_device)
        return max(1, lanes // self.starts)

    def of_machine(
        self, machine: Machine, values: Mapping[str, Value], objective: Objective, *, key=None
    ) -> jax.Array:
        """() the objective of one machine, with these values of the weights by name."""
        last = None if self.truncate is None else min(self.truncate, self.trials)
        return judge(
            machine, replaced(self.scheme, values), self.task, self.trials, objective,
            key=key, ceiling=self.ceiling, save=Keep.of(self.quantities), last=last,
        )  # fmt: skip

    def risk_of(
        self, values: Mapping[str, Value], objective: Objective, population: Population, first: int
    ) -> jax.Array:
        """() the risk over machines with these weights, plus the nominal terms."""
        of_machines, of_nominal = split(objective)
        batch = population.batch(first)
        run = tiled(
            lambda values, one: self._of_one(values, one, of_machines, population),
            lanes=self._lanes_of(batch),
        )
        risk = self.risk(counted(run(values, batch)))
        if not of_nominal.parts:
            return risk
        return risk + self.of_machine(self.population.machine, values, of_nominal)

    def evaluation(
        self, objective: Objective, *, clip: float, steps: int
    ) -> tuple[Callable[[jax.Array], Evaluation], bool]:
        """A function that evaluates the loss over the machines of the population at z (P,).

        The second result is whether a program compiled for this processor does, see `native`.

            value = risk(l_1, ..., l_S) + nominal terms
            slope = sum_s (d risk / d l_s) (d l_s / d z) + slope of the nominal terms

        clip: bound on the slope of a machine, see `descent.repaired`
        steps: number of times that it will evaluate from each start
        """
        of_machines, of_nominal = split(objective)
        batch = self.population.batch()
        of_one = partial(self._slope_of_one, objective=of_machines)
        z = jnp.asarray(self.weights.starts(1, 0.0, 0)[0])
        runs = steps * self.starts * len(jax.tree.leaves(batch)[0]) * self.trials
        over_machines, native = fastest(
            of_one, z, batch, lanes=self._lanes_of(batch), steps=lambda: runs * self.task.N
        )

        def evaluate(z) -> Evaluation:
            losses, slopes, good = repaired(*over_machines(z, batch), clip)
            behind = jnp.min(losses) - 1.0  # where a machine without a slope takes no share of one
            omega = self.risk.weights(jnp.where(good, losses, behind)) * good
            omega = omega / jnp.where(jnp.sum(omega) > 0, jnp.sum(omega), 1.0)
            value, gradient = self.risk(losses), omega @ slopes
            residuals, jacobian = losses / len(losses) ** 0.5, slopes / len(losses) ** 0.5
            if of_nominal.parts:
                nominal = self.population.machine
                term, slope = jax.value_and_grad(
                    lambda z: self.of_machine(nominal, self.weights.at(z), of_nominal)
                )(z)
                value, gradient = value + term, gradient + slope
                residuals, jacobian = jnp.append(residuals, term), jnp.vstack([jacobian, slope])
            dropped = jnp.sum(~good).astype(losses.dtype)
            return Evaluation(value, gradient, residuals, jacobian, dropped)

        return evaluate, native

    def fitting_lanes(self, objective: Objective, machines: int) -> int:
        """The lanes that suit the backend and fit with slopes, for so many machines at each start.

        Raises ValueError where a single machine does not fit on a device.
        """
        usual = usual_lanes(bytes_of_trial(self.scheme, self.task), backward=not self._forward)
        if usual is not None:
            return usual
        of_one = partial(self._slope_of_one, objective=split(objective)[0])
        batch, z = self.population.batch(), jnp.zeros(len(self.weights.start))
        every = machines * self.starts
        return fitting_lanes(of_one, z, batch, every, held=every, what="Tuning")

    def _slope_of_one(self, z, one, *, objective: Objective):
        """The loss of one machine of a batch at z (P,), and its slope."""

        def loss(z, one):
            return self._of_one(self.weights.at(z), one, objective, self.population)

        return value_and_slope(loss, z, one, forward=self._forward)

    @property
    def _forward(self) -> bool:
        """Whether slopes are computed forward, which costs less for few weights."""
        few = self.mode == "auto" and len(self.weights.bijections) <= FORWARD_UP_TO
        return self.mode == "forward" or few

    def _of_one(self, values, one, objective: Objective, population: Population):
        """The objective of one machine of a batch."""
        machine, key = population.one_of(one)
        return self.of_machine(machine, values, objective, key=key)


def split(objective: Objective) -> tuple[Sum, Sum]:
    """The terms of an objective for every machine, and its terms for the nominal machine alone."""
    of_machines, of_nominal = (
        Sum(tuple(t for t in objective.terms if t[1].nominal is nominal))
        for nominal in (False, True)
    )
    return of_machines, of_nominal


def value_and_slope(f: Callable, z, *arguments, forward: bool):
    """f(z, *arguments) and its (P,) gradient, by P forward derivatives at once or one reverse pass.

    Under `vmap` over the arguments, the P forward derivatives stay outside of the batch, so that
    those of all members for one weight are adjacent in RAM, as the members themselves are.
    """
    return _forward(f)(z, arguments) if forward else jax.value_and_grad(f)(z, *arguments)


def _forward(f: Callable) -> Callable:
    def slopes(of, z):
        """The values of a function, any shape, and its derivatives, with P as the last axis."""
        if z.size == 1:
            value, slope = jax.jvp(of, (z,), (jnp.ones_like(z),))
            return value, slope[..., None]
        return jax.vmap(lambda tangent: jax.jvp(of, (z,), (tangent,)), out_axes=(None, -1))(
            jnp.eye(z.size, dtype=z.dtype)
        )

    def alone(z, arguments):
        return slopes(lambda z: f(z, *arguments), z)

    of_one = jax.custom_batching.custom_vmap(alone)

    @of_one.def_vmap
    def of_batch(axis_size, batched, z, arguments):
        axes = jax.tree.map(lambda is_batched: 0 if is_batched else None, batched)
        if axes[0] == 0:
            both = jax.vmap(alone, in_axes=axes)(z, arguments)
        else:
            both = slopes(lambda z: jax.vmap(lambda one: f(z, *one), axes[1:])(arguments), z)
        return both, (True, True)

    return of_one
