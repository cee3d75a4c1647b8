"""P-, PD- and PID-type learning, the classical laws with a fixed learning gain."""

from __future__ import annotations

import jax.numpy as jnp

from ..pytree.fields import Leaf, leaf, pytree, static
from ..pytree.needs import need_channels
from ..signals.by_row import by_row
from ..signals.task import Limit, Task, Trial
from .scheme import Feedforward, Scheme, limit_of, limited, need_square
from .shifts import advance, running_sum


@pytree
class PIDType(Scheme):
    """P-, PD- and PID-type learning (Cao 2019, section IV-D; Li 2020, eq. 2).

        u_{j+1}[k] = (1 - leak) u_j[k] + gamma_p e_j[k+1+m] + gamma_i sum_{i<=k} e_j[i+1]
                     + gamma_d (e_j[k+1+m] - e_j[k+m])

    The gains are per sample, as both papers print them. `Filtered(scheme, filter)` adds the
    robustness filter: u_{j+1} = Q(u_j + L e_j). Errors and differences beyond the end of the trial
    count as zero.

    gamma_p, gamma_i, gamma_d: () or (n,) learning gains [unit of u per unit of y]
    leak: () or (n,) forgetting factor in [0, 1)
    lead: m, samples of look-ahead of the learning beyond the one sample from u[k] to y[k+1]
    limit: () or (n,) largest |u| that is learned [unit of u]; None: no limit
    `check` raises ValueError for a lead that is not shorter than the trial.
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
        return Feedforward(
            self._law(trial.u, advance(e, 1 + self.lead), running_sum(e[1:]), difference)
        )

    @by_row
    def _law(self, u, e, integral, difference):
        step = self.gamma_p * e + self.gamma_i * integral + self.gamma_d * difference
        return limited((1.0 - self.leak) * u + step, self.limit)

    def limits(self, task: Task, memory: Feedforward, trial: Trial) -> dict[str, Limit]:
        return limit_of(self.unlimited().learn(memory, trial).u, self.limit)


def need_lead(scheme, task: Task) -> None:
    """Raises ValueError unless the learning lead is shorter than the trial."""
    if scheme.lead >= task.N:
        raise ValueError(
            f"{type(scheme).__name__}: lead = {scheme.lead} is outside its allowed range [0, "
            f"{task.N - 1}] for N = {task.N}"
        )
