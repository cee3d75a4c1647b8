"""What a command found, in sentences, and the command to type next, quoted for a shell.

This module does not import NumPy or JAX, so that commands that need neither stay fast.
"""

from __future__ import annotations

import dataclasses
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from ...scenarios.catalogue import LISTED

FILES = (".toml", ".json")  # endings of plant files
# The options of what is simulated, which a command repeats if the user has given them.
REPEATED = {
    "run": ("trials", "metric", "set", "params"),
    "sweep": ("trials", "spread", "metric", "tolerance", "set", "params"),
    "certify": ("trials", "spread", "set", "params"),
    "worst-case": ("trial", "spread", "set", "params"),
    "design": ("trials", "spread", "set"),
    "next": ("set", "params"),
    "list": (),
}
NAMES_ITS_FILE = {"next": "--scenario"}  # commands that take the scenario by an option


class Verdict(NamedTuple):
    """What a command found, and what to do next.

    said: one or two sentences
    what: what the next command does, in words
    following: the next command, quoted for a shell; empty if there is none
    """

    said: tuple[str, ...]
    what: str = ""
    following: str = ""

    @property
    def lines(self) -> list[str]:
        """The lines to print."""
        head = f"Next, {self.what}: " if self.what else "Next: "
        return [*self.said, *([head + self.following] if self.following else [])]

    def as_json(self) -> dict[str, object]:
        """The entries for the file of `--json`."""
        return {"verdict": list(self.said), "next": self.following}


@dataclasses.dataclass(frozen=True)
class Asked:
    """The options of a command that the next command repeats, None or () where not given.

    source: name of a scenario, or a plant file
    schemes: names of schemes
    set: texts of `--set`
    params: file of parameters
    trials, spread, metric, tolerance: values of the options of the same name
    """

    source: str
    schemes: tuple[str, ...] = ()
    set: tuple[str, ...] = ()
    params: str | Path | None = None
    trials: int | None = None
    spread: float | None = None
    metric: str | None = None
    tolerance: float | None = None

    @property
    def of_file(self) -> bool:
        """Whether the scenario is a plant file."""
        return self.source not in LISTED and Path(self.source).suffix in FILES

    def following(self, command: str, *words: str, scheme: str = "", **changed: object) -> str:
        """The words of another command for the same scenario, quoted for a shell.

        words: further words at the end
        scheme: name of the scheme, empty for none
        changed: values of options in place of those that were given; None leaves one out
        """
        given = dataclasses.asdict(self) | {"trial": self.trials} | changed
        line = ["jaxilc", command]
        option = NAMES_ITS_FILE.get(command)
        line += [option] if option else []
        line.append(f"./{self.source}" if self.source.startswith("-") else self.source)
        line += ["--scheme", scheme] if scheme else []
        for name in REPEATED[command]:
            for value in _each(given[name]):
                line += [f"--{name}", str(value)]
        return shlex.join([*line, *words])

    def name_of(self, best: str, schemes: Sequence[str]) -> str:
        """The name of a scheme, empty where it is the only one and the user has not named it.

        schemes: names of all schemes of this command
        """
        return best if self.schemes or len(schemes) > 1 else ""

    def without(self, scheme: str) -> Asked:
        """The same without the settings of a scheme, which its file of parameters holds."""
        kept = tuple(one for one in self.set if not one.strip().startswith(f"{scheme}."))
        return dataclasses.replace(self, set=kept)


def _each(value: object) -> Sequence[object]:
    if isinstance(value, tuple | list):
        return value
    return () if value is None else (value,)
