"""Basis functions: inputs that follow from a reference by a few parameters.

    u = Psi(r) theta

A law that learns theta in place of the samples of u serves references that it has not seen.
"""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from ..pytree.fields import Leaf, child, leaf, need_decorated, pytree, static
from ..pytree.needs import known
from ..signals.task import Task

ORDERS = ("position", "velocity", "acceleration", "jerk", "snap")
MARGIN = 4  # samples beyond each end, which the differences of the highest order need


class Basis:
    """Functions of a reference, of which an input is a sum with the parameters theta as weights.

    A user's own basis is a subclass, decorated with `@pytree`, that overrides `columns` and
    `names`. Its fields are parameters of the basis, which may be tuned by gradient.

    linear: whether u is linear in theta
    """

    # `@pytree` makes a dataclass of each subclass
    __dataclass_fields__: ClassVar[dict[str, dataclasses.Field]]
    linear: ClassVar[bool] = True

    def __init__(self, *values: Any, **named: Any):
        need_decorated(type(self))

    def names(self, outputs: int, inputs: int) -> tuple[str, ...]:
        """(m) the names of the parameters theta."""
        raise NotImplementedError

    def columns(self, r, dt: float, inputs: int) -> jax.Array:
        """(N, inputs, m) the functions Psi of a reference r (N+1, n_y), of which each is an input.

        dt: sample time [s]
        """
        raise NotImplementedError

    def signal(self, theta, r, dt: float, inputs: int) -> jax.Array:
        """(N, inputs) the input Psi(r) theta of the parameters theta (m,)."""
        return self.columns(r, dt, inputs) @ theta

    def regression(self, theta, t, push, r, dt: float, inputs: int) -> tuple[jax.Array, jax.Array]:
        """(K, n) the target, and (K, n, m) the columns whose sum is to come near it.

        theta: (m,) parameters so far, of which only a basis that is not linear in theta makes use
        t: (K, n) signal that `push` of the input is to come near
        push: linear map from an input (N, inputs) to a signal (K, n)
        """
        return t, pushed(push, self.columns(r, dt, inputs))

    def check(self, task: Task) -> None:
        """Raises ValueError where the basis does not fit the task."""


def pushed(push, columns) -> jax.Array:
    """(K, n, m) a linear map of each of the columns (N, inputs, m)."""
    return jax.vmap(push, in_axes=-1, out_axes=-1)(columns)


@pytree
class PolynomialBasis(Basis):
    """The reference and its derivatives (Lambrechts, Boerlage and Steinbuch 2005).

        u = theta_1 r' + theta_2 r'' + theta_3 r''' + theta_4 r'''' + theta_c tanh(r' / coulomb)

    The derivatives are central differences in the middle between the samples k and k+1, over which
    u[k] is held. Before and after the trial the reference rests; begin and end it at rest, or the
    jump of its velocity counts as an acceleration. Each input has parameters of its own for the
    reference of its own output, or, with `coupled`, for the references of all outputs.

    orders: the derivatives, of 0 (position), 1 (velocity), 2 (acceleration), 3 (jerk), 4 (snap)
    coulomb: () velocity up to which friction grows, > 0 [unit of y per s]; None: no friction
    lead: () time by which the functions are ahead of the reference [s]; None: none. Both have a
        gradient.
    coupled: whether each input has parameters for the references of all outputs
    """

    orders: tuple[int, ...] = static(default=(1, 2, 3, 4))
    coulomb: Leaf | None = leaf(default=None, interval="(0, inf)", optional=True)
    lead: Leaf | None = leaf(default=None, optional=True)
    coupled: bool = static(default=False)

    def __post_init__(self):
        allowed = all(type(order) is int and 0 <= order < len(ORDERS) for order in self.orders)
        if not allowed or len(set(self.orders)) != len(self.orders):
            raise ValueError(
                f"PolynomialBasis: orders = {self.orders}; allowed are different ones of 0 "
                "(position), 1 (velocity), 2 (acceleration), 3 (jerk) and 4 (snap)"
            )
        if not self.orders and self.coulomb is None:
            raise ValueError("PolynomialBasis: orders = () without coulomb leaves no function")
        for name in ("coulomb", "lead"):
            value = getattr(self, name)
            if value is not None and value.shape:
                raise ValueError(
                    f"PolynomialBasis: {name} has shape {value.shape}; allowed is one number"
                )

    def names(self, outputs: int, inputs: int) -> tuple[str, ...]:
        of_one = [ORDERS[order] for order in self.orders] + ["friction"] * (
            self.coulomb is not None
        )
        if self.coupled:
            return tuple(
                f"{f}[{i}<-{o}]" for i in range(inputs) for o in range(outputs) for f in of_one
            )
        return tuple(f if inputs == 1 else f"{f}[{i}]" for i in range(inputs) for f in of_one)

    def columns(self, r, dt: float, inputs: int) -> jax.Array:
        of_each = self._functions(jnp.asarray(r), dt)  # (N, n_y, p)
        N, _, p = of_each.shape
        eye = jnp.eye(inputs, dtype=of_each.dtype)
        if self.coupled:
            return jnp.einsum("kyp,ij->kijyp", of_each, eye).reshape(N, inputs, -1)
        return jnp.einsum("kip,ij->kijp", of_each, eye).reshape(N, inputs, inputs * p)

    def check(self, task: Task) -> None:
        if not self.coupled and task.inputs != task.outputs:
            raise ValueError(
                f"PolynomialBasis: coupled = False needs as many inputs as outputs, not "
                f"{task.inputs} and {task.outputs}; allowed is coupled = True"
            )
        if self.lead is not None and known(self) and abs(float(self.lead)) >= task.duration:
            raise ValueError(
                f"PolynomialBasis: lead = {float(self.lead):g} s is not shorter than the trial of "
                f"{task.duration:g} s"
            )

    def _functions(self, r, dt: float):
        """(N, n_y, p) the functions of the reference of each output."""
        held = jnp.pad(r, ((MARGIN, MARGIN), (0, 0)), mode="edge")
        found = [_difference(held, order, dt) for order in self.orders]
        if self.coulomb is not None:
            found.append(jnp.tanh(_difference(held, 1, dt) / self.coulomb))
        # the middle of the samples k and k+1 is row k + 2 of what is left of the margin
        first = MARGIN - 2
        of_each = jnp.stack(found, axis=-1)
        N = len(r) - 1
        if self.lead is None:
            return of_each[first : first + N]
        last = len(of_each) - 1
        at = jnp.clip(first + np.arange(N) + self.lead / dt, 0, last)
        before = jnp.clip(jnp.floor(at), 0, last - 1).astype(int)
        share = (at - before)[:, None, None]
        return (1 - share) * of_each[before] + share * of_each[before + 1]


