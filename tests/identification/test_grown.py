"""Grown models are compared with the plants that made the records, and their slopes with numbers.

The simulated drives are those of an experiment, which NumPy and SciPy make alone.
"""

import os
import runpy
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter

from jaxilc.identification import Record, excite, grow, grown, problem, read_record
from jaxilc.identification.not_linear import Answers
from jaxilc.learning import Machine, Sensor
from jaxilc.plants import ModalModel, ProcessModel

DT = 1e-3
drives = runpy.run_path(str(Path(__file__).parents[2] / "experiments" / "drives_identified.py"))
RNG = np.random.default_rng(2)
U = RNG.choice([-1.0, 1.0], size=(900, 1))
PLANT = ModalModel(
    poles=(40.0,), pole_gains=(0.6,), frequencies=(260.0,), dampings=(0.03,), mode_gains=(0.4,),
    mode_rates=(0.1,), integrator=3.0, direct=0.2, delay=2 * DT,
)  # fmt: skip
PARTS = grown.Parts(np.log([[250.0, 0.05], [90.0, 1.4]]), np.log([30.0]), 1, True, 1)


def signals(u=U, channels=1, samples=None):
    """A record of noise, whose fit is as good as any for slopes and sizes."""
    y = np.random.default_rng(4).normal(size=(len(u) + 1, channels))
    return grown.Signals.of(Record(u, y, DT), samples or len(y))


@pytest.mark.parametrize(("inputs", "outputs"), [(1, 1), (2, 2)])
def test_the_slopes_of_the_residual_are_those_of_differences(inputs, outputs):
    """To first order in what is left, so at a point where the parts explain the record."""
    u = RNG.normal(size=(300, inputs))
    of = signals(u, outputs)
    X, _ = grown.columns(of, PARTS)
    of = of._replace(y=X @ RNG.normal(size=(X.shape[1], outputs)))

    def at(x):
        return problem.projected(x, grown.columns(of, PARTS.at(x))[0], of.y)

    here = at(PARTS.x)
    assert np.max(np.abs(here.left)) < 1e-9
    J = grown.slopes(of, PARTS, here.N)
    J = J - np.tensordot(here.Q, np.tensordot(here.Q.T, J, 1), 1)
    for i in range(len(PARTS.x)):
        step = np.zeros(len(PARTS.x))
        step[i] = 1e-6
        ahead, behind = (at(PARTS.x + s * step).left for s in (1, -1))
        np.testing.assert_allclose(J[..., i], (ahead - behind) / 2e-6, rtol=1e-4, atol=1e-4)


@pytest.mark.thorough
@pytest.mark.parametrize("channels", [1, 2])
def test_the_plant_answers_as_the_columns_do(channels):
    """Of two experiments, with every kind of part, a delay and two channels."""
    u = RNG.normal(size=(200, channels))
    y = RNG.normal(size=(202, channels))
    record = Record(u, y, DT, trials=2)
    of = grown.Signals.of(record, 150)
    parts = PARTS._replace(integrators=2)
    plant = grown.plant_of(of, parts)
    X = grown.columns(of, parts)[0]
    X = X - X[[0]]
    want = X @ (grown.numerators(of, parts)[0] * of.scale)
    for half in range(2):
        found = excite(Machine(plant), u[100 * half : 100 * (half + 1)], DT).y
        np.testing.assert_allclose(found, want[101 * half : 101 * (half + 1)], rtol=1e-7, atol=1e-7)


@pytest.mark.thorough
def test_what_is_not_linear_is_asked_of_what_the_plant_answers():
    record = Record(U, RNG.normal(size=(901, 1)), DT)
    of = grown.Signals.of(record, 700)
    ours = grown.answers_of(of, PARTS)
    simulated = Answers.of(grown.plant_of(of, PARTS), record)
    for one, other in zip(ours, simulated, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-7, atol=1e-7)


@pytest.mark.thorough
def test_order_delay_direct_term_and_integrator_are_found():
    u = RNG.choice([-1.0, 1.0], size=(1000, 1))
    record = excite(Machine(PLANT, sensor=Sensor(noise=2e-3)), u, DT)
    model = grow(record, longest=8)
    assert (model.chosen.order, model.chosen.integrators) == (4, 1)
    assert (model.chosen.direct, model.chosen.delay) == (True, 2)
    assert model.found.white
    for name in ("poles", "frequencies", "dampings", "pole_gains", "mode_gains", "mode_rates"):
        for i in range(len(np.atleast_1d(getattr(PLANT, name)))):
            value, low, high = model.found.parameters[f"{name}[{i}]"]
            assert abs(value - float(getattr(PLANT, name)[i])) < 2 * (high - low)


