"""P-, PD- and PID-type learning, the classical laws; of several trials; with a growing gain."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from ..pytree.aliases import Array, Leaf, Tree
from ..pytree.fields import leaf, pytree, static
from ..pytree.needs import known, need_channels
from ..signals.rows import advance, by_row, running_sum
from ..signals.task import Task, Trial
from .scheme import Feedforward, Scheme, limited, need_square
from .sliding_mode import need_input_gain

FORESEEN = 50  # trials in which the growth of what is learned is looked for


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

    def learn(self, memory: Feedforward, trial: Trial) -> Feedforward:
        e = trial.e
        difference = jnp.pad(jnp.diff(e, axis=0)[self.lead :], ((0, self.lead), (0, 0)))
        return Feedforward(
            self._law(trial.u, advance(e, 1 + self.lead), running_sum(e[1:]), difference)
        )

    @by_row
    def _law(self, u: Array, e: Array, integral: Array, difference: Array) -> Array:
        step = self.gamma_p * e + self.gamma_i * integral + self.gamma_d * difference
        return limited((1.0 - self.leak) * u + step, self.limit)


def need_lead(scheme: Tree, task: Task) -> None:
    """Raises ValueError unless the learning lead is shorter than the trial."""
    if scheme.lead >= task.N:
        raise ValueError(
            f"{type(scheme).__name__}: lead = {scheme.lead} is outside its allowed range [0, "
            f"{task.N - 1}] for N = {task.N}"
        )


class Past(NamedTuple):
    """The memory of `HigherOrder`.

    u: (N, n) input of the next trial [unit of u]
    inputs: (N, n) each, inputs of the P-1 trials before the last, newest first [unit of u]
    errors: (N, n) each, errors e[k+1+lead] of the same trials [unit of y]
    Inputs and errors before the first trial are zero.
    """

    u: Array
    inputs: tuple[Array, ...]
    errors: tuple[Array, ...]


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
    elementwise = True

    def __post_init__(self) -> None:
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

    @property
    @np.errstate(over="ignore", invalid="ignore")
    def grows(self) -> float:
        """From trials with e = 1, by the law itself; input and errors before them are zero."""
        alpha, gamma = np.asarray(self.alpha), np.asarray(self.gamma)
        gamma = np.cumsum(gamma.reshape(len(alpha), -1), axis=0)
        u, largest, most = np.zeros(gamma.shape), np.zeros(gamma.shape[1]), 1.0
        for j in range(1, FORESEEN + 1):
            now = alpha @ u + gamma[min(j, len(gamma)) - 1]
            played = largest > 0
            ratio = np.abs(now[played]) / largest[played] / (1 + 1 / max(1, j - 1))
            most = max(most, float(np.max(ratio, initial=0.0)))
            u, largest = np.vstack([now, u[:-1]]), np.maximum(largest, np.abs(now))
        return most

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
        inputs = (trial.u, *memory.inputs)
        errors = (advance(trial.e, 1 + self.lead), *memory.errors)
        return Past(self._law(inputs, errors), inputs[:-1], errors[:-1])

    def started(self, memory: Past, u: Array, task: Task) -> Past:
        """The memory after trials that all played the input u (N, n) without an error."""
        return Past(jnp.asarray(u), (jnp.asarray(u),) * len(memory.inputs), memory.errors)

    @by_row
    def _law(self, inputs: tuple[Array, ...], errors: tuple[Array, ...]) -> Array:
        u = sum(self.alpha[i] * inputs[i] + self.gamma[i] * errors[i] for i in range(len(inputs)))
        return limited(u, self.limit)


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

    def __post_init__(self) -> None:
        need_input_gain(self)

    def check(self, task: Task) -> None:
        need_square(self, task)
        need_lead(self, task)
        need_channels(self, task.inputs, "K_P", "K_D", "lam0", "b", "limit")

    def learn(self, memory: Feedforward, trial: Trial) -> Feedforward:
        t = jnp.arange(trial.u.shape[0])[:, None] * trial.dt
        slope = jnp.asarray(jnp.gradient(trial.e, trial.dt, axis=0))
        e, slope = advance(trial.e, 1 + self.lead), advance(slope, 1 + self.lead)
        return Feedforward(self._law(trial.u, t, e, slope))

    @by_row
    def _law(self, u: Array, t: Array, e: Array, slope: Array) -> Array:
        step = self.K_P * e + self.K_D * slope
        return limited(u + jnp.exp(self.lam0 * t) * step / self.b, self.limit)
