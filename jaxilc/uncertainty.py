"""Uncertain plants: distributions on named leaves of a machine, and how samples of them are drawn.

    {"plant.gain": Uniform(0.9, 1.1, relative=True), "plant.poles[2]": Normal(6.4, 0.5),
    "actuator.limit": LogUniform(5, 20)}

One number is drawn for each name. A relative one scales the leaf (all of it, if it is an array); an
absolute one replaces a scalar or a single element. Sample 0 is always the nominal machine. Drawing
happens on the host, in float64, from a seed.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy import special
from scipy.stats import qmc

from .pytree.named_paths import get_at, interval_at, replaced
from .pytree.ranges import SEEDS, brief, is_number, require
from .runtime.capacity import check_size

COPIES = 6  # of all numbers, while they are drawn
SAMPLINGS = ("monte-carlo", "latin-hypercube", "sobol", "corners")


@dataclasses.dataclass(frozen=True)
class Uniform:
    """Uniform on [low, high]."""

    low: float
    high: float
    relative: bool = False

    def __post_init__(self):
        _need_numbers(self, low="(-inf, inf)", high="(-inf, inf)")
        if not self.low < self.high:
            raise ValueError(f"Uniform: low = {self.low:g} must lie below high = {self.high:g}")
        _need_finite(self)

    def quantile(self, p) -> np.ndarray:
        """The value below which a share p of the draws lies."""
        return self.low + p * (self.high - self.low)

    def corners(self) -> tuple[float, float]:
        return self.low, self.high

    def spread(self, half_width: float) -> Uniform:
        """The same centre (1 if relative), `half_width` to either side."""
        return Uniform(1.0 - half_width, 1.0 + half_width, relative=True)


@dataclasses.dataclass(frozen=True)
class Normal:
    """Normal with mean and standard deviation; its corners are two standard deviations out."""

    mean: float
    std: float
    relative: bool = False

    def __post_init__(self):
        _need_numbers(self, mean="(-inf, inf)", std="(0, inf)")
        _need_finite(self)

    def quantile(self, p) -> np.ndarray:
        return self.mean + self.std * special.ndtri(np.clip(p, 1e-12, 1.0 - 1e-12))

    def corners(self) -> tuple[float, float]:
        return self.mean - 2.0 * self.std, self.mean + 2.0 * self.std

    def spread(self, half_width: float) -> Normal:
        """Centre 1, two standard deviations at `half_width`."""
        return Normal(1.0, half_width / 2.0, relative=True)


@dataclasses.dataclass(frozen=True)
class LogUniform:
    """Uniform in the logarithm, on [low, high] with 0 < low."""

    low: float
    high: float
    relative: bool = False

    def __post_init__(self):
        _need_numbers(self, low="(-inf, inf)", high="(-inf, inf)")
        if not 0 < self.low < self.high:
            raise ValueError(
                f"LogUniform: low = {self.low:g} and high = {self.high:g} must satisfy 0 < low < high"
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
    """Raises ValueError unless each field is one number in its range, and `relative` True or False."""
    name = type(distribution).__name__
    for field, interval in ranges.items():
        require(name, field, getattr(distribution, field), interval)
        object.__setattr__(distribution, field, float(getattr(distribution, field)))
    if not isinstance(distribution.relative, bool | np.bool_):
        raise ValueError(
            f"{name}: relative = {brief(distribution.relative)} is not one of True, False"
        )


def _need_finite(distribution) -> None:
    """Raises ValueError where what is drawn would not be a finite number, as between 1e-300 and
    1e300 by their ratio.
    """
    with np.errstate(all="ignore"):
        ends = [*distribution.quantile(np.array([0.0, 1.0])), *distribution.corners()]
    if not np.all(np.isfinite(ends)):
        raise ValueError(
            f"{distribution} reaches beyond the largest float; allowed are finite draws"
        )


def with_spread(uncertainty: Uncertainty, half_width: float) -> dict[str, Distribution]:
    """The same names, every relative distribution at +-half_width (0.2 is 20 %). Raises ValueError
    outside (0, 1).
    """
    if not is_number(half_width):
        raise ValueError(f"spread = {brief(half_width)} is not a number")
    if not 0 < half_width < 1:
        raise ValueError(f"spread = {half_width:g} is outside its allowed range (0, 1)")
    return {name: d.spread(half_width) if d.relative else d for name, d in uncertainty.items()}


def nominal(machine, uncertainty: Uncertainty) -> dict[str, float]:
    """The numbers that leave the machine as it is: 1 for a relative distribution, else the leaf's
    value.
    """
    return {
        name: 1.0 if d.relative else float(get_at(machine, name)) for name, d in uncertainty.items()
    }


def check(machine, uncertainty: Uncertainty) -> None:
    """Raises ValueError naming a leaf that does not exist, is absent, or cannot take an absolute
    value, and what is no distribution.
    """
    if not isinstance(uncertainty, Mapping):
        raise ValueError(
            f"uncertainty = {brief(uncertainty)} is a {type(uncertainty).__name__}; allowed are names with distributions"
        )
    for name, distribution in uncertainty.items():
        if not callable(getattr(distribution, "quantile", None)):
            raise ValueError(
                f"uncertainty: {name} = {brief(distribution)} is no distribution; allowed are Uniform, Normal and LogUniform, "
                "such as Uniform(0.9, 1.1, relative=True)"
            )
        try:
            value = get_at(machine, name)
        except KeyError as error:
            raise ValueError(f"uncertainty: {error.args[0]}") from None
        if value is None or np.asarray(value).dtype.kind != "f":
            raise ValueError(
                f"uncertainty: {name} = {value!r} is not a float leaf of this machine and cannot be drawn"
            )
        if np.ndim(value) and not distribution.relative:
            raise ValueError(
                f"uncertainty: {name} has shape {np.shape(value)}; an absolute distribution needs one element, say {name}[0]"
            )


def draw(
    machine, uncertainty: Uncertainty, samples: int, *, seed: int = 0, sampling: str = "monte-carlo"
) -> dict[str, np.ndarray]:
    """(S,) numbers for each name; the first is nominal.

    samples: S >= 1 with the nominal one; `corners` takes 1 + 2^n and ignores it
    sampling: monte-carlo (a longer draw starts with the shorter one), latin-hypercube, sobol
    (scrambled, likewise a prefix), corners
    Raises ValueError for an unknown name or sampling, and where a draw leaves the allowed range of
    its leaf.
    """
    if sampling not in SAMPLINGS:
        raise ValueError(f"sampling = {brief(sampling)} is not one of {', '.join(SAMPLINGS)}")
    require("draw", "samples", samples, "[1, inf)", whole=True)
    require("draw", "seed", seed, SEEDS, whole=True)
    check(machine, uncertainty)
    check_size(
        sampling,
        lambda samples: bytes_drawn(machine, uncertainty, samples),
        samples=drawn_samples(uncertainty, samples, sampling),
    )
    if sampling == "corners":
        drawn = _corners(uncertainty)
    else:
        unit = _unit_cube(samples - 1, len(uncertainty), seed, sampling)
        drawn = {name: d.quantile(unit[:, i]) for i, (name, d) in enumerate(uncertainty.items())}
    first = nominal(machine, uncertainty)
    drawn = {name: np.concatenate([[first[name]], values]) for name, values in drawn.items()}
    _within_ranges(machine, uncertainty, drawn)
    return drawn


def drawn_samples(uncertainty: Uncertainty, samples: int, sampling: str) -> int:
    """How many machines `draw` gives: the nominal one and the others, which of corners are as many
    as there are.
    """
    return 1 + 2 ** len(uncertainty) if sampling == "corners" else samples


def bytes_drawn(machine, uncertainty: Uncertainty, samples: float) -> float:
    """What drawing so many takes, at most."""
    largest = max((np.size(get_at(machine, name)) for name in uncertainty), default=0)
    return 8 * samples * (COPIES * len(uncertainty) + 2 * largest)


def drawn_machine(machine, uncertainty: Uncertainty, values: Mapping[str, float]) -> Any:
    """The machine with one sample's numbers put in; also inside `jit` and `vmap`."""
    scale = {
        name: jnp.asarray(get_at(machine, name)) if d.relative else 1.0
        for name, d in uncertainty.items()
    }
    return replaced(
        machine, {name: scale[name] * jnp.asarray(values[name]) for name in uncertainty}
    )


