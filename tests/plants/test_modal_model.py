"""The modal model, and dead times, against matrix exponentials, python-control, closed forms."""

import dataclasses
import decimal

import control
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy
from refusals import refused

from jaxilc.plants import ModalModel, ProcessModel, StateSpace, modal_model, motion, to_control
from jaxilc.plants.modal_model import _pair_after
from jaxilc.plants.process_model import samples_of

DT = 1e-3
FLEXIBLE = {
    "poles": (60.0,),
    "pole_gains": (0.4,),
    "frequencies": (200.0, 900.0),
    "dampings": (0.01, 0.03),
    "mode_gains": (1.0, 0.3),
    "mode_rates": (0.1, -0.2),
}
MATRICES = {
    "poles": (60.0,),
    "pole_gains": [[[0.4, 0.0], [0.1, 0.3], [1.0, 0.2]]],
    "frequencies": (200.0,),
    "dampings": (0.01,),
    "mode_gains": [[[1.0, 0.5], [0.2, 0.3], [0.0, 0.1]]],
    "mode_rates": [[[0.0, 0.1], [0.2, 0.0], [0.0, 0.1]]],
    "integrator": [[3.0, 0.0], [1.0, 1.0], [0.0, 2.0]],
    "double_integrator": [[30.0, 10.0], [1.0, 0.0], [0.0, 0.0]],
}


def rational(model, i=0, j=0):
    """The transfer function from input j to output i as a sum of quotients, by python-control."""
    s, shape = control.tf("s"), (-1, model.n_y, model.n_u)
    R, a, b = (np.reshape(N, shape) for N in (model.pole_gains, model.mode_gains, model.mode_rates))
    G = control.tf(0.0, 1.0)
    for p, gain in zip(model.poles, R[:, i, j], strict=True):
        G += float(gain) / (1 + s / float(p))
    for w, zeta, *N in zip(model.frequencies, model.dampings, a[:, i, j], b[:, i, j], strict=True):
        w, zeta, N = float(w), float(zeta), [float(n) for n in N]
        G += (N[0] + N[1] * s / w) / (1 + 2 * zeta * s / w + (s / w) ** 2)
    for power, N in ((1, model.integrator), (2, model.double_integrator)):
        G += 0.0 if N is None else float(np.reshape(N, shape)[0, i, j]) / s**power
    return G + (0.0 if model.direct is None else float(np.reshape(model.direct, shape)[0, i, j]))


simulated = jax.jit(motion, static_argnums=2)


@pytest.mark.thorough
@pytest.mark.parametrize("model", [ModalModel(**FLEXIBLE), ModalModel(**MATRICES)], ids=str)
def test_the_response_is_the_sum_that_is_written(model):
    s = 1j * np.geomspace(1.0, 3e3, 40)
    for i, j in np.ndindex(model.n_y, model.n_u):
        want = rational(model, i, j)(s)
        np.testing.assert_allclose(np.asarray(model.transfer(s))[:, i, j], want, rtol=1e-9)
    by_control = to_control(model)(s).transpose(2, 0, 1) if model.n_u > 1 else to_control(model)(s)
    found = np.asarray(model.transfer(s))
    np.testing.assert_allclose(by_control, found if model.n_u > 1 else found[:, 0, 0], rtol=1e-9)


@pytest.mark.parametrize("model", [ModalModel(**FLEXIBLE), ModalModel(**MATRICES)], ids=str)
def test_the_hold_is_that_of_the_matrix_exponential(model):
    c, d = jax.jit(lambda model: (model.continuous(), model.sampled(DT)))(model)
    n, m = c.B.shape
    block = np.zeros((n + m, n + m))
    block[:n, :n], block[:n, n:] = np.asarray(c.A) * DT, np.asarray(c.B) * DT
    both = scipy.linalg.expm(block)
    np.testing.assert_allclose(d.A, both[:n, :n], rtol=1e-10, atol=1e-15)
    np.testing.assert_allclose(d.B, both[:n, n:], rtol=1e-10, atol=1e-15)


