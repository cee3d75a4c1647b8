"""Cao 2019: the printed numbers, what was fitted to them, and what the paper leaves open.

The paper says "amplitude 1 mm" and, one sentence later, "stroke 1 mm" of the same motion, and names
no window for its steady-state errors. Two readings follow, each whole (`READINGS`): one motion, one
window, one reset of the estimates for all schemes. `experiments/cao_2019_readings.py` judges them
side by side.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from .published import NOTHING, Fit, Published

TABLE_1 = {  # scheme: trial: settled error [µm]; "no change" repeats the number before
    "cfdl-mfailc": {20: 18.0, 30: 11.0, 40: 5.5, 50: 2.5, 60: 1.5, 70: 0.5, 80: 0.3, 100: 0.3},
    "ffdl-mfailc": {20: 13.0, 30: 2.5, 40: 0.5, 50: 0.2, 60: 0.15, 70: 0.15, 80: 0.15, 100: 0.15},
    "ilc-mfapc": {10: 8.0, 15: 1.5, **dict.fromkeys((20, 30, 40, 50, 60, 70, 80, 100), 0.3)},
}
NO_CHANGE = {"cfdl-mfailc": 80, "ffdl-mfailc": 60, "ilc-mfapc": 20}  # printed for later trials
# The trials to which phi0 was fitted; the others test the fit.
FITTED = {"cfdl-mfailc": (20, 40, 60, 80), "ffdl-mfailc": (20, 40, 60), "ilc-mfapc": (10, 20)}
SEARCH = "experiments/cao_2019_readings.py"


class Reading(NamedTuple):
    """A reading of section IV, and the start values of the estimates fitted under it.

    said: the reading in words
    cfdl, ffdl, mfapc: phi0 of CFDL-MFAILC, FFDL-MFAILC and ILC-MFAPC [mm/V]
    chosen: the readings of single places that belong to it
    """

    said: str
    cfdl: float
    ffdl: tuple[float, ...]
    mfapc: float
    chosen: tuple[str, ...]


READINGS = {
    "amplitude": Reading(
        "sine of amplitude 1 mm; second half of the trial",
        cfdl=-0.0682,
        ffdl=(0.753, -0.0547, -0.0811, 0.498),
        mfapc=-0.00064,
        chosen=(
            "the motion is read as a sine of amplitude 1 mm, the steady-state error as max |e| "
            "over the second half of the trial",
        ),
    ),
    "stroke": Reading(
        "0.5 (1 - cos) mm, the stroke of 1 mm in the form of eq. 28; last quarter of the trial",
        cfdl=-0.0297,
        ffdl=(0.753, -0.0547, -0.0811, 0.498),
        mfapc=-0.00064,
        chosen=(
            "the motion is read as 0.5 (1 - cos) mm, the stroke of 1 mm in the form of eq. 28, the "
            "steady-state error as max |e| over the last quarter of the trial",
        ),
    ),
}
PID_READING = "ki multiplied by the sample time"
MFAILC_READING = "eq. 29's plant; reset `sign`"
MFAPC_READING = "gains take the plant's sign; lam read as lam / P"


def published(reading: str) -> tuple[Published, ...]:
    """The rows of the paper under a reading."""
    said = READINGS[reading].said
    options = (("plant", "printed"), ("reading", reading))

    def row(scheme, trial, quantity, value, source, how, fitted) -> Published:
        how = f"{how}; {said}" if quantity == "settled_error" else how
        return Published(scheme, trial, quantity, value, source, options, how, fitted=fitted)

    of_table = [
        row(scheme, j, "settled_error", value, "Table 1", _how(scheme, j), _fit(scheme, j))
        for scheme, by_trial in TABLE_1.items()
        for j, value in by_trial.items()
    ]
    whole = "over the whole trial, its start included"
    of_text = (
        ("cfdl-mfailc", 35, "max_error", 10.0, "section IV-A", whole, _fit("cfdl-mfailc", 35)),
        ("pid", None, "max_error", 30.0, "section IV-C", PID_READING, NOTHING),
        ("pid", None, "settled_error", 23.0, "section IV-C", PID_READING, NOTHING),
    )
    return (*of_table, *(row(*one) for one in of_text))


def _how(scheme: str, trial: int) -> str:
    how = MFAPC_READING if scheme == "ilc-mfapc" else MFAILC_READING
    return f'"no change" after {NO_CHANGE[scheme]}; {how}' if trial > NO_CHANGE[scheme] else how


def _fit(scheme: str, trial: int) -> Fit:
    names = tuple(f"phi0[{i}]" for i in range(4)) if scheme == "ffdl-mfailc" else ("phi0",)
    to = f"its rows of Table 1 at trials {', '.join(map(str, FITTED[scheme]))}"
    return Fit(names, to, trial in FITTED[scheme])


def chosen(reading: str) -> tuple[str, ...]:
    """What the paper leaves open, and what was chosen under a reading."""
    return (
        *READINGS[reading].chosen,
        "phi0 of CFDL- and FFDL-MFAILC is not printed: one number was fitted to 4 rows of Table 1, "
        "four numbers to 3 rows, and judged on the others "
        "(experiments/cao_2019_start_values.py); PFDL-MFAILC is not in the paper and has FFDL's "
        "weights",
        "the estimate is reset where its sign turns (mode `sign`); Cao 2019 prints no reset",
        "PID is read in position form with ki multiplied by the sample time",
        "ILC-MFAPC: the learning gains are given the plant's sign, lam = 2 is read as lam / P, "
        f"phi0 = {READINGS[reading].mfapc:g} is fitted to two of its rows",
    )


def start_values(reading: str) -> dict[str, Any]:
    """phi0 by scheme; PFDL-MFAILC has that of CFDL-MFAILC, and no weight on the earlier input."""
    of = READINGS[reading]
    return {
        "cfdl-mfailc": of.cfdl,
        "pfdl-mfailc": (of.cfdl, 0.0),
        "ffdl-mfailc": of.ffdl,
        "ilc-mfapc": of.mfapc,
    }
