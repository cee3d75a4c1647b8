"""Li 2020: RMS error by trial without a filter, with a fixed and with a switchable one.

Further figures show the shares of feedback and learning in the input, and theory with simulation.
"""

import numpy as np
import output
from printed_tables import LI

import jaxilc
from jaxilc.learning import Keep, best_trial
from jaxilc.scenarios.li_2020 import DERIVATIVE, PROPORTIONAL, SETTINGS
from jaxilc.theory import frequency

jaxilc.setup()
folder = output.folder(__file__)
loaded = {setting: jaxilc.scenarios.load("li-2020", setting=setting) for setting in SETTINGS}


def run(s, name, trials=None):
    return jaxilc.learn(
        s.machine, s.schemes[name], s.task, trials or s.trials, save=Keep.of(s.functions, "e", "u")
    )


rows, (left, right) = [], output.axes(1, 2, size=(10.0, 4.2))
for ax, setting in ((left, "simulation"), (right, "experiment")):
    for name in ("p-type", "fixed-filter", "switchable", "stop", "ladder", "series"):
        trials = 40 * (5 if name == "ladder" else 1)
        found = run(loaded[setting], name, trials)
        rms = 1e3 * np.asarray(found.rms)[:: 5 if name == "ladder" else 1, 0]
        ax.semilogy(np.arange(1, 41), rms, "--" if name == "series" else "-", label=name)
        best = int(best_trial(rms[:, None])[-1])
        error = 1e3 * float(np.max(np.abs(np.asarray(found.saved["e"])[-1])))
        rows.append(
            {
                "setting": setting,
                "scheme": name,
                "best trial": best,
                "best RMS": rms[best - 1],
                "RMS 40": rms[-1],
                "max 40": error,
            }
        )
    (turns,) = LI[setting]["p-type"]["best_trial"].values()
    ax.axvline(turns, color="#777777", ls=":", label="printed: p-type rises")
    ax.set(xlabel="trial (ladder: rung of 5)", ylabel="RMSE [µm]", title=setting)
    output.plain(ax)
    ax.grid(True, which="both", alpha=0.25)
left.legend(fontsize="small")
left.figure.savefig(folder / "rmse-by-trial.png")
output.write_rows(folder / "rows.csv", rows)


# Fig. 36 to 39: learning replaces the input of the position controller; the sum is unchanged
def learned(trial):
    return (trial.u - trial.signals["feedback"])[:, 0]


s = loaded["experiment"]
keep = Keep(("e",), (*s.functions.items(), ("learned", learned)))
found = jaxilc.learn(s.machine, s.schemes["p-type"], s.task, 5, save=keep).saved
shares = {name: np.asarray(found[f"{name}_effort"]) for name in ("feedback", "learned")}
print(
    "position controller's share, RMS by run:",
    np.round(shares["feedback"], 4),
    "what was learned:",
    np.round(shares["learned"], 4),
)
axes = output.axes(4, 1, size=(7.2, 10.0))
for j in range(5):
    e = np.asarray(found["e"])[j, :, 0]
    share, w = PROPORTIONAL * e[:-1], np.asarray(found["learned"])[j]
    printed = LI["experiment"]["p-type"]["max_error"][j + 1]
    said = f"run {j + 1}: {1e3 * np.max(np.abs(e)):.0f} ({printed:g})"
    for ax, signal in zip(axes, (1e3 * e[:-1], w, share, share + w), strict=True):
        ax.plot(s.task.time[:-1], signal, lw=0.6, label=said)
labels = {
    "error [µm]": "Fig. 36; largest error [µm], printed one in brackets",
    "learned": "Fig. 37: what was learned",
    "feedback": "Fig. 38: the position controller",
    "sum": "Fig. 39: their sum",
}
for ax, (label, title) in zip(axes, labels.items(), strict=True):
    ax.set(ylabel=label)
    ax.set_title(title, fontsize="medium")
axes[0].legend(ncols=5, fontsize="x-small", loc="lower center")
axes[0].set(ylim=(-110, 80))
axes[-1].set(xlabel="time [s]")
axes[0].figure.savefig(folder / "figures-36-39.png")

