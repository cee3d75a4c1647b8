"""Cao 2019, Table 1: start values of the estimates, which are not printed, by least squares.

The least squares go through the whole learning process. The values are fitted to every other row of
the table and tested on the rest. CFDL has one free number, FFDL has four. Both readings of the
paper are fitted: the sine of amplitude 1 mm and the stroke of 1 mm.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np
import output
from cao_2019_readings import FITTED
from printed_tables import CAO_1

import jaxilc
from jaxilc.identification import fit
from jaxilc.scenarios.cao_2019 import READINGS

jaxilc.setup()
folder = output.folder(__file__)
LOADED = {name: jaxilc.scenarios.load("cao-2019", reading=name) for name in READINGS}
RANGES = {
    "cfdl-mfailc": {"phi": (-1.0, -0.01)},
    "ffdl-mfailc": {
        "phi_y1": (-1.5, 1.5),
        "phi_y2": (-1.5, 1.5),
        "phi_u1": (-0.5, -0.01),
        "phi_u2": (-0.5, 0.5),
    },
}


def errors(s, name, values):
    """(J,) steady-state errors [µm] with these start values, over the window of the reading."""
    start = jnp.stack([jnp.asarray(values[n]) for n in RANGES[name]])
    scheme = dataclasses.replace(s.schemes[name], phi0=start)
    windows = READINGS[s.options["reading"]].windows
    of_reading = s.functions[windows[name][0]] if name in windows else None
    history = jaxilc.learn(s.machine, scheme, s.task, max(CAO_1[name]), save=of_reading)
    found = history.settled_error if of_reading is None else history.saved
    return s.shown_scale * found.reshape(len(found), -1)[:, 0]


rows, axes = [], output.axes(1, 2, size=(11.0, 4.4))
for ax, (reading, s) in zip(axes, LOADED.items(), strict=True):
    for name, ranges in RANGES.items():
        table, fitted = CAO_1[name], np.array([trial for trial, _ in FITTED[name]])
        printed = jnp.array([table[j] for j in fitted.tolist()])

        def residuals(values, s=s, name=name, fitted=fitted, printed=printed):
            return jnp.log(errors(s, name, values)[fitted - 1] / printed)

        best = fit(residuals, ranges, starts=128, refine=6)
        ours = np.asarray(errors(s, name, best.values))
        start = " ".join(f"{value:.4g}" for value in best.values.values())
        line = ax.semilogy(np.arange(1, len(ours) + 1), ours, label=f"{name}, phi0 = {start}")[0]
        for j, value in table.items():
            row = {"reading": reading, "scheme": name, "phi0": start, "trial": j}
            row |= {"role": "fitted" if j in fitted else "judged", "published": value}
            rows.append(row | {"ours": float(ours[j - 1]), "ratio": float(ours[j - 1] / value)})
        ax.plot(list(table), list(table.values()), "o", mfc="none", color=line.get_color())
    ax.set(xlabel="trial", ylabel="settled error [µm]", title=f"{reading}; circles: Table 1")
output.save(axes, folder / "start-values.png", fontsize="small")
output.write_rows(folder / "rows.csv", rows)
for reading in READINGS:
    judged = [r for r in rows if r["role"] == "judged" and r["reading"] == reading]
    met = sum(abs(r["ratio"] - 1) <= 0.3 for r in judged)
    print(
        f"{reading}: 5 free numbers fitted to 7 printed ones; of the {len(judged)} judged rows "
        f"{met} are met within 30 %"
    )
