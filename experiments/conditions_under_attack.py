"""Conditions on the frequency response, of machines with resonances.

Is the maximum over frequency found, and do 1000 trials end nearer to their limit, the 1000th power
of the dense learning matrix, wherever a condition holds?

    norm-optimal    120 pairs of a model and a machine, each with its own resonance or nearly the
                    same, against dense frequency lines around both
    family          100 boxes of a gain and a resonance, against a grid of plants and lines
    filtered        100 servo loops under a Butterworth filter and a lead
    robust          the same with a plant that is uncertain by 10 %, against perturbed plants
    light damping   150 machines of damping 0.003 to 0.1 in trials of 600 samples
"""

import itertools
import sys
import time
from collections import Counter

import jax
import numpy as np
import output
import scipy.fft
import scipy.linalg
import scipy.signal

import jaxilc
from jaxilc import Actuator, Disturbance, Machine, Task
from jaxilc.filters import ZeroPhaseButterworth
from jaxilc.plants import ProcessModel, StateSpace
from jaxilc.schemes import Filtered, PIDType
from jaxilc.theory import frequency
from jaxilc.uncertainty import Uniform

DT = 1e-3
TRIALS, SECONDS, TOLD = 1000, 600, 20


def within(count: int):
    """So many turns, or as many as can be begun in the processor time of a class."""
    end = time.process_time() + SECONDS
    for turn in itertools.takewhile(lambda _: time.process_time() < end, range(count)):
        yield turn
        if (turn + 1) % TOLD == 0:
            print(f"   {turn + 1} tried", flush=True)


def ends(M) -> bool:
    """Whether 1000 trials end nearer to the limit than they began, from wherever they began."""
    with np.errstate(all="ignore"):
        power = np.linalg.matrix_power(M, TRIALS)
    if np.all(np.isfinite(power)) and np.linalg.norm(power, 2) < 1:
        return True
    return bool(np.max(np.abs(np.linalg.eigvals(M))) < 1)


class Counted:
    """The counts of a class."""

    def __init__(self, name):
        self.name, self.counts, self.why = name, Counter(), Counter()

    def add(self, condition, wrong: bool, low: bool = False):
        self.counts["tried"] += 1
        self.counts["claimed"] += condition.holds
        self.counts["wrong"] += bool(condition.holds and wrong)
        if condition.holds and wrong:
            print(f"   WRONG: case {self.counts['tried']} of {self.name}", flush=True)
        self.counts["value too low"] += bool(low)
        if not condition.holds:
            self.counts["fails" if condition.verdict == "fails" else "abstained"] += 1
            if condition.verdict != "fails":
                self.why.update([condition.broken[0].name])

    def row(self):
        names = ("tried", "claimed", "wrong", "value too low", "fails", "abstained")
        why = "; ".join(f"{k} {v}" for k, v in self.why.most_common())
        return {"class": self.name} | {n: self.counts[n] for n in names} | {"why": why}


def task_of(samples: int, outputs: int = 1, inputs: int | None = None) -> Task:
    """A bump, higher by a half for each further output; inputs: None for as many as outputs."""
    bump = np.sin(np.pi * np.arange(samples + 1) / samples) ** 2
    r = bump[:, None] * (1 + 0.5 * np.arange(outputs))
    return Task(r, dt=DT, inputs=inputs or outputs)


def stacked_machines(A, B, C, d, limits=()) -> Machine:
    """Machines with a leading axis, of plants, disturbances of the output, and limit and rate."""
    machine = Machine(
        StateSpace(A[0], B[0], C[0], dt=DT),
        Actuator(limit=1.0, rate=1.0) if len(limits) else None,
        None,
        Disturbance(output=d[0]),
    )
    return jax.tree.unflatten(jax.tree.structure(machine), [A, B, C, *limits, d])


def held(modes, gain=1.0):
    """(A, B, C) of gain prod w^2 / (s^2 + 2 zeta w s + w^2), sampled with a hold, by SciPy.

    modes: pairs (w, zeta) of a frequency [rad/s] and a damping
    """
    top, bottom = gain, np.array([1.0])
    for w, zeta in modes:
        top, bottom = top * w * w, np.polymul(bottom, [1.0, 2 * zeta * w, w * w])
    return sampled([top], bottom)


