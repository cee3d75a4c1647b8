"""The contests of `make bench`: the same learning by jaxilc and by its opponents (`peers`).

The setting is MFAILC on the motor of Cao 2019, in any size.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np
import peers
from peers import METRICS, Peer, Problem
from timing import OURS, Cost, Entry, Row, cores, cost, difference, in_turns

from jaxilc import scenarios
from jaxilc.learning.machine import Machine
from jaxilc.learning.over_trials import learn
from jaxilc.learning.within_trial import bytes_of_trial, run_trial
from jaxilc.native.program import Unknown
from jaxilc.native.run import Compiled, lanes_of
from jaxilc.plants import InBlocks
from jaxilc.pytree.named_paths import replaced
from jaxilc.pytree.ranges import require
from jaxilc.runtime.capacity import check_size
from jaxilc.runtime.lanes import usual_lanes
from jaxilc.runtime.tiles import tiled
from jaxilc.schemes import Scheme
from jaxilc.schemes.scheme import Feedforward
from jaxilc.signals import references
from jaxilc.signals.task import Task
from jaxilc.sweeps.host import TRIALS_A_PASS

SCHEMES = {"cfdl": "cfdl-mfailc", "ffdl": "ffdl-mfailc"}
# Plants and trials that are enough to measure the time of a sample-step.
SLOW = {"NumPy loop": (1, 20), "NumPy batch": (1024, 5)}
SPREAD = 0.1  # half-width of the relative uncertainty of the gain


class Setting(NamedTuple):
    """MFAILC on the motor of Cao 2019, eq. 29, whose gain is uncertain by 10 %.

    trials: number J of trials
    gains: (S,) gains of the plants, relative to the printed one
    """

    machine: Any
    scheme: Any
    task: Task
    trials: int
    gains: np.ndarray

    @property
    def b(self) -> np.ndarray:
        """(S, 3) numerator coefficients of the plants."""
        return self.gains[:, None] * np.asarray(self.machine.plant.b)

    @property
    def problem(self) -> Problem:
        s, a = self.scheme, self.machine.plant.a
        weights = np.array([float(x) for x in (s.lam, s.rho, s.eta, s.mu, s.epsilon)])
        settled = self.task.settled.start
        return Problem(
            np.asarray(a),
            self.b,
            np.asarray(self.task.reference)[:, 0],
            self.trials,
            settled,
            weights,
            np.atleast_1d(s.phi0),
        )

    def ours(self, lanes: int | None = None) -> Callable[[], np.ndarray]:
        """(S, J, 4) metrics by `learn`, with the plants in tiles as in a sweep."""
        lanes = lanes or usual_lanes(bytes_of_trial(self.scheme, self.task))
        run = tiled(partial(_metrics, trials=self.trials), lanes=lanes)
        common, b = (self.machine, self.scheme, self.task), self.b
        return lambda: np.asarray(run(common, b))

    def native(self) -> Callable[[], np.ndarray]:
        """The same metrics by a program compiled for this processor; raises Unknown without one."""
        common, b = (self.machine, self.scheme, self.task), self.b
        fn = partial(_metrics, trials=self.trials)
        run = Compiled(fn, common, b[0], lanes_of(len(b)))
        return lambda: np.asarray(run(common, b))

    def part(self, plants: int) -> Setting:
        """The same setting with the first plants only."""
        return self._replace(gains=self.gains[:plants])


def setting(scheme: str, plants: int, trials: int, samples: int) -> Setting:
    """The scenario `cao-2019` in a given size, with one period of the sinusoid in each trial.

    scheme: `cfdl` or `ffdl`
    plants: number S of plants
    trials: number J of trials
    samples: number N of samples of a trial
    Raises ValueError for another scheme, and for a size that is too small or too large.
    """
    if scheme not in SCHEMES:
        raise ValueError(f"bench: scheme = {scheme!r} is not one of {', '.join(SCHEMES)}")
    require("bench", "plants", plants, "[1, inf)")
    require("bench", "trials", trials, "[1, inf)")
    require("bench", "samples", samples, "[4, inf)")
    need_room(plants, trials, samples)
    chosen = scenarios.load("cao-2019", reading="amplitude")
    task = Task(sinusoid(samples, chosen.task.dt), dt=chosen.task.dt)
    gains = np.random.default_rng(0).uniform(1 - SPREAD, 1 + SPREAD, plants)
    machine = chosen.machine.sampled(task.dt)
    return Setting(machine, chosen.schemes[SCHEMES[scheme]], task, trials, gains)


def need_room(plants: int, trials: int, samples: int) -> None:
    """Check that all contenders fit into the RAM together.

    They keep the metrics of every trial, signals of a few plants, and the outputs of the plants.

    Raises ValueError where they do not fit.
    """

    def need(plants: float, trials: float, samples: float) -> float:
        of_signals = 20 * min(plants, SLOW["NumPy batch"][0]) + 6 * plants
        return 8 * (32 * plants * trials + of_signals * samples)

    check_size("bench", need, plants=plants, trials=trials, samples=samples)


def sinusoid(samples: int, dt: float) -> np.ndarray:
    """(N+1,) one period of a sinusoid with the amplitude 1."""
    return np.asarray(
        references.sinusoid(1.0, 1 / (samples * dt), duration=samples * dt, dt=dt), float
    ).ravel()


def _metrics(common, b, *, trials: int):
    machine, scheme, task = common
    drawn = replaced(machine, {"plant.b": b})
    history = learn(drawn, scheme, task, trials, trials_a_pass=TRIALS_A_PASS)
    return jax.numpy.concatenate([getattr(history, name) for name in METRICS], axis=-1)


# The contests
# --------------------------------------------------------------------------------------------------

BLOCKS = "jaxilc in blocks"
NATIVE = "jaxilc native"


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
        "Numba parallel": peers.numba_parallel,
        "C limit": partial(peers.c_program, cores()),
    }.items():
        start = time.perf_counter()
        try:
            found[name] = (make(), time.perf_counter() - start)
        except (ImportError, OSError) as error:
            notes.append(f"{name} left out: {error}")
    if "C limit" in found:
        compiler, instructions, lanes = peers.target_of_c()
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
    start = time.perf_counter()
    with suppress(Unknown):  # where llvmlite is missing
        native = of.native()
        entries[NATIVE] = Entry(native, len(whole.b), whole.trials, N, time.perf_counter() - start)
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
