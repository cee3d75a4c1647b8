"""Contraction maps of Cao 2019: what is observed beside d2, sigma_max and the spectral radius.

CFDL-MFAILC over its weight lam and a number of the plant, with uncertain machines at each point:

    motor        the paper's machine, over the gain of its plant. Its output reacts to the newest
                 input by 1 part in 20,000 of what it does to earlier ones, which d2 leaves out
    first-order  y[k+1] = a y[k] + (1 - a) u[k], over its pole a; d2 is exact at a = 0

The colour is the observed contraction: the factor by which the 2-norm of the error changes in a
trial, as the geometric mean of trials 2 to 10, in the median of the machines. The lines are those
on which a bound is 1, from the plant and before any trial: d2 of the paper, sigma_max and spectral
radius of the law frozen at its start. The rows tell beside it the share of machines on which each
premise of the paper held, and on which a claimed bound did not hold.

    python experiments/grids_and_contraction.py CASE [points of an axis] [machines]

Writes CASE.csv and CASE.svg to out/experiments/grids_and_contraction.
"""

import sys
import time
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from matplotlib.colors import LogNorm
from output import axes, folder, write_rows

import jaxilc
from jaxilc.figures import save
from jaxilc.plants import StateSpace
from jaxilc.schemes import CFDLMFAILC
from jaxilc.theory.bounds import BoundsWatch

NAME = "cfdl-mfailc"
LAM = f"{NAME}.lam"
TRIALS = 10
SIGMA_STEPS = 40  # of the Lanczos iteration for the nominal machine of a point
LINES = {"d2": ("--", "black"), "sigma_max": ("-", "#1b7837"), "radius": (":", "#762a83")}
PREMISES = ("linear", "alone", "signs", "damped", "printed", "claimed")
WIDEST = 10.0  # factor of a trial at which the colours end


class Case(NamedTuple):
    """What is swept: a machine with its law, and the axis beside lam, with its name in words."""

    machine: jaxilc.Machine
    scheme: CFDLMFAILC
    task: jaxilc.Task
    uncertainty: Mapping[str, Any]
    lam: tuple[float, float]
    axis: str
    values: tuple[float, float]
    words: str
    logarithmic: bool


def motor() -> Case:
    paper = jaxilc.scenarios.load("cao-2019")
    scheme, gain = paper.schemes[NAME], float(paper.machine.plant.gain)
    lam = float(scheme.lam)
    return Case(
        paper.machine,
        scheme,
        paper.task,
        paper.uncertainty,
        (lam / 100, lam * 100),
        "machine.plant.gain",
        (gain / 10, gain * 10),
        "gain of the plant",
        logarithmic=True,
    )


def first_order() -> Case:
    a = 0.5
    time_ = np.arange(201) / 200
    return Case(
        jaxilc.Machine(StateSpace([[a]], [[1.0]], [[1 - a]], dt=5e-3)),
        CFDLMFAILC(phi0=0.25, lam=1.0, mu=1.0, rho=1.0, eta=0.5, epsilon=1e-5),
        jaxilc.Task(1 - np.cos(2 * np.pi * time_), dt=5e-3),
        {"plant.C": jaxilc.Uniform(0.8, 1.2, relative=True)},
        (0.003, 10.0),
        "machine.plant.A[0][0]/machine.plant.C[0][0]",
        (-0.9, 0.99),
        "pole of the plant",
        logarithmic=False,
    )


CASES = {"motor": motor, "first-order": first_order}


def swept(case: Case, points: int, machines: int, watch: BoundsWatch) -> xr.Dataset:
    """The dataset over lam and the other axis."""
    values = (np.geomspace if case.logarithmic else np.linspace)(*case.values, points)
    several = (values, 1 - values) if "/" in case.axis else values  # the gain at rest stays 1
    sweep = jaxilc.Sweep(
        case.machine,
        {NAME: case.scheme},
        case.task,
        trials=TRIALS,
        uncertainty=case.uncertainty if machines > 1 else {},
        machines=machines,
        watch=watch,
        grid={
            LAM: np.geomspace(*case.lam, points),
            tuple(case.axis.split("/")) if "/" in case.axis else case.axis: several,
        },
    )
    return sweep.run().isel(scheme=0).load()


