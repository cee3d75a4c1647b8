"""Learned laws of matrices and of segments, tuned through learning and proved, on a gantry.

    python experiments/learned_channels.py

A gantry has two motors on one beam, each under a position loop of its own. What both do together
moves the beam, what they do against each other turns it, and both motions have other dynamics; so
each motor feels the other. The laws are

    alone           taps for each motor's own error (`coupled=False`)
    matrices        each motor learns from both errors
    ... scheduled   the same with taps of their own for the second half, in which the gantry cuts:
                    it moves less and faster
    norm-optimal    by the nominal model of both channels and a Q-filter, its weights by gradient

each by frequency response and tuned through learning. `LearnedLaw.run` proves each. Shown are
medians of the rms error over 33 machines that nobody has seen, of the worse channel in units of the
noise, and the figure of each law.
"""

import json
import sys
import time

import jax.numpy as jnp
import numpy as np
import output
from learned_families import Case, errors_of, relative

import jaxilc
from jaxilc import Machine, Sensor, Task, figures
from jaxilc.design.learned import LearnedLaw
from jaxilc.filters import ZeroPhaseButterworth
from jaxilc.plants import ProcessModel, StateSpace
from jaxilc.plants.plant import Plant
from jaxilc.pytree import child, pytree
from jaxilc.runtime.start import keep_programs
from jaxilc.schemes import Filtered, NormOptimal, Scheme
from jaxilc.theory.loop import minimal
from jaxilc.tuning import Tuning
from jaxilc.tuning.objectives import EveryTrial
from jaxilc.tuning.risks import CVaR

METRIC, MARGIN, SEED, JUDGES, NOISE = "rms", 0.05, 0, 4711, 1e-4
SAMPLES, TRIALS, LAST, SHOWN = 400, 10, 100, (2, 3, 5, 10, 100)
TUNED_ON, STEPS, JUDGED_ON = 8, 25, 33
TAPS = (31, 15)


@pytree
class Gantry(Plant):
    """y = x -+ phi of both sides, where x is moved by the mean of both inputs and phi by half their
    difference.

    beam, turn: from the mean to x, and from half the difference to phi
    """

    n_u = n_y = 2
    beam: Plant = child()
    turn: Plant = child()

    def sampled(self, dt: float) -> Plant:
        return Gantry(self.beam.sampled(dt), self.turn.sampled(dt))

    def initial_state(self):
        return self.beam.initial_state(), self.turn.initial_state()

    def step(self, x, u, dt: float):
        mean, half = (u[:1] + u[1:]) / 2, (u[1:] - u[:1]) / 2
        return self.beam.step(x[0], mean, dt), self.turn.step(x[1], half, dt)

    def output(self, x):
        middle, angle = self.beam.output(x[0]), self.turn.output(x[1])
        return jnp.concatenate([middle - angle, middle + angle])


def gantry() -> Case:
    beam = ProcessModel(1.0, frequencies=2 * np.pi * np.r_[45.0], dampings=[0.7])
    turn = ProcessModel(0.8, frequencies=2 * np.pi * np.r_[70.0], dampings=[0.15])
    spread = relative(frequencies_0=0.1)
    spread = {
        name.replace("plant.", f"plant.{part}."): of
        for part in ("beam", "turn")
        for name, of in spread.items()
    }
    t = np.arange(SAMPLES + 1) * 1e-3

    def during(start, end):
        return np.sin(np.pi * np.clip((t - start) / (end - start), 0, 1)) ** 2

    both = during(0.02, 0.2) * np.sin(2 * np.pi * 6 * t)
    cut = 0.1 * during(0.2, 0.38) * np.sin(2 * np.pi * 35 * t)
    level = 0.2 * during(0.02, 0.2) * np.sin(2 * np.pi * 9 * t)
    task = Task(np.stack([both + cut - level, both + cut + level], 1), dt=1e-3, unit="mm")
    machine = Machine(Gantry(beam, turn), None, Sensor(noise=NOISE))
    return Case(machine, task, spread, TRIALS, LAST, JUDGED_ON, tuned_on=TUNED_ON, steps=STEPS)


