"""The commands that tune and search give the numbers of the library, and they can be resumed.

Parameter files, worst machines that are built again, and mistakes of users are tested here too.
"""

import dataclasses
import json
import shlex
from unittest import mock

import numpy as np
import pytest
from cases import first_order, follows, known_to, p_type
from command import call, done, flat, mistakes, refused

import jaxilc
from jaxilc import figures, outcomes
from jaxilc.filters import ZeroPhaseButterworth
from jaxilc.outcomes import Request
from jaxilc.outcomes.terms import limits_not_met, objective_of, risk_of, with_limits
from jaxilc.outcomes.words import number
from jaxilc.plants import StateSpace
from jaxilc.runtime.provenance import describe
from jaxilc.scenarios.parameters import (
    differing,
    warn_of_another,
    with_parameters,
    write_parameters,
)
from jaxilc.schemes import CFDLMFAILC, Filtered, PIDType
from jaxilc.storage.sealed import as_json
from jaxilc.tuning import Tuning, monte_carlo_search, trade_off
from jaxilc.tuning import descent as of_tuning
from jaxilc.tuning import worst_case as of_worst
from jaxilc.tuning.objectives import (
    D2,
    Contraction,
    Effort,
    EveryTrial,
    Final,
    Growth,
    Holding,
    InputRate,
    TrialsTo,
)
from jaxilc.tuning.risks import CVaR, Mean, SmoothMax, Worst
from jaxilc.tuning.trade_off import Point, held_out_losses
from jaxilc.uncertainty import Uniform, with_spread

SHORT = ("--set", "frequency=50")  # 20 samples a trial
TUNE = (
    *("--scheme", "ilc", "--set", "ilc.lead=1", "--weights", "gamma_p=0.1:8,gamma_d"),
    *("--objective", "final+0.3*growth@max_error", "--risk", "cvar:0.5", "--trials", 4),
    *("--machines", 3, "--held-out", 2, "--steps", 3, "--unseen", 4, "--spread", 0.2),
)
PARETO = (
    *("pareto", "axis.toml", "--scheme", "ilc", "--weights", "gamma_p=0.1:8"),
    *("--set", "ilc.lead=1", "--machines", 3, "--held-out", 2, "--steps", 2, "--seed", 1),
)
AXIS = (
    f'judged_by = "settled_error"\n{first_order()}unit = "mm"\n{follows(50.0, 0.02)}'
    + p_type(1.0)
    + known_to(0.2)
)


pytestmark = pytest.mark.usefixtures("compiled_once")


@pytest.fixture(scope="module")
def scenario():
    return jaxilc.scenarios.load("cao-2019", frequency=50)


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("file") / "axis.toml"
    path.write_text(AXIS)
    return path


@pytest.fixture(scope="module")
def tuned(file, tmp_path_factory):
    """Return the folder of a tuning that was stopped and resumed, and what the command printed."""
    folder = tmp_path_factory.mktemp("tune")
    write, states = of_tuning.Folder.write, []

    def stop_at_two(self, state):
        write(self, state)
        states.append(state)
        if len(states) == 2:
            raise KeyboardInterrupt

    asked = ("tune", file, *TUNE, "--out", folder)
    with mock.patch.object(of_tuning.Folder, "write", stop_at_two):
        code, _, err = call(*asked)
        assert (code, "--resume goes on" in err) == (130, True)
        assert "add --resume" in refused(*asked)
        reports = ("--report", folder / "numbers.json", "--report", folder / "page.html")
        out = done(*asked, "--resume", *reports)
    assert len(states) == 3
    return folder, out


def test_a_tuning_that_is_stopped_before_it_writes_leads_to_no_folder(file, tmp_path):
    with mock.patch.object(Tuning, "run", side_effect=KeyboardInterrupt):
        code, _, err = call("tune", file, *TUNE, "--out", tmp_path / "new")
    assert (code, err.splitlines()[-1]) == (130, "stopped; nothing was done yet")
    assert not (tmp_path / "new").exists()


# tune
# --------------------------------------------------------------------------------------------------


