"""Cao 2019, Table 2 and Fig. 15 to 18: CFDL-MFAILC against PID on the rig at five frequencies."""

import output
from printed_tables import CAO_2

import jaxilc
from jaxilc import figures

jaxilc.setup()
folder = output.folder(__file__)
rows = jaxilc.reproduce(["cao-2019-rig"])
ax = output.axes()
for scheme, colour in (("pid", "C0"), ("cfdl-mfailc", "C1")):
    ours = [r.ours for r in rows if r.published.scheme == scheme]
    printed = CAO_2[scheme]
    ax.semilogy(list(printed), ours, "-", color=colour, label=scheme)
    ax.plot(list(printed), list(printed.values()), "o", mfc="none", color=colour)
ax.set(
    xlabel="frequency [Hz]",
    ylabel="settled error [µm]",
    title="lines: simulated, reading within-samples; circles: Table 2",
)
output.plain(ax)
ax.set_xticks(list(CAO_2["pid"]))
ax.grid(True, which="both", alpha=0.25)
ax.legend()
ax.figure.savefig(folder / "table-2.png")
s = jaxilc.scenarios.load("cao-2019-rig", frequency=0.5)
dataset, _ = jaxilc.run_schemes(s.machine, s.schemes, s.task, 1)
for name, trials in {"pid": (1,), "cfdl-mfailc": (1,)}.items():
    axes = figures.tracking(dataset, name, trials, scale=s.shown_scale, unit=s.shown_unit)
    figures.save(axes, folder / f"tracking-{name}.png")
output.write_rows(folder / "rows.csv", [row.as_dict() for row in rows])
