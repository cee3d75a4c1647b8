"""Whether a Q-filter is safe: against dense grids in NumPy with closed forms written here again."""

import numpy as np
import pytest
from dense import lifted

from jaxilc import Machine, Task, learn
from jaxilc.filters import ZeroPhaseButterworth
from jaxilc.learning.variation import Variation
from jaxilc.plants import ProcessModel, StateSpace
from jaxilc.schemes import CFDLMFAILC, AtSamples, Filtered, HigherOrder, PIDType
from jaxilc.theory.enclosure import Disc
from jaxilc.theory.frequency import bound_of_set, learning_condition, tried_plants
from jaxilc.theory.law import law_of
from jaxilc.theory.linearity import whole_trials
from jaxilc.theory.loop import linear_loop
from jaxilc.theory.on_lines import (
    Change,
    Lines,
    best_lead,
    curves_of,
    largest_cutoff,
    largest_gain,
    peak,
)
from jaxilc.theory.q_filter import need_linear, offers_of, question
from jaxilc.uncertainty import Population, Uniform

DT, GAMMA, LEAD, CUTOFF = 1e-3, 0.5, 8, 30.0
TASK = Task(np.sin(2 * np.pi * np.arange(301) / 300), dt=DT)
PLANT = ProcessModel(gain=1.0, zeros=(), poles=(200.0,), frequencies=(300.0,), dampings=(0.2,))
SHORT = Task(np.sin(2 * np.pi * np.arange(61) / 60), dt=DT)
LAW = Filtered(PIDType(gamma_p=GAMMA, lead=LEAD), ZeroPhaseButterworth(CUTOFF))
F = np.linspace(0.1, 500.0, 2000)


def sampled(f, gain, w, zeta, pole=200.0):
    """The plant under zero-order hold, by expm of its companion form in NumPy."""
    from scipy.signal import cont2discrete

    den = np.polymul([1 / pole, 1.0], [1 / w**2, 2 * zeta / w, 1.0])
    num, den, _ = cont2discrete(([gain], den), DT, method="zoh")
    z = np.exp(2j * np.pi * f * DT)
    return np.polyval(num[0], z) / np.polyval(den, z)


def size(f, P, gamma=GAMMA, lead=LEAD, cutoff=CUTOFF):
    Q = 1 / (1 + (np.tan(np.pi * f * DT) / np.tan(np.pi * cutoff * DT)) ** 4)
    return Q * np.abs(1 - gamma * np.exp(2j * np.pi * f * DT * (1 + lead)) * P)


def lines_of(*plants):
    P = np.array([sampled(F[:-1], *one) for one in plants])
    one = np.ones(len(F) - 1, complex)
    return Lines(F[:-1], P, 0 * P.real, one, np.exp(2j * np.pi * F[:-1] * DT * (1 + LEAD)), DT)


@pytest.fixture(scope="module")
def answer():
    box = {
        "plant.gain": Uniform(0.85, 1.15, relative=True),
        "plant.frequencies": Uniform(0.8, 1.2, relative=True),
    }
    return question(Machine(PLANT), LAW, TASK, box, machines=4)


def test_no_plant_of_the_box_exceeds_what_is_proved(answer):
    found, _ = answer
    assert found.proof.proved
    f = np.linspace(0.5, 120.0, 600)
    worst = max(
        float(np.max(size(f, sampled(f, gain, 300.0 * k, 0.2))))
        for gain in np.linspace(0.85, 1.15, 5)
        for k in np.linspace(0.8, 1.2, 41)
    )
    assert worst <= found.proof.bound <= 1.03 * worst
    assert found.tried.at == {"plant.gain": 0.85, "plant.frequencies": pytest.approx(1.2)}


def test_curves_and_resonance(answer):
    found, _ = answer
    curves, f = found.curves, found.curves.f
    P = sampled(f[:-1], 1.0, 300.0, 0.2)
    np.testing.assert_allclose(curves.P[:-1], P, rtol=1e-7)
    np.testing.assert_allclose(curves.nominal[:-1], size(f[:-1], P), atol=1e-9)
    assert np.all(curves.low <= curves.nominal + 1e-12)
    assert np.all(curves.nominal <= curves.high + 1e-12)
    assert found.resonances[0].frequency == pytest.approx(300 / (2 * np.pi), rel=1e-6)
    assert found.resonances[0].damping == pytest.approx(0.2, rel=1e-6)
    # without the filter, on the machine that exceeds 1 first
    above = [
        f[np.argmax(np.abs(1 - GAMMA * np.exp(2j * np.pi * f * DT * (1 + LEAD)) * P) > 1)]
        for P in (sampled(f, g, 300.0 * k, 0.2) for g in (0.85, 1.15) for k in (0.8, 1.2))
    ]
    assert curves.first_above <= min(above)


