"""Cao 2019, section IV: a search over the readings of Table 1, scheme by scheme, then as a whole.

    motion     sine of 1 mm; 0.5 (1 - cos), the stroke of 1 mm in the form of eq. 28; a sine of
               0.5 mm; 1 - cos
    window     from 0, 1/8, ... 7/8 of the trial to its end
    reset      as in the book, where the sign turns, none
    plant      eq. 29, or the exact one of eq. 7
    unit       of y in CFDL-MFAILC: mm or µm; y in µm is lam / 1e6 for y in mm
    numbering  the first trial has number 1, or number 0
    phi0       free: one number for CFDL-MFAILC, four for FFDL-MFAILC, one for ILC-MFAPC

ILC-MFAPC further has: learned input added to that of the feedback or to the reference, the sign of
its gains, its derivative per sample or per second, lam as printed or lam / P, a previewed or a
constant reference over the horizon. PID has ki per sample or per second. What departs from the
words of the paper costs a choice, see `reading_search`. `python cao_2019_readings.py NAME ...` runs
the schemes whose name contains one of the NAMEs.
"""

import itertools
import sys

import jax.numpy as jnp
import numpy as np
import output
from printed_tables import CAO_1, CAO_FITTED
from reading_search import Reading, search
from scipy.stats import qmc

import jaxilc
from jaxilc import Machine, Task
from jaxilc.plants import voice_coil
from jaxilc.schemes import (
    CFDLMFAILC,
    CFDLMFAPC,
    FFDLMFAILC,
    PID,
    OnReference,
    PIDType,
    WithFeedback,
)

