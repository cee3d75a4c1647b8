"""Model-free adaptive iterative learning control (MFAILC) along the trial axis (Cao 2019).

CFDL, PFDL and FFDL (the compact, the partial and the full form of dynamic linearisation) are one
scheme. Its data model is a pseudo gradient Phi over a window of L_y output and L_u input increments
between trials (eq. 18). CFDL has the window (0, 1), and its Phi is the scalar pseudo partial
derivative. PFDL has the window (0, L_u). Below, D x(k, j) = x(k, j) - x(k, j-1) is the increment
between trials. Several channels are controlled independently of each other.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from ..pytree.fields import Leaf, leaf, pytree, static
from ..pytree.needs import need_channels
from ..signals.by_row import by_row
from ..signals.sample_layout import for_scan
from ..signals.task import Sample, Task, Trial
from .pid_type import need_lead
from .pseudo_gradient import RESETS, need_window, pseudo_gradient, reset_estimate
from .scheme import Scheme, limited, need_square
from .shifts import advance, delay


class Memory(NamedTuple):
    """The memory of MFAILC after trial j.

    u: (N, n) input of trial j [unit of u]
    y: (N+1, n) output of trial j [unit of y]
    phi: (N, n) each, L_y+L_u components of the estimate for the next trial
    seen: () 0 before the first trial, else 1
    """

    u: jax.Array
    y: jax.Array
    phi: tuple[jax.Array, ...]
    seen: jax.Array


class Schedule(NamedTuple):
    """The rows that FFDL-MFAILC sees within a trial.

    u: (N, n) the part of the law that is known before the trial [unit of u]
    y: (N, n) output of trial j-1 [unit of y]
    u_last: (N, n) input of trial j-1 [unit of u]
    weights: (N, n) each, the L_y+L_u-1 weights of the increments D y(k..k-L_y+1, j) and
        D u(k-1..k-L_u+1, j) of the running trial
    """

    u: jax.Array
    y: jax.Array
    u_last: jax.Array
    weights: tuple[jax.Array, ...]


class Window(NamedTuple):
    """The increments of the running trial that MFAILC keeps, newest first.

    dy: (n,) each, L_y-1 increments of the output [unit of y]
    du: (n,) each, L_u-1 increments of the input [unit of u]
    u_last: (n,) input that was applied in trial j-1 at the sample before [unit of u]
    The increments are tuples of arrays, because to shift one array in a loop over samples costs a
    copy.
    """

    dy: tuple[jax.Array, ...]
    du: tuple[jax.Array, ...]
    u_last: jax.Array


@pytree
class FFDLMFAILC(Scheme):
    """Full-form MFAILC (Cao 2019, eq. 25 and 27).

        u(k,j) = u(k,j-1) + phi_c / (lam + phi_c^2) [ rho_c e(k+1,j-1)
                                                      - sum_{i<=L_y} rho_i phi_i D y(k-i+1,j)
                                                      - sum_{i>c} rho_i phi_i D u(k+L_y-i+1,j) ]

    where c = L_y + 1 is the number of the component of u(k).

    D y(k,j) is an increment of the running trial, so FFDL acts as feedback within the trial; CFDL
    does not. The first trial applies u = 0, the second uses phi0, and the estimator has data from
    the third trial on. With a learning lead m, e and D y are taken m samples later. Where that is
    beyond the end of the trial, the error counts as zero and the estimate does not change.

    Every u above is the input that the actuator applied, in both trials. u(k,j-1) and the
    increments between trials come from `Trial.u`; the increments within the running trial come from
    `Sample.applied`. Only the contribution of the present sample is a command, which the actuator
    then limits in size, limits in rate, or rounds. A controller that cannot know what its actuator
    applies uses what it commanded. Then record the command also as the u of the trial, so that both
    kinds of increments are those of the commanded input.

    lam: () > 0, weight on the input increment [(y/u)^2]
    rho: () or (L_y+L_u,) step factors in (0, 1]
    eta: () in (0, 2], step of the estimator
    mu: () > 0 [u^2]; for L_y > 0 its units are mixed, as in the paper
    phi0: (L_y+L_u,) start value of the estimate; Cao 2019 does not print it, and the result depends
        on it
    epsilon: () reset threshold
    limit: () or (n,) largest |u| [unit of u]; None: no limit
    L_y, L_u: lengths of the windows of output and of input increments
    lead: m, samples of look-ahead of the learning
    reset: see `reset_estimate`
    """

    lam: Leaf = leaf(default=1.2, interval="(0, inf)")
    rho: Leaf = leaf(default=0.98, interval="(0, 1]")
    eta: Leaf = leaf(default=1.0, interval="(0, 2]")
    mu: Leaf = leaf(default=1.1, interval="(0, inf)")
    phi0: Leaf = leaf(default=(0.5, 0.0, -0.06, 0.0))
    epsilon: Leaf = leaf(default=1e-5, interval="(0, inf)")
    limit: Leaf | None = leaf(default=None, interval="(0, inf)", optional=True)
    L_y: int = static(default=2, interval="[0, 500]", whole=True)
    L_u: int = static(default=2, interval="[1, 500]", whole=True)
    lead: int = static(default=0, interval="[0, inf)", whole=True)
    reset: str = static(default="book", choices=RESETS)
    estimator_steps = ("eta",)
    clips = ("limit",)
    compares = ("L_y",)

    def __post_init__(self):
        need_window(self)

    def check(self, task: Task) -> None:
        need_square(self, task)
        need_lead(self, task)
        need_channels(self, task.inputs, "lam", "eta", "mu", "epsilon", "limit")

    @property
    def plays_back(self) -> bool:
        return self.L_y + self.L_u == 1

    def initial_memory(self, task: Task) -> Memory:
        N, n = task.N, task.inputs
        phi = tuple(jnp.broadcast_to(p, (N, n)) for p in self._start())
        return Memory(jnp.zeros((N, n)), jnp.zeros((N + 1, n)), phi, jnp.zeros(()))

    def learn(self, memory: Memory, trial: Trial) -> Memory:
        du, dy = memory.seen * (trial.u - memory.u), memory.seen * (trial.y - memory.y)
        outputs = [delay(dy[:-1], i) for i in range(self.L_y)]
        inputs = [delay(du, i) for i in range(self.L_u)]
        phi = self._estimated(memory.phi, outputs + inputs, advance(dy, 1 + self.lead), du)
        if self.lead:
            phi = [
                jnp.concatenate([new[: -self.lead], old[-self.lead :]])
                for new, old in zip(phi, memory.phi, strict=True)
            ]
        return Memory(trial.u, trial.y, tuple(phi), jnp.ones_like(memory.seen))

    def schedule(self, memory: Memory, task: Task) -> Schedule:
        e = memory.seen * advance(task.reference - memory.y, 1 + self.lead)
        u, weights = self._law(memory.phi, memory.u, e)
        weights = tuple(memory.seen * weight for weight in weights)
        return Schedule(u, memory.y[:-1], memory.u, weights)

    def initial_state(self, task: Task) -> Window:
        rest = jnp.zeros(task.inputs)
        return Window((rest,) * max(self.L_y - 1, 0), (rest,) * (self.L_u - 1), rest)

    def act(self, state: Window, sample: Sample) -> tuple[Window, jax.Array]:
        row = sample.row
        if self.L_y + self.L_u == 1:
            return state, limited(row.u, self.limit)
        dy, du = (sample.y - row.y, *state.dy)[: self.L_y], state.du
        if du and sample.applied is not None:  # the actuator made this of the last command
            du = (sample.applied - state.u_last, *du[1:])
        u = row.u - sum(
            weight * increment for weight, increment in zip(row.weights, dy + du, strict=True)
        )
        u = limited(u, self.limit)
        du = (u - row.u_last, *du)[: self.L_u - 1]
        return Window(dy[: max(self.L_y - 1, 0)], du, row.u_last), u

    @by_row
    def _estimated(self, phi, increments, dy, du):
        """The estimate for the next trial, see `pseudo_gradient` and `reset_estimate`."""
        phi = pseudo_gradient(phi, increments, dy, eta=self.eta, mu=self.mu)
        return reset_estimate(
            phi, du, self._start(), component=self.L_y, epsilon=self.epsilon, mode=self.reset
        )

    @by_row
    def _law(self, phi, u, e):
        """The part of the law that is known before the trial, and the weights of increments."""
        c, rho = self.L_y, jnp.broadcast_to(self.rho, (self.L_y + self.L_u,))
        gain = phi[c] / (self.lam + phi[c] ** 2)
        if len(phi) > 1:  # each weight uses it: laid out once, not once for each
            gain = for_scan(gain)
        weights = tuple(gain * rho[i] * p for i, p in enumerate(phi) if i != c)
        u = u + gain * rho[c] * e
        # with weights, `act` first adds the increments of the running trial
        return (u if weights else limited(u, self.limit)), weights

    def _start(self):
        return jnp.atleast_1d(jnp.asarray(self.phi0))


@pytree
class PFDLMFAILC(FFDLMFAILC):
    """Partial-form MFAILC, which has no output increments (L_y = 0); phi0 has the shape (L_u,)."""

    phi0: Leaf = leaf(default=(-0.065, 0.0))
    L_y: int = static(default=0, interval="[0, 0]")


@pytree
class CFDLMFAILC(FFDLMFAILC):
    """Compact-form MFAILC (Cao 2019, eq. 12 and 13): L_y = 0 and L_u = 1.

        u(k,j) = u(k,j-1) + rho phi(k,j) / (lam + phi(k,j)^2) e(k+1,j-1)

    phi is the pseudo partial derivative. This is an adaptive P-type law. On a dynamic plant the
    error can decrease for some trials and then grow, whatever lam is. With a `Filtered` wrapper, a
    learning lead or a stop rule it can be used on such plants.

    eta: () in (0, 1], step of the estimator
    phi0: () or (1,) start value of the estimate
    """

    lam: Leaf = leaf(default=1.0, interval="(0, inf)")
    rho: Leaf = leaf(default=1.0, interval="(0, 1]")
    eta: Leaf = leaf(default=0.9, interval="(0, 1]")
    mu: Leaf = leaf(default=1.0, interval="(0, inf)")
    phi0: Leaf = leaf(default=-0.065)
    L_y: int = static(default=0, interval="[0, 0]")
    L_u: int = static(default=1, interval="[1, 1]")
