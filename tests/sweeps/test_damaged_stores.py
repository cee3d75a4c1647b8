"""Damage to a store is never silent.

Whatever bit is changed, and whatever is cut off or missing, no number changes without a message.
"""

import dataclasses
import itertools
import os
import shutil

import numcodecs.zstd
import numpy as np
import pytest
import xarray as xr
from fuzz import files_of, flipped, fuzz, refusal
from store_case import LAYOUT, filled
from sweep_case import PLAN
from zarr.storage import LocalStore

from jaxilc import open_dataset, summarise
from jaxilc.outcomes.designing import state_of
from jaxilc.outcomes.request import unless_there
from jaxilc.storage import files
from jaxilc.sweeps import Sweep
from jaxilc.sweeps.store import DONE, UNFILLED, Store

pytestmark = pytest.mark.usefixtures("quickly_and_quietly")


def test_a_flipped_bit_in_a_store_is_refused_or_computed_again(tmp_path):
    whole, _ = filled(tmp_path / "store.zarr")

    def attempt(rng):
        store = flipped(rng, tmp_path / "store.zarr", tmp_path / "flipped.zarr")
        said = refusal(lambda: xr.testing.assert_identical(open_dataset(store), whole))
        assert said is None or "flipped.zarr is damaged" in said
        dataset, _ = filled(store)
        xr.testing.assert_identical(dataset, whole)
        assert files_of(store) == files_of(tmp_path / "store.zarr")
        xr.testing.assert_identical(open_dataset(store), whole)

    fuzz(28, attempt, ())


def bomb(size):
    """A frame of Zstandard that declares its size in 8 bytes, and its crc32c."""
    packed = numcodecs.zstd.compress(bytes(10), 0)
    assert packed[:5] == b"\x28\xb5\x2f\xfd\x20"  # one segment, its size in one byte
    return packed[:4] + b"\xe0" + size.to_bytes(8, "little") + packed[6:]


@pytest.mark.parametrize("place", ["rms/c/0/0", "rms/c/0/1", "sample/c/0", "scheme/c/0"])
@pytest.mark.parametrize("kind", ["pipe", "bomb"])
def test_a_pipe_or_a_bomb_in_a_store_takes_neither_time_nor_memory(tmp_path, place, kind):
    """It is refused when the store is read, and computed again when it is resumed."""
    whole, _ = filled(tmp_path / "store.zarr")
    file = tmp_path / "store.zarr" / place
    file.unlink()
    if kind == "pipe":
        os.mkfifo(file)
    else:
        file.write_bytes(bomb(2**40))
    said = refusal(lambda: open_dataset(tmp_path / "store.zarr"))
    assert ("is no file" if kind == "pipe" else "would unpack to 1,099,511,627,776 bytes") in said
    assert said.endswith("resuming the sweep mends it")
    xr.testing.assert_identical(filled(tmp_path / "store.zarr")[0], whole)
    xr.testing.assert_identical(open_dataset(tmp_path / "store.zarr"), whole)


def test_a_unit_that_reads_like_that_of_a_date_changes_no_value(tmp_path):
    unit = "days since 2000-01-01"
    rms = dataclasses.replace(LAYOUT.variables["rms"], unit=unit)
    layout = dataclasses.replace(LAYOUT, variables={**LAYOUT.variables, "rms": rms})
    given = {"rms": np.array([0.1, 3.0, 2.0]), "finite": np.ones(3, bool)}
    with Store.create(tmp_path / "x", layout) as store:
        store.write(0, 0, slice(0, 3), given)
        for found in (store.dataset(), open_dataset(tmp_path / "x")):
            np.testing.assert_array_equal(found["rms"][0, :3], given["rms"])
            assert found["rms"].attrs["units"] == unit


def test_a_folder_around_or_without_a_dataset_is_not_called_damaged(tmp_path):
    filled(tmp_path / "results" / "dataset.zarr")
    said = r"in the folder of a command it is dataset\.zarr"
    for folder in ("", "results", "nothing"):
        with pytest.raises(FileNotFoundError, match=said):
            open_dataset(tmp_path / folder)