DT, N = 1e-3, 2000
TIME = np.arange(N + 1) * DT
MOTIONS = {
    "sine 1": np.sin(np.pi * TIME),
    "stroke": 0.5 * (1 - np.cos(np.pi * TIME)),
    "sine 0.5": 0.5 * np.sin(np.pi * TIME),
    "1 - cos": 1 - np.cos(np.pi * TIME),
}
WINDOWS = {f"from {i}/8": max(i * N // 8, 1) for i in range(8)}
RESETS, PLANTS = ("book", "sign", "none"), ("printed", "exact")
# What the words of the paper do not say, or contradict. The window is not named at all, and the
# sine and the stroke of 1 mm both are.
DEPARTS = {
    *(("motion", "sine 0.5"), ("motion", "1 - cos"), ("reset", "book"), ("reset", "sign")),
    *(("plant", "exact"), ("unit", "µm"), ("numbering", "from 0"), ("structure", "series")),
    *(("gains", "-"), ("derivative", "per second"), ("lam", "lam / P"), ("ki", "per second")),
}


def errors_in_windows(trial):
    """(windows,) largest |e| from the start of each window to the end [mm]."""
    e = jnp.abs(trial.e[:, 0])
    return jnp.stack([jnp.max(e[start:]) for start in WINDOWS.values()])


def simulated(build, trials: int):
    """A function of plant, motion and (S, m) free numbers that gives (S, J, windows) errors [µm].

    build: function from m numbers to a scheme
    """

    def errors(common, free):
        machine, reference = common
        task = Task(reference, dt=DT)
        history = jaxilc.learn(machine, build(free), task, trials, save=errors_in_windows)
        return 1e3 * jnp.where(history.diverged[:, None], jnp.inf, history.saved)

    run = jaxilc.tiled(errors)

    def of(plant, motion, values):
        common = (Machine(voice_coil(plant)), jnp.asarray(MOTIONS[motion]))
        return np.asarray(run(common, jnp.asarray(values)))

    return of


def readings(errors, values, places, rows):
    """The readings of one simulation: every window, and both numberings of the trials.

    rows: pairs of trial and window, None for that of the reading
    """
    for window, first in itertools.product(WINDOWS, (1, 0)):
        numbering = "from 1" if first else "from 0"
        here = {**places, "window": window, "numbering": numbering}
        columns = [
            errors[:, min(j - first, errors.shape[1] - 1), list(WINDOWS).index(of or window)]
            for j, of in rows
        ]
        departures = len(DEPARTS & set(here.items()))
        yield Reading(here, departures, np.asarray(values), np.stack(columns, axis=1))


def cfdl():
    """CFDL-MFAILC: 80 start values."""
    rows = [*((j, None) for j in CAO_1["cfdl-mfailc"]), (35, "from 0/8")]
    starts, found = -np.geomspace(0.003, 0.6, 80), []
    for reset in RESETS:

        def build(free, reset=reset):
            return CFDLMFAILC(lam=free[1], eta=0.9, mu=1.0, rho=1.0, phi0=free[0], reset=reset)

        run = simulated(build, 102)
        for plant, motion in itertools.product(PLANTS, MOTIONS):
            lams = {"mm": 1.0, "µm": 1e-6}
            values = [(start, lam) for lam in lams.values() for start in starts]
            errors = run(plant, motion, values)
            for i, unit in enumerate(lams):
                part = slice(i * len(starts), (i + 1) * len(starts))
                places = {"motion": motion, "reset": reset, "plant": plant, "unit": unit}
                found += readings(errors[part], starts[:, None], places, rows)
    return found, rows, (*CAO_1["cfdl-mfailc"].values(), 10.0)


def ffdl():
    """FFDL-MFAILC: 1024 start values in four dimensions, spread evenly."""
    rows = [(j, None) for j in CAO_1["ffdl-mfailc"]]
    unit = qmc.Sobol(4, seed=0).random(1024)
    values = qmc.scale(unit, (-1.5, -1.5, -4.5, -0.5), (1.5, 1.5, -1.2, 0.5))
    values[:, 2] = -np.exp(values[:, 2])
    found = []
    for reset in RESETS:

        def build(free, reset=reset):
            return FFDLMFAILC(lam=1.2, eta=1.0, mu=1.1, rho=0.98, phi0=free, reset=reset)

        run = simulated(build, 102)
        for motion in MOTIONS:
            places = {"motion": motion, "reset": reset, "plant": "printed"}
            found += readings(run("printed", motion, values), values, places, rows)
    return found, rows, tuple(CAO_1["ffdl-mfailc"].values())


def mfapc():
    """ILC-MFAPC: 40 start values; of its eight rows of 0.3 µm the later ones say "no change"."""
    rows = [(j, None) for j in CAO_1["ilc-mfapc"] if j <= 60]
    starts, found = -np.geomspace(1e-6, 0.3, 40), []
    leaves = list(itertools.product((-1.0, 1.0), (1.0, 1e3), (20.0, 2.0)))
    values = [(start, *leaf) for leaf in leaves for start in starts]
    for structure, reset, horizon in itertools.product(
        (WithFeedback, OnReference), ("book", "sign"), ("preview", "constant")
    ):

        def build(free, structure=structure, reset=reset, horizon=horizon):
            feedback = CFDLMFAPC(
                P=10, lam=free[3], eta=0.9, phi0=free[0], reset=reset, reference=horizon
            )
            gains = {"gamma_p": 0.2 * free[1], "gamma_d": free[1] * free[2]}
            return structure(PIDType(**gains), feedback)

        run = simulated(build, 60)
        for motion in MOTIONS:
            errors = run("printed", motion, values)
            for i, (sign, second, lam) in enumerate(leaves):
                part = slice(i * len(starts), (i + 1) * len(starts))
                places = {
                    "motion": motion,
                    "reset": reset,
                    "horizon": horizon,
                    "structure": "series" if structure is OnReference else "parallel",
                    "gains": "-" if sign < 0 else "+",
                    "derivative": "per sample" if second == 1 else "per second",
                    "lam": "lam / P" if lam > 2 else "lam",
                }
                found += readings(errors[part], starts[:, None], places, rows)
    return found, rows, tuple(CAO_1["ilc-mfapc"][j] for j, _ in rows)


def pid():
    """PID: no free number."""
    rows, found = [(1, "from 0/8"), (1, None)], []

    def build(free):
        return PID(kp=-11.3, ki=free[0])

    run = simulated(build, 1)
    for plant, motion in itertools.product(PLANTS, MOTIONS):
        errors = run(plant, motion, [(-0.028,), (-28.0,)])
        for i, ki in enumerate(("per second", "per sample")):
            places = {"motion": motion, "plant": plant, "ki": ki}
            found += readings(errors[i : i + 1], np.zeros((1, 0)), places, rows)
    return found, rows, (30.0, 23.0)


SCHEMES = {"cfdl-mfailc": cfdl, "ffdl-mfailc": ffdl, "ilc-mfapc": mfapc, "pid": pid}


def as_a_whole(tables: dict[str, list[dict]]) -> list[dict]:
    """Readings with one motion and one numbering for all schemes, the best first.

    The window is the same for all schemes, or each scheme has its own, which costs one choice for
    each scheme beyond the first. What is left to choose is the best of each scheme.
    """
    rows = []
    for motion, numbering, window in itertools.product(
        MOTIONS, ("from 1", "from 0"), (*WINDOWS, "own")
    ):
        here = {"motion": motion, "numbering": numbering}
        best = {}
        for name, table in tables.items():
            fits = [row for row in table if all(row[place] == here[place] for place in here)]
            fits = [row for row in fits if window in ("own", row["window"])]
            best[name] = min(fits, key=lambda row: row["BIC"], default=None)
        if all(best.values()):
            total = sum(row["BIC"] for row in best.values())
            total += (window == "own") * (len(best) - 1) * np.log(len(WINDOWS))
            row = {**here, "window": window, "k": sum(row["k"] for row in best.values())}
            row |= {"BIC": float(total), "met": sum(row["met"] for row in best.values())}
            row |= {"held out met": sum(row["held out met"] for row in best.values())}
            rows.append(row | {name: f"{of['met']}, {of['window']}" for name, of in best.items()})
    return sorted(rows, key=lambda row: row["BIC"])


def main(names: list[str]) -> None:
    folder, tables = output.folder(__file__), {}
    for name, search_of in SCHEMES.items():
        if names and not any(part in name for part in names):
            continue
        found, rows, printed = search_of()
        fitted = [j in CAO_FITTED.get(name, ()) and of is None for j, of in rows]
        tables[name] = search(name, found, printed, fitted)
        output.write_rows(folder / f"{name}.csv", tables[name][:12])
    print("all schemes together, the best of each motion:")
    together = as_a_whole(tables)
    output.write_rows(
        folder / "together.csv",
        [next(row for row in together if row["motion"] == motion) for motion in MOTIONS],
    )


if __name__ == "__main__":
    jaxilc.setup()
    main(sys.argv[1:])
