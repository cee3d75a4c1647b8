"""Plants and scenarios from TOML and JSON files are compared with python-control and scipy.

What is refused is named by its key.
"""

import json
import subprocess
import sys
from types import SimpleNamespace

import control
import numpy as np
import pytest
import scipy.signal
from cases import ALGEBRA, DT
from typer.testing import CliRunner

from jaxilc import plants, scenarios
from jaxilc.cli import app
from jaxilc.identification import excite, write_record
from jaxilc.learning import Machine, learn
from jaxilc.scenarios import file_plant, load_scenario
from jaxilc.scenarios.file_task import task_of
from jaxilc.scenarios.from_file import read_scenario
from jaxilc.scenarios.specification import classes
from jaxilc.schemes import (
    PID,
    Filtered,
    Ladder,
    MultivariableILC,
    NormOptimal,
    OnOutputs,
    PIDType,
    StopWhen,
    WithFeedback,
)
from jaxilc.signals import references
from jaxilc.uncertainty import LogUniform, Normal, Uniform, draw

NUM, DEN = [4000.0], [1.0, 80.0, 4000.0]
PLANT = {"kind": "transfer_function", "num": NUM, "den": DEN}
TASK = {
    "dt": DT,
    "reference": {"function": "sinusoid", "amplitude": 1.0, "frequency": 10.0, "duration": 0.1},
}
SCHEMES = {"ilc": {"class": "PIDType", "gamma_p": 0.5}}
U = np.sin(0.7 * np.arange(60)) + 0.3


def write(folder, **tables):
    """Write a JSON file, without the tables that are None."""
    path = folder / "axis.json"
    values = {"plant": PLANT, "task": TASK, "schemes": SCHEMES} | tables
    kept = {name: table for name, table in values.items() if table is not None}
    path.write_text(json.dumps(kept))
    return path


def response(plant, inputs=1):
    """Return the response (N+1, n_y) of the plant to U in every channel."""
    return np.asarray(excite(Machine(plant), np.stack([U] * inputs, axis=1), DT).y)


def expected(system, inputs=1):
    """Return the same response from python-control."""
    if system.dt == 0:
        system = control.sample_system(control.ss(system), DT, "zoh")
    t = np.arange(len(U) + 1) * DT
    return np.atleast_2d(
        control.forced_response(system, t, np.stack([np.append(U, 0.0)] * inputs)).outputs
    ).T


def plant_of(folder, **plant):
    return read_scenario(write(folder, plant=plant, schemes=None)).machine.plant


def test_transfer_functions_respond_as_python_control_s(tmp_path):
    plant = plant_of(tmp_path, **PLANT)
    np.testing.assert_allclose(response(plant), expected(control.tf(NUM, DEN)), **ALGEBRA)
    plant = plant_of(
        tmp_path, kind="transfer_function", num=[0.06, 0.03], den=[1.0, -1.6, 0.65], dt=DT
    )
    np.testing.assert_allclose(
        response(plant), expected(control.tf([0.06, 0.03], [1.0, -1.6, 0.65], DT)), **ALGEBRA
    )


def test_a_command_starts_without_packages_that_it_does_not_need(tmp_path):
    file = write(tmp_path)
    slow = ("control", "matplotlib", "scipy.signal", "scipy.stats", "xarray", "zarr")
    program = (
        "import sys\n"
        "from jaxilc.scenarios import load_scenario\n"
        "from jaxilc.outcomes import running, sweeping\n"
        "from jaxilc.filters.switching import instantaneous_frequency\n"
        "from jaxilc.hardware import campaign\n"
        f"for name in ('cao-2019', {str(file)!r}): load_scenario(name)\n"
        "instantaneous_frequency([0.0, 1.0, 0.5, 0.0, 0.5], 0.1)\n"
        f"print([name for name in {slow} if name in sys.modules])"
    )
    found = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert found.stdout == "[]\n", found.stderr


