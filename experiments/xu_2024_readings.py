"""Xu 2024: a search over the readings of ILC-ASMC, for its rows without and with the load of 1 N.

    dead zone  epsilon of ASMC, not printed: 0.02 to 0.25 µm
    stiffness  of the tool, not printed: 1 or 2 N/µm; only a1 = k_f / m is. The load moves a stiff
               tool less, and adds less to its mass
    load       a constant force, a weight of 1 N (force and mass), or the mass alone
    memory     learning begins anew under the load, or goes on from the ten trials without it
    gain       whether eta_hat begins each trial anew, as the proof needs, or is carried on
    trial      10, or 11 where the first is counted as 0
    lam0       growth of the learning gain, not printed but as positive: 0.01, 0.2 or 1 1/s
    window     errors from 0.05, 0.1 or 0.25 s on
    share      of the inverse that is learned in a trial, free: 15 values

The six numbers of `FITTED` stay as they are; they were fitted to PID, SMC and ASMC without load.
Share, dead zone and stiffness are fitted to the largest errors of ILC-ASMC without load and of ASMC
without and with load; the other five rows are held out, among them both of ILC-ASMC under load.
The other places, lam0, window and load among them, are chosen by all eight rows, so that all count
as fitted.
"""

import dataclasses
import itertools

import jax.numpy as jnp
import numpy as np
import output
from printed_tables import XU_1, XU_2
from reading_search import Reading, search

import jaxilc
from jaxilc import Machine
from jaxilc.scenarios import xu_2024
from jaxilc.scenarios.xu_2024 import DT, FITTED, schemes_for, servo

jaxilc.setup()
S = jaxilc.scenarios.load("xu-2024", reading="small-gain")
WINDOWS = {"0.1 s": 0.1, "0.05 s": 0.05, "0.25 s": 0.25}
TRIALS = {"10": 9, "11": 10}
SHARES = np.round(np.linspace(0.4, 1.8, 15), 2)
ZONES = (0.02, 0.06, 0.12, 0.2, 0.25)  # [µm]
STIFF = (1.0, 2.0)  # [N/µm]
GROWTH = (0.01, 0.2, 1.0)  # [1/s]
WEIGHT = 1.0 / 9.81  # [kg]
LOADS = {"force": (1.0, 0.0), "weight": (1.0, 1.0), "mass": (0.0, 1.0)}
ROWS = {  # scheme, load: max, RMS [nm]
    ("asmc", "none"): XU_1["asmc"],
    ("asmc", "loaded"): XU_2["asmc"],
    ("ilc-asmc", "none"): XU_1["ilc-asmc"],
    ("ilc-asmc", "loaded"): XU_2["ilc-asmc"],
}
PRINTED = np.ravel(list(ROWS.values()))
FITTED_ROWS = [True, False, True, False, True, False, False, False]
# "10 iterations" may be those after the first trial; only the mass, and what is carried on, depart.
DEPARTS = {("load", "mass"), ("gain", "carried"), ("trial", "11"), ("memory", "goes on")}


def errors_in_windows(trial):
    """(windows, 2) largest and RMS error from the start of each window on [µm]."""
    e = trial.e[:, 0]
    parts = [e[round(start / DT) :] for start in WINDOWS.values()]
    return jnp.stack([jnp.stack([jnp.max(jnp.abs(p)), jnp.sqrt(jnp.mean(p**2))]) for p in parts])


def machine(force, added):
    """The tool under a force [N] and with added mass [kg], both for a stiffness of 1 N/µm."""
    tool = servo(FITTED["A"], 1.0)
    tool = dataclasses.replace(tool, load=force, mass=tool.mass + added)
    return Machine(tool, S.machine.actuator, S.machine.sensor)


def schemes(share, zone, growth, carry):
    """ASMC, and learning over it, of the paper with these numbers of a reading."""
    found = schemes_for(FITTED, xu_2024.Reading(share, zone, growth))
    asmc = dataclasses.replace(found["asmc"], carry=carry)
    return asmc, dataclasses.replace(found["ilc-asmc"], feedback=asmc)


def simulated(carry: bool):
    """A function from (S, 5) values to (S, 3, J, windows, 2) errors [nm].

    values: share, dead zone, growth, force, added mass
    The second axis has ILC-ASMC without load, under the load from the start, and under it after the
    trials without it.
    """

    def learned(common, free):
        law = schemes(*free[:3], carry)[1]
        unloaded = jaxilc.learn(machine(0.0, 0.0), law, S.task, 11, save=errors_in_windows)
        loaded = machine(free[3], free[4])
        anew = jaxilc.learn(loaded, law, S.task, 11, save=errors_in_windows)
        on = jaxilc.learn(
            *(loaded, law, S.task, 11), memory=unloaded.memory, first=12, save=errors_in_windows
        )
        kept = [
            jnp.where(h.diverged[:, None, None], jnp.inf, h.saved) for h in (unloaded, anew, on)
        ]
        return 1e3 * jnp.stack(kept)

    return jaxilc.tiled(learned)


def plain(common, free):
    """(2, windows, 2) errors of ASMC without and with the load [nm]."""
    asmc = schemes(1.0, free[0], 0.0, False)[0]
    tools = (machine(0.0, 0.0), machine(free[1], free[2]))
    kept = [jaxilc.learn(t, asmc, S.task, 1, save=errors_in_windows).saved[0] for t in tools]
    return 1e3 * jnp.stack(kept)


def main() -> None:
    folder, found = output.folder(__file__), []
    runs = {"anew": simulated(False), "carried": simulated(True)}
    of_plain = jaxilc.tiled(plain)
    for load, (force, weight) in LOADS.items():
        loads = {k: (force / k, weight * WEIGHT / k) for k in STIFF}
        free = [(zone, k) for zone in ZONES for k in STIFF]
        asmc = np.asarray(of_plain(0.0, jnp.asarray([(z, *loads[k]) for z, k in free])))
        for growth, gain in itertools.product(GROWTH, runs):
            values = [(s, z, growth, *loads[k]) for z, k in free for s in SHARES]
            ilc = np.asarray(runs[gain](0.0, jnp.asarray(values)))
            numbers = np.array([(s, z, k) for z, k in free for s in SHARES])
            of_asmc = np.repeat(asmc, len(SHARES), axis=0)
            for memory, trial, window in itertools.product(("anew", "goes on"), TRIALS, WINDOWS):
                w, j = list(WINDOWS).index(window), TRIALS[trial]
                after = ilc[:, 1 if memory == "anew" else 2, j, w]
                ours = np.hstack([of_asmc[:, 0, w], of_asmc[:, 1, w], ilc[:, 0, j, w], after])
                places = {"load": load, "lam0": growth, "gain": gain, "memory": memory}
                places |= {"trial": trial, "window": window}
                found.append(Reading(places, len(DEPARTS & set(places.items())), numbers, ours))
    table = search("ASMC and ILC-ASMC", found, PRINTED, FITTED_ROWS)
    output.write_rows(folder / "rows.csv", table, 20)


if __name__ == "__main__":
    main()
