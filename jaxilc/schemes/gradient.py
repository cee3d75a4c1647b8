"""Learning down the gradient of a quadratic cost, by a model of any kind or by experiments."""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..filters.zero_phase import Filter
from ..plants import Plant, motion
from ..plants.structure import obstacle
from ..pytree.aliases import Array, Function, Leaf, Tree
from ..pytree.fields import child, leaf, pytree, static
from ..pytree.needs import known, need_channels, need_numbers
from ..signals.task import Task, Trial
from .quadratic_cost import (
    WithModel,
    largest_eigenvalue,
    need_channels_of,
    need_weight,
    need_weights,
    symmetric_of,
    weights_of,
)
from .scheme import Scheme, limited
from .weights import answers_weighed


class GradientMemory(NamedTuple):
    """What `GradientILC` knows.

    u: (N, n_u) next input [unit of u]
    step: () step that was taken after the last trial
    share: () this step as a share of its bound: step h / 2, with the h that was found; 0 before
    beyond: () number of trials after which the step was at its bound or beyond it, share >= 1
    """

    u: Array
    step: Array
    share: Array
    beyond: Array


@pytree
class Ready:
    """A model prepared for a sample time.

    curvature: () largest curvature h of the cost; None where it differs from trial to trial
    dt: sample time [s]
    """

    curvature: Leaf | None = leaf(default=None, optional=True)
    dt: float = static(interval="(0, inf)", default=1.0)


