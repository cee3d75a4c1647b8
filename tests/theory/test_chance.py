"""Claims on single runs where trials differ by chance.

The oracles are enumerations of all that can be drawn, for trials of a few samples, and runs that
NumPy draws. The attack on many machines is `experiments/chance_under_attack.py`.
"""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
import scipy.stats
from dense import lifted

from jaxilc.learning import Machine
from jaxilc.learning.machine import Actuator, Disturbance, Sensor
from jaxilc.learning.variation import PlantChange, Variation, there_until
from jaxilc.outcomes.certifying import certificate_numbers, left_words, senses_words
from jaxilc.outcomes.words import number
from jaxilc.plants import StateSpace
from jaxilc.pytree import replaced
from jaxilc.schemes import NormOptimal, PIDType, PolynomialBasis, WarmStart
from jaxilc.schemes.weights import weighed
from jaxilc.signals.task import Task, Trial
from jaxilc.theory import carried_radius, certificates, certify
from jaxilc.theory.certificates import CONVERGES, DIVERGES, MONOTONE, NOTHING, OfScheme, long_run
from jaxilc.theory.chance import RecordMoments, under_chance
from jaxilc.theory.learning_map import view_of
from jaxilc.uncertainty import drawn_machines

DT, N = 1e-3, 40
TASK = Task(np.sin(np.linspace(0, 2 * np.pi, N + 1)), DT, settle=(0.01, 0.04))
# of two states each, so that all are run by the same programs; y[k+1] = u[k] of the first
AT_ONCE = StateSpace(np.zeros((2, 2)), [[1.0], [0.0]], [[1.0, 0.0]], dt=DT)
LAGS = StateSpace([[0.5, 0.0], [0.0, 0.0]], [[0.5], [0.0]], [[1.0, 0.0]], dt=DT)
WAITS = StateSpace([[0.5, 0.0], [1.0, 0.0]], [[0.5], [0.0]], [[0.0, 1.0]], dt=DT)  # a sample more
TRIALS = 256  # also those in which the largest error is looked for
EVERYTHING = {"shortest": 0.4, "dropped": 0.2, "late": 2, "delayed": 0.4, "delay": 2}


def on_runs(machine, law, task, trials, **how):
    """Return what holds for single runs, without the trials that a certificate simulates."""
    machines = drawn_machines(machine, {}, {})
    return under_chance(machines, law, task, view_of(law, task), trials, **how)


def of_each(machine, name, numbers):
    """Return machines that differ in one number."""
    whole = jax.tree.map(lambda leaf: np.stack([leaf] * len(numbers)), machine)
    return replaced(whole, {name: np.array(numbers)})


@pytest.mark.thorough(but=["shortest"])
@pytest.mark.parametrize(
    "how",
    [{"delayed": 0.5, "delay": 3}, {"shortest": 0.4}, EVERYTHING],
    ids=lambda how: ", ".join(how),
)
def test_moments_of_the_record_are_those_of_drawn_records(how):
    rng, draws, rows, n = np.random.default_rng(1), 40_000, 8, 2
    variation, r, A = Variation(**how), rng.normal(size=(rows, n)), rng.normal(size=(rows * n, 3))

    def shown(key):
        of_y, key = jax.random.split(key)
        y = (A @ jax.random.normal(of_y, (3,)) + 0.5).reshape(rows, n)
        trial = Trial(jnp.asarray(r), y, jnp.zeros((rows - 1, 1)), DT)
        if variation.shortest is not None:
            there = there_until(variation.shortest, rows - 1, variation._of(key, 1))
            trial = weighed(trial, jnp.broadcast_to(there[:, None], r.shape))
        return variation.shown(trial, key).e.ravel()

    e = np.asarray(jax.jit(jax.vmap(shown))(jax.random.split(jax.random.key(2), draws)))
    found, y = RecordMoments.of(variation, rows), np.full(rows * n, 0.5)
    kept, held = np.repeat(found.kept, n), np.kron(found.held, np.eye(n))
    of_y = A @ A.T
    mean = kept * (r.ravel() - held @ y)
    total = found.covariance(of_y + np.outer(y, y), r.ravel(), y)
    total += np.outer(kept, kept) * (held @ of_y @ held.T)
    centred = e - mean
    assert np.all(abs(centred.mean(0)) <= 6 * e.std(0) / np.sqrt(draws) + 1e-12)
    products = centred[:, :, None] * centred[:, None, :]
    assert np.all(abs(products.mean(0) - total) <= 6 * products.std(0) / np.sqrt(draws) + 1e-12)
    X, Z = rng.normal(size=(2, rows * n, rows * n))
    np.testing.assert_allclose(
        np.sum(found.covariance(X) * Z), np.sum(X * found.covariance_back(Z)), rtol=1e-10
    )


