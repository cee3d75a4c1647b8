"""Which outputs of a program are affine functions of its inputs, read off the program itself.

The reader lies with the plants, in `plants.structure`, because `plants.to_control` needs it too.
"""

from ..plants.structure import (
    AFFINE,
    CONSTANT,
    OTHERWISE,
    Dependence,
    blind,
    dependence,
    followers,
    obstacle,
)

__all__ = [
    "AFFINE",
    "CONSTANT",
    "OTHERWISE",
    "Dependence",
    "blind",
    "dependence",
    "followers",
    "obstacle",
]
