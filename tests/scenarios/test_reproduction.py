"""Published numbers are compared with ours.

The tests check what a verdict means, and that every printed row can be simulated. The short
scenario is simulated in full.
"""

import dataclasses
import functools
import re
from pathlib import Path

import numpy as np
import pytest
from cases import ARX, DT

from jaxilc import scenarios
from jaxilc.learning import Machine, check, learn
from jaxilc.plants import DifferenceEquation
from jaxilc.scenarios import Fit, Published, Scenario, reproduce, reproduction
from jaxilc.scenarios.from_file import JUDGED
from jaxilc.scenarios.published import (
    ALIKE,
    FALLS,
    KINDS,
    NO_RISE,
    ORDERS,
    OVER_TRIALS,
    Conclusion,
    agreement_of,
)
from jaxilc.schemes import PID, PIDType, Scheme
from jaxilc.signals import Task

NAN = float("nan")
FAST, SLOW = (("speed", "fast"),), (("speed", "slow"),)


def row(value, scheme="law", trial=1, quantity="settled_error", options=()):
    return Published(scheme, trial, quantity, value, "made up", options)


def verdicts(rows, ours):
    return [verdict for verdict, _ in judged(rows, ours)]


def judged(rows, ours):
    return [reproduction._verdict(i, tuple(rows), list(ours)) for i in range(len(rows))]


ALONE = "times the printed number, and no other row to compare with"
BOUND = row(5.0)._replace(at_most=True)


def improved(percent):
    return row(percent, quantity="rms_improvement")._replace(against="other")


@pytest.mark.parametrize(
    ("printed", "ours", "verdict"),
    [  # within 30 % either way
        *((row(20.0), 20.0 * ratio, "met") for ratio in (1.0, 1.3 - 1e-9, 0.7 + 1e-9)),
        *((row(20.0), 20.0 * ratio, "open") for ratio in (1.3 + 1e-9, 0.7 - 1e-9, -1.0)),
        (row(0.15), 1.29 * 0.15, "met"),
        (row(1.0), NAN, "open"),
        (row(1.0), np.inf, "open"),
        # what is printed as "less than" is met up to it, and not 30 % beyond it
        *((BOUND, ours, "met") for ours in (0.05, 5.0)),
        *((BOUND, ours, "open") for ours in (5.0 + 1e-8, 6.0)),
        # An improvement in percent is judged by the worse of two ratios: it, and what is left. Of
        # 90 % printed, 97 % leaves 3 in place of 10, and 80 % leaves 20; both are within 30 % of
        # 90. Of 42 % printed, what is left says little: 25 % leaves 75 in place of 58.
        *((improved(90.0), ours, "met") for ours in (90.0, 87.1)),
        *((improved(90.0), ours, "open") for ours in (97.0, 80.0)),
        (improved(42.0), 50.0, "met"),
        *((improved(42.0), ours, "open") for ours in (25.0, 0.0, -10.0)),
    ],
)
def test_the_verdict_on_a_number_alone(printed, ours, verdict):
    assert verdicts([printed], [ours]) == [verdict]


def test_rises_and_spread_over_trials():
    """The rise is the largest from one trial to the next, the spread that of all trials so far."""
    found = reproduction.rises(np.array([[3.0, 1.0], [2.0, 2.5], [2.2, 0.1], [4.0, 0.0]]))
    np.testing.assert_allclose(found["rms_rise"], [0.0, 0.0, 0.0, 1.8])
    np.testing.assert_allclose(found["rms_spread"], [0.0, 0.5, 0.8, 1.8])
    assert tuple(found) == OVER_TRIALS


TRIALS = [row(8.0, trial=10), row(4.0, trial=20), row(1.0, trial=30)]


@pytest.mark.parametrize(
    ("ours", "expected"),
    [
        ([15.0, 7.5, 1.9], ["shape", "shape", "shape"]),  # almost twice as much, in the right order
        ([4.1, 2.1, 0.55], ["shape", "shape", "shape"]),
        ([4.1, 5.4, 1.9], ["open", "open", "shape"]),  # the first two are in the wrong order
        # `met`, since the number is right although its order is not
        ([15.0, 4.0, 10.0], ["shape", "met", "open"]),
        ([20.0, 40.0, 80.0], ["open", "open", "open"]),
        ([8.0, 4.0, 10.0], ["met", "met", "open"]),
        # a comparison with a row that diverged is no agreement
        ([12.0, NAN, 1.5], ["open", "open", "open"]),
        ([12.0, np.inf, 1.0], ["open", "open", "met"]),
        ([NAN, 4.0, 1.0], ["open", "met", "met"]),
        # equal is neither larger nor smaller, whichever of the two rows is judged
        ([11.0, 5.4, 5.4], ["shape", "open", "open"]),
    ],
)
def test_shape_is_the_order_among_the_trials_of_a_scheme(ours, expected):
    assert verdicts(TRIALS, ours) == expected


