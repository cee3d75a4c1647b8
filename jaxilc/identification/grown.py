"""Models of flexible machines from records: their order is grown, part by part.

The output is a sum of filtered inputs (`plants.ModalModel`), so only the poles are searched for:
the numerators are linear (`problem.projected`). A search costs milliseconds an order, since a part
with poles exp(l dt) filters the input by a polynomial of z of degree 1 or 2, whose numerator spans
that of the part held exactly.

Each order begins from several places: from the poles of a reduced high-order difference equation
(Juang, Pappa 1985), from the order below and one part more, chosen from a grid by what it explains
of the residual, and from the order above and a part less. So a dipole, a pole and a zero that
nearly cancel, is judged jointly: by the criterion of the fit with and of that without it.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from typing import NamedTuple

import numpy as np
import scipy
from scipy.signal import lfilter

from ..plants import ModalModel, ProcessModel
from ..plants.process_model import LONGEST_DELAY
from ..pytree.aliases import Numbers, Value
from ..pytree.in_short import in_short
from ..pytree.ranges import require
from .estimation import MOVING, Order, compare_orders, identify, information
from .not_linear import SIMPLE, Answers, Suspicion, suspicions
from .problem import (
    SAMPLES_PER_PARAMETER,
    Parts,
    checked_record,
    need_excitation,
    need_samples,
    projected,
    searched,
    unit_columns,
)
from .records import Record, as_columns, delayed
from .verdict import Identified, fit_of

LONGEST_LOOKED_FOR = 50  # samples, the default of the longest delay that is looked for
BEYOND = 10  # lags beyond the longest delay, so that its answer is seen
SIGNIFICANT = 4.0  # standard errors from which on an answer to the input is no chance
HIGHEST = 24  # order that is looked for
PATIENCE = 3  # orders without a smaller criterion, after which growing ends
LAGS = 60  # of the difference equation that is reduced
SAMPLED = 2000  # rows of a record that decide between parts of the grid
LONG_RECORD, PART = 100_000, 30_000  # samples: of a longer one a part compares; the least of it
HELD, BANDS, SEEN = 0.1, 24, 1e-10  # share of its power, in each band with so much of the most
GRID, DAMPINGS = 48, (0.01, 0.1, 0.7)  # rates and dampings of the parts that are tried
DELAYS = (0, 1, 2, 3, 5, 8, 13, 21, 34)  # samples, at which a search may begin
MODERATE = (4, 8)  # orders by which it is decided at which
TRIED = 3  # of these, and of the parts that may go, so many are refined
SHORT, LONG = 6, 60  # steps of a refinement that compares, and of one that ends
EASED = 10.0  # what its damping is divided by after a step
GAINED = 1e-7  # relative fall of the cost of a step, below which a refinement ends
LEAST_DAMPING, MOST_DAMPING = 1e-5, 50.0
STILL = 0.02  # of 1 / duration, the slowest rate that is looked for
ASKED, MOSTLY = 8, 0.5  # order at which it is asked; share of the residual that it must explain
SMALLEST = 1e-9  # of the standard deviation of an output, below which a residual is rounding
EQUAL = 1.0  # of the criterion, within which two models explain a record as well
FAR = 50.0  # of the criterion, beyond which no smaller model is looked for
CLEARLY = 0.98  # of the squared error of the validation part, below which a lower order is better
EXPLAINED, GROWS = 95.0, 10.0  # fit [%] below which a pole that grows as exp(10) is looked for
MOVES = 1.3  # times, with the order, that a pole of chance does
FORESEEN = 0.25  # of what a simulation leaves, above which no unstable plant explains it
INTEGRATES = 1.0  # rate times duration, below which a lag may be an integrator


class Signals(NamedTuple):
    """A record as it is filtered.

    u: (n_u, T, N+1) inputs of T experiments, one sample late and from rest
    y: (T (N+1), n_y) outputs divided by `scale`, the first `samples` rows of which are fitted
    from_rest: whether the machine rests at the start; if not, each part has a free motion, and
        the samples of the dead time, which answer inputs before the record, are left out
    """

    u: Numbers
    y: Numbers
    scale: Numbers
    samples: int
    dt: float
    from_rest: bool = True

    @classmethod
    def of(cls, record: Record, samples: int) -> Signals:
        u, y = np.asarray(record.u), np.asarray(record.y)
        u = np.moveaxis(u.reshape(record.trials, -1, u.shape[1]), 2, 0)
        u = np.pad(u, ((0, 0), (0, 0), (1, 0)))
        scale = np.std(y[:samples], axis=0)
        return cls(u, y / scale, scale, samples, record.dt)

    @property
    def duration(self) -> float:
        return self.u.shape[2] * self.dt

    def left_out(self, parts: Parts) -> int:
        """The number of first samples that tell nothing of these parts."""
        return 0 if self.from_rest else parts.delay

    def wanted(self, parts: Parts) -> Numbers:
        """`y`, with zeros in the samples that are left out."""
        y = self.y.copy()
        y[: self.left_out(parts)] = 0.0
        return y

    def first(self) -> Signals:
        """The part that is fitted."""
        n = self.u.shape[2]
        if self.samples < n:
            return self._replace(u=self.u[:, :1, : self.samples], y=self.y[: self.samples])
        experiments = -(-self.samples // n)
        return self._replace(u=self.u[:, :experiments], y=self.y[: self.samples])

    def part(self) -> Signals:
        """A first part of what is fitted, whose input has all frequencies; of a short record all.

        It is the shortest one, from `PART` samples on, whose mean power is `HELD` of that of the
        whole in each band: the beginning of a slow sweep says nothing of a fast mode, nor does that
        of a large motion to which small noise is added later.
        """
        if self.samples <= LONG_RECORD:
            return self
        power = _power(self.u.reshape(len(self.u), -1)[:, : self.samples])
        whole = np.mean(power, axis=0)
        some = np.cumsum(power, axis=0) / np.arange(1, len(power) + 1)[:, None, None]
        held = (some >= HELD * whole) | (whole < SEEN * np.max(whole, axis=-1, keepdims=True))
        last = int(np.argmax(np.all(held, axis=(1, 2))))
        left = (len(power) - 1 - last) * (PART // 4)
        return self._replace(samples=max(self.samples - left, PART)).first()


def _power(u: Numbers) -> Numbers:
    """(windows, n_u, BANDS + 1) power of inputs (n_u, samples) in time, by frequency and at all.

    Windows of half of `PART` overlap by half, and the last one ends with the record (Welch 1967).
    By frequency they fall off smoothly (Hann), so that what is large and slow does not hide what is
    small and fast.
    """
    length, step = PART // 2, PART // 4
    windows = np.lib.stride_tricks.sliding_window_view(u, length, axis=1)
    parts = windows[:, (windows.shape[1] - 1) % step :: step]
    parts = np.moveaxis(parts - np.mean(parts, axis=-1, keepdims=True), 0, 1)
    lines = np.abs(np.fft.rfft(parts * np.hanning(length))) ** 2
    first = np.geomspace(4, length // 2, BANDS)[:-1].astype(int)
    by_frequency = np.add.reduceat(lines, [1, *first], axis=-1)
    return np.append(by_frequency, np.sum(parts**2, axis=-1, keepdims=True), axis=-1)


class Fitted(NamedTuple):
    """Parts with the least squares of their numerators.

    cost: sum of squares of the residual of the fitted part, of each output divided by its scale
    bic: Bayesian information criterion, see `information`
    parameters: number of numbers that were fitted
    percent: fit of the fitted part [%], over all outputs
    """

    parts: Parts
    cost: float
    bic: float
    parameters: int
    percent: float


def denominator(w: float, zeta: float, dt: float) -> Numbers:
    """1 + a_1 / z + a_2 / z^2 of a mode that is sampled at dt."""
    if zeta < 1:
        r, turned = np.exp(-zeta * w * dt), w * dt * np.sqrt((1 - zeta) * (1 + zeta))
        return np.array([1.0, -2 * r * np.cos(turned), r * r])
    fast = w * (zeta + np.sqrt((zeta - 1) * (zeta + 1)))
    slow = w**2 / fast
    return np.array([1.0, -np.exp(-slow * dt) - np.exp(-fast * dt), np.exp(-(slow + fast) * dt)])


def columns(signals: Signals, parts: Parts) -> tuple[Numbers, list[Numbers]]:
    """(rows, c) what the numerators multiply, and the denominators of modes and lags.

    For each input: the direct term, one or two integrators, two columns a mode, one a lag; a column
    of ones for the bias stands first. Those of a start in motion are the last: two a mode, one a
    lag, and a ramp of two integrators.
    """
    u = delayed(signals.u, parts.delay)
    rows, found = signals.y.shape[0], [u] * parts.direct
    summed = u
    for _ in range(parts.integrators):
        summed = np.cumsum(summed, axis=-1)
        found.append(summed)
    dens = [denominator(*np.exp(mode), signals.dt) for mode in parts.modes]
    dens += [np.array([1.0, -np.exp(-np.exp(lag) * signals.dt)]) for lag in parts.lags]
    for den in dens:
        filtered = lfilter([1.0], den, u)
        found += [filtered, delayed(filtered, 1)][: len(den) - 1]
    flat = [np.ones((1, rows)), *(one.reshape(len(u), -1)[:, :rows] for one in found)]
    if not signals.from_rest:
        for den in dens:
            free = lfilter([1.0], den, np.eye(1, rows, parts.delay))
            flat += [free, delayed(free, 1)][: len(den) - 1]
        flat += [np.arange(float(rows))[None]] * (parts.integrators > 1)
    X = np.concatenate(flat).T
    X[: signals.left_out(parts)] = 0.0
    return X, dens


def slopes(signals: Signals, parts: Parts, N: Numbers) -> Numbers:
    """(rows, n_y, x) derivatives of the residual by the poles, but for what the columns span.

    The output of each part is filtered once more by its own denominator.

    N: (c, n_y) numerators, which do not move
    """
    X, dens = columns(signals, parts)
    n_u, T, n = signals.u.shape
    at, free = 1 + n_u * (parts.direct + parts.integrators), 1 + n_u * parts.numerators
    J = np.zeros((*signals.y.shape, len(parts.x)))
    for i, den in enumerate(dens):
        width = n_u * (len(den) - 1)
        own = X[:, at : at + width] @ N[at : at + width]
        at += width
        if not signals.from_rest:
            own += X[:, free : free + len(den) - 1] @ N[free : free + len(den) - 1]
            free += len(den) - 1
        padded = np.zeros((T * n, own.shape[1]))
        padded[: len(own)] = own
        again = lfilter([1.0], den, padded.T.reshape(-1, T, n))
        moved = [delayed(again, k).reshape(len(again), -1)[:, : len(own)].T for k in (1, 2)]
        q = len(parts.modes)
        if i < q:
            for k, step in enumerate(1e-6 * np.eye(2)):
                ends = [
                    denominator(*np.exp(parts.modes[i] + s * step), signals.dt) for s in (1, -1)
                ]
                d = (ends[0] - ends[1]) / 2e-6
                J[:, :, 2 * i + k] = d[1] * moved[0] + d[2] * moved[1]
        else:
            p = np.exp(parts.lags[i - q]) * signals.dt
            J[:, :, q + i] = p * np.exp(-p) * moved[0]
    return J


def bounds(signals: Signals, parts: Parts) -> tuple[Numbers, Numbers]:
    """The ends of what is searched for: far slower than the record, up to the sample rate."""
    slow, fast = np.log(STILL / signals.duration), np.log(1.2 * np.pi / signals.dt)
    q, lags = len(parts.modes), len(parts.lags)
    low = [*np.tile([slow, np.log(LEAST_DAMPING)], q), *np.full(lags, slow)]
    high = [*np.tile([fast, np.log(MOST_DAMPING)], q), *np.full(lags, fast + 1)]
    return np.array(low), np.array(high)


def refined(signals: Signals, parts: Parts, steps: int) -> Fitted:
    """The parts after some steps of the search for their poles; a delay counts as a parameter.

    A direct term counts once more, since it may imitate a delay of one sample.
    """
    y = signals.wanted(parts)
    found, _ = searched(
        lambda x: projected(x, columns(signals, parts.at(x))[0], y),
        lambda at: slopes(signals, parts.at(at.theta), at.N),
        parts.x, bounds(signals, parts), steps=steps, tolerance=GAINED, eased=EASED,
    )  # fmt: skip
    count = found.N.size + len(parts.x) + (parts.delay > 0 or parts.direct)
    bic = criterion(signals, parts, found.left, count)
    about = signals.y - np.mean(signals.y, axis=0)
    percent = float(100 * (1 - np.sqrt(found.cost / np.sum(about**2))))
    return Fitted(parts.at(found.theta), found.cost, bic, count, percent)


def criterion(signals: Signals, parts: Parts, left: Numbers, parameters: int) -> float:
    """The information of a residual, where samples that are left out err as the others do.

    As parameters of their own they would cost more than they can gain, so that a machine in motion
    would seem to answer before its dead time is over.
    """
    even = len(left) / max(len(left) - signals.left_out(parts), 1)
    return information(np.sqrt(even) * left, parameters, SMALLEST)


# Where a search begins
# --------------------------------------------------------------------------------------------------


def of_poles(s: Numbers, delay: int) -> Parts:
    """Parts with these poles [rad/s]; real ones are put together in pairs, the slowest last."""
    complex_ = s[s.imag > 0]
    modes = [(np.log(abs(p)), np.log(max(-p.real / abs(p), 1e-4))) for p in complex_]
    real = sorted(np.maximum(-s[s.imag == 0].real, 1e-3), reverse=True)
    while len(real) > 1:
        fast, slow = real.pop(0), real.pop(0)
        w = np.sqrt(fast * slow)
        modes.append((np.log(w), np.log((fast + slow) / (2 * w))))
    return Parts(np.reshape(modes, (-1, 2)), np.log(real), delay=delay)


def difference_equation(signals: Signals, delay: int) -> tuple[Numbers, Numbers, float]:
    """Numbers a (n_y, m, n_y) and b (n_u, m, n_y) of an equation of high order, and what it leaves.

    The latter is the mean square of the prediction by one sample, with its degrees of freedom.
    """
    n_u, T, n = signals.u.shape
    n_y = signals.y.shape[1]
    u = delayed(signals.u, delay)
    m = int(min(LAGS, n // 4, signals.samples // (3 * (n_u + n_y))))
    rows, wanted = [], []
    for t in range(T):
        y = signals.y[t * n : (t + 1) * n]
        if len(y) <= m:
            continue
        past = np.lib.stride_tricks.sliding_window_view(y, m, axis=0)[:-1, :, ::-1]
        late = np.lib.stride_tricks.sliding_window_view(u[:, t, : len(y)].T, m, axis=0)[1:, :, ::-1]
        rows.append(np.concatenate([past.reshape(len(past), -1), late.reshape(len(late), -1)], 1))
        wanted.append(y[m:])
    X, Y = np.concatenate(rows), np.concatenate(wanted)
    X, length = unit_columns(np.hstack([X, np.ones((len(X), 1))]))
    gram = X.T @ X
    theta = np.linalg.solve(gram + 1e-12 * np.eye(len(gram)), X.T @ Y) / length[:, None]
    left = np.sum((Y - X @ (theta * length[:, None])) ** 2) / max(1, len(X) - len(theta)) / n_y
    a = theta[: n_y * m].reshape(n_y, m, n_y)
    return a, theta[n_y * m : -1].reshape(n_u, m, n_y), float(left)


def reduced_poles(signals: Signals, delay: int, clip: bool = True) -> Callable[[int], Numbers]:
    """The poles [rad/s] of any order, from a difference equation of high order that is reduced.

    Its answers to impulses make a Hankel matrix, whose singular vectors span the states of a model
    of any order (the eigensystem realisation algorithm). Unless `clip` is false, they are stable.
    """
    a, b, _ = difference_equation(signals, delay)
    n_u, m, n_y = b.shape
    L = 2 * m
    h = np.zeros((2 * L + 1, n_y, n_u))
    for k in range(2 * L + 1):
        if k < m:
            h[k] = b[:, k].T
        for i in range(min(k, m)):
            h[k] += a[:, i].T @ h[k - 1 - i]
    h = np.nan_to_num(h, posinf=0.0, neginf=0.0)
    index = np.arange(L)[:, None] + np.arange(L)
    H, H_later = (np.moveaxis(h[index + k], 2, 1).reshape(L * n_y, L * n_u) for k in range(2))
    U, size, V = np.linalg.svd(H)

    def poles(order: int) -> Numbers:
        order = min(order, len(size))
        root = np.sqrt(np.maximum(size[:order], np.finfo(float).tiny))
        z = np.linalg.eigvals((U[:, :order] / root).T @ H_later @ (V[:order].T / root))
        if clip:
            z = np.where(np.abs(z) > 0.9999, 0.9999 * z / np.abs(z), z)
        z = np.where((z.imag == 0) & (z.real < 0.01), 0.01 + np.abs(z.real) / 10, z)
        return np.log(z) / signals.dt

    return poles


def larger(signals: Signals, parts: Parts) -> tuple[list[Parts], list[Parts]]:
    """Parts with one lag more, and with one mode more: those that explain most of the residual.

    Of a long record some rows decide.
    """
    some = slice(None, None, max(1, signals.samples // SAMPLED))
    X, _ = unit_columns(columns(signals, parts)[0])
    y = signals.wanted(parts)
    residual = (y - X @ np.linalg.lstsq(X, y)[0])[some]
    Q = np.linalg.qr(X[some])[0]
    none = Parts(delay=parts.delay)
    rates = np.log(np.geomspace(1 / signals.duration, np.pi / signals.dt, GRID))
    lags = [none._replace(lags=np.array([w])) for w in rates]
    modes = [none._replace(modes=np.array([[w, np.log(z)]])) for w in rates for z in DAMPINGS]

    def best(tried: list[Parts]) -> list[Parts]:
        gains = []
        for one in tried:
            new = columns(signals, one)[0][some, 1:]
            new = np.linalg.qr(new - Q @ (Q.T @ new))[0]
            gains.append(np.sum((new.T @ residual) ** 2))
        return [parts.joined(tried[i]) for i in np.argsort(gains)[::-1][:TRIED]]

    return best(lags), best(modes)


def smaller(parts: Parts) -> Iterator[Parts]:
    """Parts without one of them; of a mode also without one of its two poles, where they are real.

    A damped mode counts as two equal real poles.
    """
    for i in range(len(parts.lags)):
        yield parts.without_lag(i)
    for i, (w, zeta) in enumerate(parts.modes):
        rest = parts.without_mode(i)
        yield rest
        apart = np.arccosh(max(np.exp(zeta), 1.0))
        for rate in {w - apart, w + apart} if np.exp(zeta) > 0.5 else ():
            yield rest._replace(lags=np.append(rest.lags, rate))
    if parts.direct:
        yield parts._replace(direct=False)


def later(parts: Parts) -> Iterator[Parts]:
    """Parts without a fast pole or pair of poles, and with more delay or a direct term instead.

    Poles that decay within a sample are a dead time or a direct term in disguise.
    """
    yield parts._replace(direct=True)
    for direct in {parts.direct, False}:
        yield parts._replace(delay=parts.delay + 1, direct=direct)
    for order in (parts.order - 1, parts.order - 2):
        fewer = [one for one in smaller(parts) if one.order == order]
        if not fewer:
            continue
        one = min(fewer, key=lambda one: np.sum(one.modes) + np.sum(one.lags))
        for jump in range(3):
            yield one._replace(delay=parts.delay + jump, direct=True)
            if jump:
                yield one._replace(delay=parts.delay + jump, direct=False)


def at_rest(parts: Parts, duration: float) -> Iterator[Parts]:
    """Parts whose slowest poles are integrators, where the record cannot tell them from these."""
    slowest = np.log(INTEGRATES / duration)
    if parts.integrators < 2:
        for i, lag in enumerate(parts.lags):
            if lag < slowest:
                yield parts.without_lag(i)._replace(integrators=parts.integrators + 1)
        for i, (w, zeta) in enumerate(np.exp(parts.modes)):
            fast = w * (zeta + np.sqrt(max(zeta**2 - 1, 0.0)))
            if zeta > 1 and np.log(w**2 / fast) < slowest:
                lags = np.append(parts.lags, np.log(fast))
                rest = parts.without_mode(i)._replace(lags=lags)
                yield rest._replace(integrators=parts.integrators + 1)
            elif w * duration < INTEGRATES and not parts.integrators:
                yield parts.without_mode(i)._replace(integrators=2)
    elif parts.integrators:
        lags = np.append(parts.lags, slowest)
        yield parts._replace(lags=lags, integrators=parts.integrators - 1)


# The search
# --------------------------------------------------------------------------------------------------


def long_enough(signals: Signals, parts: Parts) -> bool:
    """Whether the samples that are fitted are enough for all numbers of these parts."""
    n_u, n_y, order = len(signals.u), signals.y.shape[1], parts.order
    count = n_y + (order - parts.integrators) + n_u * n_y * parts.numerators
    samples = signals.samples
    if not signals.from_rest:
        count, samples = count + order * n_y, samples - parts.delay
    return samples * n_y >= SAMPLES_PER_PARAMETER * count


def moderate(signals: Signals, delay: int) -> Fitted:
    """The better fit of two moderate orders, from poles that hold wherever the machine begins."""
    poles = reduced_poles(signals, delay)
    fits = [refined(signals, of_poles(poles(n), delay), SHORT) for n in MODERATE]
    return min(fits, key=lambda one: one.bic)


def in_motion(signals: Signals, delay: int) -> bool:
    """Whether models of moderate order explain clearly more with free motions from the start."""
    if signals.u.shape[1] > 1:
        return False
    moving = moderate(signals._replace(from_rest=False), delay)
    return moving.bic < moderate(signals, delay).bic - MOVING


def first_delay(signals: Signals, longest: int) -> int:
    """The delay, of some up to the longest, at which models of moderate order fit best."""
    delays = sorted({*(d for d in DELAYS if d < longest), longest})
    return min((moderate(signals, d) for d in delays), key=lambda one: one.bic).parts.delay


def ladder(
    signals: Signals,
    delay: int,
    highest: int,
    each: Callable[[Fitted], object],
    imitates: Callable[[list[Fitted]], bool],
    *,
    least: int = 1,
) -> dict[int, Fitted]:
    """The best fit of each order from 1 on, until the criterion no longer falls.

    least: the order that is reached in any case
    imitates: asked once, whether more poles would only imitate what is not linear
    """
    poles, best = reduced_poles(signals, delay), {}
    starts: dict[int, list[Parts]] = {}
    for order in range(1, highest + 1):
        begin = [of_poles(poles(order), delay), *starts.pop(order, [])]
        short = min((refined(signals, p, SHORT) for p in begin), key=lambda one: one.cost)
        best[order] = refined(signals, short.parts, LONG)
        each(best[order])
        if order > least and order - min(best, key=lambda n: best[n].bic) >= PATIENCE:
            break
        if order == ASKED and imitates(list(best.values())):
            break
        lags, modes = larger(signals, best[order].parts)
        starts.setdefault(order + 1, []).extend(lags)
        starts.setdefault(order + 2, []).extend(modes)
    return best


def improved(
    signals: Signals,
    part: Signals,
    now: Fitted,
    *,
    order: int | None,
    delays: tuple[int, int],
    highest: int,
    each: Callable[[Fitted], object],
) -> tuple[Fitted, list[Fitted]]:
    """The fit after single changes of its parts, for as long as the criterion falls, and all tried.

    A part goes or comes, the delay changes, a direct term comes or goes, a slow pole becomes an
    integrator.

    part: of the signals, on which changes are compared before the best two are refined; where it
        is not all of them, also the other one of the least residual, since a part shows less
    order: the order where it is fixed
    delays: the least and the longest
    """
    tried = []
    while True:
        parts = now.parts
        changed = [*smaller(parts), *at_rest(parts, signals.duration)]
        changed += later(parts)
        changed += [
            parts._replace(delay=parts.delay - 1, direct=direct) for direct in {parts.direct, False}
        ]
        for more in larger(signals, parts):
            changed += more[:1]
        allowed = [
            p
            for p in changed
            if p.kind != parts.kind
            and delays[0] <= p.delay <= delays[1]
            and long_enough(signals, p)
            and (p.order == order if order else 0 < p.order <= highest)
        ]
        short = sorted((refined(part, p, SHORT) for p in allowed), key=lambda one: one.bic)
        others = sorted(short[2:], key=lambda one: one.cost)[: part is not signals]
        long = [refined(signals, one.parts, LONG) for one in (*short[:2], *others)]
        tried += [*(short if part is signals else ()), *long]
        after = min([now, *long], key=lambda one: one.bic)
        if after is now:
            return now, tried
        now = after
        each(now)


def numerators(signals: Signals, parts: Parts) -> tuple[Numbers, Numbers]:
    """(c, n_y) what the columns are multiplied by, and (T (N+1), n_y) the output, of all rows."""
    X = columns(signals, parts)[0]
    fitted, length = unit_columns(X[: signals.samples])
    y, late = signals.wanted(parts)[: signals.samples], signals.left_out(parts)
    N = np.linalg.lstsq(fitted, y)[0]
    return N / length[:, None], np.concatenate([signals.y[:late], (X / length @ N)[late:]])


def foretold(signals: Signals, parts: Parts) -> tuple[Numbers, Numbers]:
    """The output of the part that was not fitted, and its residual."""
    y = signals.y[signals.samples :]
    return y, y - numerators(signals, parts)[1][signals.samples :]


# The plant
# --------------------------------------------------------------------------------------------------


def answers_of(signals: Signals, parts: Parts) -> Answers:
    """What a model of one input and one output answers, without its bias."""
    kick = np.zeros(signals.u.shape)
    kick[..., 1] = 1.0  # the input comes one sample late
    N, modelled = numerators(signals, parts)
    kicked = columns(signals._replace(u=kick, from_rest=True), parts)[0][:, 1:]
    both = (modelled - N[0], kicked @ N[1 : 1 + kicked.shape[1]])
    return Answers(parts.order, *((of * signals.scale)[:, 0] for of in both))


def into_states(parts: Parts, dt: float) -> Numbers:
    """(c, c) the columns of one input, as those of `columns`, times this are the held states."""
    blocks = [np.eye(int(parts.direct))]
    if parts.integrators:
        both = np.array([[dt, -(dt**2) / 2], [0.0, dt**2]])
        blocks.append(both[: parts.integrators, : parts.integrators])
    for w, zeta in np.exp(parts.modes):
        A = np.array([[0.0, w, 0.0], [-w, -2 * zeta * w, w], [0.0, 0.0, 0.0]])
        (a, b, x), (c, d, v), _ = scipy.linalg.expm(A * dt)
        blocks.append(np.array([[x, v], [b * v - d * x, c * x - a * v]]))
    blocks += [np.array([[-np.expm1(-np.exp(lag) * dt)]]) for lag in parts.lags]
    return scipy.linalg.block_diag(*blocks)


def plant_of(signals: Signals, parts: Parts) -> ModalModel:
    """The plant with these parts and the least squares of its numerators."""
    n_u, n_y = len(signals.u), signals.y.shape[1]
    M = into_states(parts, signals.dt)
    N = numerators(signals, parts)[0][1 : 1 + n_u * len(M)] * signals.scale
    N = np.linalg.solve(M, N.reshape(len(M), -1)).reshape(len(M), n_u, n_y)
    N = np.swapaxes(N, 1, 2) if n_u * n_y > 1 else N[:, 0, 0]
    q, m, d = len(parts.modes), parts.integrators, int(parts.direct)
    I_1, I_2 = (*N[d : d + m], None, None)[:2]
    of_modes, of_lags = N[d + m : d + m + 2 * q], N[d + m + 2 * q :]
    w, zeta = np.exp(parts.modes).T
    by_rate, slowest = np.argsort(w), np.argsort(parts.lags)
    lags = (of[slowest] for of in (np.exp(parts.lags), of_lags))
    modes = (of[by_rate] for of in (w, zeta, of_modes[::2], of_modes[1::2]))
    delay = parts.delay * signals.dt
    return ModalModel(*lags, *modes, I_1, I_2, N[0] if d else None, delay)


# Real zeros
# --------------------------------------------------------------------------------------------------


class WithZeros(NamedTuple):
    """Parts with a numerator of lower degree, prod_i (1 - s / zeros_i) times a gain.

    numerator: (m+1,) coefficients of powers of s / unit
    """

    parts: Parts
    numerator: Numbers
    unit: float
    bic: float

    @property
    def zeros(self) -> Numbers:
        """(m,) [rad/s]."""
        return self.unit * np.polynomial.polynomial.polyroots(self.numerator)


def with_zeros(signals: Signals, fitted: Fitted) -> WithZeros:
    """The best fit of all degrees of the numerator below the order, of one input and one output."""
    parts, y = fitted.parts, signals.wanted(fitted.parts)[:, 0]
    rates = np.exp(np.concatenate([parts.modes[:, 0], parts.lags]))
    unit = float(np.exp(np.mean(np.log(rates))))
    s = (0.3 + 1j) * np.geomspace(0.05 * rates.min(), 20 * rates.max(), 12 * parts.order)[:, None]

    def basis(parts: Parts, degree: int) -> Numbers:
        """(rows, c) ones, outputs of (s / unit)^k over the denominator, and those of a start."""
        w, zeta = np.exp(parts.modes).T
        second, first = 1 + 2 * zeta * s / w + (s / w) ** 2, 1 + s / np.exp(parts.lags)
        of_modes = np.stack([1 / second, s / w / second], axis=2).reshape(len(s), -1)
        of_states = np.hstack([of_modes, 1 / first])
        whole = np.prod(second, axis=1) * np.prod(first, axis=1)
        wanted = (s / unit) ** np.arange(degree + 1.0) / whole[:, None]
        size = np.abs(wanted[:, :1])
        of_states, wanted = (np.vstack([M.real, M.imag]) for M in (of_states / size, wanted / size))
        T = np.linalg.lstsq(of_states, wanted)[0]
        X = columns(signals, parts)[0]
        states = X[:, 1 : 1 + parts.order] @ into_states(parts, signals.dt)
        return np.hstack([X[:, :1], states @ T, X[:, 1 + parts.order :]])

    def solved(x: Numbers, degree: int) -> tuple[Numbers, Numbers]:
        X, length = unit_columns(basis(parts.at(x), degree))
        N = np.linalg.lstsq(X, y)[0]
        return N / length, X @ N - y

    low, high = bounds(signals, parts)
    found: list[WithZeros] = []
    for degree in reversed(range(parts.order)):
        x = scipy.optimize.least_squares(
            lambda x, degree=degree: solved(x, degree)[1],
            np.clip(parts.x, low + 1e-6, high - 1e-6),
            bounds=(low, high),
            x_scale="jac",
            max_nfev=20,
            ftol=1e-7,
        ).x
        N, residual = solved(x, degree)
        bic = criterion(signals, parts, residual, len(x) + len(N) + (parts.delay > 0))
        numerator = N[1 : 2 + degree] * signals.scale[0]
        found.append(WithZeros(parts.at(x), numerator, unit, bic))
        if bic > min(one.bic for one in found) + FAR:  # a coefficient that is needed is missing
            break
    return min(found, key=lambda one: one.bic)


def with_real_zeros(signals: Signals, fitted: Fitted) -> ProcessModel | None:
    """The ProcessModel that explains the record as well as the sum of parts; None if none does."""
    parts = fitted.parts
    if signals.y.shape[1] > 1 or len(signals.u) > 1 or parts.order > SIMPLE:
        return None
    if parts.direct or parts.integrators:
        return None
    best = with_zeros(signals, fitted)
    zeros = best.zeros
    if best.bic > fitted.bic + EQUAL or np.any(np.abs(zeros.imag) > 1e-6 * np.abs(zeros)):
        return None
    lags, (w, zeta) = np.exp(best.parts.lags), np.exp(best.parts.modes).T
    delay = parts.delay * signals.dt
    return ProcessModel(best.numerator[0], zeros.real, lags, w, zeta, delay).regrouped()


# The whole way
# --------------------------------------------------------------------------------------------------


class Tried(NamedTuple):
    """A fit that was compared.

    order: number of poles, with those of the integrators
    modes, lags, integrators, direct: its parts
    rms: root mean square of the residual over the fitted part, of several outputs relative to them
    validation_fit: fit over the validation part [%]
    """

    order: int
    modes: int
    lags: int
    integrators: int
    direct: bool
    delay: int
    parameters: int
    rms: float
    bic: float
    validation_fit: float


class Grown(NamedTuple):
    """What `grow` found.

    tried: the best fit of each order that was looked at, and of each delay and kind beside the best
    chosen: that of them which was chosen
    suspicions: what may not be linear
    """

    found: Identified
    tried: list[Tried]
    chosen: Tried
    suspicions: list[Suspicion]
    __repr__ = in_short


def grow(
    record: Record,
    *,
    order: int | None = None,
    delay: int | None = None,
    fit_share: float = 0.7,
    longest: int = LONGEST_LOOKED_FOR,
    from_rest: bool | None = None,
    each: Callable[[str], object] = lambda said: None,
) -> Grown:
    """The plant of a record, of an order that is found, with complex zeros where they are there.

    A sum of lags and modes (`ModalModel`) grows by one pole at a time while the Bayesian
    information criterion falls; then single changes are tried until none makes it fall: a part less
    or more, a sample of delay less or more, a direct term, an integrator in place of a slow pole.
    Of the lower orders, one that is better on the validation part is taken instead. With one input
    and one output, a `ProcessModel` whose criterion is smaller, since it has fewer and real zeros,
    is the answer. In the end `identify` fits all numbers of the plant, and judges it. Where its
    residual is not white, and a plant of at most 6 poles leaves less together with something that
    is not linear (`suspicions`), that plant is the answer, since more poles would imitate it; with
    8 poles this is asked once, and growing ends where it explains half of the residual.

    record: of any number of inputs and outputs, which share the poles
    order: number of poles; None where it is looked for
    delay: dead time in samples, beyond the one of the hold; None where it is looked for
    fit_share: share of the record that is fitted; the rest validates
    longest: the longest delay that is looked for, in samples
    from_rest: whether the machine rests at the start, as for `identify`
    each: called with a few words on what was found so far

    Raises ValueError as `identify` does, and where the record is that of an unstable plant.
    """
    record = checked_record(record)
    require("identify", "fit_share", fit_share, "(0, 1]")
    samples = round(fit_share * len(record.y))
    require("identify", "order", order, f"[1, {HIGHEST}]", whole=True, optional=True)
    n_u, n_y = record.u.shape[1], record.y.shape[1]
    need_samples(samples * n_y, n_y + (order or 1) * (1 + n_u * n_y))
    need_excitation(record, samples)
    if delay is not None:
        most = min(LONGEST_DELAY, min(samples - 1, len(record.u) // record.trials) - 1)
        require("identify", "delay", delay, f"[0, {most}]", whole=True, note=" for this record")
    whole = Signals.of(record, samples)
    require("grow", "longest", longest, f"[0, {LONGEST_DELAY}]", whole=True)
    longest = min(longest, len(record.u) // record.trials // 3)
    delays = (0, longest) if delay is None else (delay, delay)
    part = whole.first().part()
    first = len(part.y) if len(part.y) < samples else None
    late = min(longest, first_lag(record, longest, first)) if delay is None else delay
    if from_rest is False or (from_rest is None and in_motion(part, late)):
        whole = whole._replace(from_rest=False)
    signals = whole.first()
    part = signals.part()
    lags = (of_poles(-np.ones(n), 0) for n in range(2, HIGHEST + 1))
    highest = 1 + sum(long_enough(signals, parts) for parts in lags)
    began = first_delay(part, late) if delay is None else delay

    def say(one: Fitted) -> None:
        parts = one.parts
        each(f"order {parts.order}, delay {parts.delay}: {one.percent:.4g} % fit")

    fixed = order
    judge = partial(identify, record, fit_share=fit_share, from_rest=whole.from_rest)

    def suspected(fits: Iterable[Fitted], *others: Identified) -> list[Suspicion]:
        if n_u * n_y * record.trials > 1:
            return []
        simple = [answers_of(whole, one.parts) for one in fits if one.parts.order <= SIMPLE]
        return suspicions(record, [*others, *simple])

    def imitates(fits: list[Fitted]) -> bool:
        nonlocal fixed
        told = suspected(fits) if order is None else []
        if told and told[0].share > MOSTLY:
            fixed = told[0].order
        return fixed != order

    steps = ladder(part, began, order or highest, say, imitates, least=order or 1)
    start = steps[fixed] if fixed else min(steps.values(), key=lambda one: one.bic)
    if delay is None:  # a delay that is far off would be left sample by sample, or by more poles
        most = start.parts.order
        orders = {most} if fixed else {most, *range(1, min(most, SIMPLE))}
        others = [steps[n].parts._replace(delay=d) for n in orders
                  for d in DELAYS if d <= late and d != began]  # fmt: skip
        others = [refined(part, parts, SHORT) for parts in others if long_enough(signals, parts)]
        start = min([start, *others], key=lambda one: one.bic)
    if part is not signals:
        steps = {n: refined(signals, one.parts, 0) for n, one in steps.items()}
        start = refined(signals, start.parts, LONG)
    improve = partial(improved, delays=delays, highest=highest, each=say)
    best, tried = improve(signals, part, start, order=fixed)
    need_stable(whole, best)
    kinds: dict[tuple[Value, ...], Fitted] = {}
    for one in (*steps.values(), *tried, best):
        kind = one.parts.kind
        kinds[kind] = min(kinds.get(kind, one), one, key=lambda one: one.bic)
    if fixed is None and fit_share < 1:
        best = by_validation(whole, best, list(kinds.values()))
    if from_rest is None and not whole.from_rest:
        rest = signals._replace(from_rest=True)
        near, _ = improve(rest, rest.part(), refined(rest, best.parts, SHORT), order=fixed)
        if near.bic < best.bic + MOVING or not long_enough(signals, best.parts):
            return grow(
                record, order=order, delay=delay, fit_share=fit_share, longest=longest,
                from_rest=True, each=each,
            )  # fmt: skip
    plant = with_real_zeros(signals, best) or plant_of(whole, best.parts)
    each(f"order {best.parts.order}: intervals")
    found = judge(plant)
    lower = [] if found.white or fixed else steps.values()
    told = suspected(lower, found)
    if told and told[0].order < best.parts.order and told[0].rms < float(found.residual_std[0]):
        best, _ = improve(signals, part, steps[told[0].order], order=told[0].order)
        found = judge(plant_of(whole, best.parts))
    kinds[best.parts.kind] = best
    others = [one for one in _worth_telling(kinds.values()) if one.parts.kind != best.parts.kind]
    rows = [_told(whole, one) for one in (best, *others)]
    return Grown(found, sorted(rows, key=lambda row: (row.order, row.bic)), rows[0], told)


def by_validation(whole: Signals, best: Fitted, others: list[Fitted]) -> Fitted:
    """The best fit, or that of a lower order that is clearly better on the validation part."""
    of_orders = {one.parts.order: one for one in sorted(others, key=lambda one: -one.bic)}
    lower = [one for order, one in of_orders.items() if order < best.parts.order]

    def left(one: Fitted) -> float:
        return float(np.sum(foretold(whole, one.parts)[1] ** 2))

    other = min(lower, key=left, default=best)
    return other if left(other) < CLEARLY * left(best) else best


def need_stable(whole: Signals, best: Fitted) -> None:
    """Raises ValueError where no stable model explains the record, and an unstable one would.

    A difference equation predicts each sample from those before it, so it may have a pole that
    grows; a simulation may not. It has no delay, since a too long one would show as such a pole.
    Where neither explains what is left, such as answers within a sample, its poles are chance. One
    that moves with the order to which the equation is reduced is chance, too: an axis with friction
    seems to have one at few orders, since the equation sees the answers of `LAGS` samples alone.
    """
    ahead = _told(whole, best).validation_fit
    if best.percent > EXPLAINED and not ahead < EXPLAINED:
        return
    simulated = np.mean((whole.y - numerators(whole, best.parts)[1]) ** 2)
    signals = whole.first().part()
    if difference_equation(signals, 0)[2] > FORESEEN * simulated:
        return
    poles = reduced_poles(signals, 0, clip=False)
    growth, above = sorted(np.max(poles(n).real) for n in (MODERATE[0], HIGHEST))
    if growth * signals.duration > GROWS and above < MOVES * growth:
        raise ValueError(
            f"identify: the plant seems to be unstable, with a pole near +{growth:.3g} rad/s; keep "
            "it under its feedback, and identify from the reference to the output"
        )


def _worth_telling(fits: Iterable[Fitted]) -> list[Fitted]:
    """The best fit of each order, and the best ones of all."""
    ranked = sorted(fits, key=lambda one: one.bic)
    first = {one.parts.order: one for one in reversed(ranked)}
    kinds = {one.parts.kind: one for one in (*first.values(), *ranked[:6])}
    return list(kinds.values())


def _told(whole: Signals, one: Fitted) -> Tried:
    share, n_y = float(np.min(fit_of(*foretold(whole, one.parts)))), whole.y.shape[1]
    unit = float(whole.scale[0]) if n_y == 1 else 1.0
    rms = unit * float(np.sqrt(one.cost / (whole.samples * n_y)))
    parts, parameters = one.parts, one.parameters
    return Tried(
        parts.order, **parts.counts, delay=parts.delay, parameters=parameters, rms=rms,
        bic=one.bic, validation_fit=share,
    )  # fmt: skip


def orders_and_delays(
    record: Record, *, longest: int = LONGEST_LOOKED_FOR, **options: Value
) -> list[Order]:
    """Fits of several structures with the dead time of `grow`, which is to be used in its place.

    longest: the longest delay that is looked for, in samples
    options: as for `compare_orders`
    """
    warnings.warn("orders_and_delays is now grow, without a list", FutureWarning, stacklevel=2)
    delay = grow(record, longest=longest).chosen.delay
    return compare_orders(record, delay=delay, **options)


# The dead time, as the first answer tells it
# --------------------------------------------------------------------------------------------------


def first_lag(record: Record, longest: int = LONGEST_LOOKED_FOR, first: int | None = None) -> int:
    """The samples between the input and the first significant answer, less the one of the hold.

    A difference equation of high order is fitted by linear least squares, where the noise is white:

        y[k] = c + sum_{i=1..n} (a_i y[k-i] + b_i u[k-i])

    The estimate is i - 1 of the first b_i that is more than 4 standard errors from 0. It is 0 where
    none is, or where the record is too short for such a fit. Of several experiments, the first is
    taken, or its `first` samples.
    """
    u, y = (as_columns("first_lag", name, getattr(record, name))[:, 0] for name in "uy")
    u, y = (of[: len(of) // record.trials] for of in (u, y))
    u, y = u[:first], y[: len(u[:first]) + 1]
    n = min(longest + BEYOND, (len(u) - 1) // 6)
    if n < 1:
        return 0
    lagged = np.lib.stride_tricks.sliding_window_view
    rows = np.hstack([lagged(of, n)[:, ::-1] for of in (y[:-1], u)])
    scale = np.std(rows, axis=0)
    rows = np.hstack([np.ones((len(rows), 1)), rows / np.where(scale == 0, 1.0, scale)])
    found, _, rank, _ = np.linalg.lstsq(rows, y[n:])
    freedom = len(rows) - rank
    if freedom < 1:
        return 0
    variance = np.sum((y[n:] - rows @ found) ** 2) / freedom
    errors = np.sqrt(variance * np.abs(np.diag(np.linalg.pinv(rows.T @ rows))))
    answers = np.abs(found[1 + n :]) > SIGNIFICANT * errors[1 + n :]
    return min(int(np.argmax(answers)), longest) if np.any(answers) else 0