def test_several_channels_are_lists_of_lists(tmp_path):
    num = [[[1.0], [5.0]], [[0.0], [2.0, 1.0]]]
    den = [[[1.0, 9.0], [1.0, 30.0]], [[1.0], [1.0, 8.0, 20.0]]]
    two = {"kind": "transfer_function", "num": num, "den": den}
    several = TASK | {"reference": [TASK["reference"], TASK["reference"] | {"amplitude": 2.0}]}
    made = read_scenario(write(tmp_path, plant=two, task=several, schemes=None))
    parts = [[control.tf(num[i][j], den[i][j]) for j in range(2)] for i in range(2)]
    rows = [sum(expected(parts[i][j])[:, 0] for j in range(2)) for i in range(2)]
    np.testing.assert_allclose(
        response(made.machine.plant, 2), np.stack(rows, axis=1), rtol=1e-9, atol=1e-12
    )
    np.testing.assert_allclose(made.task.reference[:, 1], 2 * made.task.reference[:, 0])


def test_zeros_poles_and_gain_keep_the_digits_of_poles_that_lie_close_together(tmp_path):
    plant = plant_of(
        tmp_path, kind="zeros_poles_gain", zeros=[-900.0],
        poles=[-474.0, -474.0, [-60.0, 80.0], [-60.0, -80.0]], gain=2e6,
    )  # fmt: skip
    b, a = scipy.signal.zpk2tf([-900.0], [-474.0, -474.0, -60 + 80j, -60 - 80j], 2e6)
    np.testing.assert_allclose(response(plant), expected(control.tf(b, a)), rtol=1e-9, atol=1e-12)
    poles, zeros = [0.999, 0.9991, 0.9992, 0.9993, 0.9994, 0.9995], [-0.5, 0.3]
    plant = plant_of(tmp_path, kind="zeros_poles_gain", zeros=zeros, poles=poles, gain=1e-9, dt=DT)
    below = np.prod(1 - np.array(poles))
    assert abs(np.polyval(np.poly(poles), 1.0) / below - 1) > 0.1, (
        "one polynomial loses all digits of the gain at rest"
    )
    at_rest = plant.C @ np.linalg.solve(np.eye(6) - plant.A, plant.B)
    np.testing.assert_allclose(at_rest, [[1e-9 * np.prod(1 - np.array(zeros)) / below]], rtol=1e-6)


def test_zeros_and_poles_of_any_kinds_are_the_plant_that_they_say(tmp_path):
    rng, tried, s = np.random.default_rng(5), 0, 1j * np.array([0.0, 1.0, 30.0, 200.0, 900.0])

    def roots(real, pairs):
        size, angle = rng.uniform(20, 400, pairs), rng.uniform(0.02, 0.9, pairs)
        upper = size * (1j * np.sqrt(1 - angle**2) - angle)
        return rng.permutation([*-rng.uniform(5, 300, real), *upper, *upper.conj()]).astype(complex)

    while tried < 200:
        poles, zeros = roots(*rng.integers(0, (4, 3))), roots(*rng.integers(0, (3, 3)))
        if len(zeros) >= len(poles):
            continue
        tried += 1
        table = {
            name: [[z.real, z.imag] if z.imag else z.real for z in of]
            for name, of in (("zeros", zeros), ("poles", poles))
        }
        table |= {"kind": "zeros_poles_gain", "gain": 2.0}
        plant = file_plant.plant_of(table, "plant", tmp_path, [])
        A, B, C = (np.asarray(M) for M in (plant.A, plant.B, plant.C))
        found = [(C @ np.linalg.solve(z * np.eye(len(A)) - A, B))[0, 0] for z in s]
        factors = [np.prod(s[:, None] - of, axis=1) for of in (zeros, poles)]
        np.testing.assert_allclose(found, 2.0 * factors[0] / factors[1], rtol=1e-8)
        assert len(A) == len(poles)


def test_state_space_and_any_class_by_its_name(tmp_path):
    A, B, C = [[0.9, 0.1], [-0.2, 0.8]], [[0.01], [0.1]], [[1.0, 0.5]]
    plant = plant_of(tmp_path, kind="state_space", A=A, B=B, C=C, dt=DT)
    np.testing.assert_allclose(response(plant), expected(control.ss(A, B, C, 0, DT)), **ALGEBRA)
    plant = plant_of(tmp_path, kind="ProcessModel", gain=2.0, poles=[60.0])
    np.testing.assert_allclose(
        response(plant), expected(control.tf([120.0], [1.0, 60.0])), **ALGEBRA
    )
    friction = {"class": "StribeckFriction", "coulomb_force": 20.0, "static_force": 30.0}
    friction["transition_velocity"] = 2e-3
    plant = plant_of(tmp_path, kind="VoiceCoilMotor", friction=friction)
    assert isinstance(plant.friction, plants.StribeckFriction)
    assert plant.friction.static_force == 30.0


