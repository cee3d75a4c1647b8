"""Learning of the parameters of basis functions, by a model or from any law, and their fit."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.lax import linalg

from ..plants import Plant
from ..pytree.aliases import Array, Function, Leaf, Value
from ..pytree.fields import child, leaf, pytree, static
from ..pytree.needs import need_channels, need_numbers
from ..signals.task import Task, Trial
from .bases import Basis, pushed
from .compose import need_feedforward
from .gradient import Ready, answers, need_answers, varies
from .guards import Guard
from .quadratic_cost import largest_eigenvalue, need_weights, weights_of
from .scheme import Feedforward, Memory, Schedule, Scheme, Wrapper, limited, need_no_experiments
from .weights import answers_weighed

ROUNDING = 100.0  # in units of the last place, of a scaled Gram matrix


class Parameters(NamedTuple):
    """What `BasisFunctions` knows: theta (m,), the weights of the basis functions."""

    theta: Array


@pytree
class BasisFunctions(Scheme):
    """Learning in the space of basis functions (van de Wijdeven and Bosgra 2010), u = Psi(r) theta.

    `norm_optimal`: the parameters minimise the cost of the next trial, as the model H predicts it,

        |e_j - H (Psi theta - u_j)|^2_Wq + |Psi theta - u_j|^2_Wr + |Psi theta|^2_Ws

    and of that minimum a `step` is taken, theta_{j+1} = theta_j + step (minimum - theta_j). Here
    theta_j is that of the input which was played.
    `gradient`: they go down the slope of the same cost, in parameters that are scaled so that its
    curvature has the diagonal 1,

        theta_{j+1} = theta_j + step Psi' (H' W_q e_j - W_s u_j) / h

    where h is the largest eigenvalue of this curvature, so 0 < step < 2.

    Only theta is learned and kept, so that `learn(..., memory=...)` goes on with another reference,
    also of another length. What the functions cannot make is left as an error. With a
    `RationalBasis` theta follows from `iterations` weighted regressions in each trial.

    model: nominal plant of n_u inputs and n_y outputs, linear or not, as for `GradientILC`
    start: (m,) parameters of the first trial; None: zero
    update: "norm_optimal" or "gradient"
    step: () in (0, 2)
    w_q: () or (n_y,) or (n_y, n_y); w_r, w_s: () or (n_u,) or (n_u, n_u); positive semidefinite
    limit: () or (n_u,) largest |u| that is played [unit of u]; None: no limit
    iterations: number of regressions of a trial with a `RationalBasis`
    solved: leave None
    Differentiable in the weights, the model, and the parameters of the basis.
    `check` raises ValueError where basis, model, start and task do not fit.
    """

    basis: Basis = child()
    model: Plant = child()
    start: Leaf | None = leaf(default=None, optional=True)
    step: Leaf = leaf(default=1.0, interval="(0, 2)")
    w_q: Leaf = leaf(default=1.0)
    w_r: Leaf = leaf(default=0.0)
    w_s: Leaf = leaf(default=0.0)
    limit: Leaf | None = leaf(default=None, interval="(0, inf)", optional=True)
    update: str = static(default="norm_optimal", choices=("norm_optimal", "gradient"))
    iterations: int = static(default=5, interval="[1, 100]", whole=True)
    solved: Ready | None = child(default=None)
    weighs = True
    clips = ("limit",)
    of_one_length = True

    def __post_init__(self) -> None:
        need_numbers(self, "step")
        need_weights(self, "w_q", "w_r", "w_s")

    def check(self, task: Task) -> None:
        self.basis.check(task)
        need_answers(self, task)
        need_channels(self, task.inputs, "limit")
        need_parameters(self, "start", self.start, self.basis, task)

    def initial_memory(self, task: Task) -> Parameters:
        if self.start is not None:
            return Parameters(jnp.asarray(self.start))
        return Parameters(jnp.zeros(len(self.basis.names(task.outputs, task.inputs))))

    def prepared(self, task: Task) -> BasisFunctions:
        if self.solved is not None:
            return self
        return dataclasses.replace(
            self,
            model=self.model.sampled(task.dt),
            solved=Ready(None if varies(self.model, task.N, task.dt) else 0.0, dt=task.dt),
        )

    def schedule(self, memory: Parameters, task: Task) -> Feedforward:
        return Feedforward(limited(input_of(self.basis, memory.theta, task), self.limit))

    def learn(self, memory: Parameters, trial: Trial) -> Parameters:
        dt = trial.dt if self.solved is None else self.solved.dt
        linear = self.solved is not None and self.solved.curvature is not None
        # A linear model answers alike at any input, so a diverged one has no part in it.
        push, pull = answers(self.model, jnp.zeros_like(trial.u) if linear else trial.u, dt)
        push, pull = answers_weighed(push, pull, trial)
        theta = memory.theta
        if self.basis.linear:  # what was played, also where it was limited
            start = theta if self.basis.keeps else None
            theta = fitted(self.basis, trial.u, trial.r, dt, theta=start)
        of = self._gradient if self.update == "gradient" else self._norm_optimal
        return Parameters(of(theta, trial, push, pull, dt))

    def started(self, memory: Parameters, u: Array, task: Task) -> Parameters:
        """The memory with the parameters that come nearest to an input u (N, n_u)."""
        r = jnp.asarray(task.reference)
        return Parameters(fitted(self.basis, u, r, task.dt, iterations=self.iterations))

    def _norm_optimal(
        self, theta: Array, trial: Trial, push: Function, pull: Function, dt: float
    ) -> Array:
        u, inputs = trial.u, trial.u.shape[1]
        Q, R, S = weights_of(self, "w_q", "w_r", "w_s")

        def same(u: Array) -> Array:
            return u

        # what the input of the next trial is to come near, as a signal, and its weight
        wanted = ((trial.e[1:] + push(u), push, Q), (u, same, R), (jnp.zeros_like(u), same, S))
        best = theta
        for _ in range(1 if self.basis.linear else self.iterations):
            G: Leaf = 0.0
            g: Leaf = 0.0
            for target, of, W in wanted:
                t, X = self.basis.regression(best, target, of, trial.r, dt, inputs)
                G, g = G + jnp.einsum("kim,ij,kjn->mn", X, W, X), g + _seen(X, t @ W)
            best = best + _told(self.basis, G, g - G @ best, trial.r, dt, inputs)
        return theta + self.step * (best - theta)

    def _gradient(
        self, theta: Array, trial: Trial, push: Function, pull: Function, dt: float
    ) -> Array:
        Q, R, S = weights_of(self, "w_q", "w_r", "w_s")

        def signal(theta: Array) -> Array:
            return self.basis.signal(theta, trial.r, dt, trial.u.shape[1])

        columns = jax.jacfwd(signal)(theta)
        X = pushed(push, columns)
        G = jnp.einsum("kim,ij,kjn->mn", X, Q, X)
        G += jnp.einsum("kim,ij,kjn->mn", columns, R + S, columns)
        down = _seen(columns, pull(trial.e[1:] @ Q) - trial.u @ S)
        told = self.basis.seen(trial.r, dt, trial.u.shape[1])
        G = G * jnp.outer(told, told)
        scale = _scale(G)
        h = largest_eigenvalue(lambda v: (G * jnp.outer(scale, scale)) @ v, theta)
        return theta + self.step * scale**2 * down / jnp.where(h > 0, h, 1.0)


def input_of(basis: Basis, theta: Array, task: Task) -> Array:
    """(N, n_u) the input that the parameters theta (m,) make for the reference of a task."""
    return basis.signal(theta, jnp.asarray(task.reference), task.dt, task.inputs)


def fitted(
    basis: Basis, u: Array, r: Array, dt: float, *, theta: Array | None = None, iterations: int = 5
) -> Array:
    """(m,) the parameters with which the basis comes nearest to an input u (N, n_u), or (N,).

        theta = argmin |Psi(r) theta - u|^2

    u: learned or measured input, from which theta is to be taken over to other references
    r: (N+1, n_y) or (N+1,) the reference of u; the output of that trial may stand in its place,
        which makes theta a fit of the inverse of the machine
    theta: (m,) parameters from which a `RationalBasis` starts, and that stay where u tells nothing
        of them, as of a place that r does not visit; None: zero
    iterations: number of regressions with a `RationalBasis`; of another basis there is one

    The function is pure. Raises ValueError where the lengths of u and r do not fit.
    """
    u, r = (x[:, None] if x.ndim == 1 else x for x in (jnp.asarray(u), jnp.asarray(r)))
    if len(r) != len(u) + 1:
        raise ValueError(
            f"fitted: u {u.shape} and r {r.shape} do not fit; allowed are (N, n_u) and (N+1, n_y)"
        )
    inputs = u.shape[1]
    if theta is None:
        theta = jnp.zeros(len(basis.names(r.shape[1], inputs)), u.dtype)
    for _ in range(1 if basis.linear else iterations):
        t, X = basis.regression(theta, u, lambda u: u, r, dt, inputs)
        G = jnp.einsum("kim,kin->mn", X, X)
        if basis.linear:  # where columns make each other, what u does not tell is not to stay
            told = (jnp.diag(G) > 0) & (basis.seen(r, dt, inputs) > 0)
            theta = jnp.where(told, 0.0, theta)
        theta = theta + _told(basis, G, _seen(X, t) - G @ theta, r, dt, inputs)
    return theta


def _told(basis: Basis, G: Array, g: Array, r: Array, dt: float, inputs: int) -> Array:
    """G^-1 g of the functions that a trial sees, and 0 for the others, whose parameters stay.

    G (m, m) is positive semidefinite, and scaled, for columns of any units. A column that is zero,
    or that others make, gets the least parameter.
    """
    told = basis.seen(r, dt, inputs)
    G, g = G * jnp.outer(told, told), g * told
    scale = _scale(G)
    least = ROUNDING * len(g) * jnp.finfo(G.dtype).eps
    scaled, of_all = G * jnp.outer(scale, scale), scale * g
    # Where columns make others, the elements of an inverse are 1e12, and what is left of their sums
    # is rounding: only substitution tells what all columns make together. Theory sees through it.
    LU, _, order = linalg.lu(scaled + least * jnp.eye(len(g), dtype=G.dtype))

    def solved(b: Array) -> Array:
        below = linalg.triangular_solve(
            LU, b[order][:, None], left_side=True, lower=True, unit_diagonal=True
        )
        return linalg.triangular_solve(LU, below, left_side=True)[:, 0]

    found = solved(of_all)
    return scale * (found + solved(of_all - scaled @ found))  # without what `least` kept back


def need_parameters(owner: Scheme, name: str, theta: Leaf, basis: Basis, task: Task) -> None:
    """Raises ValueError unless theta, if given, has one number for each function of the basis."""
    names = basis.names(task.outputs, task.inputs)
    if theta is not None and theta.shape != (len(names),):
        raise ValueError(
            f"{type(owner).__name__}: {name} has shape {theta.shape}; allowed is ({len(names)},), "
            f"for {', '.join(names)}"
        )


def _scale(G: Array) -> Array:
    """(m,) the factors with which the diagonal of G is 1."""
    diagonal = jnp.diag(G)
    return jnp.where(diagonal > 0, 1 / jnp.sqrt(jnp.where(diagonal > 0, diagonal, 1.0)), 0.0)


def _seen(X: Array, signal: Array) -> Array:
    """(m,) the sums of the products of the columns X (K, n, m) and a signal (K, n)."""
    return jnp.einsum("kim,ki->m", X, signal)


class OnBasisMemory(NamedTuple):
    """The memory of `OnBasis`.

    theta: (m,) parameters of the input
    """

    scheme: Memory
    theta: Array


@pytree
class OnBasis(Guard):
    """Any law that learns an input, within the space of basis functions.

        theta_{j+1} = argmin |Psi(r_j) theta - u|^2,    u: what the law has learned after trial j
        u_{j+1} = Psi(r_{j+1}) theta_{j+1}

    The law learns sample by sample, and the fit keeps of it what the functions can make, so it
    needs no model of its own. A reference that changes takes the parameters with it; to a trial of
    another length `WarmStart` takes them.

    scheme: a scheme whose schedule has a field `u`, which it learns from the input of the last
        trial; if it has a `limit`, the input is also limited
    iterations: number of regressions with a `RationalBasis`
    solved: leave None
    """

    scheme: Scheme = child()
    basis: Basis = child()
    iterations: int = static(default=5, interval="[1, 100]", whole=True)
    solved: Ready | None = child(default=None)
    of_one_length = True
    limits_again = "fitted"

    def frozen(self) -> Scheme:
        return Scheme.frozen(self)

    def check(self, task: Task) -> None:
        super().check(task)
        need_no_experiments(self, task, "whose inputs are no sums of the basis functions")
        need_feedforward(self, self.scheme, task)
        self.basis.check(task)

    def initial_memory(self, task: Task) -> OnBasisMemory:
        theta = jnp.zeros(len(self.basis.names(task.outputs, task.inputs)))
        return OnBasisMemory(self.scheme.initial_memory(task), theta)

    def prepared(self, task: Task) -> OnBasis:
        return dataclasses.replace(super().prepared(task), solved=Ready(dt=task.dt))

    def learn(self, memory: OnBasisMemory, trial: Trial) -> OnBasisMemory:
        dt = trial.dt if self.solved is None else self.solved.dt
        following = self.scheme.learn(memory.scheme, self.shown(trial)["scheme"])
        u = self.scheme.schedule(following, Task(trial.r, dt=dt, inputs=trial.u.shape[1])).u
        start = memory.theta if self.basis.keeps or not self.basis.linear else None
        theta = fitted(self.basis, u, trial.r, dt, theta=start, iterations=self.iterations)
        return OnBasisMemory(following, theta)

    def schedule(self, memory: OnBasisMemory, task: Task) -> Schedule:
        u = limited(input_of(self.basis, memory.theta, task), self.limit)
        return self.scheme.play(u, memory.scheme, task)

    def feedforward(self, memory: OnBasisMemory, task: Task) -> Array:
        return self.schedule(memory, task).u

    def started(self, memory: OnBasisMemory, u: Array, task: Task) -> OnBasisMemory:
        """The memory with the parameters that come nearest to an input u (N, n_u)."""
        r = jnp.asarray(task.reference)
        return memory._replace(theta=fitted(self.basis, u, r, task.dt, iterations=self.iterations))


def started(scheme: Scheme, memory: Memory, u: Value, task: Task) -> Memory:
    """The memory of a scheme with u (N, n_u) as its learned input, and all else as it was.

    A scheme that keeps more than its input says what this means by a method `started(memory, u,
    task)`. Of a composed scheme it is the part that learns an input.
    Raises ValueError for a scheme that learns no input, and for an input of another shape.
    """
    own = getattr(scheme, "started", None)
    if own is not None:
        return own(memory, u, task)
    if hasattr(memory, "u") and not isinstance(scheme, Wrapper):
        if jnp.shape(u) != jnp.shape(memory.u):
            raise ValueError(
                f"started: u has shape {jnp.shape(u)}; {type(scheme).__name__} learns "
                f"{jnp.shape(memory.u)}"
            )
        return memory._replace(u=jnp.asarray(u))
    for name, (part, seen, known) in scheme.parts(task, memory).items():
        if not part.learns:
            continue
        found = started(part, known, u, seen)
        return found if known is memory else memory._replace(**{name: found})
    raise ValueError(f"started: {type(scheme).__name__} learns no input that it could start from")


@pytree
class WarmStart(Wrapper):
    """A scheme whose first trial plays Psi(r) theta in place of nothing.

    theta is known from other references, by `fitted` or from the memory of `BasisFunctions`. From
    there the scheme learns as ever, also what the basis cannot make. Where the law has a `limit`,
    it is also that of the first trial.

    scheme: any scheme that learns an input
    theta: (m,) its parameters
    """

    scheme: Scheme = child()
    basis: Basis = child()
    theta: Leaf = leaf()

    def check(self, task: Task) -> None:
        super().check(task)
        self.basis.check(task)
        need_parameters(self, "theta", self.theta, self.basis, task)
        self.initial_memory(task)  # raises for a scheme that learns no input

    def initial_memory(self, task: Task) -> Memory:
        u = input_of(self.basis, jnp.asarray(self.theta), task)
        return started(self.scheme, super().initial_memory(task), limited(u, self.limit), task)
