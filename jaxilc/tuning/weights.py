"""The weights that are tuned, and the result of a tuning.

A weight is a float leaf of a scheme, or an element of one. It has an open range, which is mapped to
the real line: the optimiser moves its coordinate z there.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from ..learning.machine import Machine
from ..learning.over_trials import check
from ..pytree.aliases import Value
from ..pytree.in_short import in_short
from ..pytree.named_paths import get_at, interval_at, named_leaves, need_leaf, replaced
from ..pytree.ranges import brief
from ..schemes import Scheme
from ..signals.task import Task
from .descent import State

FARTHEST = 12.0  # largest |z| for which room is checked: a factor e^12, or 6e-6 from an end
MARGIN = 1e-6  # smallest distance of a value from an end of its range, on the unit interval
FAR = 60.0  # largest |z| on the real line; beyond it exponentials are held constant
NUDGE = 1e-3  # share of the range by which a start on its end is moved inside
CLOSE = 0.02  # share of the range up to which a value has come to its end

# Names of weights with their bounds, None for the range that the leaf allows.
NamesOrBounds = Mapping[str, tuple[float, float] | None] | Sequence[str]


@dataclasses.dataclass(frozen=True)
class Bijection:
    """A smooth map of the real line onto an open interval, with s(z) = 1 / (1 + e^-z).

        (-inf, inf)    scale z
        (a, inf)       a + e^z
        (-inf, b)      b - e^z
        (a, b)         a + (b - a) s(z)
        (a, b), a and b of one sign    a (b / a)^s(z): each order of magnitude has the same weight

    low, high: () ends of the interval
    scale: () factor of the map onto the whole real line
    margin: smallest distance of a value from an end of a finite interval, as a share of it
    """

    low: float
    high: float
    scale: float = 1.0
    margin: float = MARGIN

    @classmethod
    def of(cls, low: float, high: float, start: float) -> Bijection:
        """The map that reaches a start, however near to an end, unless it lies on the end."""
        whole = cls(low, high, abs(start) or 1.0)
        if len(whole._ends) < 2:
            return whole
        share = whole._share(start)
        margin = min(MARGIN, min(share, 1.0 - share) / 20) or MARGIN
        rounding = float(jnp.finfo(jnp.result_type(float)).eps)
        return dataclasses.replace(whole, margin=max(margin, rounding))

    @property
    def _ends(self) -> tuple[tuple[float, float], ...]:
        """The finite ends, each with the sign of the direction into the interval."""
        both = (self.low, 1.0), (self.high, -1.0)
        return tuple(one for one in both if np.isfinite(one[0]))

    def __call__(self, z):
        match self._ends:
            case ():
                return self.scale * z
            case ((end, sign),):
                nearest = np.log(MARGIN * abs(end)) if end else -FAR
                return end + sign * jnp.exp(jnp.clip(z, nearest, FAR))
        return self._at(self.margin + (1.0 - 2.0 * self.margin) * jax.nn.sigmoid(z))

    def inverse(self, value: float) -> float:
        """The number z that is mapped to this value inside the interval."""
        match self._ends:
            case ():
                return value / self.scale
            case ((end, sign),):
                return float(np.log(sign * (value - end)))
        share = (self._share(value) - self.margin) / (1.0 - 2.0 * self.margin)
        return float(np.log(share / (1.0 - share)))

    def inside(self, value: float) -> float:
        """The value, moved inside the interval if it lies on an end of it."""
        match self._ends:
            case ():
                return value
            case ((end, sign),):  # 0 is approached exponentially, without a distance
                near = sign * (value - end) <= 10 * MARGIN * abs(end)
                return end + sign * NUDGE * (abs(end) or 1.0) if near else value
        share = self._share(value)
        near = not 10 * self.margin < share < 1.0 - 10 * self.margin
        return float(self._at(NUDGE if share < 0.5 else 1.0 - NUDGE)) if near else value

    def reached(self, start: float, value: float) -> tuple[float, float] | None:
        """The end of a finite interval that the value has come to, and a number beyond that end.

        None for a value inside, and for one that has not gone nine tenths of its way to the end.
        """
        if len(self._ends) < 2:
            return None
        first, last = self._share(self.inside(start)), self._share(value)
        if last < min(CLOSE, first / 10):
            return self.low, float(self._at(-CLOSE))
        if 1.0 - last < min(CLOSE, (1.0 - first) / 10):
            return self.high, float(self._at(1.0 + CLOSE))
        return None

    def _at(self, share):
        """The value at a share of the way from one finite end to the other."""
        low, high = self.low, self.high
        return low * (high / low) ** share if low * high > 0 else low + (high - low) * share

    def _share(self, value: float) -> float:
        """The share at which `_at` is the value."""
        low, high = self.low, self.high
        if low * high > 0:
            return float(np.log(value / low) / np.log(high / low))
        return (value - low) / (high - low)


@dataclasses.dataclass(frozen=True)
class Weights:
    """The P weights of a tuning by name.

    bijections: maps from z on the real line to each weight
    start: values in the scheme, which may be ends of a range
    """

    bijections: dict[str, Bijection]
    start: dict[str, float]

    @classmethod
    def of(cls, scheme: Scheme, asked: NamesOrBounds) -> Weights:
        """The weights of a scheme that were asked for.

        Raises ValueError naming a weight that does not exist, is absent or static, bounds that are
        empty or not allowed, and a start outside its bounds.
        """
        if isinstance(asked, str):
            raise ValueError(f"Tuning: weights = {asked!r} is text; allowed are names, [{asked!r}]")
        if not isinstance(asked, Iterable):
            raise ValueError(
                f"Tuning: weights = {brief(asked)} is a {type(asked).__name__}; allowed are names, "
                "or bounds by name"
            )
        asked = asked if isinstance(asked, Mapping) else dict.fromkeys(asked)
        if not asked:
            raise ValueError("Tuning: weights is empty; at least one is needed")
        found = {name: _elements(scheme, name, of) for name, of in asked.items()}
        bounds = {element: b for of in found.values() for element, b in of.items()}
        given = [name for name, of in asked.items() if of is not None]
        for name in sorted(given, key=lambda name: name.count("[")):  # an element's own ones count
            bounds |= found[name]
        start = {name: float(get_at(scheme, name)) for name in bounds}
        return cls({name: Bijection.of(*b, start[name]) for name, b in bounds.items()}, start)

    def at(self, z) -> dict[str, jax.Array]:
        """The values of the weights by name, for z (..., P)."""
        return {name: b(z[..., i]) for i, (name, b) in enumerate(self.bijections.items())}

    @property
    def inside(self) -> dict[str, float]:
        """The start values, moved inside where they lie on an end of a range."""
        return {name: b.inside(self.start[name]) for name, b in self.bijections.items()}

    def starts(self, count: int, scatter: float, seed: int) -> np.ndarray:
        """(count, P) z of the start, and random z around it with standard deviation `scatter`."""
        scattered = scatter * np.random.default_rng(seed).standard_normal((count, len(self.start)))
        scattered[0] = 0.0
        z = (
            np.array([b.inverse(self.inside[name]) for name, b in self.bijections.items()])
            + scattered
        )
        return z.astype(jnp.result_type(float))

    def need_room(self, machine: Machine, scheme: Scheme, task: Task) -> None:
        """Check that the scheme accepts the values that the bounds of each weight allow.

        Raises ValueError if it does not, as for a cutoff of a filter beyond the Nyquist frequency.
        """
        for name, bijection in self.bijections.items():
            for z in (-FARTHEST, FARTHEST):
                value = float(bijection(z))
                try:
                    check(machine, replaced(scheme, {name: value}), task)
                except ValueError as error:
                    raise ValueError(
                        f"weights: within its bounds {name} may become {value:g}; {error}. "
                        "Give narrower bounds"
                    ) from None


@dataclasses.dataclass(frozen=True)
class Tuned:
    """The result of a tuning.

    values: weights by name, of the judged iterate with the least held-out loss, or `start`
    loss: (steps, K) training loss of each step and start
    slope: (steps, K) length of the gradient by z, which falls to 0 where a weight nears an end of
        its range, however the loss changes with the weight itself
    dropped: (steps, K) how many machines had no finite gradient
    weights: (steps, K) values by name at which the loss was computed
    held_out: (steps + 1, K) held-out loss, NaN where it was not computed
    before, after: held-out loss with `start` and with `values`
    step: after which the iterate was reached, 0 for `start`
    nudged: new values by name, of weights that lay on an end of their range and were moved away
    """

    values: dict[str, float]
    scheme: Scheme
    start: dict[str, float]
    loss: np.ndarray
    slope: np.ndarray
    dropped: np.ndarray
    weights: dict[str, np.ndarray]
    held_out: np.ndarray
    before: float
    after: float
    step: int
    nudged: dict[str, float]
    reason: str
    __repr__ = in_short

    @classmethod
    def of(
        cls,
        state: State,
        weights: Weights,
        scheme: Scheme,
        before: float,
        after: float,
        reason: str,
    ) -> Tuned:
        """The result of the descent that ended in `state`, for the weights of a scheme."""
        done, best = int(state.step), int(state.best_step)
        values = {name: float(value) for name, value in weights.at(state.best_z).items()}
        if after >= before:  # also where the start was moved into its range
            values, after, best = dict(weights.start), before, 0
        return cls(
            values=values,
            scheme=replaced(scheme, values),
            start=dict(weights.start),
            loss=state.loss[:done],
            slope=state.slope[:done],
            dropped=state.dropped[:done],
            weights={
                name: np.asarray(value) for name, value in weights.at(state.path[:done]).items()
            },
            held_out=state.held_out[: done + 1],
            before=before,
            after=after,
            step=best,
            nudged={
                name: value
                for name, value in weights.inside.items()
                if value != weights.start[name]
            },
            reason=reason,
        )


def _elements(
    scheme: Scheme, name: str, bounds: tuple[float, float] | None
) -> dict[str, tuple[float, float]]:
    """The elements of a leaf by name, with their bounds.

    Raises ValueError as `Weights.of` says.
    """
    try:
        value = get_at(scheme, name)
    except KeyError as error:
        raise ValueError(f"weights: {error.args[0]}") from None
    if not any(name == of or name.startswith(f"{of}[") for of in named_leaves(scheme)):
        raise ValueError(
            f"weights: {name} = {value!r} is not a float leaf of this scheme and cannot be tuned"
        )
    need_leaf("weights", scheme, name)
    allowed: Value = interval_at(scheme, name)  # every float leaf has an interval
    try:
        low, high = (allowed.low, allowed.high) if bounds is None else map(float, bounds)
    except (TypeError, ValueError):
        raise ValueError(
            f"weights: the bounds {brief(bounds)} of {name} are not two numbers (low, high)"
        ) from None
    if not low < high:
        raise ValueError(f"weights: the bounds ({low:g}, {high:g}) of {name} are empty")
    if low < allowed.low or high > allowed.high:
        raise ValueError(
            f"weights: the bounds ({low:g}, {high:g}) of {name} leave its allowed range {allowed}"
        )
    if not np.all((low <= np.asarray(value)) & (np.asarray(value) <= high)):
        raise ValueError(
            f"weights: the start {name} = {np.asarray(value)} is outside its bounds "
            f"({low:g}, {high:g})"
        )
    return {
        name + "".join(f"[{i}]" for i in index): (low, high)
        for index in np.ndindex(np.shape(value))
    }
