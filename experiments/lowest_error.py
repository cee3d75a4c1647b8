"""The lowest errors that were found, for the cases in which tuning misses its target."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

import jaxilc
from jaxilc.learning import Keep
from jaxilc.schemes import Scheme
from jaxilc.tuning import Tuning
from jaxilc.uncertainty import draw, drawn_machine


def lowest_of(
    s,
    judged: tuple[str, tuple[int, ...]],
    problem: Tuning,
    scheme: Scheme,
    machines: int,
    seed: int,
) -> tuple[float, float]:
    """The error of the ideal input with noise and quantisation, and its error without them.

    Both are medians over machines that were not used in the tuning. The ideal input is learned on a
    machine without converter step, encoder step and noise, until its error is a fraction of the
    error with them. It is then played on the real machine with the same feedback. This is not a
    lower bound: an input that takes the converter's codes into account may have a lower error.

    judged: metric, and the trials that are shown
    machines, seed: number of drawn machines, and their seed
    """
    metric, trials = judged
    drawn = {
        name: jnp.asarray(v)
        for name, v in draw(problem.machine, problem.uncertainty, machines, seed=seed).items()
    }
    keys = jax.random.split(jax.random.key(seed), machines)

    def played(_, plant):
        values, key = plant
        machine = drawn_machine(problem.machine, problem.uncertainty, values)
        actuator = machine.actuator and dataclasses.replace(machine.actuator, resolution=None)
        ideal = dataclasses.replace(machine, actuator=actuator, sensor=None)
        learned = jaxilc.learn(
            ideal, scheme, problem.task, 3 * max(trials), save=Keep.of(s.functions)
        )
        once = jaxilc.learn(
            machine,
            scheme,
            problem.task,
            1,
            memory=learned.memory,
            key=key,
            save=Keep.of(s.functions),
        )
        return [
            jnp.max(h.saved[metric][-1] if metric in s.functions else getattr(h, metric)[-1])
            for h in (once, learned)
        ]

    return tuple(
        s.shown_scale * float(np.median(x)) for x in jaxilc.tiled(played)(0.0, (drawn, keys))
    )


def best_of_one_move(s, seed: int, machines: int = 33) -> float:
    """The least median error at 0.5 Hz of CFDL-MFAPC with P_u = 1, by frequency response.

        u[k] = u[k-1] + K (mean r[k+1..k+P] - y[k])
        e = 1 - L / (1 + L) mean z^i,   L = K z / (z - 1) G

    The minimum is taken over all P <= 500 and all gains K with which the loop is stable.

    seed, machines: seed of the drawn machines, and their number
    """
    drawn = draw(s.machine, s.uncertainty, machines, seed=seed)
    sampled = jax.vmap(
        lambda v: drawn_machine(s.machine, s.uncertainty, v).plant.sampled(s.task.dt)
    )(jax.tree.map(jnp.asarray, drawn))
    ones = np.ones((machines, 1))
    a, b = np.hstack([ones, -np.asarray(sampled.a)]), np.hstack([0 * ones, np.asarray(sampled.b)])
    z, best = np.exp(1j * np.pi * s.task.dt), np.inf
    G = (b @ z ** -np.arange(4.0)) / (a @ z ** -np.arange(4.0))
    means = np.cumsum(z ** np.arange(1, 501)) / np.arange(1, 501)
    for K in -np.geomspace(3e-4, 0.05, 80):
        closed = [
            np.polyadd(np.convolve([1.0, -1.0], a_i), np.append(K * b_i, 0.0))
            for a_i, b_i in zip(a, b, strict=True)
        ]
        L = K * z / (z - 1) * G
        e = np.abs(1 - (L / (1 + L))[:, None] * means)
        e[[np.max(np.abs(np.roots(p))) >= 1 for p in closed]] = np.inf
        best = min(best, np.min(np.median(e, axis=0)))
    return s.shown_scale * float(best)
