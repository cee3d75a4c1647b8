"""Norm-optimal learning by the Riccati recursion against the dense lifted form, by trial length.

The learned signals, the time and the memory are compared. The case is MILC with two inputs and two
outputs on the drive of MILC 2024 in ten trials. Each measurement runs in its own process.
"""

import dataclasses
import multiprocessing
import resource
import time

import numpy as np
import output

LENGTHS, LONGEST, TRIALS = (250, 1000, 4000), 100_000, 10


def measure(form, N):
    """Seconds to compile and to run ten trials, peak memory, and the learned signals (N, 2).

    The peak memory [MB] is the excess over an idle process.
    """
    import jax

    import jaxilc

    jaxilc.setup()
    s = jaxilc.scenarios.load("milc-2024", reading="long-stroke")
    bump = 5.0 * min(N / 4000, 1.0) ** 2 * (1 - np.cos(2 * np.pi * np.arange(N + 1) / N))
    task = dataclasses.replace(s.task, reference=np.stack([bump, bump], axis=1), settle=None)
    scheme = s.schemes["milc"]
    scheme = dataclasses.replace(scheme, learning=dataclasses.replace(scheme.learning, form=form))
    machine = dataclasses.replace(s.machine, sensor=None)
    jaxilc.learn(
        machine, s.schemes["milc"], dataclasses.replace(task, reference=task.reference[:3]), 1
    )
    idle = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    start = time.perf_counter()
    compiled = (
        jax.jit(lambda machine, scheme, task: jaxilc.learn(machine, scheme, task, TRIALS))
        .lower(machine, scheme, task)
        .compile()
    )
    built = time.perf_counter()
    history = jax.block_until_ready(compiled(machine, scheme, task))
    done = time.perf_counter()
    peak = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - idle) / 1024
    return (
        built - start,
        done - built,
        peak,
        np.asarray(history.memory.learning.u),
        np.asarray(history.rms)[-1, 1],
    )


def main():
    folder, rows = output.folder(__file__), []
    with multiprocessing.get_context("spawn").Pool(1, maxtasksperchild=1) as pool:
        for N in (*LENGTHS, LONGEST):
            found = {
                form: pool.apply(measure, (form, N))
                for form in ("lifted", "riccati")
                if N != LONGEST or form == "riccati"
            }
            for form, (compile_s, run_s, peak, learned, rms) in found.items():
                row = {
                    "N": N,
                    "form": form,
                    "compile s": compile_s,
                    "run s": run_s,
                    "peak MB": peak,
                    "table RMS um": 1e3 * rms,
                }
                other = found.get("lifted", found["riccati"])[3]
                difference = np.max(np.abs(learned - other), axis=0) / np.max(np.abs(other), axis=0)
                compared = float(np.max(difference)) if len(found) > 1 else ""
                rows.append(row | {"relative difference": compared})
    output.write_rows(folder / "rows.csv", rows)


if __name__ == "__main__":
    main()
