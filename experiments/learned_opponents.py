"""Learning laws of a few weights, tuned on the machines on which `learned_laws.py` learns a law.

Each has the same machines, trials and steps as the learned law. P- and PD-type learning with a lead
and a Q-filter, P-type learning with a notch around the resonance too, the model inverse and ZPETC
with a gain and a Q-filter, and norm-optimal learning with its two weights and a Q-filter begin at
the best weights of a grid that are safe by frequency; these are then tuned by gradient for the mean
of the worst quarter of the machines (CVaR), and kept safe. Three are free of that test: the best
P-type law of a grid of gains, cutoffs and leads, by simulation; the model inverse with its gain and
cutoff as the gradient leaves them; and FFDL-MFAILC.
`model-inverse, as one` is Q P^-1 as one filter, with the best safe weights of the grid
(`candidates.model_inverse`); in the other two P^-1 is cut off at the end of the trial before Q.
"""

import dataclasses
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from learned_families import Case

from jaxilc.design.candidates import (
    INVERSE_GAINS,
    ORDER,
    Absent,
    Candidate,
    response_of_pd,
    rms_of,
    simulated,
    tuned,
    widest,
)
from jaxilc.design.learned import LearnedLaw
from jaxilc.design.responses import Family
from jaxilc.filters import ZeroPhaseButterworth, stable_inverse, zpetc
from jaxilc.plants import StateSpace
from jaxilc.schemes import FFDLMFAILC, ErrorFiltered, Filtered, PIDType, Scheme
from jaxilc.theory.law import law_of
from jaxilc.theory.loop import minimal
from jaxilc.theory.on_lines import low_pass
from jaxilc.tuning import Tuning
from jaxilc.tuning.objectives import EveryTrial, Holding
from jaxilc.tuning.risks import CVaR

METRIC, MARGIN, SEED = "rms", 0.05, 0
RISK = CVaR(0.75)
GAINS, SHARES, LEADS = np.geomspace(0.1, 1.2, 8), np.geomspace(0.004, 0.3, 16), 16
SIMULATED = 160  # laws of this grid that are simulated: those of least error by the responses
KEPT = ("p-type", "pd-type", "p-type-notch", "model-inverse", "norm-optimal")


def learned_law(case: Case, **settings) -> LearnedLaw:
    """The learned law of a case, judged as its opponents are."""
    return LearnedLaw(
        case.machine, case.task, case.trials, case.uncertainty, case.feedback, metric=METRIC,
        margin=MARGIN, seed=SEED, risk=RISK, **settings,
    )  # fmt: skip


def opponents(
    case: Case, family: Family, safe: list[Candidate | Absent], folder: Path
) -> Iterator[tuple[str, Scheme, float]]:
    """Name, scheme and seconds of tuning of each law; why one has no weights is printed.

    safe: laws of a few weights with the best safe ones of a grid
    """
    began = time.perf_counter()
    found = [
        *safe,
        of_inverse(case, family, "model-inverse", stable_inverse),
        of_inverse(case, family, "zpetc", zpetc),
    ]
    for one in found:
        if isinstance(one, Absent):
            print(f"    {one.name}: {one.why}", flush=True)
            continue
        if not one.bounds:
            yield f"{one.name}, as one", one.scheme, time.perf_counter() - began
            began = time.perf_counter()
            continue
        if one.name == "p-type-notch":
            yield "p-type-notch, grid", one.scheme, 0.0
        state = folder / f"tuning-{one.name}"
        better = tuned(
            one, family, case.task, case.trials, metric=METRIC,
            margin=MARGIN, out=state, resume=state.exists(), quantities={}, **case.budget(),
        )  # fmt: skip
        yield one.name, better.scheme, time.perf_counter() - began
        began = time.perf_counter()
        if one.name == "model-inverse":
            yield (
                "model-inverse, free",
                free(case, one, folder / "tuning-free"),
                time.perf_counter() - began,
            )
            began = time.perf_counter()
    grid = best_of_grid(case, family)
    yield "p-type, grid", grid, time.perf_counter() - began
    began = time.perf_counter()
    ffdl = of_ffdl(case, family, grid, folder / "tuning-ffdl")
    yield "ffdl-mfailc", ffdl, time.perf_counter() - began


