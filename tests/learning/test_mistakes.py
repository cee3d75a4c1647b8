"""A mistake in a user's own code is reported before anything is compiled, with what to do."""

import dataclasses
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import DT

from jaxilc.learning import Machine, feedforward, learn, next_memory, over_trials, run_trial
from jaxilc.plants import DifferenceEquation, Plant
from jaxilc.pytree import child, leaf, pytree
from jaxilc.schemes import PID, PIDType, Scheme, WithFeedback
from jaxilc.schemes.scheme import Feedforward
from jaxilc.signals import Task
from jaxilc.sweeps import Sweep
from jaxilc.tuning import Tuning
from jaxilc.tuning.objectives import Final
from jaxilc.uncertainty import Uniform, draw

N = 12
TASK = Task(np.sin(0.3 * np.arange(N + 1)), dt=DT)
PLANT = DifferenceEquation((0.7,), (0.3,), dt=DT)
MACHINE = Machine(PLANT)
SWEEP = partial(Sweep, MACHINE, schemes={"p": PIDType()}, task=TASK, trials=3, uncertainty={})
TUNING = partial(Tuning, MACHINE, PIDType(), TASK, trials=3, weights=["gamma_p"])


class M(NamedTuple):
    u: Any
    n: Any


class Reversed(NamedTuple):
    n: Any
    u: Any


@pytree
class Own(Scheme):
    """A test scheme adds the gain times the error, and counts trials in its memory."""

    gain: jax.Array = leaf(default=0.5)

    def initial_memory(self, task):
        return M(jnp.zeros((task.N, task.inputs)), jnp.zeros(()))

    def learn(self, memory, trial):
        return M(trial.u + self.gain * trial.e[1:], memory.n + 1)


def mine(of, **methods):
    """Return a user's own subclass, which has other methods."""
    return pytree(type("Mine", (of,), methods))


SHAPE = r"the u of its memory or schedule has shape {}; allowed is \(N, n_u\) = \(12, 1\)"
MISTAKES = {
    "fields": (
        mine(Own, initial_memory=lambda _, task: M(jnp.zeros(()), jnp.zeros((task.N, 1)))),
        "Mine: " + SHAPE.format(r"\(\)"),
    ),
    "axes": (
        mine(Own, initial_memory=lambda _, task: M(jnp.zeros((1, task.N)), jnp.zeros(()))),
        SHAPE.format(r"\(1, 12\)"),
    ),
    "rank": (
        mine(Own, initial_memory=lambda _, task: M(jnp.zeros(task.N), jnp.zeros(()))),
        SHAPE.format(r"\(12,\)"),
    ),
    "no_u": (
        mine(Own, initial_memory=lambda _, task: {"input": jnp.zeros((task.N, 1))}),
        r"Mine: act plays back the u .* give the memory a field u",
    ),
    "row": (
        mine(
            Own,
            act=lambda _, state, sample: (state, sample.row["u"]),
            schedule=lambda _, memory, task: {"u": memory.u, "n": memory.n},
        ),
        r"n of its schedule has shape \(\).* override schedule",
    ),
    "longer": (
        mine(Own, learn=lambda self, memory, trial: M(self.gain * trial.e, memory.n + 1)),
        r"Mine: learn makes u float64\[13, 1\] of float64\[12, 1\]",
    ),
    "type": (
        mine(Own, learn=lambda _, memory, trial: M(trial.u, jnp.asarray(memory.n + 1, int))),
        r"learn makes n int64\[\] of float64\[\]; .* initial_memory gives",
    ),
    "another": (
        mine(Own, learn=lambda _, memory, trial: Reversed(memory.n, trial.u)),
        r"Mine: learn makes a memory Reversed \(n, u\) of M \(u, n\)",
    ),
    "input": (
        mine(Own, act=lambda _, state, sample: (state, jnp.concatenate([sample.row.u] * 2))),
        r"act gives an input of shape \(2,\); allowed is \(n_u,\) = \(1,\)",
    ),
    "state": (
        mine(
            Own,
            act=lambda _, state, sample: (None, sample.row.u),
            initial_state=lambda *_: jnp.zeros(1),
        ),
        r"(Mine|WithFeedback): act makes a state .*initial_state gives",
    ),
}


@pytest.fixture(autouse=True)
def nothing_is_compiled(monkeypatch):
    def compiling(*args, **options):
        raise AssertionError("it came to compiling")

    monkeypatch.setattr(over_trials, "_program", lambda *_: compiling)


