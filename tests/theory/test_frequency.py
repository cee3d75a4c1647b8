"""Frequency conditions are compared with other computations, and their claims with simulation.

The other computations are python-control, dense matrices and closed forms.
"""

import dataclasses

import control
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
import scipy.signal
from cases import ARX, DT, PLANTS, case, task_for
from refusals import refused

from jaxilc.filters import Filter, ZeroPhaseButterworth, ZeroPhaseFIR
from jaxilc.learning import Actuator, Machine, learn
from jaxilc.plants import DifferenceEquation, ProcessModel, StateSpace
from jaxilc.pytree import child, get_at, leaf, pytree, replaced
from jaxilc.schemes import (
    CFDLMFAC,
    CFDLMFAILC,
    PID,
    Filtered,
    OnOutputs,
    OnReference,
    PIDType,
    Scheme,
    WithFeedback,
)
from jaxilc.schemes.scheme import Feedforward
from jaxilc.signals import Task
from jaxilc.theory import frequency, lifted
from jaxilc.theory.certificates import printed_conditions
from jaxilc.theory.enclosure import Arc
from jaxilc.theory.law import law_of
from jaxilc.uncertainty import Normal, Uniform

ARX_MACHINE, TASK = Machine(PLANTS["arx"]), task_for(PLANTS["arx"], 200)
F = np.geomspace(0.5, 499.0, 40)
Z = np.exp(2j * np.pi * F * DT)


def errors(trial):
    return trial.e[1:, 0]


law_response = frequency.law_response
linear_loop = jax.jit(frequency.linear_loop)
response = jax.jit(lambda *of: frequency.response(linear_loop(*of), F, DT))


def transfer(a, b):
    return control.tf([0.0, *b], [1.0, *(-np.asarray(a))], DT)


def butterworth(f, cutoff, order=2):
    """Return the response of a zero-phase filter by scipy."""
    sections = scipy.signal.butter(order, cutoff, fs=1 / DT, output="sos")
    return np.abs(scipy.signal.sosfreqz(sections, f, fs=1 / DT)[1]) ** 2


def of_plant(plant):
    """Return the frequency response of the plant at Z by python-control."""
    if isinstance(plant, DifferenceEquation):
        return transfer(plant.a, plant.b)(Z)[:, None, None]
    system = control.ss(plant.A, plant.B, plant.C, 0, plant.dt)
    system = system if plant.dt else control.sample_system(system, DT, "zoh")
    return np.moveaxis(np.reshape(system(Z), (plant.n_y, plant.n_u, len(Z))), -1, 0)


@pytest.mark.parametrize(
    "name", ["voice_coil_printed", "arx", "continuous", "discrete", "mimo", "motor_and_table"]
)
def test_the_plant_is_that_of_python_control(name):
    plant = PLANTS[name]
    np.testing.assert_allclose(
        response(Machine(plant), None, task_for(plant)), of_plant(plant), rtol=1e-9, atol=1e-12
    )


@pytest.mark.thorough
def test_the_identified_motor_is_its_transfer_function_sampled():
    exact = control.sample_system(
        control.zpk([928.2], [-474.0, -474.0, -6.404], 7437.7769), DT, "zoh"
    )
    plant = PLANTS["voice_coil_exact"]
    np.testing.assert_allclose(
        response(Machine(plant), None, task_for(plant))[:, 0, 0], exact(Z), rtol=1e-6
    )


GAINS = {"kp": 0.8, "ki": 20.0, "kd": 2e-4, "tau": 1e-3}


@pytest.mark.parametrize("form", ["position", "increment"])
def test_the_loop_is_that_of_python_control(form):
    """From the input it is P / (1 + C P), from the reference C P / (1 + C P).

    w[k] of the input belongs to the reference r[k+1].
    """
    kp, ki, kd, tau = GAINS.values()
    # kp + ki dt z / (z - 1) + kd (z - 1) / ((tau + dt) z - tau)
    derivative = control.tf([kd, -kd], [tau + DT, -tau], DT)
    P, C = transfer(*ARX)(Z), kp + control.tf([ki * DT, 0], [1, -1], DT)(Z) + derivative(Z)
    feedback, task = PID(**GAINS, form=form), task_for(PLANTS["arx"])
    np.testing.assert_allclose(
        response(ARX_MACHINE, feedback, task)[:, 0, 0], P / (1 + C * P), rtol=1e-9
    )
    series = response(ARX_MACHINE, OnReference(PIDType(gamma_p=1.0), feedback), task)[:, 0, 0]
    np.testing.assert_allclose(series, C * P / (1 + C * P) / Z, rtol=1e-9)


