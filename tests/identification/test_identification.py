"""Identification is compared with python-control, the true parameters and statistics of noise."""

import control
import jax
import numpy as np
import pytest
import scipy.signal
from cases import ALGEBRA, SIGMAS

from jaxilc import figures
from jaxilc.identification import Record, excite, identify, read_record, write_record
from jaxilc.identification.verdict import fit_of, poles_of
from jaxilc.learning import Actuator, Machine, Sensor
from jaxilc.plants import DifferenceEquation, ProcessModel, StateSpace, VoiceCoil, voice_coil
from jaxilc.pytree import get_at
from jaxilc.signals.references import m_sequence

DT = 1e-3
U = m_sequence(9, hold=2, periods=3)  # (3066,) [V]
ENCODER, NOISE = 1e-4, 2e-4  # [mm]
TRUE = {
    "gain": -7437.7769 * 928.2 / (474.0**2 * 6.404),  # -4.798
    "zeros[0]": 928.2,
    "poles[0]": 6.404,
    "frequencies[0]": 474.0,
    "dampings[0]": 1.0,
    "bias": 0.0,
}
EQ_7 = ProcessModel(TRUE["gain"], [928.2], [6.404], [474.0], [1.0])
MOTOR = Machine(voice_coil(), sensor=Sensor(ENCODER, NOISE))


@pytest.fixture(scope="module")
def record():
    return excite(MOTOR, U, DT)


@pytest.fixture(scope="module")
def identified(record):
    return identify(record)


def inside(estimate, value):
    return estimate.low <= value <= estimate.high


def width(estimate):
    return estimate.high - estimate.low


# The process model
# --------------------------------------------------------------------------------------------------

MODELS = {
    "eq_7": EQ_7,
    "lag": ProcessModel(2.0, [], [50.0]),
    "two_lags_one_zero": ProcessModel(-1.5, [-80.0], [20.0, 300.0]),
    "resonance": ProcessModel(0.7, [], [], [250.0], [0.02]),
    "overdamped": ProcessModel(1.0, [], [], [100.0], [2.5]),
    "everything": ProcessModel(
        3.0, [-40.0, 600.0, 90.0], [30.0, 500.0], [150.0, 700.0], [0.1, 0.6]),
}  # fmt: skip


def transfer_function(p):
    num = float(p.gain) * control.tf([1.0], [1.0])
    for z in p.zeros:
        num *= control.tf([-1.0 / z, 1.0], [1.0])
    for lag in p.poles:
        num *= control.tf([1.0], [1.0 / lag, 1.0])
    for w, zeta in zip(p.frequencies, p.dampings, strict=True):
        num *= control.tf([1.0], [1.0 / w**2, 2.0 * zeta / w, 1.0])
    return num


@pytest.mark.parametrize(
    ("model", "dt"),
    [*((m, DT) for m in MODELS.values()), (MODELS["everything"], DT / 4)],
    ids=[*MODELS, "faster"],
)
def test_process_model_responds_as_python_control_and_has_its_poles(model, dt):
    u, continuous = np.random.default_rng(1).normal(size=200), transfer_function(model)
    poles = (np.array(model.all_poles), control.poles(continuous))
    np.testing.assert_allclose(*(np.sort_complex(np.poly(one)) for one in poles), rtol=1e-8)
    discrete = control.c2d(control.ss(continuous), dt, method="zoh")
    expected = control.forced_response(discrete, np.arange(201) * dt, np.append(u, 0.0)).outputs
    y = excite(Machine(model), u, dt).y[:, 0]
    np.testing.assert_allclose(y, expected, rtol=1e-6, atol=1e-8 * np.max(np.abs(expected)))
    assert np.max(np.abs(expected)) > 1e-3


def test_process_model_is_eq_7_of_the_paper():
    model, motor = (excite(Machine(plant), U, DT).y for plant in (EQ_7, voice_coil()))
    np.testing.assert_allclose(model, motor, rtol=1e-8, atol=1e-10)
    assert TRUE["gain"] == pytest.approx(-4.798, abs=5e-4)


