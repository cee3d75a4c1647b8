"""Each scheme of each scenario on an accelerator, against the CPU, and the time of a sample.

    python experiments/benchmark/accelerator_schemes.py [SCENARIO:SCHEME ...]

A few trials of one machine, with noise, are compared in rms, largest error and last input, as a
share of the largest. Then the seconds to compile and the microseconds for a sample follow, of one
machine and of a thousand together. Each scheme has a process of its own, and 95 s. The exit code
is 1 where a scheme could not be compared.
"""

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import jax
import numpy as np

import jaxilc
from jaxilc import scenarios

TRIALS, MACHINES, PATIENCE = 4, 1024, 95.0


def learned(name: str, machines: int, file: Path | None) -> None:
    """Print the times of so many machines that differ in noise, and keep the numbers in a file."""
    of, scheme_name = scenarios.load(name.split(":")[0]), name.split(":")[1]
    scheme = of.schemes[scheme_name]
    trials = -(-min(of.trials, TRIALS) // scheme.trials_a_step) * scheme.trials_a_step

    @jax.jit
    @jax.vmap
    def run(key):
        history = jaxilc.learn(of.machine, scheme, of.task, trials, key=key)
        return history.rms, history.max_error, history.final.u

    keys = jax.random.split(jax.random.key(3), machines)
    start = time.perf_counter()
    program = run.lower(keys).compile()
    compiling = time.perf_counter() - start
    jax.block_until_ready(program(keys))
    start = time.perf_counter()
    found = jax.block_until_ready(program(keys))
    of_sample = 1e6 * (time.perf_counter() - start) / trials / of.task.N
    if file is not None:
        np.savez(file, *map(np.asarray, found))
    print(f"  {machines} machines: {compiling:.1f} s to compile, {of_sample:.3g} us a sample")


def compared(name: str, folder: Path) -> bool:
    """Print the largest differences from the CPU; whether there were numbers to compare."""
    files = {"cpu": folder / "cpu.npz", "": folder / "here.npz"}
    print(name, flush=True)
    for platform, file in files.items():
        file.unlink(missing_ok=True)
        given = {"JAX_PLATFORMS": platform} if platform else {}
        command = [sys.executable, __file__, "--one", name, str(file)]
        try:
            ended = subprocess.run(
                command, env=os.environ | given, timeout=PATIENCE, capture_output=True, text=True
            )
        except subprocess.TimeoutExpired:
            print(f"  not known: it took more than {PATIENCE:g} s", flush=True)
            continue
        if ended.returncode:
            where = "on the CPU" if platform else "here"
            print(f"  failed {where}: {ended.stderr.strip().splitlines()[-1]}", flush=True)
        elif not platform:
            print(ended.stdout, end="", flush=True)
    if not all(file.exists() for file in files.values()):
        return False
    both = [[stored[key] for key in stored.files] for stored in map(np.load, files.values())]
    off = [np.max(abs(a - b)) / max(np.max(abs(a)), 1e-300) for a, b in zip(*both, strict=True)]
    print("  off by", *(f"{x:.1e}" for x in off), "(rms, largest error, last input)", flush=True)
    return True


if __name__ == "__main__":
    if sys.argv[1:2] == ["--one"]:
        jaxilc.setup()
        learned(sys.argv[2], 1, Path(sys.argv[3]))
        if jax.default_backend() != "cpu":
            learned(sys.argv[2], MACHINES, None)
        sys.exit()
    every = [f"{of}:{name}" for of in scenarios.SCENARIOS for name in scenarios.load(of).schemes]
    with tempfile.TemporaryDirectory() as folder:
        known = [compared(name, Path(folder)) for name in sys.argv[1:] or every]
    print(f"{sum(known)} of {len(known)} schemes were compared")
    sys.exit(not all(known))
