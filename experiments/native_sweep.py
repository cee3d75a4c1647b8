"""The processor time of a sweep by XLA, or by programs compiled for this processor.

    python experiments/native_sweep.py cao-2019 off
    python experiments/native_sweep.py cao-2019 on

Two runs, of which the second has its programs. In a second process, where JAXILC_CACHE names a
folder, the first run reads them from the disk; with `off` nothing is read.
"""

import sys
import time

import jaxilc
from jaxilc import scenarios
from jaxilc.runtime.start import keep_programs
from jaxilc.sweeps import Sweep

MACHINES = 1024


def main(name, native):
    """Print the seconds of both runs."""
    jaxilc.setup(native=native == "on")
    keep_programs()
    of = scenarios.load(name)
    sweep = Sweep(
        of.machine, of.schemes, of.task, of.trials, uncertainty=of.uncertainty, machines=MACHINES
    )
    for what in ("the first time", "again"):
        begun, start = time.process_time(), time.perf_counter()
        sweep.run()
        used, took = time.process_time() - begun, time.perf_counter() - start
        print(f"{name}, native {native}, {what}: {used:.2f} s of processor, {took:.2f} s")


if __name__ == "__main__":
    main(*sys.argv[1:])
