"""MILC 2024: the printed numbers, what was fitted to them, and what the paper leaves open.

The paper prints neither the masses and the stiffness of the drive nor the unit of its input, and
the path as a picture. Two readings follow, `READINGS`; `experiments/milc_2024_readings.py` judges
many by the rows they meet against the choices they need, and `experiments/milc_2024_calibration.py`
fits their numbers.
"""

from __future__ import annotations

from typing import NamedTuple

from .published import Fit, Published

TABLE_1 = {
    "dilc": {
        (1, "table_rms"): 201.00,
        (1, "motor_rms"): 204.21,
        (11, "table_rms"): 0.55,
        (11, "motor_rms"): 5.39,
        (11, "table_max"): 3.57,
    },
    "milc": {
        (1, "table_rms"): 196.46,
        (1, "motor_rms"): 199.81,
        (11, "table_rms"): 0.46,
        (11, "motor_rms"): 0.40,
        (11, "table_max"): 2.06,
    },
}
IMPROVEMENT = 42.0  # of the largest error of the table by MILC over DILC, section 5.2 [%]
SEARCH = "experiments/milc_2024_readings.py"


class Reading(NamedTuple):
    """A reading of section 5.

    stroke: of the path [mm]
    velocity, acceleration, jerk: limits of the path [mm/s], [mm/s^2], [mm/s^3]
    dwell: rest between the strokes [s]
    unit: of the input, its velocity for a volt [mm/s]; it decides how the printed weights act
    antiresonance: of the drive [Hz]
    force_gain: the one that makes the motor's position loop 50 Hz wide, -3 dB [N/V]
    noise: standard deviation of the noise on the machine table [mm]
    fitted: what was fitted of these
    to: the printed numbers to which they were fitted, as text
    among: scheme, trial and quantity of these numbers
    """

    stroke: float
    velocity: float
    acceleration: float
    jerk: float
    dwell: float
    unit: float
    antiresonance: float
    force_gain: float
    noise: float
    fitted: tuple[str, ...]
    to: str
    among: tuple[tuple[str, int, str], ...]


OF_DILC = (("dilc", 1, "table_rms"), ("dilc", 11, "table_rms"), ("dilc", 11, "motor_rms"))
READINGS = {
    "long-stroke": Reading(
        stroke=10.0,
        velocity=68.71,
        acceleration=6e3,
        jerk=6e5,
        dwell=0.3,
        unit=50.0,
        antiresonance=77.28,
        force_gain=113.8,
        noise=0.5236e-3,
        fitted=("velocity", "antiresonance", "noise"),
        to="three RMS errors of the DILC row",
        among=OF_DILC,
    ),
    "short-stroke": Reading(
        stroke=5.0,
        velocity=192.0,
        acceleration=12e3,
        jerk=1.2e6,
        dwell=0.49,  # so that the stroke back lies near 0.57, 0.59 and 0.61 s, as the text has it
        unit=12.29,
        antiresonance=119.4,
        force_gain=87.3,
        noise=0.39e-3,
        fitted=("velocity", "antiresonance", "noise", "input unit"),
        to="three RMS errors and the largest of the DILC row, and the table's last RMS error under "
        "MILC",
        among=(*OF_DILC, ("dilc", 11, "table_max"), ("milc", 11, "table_rms")),
    ),
}


def published(reading: str) -> tuple[Published, ...]:
    """The rows of Table 1, and the improvement in section 5.2, under a reading."""
    of = READINGS[reading]

    def row(scheme, trial, quantity, value, source="Table 1", against="") -> Published:
        return Published(
            *(scheme, trial, quantity, value, source, (("axis", "x"), ("reading", reading))),
            f"the paper's trial {trial - 1}",
            fitted=Fit(of.fitted, of.to, (scheme, trial, quantity) in of.among),
            against=against,
            searched=SEARCH,
        )

    of_table = (
        row(scheme, trial, quantity, value)
        for scheme, rows in TABLE_1.items()
        for (trial, quantity), value in rows.items()
    )
    improvement = ("milc", 11, "table_max_improvement", IMPROVEMENT, "section 5.2", "dilc")
    return (*of_table, row(*improvement))


def chosen(reading: str) -> tuple[str, ...]:
    """What the paper leaves open, and what was chosen under a reading."""
    of = READINGS[reading]
    fitted = "fitted" if "input unit" in of.fitted else "chosen"
    return (
        "masses, stiffness, damping and force gain are not printed: 30 kg on each side, 3 % "
        "damping, a torque filter of 350 Hz and a force gain that makes the position loop 50 Hz "
        "wide, as printed; the antiresonance is fitted",
        f"the path is printed as a picture: an S-curve of {of.stroke:g} mm and back at "
        f"{1e-3 * of.acceleration:g} m/s^2 and {1e-3 * of.jerk:g} m/s^3 with {of.dwell:g} s of "
        "rest between; its velocity is fitted",
        "the input's unit is not printed and decides how the weights act: "
        f"{of.unit:g} mm/s per volt, {fitted}",
        "noise is not printed: white, its standard deviation on the table fitted, on the motor's "
        "encoder a third of it, as their steps are",
        "the model knows the drive but for what a model leaves out: the table weighs 10 % more, "
        "friction of 20 N that the look-up table compensates to 90 %, a lead error of 2 µm a "
        "revolution, encoders and converter",
        "the motor's error under MILC is that of the learned reference (eq. 25), under DILC that "
        "of the desired path",
    )
