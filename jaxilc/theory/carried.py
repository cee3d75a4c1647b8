"""Learning where each trial starts from the end of the one before, up to repetitive control."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from ..learning.machine import Machine
from ..learning.within_trial import first_start, run_and_measure
from ..plants.structure import obstacle
from ..schemes import Scheme
from ..schemes.parts import trials_of_step
from ..signals.task import Task
from .certificates import CONVERGES, DIVERGES, NOTHING
from .record_moments import RecordMoments
from .spectrum import radius_with_doubt

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

    w is all that the scheme knows and x the state of plant, feedback and actuator. Without noise
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
    free, law = machine.unlimited().noiseless(), scheme.unlimited().prepared(task)
    key = jax.random.key(0)

    def begun(free, law, task):
        memory = law.initial_memory(task)
        return memory, first_start(free.sampled(task.dt), law, task, key)

    flat, unravel = ravel_pytree(begun(free, law, task))
    if flat.size > MOST:
        raise ValueError(
            f"carried_radius: memory and state have {flat.size} numbers; allowed are {MOST}: take "
            "a shorter trial"
        )

    def following(fixed, z):
        free, law, task = fixed
        memory, start = unravel(z)
        trial, _, end = run_and_measure(free, law, task, memory, key, None, start)
        return ravel_pytree((law.learn(memory, free.shown(trial, key)), end))[0]

    fixed = free, law, task
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
