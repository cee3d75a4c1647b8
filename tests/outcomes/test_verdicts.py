"""The verdict of each command is what its numbers say, and its next command is one of jaxilc."""

import math
import shlex
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from unittest import mock

import numpy as np
import pytest
import xarray as xr
from cases import first_order, follows, p_type
from made_datasets import sweep_of
from typer.main import get_command

from jaxilc import outcomes
from jaxilc.cli import app
from jaxilc.design.judging import Limits, judged_trials, verdict
from jaxilc.learning import Machine
from jaxilc.outcomes import certifying, designing
from jaxilc.outcomes.beginning import list_verdict
from jaxilc.outcomes.certifying import certificate_sentence, certify_verdict
from jaxilc.outcomes.outcome import Console, Verdict
from jaxilc.outcomes.reproducing import _by_paper, reproduce_verdict
from jaxilc.outcomes.request import REPEATED, Request
from jaxilc.outcomes.running import run_numbers, run_verdict
from jaxilc.outcomes.sweeping import sweep_verdict
from jaxilc.outcomes.terms import objective_of, weights_of
from jaxilc.outcomes.tuning import (
    _drawn,
    _end_reached,
    _over,
    _tell_ranges,
    budget_verdict,
    front_verdict,
    in_words,
    is_error_of,
    outside,
    tune_verdict,
    tuning_lines,
    without_size,
    worst_case_verdict,
)
from jaxilc.outcomes.words import DIVERGES, FALLS, GROWS, SETTLED, SINGLE, Case, beside_1, trend_of
from jaxilc.plants import StateSpace
from jaxilc.scenarios import Scenario
from jaxilc.scenarios.published import NOTHING, Fit, Published
from jaxilc.scenarios.reproduction import Row
from jaxilc.schemes import LearningFilter, ModelFreeGradient, NormOptimal, PIDType
from jaxilc.signals import Task
from jaxilc.sweeps.runs import run_schemes
from jaxilc.sweeps.summary import SchemeSummary, wilson_interval
from jaxilc.tuning import Tuning
from jaxilc.tuning.weights import Weights
from jaxilc.uncertainty import Normal, Uniform

J = np.arange(1, 41)
NOISE = np.random.default_rng(3)
FILE = Request("my axis.toml")
AXIS = f"{first_order(0.2, 0.8)}unit = 'mm'\n{follows(20.0, 0.05)}"
CASE = Case(FILE, {"ilc": True}, designable=True, unit="mm")


def parsed(verdict):
    """Parse the next command by the program itself; return its name and its parameters.

    Older versions of typer give lists as tuples, and paths as texts.
    """
    jaxilc, name, *words = shlex.split(verdict.following)
    assert jaxilc == "jaxilc"
    command = get_command(app).commands[name]
    with command.make_context(name, words) as context:
        assert not context.args
        options = {key: [*x] if isinstance(x, tuple) else x for key, x in context.params.items()}
    if options.get("params"):
        options["params"] = Path(options["params"])
    return name, options


@pytest.mark.parametrize(
    ("errors", "kind", "words"),
    [
        (0.01 + 0.7 ** (J - 1), SETTLED, "has settled since trial 23"),
        (1 / J, FALLS, "is still falling"),
        (0.9**J, FALLS, "is still falling"),
        (0.9**J + 1e-3 * 1.2**J, GROWS, "has grown 9.66 times since trial 22"),
        (np.append(0.5**J, np.inf), DIVERGES, "diverges"),
        (np.insert(0.5**J, 3, np.nan), DIVERGES, "diverges"),
        (1e-16 * NOISE.uniform(1, 9, 40) + (J == 1), SETTLED, "has settled since trial 2"),
        (1 + 0.02 * NOISE.standard_normal(40), SETTLED, "has not fallen by 5% since trial 1"),
        (np.zeros(5), SETTLED, "has not fallen by 5% since trial 1"),
        (np.arange(3.0), GROWS, "has grown since trial 1"),
        ([2.0, 1.0], FALLS, "is still falling"),
        ([2.0], SINGLE, ""),
    ],
)
def test_the_course_of_an_error(errors, kind, words):
    found = trend_of([float(error) for error in errors])
    assert (found.kind, found.words) == (kind, words)


@pytest.mark.parametrize("command", REPEATED)
def test_what_was_asked_is_repeated_in_options_that_the_command_has(command):
    asked = Request(
        "it's my axis.toml", ("a b",), ("x.y=1", "z='q'"), "p q.json", 7, 0.25, "rms", 1e-7
    )
    words = ("--state", "s") if command == "next" else ()
    scheme = "" if command in ("list", "design") else "a b"
    _, params = parsed(Verdict((), "", asked.following(command, *words, scheme=scheme)))
    assert "it's my axis.toml" in map(str, params.values())
    given = {name: value for name, value in params.items() if value is not None}
    expected = {"trials": 7, "trial": 7, "spread": 0.25, "metric": "rms", "tolerance": 1e-7}
    for name in REPEATED[command]:
        if name == "set":
            assert list(given["set_"]) == ["x.y=1", "z='q'"]
        else:
            assert str(given[name]) == str(expected.get(name, "p q.json"))
    line = Request("-x.toml").following(command, *words, scheme=scheme)
    assert parsed(Verdict((), "", line))[0] == command


# run, sweep and list
# --------------------------------------------------------------------------------------------------


def ran(case, grown=None, **errors):
    rows = {name: {"grown_from": 0, "grown_to": 1.0, "best": 1} for name in errors}
    rows |= grown or {}
    numbers = {"trials": len(next(iter(errors.values()))), "schemes": rows}
    return run_verdict(case, numbers, {name: [*map(float, e)] for name, e in errors.items()})