@pytest.mark.parametrize(("scheme", "message"), MISTAKES.values(), ids=MISTAKES)
def test_a_scheme_of_a_wrong_shape(scheme, message):
    for one in (scheme(), WithFeedback(scheme(), PID(kp=0.1))):
        with pytest.raises(ValueError, match=message):
            learn(MACHINE, one, TASK, 3)


@pytest.mark.parametrize(
    ("act", "message"),
    [
        (lambda *_: jnp.zeros(1), r"act gives array float64\[1\]; allowed is a pair \(state, u\)"),
        (
            lambda _, state, __: (state, [1.0]),
            r"act gives an input of shape list; allowed is \(n_u",
        ),
        (
            lambda _, state, __: (state, np.ones(1, int)),
            "act gives an input of int64; allowed is float64",
        ),
    ],
)
def test_an_input_of_a_wrong_kind(act, message):
    with pytest.raises(ValueError, match=f"Mine: {message}"):
        learn(MACHINE, mine(Own, act=act)(), TASK, 3)


def test_the_schedule_is_the_feedforward_alone_where_the_memory_has_one():
    schedule = Own().schedule(Own().initial_memory(TASK), TASK)
    assert schedule._fields == ("u",)
    with pytest.raises(AssertionError, match="it came to compiling"):
        learn(MACHINE, Own(), TASK, 3)


@pytree
class Gain(Plant):
    """The plant is y = gain x, where x is the last input."""

    gain: jax.Array = leaf(default=1.0)

    def initial_state(self):
        return jnp.zeros(1)

    def step(self, x, u, dt):
        return u

    def output(self, x):
        return self.gain * x


@pytest.mark.parametrize(
    ("methods", "message"),
    [
        (
            {"output": lambda self, x: self.gain * x[0]},
            r"Mine: the output has shape \(\); allowed is \(n_y,\) = \(1,\)",
        ),
        ({"output": lambda _, x: jnp.concatenate([x, x])}, r"Mine: the output has shape \(2,\)"),
        (
            {"step": lambda _, x, u, dt: jnp.concatenate([x, u])},
            r"Mine: a step makes a state of \(2,\) of one of \(1,\)",
        ),
        (
            {"initial_state": lambda _: jnp.zeros(1, int)},
            r"a step makes state float64\[1\] of int64\[1\]; .* what initial_state gives",
        ),
    ],
)
def test_a_plant_of_a_wrong_shape(methods, message):
    with pytest.raises(ValueError, match=message):
        learn(Machine(mine(Gain, **methods)()), PIDType(), TASK, 3)


class Undecorated(Scheme):
    gain: Any = leaf(default=0.5)


class UndecoratedBelow(PIDType):
    more: Any = leaf(default=0.5)


class UndecoratedPlant(Plant):
    gain: Any = leaf(default=0.5)


@dataclasses.dataclass
class Plain(Scheme):
    gain: float = 0.5


@pytest.mark.parametrize("cls", [Undecorated, UndecoratedBelow, UndecoratedPlant])
def test_a_forgotten_pytree(cls):
    for build in (cls, lambda: cls(gain=0.3) if cls is not UndecoratedBelow else cls(gamma_p=0.3)):
        with pytest.raises(ValueError, match=rf"write @pytree .* above `class {cls.__name__}`"):
            build()


def test_a_dataclass_that_is_no_pytree():
    @pytree
    class Around(Scheme):
        inner: Any = child()

    for scheme in (Plain(), Around(Plain())):
        with pytest.raises(ValueError, match=r"write @pytree .* above `class Plain`"):
            learn(MACHINE, scheme, TASK, 3)


def test_a_text_that_is_not_static():
    @pytree
    class Mode(Own):
        mode: str = "fast"

    with pytest.raises(ValueError, match=r"Mode: mode = 'fast' is text.* with static\(\)"):
        learn(MACHINE, Mode(), TASK, 3)


@pytree
class Bare(Own):
    """A test scheme has a number whose field is not declared."""

    share: float = 0.5


def test_a_number_that_is_no_leaf():
    scheme = Bare()
    grid = partial(SWEEP, schemes={"own": scheme})
    for attempt, named in (
        (lambda: Tuning(MACHINE, scheme, TASK, 3, ["share"]), "weights: share = 0.5 is no leaf"),
        (lambda: grid(grid={"own.share": [0.2, 0.5]}), "grid: share = 0.5 is no leaf of Bare"),
        (lambda: jax.grad(lambda x: Bare(share=x).gain)(0.5), "Bare: share is traced, and"),
    ):
        with pytest.raises(ValueError, match=rf"{named}.* with leaf\(\) \(from jaxilc.pytree\)"):
            attempt()


