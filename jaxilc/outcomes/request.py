"""What is asked of a scenario: its settings, the scenario with them, and the command to type next.

This module does not import NumPy or JAX, so that commands that need neither stay fast.
"""

from __future__ import annotations

import dataclasses
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..scenarios.catalogue import LISTED
from ..storage.files import need_unused

if TYPE_CHECKING:
    from ..scenarios import Scenario

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


@dataclasses.dataclass(frozen=True)
class Request:
    """What is asked of a scenario, and what the next command repeats; None or () if not given.

    source: name of a scenario, or a plant file
    schemes: names of schemes
    set: texts of `--set`
    params: file of parameters
    trials, spread, metric, tolerance: values of the options of the same name
    """

    source: str
    schemes: tuple[str, ...] = ()
    set: tuple[str, ...] = ()
    params: Path | None = None
    trials: int | None = None
    spread: float | None = None
    metric: str | None = None
    tolerance: float | None = None

    @classmethod
    def of(cls, asked: Request | str | Path) -> Request:
        """The request itself, or that of the name of a scenario or of a plant file."""
        return asked if isinstance(asked, Request) else cls(str(asked))

    @property
    def of_file(self) -> bool:
        """Whether the scenario is a plant file."""
        return self.source not in LISTED and Path(self.source).suffix in FILES

    def scenario(self) -> Scenario:
        """The scenario as it is asked for.

        Its options are set first, then the parameters, then all else, then the schemes are chosen.
        The metric judges it, and the spread widens its uncertainty.
        Raises ValueError naming what is allowed.
        """
        from ..scenarios.judging import judged
        from ..scenarios.parameters import with_parameters
        from ..uncertainty import with_spread

        here = self.expanded()
        chosen, values = here._with_options()
        if not chosen.schemes:
            raise ValueError(
                f"{self.source} has no scheme; needed is a table [schemes.NAME] at least"
            )
        if here.params is not None:
            chosen = with_parameters(chosen, here.params)
        chosen = here._with_trials(chosen.with_values(values)).select(here.schemes)
        chosen.check()
        if here.spread is not None:
            wide = with_spread(chosen.uncertainty, here.spread)
            chosen = dataclasses.replace(chosen, uncertainty=wide)
        return judged(chosen, here.metric)

    def of_one_scheme(self) -> tuple[Scenario, str]:
        """The scenario as it is asked for, and the name of its only scheme.

        Raises ValueError as `scenario` does, and where several schemes are chosen.
        """
        chosen = self.scenario()
        if len(chosen.schemes) > 1:
            raise ValueError(f"--scheme: needed is one of {', '.join(chosen.schemes)}")
        return chosen, next(iter(chosen.schemes))

    def machine_to_design(self) -> Scenario:
        """The scenario of a plant file, which need not have schemes, for the design of a law.

        Of `schemes` the first one is taken, whose feedback counts; all if there is none.
        """
        from ..scenarios.from_file import load_scenario
        from ..uncertainty import with_spread

        chosen = self._with_trials(load_scenario(self.source, settings_of(self.set)))
        if self.spread is not None:
            wide = with_spread(chosen.uncertainty, self.spread)
            chosen = dataclasses.replace(chosen, uncertainty=wide)
        return chosen.select(self.schemes)

    def _with_options(self) -> tuple[Scenario, dict[str, str]]:
        """The scenario with its options, and the settings that are left."""
        from .. import scenarios
        from ..scenarios.from_file import load_scenario

        values = settings_of(self.set)
        known = scenarios.options(self.source) if self.source in scenarios.SCENARIOS else {}
        of_paper = {path: value for path, value in values.items() if path in known}
        chosen = load_scenario(self.source, of_paper)
        return chosen, {path: value for path, value in values.items() if path not in known}

    def _with_trials(self, chosen: Scenario) -> Scenario:
        if self.trials is None:
            return chosen
        if self.trials < 1:
            raise ValueError(f"--trials {self.trials} is outside its allowed range [1, inf)")
        return dataclasses.replace(chosen, trials=self.trials)

    def expanded(self) -> Request:
        """The same with a point in place of a stored grid, where `params` is the folder of one.

        What is set stands after the point, and so counts.
        Raises ValueError as `stored_grid.best_of` does, and for an axis that no option can set.
        """
        if self.params is None or not Path(self.params).is_dir():
            return self
        from .. import scenarios
        from .stored_grid import best_of

        def load(of: Mapping[str, str]) -> Scenario:
            texts = tuple(f"{path}={text}" for path, text in of.items())
            return dataclasses.replace(self, set=texts, params=None).scenario()

        point = best_of(Path(self.params), settings_of(self.set), load)
        known = scenarios.options(self.source) if self.source in scenarios.SCENARIOS else {}
        for axis in point:
            if axis.startswith("task.") or ("." not in axis and axis not in {*known, "trials"}):
                raise ValueError(
                    f"--params {self.params}: the axis {axis} is not one that --set can set"
                )
        of_point = point.pop("trials", None)
        trials = of_point if self.trials is None else self.trials
        texts = (*(f"{axis}={x}" for axis, x in point.items()), *self.set)
        return dataclasses.replace(self, trials=trials, set=texts, params=None)

    def grid(self, axes: Sequence[str], chosen: Scenario) -> dict[str, Any]:
        """The grid of the scenario with further axes, for `Sweep`.

        axes: texts PATH=VALUES; an axis may be an option of the scenario
        chosen: the scenario of this request
        """
        grid, read = dict(chosen.grid), set()
        for axis in axes:
            name, equals, values = (part.strip() for part in axis.partition("="))
            if not equals:
                raise ValueError(f"--grid {axis!r} is not PATH=VALUES")
            if name in read:
                raise ValueError(f"--grid {name} is given twice; allowed is once")
            read.add(name)
            labels = [label.strip() for label in values.split(",")]
            of_option = name in chosen.options
            if of_option and len({*labels}) < len(labels):
                raise ValueError(f"--grid {axis!r} has equal values; allowed are different ones")
            grid[name] = (
                {x: self.also(f"{name}={x}").scenario() for x in labels} if of_option else values
            )
        return grid

    def also(self, setting: str) -> Request:
        """The same with a further setting."""
        return dataclasses.replace(self, set=(*self.set, setting))

    def following(self, command: str, *words: str, scheme: str = "", **changed: object) -> str:
        """The words of another command for the same scenario, quoted for a shell.

        words: further words at the end
        scheme: name of the scheme, empty for none
        changed: values of options in place of those that were given; None leaves one out
        """
        line = ["jaxilc", command]
        option = NAMES_ITS_FILE.get(command)
        line += [option] if option else []
        line.append(f"./{self.source}" if self.source.startswith("-") else self.source)
        line += ["--scheme", scheme] if scheme else []
        return shlex.join([*line, *self.repeated(command, **changed), *words])

    def repeated(self, command: str, **changed: object) -> list[str]:
        """The options that were given, and that another command has too, as words."""
        given = dataclasses.asdict(self) | {"trial": self.trials} | changed
        options = ((name, value) for name in REPEATED[command] for value in _each(given[name]))
        return [word for name, value in options for word in (f"--{name}", str(value))]

    def name_of(self, best: str, schemes: Sequence[str]) -> str:
        """The name of a scheme, empty where it is the only one and the user has not named it.

        schemes: names of all schemes of this command
        """
        return best if self.schemes or len(schemes) > 1 else ""

    def without(self, scheme: str) -> Request:
        """The same without the settings of a scheme, which its file of parameters holds."""
        kept = tuple(one for one in self.set if not one.strip().startswith(f"{scheme}."))
        return dataclasses.replace(self, set=kept)


def _each(value: object) -> Sequence[object]:
    if isinstance(value, tuple | list):
        return value
    return () if value is None else (value,)


def settings_of(given: Sequence[str]) -> dict[str, str]:
    """The values of the options `--set PATH=VALUE`, by path."""
    values = {}
    for setting in given:
        path, equals, value = setting.partition("=")
        if not equals:
            raise ValueError(f"--set {setting!r} is not PATH=VALUE")
        values[path.strip()] = value.strip()
    return values


def unless_there(place: Path, resume: bool) -> Path:
    """The place of what a computation keeps, inside the folder for results.

    Raises FileExistsError if it exists already and is not to be gone on with, and ValueError where
    another process is writing there.
    """
    if place.exists() and not resume:
        need_unused(place)
        raise FileExistsError(
            f"{place} exists already; add --resume to go on with it, or choose another --out"
        )
    return place
