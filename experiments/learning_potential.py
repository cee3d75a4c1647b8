"""What learning leaves, predicted from a few repeats: five simulated rigs, and a measured axis.

The rigs share no code with the package: plain NumPy, a mass or two with friction, noise, cogging,
dead time and an encoder under a sampled feedback. Six repeats without learning give the prediction
of `jaxilc potential`; then a law with the inverse of the linear rig and the predicted cutoff learns
for 120 trials. The error it settles at is compared with what was predicted to be left.

The measured axis is `arizona_x_trials.npz` in the folder that JAXILC_MEASURED names: of each of its
seven motions the first three trials predict the rms about the mean of all four, and the fourth is
judged against what is new.
"""

import math
from typing import NamedTuple

import numpy as np
from output import measured_folder
from scipy.signal import butter, lfilter

from jaxilc.identification import potential_of

DT, N, INNER = 1e-3, 1500, 3
REPEATS, TRIALS, LAST, GAIN = 6, 120, 40, 0.2
FACTORS = (1.0, 0.5, 2.0)  # of the cutoff that is predicted


class Rig(NamedTuple):
    """One or two masses [kg] with a spring [N/m] between, friction [N], [N s/m], cogging [N].

    force: rms of the force that is new in each trial [N], below `slow` [Hz]; None: white
    noise, step: rms of the noise and resolution of the encoder [m];  late: dead time [samples]
    begins: rms of the place where a trial begins [m];  elsewhere: that of the first trial [m]
    """

    mass: float
    load: float = 0.0
    stiffness: float = 0.0
    damping: float = 0.0
    coulomb: float = 0.0
    viscous: float = 0.0
    cogging: float = 0.0
    force: float = 0.0
    slow: float | None = None
    noise: float = 0.0
    step: float = 0.0
    late: int = 0
    kp: float = 0.0
    kd: float = 0.0
    stroke: float = 0.1
    begins: float = 0.0
    elsewhere: float = 0.0


RIGS = {
    "belt axis": Rig(
        10, coulomb=8, viscous=40, force=1.5, slow=20, step=1e-6, late=2, kp=4e4, kd=800
    ),
    "linear motor with cogging": Rig(
        4, coulomb=2, viscous=10, cogging=5, force=0.6, noise=3e-7, step=1e-7, late=1, kp=3e4,
        kd=400,
    ),
    "two masses, encoder at the load": Rig(
        6, load=4, stiffness=4e5, damping=60, coulomb=4, viscous=30, force=2.0, slow=40,
        noise=1e-6, step=5e-7, kp=1.5e3, kd=120,
    ),
    "table that sticks, coarse encoder": Rig(
        30, coulomb=40, viscous=150, force=4, slow=8, step=5e-6, late=3, kp=1.2e5, kd=2500,
        stroke=0.05,
    ),
    "axis that begins elsewhere": Rig(
        8, coulomb=6, viscous=60, force=0.8, slow=3, noise=5e-7, step=1e-6, late=1, kp=4e4,
        kd=700, begins=2e-6, elsewhere=2e-4,
    ),
}  # fmt: skip