def every_record(how: dict, rows: int):
    """Yield (chance, H, P) of all that can be drawn, by the definition of each kind."""
    k = np.arange(rows)
    chances = 1 - how.get("dropped", 0.0), how.get("dropped", 0.0)
    masks = [(1, 1.0)] if "dropped" not in how else list(zip((1, 0), chances, strict=True))
    delays = [(0, 1.0)]
    if "delayed" in how:
        slow, most = how["delayed"], how["delay"]
        delays = [(0, 1 - slow), *((d, slow / most) for d in range(1, most + 1))]
    shifts = range(how.get("late", 0) + 1)
    for shift in shifts:
        for kept in itertools.product(masks, repeat=rows - 1):
            for late in itertools.product(delays, repeat=rows - 1):
                delta = [0, *(d for d, _ in late)]
                newest = [max(m for m in range(i + 1) if m + delta[m] <= i) for i in k]
                at = np.maximum(np.array(newest) - shift, 0)
                chance = np.prod([p for _, p in (*kept, *late)]) / len(shifts)
                yield chance, np.eye(rows)[at], np.diag([1.0, *(float(m) for m, _ in kept)])


@pytest.mark.thorough(but=["dropped, late"])
@pytest.mark.parametrize(
    "how",
    [{"delayed": 0.4, "delay": 2}, {"dropped": 0.2, "late": 1}],
    ids=lambda how: ", ".join(how),
)
def test_the_mean_square_error_of_each_trial_is_that_over_all_that_can_be_drawn(how):
    rows, gain, leak, trials = 5, 0.8, 0.1, 6
    task = Task(np.array([0.0, 1.0, 0.4, -0.7, 0.2]), DT)
    noise = {"sensor": Sensor(noise=0.05), "disturbance": Disturbance(input_noise=0.1)}
    machine = Machine(LAGS, **noise, variation=Variation(**how))
    (found,) = on_runs(machine, PIDType(gamma_p=gain, leak=leak), task, trials)
    n, r = rows - 1, np.asarray(task.reference)[:, 0]
    G = np.array([[0.5 ** (i - k) if i > k else 0.0 for k in range(n)] for i in range(rows)])
    F = np.hstack([0.1 * G, 0.05 * np.eye(rows)])  # noise of the input and of the sensor
    shift, records = np.eye(rows)[1:], list(every_record(how, rows))
    np.testing.assert_allclose(sum(p for p, _, _ in records), 1.0, rtol=1e-12)
    X = np.zeros((n + 1, n + 1))  # E of (u, 1) (u, 1)^T
    X[-1, -1] = 1.0
    Y = np.hstack([G, np.zeros((rows, 1))])
    R = np.hstack([np.zeros((rows, n)), r[:, None]])
    expected = []
    for _ in range(trials):
        square = np.diag((R - Y) @ X @ (R - Y).T + F @ F.T)
        expected.append(np.sqrt(np.mean(square[1:])))
        following = np.zeros_like(X)
        for chance, H, P in records:
            M = np.zeros_like(X)
            M[:n] = np.hstack([(1 - leak) * np.eye(n), np.zeros((n, 1))])
            M[:n] += gain * shift @ P @ (R - H @ Y)
            M[-1, -1] = 1.0
            of_noise = np.vstack([gain * shift @ P @ H @ F, np.zeros((1, F.shape[1]))])
            following += chance * (M @ X @ M.T + of_noise @ of_noise.T)
        X = following
    np.testing.assert_allclose(found.rms, expected, rtol=1e-9)


