"""Sweeps equal single runs, resume bit for bit, and refuse what does not fit.

Their summary is tested too.
"""

import dataclasses
from pathlib import Path

import jax
import numpy as np
import pytest
import xarray as xr
from scipy.stats import binomtest
from sweep_case import PLAN, TASK

import jaxilc
from jaxilc import Machine, Sweep, Task, Uniform, summarise
from jaxilc.plants import DifferenceEquation, StateSpace
from jaxilc.runtime import capacity, tiled
from jaxilc.runtime.earlier_names import takes_also
from jaxilc.schemes import CFDLMFAILC, PID, PIDType
from jaxilc.sweeps import sweep as sweep_module
from jaxilc.sweeps.host import Host
from jaxilc.sweeps.summary import errors_of, last_errors, wilson_interval
from jaxilc.theory import BoundsWatch


@pytest.fixture(scope="module", autouse=True)
def programs():
    """Compile the chunks of PLAN once for all its runs here."""
    make, hosts = Sweep.host, {id(PLAN): PLAN.host()}
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(Sweep, "host", lambda self: hosts.get(id(self)) or make(self))
        yield


@pytest.fixture(scope="module")
def dataset(programs):
    return PLAN.run()


def resumed(plan, store):
    """Return the dataset of a store that a plan goes on with, and how many machines it computed."""
    computed = []
    dataset = plan.run(store, resume=True, progress=lambda *told: computed.append(told[-1]))
    return dataset, computed


@pytest.mark.thorough
def test_each_sample_can_be_rebuilt_and_run_alone(dataset):
    for i in (0, 3, 10):
        machine, key = PLAN.machine_of(i), PLAN.key_of(i)
        alone = jaxilc.learn(machine, PLAN.schemes["learning"], TASK, 4, key=key)
        of_sweep = dataset.sel(scheme="learning", sample=i)
        np.testing.assert_allclose(of_sweep["rms"], alone.rms[:, 0], rtol=1e-10)
        np.testing.assert_allclose(of_sweep["e"], alone.final.e[:, 0], rtol=1e-10, atol=1e-14)
        assert float(of_sweep["plant.poles[2]"]) == float(machine.plant.poles[2])


def test_the_dataset_is_labelled(dataset):
    assert dataset["settled_error"].dims == ("scheme", "sample", "trial")
    assert dataset["u"].dims == ("scheme", "sample", "input_time")
    assert dataset["rms"].attrs["units"] == "mm"
    assert set(dataset.coords) >= {"plant.gain", "plant.poles[2]", "scheme", "sample", "trial"}
    configuration = dataset.attrs["configuration"]
    assert configuration["seed"] == 7
    assert configuration["environment"]["versions"]["jax"] == jax.__version__
    assert configuration["schemes"]["learning"]["lam"] == 1.0


def test_a_store_of_another_configuration_is_refused(tmp_path):
    store = tmp_path / "store.zarr"
    PLAN.run(store)
    with pytest.raises(FileExistsError, match="exists already"):
        PLAN.run(store)
    said = "another configuration; it differs in: seed: 7 there, 8 here"
    with pytest.raises(ValueError, match=said):
        dataclasses.replace(PLAN, seed=8).run(store, resume=True)
    longer = Task(reference=np.r_[TASK.reference, [[0.5]]], dt=1e-3)
    with pytest.raises(ValueError, match=r"task.reference.shape"):
        dataclasses.replace(PLAN, task=longer).run(store, resume=True)
    for name in ("schemes", "uncertainty"):  # machines are drawn, and stored, in this order
        turned = dict(reversed(getattr(PLAN, name).items()))
        with pytest.raises(ValueError, match=rf"{name}: in the order .* there, .* here"):
            dataclasses.replace(PLAN, **{name: turned}).run(store, resume=True)
    own = {"own": lambda trial: trial.e[0, 0]}
    with pytest.raises(ValueError, match=r"it differs in: quantities\.own: None there, "):
        dataclasses.replace(PLAN, quantities=own).run(store, resume=True)
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match="not a store that can be resumed"):
        PLAN.run(tmp_path / "empty", resume=True)


def earlier_names(configuration):
    """Return a configuration as it was before a watch, when machines were called samples."""
    renamed = {"samples" if name == "machines" else name: of for name, of in configuration.items()}
    return {name: of for name, of in renamed.items() if name != "watch"}


