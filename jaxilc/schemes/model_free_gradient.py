"""Gradient learning without a model, by experiments with the time-reversed error."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from ..filters.zero_phase import Filter
from ..pytree.fields import Leaf, child, leaf, pytree, static
from ..pytree.needs import need_channels
from ..signals.task import Limit, Task, Trial
from .quadratic_cost import matrix_of, need_weight
from .scheme import Scheme, limit_of, limited


class ExperimentMemory(NamedTuple):
    """What `ModelFreeGradient` knows.

    u: (N, n_u) what the next experiment plays [unit of u]
    learned: (N, n_u) learned input u_j of this step [unit of u]
    error: (N, n_y) weighted errors W_q e_j[1..N] of the trial that played it
    total: (N, n_u) what the experiments of this step have given so far: in the end alpha G* W_q e_j
    experiment: () number of the next experiment of this step; 0 is the trial that plays u_j
    steps: () number of learning steps that are complete
    """

    u: jax.Array
    learned: jax.Array
    error: jax.Array
    total: jax.Array
    experiment: jax.Array
    steps: jax.Array


@pytree
class ModelFreeGradient(Scheme):
    """Gradient learning by time-reversed experiments on the machine itself, without a model.

        u_{j+1} = Q(u_j + step G* W_q e_j)

    For a linear machine that is the same at each sample, of one input and one output, the transpose
    G* is the machine with time reversed, so that an experiment gives it (Ye and Wang 2005; Bolder,
    Kleinendorst and Oomen 2018). With S, which reverses the samples, and a baseline b,

        G* e = S (y(b + alpha S e) - y(b)) / alpha

    For more channels, patterns M of shape (n_u, n_y) distribute the reversed error to the inputs,
    and the answers in the same way:

        G* e ~ sum_M S M (y(b + alpha M S e) - y(b)) / alpha

    `exact` runs an experiment for each input and each output, with M = 1 at this pair and 0 else;
    then the equation is exact. `stochastic` runs a single one with random signs M in each step;
    then it is true in the mean (Aarnoudse and Oomen 2022, arXiv 2209.05139). `joint` runs a single
    one with M = I, each error into the input of its own number: true only where the answer of
    output i to input j is that of output j to input i. It is what IterativeLearningControl2.jl
    does.

    A step consists of `trials_a_step` experiments. The first one plays u_j: its error is e_j, and
    it alone says how well was learned. The next ones play the reversed error. Their errors are not
    those of u_j, also in metrics, tables and figures, so look at the trials 1, 1 + trials_a_step,
    1 + 2 trials_a_step, and so on. With `about` = "trial", b = u_j, and y(b) is the output of the
    first experiment. With "mean", b is the mean of u_j over the samples, and the last experiment
    plays b itself (Huo, Freeman and Liu 2020): around u_j a nonlinear machine is linearised where
    it works, around the mean it moves less. Before anything is learned both b are zero, and with
    "mean" the last experiment repeats the first.

    Under `WithFeedback` each experiment adds to the feedback, and G is the closed loop. Everything
    that repeats cancels in the difference. Noise of standard deviation s of each output does not:
    for `exact` it enters the learned input with (step / alpha) sqrt(2 n_y) s in each step. So alpha
    should be as large as the machine permits. `Ladder` around the scheme averages each experiment.

    step: () as for `GradientILC`; without a model its bound 2 / |G|^2 is not known
    amplitude: () alpha, factor on the reversed error [unit of u per unit of y]
    w_q: () or (n_y,) or (n_y, n_y), positive semidefinite
    limit: () or (n_u,) largest |u| that is learned and played [unit of u]; None: no limit. Where it
        clips the reversed error, the gradient is that of what is left of it: choose alpha so that
        it does not
    filter: zero-phase filter Q of what is learned; None: none. A `Filtered` around the scheme is
        refused, since it would filter the experiments
    about: "trial" or "mean", see above
    method: "exact", "stochastic" or "joint", see above
    inputs, outputs: n_u and n_y of the task, which say how many experiments a step takes
    seed: of the random signs, which are the same for each machine of a batch

    `check` raises ValueError for a task of other channels.
    """

    step: Leaf = leaf(interval="(0, inf)")
    amplitude: Leaf = leaf(default=1.0, interval="(0, inf)")
    w_q: Leaf = leaf(default=1.0)
    limit: Leaf | None = leaf(default=None, interval="(0, inf)", optional=True)
    filter: Filter | None = child(default=None)
    about: str = static(default="trial", choices=("trial", "mean"))
    method: str = static(default="exact", choices=("exact", "stochastic", "joint"))
    inputs: int = static(default=1, interval="[1, 1e6]", whole=True)
    outputs: int = static(default=1, interval="[1, 1e6]", whole=True)
    seed: int = static(default=0, interval="[0, 1e9]", whole=True)
    clips = ("limit",)
    experiments = True

    def __post_init__(self):
        for name in ("step", "amplitude"):
            shape = getattr(self, name).shape
            if shape:
                raise ValueError(
                    f"ModelFreeGradient: {name} has shape {shape}; allowed is one number"
                )
        need_weight("ModelFreeGradient", "w_q", self.w_q, self.outputs)
        if self.method == "joint" and self.inputs != self.outputs:
            raise ValueError(
                f"ModelFreeGradient: method = 'joint' with inputs = {self.inputs} and outputs = "
                f"{self.outputs}; allowed are as many of both, or another method"
            )

    @property
    def patterns(self) -> int:
        """The number of experiments of a step that play the reversed error."""
        return self.inputs * self.outputs if self.method == "exact" else 1

    @property
    def trials_a_step(self) -> int:
        return 1 + self.patterns + (self.about == "mean")

    def check(self, task: Task) -> None:
        for name, of_task in (("inputs", task.inputs), ("outputs", task.outputs)):
            if getattr(self, name) != of_task:
                raise ValueError(
                    f"ModelFreeGradient: {name} = {getattr(self, name)} but the task has "
                    f"{of_task}; allowed is {name} = {of_task}"
                )
        need_channels(self, task.inputs, "limit")
        if self.filter is not None:
            self.filter.check(task.N, task.dt)

    def initial_memory(self, task: Task) -> ExperimentMemory:
        u, e = jnp.zeros((task.N, task.inputs)), jnp.zeros((task.N, task.outputs))
        return ExperimentMemory(u, u, e, u, jnp.zeros(()), jnp.zeros(()))

    def learn(self, memory: ExperimentMemory, trial: Trial) -> ExperimentMemory:
        now = memory.experiment
        first, last = now == 0, now == self.trials_a_step - 1
        W = matrix_of(self.w_q, self.outputs)
        error = jnp.where(first, trial.e[1:] @ ((W + W.T) / 2), memory.error)
        learned = jnp.where(first, trial.u, memory.learned)
        total = jnp.where(first, 0.0, memory.total) + trial.y[:0:-1] @ self._share(now, memory).T
        learned = jnp.where(
            last, self._filtered(learned + self.step / self.amplitude * total, trial.dt), learned
        )
        following = jnp.where(last, 0.0, now + 1)
        base = learned if self.about == "trial" else jnp.mean(learned, axis=0, keepdims=True)
        excited = base + self.amplitude * error[::-1] @ self._pattern(following, memory).T
        u = limited(jnp.where(last, learned, excited), self.limit)
        steps = memory.steps + jnp.where(last, 1.0, 0.0)
        return ExperimentMemory(u, learned, error, total, following, steps)

    def limits(self, task: Task, memory: ExperimentMemory, trial: Trial) -> dict[str, Limit]:
        return limit_of(self.unlimited().learn(memory, trial).u, self.limit)

    def _pattern(self, experiment, memory: ExperimentMemory) -> jax.Array:
        """(n_u, n_y) the pattern M of an experiment; zero for one that plays the baseline alone."""
        shape = self.inputs, self.outputs
        if self.method == "exact":
            pairs = jnp.arange(1.0, self.patterns + 1).reshape(shape)
            return jnp.where(pairs == experiment, 1.0, 0.0)
        return jnp.where(experiment == 1, self._signs(memory), 0.0)

    def _share(self, experiment, memory: ExperimentMemory) -> jax.Array:
        """(n_u, n_y) the weights with which the output of an experiment counts in the sum.

        The baseline counts against each of the patterns.
        """
        shape = self.inputs, self.outputs
        all_patterns = jnp.ones(shape) if self.method == "exact" else self._signs(memory)
        baseline = 0 if self.about == "trial" else self.trials_a_step - 1
        against = jnp.where(experiment == baseline, 1.0, 0.0) * all_patterns
        return self._pattern(experiment, memory) - against

    def _signs(self, memory: ExperimentMemory) -> jax.Array:
        """(n_u, n_y) the random signs of this step, or I."""
        if self.method == "joint":
            return jnp.eye(self.inputs)
        key = jax.random.fold_in(jax.random.key(self.seed), memory.steps.astype(int))
        return jnp.where(jax.random.bernoulli(key, shape=(self.inputs, self.outputs)), 1.0, -1.0)

    def _filtered(self, u, dt: float) -> jax.Array:
        return u if self.filter is None else self.filter(u, dt)
