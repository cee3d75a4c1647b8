"""Wrappers that decide when a scheme learns and from which trial (Li 2020, sections 4 and 6.2)."""

from __future__ import annotations

from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax import lax

from ..pytree.aliases import Array, Leaf, Tree, Value
from ..pytree.fields import child, leaf, pytree, static
from ..pytree.needs import need_channels, need_numbers
from ..signals.task import Task, Trial
from .scheme import Memory, Part, Scheme, Wrapper, need_no_experiments, silent, with_all_parts
from .weights import need_no_true_outputs

T = TypeVar("T")


class Guard(Wrapper):
    """A wrapper that decides when its scheme learns, and from which trial or from which part of it.

    Within a trial it does the same as its scheme. The field `scheme` of its memory is the memory of
    the scheme.
    """

    def parts(self, task: Task, memory: Memory) -> dict[str, Part]:
        return {"scheme": Part(self.scheme, task, memory.scheme)}

    def frozen(self) -> Scheme:
        return self.scheme.frozen()


class StopMemory(NamedTuple):
    """The memory of `StopWhen`.

    scheme: memory of the scheme for the next trial
    frozen: () 1 if learning has stopped, else 0
    trials: () number of trials that were examined, including the one after which learning stopped
    best: memory with which the best trial so far was run; None without `growth`
    best_rms: () RMS error of that trial [unit of y]; None without `growth`
    """

    scheme: Memory
    frozen: Array
    trials: Array
    best: Memory
    best_rms: Tree


@pytree
class StopWhen(Guard):
    """Learning stops when a trial is good enough or the error grows (Li 2020, Fig. 19, sec. 6.3).

        max |e_j| <= max_error and RMS(e_j) <= rms     keep the memory with which trial j was run
        RMS(e_j) > (1 + growth) min_{i<j} RMS(e_i)     return to the memory of the best trial

    The maximum and the RMS are over the samples k = 1..N. After that each trial plays back the same
    schedule, and later errors are not examined any more. A sample that was not measured counts with
    the error zero: a trial that ended early, or lost samples, may pass for a good one, and with
    `growth` the whole ones after it for grown ones. The jerks that `AtSamples` shows do not count.

    scheme: the scheme whose learning is stopped
    max_error: () or (n_y,) tolerance of the largest error [unit of y]; None: no such tolerance
    rms: () or (n_y,) tolerance of the RMS error [unit of y]; None: no such tolerance
        Every output must meet each tolerance that is given.
    growth: () >= 0, relative growth of the RMS error over all outputs together; None: growth never
        stops the learning. A trial that is not finite counts as grown.

    The comparisons carry no gradient, so the gradient with respect to a tolerance is zero. The
    gradient of a trial after the stop is that of the memory that was kept: it includes the trials
    from which this memory was learned, and none of the discarded trials.
    Raises ValueError if max_error, rms and growth are all None.
    """

    scheme: Scheme = child()
    max_error: Leaf | None = leaf(default=None, interval="(0, inf)", optional=True)
    rms: Leaf | None = leaf(default=None, interval="(0, inf)", optional=True)
    growth: Leaf | None = leaf(default=None, interval="[0, inf)", optional=True)

    def __post_init__(self) -> None:
        if self.max_error is None and self.rms is None and self.growth is None:
            raise ValueError(
                "StopWhen: max_error, rms and growth are all None; at least one must be given"
            )

    def check(self, task: Task) -> None:
        need_channels(self, task.outputs, "max_error", "rms")
        need_numbers(self, "growth")
        need_no_experiments(self, task, "whose errors say nothing of what it has learned")
        super().check(task)

    def initial_memory(self, task: Task) -> StopMemory:
        start = self.scheme.initial_memory(task)
        best = (None, None) if self.growth is None else (start, jnp.full((), jnp.inf, float))
        return StopMemory(start, jnp.zeros(()), jnp.zeros(()), *best)

    def learn(self, memory: StopMemory, trial: Trial) -> StopMemory:
        e = lax.stop_gradient(_errors(trial))
        frozen = memory.frozen > 0
        stay = frozen | self._within_tolerance(e)
        following = _choose(stay, memory.scheme, self.scheme.learn(memory.scheme, trial))
        stop, best, best_rms = stay, None, None
        if self.growth is not None:
            rms = _root_mean_square(e)
            grown = ~stay & ~(rms <= (1 + lax.stop_gradient(self.growth)) * memory.best_rms)
            following = _choose(grown, memory.best, following)
            better = rms < memory.best_rms
            best = _choose(better, memory.scheme, memory.best)
            best_rms = jnp.where(better, rms, memory.best_rms)
            stop = stay | grown
        trials = memory.trials + jnp.where(frozen, 0.0, 1.0)
        return StopMemory(following, stop.astype(memory.frozen.dtype), trials, best, best_rms)

    def _within_tolerance(self, e: Array) -> Array:
        """Whether the error e (N, n_y) meets every tolerance that is given, as ()."""
        met = []
        if self.max_error is not None:
            most = jnp.atleast_1d(self.max_error)[: e.shape[1]]
            met.append(jnp.max(jnp.abs(e), axis=0) <= most)
        if self.rms is not None:
            most = jnp.atleast_1d(self.rms)[: e.shape[1]]
            met.append(jnp.sqrt(jnp.mean(e**2, axis=0)) <= most)
        return jnp.all(jnp.stack(met)) if met else jnp.asarray(False)


