"""Model-free adaptive control (MFAC) along the time axis, also in predictive form (Dai 2014).

These feedback schemes need no model. While they run, they estimate the pseudo gradient from the
increments between samples, d x(k) = x(k) - x(k-1). Several channels are controlled independently.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from ..pytree.fields import Leaf, leaf, pytree, static
from ..pytree.needs import need_channels
from ..signals.task import Sample, Task
from .pseudo_gradient import RESETS, need_window, pseudo_gradient, reset_estimate
from .scheme import Scheme, limited, need_square


class State(NamedTuple):
    """The state of `FFDLMFAC`, all values as they were one sample ago.

    u, y: (n,) input [unit of u] and output [unit of y]
    seen: () 0 at the first sample of a trial, else 1
    dy: (n,) each, the L_y output increments, newest first [unit of y]
    du: (n,) each, the L_u input increments, newest first [unit of u]
    phi: (n,) each, the L_y+L_u components of the estimate
    """

    u: jax.Array
    y: jax.Array
    seen: jax.Array
    dy: tuple[jax.Array, ...]
    du: tuple[jax.Array, ...]
    phi: tuple[jax.Array, ...]


@pytree
class FFDLMFAC(Scheme):
    """Full-form MFAC (book of Hou and Jin; Cao 2019, eq. 25 and 27, with time in place of trials).

        u(k) = u(k-1) + phi_c / (lam + phi_c^2) [ rho_c (r(k+1) - y(k))
                                                  - sum_{i<=L_y} rho_i phi_i d y(k-i+1)
                                                  - sum_{i>c} rho_i phi_i d u(k+L_y-i+1) ]

    where c = L_y + 1.

    lam: () > 0, weight on the input increment [(y/u)^2]
    rho: () or (L_y+L_u,) step factors in (0, 1]
    eta: () in (0, 2], step of the estimator
    mu: () > 0 [u^2]
    phi0: (L_y+L_u,) start value; the sign of its component c is that of the plant's reaction to u
    epsilon: () reset threshold
    limit: () or (n,) largest |u| [unit of u]; the increments are those of the limited u
    L_y, L_u: lengths of the windows of output and of input increments
    reset: see `reset_estimate`
    The signal `phi` of the trial records phi_c.
    """

    lam: Leaf = leaf(default=1.0, interval="(0, inf)")
    rho: Leaf = leaf(default=1.0, interval="(0, 1]")
    eta: Leaf = leaf(default=1.0, interval="(0, 2]")
    mu: Leaf = leaf(default=1.0, interval="(0, inf)")
    phi0: Leaf = leaf(default=(0.5, 0.0, -0.1, 0.0))
    epsilon: Leaf = leaf(default=1e-5, interval="(0, inf)")
    limit: Leaf | None = leaf(default=None, interval="(0, inf)", optional=True)
    L_y: int = static(default=2, interval="[0, 500]", whole=True)
    L_u: int = static(default=2, interval="[1, 500]", whole=True)
    reset: str = static(default="book", choices=RESETS)
    estimator_steps = ("eta",)
    clips = ("limit",)

    def __post_init__(self):
        need_window(self)

    def check(self, task: Task) -> None:
        need_square(self, task)
        need_channels(self, task.inputs, "lam", "eta", "mu", "epsilon", "limit")

    def initial_state(self, task: Task) -> State:
        rest = jnp.zeros(task.inputs)
        phi = tuple(jnp.broadcast_to(p, rest.shape) for p in jnp.atleast_1d(self.phi0))
        return State(rest, rest, jnp.zeros(()), (rest,) * self.L_y, (rest,) * self.L_u, phi)

    def act(self, state: State, sample: Sample) -> tuple[State, jax.Array]:
        dy_now = state.seen * (sample.y - state.y)
        phi = pseudo_gradient(state.phi, state.dy + state.du, dy_now, eta=self.eta, mu=self.mu)
        phi0 = jnp.atleast_1d(self.phi0)
        phi = reset_estimate(
            phi, state.du[0], phi0, component=self.L_y, epsilon=self.epsilon, mode=self.reset
        )
        dy = (dy_now, *state.dy)[: self.L_y]
        rho, c = jnp.broadcast_to(self.rho, (self.L_y + self.L_u,)), self.L_y
        held = sum(rho[i] * phi[i] * dy[i] for i in range(c)) + sum(
            rho[c + i] * phi[c + i] * state.du[i - 1] for i in range(1, self.L_u)
        )
        miss = rho[c] * (sample.ahead[0] - sample.y) - held
        u = limited(state.u + phi[c] / (self.lam + phi[c] ** 2) * miss, self.limit)
        du = (u - state.u, *state.du)[: self.L_u]
        return State(u, sample.y, jnp.ones_like(state.seen), dy, du, tuple(phi)), u

    def signals(self, state: State) -> dict[str, jax.Array]:
        return {"phi": state.phi[self.L_y]}


@pytree
class PFDLMFAC(FFDLMFAC):
    """Partial-form MFAC, which has no output increments (L_y = 0); phi0 has the shape (L_u,)."""

    phi0: Leaf = leaf(default=(-0.1, 0.0))
    L_y: int = static(default=0, interval="[0, 0]")


@pytree
class CFDLMFAC(FFDLMFAC):
    """Compact-form MFAC: L_y = 0 and L_u = 1.

        u(k) = u(k-1) + rho phi(k) / (lam + phi(k)^2) (r(k+1) - y(k))

    eta: () in (0, 1], step of the estimator
    phi0: () or (1,) start value of the estimate
    """

    eta: Leaf = leaf(default=1.0, interval="(0, 1]")
    phi0: Leaf = leaf(default=-0.1)
    L_y: int = static(default=0, interval="[0, 0]")
    L_u: int = static(default=1, interval="[1, 1]")


class PredictiveState(NamedTuple):
    """The state of `CFDLMFAPC`, all values as they were one sample ago.

    u, y: (n,) input [unit of u] and output [unit of y]
    du: (n,) input increment [unit of u]; 0 before the first sample, so that nothing is estimated
    phi: (n_p, n) estimates, newest first
    theta: (n_p, n) coefficients of the forecast of phi
    """

    u: jax.Array
    y: jax.Array
    du: jax.Array
    phi: jax.Array
    theta: jax.Array


@pytree
class CFDLMFAPC(Scheme):
    """Predictive compact-form MFAC with prediction horizon P and control horizon P_u (Dai 2014).

        Y(k+1) = E y(k) + A dU(k)                                                  (5)
        dU = (A^T A + lam I)^-1 A^T (Y* - E y(k)),    u(k) = u(k-1) + dU_1         (17, 18)

    Column i of A is zero above row i and phi(k+i) from row i on. In eq. 17 the "+" before lam I is
    missing in print. For P_u = 1 the law is eq. 10. The future phi are forecast as
    theta . (phi(k), ..., phi(k-n_p+1)). theta comes from a normalised projection (13), which is
    reset where |theta| >= theta_limit (14). The forecasts are reset like the estimate, but without
    the condition on |du| (16). A^T A and A^T (.) are computed from sums, without a matrix of size
    P x P_u: P = 250 costs P additions a sample.

    lam: () > 0, weight on the input increment [(y/u)^2]
    eta: () in (0, 1], step of the estimator
    mu: () > 0 [u^2]
    phi0: () start value of the estimate
    epsilon: () reset threshold
    delta: () in (0, 1], of eq. 13
    theta_limit: () M of eq. 14
    theta0: (n_p,) start value of theta, which is not printed; None: (1, 0, ..., 0), so that the
        forecast of phi is constant
    limit: () or (n,) largest |u| [unit of u]; None: no limit
    P, P_u: prediction horizon, and control horizon <= P
    n_p: order of the forecast >= 1
    reset: see `reset_estimate`
    reference: `preview` sets Y* = r(k+1..k+P); `constant` sets all of Y* to r(k+1)
    The signal `phi` of the trial records phi(k).
    """

    lam: Leaf = leaf(default=45.0, interval="(0, inf)")
    eta: Leaf = leaf(default=1.0, interval="(0, 1]")
    mu: Leaf = leaf(default=1.0, interval="(0, inf)")
    phi0: Leaf = leaf(default=-0.1)
    epsilon: Leaf = leaf(default=1e-5, interval="(0, inf)")
    delta: Leaf = leaf(default=1.0, interval="(0, 1]")
    theta_limit: Leaf = leaf(default=10.0, interval="(0, inf)")
    theta0: Leaf | None = leaf(default=None, optional=True)
    limit: Leaf | None = leaf(default=None, interval="(0, inf)", optional=True)
    P: int = static(default=10, interval="[1, 1e6]", whole=True)
    P_u: int = static(default=1, interval="[1, 500]", whole=True)
    n_p: int = static(default=3, interval="[1, 500]", whole=True)
    reset: str = static(default="book", choices=RESETS)
    reference: str = static(default="preview", choices=("preview", "constant"))
    estimator_steps = ("eta",)
    clips = ("limit",)

    def __post_init__(self):
        if self.P_u > self.P:
            raise ValueError(
                f"CFDLMFAPC: P_u = {self.P_u} is outside its allowed range [1, {self.P}] for P = "
                f"{self.P}"
            )
        if self.theta0 is not None and self.theta0.shape != (self.n_p,):
            raise ValueError(
                f"CFDLMFAPC: theta0 has shape {self.theta0.shape}; n_p = {self.n_p} needs "
                f"({self.n_p},)"
            )

    @property
    def preview(self) -> int:
        return self.P if self.reference == "preview" else 1

    def check(self, task: Task) -> None:
        need_square(self, task)
        need_channels(
            self,
            task.inputs,
            "lam",
            "eta",
            "mu",
            "phi0",
            "epsilon",
            "delta",
            "theta_limit",
            "limit",
        )

    def initial_state(self, task: Task) -> PredictiveState:
        rest = jnp.zeros(task.inputs)
        shape = (self.n_p, task.inputs)
        phi, theta = jnp.broadcast_to(self.phi0, shape), jnp.broadcast_to(self._theta0(), shape)
        return PredictiveState(rest, rest, rest, phi, theta)

    def act(self, state: PredictiveState, sample: Sample) -> tuple[PredictiveState, jax.Array]:
        (phi_now,) = pseudo_gradient(
            [state.phi[0]], [state.du], sample.y - state.y, eta=self.eta, mu=self.mu
        )
        (phi_now,) = reset_estimate(
            [phi_now], state.du, [self.phi0], component=0, epsilon=self.epsilon, mode=self.reset
        )
        theta = self._forecaster(state, phi_now)
        phi = jnp.concatenate([phi_now[None], state.phi[:-1]])
        u = limited(
            state.u + self._first_move(self._future(phi, theta), self._wanted(sample)), self.limit
        )
        return PredictiveState(u, sample.y, u - state.u, phi, theta), u

    def signals(self, state: PredictiveState) -> dict[str, jax.Array]:
        return {"phi": state.phi[0]}

    def _theta0(self):
        start = jnp.eye(self.n_p)[0] if self.theta0 is None else jnp.asarray(self.theta0)
        return start[:, None]

    def _forecaster(self, state, phi_now):
        """The coefficients theta(k) of eq. 13, 14; the regressor is phi(k-1), ..., phi(k-n_p)."""
        miss = phi_now - jnp.sum(state.phi * state.theta, axis=0)
        theta = state.theta + state.phi * miss / (self.delta + jnp.sum(state.phi**2, axis=0))
        return jnp.where(
            jnp.sqrt(jnp.sum(theta**2, axis=0)) >= self.theta_limit, self._theta0(), theta
        )

    def _future(self, phi, theta):
        """The forecasts phi(k), ..., phi(k+P_u-1) of eq. 15 and 16, each (n,)."""
        mode = "none" if self.reset == "none" else "sign"
        past = [phi[i] for i in range(self.n_p)]
        future = past[:1]
        for _ in range(self.P_u - 1):
            ahead = sum(theta[i] * past[i] for i in range(self.n_p))
            (ahead,) = reset_estimate(
                [ahead], None, [self.phi0], component=0, epsilon=self.epsilon, mode=mode
            )
            past = [ahead, *past[:-1]]
            future.append(ahead)
        return future

    def _wanted(self, sample: Sample):
        """The product A^T (Y* - E y) without its factor phi, as (P_u, n).

        Row i is the sum of r(k+1+p) - y(k) over p = i..P-1.
        """
        if self.reference == "constant":
            return (self.P - jnp.arange(self.P_u))[:, None] * (sample.ahead[0] - sample.y)
        miss = sample.ahead - sample.y
        return jnp.cumsum(miss[::-1], axis=0)[::-1][: self.P_u]

    def _first_move(self, future, wanted):
        """The first element of (A^T A + lam I)^-1 A^T (Y* - E y), as (n,).

        (A^T A)_ij = phi_i phi_j (P - max(i, j))
        """
        if self.P_u == 1:
            return future[0] * wanted[0] / (self.P * future[0] ** 2 + self.lam)
        phi = jnp.stack(future, axis=-1)
        moves = jnp.arange(self.P_u)
        weight = jnp.broadcast_to(self.lam, phi.shape[:1])[:, None, None] * jnp.eye(self.P_u)
        normal = (
            phi[:, :, None] * phi[:, None, :] * (self.P - jnp.maximum(moves[:, None], moves))
            + weight
        )
        return jnp.linalg.solve(normal, (phi * wanted.T)[..., None])[:, 0, 0]
