"""How near `--auto` comes to the true model of 40 simulated drives, made without the package.

A drive has one to three masses in a row, with viscous friction, springs and dampers; a current loop
of first order; an encoder of position or speed on the motor or on the last mass. Half of them are
driven by their force, the others closed by a cascade of a speed loop (PI) and a position loop (P),
so that their input is a reference. Every second one has a dead time of up to six samples, half of
these not of whole samples. The input is an M-sequence, a multisine or a swept sine; the output has
white noise of 0.1 to 10 % of its standard deviation, every fifth one is rounded by its encoder.

The model is judged by the last 30 % of the record, simulated without a break from the first sample;
the fit of the true model there is 100 (1 - |noise| / |y - mean y|). NumPy and SciPy make the
records. The last line counts the drives whose fit is within 0.5 % of that of the true model.

    python experiments/drives_identified.py [drives] [seed of the first drive]
"""

import sys
import time
from typing import NamedTuple

import numpy as np
import scipy

FINE = 8  # steps a sample of the simulation, so that a dead time need not be whole samples


class Drive(NamedTuple):
    """A record and what made it: u (N,), y and the output without noise (N+1,), dt [s]."""

    u: np.ndarray
    y: np.ndarray
    clean: np.ndarray
    dt: float
    said: str
    order: int

    @property
    def true_fit(self) -> float:
        """The fit [%] of the true model over the last 30 %."""
        return fit(self.y, self.clean)


def fit(y: np.ndarray, simulated: np.ndarray) -> float:
    """The fit [%] over the last 30 % of a record."""
    last = slice(round(0.7 * len(y)), None)
    error, about = y[last] - simulated[last], y[last] - np.mean(y[last])
    return 100 * (1 - np.linalg.norm(error) / np.linalg.norm(about))


