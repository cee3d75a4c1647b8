"""Xu 2024: yield, worst case and chattering of 1024 tools.

Stiffness, damping, gain, hysteresis and load are drawn together within ±20 %.
"""

import output

import jaxilc

jaxilc.setup()
folder = output.folder(__file__)
s = jaxilc.scenarios.load("xu-2024", reading="small-gain", load=1.0)
sweep = jaxilc.Sweep(
    s.machine, s.schemes, s.task, s.trials, s.uncertainty, machines=1024, quantities=s.functions
)
dataset = sweep.run()
tolerance = s.tolerance / s.shown_scale
rows = []
for row in jaxilc.summarise(dataset, tolerance):
    quantiles = {
        f"{name} [nm]": 1e3 * float(values[-1])
        for name, values in (("median", row.median), ("95 %", row.high), ("worst", row.worst))
    }
    shares = {"yield": row.yield_share, "diverged": row.diverged}
    chattering = float(dataset["chattering"].sel(scheme=row.scheme, trial=s.trials).median())
    rows.append(
        {"scheme": row.scheme}
        | shares
        | quantiles
        | {"worst sample": int(row.worst_machine[-1]), "chattering [V/s]": chattering}
    )
output.write_rows(folder / "rows.csv", rows)
print(f"yield: settled error of trial {s.trials} within {s.tolerance:g} nm; 1 N nominal load")
axes = jaxilc.figures.error_band(dataset, tolerance=tolerance, scale=1e3, unit="nm")
jaxilc.figures.save(axes, folder / "band.png")
