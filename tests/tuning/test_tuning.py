"""These tests check tuning: optima, risks, coordinates, resuming, and what is refused.

Optima are compared with closed forms.
"""

import copy
import dataclasses
import json
import pickle

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
import scipy.integrate
import scipy.linalg
import scipy.optimize
from cases import CASES
from gain_case import PROBLEM, STATIC, Killed, assert_same_tuned, kill_after

from jaxilc.filters import ZeroPhaseButterworth, ZeroPhaseFIR
from jaxilc.learning import Machine, Sensor, learn
from jaxilc.plants import StateSpace
from jaxilc.pytree import get_at
from jaxilc.schemes import Filtered, HigherOrder, ModelFreeGradient, PIDType
from jaxilc.signals import Task
from jaxilc.tuning import Tuning
from jaxilc.tuning.descent import Evaluation, by_gradient, by_least_squares, for_starts
from jaxilc.tuning.objectives import EveryTrial, Final, Growth, Holding, Objective, Run
from jaxilc.tuning.risks import CVaR, Mean, SmoothMax, Worst
from jaxilc.tuning.weights import Bijection
from jaxilc.uncertainty import Uniform

# Risks
# --------------------------------------------------------------------------------------------------

LOSSES = np.array([0.3, -1.0, 2.5, 0.9, 4.0, 0.1, 0.2])
DEFINED = {
    Mean(): np.mean(LOSSES), Worst(): 4.0, CVaR(0.0): np.mean(LOSSES),
    CVaR(5 / 7): np.mean([4.0, 2.5]), CVaR(0.5): (4.0 + 2.5 + 0.9 + 0.5 * 0.3) / 3.5,
    CVaR(0.99): 4.0, SmoothMax(0.5): 0.5 * np.log(np.mean(np.exp(LOSSES / 0.5))),
    SmoothMax(1e-3): 4.0 - 1e-3 * np.log(7), SmoothMax(1e5): np.mean(LOSSES),
}  # fmt: skip


@pytest.mark.parametrize("risk", DEFINED, ids=str)
def test_risks_are_what_they_say_and_their_weights_are_their_derivatives(risk):
    np.testing.assert_allclose(risk(jnp.asarray(LOSSES)), DEFINED[risk], rtol=1e-4)
    weights = np.asarray(risk.weights(jnp.asarray(LOSSES)))
    np.testing.assert_allclose(weights.sum(), 1.0, rtol=1e-12)
    assert np.all(weights >= 0)
    h = 1e-6
    moved = [
        (risk(jnp.asarray(LOSSES + h * d)) - risk(jnp.asarray(LOSSES - h * d))) / (2 * h)
        for d in np.eye(len(LOSSES))
    ]
    np.testing.assert_allclose(weights, moved, atol=1e-5)


# Coordinates
# --------------------------------------------------------------------------------------------------

INTERVALS = [
    (-np.inf, np.inf), (0, np.inf), (2, np.inf), (-np.inf, -3), (0, 1), (-2, 5), (0.01, 100),
    (-50, -0.5),
]  # fmt: skip


@pytest.mark.parametrize("interval", INTERVALS, ids=str)
def test_bijections_are_one_to_one_and_stay_inside(interval):
    bijection = Bijection(*map(float, interval), scale=3.0)
    z = np.linspace(-8.0, 8.0, 33)
    values = np.asarray(bijection(z))
    np.testing.assert_allclose([bijection.inverse(v) for v in values], z, atol=1e-5)
    assert np.all(np.diff(values) * np.sign(values[-1] - values[0]) > 0)
    far = np.asarray(bijection(np.array([-1e3, 1e3])))
    assert np.all((far > interval[0]) & (far < interval[1]))
    for end in interval:
        assert interval[0] < bijection.inside(end) < interval[1] or np.isinf(end)
        if np.isfinite(end):  # beside an end, the value from which a tuning starts is the one told
            inside = bijection.inside(end + 1e-9 * (float(bijection(0.0)) - end))
            np.testing.assert_allclose(bijection(bijection.inverse(inside)), inside, rtol=1e-9)
        if np.isfinite(interval).all():  # a start beside an end is within reach, and is not moved
            start = end + 1e-6 * (float(bijection(0.0)) - end)
            reaches = Bijection.of(*map(float, interval), start)
            assert reaches.inside(start) == start
            np.testing.assert_allclose(reaches(reaches.inverse(start)), start, rtol=1e-9)
            assert all(interval[0] < reaches(z) < interval[1] for z in (-1e3, 1e3))
    assert [bijection.inside(v) for v in values] == values.tolist()
    if np.isfinite(interval).all() and np.prod(interval) > 0:  # the middle is the geometric mean
        np.testing.assert_allclose(abs(bijection(0.0)), np.sqrt(np.prod(interval)), rtol=1e-9)