@pytest.mark.thorough
def test_of_a_long_record_a_part_compares_and_all_of_it_is_fitted(monkeypatch):
    """But for a slow sweep, and for small noise that comes late: the fast modes would be missed."""
    record = excite(Machine(PLANT, sensor=Sensor(noise=0.05)), np.tile(U, (4, 1)), DT)
    all_compare = grow(record, delay=2)
    for name, samples in (("LONG_RECORD", 2000), ("PART", 900)):
        monkeypatch.setattr(grown, name, samples)
    sweep = np.resize(np.sin(np.cumsum(np.geomspace(1e-2, 3.0, 2600))), (3600, 1))
    motion = 10 * np.sin(np.arange(3600)[:, None] / 100)
    motion[1400:] += 0.1 * record.u[1400:]
    for u, least, most in ((record.u, 900, 900), (sweep, 2000, 2520), (motion, 1400, 2000)):
        of = grown.Signals.of(record._replace(u=u), 2520).first()
        assert least <= len(of.part().y) <= most
    model = grow(record, delay=2)
    for name, (value, low, high) in all_compare.found.parameters.items():
        assert model.found.parameters[name].value == pytest.approx(value, abs=1e-3 * (high - low))
    assert model.chosen.bic == pytest.approx(all_compare.chosen.bic, abs=0.01)
    assert min(one.bic for one in model.tried) > model.chosen.bic - 10  # all are of all samples


@pytest.mark.thorough
def test_a_simple_plant_stays_one_of_real_zeros():
    plant = ProcessModel(2.0, (), (150.0,), (300.0,), (0.4,), delay=3 * DT)
    model = grow(excite(Machine(plant, sensor=Sensor(noise=5e-3)), U, DT))
    found = model.found.plant
    assert isinstance(found, ProcessModel)
    assert (len(found.zeros), found.order) == (0, 3)
    assert found.delay == pytest.approx(3 * DT)
    np.testing.assert_allclose(found.frequencies, 300.0, rtol=0.05)


@pytest.mark.thorough
def test_one_lag_is_a_gain_and_a_pole_also_in_few_samples():
    lag = Machine(ProcessModel(3.0, (), (80.0,)), sensor=Sensor(noise=0.1))
    found = grow(excite(lag, U[:60], DT)).found.plant
    assert (type(found), found.order) == (ProcessModel, 1)


@pytest.mark.thorough
def test_a_dipole_is_kept_or_dropped_by_its_joint_test():
    """A zero beside a pole: their intervals overlap, yet both are needed at little noise."""
    poles, zeros = (40.0, 300.0), (-44.0,)
    plant = ProcessModel(1.0, zeros, poles)
    u = np.repeat(RNG.choice([-1.0, 1.0], size=40), 40)[:, None]
    clear = excite(Machine(plant, sensor=Sensor(noise=1e-3)), u, DT)
    assert grow(clear, delay=0).chosen.order == 2
    hidden = excite(Machine(plant, sensor=Sensor(noise=2.0)), u, DT)
    assert grow(hidden, delay=0).chosen.order == 1


@pytest.mark.thorough(but=["5"])
@pytest.mark.parametrize("seed", [5, 23])
def test_a_simulated_drive_is_found_as_well_as_its_true_model_fits(seed):
    """The longest delay with a hidden pole; eight poles."""
    one = drives["drive"](seed)
    model = grow(Record(one.u[:, None], one.y[:, None], one.dt))
    assert model.found.validation_fit[0] > one.true_fit - 0.5
    assert drives["fit"](one.y, model.found.simulated[:, 0]) == pytest.approx(
        float(model.found.validation_fit[0])
    )
    assert model.found.white


def test_channels_share_their_poles():
    plant = ModalModel(
        frequencies=(150.0, 420.0), dampings=(0.05, 0.02),
        mode_gains=[[[1.0, 0.3], [0.2, 0.8]], [[0.3, -0.2], [0.1, 0.4]]],
        mode_rates=np.zeros((2, 2, 2)),
    )  # fmt: skip
    u = RNG.choice([-1.0, 1.0], size=(600, 2))
    model = grow(excite(Machine(plant, sensor=Sensor(noise=1e-2)), u, DT), longest=3)
    assert (model.chosen.order, model.chosen.modes) == (4, 2)
    np.testing.assert_allclose(model.found.plant.frequencies, [150.0, 420.0], rtol=0.01)
    assert np.all(model.found.validation_fit > 95)


