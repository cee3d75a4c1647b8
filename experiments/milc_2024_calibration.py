"""MILC 2024: a fit of the numbers that are not printed, to three of the DILC row of Table 1.

The other seven numbers of the table test the fit.

The free numbers are the velocity of the path (fitted to the table RMS of the first trial), the
antiresonance of the drive (motor RMS of the last trial) and the noise of the table (table RMS of
the last trial). The force gain follows from the printed bandwidth of 50 Hz. Numbers of MILC are not
used in the fit.
"""

import numpy as np
import output
import scipy.optimize

import jaxilc
from jaxilc.scenarios.milc_2024 import (
    DT,
    FITTED_ROWS,
    TABLE_1,
    direct_ilc,
    multivariable_ilc,
    nominal_drive,
    path,
    position_gain,
    real_machine,
)
from jaxilc.schemes import PID, OnOutputs
from jaxilc.signals import Task
from jaxilc.theory import frequency

jaxilc.setup()
folder = output.folder(__file__)
ROWS = {
    "velocity": (1, "table_rms"),
    "antiresonance": (11, "motor_rms"),
    "noise": (11, "table_rms"),
}
PRINTED = np.array([TABLE_1["dilc"][row] for row in ROWS.values()])
start = {"velocity": 65.0, "antiresonance": 80.0, "noise": 0.5e-3}
GRID = np.linspace(30.0, 80.0, 501)


def bandwidth(antiresonance, force_gain):
    """-3 dB of the motor's position loop [Hz]."""
    drive = nominal_drive(antiresonance, force_gain)
    gain, rest = position_gain(drive), Task(np.zeros((3, 2)), dt=DT, inputs=1)
    loop = frequency.linear_loop(jaxilc.Machine(drive), OnOutputs(PID(kp=gain), (0,)), rest)
    closed = gain * np.abs(np.asarray(frequency.response(loop, GRID, DT))[:, 0, 0])
    below = np.argmax(closed < np.sqrt(0.5))
    return float(
        np.interp(-np.sqrt(0.5), -closed[below - 1 : below + 1], GRID[below - 1 : below + 1])
    )


def force_gain(antiresonance):
    """That of the printed bandwidth [N/V]."""
    return scipy.optimize.brentq(
        lambda g: bandwidth(antiresonance, g) - 50.0, 60.0, 125.0, xtol=0.01
    )


def table_1(values):
    """Our numbers of Table 1 by scheme, trial and quantity."""
    s = jaxilc.scenarios.load("milc-2024")
    drive = nominal_drive(values["antiresonance"], force_gain(values["antiresonance"]))
    r = path(values["velocity"])
    task = Task(np.stack([r, r], axis=1), dt=DT, inputs=1)
    schemes = {"dilc": direct_ilc(drive), "milc": multivariable_ilc(drive)}
    dataset, _ = jaxilc.run_schemes(
        real_machine(drive, values["noise"]), schemes, task, s.trials, quantities=s.functions
    )
    return {
        key: {row: 1e3 * float(dataset[row[1]].sel(scheme=key, trial=row[0])) for row in rows}
        for key, rows in TABLE_1.items()
    }


def residuals(logarithms):
    values = dict(zip(ROWS, np.exp(logarithms), strict=True))
    ours = table_1(values)["dilc"]
    print(
        {name: round(value, 6) for name, value in values.items()},
        {row: round(ours[row], 3) for row in ROWS.values()},
        flush=True,
    )
    return np.log(np.array([ours[row] for row in ROWS.values()]) / PRINTED)


best = scipy.optimize.least_squares(
    residuals, np.log(list(start.values())), diff_step=0.02, xtol=1e-4, ftol=1e-6, max_nfev=8
)
values = dict(zip(ROWS, np.exp(best.x), strict=True))
ours = table_1(values)
print(
    "fitted:",
    {name: float(f"{value:.4g}") for name, value in values.items()},
    "force gain",
    round(force_gain(values["antiresonance"]), 1),
)
rows = []
for scheme, printed in TABLE_1.items():
    for row, value in printed.items():
        role = "fitted" if (scheme, *row) in FITTED_ROWS else "predicted"
        rows.append(
            {
                "scheme": scheme,
                "trial": row[0] - 1,
                "quantity": row[1],
                "published": value,
                "ours": ours[scheme][row],
                "role": role,
            }
        )
output.write_rows(folder / "rows.csv", rows)