def test_run_names_the_best_scheme_how_far_it_came_and_what_to_do():
    found = ran(CASE, ilc=0.01 + 0.7 ** (J - 1))
    assert found.said == (
        "ilc: trial 40 has a settled error of 0.01 mm, after 1.01 mm in trial 1; it has settled "
        "since trial 23.",
    )
    assert found.lines[-1] == "Next, many machines: jaxilc sweep 'my axis.toml'"
    assert parsed(ran(CASE._replace(uncertain=False), ilc=[1.0] * 9))[0] == "certify"
    name, params = parsed(ran(CASE, ilc=1 / J))
    assert (name, params["trials"]) == ("run", 80)
    grows = {"ilc": {"grown_from": 12, "grown_to": 2.5, "best": 10}}
    found = ran(CASE, grows, ilc=1 / J)
    assert found.said[0].endswith("; its rms error has grown 2.5 times since trial 10.")
    assert parsed(found)[0] == "design"
    assert ran(CASE, grows, ilc=1e-17 * J + (J == 1)).said[0].endswith("settled since trial 2.")
    found = ran(CASE._replace(steps={"ilc": 3}), ilc=[8.0, 9, 9, 4, 9, 9, 2, 9])
    assert "trial 7 has a settled error of 2 mm, after 8 mm in trial 1" in found.said[0]
    gone = ran(CASE._replace(steps={"ilc": 2}), ilc=[8.0, np.inf, 2, 4])
    assert gone.said == ("ilc diverges within 4 trials.",), "also where an experiment does"


def test_a_design_keeps_the_settings_of_machine_and_feedback():
    settings = ("machine.plant.B=2", "ilc.gamma_p=8", "ilc.feedback.kp=1")
    case = CASE._replace(request=Request("my axis.toml", set=settings))
    found = ran(case, ilc=[1.0, np.inf])
    assert found.said == ("ilc diverges within 2 trials.",)
    name, params = parsed(found)
    assert (name, params["set_"]) == ("design", ["machine.plant.B=2", "ilc.feedback.kp=1"])


@pytest.mark.parametrize(
    ("trials", "factor", "left", "said"),
    [
        (20, 0.5, 0.01, "Stop after trial 12: what later trials gain is less than 5 %."),
        (20, 0.95, 6.5, "Stop after trial 20: what later trials gain is less than 5 %."),
        (20, 0.99, 0.0, "still falls after trial 20, by 30% to trial 60: more trials than 20"),
        (350, 0.5, 0.01, "Stop after trial 12: what later trials gain is less than 5 %."),
        (350, 0.99, 0.0, "The error still falls in trial 350: more trials leave less."),
        (350, 0.999, 0.0, "Stop after trial 302: what later trials up to 350 gain is less than"),
    ],
)
def test_a_design_tells_to_stop_as_far_as_it_has_looked(trials, factor, left, said):
    """From 200 trials on no more are run than were asked for."""
    long = judged_trials(trials)
    high = left + factor ** np.arange(long)
    fields = dict.fromkeys(SchemeSummary._fields, 0.0)
    one = verdict(
        None, SchemeSummary(**fields | {"median": high, "high": high, "worst": high}), trials, None
    )
    assert said in designing._stop_said(one, trials, long)


def test_a_design_tells_of_uncertain_machines_where_there_are_some():
    said = partial(designing._limits_said, Limits(1.0, 2.0, 5.0, 5.5), "{:g} mm".format)
    both = (
        "Most of the error comes from noise: without noise and limits the nominal machine reaches "
        "1 mm, with the limits of the actuator 2 mm, with noise too 5 mm"
    )
    assert said(uncertain=False) == f"{both}."
    assert said(uncertain=True) == f"{both}, and 95 % of the uncertain machines 5.5 mm."


@pytest.mark.parametrize(
    ("ours", "safe", "said"),
    [
        (0.0, 0.0, "that is as much as with"),
        (0.0, 1.0, "that is inf times less than"),
        (1.0, 0.0, "that is inf times more than"),
        (1.0, 0.5, "that is 2 times more than"),
    ],
)
def test_a_learned_law_is_compared_with_a_law_without_an_error(ours, safe, said):
    candidate, found = SimpleNamespace(name="p-type"), {}
    for role, error in (("learned", ours), ("safe", safe)):
        of = dict.fromkeys(("median", "high", "worst"), np.array([1.0, error]))
        found[role] = SimpleNamespace(summary=SimpleNamespace(**of), candidate=candidate)
    learned = SimpleNamespace(verdicts=found, trials=2, start=None)
    assert said in designing._compared(learned)


def test_run_compares_schemes_and_the_tolerance():
    several = Case(
        Request("cao-2019", metric="rms", set=("plant=printed",)),
        {"pid": False, "a": True, "b": True}, metric="rms", unit="µm", tolerance=5.0,
    )  # fmt: skip
    found = ran(several, pid=[9.0] * 40, a=4 + 0.5**J, b=np.append(0.1 ** J[:-1], np.inf))
    assert found.said[0].startswith(
        "a is best of 3 schemes: trial 40 has an rms error of 4 µm, after 4.5"
    )
    assert found.said[1] == "It is within the tolerance of 5 µm."
    name, params = parsed(found)
    assert (name, params["scheme"], params["metric"]) == ("sweep", ["a"], "rms")
    assert params["set_"] == ["plant=printed"]
    found = ran(several, pid=[9.0] * 40, a=np.append(np.inf, 0.1 ** J[1:]), b=[np.nan] * 40)
    assert found.said[0] == (
        "pid is best of 3 schemes (it does not learn): trial 40 has an rms error of 9 µm, after "
        "9 µm in trial 1."
    )
    assert found.said[1] == "It is beyond the tolerance of 5 µm."
    assert parsed(found)[1]["scheme"] == ["a"]
    found = ran(several, pid=[9.0] * 40, a=4 + 0.5**J, b=4.04 + 0.1**J)
    assert found.said[0].startswith(
        "a and b end alike, best of 3 schemes: a in trial 40 has an rms error"
    )
    largest = {
        name: {"max_error": {"40": x}} for name, x in (("pid", 12.0), ("a", 30.0), ("b", 40.0))
    }
    usual = {"grown_from": 0, "grown_to": 1.0, "best": 1}
    errors = {"pid": [9.0] * 40, "a": [*(4 + 0.5**J)], "b": [8.0] * 40}
    rows = {"trials": 40, "unit": "µm", "schemes": {n: usual | of for n, of in largest.items()}}
    assert run_verdict(several, rows, errors).said[1] == (
        "Over the whole trial it errs by up to 30 µm, and pid by 12 µm."
    )
    found = ran(several, a=[np.inf] * 3, b=[1.0, np.inf, 1.0], pid=[np.nan] * 3)
    assert found.said == ("Every scheme diverges within 3 trials.",)
    single = Case(Request("cao-2019", ("pid",)), {"pid": False})
    assert ran(single, pid=[1.0]).following == "jaxilc run cao-2019"
    alone = Case(Request("dai-2014"), {"pid": False})
    assert ran(alone, pid=[1.0]).following == "jaxilc list dai-2014"