class Sums(NamedTuple):
    """Sums of the records of the repeats so far.

    y: (N+1, n_y) sum of the outputs [unit of y]
    u: (N, n_u) sum of the inputs [unit of u]
    signals: (N, ...) sum of each signal, by name
    """

    y: Array
    u: Array
    signals: dict[str, Array]


class LadderMemory(NamedTuple):
    """The memory of `Ladder`.

    count: () number of repeats so far of the present schedule
    sums: sums over these repeats
    gain: () factor on the error; None if the gain is fixed
    rms: () RMS error of the mean trial last learned from [unit of y], inf before the first; None if
        the gain is fixed
    """

    scheme: Memory
    count: Array  # type: ignore[assignment]  # tuples of Python have a method of this name
    sums: Sums
    gain: Tree
    rms: Tree


@pytree
class Ladder(Guard):
    """Ladder-type learning: one learning step from the mean of R trials (Li 2020, section 6.2).

    Each schedule is run R times; then the scheme learns once, from the mean of these R trials. In
    between, the memory of the scheme does not change. Noise that does not repeat enters the learned
    input with 1/sqrt(R) of its standard deviation. With `slow` the gain of learning adapts. Where
    the RMS error of the mean trial has decreased since the last mean trial, but only slowly, the
    gain is increased and keeps its new value. It starts at 1:

        slow < RMS_i / RMS_{i-1} <= 1:    gain' = min(growth_of_gain gain, largest)

    The paper prints no rule for the gain. Here an error that has increased does not change the
    gain, since a larger gain would not help. For any scheme the gain multiplies the error that the
    scheme is shown, y' = r - gain (r - y). To an adaptive law this looks like a different plant,
    and the law adapts to it as well.

    A sample that was not measured has the error zero in the mean: where m of the R repeats lost it,
    it is learned from with (R - m) / R of the gain. A law with a model is shown the weight that the
    samples of the last repeat have, and a law beside a feedback, within `WithFeedback`, what that
    contributed to the last repeat.

    scheme: the scheme that learns from the mean trial
    repeats: R, number of trials for each learning step
    growth_of_gain: () >= 1, factor by which the gain is increased
    largest: () >= 1, largest gain
    slow: () in (0, 1), ratio of RMS errors above which the decrease counts as slow; None: the gain
        is 1

    The comparisons carry no gradient, so the gradient with respect to `slow` is zero.
    `check` raises ValueError if the gain adapts and the scheme compares the output of the running
    trial with the one that it was shown (FFDL-MFAILC), weighs its jerk (`jerk_time`) or bounds it.
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
        need_numbers(self, "growth_of_gain", "largest", "slow")
        if self.slow is not None:
            found = f"slow = {self.slow} with ", "are slow = None, or"
            need_no_true_outputs(self, task, "would hold for r - gain e in its place", *found)
        super().check(task)

    def initial_memory(self, task: Task) -> LadderMemory:
        y, u = jnp.zeros((task.N + 1, task.outputs)), jnp.zeros((task.N, task.inputs))
        sums = Sums(y, u, silent(self.scheme, task))
        adapted = (
            (None, None) if self.slow is None else (jnp.ones(()), jnp.full((), jnp.inf, float))
        )
        return LadderMemory(self.scheme.initial_memory(task), jnp.zeros(()), sums, *adapted)

    def learn(self, memory: LadderMemory, trial: Trial) -> LadderMemory:
        # a measured trial may lack signals; the scheme must see that they are missing
        names = [name for name in memory.sums.signals if name in trial.signals]
        now = Sums(
            trial.y, trial.u, memory.sums.signals | {name: trial.signals[name] for name in names}
        )
        sums = _choose(memory.count == 0, now, jax.tree.map(jnp.add, memory.sums, now))
        count = memory.count + 1
        full = count >= self.repeats
        y, u, signals = jax.tree.map(lambda total: total / self.repeats, sums)
        signals = trial.signals | {name: signals[name] for name in names}
        mean = trial._replace(y=y, u=u, signals=signals)
        gain = rms = None
        if self.slow is not None:
            now_rms = _root_mean_square(lax.stop_gradient(_errors(mean)))
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


def _choose(condition: Array, one: T, other: T) -> T:
    """The tree `one` where the condition holds, else the tree `other`, leaf by leaf."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), one, other)


