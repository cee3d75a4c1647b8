"""What moves when a weight is moved: errors by trial, tracking and |Q - L P|, within a blink.

All weights, all machines and the spread are arguments of one compiled program; only a change of
what is static, such as a lead, compiles another, which is kept.
"""

from __future__ import annotations

import functools
import math
import shlex
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..learning.metrics import Keep
from ..learning.over_trials import check, learn
from ..pytree.named_paths import get_at, interval_at, kind_at, replaced, settable
from ..pytree.ranges import require
from ..runtime.tiles import tiled
from ..theory.law import traced_response
from ..theory.loop import linear_loop, response
from ..uncertainty import Population, with_spread

if TYPE_CHECKING:
    import xarray as xr

    from ..learning.machine import Machine
    from ..scenarios import Scenario
    from ..schemes import Scheme
    from ..sweeps.points import BestPoint

MACHINES = 32  # the nominal one included
AT_MOST = 4096  # machines that follow a slider
MOST = 10  # sliders
DECADES = 2.0  # of a weight, to both sides of its value
LEADS, MORE = 60, 8  # least end of the slider of a lead [samples], and of another whole number
LINES = 240  # frequencies
KEPT = 8  # spreads whose machines are kept


class Control(NamedTuple):
    """A number that can be moved.

    path: of the scheme, or of the machine with `machine.` before it
    value: as given
    low, high: ends of the slider
    log: whether the slider is logarithmic
    whole: whether it is a whole number, whose change compiles another program
    """

    path: str
    value: float
    low: float
    high: float
    log: bool
    whole: bool


class Outcome(NamedTuple):
    """What the weights lead to.

    errors: (S, J) metric by trial of each machine, the nominal one first [shown unit]; inf where
        a machine diverged
    r, y, e, u: (N+1,) or (N,) signals of the last trial of the nominal machine; the first channel
    f, size: (F,) frequencies [Hz] and (S, F) |Q - L P| of each machine; empty where there is none
    """

    errors: np.ndarray
    r: np.ndarray
    y: np.ndarray
    e: np.ndarray
    u: np.ndarray
    f: np.ndarray
    size: np.ndarray


