"""Designs of 50 random axes, judged by long simulation and against the best of a large grid.

An axis is a closed position loop of 8 to 60 Hz with a resonance of damping 0.01 to 0.15 three to
eight times above it, every third one with a zero in the right half-plane and every fourth one with
an actuator limit. Gain, loop and resonance are known to 3 to 20 %. The encoder has noise of 1e-6 to
1e-4 of the stroke; where both laws come within a tenth of that noise, they count as a tie. The
design tries the laws of a few weights, without one learned by its taps. It sees neither the
machines nor the trials by which it is judged: 256 new machines, 500 trials.

The first opponent is P-type learning with a lead and a Q-filter, the best of 378 laws (6 gains, 9
cutoffs, 7 leads) by simulation of 12 machines over 40 trials. The second is the
best of those of these laws that keep the margin of the design by their frequency response.

    python experiments/designs_judged.py [axes] [seed of the first axis]

An axis that is done is kept in out/experiments, so a run that was stopped goes on.
"""

import json
import shutil
import sys
import time
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import output

import jaxilc
from jaxilc import Actuator, Machine, Sensor, Sweep, Task, Uniform
from jaxilc.design import Design
from jaxilc.design.candidates import LAWS
from jaxilc.design.responses import designed_on, family_of
from jaxilc.filters import ZeroPhaseButterworth
from jaxilc.learning.over_trials import learn
from jaxilc.plants import ProcessModel
from jaxilc.runtime.start import keep_programs
from jaxilc.schemes import Filtered, PIDType
from jaxilc.signals.references import multisine, s_curve, sinusoid
from jaxilc.sweeps.summary import summarise
from jaxilc.theory.on_lines import low_pass
from jaxilc.uncertainty import draw, drawn_machines

DT, SAMPLES, TRIALS = 1e-3, 1000, 20
LONG, JUDGED_ON, JUDGES = 500, 256, 4711  # trials, machines and seed of the judgement
GAINS, CUTOFFS, LEADS = np.geomspace(0.1, 1.2, 6), np.geomspace(3, 300, 9), 7
GRID_ON, GRID_TRIALS = 12, 40
METRIC, MARGIN = "rms", 0.05


def axis(seed: int):
    """The machine, its task and its uncertainty."""
    rng = np.random.default_rng(seed)
    loop = 2 * np.pi * np.exp(rng.uniform(np.log(8), np.log(60)))
    ringing = loop * rng.uniform(3, 8)
    plant = ProcessModel(
        gain=rng.choice([-1, 1]) * np.exp(rng.uniform(-2, 2)),
        zeros=[loop * rng.uniform(2, 6)] if seed % 3 == 0 else [],
        frequencies=[loop, ringing],
        dampings=[rng.uniform(0.5, 1.2), np.exp(rng.uniform(np.log(0.01), np.log(0.15)))],
    )
    reference = [
        lambda: sinusoid(0.5, 2.0, duration=1.0, dt=DT, phase=-np.pi / 2, offset=0.5),
        lambda: s_curve([0.0, 1.0], velocity=8.0, acceleration=120.0, jerk=5e3, dt=DT),
        lambda: multisine([0.4, 0.2, 0.1], [1.0, 3.0, 7.0], duration=1.0, dt=DT),
    ][rng.integers(3)]()
    r = np.full(SAMPLES + 1, reference[-1])
    r[: min(len(reference), SAMPLES + 1)] = reference[: SAMPLES + 1]
    r = r - r[0]
    limit = Actuator(limit=4 / abs(float(plant.gain))) if seed % 4 == 0 else None
    noise = Sensor(noise=np.exp(rng.uniform(np.log(1e-6), np.log(1e-4))))
    uncertainty = {
        f"plant.{name}": Uniform(1 - width, 1 + width, relative=True)
        for name, width in (
            ("gain", rng.uniform(0.03, 0.2)),
            ("frequencies", rng.uniform(0.03, 0.2)),
            ("dampings", rng.uniform(0.03, 0.2)),
        )
    }
    return Machine(plant, limit, noise), Task(r, dt=DT, unit="mm"), uncertainty


@partial(jax.jit, static_argnames="lead")
def of_grid(machines, task, gains, lead):
    """(S, gains, cutoffs, J) errors of the laws of one lead."""

    def error(machine, gain, cutoff, key):
        scheme = Filtered(PIDType(gamma_p=gain, lead=lead), ZeroPhaseButterworth(cutoff))
        return jnp.max(learn(machine, scheme, task, GRID_TRIALS, key=key).metrics.rms, axis=-1)

    keys = jax.random.split(jax.random.key(3), GRID_ON)
    each = jax.vmap(jax.vmap(error, (None, None, 0, None)), (None, 0, None, None))
    return jax.lax.map(lambda one: each(one[0], gains, jnp.asarray(CUTOFFS), one[1]),
                       (machines, keys))  # fmt: skip


