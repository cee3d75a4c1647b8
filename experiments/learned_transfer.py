"""How far a learned law carries: to other families of machines, and to a wider spread of its own.

    python experiments/learned_transfer.py

The laws are those by frequency response, with 61 and 31 taps, of the families of `learned_laws.py`
with a sample time of 1 ms; taps belong to one sample time. On another family a law keeps its taps,
and L is multiplied by the ratio of the steady gains. Shown are the largest |Q - L P| on the
machines of the family (sup), and of 17 machines up to trial 100 the median share of the first error
that is left in trial 10, and how many diverge.
"""

import dataclasses

import numpy as np
import output
from learned_families import FAMILIES, Case, errors_of
from learned_laws import JUDGES, MARGIN, METRIC, SEED
from learned_opponents import learned_law

import jaxilc
from jaxilc.design.candidates import Candidate, candidates, contraction
from jaxilc.design.learned import STARTS
from jaxilc.design.responses import Family
from jaxilc.runtime.start import keep_programs
from jaxilc.schemes import LearningFilter

OF = ("servo", "non-minimum-phase", "cao-2019")
WIDER, MACHINES, TRIALS = (1.0, 1.4, 1.8), 17, 100


def wider(case: Case, times: float) -> Case:
    """The case with all half-widths of its uniform distributions so many times as large."""
    spread = {}
    for name, of in case.uncertainty.items():
        middle, half = (of.high + of.low) / 2, times * (of.high - of.low) / 2
        spread[name] = dataclasses.replace(of, low=middle - half, high=middle + half)
    return case._replace(uncertainty=spread)


def law_of(case: Case, family: Family, folder) -> LearningFilter | str:
    """The law of a family by frequency response, or why there is none."""
    asked, names = learned_law(case, steps=0), STARTS["safe"]
    found = candidates(family, case.feedback, case.task, case.trials, MARGIN, names)
    safe = sorted((x for x in found if isinstance(x, Candidate)), key=lambda x: x.predicted)
    taps = asked.learned_taps(
        asked.resolved(), safe, folder, resume=folder.exists(), told=lambda stage, what: None
    )
    return taps.passed if isinstance(taps.passed, str) else taps.window.of(taps.passed.filters)


def row_of(case: Case, family: Family, law: LearningFilter) -> dict:
    """What a law does on a family."""
    scheme = case.under(law)
    errors, lost = errors_of(case._replace(real=None), scheme, METRIC, TRIALS, MACHINES, JUDGES)
    return {
        "sup": contraction(family, scheme, case.task),
        "left in trial 10": float(np.median(errors[:, 9] / errors[:, 0])),
        "left in trial 100": float(np.median(errors[:, 99] / errors[:, 0])),
        "diverged": int(np.sum(lost.any(axis=1))),
    }


def main() -> None:
    jaxilc.setup()
    keep_programs()
    folder, rows = output.folder(__file__), []
    cases = {name: FAMILIES[name]() for name in OF}
    families = {name: case.family(SEED) for name, case in cases.items()}
    laws = {name: law_of(cases[name], families[name], folder / name) for name in OF}
    for name, law in laws.items():
        if isinstance(law, str):
            print(f"{name}: refused, {law}")
            continue
        gain = float(families[name].P[0, 0].real)
        for on, case in cases.items():
            scaled = dataclasses.replace(law, L=law.L * gain / float(families[on].P[0, 0].real))
            for times in WIDER if on == name else (1.0,):
                one = wider(case, times)
                row = {"law of": name, "on": on, "spread": times}
                rows.append(row | row_of(one, one.family(SEED), scaled))
                print(rows[-1], flush=True)
    output.write_rows(folder / "transfer.csv", rows)


if __name__ == "__main__":
    main()
