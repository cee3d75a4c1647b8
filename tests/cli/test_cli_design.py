"""`jaxilc design` and `jaxilc learn-law` as a user types them."""

import json
from contextlib import suppress
from types import SimpleNamespace
from unittest import mock

import jax
import numpy as np
import pytest
from cases import follows, known_to, lag
from command import call, done, flat, mistakes, refused, write_columns

from jaxilc.cli import commands
from jaxilc.design import LAWS, Designed, Recommended, search
from jaxilc.design.candidates import Candidate
from jaxilc.design.judging import Verdict, verdict
from jaxilc.design.learned import STARTS, LearnedLaw, Taps
from jaxilc.outcomes import Request
from jaxilc.outcomes.designing import _table, _with_weights, need_replaceable, state_of, written_by
from jaxilc.scenarios.from_file import read_scenario
from jaxilc.schemes import LearningFilter, PIDType
from jaxilc.sweeps.summary import SchemeSummary

FILE = f"""tolerance = 0.9
trials = 4
{lag()}input_unit = "V"
{follows(20.0, 0.05)}{known_to(0.1, "plant.gain")}"""

pytestmark = pytest.mark.usefixtures("compiled_once")


@pytest.fixture
def file(here, monkeypatch, unpainted):
    monkeypatch.setattr("jaxilc.outcomes.repeating.MACHINES", 3)
    path = here / "axis.toml"
    path.write_text(FILE)
    return path


def test_a_lead_of_one_sample_is_told_in_the_singular():
    law = SimpleNamespace(words="P-type", bounds=["gamma_p"], scheme=PIDType(gamma_p=0.5, lead=1))
    there = SimpleNamespace(task=SimpleNamespace(unit="mm", input_unit="V"))
    assert _with_weights(law, there) == "P-type, gamma_p = 0.5 V/mm, lead = 1 sample"


def test_the_laws_that_are_completed_are_those_that_are_tried():
    assert tuple(LAWS) == commands.LAWS  # the command names them without an import of JAX


def test_a_design_ends_with_a_verdict_and_a_file_for_the_next_command(file, monkeypatch):
    def as_chosen(candidate, *_, progress, **__):
        """A tuning that ends where it begins; tests/design/test_design.py has one that searches."""
        progress(1, None, 0.5)
        return candidate

    monkeypatch.setattr(search, "tuned", as_chosen)
    asked = ("--margin", 0.1, "--law", "p-type", "--machines", 9, "--steps", 2)
    reports = ("--report", "design.json", "--report", "design.html")
    t = 0.001 * np.arange(700)
    e = np.sin(2 * np.pi * t / 0.1)
    np.savez("trial.npz", t=t, e=e, r=np.cumsum(t * (t % 0.7)))
    said = flat(done("design", file.name, *asked, *reports, "--record", "trial.npz"))
    for part in (
        "A first safe answer, by frequency alone: P-type", "Take p-type", "V/mm",
        "95 % are at or below a settled error of", "mm in each trial from 4 to 60; half of them",
        "Tolerance 0.9 mm: 95 % of the machines are within it in each trial from",
        "so the margin is 0.",
        "The error still falls after trial 4, by ", "more trials than 4 leave less.",
        "Most of the error comes from",
        "it repeats in a period, so RepetitiveControl learns it without a stop",
        "repetitive converges from period to period of 0.1 s",
        "Next, before `jaxilc next` plays it on the machine: jaxilc run axis.design.toml",
    ):  # fmt: skip
        assert part in said
    numbers = json.loads((file.parent / "design.json").read_text())
    page = (file.parent / "design.html").read_text("utf-8")
    assert page.count("<figure><img") == 1, "design.png, and not the file of the same name"
    assert numbers["chosen"]["law"] == "p-type"
    assert numbers["proof"]["margin"] >= 0.1 - 1e-3
    assert set(numbers["proof"]["claims"]) <= {"monotone", "converges"}
    schemes = read_scenario(file.parent / "axis.design.toml").schemes
    assert float(schemes["repetitive"].period) == numbers["within"]["time"]["period"]
    law = schemes["p-type"]
    assert float(law.scheme.gamma_p) == numbers["chosen"]["weights"]["scheme.gamma_p"]
    for further in ((), ("--resume",)):
        (file.parent / "axis.design.toml").write_text("mine")
        assert "add --force" in refused("design", file.name, *asked, *further)
        assert (file.parent / "axis.design.toml").read_text() == "mine"
    write_columns("other.csv", "t [s],r [cm],y [cm]", t, t, t - 0.1 * e)
    told = refused("design", file.name, *asked, "--force", "--record", "other.csv")
    assert "record has the unit 'cm', the task has 'mm'" in told