def test_shape_among_schemes_and_among_settings():
    """Compared are several schemes at one setting, and one scheme at several settings."""
    rows = [
        row(4.0, "a", None, options=FAST),
        row(2.0, "b", None, options=FAST),
        row(1.0, "a", None, options=SLOW),
    ]
    assert verdicts(rows, [6.0, 3.0, 1.5]) == ["shape", "shape", "shape"]
    assert verdicts(rows, [2.5, 3.5, 1.5]) == ["open", "open", "shape"]
    assert verdicts(rows, [2.5, 1.2, 2.6]) == ["open", "shape", "open"], (
        "b at `fast` does not compare with a at `slow`"
    )


def test_shape_is_bounded_in_size_and_what_lies_beyond_says_so():
    """The bounds are twice and half the printed size; a row in the printed order says so."""
    for factor, verdict in (
        (3.62, "open"), (0.37, "open"), (2.01, "open"), (0.49, "open"), (2.0, "shape"),
        (0.5, "shape"), (1.4, "shape"),
    ):  # fmt: skip
        found = judged(TRIALS, [factor * p.value for p in TRIALS])
        assert [one for one, _ in found] == [verdict] * 3, factor
        reason = (
            f"in the printed order, but {factor:.2f} times the printed number, beyond a factor of 2"
        )
        assert [told for _, told in found] == [reason if verdict == "open" else ""] * 3


def test_an_open_row_says_why():
    assert judged([row(1.0)], [3.0]) == [("open", f"3.00 {ALONE}")]
    assert judged([row(1.0)], [NAN]) == [("open", "ours is not finite")]
    left = "2.00 times what is left, and no other row to compare with"
    assert judged([improved(90.0)], [80.0]) == [("open", left)]
    against = "times the printed number, and not in the printed order with 1 of 2 comparable rows"
    said = [("open", f"0.51 {against}"), ("open", f"1.35 {against}")]
    assert judged(TRIALS, [4.1, 5.4, 1.0])[:2] == said


def test_a_number_of_other_software_agrees_within_its_own_tolerance():
    """The tolerance follows from the digits that are printed, and is not below 1e-6."""
    assert agreement_of("159.727175") == 1e-6
    assert agreement_of("0.0040917") == pytest.approx(0.5e-7 / 0.0040917)
    assert agreement_of("14500") == pytest.approx(0.5 / 14500)
    rows = [row(2.0)._replace(agreement=1e-6), row(1.0, trial=2)._replace(agreement=1e-6)]
    for ratio, verdict in ((1 + 0.9e-6, "agrees"), (1 - 0.9e-6, "agrees"), (1 + 1.2e-6, "open")):
        assert verdicts(rows, [2.0 * ratio, 1.0]) == [verdict, "agrees"]
    assert judged(rows, [2.6, NAN]) == [
        ("open", "ours differs by 0.3 of it, beyond 1e-06"),
        ("open", "ours is not finite"),
    ]


@pytest.mark.parametrize(
    "other",
    [
        row(1.0, "other", trial=2),  # another scheme at another trial
        row(1.0, quantity="max_error"),  # another quantity
        row(1.0, trial=1),  # the same, printed twice
        row(8.0, trial=2),  # the printed value is the same
    ],
)
def test_rows_without_an_order_in_print_give_no_shape(other):
    assert verdicts([row(8.0), other], [12.0, 1.5])[0] == "open"


SCENARIOS = list(scenarios.SCENARIOS)
ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module", params=SCENARIOS)
def scenario(request) -> Scenario:
    return scenarios.load(request.param)


@functools.cache
def under(name: str, options: tuple[tuple[str, object], ...]) -> Scenario:
    return scenarios.load(name, **dict(options))


