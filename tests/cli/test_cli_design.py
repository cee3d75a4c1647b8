"""`jaxilc design` as a user types it."""

import json
import sys
from unittest import mock

import pytest

from jaxilc.cli import design, main
from jaxilc.design import LAWS
from jaxilc.scenarios.from_file import read_scenario

FILE = """
tolerance = 0.9
trials = 4
[plant]
kind = "ProcessModel"
gain = 2.0
poles = [150.0]
[task]
dt = 0.001
unit = "mm"
input_unit = "V"
reference = { function = "sinusoid", amplitude = 1.0, frequency = 20.0, duration = 0.05 }
[uncertainty]
"plant.gain" = { distribution = "uniform", low = 0.9, high = 1.1, relative = true }
"""


def jaxilc(*words) -> int:
    with (
        mock.patch.object(sys, "argv", ["jaxilc", *map(str, words)]),
        pytest.raises(SystemExit) as ended,
    ):
        main()
    return ended.value.code


@pytest.fixture
def file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "axis.toml"
    path.write_text(FILE)
    return path


def test_the_laws_that_are_completed_are_those_that_are_tried():
    assert tuple(LAWS) == design.LAWS  # the command names them without an import of JAX


def test_a_design_ends_with_a_verdict_and_a_file_for_the_next_command(file, capsys):
    asked = (
        "--margin",
        0.1,
        "--law",
        "p-type",
        "--machines",
        9,
        "--steps",
        2,
        "--json",
        "design.json",
    )
    assert jaxilc("design", file.name, *asked) == 0
    said = " ".join(capsys.readouterr().out.split())
    for part in (
        "A first safe answer, by frequency alone: P-type",
        "Take p-type",
        "V/mm",
        "95 % stay at or below a settled error of",
        "so the margin is 0.",
        "Tolerance 0.9 mm: 95 % of the machines are within it from trial",
        "Stop after trial",
        "Most of the error comes from",
        "Next: jaxilc run axis.design.toml",
    ):
        assert part in said
    numbers = json.loads((file.parent / "design.json").read_text())
    assert numbers["chosen"]["law"] == "p-type"
    assert numbers["proof"]["margin"] >= 0.1 - 1e-3
    law = read_scenario(file.parent / "axis.design.toml").schemes["p-type"]
    assert float(law.scheme.gamma_p) == numbers["chosen"]["weights"]["scheme.gamma_p"]
    assert jaxilc("design", file.name, *asked) == 2
    assert "add --force" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("cao-2019",), "is no plant file"),
        (("axis.toml", "--margin", "1.5"), "margin = 1.5 is outside its allowed range (0, 1)"),
        (("axis.toml", "--law", "q-type"), "law = 'q-type'"),
        (("axis.toml", "--scheme", "ilc"), "scheme = 'ilc'"),
        (("axis.toml", "--out", "sub/a.toml"), "a design lies beside"),
        (("axis.toml", "--out", "a.json"), "must end with .toml"),
    ],
)
def test_mistakes_are_refused_before_anything_is_written(file, capsys, words, said):
    assert jaxilc("design", *words) == 2
    assert said in " ".join(capsys.readouterr().err.split())
    assert [path.name for path in file.parent.iterdir()] == ["axis.toml"]
