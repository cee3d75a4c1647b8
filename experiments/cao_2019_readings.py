"""Cao 2019, section IV: a search over the readings of Table 1, scheme by scheme, then as a whole.

    motion     sine of 1 mm; 0.5 (1 - cos), the stroke of 1 mm in the form of eq. 28; a sine of
               0.5 mm; 1 - cos
    periods    a trial of one period, or of two; the paper prints no duration
    window     from 0, 1/8, ... 7/8 of the last period to its end
    reset      as in the book, where the sign turns, none
    plant      eq. 29, or the exact one of eq. 7
    unit       of y in CFDL-MFAILC: mm or µm; y in µm is lam / 1e6 for y in mm
    numbering  the first trial has number 1, or number 0
    phi0       free: one number for CFDL-MFAILC, one for ILC-MFAPC; of FFDL-MFAILC the number of
               u(k), or that of y(k) too, or all four

ILC-MFAPC further has: learned input added to that of the feedback or to the reference, the sign of
its gains, its derivative per sample or per second, lam as printed or lam / P, a previewed or a
constant reference over the horizon. PID has ki per sample or per second. What departs from the
words of the paper costs a choice, see `reading_search`.

Free numbers, and what else one scheme alone has, are fitted to every other row of its column, and
judged by the rows between. Motion, periods, window and numbering belong to all columns. Each column
is left out in turn: the others choose these four, and what they choose is judged by the rows of the
column to which nothing was fitted. Beside it stands the column with a window of its own, which its
own fitted rows choose.
"""

import itertools

import jax.numpy as jnp
import numpy as np
import output
from printed_tables import CAO_1
from reading_search import HELD_OUT, Reading, search
from scipy.stats import qmc

import jaxilc
from jaxilc import Machine, Task
from jaxilc.plants import voice_coil
from jaxilc.schemes import (
    CFDLMFAILC,
    CFDLMFAPC,
    FFDLMFAILC,
    PID,
    OnReference,
    PIDType,
    WithFeedback,
)