@pytest.mark.thorough
def test_derivatives_with_respect_to_plant_and_feedback():
    def level(parts, task):
        loop = frequency.linear_loop(parts["machine"], parts["feedback"], task)
        return jnp.sum(jnp.abs(frequency.response(loop, F[::8], DT)) ** 2)

    parts = {"machine": ARX_MACHINE, "feedback": PID(kp=0.8, ki=20.0)}
    slopes = jax.jit(jax.grad(level))(parts, TASK)
    level = jax.jit(level)
    for name in ("machine.plant.a[1]", "machine.plant.b[0]", "feedback.kp", "feedback.ki"):
        value = get_at(parts, name)
        step = 1e-5 * abs(value)
        sides = [level(replaced(parts, {name: value + sign * step}), TASK) for sign in (1, -1)]
        np.testing.assert_allclose(
            get_at(slopes, name), (sides[0] - sides[1]) / (2 * step), rtol=1e-6, err_msg=name
        )


@pytree
class TwoAhead(Scheme):
    """The law of a user is u_{j+1}[k] = 0.9 u_j[k] + gain (0.7 e_j[k+2] + 0.3 e_j[k])."""

    gain: jax.Array = leaf(default=0.5)

    def initial_memory(self, task):
        return Feedforward(jnp.zeros((task.N, task.inputs)))

    def learn(self, memory, trial):
        ahead = jnp.concatenate([trial.e[2:], jnp.zeros_like(trial.e[:1])])
        return Feedforward(0.9 * trial.u + self.gain * (0.7 * ahead + 0.3 * trial.e[:-1]))


@pytree
class Own(Filter):
    """The filter of a user does the same as one of the package, but has an unknown class."""

    other: Filter = child()

    def __call__(self, signal, dt):
        return self.other(signal, dt)


@pytest.mark.thorough
def test_laws_and_filters():
    task = Task(np.zeros(401), dt=DT)
    law = law_response(PIDType(gamma_p=0.6, gamma_d=0.3, leak=0.1, lead=3), task, F)
    np.testing.assert_allclose(law.L[:, 0, 0], 0.6 * Z**4 + 0.3 * (Z**4 - Z**3), rtol=1e-12)
    np.testing.assert_allclose(law.keep[:, 0, 0], 0.9)
    law = law_response(CFDLMFAILC(phi0=0.3, lam=0.2, rho=0.5, lead=1), task, F)
    np.testing.assert_allclose(law.L[:, 0, 0], 0.5 * 0.3 / (0.2 + 0.09) * Z**2, rtol=1e-12)
    law = law_response(
        WithFeedback(Filtered(TwoAhead(), ZeroPhaseFIR((0.5, 0.2, 0.05))), PID()), task, F
    )
    Q = 0.5 + 0.4 * np.cos(2 * np.pi * F * DT) + 0.1 * np.cos(4 * np.pi * F * DT)
    np.testing.assert_allclose(law.L[:, 0, 0], Q * 0.5 * (0.7 * Z**2 + 0.3), rtol=1e-9)
    np.testing.assert_allclose(law.keep[:, 0, 0], Q * 0.9, rtol=1e-9)
    for q in (ZeroPhaseButterworth(70.0, order=3), Own(ZeroPhaseButterworth(70.0, order=3))):
        found = law_response(Filtered(PIDType(), q), task, F).keep[:, 0, 0]
        np.testing.assert_allclose(found, butterworth(F, 70.0, 3), rtol=1e-8, atol=1e-12)


