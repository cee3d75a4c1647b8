"""Trials that differ, against loops in NumPy that are written from the definitions."""

import dataclasses
import itertools
from functools import partial

import control
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal
from cases import ALGEBRA, DT, case, first_order, follows
from scipy.integrate import solve_ivp

from jaxilc import (
    Machine,
    PlantChange,
    References,
    Sweep,
    Task,
    Uniform,
    Variation,
    figures,
    learn,
    outcomes,
    run_schemes,
)
from jaxilc.figures import browsers
from jaxilc.filters import ZeroPhaseButterworth, ZeroPhaseFIR
from jaxilc.learning import run_trial
from jaxilc.learning.metrics import measure
from jaxilc.learning.over_trials import check, truncated
from jaxilc.learning.quantities import WAYS, CountedMetric
from jaxilc.learning.variation import newest
from jaxilc.plants import (
    DifferenceEquation,
    Harmonics,
    ProcessModel,
    StateSpace,
    TimeVaryingStateSpace,
    from_control,
)
from jaxilc.pytree import replaced
from jaxilc.scenarios.campaigns import Given, open_campaign
from jaxilc.scenarios.from_file import read_scenario
from jaxilc.schemes import (
    CFDLMFAILC,
    PID,
    BasisFunctions,
    ConstrainedNormOptimal,
    Feedforward,
    Filtered,
    GivenBasis,
    GradientILC,
    KeepUnmeasured,
    Ladder,
    LearningFilter,
    NormOptimal,
    OnOutputs,
    PeriodTracking,
    PIDType,
    RepetitiveBasis,
    RepetitiveControl,
    Scheme,
    StopWhen,
    TwoStep,
    WithFeedback,
)
from jaxilc.schemes.weights import weighed
from jaxilc.signals.task import Trial
from jaxilc.theory import carried_radius
from jaxilc.theory.certificates import CONVERGES, DIVERGES, MONOTONE, NOTHING, long_run
from jaxilc.theory.linearity import alike_trials
from jaxilc.tuning.worst_case import worst_machine
from jaxilc.uncertainty import drawn_machines

N, A, B, GAIN = 20, 0.7, 0.3, 0.8
PLANT = StateSpace([[A]], [[B]], [[1.0]], dt=DT)
TASK = Task(np.sin(np.arange(N + 1) / 3), DT)
R = np.asarray(TASK.reference)[:, 0]
LAW = PIDType(gamma_p=GAIN)


def vary(**how):
    return Machine(PLANT, variation=Variation(**how))


def y_of(trial):
    return trial.y[:, 0]


def both_of(trial):
    return trial.u[:, 0], trial.y[:, 0]


@partial(jax.jit, static_argnames="task")
def outputs_of(machine, task, u, trials):
    """Return the outputs (J, N+1) of trials of these numbers, in each of which u is played."""
    play = partial(run_trial, machine, Scheme(), task, Feedforward(u), jax.random.key(0))
    return jax.vmap(lambda j: play(j).y[:, 0])(trials)


def claims(machine, law):
    return long_run(drawn_machines(machine, {}, {}), law, TASK)


def response(u, x0=0.0, a=A, b=B):
    y = np.empty(len(u) + 1)
    y[0] = x0
    for k in range(len(u)):
        y[k + 1] = a * y[k] + b * u[k]
    return y


@pytest.mark.thorough
def test_nothing_differs_without_a_variation_in_it():
    plain, same = (learn(machine, LAW, TASK, 5) for machine in (Machine(PLANT), vary()))
    np.testing.assert_array_equal(plain.rms, same.rms)
    assert same.start is None


@pytest.mark.thorough
def test_an_offset_is_the_same_and_scatter_another_in_each_trial():
    history = learn(vary(offset=0.2, scatter=0.0), LAW, TASK, 3, save=y_of)
    np.testing.assert_allclose(history.saved[:, 0], 0.2)
    key, scattered = jax.random.key(3), vary(offset=0.0, scatter=0.1)
    filtered = Filtered(LAW, ZeroPhaseButterworth(100.0))
    firsts = np.asarray(learn(scattered, filtered, TASK, 400, key=key, save=y_of).saved)[:, 0]
    assert len(np.unique(firsts)) == 400
    assert abs(np.std(firsts) / 0.1 - 1) < 6 / np.sqrt(2 * 400)
    again = learn(scattered, LAW, TASK, 3, key=key, first=5, save=y_of).saved
    np.testing.assert_allclose(again[:, 0], firsts[4:7], **ALGEBRA)


@pytest.mark.thorough
def test_what_is_drawn_of_the_state_is_new_in_each_trial_where_the_state_is_carried_too():
    """With nothing carried, x[0] of trials 1 and 2 are two draws: their correlation is none."""
    machine = vary(scatter=0.1, carried=0.0)

    def firsts(key):
        return learn(machine, LAW, TASK, 3, key=key, save=y_of).saved[:, 0]

    drawn = np.asarray(jax.vmap(firsts)(jax.random.split(jax.random.key(5), 1000)))
    apart = np.corrcoef(drawn.T)[np.triu_indices(3, 1)]
    assert np.max(np.abs(apart)) < 5 / np.sqrt(1000)
    assert np.max(np.abs(np.std(drawn, axis=0) / 0.1 - 1)) < 6 / np.sqrt(2000)


