"""MILC 2024, Table 1 and Fig. 9 to 11: direct and multivariable learning, and Proposition 1.

The reading is the one by which `reproduce` judges. Proposition 1 is tested on every trial of direct
learning.
"""

import dataclasses

import numpy as np
import output
from printed_tables import MILC_1

import jaxilc
from jaxilc.scenarios.milc_2024 import table_rms

jaxilc.setup()
folder = output.folder(__file__)
s = jaxilc.scenarios.load("milc-2024")
keep = jaxilc.Keep(
    ("e", "u"), (*s.functions.items(), ("feedback", lambda trial: trial.signals["feedback"][:, 0]))
)
found = {
    name: jaxilc.learn(s.machine, scheme, s.task, s.trials, save=keep).saved
    for name, scheme in s.schemes.items()
}
quiet = dataclasses.replace(s.machine, sensor=None)
found_quiet = {
    name: jaxilc.learn(quiet, scheme, s.task, s.trials, save=table_rms).saved
    for name, scheme in s.schemes.items()
}

rows = []
for (name, trial, quantity), value in MILC_1.items():
    ours = 1e3 * float(found[name][quantity][trial - 1])
    row = {"scheme": name, "trial": trial - 1, "quantity": quantity}
    rows.append(row | {"published": value, "ours": ours, "ratio": ours / value})
output.write_rows(folder / "rows.csv", rows)

COLOURS = {"dilc": "#0072b2", "milc": "#d55e00"}
ax = output.axes()
trials = np.arange(s.trials)  # counted as in the paper
for name, colour in COLOURS.items():
    for errors, look, label in (
        (found[name]["table_rms"], "o-", "table"),
        (found[name]["motor_rms"], "s--", "motor"),
        (found_quiet[name], ":", "table, without noise"),
    ):
        ax.semilogy(trials, 1e3 * np.asarray(errors), look, color=colour, label=f"{name}, {label}")
    for quantity, marker in (("table_rms", "o"), ("motor_rms", "s")):
        printed = [MILC_1[name, j, quantity] for j in (1, 11)]
        ax.plot([0, 10], printed, marker, mfc="none", ms=11, color=colour, ls="none")
ax.set(
    xlabel="trial (0: feedback alone)",
    ylabel="RMS error [µm]",
    title="Fig. 9; large open markers: published",
)
output.plain(ax)
output.save(ax, folder / "figure-9.png", fontsize="small")

top, bottom = output.axes(2, 1, size=(7.2, 6.0))
time = s.task.time
for name, colour in COLOURS.items():
    for ax, signal, label in (
        (top, 1e3 * np.asarray(found[name]["e"])[-1, :, 1], "table's error"),
        (bottom, np.asarray(found[name]["feedback"])[-1], "feedback's share"),
    ):
        label = f"{name}: {label}, trial 10"
        ax.plot(time[: len(signal)], signal, color=colour, lw=0.6, label=label)
top.set(ylabel="error [µm]", title="Fig. 10 and 11; reading: short-stroke")
bottom.set(ylabel="input [V]", xlabel="time [s]")
output.save((top, bottom), folder / "figures-10-11.png", "major", fontsize="small")

effort = {name: float(kept["feedback_effort"][-1]) for name, kept in found.items()}
times = effort["dilc"] / effort["milc"]
print(
    f"feedback effort in trial 10: dilc {effort['dilc']:.4f} V, milc {effort['milc']:.4f} V, "
    f"{times:.0f} times less"
)

# Proposition 1 (a): e_z = P_Z e_c + (1 - P_Z) r_d, so |(1 - P_Z) r_d| <= |e_z| + |P_Z| |e_c|, and
# where e_z = 0, e_c = (1 - 1/P_Z) r_d
numerator, denominator = (np.asarray(p) for p in quiet.plant.transmission())
length = 4 * len(time)
f = np.fft.rfftfreq(length, s.task.dt)
P_Z = np.polyval(numerator, 2j * np.pi * f) / np.polyval(denominator, 2j * np.pi * f)
r, e = np.fft.rfft(np.asarray(s.task.reference)[:, 0], length), 1e3 * np.asarray(found["dilc"]["e"])


def rms(spectrum):
    return 1e3 * np.linalg.norm(np.fft.irfft(spectrum)) / np.sqrt(len(time))


sums = np.sqrt(np.mean(e[:, :, 1] ** 2, axis=1)) + np.max(np.abs(P_Z)) * np.sqrt(
    np.mean(e[:, :, 0] ** 2, axis=1)
)
least, bound = sums.min(), rms((1 - P_Z) * r)
print(
    f"Proposition 1 (a): |(1 - P_Z) r_d| = {bound:.2f} µm RMS; |e_z| + |P_Z| |e_c| is {least:.1f} "
    "at least over the trials"
)
left, stalled = rms((1 - 1 / P_Z) * r), rows[3]["ours"]
print(
    f"motor error left where the table has none: |(1 - 1/P_Z) r_d| = {left:.2f} µm RMS; dilc "
    f"stalls at {stalled:.2f}"
)