def learns(scheme: Scheme) -> bool:
    parts = [getattr(scheme, f.name) for f in dataclasses.fields(scheme)]
    return scheme.learns and any(not isinstance(p, Scheme) or learns(p) for p in parts)


def test_every_published_row_can_be_simulated(scenario):
    """The options, scheme, quantity and trial of each row exist in the scenario."""
    assert scenario.published
    for p in scenario.published:
        here = under(scenario.name, p.options)
        assert set(dict(p.options)) <= set(scenarios.options(scenario.name)), p
        assert p.scheme in here.schemes, p
        assert here.shown(p.quantity)[0] > 0, p
        known = {"settled_error", "max_error", "rms", "best_trial", *here.quantities}
        assert p.base in {*known, *OVER_TRIALS}, p
        assert (p.base != p.quantity) == bool(p.against), p
        assert not p.against or p.against in here.schemes, p
        of_trials = learns(here.schemes[p.scheme]) or p.quantity in OVER_TRIALS
        assert (p.trial is not None) == of_trials, p
        assert p.trial is None or 1 <= p.trial <= 100, p
        assert np.isfinite(p.value), p
        assert p.value > 0, p
        assert p.source, p
        assert p.reading, p
        assert p.kind in KINDS, p
        assert bool(p.words) == (p.agreement is None), "a number of a paper has the printed words"
        assert not p.set, "a printed number belongs to the paper's own values"
        assert isinstance(p.fitted, Fit), f"{p} does not say what was fitted, or that nothing was"
        assert bool(p.fitted.names) == bool(p.fitted.to), p
        assert p.fitted.names or not p.fitted.among, p
        assert "fitted" not in p.reading, "that is said by `fitted`, in the same words for all"
        assert (p in here.due) == p.of_one_run, "a row is due under its own options"
        assert not p.searched or (ROOT / p.searched).is_file(), p


FREE = {  # how many numbers were fitted to print, by scenario and scheme; for li-2020 by row
    "cao-2019": {"cfdl-mfailc": {1, 2}, "ffdl-mfailc": {5}, "ilc-mfapc": {2}, "pid": {0, 1}},
    "cao-2019-rig": {"cfdl-mfailc": {2}, "pid": {1}},
    "dai-2014": {"pid": {0}, "cfdl-mfapc": {1}},
    "double-mass": {name: {0} for name in scenarios.LISTED["double-mass"].schemes},
    "li-2020": {"feedback": {3, 5}, "feedforward": {4}, "p-type": {4, 5}, "fixed-filter": {5}},
    "milc-2024": {"dilc": {4}, "milc": {4}},
    "pendulum": {"two-step": {0}, "two-step-limited": {0}},
    "xu-2024": {"pid": {6}, "smc": {6}, "asmc": {6, 11}, "ilc-asmc": {10}},
}
AMONG = {
    "cao-2019": 27, "cao-2019-rig": 4, "dai-2014": 2, "double-mass": 0, "li-2020": 6,
    "milc-2024": 5, "pendulum": 0, "xu-2024": 20,
}  # fmt: skip


def test_each_row_says_what_was_fitted(scenario):
    """It says how many numbers were fitted, to which ones, and whether it is one of these."""
    found: dict[str, set] = {}
    for p in scenario.published:
        found.setdefault(p.scheme, set()).add(len(p.fitted.names))
        said = str(p.fitted)
        assert said == "nothing fitted" or f"{len(p.fitted.names)} free number" in said
        assert ("among them" in said) == p.fitted.among
        assert ("predicted" in said) == (bool(p.fitted.names) and not p.fitted.among)
    assert found == FREE[scenario.name]
    assert sum(p.fitted.among for p in scenario.published) == AMONG[scenario.name]


def test_rows_of_a_printed_integral_gain_say_its_unit(scenario):
    """A gain `ki` in print is one per second or per sample, which can decide the row."""
    for p in scenario.published:
        scheme = under(scenario.name, p.options).schemes[p.scheme]
        if p.words and isinstance(scheme, PID) and np.any(scheme.ki) and "ki" not in p.fitted.names:
            assert "ki multiplied by the sample time" in p.reading, p