def test_a_chunk_in_the_place_of_another_is_computed_again(tmp_path):
    """Its numbers and its mark are whole, but of another scheme or of other machines."""
    names = {"scheme": (("scheme",), np.array(["one", "two"]))}
    layout = dataclasses.replace(
        LAYOUT, coordinates=LAYOUT.coordinates | names | {"sample": (("sample",), np.arange(6))}
    )
    values = {"rms": np.arange(12.0).reshape(2, 6) + 1, "finite": np.ones((2, 6), bool)}
    places = list(itertools.product(range(2), range(2)))

    def fill(path):
        make = Store.resume if path.exists() else Store.create
        with make(path, layout) as store:
            for scheme, chunk in places:
                if not store.is_done(scheme, chunk):
                    rows = slice(3 * chunk, 3 * chunk + 3)
                    found = {name: of[scheme, rows] for name, of in values.items()}
                    store.write(scheme, chunk, rows, found)
            return store.dataset()

    whole = fill(tmp_path / "store.zarr")
    for one, other in itertools.permutations(places, 2):
        store = shutil.copytree(tmp_path / "store.zarr", tmp_path / f"{one}{other}.zarr")
        for name in (*values, DONE):
            to, of = (store / name / "c" / f"{scheme}/{chunk}" for scheme, chunk in (one, other))
            shutil.copyfile(of, to)
        with pytest.raises(ValueError, match="is not as it was marked"):
            open_dataset(store)
        xr.testing.assert_identical(fill(store), whole)


@pytest.fixture(scope="module")
def swept(tmp_path_factory):
    """Return a small sweep, its finished store and its dataset.

    Its chunks are compiled once.
    """
    plan = dataclasses.replace(
        PLAN, schemes={"feedback": PLAN.schemes["feedback"]}, machines=5, chunk=3, keep=(), trials=2
    )
    host, store = plan.host(), tmp_path_factory.mktemp("swept") / "store.zarr"
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(Sweep, "host", lambda self: host)
        yield plan, store, plan.run(store)


def cut(file):
    file.write_bytes(file.read_bytes()[:-7])


DAMAGES = {
    "settled_error/c/0/1/0": os.remove, "rms/c/0/0/0": cut, "diverged_at/c/0/0": os.remove,
    "finite/c/0/1/0": cut, "chunk_done": shutil.rmtree, "chunk_done/c/0/0": cut,
    "chunk_done/zarr.json": os.remove, "plant.gain/c/0": os.remove, "sample": shutil.rmtree,
    "scheme/c/0": cut, "zarr.json": lambda file: file.write_text("{"),
}  # fmt: skip


@pytest.mark.parametrize("damaged", DAMAGES)
def test_what_is_gone_or_cut_short_is_refused_and_computed_again(swept, tmp_path, damaged):
    plan, store, dataset = swept
    shutil.copytree(store, tmp_path / "store.zarr")
    DAMAGES[damaged](tmp_path / "store.zarr" / damaged)
    with pytest.raises(ValueError, match=r"store.zarr is damaged: .*; resuming the sweep mends it"):
        open_dataset(tmp_path / "store.zarr")
    # A reader that uses xarray alone gets NaN, not zeros, which would be within every tolerance.
    if damaged.startswith("settled_error"):
        read = xr.open_zarr(tmp_path / "store.zarr", chunks=None, consolidated=False)
        assert summarise(read, 1e9)[0].yield_share == 0.6
    resumed = plan.run(tmp_path / "store.zarr", resume=True)
    xr.testing.assert_identical(resumed, dataset)
    assert resumed["settled_error"].values.tobytes() == dataset["settled_error"].values.tobytes()


def test_a_chunk_is_shown_when_it_is_marked(swept, tmp_path, monkeypatch):
    """A sweep that was killed has stored a part of it, and one that runs goes on meanwhile."""
    (_, store, dataset), begun, get = swept, tmp_path / "store.zarr", LocalStore.get
    shutil.copytree(store, begun, ignore=lambda at, _: {"1"} if at.endswith("/c/0") else set())

    async def written_meanwhile(self, key, **options):
        found = await get(self, key, **options)
        if key == "diverged_at/c/0/1":
            shutil.copytree(store, begun, dirs_exist_ok=True)
        return found

    monkeypatch.setattr(LocalStore, "get", written_meanwhile)
    read = open_dataset(begun)
    xr.testing.assert_identical(read.isel(sample=slice(3)), dataset.isel(sample=slice(3)))
    for name, values in read.isel(sample=slice(3, None)).data_vars.items():
        np.testing.assert_array_equal(values, UNFILLED[values.dtype.kind], err_msg=name)


