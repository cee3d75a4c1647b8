"""A grid equals sweeps and runs with its values set by hand, and refuses what it cannot run."""

import dataclasses
from contextlib import nullcontext
from itertools import product
from unittest.mock import Mock

import numpy as np
import pytest
import xarray as xr
from cases import first_order, follows, p_type
from fuzz import HOSTILE, fuzz, pick
from gain_case import Killed
from sweep_case import PLAN, TASK

import jaxilc
from jaxilc import Sweep
from jaxilc.figures import error_band
from jaxilc.figures.within_trial import signal_of
from jaxilc.filters import SwitchableFilter
from jaxilc.outcomes import Request, sweep
from jaxilc.runtime import capacity
from jaxilc.schemes import (
    FFDLMFAILC,
    PID,
    Filtered,
    LearningFilter,
    ModelFreeGradient,
    PIDType,
    RepetitiveControl,
)
from jaxilc.sweeps import at_best, best_points, summarise
from jaxilc.sweeps import grid as grid_module
from jaxilc.sweeps.store import open_dataset

LEARNING = {"learning": PLAN.schemes["learning"]}
GAIN = float(PLAN.machine.plant.gain)
ONE = dataclasses.replace(PLAN, schemes=LEARNING, machines=3, keep=("e",))
GRID = dataclasses.replace(
    ONE,
    grid={
        "learning.lam": "0.1:10:3log",
        "learning.lead": [2, 0],
        "plant.gain": [0.5 * GAIN, GAIN],  # also drawn, by a factor
    },
)


@pytest.fixture(scope="module")
def dataset():
    return GRID.run()


@pytest.mark.thorough
def test_a_grid_of_one_point_is_the_sweep():
    grid = dataclasses.replace(ONE, grid={"learning.lam": [float(LEARNING["learning"].lam)]})
    found, plain = grid.run(), ONE.run()
    assert found.sizes["learning.lam"] == 1
    for name in plain.data_vars:
        np.testing.assert_array_equal(found[name].isel({"learning.lam": 0}), plain[name])


def test_every_point_equals_learning_with_its_values(dataset):
    plant, law = PLAN.machine.plant, LEARNING["learning"]
    assert dataset["rms"].dims == (
        "scheme", "learning.lam", "learning.lead", "machine.plant.gain", "sample", "trial",
    )  # fmt: skip
    for lam, lead, gain in ((0.1, 2, GAIN), (10.0, 0, 0.5 * GAIN), (1.0, 2, 0.5 * GAIN)):
        at = dataset.sel({"learning.lam": lam, "learning.lead": lead, "machine.plant.gain": gain})
        for i in (0, 2):
            drawn = dataset.isel(sample=i)
            poles = np.array(plant.poles)
            poles[2] = drawn["plant.poles[2]"]
            of = dataclasses.replace(plant, gain=gain * float(drawn["plant.gain"]), poles=poles)
            alone = jaxilc.learn(
                dataclasses.replace(PLAN.machine, plant=of),
                dataclasses.replace(law, lam=lam, lead=lead), TASK, 4, key=PLAN.key_of(i),
            )  # fmt: skip
            found = at.isel(sample=i, scheme=0)
            np.testing.assert_allclose(found["rms"], alone.rms[:, 0], rtol=1e-10)
            np.testing.assert_allclose(found["e"], alone.final.e[:, 0], rtol=1e-10, atol=1e-14)


def test_the_sweep_of_a_point_has_its_numbers(dataset):
    point = {"learning.lam": 1.0, "learning.lead": 0, "machine.plant.gain": 0.5 * GAIN}
    np.testing.assert_allclose(GRID.at(point).run()["rms"], dataset["rms"].sel(point), rtol=1e-12)
    with pytest.raises(ValueError, match=r"learning.lead = 1 is not one of \[2, 0\]"):
        GRID.at(point | {"learning.lead": 1})
    for wrong in (point | {"learning.gain": 1.0}, 3):
        with pytest.raises(ValueError, match=r"point = .*; allowed is .*: learning.lam, learning"):
            GRID.at(wrong)


