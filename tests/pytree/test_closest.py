"""Unknown names: the closest known names come first in the message."""

import pytest

from jaxilc.pytree.closest import LISTED, MOST, closest, known_names, listed, not_one_of

PATHS = ["machine.plant.gain", "machine.plant.poles", "p-type.gamma_p", "p-type.lead"]


@pytest.mark.parametrize(
    ("given", "known", "first"),
    [
        ("cao-2091", ["dai-2014", "cao-2019", "cao-2019-rig"], "cao-2019"),  # digits exchanged
        ("pidtype", ["PID", "PIDType", "Filtered"], "PIDType"),  # upper and lower case
        ("transfer-function", ["state_space", "transfer_function"], "transfer_function"),
        ("ffdl", ["cfdl-mfailc", "ffdl-mfailc"], "ffdl-mfailc"),  # a part of a name
        ("machine.plant.gian", PATHS, "machine.plant.gain"),
        ("plant.gian", PATHS, "machine.plant.gain"),  # the end of a path
        ("gama_p", PATHS, "p-type.gamma_p"),
        ("p-type.laed", PATHS, "p-type.lead"),
    ],
)
def test_the_closest_name_is_the_first(given, known, first):
    assert closest(given, known)[0] == first
    assert f"; did you mean {first}" in not_one_of("x = 1", given, known)


@pytest.mark.parametrize("given", ["", "zzzz", None, 3.5, ["gain"], "gain" * 10**5])
def test_nothing_is_suggested_for_what_is_close_to_nothing(given):
    assert closest(given, PATHS) == []
    assert not_one_of("x = 1", given, ["b", "a"]) == "x = 1 is not one of b, a"


def test_a_long_list_is_counted_only_where_there_is_a_suggestion():
    many = [f"plant.{letter}" for letter in "abcdefghijklm"]
    assert len(many) == LISTED + 1
    said = known_names("plant.aa", many)
    assert said.startswith("did you mean plant.a")
    assert said.endswith("? 13 names are known")
    assert said.count("plant.") <= MOST
    assert known_names("zzzz", many) == f"known: {', '.join(many)}"
    assert known_names("plant.aa", many[:2]).endswith("? Known: plant.a, plant.b")
    assert known_names("a", []) == "known: none"


def test_a_long_list_of_names_is_cut():
    names = [f"name-{i}" for i in range(1000)]
    assert listed(names[:3]) == "name-0, name-1, name-2"
    assert listed([]) == "none"
    text = listed(names)
    shown = text.partition(" and ")[0].split(", ")
    assert shown == names[: len(shown)]
    assert text.endswith(f" and {1000 - len(shown)} more")
    assert len(text) < 650
    assert len(listed(["x" * 9999, "y"])) < 120
