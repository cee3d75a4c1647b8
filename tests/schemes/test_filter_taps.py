"""Laws from any filter: their taps against python-control, and the error that they leave."""

import dataclasses

import control
import jax
import numpy as np
import pytest
from refusals import refused

from jaxilc import Machine, Task, learn
from jaxilc.filters import (
    SwitchableFilter,
    ZeroPhaseButterworth,
    ZeroPhaseFIR,
    ZeroPhaseIIR,
    stable_inverse,
    zpetc,
)
from jaxilc.plants import StateSpace, from_control
from jaxilc.schemes import (
    PID,
    ErrorFiltered,
    LearningFilter,
    OnReference,
    PIDType,
    WithFeedback,
    learning_filter,
)
from jaxilc.theory import to_control
from jaxilc.theory.law import law_response

DT, N = 1e-3, 60
# y[k+1] = 0.8 y[k] + 0.2 u[k], and a plant whose zero lies outside the unit circle
LAG = StateSpace([[0.8]], [[0.2]], [[1.0]], dt=DT)
OUTSIDE = control.tf([0.5, -0.8], [1.0, -1.1, 0.3], DT)  # zero 1.6, poles 0.6 and 0.5
TASK = Task(np.sin(np.arange(N + 1) / 4.0) ** 3, dt=DT)
FREQUENCIES = np.array([0.0, 3.0, 60.0, 210.0, 480.0])
CIRCLE = np.exp(2j * np.pi * FREQUENCIES * DT)


def errors_of(plant, scheme, trials=5, task=TASK):
    """Return e[1..N] of each trial."""
    machine = Machine(plant if isinstance(plant, StateSpace) else from_control(plant))
    return np.asarray(learn(machine, scheme, task, trials, save=lambda trial: trial.e[1:, 0]).saved)


@pytest.mark.parametrize("kind", ["inverse", "system", "quotient"])
def test_with_the_inverse_of_the_plant_a_fifth_of_the_error_is_left(kind):
    P = control.tf([0.2], [1.0, -0.8], DT)
    law = {
        "inverse": lambda: learning_filter(stable_inverse(LAG), gain=0.8),
        "system": lambda: learning_filter(stable_inverse(P), gain=0.8),
        "quotient": lambda: learning_filter(0.8 / P),
    }[kind]()
    assert (len(law.L), law.lead, law.dt) == (3, 0, DT)
    np.testing.assert_allclose(law.L, [-0.8 * 4, 0.8 * 5, 0.0], rtol=1e-12, atol=1e-12)
    e = errors_of(LAG, law)
    np.testing.assert_allclose(e[1:], 0.2 * e[:-1], rtol=1e-9, atol=1e-13)


@pytest.mark.thorough
def test_a_zero_outside_the_circle_is_inverted_backward_in_time():
    """Far from the start of the trial, which lacks the input before it, a fifth is left."""
    for given in (stable_inverse(OUTSIDE), 1 / OUTSIDE):
        law = learning_filter(given, gain=0.8, tolerance=1e-9)
        late = Task(np.r_[np.zeros(60), TASK.reference[:, 0]], dt=DT)
        e = errors_of(OUTSIDE, law, 3, late)
        np.testing.assert_allclose(e[1:, 60:], 0.2 * e[:-1, 60:], atol=1e-8)
    before = dataclasses.replace(
        stable_inverse(OUTSIDE), advance=stable_inverse(OUTSIDE).advance - 1
    )
    same = errors_of(OUTSIDE, ErrorFiltered(PIDType(gamma_p=0.8), before), 3, late)
    np.testing.assert_allclose(e[:, 60:], same[:, 60:], atol=1e-8)


L = control.tf([0.3, 0.1, -0.2, 0.1], [1.0, -2.0, 0.45], DT)  # poles 0.26 and 1.74, improper
Q = control.tf([0.3], [1.0, -0.7], DT)
IIR = ZeroPhaseIIR((0.0461, 0.0922, 0.0461), (1.0, -1.3073, 0.4918))


