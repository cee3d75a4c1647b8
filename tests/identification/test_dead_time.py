"""The dead time is found on records that NumPy makes from a sampled lag and a shifted input."""

import numpy as np
import pytest

from jaxilc.identification import Record, grow, identify, orders_and_delays
from jaxilc.identification.estimation import later
from jaxilc.identification.grown import first_lag

DT = 1e-3


def record(delay, noise=0.01, samples=400, pole=200.0):
    """A lag of gain 3 whose input comes `delay` samples late, with noise at its output."""
    rng, a = np.random.default_rng(delay), np.exp(-pole * DT)
    u, x = rng.choice([-1.0, 1.0], size=samples), np.zeros(samples + 1)
    late = np.r_[np.zeros(delay), u][:samples]
    for k in range(samples):
        x[k + 1] = a * x[k] + 3.0 * (1 - a) * late[k]
    return Record(u[:, None], (x + noise * rng.normal(size=samples + 1))[:, None], DT)


@pytest.mark.parametrize("delay", [0, 1, 7])
def test_the_first_answer_tells_the_delay(delay):
    one = record(delay)
    assert first_lag(one, 20) == delay
    twice = Record(np.tile(one.u, (2, 1)), np.tile(one.y, (2, 1)), DT, trials=2)
    assert first_lag(twice, 20) == delay


def test_without_an_answer_there_is_no_delay():
    rng = np.random.default_rng(3)
    assert first_lag(Record(rng.normal(size=(300, 1)), rng.normal(size=(301, 1)), DT), 20) == 0
    assert first_lag(Record(np.ones((3, 1)), np.ones((4, 1)), DT)) == 0
    assert first_lag(Record(np.zeros((100, 1)), np.zeros((101, 1)), DT)) == 0


@pytest.mark.thorough
def test_a_fixed_delay_is_in_the_plant_and_not_in_the_poles():
    found = identify(record(4), poles=1, pairs=0, zeros=0, delay=4, starts=16)
    assert found.plant.delay == pytest.approx(4 * DT, rel=1e-12)
    assert found.white
    for name, true in (("gain", 3.0), ("poles[0]", 200.0)):
        value, low, high = found.parameters[name]
        assert low < value < high
        assert abs(value - true) < 3 * (high - value)
        assert high - low < 0.05 * true


def test_the_delay_is_a_shift_of_the_input():
    u = np.arange(6.0)[:, None]
    moved = later(Record(u, np.zeros((7, 1)), DT), 2).u[:, 0]
    np.testing.assert_array_equal(moved, [0, 0, 0, 1, 2, 3])
    of_each = later(Record(u, np.zeros((8, 1)), DT, 2), 2).u[:, 0]
    np.testing.assert_array_equal(of_each, [0, 0, 0, 0, 0, 3])
    with pytest.raises(ValueError, match=r"delay = 6 samples is outside .* \[0, 6\)"):
        later(Record(u, np.zeros((7, 1)), DT), 6)
    with pytest.raises(ValueError, match="delay = -1 is outside"):
        identify(record(0), delay=-1)
    with pytest.raises(ValueError, match=r"delay = 280 is outside .* \[0, 279\] .* this record"):
        grow(record(0), delay=280)  # of 281 samples that are fitted
    with pytest.raises(ValueError, match="longest = 2000 is outside"):
        grow(record(0), longest=2000)


def test_the_earlier_name_still_compares_structures():
    with pytest.warns(FutureWarning, match="orders_and_delays is now grow"):
        found = orders_and_delays(record(3), longest=5, structures=((1, 0, 0),), starts=16)
    assert [(one.poles, one.pairs, one.zeros, one.delay) for one in found] == [(1, 0, 0, 3)]
