"""The optimisers of a tuning by name."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import optax

from .descent import Evaluation, Method, by_gradient, by_least_squares

OPTIMISERS = ("adam", "lbfgs", "least-squares")


def method_of(
    optimiser: str | optax.GradientTransformation,
    evaluate: Callable[[Any], Evaluation],
    rate: float,
    steps: int,
) -> Method:
    """The method of an optimiser on a loss.

    rate, steps: rate of adam, and the number of steps over which it falls to zero
    """
    if optimiser == "least-squares":
        return by_least_squares(evaluate)
    if isinstance(optimiser, str):
        optimiser = (
            optax.lbfgs()
            if optimiser == "lbfgs"
            else optax.adam(optax.cosine_decay_schedule(rate, steps))
        )
    return by_gradient(evaluate, optimiser)