def test_a_resumed_tuning_gives_the_numbers_of_the_library_at_once(tuned, file):
    folder, out = tuned
    s = jaxilc.load_scenario(file).with_values({"ilc.lead": 1})
    problem = Tuning(
        s.machine, s.schemes["ilc"], s.task, 4, {"gamma_p": (0.1, 8.0), "gamma_d": None},
        with_spread(s.uncertainty, 0.2), Final() + 0.3 * Growth("max_error"), CVaR(0.5), machines=3,
        held_out=2, steps=3,
    )  # fmt: skip
    found = problem.run()
    numbers = json.loads((folder / "numbers.json").read_text())
    assert {name: row["tuned"] for name, row in numbers["weights"].items()} == found.values
    assert (
        numbers["held_out"]["tuned"] == found.after < found.before == numbers["held_out"]["given"]
    )
    dataset = problem.compare(found, machines=4)
    for figure in ("settled_error", "max_error"):
        for which in ("given", "tuned"):
            row, errors = (
                numbers["figures"][figure][which]["2"],
                s.shown(figure)[0] * dataset[figure].sel(scheme=which, trial=2).values,
            )
            np.testing.assert_allclose(
                [row["worst"], row["median"]], [errors.max(), np.sort(errors)[1]], rtol=1e-12
            )
    assert f"{numbers['weights']['gamma_d']['tuned']:.6g}" in out
    assert out.splitlines()[-1] == f"Next, many machines: {numbers['next']}"
    assert flat(out).startswith(" ".join(numbers["verdict"]))
    words = ("sweep", str(file), "--scheme", "ilc", "--trials", "4", "--spread", "0.2")
    more = ("--params", str(folder / "params.json"))
    assert shlex.split(numbers["next"]) == ["jaxilc", *words, *more]
    assert all((folder / name).stat().st_size > 10_000 for name in ("loss.png", "learning.png"))
    page = (folder / "page.html").read_text(encoding="utf-8")
    assert all(part in page for part in ("jaxilc tune", "held-out loss", "<td>gamma_d</td>"))


@pytest.mark.thorough
def test_a_parameter_file_reaches_other_commands_and_set_goes_on_top(
    tuned, file, tmp_path, unpainted
):
    params = tuned[0] / "params.json"
    values = json.loads(params.read_text())["schemes"]["ilc"]
    assert values.keys() == {"gamma_p", "gamma_d", "lead"}, "what was set by hand belongs to it"
    run = ("run", file, "--params", params, "--trials", 4, "--set", "ilc.gamma_p=0.9")
    done(*run, "--out", tmp_path / "run", "--report", tmp_path / "run.json")
    s = jaxilc.load_scenario(file)
    scheme = jaxilc.pytree.replaced(s.schemes["ilc"], values | {"gamma_p": 0.9})
    ours = s.shown_scale * jaxilc.learn(s.machine, scheme, s.task, 4).settled_error[-1, 0]
    printed = json.loads((tmp_path / "run.json").read_text())["schemes"]["ilc"]
    np.testing.assert_allclose(printed["settled_error"]["4"], ours, rtol=1e-12)


@pytest.mark.parametrize(
    ("of", "message"),
    [("dai-2014", "'dai-2014', not of 'cao-2019'"), ("cao-2019", "pid, and none of cfdl-mfailc")],
)
@pytest.mark.parametrize("command", ["sweep", "certify", "tune", "worst-case", "next"])
def test_every_command_names_a_parameter_file_of_another_scenario_or_scheme(
    command, of, message, tmp_path
):
    file = write_parameters(tmp_path / "p.json", of, {"pid": {"kp": 1.0}}, {})
    where = ("--scenario",) if command == "next" else ()
    more = {"tune": ("--weights", "lam"), "next": ("--state", tmp_path / "out")}.get(command, ())
    asked = (*where, "cao-2019", "--scheme", "cfdl-mfailc", "--params", file, *more)
    said = refused(command, *asked, "--out", tmp_path / "out.csv")
    assert f"{file} has parameters of {message}" in said
    assert [*tmp_path.iterdir()] == [file]


# pareto
# --------------------------------------------------------------------------------------------------


@pytest.fixture
def axis(here):
    """Return the scenario of a small file, in the folder of which the command runs."""
    (here / "axis.toml").write_text(AXIS)
    return jaxilc.load_scenario("axis.toml").with_values({"ilc.lead": 1})