@pytree
class GradientILC(Scheme):
    """Gradient learning (Furuta and Yamakita 1987; Owens, Hatonen and Daley 2009).

    The input goes down the gradient of the cost J = (|e|^2_Wq + |u|^2_Ws) / 2 of the last trial:

        u_{j+1} = u_j + step (G*_j W_q e_j - W_s u_j)

    G_j is the derivative of the model's output by its input, along the motion of the model under
    u_j, and G*_j is its transpose. Both are taken anew after each trial, by one pass forward and
    one backward through the model, so no matrix is made, and time is linear in N. For a linear
    model they are the same in every trial, and then the law is linear: theory reads that off the
    model's own program.

    Let h be the largest eigenvalue of the curvature G* W_q G + W_s. On a linear machine that is the
    model, the cost falls in every trial for 0 < step < 2 / h; on a nonlinear one that is true of
    small steps. h is found by ten steps of the Lanczos process from a fixed start. What they give
    is never above h, and mostly within a percent of it. For a linear model that is done once, and
    else after each trial; the memory then says how the step stands to its bound 2 / h, which moves
    with the trajectory. Other machines than the model are for `theory.certify`.

    model: nominal plant of n_u inputs and n_y outputs, linear or not, of the package or the user's,
        which starts from its own initial state. Under feedback it is the model of the closed loop,
        from the learned input to the output
    step: () the step; None: 1 / h, with the h that was found
    w_q: () or (n_y,) or (n_y, n_y), positive semidefinite
    w_s: () or (n_u,) or (n_u, n_u), positive semidefinite; it forgets, and leaves an error
        Weights must be symmetric except for rounding; their symmetric part is used.
    limit: () or (n_u,) largest |u| that is learned [unit of u]; None: no limit
    solved: leave None

    `check` raises ValueError for a model of other channels or another sample time, for a model
    whose answer is not finite or, if it is linear, zero, and for a step of 2 / h or more, with h
    found at the motion without input. A step that passes may still be beyond the bound elsewhere,
    or by what the Lanczos process missed: see `share` and `beyond` of the memory.
    """

    model: Plant = child()
    step: Leaf | None = leaf(default=None, interval="(0, inf)", optional=True)
    w_q: Leaf = leaf(default=1.0)
    w_s: Leaf = leaf(default=0.0)
    limit: Leaf | None = leaf(default=None, interval="(0, inf)", optional=True)
    solved: Ready | None = child(default=None)
    weighs = True
    clips = ("limit",)

    def __post_init__(self) -> None:
        need_numbers(self, "step")
        need_weights(self, "w_q", "w_s")

    @property
    def of_one_length(self) -> bool:
        """Whether the step, which follows from the curvature, belongs to a number of samples."""
        return self.step is None

    def check(self, task: Task) -> None:
        need_answers(self, task)
        need_channels(self, task.inputs, "limit")
        if known(self):
            with jax.ensure_compile_time_eval():
                self._need_step(float(_curvature_at_rest(self, task.N, task.dt)), task)

    def _need_step(self, h: float, task: Task) -> None:
        """Raises ValueError where the largest curvature h at rest admits no step, or not this."""
        name = type(self.model).__name__
        if not np.isfinite(h):
            raise ValueError(
                f"GradientILC: the model ({name}) answers with numbers that are not finite within "
                f"N = {task.N} samples; allowed is a model that is stable, under feedback that of "
                "the closed loop"
            )
        if h <= 0 and not varies(self.model, task.N, task.dt):
            raise ValueError(
                f"GradientILC: within N = {task.N} samples the model ({name}) does not answer its "
                "input, or w_q gives its answer no weight; allowed is a model whose output depends "
                "on its input, with a weight above 0"
            )
        if self.step is not None and float(self.step) * h >= 2:
            raise ValueError(
                f"GradientILC: step = {float(self.step):.6g} is beyond its bound; allowed is a "
                f"step below 2 / |G|^2 = {2 / h:.6g}, with the largest gain |G| = {h**0.5:.6g} of "
                "the model, in the norms of the weights; None takes half of it"
            )

    def initial_memory(self, task: Task) -> GradientMemory:
        none = jnp.zeros(())
        return GradientMemory(jnp.zeros((task.N, task.inputs)), none, none, none)

    def prepared(self, task: Task) -> GradientILC:
        return self._prepared(task.N, task.dt)

    def _prepared(self, N: int, dt: float) -> GradientILC:
        if self.solved is not None:
            return self
        h = None if varies(self.model, N, dt) else _curvature_at_rest(self, N, dt)
        return dataclasses.replace(self, model=self.model.sampled(dt), solved=Ready(h, dt))

    def learn(self, memory: GradientMemory, trial: Trial) -> GradientMemory:
        u, e = trial.u, trial.e[1:]
        ready = self._prepared(len(u), trial.dt)
        found: Tree = ready.solved
        Q, S = weights_of(ready, "w_q", "w_s")
        # A linear model answers alike at any input, so a diverged one has no part in it.
        at = u if found.curvature is None else jnp.zeros_like(u)
        push, pull = answers_weighed(*answers(ready.model, at, found.dt), trial)
        known = found.curvature is not None and trial.weight is None
        h = found.curvature if known else _curvature(push, pull, Q, S, u)
        step = jnp.where(h > 0, 1.0, 0.0) / jnp.where(h > 0, h, 1.0)
        step = step if self.step is None else self.step
        share = step * h / 2
        return GradientMemory(
            limited(u + step * (pull(e @ Q) - u @ S), self.limit),
            step,
            share,
            memory.beyond + jnp.where(share >= 1, 1.0, 0.0),
        )


# The model
# --------------------------------------------------------------------------------------------------


def answers(model: Plant, u: Array, dt: float) -> tuple[Function, Function]:
    """G and G*, as functions: the derivative of y[1..N] (N, n_y) at the input u (N, n_u)."""
    _, push = jax.linearize(lambda u: motion(model, u, dt)[1:], u)
    transposed = jax.linear_transpose(push, u)
    return push, lambda e: transposed(e)[0]


def _curvature(push: Function, pull: Function, Q: Array, S: Array, u: Array) -> Array:
    """() the largest eigenvalue of G* W_q G + W_s, from below."""
    return largest_eigenvalue(lambda v: pull(push(v) @ Q) + v @ S, u)


@partial(jax.jit, static_argnames=("N", "dt"))
def _curvature_at_rest(scheme: GradientILC, N: int, dt: float) -> Array:
    """() the largest curvature where the model is not driven."""
    u = jnp.zeros((N, scheme.model.n_u))
    push, pull = answers(scheme.model, u, dt)
    Q, S = weights_of(scheme, "w_q", "w_s")
    return _curvature(push, pull, Q, S, u)