def test_the_settings_of_published_rows_fit_together(scenario):
    """Machine, scheme and task of each row fit; the errors are shown on one scale.

    The settled window holds samples. Nothing is simulated.
    """
    for options in {p.options for p in scenario.published}:
        here = under(scenario.name, options)
        assert here.shown_unit == scenario.shown_unit
        assert here.shown_scale == scenario.shown_scale
        assert here.published == scenario.published, (
            "the rows must not depend on the options they were printed for"
        )
        assert len(np.asarray(here.task.reference)[here.task.settled]) > 10
        for name in {p.scheme for p in scenario.published if p.options == options}:
            check(here.machine, here.schemes[name], here.task)


def test_no_row_is_listed_twice(scenario):
    keys = [p._replace(value=0.0, source="", reading="") for p in scenario.published]
    assert len(set(keys)) == len(keys)


@pytest.mark.thorough
def test_dai_2014():
    rows = reproduce(["dai-2014"])
    pid = [r for r in rows if r.published.scheme == "pid"]
    assert [(r.verdict, r.unit) for r in pid] == [("met", "mm")] * 2
    # the result of an independent NumPy loop with the coefficients of eq. 29
    np.testing.assert_allclose([r.ours for r in pid], [0.0250, 0.0617], atol=6e-5)
    flat = rows[0].as_dict()
    assert flat["options"] == {"plant": "printed", "frequency": 0.5}
    assert {"scenario", "scheme", "value", "source", "ours", "ratio", "unit", "verdict"} <= {*flat}
    assert flat["agreement"] is None
    fitted = "1 free number (phi0) fitted to this row alone; this row is among them"
    assert rows[1].as_dict()["fitted"] == fitted
    assert [r.reason for r in rows[:3]] == ["", "", ""]
    assert rows[3].reason.endswith("not in the printed order with 1 of 2 comparable rows")


@pytest.mark.parametrize(
    ("frequency", "printed", "seconds"),
    [(0.5, (-10.0, 0.1, 0.0), 102.3), (2.5, (-9.0, 0.2, 1.0), 46.2)],
)
def test_the_loops_of_dai_2014_drift_as_the_file_says(frequency, printed, seconds):
    """The pole nearest to 1 of eq. 29 under the printed PID, from its characteristic polynomial."""
    pid = scenarios.load("dai-2014", frequency=frequency).schemes["pid"]
    dt = 1e-3
    assert (pid.kp, pid.ki, pid.kd / dt) == printed
    a, b = (1.0, -2.2386, 1.6246, -0.385), (0.0018, -0.0036, -0.0025)
    per_sample = (pid.kp, pid.ki * dt, pid.kd / dt)
    law = np.dot(per_sample, [[1.0, -1.0, 0.0], [1.0, 0.0, 0.0], [1.0, -2.0, 1.0]])
    poles = np.roots(np.polyadd(np.polymul(a, (1.0, -1.0, 0.0)), np.polymul(b, law)))
    assert dt / np.log(np.max(np.abs(poles))) == pytest.approx(seconds, rel=2e-3)


N = 20
TASK = Task(0.5 - 0.5 * np.cos(2 * np.pi * np.arange(N + 1) / N), dt=DT)
SCHEMES = {"feedback": PID(kp=1.0), "learning": PIDType(gamma_p=0.5)}
MACHINE = Machine(DifferenceEquation(*ARX, dt=DT))


@pytest.fixture
def made_up(monkeypatch):
    """Return a scenario with a gain as its option, and a count of its learning runs.

    Its printed numbers are ours, except for known factors.
    """

    def ours(name, trial, quantity, gain=1.0):
        return 1e3 * float(
            getattr(learn(MACHINE, scaled(gain)[name], TASK, 4), quantity)[trial - 1, 0]
        )

    def scaled(gain):
        return SCHEMES | {"learning": PIDType(gamma_p=0.5 * gain)}

    half = (("gain", 0.5),)
    published = (
        Published("learning", 2, "rms", ours("learning", 2, "rms"), "made up"),
        Published("learning", 4, "rms", ours("learning", 4, "rms") / 1.9, "made up"),
        Published("learning", 4, "max_error", ours("learning", 4, "max_error") * 2, "made up"),
        Published("learning", 3, "rms", ours("learning", 3, "rms", 0.5) * 1.2, "made up", half),
        Published("feedback", None, "max_error", ours("feedback", 1, "max_error"), "made up"),
    )

    sides = tuple(published[0]._replace(set=(("learning.gamma_p", x),)) for x in (0.1, 0.2))
    concluded = (Conclusion("it falls", "section 1", "falls", FALLS, sides),)

    def build(gain: float = 1.0) -> Scenario:
        return Scenario(
            "made-up", "", MACHINE, TASK, scaled(gain), 4, {}, published, concluded,
            shown_unit="µm", shown_scale=1e3,
        )  # fmt: skip

    runs = []

    def counted(machine, scheme, task, trials, **options):
        runs.append((type(scheme).__name__, trials))
        return learn(machine, scheme, task, trials, **options)

    monkeypatch.setitem(scenarios.SCENARIOS, "made-up", build)
    monkeypatch.setattr(reproduction, "learn", counted)
    return published, runs