def drive(seed: int) -> Drive:
    """A drive and its record, drawn by the seed."""
    rng = np.random.default_rng(seed)
    masses, cascade, at_load = 1 + seed % 3, seed % 2 == 1, bool(rng.integers(2))
    of_speed, dt = bool(rng.integers(2)) and not cascade, rng.choice([5e-4, 1e-3, 2e-3])
    A, B, C = mechanics(rng, masses, dt, cascade)
    row = (masses - 1 if at_load else 0) + (masses if of_speed else 0)
    C = C[row : row + 1]
    late = 0.0
    if seed % 4 in (1, 2):
        late = rng.uniform(0, 6)
        late = round(FINE * late) / FINE if rng.integers(2) else float(round(late))
    samples = int(rng.choice([2000, 4000, 8000]))
    u, kind = excitation(rng, samples, dt)
    fine = np.r_[np.zeros(round(FINE * late)), np.repeat(u, FINE)][: FINE * len(u)]
    system = scipy.signal.cont2discrete((A, B, C, np.zeros((1, 1))), dt / FINE)
    clean = np.zeros(samples + 1)
    x, (A_d, B_d) = np.zeros(len(A)), (system[0], system[1][:, 0])
    for k, value in enumerate(fine):
        x = A_d @ x + B_d * value
        if k % FINE == FINE - 1:
            clean[k // FINE + 1] = C[0] @ x
    level = np.std(clean) * 10 ** rng.uniform(-3, -1)
    y = clean + level * rng.normal(size=samples + 1)
    if seed % 5 == 4:
        y = np.round(y / level) * level
    said = (
        f"{masses} masses, {'cascade' if cascade else 'force'} to "
        f"{'speed' if of_speed else 'position'} of the {'load' if at_load else 'motor'}, "
        f"{late:g} samples late, {kind}, {samples} samples of {1e3 * dt:g} ms, noise "
        f"{100 * level / np.std(clean):.2g} %"
    )
    return Drive(u, y, clean, float(dt), said, len(A))


def mechanics(rng, masses: int, dt: float, cascade: bool):
    """A, B and C (positions, then speeds) of the chain behind its current loop."""
    m = np.exp(rng.uniform(np.log(0.3), np.log(3), masses))
    M, K, D = np.diag(m), np.zeros((masses, masses)), np.diag(m * rng.uniform(2, 20, masses))
    for i in range(masses - 1):
        w = 2 * np.pi * rng.uniform(0.02, 0.15) / dt * (1 + i)  # of the two masses by themselves
        k = w**2 * m[i] * m[i + 1] / (m[i] + m[i + 1])
        d = 2 * np.exp(rng.uniform(np.log(0.005), np.log(0.05))) * k / w
        side = np.zeros(masses)
        side[i : i + 2] = 1, -1
        K, D = K + k * np.outer(side, side), D + d * np.outer(side, side)
    n, fast = 2 * masses + 1, 2 * np.pi * rng.uniform(0.1, 0.4) / dt
    A, B, C = np.zeros((n, n)), np.zeros((n, 1)), np.eye(2 * masses, n)
    A[:masses, masses : 2 * masses] = np.eye(masses)
    A[masses:-1, :masses], A[masses:-1, masses:-1] = (-np.linalg.solve(M, of) for of in (K, D))
    A[masses, -1], A[-1, -1], B[-1, 0] = np.sum(m) / m[0], -fast, fast
    return closed(A, B, C, masses, dt) if cascade else (A, B, C)


def closed(A, B, C, masses: int, dt: float):
    """The chain under a speed loop (PI) and a position loop (P) on the motor, from its reference.

    The loops are made slower until they are stable with some damping.
    """
    n, bandwidth = len(A), 2 * np.pi * 0.03 / dt
    while True:
        kp, ki, kv = bandwidth, bandwidth**2 / 4, bandwidth / 5
        speed, place = C[masses], C[0]
        error = -kv * place - speed  # of the speed, for a reference of 0
        closed_A = np.block([[A + B @ (kp * error)[None], ki * B], [error[None], np.zeros((1, 1))]])
        closed_B = np.vstack([kp * kv * B, [[kv]]])
        poles = np.linalg.eigvals(closed_A)
        if np.max(poles.real / np.abs(poles)) < -0.01:
            return closed_A, closed_B, np.hstack([C, np.zeros((len(C), 1))])
        bandwidth /= 1.5
        assert bandwidth > 1e-3 / dt, n


def excitation(rng, samples: int, dt: float):
    """The input and its kind."""
    kind = ("M-sequence", "multisine", "swept sine")[rng.integers(3)]
    t, top = np.arange(samples) * dt, 0.4 / dt
    if kind == "M-sequence":
        held = int(rng.integers(1, 4))
        return np.repeat(rng.choice([-1.0, 1.0], samples // held + 1), held)[:samples], kind
    if kind == "multisine":
        f = np.arange(1, int(top * samples * dt / 4)) * 4 / (samples * dt)
        phases = rng.uniform(0, 2 * np.pi, len(f))
        u = np.sum(np.cos(2 * np.pi * f * t[:, None] + phases), axis=1)
        return u / np.std(u), kind
    half = len(t) // 4
    one = scipy.signal.chirp(t[:half], 0.5, t[half], top, method="logarithmic")
    return np.resize(one, samples), kind


def main(drives: int = 40, first: int = 0) -> None:
    import output

    import jaxilc
    from jaxilc.identification import Record, grow

    jaxilc.setup()
    rows = []
    for seed in range(first, first + drives):
        one, began = drive(seed), time.process_time()
        record = Record(one.u[:, None], one.y[:, None], one.dt)
        model = grow(record)
        rows.append(
            {
                "seed": seed,
                "samples": len(one.u),
                "order": one.order,
                "found": model.chosen.order,
                "plant": type(model.found.plant).__name__,
                "true fit": one.true_fit,
                "fit": float(model.found.validation_fit[0]),
                "white": bool(model.found.white),
                "seconds": time.process_time() - began,
                "drive": one.said,
            }
        )
        print(rows[-1], flush=True)
    output.write_rows(output.folder(__file__) / "drives.csv", rows)
    near = sum(row["fit"] > row["true fit"] - 0.5 for row in rows)
    print(f"{near} of {len(rows)} within 0.5 % of the true model")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
