"""The dead time is found on records that NumPy makes from a sampled lag and a shifted input."""

import numpy as np
import pytest

from jaxilc.identification import Record, grow, identify, orders_and_delays
from jaxilc.identification.estimation import later
from jaxilc.identification.grown import first_lag

DT = 1e-3


def record(delay, noise=0.01, samples=400, pole=200.0, held=0.0, each=1):
    """A lag of gain 3 whose input comes `delay` samples late, with noise at its output.

    held: input that it rests at before the record;  each: samples for which a new one is held
    """
    rng, a = np.random.default_rng(delay), np.exp(-pole * DT)
    u = held + np.repeat(rng.choice([-1.0, 1.0], size=samples), each)[:samples]
    x = np.full(samples + 1, 3.0 * held)
    late = np.r_[np.full(delay, held), u][:samples]
    for k in range(samples):
        x[k + 1] = a * x[k] + 3.0 * (1 - a) * late[k]
    return Record(u[:, None], (x + noise * rng.normal(size=samples + 1))[:, None], DT)


@pytest.mark.parametrize("delay", [0, 1, 7])
def test_the_first_answer_tells_the_delay(delay):
    one = record(delay)
    assert first_lag(one, 20) == delay
    twice = Record(np.tile(one.u, (2, 1)), np.tile(one.y, (2, 1)), DT, trials=2)
    assert first_lag(twice, 20) == delay


@pytest.mark.parametrize(
    ("delay", "of"), [(1, {}), (4, {"noise": 0.3, "pole": 60.0, "held": 100.0, "each": 10})]
)
def test_a_delay_is_found_wherever_the_machine_rests_and_is_no_direct_term(delay, of):
    """A direct term was cheaper than 1; at a place that is not 0, 4 were 2 and one more pole."""
    chosen = grow(record(delay, **of)).chosen
    assert (chosen.order, chosen.delay, chosen.direct) == (1, delay, False)


def test_without_an_answer_there_is_no_delay():
    rng = np.random.default_rng(3)
    assert first_lag(Record(rng.normal(size=(300, 1)), rng.normal(size=(301, 1)), DT), 20) == 0
    assert first_lag(Record(np.ones((3, 1)), np.ones((4, 1)), DT)) == 0
    assert first_lag(Record(np.zeros((100, 1)), np.zeros((101, 1)), DT)) == 0


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
