"""The formats in which a law is exported, and the files of each."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from ..learning.machine import Machine
from ..native.program import Unknown
from . import fmu, hal, st
from .c_files import files_of
from .law import Law
from .plant import files_of_plant, model_of


class Asked(NamedTuple):
    """What the files of a law are made from.

    machine: whose plant an FMU holds beside the law
    about: sentences for the head of each file
    digest: of the certificate, which the code carries
    trials: outputs (N+1, n_y) of the trials of the test program
    single: whether numbers are `float` in place of `double`
    """

    law: Law
    machine: Machine
    about: Sequence[str]
    digest: str
    trials: Sequence[Any]
    single: bool


def _c(asked: Asked) -> dict[str, str | bytes]:
    law, about, digest, trials = asked.law, asked.about, asked.digest, asked.trials
    return {**files_of(law, about, digest, trials, single=asked.single)}


def _fmu(asked: Asked) -> dict[str, str | bytes]:
    """FMUs of the law, and of the plant where it can be written in C."""
    _need_double(asked, "FMU")
    texts, task = files_of(asked.law, asked.about, asked.digest, asked.trials), asked.law.task
    blocks = [fmu.law_block(task, texts, asked.about[0])]
    try:
        model = model_of(asked.machine, task)
    except Unknown:
        pass  # a simulator then has a plant of its own
    else:
        about = f"The plant for which the law is certified: {type(asked.machine.plant).__name__}."
        blocks.append(fmu.plant_block(task, files_of_plant(model, [about]), about, model.first))
    made = {f"{block.name}_fmi{version}.fmu": fmu.packed(block, version=version)
            for block in blocks for version in (2, 3)}  # fmt: skip
    return {**made, "law_test.c": texts["law_test.c"], "law.h": texts["law.h"],
            "law.c": texts["law.c"]}  # fmt: skip


def _hal(asked: Asked) -> dict[str, str | bytes]:
    _need_double(asked, "HAL component, whose pins are double")
    texts = files_of(asked.law, asked.about, asked.digest, asked.trials)
    return {"law.comp": hal.component(asked.law.task, texts, asked.about[0]), **texts}


def _st(asked: Asked) -> dict[str, str | bytes]:
    _need_double(asked, "function block, whose numbers are LREAL")
    return {"law.st": st.function_block(asked.law, asked.about, asked.digest)}


def _need_double(asked: Asked, kind: str) -> None:
    if asked.single:
        raise Unknown(f"`float` in a {kind}")


FORMATS: dict[str, Callable[[Asked], dict[str, str | bytes]]] = {
    "c": _c,
    "fmu": _fmu,
    "hal": _hal,
    "st": _st,
}