@pytest.mark.thorough
def test_an_order_that_is_asked_for_is_fitted():
    record = excite(Machine(PLANT, sensor=Sensor(noise=1e-2)), U, DT)
    model = grow(record, order=3, delay=2)
    assert model.chosen.order == 3
    assert {one.order for one in model.tried} <= {1, 2, 3}
    assert {one.delay for one in model.tried} == {2}
    for one in model.tried:  # of each pole itself and its gain; a constant, and the delay
        assert one.parameters == 2 * one.order - one.integrators + one.direct + 2


def test_an_integrator_more_or_less_stands_in_for_a_slow_pole():
    slow, fast = np.log([1e-3, 50.0])
    (one,) = grown.at_rest(grown.Parts(np.zeros((0, 2)), np.array([slow, fast]), 1), 1.0)
    assert (one.integrators, one.lags.tolist()) == (2, [fast])
    (one,) = grown.at_rest(grown.Parts(np.zeros((0, 2)), np.array([fast]), 2), 1.0)
    assert (one.integrators, len(one.lags)) == (1, 2)


@pytest.mark.thorough
def test_an_output_that_answers_within_its_sample_is_not_called_unstable():
    """Nothing can explain it here, so the poles of a difference equation were those of chance."""
    for seed in range(2):
        rng = np.random.default_rng(seed)
        u, y = rng.normal(size=200), 0.02 * rng.normal(size=201)
        y[:200] += lfilter([0.5, 0.3], [1, -1.2, 0.5], u)
        found = grow(Record(u[:, None], y[:, None], 1e-3), delay=0).found
        assert found.fit[0] < 80


@pytest.mark.thorough
def test_an_order_beyond_what_is_needed_is_reached_and_one_below_is_not_called_unstable():
    simple = excite(Machine(ProcessModel(3.0, (), (80.0, 20.0))), U[:300], DT)
    assert grow(simple, order=10, delay=0).chosen.order == 10
    one = drives["drive"](4)  # two masses, found with a delay that is too long
    assert grow(Record(one.u[:, None], one.y[:, None], one.dt), order=2).chosen.order == 2


def test_an_axis_with_friction_is_not_called_unstable():
    """A mass of 0.8 kg with friction and cogging, in its position loop, read to a micrometre."""
    k, x, v = np.arange(4000), 0.0, 0.0
    r = 0.05 * (1 - np.cos(np.pi * k * DT)) + 0.02 * np.sin(1.8 * np.pi * k * DT)
    u, y = np.zeros((4000, 1)), 1e-6 * np.random.default_rng(1).standard_normal((4001, 1))
    for i, rate in enumerate(np.gradient(r, DT)):
        y[i] += x
        u[i] = 4000 * (r[i] - y[i]) + 60 * (rate - v)
        lost = 0.5 * v + 0.2 * np.tanh(100 * v) + 0.3 * np.sin(2 * np.pi * x / 0.024)
        v += (u[i, 0] - lost) / 0.8 * DT
        x += v * DT
    y[-1] += x
    whole = grown.Signals.of(Record(u, y, DT), 2800)
    poor = grown.refined(whole.first(), grown.of_poles(np.array([-2000.0]), 0), 1)
    assert np.max(grown.reduced_poles(whole.first(), 0, clip=False)(4).real) > 10
    grown.need_stable(whole, poor)


def test_what_cannot_be_fitted_is_said():
    record = excite(Machine(PLANT), U, DT)
    with pytest.raises(ValueError, match=r"record is too short: 28 samples to fit 41 .* at least"):
        grow(Record(U[:39], record.y[:40], DT), order=20)
    with pytest.raises(ValueError, match=r"order = 40 is outside its allowed range \[1, 24\]"):
        grow(record, order=40)
    with pytest.raises(ValueError, match="output 0 is constant"):
        grow(Record(U, np.ones((901, 1)), DT))
    y, x = np.zeros((401, 1)), 0.0
    for k in range(400):
        x = 1.05 * x + 0.01 * U[k, 0]
        y[k + 1] = x
    with pytest.raises(
        ValueError, match=r"seems to be unstable, with a pole near \+48.8 .* feedback"
    ):
        grow(Record(U[:400], y, DT), longest=5)


@pytest.mark.skipif(
    "JAXILC_MEASURED" not in os.environ, reason="JAXILC_MEASURED names no folder of records"
)
def test_a_measured_robot_arm_is_found_with_its_complex_zeros():
    """A fit of 20 lines by hand reaches 89.6 % of the last 30 % of the record."""
    record = read_record(Path(os.environ["JAXILC_MEASURED"]) / "robot_arm.csv")
    model = grow(record)
    assert model.found.validation_fit[0] > 89.6
    assert np.sum(np.abs(model.found.plant.all_zeros().imag) > 1) >= 4