def test_regrouping_pairs_the_nearest_real_poles_and_keeps_the_response():
    """The poles are 6.4, 470 and 480, and the slow one is hidden in the pair."""
    w, zeta = np.sqrt(6.4 * 470.0), (6.4 + 470.0) / (2 * np.sqrt(6.4 * 470.0))
    hidden = ProcessModel(1.0, [900.0, -20.0], [480.0], [w, 50.0], [zeta, 0.3])
    model = hidden.regrouped()
    np.testing.assert_allclose(model.poles, [6.4], rtol=1e-10)
    np.testing.assert_allclose(model.frequencies, [50.0, np.sqrt(470.0 * 480.0)], rtol=1e-10)
    np.testing.assert_allclose(
        model.dampings, [0.3, 950.0 / (2 * np.sqrt(470.0 * 480.0))], rtol=1e-10
    )
    np.testing.assert_array_equal(model.zeros, [-20.0, 900.0])
    np.testing.assert_allclose(
        excite(Machine(model), U[:100], DT).y, excite(Machine(hidden), U[:100], DT).y, **ALGEBRA
    )


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: ProcessModel(1.0, [1.0], [2.0]),
         r"ProcessModel: 1 zeros over 1 poles; allowed are fewer zeros than poles"),
        (lambda: ProcessModel(1.0), r"ProcessModel: 0 zeros over 0 poles"),
        (lambda: ProcessModel(1.0, [0.0], [2.0, 3.0]),
         r"ProcessModel: zeros = 0 makes the DC gain 0"),
        (lambda: ProcessModel(1.0, [], 2.0),
         r"ProcessModel: poles has shape \(\); allowed is one dimension"),
        (lambda: ProcessModel(1.0, [], [], [2.0, 3.0], [1.0]),
         r"ProcessModel: frequencies \(2,\) and dampings \(1,\) must have one shape"),
    ],
)  # fmt: skip
def test_impossible_process_models_are_refused(build, message):
    with pytest.raises(ValueError, match=message):
        build()


# The experiment
# --------------------------------------------------------------------------------------------------


@pytest.mark.thorough
def test_a_record_holds_the_input_as_applied_and_the_output_as_the_encoder_shows_it():
    record = excite(Machine(EQ_7, Actuator(limit=0.5, resolution=0.4), Sensor(ENCODER)), U[:50], DT)
    np.testing.assert_allclose(np.abs(record.u), 0.4, **ALGEBRA)
    exact = excite(Machine(EQ_7), record.u, DT)
    assert record.y.shape == (51, 1)
    counts = np.asarray(record.y) / ENCODER
    np.testing.assert_allclose(counts, np.round(counts), atol=1e-9)
    assert 0 < np.max(np.abs(record.y - exact.y)) <= ENCODER / 2 * (1 + 1e-9)


# The fit
# --------------------------------------------------------------------------------------------------


@pytest.mark.thorough
def test_eq_7_is_recovered_within_the_intervals(identified):
    assert list(identified.parameters) == list(TRUE)
    for name, value in TRUE.items():
        assert inside(identified.parameters[name], value), name
        if name != "bias":
            assert width(identified.parameters[name]) < 5e-3 * abs(value), name
            assert float(get_at(identified.plant, name)) == identified.parameters[name].value
    assert identified.white
    assert identified.converged
    # What remains is the noise and the rounding of the encoder.
    assert identified.samples == round(0.7 * 3067)
    assert identified.residual_std[0] == pytest.approx(
        np.sqrt(NOISE**2 + ENCODER**2 / 12), rel=SIGMAS / np.sqrt(2 * identified.samples)
    )
    assert min(identified.fit[0], identified.validation_fit[0]) > 99.8


@pytest.mark.thorough
def test_poles_have_intervals_even_where_they_meet(identified):
    for pole, true in zip(identified.poles, (-6.404, -474.0, -474.0), strict=True):
        assert inside(pole.real, true)
        assert inside(pole.imag, 0.0)
        assert inside(pole.real, pole.value.real)
        assert inside(pole.imag, pole.value.imag)
    # The distance of the two poles of a double pole is proportional to the square root of the error
    # of the damping, so it is much less certain than the frequency.
    assert width(identified.poles[1].real) > 5 * width(identified.parameters["frequencies[0]"])