@pytest.mark.thorough
def test_rows_of_a_made_up_scenario(made_up):
    """Each row has its own options, trial and quantity; a scheme learns once for each setting."""
    published, runs = made_up
    rows = reproduce(["made-up"])
    assert [r.published for r in rows] == list(published)
    np.testing.assert_allclose([r.ratio for r in rows], [1.0, 1.9, 0.5, 1 / 1.2, 1.0], rtol=1e-9)
    # The third row is in order with feedback, which is the same at every trial.
    assert [r.verdict for r in rows] == ["met", "shape", "shape", "met", "met"]
    assert {r.unit for r in rows} == {"µm"}
    assert sorted(runs) == [("PID", 1), ("PIDType", 3), ("PIDType", 4)], "and no conclusion"
    assert [judged.holds for judged in reproduction.compared(["made-up"])[1]] == [True]


@pytest.mark.parametrize("name", scenarios.SCENARIOS)
def test_what_is_judged_is_what_is_loaded(name):
    """No row and no conclusion is judged under a reading or a plant that `load` does not take."""
    s = scenarios.load(name)
    usual = {option: s.options[option] for option in JUDGED if option in s.options}
    sides = [x for c in s.conclusions for x in c.sides if isinstance(x, Published)]
    for row in (*s.published, *sides):
        assert {(k, v) for k, v in row.options if k in JUDGED} <= usual.items(), row
    if name in ("cao-2019", "dai-2014"):
        assert scenarios.load(name, plant="exact").title == f"{s.title}, plant: exact"


@pytest.mark.parametrize(
    ("name", "readings"),
    [
        ("cao-2019", ("amplitude", "stroke")),
        ("cao-2019-rig", ("over-trials", "within-samples")),
        ("milc-2024", ("long-stroke", "short-stroke")),
        ("xu-2024", ("small-gain", "large-gain")),
    ],
)
def test_each_reading_has_the_same_printed_numbers(name, readings):
    """The readings of a paper have the same printed rows, each under its own options."""
    of = {reading: scenarios.load(name, reading=reading).published for reading in readings}
    first, second = ([(p.scheme, p.value, p.source) for p in rows] for rows in of.values())
    assert first == second
    assert all(dict(p.options)["reading"] == r for r, rows in of.items() for p in rows)
    assert scenarios.options(name)["reading"] == readings[1], "what is judged is what is loaded"
    title = scenarios.load(name).title
    assert scenarios.load(name, reading=readings[0]).title == f"{title}, reading: {readings[0]}"
    with pytest.raises(ValueError, match=f"{name}: reading = 'neither'"):
        scenarios.load(name, reading="neither")


def test_a_reading_that_is_not_there_is_refused():
    with pytest.raises(ValueError, match="dai-2014 has one reading only; several have cao"):
        reproduce(["dai-2014"], "stroke")
    with pytest.raises(ValueError, match="reading = 'strike'"):
        reproduce(["cao-2019"], "strike")


def test_each_conclusion_can_be_simulated(scenario):
    """Each conclusion names schemes, values and quantities that are there."""
    for one in scenario.conclusions:
        assert one.order in ORDERS, one
        assert all((one.says, one.source, one.words)), one
        simulated = [side for side in one.sides if isinstance(side, Published)]
        assert simulated, one
        assert len(one.sides) > 1, one
        for side in simulated:
            here = under(scenario.name, side.options).with_values(dict(side.set))
            assert side.scheme in here.schemes, side
            assert side.quantity in reproduction.CONDITIONS or here.shown(side.quantity)[0] > 0


