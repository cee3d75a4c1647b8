"""Play an exported law in LinuxCNC's HAL, and compare its inputs with those of the package.

    python experiments/law_in_hal.py

It needs LinuxCNC 2.9 with its headers (Debian: linuxcnc-uspace, linuxcnc-uspace-dev) and the right
to install a component. A streamer plays measured outputs into the pins, a sampler records what the
law answers, in a thread of 1 ms. The sampler prints six decimals, so the inputs agree to half of
the last of these, not to the last bit.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from jaxilc.export import law_of
from jaxilc.export.c_files import files_of, hal_component
from jaxilc.runtime import setup
from jaxilc.schemes import PIDType
from jaxilc.signals import Task, references

TRIALS = 3
SESSION = """loadrt threads name1=t period1=1000000
loadrt streamer depth=4000 cfg=fb
loadrt sampler depth=4000 cfg=fbss
loadrt law
addf streamer.0 t
addf law t
addf sampler.0 t
net y streamer.0.pin.0 => law.measured
net b streamer.0.pin.1 => law.begin-trial
net u law.command => sampler.0.pin.0
net r law.running => sampler.0.pin.1
net n law.trials => sampler.0.pin.2
net c law.last-code => sampler.0.pin.3
"""
PLAYED = """realtime start
halcmd -f session.hal || exit 1
halsampler -n {rows} > recorded.txt &
halstreamer played.txt
halcmd start
wait
halcmd stop
halcmd unload all
realtime stop
"""


def main() -> None:
    missing = [name for name in ("halcompile", "halcmd", "halstreamer") if not shutil.which(name)]
    if missing:
        sys.exit(
            f"{', '.join(missing)}: not there; install linuxcnc-uspace and linuxcnc-uspace-dev"
        )
    setup()
    r = references.sinusoid(1.0, 20.0, duration=0.1, dt=0.001)
    task = Task(r, 0.001)
    law = law_of(PIDType(gamma_p=0.5, gamma_d=0.001, lead=2), task, 100.0)
    rng = np.random.default_rng(0)
    r = np.asarray(task.reference)
    y = [(1 - 0.5**j) * r + 0.01 * rng.standard_normal(r.shape) for j in range(TRIALS)]
    played = law.played()
    wanted = [np.append(played.trial(one)[0], 0.0) for one in y]  # 0 where the law learns
    with tempfile.TemporaryDirectory() as folder:
        text = hal_component(task, files_of(law, ["A law."], "0" * 64, y), "A law.")
        recorded = in_hal(Path(folder), text, np.concatenate(y))
    off = np.abs(recorded[:, 0] - np.concatenate(wanted)).max()
    print(f"{len(recorded)} samples of {TRIALS} trials: the inputs differ by {off:.1e} at most")
    print(f"trials that have ended: {recorded[-1, 2]:.0f}; code of the last: {recorded[-1, 3]:.0f}")
    if not (off <= 5.1e-7 and recorded[-1, 2] == TRIALS and recorded[-1, 3] == 0):
        sys.exit("the law in HAL is not the law of the package")


def in_hal(folder: Path, text: str, y: np.ndarray) -> np.ndarray:
    """What the sampler records: rows of input, running, trials and code."""
    (folder / "law.comp").write_text(text)
    (folder / "session.hal").write_text(SESSION)
    rows = [f"{float(one)!r} 1\n" for one in np.ravel(y)]
    (folder / "played.txt").write_text("".join(rows))
    (folder / "played.sh").write_text(PLAYED.format(rows=len(rows)))
    folder.chmod(0o777)  # HAL gives up root's rights
    subprocess.run(["halcompile", "--install", "law.comp"], cwd=folder, check=True)
    subprocess.run(["sh", "played.sh"], cwd=folder, check=True, timeout=60)
    return np.loadtxt(folder / "recorded.txt")


if __name__ == "__main__":
    main()