@pytest.mark.slow
def test_pareto_gives_the_losses_of_the_weights_that_it_writes(
    axis, tmp_path, unpainted, monkeypatch
):
    made = []
    monkeypatch.setattr(
        trade_off, "held_out_losses", lambda *of: made.append(of) or held_out_losses(*of)
    )
    objectives = ("--objective", "final", "--objective", "effort", "--shares", "0.2,0.95")
    reports = ("--report", tmp_path / "numbers.json", "--report", tmp_path / "page.html")
    asked = (*PARETO, *objectives, "--trials", 3, "--out", tmp_path)
    out = done(*asked, *reports)
    assert len(made) == 1, "they are compiled once"
    assert "add --resume" in refused(*asked)
    numbers = json.loads((tmp_path / "numbers.json").read_text())
    given, *shares = points = numbers["points"]
    assert sorted([*map(float, shares), *numbers["left_out"]]) == [0.2, 0.95]
    assert (given, bool(shares)) == ("given", True)
    problem = Tuning(
        axis.machine, axis.schemes["ilc"], axis.task, 3, {"gamma_p": (0.1, 8.0)}, axis.uncertainty,
        machines=3, held_out=2, steps=2, seed=1,
    )  # fmt: skip
    losses = held_out_losses(problem, Final(), Effort())
    for which, row in points.items():
        weights = problem.start if which == "given" else row["weights"]
        np.testing.assert_allclose([row["first"], row["second"]], losses(weights), rtol=1e-12)
    for share in shares:
        assert f"{points[share]['second']:.6g}" in out
        params = json.loads((tmp_path / f"params-share-{share}.json").read_text())
        assert params["schemes"]["ilc"] == points[share]["weights"] | {"lead": 1}
        machine = params["obtained"]["configuration"]["machine"]
        assert machine == as_json(describe(axis.machine)), "of which another one is told"
    assert (tmp_path / "front.png").exists()
    assert "share of first" in (tmp_path / "page.html").read_text()


@pytest.mark.slow
def test_budgets_of_trials_are_judged_at_their_own_trial(axis, tmp_path, unpainted):
    report = ("--unseen", 1, "--out", tmp_path, "--report", tmp_path / "numbers.json")
    out = done(*PARETO, "--budgets", "2,4", *report)
    budgets = json.loads((tmp_path / "numbers.json").read_text())["budgets"]
    assert budgets["2"]["weights"] != budgets["4"]["weights"]
    for J, row in budgets.items():
        for which, weights in (("given", {}), ("tuned", row["weights"])):
            law = jaxilc.pytree.replaced(axis.schemes["ilc"], weights)
            history = jaxilc.learn(axis.machine, law, axis.task, 4)
            ours = axis.shown_scale * float(history.settled_error[int(J) - 1, 0])
            np.testing.assert_allclose(row[which]["worst"], ours, rtol=1e-12)
            assert number(ours) in out
    assert (tmp_path / "trials.png").exists()


# worst-case
# --------------------------------------------------------------------------------------------------


def test_worst_case_tells_machines_that_can_be_rebuilt(tmp_path, unpainted):
    scenario = jaxilc.scenarios.load("cao-2019", frequency=50, reading="amplitude")
    settings, searched = (*SHORT[1:], "reading=amplitude"), []

    def drawn(*given, **how):
        searched.append(monte_carlo_search(*given, **how))
        return searched[-1]

    request = Request("cao-2019", ("cfdl-mfailc",), set=settings, trials=4, spread=0.2)
    with mock.patch.object(of_worst, "monte_carlo_search", side_effect=drawn) as asked:
        found = outcomes.worst_case(request, draws=30, starts=2, evaluations=27, folder=tmp_path)
    names = ("worst-case.png", "worst-case.json")
    assert found.save() == [tmp_path / name for name in names]
    numbers, out = json.loads((tmp_path / names[1]).read_text()), repr(found)
    assert numbers == json.loads(json.dumps(found.as_json()))
    scheme = scenario.schemes["cfdl-mfailc"]

    def error(machine):
        return 1e3 * float(jaxilc.learn(machine, scheme, scenario.task, 4).settled_error[-1, 0])

    np.testing.assert_allclose(numbers["nominal"], error(scenario.machine), rtol=1e-12)
    assert {name: row["evaluations"] for name, row in numbers["searches"].items()} == {
        "gradient": 24,
        "chance": 24,
        "more chance": 30,
    }
    for row in numbers["searches"].values():
        settings = dict(setting.split("=") for setting in row["set"])
        rebuilt = scenario.with_values(settings).machine
        np.testing.assert_allclose(row["value"], error(rebuilt), rtol=1e-9)
        for name, share in row["numbers"].items():
            now, nominal = (jaxilc.pytree.get_at(m, name) for m in (rebuilt, scenario.machine))
            np.testing.assert_allclose(now, share * nominal, rtol=1e-12)
            assert 0.8 <= share <= 1.2
        assert row["value"] > numbers["nominal"]
        assert number(row["value"]) in out
    assert [(of.args[3], of.kwargs["seed"]) for of in asked.call_args_list] == [(24, 0), (30, 0)]
    row, chance = numbers["searches"]["more chance"], searched[1]
    np.testing.assert_allclose(
        list(row["numbers"].values()), list(chance.values.values()), rtol=1e-12
    )
    assert row["needed"] == 1 + np.argmax(chance.found)
    assert numbers["searches"]["gradient"]["value"] > row["value"]
    page = found.page(tmp_path / "page.html").read_text("utf-8")
    assert all(part in page for part in ("until level with chance", "plant.poles[0]"))
    assert page.count('<figure class="live">') == 2


