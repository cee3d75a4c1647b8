"""Certificates against simulation: what is certified never grows, what is predicted to turn turns there."""

from dataclasses import replace

import numpy as np
import pytest

import jaxilc
from jaxilc import Actuator, Machine, Task, Uniform, tables
from jaxilc.filters import ZeroPhaseButterworth
from jaxilc.plants import DifferenceEquation, StateSpace
from jaxilc.schemes import CFDLMFAILC, PID, Filtered, PIDType, WithFeedback
from jaxilc.theory import certify, premises
from jaxilc.theory.certificates import frozen
from jaxilc.uncertainty import draw

DT, N = 1e-3, 100
TASK = Task(reference=0.5 - 0.5 * np.cos(2 * np.pi * np.arange(N + 1) / N), dt=DT)
W = 2 * np.pi * 60.0
SERVO = Machine(StateSpace([[0.0, 1.0], [-W * W, -1.4 * W]], [[0.0], [W * W]], [[1.0, 0.0]]))
FIRST_ORDER = Machine(DifferenceEquation((0.7,), (0.3,), dt=DT))
GAIN = {"plant.B": Uniform(0.8, 1.2, relative=True)}
B = {"plant.b": Uniform(0.5, 1.5, relative=True)}


def certified(machine, scheme, trials, uncertainty, samples=6):
    return certify(machine, scheme, TASK, trials, uncertainty, draw(machine, uncertainty, samples))


def titled(found):
    return tables.certificate_tables("scheme", 10, tables.certificate_figures(found, None, 1.0))[0].title


def dense_error_map(machine, gain):
    """I - gain G with G the Toeplitz matrix of Markov parameters, from the impulse response by hand."""
    a, b = float(machine.plant.a[0]), float(machine.plant.b[0])
    g = b * a ** np.arange(N)
    return np.eye(N) - gain * np.array([[g[i - j] if i >= j else 0.0 for j in range(N)] for i in range(N)])


def test_a_monotone_case_is_certified_with_the_dense_singular_value_and_never_grows():
    found = certified(FIRST_ORDER, PIDType(gamma_p=0.8), 15, B)
    assert found.linear
    assert set(found.verdict) == {"monotone"}
    assert set(found.observed_verdict) == {"monotone"}
    assert not len(found.broken_promises())
    np.testing.assert_allclose(found.sigma[0], np.linalg.norm(dense_error_map(FIRST_ORDER, 0.8), 2), rtol=1e-3)
    assert np.all(found.sigma < 1)
    ratio = found.observed[:, 1:] / found.observed[:, :-1]
    assert np.all(ratio <= found.sigma[:, None] + found.doubt[:, None])
    np.testing.assert_allclose(found.predicted, found.observed, rtol=1e-12)


def test_nothing_certified_monotone_grows_whatever_is_drawn():
    wide = {"plant.a": Uniform(0.2, 1.3, relative=True), "plant.b": Uniform(0.1, 8.0, relative=True)}
    scheme = WithFeedback(PIDType(gamma_p=0.8), PID(kp=0.1))
    found = certified(FIRST_ORDER, scheme, 12, wide, samples=64)
    assert not len(found.broken_promises())
    assert 10 <= np.sum(found.verdict == "monotone") <= 54, "some are certified and some are not, or the test says nothing"


@pytest.mark.parametrize("scheme", [Filtered(PIDType(gamma_p=0.8), ZeroPhaseButterworth(100.0)), PIDType(gamma_p=0.8, leak=0.1)])
def test_where_an_error_is_left_over_nothing_is_certified(scheme):
    """With a filter or a leak the distance from a limit falls, not the error itself."""
    found = certified(FIRST_ORDER, scheme, 12, B)
    assert np.all(found.left_over > 1e-6)
    assert "monotone" not in set(found.verdict)


def test_a_wrong_sign_is_predicted_to_diverge_and_does():
    found = certified(FIRST_ORDER, PIDType(gamma_p=-0.8), 15, B)
    assert set(found.verdict) == set(found.observed_verdict) == {"diverges"}
    assert np.all(found.turning == 1)


def test_semi_convergence_is_predicted_with_its_turning_trial():
    found = certified(SERVO, CFDLMFAILC(lam=1.0, phi0=0.5, eta=0.01, reset="sign"), 100, GAIN)
    assert not found.linear
    assert found.verdict[0] == found.observed_verdict[0] == "semi-converges"
    assert np.all(np.abs(found.turning - found.observed_turning) <= 3)
    assert np.all(found.sigma > 1)
    assert sum(sum(row.values()) for row in found.confusion().values()) == 6


def test_an_adaptive_scheme_is_never_certified_monotone():
    found = certified(FIRST_ORDER, CFDLMFAILC(lam=1.0, phi0=0.3, reset="sign"), 10, B)
    assert np.all(found.sigma < 1)
    assert "monotone" not in set(found.verdict)
    assert "estimates frozen at their start" in titled(found)


def test_what_is_not_linear_is_predicted_and_never_certified():
    """One law, where the limit of the input is never met and where it is."""
    scheme = PIDType(gamma_p=0.8)
    out_of_reach = replace(FIRST_ORDER, actuator=Actuator(limit=1e3))
    assert set(certified(out_of_reach, scheme, 10, B).verdict) == {"monotone"}
    found = certified(replace(FIRST_ORDER, actuator=Actuator(limit=0.3)), scheme, 10, B)
    assert not found.linear
    assert np.all(found.departure > 1e-3)
    assert "monotone" not in set(found.verdict)
    assert "not linear in an error" in titled(found)


def test_frozen_stops_every_estimator_and_leaves_the_rest():
    scheme = WithFeedback(CFDLMFAILC(lam=2.0, eta=0.7), PID(kp=1.0))
    assert float(frozen(scheme).learning.eta) < 1e-20
    assert float(frozen(scheme).learning.lam) == 2.0
    linear = WithFeedback(PIDType(gamma_p=1.0), PID(kp=1.0))
    assert frozen(linear) is linear


def test_premises_are_counted_over_machines():
    drawn = draw(FIRST_ORDER, B, 5)
    scheme = CFDLMFAILC(lam=1.0, phi0=0.3, reset="sign")
    shares, bound = premises(FIRST_ORDER, scheme, TASK, 8, B, drawn, chunk=2)
    assert sum(bound.values()) == 5
    alone = jaxilc.learn(FIRST_ORDER, scheme, TASK, 8, save=lambda trial: (trial.y, trial.u)).saved
    of_nominal = jaxilc.theory.cfdl_bounds(scheme, TASK, *alone).condition.premises
    assert [p.name for p in shares] == [p.name for p in of_nominal]
    assert all(0 <= p.held <= 5 and 0 <= p.share_broken <= 1 for p in shares)


@pytest.mark.parametrize("scheme", [PIDType(gamma_p=(1.0, 2.0)), PIDType(lead=N)])
def test_what_does_not_fit_is_named(scheme):
    with pytest.raises(ValueError, match="PIDType"):
        certified(FIRST_ORDER, scheme, 5, B)
