"""`--set PATH=VALUE` is tested with invalid paths and values, for every scenario.

fuzz.py says how to run more cases.
"""

import jax
import pytest
from fuzz import HOSTILE, fuzz, pick

from jaxilc import learning, scenarios

TEXTS = (
    "0", "1", "-1", "2", "7", "1e6", "1e-9", "1e300", "-1e300", "1e999", "nan", "inf", "-inf",
    "none", "None", "true", "False",
    "(1,2,3)", "1,2", "[1,2", "()", "", ",", "1,,2", "[[1,2],[3,4]]", "0x10", "1_000", "٣", "1j",
    "book", "sign", "lifted", "increment",
    "1" * 23, "9" * 5000, "a" * 300, "\x1b[31m", "\ud800", "=", "x=y", "1=2", " 3 ", "3 4", "'1'",
    "1;2", "0,1", "0,0", "5,6",
)  # fmt: skip
NAMES = list(scenarios.SCENARIOS)
CHEAP = ("cao-2019", "cao-2019-rig", "dai-2014", "milc-2024", "xu-2024")


def path_of(rng, known):
    """Return a path that can be set, or a similar one."""
    path = pick(rng, known)
    match rng.integers(8):
        case 0:
            return path + pick(
                rng, ("[0]", "[7]", "[-1]", "[0][0]", "[99999999999999999999]", ".x", "[", "")
            )
        case 1:
            return ".".join(path.split(".")[:-1])
        case 2:
            return pick(
                rng,
                ("", ".", "machine", "machine.", "..", "[0]", "x.y.z", "machine.plant",
                 "machine.actuator.limit", "__class__"),
            )  # fmt: skip
        case 3:
            return path.replace(pick(rng, list(path)), pick(rng, ("", "_", "\x00", "é", ".")), 1)
        case _:
            return path


@pytest.mark.thorough
@pytest.mark.parametrize("name", NAMES)
def test_paths_and_values(name):
    scenario = scenarios.load(name)
    known = [*scenario.settable(), "machine.actuator.limit"]

    def attempt(rng):
        # The values that are not texts come from a file of parameters.
        values = TEXTS if rng.random() < 0.8 else HOSTILE
        chosen = scenario.with_values(
            {path_of(rng, known): pick(rng, values) for _ in range(1 + rng.integers(2))}
        )
        if rng.random() < 0.2:
            chosen.check()
        if rng.random() < 0.01:
            scheme = pick(rng, list(chosen.schemes.values()))
            jax.eval_shape(lambda: learning.learn(chosen.machine, scheme, chosen.task, 2))

    fuzz(40, attempt)


def test_options():
    def attempt(rng):
        name = pick(rng, CHEAP)
        scenarios.load(
            name,
            **{
                pick(rng, [*scenarios.options(name), "x"]): pick(
                    rng, TEXTS if rng.random() < 0.7 else HOSTILE
                )
            },
        )

    fuzz(40, attempt)