@pytest.mark.parametrize("zeta", [1e-4, 0.3, 0.9999, 1.0, 1.0001, 3.0, 1e4])
@pytest.mark.parametrize("theta", [1e-5, 0.1, 2.0, 40.0])
def test_a_pair_keeps_its_digits_at_any_damping_and_speed(theta, zeta):
    """The oracle is a series in decimal numbers of 60 digits, squared until it is long enough."""
    with decimal.localcontext(prec=60):
        times = max(0, int(np.ceil(np.log2(theta * max(1.0, zeta)))) + 3)
        t, z = decimal.Decimal(theta) / 2**times, decimal.Decimal(zeta)
        x = [decimal.Decimal(0)] * 2  # Taylor coefficients of the step response, times t^k
        for k in range(60):
            x.append((k == 0) * t**2 - 2 * z * (k + 1) * t * x[k + 1] - t**2 * x[k])
            x[-1] /= (k + 1) * (k + 2)
        stepped, rate = sum(x), sum(k * c for k, c in enumerate(x)) / t
        for _ in range(times):  # M -> M^2 of x, x', and the held input
            a, b = 1 - stepped, rate  # free motion from x = 1: a, -b; from x' = 1: b, a - 2 z b
            stepped, rate = (
                stepped + a * stepped + b * rate,
                rate - b * stepped + (a - 2 * z * b) * rate,
            )
    found = _pair_after(jnp.array(theta), jnp.array(zeta))
    want = [float(stepped), float(rate)]
    np.testing.assert_allclose(found, want, rtol=1e-13 * max(1.0, 1 / theta), atol=1e-300)


def test_a_pair_is_smooth_where_it_becomes_two_real_poles():
    of = jax.jit(jax.vmap(jax.value_and_grad(lambda z: _pair_after(jnp.array(0.7), z)[0])))
    z, h = np.array([0.99, 1.0, 1.01, 1.04, 1.2]), 1e-5
    differences = (of(z + h)[0] - of(z - h)[0]) / (2 * h)
    np.testing.assert_allclose(of(z)[1], differences, rtol=1e-7)


MODEL = ModalModel(**FLEXIBLE, integrator=3.0)
PROCESS = ProcessModel(2.0, (-300.0,), (60.0,), (200.0,), (0.3,))
LAGS = control.tf([2 / 300, 2.0], np.polymul([1 / 60, 1.0], [1 / 4e4, 0.6 / 200, 1.0]))


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("model", "G", "direct", "samples"),
    [
        *((dataclasses.replace(MODEL, direct=0.7), rational(MODEL), 0.7, d) for d in (0, 2, 0.25)),
        *((PROCESS, LAGS, 0.0, d) for d in (0, 2, 2.6)),
    ],
)
def test_delay_and_direct_term_are_those_of_the_held_input(model, G, direct, samples):
    """On a grid 20 times as fine the late input is whole samples, and y is read just before u."""
    fine, u = 20, np.random.default_rng(1).normal(size=50)
    A, B, C, D, _ = scipy.signal.cont2discrete(
        scipy.signal.tf2ss(G.num[0][0], G.den[0][0]), DT / fine, method="zoh"
    )
    late = np.r_[np.zeros(round(samples * fine)), np.repeat(u, fine)][: fine * len(u)]
    y = scipy.signal.dlsim((A, B, C, D, DT / fine), late)[1][::fine, 0]
    y[1:] += direct * late[fine - 1 : -1 : fine]
    found = simulated(dataclasses.replace(model, delay=samples * DT), u[:, None], DT)[:-1, 0]
    np.testing.assert_allclose(found, y, atol=1e-10 * np.max(abs(y)))


@pytest.mark.thorough
def test_a_delay_has_no_continuous_state_space():
    late = dataclasses.replace(PROCESS, delay=3 * DT)
    assert PROCESS.continuous() is not None
    assert late.continuous() is None
    assert late.regrouped().delay == 3 * DT
    with pytest.raises(ValueError, match="no form in continuous time"):
        to_control(late)
    assert to_control(late, DT).nstates == 6


def test_whole_samples_and_the_largest_delay():
    assert samples_of(0.1 + 0.2, 0.1) == (3, 0.0)
    assert samples_of(1.07, 0.00107) == (1000, 0.0)
    whole, rest = samples_of(2.5 * DT, DT)
    assert (whole, pytest.approx(0.5 * DT)) == (2, rest)
    for model in (PROCESS, MODEL):
        said = rf"{type(model).__name__}: delay = 2 s is 2000 samples of 0.001 s; allowed are at"
        with pytest.raises(ValueError, match=said):
            dataclasses.replace(model, delay=2.0).sampled(DT)
        with pytest.raises(ValueError, match=r"delay = -0.1 is outside"):
            dataclasses.replace(model, delay=-0.1)