def test_the_dataset_is_labelled_and_xarray_works_on_it(dataset):
    assert dataset["machine.plant.gain"].attrs["units"] == "mm/(V s^2)"
    np.testing.assert_allclose(dataset["learning.lam"], [0.1, 1.0, 10.0])
    assert dataset["plant.gain"].dims == ("sample",)
    between = dataset["rms"].interp({"learning.lam": 0.55})
    both = dataset["rms"].sel({"learning.lam": [0.1, 1.0]}).mean("learning.lam")
    np.testing.assert_allclose(between, both)
    dataset["rms"].isel(scheme=0, sample=0, trial=-1, **{"learning.lead": 0}).plot()


def test_a_killed_grid_resumes_to_the_same_dataset(tmp_path, dataset):
    def kill(name, done, fresh):
        if done > 20:
            raise Killed

    store, computed = tmp_path / "store.zarr", []
    with pytest.raises(Killed):
        GRID.run(store, progress=kill)
    begun = open_dataset(store)["finite"]
    assert begun.isel({"learning.lead": 0}).all()
    assert not begun.all()
    resumed = GRID.run(store, resume=True, progress=lambda *done: computed.append(done))
    assert ("learning", 36, 2) in computed
    assert sum(fresh for _, _, fresh in computed) < 36
    xr.testing.assert_identical(resumed, dataset)
    xr.testing.assert_identical(open_dataset(store), dataset)
    other = dataclasses.replace(GRID, grid=GRID.grid | {"learning.lam": "0.1:11:3log"})
    said = r"it differs in: grid.axes\[0\].values.learning.lam: .* there, .* here$"
    with pytest.raises(ValueError, match=said):
        other.run(store, resume=True)


@pytest.mark.thorough
def test_static_axes_may_change_every_shape_and_the_trials():
    laws = {"ffdl": FFDLMFAILC(), "pid": PID(kp=-5.0)}
    windows = ([0, 2], [(0.5,), (0.5, 0.1, -0.06, 0.0)], [1, 2])
    sweep = dataclasses.replace(
        ONE, schemes=laws, keep=(), machines=2,
        grid={"trials": "2, 4", ("ffdl.L_y", "ffdl.phi0", "ffdl.L_u"): windows},
    )  # fmt: skip
    dataset = sweep.run()
    assert dataset["ffdl.phi0"].values.tolist() == ["0.5", "0.5 0.1 -0.06 0"]
    short = dataset.sel(trials=2)
    assert np.isnan(short["rms"].sel(trial=[3, 4])).all()
    assert not short["finite"].sel(trial=3).any()
    law = FFDLMFAILC(L_y=2, L_u=2, phi0=(0.5, 0.1, -0.06, 0.0))
    alone = jaxilc.learn(sweep.machine_of(1), law, TASK, 2, key=sweep.key_of(1))
    found = short.sel({"ffdl.L_y": 2}).sel(scheme="ffdl", sample=1)["rms"][:2]
    np.testing.assert_allclose(found, alone.rms[:, 0], rtol=1e-10)
    best = best_points(dataset)
    errors = dataset["settled_error"].sel(scheme="pid", trial=dataset["trials"])
    assert best[1].error == float(errors.max("sample").min())
    assert at_best(dataset, best).sizes["trial"] == max(of.point["trials"] for of in best)


@pytest.mark.thorough
def test_trials_that_change_with_a_weight_are_those_of_each_point():
    """Two trials with one gain, four with the other: each point is judged by its own last one."""
    grid = {("learning.lam", "trials"): ([0.5, 1.0], [4, 2])}
    dataset = dataclasses.replace(ONE, grid=grid).run()
    (best,) = best_points(dataset)
    last = [
        float(dataset["settled_error"].isel(scheme=0)[i, :, j].max()) for i, j in ((0, 3), (1, 1))
    ]
    assert best.error == min(last)
    assert best.near == np.mean(np.array(last) <= 2 * min(last))
    shorter = at_best(dataset, [best._replace(point={"learning.lam": 1.0})])
    assert shorter.sizes["trial"] == 2