TRACED = []


@dataclasses.dataclass(frozen=True)
class Traced(Objective):
    """The objective counts how often it is traced."""

    def __call__(self, run):
        TRACED.append(1)
        return Final("rms", floor=0.1)(run)


# Optima
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "optimiser",
    ["adam", "lbfgs", "least-squares", optax.rmsprop(0.1)],
    ids=["adam", "lbfgs", "least-squares", "own"],
)
def test_the_best_gain_of_p_type_learning_is_found_by_one_program(optimiser):
    # The objective log sqrt((1 - gamma g)^4 + floor^2) is smooth and convex near its minimum at
    # gamma = 1 / g.
    machine = dataclasses.replace(STATIC, plant=StateSpace([[0.0]], [[0.8]], [[1.0]], dt=1e-3))
    options = {
        "machines": 1, "held_out": 0, "optimiser": optimiser, "steps": 60, "patience": 60,
        "validate_every": 1,
    }  # fmt: skip
    problem = dataclasses.replace(
        PROBLEM, machine=machine, uncertainty={}, trials=2, objective=Traced(), **options
    )
    traced = []
    tuned = problem.run(progress=lambda *_: traced.append(len(TRACED)))
    np.testing.assert_allclose(tuned.values["gamma_p"], 1 / 0.8, rtol=0.02)
    assert len(traced) == 60
    assert len(set(traced)) == 1
    assert tuned.after < 0.01 < tuned.before


@pytest.mark.thorough
def test_the_gain_for_the_worst_of_two_plants_is_the_minimax_one():
    # The maximum of |1 - gamma g| over g is least where both ends are equal, at
    # gamma = 2 / (g_low + g_high).
    options = {
        "sampling": "corners", "risk": Worst(), "steps": 80, "held_out": 0, "patience": 80,
        "validate_every": 1, "rate": 0.05,
    }  # fmt: skip
    tuned = dataclasses.replace(PROBLEM, trials=2, **options).run()
    np.testing.assert_allclose(tuned.values["gamma_p"], 2 / 1.8, rtol=2e-3)


def test_least_squares_agrees_with_scipy():
    A, b = np.array([[1.0, 2.0], [0.5, -1.0], [3.0, 0.2]]), np.array([1.0, 0.3, -0.7])

    def residuals(z):
        return jnp.asarray(A) @ jnp.sinh(z) - b

    def evaluate(z):
        r, J = residuals(z), jax.jacfwd(residuals)(z)
        return Evaluation(0.5 * jnp.sum(r**2), J.T @ r, r, J, jnp.zeros(()))

    init, step = for_starts(by_least_squares(evaluate))
    z = np.array([[2.0, -1.5]])
    state = init(z)
    for _ in range(30):
        z, state, _ = step(z, state)
    np.testing.assert_allclose(
        z[0],
        scipy.optimize.least_squares(lambda z: np.asarray(residuals(z)), [0.1, 0.1]).x,
        atol=1e-6,
    )


def test_the_line_search_of_lbfgs_uses_the_given_gradient():
    def evaluate(z):
        value = (1 - z[0]) ** 2 + 100 * (z[1] - z[0] ** 2) ** 2
        gradient = jnp.array(
            [-2 * (1 - z[0]) - 400 * z[0] * (z[1] - z[0] ** 2), 200 * (z[1] - z[0] ** 2)]
        )
        return Evaluation(value, gradient, z, jnp.eye(2), jnp.zeros(()))

    init, step = for_starts(by_gradient(evaluate, optax.lbfgs()))
    z = np.array([[-1.2, 1.0], [2.0, -1.0]])
    state = init(z)
    for _ in range(60):
        z, state, record = step(z, state)
    np.testing.assert_allclose(z, 1.0, atol=1e-4)
    assert record.loss.shape == (2,)


MANY = dataclasses.replace(PROBLEM, starts=3, scatter=0.8)  # it compiles its programs once


@pytest.fixture(scope="module")
def tuned():
    return MANY.run()


