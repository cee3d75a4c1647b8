"""The RAM of a program is planned from its arrays; what would not fit is refused before."""

import dataclasses
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxilc import Machine, Sweep, Task, Uniform
from jaxilc.plants import voice_coil
from jaxilc.runtime import capacity
from jaxilc.schemes import CFDLMFAILC

TASK = Task(reference=np.sin(2 * np.pi * np.arange(201) / 200), dt=1e-3)
PLAN = Sweep(
    Machine(voice_coil("printed").sampled(1e-3)), {"learning": CFDLMFAILC()}, TASK, trials=3,
    uncertainty={"plant.b": Uniform(0.9, 1.1, relative=True)}, machines=64, keep=("e", "u"),
    chunk=64, lanes=2,
)  # fmt: skip
TILE = 2 * jax.device_count()


def with_memory(monkeypatch, size):
    monkeypatch.setattr(capacity, "host_bytes", lambda: size)


def test_the_bytes_of_a_program_are_those_of_its_arrays():
    run = jax.jit(lambda x: jnp.outer(x, x))
    of_one_device = 8 * (100 + 100 * 100)
    found = capacity.program_bytes(run.lower(jnp.ones(100))) / jax.device_count()
    assert of_one_device <= found <= of_one_device + 2000


def test_a_chunk_that_does_not_fit_is_refused_with_one_that_does(monkeypatch, tmp_path):
    # e and u of 64 machines are 205 kB of the program's results. About 35 machines fit, together
    # with the trials of a tile.
    with_memory(monkeypatch, PLAN.bytes_stored() + 200_000)
    store = tmp_path / "store.zarr"
    said = r"chunk = 64 takes .* kB of memory, where 200 kB are .*; chunk = \d+ would fit"
    with pytest.raises(ValueError, match=said) as refusal:
        PLAN.run(store)
    assert not store.exists()
    chunk = int(re.search(r"chunk = (\d+) would fit", str(refusal.value))[1])
    assert TILE <= chunk < 64
    assert chunk % TILE == 0
    dataclasses.replace(PLAN, chunk=chunk).run(store)
    with pytest.raises(ValueError, match="would fit"):  # the next larger one does not fit
        dataclasses.replace(PLAN, chunk=chunk + 2 * TILE).run(tmp_path / "larger.zarr")


@pytest.mark.thorough
def test_where_no_chunk_fits_it_says_so(monkeypatch, tmp_path):
    with_memory(monkeypatch, PLAN.bytes_stored() + 10_000)
    with pytest.raises(ValueError, match=f"{2 * TILE} machines at a time take .* already"):
        PLAN.run(tmp_path / "store.zarr")
    wide = dataclasses.replace(PLAN, lanes=64)  # a single tile has all machines
    with_memory(monkeypatch, PLAN.bytes_stored() + 200_000)
    with pytest.raises(ValueError, match=r"64 machines .* already; take a smaller chunk or fewer"):
        wide.run(tmp_path / "store.zarr")


def test_a_dataset_that_does_not_fit_is_refused(monkeypatch, tmp_path):
    with_memory(monkeypatch, int(1.5 * PLAN.bytes_stored()))
    said = r"Sweep: machines = 64 and trials = 3 take .* of memory, where .* would fit"
    with pytest.raises(ValueError, match=said) as refusal:
        PLAN.run()  # the dataset exists twice in RAM
    machines = int(re.search(r"machines = (\d+) would fit", str(refusal.value))[1])
    dataclasses.replace(PLAN, machines=machines).need_room(copies=2)
    with pytest.raises(ValueError, match="would fit"):  # the next larger one does not fit
        dataclasses.replace(PLAN, machines=machines + 1).need_room(copies=2)
    with_memory(monkeypatch, PLAN.bytes_stored() - 1)
    with pytest.raises(ValueError, match="machines = 64 and trials = 3 take"):
        PLAN.run(tmp_path / "store.zarr")


def test_a_finished_store_needs_no_room_for_a_chunk(monkeypatch, tmp_path):
    store = tmp_path / "store.zarr"
    PLAN.run(store)
    with_memory(monkeypatch, PLAN.bytes_stored() + 10_000)
    assert PLAN.run(store, resume=True).sizes["sample"] == 64


def test_unknown_memory_is_enough_and_the_dataset_is_as_large_as_counted(monkeypatch):
    with_memory(monkeypatch, None)
    dataset = PLAN.run()
    assert dataset.sizes["sample"] == 64
    assert PLAN.bytes_stored() == sum(v.nbytes for v in dataset.data_vars.values())


def test_what_there_is_lies_within_the_machine():
    with open("/proc/meminfo") as file:
        total = 1024 * int(file.readline().split()[1])
    assert 0 < capacity.host_bytes() <= total
    assert capacity.device_bytes() is None  # the devices of a CPU share the RAM of the host


@pytest.mark.parametrize(
    ("size", "text"), [(7, "7 B"), (1999, "2 kB"), (3.25e7, "32.5 MB"), (2.5e12, "2.5e+03 GB")]
)
def test_sizes_are_readable(size, text):
    assert capacity.shown(size) == text
