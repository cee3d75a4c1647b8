"""A scheme that stays finite where learning diverges, so that its loss has a finite gradient."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from ..learning.divergence import CEILING, peak
from ..pytree.aliases import Leaf
from ..pytree.fields import child, leaf, pytree
from ..schemes import Scheme
from ..schemes.guards import Guard
from ..signals.task import Sample, Task, Trial


class Held(NamedTuple):
    """The memory of `Bounded`.

    scheme: memory of the scheme that is bounded
    """

    scheme: Any


@pytree
class Bounded(Guard):
    """A scheme that sees no error beyond a level, and stops learning in a trial that passes it.

        y seen = clip(y, r - level, r + level)
        memory' = memory if max |e| > level, else what the scheme learns

    As long as no error exceeds the level, all numbers are those of the scheme itself. After a trial
    that exceeds it, every later trial repeats that trial. So the error and its gradient stay
    finite. The gradient is that of the trial that exceeded the level; the part of an error that is
    clipped has the gradient zero. A learning process that diverges thus has a loss of about
    log(ceiling / floor), and a slope that leads back to weights that converge.

    level: (n_y,) largest error that the scheme sees, > 0 [unit of y]
    """

    scheme: Scheme = child()
    level: Leaf = leaf(interval="(0, inf)")

    @classmethod
    def around(cls, scheme: Scheme, task: Task, ceiling: float = CEILING) -> Bounded:
        """The scheme with a level of `ceiling` times the peak of the reference."""
        return cls(scheme, lax.stop_gradient(ceiling * peak(task)))

    def initial_memory(self, task: Task) -> Held:
        return Held(self.scheme.initial_memory(task))

    def act(self, state, sample: Sample) -> tuple[Any, jax.Array]:
        return self.scheme.act(
            state,
            sample._replace(y=jnp.clip(sample.y, sample.r - self.level, sample.r + self.level)),
        )

    def learn(self, memory: Held, trial: Trial) -> Held:
        passed = ~jnp.all(jnp.abs(trial.e) <= self.level)
        seen = trial._replace(y=jnp.clip(trial.y, trial.r - self.level, trial.r + self.level))
        learned = self.scheme.learn(memory.scheme, seen)
        return Held(
            jax.tree.map(lambda old, new: jnp.where(passed, old, new), memory.scheme, learned)
        )
