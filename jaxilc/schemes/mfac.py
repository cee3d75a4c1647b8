"""Model-free adaptive control along the time axis: CFDL-, PFDL-, FFDL-MFAC and the predictive
CFDL-MFAPC (Dai 2014).

Feedback that needs no model: the pseudo gradient is estimated from the increments between samples,
d x(k) = x(k) - x(k-1), while the controller runs. Several channels are taken one by one.
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
    """u, y: (n,) input and output one sample ago;  seen: () 1 once there is one, else 0
    dy, du: windows of increments, newest first, each (n,), as they stood one sample ago;  phi: the
    estimate, each (n,)
    """

    u: jax.Array
    y: jax.Array
    seen: jax.Array
    dy: tuple[jax.Array, ...]
    du: tuple[jax.Array, ...]
    phi: tuple[jax.Array, ...]


@pytree
class FFDLMFAC(Scheme):
    """Full-form MFAC (Hou and Jin's book, the time-axis twin of Cao 2019, eq. 25 and 27), with c =
    L_y + 1:

        u(k) = u(k-1) + phi_c / (lam + phi_c^2) [ rho_c (r(k+1) - y(k))
                                                  - sum_{i<=L_y} rho_i phi_i d y(k-i+1)
                                                  - sum_{i>c} rho_i phi_i d u(k+L_y-i+1) ]

    lam: () > 0 [(y/u)^2];  rho: () or (L_y+L_u,) in (0, 1];  eta: () in (0, 2];  mu: () > 0 [u^2]
    phi0: (L_y+L_u,) start value, whose c-th sign is that of the plant's reaction;  epsilon: ()
    reset threshold
    limit: largest |u|, from which the increments are then taken
    L_y, L_u: windows;  reset: see `reset_estimate`
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
    """Partial-form MFAC: no output increments, L_y = 0. phi0: (L_u,)"""

    phi0: Leaf = leaf(default=(-0.1, 0.0))
    L_y: int = static(default=0, interval="[0, 0]")


@pytree
class CFDLMFAC(FFDLMFAC):
    """Compact-form MFAC: L_y = 0, L_u = 1. eta: () in (0, 1];  phi0: () or (1,)

    u(k) = u(k-1) + rho phi(k) / (lam + phi(k)^2) (r(k+1) - y(k))
    """

    eta: Leaf = leaf(default=1.0, interval="(0, 1]")
    phi0: Leaf = leaf(default=-0.1)
    L_y: int = static(default=0, interval="[0, 0]")
    L_u: int = static(default=1, interval="[1, 1]")


class PredictiveState(NamedTuple):
    """u, y, du: (n,) input, output and input increment one sample ago; before the first, du = 0 and
    nothing is estimated
    phi: (n_p, n) estimates, newest first;  theta: (n_p, n) coefficients of their forecast"""

    u: jax.Array
    y: jax.Array
    du: jax.Array
    phi: jax.Array
    theta: jax.Array


@pytree
class CFDLMFAPC(Scheme):
    """Predictive compact-form MFAC (Dai 2014): P samples ahead, P_u moves of the input.

        Y(k+1) = E y(k) + A dU(k)                                   (5)   A: column i is phi(k+i)
        from row i down
        dU = (A^T A + lam I)^-1 A^T (Y* - E y(k)), u(k) = u(k-1) + dU_1    (17, 18; the print lacks
        "+" before lam I)

    For P_u = 1 this is eq. 10. Future phi come from theta . (phi(k), ..., phi(k-n_p+1)), and theta
    from a normalised projection (13) that is reset where |theta| >= theta_limit (14); forecasts are
    reset like the estimate, but without the |du| clause (16). A^T A and A^T (.) are formed from
    sums, so that nothing of size P x P_u is ever built: P = 250 costs P additions a sample.

    lam: () > 0 [(y/u)^2];  eta: () in (0, 1];  mu: () > 0 [u^2];  phi0: () start value;  epsilon:
    () reset threshold
    delta: () in (0, 1], of (13);  theta_limit: () M of (14);  limit: largest |u|, None for none
    theta0: (n_p,) start of the forecast; not printed, None is (1, 0, ..., 0), that is "phi stays"
    P: prediction horizon;  P_u: control horizon <= P;  n_p: order of the forecast >= 1
    reference: `preview` takes Y* = r(k+1..k+P), `constant` takes r(k+1) for all of it
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
        """theta(k) by eq. 13 and 14; the regressor is (phi(k-1), ..., phi(k-n_p))."""
        miss = phi_now - jnp.sum(state.phi * state.theta, axis=0)
        theta = state.theta + state.phi * miss / (self.delta + jnp.sum(state.phi**2, axis=0))
        return jnp.where(
            jnp.sqrt(jnp.sum(theta**2, axis=0)) >= self.theta_limit, self._theta0(), theta
        )

    def _future(self, phi, theta):
        """phi(k), ..., phi(k+P_u-1), each (n,), by eq. 15 and 16."""
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
        """A^T (Y* - E y) without its factor phi: (P_u, n) sums over rows i..P-1 of r(k+1+p) -
        y(k).
        """
        if self.reference == "constant":
            return (self.P - jnp.arange(self.P_u))[:, None] * (sample.ahead[0] - sample.y)
        miss = sample.ahead - sample.y
        return jnp.cumsum(miss[::-1], axis=0)[::-1][: self.P_u]

    def _first_move(self, future, wanted):
        """(n,) the first element of (A^T A + lam I)^-1 A^T (Y* - E y); (A^T A)_ij = phi_i phi_j (P
        - max(i, j)).
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