@pytest.mark.thorough
def test_a_plant_is_identified_from_a_record_beside_the_file(tmp_path):
    lag, moves = plants.ProcessModel(2.0, (), (60.0,)), references.m_sequence(6, hold=2)
    write_record(tmp_path / "record.csv", excite(Machine(lag), np.pad(moves, (0, 9)), DT))

    def of(record, **structure):
        structure = {"poles": 1, "pairs": 0, "zeros": 0} | structure
        plant = {"kind": "identified", "record": record, **structure}
        made = read_scenario(write(tmp_path, plant=plant))
        return made.machine.plant, made.chosen[0]

    plant, said = of("record.csv")
    np.testing.assert_allclose([plant.gain, plant.poles[0]], [2.0, 60.0], rtol=1e-6)
    assert "identified from record.csv: gain = 2" in said
    assert "begin at rest" not in said
    moved = excite(Machine(lag), np.pad(moves, (9, 0)), DT)
    write_record(tmp_path / "far.csv", moved._replace(u=moved.u + 100, y=moved.y + 200))
    plant, said = of("far.csv")
    np.testing.assert_allclose([plant.gain, plant.poles[0]], [2.0, 60.0], rtol=1e-6)
    assert "does not begin at rest" in said
    rng = np.random.default_rng(0)
    noisy = moved.y + 200 + 0.01 * rng.standard_normal(moved.y.shape)
    write_record(tmp_path / "noisy.csv", moved._replace(y=noisy))
    assert "not significant" in of("noisy.csv", poles=2)[1]  # of a plant that has one


@pytest.mark.parametrize(
    ("heading", "said"),
    [
        ("t [s],u [V],y [um]", "y is in 'um'; this task needs 'mm'"),
        ("t [s],u [mV],y [mm]", "u is in 'mV'; this task needs 'V'"),
    ],
)
def test_a_record_has_the_units_of_the_task(tmp_path, monkeypatch, heading, said):
    """A gain of 699.99 was fitted for 0.69999, without a word."""

    def fit(record, **structure):
        lag = plants.ProcessModel(gain=record.y[1, 0] / record.u[0, 0], zeros=(), poles=(60.0,))
        return SimpleNamespace(parameters={}, plant=lag, fit=[99.0])

    monkeypatch.setattr(file_plant.identification, "identify", fit)
    monkeypatch.setattr(file_plant, "verdict", lambda found, dt: ["fits"])
    rows = np.array([[0.0, 1.0, 0.0], [DT, 1.0, 2.0], [2 * DT, 1.0, 3.0]])
    plant = {"kind": "identified", "record": "record.csv", "poles": 1, "pairs": 0, "zeros": 0}
    record, task = tmp_path / "record.csv", TASK | {"unit": "mm", "input_unit": "V"}
    for _ in range(2):  # also of the fit that is kept
        np.savetxt(record, rows, delimiter=",", header=heading, comments="", fmt="%.12g")
        with pytest.raises(ValueError, match=said):
            read_scenario(write(tmp_path, plant=plant, task=task))
    for header in ("t,u,y", "t [s],u [V],y [mm]"):
        np.savetxt(record, rows, delimiter=",", header=header, comments="", fmt="%.12g")
        made = read_scenario(write(tmp_path, plant=plant, task=task))
        assert float(made.machine.plant.gain) == 2.0


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ({"record": "gone.csv"}, "plant: .*gone.csv: no such file or directory"),
        ({"time_unit": "msec"}, "plant: time_unit = 'msec' is not one of s, ms, us, ns"),
        ({}, "plant: .*, line 4: t steps by 0.002 .* deviation of 1%, or `dt = 0.001`"),
        ({"time": "Zeit"}, "plant: .*uneven.csv has no column 'Zeit'; .*; `time` names another"),
        ({"record": "um--x.csv"}, "plant: .*um--x.csv: no such file or directory"),
        ({"columns": ["t", "u", "r"]}, r"plant: .* names of columns \(`columns`\) for a file"),
        ({"time_unit": "us"}, r"plant: .* 't \[s\]' has another unit than `time_unit` us"),
        ({"csv": "gone.csv"}, "task.reference: .*gone.csv: no such file or directory"),
        ({"csv": "uneven.csv"}, "task.reference: .* where the sample .* a deviation of 1%$"),
        ({"num": [1], "den": [1, -3]}, r"plant: .* loop first or write allow_unstable = true$"),
    ],
)
def test_a_message_on_a_record_names_the_file_and_the_keys(tmp_path, keys, said):
    """It named neither, but options of another command."""
    (tmp_path / "uneven.csv").write_text("t [s],u,r\n0,1,2\n0.001,1,2\n0.003,1,2\n0.004,1,2\n")
    plant, task = {"kind": "identified", "record": "uneven.csv", "output": "r"} | keys, TASK
    if "num" in keys:
        plant = PLANT | keys
    elif "csv" in keys:
        plant, task = PLANT, TASK | {"reference": keys}
    with pytest.raises(ValueError, match=f"axis.json: {said}") as refused:
        read_scenario(write(tmp_path, plant=plant, task=task))
    assert "--" not in str(refused.value).replace("um--x", "")