@pytest.mark.thorough
def test_figures_of_merit_are_those_of_the_simulated_output(record, identified):
    y, n = np.asarray(record.y)[:, 0], identified.samples
    bias = identified.parameters["bias"].value
    simulated = excite(Machine(identified.plant), record.u, DT).y[:, 0] + bias
    np.testing.assert_allclose(identified.simulated[:, 0], simulated, rtol=1e-9, atol=1e-12)
    for part, fit in ((slice(n), identified.fit), (slice(n, None), identified.validation_fit)):
        expected = 1 - np.sqrt(
            np.sum((y - simulated)[part] ** 2) / np.sum((y[part] - np.mean(y[part])) ** 2)
        )
        assert fit[0] == pytest.approx(100 * expected, abs=1e-9)
    rows = {name: values for name, *values in identified.summary()}
    assert rows["gain"] == list(identified.parameters["gain"])
    assert rows["fit [%]"][0] == identified.fit[0]


@pytest.mark.thorough
def test_another_seed_finds_the_same_minimum(record, identified):
    again = identify(record, seed=7, starts=32)
    for name, found in identified.parameters.items():
        value = again.parameters[name].value
        assert value == pytest.approx(found.value, abs=1e-3 * width(found)), name


@pytest.mark.thorough
def test_intervals_cover_the_truth_as_often_as_they_say():
    """Over 100 noise records; errors over standard deviations have a standard deviation of 1."""
    seeds, machine = 100, Machine(EQ_7, sensor=Sensor(ENCODER, NOISE))
    keys = jax.random.split(jax.random.key(1), seeds)
    outputs = np.asarray(jax.vmap(lambda key: excite(machine, U, DT, key=key).y)(keys))
    found = [identify(Record(U, y, DT), EQ_7) for y in outputs]
    for i, (name, true) in enumerate(TRUE.items()):
        covered = np.mean([inside(f.parameters[name], true) for f in found])
        assert covered >= 0.95 - SIGMAS * np.sqrt(0.95 * 0.05 / seeds), name
        errors = [(f.parameters[name].value - true) / np.sqrt(f.covariance[i, i]) for f in found]
        assert np.std(errors) == pytest.approx(1.0, abs=SIGMAS / np.sqrt(2 * seeds)), name
    assert np.mean([f.white for f in found]) > 0.9


@pytest.mark.thorough
def test_too_low_an_order_shows(record, identified):
    poor = identify(record, poles=1, pairs=0, zeros=0)
    assert poor.validation_fit[0] < identified.validation_fit[0] - 10
    assert poor.residual_std[0] > 100 * identified.residual_std[0]
    assert not poor.white


@pytest.mark.thorough
def test_a_lightly_damped_drive_is_found_without_a_start():
    """2.229e7 / (s^2 + 70.16 s + 2.413e6) (Xu 2024): 247 Hz, damping 0.0226, encoder 1.2 nm."""
    w, zeta, gain = np.sqrt(2.413e6), 70.16 / (2 * np.sqrt(2.413e6)), 2.229e7 / 2.413e6
    servo = Machine(ProcessModel(gain, [], [], [w], [zeta]), sensor=Sensor(1.2e-3, 5e-3))
    record = excite(servo, m_sequence(9, hold=3, periods=2), 1e-4)
    found = identify(record, poles=0, pairs=1, zeros=0)
    for name, true in {"gain": gain, "frequencies[0]": w, "dampings[0]": zeta}.items():
        assert inside(found.parameters[name], true), name
    for pole, sign in zip(found.poles, (1, -1), strict=True):
        assert inside(pole.real, -zeta * w)
        assert inside(pole.imag, sign * w * np.sqrt(1 - zeta**2))
        assert width(pole.real) < 0.05 * zeta * w
    assert found.white


# A given plant
# --------------------------------------------------------------------------------------------------


@pytest.mark.thorough
def test_chosen_leaves_and_elements_of_a_given_plant(record):
    start = VoiceCoil(gain=5000.0, zero=500.0, poles=(474.0, 474.0, 20.0))
    found = identify(record, start, free=("gain", "zero", "poles[2]"), fit_share=1.0)
    assert list(found.parameters) == ["gain", "zero", "poles[2]", "bias"]
    for name, true in (("gain", 7437.7769), ("zero", 928.2), ("poles[2]", 6.404)):
        assert inside(found.parameters[name], true), name
    np.testing.assert_array_equal(found.plant.poles[:2], start.poles[:2])
    assert found.poles == ()
    assert np.isnan(found.validation_fit[0])


