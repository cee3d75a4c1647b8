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


def _row(
    setting, scheme, trial, quantity, value, source, reading, *beyond, among=False, at_most=False
) -> Published:
    """A row with a printed number.

    beyond: fits that the row uses besides that of the path
    among: whether they were fitted to this row
    """
    names, to = zip(OF_PATH, *beyond, strict=True)
    fitted = Fit(sum(names, ()), " and ".join(to), among)
    return Published(
        scheme, trial, quantity, value, source, (("setting", setting),), reading, at_most, fitted
    )


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
        "after 8 iterations",
        OF_SIMULATION,
    ),
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
