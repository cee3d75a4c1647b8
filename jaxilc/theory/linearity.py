"""The premises under which linear theory is more than a prediction.

Each is read off the program of the part that it is about:

    invariant_loop  a sample: state and input -> next state, the same at each sample
    linear_trial    a trial: what is played -> the output
    linear_law      learning: what is known, and a trial -> what is known next, the same in each
                    trial

Limits are left out of all of them (`unlimited`): as long as none is met, they change nothing.
Whether one is met is for `outlook` to say.
"""

from __future__ import annotations

from collections.abc import Collection

import jax
import jax.numpy as jnp
import numpy as np

from ..learning.machine import Machine
from ..learning.playback import replay
from ..learning.variation import Variation
from ..plants.structure import depends, obstacle
from ..schemes import Scheme, WithFeedback
from ..schemes.scheme import UNASKED, Memory, trials_of_step, with_all_parts
from ..signals.task import Task, Trial
from .condition import Premise, premise
from .loop import tick_of
from .trials import learned_shape, next_learned, played, step

ONE_LAW = "learning law linear and the same in each trial"
LINEAR = "machine and feedback linear"
ONE_TRIAL = "what is learned follows from the last trial alone"
INVARIANT = "loop linear and time invariant"
EACH_ALIKE = "each trial starts alike and is learned from alike"
# The numbers of a variation with which each trial starts at rest, and its record is a whole one.
WHOLE = {"carried": 0, "shortest": 1, "dropped": 0, "late": 0, "delayed": 0}


def linear_law(scheme: Scheme, task: Task, memory: Memory = None) -> Premise:
    """The premise that learning is an affine map, the same after every trial.

    The map goes from what a scheme knows, and from a trial, to what it knows next. An estimator, a
    rule that stops or switches the learning, or learning only in some of the trials breaks it.
    """
    free, what = scheme.unlimited(), type(scheme).__name__
    memory = scheme.initial_memory(task) if memory is None else memory
    shape = learned_shape(scheme, task)
    if shape is None:
        return premise(ONE_LAW, False, f"{what} learns no feedforward")
    if trials_of_step(scheme, task) > 1:
        found = f"{what} makes experiments between its steps; a GradientILC can be certified"
        return premise(ONE_LAW, False, found)
    trial = free.record(jnp.zeros(shape), jnp.zeros((task.N + 1, task.outputs)), task)
    signals = {"u": trial.u, "y": trial.y, "signals": trial.signals}

    def learned(fixed, varying):
        (scheme, task), (memory, signals) = fixed, varying
        shown = trial._replace(r=jnp.asarray(task.reference), **signals)
        following = scheme.learn(memory, shown)
        return following, scheme.feedforward(following, task)

    why = obstacle(learned, (free.prepared(task), task), (memory, signals))
    found = f"{what} learns by {why}" if why else f"{what}, read off its program"
    return premise(ONE_LAW, not why, found)


def linear_trial(
    machine: Machine, scheme: Scheme | None, task: Task, *, memory: Memory = None
) -> Premise:
    """The premise that the output of a trial is an affine function of what is played in it."""
    free = None if scheme is None else scheme.unlimited()
    memory = memory if scheme is None or memory is not None else scheme.initial_memory(task)
    shape = learned_shape(scheme, task) or (task.N, task.inputs)
    fixed = machine.unlimited(), free, task, memory
    why = obstacle(lambda fixed, w: played(*fixed, w).y, fixed, jnp.zeros(shape))
    if not why:
        return premise(LINEAR, True, "read off their programs")
    return premise(LINEAR, False, nonlinear_part(machine, scheme, task, memory) or why)


def nonlinear_part(
    machine: Machine, scheme: Scheme | None, task: Task, memory: Memory = None
) -> str:
    """Which part of a trial is not linear, and by what, in words; empty if every part is."""
    why = obstacle(output_alone, (machine.unlimited(), task), jnp.zeros((task.N, task.inputs)))
    if why:
        return f"the machine ({type(machine.plant).__name__}) answers its input by {why}"
    if scheme is None:
        return ""
    memory = scheme.initial_memory(task) if memory is None else memory
    fixed, y = (scheme.unlimited(), task, memory), jnp.zeros((task.N + 1, task.outputs))
    why = obstacle(lambda fixed, y: replay(*fixed, y)[0], fixed, y)
    return f"{type(scheme).__name__} acts within the trial by {why}" if why else ""


def invariant_loop(machine: Machine, scheme: Scheme | None, task: Task) -> Premise:
    """The premise that machine and feedback do the same linear thing at each sample.

    Only then does `linear_loop` hold for all samples.
    """
    free = None if scheme is None else scheme.unlimited()
    tick, fixed, varying = tick_of(machine.unlimited(), free, task)
    why = obstacle(tick, fixed, varying)
    if why:
        part = nonlinear_part(machine, scheme, task)
        why = part or f"{why}, which makes it another loop at each sample"
    return premise(INVARIANT, not why, why or "read off the program of a sample")


def learning_premises(machine: Machine, scheme: Scheme, task: Task) -> tuple[Premise, Premise]:
    """The premises that a trial and learning from it are one affine map, the same in every trial.

    The map is of all that the scheme knows. The first premise is of the trial, the second of
    learning, so that the part that breaks one is named.
    """
    found = linear_trial(machine, scheme, task), linear_law(scheme, task)
    alike = alike_trials(machine, scheme, task)
    if not alike.held:
        return found[0], premise(ONE_LAW, False, alike.detail)
    fixed = machine.unlimited(), scheme.unlimited().prepared(task), task
    whole = obstacle(lambda fixed, memory: step(*fixed, memory), fixed, scheme.initial_memory(task))
    if whole and all(p.held for p in found):
        said = f"a trial and learning from it is no linear map, by {whole}"
        return found[0], premise(ONE_LAW, False, said)
    return found


