"""Li 2020: the signals within a trial, Fig. 4 to 8, 16, 22 to 27, 29 to 31, 33 and 34.

    figures-4-8.png     the butterfly, position and speed of its axis X (4 to 6); the error under
                        feedback alone and with speed feedforward (7, 8)
    figure-16.png       the part of the error above the critical frequency, without a filter
    figures-22-26.png   the frequency of a chirp and of the axis at each sample (22, 26), speed and
                        error without iteration and after 8 (23 to 25)
    figure-27.png       errors with the fixed and the switchable filter
    figures-29-31.png   ten runs under feedback, and their RMS error with another position loop
    figures-33-34.png   spectrum of one error, and of the mean of 100

`li_2020_figures.py` draws Fig. 11 to 15, 18, 35 to 39, 41 and 42 and, as the scheme `stop`, 40.
Fig. 1 to 3, 9, 10, 17, 19 to 21 and 32 are block diagrams and sketches, and Fig. 28 is a photo.
The paper prints samples, which are the abscissa here, but no chirp, no second position loop of
Fig. 31, and no band of Fig. 16: a chirp from 0.5 to 20 Hz, a gain 1.5 times as large, and the
frequencies at which learning amplifies are taken.
"""

import dataclasses

import jax
import numpy as np
import output
import scipy.signal

import jaxilc
from jaxilc.filters.switching import instantaneous_frequency
from jaxilc.scenarios.li_2020 import DERIVATIVE, PROPORTIONAL, butterfly_path
from jaxilc.theory import frequency

jaxilc.setup()
folder = output.folder(__file__)
SHARP = (2915, 5249, 6093, 7576)  # printed interpolation points
simulation, experiment = (
    jaxilc.scenarios.load("li-2020", setting=setting) for setting in ("simulation", "experiment")
)
DT, path = simulation.task.dt, butterfly_path()
samples = np.arange(len(path))
speed = np.gradient(path[:, 0], DT)


def errors(s, scheme, trials, key=0):
    """(J, N+1) errors of each trial of a scheme, by its name or itself [µm]."""
    law = s.schemes[scheme] if isinstance(scheme, str) else scheme
    kept = jaxilc.Keep(("e",))
    found = jaxilc.learn(s.machine, law, s.task, trials, key=jax.random.key(key), save=kept)
    return 1e3 * np.asarray(found.saved["e"])[:, :, 0]


def saved(axes, name: str, label="sample") -> None:
    """Label, grid and legend of the axes of a figure, and its file."""
    axes[-1].set(xlabel=label)
    output.save(axes, folder / name, fontsize="small", loc="upper right")


def rms(e):
    return np.sqrt(np.mean(np.atleast_2d(e)[:, 1:] ** 2, axis=1))


# Fig. 4 to 8
alone, ahead = errors(simulation, "feedback", 1)[0], errors(simulation, "feedforward", 1)[0]
axes = output.axes(5, 1, size=(7.2, 11.0))
axes[0].plot(*path.T, lw=0.9)
axes[0].set(title="Fig. 4: the butterfly", xlabel="x [mm]", ylabel="y [mm]", aspect="equal")
for ax, signal, title, label in (
    (axes[1], path[:, 0], "Fig. 5 and 6: axis X", "position [mm]"),
    (axes[2], speed, "Fig. 6: its speed", "speed [mm/s]"),
    (axes[3], alone, "Fig. 7: feedback alone; dashed: printed ±60 µm", "error [µm]"),
    (axes[4], ahead, "Fig. 8: with speed feedforward; dashed: printed ±18 µm", "error [µm]"),
):
    ax.plot(samples, signal, lw=0.7)
    ax.set(title=title, ylabel=label)
for ax, value in ((axes[3], 60.0), (axes[4], 18.0)):
    output.printed_at(ax, value)
saved(axes, "figures-4-8.png")

# Fig. 16: what grows lies above the critical frequency
law = experiment.schemes["p-type"]
critical = frequency.learning_condition(experiment.machine, law, experiment.task).critical
high = scipy.signal.butter(4, critical, "high", fs=1 / DT, output="sos")
grown = scipy.signal.sosfiltfilt(high, errors(experiment, "p-type", 30), axis=1)
axes = output.axes(4, 1, size=(7.2, 7.0))
for ax, j in zip(axes, (1, 6, 15, 30), strict=True):
    ax.plot(samples, grown[j - 1], lw=0.4, label=f"trial {j}, RMS {rms(grown[j - 1])[0]:.2f} µm")
    ax.set(ylabel="error [µm]", ylim=1.05 * np.max(np.abs(grown[29])) * np.array([-1, 1]))
axes[0].set(title=f"Fig. 16: the error above {critical:.0f} Hz, without a filter")
saved(axes, "figure-16.png")

