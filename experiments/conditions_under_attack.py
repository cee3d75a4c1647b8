"""Tests of the conditions on the frequency response.

The tests ask whether the maxima are found, whether the conditions hold for the whole trial, and
whether no claim is made where none is allowed.

    norm-optimal    120 pairs of a model and a machine, each with its own resonance, against dense
                    frequency lines around both
    family          100 boxes of a gain and a resonance, against a grid of plants and lines
    filtered        100 servo loops under a Butterworth filter and a lead, against eigenvalues of
                    the dense learning matrix
    robust          the same with a plant that is uncertain by 10 %, against perturbed plants
    light damping   150 machines of damping 0.003 to 0.1 in trials of 600 samples
"""

import sys

import numpy as np
import output
import scipy.fft
import scipy.linalg
import scipy.signal

import jaxilc
from jaxilc import Machine, Task
from jaxilc.filters import ZeroPhaseButterworth
from jaxilc.plants import ProcessModel, StateSpace
from jaxilc.schemes import Filtered, PIDType
from jaxilc.theory import frequency
from jaxilc.uncertainty import Uniform

DT = 1e-3


def task_of(samples: int) -> Task:
    return Task(np.sin(np.pi * np.arange(samples + 1) / samples) ** 2, dt=DT)


def held(modes, gain=1.0):
    """(A, B, C) of gain prod w^2 / (s^2 + 2 zeta w s + w^2), sampled with a hold, by SciPy.

    modes: pairs (w, zeta) of a frequency [rad/s] and a damping
    """
    top, bottom = gain, np.array([1.0])
    for w, zeta in modes:
        top, bottom = top * w * w, np.polymul(bottom, [1.0, 2 * zeta * w, w * w])
    A, B, C, D = scipy.signal.tf2ss([top], bottom)
    scale = scipy.linalg.matrix_balance(A, permute=False, separate=True)[1][0]
    A, B, C = A / scale[:, None] * scale, B / scale[:, None], C * scale
    return scipy.signal.cont2discrete((A, B, C, D), DT)[:3]


def response(plant, f):
    A, B, C = plant
    z = np.exp(2j * np.pi * f * DT)
    return np.array([(C @ np.linalg.solve(x * np.eye(len(A)) - A, B))[0, 0] for x in z])


def lines(*modes):
    """Frequency lines [Hz], dense around the resonances."""
    near = [w / (2 * np.pi) * (1 + zeta * np.linspace(-12, 12, 241)) for w, zeta in modes]
    f = np.concatenate([np.geomspace(0.1, 500.0, 1500), *near])
    return np.unique(f[(f > 0) & (f < 500)])


def q_response(cutoff, f):
    return 1 / (1 + (np.tan(np.pi * f * DT) / np.tan(np.pi * cutoff * DT)) ** 4)


def radius(plant, law: Filtered, samples: int) -> float:
    """Spectral radius of Q (I - L G), for P-type with a lead and a filter with mirrored ends."""
    G = lifted(*plant, samples)
    response = q_response(float(law.filter.cutoff), np.arange(samples) / (2 * samples * DT))
    Q = scipy.fft.idct(response[:, None] * scipy.fft.dct(np.eye(samples), axis=0), axis=0)
    L = float(law.scheme.gamma_p) * np.eye(samples, k=law.scheme.lead)
    return float(np.max(np.abs(np.linalg.eigvals(Q @ (np.eye(samples) - L @ G)))))


def lifted(A, B, C, samples: int) -> np.ndarray:
    """The lifted plant (samples n_y, samples n_u): the block Toeplitz matrix of C A^k B."""
    x, markov = B, []
    for _ in range(samples):
        markov.append(C @ x)
        x = A @ x
    lag = np.subtract.outer(np.arange(samples), np.arange(samples))
    blocks = np.stack(markov)[np.maximum(lag, 0)] * (lag >= 0)[:, :, None, None]
    return blocks.swapaxes(1, 2).reshape(samples * len(C), samples * B.shape[1])


def norm_optimal(rng, count=120) -> dict:
    low = holds = 0
    for _ in range(count):
        modes = [(rng.uniform(100, 1500), 10 ** rng.uniform(-3.5, -0.7)) for _ in range(2)]
        model, machine = (held([mode]) for mode in modes)
        w_e, w_u, w_delta = 1.0, 10 ** rng.uniform(-3, -0.5), 10 ** rng.uniform(-2, 0)
        of = [Machine(StateSpace(*one, dt=DT)) for one in (model, machine)]
        found = frequency.norm_optimal_condition(
            *of, None, task_of(100), w_e=w_e, w_u=w_u, w_delta=w_delta
        ).condition
        f = lines(*modes)
        G, G_t = response(model, f), response(machine, f)
        brute = np.max(np.abs(w_delta + np.conj(G) * (G - G_t)) / (np.abs(G) ** 2 + w_u + w_delta))
        low, holds = low + (found.value < brute * (1 - 1e-9)), holds + found.holds
    return {
        "condition": "norm-optimal",
        "tried": count,
        "value too low": low,
        "holds": holds,
        "contradicted": "",
        "abstained below 1": "",
    }