def test_offers_keep_the_margin_between_the_lines_and_go_no_further(answer):
    found, inner = answer
    corners = [(g, 300.0 * k, 0.2) for g in (0.85, 1.15) for k in (0.8, 1.2)]

    def largest(**changed):
        return max(float(np.max(size(F[:-1], sampled(F[:-1], *one), **changed))) for one in corners)

    offers = {one.what: one for one in offers_of(found, inner, Machine(PLANT), LAW, TASK, 0.1)}
    cutoff = offers["largest cutoff"].settings["filter.cutoff"]
    gain = float(offers["largest gain"].settings["scheme.gamma_p"])
    assert cutoff > CUTOFF
    assert gain > GAMMA
    assert largest(cutoff=cutoff) <= 0.9 < largest(cutoff=1.02 * cutoff)
    assert largest(gamma=gain) <= 0.9 < largest(gamma=1.02 * gain)


@pytest.mark.thorough
def test_the_floor_is_that_of_the_limit_of_learning(answer):
    found, _ = answer
    keep, L = law_matrices()
    G = lifted(linear_loop(Machine(PLANT), None, TASK), TASK.N)
    r = np.asarray(TASK.reference)[1:, 0]
    u = np.linalg.solve(np.eye(TASK.N) - keep + L @ G, L @ r)
    assert found.now.floor == pytest.approx(np.sqrt(np.mean((r - G @ u) ** 2)), rel=2e-3)


def law_matrices():
    """The law of a trial in NumPy: the filter by cosines (DCT-II), zeros beyond the end."""
    from scipy.fft import dct, idct

    N = TASK.N
    half = np.pi * np.arange(N) / (2 * N)
    Q = 1 / (1 + (np.tan(half) / np.tan(np.pi * CUTOFF * DT)) ** 4)
    Q = idct(Q[:, None] * dct(np.eye(N), axis=0, norm="ortho"), axis=0, norm="ortho")
    return Q, GAMMA * Q @ np.eye(N, k=LEAD)


def test_nothing_is_proved_by_the_corners_of_more_numbers_than_are_looked_at():
    """A pole among nine was taken for affine: a machine within diverged, proved to be safe."""
    A, n = np.diag(np.full(9, 0.5)), 9
    plant = Machine(StateSpace(A, np.full((n, 1), 0.1), np.ones((1, n)), dt=DT))
    box = {f"plant.A[{i}][{i}]": Uniform(0.4, 0.6) for i in range(n)}
    law, of = PIDType(gamma_p=0.5), Population(plant, box, sampling="corners")
    tried = tried_plants(of, law, SHORT, climbers=0)
    proof = bound_of_set(of, law, SHORT, law_of(law, SHORT), tried)
    assert len(tried.points) >= 2**n
    assert not proof.proved
    assert "more than 8 numbers" in proof.how


def test_gains_are_proved_by_their_corners_and_a_pole_is_not():
    plant = Machine(StateSpace([[0.9]], [[0.1]], [[1.0]], dt=DT))
    law = Filtered(PIDType(gamma_p=0.8, lead=LEAD), ZeroPhaseButterworth(40.0))
    wide = Uniform(0.7, 1.3, relative=True)
    both = {"plant.B": wide, "plant.C": wide}
    of = Population(plant, both, count=2, sampling="latin-hypercube")
    tried = tried_plants(of, law, TASK, climbers=0)
    taps = law_of(law, TASK)
    proof = bound_of_set(of, law, TASK, taps, tried)
    P = 0.1 / (np.exp(2j * np.pi * F[:-1] * DT) - 0.9)
    worst = max(
        float(np.max(size(F[:-1], k * P, gamma=0.8, cutoff=40.0)))
        for k in np.linspace(0.7**2, 1.3**2, 41)
    )
    assert proof.bound == pytest.approx(worst, rel=1e-3)
    assert "corner" in proof.how
    inner = tried._replace(points=0.99 * tried.points)
    assert "not all corners" in bound_of_set(of, law, TASK, taps, inner).how
    pole = {"plant.A": Uniform(0.95, 1.05, relative=True)}
    proof = bound_of_set(Population(plant, pole), law, TASK, taps, tried)
    assert not proof.proved
    assert "not affine in plant.A" in proof.how


def test_discs_contain_every_result():
    random = np.random.default_rng(4)
    centre = random.standard_normal((2, 500)) + 1j * random.standard_normal((2, 500))
    radius = 0.3 * random.uniform(size=(2, 500))
    a, b = (Disc(c, r) for c, r in zip(centre, radius, strict=True))
    turn = np.exp(2j * np.pi * random.uniform(size=(2, 500)))
    x, y = centre + radius * turn
    for disc, value in (
        (a.plus(b), x + y),
        (a.minus(b), x - y),
        (a.times(b), x * y),
        (a.inverse(), 1 / x),
        (a.exponential(), np.exp(x)),
    ):
        assert np.all(np.abs(value - disc.centre) <= disc.radius * (1 + 1e-12) + 1e-14)


