"""Learning within one long trial: repetitive control, and basis functions with their weights.

With e_0 the error under the feedback alone, T the closed loop from what is added to the output, and
the law u' = Q u + L e over a delay W of one period,

    e = S e_0,    S = (1 - Q W) / (1 - (Q - L T) W).

|Q - L T| < 1 at all frequencies is the condition of the same law between trials, but what happens
at the ends of a trial does not matter here. As |W| <= 1, it suffices for any period (small gain;
Hara, Yamamoto, Omata, Nakano 1988). At the harmonics of the period, where W = 1, little is left
where Q is near 1. Between them |S| exceeds 1: what does not repeat with the period becomes larger
there, the more the wider Q is (the waterbed). For a period that is no whole number of samples W has
the interpolation of `RepetitiveControl` in it. For P periods at once W is 1 - prod_i (1 - W_i),
with one interpolated delay of n_1 + n_2 for W_1 W_2, so |W| <= 2^P - 1, and it suffices that
|Q - L T| < 1 / (2^P - 1). That is P of them in series, with the internal models of all. P in
parallel, each with the same law from the same error, v = sum_i v_i with v_i = W_i (Q v_i + L e),
are one law Q and P L over the delay

    W = N / (D + Q N),   N = sum_i W_i prod_{j != i} (1 - Q W_j) / P,   D = prod_i (1 - Q W_i).

W / (1 - Q W) maps the unit disc to a disc where |Q| < 1, which is convex and so has the mean of P
of its points in it, so |W| <= 1: |Q - P L T| < 1 suffices. The delay of a period that is tracked
changes; within its limits it makes no signal more than `largest_gain` times larger in the 2-norm,
so |Q - L T| < 1 / largest_gain suffices. Of several channels |.| is the largest singular value. On
measured lines T = P / (1 + C P), and a response P that is off by s makes T off by at most
s / (|1 + C P| (|1 + C P| - |C| s)).

The loop of machine, feedback and `RepetitiveBasis` is linear, and the functions are those of one
period, so from sample to sample it is x[k+1] = M[k] x[k] + what acts on it, with M the same a
period later. Its product over a period is the monodromy matrix, whose eigenvalues are within the
unit circle if and only if all comes to its limit exponentially (Floquet; Bittanti, Colaneri 2009,
ch. 3). Where `keep` is 1, what the functions hold of a disturbance at the input is then removed: w
is its negative. Harmonics hold what acts anywhere, since a linear loop makes of each the same one.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..learning.machine import Machine
from ..plants import StateSpace
from ..plants.position import Harmonics
from ..pytree.aliases import Value
from ..pytree.in_short import in_short
from ..pytree.ranges import require
from ..schemes import OnOutputs, RepetitiveBasis, RepetitiveControl, Scheme, WithFeedback
from ..schemes.repetitive import AROUND, BEFORE, delays, lagrange
from ..signals.task import Task
from ..uncertainty import Population, drawn_machines
from .condition import Condition, Premise, condition, premise
from .enclosure import arc_of_taps, supremum
from .frequency import FrequencyTest, Parts, of_poles, on_supremum, parts_of, reduced
from .law import Law, at_points, law_of, law_on
from .learning_map import limit_names
from .linearity import invariant_loop
from .loop import Loop, linear_loop, on_circle, response
from .on_lines import MeasuredResponse
from .outlook import NO_LIMIT

ROUNDED = 2e-6  # above 1, within which a supremum is enclosed
POINTS = 32  # frequencies between two harmonics
FROM_PERIOD_TO_PERIOD = (
    "sup |Q - L T| < 1: by small gain the loop through the delay of a period is stable, and while "
    "the period stays, each frequency comes nearer to its limit by about this factor or more in "
    "every period (Hara, Yamamoto, Omata, Nakano 1988)"
)
ON_LINES = (
    "|Q - L T| < 1 on the measured lines and within their doubt: between periods each of these "
    "frequencies comes nearer to its limit by this factor or more, if the loop is stable and the "
    "period stays"
)
SLOPE = 1.61  # largest 2-norm of the derivatives of the four weights of `lagrange`
MOST, AT_ONCE = 2**20, 2**12  # frequencies of a sensitivity, and that are computed at once
PERIODS, WHOLE = 64, 1e-6  # periods that are tried for a whole number of samples, and what is whole
SAMPLES, MAPS = 2**17, 2**10  # samples of these periods, and maps that are multiplied at once
OF_PERIOD = (
    "the largest |eigenvalue| of the map of a period is below 1: the weights and the error come to "
    "their limit, nearer by this factor in the long run in every period (Floquet)"
)


class RepetitiveTest(NamedTuple):
    """What repetitive control promises for one machine, for a family, or on measured lines.

    test: (2^P - 1) |Q - L T| < 1 at all frequencies, with its premises; P = 1 for one period, and
        `largest_gain` in the place of 2^P - 1 for one that is tracked. Of a family it is that of
        its worst machine; on lines it has the doubt of each line in it
    period: of what is remembered [s], the sum of several
    frequencies: (F,) [Hz];  sensitivity: (F,) |S|, the error over that of the feedback alone, of a
        family the largest
    worst, worst_at: the largest |S|, and its frequency [Hz]
    harmonics: (H,) multiples of 1 / period below the Nyquist frequency, of each period [Hz]
    left: (H,) |S| at these
    factor: (H,) |Q - L T| at these, by which each of them comes nearer to its limit in a period
    at: the numbers of the worst machine of a family, by name
    """

    test: FrequencyTest
    period: float
    frequencies: np.ndarray
    sensitivity: np.ndarray
    worst: float
    worst_at: float
    harmonics: np.ndarray
    left: np.ndarray
    factor: np.ndarray
    at: dict[str, float]
    __repr__ = in_short


def repetitive_condition(
    machine: Machine | Population | MeasuredResponse,
    scheme: Scheme,
    task: Task,
    *,
    points: int = POINTS,
    wrong: float = 0.0,
    sigmas: float = 3.0,
) -> RepetitiveTest:
    """Whether repetitive control beside a feedback converges, and its sensitivity.

    machine: one; a `Population`, for the worst of those that are drawn; or the measured response of
        one without its feedback. Lines claim nothing: they tell the value of the condition, and,
        joined by straight lines, the sensitivity between the first and the last of them
    scheme: `WithFeedback(RepetitiveControl(...), feedback)`, or a `RepetitiveControl` alone; or
        several in parallel, of one law and a period each, `WithFeedback(RepetitiveControl(law, p),
        WithFeedback(RepetitiveControl(law, q), feedback))`, for which `test` and `factor` have P L
        in the place of L
    points: frequencies between two harmonics, so that no narrow peak is missed
    wrong: relative error of the period: the true period is (1 + wrong) times that of the scheme,
        and `harmonics` are those of the true one
    sigmas: standard deviations by which a measured line may be off

    Where the period is tracked, the condition claims that all stays bounded whatever is tracked,
    right or wrong, and converges once it stays; `sensitivity` and `left` are those of the period of
    the scheme.

    Raises ValueError for another scheme, for lines of several channels, for a period of more than
    2^20 frequencies, for lines without a harmonic or above the Nyquist frequency, and where
    machine, scheme and task do not fit.
    """
    beside, feedback = side_by_side(scheme)
    if not beside:
        raise ValueError(
            f"repetitive_condition: scheme is a {type(scheme).__name__}; allowed are a "
            "RepetitiveControl and WithFeedback(RepetitiveControl(...), feedback)"
        )
    repetitive = beside[0]
    if len(beside) > 1 and not _alike(beside, task):
        raise ValueError(
            f"repetitive_condition: {len(beside)} RepetitiveControl in parallel; allowed are those "
            "of one law, for one input and one output, with one period each that is not tracked"
        )
    if isinstance(machine, MeasuredResponse) and (task.inputs, task.outputs) != (1, 1):
        raise ValueError(
            f"repetitive_condition: the task has {task.inputs} inputs and {task.outputs} outputs; "
            "allowed is one of each on measured lines"
        )
    require("repetitive_condition", "wrong", wrong, "(-1, inf)")
    require("repetitive_condition", "sigmas", sigmas, "[0, inf)")
    require("repetitive_condition", "points", points, "[2, 1e4]", whole=True)
    for one in beside:
        one.check(task)
    each, dt = np.concatenate([np.atleast_1d(one.period) for one in beside]), float(task.dt)
    each = each.astype(float)
    period = float(np.sum(each))
    count = int(0.5 / dt * points * period)
    if count > MOST:
        raise ValueError(
            f"repetitive_condition: points = {points} make {count:,} frequencies of a period of "
            f"{period / dt:g} samples; allowed are {MOST:,}"
        )
    f = np.arange(1, count + 1) / (points * period)
    longer = (1 + wrong) * each
    true = np.unique(
        np.concatenate([np.arange(1, int(0.5 / dt * one) + 1) / one for one in longer])
    )
    parallel = len(beside) > 1
    size_of_W: float = 1 if parallel else 2 ** len(each) - 1
    if repetitive.tracking is not None:
        size_of_W = largest_gain(float(repetitive.tracking.fastest))
    law, seen = _between_trials(beside, feedback, task), repetitive.sees(task)
    drawn: Mapping[str, np.ndarray] = {}
    if isinstance(machine, MeasuredResponse):
        f, true = (_within(machine, of, dt) for of in (f, true))
        tests = [_on_lines(machine, law, task, sigmas, size_of_W)]
        loops, taps = [_closed(machine, law, task)], law_of(law, task)
    else:
        machines, drawn = members(machine)
        every = [_parts_seen(one, law, task, seen) for one in machines]
        tests = [
            _on_circle(one, of, law, task, size_of_W, parallel)
            for one, of in zip(machines, every, strict=True)
        ]
        loops, taps = [_response_of(of, task) for of in every], every[0].law
    top = worst_of([test.condition for test in tests])

    def sensitivity(f):
        some = np.array_split(f, max(1, -(-len(f) // AT_ONCE)))
        found = [_sensitivity(loops, taps, task, each, part, parallel) for part in some]
        return np.concatenate(found, axis=1)

    (size, _), (left, factor) = sensitivity(f), sensitivity(true)
    worst, at = int(np.argmax(size)), {name: float(of[top]) for name, of in drawn.items()}
    of_size = float(size[worst]), float(f[worst])
    return RepetitiveTest(tests[top], period, f, size, *of_size, true, left, factor, at)


def members(machine: Machine | Population) -> tuple[list[Machine], Mapping[str, np.ndarray]]:
    """The machines of a population and what was drawn of each; of one machine nothing is drawn."""
    if isinstance(machine, Population):
        return [machine.machine_of(i) for i in range(machine.size)], machine.drawn
    return [machine], {}


def worst_of(conditions: Sequence[Condition]) -> int:
    """The number of the worst one; one that does not hold is worse than any that does."""
    return max(range(len(conditions)), key=lambda i: (not conditions[i].holds, conditions[i].value))


def side_by_side(scheme: Scheme) -> tuple[list[RepetitiveControl], Scheme | None]:
    """The repetitive controls of a scheme, and the feedback beside them; None without one."""
    found: list[RepetitiveControl] = []
    while isinstance(scheme, WithFeedback) and isinstance(scheme.learning, RepetitiveControl):
        found.append(scheme.learning)
        scheme = scheme.feedback
    if isinstance(scheme, RepetitiveControl):
        return [*found, scheme], None
    return found, scheme


def _alike(beside: list[RepetitiveControl], task: Task) -> bool:
    """Whether they differ by their periods alone."""
    first = beside[0].law
    return (task.inputs, task.outputs) == (1, 1) and all(
        one.tracking is None
        and np.size(one.period) == 1
        and jax.tree.structure(one.law) == jax.tree.structure(first)  # type: ignore[operator]  # of JAX
        and all(
            np.array_equal(*pair)
            for pair in zip(jax.tree.leaves(one.law), jax.tree.leaves(first), strict=True)
        )
        for one in beside
    )


def _between_trials(beside: list[RepetitiveControl], feedback: Scheme | None, task: Task) -> Scheme:
    """The same law between trials; of several in parallel L is their number times it."""
    of = beside[0]
    law: Scheme = dataclasses.replace(of.law, L=len(beside) * of.law.L)
    if len(of.sees(task)) < task.outputs:
        law = OnOutputs(law, of.sees(task))
    return law if feedback is None else WithFeedback(law, feedback)


@functools.cache
def largest_gain(fastest: float) -> float:
    """How many times larger a delay makes a signal in the 2-norm, however it changes.

    fastest: rho, largest change of the delay in samples per sample, below 1

    Around each sample c lies a window of 2 h + 1 samples. In it the delay is that of c, up to
    rho h. With the delay of c nothing is made larger (|W| <= 1), and of each sample of the past no
    more than (2 h + 4) / (1 - rho) + 1 windows see anything. The rest is rho h times the slope of
    what is interpolated, which is at most SLOPE times the 2-norm of the samples around. Both are
    averaged over all windows, and h is the best:

        min_h sqrt(((2 h + 4) / (1 - rho) + 1) / (2 h + 1)) + SLOPE rho h sqrt(6 / (1 - rho) + 1)
    """
    if not fastest:
        return 1.0
    h = np.unique(np.geomspace(1, max(1.0, 1 / fastest), 4000).astype(int))
    within = np.sqrt(((2 * h + 4) / (1 - fastest) + 1) / (2 * h + 1))
    return float(np.min(within + SLOPE * fastest * h * np.sqrt(6 / (1 - fastest) + 1)))


def _parts_seen(machine: Machine, law: Scheme, task: Task, seen: tuple[int, ...]) -> Parts:
    """Loop and law, of the outputs that the law sees."""
    parts, rows = parts_of(machine, law, task), list(seen)
    L = parts.law.L._replace(taps=parts.law.L.taps[..., rows])
    loop = parts.loop._replace(C=parts.loop.C[rows])
    return parts._replace(loop=loop, law=parts.law._replace(L=L))


def _response_of(parts: Parts, task: Task) -> Callable[[np.ndarray], np.ndarray]:
    """T at frequencies [Hz]."""
    return lambda f: np.asarray(response(parts.loop, f, task.dt))


def _closed(
    measured: MeasuredResponse, law: Scheme, task: Task
) -> Callable[[np.ndarray], np.ndarray]:
    """T at frequencies [Hz], with straight lines between those of P."""
    C, lines = _feedback_of(law, task), measured.frequencies

    def closed(f):
        P = np.interp(f, lines, measured.response)
        return (P / (1 + C(f) * P))[:, None, None]

    return closed


def _feedback_of(law: Scheme, task: Task) -> Callable[[np.ndarray], np.ndarray]:
    """C at frequencies [Hz], read off the loop around a delay of one sample: C = 1 / T - z."""
    delay = Machine(StateSpace([[0.0]], [[1.0]], [[1.0]], dt=task.dt))
    loop = linear_loop(delay, law, task)
    return lambda f: np.asarray(1 / response(loop, f, task.dt)[:, 0, 0] - on_circle(f, task.dt))


def _within(measured: MeasuredResponse, f: np.ndarray, dt: float) -> np.ndarray:
    low, high = measured.frequencies[[0, -1]]
    within = f[(f >= low) & (f <= high)]
    if high > 0.5 / dt * (1 + 1e-9) or not len(within):  # the last line is rounded
        raise ValueError(
            f"repetitive_condition: the lines go from {low:g} to {high:.10g} Hz; allowed are those "
            f"up to Nyquist, {0.5 / dt:.10g} Hz, with a harmonic of the period among them"
        )
    return within


def _on_circle(
    machine: Machine, parts: Parts, law: Scheme, task: Task, size_of_W: float, parallel: bool
) -> FrequencyTest:
    """sup |Q - L T| < 1. An operation without ends asks for nothing else, but a linear loop."""

    def bounds(centre: np.ndarray, h: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return parts.nominal(centre, h).scaled(size_of_W * np.ones_like(h)).bounds(h)

    premises = [*parts.premises, _without_limits(machine, law, task)]
    if parallel:
        Q = supremum(lambda centre, h: arc_of_taps(parts.law.keep, centre).bounds(h))
        premises.append(premise("|Q| <= 1", Q.bound <= 1 + ROUNDED, f"up to {Q.bound:.6g}"))
    return on_supremum(bounds, FROM_PERIOD_TO_PERIOD, [parts.loop], task, premises)


def _without_limits(machine: Machine, scheme: Scheme, task: Task) -> Premise:
    """The premise that an operation without ends meets no limit: that there is none."""
    names = limit_names(drawn_machines(machine, {}, {}), scheme, task)
    return premise(NO_LIMIT, not names, ", ".join(names))


def _on_lines(
    measured: MeasuredResponse, law: Scheme, task: Task, sigmas: float, size_of_W: float
) -> FrequencyTest:
    """|Q - L T| with the doubt of each line; nothing is claimed of what lines do not tell."""
    f, P = measured.frequencies, measured.response
    Q, L = law_on(law, task, f)
    C, off = _feedback_of(law, task)(f), measured.scatter(sigmas)
    loop = np.abs(1 + C * P)
    surely = loop - np.abs(C) * off
    with np.errstate(divide="ignore"):
        doubt = np.where(surely > 0, off / (loop * np.maximum(surely, 0)), np.inf)
    size = size_of_W * (np.abs(Q - L * P / (1 + C * P)) + np.abs(L) * doubt)
    top, above = int(np.argmax(size)), f[size >= 1]
    known = measured.std_known
    said = "lines do not tell it" + ("" if known else ", and their doubt is not known")
    told = premise("loop stable, and nothing between the lines or beyond them", False, said)
    claim = condition(size[top], ON_LINES, premises=[told])
    return FrequencyTest(claim, f, size, float(f[top]), float(above[0]) if len(above) else np.inf)


def _sensitivity(
    loops, law: Law, task: Task, each: np.ndarray, f: np.ndarray, parallel: bool
) -> np.ndarray:
    """(2, F) the largest |S| and |Q - L T| of closed loops T at frequencies [Hz]."""
    z = on_circle(f, task.dt)
    Q, L = (np.asarray(at_points(part, z)) for part in (law.keep, law.L))
    if parallel:
        late, q = np.array([_delay(one, f, task) for one in each]), Q[:, 0, 0]
        left = 1 - q * late
        others = [np.prod(np.delete(left, i, axis=0), axis=0) for i in range(len(each))]
        mean = np.mean(late * others, axis=0)
        W = mean / (np.prod(left, axis=0) + q * mean)
    else:
        W = sum(
            (sign * _delay(float(one), f, task) for sign, one in delays(each)), np.zeros(len(f))
        )
    W, sizes = W[:, None, None], []
    for loop in loops:
        T = loop(f)
        factor = Q - L @ T
        S = np.eye(T.shape[1]) - T @ np.linalg.solve(np.eye(Q.shape[-1]) - W * factor, W * L)
        sizes.append([np.linalg.svd(one, compute_uv=False)[:, 0] for one in (S, factor)])
    return np.max(sizes, axis=0)


def _delay(period: float, f: np.ndarray, task: Task) -> np.ndarray:
    """(F,) the delay of a period, between samples as `RepetitiveControl` has it."""
    whole, share = divmod(float(period) / float(task.dt), 1.0)
    late = np.exp(-2j * np.pi * float(task.dt) * np.outer(f, whole + AROUND))
    return late @ np.asarray(lagrange(share))


# Of basis functions
# --------------------------------------------------------------------------------------------------


class PeriodTest(NamedTuple):
    """What basis functions within one trial promise.

    condition: the largest |eigenvalue| of the map of one period, below 1; of a family that of its
        worst machine
    period: of the functions [s]
    at: the numbers of the worst machine of a family, by name
    """

    condition: Condition
    period: float
    at: dict[str, float]

    def __repr__(self) -> str:
        return in_short(self)


def basis_condition(machine: Machine | Population, scheme: Scheme, task: Task) -> PeriodTest:
    """Whether the weights of a `RepetitiveBasis` beside a feedback converge.

    machine: one, or a `Population`, for the worst of those that are drawn
    scheme: `WithFeedback(RepetitiveBasis(...), feedback)`, or a `RepetitiveBasis` alone

    Raises ValueError for another scheme, for functions of an angle, which follow the motion, for
    splines that are not closed, for a period of which no 64 make a whole number of samples, for
    more than 2^17 of these samples, and where machine, scheme and task do not fit.
    """
    basis, feedback = basis_of(scheme)
    if basis is None or basis.angle is not None:
        what = type(scheme).__name__ if basis is None else "RepetitiveBasis of an angle"
        raise ValueError(
            f"basis_condition: scheme is a {what}; allowed are a RepetitiveBasis of the time and "
            "WithFeedback(RepetitiveBasis(...), feedback)"
        )
    basis.check(task)
    functions = basis.functions
    period = float(
        functions.pitch if isinstance(functions, Harmonics) else functions.high - functions.low
    )
    count, samples = _whole(period / float(task.dt))
    machines, drawn = members(machine)
    plays, learns, ends = _of_samples(basis, samples, float(task.dt))
    parts, found = np.array_split(np.arange(samples), -(-samples // MAPS)), []
    without_limits = _without_limits(machines[0], scheme, task)  # and so are all others
    for one in machines:
        loop = reduced(one, feedback, task)
        premises = (invariant_loop(one, feedback, task), of_poles([loop]), without_limits)
        maps = (
            _maps(loop, plays[k], learns[k], ends[k], float(basis.keep), basis.by_period)
            for k in parts
        )
        product = functools.reduce(lambda before, of: of @ before, map(_product, maps))
        radius = float(np.max(np.abs(np.linalg.eigvals(product)))) ** (1 / count)
        found.append(condition(radius, OF_PERIOD, premises=premises))
    top = worst_of(found)
    return PeriodTest(found[top], period, {name: float(of[top]) for name, of in drawn.items()})


def basis_of(scheme: Scheme) -> tuple[RepetitiveBasis | None, Scheme | None]:
    """The `RepetitiveBasis` of a scheme, and the feedback beside it; None without one."""
    if isinstance(scheme, WithFeedback) and isinstance(scheme.learning, RepetitiveBasis):
        return scheme.learning, scheme.feedback
    return (scheme, None) if isinstance(scheme, RepetitiveBasis) else (None, None)


def _whole(samples: float) -> tuple[int, int]:
    """The smallest number of periods that take a whole number of samples, and that number."""
    for count in range(1, PERIODS + 1):
        total = count * samples
        if abs(total - round(total)) <= WHOLE:
            if total > SAMPLES:
                raise ValueError(
                    f"basis_condition: {count} periods of {samples:g} samples take {total:,.0f}; "
                    f"allowed are {SAMPLES:,}"
                )
            return count, round(total)
    raise ValueError(
        f"basis_condition: the period is {samples:.9g} samples; allowed is one of which up to "
        f"{PERIODS} make a whole number"
    )


def _of_samples(
    basis: RepetitiveBasis, samples: int, dt: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(K, m) what each function plays and learns by, and (K,) whether a period has ended there."""
    t = jnp.arange(samples) * dt
    plays = np.asarray(basis.functions.at(t))
    lead = jnp.broadcast_to(basis.lead, plays.shape[1])
    each = [basis.functions.at(t - one)[:, i] for i, one in enumerate(lead)]
    before: Value = np.arange(-1, samples) * dt  # with its sample before
    turn = np.floor(np.asarray(basis._turns(before)) + BEFORE)
    return plays, np.asarray(basis.gain * jnp.stack(each, axis=1)), np.diff(turn) > 0