class Exploration:
    """A scheme of a scenario, whose weights are moved by hand.

    scenario: what is simulated
    scheme: its name; None for the first one that learns
    machines: number of machines, the nominal one included
    source, repeated: name or file of the scenario, and the options that lead to it from there, for
        the command line
    grid: axes of a map, as for `Sweep`, which is run on these machines; or the dataset of such a
        sweep, of which axes that no slider moves stay as in the scenario
    progress: as for `Sweep.run`
    Raises ValueError for a scheme that is not there, for more than 4096 machines, as `learn`, and
    for an axis of the map that no slider can move.
    """

    def __init__(
        self,
        scenario: Scenario,
        scheme: str | None = None,
        *,
        machines: int = MACHINES,
        source: str | None = None,
        repeated: Sequence[str] = (),
        grid: Mapping[Any, Any] | xr.Dataset | None = None,
        progress: Callable[[str, int, int], None] | None = None,
    ):
        require("explore", "machines", machines, f"[1, {AT_MOST}]", whole=True)
        learning = [name for name, one in scenario.schemes.items() if one.learns]
        name = scheme or next(iter(learning or scenario.schemes))
        self.scenario, self.source = scenario.select((name,)), source or scenario.name
        self.repeated = tuple(repeated)
        self.name, self.given = name, self.scenario.schemes[name]
        check(scenario.machine, self.given, scenario.task)
        self.machines = machines
        self.spread = _spread_of(scenario)
        self.controls = controls_of(self.given, float(scenario.task.dt))
        needed = {n: of for n, of in scenario.functions.items() if n == scenario.judged_by}
        self.keep = Keep.of(needed)
        dt, N = float(scenario.task.dt), scenario.task.N
        self.f = np.geomspace(1 / (N * dt), 0.5 / dt, LINES)
        self._machines: dict[Any, Any] = {}
        self.map = None if grid is None else self._mapped(grid, needed, progress)

    def _mapped(self, grid, needed, progress) -> tuple[xr.Dataset, BestPoint]:
        """A sweep of the scheme over a grid, with its best point; controls reach its points."""
        import xarray as xr

        from ..sweeps.grid import values_at
        from ..sweeps.points import best_points, labels_of
        from ..sweeps.sweep import Sweep
        from .grid_map import in_order

        s = self.scenario
        if not isinstance(grid, xr.Dataset):
            sweep = Sweep(
                s.machine, s.schemes, s.task, s.trials, uncertainty=s.uncertainty,
                machines=self.machines, sampling="sobol", quantities=needed, grid=grid,
            )  # fmt: skip
            self._move_along({n: of for axis in sweep.axes.axes for n, of in axis.labels.items()})
            grid = sweep.run(progress=progress)
        if self.name not in grid["scheme"]:
            raise ValueError(f"explore: the grid has no scheme {self.name!r}")
        of_others = {str(name) for name in grid["scheme"].values} - {self.name}
        grid, _, drawn = in_order(grid.sel(scheme=[self.name]))
        limit = None if s.tolerance is None else s.tolerance / s.shown(s.judged_by)[0]
        best = best_points(grid, limit, metric=s.judged_by)[0]
        labels = [name for name in labels_of(grid) if name.partition(".")[0] not in of_others]
        here, at = values_at(labels, s) | dict(s.options), grid.coords.to_dataset().sel(best.point)
        self._move_along(
            {n: grid[n].values for n in labels
             if grid[n].dims[0] in drawn or here.get(n) != at[n].item()}
        )  # fmt: skip
        return grid, best

    def _move_along(self, axes: Mapping[str, np.ndarray]) -> None:
        """Give each name a control that reaches all of its values; ValueError if none can."""
        for name, values in reversed([*axes.items()]):
            owner, _, path = name.partition(".")
            tree = {self.name: self.given, "machine": self.scenario.machine}.get(owner)
            control = tree and _control(tree, path, float(self.scenario.task.dt))
            if not isinstance(control, Control) or values.dtype.kind not in "fi":
                raise ValueError(
                    f"explore: no slider can move the axis {name}; allowed are single numbers of "
                    f"{self.name} and of the machine"
                )
            low, high = min(control.low, values.min()), max(control.high, values.max())
            control = control._replace(
                path=name if tree is not self.given else path,
                low=float(low), high=float(high), log=control.log and low > 0,
            )  # fmt: skip
            others = (one for one in self.controls if one.path != control.path)
            self.controls = [control, *others][:MOST]

    def scheme_with(self, values: Mapping[str, float]) -> Scheme:
        """The scheme with values by path; raises ValueError naming what is allowed."""
        return self._with(values)[0]

    def _with(self, values: Mapping[str, float]) -> tuple[Scheme, Machine]:
        """The scheme and the nominal machine with values by path."""
        known = {control.path: control for control in self.controls}
        read = {p: int(v) if known[p].whole else float(v) for p, v in values.items()}
        moved = {p.removeprefix("machine."): v for p, v in read.items() if self._of_machine(p)}
        own = {p: v for p, v in read.items() if not self._of_machine(p)}
        return replaced(self.given, own), replaced(self.scenario.machine, moved)

    @staticmethod
    def _of_machine(path: str) -> bool:
        return path.startswith("machine.")

    def outcome(
        self, values: Mapping[str, float], spread: float | None = None, *, alone: bool = False
    ) -> Outcome:
        """What values by path lead to; a spread in place of that of the scenario.

        alone: the nominal machine alone, which takes a small part of the time
        Raises ValueError naming what is allowed.
        """
        s = self.scenario
        scheme, nominal = self._with(values)
        machines = self._drawn(nominal, self.spread if spread is None else float(spread))
        if alone:
            machines = jax.tree.map(lambda x: x[:1], machines)
        errors, signals, size = _computed(
            scheme, machines, s.task, self.f,
            trials=s.trials, metric=s.judged_by, keep=self.keep, frequency=self._has_response(),
        )  # fmt: skip
        scale = s.shown(s.judged_by)[0]
        y, u = (np.asarray(x).reshape(len(x), -1)[:, 0] for x in signals)
        r = np.asarray(s.task.reference).reshape(len(y), -1)[:, 0]
        errors = scale * np.asarray(errors)
        found = np.asarray(size)
        return Outcome(errors, r, y, s.shown_scale * (r - y), u, self.f[: found.shape[1]], found)

    def _drawn(self, nominal: Machine, spread: float | None) -> Any:
        """The machines of a spread; those of the last few are kept."""
        s = self.scenario
        key = spread, *(np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(nominal))
        if key not in self._machines:
            same = spread is None or spread == self.spread
            wide = s.uncertainty if same else with_spread(s.uncertainty, spread)
            if len(self._machines) >= KEPT:
                self._machines.clear()
            population = Population(nominal, wide, count=self.machines, sampling="sobol")
            self._machines[key] = population.machines
        return self._machines[key]

    @functools.cache  # noqa: B019  (an exploration lives as long as its page)
    def _has_response(self) -> bool:
        """Whether the law has a frequency response, on a machine of one output and one input."""
        s = self.scenario
        if not (s.task.inputs == s.task.outputs == 1 and self.given.learns):
            return False
        try:
            jax.eval_shape(
                lambda one: _size(one, s.machine, s.task, jnp.asarray(self.f)), self.given
            )
        except (ValueError, TypeError, NotImplementedError):
            return False
        return True

    def changed(self, values: Mapping[str, float]) -> dict[str, float]:
        """The values that differ from those given."""
        given = {control.path: control.value for control in self.controls}
        return {
            path: value
            for path, value in values.items()
            if not math.isclose(value, given[path], rel_tol=1e-9)
        }

    def command(self, values: Mapping[str, float], spread: float | None = None) -> str:
        """The command line that simulates the same on one machine, or on many with a spread."""
        words = ["jaxilc", "run" if spread is None else "sweep", self.source, "--scheme", self.name]
        words += self.repeated
        for path, value in self.changed(values).items():
            whole = path if self._of_machine(path) else f"{self.name}.{path}"
            words += ["--set", f"{whole}={value:.6g}"]
        if spread is not None:
            words += ["--spread", f"{spread:.4g}"]
        return shlex.join(words)

    def save(self, values: Mapping[str, float], path: str | Path) -> Path:
        """Write the values as a parameter file, for `--params`."""
        from ..scenarios.parameters import differing, write_parameters

        Path(path).parent.mkdir(parents=True, exist_ok=True)
        changed = {self.name: differing(self.scheme_with(values), self.given)}
        how = {"command": "jaxilc explore", "options": dict(self.scenario.options)}
        return write_parameters(Path(path), self.scenario.name, changed, how)