def motion(stroke):
    """Return a motion forth and back that rests at its ends, without a jump of acceleration."""
    t = np.arange(N) / N
    way = np.clip(np.concatenate([t[: N // 2] * 2.6 - 0.3, 2.3 - t[N // 2 :] * 2.6]), 0, 1)
    return stroke * way**4 * (35 - 84 * way + 70 * way**2 - 20 * way**3)


def played(rig, r, u, rng, begins):
    """Return the error of one trial with the feedforward u; the rest of the rig is its own."""
    force = rig.force * rng.standard_normal(N + 400)
    if rig.slow is not None:
        force = lfilter(*butter(1, 2 * DT * rig.slow), force) * math.sqrt(
            0.5 / (DT * rig.slow) / math.pi
        )
    force, noise = force[400:].tolist(), (rig.noise * rng.standard_normal(N)).tolist()
    x = z = r[0] + begins
    v = w = last = 0.0
    h, line, e, wanted, ahead = DT / INNER, [0.0] * rig.late, [], r.tolist(), u.tolist()
    for k in range(N):
        y = (z if rig.load else x) + noise[k]
        y = rig.step * round(y / rig.step) if rig.step else y
        e.append(wanted[k] - y)
        change = (e[k] - last) / DT if k else 0.0
        last = e[k]
        line.append(rig.kp * e[k] + rig.kd * change + ahead[k])
        drive = line.pop(0) + force[k]
        for _ in range(INNER):
            rub = rig.viscous * v + rig.coulomb * math.tanh(v / 5e-4)
            pull = rig.stiffness * (x - z) + rig.damping * (v - w) if rig.load else 0.0
            v += h * (drive - rub - pull - rig.cogging * math.sin(210 * x)) / rig.mass
            x += h * v
            if rig.load:
                w += h * pull / rig.load
                z += h * w
    return np.array(e)


def learned(rig, r, cutoff, rng):
    """Return the rms errors of trials under a law with the inverse of the rig without friction."""
    line = Rig(
        **rig._asdict() | dict.fromkeys(("coulomb", "cogging", "force", "noise", "step"), 0.0)
    )
    push = np.zeros(N)
    push[0] = 1.0
    flat = np.zeros(N)
    response = np.fft.rfft(
        played(line, flat, flat, rng, 0.0) - played(line, flat, push, rng, 0.0), 2 * N
    )
    f = np.fft.rfftfreq(2 * N, DT)
    keep = 1 / (1 + (f / cutoff) ** 16) if cutoff else 0 * f
    u, found = np.zeros(N), []
    for _ in range(TRIALS):
        e = played(rig, r, u, rng, rig.begins * rng.standard_normal())
        found.append(np.sqrt(np.mean(e**2)))
        E = np.fft.rfft(e, 2 * N) / response
        u = np.fft.irfft(keep * (np.fft.rfft(u, 2 * N) + GAIN * E))[:N]
    return np.array(found)


def on_rigs():
    """Print what six repeats predict to be left, beside what long learning reaches."""
    print("rig: repeats, new [its interval], left, cutoff; learning reaches, against left")
    for seed, (name, rig) in enumerate(RIGS.items()):
        rng, r = np.random.default_rng(seed), motion(rig.stroke)
        away = [rig.elsewhere or rig.begins, *(rig.begins * rng.standard_normal(REPEATS - 1))]
        e = np.stack([played(rig, r, np.zeros(N), rng, one) for one in away])
        found = potential_of(e, DT)
        settled, *others = (
            float(np.sqrt(np.mean(learned(rig, r, factor * found.cutoff.value, rng)[-LAST:] ** 2)))
            for factor in FACTORS
        )
        um = [1e6 * x for x in (found.repeatable.value, *found.new, found.left, settled)]
        print(
            f"{name}: {um[0]:.1f}, {um[1]:.2f} [{um[2]:.2f}, {um[3]:.2f}], {um[4]:.2f} um, "
            f"{found.cutoff.value:.1f} Hz; {um[5]:.2f} um, {settled / found.left - 1:+.1%} "
            f"(start {1e6 * found.start:.1f} um, drift {1e6 * found.drift:.2f} um); half and twice "
            f"the cutoff reach {1e6 * others[0]:.2f} and {1e6 * others[1]:.2f} um"
        )


def on_measured(path):
    """Print what three trials of each motion predict, beside what four show."""
    with np.load(path) as file:
        motions = {name[:-2]: file[name] for name in file.files if name.endswith("_e")}
    print(
        "motion: rms about the mean of four, predicted from three; new [its interval]; the fourth"
    )
    for name, e in motions.items():
        found, alike = potential_of(e[:3], DT), e[1:3] if potential_of(e[:3], DT).start else e[:3]
        about = float(np.sqrt(np.mean((e - e.mean(axis=0)) ** 2)))
        fourth = float(np.sqrt(np.mean((e[3] - alike.mean(axis=0)) ** 2) / (1 + 1 / len(alike))))
        new = [1e6 * x for x in found.new]
        print(
            f"{name}: {1e6 * about:.2f} um, {1e6 * found.spread(4):.2f} um "
            f"({found.spread(4) / about - 1:+.1%}); {new[0]:.2f} [{new[1]:.2f}, {new[2]:.2f}]; "
            f"{1e6 * fourth:.2f} um; first trial apart by {1e6 * found.start:.1f} um"
        )


if __name__ == "__main__":
    on_rigs()
    place = measured_folder()
    if place is not None:
        on_measured(place / "arizona_x_trials.npz")
