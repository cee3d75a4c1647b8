"""Learning by two filters of finite length, causal or not: the general linear law by its taps."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from ..pytree.fields import Leaf, leaf, pytree, static
from ..pytree.needs import need_channels
from ..signals.correlation import correlated, in_segments
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

    Taps are numbers, and each channel learns from its own error; or they are matrices, and each
    input learns from all errors. With `starts` they are scheduled: the trial is cut into segments,
    and u_{j+1}[k] follows from the taps of the segment of k.

    L:    (p,) or (p, n_u, n_y) taps of the learning filter, p = 2 n + 1, earliest error first
        [unit of u per unit of y]; with S segments (S, p) or (S, p, n_u, n_y)
    keep: (p',) or (p', n_u, n_u) taps on what was learned before, p' = 2 m + 1, earliest first;
        with S segments also (S, p') or (S, p', n_u, n_u)
    lead: samples of look-ahead of the middle tap beyond the one sample from u[k] to y[k+1]
    limit: () or (n_u,) largest |u| that is learned [unit of u]; None: no limit
    starts: first samples of the segments after the first, rising; () for one law in all samples

    Raises ValueError for taps that are not an odd number, and for another number of segments;
    `check` raises it for taps of other channels, and for taps, a lead or a segment that reach
    beyond the whole trial.
    """

    L: Leaf = leaf()
    keep: Leaf = leaf(default=(1.0,))
    limit: Leaf | None = leaf(default=None, interval="(0, inf)", optional=True)
    lead: int = static(default=0, interval="[0, inf)", whole=True)
    starts: tuple[int, ...] = static(default=())
    clips = ("limit",)

    def __post_init__(self):
        for name in ("L", "keep"):
            shape, scheduled = getattr(self, name).shape, self._scheduled(name)
            segments = len(self.starts) + 1
            if len(shape) not in (1, 2, 3, 4) or not shape[scheduled] % 2:
                raise ValueError(
                    f"LearningFilter: {name} has shape {shape}; allowed is an odd number of taps, "
                    "(2 n + 1,) or as matrices (2 n + 1, n_u, n), the one without a shift in the "
                    "middle"
                )
            if scheduled and shape[0] != segments:
                raise ValueError(
                    f"LearningFilter: {name} has shape {shape}, taps of {shape[0]} segments, but "
                    f"starts = {self.starts} make {segments}"
                )
        if any(a >= b for a, b in zip((0, *self.starts), self.starts, strict=False)):
            raise ValueError(
                f"LearningFilter: starts = {self.starts}; allowed are samples above 0 that rise"
            )

    def check(self, task: Task) -> None:
        need_channels(self, task.inputs, "limit")
        for name, seen in (("L", task.outputs), ("keep", task.inputs)):
            self._need_channels_of(name, seen, task)
        reach = self.lead + self._taps("L") // 2
        for what, samples in (
            ("lead and L reach", reach),
            ("keep reaches", self._taps("keep") // 2),
            ("the last of starts reaches", max(self.starts, default=0)),
        ):
            if samples >= task.N:
                raise ValueError(
                    f"LearningFilter: {what} over {samples} samples; allowed is less than the "
                    f"trial of N = {task.N}"
                )

    def _need_channels_of(self, name: str, seen: int, task: Task) -> None:
        """Raises ValueError unless the taps fit the channels that they go to and come from."""
        taps = getattr(self, name)
        if taps.ndim <= 2:
            if name == "L":
                need_square(self, task)
        elif taps.shape[-2:] != (task.inputs, seen):
            raise ValueError(
                f"LearningFilter: {name} has shape {taps.shape}; allowed are matrices of "
                f"({task.inputs}, {seen}) for this task"
            )

    def initial_memory(self, task: Task) -> Feedforward:
        return Feedforward(jnp.zeros((task.N, task.inputs)))

    def learn(self, memory: Feedforward, trial: Trial) -> Feedforward:
        N, n, m = trial.u.shape[0], self._taps("L") // 2, self._taps("keep") // 2
        e = jnp.pad(trial.e, ((n, n + self.lead), (0, 0)))[1 + self.lead :][: N + 2 * n]
        u = jnp.pad(trial.u, ((m, m), (0, 0)), mode="symmetric")
        return Feedforward(limited(self._through("keep", u) + self._through("L", e), self.limit))

    def limits(self, task: Task, memory: Feedforward, trial: Trial) -> dict[str, Limit]:
        return limit_of(self.unlimited().learn(memory, trial).u, self.limit)

    def _scheduled(self, name: str) -> bool:
        return getattr(self, name).ndim % 2 == 0

    def _taps(self, name: str) -> int:
        """The number of taps."""
        return getattr(self, name).shape[self._scheduled(name)]

    def _through(self, name: str, signal) -> jax.Array:
        """(N, n_u) the signal through the taps of each segment."""
        taps = getattr(self, name)
        if not self._scheduled(name):
            return correlated(taps, signal)
        each = jax.vmap(correlated, (0, None))(taps, signal)
        return jnp.einsum("sk,skn->kn", in_segments(self.starts, each.shape[1]), each)
