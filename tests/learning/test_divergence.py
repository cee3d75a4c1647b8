"""These tests check which runs are said to diverge or to grow.

They compare with closed forms and plain loops, and check that every precision, table and figure
uses the same words.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import DT, task_for

from jaxilc import figures, scenarios
from jaxilc.learning import Keep, Machine, Metrics, divergence, learn
from jaxilc.outcomes import running, sweeping
from jaxilc.outcomes.running import run_numbers
from jaxilc.outcomes.sweeping import sweep_numbers
from jaxilc.plants import StateSpace
from jaxilc.scenarios import Published, reproduction
from jaxilc.schemes import PIDType
from jaxilc.signals import Task
from jaxilc.sweeps import Sweep, run_schemes, summarise
from jaxilc.tuning import Tuning
from jaxilc.uncertainty import Uniform

STATIC = StateSpace([[0.0]], [[1.0]], [[1.0]], dt=DT)  # y[k+1] = u[k], so e_j = (1 - gamma)^(j-1) r
MACHINE, TASK, TRIALS = Machine(STATIC), task_for(STATIC, 20), 12
# (-4)^(j-1) exceeds 1000 for the first time at j = 6, where 4^5 = 1024.
GROWING, STEADY = (PIDType(gamma_p=5.0), PIDType(gamma_p=0.5))


def scenario_of(**changes):
    known = scenarios.load("cao-2019")
    return dataclasses.replace(known, task=TASK, trials=TRIALS, published=(), **changes)


@pytest.mark.thorough
@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_a_trial_diverges_at_a_thousand_times_the_reference_in_either_precision(precision):
    """In float32 the errors overflow at trial 65; in float64 they do not within 200 trials."""
    with jax.enable_x64(precision == "float64"):
        machine, scheme, task = jax.tree.map(
            lambda x: jnp.asarray(x, precision), (MACHINE, GROWING, TASK)
        )
        history = learn(machine, scheme, task, 100)
        assert history.rms.dtype == precision
        assert bool(jnp.all(history.finite)) is (precision == "float64")
    assert int(history.diverged_at) == 6
    np.testing.assert_array_equal(history.diverged, np.arange(1, 101) >= 6)
    assert int(history.grown_from) == 0, "what diverged has not grown"


def test_a_reference_of_zero_and_of_several_outputs_has_a_peak():
    r = np.zeros((9, 3))
    r[4, 0], r[2, 1] = -2.0, 7.0
    np.testing.assert_array_equal(divergence.peak(Task(r, dt=DT)), [2.0, 7.0, 7.0])
    np.testing.assert_array_equal(divergence.peak(Task(0 * r, dt=DT)), [1.0, 1.0, 1.0])


def by_hand(errors, peak, growth, first):
    """Compute diverged_at and grown_from of one learning process, trial by trial.

    errors: (J, n)
    """
    lost = [
        j for j, e in enumerate(errors) if not np.all(np.isfinite(e)) or np.any(e > 1000 * peak)
    ]
    if lost:
        return first + lost[0], 0
    worst = [max(e) for e in errors]
    limit, since = (1 + growth) * min(worst), len(worst)
    while since > 0 and worst[since - 1] > limit:
        since -= 1
    return 0, first + since if since < len(worst) else 0


@pytest.mark.thorough
def test_the_course_is_that_of_a_plain_loop():
    rng, peak = np.random.default_rng(0), np.array([0.5, 3.0])
    task, seen = Task(np.outer(np.ones(5), peak), dt=DT), []
    for _ in range(300):
        J, first = rng.choice([1, 2, 7]), int(rng.integers(1, 5))
        errors = np.exp(rng.normal(0.0, 0.6, (J, 2))) * 10.0 ** rng.choice(
            [0.0, 3.0, 4.0], p=[0.95, 0.03, 0.02]
        )
        errors[rng.random((J, 2)) < 0.02] = rng.choice([np.nan, np.inf])
        metrics = Metrics(errors, errors, errors, errors, np.isfinite(errors).all(axis=1))
        found = divergence.course(jax.tree.map(jnp.asarray, metrics), task, first)
        seen.append((int(found.diverged_at), int(found.grown_from)))
        assert seen[-1] == by_hand(errors, peak, divergence.GROWTH, first)
    assert sum(d > 0 for d, _ in seen) > 20
    assert sum(g > 0 for _, g in seen) > 60


@pytest.mark.parametrize("xp", [np, jnp], ids=["numpy", "jax"])
def test_growth_of_many_at_once(xp):
    errors = xp.asarray(
        [
            [4.0, 1.0, 1.4, 1.6, 1.7],
            [4.0, 1.0, 9.0, 1.4, 1.5],
            [1.0, 2.0, 3.0, 4.0, xp.inf],
            [3.0, 2.0, 1.0, 1.0, 1.0],
        ]
    )
    np.testing.assert_array_equal(divergence.grown_from(errors), [4, 0, 0, 0])
    np.testing.assert_array_equal(divergence.grown_from(errors, 0.2), [3, 3, 0, 0])


@pytest.mark.thorough
def test_it_maps_over_machines_and_leaves_gradients_alone():
    def learned(gain):
        return learn(MACHINE, PIDType(gamma_p=gain), TASK, TRIALS)

    batch = jax.jit(jax.vmap(learned))(np.array([0.5, 5.0, 2.6]))
    np.testing.assert_array_equal(batch.diverged_at, [0, 6, 0])  # 1.6^11 = 176
    np.testing.assert_array_equal(batch.grown_from, [0, 0, 2])
    slope = jax.jit(jax.grad(lambda gain: learned(gain).rms[7, 0]))(5.0)
    rms = np.sqrt(np.mean(np.asarray(TASK.reference)[1:] ** 2))
    np.testing.assert_allclose(slope, 7 * 4.0**6 * rms, rtol=1e-9)


@pytest.mark.thorough
def test_trials_that_go_on_keep_their_numbers():
    before = learn(MACHINE, GROWING, TASK, 3)
    after = learn(MACHINE, GROWING, TASK, 4, memory=before.memory, first=4)
    assert (int(before.diverged_at), int(after.diverged_at)) == (0, 6)
    grown = learn(MACHINE, PIDType(gamma_p=2.7), TASK, 3, memory=before.memory, first=4)
    assert int(grown.grown_from) == 5
    problem = Tuning(
        MACHINE, GROWING, TASK, 8, {"gamma_p": (1.0, 9.0)}, truncate=2, held_out=0, machines=1
    )
    assert problem.ceiling == divergence.CEILING


@pytest.fixture(scope="module")
def swept():
    """Return a sweep whose learning gains go from 0.5 to 5 over the machines.

    Some machines are steady, some grow and some diverge, but no number is infinite.
    """
    schemes = {"steady": STEADY, "growing": PIDType(gamma_p=2.5)}
    plan = Sweep(
        MACHINE,
        schemes,
        TASK,
        TRIALS,
        {"plant.B": Uniform(0.2, 2.0, relative=True)},
        machines=40,
        seed=3,
    )
    return plan, plan.run()


def test_a_sweep_counts_what_diverged_though_it_stayed_finite(swept):
    plan, dataset = swept
    factor = np.abs(1 - 2.5 * plan.drawn["plant.B"])  # the ratio of two successive errors
    lost, grown = factor ** (TRIALS - 1) > 1000, (factor ** (TRIALS - 1) <= 1000) & (factor > 1)
    assert bool(dataset["finite"].all())
    np.testing.assert_array_equal(dataset["diverged_at"].sel(scheme="growing") > 0, lost)
    np.testing.assert_array_equal(dataset["diverged"].sel(scheme="growing").values[:, -1], lost)
    steady, growing = summarise(dataset, 0.1, metric="rms")
    assert (steady.diverged, steady.diverged_at, steady.semi_converged, steady.grown_from) == (
        0,
        0,
        0,
        0,
    )
    assert (growing.diverged, growing.semi_converged) == (np.mean(lost), np.mean(grown))
    assert growing.diverged_at == int(np.min(2 + np.floor(np.log(1000) / np.log(factor[lost]))))
    assert growing.grown_from == 1 + int(np.min(1 + np.floor(np.log(1.5) / np.log(factor[grown]))))
    assert growing.grown_to == pytest.approx(np.max(factor[grown]) ** (TRIALS - 1), rel=1e-9)
    assert growing.worst[-1] == np.inf
    assert np.max(np.where(lost, 0.0, dataset["rms"].sel(scheme="growing").values[:, -1])) > 1


def test_tables_and_figures_say_so(swept):
    plan, dataset = swept
    scenario = scenario_of(schemes=plan.schemes, show_trials=(1, 5), judged_by="rms")
    figures_ = sweep_numbers(scenario, summarise(dataset, 0.1, metric="rms"), 0.1, plan.machines)
    figures_["schemes"]["steady"] |= {"yield": 0.99995, "yield_interval": [0.9997, 0.99999]}
    cells = {
        str(column.header): list(column.cells) for column in sweeping.yield_table(figures_).columns
    }
    assert str(cells["diverged (from)"][0]) == "0.0%"
    assert str(cells["yield (95 % interval)"][0]) == "99.995% (99.97% – 99.999%)"
    assert f"({figures_['schemes']['growing']['diverged_at']})" in str(cells["diverged (from)"][1])
    assert f"({figures_['schemes']['growing']['grown_from']})" in str(cells["grown (from)"][1])
    bare = sweeping.spread_table(figures_ | {"unit": ""})
    assert str(bare.title) == f"rms of trial {TRIALS}"
    worst = next(
        column
        for column in sweeping.spread_table(figures_).columns
        if str(column.header) == "worst"
    )
    assert str(list(worst.cells)[1]) == "∞"
    steady, growing, _ = figures.error_band(dataset, metric="rms")
    assert (steady.get_title("left"), growing.get_title("left")) == ("steady", "growing")
    assert "diverged" not in "".join(text.get_text() for text in steady.texts)
    assert any("% diverged" in text.get_text() for text in growing.texts)


def test_a_run_says_what_diverged_and_what_has_grown():
    schemes = {"steady": STEADY, "growing": PIDType(gamma_p=2.6), "lost": GROWING}
    dataset, _ = run_schemes(MACHINE, schemes, TASK, TRIALS)
    np.testing.assert_array_equal(dataset["diverged_at"], [0, 0, 6])
    np.testing.assert_array_equal(dataset["grown_from"], [0, 2, 0])
    scenario = scenario_of(schemes=schemes, quantities={}, show_trials=(5,))
    numbers = run_numbers(scenario, dataset)
    assert numbers["schemes"]["lost"]["rms"]["12"] == np.inf
    assert np.isfinite(numbers["schemes"]["lost"]["rms"]["5"])
    assert running.course_lines(numbers) == [
        "growing: the rms error has grown 176 times since trial 1; from trial 2 on it is more than "
        "1.5 times its least",
        "lost: diverged at trial 6: not finite, or an error of 1000 times the reference",
    ]
    ax = figures.error_by_trial(dataset, metric="rms")
    labels = [text.get_text() for text in ax.get_legend().get_texts()]
    assert labels == ["steady", "growing (grown from trial 2 on)", "lost (diverged at trial 6)"]
    assert np.isfinite(ax.lines[2].get_ydata()).sum() == 5


def test_a_published_row_beside_a_diverged_trial_is_open():
    scenario = scenario_of(machine=MACHINE, schemes={"lost": GROWING})
    rows = [Published("lost", j, "rms", 1.0, "") for j in (1, 9)]
    ours = reproduction._simulated(scenario, rows)
    assert np.isfinite(ours[rows[0]])
    assert ours[rows[1]] == np.inf


def test_the_names_are_taken():
    for name in divergence.Course._fields:
        with pytest.raises(
            ValueError, match=f"quantity = '{name}' is a metric or a signal that every trial has"
        ):
            Keep.of({name: lambda trial: trial.y})


@pytest.mark.thorough
def test_errors_of_experiments_are_no_growth():
    """The errors 4, 2 and 1 of what was learned lie between those of experiments, which are 9."""

    def grown(rms, first=1, every=1):
        errors = np.array(rms)[:, None]
        metrics = Metrics(errors, errors, errors, errors, np.isfinite(errors).all(axis=1))
        return divergence.course(metrics, Task(np.ones(3), dt=DT), first, every).grown_from

    rms = [4.0, 9.0, 9.0, 2.0, 9.0, 9.0, 1.0, 9.0]
    assert grown(rms) == 8
    assert grown(rms, every=3) == 0
    assert grown(rms[2:], first=3, every=3) == 0  # begun in the midst of a step
    assert grown([*rms[:6], 7.0, 9.0], every=3) == 7
