"""The pictures of the page on the printer, which need records that are not part of the project."""

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

EXPERIMENT = Path(__file__).parents[2] / "experiments" / "flatbed_printer.py"
PICTURES = {  # picture of the experiment: heading below which it stands, and what it shows
    "response": ("The response", "The measured response and the model of order 20"),
    "predicted": (
        "The error of a motion that was never played",
        "The error of four trials, predicted from the reference, with its band",
    ),
    "learned": (
        "Is learning worth it, and what it comes to",
        "The rms error over the trials in simulation, down to what is new in each",
    ),
}


def extend(page: Path) -> None:
    """Draw the pictures beside the page and put them into it, where the records are at hand."""
    if not os.environ.get("JAXILC_MEASURED"):
        return
    text = page.read_text(encoding="utf-8")
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run([sys.executable, str(EXPERIMENT)], cwd=folder, check=True)
        for name, (heading, shows) in PICTURES.items():
            drawn = Path(folder) / "out" / "experiments" / "flatbed_printer" / f"{name}.png"
            shutil.copy(drawn, page.parent / f"printer-{name}.png")
            above = f"## {heading}\n\n"
            text = text.replace(above, f"{above}![{shows}](printer-{name}.png)\n\n")
    page.write_text(text, encoding="utf-8")
