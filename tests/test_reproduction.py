"""Published numbers beside ours: what a verdict means, that every printed row can be simulated, and the short scenario in full."""

import dataclasses

import numpy as np
import pytest
from cases import ARX, DT

from jaxilc import reproduction, scenarios
from jaxilc.learning import check, learn
from jaxilc.machine import Machine
from jaxilc.plants import DifferenceEquation
from jaxilc.reproduction import reproduce
from jaxilc.scenarios import Published, Scenario
from jaxilc.schemes import PID, PIDType, Scheme
from jaxilc.signals import Task

NAN = float("nan")
FAST, SLOW = (("speed", "fast"),), (("speed", "slow"),)


def row(value, scheme="law", trial=1, quantity="settled_error", options=()):
    return Published(scheme, trial, quantity, value, "made up", options)


def verdicts(rows, ours):
    return [reproduction._verdict(i, tuple(rows), list(ours)) for i in range(len(rows))]


def test_met_is_within_30_percent_either_way():
    for ratio, met in ((1.0, True), (1.3 - 1e-9, True), (0.7 + 1e-9, True), (1.3 + 1e-9, False), (0.7 - 1e-9, False), (-1.0, False)):
        for value in (20.0, 0.15):
            assert verdicts([row(value)], [ratio * value]) == ["met" if met else "open"], ratio


def test_what_is_not_finite_is_open():
    rows = [row(2.0, trial=1), row(1.0, trial=2)]
    for worst in (NAN, np.inf):
        assert verdicts(rows, [worst, 1.0]) == ["open", "met"]
        assert verdicts(rows, [2.0, worst]) == ["met", "open"]
        assert verdicts([row(1.0)], [worst]) == ["open"]


TRIALS = [row(8.0, trial=10), row(4.0, trial=20), row(1.0, trial=30)]


@pytest.mark.parametrize(
    ("ours", "expected"),
    [
        ([80.0, 40.0, 10.0], ["shape", "shape", "shape"]),  # ten times too large, in the right order
        ([80.0, 90.0, 10.0], ["open", "open", "shape"]),  # the first two change places
        ([80.0, 4.0, 10.0], ["shape", "met", "open"]),  # `met` where the number is right, though its order is not
        ([20.0, 40.0, 80.0], ["open", "open", "open"]),
        ([8.0, 4.0, 10.0], ["met", "met", "open"]),
    ],
)
def test_shape_is_the_order_among_the_trials_of_a_scheme(ours, expected):
    assert verdicts(TRIALS, ours) == expected


def test_shape_among_schemes_and_among_settings():
    """Several schemes at one setting, or one scheme at several; a row is judged by all of them."""
    rows = [row(4.0, "a", None, options=FAST), row(2.0, "b", None, options=FAST), row(1.0, "a", None, options=SLOW)]
    assert verdicts(rows, [40.0, 20.0, 10.0]) == ["shape", "shape", "shape"]
    assert verdicts(rows, [40.0, 50.0, 10.0]) == ["open", "open", "shape"]
    assert verdicts(rows, [40.0, 20.0, 50.0]) == ["open", "shape", "open"], "b at `fast` does not compare with a at `slow`"


@pytest.mark.parametrize(
    "other",
    [
        row(1.0, "other", trial=2),  # another scheme at another trial
        row(1.0, quantity="max_error"),  # another quantity
        row(1.0, trial=1),  # the same, printed twice
        row(8.0, trial=2),  # of the same printed value
    ],
)
def test_rows_without_an_order_in_print_give_no_shape(other):
    assert verdicts([row(8.0), other], [80.0, 10.0])[0] == "open"


def test_a_comparison_with_a_diverged_row_is_no_agreement():
    """Printed 8, 4, 1; ours 80, NaN, 10: that the second stands below the first cannot be said."""
    for diverged in (NAN, np.inf):
        assert verdicts(TRIALS, [80.0, diverged, 10.0])[0] == "open", diverged


def test_an_error_that_does_not_move_has_not_the_printed_shape():
    """`larger or smaller as in print`: equal is neither, whichever of the two rows is judged."""
    assert verdicts(TRIALS, [80.0, 80.0, 80.0]) == ["open", "open", "open"]


SCENARIOS = list(scenarios.SCENARIOS)


@pytest.fixture(scope="module", params=SCENARIOS)
def scenario(request) -> Scenario:
    return scenarios.load(request.param)


def loaded(scenario, published) -> Scenario:
    return scenarios.load(scenario.name, **dict(published.options))


def learns(scheme: Scheme) -> bool:
    parts = [getattr(scheme, f.name) for f in dataclasses.fields(scheme)]
    return scheme.learns and any(not isinstance(p, Scheme) or learns(p) for p in parts)


def test_every_published_row_can_be_simulated(scenario):
    """Its options load, its scheme exists there, its quantity is measured, its trial is among those of the scenario."""
    assert scenario.published
    for p in scenario.published:
        here = loaded(scenario, p)
        assert set(dict(p.options)) <= set(scenarios.options(scenario.name)), p
        assert p.scheme in here.schemes, p
        assert here.shown(p.quantity)[0] > 0, p
        assert p.quantity in {"settled_error", "max_error", "rms", "best_trial", *here.quantities}, p
        assert (p.trial is not None) == learns(here.schemes[p.scheme]), p
        assert p.trial is None or 1 <= p.trial <= here.trials, p
        assert np.isfinite(p.value), p
        assert p.value > 0, p
        assert p.source, p
        assert p.reading, p
        assert p in here.due, "a row is due under its own options"