def best_of_grid(machine, task, uncertainty) -> dict[str, Filtered]:
    """The laws with the least 95 % error in trials 20 to 40: of all, and of those with a margin."""
    drawn = draw(machine, uncertainty, GRID_ON, seed=1, sampling="sobol")
    machines = drawn_machines(machine, uncertainty, drawn)
    family = family_of(designed_on(machine, uncertainty), None, task)
    Q = low_pass(family.frequencies, CUTOFFS[:, None], DT, 2)
    gains = GAINS / float(machine.plant.gain)
    delay = 1 / (float(machine.plant.frequencies[0]) * DT)  # samples of the loop, roughly
    found = []
    for lead in sorted({round(x) for x in np.linspace(0, 3 * delay, LEADS)}):
        errors = np.nan_to_num(np.asarray(of_grid(machines, task, gains, lead)), nan=np.inf)
        late = np.max(np.quantile(errors, 0.95, axis=0, method="higher")[..., TRIALS - 1 :], -1)
        for i, gain in enumerate(gains):
            largest = family.largest(Q, gain * family.advance(1 + lead, DT)[None])
            found += [
                (late[i, j], largest[j], gain, lead, cutoff) for j, cutoff in enumerate(CUTOFFS)
            ]
    opponents = {}
    for name, most in (("grid", np.inf), ("safe grid", 1 - MARGIN)):
        held = [law for law in found if law[1] <= most]
        if held:
            _, _, gain, lead, cutoff = min(held)
            scheme = Filtered(PIDType(gamma_p=gain, lead=lead), ZeroPhaseButterworth(cutoff))
            opponents[name] = scheme
    return opponents


def judged(seed: int, folder: Path) -> dict:
    """What became of one axis."""
    machine, task, uncertainty = axis(seed)
    start = time.perf_counter()
    shutil.rmtree(folder / "state", ignore_errors=True)
    asked = Design(
        machine, task, TRIALS, uncertainty, metric=METRIC, margin=MARGIN, machines=129,
        laws=tuple(LAWS),
    )  # fmt: skip
    found = asked.run(folder / "state")
    row = {"noise": float(machine.sensor.noise)}
    row |= {"axis": seed, "seconds": time.perf_counter() - start, "law": "", "margin": np.nan}
    row |= {"claims": "", "design 95 %": np.inf, "design diverges": False}
    start = time.perf_counter()
    schemes = best_of_grid(machine, task, uncertainty)
    row["seconds of the grid"] = time.perf_counter() - start
    row |= {"safe grid 95 %": np.inf, "safe grid diverges": False}
    if found.chosen:
        one = found.chosen
        schemes["design"] = one.verdict.candidate.scheme
        row |= {
            "law": one.verdict.candidate.name,
            "margin": one.proof.margin,
            "claims": "/".join(one.proof.claims),
        }
    sweep = Sweep(machine, schemes, task, LONG, uncertainty, machines=JUDGED_ON, seed=JUDGES)
    for summary in summarise(sweep.run(), None, metric=METRIC):
        late = summary.high[TRIALS - 1 :]
        row[f"{summary.scheme} 95 %"] = float(np.max(late))
        row[f"{summary.scheme} diverges"] = bool(
            summary.diverged > 0 or summary.worst[-1] > 2 * summary.worst[TRIALS - 1]
        )
    row["first error"] = float(summary.median[0])
    return row


def main(axes: int = 50, first: int = 0) -> None:
    jaxilc.setup()
    keep_programs()
    folder = output.folder(__file__)
    rows = []
    for seed in range(first, first + axes):
        kept = folder / f"axis-{seed}.json"
        if not kept.exists():
            kept.write_text(json.dumps(judged(seed, folder)))
            jax.clear_caches()  # the programs of some ten axes would use up the memory maps
        rows.append(json.loads(kept.read_text()))
        print(rows[-1], flush=True)
    recommended = [row for row in rows if row["law"]]
    for name in ("grid", "safe grid"):
        better = sum(
            row["design 95 %"] <= row[f"{name} 95 %"] or row[f"{name} diverges"]
            for row in recommended
        )
        print(f"{better} of these are at least as good as the best of the {name}")
    ties = sum(
        max(row["design 95 %"], row["grid 95 %"]) <= 1.1 * row["noise"] for row in recommended
    )
    print(f"{ties} of these are ties at the noise")
    ratios = [row["grid 95 %"] / row["design 95 %"] for row in recommended]
    print(f"error of the grid's best over that of the design: median {np.median(ratios):.3g}")
    shutil.rmtree(folder / "state", ignore_errors=True)
    output.write_rows(folder / "axes.csv", rows)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
