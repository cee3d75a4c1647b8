"""What the slopes of learning take, by how many trials' memories are stored at a time.

    python experiments/native_blocks.py cao-2019/cfdl-mfailc cao-2019/ffdl-mfailc

The slopes are those of the last error of 64 machines by every number of the scheme: of 8 trials,
whose memories fit into the cache, and of 80, each with all trials at once and in about sqrt(J)
blocks. The best of five processor times is printed, in turns.
"""

import math
import sys
from functools import partial

import native_by_scheme as by_scheme
import numpy as np

import jaxilc
from jaxilc import scenarios
from jaxilc.native.run import Compiled

MACHINES, TURNS = 64, 5


def main(names):
    jaxilc.setup()
    gains = 1 + 1e-4 * np.arange(MACHINES)
    for name in names:
        scenario, scheme = name.split("/")
        of = scenarios.load(scenario)
        common, programs = (of.machine, of.schemes[scheme], of.task), {}
        for trials in (8, 80):
            by_scheme.TRIALS = trials
            for blocks in (1, math.isqrt(trials)):
                slopes = partial(by_scheme.slopes)  # anew, since JAX keeps what it traced
                program = Compiled(slopes, common, gains[0], blocks=blocks)
                by_scheme.seconds(program, common, gains)
                programs[trials, blocks] = program
        best = dict.fromkeys(programs, math.inf)
        for _ in range(TURNS):
            for key, program in programs.items():
                best[key] = min(best[key], by_scheme.seconds(program, common, gains))
        for (trials, blocks), seconds in best.items():
            ns = 1e9 * seconds / MACHINES / trials / of.task.N
            print(f"{name}: {trials} trials in {blocks} blocks {ns:.2f} ns for a sample-step")


if __name__ == "__main__":
    main(sys.argv[1:])
