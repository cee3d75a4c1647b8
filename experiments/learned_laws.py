"""Learned laws against laws of a few weights, on machines that none of them has seen.

Families (`learned_families`): a servo of 60 Hz with an uncertain resonance, a plant with a zero in
the right half-plane, the axis of li-2020 under its feedback, the ball screw of milc-2024 with its
position loop closed on the motor, and the voice coil of cao-2019. Opponents: `learned_opponents`,
each tuned on the same machines with as many steps. `by response` is the learned law before its
tuning through learning.

    python experiments/learned_laws.py [--by-grid] [family ...]

With `--by-grid` nothing is tuned through learning: the learned law is that by frequency response,
beside the laws of a few weights with their best safe weights of a grid, and the best P-type law of
a grid by simulation. That takes a minute or two for each family.

The median has an interval of 95 % by order statistics, which needs no assumption on the
distribution. `noise` is what the sensor leaves of error in a trial at rest, under the feedback of
the family if it has one; no measured error can be below.
`lowest` is the error that repeats with the best input for the nominal machine, which the law knows
exactly, without noise and under its limits: what is left is due to the machine and the trial.

Each family takes some minutes on one core, and each law that is done is kept in out/experiments, so
that a run that was stopped goes on. On the long trials of li-2020 and milc-2024, 33 machines judge
instead of 257, and 8 machines and 20 steps tune instead of 32 and 60. A learned law that the proof
over all frequencies refuses is judged too, and called refused.
"""

import dataclasses
import json
import sys
import time
from pathlib import Path

import numpy as np
import output
import scipy.stats
from learned_families import FAMILIES, Case, errors_of
from learned_opponents import KEPT, MARGIN, METRIC, SEED, best_of_grid, learned_law, opponents

import jaxilc
from jaxilc.design.candidates import Absent, candidates, contraction
from jaxilc.design.judging import proof_of
from jaxilc.design.learned import STARTS, LearnedLaw
from jaxilc.design.responses import Family
from jaxilc.design.window import Filters, Window
from jaxilc.plants import StateSpace
from jaxilc.runtime.start import keep_programs
from jaxilc.schemes import NormOptimal, PIDType, Scheme
from jaxilc.theory.loop import minimal

JUDGES, SHOWN = 4711, (1, 2, 5, 10, 20, 50, 100, 200, 500)
TABLE = (10, 100, 500)
CONFIDENCE = 0.95
AT_REST = 20  # trials that measure the noise under feedback
DENSE, CLOSE, LINES_FOR = 257, 600, 61  # machines, frequencies and taps of the test by frequency
SCHEDULED, REFUSED = "learned, two segments", ", refused"
# the test by frequency is of a linear law that is not scheduled
UNTESTED = ("ffdl-mfailc", SCHEDULED, SCHEDULED + REFUSED)


def judged(name: str, folder: Path, laws_of) -> dict:
    """The rows of one family, and the taps of its learned law.

    laws_of: `tuned_laws` or `laws_by_grid`
    """
    case = FAMILIES[name]()
    dense = case.family(SEED + 3, {"machines": DENSE}, points=CLOSE, taps=LINES_FOR)
    family = case.family(SEED)
    safe = list(candidates(family, case.feedback, case.task, case.trials, MARGIN, KEPT))
    rows, taps = [], {}
    for law, scheme, seconds in laws_of(case, family, safe, folder, taps):
        row = {"law": law} | row_of(case, law, scheme, seconds, folder)
        sup = None if law in UNTESTED else contraction(dense, scheme, case.task)
        rows.append(row | {"sup": sup})
        print(f"  {law}: " + "  ".join(cells(rows[-1], case.last)), flush=True)
    floors = {"noise": noise_of(case), "lowest": lowest_of(case, family)}
    of_case = {"family": name, "trials": case.trials, "last": case.last, "judges": case.judged_on}
    of_case |= {"tuned_on": case.tuned_on, "steps": case.steps, "samples": case.task.N}
    return of_case | floors | {"laws": rows, "taps": taps}


