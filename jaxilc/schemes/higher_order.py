"""Higher-order learning, which uses the errors of several trials and not only of the last one."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..pytree.fields import Leaf, leaf, pytree, static
from ..pytree.needs import known, need_channels
from ..signals.by_row import by_row
from ..signals.task import Limit, Task, Trial
from .pid_type import need_lead
from .scheme import Scheme, limit_of, limited, need_square
from .shifts import advance


class Past(NamedTuple):
    """The memory of `HigherOrder`.

    u: (N, n) input of the next trial [unit of u]
    inputs: (N, n) each, inputs of the P-1 trials before the last, newest first [unit of u]
    errors: (N, n) each, errors e[k+1+lead] of the same trials [unit of y]
    Inputs and errors before the first trial are zero.
    """

    u: jax.Array
    inputs: tuple[jax.Array, ...]
    errors: tuple[jax.Array, ...]


@pytree
class HigherOrder(Scheme):
    """P-type learning of order P (Bien and Huh 1989; Chen, Gong and Wen 1998; Li 2020, section 1).

        u_{j+1}[k] = sum_{i<P} alpha_i u_{j-i}[k] + sum_{i<P} gamma_i e_{j-i}[k+1+m]

    Inputs and errors before the first trial, and errors beyond the end of a trial, count as zero.
    For P = 1 and alpha = 1 the law is `PIDType` with gamma_p alone.
    On a plant G(z) the error at each frequency satisfies

        e_{j+1} = sum_i (alpha_i - gamma_i z^(1+m) G) e_{j-i} + (1 - sum alpha) r

    It converges, not always monotonically, if all roots s of
    s^P = sum_i (alpha_i - gamma_i z^(1+m) G) s^(P-1-i) lie within the unit circle.

    alpha: (P,) with the sum 1, so that the learned input does not change where the error is zero;
        with a sum in (0, 1) the law forgets
    gamma: (P,) or (P, n) learning gain [unit of u per unit of y]
    lead: m, samples of look-ahead of the learning, as for `PIDType`
    limit: () or (n,) largest |u| that is learned [unit of u]; None: no limit
    Raises ValueError for shapes that do not fit, and for a sum of alpha outside (0, 1].
    """

    alpha: Leaf = leaf(default=(1.0,))
    gamma: Leaf = leaf(default=(0.0,))
    limit: Leaf | None = leaf(default=None, interval="(0, inf)", optional=True)
    lead: int = static(default=0, interval="[0, inf)", whole=True)
    clips = ("limit",)

    def __post_init__(self):
        P = self.alpha.shape[-1] if self.alpha.ndim == 1 else 0
        if not P or self.gamma.ndim not in (1, 2) or len(self.gamma) != P:
            raise ValueError(
                f"HigherOrder: alpha {self.alpha.shape} and gamma {self.gamma.shape} do not fit; "
                "allowed are (P,) and (P,) or (P, n) with P >= 1"
            )
        if known(self):
            total = float(np.sum(self.alpha))
            if not 0 < total <= 1 + 1e-6:  # 0.7 + 0.2 + 0.1 may exceed 1 in single precision
                raise ValueError(
                    f"HigherOrder: the sum of alpha = {total:g} is outside its allowed range (0, 1]"
                )

    def check(self, task: Task) -> None:
        need_square(self, task)
        need_lead(self, task)
        need_channels(self, task.inputs, "limit")
        if self.gamma.shape[1:] not in ((), (task.inputs,)):
            P = self.gamma.shape[0]
            raise ValueError(
                f"HigherOrder: gamma has shape {self.gamma.shape}; allowed are ({P},) and ({P}, "
                f"{task.inputs})"
            )

    def initial_memory(self, task: Task) -> Past:
        rest = jnp.zeros((task.N, task.inputs))
        before = (rest,) * (self.alpha.shape[0] - 1)
        return Past(rest, before, before)

    def learn(self, memory: Past, trial: Trial) -> Past:
        inputs, errors = (
            (trial.u, *memory.inputs),
            (advance(trial.e, 1 + self.lead), *memory.errors),
        )
        return Past(self._law(inputs, errors), inputs[:-1], errors[:-1])

    def started(self, memory: Past, u, task: Task) -> Past:
        """The memory after trials that all played the input u (N, n) without an error."""
        return Past(jnp.asarray(u), (jnp.asarray(u),) * len(memory.inputs), memory.errors)

    @by_row
    def _law(self, inputs, errors):
        u = sum(self.alpha[i] * inputs[i] + self.gamma[i] * errors[i] for i in range(len(inputs)))
        return limited(u, self.limit)

    def limits(self, task: Task, memory: Past, trial: Trial) -> dict[str, Limit]:
        return limit_of(self.unlimited().learn(memory, trial).u, self.limit)
