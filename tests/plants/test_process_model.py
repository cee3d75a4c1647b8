"""A dead time of the process model is compared with scipy.signal and with the shifted input."""

import numpy as np
import pytest
import scipy.signal

from jaxilc.plants import ProcessModel, to_control
from jaxilc.plants.process_model import samples_of

DT = 1e-3
LAGS = {"gain": 2.0, "zeros": (-300.0,), "poles": (60.0,), "frequencies": (200.0,)}


def model(delay):
    return ProcessModel(**LAGS, dampings=(0.3,), delay=delay)


def simulated(plant, u):
    """The output by a NumPy loop over the matrices of the sampled plant."""
    system = plant.sampled(DT)
    A, B, C = (np.asarray(M) for M in (system.A, system.B, system.C))
    x, y = np.zeros(len(A)), []
    for value in u:
        y.append(C[0] @ x)
        x = A @ x + B[:, 0] * value
    return np.array(y)


@pytest.mark.parametrize("samples", [0.0, 1.0, 3.0, 0.25, 2.6])
def test_the_delayed_output_is_that_of_scipy(samples):
    """The input is held over each sample, so it is held over parts of a fine grid, exactly."""
    fine, u = 20, np.random.default_rng(1).normal(size=60)
    num, den = (
        2.0 * np.array([1 / 300.0, 1.0]),
        np.polymul([1 / 60.0, 1.0], [1 / 4e4, 0.6 / 200, 1]),
    )
    A, B, C, D, _ = scipy.signal.cont2discrete(
        scipy.signal.tf2ss(num, den), DT / fine, method="zoh"
    )
    late = np.r_[np.zeros(round(samples * fine)), np.repeat(u, fine)][: fine * len(u)]
    y = scipy.signal.dlsim((A, B, C, D, DT / fine), late)[1][::fine, 0]
    found = simulated(model(samples * DT), u)
    np.testing.assert_allclose(found, y, atol=1e-10 * np.max(abs(y)))


def test_a_delay_has_no_continuous_state_space():
    assert model(0.0).continuous() is not None
    assert model(DT).continuous() is None
    assert model(2.5 * DT).regrouped().delay == 2.5 * DT
    with pytest.raises(ValueError, match="no form in continuous time"):
        to_control(model(3 * DT))
    assert to_control(model(3 * DT), DT).nstates == 6


def test_whole_samples_and_the_largest_delay():
    assert samples_of(0.1 + 0.2, 0.1) == (3, 0.0)
    whole, rest = samples_of(2.5 * DT, DT)
    assert (whole, pytest.approx(0.5 * DT)) == (2, rest)
    with pytest.raises(ValueError, match=r"delay = 2 s is 2000 samples of 0.001 s; allowed are at"):
        model(2.0).sampled(DT)
    with pytest.raises(ValueError, match=r"delay = -0.1 is outside"):
        model(-0.1)
