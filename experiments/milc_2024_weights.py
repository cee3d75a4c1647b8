"""MILC 2024: w_q, w_r and w_s tuned by gradients through learning and the Riccati recursion.

Stiffness and table mass are uncertain.
"""

import dataclasses
from functools import partial

import numpy as np
import output

import jaxilc
from jaxilc.tuning import Tuning
from jaxilc.tuning.objectives import EveryTrial, Final
from jaxilc.uncertainty import Uniform

TRIALS = 6
BOUNDS = {"w_q": (1e3, 1e10), "w_r": (1e-8, 1e3), "w_s": (1e-6, 1e4)}


def problem(s, name: str) -> Tuning:
    """The tuning problem of the scheme `dilc` or `milc` of a scenario."""
    scheme, path = s.schemes[name], "learning.scheme." if name == "dilc" else "learning."
    # The penalty on the learned reference gets its own weight, since the printed weight also pulls
    # the whole reference towards zero.
    if name == "milc":
        scheme = dataclasses.replace(
            scheme,
            learning=dataclasses.replace(scheme.learning, w_s=np.full(2, scheme.learning.w_s)),
        )
    weights = {f"{path}{w}": bounds for w, bounds in BOUNDS.items()}
    uncertainty = {
        f"plant.{leaf}": Uniform(0.8, 1.2, relative=True) for leaf in ("stiffness", "table_mass")
    }
    options = {"machines": 16, "held_out": 16, "steps": 60, "rate": 0.3, "quantities": s.functions}
    return Tuning(
        s.machine,
        scheme,
        s.task,
        TRIALS,
        weights,
        uncertainty,
        EveryTrial("table_rms") + Final("table_rms"),
        **options,
    )


def problem_of(name: str):
    """The function `problem` of one scheme, with the scenario as its only argument."""
    return partial(problem, name=name)


def main() -> None:
    folder = output.folder(__file__)
    s = jaxilc.scenarios.load("milc-2024", reading="long-stroke")
    rows, axes = [], output.axes(1, 2, size=(10.0, 4.0))
    for ax, name in zip(axes, ("dilc", "milc"), strict=True):
        of = problem(s, name)
        tuned = of.run()
        table = 1e3 * of.compare(tuned, machines=64)["table_rms"]
        for which in table["scheme"].values:
            median, worst = (
                getattr(table.sel(scheme=which), how)("sample").values for how in ("median", "max")
            )
            ax.semilogy(np.arange(1, TRIALS + 1), median, label=f"{which}: median")
            ax.semilogy(np.arange(1, TRIALS + 1), worst, "--", label=f"{which}: worst")
            row = {
                "scheme": name,
                "weights": which,
                "loss": tuned.before if which == "given" else tuned.after,
            }
            row |= {f"median {j}": float(median[j - 1]) for j in (2, 3, TRIALS)} | {
                f"worst {TRIALS}": float(worst[-1])
            }
            rows.append(row | (tuned.start if which == "given" else tuned.values))
        ax.set(title=f"{name}: 64 drives never seen", xlabel="trial", ylabel="table RMS [µm]")
    output.save(axes, folder / "tuned.png", fontsize="small")
    for row in rows:
        print(
            "  ".join(
                f"{k} {v:.4g}" if isinstance(v, float) else f"{k} {v}" for k, v in row.items()
            )
        )
    noise, step = float(s.machine.sensor.noise[1]), float(s.machine.sensor.resolution[1])
    floor = 1e3 * np.sqrt(noise**2 + step**2 / 12)
    print(
        f"the table's encoder alone, its noise and step, measures {floor:.4f} µm RMS: no weights "
        "get below"
    )
    for row in rows:
        excess = np.sqrt(row[f"median {TRIALS}"] ** 2 - floor**2)
        print(
            f"{row['scheme']}, {row['weights']}: {excess:.3f} µm RMS beyond the encoder's floor "
            f"at trial {TRIALS}"
        )


if __name__ == "__main__":
    jaxilc.setup()
    main()
