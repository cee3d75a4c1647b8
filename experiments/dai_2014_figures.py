"""Dai 2014, Fig. 2 to 9: tracking and error of PID and CFDL-MFAPC at 0.5 and 2.5 Hz."""

import output

import jaxilc
from jaxilc import figures

jaxilc.setup()
folder = output.folder(__file__)
rows = jaxilc.reproduce(["dai-2014"])
for row in rows:
    frequency, name = dict(row.published.options)["frequency"], row.published.scheme
    s = jaxilc.scenarios.load("dai-2014", frequency=frequency)
    dataset, _ = jaxilc.run_schemes(s.machine, s.select((name,)).schemes, s.task, 1)
    axes = figures.tracking(dataset, name, (1,), zoom=s.task.settle, unit=s.shown_unit)
    settled, printed = axes[1, 1], row.published.value
    output.printed_at(settled, printed)
    reach = 1.3 * max(printed, row.ours)
    settled.set(ylim=(-reach, reach))
    settled.set_title(f"dashed: printed {printed:g}; ours {row.ours:.3g}", fontsize="small")
    figures.save(axes, folder / f"{name}-{frequency:g}-Hz.png")
output.write_rows(folder / "rows.csv", [row.as_dict() for row in rows])
