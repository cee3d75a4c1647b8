"""What is asked of a scenario: its settings, the scenario with them, and the command to type next.

This module does not import NumPy or JAX, so that commands that need neither stay fast.
"""

from __future__ import annotations

import dataclasses
import numbers
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from ..scenarios.catalogue import LISTED
from ..storage.files import need_unused

if TYPE_CHECKING:
    import xarray as xr

    from ..pytree.aliases import Value
    from ..scenarios import Scenario
    from .outcome import Numbers


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


@dataclasses.dataclass(frozen=True)
class Request:
    """What is asked of a scenario, and what the next command repeats; None or () if not given.

    In place of several texts there may be one, and in place of those of `set` values by path.

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

    def __post_init__(self) -> None:
        given: Value = self.set
        if isinstance(given, Mapping):
            texts = tuple(f"{path}={as_text(value)}" for path, value in given.items())
            object.__setattr__(self, "set", texts)
        for name in ("schemes", "set"):
            if isinstance(getattr(self, name), str):
                object.__setattr__(self, name, (getattr(self, name),))

    @classmethod
    def of(cls, asked: Request | str | Path) -> Request:
        """The request itself, or that of the name of a scenario or of a plant file."""
        return asked if isinstance(asked, Request) else cls(str(asked))

    @property
    def of_file(self) -> bool:
        """Whether the scenario is a plant file."""
        return self.source not in LISTED and Path(self.source).suffix in FILES

    def scenario(self, *, grid: str | Sequence[str] | None = None) -> Scenario:
        """The scenario as it is asked for.

        grid: axes beside its own of a grid, at whose points it is run, which `Sweep` checks; None
            where it is run as it is
        Its options are set first, then the parameters, then all else, then the schemes are chosen.
        The metric and the tolerance judge it, and the spread widens its uncertainty.
        Raises ValueError naming what is allowed.
        """
        from ..runtime.start import warn_of_single
        from ..scenarios.from_file import with_options
        from ..scenarios.parameters import warn_of_another, with_parameters
        from ..scenarios.scenario import judged

        warn_of_single()
        here = self.expanded()
        chosen, rest = with_options(here.source, settings_of(here.set))
        if not chosen.schemes:
            raise ValueError(
                f"{self.source} has no scheme; needed is a table [schemes.NAME] at least"
            )
        if here.params is not None:
            chosen = with_parameters(chosen, here.params, here.schemes)
        chosen = here._with_trials(chosen.with_values(rest)).select(here.schemes)
        if here.params is not None:
            warn_of_another(chosen, here.params, settings_of(here.set))
        if grid is None or not (grid or chosen.grid):
            chosen.check()
        chosen = judged(here._widened(chosen), here.metric)
        limit = chosen.tolerance if here.tolerance is None else here.tolerance
        return dataclasses.replace(chosen, tolerance=limit)

    def of_one_scheme(self) -> tuple[Scenario, str]:
        """The scenario and the name of its only scheme; raises ValueError if there are several."""
        chosen = self.scenario()
        if len(chosen.schemes) > 1:
            raise ValueError(f"--scheme: needed is one of {', '.join(chosen.schemes)}")
        return chosen, next(iter(chosen.schemes))

    def machine_to_design(self) -> Scenario:
        """The scenario of a plant file, of whose schemes, if there are any, the feedback counts."""
        from ..runtime.start import warn_of_single
        from ..scenarios.from_file import load_scenario

        warn_of_single()
        chosen = self._with_trials(load_scenario(self.source, settings_of(self.set)))
        return self._widened(chosen).select(self.schemes)

    def _widened(self, chosen: Scenario) -> Scenario:
        """A scenario with the spread of its uncertainty that is asked for."""
        from ..uncertainty import with_spread

        if self.spread is None:
            return chosen
        wide = with_spread(chosen.uncertainty, self.spread)
        if not any(d.relative for d in wide.values()):
            raise ValueError(
                f"spread = {self.spread:g} widens nothing, since no uncertainty of {self.source} "
                "is relative; needed is one with relative = true in [uncertainty]"
            )
        return dataclasses.replace(chosen, uncertainty=wide)

    def _with_trials(self, chosen: Scenario) -> Scenario:
        if self.trials is None:
            return chosen
        if not isinstance(self.trials, numbers.Integral) or self.trials < 1:
            raise ValueError(
                f"--trials {self.trials} is outside its allowed range [1, inf) of whole numbers"
            )
        return dataclasses.replace(chosen, trials=self.trials)

    def expanded(self) -> Request:
        """The same with a point in place of a stored grid, where `params` is the folder of one.

        It is the best one by the metric and the tolerance of the scenario, over its schemes. What
        is set stands after the point, and so counts.
        Raises ValueError as `open_grid` does, for a sweep of another scenario or one of which more
        than 5 % of the machines diverge at every point, and for an axis that no option can set.
        """
        from ..scenarios.from_file import SCENARIOS, options

        if self.params is None or not Path(self.params).is_dir():
            return self
        point = self._best_point(Path(self.params))
        of_paper = options(self.source) if self.source in SCENARIOS else {}
        for axis in point:
            if axis.startswith("task.") or ("." not in axis and axis not in (*of_paper, "trials")):
                raise ValueError(
                    f"--params {self.params}: the axis {axis} is not one that --set can set"
                )
        of_point = point.pop("trials", None)
        trials = of_point if self.trials is None else self.trials
        texts = (*(f"{axis}={as_text(x)}" for axis, x in point.items()), *self.set)
        return dataclasses.replace(self, trials=trials, set=texts, params=None)

    def _best_point(self, folder: Path) -> dict[str, Value]:
        """The values of all axes at the best point of a stored grid, by name."""
        from ..sweeps.points import best_points, labels_of, point_of

        dataset, settings = open_grid(folder), settings_of(self.set)
        axes = {*labels_of(dataset)}
        own = (path for path in settings if not {path, f"machine.{path}"} & axes)
        texts = tuple(f"{path}={settings[path]}" for path in own)
        bare = dataclasses.replace(self, set=texts, params=None).scenario()
        schemes = [name for name in bare.schemes if name in dataset["scheme"]]
        if not schemes:
            raise ValueError(
                f"--params {folder} has the schemes "
                f"{', '.join(map(str, dataset['scheme'].values))}, and none of "
                f"{', '.join(bare.schemes)}"
            )
        # A value that is replaced at every point; of an element, the others have to be the same.
        replaced = [axis for axis in axes if "." in axis and "[" not in axis]
        explained = [*settings, *replaced]
        _need_same(folder, dataset.attrs["configuration"], bare, schemes, explained)
        limit = bare.look["tolerance"]
        found = best_points(dataset.sel(scheme=schemes), limit, metric=bare.judged_by)
        best = min(found, key=lambda of: of.rank)
        if not best.anywhere:
            raise ValueError(f"--params {folder}: {best.sentences[0]}")
        return point_of(dataset, best.point)

    def grid(self, axes: str | Sequence[str], chosen: Scenario) -> dict[str, Value]:
        """The grid of the scenario, for `Sweep`, with axes PATH=VALUES, also of its options."""
        grid, read = dict(chosen.grid), set()
        for axis in [axes] if isinstance(axes, str) else axes:
            name, equals, values = (part.strip() for part in axis.partition("="))
            if not equals:
                raise ValueError(f"--grid {axis!r} is not PATH=VALUES")
            if name in read:
                raise ValueError(f"--grid {name} is given twice; allowed is once")
            read.add(name)
            grid[name] = values
            if name in chosen.options:
                labels = [label.strip() for label in values.split(",")]
                if len({*labels}) < len(labels):
                    raise ValueError(
                        f"--grid {axis!r} has equal values; allowed are different ones"
                    )
                at = {x: dataclasses.replace(self, set=(*self.set, f"{name}={x}")) for x in labels}
                grid[name] = {label: of.scenario(grid=axes) for label, of in at.items()}
        return grid

    def following(self, command: str, *words: str, scheme: str = "", **changed: object) -> str:
        """The words of a command for the same scenario; an option changed to None is left out."""
        line = ["jaxilc", command, *(["--scenario"] if command == "next" else [])]
        line.append(f"./{self.source}" if self.source.startswith("-") else self.source)
        line += ["--scheme", scheme] if scheme else []
        return shlex.join([*line, *self.repeated(command, **changed), *words])

    def repeated(self, command: str, **changed: object) -> list[str]:
        """The options that were given, and that another command has too, as words."""
        given = dataclasses.asdict(self) | {"trial": self.trials} | changed
        options = ((name, value) for name in REPEATED[command] for value in _each(given[name]))
        return [word for name, value in options for word in (f"--{name}", str(value))]

    def name_of(self, best: str, schemes: Sequence[str]) -> str:
        """The name of a scheme, empty where it is the only one and the user has not named it."""
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
    """The place in a folder for results; raises FileExistsError if it is there, unless resumed."""
    if place.exists() and not resume:
        need_unused(place)
        raise FileExistsError(
            f"{place} exists already; add --resume to go on with it, or choose another --out"
        )
    return place


# A grid that `jaxilc sweep` stored, and its best point as settings of another command
# --------------------------------------------------------------------------------------------------


def open_grid(folder: Path) -> xr.Dataset:
    """The dataset of a grid in a folder; raises ValueError if there is none, or it is damaged."""
    from ..sweeps.store import open_dataset, stored_configuration

    store = folder / "dataset.zarr"
    store = store if store.is_dir() else folder
    try:
        known = stored_configuration(store)
    except ValueError:
        raise ValueError(
            f"--params {folder} is neither a parameter file nor the folder of a sweep"
        ) from None
    if "grid" not in known:
        raise ValueError(f"--params {folder} has no grid; a sweep with --grid has one")
    dataset = open_dataset(store)
    left = int((dataset["diverged_at"] < 0).sum())
    if left:
        raise ValueError(
            f"--params {folder} is not complete: {left} of {dataset['diverged_at'].size} runs are "
            "missing; the same sweep with --resume goes on"
        )
    return dataset


def as_text(value: Value) -> str:
    """A value, such as one of `point_of`, as `--set` takes it."""
    value = value.tolist() if hasattr(value, "tolist") else value
    return ",".join(map(str, value)) if isinstance(value, tuple | list) else f"{value}"


def _need_same(folder, stored: Numbers, bare: Scenario, schemes, explained) -> None:
    """Raises ValueError where a sweep had another machine, task or law, but at explained paths."""
    from ..pytree.closest import first_of
    from ..pytree.named_paths import owner_of
    from ..runtime.provenance import describe, differences
    from ..storage.sealed import as_json

    of = {name: describe(bare.schemes[name]) for name in schemes}
    now = as_json({"machine": describe(bare.machine), "task": describe(bare.task), "schemes": of})
    then = {name: stored[name] for name in ("machine", "task")}
    then["schemes"] = {name: stored["schemes"][name] for name in schemes}
    given = []
    for owner, path in (owner_of(path.partition("[")[0], bare.schemes) for path in explained):
        given.append(f"{owner}.{path}" if owner == "machine" else f"schemes.{owner}.{path}")
    wrong = differences(then, now, besides=given)
    if wrong:
        raise ValueError(
            f"--params {folder} is a grid of another scenario, or of other settings; it differs in "
            f"{first_of(wrong, between='; ')}"
        )
