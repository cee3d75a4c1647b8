"""Schemes as tables of a plant file: what is written is read back as it was."""

import jax
import numpy as np
import pytest
from cases import DT, SCHEMES

from jaxilc.filters import ZeroPhaseButterworth
from jaxilc.filters.inversion import stable_inverse
from jaxilc.plants import StateSpace
from jaxilc.scenarios.design_file import design_path, need_same_folder, table_of, write_design
from jaxilc.scenarios.from_file import read_scenario
from jaxilc.scenarios.specification import scheme as read
from jaxilc.schemes import ErrorFiltered, Filtered, PIDType

PLANT = StateSpace([[0.9]], [[0.2]], [[1.0]], dt=1e-3)
INVERSE = ErrorFiltered(PIDType(gamma_p=0.5), stable_inverse(PLANT))
FILE = """
trials = 3
[plant]
kind = "state_space"   # of a test
A = [[0.9]]
B = [[0.2]]
C = [[1.0]]
dt = 0.001
[task]
dt = 0.001
reference = { function = "sinusoid", amplitude = 1.0, frequency = 20.0, duration = 0.1 }
[schemes.old]
class = "PIDType"
gamma_p = 1.0
[uncertainty]
"plant.B" = { distribution = "uniform", low = 0.9, high = 1.1, relative = true }
[grid]
"old.gamma_p" = "0.5:1:3"
"""


def assert_same(one, other):
    assert jax.tree.structure(one) == jax.tree.structure(other)
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("name", SCHEMES)
def test_every_scheme_comes_back_from_its_table(name):
    assert_same(read(table_of(SCHEMES[name]), "schemes.x", PLANT, DT), SCHEMES[name])


@pytest.mark.parametrize("suffix", [".toml", ".json"])
def test_a_design_keeps_the_file_and_changes_its_schemes(tmp_path, suffix):
    source, text = tmp_path / f"axis{suffix}", FILE
    if suffix == ".json":
        import json
        import tomllib

        text = json.dumps(tomllib.loads(FILE))
    source.write_text(text)
    law = Filtered(INVERSE, ZeroPhaseButterworth(cutoff=40.0))
    path = write_design(design_path(source), source, {"new": law}, ["Take\nthis: a \x07 law."])
    assert path.name == f"axis.design{suffix}"
    before, after = read_scenario(source), read_scenario(path)
    assert list(after.schemes) == ["new"]
    assert_same(after.schemes["new"], law)
    assert_same(after.machine, before.machine)
    assert after.uncertainty == before.uncertainty
    assert (list(before.grid), after.grid) == (["old.gamma_p"], {})
    if suffix == ".toml":
        written = path.read_text()
        assert "# of a test" in written
        assert written.startswith("# Take")
        assert "gamma_p = 1.0" not in written


def test_a_design_lies_beside_its_plant_file_under_another_name(tmp_path):
    source = tmp_path / "axis.toml"
    need_same_folder(source, tmp_path / "other.toml")
    for wrong in ("axis.toml", "sub/axis.toml", "other.json"):
        with pytest.raises(ValueError, match="--out"):
            need_same_folder(source, tmp_path / wrong)