def test_a_population_takes_the_place_of_the_machine():
    drawn = {"machine", "uncertainty", "machines", "seed", "sampling"}
    own = {f.name: getattr(PROBLEM, f.name) for f in dataclasses.fields(PROBLEM)}
    own = {name: of for name, of in own.items() if name not in drawn}
    found = Tuning(dataclasses.replace(PROBLEM.population, seed=5), **own)
    assert (found.machine, found.machines, found.seed) == (PROBLEM.machine, PROBLEM.machines, 5)
    assert found.configuration() == PROBLEM.configuration() | {"seed": 5}
    assert Tuning(PROBLEM.population, **own, machines=3).population.size == 3


def test_a_tuning_is_pickled_before_and_after_its_programs_are_made():
    problem = dataclasses.replace(PROBLEM, machines=3)
    before = pickle.dumps(problem)
    _ = problem.evaluation
    assert pickle.dumps(problem) == before
    assert repr(pickle.loads(before)) == repr(problem)
    assert copy.copy(problem).population.drawn.keys() == problem.population.drawn.keys()


@pytest.mark.thorough
def test_many_starts_take_the_best_by_held_out_plants(tuned):
    assert tuned.loss.shape == tuned.dropped.shape == tuned.weights["gamma_p"].shape == (8, 3)
    assert len(np.unique(tuned.weights["gamma_p"][0])) == 3
    looked = np.isfinite(tuned.held_out).all(axis=1)
    np.testing.assert_array_equal(np.flatnonzero(looked), [0, 3, 6, 8])
    np.testing.assert_allclose(tuned.after, np.nanmin(tuned.held_out), rtol=1e-12)
    assert np.nanmin(tuned.held_out[tuned.step]) == np.nanmin(tuned.held_out)
    # the loss on held-out machines, from the closed form and from plants built again here
    gains = np.asarray(PROBLEM.population.others(PROBLEM.seed + 1, 4).batch(1)[1]["plant.B"])
    error = (1 - tuned.values["gamma_p"] * gains) ** 2 * np.sqrt(0.5)
    np.testing.assert_allclose(
        tuned.after, np.mean(0.5 * np.log(error**2 + 0.01) - np.log(0.1)), rtol=1e-10
    )
    assert get_at(tuned.scheme, "gamma_p") == tuned.values["gamma_p"]


def test_a_whole_number_of_numpy_is_one():
    assert dataclasses.replace(PROBLEM, machines=np.int64(3)).population.size == 3
    problem = dataclasses.replace(PROBLEM, machines=np.int64(4), lanes=np.int64(2))
    assert json.dumps(problem.configuration()) == json.dumps(PROBLEM.configuration())


@pytest.mark.thorough
def test_how_often_steps_are_judged_changes_no_step(tuned):
    each = dataclasses.replace(MANY, validate_every=1, patience=8).run()
    np.testing.assert_array_equal(each.loss, tuned.loss)
    judged = [0, 3, 6, 8]
    np.testing.assert_array_equal(each.held_out[judged], tuned.held_out[judged])
    assert each.after == np.min(each.held_out) <= np.min(each.held_out[judged]) == tuned.after


@pytest.mark.thorough
def test_patience_ends_it():
    still = dataclasses.replace(
        PROBLEM, optimiser=optax.set_to_zero(), steps=30, validate_every=1, patience=2
    ).run()
    assert still.reason == "patience"
    assert len(still.loss) == 3


# Runs
# --------------------------------------------------------------------------------------------------


@pytest.mark.thorough
def test_a_folder_under_earlier_names_is_resumed(tmp_path, monkeypatch):
    """Machines were called samples then, and metrics were called figures."""
    configuration = Tuning.configuration

    def earlier(self):
        found = configuration(self)
        found["samples"] = found.pop("machines")
        found["objective"]["figure"] = found["objective"].pop("metric")
        return found

    with monkeypatch.context() as patched:
        patched.setattr(Tuning, "configuration", earlier)
        with pytest.raises(Killed):
            PROBLEM.run(tmp_path / "state", progress=kill_after(3))
    other = dataclasses.replace(PROBLEM, objective=Final("max_error", floor=0.1))
    with pytest.raises(ValueError, match=r"it differs in: objective.metric: rms there, max_error"):
        other.run(tmp_path / "state", resume=True)
    resumed, whole = PROBLEM.run(tmp_path / "state", resume=True), PROBLEM.run()
    assert resumed.values == whole.values
    np.testing.assert_array_equal(resumed.loss, whole.loss)


