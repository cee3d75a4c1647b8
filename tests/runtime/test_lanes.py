"""Lanes follow from the memory of a device, which is faked; loops over samples are unrolled."""

import dataclasses

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr
from cases import case
from gain_case import GAINS, PROBLEM, STATIC
from sweep_case import PLAN

from jaxilc import Sweep, tiled
from jaxilc.learning import learn
from jaxilc.learning.within_trial import bytes_of_trial
from jaxilc.runtime import capacity, lanes
from jaxilc.runtime.lanes import SHARE, WIDE, fitting_lanes, lanes_for, usual_lanes
from jaxilc.schemes import PIDType
from jaxilc.signals.task import Task
from jaxilc.tuning.descent import Folder, stored_lanes

DEVICES = jax.device_count()


@pytest.fixture
def device(monkeypatch):
    """Return a function that fakes an accelerator whose devices have so many bytes."""

    def fake(size):
        monkeypatch.setattr(lanes, "LANES", {})
        monkeypatch.setattr(capacity, "device_memory", lambda: size)

    return fake


def test_the_lanes_are_the_largest_power_of_two_that_fits():
    rng = np.random.default_rng(0)
    for _ in range(300):
        memory, each, beside = 10 ** rng.uniform((6, 0, 0), (12, 6, 5.5))
        machines = int(10 ** rng.uniform(0, 7))
        found = lanes_for(memory, each, machines, beside=beside)
        fits = [2**i for i in range(60) if 2**i * each + beside <= SHARE * memory]
        assert found == min(max(fits), next(2**i for i in range(60) if 2**i >= machines))
        assert lanes_for(1.7 * memory, each, machines, beside=beside) >= found


@pytest.mark.parametrize(
    ("memory", "each", "machines", "expected"),
    [
        (None, 1e5, 10**6, WIDE),  # a device that reports no memory
        (None, 1e5, np.int64(100), 128),
        (1e11, 1e5, 1, 1),
        (1e11, 0.0, 3, 4),
        (0, 0.0, 5, 8),
        (1e-300, 1e-320, 10**9, 2**30),
        (1e11, 1e5, 10**18, 2**19),
        (1e300, 1.0, 10**18, 2**60),
    ],
)
def test_absurd_sizes_have_lanes(memory, each, machines, expected):
    assert lanes_for(memory, each, machines) == expected


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            (8e9, 1e10, 4),
            r"tiled: one machine takes 10 GB of memory, where 6 GB are available of the 8 GB of a "
            "device; with 60 % of its samples it would fit",
        ),
        ((8e9, 1e13, 4), "; take fewer samples, trials or machines"),
        ((0, 1.0, 4),
         "one machine takes 1 B of memory, where 0 B are available of the 0 B of a device"),
        ((8e9, 1.0, 0), r"tiled: machines = 0 is outside its allowed range \[1, inf\)"),
        ((8e9, 1.0, 2.5),
         r"machines = 2.5 is outside its allowed range \[1, inf\) of whole numbers"),
        ((float("nan"), 1.0, 4), "tiled: memory = nan"),
        ((8e9, -1.0, 4), "tiled: of_a_machine = -1"),
        ((8e9, 1e3, 4, 7e9),
         "one machine beside 7 GB of results takes 1 kB of memory, where 6 GB"),
    ],
)  # fmt: skip
def test_what_cannot_fit_is_refused_with_what_would(arguments, message):
    sizes, beside = arguments[:3], sum(arguments[3:])
    with pytest.raises(ValueError, match=message):
        lanes_for(*sizes, beside=beside)


class Device:
    """A device of an accelerator, with the statistics of its memory."""

    def __init__(self, stats, platform="gpu"):
        self.platform, self._stats = platform, stats

    def memory_stats(self):
        return self._stats


@pytest.mark.parametrize(
    ("stats", "memory", "free"),
    [
        ([{"bytes_limit": 100, "bytes_in_use": 30}], 100, 70),
        ([{"bytes_limit": 100}, {"bytes_limit": 80, "bytes_in_use": 90}], 80, 0),
        ([{"bytes_limit": 800}, {"bytes_limit": 240, "bytes_in_use": 10}], 240, 460),
        ([{"bytes_limit": 100}, None], None, None),
        ([{"bytes_limit": 100}, {}], None, None),
        ([{"bytes_in_use": 3}], None, None),
    ],
)
def test_the_memory_is_that_of_the_smallest_device(monkeypatch, stats, memory, free):
    devices = [Device(of) for of in stats] + [Device({"bytes_limit": 1}, "cpu")]
    monkeypatch.setattr(jax, "devices", lambda: devices)
    assert (capacity.device_memory(), capacity.device_bytes()) == (memory, free)


def test_a_cpu_keeps_its_lanes():
    assert capacity.device_memory() is None
    assert fitting_lanes(lambda common, one: one, (), jnp.ones(3), 10**6) == 16
    assert dataclasses.replace(PLAN, lanes=None, chunk=None).plan.lanes == 16
    assert dataclasses.replace(PROBLEM, lanes=None).configuration()["lanes"] == 16