def alike_trials(machine: Machine, scheme: Scheme, task: Task) -> Premise:
    """The premise that a trial and its learning are one map in each, where its means are taken."""
    differs = "" if machine.variation is None else _differing(machine.variation, scheme, task)
    return premise(EACH_ALIKE, not differs, differs or machine.said_of_claims().removesuffix(": "))


def whole_trials(machine: Machine, scheme: Scheme, task: Task) -> Premise:
    """The premise of conditions on frequency: trials are alike, and each record is a whole one."""
    alike, found = alike_trials(machine, scheme, task), not_whole(machine)
    return alike if not alike.held or not found else premise(EACH_ALIKE, False, found)


def not_whole(machine: Machine, uncertain: Collection[str] = ()) -> str:
    """What of a variation couples a frequency with others, with its value; empty if nothing.

    uncertain: names of leaves that differ from machine to machine
    """
    found = []
    for name, without in WHOLE.items():
        value = getattr(machine.variation, name, None)
        if f"variation.{name}" in uncertain:
            found.append(f"an uncertain variation.{name}")
        elif value is not None and value != without:
            found.append(f"variation.{name} = {value}")
    return ", ".join(found)


def _differing(variation: Variation, scheme: Scheme, task: Task) -> str:
    """Why no map of a trial is the same in each, although its means are taken; empty if one is."""
    if variation.carried is not None:
        return (
            "each trial starts with a share (`carried`) of the state in which the one before has "
            "ended, so learning is no map of what is learned alone; leave `carried` out where it "
            "is 0, else see theory.carried_radius"
        )
    if variation.references is not None and not variation.references.first:
        return "the reference changes after every trial, and what is learned has no limit"
    lost = variation.dropped is not None or variation.shortest is not None
    for part, _, _ in with_all_parts(scheme, task):
        if lost and getattr(part, "weighs", False):
            return (
                f"{type(part).__name__} is another law for each set of samples that are measured, "
                "so its mean is not that of mean samples; `sweep` draws its runs, and a law "
                "without a model is the same for each set"
            )
    return ""


def remembers(scheme: Scheme, task: Task) -> bool:
    """Whether what is learned depends on more than what the last trial played, and its error.

    It may depend on earlier trials, estimates or counters, also of what is played beside it, such
    as by a feedback that learns, or on what a feedback did.
    """
    return bool(_learned_from_too(scheme, task))


def _learned_from_too(scheme: Scheme, task: Task) -> str:
    """From what a scheme learns beside the signal that it played, and its error, in words."""
    free, still = scheme.unlimited().prepared(task), jnp.zeros(learned_shape(scheme, task))

    def learned(fixed, memory):
        scheme, task = fixed
        following = scheme.learn(memory, _recorded(scheme, task))
        return scheme.feedforward(following, task), scheme.play(still, memory, task)

    if depends(learned, (free, task), free.initial_memory(task)):
        return "earlier trials"

    def seeing(fixed, beside):
        learning, task = fixed
        trial = _recorded(learning, task)
        shown = trial._replace(signals=trial.signals | {"beside": beside})
        return learning.learn(learning.initial_memory(task), shown)

    for part, seen, _ in with_all_parts(free, task):
        if isinstance(part, WithFeedback):
            own = part.parts(seen, UNASKED)["learning"]
            if depends(seeing, (own.scheme, own.task), jnp.zeros((seen.N, seen.inputs))):
                return "what the feedback does"
    return ""


def _recorded(scheme: Scheme, task: Task) -> Trial:
    """The record of a trial in which nothing was played, and which has no error."""
    shape = learned_shape(scheme, task) or (task.N, task.inputs)
    trial = scheme.record(jnp.zeros(shape), jnp.zeros((task.N + 1, task.outputs)), task)
    return trial._replace(r=jnp.asarray(task.reference))


def of_last_trial(scheme: Scheme, task: Task) -> Premise:
    """The premise that what is learned follows from the last trial alone.

    Without it, |Q (keep - L P)| of the last trial says nothing: learning from several trials
    converges or not by the roots of a polynomial at each frequency (`HigherOrder`).
    """
    more, name = _learned_from_too(scheme, task), type(scheme).__name__
    found = f"{name} learns from {more} too" if more else f"{name}, read off its program"
    return premise(ONE_TRIAL, not more, found)


def keeps_all(scheme: Scheme, task: Task, *, off: bool = False) -> bool:
    """Whether a trial without error changes nothing of what is learned: no filter, no leak.

    off: with an error at k = 0 all the same, which no input can reach; a derivative of the error
         reads it

    It is looked at for a random input, which is enough for a linear law.
    """
    if remembers(scheme, task):
        return False
    free = scheme.unlimited().prepared(task)
    random = np.random.default_rng(6)
    w = random.standard_normal(learned_shape(scheme, task))
    e0 = random.standard_normal(task.outputs) * off
    kept = _after_no_error(free, task, w, e0)  # an array of JAX, from which w is taken as rounded
    return bool(np.max(np.abs(kept - w)) <= 1e-12 * np.max(np.abs(w)))


@jax.jit
def _after_no_error(scheme, task, w, e0):
    return next_learned(
        scheme, task, scheme.initial_memory(task), w, jnp.zeros((task.N, task.outputs)), e0
    )


def output_alone(fixed, u):
    """(N+1, n_y) the output of a machine without a scheme."""
    machine, task = fixed
    return played(machine, None, task, None, u).y