@pytest.mark.thorough(
    but=[
        "at once-2.2-dropped-diverges-almost surely",
        "at once-0.7-dropped-monotone-in mean square",
        "at once-0.7-scatter-monotone-for every draw",
        "lags-2.0-late-not claimed-in the mean",
        "lags-2.5-shortest-converges-in mean square",
        "lags-3.0-delayed-converges-in mean square",
    ]
)
@pytest.mark.parametrize(
    ("plant", "gain", "how", "claim", "sense"),
    [
        (AT_ONCE, 2.2, {"dropped": 0.2}, DIVERGES, "almost surely"),
        (AT_ONCE, 0.7, {"dropped": 0.2}, MONOTONE, "in mean square"),
        (AT_ONCE, 0.7, {"shortest": 0.5}, MONOTONE, "in mean square"),
        (AT_ONCE, 0.7, {"scatter": 0.1}, MONOTONE, "for every draw"),
        (LAGS, 1.0, {"late": 3}, CONVERGES, "in mean square"),
        (LAGS, 2.0, {"late": 3}, NOTHING, "in the mean"),
        (LAGS, 3.5, {"late": 3}, NOTHING, "in the mean"),
        (LAGS, 1.0, {"delayed": 0.4, "delay": 3}, MONOTONE, "in mean square"),
        (LAGS, 3.0, {"delayed": 0.4, "delay": 3}, CONVERGES, "in mean square"),
        (LAGS, 3.5, {"delayed": 0.4, "delay": 3}, NOTHING, "in the mean"),
        (LAGS, 2.5, {"shortest": 0.3}, CONVERGES, "in mean square"),  # was looked at for ever
    ],
    ids=lambda of: (
        {id(AT_ONCE): "at once", id(LAGS): "lags"}.get(id(of))
        or (next(iter(of)) if isinstance(of, dict) else None)
    ),
)
def test_claims_are_those_of_single_runs(plant, gain, how, claim, sense):
    """Each of these once was claimed to be monotone or to converge, by its mean alone."""
    machine = Machine(plant, variation=Variation(**how))
    found = certify(machine, PIDType(gamma_p=gain), TASK, TRIALS, {}, {})
    assert (found.claim[0], found.sense[0]) == (claim, sense)
    assert not len(found.broken_promises())
    runs = found.runs[0]
    if claim in (MONOTONE, CONVERGES):
        assert np.all(np.isfinite(runs))
        told = certificate_numbers(OfScheme(found, None, 1.0))["transient"]["growth"]
        assert told is None or told * found.predicted[0, 0] > found.left[0]
        last = np.mean(runs[:, -10:] ** 2), np.mean(found.predicted[0, -10:] ** 2)
        assert last[0] < 10 * last[1] + 1e-20
    if claim == DIVERGES:
        assert np.all(runs[:, -1] > 10 * runs[:, 0])
    # if the mean of all runs were claimed, its own runs would contradict it where they grow
    if claim in (DIVERGES, NOTHING):
        in_mean_square = {"claim": np.array([MONOTONE]), "sense": np.array(["in mean square"])}
        said = found._replace(**in_mean_square, predicted=0 * found.predicted)
        assert len(said.broken_promises()) == 1


def test_an_error_that_falls_for_100_trials_and_is_pushed_by_chance_is_claimed_to_diverge():
    """NumPy runs 30,000 trials of u[0], whose error no input moves, and of what it pushes."""
    machine, gain, dropped = Machine(WAITS, variation=Variation(dropped=0.2)), 0.05, 0.2
    found = certify(machine, PIDType(gamma_p=gain), TASK, TRIALS, {}, {})
    assert (found.claim[0], found.sense[0]) == (DIVERGES, "almost surely")
    assert "do not depend on them" in found.reason[0]
    assert np.all(found.runs[0, :, 99] < 0.1 * found.runs[0, :, 0])
    rng, r = np.random.default_rng(4), np.asarray(TASK.reference)[:, 0]
    u = gain * r[1] * np.sum(rng.random(30_000) >= dropped)
    assert abs(r[2] - 0.5 * u) > 100 * found.runs[0, :, 0].max()
    at_zero = replaced(TASK, {"reference": np.where(np.arange(N + 1) == 1, 0.0, r)[:, None]})
    found = certify(machine, PIDType(gamma_p=gain), at_zero, TRIALS, {}, {})
    assert (found.claim[0], found.sense[0]) == (DIVERGES, "almost surely")
    assert found.runs[0, 0, 1] < found.runs[0, 0, 0]  # nothing pushes u[0]; r[2] pushes u[1]
    u = gain * r[2] * np.sum(rng.random(30_000) >= dropped)
    assert abs(r[3] - 0.5 * u) > 100 * found.runs[0, :, 0].max()


