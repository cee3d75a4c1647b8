"""Tests of the certificates on random machines under every learning law.

Each claim is compared with 1500 simulated trials.

The machines have order 1 to 6. Some have a delay, resonances of damping down to 0.003 or zeros
outside the unit circle. Every second one has limits of input and rate, every eighth has two inputs
and outputs. A repeating disturbance acts on each output. For each law are counted: the claims, the
claims that the simulation contradicts, and the reasons why nothing is claimed of the other
machines.

A second calculation decides where a claim is due, with matrices that NumPy and SciPy make from the
equations. Learning is truly monotone if sigma_max(keep - L G) < 1 on the inputs that learning
changes, or sigma_max(I - G L) < 1 where nothing is forgotten and the law does not use e[0], and if
no limit is reached in 1500 trials of u_{j+1} = keep u_j + L e_j.
"""

import sys
from collections import Counter

import numpy as np
import output
import scipy.linalg
import scipy.signal
from conditions_under_attack import lifted, mirrored, stacked_machines, symmetric, task_of

import jaxilc
from jaxilc.filters import SwitchableFilter, ZeroPhaseButterworth, ZeroPhaseFIR
from jaxilc.plants import StateSpace
from jaxilc.schemes import (
    CFDLMFAC,
    CFDLMFAILC,
    FFDLMFAILC,
    PFDLMFAILC,
    PID,
    ErrorFiltered,
    ExponentialPD,
    Filtered,
    HigherOrder,
    Ladder,
    NormOptimal,
    OnReference,
    PIDType,
    StopWhen,
    WithFeedback,
)
from jaxilc.theory import CLAIMS, certify_each

MACHINES, TRIALS, DT, SAMPLES, ORDER = 2048, 1500, 1e-3, 40, 10
JUDGED = "truly monotone", "of these certified"
REASONS = (
    "is met in trial",
    "is met later cannot be excluded",
    "no power of the learning map",
    "beyond the digits of the numbers",
    "learns by",
    "acts within the trial by",
)
P, Q = PIDType(gamma_p=0.5), ZeroPhaseButterworth(80.0)
MODEL = {
    1: StateSpace([[0.8]], [[0.2]], [[1.0]], dt=DT),
    2: StateSpace(0.8 * np.eye(2), 0.2 * np.eye(2), np.eye(2), dt=DT),
}


def laws(channels: int) -> dict:
    return {
        "P": P,
        "P, small": PIDType(gamma_p=0.03),
        "P, lead": PIDType(gamma_p=0.5, lead=2),
        "PD": PIDType(gamma_p=0.3, gamma_d=0.5),
        "PID, leak": PIDType(gamma_p=0.4, gamma_i=0.01, leak=0.05),
        "P, leak": PIDType(gamma_p=0.5, leak=0.1),
        "P, limit": PIDType(gamma_p=0.5, limit=3.0),
        "exponential": ExponentialPD(K_P=0.1, lam0=20.0),
        "exponential, steep": ExponentialPD(K_P=0.1, lam0=60.0, K_D=1e-4),
        "Q": Filtered(PIDType(gamma_p=0.5, lead=2), Q),
        "Q, odd extension": Filtered(
            PIDType(gamma_p=0.5, lead=2), ZeroPhaseButterworth(80.0, padding=9)
        ),
        "Q, FIR": Filtered(PIDType(gamma_p=0.5, lead=1), ZeroPhaseFIR((0.4, 0.2, 0.1))),
        "Q, limit": Filtered(PIDType(gamma_p=0.5, lead=2, limit=3.0), Q),
        "Q, switchable": Filtered(P, SwitchableFilter((50.0, 120.0), (0.02,), 0.01)),
        "error filtered": ErrorFiltered(PIDType(gamma_p=0.5, lead=2), ZeroPhaseButterworth(60.0)),
        "higher order": HigherOrder((0.7, 0.3), (0.4, 0.1)),
        "norm-optimal": NormOptimal(MODEL[channels], w_q=1.0, w_r=0.3, w_s=0.01),
        "over PID": WithFeedback(P, PID(kp=0.1, ki=2.0)),
        "over PID, limit": WithFeedback(P, PID(kp=0.1, ki=2.0, limit=0.3)),
        "on reference": OnReference(PIDType(gamma_p=0.5, lead=1), PID(kp=0.3, ki=10.0)),
        "over MFAC": WithFeedback(P, CFDLMFAC(lam=1.0, phi0=0.3)),
        "stop": StopWhen(P, rms=0.01, growth=0.1),
        "ladder": Ladder(P, repeats=3),
        "ladder, adapted gain": Ladder(P, repeats=1, slow=0.9),
        "CFDL-MFAILC": CFDLMFAILC(phi0=0.5, lam=0.5, reset="sign"),
        "PFDL-MFAILC": PFDLMFAILC(phi0=(0.5, 0.1), lam=0.5, reset="sign"),
        "FFDL-MFAILC": FFDLMFAILC(phi0=(0.3, 0.0, 0.5, 0.0), lam=0.5, reset="sign"),
        "CFDL-MFAILC, Q": Filtered(CFDLMFAILC(phi0=0.5, lam=0.5, reset="sign"), Q),
    }