def test_a_plant_that_counts_its_samples_starts_at_the_first_whatever_is_added_to_its_state():
    """Its matrices are those of the trial's own samples, as with a state given by its parts."""
    B_of = 0.1 * (1 + np.arange(N) / 5)
    matrices = (np.full((N, 1, 1), A), B_of[:, None, None], np.ones((N, 1, 1)))
    machine = Machine(TimeVaryingStateSpace(*matrices, dt=DT), variation=Variation(offset=3.0))
    u = np.random.default_rng(2).standard_normal((N, 1))
    y = outputs_of(machine, TASK, u, np.array([1]))[0]
    x, wanted = 3.0, []
    for k in range(N):
        x = A * x + B_of[k] * u[k, 0]
        wanted.append(x)
    np.testing.assert_allclose(y[1:], wanted, **ALGEBRA)


def test_the_time_of_a_system_is_that_of_the_trial_whatever_is_added_to_its_state():
    def update(t, x, u, _):
        return -5 * x + (1 + jnp.sin(20 * t)) * u

    system = control.NonlinearIOSystem(update, lambda t, x, u, _: x, inputs=1, outputs=1, states=1)
    plant = from_control(system, substep=1e-3)
    machine, task = (Machine(plant, variation=Variation(offset=1.0)), Task(np.zeros(101), dt=0.01))
    y = outputs_of(machine, task, np.ones((100, 1)), np.array([1]))[0]
    exact = solve_ivp(
        lambda t, x: -5 * x + 1 + np.sin(20 * t), (0, 1), [1.0], t_eval=0.01 * np.arange(101),
        rtol=1e-10, atol=1e-12,
    )  # fmt: skip
    np.testing.assert_allclose(y, exact.y[0], rtol=0, atol=1e-6)


@pytest.mark.thorough
@pytest.mark.parametrize("over", [1, 3])
def test_it_is_the_parameters_of_a_plant_that_change(over):
    """A drive of 33 Hz, where 30 Hz become 20 Hz, ends with 23 Hz; the drive is SciPy's."""

    def drive(hertz):
        return ProcessModel(gain=1.0, frequencies=[2 * np.pi * hertz], dampings=[0.02])

    change = PlantChange(drive(20.0), first=2, over=over, before=drive(30.0))
    machine, task = Machine(drive(33.0), variation=Variation(change=change)), Task(np.ones(41), DT)
    u = np.random.default_rng(4).standard_normal((40, 1))
    trials = np.array([1, 2, 3, 4, 9])
    for j, y in zip(trials, outputs_of(machine, task, u, trials), strict=True):
        w = 2 * np.pi * (33 - 10 * np.clip((j - 1) / over, 0, 1))
        sampled = scipy.signal.cont2discrete(([w * w], [1, 0.04 * w, w * w]), DT)
        wanted = scipy.signal.lfilter(sampled[0].ravel(), sampled[1], np.r_[u[:, 0], 0])
        np.testing.assert_allclose(y, wanted, rtol=0, atol=1e-10)


def test_the_plants_of_a_drift_are_kept_only_where_they_are_sampled_anew():
    sampled = vary(change=PlantChange(PLANT, first=2, over=50)).sampled(DT)
    assert sampled.variation.change.course is None
    rising = ProcessModel(gain=1.0, frequencies=[200.0], dampings=[0.02])
    change = PlantChange(rising, first=2, over=50)
    machine = Machine(rising, variation=Variation(change=change))
    anew = jax.eval_shape(lambda: machine.sampled(DT))
    assert {x.shape[0] for x in jax.tree.leaves(anew.variation.change.course)} == {50}


@pytest.mark.thorough
@pytest.mark.parametrize("over", [1, 4])
def test_a_plant_jumps_or_drifts_from_a_trial_on(over):
    after = dataclasses.replace(PLANT, B=[[0.5]])
    machine = vary(change=PlantChange(after, first=3, over=over))
    history = learn(machine, LAW, TASK, 8, save=both_of)
    for j, u, y in zip(range(1, 9), *map(np.asarray, history.saved), strict=True):
        share = np.clip((j - 3 + 1) / over, 0, 1)
        np.testing.assert_allclose(y, response(u, b=B + share * 0.2), **ALGEBRA)
    known = dataclasses.replace(machine.variation.change, before=PLANT)
    drawn = replaced(vary(change=known), {"plant.A": [[0.6]]})
    last = jax.jit(lambda u: run_trial(drawn, Scheme(), TASK, Feedforward(u), jax.random.key(0)).y)
    y = last(np.ones((N, 1)))[:, 0]
    np.testing.assert_allclose(y, response(np.ones(N), a=0.6, b=0.5), **ALGEBRA)