# What is asked for
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "terms"),
    [
        ("final", ((1.0, Final("rms")),)),
        ("2*final:20 + 0.3*final@max_error", ((2.0, Final("rms", 20)), (0.3, Final("max_error")))),
        ("holding:5+every-trial@max_error",
         ((1.0, Holding(5, "rms")), (1.0, EveryTrial("max_error")))),
        ("trials-to:5", ((1.0, TrialsTo(0.005, "rms")),)),
        ("2.e+1*trials-to:5E+0+final", ((20.0, TrialsTo(0.005, "rms")), (1.0, Final("rms")))),
        (with_limits("final", ["d2=1e17"]), ((1.0, Final("rms")), (100.0, D2(1e17)))),
        ("trials-to:5@volts", ((1.0, TrialsTo(2.5, "volts")),)),
        ("growth:3+effort:2+input-rate",
         ((1.0, Growth("rms", 3)), (1.0, Effort(2.0)), (1.0, InputRate(1.0)))),
        ("0.1*contraction:0.9", ((0.1, Contraction(0.9)),)),
        (with_limits("final", ["d2=0.95", "contraction = 1"]),
         ((1.0, Final("rms")), (100.0, D2(0.95)), (100.0, Contraction(1.0)))),
    ],
)  # fmt: skip
def test_objectives_are_what_they_say(text, terms):
    assert objective_of(text, "rms", {"rms": 1e3, "volts": 2.0}.get).terms == terms


def test_a_limit_that_the_tuned_weights_exceed_is_told():
    """On a static plant of 2 with phi = 2, d2 = 1 - 2^2 / (lam + 2^2) = 0.8 at lam = 16."""
    plant, law = StateSpace([[0.0]], [[1.0]], [[2.0]], dt=1e-3), CFDLMFAILC(phi0=2.0, rho=1.0)
    task = jaxilc.Task(np.sin(np.linspace(0, 6, 21)), dt=1e-3)
    problem = Tuning(jaxilc.Machine(plant), law, task, 2, weights=["lam"], objective=Final("rms"))
    tuned = mock.Mock(values={"lam": 16.0})
    (said,) = limits_not_met(problem, tuned, ["d2=0.5", "d2 = 0.80001"])
    assert "the nominal machine has d2 = 0.8, and allowed was 0.5" in said
    assert limits_not_met(problem, tuned, ()) == []
    gain = {"plant.C": Uniform(0.5, 1.0, relative=True)}  # d2 = 1 - 1 / (lam + 1) for a gain of 1
    several = dataclasses.replace(problem, uncertainty=gain, sampling="corners")
    (said,) = limits_not_met(several, tuned, ["d2=0.85", "d2=0.9412"])
    assert "one of the machines tuned on has d2 = 0.941176, and allowed was 0.85" in said


def test_a_law_with_a_low_pass_exceeds_a_limit_on_contraction_though_it_is_monotone():
    """P is 2 and one sample of delay, so that Q (1 - L P) is 0.2 Q, and I - P Q L is 1 - 0.8 Q."""
    plant, low_pass = StateSpace([[0.0]], [[1.0]], [[2.0]], dt=1e-3), ZeroPhaseButterworth(50.0)
    law = Filtered(PIDType(gamma_p=0.4, lead=1), low_pass)
    task = jaxilc.Task(np.sin(np.linspace(0, 6, 41)), dt=1e-3)
    problem = Tuning(jaxilc.Machine(plant), law, task, 2, ["scheme.gamma_p"])
    tuned = mock.Mock(values={"scheme.gamma_p": 0.4})
    (said,) = limits_not_met(problem, tuned, ["contraction=0.9"])
    sigma = float(said.split("contraction = ")[1].split(",")[0])
    assert 0.99 < sigma < 1.1, "1 beyond the cutoff, and a little more at the ends of the trial"
    assert said.endswith("filter and certify judge such laws")