@pytest.mark.parametrize("lead", [-8, 3])
def test_the_largest_cutoff_and_gain_are_those_of_a_scan(lead):
    plants = [(g, 300.0 * k, 0.2) for g in (0.85, 1.15) for k in (0.8, 1.2)]
    lines, now = lines_of(*plants), Change(0.5, lead, 40.0, 2)
    cutoff = largest_cutoff([lines], now, 0.9, 1.0)
    scanned = [c for c in np.linspace(1, 490, 490) if peak([lines], now._replace(cutoff=c)) <= 0.9]
    assert cutoff == pytest.approx(max(scanned), abs=1.0)
    gain = largest_gain([lines], now._replace(cutoff=30.0), 0.9)
    gains = np.linspace(0.05, 4, 200)
    allowed = [g for g in gains if peak([lines], now._replace(gain=g, cutoff=30.0)) <= 0.9]
    assert gain is None if not allowed else gain == pytest.approx(max(allowed), abs=0.02)


def test_the_best_lead_is_that_of_a_scan():
    lines, now = lines_of((1.0, 300.0, 0.2)), Change(0.5, 0, 40.0, 2)
    lead, cutoff = best_lead([lines], now, 0.9, range(-8, 20), 1.0)
    each = [largest_cutoff([lines], now._replace(lead=d), 0.9, 1.0) or 0 for d in range(-8, 20)]
    assert cutoff == max(each)
    assert lead == int(np.argmax(each)) - 8


def test_of_a_plant_that_answers_at_some_lines_no_error_is_learned_at_the_others():
    f, P = np.array([1.0, 2.0, 3.0]), np.array([[1.0, 0.0, 1.0]])
    curves = curves_of(Lines(f, P + 0j, 0 * P, np.ones(3, complex), np.ones(3, complex), 0.01))
    np.testing.assert_array_equal(curves.left, [0, 1, 0])
    assert curves.learned_up_to == 1.0


def test_nothing_is_safe_or_offered_where_a_machine_is_unstable():
    """The report said `safe`, and how far the law may go, by the lines of the responses alone."""
    task = Task(np.zeros(101), dt=DT)
    plant = Machine(StateSpace([[-0.8]], [[1.8]], [[1.0]], dt=DT))
    law = Filtered(PIDType(gamma_p=0.9), ZeroPhaseButterworth(100.0))
    box = {"plant.A": Uniform(0.9, 1.26, relative=True)}
    found, inner = question(plant, law, task, box, machines=1)
    assert float(found.tried.values[found.tried.top]) < 0.9 < 1 <= np.max(found.tried.radii)
    assert np.isnan([found.peak, found.now.peak, found.now.floor]).all()
    assert offers_of(found, inner, plant, law, task, 0.05) == []


@pytest.mark.thorough
def test_a_law_that_is_not_linear_is_named():
    with pytest.raises(
        ValueError, match=r"CFDLMFAILC: the condition .* needs: learning law linear"
    ):
        question(Machine(PLANT), CFDLMFAILC(phi0=0.5), TASK, {})
    higher = HigherOrder((0.7, 0.3), (0.4, 0.2))
    with pytest.raises(ValueError, match="HigherOrder learns from earlier trials too"):
        question(Machine(PLANT), higher, TASK, {})
    test = learning_condition(Machine(PLANT), higher, TASK)
    assert test.condition.verdict == "not claimed"


@pytest.mark.thorough
def test_a_law_of_windows_that_learns_nothing_in_the_middle_is_not_called_safe():
    """There it is 0.8 by its leak, and in the window the error goes from 1 to 1e14."""
    plant = Machine(StateSpace([[0.9]], [[0.1]], [[1.0]], dt=DT))
    task = Task(np.sin(2 * np.pi * np.arange(201) / 200), dt=DT)
    law = AtSamples(PIDType(gamma_p=30.0, leak=0.2), windows=((0.02, 0.03),))
    with pytest.raises(ValueError, match="AtSamples: needed is a learning law the same throughout"):
        question(plant, law, task, {})
    test = learning_condition(plant, law, task)
    assert "learning law the same throughout the trial" in [p.name for p in test.condition.broken]
    errors = np.asarray(learn(plant, law, task, 21).max_error)[:, 0]
    assert errors[-1] > 1e14 * errors[0]


@pytest.mark.parametrize(
    "given", [{"late": 40}, {"carried": 1.0}, {"dropped": 0.1}, {"shortest": 0.5}, {"delayed": 0.5}]
)
def test_nothing_is_said_of_lines_where_the_record_is_not_the_whole_trial(given):
    """With `late` = 40 a law was "safe (proved)", whose error grows 5e4 times in 400 trials."""
    machine = Machine(PLANT, variation=Variation(**given))
    (name, value), *_ = given.items()
    with pytest.raises(ValueError, match=rf"whole and in time. Found: variation.{name} = {value}"):
        question(machine, LAW, TASK, {}, machines=1)
    if name == "late":
        claimed = learning_condition(machine, LAW, SHORT).condition
        assert not claimed.holds
        assert any(name in p.detail for p in claimed.premises if not p.held)
        return
    broken = whole_trials(machine, LAW, TASK)
    assert (broken.held, name in broken.detail) == (False, True)
    of_all = {f"variation.{name}": Uniform(0.6, 0.8)}
    plain = Machine(PLANT, variation=Variation(**{name: float(name == "shortest")}))
    with pytest.raises(ValueError, match=f"Found: an uncertain variation.{name}"):
        question(plain, LAW, TASK, of_all, machines=1)
    need_linear(plain, LAW, TASK)