# Its state has a random key, and numbers of a type that NumPy lacks.
OWN = optax.chain(
    optax.add_noise(0.01, 0.9, 0),
    optax.scale_by_adam(mu_dtype=jnp.bfloat16),
    optax.scale_by_schedule(optax.linear_schedule(-0.2, 0.0, 6)),
)


@pytest.mark.thorough(but=["least-squares", "own"])
@pytest.mark.parametrize(
    "optimiser",
    ["lbfgs", "least-squares", OWN],  # tests/storage kills runs with Adam
    ids=["lbfgs", "least-squares", "own"],
)
def test_an_interrupted_tuning_resumes_to_the_same_numbers(optimiser, tmp_path):
    # noise takes longest to compile, and is the same whatever the optimiser
    machine = STATIC if optimiser != OWN else dataclasses.replace(STATIC, sensor=Sensor(noise=1e-2))
    problem = dataclasses.replace(PROBLEM, machine=machine, starts=2, steps=6, optimiser=optimiser)
    whole = problem.run()
    with pytest.raises(Killed):
        problem.run(tmp_path / "state", progress=kill_after(4))
    steps = []
    resumed = problem.run(
        tmp_path / "state", resume=True, progress=lambda step, losses, best: steps.append(step)
    )
    assert steps == [5, 6]
    assert_same_tuned(whole, resumed)


def test_a_folder_of_another_tuning_is_refused_before_compiling(tmp_path, monkeypatch):
    with pytest.raises(Killed):
        MANY.run(tmp_path / "state", progress=kill_after(1))
    monkeypatch.setattr(Tuning, "_compile", lambda *_: pytest.fail("it was compiled"))
    problem, other = dataclasses.replace(MANY), dataclasses.replace(MANY, seed=5)
    with pytest.raises(FileExistsError, match="exists already"):
        problem.run(tmp_path / "state")
    with pytest.raises(
        ValueError, match="another configuration; it differs in: seed: 0 there, 5 here"
    ):
        other.run(tmp_path / "state", resume=True)
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match="not a tuning that can be resumed"):
        problem.run(tmp_path / "empty", resume=True)


class Nominal(Final):
    """The same objective, evaluated on the nominal plant only."""

    nominal = True


@pytest.mark.thorough
def test_an_experiment_counts_as_the_learned_trial_before_it():
    """Those of trials 2, 4 and 6 err more, while what is learned errs less in each step."""
    machine, law = Machine(StateSpace([[0.5]], [[1.0]], [[1.0]], dt=1e-3)), ModelFreeGradient(0.1)
    task = Task(np.sin(np.linspace(0, 6, 15)), dt=1e-3)
    history = learn(machine, law, task, 7)
    rms = np.asarray(history.rms)[:, 0]
    assert rms[1] > 2 * rms[0] > 2 * rms[2]
    held = np.log(rms[[0, 0, 2, 2, 4, 4, 6]] / np.max(np.abs(task.reference)) / 1e-6)
    terms = EveryTrial("rms"), Growth("rms"), Holding(4, "rms"), Final("rms", 2)
    found = [term(Run(machine, law, task, history)) for term in terms]
    np.testing.assert_allclose(found, [held.mean(), 0.0, held[3], held[1]], rtol=1e-9)


@pytest.mark.thorough
def test_a_nominal_term_is_asked_once_and_counts():
    # With two trials at the start gain of 0.4, e_3 = 0.36 r on the nominal plant.
    problem = dataclasses.replace(PROBLEM, objective=2.0 * Nominal("rms", floor=0.1), steps=1)
    tuned = problem.run()
    expected = 2.0 * (0.5 * np.log(0.5 * 0.36**2 + 0.01) - np.log(0.1))
    np.testing.assert_allclose([tuned.loss[0, 0], tuned.before], expected, rtol=1e-9)
    assert tuned.slope[0, 0] > 0


