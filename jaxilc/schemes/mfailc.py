"""Model-free adaptive iterative learning control along the trial axis (Cao 2019): CFDL, PFDL and
FFDL.

All three are one scheme. The data model is a pseudo gradient Phi over a window of L_y output and
L_u input increments between trials (eq. 18); CFDL is the window (0, 1), whose Phi is the scalar
pseudo partial derivative, and PFDL is (0, L_u). Below, D x(k, j) = x(k, j) - x(k, j-1) is the
increment between trials; several channels are taken one by one.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from ..pytree.fields import Leaf, leaf, pytree, static
from ..pytree.needs import need_channels
from ..signals.task import Sample, Task, Trial
from .pid_type import need_lead
from .pseudo_gradient import RESETS, need_window, pseudo_gradient, reset_estimate
from .scheme import Scheme, advance, delay, limited, need_square


class Memory(NamedTuple):
    """What MFAILC knows after trial j.

    u: (N, n) input of trial j;  y: (N+1, n) output of trial j
    phi: L_y+L_u estimates, each (N, n), for the coming trial;  seen: () 1 once a trial has been
    seen, else 0
    """

    u: jax.Array
    y: jax.Array
    phi: tuple[jax.Array, ...]
    seen: jax.Array


class Schedule(NamedTuple):
    """The rows that FFDL-MFAILC sees within a trial.

    u: (N, n) the part of the law that is known before the trial
    y, u_last: (N, n) output and input of trial j-1
    weights: L_y+L_u-1 of them, each (N, n), of the increments D y(k..k-L_y+1, j) and
        D u(k-1..k-L_u+1, j) of the running trial
    """

    u: jax.Array
    y: jax.Array
    u_last: jax.Array
    weights: tuple[jax.Array, ...]


class Window(NamedTuple):
    """Increments of the running trial, newest first, each (n,): L_y-1 of the output and L_u-1 of
    the input.

    u_last: (n,) what was applied in trial j-1 at the sample before
    Tuples of arrays rather than one array: in a loop over samples, shifting an array costs a copy.
    """

    dy: tuple[jax.Array, ...]
    du: tuple[jax.Array, ...]
    u_last: jax.Array


@pytree
class FFDLMFAILC(Scheme):
    """Full-form MFAILC (Cao 2019, eq. 25 and 27), with c = L_y + 1 the component of u(k):

        u(k,j) = u(k,j-1) + phi_c / (lam + phi_c^2) [ rho_c e(k+1,j-1)
                                                      - sum_{i<=L_y} rho_i phi_i D y(k-i+1,j)
                                                      - sum_{i>c} rho_i phi_i D u(k+L_y-i+1,j) ]

    D y(k,j) belongs to the running trial: FFDL acts as feedback within the trial, CFDL does not.
    The first trial applies u = 0, the second uses phi0, the estimator has data from the third on.
    With a learning lead m, e and D y are taken m samples later; where that lies beyond the end of
    the trial the error counts as zero and the estimate stays.

    Every u above is the input as the actuator applied it, of both trials: u(k,j-1) and the
    increments between trials come from `Trial.u`, those within the running trial from
    `Sample.applied`. Only what this sample adds is a command, which the actuator then limits, slows
    or rounds. A controller that cannot know what its actuator applies takes what it commanded;
    record that as the trial's u as well, so that both increments are of the commanded input.

    lam: () > 0 weight on the input increment [(y/u)^2]
    rho: () or (L_y+L_u,) step factors in (0, 1]
    eta: () estimator step in (0, 2];  mu: () > 0 [u^2], for L_y > 0 mixed units as in the paper
    phi0: (L_y+L_u,) start value; Cao 2019 does not print it, and the result depends on it
    epsilon: () reset threshold;  limit: largest |u|, None for none
    L_y, L_u: windows;  lead: m;  reset: see `reset_estimate`
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
        phi = pseudo_gradient(
            memory.phi, outputs + inputs, advance(dy, 1 + self.lead), eta=self.eta, mu=self.mu
        )
        phi = reset_estimate(
            phi, du, self._start(), component=self.L_y, epsilon=self.epsilon, mode=self.reset
        )
        if self.lead:
            phi = [
                jnp.concatenate([new[: -self.lead], old[-self.lead :]])
                for new, old in zip(phi, memory.phi, strict=True)
            ]
        return Memory(trial.u, trial.y, tuple(phi), jnp.ones_like(memory.seen))

    def schedule(self, memory: Memory, task: Task) -> Schedule:
        c, rho = self.L_y, jnp.broadcast_to(self.rho, (self.L_y + self.L_u,))
        lead = memory.phi[c]
        gain = lead / (self.lam + lead**2)
        weights = tuple(
            memory.seen * gain * rho[i] * memory.phi[i]
            for i in range(self.L_y + self.L_u)
            if i != c
        )
        e = memory.seen * advance(task.reference - memory.y, 1 + self.lead)
        u = memory.u + gain * rho[c] * e
        if not weights:
            u = limited(
                u, self.limit
            )  # with weights, the running trial's increments come on top first
        return Schedule(u, memory.y[:-1], memory.u, weights)

    def initial_state(self, task: Task) -> Window:
        rest = jnp.zeros(task.inputs)
        return Window((rest,) * max(self.L_y - 1, 0), (rest,) * (self.L_u - 1), rest)

    def act(self, state: Window, sample: Sample) -> tuple[Window, jax.Array]:
        row = sample.row
        if self.L_y + self.L_u == 1:
            return state, limited(row.u, self.limit)
        dy, du = (sample.y - row.y, *state.dy)[: self.L_y], state.du
        if du and sample.applied is not None:  # what was commanded a sample ago has become this
            du = (sample.applied - state.u_last, *du[1:])
        u = row.u - sum(
            weight * increment for weight, increment in zip(row.weights, dy + du, strict=True)
        )
        u = limited(u, self.limit)
        du = (u - row.u_last, *du)[: self.L_u - 1]
        return Window(dy[: max(self.L_y - 1, 0)], du, row.u_last), u

    def _start(self):
        return jnp.atleast_1d(jnp.asarray(self.phi0))


@pytree
class PFDLMFAILC(FFDLMFAILC):
    """Partial-form MFAILC: the full form without output increments, L_y = 0. phi0: (L_u,)"""

    phi0: Leaf = leaf(default=(-0.065, 0.0))
    L_y: int = static(default=0, interval="[0, 0]")


@pytree
class CFDLMFAILC(FFDLMFAILC):
    """Compact-form MFAILC (Cao 2019, eq. 12 and 13): L_y = 0, L_u = 1, phi the pseudo partial
    derivative.

        u(k,j) = u(k,j-1) + rho phi(k,j) / (lam + phi(k,j)^2) e(k+1,j-1)

    An adaptive P-type law: on a dynamic plant the error can fall for some trials and then grow at
    any lam. A `Filtered` wrapper, a learning lead or a stop rule makes it usable there. eta: () in
    (0, 1];  phi0: () or (1,)
    """

    lam: Leaf = leaf(default=1.0, interval="(0, inf)")
    rho: Leaf = leaf(default=1.0, interval="(0, 1]")
    eta: Leaf = leaf(default=0.9, interval="(0, 1]")
    mu: Leaf = leaf(default=1.0, interval="(0, inf)")
    phi0: Leaf = leaf(default=-0.065)
    L_y: int = static(default=0, interval="[0, 0]")
    L_u: int = static(default=1, interval="[1, 1]")