def swept(case, share, high, worst, machines=64, **lost):
    row = {"yield": share, "yield_interval": [0.5, 1.0], "semi_converged": 0.0, "diverged": 0.0}
    at = {"high": high[-1], "worst": worst, "worst_sample": 5}
    row |= {"by_trial": {str(len(high)): at}} | lost
    numbers = {"schemes": {"ilc": row}, "trials": len(high), "samples": machines, "tolerance": 0.02}
    return sweep_verdict(case, numbers, {"ilc": high})


def test_the_winner_of_a_grid_of_trials_is_told_at_its_own_last_trial(tmp_path):
    """At the fewest trials of the best points the other scheme is ahead."""
    (tmp_path / "two.toml").write_text(
        f"tolerance = 0.2\n{AXIS}{p_type(0.3, 'sure')}{p_type(1.0, 'fast')}"
    )
    course = np.array([[8.0, 4.0, 1.0, 0.125], [8.0, 0.5, 0.5, 512.0]])
    errors = np.stack([np.where(np.arange(4) < J, course, np.nan) for J in (3, 4)], axis=1)
    dims = ("scheme", "trials", "sample", "trial")
    dataset = xr.Dataset(
        {"settled_error": (dims, errors[:, :, None]), "finite": (dims, errors[:, :, None] > 0),
         "diverged_at": (dims[:-1], np.zeros((2, 2, 1), int))},
        {"scheme": ["sure", "fast"], "trials": [3, 4], "sample": [0], "trial": range(1, 5)},
        {"configuration": {}},
    )  # fmt: skip
    of_file = Request(str(tmp_path / "two.toml"))
    found = outcomes.sweep(
        of_file, machines=1, grid="trials=3,4", folder=tmp_path, run=lambda *of, **how: dataset
    )
    assert found.verdict.said[0] == "sure has its least error at trials = 4."
    assert found.verdict.said[3].startswith(
        "sure is best of 2 schemes: the only machine ends within"
    )
    assert "0.125 mm" in found.verdict.said[3]
    _, of_command = parsed(found.verdict)
    assert (of_command["scheme"], of_command["trials"]) == (["sure"], 4)
    yields, spread, by_trial = (
        [[str(cell) for cell in column.cells] for column in table.columns]
        for table in found.tables[1:4]
    )
    assert yields[1] == spread[1] == ["4", "3"]
    assert yields[2] == ["100.0%", "0.0%"]
    assert spread[4] == ["0.125", "0.5"]
    assert by_trial == [
        ["1", "2", "3", "4"],
        ["8 (8)", "4 (4)", "1 (1)", "0.125 (0.125)"],
        ["8 (8)", "0.5 (0.5)", "0.5 (0.5)", "–"],
    ]


def test_the_growth_of_a_run_leaves_experiments_out():
    """The experiments err more, of which the last trial is one."""
    machine = Machine(StateSpace([[0.5]], [[0.5]], [[1.0]], dt=1e-3))
    task = Task(np.sin(np.linspace(0, 2 * np.pi, 41)), dt=1e-3)
    s = Scenario(
        "a", "a", machine, task, {"ilc": ModelFreeGradient(step=2.6, amplitude=5.0)}, 6, {}
    )
    dataset, _ = run_schemes(machine, s.schemes, task, 6)
    row, rms = run_numbers(s, dataset)["schemes"]["ilc"], dataset["rms"].values.ravel()
    assert row["grown_from"] == 5
    assert (row["best"], row["grown_to"]) == (1, pytest.approx(rms[4] / rms[0]))
    assert rms[5] > 3 * rms[4]


def test_an_experiment_at_the_end_of_a_sweep_says_nothing_of_what_was_learned(tmp_path):
    """It errs more than the trial before, and its machines have neither grown nor failed."""
    (tmp_path / "one.toml").write_text(
        f"tolerance = 3.0\n{AXIS}[schemes.ilc]\nclass = 'ModelFreeGradient'\nstep = 0.5\n"
    )
    errors = [[[8.0, 100, 2, 50], [9, 100, 1, 50]]]
    dataset = sweep_of(errors, ("ilc",), "settled_error").assign_attrs(configuration={})

    def asked(dataset):
        of_file = Request(str(tmp_path / "one.toml"))
        return outcomes.sweep(of_file, folder=tmp_path, run=lambda *of, **how: dataset)

    found = asked(dataset)
    row = found.numbers["schemes"]["ilc"]
    assert (row["yield"], row["semi_converged"], [*row["by_trial"]][-1]) == (1.0, 0.0, "3")
    assert "all 2 machines end within 3 mm; 95 % of them end with" in found.verdict.said[0]
    assert "of at most 2 mm" in found.verdict.said[0]
    assert "of trial 3" in str(found.tables[0].title)
    of_axis = asked(dataset.assign_coords(trials_of_step=("scheme", [3]))).numbers["schemes"]["ilc"]
    assert (of_axis["yield"], [*of_axis["by_trial"]][-1]) == (0.0, "4")
    lost = dataset.assign(finite=dataset["trial"] < 4, diverged_at=(("scheme", "sample"), [[4, 4]]))
    assert asked(lost).numbers["schemes"]["ilc"]["diverged"] == 1.0


