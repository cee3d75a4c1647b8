"""Xu 2024: tracking in Fig. 6, 7, 9 and 11, the responses of Fig. 5, and the force of Fig. 10.

    figure-5.png        the identified model, and the servo with a mode that it leaves out
    figures-6-7.png     PID, SMC and ASMC against ILC-ASMC in trial 10
    figure-9.png        ASMC and ILC-ASMC under the load of 1 N
    figures-10-11.png   the periodic force, and tracking in trials 1 and 10 under it

`xu_2024_tables.py` draws Fig. 8 and 12. Fig. 1 and 4 are photographs and drawings of the rig, and
Fig. 2 and 3 are block diagrams. The reading is `large-gain`. The mode of Fig. 5 and the force of
Fig. 10 are printed as pictures only: 900 Hz, and 1, 0.6 and 0.4 N at 20, 65 and 110 Hz, are taken.
The servo of the tables has no such mode; Fig. 5 alone uses it.
"""

import jax
import jax.numpy as jnp
import numpy as np
import output
from printed_tables import XU_1, XU_2

import jaxilc
from jaxilc.plants import fast_tool_servo
from jaxilc.scenarios.xu_2024 import servo

jaxilc.setup()
folder = output.folder(__file__)
COLOURS = {"pid": "#777777", "smc": "#e69f00", "asmc": "#0072b2", "ilc-asmc": "#d55e00"}
LEGEND = {"fontsize": "small", "loc": "upper right"}


def scenario(**options):
    return jaxilc.scenarios.load("xu-2024", **options)


def kept(s, name):
    """Outputs and errors of each trial of a scheme, both (J, N+1) [µm] and [nm]."""
    law = s.schemes[name]
    trials = s.trials if law.learns else 1
    found = jaxilc.learn(s.machine, law, s.task, trials, save=jaxilc.Keep(("y", "e"))).saved
    return np.asarray(found["y"])[:, :, 0], 1e3 * np.asarray(found["e"])[:, :, 0]


def compared(s, names, printed, title, name):
    """Output in the last two periods, and error over the whole trial, of the last trial."""
    top, bottom = output.axes(2, 1, size=(7.2, 6.4))
    time, r = s.task.time, np.asarray(s.task.reference)[:, 0]
    late = time >= time[-1] - 0.05
    top.plot(time[late], r[late], color="#aaaaaa", lw=3, label="reference")
    for scheme in names:
        y, e = kept(s, scheme)
        settled = e[-1, round(0.1 / s.task.dt) :]
        ours = f"{np.max(np.abs(settled)):.0f} / {np.sqrt(np.mean(settled**2)):.0f}"
        said = f"{scheme}: {ours} nm" + (
            f" (printed {printed[scheme][0]:.0f} / {printed[scheme][1]:.0f})" if printed else ""
        )
        top.plot(time[late], y[-1, late], "--", lw=1.0, color=COLOURS[scheme], label=scheme)
        bottom.plot(time, e[-1], lw=0.6, color=COLOURS[scheme], label=said)
    top.set(ylabel="position [µm]", title=title)
    reach = 1.2 * max(np.max(np.abs(line.get_ydata()[1000:])) for line in bottom.lines)
    bottom.set(ylabel="error [nm]", xlabel="time [s]", ylim=(-reach, 2.0 * reach))
    bottom.set_title("error: largest / RMS from 0.1 s on (before it, cut off)", fontsize="medium")
    output.save((top, bottom), folder / name, "major", **LEGEND)


def responses() -> None:
    """Fig. 5: magnitude and phase from volt to µm."""
    f = np.geomspace(10.0, 3000.0, 2000)
    top, bottom = output.axes(2, 1, size=(7.2, 5.6))
    model, measured = fast_tool_servo(), fast_tool_servo("full")
    linear = jax.tree.map(np.asarray, measured.linear())
    s = 2j * np.pi * f
    # hysteresis lowers the gain of a small stroke by 1 - A
    small = 1 - float(measured.hysteresis.initial_slope)
    found = (
        np.array(
            [
                (linear.C @ np.linalg.solve(si * np.eye(len(linear.A)) - linear.A, linear.B))[0, 0]
                for si in s
            ]
        )
        * small
    )
    a1, a2, b = map(float, model.coefficients)
    for G, label, look in (
        (found, "with a mode at 900 Hz and creep", "-"),
        (b / (s**2 + a2 * s + a1), "identified, 2.229e7 / (s² + 70.16 s + 2.413e6)", "--"),
    ):
        top.semilogx(f, 20 * np.log10(np.abs(G)), look, label=label)
        bottom.semilogx(f, np.rad2deg(np.unwrap(np.angle(G))), look)
    top.set(ylabel="magnitude [dB of µm/V]", title="Fig. 5: open loop")
    bottom.set(ylabel="phase [°]", xlabel="frequency [Hz]")
    output.save((top, bottom), folder / "figure-5.png", fontsize="small")


def disturbed() -> None:
    """Fig. 10 and 11."""
    s = scenario(disturbance="multi")
    time, force = s.task.time, servo(0.06, None, "multi").periodic
    top, middle, bottom = output.axes(3, 1, size=(7.2, 7.6))
    waves = force.amplitudes * jnp.sin(
        2 * jnp.pi * force.frequencies * time[:, None] + force.phases
    )
    top.plot(time, np.sum(np.asarray(waves), axis=1), lw=0.8)
    top.set(ylabel="force [N]", title="Fig. 10: the periodic force")
    y, e = kept(s, "ilc-asmc")
    late = time >= time[-1] - 0.1
    middle.plot(time[late], np.asarray(s.task.reference)[late, 0], color="#aaaaaa", lw=3)
    for j, look in ((1, ":"), (10, "--")):
        middle.plot(time[late], y[j - 1, late], look, lw=1.2, label=f"trial {j}")
        bottom.plot(time, e[j - 1], lw=0.6, label=f"trial {j}")
    middle.set(ylabel="position [µm]", title="Fig. 11: ILC-ASMC under it; grey: reference")
    bottom.set(ylabel="error [nm]", xlabel="time [s]")
    output.save((top, middle, bottom), folder / "figures-10-11.png", "major", **LEGEND)


responses()
compared(scenario(), tuple(XU_1), XU_1, "Fig. 6 and 7: 20 µm at 40 Hz", "figures-6-7.png")
compared(scenario(load=1.0), tuple(XU_2), XU_2, "Fig. 9: under a load of 1 N", "figure-9.png")
disturbed()