def tuning_of(case: Case, scheme: Scheme, bounds: dict) -> Tuning:
    """The tuning that `tuned` runs, for a scheme without the test by frequency after it."""
    first = max(1, round(0.75 * case.trials))
    return Tuning(
        case.machine, scheme, case.task, case.trials, bounds, case.uncertainty,
        Holding(first, METRIC) + 0.02 * EveryTrial(METRIC), RISK, **case.budget(), seed=SEED,
    )  # fmt: skip


def free(case: Case, safe: Candidate, state: Path) -> Scheme:
    """The law with the weights that a tuning without the test by frequency finds."""
    return tuning_of(case, safe.scheme, safe.bounds).run(state, resume=state.exists()).scheme


def of_inverse(case: Case, family: Family, name: str, inverse) -> Candidate | Absent:
    """Q (u + gamma F e) with an inverse F of the nominal loop, and weights that are safe."""
    try:
        F = inverse(StateSpace(*minimal(family.loops[0], case.task.N), dt=case.task.dt))
    except ValueError as error:
        return Absent(name, str(error))
    F = dataclasses.replace(F, advance=F.advance - 1)  # PIDType looks one sample ahead
    law = law_of(ErrorFiltered(PIDType(gamma_p=1.0), F), case.task)
    L = family.of_taps(law.L, case.task.dt) if name == "zpetc" else 1 / family.P[0]
    laws = ({"gamma_p": g, "L": g * L} for g in INVERSE_GAINS)
    best = next(iter(widest(family, laws, case.task, case.trials, MARGIN)), None)
    if best is None:
        return Absent(name, "no weights keep the margin on every machine")
    gain, cutoff = best.weights["gamma_p"], best.weights["cutoff"]
    scheme = Filtered(ErrorFiltered(PIDType(gamma_p=gain), F), ZeroPhaseButterworth(cutoff))
    bounds = {
        "scheme.scheme.gamma_p": (gain / 4, 1.5),
        "filter.cutoff": (cutoff / 4, min(4 * cutoff, 0.45 / case.task.dt)),
    }
    return Candidate(name, "", case.under(scheme), case.named(bounds), best.largest, best.predicted)


def best_of_grid(case: Case, family: Family) -> Scheme:
    """The P-type law with lead and Q-filter of least error at 95 % of the machines of a family."""
    dt, longest = case.task.dt, max(4, min(60, case.task.N // 20))
    steady = family.P[:, 0].real  # not the peak of a resonance
    gains = GAINS / float(np.max(np.abs(steady))) * np.sign(steady[0])
    leads = sorted({round(x) for x in np.geomspace(1, longest, LEADS)} | {0})
    loops = family.loops[:: max(1, len(family.loops) // 8)]
    laws = [
        {"gamma_p": float(g), "gamma_d": 0.0, "lead": m, "cutoff": float(share / dt)}
        for g in gains
        for m in leads
        for share in SHARES
    ]
    laws = predicted_best(family, laws, dt, case.trials)
    few = max(1, int(4e7 / (len(loops) * case.task.N * 8)))  # at a time, to spare memory
    parts = []
    for i in range(0, len(laws), few):
        for e in simulated(loops, family.first_error, laws[i : i + few], dt, case.trials):
            last = e
        parts.append(rms_of(last))
    errors = np.nan_to_num(np.concatenate(parts), nan=np.inf)
    best = laws[int(np.argmin(np.quantile(errors, 0.95, axis=1, method="higher")))]
    law = PIDType(gamma_p=best["gamma_p"], lead=best["lead"])
    return case.under(Filtered(law, ZeroPhaseButterworth(best["cutoff"])))


def predicted_best(family: Family, laws: list[dict], dt: float, trials: int) -> list[dict]:
    """The `SIMULATED` laws of least error by the frequency responses, at 95 % of the machines."""
    quiet, errors = family._replace(noise=0 * family.noise), []
    for law in laws:
        Q = low_pass(family.frequencies, law["cutoff"], dt, ORDER)
        errors.append(np.quantile(quiet.rms(Q, response_of_pd(family, law, dt), trials), 0.95))
    order = np.argsort(np.nan_to_num(errors, nan=np.inf))
    return [laws[i] for i in order[:SIMULATED]]


def of_ffdl(case: Case, family: Family, p_type: Scheme, state: Path) -> Scheme:
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
    return tuning_of(case, scheme, case.named(bounds)).run(state, resume=state.exists()).scheme
