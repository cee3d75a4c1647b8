"""Dai 2014: a search over the readings of CFDL-MFAPC, for its two rows together.

    plant      eq. 24, eq. 29 of Cao 2019, or the exact one of eq. 23
    moves      control horizon P_u: 1 or 2; the paper says that it may be 1
    horizon    the reference over the horizon: previewed, or constant at r(k+1)
    reset      as printed (eq. 12), or none
    lam        as printed, or times P, 1 / P, 1 / P^2 (eq. 10 has lam / P)
    window     the last period but one, the second period, all after the first quarter of a period
    phi0       free, not printed: 80 values, the same at both frequencies, or one for each

One phi0 is fitted to the row at 0.5 Hz and judged on that at 2.5 Hz. With one for each frequency
nothing is held out. A match at a single start value among neighbours that miss proves nothing, as
the loop at 2.5 Hz (P = 250, lam = 8700) is at its stability limit. So for each reading the share
of start values that meet the row is told too, and the longest run of neighbours that do.
"""

import itertools

import jax.numpy as jnp
import numpy as np
import output
from reading_search import Reading, met, search

import jaxilc
from jaxilc import Machine
from jaxilc.plants import voice_coil
from jaxilc.schemes import CFDLMFAPC

jaxilc.setup()
PRINTED = {0.5: 0.0165, 2.5: 0.047}
HORIZON = {0.5: (10, 45.0), 2.5: (250, 8700.0)}  # P, lam
PLANTS = {
    name: voice_coil(form).sampled(1e-3)
    for name, form in (("eq. 24", "dai_2014_printed"), ("eq. 29", "printed"), ("exact", "exact"))
}
RESETS = {"eq. 12": "book", "none": "none"}
POWERS = {"lam": 0, "lam P": 1, "lam / P": -1, "lam / P^2": -2}
WINDOWS = ("last but one", "second period", "all after 1/4")
STARTS = -np.geomspace(1e-3, 100.0, 80)
DEPARTS = {("plant", "eq. 29"), ("plant", "exact"), ("reset", "none")}
DEPARTS |= {("lam", name) for name in POWERS if name != "lam"}


def simulated(frequency: float):
    """A function that gives (lam, phi0, windows) errors [mm] of a reading at a frequency."""
    task = jaxilc.scenarios.load("dai-2014", frequency=frequency).task
    period, N = round(1e3 / frequency), task.N
    spans = (slice(N - 2 * period, N - period), slice(period, 2 * period), slice(period // 4, None))
    P, lam = HORIZON[frequency]

    def errors_in_windows(trial):
        return jnp.stack([jnp.max(jnp.abs(trial.e[span, 0])) for span in spans])

    def of(moves, horizon, reset):
        def errors(machine, free):
            weights = {"lam": free[0], "phi0": free[1], "reset": reset, "reference": horizon}
            scheme = CFDLMFAPC(P=P, P_u=moves, **weights)
            return jaxilc.learn(machine, scheme, task, 1, save=errors_in_windows).saved[0]

        run = jaxilc.tiled(errors)
        values = [(lam * float(P) ** power, start) for power in POWERS.values() for start in STARTS]

        def at(plant):
            found = run(Machine(PLANTS[plant]), jnp.asarray(values))
            return np.asarray(found).reshape(len(POWERS), len(STARTS), len(WINDOWS))

        return at

    return of


def longest_run(flags) -> int:
    """The largest number of neighbours that are all true."""
    return max((len(list(run)) for true, run in itertools.groupby(flags) if true), default=0)


def main() -> None:
    folder, found, ranges = output.folder(__file__), [], []
    at = {frequency: simulated(frequency) for frequency in PRINTED}
    for moves, horizon, reset in itertools.product((1, 2), ("preview", "constant"), RESETS):
        runs = {f: of(moves, horizon, RESETS[reset]) for f, of in at.items()}
        for plant in PLANTS:
            errors = {f: run(plant) for f, run in runs.items()}
            for (i, lam), (k, window) in itertools.product(enumerate(POWERS), enumerate(WINDOWS)):
                places = {"plant": plant, "moves": moves, "horizon": horizon, "reset": reset}
                places |= {"lam": lam, "window": window}
                ours = np.stack([errors[f][i, :, k] for f in PRINTED], axis=1)
                departs = len(DEPARTS & set(places.items()))
                found.append(Reading(places, departs, STARTS[:, None], ours))
                right = met(ours, list(PRINTED.values()))
                ranges.append(
                    {
                        **places,
                        "best": float(np.nanmin(np.where(np.isfinite(ours), ours, np.inf)[:, 1])),
                        "share": float(right[:, 1].mean()),
                        "run": longest_run(right[:, 1]),
                        "run of both": longest_run(right.all(axis=1)),
                    }
                )
    printed = list(PRINTED.values())
    table = search("one phi0 for both frequencies", found, printed, [True, False])
    output.write_rows(folder / "rows.csv", table, 12)
    print("runs of neighbouring start values, a factor of 1.16 apart, that meet the row at 2.5 Hz:")
    ranges.sort(key=lambda row: (-row["run"], -row["share"]))
    output.write_rows(folder / "ranges.csv", ranges, 12)
    draw(folder, found)


def draw(folder, found) -> None:
    """The error at 2.5 Hz against phi0 for the readings with P_u = 1 and the printed reset."""
    ax = output.axes()
    for reading in found:
        places = reading.places
        plain = (places["moves"], places["reset"], places["lam"]) == (1, "eq. 12", "lam")
        if plain and places["window"] == WINDOWS[0]:
            name = f"{places['plant']}, {places['horizon']}"
            ax.loglog(-STARTS, reading.ours[:, 1], label=name)
    ax.axhline(PRINTED[2.5], color="k", linewidth=0.8, label="published")
    ax.set(xlabel="-phi0 [mm/V]", ylabel="settled error [mm]", ylim=(0.02, 10))
    ax.set_title("2.5 Hz, P = 250, P_u = 1")
    output.save(ax, folder / "start-values.png", fontsize="small")


if __name__ == "__main__":
    main()
