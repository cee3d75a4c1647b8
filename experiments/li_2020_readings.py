"""Li 2020: searches over the readings of the fixed filter, and of what does not repeat.

The first is for the error of the fixed filter, 10 µm after 8 iterations:

    filter    printed coefficients as they are, or for a DC gain of 1; Butterworth of order 2, 3
              or 4 at 10 Hz, each pass or both together; the third order of the print, 5.85 Hz
    ends      odd extension of 9 samples, or mirrored over 1000
    acts on   the error (eq. 11, Fig. 17), or the whole learned input
    lead      of the learning: 0 or 5 samples beyond the one from u to y
    plant     as a double integrator, or as printed
    trial     9, or 8
    window    the whole path; or away from its sharp points, as the paper says that the overall
              error converges to 10 µm, while those near samples 2915 and 7576 stay larger; 0.1,
              0.2 or 0.4 s on each side are left out
    gain      free, as the paper may have used another one with the filter: seven values

The loop is linear, so that SciPy simulates it by its transfer functions, apart from the project's
code. Held out are two printed statements: the RMS never rises by more than 0.3 µm in 40 trials
(Fig. 18), and the largest error under feedback is 60 µm (Fig. 7). k counts the places that differ
from reading every sample of trial 9 in the scenario, the gain among them.

The second is for section 6.1, "the variance range of the RMSE was within 0.000 3 mm" over ten runs
under feedback, read as its size: white noise of the encoder gives 0.006 µm. Beside it may stand

    part    nothing; an offset of the error in each run; noise of 0.5 or 5 Hz; white noise at the
            input of the plant; a share of the error under feedback, as a drive has whose gain
            drifts; or a start that is late by a part of a sample, each drawn anew for each run
            with a standard deviation that is free

The gain of learning and the encoder's noise are free as well. The tables are Fig. 30 (this row),
Fig. 36 (runs 1 to 5) and Fig. 15 (the first trial that rises); each is left out in turn.
"""

import itertools

import numpy as np
import output
import scipy.signal
from reading_search import Reading, left_out, search

import jaxilc
from jaxilc.filters.zero_phase import PRINTED_LI_2020
from jaxilc.plants import cnc_axis
from jaxilc.plants.cnc_axis import SAMPLE_TIME
from jaxilc.scenarios import li_2020 as paper

PRINTED, MET = 10.0, 0.3  # [µm], share
TRIALS, SHOWN = 40, 6
SPREAD, RUNS, RISES = 0.3, (70.0, 40.0, 20.0, 15.0, 10.0), 6.0  # Fig. 30, 36 [µm], 15
TABLES = ("Fig. 30", *5 * ("Fig. 36",), "Fig. 15")
PARTS = {  # standard deviations [µm], shares, [samples], [unit of u]
    "nothing": (0.0,),
    "offset": (0.2, 0.6, 2.0, 6.0),
    "0.5 Hz": (0.05, 0.15, 0.5, 1.5),
    "5 Hz": (0.15, 0.5, 1.5, 5.0),
    "share": (2e-4, 6e-4, 2e-3, 6e-3),
    "late": (2e-3, 6e-3, 2e-2, 6e-2),
    "input": (5e-4, 1.5e-3, 5e-3, 1.5e-2),
}
OF_LEARNING = ((0.8, 1.0, 1.2, 1.4), (0.5e-3, 0.8e-3, 1.1e-3, 1.4e-3))  # gain, noise [mm]
REPEATS, SEEDS = 16, 3
SHARP = (2915, 7576)  # printed samples
AWAY = {"whole path": 0.0, "0.1 s": 0.1, "0.2 s": 0.2, "0.4 s": 0.4}  # [s] on each side
GAINS = (0.2, 0.3, 0.45, 0.6, 0.8, 1.2, 1.8)
OWN = paper.SETTINGS["simulation"]
FIRST = {"filter": "Butterworth 2", "ends": "odd", "acts on": "error", "lead": 0}
FIRST |= {"plant": "double_integrator", "trial": 9, "window": "whole path"}


