"""What is learned over the position at one speed serves others, and what a trial tells of it."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxilc import Machine, Sensor, Task, Variation, learn, theory
from jaxilc.identification import pitch_of
from jaxilc.plants import ByPosition, Harmonics, PositionMap, Splines, StateSpace
from jaxilc.schemes import (
    PID,
    BasisFunctions,
    GradientILC,
    JoinedBasis,
    OnBasis,
    PIDType,
    PolynomialBasis,
    PositionBasis,
    RationalBasis,
    SelectedBasis,
    WithFeedback,
    fitted,
)

DT, START = 2e-3, 5.0
SAMPLES = 3000  # of all tasks, so that one program serves them
GAINS = {"kp": 20.0, "ki": 100.0, "kd": 0.4}
DRIVE = StateSpace([[0, 1], [0, -2.0]], [[0], [200.0]], [[1, 0]], x0=(START, 0))  # N to mm
COGGING = PositionMap(Harmonics(12.0, (1, 2)), (3.0, 1.0, 0.5, 0.8))
FRICTION = PositionMap(
    Splines(0, 50, 6, degree=1), (-4, -5, -7, -5, -3, -4, 4, 5, 6, 5, 4, 4), turning=8.0
)
MACHINE = Machine(ByPosition(ByPosition(DRIVE, COGGING), FRICTION))
BASIS = JoinedBasis(
    (
        PolynomialBasis((1, 2)),
        PositionBasis(Harmonics(12.0, (1, 2, 3))),
        PositionBasis(Splines(0, 50, 6, degree=1), turning=8.0),
    )
)


def closed():
    """The drive under its feedback, from what is added to the input to the position."""
    held = StateSpace(DRIVE.A, DRIVE.B, DRIVE.C).sampled(DT)
    A, B, C = (np.asarray(M) for M in (held.A, held.B, held.C))
    kp, ki, kd = GAINS.values()
    whole = np.zeros((4, 4))
    whole[:2, :2] = A - (kp + kd / DT + ki * DT) * B @ C
    whole[:2, 2:] = B @ [[-ki * DT, kd / DT]]
    whole[2, :3] = [*C[0], 1]
    whole[3, :2] = C[0]
    return StateSpace(whole, np.vstack([B, 0, 0]), np.hstack([C, [[0, 0]]]), dt=DT)


def there_and_back(speed, stroke=40.0):
    """A motion from 5 mm by `stroke` and back, with cruises of this speed [mm/s], and a rest."""
    ramp, T = 0.1, stroke / speed + 0.1
    t = np.arange(0, T, DT)
    v = speed * np.clip(np.minimum(t, T - t) / ramp, 0, 1)
    v *= stroke / (v.sum() * DT)
    still = np.zeros(50)
    v = np.convolve(np.concatenate([still, v, still, -v, still]), np.ones(11) / 11, "same")
    v = np.concatenate([v, np.zeros(SAMPLES - len(v))])
    return Task(START + np.concatenate([[0], np.cumsum(v) * DT]), DT)


def law(basis=BASIS, **more):
    return WithFeedback(BasisFunctions(basis, closed(), **more), PID(**GAINS))


def rms(scheme, task, trials, memory=None, machine=MACHINE):
    memory = scheme.initial_memory(task) if memory is None else memory
    history = learn(machine, scheme, task, trials, memory=memory)
    return float(history.rms[0, 0]), float(history.rms[-1, 0]), history.memory


@pytest.mark.thorough
def test_what_was_learned_at_one_speed_serves_four_others():
    """Within 1.3 of learning there; what is learned over time has to start anew."""
    noisy = dataclasses.replace(MACHINE, sensor=Sensor(noise=5e-4))
    _, _, memory = rms(law(), there_and_back(30.0), 6, machine=noisy)
    over_time = WithFeedback(GradientILC(closed()), PID(**GAINS))
    _, _, timed = rms(over_time, there_and_back(30.0), 6)
    for speed in (15.0, 60.0, 90.0, 110.0):
        task = there_and_back(speed)
        before, there, _ = rms(law(), task, 6, machine=noisy)
        taken, _, _ = rms(law(), task, 6, memory, machine=noisy)
        assert taken < 1.3 * there < 0.1 * before, speed
        assert rms(law(), task, 6, memory)[0] < 2e-3 * before, speed
        assert rms(over_time, task, 6, timed)[0] > before, speed


@pytest.mark.thorough
def test_forgetting_leaves_an_error_and_a_place_not_visited_is_not_forgotten():
    basis = PositionBasis(Splines(0, 50, 11, degree=1))
    whole, part = there_and_back(30.0), there_and_back(30.0, stroke=15.0)
    for scheme in (law(basis, w_s=1e-9), law(basis, update="gradient")):
        _, _, memory = rms(scheme, whole, 3)
        found = learn(MACHINE, scheme, part, 3, memory=memory)
        kept, new = (np.asarray(m.learning.theta) for m in (memory, found.memory))
        away = np.linspace(0, 50, 11) > START + 15 + 5.01
        np.testing.assert_allclose(new[away], kept[away], rtol=1e-6)
        assert np.max(np.abs(new - kept)[~away]) > 1e-3
    free, forgets = (rms(law(basis, w_s=w), whole, 3)[1] for w in (1e-9, 1e-4))
    assert forgets > 1.05 * free


@pytest.mark.thorough
def test_any_law_learns_a_map_and_keeps_what_it_does_not_visit():
    basis = PositionBasis(Splines(0, 50, 11, degree=1), turning=8.0)
    scheme = WithFeedback(OnBasis(PIDType(gamma_p=15.0, lead=9), basis), PID(**GAINS))
    first, last, memory = rms(scheme, there_and_back(30.0), 8)
    assert last < 0.6 * first
    part = there_and_back(30.0, stroke=15.0)
    u = np.asarray(basis.signal(memory.learning.theta, part.reference, DT, 1))
    again = fitted(basis, u, part.reference, DT, theta=memory.learning.theta)
    np.testing.assert_allclose(again, memory.learning.theta, rtol=1e-6, atol=1e-9)


@pytest.mark.thorough
def test_a_selection_of_a_map_keeps_what_a_trial_does_not_visit():
    basis = SelectedBasis(PositionBasis(Splines(0, 50, 6, degree=1)), (1, 2, 5))
    r = there_and_back(30.0, stroke=15.0).reference

    @jax.jit
    def again(theta):
        u = basis.signal(jnp.array([4.0, 5.0, 0.0]), r, DT, 1)
        return fitted(basis, u, r, DT, theta=theta)

    np.testing.assert_allclose(again(np.array([1.0, 2.0, 3.0])), [4.0, 5.0, 3.0], rtol=1e-9)
    assert basis.keeps


def test_a_lead_is_a_place_further_on():
    task = there_and_back(30.0)
    r = np.asarray(task.reference)[:, 0]
    basis = PositionBasis(Harmonics(12.0, (1,)), lead=0.01)
    v, x = np.diff(r) / DT, (r[1:] + r[:-1]) / 2
    angle = 2 * np.pi * (x + 0.01 * v) / 12.0
    wanted = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    columns = jax.jit(basis.columns, static_argnums=(1, 2))
    np.testing.assert_allclose(columns(r[:, None], DT, 1)[:, 0], wanted, atol=1e-12)
    two = columns(np.stack([r, r], axis=1), DT, 2)
    np.testing.assert_allclose(two[:, 0, :2], wanted, atol=1e-12)
    np.testing.assert_array_equal(two[:, 0, 2:], 0.0)
    assert basis.names(2, 2) == ("cos 1[0]", "sin 1[0]", "cos 1[1]", "sin 1[1]")


def test_the_map_is_what_the_machine_lacks():
    """Of a machine with cogging alone, the learned map is the negative of its force."""
    machine = Machine(ByPosition(DRIVE, COGGING))
    basis = PositionBasis(Harmonics(12.0, (1, 2)))
    scheme = law(JoinedBasis((PolynomialBasis((1, 2)), basis)))
    memory = learn(machine, scheme, there_and_back(15.0), 6).memory
    found = basis.map(memory.learning.theta[2:])
    x = np.linspace(5, 45, 60)
    np.testing.assert_allclose(found.at(x), -COGGING.at(x), atol=0.05)


@pytest.mark.thorough
def test_a_trial_tells_the_bins_it_visits_and_how_well():
    basis = PositionBasis(Splines(0, 50, 11, degree=1))
    part = there_and_back(30.0, stroke=15.0)
    found = theory.visits(MACHINE, law(basis), part)
    assert list(found.told) == [4 < x < 25 for x in np.linspace(0, 50, 11)]
    assert np.all(np.isinf(found.doubt) == ~found.told)
    np.testing.assert_array_equal(found.seconds > 0, found.told)
    # the scatter of what is learned from white noise, 400 times
    model, psi = closed(), np.asarray(basis.columns(part.reference, DT, 1))[:, 0]
    A, B, C = (np.asarray(M) for M in (model.A, model.B, model.C))
    x, X = np.zeros((4, 11)), []
    for row in psi:
        x = A @ x + B * row
        X.append((C @ x)[0])
    X = np.array(X)[:, found.told]
    noise = np.random.default_rng(0).normal(size=(400, len(X)))
    scatter = np.std(np.linalg.lstsq(X, noise.T)[0], axis=1)
    np.testing.assert_allclose(found.doubt[found.told], scatter, rtol=6 / np.sqrt(800))


@pytest.mark.thorough
def test_the_rate_is_that_with_which_learning_comes_to_its_end():
    basis, task = PositionBasis(Splines(0, 50, 11, degree=1)), there_and_back(30.0)
    machine = Machine(ByPosition(DRIVE, COGGING))
    for step, share, grows in ((0.5, 1.0, False), (1.7, 1.0, False), (1.7, 0.4, True)):
        model = closed()  # which answers with this share of what the machine does
        model = dataclasses.replace(model, B=share * model.B)
        scheme = WithFeedback(BasisFunctions(basis, model, step=step), PID(**GAINS))
        memories = [scheme.initial_memory(task)]
        for trials in (5, 1, 1):
            memories.append(learn(machine, scheme, task, trials, memory=memories[-1]).memory)
        found = theory.visits(machine, scheme, task, memory=memories[1])
        one, two, three = (np.asarray(m.learning.theta)[found.told] for m in memories[1:])
        ratio = np.linalg.norm(three - two) / np.linalg.norm(two - one)
        assert (found.rate > 1) == (ratio > 1) == grows
        assert ratio < 1.15 * found.rate


@pytest.mark.thorough
def test_the_rate_counts_what_the_model_cannot_tell_where_it_moves_and_acts():
    """Two inputs that act alike on the model, and not on the machine; w_r moves them unlike."""
    r = np.sin(np.linspace(0, 2 * np.pi, 41))[:, None] ** 2 * [1.0, 0.5]
    one, eye = np.random.default_rng(1282), np.eye(2)
    for _ in range(12):
        alike = np.outer(one.normal(size=2), [1.0, one.normal()])
        model = StateSpace(0.3 * eye, alike, eye, dt=0.01)
        machine = Machine(dataclasses.replace(model, B=alike + one.normal(size=(2, 2))))
        w_r = 10.0 ** one.uniform(-1, 1, 2)
        scheme = BasisFunctions(PolynomialBasis((0,)), model, w_r=w_r, step=0.5)
        task = Task(r, dt=0.01, inputs=2)
        history = learn(machine, scheme, task, 150)
        grown = history.rms[-1].max() > 2 * history.rms[-40].max()
        assert (theory.visits(machine, scheme, task).rate > 1 + 1e-9) == bool(grown)


@pytest.mark.thorough(but=["7.3"])
@pytest.mark.parametrize("pitch", [12.0, 7.3])
def test_the_pitch_is_found_from_a_record(pitch):
    task = there_and_back(30.0)
    x = np.asarray(task.reference)[:, 0]
    random = np.random.default_rng(3)
    clean = 3 * np.cos(2 * np.pi * x / pitch) + np.sin(4 * np.pi * x / pitch)
    friction = 5 * np.sign(np.gradient(x)) + 0.1 * x
    doubts, off = [], []
    for _ in range(8):
        found = pitch_of(x, clean + friction + random.normal(size=len(x)), least=5, most=16)
        doubts.append(found.doubt)
        off.append(found.pitch - pitch)
    assert np.max(np.abs(off)) < 6 * np.mean(doubts) < 0.2
    assert 0.4 < np.std(off) / np.mean(doubts) < 2.0
    np.testing.assert_allclose(found.amplitudes, [3, 1, 0], atol=0.3)
    assert 0.6 < found.share < 0.95
    # a wave alone is found as itself, and not as a harmonic of a multiple
    assert pitch_of(x, np.sin(2 * np.pi * x / 5.1), least=2, most=20).pitch == pytest.approx(5.1)


def test_combs_of_two_pitches_are_found_one_after_the_other_and_learned_at_once():
    task, combs = there_and_back(30.0), Harmonics((12.0, 3.7), (1, 2))
    force = PositionMap(combs, (3.0, 1.0, 0.5, 0.8, 1.0, -1.0, 0.4, 0.2))
    x = np.asarray(task.reference)[:, 0]
    record = np.asarray(force.at(x)) + np.random.default_rng(0).normal(size=len(x))
    one = pitch_of(x, record, least=2, most=20).pitch
    two = pitch_of(x, record, least=2, most=20, known=(one,)).pitch
    assert (one, two) == (pytest.approx(12.0, rel=0.01), pytest.approx(3.7, rel=0.01))
    machine, left = Machine(ByPosition(DRIVE, force)), []
    for pitch in (12.0, (12.0, 3.7)):
        basis = JoinedBasis((PolynomialBasis((1, 2)), PositionBasis(Harmonics(pitch, (1, 2)))))
        left.append(rms(law(basis), task, 3, machine=machine)[1])
    assert left[1] < 0.01 * left[0]


def test_what_does_not_fit_is_said():
    task, position = there_and_back(60.0), PositionBasis(Harmonics(12.0))
    with pytest.raises(ValueError, match="a RationalBasis is not linear in theta"):
        JoinedBasis((position, RationalBasis(PolynomialBasis((0,)))))
    with pytest.raises(ValueError, match="the task has 2 inputs and 1 outputs"):
        JoinedBasis((position,)).check(dataclasses.replace(task, inputs=2))
    with pytest.raises(ValueError, match="scheme is a PID; allowed are BasisFunctions"):
        theory.visits(MACHINE, PID(kp=1.0), task)
    learning = WithFeedback(PIDType(gamma_p=9.0), PID(kp=1.0))
    both = dataclasses.replace(law(position), feedback=learning)
    with pytest.raises(ValueError, match="visits: the feedback, a WithFeedback, learns too"):
        theory.visits(MACHINE, both, task)
    carries = dataclasses.replace(MACHINE, variation=Variation(carried=1.0))
    with pytest.raises(ValueError, match="visits: each trial starts with a share"):
        theory.visits(carries, law(position), task)
    x = np.linspace(0, 40, 200)
    with pytest.raises(ValueError, match="most = 30 with a motion over 40"):
        pitch_of(x, np.sin(x), least=1, most=30)
    with pytest.raises(ValueError, match=r"least = 0\.0001 makes 9,"):
        pitch_of(x, np.sin(x), least=1e-4, most=20)
    with pytest.raises(ValueError, match="the signal is a straight line"):
        pitch_of(x, 2 * x + 1, least=1, most=20)
    for orders, said in (((), r"\(\) is empty"), ((1, 0), r"0 is outside its allowed range \[1,")):
        with pytest.raises(ValueError, match=f"pitch_of: orders = {said}"):
            pitch_of(x, np.sin(x), least=1, most=20, orders=orders)