@pytest.mark.thorough(but=["lead", "zpetc", "model"])
@pytest.mark.parametrize(
    ("L", "Q", "options", "of_L", "of_Q"),
    [
        (L, Q, {}, L, Q),
        (L, None, {"lead": 3, "gain": 0.5}, lambda z: 0.5 * z**3 * L(z), lambda z: z**0),
        (Q, L, {"lead": -7}, lambda z: z**-7 * Q(z), L),
        (
            stable_inverse(OUTSIDE),
            ZeroPhaseFIR((0.5, 0.25)),
            {},
            lambda z: 1 / OUTSIDE(z),
            lambda z: 0.5 + 0.25 * (z + 1 / z),
        ),
        (
            zpetc(OUTSIDE),
            ZeroPhaseButterworth(80.0),
            {},
            # |B_u|^2 / B_u(1)^2 of the zero 1.6 is what zero phase error tracking leaves
            lambda z: np.abs(z - 1.6) ** 2 / 0.6**2 / OUTSIDE(z),
            lambda z: 1 / (1 + (np.tan(np.angle(z) / 2) / np.tan(np.pi * 80.0 * DT)) ** 4),
        ),
        (0.4, IIR, {"dt": DT}, lambda z: 0.4 * z, lambda z: abs(_iir(z)) ** 2),
        ((0.1, 0.4, -0.2), None, {}, lambda z: 0.1 + 0.4 * z - 0.2 * z**2, lambda z: z**0),
        (LAG, (0.2, 0.5, 0.2), {}, lambda z: 0.2 / (z - 0.8), lambda z: 0.2 / z + 0.5 + 0.2 * z),
    ],
    ids=["system", "lead", "swapped", "inverse", "zpetc", "number", "taps", "model"],
)
def test_its_frequency_response_is_that_of_the_filters(L, Q, options, of_L, of_Q):
    law = learning_filter(L, Q, **options)
    found = law_response(law, Task(np.zeros(801), dt=DT), FREQUENCIES)
    np.testing.assert_allclose(found.keep[:, 0, 0], of_Q(CIRCLE), rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(found.L[:, 0, 0], of_Q(CIRCLE) * of_L(CIRCLE), rtol=1e-8, atol=1e-10)


def _iir(z):
    return np.polyval(IIR.b, z) / np.polyval(IIR.a, z)


@pytest.mark.thorough
def test_it_learns_on_the_input_of_a_feedback_and_on_its_reference():
    machine, feedback = Machine(LAG), PID(kp=2.0)
    for around in (WithFeedback, OnReference):
        loop = to_control(machine, around(PIDType(gamma_p=0.1), feedback), TASK)
        from_learned = control.minreal(control.tf(loop)[0, 0], verbose=False)
        e = errors_of(LAG, around(learning_filter(0.5 / from_learned), feedback))
        # a correction of the reference acts on y two samples later, and so not on the first one;
        # what that leaves falls as the pole of the loop, 0.4^k
        np.testing.assert_allclose(e[1:, 35:], 0.5 * e[:-1, 35:], rtol=1e-8, atol=1e-12)


def test_zero_is_a_law_that_learns_nothing():
    law = learning_filter(0.0, control.tf([1.0], [1.0], DT))
    np.testing.assert_array_equal(law.L, 0.0)
    np.testing.assert_allclose(law.keep, [1.0])


ON_CIRCLE = control.tf([1.0], [1.0, -1.0], DT)
SWITCHED = SwitchableFilter((60.0, 150.0), (0.01,), 0.002)
REFUSED = {
    r"L: its taps do not decay, because the pole z = 1 lies on": lambda: learning_filter(ON_CIRCLE),
    r"L: more than most = 50 taps .* a pole lies 0\.01 from": lambda: learning_filter(
        control.tf([1.0], [1.0, -0.99], DT), most=50
    ),
    r"Q: more than most = 20 taps": lambda: learning_filter(
        1.0, ZeroPhaseButterworth(5.0), most=20, dt=DT
    ),
    r"L = \[1.0, 2.0\] has shape \(2,\); allowed is an odd number": lambda: learning_filter(
        [1.0, 2.0]
    ),
    r"L = \[nan\] has shape": lambda: learning_filter([np.nan]),
    r"L = 'P' is a str; allowed are taps": lambda: learning_filter("P"),
    r"Q: ZeroPhaseButterworth needs dt": lambda: learning_filter(1.0, ZeroPhaseButterworth(50.0)),
    r"Q: SwitchableFilter is another filter at other samples": lambda: learning_filter(
        1.0, SWITCHED, dt=DT
    ),
    r"StableInverse is designed for dt = 0.001 s but dt = 0.002": lambda: learning_filter(
        stable_inverse(LAG), dt=2e-3
    ),
    r"factors: the system is sampled at 0.002 s but dt = 0.001": lambda: learning_filter(
        LAG, control.tf([1.0], [1.0, 0.5], 2e-3)
    ),
    r"factors: the system has 2 inputs": lambda: learning_filter(
        StateSpace(0.5 * np.eye(2), np.eye(2), np.eye(2), dt=DT)
    ),
    r"factors: dt = None is outside": lambda: learning_filter(control.tf([1.0], [1.0, 5.0])),
    r"learning_filter: tolerance = 0 is outside": lambda: learning_filter(1.0, tolerance=0),
    r"learning_filter: lead = 0.5 is outside": lambda: learning_filter(1.0, lead=0.5),
    r"LearningFilter: L = \[nan\]": lambda: learning_filter(1.0, gain=np.nan),
}
test_what_is_no_law_is_refused = refused(REFUSED)


def test_taps_of_another_sample_time_are_refused_by_the_task():
    law = learning_filter(stable_inverse(LAG))
    with pytest.raises(ValueError, match=r"dt = 0.001 s is not that of the task, 0.002 s"):
        law.check(Task(np.zeros(N + 1), dt=2e-3))
    assert jax.tree.leaves(LearningFilter((1.0,)))[0].dtype == float