def test_one_point_of_an_axis_of_trials_has_its_own_trials_alone():
    """Of the third trial of two, which is not there, nothing counts as diverged."""
    trial, least = np.arange(1, 4), np.arange(1.0, 6.0)
    errors = least[:, None] / trial * np.where(trial > 2, np.nan, 1.0)
    dims = ("scheme", "sample", "trial")
    point = xr.Dataset(
        {"rms": (dims, errors[None]), "finite": (dims, np.isfinite(errors)[None]),
         "e": (("scheme", "sample", "time"), np.zeros((1, 5, 4)))},
        {"scheme": ["law"], "trial": trial, "sample": np.arange(5), "trials": 2},
    )  # fmt: skip
    (row,) = summarise(point, 1.5, metric="rms")
    assert row.worst.tolist() == [5.0, 2.5]
    assert (row.yield_share, row.diverged, row.diverged_at) == (3 / 5, 0.0, 0)
    (later,) = summarise(point.isel(trial=[2, 1]), 1.5, metric="rms")
    assert later.worst.tolist() == [2.5]
    assert error_band(point, metric="rms")[-1].figure.get_suptitle() == "5 machines, 2 trials"
    assert signal_of(point.sel(sample=0), "e", "law", 2).shape == (4, 1)
    with pytest.raises(ValueError, match=r"trial = \[3\] .* whose last trial is 2"):
        summarise(point.isel(trial=[2]), 1.5, metric="rms")


def test_each_scheme_is_summarised_at_the_last_trial_of_its_own_best_point():
    """One is best after four trials, the other after two, since it diverges in the third one."""
    whole = np.array([[8.0, 4.0, 2.0, 1.0], [8.0, 3.0, np.inf, np.inf]])
    errors = np.stack([np.where(np.arange(4) < J, whole, np.nan) for J in (2, 4)], axis=1)
    errors = errors[:, :, None] * np.arange(1, 4)[:, None]  # three machines
    lost = np.isinf(errors)
    at = np.where(lost.any(axis=-1), 3, 0)
    dims = ("scheme", "trials", "sample", "trial")
    dataset = xr.Dataset(
        {"rms": (dims, errors), "finite": (dims, ~np.isnan(errors) & ~lost),
         "diverged_at": (dims[:-1], at), "e": (("scheme", "trials", "sample", "time"), errors)},
        {"scheme": ["slow", "fast"], "trials": [2, 4], "sample": range(3), "trial": range(1, 5)},
    )  # fmt: skip
    best = best_points(dataset, 2.0, metric="rms")
    found = at_best(dataset, best)
    assert found.sizes["trial"] == 4
    rows = summarise(found, 2.0, metric="rms")
    assert [row.worst.tolist() for row in rows] == [[24, 12, 6, 3], [24, 9]]
    for row, of in zip(rows, best, strict=True):
        assert (row.yield_share, row.high[-1]) == (of.yield_share, of.error)
    assert [row.yield_share for row in rows] == [2 / 3, 0.0]
    assert [row.diverged for row in rows] == [0.0, 0.0]
    *panels, shares = error_band(found, metric="rms")
    assert shares.figure.get_suptitle() == "3 machines, 2 to 4 trials"
    assert [ax.get_lines()[1].get_xdata()[-1] for ax in panels] == [4, 2]
    drawn = {line.get_label(): line.get_xdata() for line in shares.get_lines()}
    assert {1.0, 2.0, 3.0} < set(drawn["slow"])
    assert {3.0, 6.0, 9.0} < set(drawn["fast"])
    assert signal_of(found.sel(sample=0), "e", "fast", 2).shape == (4, 1)