@pytest.mark.parametrize("chunks", [1, 2])
def test_a_store_that_is_removed_while_a_sweep_runs_is_named(swept, tmp_path, chunks):
    plan, place = swept[0], tmp_path / "store.zarr"

    def progress(name, done, fresh):
        if done >= 3 * chunks - 1:
            shutil.rmtree(place, ignore_errors=True)

    with pytest.raises(FileNotFoundError, match=r"store.zarr was removed while the sweep was run"):
        plan.run(place, progress=progress)
    assert not place.exists()


def test_an_array_that_is_removed_while_a_sweep_runs_is_named(swept, tmp_path):
    plan, place = swept[0], tmp_path / "store.zarr"

    def progress(name, done, fresh):
        if done == plan.machines:
            shutil.rmtree(place / "diverged")

    with pytest.raises(ValueError, match=r"store.zarr is damaged: .*diverged.*; resuming"):
        plan.run(place, progress=progress)
    xr.testing.assert_identical(plan.run(place, resume=True), swept[2])


def test_a_store_without_its_configuration_is_refused(swept, tmp_path):
    plan, store, _ = swept
    shutil.copytree(store, tmp_path / "store.zarr")
    for name in ("zarr.json", "chunk_done/zarr.json"):
        cut(tmp_path / "store.zarr" / name)
    with pytest.raises(ValueError, match="not a store that can be resumed; choose another folder"):
        plan.run(tmp_path / "store.zarr", resume=True)


def test_a_chunk_is_marked_when_its_figures_are_on_the_disk(tmp_path, monkeypatch):
    done = []
    replace = os.replace

    def noted(what, path):
        replace(what, path)
        done.append(path)

    def synced(descriptor):
        done.append(os.readlink(f"/proc/self/fd/{descriptor}"))

    monkeypatch.setattr(files.os, "fsync", synced)
    monkeypatch.setattr(files.os, "replace", noted)
    filled(tmp_path / "store.zarr")
    store = tmp_path / "store.zarr"
    for chunk in (0, 1):
        mark = done.index(store / f"chunk_done/c/0/{chunk}")
        for name in ("rms", "finite"):
            renamed = done.index(store / f"{name}/c/0/{chunk}")
            assert files.UNFINISHED in done[renamed - 1], (
                "the file is on the disk before it has its name"
            )
            assert str(store / f"{name}/c/0") in done[renamed:mark], "and its name before the mark"


def test_a_store_is_in_use_by_one_process_at_a_time(swept, tmp_path):
    plan, store, _ = swept
    with (
        files.only_one(store),
        pytest.raises(ValueError, match=r"store.zarr is in use by process \d+, which is running"),
    ):
        plan.run(store)  # not told to resume it, since it is not there to be resumed
    assert plan.run(store, resume=True).sizes["sample"] == 5


def test_what_is_in_use_is_not_to_be_resumed_or_replaced(tmp_path):
    """Without `--resume` and with `--force`, too, the other process is named."""
    (tmp_path / "state" / "sweep.zarr").mkdir(parents=True)
    for place in (tmp_path / "state", tmp_path / "state" / "sweep.zarr"):
        used = pytest.raises(ValueError, match=r"is in use by process \d+, which is running")
        with files.only_one(place), used:
            unless_there(tmp_path / "state", resume=False)
        used = pytest.raises(ValueError, match=r"is in use by process \d+, which is running")
        with files.only_one(place), used:
            state_of(tmp_path, force=True, resume=False)
    with pytest.raises(FileExistsError, match="add --resume"):
        unless_there(tmp_path / "state", resume=False)
    assert not state_of(tmp_path, force=True, resume=False).exists()
