"""Draw the pictures of the start page into .github/pictures: the default sweep, and the butterfly.

The sweep is that of `make run`, with 256 machines. The butterfly is the path of Li 2020 on its two
axes under learning with a fixed filter; the distance from the path is drawn larger.
"""

from pathlib import Path

import numpy as np
from PIL import Image

import jaxilc
from jaxilc import Sweep, figures, run_schemes, scenarios

FOLDER = Path(__file__).parents[2] / ".github" / "pictures"
COLOURS = 64  # of a picture, which keeps it small


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
    s = scenarios.load("cao-2019").select(("pid", "cfdl-mfailc", "ffdl-mfailc", "ilc-mfapc"))
    sweep = Sweep(s.machine, s.schemes, s.task, 60, uncertainty=s.uncertainty, machines=256)
    keep(figures.error_band(sweep.run(), tolerance=0.005, scale=1e3, unit="µm"), "sweep.png")
    xy = scenarios.load("li-2020", axes="xy").select(("fixed-filter",))
    dataset, _ = run_schemes(xy.machine, xy.schemes, xy.task, trials=8)
    axes = figures.contour(dataset, "fixed-filter", (1, 3, 8), scale=1e3, unit="µm")
    keep(axes, "butterfly.png")


if __name__ == "__main__":
    main()