def butterworth(order: int, cutoff: float, passes: int = 1):
    """(b, a) of a low-pass at 500 Hz whose passes together are at -3 dB at the cutoff [Hz]."""
    ratio = (2.0 ** (1 / passes) - 1.0) ** (-1 / (2 * order))
    return scipy.signal.butter(order, cutoff * ratio, fs=1 / SAMPLE_TIME)


def filters() -> dict[str, tuple]:
    """(b, a) of one pass, by name."""
    b, a = (np.array(PRINTED_LI_2020[name]) for name in ("b", "a"))
    orders = (2, 3, 4)
    return {
        "printed": (b, a),
        "printed, DC 1": (b * a.sum() / b.sum(), a),
        **{f"Butterworth {n}": butterworth(n, 10.0) for n in orders},
        **{f"Butterworth {n}, both": butterworth(n, 10.0, 2) for n in orders},
        "Butterworth 3, 5.85 Hz": butterworth(3, 5.85),
    }


def loop(plant: str):
    """The closed loop: functions from the input, and from the encoder's noise, to the position."""
    axis = cnc_axis(plant)
    num, den = scipy.signal.ss2tf(*(np.asarray(m) for m in (axis.A, axis.B, axis.C)), [[0.0]])
    kd = paper.DERIVATIVE / SAMPLE_TIME
    control = np.array([paper.PROPORTIONAL + kd, -kd])
    through = np.convolve(num[0], control)
    closed = np.append(den, 0.0) + through
    return (
        lambda u: scipy.signal.lfilter(np.append(num[0], 0.0), closed, u),
        lambda n: -scipy.signal.lfilter(through, closed, n),
    )


def runs(places, gains, noise) -> np.ndarray:
    """(trials, gains, N+1) errors as measured [mm].

    noise: (trials, N+1) of the encoder [mm]
    """
    of_input, of_noise = loop(places["plant"])
    low_pass, ends, lead = filters()[places["filter"]], places["ends"], places["lead"]
    r = paper.butterfly_path()[:, 0]
    # the derivative acts on the position alone, so that feedback sees kp r only
    base = r - of_input(paper.PROPORTIONAL * r)
    gains, w = np.array(gains)[:, None], np.zeros((len(gains), len(r)))
    kept = []
    for n in noise:
        e = base - of_noise(n) - n - of_input(w)
        kept.append(e)
        step = np.zeros_like(e)
        chosen = e if places["acts on"] == "input" else filtered(low_pass, e, ends)
        step[:, : -1 - lead] = chosen[:, 1 + lead :]
        w = w + gains * step
        if places["acts on"] == "input":
            w = filtered(low_pass, w, ends)
    return np.array(kept)


def filtered(low_pass, signal, ends: str):
    padding = {"odd": paper.FILTFILT, "even": 1000}[ends]
    return scipy.signal.filtfilt(*low_pass, signal, padtype=ends, padlen=padding)


def rise(row, noise) -> float:
    """The largest rise of the RMS error from a trial to the next in 40 [µm]."""
    rms = np.sqrt(np.mean(runs(row, (row["gain"],), noise)[:, 0] ** 2, axis=-1))
    return float(1e3 * np.max(np.diff(rms)))


def judged(errors, places) -> list[dict[str, object]]:
    """A row for each gain, trial and window."""
    rows, samples = [], np.arange(errors.shape[-1])
    distance = np.min(np.abs(samples[:, None] - np.array(SHARP)), axis=1) * SAMPLE_TIME
    for trial, window in itertools.product((9, 8), AWAY):
        inside = distance >= AWAY[window]
        size = 1e3 * np.abs(errors[trial - 1])
        for i, gain in enumerate(GAINS):
            own = {**places, "trial": trial, "window": window}
            rows.append(
                {
                    **own,
                    "gain": gain,
                    "k": sum(own[name] != FIRST[name] for name in FIRST) + (gain != OWN.gain),
                    "ours": float(size[i, inside].max()),
                    "at the points": float(size[i].max()),
                    "feedback": float(1e3 * np.abs(errors[0, i]).max()),
                }
            )
    return rows


