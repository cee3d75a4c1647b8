"""Systems of python-control and of scipy.signal as plants.

python-control is imported where one of its systems is used only, since that takes longer than many
a command: it imports Matplotlib.
"""

from __future__ import annotations

import dataclasses
import math
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jax import lax

from ..pytree.aliases import Array, Function, Leaf, Numbers, Tree, Value
from ..pytree.fields import child, leaf, pytree, static
from ..pytree.ranges import as_numbers, brief
from .integration import runge_kutta
from .linear import LARGEST_ORDER, StateSpace, matching
from .plant import Plant
from .structure import followers

BALANCED = 8  # order above which the states of a polynomial are scaled
TINY = 1e-14  # first coefficient of a numerator, below which SciPy warns that it may be rounding


class Linear(NamedTuple):
    """The matrices of a linear system, and its sample time [s], 0 for continuous time."""

    A: Numbers
    B: Numbers
    C: Numbers
    D: Numbers
    dt: float


def from_control(
    system: Value, *, allow_unstable: bool = False, x0: Value = None, substep: float | None = None
) -> StateSpace | NonlinearSystem:
    """A plant from a system of python-control or of scipy.signal, with one or several channels.

    system: `control.StateSpace`, `control.TransferFunction` or `control.nlsys`; or `lti`, `dlti`,
            `StateSpace`, `TransferFunction` or `ZerosPolesGain` of scipy.signal
    allow_unstable: whether an unstable linear system is taken, because the scheme stabilises it
    x0:     (n,) initial state; None is rest
    substep: longest step [s] of the integrator of a nonlinear system in continuous time, the
            classical Runge-Kutta method of order 4; needed there, and there only

    A linear system in continuous time is sampled with a zero-order hold at the task's sample time;
    a discrete system keeps its own sample time, which must be the task's. A transfer function of
    several channels becomes one realisation per entry, side by side: not minimal, but exact.
    The functions of a nonlinear system must be ones that JAX can trace, so they compute with
    jax.numpy; its numeric parameters become the leaves `parameters.NAME`.

    Raises ValueError for another kind of system, a polynomial of an order above 1000, an improper
    one, direct feedthrough, an unspecified sample time, an unstable linear system (unless
    `allow_unstable`), and a nonlinear system whose functions JAX cannot trace.
    """
    import control

    if type(system).__module__.startswith("scipy.signal"):
        system = _of_scipy(system)
    linear = isinstance(system, control.StateSpace | control.TransferFunction)
    if not linear and not isinstance(system, control.NonlinearIOSystem):
        raise ValueError(
            f"from_control: {type(system).__name__} is not a control.StateSpace or "
            "control.TransferFunction, a control.nlsys, or a linear system of scipy.signal"
        )
    if system.dt is None or system.dt is True:
        raise ValueError(
            f"from_control: dt = {system.dt} leaves the sample time open; allowed are 0 "
            "(continuous) and a time in s"
        )
    if not linear:
        return _nonlinear(system, x0, substep)
    if substep is not None:
        raise ValueError("from_control: substep is for a nonlinear system; this one is linear")
    A, B, C, D = system_matrices(system)
    return from_linear(Linear(A, B, C, D, system.dt), allow_unstable, x0)


Matrices: TypeAlias = tuple[Numbers, Numbers, Numbers, Numbers]  # A, B, C, D


def from_linear(system: Linear, allow_unstable: bool = False, x0: Value = None) -> StateSpace:
    """A plant from matrices, with the arguments and the errors of `from_control`."""
    A, B, C, D, dt = system
    if np.any(D):
        raise ValueError(
            f"from_control: direct feedthrough D = {D.tolist()}; u[k] acts on y[k+1] at the "
            "earliest, so D must be 0: make the system strictly proper, or delay it by a sample"
        )
    if not allow_unstable:
        _need_stable(A, dt == 0)
    return StateSpace(A, B, C, x0, dt=float(dt))


