"""What becomes of files that are whole, but in the place of another: sweeps and tunings.

Two sweeps and two tunings that are alike but for a seed or a rate are finished. Then files are put
in the place of others of their kind, and files and folders are removed. Opened and resumed, a store
gives the numbers that it had, or it is refused with a sentence: `silent` counts what gave other
numbers without a word. Campaigns are attacked by `tests/hardware/test_damaged_campaigns.py`.
"""

import dataclasses
import itertools
import logging
import shutil
import sys
import tempfile
from pathlib import Path

import jax
import numpy as np
import output

from jaxilc import Machine, Sweep, Task, Uniform, open_dataset
from jaxilc.plants import StateSpace
from jaxilc.schemes import PIDType
from jaxilc.tuning import Tuning
from jaxilc.tuning.objectives import Final

TASK = Task(np.sin(2 * np.pi * np.arange(21) / 20), dt=1e-3)
STATIC = Machine(StateSpace([[0.0]], [[1.0]], [[1.0]], dt=1e-3))
GAINS = {"plant.B": Uniform(0.6, 1.2, relative=True)}
SCHEMES = {"slow": PIDType(gamma_p=0.2), "fast": PIDType(gamma_p=0.6)}
SWEEP = Sweep(STATIC, SCHEMES, TASK, 3, uncertainty=GAINS, machines=6, chunk=2, lanes=2)
TUNING = Tuning(
    STATIC, PIDType(gamma_p=0.4), TASK, 3, ["gamma_p"], GAINS, Final("rms", floor=0.1), machines=4,
    held_out=3, steps=4, validate_every=2, lanes=2,
)  # fmt: skip


def numbers(found) -> list:
    """The arrays of a dataset, or of the result of a tuning."""
    if hasattr(found, "data_vars"):
        return [found[name].values for name in sorted(map(str, found.variables))]
    fields = (of.name for of in dataclasses.fields(found) if of.name != "scheme")
    return jax.tree.leaves([getattr(found, name) for name in fields])


def outcome(call, whole: list) -> str:
    """`right`, `refused` or `silent`: whether a call gives the numbers of before, or a refusal."""
    try:
        found = numbers(call())
    except (ValueError, OSError) as error:
        return "refused" if "\n" not in str(error) else "traceback"
    same = len(found) == len(whole) and all(
        np.array_equal(a, b, equal_nan=a.dtype.kind == "f")
        for a, b in zip(map(np.asarray, found), map(np.asarray, whole), strict=True)
    )
    return "right" if same else "silent"


def attacks(folder: Path, other: Path):
    """(target, source) of every exchange; None as the source removes the target."""
    files = [sorted(f for f in of.rglob("*") if f.is_file()) for of in (folder, other)]
    for target, source in itertools.product(files[0], files[0] + files[1]):
        alike = target.parent.name == source.parent.name or target.suffix == source.suffix != ""
        if target != source and alike:
            yield target, source
    for target in sorted(folder.rglob("*")):
        yield target, None


def attacked(folder: Path, other: Path, calls: dict, whole: list, most: int, rng) -> list[dict]:
    """A row for each of the calls, with the number of outcomes of each kind."""
    listed = list(attacks(folder, other))
    chosen = rng.permutation(len(listed))[:most]
    rows = [{"call": name, "exchanges": len(chosen)} for name in calls]
    for row in rows:
        row |= dict.fromkeys(("right", "refused", "silent", "traceback"), 0)
    for i in chosen:
        target, source = listed[i]
        for row, call in zip(rows, calls.values(), strict=True):
            copy = folder.parent / "attacked"
            shutil.rmtree(copy, ignore_errors=True)
            shutil.copytree(folder, copy)
            place = copy / target.relative_to(folder)
            (shutil.rmtree if place.is_dir() else Path.unlink)(place)
            if source is not None:
                shutil.copyfile(source, place)
            found = outcome(lambda call=call, copy=copy: call(copy), whole)
            row[found] += 1
            if found in ("silent", "traceback"):
                print(found, row["call"], target.relative_to(folder), source, flush=True)
    return rows


def main(most: int = 500, seed: int = 42) -> None:
    logging.getLogger("jaxilc").setLevel(logging.ERROR)
    rng, rows = np.random.default_rng(seed), []
    with tempfile.TemporaryDirectory() as name:
        root = Path(name)
        host = SWEEP.host()
        Sweep.host = lambda self: host  # compiled once
        whole = numbers(SWEEP.run(root / "one.zarr"))
        dataclasses.replace(SWEEP, seed=1).run(root / "other.zarr")
        calls = {
            "open a sweep": open_dataset,
            "resume a sweep": lambda path: SWEEP.run(path, resume=True),
        }
        rows += attacked(root / "one.zarr", root / "other.zarr", calls, whole, most, rng)
    with tempfile.TemporaryDirectory() as name:
        root = Path(name)
        whole = numbers(TUNING.run(root / "one"))
        dataclasses.replace(TUNING, rate=2 * TUNING.rate).run(root / "other")
        calls = {"resume a tuning": lambda path: TUNING.run(path, resume=True)}
        rows += attacked(root / "one", root / "other", calls, whole, most, rng)
    output.write_rows(output.folder(__file__) / "exchanges.csv", rows)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