def test_a_law_that_is_as_good_as_the_simpler_one_has_no_larger_error():
    chosen = SimpleNamespace(name="axis", judged_by="rms", shown=lambda _: (1.0, "mm"))
    errors, one = {"simple": 1.0, "other": 0.995, "worse": 1.1}, SimpleNamespace(high=np.ones(9))
    verdicts = [
        Verdict(Candidate(name, "", None, {}, 0.9, 1.0), error, 1.0, 1.0, 1, 0, "", one)
        for name, error in errors.items()
    ]
    best = Recommended(verdicts[0], None, None)
    table = _table(chosen, Designed(best, tuple(verdicts[1:]), (), 4, 9, 3))
    assert [*map(str, table.columns[-1].cells)] == ["recommended", "as good", "larger error"]
    high = np.array([1.0, 0.5, np.inf, np.inf])  # a law that diverges has not settled in trial 1
    summary = dict.fromkeys(SchemeSummary._fields, 1.0) | {"high": high, "worst": high}
    lost = verdict(verdicts[0].candidate, SchemeSummary(**summary | {"median": high}), 2, None)
    table = _table(chosen, Designed(best, (lost,), (), 4, 9, 3))
    assert [*map(str, table.columns[-2].cells)] == ["trial 1", "–"]


def test_a_state_is_resumed_replaced_or_refused(tmp_path):
    (state := tmp_path / "state").mkdir()
    with pytest.raises(FileExistsError, match="add --resume to go on with it, --force to begin"):
        state_of(tmp_path, force=False, resume=False)
    assert state_of(tmp_path, force=False, resume=True) == state
    assert state.exists()
    assert state_of(tmp_path, force=True, resume=False) == state
    assert not state.exists()


def test_to_go_on_replaces_what_the_state_has_written_and_nothing_of_the_user(file):
    target, state = file.with_name("axis.design.toml"), file.with_name("state")
    state.mkdir()

    def kept(*, resume):
        with suppress(FileExistsError):
            need_replaceable(target, file.parent, force=False, resume=resume)
            return False
        return True

    assert not kept(resume=False)
    target.write_text("mine")
    assert kept(resume=True)
    need_replaceable(target, file.parent, force=True, resume=True)
    written_by(state, target, Request.of(file), {"p-type": PIDType(gamma_p=0.5)}, ["said"])
    assert kept(resume=False)
    assert not kept(resume=True)
    target.write_text(target.read_text() + "# and a note of mine")
    assert kept(resume=True)
    (state / "written.json").write_text("{}")
    assert kept(resume=True)


@pytest.mark.parametrize(
    ("words", "message"),
    mistakes("""
cao-2019 => is no plant file
axis.toml --margin 1.5 => margin = 1.5 is outside its allowed range (0, 1)
axis.toml --law q-type => law = 'q-type'
axis.toml --scheme ilc => scheme = 'ilc'
axis.toml --out sub/a.toml => a design lies beside
axis.toml --out a.json => must end with .toml
axis.toml --record none.csv => none.csv
"""),
)
def test_mistakes_are_refused_before_anything_is_written(file, words, message):
    assert message in refused("design", *words)
    assert [path.name for path in file.parent.iterdir()] == ["axis.toml"]


@pytest.fixture
def small(file, monkeypatch):
    """The same plant file, for a law that is learned in seconds, of three trials."""
    monkeypatch.setattr("jaxilc.design.learned.DENSE", 5)
    monkeypatch.setattr("jaxilc.design.learned.WATCH", 5)
    monkeypatch.setattr("jaxilc.design.by_response.leads_of", lambda *_: [4])
    monkeypatch.setitem(STARTS, "safe", ("p-type",))
    file.write_text(FILE.replace("trials = 4", "trials = 3"))
    return file