def canonical_form(num: Leaf, den: Leaf, dt: float) -> Linear | None:
    """The controllable canonical form of a strictly proper transfer function of one channel.

        x' = [[-a1, ..., -an], [I, 0]] x + [1, 0, ...] u,    y = [b1, ..., bn] x

    It is that of `control.tf2ss`, but for the scale of the states where the order is above 8: the
    coefficients of 20 poles reach 1e49 /s^20, and the exponential of such a matrix overflows. The
    result is None for a transfer function of another kind, and
    for one whose coefficients python-control warns of.

    num, den: coefficients of descending powers; bi and ai are these divided by the first of den
    """
    num, den = (np.trim_zeros(np.asarray(of, float), "f") for of in (num, den))
    _need_order(den)
    if not 0 < len(num) < len(den) or not abs(num[0] / den[0]) > TINY:
        return None
    n = len(den) - 1
    A, B, C = np.eye(n, k=-1), np.eye(n, 1), np.zeros((1, n))
    A[0], C[0, n - len(num) :] = -den[1:] / den[0], num / den[0]
    A, B, C = _balanced(A, B, C)
    return Linear(A, B, C, np.zeros((1, 1)), dt)


def _balanced(A: Numbers, B: Numbers, C: Numbers) -> tuple[Numbers, Numbers, Numbers]:
    """The matrices of a polynomial with each state divided by a power of two: no digit is lost."""
    if len(A) <= BALANCED:
        return A, B, C
    with np.errstate(invalid="ignore"):  # SciPy makes integers of the scales, and uses none of them
        balanced, scale = scipy.linalg.matrix_balance(A, permute=False)
    return balanced, B / np.diag(scale)[:, None], C * np.diag(scale)


def _of_scipy(system: Value) -> Value:
    """A linear system of scipy.signal as a `control.StateSpace`."""
    import control
    from scipy.signal import dlti, lti

    if not isinstance(system, lti | dlti):
        return system
    _need_order(np.asarray(getattr(system, "den", ())))
    try:
        found = system.to_ss()
    except ValueError as error:
        raise ValueError(f"from_control: the system is improper or not valid: {error}") from None
    dt = 0 if isinstance(system, lti) else system.dt
    return control.ss(found.A, found.B, found.C, found.D, dt, remove_useless_states=False)


def _need_order(den: Numbers) -> None:
    """Raises ValueError for a denominator whose matrices would fill the memory."""
    order = np.shape(den)[-1] - 1
    if order > LARGEST_ORDER:
        raise ValueError(
            f"from_control: den has {order + 1} coefficients, of order {order}; allowed is an "
            f"order of at most {LARGEST_ORDER}"
        )


def _need_stable(A: Numbers, continuous: bool) -> None:
    if not A.size:
        return
    poles, left, right = scipy.linalg.eig(A, left=True)
    beyond = poles.real if continuous else np.abs(poles) - 1.0
    worst = np.argmax(beyond)
    growth = beyond[worst]
    if growth > 1e-7:
        where = "right of the imaginary axis" if continuous else "outside the unit circle"
        alone = np.abs(np.vdot(left[:, worst], right[:, worst]))  # 1 for orthogonal eigenvectors
        with np.errstate(over="ignore"):  # coefficients beyond 1e154
            doubt = np.finfo(float).eps * np.linalg.norm(A) / max(alone, np.finfo(float).tiny)
        lost = (
            f". Rounding its {len(A)} coefficients alone moves this pole as far: give zeros, poles "
            "and gain instead"
        )
        raise ValueError(
            f"from_control: the system is unstable (a pole {growth:.3g} {where}); close a loop "
            f"first or pass allow_unstable=True{lost if doubt > growth else ''}"
        )


