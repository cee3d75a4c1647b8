"""The error of each trial on many machines, as linear theory predicts it and as it is simulated."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from ..learning.machine import Machine
from ..learning.over_trials import learn
from ..runtime.tiles import tiled_with
from ..schemes import Scheme
from ..signals.task import Task
from .learning_map import View, known_as
from .trials import learned_from, trial_of

# trials simulated before the prediction takes over: from the third on a law of two-trial
# increments is what it will be
FIRST = 2
AHEAD = 4  # times a power that contracts: trials in which the largest error is looked for
LAST_LOOK = 4096  # trials, at most
SETTLED = 1e-3  # relative distance of the error from that of the limit


def predict(machines: Machine, scheme: Scheme, task: Task, trials: int) -> np.ndarray:
    """(S, J) root mean square errors by linear theory.

    Two learning steps are simulated; then the learning map is linearised at what they left.
    Estimates are frozen at their start; rules of when to learn, and limits, are left out. Where a
    rule runs several equal trials before its scheme learns once, each error is repeated that many
    times. Where a scheme makes experiments, a step is all of them.
    """
    law = scheme.frozen().unlimited()
    repeats = scheme.trials_a_step // law.trials_a_step
    found = np.asarray(tiled_with(_predict, trials=-(-trials // repeats))((law, task), machines))
    return np.repeat(found, repeats, axis=1)[:, :trials]


def peaks(
    machines: Machine, scheme: Scheme, task: Task, predicted, powers, floor
) -> tuple[np.ndarray, np.ndarray]:
    """(S,) the largest error by theory, in units of the first, and its trial, counted from 1.

    Of machines with an error that is known at the limit, it is looked for beyond the J trials: in
    four times the trials after which the distance from the limit has surely fallen, and further
    until the error has fallen below the first one or is that of the limit. The latter counts, too;
    its trial is the last one that was looked at.

    predicted: (S, J) of `predict`
    powers: (S,) power of the learning map that is known to contract, on these machines; 0 where
        none is, as where a claim rests on the mean square of what is drawn
    floor: (S,) error at the limit; NaN where none is known, or where the error falls in every trial
    """
    sizes, known = [_finite_or_infinite(predicted)], np.isfinite(floor)
    if np.any(known):
        trials = AHEAD * max(int(np.max(powers[known])), 1)
        while trials <= LAST_LOOK:
            if trials > predicted.shape[1]:
                predicted = predict(machines, scheme, task, trials)
            first, last = _finite_or_infinite(predicted)[known][:, [0, -1]].T
            there = np.abs(last - floor[known]) <= SETTLED * floor[known]
            if np.all((last <= first) | there):
                break
            trials *= AHEAD
        beyond = np.column_stack([predicted[:, sizes[0].shape[1] :], floor])
        sizes.append(np.where(known[:, None], _finite_or_infinite(beyond), -np.inf))
    every = np.concatenate(sizes, axis=1)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        peak = np.max(every, axis=1) / every[:, 0]
    trial = np.minimum(np.argmax(every, axis=1) + 1, predicted.shape[1])
    return np.where(np.isnan(peak), 1.0, peak), trial


def growth_of(errors) -> np.ndarray:
    """(S,) the largest rise of errors (S, J) above a lower one before it, as a factor."""
    with np.errstate(invalid="ignore", divide="ignore"):
        rises = errors / np.minimum.accumulate(errors, axis=1)
    return np.max(np.nan_to_num(rises, nan=np.inf), axis=1)


def _finite_or_infinite(errors) -> np.ndarray:
    return np.where(np.isfinite(errors), errors, np.inf)


def simulate(machines: Machine, scheme: Scheme, task: Task, trials: int) -> np.ndarray:
    """(S, J) root mean square errors as `learn` simulates them, without noise."""
    return np.asarray(tiled_with(_simulate, trials=trials)((scheme, task), machines))


def simulate_runs(
    machines: Machine, scheme: Scheme, task: Task, trials: int, runs: int
) -> np.ndarray:
    """(S, R, J) root mean square errors of R runs of each machine, with all that is drawn.

    As theory does, they begin when machine and reference have changed for the last time.
    """
    keys = jax.random.split(jax.random.key(11), runs)
    return np.asarray(tiled_with(_simulate_runs, trials=trials)((scheme, task, keys), machines))


def follow(
    machines: Machine, scheme: Scheme, task: Task, trials: int, limit, view: View
) -> tuple[np.ndarray, np.ndarray]:
    """(S, J) root mean square errors as simulated, and (S, J) distances from a limit.

    The distance is that of what is played from a limit (S, n), see `learning_map`.
    """
    run = tiled_with(_follow, trials=trials, view=view)
    errors, distance = run((scheme, task), (machines, jnp.asarray(limit)))
    return np.asarray(errors), np.asarray(distance)


# One machine at a time
# --------------------------------------------------------------------------------------------------


def _predict(common, machine, *, trials):
    """(J,) root mean square errors of one machine.

    The first trials are simulated; the others follow by the learning map, linearised after them.
    """
    scheme, task = common
    machine, scheme = machine.unlimited(), scheme.prepared(task)
    steps = -(-trials // scheme.trials_a_step)

    def simulated(memory, _):
        """The memory after a learning step, and the errors (M, N, n_y) of its M trials."""
        trial = trial_of(machine, scheme, task, memory)
        return learned_from(machine, scheme, memory, trial), trial.e[1:]

    def a_step(memory, _=None):
        return lax.scan(simulated, memory, length=scheme.trials_a_step)

    def pushed(floats):
        following, errors = a_step(back(floats))
        return _floats(following)[0], errors

    memory, first = lax.scan(a_step, scheme.initial_memory(task), length=FIRST)
    floats, back = _floats(memory)
    (following, errors), push = jax.linearize(pushed, floats)
    moved = jax.tree.map(jnp.subtract, following, floats)

    def turn(d, _):
        step_of_memory, of_errors = push(d)
        return jax.tree.map(jnp.add, moved, step_of_memory), _rms(errors + of_errors)

    _, later = lax.scan(turn, jax.tree.map(jnp.zeros_like, floats), length=max(steps - FIRST, 1))
    return jnp.concatenate([_rms(first), later]).ravel()[:trials]


def _rms(errors):
    """(...) root mean squares of errors (..., N, n_y)."""
    return jnp.sqrt(jnp.mean(errors**2, axis=(-2, -1)))


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


def _simulate_runs(common, machine, *, trials):
    scheme, task, keys = common
    machine, task = machine.after_changes(task)
    return jax.vmap(lambda key: _error(learn(machine, scheme, task, trials, key=key)))(keys)


def _simulate(common, machine, *, trials):
    return _error(learn(machine.noiseless(), *common, trials))


def _follow(common, one, *, trials, view):
    """(J,) root mean square errors as simulated, and distances from the limit of learning."""
    (scheme, task), (machine, limit) = common, one
    scheme = scheme.prepared(task)

    def turn(memory, _):
        w = known_as(memory, scheme, task, view)
        trial = trial_of(machine, scheme, task, memory)
        after = learned_from(machine, scheme, memory, trial)
        return after, (_rms(trial.e[1:]), jnp.linalg.norm(w - limit))

    return lax.scan(turn, scheme.initial_memory(task), length=trials)[1]


def _error(history):
    """() root mean square over all outputs, for each of J trials."""
    return jnp.sqrt(jnp.mean(history.rms**2, axis=1))