@pytest.mark.thorough
def test_what_was_not_measured_is_not_learned_from():
    machine = vary(shortest=0.5)
    history = learn(machine, LAW, TASK, 6, save=lambda trial: (trial.u, trial.y, trial.weight))
    u, lengths = np.zeros(N), []
    for j in range(6):
        played, y, weight = (np.asarray(x[j]) for x in history.saved)
        np.testing.assert_allclose(played[:, 0], u, rtol=1e-9, atol=1e-12)
        there = weight[:, 0, 0]
        last = int(there.sum()) - 1
        lengths.append(last)
        np.testing.assert_array_equal(there, np.arange(N + 1) <= last)
        e = np.where(there > 0, R - response(u), 0.0)
        np.testing.assert_allclose(R - y[:, 0], e, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(
            history.rms[j, 0], np.sqrt(np.mean(e[1 : last + 1] ** 2)), rtol=1e-9
        )
        np.testing.assert_allclose(history.max_error[j, 0], np.max(np.abs(e[1:])), rtol=1e-9)
        u = u + GAIN * e[1:]
    assert min(lengths) >= N / 2
    assert len(set(lengths)) > 2


def test_a_trial_that_ends_before_its_window_has_no_error_of_it(tmp_path):
    """It had the error 0 there, so a machine that learned nothing passed."""
    there = (np.arange(N + 1) <= 8).astype(float)[:, None]
    record = Trial(TASK.reference, np.zeros((N + 1, 1)), np.zeros((N, 1)), DT)
    record = weighed(record, jnp.asarray(there))
    kinds = [CountedMetric(of, at) for at in (((4, 6), (12, 15)), ((9, 12),)) for of in WAYS]
    found, counted = jax.jit(lambda of: (measure(of, TASK), [kind(of) for kind in kinds]))(record)
    assert np.isnan(found.settled_error[0])
    assert bool(found.finite)
    np.testing.assert_allclose(found.rms[0], np.sqrt(np.mean(R[1:9] ** 2)), rtol=1e-6)
    of = dict(zip(WAYS, counted, strict=False))
    np.testing.assert_allclose(of["largest"], np.max(np.abs(R[4:6])), rtol=1e-6)
    np.testing.assert_allclose(of["root mean square"], np.sqrt(np.mean(R[4:6] ** 2)), rtol=1e-6)
    assert np.all(np.isnan(counted[len(WAYS) :]))

    said = r"shortest = 0\.4: .* at 0.008 s, before the settled .* at 0.01 s; .* from 0\.5 on"
    with pytest.raises(ValueError, match=said):
        learn(vary(shortest=0.4), LAW, TASK, 2)
    check(vary(shortest=0.4), LAW, dataclasses.replace(TASK, settle=(0.008, 0.02)))
    check(vary(shortest=np.float32(0.7)), LAW, dataclasses.replace(TASK, settle=(0.014, 0.02)))
    drawn = {"variation.shortest": Uniform(0.3, 0.4)}
    with pytest.raises(ValueError, match=r"shortest = 0\.3.* before the settled window"):
        Sweep(vary(shortest=0.8), {"law": LAW}, TASK, 2, drawn, machines=4)
    path = tmp_path / "axis.toml"
    path.write_text(FILE.replace("[task]", "[task]\nwindows = [0.02, [0.09, 0.1]]"))
    with pytest.raises(ValueError, match=r"axis\.toml: .*shortest = 0\.8.* at 0\.09 s; .* 0\.9 on"):
        read_scenario(path)


@pytest.mark.thorough
def test_dropped_samples_count_in_the_error_but_not_in_learning():
    history = learn(vary(dropped=0.4), LAW, TASK, 5, save=both_of)
    played, y = (np.asarray(x) for x in history.saved)
    e = R - y
    np.testing.assert_allclose(history.rms[:, 0], np.sqrt(np.mean(e[:, 1:] ** 2, axis=1)))
    learned = np.diff(played, axis=0)
    lost = np.isclose(learned, 0, atol=1e-14)
    np.testing.assert_allclose(learned[~lost], GAIN * e[:-1, 1:][~lost], rtol=1e-8)
    assert 0.2 < lost.mean() < 0.6


@pytest.mark.thorough
def test_a_late_record_is_learned_from_as_it_is():
    history = learn(vary(late=3), LAW, TASK, 8, save=both_of)
    played, y = (np.asarray(x) for x in history.saved)
    found = set()
    for j in range(7):
        e = [R - np.concatenate([np.full(d, y[j, 0]), y[j, : N + 1 - d]]) for d in range(4)]
        off = [np.max(np.abs(played[j + 1] - played[j] - GAIN * e_d[1:])) for e_d in e]
        found.add(int(np.argmin(off)))
        assert min(off) < 1e-12
    assert len(found) > 1


@pytest.mark.parametrize("most", [1, 2])
def test_a_delayed_sample_is_held_until_the_next_one_arrives(most):
    """All draws of the delays of a short record, in NumPy, against the mean and the draws."""
    chance, rows = 0.4, 5
    y = np.array([3.0, -1.0, 4.0, 1.0, -5.0])
    mean, records = np.zeros(rows), set()
    for delays in itertools.product(range(most + 1), repeat=rows - 1):
        share = np.prod([1 - chance if d == 0 else chance / most for d in delays])
        arrived = [[m for m, d in enumerate((0, *delays)) if m + d <= k] for k in range(rows)]
        held = y[[max(there) for there in arrived]]
        mean += share * held
        records.add(tuple(held))
    keys = jax.random.split(jax.random.key(2), 4000)
    drawn = np.asarray(jax.vmap(lambda key: newest(y[:, None], chance, most, key))(keys))[..., 0]
    assert {tuple(row) for row in drawn} == records
    error = 6 * drawn.std(0) / np.sqrt(len(keys))
    assert np.all(np.abs(drawn.mean(0) - mean) <= error + 1e-12)
    expected = jax.jit(lambda y: newest(y, chance, most, None))(y[:, None])
    np.testing.assert_allclose(expected[:, 0], mean, **ALGEBRA)


@pytest.mark.thorough
def test_delayed_samples_are_learned_from_as_they_are():
    machine = vary(delayed=0.4, shortest=0.6)
    history = learn(machine, LAW, TASK, 6, save=lambda t: (t.u, t.y, t.weight))
    played, y, there = (np.asarray(x)[:, :, 0] for x in history.saved)
    late = 0
    for j in range(5):
        there_now = there[j, 1:, 0] > 0
        learned = (played[j + 1] - played[j])[there_now]
        e = [GAIN * (R[1:] - held)[there_now] for held in (y[j, 1:], y[j, :-1])]
        off = np.abs(learned - np.stack(e))
        assert np.max(off.min(0)) < 1e-12
        late += np.sum(off.argmin(0))
        np.testing.assert_allclose((played[j + 1] - played[j])[~there_now], 0, atol=1e-14)
    assert 0.2 < late / there[:5, 1:].sum() < 0.6


@pytest.mark.thorough(but=["dropped", "delayed"])
@pytest.mark.parametrize("name", ["shortest", "dropped", "delayed"])
def test_a_chance_has_no_slope_and_says_so(name):
    machine = vary(shortest=0.8, dropped=0.1, delayed=0.2)

    def loss(chance, gain):
        moved = replaced(machine, {f"variation.{name}": chance})
        return jnp.sum(learn(moved, PIDType(gamma_p=gain), TASK, 4).rms)

    with pytest.raises(ValueError, match="shortest, dropped and delayed are chances"):
        jax.grad(loss)(0.3, 0.5)

    @jax.jit
    def mean(chance):  # of a record, which theory takes, and which has a slope
        known = machine.noiseless().variation
        known = replaced(known, {name: chance})
        trial = Trial(jnp.asarray(TASK.reference), jnp.cos(TASK.reference), jnp.zeros((N, 1)), DT)
        there = known.measured(TASK, None)
        return jnp.sum(
            known.shown(weighed(trial, there[:, None]), None).e
            * jnp.sin(jnp.arange(N + 1))[:, None]
        )

    found = (mean(0.3 + 1e-6) - mean(0.3 - 1e-6)) / 2e-6
    assert abs(found) > 1e-3
    np.testing.assert_allclose(jax.grad(mean)(0.3), found, rtol=1e-5)


def test_a_worst_machine_is_not_looked_for_along_a_chance():
    spread = {"variation.dropped": Uniform(0.0, 0.3)}
    with pytest.raises(ValueError, match="are chances"):
        worst_machine(vary(dropped=0.1), LAW, TASK, 4, spread, starts=2, steps=2)


def test_references_change_and_what_is_played_follows_them():
    other = np.stack([2 * R, -R])[..., None]
    values = np.concatenate([np.asarray(TASK.reference)[None], other])
    for first, expected in (((3, 4), [1, 1, 2, -1, -1]), ((), [1, 2, -1, 1, 2])):
        machine = vary(references=References(values, first))
        r = learn(machine, LAW, TASK, 5, save=lambda trial: trial.r).saved[..., 0]
        np.testing.assert_allclose(r, np.outer(expected, R), **ALGEBRA)


def test_a_feedback_sees_what_the_record_has_lost():
    """Before anything is learned, a loop moves as if no sample of its record were lost or late."""
    loop, key = WithFeedback(LAW, PID(kp=0.5, ki=20.0)), jax.random.key(4)
    plain, other = (
        learn(machine, loop, TASK, 2, key=key, save=y_of).saved
        for machine in (Machine(PLANT), vary(dropped=0.2, late=2, delayed=0.5, delay=3))
    )
    np.testing.assert_array_equal(plain[0], other[0])
    assert np.max(np.abs(plain[1] - other[1])) > 1e-3


@pytest.mark.thorough
def test_a_carried_state_is_that_of_plant_feedback_and_actuator():
    loop = WithFeedback(LAW, PID(kp=0.5, ki=20.0))
    history = learn(vary(carried=1.0), loop, TASK, 3, save=y_of)
    # the same as one long trial: NumPy's loop goes on where the trial before has ended
    x, integral, u_learned = 0.0, 0.0, np.zeros(N)
    for j in range(3):
        y, u, fed = np.empty(N + 1), np.empty(N), np.empty(N)
        y[0] = x
        for k in range(N):
            e = R[k] - y[k]
            integral += 20.0 * DT * e
            fed[k] = 0.5 * e + integral
            u[k] = u_learned[k] + fed[k]
            y[k + 1] = A * y[k] + B * u[k]
        np.testing.assert_allclose(history.saved[j], y, rtol=1e-8, atol=1e-10)
        x, u_learned = y[-1], u_learned + GAIN * (R - y)[1:]
    half = learn(vary(carried=0.5), LAW, TASK, 3, save=y_of).saved
    np.testing.assert_allclose(half[1:, 0], 0.5 * half[:-1, -1], **ALGEBRA)
    both = learn(vary(carried=1.0), loop, TASK, 2)
    rest = learn(vary(carried=1.0), loop, TASK, 1, memory=both.memory, first=3, start=both.start)
    np.testing.assert_allclose(rest.rms[-1], history.rms[-1], rtol=1e-9)
    cut = truncated(vary(carried=1.0), loop, TASK, 3, 1)
    np.testing.assert_allclose(cut.rms, history.rms, rtol=1e-9)


@pytest.mark.thorough
def test_a_carried_state_comes_to_rest_on_the_plant_and_reference_of_the_trial_that_starts():
    """It was the rest of the trial before: an input of -2875 where there is none, at a change."""
    rest = np.where(np.arange(1, 6) >= 3, 5.0, 1.0)
    before, after = (dataclasses.replace(PLANT, x0=[x]) for x in (1.0, 5.0))
    change = PlantChange(after, first=3)
    for share in (0.0, 0.4):
        machine = Machine(before, variation=Variation(carried=share, change=change))
        y = learn(machine, LAW, TASK, 5, save=y_of).saved
        ends = np.concatenate([[1.0], y[:-1, -1]])
        np.testing.assert_allclose(y[:, 0], rest + share * (ends - rest), rtol=1e-9)

    loop, values = PID(kp=0.5, ka=2e-4), np.stack([R, 3.0 + 2 * R])[..., None]
    inputs = []
    for share in (0.0, None):
        machine = vary(references=References(values, (3,)), carried=share)
        inputs.append(learn(machine, loop, TASK, 4, save=both_of).saved[0])
    np.testing.assert_allclose(*inputs, **ALGEBRA)


@pytest.mark.thorough
def test_a_carried_state_begins_at_rest_on_the_plant_and_reference_of_the_first_trial():
    """A plant that is another one from trial 1 on rested as the one before in its first trial."""
    before, after = (dataclasses.replace(PLANT, x0=[x]) for x in (0.0, 1.0))
    change, values = PlantChange(after, first=1), np.stack([0 * R + 5.0, R])[..., None]
    for carried in (None, 0.0, 0.7):
        of_plant = Machine(before, variation=Variation(carried=carried, change=change))
        assert learn(of_plant, LAW, TASK, 1, save=y_of).saved[0, 0] == 1.0
        # a feedback that differentiates the reference sees no step before the first sample
        of_task = vary(references=References(values), carried=carried)
        assert learn(of_task, PID(ka=2e-4), TASK, 1).effort[0, 0] == 0.0


def basis_by_hand(share, by_period, trials):
    """(J, N+1) outputs under weights of a wave of 8 samples, whose clock goes on over trials."""
    x, clock, w, waiting, rows = 0.0, 0, np.zeros(2), np.zeros(2), []
    for _ in range(trials):
        y = [x]
        for k in range(N):
            if by_period and clock and clock % 8 == 0:
                w, waiting = w + waiting, np.zeros(2)
            wave = np.array([np.cos(np.pi * clock / 4), np.sin(np.pi * clock / 4)])
            y.append(A * y[-1] + B * wave @ w)
            change = 0.3 * wave * (R[k] - y[k])
            w, waiting = (w, waiting + change) if by_period else (w + change, waiting)
            clock += 1
        rows.append(y)
        x, w, waiting = share * y[-1], share * w, share * waiting
    return np.array(rows)


@pytest.mark.thorough
@pytest.mark.parametrize("by_period", [False, True])
def test_the_clock_of_a_law_goes_on_where_the_state_is_carried(by_period):
    law = RepetitiveBasis(Harmonics(8 * DT, (1,)), gain=0.3, by_period=by_period)

    @jax.jit
    def outputs(share):
        return learn(vary(carried=share), law, TASK, 4, save=y_of).saved

    for share in (1.0, 0.6, 0.0):
        y = outputs(share)
        np.testing.assert_allclose(y[0], basis_by_hand(share, by_period, 1)[0], **ALGEBRA)
        if share:
            np.testing.assert_allclose(y, basis_by_hand(share, by_period, 4), **ALGEBRA)
        else:  # each trial starts at rest, and so does the clock
            np.testing.assert_array_equal(y, np.broadcast_to(y[0], y.shape))
    _, slope = jax.jvp(outputs, (0.6,), (1.0,))
    ends = [basis_by_hand(0.6 + by, by_period, 4) for by in (-1e-6, 1e-6)]
    np.testing.assert_allclose(slope, (ends[1] - ends[0]) / 2e-6, rtol=1e-6, atol=1e-7)


@pytest.mark.thorough
def test_a_period_that_is_longer_than_a_trial_is_found_where_the_state_is_carried():
    """An output grows by one turn in 20.6 samples, of which no trial sees a whole one."""
    turning = StateSpace(
        [[0.5, 0.0, 0.0], [0.0, 1.0, 1.0], [0.0, 0.0, 1.0]], [[0.5], [0.0], [0.0]],
        [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], dt=DT, x0=[0.0, 0.0, 1 / 20.6],
    )  # fmt: skip
    law = RepetitiveControl(
        LearningFilter([0.5], [0.25, 0.5, 0.25]),
        period=20 * DT,
        tracking=PeriodTracking(angle=1, fastest=0.05),
    )
    machine = Machine(turning, variation=Variation(carried=1.0))
    found = learn(machine, law, Task(np.zeros((N + 1, 2)), dt=DT, inputs=1), 40).final
    np.testing.assert_allclose(found.signals["period"][-1] / DT, 20.6, rtol=1e-4)


@pytest.mark.thorough
@pytest.mark.parametrize("gain", [0.8, 3.0, 9.0])
def test_repetitive_control_is_certified_by_its_whole_map(gain):
    machine, law = vary(carried=1.0), PIDType(gamma_p=gain, leak=0.01)
    found = carried_radius(machine, law, TASK)
    M = np.zeros((N + 1, N + 1))  # of (u, x[0])
    for i in range(N + 1):
        u, x0 = np.eye(N + 1)[i, :N], np.eye(N + 1)[i, N]
        y = response(u, x0)
        M[:, i] = np.concatenate([0.99 * u - gain * y[1:], y[-1:]])
    np.testing.assert_allclose(found.radius, np.max(np.abs(np.linalg.eigvals(M))), rtol=1e-6)
    errors = np.asarray(learn(machine, law, TASK, 300).rms)[:, 0]
    if found.claim == CONVERGES:
        assert abs(errors[-1] - errors[-2]) < 1e-6
    else:
        assert found.claim == DIVERGES
        assert errors[-1] > errors[0]
    said = claims(machine, law)
    assert said.claim[0] == NOTHING
    assert "carried_radius" in said.reason[0]


def test_what_is_said_of_a_machine_that_carries_its_state_holds_for_a_share_of_0_too():
    """It was said that each trial starts where the one before has ended."""
    said = alike_trials(vary(carried=0.0), LAW, TASK).detail  # of others that are drawn, too
    assert "starts with a share (`carried`) of the state" in said
    assert "leave `carried` out where it is 0" in said


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("law", "w"),
    [(GradientILC(PLANT, step=1.0), None), (ConstrainedNormOptimal(PLANT, w_r=0.2), 0.2)],
)
def test_a_counter_of_a_law_is_no_eigenvalue_where_the_state_is_carried(law, w):
    """Both count trials, `beyond` and `unsolved`, which no trial to come depends on."""
    G = np.array([response(one)[1:] for one in np.eye(N)]).T
    gain = G.T if w is None else np.linalg.solve(G.T @ G + w * np.eye(N), G.T)
    x0 = response(np.zeros(N), 1.0)[1:, None]
    M = np.block([[np.eye(N) - gain @ G, -gain @ x0], [0.7 * G[-1:], 0.7 * x0[-1:]]])
    found = carried_radius(vary(carried=0.7), law, TASK)
    assert found.claim == CONVERGES
    np.testing.assert_allclose(found.radius, np.max(np.abs(np.linalg.eigvals(M))), rtol=1e-9)