@pytest.mark.thorough
@pytest.mark.parametrize("N", [40, 5000])
def test_the_law_of_a_filter_with_a_low_cutoff_is_the_same_throughout(N):
    """At 1 kHz the taps of 2 Hz take some 9000 samples to die out."""
    scheme = Filtered(PIDType(gamma_p=0.5), ZeroPhaseButterworth(2.0, order=2))
    law, f = law_of(scheme, Task(np.zeros(N + 1), dt=DT)), np.geomspace(0.1, 20, 20)
    assert law.invariant.held, law.invariant.detail
    found = np.exp(2j * np.pi * DT * np.outer(f, law.keep.powers)) @ law.keep.taps[:, 0, 0]
    np.testing.assert_allclose(found, butterworth(f, 2.0), atol=1e-10)


@pytest.mark.thorough
def test_a_scheme_on_one_of_two_outputs():
    """L has a column for each output; the columns of unused outputs are zero."""
    plant = PLANTS["motor_and_table"]
    task = dataclasses.replace(task_for(plant, 200), reference=np.zeros((201, 2)))
    law = law_response(OnOutputs(PIDType(gamma_p=0.5, lead=1), (1,)), task, F)
    np.testing.assert_allclose(law.L[:, 0], np.stack([0 * Z, 0.5 * Z**2], axis=1), atol=1e-12)


@pytest.mark.parametrize("gamma", [0.5, 4.0])
def test_the_supremum_is_the_singular_value_of_a_long_trial(gamma):
    """sup |1 - gamma z P| and sigma_max(I - gamma G) at N = 400 agree to three digits."""
    task = Task(np.zeros(401), dt=DT)
    found = frequency.learning_condition(ARX_MACHINE, PIDType(gamma_p=gamma), task)
    G = lifted.lifted_plant(ARX_MACHINE, None, task)
    np.testing.assert_allclose(
        found.condition.value, lifted.sigma_max(np.eye(400) - gamma * G), rtol=1e-3
    )
    P = transfer(*ARX)
    fine = np.linspace(1e-3, 500.0, 200001)
    z = np.exp(2j * np.pi * fine * DT)
    curve = np.abs(1 - gamma * z * P(z))
    assert curve.max() <= found.condition.value <= curve.max() * (1 + 1.1e-6), "enclosed from above"
    np.testing.assert_allclose(found.worst, fine[np.argmax(curve)], atol=0.2)
    np.testing.assert_allclose(found.critical, fine[np.argmax(curve >= 1)], atol=0.01)


def test_the_cnc_condition_and_its_simulation():
    """Li 2020, eq. 9: below the critical frequency the error falls, above it grows, as told."""
    task = Task(np.zeros(2001), dt=DT)
    scheme = WithFeedback(PIDType(gamma_p=2.0), PID(kp=0.8))
    found = frequency.learning_condition(ARX_MACHINE, scheme, task)
    P = transfer(*ARX)
    z, S = np.exp(2j * np.pi * found.frequencies * DT), P / (1 + 0.8 * P)
    np.testing.assert_allclose(found.magnitude, np.abs(1 - 2.0 * z * S(z)), rtol=1e-9)
    assert found.condition.verdict == "fails"
    assert printed_conditions(scheme, task, ARX_MACHINE) == {"Li 2020, eq. 9": found.condition}
    for other in (PIDType(gamma_p=2.0, lead=1), PIDType(gamma_p=2.0, gamma_d=0.1)):
        assert printed_conditions(WithFeedback(other, PID(kp=0.8)), task, ARX_MACHINE) == {}
    assert 20 < found.critical < 100
    for f in (0.5 * found.critical, 1.5 * found.critical):
        f = round(f * 2.0) / 2.0  # the trial holds whole periods
        window = slice(500, 1500)  # far from the ends
        r = np.sin(2 * np.pi * f * DT * np.arange(2001))
        e = np.asarray(learn(ARX_MACHINE, scheme, Task(r, dt=DT), 5, save=errors).saved)[:, window]
        size = np.linalg.norm(e, axis=1)
        expected = np.interp(f, found.frequencies, found.magnitude)
        np.testing.assert_allclose(size[1:] / size[:-1], expected, rtol=0.02)
        assert (expected < 1) == (f < found.critical)


