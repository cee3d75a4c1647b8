"""Contraction map of Cao 2019: what is observed beside d2, sigma_max and the spectral radius.

The paper's machine under CFDL-MFAILC, over the weight lam and the gain of the plant, with uncertain
machines at each point. Its output reacts to the newest input by 1 part in 20,000 of what it does to
earlier ones, which d2 leaves out.

The picture is `figures.contraction_map`. The rows tell beside it the share of machines on which
each premise of the paper held, and on which a claimed bound did not hold.

    python experiments/cao_2019_contraction.py [points of an axis] [machines]

Writes map.csv and map.svg to out/experiments/cao_2019_contraction.
"""

import sys
import time
from collections.abc import Mapping

import numpy as np
import xarray as xr
from output import folder, write_rows

import jaxilc
from jaxilc import figures
from jaxilc.theory.bounds import BoundsWatch

NAME = "cfdl-mfailc"
LAM, GAIN = f"{NAME}.lam", "machine.plant.gain"
WITHIN_LAM, WITHIN_GAIN = 100.0, 10.0  # the axes, up and down from the paper's numbers
TRIALS = 10
SIGMA_STEPS = 40  # of the Lanczos iteration for the nominal machine of a point
LINES = ("d2", "sigma_max", "radius")
PREMISES = ("linear", "alone", "signs", "damped", "printed", "claimed")


def swept(points: int, machines: int, watch: BoundsWatch) -> xr.Dataset:
    """The dataset over lam and gain."""
    paper = jaxilc.scenarios.load("cao-2019", reading="amplitude", plant="exact")
    scheme, gain = paper.schemes[NAME], float(paper.machine.plant.gain)
    sweep = jaxilc.Sweep(
        paper.machine,
        {NAME: scheme},
        paper.task,
        trials=TRIALS,
        uncertainty=paper.uncertainty if machines > 1 else {},
        machines=machines,
        watch=watch,
        grid={
            LAM: float(scheme.lam) * np.geomspace(1 / WITHIN_LAM, WITHIN_LAM, points),
            GAIN: gain * np.geomspace(1 / WITHIN_GAIN, WITHIN_GAIN, points),
        },
    )
    return sweep.run()


def main(points: int = 32, machines: int = 64) -> None:
    jaxilc.setup()  # in double precision, since the error falls below the rounding of the other
    path, begun = folder(__file__), time.perf_counter()
    whole = swept(points, machines, BoundsWatch())
    took = time.perf_counter() - begun
    bounds = swept(points, 1, BoundsWatch(sigma_steps=SIGMA_STEPS))
    seen, nominal = whole.isel(scheme=0), bounds.isel(scheme=0, sample=0)
    later = seen.isel(trial=slice(1, None))
    broken = (seen["claimed"] == 1) & (later["share_kept"] < 1).any("trial")
    found = {
        "contraction": figures.contraction_of(seen).median("sample"),
        "diverged": (seen["diverged_at"] > 0).mean("sample"),
        "left_out": seen["left_out"].median("sample"),
        "excited": later["share_excited"].mean(("trial", "sample")),
        "claimed_and_broken": broken.mean("sample"),
        **{line: nominal[line] for line in LINES},
        **{premise: (seen[premise] == 1).mean("sample") for premise in PREMISES},
    }
    table = xr.Dataset(found).to_dataframe()[list(found)].reset_index()
    write_rows(path / "map.csv", table.to_dict("records"))
    paper = {LAM: np.sqrt(seen[LAM][[0, -1]].prod()), GAIN: np.sqrt(seen[GAIN][[0, -1]].prod())}
    marks = {"as printed": {name: float(value) for name, value in paper.items()}}
    figures.save(figures.contraction_map(whole, bounds=bounds, marks=marks), path / "map.svg")
    print(f"{points} x {points} points x {machines} machines x {TRIALS} trials: {took:.0f} s")
    tell(found)


def tell(found: Mapping[str, xr.DataArray]) -> None:
    """What the map says, in numbers."""
    falls = found["contraction"] < 1
    print(f"the error falls at {float(falls.mean()):.1%} of the points")
    for name in LINES:
        below = found[name] < 1
        for words, where in ((f"{name} < 1", below), (f"{name} >= 1", ~below)):
            print(f"{words} at {float(where.mean()):.1%} of the points")
            if where.any():
                print(f"    the error falls at {float(falls.where(where).mean()):.1%} of these")
    ratio = (found["contraction"] / found["d2"]).where(found["claimed"] == 1)
    if ratio.notnull().any():
        print(f"where d2 is claimed, the observed factor is {float(ratio.median()):.3g} of it")
    for name in (*PREMISES, "claimed_and_broken"):
        print(f"{name}: on {float(found[name].mean()):.1%} of the machines")
    print(f"left out by the window: {float(found['left_out'].median()):.3%} in the median")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
