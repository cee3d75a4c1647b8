"""This module holds what the fuzz tests share.

It says how often they run, which values are invalid for every parameter, and how files and folders
are damaged.

Each fuzz test runs a few times with the other tests. For more, give the number of runs and the
first seed:

    JAXILC_FUZZ=10000 JAXILC_FUZZ_SEED=1 pytest tests/*/test_fuzz_*.py tests/*/test_damaged_*.py

A failure is reported with the seed of its run. JAXILC_FUZZ=1 with this seed repeats that run alone.
"""

import copy
import json
import os
import shutil
import traceback

import numpy as np

from jaxilc.schemes import PID

LONGEST = 2000  # characters of an error
DEEP = []
for _ in range(2000):
    DEEP = [DEEP]
HOSTILE = (
    None, True, False, 0, 1, -1, 2, 7, 10**6, 2**31, 2**63, 2**70, -(2**70), 10**23, 10**400,
    0.0, -0.0, 0.5, 1.0, 2.5, -3.5, 1e-300, 1e300, 1e-9, 1e9, np.inf, -np.inf, np.nan,
    "", "x", "nan", "1e6", "(1,2,3)", "none", "machine", "../../etc", "[bold]", ":x:", "\x1b[31m",
    "\ud800", "a" * 3000, "\x00", "plant",
    [], [1], [1, 2], [[1, 2]], [[1], [2, 3]], [np.nan], ["a"], [None], [[]],
    {}, {"a": 1}, {"class": "PID"}, {"class": 3}, (), (1,),
    1j, b"bytes", {1, 2}, object(), PID, PID(), DEEP, range(3), lambda: 1,
    np.float32(1), np.float64(np.nan), np.int64(3), np.array([]), np.ones(3), np.ones((2, 2)),
    np.array(["a"]), np.array([None]), np.datetime64("2020-01-01"), np.float16(1), np.longdouble(1),
    np.zeros((0, 3)), np.bool_(True),
)  # fmt: skip
# These values can be written as JSON.
PLAIN = tuple(
    x for x in HOSTILE if x is None or isinstance(x, bool | int | float | str | list | dict)
)


def fuzz(few, attempt, allowed=ValueError):
    """Run `attempt(rng)` `few` times, or as often as the environment asks.

    It may raise the exceptions in `allowed` only. Returns how many runs raised nothing.
    """
    accepted, found = 0, []
    first = int(os.environ.get("JAXILC_FUZZ_SEED", "0"))
    for seed in range(first, first + int(os.environ.get("JAXILC_FUZZ", few))):
        try:
            attempt(np.random.default_rng(seed))
            accepted += 1
        except allowed as error:
            if not 0 < len(str(error).strip()) <= LONGEST:
                found.append(f"seed {seed}: {len(str(error))} characters, {str(error)[:99]}")
        except Exception:
            found.append(f"seed {seed}: {traceback.format_exc(limit=-3)}")
        if len(found) >= 20:
            break
    print(f"{attempt.__qualname__}: {accepted} accepted")
    assert not found, f"{len(found)} of them:\n" + "\n".join(found)
    return accepted


def pick(rng, choices):
    return choices[rng.integers(len(choices))]


# Damage
# --------------------------------------------------------------------------------------------------

KEYS = ("x", "class", "kind", "distribution", "function", "csv", "", "a/b", "\x1b[0m", "machine")
BYTES = (
    b"\x00", b"\xff", b"[", b"{" * 50, b'"', b"1e999", b"nan", b"\r", b"\n\n", b",", b";",
    b"\xc3\xa9",
)  # fmt: skip


def places(tree, path=()):
    """Yield every place in nested tables and lists."""
    if isinstance(tree, dict | list):
        for key, value in tree.items() if isinstance(tree, dict) else enumerate(tree):
            yield (*path, key)
            yield from places(value, (*path, key))


def damaged(rng, tree):
    """Return a copy with a random damage.

    A value is replaced, removed, doubled, wrapped, or stored under another name.
    """
    tree = copy.deepcopy(tree)
    for _ in range(1 + rng.integers(2)):
        found = list(places(tree))
        if not found:
            return tree
        *path, key = pick(rng, found)
        owner = tree
        for part in path:
            owner = owner[part]
        match rng.integers(7):
            case 0 | 1 | 2:
                value = pick(rng, PLAIN)
                if value is DEEP:
                    owner[key] = value
                    return tree
                owner[key] = copy.deepcopy(value)
            case 3:
                del owner[key]
            case 4 if isinstance(owner, dict):
                owner[pick(rng, KEYS)] = owner.pop(key)
            case 5:
                owner[key] = pick(rng, ([owner[key]], {"a": owner[key]}, -1, str(owner[key])))
            case _ if isinstance(owner[key], int | float):
                owner[key] = owner[key] * pick(rng, (-1, 0, 1e6, 1e-6, 1e300, 2))
    return tree


def dumped(tree):
    try:
        return json.dumps(tree)
    # The tree is nested too deeply for the JSON writer, or has a number with thousands of digits.
    except (RecursionError, ValueError):
        return "[" * 100_000


def bytes_damaged(rng, content):
    content = bytearray(content)
    for _ in range(1 + rng.integers(4)):
        at = int(rng.integers(len(content))) if content else 0
        match rng.integers(5):
            case 0 if content:
                content[at] ^= 1 << int(rng.integers(8))
            case 1:
                content = content[:at]
            case 2:
                content[at:at] = pick(rng, BYTES)
            case 3:
                content[at : at + int(rng.integers(20))] = b""
            case _:
                content[at:at] = content[at : at + int(rng.integers(200))]
    return bytes(content)


def files_of(folder):
    return sorted(f.relative_to(folder) for f in folder.rglob("*") if f.is_file())


def flipped(rng, folder, to):
    """Make a copy of a folder with one bit changed in one of its files."""
    shutil.rmtree(to, ignore_errors=True)
    shutil.copytree(folder, to)
    file = to / pick(rng, files_of(folder))
    content = bytearray(file.read_bytes())
    bit = int(rng.integers(8 * len(content)))
    content[bit // 8] ^= 1 << bit % 8
    file.write_bytes(content)
    return to


def refusal(call):
    """Return the message of one line with which a call is refused, or None where it is accepted."""
    try:
        call()
    except ValueError as error:
        return str(error).replace("\n", "a second line")
    return None
