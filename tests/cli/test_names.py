"""Names, titles and units are checked before anything runs.

They become parts of file names, of paths of parameters, and of what a terminal prints.
"""

import dataclasses
import json
import re

import pytest
from command import call, refused

from jaxilc import figures, scenarios
from jaxilc.scenarios.from_file import read_scenario
from jaxilc.schemes import PID
from jaxilc.sweeps import run_schemes

FILE = {
    "plant": {"kind": "transfer_function", "num": [3.0], "den": [1.0, 30.0]},
    "task": {
        "dt": 0.001,
        "reference": {"function": "sinusoid", "amplitude": 1.0, "frequency": 10.0, "duration": 0.1},
    },
    "schemes": {"ilc": {"class": "PIDType", "gamma_p": 0.5}},
}


def write(folder, file="axis.json", /, **changes):
    path = folder / file
    path.write_text(json.dumps(FILE | changes), encoding="utf-8", errors="surrogatepass")
    return path


BAD_NAMES = (
    "x/../../../escaped", "/tmp/x", "..", ".hidden", "", " x", "a\\b", "a\nb", "\x1b[31mred", "a:b",
    "[bold]", "a" * 51, "\ud800", "_x", "-x",
)  # fmt: skip
GOOD_NAMES = ("axis", "X-Achse 2", "Förderachse_3", "两轴", "v1.2 (copy)")


@pytest.mark.parametrize("name", BAD_NAMES)
def test_a_name_that_a_file_cannot_have_is_refused_when_it_is_read(tmp_path, name):
    schemes = {name: FILE["schemes"]["ilc"]}
    for what, signs, changes in (
        ("name", r"_ \. \+ -", {"name": name}),
        ("scheme", r"_ \+ -", {"schemes": schemes}),
    ):
        said = (
            f"{what} = .* is no name; allowed are up to 50 of letters, digits, spaces and {signs}"
        )
        with pytest.raises(ValueError, match=rf"axis\.json: {said}"):
            read_scenario(write(tmp_path, **changes))


def test_a_scheme_is_not_called_as_the_machine_is_nor_with_a_dot(tmp_path):
    for name, said in (
        ("machine", "the name of the machine's own parameters"),
        ("v1.2", "is no name"),
    ):
        with pytest.raises(ValueError, match=said):
            read_scenario(write(tmp_path, schemes={name: FILE["schemes"]["ilc"]}))


@pytest.mark.parametrize("name", GOOD_NAMES)
def test_names_of_people_are_kept(tmp_path, name):
    assert read_scenario(write(tmp_path, name=name)).name == name
    assert read_scenario(write(tmp_path, f"{name}.json")).name == name


@pytest.mark.parametrize(
    ("file", "name"),
    [
        ("a[b]:c.json", "a-b--c"),
        ("\x1b[31m.json", "31m"),
        ("---.json", "plant"),
        ("x" * 90 + ".json", "x" * 50),
    ],
)
def test_a_file_of_another_name_gives_one_that_is_allowed(tmp_path, file, name):
    made = read_scenario(write(tmp_path, file))
    assert made.name == name
    assert made.title == f"{name}: StateSpace"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"title": "\x1b[2J"},
         r"title = '\\x1b\[2J' cannot be shown; allowed are printable characters in one line"),
        ({"title": "two\nlines"}, "title = .* cannot be shown"),
        ({"title": "\u202eright to left"}, "title = .* cannot be shown"),
        ({"shown_unit": "mm]"},
         r"shown_unit = 'mm\]' cannot be shown; allowed are .* without \[ \]"),
        ({"task": FILE["task"] | {"unit": "m;m"}}, "unit = 'm;m' cannot be shown"),
        ({"task": FILE["task"] | {"unit": "$x$"}}, "unit = .* cannot be shown"),
        ({"task": FILE["task"] | {"input_unit": "*/ int x;"}}, "input_unit = .* cannot be shown"),
        ({"tolerance": -1.0}, r"tolerance = -1 is outside its allowed range \(0, inf\)"),
        ({"shown_scale": 0.0}, r"shown_scale = 0 is outside its allowed range \(0, inf\)"),
        ({"show_trials": [0]}, r"show_trials\[0\] = 0 is outside its allowed range \[1, inf\)"),
    ],
)  # fmt: skip
def test_what_cannot_be_shown_is_refused(tmp_path, changes, message):
    with pytest.raises(ValueError, match=message):
        read_scenario(write(tmp_path, **changes))


def test_a_scenario_made_in_python_is_held_to_the_same():
    with pytest.raises(ValueError, match="scheme = 'a/b' is no name"):
        dataclasses.replace(scenarios.load("dai-2014"), schemes={"a/b": PID()})
    with pytest.raises(ValueError, match="tolerance = inf is outside its allowed range"):
        dataclasses.replace(scenarios.load("dai-2014"), tolerance=float("inf"))


def test_a_name_that_leads_elsewhere_writes_nothing(here, tmp_path):
    (tmp_path / "inside").mkdir()
    for changes in ({"name": "x/../../../escaped"}, {"schemes": {"a/b": FILE["schemes"]["ilc"]}}):
        path = write(tmp_path / "inside", **changes)
        code, out, err = call("run", path, "--trials", "2")
        assert code == 2
        assert out == ""
        assert err.count("\n") == 1
        assert "is no name; allowed are" in err
    assert sorted(p.name for p in tmp_path.rglob("*")) == ["axis.json", "inside"]


def test_brackets_and_colons_of_the_user_are_printed_as_they_are(tmp_path, unpainted):
    title = "[bold]Axis[/nothing] :x: [mm]"
    out_dir = tmp_path / "o[b]:x:"
    code, out, err = call("run", write(tmp_path, title=title), "--out", out_dir)
    assert (code, err) == (0, "")
    assert title in out
    assert re.search(r"written: .*o\[b\]:x:/error-by-trial\.png", out)
    assert "[red]none[/].json: no such file" in refused("run", tmp_path / "[red]none[/].json")
    said = refused("run", "cao-2019", "--scheme", "\x1b[31m:x:")
    assert r"scheme = '\x1b[31m:x:' is not one of" in said


def test_every_scheme_of_a_figure_has_a_place_in_its_legend(tmp_path):
    scenario = read_scenario(write(tmp_path, schemes={"X 1+2": FILE["schemes"]["ilc"]}))
    dataset, _ = run_schemes(scenario.machine, scenario.schemes, scenario.task, 2)
    axes = figures.error_by_trial(dataset, metric="rms")
    figures.save(axes, tmp_path / "error.png")
    assert [text.get_text() for text in axes.get_legend().get_texts()] == ["X 1+2"]
