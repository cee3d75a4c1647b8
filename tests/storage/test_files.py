"""Files and folders are whole or absent at every moment; leftovers go, and JSON is strict."""

import errno
import json
import os
import shutil
import subprocess
import sys
import threading

import numpy as np
import pytest
import xarray as xr
from crash_points import recorded
from matplotlib.figure import Figure

from jaxilc import figures
from jaxilc.cli.present import stored
from jaxilc.figures.report import write_report
from jaxilc.hardware.journal import Journal
from jaxilc.scenarios.parameters import write_parameters
from jaxilc.storage import files
from jaxilc.storage.files import UNFINISHED, atomically, whole_folder
from jaxilc.storage.sealed import (
    Damaged,
    archive,
    read_arrays,
    read_json,
    sealed,
    unsealed,
    write_json,
)


def names(folder):
    return sorted(f.name for f in folder.iterdir())


def strictly(text):
    return json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))


def test_results_are_whole_at_every_moment(tmp_path):
    dataset, axes = xr.Dataset({"rms": ("trial", np.arange(3.0))}), Figure().subplots()
    out, numbers = tmp_path / "out", {"worst": float("inf"), "rows": [float("nan")] * 50}
    with recorded(out, tmp_path) as states:
        for _ in range(2):  # the second time it replaces the first
            stored(out / "numbers.json", numbers)
            write_parameters(out / "params.json", "axis", {"pid": {"kp": 1.0}}, {})
            figures.save(axes, out / "figure.png")
            write_report(out / "page.html", "title", {"asked": 1})
            with whole_folder(out / "dataset.zarr", replace=True) as store:
                dataset.to_zarr(store, consolidated=False)
    found = dict.fromkeys(names(out), 0)
    for state in states:
        for path in state.iterdir():
            if not path.name.startswith(UNFINISHED):
                found[path.name] += 1
        for path in state.glob("*.json"):
            strictly(path.read_text())
        for path in state.glob("*.png"):
            assert path.read_bytes().endswith(b"IEND\xaeB`\x82")
        for path in state.glob("*.html"):
            assert path.read_text().endswith("</html>\n")
        for path in state.glob("*.zarr"):
            read = xr.open_zarr(path, chunks=None, consolidated=False).load()
            xr.testing.assert_identical(read, dataset)
    assert all(found.values())


def test_what_killed_processes_left_is_removed_and_what_is_being_written_stays(tmp_path):
    program = "import sys, time; from pathlib import Path; from jaxilc.storage import files\n"
    program += "with files.whole_folder(Path(sys.argv[1]) / 'store') as unfinished:"
    program += " print(unfinished.name, flush=True); time.sleep(60)"
    command = [sys.executable, "-c", program, str(tmp_path)]
    writer = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    running = writer.stdout.readline().strip()
    for left in (f"{UNFINISHED}1-0123abcd", f"{UNFINISHED}12-deadbeef"):
        (tmp_path / left).write_text("half")
    (tmp_path / f"{UNFINISHED}2-21212121").mkdir()
    (tmp_path / f"{UNFINISHED}2-21212121" / "manifest.json").write_text("half")
    write_json(tmp_path / "a.json", 1)
    assert names(tmp_path) == [running, "a.json"]
    writer.kill()
    writer.wait()
    writer.stdout.close()
    write_json(tmp_path / "a.json", 2)
    assert names(tmp_path) == ["a.json"]


def test_what_a_user_has_named_alike_is_kept(tmp_path):
    own = ["report.unfinished-2.docx", ".unfinished-thesis", ".unfinished-1-0123abcd.bak"]
    for name in own:
        (tmp_path / name).write_text("mine")
    (tmp_path / "plans.unfinished-1-0123abcd").mkdir()
    write_json(tmp_path / "a.json", 1)
    with whole_folder(tmp_path / "folder"):
        pass
    assert names(tmp_path) == sorted([*own, "a.json", "folder", "plans.unfinished-1-0123abcd"])
    (tmp_path / "folder" / own[0]).write_text("mine")
    with pytest.raises(FileExistsError, match="exists already"):
        Journal(tmp_path / "folder").create()


@pytest.mark.parametrize("can_swap", [True, False])
def test_a_folder_that_is_replaced_is_never_lost(tmp_path, monkeypatch, can_swap):
    def write(out, content):
        with whole_folder(out / "dataset", replace=True) as store:
            (store / "content").write_text(content)

    if not can_swap:  # as on a file system without this operation
        monkeypatch.setattr(files, "_swapped", lambda one, other: False)
    with recorded(tmp_path / "out", tmp_path) as states:
        write(tmp_path / "out", "old")
        write(tmp_path / "out", "new")
    assert names(tmp_path / "out") == ["dataset"]
    first = next(i for i, state in enumerate(states) if (state / "dataset").exists())
    for state in states[first:]:
        if can_swap:
            assert (state / "dataset" / "content").read_text() in ("old", "new")
        with pytest.raises(KeyboardInterrupt), whole_folder(state / "dataset", replace=True):
            raise KeyboardInterrupt  # what is begun next, even if it fails, finds it
        assert (state / "dataset" / "content").read_text() in ("old", "new")
    write(states[first], "newest")
    assert names(states[first]) == ["dataset"]
    assert (states[first] / "dataset" / "content").read_text() == "newest"


