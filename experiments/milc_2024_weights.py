"""MILC 2024: w_q, w_r and w_s by gradient through the learning and the Riccati recursion, over uncertain stiffness and table mass."""

import dataclasses

import numpy as np
import output

import jaxilc
from jaxilc.objectives import EveryTrial, Final
from jaxilc.tuning import Tuning
from jaxilc.uncertainty import Uniform

jaxilc.setup()
folder = output.folder(__file__)
s = jaxilc.scenarios.load("milc-2024")
uncertainty = {f"plant.{name}": Uniform(0.8, 1.2, relative=True) for name in ("stiffness", "table_mass")}
# the penalty on the learned reference gets a weight of its own: as printed, it also pulls the whole reference towards zero
milc = s.schemes["milc"]
milc = dataclasses.replace(milc, learning=dataclasses.replace(milc.learning, w_s=np.full(2, milc.learning.w_s)))
CASES = {"dilc": (s.schemes["dilc"], "learning.scheme."), "milc": (milc, "learning.")}
TRIALS = 6
BOUNDS = {"w_q": (1e3, 1e10), "w_r": (1e-8, 1e3), "w_s": (1e-6, 1e4)}

rows, axes = [], output.axes(1, 2, size=(10.0, 4.0))
for ax, (name, (scheme, path)) in zip(axes, CASES.items(), strict=True):
    problem = Tuning(
        s.machine,
        scheme,
        s.task,
        TRIALS,
        {f"{path}{w}": bounds for w, bounds in BOUNDS.items()},
        uncertainty,
        EveryTrial("table_rms") + Final("table_rms"),
        samples=16,
        held_out=16,
        steps=60,
        rate=0.3,
        quantities=s.functions,
    )
    tuned = problem.run()
    dataset = problem.compare(tuned, samples=64)
    medians = {which: 1e3 * dataset["table_rms"].sel(scheme=which).median("sample").values for which in dataset["scheme"].values}
    worst = {which: 1e3 * dataset["table_rms"].sel(scheme=which).max("sample").values for which in dataset["scheme"].values}
    for which in medians:
        ax.semilogy(np.arange(1, TRIALS + 1), medians[which], label=f"{which}: median")
        ax.semilogy(np.arange(1, TRIALS + 1), worst[which], "--", label=f"{which}: worst")
        row = {"scheme": name, "weights": which, "loss": tuned.before if which == "given" else tuned.after}
        row |= {f"median {j}": float(medians[which][j - 1]) for j in (2, 3, TRIALS)} | {f"worst {TRIALS}": float(worst[which][-1])}
        rows.append(row | (tuned.start if which == "given" else tuned.values))
    ax.set(title=f"{name}: 64 drives never seen", xlabel="trial", ylabel="table RMS [µm]")
    ax.grid(True, which="both", alpha=0.25)
    ax.legend(fontsize="small")
axes[0].figure.savefig(folder / "tuned.png")
for row in rows:
    print("  ".join(f"{k} {v:.4g}" if isinstance(v, float) else f"{k} {v}" for k, v in row.items()))
noise, step = float(s.machine.sensor.noise[1]), float(s.machine.sensor.resolution[1])
floor = 1e3 * np.sqrt(noise**2 + step**2 / 12)
print(f"the table's encoder alone, its noise and step, measures {floor:.4f} µm RMS: no weights get below")
for row in rows:
    excess = np.sqrt(row[f"median {TRIALS}"] ** 2 - floor**2)
    print(f"{row['scheme']}, {row['weights']}: {excess:.3f} µm RMS beyond the encoder's floor at trial {TRIALS}")