def test_where_an_output_rests_it_has_no_fit():
    rest, moved = np.full(120, 0.45), U[:120]  # the mean of the first is not exactly 0.45
    y = np.stack([rest, moved], axis=1)
    np.testing.assert_allclose(fit_of(y, 0.1 * np.std(moved) * y), [np.nan, 90], rtol=0.02)


@pytest.mark.thorough
def test_where_an_output_rests_but_for_noise_it_has_no_fit():
    """Noise of 1 after a stroke of 1000 that the model explains; a model that drifts is told."""
    rng = np.random.default_rng(4)
    noise, drift = rng.normal(size=(200, 1)), np.linspace(0, 50, 200)[:, None]
    assert np.isnan(fit_of(noise, noise - 0.02, 1.5, 1.5))
    assert np.isnan(fit_of(noise, noise - 2.0, 1.5, 3.0)), "an error of the model, as it is at rest"
    assert fit_of(noise, noise - 2.0, 1.5, 1.5) < 0
    assert fit_of(noise, noise) == pytest.approx(0, abs=1)
    assert fit_of(noise, noise + drift, 1.5, 1.5) < -1000
    assert fit_of(noise, noise + drift, 1.5, 100.0) < -1000, "whatever the model errs in a motion"
    assert fit_of(noise + drift, noise, 1.5, 1.5) > 90
    u = np.where(np.arange(400) < 200, np.repeat(rng.normal(size=40), 10), 1.0)
    y = [0.0]
    for of in u:  # a lag of five samples
        y.append(y[-1] + (1 - np.exp(-0.2)) * (of - y[-1]))
    found = identify(Record(u, np.array(y) + 1e-3 * rng.normal(size=401), DT), MODELS["lag"])
    assert found.fit[0] > 99
    assert np.isnan(found.validation_fit[0])


@pytest.mark.thorough
def test_what_the_model_errs_in_a_motion_is_no_noise():
    """A lag without a mode at 40 Hz fits 96 %; then the mode alone moves, and the lag misses it."""
    rng, t, step = np.random.default_rng(3), np.arange(1201) * 1e-3, 1e-3
    knots = np.append(rng.normal(size=20), np.zeros(11))
    u = np.interp(t, np.arange(31) * 0.04, knots) + 0.3 * np.sin(80 * np.pi * t) * (t < 0.75)
    u += 0.2 * np.sin(80 * np.pi * t) * (t > 0.8)
    w = 80 * np.pi
    mode = np.polymul([w**2], [0.05, 1.0]) * 0.006
    num = np.polyadd([1.0, 0.06 * w, w**2], mode)
    den = np.polymul([0.05, 1.0], [1.0, 0.06 * w, w**2])
    b, a, _ = scipy.signal.cont2discrete((num, den), step)
    y = scipy.signal.lfilter(b.ravel(), a, u) + 1e-4 * rng.normal(size=len(t))
    found = identify(Record(u[:-1], y, step), MODELS["lag"], fit_share=0.71)
    assert found.fit[0] > 90
    late, left = y[found.samples :], (y - found.simulated[:, 0])[found.samples :]
    assert np.std(late) > 100 * 1e-4
    share = 1 - np.linalg.norm(left) / np.linalg.norm(late - np.mean(late))
    assert found.validation_fit[0] == pytest.approx(100 * share)


@pytest.mark.thorough
def test_difference_equation_from_its_rounded_coefficients(record):
    """From Cao 2019, eq. 29, the fit returns to eq. 7 sampled at 1 ms, and to its DC gain."""
    found = identify(record, voice_coil("printed").sampled(DT))
    exact = voice_coil().sampled(DT)
    for name in "ab":
        for i in range(3):
            assert inside(found.parameters[f"{name}[{i}]"], getattr(exact, name)[i]), (name, i)
    assert isinstance(found.plant, DifferenceEquation)
    assert np.sum(found.plant.b) / (1 - np.sum(found.plant.a)) == pytest.approx(-4.798, rel=1e-3)


