"""A plant file with another plant in it keeps everything else."""

import tomllib
from types import SimpleNamespace

import numpy as np
import pytest

from jaxilc.identification import Estimate
from jaxilc.plants import ProcessModel
from jaxilc.scenarios.identified_file import write_refitted

FILE = """# my axis
trials = 7
[plant]   # as built
kind = "state_space"
A = [
  [0.5, 0.0],
[0.1, 0.2],
]
[ uncertainty . "plant.A" ]
distribution = "uniform"
low = 0.9
high = 1.1
relative = true
[uncertainty.machine.plant.C]
distribution = "uniform"
low = 0.5
high = 1.5
[uncertainty."actuator.limit"]
distribution = "normal"
mean = 9.0
std = 0.1
[grid]
"plant.A[0][0]" = [0.1, 0.2]
[machine.actuator]  # its amplifier
limit = 9.0
[["task".reference]]
function = "sinusoid" # [plant]
[schemes.plant]
class = "PIDType"
"""


def fitted(delay=0.0):
    plant = ProcessModel(2.0, [], [9.0], [], [], delay)
    parameters = {
        "gain": Estimate(2.0, 1.9, 2.1),
        "poles[0]": Estimate(9.0, -1.0, 19.0),
        "bias": Estimate(0.1, 0.0, 0.2),
    }
    fit = np.array([99.0])
    return SimpleNamespace(plant=plant, parameters=parameters, apart={}, fit=fit)


def test_only_the_plant_and_its_uncertainty_are_replaced(tmp_path):
    (tmp_path / "axis.toml").write_text(FILE)
    before = tomllib.loads(FILE)
    file = write_refitted(
        tmp_path / "axis-2.toml", tmp_path / "axis.toml", fitted(), fitted_to="a\nb", noise=0.01
    )
    text = file.read_text()
    after = tomllib.loads(text)
    assert after.pop("plant") == {
        "kind": "ProcessModel", "gain": 2.0, "zeros": [], "poles": [9.0], "frequencies": [],
        "dampings": [],
    }  # fmt: skip
    assert after.pop("uncertainty") == {
        "actuator.limit": before["uncertainty"]["actuator.limit"],
        "plant.gain": {"distribution": "uniform", "low": 1.9, "high": 2.1},  # that of poles holds 0
    }
    assert after["machine"].pop("sensor") == {"noise": 0.01}
    assert after == {n: of for n, of in before.items() if n not in ("plant", "uncertainty", "grid")}
    assert all(note in text for note in ("# my axis", "# its amplifier", "# [plant]"))
    # With a sensor in the file its noise stays as it is; what was fitted can be fitted again.
    again = write_refitted(tmp_path / "axis-3.toml", file, fitted(), fitted_to="c", noise=0.5)
    assert tomllib.loads(again.read_text()) == tomllib.loads(text)
    late = write_refitted(tmp_path / "axis-4.toml", file, fitted(0.004), fitted_to="d")
    assert tomllib.loads(late.read_text())["plant"]["delay"] == 0.004


@pytest.mark.parametrize(
    ("text", "folder", "message"),
    [
        ("machine = { actuator = { limit = 9.0 } }\n[plant]\n", ".", "cannot get a sensor"),
        ('[plant]\n[task.reference]\ncsv = "r.csv"\n', "other", "names files relative to its fold"),
        ("[plant", ".", "axis.toml: "),
    ],
)
def test_a_file_that_cannot_be_changed_is_refused(tmp_path, text, folder, message):
    (tmp_path / "axis.toml").write_text(text)
    (tmp_path / "other").mkdir()
    new = tmp_path / folder / "new.toml"
    with pytest.raises(ValueError, match=message):
        write_refitted(new, tmp_path / "axis.toml", fitted(), fitted_to="a", noise=0.01)
    assert not new.exists()


@pytest.mark.parametrize(
    "plant",
    [
        'plant = { kind = "PMLSM" }\n[task]\ndt = 1.0\n',
        'plant.kind = "PMLSM"\n[task]\ndt = 1.0\n',
        '[plant]\nx = """\n[task]\n"""\n[task]\ndt = 1.0\n',
        "[plant]\nx = 1\n[task]\ndt = 1.0\n[plant.friction]\ny = 2\n",
    ],
)
def test_a_plant_is_replaced_however_it_is_written(tmp_path, plant):
    (tmp_path / "axis.toml").write_text(plant)
    new = write_refitted(tmp_path / "b.toml", tmp_path / "axis.toml", fitted(), fitted_to="a")
    written = tomllib.loads(new.read_text())
    assert written["task"] == {"dt": 1.0}
    assert written["plant"]["poles"] == [9.0]
