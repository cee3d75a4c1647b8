"""A learning law that starts from an input that is known already."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp

from ..pytree.fields import Leaf, child, leaf, pytree
from ..signals.task import Task
from .bases import Basis
from .basis_functions import need_parameters
from .scheme import Scheme
from .wrapper import Wrapper


def started(scheme: Scheme, memory: Any, u, task: Task) -> Any:
    """The memory of a scheme with u (N, n_u) as its learned input, and all else as it was.

    A scheme that keeps more than its input says what this means by a method `started(memory, u,
    task)`. Of a composed scheme it is the part that learns an input.
    Raises ValueError for a scheme that learns no input, and for an input of another shape.
    """
    own = getattr(scheme, "started", None)
    if own is not None:
        return own(memory, u, task)
    if hasattr(memory, "u"):
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
    there the scheme learns as ever, also what the basis cannot make.

    scheme: any scheme that learns an input
    basis: basis of m functions
    theta: (m,) its parameters
    """

    scheme: Scheme = child()
    basis: Basis = child()
    theta: Leaf = leaf()

    def check(self, task: Task) -> None:
        super().check(task)
        self.basis.check(task)
        need_parameters(self, "theta", self.theta, self.basis, task)
        started(self.scheme, self.scheme.initial_memory(task), self._input(task), task)

    def initial_memory(self, task: Task) -> Any:
        return started(self.scheme, super().initial_memory(task), self._input(task), task)

    def _input(self, task: Task):
        r = jnp.asarray(task.reference)
        return self.basis.signal(jnp.asarray(self.theta), r, task.dt, task.inputs)