@pytest.mark.thorough
def test_zeros_are_those_of_the_polynomials():
    model = ModalModel(**FLEXIBLE, direct=0.2)
    want = np.sort_complex(np.roots(rational(model).num[0][0]))
    np.testing.assert_allclose(np.sort_complex(model.all_zeros()), want, rtol=1e-7)
    drive = ModalModel(  # two masses, encoder on the motor: an antiresonance at 100 rad/s
        frequencies=(150.0,), dampings=(1e-9,), mode_gains=(1.0,), mode_rates=(0.0,),
        double_integrator=150.0**2 / (150.0**2 / 100.0**2 - 1.0),
    )  # fmt: skip
    np.testing.assert_allclose(drive.all_zeros().imag, [-100.0, 100.0], rtol=1e-6)
    several = ModalModel(**MATRICES)
    want = np.roots(rational(several, 1, 1).num[0][0])
    found = several.all_zeros(1, 1)
    np.testing.assert_allclose(np.sort_complex(found), np.sort_complex(want), rtol=1e-6)


@pytest.mark.thorough
@pytest.mark.parametrize(
    "plant",
    [
        ProcessModel(-4.8, (900.0,), (6.4,), (470.0, 90.0), (1.0, 0.02), delay=0.0123),
        ModalModel(**FLEXIBLE),
        ModalModel(**MATRICES),
        StateSpace([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]], [[1.0, 0.1]]),
    ],
    ids=["process", "modal", "matrices", "mass"],
)
def test_other_forms_become_a_sum_of_parts(plant):
    model = modal_model(plant)
    assert model.delay == getattr(plant, "delay", 0.0)
    s = 2j * np.geomspace(1.0, 1e3, 30)
    same = (
        dataclasses.replace(plant, delay=0.0).continuous()
        if isinstance(plant, ProcessModel)
        else plant.continuous()
    )
    want = [same.C @ np.linalg.solve(x * np.eye(len(same.A)) - same.A, same.B) for x in s]
    found = model.transfer(s) / np.exp(-s * model.delay)[:, None, None]
    np.testing.assert_allclose(found, want, rtol=1e-7, atol=1e-12)


def test_a_system_with_feedthrough_and_a_process_model_and_back():
    s = control.tf("s")
    model = modal_model(2 * (s**2 + 3 * s + 400) / ((s + 5) * (s**2 + s + 900)) + 0.5)
    assert model.direct == pytest.approx(0.5)
    assert np.any(model.all_zeros().imag)
    assert modal_model(control.ss([], [], [], 3.0, 0)).direct == 3.0
    plant = ProcessModel(2.0, (-80.0, 300.0), (20.0, 500.0), (90.0,), (0.2,), delay=0.003)
    back = modal_model(plant).as_process_model()
    for name in ("gain", "zeros", "poles", "frequencies", "dampings", "delay"):
        np.testing.assert_allclose(getattr(back, name), getattr(plant, name), rtol=1e-7)
    # of a lag and a mode of no gain nothing is seen
    unseen = ModalModel((20.0, 5.0), (1.0, 0.0), (90.0, 40.0), (0.2, 0.1), (2.0, 0.0), (0.0, 0.0))
    x = 1j * np.array([1.0, 30.0, 200.0])
    other = modal_model(unseen.as_process_model())
    np.testing.assert_allclose(other.transfer(x), unseen.transfer(x), rtol=1e-7)
    with pytest.raises(ValueError, match="the model has complex zeros; allowed are"):
        ModalModel(**FLEXIBLE).as_process_model()


REFUSED = {
    "the parts have the numerators none; allowed is one or more": lambda: ModalModel(),
    r"pole_gains has shape \(0,\) for \(1,\) parts; allowed": lambda: ModalModel((1.0,)),
    "allowed is one or more, each a": lambda: ModalModel((1.0,), (1.0,), direct=[[1.0]]),
    r"poles = \[-1.\] is outside its allowed range": lambda: ModalModel((-1.0,), (1.0,)),
    r"frequencies \(1,\) and dampings \(0,\) must have one shape": lambda: ModalModel(
        (), (), (1.0,), (), (1.0,), (1.0,)
    ),
    "are not all stable, but for integrators": lambda: modal_model(
        StateSpace([[1.0]], [[1.0]], [[1.0]])
    ),
    "more poles coincide than a pair of real ones": lambda: modal_model(
        control.tf(1, np.poly([-1.0] * 4))
    ),
    "in continuous time": lambda: modal_model(control.tf(1, [1, 0.5], 0.1)),
}
test_what_is_no_such_model_is_refused = refused(REFUSED)
