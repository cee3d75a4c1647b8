"""P-, PD- and PID-type iterative learning control: the classical laws with a fixed learning
gain.
"""

from __future__ import annotations

import jax.numpy as jnp

from ..pytree.fields import Leaf, leaf, pytree, static
from ..pytree.needs import need_channels
from ..signals.task import Limit, Task, Trial
from .scheme import Feedforward, Scheme, advance, limit_of, limited, need_square


@pytree
class PIDType(Scheme):
    """P-, PD- and PID-type learning:

        u_{j+1}[k] = (1 - leak) u_j[k] + gamma_p e_j[k+1+m] + gamma_i sum_{i<=k} e_j[i+1]
                     + gamma_d (e_j[k+1+m] - e_j[k+m])

    The gains are per sample, as Cao 2019 (section IV-D) and Li 2020 (eq. 2) print theirs.
    `Filtered(scheme, filter)` adds the robustness filter: u_{j+1} = Q(u_j + L e_j). Errors and
    differences that lie beyond the end of the trial count as zero.

    gamma_p, gamma_i, gamma_d: () or (n,) [unit of u per unit of y]
    leak: () or (n,) forgetting in [0, 1)
    lead: m, samples by which learning looks ahead beyond the one of u[k] -> y[k+1]
    limit: () or (n,) largest |u| learned, None for none
    """

    gamma_p: Leaf = leaf(default=0.0)
    gamma_i: Leaf = leaf(default=0.0)
    gamma_d: Leaf = leaf(default=0.0)
    leak: Leaf = leaf(default=0.0, interval="[0, 1)")
    limit: Leaf | None = leaf(default=None, interval="(0, inf)", optional=True)
    lead: int = static(default=0, interval="[0, inf)", whole=True)
    clips = ("limit",)

    def check(self, task: Task) -> None:
        need_square(self, task)
        need_lead(self, task)
        need_channels(self, task.inputs, "gamma_p", "gamma_i", "gamma_d", "leak", "limit")

    def initial_memory(self, task: Task) -> Feedforward:
        return Feedforward(jnp.zeros((task.N, task.inputs)))

    def learn(self, memory: Feedforward, trial: Trial) -> Feedforward:
        e = trial.e
        difference = jnp.pad(jnp.diff(e, axis=0)[self.lead :], ((0, self.lead), (0, 0)))
        step = (
            self.gamma_p * advance(e, 1 + self.lead)
            + self.gamma_i * jnp.cumsum(e[1:], axis=0)
            + self.gamma_d * difference
        )
        return Feedforward(limited((1.0 - self.leak) * trial.u + step, self.limit))

    def limits(self, task: Task, memory: Feedforward, trial: Trial) -> dict[str, Limit]:
        return limit_of(self.unlimited().learn(memory, trial).u, self.limit)


def need_lead(scheme, task: Task) -> None:
    """Raises ValueError if the learning lead leaves nothing of the trial to learn from."""
    if scheme.lead >= task.N:
        raise ValueError(
            f"{type(scheme).__name__}: lead = {scheme.lead} is outside its allowed range [0, "
            f"{task.N - 1}] for N = {task.N}"
        )