@pytest.mark.thorough(but=["how0"])
@pytest.mark.parametrize(
    "how",
    [
        {"scatter": 0.05, "late": 1, "dropped": 0.2},
        {"shortest": 0.6, "late": 1, "delayed": 0.3, "delay": 2},
        {"change": PlantChange(dataclasses.replace(PLANT, B=[[0.5]]), first=4, over=3)},
    ],
)
def test_claims_hold_in_the_mean_over_machines_and_say_so(how):
    machine, law = vary(**how), PIDType(gamma_p=0.6, leak=0.02)
    certificate = claims(machine, law)
    assert certificate.claim[0] in (MONOTONE, CONVERGES)
    said = "from trial 6 on" if "change" in how else "in mean square"
    assert said in certificate.reason[0]
    assert certificate.sense[0] == ("" if "change" in how else "in mean square")
    limit = np.asarray(certificate.outlook.limit)[0]

    def learned(key):
        return learn(machine, law, TASK, 150, key=key).memory.u[:, 0]

    found = np.asarray(jax.jit(jax.vmap(learned))(jax.random.split(jax.random.key(1), 200)))
    error = 6 * found.std(0) / np.sqrt(200) + 1e-4 * np.max(np.abs(limit))
    moving = found.mean(0)[-len(limit) :]
    assert np.all(np.abs(moving - limit) <= error[-len(limit) :])


