"""How many times as long XLA takes as programs compiled for this processor, by scheme.

    python experiments/native_by_scheme.py [scenario/scheme ...]

Each machine has other numbers and other noise. Of each scheme a few trials are timed, forward and
with slopes by every number of the scheme, by the best of three processor times.
"""

import sys
import time

import jax
import jax.numpy as jnp
import numpy as np

import jaxilc
from jaxilc import scenarios
from jaxilc.learning import learn
from jaxilc.native.program import Unknown
from jaxilc.native.run import Compiled, differs
from jaxilc.runtime.tiles import tiled

MACHINES, TRIALS = 32, 6
SCHEMES = {
    "li-2020": ("p-type", "higher-order", "ladder", "series", "fixed-filter", "switchable"),
    "milc-2024": ("dilc", "milc"),
    "xu-2024": ("ilc-asmc",),
    "double-mass": ("norm-optimal", "inverse-filter", "gradient", "model-free"),
}
LEAST = 0.2  # the system tells the time of other threads to some milliseconds


def scaled(tree, gain):
    """Return the tree with every real number times the gain."""
    return jax.tree.map(
        lambda x: x * gain if jnp.issubdtype(jnp.asarray(x).dtype, jnp.floating) else x, tree
    )


def errors(common, gain):
    """Return the errors of a machine, whose noise has the gain as its seed."""
    machine, scheme, task = common
    key = jax.random.key(jnp.astype(1e6 * gain, int))
    return learn(scaled(machine, gain), scheme, task, TRIALS, key=key).rms


def slopes(common, gain):
    """Return the last error and its slopes by every real number of the scheme."""
    machine, scheme, task = common
    leaves, structure = jax.tree.flatten(scheme)
    real = [i for i, x in enumerate(leaves) if jnp.issubdtype(jnp.asarray(x).dtype, jnp.floating)]

    def loss(values):
        moved = dict(zip(real, values, strict=True))
        of = jax.tree.unflatten(structure, [moved.get(i, x) for i, x in enumerate(leaves)])
        return jnp.sum(errors((machine, of, task), gain)[-1])

    return jax.value_and_grad(loss)([leaves[i] for i in real])


def seconds(run, *arguments):
    """Return the processor time of a run, of as many as take LEAST seconds."""
    start, runs = time.process_time(), 0
    while time.process_time() - start < LEAST:
        jax.block_until_ready(run(*arguments))
        runs += 1
    return (time.process_time() - start) / runs


def main(names):
    """Print a line for each scheme and each of both ways."""
    jaxilc.setup(devices=1)
    gains = 1 + 1e-4 * np.arange(MACHINES)
    for name in names:
        scenario, scheme = name.split("/")
        of = scenarios.load(scenario)
        common = (of.machine, of.schemes[scheme], of.task)
        steps = MACHINES * TRIALS * of.task.N
        for fn, lanes in ((errors, None), (slopes, 8)):
            try:
                native, xla = Compiled(fn, common, gains[0]), tiled(fn, lanes=lanes)
            except Unknown as reason:
                print(f"{name} {fn.__name__}: refused, {reason}", flush=True)
                continue
            off = differs(native(common, gains), xla(common, gains))
            ours, theirs = (
                min(seconds(run, common, gains) for _ in range(3)) / steps * 1e9
                for run in (native, xla)
            )
            told = f"{ours:.1f} ns, XLA {theirs:.1f} ns, {theirs / ours:.2f} times"
            print(f"{name} {fn.__name__}: {told}; {off or 'the same numbers'}", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:] or [f"{of}/{name}" for of, names in SCHEMES.items() for name in names])
