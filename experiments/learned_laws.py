"""Learned laws against laws of a few weights, on machines that none of them has seen.

Families: a servo of 60 Hz with an uncertain resonance, a plant with a zero in the right half-plane,
the axis of li-2020 under its feedback, the ball screw of milc-2024 with its position loop closed on
the motor, and the voice coil of cao-2019.

Opponents, tuned on the same machines for the same trial: P- and PD-type learning with a lead and a
Q-filter, the model inverse and ZPETC with a gain and a Q-filter, and norm-optimal learning with its
two weights and a Q-filter, each with weights that are safe by frequency, then tuned by gradient for
the mean of the worst quarter of the machines (CVaR) and kept safe; the best P-type law of a grid of
gains, cutoffs and leads, by simulation, safe or not; and FFDL-MFAILC with a lead and a Q-filter,
its weights tuned by gradient. `by response` is the learned law before its tuning through learning.

    python experiments/learned_laws.py [family ...]

A family that is done is kept in out/experiments, so a run that was stopped goes on.
"""

import dataclasses
import json
import sys
import time
from pathlib import Path

import numpy as np
import output
from learned_families import FAMILIES, Case

import jaxilc
from jaxilc import Sweep
from jaxilc.design.candidates import INVERSE_GAINS, LAWS, Candidate, candidates
from jaxilc.design.learned import LearnedLaw
from jaxilc.design.responses import family_of
from jaxilc.design.safe_weights import ORDER, widest
from jaxilc.design.simulated import rms_of
from jaxilc.design.tuned import tuned
from jaxilc.filters import ZeroPhaseButterworth, zpetc
from jaxilc.plants import StateSpace
from jaxilc.runtime.start import keep_programs
from jaxilc.schemes import (
    FFDLMFAILC,
    ErrorFiltered,
    Filtered,
    PIDType,
    Scheme,
)
from jaxilc.sweeps.summary import summarise
from jaxilc.theory.law import law_of
from jaxilc.theory.loop import minimal
from jaxilc.tuning import Tuning
from jaxilc.tuning.objectives import EveryTrial, Holding
from jaxilc.tuning.risks import CVaR

METRIC, MARGIN, SEED = "rms", 0.05, 0
TUNED_ON = {"machines": 24, "held_out": 24, "steps": 30, "seed": SEED}
JUDGED_ON, JUDGES, SHOWN = 256, 4711, (1, 10, 100, 500)
GAINS, SHARES, LEADS = np.geomspace(0.1, 1.2, 8), np.geomspace(0.004, 0.3, 16), 16


# Opponents
# --------------------------------------------------------------------------------------------------


def opponents(case: Case, family, folder: Path) -> dict[str, Scheme]:
    """The laws of a few weights, tuned."""
    found = [
        one
        for one in (
            *candidates(family, case.feedback, case.task, case.trials, MARGIN, tuple(LAWS)),
            of_zpetc(case, family),
        )
        if isinstance(one, Candidate)
    ]
    laws = {}
    for one in found:
        state = folder / f"tuning-{one.name}"
        better = tuned(
            one, family, case.machine, case.task, case.trials, case.uncertainty, metric=METRIC,
            margin=MARGIN, out=state, resume=state.exists(), **TUNED_ON,
        )  # fmt: skip
        laws[one.name] = better.scheme
        print(f"    {one.name}: |Q (1 - L P)| at most {better.largest:.3f}", flush=True)
    laws["p-type, grid"] = best_of_grid(case, family)
    laws["ffdl-mfailc"] = of_ffdl(case, family, laws["p-type, grid"], folder / "tuning-ffdl")
    return laws


def of_zpetc(case: Case, family) -> Candidate | None:
    """Q (u + gamma Z e) with Z by ZPETC of the nominal loop, and weights that are safe."""
    try:
        Z = zpetc(StateSpace(*minimal(family.loops[0], case.task.N), dt=case.task.dt))
    except ValueError as error:
        print(f"    zpetc: {error}")
        return None
    Z = dataclasses.replace(Z, advance=Z.advance - 1)  # PIDType looks one sample ahead
    law = law_of(ErrorFiltered(PIDType(gamma_p=1.0), Z), case.task)
    L = family.of_taps(law.L, case.task.dt)
    laws = ({"gamma_p": g, "L": g * L} for g in INVERSE_GAINS)
    best = next(iter(widest(family, laws, case.task, case.trials, MARGIN)), None)
    if best is None:
        return None
    gain, cutoff = best.weights["gamma_p"], best.weights["cutoff"]
    scheme = Filtered(ErrorFiltered(PIDType(gamma_p=gain), Z), ZeroPhaseButterworth(cutoff))
    bounds = {"scheme.scheme.gamma_p": (gain / 4, 1.5), "filter.cutoff": (cutoff / 4, 4 * cutoff)}
    bounds["filter.cutoff"] = (cutoff / 4, min(4 * cutoff, 0.45 / case.task.dt))
    return Candidate(
        "zpetc", "", case.under(scheme), case.named(bounds), best.largest, best.predicted
    )


