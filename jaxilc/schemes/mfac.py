"""Model-free adaptive control (MFAC) along the time axis, and learning along the trials (MFAILC).

These schemes need no model. While they run, they estimate a pseudo gradient, that of the dynamic
linearisation: over a window of L_y output and L_u input increments between samples (Dai 2014) or
between trials (Cao 2019). The compact form CFDL has the window (0, 1), and its pseudo gradient is
the scalar pseudo partial derivative; the partial form PFDL has (0, L_u); the full form FFDL has
both. Several channels are controlled independently of each other.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp

from ..pytree.aliases import Array, Leaf, Tree
from ..pytree.fields import leaf, pytree, static
from ..pytree.needs import need_channels
from ..signals.rows import advance, by_row, delay, for_scan
from ..signals.task import Sample, Task, Trial
from .pid_type import need_lead
from .scheme import Scheme, limited, need_square

RESETS = ("book", "sign", "none", "smooth")


@jax.custom_jvp
def _quotient(a: Array, b: Array) -> Array:
    """The quotient q = a / b.

    Where it is differentiated, q = a (1 / b) and dq = (da - q db) (1 / b), with one division in
    place of three: a / b, and those by b and b^2. Then |b| may not be so large that 1 / b is no
    normal number: up to 4e307, in float32 8e37.
    """
    return a / b


@_quotient.defjvp
def _(at: tuple[Array, Array], by: tuple[Array, Array]) -> tuple[Array, Array]:
    inverse = 1.0 / at[1]
    q = at[0] * inverse
    return q, (by[0] - q * by[1]) * inverse


def reset_estimate(
    phi: list[Array], du: Tree, phi0: Leaf, *, component: int, epsilon: Leaf, mode: str
) -> list[Array]:
    """Reset the estimate to its start value phi0 where it is not usable (Dai 2014, eq. 12).

    Cao 2019 prints no reset rule. The mode is one of

        book      reset where |phi_c| <= epsilon, |du| <= epsilon, or sign phi_c != sign phi0_c
        sign      the same without the condition on |du|, which can cause bursts
        none      never reset
        smooth    the conditions of `book`, blended over widths of epsilon, for tuning

    phi_c is the component of u(k). In `book` and `sign` the gradient is that of the branch taken:
    it is zero through an estimate that was reset, and it does not include the switching itself.
    `smooth` has the whole gradient. With s(z) = 1 / (1 + e^-z) it returns

        phi0 + w (phi - phi0),      w = s(phi_c sign(phi0_c) / epsilon - 1) s(|du| / epsilon - 1)

    The smaller epsilon is, the closer is `smooth` to `book`, and the steeper it is: its slope is
    at most |phi - phi0| / (4 epsilon). The forecasts of CFDL-MFAPC have no condition on |du|; with
    `smooth` they are reset as by `sign`.

    phi, phi0: (...) each, components of the estimate and of its start value
    du: (...) input increment [unit of u]
    component: index of phi_c
    epsilon: () reset threshold
    """
    if mode == "none":
        return phi
    along = phi[component] * jnp.sign(phi0[component])
    if mode == "smooth":
        w = jax.nn.sigmoid(along / epsilon - 1.0) * jax.nn.sigmoid(jnp.abs(du) / epsilon - 1.0)
        return [p0 + w * (p - p0) for p, p0 in zip(phi, phi0, strict=True)]
    useless = ~(along > epsilon)  # the conditions on size and sign in one; it is true for NaN
    if mode == "book":
        useless = useless | (jnp.abs(du) <= epsilon)
    return [jnp.where(useless, p0, p) for p, p0 in zip(phi, phi0, strict=True)]


def estimated(
    scheme: Tree,
    phi: Sequence[Array],
    dh: Sequence[Array],
    dy: Array,
    phi0: Leaf,
    *,
    component: int,
    eta: Leaf,
) -> list[Array]:
    """One step of the pseudo-gradient estimator (Cao 2019, eq. 27), and its `reset_estimate`.

        phi' = phi + eta dh / (mu + |dh|^2) (dy - phi . dh)

    For a window of one it is eq. 13 of Cao 2019 and eq. 11 of Dai 2014.

    scheme: the scheme whose mu, epsilon and reset they are
    phi, phi0: (...) each, L components of the estimate and of its start value
    dh: (...) each, the L increments that these components multiply
    dy: (...) output increment that the increments dh caused
    component: index of the increment of u(k)
    eta: () step of the estimator
    """
    miss = dy - sum(p * h for p, h in zip(phi, dh, strict=True))
    step = _quotient(eta * miss, scheme.mu + sum(h * h for h in dh))
    moved = [p + step * h for p, h in zip(phi, dh, strict=True)]
    return reset_estimate(
        moved, dh[component], phi0, component=component, epsilon=scheme.epsilon, mode=scheme.reset
    )


def need_window(scheme: FFDLMFAC | FFDLMFAILC) -> None:
    """Raises ValueError unless phi0 and rho of a scheme fit its windows L_y and L_u."""
    window = scheme.L_y + scheme.L_u
    name, phi0, rho = type(scheme).__name__, scheme.phi0.shape, scheme.rho.shape
    if phi0 != (window,) and (phi0, window) != ((), 1):
        raise ValueError(
            f"{name}: phi0 has shape {phi0}; L_y = {scheme.L_y} and L_u = {scheme.L_u} need "
            f"({window},)"
        )
    if rho not in ((), (window,)):
        raise ValueError(f"{name}: rho has shape {rho}; allowed are () and ({window},)")


class State(NamedTuple):
    """The state of `FFDLMFAC`, all values as they were one sample ago.

    u, y: (n,) input [unit of u] and output [unit of y]
    seen: () 0 at the first sample of a trial, else 1
    dy: (n,) each, the L_y output increments, newest first [unit of y]
    du: (n,) each, the L_u input increments, newest first [unit of u]
    phi: (n,) each, the L_y+L_u components of the estimate
    """

    u: Array
    y: Array
    seen: Array
    dy: tuple[Array, ...]
    du: tuple[Array, ...]
    phi: tuple[Array, ...]


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

    def __post_init__(self) -> None:
        need_window(self)

    def check(self, task: Task) -> None:
        need_square(self, task)
        need_channels(self, task.inputs, "lam", "eta", "mu", "epsilon", "limit")

    def initial_state(self, task: Task) -> State:
        rest = jnp.zeros(task.inputs)
        phi = tuple(jnp.broadcast_to(p, rest.shape) for p in jnp.atleast_1d(self.phi0))
        return State(rest, rest, jnp.zeros(()), (rest,) * self.L_y, (rest,) * self.L_u, phi)

    def act(self, state: State, sample: Sample) -> tuple[State, Array]:
        dy_now = state.seen * (sample.y - state.y)
        phi0, c = jnp.atleast_1d(self.phi0), self.L_y
        dh = state.dy + state.du
        phi = estimated(self, state.phi, dh, dy_now, phi0, component=c, eta=self.eta)
        dy = (dy_now, *state.dy)[:c]
        rho = jnp.broadcast_to(self.rho, (c + self.L_u,))
        held = sum(rho[i] * phi[i] * dy[i] for i in range(c)) + sum(
            rho[c + i] * phi[c + i] * state.du[i - 1] for i in range(1, self.L_u)
        )
        miss = rho[c] * (sample.ahead[0] - sample.y) - held
        u = limited(state.u + _quotient(phi[c], self.lam + phi[c] ** 2) * miss, self.limit)
        du = (u - state.u, *state.du)[: self.L_u]
        return State(u, sample.y, jnp.ones_like(state.seen), dy, du, tuple(phi)), u

    def signals(self, state: State) -> dict[str, Array]:
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

    u: Array
    y: Array
    du: Array
    phi: Array
    theta: Array


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

    def __post_init__(self) -> None:
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
        weights = ("lam", "eta", "mu", "phi0", "epsilon", "delta", "theta_limit", "limit")
        need_channels(self, task.inputs, *weights)

    def initial_state(self, task: Task) -> PredictiveState:
        rest = jnp.zeros(task.inputs)
        shape = (self.n_p, task.inputs)
        phi, theta = jnp.broadcast_to(self.phi0, shape), jnp.broadcast_to(self._theta0(), shape)
        return PredictiveState(rest, rest, rest, phi, theta)

    def act(self, state: PredictiveState, sample: Sample) -> tuple[PredictiveState, Array]:
        was, dy = [state.phi[0]], sample.y - state.y
        (phi_now,) = estimated(self, was, [state.du], dy, [self.phi0], component=0, eta=self.eta)
        theta = self._forecaster(state, phi_now)
        phi = jnp.concatenate([phi_now[None], state.phi[:-1]])
        u = limited(
            state.u + self._first_move(self._future(phi, theta), self._wanted(sample)), self.limit
        )
        return PredictiveState(u, sample.y, u - state.u, phi, theta), u

    def signals(self, state: PredictiveState) -> dict[str, Array]:
        return {"phi": state.phi[0]}

    def _theta0(self) -> Array:
        start = jnp.eye(self.n_p)[0] if self.theta0 is None else jnp.asarray(self.theta0)
        return start[:, None]

    def _forecaster(self, state: PredictiveState, phi_now: Array) -> Array:
        """The coefficients theta(k) of eq. 13, 14; the regressor is phi(k-1), ..., phi(k-n_p)."""
        miss = phi_now - jnp.sum(state.phi * state.theta, axis=0)
        theta = state.theta + state.phi * miss / (self.delta + jnp.sum(state.phi**2, axis=0))
        return jnp.where(
            jnp.sqrt(jnp.sum(theta**2, axis=0)) >= self.theta_limit, self._theta0(), theta
        )

    def _future(self, phi: Array, theta: Array) -> list[Array]:
        """The forecasts phi(k), ..., phi(k+P_u-1) of eq. 15 and 16, each (n,)."""
        mode = "none" if self.reset == "none" else "sign"
        past = [phi[i] for i in range(self.n_p)]
        future = past[:1]
        for _ in range(self.P_u - 1):
            ahead: Tree = sum(theta[i] * past[i] for i in range(self.n_p))
            (ahead,) = reset_estimate(
                [ahead], None, [self.phi0], component=0, epsilon=self.epsilon, mode=mode
            )
            past = [ahead, *past[:-1]]
            future.append(ahead)
        return future

    def _wanted(self, sample: Sample) -> Array:
        """The product A^T (Y* - E y) without its factor phi, as (P_u, n).

        Row i is the sum of r(k+1+p) - y(k) over p = i..P-1.
        """
        if self.reference == "constant":
            return (self.P - jnp.arange(self.P_u))[:, None] * (sample.ahead[0] - sample.y)
        miss = sample.ahead - sample.y
        return jnp.cumsum(miss[::-1], axis=0)[::-1][: self.P_u]

    def _first_move(self, future: list[Array], wanted: Array) -> Array:
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


class Memory(NamedTuple):
    """The memory of MFAILC after trial j.

    u: (N, n) input of trial j [unit of u]
    y: (N+1, n) output of trial j; before the first trial the reference, as if without an error, so
        that `KeepUnmeasured` learns nothing where nothing was measured yet [unit of y]
    phi: (N, n) each, L_y+L_u components of the estimate for the next trial
    seen: () 0 before the first trial, else 1
    """

    u: Array
    y: Array
    phi: tuple[Array, ...]
    seen: Array


class Schedule(NamedTuple):
    """The rows that FFDL-MFAILC sees within a trial.

    u: (N, n) the part of the law that is known before the trial [unit of u]
    y: (N, n) output of trial j-1 [unit of y]
    u_last: (N, n) input of trial j-1 [unit of u]
    weights: (N, n) each, the L_y+L_u-1 weights of the increments D y(k..k-L_y+1, j) and
        D u(k-1..k-L_u+1, j) of the running trial
    """

    u: Array
    y: Array
    u_last: Array
    weights: tuple[Array, ...]


class Window(NamedTuple):
    """The increments of the running trial that MFAILC keeps, newest first.

    dy: (n,) each, L_y-1 increments of the output [unit of y]
    du: (n,) each, L_u-1 increments of the input [unit of u]
    u_last: (n,) input that was applied in trial j-1 at the sample before [unit of u]
    The increments are tuples of arrays, because to shift one array in a loop over samples costs a
    copy.
    """

    dy: tuple[Array, ...]
    du: tuple[Array, ...]
    u_last: Array


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
    elementwise = True

    def __post_init__(self) -> None:
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
        phi = tuple(jnp.broadcast_to(p, (N, n)) for p in jnp.atleast_1d(self.phi0))
        return Memory(jnp.zeros((N, n)), jnp.asarray(task.reference, float), phi, jnp.zeros(()))

    def learn(self, memory: Memory, trial: Trial) -> Memory:
        du, dy = trial.u - memory.u, trial.y - memory.y
        outputs = [delay(dy[:-1], i) for i in range(self.L_y)]
        inputs = [delay(du, i) for i in range(self.L_u)]
        rows = memory.phi, outputs + inputs, advance(dy, 1 + self.lead)
        phi = _estimated((self, memory.seen * self.eta), *rows)
        if self.lead:
            phi = [
                jnp.concatenate([new[: -self.lead], old[-self.lead :]])
                for new, old in zip(phi, memory.phi, strict=True)
            ]
        return Memory(trial.u, trial.y, tuple(phi), jnp.ones_like(memory.seen))

    def schedule(self, memory: Memory, task: Task) -> Schedule:
        e = advance(task.reference - memory.y, 1 + self.lead)
        u, weights = _law((self, memory.seen * self.rho), memory.phi, memory.u, e)
        return Schedule(u, memory.y[:-1], memory.u, weights)

    def initial_state(self, task: Task) -> Window:
        rest = jnp.zeros(task.inputs)
        return Window((rest,) * max(self.L_y - 1, 0), (rest,) * (self.L_u - 1), rest)

    def act(self, state: Window, sample: Sample) -> tuple[Window, Array]:
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
def _estimated(
    of: tuple[FFDLMFAILC, Array], phi: Sequence[Array], increments: Sequence[Array], dy: Array
) -> list[Array]:
    """The estimate for the next trial.

    of: the scheme, and the step of its estimator: 0 after the first trial, whose increments tell
        nothing
    """
    scheme, eta = of
    phi0 = jnp.atleast_1d(scheme.phi0)
    return estimated(scheme, phi, increments, dy, phi0, component=scheme.L_y, eta=eta)


@by_row
def _law(
    of: tuple[FFDLMFAILC, Array], phi: Sequence[Array], u: Array, e: Array
) -> tuple[Array, tuple[Array, ...]]:
    """The part of the law that is known before the trial, and the weights of increments.

    of: the scheme, and its step factors: 0 in the first trial, so that nothing is added to u
    """
    scheme, rho = of
    c = scheme.L_y
    gain = _quotient(phi[c], scheme.lam + phi[c] ** 2)
    if len(phi) > 1:  # each weight uses it: laid out once, not once for each
        gain = for_scan(gain)
    gains = [gain * r for r in rho] if rho.ndim else [gain * rho] * len(phi)
    weights = tuple(gains[i] * p for i, p in enumerate(phi) if i != c)
    u = u + gains[c] * e
    # with weights, `act` first adds the increments of the running trial
    return (u if weights else limited(u, scheme.limit)), weights


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