# Fig. 11 to 13: the repetitive disturbance
s = loaded["disturbance"]
found = run(s, "p-type")
ax = output.axes()
for j in (1, 10, 40, 100):
    rms = 1e3 * float(found.rms[j - 1, 0])
    printed = LI["disturbance"]["p-type"]["rms"].get(j)
    label = f"trial {j}: RMS {rms:.1f} µm" + (f" (printed {printed:g})" if printed else "")
    ax.plot(s.task.time, 1e3 * np.asarray(found.saved["e"])[j - 1, :, 0], lw=0.8, label=label)
output.printed_at(ax, LI["disturbance"]["p-type"]["max_error"][100], "printed: below 5 µm")
ax.set(xlabel="time [s]", ylabel="error [µm]", title="a repetitive disturbance from sample 625")
ax.legend()
ax.figure.savefig(folder / "disturbance.png")

# The contour error of two axes with the fixed filter.
s = jaxilc.scenarios.load("li-2020", setting="experiment", axes="xy")
found = run(s, "fixed-filter", 10)
axis_error, contour = (
    1e3 * np.asarray(x)
    for x in (np.max(np.asarray(found.max_error), axis=1), found.saved["contour_max"])
)
print(
    "two axes, by trial: largest axis error",
    np.round(axis_error, 1),
    "largest contour error [µm]",
    np.round(contour, 1),
)

# The theory: |1 - CB phi|, condition (9) and its critical frequency, and from them the trial at
# which the error turns. In frequency, with n_j the noise of trial j,
#     e_{j+1} = M e_j - S (n_{j+1} - n_j),   M = 1 - phi z G / (1 + C G),   S = 1 / (1 + C G)
# and so, in the mean,
#     |e_j|^2 = |M|^(2j-2) |e_1|^2 + |S|^2 |n|^2 (1 + |M - 1|^2 (1 - |M|^(2j-2)) / (1 - |M|^2))
for setting in ("simulation", "experiment"):
    s, phi, noise = loaded[setting], SETTINGS[setting].gain, SETTINGS[setting].noise
    test = frequency.learning_condition(s.machine, s.schemes["p-type"], s.task)
    quiet = jaxilc.Machine(s.machine.plant)
    first = np.asarray(jaxilc.learn(quiet, s.schemes["feedback"], s.task, 1).final.e)[:, 0]
    f = np.fft.rfftfreq(len(first), s.task.dt)
    z = np.exp(2j * np.pi * f * s.task.dt)
    P = np.asarray(
        frequency.response(
            frequency.linear_loop(quiet, s.schemes["p-type"], s.task), f[1:], s.task.dt
        )
    )[:, 0, 0]
    M, S = 1 - phi * z[1:] * P, 1 - (PROPORTIONAL + DERIVATIVE / s.task.dt * (1 - 1 / z[1:])) * P
    j = np.arange(1, s.trials + 1)[:, None]
    power = np.abs(M) ** (2 * (j - 1))
    tracking = power * np.abs(np.fft.rfft(first)[1:]) ** 2 / len(first)
    grown = np.abs(S * noise) ** 2 * (1 + np.abs(M - 1) ** 2 * (1 - power) / (1 - np.abs(M) ** 2))
    predicted = np.sqrt(2 * np.sum(tracking + grown, axis=1) / len(first))
    simulated = np.asarray(run(s, "p-type").rms)
    turning = best_trial(predicted[:, None])[-1], best_trial(simulated)[-1]
    ratio = predicted / simulated[:, 0]
    print(
        f"{setting}: phi = {phi:g}, |1 - CB phi| = {abs(1 - 0.0475 * phi):.4f}, sup |1 - phi z "
        f"G/(1 + C G)| = {test.condition.value:.4f}"
    )
    print(
        f"    critical frequency {test.critical:.1f} Hz; the error turns at trial {turning[0]} in "
        f"theory, {turning[1]} in simulation"
    )
    print(
        f"    RMSE predicted / simulated, over the trials: {np.min(ratio):.3f} to "
        f"{np.max(ratio):.3f}"
    )