EVERYTHING = """
name = "x-axis"
trials = 7
tolerance = 2.0
shown_unit = "µm"
shown_scale = 1e3
show_trials = [1, 7]
[plant]
kind = "state_space"
A = [[0.9, 0.1], [-0.2, 0.8]]
B = [[0.01], [0.1]]
C = [[1.0, 0.5]]
dt = 0.001
[machine]
actuator = { limit = 10.0, rate = 5e3, resolution = 1e-3 }
sensor = { resolution = 1e-4, noise = 2e-4 }
disturbance = { input_noise = 1e-3 }
[task]
dt = 0.001
settle = [0.02, 0.04]
unit = "mm"
input_unit = "V"
reference = { csv = "path.csv", column = "x" }
[schemes.nested]
class = "StopWhen"
rms = 1e-3
[schemes.nested.scheme]
class = "Ladder"
repeats = 2
[schemes.nested.scheme.scheme]
class = "WithFeedback"
feedback = { class = "PID", kp = 1.0, form = "increment" }
[schemes.nested.scheme.scheme.learning]
class = "Filtered"
scheme = { class = "PIDType", gamma_p = 0.5, lead = 2 }
filter = { class = "ZeroPhaseFIR", taps = [0.6, 0.2] }
[schemes.optimal]
class = "NormOptimal"
model = "plant"
w_r = 0.1
[schemes.seen]
class = "OnOutputs"
scheme = { class = "PIDType" }
outputs = [0]
[uncertainty]
"plant.B" = { distribution = "uniform", low = 0.9, high = 1.1, relative = true }
"machine.plant.A[0]" = { distribution = "normal", mean = 1.0, std = 0.01, relative = true }
actuator.limit = { distribution = "log_uniform", low = 8.0, high = 12.0 }
"""


def test_a_toml_file_is_a_whole_scenario(tmp_path):
    path, k = tmp_path / "axis.toml", np.arange(51)
    path.write_text(EVERYTHING, encoding="utf-8")
    r = 0.5 - 0.5 * np.cos(2 * np.pi * k / 50)
    np.savetxt(
        tmp_path / "path.csv", np.stack([k * DT, r], axis=1), delimiter=",", header="t,x",
        comments="", fmt="%.17g",
    )  # fmt: skip
    made = load_scenario(
        path, {"machine.actuator.limit": "9", "nested.scheme.scheme.feedback.kp": 0.5}
    )
    assert (made.name, made.trials, made.tolerance, made.shown_unit, made.show_trials) == (
        "x-axis", 7, 2.0, "µm", (1, 7),
    )  # fmt: skip
    assert (made.task.N, made.task.dt, made.task.settle, made.task.unit, made.task.input_unit) == (
        50, DT, (0.02, 0.04), "mm", "V",
    )  # fmt: skip
    np.testing.assert_array_equal(made.task.reference[:, 0], r)
    actuator, sensor = made.machine.actuator, made.machine.sensor
    assert (actuator.limit, actuator.rate, sensor.noise) == (9.0, 5e3, 2e-4)
    stop = made.schemes["nested"]
    pair = stop.scheme.scheme
    assert [type(s) for s in (stop, stop.scheme, pair, pair.learning)] == [
        StopWhen, Ladder, WithFeedback, Filtered,
    ]  # fmt: skip
    assert (pair.feedback.kp, pair.feedback.form) == (0.5, "increment")
    assert isinstance(made.schemes["seen"], OnOutputs)
    np.testing.assert_array_equal(made.schemes["optimal"].model.A, [[0.9, 0.1], [-0.2, 0.8]])
    assert made.uncertainty == {
        "plant.B": Uniform(0.9, 1.1, relative=True),
        "plant.A[0]": Normal(1.0, 0.01, relative=True),
        "actuator.limit": LogUniform(8.0, 12.0),
    }
    assert draw(made.machine, made.uncertainty, 5)["actuator.limit"].shape == (5,)
    path.write_text(EVERYTHING.replace('column = "x"', 'column = "r"'), encoding="utf-8")
    said = "axis.toml: task.reference: .*path.csv has no column 'r'; present are t, x; `column` nam"
    with pytest.raises(ValueError, match=said):
        read_scenario(path)