@pytest.mark.thorough
def test_what_the_record_cannot_tell_apart_has_no_interval():
    """For y = C x, x' = A x + B u only A and the product C B determine the output."""
    lag = StateSpace([[-50.0]], [[50.0]], [[2.0]])
    record = excite(Machine(lag, sensor=Sensor(noise=1e-3)), U, DT)
    found = identify(record, StateSpace([[-40.0]], [[50.0]], [[1.0]]))
    assert inside(found.parameters["A[0][0]"], -50.0)
    assert width(found.parameters["A[0][0]"]) < 1.0
    for name in ("B[0][0]", "C[0][0]"):
        assert width(found.parameters[name]) == np.inf
    assert float(found.plant.B[0, 0] * found.plant.C[0, 0]) == pytest.approx(100.0, rel=0.01)


@pytest.mark.thorough
def test_a_double_pole_needs_a_pair(record):
    """Two equal `poles` have the same derivative. The pair is determined to 0.2 %."""
    twice = identify(record, ProcessModel(TRUE["gain"], [928.2], [6.404, 474.0, 474.0]))
    assert width(twice.parameters["poles[0]"]) < 0.01
    assert min(width(twice.parameters[f"poles[{i}]"]) for i in (1, 2)) > 0.02 * 474.0
    pair = identify(record, EQ_7)
    assert width(pair.parameters["frequencies[0]"]) < 2e-3 * 474.0


@pytest.mark.thorough
def test_two_outputs_are_weighted_by_their_noise():
    stage = StateSpace([[-50.0, 0.0], [200.0, -200.0]], [[50.0], [0.0]], [[1.0, 0.0], [0.0, 1.0]])
    noise = np.array([1e-3, 5e-2])
    start = StateSpace([[-30.0, 0.0], [200.0, -100.0]], [[50.0], [0.0]], [[1.0, 0.0], [0.0, 1.0]])
    record = excite(Machine(stage, sensor=Sensor(noise=noise)), U, DT)
    found = identify(record, start, free=("A[0][0]", "A[1][1]", "C[1][1]"))
    for name, true in (
        ("A[0][0]", -50.0), ("A[1][1]", -200.0), ("C[1][1]", 1.0), ("bias[0]", 0.0),
        ("bias[1]", 0.0),
    ):  # fmt: skip
        assert inside(found.parameters[name], true), name
    np.testing.assert_allclose(found.residual_std, noise, rtol=SIGMAS / np.sqrt(2 * found.samples))
    # The first output alone determines its pole as well as both together, since the second output
    # is fifty times noisier.
    first = StateSpace(start.A[:1, :1], start.B[:1], [[1.0]])
    alone = identify(record._replace(y=record.y[:, :1]), first, free="A").parameters["A[0][0]"]
    assert width(found.parameters["A[0][0]"]) == pytest.approx(width(alone), rel=0.05)


# Files
# --------------------------------------------------------------------------------------------------


def test_a_record_survives_its_file(record, tmp_path):
    write_record(tmp_path / "record.csv", record)
    read = read_record(tmp_path / "record.csv")
    np.testing.assert_array_equal(read.u, record.u)
    np.testing.assert_array_equal(read.y, record.y)
    assert read.dt == DT
    assert identify(read, EQ_7).parameters == identify(record, EQ_7).parameters


def test_several_channels_and_foreign_columns(tmp_path):
    two = Record(np.arange(6.0).reshape(3, 2), np.arange(8.0).reshape(4, 2) / 3, 0.02)
    write_record(tmp_path / "two.csv", two, time="time", input="force", output="x")
    read = read_record(
        tmp_path / "two.csv", time="time", input=("force_0", "force_1"), output=("x_1",)
    )
    np.testing.assert_array_equal(read.u, two.u)
    np.testing.assert_array_equal(read.y, two.y[:, 1:])
    with pytest.raises(ValueError, match=r"write_record: u has 2 rows and y 4, .* one experiment"):
        write_record(tmp_path / "two.csv", two._replace(u=two.u[:2], trials=2))


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("\ufeffCH1 [V]; t [s] ;note;pos [mm]\n1;0.5;start;0\n\n-1;0.52;;0.25\n1;0.54;end;0.5\n",
         {"time": "t [s]", "input": "CH1 [V]", "output": "pos [mm]"}),
        ("y [mm],t [s],u [V]\n0,0.5,1\n0.25,0.52,-1\n0.5,0.54,\n", {}),
    ],
    ids=["scope", "measured trial"],
)  # fmt: skip
def test_columns_stand_in_any_order_and_the_last_row_needs_no_input(text, names, tmp_path):
    (tmp_path / "record.txt").write_text(text)
    read = read_record(tmp_path / "record.txt", **names)
    np.testing.assert_array_equal(read.u, [[1.0], [-1.0]])
    np.testing.assert_array_equal(read.y, [[0.0], [0.25], [0.5]])
    assert read.dt == pytest.approx(0.02, rel=1e-12)


