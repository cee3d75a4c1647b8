"""What the fuzzers share: how often they run, and values that no parameter wants.

Each runs a few times with the other tests. For more, say how many, and from which seed on:

    JAXILC_FUZZ=10000 JAXILC_FUZZ_SEED=1 pytest tests/test_fuzz_*.py

What is found is named with the seed of that one run: JAXILC_FUZZ=1 with it repeats it alone.
"""

import os
import traceback

import numpy as np

from jaxilc.schemes import PID

DEEP = []
for _ in range(2000):
    DEEP = [DEEP]
HOSTILE = (
    *(None, True, False, 0, 1, -1, 2, 7, 10**6, 2**31, 2**63, 2**70, -(2**70), 10**23, 10**400),
    *(0.0, -0.0, 0.5, 1.0, 2.5, -3.5, 1e-300, 1e300, 1e-9, 1e9, np.inf, -np.inf, np.nan),
    *("", "x", "nan", "1e6", "(1,2,3)", "none", "machine", "../../etc", "[bold]", ":x:", "\x1b[31m", "\ud800", "a" * 3000, "\x00", "plant"),
    *([], [1], [1, 2], [[1, 2]], [[1], [2, 3]], [np.nan], ["a"], [None], [[]], {}, {"a": 1}, {"class": "PID"}, {"class": 3}, (), (1,)),
    *(1j, b"bytes", {1, 2}, object(), PID, PID(), DEEP, range(3), lambda: 1),
    *(np.float32(1), np.float64(np.nan), np.int64(3), np.array([]), np.ones(3), np.ones((2, 2)), np.array(["a"]), np.array([None])),
    *(np.datetime64("2020-01-01"), np.float16(1), np.longdouble(1), np.zeros((0, 3)), np.bool_(True)),
)
PLAIN = tuple(x for x in HOSTILE if x is None or isinstance(x, bool | int | float | str | list | dict))  # what JSON can hold


def fuzz(few, attempt, allowed=ValueError):
    """`attempt(rng)`, `few` times or as often as was asked for, which may raise what is allowed only. Returns how many raised nothing."""
    accepted, found = 0, []
    first = int(os.environ.get("JAXILC_FUZZ_SEED", "0"))
    for seed in range(first, first + int(os.environ.get("JAXILC_FUZZ", few))):
        try:
            attempt(np.random.default_rng(seed))
            accepted += 1
        except allowed as error:
            if not str(error).strip():
                found.append(f"seed {seed}: an error without a word")
        except Exception:
            found.append(f"seed {seed}: {traceback.format_exc(limit=-3)}")
        if len(found) >= 20:
            break
    print(f"{attempt.__qualname__}: {accepted} accepted")
    assert not found, f"{len(found)} of them:\n" + "\n".join(found)
    return accepted


def pick(rng, choices):
    return choices[rng.integers(len(choices))]