def test_risks_are_what_they_say():
    texts = ("mean", "worst", "cvar:0.8", "cvar", "smooth-max:0.1")
    assert [risk_of(text) for text in texts] == [Mean(), Worst(), CVaR(0.8), CVaR(), SmoothMax(0.1)]


@pytest.mark.parametrize(
    ("words", "message"),
    mistakes("""
tune --weights gain => weights: 'gain' is not a parameter here; known: lam
tune --weights eta,lam=1 => --weights 'lam=1' is not NAME=LOW:HIGH
tune --weights lam,eta,lam=0.1:10 => --weights: lam is given more than once
tune --weights lam --limit d2 => --limit 'd2' is not NAME=NUMBER
tune --weights lam --limit d3=1 => --limit: 'd3' is not one of d2, contraction
tune --weights lam --limit d2=-1 => d2: -1 is outside its allowed range (0, inf)
tune --weights lam=a:1 => lam: 'a' is not a number
tune --weights 'lam = 2:3' => the start lam = 1.0 is outside its bounds (2, 3)
tune --weights lam --objective best => --objective: 'best' is not one of final[:trial], every-trial
tune --weights lam --objective final:0 => final: '0' is not the number of a trial
tune --weights lam --objective final:100 => trial = 100 is outside its allowed range [1, 80]
tune --weights lam --objective '-1*final' => weight of final: -1 is outside its allowed range (0, \
inf)
tune --weights lam --objective '2*finl:5' => --objective: 'finl' is unknown; did you mean \
final[:trial]? Known: final[:trial],
tune --weights lam --risk median => --risk 'median' is unknown; did you mean mean? Known: mean, \
worst, cvar[:alpha]
pareto --weights lam => --objective final: needed are two objectives, or one and --budgets
pareto --weights lam --objective final --objective effort --budgets 5 => --objective final, \
effort --budgets 5: needed are two objectives, or one and
pareto --weights lam --budgets 5 --trials 9 => --trials 9 has no meaning beside --budgets 5
pareto --weights lam --budgets 5,0 => --budgets: '0' is not a number of trials
pareto --weights lam --budgets 5,5 => --budgets: 5 is given more than once
worst-case --trial 0 => --trial 0 is outside its allowed range [1, inf)
worst-case --evaluations 10 => --evaluations 10 is outside its allowed range [64, inf)
worst-case --draws 0 => --draws 0 is outside its allowed range [1, inf)
"""),
)
def test_a_mistake_is_one_line_and_nothing_is_written(words, message, tmp_path):
    command, *more = words
    asked = ("cao-2019", *SHORT, "--scheme", "cfdl-mfailc", *more, "--out", tmp_path / "out")
    code, _, err = call(command, *asked)
    assert code == 2
    assert message in err
    assert err.count("\n") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("command", "option", "value", "message"),
    [
        ("tune", "--bounds", "eta=0:1", "--bounds: 'eta' is not one of the weights lam"),
        ("tune", "--bounds", "lam=2:3", "the start lam = 1.0 is outside its bounds (2, 3)"),
        ("tune", "--held-out", "-1", "held_out = -1 is outside its allowed range [0, inf)"),
        ("tune", "--unseen", "-1", "--unseen -1 is outside its allowed range [1, inf)"),
        ("tune", "--starts", "-1", "starts = -1 is outside its allowed range [1, inf)"),
        ("tune", "--rate", "0", "rate = 0 is outside its allowed range (0, inf)"),
        ("tune", "--optimiser", "sgd", "optimiser = 'sgd' is not one of adam, lbfgs"),
        ("tune", "--sampling", "grid", "sampling = 'grid' is not one of monte-carlo"),
        ("tune", "--compare-trials", "-1", "--compare-trials -1 is outside its allowed range"),
        ("pareto", "--second", "best", "--objective: 'best' is not one of final[:trial]"),
        ("pareto", "--first", "best", "--objective best: needed are two objectives, or one and"),
        ("pareto", "--shares", "a", "--shares: 'a' is not a number"),
    ],
)
def test_an_option_that_left_still_does_its_work_and_warns(command, option, value, message):
    asked = ("cao-2019", *SHORT, "--scheme", "cfdl-mfailc", "--weights", "lam", option, value)
    code, out, err = call(command, *asked)
    assert (code, out) == (2, "")
    warned, error = err.splitlines()
    assert warned.startswith(f"warning: {option} will go: ")
    assert message in error
    assert option not in call(command, "--help")[1]


