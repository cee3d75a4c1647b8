"""How many trials of a campaign lie within both bands that the trials before them gave.

Ten drives in plain NumPy (`two_mass_rig`), each with another trouble that the plant file does not
know, learn for ten trials through `jaxilc next`, from several seeds. After two trials `next` gives
bands of the rms and of the largest error from the campaign itself, which are to hold both in 90 %
of the trials. The table has the share of the trials 3 to 10 of which both errors lie within, of
which the rms lies within, below and above, and how wide its band of the last trial is. The trials
of a campaign are not independent: the share is given or taken by what differs between whole
campaigns.
"""

import json
import shutil
import sys
import tempfile
from pathlib import Path

import numpy as np
import output
from campaigns_with_faults import PLANT, TRIALS, begun, call
from two_mass_rig import Rig, read_schedule, stroke, write_trial

RIGS = {
    "as it is": Rig(),
    "friction": Rig(coulomb=45.0),
    "delay": Rig(delay=7),
    "coarse encoder": Rig(step=3e-2),
    "play": Rig(play_of_coupling=0.2),
    "saturation": Rig(force=8.0),
    "gain varies": Rig(spread=5e-3),
    "gain drifts": Rig(warming=2e-3),
    "pushed": Rig(push=4.0, ripple=10.0),
    "wandering, spikes": Rig(wander=4e-4, spikes=0.1),
}


def campaign(folder: Path, rig: Rig, seed: int) -> list[dict]:
    """What was predicted for each trial from the third on, with its error."""
    r = stroke()
    state, schedule, report = folder / "state", folder / "next.csv", folder / "next.json"
    code, said = begun(folder, PLANT, state, schedule)
    found = []
    for j in range(1, TRIALS + 1):
        assert code == 0, said
        u = read_schedule(schedule)
        y = rig.play(u, 1000 * seed + j, j)
        write_trial(folder / f"trial-{j}.csv", r, y, u)
        code, said = call(
            *("next", "--state", state, "--measured", folder / f"trial-{j}.csv"),
            *("--out", schedule, "--report", report),
            *("--set", "campaign.accept=growth"),
        )
        numbers = json.loads(report.read_text())
        if j >= 3:
            found.append(numbers["predicted"] | {"error": numbers["metrics"]["error"]})
    shutil.rmtree(state)
    return found


def row(name: str, rig: Rig, seeds: int) -> dict:
    """The row of one rig over several campaigns."""
    trials = []
    for seed in range(1, seeds + 1):
        with tempfile.TemporaryDirectory() as folder:
            trials += campaign(Path(folder), rig, seed)
    low, high, error = np.array([(*t["rms"], t["error"]) for t in trials]).T
    both = np.array([t["level"] == "within" for t in trials])
    of_campaign = np.mean(both.reshape(seeds, -1), axis=1)
    return {
        "rig": name,
        "trials": len(trials),
        "within": float(np.mean(of_campaign)),
        "give or take": float(1.96 * np.std(of_campaign) / max(1, seeds - 1) ** 0.5),
        "rms within": float(np.mean((low <= error) & (error <= high))),
        "below": float(np.mean(error < low)),
        "above": float(np.mean(error > high)),
        "far outside": sum(t["level"] == "clear" for t in trials),
        "upper over lower end, last trial": float(
            np.median((high / low)[TRIALS - 3 :: TRIALS - 2])
        ),
    }


def main(seeds: int = 3) -> None:
    rows = []
    for name, rig in RIGS.items():
        rows.append(row(name, rig, seeds))
        print(rows[-1], flush=True)
    print(f"within: {np.mean([one['within'] for one in rows]):.1%} of all")
    output.write_rows(output.folder(__file__) / "bands.csv", rows)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
