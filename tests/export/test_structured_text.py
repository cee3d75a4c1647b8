"""Laws in Structured Text, played by a reader of the language that knows nothing of the printer."""

import math
import re
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import case
from structured_text import Block

from jaxilc.export import law_of
from jaxilc.export.st import function_block
from jaxilc.pytree import pytree
from jaxilc.schemes import Scheme
from jaxilc.schemes.scheme import Feedforward
from jaxilc.signals import Task

SCHEMES = ["ffdl_book", "p_type_iir", "norm_optimal", "p_type_stop"]


@pytest.mark.parametrize("name", SCHEMES)
def test_a_block_plays_what_the_law_plays_to_the_last_bit(name):
    _, scheme, task = case(name)
    law = law_of(scheme, task, 100.0)
    text = function_block(law, ["A law."], "0" * 64).text
    assert max(map(len, text.split("\n"))) < 2000
    block, played = Block(text), law.played()
    rng = np.random.default_rng(0)
    trials = [(0.9 + 0.03 * j) * np.asarray(task.reference) for j in range(2)]
    trials = [y + 0.01 * rng.standard_normal(y.shape) for y in trials]
    trials.append(np.where(np.arange(len(trials[0]))[:, None] == 3, np.nan, trials[0]))
    for y in trials:
        found, wanted = block.trial(y), played.trial(y)
        np.testing.assert_array_equal(found[0], wanted[0])
        assert found[1] == wanted[1]
    assert block.known["trials"] == 3
    assert wanted[1] == 1  # a sensor that fails is told


class Learned(NamedTuple):
    """What `Own` has learned, one part under a name that is not ASCII, and one without numbers."""

    u: jax.Array
    nothing: jax.Array
    φ: jax.Array


@pytree
class Own(Scheme):
    """A law of a user with the tangent of the error, whole numbers, and a field of any name."""

    def initial_memory(self, task):
        return Learned(jnp.zeros((task.N, 1)), jnp.zeros((0, 2)), jnp.zeros(3))

    def schedule(self, memory, task):
        return Feedforward(memory.u)

    def initial_state(self, task):
        return ()

    def act(self, state, sample):
        return state, sample.row.u

    def learn(self, memory, trial):
        last = jnp.max(jnp.where(trial.e[:, 0] > 0, jnp.arange(len(trial.e)), -1))
        whole = (last - 9) // 3 + (last - 9) % 4 + (last & 6) + (~last | 8) + jnp.sign(last ^ 5)
        u = memory.u + jnp.tanh(trial.e[1:]) + 0.01 * whole
        return Learned(u, 2 * memory.nothing, memory.φ + last + jnp.sum(trial.e))


@pytest.fixture(scope="module")
def own():
    """A law of a user, in units that end a comment, and its block."""
    task = Task(np.sin(np.arange(9.0)), dt=1e-3, unit="mm (*) 1", input_unit="*) V")
    law = law_of(Own(), task, 10.0)
    return law, function_block(law, ["A law (*)."], "0" * 64).text


def test_no_unit_and_no_name_of_a_field_leaves_its_place(own):
    law, text = own
    code = re.sub(r"\(\*.*?\*\)", "", text, flags=re.S)
    assert code.isascii()
    assert "*)" not in code
    assert max(map(int, re.findall(r"(?<![\w.#])\d+(?![\w.])", code))) < 2**63  # as LINT holds them
    block, played = Block(text), law.played()
    for j in range(2):
        y = (1 + j) * np.asarray(law.task.reference) / 4
        found, wanted = block.trial(y), played.trial(y)
        np.testing.assert_allclose(found[0], wanted[0], rtol=1e-14)
        assert found[1] == wanted[1] == 0


def test_the_tangent_of_a_block_is_exact_to_a_few_last_bits(own):
    found = Block(own[1]).known["LAW_TANH"]
    sizes = np.concatenate([[0.0, 5e-324, 20.0, 400.0, 1e308, np.inf], np.logspace(-300, 2, 500)])
    with np.errstate(all="ignore"):
        for x in (*sizes, *-sizes):
            assert abs(found(x) - math.tanh(x)) <= 6e-16 * abs(math.tanh(x)), x
        assert math.copysign(1, found(np.float64(-0.0))) == -1
        assert math.isnan(found(np.float64("nan")))


def test_a_block_is_what_the_grammar_of_twincat_takes(tmp_path):
    blark = pytest.importorskip("blark", reason="pip install blark")
    _, scheme, task = case("ffdl_book")
    text = function_block(law_of(scheme, task, 100.0), ["A law."], "0" * 64).text
    parsed = blark.parse_source_code(text)
    assert parsed.exception is None
    broken = blark.parse_source_code(text.replace("END_FOR", "END_FRO", 1))
    assert broken.exception is not None