def test_monotone_by_design():
    """Of a causal law with |1 - L z P| < 1 at all frequencies, and of its simulation."""
    machine, law = Machine(StateSpace([[0.3]], [[0.7]], [[1.0]], dt=DT)), PIDType(gamma_p=0.8)
    found = frequency.learning_condition(machine, law, TASK)
    assert found.condition.verdict == "holds"
    assert found.critical == np.inf
    e = np.asarray(learn(machine, law, TASK, 8, save=errors).saved)
    size = np.linalg.norm(e, axis=1)
    assert np.all(size[1:] <= found.condition.value * size[:-1] * (1 + 1e-9))


@pytest.mark.thorough
def test_the_ends_of_the_trial_are_looked_at():
    """The odd extension of a zero-phase filter pins the end, where a lead finds no error.

    |Q (1 - L P)| < 1 at every frequency, but learning grows at the end by 0.2 % per trial. So
    nothing is claimed. Without the extension the claim is made.
    """
    pinned, free = (
        Filtered(PIDType(gamma_p=0.5, lead=3), ZeroPhaseButterworth(80.0, padding=padding))
        for padding in (9, 0)
    )
    held, holds = (
        frequency.learning_condition(ARX_MACHINE, scheme, TASK).condition
        for scheme in (pinned, free)
    )
    assert held.value == holds.value < 0.7
    assert (held.verdict, holds.verdict) == ("not claimed", "holds")
    assert [p.name for p in held.broken] == ["the whole trial converges, its ends included"]
    rho, of_free = (
        lifted.learning_conditions(ARX_MACHINE, scheme, TASK)["asymptotic"].value
        for scheme in (pinned, free)
    )
    assert of_free < 0.7
    assert 1.001 < rho < 1.01
    change = np.diff(np.asarray(learn(ARX_MACHINE, pinned, TASK, 2000, save=errors).saved)[:, -1])
    np.testing.assert_allclose(change[-1] / change[-501], rho**500, rtol=1e-6)


BROKEN = {
    "loop stable": (Machine(StateSpace([[1.0]], [[1.0]], [[1.0]], dt=DT)), PIDType(gamma_p=0.5)),
    "loop linear and time invariant": (ARX_MACHINE, WithFeedback(PIDType(), CFDLMFAC(phi0=0.3))),
    "learning law linear and the same in each trial": (ARX_MACHINE, CFDLMFAILC(phi0=0.3)),
}


@pytest.mark.thorough
@pytest.mark.parametrize("premise", BROKEN)
def test_nothing_is_claimed_where_a_premise_is_broken(premise):
    machine, scheme = BROKEN[premise]
    found = frequency.learning_condition(machine, scheme, task_for(machine.plant, 200)).condition
    assert found.verdict == "not claimed"
    assert premise in [p.name for p in found.broken]


@pytest.mark.thorough
def test_a_limit_breaks_the_premise_and_an_unused_integrator_does_not():
    machine = Machine(PLANTS["arx"], actuator=Actuator(limit=0.5, rate=1e6))
    filtered = Filtered(PIDType(gamma_p=0.5), ZeroPhaseButterworth(40.0))
    broken = frequency.learning_condition(machine, filtered, TASK).condition.broken
    assert [p.name for p in broken] == ["no limit is met in any trial to come"]
    loop = linear_loop(ARX_MACHINE, PID(kp=0.5, form="increment"), TASK)
    np.testing.assert_allclose(np.max(np.abs(np.linalg.eigvals(loop.A))), 1.0, atol=1e-9)
    A = np.array([[1.6 - 0.5 * 0.06, 1.0], [-0.65 - 0.5 * 0.03, 0.0]])
    np.testing.assert_allclose(
        frequency.pole_radius(loop), np.max(np.abs(np.linalg.eigvals(A))), rtol=1e-9
    )