def test_long_values_are_told_in_short_and_alike_ones_are_told_apart():
    long = np.asarray(TASK.reference)
    grid = {"task.reference": [long, 2 * long], "learning.lam/learning.mu": [[0.1, 0.2], [1, 2]]}
    (best,) = best_points(dataclasses.replace(ONE, machines=1, grid=grid).run())
    assert f"({len(long)} values)" in best.sentences[0]
    assert len(best.sentences[0]) < 200
    close = dataclasses.replace(
        ONE, uncertainty={}, machines=1, grid={"plant.poles": [[1.0, 2, 3], [1.0 + 1e-9, 2, 3]]}
    )
    labels = close.axes.axes[0].labels["machine.plant.poles"]
    assert labels.tolist() == ["1 2 3", "1.000000001 2 3"]


@pytest.mark.thorough
def test_values_that_are_wholes_replace_machine_schemes_and_task():
    other = dataclasses.replace(PLAN, machine=GRID.at(
        {"learning.lam": 1.0, "learning.lead": 0, "machine.plant.gain": 0.5 * GAIN}
    ).machine)  # fmt: skip
    grid = {"learning.lam": [0.5, 2.0], "reading": {"as printed": PLAN, "half": other}}
    dataset = dataclasses.replace(ONE, grid=grid).run()
    assert dataset["rms"].dims[1:3] == ("learning.lam", "reading")
    by_gain = dataclasses.replace(ONE, grid={"learning.lam": [0.5], "plant.gain": [GAIN / 2]}).run()
    np.testing.assert_allclose(
        dataset["rms"].sel({"learning.lam": 0.5, "reading": "half"}),
        by_gain["rms"].isel({"learning.lam": 0, "machine.plant.gain": 0}),
        rtol=1e-12,
    )


@pytest.mark.parametrize(
    ("grid", "message"),
    [
        (5, "grid = 5 is a int; allowed are values by name"),
        ({3: [1]}, "3 is not a name, or names with / between them"),
        ({"learning.lm": [1]}, "'learning.lm' cannot be an axis; did you mean learning.lam"),
        ({"pid.kp": [1]}, "'pid.kp' cannot be an axis; known: trials, machine.plant.gain"),
        ({"machine.plant": [1]}, "'machine.plant' cannot be an axis"),
        ({"plant.gain": [1], "machine.plant.gain": [2]}, "gain is set a second time, by machine"),
        ({"plant.poles": [[1.0, 2, 3]], "plant.poles[0]": [2]}, "poles is set a second time"),
        ({"plant.poles[2]": [5, 6]}, r"poles\[2\] is drawn from Uniform.*allowed is a relative"),
        ({"plant.poles": [1, 2]}, r"has shape \(3,\), and its values \(\); .* say .*poles\[0\]"),
        ({"learning.lam": [1, np.nan]}, "learning.lam = nan is outside its allowed range"),
        ({"learning.lam": "1, 2, 1"}, "learning.lam has 1.0 2 times"),
        ({"learning.lam": []}, "learning.lam has no values"),
        ({"learning.lam": ","}, "learning.lam has no values"),
        ({"learning.lam": "0:1"}, "learning.lam = '0:1' is not LOW:HIGH:COUNT"),
        ({"learning.lam": "0:1:3log"}, r"the low end = 0 is outside its allowed range \(0, inf\)"),
        ({"learning.lam": "-1:1:3"}, r"learning.lam = -1 is outside its allowed range \(0, inf\)"),
        ({"learning.lam": "a, b"}, "learning.lam = 'a' is not a number"),
        ({"learning.lam": f"1:2:{10**15}"}, r"values = 1e\+15 take 6.4e\+07 GB of memory, where"),
        ({"learning.lam": "1:2:9999", "plant.gain": "1:2:9999"}, r"points = 99980001 take .* GB"),
        ({"learning.lam/learning.rho": "1, 2/0.5"}, "lam has 2 and learning.rho has 1 values"),
        ({"learning.lam/learning.rho": "1/2/3"}, "has values for 3 names; allowed is one part"),
        ({"learning.lam/learning.rho": ["1", "2"]}, "allowed are a list for each name, or the"),
        ({"learning.lead": "0:1:3"}, "lead = 0.5 is outside its allowed range .* whole numbers"),
        ({"learning.lead": np.arange(3000)}, r"lead = 2999 is outside its .* range \[0, 59\]"),
        ({"learning.reset": "book, boko"}, "reset = 'boko' is not one of 'book'"),
        ({"trials": [1.5]}, r"trials = 1.5 is outside its allowed range \[1, inf\)"),
        ({"task.dt": [1e-3, 2e-3]}, "has a task with dt = 0.002, and the sweep one with 0.001"),
        ({"a": {"x": PLAN}, "b": {"x": PLAN}}, "a and b are options of the scenario, each"),
        ({"a": {"x": 3}}, "a = 'x': 3; allowed is what has a machine, a task and the schemes"),
        ({"rms": {"x": PLAN}}, "'rms' cannot be the name of a dimension"),
    ],
)  # fmt: skip
def test_bad_grids_are_named_before_anything_runs(grid, message, monkeypatch):
    monkeypatch.setattr(capacity, "host_bytes", lambda: 2**34)
    monkeypatch.setattr(Sweep, "host", None)
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(ONE, grid=grid)


