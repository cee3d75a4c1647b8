"""Constructors get invalid values.

Each raises a ValueError, or makes an object that the later checks can handle. fuzz.py says how to
run more cases.
"""

import dataclasses

import jax
import numpy as np
from cases import CASES, DT, case
from fuzz import HOSTILE, fuzz, pick

from jaxilc import learning
from jaxilc.learning import Actuator, Disturbance, Machine, Sensor
from jaxilc.plants import StateSpace
from jaxilc.schemes import PIDType
from jaxilc.signals import Task
from jaxilc.sweeps import Sweep
from jaxilc.tuning import Tuning, objectives, risks
from jaxilc.uncertainty import LogUniform, Normal, Uniform, check, with_spread

NAMES = list(CASES)
STATIC = StateSpace([[0.0]], [[1.0]], [[1.0]], dt=DT)
PLAN = (
    Machine(STATIC),
    {"ilc": PIDType(gamma_p=0.5)},
    Task(np.ones(5), dt=DT),
    2,
    {"plant.B": Uniform(0.9, 1.1, relative=True)},
)


def with_parts(machine):
    """Return the same machine with an actuator, sensors and disturbances, to test these too."""
    parts = {
        "actuator": Actuator(3.0, 500.0, 0.01),
        "sensor": Sensor(1e-6, 1e-6),
        "disturbance": Disturbance(input_noise=1e-3),
    }
    return dataclasses.replace(machine, **parts)


def mutated(rng, tree, changes=1):
    """Return the tree with one of its fields, or a field of one of its parts, made invalid."""
    for _ in range(changes):
        tree = _mutated(rng, tree)
    return tree


def _mutated(rng, tree):
    names = [f.name for f in dataclasses.fields(tree)]
    parts = [name for name in names if dataclasses.is_dataclass(getattr(tree, name))]
    if parts and rng.random() < 0.7:
        name = pick(rng, parts)
        return dataclasses.replace(tree, **{name: _mutated(rng, getattr(tree, name))})
    return dataclasses.replace(tree, **{pick(rng, names): pick(rng, HOSTILE)}) if names else tree


def test_plants_schemes_and_tasks():
    def attempt(rng):
        machine, scheme, task = case(pick(rng, NAMES))
        asked = {"machine": with_parts(machine), "scheme": scheme, "task": task}
        for name in ("machine", "scheme", "task")[: 1 + rng.integers(2)]:
            name = pick(rng, list(asked))
            asked[name] = mutated(rng, asked[name])
        learning.check(**asked)
        if rng.random() < 0.05:
            jax.eval_shape(lambda: learning.learn(**asked, trials=2))

    assert fuzz(150, attempt) > 5


WORDS = [x for x in HOSTILE if isinstance(x, str)]
DISTRIBUTIONS = (
    Uniform(0.9, 1.1, relative=True),
    Normal(1.0, 0.1, relative=True),
    LogUniform(0.5, 2.0, relative=True),
)


def test_distributions():
    def attempt(rng):
        distribution = mutated(rng, pick(rng, DISTRIBUTIONS), rng.integers(3))
        assert np.all(np.isfinite(distribution.quantile(rng.random(3))))
        match rng.integers(3):
            case 0:
                names = (
                    "plant.B",
                    "plant.B[0][0]",
                    "plant.x0",
                    "actuator",
                    "plant",
                    "sensor.noise",
                )
                check(PLAN[0], {pick(rng, names if rng.random() < 0.7 else WORDS): distribution})
            case 1:
                check(PLAN[0], pick(rng, [{"plant.B": pick(rng, HOSTILE)}, pick(rng, HOSTILE)]))
            case _:
                with_spread(
                    {"plant.B": distribution}, pick(rng, (0.1,) if rng.random() < 0.5 else HOSTILE)
                )

    assert fuzz(200, attempt) > 5


SWEEP = Sweep(*PLAN, machines=3, chunk=2, lanes=2)
TUNING = Tuning(
    PLAN[0], PLAN[1]["ilc"], *PLAN[2:4], ["gamma_p"], PLAN[4],
    machines=2, held_out=2, steps=2, validate_every=1, patience=2, lanes=2,
)  # fmt: skip
OF_A_SWEEP = [f.name for f in dataclasses.fields(Sweep)][:11]  # up to the lanes
OF_A_TUNING = ["uncertainty"]
OF_A_TUNING += [
    f.name for f in dataclasses.fields(Tuning) if f.type in ("int", "float", "int | None")
]
# Another test limits how large they may be.
SMALL = [x for x in HOSTILE if not (isinstance(x, int) and x > 1000)]


def test_sweeps_tunings_and_numbers_of_trials():
    def attempt(rng):
        match rng.integers(3):
            case 0:
                dataclasses.replace(SWEEP, **{pick(rng, OF_A_SWEEP): pick(rng, SMALL)})
            case 1:
                dataclasses.replace(TUNING, **{pick(rng, OF_A_TUNING): pick(rng, SMALL)})
            case _:
                trials = [x for x in HOSTILE if not (isinstance(x, int) and x == 10**6)][:40]
                learning.learn(PLAN[0], PLAN[1]["ilc"], PLAN[2], pick(rng, trials))

    fuzz(60, attempt)


OBJECTIVES = (
    objectives.Final(),
    objectives.EveryTrial(),
    objectives.Holding(),
    objectives.TrialsTo(0.1),
    objectives.Growth(),
    objectives.Effort(),
    objectives.InputRate(),
    objectives.Contraction(),
    objectives.D2(),
    risks.CVaR(),
    risks.SmoothMax(),
)


def test_objectives_and_risks():
    fuzz(200, lambda rng: mutated(rng, pick(rng, OBJECTIVES)))
