"""Cao 2019: the printed numbers, what was fitted to them, and what the paper leaves open.

The paper says "amplitude 1 mm" and, two sentences later, "stroke 1 mm" of the same motion, prints
no reset of the estimates and no start values, and names no window for its steady-state errors.
Two readings follow, `READINGS`. `experiments/cao_2019_readings.py` judges them, and many others,
by the rows they meet against the choices they need.
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

    said: the motion in words
    settled_from: eighths of the trial after which its errors count as settled
    windows: quantity by scheme whose steady-state error is read off from another sample on, and
        the eighths of the trial after which it is
    reset: reset of the estimates of MFAILC, see `reset_estimate`
    lam: lam of ILC-MFAPC
    phi0: start value by scheme [mm/V]
    """

    said: str
    settled_from: int
    windows: dict[str, tuple[str, int]]
    reset: str
    lam: float
    phi0: dict[str, Any]


READINGS = {
    "amplitude": Reading(
        "sine of amplitude 1 mm",
        settled_from=4,
        windows={},
        reset="sign",
        lam=20.0,
        phi0={
            "cfdl-mfailc": -0.0682,
            "pfdl-mfailc": (-0.0682, 0.0),
            "ffdl-mfailc": (0.753, -0.0547, -0.0811, 0.498),
            "ilc-mfapc": -0.00064,
        },
    ),
    "stroke": Reading(
        "0.5 (1 - cos) mm, a stroke of 1 mm",
        settled_from=5,
        windows={
            "pid": ("three_quarters", 2),
            "ffdl-mfailc": ("three_quarters", 2),
            "ilc-mfapc": ("seven_eighths", 1),
        },
        reset="none",
        lam=2.0,
        phi0={
            "cfdl-mfailc": -0.02934,
            "pfdl-mfailc": (-0.02934, 0.0),
            "ffdl-mfailc": (-0.6744, 0.9411, -0.06383, 0.1644),
            "ilc-mfapc": -4.845e-05,
        },
    ),
}
PID_READING = "ki multiplied by the sample time"


def published(reading: str) -> tuple[Published, ...]:
    """The rows of the paper under a reading."""
    options = (("plant", "printed"), ("reading", reading))

    def row(scheme, trial, quantity, value, source, how, fitted) -> Published:
        if quantity == "steady state":
            quantity, eighths = READINGS[reading].windows.get(
                scheme, ("settled_error", READINGS[reading].settled_from)
            )
            how = f"{how}; {READINGS[reading].said}; from {eighths}/8 of the trial on"
        searched = SEARCH if scheme != "pid" else ""
        return Published(
            *(scheme, trial, quantity, value, source, options, how),
            fitted=fitted,
            searched=searched,
        )

    steady, whole = "steady state", "over the whole trial, its start included"
    of_table = [
        row(scheme, j, steady, value, "Table 1", _how(reading, scheme, j), _fit(scheme, j))
        for scheme, by_trial in TABLE_1.items()
        for j, value in by_trial.items()
    ]
    of_text = (
        ("cfdl-mfailc", 35, "max_error", 10.0, "section IV-A", whole, _fit("cfdl-mfailc", 35)),
        ("pid", None, "max_error", 30.0, "section IV-C", PID_READING, NOTHING),
        ("pid", None, steady, 23.0, "section IV-C", PID_READING, NOTHING),
    )
    return (*of_table, *(row(*one) for one in of_text))


def _how(reading: str, scheme: str, trial: int) -> str:
    of = READINGS[reading]
    lam = "" if of.lam == 2.0 else "; lam read as lam / P"
    how = (
        f"gains take the plant's sign{lam}"
        if scheme == "ilc-mfapc"
        else f"eq. 29's plant; reset `{of.reset}`"
    )
    return f'"no change" after {NO_CHANGE[scheme]}; {how}' if trial > NO_CHANGE[scheme] else how


def _fit(scheme: str, trial: int) -> Fit:
    names = tuple(f"phi0[{i}]" for i in range(4)) if scheme == "ffdl-mfailc" else ("phi0",)
    to = f"its rows of Table 1 at trials {', '.join(map(str, FITTED[scheme]))}"
    return Fit(names, to, trial in FITTED[scheme])


def chosen(reading: str) -> tuple[str, ...]:
    """What the paper leaves open, and what was chosen under a reading."""
    of = READINGS[reading]
    others = ", ".join(f"{eighths}/8 for {name}" for name, (_, eighths) in of.windows.items())
    windows = f"from {of.settled_from}/8 of the trial on" + f" ({others})" * bool(others)
    return (
        f"the motion is read as {of.said}, a steady-state error as max |e| {windows}",
        "phi0 of CFDL- and FFDL-MFAILC is not printed: one number was fitted to 4 rows of Table 1, "
        "four numbers to 3 rows, and judged on the others; PFDL-MFAILC is not in the paper and has "
        "FFDL's weights",
        f"the estimate is reset with the mode `{of.reset}`; Cao 2019 prints no reset",
        "PID is read in position form with ki multiplied by the sample time",
        "ILC-MFAPC: the learning gains are given the plant's sign, lam = 2 is read as "
        f"{'printed' if of.lam == 2.0 else 'lam / P'}, phi0 = {of.phi0['ilc-mfapc']:g} is fitted "
        "to two of its rows",
    )
