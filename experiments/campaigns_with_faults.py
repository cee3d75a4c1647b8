"""Campaigns of ten trials on a simulated drive, each with a fault in the middle.

`two_mass_rig` plays the files that `jaxilc next` writes and measures the files that it reads; it
shares no code with the package. Each campaign has a fault in trial 6. A trial that is refused (exit
code 3) is measured again, without the fault.
A last campaign without a fault corrects the set-point: `jaxilc init --set-point` writes its plant
file from one recorded move, and its first trial plays the reference.
For each fault the table has what `next` did in trial 6, in its words, the largest input that was
played in all ten trials, and the errors of three of them.
"""

import contextlib
import csv
import io
import shutil
import sys
import tempfile
from pathlib import Path

import numpy as np
import output
from two_mass_rig import DT, Rig, read_schedule, stroke, write_trial

from jaxilc import cli

TRIALS, FAULTY = 10, 6
PLANT = f"""trials = 10
[plant]
kind = "transfer_function"
num = [50.0]
den = [1.0, 50.0]
[machine.sensor]
resolution = 1e-4
noise = 2e-4
[task]
dt = {DT}
unit = "mm"
input_unit = "mm"
reference = {{ csv = "reference.csv", column = "r" }}
[schemes.ilc]
class = "Filtered"
scheme = {{ class = "PIDType", gamma_p = 0.7, gamma_d = 14.0, lead = 2 }}
filter = {{ class = "ZeroPhaseButterworth", cutoff = 20.0 }}
[uncertainty."plant.B"]
distribution = "uniform"
low = 0.9
high = 1.1
relative = true
"""
IN_ORDER = Rig()


def played(rig, u, seed):
    return rig.play(u, seed), u


def frozen(y):
    return np.where(np.arange(len(y)) < len(y) // 5, y, y[len(y) // 5])


# What the machine does with the input, and what it records: (y, u) of the set-point, the folder
# with the trials before, and the number of the trial.
FAULTS = {
    "none": lambda u, before, j: played(IN_ORDER, u, j),
    "dead encoder": lambda u, before, j: (0 * IN_ORDER.play(u, j), u),
    "frozen encoder": lambda u, before, j: (frozen(IN_ORDER.play(u, j)), u),
    "gain -30 %": lambda u, before, j: played(Rig(gain=0.7), u, j),
    "wrong units": lambda u, before, j: (IN_ORDER.play(u, j) / 25.4, u),
    "wrong schedule": lambda u, before, j: played(IN_ORDER, before[1], j),
    "delayed": lambda u, before, j: played(Rig(delay=9), u, j),
    "friction up": lambda u, before, j: played(Rig(coulomb=60.0), u, j),
    "resonance moved": lambda u, before, j: played(Rig(resonance=18.0, damping=0.02), u, j),
    "saturated": lambda u, before, j: played(Rig(force=6.0), u, j),
    "swapped file": lambda u, before, j: (before["other"], u),
}


def call(*arguments):
    """Exit code and text of a command."""
    text = io.StringIO()
    sys.argv = ["jaxilc", *map(str, arguments)]
    with contextlib.redirect_stdout(text), contextlib.redirect_stderr(text):
        try:
            cli.main()
        except SystemExit as stop:
            return stop.code or 0, text.getvalue()
    return 0, text.getvalue()


def begun(folder: Path, plant: str | None, state: Path, schedule: Path):
    """Exit code and text of the command that begins a campaign; it leaves the first schedule.

    plant: plant file; None has it written from a recorded move
    """
    file = folder / "axis.toml"
    start = ("next", "--state", state, "--scenario", file, "--out", schedule)
    if plant is None:
        move = folder / "move.csv"
        write_trial(move, stroke(), IN_ORDER.play(stroke()[:-1], 1), stroke())
        code, said = call("init", "--set-point", "--record", move, file)
        return call(*start) if code == 0 else (code, said)
    with (folder / "reference.csv").open("w", newline="") as opened:
        csv.writer(opened).writerows([("t", "r"), *((k * DT, v) for k, v in enumerate(stroke()))])
    file.write_text(plant)
    return call(*start)


def campaign(folder: Path, fault: str, *, plant: str | None = PLANT) -> dict:
    """The row of one fault: what was done in trial 6, and what the campaign came to."""
    r = stroke()
    state, schedule = folder / fault.replace(" ", "-"), folder / "next.csv"
    code, said = begun(folder, plant, state, schedule)
    assert code == 0, said
    before = {"other": Rig(position_gain=30.0).play(0.6 * r[:-1], 99)}
    largest, answer, errors = 0.0, "", []
    for j in range(1, TRIALS + 1):
        u = before[j] = read_schedule(schedule)
        largest = max(largest, float(np.max(np.abs(u))))
        make = FAULTS[fault if j == FAULTY else "none"]
        y, recorded = make(u, before, j)
        trial = folder / f"trial-{j}.csv"
        write_trial(trial, r, y, recorded)
        schedule.unlink()
        code, said = call("next", "--state", state, "--measured", trial, "--out", schedule)
        if j == FAULTY:
            answer = ("played on", "", "a mistake", "refused")[code]
            told = [line for line in said.splitlines() if line.startswith(("error", "warning"))]
            answer = f"{answer}: {' '.join(told)}"
            assert schedule.exists() == (code == 0)
        if code == 3:  # somebody mends the machine and measures again
            y, recorded = FAULTS["none"](u, before, j + 100)
            write_trial(trial, r, y, recorded)
            code, said = call("next", "--state", state, "--measured", trial, "--out", schedule)
        assert code == 0, said
        errors.append(float(np.sqrt(np.mean((r - y)[1:] ** 2))))
    shutil.rmtree(state)
    at = {f"error {j}": errors[j - 1] for j in (1, 5, 10) if j <= TRIALS}
    return {"fault": fault, "largest": largest, **at, "trial 6": answer}


def main() -> None:
    rows = []
    for fault in FAULTS:
        with tempfile.TemporaryDirectory() as folder:
            rows.append(campaign(Path(folder), fault))
    with tempfile.TemporaryDirectory() as folder:
        rows.append(campaign(Path(folder), "none", plant=None) | {"fault": "none, from r on"})
    output.write_rows(output.folder(__file__) / "faults.csv", rows)


if __name__ == "__main__":
    main()