@pytest.mark.parametrize(
    ("unit", "heading", "fits"), [("um", "µm", True), ("mm", "µm", False), ("", "µm", True)]
)
def test_a_reference_in_another_unit_is_refused(tmp_path, unit, heading, fits):
    (tmp_path / "r.csv").write_text(f"t [ms],r [{heading}]\n0,0\n1,5\n2,0\n", encoding="utf-8")
    values = {"dt": 1e-3, "unit": unit, "reference": {"csv": "r.csv"}}
    plant = plants.StateSpace([[0.5]], [[1.0]], [[1.0]], dt=1e-3)
    if fits:
        assert list(task_of(values, "task", tmp_path, plant, []).reference[:, 0]) == [0, 5, 0]
    else:
        with pytest.raises(ValueError, match="r is in 'µm'; this task needs 'mm'"):
            task_of(values, "task", tmp_path, plant, [])


def test_what_a_file_describes_learns_as_what_the_library_makes(tmp_path):
    table = {
        "class": "WithFeedback",
        "learning": {"class": "PIDType", "gamma_p": 0.4},
        "feedback": {"class": "PID", "kp": 1.0},
    }
    made = load_scenario(write(tmp_path, schemes={"ilc": table}))
    ours = learn(made.machine, made.schemes["ilc"], made.task, 3).rms
    scheme = WithFeedback(PIDType(gamma_p=0.4), PID(kp=1.0))
    task = type(made.task)(references.sinusoid(1.0, 10.0, duration=0.1, dt=DT), dt=DT)
    machine = Machine(plants.from_control(control.tf(NUM, DEN)))
    np.testing.assert_array_equal(ours, learn(machine, scheme, task, 3).rms)


def test_a_drive_of_two_outputs_takes_its_models_from_the_file(tmp_path):
    A, B, C = [[0.9, 0.1], [0.3, 0.6]], [[0.2], [0.0]], [[1.0, 0.0], [0.0, 1.0]]
    model = {"function": "multivariable_model", "C_P": 0.5, "P": "plant"}
    learning = {"class": "NormOptimal", "model": model, "w_r": 0.1}
    feedback = {"class": "PID", "kp": 0.5}
    milc = {"class": "MultivariableILC", "learning": learning, "feedback": feedback}
    task = TASK | {"reference": [TASK["reference"]] * 2}
    plant = {"kind": "state_space", "A": A, "B": B, "C": C, "dt": DT}
    made = read_scenario(write(tmp_path, plant=plant, task=task, schemes={"milc": milc}))
    scheme = made.schemes["milc"]
    assert isinstance(scheme, MultivariableILC)
    assert isinstance(scheme.learning, NormOptimal)
    by_hand = plants.multivariable_model(0.5, plants.StateSpace(A, B, C, dt=DT))
    np.testing.assert_array_equal(scheme.learning.model.A, by_hand.A)
    assert made.task.inputs == 1


def test_scenarios_by_name_take_options_and_paths_together():
    made = load_scenario(
        "cao-2019",
        {"plant": "exact", "pid.kp": "-9", "machine.plant.gain": "7000", "plant.poles[1]": "450"},
    )
    assert made.schemes["pid"].kp == -9.0
    assert (made.machine.plant.gain, made.machine.plant.poles[1]) == (7000.0, 450.0)
    assert made.options["plant"] == "exact"
    said = f"one of {', '.join(scenarios.SCENARIOS)}; a file .toml or .json may stand in"
    with pytest.raises(ValueError, match=f"scenario = 'axis' is not {said}"):
        load_scenario("axis")
    with pytest.raises(FileNotFoundError):
        load_scenario("nowhere.toml")
    with pytest.raises(ValueError, match=r"'axis.toml' is a file; jaxilc.load_scenario takes one"):
        scenarios.load("axis.toml")