def learned(case: Case, folder):
    """Name, scheme and what was proved of each learned law, before and after its tuning."""
    for name, settings in {
        "alone": {"coupled": False, "steps": 0},
        "matrices": {"steps": case.steps},
        "matrices, scheduled": {"starts": (SAMPLES // 2,), "steps": case.steps},
    }.items():
        asked = LearnedLaw(
            case.machine, case.task, case.trials, case.uncertainty, metric=METRIC, margin=MARGIN,
            taps=TAPS, machines=9, seed=SEED, start="nothing", objective=EveryTrial(METRIC),
            trained_on=case.tuned_on, held_out=case.tuned_on, **settings,
        )  # fmt: skip
        began, state = time.perf_counter(), folder / name.replace(", ", "-")
        told_of: list[tuple] = []
        found = asked.run(
            state, resume=state.exists(), told=lambda *what, to=told_of: to.append(what)
        )
        yield f"{name}, by response", found.window.of(dict(told_of)["found"]), {}
        if found.law is None:
            print(f"  {name}: refused, {found.refused}", flush=True)
            continue
        proof = found.proof
        told = {
            "sup": proof.worst, "at [Hz]": proof.at, "claim": proof.claims[1],
            "way": found.passed.way, "seconds": round(time.perf_counter() - began),
        }  # fmt: skip
        figure = figures.learned_law_figure(found, float(case.task.dt), unit="mm/mm")
        figures.save(figure, folder / f"{state.name}.png")
        yield f"{name}, {'tuned' if asked.steps else 'passed'}", found.law.scheme, told


def norm_optimal(case: Case, folder) -> tuple[Scheme, dict]:
    """Norm-optimal learning by the nominal model of both channels, its weights by gradient."""
    family = case.family(SEED, several=True)
    model = StateSpace(*minimal(family.loops[0], case.task.N), dt=case.task.dt)
    start = Filtered(NormOptimal(model, w_r=0.1, w_s=1e-5), ZeroPhaseButterworth(100.0))
    bounds = {"scheme.w_r": (1e-3, 1e2), "scheme.w_s": (1e-9, 1e-1), "filter.cutoff": (20.0, 400.0)}
    state, began = folder / "norm-optimal", time.perf_counter()
    found = Tuning(
        case.machine, start, case.task, case.trials, bounds, case.uncertainty, EveryTrial(METRIC),
        CVaR(0.75), **case.budget(), seed=SEED,
    ).run(state, resume=state.exists())  # fmt: skip
    return found.scheme, {"seconds": round(time.perf_counter() - began)}


def row_of(case: Case, scheme: Scheme) -> dict:
    """Medians of the rms error of the worse channel, in units of the noise, and the worst one."""
    errors, lost = errors_of(case, scheme, METRIC, LAST, case.judged_on, JUDGES)
    errors = errors / NOISE
    row = {f"trial {j}": float(np.median(errors[:, j - 1])) for j in SHOWN}
    return row | {"worst, 100": float(np.max(errors[:, -1])), "lost": int(np.sum(lost.any(1)))}


def main() -> None:
    jaxilc.setup()
    keep_programs()
    case, folder = gantry(), output.folder(__file__)
    rows = {}
    for law, scheme, told in learned(case, folder):
        rows[law] = row_of(case, scheme) | told
        print(law, rows[law], flush=True)
    scheme, told = norm_optimal(case, folder)
    rows["norm-optimal, tuned"] = row_of(case, scheme) | told
    print("norm-optimal, tuned", rows["norm-optimal, tuned"], flush=True)
    (folder / "rows.json").write_text(json.dumps(rows))


if __name__ == "__main__":
    main(*sys.argv[1:])