# Machines
# --------------------------------------------------------------------------------------------------


def random_plant(rng):
    """A (10, 10), B (10, 1), C (1, 10), padded with zeros, with a random size of the response."""
    order, kind = rng.integers(1, 7), rng.choice(["real", "resonant", "mixed", "nonminimum phase"])
    poles: list = []
    while len(poles) < order:
        if order - len(poles) >= 2 and kind in ("resonant", "mixed") and rng.random() < 0.7:
            w, zeta = 2 * np.pi * rng.uniform(10, 250), 10 ** rng.uniform(-2.5, -0.1)
            pole = np.exp((-zeta + 1j * np.sqrt(1 - zeta**2)) * w * DT)
            poles += [pole, pole.conj()]
        else:
            poles.append(
                np.exp(-2 * np.pi * 10 ** rng.uniform(0.5, 2.7) * DT) * rng.choice([1, 1, 1, -0.5])
            )
    outside = kind == "nonminimum phase"
    zeros = [
        rng.uniform(1.05, 3) * rng.choice([1, -1]) if outside else rng.uniform(-0.95, 0.95)
        for _ in range(rng.integers(0, order))
    ]
    bottom = np.concatenate([np.poly(poles).real, np.zeros(rng.choice([0, 0, 0, 1, 2]))])
    top = np.atleast_1d(np.poly(zeros)).real
    A, B, C, _ = scipy.signal.tf2ss(top, bottom)
    z = np.exp(1j * np.linspace(1e-3, np.pi, 400))
    response = np.abs(np.polyval(top, z) / np.polyval(bottom, z))
    reference = {
        "slow": response[0],
        "peak": np.max(response),
        "first": np.max(np.abs(scipy.signal.dimpulse((top, bottom, DT))[1][0])),
    }
    size = reference[rng.choice(list(reference))]
    sign = np.sign(np.polyval(top, 1) / np.polyval(bottom, 1)) if rng.random() < 0.9 else 1.0
    m, padded = len(A), (np.zeros((ORDER, ORDER)), np.zeros((ORDER, 1)), np.zeros((1, ORDER)))
    padded[0][:m, :m], padded[1][:m], padded[2][:, :m] = (
        A,
        B,
        C * sign / size * rng.uniform(0.3, 1.5),
    )
    return padded


def plants(rng, count: int, channels: int):
    """(A, B, C) of `count` plants, with a leading axis.

    With two channels there are four plants, and the coupling is a tenth as strong as the diagonal.
    """
    if channels == 1:
        return tuple(
            np.stack(M) for M in zip(*(random_plant(rng) for _ in range(count)), strict=True)
        )
    found = []
    for _ in range(count):
        (A1, B1, C1), (A2, B2, C2), (A3, B3, C3), (A4, B4, C4) = (
            random_plant(rng) for _ in range(4)
        )
        o, weak = np.zeros_like(B1), 10 ** rng.uniform(-2, -0.3)
        B = np.block([[B1, o], [o, B2], [o, weak * B3], [weak * B4, o]])
        C = np.block([[C1, o.T, C3, o.T], [o.T, C2, o.T, C4]])
        found.append((scipy.linalg.block_diag(A1, A2, A3, A4), B, C))
    return tuple(np.stack(M) for M in zip(*found, strict=True))


def stacked(rng, count: int, channels: int, limited: bool):
    """The machines with a leading axis, and their task."""
    A, B, C = plants(rng, count, channels)
    d = 0.1 * rng.standard_normal((count, SAMPLES + 1, channels))
    limits = (
        [10 ** rng.uniform(-0.5, 2.5, count), 10 ** rng.uniform(2, 5, count)] if limited else []
    )
    return stacked_machines(A, B, C, d, limits), task_of(SAMPLES, channels)


# The true result, by a second calculation
# --------------------------------------------------------------------------------------------------


def shifted(m: int):
    """The matrix S of (S e)[k] = e[k+1+m], with e counted from 1, and zero beyond the end."""
    return np.eye(SAMPLES, k=m)


def difference():
    """The matrix of e[k+1] - e[k], with e counted from 1, without e[0]."""
    return np.eye(SAMPLES) - np.eye(SAMPLES, k=-1)


def filter_matrix(kind: str):
    sections = scipy.signal.butter(2, 80.0, fs=1 / DT, output="sos")
    if kind == "mirrored":
        return mirrored(
            lambda f: np.abs(scipy.signal.sosfreqz(sections, f, fs=1 / DT)[1]) ** 2, SAMPLES
        )
    if kind == "odd":
        return scipy.signal.sosfiltfilt(sections, np.eye(SAMPLES), axis=0, padlen=9)
    return symmetric((0.4, 0.2, 0.1), SAMPLES)


