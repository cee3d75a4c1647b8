"""`jaxilc filter`: the answers that are printed, the files that are left, and what is refused."""

import json
import shlex
import tomllib

import numpy as np
import pytest
from cases import follows, lag
from command import call, done, flat, mistakes, refused, write_columns

from jaxilc.filters import ZeroPhaseButterworth
from jaxilc.outcomes import filter_, filter_measured
from jaxilc.pytree.named_paths import replaced
from jaxilc.scenarios.design_file import toml_of, write_with_scheme
from jaxilc.schemes import Filtered, LearningFilter, PIDType, WithFeedback
from jaxilc.schemes.pid import PID
from jaxilc.theory import q_filter
from jaxilc.theory.frequency import Tried, WholeSet
from jaxilc.theory.loop import Loop
from jaxilc.theory.on_lines import Change, Lines
from jaxilc.theory.q_filter import (
    Offer,
    Places,
    Question,
    Resonance,
    curves_of,
    places_in,
    with_law,
    without_low_pass,
)

AXIS = f"""{lag(60.0, 0.002)}input_unit = "V"
{follows(5.0, 0.2)}[schemes.ilc]
class = "Filtered"
scheme = {{ class = "PIDType", gamma_p = 0.3, lead = 3 }}
filter = {{ class = "ZeroPhaseButterworth", cutoff = 20.0 }}
"""
pytestmark = pytest.mark.usefixtures("compiled_once")
LAW = ("--gain", 0.5, "--lead", 2, "--cutoff", 30, "--dt", 0.001)
LINES = np.arange(1.0, 200.0)  # [Hz] of a plant, and of L and Q of that law
PLANT = 1 / (1 + 2j * np.pi * LINES / 80)
L = 0.5 * np.exp(2j * np.pi * LINES * 3e-3)
Q = 1 / (1 + (np.tan(np.pi * LINES * 1e-3) / np.tan(np.pi * 0.03)) ** 4)


def write_response(path, scatter="", *columns):
    """Write the measured response of that plant, with columns that tell its scatter."""
    write_columns(path, f"f [Hz],re,im{scatter}", LINES, PLANT.real, PLANT.imag, *columns)


@pytest.fixture
def here(here, unpainted):
    (here / "axis.toml").write_text(AXIS)
    write_response("a.csv", ",std", 0.02 * np.abs(PLANT))
    return here


def answer(value: float, proof: WholeSet) -> tuple[Question, Lines]:
    """An answer with a given largest value, on three machines."""
    f, one = np.array([1.0, 10.0, 40.0, 90.0]), np.ones(4, complex)
    P = np.array([[1.0, 1.0, 0.5, 0.1], [0.9, 0.9, 0.4, 0.1], [1.1, 1.1, 0.6, 0.1]], complex)
    lines = Lines(f, P, 0 * P.real, one, 0.5 * one, 2e-3)
    values, points = np.array([0.5, value, 0.55]), np.array([[1.0], [0.85], [1.15]])
    loop = Loop(np.zeros((1, 1)), np.ones((1, 1)), np.ones((1, 1)))
    tried = Tried(("plant.gain",), points, values, f[:3], values, 0 * values, [loop] * 3)
    now = Offer("as it is", {}, Change(1.0, 0, 20.0, 2), value, 14.0, 0.01)
    curves = curves_of(lines)
    places = Places("filter.cutoff", ("scheme.gamma_p",), "scheme.lead", 2)
    return Question(tried, curves, proof, [Resonance(10.0, 0.1)], places, now, 0.0), lines


@pytest.mark.parametrize(
    ("value", "proof", "said", "bound"),
    [
        (0.6, WholeSet(0.61, "corners"), "is at most 0.61 (proved for all of them)", 0.61),
        (0.6, WholeSet(np.inf, "why"), "is at most 0.6 (on the machines tried)", 0.6),
        (1.2, WholeSet(np.inf, "why"), "not safe for plant.gain ±15 %: |Q (1 - L P)| reaches", 1.2),
    ],
)
def test_the_answer_for_a_machine(here, monkeypatch, value, proof, said, bound):
    better = {"filter.cutoff": 50.0, "scheme.lead": 4}
    offer = Offer("largest cutoff", better, Change(1.0, 1, 50.0, 2), 0.89, 30.0, 0.002)
    monkeypatch.setattr(q_filter, "question", lambda *_, **__: answer(value, proof))
    monkeypatch.setattr(q_filter, "offers_of", lambda *_: [offer])
    monkeypatch.setattr("jaxilc.outcomes.filtering._lead_of", lambda *_: 0.0)
    asked = ("--vary", "machine.plant.gain=15%", "--report", "o.json", "--out", "o")
    asked += ("--set", "plant.poles[0]=61", "--set", "ilc.scheme.lead=2", "--taps", "3")
    out = done("filter", "axis.toml", *asked)
    found = json.loads((here / "o.json").read_text())["schemes"]["ilc"]
    assert (found["peak"], found["safe"]) == (bound, bound < 1)
    assert found["machine"] == {"plant.gain": 0.85}
    assert found["offers"][0]["set"] == better
    text = flat(out)
    assert said in text
    rest = "proved for all of them" if np.isfinite(proof.bound) else "on the machines tried"
    assert f"Synthesised with 3 taps: |Q (1 - L P)| is at most {bound:g} ({rest})" in text
    assert "10 Hz on the machine plant.gain x 0.85" in text
    assert "0.002 mm rms is left instead of 0.01 mm" in text
    assert "certify has no --vary: its machines are the nominal one alone" in text
    certify = "jaxilc certify axis.toml --scheme ilc --set 'plant.poles[0]=61'"
    assert f"{certify} --set ilc.filter.cutoff=50 --set ilc.scheme.lead=4" in text
    assert (here / "o/ilc.png").exists()


