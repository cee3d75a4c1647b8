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
from jaxilc.objectives import EveryTrial, Final, Holding
from jaxilc.tuning import Tuning

jaxilc.setup()
folder = output.folder(__file__)
UNSEEN = 257  # plants, the nominal one included


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


MFAILC = {"lam": (1e-5, 1e2), "eta": None, "mu": (1e-6, 1e2), "rho": (0.01, 1.0)}
CASES = {
    "cfdl": Case(
        "cao-2019",
        "cfdl-mfailc",
        MFAILC | {"phi0": (-0.5, -0.003)},
        Holding(20) + 0.3 * Holding(20, "max_error"),
        60,
        (20, 40, 80, 200),
        {"lead": 3},
        tuning={"starts": 3},
    ),
    "ffdl": Case(
        "cao-2019",
        "ffdl-mfailc",
        MFAILC | {"phi0": None},
        Holding(15) + 0.3 * Holding(15, "max_error"),
        60,
        (15, 50, 80, 200),
    ),
    "mfapc": Case(
        "dai-2014",
        "cfdl-mfapc",
        {"lam": (0.1, 1e4), "eta": None, "mu": (1e-6, 1e2), "phi0": (-2.0, -0.003)},
        Final() + 0.1 * Final("max_error"),
        1,
        (1,),
        tuning={"starts": 3},
    ),
    "rig": Case(
        "cao-2019-rig",
        "cfdl-mfailc",
        {
            "learning.filter.cutoff": (1.0, 60.0),
            "learning.scheme.lam": (1e-3, 1e2),
            "learning.scheme.phi0": (0.05, 10.0),
            "feedback.kp": (0.03, 3.0),
            "feedback.ki": (0.0006, 0.06),
        },
        EveryTrial() + Final() + 0.3 * Final("max_error"),
        12,
        (12, 80),
        tuning={"samples": 8, "held_out": 8, "steps": 40},
    ),
    "servo": Case(
        "xu-2024",
        "ilc-asmc",
        {"learning.K_P": (1e4, 1e7), "learning.K_D": (50.0, 2e4), "feedback.k_n": (200.0, 1e4), "feedback.phi": (1e4, 1e7)},
        EveryTrial() + Final() + 0.3 * Final("max_error"),
        10,
        (2, 10, 40),
        tuning={"samples": 8, "held_out": 8, "steps": 40},
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
    dataset = jaxilc.Sweep(s.machine, schemes, s.task, max(case.judged), s.uncertainty, samples=UNSEEN, seed=problem.seed + 2).run()
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