def test_what_theory_cannot_say_it_does_not():
    optimal, leaky = NormOptimal(PLANT, w_r=0.1), PIDType(gamma_p=0.6, leak=0.1)
    for law, how, said in (
        (optimal, {"dropped": 0.2}, "NormOptimal is another law for each set of samples"),
        # it forgets nothing of what was lost, so its mean is not that of mean samples
        (KeepUnmeasured(leaky), {"dropped": 0.2}, "KeepUnmeasured is another law for each set"),
        (
            optimal,
            {"references": References(np.stack([R, 2 * R])[..., None])},
            "changes after every trial",
        ),
    ):
        found = claims(vary(**how), law)
        assert found.claim[0] == NOTHING
        assert said in found.reason[0]
    # of the last reference alone, `diverges` was said of a law on a basis whose error stays
    turns = vary(carried=0.5, references=References(np.stack([R, 2 * R])[..., None]))
    carried = carried_radius(turns, LAW, TASK)
    assert carried.claim == NOTHING
    assert "changes after every trial" in carried.reason


@pytest.mark.thorough
def test_laws_that_compare_trials_keep_what_was_not_measured():
    law = CFDLMFAILC(phi0=0.3, lam=0.02, mu=0.05, rho=0.6, reset="sign")
    machine = vary(dropped=0.3)
    kept = learn(machine, KeepUnmeasured(law), TASK, 60)
    assert float(kept.rms[-1, 0]) < 1e-3
    whole, plain = (learn(Machine(PLANT), one, TASK, 8) for one in (KeepUnmeasured(law), law))
    np.testing.assert_array_equal(whole.rms, plain.rms)