def test_a_store_under_earlier_names_is_resumed_and_opened(tmp_path, dataset, monkeypatch):
    configuration, store = Sweep.configuration, tmp_path / "store.zarr"

    def stop_after_second_chunk(name, done, fresh):
        if done >= 8:
            raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(Sweep, "configuration", lambda *a: earlier_names(configuration(*a)))
        with pytest.raises(KeyboardInterrupt):
            PLAN.run(store, progress=stop_after_second_chunk)
    with pytest.raises(ValueError, match="it differs in: machines: 11 there, 12 here"):
        dataclasses.replace(PLAN, machines=12).run(store, resume=True)
    whole, computed = resumed(PLAN, store)
    assert computed == [0, 0, 3, 4, 4, 3]
    assert whole.attrs["configuration"] == earlier_names(dataset.attrs["configuration"])
    xr.testing.assert_identical(whole.drop_attrs(deep=False), dataset.drop_attrs(deep=False))
    xr.testing.assert_identical(jaxilc.open_dataset(store), whole)
    # The variables are sorted, in whatever order the file system lists them.
    listed = Path.iterdir
    for order in (sorted, lambda of: sorted(of, reverse=True)):
        monkeypatch.setattr(Path, "iterdir", lambda self, order=order: iter(order(listed(self))))
        assert [*jaxilc.open_dataset(store).data_vars] == sorted(dataset.data_vars)


def test_the_results_of_each_chunk_are_told_when_they_are_computed(dataset, tmp_path):
    told = {name: [] for name in PLAN.schemes}

    def results(name, values):
        told[name].append(last_errors(values, "rms"))

    PLAN.run(tmp_path / "store.zarr", results=results)
    for name, chunks in told.items():
        assert [len(of) for of in chunks] == [4, 4, 3]
        whole = errors_of(dataset, "rms").sel(scheme=name).values
        np.testing.assert_array_equal(np.concatenate(chunks), whole[:, -1])
        chunks.clear()
    PLAN.run(tmp_path / "store.zarr", resume=True, results=results)
    assert not any(told.values()), "nothing was left to compute"


def test_the_first_chunk_is_told_before_other_schemes_are_compiled(dataset, tmp_path, monkeypatch):
    store, first, host = tmp_path / "store.zarr", [], Sweep.host(PLAN)

    def results(name, values):
        assert not store.exists()
        first.append((name, last_errors(values, "rms")))

    def compiling(*_):
        raise KeyboardInterrupt

    plan = dataclasses.replace(PLAN)
    monkeypatch.setattr(Sweep, "host", lambda _: host)
    monkeypatch.setattr(Host, "environment", property(compiling))
    with pytest.raises(KeyboardInterrupt):
        plan.run(store, results=results, progress=lambda *_: pytest.fail("nothing is stored"))
    monkeypatch.undo()
    ((name, errors),) = first
    whole = errors_of(dataset, "rms").sel(scheme=name).values
    np.testing.assert_array_equal(errors, whole[:4, -1])
    xr.testing.assert_identical(plan.run(store), dataset)


def test_the_last_errors_are_the_largest_channel_and_infinite_where_a_machine_diverged():
    values = {"rms": np.ones((3, 2, 2)) * [1.0, 3.0], "finite": np.ones((3, 2), bool)}
    values["diverged"] = np.array([[False, False], [False, True], [False, False]])
    values["finite"][2, 1] = False
    np.testing.assert_array_equal(last_errors(values, "rms"), [3.0, np.inf, np.inf])


def test_a_population_takes_the_place_of_the_machine():
    given = {"keep": PLAN.keep, "chunk": 4, "lanes": 2}
    same = Sweep(PLAN.population, PLAN.schemes, TASK, 4, **given)
    assert same.configuration() == PLAN.configuration()
    assert same.machine is PLAN.machine
    fewer = Sweep(PLAN.population, PLAN.schemes, TASK, 4, machines=3, **given)
    assert fewer.plan.members == 3
    many = dataclasses.replace(PLAN, machines=2, sampling="corners", chunk=None, lanes=None)
    assert (many.machines, many.chunk, many.lanes) == (2, None, None)
    assert [many.configuration()[name] for name in ("machines", "chunk")] == [5, 256]