def drawn_machines(machine, uncertainty: Uncertainty, drawn: Mapping[str, Any]) -> Any:
    """All machines drawn as one, each leaf with a leading axis that counts them; the machine itself
    if nothing was drawn.
    """
    if not drawn:
        return jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], machine)
    numbers = {name: jnp.asarray(values) for name, values in drawn.items()}
    return jax.vmap(lambda values: drawn_machine(machine, uncertainty, values))(numbers)


def _unit_cube(samples: int, dimensions: int, seed: int, sampling: str) -> np.ndarray:
    if samples == 0 or dimensions == 0:
        return np.zeros((samples, dimensions))
    match sampling:
        case "latin-hypercube":
            return qmc.LatinHypercube(dimensions, rng=seed).random(samples)
        case "sobol":
            return qmc.Sobol(dimensions, rng=seed).random_base2(int(np.ceil(np.log2(samples))))[
                :samples
            ]
    return np.random.default_rng(seed).random((samples, dimensions))


def _corners(uncertainty: Uncertainty) -> dict[str, np.ndarray]:
    if len(uncertainty) > 16:
        raise ValueError(
            f"sampling = 'corners' of {len(uncertainty)} names would be 2^{len(uncertainty)} samples; allowed are at most 16 names"
        )
    points = np.array(
        list(itertools.product(*(d.corners() for d in uncertainty.values())))
    ).reshape(-1, len(uncertainty))
    return {name: points[:, i] for i, name in enumerate(uncertainty)}


def _within_ranges(machine, uncertainty, drawn) -> None:
    for name, distribution in uncertainty.items():
        allowed = interval_at(machine, name)
        values = (
            np.multiply.outer(drawn[name], get_at(machine, name))
            if distribution.relative
            else drawn[name]
        )
        if allowed is not None and not allowed.contains(values):
            raise ValueError(
                f"uncertainty: {name} was drawn between {values.min():g} and {values.max():g}; allowed is {allowed}"
            )