def test_sweep_says_yield_worst_machine_and_what_is_lost():
    high = [float(x) for x in 0.01 + 0.7**J]
    found = swept(CASE, 1.0, high, 0.015)
    assert found.said == (
        "ilc: all 64 machines end within 0.02 mm; 95 % of them end with a settled error of at most "
        "0.01 mm, the worst (machine 5) with 0.015 mm.",
        "The 95 % settled error has settled since trial 22.",
    )
    assert parsed(found)[0] == "certify"
    found = swept(CASE, 0.75, high, 0.03)
    assert found.said[0].startswith(
        "ilc: 75.0 % of 64 machines (95 % interval 50.0 % to 100.0 %) end"
    )
    assert parsed(found)[0] == "design"
    name, params = parsed(swept(CASE._replace(designable=False), 0.75, high, 0.03))
    assert (name, params["scheme"]) == ("worst-case", "ilc")
    found = swept(CASE._replace(designable=False, uncertain=False), 0.75, high, 0.03)
    assert found.said[-1].startswith("Only noise tells these machines apart")
    assert parsed(found)[0] == "certify"
    found = swept(CASE, None, high, np.inf, diverged=1 / 64, diverged_at=9)
    assert found.said == (
        "ilc: 95 % of 64 machines end with a settled error of at most 0.01 mm, the worst (machine "
        "5) with one that has diverged.",
        "1.6 % of the machines diverge, the first in trial 9.",
    )
    assert parsed(found)[0] == "design"
    ends = {"yield_interval": wilson_interval(4095, 4096), "diverged": 1 / 4096, "diverged_at": 9}
    found = swept(CASE, 4095 / 4096, high, np.inf, 4096, **ends)
    said = "ilc: 99.98 % of 4096 machines (95 % interval 99.9 % to 99.996 %)"
    assert said in found.said[0], "only where no machine failed it reaches to 100.0 %"
    assert found.said[1].startswith("0.02 % of the machines diverge")
    found = swept(CASE, None, [*high[:-1], math.inf], np.inf, semi_converged=0.5, grown_to=3.0)
    assert "fewer than 95 % of 64 machines end with an error that has not diverged" in found.said[0]
    grown = "On 50.0 % the settled error has grown up to 3 times since its best trial."
    assert found.said[1] == grown
    for share, said in (
        (1.0, "the only machine ends within 0.02 mm; it ends with a settled error of 0.01 mm."),
        (0.0, "the only machine does not end within 0.02 mm; it ends with a settled error of 0.01"),
        (None, "the only machine ends with a settled error of 0.01 mm."),
    ):
        assert f"ilc: {said}" in swept(CASE, share, high, high[-1], machines=1).said[0]
    for metric, said in (
        ("contour max", "a largest contour error"),
        ("max error", "a largest error"),
        ("rms", "an rms error"),
        ("jerk", "a jerk"),
    ):
        found = swept(CASE._replace(metric=metric), None, high, 0.03)
        assert f"95 % of 64 machines end with {said} of at most 0.01 mm" in found.said[0]


def test_list_shows_a_value_that_can_be_set():
    values = {"machine.plant.dt": np.float64(0.001), "ilc.lead": 3, "ilc.gamma_p": np.array(0.8)}
    values |= {"ilc.leak": np.array(0.0), "ilc.b": np.array(4.0)}

    def tried(settings):
        if "ilc.gamma_p" in settings:
            raise ValueError("outside its allowed range")

    found = list_verdict(CASE, values, ["plant"], dict)
    assert found.said == ("6 values can be set in my axis.toml.",)
    assert parsed(found)[1]["set_"] == ["ilc.gamma_p=0.4"], "another value than the one there"
    assert parsed(list_verdict(CASE, values, [], tried))[1]["set_"] == ["ilc.b=2"]
    del values["ilc.b"]
    assert parsed(list_verdict(CASE, values, [], tried))[1]["set_"] == []
    assert parsed(list_verdict(CASE._replace(learns={}), values, [], dict))[0] == "design"


# certify, and its tables
# --------------------------------------------------------------------------------------------------


def certificate(reasons, floor=None, observed="falls", grows=(None, None, None, 0)):
    kinds = ("monotone", "converges", "diverges", "not claimed")
    courses = ("falls", "falls, not always", "turns", "grows")
    machines = sum(sum(of.values()) for of in reasons.values())
    return {
        "claims": {kind: sum(reasons.get(kind, {}).values()) for kind in kinds}, "reasons": reasons,
        "floor": floor, "senses": {}, "first": None, "quantile": None, "rounding": None,
        "held_by": None, "most": None,
        "observed": {course: machines * (course == observed) for course in courses},
        "expected": {course: machines * (course == "falls") for course in courses},
        "confusion": {c: dict.fromkeys(courses, 0) for c in courses}, "monotone_in_the_error": 0,
        "turning": {"predicted": 1.0, "observed": 1.0},
        "transient": dict(zip(("growth", "trial", "of_noise", "machines"), grows, strict=True)),
        "bound": {"holds": 0, "fails": 0, "not claimed": machines}, "care": None,
        "premises": {"lam > b^2 / 4 and some more words": {"held": 0, "share_broken": 0.5}},
    }  # fmt: skip


def test_certify_says_what_is_certified_what_not_and_why():
    sure = certificate({"monotone": {"x": 3}, "converges": {"y": 5}}, 0.004)
    doubt = certificate({"monotone": {"x": 6}, "not claimed": {"it is nonlinear": 2}}, 0.001)
    found = certify_verdict(CASE._replace(learns={"a": 1, "b": 1}), {"b": doubt, "a": sure}, 1e3)
    assert found.said == (
        "b is not certified on 2 of 8 machines: it is nonlinear.",
        "a is certified on all 8 machines: learning converges, on 3 of them in every trial and "
        "leaves an rms error of at most 4 mm.",
    )
    name, params = parsed(found)
    assert (name, params["scheme"], str(params["scenario"])) == ("next", "a", "my axis.toml")
    published = Case(Request("cao-2019"), {"a": True})
    assert parsed(certify_verdict(published, {"a": sure}, 1.0))[0] == "worst-case"
    bad = certificate({"diverges": {"an eigenvalue": 1}, "monotone": {"x": 7}}, 0.1)
    found = certify_verdict(CASE, {"ilc": bad}, 1.0)
    assert found.said == ("ilc diverges on 1 of 8 machines: an eigenvalue.",)
    turns = bad | {"expected": bad["expected"] | {"falls": 7, "turns": 1}}
    said = certificate_sentence("ilc", 5, turns, 1, "")
    assert ", 1 diverges. Within 5 trials 1 of 8 machines by theory and 0 by simulation" in said
    assert parsed(found)[0] == "design"
    assert parsed(certify_verdict(published, {"a": doubt}, 1.0))[0] == "sweep"
    one = certify_verdict(CASE, {"ilc": certificate({"diverges": {"an eigenvalue": 1}}, 0.1)}, 1.0)
    assert one.said == ("ilc diverges on the nominal machine: an eigenvalue.",)
    turns = certificate({"not claimed": {"it is nonlinear": 2}}, None, "turns")
    assert parsed(certify_verdict(published, {"a": turns}, 1.0))[0] == "worst-case"
    turns["expected"]["turns"] = 1
    said = certifying.certificate_sentence("a", 5, turns, 1.0, "mm")
    assert "1 of 3 machines by theory and 2 by simulation turned after a best trial" in said
    near = {"MILC": {"value": 1 - 2e-7, "verdict": "holds", "broken": []}}
    assert "0.9999998 is below 1" in certifying.printed_lines("a", {"printed": near})[0]
    assert [*map(beside_1, (1, 1 + 1e-9, 0.99951))] == ["1", "1.000000001", "0.9995"]


