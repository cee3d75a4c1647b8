"""The speed of jaxilc in several environments, whose folders are the arguments, side by side.

The environments take turns, each in a process of its own. The processor time counts, which does not
include waiting for a core: the least of all turns and, in brackets, the ratio to the first
environment, a median over the turns. Programs are MFAILC on the motor of Cao 2019, forward and with
its gradient by all weights in reverse. `make matrix` compares versions of Python and JAX so.
"""

import json
import platform
import subprocess
import sys
from pathlib import Path

import numpy as np

PLANTS, TRIALS, SAMPLES, TURNS = 16, 80, 2000, 3


def measured(plants=PLANTS, trials=TRIALS, samples=SAMPLES):
    """The name of this environment, and the processor time of each program [ns a sample-step]."""
    import contests
    import gradients
    import jax
    from timing import OURS

    import jaxilc

    jaxilc.setup()
    times = {}
    for name in contests.SCHEMES:
        rows = gradients.compare_gradients(contests.setting(name, plants, trials, samples), {})
        times[name] = rows[OURS].cpu
        times[f"{name} gradient"] = next(r.cpu for n, r in rows.items() if n.endswith("reverse"))
    return f"Python {platform.python_version()}, JAX {jax.__version__}", times


def table(turns):
    """The lines of the table, from what each environment measured in each turn.

    turns: for each turn, for each environment, its name and its times by program
    """
    names, programs = [name for name, _ in turns[0]], list(turns[0][0][1])
    yield f"{'processor ns a sample-step':26}" + "".join(f"{name:>30}" for name in names)
    for program in programs:
        times = np.array([[found[program] for _, found in turn] for turn in turns])
        ratios = np.median(times / times[:, :1], axis=0)
        cells = (f"{ns:.2f} ({r:.2f})" for ns, r in zip(times.min(axis=0), ratios, strict=True))
        yield f"{program:26}" + "".join(f"{cell:>30}" for cell in cells)


def main(environments):
    def asked(folder):
        command = [str(Path(folder) / "bin" / "python"), __file__]
        return json.loads(subprocess.run(command, stdout=subprocess.PIPE, check=True).stdout)

    turns = [[asked(folder) for folder in environments] for _ in range(TURNS)]
    print("\n".join(table(turns)))


if __name__ == "__main__":
    if sys.argv[1:]:
        main(sys.argv[1:])
    else:
        print(json.dumps(measured()))