def test_where_the_mean_of_all_runs_diverges_their_mean_square_does():
    """Of two axes that act on each other more than on themselves one direction has a wrong sign."""
    plant = StateSpace(np.zeros((2, 2)), np.array([[1.0, 2.0], [2.0, 1.0]]), np.eye(2), dt=DT)
    task = Task(np.repeat(np.asarray(TASK.reference), 2, axis=1) * [1.0, 0.5], DT, inputs=2)
    machine = Machine(plant, variation=Variation(dropped=0.2))
    found = long_run(drawn_machines(machine, {}, {}), PIDType(gamma_p=0.1), task)
    assert (found.claim[0], found.sense[0]) == (DIVERGES, "in mean square")
    rng, r = np.random.default_rng(5), np.tile(np.asarray(task.reference)[1:], (16, 1, 1))
    e = r
    for _ in range(200):
        e = e - 0.1 * (rng.random((16, N, 1)) >= 0.2) * (e @ np.asarray(plant.B))
    assert np.all(np.linalg.norm(e, axis=(1, 2)) > 1e3 * np.linalg.norm(r, axis=(1, 2)))


@pytest.mark.parametrize(("gains", "moves"), [((2.5, 0.5), (0, 1)), ((0.5, 2.5), (1, 0)), (2.5, 0)])
def test_an_axis_at_rest_does_not_diverge(gains, moves):
    """With the axis at rest as the first one its runs were said to diverge; its error stays 0."""
    plant = StateSpace(np.zeros((2, 2)), np.eye(2), np.eye(2), dt=DT)
    task = Task(np.sin(np.arange(1.0, 10.0))[:, None] * np.broadcast_to(moves, 2), DT, inputs=2)
    machines = drawn_machines(Machine(plant, variation=Variation(dropped=0.2)), {}, {})
    found = long_run(machines, PIDType(gamma_p=np.broadcast_to(gains, 2)), task)
    assert found.claim[0] == (MONOTONE if np.any(moves) else NOTHING)
    assert ("no trial moves" in found.reason[0]) == (not np.any(moves))


def test_of_a_law_that_is_another_for_each_record_and_of_carried_states_nothing_is_claimed():
    lost = Machine(LAGS, variation=Variation(dropped=0.2))
    found = long_run(drawn_machines(lost, {}, {}), NormOptimal(LAGS, w_r=0.1), TASK)
    assert found.claim[0] == NOTHING
    carried = Machine(LAGS, variation=Variation(carried=1.0, dropped=0.2))
    found = carried_radius(carried, PIDType(gamma_p=3.0, leak=0.01), TASK)
    assert found.claim == NOTHING
    assert "single runs" in found.reason


def test_a_limit_that_noise_may_meet_late_in_a_transient_is_in_the_way():
    """The mean of the input is largest in trial 130, and most runs of 1500 trials are beyond it."""
    G = scipy.linalg.toeplitz((np.arange(10) + 1) * 0.9 ** np.arange(10), np.zeros(10))
    task, gain, mean, most = Task(np.append(0.0, np.ones(10)), DT), 0.03, np.zeros(10), []
    for _ in range(400):
        most.append(np.max(np.abs(mean)))
        mean = mean + gain * (1 - G @ mean)
    assert np.argmax(most) + 1 == 130
    plant = StateSpace([[1.8, -0.81], [1.0, 0.0]], [[1.0], [0.0]], [[1.0, 0.0]], dt=DT)
    limits = np.array([1.002, 1.2]) * max(most)
    machine = Machine(plant, Actuator(limit=1.0), Sensor(noise=0.03))
    found = long_run(of_each(machine, "actuator.limit", limits), PIDType(gamma_p=gain), task)
    assert found.claim.tolist() == [NOTHING, CONVERGES]
    assert found.reason[0] == "a limit may be met in a trial that is drawn"
    assert "; no limit is met within 5 standard deviations" in found.reason[1]


@pytest.mark.thorough
def test_a_limit_that_noise_may_meet_in_an_early_trial_is_in_the_way():
    """The mean begins 2 % below it, where nothing was drawn yet, and moves away from there on."""
    law = WarmStart(PIDType(gamma_p=0.1), PolynomialBasis((0,)), theta=[1.96])
    machine, task = Machine(AT_ONCE, Actuator(limit=1.0), Sensor()), Task(np.full(N + 1, 0.5), DT)
    found = long_run(of_each(machine, "sensor.noise", [0.3, 0.05]), law, task)
    assert list(found.claim) == [NOTHING, MONOTONE]
    assert found.reason[0] == "a limit may be met in a trial that is drawn"
    assert "; no limit is met within 5 standard deviations" in found.reason[1]


