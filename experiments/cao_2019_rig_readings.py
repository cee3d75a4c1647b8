"""Cao 2019, Table 2: a search over the readings of the rig, for all ten rows.

    structure  how CFDL-MFAILC runs in the real-time system, see below
    limit      of the "Saturation module": that of the converter, 10 V, or 0.01 to 1 V
    command    the speed for 10 V: the printed top speed of 3.44 m/s, or free
    offset     a constant voltage at the drive's input, as converters and drives have: none, or free
    ki         integral gain of PID: per second, or per sample

Free numbers are fitted to the rows at 0.1 and 0.5 Hz of both schemes; the six rows at 0.2, 0.3 and
0.4 Hz are held out. Then each of the five frequencies is left out in turn. The structures:

    1, 2, 3, 80     the printed "For Iterator": within each sample the iterations begin anew at u =
                    0, and y cannot change, so that the first step of eq. 12 gives
                    u = rho phi e / (lam + phi^2), and each further one as much again
    in time         eq. 12 along the samples, u(k) = u(k-1) + ...
    over trials     ten trials of 10 s by eq. 12 alone, on a coarser grid of the free numbers
    over PID        80 trials, as printed, over the printed PID, behind a zero-phase filter of 6, 12
                    or 25 Hz

A module that keeps its state from sample to sample, or reads the encoder in each pass, is "in time"
with another gain or sample time. On a drive that integrates, integral control is unstable for any
gain: s^2 (tau s + 1) + K has no term in s.

Friction is not among them: below 110 N it changes no row by 2 %, and above it the carriage sticks.
"""

import itertools

import jax.numpy as jnp
import numpy as np
import output
from printed_tables import CAO_2
from reading_search import Reading, left_out, search

import jaxilc
from jaxilc import Task
from jaxilc.filters.zero_phase import ZeroPhaseButterworth
from jaxilc.learning import Actuator, Disturbance, Machine
from jaxilc.pytree import replaced
from jaxilc.schemes import CFDLMFAC, CFDLMFAILC, PID, Filtered, WithFeedback
from jaxilc.signals import references

jaxilc.setup()
STEP = 1.0 / (1.5 + 1.0)  # rho phi / (lam + phi^2) with the printed lam = 1.5, rho = phi = 1
FINE = {  # [m/s/V] for 1 V, and [V]
    "command": {
        "3.44 m/s": (0.344,),
        "free": (*np.geomspace(0.004, 0.2, 9), *np.linspace(0.3, 0.7, 17)),
    },
    "offset": {"none": (0.0,), "free": tuple(2e-4 * np.arange(1, 9))},
}
COARSE = {
    "command": {"3.44 m/s": (0.344,), "free": (0.4, 0.5, 0.6)},
    "offset": {"none": (0.0,), "free": (8e-4,)},
}
KI = {"per second": 0.006, "per sample": 6.0}
WORDS = {"80 passes"}  # the structure that the words of section V-B describe
FREQUENCIES = tuple(CAO_2["pid"])
FITTED = [f in (0.1, 0.5) for _ in range(2) for f in FREQUENCIES]
MACHINE = jaxilc.scenarios.load("cao-2019-rig", reading="over-trials").machine
REFERENCES = jnp.stack(
    [jnp.asarray(references.sinusoid(1.0, f, duration=10.0, dt=1e-3)) for f in FREQUENCIES]
)
LIMIT = 10.0  # of the converter [V]
LIMITS = (0.01, 0.02, 0.05, 0.1, 1.0)  # of the "Saturation module" [V]


def law():
    return CFDLMFAILC(lam=1.5, eta=1.0, mu=1.0, rho=1.0, phi0=1.0, reset="sign")


