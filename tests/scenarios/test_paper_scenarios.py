"""The derived numbers of the scenarios MILC 2024 and Xu 2024 give the printed ones."""

import control
import numpy as np
import pytest
from refusals import refused

from jaxilc import scenarios
from jaxilc.scenarios import reproduce
from jaxilc.scenarios.milc_2024 import DT, READINGS, nominal_drive, path, position_gain
from jaxilc.scenarios.xu_2024 import MODEL, servo


@pytest.mark.parametrize("of", READINGS.values(), ids=READINGS)
def test_the_position_loop_is_50_hz_wide(of):
    """The -3 dB frequency of the motor's loop by python-control.

    It has sampled mechanics, backward PI and difference, and a P position loop.
    """
    drive = nominal_drive(of.antiresonance, of.force_gain, of.unit)
    A, B, C = (np.asarray(getattr(drive.mechanics(), name)) for name in "ABC")
    mechanics = control.sample_system(control.ss(A, B, 1e3 * C[:1], 0), DT, "zoh")
    z = control.tf("z")
    speed = control.tf([1, -1], [DT, 0], DT)
    pi = float(drive.speed_gain) + float(drive.speed_integral_gain) * DT * z / (z - 1)
    pi = control.tf(pi.num, pi.den, DT)
    f = np.linspace(45, 55, 2001)
    x, v, controller = (of(np.exp(2j * np.pi * f * DT)) for of in (mechanics, speed, pi))
    # the loop from the deviation of the speed to the position
    forward = float(drive.force_gain) * controller * x
    P_M = float(drive.command_scale) * forward / (1 + forward * v)
    closed = np.abs(position_gain(drive) * P_M / (1 + position_gain(drive) * P_M))
    assert 49.5 < f[np.argmax(closed < np.sqrt(0.5))] < 50.5


@pytest.mark.parametrize("of", READINGS.values(), ids=READINGS)
def test_the_path_rests_moves_forward_and_back(of):
    r = path(of)
    assert len(r) == 4001
    assert np.all(r[:101] == 0)
    assert r.max() == of.stroke
    assert r[-1] == 0.0
    assert np.max(np.abs(np.diff(r))) / DT == pytest.approx(of.velocity, rel=1e-3)
    assert np.max(np.abs(np.diff(r, 2))) / DT**2 < of.acceleration * 1.01


def test_table_1_of_milc_2024():
    rows = reproduce(["milc-2024"])
    assert {row.verdict for row in rows} == {"met"}, "the guide says so"
    ours = {(r.published.scheme, r.published.trial, r.published.quantity): r.ours for r in rows}
    assert ours["dilc", 11, "motor_rms"] > 10 * ours["milc", 11, "motor_rms"]


def test_a_small_stroke_sees_the_identified_gain_of_the_servo():
    """Whatever the hysteresis, 10 mV move the tool by b / a1 per volt, as in identification."""
    tool = servo(0.06)
    static = tool.conversion * tool.amplifier_gain / tool.stiffness
    static *= 1 - tool.hysteresis.initial_slope
    assert float(static) == pytest.approx(MODEL["b"] / MODEL["a1"], rel=1e-3)


def test_tables_of_xu_2024():
    rows = reproduce(["xu-2024"])
    assert {row.verdict for row in rows} == {"met"}, "the guide says so"
    ours = {(r.published.source, r.published.scheme, r.published.quantity): r.ours for r in rows}
    for table in ("Table 1", "Table 2"):
        for quantity in ("settled_error", "settled_rms"):
            assert ours[table, "ilc-asmc", quantity] < ours[table, "asmc", quantity]


REFUSED = {
    "load = -1.0 is outside its allowed range": ("double-mass", {"load": -1.0}),
    "at = 'output' is not one of 'input', 'reference'": ("double-mass", {"at": "output"}),
    "second = 'torque' is not one of": ("double-mass", {"second": "torque"}),
    "setting = 'dream' is not one of": ("li-2020", {"setting": "dream"}),
    "axes = 'z' is not one of": ("li-2020", {"axes": "z"}),
    "form = 'rounded' is not one of": ("li-2020", {"plant": "rounded"}),
    "axis = 'y' is not one of 'x', 'z'": ("milc-2024", {"axis": "y"}),
    "reading = 'short' is unknown.*short-stroke": ("milc-2024", {"reading": "short"}),
    "disturbance = 'loud' is not one of 'none', 'multi'": ("xu-2024", {"disturbance": "loud"}),
    r"load = 50 N is outside its allowed range \[-5, 5\]": ("xu-2024", {"load": 50.0}),
}
test_options_are_refused = refused(REFUSED, lambda given: scenarios.load(given[0], **given[1]))