@pytest.mark.thorough
def test_robust_condition_is_the_worst_of_all_perturbed_plants():
    """|Q| (|1 - L P| + |L P W|) is reached by some |D| <= 1 and exceeded by none.

    The condition then gives the right verdict on true plants.
    """
    scheme = Filtered(PIDType(gamma_p=0.5, lead=3), ZeroPhaseButterworth(60.0, padding=0))

    def weight(f):
        return 0.1 + f / 400.0

    f = np.linspace(1.0, 499.0, 120)
    found = frequency.robust_condition(ARX_MACHINE, scheme, TASK, weight, frequencies=f)
    z, law = np.exp(2j * np.pi * f * DT), law_response(scheme, TASK, f)
    LP, W = np.asarray(law.L)[:, 0, 0] * transfer(*ARX)(z), weight(f)
    unit = np.exp(2j * np.pi * np.arange(720) / 720)[:, None]
    perturbed = np.abs(np.asarray(law.keep)[:, 0, 0] - LP * (1 + W * unit))
    np.testing.assert_allclose(found.magnitude, perturbed.max(axis=0), rtol=1e-4, atol=1e-12)
    nominal = frequency.learning_condition(ARX_MACHINE, scheme, TASK, frequencies=f)
    certain = frequency.robust_condition(ARX_MACHINE, scheme, TASK, 0.0, frequencies=f)
    np.testing.assert_allclose(certain.magnitude, nominal.magnitude)
    assert nominal.condition.value < found.condition.value
    some, most = (
        frequency.robust_condition(ARX_MACHINE, scheme, TASK, share).condition
        for share in (0.15, 0.9)
    )
    assert (some.verdict, most.verdict) == ("holds", "fails")
    louder = Machine(DifferenceEquation(ARX[0], np.multiply(ARX[1], 1.15), dt=DT))
    assert frequency.learning_condition(louder, scheme, TASK).condition.value <= some.value


@pytest.mark.thorough
def test_a_response_that_is_singular_has_no_bounded_inverse():
    rng = np.random.default_rng(0)
    value, slope = (rng.standard_normal((2, 2, 2)) + 0j for _ in range(2))
    value[0] = [[1.0, 2.0], [0.5, 1.0]]
    found, h = Arc(value, slope, np.ones(2)).inverse(np.full(2, 1e-3)), np.full(2, 1e-3)
    sizes, upper = found.times(Arc(value, slope, np.ones(2)), h).bounds(h)
    assert np.isnan([sizes[0], upper[0]]).all()
    np.testing.assert_allclose(found.value[1], np.linalg.inv(value[1]))
    assert 1 <= upper[1] < 1.1
    two = StateSpace([[0.5]], [[1.0, 1.0]], [[1.0]], dt=DT)  # what they share alone is seen
    task, weights = task_for(two, 20), {"w_e": 1.0, "w_u": 0.0, "w_delta": 0.0}
    condition = frequency.norm_optimal_condition(Machine(two), Machine(two), None, task, **weights)
    assert not condition.condition.holds


def test_the_product_of_arcs_departs_from_its_line_as_far_as_is_claimed():
    """Where all numbers are positive, nothing of the bound is given away at the end of the arc."""
    h, *parts = np.random.default_rng(4).uniform(0.1, 2.0, (7, 3))
    one, other = (Arc(x[:, None, None], y[:, None, None], c) for x, y, c in (parts[:3], parts[3:]))
    found = one.times(other, h)
    a, b, line = (x.value[:, 0, 0] + h * x.slope[:, 0, 0] for x in (one, other, found))
    product = (a + h**2 * one.curve) * (b + h**2 * other.curve)
    np.testing.assert_allclose(line + h**2 * found.curve, product, rtol=1e-12)


