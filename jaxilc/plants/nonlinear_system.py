"""A nonlinear system of python-control (`control.nlsys`) as a plant."""

from __future__ import annotations

import dataclasses
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from ..pytree.aliases import Array, Function, Leaf, Tree, Value
from ..pytree.fields import child, leaf, pytree, static
from ..pytree.ranges import as_numbers, brief
from .integration import runge_kutta
from .linear import matching
from .plant import Plant
from .structure import followers


class TimedState(NamedTuple):
    """The number k of the sample (), the time t = k dt () [s] and the state x (n,)."""

    k: Array
    t: Array
    x: Array


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
            return TimedState(k, (k * dt).astype(x.t.dtype), self._next(x.t, x.x, u, dt))
        return self._next(jnp.zeros((), x.dtype), x, u, dt)

    def output(self, x: Tree) -> Array:
        t, x = (x.t, x.x) if self.timed else (jnp.zeros((), x.dtype), x)
        return vector(self.read(t, x, self.parameters), x.dtype)

    def _next(self, t: Array, x: Tree, u: Array, dt: float) -> Array:
        if self.dt:
            return vector(self.update(t, x, u, self.parameters), x.dtype)
        steps = max(math.ceil(dt / self.substep - 1e-9), 1)

        def rates(now: Tree) -> tuple[Tree, Tree]:
            t, x = now
            return jnp.ones_like(t), vector(self.update(t, x, u, self.parameters), x.dtype)

        def one(_: object, now: Tree) -> Array:
            return runge_kutta(rates, now, dt / steps)

        return lax.fori_loop(0, steps, one, (t, x))[1]


def nonlinear_system(system: Value, x0: Array, substep: float | None) -> NonlinearSystem:
    """The plant of a `control.NonlinearIOSystem`; see `plants.from_control`.

    x0:      (n,) initial state; None is rest
    substep: longest step of the integrator of a continuous system [s]

    Its messages speak in the name of `from_control`. Raises ValueError for a function that JAX
    cannot trace or that returns another shape than the system states, for an output that depends on
    the input of the same sample, for parameters that are not numbers, and for a `substep` that is
    missing or has no use.
    """
    n, n_u, n_y = system.nstates, system.ninputs, system.noutputs
    _check_substep(bool(system.dt), substep)
    parameters = {name: _number(name, value) for name, value in (system.params or {}).items()}
    plant = NonlinearSystem(
        parameters,
        np.zeros(n) if x0 is None else x0,
        system.updfcn,
        _reading(system, n_u),
        n_in=n_u,
        n_out=n_y,
        dt=float(system.dt),
        substep=float(substep or 0.0),
    )
    if plant.x0.shape != (n,):
        raise ValueError(f"from_control: x0 has shape {plant.x0.shape}; allowed is ({n},)")

    def update(parameters: Value, given: Value) -> Array:
        return vector(system.updfcn(given["t"], given["x"], given["u"], parameters))

    def read(parameters: Value, given: Value) -> Array:
        x, outfcn = given["x"], system.outfcn
        return vector(x if outfcn is None else outfcn(given["t"], x, given["u"], parameters))

    given = {"t": jnp.zeros(()), "x": jnp.asarray(plant.x0), "u": jnp.zeros(n_u)}
    _traced("update", update, parameters, given, (n,))
    _traced("output", read, parameters, given, (n_y,))
    if _depends(read, parameters, given, "u"):
        raise ValueError(
            "from_control: the output function uses u, a direct feedthrough; u[k] acts on y[k+1] "
            "at the earliest, so it may use t, x and the parameters only"
        )
    timed = any(_depends(f, parameters, given, "t") for f in (update, read))
    return dataclasses.replace(plant, timed=timed)


def vector(values: Value, dtype: Value = None) -> Array:
    """What a function of the system returns, a list of numbers or an array, as one array."""
    return jnp.asarray(values, dtype)


def _reading(system: Value, n_u: int) -> Function:
    """The output as a function of (t, x, parameters); it is the state where none is given."""
    outfcn = system.outfcn
    if outfcn is None:
        return _the_state
    return lambda t, x, parameters: outfcn(t, x, jnp.zeros(n_u, x.dtype), parameters)


def _the_state(t: Array, x: Tree, parameters: Value) -> Array:
    return x


def _check_substep(discrete: bool, substep: float | None) -> None:
    if discrete and substep is not None:
        raise ValueError("from_control: substep is for a continuous system; this one is discrete")
    if not discrete and (substep is None or not substep > 0):
        raise ValueError(
            f"from_control: substep = {substep} for a nonlinear system in continuous time; give "
            "the longest step of the integrator (Runge-Kutta of order 4) in s, above 0"
        )


def _number(name: str, value: Value) -> Array:
    found = as_numbers(value)
    if found is None:
        raise ValueError(
            f"from_control: the parameter {name} = {brief(value)} is not a number or an array of "
            "numbers"
        )
    return jnp.asarray(found, float)


def _traced(
    what: str, f: Function, parameters: Value, given: Value, shape: tuple[int, ...]
) -> None:
    """Raises ValueError unless JAX can trace f and it returns an array of that shape."""
    try:
        found = jax.eval_shape(f, parameters, given).shape
    except Exception as error:  # whatever a user's function raises when it is given tracers
        raise ValueError(
            f"from_control: JAX cannot trace the {what} function ({type(error).__name__}); write "
            "it with jax.numpy in place of numpy or math, and without `if` on t, x or u"
        ) from error
    if found != shape:
        raise ValueError(
            f"from_control: the {what} function returns the shape {found}; allowed is {shape}"
        )


def _depends(f: Function, parameters: Value, given: dict[str, Tree], name: str) -> bool:
    """Whether the value of f depends on the argument of that name."""

    def of_one(fixed: Tree, value: Value) -> Array:
        parameters, others = fixed
        return f(parameters, others | {name: value})

    return bool(np.any(followers(of_one, (parameters, given), given[name])))
