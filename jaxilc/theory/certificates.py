"""What theory claims of each uncertain machine, what it predicts, and what simulation does.

Two questions are answered separately. **The long run** does not depend on how many trials are
watched. It is claimed only where machine, feedback and learning law are linear and learn alike in
every trial (`linearity`), and where no limit is met in any trial to come (`outlook`):

    monotone     the error falls in every trial to come, sigma_max(I - G L) < 1. With a filter or a
                 leak, which leave an error, it is the distance of what is learned from its limit
                 that falls: sigma_max of the learning map < 1
    converges    learning comes to its limit in the end: a power of the learning map contracts, or
                 its spectral radius is below 1. Before, the error may grow far;
                 how far, and until which trial, is predicted (`peak`)
    diverges     learning grows without bound, and there is no limit to stop it: an eigenvalue lies
                 beyond 1 by more than its doubt, said of up to 1024 inputs; or in each trial the
                 same is added to an input by errors that no input moves, as under a law without
                 the lead of a plant with dead time, said of up to 512
    not claimed  for a reason that is told

Where something is drawn for each trial (noise, or by a `Variation`), a claim is one of single runs,
in the sense that `chance` gives it: for every draw, in mean square, or almost surely. The distance
is then that of two runs with the same draws, and what learning leaves is told as a root mean square
over all that is drawn, and as what 95 of 100 late trials stay below, which is proved and not
sampled. What holds for the mean of all runs alone is not claimed.

Where a sensor or a converter rounds, or a linear plant has hysteresis at its input, a claim is that
of the machine without it, up to a ball (`rounding`): what falls does so until it is within the
ball, and then stays there.

**Within J trials** theory predicts the error of each trial. An adaptive scheme is taken with its
estimates frozen, rules and limits are left out, and what is not linear is linearised at the third
trial. That is a prediction, and the confusion table says how good it is:

    falls              the error falls in every trial
    falls, not always  the error ends low, but grew between two trials
    turns              the best trial is before the last, and the error has since grown by a half:
                       learning semi-converges
    grows              the error ends above its start
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.flatten_util import ravel_pytree

from ..learning.divergence import GROWTH
from ..learning.machine import Machine
from ..learning.over_trials import check, learn
from ..learning.within_trial import first_start, run_and_measure
from ..plants.structure import acting, obstacle
from ..pytree.in_short import in_short
from ..pytree.ranges import require
from ..runtime.capacity import check_size
from ..runtime.tiles import tiled_with
from ..schemes import (
    ASMC,
    FFDLMFAILC,
    SMC,
    ExponentialPD,
    NormOptimal,
    PIDType,
    Scheme,
    WithFeedback,
)
from ..schemes.scheme import trials_of_step
from ..signals.task import Task
from ..uncertainty import Uncertainty, draw, drawn_machines
from . import condition
from .bounds import Checked, checked_machines
from .chance import (
    EVERY,
    MARGIN,
    SQUARE,
    STILL,
    SURELY,
    RecordMoments,
    UnderChance,
    draws,
    learned_alike,
    under_chance,
)
from .condition import ROUNDING, Condition
from .frequency import learning_condition
from .learning_map import (
    DENSE,
    LearningMaps,
    changes_nothing,
    count_of,
    ends_at_zero,
    first_of,
    in_groups,
    known_as,
    limit_names,
    maps_of,
    view_of,
)
from .lifted import weights_condition
from .linearity import keeps_all, learning_premises
from .outlook import Outlook, outlook_of, share_words
from .rounding import LARGEST, Ball, ball_of, begins_off, linear_part
from .sliding import printed_condition
from .spectrum import radius_with_doubt
from .trials import learned_from, trial_of

CLAIMS = MONOTONE, CONVERGES, DIVERGES, NOTHING = condition.CLAIMS
COURSES = FALLS, NOT_ALWAYS, TURNS, GROWS = "falls", "falls, not always", "turns", "grows"
RISE = 1e-9  # a relative rise of the error that rounding explains
AS_TOLD = 1e-6  # share of the largest error by which simulation may differ from theory
EXACT = 1e-9  # share of the first error that counts as none left
MACHINES = 64  # that are drawn where none were before
GAUSSIAN = (
    "what 95 of 100 trials stay below follows from noise that is Gaussian, by Chernoff's bound"
)
MARKOV = (
    "what 95 of 100 trials stay below follows from the mean square alone, by Markov's inequality"
)
DRAWN = (
    "what {} adds is bounded only where every trial is learned from alike; a claim needs records "
    "without it, or of which nothing is lost or late"
)
UNBOUNDED = "what {} adds in each trial is not seen to stay within bounds"
MANY = (
    f"what {{}} adds is followed for up to {LARGEST} inputs; a claim needs a shorter trial or "
    "longer samples, and `sweep` simulates it"
)
SEEDS = 16  # runs that are simulated of each machine of which something is drawn
BEYOND = 1e3  # times its root mean square; a positive number is 10^6 times its mean once in 10^6
DOUBTED = 0.6  # share of the runs above what 95 % stay below; 10 of 16 are it once in 10^9
NEEDED = 2  # trials: the bounds compare one with the one before it
COPIES = 64  # bytes for each trial of each machine: three curves, with what lies between


class Certificate(NamedTuple):
    """What theory claims of S machines, what it expects of J trials, and what simulation does.

    claim:     (S,) of `CLAIMS`
    reason:    (S,) on what a claim rests, or why nothing is claimed
    sense:     (S,) of `chance.SENSES`, in which a claim holds for single runs; empty where nothing
               is drawn
    left:      (S,) root mean square error in the long run, over all that is drawn, noise included;
               infinite where its square has no mean, NaN where it is not known or nothing is drawn
    most:      (S,) root mean square error that a late trial exceeds with a chance of 5 % or less;
               likewise
    of_error:  (S,) whether `monotone` is of the error itself; if not, of the distance from the
               limit
    sigma:     (S,) bound of the largest singular value of the map that decides; inf where nothing
               is linear
    ball:      within which of this rounding or hysteresis holds the machines; None without it or if
               nothing is linear
    floor:     (S,) root mean square error left at the limit, but for rounding; NaN where no limit
               is claimed. Where something is drawn it is that of the mean of all runs
    doubt:     (S,) the distance within which `floor` is known
    expected:  (S,) of `COURSES`, by theory, within J trials, without those that are experiments
    observed:  (S,) of `COURSES`, by simulation, likewise
    predicted: (S, J) root mean square error of each trial, by theory
    simulated: (S, J) the same by simulation. Where something is drawn, both are root mean squares
               over all that is drawn, by simulation over `SEEDS` runs; where samples are lost or
               late and more than 512 inputs are learned, theory gives a bound
    turning:   (S,) the best trial, by theory
    observed_turning: (S,) the best trial, by simulation
    growth:    (S,) largest rise of the predicted error above a lower one before it, as a factor
    peak:      (S,) largest error by theory, in units of the first; where learning is claimed to
               converge, also beyond J trials
    peak_trial: (S,) the trial of this error; of that at the limit the last one that was looked at
    distance:  (S, J) simulated distance of what is learned from its limit; None where nothing is
               linear, and where something is drawn
    runs:      (S, R, J) the simulated errors of each run; None where nothing is drawn
    outlook:   of all trials to come; None where nothing is linear
    """

    claim: np.ndarray
    reason: np.ndarray
    sense: np.ndarray
    left: np.ndarray
    most: np.ndarray
    of_error: np.ndarray
    sigma: np.ndarray
    ball: Ball | None
    floor: np.ndarray
    doubt: np.ndarray
    expected: np.ndarray
    observed: np.ndarray
    predicted: np.ndarray
    simulated: np.ndarray
    turning: np.ndarray
    observed_turning: np.ndarray
    growth: np.ndarray
    peak: np.ndarray
    peak_trial: np.ndarray
    distance: np.ndarray | None
    runs: np.ndarray | None
    outlook: Outlook | None
    __repr__ = in_short

    def confusion(self) -> dict[str, dict[str, int]]:
        """{expected: {observed: machines}}"""
        pairs = list(zip(self.expected, self.observed, strict=True))
        return {p: {o: sum(pair == (p, o) for pair in pairs) for o in COURSES} for p in COURSES}

    def broken_promises(self) -> np.ndarray:
        """Indices of machines whose claim the simulation contradicts. There must be none."""
        return np.flatnonzero([self._broken(i) for i in range(len(self.claim))])

    def _broken(self, i: int) -> bool:
        e, claim = self.simulated[i], self.claim[i]
        ball, falls_to = 0.0, 0.0
        if self.ball is not None:
            ball = float(self.ball.error[i])
            falls_to = float(self.ball.until(self.of_error, self.sigma)[i])
        if self.runs is not None and claim in (MONOTONE, CONVERGES):
            known = self.sense[i] in (SURELY, EVERY, SQUARE)
            bound = BEYOND * (self.predicted[i] + ball) + EXACT * e[0] if known else np.inf
            last, most = self.runs[i, :, -1] * self.left[i], self.most[i]
            above = last > most * max(self.left[i], self.predicted[i, -1])
            return not bool(np.all(np.isfinite(e) & (e <= bound)) and np.mean(above) < DOUBTED)
        if claim in (NOTHING, DIVERGES) or self.distance is None or self.outlook is None:
            return bool(claim == DIVERGES and e[-1] < EXACT * e[0])
        if claim == MONOTONE and self.of_error[i]:
            return _rises(e, e[0], falls_to)
        k, q, g = (float(x[i]) for x in self.outlook.decay[:3])
        if not k:  # then the error is to be as predicted, but for rounding, which grows as well
            share = AS_TOLD + ROUNDING * np.finfo(e.dtype).eps * g
            apart = np.max(np.abs(e - self.predicted[i])) - ball
            return not apart / share <= np.max(self.predicted[i])
        far, sure = self.distance[i], float(self.outlook.radius[i])
        bound = g * q ** (np.arange(len(far)) // k) * (far[0] + sure) + sure
        bound = bound if self.ball is None else bound + self.ball.learned[i]
        return bool(
            np.any(far > bound * (1 + RISE) + EXACT * far[0]) or not np.all(np.isfinite(far))
        )


class LongRun(NamedTuple):
    """The claims on all trials to come of S machines; the fields are those of `Certificate`."""

    claim: np.ndarray
    reason: np.ndarray
    sense: np.ndarray
    left: np.ndarray
    most: np.ndarray
    of_error: np.ndarray
    sigma: np.ndarray
    ball: Ball | None
    outlook: Outlook | None
    __repr__ = in_short


def long_run(machines: Machine, scheme: Scheme, task: Task, *, steps: int = 300) -> LongRun:
    """The claims alone, without the prediction and the simulation of trials; see `certify_each`."""
    check(first_of(machines), scheme, task)
    return in_groups(lambda some, task: _long_run(some, scheme, task, steps)[0], machines, task)


def certify(
    machine: Machine,
    scheme: Scheme,
    task: Task,
    trials: int,
    uncertainty: Uncertainty | None = None,
    drawn: Mapping[str, np.ndarray] | None = None,
    *,
    steps: int = 300,
) -> Certificate:
    """The certificate of each machine drawn, of which the first is nominal; see `certify_each`.

    uncertainty: distributions by path; without them there is the nominal machine only
    drawn: numbers of `uncertainty.draw`; without them 64 machines are drawn
    """
    check(machine, scheme, task)
    require("certify", "trials", trials, "[1, inf)", whole=True)
    uncertainty = uncertainty or {}
    if drawn is None:
        drawn = draw(machine, uncertainty, MACHINES)
    return certify_each(
        drawn_machines(machine, uncertainty, drawn), scheme, task, trials, steps=steps
    )


def certify_each(
    machines: Machine, scheme: Scheme, task: Task, trials: int, *, steps: int = 300
) -> Certificate:
    """The certificate of each of S machines, without noise where nothing is drawn for a trial.

    machines: one machine whose leaves have a leading axis of S
    trials:   J, of the prediction and of the simulation; claims do not depend on it
    steps:    largest number of steps of the Lanczos process

    Raises as `learn` does, and ValueError, before anything runs, for more machines or trials than
    fit into memory.
    """
    check(first_of(machines), scheme, task)
    require("certify", "trials", trials, "[1, inf)", whole=True)
    check_size("certify", COPIES, machines=count_of(machines), trials=trials)
    certified = partial(_certified, given=task, trials=trials, steps=steps)
    return in_groups(lambda some, task: certified(some, scheme, task), machines, task)


def _certified(
    machines: Machine, scheme: Scheme, task: Task, given: Task, trials: int, steps: int
) -> Certificate:
    run, course_of_draws = _long_run(machines, scheme, task, steps, trials)
    bounded = run.ball is not None and bool(np.any(np.isfinite(run.ball.error)))
    exact = linear_part(machines) if bounded else machines.unrounded()
    predicted = predict(exact, scheme, task, trials)
    runs, distance, variation = None, None, machines.variation
    if course_of_draws is not None or (variation is not None and variation.draws):
        keys = jax.random.split(jax.random.key(11), SEEDS)
        run_all = tiled_with(_simulate_runs, trials=trials)
        runs = np.asarray(run_all((scheme, task, keys), machines))
        simulated = np.sqrt(np.mean(runs**2, axis=1))
        if course_of_draws is not None:
            unknown = np.all(np.isnan(course_of_draws), axis=1, keepdims=True)
            predicted = np.where(unknown, predicted, course_of_draws)
    elif run.outlook is None:
        run_each = tiled_with(_simulate, trials=trials)
        simulated = np.asarray(run_each((scheme, given), machines))
    else:
        following = tiled_with(_follow, trials=trials, view=view_of(scheme, task))
        found = following((scheme, task), (machines, jnp.asarray(run.outlook.limit)))
        simulated, distance = map(np.asarray, found)
    floor, doubt = np.full((2, len(simulated)), np.nan)
    if run.outlook is not None:
        lasts = np.isin(run.claim, (MONOTONE, CONVERGES))
        none_left = run.of_error & (runs is None)
        found = run.outlook.floor, run.outlook.doubt
        floor, doubt = (np.where(lasts, np.where(none_left, 0.0, x), np.nan) for x in found)
    powers = np.ones(len(predicted), int) if run.outlook is None else run.outlook.decay.power
    ahead = np.where(run.of_error, np.nan, floor)
    peak, peak_trial = peaks(exact, scheme, task, predicted, powers, ahead)
    # the errors of experiments say nothing of what was learned
    each = trials_of_step(scheme, task)
    expected, observed = predicted[:, ::each], simulated[:, ::each]
    return Certificate(
        **run._asdict(),
        floor=floor,
        doubt=doubt,
        expected=np.array([course(e) for e in expected]),
        observed=np.array([course(e) for e in observed]),
        predicted=predicted,
        simulated=simulated,
        turning=1 + each * _best(expected),
        observed_turning=1 + each * _best(observed),
        growth=growth_of(expected),
        peak=peak,
        peak_trial=peak_trial,
        distance=distance,
        runs=runs,
    )


def _long_run(
    machines: Machine, scheme: Scheme, task: Task, steps: int, trials: int = 0
) -> tuple[LongRun, np.ndarray | None]:
    """The claims, and (S, J) root mean square errors of trials over all that is drawn for them."""
    rounding, machines = machines, linear_part(machines)
    machine = first_of(machines)
    broken = [p.detail for p in learning_premises(machine, scheme, task) if not p.held]
    if broken and begins_off(machine):
        broken = [begins_off(machine)]
    if not broken and changes_nothing(scheme, task):
        broken = ["the law changes nothing of what is played, so every trial is like the first"]
    view = view_of(scheme, task)
    ball = None if broken else ball_of(rounding, scheme, task, view)
    if ball is not None and len(view.moving) > LARGEST:
        broken = [MANY.format(ball.of[0])]
    if broken:
        size = count_of(machines)
        reason = np.full(size, broken[0], object)
        nothing, unknown = np.full(size, NOTHING), np.full(size, np.nan)
        no = np.zeros(size, bool), np.full(size, np.inf)
        sense = np.full(size, SURELY)
        return LongRun(nothing, reason, sense, unknown, unknown, *no, None, None), None
    maps = maps_of(machines, scheme, task, steps)
    astray = None if ball is None else ball.limits
    ahead = outlook_of(maps, astray)
    claim, reason, of_error, sigma = _claims(maps, ahead)
    sense, left = np.full(len(claim), SURELY, object), np.full(len(claim), np.nan)
    found, rms = LongRun(claim, reason, sense, left, left, of_error, sigma, ball, ahead), None
    if draws(machine):
        found, rms = _of_runs(machines, scheme, task, found, trials)
    if ball is not None:
        found = _within(found, ball)
    return found._replace(reason=machine.said_of_claims() + found.reason), rms


def _of_runs(
    machines, scheme, task, means: LongRun, trials: int
) -> tuple[LongRun, np.ndarray | None]:
    """The claims on single runs, where something is drawn, from those on the mean of all runs."""
    view, size = view_of(scheme, task), len(means.claim)
    # what is drawn before the last change is not followed, so it is not known where w begins
    limited = bool(limit_names(machines, scheme, task))
    strays = machines.last_change > 1 and limited
    alike, inputs = learned_alike(machines), len(view.moving)
    if inputs > LARGEST:
        if alike:
            said = f"; noise is followed for up to {LARGEST} inputs, not for {inputs}"
            sense = np.full(size, STILL, object)
            return means._replace(sense=sense, reason=means.reason + said), None
        said = f"what is drawn for each trial is followed for up to {LARGEST} inputs, not for "
        said += f"{inputs}; a claim needs a shorter trial or longer samples, and `sweep` draws runs"
        reason = np.full(size, said, object)
        no = np.zeros(size, bool)
        return means._replace(claim=np.full(size, NOTHING), reason=reason, of_error=no), None
    astray = None if means.ball is None else means.ball.limits
    in_norm = inputs > DENSE
    found = under_chance(machines, scheme, task, view, trials, astray=astray, in_norm=in_norm)
    claim, reason = means.claim.copy(), means.reason.copy()
    sense = np.array([one.sense for one in found], object)
    for i, one in enumerate(found):
        if not one.certain:
            claim[i], reason[i], sense[i] = _claim_on_runs(one, means.claim[i])
            if means.ball is not None:
                claim[i], reason[i] = NOTHING, DRAWN.format(means.ball.of[i])
        elif claim[i] != NOTHING:
            reason[i] = f"but for what is drawn, {reason[i]}"
        if claim[i] != NOTHING and (strays or not one.clear):
            claim[i], reason[i] = NOTHING, "a limit may be met in a trial that is drawn"
        elif claim[i] != NOTHING and limited:
            reason[i] += f"; no limit is met within {MARGIN:g} standard deviations"
        if means.ball is None and claim[i] in (MONOTONE, CONVERGES) and np.isfinite(one.most):
            reason[i] += f"; {GAUSSIAN if one.certain else MARKOV}"
    rms = np.stack([one.rms for one in found])
    return means._replace(
        claim=claim,
        reason=reason,
        sense=sense,
        left=np.array([one.left for one in found]),
        most=np.array([one.most for one in found]),
        of_error=means.of_error & np.array([one.certain for one in found]),
    ), rms


def _within(found: LongRun, ball: Ball) -> LongRun:
    """The claims on machines that round or have hysteresis, from those on their linear part."""
    until = ball.until(found.of_error, found.sigma)
    ball = ball._replace(error=np.fmin(ball.error, np.where(found.of_error, until, np.inf)))
    claim, reason = found.claim.copy(), found.reason.copy()
    ahead = cast(Outlook, found.outlook)
    for i in np.flatnonzero((claim != NOTHING) | ahead.decay.converges):
        what = ball.of[i]
        if claim[i] == DIVERGES:
            claim[i], reason[i] = NOTHING, f"{reason[i]}, but {what} may hide what would grow"
        elif not np.isfinite(ball.error[i]):
            claim[i], reason[i] = NOTHING, UNBOUNDED.format(what)
        elif claim[i] == NOTHING:
            continue
        elif claim[i] == MONOTONE:
            reason[i] += f", until it is at {until[i]:.4g}, within which {what} holds it"
        else:
            reason[i] += f", but for what {what} adds"
        if claim[i] != NOTHING and np.isfinite(found.most[i]):
            reason[i] += f"; {GAUSSIAN}"  # nothing is claimed of what is lost and rounded
    return found._replace(
        claim=claim,
        reason=reason,
        left=np.where(claim == NOTHING, np.nan, found.left + ball.error),
        most=np.where(claim == NOTHING, np.nan, found.most + ball.error),
        of_error=found.of_error & (claim == MONOTONE),
        ball=ball,
    )


def _claim_on_runs(one: UnderChance, of_mean: str) -> tuple[str, str, str]:
    """Claim, reason and sense; of_mean: the claim on the mean of all runs."""
    if one.claim == NOTHING and of_mean == DIVERGES:
        said = "the mean of all runs grows without bound, and their mean square at least as fast"
        return DIVERGES, f"{SQUARE}, {said}", SQUARE
    reason = one.reason if one.claim == NOTHING else f"{one.sense}, {one.reason}"
    return one.claim, reason, one.sense


def course(errors) -> str:
    """What an error curve (J,) does: one of `COURSES`."""
    if not np.all(np.isfinite(errors)) or errors[-1] > errors[0] * (1 + RISE):
        return GROWS
    if errors[-1] > (1.0 + GROWTH) * np.min(errors):
        return TURNS
    return NOT_ALWAYS if _rises(errors, errors[0]) else FALLS


# Of the schemes of a scenario
# --------------------------------------------------------------------------------------------------


class OfScheme(NamedTuple):
    """What theory says of one scheme.

    certificate: of each machine
    checked: the bounds of Cao 2019 and their premises; None for a scheme that has no such bounds
    seconds: that the certificate took
    since: number of the trial from which on nothing changes, where what is claimed begins
    """

    certificate: Certificate
    checked: Checked | None
    seconds: float
    since: int = 1


def certify_schemes(
    machine: Machine,
    schemes: Mapping[str, Scheme],
    task: Task,
    trials: int,
    uncertainty: Uncertainty,
    drawn: Mapping[str, np.ndarray],
    *,
    progress: Callable[[int, str], object] | None = None,
) -> dict[str, OfScheme]:
    """The certificate of every scheme that learns, with the premises of its bounds, by name.

    progress: called with the number of schemes done and the name of the next one
    Raises ValueError, before anything runs, where no scheme learns, or where the trials are too few
    for bounds to be checked, and whatever `certify` raises.
    """
    learning = {name: scheme for name, scheme in schemes.items() if scheme.learns}
    if not learning:
        raise ValueError(
            f"certify: none of {', '.join(schemes)} learns; there is nothing to certify"
        )
    for name, scheme in learning.items():
        if isinstance(scheme, FFDLMFAILC) and trials < NEEDED:
            allowed = f"[{NEEDED}, inf) of {name}, whose bounds are checked"
            raise ValueError(f"--trials {trials} is outside its allowed range {allowed}")
    found = {}
    for name, scheme in learning.items():
        if progress is not None:
            progress(len(found), name)
        start = time.perf_counter()
        certificate = certify(machine, scheme, task, trials, uncertainty, drawn)
        seconds, bounds = time.perf_counter() - start, None
        if isinstance(scheme, FFDLMFAILC):
            bounds = checked_machines(machine, scheme, task, trials, uncertainty, drawn)
        found[name] = OfScheme(certificate, bounds, seconds, machine.last_change)
    return found


# How it is done
# --------------------------------------------------------------------------------------------------


def _claims(maps: LearningMaps, ahead: Outlook):
    """(S,) claims and their reasons, whether they are of the error, and the deciding values."""
    size, decay = len(ahead.met), ahead.decay
    of_errors = np.full(size, np.inf)
    scheme, task = maps.scheme, maps.task
    if keeps_all(scheme, task):
        of_errors = np.where(ends_at_zero(maps), maps.error_norm(), np.inf)
    surely = 1 - ROUNDING * np.finfo(of_errors.dtype).eps
    of_error = (of_errors < surely) & ahead.clear
    monotone = of_error | (decay.monotone & ahead.clear)
    converges = decay.converges & ahead.clear & ~monotone
    diverges, drifts = np.zeros(size, bool), np.full(size, "", object)
    if not np.all(monotone | converges) and not limit_names(maps.machines, scheme, task):
        radius, doubt = maps.radius()
        beyond = radius - doubt > 1
        drifts = np.where(beyond, "", np.array(maps.drifts(), object))
        diverges = ~monotone & ~converges & (beyond | (drifts != ""))
    claim = np.select([monotone, converges, diverges], [MONOTONE, CONVERGES, DIVERGES], NOTHING)
    reason = [
        _reason(i, claim[i], of_error[i], of_errors[i], ahead, drifts[i]) for i in range(size)
    ]
    return claim, np.array(reason, object), of_error, np.where(of_error, of_errors, decay.norm)


def _reason(
    i: int, claim: str, of_error: bool, of_errors: float, ahead: Outlook, drifts: str
) -> str:
    if of_error:
        return f"the error falls to {share_words(of_errors)} of itself in every trial, or below"
    if claim == DIVERGES:
        return drifts or "an eigenvalue of the learning map lies beyond 1"
    if claim != NOTHING or not ahead.decay.converges[i]:
        return ahead.decay.told(i)
    return ahead.told(i)


def _rises(errors, first, least=0.0) -> bool:
    """Whether an error curve rises between two trials, by more than rounding, and above `least`."""
    before = np.maximum(errors[:-1], least)
    return bool(
        np.any(errors[1:] > before * (1 + RISE) + 1e-13 * first) or not np.all(np.isfinite(errors))
    )


def _best(errors) -> np.ndarray:
    """(S,) the index of the smallest error."""
    return np.argmin(np.nan_to_num(errors, nan=np.inf), axis=1)


# The conditions that papers print for a scheme
# --------------------------------------------------------------------------------------------------


def printed_conditions(
    scheme: Scheme, task: Task, machine: Machine | None = None
) -> dict[str, Condition]:
    """The conditions by their places in the papers; empty for a scheme of which none speaks.

    MILC 2024, Theorem 2, of norm-optimal learning, see `weights_condition`, and Xu 2024, eq. 36, of
    learning over sliding mode, see `printed_condition`. With a machine also Li 2020, eq. 9, of
    P-type learning over feedback, see `learning_condition`. That of Cao 2019 has many premises of a
    trial, see `bounds_of`.
    """
    law = scheme
    while (inner := getattr(law, "learning", getattr(law, "scheme", None))) is not None:
        law = inner
    if isinstance(law, NormOptimal):
        return {"MILC 2024, Theorem 2": weights_condition(law)}
    over_sliding = isinstance(scheme, WithFeedback) and isinstance(scheme.feedback, SMC | ASMC)
    if isinstance(law, ExponentialPD) and over_sliding:
        return {"Xu 2024, eq. 36": printed_condition(scheme, task).condition}
    if machine is not None and isinstance(scheme, WithFeedback) and _p_type(scheme.learning):
        return {"Li 2020, eq. 9": learning_condition(machine, scheme, task).condition}
    return {}


def _p_type(law: Scheme) -> bool:
    """Whether a law is w_{j+1} = w_j + phi e_j, with nothing else."""
    if not isinstance(law, PIDType) or law.lead or law.limit is not None:
        return False
    return not np.any([np.any(x) for x in (law.gamma_i, law.gamma_d, law.leak)])


# The error of each trial, as predicted and as simulated
# --------------------------------------------------------------------------------------------------

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
    least = np.minimum.accumulate(errors, axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        rises = np.where((errors == least) & np.isfinite(errors), 1.0, errors / least)
    return np.max(_finite_or_infinite(rises), axis=1)


def _finite_or_infinite(errors) -> np.ndarray:
    return np.where(np.isfinite(errors), errors, np.inf)


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
    """(R, J) root mean square errors of runs with all that is drawn, by their keys.

    As theory does, they begin when machine and reference have changed for the last time.
    """
    scheme, task, keys = common
    machine, task = machine.after_changes(task)
    return jax.vmap(lambda key: _error(learn(machine, scheme, task, trials, key=key)))(keys)


def _simulate(common, machine, *, trials):
    """(J,) root mean square errors of one machine as `learn` simulates them, without noise."""
    scheme, task = common
    machine, task = machine.noiseless().after_changes(task)
    return _error(learn(machine, scheme, task, trials))


def _follow(common, one, *, trials, view):
    """(J,) root mean square errors as simulated, and distances of what is played from a limit."""
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


# Where each trial starts from the end of the one before
# --------------------------------------------------------------------------------------------------

MOST = 4000  # numbers of a memory and a state together, whose map is made as a matrix


class CarriedRadius(NamedTuple):
    """What `carried_radius` found.

    claim: "converges", "diverges" or "not claimed"
    reason: on what it rests
    radius: spectral radius of the map; NaN where nothing is linear
    doubt: by how much rounding may have moved it
    """

    claim: str
    reason: str
    radius: float
    doubt: float


def carried_radius(machine: Machine, scheme: Scheme, task: Task) -> CarriedRadius:
    """Whether learning converges on a machine whose state is carried from trial to trial.

        (w_{j+1}, x_{j+1}[0]) = F(w_j, x_j[0])

    w is all that the scheme knows and x the state of plant, feedback and actuator, but what only
    tells of the past, such as a counter, on which no trial to come depends. Without noise
    and limits F is affine, if machine and law are, and then it converges if and only if its
    spectral radius is below 1. For `carried` = 1 that is the stability of repetitive control in
    blocks of one trial. Nothing is said of what happens before: the error may grow at first. Where
    samples are lost, late or cut off by chance, the radius is that of the mean of all runs, and
    nothing is claimed, since single runs may grow all the same.

    Raises ValueError for a machine that does not carry its state, and for one whose map would be a
    matrix of more than 4000 rows.
    """
    if not machine.carries:
        raise ValueError(
            "carried_radius: the machine starts each trial alike; allowed is one whose variation "
            "has `carried`; certify is for the others"
        )
    if trials_of_step(scheme, task) > 1:
        said = f"{type(scheme).__name__} makes experiments between its steps"
        return CarriedRadius(NOTHING, said, np.nan, np.nan)
    references = getattr(machine.variation, "references", None)
    if references is not None and not references.first:
        said = "the reference changes after every trial, and what is learned has no limit"
        return CarriedRadius(NOTHING, said, np.nan, np.nan)
    free, law = machine.unlimited().noiseless(), scheme.unlimited().prepared(task)
    key = jax.random.key(0)

    def begun(free, law, task):
        memory = law.initial_memory(task)
        return memory, first_start(free.sampled(task.dt), law, task, key)

    def turn(fixed, known):
        free, law, task = fixed
        memory, start = known
        trial, _, end = run_and_measure(free, law, task, memory, key, None, start)
        return (law.learn(memory, free.shown(trial, key)), end), trial.y, trial.u

    fixed = free, law, task
    whole, shape = jax.tree.flatten(begun(*fixed))
    acts = acting(turn, fixed, shape.unflatten(whole))
    flat, unravel = ravel_pytree([*itertools.compress(whole, acts)])
    if flat.size > MOST:
        raise ValueError(
            f"carried_radius: memory and state have {flat.size} numbers; allowed are {MOST}: take "
            "a shorter trial"
        )

    def following(fixed, z):
        moved = iter(unravel(z))
        known = [next(moved) if one else x for x, one in zip(whole, acts, strict=True)]
        after = jax.tree.leaves(turn(fixed, shape.unflatten(known))[0])
        return ravel_pytree([*itertools.compress(after, acts)])[0]

    why = obstacle(following, fixed, flat)
    if why:
        said = f"a trial and learning from it is no linear map, by {why}"
        return CarriedRadius(NOTHING, said, np.nan, np.nan)
    M = np.asarray(jax.jit(jax.jacfwd(following, argnums=1))(fixed, jnp.zeros_like(flat)))
    radius, doubt = radius_with_doubt(M)
    said = machine.said_of_claims() + (
        f"the largest eigenvalue of learning and carried state together is {radius:.6g}, as long "
        "as no limit is met"
    )
    claim = CONVERGES if radius + doubt < 1 else DIVERGES if radius - doubt > 1 else NOTHING
    variation = machine.variation
    assert variation is not None
    if variation.draws and not RecordMoments.of(variation, task.N + 1).certain:
        claim, said = NOTHING, f"of single runs nothing is known; in the mean of all runs {said}"
        said += ". A `sweep` draws runs"
    return CarriedRadius(claim, said, float(radius), float(doubt))