@pytest.mark.parametrize("seed", range(8))
def test_a_grid_is_refused_where_one_of_its_points_is(seed, monkeypatch):
    """Leaves were checked with the value that a static axis replaces, and then gave NaN."""
    monkeypatch.setattr(Sweep, "host", None)
    rng = np.random.default_rng(seed)
    longest, period = rng.uniform(0.03, 0.06, 3).tolist(), rng.uniform(0.01, 0.05, 3)

    def of(period, longest, grid):
        law = RepetitiveControl(LearningFilter([0.5]), period, longest)
        return dataclasses.replace(ONE, schemes={"law": law}, grid=grid)

    grid = {"law.longest": longest, "law.period": period}
    if max(period) < min(longest):
        assert of(0.02, 0.01 + max(longest), grid).axes.size == 9
    else:
        with pytest.raises(ValueError, match="from what the law"):
            of(0.02, 0.01 + max(longest), grid)
    for x, y in product(period, longest):
        with nullcontext() if x < y else pytest.raises(ValueError, match="from what the law"):
            of(x, y, {})


def test_a_value_that_an_axis_replaces_is_not_checked(monkeypatch):
    """It was refused, although it is run nowhere."""
    monkeypatch.setattr(Sweep, "host", None)
    late = {"learning": dataclasses.replace(LEARNING["learning"], lead=5000)}
    plan = dataclasses.replace(ONE, schemes=late, grid={"learning.lead": [0, 2]})
    assert plan.axes.size == 2
    for grid in ({}, {"learning.lam": [1.0, 2.0]}):
        with pytest.raises(ValueError, match="CFDLMFAILC: lead = 5000 is outside its"):
            dataclasses.replace(plan, grid=grid)
    with pytest.raises(ValueError, match="grid: other: CFDLMFAILC: lead = 5000"):
        dataclasses.replace(plan, schemes=late | {"other": late["learning"]})
    with pytest.raises(ValueError, match="scheme = 3 is a int"):
        dataclasses.replace(plan, schemes={"learning": 3})
    late = Request("cao-2019", schemes=("cfdl-mfailc",), set=("cfdl-mfailc.lead=50000",))
    with pytest.raises(Killed):  # where it would run
        sweep(late, grid="cfdl-mfailc.lead=0,2", run=Mock(side_effect=Killed))