def laws_by_grid(case: Case, family: Family, safe: list, folder: Path, taps: dict):
    """As `tuned_laws`, without any tuning through learning."""
    asked = learned_law(case, steps=0)
    found, seconds = taps_of(asked, safe, folder / "learned", {})
    if isinstance(found.passed, str):
        print(f"  learned: refused, {found.passed}", flush=True)
    else:
        keep_taps(taps, found.passed.filters, found.window, family)
        law = asked.candidate(found.window, found.passed)
        yield "learned by response", law.scheme, seconds
    for one in safe:
        if isinstance(one, Absent):
            print(f"    {one.name}: {one.why}", flush=True)
        else:
            yield one.name if one.bounds else f"{one.name}, as one", one.scheme, 0.0
    yield "p-type, grid", best_of_grid(case, family), 0.0


def keep_taps(taps: dict, filters: Filters, window: Window, family: Family) -> None:
    """Put the taps of a law and the steady gain of its nominal machine into `taps`."""
    taps |= {"L": filters.L.tolist(), "Q": filters.keep.tolist(), "lead": window.lead}
    taps["gain"] = float(family.P[0, 0].real)


def tuned_laws(case: Case, family: Family, safe: list, folder: Path, taps: dict):
    """Name, scheme and seconds of each law; the taps of the learned one are put into `taps`."""
    for name, starts in {"learned": (), SCHEDULED: case.starts}.items():
        if name == SCHEDULED and not starts:
            continue
        seen = {}
        trained = {"steps": case.steps, "trained_on": case.tuned_on, "held_out": case.tuned_on}
        asked = learned_law(case, starts=starts, **trained)
        state = folder / name.replace(", ", "-").replace(" ", "-")
        found, seconds = taps_of(asked, safe, state, seen)
        if isinstance(found.passed, str):
            print(f"  {name}: refused, {found.passed}", flush=True)
            continue
        law = asked.candidate(found.window, found.passed).scheme
        proof = proof_of(found.family, law, case.task)
        print(f"  {found.passed.way=}, proof: {proof._asdict()}", flush=True)
        yield name + (REFUSED if proof.refuted else ""), law, seconds
        if not starts:
            keep_taps(taps, found.passed.filters, found.window, family)
            yield "by response", case.under(found.window.of(seen["found"])), 0.0
    yield from opponents(case, family, safe, folder)


def taps_of(asked: LearnedLaw, safe: list, state: Path, seen: dict):
    """The taps that passed the gate, or why none did, and the seconds that this took.

    safe: the laws of a few weights, with safe ones or absent
    seen: filled with the first of what is told at each stage
    """
    began, names = time.perf_counter(), STARTS["safe"]
    starts = [one for one in safe if not isinstance(one, Absent) and one.name in names]
    found = asked.learned_taps(
        asked.resolved(), sorted(starts, key=lambda one: one.predicted), state,
        resume=state.exists(), told=lambda stage, what: seen.setdefault(stage, what),
    )  # fmt: skip
    return found, time.perf_counter() - began


# Judgement
# --------------------------------------------------------------------------------------------------


def row_of(case: Case, law: str, scheme: Scheme, seconds: float, folder: Path) -> dict:
    """The errors of a law on the machines that judge, kept in a file.

    seconds: that its tuning took
    """
    kept = folder / f"{law.replace(', ', '-').replace(' ', '-')}.json"
    if kept.exists():
        return json.loads(kept.read_text())
    errors, lost = errors_of(case, scheme, METRIC, case.last, case.judged_on, JUDGES)
    row = {
        str(trial): [float(x) for x in quantiles(errors[:, trial - 1])]
        for trial in SHOWN
        if trial <= case.last
    }
    row = {
        "errors": row, "diverged": float(np.mean(lost.any(axis=1))), "seconds": round(seconds),
    }  # fmt: skip
    kept.write_text(json.dumps(row))
    return row