def test_the_answer_for_a_record(here):
    said = flat(done("filter", "a.csv", *LAW, "--report", "o.json"))
    found = json.loads((here / "o.json").read_text())
    assert "Safe on every line with 3 standard deviations" in said
    assert "Between the lines, below the first and above the last nothing is proved" in said
    robust = Q * (np.abs(1 - L * PLANT) + 3 * 0.02 * np.abs(L * PLANT))
    assert found["peak"] == pytest.approx(np.max(robust), rel=1e-9)
    assert "Next: jaxilc filter a.csv --gain 0.5" in said


def test_a_record_without_scatter_is_not_said_to_be_safe_with_it(here):
    """Lines of re and im alone were "safe with 3 standard deviations", "scatter included"."""
    for name, *std in (("bare.csv",), ("zero.csv", ",std", 0 * LINES)):
        write_response(name, *std)
        said = flat(done("filter", name, *LAW))
        assert "Safe on every line: |Q (1 - L P)| is at most" in said
        assert f"{name}: no scatter of its lines is told, so that none is allowed for" in said
        assert not any(text in said for text in ("deviations", "included", "|Q L| s"))
    both = filter_measured(["a.csv", "bare.csv"], gain=0.5, cutoff=30.0, dt=1e-3, lead=2)
    first, second, *_ = both.verdict.said
    assert "with 3 standard deviations of scatter where it is told: |Q (1 - L P)| + |Q L|" in first
    assert second.startswith("bare.csv: no scatter")


def test_taps_of_one_by_one_matrices_are_written_as_they_are_set(here, monkeypatch):
    """They ended in a TypeError, and those of one axis were rounded beyond the margin."""
    taps = {"L": np.array([[[0.123456]], [[0.5]]])}
    offer = Offer("largest gain", taps, Change(1.2, 0, np.inf, 2), 0.89, 30.0, 0.002)
    monkeypatch.setattr(q_filter, "question", lambda *_, **__: answer(0.6, WholeSet(0.61, "")))
    monkeypatch.setattr(q_filter, "offers_of", lambda *_: [offer])
    said = filter_("axis.toml", vary=["plant.gain=15%"]).verdict.following
    assert shlex.split(said)[-1] == "ilc.L=[0.123456,0.5]"


def test_a_machine_that_stands_still_has_figures_and_no_design(here):
    """The limits of a logarithmic axis were 0, and NaN could not become the number of a lead."""
    (here / "still.toml").write_text(AXIS.replace("gain = 2.0", "gain = 0.0"))
    assert "ilc: not safe" in flat(done("filter", "still.toml"))
    for command in ("design", "learn-law"):
        assert "does not answer its input" in refused(command, "still.toml")


def test_the_next_command_for_a_record_asks_the_same(here):
    """A rounded sample time refused the line at its Nyquist frequency; sigmas were left out."""
    f, dt = np.linspace(30.0, 3000.0, 100), 1 / 6000
    c = np.full(100, 0.9)
    write_columns("c.csv", "f [Hz],re,im,coherence", f, 1 / (1 + (f / 800) ** 2), 0 * f, c)
    asked = {"sigmas": 2.0, "averages": 100, "margin": 0.2}
    found = filter_measured(["c.csv"], gain=0.5, cutoff=300.0, dt=dt, **asked)
    done(*shlex.split(found.verdict.following)[1:], "--report", "o.json")
    peak = json.loads((here / "o.json").read_text())["peak"]
    assert peak == pytest.approx(max(one["peak"] for one in found.numbers["offers"]), rel=1e-9)


