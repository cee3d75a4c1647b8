"""The plant file that identification writes is read back, and its law is compared with NumPy."""

import re
import tomllib

import numpy as np
import pytest

from jaxilc.identification import Estimate, Identified, Record
from jaxilc.learning import learn
from jaxilc.plants import ProcessModel
from jaxilc.scenarios.from_file import read_scenario
from jaxilc.scenarios.identified_file import intervals, starting_law, write_plant_file
from jaxilc.theory.on_lines import MeasuredResponse
from jaxilc.uncertainty import Uniform

DT = 1e-3
PLANT = ProcessModel(-2.0, (), (60.0,))
FOUND = Identified(
    plant=PLANT,
    parameters={
        "gain": Estimate(-2.0, -2.2, -1.8),
        "poles[0]": Estimate(60.0, 50.0, 70.0),
        "bias": Estimate(0.1, 0.0, 0.2),
    },
    covariance=np.eye(3),
    poles=(),
    samples=700,
    simulated=np.zeros((1001, 1)),
    fit=np.array([99.0]),
    validation_fit=np.array([98.0]),
    residual_std=np.array([0.01]),
    whiteness=np.array([0.5]),
    white=False,
    converged=True,
)
RECORD = Record(np.full((1000, 1), 4.0), np.zeros((1001, 1)), DT)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """The path of a plant file, and the law in it."""
    path = tmp_path_factory.mktemp("files") / "axis.toml"
    source = "odd\nname\x07.csv"
    return path, write_plant_file(path, FOUND, RECORD, source=source, units=("V", 'm"m'))


def largest(gain, pole, law, delay=0.0):
    """sup |Q (1 - L P)| of a lag held over each sample, from its closed form; delay: [samples]."""
    f = np.linspace(0.01, 0.5 / DT * (1 - 1e-9), 20001)
    z, a, (part, whole) = np.exp(2j * np.pi * f * DT), np.exp(-pole * DT), np.modf(delay)
    now = a ** (1 - part)
    P = gain * ((1 - now) + (now - a) / z) / (z - a) / z**whole
    Q = 1 / (1 + (np.tan(np.pi * f * DT) / np.tan(np.pi * law.cutoff * DT)) ** 4)
    return np.max(np.abs(Q * (1 - law.gamma_p * z ** (1 + law.lead) * P)))


@pytest.mark.thorough
def test_the_file_holds_the_fitted_numbers_and_their_intervals(written):
    made = read_scenario(written[0])
    assert float(made.machine.plant.gain) == -2.0
    assert made.machine.plant.poles.tolist() == [60.0]
    assert made.uncertainty == {
        "plant.gain": Uniform(-2.2, -1.8),
        "plant.poles[0]": Uniform(50.0, 70.0),
    }
    assert (made.task.dt, made.task.unit, made.task.input_unit) == (DT, "mm", "V")
    text = written[0].read_text()
    assert "1001 samples of 0.001 s; 700 were fitted" in text
    assert "The residual is not white" in text
    assert tomllib.loads(text)["plant"]["kind"] == "ProcessModel"
    assert "machine" not in tomllib.loads(text), "no noise is stated"
    noisy = tomllib.loads(re.sub("^#(?=[a-z[])", "", text, flags=re.M))
    assert noisy["machine"] == {"sensor": {"noise": 0.01}}, "that of the residual, as a choice"


def test_its_law_is_stable_at_the_ends_of_the_intervals(written):
    law = written[1]
    corners = [largest(gain, pole, law) for gain in (-2.2, -1.8) for pole in (50.0, 70.0)]
    assert law.worst == pytest.approx(max(corners), rel=1e-3)
    assert law.nominal == pytest.approx(largest(-2.0, 60.0, law), rel=1e-3)
    assert max(corners) < 0.95
    assert law.machines == 5
    # the cutoff cannot be doubled
    assert max(largest(-1.8, pole, law._replace(cutoff=2 * law.cutoff)) for pole in (50, 70)) > 0.9
    # of wide intervals only some corners are enclosed, and the worst one is among them
    wide = {"plant.gain": Uniform(-2.6, -1.4), "plant.poles[0]": Uniform(42.0, 78.0)}
    law = starting_law(PLANT, wide, DT, 1000)
    corners = [largest(gain, pole, law) for gain in (-2.6, -1.4) for pole in (42.0, 78.0)]
    assert law.worst == pytest.approx(max(corners), rel=1e-3)


