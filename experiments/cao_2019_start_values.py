"""Cao 2019, Table 1: start values of the estimates, which are not printed, by least squares.

The least squares go through the whole learning process. The values are fitted to every other row of
the table and tested on the rest. CFDL has one free number, FFDL has four.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np
import output

import jaxilc
from jaxilc.identification import fit
from jaxilc.scenarios.cao_2019 import FITTED, TABLE_1

jaxilc.setup()
folder = output.folder(__file__)
s = jaxilc.scenarios.load("cao-2019", plant="printed")
RANGES = {
    "cfdl-mfailc": {"phi": (-1.0, -0.01)},
    "ffdl-mfailc": {
        "phi_y1": (-1.5, 1.5),
        "phi_y2": (-1.5, 1.5),
        "phi_u1": (-0.5, -0.01),
        "phi_u2": (-0.5, 0.5),
    },
}


def errors(name, reset, values):
    """(J,) settled errors [µm] with these start values."""
    scheme = dataclasses.replace(
        s.schemes[name], phi0=jnp.stack([jnp.asarray(values[n]) for n in RANGES[name]]), reset=reset
    )
    return (
        s.shown_scale
        * jaxilc.learn(s.machine, scheme, s.task, max(TABLE_1[name])).settled_error[:, 0]
    )


rows, ax = [], output.axes()
for name, ranges in RANGES.items():
    table, fitted = TABLE_1[name], np.array(FITTED[name])
    printed = jnp.array([table[j] for j in FITTED[name]])
    for reset in ("book", "sign"):

        def residuals(values, name=name, reset=reset, fitted=fitted, printed=printed):
            return jnp.log(errors(name, reset, values)[fitted - 1] / printed)

        best = fit(residuals, ranges, starts=128, refine=6)
        ours = np.asarray(errors(name, reset, best.values))
        start = " ".join(f"{value:.3g}" for value in best.values.values())
        ax.semilogy(np.arange(1, len(ours) + 1), ours, label=f"{name}, {reset}, phi0 = {start}")
        for j, value in table.items():
            role = "fitted" if j in fitted else "judged"
            row = {
                "scheme": name,
                "reset": reset,
                "phi0": start,
                "trial": j,
                "role": role,
                "published": value,
            }
            rows.append(row | {"ours": float(ours[j - 1]), "ratio": float(ours[j - 1] / value)})
    ax.plot(list(table), list(table.values()), "o", mfc="none", label=f"{name}, published")
ax.set(xlabel="trial", ylabel="settled error [µm]")
ax.legend(fontsize="small")
ax.grid(True, which="both", alpha=0.25)
ax.figure.savefig(folder / "start-values.png")
output.write_rows(folder / "rows.csv", rows)
judged = [r for r in rows if r["role"] == "judged" and r["reset"] == "sign"]
met = sum(abs(r["ratio"] - 1) <= 0.3 for r in judged)
print(
    f"reset `sign`: 5 free numbers fitted to 7 printed ones; of the {len(judged)} judged rows "
    f"{met} are met within 30 %"
)