def best_of_grid(case: Case, family) -> Scheme:
    """The P-type law with lead and Q-filter of least error at 95 % of the machines of a family."""
    dt, longest = case.task.dt, max(4, min(60, case.task.N // 20))
    steady = family.P[:, 0].real  # not the peak of a resonance
    gains = GAINS / float(np.max(np.abs(steady))) * np.sign(steady[0])
    leads = sorted({round(x) for x in np.geomspace(1, longest, LEADS)} | {0})
    loops = family.loops[:: max(1, len(family.loops) // 12)]
    laws = [
        {"gamma_p": float(g), "gamma_d": 0.0, "lead": m, "cutoff": float(share / dt)}
        for g in gains
        for m in leads
        for share in SHARES
    ]
    few = max(1, int(4e7 / (len(loops) * case.task.N * 8)))  # at a time, to spare memory
    parts = [
        rms_of(loops, family.first_error, laws[i : i + few], dt, case.trials, ORDER)
        for i in range(0, len(laws), few)
    ]
    errors = np.nan_to_num(np.concatenate(parts), nan=np.inf)
    best = laws[int(np.argmin(np.quantile(errors, 0.95, axis=1, method="higher")))]
    law = PIDType(gamma_p=best["gamma_p"], lead=best["lead"])
    return case.under(Filtered(law, ZeroPhaseButterworth(best["cutoff"])))


def of_ffdl(case: Case, family, p_type: Scheme, state: Path) -> Scheme:
    """FFDL-MFAILC from the gain, lead and filter of a P-type law, with weights by gradient."""
    filtered = p_type if case.feedback is None else p_type.learning
    law, phi = filtered.scheme, float(family.P[0, 0].real)
    lam = max(phi / float(law.gamma_p) - phi**2, 0.1 * phi**2)
    cutoff = float(filtered.filter.cutoff)
    adaptive = FFDLMFAILC(lam=lam, rho=1.0, eta=0.5, phi0=[0.0, 0.0, phi, 0.0], lead=law.lead)
    scheme = case.under(Filtered(adaptive, ZeroPhaseButterworth(cutoff)))
    bounds = {
        "scheme.lam": (lam / 100, lam * 100),
        "scheme.eta": (1e-3, 1.5),
        "filter.cutoff": (cutoff / 4, min(4 * cutoff, 0.45 / case.task.dt)),
    }
    first = max(1, round(0.75 * case.trials))
    problem = Tuning(
        case.machine, scheme, case.task, case.trials, case.named(bounds), case.uncertainty,
        Holding(first, METRIC) + 0.02 * EveryTrial(METRIC), CVaR(0.75), **TUNED_ON,
    )  # fmt: skip
    return problem.run(state, resume=state.exists()).scheme


# Judgement
# --------------------------------------------------------------------------------------------------


def judged(name: str, folder: Path) -> list[dict]:
    """The rows of one family."""
    case, began = FAMILIES[name](), time.perf_counter()
    family = family_of(case.machine, case.feedback, case.task, case.uncertainty, seed=SEED)
    learned = LearnedLaw(
        case.machine, case.task, case.trials, case.uncertainty, case.feedback, metric=METRIC,
        margin=MARGIN, machines=33, steps=80, seed=SEED, trained_on=64,
    )  # fmt: skip
    schemes, sup = {}, {}
    for law, steps in (("learned", learned.steps), ("by response", 0)):
        state = folder / f"{name}-{law.replace(' ', '-')}"
        found = dataclasses.replace(learned, steps=steps).run(state, resume=state.exists())
        print(f"  {law}: {found.refused or found.proof.worst} {time.perf_counter() - began:.0f} s")
        if found.law:
            schemes[law], sup[law] = found.law.scheme, found.proof.worst
    began = time.perf_counter()
    schemes |= opponents(case, family, folder / name)
    print(f"  opponents after {time.perf_counter() - began:.0f} s", flush=True)
    return [
        {"family": name, "law": law, "noise": noise_of(case), "sup": sup.get(law)}
        | row_of(case, scheme, folder / name / law.replace(" ", "-"))
        for law, scheme in schemes.items()
    ]


def row_of(case: Case, scheme: Scheme, place: Path) -> dict:
    """The errors of a law on the machines that judge, kept beside its store."""
    kept, store = place.with_suffix(".json"), place.with_suffix(".zarr")
    if kept.exists():
        return json.loads(kept.read_text())
    sweep = Sweep(
        case.machine, {"law": scheme}, case.task, case.last, case.uncertainty,
        machines=JUDGED_ON + 1, seed=JUDGES,
    )  # fmt: skip
    (one,) = summarise(sweep.run(store, resume=store.exists()), None, metric=METRIC)
    row = {}
    for trial in (t for t in SHOWN if t <= case.last):
        for quantile, of in (("median", one.median), ("95 %", one.high), ("worst", one.worst)):
            row[f"{quantile} {trial}"] = float(of[trial - 1])
    row |= {"diverged": float(one.diverged), "grown": float(one.semi_converged)}
    kept.write_text(json.dumps(row))
    return row


def noise_of(case: Case) -> float:
    """Root mean square of what the sensor adds, below which no measured error can be."""
    noise = None if case.machine.sensor is None else case.machine.sensor.noise
    return 0.0 if noise is None else float(np.max(noise))


def main(*names: str) -> None:
    jaxilc.setup()
    keep_programs()
    folder = output.folder(__file__)
    rows = []
    for name in names or FAMILIES:
        kept = folder / f"{name}.json"
        print(name, flush=True)
        if not kept.exists():
            kept.write_text(json.dumps(judged(name, folder)))
        rows += json.loads(kept.read_text())
    every = dict.fromkeys(key for row in rows for key in row)
    output.write_rows(folder / "laws.csv", [dict.fromkeys(every) | row for row in rows])


if __name__ == "__main__":
    main(*sys.argv[1:])