def test_the_comparison_is_on_plants_nobody_has_seen(tuned):
    dataset = PROBLEM.compare(tuned, machines=9)
    seen = np.concatenate(
        [np.asarray(PROBLEM.population.others(seed, 5).batch(1)[1]["plant.B"]) for seed in (0, 1)]
    )
    assert not np.isin(dataset["plant.B"].values[1:], seen).any()
    gain = dataset["plant.B"].values
    expected = np.abs(1 - tuned.values["gamma_p"] * gain) ** 2 * np.sqrt(0.5)
    np.testing.assert_allclose(dataset["rms"].sel(scheme="tuned", trial=3), expected, rtol=1e-10)
    others = PROBLEM.compare(tuned, machines=9, seed=7)["plant.B"].values[1:]
    assert not np.isin(others, [*seen, *gain]).any()
    for seen_by in (0, 1):
        with pytest.raises(ValueError, match=f"compare: seed = {seen_by} is one of 0 and 1"):
            PROBLEM.compare(tuned, seed=seen_by)
    with pytest.raises(ValueError, match="trials = 0 is outside"):
        PROBLEM.compare(tuned, trials=0)


@pytest.mark.thorough
def test_elements_and_arrays_are_tuned_by_name_and_ends_are_left():
    scheme = Filtered(PIDType(gamma_p=0.5, leak=0.0), ZeroPhaseFIR((0.5, 0.25)))
    weights = {
        "filter.taps[1]": None,
        "filter.taps": None,
        "scheme.leak": None,
        "scheme.gamma_p": (0.1, 2),
    }
    problem = dataclasses.replace(PROBLEM, scheme=scheme, steps=2, weights=weights)
    assert sorted(problem.bijections) == [
        "filter.taps[0]", "filter.taps[1]", "scheme.gamma_p", "scheme.leak",
    ]  # fmt: skip
    tuned = problem.run()
    assert tuned.nudged == {"scheme.leak": 1e-3}
    assert tuned.start["scheme.leak"] == 0.0
    assert all(
        tuned.weights[name][1, 0] != tuned.weights[name][0, 0] for name in problem.bijections
    )


@pytest.mark.parametrize("order", [1, -1])
def test_the_bounds_of_an_element_count_beside_those_of_its_array(order):
    """An element's own bounds were lost where its array was named after it."""
    both = {"filter.taps[1]": (0.2, 0.3), "filter.taps": (0.1, 2.0)}
    scheme = Filtered(PIDType(gamma_p=0.5), ZeroPhaseFIR((0.5, 0.25)))
    weights = dict([*both.items()][::order])
    found = dataclasses.replace(PROBLEM, scheme=scheme, weights=weights).bijections
    ends = {name: (of.low, of.high) for name, of in found.items()}
    assert ends == {"filter.taps[0]": (0.1, 2.0), "filter.taps[1]": (0.2, 0.3)}
    bounds = {"filter.taps[1]": None, "filter.taps": (0.1, 2.0)}  # no bounds of its own
    found = dataclasses.replace(PROBLEM, scheme=scheme, weights=bounds).bijections
    assert {(of.low, of.high) for of in found.values()} == {(0.1, 2.0)}


# Each alpha is allowed by itself, but their sum is not above 1, to which the error leads.
TOGETHER = {
    "scheme": HigherOrder((0.45, 0.45), (0.1, 0.1)), "weights": {"alpha": (0.05, 0.54)},
    "trials": 4, "machines": 1, "uncertainty": {}, "steps": 1, "rate": 1.0, "held_out": 0,
}  # fmt: skip


def test_weights_that_are_refused_together_are_not_held_best():
    problem = dataclasses.replace(PROBLEM, **TOGETHER)
    vars(problem)["_programs"] = None, None, lambda rows: jnp.array([0.2, 0.1, jnp.nan])
    found = problem._held_out_at(np.array([[0.0, 0.0], [9.0, 9.0], [0.0, 0.0]]))
    np.testing.assert_array_equal(found, np.array([0.2, np.inf, np.nan], found.dtype))
    refusal = problem._refusal(np.array([9.0, 9.0]))
    assert refusal.startswith("HigherOrder: the sum of alpha = 1.07968 is")


@pytest.mark.thorough
def test_a_tuning_whose_steps_are_refused_leaves_the_weights_as_given(tmp_path, monkeypatch):
    """It says so again when it is resumed, whatever is refused from then on."""
    problem = dataclasses.replace(PROBLEM, **TOGETHER | {"steps": 2, "validate_every": 1})
    for _ in range(2):
        with pytest.warns(RuntimeWarning, match=r"refuses together .* alpha = 1\.00\d+ is"):
            tuned = problem.run(tmp_path / "state", resume=True)
        assert tuned.values == pytest.approx({"alpha[0]": 0.45, "alpha[1]": 0.45}, rel=1e-12)
        monkeypatch.setattr(Tuning, "_held_out_at", lambda self, z: np.full(len(z), 9.0))


