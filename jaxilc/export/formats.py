"""The formats in which a law is exported, and the files of each."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from ..learning.machine import Machine
from ..native.program import Unknown
from . import fmu, st
from .c import Code
from .c_files import files_of, hal_component
from .law import Law
from .plant import files_of_plant, model_of


class Asked(NamedTuple):
    """What the files of a law are made from.

    machine: whose plant an FMU holds beside the law
    trials: outputs (N+1, n_y) of the trials of the test program
    single: whether numbers are `float` in place of `double`
    """

    law: Law
    machine: Machine
    about: Sequence[str]
    digest: str
    trials: Sequence[np.ndarray]
    single: bool


class Made(NamedTuple):
    """The files of a law.

    bytes: of RAM that the law needs on the controller
    warnings: sentences on what is left out
    """

    files: dict[str, str | bytes]
    bytes: int
    warnings: tuple[str, ...] = ()


class Format(NamedTuple):
    """A format: what the law then is, for a sentence, and how its files are made."""

    said: str
    make: Callable[[Asked], Made]


def _c(asked: Asked) -> Made:
    law, about, digest, trials = asked.law, asked.about, asked.digest, asked.trials
    code = Code(law.fields, law.functions, single=asked.single)
    return Made({**files_of(law, about, digest, trials, code=code)}, code.bytes)


def _fmu(asked: Asked) -> Made:
    """FMUs of the law, and of the plant where it can be written in C."""
    _need_double(asked, "an FMU, whose numbers are double")
    of_c, task, warnings = _c(asked), asked.law.task, []
    texts = {name: str(text) for name, text in of_c.files.items()}
    blocks = [fmu.law_block(task, texts, asked.about[0])]
    about = f"The plant for which the law is certified: {type(asked.machine.plant).__name__}."
    try:
        model = model_of(asked.machine, task)
        of_plant = files_of_plant(model, [about])
    except Unknown as error:
        warnings.append(f"The plant has no FMU: {error}.")
    else:
        blocks.append(fmu.plant_block(task, of_plant, about, model.first))
    made: dict[str, str | bytes] = {
        f"{block.name}_fmi{version}.fmu": fmu.packed(block, version=version)
        for block in blocks
        for version in (2, 3)
    }
    return Made({**made, **texts}, of_c.bytes, tuple(warnings))


def _hal(asked: Asked) -> Made:
    _need_double(asked, "a HAL component, whose pins are double")
    of_c = _c(asked)
    texts = {name: str(text) for name, text in of_c.files.items()}
    component = hal_component(asked.law.task, texts, asked.about[0])
    return Made({"law.comp": component, **texts}, of_c.bytes)


def _st(asked: Asked) -> Made:
    _need_double(asked, "a function block, whose numbers are LREAL")
    block = st.function_block(asked.law, asked.about, asked.digest)
    return Made({"law.st": block.text}, block.bytes)


def _need_double(asked: Asked, kind: str) -> None:
    if asked.single:
        raise Unknown(f"`--number float` in {kind}")


FORMATS = {
    "c": Format("a program in C", _c),
    "fmu": Format("an FMU 2.0 and 3.0 for co-simulation", _fmu),
    "hal": Format("a component of LinuxCNC's HAL", _hal),
    "st": Format("a function block in Structured Text", _st),
}