def test_a_value_that_an_axis_replaces_is_not_checked_beside_other_axes(tmp_path):
    """It was refused beside an option of a scenario, and where the axis is that of a plant file."""
    law, run = "cfdl-mfailc", Mock(side_effect=Killed)  # where it would run
    late = Request("cao-2019", schemes=(law,), set=(f"{law}.lead=50000",))
    options, of_lead = "reading=stroke,amplitude", f"{law}.lead=0,2"
    with pytest.raises(Killed):
        sweep(late, grid=[options, of_lead], run=run)
    file = tmp_path / "axis.toml"
    of_grid = '[grid]\n"law.lead" = [0, 1]\n'
    law_of_file = p_type(5.0, name="law")
    file.write_text(f"trials = 2\n{first_order()}{follows(50.0, 0.02)}{law_of_file}{of_grid}")
    of_file = Request(str(file), set=("law.lead=50000",))
    with pytest.raises(Killed):
        sweep(of_file, run=run)
    for request, grid in ((late, options), (late, ()), (of_file, "law.lead=50000,50001")):
        with pytest.raises(ValueError, match=r"lead = 5000[01] is outside its"):
            sweep(request, grid=grid, run=run)


def test_leaves_are_checked_at_their_ends_together(monkeypatch):
    """Each alone fits the segments."""
    monkeypatch.setattr(Sweep, "host", None)
    cut = SwitchableFilter([50.0, 90.0], times=[0.03], width=0.01)
    one = dataclasses.replace(ONE, schemes={"law": Filtered(PIDType(0.5), cut)})
    grid = {"law.filter.times[0]": [0.03, 0.02], "law.filter.width": [0.01, 0.025]}
    with pytest.raises(ValueError, match=r"width = 0.025 s is outside .*\[0, 0.02\]"):
        dataclasses.replace(one, grid=grid)


def test_of_many_static_values_those_between_the_ends_are_checked_once(monkeypatch):
    """Each value at each corner of the leaves took 18 s for 600 values and four leaves."""
    monkeypatch.setattr(Sweep, "host", None)
    checked, check = [], grid_module.check
    monkeypatch.setattr(grid_module, "check", lambda *of: (checked.append(of), check(*of)))
    leaves = {"learning.lam": [1.0, 2.0], "plant.gain": [GAIN, 2 * GAIN]}
    leaves |= {"machine.sensor.noise": [0, 1e-6]}
    grid = {"learning.lead": [*range(8)], **leaves}
    dataclasses.replace(ONE, grid=grid)
    every = len(checked)
    monkeypatch.setattr(grid_module, "MANY", 8 * 8 - 1)
    dataclasses.replace(ONE, grid=grid)
    laws = len(ONE.schemes)
    assert [every, len(checked) - every] == [laws * 8 * (2 + 8), laws * (8 * 2 + 8)]
    with pytest.raises(ValueError, match="lead = 5000 is outside"):
        dataclasses.replace(ONE, grid={**grid, "learning.lead": [0, 5000, 1]})


@pytest.mark.parametrize("name", ["a.b", "a/b"])
def test_a_scheme_whose_name_no_axis_can_have_is_told_to_be_renamed(name):
    def plan(grid):
        return dataclasses.replace(ONE, schemes={name: PID(kp=-5.0)}, grid=grid)

    for axis in (f"{name}.kp", f"plant.gain / {name}.kp", (f"{name}.kp",)):
        with pytest.raises(ValueError, match=f"a scheme is called '{name}', .* without . and /"):
            plan({axis: [-1.0, -2.0]})
    assert plan({"plant.gain": [GAIN, 2 * GAIN]}).axes.points == 2


