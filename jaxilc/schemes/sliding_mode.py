"""Sliding mode control with a fixed or an adaptive switching gain (Xu 2024, section 3)."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from ..pytree.aliases import Array, Leaf, Tree, Value
from ..pytree.fields import leaf, pytree, static
from ..pytree.needs import known, need_channels
from ..signals.task import Sample, Task, Trial
from .scheme import Scheme, limited, need_square


class SlidingState(NamedTuple):
    """The state of `SMC`, and of `ASMC`.

    total: (n,) sum of e so far [y]; it does not contain dt, so that linearised loops are well
        scaled
    e: (n,) error of the sample before [y]
    slope: (n,) estimated rate of that error [y/s]
    r: (n,) reference of the sample before [y]
    r_before: (n,) reference one sample earlier still, r[k-2] [y]
    sigma: (n,) sliding variable [y/s]
    eta_hat: (n,) present switching gain [y/s^2]
    """

    total: Array
    e: Array
    slope: Array
    r: Array
    r_before: Array
    sigma: Array
    eta_hat: Array


@pytree
class SMC(Scheme):
    """Integral sliding mode control of a second-order servo (Xu 2024, eq. 5 to 9).

        y'' = -a1 y - a2 y' + b u,    e = y - r,    sigma = e' + lam1 e + lam2 int e
        u = (a1 y + a2 y' + r'' - lam1 e' - lam2 e - eta sgn(sigma) - k_n sigma) / b

    Each channel has its own loop. e has the sign of the paper, opposite to that of `Trial.e`. The
    nominal model is given to the scheme and may differ from the plant. Reference and position are
    those at the sample (`centre` = "sample", as printed) or those in the middle of the interval
    over which u[k] is held ("hold"). "hold" removes the delay of half a sample with which the input
    otherwise acts; for a stiffness a1 this delay is a disturbance of a1 y' dt / 2:

        sample: r' = (r[k+1] - r[k-1]) / (2 dt),  r'' = (r[k+1] - 2 r[k] + r[k-1]) / dt^2,  y = y[k]
        hold:   r' = (r[k+1] - r[k]) / dt,  r'' = 3/2 of that now - 1/2 of that before,
                y = (r[k+1] + r[k]) / 2 + e + e' dt / 2

    e' is the `filtered_difference` of e with time constant tau, which has a delay of tau + dt / 2,
    and y' = r' + e'. Since the reference is known, only the velocity of the error is delayed. There
    is no observer with the nominal model, because under `WithFeedback` it would not know the
    learned part of u. int e is dt sum_{i<=k} e[i]. Before the first sample e = 0, and the reference
    has its first value; after the trial it has its last value. Where u would exceed `limit`, the
    integration stops unless the error drives u back. sgn(0) = 0. The gradient through sgn is zero;
    the gradient with respect to eta is not.

    a1: stiffness of the nominal model [1/s^2]
    a2: damping of the nominal model [1/s]
    b: input gain of the nominal model, not 0 [y/(u s^2)]
    eta: switching gain, larger than the disturbance [y/s^2]
    k_n: reaching rate [1/s]
    lam1, lam2: weights of sigma [1/s], [1/s^2]
    tau: time constant of the estimated velocity [s]
    limit: largest |u| [unit of u]; None: no limit
    centre: `sample` or `hold`, see above
    All but `centre` are () or (n,). The paper does not print eta and k_n; the defaults suit the
    servo of the paper with y in um.
    The signals `sigma` and `eta_hat` of the trial record the sliding variable and switching gain.
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

    def __post_init__(self) -> None:
        need_input_gain(self)

    def check(self, task: Task) -> None:
        need_square(self, task)
        need_channels(
            self, task.outputs, "a1", "a2", "b", "eta", "k_n", "lam1", "lam2", "tau", "limit"
        )

    def initial_state(self, task: Task) -> SlidingState:
        rest, r = jnp.zeros(task.outputs), jnp.asarray(task.reference[0])
        return SlidingState(rest, rest, rest, r, r, rest, self.eta + rest)

    def act(self, state: SlidingState, sample: Sample) -> tuple[SlidingState, Array]:
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

    def signals(self, state: SlidingState) -> dict[str, Array]:
        return {"sigma": state.sigma, "eta_hat": state.eta_hat}

    def switching(self, sigma: Leaf) -> Array:
        """The switching function of sigma, as (n,): sgn(sigma) unless a subclass overrides it."""
        return jnp.sign(sigma)

    def _equivalent(self, e: Array, slope: Array, state: SlidingState, sample: Sample) -> Array:
        """The equivalent control b u_eq (eq. 8), as (n,) [y/s^2]."""
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

    def _input(self, wanted: Value, sigma: Array, eta_hat: Array) -> Array:
        return (wanted - eta_hat * self.switching(sigma) - self.k_n * sigma) / self.b

    def _start(self, state: SlidingState, sample: Sample) -> Array:
        """The switching gain (n,) before it adapts."""
        return state.eta_hat

    def _adapted(self, eta_hat: Array, e: Array, sigma: Array, dt: float) -> Array:
        """The switching gain (n,) for this sample."""
        return eta_hat


