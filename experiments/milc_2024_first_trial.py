"""MILC 2024, Table 1: a search over the readings of its first trial, where two orders are reversed.

In the print the motor's RMS error is above that of the table, by 1.6 % under DILC and 1.7 % under
MILC, and MILC's are below DILC's, by 2.3 and 2.1 %. Eq. 10 with the printed loops gives a table
that errs more than the motor. The first trial has feedback only, so that the linear model tells:

    path       those of `milc_2024_readings`
    late       samples by which the position loop reads the motor's encoder late; it is printed
               nowhere, and departs from eq. 42: 0, 1/4, 1/2, 3/4 or 1
    table      its real mass by that of the model: 0.9, 1, 1.1 or 1.3 times
    antiresonance  free, not printed; the force gain follows from the printed 50 Hz

The rows are the four shares. Friction is left out: on the table it stretches the spring, and only
raises the table's error. The share of each scheme, and those between the schemes, are left out in
turn. A share of the other sign counts as far off as can be (`reading_search.misfits`).
"""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import output
from milc_2024_gain import force_gain
from milc_2024_readings import ANTIRESONANCES, PATHS, path
from printed_tables import MILC_1
from reading_search import Reading, left_out, search

from jaxilc.scenarios import milc_2024 as paper

LATE = (0.0, 0.25, 0.5, 0.75, 1.0)  # samples
MASSES = (0.9, 1.0, 1.1, 1.3)
TABLES = ("DILC", "MILC", "between", "between")


def shares(errors) -> np.ndarray:
    """(..., 4) motor above table under DILC and MILC; table and motor below DILC under MILC [%].

    errors: (..., 4) table and motor under DILC, table and motor under MILC
    """
    table, motor, table_milc, motor_milc = np.moveaxis(np.asarray(errors), -1, 0)
    above = (motor / table, motor_milc / table_milc)
    below = (table_milc / table, motor_milc / motor)
    return 100 * np.stack([*(x - 1 for x in above), *(1 - x for x in below)], axis=-1)


PRINTED = shares(
    [
        MILC_1[scheme, 1, quantity]
        for scheme, quantity in itertools.product(("dilc", "milc"), ("table_rms", "motor_rms"))
    ]
)


def responses(drive, z) -> np.ndarray:
    """(F, 2) from the position loop's output [V] to motor and table [mm] at z."""
    A, B, C = (np.asarray(M) for M in dataclasses.astuple(paper.linear_model(drive))[:3])
    return (C @ np.linalg.solve(z[:, None, None] * np.eye(len(A)) - A, B[None]))[..., 0]


def first_errors(reference, model, real, z, late: float) -> list[float]:
    """RMS errors of table and motor under DILC, then under MILC [mm].

    model, real: (F, 2) `responses` of the model, whose ratio shapes MILC's reference, and of the
        machine
    """
    N, gain = len(reference) - 1, paper.position_gain(DRIVE)
    delay = z**-late
    r = np.fft.rfft(reference[:N], 4 * N)
    motor, table = (gain * P / (1 + gain * real[:, 0] * delay) for P in real.T)
    shaped = r * model[:, 0] / model[:, 1]
    found = (
        r - table * r,
        r - delay * motor * r,
        r - table * shaped,
        shaped - delay * motor * shaped,
    )
    return [float(np.sqrt(np.mean(np.fft.irfft(e)[:N] ** 2))) for e in found]


DRIVE = paper.nominal_drive(100.0, 80.0)


def main() -> None:
    folder = output.folder(__file__)
    moves = {limits: path(limits, 68.71 * 10.0 / limits[0]) for limits in PATHS}
    N = len(next(iter(moves.values()))) - 1
    z = np.exp(2j * np.pi * np.fft.rfftfreq(4 * N))
    z[0] = np.exp(1e-9j)  # the drive integrates
    drives = {
        f: jax.tree.map(jnp.asarray, paper.nominal_drive(f, force_gain(f))) for f in ANTIRESONANCES
    }
    of_model = {f: responses(drive, z) for f, drive in drives.items()}
    found = []
    for mass in MASSES:
        of_real = {
            f: responses(dataclasses.replace(drive, table_mass=mass * drive.table_mass), z)
            for f, drive in drives.items()
        }
        for late, limits in itertools.product(LATE, PATHS):
            errors = [
                first_errors(moves[limits], of_model[f], of_real[f], z, late)
                for f in ANTIRESONANCES
            ]
            places = {"late": late, "path": limits, "mass": mass}
            departures = (late > 0) + (mass != 1.1) + (limits != PATHS[0])
            found.append(
                Reading(places, departures, np.array(ANTIRESONANCES)[:, None], shares(errors))
            )
    for late in LATE:
        right = np.concatenate([of.ours > 0 for of in found if of.places["late"] == late])
        print(f"late {late:g}: {right.all(axis=1).sum()} of {len(right)} have the printed orders")
    table = search("first trial", found, PRINTED, [True, True, False, False])
    output.write_rows(folder / "rows.csv", table, 12)
    table = left_out("first trial", found, PRINTED, TABLES)
    output.write_rows(folder / "left-out.csv", table, 12)


if __name__ == "__main__":
    main()
