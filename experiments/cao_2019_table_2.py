"""Cao 2019, Table 2 and Fig. 15 to 18: CFDL-MFAILC against PID on the rig at five frequencies.

Under the reading `within-samples` CFDL-MFAILC is a P controller of 0.4 V/mm for each of its steps
within a sample. Two are judged; the paper prints 80, and the second picture has both.
"""

import output
from printed_tables import CAO_2

import jaxilc
from jaxilc import figures

jaxilc.setup()
folder = output.folder(__file__)
rows = jaxilc.reproduce(["cao-2019-rig"])
ax, by_steps = output.axes(1, 2, size=(10.0, 4.2))
for scheme, colour in (("pid", "C0"), ("cfdl-mfailc", "C1")):
    ours = [r.ours for r in rows if r.published.scheme == scheme]
    printed = CAO_2[scheme]
    ax.semilogy(list(printed), ours, "-", color=colour, label=scheme)
    ax.plot(list(printed), list(printed.values()), "o", mfc="none", color=colour)
ax.set(
    xlabel="frequency [Hz]",
    ylabel="settled error [µm]",
    title="lines: simulated, two steps a sample; circles: Table 2",
)
output.plain(ax)
ax.set_xticks(list(CAO_2["pid"]))
STEPS = (1, 2, 3, 4, 5, 10, 20, 40, 80)
ours = []
for steps in STEPS:
    s = jaxilc.scenarios.load("cao-2019-rig", frequency=0.5, passes=steps)
    found = jaxilc.learn(s.machine, s.schemes["cfdl-mfailc"], s.task, 1)
    ours.append(s.shown_scale * float(found.settled_error[0, 0]))
by_steps.loglog(STEPS, ours, "o-", color="C1", label="cfdl-mfailc at 0.5 Hz")
by_steps.plot(80, CAO_2["cfdl-mfailc"][0.5], "o", ms=9, mfc="none", color="C1", label="printed")
by_steps.axvline(2, color="#777777", ls=":", label="judged")
by_steps.set(
    xlabel="steps within a sample",
    ylabel="settled error [µm]",
    title="a P controller of 0.4 V/mm for each step",
    xticks=STEPS,
    xticklabels=STEPS,
)
by_steps.minorticks_off()
output.plain(by_steps, (1.0,))
output.save((ax, by_steps), folder / "table-2.png")
s = jaxilc.scenarios.load("cao-2019-rig", frequency=0.5)
dataset, _ = jaxilc.run_schemes(s.machine, s.schemes, s.task, 1)
for name, trials in {"pid": (1,), "cfdl-mfailc": (1,)}.items():
    axes = figures.tracking(dataset, name, trials, scale=s.shown_scale, unit=s.shown_unit)
    figures.save(axes, folder / f"tracking-{name}.png")
output.write_rows(folder / "rows.csv", [row.as_dict() for row in rows])