def test_chunks_grow_with_the_machines_but_not_with_what_is_kept_of_them(monkeypatch):
    monkeypatch.setattr(capacity, "host_bytes", lambda: 2**40)
    given = (PLAN.machine, PLAN.schemes, TASK, 4, PLAN.uncertainty)
    chunks = {count: Sweep(*given, machines=count).plan.chunk for count in (1, 4096, 2**14, 2**17)}
    assert chunks == {1: 256, 4096: 256, 2**14: 1024, 2**17: 2048}
    long = Task(reference=np.zeros(10_001), dt=1e-3)
    large = Sweep(*given[:2], long, 4, PLAN.uncertainty, machines=2**17, keep=("y",))
    assert large.plan.chunk == 768  # 80 kB of each machine
    assert Sweep(*given, machines=2**17, chunk=300).plan.chunk == 300


@pytest.mark.thorough
def test_a_store_keeps_its_chunks_where_none_are_asked_for(tmp_path, monkeypatch):
    feedback = {"feedback": PLAN.schemes["feedback"]}
    given = {"schemes": feedback, "trials": 2, "keep": (), "machines": 5, "chunk": None}
    store = tmp_path / "store.zarr"
    monkeypatch.setattr(sweep_module, "CHUNK", 4)
    whole = dataclasses.replace(PLAN, **given).run(store)
    monkeypatch.setattr(sweep_module, "CHUNK", 8)
    again, computed = resumed(dataclasses.replace(PLAN, **given), store)
    assert computed == [0, 0]
    xr.testing.assert_identical(again, whole)
    of_numpy = dataclasses.replace(PLAN, **given | {"chunk": np.int64(4)})
    xr.testing.assert_identical(of_numpy.run(tmp_path / "other.zarr"), whole)
    with pytest.raises(ValueError, match="it differs in: chunk: 4 there, 3 here"):
        dataclasses.replace(PLAN, **given | {"chunk": 3}).run(store, resume=True)


def test_the_earlier_name_of_machines_is_understood():
    given = (PLAN.machine, PLAN.schemes, TASK, 4, PLAN.uncertainty)
    assert Sweep(*given, samples=3).machines == 3
    with pytest.raises(TypeError, match="Sweep: samples is now machines; both were given"):
        Sweep(*given, samples=3, machines=3)
    call = takes_also(samples="machines")(lambda *, machines=1: machines)
    assert (call(), call(machines=2), call(samples=3)) == (1, 2, 3)


def test_a_sweep_of_which_a_part_is_computed_has_no_summary(tmp_path):
    store = tmp_path / "store.zarr"

    def stop(*_):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        PLAN.run(store, progress=stop)
    part = jaxilc.open_dataset(store)
    with pytest.raises(ValueError, match="18 of 22 results of the dataset are not computed"):
        summarise(part, 1.0)
    done = part.sel(scheme=["learning"])
    done = done.sel(sample=(done.diverged_at >= 0).all("scheme"))
    (row,) = summarise(done, 1.0)
    assert row.diverged == 0