def varies(model: Plant, N: int, dt: float) -> bool:
    """Whether the derivative of the model depends on its input, as far as its program tells."""
    return bool(obstacle(lambda model, u: motion(model, u, dt), model, jnp.zeros((N, model.n_u))))


def need_answers(scheme: WithModel, task: Task) -> None:
    """Raises ValueError where the model is of another number of channels or samples, or rate."""
    model = scheme.model
    need_channels_of(scheme, task)
    model.check(task)
    u = jax.ShapeDtypeStruct((task.N, model.n_u), jnp.zeros(()).dtype)
    y = jax.eval_shape(lambda model, u: motion(model, u, task.dt), model, u)
    if y.shape != (task.N + 1, model.n_y):
        raise ValueError(
            f"{type(scheme).__name__}: the model ({type(model).__name__}) answers with the shape "
            f"{y.shape}; allowed is (N+1, n_y) = ({task.N + 1}, {model.n_y})"
        )


class ExperimentMemory(NamedTuple):
    """What `ModelFreeGradient` knows.

    u: (N, n_u) what the next experiment plays [unit of u]
    learned: (N, n_u) learned input u_j of this step [unit of u]
    error: (N, n_y) weighted errors W_q e_j[1..N] of the trial that played it
    total: (N, n_u) what the experiments of this step have given so far: in the end alpha G* W_q e_j
    experiment: () number of the next experiment of this step; 0 is the trial that plays u_j
    steps: () number of learning steps that are complete
    """

    u: Array
    learned: Array
    error: Array
    total: Array
    experiment: Array
    steps: Array


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
    elementwise = True

    def __post_init__(self) -> None:
        need_numbers(self, "step", "amplitude")
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
        error = jnp.where(first, trial.e[1:] @ symmetric_of(self.w_q, self.outputs), memory.error)
        learned = jnp.where(first, trial.u, memory.learned)
        total = jnp.where(first, 0.0, memory.total) + trial.y[:0:-1] @ self._share(now, memory).T
        new = learned + self.step / self.amplitude * total
        new = new if self.filter is None else self.filter(new, trial.dt)
        learned = jnp.where(last, new, learned)
        following = jnp.where(last, 0.0, now + 1)
        base = learned if self.about == "trial" else jnp.mean(learned, axis=0, keepdims=True)
        excited = base + self.amplitude * error[::-1] @ self._pattern(following, memory).T
        u = limited(jnp.where(last, learned, excited), self.limit)
        steps = memory.steps + jnp.where(last, 1.0, 0.0)
        return ExperimentMemory(u, learned, error, total, following, steps)

    def _pattern(self, experiment: Array, memory: ExperimentMemory) -> Array:
        """(n_u, n_y) the pattern M of an experiment; zero for one that plays the baseline alone."""
        shape = self.inputs, self.outputs
        if self.method == "exact":
            pairs = jnp.arange(1.0, self.patterns + 1).reshape(shape)
            return jnp.where(pairs == experiment, 1.0, 0.0)
        return jnp.where(experiment == 1, self._signs(memory), 0.0)

    def _share(self, experiment: Array, memory: ExperimentMemory) -> Array:
        """(n_u, n_y) the weights with which the output of an experiment counts in the sum.

        The baseline counts against each of the patterns.
        """
        shape = self.inputs, self.outputs
        all_patterns = jnp.ones(shape) if self.method == "exact" else self._signs(memory)
        baseline = 0 if self.about == "trial" else self.trials_a_step - 1
        against = jnp.where(experiment == baseline, 1.0, 0.0) * all_patterns
        return self._pattern(experiment, memory) - against

    def _signs(self, memory: ExperimentMemory) -> Array:
        """(n_u, n_y) the random signs of this step, or I."""
        if self.method == "joint":
            return jnp.eye(self.inputs)
        key = jax.random.fold_in(jax.random.key(self.seed), memory.steps.astype(int))
        return jnp.where(jax.random.bernoulli(key, shape=(self.inputs, self.outputs)), 1.0, -1.0)