def test_the_file_tells_the_averages_behind_its_coherence(here):
    """They were asked for by an option that no help shows, and that warned when it was given."""
    for heading in ("coherence", "coherence [20 averages]"):
        write_response("c.csv", f",{heading}", np.full(199, 0.99))
        code, out, err = call("filter", "c.csv", *LAW, "--report", "o.json")
        if heading == "coherence":
            assert (code, out) == (2, "")
            assert "write it into the heading, as `coherence [16 averages]`" in err
    assert (code, err) == (0, "")
    assert "scatter and the doubt of 20 averages: |Q" in flat(out)
    assert "--averages" not in out
    peak = json.loads((here / "o.json").read_text())["peak"]
    # the F distribution with 2 and 38 degrees of freedom exceeds x with (1 + x / 19)^-19
    std = np.abs(PLANT) * np.sqrt(0.01 / 0.99 / 19)
    s = std * np.sqrt(19 * (np.exp(9 / 19) - 1))
    assert peak == pytest.approx(np.max(Q * (np.abs(1 - L * PLANT) + 0.5 * s)), rel=1e-9)


def test_records_of_one_name_in_several_folders_are_told_apart(here):
    (here / "b").mkdir()
    (here / "b/a.csv").write_bytes((here / "a.csv").read_bytes())
    found = filter_measured(["a.csv", "b/a.csv"], gain=0.5, cutoff=30.0, dt=1e-3)
    assert [*found.numbers["records"]] == ["a.csv", "b/a.csv"]


@pytest.mark.parametrize(
    ("words", "message"),
    mistakes("""
axis.toml --margin 1 => --margin 1 is outside its allowed range (0, 1)
axis.toml --margin nan => --margin nan is outside
axis.toml --vary plant.gain => --vary 'plant.gain' is not PATH=SHARE
axis.toml --vary plant.gian=0.1 => plant.gian
axis.toml --vary plant.gain=120% => share in (0, 1)
axis.toml --vary plant.gain=0.1 --spread 0.1 => exclude each other
axis.toml --spread 0.1 => spread = 0.1 widens nothing, since no uncertainty of axis.toml is rel
axis.toml --set ilc.filter.cutoff=250 => cutoff = 250 Hz is outside
axis.toml --taps 0 => taps = 0 is outside its allowed range [3, 501]
a.csv --gain 1 --cutoff 30 --dt 0.001 --taps 4 => taps = 4 is even; allowed are odd numbers
a.csv --gain 0.5 --cutoff 30 --dt 0.001 --taps 5 --band 0 => band = 0 Hz is outside
axis.toml --gain 1 => --gain is for a measured response only
axis.toml --lead 1 => --lead is for a measured response only
axis.toml a.csv => filter takes one scenario, or measured responses
a.csv => --gain, --cutoff, --dt not given
a.csv --gain 1 --cutoff 600 --dt 0.001 => cutoff = 600 Hz is outside
a.csv --gain 1 --cutoff 20 --dt 0.01 => has a line at 199 Hz; allowed is up to 50 Hz
a.csv --gain 1 --cutoff 0.5 --dt 0.001 => starts at 1 Hz and has 0 lines
a.csv --gain 1 --cutoff 30 --dt 0.001 --machines 5 => --machines is for a scenario only
a.csv --gain 1 --cutoff 30 --dt 0.001 --scheme ilc => --scheme is for a scenario only
"""),
)
def test_what_is_refused(here, words, message):
    assert message in refused("filter", *words)
    assert not (here / "out").exists()


def test_where_cutoff_gain_and_lead_stand():
    law = Filtered(PIDType(gamma_p=0.4, gamma_d=0.2, lead=3), ZeroPhaseButterworth(20.0, order=3))
    whole = WithFeedback(law, PID(kp=1.0))
    places = places_in(whole)
    assert places.cutoff == "learning.filter.cutoff"
    assert places.gains == ("learning.scheme.gamma_p", "learning.scheme.gamma_d")
    assert (places.lead, places.order) == ("learning.scheme.lead", 3)
    changed = replaced(whole, places.of(whole, Change(2.0, -1, 35.0, 3)))
    assert (changed.learning.scheme.gamma_d, changed.learning.scheme.lead) == (0.4, 2)
    assert changed.learning.filter.cutoff == 35.0
    assert without_low_pass(whole).learning is law.scheme
    fir = LearningFilter((0.1, 0.2, 0.3))
    assert with_law(whole, fir).learning is fir


def test_a_scheme_is_written_as_it_is_read(here):
    fir = LearningFilter((0.1, 0.2, 1 / 3), keep=(0.25, 0.5, 0.25), lead=4)
    path, ready = write_with_scheme(here / "new.toml", "axis.toml", "ilc-fir", fir)
    assert ready
    read = tomllib.loads(path.read_text())["schemes"]
    assert set(read) == {"ilc", "ilc-fir"}
    assert read["ilc-fir"] == {
        "class": "LearningFilter", "L": [0.1, 0.2, 1 / 3], "keep": [0.25, 0.5, 0.25], "lead": 4,
    }  # fmt: skip
    whole = Filtered(PIDType(gamma_p=0.4), ZeroPhaseButterworth(20.0))
    nested = tomllib.loads(toml_of({"a b": whole}))["schemes"]["a b"]
    assert nested["scheme"] == {"class": "PIDType", "gamma_p": 0.4}
    assert nested["filter"] == {"class": "ZeroPhaseButterworth", "cutoff": 20.0}
