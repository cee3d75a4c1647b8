"""A sweep over two worker processes gives the dataset of one host, whatever is killed.

The tests also check what is refused.
"""

import contextlib
import dataclasses
import json
import logging
import os
import signal
import socket
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import jax
import numpy as np
import pytest
import sweep_case
import xarray as xr
from cases import first_order, follows, known_to

import jaxilc
from jaxilc import Machine, Uniform, cli
from jaxilc.plants import DifferenceEquation
from jaxilc.plants.voice_coil import CAO_2019_EQ_29
from jaxilc.pytree import pytree
from jaxilc.runtime import capacity
from jaxilc.schemes import PID
from jaxilc.sweeps import cluster, host
from jaxilc.sweeps.store import Store

distributed = pytest.importorskip("distributed", reason="needs Dask: pip install 'jaxilc[cluster]'")

# Coefficients at the sample time are compiled faster than poles, which each process samples first.
MOTOR = DifferenceEquation(*CAO_2019_EQ_29, dt=1e-3)
COIL = {
    "machine": Machine(MOTOR, sensor=sweep_case.PLAN.machine.sensor),
    "uncertainty": {"plant.b": Uniform(0.9, 1.1, relative=True)},
}
PLAN = dataclasses.replace(sweep_case.PLAN, **COIL, machines=31)
SMALL = dataclasses.replace(
    PLAN, machine=Machine(MOTOR), schemes={"feedback": PID(kp=-5.0)}, keep=()
)
CHUNKS = [(scheme, chunk) for scheme in range(2) for chunk in range(8)]


@pytest.fixture(scope="module")
def client(tmp_path_factory):
    """Return a client of two worker processes that are started again when they die.

    They inherit how JAX is set up here, and share their compiled programs.
    """
    programs = {
        "JAX_COMPILATION_CACHE_DIR": str(tmp_path_factory.mktemp("programs")),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
    }
    options = {
        "env": programs, "processes": True, "threads_per_worker": 1, "dashboard_address": ":0",
        "host": "127.0.0.1", "memory_limit": 0,
    }  # fmt: skip
    with (
        distributed.LocalCluster(n_workers=2, **options) as local,
        distributed.Client(local, set_as_default=False) as client,
    ):
        client.run(jaxilc.setup)  # before a test that sends a function of its own starts JAX there
        yield client


def until(condition):
    deadline = time.monotonic() + 120
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


@pytest.fixture(scope="module")
def alone():
    """Return the dataset that this process computes."""
    return PLAN.run()


@pytest.fixture
def written(monkeypatch):
    """Record every chunk that is written, in order."""
    found, write = [], Store.write

    def counted(self, scheme, chunk, samples, values):
        found.append((scheme, chunk))
        write(self, scheme, chunk, samples, values)

    monkeypatch.setattr(Store, "write", counted)
    return found


@pytest.mark.thorough
def test_an_interrupted_sweep_cancels_its_tasks_and_resumes(tmp_path, client, alone, written):
    def stop_after_three(name, done, fresh):
        if len(written) == 3:
            raise KeyboardInterrupt

    store = tmp_path / "store.zarr"
    with pytest.raises(KeyboardInterrupt):
        PLAN.run(store, cluster=client, progress=stop_after_three)
    until(lambda: not any(client.processing().values()))
    first, progress = written.copy(), []
    dataset = PLAN.run(
        store, resume=True, cluster=client, progress=lambda *call: progress.append(call)
    )
    xr.testing.assert_identical(dataset, alone)
    assert len(first) == 3
    assert sorted(written) == CHUNKS
    assert sum(fresh for _, _, fresh in progress) == 2 * 31 - sum(
        3 if chunk == 7 else 4 for _, chunk in first
    )
    assert {name: max(done for n, done, _ in progress if n == name) for name in PLAN.schemes} == {
        "learning": 31,
        "feedback": 31,
    }


@pytest.mark.thorough
def test_a_grid_is_computed_by_workers(client):
    grid = {"feedback.kp": [-5.0, -2.0], "trials": [4, 2]}
    plan = dataclasses.replace(SMALL, machines=5, grid=grid)
    xr.testing.assert_identical(plan.run(cluster=client), plan.run())


@pytest.mark.thorough
def test_precision_goes_along(client):
    jax.config.update("jax_enable_x64", False)
    try:
        alone, dataset = SMALL.run(), SMALL.run(cluster=client)
    finally:
        jax.config.update("jax_enable_x64", True)
    assert dataset["rms"].dtype == np.float32
    assert dataset.attrs["configuration"]["environment"]["precision"] == "float32"
    xr.testing.assert_identical(dataset, alone)