def matrices() -> dict:
    """(keep, L, whether e[0] is used) for one channel, for the laws with a short formula."""
    eye, time = np.eye(SAMPLES), DT * np.arange(SAMPLES)
    mirrored, odd, fir = (filter_matrix(kind) for kind in ("mirrored", "odd", "FIR"))
    return {
        "P": (eye, 0.5 * shifted(0), False),
        "P, small": (eye, 0.03 * shifted(0), False),
        "P, lead": (eye, 0.5 * shifted(2), False),
        "PD": (eye, 0.3 * shifted(0) + 0.5 * difference(), True),
        "PID, leak": (0.95 * eye, 0.4 * shifted(0) + 0.01 * np.tri(SAMPLES), True),
        "P, leak": (0.9 * eye, 0.5 * shifted(0), False),
        "exponential": (eye, np.diag(0.1 * np.exp(20.0 * time)), False),
        "Q": (mirrored, 0.5 * mirrored @ shifted(2), False),
        "Q, odd extension": (odd, 0.5 * odd @ shifted(2), False),
        "Q, FIR": (fir, 0.5 * fir @ shifted(1), False),
    }


def truly_monotone(machines, task, law) -> np.ndarray:
    """(S,) whether learning is monotone, by dense matrices and a recursion for each channel."""
    keep, L, reads_start = law
    channels = task.outputs
    keep, L = np.kron(keep, np.eye(channels)), np.kron(L, np.eye(channels))
    moved = np.any(np.concatenate([keep - np.eye(len(keep)), L], axis=1) != 0, axis=1)
    found = []
    for i in range(len(machines.plant.A)):
        plant = machines.plant
        G = lifted(*(np.asarray(M[i]) for M in (plant.A, plant.B, plant.C)), SAMPLES)
        M = (keep - L @ G)[np.ix_(moved, moved)]
        error = (np.asarray(task.reference) - np.asarray(machines.disturbance.output[i]))[
            1:
        ].ravel()
        kept = np.array_equal(keep, np.eye(len(keep))) and not reads_start
        true = np.linalg.norm(M, 2) < 1 or (kept and np.linalg.norm(np.eye(len(G)) - G @ L, 2) < 1)
        found.append(true and within_limits(machines.actuator, i, keep, L, G, error, channels))
    return np.array(found)


def within_limits(actuator, i, keep, L, G, error, channels) -> bool:
    if actuator is None:
        return True
    limit, rate = float(actuator.limit[i]), float(actuator.rate[i])
    u = np.zeros(len(G))
    for _ in range(TRIALS):
        if (
            np.max(np.abs(u)) > limit
            or np.max(np.abs(np.diff(u.reshape(-1, channels), axis=0, prepend=0.0))) > rate * DT
        ):
            return False
        u = keep @ u + L @ (error - G @ u)
    return True


# The comparison
# --------------------------------------------------------------------------------------------------


def attacked(name: str, groups, oracle) -> tuple[dict, Counter]:
    """A row of the table, and the reasons why nothing was claimed."""
    claims, reasons, broken, true, certified = Counter(), Counter(), 0, 0, 0
    for machines, task in groups:
        found = certify_each(machines, laws(task.outputs)[name], task, TRIALS)
        claims.update(found.claim.tolist())
        reasons.update(
            in_short(why)
            for why, claim in zip(found.reason, found.claim, strict=True)
            if claim == "not claimed"
        )
        broken += len(found.broken_promises())
        if oracle is not None:
            due = truly_monotone(machines, task, oracle)
            true, certified = (
                true + int(np.sum(due)),
                certified + int(np.sum(due & (found.claim == "monotone"))),
            )
    row = {"law": name} | {claim: claims[claim] for claim in CLAIMS} | {"contradicted": broken}
    return row | {
        "truly monotone": true if oracle is not None else "",
        "of these certified": certified if oracle is not None else "",
    }, reasons


def in_short(reason: str) -> str:
    return next((part for part in REASONS if part in reason), reason)


def main(count: int, names: list[str]) -> None:
    jaxilc.setup()
    folder, rng = output.folder(__file__), np.random.default_rng(16)
    sizes = {
        (1, False): count * 7 // 16,
        (1, True): count * 7 // 16,
        (2, False): count // 16,
        (2, True): count // 16,
    }
    groups = [stacked(rng, size, channels, limited) for (channels, limited), size in sizes.items()]
    oracles, rows, reasons = matrices(), [], []
    for name in names:
        row, why = attacked(name, groups, oracles.get(name))
        rows.append(row)
        reasons += [
            {"law": name, "why nothing is claimed": reason, "machines": times}
            for reason, times in why.most_common()
        ]
        print(row, dict(why), flush=True)
    output.write_rows(folder / "laws.csv", rows)
    output.write_rows(folder / "abstentions.csv", reasons)
    total = {key: sum(row[key] or 0 for row in rows) for key in ("contradicted", *JUDGED)}
    print(f"{sum(sizes.values())} machines under {len(rows)} laws, {TRIALS} trials: {total}")


if __name__ == "__main__":
    machines = int(sys.argv[1]) if len(sys.argv) > 1 else MACHINES
    main(machines, output.asked(sys.argv[2:], laws(1)))
