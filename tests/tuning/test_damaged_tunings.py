"""A tuning whose folder is damaged ends with the same numbers, or is refused in one line."""

import dataclasses
import json
import shutil

import numpy as np
import pytest
from fuzz import damaged, dumped, files_of, flipped, fuzz, pick
from gain_case import PROBLEM, Killed, assert_same_tuned, kill_after

from jaxilc.storage.sealed import archive, read_arrays
from jaxilc.tuning.descent import Folder

pytestmark = pytest.mark.usefixtures("quickly_and_quietly")


@pytest.fixture(scope="module")
def tuned(tmp_path_factory):
    """Return a problem, its folder stopped after three of four steps, and the result without it."""
    problem = dataclasses.replace(PROBLEM, steps=4, clip=np.inf)
    folder = tmp_path_factory.mktemp("tuned") / "state"
    with pytest.raises(Killed):
        problem.run(folder, progress=kill_after(3))
    return problem, folder, problem.run()


@pytest.mark.thorough
def test_a_flipped_bit_in_a_tuning_changes_nothing(tuned, tmp_path):
    problem, folder, whole = tuned

    def attempt(rng):
        assert_same_tuned(problem.run(flipped(rng, folder, tmp_path / "state"), resume=True), whole)

    fuzz(30, attempt, ())


def test_a_state_of_something_else_is_refused(tuned, tmp_path):
    """Its checksums are right, but it is of another tuning, or was made by hand."""
    problem, folder, _ = tuned
    names = ("state.npz", "previous.npz")
    state = {name: read_arrays(folder / name) for name in names}

    def attempt(rng):
        shutil.rmtree(tmp_path / "state", ignore_errors=True)
        shutil.copytree(folder, tmp_path / "state")
        name = pick(rng, names[: 1 + rng.integers(2)])
        arrays = dict(state[name])
        array = pick(rng, list(arrays))
        match rng.integers(4):
            case 0:
                del arrays[array]
            case 1:
                arrays[array] = np.zeros((3, 3))
            case 2:
                arrays[array] = arrays[array].astype(pick(rng, ("U300", "c16", "?")))
            case _:
                configuration = dumped(damaged(rng, json.loads(str(arrays["configuration"]))))
                arrays["configuration"] = np.asarray(pick(rng, (configuration, "null", "[]", "{")))
                (tmp_path / "state/configuration.json").unlink()
        (tmp_path / "state" / name).write_bytes(archive(arrays))
        problem.run(tmp_path / "state", resume=True)

    fuzz(30, attempt)


def test_a_state_of_another_tuning_is_left_for_the_one_before_it(tuned, tmp_path):
    problem, folder, whole = tuned
    dataclasses.replace(problem, rate=2 * problem.rate).run(tmp_path / "other")
    for name, exchanged in (("one", ("state.npz",)), ("both", ("state.npz", "previous.npz"))):
        state = shutil.copytree(folder, tmp_path / name)
        for file in exchanged:
            shutil.copyfile(tmp_path / "other" / "state.npz", state / file)
        if name == "one":
            assert_same_tuned(problem.run(state, resume=True), whole)
            continue
        with pytest.raises(ValueError, match=r"state.npz was made with another .*start again"):
            problem.run(state, resume=True)


@pytest.mark.parametrize("content", [b"", b"{}", b"[]", b"null", b'{"sha256": 1}', b"\xff"])
def test_a_damaged_tuning_falls_back_or_is_refused_in_one_line(tuned, tmp_path, content):
    problem, folder, whole = tuned
    names = {name.name for name in files_of(folder)}
    assert names == {"configuration.json", "state.npz", "previous.npz"}
    for name in names:
        shutil.copytree(folder, tmp_path / name)
        (tmp_path / name / name).write_bytes(content)
        assert_same_tuned(problem.run(tmp_path / name, resume=True), whole)
    shutil.copytree(folder, tmp_path / "state")
    for name in names - {"configuration.json"}:
        (tmp_path / "state" / name).write_bytes(content)
    with pytest.raises(
        ValueError, match=r"state.npz is damaged: .*; remove .*state and start again"
    ) as refusal:
        problem.run(tmp_path / "state", resume=True)
    assert "\n" not in str(refusal.value)
    (tmp_path / "state/configuration.json").write_bytes(content)
    with pytest.raises(ValueError, match="not a tuning that can be resumed"):
        problem.run(tmp_path / "state", resume=True)


def test_a_state_that_is_damaged_again_falls_back_again(tuned, tmp_path):
    """The damaged state does not overwrite the previous one, which was used instead."""
    problem, folder, whole = tuned
    shutil.copytree(folder, tmp_path / "state")
    for content in (b"", b"PK"):
        (tmp_path / "state/state.npz").write_bytes(content)
        assert_same_tuned(problem.run(tmp_path / "state", resume=True), whole)


def test_two_tunings_do_not_share_a_folder(tuned, tmp_path):
    problem, folder, whole = tuned
    shutil.copytree(folder, tmp_path / "state")
    used = pytest.raises(
        ValueError, match=r"state is in use by process \d+, which is running; wait for its end"
    )
    with Folder(tmp_path / "state", problem.configuration(), True), used:
        problem.run(tmp_path / "state", resume=True)
    assert_same_tuned(problem.run(tmp_path / "state", resume=True), whole)
