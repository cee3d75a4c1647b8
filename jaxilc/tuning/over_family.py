"""The monotone condition of a learning law over a family of machines, as a term of an objective."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from ..pytree.aliases import Leaf
from ..pytree.ranges import require
from ..schemes import Scheme
from ..schemes.learning_filter import segments_of
from ..signals.task import Task
from ..theory.law import traced_response
from .objectives import Objective, Run

SHARPNESS = 400.0


@dataclasses.dataclass(frozen=True)
class OverFamily(Objective):
    """How far a linear law is from monotone convergence on a family of machines; 0 where it holds.

        max(0, log(s / below)),     s = (sum |keep - L P|^sharpness)^(1 / sharpness)

    where the sum is over all machines and frequencies. s is never below the largest |keep - L P|,
    and above it by no more than the factor count^(1 / sharpness), 2.5 % for 20000 terms, which only
    as many equal ones reach. With s < 1 the error, without its ends and what does not repeat, falls
    in each trial on each machine (Bristow 2006, theorem 4). keep and L are those of the scheme that
    is tuned (`theory.law`), so it may be a `LearningFilter`, alone or filtered, or any other linear
    law. For a law with several inputs |.| is the largest singular value. Of a scheduled law each
    segment counts, as if it were the law of all samples.

    frequencies: (F,) [Hz]
    P:     (S, F) responses of S machines, or (S, F, n_y, n_u), from what is learned to the output
    below: upper limit for s
    sharpness: power of the sum

    It does not depend on the machine that is simulated, and is computed once in a step. Raises
    ValueError for responses of another shape, or that are not finite.
    """

    frequencies: Leaf
    P: Leaf
    below: float = 0.95
    sharpness: float = SHARPNESS
    nominal: ClassVar[bool] = True

    def __post_init__(self):
        super().__post_init__()
        require("OverFamily", "sharpness", self.sharpness, "[1, 1e4]")
        object.__setattr__(self, "frequencies", np.asarray(self.frequencies, float))
        object.__setattr__(self, "P", np.asarray(self.P, complex))
        if self.P.ndim not in (2, 4) or self.frequencies.shape != self.P.shape[1:2]:
            raise ValueError(
                f"OverFamily: P has shape {self.P.shape} for frequencies of shape "
                f"{self.frequencies.shape}; allowed are (S, F) or (S, F, n_y, n_u) and (F,)"
            )
        if not (np.all(np.isfinite(self.frequencies)) and np.all(np.isfinite(self.P))):
            raise ValueError("OverFamily: frequencies and P must be finite")

    def __call__(self, run: Run) -> jax.Array:
        sizes = jnp.stack(
            [
                contraction_sizes(one, run.task, self.frequencies, self.P)
                for one in segments_of(run.scheme)
            ]
        )
        tiny = jnp.finfo(sizes.dtype).tiny
        powers = self.sharpness * jnp.log(jnp.maximum(sizes, tiny) / self.below)
        return jax.nn.relu(jax.nn.logsumexp(powers) / self.sharpness)


def contraction_sizes(scheme: Scheme, task: Task, frequencies, P) -> jax.Array:
    """(S, F) |keep - L P| of a linear law, the largest singular value where it is a matrix.

    P: (S, F), or (S, F, n_y, n_u)
    """
    keep, L = traced_response(scheme, task, frequencies)
    P = jnp.asarray(P)
    P = P[..., None, None] if P.ndim == 2 else P
    left = keep - jnp.einsum("fij,sfjk->sfik", L, P)
    if left.shape[-1] > 1:
        return jnp.linalg.svd(left, compute_uv=False)[..., 0]
    return _abs(left[..., 0, 0])


def _abs(z):
    """|z| with the slope 0 at z = 0, where that of `abs` is not a number."""
    square = z.real**2 + z.imag**2
    return jnp.sqrt(jnp.where(square > 0, square, 1.0)) * (square > 0)
