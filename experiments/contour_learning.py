"""Contour learning against independent axes: circle, rounded corner and butterfly.

Two axes of different bandwidth follow each path under three laws that are alike in all but the
error that they learn from: that of each axis by itself, the contour error beside it, and the
contour error in its place. 64 machines are drawn; the table has the contour error after a few
trials, its worst machine, and the share of machines within the tolerance. Rows are written to
out/experiments/contour_learning.
"""

import tempfile
from pathlib import Path

import numpy as np
from output import folder, write_rows

import jaxilc

jaxilc.setup()

from jaxilc import Sweep, Uniform, load_scenario, summarise  # noqa: E402
from jaxilc.filters import ZeroPhaseButterworth  # noqa: E402
from jaxilc.schemes import Filtered, NormOptimal, OnContour, PIDType, Scheme  # noqa: E402

MACHINES, SEED, TRIALS, TOLERANCE = 64, 5, 6, 0.002  # mm
PATHS = {
    "circle": 'path = "circle", radius = 10.0',
    "corner": 'path = "points", file = "corner.csv", join = "lines", corner = 0.05',
    "butterfly": 'path = "butterfly", width = 40.0',
}
FILE = """
[plant]
kind = "TwoAxes"
[plant.x]
kind = "transfer_function"
num = [15790.0]
den = [1.0, 176.0, 15790.0]
[plant.y]
kind = "transfer_function"
num = [48361.0]
den = [1.0, 352.0, 48361.0]

[task]
dt = 0.002
unit = "mm"
reference = { %s, feed = 80.0, acceleration = 2000.0, jerk = 1e5, rest = 0.1 }
"""
CORNER = "x,y\n0,0\n15,0\n15,10\n5,18\n0,0\n"


def laws(model) -> dict[str, Scheme]:
    """Each law by itself, and with the contour error beside and in place of that of the axes."""
    p_type = Filtered(PIDType(gamma_p=0.25, lead=3), ZeroPhaseButterworth(30.0))
    optimal = NormOptimal(model, w_r=2.0)
    found: dict[str, Scheme] = {}
    for name, law in {"P-type": p_type, "norm-optimal": optimal}.items():
        found[f"{name}, axes"] = law
        found[f"{name}, beside"] = OnContour(law, own=1.0, contour=1.0)
        found[f"{name}, in place"] = OnContour(law, own=0.0, contour=2.0)
    return found


def main() -> None:
    rows = []
    for path, words in PATHS.items():
        with tempfile.TemporaryDirectory() as place:
            Path(place, "corner.csv").write_text(CORNER)
            file = Path(place, "axes.toml")
            file.write_text(FILE % words)
            scenario = load_scenario(file)
        plant, task = scenario.machine.plant, scenario.task
        spread = {f"plant.{axis}.B": Uniform(0.9, 1.1, relative=True) for axis in ("x", "y")}
        sweep = Sweep(
            scenario.machine,
            laws(plant.continuous().sampled(task.dt)),
            task,
            TRIALS,
            spread,
            machines=MACHINES,
            seed=SEED,
            quantities={name: q.of for name, q in scenario.quantities.items()},
        )
        dataset = sweep.run()
        for row in summarise(dataset, tolerance=TOLERANCE, metric="contour_max"):
            of = dataset.sel(scheme=row.scheme)
            rows.append(
                {
                    "path": path,
                    "law": row.scheme,
                    "contour, first, um": 1e3 * float(row.median[0]),
                    "contour, last, um": 1e3 * float(row.median[-1]),
                    "worst, um": 1e3 * float(row.worst[-1]),
                    "yield": row.yield_share,
                    "axes rms, last, um": 1e3 * float(np.median(of["rms"][:, -1].max("channel"))),
                }
            )
    write_rows(folder(__file__) / "contours.csv", rows)


if __name__ == "__main__":
    main()
