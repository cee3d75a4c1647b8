"""Cao 2019, Table 1 and Fig. 5 to 12: errors by trial of four schemes on the plant of eq. 29.

The schemes are CFDL- and FFDL-MFAILC, ILC-MFAPC and PID, under the reading `stroke`.
"""

import output

import jaxilc
from jaxilc import figures

jaxilc.setup()
folder = output.folder(__file__)
s = jaxilc.scenarios.load("cao-2019", plant="printed", reading="stroke")
dataset, _ = jaxilc.run_schemes(s.machine, s.schemes, s.task, s.trials)
shown = {"scale": s.shown_scale, "unit": s.shown_unit}
figures.save(figures.error_by_trial(dataset, published=s.due, **shown), folder / "table-1.png")
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