def test_a_law_that_is_learned_is_told_in_sentences_and_written_for_other_commands(small):
    asked = ("--taps", "9,5", "--start", "p-type", "--steps", 0, "--machines", 3)
    code, out, err = call("learn-law", small.name, *asked, "--report", "law.json")
    assert code == 0, err
    assert "warning: --start will go" in err
    said = flat(out)
    for part in (
        "The taps by frequency response are found.",
        ": u' = Q u + L e by learned filters, L of 9 taps and Q of 5",
        "Of 3 machines, the nominal one and 2 that it has not seen, half are at or below a settled",
        "the best safe law of a few weights",
        "so the margin is 0.",
    ):
        assert part in said
    assert ("Take learned" in said) == ("take that one" not in said)
    numbers = json.loads((small.parent / "law.json").read_text())
    scheme = read_scenario(small.parent / "axis.learned.toml").schemes["learned"]
    assert isinstance(scheme, LearningFilter)
    assert np.array_equal(scheme.L, numbers["L"])
    assert np.array_equal(scheme.keep, numbers["Q"])
    assert scheme.dt == 1e-3  # what the file says is proved at no other
    assert numbers["proof"]["margin"] >= 0.05 - 2e-3
    assert numbers["proof"]["whole"]["bound"] < 1  # P is affine in its gain
    assert numbers["proof"]["further"] > 0
    assert (small.parent / "out" / "learn-law-axis" / "law.png").exists()
    _next_plays(scheme)


def _next_plays(law):
    """`next` makes of the first trial of a machine, which stood still, what the taps say."""
    state = ("--state", "campaign", "--out", "next.csv")
    words = ("--scenario", "axis.learned.toml", "--set", "campaign.predict=false")
    assert call("next", *state, *words)[0] == 0
    t, r, u = np.loadtxt("next.csv", delimiter=",", skiprows=1, unpack=True)[:3]
    assert np.all(u == 0)
    write_columns("trial.csv", "t [s],u [V],y [mm]", t, u, 0 * t)
    assert call("next", *state, "--measured", "trial.csv")[0] == 0
    played = np.loadtxt("next.csv", delimiter=",", skiprows=1, unpack=True)[2][:-1]
    n = len(law.L) // 2
    e = np.pad(r, (n, n + law.lead))[1 + law.lead :]
    expected = np.correlate(e, np.asarray(law.L), mode="valid")[: len(played)]
    np.testing.assert_allclose(played, expected, atol=1e-9 * np.max(np.abs(expected)))


def test_a_law_that_the_gate_refuses_is_not_written(small, monkeypatch):
    unsafe = Taps(None, mock.Mock(lead=4), None, "|Q (1 - L P)| is 1.2 at 7 Hz")
    monkeypatch.setattr(LearnedLaw, "learned_taps", lambda *_, **__: unsafe)
    monkeypatch.setattr(LearnedLaw, "_safe", lambda *_: [])
    code, out, err = call("learn-law", small.name, "--taps", "5,3", "--steps", 0)
    assert code == 1
    assert "The learned law is refused: |Q (1 - L P)| is 1.2 at 7 Hz." in out
    assert "no plant file was written" in err
    assert not (small.parent / "axis.learned.toml").exists()


@pytest.mark.parametrize(
    ("words", "message"),
    mistakes("""
--taps 61 => --taps '61' is not allowed; allowed are two odd numbers
--taps 8,5 => taps = (8, 5)
--start nil => start = 'nil'
--segments soon => --segments 'soon' is not allowed; allowed are times
--taps 5,3 --segments 0.04,0.02 => starts = (40, 20) are not allowed
--taps 5,3 --limit -1 => limit = -1
--objective last => --objective: 'last'
"""),
)
def test_a_mistake_is_told_in_one_line(small, words, message):
    assert message in refused("learn-law", small.name, *words)


def test_a_law_is_proved_in_double_precision(file):
    assert call("--precision", "float32", "design", file.name, "--margin", "1.5")[0] == 2
    assert jax.numpy.zeros(()).dtype == "float64"