def structures(pid) -> dict:
    """Scheme, number of trials, name of the grid, and whether PID is part of it, by name."""
    passes = {f"{n} pass{'es' * (n > 1)}": PID(kp=n * STEP) for n in (1, 2, 3, 80)}
    found = {name: (scheme, 1, "fine", False) for name, scheme in passes.items()}
    in_time = CFDLMFAC(lam=1.5, eta=1.0, mu=1.0, rho=1.0, phi0=1.0, reset="sign")
    over = {
        f"over PID, {f:g} Hz": (
            WithFeedback(Filtered(law(), ZeroPhaseButterworth(f, padding=300)), pid),
            80,
            "coarse",
            True,
        )
        for f in (6.0, 12.0, 25.0)
    }
    found["in time"] = (in_time, 1, "coarse", False)
    found["over trials"] = (law(), 10, "coarse", False)
    return found | over


def grid_of(axes):
    """The parts of a grid by the names of its axes, each with its free columns, and its values."""
    parts, values = {}, []
    for (command, scales), (offset, volts) in itertools.product(
        axes["command"].items(), axes["offset"].items()
    ):
        first = len(values)
        values += itertools.product(scales, volts)
        free = [command == "free", offset == "free"]
        parts[command, offset] = (slice(first, len(values)), free)
    return parts, np.array(values)


def settled_error(common, one):
    """The error of the last trial [µm] for a speed by volt, an offset and a reference."""
    scheme, limit, trials = common
    scale, offset, reference = one
    plant = replaced(MACHINE.plant, {"command_scale": scale})
    drift = Disturbance(input=jnp.full((len(reference) - 1, 1), offset))
    actuator = Actuator(limit, resolution=MACHINE.actuator.resolution)
    machine = Machine(plant, actuator, MACHINE.sensor, drift)
    history = jaxilc.learn(machine, scheme, Task(reference, dt=1e-3), trials)
    return 1e3 * jnp.where(history.diverged[-1], jnp.inf, history.settled_error[-1, 0])


def errors(scheme, trials: int, values, limit: float = LIMIT) -> np.ndarray:
    """(S, 5) settled errors [µm] at the five frequencies for (S, 2) values of scale and offset."""
    run = jaxilc.tiled(lambda common, one: settled_error((*common, trials), one))
    scale, offset = np.repeat(values, len(FREQUENCIES), axis=0).T
    reference = jnp.tile(REFERENCES, (len(values), 1))
    lanes = (jnp.asarray(scale), jnp.asarray(offset), reference)
    found = run((scheme, jnp.asarray(limit)), lanes)
    return np.asarray(found).reshape(len(values), len(FREQUENCIES))


def main() -> None:
    folder = output.folder(__file__)
    pids = {name: PID(kp=0.29, ki=ki) for name, ki in KI.items()}
    grids = {name: grid_of(axes) for name, axes in (("fine", FINE), ("coarse", COARSE))}
    of_pid = {
        (name, grid): errors(pid, 1, values)
        for name, pid in pids.items()
        for grid, (_, values) in grids.items()
    }
    found = []
    for structure, (scheme, trials, grid, over) in structures(pids["per second"]).items():
        parts, values = grids[grid]
        limits = (LIMIT, *LIMITS) if structure in WORDS else (LIMIT,)
        ours = {limit: errors(scheme, trials, values, limit) for limit in limits}
        for limit, ki in itertools.product(limits, KI if not over else ("per second",)):
            rows = np.hstack([ours[limit], of_pid[ki, grid]])
            departs = (structure not in WORDS) + (ki == "per second") + (limit < LIMIT)
            for (command, offset), (part, free) in parts.items():
                places = {"structure": structure, "limit": limit, "ki": ki}
                places |= {"command": command, "offset": offset}
                found.append(Reading(places, departs, values[part][:, free], rows[part]))
    printed = [CAO_2[name][f] for name in ("cfdl-mfailc", "pid") for f in FREQUENCIES]
    table = search("Table 2, CFDL-MFAILC and PID", found, printed, FITTED)
    output.write_rows(folder / "rows.csv", table, 30)
    table = left_out("Table 2", found, printed, 2 * FREQUENCIES)
    output.write_rows(folder / "left-out.csv", table, 30)


if __name__ == "__main__":
    main()