# Fig. 22 to 26
time = np.arange(0.0, 4.0, DT)
chirp = scipy.signal.chirp(time, 0.5, 4.0, 20.0)
axes = output.axes(5, 1, size=(7.2, 11.0))
axes[0].plot(time / DT, chirp, lw=0.5, color="#aaaaaa")
of_chirp = axes[0].twinx()
of_chirp.plot(time / DT, instantaneous_frequency(chirp, DT, window=0.2), label="found")
of_chirp.plot(time / DT, 0.5 + 19.5 * time / 4.0, "--", label="its law")
of_chirp.set(ylabel="frequency [Hz]")
of_chirp.legend(fontsize="small", loc="upper left")
axes[0].set(title="Fig. 22: a chirp from 0.5 to 20 Hz (grey)", ylabel="chirp")
axes[1].plot(samples, path[:, 0], lw=0.8, label="position [mm]")
axes[1].plot(samples, speed, lw=0.8, label="speed [mm/s]")
axes[1].set(title="Fig. 23: axis X", ylabel="[mm], [mm/s]")
fixed, switched = (errors(simulation, name, 40) for name in ("fixed-filter", "switchable"))
for ax, j, title in (
    (axes[2], 1, "Fig. 24: speed and error without iteration"),
    (axes[3], 9, "Fig. 25: speed and error after 8 iterations, fixed filter"),
):
    ax.plot(samples, fixed[j - 1], lw=0.7)
    ax.set(title=title, ylabel="error [µm]")
    beside = ax.twinx()
    beside.plot(samples, speed, lw=0.6, color="#aaaaaa")
    beside.set(ylabel="speed [mm/s], grey")
axes[4].plot(samples, instantaneous_frequency(path[:, 0], DT, window=0.2), lw=0.8)
axes[4].set(title="Fig. 26: frequency of axis X; dashed: the printed points", ylabel="[Hz]")
for ax in axes[2:]:
    for k in SHARP:
        ax.axvline(k, color="#d55e00", ls="--", lw=0.7)
saved(axes, "figures-22-26.png")

# Fig. 27
axes = output.axes(2, 1, size=(7.2, 6.0))
for e, name in ((fixed, "fixed filter, 10 Hz"), (switched, "switchable filter, 10 and 50 Hz")):
    axes[0].plot(samples, e[8], lw=0.7, label=f"{name}: max {np.max(np.abs(e[8])):.1f} µm")
    axes[1].semilogy(np.arange(1, len(e) + 1), rms(e), label=name)
output.printed_at(axes[0], 10.0, "fixed filter, printed: 10 µm")
axes[0].set(title="Fig. 25, 27: after 8 iterations", xlabel="sample", ylabel="error [µm]")
axes[0].set(ylim=(-16, 26))
axes[1].set(ylabel="RMS error [µm]")
saved(axes, "figure-27.png", "trial")

# Fig. 29 to 31: the runs differ by the noise of the encoder alone
runs = errors(experiment, "feedback", 10)
stiff = dataclasses.replace(experiment.schemes["feedback"], kp=1.5 * PROPORTIONAL, kd=DERIVATIVE)
axes = output.axes(3, 1, size=(7.2, 7.5))
for j, e in enumerate(runs):
    axes[0].plot(samples, e, lw=0.4, label=None if j else "10 runs, one upon the other")
axes[0].set(title="Fig. 29: errors under feedback", xlabel="sample", ylabel="error [µm]")
for ax, e, printed, title in (
    (axes[1], runs, 0.3, "Fig. 30"),
    (axes[2], errors(experiment, stiff, 10), 1.0, "Fig. 31: gain of the position loop 1.5 times"),
):
    of_run = rms(e)
    middle = np.mean(of_run)
    ax.axhspan(middle - printed / 2, middle + printed / 2, color="#dddddd", label="printed spread")
    ax.set(ylim=(middle - 0.8 * printed, middle + 0.8 * printed))
    ax.plot(np.arange(1, 11), of_run, "o-", label=f"spread {np.ptp(of_run):.3f} µm")
    ax.set(title=title, ylabel="RMS error [µm]")
    print(f"{title}: RMS {middle:.2f} µm, spread over 10 runs {np.ptp(of_run):.3f} µm")
saved(axes, "figures-29-31.png", "run")

# Fig. 33 and 34: the mean of 100 runs has a tenth of the noise
hundred = errors(experiment, "feedback", 100)
axes = output.axes(2, 1, size=(7.2, 6.0))
for ax, e, title in (
    (axes[0], hundred[0], "Fig. 33: the first error"),
    (axes[1], np.mean(hundred, axis=0), "Fig. 34: the mean of 100 errors"),
):
    f, power = scipy.signal.periodogram(e[1:], 1 / DT, window="hann", scaling="spectrum")
    amplitude = np.sqrt(2 * power)
    level = np.sqrt(np.mean(amplitude[f > critical] ** 2))
    ax.loglog(f[1:], amplitude[1:], lw=0.5)
    ax.axhline(
        level, color="#d55e00", ls="--", lw=0.8, label=f"above {critical:.0f} Hz: {level:.2g} µm"
    )
    ax.set(title=title, ylabel="amplitude [µm]", ylim=(1e-4, 1e2))
    print(f"{title}: lines above {critical:.0f} Hz have {level:.3g} µm RMS")
saved(axes, "figures-33-34.png", "frequency [Hz]")