@pytest.mark.thorough
def test_weights_that_no_step_has_bettered_stay_as_given():
    """A forgetting of 0 is best and lies on an end: the tuning starts, and stays, beside it."""
    scheme = PIDType(gamma_p=0.9, leak=0.0)
    tuned = dataclasses.replace(PROBLEM, scheme=scheme, steps=2, weights=["leak"]).run()
    assert np.nanmin(tuned.held_out) > tuned.before
    assert (tuned.values, tuned.after, tuned.step) == ({"leak": 0.0}, tuned.before, 0)
    assert float(tuned.scheme.leak) == 0.0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"weights": ["gain"]}, "weights: 'gain' is not a parameter here; known: gamma_p"),
        ({"weights": ["lead"]}, "weights: lead = 0 is not a float leaf"),
        ({"weights": ["limit"]}, "weights: limit = None is not a float leaf"),
        ({"weights": []}, "weights is empty"),
        ({"weights": "gamma_p"}, r"weights = 'gamma_p' is text; allowed are names, \['gamma_p'\]"),
        ({"weights": {"gamma_p": 0.3}}, r"bounds 0.3 of gamma_p are not two numbers \(low, high\)"),
        ({"objective": None}, "objective = None; allowed is Objective"),
        ({"risk": np.mean}, "risk = <function mean .*; allowed is Risk"),
        ({"optimiser": None}, "optimiser = None; allowed are text and GradientTransformation"),
        ({"weights": {"gamma_p": (1.0, 1.0)}},
         r"weights: the bounds \(1, 1\) of gamma_p are empty"),
        ({"weights": {"gamma_p": (0.5, 1.0)}},
         r"weights: the start gamma_p = 0.4 is outside its bounds \(0.5, 1\)"),
        ({"weights": {"leak": (0.0, 2.0)}},
         r"weights: the bounds \(0, 2\) of leak leave its allowed range \[0, 1\)"),
        ({"weights": ["scheme"], "scheme": CASES["p_type_fir"][1]},
         "weights: scheme = .* is not a float leaf"),
        (
            {
                "weights": ["filter.cutoff"],
                "scheme": Filtered(PIDType(gamma_p=0.5), ZeroPhaseButterworth(80.0, padding=3)),
            },
            r"filter.cutoff may become .*Nyquist.*Give narrower bounds",
        ),
        ({"optimiser": "newton"}, "optimiser = 'newton' is not one of adam, lbfgs, least-squares"),
        ({"mode": "sideways"}, "mode = 'sideways' is not one of auto, forward, reverse"),
        ({"mode": None}, "mode = None is not one of auto, forward, reverse"),
        ({"steps": 0}, r"steps = 0 is outside its allowed range \[1, inf\)"),
        ({"truncate": 0}, r"truncate = 0 is outside its allowed range \[1, inf\)"),
        ({"clip": 0.0}, r"clip = 0 is outside its allowed range \(0, inf\]"),
        ({"objective": Final("speed")},
         "metric = 'speed' is not one of max_error, rms, settled_error"),
        ({"objective": Holding(9)}, r"first = 9 is outside its allowed range \[1, 3\]"),
        ({"objective": Growth(after=9)}, r"after = 9 is outside its allowed range \[1, 3\]"),
        ({"objective": Final(trial=9)}, r"trial = 9 is outside its allowed range \[1, 3\]"),
        ({"uncertainty": {"plant.mass": Uniform(1, 2)}}, "plant.mass"),
    ],
)  # fmt: skip
def test_bad_input_is_named_before_anything_runs(change, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(PROBLEM, **change)


@pytest.mark.parametrize("risk", [Mean(), Worst(), CVaR(0.5), SmoothMax()])
def test_a_risk_of_machines_of_which_none_is_finite_is_infinite(risk):
    assert risk(jnp.full(4, jnp.inf)) == np.inf


def test_risks_name_what_is_wrong():
    with pytest.raises(ValueError, match=r"alpha = 1 is outside its allowed range \[0, 1\)"):
        CVaR(1.0)
    with pytest.raises(ValueError, match=r"temperature = 0 is outside"):
        SmoothMax(0.0)