def test_every_class_that_is_named_in_a_refusal_can_be_named_in_a_file():
    assert {
        "PIDType", "Filtered", "ZeroPhaseFIR", "SwitchableFilter", "StateSpace", "VoiceCoil",
        "StribeckFriction",
    } <= classes().keys()  # fmt: skip
    assert not {"Filter", "Scheme", "Plant", "Interval"} & classes().keys()


def plant(**fields):
    return {"plant": PLANT | fields}


def roots(**fields):
    return {"plant": {"kind": "zeros_poles_gain", "gain": 1.0} | fields}


def task(**fields):
    return {"task": TASK | fields}


def reference(**fields):
    return task(reference=TASK["reference"] | fields)


def scheme(name, **fields):
    return {"schemes": {"a": {"class": name, **fields}}}


def uncertain(leaf="plant.B", **fields):
    return {"uncertainty": {leaf: {"distribution": "uniform", "low": 0.9, "high": 1.1} | fields}}


ROW, COLUMN = [[1.0, 0.0]], [[1.0]]
FIR = {"class": "ZeroPhaseFIR"}
OTHER_MODEL = {"function": "direct_model", "C_P": 1.0, "P": "nominal"}
REFUSED = {
    # keys
    "plants is not a key here; did you mean plant. 15 names are known": {"plants": PLANT},
    "plant is missing; present are task, schemes": {"plant": None},
    "plnt is not a key here; did you mean plant. It is missing": {"plant": None, "plnt": PLANT},
    "task.refrence is not a key here; did you mean reference. It is missing": {
        "task": {"dt": DT, "refrence": TASK["reference"]}
    },
    "schemes.a.clas is not a key here; did you mean class. It is missing": {
        "schemes": {"a": {"clas": "PID"}}
    },
    "schemes.a.model is missing; present are class, w_r, w_q; allowed are model, w_q, w_r": scheme(
        "NormOptimal", w_r=1.0, w_q=2.0
    ),
    "uncertainty.plant.B.distributoin is not a key here; did you mean distribution. It is": {
        "uncertainty": {"plant.B": {"distributoin": "uniform", "low": 0.9, "high": 1.1}}
    },
    # [plant]
    "plant = 3 is not a table": {"plant": 3},
    "plant.kind = 'tf' is not one of transfer_function, zeros_poles_gain, state_space": plant(
        kind="tf"
    ),
    "plant.gain is not a key here; allowed are allow_unstable, den, dt, kind, num": plant(gain=1.0),
    "plant.num = '4' is not a number or a list of numbers": plant(num="4"),
    r"plant.num\[0\]\[0\] = 1 is not a list of numbers": plant(num=[[1, 2]]),
    "plant: direct feedthrough": plant(num=[1.0, 2.0, 3.0]),
    "plant: direct feedthrough D": plant(num=[[[1, 2]]], den=[1.0, 2.0]),
    "plant: the system is unstable": plant(den=[1.0, -3.0, 10.0]),
    r"plant.dt = -1 is outside its allowed range \[0, inf\)": plant(dt=-1.0),
    "plant: den has 1002 coefficients, of order 1001; allowed is an order of at most 1000": plant(
        den=[1.0] * 1002
    ),
    r"plant.poles has \[-1, 2\] without its conjugate; allowed are": roots(poles=[[-1.0, 2.0]]),
    r"plant.zeros has \[-1, 2\] without its conj": roots(
        zeros=[[-1.0, 2.0], [-1.0, -3.0]], poles=[-1.0, -2.0, -3.0]
    ),
    "plant.poles has 1001 numbers; allowed are at most 1000": roots(poles=[-1.0] * 1001),
    "1 zeros over 1 poles; allowed are": roots(zeros=[-1.0], poles=[-2.0]),
    r"plant.zeros\[0\] = nan is outside its allowed range \(-inf, inf\)": roots(
        zeros=[float("nan")], poles=[-1, -2]
    ),
    r"plant.dt = nan is outside its allowed range \[0, inf\), 0 for": plant(dt=float("nan")),
    r"C \(1, 2\) do not fit; allowed are": {
        "plant": {"kind": "state_space", "A": COLUMN, "B": ROW, "C": ROW}
    },
    r"plant: ProcessModel: poles = \[-1.\] is outside": {
        "plant": {"kind": "ProcessModel", "poles": [-1.0]}
    },
    "plant.mass is not a key here; allowed are dampings": {
        "plant": {"kind": "ProcessModel", "mass": 1.0}
    },
    "plant.plant = 'axis' is no table; allowed is a table with class = BallScrewDrive": {
        "plant": {"kind": "InBlocks", "plant": "axis"}
    },
    "plant.record is missing": {"plant": {"kind": "identified"}},
    # [machine]
    "machine.limit is not a key here; allowed are actuator, disturbance, sensor": {
        "machine": {"limit": 1.0}
    },
    r"machine.actuator: Actuator: limit = -1 is outside its allowed range \(0, inf\)": {
        "machine": {"actuator": {"limit": -1.0}}
    },
    "machine.actuator = 'limit' is not a table of keys and values, such as limit, rate": {
        "machine": {"actuator": "limit"}
    },
    "machine: ": {"machine": {"sensor": {"noise": [1.0, 2.0]}}},
    # [task]
    r"task.dt = 0 is outside its allowed range \(0, inf\)": task(dt=0),
    "task.dt = '1 ms' is not a number.*: .*times in s": task(dt="1 ms"),
    "task": task(dt=1e300),
    r"task.settle = \[1.0\] is not a pair": task(settle=[1.0]),
    "machine: the task has 2 inputs but the plant StateSpace has 1": task(inputs=2),
    "task.reference is missing; present are dt": {"task": {"dt": DT}},
    "task.reference = 'sinusoid' is not a table .*, such as { function = ": task(
        reference="sinusoid"
    ),
    "task.reference.function = 'square' is not one of sinusoid, multisine": reference(
        function="square"
    ),
    "task.reference.frequency is missing": task(
        reference={"function": "sinusoid", "amplitude": 1.0}
    ),
    "task.reference.freq is not a key here; did you mean frequency. Allowed are amplitude": (
        reference(freq=1.0)
    ),
    "task.reference: sinusoid: frequency = 900 Hz is": reference(frequency=900.0),
    "task.reference.amplitude = '1 mm' is not a number .*without a unit: lengths in the `unit`": (
        reference(amplitude="1 mm")
    ),
    # [schemes]
    "schemes.a.class = 'PIT' is unknown; did you mean PID. ": scheme("PIT"),
    "schemes.a is a StateSpace; allowed is": scheme("StateSpace", A=COLUMN, B=COLUMN, C=COLUMN),
    "schemes.a is a FlexibleMode; allowed is a table with class = ASMC": scheme("FlexibleMode"),
    "schemes.a.filter.class = 'Notch' is not one of StableInverse, SwitchableFilter": scheme(
        "Filtered", scheme={"class": "PIDType"}, filter={"class": "Notch"}
    ),
    "schemes.a.kq is not a key here; allowed are class, form, ka, kd, ki, kp, kv, limit, tau": (
        scheme("PID", kq=1.0)
    ),
    "schemes.a.kp = '1' is not a number or a list of numbers": scheme("PID", kp="1"),
    "schemes.a: PID: form = 'speed' is not one of 'position', 'increment'": scheme(
        "PID", form="speed"
    ),
    "schemes.a: ": scheme("PID", kp=[1.0, 2.0]),
    r"schemes.a: PIDType: leak = nan is outside its allowed range \[0, 1\)": scheme(
        "PIDType", gamma_p=1.0, leak=float("nan")
    ),
    "schemes.a.filter is missing; present are class": scheme(
        "Filtered", scheme={"class": "PIDType"}
    ),
    "schemes.a.scheme is a ZeroPhaseFIR; allowed is a table with class = .*PIDType": scheme(
        "Filtered", scheme=FIR, filter=FIR
    ),
    "schemes.a.scheme = 'pidtype' is no table; did you mean { class = \"PIDType\", ... }": scheme(
        "Filtered", scheme="pidtype", filter=3
    ),
    "schemes.a.model = 'nominal' is no table; allowed is \"plant\", which stands for": scheme(
        "NormOptimal", model="nominal"
    ),
    "schemes.a.model = 'Plant' is no table; did you mean \"plant\"": scheme(
        "NormOptimal", model="Plant"
    ),
    "schemes.a.model.P = 'nominal' is no table; allowed is \"plant\"": scheme(
        "NormOptimal", model=OTHER_MODEL
    ),
    # [uncertainty], [grid], and what stands before all tables
    "uncertainty: 'plant.C_d'": uncertain("plant.C_d"),
    "uncertainty: plant.dt = 0.0 is not a float leaf of this machine": uncertain("plant.dt"),
    "uncertainty.plant.B.distribution = 'beta' is not one of uniform, normal": uncertain(
        distribution="beta"
    ),
    "uncertainty.plant.B.high is missing": {
        "uncertainty": {"plant.B": {"distribution": "uniform", "low": 1.0}}
    },
    "uncertainty.plant.B: Uniform: low = 3": uncertain(low=3.0),
    "uncertainty.machine.plant.B gives plant.B a second time; allowed is once": {
        "uncertainty": uncertain()["uncertainty"] | {"machine": uncertain()["uncertainty"]}
    },
    "grid.ilc.gamma_p gives ilc.gamma_p a second time; allowed is once": {
        "grid": {"ilc.gamma_p": "1:2:3", "ilc": {"gamma_p": "4:5:3"}}
    },
    "grid: 'ilc.gama_p' cannot be an axis; did": {"grid": {"ilc.gama_p": "1:2:3"}},
    "grid: ilc.gamma_p = '1:2' is not LOW:HIGH:COUNT": {"grid": {"ilc": {"gamma_p": "1:2"}}},
    "grid: PIDType: lead = 2.5 is outside its allowed": {"grid": {"ilc.lead": "0:5:3"}},
    "scheme = 'task' is the name of the task's own": {"schemes": {"task": SCHEMES["ilc"]}},
    r"trials = 0 is outside its allowed range \[1, inf\)": {"trials": 0},
    "trials = 2.5 is not a whole number": {"trials": 2.5},
}  # fmt: skip


