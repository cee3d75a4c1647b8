"""Draw the pictures of the start page into .github/pictures: the default sweep, and the butterfly.

The sweep is that of `make run`, with 256 machines. The butterfly is the path that papers on CNC
interpolators use, on two axes that differ, under P-type learning with a filter; the distance from
the path is drawn larger. `pictures.py butterfly` draws this one alone.
"""

import io
import sys
import tempfile
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from PIL import Image

import jaxilc
from jaxilc import Sweep, figures, load_scenario, run_schemes, scenarios
from jaxilc.figures.paper import darken
from jaxilc.figures.within_trial import signal_of

FOLDER = Path(__file__).parents[2] / ".github" / "pictures"
COLOURS = 64  # of a picture, which keeps it small
BUTTERFLY = """
[plant]
kind = "TwoAxes"
x = { kind = "transfer_function", num = [4000.0], den = [1.0, 80.0, 4000.0] }
y = { kind = "transfer_function", num = [2500.0], den = [1.0, 70.0, 2500.0] }
[task]
dt = 0.002
unit = "mm"
reference = { path = "butterfly", width = 40.0, feed = 40.0, acceleration = 600.0, jerk = 2e4 }
[schemes.ilc]
class = "Filtered"
scheme = { class = "PIDType", gamma_p = 0.8, lead = 8 }
filter = { class = "ZeroPhaseButterworth", cutoff = 25.0, order = 2 }
"""


def keep(axes, name: str) -> None:
    """Write a picture with few colours, one for a light and one for a dark page."""
    figure = np.ravel(axes)[0].figure
    for path in (FOLDER / f"{name}.png", FOLDER / f"{name}-dark.png"):
        if path.stem.endswith("dark"):
            darken(figure)
        figure.savefig(path, dpi=100)
        Image.open(path).convert("RGB").quantize(COLOURS, method=Image.Quantize.MEDIANCUT).save(
            path, optimize=True
        )
        print(f"{path.name}: {path.stat().st_size / 1000:.0f} kB")


def _long(micrometres: float) -> str:
    return f"{micrometres / 1e3:.3g} mm" if micrometres > 1e3 else f"{micrometres:.3g} µm"


def moving(dataset, trials: int, *, dark: bool) -> None:
    """Write the butterfly as a picture that moves: the motion and its error, trial by trial."""
    signals = [
        [np.asarray(signal_of(dataset, name, "ilc", j)) for name in ("y", "e")]
        for j in range(1, trials + 1)
    ]
    path = signals[-1][0] + signals[-1][1]
    errors = [1e3 * np.max(np.linalg.norm(e, axis=1)) for _, e in signals]
    frames = []
    for j in range(1, trials + 1):
        drawn, figure = io.BytesIO(), Figure(figsize=(8, 3.6), layout="constrained", dpi=80)
        plane, by_trial = figure.subplots(1, 2, width_ratios=(1.6, 1))
        plane.plot(*path.T, color="0.75", lw=4)
        plane.plot(*signals[j - 1][0].T, color="C0", lw=1.2)
        plane.set_aspect("equal")
        plane.set_axis_off()
        plane.set_title(f"trial {j}")
        by_trial.semilogy(range(1, j + 1), errors[:j], "o-", color="C0")
        by_trial.set(
            xlim=(0.5, trials + 0.5), ylim=(0.5 * min(errors), 2 * max(errors)),
            xlabel="trial", ylabel="largest error [µm]", title=_long(errors[j - 1]),
        )  # fmt: skip
        by_trial.grid(alpha=0.3)
        if dark:
            darken(figure)
        figure.savefig(drawn)
        frames.append(Image.open(drawn).convert("RGB").quantize(COLOURS))
    place, shown = FOLDER / f"butterfly{'-dark' * dark}.gif", [800] * (trials - 1) + [3000]
    frames[0].save(place, save_all=True, append_images=frames[1:], duration=shown, loop=0)
    print(f"{place.name}: {place.stat().st_size / 1000:.0f} kB")


def main() -> None:
    """Draw all."""
    jaxilc.setup()
    if "butterfly" not in sys.argv[1:]:
        s = scenarios.load("cao-2019").select(("pid", "cfdl-mfailc", "ffdl-mfailc", "ilc-mfapc"))
        sweep = Sweep(s.machine, s.schemes, s.task, 60, uncertainty=s.uncertainty, machines=256)
        keep(figures.error_band(sweep.run(), tolerance=0.005, scale=1e3, unit="µm"), "sweep")
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "butterfly.toml"
        file.write_text(BUTTERFLY)
        xy = load_scenario(file)
    dataset, _ = run_schemes(xy.machine, xy.schemes, xy.task, trials=8)
    axes = figures.contour(dataset, "ilc", (3, 4, 8), scale=1e3, unit="µm")
    keep(axes, "butterfly")
    for dark in (False, True):
        moving(dataset, 8, dark=dark)


if __name__ == "__main__":
    main()