def test_norm_optimal_condition_is_the_norm_of_the_lifted_map():
    """It is sigma_max of (W_e G'G + W_u + W_D)^-1 (W_D + W_e G'(G - G_t)) at N = 100."""
    task, weights = Task(np.zeros(101), dt=DT), {"w_e": 1.0, "w_u": 1e-3, "w_delta": 0.05}
    G = lifted.lifted_plant(ARX_MACHINE, None, task)
    verdicts = []
    for factor in (0.7, 1.0, 1.8, -0.5):
        truth = Machine(DifferenceEquation(ARX[0], np.multiply(ARX[1], factor), dt=DT))
        found = frequency.norm_optimal_condition(ARX_MACHINE, truth, None, task, **weights)
        H = G.T @ G + 0.051 * np.eye(100)
        M = np.linalg.solve(H, 0.05 * np.eye(100) + G.T @ G * (1 - factor))
        np.testing.assert_allclose(found.condition.value, lifted.sigma_max(M), rtol=5e-3)
        verdicts.append(found.condition.verdict)
    assert verdicts == ["holds", "holds", "holds", "fails"]
    by_function = frequency.norm_optimal_condition(
        ARX_MACHINE, truth, None, task, **weights | {"w_u": lambda f: 1e-3 + 0 * f}
    )
    np.testing.assert_allclose(by_function.magnitude, found.magnitude)


@pytest.mark.thorough
def test_two_channels_take_the_largest_singular_value():
    plant = PLANTS["mimo"]
    machine, task = Machine(plant), task_for(plant)
    found = frequency.learning_condition(machine, PIDType(gamma_p=(2.0, 1.0)), task, frequencies=F)
    M = np.eye(2) - np.diag([2.0, 1.0]) @ (Z[:, None, None] * of_plant(plant))
    np.testing.assert_allclose(found.magnitude, np.linalg.norm(M, 2, axis=(1, 2)), rtol=1e-9)
    weights = {"w_e": 1.0, "w_u": 0.1, "w_delta": lambda f: 0.2 + 0 * f}
    model = frequency.norm_optimal_condition(machine, machine, None, task, **weights, frequencies=F)
    G = of_plant(plant)
    H = np.conj(np.swapaxes(G, 1, 2)) @ G + 0.3 * np.eye(2)
    expected = np.linalg.norm(np.linalg.solve(H, 0.2 * np.eye(2)[None]), 2, axis=(1, 2))
    np.testing.assert_allclose(model.magnitude, expected, rtol=1e-9)


def test_the_worst_of_a_box_is_at_its_corner_at_least():
    """A full search finds it at a corner that no drawn plant reaches."""
    box = {"plant.b": Uniform(0.8, 1.2, relative=True), "plant.a[1]": Normal(-0.65, 0.005)}
    f = np.geomspace(0.5, 499.0, 2000)
    scheme = Filtered(PIDType(gamma_p=0.5, lead=3), ZeroPhaseButterworth(150.0))
    found = frequency.family_condition(
        ARX_MACHINE, box, scheme, TASK, machines=12, seed=1, climbers=0
    )
    z = np.exp(2j * np.pi * f * DT)
    Q = butterworth(f, 150.0)
    brute = {
        (gain, a2): np.max(
            np.abs(Q * (1 - 0.5 * z**4 * transfer((ARX[0][0], a2), gain * np.asarray(ARX[1]))(z)))
        )
        for gain in np.linspace(0.8, 1.2, 9)
        for a2 in np.linspace(-0.66, -0.64, 9)
    }
    worst = max(brute, key=brute.get)
    np.testing.assert_allclose([found.at["plant.b"], found.at["plant.a[1]"]], worst, rtol=1e-6)
    assert brute[worst] <= found.condition.value <= brute[worst] * (1 + 1e-5)
    assert np.max(found.values[:12]) < found.condition.value - 1e-3
    for name, (low, high) in {"plant.b": (0.8, 1.2), "plant.a[1]": (-0.66, -0.64)}.items():
        assert low <= np.min(found.drawn[name]) <= np.max(found.drawn[name]) <= high
    np.testing.assert_allclose(found.values[0], [*brute.values()][40], rtol=1e-5)  # nominal


