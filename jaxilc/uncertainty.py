"""Uncertain plants: distributions of named leaves of a machine, and the machines drawn from them.

    {"plant.gain": Uniform(0.9, 1.1, relative=True), "plant.poles[2]": Normal(6.4, 0.5),
     "actuator.limit": LogUniform(5, 20)}

One number is drawn for each name. A relative number scales the leaf (an array as a whole). An
absolute number replaces a scalar or a single element. A `Population` is a machine with such an
uncertainty and the way in which machines are drawn from it: machine 0 is always the nominal one,
and numbers are drawn on the host, in float64, from a seed.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Mapping
from functools import cached_property, wraps
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from .pytree.aliases import Tree, Value
from .pytree.closest import need_known
from .pytree.in_short import in_short
from .pytree.named_paths import get_at, interval_at, kind_at, overlapping, replaced
from .pytree.ranges import SEEDS, brief, require
from .runtime.capacity import check_size

COPIES = 6  # number of copies of all numbers that are in RAM while they are drawn
SAMPLINGS = ("monte-carlo", "latin-hypercube", "sobol", "corners")


@dataclasses.dataclass(frozen=True)
class Uniform:
    """The uniform distribution on [low, high]."""

    low: float
    high: float
    relative: bool = False

    def __post_init__(self) -> None:
        _need_numbers(self, low="(-inf, inf)", high="(-inf, inf)")
        if not self.low < self.high:
            raise ValueError(f"Uniform: low = {self.low:g} must lie below high = {self.high:g}")
        _need_finite(self)

    def quantile(self, p: np.ndarray) -> np.ndarray:
        """The quantile function: a draw is below this value with probability p."""
        return self.low + p * (self.high - self.low)

    def corners(self) -> tuple[float, float]:
        return self.low, self.high

    def spread(self, half_width: float) -> Uniform:
        """The relative uniform distribution on [1 - half_width, 1 + half_width]."""
        return Uniform(1.0 - half_width, 1.0 + half_width, relative=True)


@dataclasses.dataclass(frozen=True)
class Normal:
    """The normal distribution; its corners are two standard deviations from the mean."""

    mean: float
    std: float
    relative: bool = False

    def __post_init__(self) -> None:
        _need_numbers(self, mean="(-inf, inf)", std="(0, inf)")
        _need_finite(self)

    def quantile(self, p: np.ndarray) -> np.ndarray:
        """The quantile function: a draw is below this value with probability p."""
        from scipy.special import ndtri  # imported here, because the import is slow

        return self.mean + self.std * ndtri(np.clip(p, 1e-12, 1.0 - 1e-12))

    def corners(self) -> tuple[float, float]:
        return self.mean - 2.0 * self.std, self.mean + 2.0 * self.std

    def spread(self, half_width: float) -> Normal:
        """The relative normal distribution of mean 1 with two standard deviations = half_width."""
        return Normal(1.0, half_width / 2.0, relative=True)


@dataclasses.dataclass(frozen=True)
class LogUniform:
    """The distribution on [low, high], 0 < low < high, whose logarithm is uniform."""

    low: float
    high: float
    relative: bool = False

    def __post_init__(self) -> None:
        _need_numbers(self, low="(-inf, inf)", high="(-inf, inf)")
        if not 0 < self.low < self.high:
            raise ValueError(
                f"LogUniform: low = {self.low:g} and high = {self.high:g} must satisfy "
                "0 < low < high"
            )
        _need_finite(self)

    def quantile(self, p: np.ndarray) -> np.ndarray:
        return self.low * (self.high / self.low) ** p

    def corners(self) -> tuple[float, float]:
        return self.low, self.high

    def spread(self, half_width: float) -> LogUniform:
        return LogUniform(1.0 / (1.0 + half_width), 1.0 + half_width, relative=True)


Distribution = Uniform | Normal | LogUniform
Uncertainty = Mapping[str, Distribution]


class Drawn(NamedTuple):
    """All that a program needs to know of a distribution."""

    relative: bool


def _need_numbers(distribution: Distribution, **ranges: str) -> None:
    """Raises ValueError unless each field is in its range, and `relative` is True or False."""
    name = type(distribution).__name__
    for field, interval in ranges.items():
        require(name, field, getattr(distribution, field), interval)
        object.__setattr__(distribution, field, float(getattr(distribution, field)))
    if not isinstance(distribution.relative, bool | np.bool_):
        raise ValueError(
            f"{name}: relative = {brief(distribution.relative)} is not one of True, False"
        )


def _need_finite(distribution: Distribution) -> None:
    """Raises ValueError where a draw, or the ratio high / low of a `LogUniform`, is not finite."""
    with np.errstate(all="ignore"):
        ends = [*distribution.quantile(np.array([0.0, 1.0])), *distribution.corners()]
    if not np.all(np.isfinite(ends)):
        raise ValueError(
            f"{distribution} reaches beyond the largest float; allowed are finite draws"
        )


def with_spread(uncertainty: Uncertainty, half_width: float) -> dict[str, Distribution]:
    """The same names with a width of +-half_width (0.2 is 20 %) for all relative distributions.

    Raises ValueError for a half_width outside (0, 1).
    """
    require("", "spread", half_width, "(0, 1)")
    if 1 + half_width == 1:
        raise ValueError(f"spread = {half_width:g} is lost in rounding; allowed is 1e-15 or more")
    return {name: d.spread(half_width) if d.relative else d for name, d in uncertainty.items()}


def check(machine: Tree, uncertainty: Uncertainty) -> None:
    """Raises ValueError for an uncertainty that does not fit the machine.

    The message names a leaf that does not exist, is None, or cannot take an absolute value, a value
    that is not a distribution, and two names of one number, such as poles and poles[2].
    """
    if not isinstance(uncertainty, Mapping):
        raise ValueError(
            f"uncertainty = {brief(uncertainty)} is a {type(uncertainty).__name__}; "
            "allowed are names with distributions"
        )
    for name, distribution in uncertainty.items():
        if isinstance(distribution, type) or not callable(getattr(distribution, "quantile", None)):
            raise ValueError(
                f"uncertainty: {name} = {brief(distribution)} is no distribution; allowed are "
                "Uniform, Normal and LogUniform, such as Uniform(0.9, 1.1, relative=True)"
            )
        try:
            value = get_at(machine, name)
        except KeyError as error:
            raise ValueError(f"uncertainty: {error.args[0]}") from None
        if np.asarray(value).dtype.kind != "f" or kind_at(machine, name)[0] == "static":
            raise ValueError(
                f"uncertainty: {name} = {value!r} is not a float leaf of this machine and cannot "
                "be drawn"
            )
        if np.ndim(value) and not distribution.relative:
            raise ValueError(
                f"uncertainty: {name} has shape {np.shape(value)}; an absolute distribution needs "
                f"one element, say {name}{'[0]' * np.ndim(value)}"
            )
    if twice := overlapping(uncertainty):
        raise ValueError(
            f"uncertainty: {twice[1]} is drawn by {twice[0]} already; allowed is each number once"
        )


@dataclasses.dataclass(frozen=True, eq=False)
class Population:
    """The machines of which a question is asked: the nominal one, and those drawn around it.

    machine: the nominal machine, number 0; it may be any pytree
    uncertainty: distributions of its named leaves
    grid: values by name, at each of which a sweep runs all machines, see `sweeps.grid`; only a
        sweep looks at it
    count: S >= 1 machines, including the nominal one; `corners` has 1 + 2^n of them for n names
    seed: of the draw
    sampling: `monte-carlo`, `latin-hypercube`, `sobol` (scrambled) or `corners`. With `monte-carlo`
        and `sobol` a longer draw starts with the numbers of a shorter one.

    What has a machine and these fields takes a population in place of its machine. Raises
    ValueError for an unknown name or sampling, and, when its machines are drawn, for a number
    outside the allowed range of its leaf.
    """

    machine: Tree
    uncertainty: Uncertainty = dataclasses.field(default_factory=dict)
    grid: Mapping[Value, Value] = dataclasses.field(default_factory=dict)
    count: int = 1024
    seed: int = 0
    sampling: str = "monte-carlo"
    __repr__ = in_short

    def __post_init__(self) -> None:
        need_known(f"sampling = {brief(self.sampling)}", self.sampling, SAMPLINGS)
        if not isinstance(self.grid, Mapping):
            raise ValueError(
                f"grid = {brief(self.grid)} is a {type(self.grid).__name__}; allowed are values by "
                "name, such as {'machine.plant.gain': [0.9, 1.0, 1.1]}"
            )
        require("Population", "count", self.count, "[1, inf)", whole=True)
        require("Population", "seed", self.seed, SEEDS, whole=True)
        check(self.machine, self.uncertainty)

    @classmethod
    def of(
        cls, machine: Tree, uncertainty: Uncertainty | None = None, **others: Value
    ) -> Population:
        """The population of a machine; one that is given already, with what is given besides it."""
        if not isinstance(machine, Population):
            return cls(machine, uncertainty or {}, **others)
        if uncertainty is not None:
            others["uncertainty"] = uncertainty
        return dataclasses.replace(machine, **others) if others else machine

    @property
    def size(self) -> int:
        """The number of machines."""
        corners = self.sampling == "corners" and self.uncertainty
        return 1 + 2 ** len(self.uncertainty) if corners else self.count

    @cached_property
    def drawn(self) -> dict[str, np.ndarray]:
        """(S,) the drawn numbers for each name, of which the first is nominal."""
        check_size(self.sampling, self.bytes_drawn, machines=self.size)
        if self.sampling == "corners":
            values = _corners(self.uncertainty)
        else:
            points = _unit_cube(self.count - 1, len(self.uncertainty), self.seed, self.sampling)
            each = zip(self.uncertainty.items(), points.T, strict=True)
            values = {name: d.quantile(p) for (name, d), p in each}
        drawn = {}
        for name, d in self.uncertainty.items():  # the nominal machine is not changed by its number
            first = 1.0 if d.relative else float(get_at(self.machine, name))
            drawn[name] = np.concatenate([[first], values[name]])
            drawn[name].flags.writeable = False
        need_ranges(self.machine, self.uncertainty, drawn)
        return drawn

    def bytes_drawn(self, machines: float) -> float:
        """The largest number of bytes that the draw of so many machines takes."""
        largest = max((np.size(get_at(self.machine, name)) for name in self.uncertainty), default=0)
        return 8 * machines * (COPIES * len(self.uncertainty) + 2 * largest)

    def others(self, seed: int, count: int) -> Population:
        """Other machines of the set, by another seed; as corners have none, they are by `sobol`."""
        again = "sobol" if self.sampling == "corners" and seed != self.seed else self.sampling
        return dataclasses.replace(self, seed=seed, count=count, sampling=again)

    def with_numbers(self, values: Mapping[str, Value]) -> Tree:
        """The machine with one set of numbers; can be called inside `jit` and `vmap`."""
        return drawn_machine(self.machine, self.uncertainty, values)

    def machine_of(self, number: int) -> Tree:
        """One of the machines; raises ValueError for a number that none of them has."""
        require("machine_of", "number", number, f"[0, {self.size - 1}]", whole=True)
        return self.with_numbers({name: values[number] for name, values in self.drawn.items()})

    def key_of(self, number: int | jax.Array) -> jax.Array:
        """The key of one machine's noise, which does not depend on the number of machines."""
        return jax.random.fold_in(key_of(self.seed), number)

    def batch(self, first: int = 0) -> tuple[jax.Array, dict[str, jax.Array]]:
        """The numbers and drawn values of all machines from the first one on, for `tiled`."""
        values = {name: jnp.asarray(of[first:]) for name, of in self.drawn.items()}
        return jnp.arange(first, self.size), values

    def one_of(self, batch: tuple[jax.Array, dict[str, jax.Array]]) -> tuple[Tree, jax.Array]:
        """The machine of an element of a batch, and the key of its noise."""
        number, values = batch
        return self.with_numbers(values), self.key_of(number)

    @property
    def machines(self) -> Tree:
        """All machines as one, see `drawn_machines`."""
        return drawn_machines(self.machine, self.uncertainty, self.drawn)