DT, N = 1e-3, 2000  # N: samples of a period
PERIODS = (1, 2)
TIME = np.arange(PERIODS[-1] * N + 1) * DT
MOTIONS = {
    "sine 1": np.sin(np.pi * TIME),
    "stroke": 0.5 * (1 - np.cos(np.pi * TIME)),
    "sine 0.5": 0.5 * np.sin(np.pi * TIME),
    "1 - cos": 1 - np.cos(np.pi * TIME),
}
WINDOWS = {f"from {i}/8": max(i * N // 8, 1) for i in range(8)}
RESETS, PLANTS = ("book", "sign", "none"), ("printed", "exact")
FITTED = {  # rows that the numbers of a scheme are fitted to: trial, and window if not the common
    "cfdl-mfailc": [(j, None) for j in (20, 40, 60, 80)],
    "ffdl-mfailc": [(j, None) for j in (20, 40, 60)],
    "ilc-mfapc": [(j, None) for j in (10, 20)],
    "pid": [(1, "from 0/8")],
}
# What the words of the paper do not say, or contradict. The window is not named at all, and the
# sine and the stroke of 1 mm both are.
DEPARTS = {
    *(("motion", "sine 0.5"), ("motion", "1 - cos"), ("reset", "book"), ("reset", "sign")),
    *(("plant", "exact"), ("unit", "µm"), ("numbering", "from 0"), ("structure", "series")),
    *(("gains", "-"), ("derivative", "per second"), ("lam", "lam / P"), ("ki", "per second")),
}


def errors_in_windows(trial):
    """(windows,) largest |e| from the start of each window to the end [mm]."""
    e = jnp.abs(trial.e[-N - 1 :, 0])
    return jnp.stack([jnp.max(e[start:]) for start in WINDOWS.values()])


def simulated(build, trials: int):
    """A function of plant, motion and (S, m) free numbers that gives (S, J, windows) errors [µm].

    build: function from m numbers to a scheme
    """

    def errors(common, free):
        machine, reference = common
        task = Task(reference, dt=DT)
        history = jaxilc.learn(machine, build(free), task, trials, save=errors_in_windows)
        return 1e3 * jnp.where(history.diverged[:, None], jnp.inf, history.saved)

    run = jaxilc.tiled(errors)

    def of(places, values):
        reference = MOTIONS[places["motion"]][: places["periods"] * N + 1]
        common = (Machine(voice_coil(places["plant"])), jnp.asarray(reference))
        return np.asarray(run(common, jnp.asarray(values)))

    return of


def readings(errors, values, places, rows):
    """The readings of one simulation: every window, and both numberings of the trials.

    rows: pairs of trial and window, None for that of the reading
    """
    for window, first in itertools.product(WINDOWS, (1, 0)):
        numbering = "from 1" if first else "from 0"
        here = {**places, "window": window, "numbering": numbering}
        columns = [
            errors[:, min(j - first, errors.shape[1] - 1), list(WINDOWS).index(of or window)]
            for j, of in rows
        ]
        departures = len(DEPARTS & set(here.items()))
        yield Reading(here, departures, np.asarray(values), np.stack(columns, axis=1))


def settings(plants):
    """The places that a simulation needs besides the scheme."""
    for plant, motion, periods in itertools.product(plants, MOTIONS, PERIODS):
        yield {"motion": motion, "periods": periods, "plant": plant}


def cfdl():
    """CFDL-MFAILC: 80 start values."""
    rows = [*((j, None) for j in CAO_1["cfdl-mfailc"] if j <= 80), (35, "from 0/8")]
    starts, found = -np.geomspace(0.003, 0.6, 80), []
    for reset in RESETS:

        def build(free, reset=reset):
            return CFDLMFAILC(lam=free[1], eta=0.9, mu=1.0, rho=1.0, phi0=free[0], reset=reset)

        run = simulated(build, 81)
        for places in settings(PLANTS):
            lams = {"mm": 1.0, "µm": 1e-6}
            errors = run(places, [(start, lam) for lam in lams.values() for start in starts])
            for i, unit in enumerate(lams):
                part = slice(i * len(starts), (i + 1) * len(starts))
                here = {**places, "reset": reset, "unit": unit}
                found += readings(errors[part], starts[:, None], here, rows)
    return found, rows, (*(CAO_1["cfdl-mfailc"][j] for j, _ in rows[:-1]), 10.0)


def ffdl():
    """FFDL-MFAILC: 64, 256 and 1024 start values in one, two and four dimensions, spread evenly."""
    rows = [(j, None) for j in CAO_1["ffdl-mfailc"] if j <= 60]
    lowest, highest = (-1.5, -1.5, -4.5, -0.5), (1.5, 1.5, -1.2, 0.5)
    forms, values = {"u(k)": (64, [2]), "y(k), u(k)": (256, [0, 2]), "all": (1024, range(4))}, []
    for many, free in forms.values():
        starts = np.zeros((many, 4))
        points = qmc.Sobol(len(free), seed=0).random(many)
        starts[:, free] = qmc.scale(points, [lowest[i] for i in free], [highest[i] for i in free])
        starts[:, 2] = -np.exp(starts[:, 2])
        values.append(starts)
    found, ends = [], np.cumsum([len(starts) for starts in values])
    for reset in RESETS:

        def build(free, reset=reset):
            return FFDLMFAILC(lam=1.2, eta=1.0, mu=1.1, rho=0.98, phi0=free, reset=reset)

        run = simulated(build, 61)
        for places in settings(("printed",)):
            errors = np.split(run(places, np.concatenate(values)), ends[:-1])
            for (form, (_, free)), starts, of in zip(forms.items(), values, errors, strict=True):
                here = {**places, "reset": reset, "start": form}
                found += readings(of, starts[:, free], here, rows)
    return found, rows, tuple(CAO_1["ffdl-mfailc"][j] for j, _ in rows)


def mfapc():
    """ILC-MFAPC: 40 start values; its later rows say "no change"."""
    rows = [(j, None) for j in CAO_1["ilc-mfapc"] if j <= 30]
    starts, found = -np.geomspace(1e-6, 0.3, 40), []
    leaves = list(itertools.product((-1.0, 1.0), (1.0, 1e3), (20.0, 2.0)))
    values = [(start, *leaf) for leaf in leaves for start in starts]
    for structure, reset, horizon in itertools.product(
        (WithFeedback, OnReference), ("book", "sign"), ("preview", "constant")
    ):

        def build(free, structure=structure, reset=reset, horizon=horizon):
            feedback = CFDLMFAPC(
                P=10, lam=free[3], eta=0.9, phi0=free[0], reset=reset, reference=horizon
            )
            gains = {"gamma_p": 0.2 * free[1], "gamma_d": free[1] * free[2]}
            return structure(PIDType(**gains), feedback)

        run = simulated(build, 60)
        for places in settings(("printed",)):
            errors = run(places, values)
            for i, (sign, second, lam) in enumerate(leaves):
                part = slice(i * len(starts), (i + 1) * len(starts))
                here = {
                    **places,
                    "reset": reset,
                    "horizon": horizon,
                    "structure": "series" if structure is OnReference else "parallel",
                    "gains": "-" if sign < 0 else "+",
                    "derivative": "per sample" if second == 1 else "per second",
                    "lam": "lam / P" if lam > 2 else "lam",
                }
                found += readings(errors[part], starts[:, None], here, rows)
    return found, rows, tuple(CAO_1["ilc-mfapc"][j] for j, _ in rows)


def pid():
    """PID: no free number."""
    rows, found = [(1, "from 0/8"), (1, None)], []

    def build(free):
        return PID(kp=-11.3, ki=free[0])

    run = simulated(build, 1)
    for places in settings(PLANTS):
        errors = run(places, [(-0.028,), (-28.0,)])
        for i, ki in enumerate(("per second", "per sample")):
            found += readings(errors[i : i + 1], np.zeros((1, 0)), {**places, "ki": ki}, rows)
    return found, rows, (30.0, 23.0)


MET_OF = ("met", "held out met")
SCHEMES = {"cfdl-mfailc": cfdl, "ffdl-mfailc": ffdl, "ilc-mfapc": mfapc, "pid": pid}


COMMON = {"motion": MOTIONS, "periods": PERIODS, "numbering": ("from 1", "from 0")}
COMMON |= {"window": WINDOWS}


def best_of(table: list[dict], here: dict) -> dict:
    """The reading of a scheme with these places whose fit is best; held-out rows are not seen."""
    fits = (row for row in table if all(row[place] == value for place, value in here.items()))
    return min(fits, key=lambda row: row["criterion of the fit"])


def in_common(tables: dict[str, list[dict]], window: bool = True) -> list[dict]:
    """Readings with the same places in all columns, the best first.

    window: whether the window is one of these; else each column has the one that its fit takes, a
        choice for each beyond the first
    """
    rows = []
    places = {name: COMMON[name] for name in COMMON if window or name != "window"}
    for chosen in itertools.product(*places.values()):
        here = dict(zip(places, chosen, strict=True))
        best = {name: best_of(table, here) for name, table in tables.items()}
        count = sum(row["held out"] for row in best.values())
        off = sum(row["held out"] * row["held out off"] ** 2 for row in best.values())
        total = sum(row["BIC"] for row in best.values())
        total += (not window) * (len(best) - 1) * np.log(len(WINDOWS))
        row = here | {"BIC": float(total), "held out off": float(np.sqrt(off / count))}
        row |= {name: sum(row[name] for row in best.values()) for name in ("held out", *MET_OF)}
        own = {name: f"{of['met']} met, {of['window']}" for name, of in best.items()}
        rows.append(row | own)
    return sorted(rows, key=lambda row: row["BIC"])


def left_out(tables: dict[str, list[dict]]) -> list[dict]:
    """Each column, predicted with the places that the others choose, with or without its window."""
    rows = []
    for name, table in tables.items():
        others = in_common({other: of for other, of in tables.items() if other != name})[0]
        for whose in ("of the others", "of its own fit"):
            here = {place: others[place] for place in COMMON}
            if whose == "of its own fit":
                del here["window"]
            best = best_of(table, here)
            told = {place: best[place] for place in (*COMMON, "free", *HELD_OUT, "ours")}
            rows.append({"left out": name, "window": whose, "with": told.pop("window"), **told})
    return rows


def main() -> None:
    folder, tables = output.folder(__file__), {}
    for name, search_of in SCHEMES.items():
        found, rows, printed = search_of()
        tables[name] = search(name, found, printed, [row in FITTED[name] for row in rows])
        output.write_rows(folder / f"{name}.csv", tables[name], 12)
    together = in_common(tables)
    print(
        "one window for all columns, the best of each motion; then each window of the best motion:"
    )
    best = [next(row for row in together if row["motion"] == motion) for motion in MOTIONS]
    output.write_rows(folder / "together.csv", best)
    shared = {place: together[0][place] for place in COMMON if place != "window"}
    alike = [row for row in together if all(row[place] == shared[place] for place in shared)]
    output.write_rows(folder / "windows.csv", sorted(alike, key=lambda row: row["window"]))
    print("each column with a window of its own, the best of each motion:")
    own = in_common(tables, window=False)
    best = [next(row for row in own if row["motion"] == motion) for motion in MOTIONS]
    output.write_rows(folder / "own-windows.csv", best)
    print("each column left out:")
    output.write_rows(folder / "left-out.csv", left_out(tables))


if __name__ == "__main__":
    jaxilc.setup()
    main()
