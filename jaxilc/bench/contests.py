"""The contests of `jaxilc bench`: the same learning by jaxilc and by its opponents (`peers`)."""

from __future__ import annotations

import time
from collections.abc import Mapping
from functools import partial

import jax
import numpy as np

from ..learning.machine import Machine
from ..learning.within_trial import run_trial
from ..plants import InBlocks
from ..pytree.named_paths import replaced
from ..runtime.tiles import tiled
from ..schemes import Scheme
from ..schemes.scheme import Feedforward
from . import compiled_peers, peers
from .computer import cores
from .peers import Peer
from .settings import SLOW, Setting, setting
from .timing import OURS, Cost, Entry, Row, cost, difference, in_turns

BLOCKS = "jaxilc in blocks"


def opponents() -> tuple[dict[str, tuple[Peer, float]], list[str]]:
    """The opponents that run here with the seconds to build them, and a note on each other one.

    Numba and a C compiler are optional. Another note says how many lanes C has.
    """
    found: dict[str, tuple[Peer, float]] = {
        "NumPy loop": (peers.numpy_loop, 0.0),
        "NumPy batch": (peers.numpy_batch, 0.0),
    }
    notes: list[str] = []
    for name, make in {
        "Numba parallel": compiled_peers.numba_parallel,
        "C limit": partial(compiled_peers.c_program, cores()),
    }.items():
        start = time.perf_counter()
        try:
            found[name] = (make(), time.perf_counter() - start)
        except (ImportError, OSError) as error:
            notes.append(f"{name} left out: {error}")
    if "C limit" in found:
        compiler, instructions, lanes = compiled_peers.target_of_c()
        notes.append(f"C: {compiler} for {instructions}, {lanes} lanes (plants in a register)")
    return found, notes


def compare(
    of: Setting, opponents: Mapping[str, tuple[Peer, float]], *, repeats: int = 5
) -> dict[str, Row]:
    """The times of jaxilc and of every opponent on one setting.

    Raises ArithmeticError naming an opponent that computes other numbers.
    """
    whole, N, entries = of.problem, of.task.N, {}
    for name, (peer, built) in opponents.items():
        plants, trials = SLOW.get(name, (None, whole.trials))
        problem = whole.part(plants or len(whole.b), trials)
        entries[name] = Entry(partial(peer, problem), len(problem.b), problem.trials, N, built)
    entries[OURS] = Entry(of.ours(), len(whole.b), whole.trials, N)
    return in_turns(entries, repeats=repeats)


def compare_plant(of: Setting, *, repeats: int = 5) -> dict[str, Row]:
    """The times for the plants alone under one input: python-control, SciPy and `run_trial`.

    Raises ArithmeticError where their outputs differ.
    """
    import control
    import scipy.signal

    a, dt, N, S = np.asarray(of.machine.plant.a), of.task.dt, of.task.N, len(of.b)
    u = np.random.default_rng(1).normal(size=N)
    few = min(S, 64)  # python-control runs a Python step for each sample
    instants, last, denominator = np.arange(N + 1) * dt, np.append(u, 0.0), np.append(1.0, -a)
    systems = [control.ss(control.tf(b, denominator, dt)) for b in of.b[:few]]
    run, common = tiled(_response), (of.machine, of.task, u[:, None])

    def by_control() -> np.ndarray:
        return np.stack([control.forced_response(s, instants, last).outputs for s in systems])

    def by_scipy() -> np.ndarray:
        numerators = (np.append(0.0, b) for b in of.b)
        return np.stack([scipy.signal.lfilter(b, denominator, last) for b in numerators])

    entries = {
        "python-control": Entry(lambda: by_control()[..., None], few, 1, N),
        "SciPy lfilter": Entry(lambda: by_scipy()[..., None], S, 1, N),
        OURS: Entry(lambda: np.asarray(run(common, of.b))[..., None], S, 1, N),
    }
    return in_turns(entries, repeats=repeats)


def compare_long(samples: int, *, repeats: int = 5) -> dict[str, Row]:
    """The times for one long trial of one plant: SciPy, and `run_trial` by steps and in blocks.

    Raises ArithmeticError where outputs in blocks differ by more than 1e-9 of the largest one,
    ValueError for fewer than 4 samples.
    """
    import scipy.signal

    of = setting("cfdl", 1, 1, samples)
    u = np.random.default_rng(1).normal(size=(samples, 1))
    b, a = np.append(0.0, of.machine.plant.b), np.append(1.0, -np.asarray(of.machine.plant.a))
    last = np.append(u, 0.0)
    run, common = jax.jit(_output), jax.device_put((of.task, u))
    steps, in_blocks = jax.device_put((of.machine, Machine(InBlocks(of.machine.plant))))
    calls = {
        "SciPy lfilter": lambda: scipy.signal.lfilter(b, a, last)[None, :, None],
        BLOCKS: lambda: np.asarray(run(in_blocks, *common))[None],
        OURS: lambda: np.asarray(run(steps, *common))[None],
    }
    off = difference(calls[BLOCKS](), calls[OURS]())
    if jax.config.jax_enable_x64 and not off <= 1e-9:
        raise ArithmeticError(
            f"bench: {BLOCKS} differs from jaxilc by {off:.2g} of the largest output; "
            "allowed is 1e-09"
        )
    return in_turns(
        {name: Entry(call, 1, 1, samples) for name, call in calls.items()}, repeats=repeats
    )


def cost_by_size(
    scheme: str, plants: int, trials: int, samples: int, *, repeats: int = 5
) -> dict[str, tuple[dict[int, float], Cost]]:
    """Seconds of our best run by numbers of plants, trials and samples, with fitted lines.

    One number is varied at a time: a quarter, a half and all of its size.
    """
    found = {}
    whole = {"plants": plants, "trials": trials, "samples": samples}
    for name, size in whole.items():
        quarter = max(size // 4, 4)
        calls = {
            s: setting(scheme, **whole | {name: s}).ours()
            for s in (quarter, 2 * quarter, 4 * quarter)
        }
        rows = {s: [] for s in calls}
        for turn in range(repeats + 1):
            for s, call in calls.items():
                start = time.perf_counter()
                call()
                if turn:
                    rows[s].append(time.perf_counter() - start)
        best = {s: min(times) for s, times in rows.items()}
        found[name] = (best, cost(best, best.values()))
    return found


def _response(common, b):
    machine, task, u = common
    return _output(replaced(machine, {"plant.b": b}), task, u)[:, 0]


def _output(machine, task, u):
    return run_trial(machine, Scheme(), task, Feedforward(u), jax.random.key(0)).y