def sampled(top, bottom):
    """(A, B, C) of top(s) / bottom(s), sampled with a hold, by SciPy."""
    A, B, C, D = scipy.signal.tf2ss(top, bottom)
    scale = scipy.linalg.matrix_balance(A, permute=False, separate=True)[1][0]
    A, B, C = A / scale[:, None] * scale, B / scale[:, None], C * scale
    return scipy.signal.cont2discrete((A, B, C, D), DT)[:3]


def response(plant, f):
    A, B, C = plant
    z = np.exp(2j * np.pi * np.asarray(f) * DT)[:, None, None]
    return (C @ np.linalg.solve(z * np.eye(len(A)) - A, B))[:, 0, 0]


def lines(*modes):
    """Frequency lines [Hz], dense around the resonances."""
    near = [w / (2 * np.pi) * (1 + zeta * np.linspace(-12, 12, 241)) for w, zeta in modes]
    f = np.concatenate([np.geomspace(0.1, 500.0, 1500), *near])
    return np.unique(f[(f > 0) & (f < 500)])


def q_response(cutoff, f):
    return 1 / (1 + (np.tan(np.pi * f * DT) / np.tan(np.pi * cutoff * DT)) ** 4)


def mirrored(response, samples: int) -> np.ndarray:
    """A zero-phase filter of a signal that is mirrored at its ends, by SciPy's cosine transform.

    response: function of frequencies [Hz]
    """
    f = np.arange(samples) / (2 * samples * DT)
    return scipy.fft.idct(response(f)[:, None] * scipy.fft.dct(np.eye(samples), axis=0), axis=0)


def symmetric(taps, samples: int) -> np.ndarray:
    """A symmetric FIR filter by its taps from the middle on; the signal is held at its ends."""
    n = len(taps) - 1
    held_ends = np.pad(np.eye(samples), ((n, n), (0, 0)), mode="edge")
    kernel = zip(range(-n, n + 1), (*taps[:0:-1], *taps), strict=True)
    return sum(tap * held_ends[n + i : n + i + samples] for i, tap in kernel)


def map_of(plant, law: Filtered, samples: int) -> np.ndarray:
    """Q (I - L G), for P-type with a lead and a filter with mirrored ends."""
    G = lifted(*plant, samples)
    Q = mirrored(lambda f: q_response(float(law.filter.cutoff), f), samples)
    L = float(law.scheme.gamma_p) * np.eye(samples, k=law.scheme.lead)
    return Q @ (np.eye(samples) - L @ G)


def lifted(A, B, C, samples: int) -> np.ndarray:
    """The lifted plant (samples n_y, samples n_u): the block Toeplitz matrix of C A^k B."""
    x, markov = B, []
    for _ in range(samples):
        markov.append(C @ x)
        x = A @ x
    lag = np.subtract.outer(np.arange(samples), np.arange(samples))
    blocks = np.stack(markov)[np.maximum(lag, 0)] * (lag >= 0)[:, :, None, None]
    return blocks.swapaxes(1, 2).reshape(samples * len(C), samples * B.shape[1])


def norm_optimal(rng, count=120) -> list[dict]:
    found, samples = Counted("norm-optimal"), 100
    for _ in within(count):
        modes = [(rng.uniform(100, 1500), 10 ** rng.uniform(-3.5, -0.7)) for _ in range(2)]
        if rng.random() < 0.7:  # a machine near its model, of which the condition can hold
            (w, zeta), near = modes[0], 10 ** rng.uniform(-3, -1)
            modes[1] = w * (1 + near * rng.uniform(-1, 1)), zeta * (1 + near * rng.uniform(-1, 1))
        model, machine = (held([mode]) for mode in modes)
        w_e, w_u, w_delta = 1.0, 10 ** rng.uniform(-3, -0.5), 10 ** rng.uniform(-2, 0)
        of = [Machine(StateSpace(*one, dt=DT)) for one in (model, machine)]
        test = frequency.norm_optimal_condition(
            *of, None, task_of(samples), w_e=w_e, w_u=w_u, w_delta=w_delta
        ).condition
        f = lines(*modes)
        G, G_t = response(model, f), response(machine, f)
        brute = np.max(np.abs(w_delta + np.conj(G) * (G - G_t)) / (np.abs(G) ** 2 + w_u + w_delta))
        G, G_t = (lifted(*one, samples) for one in (model, machine))
        of_square, each = G.T @ G, np.eye(samples)
        M = np.linalg.solve(
            of_square + (w_u + w_delta) * each, w_delta * each + of_square - G.T @ G_t
        )
        found.add(test, test.holds and not ends(M), test.value < brute * (1 - 1e-9))
    return [found.row()]


