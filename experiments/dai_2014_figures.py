"""Dai 2014, Fig. 2 to 9: tracking and error of PID and CFDL-MFAPC at 0.5 and 2.5 Hz."""

import output

import jaxilc
from jaxilc import figures

jaxilc.setup()
folder = output.folder(__file__)
for frequency in (0.5, 2.5):
    s = jaxilc.scenarios.load("dai-2014", plant="printed", frequency=frequency)
    dataset, _ = jaxilc.run_schemes(s.machine, s.schemes, s.task, 1)
    for name in s.schemes:
        axes = figures.tracking(dataset, name, (1,), unit=s.shown_unit)
        figures.save(axes, folder / f"{name}-{frequency:g}-Hz.png")
output.write_rows(folder / "rows.csv", [row.as_dict() for row in jaxilc.reproduce(["dai-2014"])])