def _errors(trial: Trial) -> Array:
    """(N, n_y) the errors of a trial, without the jerks that `AtSamples` shows beside them."""
    n, e = trial.signals["jerk"].shape[1] if "jerk" in trial.signals else 0, trial.e[1:]
    return e[:, :n] if e.shape[1] == 2 * n else e


def _root_mean_square(e: Array) -> Array:
    """The root mean square over all samples and outputs, as ()."""
    return jnp.sqrt(jnp.mean(e**2))


@pytree
class KeepUnmeasured(Wrapper):
    """A scheme whose memory of a sample stays as it was where this sample was not measured.

    In a record of a machine whose trials differ, samples that were not measured have the error and
    the weight zero. A law that adds to its input then leaves it alone. A law that also compares
    trials, such as `CFDLMFAILC`, that forgets, or that filters, would still take the zero for
    data. Here each row of its memory that belongs to sample k of the input stays, unless y[k+1] was
    measured, of a scheme with a `lead` m y[k+1+m], or the last sample where the trial is shorter;
    then increments are those from the last trial that was. Of `StopWhen` and `Ladder` these are the
    rows of their scheme.

    scheme: any scheme that learns from the error
    `check` raises ValueError for a scheme that makes experiments (`ModelFreeGradient`): what was
    kept of an experiment would be played in the next one. It raises, too, for `OnBasis` within,
    which fits its parameters before rows are kept; write OnBasis(KeepUnmeasured(...), basis).
    """

    weighs = True  # another law for each set of samples that are measured

    scheme: Scheme = child()

    def check(self, task: Task) -> None:
        super().check(task)
        need_no_experiments(self, task, "which must be played as they are")
        for part, _, _ in with_all_parts(self.scheme, task):
            if isinstance(part, Guard) and hasattr(part, "basis"):
                raise ValueError(
                    f"KeepUnmeasured: {type(part).__name__} within it fits its parameters before "
                    f"rows are kept; allowed is {type(part).__name__} around KeepUnmeasured"
                )

    def learn(self, memory: Memory, trial: Trial) -> Memory:
        following = super().learn(memory, trial)
        if trial.weight is None:
            return following
        there, N = jnp.any(trial.weight != 0, axis=(1, 2)), len(trial.u)
        lead = getattr(_law_within(self.scheme), "lead", 0)
        m = lead if isinstance(lead, int) else 0  # that of a basis is a time
        ahead = jnp.minimum(jnp.arange(N) + 1 + m, N)

        def kept(old: Value, new: Value) -> Value:
            if hasattr(new, "theta"):  # parameters of functions, of which there may be N
                return new
            if isinstance(new, StopMemory | LadderMemory):  # other fields are no rows
                scheme = jax.tree.map(kept, old.scheme, new.scheme, is_leaf=_is_no_row)
                if isinstance(new, StopMemory):  # that of the best trial is kept as a whole
                    scheme = _choose(new.frozen > 0, new.scheme, scheme)
                return new._replace(scheme=scheme)
            rows = jnp.shape(new)[0] if jnp.ndim(new) else 0
            if rows not in (N, N + 1):
                return new
            measured = there[ahead] if rows == N else there
            return jnp.where(measured.reshape(-1, *(1,) * (jnp.ndim(new) - 1)), new, old)

        return jax.tree.map(kept, memory, following, is_leaf=_is_no_row)


def _is_no_row(memory: Value) -> bool:
    return isinstance(memory, StopMemory | LadderMemory) or hasattr(memory, "theta")


def _law_within(scheme: Scheme) -> Scheme:
    """The law that learns what is played, within its wrappers and beside a feedback."""
    while True:
        inner: Value = getattr(scheme, "scheme", getattr(scheme, "learning", None))
        if not isinstance(inner, Scheme):
            return scheme
        scheme = inner