def test_several_channels_stay_apart():
    two = StateSpace(np.diag([0.9, 0.8]), np.eye(2), np.eye(2), dt=1e-3)
    task = Task(reference=np.ones((31, 2)), dt=1e-3)
    plan = Sweep(
        Machine(two), {"pid": PID(kp=0.2)}, task, 2, {"plant.B": Uniform(0.9, 1.1, relative=True)},
        machines=3, keep=("y", "u"),
    )  # fmt: skip
    dataset = plan.run()
    assert dataset["rms"].dims == ("scheme", "sample", "trial", "channel")
    assert dataset["u"].dims == ("scheme", "sample", "input_time", "input")
    assert summarise(dataset, 1.0)[0].median.shape == (2,)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"trials": 0}, r"trials = 0 is outside its allowed range \[1, inf\)"),
        ({"keep": ("x",)}, "keep = 'x' is not one of y, e, u"),
        ({"schemes": {}}, "schemes is empty"),
        ({"uncertainty": {"plant.mass": Uniform(1, 2)}}, "plant.mass.*Known"),
        ({"quantities": {"sample": np.sum}}, "quantity = 'sample' is a coordinate of the dataset"),
        ({"quantities": {"N/mm": np.sum}}, "quantity = 'N/mm' cannot name a variable of a store"),
        ({"schemes": {"task": PID()}}, "schemes has a scheme 'task', with which a grid names"),
    ],
)
def test_bad_input_is_named_before_anything_runs(change, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(PLAN, **change)


def test_a_quantity_that_is_no_number_is_named_before_anything_is_computed():
    plan = dataclasses.replace(PLAN, quantities={"all": lambda trial: trial.e[:, 0]})
    with pytest.raises(ValueError, match=r"quantity = 'all' has shape \(\d+,\); allowed is one"):
        plan.run(progress=lambda *told: pytest.fail("something was computed"))


def test_tiles_equal_a_loop_whatever_the_batch_size():
    run = tiled(lambda common, one: common * one**2, lanes=3)
    for size in (1, 5, 12):
        batch = np.arange(size, dtype=float)
        np.testing.assert_array_equal(run(2.0, batch), 2.0 * batch**2)
    with pytest.raises(ValueError, match=r"lanes = 0"):
        tiled(lambda common, one: one, lanes=0)
    for batch in (np.zeros(0), (np.zeros(2), np.zeros(3)), 1.0):
        with pytest.raises(ValueError, match=r"leading axes .*; allowed is one length of all"):
            run(2.0, batch)


def made_up(errors):
    errors = np.asarray(errors, float)[None]
    dims = ("scheme", "sample", "trial")
    values = {"settled_error": (dims, errors), "finite": (dims, np.isfinite(errors))}
    return xr.Dataset(values, {"scheme": ["s"]})


def test_summary_counts_yield_growth_and_divergence():
    steady, growing, noisy, lost = [9, 2, 0.5], [9, 0.2, 0.8], [9, 0.5, 0.51], [9, np.inf, np.nan]
    (row,) = summarise(made_up([steady, growing, noisy, lost]), tolerance=0.6)
    assert row.yield_share == 0.5  # the machines steady and noisy
    assert row.semi_converged == 0.25  # the machine growing; a rise of 2 % is not growth
    assert row.diverged == 0.25
    assert row.worst[-1] == np.inf
    assert row.worst_machine[-1] == 3
    assert row.median[0] == 9
    # of machine 0, the nominal one, it says nothing: of the three others one passes
    wanted = binomtest(1, 3).proportion_ci(method="wilson")
    np.testing.assert_allclose([row.yield_low, row.yield_high], wanted, rtol=1e-12)


def test_the_interval_of_the_yield_is_claimed_of_drawn_machines_only():
    """A nominal machine that always passes would have it miss a yield of 5 % in 3 cases of 10."""
    rng, held = np.random.default_rng(3), 0
    for _ in range(200):
        passes = np.r_[True, rng.random(7) < 0.05]
        (row,) = summarise(made_up(np.where(passes, 0.5, 2.0)[:, None]), tolerance=1.0)
        held += row.yield_low <= 0.05 <= row.yield_high
    assert held >= 180
    corners = made_up([[0.5], [0.5], [2.0]]).assign_attrs(configuration={"sampling": "corners"})
    (row,) = summarise(corners, tolerance=1.0)
    assert row.yield_share == 2 / 3
    assert np.isnan([row.yield_low, row.yield_high]).all()


def test_the_interval_of_a_share_is_wilsons():
    for k, n in ((0, 1), (1, 1), (0, 40), (1, 3), (40, 40), (65535, 65536)):
        wanted = binomtest(k, n).proportion_ci(method="wilson")
        np.testing.assert_allclose(wilson_interval(k, n), wanted, rtol=1e-12)


def test_the_summary_of_a_selection_keeps_the_numbers_of_machines_and_trials():
    rng = np.random.default_rng(5)
    many = made_up(np.exp(rng.normal(size=(9, 7))) + np.where(np.arange(7) == 4, np.inf, 0.0))
    many = many.assign_coords(sample=np.arange(9), trial=1 + np.arange(7))
    (whole,) = summarise(many, 1.0)
    (one,) = summarise(many.sel(scheme="s"), 1.0)
    np.testing.assert_array_equal(one.worst, whole.worst)
    assert (one.yield_share, one.diverged_at) == (whole.yield_share, 5)
    (some,) = summarise(many.isel(sample=[2, 5, 8], trial=slice(2, 7)), 1.0)
    worst = many["settled_error"].values[0, [2, 5, 8], 6].argmax()
    assert (some.worst_machine[-1], some.diverged_at) == ([2, 5, 8][worst], 5)
    (alone,) = summarise(many.sel(sample=5, trial=[7]), None)
    assert alone.worst_machine == [5]
    (grown,) = summarise(many.isel(trial=slice(0, 4)).drop_vars("trial"), None)
    (later,) = summarise(many.isel(trial=slice(0, 4)).assign_coords(trial=11 + np.arange(4)), None)
    assert later.grown_from == grown.grown_from + 10 > 10


def test_summary_names_what_is_wrong():
    with pytest.raises(ValueError, match=r"tolerance = 0 is outside"):
        summarise(made_up([[1.0]]), 0.0)
    with pytest.raises(ValueError, match=r"dataset is a dict; allowed is a dataset of results"):
        summarise({}, 1.0)
    with pytest.raises(ValueError, match=r"metric = 'rms' is not one of finite, settled_error"):
        summarise(made_up([[1.0]]), 1.0, metric="rms")
    with pytest.raises(ValueError, match=r"not over .*, as that of run_schemes, of one machine"):
        summarise(made_up([[1.0]]).isel(sample=0, drop=True), 1.0)
    with pytest.raises(ValueError, match=r"'sample': 0, 'trial': 1}; allowed is one of each"):
        summarise(made_up([[1.0]]).isel(sample=[]), 1.0)


# What looks at two trials
# --------------------------------------------------------------------------------------------------

SMALL = Task(reference=np.sin(np.arange(21) / 3.0), dt=1e-3, unit="mm", input_unit="V")
WATCHED = Sweep(
    Machine(DifferenceEquation((0.0,), (1.0,), dt=1e-3)),
    {"a": CFDLMFAILC(phi0=0.7, reset="sign"), "b": PIDType(gamma_p=0.5)}, SMALL, trials=4,
    uncertainty={"plant.b[0]": Uniform(0.5, 2.5)}, machines=6, watch=BoundsWatch(),
)  # fmt: skip


@pytest.mark.thorough
def test_a_watch_adds_its_variables_of_machines_and_of_trials(tmp_path):
    dataset = WATCHED.run(tmp_path / "store.zarr")
    assert dataset["d2"].dims == ("scheme", "sample")
    assert dataset["contraction_norm"].dims == ("scheme", "sample", "trial")
    assert (dataset["b"].attrs["units"], dataset["lam_min"].attrs["units"]) == ("mm/V", "(mm/V)^2")
    for name, scheme in WATCHED.schemes.items():
        alone = jaxilc.learn(WATCHED.machine_of(4), scheme, SMALL, 4, watch=BoundsWatch())
        for key in BoundsWatch().variables(SMALL):
            found = dataset[key].sel(scheme=name, sample=4)
            np.testing.assert_allclose(found, alone.watched[key], rtol=1e-9, err_msg=key)
    one = dataset.sel(scheme="a")
    gains = one["plant.b[0]"]
    np.testing.assert_allclose(one["b"], gains, rtol=1e-12)
    np.testing.assert_array_equal(one["claimed"] == 1, gains**2 / 4 < 1)
    held = one["share_kept"].isel(trial=slice(1, None))
    assert bool((held.where(one["claimed"] == 1, 1.0) == 1).all())
    # P-type learning on a static plant: exactly |1 - gamma b| at every sample
    np.testing.assert_allclose(
        dataset["contraction_worst"].sel(scheme="b", trial=3), abs(1 - 0.5 * gains), rtol=1e-6
    )
    assert bool(np.isnan(dataset["d2"].sel(scheme="b")).all())


def test_a_watch_of_one_channel_and_a_name_that_it_has_are_refused():
    with pytest.raises(ValueError, match="quantity = 'd2' is a variable of the watch"):
        dataclasses.replace(WATCHED, quantities={"d2": lambda trial: trial.e[0, 0]})
    task = Task(reference=np.zeros((21, 2)), dt=1e-3)
    plant = StateSpace(-np.eye(2), np.eye(2), np.eye(2))
    schemes = {"a": PIDType(gamma_p=0.1)}
    with pytest.raises(ValueError, match="2 inputs and 2 outputs; allowed is one of each"):
        Sweep(Machine(plant), schemes, task, 3, uncertainty={}, machines=2, watch=BoundsWatch())