def test_what_fails_while_it_is_written_leaves_what_was_there(tmp_path):
    def fails(file):
        file.write(b"half")
        raise KeyboardInterrupt

    write_json(tmp_path / "a.json", "first")
    with pytest.raises(KeyboardInterrupt):
        atomically(tmp_path / "a.json", fails)
    with (
        pytest.raises(KeyboardInterrupt),
        whole_folder(tmp_path / "folder") as unfinished,
        open(unfinished / "file", "wb") as file,
    ):
        fails(file)
    assert names(tmp_path) == ["a.json"]
    assert read_json(tmp_path / "a.json") == "first"
    with pytest.raises(FileExistsError), whole_folder(tmp_path / "a.json"):
        pass


@pytest.mark.parametrize("removed", [False, True])
def test_a_full_disk_and_a_removed_folder_are_told_with_the_name_of_the_file(tmp_path, removed):
    path = tmp_path / "store" / "rms"
    path.parent.mkdir()

    def write(file):
        if removed:
            shutil.rmtree(path.parent)
        else:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with pytest.raises(OSError, match=r"No such file|No space left") as found:
        files.atomically(path, write)
    assert found.value.filename == str(path)
    named = pytest.raises(OSError, match=r"No space left on device: '.*/folder'")
    with named, whole_folder(tmp_path / "folder"):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_a_name_that_another_process_takes_for_a_leftover_is_given_up(tmp_path, monkeypatch):
    locked, tried = files._locked, []

    def too_late(path):
        """Another process removes the first name before it is locked."""
        tried.append(path)
        if len(tried) == 1:
            path.unlink()
        return locked(path)

    monkeypatch.setattr(files, "_locked", too_late)
    write_json(tmp_path / "a.json", 3)
    assert len(set(tried)) == 2
    assert read_json(tmp_path / "a.json") == 3


def test_links_are_followed_and_pipes_are_written_to(tmp_path):
    (tmp_path / "real.json").write_text("0")
    (tmp_path / "link.json").symlink_to(tmp_path / "real.json")
    write_json(tmp_path / "link.json", 1)
    assert (tmp_path / "link.json").is_symlink()
    assert read_json(tmp_path / "real.json") == 1
    os.mkfifo(tmp_path / "pipe")
    read = []
    reader = threading.Thread(target=lambda: read.append((tmp_path / "pipe").read_text()))
    reader.start()
    write_json(tmp_path / "pipe", 2)
    reader.join()
    assert read == ["2\n"]


def test_json_is_strict_and_reads_back(tmp_path):
    numbers = {"worst": np.inf, "rows": [float("nan"), (-np.inf, 1.5)], "figure": {"3": 0.1}}
    write_json(tmp_path / "a.json", numbers)
    text = (tmp_path / "a.json").read_text()
    assert strictly(text) == {
        "worst": "Infinity",
        "rows": ["NaN", ["-Infinity", 1.5]],
        "figure": {"3": 0.1},
    }
    assert float(strictly(text)["worst"]) == np.inf
    found = read_json(tmp_path / "a.json")
    assert found["worst"] == np.inf
    assert np.isnan(found["rows"][0])
    assert unsealed(sealed(numbers)) == strictly(text)
    (tmp_path / "a.json").write_text("[" * 100_000)
    with pytest.raises(Damaged, match=r"a\.json is damaged: tables or lists are nested too deeply"):
        read_json(tmp_path / "a.json")


def test_an_archive_is_read_by_numpy_and_holds_a_checksum(tmp_path):
    arrays = {"y [0]": np.arange(3.0), "text": np.asarray("µ")}
    file = tmp_path / "a.npz"
    file.write_bytes(archive(arrays))
    with np.load(file) as plain:
        np.testing.assert_equal(dict(plain), arrays)
    np.testing.assert_equal(read_arrays(file), arrays)
    np.savez(file, **arrays)
    np.testing.assert_equal(read_arrays(file, checked=False), arrays)
    with pytest.raises(Damaged, match=r"a\.npz is damaged: its checksum is missing"):
        read_arrays(file)
    file.write_bytes(b"PK")
    with pytest.raises(Damaged, match=r"a\.npz is damaged: it holds no arrays"):
        read_arrays(file, checked=False)
