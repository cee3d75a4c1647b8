"""A plant of kind `identified` is fitted once, and again where its record or its file changed."""

import json
import os

import numpy as np
import pytest

from jaxilc.plants import ProcessModel
from jaxilc.scenarios import file_plant
from jaxilc.scenarios.file_plant import Fit, Options, identified_plant, plant_of

PLANT = ProcessModel(1 / 3, (), (60.1,), (200.7, 300.0), (0.3, 1.1), delay=0.004)
READING = {"time": "t", "input": "u", "output": "y", "time_unit": None, "columns": []}
READING |= {"dt": None, "resample": None}
OPTIONS = Options(READING, {"poles": 1, "pairs": 2, "zeros": 0}, 4, None)


@pytest.fixture
def fits(tmp_path, monkeypatch):
    """A record, and the list of the fits that were made."""
    made = []

    def fit(record, options):
        made.append(record)
        return Fit(PLANT, "said")

    (tmp_path / "record.csv").write_text("t,u,y\n0,1,2\n")
    monkeypatch.setattr(file_plant, "_fitted", fit)
    return made


def plant(folder, **change):
    return identified_plant(folder / "record.csv", OPTIONS._replace(**change), folder)


def same(a, b):
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in file_plant.LEAVES)


def test_it_is_fitted_once_to_the_last_bit(tmp_path, fits):
    for _ in range(3):
        found, said = plant(tmp_path)
        assert same(found, PLANT)
    assert len(fits) == 1
    (kept,) = tmp_path.glob("record.csv.*.fit.json")
    assert said == f"said (kept in {kept.name})"


def test_the_fit_of_other_options_is_not_taken_whatever_its_name(tmp_path, fits):
    plant(tmp_path)
    (first,) = tmp_path.glob("*.fit.json")
    plant(tmp_path, delay=5)
    (other,) = {*tmp_path.glob("*.fit.json")} - {first}
    other.replace(first)
    plant(tmp_path)
    plant(tmp_path)
    assert len(fits) == 3, "it is fitted again, and kept"


def test_another_record_or_other_options_are_fitted(tmp_path, fits):
    plant(tmp_path)
    plant(tmp_path, delay=5)
    assert len(fits) == 2
    assert len([*tmp_path.glob("*.fit.json")]) == 2
    (tmp_path / "record.csv").write_text("t,u,y\n0,1,3\n")
    plant(tmp_path)
    plant(tmp_path)
    assert len(fits) == 3
    assert len([*tmp_path.glob("*.fit.json")]) == 2, "the file of the old record is replaced"


def changed(kept, change):
    content = json.loads(kept.read_text())
    change(content)
    kept.write_text(json.dumps(content))


DAMAGES = {
    "cut": lambda kept: kept.write_text(kept.read_text()[:100]),
    "empty": lambda kept: kept.write_text(""),
    "no text": lambda kept: kept.write_bytes(b"\xff\x00"),
    "another number": lambda kept: changed(kept, lambda c: c["plant"].update(gain=9.0)),
    "no seal": lambda kept: changed(kept, lambda c: c.pop("sha256")),
    "a list": lambda kept: kept.write_text("[1]"),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_file_is_replaced(tmp_path, fits, damage):
    plant(tmp_path)
    (kept,) = tmp_path.glob("*.fit.json")
    whole = kept.read_text()
    DAMAGES[damage](kept)
    assert same(plant(tmp_path)[0], PLANT)
    assert len(fits) == 2
    assert kept.read_text() == whole


def test_what_cannot_be_written_is_no_error(tmp_path, fits, monkeypatch):
    def refused(path, value):
        raise PermissionError(path)

    with monkeypatch.context() as context:
        context.setattr(file_plant, "write_json", refused)
        plant(tmp_path)
        plant(tmp_path)
    assert len(fits) == 2
    assert not [*tmp_path.glob("*.fit.json")]
    plant(tmp_path)
    (kept,) = tmp_path.glob("*.fit.json")
    kept.unlink()
    os.mkfifo(kept)  # to write to it would wait for a process that reads
    assert same(plant(tmp_path)[0], PLANT)
    kept.unlink()
    kept.mkdir()
    assert same(plant(tmp_path)[0], PLANT)


def test_the_keys_of_a_plant_file_are_the_options(tmp_path, monkeypatch):
    asked = []

    def found(*of):
        asked.append(of)
        return PLANT, "said"

    monkeypatch.setattr("jaxilc.scenarios.file_plant.identified_plant", found)
    table = {"kind": "identified", "record": "hal.txt", "columns": ["u", "y"], "dt": 1e-3}
    notes = []
    plant_of(table | {"delay": 4, "zeros": 0}, "plant", tmp_path, notes)
    reading = READING | {"columns": ["u", "y"], "dt": 1e-3}
    structure = {"poles": 1, "pairs": 1, "zeros": 0}
    options = Options(reading, structure, 4, None)
    assert asked == [(tmp_path / "hal.txt", options, tmp_path, ("", ""))]
    assert notes == ["said"]
    with pytest.raises(ValueError, match=r"plant.delays is not a key here"):
        plant_of(table | {"delays": 4}, "plant", tmp_path, notes)
    with pytest.raises(ValueError, match=r"plant.delay = 1.5 is not a whole number"):
        plant_of(table | {"delay": 1.5}, "plant", tmp_path, notes)


def test_a_response_needs_its_sample_time(tmp_path):
    (tmp_path / "record.csv").write_text("f [Hz],re,im\n1,1,0\n2,1,0\n")
    with pytest.raises(ValueError, match=r"is a frequency response: give dt, the sample time"):
        plant(tmp_path)
