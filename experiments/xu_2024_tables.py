"""Xu 2024: Tables 1 and 2, errors by trial (Fig. 8), disturbance (Fig. 10 to 12), theory."""

import numpy as np
import output
from printed_tables import XU_1, XU_2

import jaxilc
from jaxilc.scenarios.xu_2024 import FITTED
from jaxilc.theory import contraction, sliding

jaxilc.setup()
folder = output.folder(__file__)
rows, histories = [], {}
for name, table, load in (("Table 1", XU_1, 0.0), ("Table 2", XU_2, 1.0)):
    s = jaxilc.scenarios.load("xu-2024", load=load)
    keep = jaxilc.Keep.of(s.functions, "e", "u")
    for scheme, printed in table.items():
        history = jaxilc.learn(s.machine, s.schemes[scheme], s.task, s.trials, save=keep)
        histories[name, scheme] = history
        ours = (
            1e3 * float(history.settled_error[-1, 0]),
            1e3 * float(history.saved["settled_rms"][-1]),
        )
        row = {
            "table": name,
            "scheme": scheme,
            "max published": printed[0],
            "max": ours[0],
            "RMS published": printed[1],
            "RMS": ours[1],
        }
        rows.append(row | {"chattering V/s": float(np.ravel(history.saved["chattering"][-1])[0])})
output.write_rows(folder / "rows.csv", rows)
for name, table in (("Table 1", XU_1), ("Table 2", XU_2)):
    ours = {r["scheme"]: r["max"] for r in rows if r["table"] == name}
    printed = table["ilc-asmc"][0] / table["asmc"][0]
    print(
        f"{name}: ilc-asmc / asmc, largest error: {ours['ilc-asmc'] / ours['asmc']:.3f} "
        f"(published {printed:.3f})"
    )

s = jaxilc.scenarios.load("xu-2024")
top, bottom = output.axes(2, 1, size=(7.2, 6.0))
learned = histories["Table 1", "ilc-asmc"]
for j in (2, 4, 6, 8, 10):
    top.plot(
        s.task.time, 1e3 * np.asarray(learned.saved["e"])[j - 1, :, 0], lw=0.8, label=f"trial {j}"
    )
top.set(
    xlabel="time [s]", ylabel="error [nm]", title="Fig. 8: ILC-ASMC without load", ylim=(-600, 700)
)
top.legend(ncols=5, fontsize="small")
for load, disturbance, label in (
    (0.0, "none", "none"),
    (1.0, "none", "1 N load"),
    (0.0, "multi", "multi-frequency"),
):
    options = {"load": load, "disturbance": disturbance}
    here = jaxilc.scenarios.load("xu-2024", **options)
    keep = jaxilc.Keep.of(here.functions)
    found = jaxilc.learn(here.machine, here.schemes["ilc-asmc"], here.task, 20, save=keep)
    largest = 1e3 * np.asarray(found.settled_error)[:, 0]
    (line,) = bottom.semilogy(np.arange(1, 21), largest, "o-", label=label)
    printed = {"none": XU_1, "1 N load": XU_2}.get(label, {}).get("ilc-asmc")
    if printed:
        bottom.plot(10, printed[0], "s", ms=11, mfc="none", color=line.get_color())
    rms = 1e3 * np.ravel(found.saved["settled_rms"])
    for name, errors in (("largest", largest), ("RMS", rms)):
        print(f"{label}: {name} error by trial [nm]", np.round(errors).astype(int))
bottom.set(xlabel="trial", ylabel="largest error [nm]", xticks=range(2, 21, 2))
bottom.set(title="Fig. 12: by disturbance; squares: Tables 1 and 2")
output.plain(bottom)
bottom.grid(True, which="both", alpha=0.25)
bottom.legend()
top.figure.savefig(folder / "figures-8-12.png")

# Theory: the sliding condition along a trial of ASMC, and the contraction of the whole nonlinear
# learning map.
asmc = s.schemes["asmc"]
trial = jaxilc.learn(s.machine, asmc, s.task, 1).final
found = sliding.sliding(asmc, trial)
print(
    f"sliding condition on asmc: |f| reaches {found.condition.value:.3g} times the switching "
    "authority; it is below in"
)
print(
    f"    {found.dominated:.1%} of the samples; V falls outside the layer in {found.falling:.1%} "
    "of them"
)
for premise in found.condition.premises:
    print(f"    {premise.name}: {premise.detail}")
short = jaxilc.Task(s.task.reference[:501], dt=s.task.dt, settle=None)
sigma = contraction.contracting(jaxilc.Machine(s.machine.plant), s.schemes["ilc-asmc"], short)
print(
    f"learning map over 50 ms: largest singular value {sigma.value:.4f}, {sigma.verdict}: "
    f"{'; '.join(p.name for p in sigma.broken)}"
)
print(f"fitted numbers: {FITTED}")