def system_matrices(system: Value) -> Matrices:
    """A, B, C, D of a python-control system. Raises ValueError for an improper one."""
    import control

    if isinstance(system, control.StateSpace):
        return system.A, system.B, system.C, system.D
    blocks: list[Matrices] = []
    for i in range(system.noutputs):
        for j in range(system.ninputs):
            num, den = np.atleast_1d(system.num[i][j]), np.atleast_1d(system.den[i][j])
            _need_order(den)
            if len(np.trim_zeros(num, "f")) > len(np.trim_zeros(den, "f")):
                raise ValueError(
                    f"from_control: entry ({i}, {j}) is improper (numerator of higher order than "
                    "the denominator)"
                )
            block = control.tf2ss(num, den)
            blocks.append((*_balanced(block.A, block.B, block.C), block.D))
    A, B, C, D = (scipy.linalg.block_diag(*of) for of in zip(*blocks, strict=True))
    # of each block, its input and its output in the system
    inputs = np.tile(np.eye(system.ninputs), (system.noutputs, 1))
    outputs = np.repeat(np.eye(system.noutputs), system.ninputs, axis=1)
    return A, B @ inputs, outputs @ C, outputs @ D @ inputs


# Nonlinear systems
# --------------------------------------------------------------------------------------------------


class TimedState(NamedTuple):
    """The number k of the sample (), the time t = k dt () [s] and the state x (n,)."""

    k: Array
    t: Array
    x: Array

    @property
    def time(self) -> Array:
        """() t, which is 0 at the start of each trial, whatever state that starts with [s]."""
        return jnp.where(self.k > 0, self.t, jnp.zeros_like(self.t))


@pytree
class NonlinearSystem(Plant):
    """A system that is given by two functions, as `control.nlsys` takes them.

        continuous:  dx/dt  = update(t, x, u, parameters),  y = read(t, x, parameters)
        discrete:    x[k+1] = update(t, x, u, parameters),  y = read(t, x, parameters)

    A continuous system is integrated by the classical Runge-Kutta method of order 4 under an input
    that is held over the sample, in ceil(dt / substep) equal steps a sample.

    parameters: numbers by name; each is a leaf, so that it can be drawn, tuned and differentiated
    x0:         (n,) initial state
    update:     function (t, x, u, parameters) -> (n,), which JAX can trace
    read:       function (t, x, parameters) -> (n_y,), which JAX can trace
    n_in, n_out: number of inputs and of outputs
    timed:      whether the functions depend on the time t, which is 0 at the start of each trial
    dt:         sample time of a discrete system [s]; 0 for a continuous one
    substep:    longest step of the integrator [s]; 0 for a discrete system
    """

    parameters: Tree = child()
    x0: Leaf = leaf()
    update: Function = static()
    read: Function = static()
    n_in: int = static(interval="[1, inf)", whole=True)
    n_out: int = static(interval="[1, inf)", whole=True)
    timed: bool = static(default=False)
    dt: float = static(default=0.0, interval="[0, inf)")
    substep: float = static(default=0.0, interval="[0, inf)")

    @property
    def n_u(self) -> int:
        return self.n_in

    @property
    def n_y(self) -> int:
        return self.n_out

    def sampled(self, dt: float) -> NonlinearSystem:
        return matching(self, dt) if self.dt else self

    def initial_state(self) -> Tree:
        x = jnp.asarray(self.x0)
        return TimedState(jnp.zeros((), int), jnp.zeros((), x.dtype), x) if self.timed else x

    def step(self, x: Tree, u: Array, dt: float) -> Tree:
        if self.timed:
            k = x.k + 1
            return TimedState(k, (k * dt).astype(x.t.dtype), self._next(x.time, x.x, u, dt))
        return self._next(jnp.zeros((), x.dtype), x, u, dt)

    def output(self, x: Tree) -> Array:
        t, x = (x.time, x.x) if self.timed else (jnp.zeros((), x.dtype), x)
        return _vector(self.read(t, x, self.parameters), x.dtype)

    def _next(self, t: Array, x: Tree, u: Array, dt: float) -> Array:
        if self.dt:
            return _vector(self.update(t, x, u, self.parameters), x.dtype)
        steps = max(math.ceil(dt / self.substep - 1e-9), 1)

        def rates(now: Tree) -> tuple[Tree, Tree]:
            t, x = now
            return jnp.ones_like(t), _vector(self.update(t, x, u, self.parameters), x.dtype)

        def one(_: object, now: Tree) -> Array:
            return runge_kutta(rates, now, dt / steps)

        return lax.fori_loop(0, steps, one, (t, x))[1]


