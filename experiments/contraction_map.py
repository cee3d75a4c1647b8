"""Where d2 of Cao 2019 is exact, careful, or silent: a map of the plant's lag and of lam.

The plant is y(k+1) = a y(k) + u(k), static for a = 0. On each point CFDL-MFAILC learns a step that
was smoothed, and its contraction is observed. Beside it stand d2 from the plant and the largest
singular value of the frozen law's map of errors. The start of the estimate is phi = 1, so that
nothing has to adapt, and d2 is the spectral radius of that map. The numbers mu and epsilon of the
estimator are those of the plant with a gain of 1 at rest, whose input is 1 - a times as large.

The rows count the points by whether the bound is claimed, whether d2 and sigma_max are below 1, and
whether the error grew in some trial.
"""

import numpy as np
import output

import jaxilc
from jaxilc import Machine, Sweep, Task, figures
from jaxilc.plants import DifferenceEquation
from jaxilc.schemes import CFDLMFAILC
from jaxilc.theory import BoundsWatch

N, TRIALS, POINTS = 60, 40, 24
TASK = Task(reference=0.5 - 0.5 * np.cos(np.pi * np.minimum(np.arange(N + 1) / 20, 1.0)), dt=1e-3)
LAW = CFDLMFAILC(rho=1.0, eta=0.5, mu=1.0, phi0=1.0, reset="sign")
LAG, WEIGHT = np.linspace(0.0, 0.95, POINTS), np.geomspace(1e-3, 10.0, POINTS)


def main() -> None:
    jaxilc.setup()
    folder = output.folder(__file__)
    lag = ("machine.plant.a[0]", "cfdl.mu", "cfdl.epsilon")
    sweep = Sweep(
        Machine(DifferenceEquation([0.5], [1.0], dt=TASK.dt)),
        {"cfdl": LAW},
        TASK,
        TRIALS,
        uncertainty={},
        machines=1,
        watch=BoundsWatch(sigma_steps=N),
        grid={lag: [LAG, (1 - LAG) ** 2, float(LAW.epsilon) * (1 - LAG)], "cfdl.lam": WEIGHT},
    )
    dataset = sweep.run()
    found = dataset.isel(scheme=0, sample=0)
    claimed, later = (found["claimed"] == 1).values, found.isel(trial=slice(1, None))
    grew = (later["contraction_norm"].max("trial") > 1 + 1e-9).values
    kept = later["share_kept"].min("trial").values
    assert np.all(kept[claimed] == 1), "a bound that was claimed did not hold"
    d2, sigma_max = (found[name].values for name in ("d2", "sigma_max"))
    rows = []
    for name, where in {
        "claimed": claimed,
        "d2 < 1, not claimed": (d2 < 1) & ~claimed,
        "d2 < 1, sigma_max > 1": (d2 < 1) & (sigma_max > 1),
        "sigma_max < 1": sigma_max < 1,
        "all": np.ones_like(claimed),
    }.items():
        rows.append({"points": name, "number": int(where.sum()), "grew": int(grew[where].sum())})
    output.write_rows(folder / "points.csv", rows)
    figures.save(figures.contraction_map(dataset), folder / "map.png")


if __name__ == "__main__":
    main()