def test_the_samples_that_are_kept_are_those_that_the_law_within_learns_from():
    law, rng = PIDType(gamma_p=0.5, leak=0.1, lead=3), np.random.default_rng(2)
    e, u = rng.standard_normal((N + 1, 1)), jnp.asarray(rng.standard_normal((N, 1)))
    lost = np.ones((N + 1, 1))
    lost[10:13] = 0.0
    r = jnp.asarray(TASK.reference)
    trial = weighed(Trial(r, r - e, u, DT), jnp.asarray(lost))
    for one in (law, Filtered(law, ZeroPhaseFIR((1.0,))), OnOutputs(law, (0,))):
        kept = KeepUnmeasured(one).learn(Feedforward(u), trial)
        np.testing.assert_array_equal(np.flatnonzero((kept.u == u)[:, 0]), [6, 7, 8])
    beside = KeepUnmeasured(WithFeedback(law, PID()))
    memory = beside.initial_memory(TASK)
    memory = memory._replace(learning=Feedforward(u))
    kept = beside.learn(memory, trial._replace(signals={"feedback": jnp.zeros((N, 1))}))
    np.testing.assert_array_equal(np.flatnonzero((kept.learning.u == u)[:, 0]), [6, 7, 8])
    of_each = BasisFunctions(GivenBasis(np.eye(N)[:, None]), PLANT)  # N parameters are no samples
    before = of_each.initial_memory(TASK)
    kept = KeepUnmeasured(of_each).learn(before, trial)
    np.testing.assert_array_equal(kept.theta, of_each.learn(before, trial).theta)


