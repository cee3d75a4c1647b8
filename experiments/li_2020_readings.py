"""Li 2020: a search over the readings of the fixed filter, whose error is 10 µm after 8 iterations.

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
"""

import itertools

import numpy as np
import output
import scipy.signal

import jaxilc
from jaxilc.filters.zero_phase import PRINTED_LI_2020
from jaxilc.plants import cnc_axis
from jaxilc.plants.cnc_axis import SAMPLE_TIME
from jaxilc.scenarios import li_2020 as paper

PRINTED, MET = 10.0, 0.3  # [µm], share
TRIALS, SHOWN = 40, 6
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


def main() -> None:
    jaxilc.setup()
    folder, found = output.folder(__file__), []
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