@pytest.mark.parametrize(
    ("samples", "expected"), [(2048, 16), (2049, 16), (4096, 16), (4097, 8), (8192, 8), (8193, 16)]
)
def test_half_a_tile_is_taken_where_only_that_fits_into_the_cache(samples, expected):
    task = Task(np.zeros(samples + 1), dt=1e-3)
    size = bytes_of_trial(PIDType(0.1), task)
    assert size == 4 * 8 * samples  # memory, schedule, y and u
    assert usual_lanes(size) == expected
    assert usual_lanes(size, backward=True) == (16 if samples == 2048 else 8)
    plan = dataclasses.replace(PLAN, schemes={"p-type": PIDType(0.1)}, task=task, lanes=None)
    assert plan.plan.lanes == expected


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["p_type", "cfdl_sign"])
def test_the_program_of_these_lanes_fits_and_that_of_twice_as_many_does_not(device, name):
    machine, scheme, task = case(name)

    def of_one(scheme, gain):
        return learn(jax.tree.map(lambda x: x * gain, machine), scheme, task, 3).metrics

    def need(size):
        run = jax.jit(jax.vmap(of_one, in_axes=(None, 0)))
        shape = jax.ShapeDtypeStruct((size,), float)
        return capacity.program_bytes(run.lower(scheme, shape), devices=1)

    device(memory := 700_000)
    found = fitting_lanes(of_one, scheme, jnp.ones(1), 10**6)
    assert found >= 16
    assert need(found) <= SHARE * memory < need(2 * found)


def test_a_batch_runs_in_tiles_that_fit(device):
    rows = np.random.default_rng(1).normal(size=(37, 50))

    def of_one(common, row):
        return common * jnp.sum(jnp.sort(jnp.outer(row, row).ravel())[::100])

    expected = np.asarray(tiled(of_one, lanes=16)(2.0, rows))
    device(2 * 10**5)
    run, share = tiled(of_one), -(-37 // DEVICES)
    found = fitting_lanes(of_one, 2.0, rows, 37, held=37)
    assert 1 < found < share
    assert f"length={-(-share // found)}" in str(jax.make_jaxpr(run)(2.0, rows))
    np.testing.assert_allclose(run(2.0, rows), expected, rtol=1e-12)
    device(20_000)
    with pytest.raises(ValueError, match=r"tiled: one machine beside .* of results takes .*, wher"):
        tiled(of_one)(2.0, rows)


def test_a_sweep_takes_what_fits_and_a_resumed_one_keeps_it(device, tmp_path):
    fields: dict = {"machine": STATIC, "schemes": {"a": PROBLEM.scheme}, "task": PROBLEM.task}
    fields |= {"trials": 2, "uncertainty": GAINS, "machines": 40}
    device(8_000)
    small = Sweep(**fields)
    assert 1 < small.plan.lanes < 40 / DEVICES
    assert small.plan.chunk == 256
    whole = small.run(tmp_path / "store.zarr")
    assert whole.attrs["configuration"]["lanes"] == small.plan.lanes
    device(10**12)
    large = Sweep(**fields)
    assert large.plan.lanes == 2 ** int(np.ceil(np.log2(40 / DEVICES)))
    resumed = large.run(tmp_path / "store.zarr", resume=True)
    xr.testing.assert_identical(resumed, whole)
    with pytest.raises(ValueError, match=f"lanes: {small.plan.lanes} there, 16 here"):
        Sweep(**fields | {"lanes": 16}).run(tmp_path / "store.zarr", resume=True)


def test_a_tuning_takes_what_fits_and_a_resumed_one_keeps_it(device, tmp_path):
    fields = {f.name: getattr(PROBLEM, f.name) for f in dataclasses.fields(PROBLEM)}
    fields |= {"lanes": None, "steps": 1, "starts": 2, "machines": 8, "held_out": 0}
    device(10**12)
    large = type(PROBLEM)(**fields).configuration()
    assert large["lanes"] == 2 ** int(np.ceil(np.log2(2 * 8 / DEVICES)))
    device(5_000)
    small = type(PROBLEM)(**fields)
    assert 1 <= small.configuration()["lanes"] < large["lanes"]
    with Folder(tmp_path / "state", large, resume=False):
        pass
    assert small.run(tmp_path / "state", resume=True).values["gamma_p"] > 0.4
    assert stored_lanes(tmp_path / "state") == large["lanes"]
    assert stored_lanes(tmp_path) is None
    device(600)  # which the losses and slopes of all machines take, too
    with pytest.raises(ValueError, match=r"Tuning: one machine beside .* of results takes"):
        type(PROBLEM)(**fields).configuration()


# each kind of loop over samples; the one of 32 samples is shorter than a pass of 64
LOOPS = (
    "ffdl_book-3", "ilc_mfapc-3", "keep_unmeasured-3", "milc-3",
    "norm_optimal-3", "p_type_butterworth-3", "p_type_iir-3", "p_type_over_pid-64",
    "pid_type_leaky_limited-3", "two_step-3",
)  # fmt: skip


@pytest.mark.thorough(but=["ffdl_book-3"])
@pytest.mark.parametrize("loop", LOOPS)
def test_the_loops_of_an_accelerator_have_the_numbers_and_slopes(monkeypatch, loop):
    name, samples = loop.split("-")
    machine, scheme, task = case(name)

    def scaled(gain, x):
        return x * gain if jnp.issubdtype(jnp.asarray(x).dtype, jnp.floating) else x

    def found():
        def loss(gain):
            changed, law = jax.tree.map(lambda x: scaled(gain, x), (machine, scheme))
            history = learn(changed, law, task, 2)
            return history.rms[-1].sum(), (history.max_error, history.final.u)

        run = jax.value_and_grad(loss, has_aux=True)
        jax.clear_caches()  # of what was traced for the other kind of device
        traced = jax.jit(run).trace(1.01)
        return traced.jaxpr, traced.lower().compile()(1.01)

    with monkeypatch.context() as accelerated:
        accelerated.setattr(lanes, "UNROLL", {"cpu": int(samples)})
        accelerated.setattr(lanes, "SCANNED", set())
        program, unrolled = found()
    expected = found()[1]
    chex.assert_trees_all_close(unrolled, expected, rtol=1e-9, atol=1e-12)
    assert f"unroll={samples}" in str(program)
