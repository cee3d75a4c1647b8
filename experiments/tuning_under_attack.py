"""The slopes of the losses of a tuning, against differences of the losses.

Every objective with every risk, forward and in reverse, of random weights of five schemes over six
machines that differ in their plant. The slopes of the losses of all machines, and of their risk,
along a random direction are compared with the differences on both sides. Where these differ, the
loss has a kink between them, as the worst machine or the largest error changes; there the slope
may be any between the two.
"""

import dataclasses
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import output

import jaxilc
from jaxilc.pytree import named_leaves
from jaxilc.tuning import Tuning
from jaxilc.tuning.objectives import (
    Contraction,
    Effort,
    EveryTrial,
    Final,
    Growth,
    Holding,
    InputRate,
    TrialsTo,
)
from jaxilc.tuning.risks import CVaR, Mean, SmoothMax, Worst
from jaxilc.uncertainty import Uniform

OBJECTIVES = {
    "Final": Final(),
    "Final, trial 2": Final("rms", trial=2),
    "EveryTrial": EveryTrial("max_error"),
    "Holding": Holding(2, "rms"),
    "TrialsTo": TrialsTo(0.3, "rms"),
    "Growth": Growth("max_error", floor=0.1),
    "Effort": Effort(2.0),
    "InputRate": InputRate(50.0),
    "Contraction": Contraction(0.05, steps=40) + Final(),
    "sum": Final() + 0.3 * EveryTrial("rms") + 0.1 * Growth("rms") + 0.1 * Effort(2.0),
}
RISKS = {"Mean": Mean(), "CVaR": CVaR(0.55), "Worst": Worst(), "SmoothMax": SmoothMax(0.3)}
# weights of cases of tests/cases.py, with their bounds
SCHEMES = {
    "cfdl_smooth": dict.fromkeys(("phi0", "lam", "rho")),
    "pid_type_leaky_limited": dict.fromkeys(("gamma_p", "gamma_i", "gamma_d", "leak")),
    "p_type_butterworth": {"scheme.gamma_p": None, "filter.cutoff": (10.0, 300.0)},
    "p_type_over_pid": dict.fromkeys(("learning.gamma_p", "feedback.kp", "feedback.ki")),
    "norm_optimal_lifted": {"w_q": (0.3, 3.0), "w_r": (0.01, 0.2), "w_s": (0.002, 0.05)},
}
POINTS, TRIALS, H, DIGITS = 6, 3, 1e-6, 2e-5


def problem_of(name: str, mode: str) -> Tuning:
    from cases import case

    machine, scheme, task = case(name)
    floats = [n for n, x in named_leaves(machine.plant).items() if np.ndim(x) and np.all(x)]
    differs = {f"plant.{floats[-1]}": Uniform(0.8, 1.2, relative=True)}
    return Tuning(
        machine,
        scheme,
        task,
        TRIALS,
        SCHEMES[name],
        differs,
        machines=6,
        held_out=0,
        mode=mode,
        clip=np.inf,
        steps=1,
    )


def compared(problem: Tuning, objective, points: int, seed: int = 38) -> dict:
    """{each machine, each risk: (slopes, left, right)} along random directions at random points."""
    evaluate = jax.jit(dataclasses.replace(problem, objective=objective).evaluation[0])
    rng = np.random.default_rng(seed)
    start = np.asarray(problem._weights.starts(1, 0.0, 0)[0])
    found = {name: [] for name in ("each machine", *RISKS)}
    for _ in range(points):
        z = start + 0.4 * rng.standard_normal(len(start))
        d = rng.standard_normal(len(z))
        at, after, before = (evaluate(jnp.asarray(x)) for x in (z, z + H * d, z - H * d))
        root = problem.machines**0.5
        now, above, below = (np.asarray(one.residuals) * root for one in (at, after, before))
        slopes = np.asarray(at.slopes) * root @ d
        right, left = (above - now) / H, (now - below) / H
        found["each machine"] += list(zip(slopes, left, right, strict=True))
        each = slice(problem.machines)  # and not the nominal term, which comes last
        for name, risk in RISKS.items():
            here, there, back = (float(risk(jnp.asarray(x[each]))) for x in (now, above, below))
            slope = float(risk.weights(jnp.asarray(now[each])) @ slopes[each])
            found[name].append((slope, (here - back) / H, (there - here) / H))
        found["Mean"][-1] = (
            float(at.gradient @ d),
            float(at.value - before.value) / H,
            float(after.value - at.value) / H,
        )
    return {name: np.array(rows).T for name, rows in found.items()}


def wrong(slopes, left, right) -> np.ndarray:
    """Whether a slope is neither near the differences nor between two that differ."""
    room = DIGITS * np.maximum(1.0, np.maximum(np.abs(left), np.abs(right)))
    return ~(
        (slopes >= np.minimum(left, right) - room) & (slopes <= np.maximum(left, right) + room)
    )


def kinks(left, right) -> np.ndarray:
    return np.abs(left - right) > DIGITS * np.maximum(1.0, np.maximum(np.abs(left), np.abs(right)))


def main(names: list[str]) -> None:
    rows = []
    for name in output.asked(names, SCHEMES):
        for mode in ("forward", "reverse"):
            start, problem = time.perf_counter(), problem_of(name, mode)
            for title, objective in OBJECTIVES.items():
                try:
                    found = compared(problem, objective, POINTS)
                except ValueError as error:
                    print(f"{name}, {title}: {error}")
                    continue
                row = {"scheme": name, "mode": mode, "objective": title}
                print(row, f"{time.perf_counter() - start:.0f} s", flush=True)
                for risk, (slopes, left, right) in found.items():
                    rows.append(
                        row
                        | {
                            "risk": risk,
                            "tried": len(slopes),
                            "kinks": int(np.sum(kinks(left, right))),
                            "zero": int(np.sum((slopes == 0) & (left == 0))),
                            "wrong": int(np.sum(wrong(slopes, left, right))),
                        }
                    )
                    if rows[-1]["wrong"]:
                        at = np.flatnonzero(wrong(slopes, left, right))
                        print("   WRONG", rows[-1], slopes[at], left[at], right[at], flush=True)
            total = {
                k: sum(r[k] for r in rows if r["scheme"] == name and r["mode"] == mode)
                for k in ("tried", "kinks", "zero", "wrong")
            }
            print(name, mode, total, f"{time.perf_counter() - start:.0f} s", flush=True)
    output.write_rows(output.folder(__file__) / "rows.csv", rows)


if __name__ == "__main__":
    jaxilc.setup()
    sys.path.append(str(Path(__file__).parents[1] / "tests"))
    main(sys.argv[1:])
