"""Any learning law within the space of basis functions."""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from ..pytree.fields import child, pytree, static
from ..signals.task import Task, Trial
from .bases import Basis
from .basis_functions import fitted
from .compose import need_feedforward
from .experiments import need_no_experiments
from .gradient import Ready
from .guards import Guard
from .scheme import Part, Scheme, limited


class OnBasisMemory(NamedTuple):
    """The memory of `OnBasis`.

    scheme: memory of the scheme
    theta: (m,) parameters of the input
    """

    scheme: Any
    theta: jax.Array


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
    basis: basis of m functions
    iterations: number of regressions with a `RationalBasis`
    solved: leave None
    """

    scheme: Scheme = child()
    basis: Basis = child()
    iterations: int = static(default=5, interval="[1, 100]", whole=True)
    solved: Ready | None = child(default=None)
    of_one_length = True

    def parts(self, task: Task, memory) -> dict[str, Part]:
        return {"scheme": Part(self.scheme, task, memory.scheme)}

    def frozen(self) -> Scheme:
        return dataclasses.replace(self, scheme=self.scheme.frozen())

    def check(self, task: Task) -> None:
        super().check(task)
        need_no_experiments(self, task, "whose inputs are no sums of the basis functions")
        need_feedforward(self, self.scheme, task)
        self.basis.check(task)

    def initial_memory(self, task: Task) -> OnBasisMemory:
        theta = jnp.zeros(len(self.basis.names(task.outputs, task.inputs)))
        return OnBasisMemory(self.scheme.initial_memory(task), theta)

    def prepared(self, task: Task) -> OnBasis:
        ready = Ready(dt=task.dt)
        return dataclasses.replace(self, scheme=self.scheme.prepared(task), solved=ready)

    def learn(self, memory: OnBasisMemory, trial: Trial) -> OnBasisMemory:
        dt: Any = trial.dt if self.solved is None else self.solved.dt
        following = self.scheme.learn(memory.scheme, self.shown(trial)["scheme"])
        u = self.scheme.schedule(following, Task(trial.r, dt=dt, inputs=trial.u.shape[1])).u
        theta = fitted(self.basis, u, trial.r, dt, theta=memory.theta, iterations=self.iterations)
        return OnBasisMemory(following, theta)

    def schedule(self, memory: OnBasisMemory, task: Task) -> Any:
        u = self.basis.signal(memory.theta, jnp.asarray(task.reference), task.dt, task.inputs)
        schedule = self.scheme.schedule(memory.scheme, task)
        return schedule._replace(u=limited(u, self.limit))

    def feedforward(self, memory: OnBasisMemory, task: Task) -> jax.Array:
        return self.schedule(memory, task).u

    def started(self, memory: OnBasisMemory, u, task: Task) -> OnBasisMemory:
        """The memory with the parameters that come nearest to an input u (N, n_u)."""
        r = jnp.asarray(task.reference)
        return memory._replace(theta=fitted(self.basis, u, r, task.dt, iterations=self.iterations))
