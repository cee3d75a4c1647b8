"""How far a learned law carries: to other families of machines, and to a wider spread of its own.

The laws are those that `learned_laws.py` has kept. On another family a law keeps its taps, and L is
divided by the ratio of the steady gains. A law belongs to one sample time. Shown are the largest
|Q - L P| on the machines of the family, and the median error of trial 10 and share of machines that
diverge within 100 trials, of 33 machines, in units of the noise.

    python experiments/learned_transfer.py
"""

import dataclasses
import json

import numpy as np
import output
from learned_families import FAMILIES, Case
from learned_laws import JUDGES, METRIC, SEED, noise_of

import jaxilc
from jaxilc import Sweep
from jaxilc.design.responses import Family, family_of
from jaxilc.design.tuned import contraction
from jaxilc.runtime.start import keep_programs
from jaxilc.schemes import LearningFilter

WIDER, MACHINES, TRIALS = (0.5, 1.0, 1.5, 2.0), 33, 100


def wider(case: Case, times: float) -> Case:
    """The case with all half-widths of its uniform distributions so many times as large."""
    spread = {}
    for name, of in case.uncertainty.items():
        middle, half = (of.high + of.low) / 2, times * (of.high - of.low) / 2
        spread[name] = dataclasses.replace(of, low=middle - half, high=middle + half)
    return case._replace(uncertainty=spread)


def row_of(case: Case, family: Family, taps: dict) -> dict:
    """What a law does on a family, its gain made to fit."""
    scale = taps["gain"] / float(family.P[0, 0].real)
    law = LearningFilter(scale * np.array(taps["L"]), keep=taps["Q"], lead=taps["lead"])
    scheme = case.under(law)
    dataset = Sweep(
        case.machine, {"law": scheme}, case.task, TRIALS, case.uncertainty,
        machines=MACHINES, seed=JUDGES,
    ).run()  # fmt: skip
    lost = ~dataset["finite"].values[0] | dataset["diverged"].values[0]
    errors = dataset[METRIC].values[0].reshape(MACHINES, TRIALS, -1).max(-1)
    errors = np.where(lost, np.inf, errors)
    return {
        "sup": contraction(family, scheme, case.task),
        "median 10": float(np.median(errors[:, 9])) / (noise_of(case) or 1.0),
        "diverged": float(np.mean(lost.any(axis=1))),
    }


def main() -> None:
    jaxilc.setup()
    keep_programs()
    results = output.folder(__file__).parent / "learned_laws"
    kept = {name: results / name / "family.json" for name in FAMILIES}
    laws = {n: json.loads(p.read_text())["taps"] for n, p in kept.items() if p.exists()}
    cases = {name: FAMILIES[name]() for name in laws}
    rows = []
    for on, case in cases.items():
        for times in WIDER:
            one = wider(case, times)
            family = family_of(one.machine, one.feedback, one.task, one.uncertainty, seed=SEED)
            of = laws if times == 1 else {on: laws[on]}
            for name, taps in of.items():
                if float(cases[name].task.dt) == float(case.task.dt):
                    row = {"law of": name, "on": on, "spread": times}
                    rows.append(row | row_of(one, family, taps))
                    print(rows[-1], flush=True)
    output.write_rows(output.folder(__file__) / "transfer.csv", rows)


if __name__ == "__main__":
    main()