def controls_of(scheme: Scheme, dt: float) -> list[Control]:
    """The single numbers of a scheme that can be moved, with the ends of their sliders.

    dt: sample time [s]; a cutoff stays below half of the sample rate
    """
    found = (_control(scheme, path, dt) for path in settable(scheme))
    return [control for control in found if control][:MOST]


def _control(tree: Any, path: str, dt: float) -> Control | None:
    """The control of a number at a path; None where there is no single finite number."""
    value, kind = get_at(tree, path), kind_at(tree, path)[0]
    whole = kind == "static" and isinstance(value, int) and not isinstance(value, bool)
    if not (whole or kind == "leaf") or value is None or np.size(value) != 1:
        return None
    number, allowed = float(np.ravel(np.asarray(value))[0]), interval_at(tree, path)
    if not np.isfinite(number):
        return None
    low, high = (-np.inf, np.inf) if allowed is None else (allowed.low, allowed.high)
    if whole:
        most = LEADS if path.endswith("lead") else MORE
        ends = (max(low, 0.0), min(high, max(most, 2 * number)))
    elif number > 0:
        ends = (max(low, number * 10**-DECADES), min(high, number * 10**DECADES))
    else:
        reach = max(4 * abs(number), 1.0)
        ends = (max(low, number - reach), min(high, number + reach))
    if path.rpartition(".")[2].startswith("cutoff"):
        ends = (ends[0], min(ends[1], 0.49 / dt))
    if ends[1] <= ends[0]:
        return None
    log = not whole and ends[0] > 0 and ends[1] / ends[0] > 30
    return Control(path, number, *ends, log, whole)


def _spread_of(scenario: Scenario) -> float | None:
    """The half-width of the first relative uniform uncertainty; None without one."""
    for one in scenario.uncertainty.values():
        if getattr(one, "relative", False) and hasattr(one, "high"):
            return float(np.max(np.asarray(one.high))) - 1.0
    return None


def _size(scheme, machine, task, f) -> jax.Array:
    """(F,) |Q - L P| of a machine."""
    law = traced_response(scheme, task, f)
    P = response(linear_loop(machine, scheme, task), f, task.dt)
    return jnp.abs(law.keep[:, 0, 0] - law.L[:, 0, 0] * P[:, 0, 0])


@functools.partial(jax.jit, static_argnames=("trials", "metric", "keep", "frequency"))
def _computed(scheme, machines, task, f, *, trials, metric, keep, frequency):
    """Errors of all machines, y and u of the last trial of the nominal one, and |Q - L P|."""

    def of(common, machine):
        scheme, task = common
        history = learn(machine, scheme, task, trials, save=keep)
        values = history.saved[metric] if keep.quantities else getattr(history, metric)
        values = jnp.max(values.reshape(trials, -1), axis=1)
        return jnp.where(history.diverged, jnp.inf, values), (history.final.y, history.final.u)

    errors, signals = tiled(of)((scheme, task), machines)
    first = jax.tree.map(lambda x: x[0], signals)
    if not frequency:
        return errors, first, jnp.zeros((len(errors), 0))
    return errors, first, jax.vmap(lambda one: _size(scheme, one, task, f))(machines)