def family(rng, count=100) -> list[dict]:
    found, samples = Counted("family"), 200
    for _ in within(count):
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
        test = frequency.family_condition(
            Machine(plant), box, law, task_of(samples), machines=32
        ).condition
        brute, wrong = 0.0, False
        for i, share in enumerate(np.linspace(0.8, 1.2, 21)):
            f = lines((share * w, zeta))
            one = held([modes[0], (share * w, zeta)])
            P, zL = response(one, f), gamma * np.exp(2j * np.pi * f * DT * (1 + lead))
            for gain in (0.85, 1.0, 1.15):
                brute = max(brute, np.max(q_response(cutoff, f) * np.abs(1 - zL * gain * P)))
                if test.holds and i % 5 == 0:
                    A, B, C = one
                    wrong |= not ends(map_of((A, gain * B, C), law, samples))
        found.add(test, wrong, test.value < brute * (1 - 1e-6))
    return [found.row()]


def filtered(rng, count=100) -> list[dict]:
    one, several = Counted("filtered"), Counted("robust")
    for _ in within(count):
        modes = [
            (rng.uniform(60, 500), rng.uniform(0.2, 0.9)),
            (rng.uniform(300, 2500), 10 ** rng.uniform(-2, -0.5)),
        ]
        plant = held(modes)
        law = Filtered(
            PIDType(gamma_p=rng.uniform(0.2, 0.9), lead=int(rng.integers(0, 9))),
            ZeroPhaseButterworth(rng.uniform(20, 120)),
        )
        about = Machine(StateSpace(*plant, dt=DT)), law, task_of(200)
        for found, test, tried in (
            (one, frequency.learning_condition(*about), [plant]),
            (several, frequency.robust_condition(*about, 0.1), perturbed(rng, plant)),
        ):
            wrong = test.condition.holds and not all(ends(map_of(p, law, 200)) for p in tried)
            found.add(test.condition, wrong)
    return [one.row(), several.row()]


def perturbed(rng, plant, count=4):
    """Plants P (1 + 0.1 D), where D is +-1 or an all-pass of first order."""
    A, B, C = plant
    found = [(A, share * B, C) for share in (0.9, 1.1)]
    for a in rng.uniform(-0.9, 0.9, count):
        # D = (1 - a z) / (z - a): x' = a x + w, y = (1 - a^2) x - a w, in front of the plant
        A2 = np.block([[A, 0.1 * (1 - a * a) * B], [np.zeros((1, len(A))), np.array([[a]])]])
        found.append((A2, np.vstack([(1 - 0.1 * a) * B, [[1.0]]]), np.hstack([C, [[0.0]]])))
    return found


def light_damping(rng, count=150) -> list[dict]:
    found = Counted("light damping, 600 samples")
    for _ in within(count):
        plant = held([(rng.uniform(150, 1500), 10 ** rng.uniform(-2.5, -1))])
        law = Filtered(
            PIDType(gamma_p=rng.uniform(0.2, 0.8), lead=int(rng.integers(0, 3))),
            ZeroPhaseButterworth(rng.uniform(10, 60)),
        )
        test = frequency.learning_condition(
            Machine(StateSpace(*plant, dt=DT)), law, task_of(600)
        ).condition
        found.add(test, test.holds and not ends(map_of(plant, law, 600)))
    return [found.row()]


PARTS = {
    "norm-optimal": norm_optimal,
    "family": family,
    "filtered": filtered,
    "light": light_damping,
}

if __name__ == "__main__":
    jaxilc.setup()
    rows = []
    for name in output.asked(sys.argv[1:], PARTS):
        found = PARTS[name](np.random.default_rng(16))
        print(name, found, flush=True)
        rows += found
    output.write_rows(output.folder(__file__) / "rows.csv", rows)
