"""The CNC axis of Li 2020, its scenario, axes side by side, and learning from a filtered error."""

import dataclasses

import numpy as np
import pytest
import scipy.signal
from cases import ALGEBRA, DT, PLANTS, task_for

from jaxilc import scenarios
from jaxilc.filters import SwitchableFilter, ZeroPhaseButterworth
from jaxilc.learning import Keep, Machine, Sensor, best_trial, learn
from jaxilc.plants import StateSpace, ThreeAxes, TwoAxes, cnc_axis
from jaxilc.schemes import PID, ErrorFiltered, Filtered, OnOutputs, PIDType, WithFeedback
from jaxilc.signals import Task


@pytest.mark.parametrize(
    ("form", "poles"),
    [("printed", (0.8602, 0.9567, 1.0331)), ("double_integrator", (0.85, 1.0, 1.0))],
)
def test_poles_and_first_markov_parameter(form, poles):
    plant = cnc_axis(form)
    found = np.sort(np.linalg.eigvals(plant.A).real)
    np.testing.assert_allclose(found, poles, atol=5e-5 if form == "printed" else 1e-7)
    np.testing.assert_allclose(plant.C @ plant.B, [[0.0475]], **ALGEBRA)
    _, (impulse,) = scipy.signal.dimpulse(
        (np.array([0.0475, 0, -0.0047475]), np.poly(np.linalg.eigvals(plant.A)).real, 2e-3), n=8
    )
    markov = [(plant.C @ np.linalg.matrix_power(plant.A, k) @ plant.B)[0, 0] for k in range(7)]
    np.testing.assert_allclose(impulse[1:, 0], markov, rtol=1e-9)


@pytest.mark.thorough
@pytest.mark.parametrize("axes", [TwoAxes, ThreeAxes])
def test_axes_are_machines_of_their_own(axes):
    one, other = PLANTS["arx"], StateSpace([[0.8]], [[0.3]], [[1.0]], dt=DT)
    plants = (one, other) if axes is TwoAxes else (other, one, other)
    scheme, task = (
        WithFeedback(PIDType(gamma_p=0.5), PID(kp=0.4, ki=3.0)),
        task_for(axes(*plants), 40),
    )
    both = learn(Machine(axes(*plants)), scheme, task, 5, save=Keep(("y", "u"))).saved
    for i, plant in enumerate(plants):
        alone = Task(task.reference[:, i], dt=DT)
        single = learn(Machine(plant), scheme, alone, 5, save=Keep(("y", "u"))).saved
        for name in ("y", "u"):
            np.testing.assert_allclose(both[name][..., i], single[name][..., 0], **ALGEBRA)


@pytest.mark.thorough
def test_learning_from_a_filtered_error():
    """It is u_{j+1}[k] = u_j[k] + gamma (F e_j)[k+1] with scipy's zero-phase filter F."""
    task, cutoff, gamma = task_for(PLANTS["arx"], 80), 60.0, 0.4
    scheme = ErrorFiltered(PIDType(gamma_p=gamma), ZeroPhaseButterworth(cutoff, padding=9))
    found = learn(Machine(PLANTS["arx"]), scheme, task, 4, save=Keep(("e", "u"))).saved
    sections = scipy.signal.butter(2, cutoff, fs=1 / DT, output="sos")
    for j in range(3):
        filtered = scipy.signal.sosfiltfilt(sections, np.asarray(found["e"])[j, :, 0])
        np.testing.assert_allclose(
            found["u"][j + 1, :, 0], found["u"][j, :, 0] + gamma * filtered[1:], atol=1e-9
        )


def test_the_filter_of_the_error_is_checked():
    with pytest.raises(
        ValueError, match=r"cutoff = 600 Hz is outside its allowed range \(0, 500\)"
    ):
        learn(
            Machine(PLANTS["arx"]),
            ErrorFiltered(PIDType(gamma_p=0.4), ZeroPhaseButterworth(600.0)),
            task_for(PLANTS["arx"], 80),
            1,
        )


@pytest.fixture(scope="module")
def s():
    return scenarios.load("li-2020", setting="experiment")


def test_the_path_has_its_sharp_points_where_it_says(s):
    """At its sharp points the path is slowest, because the planner brakes there."""
    path = np.asarray(scenarios.load("li-2020", axes="xy").task.reference)
    speed = np.linalg.norm(np.diff(path, axis=0), axis=1)
    slow = [
        k
        for k in range(600, len(speed) - 100)
        if speed[k] == speed[k - 100 : k + 101].min() and speed[k] < 0.5 * speed.max()
    ]
    np.testing.assert_allclose(slow, [2915, 4788, 5708, 7581], atol=3)


@pytest.mark.thorough
def test_noise_turns_the_error_and_a_filter_does_not_let_it(s):
    """This is the paper's observation, on two seconds of its path."""
    short = dataclasses.replace(
        s.task, reference=s.task.reference[2400:3401] - s.task.reference[2400], settle=None
    )
    machine = dataclasses.replace(s.machine, sensor=Sensor(noise=1.1e-3))
    law = PIDType(gamma_p=1.0)
    feedback = s.schemes["feedback"]
    rms = {
        name: np.asarray(learn(machine, WithFeedback(learning, feedback), short, 25).rms)[:, 0]
        for name, learning in (
            ("none", law),
            ("fixed", ErrorFiltered(law, ZeroPhaseButterworth(10.0))),
        )
    }
    assert best_trial(rms["none"][:, None])[-1] < 12
    assert rms["none"][-1] > 4 * rms["none"].min()
    assert rms["fixed"][-1] < 1.3 * rms["fixed"].min()


def test_the_switchable_filter_of_the_scenario(s):
    found = s.schemes["switchable"].learning.filter
    assert isinstance(found, SwitchableFilter)
    assert set(np.asarray(found.cutoff)) == {10.0, 50.0}
    for sharp in (2915, 7581):
        assert found.cutoff[np.searchsorted(found.times, sharp * s.task.dt)] == 50.0


@pytest.mark.thorough
def test_the_limit_of_a_law_that_sees_some_outputs_holds_behind_a_filter():
    plant = PLANTS["motor_and_table"]
    scheme = Filtered(OnOutputs(PIDType(gamma_p=3.0, limit=0.4), (1,)), ZeroPhaseButterworth(150.0))
    found = learn(Machine(plant), scheme, task_for(plant, 60), 6, save=Keep(("u",))).saved["u"]
    assert np.max(np.abs(found)) == pytest.approx(0.4)