@pytest.mark.thorough
def test_a_limit_that_a_draw_may_meet_is_in_the_way():
    parts = Actuator(limit=1.0), Sensor(noise=0.1)
    machine = Machine(AT_ONCE, *parts, variation=Variation(dropped=0.2))
    machines = of_each(machine, "actuator.limit", [1.2, 50.0, 1e6])
    assert long_run(machines, PIDType(gamma_p=0.7), TASK).claim.tolist()[:2] == [NOTHING, MONOTONE]
    assert long_run(machines, PIDType(gamma_p=2.2), TASK).claim[2] == NOTHING


@pytest.mark.thorough
def test_what_noise_leaves_lies_between_its_quantile_and_the_bound_of_laurent_and_massart():
    """Of y[k+1] = u[k] each sample forgets by itself: N rms^2 / variance is chi square of N."""
    gain, size, t = 0.5, 0.2, np.log(20.0)
    machine = Machine(AT_ONCE, sensor=Sensor(noise=size))
    found = certify(machine, PIDType(gamma_p=gain), TASK, 30, {}, {})
    assert (found.claim[0], found.sense[0]) == (MONOTONE, "for every draw")
    assert "noise that is Gaussian" in found.reason[0]
    assert not len(found.broken_promises())
    each = size * np.sqrt(2 / (2 - gain))
    np.testing.assert_allclose(found.left[0], each, rtol=1e-6)
    exact = each * np.sqrt(scipy.stats.chi2.ppf(0.95, N) / N)
    most = each * np.sqrt((N + 2 * np.sqrt(N * t) + 2 * t) / N)
    assert exact < found.most[0] <= most
    above = found._replace(runs=np.full_like(found.runs, 1.01 * found.most[0]))
    assert len(above.broken_promises()) == 1


@pytest.mark.thorough
@pytest.mark.parametrize("kind", ["scatter", "noise of the input"])
def test_five_in_a_hundred_late_trials_have_more_error_than_is_told(kind):
    """A leak leaves an error in the mean; NumPy runs the trials by matrices of its own."""
    gain, leak, size, seeds = 0.8, 0.1, 0.3, 4000
    scatters = kind == "scatter"
    machine = Machine(
        LAGS,
        disturbance=None if scatters else Disturbance(input_noise=size),
        variation=Variation(scatter=size) if scatters else None,
    )
    found = long_run(drawn_machines(machine, {}, {}), PIDType(gamma_p=gain, leak=leak), TASK)
    rng, r = np.random.default_rng(8), np.asarray(TASK.reference)[1:, 0]
    G = lifted(LAGS, N)
    acts = 0.5 ** np.arange(1, N + 1)[:, None] if scatters else G
    u = np.zeros((seeds, N))
    for _ in range(60):
        e = r - u @ G.T - size * rng.standard_normal((seeds, acts.shape[1])) @ acts.T
        u = (1 - leak) * u + gain * e
    rms = np.sqrt(np.mean(e**2, axis=1))
    np.testing.assert_allclose(np.mean(rms**2), found.left[0] ** 2, rtol=0.1)
    assert np.mean(rms > found.most[0]) < 0.05
    assert found.most[0] < 1.6 * np.quantile(rms, 0.95)


def test_where_samples_are_lost_the_quantile_is_that_of_markov():
    machine = Machine(AT_ONCE, sensor=Sensor(noise=0.2), variation=Variation(dropped=0.25))
    found = certify(machine, PIDType(gamma_p=0.5), TASK, 40, {}, {})
    # d' = (1 - b / 2) d - b n / 2, b = 1 in 3 of 4 trials
    left = 0.75 * 0.25 * 0.2**2 / (1 - 0.25 - 0.75 * 0.25) + 0.2**2
    np.testing.assert_allclose(found.left[0], np.sqrt(left), rtol=1e-6)
    np.testing.assert_allclose(found.most[0], found.left[0] / np.sqrt(0.05), rtol=1e-12)
    assert "Markov" in found.reason[0]
    words = certificate_numbers(OfScheme(found, None, 1.0))
    said = left_words(words, 1.0, "mm")
    assert f"in 95 of 100 late trials of at most {number(found.most[0])} mm" in said
    assert said.endswith(f" runs are below {number(words['quantile'])} mm after 40 trials)")