@pytest.mark.parametrize(
    ("heading", "step", "unit", "dt"),
    [
        ("t", 0.002, None, 0.002), ("t [ms]", 2, None, 0.002), ("time (ms)", 2, None, 0.002),
        ("t_ms", 2, None, 0.002), ("Time_us", 250, None, 0.00025), ("t [µs]", 250, None, 0.00025),
        ("t [s]", 2, None, 2.0), ("t", 2, "ms", 0.002), ("t", 2, "s", 2.0),
        ("t (ms)", 2, "ms", 0.002),
    ],
)  # fmt: skip
def test_the_time_is_converted_to_seconds(heading, step, unit, dt, tmp_path):
    path = tmp_path / "record.csv"
    rows = "".join(f"{5 + k * step},1,{k}\n" for k in range(4))
    path.write_text(f"{heading},u,y\n{rows}")
    assert read_record(path, time_unit=unit).dt == pytest.approx(dt, rel=1e-9)


# Errors
# --------------------------------------------------------------------------------------------------

GOOD = Record(U[:100], np.sin(np.arange(101.0)), DT)


def spoiled(signal, k=17):
    values = np.array(getattr(GOOD, signal))
    values[k] = np.nan
    return GOOD._replace(**{signal: values})


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: identify(spoiled("y")), r"y is not finite at sample 17"),
        (lambda: identify(spoiled("u")), r"u is not finite at sample 17"),
        (lambda: identify(GOOD._replace(y=GOOD.y[:-1])),
         r"u has 100 rows and y 100; allowed is one more row in y than in u"),
        (lambda: identify(GOOD._replace(y=np.zeros((101, 1, 1)))),
         r"y has shape \(101, 1, 1\); allowed are \(rows,\) and \(rows, channels\)"),
        (lambda: identify(GOOD._replace(y=1e200 * GOOD.y)),
         r"the largest \|y\| is .*e\+200; allowed is \[1e-100, 1e\+100\]"),
        (lambda: identify(GOOD._replace(u=1e-200 * U[:100])), r"the largest \|u\| is 1e-200"),
        (lambda: identify(GOOD._replace(dt=0.0)),
         r"dt = 0.0 is outside its allowed range \(0, inf\)"),
        (lambda: identify(GOOD._replace(u=U[:20], y=GOOD.y[:21])),
         r"too short: 15 samples to fit 6 parameters; allowed are at least 30"),
        (lambda: identify(GOOD._replace(y=np.ones(101))),
         r"output 0 is constant over the 71 samples to fit"),
        (lambda: identify(GOOD._replace(u=np.zeros(100))),
         r"the input is 0 over all of the 71 samples to fit"),
        (lambda: identify(GOOD._replace(u=np.full(100, 2.5))),
         r"the input is 2.5 over all .* it excites nothing. A record of a step begins before it"),
        (lambda: identify(GOOD, poles=-1), r"poles = -1 is outside its allowed range \[0, 50\]"),
        (lambda: identify(GOOD, pairs=0.5), r"pairs = 0.5 is outside its allowed range \[0, 50\]"),
        (lambda: identify(GOOD, zeros=3),
         r"zeros = 3 is outside its allowed range \[0, 3\), the order"),
        (lambda: identify(GOOD, starts=0), r"starts = 0 is outside its allowed range \[1, inf\)"),
        (lambda: identify(GOOD, fit_share=1.5),
         r"fit_share = 1.5 is outside its allowed range \(0, 1\]"),
        (lambda: identify(GOOD, free=("gain",)),
         r"free = \['gain'\] names leaves of a plant, but no plant is given"),
        (lambda: identify(GOOD, EQ_7, free=("gian",)),
         r"free = 'gian' is not a leaf of ProcessModel; did you mean gain. Known: gain, zeros"),
        (lambda: identify(GOOD, VoiceCoil(), free=("poles[3]",)),
         r"free = 'poles\[3\]': poles has shape \(3,\)"),
        (lambda: identify(GOOD, EQ_7, free=()), r"free = \(\) leaves nothing to fit"),
        (lambda: identify(GOOD._replace(y=np.ones((101, 2))), EQ_7),
         r"the record has 1 inputs and 2 outputs but the plant ProcessModel has 1 and 1"),
        (lambda: identify(GOOD, StateSpace([[1e5]], [[1.0]], [[1.0]]), free="B"),
         r"the output of the given StateSpace does not stay finite"),
    ],
)  # fmt: skip
def test_what_cannot_be_identified_is_named(call, message):
    with pytest.raises(ValueError, match="identify: .*" + message):
        call()


