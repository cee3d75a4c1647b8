"""MILC 2024: the responses of Fig. 2 and 7, the path of Fig. 8, and Fig. 10 magnified.

    figure-7.png      from torque to the motor's speed, P_x, and from motor to table, P_Z; with them
                      Fig. 2, parts d and e: from torque to the motor's and to the table's speed
    figures-8-10.png  position, speed and acceleration of the path; the error of the table in the
                      paper's trial 10, over the whole trial and over the stroke back

`milc_2024_table_1.py` draws Fig. 9 to 11. Fig. 1, 3, 4 and 6 are block diagrams, Fig. 2a to c are
drawings, and Fig. 5 is a photograph. Masses, stiffness and path are printed as pictures only; they
are those of the reading that `reproduce` judges.
"""

import numpy as np
import output
from printed_tables import MILC_1

import jaxilc

jaxilc.setup()
folder = output.folder(__file__)
s = jaxilc.scenarios.load("milc-2024")
drive, time, dt = s.machine.plant, np.asarray(s.task.time), s.task.dt
COLOURS = {"dilc": "#0072b2", "milc": "#d55e00"}
LEGEND = {"fontsize": "small", "loc": "upper right"}


def decibels(response):
    return 20 * np.log10(np.abs(response))


# Fig. 7, with Fig. 2d and e
f = np.geomspace(5.0, 500.0, 2000)
p = 2j * np.pi * f
mechanics = drive.mechanics()
A, B, C = (np.asarray(M) for M in (mechanics.A, mechanics.B, mechanics.C))
both = np.array([(C @ np.linalg.solve(pi * np.eye(len(A)) - A, B))[:, 0] for pi in p])
# from the command [V] to speeds [mm/s]
motor, table = (1e3 * float(drive.force_gain) * p * both[:, i] for i in (0, 1))
axes = output.axes(2, 1, size=(7.2, 6.4))
axes[0].semilogx(f, decibels(motor), label="to the motor's speed, P_x")
axes[0].semilogx(f, decibels(table), "--", label="to the table's speed")
axes[0].set(ylabel="magnitude [dB of mm/(s V)]", title="Fig. 7 and 2d, e: from the torque command")
axes[1].semilogx(f, decibels(table / motor), label="from motor to table, P_Z")
axes[1].set(ylabel="magnitude [dB]", xlabel="frequency [Hz]")
for ax in axes:
    for value, name in ((drive.antiresonance, "antiresonance"), (drive.resonance, "resonance")):
        ax.axvline(float(value), color="#777777", ls=":", lw=1.0)
        ax.annotate(name, (float(value), ax.get_ylim()[0]), rotation=90, fontsize="small")
output.save(axes, folder / "figure-7.png", **LEGEND)

# Fig. 8 and 10
r = np.asarray(s.task.reference)[:, 0]
speed = np.gradient(r, dt)
axes = output.axes(5, 1, size=(7.2, 11.0))
for ax, signal, label in (
    (axes[0], r, "position [mm]"),
    (axes[1], speed, "speed [mm/s]"),
    (axes[2], 1e-3 * np.gradient(speed, dt), "acceleration [m/s²]"),
):
    ax.plot(time, signal, lw=0.9)
    ax.set(ylabel=label)
moving = time[np.abs(speed) > 0.01 * np.max(np.abs(speed))]
start = moving[np.argmax(np.diff(moving)) + 1]  # of the stroke back, after the longest rest
back = (time > start - 0.02) & (time < moving[-1] + 0.04)
for name, colour in COLOURS.items():
    kept = jaxilc.learn(s.machine, s.schemes[name], s.task, s.trials, save=jaxilc.Keep(("e",)))
    e = 1e3 * np.asarray(kept.saved["e"])[-1, :, 1]
    for ax, part in ((axes[3], time >= 0), (axes[4], back)):
        printed = MILC_1[name, s.trials, "table_max"]
        label = f"{name}: max {np.max(np.abs(e)):.2f} µm (printed {printed:g})"
        ax.plot(time[part], e[part], lw=0.7, color=colour, label=label)
for ax in axes[3:]:
    ax.set(ylabel="error of the table [µm]", ylim=(-3.2, 5.0))
axes[0].set(title="Fig. 8: the path")
axes[3].set(title="Fig. 10: the paper's trial 10")
axes[4].set(title="Fig. 10, magnified: the stroke back", xlabel="time [s]")
output.save(axes, folder / "figures-8-10.png", **LEGEND)