def quantiles(errors) -> tuple[float, float, float, float, float]:
    """Median with both ends of its interval, the error of 95 % of the machines, and the largest.

    Of n machines the k-th and the (n + 1 - k)-th enclose the median of all machines, but for the
    probability that fewer than k of n fall to one side of it.
    """
    errors = np.sort(errors)
    n = len(errors)
    k = max(int(scipy.stats.binom.ppf((1 - CONFIDENCE) / 2, n, 0.5)), 1)
    median, high = np.quantile(errors, (0.5, 0.95), method="inverted_cdf")
    return median, errors[k - 1], errors[n - k], high, errors[-1]


def noise_of(case: Case) -> float:
    """Root mean square of the error that the noise of the sensor leaves in a trial at rest.

    No learning can measure less. Under feedback it is more than what the sensor adds, as the
    feedback answers the noise.
    """
    noise = None if case.machine.sensor is None else case.machine.sensor.noise
    if case.feedback is None or noise is None:
        return 0.0 if noise is None else float(np.max(noise))
    rest = dataclasses.replace(case.task, reference=0.0 * np.asarray(case.task.reference))
    history = jaxilc.learn(case.machine, case.under(PIDType(gamma_p=0.0)), rest, AT_REST)
    return float(np.mean(np.asarray(getattr(history, METRIC))))


def lowest_of(case: Case, family: Family) -> float:
    """The error that repeats under norm-optimal learning with the exact model, without noise."""
    model = StateSpace(*minimal(family.loops[0], case.task.N), dt=case.task.dt)
    size = float(np.max(np.abs(family.P[0]))) ** 2
    scheme = case.under(NormOptimal(model, w_r=1e-6 * size, w_s=1e-10 * size))
    history = jaxilc.learn(case.machine.noiseless(), scheme, case.task, 50)
    return float(np.min(np.max(np.asarray(getattr(history, METRIC)), axis=1)))


# Tables
# --------------------------------------------------------------------------------------------------


def cells(row: dict, last: int) -> list[str]:
    """What a table shows of a law: test by frequency, medians with intervals, worst, diverged."""
    sup = "" if row["sup"] is None else f"{row['sup']:.3f}"
    shown = [row["errors"][str(trial)] for trial in TABLE if trial <= last]
    errors = [f"{m:.3g} [{low:.3g}, {high:.3g}]" for m, low, high, *_ in shown]
    worst = [f"{shown[0][4]:.3g}", f"{shown[-1][4]:.3g}"]
    return [sup, *errors, *worst, f"{row['diverged']:.0%}"]


def markdown(found: dict) -> str:
    """The table of a family, in the unit of the output."""
    trials = [trial for trial in TABLE if trial <= found["last"]]
    head = ["law", r"sup \|Q(1 − LP)\|", *(f"median {t}" for t in trials),
            f"worst {trials[0]}", f"worst {trials[-1]}", "diverged"]  # fmt: skip
    rows = [head, ["---"] * len(head)]
    rows += [[row["law"], *cells(row, found["last"])] for row in found["laws"]]
    title = (
        f"{found['family']}: N = {found['samples']}, {found['judges']} machines; tuned on "
        f"{found['tuned_on']} with {found['steps']} steps; noise {found['noise']:.3g}, lowest "
        f"{found['lowest']:.3g}"
    )
    return title + "\n\n" + "\n".join(f"| {' | '.join(row)} |" for row in rows) + "\n"


def main(*names: str) -> None:
    jaxilc.setup()
    keep_programs()
    folder = output.folder(__file__)
    tables, by_grid = [], "--by-grid" in names
    for name in [name for name in names if name != "--by-grid"] or FAMILIES:
        place = folder / (f"{name}-by-grid" if by_grid else name)
        began = time.perf_counter()
        place.mkdir(exist_ok=True)
        kept = place / "family.json"
        print(name, flush=True)
        if not kept.exists():
            kept.write_text(
                json.dumps(judged(name, place, laws_by_grid if by_grid else tuned_laws))
            )
            print(f"  {time.perf_counter() - began:.0f} s", flush=True)
        tables.append(markdown(json.loads(kept.read_text())))
    text = "\n".join(tables)
    (folder / ("tables-by-grid.md" if by_grid else "tables.md")).write_text(text)
    print(text)


if __name__ == "__main__":
    main(*sys.argv[1:])
