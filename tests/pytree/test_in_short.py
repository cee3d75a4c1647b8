"""What users print fits a screen, and says what they gave."""

import dataclasses
import importlib
import inspect
import typing

import jax
import numpy as np
import pytest

import jaxilc
from jaxilc.plants import StateSpace
from jaxilc.pytree.in_short import LINES, WIDTH
from jaxilc.schemes import PIDType
from jaxilc.theory.learning_map import LearningMaps

ROOMS = (
    "learning", "signals", "sweeps", "tuning", "design", "hardware", "identification",
    "scenarios", "filters", "plants", "schemes", "uncertainty", "theory", "theory.outlook",
    "theory.frequency", "theory.certificates", "tuning.worst_case",
)  # fmt: skip
SMALL = (int, float, str, bool, type(None))


def public():
    """Each public class that has fields."""
    rooms = [jaxilc, *(importlib.import_module(f"jaxilc.{name}") for name in ROOMS)]
    named = [getattr(room, n) for room in rooms for n in getattr(room, "__all__", dir(room))]
    classes = {one for one in named if inspect.isclass(one) and one.__module__[:6] == "jaxilc"}
    classes -= {LearningMaps}  # theory.outlook only uses them
    have = [one for one in classes if hasattr(one, "_fields") or dataclasses.is_dataclass(one)]
    return sorted(have, key=lambda one: (one.__module__, one.__name__))


def small(annotation):
    kinds = typing.get_args(annotation) or (annotation,)
    return all(kind in (*SMALL, ...) or typing.get_origin(kind) is tuple for kind in kinds)


def filled(cls):
    """An object of a class, with a long array in each field that could hold one."""
    hints = typing.get_type_hints(
        cls, None, {"jax": jax, "Array": jax.Array}
    )  # for types only in some
    names = getattr(cls, "_fields", None) or [f.name for f in dataclasses.fields(cls)]
    values = [1.5 if small(hints[name]) else np.ones((999, 3)) for name in names]
    if hasattr(cls, "_make"):
        return cls._make(values)
    made = object.__new__(cls)
    for name, value in zip(names, values, strict=True):
        object.__setattr__(made, name, value)
    return made


@pytest.mark.parametrize("cls", public(), ids=lambda cls: cls.__name__)
def test_a_public_object_is_printed_in_few_lines(cls):
    text = repr(filled(cls))
    assert len(text.splitlines()) <= LINES
    assert len(text) <= LINES * WIDTH


def test_values_are_told_and_long_arrays_by_their_shapes():
    plant = StateSpace([[0.9]], [[0.1]], [[1.0]], dt=1e-3)
    assert str(plant) == "StateSpace(A=[[0.9]], B=[[0.1]], C=[[1.]], x0=None, dt=0.001)"
    long = StateSpace(np.eye(9), np.ones((9, 1)), np.ones((1, 9)), x0=np.arange(9))
    assert "A=float64[9, 9], B=float64[9, 1]" in str(long)
    machine = jaxilc.Machine(plant)
    assert "plant=StateSpace(A=[[0.9]], B=[[0.1]], C=[[1.]], dt=0.001)" in str(machine)
    # within a transformation, where no number is known
    told = []
    jax.jit(lambda scheme: told.append(str(scheme))).eval_shape(PIDType())
    assert told[0].startswith("PIDType(gamma_p=float64[], gamma_i=float64[]")
