"""One trial of a machine, as a scan over time."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from ..pytree.aliases import Array, Tree, Value
from ..runtime.capacity import bytes_of
from ..runtime.lanes import over_samples, stored
from ..schemes import Scheme
from ..schemes.scheme import silent
from ..schemes.weights import weighed
from ..signals.rows import for_scan, plus
from ..signals.task import Sample, Task, Trial
from .machine import Machine
from .metrics import Tally, measure
from .rehearsal import fitting_memory
from .variation import SALT, Start


def run_trial(
    machine: Machine,
    scheme: Scheme,
    task: Task,
    memory: Tree,
    key: Array,
    number: Array | int | None = None,
) -> Trial:
    """The record of one trial of the machine under the scheme, from rest.

    memory: memory of the scheme; None: that before the first trial, `scheme.initial_memory(task)`
    key: random key of the noise of this trial
    number: j, of a machine whose trials differ; None is a trial of the long run
    The function is pure and can be called inside `jit`. Fields of the returned `Trial` have N or
    N+1 rows. Raises ValueError where machine, scheme, memory and task do not fit, unless traced.
    """
    memory = fitting_memory(scheme, task, memory, machine)
    return run_and_measure(machine, scheme, task, memory, key, number, measured=False)[0]


def run_and_measure(
    machine: Machine,
    scheme: Scheme,
    task: Task,
    memory: Tree,
    key: Array,
    number: Array | int | None = None,
    start: Start | None = None,
    *,
    measured: bool = True,
) -> tuple[Trial, Tree, Start | None]:
    """The record of `run_trial`, its `Metrics`, and the start of the next trial.

    start: `Start` of the trial; None: that of the machine
    measured: whether the metrics are computed, in the same pass; they are None if not. XLA would
        drop metrics that nobody reads, but tracing and differentiating them takes time
    The last result is None for a machine that does not carry its state.
    """
    every, of_all = machine.sampled(task.dt), task
    machine, task = every.at_trial(task, number)
    if (
        machine.answers_at_once
        and scheme.plays_back
        and not scheme.signals(scheme.initial_state(task))
    ):
        trial = _at_once(machine, scheme.schedule(memory, task).u, task, key)
        return trial, measure(trial, task) if measured else None, None
    plant, dt, r, preview = machine.plant, task.dt, jnp.asarray(task.reference), scheme.preview
    draws = machine.draws(key, task)
    future = jnp.pad(r[1:], ((0, preview - 1), (0, 0)), mode="edge")
    there = None if machine.variation is None else machine.variation.measured(task, key)

    def tick(carry: Tree, now: Tree) -> tuple[Tree, Tree]:
        x, state, v_last, u_last, y, tally = carry
        k, r_k, next_r, row, d_u, d_y, noise, settled, counted = now
        ahead = next_r[None] if preview == 1 else lax.dynamic_slice_in_dim(future, k, preview)
        state, command = scheme.act(state, Sample(r_k, ahead, y, row, dt, u_last))
        v, u = machine.actuate(command, v_last, dt)
        x = plant.step(x, plus(u, d_u), dt)
        y = machine.measure(plus(plant.output(x), d_y), noise)
        if measured:
            e = next_r - y if counted is None else counted * (next_r - y)
            tally = tally.add(*lax.stop_gradient((e, u)), settled)
        return (x, state, v, None if unaltered else u, y, tally), (y, u, scheme.signals(state))

    d_y, noise, unaltered = draws.output, draws.sensor, machine.actuator is None
    begun = first_start(machine, scheme, task, key) if start is None else start
    y = machine.measure(plus(plant.output(begun.plant), _at(d_y, 0)), _at(noise, 0))
    tally: Tree = None
    if measured:
        at_0 = lax.stop_gradient(r[0] - y)
        tally = Tally.start(at_0, task.inputs, task.N, task.settled.start == 0)
    carry = (begun.plant, begun.scheme, begun.v, begun.u, y, tally)
    rows = (
        jnp.arange(task.N),
        r[:-1],
        r[1:],
        scheme.schedule(memory, task),
        draws.input,
        _at(d_y, slice(1, None)),
        _at(noise, slice(1, None)),
        _is_settled(task)[1:] if measured else None,
        _at(there, slice(1, None)),
    )
    carry, record = over_samples(tick, carry, for_scan(rows))
    y_next, u, signals = for_scan(record)
    trial = Trial(r, jnp.concatenate([y[None], stored(y_next)]), u, dt, signals)
    if there is not None:
        trial = weighed(trial, jnp.broadcast_to(there[:, None], r.shape))
    metrics = stored(carry[-1]).metrics(trial, task) if measured else None
    if not machine.carries:
        return trial, metrics, None
    machine, task = every.at_trial(of_all, None if number is None else number + 1)
    rest = first_start(machine, scheme, task, jax.random.fold_in(key, SALT))
    assert machine.variation is not None
    return trial, metrics, machine.variation.following(rest, Start(*carry[:4]))


def first_start(machine: Machine, scheme: Scheme, task: Task, key: Array) -> Start:
    """The `Start` of a trial of a machine, sampled, that is at rest."""
    plant = machine.plant
    varies = machine.variation
    x = plant.initial_state() if varies is None else varies.initial_state(plant, key)
    rest = jnp.zeros(task.inputs)
    return Start(x, scheme.initial_state(task), rest, None if machine.actuator is None else rest)


def bytes_of_trial(scheme: Scheme, task: Task) -> int:
    """The bytes of one machine that learning over trials reads and writes between two trials.

    They are those of the memory, the schedule, and the record of a trial. Nothing is computed.
    """

    def signals() -> Tree:
        ready = scheme.prepared(task)
        memory = ready.initial_memory(task)
        record = jnp.zeros((task.N, task.outputs + task.inputs))
        return memory, ready.schedule(memory, task), record, silent(ready, task)

    return bytes_of(jax.eval_shape(signals))


def _at_once(machine: Machine, command: Array, task: Task, key: Array) -> Trial:
    """The trial of a plant that computes all outputs at once from all inputs.

    command: (N, n_u) input that the scheme plays back [unit of u]
    """
    draws = machine.draws(key, task)
    u = machine.actuate(command, command, task.dt)[1]
    y = machine.measure(
        plus(machine.plant.response(plus(u, draws.input), task.dt), draws.output), draws.sensor
    )
    return Trial(jnp.asarray(task.reference), y, u, task.dt)


def _is_settled(task: Task) -> np.ndarray:
    """Whether each sample is in the settled window, as (N+1,)."""
    settled = np.zeros(task.N + 1, bool)
    settled[task.settled] = True
    return settled


def _at(rows: Array | None, index: Value) -> Tree:
    return None if rows is None else rows[index]
