"""The contests of `jaxilc bench`: the same learning by jaxilc and by its opponents (`peers`)."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np

from .. import scenarios
from ..learning.machine import Machine
from ..learning.over_trials import learn
from ..learning.within_trial import run_trial
from ..plants import InBlocks, StateSpace
from ..pytree.named_paths import replaced
from ..runtime.capacity import check_size
from ..runtime.tiles import tiled
from ..scenarios.xu_2024 import MODEL
from ..schemes import NormOptimal, Scheme
from ..schemes.scheme import Feedforward
from ..signals import references
from ..signals.task import Task
from . import compiled_peers, peers
from .peers import METRICS, Peer, Problem
from .timing import OURS, Cost, Entry, Row, cores, cost, difference, in_turns

SCHEMES = {"cfdl": "cfdl-mfailc", "ffdl": "ffdl-mfailc"}
ALONE = ("noilc", "ilc-asmc")
BLOCKS = "jaxilc in blocks"
# Plants and trials that are enough to measure the time of a sample-step.
SLOW = {"NumPy loop": (1, 20), "NumPy batch": (1024, 5)}


def opponents() -> tuple[dict[str, tuple[Peer, float]], list[str]]:
    """The opponents that run here with the seconds to build them, and a note on each other one.

    Numba and a C compiler are optional.
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
    return found, notes


class Setting(NamedTuple):
    """MFAILC on the motor of Cao 2019, eq. 29, whose gain is uncertain by 10 %.

    trials: number J of trials
    b: (S, 3) numerator coefficients of the plants
    """

    machine: Any
    scheme: Any
    task: Task
    trials: int
    b: np.ndarray

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
        run = tiled(partial(_metrics, leaf="plant.b", trials=self.trials), lanes=lanes)
        common = (self.machine, self.scheme, self.task)
        return lambda: np.asarray(run(common, self.b))


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
    for name, value, least in (
        ("plants", plants, 1),
        ("trials", trials, 1),
        ("samples", samples, 4),
    ):
        if value < least:
            raise ValueError(f"bench: {name} = {value} is outside its allowed range [{least}, inf)")
    need_room(plants, trials, samples)
    chosen = scenarios.load("cao-2019", plant="printed")
    motor: Any = chosen.machine.plant
    task = Task(_sinusoid(samples, chosen.task.dt), dt=chosen.task.dt)
    b = np.asarray(motor.b) * np.random.default_rng(0).uniform(0.9, 1.1, (plants, 1))
    return Setting(chosen.machine, chosen.schemes[SCHEMES[scheme]], task, trials, b)


def need_room(plants: int, trials: int, samples: int) -> None:
    """Check that all contenders fit into the RAM together.

    They keep the metrics of every trial, signals of a few plants, and the outputs of the plants.

    Raises ValueError where they do not fit.
    """

    def need(plants: float, trials: float, samples: float) -> float:
        of_signals = 20 * min(plants, SLOW["NumPy batch"][0]) + 6 * plants
        return 8 * (32 * plants * trials + of_signals * samples)

    check_size("bench", need, plants=plants, trials=trials, samples=samples)


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


def alone(name: str, plants: int, *, repeats: int = 5) -> Row:
    """The time of jaxilc without opponents, in ten trials of 2000 samples.

    The names are:

    noilc       norm-optimal learning by the Riccati recursion on the drive of MILC 2024, with 10 %
                model error
    ilc-asmc    the scheme of Xu 2024 on its identified model

    Raises ValueError for another name.
    """
    match name:
        case "noilc":
            chosen = scenarios.load("milc-2024")
            dilc: Any = chosen.schemes["dilc"]
            plant = dilc.learning.scheme.model
            scheme = NormOptimal(plant, w_q=1.0, w_r=1e-4, w_s=1e-3)
            task = Task(_sinusoid(2000, plant.dt), dt=plant.dt)
        case "ilc-asmc":
            chosen = scenarios.load("xu-2024")
            plant = StateSpace(
                [[0.0, 1.0], [-MODEL["a1"], -MODEL["a2"]]], [[0.0], [MODEL["b"]]], [[1.0, 0.0]]
            )
            scheme = chosen.schemes["ilc-asmc"]
            task = Task(20 * _sinusoid(2000, chosen.task.dt), dt=chosen.task.dt)
        case _:
            raise ValueError(f"bench: scheme = {name!r} is not one of {', '.join(ALONE)}")
    gains = np.random.default_rng(0).uniform(0.9, 1.1, (plants, 1, 1)) * np.asarray(plant.B)
    run = tiled(partial(_metrics, leaf="plant.B", trials=10))
    common = (Machine(plant), scheme, task)
    ours = Entry(lambda: np.asarray(run(common, gains)), plants, 10, task.N)
    return in_turns({OURS: ours}, repeats=repeats)[OURS]


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


def _metrics(common, one, *, leaf: str, trials: int):
    machine, scheme, task = common
    history = learn(replaced(machine, {leaf: one}), scheme, task, trials)
    return jax.numpy.concatenate([getattr(history, name) for name in METRICS], axis=-1)


def _response(common, b):
    machine, task, u = common
    return _output(replaced(machine, {"plant.b": b}), task, u)[:, 0]


def _output(machine, task, u):
    return run_trial(machine, Scheme(), task, Feedforward(u), jax.random.key(0)).y


def _sinusoid(samples: int, dt: float) -> np.ndarray:
    return np.asarray(
        references.sinusoid(1.0, 1 / (samples * dt), duration=samples * dt, dt=dt), float
    ).ravel()