def made_up(errors, lost):
    """Return a dataset of one scheme over two axes, one machine a point, two trials."""
    errors, lost = np.asarray(errors, float), np.asarray(lost, bool)
    dims = ("scheme", "a", "b", "sample", "trial")
    whole = np.stack([np.ones_like(errors), errors], axis=-1)[None, :, :, None]
    gone = np.stack([lost & False, lost], axis=-1)[None, :, :, None]
    at = (2 * lost)[None, :, :, None]
    return xr.Dataset(
        {"settled_error": (dims, whole), "finite": (dims, ~gone), "diverged_at": (dims[:-1], at)},
        {"scheme": ["law"], "a": [0.1, 1.0, 10.0], "b": [1, 2, 3, 4]},
    )


def test_the_best_point_its_flatness_and_the_edge_to_divergence():
    errors = [[9, 4, 3, 9], [9, 1.5, 1, 8], [9, 9, 1.9, 2]]
    lost = [[0, 0, 0, 1], [1, 0, 0, 1], [0, 0, 0, 0]]
    dataset = made_up(errors, lost)
    (best,) = best_points(dataset)
    assert best.point == {"a": 1.0, "b": 3}
    assert best.error == 1.0
    assert best.near == 4 / 12
    assert best.along == {"a": (1.0, 10.0), "b": (2, 3)}
    assert best.diverged == 3 / 12
    assert best.edges == {"a": (None, None), "b": (1, 4)}
    (row,) = summarise(at_best(dataset, [best]), 1.5)
    assert row.median.tolist() == [1.0, 1.0]
    with pytest.raises(ValueError, match=r"has a grid over a, b; allowed is one point"):
        summarise(dataset, None)


def test_below_and_above_are_those_of_the_values_whatever_their_order():
    errors = np.array([[9, 1.5, 1, 1.9], [9, 9, 9, 9], [9, 9, 9, 9]])
    lost = np.array([[1, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0]])
    dataset = made_up(errors, lost)
    (rising,), (falling,) = best_points(dataset), best_points(dataset.isel(b=[3, 0, 2, 1]))
    assert rising.edges["b"] == (1, None)
    for field in ("point", "along", "edges", "near", "sentences"):
        assert getattr(falling, field) == getattr(rising, field)


def test_the_sentences_on_a_shared_axis_have_the_names_and_values_of_their_scheme():
    dataset = made_up([[1.0, 3, 9, 9]] * 3, [[0, 0, 1, 1]] * 3).rename(b="other.gain")
    name = str(dataset["scheme"].values[0])
    own = {f"{name}.lam": ("other.gain", [10.0, 20.0, 30.0, 40.0])}
    (best,) = best_points(dataset.assign_coords(own))
    assert best.point["other.gain"] == dataset["other.gain"].values[0]
    assert "other" not in " ".join(best.sentences)
    assert f"{name}.lam = 10" in best.sentences[0]
    assert f"{name}.lam = 30 up" in best.sentences[2]


def test_the_best_point_has_the_largest_yield_first():
    dataset = xr.concat([made_up([[1.0, 3, 9, 9]] * 3, [[0] * 4] * 3),
                         made_up([[5.0, 4, 9, 9]] * 3, [[0] * 4] * 3)], "sample")  # fmt: skip
    (best,) = best_points(dataset, 4.5)
    assert (best.point["b"], best.yield_share) == (2, 1.0)


def test_the_sentences_name_what_makes_a_point_the_best_one():
    """Of ten machines at each point one or none diverges, or one is far above the others."""
    kinds = {"low": [4.0] * 10, "far": [1.0] * 9 + [6.0], "gone": [1.0] * 9 + [np.inf]}

    def said(points, tolerance):
        machines = zip(*(kinds[point] for point in points), strict=True)
        each = [made_up([row] * 3, [np.isinf(row)] * 3) for row in machines]
        (best,) = best_points(xr.concat(each, "sample"), tolerance)
        return best.point["b"], best.sentences

    b, told = said(["far", "far", "low", "far"], 5.0)
    assert (b, told[0]) == (3, "law has its least error at a = 0.1 and b = 3.")
    b, told = said(["low", "low", "gone", "low"], 2.0)  # 90 % end within it at b = 3, 0 elsewhere
    assert (b, told[0]) == (3, "law has its largest yield at a = 0.1 and b = 3.")
    assert told[1] == "More than 5 % of the machines diverge there."
    b, told = said(["low", "low", "gone", "low"], None)
    assert (b, told[0]) == (1, "law has its least error at a = 0.1 and b = 1.")
    _, told = said(["gone"] * 4, None)
    assert told == ("law: more than 5 % of the machines diverge at every point.",)


