"""A description tells apart what has other numbers, and nothing else; old ones are understood."""

import abc
import json
import logging
import math
import threading
import types
from collections import deque
from fractions import Fraction
from functools import partial
from operator import methodcaller
from typing import Protocol

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from scipy.interpolate import CubicSpline
from scipy.stats import norm

from jaxilc.learning import Machine
from jaxilc.plants import Plant, ProcessModel
from jaxilc.pytree import Leaf, leaf, pytree
from jaxilc.runtime.provenance import (
    CODE,
    CONSTANTS,
    describe,
    differences,
    environment,
    need_described,
)
from jaxilc.schemes import PID, Feedforward, Scheme
from jaxilc.signals import Task
from jaxilc.tuning.descent import Folder


def own_law(power):
    """Return a user's law, whose code is another for another power of the error."""

    class Own(Scheme):
        gain: Leaf = leaf(default=0.5)

        if power == 1:

            def learn(self, memory, trial):
                return Feedforward(trial.u + self.gain * trial.e[1:])

        else:

            def learn(self, memory, trial):
                return Feedforward(trial.u + self.gain * trial.e[1:] ** 3)

    return pytree(Own)()


def test_a_user_s_law_is_known_by_its_code():
    once, again, other = (describe(own_law(power)) for power in (1, 1, 3))
    assert once == again
    (line,) = differences({"law": once}, {"law": other})
    assert line.startswith(f"law.{CODE}: ")
    earlier = {name: value for name, value in once.items() if name not in (CODE, CONSTANTS)}
    assert differences(earlier, other) == []
    assert not {CODE, CONSTANTS} & {*describe(PID())}


LINE = np.arange(5.0)
APART = [  # what makes objects, and arguments of which it makes two that differ
    (lambda k: jax.vmap(lambda x: k * x), (1.0,), (2.0,)),
    (lambda k: jax.grad(lambda x: k * x), (1.0,), (2.0,)),
    (lambda k: jax.checkpoint(lambda x: k * x), (1.0,), (2.0,)),
    (lambda k: jax.jit(jax.vmap(lambda x: k * x)), (1.0,), (2.0,)),
    (lambda of: of, (lambda trial: jnp.max(trial.e),), (lambda trial: jnp.min(trial.e),)),
    (lambda of: of, (lambda slope: -0.1 * slope,), (lambda slope: -0.2 * slope,)),
    (jax.nn.initializers.constant, (2.0,), (3.0,)),
    (optax.rmsprop, (0.1,), (0.2,)),
    (lambda n: optax.adam(optax.cosine_decay_schedule(0.1, n)), (20,), (30,)),
    (lambda k: optax.chain(optax.clip(k), optax.sgd(0.1)), (1.0,), (2.0,)),
    (lambda k: optax.inject_hyperparams(optax.sgd)(learning_rate=k), (0.1,), (0.2,)),
    (CubicSpline, (LINE, LINE**2), (LINE, LINE**3)),
    (slice, (0, 10), (40, 50)),
    (range, (10,), (11,)),
    (set, ("abc",), ("abd",)),
    (frozenset, ([1, 2],), ([1, 3],)),
    (bytes, ([1],), ([2],)),
    (deque, ([1],), ([2],)),
    (Fraction, (1, 2), (1, 3)),
    (lambda k: methodcaller("clip", max=k), (1,), (2,)),
    (partial(getattr, jnp), ("add",), ("multiply",)),
    (partial(getattr, np), ("sin",), ("cos",)),
]


@pytest.mark.parametrize(("make", "one", "other"), APART)
def test_what_a_function_closes_over_is_told_from_others(make, one, other):
    def described(arguments):
        held = make(*arguments)
        return json.dumps(describe(lambda trial: held))

    assert described(one) == described(one) != described(other)
    assert " at 0x" not in described(one)


