"""Printed weights against tuned ones, scenario by scenario, on plants that the tuner never saw.

MILC 2024 and Li 2020 have scripts of their own: milc_2024_weights.py and li_2020_tuning.py. `python tuned_against_printed.py NAME` runs
the cases whose name contains NAME.
"""

import dataclasses
import sys
import time

import numpy as np
import output

import jaxilc
from jaxilc.objectives import Final, Growth, Holding
from jaxilc.risks import CVaR
from jaxilc.tuning import Tuning

jaxilc.setup()
folder = output.folder(__file__)


@dataclasses.dataclass(frozen=True)
class Case:
    """changes: of the scheme before tuning, what no gradient can choose;  trials: learned while tuning;  judged: trials of the table"""

    scenario: str
    scheme: str
    weights: dict
    objective: object
    trials: int
    judged: tuple[int, ...]
    changes: dict = dataclasses.field(default_factory=dict)
    options: dict = dataclasses.field(default_factory=dict)
    tuning: dict = dataclasses.field(default_factory=dict)
    unseen: int = 257  # plants, the nominal one included


MFAILC = {"lam": (1e-5, 1e2), "eta": None, "mu": (1e-6, 1e2), "rho": (0.01, 1.0)}
FINE = 1e-4  # of the reference's peak: 0.1 µm; what lies below it is not worth a growth of the largest error
CASES = {
    "cfdl": Case(
        "cao-2019",
        "cfdl-mfailc",
        MFAILC | {"phi0": (-0.5, -0.003)},
        Holding(20, floor=FINE) + 0.3 * Holding(20, "max_error") + Growth("max_error", 20) + Growth("settled_error", 20),
        200,
        (20, 40, 80, 120, 200, 300),
        {"lead": 3},
        tuning={"starts": 2, "steps": 60},
    ),
    "ffdl": Case(
        "cao-2019",
        "ffdl-mfailc",
        MFAILC | {"phi0": None},
        Holding(15, floor=FINE) + 0.3 * Holding(15, "max_error") + Growth("max_error", 15),
        80,
        (15, 50, 80, 200),
        tuning={"risk": CVaR(0.7)},
    ),
    "mfapc": Case(
        "dai-2014",
        "cfdl-mfapc",
        {"lam": (0.1, 1e4), "eta": None, "mu": (1e-6, 1e2), "phi0": (-5.0, -0.003)},
        Final(),
        1,
        (1,),
        tuning={"starts": 4, "scatter": 1.5, "clip": 10.0},
    ),
    "rig": Case(
        "cao-2019-rig",
        "cfdl-mfailc",
        {
            "learning.filter.cutoff": (1.0, 60.0),
            "learning.scheme.lam": (1e-3, 1e2),
            "feedback.kp": (0.03, 3.0),
        },
        Final() + 0.3 * Final("max_error"),
        8,
        (8, 40),
        tuning={"samples": 4, "held_out": 4, "steps": 24, "clip": 10.0},
        unseen=33,
    ),
    "servo": Case(
        "xu-2024",
        "ilc-asmc",
        {"learning.K_P": (1e4, 1e7), "learning.K_D": (50.0, 2e4), "feedback.k_n": (200.0, 1e4), "feedback.phi": (1e4, 1e7)},
        Final() + 0.3 * Final("max_error"),
        10,
        (2, 10, 40),
        tuning={"samples": 16, "held_out": 16, "steps": 60, "rate": 0.05, "clip": 1.0},
    ),
}

