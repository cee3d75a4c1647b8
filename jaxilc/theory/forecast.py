"""The error of each trial on many machines, as linear theory predicts it and as it is simulated."""

from __future__ import annotations

from functools import lru_cache, partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from ..learning.machine import Machine
from ..learning.over_trials import learn
from ..runtime.tiles import tiled
from ..schemes import Scheme
from ..signals.task import Task
from .affine import View, known_as
from .trials import step, trial_of

# trials simulated before the prediction takes over: from the third on a law of two-trial
# increments is what it will be
FIRST = 2


def predict(machines: Machine, scheme: Scheme, task: Task, trials: int) -> np.ndarray:
    """(S, J) root mean square errors by linear theory.

    Two trials are simulated; then the learning map is linearised at what they left. Estimates are
    frozen at their start; rules of when to learn, and limits, are left out. Where a scheme runs
    several trials before it learns once, each error is repeated that many times.
    """
    run = _predicting(-(-trials // scheme.trials_a_step))
    found = np.asarray(run((scheme.frozen().unlimited(), task), machines))
    return np.repeat(found, scheme.trials_a_step, axis=1)[:, :trials]


def simulate(machines: Machine, scheme: Scheme, task: Task, trials: int) -> np.ndarray:
    """(S, J) root mean square errors as `learn` simulates them, without noise."""
    return np.asarray(_simulating(trials)((scheme, task), machines))


def follow(
    machines: Machine, scheme: Scheme, task: Task, trials: int, limit, view: View
) -> tuple[np.ndarray, np.ndarray]:
    """(S, J) root mean square errors as simulated, and (S, J) distances from a limit.

    The distance is that of what is played from a limit (S, n), see `affine`.
    """
    errors, distance = _following(trials, view)((scheme, task), (machines, jnp.asarray(limit)))
    return np.asarray(errors), np.asarray(distance)


# One machine at a time
# --------------------------------------------------------------------------------------------------


@lru_cache(maxsize=16)  # what `tiled` returns compiles anew each time it is made
def _predicting(trials):
    return tiled(partial(_predict, trials=trials))


@lru_cache(maxsize=16)
def _simulating(trials):
    return tiled(partial(_simulate, trials=trials))


@lru_cache(maxsize=16)
def _following(trials, view):
    return tiled(partial(_follow, trials=trials, view=view))


def _predict(common, machine, *, trials):
    """(J,) root mean square errors of one machine.

    The first trials are simulated; the others follow by the learning map, linearised after them.
    """
    scheme, task = common
    machine, scheme = machine.unlimited(), scheme.prepared(task)

    def after(memory):
        return trial_of(machine, scheme, task, memory).e[1:]

    def pushed(floats):
        """The floats of the memory after a trial, and the error of that trial."""
        whole = back(floats)
        return _floats(step(machine, scheme, task, whole))[0], after(whole)

    def simulated(memory, _):
        return step(machine, scheme, task, memory), _rms(after(memory))

    memory, first = lax.scan(simulated, scheme.initial_memory(task), length=FIRST)
    floats, back = _floats(memory)
    (following, error), push = jax.linearize(pushed, floats)
    moved = jax.tree.map(jnp.subtract, following, floats)

    def turn(d, _):
        step_of_memory, of_error = push(d)
        return jax.tree.map(jnp.add, moved, step_of_memory), _rms(error + of_error)

    _, later = lax.scan(turn, jax.tree.map(jnp.zeros_like, floats), length=max(trials - FIRST, 1))
    return jnp.concatenate([first, later])[:trials]


def _rms(error):
    return jnp.sqrt(jnp.mean(error**2))


def _floats(memory):
    """The floating leaves of a memory that are signals, and the way back.

    Counters and flags are held.
    """
    leaves, shape = jax.tree.flatten(memory)
    free = [jnp.issubdtype(jnp.result_type(x), jnp.floating) and jnp.ndim(x) > 0 for x in leaves]

    def back(floats):
        given = iter(floats)
        return shape.unflatten([next(given) if f else x for x, f in zip(leaves, free, strict=True)])

    return [x for x, f in zip(leaves, free, strict=True) if f], back


def _simulate(common, machine, *, trials):
    return _error(learn(machine.noiseless(), *common, trials))


def _follow(common, one, *, trials, view):
    """(J,) root mean square errors as simulated, and distances from the limit of learning."""
    (scheme, task), (machine, limit) = common, one
    scheme = scheme.prepared(task)

    def turn(memory, _):
        w = known_as(memory, scheme, task, view)
        trial = trial_of(machine, scheme, task, memory)
        return scheme.learn(memory, trial), (_rms(trial.e[1:]), jnp.linalg.norm(w - limit))

    return lax.scan(turn, scheme.initial_memory(task), length=trials)[1]


def _error(history):
    """() root mean square over all outputs, for each of J trials."""
    return jnp.sqrt(jnp.mean(history.rms**2, axis=1))