def family(rng, count=100) -> dict:
    low = holds = 0
    for _ in range(count):
        modes = [
            (rng.uniform(100, 400), rng.uniform(0.3, 0.9)),
            (rng.uniform(400, 1500), 10 ** rng.uniform(-2.3, -0.7)),
        ]
        (slow, _), (w, zeta) = modes
        plant = ProcessModel(gain=1.0, frequencies=(slow, w), dampings=(modes[0][1], zeta))
        box = {
            "plant.gain": Uniform(0.85, 1.15, relative=True),
            "plant.frequencies[1]": Uniform(0.8 * w, 1.2 * w),
        }
        gamma, lead, cutoff = rng.uniform(0.2, 0.8), int(rng.integers(0, 8)), rng.uniform(30, 150)
        law = Filtered(PIDType(gamma_p=gamma, lead=lead), ZeroPhaseButterworth(cutoff))
        found = frequency.family_condition(
            Machine(plant), box, law, task_of(200), machines=32
        ).condition
        brute = 0.0
        for share in np.linspace(0.8, 1.2, 21):
            f = lines((share * w, zeta))
            P, zL = (
                response(held([modes[0], (share * w, zeta)]), f),
                gamma * np.exp(2j * np.pi * f * DT * (1 + lead)),
            )
            brute = max(
                brute,
                *(
                    np.max(q_response(cutoff, f) * np.abs(1 - zL * gain * P))
                    for gain in (0.85, 1.0, 1.15)
                ),
            )
        low, holds = low + (found.value < brute * (1 - 1e-6)), holds + found.holds
    return {
        "condition": "family",
        "tried": count,
        "value too low": low,
        "holds": holds,
        "contradicted": "",
        "abstained below 1": "",
    }


def filtered(rng, count=100) -> list[dict]:
    rows = {name: [0, 0, 0] for name in ("filtered", "robust")}
    for _ in range(count):
        modes = [
            (rng.uniform(60, 500), rng.uniform(0.2, 0.9)),
            (rng.uniform(300, 2500), 10 ** rng.uniform(-2, -0.5)),
        ]
        plant = held(modes)
        law = Filtered(
            PIDType(gamma_p=rng.uniform(0.2, 0.9), lead=int(rng.integers(0, 9))),
            ZeroPhaseButterworth(rng.uniform(20, 120)),
        )
        machine, task = Machine(StateSpace(*plant, dt=DT)), task_of(200)
        for name, found, tried in (
            ("filtered", frequency.learning_condition(machine, law, task).condition, [plant]),
            (
                "robust",
                frequency.robust_condition(machine, law, task, 0.1).condition,
                perturbed(rng, plant),
            ),
        ):
            broken = found.holds and max(radius(one, law, 200) for one in tried) >= 1
            rows[name] = [
                x + y
                for x, y in zip(
                    rows[name],
                    (found.holds, broken, found.value < 1 and not found.holds),
                    strict=True,
                )
            ]
    names = "holds", "contradicted", "abstained below 1"
    return [
        {"condition": c, "tried": count, "value too low": ""} | dict(zip(names, row, strict=True))
        for c, row in rows.items()
    ]


def perturbed(rng, plant, count=4):
    """Plants P (1 + 0.1 D), where D is +-1 or an all-pass of first order."""
    A, B, C = plant
    found = [(A, share * B, C) for share in (0.9, 1.1)]
    for a in rng.uniform(-0.9, 0.9, count):
        # D = (1 - a z) / (z - a): x' = a x + w, y = (1 - a^2) x - a w, in front of the plant
        A2 = np.block([[A, 0.1 * (1 - a * a) * B], [np.zeros((1, len(A))), np.array([[a]])]])
        found.append((A2, np.vstack([(1 - 0.1 * a) * B, [[1.0]]]), np.hstack([C, [[0.0]]])))
    return found


def light_damping(rng, count=150) -> dict:
    holds = broken = abstained = 0
    for _ in range(count):
        plant = held([(rng.uniform(150, 1500), 10 ** rng.uniform(-2.5, -1))])
        law = Filtered(
            PIDType(gamma_p=rng.uniform(0.2, 0.8), lead=int(rng.integers(0, 3))),
            ZeroPhaseButterworth(rng.uniform(10, 60)),
        )
        found = frequency.learning_condition(
            Machine(StateSpace(*plant, dt=DT)), law, task_of(600)
        ).condition
        broken += found.holds and radius(plant, law, 600) >= 1
        holds, abstained = holds + found.holds, abstained + (found.value < 1 and not found.holds)
    counts = {"holds": holds, "contradicted": broken, "abstained below 1": abstained}
    return {"condition": "light damping, N = 600", "tried": count, "value too low": ""} | counts


PARTS = {
    "norm-optimal": lambda rng: [norm_optimal(rng)],
    "family": lambda rng: [family(rng)],
    "filtered": filtered,
    "light": lambda rng: [light_damping(rng)],
}

if __name__ == "__main__":
    jaxilc.setup()
    rows = []
    for name in sys.argv[1:] or PARTS:
        found = PARTS[name](np.random.default_rng(16))
        print(name, found, flush=True)
        rows += found
    output.write_rows(output.folder(__file__) / "rows.csv", rows)
