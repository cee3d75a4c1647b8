"""The law by model inverse and zero-phase filter as IterativeLearningControl2.jl runs it."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from ..plants import StateSpace
from ..pytree.aliases import Leaf
from ..pytree.fields import child, leaf, pytree
from ..schemes import Scheme
from ..schemes.scheme import Feedforward
from ..signals.task import Task, Trial, product


class WholeRecord(NamedTuple):
    """a: (N+1, 1) what was learned, of which the last sample acts on nothing within the trial."""

    a: jax.Array


@pytree
class InverseLaw(Scheme):
    """a_{j+1} = Q (a_j + gain G^-1 e_j), over records of N+1 samples (`HeuristicILC` there).

    G^-1 runs forward from rest, so the zeros of the model must lie within the unit circle. It looks
    one sample ahead; at the last sample it repeats its value. Q is the lag 1/(T s + 1), sampled
    with a zero-order hold, first backward and then forward in time, from rest each time.

    These ends are why this law is not a `LearningFilter`: they are part of the numbers that the
    scenario compares with.

    model: sampled model G of one input and one output
    gain: () share of the inverse
    time_constant: () T [s]
    """

    model: StateSpace = child()
    gain: Leaf = leaf(interval="(0, inf)")
    time_constant: Leaf = leaf(interval="(0, inf)")

    def check(self, task: Task) -> None:
        if (self.model.n_u, self.model.n_y, task.inputs, task.outputs) != (1, 1, 1, 1):
            raise ValueError(
                f"InverseLaw: the model has {self.model.n_u} inputs and {self.model.n_y} outputs, "
                f"the task {task.inputs} and {task.outputs}; allowed is one of each"
            )
        self.model.sampled(task.dt)

    def initial_memory(self, task: Task) -> WholeRecord:
        return WholeRecord(jnp.zeros((task.N + 1, task.inputs)))

    def schedule(self, memory: WholeRecord, task: Task) -> Feedforward:
        return Feedforward(memory.a[:-1])

    def learn(self, memory: WholeRecord, trial: Trial) -> WholeRecord:
        played = jnp.concatenate([trial.u, memory.a[-1:]])
        wanted = self.gain * self._inverse(trial.e[1:], trial.dt)
        both = played + jnp.concatenate([wanted, wanted[-1:]])
        pole = jnp.exp(-trial.dt / self.time_constant)
        return WholeRecord(_lagged(_lagged(both[::-1], pole)[::-1], pole))

    def _inverse(self, e, dt):
        """(N, 1) the input that moves the output of the model by e (N, 1), one sample later."""
        A, B, C = (getattr(self.model.sampled(dt), name) for name in "ABC")
        first = (C @ B)[0, 0]

        def tick(x, e_next):
            u = (e_next - product(C, product(A, x))) / first
            return product(A, x) + product(B, u), u

        return lax.scan(tick, jnp.zeros(A.shape[-1]), e)[1]


def _lagged(signal, pole):
    """The signal behind the sampled lag (1 - pole) / (z - pole), from rest."""

    def tick(state, x):
        return pole * state + (1 - pole) * x, state

    return lax.scan(tick, jnp.zeros_like(signal[0]), signal)[1]
