"""A verdict on each uncertain machine from theory alone, and how it compares with simulation.

Theory here is that of a linear learning law: an adaptive scheme is taken with its estimates frozen at their start, which makes it one.
Its errors then obey e_{j+1} = M e_j with M = I - G L, and three things follow:

    sigma_max(M) < 1            the error falls in every trial, whatever the task: `monotone` (if no error leads to no error: with a
                                leak or a filter Q it is the distance from a limit that falls, and nothing is claimed)
    the recursion from e_1      over the trials asked for: it ends low, `converges with transient growth`; it has a best trial before
                                the last and has since grown, `semi-converges`, with that trial; or it ends above its start, `diverges`

Only the first is a guarantee, and it is claimed only where nothing adapts and the error of two trials to come really is linear in
that of one: no friction, limit or quantiser is met, no rule stops or switches the learning. Elsewhere the verdict is a prediction, and
the confusion table says how good a one.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..batch import tiled
from ..learning import check, learn
from ..machine import Machine
from ..memory import check_program, check_size
from ..pytree import named_leaves, replaced
from ..schemes import CFDLMFAILC, FFDLMFAILC, Scheme
from ..signals import Task, Trial
from ..uncertainty import Uncertainty, drawn_machine
from .bounds import cfdl_bounds, ffdl_bounds
from .condition import departure, is_linear
from .contraction import error_map, singular_value
from .lifted import noiseless

MONOTONE, CONVERGES, SEMI, DIVERGES = VERDICTS = ("monotone", "converges with transient growth", "semi-converges", "diverges")
RISE = 1e-9  # a relative rise of the error that rounding explains
GROWTH = 0.5  # relative rise above the best trial that counts as growing again
FROZEN = 1e-30  # an estimator step that moves nothing
CHUNK = 16  # machines whose signals are looked at together
COPIES = 12  # of what is found of a machine, until it is drawn


class Certificate(NamedTuple):
    """What theory says of each of S machines, and what simulation does.

    verdict, observed_verdict: (S,) of `VERDICTS`;  linear: whether all is, on every machine, so that `monotone` can be claimed
    departure: (S,) of the errors to come from linear in the error, as a share (`condition.departure`)
    sigma: (S,) largest singular value of M, from below;  doubt: (S,) within which it is resolved
    left_over: (S,) root mean square error that would follow on a trial without any
    predicted, observed: (S, J) root mean square error by trial;  turning, observed_turning: (S,) best trial
    growth: (S,) largest rise of the predicted error above a lower one before it, as a factor
    """

    verdict: np.ndarray
    observed_verdict: np.ndarray
    linear: bool
    departure: np.ndarray
    sigma: np.ndarray
    doubt: np.ndarray
    left_over: np.ndarray
    predicted: np.ndarray
    observed: np.ndarray
    turning: np.ndarray
    observed_turning: np.ndarray
    growth: np.ndarray

    def confusion(self) -> dict[str, dict[str, int]]:
        """{predicted: {observed: machines}}"""
        pairs = list(zip(self.verdict, self.observed_verdict, strict=True))
        return {p: {o: sum(pair == (p, o) for pair in pairs) for o in VERDICTS} for p in VERDICTS}

    def broken_promises(self) -> np.ndarray:
        """Indices of machines that were certified monotone and grew all the same: there must be none."""
        return np.flatnonzero((self.verdict == MONOTONE) & (self.observed_verdict != MONOTONE))


def frozen(scheme: Scheme) -> Scheme:
    """The scheme with every estimator stopped at its start value: its learning law is then linear."""
    steps = [path for path in named_leaves(scheme) if path.split(".")[-1] == "eta"]
    return replaced(scheme, dict.fromkeys(steps, FROZEN)) if steps else scheme


def certify(
    machine: Machine, scheme: Scheme, task: Task, trials: int, uncertainty: Uncertainty, drawn: Mapping[str, Any], *, steps: int = 60
) -> Certificate:
    """The certificate of each machine drawn (`uncertainty.draw`), without noise.

    steps: of the Lanczos process for sigma, at most
    Raises as `learn` does, and ValueError, before anything runs, for more machines or trials than fit into memory.
    """
    check(machine, scheme, task)
    _need_room(scheme, task, trials, drawn)
    adapts = frozen(scheme) is not scheme
    run = jax.jit(tiled(partial(_of_one, names=tuple(uncertainty.items()), trials=trials, steps=steps)))
    batch = {name: jnp.asarray(values) for name, values in drawn.items()} or {"": jnp.zeros(1)}
    common = (machine, frozen(scheme), scheme, task)
    check_program("certify: a batch of machines", "take fewer trials, or a shorter one", run, common, batch)
    departed, sigma, doubt, left_over, predicted, observed = (np.asarray(x) for x in run(common, batch))
    linear = is_linear(departed) & (not adapts)
    certified = linear & (sigma + doubt < 1.0) & (left_over <= RISE * predicted[:, 0])
    verdict = [MONOTONE if sure else _classified(e, CONVERGES) for sure, e in zip(certified, predicted, strict=True)]
    return Certificate(
        verdict=np.array(verdict),
        observed_verdict=np.array([_classified(e, MONOTONE) for e in observed]),
        linear=bool(np.all(linear)),
        departure=departed,
        sigma=sigma,
        doubt=doubt,
        left_over=left_over,
        predicted=predicted,
        observed=observed,
        turning=_best(predicted),
        observed_turning=_best(observed),
        growth=np.max(np.nan_to_num(predicted / np.minimum.accumulate(predicted, axis=1), nan=np.inf), axis=1),
    )


class PremiseShare(NamedTuple):
    """A premise over S machines: on how many it held throughout, and the mean share of samples and trials that broke it."""

    name: str
    held: int
    share_broken: float


def premises(
    machine: Machine, scheme: FFDLMFAILC, task: Task, trials: int, uncertainty: Uncertainty, drawn: Mapping[str, Any], *, chunk: int = CHUNK
) -> tuple[list[PremiseShare], dict[str, int]]:
    """The premises of Cao 2019's bounds on each machine's run, and how often the bound itself holds, fails or is not claimed.

    Machines whose run is not finite are left out of both.
    """
    _need_room(scheme, task, trials, drawn, chunk)
    bounds: Any = cfdl_bounds if isinstance(scheme, CFDLMFAILC) else ffdl_bounds
    run = tiled(partial(_signals, names=tuple(uncertainty.items()), trials=trials))
    total = len(next(iter(drawn.values())))
    conditions = []
    for start in range(0, total, chunk):
        batch = {name: jnp.asarray(values[start : start + chunk]) for name, values in drawn.items()}
        for y, u in zip(*(np.asarray(s) for s in run((machine, scheme, task), batch)), strict=True):
            if np.all(np.isfinite(y)) and np.all(np.isfinite(u)):
                conditions.append(bounds(scheme, task, y, u).condition)
    names = [p.name for p in conditions[0].premises] if conditions else []
    shares = [
        PremiseShare(
            name, sum(bool(c.premises[i].held) for c in conditions), float(np.mean([c.premises[i].share_broken for c in conditions]))
        )
        for i, name in enumerate(names)
    ]
    return shares, {v: sum(c.verdict == v for c in conditions) for v in ("holds", "fails", "not claimed")}


def _need_room(scheme: Scheme, task: Task, trials: int, drawn: Mapping[str, Any], chunk: int = CHUNK) -> None:
    """Raises ValueError where what is found of every machine, or the signals of a chunk of them, do not fit into memory."""
    signals = chunk * (task.N + 1) * (task.outputs + task.inputs) if isinstance(scheme, FFDLMFAILC) else 0

    def need(samples: float, trials: float) -> float:
        return COPIES * 8 * (trials * (2 * samples + signals) + 6 * samples)

    samples = len(next(iter(drawn.values()))) if drawn else 1
    check_size("certify", need, samples=samples, trials=trials)


def _of_one(common, values, *, names, trials, steps):
    machine, stopped, scheme, task = common
    machine = noiseless(drawn_machine(machine, dict(names), values))
    f, at = error_map(machine, stopped, task)
    found = singular_value(lambda e: f(e)[0], at, steps=steps, tolerance=1e-4)
    predicted, observed = (_error(learn(machine, s, task, trials)) for s in (stopped, scheme))
    left_over = jnp.sqrt(jnp.mean(f(jnp.zeros_like(at))[0] ** 2))
    two_trials = departure(*error_map(machine, stopped, task, trials=2))
    return two_trials, found.value, found.residual, left_over, predicted, observed


def _error(history):
    """(J,) root mean square over all outputs."""
    return jnp.sqrt(jnp.mean(history.rms**2, axis=1))


def _signals(common, values, *, names, trials):
    machine, scheme, task = common
    return learn(noiseless(drawn_machine(machine, dict(names), values)), scheme, task, trials, save=_y_and_u).saved


def _y_and_u(trial: Trial):
    return trial.y, trial.u


def _classified(errors, falling: str) -> str:
    """The verdict that an error curve shows; `falling` for one that falls in every trial."""
    if not np.all(np.isfinite(errors)) or errors[-1] > errors[0] * (1 + RISE):
        return DIVERGES
    if errors[-1] > (1.0 + GROWTH) * np.min(errors):
        return SEMI
    return falling if np.all(errors[1:] <= errors[:-1] * (1 + RISE)) else CONVERGES


def _best(errors) -> np.ndarray:
    """(S,) the trial of the smallest error, counted from 1."""
    return np.argmin(np.nan_to_num(errors, nan=np.inf), axis=1) + 1