def test_what_learning_cannot_go_on_from():
    longer = Own().initial_memory(Task(np.zeros(N + 3), dt=DT))
    history = over_trials.History(*[None] * 7)
    for named, value, message in (
        ("memory", longer, r"memory.u is float64\[14, 1\]; Own and .* need float64\[12, 1\]"),
        ("memory", np.zeros((N, 1)), r"memory is array float64\[12, 1\]; .* need M \(u, n\)"),
        ("memory", history, r"memory is a History; allowed is .* history.memory"),
        ("start", np.zeros(1), r"start = .* rests before each trial, so allowed is None"),
        ("memory", "x", r"memory = 'x' is no memory, as history.memory is"),
        ("key", 3, r"key = 3 is no random key, as jax.random.key\(0\) is"),
        ("key", np.zeros(2), r"key = array\(\[0., 0.\]\) is no random key"),
    ):
        with pytest.raises(ValueError, match=message):
            learn(MACHINE, Own(), TASK, 3, **{named: value})


def test_a_single_trial_and_a_measured_one_need_what_fits():
    longer, two = Task(np.zeros(N + 3), dt=DT), Task(np.zeros((N + 1, 2)), dt=DT)
    law, key = PIDType(), jax.random.key(0)
    stale = law.initial_memory(longer)
    for call in (
        lambda: feedforward(law, TASK, stale),
        lambda: next_memory(law, TASK, stale, np.zeros(N + 1), np.zeros(N)),
        lambda: run_trial(MACHINE, law, TASK, stale, key),
    ):
        with pytest.raises(ValueError, match=r"memory.u is .*\[14, 1\]; PIDType and .*\[12, 1\]"):
            call()
    with pytest.raises(ValueError, match="the task has 2 inputs but the plant"):
        run_trial(MACHINE, law, two, None, key)
    with pytest.raises(ValueError, match=r"outputs = \(2,\) are not there; allowed are 0 to 1"):
        two.of_outputs((2,))
    three = Feedforward(jnp.zeros((3, N, 1)))  # traced, nothing is looked at
    assert jax.vmap(partial(feedforward, law, TASK))(three).shape == (3, N, 1)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"quantities": None}, "quantities = None is a NoneType; allowed are functions of a trial"),
        ({"quantities": [np.sum]}, r"quantities = \[<.*>\] is a list; allowed are functions"),
        ({"quantities": {3: np.sum}}, "quantity = 3: <.*>; allowed is text, and by it a function"),
        ({"quantities": {"own": 3}}, "quantity = 'own': 3; allowed is text, and by it a function"),
    ],
)
def test_what_is_no_quantity_by_its_name(change, message):
    for make in (SWEEP, TUNING):
        with pytest.raises(ValueError, match=message):
            make(**change)


def test_what_is_no_watch_no_names_of_weights_and_no_name_of_a_scheme():
    for attempt in (lambda: learn(MACHINE, Own(), TASK, 3, watch=3), lambda: SWEEP(watch=3)):
        with pytest.raises(ValueError, match="watch = 3 is a int; allowed is a Watch"):
            attempt()
    for weights in (None, 3):
        with pytest.raises(
            ValueError, match=rf"weights = {weights} is a .*; allowed are names, or"
        ):
            TUNING(weights=weights)
    with pytest.raises(ValueError, match="schemes has the name 3; allowed is text"):
        SWEEP(schemes={3: PIDType()})


def test_a_plant_in_place_of_a_machine():
    with pytest.raises(ValueError, match=r"is a DifferenceEquation; .*: write Machine\(plant\)"):
        learn(PLANT, PIDType(), TASK, 3)


def test_a_scheme_in_place_of_schemes_by_name():
    with pytest.raises(ValueError, match=r"is a PIDType; .* such as \{'name': scheme\}"):
        Sweep(MACHINE, PIDType(), TASK, 3, {"plant.b": Uniform(0.9, 1.1, relative=True)})


def test_a_pair_in_place_of_a_distribution():
    pair = {"plant.b": (0.9, 1.1)}
    message = r"plant.b = \(0.9, 1.1\) is no distribution; .* such as Uniform\(0.9, 1.1, relative"
    for attempt in (
        lambda: Sweep(MACHINE, {"p": PIDType()}, TASK, 3, pair),
        lambda: Tuning(MACHINE, PIDType(), TASK, 3, ["gamma_p"], pair, Final("rms")).run(),
        lambda: draw(MACHINE, pair, 3),
    ):
        with pytest.raises(ValueError, match=message):
            attempt()
