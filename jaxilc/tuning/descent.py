"""Descent on a loss of few numbers that is dear to evaluate: coordinates, steps of the optimisers,
and their state.

Nothing here knows what is tuned. An `evaluate(z)` gives an `Evaluation`; a method has `init(z)` and
`step(z, state)`, both pure.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import lax

HAIR = 1e-6  # of the unit interval: how near a value may come to an end of its range
FAR = 60.0  # on the real line, beyond which exponentials stay
NUDGE = 1e-3  # of its range: by how much a start on an end of it is moved inside


@dataclasses.dataclass(frozen=True)
class Bijection:
    """A smooth map of the real line onto an open interval, with s(z) = 1 / (1 + e^-z):

    (-inf, inf)  scale z            (a, inf)  a + e^z            (-inf, b)  b - e^z
    (a, b)  a + (b - a) s(z)        of one sign  a (b / a)^s(z), so that its orders of magnitude
    count alike
    """

    low: float
    high: float
    scale: float = 1.0

    def __call__(self, z):
        low, high = self.low, self.high
        if np.isinf(low) and np.isinf(high):
            return self.scale * z
        if np.isinf(high) or np.isinf(low):
            end, sign = (low, 1.0) if np.isinf(high) else (high, -1.0)
            return end + sign * jnp.exp(jnp.clip(z, np.log(HAIR * abs(end)) if end else -FAR, FAR))
        share = HAIR + (1.0 - 2.0 * HAIR) * jax.nn.sigmoid(z)
        return low * (high / low) ** share if low * high > 0 else low + (high - low) * share

    def inverse(self, value: float) -> float:
        low, high = self.low, self.high
        if np.isinf(low) and np.isinf(high):
            return value / self.scale
        if np.isinf(high):
            return float(np.log(value - low))
        if np.isinf(low):
            return float(np.log(high - value))
        share = (
            np.log(value / low) / np.log(high / low)
            if low * high > 0
            else (value - low) / (high - low)
        )
        share = (share - HAIR) / (1.0 - 2.0 * HAIR)
        return float(np.log(share / (1.0 - share)))

    def inside(self, value: float) -> float:
        """The value, moved inside if it lies on an end."""
        width = self.high - self.low if np.isfinite(self.high - self.low) else 1.0
        if value <= self.low + 10 * HAIR * width:
            # the end 0 of a range that has no other is approached by exponents, and needs no room
            return value if value > self.low and np.isinf(self.high) else self.low + NUDGE * width
        return self.high - NUDGE * width if value >= self.high - 10 * HAIR * width else value


class Evaluation(NamedTuple):
    """value: () what is minimised;  gradient: (P,);  residuals: (R,) for least squares;  slopes:
    (R, P) of them;  dropped: () left out
    """

    value: jax.Array
    gradient: jax.Array
    residuals: jax.Array
    slopes: jax.Array
    dropped: jax.Array


def value_and_slope(f: Callable, z, *, forward: bool):
    """f(z) and its (P,) gradient, by P tangents at once or by one pass backwards."""
    if forward:
        return jax.vmap(lambda tangent: jax.jvp(f, (z,), (tangent,)), out_axes=(None, 0))(
            jnp.eye(z.size, dtype=z.dtype)
        )
    return jax.value_and_grad(f)(z)


def counted(losses):
    """Losses of which those that are not finite count as the worst finite one; all infinite if
    there is none.
    """
    finite = jnp.isfinite(losses)
    worst = jnp.max(jnp.where(finite, losses, -jnp.inf))
    return jnp.where(finite, losses, jnp.where(jnp.any(finite), worst, jnp.inf))


def repaired(losses, slopes, clip: float):
    """Losses and slopes that can be averaged, and which slopes were finite: (S,), (S, P), (S,).

    A loss that is not finite is `counted`, a slope that is not counts as none; no slope is longer
    than `clip` times the median length, or than `clip` where that is below 1, as it is once most
    plants are below an objective's floor. A chattering plant may have a slope
    of 1e70 that points anywhere: so it has one voice among the others, and no absolute bound would
    know their size.
    """
    good = jnp.isfinite(losses) & jnp.all(jnp.isfinite(slopes), axis=1)
    slopes = jnp.where(good[:, None], slopes, 0.0)
    largest = jnp.max(jnp.abs(slopes), axis=1)
    length = largest * jnp.linalg.norm(
        slopes / jnp.where(largest > 0, largest, 1.0)[:, None], axis=1
    )
    median = jnp.sort(jnp.where(good, length, jnp.inf))[(jnp.sum(good) - 1) // 2]
    longest = clip * jnp.maximum(1.0, median)
    return (
        counted(losses),
        slopes * jnp.minimum(1.0, longest / jnp.where(length > 0, length, 1.0))[:, None],
        good,
    )


class Method(NamedTuple):
    """init(z) -> state;  step(z, state) -> (z, state, Step). Pure, for one start. programs: both,
    compiled for many starts
    """

    init: Callable[[Any], Any]
    step: Callable[[Any, Any], tuple[Any, Any, Step]]
    programs: tuple[Any, ...] = ()


class Step(NamedTuple):
    """What is recorded of a step, at the z it started from. loss: ();  slope: () length of the
    gradient;  dropped: ()
    """

    loss: jax.Array
    slope: jax.Array
    dropped: jax.Array


def by_gradient(
    evaluate: Callable[[Any], Evaluation], optimiser: optax.GradientTransformation
) -> Method:
    """Any optax transformation. A line search sees the loss with the gradient that `evaluate` gives
    it.
    """
    optimiser = optax.with_extra_args_support(optimiser)

    @jax.custom_vjp
    def loss(z):
        return evaluate(z).value

    def forward(z):
        found = evaluate(z)
        return found.value, found.gradient

    loss.defvjp(forward, lambda gradient, cotangent: (cotangent * gradient,))

    def step(z, state):
        found = evaluate(z)
        updates, state = optimiser.update(
            found.gradient, state, z, value=found.value, grad=found.gradient, value_fn=loss
        )
        return (
            optax.apply_updates(z, updates),
            state,
            Step(found.value, jnp.linalg.norm(found.gradient), found.dropped),
        )

    return Method(optimiser.init, step)


class Damped(NamedTuple):
    """damping: ();  at: the evaluation at z"""

    damping: jax.Array
    at: Evaluation


def by_least_squares(evaluate: Callable[[Any], Evaluation], damping: float = 1e-2) -> Method:
    """Levenberg-Marquardt on the residuals r with Jacobian J (Marquardt 1963), the step taken only
    if |r| falls:

    (J^T J + damping diag(J^T J)) dz = -J^T r,      damping / 3 after a success, * 4 after a failure
    """

    def init(z):
        return Damped(jnp.full((), damping, z.dtype), evaluate(z))

    def step(z, state):
        r, J = state.at.residuals, state.at.slopes
        normal = J.T @ J
        ridge = state.damping * jnp.diag(normal) + jnp.finfo(z.dtype).tiny ** 0.5
        moved = z - jnp.linalg.solve(normal + jnp.diag(ridge), J.T @ r)
        there = evaluate(moved)
        better = jnp.sum(there.residuals**2) < jnp.sum(r**2)
        at = jax.tree.map(lambda new, old: jnp.where(better, new, old), there, state.at)
        state_after = Damped(jnp.where(better, state.damping / 3.0, state.damping * 4.0), at)
        return (
            jnp.where(better, moved, z),
            state_after,
            Step(state.at.value, jnp.linalg.norm(state.at.gradient), state.at.dropped),
        )

    return Method(init, step)


def for_starts(method: Method) -> Method:
    """The method for many starts at once, compiled, from NumPy to NumPy; one program serves all
    steps.
    """

    @jax.jit
    def step(z, state):
        moved, following, record = jax.vmap(method.step)(z, state)
        return (
            moved,
            jax.tree.map(
                lambda new, old: lax.convert_element_type(new, old.dtype), following, state
            ),
            record,
        )

    # brought home each time: where an array lies belongs to a compiled program too
    init = jax.jit(jax.vmap(method.init))
    programs = (init, step)
    return Method(
        lambda z: jax.device_get(init(z)), lambda z, state: jax.device_get(step(z, state)), programs
    )


def arguments_like(method: Method, z) -> tuple[Any, Any]:
    """What the compiled step of a method `for_starts` takes, by its shapes: z (K, P) and the state;
    nothing is computed.
    """
    state = jax.eval_shape(method.programs[0], z)
    return z, jax.tree.map(lambda s: jax.ShapeDtypeStruct(s.shape, s.dtype), state)


class State(NamedTuple):
    """A descent after `step` steps from K starts: all that is needed to go on.

    z: (K, P);  inner: of the method;  best_z: (P,), best: (), best_step: () by the held-out loss;
    stale: () looks since then
    loss, slope, dropped: (steps, K);  path: (steps, K, P) z of each step;  held_out: (steps + 1,
    K), NaN where not looked at
    """

    step: np.ndarray
    z: np.ndarray
    inner: Any
    best_z: np.ndarray
    best: np.ndarray
    best_step: np.ndarray
    stale: np.ndarray
    loss: np.ndarray
    slope: np.ndarray
    dropped: np.ndarray
    path: np.ndarray
    held_out: np.ndarray

    @classmethod
    def start(cls, z, inner, steps: int) -> State:
        (K, P), dtype = z.shape, z.dtype
        blank = [np.full((steps, K), np.nan, dtype) for _ in range(3)]
        none = np.asarray(0)
        return cls(
            none, z, inner, z[0], np.asarray(np.inf, dtype), none, none, *blank,
            np.full((steps, K, P), np.nan, dtype), np.full((steps + 1, K), np.nan, dtype),
        )  # fmt: skip

    def validated(self, losses) -> State:
        """With the (K,) held-out losses of its z; what is not finite is never best."""
        losses = np.asarray(losses)
        self.held_out[int(self.step)] = losses
        k = int(np.argmin(np.where(np.isfinite(losses), losses, np.inf)))
        if not losses[k] < self.best:
            return self._replace(stale=self.stale + 1)
        return self._replace(
            best_z=self.z[k], best=losses[k], best_step=self.step, stale=np.zeros_like(self.stale)
        )

    def advanced(self, z, inner, record: Step) -> State:
        step = int(self.step)
        for kept, value in zip(
            (self.loss, self.slope, self.dropped, self.path), (*record, self.z), strict=True
        ):
            kept[step] = value
        return self._replace(step=self.step + 1, z=z, inner=inner)