def unrepeated(part: str, base, rng) -> np.ndarray:
    """(REPEATS, N+1) a part of the error that differs from run to run [mm], for a size of 1."""
    shape, of_input = (REPEATS, len(base)), loop("double_integrator")[0]
    of_run = rng.standard_normal((REPEATS, 1))
    match part.split():
        case ["offset"]:
            return 1e-3 * of_run * np.ones(shape)
        case ["share"]:
            return of_run * base
        case ["input"]:
            return of_input(rng.standard_normal(shape))
        case ["late"]:
            return of_run * np.gradient(paper.butterfly_path()[:, 0])
        case [cutoff, "Hz"]:
            before = round(5 / (float(cutoff) * SAMPLE_TIME))
            white = rng.standard_normal((REPEATS, before + len(base)))
            low = scipy.signal.butter(1, float(cutoff), fs=1 / SAMPLE_TIME)
            slow = scipy.signal.lfilter(*low, white)[:, before:]
            return 1e-3 * slow / slow.std()
    return np.zeros(shape)


def repeated(part: str, size: float, gain: float, noise: float) -> np.ndarray:
    """(7,) spread under feedback, errors of runs 1 to 5 [µm], and the best trial; mean of seeds."""
    of_input, of_noise = loop("double_integrator")
    r, rows = paper.butterfly_path()[:, 0], []
    base = r - of_input(paper.PROPORTIONAL * r)
    for seed in range(SEEDS):
        rng = np.random.default_rng(seed)
        others = size * unrepeated(part, base, rng)
        white = noise * rng.standard_normal(others.shape)
        plain = base + others - of_noise(white) - white
        w, errors = np.zeros_like(r), []
        for run in plain:
            errors.append(run - of_input(w))
            w[:-1] += gain * errors[-1][1:]
        rms = np.sqrt(np.mean(np.square(errors), axis=1))
        spread = 1e3 * np.ptp(np.sqrt(np.mean(plain[:10] ** 2, axis=1)))
        rows.append([spread, *1e3 * np.abs(errors[:5]).max(axis=1), 1 + np.argmin(rms)])
    return np.mean(rows, axis=0)


def repeatability(folder) -> None:
    found = []
    for part, sizes in PARTS.items():
        values = np.array(list(itertools.product(sizes, *OF_LEARNING)))
        free = [len(sizes) > 1, True, True]
        ours = np.array([repeated(part, *value) for value in values])
        found.append(Reading({"part": part}, len(sizes) > 1, values[:, free], ours))
    printed = (SPREAD, *RUNS, RISES)
    table = search("repeatability", found, printed, [True, True, False, False, False, True, False])
    output.write_rows(folder / "repeatability.csv", table)
    table = left_out("repeatability", found, printed, TABLES)
    output.write_rows(folder / "repeatability-left-out.csv", table)


def main() -> None:
    jaxilc.setup()
    folder, found = output.folder(__file__), []
    repeatability(folder)
    length = len(paper.butterfly_path())
    noise = OWN.noise * np.random.default_rng(0).standard_normal((TRIALS, length))
    space = itertools.product(
        *(filters(), ("odd", "even"), ("error", "input")),
        *((0, 5), ("double_integrator", "printed")),
    )
    for values in space:
        places = dict(zip(("filter", "ends", "acts on", "lead", "plant"), values, strict=True))
        with np.errstate(over="ignore", invalid="ignore"):
            found += judged(runs(places, GAINS, noise[:9]), places)
    whole = [row for row in found if row["window"] == "whole path"]
    for told, rows in (("the whole path", whole), ("all windows", found)):
        right = [row for row in rows if abs(row["ours"] / PRINTED - 1) <= MET]
        right.sort(key=lambda row: (row["k"], abs(np.log(row["ours"] / PRINTED))))
        least = [row for row in right if row["k"] == right[0]["k"]]
        print(
            f"{told}: {len(rows)} candidates, {len(right)} are within 30 % of 10 µm, "
            f"{len(least)} of them with the fewest changes, {right[0]['k']}"
        )
        table = [row | {"rise": rise(row, noise)} for row in least[:SHOWN]]
        output.write_rows(folder / f"{told.replace(' ', '-')}.csv", table)


if __name__ == "__main__":
    main()