def test_plain_functions_are_described_as_before():
    """So that the stores of earlier versions go on."""
    power, bend, clip, kind = 2.0, jnp.tanh, jax.nn.relu, np.dtype("float32")
    found = describe(lambda trial: clip(bend(trial.e.astype(kind))) ** power)
    of_kind = {"name": "numpy.dtypes.Float32DType", "attributes": {}}
    assert found["closes over"] == ["jax.numpy.tanh", f"{clip.__module__}.relu", of_kind, power]
    assert found.keys() == {"name", "body", "settings", "closes over"}


@pytest.mark.parametrize("wrapped", ["jax.jit", ""])
def test_a_function_is_known_wherever_its_file_is(wrapped):
    def made(level, file):
        names = {"jax": jax, "level": level}
        text = f"def make(k):\n    return {wrapped}(lambda trial: k * trial.e)\n"
        exec(compile(file.count("/") * "\n" + text, file, "exec"), names)
        return describe(names["make"](level))

    assert made(1.0, "one.py") == made(1.0, "in/another/one.py") != made(2.0, "one.py")


@pytest.mark.parametrize(
    ("setting", "value"), [("jax_default_prng_impl", "rbg"), ("jax_threefry_partitionable", False)]
)
def test_numbers_drawn_in_another_way_are_of_another_environment(setting, value):
    usual, before = environment(), getattr(jax.config, setting)
    first = float(jax.random.normal(jax.random.key(0), (3,))[2])
    jax.config.update(setting, value)
    try:
        assert float(jax.random.normal(jax.random.key(0), (3,))[2]) != first
        (line,) = differences(usual, environment())
    finally:
        jax.config.update(setting, before)
    assert line.startswith("random: None there, ")
    assert environment() == usual
    assert "random" not in usual


def test_a_store_of_what_cannot_be_told_from_others_is_refused(tmp_path):
    lock = threading.Lock()
    with pytest.raises(ValueError, match=r"quantities\.q\.closes over\[0\] holds a _thread\.lock"):
        Folder(tmp_path / "state", {"quantities": {"q": describe(lambda trial: lock)}}, False)
    assert not (tmp_path / "state").exists()
    for held in (deque([lock]), types.SimpleNamespace(lock=lock)):
        with pytest.raises(ValueError, match=r"q\.closes over\[0\].* holds a _thread\.lock"):
            need_described({"q": describe(held_by(held))})
    told = {"q": describe(held_by(types.SimpleNamespace(lock=lock, level=2.0)))}
    need_described(told)
    assert differences(told, {"q": describe(held_by(types.SimpleNamespace(lock=lock, level=3.0)))})


def held_by(held):
    return lambda trial: held


class Cached:
    """An object that stores its level alone, and fills a cache as it is used."""

    def __init__(self, level):
        self.level, self.cache = level, {"lock": threading.Lock()}

    def __reduce__(self):
        return Cached, (self.level,)


class Kept(Cached):
    """One that says what it stores by its state."""

    __reduce__ = object.__reduce__

    def __getstate__(self):
        return {"level": self.level}


@pytest.mark.parametrize("kind", [Cached, Kept])
def test_what_an_object_does_not_store_is_no_part_of_its_description(kind):
    one, used, other = kind(1.0), kind(1.0), kind(2.0)
    used.cache["limit"] = 7.0
    first, same, another = (describe(held_by(held)) for held in (one, used, other))
    assert first == same != another
    need_described(first)


class Told(Protocol):
    def about(self) -> str: ...


@pytest.mark.parametrize("above", [abc.ABC, Told])
def test_what_python_writes_into_a_class_is_none_of_its_constants(above, tmp_path):
    class Own(PID, above):
        pass

    law = describe(pytree(Own)())
    assert law[CONSTANTS] == {}
    Folder(tmp_path / "state", {"law": law}, resume=False)
    written = {"_abc_impl": {"name": "_abc._abc_data", "attributes": {}}, "_is_protocol": False}
    assert differences({**law, CONSTANTS: written}, law) == []


