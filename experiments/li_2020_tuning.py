"""Li 2020: cutoffs, switching times and gain tuned by gradient, against the printed 10/50/10 Hz.

They are compared on machines and noise that were not used in the tuning.
"""

import numpy as np
import output

import jaxilc
from jaxilc.tuning import Tuning
from jaxilc.tuning.objectives import Final

TRIALS = 20
LAW, FILTER = "learning.scheme.gamma_p", "learning.filter"


def problem(s) -> Tuning:
    """The tuning of the switchable filter of a scenario, from the printed cutoffs."""
    found = s.schemes["switchable"].learning.filter
    gap = (
        0.4 * np.min(np.diff(np.concatenate([[0.0], found.times, [s.task.duration]])))
        - found.width / 2
    )
    weights = {LAW: (0.05, 1.5)}
    weights |= {f"{FILTER}.cutoff[{i}]": (2.0, 200.0) for i in range(len(found.cutoff))}
    weights |= {
        f"{FILTER}.times[{i}]": (float(t - max(gap, 1e-3)), float(t + max(gap, 1e-3)))
        for i, t in enumerate(found.times)
    }
    options = {"machines": 8, "held_out": 8, "steps": 40, "rate": 0.15, "mode": "reverse"}
    return Tuning(
        s.machine,
        s.schemes["switchable"],
        s.task,
        TRIALS,
        weights,
        s.uncertainty,
        Final("rms"),
        **options,
    )


def main() -> None:
    folder = output.folder(__file__)
    s = jaxilc.scenarios.load("li-2020")
    of = problem(s)
    tuned = of.run()
    schemes = {
        "none": s.schemes["p-type"],
        "fixed 10 Hz": s.schemes["fixed-filter"],
        "switchable 10/50/10 Hz": of.scheme,
    }
    schemes |= {"tuned": tuned.scheme}
    dataset = jaxilc.Sweep(
        s.machine, schemes, s.task, TRIALS, of.uncertainty, machines=32, seed=of.seed + 2
    ).run()
    rms = 1e3 * dataset["rms"]
    rows = []
    for name in schemes:
        of_scheme = rms.sel(scheme=name)
        row = {"scheme": name} | {
            f"median RMSE {j}": float(of_scheme.sel(trial=j).median())
            for j in (1, 5, 10, 15, TRIALS)
        }
        rows.append(row | {"worst": float(of_scheme.sel(trial=TRIALS).max())})
    output.write_rows(folder / "rows.csv", rows)
    print("tuned:", {name: float(f"{value:.4g}") for name, value in tuned.values.items()})
    print(
        f"held-out loss {tuned.before:.4f} -> {tuned.after:.4f}, step {tuned.step}, {tuned.reason}"
    )

    ax = output.axes()
    for name in schemes:
        ax.semilogy(dataset["trial"], rms.sel(scheme=name).median("sample"), label=name)
    ax.set(xlabel="trial", ylabel="RMSE [µm], median", title="32 axes and noise never seen")
    output.save(ax, folder / "tuned.png")


if __name__ == "__main__":
    jaxilc.setup()
    main()
