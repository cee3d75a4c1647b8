"""Is what is not linear in a drive named rightly? Random drives of NumPy, one fault each.

A drive is one mass on a spring and a damper that its input pulls (a closed position loop), or two
masses with a soft shaft between. It moves by a multisine of twelve lines, with noise or with
rounding. One thing is not linear, or nothing is:

    friction           Coulomb's force, smooth within a small speed
    backlash           the input moves the spring through a gap
    gain by amplitude  u - c u^3
    saturation         the input acts up to a level
    gain by position   u (1 + c y)
    gain by time       the gain rises over the record
    rounding           the encoder is coarse

`grow` is asked with no word of what was done. A row tells how often the first suspicion is the
right one, how often another one, and how often nothing is suspected.

    python experiments/not_linear_named.py [drives of each kind] [seed]
"""

import sys
import time

import numpy as np
import scipy
from output import folder, write_rows

import jaxilc
from jaxilc.identification import Record, grow

DT, N, FINE = 1e-3, 6000, 5
KINDS = ("linear", "friction", "backlash", "gain by amplitude", "saturation", "gain by position",
         "gain by time", "rounding")  # fmt: skip


def excitation(rng) -> np.ndarray:
    """(N,) a multisine of twelve lines up to 30 Hz, of amplitude 1."""
    t, f = np.arange(N) * DT, rng.uniform(0.5, 30.0, 12)
    size, phase = rng.uniform(0.3, 1.0, 12) / np.sqrt(1 + f / 5), rng.uniform(0, 2 * np.pi, 12)
    u = size @ np.sin(2 * np.pi * f[:, None] * t + phase[:, None])
    return u / np.max(np.abs(u))


def moved(kind: str, u: np.ndarray, rng) -> np.ndarray:
    """(N,) the recorded position of a random drive that has one thing that is not linear."""
    w, zeta, strong = 2 * np.pi * rng.uniform(8, 25), rng.uniform(0.2, 0.8), rng.uniform(0.6, 1.6)
    A, B = np.array([[0, 1], [-w * w, -2 * zeta * w]]), np.array([0, w * w])
    if rng.random() < 0.5:  # a second mass, which the encoder sees, on a soft shaft
        v, z, share = (
            2 * np.pi * rng.uniform(50, 90),
            rng.uniform(0.01, 0.05),
            rng.uniform(0.2, 0.6),
        )
        shaft = np.array([v * v, 2 * z * v])
        back = share * np.concatenate([shaft, -shaft])
        A = np.block([[A, np.zeros((2, 2))], [np.zeros((2, 2)), np.array([[0, 1], -shaft])]])
        A[1] -= back
        A[3, :2] = shaft
        B = np.append(B, [0, 0])
    held = scipy.linalg.expm(np.block([[A, B[:, None]], [np.zeros((1, len(A) + 1))]]) * DT / FINE)
    A_d, B_d = held[:-1, :-1], held[:-1, -1]
    x, gap, y = np.zeros(len(A)), 0.0, np.zeros(N)
    for k in range(N):
        acting = u[k]
        if kind == "gain by amplitude":
            acting -= 0.2 * strong * acting**3
        elif kind == "saturation":
            acting = np.clip(acting, -0.65 / strong**0.3, 0.65 / strong**0.3)
        elif kind == "backlash":
            gap = acting = np.clip(gap, acting - 0.03 * strong, acting + 0.03 * strong)
        elif kind == "gain by time":
            acting *= 1 + 0.15 * strong * (k / N - 0.5)
        elif kind == "gain by position":
            acting *= 1 + 0.2 * strong * x[-2]
        y[k] = x[-2]
        for _ in range(FINE):
            rub = 0.05 * strong * np.tanh(x[1] / 0.05) if kind == "friction" else 0.0
            x = A_d @ x + B_d * (acting - rub)
    if kind == "rounding":
        return np.round(y / 0.02) * 0.02
    return y + rng.uniform(3e-4, 3e-3) * rng.standard_normal(N)


def main() -> None:
    count, seed = (int(word) for word in [*sys.argv[1:], "10", "0"][:2])
    jaxilc.setup()
    rows, began = [], time.process_time()
    for kind in KINDS:
        right = other = silent = 0
        names, orders = [], []
        for i in range(count):
            rng = np.random.default_rng([seed, KINDS.index(kind), i])
            u = excitation(rng)
            grown = grow(Record(u[:-1, None], moved(kind, u, rng)[:, None], DT))
            told = [one.name for one in grown.suspicions]
            orders.append(grown.chosen.order)
            silent += not told
            right += told[:1] == [kind]
            other += bool(told) and told[0] != kind
            names += [name for name in told[:1] if name != kind]
        rows.append(
            {"kind": kind, "drives": count, "named": right, "another": other, "silent": silent,
             "taken_for": " ".join(names), "median_order": float(np.median(orders))}
        )  # fmt: skip
        print(rows[-1], f"{time.process_time() - began:.0f} s of processor", flush=True)
    write_rows(folder(__file__) / "named.csv", rows)


if __name__ == "__main__":
    main()