@pytest.mark.thorough
def test_it_learns_at_once(written):
    made = read_scenario(written[0])
    rms = learn(made.machine, made.schemes["ilc"], made.task, made.trials).rms[:, 0]
    assert rms[-1] < 0.05 * rms[0]
    # the input stays within half of the largest input of the record
    r = np.asarray(made.task.reference)
    assert np.max(np.abs(r)) / 2.0 < 0.5 * 4.0


def test_a_file_is_not_overwritten(written):
    before = written[0].read_text()
    with pytest.raises(FileExistsError, match=r"axis.toml exists already; add --force"):
        write_plant_file(written[0], FOUND, RECORD, source="other.csv")
    assert written[0].read_text() == before


def test_a_sign_that_is_not_known_has_no_law():
    both = {"plant.gain": Uniform(-2.0, 2.0)}
    assert starting_law(PLANT, both, DT, 1000) is None


def test_a_law_for_the_fitted_plant_only_says_so(tmp_path):
    """No gain suits both ends of an interval of 1 to 1000; the file's own law diverges at one."""
    wide = FOUND.parameters | {"gain": Estimate(-2.0, -50.0, -0.05)}
    path, found = tmp_path / "wide.toml", FOUND._replace(parameters=wide)
    law = write_plant_file(path, found, RECORD, source="record.csv")
    assert not law.within
    said = "on the fitted plant only; within all intervals of the file no such law was found"
    assert said in law.told
    assert "# Chosen for the fitted plant only (machines: 1):\n# no such law was found within" in (
        path.read_text(encoding="utf-8")
    )
    assert abs(1 - law.gamma_p * -50.0) > 1, "at rest, where Q is 1"


def test_what_the_record_does_not_determine_gets_no_interval():
    vague = {
        "gain": Estimate(-2.0, -np.inf, np.inf),
        "poles[0]": Estimate(60.0, -5.0, 125.0),
        "bias": Estimate(0.1, 0.0, 0.2),
    }
    certain, left_out = intervals(FOUND._replace(parameters=vague))
    assert certain == {}
    assert set(left_out) == {"plant.gain", "plant.poles[0]"}


def test_a_fitted_response_is_written_with_its_delay(tmp_path):
    """The delay is in the plant of the file, and the law looks that far ahead."""
    found = FOUND._replace(
        plant=ProcessModel(-2.0, (), (60.0,), delay=0.0205),
        parameters={k: v for k, v in FOUND.parameters.items() if k != "bias"}
        | {"delay": Estimate(0.0205, 0.0204, 0.0206)},
        of_response=True,
    )
    f = np.linspace(2.0, 200.0, 50)
    measured = MeasuredResponse(f, np.ones(50, complex), np.ones(50))
    with pytest.raises(ValueError, match=r"dt = None; allowed is the sample time"):
        write_plant_file(tmp_path / "a.toml", found, measured, source="frf.csv")
    law = write_plant_file(tmp_path / "a.toml", found, measured, dt=DT, source="frf.csv")
    text = (tmp_path / "a.toml").read_text()
    assert "# Response: 50 lines from 2 to 200 Hz, as sampled every 0.001 s behind a hold." in text
    assert "95 % interval 0.0204 .. 0.0206 s; it is not drawn" in text
    made = read_scenario(tmp_path / "a.toml")
    assert made.machine.plant.delay == 0.0205
    assert "plant.delay" not in made.uncertainty
    assert law.lead >= 20
    assert law.nominal == pytest.approx(largest(-2.0, 60.0, law, delay=20.5), rel=1e-3)