def _difference(signal, order: int, dt: float):
    """(M - 5, n) a derivative of a signal (M, n), in the middle between its samples 2+k and 3+k."""
    M = len(signal)
    for _ in range(order // 2):
        signal = (signal[2:] - 2 * signal[1:-1] + signal[:-2]) / dt**2
    signal = signal[2 - order // 2 :][: M - 4]
    if order % 2:
        return (signal[1:] - signal[:-1]) / dt
    return (signal[1:] + signal[:-1]) / 2


@pytree
class GivenBasis(Basis):
    """Functions of time that are given, such as measured inputs, splines or sines.

    They belong to one reference: unlike a basis of derivatives they do not follow another one.

    functions: (N, n_u, m) or, for one input, (N, m) [unit of u per unit of theta]
    """

    functions: Leaf = leaf()

    def __post_init__(self):
        if self.functions.ndim == 2:
            object.__setattr__(self, "functions", self.functions[:, None, :])
        if self.functions.ndim != 3 or not self.functions.size:
            raise ValueError(
                f"GivenBasis: functions has shape {self.functions.shape}; allowed are (N, m) and "
                "(N, n_u, m)"
            )

    def names(self, outputs: int, inputs: int) -> tuple[str, ...]:
        return tuple(f"function {i + 1}" for i in range(self.functions.shape[-1]))

    def columns(self, r, dt: float, inputs: int) -> jax.Array:
        return jnp.asarray(self.functions)

    def check(self, task: Task) -> None:
        if self.functions.shape[:2] != (task.N, task.inputs):
            raise ValueError(
                f"GivenBasis: functions has shape {self.functions.shape}; this task needs "
                f"({task.N}, {task.inputs}, m)"
            )


@pytree
class SelectedBasis(Basis):
    """Some functions of another basis, such as those that `select_basis` found to matter.

    basis: a basis that is linear in theta
    kept: the numbers of its functions that are kept, from 0
    """

    basis: Basis = child()
    kept: tuple[int, ...] = static()

    def __post_init__(self):
        if not self.basis.linear:
            name = type(self.basis).__name__
            raise ValueError(f"SelectedBasis: a {name} is not linear in theta; give another")
        good = all(type(i) is int and i >= 0 for i in self.kept)
        if not good or not self.kept or len(set(self.kept)) != len(self.kept):
            raise ValueError(
                f"SelectedBasis: kept = {self.kept}; allowed are different whole numbers from 0"
            )

    def names(self, outputs: int, inputs: int) -> tuple[str, ...]:
        of_all = self.basis.names(outputs, inputs)
        return tuple(of_all[i] for i in self.kept)

    def columns(self, r, dt: float, inputs: int) -> jax.Array:
        return self.basis.columns(r, dt, inputs)[..., list(self.kept)]

    def check(self, task: Task) -> None:
        self.basis.check(task)
        count = len(self.basis.names(task.outputs, task.inputs))
        if max(self.kept) >= count:
            raise ValueError(
                f"SelectedBasis: kept = {self.kept}; allowed are numbers of the {count} functions, "
                f"0..{count - 1}"
            )