def key_of(seed: int) -> jax.Array:
    """The key of a seed, of which JAX would take the last 32 bits alone in single precision."""
    if jax.config.x64_enabled or seed < 2**32:
        return jax.random.key(seed)
    return jax.random.fold_in(jax.random.key(seed % 2**32), seed // 2**32)


T = TypeVar("T")
Known = TypeVar("Known", bound=type)


def takes_population(known: Known) -> Known:
    """A decorator of a dataclass that then takes a `Population` in place of its machine.

    The fields that both have are then those of the population (`machines` is its count), where they
    are not given besides.
    """
    of: Value = known
    make, fields = of.__init__, [f.name for f in dataclasses.fields(of)]

    @wraps(make)
    def made(self: Value, machine: Value, *arguments: Value, **options: Value) -> None:
        if isinstance(machine, Population):
            found = {f.name: getattr(machine, f.name) for f in dataclasses.fields(machine)}
            machine, found["machines"] = found.pop("machine"), found.pop("count")
            named = fields[1 + len(arguments) :]
            options = {name: value for name, value in found.items() if name in named} | options
        make(self, machine, *arguments, **options)

    of.__init__ = made
    return known


def draw(
    machine: Tree,
    uncertainty: Uncertainty,
    machines: int,
    *,
    seed: int = 0,
    sampling: str = "monte-carlo",
) -> dict[str, np.ndarray]:
    """The drawn numbers (S,) for each name, of which the first is nominal; see `Population`.

    machines: S >= 1, including the nominal one
    Raises ValueError as `Population` does.
    """
    require("draw", "machines", machines, "[1, inf)", whole=True)
    return Population(machine, uncertainty, count=machines, seed=seed, sampling=sampling).drawn


def drawn_machine(
    machine: T, uncertainty: Mapping[str, Distribution | Drawn], values: Mapping[str, Value]
) -> T:
    """The machine with one set of drawn numbers; can be called inside `jit` and `vmap`."""
    scale = {
        name: jnp.asarray(get_at(machine, name)) if d.relative else 1.0
        for name, d in uncertainty.items()
    }
    return replaced(
        machine, {name: scale[name] * jnp.asarray(values[name]) for name in uncertainty}
    )


def drawn_machines(machine: T, uncertainty: Uncertainty, drawn: Mapping[str, np.ndarray]) -> T:
    """All drawn machines as one, whose leaves have a leading axis over the machines.

    If nothing was drawn, this axis has the length 1.
    """
    if not drawn:
        return jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], machine)
    numbers = {name: jnp.asarray(values) for name, values in drawn.items()}
    return jax.vmap(lambda values: drawn_machine(machine, uncertainty, values))(numbers)