def seized(there, trial):
    """Return 0, unless a file exists."""

    def look(_):
        if Path(there).exists():
            raise RuntimeError("the bearing has seized")
        return np.zeros((), trial.y.dtype)

    return jax.pure_callback(
        look, jax.ShapeDtypeStruct((), trial.y.dtype), trial.y[0, 0], vmap_method="sequential"
    )


def test_a_chunk_that_fails_for_good_is_named_and_the_others_stay(tmp_path, client, written):
    there, store = tmp_path / "seized", tmp_path / "store.zarr"
    plan = dataclasses.replace(SMALL, quantities={"seized": partial(seized, str(there))}, trials=1)
    with pytest.raises(
        cluster.ChunkFailed,
        match=r"(?s)scheme 'feedback', chunk \d \(machines \d+ to \d+\) failed.*the bearing has "
        r"seized",
    ):
        plan.run(store, cluster=client, progress=lambda *call: there.touch())
    there.unlink()
    first = written.copy()
    assert 1 <= len(first) < 8
    dataset = plan.run(store, resume=True, cluster=client)
    assert sorted(written) == CHUNKS[:8]
    xr.testing.assert_identical(dataset, plan.run())


@contextlib.contextmanager
def odd_worker(client):
    """Return a worker that has one device more."""
    flags = (
        f"{os.environ['XLA_FLAGS']} --xla_force_host_platform_device_count={jax.device_count() + 1}"
    )
    command = [
        sys.executable, "-m", "distributed.cli.dask_worker", client.scheduler.address, "--no-nanny",
        "--no-dashboard",
    ]  # fmt: skip
    process = subprocess.Popen(
        [*command, "--nthreads", "1", "--memory-limit", "0"],
        env=os.environ | {"XLA_FLAGS": flags},
        stderr=subprocess.DEVNULL,
    )
    try:
        client.wait_for_workers(3, timeout=60)
        yield
    finally:
        process.kill()
        process.wait()
        until(lambda: len(client.nthreads()) == 2)


def test_a_worker_that_would_round_differently_is_refused(tmp_path, client, written, monkeypatch):
    late, early = tmp_path / "late.zarr", tmp_path / "early.zarr"
    many = dataclasses.replace(SMALL, chunk=1)  # some are left for a worker that starts slowly
    devices, before = jax.device_count(), {*client.nthreads()}
    with contextlib.ExitStack() as stack:

        def join(name, done, fresh):
            if len(written) == 1:
                stack.enter_context(odd_worker(client))
                odd = [*{*client.nthreads()} - before]  # which gets all chunks from now on
                monkeypatch.setattr(client, "submit", partial(client.submit, workers=odd))

        with pytest.raises(
            ValueError,
            match=rf"the worker tcp://\S+ is not like.*devices: {devices + 1} there, "
            rf"{devices} here",
        ):
            many.run(late, cluster=client, progress=join)
        monkeypatch.delattr(client, "submit")
        assert written
        written.clear()
        with pytest.raises(
            ValueError,
            match=rf"the worker tcp://\S+ is not like tcp.*: devices: {devices + 1} there, "
            rf"{devices} here",
        ):
            SMALL.run(early, cluster=client)
    assert not written
    assert not early.exists()


def with_memory(size):
    capacity.host_bytes = lambda: size


def test_a_chunk_too_large_for_one_of_the_workers_is_refused(tmp_path, client):
    small, _ = client.run(os.getpid)
    # There is room for the dataset, and 10 kB for each of two workers.
    client.run(with_memory, PLAN.bytes_stored() + 20_000, workers=[small])
    try:
        with pytest.raises(
            ValueError,
            match=rf"chunk = 4 takes .* kB of memory, where 10 kB are .* on the worker {small}; ",
        ):
            PLAN.run(tmp_path / "store.zarr", cluster=client)
    finally:
        client.run(with_memory, None, workers=[small])
    assert not (tmp_path / "store.zarr").exists()


@pytest.mark.parametrize(
    ("found", "room"),
    [
        ((1000, None, None), 400),  # two workers share what the dataset leaves
        ((1000, None, 300), 300),
        ((1000, 5000, 300), 5000),
        ((None, None, None), None),
    ],
)
def test_room_of_a_worker(found, room):
    assert cluster.Found({}, socket.gethostname(), *found).room(200, 2) == room


