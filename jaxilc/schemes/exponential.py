"""PD-type iterative learning control with a gain that grows along the trial (Xu 2024, section
4).
"""

from __future__ import annotations

import jax.numpy as jnp

from ..pytree.fields import Leaf, leaf, pytree, static
from ..pytree.needs import need_channels
from ..signals.task import Limit, Task, Trial
from .pid_type import need_lead
from .scheme import Feedforward, Scheme, advance, limit_of, limited, need_square
from .sliding_mode import need_input_gain


@pytree
class ExponentialPD(Scheme):
    """PD-type learning with a gain that grows along the trial (Xu 2024, eq. 21 to 27):

        u_{j+1}[k] = u_j[k] + exp(lam0 k dt) (K_P e_j[k+1+m] + K_D e_j'[k+1+m]) / b,    e = r - y

    For `WithFeedback(ExponentialPD(...), ASMC(...))`, which is u_j = u_asmc,j + u_ilc,j / b: u here
    is u_ilc / b. The paper writes the whole input u_k on the right of eq. 24 to 27, and would so
    learn the feedback's share again in every trial; it is read as the part that is learned, as eq.
    33 to 36 do. e' is the central difference (e[k+1] - e[k-1]) / (2 dt), of zero phase, since a
    whole trial is known; it is one-sided at the two ends of the trial. What lies beyond the end of
    the trial counts as zero.

    In a trial, slow errors fall by the factor |1 - K_P exp(lam0 t) / (lam1 (k_n + eta_hat /
    Delta))|. Once they are below the dead zone, eta_hat stays at its start value in the next trial,
    and the feedback is then as weak as it can be: with a start value of 0, K_P exp(lam0 t) <
    2 lam1 k_n is the condition.

    K_P: [u b/y];  K_D: [u b s/y]; with b of the nominal model in y/(u s^2), 1/s^2 and 1/s
    b: input gain of the nominal model, not 0; 1 for gains per unit of u
    lam0: >= 0 [1/s]
    lead: m, samples by which learning looks ahead beyond the one of u[k] -> y[k+1]
    limit: largest |u| learned, None for none
    K_P, K_D, b, lam0 and limit are () or (n,).
    Raises ValueError for b = 0, or a lead that leaves nothing of the trial.
    """

    K_P: Leaf = leaf(default=0.0)
    K_D: Leaf = leaf(default=0.0)
    lam0: Leaf = leaf(default=0.0, interval="[0, inf)")
    b: Leaf = leaf(default=1.0)
    limit: Leaf | None = leaf(default=None, interval="(0, inf)", optional=True)
    lead: int = static(default=0, interval="[0, inf)", whole=True)
    clips = ("limit",)

    def __post_init__(self):
        need_input_gain(self)

    def check(self, task: Task) -> None:
        need_square(self, task)
        need_lead(self, task)
        need_channels(self, task.inputs, "K_P", "K_D", "lam0", "b", "limit")

    def initial_memory(self, task: Task) -> Feedforward:
        return Feedforward(jnp.zeros((task.N, task.inputs)))

    def learn(self, memory: Feedforward, trial: Trial) -> Feedforward:
        t = jnp.arange(trial.u.shape[0])[:, None] * trial.dt
        step = self.K_P * trial.e + self.K_D * jnp.asarray(jnp.gradient(trial.e, trial.dt, axis=0))
        return Feedforward(
            limited(
                trial.u + jnp.exp(self.lam0 * t) * advance(step, 1 + self.lead) / self.b, self.limit
            )
        )

    def limits(self, task: Task, memory: Feedforward, trial: Trial) -> dict[str, Limit]:
        return limit_of(self.unlimited().learn(memory, trial).u, self.limit)