class Carried(NamedTuple):
    """What `ASMC` with `carry` knows: eta_hat (n,), with which the next trial starts.

    In its schedule eta_hat (N, n) is this gain in row 0, then zero.
    """

    eta_hat: Array


@pytree
class ASMC(SMC):
    """`SMC` with adaptive switching gain, dead zone and boundary layer (Xu 2024, eq. 10 to 13).

        eta_hat' = phi |sigma| while |e| > epsilon, else 0
        sgn(sigma) -> sat(sigma / Delta) = sigma / Delta for |sigma| <= Delta, else sgn(sigma)

    The sentence below eq. 13 has inside and outside of the layer exchanged. If phi = 0, the loop is
    linear within the layer, with k_n + eta / Delta in place of k_n. The gain
    eta_hat[k] = eta_hat[k-1] + dt phi |sigma[k]| acts at the same sample. It never decreases. Where
    u would exceed `limit` it does not change, as a larger gain would have no effect. The sampled
    loop is stable approximately for lam1 + k_n + eta_hat / Delta < 2 / dt; with a large lam1 tau
    the bound is lower. Above it, the oscillation drives the adaptation, and eta_hat grows without
    bound. The gradient of sat with respect to sigma is 1 / Delta within the layer and zero outside;
    the gradient of the switching of the dead zone with respect to epsilon is zero.

    eta: () or (n,) start value of eta_hat [y/s^2]
    phi: () or (n,) rate of adaptation [1/s^2]
    epsilon: () or (n,) dead zone [y]
    Delta: () or (n,) boundary layer > 0 [y/s]
    carry: whether a trial starts with the last eta_hat of the trial before. The proof in the paper
        requires that it does not: w_{k+1} - w_k = 0 under a repetitive disturbance (eq. 37) only
        if each trial starts with the same eta_hat.
    Raises ValueError as `SMC` does. With `carry`, `learn` raises it for a trial without the signal
    eta_hat.
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

    def initial_memory(self, task: Task) -> Tree:
        return Carried(jnp.broadcast_to(self.eta, (task.outputs,))) if self.carry else ()

    def schedule(self, memory: Tree, task: Task) -> Tree:
        if not self.carry:
            return ()
        return Carried(jnp.zeros((task.N, task.outputs)).at[0].set(memory.eta_hat))

    def initial_state(self, task: Task) -> SlidingState:
        state = super().initial_state(task)
        return state._replace(eta_hat=jnp.zeros_like(state.eta_hat)) if self.carry else state

    def learn(self, memory: Tree, trial: Trial) -> Tree:
        if not self.carry:
            return memory
        if "eta_hat" not in trial.signals:
            raise ValueError(
                "ASMC: the trial has no signal 'eta_hat' (N, n_u), so carry = True has nothing "
                "to go on from"
            )
        return Carried(trial.signals["eta_hat"][-1])

    def switching(self, sigma: Leaf) -> Array:
        return jnp.clip(sigma / self.Delta, -1.0, 1.0)

    def _start(self, state: SlidingState, sample: Sample) -> Array:
        if not self.carry:
            return state.eta_hat
        start = sample.row.eta_hat  # which a machine that carries its state has in its state, too
        return jnp.where(start > 0, start, state.eta_hat + start)

    def _adapted(self, eta_hat: Array, e: Array, sigma: Array, dt: float) -> Array:
        return eta_hat + jnp.where(jnp.abs(e) > self.epsilon, dt * self.phi * jnp.abs(sigma), 0.0)


def need_input_gain(scheme: Tree) -> None:
    """Raises ValueError if the input gain b, by which the scheme divides, is zero."""
    if known(scheme) and np.any(np.asarray(scheme.b) == 0):
        raise ValueError(
            f"{type(scheme).__name__}: b = {scheme.b} is outside its allowed range: any number "
            "but 0"
        )


def filtered_difference(slope: Array, x: Array, x_last: Array, tau: Array, dt: float) -> Array:
    """One step of the backward difference with a first-order low-pass filter.

        slope' = (tau slope + x - x_last) / (tau + dt),    H(z) = (1 - z^-1) / (tau + dt - tau z^-1)

    This is s / (tau s + 1) with s = (1 - z^-1) / dt. In the steady state the slope of a ramp is
    exact. Slow signals have a delay of tau + dt / 2. At a frequency w the relative amplitude is
    |H| / w = |sin(w dt / 2)| / (w dt / 2) / |1 + tau (1 - z^-1) / dt|. White noise of standard
    deviation q in x, such as rounding to a resolution of sqrt(12) q, becomes noise of standard
    deviation q sqrt(2 / ((tau + dt) (2 tau + dt))) in the slope.

    slope: (n,) slope at the sample before [x/s]
    x: (n,) signal now [x]
    x_last: (n,) signal at the sample before [x]
    tau: () or (n,) >= 0, time constant [s]
    dt: () sample time [s]
    """
    return (tau * slope + x - x_last) / (tau + dt)
