"""Repetitive control: what is learned between trials, learned within one long trial each period.

What is learned of a period is its samples (`RepetitiveControl`) or weights of functions of the time
within it (`RepetitiveBasis`).
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax

from ..plants.position import Harmonics, Splines
from ..pytree.aliases import Array, Leaf, Value
from ..pytree.fields import child, leaf, pytree, scalar, static
from ..pytree.needs import known
from ..runtime.capacity import check_size
from ..signals.task import Sample, Task
from .learning_filter import LearningFilter
from .scheme import Scheme, limited, need_square

AROUND = np.array([-1, 0, 1, 2])  # samples from which a value between two of them is interpolated
ROOM = 1.25  # of the memory, over the period with which the scheme is made
MOST = 3  # periods at once; there are 2^P - 1 places at which P of them look back
COPIES = 2  # of what is remembered: from sample to sample
BEFORE = 1e-9  # of a period, by which rounding may put its end too early


class Passed(NamedTuple):
    """What is remembered, the newest sample last.

    v: (M, n_u) what was added to the input;  e: (M, n_y) errors
    tracked: the period, where it is tracked; else None
    """

    v: Array
    e: Array
    tracked: Tracked | None = None


class Tracked(NamedTuple):
    """A period that is tracked.

    period: () [s];  drift: () its change [s per s]
    power: (2,) sums over about a period of the squares of correction and slope
    angle: (M,) measured angles [periods], the newest last; None where no angle is measured
    """

    period: Array
    drift: Array
    power: Array
    angle: Array | None


@pytree
class PeriodTracking:
    """How `RepetitiveControl` follows a period that drifts.

    With `angle`, an output of the machine counts the periods, such as the encoder of a spindle in
    turns: the period found is the time since this angle was one less, between samples by straight
    lines. Without, it is found from what the law corrects. If v comes too late by a shift, its
    correction L e lies along its slope v', so the shift is -sum L e v' / sum v'^2, over about the
    last period (a gradient of |L e|^2, normalised; with a share of sum (L e)^2 in the denominator,
    so that what no shift within the range explains changes little). Either feeds a loop that
    follows a steady drift without a lag,

        period += rate (found - period) dt / period + drift dt
        drift  += rate^2 / 4 (found - period) dt / period^2

    within: the period stays within (1 -+ within) times the `period` of the scheme
    fastest: () largest change of the period [s per s], whatever is found
    rate: () share of a wrong period that is corrected within a period
    angle: number of the output that grows by 1 in each period, and that the law does not see; None:
        none is measured

    An estimate locks where what repeats is shifted by less than half of its shortest wave, in one
    period: with ten harmonics from 5 % of the period on, it may lock to a wrong one.
    """

    within: Leaf = scalar(default=0.05, interval="(0, 1)")
    fastest: Leaf = scalar(default=1e-3, interval="(0, 0.5]")
    rate: Leaf = scalar(default=0.5, interval="(0, 2]")
    angle: int | None = static(default=None, interval="[0, inf)", whole=True, optional=True)

    def start(self, period: Array, samples: int) -> Tracked:
        zero = jnp.zeros(())
        angle = None if self.angle is None else jnp.full(samples, -jnp.inf)
        return Tracked(jnp.asarray(period) + zero, zero, jnp.zeros(2), angle)

    def after(
        self, was: Tracked, guess: Leaf, dt: float, y: Array, correction: Array, slope: Array
    ) -> Tracked:
        """The period after a sample.

        guess: () [s], which is the middle of the range
        y: (n_y,) all outputs
        correction, slope: (n_u,) L e, and the change of v in a sample, at the same place
        """
        power, angle, share = was.power, was.angle, dt / was.period
        if angle is not None:
            angle = jnp.concatenate([angle[1:], y[self.angle][None]])
            found = _time_since(angle, dt, was.period) - was.period
        else:
            squares = jnp.stack([jnp.sum(correction**2), jnp.sum(slope**2)])
            power = (1 - share) * power + squares
            of_range = self.within * guess / dt
            size = power[1] + power[0] / of_range**2
            along = jnp.sum(correction * slope)
            moved = size > 0
            found = -jnp.where(moved, along / jnp.where(moved, size, 1.0), 0.0) * dt / share
        drift = was.drift + self.rate**2 / 4 * found * share / was.period
        drift = limited(drift, self.fastest)
        step = limited(self.rate * found * share + drift * dt, dt * self.fastest)
        low, high = guess * (1 - self.within), guess * (1 + self.within)
        period = was.period + step
        inside = (period > low) & (period < high)
        return Tracked(jnp.clip(period, low, high), jnp.where(inside, drift, 0.0), power, angle)


def _time_since(angle: Array, dt: float, unknown: Array) -> Array:
    """() the time since the angle was 1 less than its newest; `unknown` where it never was."""
    less = angle[-1] - angle  # falling, 0 at the newest
    late = jnp.sum(less < 1)  # samples since then, rounded up
    at = jnp.clip(len(angle) - 1 - late, 0, len(angle) - 2)
    before, after = less[at], less[at + 1]
    seen = (before >= 1) & (before < jnp.inf) & (after < 1)
    share = jnp.where(seen, (1 - after) / jnp.where(seen, before - after, 1.0), 0.0)
    return jnp.where(seen, (len(angle) - 2 - at + share) * dt, unknown)


@pytree
class RepetitiveControl(Scheme):
    """The law of a `LearningFilter`, from period to period of one long trial.

        v[k] = sum_i keep_i v[k - n + i - m] + sum_i L_i e[k - n + 1 + lead + i - l]

    n = period / dt is the period in samples, m and l are the middle taps of keep and L. Between
    trials the same law is u_{j+1} = Q u_j + L e_j; here the trial before is the period before
    (Hara, Yamamoto, Omata, Nakano 1988). So L and Q may look ahead, as far as a period allows, and
    in the first period v is zero. Where n is no whole number, values between samples come from four
    samples around them (Lagrange). It stands beside a feedback, in parallel:

        WithFeedback(RepetitiveControl(learning_filter(L, Q), period=0.25), PID(...))

    `theory.repetitive_condition` tells whether it converges, what is left at each frequency, and
    what a wrong period costs. Of several periods n_1 .. n_P each is learned as if it were alone: in
    place of the delay z^-n stands W = 1 - prod_i (1 - z^-n_i), such as z^-n_1 + z^-n_2 -
    z^-(n_1 + n_2), each of these delays interpolated once. That is larger than 1 between the
    harmonics, so it asks more of the law.

    law: taps L and keep, from `learning_filter` or given; one law in all samples
    period: () of what repeats [s], or (P,) of up to three at once; each at least what L and keep
        look ahead and three samples more
    longest: the longest period, or sum of several, that may be set [s]; None is 1.25 times `period`
    tracking: of one period that drifts, for which `period` is the first guess and the middle of its
        range; None: the period stays. The signal `period` of a trial records it

    `check` raises ValueError for a period that is too short for the law, or longer than `longest`,
    and where `longest` cannot be told because `period` is traced. A traced period outside of this
    range makes the input NaN, so that the machine counts as diverged.
    """

    law: LearningFilter = child()
    period: Leaf = leaf(interval="(0, inf)")
    longest: float | None = static(default=None, interval="(0, inf)", optional=True)
    tracking: PeriodTracking | None = child(default=None)

    def __post_init__(self) -> None:
        if self.longest is None and known(self.period):
            object.__setattr__(self, "longest", ROOM * float(np.sum(self.period)))

    def check(self, task: Task) -> None:
        if self.law.starts:
            raise ValueError(
                f"RepetitiveControl: law has starts = {self.law.starts}; allowed is (), one law in "
                "all samples"
            )
        need_angle("RepetitiveControl: tracking.angle", self._angle, task)
        self.law.check(self._seen_by_law(task))
        longest = self._longest
        a_sample = COPIES * 8 * (task.inputs + self._seen_by_law(task).outputs)
        check_size("RepetitiveControl", a_sample / task.dt, longest=longest)
        if self.tracking is not None and self.period.ndim:
            raise ValueError(
                f"RepetitiveControl: period has shape {self.period.shape}; allowed is (), one "
                "period, with tracking"
            )
        if not known((self.period, self.tracking)):
            return
        values = np.asarray(self.period)
        if values.ndim > 1 or not 0 < values.size <= MOST or not self._fits(task.dt):
            around = "" if self.tracking is None else f" -+ {100 * self.tracking.within:g} %"
            raise ValueError(
                f"RepetitiveControl: period = {values} s{around} is outside its allowed range "
                f"[{self._least * task.dt:g}, {longest:g}]: from what the law looks ahead, to "
                f"`longest`, which is for the sum of up to {MOST} periods"
            )

    def initial_state(self, task: Task) -> Passed:
        # as many samples before the newest as the longest period and the taps look back
        past = int(np.ceil(self._longest / task.dt)) + AROUND[-1] + 1
        of = {"keep": task.inputs, "L": self._seen_by_law(task).outputs}
        if self.tracking is not None:
            past = max(past, self._back + 2)  # also the slope
        v, e = (jnp.zeros((past - self._ends(name)[0], n)) for name, n in of.items())
        start = None if self.tracking is None else self.tracking.start(self.period, past + 1)
        return Passed(v, e, start)

    def act(self, state: Passed, sample: Sample) -> tuple[Passed, Array]:
        error, period, tracked = sample.r - sample.y, self.period, state.tracked
        if self._angle is not None:
            error = jnp.delete(error, self._angle)
        e = _with(state.e, error)
        v_past = state.v
        if sample.applied is not None:  # what an actuator has let through
            v_past = v_past.at[-1].set(sample.applied)
        if self.tracking is not None and tracked is not None:
            shifted = self._shifted(v_past, e)
            tracked = self.tracking.after(tracked, self.period, sample.dt, sample.y, *shifted)
            period = tracked.period
        v = jnp.zeros_like(v_past[-1])
        for sign, delay in delays(jnp.asarray(period)):
            periods = delay / sample.dt
            whole = jnp.floor(periods)
            weights = sign * lagrange(periods - whole)
            weights = jnp.where(self._fits(sample.dt), weights, jnp.nan)
            v = v + self._of_period("keep", v_past, whole - 1, weights)
            v = v + self._of_period("L", e, whole, weights)
        v = limited(v, self.law.limit)
        return Passed(_with(v_past, v), e, tracked), v

    def signals(self, state: Passed) -> dict[str, Array]:
        return {} if state.tracked is None else {"period": state.tracked.period[None]}

    @property
    def _angle(self) -> int | None:
        return None if self.tracking is None else self.tracking.angle

    @property
    def _longest(self) -> float:
        if self.longest is None:
            raise ValueError(
                "RepetitiveControl: longest = None, and period is traced; allowed is the longest "
                "period that it may have [s]"
            )
        return self.longest

    @property
    def _least(self) -> int:
        """The shortest period in samples, with which nothing is needed that is yet to come."""
        return max(self._ends("L")[1], self._ends("keep")[1] + 1) + 2

    def _fits(self, dt: float) -> Leaf:
        """Whether memory and law reach over the period, and over all of its range."""
        xp, within = (np if known((self.period, self.tracking)) else jnp), 0.0
        if self.tracking is not None:
            within = self.tracking.within
        least, longest = self._least * dt * (1 - 1e-9), self._longest * (1 + 1e-9)
        low, high = (1 - within) * self.period, (1 + within) * xp.sum(self.period)
        return xp.all(low >= least) & (high <= longest)

    def sees(self, task: Task) -> tuple[int, ...]:
        """The numbers of the outputs from which the law learns: all but the angle."""
        return tuple(i for i in range(task.outputs) if i != self._angle)

    def _seen_by_law(self, task: Task) -> Task:
        return task if self._angle is None else task.of_outputs(self.sees(task))

    @property
    def _back(self) -> int:
        """Samples back to the newest place of which correction and slope of v are known."""
        return max(self._ends("L")[1], 2)

    def _shifted(self, v: Array, e: Array) -> tuple[Array, Array]:
        """(n_u,) L e and the change of v per sample at the newest place where both are known."""
        later = self._back - self._ends("L")[1]
        newest = len(e) - later
        correction = _through(self.law.L, e[newest - self.law._taps("L") : newest])
        at = len(v) - self._back  # the newest of v is of a sample ago
        return correction, (v[at + 1] - v[at - 1]) / 2

    def _ends(self, name: str) -> tuple[int, int]:
        """The first and the last sample that L or keep sees, from the same place a period later."""
        middle = self.law._taps(name) // 2
        ahead = 1 + self.law.lead if name == "L" else 0
        return min(ahead - middle, 0), ahead + middle

    def _of_period(self, name: str, past: Array, whole: Array, weights: Array) -> Array:
        """(n_u,) L or keep on the samples a period ago; the newest of `past` is `whole` later."""
        taps, count, last = getattr(self.law, name), self.law._taps(name), self._ends(name)[1]
        first = len(past) - whole.astype(int) + last - count - AROUND[-1]
        seen = lax.dynamic_slice_in_dim(past, first, count + len(AROUND) - 1)
        windows = [AROUND[-1] - j + np.arange(count) for j in AROUND]
        return _through(taps, jnp.tensordot(weights, seen[np.stack(windows)], axes=1))


def need_angle(name: str, angle: int | None, task: Task) -> None:
    """Raises ValueError unless an angle that is measured is one of several outputs of the task."""
    if angle is not None and angle >= task.outputs:
        raise ValueError(f"{name} = {angle} is none of the task's outputs 0..{task.outputs - 1}")
    if angle is not None and task.outputs == 1:
        raise ValueError(
            f"{name} = {angle} is the only output of the task; allowed is one beside an output "
            "whose error is learned"
        )


def _through(taps: Array, seen: Array) -> Array:
    """(n,) the taps on as many samples."""
    if taps.ndim == 1:
        return taps @ seen
    return jnp.einsum("pij,pj->i", taps, seen)


def harmonic_taps(
    values: Value, period: float, *, dt: float, reach: int | None = None
) -> np.ndarray | Array:
    """(2 reach + 1,) taps of a filter with a value of its own at each harmonic of a period.

        sum_p taps_p exp(2 pi i h p dt / period) = values_h,   h = 0, 1, 2, ..;  0 beyond the values

    They are taps of L or keep of a `LearningFilter` in `RepetitiveControl`, such as a gain for each
    harmonic, 0 for one that shall not be learned, or the inverse of a measured response there.
    Between the harmonics the response follows from them: `theory.repetitive_condition` tells it. Of
    all such taps these have the least sum of squares.

    values: (H,) real or complex; it may be traced, so that each has a gradient
    period: [s];  dt: sample time [s]
    reach: None is half of a period

    Raises ValueError for more values than harmonics below the Nyquist frequency, and for a reach
    that is too short for them.
    """
    values, n = 1.0 * jnp.atleast_1d(jnp.asarray(values)), period / dt
    most = int(np.floor(n / 2 * (1 + 1e-12))) + 1
    if values.ndim != 1 or values.size > most:
        raise ValueError(
            f"harmonic_taps: values has shape {values.shape}; allowed is (H,) of up to {most} "
            "harmonics below the Nyquist frequency, the constant included"
        )
    least = int(np.ceil((n - 1) / 2 - 1e-9))
    reach = least if reach is None else reach
    if reach < least:
        raise ValueError(f"harmonic_taps: reach = {reach} samples; allowed is [{least}, inf)")
    angle = 2 * np.pi / n * np.outer(np.arange(most), np.arange(-reach, reach + 1))
    rows = np.concatenate([np.cos(angle), np.sin(angle[1:])])
    wanted = jnp.zeros(most, values.dtype).at[: values.size].set(values)
    parts = jnp.concatenate([jnp.real(wanted), jnp.imag(wanted)[1:]])
    taps = np.linalg.pinv(rows, rcond=1e-9) @ parts
    return taps if not known(values) else np.asarray(taps)


def delays(period: Array | np.ndarray) -> Iterator[tuple[float, Array]]:
    """The sign and the delay of each term of 1 - prod_i (1 - delay i)."""
    of_each = jnp.atleast_1d(period)
    for chosen in product((0.0, 1.0), repeat=len(of_each)):
        if any(chosen):
            yield -((-1.0) ** sum(chosen)), jnp.dot(np.array(chosen), of_each)


def _with(past: Array, newest: Array) -> Array:
    return jnp.concatenate([past[1:], newest[None]])


def lagrange(share: Array | float) -> Array:
    """(4,) weights of x[-1], x[0], x[1], x[2] in x[share], share in [0, 1)."""
    weights = []
    for i, at in enumerate(AROUND):
        others = np.delete(AROUND, i)
        weights.append(jnp.prod((share - others) / (at - others)))
    return jnp.stack(weights)


# By functions of the period
# --------------------------------------------------------------------------------------------------


class Learned(NamedTuple):
    """What `RepetitiveBasis` knows within a trial.

    w: (m, n_u) weights;  waiting: (m, n_u) what they change by at the end of the period
    k: () number of the sample, -inf before the first
    turn: () number of the period, inf before the first
    """

    w: Array
    waiting: Array
    k: Array
    turn: Array


@pytree
class RepetitiveBasis(Scheme):
    """Functions of the time within a period, whose weights are learned in one long trial.

        u[k] = f(t)' w[k],   w[k+1] = keep w[k] + gain f(t - lead) e[k],   t = k dt

    It stands beside a feedback, `WithFeedback(RepetitiveBasis(...), PID(...))`, each input with
    weights of its own for the error of its own output. With `Harmonics(period, orders)` this is
    adaptive feedforward cancellation, the same as a resonator for each harmonic (Bodson, Sacks,
    Khosla 1994): from e to u it is linear and does the same at all samples,

        C(z) = sum_h gain_h z^-1 (cos(a_h + b_h) - keep z^-1 cos b_h)
                                / (1 - 2 keep z^-1 cos a_h + keep^2 z^-2)

    with a_h = 2 pi h dt / period and b_h = 2 pi h lead / period. With all harmonics of a period of
    n samples, n odd, and gains of 2 g / n (g / n for the constant) it is `RepetitiveControl` with
    one tap L = g and keep = 1, whose lead is lead / dt - 1. Fewer functions let less noise in.

    functions: `Harmonics` with the period [s] as pitch, or `Splines(0, period, count, closed=True)`
    gain: () or (m,) of each function [unit of u per unit of e]
    lead: () or (m,) by which the output is later than the input, as delay or phase of the closed
        loop at the function [s]
    keep: () what is left of a weight after a step; below 1 it forgets, and is more robust
    by_period: whether the weights change at the end of a period only, by the sum over it
    angle: number of the output that is taken in the place of t, in the units of the functions, such
        as that of a spindle, or a position on its stroke with open `Splines`; the law does not see
        its error. None: none
    """

    functions: Harmonics | Splines = child()
    gain: Leaf = leaf()
    lead: Leaf = leaf(default=0.0)
    keep: Leaf = scalar(default=1.0, interval="(0, 1]")
    by_period: bool = static(default=False)
    angle: int | None = static(default=None, interval="[0, inf)", whole=True, optional=True)

    def check(self, task: Task) -> None:
        m, functions = len(self.functions.names), self.functions
        if isinstance(functions, Harmonics) and functions.pitch.ndim:
            raise ValueError(
                f"RepetitiveBasis: functions.pitch has shape {functions.pitch.shape}; allowed is "
                "(), one period"
            )
        ends = isinstance(functions, Splines) and not functions.closed
        if ends and (self.angle is None or self.by_period):
            raise ValueError(
                "RepetitiveBasis: functions.closed = False, of splines that end with the first "
                "period; allowed is closed = True, or an angle with by_period = False"
            )
        for name in ("gain", "lead"):
            shape = getattr(self, name).shape
            if shape not in ((), (m,)):
                raise ValueError(
                    f"RepetitiveBasis: {name} has shape {shape}; allowed are () and ({m},), one "
                    "for each function"
                )
        need_angle("RepetitiveBasis: angle", self.angle, task)
        seen = tuple(i for i in range(task.outputs) if i != self.angle)
        need_square(self, task.of_outputs(seen))

    def initial_state(self, task: Task) -> Learned:
        zero = jnp.zeros((len(self.functions.names), task.inputs))
        return Learned(zero, zero, jnp.full((), -jnp.inf), jnp.full((), jnp.inf))

    def act(self, state: Learned, sample: Sample) -> tuple[Learned, Array]:
        e, w, waiting = sample.r - sample.y, state.w, state.waiting
        k = jnp.maximum(state.k, 0.0)
        t = k * sample.dt
        if self.angle is not None:
            t, e = sample.y[self.angle], jnp.delete(e, self.angle)
        turn = jnp.floor(self._turns(t) + BEFORE)
        if self.by_period:
            ended = turn > state.turn
            w = jnp.where(ended, self.keep * w + waiting, w)
            waiting = jnp.where(ended, 0.0, waiting)
        u = self.functions.at(t) @ w
        seen = self.functions.at(t - self.lead)  # of a lead each, its own function
        seen = jnp.diagonal(seen) if seen.ndim == 2 else seen
        change = (self.gain * seen)[:, None] * e
        if self.by_period:
            waiting = waiting + change
        else:
            w = self.keep * w + change
        return Learned(w, waiting, k + 1, turn), u

    def signals(self, state: Learned) -> dict[str, Array]:
        return {"weights": state.w.ravel()}

    def _turns(self, t: Array) -> Array:
        """() the number of periods since 0."""
        if isinstance(self.functions, Harmonics):
            return t / self.functions.pitch
        return (t - self.functions.low) / (self.functions.high - self.functions.low)