rows = []
chosen = {name: case for name, case in CASES.items() if not sys.argv[1:] or any(part in name for part in sys.argv[1:])}
axes = np.atleast_1d(output.axes(1, len(chosen), size=(4.2 * len(chosen), 3.6)))
for ax, (name, case) in zip(axes, chosen.items(), strict=True):
    s = jaxilc.scenarios.load(case.scenario, **case.options)
    printed = s.schemes[case.scheme]
    start = dataclasses.replace(printed, **case.changes)
    settings = {"samples": 16, "held_out": 16, "steps": 80, "rate": 0.15, "mode": "reverse", "validate_every": 2, "patience": 15}
    problem = Tuning(s.machine, start, s.task, case.trials, case.weights, s.uncertainty, case.objective, **settings | case.tuning)
    began = time.perf_counter()
    tuned = problem.run()
    seconds = time.perf_counter() - began
    schemes = {"printed": printed} | ({"start": start} if case.changes else {}) | {"tuned": tuned.scheme}
    dataset = jaxilc.Sweep(s.machine, schemes, s.task, max(case.judged), s.uncertainty, samples=case.unseen, seed=problem.seed + 2).run()
    for figure in ("settled_error", "max_error"):
        errors = s.shown_scale * dataset[figure].where(dataset["finite"], np.inf)
        for j in case.judged:
            row = {"case": f"{case.scenario} {case.scheme}", "figure": figure, "unit": s.shown_unit, "trial": j}
            of = {which: errors.sel(scheme=which, trial=j).values for which in schemes}
            for which, values in of.items():
                row |= {f"{which} median": float(np.median(values)), f"{which} 95 %": float(np.quantile(values, 0.95, method="higher"))}
                row |= {f"{which} worst": float(np.max(values))}
            row |= {"ratio": float(np.median(of["printed"]) / np.median(of["tuned"]))}
            row |= {"worst ratio": float(np.max(of["printed"]) / np.max(of["tuned"]))}
            rows.append(row)
            print("  ".join(f"{k} {v:.4g}" if isinstance(v, float) else f"{k} {v}" for k, v in row.items()), flush=True)
    print(f"{name}: {seconds:.0f} s, held-out loss {tuned.before:.3f} -> {tuned.after:.3f} at step {tuned.step} ({tuned.reason})")
    print({k: (float(f"{tuned.start[k]:.4g}"), float(f"{v:.4g}")) for k, v in tuned.values.items()}, flush=True)
    errors = s.shown_scale * dataset["settled_error"]
    for which in schemes:
        marker = "o" if max(case.judged) == 1 else None
        line = ax.semilogy(dataset["trial"], errors.sel(scheme=which).median("sample"), marker=marker, label=which)[0]
        ax.semilogy(dataset["trial"], errors.sel(scheme=which).max("sample"), "--", marker=marker, linewidth=0.8, color=line.get_color())
    ax.set(title=f"{case.scenario}, {case.scheme}", xlabel="trial", ylabel=f"settled error [{s.shown_unit}]")
    ax.grid(True, which="both", alpha=0.25)
    ax.legend(fontsize="small")
axes[0].figure.savefig(folder / "tuned.png")
names = list(dict.fromkeys(k for row in rows for k in row))
output.write_rows(folder / "rows.csv", [{k: row.get(k, "") for k in names} for row in rows])

if "mfapc" in chosen:  # what no weights can have: the best of many drawn ones, for several horizons, on the nominal plant
    s, rng, size = jaxilc.scenarios.load("dai-2014"), np.random.default_rng(0), 600
    drawn = {"lam": 10 ** rng.uniform(-3, 4, size), "eta": rng.uniform(0.01, 1, size), "mu": 10 ** rng.uniform(-6, 2, size)}
    drawn |= {"phi0": -(10 ** rng.uniform(-2.5, 0.7, size))}

    def settled(scheme, values):
        return jaxilc.learn(s.machine, jaxilc.pytree.replaced(scheme, values), s.task, 1).settled_error[0, 0]

    look = jaxilc.tiled(settled)
    for P in (3, 10, 20, 50):
        errors = np.asarray(look(dataclasses.replace(s.schemes["cfdl-mfapc"], P=P), drawn))
        i = int(np.argmin(np.where(np.isfinite(errors), errors, np.inf)))
        print(f"P = {P}: best of {size} drawn weights {errors[i]:.4g} mm, { {k: float(f'{v[i]:.3g}') for k, v in drawn.items()} }")