def test_of_a_sample_that_no_trial_has_measured_nothing_is_learned():
    """MFAILC took its output for zero, and learned from all of the reference."""
    law = KeepUnmeasured(CFDLMFAILC(phi0=0.3, lam=0.02, mu=0.05, rho=0.6, reset="sign"))
    seen, memory, r = np.ones((N + 1, 1)), law.initial_memory(TASK), jnp.asarray(TASK.reference)
    seen[8:12] = 0.0
    for _ in range(2):
        trial = weighed(Trial(r, r - 0.01, memory.u, DT), jnp.asarray(seen))
        memory = law.learn(memory, trial)
        u = np.asarray(law.feedforward(memory, TASK))[:, 0]
        np.testing.assert_array_equal(u == 0.0, seen[1:, 0] == 0.0)


@pytest.mark.parametrize(
    "law",
    [
        ConstrainedNormOptimal(PLANT, w_r=1e-2, y_low=-0.7, y_high=0.8),
        TwoStep(PLANT, w_alpha=1e-3, w_r=1e-2, y_low=-0.7, y_high=0.8),
    ],
    ids=["constrained", "two_step"],
)
def test_bounds_within_the_reference_bind_no_sample_that_was_lost(law):
    assert np.max(np.abs(R)) > 0.9
    history = learn(vary(dropped=0.1), law, TASK, 6, save=y_of)
    assert float(history.memory.unsolved) == 0
    plain = learn(Machine(PLANT), law, TASK, 6, save=y_of)
    np.testing.assert_allclose(history.saved[-1], plain.saved[-1], atol=2e-2)


@pytest.mark.parametrize(
    "guard", [partial(Ladder, repeats=3), partial(StopWhen, growth=0.02)], ids=["ladder", "stop"]
)
def test_what_was_not_measured_is_kept_of_a_law_and_not_of_the_guard_around_it(guard):
    """The sums of a ladder had rows of earlier steps, and the error grew where it has to fall."""
    machine, law = vary(dropped=0.3), PIDType(gamma_p=0.8, leak=0.01, lead=2)
    within, around = (
        learn(machine, one, TASK, 30)
        for one in (guard(KeepUnmeasured(law)), KeepUnmeasured(guard(law)))
    )
    np.testing.assert_allclose(around.rms, within.rms, rtol=1e-9)
    jax.tree.map(np.testing.assert_allclose, around.memory, within.memory)
    assert getattr(within.memory, "frozen", 1.0) == 1.0  # the guard has stopped


@pytest.mark.thorough
def test_slopes_go_through_what_differs():
    after = dataclasses.replace(PLANT, B=[[0.4]])
    machine = vary(
        offset=0.1,
        scatter=0.05,
        carried=0.6,
        shortest=0.7,
        dropped=0.1,
        late=1,
        delayed=0.2,
        delay=2,
        change=PlantChange(after, 3, 2),
        references=References(np.stack([R, 1.5 * R])[..., None], (3,)),
    )

    @jax.jit
    def loss(x):
        moved = replaced(
            machine,
            {
                "variation.offset": 0.1 * x,
                "variation.scatter": 0.05 * x,
                "variation.carried": 0.6 * x,
                "variation.change.after.B": jnp.array([[0.4]]) * x,
            },
        )
        return jnp.sum(learn(moved, PIDType(gamma_p=0.5 * x), TASK, 5).rms)

    slope = jax.grad(loss)(1.0)
    np.testing.assert_allclose(slope, (loss(1 + 1e-6) - loss(1 - 1e-6)) / 2e-6, rtol=1e-6)


@pytest.mark.thorough
def test_the_dataset_and_the_figures_of_a_run_have_the_reference_of_each_trial():
    values = np.stack([R, 2 * R])[..., None]
    dataset, histories = run_schemes(vary(references=References(values, (3,))), {"p": LAW}, TASK, 4)
    np.testing.assert_allclose(dataset["r"], values[[0, 0, 1, 1]], rtol=1e-6)
    rms = np.sqrt(np.mean(dataset["e"].values[0, :, 1:] ** 2, axis=1))
    np.testing.assert_allclose(rms, histories["p"].rms, rtol=1e-5)
    lines = figures.tracking(dataset, "p", (1, 4))[0, 0].lines
    for line, r in zip(lines[:2], values[..., 0], strict=True):
        np.testing.assert_allclose(line.get_ydata(), r, rtol=1e-6)
    assert "each trial" in browsers.trials(dataset).caption