def test_noise_of_more_inputs_than_are_followed_is_not_counted(monkeypatch):
    noise, law = Sensor(noise=0.2), PIDType(gamma_p=0.5)
    monkeypatch.setattr(certificates, "LARGEST", N - 1)
    found = certify(Machine(AT_ONCE, sensor=noise), law, TASK, 30, {}, {})
    assert (found.claim[0], found.sense[0], found.runs) == (MONOTONE, "but for noise", None)
    assert "not for 40" in found.reason[0]
    words = certificate_numbers(OfScheme(found, None, 1.0))
    assert senses_words(words) == ", but for noise,"
    said = (
        "without its noise, which is followed for up to 1024 inputs only, an rms error of at most"
    )
    assert left_words(words, 1.0, "mm") == f"{said} {number(words['floor'])} mm"


@pytest.mark.thorough
def test_beside_a_claim_on_trials_after_a_drift_stand_runs_after_it():
    """The runs would contradict it if the drift, of 10 times the gain, were in them."""
    after = StateSpace([[0.0]], [[1.0]], [[1.0]], dt=DT)
    before = StateSpace([[0.0]], [[0.1]], [[1.0]], dt=DT)
    drifts = Variation(change=PlantChange(after, first=3, over=400))
    noise, law = Sensor(noise=0.01), PIDType(gamma_p=0.9)
    found = certify(Machine(before, sensor=noise, variation=drifts), law, TASK, 12, {}, {})
    still = certify(Machine(after, sensor=noise), law, TASK, 12, {}, {})
    assert found.reason[0].startswith("from trial 402 on: ")
    np.testing.assert_allclose(found.most, still.most, rtol=1e-9)
    np.testing.assert_allclose(found.runs, still.runs, rtol=1e-9)
    assert not len(found.broken_promises())


@pytest.mark.thorough
def test_two_axes_that_are_alike_leave_what_one_does():
    """The mean square over both outputs is that of one; each of two errors is averaged with it."""
    found = []
    for axes in (1, 2):
        plant = StateSpace(0.5 * np.eye(axes), 0.5 * np.eye(axes), np.eye(axes), dt=DT)
        task = Task(np.repeat(np.asarray(TASK.reference), axes, axis=1), DT, inputs=axes)
        machine = Machine(plant, sensor=Sensor(noise=0.1))
        found.append(certify(machine, PIDType(gamma_p=0.7, leak=0.1), task, 30, {}, {}))
    one, two = found
    assert one.claim[0] == two.claim[0] == MONOTONE
    np.testing.assert_allclose(two.left, one.left, rtol=1e-6)
    np.testing.assert_allclose(two.predicted, one.predicted, rtol=1e-9)
    assert two.most[0] < 0.999 * one.most[0]  # Gaussian, and of twice as many samples


def test_of_many_inputs_the_errors_are_bounded_in_norm(monkeypatch):
    """The bounds are above what is exact for few inputs, and not so far that they say nothing."""
    machine = Machine(
        AT_ONCE,
        sensor=Sensor(noise=0.1),
        disturbance=Disturbance(input_noise=0.1),
        variation=Variation(delayed=0.2),
    )
    law = PIDType(gamma_p=0.6, leak=0.1)
    exact, found = (on_runs(machine, law, TASK, 30, in_norm=of)[0] for of in (False, True))
    assert exact.claim == found.claim == MONOTONE
    assert found.sense == "in mean square"
    assert exact.left <= found.left <= 2 * exact.left
    assert np.all(exact.rms <= found.rms * (1 + 1e-9))
    np.testing.assert_allclose(found.rms[-1], found.left, rtol=0.2)
    limited = dataclasses.replace(machine, actuator=Actuator(limit=50.0))
    (found,) = on_runs(limited, law, TASK, 3, in_norm=True)
    assert (found.claim, np.all(np.isnan(found.rms))) == (NOTHING, True)
    assert "without limits" in found.reason
    monkeypatch.setattr(certificates, "DENSE", N - 1)
    late = Machine(LAGS, variation=Variation(delayed=0.4, delay=3))
    for gain, claim in ((1.0, MONOTONE), (3.0, NOTHING)):
        found = certify(late, replaced(law, {"gamma_p": gain}), TASK, TRIALS, {}, {})
        assert (found.claim[0], np.all(np.isfinite(found.predicted))) == (claim, True)
        assert ("without limits" in found.reason[0]) == (claim == NOTHING)
        assert not len(found.broken_promises())
