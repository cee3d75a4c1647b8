"""What the tuning through learning adds to the taps that frequency responses find.

    python experiments/learned_gain.py [case ...]

The frequency response is exact far from the ends of a long trial, for a linear machine. So the
tuning is asked where this holds, and where it does not:

    long     the servo of `learned_laws.py`: it holds
    short    the same servo in a trial of a fifth of a second that ends while it moves: the ends
             are a large part of it, and L looks for errors after the end, where there are none

and for two objectives: the error of the last trial (the default of `LearnedLaw`), and the mean over
all trials. `two segments` is a scheduled law whose second segment is the end of the trial. Beside
them stand the laws of a few weights that know most: P-type learning with a notch, and norm-optimal
learning, whose model knows the ends of the trial.

Shown are medians over machines that nobody has seen, in units of the noise, in trials 2, 3, 5, 10
and 100, and what repeats of the error in trial 100 (without noise). All laws have the same machines
and steps.
"""

import dataclasses
import json
import sys
import time
from pathlib import Path

import numpy as np
import output
from learned_families import Case, errors_of, motion, servo
from learned_laws import JUDGES, MARGIN, METRIC, SEED, noise_of
from learned_opponents import learned_law

import jaxilc
from jaxilc import Machine, Task
from jaxilc.design.candidates import Candidate, candidates, contraction, tuned
from jaxilc.runtime.start import keep_programs
from jaxilc.schemes import Scheme
from jaxilc.tuning.objectives import EveryTrial

SHOWN, LAST, SAMPLES, END = (2, 3, 5, 10, 100), 100, 200, 40
TUNED_ON, STEPS, JUDGED_ON = 16, 60, 65
FEW = ("p-type-notch", "norm-optimal")


def long() -> Case:
    return servo()._replace(tuned_on=TUNED_ON, steps=STEPS, judged_on=JUDGED_ON)


def short() -> Case:
    """A trial that begins at rest and ends in motion."""
    case, dt = long(), 1e-3
    t = np.arange(SAMPLES + 1) * dt
    whole = motion([5, 20, 45], [0.6, 0.3, 0.15])
    begins = np.sin(np.pi / 2 * np.clip((t - 0.02) / 0.06, 0, 1)) ** 2
    r = begins * (0.6 * np.sin(2 * np.pi * 5 * t) + 0.15 * np.sin(2 * np.pi * 45 * t))
    return case._replace(task=Task(r, dt=dt, unit=whole.unit))


CASES = {"long": long, "short": short}


def laws_of(case: Case, folder: Path):
    """Name, scheme and seconds of each law."""
    family = case.family(SEED)
    names = (*FEW, "p-type", "model-inverse")
    safe = [
        one
        for one in candidates(family, case.feedback, case.task, case.trials, MARGIN, names)
        if isinstance(one, Candidate)
    ]
    for one in safe:
        if one.name in FEW:
            yield one.name, one.scheme, 0.0
            began = time.perf_counter()
            state = folder / one.name
            better = tuned(
                one, family, case.task, case.trials, metric=METRIC,
                margin=MARGIN, out=state, resume=state.exists(), quantities={}, **case.budget(),
            )  # fmt: skip
            yield f"{one.name}, tuned", better.scheme, time.perf_counter() - began
    asked = learned_law(case, steps=0, trained_on=case.tuned_on, held_out=case.tuned_on)
    starts = sorted((one for one in safe if one.name != "norm-optimal"), key=lambda x: x.predicted)
    objectives = {"last": None, "every": EveryTrial(METRIC)}
    for segments, where in (("", ()), (", two segments", (case.task.N - END,))):
        plain = dataclasses.replace(asked, starts=where)
        variants = {"by response": plain} | {
            f"tuned, {name} trial": dataclasses.replace(plain, steps=case.steps, objective=of)
            for name, of in objectives.items()
        }
        for name, one in variants.items():
            began, state = time.perf_counter(), folder / f"{name}{segments}".replace(" ", "-")
            found = one.learned_taps(
                one.resolved(), starts, state, resume=state.exists(), told=lambda stage, what: None
            )
            if isinstance(found.passed, str):
                print(f"  {name}{segments}: refused, {found.passed}", flush=True)
                continue
            law = one.candidate(found.window, found.passed)
            yield f"{name}{segments}", law.scheme, time.perf_counter() - began


def row_of(case: Case, scheme: Scheme) -> dict:
    """Medians of the error in units of the noise, and of what repeats of it."""

    def errors(machine: Machine):
        judged = case._replace(machine=machine, real=None)
        found, _ = errors_of(judged, scheme, METRIC, LAST, case.judged_on, JUDGES)
        return np.median(found, axis=0) / noise_of(case)

    noisy, quiet = errors(case.machine), errors(case.machine.noiseless())
    row = {f"trial {j}": float(noisy[j - 1]) for j in SHOWN}
    return row | {"repeats": float(quiet[-1])}


def main(*names: str) -> None:
    jaxilc.setup()
    keep_programs()
    for name in names or CASES:
        case, folder = CASES[name](), output.folder(__file__) / name
        folder.mkdir(exist_ok=True)
        dense = case.family(SEED + 3, {"machines": 257})
        rows = []
        for law, scheme, seconds in laws_of(case, folder):
            kept = folder / f"{law}.json"
            if not kept.exists():
                row = row_of(case, scheme) | {"seconds": round(seconds)}
                if not getattr(scheme, "starts", ()):  # of a scheduled law
                    row["sup"] = contraction(dense, scheme, case.task)
                kept.write_text(json.dumps(row))
            rows.append({"case": name, "law": law} | json.loads(kept.read_text()))
            print(rows[-1], flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
