"""Risks: one number from the losses of many machines, which a robust tuning minimises."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
from jax import lax

from ..learning.metrics import largest
from ..pytree.ranges import require


@dataclasses.dataclass(frozen=True)
class Risk:
    """A risk rho of (S,) losses, whose derivatives (`weights`) are >= 0 and sum to 1."""

    def __call__(self, losses) -> jax.Array:
        raise NotImplementedError

    def weights(self, losses) -> jax.Array:
        """(S,) derivatives d rho / d losses."""
        return jax.grad(lambda x: self(x))(losses)


@dataclasses.dataclass(frozen=True)
class Mean(Risk):
    """The mean of the losses."""

    def __call__(self, losses):
        return jnp.mean(losses)


@dataclasses.dataclass(frozen=True)
class CVaR(Risk):
    """Conditional value at risk: the mean of the worst share 1 - alpha of the losses.

    The definition is that of Rockafellar and Uryasev 2000. Where the share is not a whole number of
    losses, the smallest of them counts in part.

    alpha: () level in [0, 1); 0 gives the mean
    """

    alpha: float = 0.9

    def __post_init__(self):
        require("CVaR", "alpha", self.alpha, "[0, 1)")

    def __call__(self, losses):
        size = (1.0 - self.alpha) * losses.shape[0]
        size = max(size, 1.0)  # a share of less than one machine: the worst one
        # By the ranks of the losses: the derivative of a sort is a scatter, at which XLA's
        # partitioner crashes where the losses are on many devices.
        place = jnp.argsort(jnp.argsort(-lax.stop_gradient(losses)))
        share = jnp.clip(size - place, 0.0, 1.0)
        return jnp.sum(jnp.where(share > 0, share * losses, 0.0)) / size  # losses may be infinite


@dataclasses.dataclass(frozen=True)
class Worst(Risk):
    """The largest loss."""

    def __call__(self, losses):
        return largest(losses)


@dataclasses.dataclass(frozen=True)
class SmoothMax(Risk):
    """A smooth maximum: the largest loss for T towards 0, the mean for T towards infinity.

        rho = T log(mean exp(losses / T))

    temperature: () T > 0 [unit of the loss]
    """

    temperature: float = 0.3

    def __post_init__(self):
        require("SmoothMax", "temperature", self.temperature, "(0, inf)")

    def __call__(self, losses):
        return self.temperature * (
            jax.nn.logsumexp(losses / self.temperature) - jnp.log(losses.shape[0])
        )