def _maps(
    loop: Loop, plays: np.ndarray, learns: np.ndarray, ends: np.ndarray, keep: float, late: bool
) -> np.ndarray:
    """(K, s, s) maps of a sample, of the state of the loop, the weights and what they wait for."""
    (A, B, C), (K, m) = (np.asarray(part) for part in loop), plays.shape
    n, size = len(A), m * B.shape[1]
    channels = np.eye(B.shape[1])
    u = np.einsum("km,ij->kimj", plays, channels).reshape(K, -1, size)
    change = np.einsum("km,ij->kmij", learns, channels).reshape(K, size, -1) @ -C
    x, w, waits = slice(0, n), slice(n, n + size), slice(n + size, n + 2 * size)
    M = np.zeros((K, n + 2 * size, n + 2 * size))
    M[:, x, x], M[:, x, w] = A, B @ u
    M[:, w, w] = np.eye(size)
    if not late:
        M[:, w, w], M[:, w, x] = keep * np.eye(size), change
        return M
    M[:, waits, waits], M[:, waits, x] = np.eye(size), change
    ended = np.eye(n + 2 * size)
    ended[w, w], ended[w, waits], ended[waits, waits] = keep * np.eye(size), np.eye(size), 0.0
    return np.where(ends[:, None, None], M @ ended, M)


def _product(maps: np.ndarray) -> np.ndarray:
    """(s, s) the maps one after the other, the first of them first."""
    while len(maps) > 1:
        rest = maps[len(maps) - len(maps) % 2 :]
        maps = np.concatenate([maps[1::2] @ maps[: 2 * (len(maps) // 2) : 2], rest])
    return maps[0]