@pytest.mark.parametrize(
    ("errors", "end"),
    [
        ([1, 2, 3, 4], "law.lam = 10 is the least value that was tried"),
        ([4, 3, 2, 1], "law.lam = 40 is the largest value that was tried"),
        ([2, 1, 3, 4], ""),
        ([1, 1, 3, 4], ""),
    ],
)
def test_a_best_point_at_an_end_of_an_axis_is_told(errors, end):
    dataset = made_up([errors] * 3, [[0] * 4] * 3).rename(b="law.lam", a="machine.gain")
    dataset = dataset.assign_coords({"law.lam": [10, 20, 30, 40]})
    for one in (dataset, dataset.isel({"law.lam": [1, 0, 3, 2]})):
        (best,) = best_points(one)
        assert best.sentences[3:] == ((f"{end}: beyond it may be a better one.",) if end else ())


def test_a_range_of_a_leaf_is_read_at_once(monkeypatch):
    """A million values, each by itself, took ten seconds."""
    monkeypatch.setattr("jaxilc.sweeps.grid._one", None)
    (axis,) = dataclasses.replace(ONE, grid={"learning.lam": "0.1:10:3log"}).axes.axes
    np.testing.assert_allclose(axis.values["learning.lam"], [0.1, 1.0, 10.0])


@pytest.mark.thorough
def test_an_experiment_at_the_end_of_a_point_does_not_judge_it():
    """A learning step takes two trials, or three; the first alone plays what was learned."""
    grid = {"law.about": ["trial", "mean"], "trials": [3, 6]}
    laws = {"law": ModelFreeGradient(step=0.3)}
    dataset = dataclasses.replace(ONE, schemes=laws, grid=grid).run()
    of = dataset["settled_error"].isel(scheme=0).max("sample").values
    last = np.array([[of[0, 0, 2], of[0, 1, 4]], [of[1, 0, 0], of[1, 1, 3]]])
    (best,) = best_points(dataset)
    assert (best.error, best.near) == (last.min(), np.mean(last <= 2 * last.min()))
    (row,) = summarise(at_best(dataset, [best]), last.min(), growth=0.1)
    assert (row.yield_share, row.semi_converged) == (1.0, 0.0)
    assert row.worst[-1] > 1.1 * last.min(), "the error of the experiment itself is among them"
    (line,) = error_band(at_best(dataset, [best]))[-1].lines
    assert line.get_xdata()[-2] == last.min(), "the largest error of the shares of the machines"
    gone = dataset.assign(finite=dataset["finite"] & (dataset["trial"] < 6))
    assert best_points(gone)[0].point == {"law.about": "trial", "trials": 3}


def test_anything_as_a_grid_is_run_or_refused():
    small = [x for x in HOSTILE if not (isinstance(x, int) and x > 1000)]
    known = ("learning.lam", "plant.gain", "learning.lead", "trials", "learning.lam/trials")
    keys = (*known, *known, "a", "", 3, None, (), ("learning.lam", "learning.rho"), (1,))

    def attempt(rng):
        one, two = pick(rng, small), pick(rng, small)
        grid = {pick(rng, keys): pick(rng, (one, [one, two], {"x": one}, {1: PLAN}))}
        dataclasses.replace(ONE, grid=one if rng.random() < 0.05 else grid)

    fuzz(200, attempt)