def test_the_settings_of_published_rows_fit_together(scenario):
    """Machine, scheme and task of each row, without simulating; the settled window holds samples, errors are shown on one scale."""
    for options in {p.options for p in scenario.published}:
        here = scenarios.load(scenario.name, **dict(options))
        assert here.shown_unit == scenario.shown_unit
        assert here.shown_scale == scenario.shown_scale
        assert here.published == scenario.published, "the rows must not depend on the options they were printed for"
        assert len(np.asarray(here.task.reference)[here.task.settled]) > 10
        for name in {p.scheme for p in scenario.published if p.options == options}:
            check(here.machine, here.schemes[name], here.task)


def test_no_row_is_listed_twice(scenario):
    keys = [p._replace(value=0.0, source="", reading="") for p in scenario.published]
    assert len(set(keys)) == len(keys)


def test_dai_2014():
    rows = reproduce(["dai-2014"])
    published = scenarios.load("dai-2014").published
    assert [r.published for r in rows] == list(published)
    for r in rows:
        assert r.scenario == "dai-2014"
        assert np.isfinite(r.ours)
        assert r.ours > 0
        assert r.ratio == pytest.approx(r.ours / r.published.value, rel=1e-12)
        assert (r.verdict == "met") == (abs(r.ratio - 1) <= 0.3)
        assert r.verdict in ("met", "shape", "open")
        assert r.unit == "mm"
    pid = [r for r in rows if r.published.scheme == "pid"]
    assert [r.verdict for r in pid] == ["met", "met"]
    # by an independent NumPy loop with eq. 29's coefficients
    np.testing.assert_allclose([r.ours for r in pid], [0.0250, 0.0617], atol=6e-5)
    flat = rows[0].as_dict()
    assert flat["options"] == {"plant": "printed", "frequency": 0.5}
    assert {"scenario", "scheme", "trial", "quantity", "value", "source", "reading", "ours", "ratio", "unit", "verdict"} <= set(flat)


N = 20
TASK = Task(0.5 - 0.5 * np.cos(2 * np.pi * np.arange(N + 1) / N), dt=DT)
SCHEMES = {"feedback": PID(kp=1.0), "learning": PIDType(gamma_p=0.5)}
MACHINE = Machine(DifferenceEquation(*ARX, dt=DT))


@pytest.fixture
def made_up(monkeypatch):
    """A scenario with a gain as its option, whose printed numbers are ours but for known factors; and how often it learned."""

    def ours(name, trial, quantity, gain=1.0):
        return 1e3 * float(getattr(learn(MACHINE, scaled(gain)[name], TASK, 4), quantity)[trial - 1, 0])

    def scaled(gain):
        return SCHEMES | {"learning": PIDType(gamma_p=0.5 * gain)}

    half = (("gain", 0.5),)
    published = (
        Published("learning", 2, "rms", ours("learning", 2, "rms"), "made up"),
        Published("learning", 4, "rms", ours("learning", 4, "rms") / 10, "made up"),
        Published("learning", 4, "max_error", ours("learning", 4, "max_error") * 2, "made up"),
        Published("learning", 3, "rms", ours("learning", 3, "rms", 0.5) * 1.2, "made up", half),
        Published("feedback", None, "max_error", ours("feedback", 1, "max_error"), "made up"),
    )

    def build(gain: float = 1.0) -> Scenario:
        return Scenario("made-up", "", MACHINE, TASK, scaled(gain), 4, {}, published, shown_unit="µm", shown_scale=1e3)

    runs = []

    def counted(machine, scheme, task, trials, **options):
        runs.append((type(scheme).__name__, trials))
        return learn(machine, scheme, task, trials, **options)

    monkeypatch.setitem(scenarios.SCENARIOS, "made-up", build)
    monkeypatch.setattr(reproduction, "learn", counted)
    return published, runs


def test_rows_of_a_made_up_scenario(made_up):
    """Each in its own options, trial and quantity, in the shown unit, in the order of print; each scheme learns once a setting."""
    published, runs = made_up
    rows = reproduce(["made-up"])
    assert [r.published for r in rows] == list(published)
    np.testing.assert_allclose([r.ratio for r in rows], [1.0, 10.0, 0.5, 1 / 1.2, 1.0], rtol=1e-9)
    assert [r.verdict for r in rows] == [
        "met",
        "shape",
        "shape",
        "met",
        "met",
    ]  # the third is in order with feedback, which is the same at every trial
    assert {r.unit for r in rows} == {"µm"}
    assert sorted(runs) == [("PID", 1), ("PIDType", 3), ("PIDType", 4)]


def test_an_unknown_scenario_is_named():
    with pytest.raises(ValueError, match="cao-2020") as caught:
        reproduce(["cao-2020"])
    for name in SCENARIOS:
        assert name in str(caught.value)
