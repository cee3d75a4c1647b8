"""Uncertain plants: distributions of named leaves of a machine, and the drawing of machines.

    {"plant.gain": Uniform(0.9, 1.1, relative=True), "plant.poles[2]": Normal(6.4, 0.5),
     "actuator.limit": LogUniform(5, 20)}

One number is drawn for each name. A relative number scales the leaf (an array as a whole). An
absolute number replaces a scalar or a single element. Machine 0 is always the nominal one. Numbers
are drawn on the host, in float64, from a seed.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .pytree.closest import not_one_of
from .pytree.named_paths import get_at, interval_at, replaced
from .pytree.ranges import SEEDS, brief, is_number, require
from .runtime.capacity import check_size

COPIES = 6  # number of copies of all numbers that are in RAM while they are drawn
SAMPLINGS = ("monte-carlo", "latin-hypercube", "sobol", "corners")


@dataclasses.dataclass(frozen=True)
class Uniform:
    """The uniform distribution on [low, high]."""

    low: float
    high: float
    relative: bool = False

    def __post_init__(self):
        _need_numbers(self, low="(-inf, inf)", high="(-inf, inf)")
        if not self.low < self.high:
            raise ValueError(f"Uniform: low = {self.low:g} must lie below high = {self.high:g}")
        _need_finite(self)

    def quantile(self, p) -> np.ndarray:
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

    def __post_init__(self):
        _need_numbers(self, mean="(-inf, inf)", std="(0, inf)")
        _need_finite(self)

    def quantile(self, p) -> np.ndarray:
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

    def __post_init__(self):
        _need_numbers(self, low="(-inf, inf)", high="(-inf, inf)")
        if not 0 < self.low < self.high:
            raise ValueError(
                f"LogUniform: low = {self.low:g} and high = {self.high:g} must satisfy "
                "0 < low < high"
            )
        _need_finite(self)

    def quantile(self, p) -> np.ndarray:
        return self.low * (self.high / self.low) ** p

    def corners(self) -> tuple[float, float]:
        return self.low, self.high

    def spread(self, half_width: float) -> LogUniform:
        return LogUniform(1.0 / (1.0 + half_width), 1.0 + half_width, relative=True)


Distribution = Uniform | Normal | LogUniform
Uncertainty = Mapping[str, Distribution]


def _need_numbers(distribution, **ranges: str) -> None:
    """Raises ValueError unless each field is in its range, and `relative` is True or False."""
    name = type(distribution).__name__
    for field, interval in ranges.items():
        require(name, field, getattr(distribution, field), interval)
        object.__setattr__(distribution, field, float(getattr(distribution, field)))
    if not isinstance(distribution.relative, bool | np.bool_):
        raise ValueError(
            f"{name}: relative = {brief(distribution.relative)} is not one of True, False"
        )


def _need_finite(distribution) -> None:
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
    if not is_number(half_width):
        raise ValueError(f"spread = {brief(half_width)} is not a number")
    if not 0 < half_width < 1:
        raise ValueError(f"spread = {half_width:g} is outside its allowed range (0, 1)")
    return {name: d.spread(half_width) if d.relative else d for name, d in uncertainty.items()}


def nominal(machine, uncertainty: Uncertainty) -> dict[str, float]:
    """The numbers of the nominal machine, with which the machine is not changed.

    The number is 1 for a relative distribution, and the value of the leaf for an absolute one.
    """
    return {
        name: 1.0 if d.relative else float(get_at(machine, name)) for name, d in uncertainty.items()
    }


def check(machine, uncertainty: Uncertainty) -> None:
    """Raises ValueError for an uncertainty that does not fit the machine.

    The message names a leaf that does not exist, is None, or cannot take an absolute value, and a
    value that is not a distribution.
    """
    if not isinstance(uncertainty, Mapping):
        raise ValueError(
            f"uncertainty = {brief(uncertainty)} is a {type(uncertainty).__name__}; "
            "allowed are names with distributions"
        )
    for name, distribution in uncertainty.items():
        if not callable(getattr(distribution, "quantile", None)):
            raise ValueError(
                f"uncertainty: {name} = {brief(distribution)} is no distribution; allowed are "
                "Uniform, Normal and LogUniform, such as Uniform(0.9, 1.1, relative=True)"
            )
        try:
            value = get_at(machine, name)
        except KeyError as error:
            raise ValueError(f"uncertainty: {error.args[0]}") from None
        if value is None or np.asarray(value).dtype.kind != "f":
            raise ValueError(
                f"uncertainty: {name} = {value!r} is not a float leaf of this machine and cannot "
                "be drawn"
            )
        if np.ndim(value) and not distribution.relative:
            raise ValueError(
                f"uncertainty: {name} has shape {np.shape(value)}; an absolute distribution needs "
                f"one element, say {name}[0]"
            )


def draw(
    machine,
    uncertainty: Uncertainty,
    machines: int,
    *,
    seed: int = 0,
    sampling: str = "monte-carlo",
) -> dict[str, np.ndarray]:
    """The drawn numbers (S,) for each name, of which the first is nominal.

    machines: S >= 1, including the nominal one; `corners` ignores it and draws 1 + 2^n for n names
    sampling: `monte-carlo`, `latin-hypercube`, `sobol` (scrambled) or `corners`. With `monte-carlo`
        and `sobol` a longer draw starts with the numbers of a shorter one.
    Raises ValueError for an unknown name or sampling, and for a number outside the allowed range of
    its leaf.
    """
    if sampling not in SAMPLINGS:
        raise ValueError(not_one_of(f"sampling = {brief(sampling)}", sampling, SAMPLINGS))
    require("draw", "machines", machines, "[1, inf)", whole=True)
    require("draw", "seed", seed, SEEDS, whole=True)
    check(machine, uncertainty)
    check_size(
        sampling,
        lambda machines: bytes_drawn(machine, uncertainty, machines),
        machines=drawn_count(uncertainty, machines, sampling),
    )
    if sampling == "corners":
        drawn = _corners(uncertainty)
    else:
        unit = _unit_cube(machines - 1, len(uncertainty), seed, sampling)
        drawn = {name: d.quantile(unit[:, i]) for i, (name, d) in enumerate(uncertainty.items())}
    first = nominal(machine, uncertainty)
    drawn = {name: np.concatenate([[first[name]], values]) for name, values in drawn.items()}
    within_ranges(machine, uncertainty, drawn)
    return drawn


def drawn_count(uncertainty: Uncertainty, machines: int, sampling: str) -> int:
    """The number of machines that `draw` returns."""
    return 1 + 2 ** len(uncertainty) if sampling == "corners" else machines


def bytes_drawn(machine, uncertainty: Uncertainty, machines: float) -> float:
    """The largest number of bytes that `draw` takes for this number of machines."""
    largest = max((np.size(get_at(machine, name)) for name in uncertainty), default=0)
    return 8 * machines * (COPIES * len(uncertainty) + 2 * largest)


def drawn_machine(machine, uncertainty: Uncertainty, values: Mapping[str, float]) -> Any:
    """The machine with one set of drawn numbers; can be called inside `jit` and `vmap`."""
    scale = {
        name: jnp.asarray(get_at(machine, name)) if d.relative else 1.0
        for name, d in uncertainty.items()
    }
    return replaced(
        machine, {name: scale[name] * jnp.asarray(values[name]) for name in uncertainty}
    )


def drawn_machines(machine, uncertainty: Uncertainty, drawn: Mapping[str, Any]) -> Any:
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
    ends = [d.corners() for d in uncertainty.values()]
    points = np.array(list(itertools.product(*ends))).reshape(-1, len(uncertainty))
    return {name: points[:, i] for i, name in enumerate(uncertainty)}


def within_ranges(machine, uncertainty: Uncertainty, drawn: Mapping[str, np.ndarray]) -> None:
    """Raises ValueError for drawn numbers that a leaf of this machine cannot have."""
    for name, distribution in uncertainty.items():
        allowed = interval_at(machine, name)
        values = (
            np.multiply.outer(drawn[name], get_at(machine, name))
            if distribution.relative
            else drawn[name]
        )
        if allowed is not None and not allowed.contains(values):
            raise ValueError(
                f"uncertainty: {name} was drawn between {values.min():g} and {values.max():g}; "
                f"allowed is {allowed}"
            )
