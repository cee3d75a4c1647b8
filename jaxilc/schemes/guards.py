"""When to learn, and from what: the stop rule and the ladder (Li 2020, sections 4 and 6.2), around
any scheme that learns.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from ..pytree.fields import Leaf, child, leaf, pytree, static
from ..pytree.needs import need_channels
from ..signals.task import Task, Trial
from .scheme import Part, Scheme, with_all_parts
from .wrapper import Wrapper


class Guard(Wrapper):
    """A wrapper that decides when its scheme learns, and from what; within a trial it is that
    scheme. Its memory holds the memory of the scheme as its field `scheme`.
    """

    def parts(self, task: Task, memory) -> dict[str, Part]:
        return {"scheme": Part(self.scheme, task, memory.scheme)}

    def frozen(self) -> Scheme:
        return self.scheme.frozen()


class StopMemory(NamedTuple):
    """scheme: memory of the scheme, of the trial to come;  frozen: () 1 once learning has stopped,
    else 0
    trials: () trials looked at until it stopped, that one included
    best: memory that brought about the best trial so far;  best_rms: () its error; both None
    without `growth`
    """

    scheme: Any
    frozen: jax.Array
    trials: jax.Array
    best: Any
    best_rms: Any


@pytree
class StopWhen(Guard):
    """Learning that stops for good once a trial is good enough, or before the error grows (Li 2020,
    Fig. 19 and section 6.3).

        max |e_j| <= max_error and RMS(e_j) <= rms     keep the memory that brought about trial j
        RMS(e_j) > (1 + growth) min_{i<j} RMS(e_i)     go back to that of the best trial

    over the samples k = 1..N. From then on each trial plays back the same schedule; noise is not
    looked at again.
    max_error, rms: () or (n_y,) tolerances [unit of y], None for none; every output must meet those
    that are given
    growth: () >= 0, None for never; its RMS is over all outputs together, and a trial that is not
        finite has grown
    What is compared carries no gradient, so the gradient by a tolerance is zero. The gradient of a
    frozen trial is that of the memory it is frozen with: of the trials learned from until then, and
    nothing of those that were discarded.
    Raises ValueError if there is nothing to stop it.
    """

    scheme: Scheme = child()
    max_error: Leaf | None = leaf(default=None, interval="(0, inf)", optional=True)
    rms: Leaf | None = leaf(default=None, interval="(0, inf)", optional=True)
    growth: Leaf | None = leaf(default=None, interval="[0, inf)", optional=True)

    def __post_init__(self):
        if self.max_error is None and self.rms is None and self.growth is None:
            raise ValueError(
                "StopWhen: max_error, rms and growth are all None; at least one must be given"
            )

    def check(self, task: Task) -> None:
        need_channels(self, task.outputs, "max_error", "rms")
        _need_numbers(self, "growth")
        super().check(task)

    def initial_memory(self, task: Task) -> StopMemory:
        start = self.scheme.initial_memory(task)
        best = (None, None) if self.growth is None else (start, jnp.full((), jnp.inf, float))
        return StopMemory(start, jnp.zeros(()), jnp.zeros(()), *best)

    def learn(self, memory: StopMemory, trial: Trial) -> StopMemory:
        e = lax.stop_gradient(trial.e[1:])
        frozen = memory.frozen > 0
        stay = frozen | self._within_tolerance(e)
        following = _choose(stay, memory.scheme, self.scheme.learn(memory.scheme, trial))
        stop, best, best_rms = stay, None, None
        if self.growth is not None:
            rms = _root_mean_square(e)
            grown = ~stay & ~(rms <= (1 + lax.stop_gradient(self.growth)) * memory.best_rms)
            following = _choose(grown, memory.best, following)
            better = rms < memory.best_rms
            best, best_rms = (
                _choose(better, memory.scheme, memory.best),
                jnp.where(better, rms, memory.best_rms),
            )
            stop = stay | grown
        trials = memory.trials + jnp.where(frozen, 0.0, 1.0)
        return StopMemory(following, stop.astype(memory.frozen.dtype), trials, best, best_rms)

    def _within_tolerance(self, e):
        """() whether every tolerance that is given is met."""
        met = []
        if self.max_error is not None:
            met.append(jnp.max(jnp.abs(e), axis=0) <= self.max_error)
        if self.rms is not None:
            met.append(jnp.sqrt(jnp.mean(e**2, axis=0)) <= self.rms)
        return jnp.all(jnp.stack(met)) if met else jnp.asarray(False)


class Sums(NamedTuple):
    """Sums over the repeats so far of y (N+1, n_y), u (N, n_u) and the signals by name, each (N,
    ...).
    """

    y: jax.Array
    u: jax.Array
    signals: dict[str, jax.Array]


class LadderMemory(NamedTuple):
    """scheme: memory of the scheme;  count: () repeats so far of the present schedule;  sums: over
    them
    gain: () on the error;  rms: () of the mean trial last learned from, inf before; both None where
    the gain is fixed
    """

    scheme: Any
    count: jax.Array
    sums: Sums
    gain: Any
    rms: Any


@pytree
class Ladder(Guard):
    """Each schedule is run R times, and learned from once, by the mean trial.

    This is ladder-type learning (Li 2020, section 6.2).
    Noise that does not repeat enters what is learned with 1/sqrt(R) of its size. Between, the
    memory of the scheme stays. With `slow` the gain of learning adapts: where the mean trial's RMS
    error has fallen since the last one, but to more than `slow` of it, the gain grows, and stays in
    force:

        slow < RMS_i / RMS_{i-1} <= 1:    gain' = min(growth_of_gain gain, largest)

    from gain = 1.

    The paper prints no rule. An error that has *risen* leaves the gain alone here, since more gain
    is not what it lacks. For any scheme the gain is on the error it is shown, y' = r - gain (r -
    y). An adaptive law takes that for a plant that reacts differently, and adapts to it as well.

    repeats: R;  growth_of_gain: () >= 1;  largest: () >= 1
    slow: () in (0, 1), None for a gain of 1
    What is compared carries no gradient, so the gradient by `slow` is zero.
    Raises ValueError, for an adapted gain, around FFDL-MFAILC, which compares the running trial
    with the output it was shown.
    """

    scheme: Scheme = child()
    repeats: int = static(interval="[1, 1e9]", whole=True)
    growth_of_gain: Leaf = leaf(default=1.2, interval="[1, inf)")
    largest: Leaf = leaf(default=2.0, interval="[1, inf)")
    slow: Leaf | None = leaf(default=None, interval="(0, 1)", optional=True)

    @property
    def trials_a_step(self) -> int:
        return self.repeats * self.scheme.trials_a_step

    def check(self, task: Task) -> None:
        _need_numbers(self, "growth_of_gain", "largest", "slow")
        for scheme, _, _ in with_all_parts(self.scheme, task):
            comparing = [name for name in scheme.compares if getattr(scheme, name)]
            if self.slow is not None and comparing:
                name = comparing[0]
                raise ValueError(
                    f"Ladder: slow = {self.slow} with {name} = {getattr(scheme, name)} of "
                    f"{type(scheme).__name__}, which compares outputs within the trial; allowed "
                    f"are None, or {name} = 0"
                )
        super().check(task)

    def initial_memory(self, task: Task) -> LadderMemory:
        signals = jax.eval_shape(lambda: self.scheme.signals(self.scheme.initial_state(task)))
        blank = {name: jnp.zeros((task.N, *s.shape), s.dtype) for name, s in signals.items()}
        sums = Sums(jnp.zeros((task.N + 1, task.outputs)), jnp.zeros((task.N, task.inputs)), blank)
        adapted = (
            (None, None) if self.slow is None else (jnp.ones(()), jnp.full((), jnp.inf, float))
        )
        return LadderMemory(self.scheme.initial_memory(task), jnp.zeros(()), sums, *adapted)

    def learn(self, memory: LadderMemory, trial: Trial) -> LadderMemory:
        # a measured trial may lack signals; the scheme shall see that it does
        names = [name for name in memory.sums.signals if name in trial.signals]
        now = Sums(
            trial.y, trial.u, memory.sums.signals | {name: trial.signals[name] for name in names}
        )
        sums = _choose(memory.count == 0, now, jax.tree.map(jnp.add, memory.sums, now))
        count = memory.count + 1
        full = count >= self.repeats
        y, u, signals = jax.tree.map(lambda total: total / self.repeats, sums)
        mean, gain, rms = (
            trial._replace(y=y, u=u, signals={name: signals[name] for name in names}),
            None,
            None,
        )
        if self.slow is not None:
            now_rms = _root_mean_square(lax.stop_gradient(mean.e[1:]))
            slowly = (now_rms > lax.stop_gradient(self.slow) * memory.rms) & (now_rms <= memory.rms)
            gain = jnp.where(
                full & slowly,
                jnp.minimum(self.growth_of_gain * memory.gain, self.largest),
                memory.gain,
            )
            rms = jnp.where(full, now_rms, memory.rms)
            mean = mean._replace(y=mean.r - gain * mean.e)
        learned = _choose(full, self.scheme.learn(memory.scheme, mean), memory.scheme)
        return LadderMemory(learned, jnp.where(full, 0.0, count), sums, gain, rms)


def _need_numbers(scheme: Scheme, *names: str) -> None:
    """Raises ValueError unless each named field is a single number, or absent."""
    for name in names:
        value = getattr(scheme, name)
        if value is not None and value.shape != ():
            raise ValueError(
                f"{type(scheme).__name__}: {name} has shape {value.shape}; allowed is ()"
            )


def _choose(condition, one, other):
    """The one tree or the other, leaf by leaf."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), one, other)


def _root_mean_square(e):
    """() over all samples and outputs."""
    return jnp.sqrt(jnp.mean(e**2))