def test_certify_sends_no_law_to_the_machine_whose_noise_is_not_followed():
    still = certificate({"monotone": {"x": 1}}, 0.0) | {"senses": {"but for noise": 1}}
    found = certify_verdict(CASE._replace(learns={"a": 1, "b": 1}), {"b": still}, 1.0)
    assert found.said == (
        "b is certified on the nominal machine: learning is monotone, but for noise, and leaves "
        "without its noise, which is followed for up to 1024 inputs only, an rms error of at most "
        "0 mm.",
    )
    name, params = parsed(found)
    assert (name, list(params["scheme"])) == ("sweep", ["b"])
    worse = certificate({"monotone": {"x": 1}}, 0.004)
    both = certify_verdict(CASE._replace(learns={"a": 1, "b": 1}), {"b": still, "a": worse}, 1.0)
    assert (parsed(both)[0], parsed(both)[1]["scheme"]) == ("next", "a")


def test_certify_tells_a_growth_before_the_fall_and_does_not_send_it_to_the_machine():
    lies = certificate({"converges": {"x": 1}}, 1e-9, grows=(1.207e11, 14, 4.6e11, 1))
    found = certify_verdict(CASE, {"ilc": lies}, 1.0)
    assert found.said == (
        "ilc is certified on the nominal machine: learning converges and leaves an rms error of at "
        "most 1.00e-09 mm. Before it falls, the error grows up to 1.21e+11 times, until trial 14, "
        "and noise can grow about 4.60e+11 times.",
    )
    assert parsed(found)[0] == "design"
    some = certificate({"converges": {"x": 4}, "monotone": {"y": 4}}, 1e-9, grows=(3.0, 5, None, 2))
    sure = certificate({"monotone": {"x": 8}}, 1e-3)
    found = certify_verdict(CASE._replace(learns={"a": 1, "b": 1}), {"a": some, "b": sure}, 1.0)
    assert "the error of 2 of 8 machines grows up to 3 times, until trial 5." in found.said[0]
    name, params = parsed(found)
    assert (name, params["scheme"]) == ("next", "b")


def test_tables_of_certify_fit_80_columns_and_reasons_stand_below_them():
    reason = "the distance from the limit falls to 0.982523 to 0.982817 of itself in every trial"
    numbers = certificate({"monotone": {reason: 1234}}, 0.1)
    console = Console(width=80)
    with console.capture() as captured:
        for table in certifying.certificate_tables("cfdl-mfailc", 200, numbers):
            console.print(table)
    text = captured.get()
    assert max(map(len, text.splitlines())) <= 80
    assert text.count("┏") == 3, "no table is divided"
    assert reason not in " ".join(text.split())
    lines = certifying.reason_lines("cfdl-mfailc", numbers)
    assert lines == [f"cfdl-mfailc, monotone on 1234: {reason}."]


# tune, pareto and worst-case
# --------------------------------------------------------------------------------------------------

ASKED = Request("cao-2019", ("c",), ("c.lead=2", "plant=printed"), "old.json", 15, 0.2)
OF_TUNING = Case(ASKED, {"c": True}, unit="µm")


def tuned(tuned_worst=1.0, **held):
    at = {"given": {"median": 1.2, "worst": 3.0}, "tuned": {"median": 0.4, "worst": tuned_worst}}
    return {
        "scheme": "c",
        "trials": 15,
        "samples": 257,
        "drawn": "machines",
        "diverged": {"given": 1.0, "tuned": 0.75},
        "weights": {"lam": {"given": 1.0, "tuned": 0.5}},
        "held_out": {"step": 7, "steps": 20, "reason": "steps", "given": 2.0, "tuned": 1.0} | held,
        "figures": {"settled_error": {which: {"15": row} for which, row in at.items()}},
    }


