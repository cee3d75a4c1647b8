"""How often the cause of a change is named, from one trial before it and one after it.

`two_mass_rig` learns four motions with a plain law in NumPy, on a drive with little friction and on
one with much. Then one thing changes while the last input is played again. The table has, for each
kind of change, how often `checks.what_changed` names which cause.
"""

import collections

import numpy as np
import output
from scipy.signal import butter, filtfilt
from two_mass_rig import DT, Rig, stroke

from jaxilc.hardware.checks import what_changed

TIME = np.arange(601) * DT
EASED = np.clip((TIME - 0.05) / 0.3, 0, 1)
MOTIONS = {
    "stroke": stroke(),
    "short stroke": np.concatenate([stroke(8.0, 0.4), np.zeros(200)]),
    "sine": 5 * np.sin(2 * np.pi * 3.333 * TIME) * np.clip(TIME / 0.15, 0, 1) ** 2,
    "one way": 15 * (10 * EASED**3 - 15 * EASED**4 + 6 * EASED**5),
}
DRIVES = Rig(), Rig(coulomb=25.0, noise=1e-3)
CHANGES = {
    "gain": [{"gain": g} for g in (0.7, 0.85, 0.93, 1.07, 1.15, 1.4)],
    "delay": [{"delay": n} for n in (3, 5, 9, 20)],
    "friction": [
        *({"coulomb": c} for c in (20.0, 30.0, 45.0, 60.0, 80.0, 110.0, 150.0)),
        *({"coulomb": c, "viscous": 0.1} for c in (30.0, 150.0)),
    ],
    "limit": [{"force": f} for f in (4.0, 5.0, 5.5, 6.0, 6.5, 7.0)],
    "resonance": [
        {"resonance": f, "damping": d}
        for f, d in ((30, 0.02), (25, 0.03), (22, 0.01), (18, 0.02), (15, 0.04), (12, 0.03))
    ],
    "lag": [{"position_gain": 40.0}, {"viscous": 0.1}],
}
B, A = butter(2, 20 * 2 * DT)


def learned(rig: Rig, r) -> np.ndarray:
    """(N,) the input after five trials of a filtered PD law."""
    u = np.zeros(len(r) - 1)
    for j in range(5):
        e = r - rig.play(u, j)
        ahead = np.concatenate([e, np.repeat(e[-1], 3)])
        step = 0.7 * ahead[2 : len(u) + 2] + 14.0 * (ahead[3 : len(u) + 3] - ahead[2 : len(u) + 2])
        u = filtfilt(B, A, u + step)
    return u


def changed(rig: Rig, values: dict) -> Rig:
    """The drive after a change; its own friction is added to that of the change, and its limit."""
    fields = vars(rig) | values
    if "coulomb" in values or "force" in values:
        name = "coulomb" if "coulomb" in values else "force"
        fields[name] = values[name] + (rig.coulomb if rig.coulomb > 10 else 0.0)
    return Rig(**fields)


def main() -> None:
    found = {kind: collections.Counter() for kind in CHANGES}
    for r in MOTIONS.values():
        for rig in DRIVES:
            u = learned(rig, r)
            last = rig.play(u, 5)[:, None]
            for kind, changes in CHANGES.items():
                for values in changes:
                    y = changed(rig, values).play(u, 6)[:, None]
                    found[kind][what_changed(y, last, DT).cause or "not named"] += 1
    rows = [{"changed": kind, "named": dict(count)} for kind, count in found.items()]
    right = sum(count[kind] for kind, count in found.items())
    silent = sum(count["not named"] for count in found.values())
    total = sum(sum(count.values()) for count in found.values())
    print(f"{right} of {total} named, {silent} not, {total - right - silent} otherwise")
    output.write_rows(output.folder(__file__) / "changes.csv", rows)


if __name__ == "__main__":
    main()
