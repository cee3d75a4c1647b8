"""Draw the pictures of the start page into .github/pictures: the default sweep, and the butterfly.

The sweep is that of `make run`, with 256 machines. The butterfly is the path that papers on CNC
interpolators use, on two axes that differ, under P-type learning with a filter; the distance from
the path is drawn larger. `pictures.py butterfly` draws this one alone.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image

import jaxilc
from jaxilc import Sweep, figures, load_scenario, run_schemes, scenarios

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
    """Write a picture with few colours."""
    path = FOLDER / name
    np.ravel(axes)[0].figure.savefig(path, dpi=100)
    Image.open(path).convert("RGB").quantize(COLOURS, method=Image.Quantize.MEDIANCUT).save(
        path, optimize=True
    )
    print(f"{path.name}: {path.stat().st_size / 1000:.0f} kB")


def main() -> None:
    """Draw both."""
    jaxilc.setup()
    if "butterfly" not in sys.argv[1:]:
        s = scenarios.load("cao-2019").select(("pid", "cfdl-mfailc", "ffdl-mfailc", "ilc-mfapc"))
        sweep = Sweep(s.machine, s.schemes, s.task, 60, uncertainty=s.uncertainty, machines=256)
        keep(figures.error_band(sweep.run(), tolerance=0.005, scale=1e3, unit="µm"), "sweep.png")
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "butterfly.toml"
        file.write_text(BUTTERFLY)
        xy = load_scenario(file)
    dataset, _ = run_schemes(xy.machine, xy.schemes, xy.task, trials=8)
    axes = figures.contour(dataset, "ilc", (3, 4, 8), scale=1e3, unit="µm")
    keep(axes, "butterfly.png")


if __name__ == "__main__":
    main()