def _unit_cube(points: int, dimensions: int, seed: int, sampling: str) -> np.ndarray:
    """The points (points, dimensions) in the unit cube."""
    if points == 0 or dimensions == 0:
        return np.zeros((points, dimensions))
    if sampling == "monte-carlo":
        return np.random.default_rng(seed).random((points, dimensions))
    from scipy.stats import qmc  # imported here, because the import is slow

    if sampling == "latin-hypercube":
        return qmc.LatinHypercube(dimensions, rng=seed).random(points)
    powers_of_two = qmc.Sobol(dimensions, rng=seed).random_base2(int(np.ceil(np.log2(points))))
    return powers_of_two[:points]


def _corners(uncertainty: Uncertainty) -> dict[str, np.ndarray]:
    if len(uncertainty) > 16:
        raise ValueError(
            f"sampling = 'corners' of {len(uncertainty)} names would be 2^{len(uncertainty)} "
            "machines; allowed are at most 16 names"
        )
    points = [*itertools.product(*(d.corners() for d in uncertainty.values()))]
    return dict(zip(uncertainty, np.array(points).T, strict=True))


def need_ranges(machine: Tree, uncertainty: Uncertainty, drawn: Mapping[str, np.ndarray]) -> None:
    """Raises ValueError for drawn numbers that a leaf of this machine cannot have."""
    for name, distribution in uncertainty.items():
        allowed, values = interval_at(machine, name), drawn[name]
        if distribution.relative:
            values = np.multiply.outer(values, get_at(machine, name))
        if allowed is not None and not allowed.contains(values):
            raise ValueError(
                f"uncertainty: {name} was drawn between {values.min():g} and {values.max():g}; "
                f"allowed is {allowed}"
            )