def test_classes_that_workers_cannot_import_are_named():
    @pytree
    class Mine(PID):
        pass

    with pytest.raises(
        ValueError, match=r"workers cannot import test_cluster\..*Mine; put it into a module"
    ):
        dataclasses.replace(PLAN, schemes={"mine": Mine(kp=-5.0)}).run(cluster="tcp://127.0.0.1:9")


def test_text_that_is_no_scheduler_is_refused(tmp_path):
    (tmp_path / "file").write_text("[]")
    with pytest.raises(ValueError, match="not a file that a Dask scheduler wrote"):
        PLAN.run(cluster=tmp_path / "file")
    for text in ("nowhere.json", "tcp://host"):
        with pytest.raises(ValueError, match=f"cluster = '{text}' is neither an address such as"):
            PLAN.run(cluster=text)


def test_without_distributed_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(ImportError, match=r"pip install 'jaxilc\[cluster\]'"):
        PLAN.run(cluster="tcp://127.0.0.1:9")


PID_ALONE = '[schemes.pid]\nclass = "PID"\nkp = 0.5\n'
AXIS = first_order() + follows(50.0, 0.02) + PID_ALONE + known_to(0.1)


def sweep_command(monkeypatch, *arguments):
    Path("axis.toml").write_text(AXIS)
    monkeypatch.setattr(sys, "argv", ["jaxilc", "sweep", "axis.toml", *map(str, arguments)])
    try:
        cli.main()
    except SystemExit as stop:
        return stop.code


def test_the_command_takes_a_scheduler_file(monkeypatch, here, client):
    Path("scheduler.json").write_text(
        json.dumps({"type": "Scheduler", "address": client.scheduler.address})
    )
    small = ("--scheme", "pid", "--trials", 2, "--samples", 8)
    dasks, room, tells = logging.getLogger("distributed.client"), cluster.Workers.room, []

    def seen(self, stored):
        tells.append(dasks.isEnabledFor(logging.ERROR))  # as the traceback of a killed scheduler
        return room(self, stored)

    monkeypatch.setattr(cluster.Workers, "room", seen)
    assert not sweep_command(monkeypatch, *small, "--out", "many", "--dask", "scheduler.json")
    assert tells == [False]
    assert dasks.isEnabledFor(logging.ERROR)
    assert not sweep_command(monkeypatch, *small, "--out", "alone")
    xr.testing.assert_identical(
        *(jaxilc.open_dataset(here / out / "dataset.zarr") for out in ("many", "alone"))
    )


def slowly():
    """In a worker, let every chunk take so long that a worker is busy while it is killed."""
    compute = host.Host.compute
    host.Host.compute = lambda self, chunk: (time.sleep(0.2), compute(self, chunk))[1]


@pytest.mark.thorough
def test_a_killed_workers_chunks_are_computed_again(tmp_path, client, alone, written, monkeypatch):
    """The chunks of a killed worker are computed again.

    The worker is killed while it has chunks to compute. It is stopped first, so that what it has
    sent before arrives. This is the last test of the workers, so that none of them starts again.
    """
    pids, killed, submit = client.run(os.getpid), [], cluster.Workers._submit

    def kill_a_busy_one():
        address = max(pids, key=lambda address: len(client.processing().get(address, ())))
        os.kill(pids[address], signal.SIGSTOP)
        time.sleep(0.3)
        if client.processing().get(address):
            killed.append(address)
        os.kill(pids[address], signal.SIGKILL if killed else signal.SIGCONT)

    def submit_after_a_kill(self, key, *rest):
        if key[0] == "jaxilc-chunk" and len(written) >= 2 and not killed:
            kill_a_busy_one()
        return submit(self, key, *rest)

    client.run(slowly)
    monkeypatch.setattr(cluster.Workers, "_submit", submit_after_a_kill)
    dataset = PLAN.run(tmp_path / "store.zarr", cluster=client)
    assert killed
    xr.testing.assert_identical(dataset, alone)
    assert sorted(written) == CHUNKS
    # The store is like any other.
    xr.testing.assert_identical(PLAN.run(tmp_path / "store.zarr", resume=True), alone)
    until(lambda: len(client.nthreads()) == 2 and not set(killed) & set(client.nthreads()))


def test_a_scheduler_out_of_reach_is_one_line(monkeypatch, here, capsys):
    monkeypatch.setattr(cluster, "PATIENCE", 0.5)
    assert sweep_command(monkeypatch, "--scheme", "pid", "--dask", "tcp://127.0.0.1:9") == 2
    assert (
        "error: no Dask scheduler answers at tcp://127.0.0.1:9 within 0.5 s"
        in capsys.readouterr().err
    )
    assert not list(here.glob("out/*/*"))