def test_a_distribution_is_described_alike_in_each_process():
    """It holds the global generator of NumPy, which each process seeds anew."""
    first = describe(held_by(norm(0, 1)))
    norm.rvs(size=3)
    again, other = (describe(held_by(norm(0, of))) for of in (1, 2))
    assert differences({"q": first}, {"q": again}) == []
    assert describe(np.random.RandomState(1)) != describe(np.random.RandomState(2))
    (line,) = differences({"q": first}, {"q": other})
    assert line == "q.closes over[0].attributes.args: [0, 1] there, [0, 2] here"


def test_a_long_difference_is_told_from_where_it_begins():
    assert differences({"q": [math.nan]}, {"q": [float("nan")]}) == []
    one, other = ([[0.5] * 100 + [of], 1] for of in (2.0, 3.0))
    (line,) = differences({"q": one}, {"q": other})
    there, here = line.split(" there, ")
    assert "0.5, 2.0], 1]" in there
    assert "0.5, 3.0], 1]" in here
    assert len(line) < 300


def test_an_earlier_store_with_the_place_of_a_jitted_function_goes_on():
    found = describe(jax.jit(lambda trial: trial.e))
    place = {"class": "JitInfo", "fun_sourceinfo": "make at a.py:3"}
    earlier = {**found, "attributes": {**found["attributes"], "_jit_info": place}}
    for held in (lambda of: of, lambda of: {"settings": [[of, 2.0], None]}):
        assert differences({"q": held(earlier)}, {"q": held(found)}) == []


def own_plant(**constants):
    """Return a user's plant, of one code whatever its constants are."""
    step = {"step": lambda self, x, u, dt: self._pole * x + u, "output": lambda self, x: x}
    return pytree(type("Own", (Plant,), {**step, **constants}))()


def test_a_user_s_plant_is_known_by_the_constants_of_its_class():
    """Also where the class had none, or where a constant is a function with other arguments."""
    first = describe(own_plant(_pole=0.8))
    assert differences(first, describe(own_plant(_pole=0.8))) == []
    (line,) = differences({"plant": first}, {"plant": describe(own_plant(_pole=0.5))})
    assert line == f"plant.{CONSTANTS}._pole: 0.8 there, 0.5 here"
    for constants in ({"preview": 2}, {"clips": True}, {"law": partial(np.power, 2)}):
        assert len(differences(describe(own_plant()), describe(own_plant(**constants)))) == 1
    one, other = (describe(own_plant(law=partial(own_law, power))) for power in (1, 3))
    assert len(differences(one, other)) == 1
    texts = np.array([f"{i}" for i in range(20)])
    for one, other in ((jax.random.key(0), jax.random.key(1)), (texts, texts[::-1])):
        both = describe(own_plant(table=one)), describe(own_plant(table=other))
        assert len(differences(*both)) == 1
    once = describe(own_plant(log=logging.getLogger("one")))
    logging.getLogger("another")
    assert differences(once, describe(own_plant(log=logging.getLogger("one")))) == []
    earlier = {name: value for name, value in first.items() if name != CONSTANTS}
    assert differences(earlier, describe(own_plant(_pole=0.5))) == []


def without(described, *names):
    return {name: value for name, value in described.items() if name not in names}


def test_fields_that_were_added_since_are_no_difference_until_they_are_used():
    task, plant = Task(np.zeros(9), dt=1e-3), ProcessModel(2.0, poles=[60.0])
    machine = Machine(plant)
    of_machine = without(describe(machine), "variation")
    found = {"task": without(describe(task), "names"), "plant": without(describe(plant), "delay")}
    today = {"task": describe(task), "plant": describe(plant)}
    assert differences(found, today) == []
    assert differences({"machine": of_machine}, {"machine": describe(machine)}) == []
    delayed = ProcessModel(2.0, poles=[60.0], delay=0.004)
    assert differences(found, {"task": describe(task), "plant": describe(delayed)}) == [
        "plant.delay: 0.0 there, 0.004 here"
    ]