def main(name: str, points: int = 32, machines: int = 64) -> None:
    case, path, begun = CASES[name](), folder(__file__), time.perf_counter()
    axis = case.axis.split("/")[0]
    seen = swept(case, points, machines, BoundsWatch())
    took = time.perf_counter() - begun
    nominal = swept(case, points, 1, BoundsWatch(sigma_steps=SIGMA_STEPS)).isel(sample=0)
    later = seen.isel(trial=slice(1, None))
    change = np.exp(np.log(later["contraction_norm"]).mean("trial", skipna=False))
    broken = (seen["claimed"] == 1) & (later["share_kept"] < 1).any("trial")
    found = {
        "contraction": change.fillna(np.inf).median("sample"),
        "diverged": (seen["diverged_at"] > 0).mean("sample"),
        "left_out": seen["left_out"].median("sample"),
        "excited": later["share_excited"].mean(("trial", "sample")),
        "claimed_and_broken": broken.mean("sample"),
        **{line: nominal[line] for line in LINES},
        **{premise: (seen[premise] == 1).mean("sample") for premise in PREMISES},
    }
    table = xr.Dataset(found).to_dataframe()[list(found)].reset_index()
    write_rows(path / f"{name}.csv", table.to_dict("records"))
    draw(path / f"{name}.svg", case, axis, found)
    print(f"{points} x {points} points x {machines} machines x {TRIALS} trials: {took:.0f} s")
    tell(found)


def tell(found: Mapping[str, xr.DataArray]) -> None:
    """What the map says, in numbers."""
    falls = found["contraction"] < 1
    print(f"the error falls at {float(falls.mean()):.1%} of the points")
    for name in LINES:
        below = found[name] < 1
        among = float(falls.where(below).mean())
        print(
            f"{name} < 1 at {float(below.mean()):.1%} of the points; the error falls at {among:.1%}"
            f" of these, and at {float(falls.where(~below).mean()):.1%} of the others"
        )
    ratio = (found["contraction"] / found["d2"]).where(found["claimed"] == 1)
    print(f"where d2 is claimed, the observed factor is {float(ratio.median()):.3g} of it (median)")
    for name in (*PREMISES, "claimed_and_broken"):
        print(f"{name}: on {float(found[name].mean()):.1%} of the machines")
    print(f"left out by the window: {float(found['left_out'].median()):.3%} in the median")


def draw(path, case: Case, axis: str, found: Mapping[str, xr.DataArray]) -> None:
    """The map, with the lines on which a bound is 1."""
    ax = axes()
    maps = {name: found[name].transpose(axis, LAM) for name in ("contraction", *LINES)}
    lam, values = (maps["contraction"][name].values for name in (LAM, axis))
    shown = np.clip(maps["contraction"], 1 / WIDEST, WIDEST)
    colours = {"norm": LogNorm(1 / WIDEST, WIDEST), "cmap": "RdBu_r"}
    mesh = ax.pcolormesh(lam, values, shown, shading="nearest", **colours)
    for name, (dashes, colour) in LINES.items():
        least, most = float(maps[name].min()), float(maps[name].max())
        label = f"{name} = 1" if least < 1 < most else f"{name} from {least:.4g} to {most:.4g}"
        ax.plot([], [], dashes, color=colour, label=label)
        if least < 1 < most:
            ax.contour(lam, values, maps[name], [1.0], colors=colour, linestyles=dashes)
    ax.set(xscale="log", yscale="log" if case.logarithmic else "linear")
    ax.set(xlabel="weight lam", ylabel=case.words)
    ax.set_title("change of the error in a trial, median of the machines", fontsize="medium")
    ax.figure.colorbar(mesh, ax=ax, label="|e| of a trial over that of the trial before")
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.15), ncols=3, fontsize="small")
    save(ax, path)


if __name__ == "__main__":
    main(sys.argv[1], *map(int, sys.argv[2:]))
