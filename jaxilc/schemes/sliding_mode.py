"""Sliding mode control of a second-order servo, with a fixed and with an adaptive switching gain
(Xu 2024, section 3).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..pytree.fields import Leaf, leaf, pytree, static
from ..pytree.needs import known, need_channels
from ..signals.task import Sample, Task, Trial
from .scheme import Scheme, limited, need_square


class SlidingState(NamedTuple):
    """total: (n,) sum of e so far, without dt, so that linearised loops stay well scaled
    e, slope, r: (n,) error, its estimated rate and reference of the sample before;  r_before: (n,)
    r[k-2]
    sigma: (n,) sliding variable [y/s];  eta_hat: (n,) switching gain in force [y/s^2]"""

    total: jax.Array
    e: jax.Array
    slope: jax.Array
    r: jax.Array
    r_before: jax.Array
    sigma: jax.Array
    eta_hat: jax.Array


@pytree
class SMC(Scheme):
    """Integral sliding mode control with the nominal model y'' = -a1 y - a2 y' + b u (Xu 2024, eq.
    5 to 9), channel by channel.

        sigma = e' + lam1 e + lam2 int e,    e = y - r
        u = (a1 y + a2 y' + r'' - lam1 e' - lam2 e - eta sgn(sigma) - k_n sigma) / b

    e has the paper's sign, opposite to that of `Trial.e`. The model is given to the scheme and need
    not be that of the plant. Reference and position are taken at the sample (`centre` = "sample",
    as printed) or for the middle of the interval over which u[k] is held ("hold"), which takes out
    the half sample by which the input otherwise acts late; for a stiffness a1 that is a disturbance
    of a1 y' dt / 2:

        sample: r' = (r[k+1] - r[k-1]) / (2 dt),  r'' = (r[k+1] - 2 r[k] + r[k-1]) / dt^2,  y = y[k]
        hold:   r' = (r[k+1] - r[k]) / dt,  r'' = 3/2 of that now - 1/2 of that before,
                y = (r[k+1] + r[k]) / 2 + e + e' dt / 2

    e' is a `filtered_difference` of e with time constant tau, late by tau + dt / 2, and y' = r' +
    e': as the reference is known, only the velocity of the error is late. No observer on the
    nominal model: under `WithFeedback` it would not know the learned part of u. int e is dt
    sum_{i<=k} e[i]. Before the first sample e = 0, and the reference rests at its first value;
    after the trial it rests at its last. Where u would pass `limit`, the integral stops unless the
    error drives it back. sgn(0) = 0; the gradient through sgn is zero, that by eta is not.

    a1 [1/s^2], a2 [1/s], b [y/(u s^2)]: of the nominal model, b not 0
    eta: switching gain, above the disturbance [y/s^2];  k_n: reaching rate [1/s]
    lam1 [1/s], lam2 [1/s^2]: of sigma
    tau: time constant of the estimated velocity [s];  limit: largest |u|, None for none
    All are () or (n,). eta and k_n are not printed: the defaults suit the paper's servo, in um.
    The signals `sigma` and `eta_hat` of the trial record
    the sliding variable and the switching gain.
    Raises ValueError for b = 0, or a task with another number of inputs than outputs.
    """

    a1: Leaf = leaf()
    a2: Leaf = leaf()
    b: Leaf = leaf()
    eta: Leaf = leaf(default=2e6, interval="[0, inf)")
    k_n: Leaf = leaf(default=1000.0, interval="[0, inf)")
    lam1: Leaf = leaf(default=500.0, interval="(0, inf)")
    lam2: Leaf = leaf(default=0.3, interval="[0, inf)")
    tau: Leaf = leaf(default=0.0, interval="[0, inf)")
    limit: Leaf | None = leaf(default=None, interval="(0, inf)", optional=True)
    centre: str = static(default="sample", choices=("sample", "hold"))
    clips = ("limit",)

    def __post_init__(self):
        need_input_gain(self)

    def check(self, task: Task) -> None:
        need_square(self, task)
        need_channels(
            self, task.outputs, "a1", "a2", "b", "eta", "k_n", "lam1", "lam2", "tau", "limit"
        )

    def initial_state(self, task: Task) -> SlidingState:
        rest, r = jnp.zeros(task.outputs), jnp.asarray(task.reference[0])
        return SlidingState(rest, rest, rest, r, r, rest, self.eta + rest)

    def act(self, state: SlidingState, sample: Sample) -> tuple[Any, jax.Array]:
        e = sample.y - sample.r
        slope = filtered_difference(state.slope, e, state.e, self.tau, sample.dt)
        wanted = self._equivalent(e, slope, state, sample)
        total, eta_hat = state.total + e, self._start(state, sample)
        sigma = slope + self.lam1 * e + self.lam2 * sample.dt * total
        grown = self._adapted(eta_hat, e, sigma, sample.dt)
        u = self._input(wanted, sigma, grown)
        if self.limit is not None:
            beyond = jnp.abs(u) > self.limit
            total = jnp.where(beyond & (u * self.b * e < 0), state.total, total)
            sigma = slope + self.lam1 * e + self.lam2 * sample.dt * total
            grown = jnp.where(beyond, eta_hat, grown)
            u = limited(self._input(wanted, sigma, grown), self.limit)
        return SlidingState(total, e, slope, sample.r, state.r, sigma, grown), u

    def signals(self, state: SlidingState) -> dict[str, jax.Array]:
        return {"sigma": state.sigma, "eta_hat": state.eta_hat}

    def switching(self, sigma) -> jax.Array:
        """(n,) sgn(sigma), or what takes its place."""
        return jnp.sign(sigma)

    def _equivalent(self, e, slope, state: SlidingState, sample: Sample):
        """(n,) b u_eq (eq. 8) [y/s^2]"""
        r, following, dt = sample.r, sample.ahead[0], sample.dt
        acceleration = (following - 2 * r + state.r) / dt**2
        if self.centre == "sample":
            position, velocity = sample.y, (following - state.r) / (2 * dt)
        else:
            position, velocity = (following + r) / 2 + e + slope * dt / 2, (following - r) / dt
            acceleration = 1.5 * acceleration - 0.5 * (r - 2 * state.r + state.r_before) / dt**2
        return (
            self.a1 * position
            + self.a2 * (velocity + slope)
            + acceleration
            - self.lam1 * slope
            - self.lam2 * e
        )

    def _input(self, wanted, sigma, eta_hat):
        return (wanted - eta_hat * self.switching(sigma) - self.k_n * sigma) / self.b

    def _start(self, state: SlidingState, sample: Sample):
        """(n,) switching gain before it adapts."""
        return state.eta_hat

    def _adapted(self, eta_hat, e, sigma, dt):
        """(n,) switching gain for this sample."""
        return eta_hat


class Carried(NamedTuple):
    """eta_hat: (n,) with which the next trial starts"""

    eta_hat: jax.Array


class CarriedRows(NamedTuple):
    """eta_hat: (N, n) the gain to start with in its first row, then zero"""

    eta_hat: jax.Array


@pytree
class ASMC(SMC):
    """`SMC` with an adaptive switching gain, a dead zone and a boundary layer (Xu 2024, eq. 10 to
    13):

        eta_hat' = phi |sigma| while |e| > epsilon, else 0
        sgn(sigma) -> sat(sigma / Delta) = sigma / Delta for |sigma| <= Delta

    and sgn(sigma) beyond (eq. 13; the sentence below it has inside and outside the layer
    exchanged). So within the layer the loop is linear if phi = 0, with k_n + eta / Delta for k_n.
    eta_hat[k] = eta_hat[k-1] + dt phi |sigma[k]| acts at once. It never falls; where u would pass
    `limit` it waits, as a larger gain would change nothing. Sampled, the loop is stable about as
    long as lam1 + k_n + eta_hat / Delta < 2 / dt, less with a large lam1 tau; beyond, the
    oscillation feeds the adaptation, and eta_hat runs away. The gradient of sat by sigma is 1 /
    Delta within the layer and zero beyond; of the dead zone's switching by epsilon it is zero.

    eta: start value of eta_hat;  phi: rate of adaptation [1/s^2]
    epsilon: dead zone [y];  Delta: boundary layer > 0 [y/s]
    carry: whether a trial goes on with the eta_hat that the one before left. The paper's proof
        needs that it does not: only if each trial starts with the same eta_hat is w_{k+1} - w_k = 0
        under a repetitive disturbance (eq. 37).
    Raises ValueError as `SMC` does, and from `learn` for a trial without the signal eta_hat if it
    is to be carried.
    """

    eta: Leaf = leaf(default=0.0, interval="[0, inf)")
    phi: Leaf = leaf(default=1e5, interval="[0, inf)")
    epsilon: Leaf = leaf(default=0.2, interval="[0, inf)")
    Delta: Leaf = leaf(default=500.0, interval="(0, inf)")
    carry: bool = static(default=False, choices=(False, True))

    @property
    def learns(self) -> bool:
        return self.carry

    def check(self, task: Task) -> None:
        super().check(task)
        need_channels(self, task.outputs, "phi", "epsilon", "Delta")

    def initial_memory(self, task: Task) -> Any:
        return Carried(jnp.broadcast_to(self.eta, (task.outputs,))) if self.carry else ()

    def schedule(self, memory, task: Task) -> Any:
        return (
            CarriedRows(jnp.zeros((task.N, task.outputs)).at[0].set(memory.eta_hat))
            if self.carry
            else ()
        )

    def initial_state(self, task: Task) -> SlidingState:
        state = super().initial_state(task)
        return state._replace(eta_hat=jnp.zeros_like(state.eta_hat)) if self.carry else state

    def learn(self, memory, trial: Trial) -> Any:
        if not self.carry:
            return memory
        if "eta_hat" not in trial.signals:
            raise ValueError(
                "ASMC: the trial has no signal 'eta_hat' (N, n_u), so carry = True has nothing "
                "to go on from"
            )
        return Carried(trial.signals["eta_hat"][-1])

    def switching(self, sigma) -> jax.Array:
        return jnp.clip(sigma / self.Delta, -1.0, 1.0)

    def _start(self, state: SlidingState, sample: Sample):
        return state.eta_hat + sample.row.eta_hat if self.carry else state.eta_hat

    def _adapted(self, eta_hat, e, sigma, dt):
        return eta_hat + jnp.where(jnp.abs(e) > self.epsilon, dt * self.phi * jnp.abs(sigma), 0.0)


def need_input_gain(scheme) -> None:
    """Raises ValueError if the input gain b, by which the scheme divides, is zero."""
    if known(scheme) and np.any(np.asarray(scheme.b) == 0):
        raise ValueError(
            f"{type(scheme).__name__}: b = {scheme.b} is outside its allowed range: any number "
            "but 0"
        )


def filtered_difference(slope, x, x_last, tau, dt) -> jax.Array:
    """One step of the backward difference behind a first-order low-pass: d/dt -> s / (tau s + 1) at
    s = (1 - z^-1) / dt.

        slope' = (tau slope + x - x_last) / (tau + dt),    H(z) = (1 - z^-1) / (tau + dt - tau z^-1)

    Once settled, a ramp is estimated exactly; slow signals are late by tau + dt / 2; at a frequency
    w the amplitude is |H| / w = |sin(w dt / 2)| / (w dt / 2) / |1 + tau (1 - z^-1) / dt|. White
    noise of standard deviation q in x, as rounding to a resolution of sqrt(12) q is, becomes q
    sqrt(2 / ((tau + dt) (2 tau + dt))) in the slope.
    slope: (n,) of the sample before [x/s];  x, x_last: (n,) signal now and a sample before;  tau:
    () or (n,) >= 0 [s];  dt: [s]
    """
    return (tau * slope + x - x_last) / (tau + dt)
