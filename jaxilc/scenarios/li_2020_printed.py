"""Li 2020: the printed numbers, what was fitted to them, and what the paper leaves open."""

from __future__ import annotations

from .published import Fit, Published

# The free numbers and the printed ones to which they were fitted. The path is used in every row,
# each other fit in the settings of the same name.
OF_PATH = (("rest before the path", "its speed", "its width"), "four printed samples, Fig. 7")
OF_FEEDFORWARD = (("share of feedforward",), "Fig. 8")
OF_SIMULATION = (("learning gain", "encoder's noise"), "Fig. 14")
OF_DISTURBANCE = (("learning gain",), "Fig. 12")
OF_EXPERIMENT = (("learning gain", "encoder's noise"), "runs 1 and 5 of Fig. 36")


# Section 6.1 calls the machine repeatable within this spread, so that a smaller rise is none.
REPEATABILITY = 0.3  # [µm]
MONOTONE = "monotone: no rise of the RMS beyond the printed repeatability of 0.3 µm"


def _row(
    setting,
    scheme,
    trial,
    quantity,
    value,
    source,
    reading,
    *beyond,
    among=False,
    at_most=False,
    against="",
) -> Published:
    """A row with a printed number.

    beyond: fits that the row uses besides that of the path
    among: whether they were fitted to this row
    against: the scheme with which this one is compared
    """
    names, to = zip(OF_PATH, *beyond, strict=True)
    fitted = Fit(sum(names, ()), " and ".join(to), among)
    options = (("setting", setting),)
    return Published(
        *(scheme, trial, quantity, value, source, options, reading, at_most),
        fitted=fitted,
        against=against,
    )


def _bound(setting, scheme, trial, quantity, value, source, reading, against="") -> Published:
    """A row that is printed as a bound or an order, and to which nothing was fitted."""
    beyond = {"simulation": OF_SIMULATION, "experiment": OF_EXPERIMENT}[setting]
    row = (setting, scheme, trial, quantity, value, source, reading, beyond)
    return _row(*row, at_most=True, against=against)


PUBLISHED = (
    _row("simulation", "feedback", None, "max_error", 60.0, "Fig. 7", "feedback alone", among=True),
    _row(
        "simulation",
        "feedforward",
        None,
        "max_error",
        18.0,
        "Fig. 8",
        "of the speed",
        OF_FEEDFORWARD,
        among=True,
    ),
    _row(
        "simulation",
        "p-type",
        40,
        "best_trial",
        22,
        "Fig. 14",
        "the trial of least RMS",
        OF_SIMULATION,
        among=True,
    ),
    _row(
        "simulation",
        "fixed-filter",
        9,
        "max_error",
        10.0,
        "Fig. 25",
        "after 8 iterations, over the whole path; the paper says that the errors near samples 2915 "
        "and 7576 stay larger",
        OF_SIMULATION,
    )._replace(searched="experiments/li_2020_readings.py"),
    _row(
        "disturbance",
        "p-type",
        40,
        "rms",
        10.0,
        "Fig. 12",
        "after 39 iterations",
        OF_DISTURBANCE,
        among=True,
    ),
    _row(
        "disturbance",
        "p-type",
        100,
        "max_error",
        5.0,
        "section 3.2",
        "the trial is not printed",
        OF_DISTURBANCE,
        at_most=True,
    ),
    *(
        _row(
            "experiment",
            "p-type",
            j,
            "max_error",
            value,
            "Fig. 36",
            f"run {j}",
            OF_EXPERIMENT,
            among=j in (1, 5),
        )
        for j, value in {1: 70.0, 2: 40.0, 3: 20.0, 4: 15.0, 5: 10.0}.items()
    ),
    _row("experiment", "p-type", 4, "rms", 10.0, "Fig. 35", "run 4", OF_EXPERIMENT, at_most=True),
    _row(
        "experiment",
        "p-type",
        30,
        "best_trial",
        6,
        "Fig. 15",
        "the trial of least RMS",
        OF_EXPERIMENT,
    ),
    _bound(
        *("experiment", "feedback", 10, "rms_spread", REPEATABILITY, "Fig. 30"),
        "repeatability over 10 runs under feedback; the 1 µm of Fig. 31 is a weaker bound",
    ),
    _bound("experiment", "p-type", 5, "rms_rise", REPEATABILITY, "Fig. 35", f"{MONOTONE}, 5 runs"),
    _bound("simulation", "fixed-filter", 40, "rms_rise", REPEATABILITY, "Fig. 18", MONOTONE),
    _bound("experiment", "fixed-filter", 30, "rms_rise", REPEATABILITY, "Fig. 41", MONOTONE),
    _bound("experiment", "switchable", 30, "rms_rise", REPEATABILITY, "Fig. 42", MONOTONE),
    _bound(
        *("simulation", "switchable", 9, "max_error_share", 100.0, "Fig. 27"),
        "better than with the fixed filter, read after 8 iterations as in Fig. 25",
        "fixed-filter",
    ),
    _bound(
        *("experiment", "switchable", 3, "rms_share", 100.0, "Fig. 42"),
        '"especially in previous iterations": better than the fixed filter in an early trial, 3',
        "fixed-filter",
    ),
)

CHOSEN = (
    "the path is printed as a picture: the NURBS butterfly of the interpolator papers, planned so "
    "that its sharp points lie at samples "
    "2915, 4788, 5248, 5708 and 7581 (printed: 2915, 5249, 6093, 7576), two numbers fitted; its "
    "width is fitted to the error of 60 µm",
    "the position controller is not printed: proportional 1.66 and derivative 16.9 a sample on "
    "the measured position; speed feedforward "
    "gives the derivative 72 % of the reference's speed",
    "learning gain and noise are not printed and differ between the paper's runs: one or two "
    "numbers fitted in each setting",
    "the repetitive disturbance is half a sine of 0.5 s at the input from sample 625",
    "switching times from the instantaneous frequency of the reference (above 2 Hz); cutoffs 10 "
    "and 50 Hz as printed",
    "the drive's saturation is not printed: 10 units, ten times what the path needs",
)