@pytest.mark.thorough
def test_ascent_finds_the_worst_within_a_box():
    """A sharp resonance is worst in the middle of its range.

    There the filter still passes it, and the lead gives it a phase that makes learning diverge.
    """
    machine = Machine(ProcessModel(gain=1.0, frequencies=(350.0, 700.0), dampings=(0.7, 0.05)))
    box = {"plant.frequencies[1]": Uniform(600.0, 1000.0)}
    scheme = Filtered(PIDType(gamma_p=0.6, lead=6), ZeroPhaseButterworth(150.0))
    climbed = frequency.family_condition(
        machine, box, scheme, TASK, machines=4, seed=2, climbers=3, steps=40
    )
    f = np.geomspace(1.0, 499.0, 4000)
    z, Q = np.exp(2j * np.pi * f * DT), butterworth(f, 150.0)

    def value(w):
        parts = [[w0**2, 2 * zeta * w0, w0**2] for w0, zeta in ((350.0, 0.7), (w, 0.05))]
        bottom = np.polymul(*([1.0, damping, stiffness] for _, damping, stiffness in parts))
        held = scipy.signal.cont2discrete(([parts[0][0] * parts[1][0]], bottom), DT)
        P = np.polyval(np.squeeze(held[0]), z) / np.polyval(held[1], z)
        return np.max(np.abs(Q * (1 - 0.6 * z**7 * P)))

    brute = {w: value(w) for w in np.linspace(600.0, 1000.0, 161)}
    worst = max(brute, key=brute.get)
    assert 650.0 < worst < 950.0, "not at an end, or the test says nothing"
    assert climbed.condition.value >= brute[worst] * (1 - 1e-9)
    assert np.max(climbed.values[:6]) < brute[worst] - 1e-3, "neither samples nor corners have it"
    assert climbed.at["plant.frequencies[1]"] == pytest.approx(worst, abs=5.0)
    assert value(climbed.at["plant.frequencies[1]"]) == pytest.approx(
        climbed.condition.value, rel=1e-3
    )


@pytest.mark.thorough
def test_unstable_plants_of_a_family_are_counted():
    plant, box = StateSpace([[0.9]], [[0.1]], [[1.0]], dt=DT), {"plant.A[0][0]": Uniform(0.8, 1.2)}
    found = frequency.family_condition(
        Machine(plant), box, PIDType(gamma_p=0.5), TASK, machines=41, climbers=0
    )
    stable = next(p for p in found.condition.premises if p.name == "loop stable")
    assert found.condition.verdict == "not claimed"
    np.testing.assert_allclose(stable.share_broken, np.mean(found.drawn["plant.A[0][0]"] >= 1.0))


BAD = {
    "must ascend": lambda: frequency.learning_condition(
        ARX_MACHINE, PIDType(), TASK, frequencies=[1.0, 600.0]
    ),
    "learns no feedforward": lambda: frequency.learning_condition(ARX_MACHINE, PID(), TASK),
    "preview = 10": lambda: linear_loop(ARX_MACHINE, OnReference(PIDType(), Previewing()), TASK),
    "allowed is a feedback of preview 1": lambda: linear_loop(*case("p_type_on_reference")),
}


@pytree
class Previewing(Scheme):
    """The feedback needs the reference ten samples ahead."""

    @property
    def preview(self):
        return 10


test_what_does_not_fit_is_named = refused(BAD)


@pytest.mark.thorough
def test_single_precision_claims_what_its_rounding_leaves_room_for():
    task = Task(np.sin(np.linspace(0, 6, 41)), dt=DT)
    A, B = np.array([[0.9, 0.07], [0.0, 0.3]]), np.array([[-0.31], [-0.77]])
    x = np.linalg.solve(np.eye(2) - A, B)[:, 0]
    blind = StateSpace(A, B, [[1.0, -x[0] / x[1]]], dt=DT)  # P = 0 at 0 Hz: 1 - L P is 1 there
    plain = StateSpace(np.diag([0.3, 0.0]), np.eye(2, 1), [[1.0, 0.0]], dt=DT)
    found = []
    with jax.enable_x64(False):
        for plant, gain in ((plain, 0.9), (blind, 0.21)):
            test = frequency.learning_condition(Machine(plant), PIDType(gamma_p=gain), task)
            found.append(test.condition)
    assert found[0].holds
    np.testing.assert_allclose(found[0].value, abs(1 - 0.9 / 1.3), rtol=1e-5)
    assert abs(found[1].value - 1) < 1e-6
    assert found[1].verdict == "fails"
