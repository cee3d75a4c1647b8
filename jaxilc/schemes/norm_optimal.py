"""Norm-optimal learning, which minimises a quadratic cost of the next trial by a nominal model."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jax.scipy.linalg import cho_factor, cho_solve

from ..plants import StateSpace, TimeVaryingStateSpace
from ..pytree.aliases import Array, Leaf, Tree
from ..pytree.fields import child, leaf, pytree, static
from ..pytree.needs import need_channels
from ..pytree.ranges import brief
from ..signals.task import Task, Trial
from .constraints import stacked
from .quadratic_cost import need_convex, need_model_of, need_stable, weights_of
from .riccati import Factor, System, cholesky, cholesky_solve, newton, scan
from .scheme import Feedforward, Scheme, limited
from .weights import model_weighed

# rows or columns of the dense form: in float64, H and the factor then take half a gigabyte each
LARGEST_LIFTED = 8192


class Lifted(NamedTuple):
    """The lifted model with its factorised cost.

    H: (N n_y, N n_u) lifted model
    factor: (N n_u, N n_u) Cholesky factor of H' W_q H + W_s + W_r
    """

    H: Array
    factor: Array


@pytree
class NormOptimal(Scheme):
    """Norm-optimal learning (Amann, Owens, Rogers 1996; MILC 2024, eq. 5 to 8).

    The next input minimises the cost J of the next trial, as the model H predicts it:

        J = |e_{j+1}|^2_Wq + |u_{j+1} - u_j|^2_Wr + |u_{j+1}|^2_Ws
        e_{j+1} = e_j - H (u_{j+1} - u_j)
        u_{j+1} = u_j + (H' W_q H + W_s + W_r)^-1 (H' W_q e_j - W_s u_j)

    `riccati.newton` solves it in time and memory linear in N. With d = u_{j+1} - u_j and
    x' = A x + B d, it takes the gain K and the factor L of the cost of the input, from P[N] = 0 on:

        Z = P[k+1] + C' w_q C,       L L' = B' Z B + w_r + w_s
        K[k] = (L L')^-1 B' Z A,     P[k] = A' Z (A - B K[k])

    These equations were derived anew, because Appendix A of MILC 2024 has errors. `lifted`
    solves the same problem in dense form, with N n_u and N n_y up to 8192.

    model: nominal model of n_u inputs and n_y outputs, at the sample time of the task, where u[k]
        acts on y[k+1]. It must be stable; under feedback it is the model of the closed loop.
    w_q: () or (n_y,) or (n_y, n_y), positive semidefinite
    w_r, w_s: () or (n_u,) or (n_u, n_u), positive semidefinite; w_r + w_s positive definite
        Weights must be symmetric except for rounding; their symmetric part is used.
    limit: () or (n_u,) largest |u| that is learned [unit of u]; None: no limit. What the equations
        above give is clipped to it, which is not the best input within the limit:
        `ConstrainedNormOptimal` solves for that one
    Raises ValueError for an unstable model, and weights that are not symmetric or not semidefinite.
    The result is differentiable in the weights and in the model, through the recursion.
    """

    model: StateSpace | TimeVaryingStateSpace = child()
    w_q: Leaf = leaf(default=1.0)
    w_r: Leaf = leaf(default=0.0)
    w_s: Leaf = leaf(default=0.0)
    limit: Leaf | None = leaf(default=None, interval="(0, inf)", optional=True)
    form: str = static(default="riccati", choices=("riccati", "lifted"))
    solved: Tree = child(default=None)
    weighs = True
    clips = ("limit",)

    def __post_init__(self) -> None:
        if not isinstance(self.solved, Factor | Lifted | None):
            raise ValueError(
                f"NormOptimal: solved = {brief(self.solved)} is a {type(self.solved).__name__}; "
                "allowed is None"
            )
        need_convex(self)
        need_stable(self)

    def check(self, task: Task) -> None:
        need_model_of(self, task)
        need_channels(self, task.inputs, "limit")
        size = task.N * max(task.inputs, task.outputs)
        if self.form == "lifted" and size > LARGEST_LIFTED:
            raise ValueError(
                f"NormOptimal: form = 'lifted' would need a dense matrix of {size} rows or "
                f"columns; allowed are {LARGEST_LIFTED}: "
                "use form = 'riccati', which gives the same input in memory linear in N"
            )

    def prepared(self, task: Task) -> NormOptimal:
        return self._prepared(task.N, task.dt)

    def learn(self, memory: Feedforward, trial: Trial) -> Feedforward:
        e, u = trial.e[1:], trial.u
        ready = self._prepared(len(u), trial.dt)
        if trial.weight is not None:  # another problem, with the outputs as they count
            model = model_weighed(ready.model, trial)
            ready = dataclasses.replace(ready, model=model, solved=ready._solve(model, len(u)))
        step = ready._step_lifted(e, u) if self.form == "lifted" else ready._step_riccati(e, u)
        return Feedforward(limited(u + step, self.limit))

    def _prepared(self, N: int, dt: float) -> NormOptimal:
        if self.solved is not None:
            return self
        model = self.model.sampled(dt)
        return dataclasses.replace(self, model=model, solved=self._solve(model, N))

    def _weights(self) -> tuple[Array, ...]:
        return weights_of(self, "w_q", "w_r", "w_s")

    def _solve(self, model: StateSpace | TimeVaryingStateSpace, N: int) -> Factor | Lifted:
        Q, R, S = self._weights()
        if self.form == "lifted":
            H = _lifted(model, N)
            n_u, n_y = model.n_u, model.n_y
            QH = jnp.einsum("pq,kqm->kpm", Q, H.reshape(N, n_y, -1)).reshape(H.shape)
            return Lifted(
                H, cho_factor(H.T @ QH + jnp.kron(jnp.eye(N), jnp.reshape(R + S, (n_u, n_u))))[0]
            )

        def back(P: Array, now: Tree) -> tuple[Tree, Tree]:
            ((A, B, C),) = now
            Z = P + C.T @ Q @ C
            L = cholesky(B.T @ Z @ B + R + S)
            K = cholesky_solve(L, B.T @ Z @ A)
            P = A.T @ Z @ (A - B @ K)
            return (P + P.T) / 2, (K, L)

        start = jnp.zeros_like(model.A, shape=model.A.shape[-1:] * 2)
        return Factor(*scan(back, start, (model.A, model.B, model.C), N, reverse=True)[1])

    def _step_riccati(self, e: Array, u: Array) -> Array:
        """The change u_{j+1} - u_j of the input, as (N, n_u)."""
        Q, _, S = self._weights()
        q = jnp.concatenate([u @ S, -e @ Q], axis=1)
        return newton(_system(self.model), self.solved, q)[0]

    def _step_lifted(self, e: Array, u: Array) -> Array:
        (Q, _, S), solved = self._weights(), self.solved
        pull = solved.H.T @ (e @ Q).reshape(-1) - (u @ S).reshape(-1)
        return cho_solve((solved.factor, False), pull).reshape(u.shape)


def _system(model: StateSpace | TimeVaryingStateSpace) -> System:
    """The system from a change of the input to itself and to the change of the output."""
    A, B, C = (jnp.asarray(M) for M in (model.A, model.B, model.C))
    still, eye = jnp.zeros((model.n_u, A.shape[-1]), A.dtype), jnp.eye(model.n_u, dtype=A.dtype)
    return System(A, B, stacked([still, C @ A]), stacked([eye, C @ B]))


def _lifted(model: StateSpace | TimeVaryingStateSpace, N: int) -> Array:
    """The lifted matrix H (N n_y, N n_u) of a model: y[1..N] = H u[0..N-1]; block row k: y[k+1]."""
    n_u, n_y = model.n_u, model.n_y

    def forth(X: Array, now: Tree) -> tuple[Tree, Tree]:
        (A, B, C), k = now
        X = A @ X + lax.dynamic_update_slice_in_dim(jnp.zeros_like(X), B, k * n_u, axis=1)
        return X, C @ X

    start = jnp.zeros_like(model.A, shape=(model.A.shape[-1], N * n_u))
    rows = scan(forth, start, (model.A, model.B, model.C), N, jnp.arange(N))[1]
    return rows.reshape(N * n_y, N * n_u)
