"""`demo`: a law that looks good and diverges, the certificate that knew, and a law that is tuned.

The machine is made up: a position loop of 10 Hz on a soft frame that swings at 60 Hz, whose gain is
known to 10 %. It is small enough that the whole story takes half a minute.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

from .. import figures, theory
from ..filters import ZeroPhaseButterworth
from ..learning import Machine, learn
from ..plants import ProcessModel
from ..schemes import Filtered, PIDType
from ..signals.task import Task
from ..sweeps import Sweep, summarise
from ..tuning import Tuning
from ..uncertainty import Uniform
from .outcome import Figure, Numbers, Outcome, Progress, Table, Verdict, silent
from .words import number

MACHINE = Machine(ProcessModel(1.0, (), (), (63.0, 380.0), (0.6, 0.02)))
UNCERTAIN = {"plant.gain": Uniform(0.9, 1.1, relative=True)}
PLAIN = PIDType(gamma_p=0.8, lead=20)
FILTERED = Filtered(PIDType(gamma_p=0.2, lead=20), ZeroPhaseButterworth(cutoff=15.0, order=2))
WEIGHTS = {"scheme.gamma_p": (0.05, 1.5), "filter.cutoff": (5.0, 100.0)}
MACHINES, TRIALS, STEPS, TUNED_AT = 1000, 60, 30, 12
METRIC, TOLERANCE = "rms", 0.01  # [mm]
UM = 1e3  # per mm


def task() -> Task:
    """A stroke of 10 mm forth and back in 0.4 s."""
    t = np.arange(401) / 400
    return Task(10 * np.sin(np.pi * t) ** 2, dt=1e-3, unit="mm", input_unit="mm")


def demo(folder: str | Path | None = None, *, progress: Progress = silent) -> Outcome:
    """What this package is for, in half a minute: the story in sentences, numbers and a figure.

    folder: for the figure; out/demo if not given
    """
    motion = task()
    progress("a law learns", 0, 4)
    rms = np.asarray(learn(MACHINE, PLAIN, motion, trials=TRIALS).rms)[:, 0]
    best = int(np.argmin(rms))
    progress("what theory claims", 1, 4)
    before = theory.certify(MACHINE, PLAIN, motion, trials=TRIALS)
    progress("tuning by gradient", 2, 4)
    tuning = Tuning(
        MACHINE, FILTERED, motion, TUNED_AT, WEIGHTS, UNCERTAIN,
        machines=4, held_out=4, steps=STEPS,
    )  # fmt: skip
    tuned = tuning.run()
    gamma, cutoff = (float(tuned.values[name]) for name in WEIGHTS)
    after = theory.certify(MACHINE, tuned.scheme, motion, trials=TRIALS)
    progress("a thousand machines", 3, 4)
    laws = {"plain": PLAIN, "tuned": tuned.scheme}
    sweep = Sweep(MACHINE, laws, motion, TRIALS, uncertainty=UNCERTAIN, machines=MACHINES)
    dataset = sweep.run()
    rows = {row.scheme: row for row in summarise(dataset, tolerance=TOLERANCE, metric=METRIC)}
    worst = {name: float(row.worst[-1]) for name, row in rows.items()}
    share = {name: float(row.yield_share) for name, row in rows.items()}
    columns = ("law", "claim of theory", "worst rms error [µm]", f"within {UM * TOLERANCE:g} µm")
    title = f"{MACHINES} machines whose gain differs by 10 %, after {TRIALS} trials"
    turning = int(before.turning[0])
    claims = {"plain": str(before.claim[0]), "tuned": str(after.claim[0])}
    cells = [(n, c, number(UM * worst[n]), f"{share[n]:.0%}") for n, c in claims.items()]
    draw = partial(
        figures.error_band, dataset, metric=METRIC, tolerance=TOLERANCE, scale=UM, unit="µm"
    )
    numbers: Numbers = {
        "rms": rms.tolist(), "best_trial": best + 1, "turning": turning, "claims": claims,
        "weights": tuned.values, "worst": worst, "yield": share,
    }  # fmt: skip
    return Outcome(
        command="demo",
        numbers=numbers,
        verdict=Verdict(
            (
                "A feed axis repeats a stroke of 10 mm. The law "
                f"u' = u + {PLAIN.gamma_p:g} e looks good: the rms error falls from "
                f"{number(rms[0])} mm to {number(UM * rms[best])} µm in trial {best + 1}. In trial "
                f"{TRIALS} it is {number(rms[-1])} mm, since it grows at 60 Hz, where the frame "
                "swings.",
                f'Theory knew before the first trial: "{claims["plain"]}", with the best trial '
                f"about trial {turning}.",
                "With a filter, and gain and cutoff tuned by the gradient through "
                f"{TUNED_AT} trials ({number(gamma)} and {number(cutoff)} Hz), theory claims "
                f'"{claims["tuned"]}", and {share["tuned"]:.0%} of {MACHINES} uncertain machines '
                f"end within {UM * TOLERANCE:g} µm rms; under the plain law {share['plain']:.0%}.",
            ),
            "the same for a machine of your own",
            "jaxilc init axis.toml",
        ),
        folder=Path(folder or "out/demo"),
        tables=[Table(right=columns, title=title, rows=cells)],
        figures={
            "demo": Figure(
                "The error by trial of both laws on a thousand machines: median and quantiles.",
                draw,
            )
        },
    )
