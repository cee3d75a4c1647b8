"""Worst cases are searched, and compared with closed forms and with random search.

The worst case is at the end or in the middle of a range. The search never leaves the given set.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from cases import ALGEBRA
from scipy.stats import norm

from jaxilc.learning import Disturbance, Machine, learn
from jaxilc.plants import StateSpace
from jaxilc.pytree import leaf, pytree
from jaxilc.schemes import PID, ModelFreeGradient, PIDType
from jaxilc.signals import Task
from jaxilc.tuning import Tuning, monte_carlo_search, worst_case_search
from jaxilc.tuning.objectives import Final, judge
from jaxilc.tuning.worst_case import GRADIENT_COST, worst_machine
from jaxilc.uncertainty import LogUniform, Normal, Uniform

N = 40
TIME = 2 * np.pi * np.arange(N + 1) / N
TASK = Task(np.sin(TIME), dt=1e-3)
STATIC = Machine(StateSpace([[0.0]], [[1.0]], [[1.0]], dt=1e-3))  # y[k+1] = u[k]
PASSIVE = PID(kp=0.0)


@pytree
class Numbers:
    """The class has leaves with names."""

    x: object = leaf()


@pytest.mark.thorough
def test_the_worst_gain_of_p_type_learning_is_an_end_of_its_range():
    # e_5 = (1 - 0.9 g)^4 r is worst at that end of the range that is farther from 1 / 0.9, which is
    # the low one.
    gains = {"plant.B": Uniform(0.5, 1.4, relative=True)}
    found = worst_case_search(
        lambda machine: learn(machine, PIDType(gamma_p=0.9), TASK, 5).rms[-1, 0], STATIC, gains,
        starts=4, steps=12,
    )  # fmt: skip
    assert found.values == {"plant.B": 0.5}
    np.testing.assert_allclose(found.loss, 0.55**4 * np.sqrt(0.5), rtol=1e-12)
    # Both starts find it: the centre, where e_5 falls with the gain, and a start above 1 / 0.9.
    assert found.found[0] == found.loss
    again = worst_case_search(
        lambda machine: judge(machine, PIDType(gamma_p=0.9), TASK, 5, Final("rms")), found.subject,
        gains, starts=2, steps=12,
    )  # fmt: skip
    np.testing.assert_allclose(again.subject.plant.B, 0.25)


@pytest.mark.thorough
def test_the_worst_phase_of_a_disturbance_is_inside_its_range():
    # With y = 0.3 sin(t + phase) and r = sin(t), the largest rms is that of opposite phase,
    # (1 + 0.3) / sqrt(2).
    def loss(subject):
        output = 0.3 * jnp.sin(jnp.asarray(TIME) + subject["phase"].x)
        machine = Machine(subject["plant"], disturbance=Disturbance(output=output[:, None]))
        return learn(machine, PASSIVE, TASK, 1).rms[-1, 0]

    subject = {"plant": STATIC.plant, "phase": Numbers(0.5)}
    found = worst_case_search(loss, subject, {"phase.x": Uniform(0.0, 6.0)}, starts=3, steps=40)
    np.testing.assert_allclose(found.values["phase.x"], np.pi, atol=1e-4)
    np.testing.assert_allclose(found.loss, 1.3 * np.sqrt(0.5), rtol=1e-8)
    np.testing.assert_array_equal(loss(found.subject), found.loss)
    assert np.all(np.diff(found.best) >= 0)


def test_a_linear_quadratic_case_has_its_worst_initial_state_at_the_far_end():
    # |y|^2 of the free response is x0^T P x0. It is convex, so its maxima are at corners, and
    # several of them are local.
    A, C = np.array([[0.9, 0.2], [-0.3, 0.7]]), np.array([[1.0, 0.0]])
    machine = Machine(StateSpace(A, [[0.0], [1.0]], C, x0=(0.1, 0.1), dt=1e-3))
    task = Task(np.zeros(N + 1), dt=1e-3)
    box = {"plant.x0[0]": Uniform(-1.0, 0.8), "plant.x0[1]": Uniform(-0.7, 1.5)}
    found = worst_case_search(
        lambda machine: learn(machine, PASSIVE, task, 1).rms[-1, 0] ** 2, machine, box, starts=12,
        steps=15,
    )  # fmt: skip
    observed = np.stack([(C @ np.linalg.matrix_power(A, k))[0] for k in range(1, N + 1)])
    corners = {(a, b): np.mean((observed @ [a, b]) ** 2) for a in (-1.0, 0.8) for b in (-0.7, 1.5)}
    assert tuple(found.values.values()) == max(corners, key=corners.get)
    np.testing.assert_allclose(found.loss, max(corners.values()), **ALGEBRA)


@pytest.mark.thorough
def test_every_constraint_is_respected_in_every_step():
    box = {
        "x[0]": Uniform(-2.0, 1.0),
        "x[1]": LogUniform(0.1, 10.0),
        "x[2]": Normal(1.0, 0.5),
        "x[3]": Uniform(0.5, 2.0),
    }
    low, high = np.array([-2.0, 0.1, 0.0, 0.5]), np.array([1.0, 10.0, 2.0, 2.0])

    def loss(subject):
        outside = jnp.any((subject.x < low * (1 - 1e-12)) & (subject.x < low)) | jnp.any(
            subject.x > high * (1 + 1e-12)
        )
        return jnp.where(outside, 1e9, jnp.sum(subject.x))

    subject = Numbers((0.0, 1.0, 1.0, 1.0))
    found = worst_case_search(loss, subject, box, starts=5, steps=20)
    np.testing.assert_allclose(list(found.values.values()), high)
    assert monte_carlo_search(loss, subject, box, 500).loss < found.loss < 1e9


def test_climbing_beats_chance_at_equal_cost():
    # The peak is smooth, in eight dimensions, and away from the centre and from every axis, so a
    # random search hardly comes near it.
    at = np.array([0.3, 0.8, 0.2, 0.9, 0.6, 0.1, 0.7, 0.4])

    def loss(subject):
        d = subject.x - at
        return jnp.exp(-jnp.sum(d**2) - 0.5 * jnp.sum(d[1:] * d[:-1]))

    box = {f"x[{i}]": Uniform(0.0, 1.0) for i in range(8)}
    found = worst_case_search(loss, Numbers(np.full(8, 0.5)), box, starts=4, steps=40)
    chance = monte_carlo_search(loss, Numbers(np.full(8, 0.5)), box, found.evaluations)
    assert found.evaluations == chance.evaluations == 4 * 40 * (1 + GRADIENT_COST)
    np.testing.assert_allclose(found.loss, 1.0, rtol=1e-6)
    assert chance.loss < 0.95
    np.testing.assert_array_equal(loss(chance.subject), chance.loss)
    np.testing.assert_allclose(chance.best, np.maximum.accumulate(chance.found))


def test_what_is_not_finite_is_neither_worst_nor_in_the_way():
    def loss(subject):
        return jnp.where(
            subject.x[0] > 0.8, jnp.nan, jnp.sqrt(jnp.abs(subject.x[0] - 0.2)) + subject.x[1]
        )

    box = {"x[0]": Uniform(0.0, 1.0), "x[1]": Uniform(0.0, 1.0)}
    found = worst_case_search(loss, Numbers((0.5, 0.5)), box, starts=6, steps=40)
    assert np.isfinite(found.loss)
    assert found.values["x[1]"] == 1.0
    np.testing.assert_allclose(found.values["x[0]"], 0.8, atol=0.02)
    with pytest.raises(ValueError, match="none of 2 losses is finite"):
        worst_case_search(lambda s: jnp.nan * s.x[0], Numbers((0.5, 0.5)), box, starts=2, steps=1)


@pytest.mark.parametrize(
    ("box", "options", "message"),
    [
        ({}, {}, "uncertainty is empty"),
        ({"y": Uniform(0, 1)}, {}, r"uncertainty: 'y' is not a parameter here; known: x"),
        ({"x": Uniform(0, 1)}, {"starts": 0},
         r"starts = 0 is outside its allowed range \[1, inf\)"),
        ({"x": Uniform(0, 1)}, {"steps": 0}, r"steps = 0 is outside its allowed range \[1, inf\)"),
    ],
)  # fmt: skip
def test_bad_input_is_named(box, options, message):
    with pytest.raises(ValueError, match=message):
        worst_case_search(lambda s: s.x, Numbers(0.5), box, **options)


@pytest.mark.parametrize("box", [{}, {"x": Uniform(0.0, 1.0)}])
def test_a_search_by_chance_is_called_by_its_name(box):
    with pytest.raises(ValueError, match=r"monte_carlo_search: (uncertainty|none of 2 losses)"):
        monte_carlo_search(lambda s: jnp.nan * s.x, Numbers(0.5), box, 2)


def test_a_box_that_leaves_the_range_of_a_leaf_is_refused():
    with pytest.raises(ValueError, match=r"leak = 1.2 is outside its allowed range \[0, 1\)"):
        worst_case_search(lambda s: s.leak, PIDType(), {"leak": Uniform(0.1, 1.2)})
    with pytest.raises(ValueError, match=r"evaluations = 0"):
        monte_carlo_search(lambda s: s.leak, PIDType(), {"leak": Uniform(0.1, 0.2)}, 0)


@pytest.mark.parametrize(
    ("counts", "message"),
    [
        ({"starts": 0, "evaluations": 9}, r"starts = 0 is outside its allowed range \[1, inf\)"),
        ({"starts": 2, "evaluations": 7}, r"evaluations = 7 .* allowed range \[8, inf\)"),
        ({"draws": 0}, r"draws = 0 is outside its allowed range \[1, inf\)"),
    ],
)
def test_counts_are_named_before_the_ascent(counts, message):
    given = STATIC, PIDType(gamma_p=0.9), TASK, 3, {"plant.B": Uniform(0.5, 1.4, relative=True)}
    with pytest.raises(ValueError, match=message):
        worst_machine(*given, **counts, progress=pytest.fail)


@pytest.mark.thorough
def test_the_worst_machine_has_the_largest_error_of_outputs_of_different_peaks():
    # The second output errs more in units of its peak; y1[k+1] = b u[k] errs more in millimetres.
    machine = Machine(StateSpace(np.zeros((2, 2)), np.eye(2), np.eye(2), dt=1e-3))
    law, task = PIDType(gamma_p=[0.5, 0.1]), Task(np.outer(np.sin(TIME), [1.0, 0.01]), dt=1e-3)
    box = {f"plant.B[{i}][{i}]": Uniform(0.5, 1.4) for i in (0, 1)}
    found = worst_machine(machine, law, task, 2, box, metric="max_error", starts=2, steps=8)
    climbed, chance = (found.searches[name] for name in ("gradient", "chance"))
    assert climbed.over_noise is None, "nothing is drawn"
    np.testing.assert_allclose([climbed.value, climbed.course[-1]], 1 - 0.5 * 0.5)
    np.testing.assert_allclose(max(found.by_chance), chance.value)
    each = 2 * (1 + GRADIENT_COST)  # evaluations of a step of both starts
    assert climbed.needed == each * (1 + climbed.case.best.argmax())
    level = climbed.case.best >= chance.case.loss
    assert climbed.level_with_chance == each * (1 + level.argmax())
    assert chance.needed == chance.level_with_chance == 1 + chance.case.found.argmax()


@pytest.mark.thorough
def test_a_quantity_counts_by_its_size_in_each_number():
    """Of y1 = b u = 0.5 b, with the mean -0.5 b: the largest, at b = 1.5, is told as 0.75."""
    found = worst_machine(
        STATIC, PIDType(gamma_p=0.5), Task(np.ones(5), 1e-3), 2,
        {"plant.B[0][0]": Uniform(0.5, 1.5)}, metric="mean", starts=1, steps=6,
        quantities={"mean": lambda trial: -jnp.mean(trial.y[1:])},
    )  # fmt: skip
    climbed = found.searches["gradient"]
    np.testing.assert_allclose(found.nominal, 0.5)
    np.testing.assert_allclose([climbed.value, climbed.course[-1]], 0.75)


@pytest.mark.thorough
def test_a_machine_that_diverges_and_returns_has_diverged():
    # The error grows to 28,000 peaks of the reference, and is small in the last trial.
    machine = Machine(StateSpace([[0.99]], [[0.1]], [[1.0]], dt=1e-3))
    task = Task(np.sin(2 * np.pi * np.arange(11) / 10), dt=1e-3)
    given = machine, PIDType(gamma_p=15.0), task, 90
    assert learn(*given).rms[-1] < 1e-3
    box = {"plant.B": Uniform(0.9, 1.0, relative=True)}
    found = worst_machine(*given, box, metric="rms", starts=1, steps=1)
    assert [found.nominal, found.searches["gradient"].value] == [np.inf, np.inf]


@pytest.mark.thorough
def test_drawn_machines_that_diverge_have_no_finite_error():
    """The error of trial 8 is |1 - b|^7 sin; the limit is 1000 times the reference."""
    box = {"plant.B": Uniform(0.5, 4.5, relative=True)}
    of = {"metric": "max_error", "starts": 5, "steps": 1, "scale": 1e3}
    found = worst_machine(STATIC, PIDType(gamma_p=1.0), TASK, 8, box, **of)
    error = np.abs(np.random.default_rng(0).random(20) * 4.0 - 0.5) ** 7
    expected = np.where(error > 1e3, np.inf, 1e3 * error)
    assert 0 < np.sum(np.isinf(expected)) < 20
    np.testing.assert_allclose(found.by_chance, expected, rtol=1e-6, atol=1e-6)


def test_drawn_machines_whose_error_overflows_have_diverged():
    """y[k+1] = a y[k] + u[k] of 40 samples: from a = 8900 on the square of y is no number."""
    law, box = PIDType(gamma_p=0.4), {"plant.A[0][0]": LogUniform(0.1, 6e8)}
    machine = dataclasses.replace(STATIC, plant=dataclasses.replace(STATIC.plant, A=[[1.0]]))
    found = worst_machine(machine, law, TASK, 2, box, metric="max_error", starts=1, steps=4)
    a = 0.1 * 6e9 ** np.random.default_rng(0).random(16)
    assert np.any(np.isneginf(found.searches["chance"].case.found))
    np.testing.assert_array_equal(np.isinf(found.by_chance), a > 1.5)


def test_noise_is_drawn_anew_for_what_was_found_and_by_the_seed():
    """In trial 1 nothing is played: e is the noise, and its largest of 40 samples is judged."""
    noisy = dataclasses.replace(STATIC, disturbance=Disturbance(output_noise=0.1))
    given = (
        PIDType(gamma_p=0.5),
        Task(np.zeros(N + 1), dt=1e-3),
        1,
        {"plant.B[0][0]": Uniform(0.5, 1.5)},
    )
    one, other = (
        worst_machine(noisy, *given, metric="max_error", starts=1, steps=1, seed=seed)
        for seed in (0, 1)
    )
    assert one.nominal != other.nominal
    few = norm.ppf((1 + 0.95 ** (1 / N)) / 2)  # P(largest < few) = 0.95
    for found in (one, other):
        np.testing.assert_allclose(found.searches["gradient"].over_noise, 0.1 * few, rtol=0.1)


def test_the_last_trial_must_not_be_an_experiment():
    """The error of an experiment says nothing of what was learned; no weight is chosen by it."""
    plant = StateSpace([[0.5]], [[1.0]], [[1.0]], dt=1e-3)
    given = Machine(plant), ModelFreeGradient(step=0.1), Task(np.ones(5), dt=1e-3), 4
    allowed = "trials = 4 ends with an experiment.*allowed are 1, 3, 5 and so on"
    with pytest.raises(ValueError, match=allowed):
        worst_machine(*given, {"plant.B": Uniform(0.5, 1.5, relative=True)})
    with pytest.raises(ValueError, match=allowed):
        Tuning(*given, weights={"step": (0.01, 1.0)}, machines=1, held_out=0)
