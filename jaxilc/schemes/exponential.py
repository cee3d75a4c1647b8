"""PD-type learning with a gain that grows along the trial (Xu 2024, section 4)."""

from __future__ import annotations

import jax.numpy as jnp

from ..pytree.fields import Leaf, leaf, pytree, static
from ..pytree.needs import need_channels
from ..signals.by_row import by_row
from ..signals.task import Limit, Task, Trial
from .pid_type import need_lead
from .scheme import Feedforward, Scheme, limit_of, limited, need_square
from .shifts import advance
from .sliding_mode import need_input_gain


@pytree
class ExponentialPD(Scheme):
    """PD-type learning with a gain that grows along the trial (Xu 2024, eq. 21 to 27).

        u_{j+1}[k] = u_j[k] + exp(lam0 k dt) (K_P e_j[k+1+m] + K_D e_j'[k+1+m]) / b,    e = r - y

    It is intended for `WithFeedback(ExponentialPD(...), ASMC(...))`, where the input is
    u_j = u_asmc,j + u_ilc,j / b; the u above is u_ilc / b. The paper prints the whole input u_k on
    the right-hand side of eq. 24 to 27. Then the contribution of the feedback would be learned
    again in every trial. Here that u_k is read as the learned part only, as in eq. 33 to 36.
    e' is the central difference (e[k+1] - e[k-1]) / (2 dt), which has zero phase; it is possible
    because the whole trial is known. At the two ends of the trial the difference is one-sided.
    Values beyond the end of the trial count as zero.

    From one trial to the next, slow errors are multiplied by
    |1 - K_P exp(lam0 t) / (lam1 (k_n + eta_hat / Delta))|. When the error is below the dead zone,
    eta_hat stays at its start value in the next trial, and the feedback is then at its weakest.
    With a start value of 0 the condition for convergence is therefore
    K_P exp(lam0 t) < 2 lam1 k_n.

    K_P: () or (n,) proportional gain [u b/y], which is [1/s^2] for b in y/(u s^2)
    K_D: () or (n,) derivative gain [u b s/y], which is [1/s] for b in y/(u s^2)
    b: () or (n,) input gain of the nominal model, not 0; 1 if the gains are per unit of u
    lam0: () or (n,) >= 0, growth rate of the gain [1/s]
    lead: m, samples of look-ahead of the learning beyond the one sample from u[k] to y[k+1]
    limit: () or (n,) largest |u| that is learned [unit of u]; None: no limit
    Raises ValueError for b = 0, and for a lead that is not shorter than the trial.
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
        slope = jnp.asarray(jnp.gradient(trial.e, trial.dt, axis=0))
        e, slope = advance(trial.e, 1 + self.lead), advance(slope, 1 + self.lead)
        return Feedforward(self._law(trial.u, t, e, slope))

    @by_row
    def _law(self, u, t, e, slope):
        step = self.K_P * e + self.K_D * slope
        return limited(u + jnp.exp(self.lam0 * t) * step / self.b, self.limit)

    def limits(self, task: Task, memory: Feedforward, trial: Trial) -> dict[str, Limit]:
        return limit_of(self.unlimited().learn(memory, trial).u, self.limit)