@pytest.mark.parametrize(
    ("order", "ours", "holds"),
    [
        (FALLS, (3.0, 2.0, 1.0), True),
        (FALLS, (3.0, 2.0, 2.0), False),
        (FALLS, (np.inf, 2.0), True),  # what diverges errs by more than what does not
        (FALLS, (2.0, np.inf), False),
        (FALLS, (NAN, 1.0), False),
        (NO_RISE, (0.3, 0.3), True),
        (NO_RISE, (0.3, 0.31), False),
        (NO_RISE, (0.3, NAN), False),
        (ALIKE, (1.0, 2.0, 1.5), True),
        (ALIKE, (1.0, 2.01), False),
        (ALIKE, (0.0, 0.0), False),
        (ALIKE, (np.inf, np.inf), False),
    ],
)
def test_a_conclusion_holds_where_our_numbers_have_its_order(order, ours, holds):
    sides = tuple(row(NAN, trial=j)._replace(quantity="rms") for j in range(len(ours)))
    one = Conclusion("it falls", "section 1", "falls", order, sides)
    found = reproduction._concluded("made-up", one, dict(zip(sides, ours, strict=True)), str)
    assert found.holds is holds


def test_counted_are_the_numbers_that_a_paper_prints_first():
    """Repeated and derived numbers and those of other software are not counted."""
    fits = Fit(("phi0",), "this row", among=True)
    rows = [
        (row(10.0)._replace(fitted=Fit()), 10.2),
        (row(10.0, trial=2)._replace(fitted=Fit()), 10.8),
        (row(10.0, trial=3)._replace(fitted=fits), 12.9),
        (row(10.0, trial=4)._replace(fitted=fits), 99.0),
        (row(10.0, trial=5)._replace(fitted=Fit(), at_most=True), 1.0),
        (row(10.0, trial=6)._replace(fitted=Fit(), kind="repeated"), 10.0),
        (row(10.0, trial=7)._replace(fitted=Fit(), kind="derived"), 10.0),
        (row(10.0, trial=8)._replace(fitted=Fit(), agreement=1e-6), 10.0),
    ]
    published = tuple(p for p, _ in rows)
    values = [x for _, x in rows]
    judged = [
        reproduction.Row("a", p, x, x / p.value, "", *reproduction._verdict(i, published, values))
        for i, (p, x) in enumerate(rows)
    ]
    found = reproduction.counted(judged)
    usual = {"bounds": 0, "kept": 0, "shape": 0, "open": 0}
    assert found["predicted"] == usual | {
        "numbers": 3, "3 %": 1, "10 %": 2, "30 %": 2, "bounds": 1, "kept": 1, "met": 3
    }  # fmt: skip
    assert found["fitted"] == usual | {
        "numbers": 2, "3 %": 0, "10 %": 0, "30 %": 1, "met": 1, "open": 1
    }  # fmt: skip


def test_an_unknown_scenario_is_named():
    with pytest.raises(ValueError, match="cao-2020") as caught:
        reproduce(["cao-2020"])
    for name in SCENARIOS:
        assert name in str(caught.value)


@pytest.mark.thorough
def test_the_guide_counts_what_is_met():
    """Its table has each reading, its first paragraph all numbers under the readings taken."""
    page = " ".join((ROOT / ".ci/docs/guide/papers.md").read_text("utf-8").split())
    count = r"`(\S+)` \| (\d+) of (\d+) \|"
    table = re.findall(rf"\| `(\S+)` \| {count} {count}", page)
    assert len(table) == 4
    rows, judged = reproduction.compared()
    for name, reading, met, of, other, other_met, other_of in table:
        taken = [row.verdict for row in rows if row.scenario == name]
        assert scenarios.options(name)["reading"] == reading
        assert (taken.count("met"), len(taken)) == (int(met), int(of)), name
        found = [row.verdict for row in reproduce([name], other)]
        assert (found.count("met"), len(found)) == (int(other_met), int(other_of)), name
    fitted, predicted = reproduction.counted(rows).values()
    both = {key: fitted[key] + predicted[key] for key in fitted}
    for said in (
        f"Of these {both['numbers']}, {both['met']} are met",
        f"{both['10 %']} are within 10 %, and {both['3 %']} within 3 %.",
        f"{both['shape']} have the shape",
        f"{both['open']} are open. To {fitted['numbers']} of them a number was fitted, which "
        f"proves nothing: {fitted['met']} are met.",
        f"The other {predicted['numbers']} are predicted: {predicted['met']} are met.",
        f"comparisons {sum(one.holds for one in judged)} hold",
    ):
        assert said in page, said