def test_single_precision_is_refused():
    with (
        jax.enable_x64(False),
        pytest.raises(ValueError, match=r"identify: precision = 'float32' is not one of 'float64'"),
    ):
        identify(GOOD)


@pytest.mark.thorough
def test_an_excitation_that_does_not_fit_is_named():
    with pytest.raises(ValueError, match=r"excite: u is not finite at sample 1"):
        excite(MOTOR, [1.0, np.nan], DT)
    with pytest.raises(ValueError, match=r"the task has 2 inputs but the plant VoiceCoil has 1"):
        excite(MOTOR, np.ones((5, 2)), DT)
    with pytest.raises(ValueError, match=r"DifferenceEquation is sampled at 0\.001 s"):
        excite(Machine(voice_coil("printed").sampled(DT)), U[:5], 2e-3)


# Figures
# --------------------------------------------------------------------------------------------------


@pytest.mark.thorough
def test_figures_show_the_record_and_the_residual(record, tmp_path):
    identified = identify(record, EQ_7)
    top, bottom = figures.record_figure(record, input_unit="V", output_unit="mm")
    np.testing.assert_array_equal(top.lines[0].get_ydata(), U)
    np.testing.assert_allclose(bottom.lines[0].get_xdata()[-1], len(U) * DT)
    assert bottom.get_ylabel() == "output [mm]"
    top, bottom = figures.validation_figure(
        record, identified, output_unit="mm", scale=1e3, unit="µm"
    )
    np.testing.assert_allclose(
        bottom.lines[0].get_ydata(), 1e3 * (np.asarray(record.y) - identified.simulated)[:, 0]
    )
    assert bottom.get_ylabel() == "residual [µm]"
    assert bottom.patches[0].get_x() == pytest.approx(identified.samples * DT)
    assert "validation 99." in top.get_legend().get_texts()[1].get_text()
    assert figures.save(top, tmp_path / "validation.png").stat().st_size > 10_000


def test_the_band_of_the_response_is_that_of_the_parameters():
    """With the gain alone fitted, log |P| has the relative standard deviation of the gain.

    The phase then has none. The curve itself is that of the sampled plant by python-control.
    """
    found = identify(GOOD, EQ_7, free="gain")
    top, bottom = figures.response_figure(found, DT)
    f, size = top.lines[0].get_xydata().T
    gain = found.parameters["gain"].value
    std = np.sqrt(found.covariance[0, 0])
    vertices = top.collections[0].get_paths()[0].vertices
    above = vertices[np.isclose(vertices[:, 0], f[200])][:, 1].max()
    assert np.log(above / size[200]) == pytest.approx(1.96 * std / abs(gain), rel=1e-6)
    phases = bottom.collections[0].get_paths()[0].vertices
    at = phases[np.isclose(phases[:, 0], f[200])][:, 1]
    assert np.ptp(at) == pytest.approx(0.0, abs=1e-9)
    sampled = found.plant.sampled(DT)
    A, B, C = (np.asarray(getattr(sampled, n)) for n in "ABC")
    z = np.exp(2j * np.pi * f[200] * DT)
    assert size[200] == pytest.approx(abs((C @ np.linalg.solve(z * np.eye(len(A)) - A, B)).item()))


@pytest.mark.thorough
def test_the_pole_of_an_exact_fit_has_no_spread():
    """Its interval was not a number, with a warning of NumPy."""
    lag = ProcessModel(gain=2.0, zeros=(), poles=(60.0,))
    (pole,) = poles_of(lag, ("gain", "poles[0]"), np.array([2.0, 60.0, 0.0]), np.zeros((3, 3)))
    assert pole.real == (-60.0, -60.0, -60.0)
