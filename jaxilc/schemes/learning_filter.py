"""Learning by two filters of finite length, causal or not: the general linear law by its taps."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from ..pytree.fields import Leaf, leaf, pytree, static
from ..pytree.needs import need_channels
from ..signals.task import Limit, Task, Trial
from .scheme import Feedforward, Scheme, limit_of, limited, need_square


@pytree
class LearningFilter(Scheme):
    """The general linear law with a memory of one trial, by its taps (Bristow 2006, eq. 3).

        u_{j+1}[k] = sum_i keep_i u_j[k + i - m] + sum_i L_i e_j[k + 1 + lead + i - n]

    where i runs over the 2 m + 1 taps of keep and over the 2 n + 1 taps of L; the middle tap is the
    one without a shift. With the default of keep, which is 1, the law is u_{j+1} = u_j + L e_j, and
    `Filtered(LearningFilter(L), Q)` is u_{j+1} = Q (u_j + L e_j). With keep = Q and L = M the law
    is u_{j+1} = Q u_j + M e_j, for any M; the synthesis of filters finds such laws. P-type learning
    of lead m has the single tap L = gamma_p.

    Beyond the ends of the trial the error counts as zero, and u is mirrored. So symmetric taps of
    keep with |Q| <= 1 make no input larger, also at the ends.

    L:    (2 n + 1,) taps of the learning filter, earliest error first [unit of u per unit of y]
    keep: (2 m + 1,) taps on what was learned before, earliest first
    lead: samples of look-ahead of the middle tap beyond the one sample from u[k] to y[k+1]
    limit: () or (n_u,) largest |u| that is learned [unit of u]; None: no limit

    Each channel learns from its own error. Raises ValueError for taps that are not one list of an
    odd length; `check` raises it for taps or a lead that reach beyond the whole trial.
    """

    L: Leaf = leaf()
    keep: Leaf = leaf(default=(1.0,))
    limit: Leaf | None = leaf(default=None, interval="(0, inf)", optional=True)
    lead: int = static(default=0, interval="[0, inf)", whole=True)
    clips = ("limit",)

    def __post_init__(self):
        for name in ("L", "keep"):
            taps = getattr(self, name)
            if taps.ndim != 1 or not taps.shape[-1] % 2:
                raise ValueError(
                    f"LearningFilter: {name} has shape {taps.shape}; allowed is an odd number of "
                    "taps (2 n + 1,), the one without a shift in the middle"
                )

    def check(self, task: Task) -> None:
        need_square(self, task)
        need_channels(self, task.inputs, "limit")
        reach = self.lead + self.L.shape[0] // 2
        for what, samples in (("lead and L reach", reach), ("keep reaches", len(self.keep) // 2)):
            if samples >= task.N:
                raise ValueError(
                    f"LearningFilter: {what} over {samples} samples; allowed is less than the "
                    f"trial of N = {task.N}"
                )

    def initial_memory(self, task: Task) -> Feedforward:
        return Feedforward(jnp.zeros((task.N, task.inputs)))

    def learn(self, memory: Feedforward, trial: Trial) -> Feedforward:
        N, n, m = trial.u.shape[0], self.L.shape[0] // 2, self.keep.shape[0] // 2
        e = jnp.pad(trial.e, ((n, n + self.lead), (0, 0)))[1 + self.lead :][: N + 2 * n]
        u = jnp.pad(trial.u, ((m, m), (0, 0)), mode="symmetric")
        return Feedforward(limited(_correlated(self.keep, u) + _correlated(self.L, e), self.limit))

    def limits(self, task: Task, memory: Feedforward, trial: Trial) -> dict[str, Limit]:
        return limit_of(self.unlimited().learn(memory, trial).u, self.limit)


def _correlated(taps, signal) -> jax.Array:
    """(N, n) sum_i taps_i signal[k + i] of a signal (N + taps - 1, n)."""
    return jax.vmap(
        lambda channel: jnp.correlate(channel, taps, mode="valid"), in_axes=1, out_axes=1
    )(signal)