def test_tune_says_what_was_gained_and_what_is_next(tmp_path):
    params = tmp_path / "params.json"
    found = tune_verdict(OF_TUNING, tuned(), params)
    assert found.said == (
        "lam = 0.5 (was 1): of 257 machines, the nominal one and 256 not seen, the median settled "
        "error of trial 15 is 0.4 µm in place of 1.2 µm, the worst 1 µm in place of 3 µm.",
    )
    name, options = parsed(found)
    assert (name, options["params"], options["scheme"]) == ("sweep", params, ["c"])
    assert options["set_"] == ["plant=printed"], "the file of parameters holds those of the scheme"
    assert "become worse" in tune_verdict(OF_TUNING, tuned(4.0), params).said[1]
    last = tune_verdict(OF_TUNING, tuned(step=20), params).said[1]
    assert last == "The last step was the best: more --steps, in another --out, may gain more."
    bounded = tuned(step=20)
    for end, low, high in ((0.49, 0.49, 2.0), (0.501, -1.0, 0.501), (50.0, 1e-4, 50.0)):
        bounded["weights"]["lam"] |= {"range": [low, high], "end": end}
        said = f"lam has come to the end {end:g} of its range, {low:g} to {high:g}"
        bounded_said = tune_verdict(OF_TUNING, bounded, params).said[1:]
        assert bounded_said == (f"{said}: beyond it may be a better value.", last)
    bounded["weights"]["lam"].pop("end")
    assert tune_verdict(OF_TUNING, bounded, params).said[1:] == (last,)
    hardly = tuned(2.98)
    hardly["figures"]["settled_error"]["tuned"]["15"]["median"] = 1.19
    assert tune_verdict(OF_TUNING, hardly, params).said[1] == (
        "That is 0.83 % less at best: the weights as given are about as good."
    )
    hardly["figures"]["settled_error"]["tuned"]["15"] = {"median": 1.32, "worst": 3.6}
    assert tune_verdict(OF_TUNING, hardly, params).said[1] == (
        "That is 10 % more at least: the weights as given are better in this."
    )
    other = tune_verdict(OF_TUNING, hardly, params, by_last=False).said[1:]
    assert other == (
        "The objective is another than this error: on the machines held out its loss is 1 in "
        "place of 2.",
    ), "a larger error of the last trial does not tell that the weights as given are better"
    alike = tuned() | {"drawn": ""}
    assert tune_verdict(OF_TUNING, alike, params).said[0] == (
        "lam = 0.5 (was 1): the settled error of trial 15 is 0.4 µm in place of 1.2 µm."
    )
    noisy = tune_verdict(OF_TUNING, tuned() | {"drawn": "runs"}, params).said[0]
    assert "1): of 257 runs of the machine, each drawn anew, the median settled error" in noisy
    diverging = tuned(np.inf)
    for of in diverging["figures"]["settled_error"].values():
        of["15"] = dict.fromkeys(("median", "worst"), np.inf)
    assert tune_verdict(OF_TUNING, diverging, params).said == (
        "lam = 0.5 (was 1): of 257 machines, the nominal one and 256 not seen, 75.0% diverge "
        "within 15 trials, and with the weights as given all.",
    )
    another_start = tuned(step=0)
    assert tune_verdict(OF_TUNING, another_start, params).said == found.said
    another_start["weights"]["lam"]["tuned"] = 1.0
    for numbers in (another_start, tuned(tuned=2.0), tuned(tuned=2.1)):
        nothing = tune_verdict(OF_TUNING, numbers, params)
        assert "No step judged" in nothing.said[0]
        assert parsed(nothing)[1]["params"].name == "old.json"
    certain = tune_verdict(OF_TUNING._replace(uncertain=False), another_start, params)
    assert parsed(certain)[0] == "certify", "worst-case needs machines to draw"
    none = tuned(given=np.inf, tuned=np.inf, step=0, steps=0)
    assert "No machine has a finite loss" in tune_verdict(OF_TUNING, none, params).said[0]


@pytest.mark.parametrize(
    ("uncertain", "machines", "said"),
    [
        (True, 9, "9 machines"),
        (False, 9, "9 runs of the machine, each drawn anew"),
        (True, 1, "the machine, nothing being drawn"),
    ],
)
def test_a_table_says_what_differs_among_the_machines_of_a_tuning(uncertain, machines, said):
    """Errors are alike where all diverge, and those of the same machine differ by its noise."""
    alike = {"20": dict.fromkeys(("median", "worst"), np.inf)}
    noisy = {"1": {"median": 1.0, "worst": 1.0 if machines == 1 else 1.1}} | alike
    assert _over(machines, _drawn(uncertain, machines, alike, noisy)).split(":")[0] == f"of {said}"
    assert not _drawn(False, machines, alike)


def test_a_weight_has_come_to_an_end_only_where_it_moved_there_and_may_go_on():
    """A weight of a cost is not below 0, so that nothing is said of that end."""
    plant = StateSpace([[0.5]], [[1.0]], [[1.0]], dt=1e-3)
    problem = Tuning(
        Machine(plant), NormOptimal(plant, w_r=0.5), Task(np.ones(4), dt=1e-3), 2,
        {"w_q": (0.5, 2.0), "w_r": (0.0, 1.0)},
    )  # fmt: skip
    for name, given, value, end in (
        ("w_q", 1.0, 0.501, 0.5), ("w_q", 1.0, 1.999, 2.0), ("w_q", 1.0, 0.6, None),
        ("w_q", 0.502, 0.501, None), ("w_q", 0.5, 0.501, None), ("w_q", 0.5, 1.999, 2.0),
        ("w_r", 0.5, 0.999, 1.0), ("w_r", 0.5, 0.001, None), ("w_r", 0.01, 0.008, None),
    ):  # fmt: skip
        assert _end_reached(problem, name, {"given": given, "tuned": value}) == end


def test_the_range_of_each_element_is_told_as_it_was_asked_for():
    law = LearningFilter([[0.0, 0.5, 0.1], [0.1, 0.4, 0.0]], starts=(2,))
    plant, asked = StateSpace([[0.5]], [[1.0]], [[1.0]], dt=1e-3), "L[0][1]=0:1,L[0]=-2:3,L[1]"
    of = Machine(plant), law, Task(np.ones(5), dt=1e-3), 2
    problem = Tuning(*of, weights_of(asked), machines=1, held_out=0)
    rows = {name: {"given": x, "tuned": x} for name, x in problem.start.items()}
    _tell_ranges(problem, asked, rows)
    found = {name: row.get("range") for name, row in rows.items()}
    ends = {"L[0][0]": [-2.0, 3.0], "L[0][1]": [0.0, 1.0], "L[0][2]": [-2.0, 3.0]}
    assert found == dict.fromkeys(f"L[1][{i}]" for i in range(3)) | ends


def test_a_tuning_is_for_the_error_of_the_last_trial_or_for_more():
    """A tuning of 15 trials, which is compared at its last trial, or at another one."""

    def judged(text, trial=15):
        objective = objective_of(text, "settled_error", lambda metric: 1.0)
        return is_error_of(mock.Mock(objective=objective, trials=15), "settled_error", trial)

    assert judged("final")
    assert judged("final:15")
    assert judged("final:20", 20)
    for other in ("trials-to:50", "final@rms", "final:14", "every-trial", "final+0.1*effort"):
        assert not judged(other)
    assert not judged("final", 20)


@pytest.mark.parametrize(
    ("reason", "said"),
    [
        ("steps", ""),
        ("patience", ", where it stopped, as no later one was better"),
        ("no machine has a finite loss",
         ", where it stopped, as no machine had a finite loss there"),
    ],
)  # fmt: skip
def test_a_tuning_that_ended_early_says_why(reason, said):
    found = mock.Mock(step=1, loss=np.zeros((3, 2)), dropped=np.zeros(3), nudged={}, reason=reason)
    line, warnings = tuning_lines(found, {"held_out": {"given": 2.0, "tuned": 1.0}})
    assert (line, warnings) == (f"held-out loss 2 -> 1, step 1 of 3{said}", [])
    assert in_words(np.array([np.nan, 3.0]), 2.0) == "loss 3, held out 2"


