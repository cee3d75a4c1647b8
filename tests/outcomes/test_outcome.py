"""An outcome is one object: terminal, JSON, page and notebook show the same of it."""

import dataclasses
import json
import re
from functools import partial

import pytest
from typer.main import get_command
from typer.testing import CliRunner

from jaxilc import outcomes
from jaxilc.cli import app
from jaxilc.cli.options import RENAMED, Pages, now_named
from jaxilc.cli.present import present
from jaxilc.outcomes import Request
from jaxilc.outcomes.outcome import Figure, Table
from jaxilc.outcomes.repeating import repeats_in

EVERY, SCREEN = 80, 50  # options of all commands, and lines of a help of 100 columns
PID = Request("cao-2019", ("pid",), trials=2)


@pytest.fixture(scope="module")
def outcome(tmp_path_factory):
    return outcomes.run(PID, folder=str(tmp_path_factory.mktemp("run")))


def test_every_view_has_the_verdict_and_the_cells_of_all_tables(outcome, tmp_path, unpainted):
    page = outcome.page(tmp_path / "page.html").read_text("utf-8")
    plain = re.sub(r"\s+", " ", repr(outcome))
    tables = [table for table in outcome.tables if isinstance(table, Table)]
    cells = [str(cell) for table in tables for column in table.columns for cell in column.cells]
    assert len(cells) > 5
    shown = outcome._repr_html_()
    for said in (*outcome.verdict.said, *cells):
        assert said in plain
        for html in (page, shown):
            assert said.replace("'", "&#39;").replace("<", "&lt;") in html
    unlike_live = [figure for figure in outcome.figures.values() if not figure.live]
    assert page.count("<figure><img") == len(unlike_live)
    assert page.count('<figure class="live">') == 2  # errors by trial, and within a trial
    assert shown.count("<figure><img") == len(outcome.figures)


def test_one_text_is_one_scheme_and_one_setting():
    one = Request("cao-2019", "pid", "pid.kp=-9", trials=2).scenario()
    assert one.schemes.keys() == {"pid"}
    assert one.schemes["pid"].kp == -9
    assert one.select("pid").schemes.keys() == {"pid"}


def test_one_text_is_one_folder_one_axis_and_one_record(outcome):
    assert (outcome.folder / "dataset.zarr").parent.is_dir()  # of a folder given as a text
    assert PID.grid("pid.kp=-9,-11", outcome.scenario) == {"pid.kp": "-9,-11"}
    measured = partial(outcomes.filter_measured, gain=1.0, cutoff=50.0, dt=1e-3)
    for find in (measured, repeats_in):
        with pytest.raises(FileNotFoundError, match=r"nowhere\.csv"):
            find("nowhere.csv")


@pytest.mark.parametrize("trials", [2.0, "2", float("nan")])
def test_a_number_of_trials_is_a_whole_one(trials):
    with pytest.raises(ValueError, match=rf"--trials {trials} is outside .* of whole numbers"):
        Request("cao-2019", "pid", trials=trials).scenario()


def test_every_view_says_what_failed(outcome, tmp_path):
    lost = dataclasses.replace(outcome, failed="no law was found", figures={}, live=tuple)
    page = lost.page(tmp_path / "page.html").read_text("utf-8")
    assert all("no law was found" in view for view in (repr(lost), lost._repr_html_(), page))


def test_a_notebook_shows_an_outcome_once(outcome, monkeypatch):
    """Rich would print beside the text, in a notebook, which asks for text and page alike."""
    outside = repr(outcome)
    monkeypatch.setattr("rich.console._is_jupyter", lambda: True)
    assert repr(outcome) == outside
    assert all(said in outside for said in outcome.verdict.said)


def test_figures_and_files_are_written_where_they_belong(outcome, tmp_path, unpainted):
    paths = outcome.save(tmp_path / "elsewhere")
    assert {path.stem for path in paths} == {*outcome.figures, "dataset"}
    assert all(path.parent == tmp_path / "elsewhere" and path.exists() for path in paths)


def test_a_figure_that_fails_loses_no_result(outcome, tmp_path):
    fails = Figure("", partial(int, "no number"))
    lost = dataclasses.replace(outcome, folder=tmp_path, figures={"one": fails}, live=tuple)
    with pytest.raises(ValueError, match="no number"):
        present(lost, Pages([tmp_path / "all.json"]))
    assert {path.name for path in tmp_path.iterdir()} == {"all.json", "dataset.zarr"}
    assert json.loads((tmp_path / "all.json").read_text())["trials"] == 2


def test_a_command_has_few_options_and_its_help_fits_a_screen():
    commands, names = get_command(app).commands, set()
    for name, command in commands.items():
        options = [one for one in command.params if one.param_type_name == "option"]
        shown = {one.opts[0] for one in options if not getattr(one, "hidden", False)}
        names |= shown
        assert len(shown) <= 15, (name, len(shown))
        page = CliRunner().invoke(app, [name, "--help"], env={"COLUMNS": "100"}).stdout
        assert len(page.splitlines()) <= SCREEN, name
    assert len(names) <= EVERY, len(names)


@pytest.mark.parametrize(
    ("words", "now"),
    [
        ("run x --json a.json", "run x --report a.json"),
        ("run x --json=a.json", "run x --report a.json"),
        ("run x --figures svg --trials 2", "--figures svg run x --trials 2"),
        ("-q sweep x --precision float32", "-q --precision float32 sweep x"),
        ("next --state s --plant-file f --limit 5",
         "next --state s --scenario f --set campaign.limit=5"),
        ("next --state s --accept-saturation",
         "next --state s --set campaign.accept_saturation=true"),
        ("next --no-predict --dry-run", "next --set campaign.predict=false --dry-run"),
        ("run x --out next --json a.json", "run x --out next --report a.json"),
        ("run x --json", "run x --report "),
    ],
)  # fmt: skip
def test_options_are_taken_by_their_old_names(words, now, capsys):
    commands = [*get_command(app).commands]
    assert now_named(words.split(), commands) == now.split(" ")
    assert "warning: --" in capsys.readouterr().err
    assert now_named(now.split(), commands) == now.split()


def test_what_replaces_an_option_is_an_option():
    commands = get_command(app).commands
    for name, options in RENAMED.items():
        known = {option for one in commands[name].params for option in one.opts}
        assert {new.split()[0] for new in options.values()} <= known
        assert not known & options.keys()
