"""A Kalman filter over trials, which estimates the repetitive disturbance for a scheme."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp

from ..pytree.aliases import Array, Leaf
from ..pytree.fields import child, leaf, pytree
from ..pytree.needs import need_channels
from ..signals.task import Limit, Task, Trial
from .constrained_norm_optimal import ConstrainedNormOptimal
from .guards import Guard
from .norm_optimal import NormOptimal
from .riccati import System, answer
from .scheme import Memory, under
from .weights import counts_at_all, output_weighed


class Estimate(NamedTuple):
    """What `EstimatedDisturbance` knows.

    scheme: what the scheme within knows
    d: (N, n_y) estimate of the disturbance of y[1..N] [unit of y]
    std: (n_y,) standard deviation of the estimate [unit of y]; None with the stationary gain
    """

    scheme: Memory
    d: Array
    std: Array | None


@pytree
class EstimatedDisturbance(Guard):
    """Norm-optimal learning from the repetitive disturbance that a Kalman filter estimates.

    Over the trials the disturbance d of the output is a random walk, which each trial measures with
    noise (Norrlöf 2004, Asian Journal of Control 6; Schoellig, Mueller, D'Andrea 2012, Autonomous
    Robots 33; Degen, Schoellig 2014, CDC). G is the nominal model of the scheme within:

        d_{j+1} = d_j + w_j,    y_j - G u_j = d_j + v_j

    With white noises of standard deviations q of w and m of v, the Kalman filter is one recursion
    for each sample and channel. Its prior standard deviation s' and its gain kappa are the same at
    all samples, and do not depend on the data:

        s'^2 = s_j^2 + q^2,   kappa = s'^2 / (s'^2 + m^2),   s_{j+1}^2 = (1 - kappa) s'^2
        d^_{j+1} = d^_j + kappa (y_j - G u_j - d^_j)

    In the long run kappa = 2 / (1 + sqrt(1 + 4 m^2 / q^2)). The next input is norm-optimal for the
    estimate: the scheme within learns from the error r - G u_j - d^_{j+1} in place of r - y_j. With
    m = 0, that is the measured error, and the law is that of the scheme within. A larger m / q
    averages over more trials: noise that differs from trial to trial is learned less, and the
    disturbance later. Time and memory are linear in N.

    scheme: `NormOptimal` or `ConstrainedNormOptimal`, whose model is G
    process_std: () or (n_y,) q, change of the disturbance from trial to trial [unit of y]
    measurement_std: () or (n_y,) m, what differs between trials without being repetitive
        [unit of y]
    initial_std: () or (n_y,) s of the first trial, with d^ = 0 [unit of y]. None: the gain of the
        long run from the first trial on, a linear law that is the same in every trial

    Disturbances of the input count as what they make of the output. Raises ValueError for standard
    deviations out of range; `check` raises it for one that is not one number a channel.
    """

    scheme: NormOptimal | ConstrainedNormOptimal = child()
    process_std: Leaf = leaf(interval="(0, inf)")
    measurement_std: Leaf = leaf(interval="[0, inf)")
    initial_std: Leaf | None = leaf(default=None, interval="[0, inf)", optional=True)
    weighs = True

    def check(self, task: Task) -> None:
        super().check(task)
        need_channels(self, task.outputs, "process_std", "measurement_std", "initial_std")

    def frozen(self) -> EstimatedDisturbance:
        """The linear law that this one becomes, with the gain of the long run."""
        return self._with({"scheme": self.scheme.frozen(), "initial_std": None})

    def initial_memory(self, task: Task) -> Estimate:
        std = self.initial_std
        return Estimate(
            self.scheme.initial_memory(task),
            jnp.zeros((task.N, task.outputs)),
            None if std is None else jnp.broadcast_to(std, (task.outputs,)),
        )

    def learn(self, memory: Estimate, trial: Trial) -> Estimate:
        seen, d, std = self._filtered(memory, trial)
        return Estimate(self.scheme.learn(memory.scheme, seen), d, std)

    def limits(self, task: Task, memory: Estimate, trial: Trial) -> dict[str, Limit]:
        seen = self._filtered(memory, trial)[0]
        return under("scheme", self.scheme.limits(task, memory.scheme, seen))

    def _filtered(self, memory: Estimate, trial: Trial) -> tuple[Trial, Array, Array | None]:
        """The trial with the output G u + d^ of the new estimate, d^, and its deviation."""
        model = self.scheme.model.sampled(trial.dt)
        A, B, C = (jnp.asarray(M) for M in (model.A, model.B, model.C))
        _, without = answer(System(A, B, C @ A, C @ B), trial.u)
        kappa, std = self._gain(memory.std)
        if trial.weight is not None:
            start = trial.y[:1]  # which no input can reach
            without = output_weighed(trial, jnp.concatenate([start, without]))[1:]
        news = (trial.y[1:] - without - memory.d) * counts_at_all(trial)
        # y less the share of the news that is not believed: exactly y where the gain is 1
        seen = trial._replace(y=trial.y.at[1:].add(-(1 - kappa) * news))
        return seen, memory.d + kappa * news, std

    def _gain(self, std: Array | None) -> tuple[Array, Array | None]:
        """The gain of the filter, and the standard deviation of the new estimate."""
        q, m = jnp.asarray(self.process_std), jnp.asarray(self.measurement_std)
        if std is None:
            return 2 / (1 + jnp.hypot(1.0, 2 * m / q)), None
        prior = jnp.hypot(std, q)
        return 1 / (1 + (m / prior) ** 2), prior * m / jnp.hypot(prior, m)