@pytest.mark.parametrize("message", REFUSED)
def test_a_mistake_is_named_by_its_key(tmp_path, message):
    with pytest.raises(ValueError, match=f"axis.json: .*{message}"):
        read_scenario(write(tmp_path, **REFUSED[message]))


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("axis.toml", "plant = = 1", ""),
        ("axis.json", "plant = = 1", ""),
        ("twice.json", '{"a": {"b": 5, "c": 1, "b": 3}}', "the key 'b' is given a second time"),
        ("list.json", "[1]", r"\[1\] is not a table of keys and values"),
    ],
)
def test_a_file_that_is_no_toml_or_json_or_no_table_is_named(tmp_path, name, text, said):
    (tmp_path / name).write_text(text)
    with pytest.raises(ValueError, match=f"{name}: {said}"):
        read_scenario(tmp_path / name)


def test_every_command_accepts_a_file_in_a_scenario_s_place(tmp_path, monkeypatch, unpainted):
    """Each command runs once; its numbers are those of the library."""
    monkeypatch.chdir(tmp_path)
    file = str(write(tmp_path, **uncertain("plant.A", low=0.99, high=1.01, relative=True)))
    runner = CliRunner()
    for command in (
        ("list", file),
        ("run", file, "--trials", "3", "--report", "run.json"),
        ("sweep", file, "--samples", "3"),
    ):
        result = runner.invoke(app, command)
        assert result.exit_code == 0, result.output
    loaded = load_scenario(file)
    history = learn(loaded.machine, loaded.schemes["ilc"], loaded.task, 3)
    shown = json.loads((tmp_path / "run.json").read_text())["schemes"]["ilc"]["rms"]["3"]
    np.testing.assert_allclose(shown, loaded.shown_scale * float(history.rms[-1, 0]), rtol=1e-9)
    assert (tmp_path / "out" / f"sweep-{loaded.name}" / "error-band.png").exists()


def test_a_grid_of_a_file_is_that_of_its_schemes(tmp_path):
    grid = {"ilc": {"gamma_p": "0.1:10:3log"}, "ilc.lead": [0, 1], "plant.B[0][0]": [1.0, 2.0]}
    two = SCHEMES | {"other": SCHEMES["ilc"]}
    read = read_scenario(write(tmp_path, grid=grid, schemes=two))
    assert read.grid == {"ilc.gamma_p": "0.1:10:3log"} | {n: grid[n] for n in [*grid][1:]}
    assert [*read.select(("other",)).grid] == ["plant.B[0][0]"]