def test_a_weight_that_starts_at_0_without_a_range_has_steps_that_suit_no_unit():
    given = {"gamma_p": None, "gamma_d": None, "leak": (0, 0.5), "gamma_i": (0, math.inf)}
    scheme = PIDType(1.0, gamma_d=0.0, gamma_i=0.0, leak=0.0)
    of = Weights.of(scheme, given)
    problem = mock.Mock(rate=0.1, start=of.start, bijections=of.bijections, optimiser="adam")
    (told,) = without_size(problem)
    assert ": gamma_d, gamma_i. So steps are 0.1" in told
    assert "gamma_d=LOW:HIGH" in told
    problem.optimiser = "lbfgs"  # whose line search finds the size of a step
    assert without_size(problem) == []


def test_a_trade_off_names_one_of_its_points(tmp_path):
    rows = {"given": (4.0, 4.0), "0.9": (1.0, 9.0), "0.5": (2.0, 3.0), "0.1": (6.0, 2.5)}
    ended = {"step": 100, "steps": 200, "reason": "steps"}
    points = {
        share: {"first": row[0], "second": row[1], "held_out": ended} for share, row in rows.items()
    }
    numbers = {"trials": 15, "points": points}
    found = front_verdict(OF_TUNING, "c", numbers, tmp_path, ("final", "effort"))
    assert found.said == (
        "The point of share 0.5 is nearest to the least of both: final is 2 and effort 3, in place "
        "of 4 and 4 with the weights as given.",
        "Over 3 points final goes from 1 to 6, effort from 9 to 2.5.",
    )
    assert parsed(found)[1]["params"] == tmp_path / "params-share-0.5.json"
    budgets = {
        J: {"tuned": {"median": m, "worst": 2 * m}, "given": {"median": 9.0, "worst": 10.0},
            "held_out": ended}
        for J, m in (("5", 3.0), ("10", 1.04), ("20", 1.0))
    }  # fmt: skip
    numbers = {"samples": 33, "budgets": budgets}
    found = budget_verdict(OF_TUNING, "c", numbers, tmp_path)
    assert found.said[0].startswith(
        "10 trials are enough for a median settled error within 5 % of the least of 3 budgets: "
        "1.04 µm, in place of 9 µm"
    )
    budgets["20"]["tuned"]["median"] = 0.78
    last = budget_verdict(OF_TUNING, "c", numbers, tmp_path).said[0]
    assert last.startswith(
        "20 trials, the largest of 3 budgets, still leave 25 % less than the others, so that more "
        "may leave less: a median settled error of 0.78 µm, in place of 9 µm"
    )
    name, options = parsed(found)
    assert (name, options["trials"]) == ("run", 10)
    assert options["params"] == tmp_path / "params-10-trials.json"
    for row in budgets.values():
        row["tuned"]["median"] = math.inf
    none = budget_verdict(OF_TUNING, "c", numbers, tmp_path)
    assert (none.said, none.following) == (("No number of trials leads to a finite error.",), "")


def test_a_trade_off_says_which_of_its_tunings_had_not_ended(tmp_path):
    """One whose best step is not its last, or that stopped by itself, is not named."""
    held = (
        {"step": 9, "steps": 9, "reason": "steps"},
        {"step": 9, "steps": 9, "reason": "patience"},
        {"step": 8, "steps": 9, "reason": "steps"},
        {"step": 9, "steps": 9, "reason": "steps"},
    )
    points = {
        share: {"first": x, "second": 1 / x, "held_out": one}
        for share, x, one in zip(
            ("0.1", "0.3", "0.5", "0.7"), (4.0, 3.0, 2.0, 1.0), held, strict=True
        )
    }
    points["given"] = {"first": 5.0, "second": 5.0}
    numbers = {"trials": 15, "points": points}
    assert front_verdict(OF_TUNING, "c", numbers, tmp_path, ("final", "effort")).said[2:] == (
        "The last step was the best for share 0.1, 0.7: more --steps, in another --out, may gain "
        "more.",
    )
    error = {"median": 1.0, "worst": 1.0}
    budgets = {
        J: {"tuned": error, "given": error, "held_out": one}
        for J, one in zip(("5", "10", "20", "40"), held, strict=True)
    }
    numbers = {"samples": 33, "budgets": budgets}
    assert budget_verdict(OF_TUNING, "c", numbers, tmp_path).said[1:] == (
        "The last step was the best for 5, 40 trials: more --steps, in another --out, may gain "
        "more.",
    )


def searched(**found):
    """Return a search, with what it found in place of the usual, and the numbers of it alone."""
    search = {"value": 7.0, "loss": 1.0, "set": ["x=1"], "needed": 24, "over_noise": None} | found
    return search, {"nominal": 2.0, "trial": 15, "searches": {"gradient": search}}


def test_worst_case_leads_to_its_machine():
    search, numbers = searched(set=["machine.plant.poles[0]=7.5"])
    found = worst_case_verdict(OF_TUNING._replace(tolerance=5.0), "c", numbers)
    assert found.said == (
        "c: the worst machine has a settled error of 7 µm in trial 15, 3.5 times that of the "
        "nominal machine; found by gradient, in 24 simulations.",
        "It is beyond the tolerance of 5 µm.",
    )
    name, options = parsed(found)
    assert name == "run"
    assert options["set_"] == [*ASKED.set, "machine.plant.poles[0]=7.5"]
    numbers["searches"]["gradient"] |= {"value": math.inf, "set": ["x=1"] * 99}
    found = worst_case_verdict(OF_TUNING, "c", numbers)
    assert found.said == (
        "c: the worst machine diverges within 15 trials; found by gradient, in 24 simulations.",
    )
    assert parsed(found)[0] == "certify"
    found = worst_case_verdict(OF_TUNING, "c", numbers | {"nominal": math.inf})
    assert "diverges within 15 trials, as the nominal one does;" in found.said[0]
    search |= {"value": 7.0}
    sooner = search | {"loss": 0.9999, "value": 6.995, "needed": 5}
    numbers["searches"] |= {"gradient": search, "chance": sooner}
    said = worst_case_verdict(OF_TUNING, "c", numbers).said[0]
    assert said.endswith("found by chance, in 5 simulations."), "as bad a machine, and sooner"
    numbers["searches"]["chance"] = sooner | {"needed": 1}
    said = worst_case_verdict(OF_TUNING, "c", numbers | {"trial": 1}).said[0]
    assert said.endswith("found by chance, in 1 simulation.")
    # 0.3 % and 0.07 % less than 7 µm; far below the floor of the loss errors have the same loss
    for error, name, loss in ((6.98, "gradient", 1.0), (6.995, "chance", 0.99)):
        numbers["searches"]["chance"] = sooner | {"value": error, "loss": loss}
        assert f"found by {name}" in worst_case_verdict(OF_TUNING, "c", numbers).said[0]
    for loss, name in ((0.99, "gradient"), (0.9999, "chance")):  # of errors that diverge
        numbers["searches"] = {
            "gradient": search | {"value": math.inf},
            "chance": sooner | {"value": math.inf, "loss": loss},
        }
        assert f"found by {name}" in worst_case_verdict(OF_TUNING, "c", numbers).said[0]


