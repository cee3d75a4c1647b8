"""Ten campaigns of ten trials on ten drives of several kinds, each with a fault in the middle.

`rigs_of_many_kinds` plays what `jaxilc next` writes. Trial 6 has the fault. Where the machine stays
as it is then, the trial is accepted, and the next ones have the fault, too, until one is refused;
where only the file was wrong, it is measured again. The table has, for each drive: the exit code of
trial 6 and what was suspected, how many trials after it were told to be another machine, how many
were played, the share of the trials from the third on, without the sixth, within their 90 % band,
the largest input that was played in a stroke of 20 mm, and errors before and after the fault.
"""

import json
import re
import sys
import tempfile
from pathlib import Path

import numpy as np
import output
from campaigns_with_faults import FAULTY, PLANT, TRIALS, begun, call
from rigs_of_many_kinds import RIGS
from two_mass_rig import read_schedule, stroke, write_trial


def campaign(folder: Path, rig, changed: dict, *, lasting: bool, seed: int) -> dict:
    """The row of one drive."""
    r, state = stroke(), folder / "state"
    schedule, report, trial = folder / "next.csv", folder / "next.json", folder / "trial.csv"
    code, said = begun(folder, PLANT, state, schedule)
    assert code == 0, said
    largest, within, errors, again, answer = 0.0, [], [], 0, ()
    for j in range(1, TRIALS + 1):
        u = read_schedule(schedule)
        largest = max(largest, float(np.max(np.abs(u))))
        faulty = j == FAULTY or (lasting and j > FAULTY)
        y = rig(u, 1000 * seed + j, **(changed if faulty else {}))
        write_trial(trial, r, y, u)
        learn = ("next", "--state", state, "--measured", trial, "--out", schedule)
        learn += ("--report", report)
        code, said = call(*learn)
        if j == FAULTY:
            causes = dict.fromkeys(re.findall(r"suspected is (.*?)(?:\. |; | \()", said))
            answer = code, " / ".join(causes)
        again += j > FAULTY and "suspected is" in said and "times the upper end" in said
        if code == 3 and not lasting:
            write_trial(trial, r, rig(u, 1000 * seed + j + 500), u)
            code, said = call(*learn)
        elif code == 3 and j > FAULTY:
            break  # the machine is to be looked at
        elif code == 3:
            code, said = call(*learn, "--set", "campaign.accept=growth,input")
        assert code == 0, said
        numbers = json.loads(report.read_text())
        errors.append(numbers["metrics"]["error"])
        if j >= 3 and j != FAULTY:
            low, high = numbers["predicted"]["rms"]
            within.append(low <= errors[-1] <= high)
    return {
        "drive": rig.__name__.replace("_", " "), "fault": next(iter(changed)),
        "exit code": answer[0], "told again": again, "trials": len(errors),
        "within": float(np.mean(within)), "largest input": largest, "error 1": errors[0],
        "error 5": errors[4], "last error": errors[-1], "suspected": answer[1],
    }  # fmt: skip


def main(seeds: int = 1) -> None:
    rows = []
    for rig, (changed, lasting) in RIGS.items():
        for seed in range(1, seeds + 1):
            with tempfile.TemporaryDirectory() as folder:
                rows.append(campaign(Path(folder), rig, changed, lasting=lasting, seed=seed))
            print(rows[-1], flush=True)
    print(f"within: {np.mean([row['within'] for row in rows]):.1%} of all")
    output.write_rows(output.folder(__file__) / "rigs.csv", rows)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
