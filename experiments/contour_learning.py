"""Cross-coupled learning against independent axes: circle, square with rounded corners, butterfly.

The axes of a table have position loops of 12 and 7 Hz, whose gains and frequencies are known to 5
and 10 %, and encoder noise of 0.2 um. All laws are P-type learning of both axes with a lead and a
robustness filter. By gradient on 16 machines, each with as many steps, are tuned

    tracking    gains and cutoff, for the errors of the axes
    contour     gains and cutoff, for the contour error
    coupled     the weights own and contour of `CrossCoupled` too, for the contour error

They are judged on 128 machines that no tuning has seen.

    python experiments/contour_learning.py [circle] [square] [butterfly]
"""

import sys

import numpy as np
import output

import jaxilc
from jaxilc import Machine, Sensor, Sweep, Task, Tuning, Uniform
from jaxilc.filters import ZeroPhaseButterworth
from jaxilc.learning.quantities import contour_metrics
from jaxilc.plants import ProcessModel, TwoAxes
from jaxilc.schemes import CrossCoupled, Filtered, PIDType
from jaxilc.signals.gcode import read_gcode
from jaxilc.signals.paths import butterfly, circle, plan
from jaxilc.signals.tool_path import follow
from jaxilc.tuning.objectives import EveryTrial, Holding

DT, TRIALS, LONG = 2e-3, 10, 100
LIMITS = {"acceleration": 1500.0, "jerk": 6e4}
STEPS, TUNED_ON, JUDGED_ON = 20, 16, 128
SQUARE = "G1 X10 Y0 F3000\nY10\nX0\nY0\n"


def paths(names: list[str]) -> dict[str, np.ndarray]:
    """The references of these names, all of them for no names."""
    found = {
        "circle": plan(circle(5.0), (0.0, 2 * np.pi), feed=50.0, dt=DT, **LIMITS).reference,
        "square": follow(read_gcode(SQUARE, "xy"), corner=0.2, dt=DT, **LIMITS).reference,
        "butterfly": plan(butterfly(20.0), (0.0, 1.0), feed=50.0, dt=DT, **LIMITS).reference,
    }
    rest = ((0, 50), (0, 0))
    wanted = output.asked(names, found)
    return {name: np.pad(found[name] - found[name][0], rest, mode="edge") for name in wanted}


def machine() -> Machine:
    axes = [
        ProcessModel(1.0, frequencies=[2 * np.pi * f], dampings=[d])
        for f, d in ((12.0, 0.7), (7.0, 0.6))
    ]
    return Machine(TwoAxes(*axes), sensor=Sensor(noise=2e-4))


UNCERTAINTY = {
    f"plant.{axis}.{name}": Uniform(1 - width, 1 + width, relative=True)
    for axis in ("x", "y")
    for name, width in (("gain", 0.05), ("frequencies", 0.1))
}


def tuned(task: Task, *, coupled: bool, of: str):
    """A law with tuned weights."""
    law = PIDType(gamma_p=(0.5, 0.5), lead=12)
    names = ["scheme.gamma_p[0]", "scheme.gamma_p[1]"]
    if coupled:
        law = CrossCoupled(law, contour=0.5, own=1.0)
        names = ["scheme.scheme.gamma_p[0]", "scheme.scheme.gamma_p[1]", "scheme.contour"]
    bounds = dict.fromkeys(names, (0.01, 5.0)) | {"filter.cutoff": (3.0, 25.0)}
    found = Tuning(
        machine(),
        Filtered(law, ZeroPhaseButterworth(20.0)),
        task,
        TRIALS,
        weights=bounds,
        uncertainty=UNCERTAINTY,
        objective=Holding(TRIALS - 2, of) + 0.2 * EveryTrial(of),
        quantities=contour_metrics(task) if of.startswith("contour") else {},
        machines=TUNED_ON,
        held_out=TUNED_ON,
        steps=STEPS,
    ).run()
    print(found.values, flush=True)
    return found.scheme


def main() -> None:
    jaxilc.setup()
    folder, rows = output.folder(__file__), []
    for name, reference in paths(sys.argv[1:]).items():
        task = Task(reference, dt=DT, unit="mm", names=("x", "y"))
        schemes = {
            "tracking": tuned(task, coupled=False, of="rms"),
            "contour": tuned(task, coupled=False, of="contour_rms"),
            "coupled": tuned(task, coupled=True, of="contour_rms"),
        }
        found = Sweep(
            machine(),
            schemes,
            task,
            LONG,
            UNCERTAINTY,
            machines=JUDGED_ON,
            seed=77,
            quantities=contour_metrics(task),
        ).run()
        for law in schemes:
            one = found.sel(scheme=law)
            row = {"path": name, "law": law}
            for metric in ("contour_rms", "contour_max", "rms"):
                values = one[metric]
                if "channel" in values.dims:
                    values = values.max("channel")
                for trial in (TRIALS, LONG):
                    um = 1e3 * values.sel(trial=trial).quantile(0.95).item()
                    row[f"{metric} {trial} [um]"] = um
            rows.append(row)
            print(row, flush=True)
    output.write_rows(folder / f"{'_'.join(['laws', *sys.argv[1:]])}.csv", rows)


if __name__ == "__main__":
    main()