@pytest.mark.thorough
def test_a_sweep_draws_what_differs():
    machine = vary(scatter=0.01, change=PlantChange(PLANT, 2))
    spread = {
        "variation.scatter": Uniform(0.5, 2.0, relative=True),
        "variation.change.after.B": Uniform(0.8, 1.2, relative=True),
    }
    dataset = Sweep(machine, {"law": LAW}, TASK, 3, spread, machines=4).run()
    assert np.all(np.isfinite(dataset["rms"]))
    assert len(np.unique(np.asarray(dataset["rms"])[0, :, -1])) == 4


LAWS = ["model_free", "constrained", "at_samples", "ilc_asmc"]


@pytest.mark.thorough(but=["model_free"])
@pytest.mark.slow
@pytest.mark.parametrize("name", LAWS)
def test_every_law_runs_where_trials_differ(name):
    """Every law of the list runs on trials that differ, and a lost sample never reaches it."""
    machine, scheme, task = case(name)
    several, every = jnp.stack([task.reference, 0.9 * task.reference]), scheme.trials_a_step
    varied = Variation(
        scatter=1e-3,
        carried=0.5,
        shortest=0.6,
        dropped=0.1,
        late=1,
        delayed=0.1,
        delay=2,
        references=References(several, () if every == 1 else (1 + every,)),
    )
    machine = dataclasses.replace(machine, variation=varied)
    history = learn(machine, scheme, task, 4)
    assert np.all(np.isfinite(history.rms))


def in_steps_of_4(*first):
    """A basis under `Ladder` kept 20 % of the error for ever, where it is learned to 0 alone."""
    values = np.stack([R, 2 * R, R][: 1 + (len(first) or 1)])[..., None]
    learn(vary(references=References(values, first)), Ladder(LAW, repeats=4), TASK, 1)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: vary(carried=1.5), r"carried = 1.5 is outside"),
        (lambda: in_steps_of_4(), r"Ladder learns from 4 trials .* after each trial; .* 5, 9 and"),
        (lambda: in_steps_of_4(5, 8), r"variation.references changes it in trial 8"),
        (lambda: vary(late=30).check(TASK), "late = 30 is outside"),
        (lambda: vary(delayed=0.1, delay=30).check(TASK), "delay = 30 is outside"),
        (lambda: vary(delayed=1.0), "delayed = 1 is outside"),
        (lambda: vary(scatter=(1.0, 2.0)).check(TASK), r"needs \(\) or \(1,\)"),
        (lambda: vary(references=References(np.ones((2, 5, 1)))).check(TASK), "this task needs"),
        (lambda: References(np.ones((2, 5, 1)), (1,)), "rising numbers of trials from 2"),
        (
            lambda: vary(change=PlantChange(DifferenceEquation((A,), (B,), dt=DT), 2)).check(TASK),
            "of the same class and shapes",
        ),
        (lambda: carried_radius(Machine(PLANT), LAW, TASK), "starts each trial alike"),
    ],
)
def test_what_does_not_fit_is_named(make, said):
    with pytest.raises(ValueError, match=said):
        make()


FILE = f"""{first_order(0.7, 0.3)}{follows(10.0, 0.1)}[machine.variation]
scatter = 0.01
shortest = 0.8
late = 1
delayed = 0.1
delay = 2
change = {{ first = 4, over = 2, scale = {{ B = 1.2 }} }}

[[machine.variation.references]]
first = 6
{follows(10.0, 0.1, amplitude=2.0)}
[schemes.ilc]
class = "KeepUnmeasured"
scheme = {{ class = "PIDType", gamma_p = 0.5 }}
"""


def test_a_controller_follows_one_reference(tmp_path):
    """That of the task was written and certified for trials that were told to have another."""
    path = tmp_path / "axis.toml"
    path.write_text(FILE, encoding="utf-8")
    with pytest.raises(ValueError, match="a campaign follows the reference of the task in every"):
        open_campaign(tmp_path / "a", Given(scenario=str(path)), new=True, dry_run=True)
    with pytest.raises(ValueError, match="an exported law follows the reference of the task"):
        outcomes.export(str(path), folder=tmp_path / "law", limit=1.0)


def test_a_plant_file_says_how_trials_differ(tmp_path):
    file = tmp_path / "axis.toml"
    file.write_text(FILE)
    machine = read_scenario(file).machine
    np.testing.assert_allclose(machine.variation.change.after.B, [[0.36]])
    assert machine.variation.references.first == (6,)
    for old, new, said in (
        ("scale = { B", "scale = { D", "'D' is not a parameter"),
        ("scale = {", "set = { B = [[0.2]] }, scale = {", "B is changed by B already"),
        ("scale = {", "set = { 'B[0][0]' = 0.2 }, scale = {", "change: B.* is changed by B al"),
        ("scatter = 0.01", "scater = 0.01", "scater"),
        ("late = 1", "averaged = true", "averaged = true; allowed is false"),
        ("first = 4", "first = 0", r"first = 0 is outside"),
        ("0, frequency = 10.0, duration = 0.1", "0, frequency = 10.0, duration = 0.2", "one l"),
    ):  # fmt: skip
        file.write_text(FILE.replace(old, new, 1))
        with pytest.raises(ValueError, match=said):
            read_scenario(file)