# Parameter files and figures
# --------------------------------------------------------------------------------------------------


def test_a_parameter_file_holds_what_differs(scenario, tmp_path):
    printed = scenario.schemes["ffdl-mfailc"]
    changed = {"lam": 0.5, "phi0": [0.5, 0.0, -0.06], "L_u": 1, "reset": "sign", "limit": 9.0}
    values = differing(jaxilc.pytree.replaced(printed, changed), printed)
    assert values == changed
    file = write_parameters(
        tmp_path / "p.json", "cao-2019", {"ffdl-mfailc": values}, {"by": "hand"}
    )
    again = with_parameters(scenario, file).schemes["ffdl-mfailc"]
    assert differing(again, printed) == changed
    assert differing(printed, again) == {
        name: values for name, values in differing(printed, again).items() if name in changed
    }
    assert json.loads(file.read_text())["versions"]["jaxilc"]


def test_parameters_of_another_machine_or_other_options_are_told(scenario, tmp_path):
    """Nothing was said of a file that had been found for another drive of the same name."""
    machine = as_json(describe(scenario.machine))
    found = {"options": dict(scenario.options), "configuration": {"machine": machine}}
    file = tmp_path / "p.json"
    for obtained in ({}, {"options": []}, {"configuration": 1}, found):  # of earlier versions, too
        write_parameters(file, "cao-2019", {"pid": {}}, obtained)
        Request("cao-2019", set="frequency=50", params=file).scenario()
    other = scenario.with_values({"plant.gain": 1.0})
    with pytest.warns(RuntimeWarning, match=r"p.json was found for another machine: plant.gain: "):
        warn_of_another(other, file)
    warn_of_another(other, file, ["machine.plant.gain"])
    with pytest.warns(RuntimeWarning, match="another machine: frequency: 50.0 there, 0.5 here"):
        Request("cao-2019", params=file).scenario()
    Request("cao-2019", set="frequency=2", params=file).scenario()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "is not a parameter file: it needs `scenario` and `schemes`"),
        ("[1]", "is not a parameter file"),
        ('{"schemes": {}}', "is not a parameter file"),
        ('{"scenario": "cao-2019", "schemes": {}}', "has none of pid, cfdl-mfailc"),
        ('{"scenario": "cao-2019", "schemes": {"pid": 3}}', "is not a parameter file"),
        ('{"scenario": "cao-2019", "schemes": {"smc": {"lam": 1}}}',
         "scheme = 'smc' is not one of pid, cfdl-mfailc"),
        ('{"scenario": "cao-2019", "schemes": {"pid": {"kq": 1}}}',
         "'pid.kq' cannot be set; did you mean pid.k"),
        ('{"scenario": "cao-2019", "schemes": {"cfdl-mfailc": {"lam": 0}}}',
         r"lam = 0 is outside its allowed range \(0, inf\)"),
    ],
)  # fmt: skip
def test_a_bad_parameter_file_is_named(scenario, tmp_path, content, message):
    file = tmp_path / "p.json"
    file.write_text(content)
    with pytest.raises(ValueError, match=rf"p\.json.*{message}"):
        with_parameters(scenario, file)


def test_figures_show_the_numbers_they_are_given():
    axes = figures.pareto_front(
        [Point(0.9, 1.0, 3.0, None), Point(0.1, 2.0, 1.0, None)], first="error", second="trials"
    )
    np.testing.assert_array_equal(axes.lines[0].get_xydata(), [[1, 3], [2, 1]])
    assert [text.get_text() for text in axes.texts] == ["0.9", "0.1"]
    axes = figures.pareto_front([Point(0.9, 1.0, 3.0, None)], given=(4.0, 5.0))
    np.testing.assert_array_equal(axes.lines[1].get_xydata(), [[4, 5]])
    axes = figures.final_error_by_trials(
        [5, 20], [[2.0, 4.0], [1.0, 3.0]], [[0.5, 0.7], [0.2, 0.3]], metric="rms", unit="µm"
    )
    np.testing.assert_array_equal(
        [line.get_ydata() for line in axes.lines], [[2, 1], [4, 3], [0.5, 0.2], [0.7, 0.3]]
    )
