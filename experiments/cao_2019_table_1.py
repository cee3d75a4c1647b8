"""Cao 2019, Table 1 and Fig. 5 to 12: errors by trial of four schemes on the plant of eq. 29.

The schemes are CFDL- and FFDL-MFAILC, ILC-MFAPC and PID, under the reading `stroke`.
"""

import numpy as np
import output
from printed_tables import CAO_1

import jaxilc
from jaxilc import figures
from jaxilc.scenarios.cao_2019 import READINGS

jaxilc.setup()
folder = output.folder(__file__)
s = jaxilc.scenarios.load("cao-2019")
dataset, _ = jaxilc.run_schemes(s.machine, s.schemes, s.task, 100, quantities=s.functions)
shown = {"scale": s.shown_scale, "unit": s.shown_unit}
ax = output.axes()
for i, (name, printed) in enumerate(CAO_1.items()):
    # each scheme by the quantity that its rows are read from
    quantity, _ = READINGS["stroke"].windows.get(name, ("settled_error", 0))
    ours = s.shown_scale * np.ravel(dataset[quantity].sel(scheme=name))
    ax.semilogy(np.arange(1, len(ours) + 1), ours, color=f"C{i}", label=name)
    ax.plot(list(printed), list(printed.values()), "o", mfc="none", color=f"C{i}")
ax.set(xlabel="trial", ylabel="steady-state error [µm]", title="lines: simulated; circles: Table 1")
output.save(ax, folder / "table-1.png")
figures.save(
    figures.error_by_trial(dataset, metric="max_error", published=s.due, **shown),
    folder / "figure-5.png",
)
for name, trials in {
    "cfdl-mfailc": (2, 35, 80),
    "ffdl-mfailc": (2, 30, 60),
    "ilc-mfapc": (2, 10, 30),
    "pid": (1,),
}.items():
    figures.save(figures.tracking(dataset, name, trials, **shown), folder / f"tracking-{name}.png")
output.write_rows(folder / "rows.csv", [row.as_dict() for row in jaxilc.reproduce(["cao-2019"])])