def _nonlinear(system: Value, x0: Array, substep: float | None) -> NonlinearSystem:
    """The plant of a `control.NonlinearIOSystem`; raises as `from_control`."""
    if system.dt and substep is not None:
        raise ValueError("from_control: substep is for a continuous system; this one is discrete")
    if not system.dt and (substep is None or not substep > 0):
        raise ValueError(
            f"from_control: substep = {substep} for a nonlinear system in continuous time; give "
            "the longest step of the integrator (Runge-Kutta of order 4) in s, above 0"
        )
    n, n_u, n_y = system.nstates, system.ninputs, system.noutputs
    updfcn, outfcn = system.updfcn, system.outfcn
    plant = NonlinearSystem(
        {name: _number(name, value) for name, value in (system.params or {}).items()},
        np.zeros(n) if x0 is None else x0,
        updfcn,
        _the_state
        if outfcn is None
        else lambda t, x, parameters: outfcn(t, x, jnp.zeros(n_u, x.dtype), parameters),
        n_in=n_u,
        n_out=n_y,
        dt=float(system.dt),
        substep=float(substep or 0.0),
    )
    if plant.x0.shape != (n,):
        raise ValueError(f"from_control: x0 has shape {plant.x0.shape}; allowed is ({n},)")

    def update(parameters: Value, now: Tree) -> Array:
        return _vector(updfcn(*now, parameters))

    def read(parameters: Value, now: Tree) -> Array:
        return _vector(now[1] if outfcn is None else outfcn(*now, parameters))

    now = jnp.zeros(()), jnp.asarray(plant.x0), jnp.zeros(n_u)
    update_timed, *_ = _followed("update", update, plant.parameters, now, (n,))
    read_timed, _, fed_through = _followed("output", read, plant.parameters, now, (n_y,))
    if fed_through:
        raise ValueError(
            "from_control: the output function uses u, a direct feedthrough; u[k] acts on y[k+1] "
            "at the earliest, so it may use t, x and the parameters only"
        )
    return dataclasses.replace(plant, timed=update_timed or read_timed)


def _vector(values: Value, dtype: Value = None) -> Array:
    """What a function of the system returns, a list of numbers or an array, as one array."""
    return jnp.asarray(values, dtype)


def _the_state(t: Array, x: Tree, parameters: Value) -> Array:
    return x


def _number(name: str, value: Value) -> Array:
    found = as_numbers(value)
    if found is None:
        raise ValueError(
            f"from_control: the parameter {name} = {brief(value)} is not a number or an array of "
            "numbers"
        )
    return jnp.asarray(found, float)


def _followed(
    what: str, f: Function, parameters: Value, now: Tree, shape: tuple[int, ...]
) -> list[bool]:
    """Whether the value of f depends on each of now = (t, x, u).

    Raises ValueError unless JAX can trace f and it returns an array of that shape.
    """
    try:
        found = jax.eval_shape(f, parameters, now).shape
    except Exception as error:  # whatever a user's function raises when it is given tracers
        raise ValueError(
            f"from_control: JAX cannot trace the {what} function ({type(error).__name__}); write "
            "it with jax.numpy in place of numpy or math, and without `if` on t, x or u"
        ) from error
    if found != shape:
        raise ValueError(
            f"from_control: the {what} function returns the shape {found}; allowed is {shape}"
        )
    return [any(of) for of in followers(f, parameters, now)]
