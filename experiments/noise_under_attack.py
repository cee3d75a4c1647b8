"""What noise, scatter and drift leave, by theory, against trials that NumPy draws by itself.

Random machines of `certificates_under_attack` learn under eight laws. Their sensors, outputs and
inputs have noise, the start scatters, the plant drifts for fifty trials, or several of these; of
some, samples are lost too. Each machine runs in 400 seeds of 1200 trials, by matrices that NumPy
and SciPy make from the equations. Of a machine whose mean has settled by then, a claim is
contradicted

    by its quantile: where so many of the 400 last trials are above what 95 % are to stay below that
        it would happen with a chance of 1e-4 if 5 % did
    by its mean square: where nothing is lost, and the mean of the 400 squares is six standard
        errors from what theory says

The care of a quantile is its ratio to that of the 400 last trials.
"""

import sys
from collections import Counter

import jax
import numpy as np
import output
import scipy.stats
from certificates_under_attack import DT, SAMPLES, laws, matrices, plants
from chance_under_attack import LAWS
from conditions_under_attack import lifted

import jaxilc
from jaxilc import Disturbance, Machine, Sensor, Task
from jaxilc.learning.variation import PlantChange, Variation
from jaxilc.plants import StateSpace
from jaxilc.theory import certify_each

SEEDS, TRIALS, LATE = 400, 1200, 50
FIRST, OVER = 5, 50  # of a drift
KINDS = {
    "sensor": ("of_sensor",),
    "input": ("of_input",),
    "output": ("of_output",),
    "scatter": ("scatter",),
    "drift-sensor": ("of_sensor", "after"),
    "all": ("of_sensor", "of_input", "of_output", "scatter", "after"),
    "lost-sensor": ("of_sensor", "dropped"),
}
TOO_MANY = scipy.stats.binom.isf(1e-4, SEEDS, 0.05)


def sizes_of(rng, kind: str) -> dict:
    """Standard deviations, the gain after a drift and the chance to be lost; neutral if absent."""
    drawn = dict(
        zip(("of_sensor", "of_input", "of_output"), 10 ** rng.uniform(-3, 0, 3), strict=True)
    )
    drawn |= {"scatter": 10 ** rng.uniform(-3, 0), "after": rng.uniform(0.7, 1.3)}
    drawn |= {"dropped": rng.uniform(0.02, 0.4)}
    neutral = {"after": 1.0}
    return {name: x if name in KINDS[kind] else neutral.get(name, 0.0) for name, x in drawn.items()}


def machine_of(A, B, C, d, of: dict) -> Machine:
    plant = StateSpace(A, B, C, dt=DT)
    change = PlantChange(StateSpace(A, B, C * of["after"], dt=DT), first=FIRST, over=OVER)
    drawn = {"scatter": of["scatter"] or None, "dropped": of["dropped"] or None}
    drawn |= {"change": change} if of["after"] != 1 else {}
    varies = any(value is not None for value in drawn.values())
    noise = {"input_noise": of["of_input"] or None, "output_noise": of["of_output"] or None}
    return Machine(
        plant,
        sensor=Sensor(noise=of["of_sensor"]) if of["of_sensor"] else None,
        disturbance=Disturbance(output=d, **noise),
        variation=Variation(**drawn) if varies else None,
    )


def runs_of(rng, plant, d, r, keep, L, of: dict):
    """(SEEDS,) mean squares of the last errors, and by how much their mean moved at the end."""
    A, B, C = plant
    G, seen, x = lifted(A, B, C, SAMPLES), [], C
    for _ in range(SAMPLES + 1):
        seen.append(x)
        x = x @ A
    seen = np.concatenate(seen)  # of the start, in every sample
    u, mean, before = np.zeros((SEEDS, SAMPLES)), np.zeros(SAMPLES), np.inf
    for j in range(1, TRIALS + 1):
        gain = 1 + np.clip((j - FIRST + 1) / OVER, 0, 1) * (of["after"] - 1)
        y = of["scatter"] * rng.standard_normal((SEEDS, len(A))) @ seen.T
        y[:, 1:] += (u + of["of_input"] * rng.standard_normal(u.shape)) @ G.T
        y = gain * y + d + of["of_output"] * rng.standard_normal(y.shape)
        e = (r - y - of["of_sensor"] * rng.standard_normal(y.shape))[:, 1:]
        kept = rng.random(e.shape) >= of["dropped"]
        still = (r - d)[1:] - gain * G @ mean
        if j == TRIALS - LATE:
            before = still
        u = u @ keep.T + (kept * e) @ L.T
        mean = keep @ mean + L @ ((1 - of["dropped"]) * still)
    return np.mean(e**2, axis=1), np.linalg.norm(still - before) / np.sqrt(SAMPLES)


def main(machines: int, kinds: list[str]) -> None:
    jaxilc.setup()
    rng, oracles = np.random.default_rng(3838), matrices()
    each = -(-machines // (len(LAWS) * len(kinds)))
    r = np.sin(np.pi * np.arange(SAMPLES + 1) / SAMPLES) ** 2
    task, rows, wrong, care = Task(r[:, None], dt=DT), [], [], {}
    for law in LAWS:
        keep, L, _ = oracles[law]
        for kind in kinds:
            some = list(zip(*plants(rng, each, 1), strict=True))
            d, of = (
                0.1 * rng.standard_normal((each, SAMPLES + 1, 1)),
                [sizes_of(rng, kind) for _ in range(each)],
            )
            several = [machine_of(*one, d[i], of[i]) for i, one in enumerate(some)]
            stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *several)
            found = certify_each(stacked, laws(1)[law], task, 20)
            count = Counter({"contradicted by its own runs": len(found.broken_promises())})
            for i in range(each):
                if not np.isfinite(found.most[i]):
                    count["no quantile"] += 1
                    continue
                squares, moved = runs_of(rng, some[i], d[i, :, 0], r, keep, L, of[i])
                if not moved < 1e-6 * found.left[i]:
                    count["not settled"] += 1
                    continue
                count["tried"] += 1
                above = int(np.sum(squares > found.most[i] ** 2))
                count["last trials above"] += above
                of_kind = "lost" if of[i]["dropped"] else "gaussian"
                care.setdefault(of_kind, []).append(
                    found.most[i] / np.sqrt(np.quantile(squares, 0.95))
                )
                apart = abs(np.mean(squares) - found.left[i] ** 2)
                far = apart > 6 * np.std(squares) / np.sqrt(SEEDS) and of_kind == "gaussian"
                if above > TOO_MANY or far:
                    wrong.append((law, kind, above, apart, found.left[i], of[i]))
                    print(wrong[-1], found.reason[i], flush=True)
            rows.append({"law": law, "kind": kind, "machines": each} | dict(count))
            print(rows[-1], flush=True)
    rows = output.filled(rows)
    output.write_rows(output.folder(__file__) / "noise.csv", rows)
    print(f"{output.sums(rows)}; contradicted: {len(wrong)}")
    for name, ratios in care.items():
        print(f"care, {name}: {np.quantile(ratios, (0, 0.5, 0.9, 1))} (least, median, 90 %, most)")


if __name__ == "__main__":
    machines = int(sys.argv[1]) if len(sys.argv) > 1 else 504
    main(machines, output.asked(sys.argv[2:], KINDS))