def test_a_worst_machine_with_noise_is_judged_by_many_draws_of_it():
    """Within the tolerance with the draw that was searched with, but not with 5 % of others."""
    search, numbers = searched(over_noise=9.0)
    said = worst_case_verdict(OF_TUNING._replace(tolerance=8.0), "c", numbers).said
    assert said[1:] == (
        "That is with one draw of its noise: with 100 others, the error that 95% of them do not "
        "exceed is 9 µm.",
        "It is beyond the tolerance of 8 µm.",
    )
    search["value"] = math.inf
    said = worst_case_verdict(OF_TUNING._replace(tolerance=8.0), "c", numbers).said
    assert said[1:] == ("It is beyond the tolerance of 8 µm.",)


def test_where_nothing_that_is_drawn_matters_no_machine_is_the_worst():
    search, numbers = searched(value=2.0005)
    found = worst_case_verdict(OF_TUNING._replace(tolerance=5.0), "c", numbers)
    assert found.said[0] == (
        "c: of the machines that were tried none is worse by 0.1 % than the nominal one, whose "
        "settled error in trial 15 is 2 µm."
    )
    assert parsed(found)[0] == "certify"
    numbers["searches"]["chance"] = search | {"value": 2.0022, "loss": 1.0009, "needed": 99}
    assert "worst machine" in worst_case_verdict(OF_TUNING, "c", numbers).said[0]


def test_a_search_within_two_standard_deviations_says_what_it_draws_and_how_many_lie_outside():
    """Of a normal distribution 4.55 % lie beyond two deviations, of two at once 8.89 %."""
    normal, uniform = Normal(1.0, 0.1), Uniform(0.9, 1.1)
    assert outside({"a": uniform}) == (0.0, "")
    share, said = outside({"a": uniform, "b": normal})
    assert abs(share - 0.0455003) < 1e-7
    assert said == (
        "The search stays within two standard deviations of the mean of b, beyond which 4.6 % of "
        "the machines lie, and its draws are spread evenly there, unlike those of a sweep."
    )
    assert "of b, c, beyond which 8.9 % of" in outside({"b": normal, "c": normal})[1]
    assert worst_case_verdict(OF_TUNING, "c", searched()[1], said).said[-1] == said


# reproduce
# --------------------------------------------------------------------------------------------------


def test_reproduce_leads_to_the_number_that_is_farthest():
    def row(verdict, ratio, trial=None, options=(), fitted=NOTHING, agreement=None):
        printed = Published(
            "pid", trial, "rms", 2.0, "Table 1", options, fitted=fitted, agreement=agreement
        )
        return Row("dai-2014", printed, 2.0 * ratio, ratio, "mm", verdict)

    rows = [
        row("met", 1.1),
        row("open", 2.5, options=(("plant", "printed"),), fitted=Fit(("a",), "b", among=True)),
        row("open", 0.2, 3, (("frequency", 2.5),)),
        row("shape", 1.9),
    ]
    found = reproduce_verdict(rows)
    assert found.said == (
        "Of 4 independent printed numbers 1 are met within 30 % or as bounds (0 within 10 %, 0 "
        "within 3 %), 1 have the printed order, 2 are open. fitted: 0 of 1 met; predicted: 1 of 3 "
        "met.",
        "The farthest open one is that of dai-2014, pid, trial 3: ours is 0.2 times the printed 2 "
        "mm.",
    )
    assert parsed(found)[1]["set_"] == ["frequency=2.5"]
    assert "The farthest one is" in reproduce_verdict(rows[:1]).said[1]
    close = [row("agrees", 1 + d, agreement=1e-6) for d in (0.0, -3e-7)]
    assert reproduce_verdict(close).said == (
        "2 of 2 numbers of other software agree, 0 open.",
        "The farthest one is that of dai-2014, pid: ours differs by 3e-07 of the 2 mm of other "
        "software.",
    )
    assert _by_paper(close, []) == [], "a table without rows"
    (table,) = _by_paper([*rows, *close], [])
    assert table.row_count == 1
    both = reproduce_verdict([*rows, row("open", 1.02, agreement=1e-6)]).said[0]
    assert both.endswith("1 of 3 met. 0 of 1 numbers of other software agree, 1 open.")


def test_the_farthest_number_is_one_that_a_paper_prints_first():
    """Derived and repeated numbers lead on only alone; a comparison leads to both schemes."""
    printed = Published("milc", 11, "table_rms", 2.0, "Table 1", fitted=NOTHING)
    less = printed._replace(quantity="table_rms_improvement", kind="derived", against="dilc")
    rows = [
        Row("milc-2024", printed, 1.8, 0.9, "µm", "met"),
        Row("milc-2024", printed._replace(kind="repeated"), 3.8, 1.9, "µm", "open"),
        Row("milc-2024", less, 1.4, 0.7, "%", "met"),
    ]
    found = reproduce_verdict(rows)
    assert found.said[1].startswith("The farthest one is that of milc-2024, milc, trial 11: ours ")
    assert found.said[1].endswith("is 0.9 times the printed 2 µm.")
    assert parsed(found)[1]["scheme"] == ["milc"]
    assert parsed(reproduce_verdict(rows[2:]))[1]["scheme"] == ["milc", "dilc"]
