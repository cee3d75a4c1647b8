"""A page with sliders whose figures follow them, for a server or a notebook.

All weights, all machines and the spread are arguments of one compiled program; only a change of
what is static, such as a lead, compiles another, which is kept.
"""

from __future__ import annotations

import asyncio
import functools
import math
import shlex
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..learning.metrics import Keep
from ..learning.over_trials import check, learn
from ..pytree.aliases import Tree, Value
from ..pytree.named_paths import get_at, interval_at, kind_at, replaced, settable
from ..pytree.ranges import require
from ..runtime.tiles import tiled
from ..theory.chance import draws
from ..theory.law import traced_response
from ..theory.loop import linear_loop, response
from ..theory.q_filter import need_linear
from ..uncertainty import Population, with_spread
from .grid_map import GridMap, in_order, live_map
from .page import legend, plot, shown_in, side_by_side, spoken, thinned
from .style import COLOURS, PALE, colour_of, labelled

if TYPE_CHECKING:
    import xarray as xr
    from bokeh.document import Document
    from bokeh.models import LayoutDOM, Slider
    from bokeh.plotting import figure as Plot

    from ..learning.machine import Machine
    from ..scenarios import Scenario
    from ..schemes import Scheme
    from ..sweeps.points import BestPoint


# What moves when a weight is moved: errors by trial, tracking and |Q - L P|, within a blink
# --------------------------------------------------------------------------------------------------


MACHINES = 32  # the nominal one included
AT_MOST = 4096  # machines that follow a slider
MOST = 10  # sliders
DECADES = 2.0  # of a weight, to both sides of its value
LEADS, MORE = 60, 8  # least end of the slider of a lead [samples], and of another whole number
LINES = 240  # frequencies
KEPT = 8  # spreads whose machines are kept
STEPS = 400  # of a slider that is not of a whole number
MACHINE = "machine."  # before a path of the machine


class Control(NamedTuple):
    """A number that can be moved, with the ends of its slider.

    path: of the scheme, or of the machine with `MACHINE` before it
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
    r, y, e, u: (N+1, n_y) or (N, n_u) signals of the last trial of the nominal machine
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
    machines: number of machines, the nominal one included, each with the noise that it has in a
        `Sweep`; one where nothing tells them apart
    source, repeated: name or file of the scenario, and the options that lead to it from there, for
        the command line
    printed: the scenario without those options, which a parameter file goes on; None for the same
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
        printed: Scenario | None = None,
        grid: Mapping[str | tuple[str, ...], Value] | xr.Dataset | None = None,
        progress: Callable[[str, int, int], None] | None = None,
    ):
        require("explore", "machines", machines, f"[1, {AT_MOST}]", whole=True)
        learning = [name for name, one in scenario.schemes.items() if one.learns]
        name = scheme or next(iter(learning or scenario.schemes))
        self.scenario, self.source = scenario.select((name,)), source or scenario.name
        self.repeated, self.printed = tuple(repeated), printed or self.scenario
        self.name, self.given = name, self.scenario.schemes[name]
        check(scenario.machine, self.given, scenario.task)
        self.draws = draws(scenario.machine)
        self.machines = machines if scenario.uncertainty or self.draws else 1
        self.spread = _spread_of(scenario)
        dt, N = float(scenario.task.dt), scenario.task.N
        found = (_control(self.given, path, dt) for path in settable(self.given))
        self.controls = [control for control in found if control][:MOST]
        needed = {n: of for n, of in scenario.functions.items() if n == scenario.judged_by}
        self.keep = Keep.of(needed)
        self.f = np.geomspace(1 / (N * dt), 0.5 / dt, LINES)
        self.map = None if grid is None else self._mapped(grid, needed, progress)

    def _mapped(self, grid, needed, progress) -> tuple[xr.Dataset, BestPoint]:
        """A sweep of the scheme over a grid, with its best point; controls reach its points."""
        import xarray as xr

        from ..sweeps.grid import values_at
        from ..sweeps.points import best_points, labels_of
        from ..sweeps.sweep import Sweep

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
        best = best_points(grid, s.look["tolerance"], metric=s.judged_by)[0]
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
        return replaced(self.given, self._read(values)[0])

    def _read(self, values: Mapping[str, float]) -> tuple[dict[str, float], dict[str, float]]:
        """The values by path in the scheme, and those by path in the machine."""
        whole = {control.path for control in self.controls if control.whole}
        read = {p: int(v) if p in whole else float(v) for p, v in values.items()}
        moved = {p.removeprefix(MACHINE): v for p, v in read.items() if p.startswith(MACHINE)}
        return {p: v for p, v in read.items() if not p.startswith(MACHINE)}, moved

    def outcome(
        self, values: Mapping[str, float], spread: float | None = None, *, alone: bool = False
    ) -> Outcome:
        """What values by path and a spread lead to; `alone`: the nominal machine, which is fast."""
        s = self.scenario
        own, moved = self._read(values)
        scheme = replaced(self.given, own)
        spread = self.spread if spread is None else float(spread)
        drawn = self._drawn(tuple(moved.items()), spread)
        if alone:
            drawn = jax.tree.map(lambda x: x[:1], drawn)
        errors, signals, size = _computed(
            scheme, drawn, s.task, self.f,
            trials=s.trials, metric=s.judged_by, keep=self.keep, frequency=self._has_response(),
        )  # fmt: skip
        scale = s.shown(s.judged_by)[0]
        r, y, u = (np.asarray(x).reshape(len(x), -1) for x in signals)
        errors = scale * np.asarray(errors)
        found = np.asarray(size)
        return Outcome(errors, r, y, s.shown_scale * (r - y), u, self.f[: found.shape[1]], found)

    @functools.lru_cache(KEPT)  # noqa: B019  (an exploration lives as long as its page)
    def _drawn(
        self, moved: tuple[tuple[str, float], ...], spread: float | None
    ) -> tuple[Machine, jax.Array]:
        """The machines of a spread, with values of the nominal one by path, and their keys."""
        s = self.scenario
        wide = s.uncertainty
        if spread is not None and spread != self.spread:
            wide = with_spread(wide, spread)
        nominal = replaced(s.machine, dict(moved))
        population = Population(nominal, wide, count=self.machines, sampling="sobol")
        return jax.vmap(population.one_of)(population.batch())

    @functools.cache  # noqa: B019
    def _has_response(self) -> bool:
        """Whether the law has a frequency response, as `filter` says, of one channel."""
        s = self.scenario
        if not (s.task.inputs == s.task.outputs == 1 and self.given.learns):
            return False
        try:
            need_linear(s.machine, self.given, s.task)
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
        """The command line that simulates the same on one machine, or with a spread on others.

        Of a machine that draws noise, `run` has another draw than the nominal machine here, and a
        sweep draws more machines.
        """
        words = ["jaxilc", "run" if spread is None else "sweep", self.source, "--scheme", self.name]
        return shlex.join([*words, *self.repeated, *self.settings(values, spread)])

    def settings(self, values: Mapping[str, float], spread: float | None) -> list[str]:
        """The options of what differs from the values and the spread that were given."""
        words = []
        for path, value in self.changed(values).items():
            whole = path if path.startswith(MACHINE) else f"{self.name}.{path}"
            words += ["--set", f"{whole}={value:.6g}"]
        return words if spread is None else [*words, "--spread", f"{spread:.4g}"]

    def save(self, values: Mapping[str, float], path: str | Path) -> Path:
        """Write the values of the scheme as a parameter file, for `--params`."""
        from ..runtime.provenance import describe
        from ..scenarios.parameters import differing, write_parameters

        Path(path).parent.mkdir(parents=True, exist_ok=True)
        s, moved = self.scenario, self._read(values)[1]
        printed = self.printed.schemes[self.name]
        changed = {self.name: differing(self.scheme_with(values), printed)}
        made = {"machine": describe(replaced(s.machine, moved))}
        how = {"command": "jaxilc explore", "options": dict(s.options), "configuration": made}
        return write_parameters(Path(path), s.name, changed, how)


def _control(tree: Tree, path: str, dt: float) -> Control | None:
    """The control of a single number at a path, else None; a cutoff stays below Nyquist."""
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
        ends = (ends[0], min(ends[1], max(0.49 / dt, number)))
    if ends[1] <= ends[0]:
        return None
    if allowed is not None and not whole:  # an end that is excluded stays a step away
        step = (ends[1] - ends[0]) / STEPS
        ends = (
            ends[0] if allowed.contains(ends[0]) else min(number, ends[0] + step),
            ends[1] if allowed.contains(ends[1]) else max(number, ends[1] - step),
        )
    log = not whole and ends[0] > 0 and ends[1] / ends[0] > 30
    return Control(path, number, *ends, log, whole)


def _spread_of(scenario: Scenario) -> float | None:
    """The larger half-width of the first relative uncertainty; None without one below 1.

    A spread of 1 or more, as of an uneven range, is none that `with_spread` could give back.
    """
    relative = (one.corners() for one in scenario.uncertainty.values() if one.relative)
    half_width = next((max(high - 1.0, 1.0 - low) for low, high in relative), np.inf)
    return half_width if half_width < 1 else None


def _size(scheme, machine, task, f) -> jax.Array:
    """(F,) |Q - L P| of a machine."""
    law = traced_response(scheme, task, f)
    P = response(linear_loop(machine, scheme, task), f, task.dt)
    return jnp.abs(law.keep[:, 0, 0] - law.L[:, 0, 0] * P[:, 0, 0])


@functools.partial(jax.jit, static_argnames=("trials", "metric", "keep", "frequency"))
def _computed(scheme, drawn, task, f, *, trials, metric, keep, frequency):
    """Errors of all machines, r, y and u of the nominal one's last trial, and |Q - L P|."""

    def of(common, one):
        (scheme, task), (machine, key) = common, one
        history = learn(machine, scheme, task, trials, key=key, save=keep)
        values = history.saved[metric] if keep.quantities else getattr(history, metric)
        values = jnp.max(values.reshape(trials, -1), axis=1)
        return jnp.where(history.diverged, jnp.inf, values), history.final[:3]

    errors, signals = tiled(of)((scheme, task), drawn)
    first = jax.tree.map(lambda x: x[0], signals)
    if not frequency:
        return errors, first, jnp.zeros((len(errors), 0))
    return errors, first, jax.vmap(lambda one: _size(scheme, one, task, f))(drawn[0])


# The page
# --------------------------------------------------------------------------------------------------


POINTS = 1200  # of a signal
SPREADS = (1.0, 60.0)  # ends of the slider of the spread [%], but for one given beyond them
UNITS = {"cutoff": "Hz", "lead": "samples"}  # of weights by the last part of their paths
TALLEST = 1e3  # times the first error, up to which errors are shown
LATEST = 0.4  # [s] after which the band does not wait for newer values any more
# Of a dark page the lightness is turned, and hues keep their meaning.
AROUND = "@media screen and (prefers-color-scheme: dark) { body { background: #191919; } }"
WITHIN = """
:host { background: white; color: black; }
@media screen and (prefers-color-scheme: dark) {
  :host { filter: invert(0.9) hue-rotate(180deg); }
}
"""
BESIDE = ThreadPoolExecutor(1, "explore")  # one computation at a time, of all readers


class Explorer:
    """The widgets and figures of one reader, beside the computation that all readers share."""

    def __init__(self, exploration: Exploration, folder: Path):
        from bokeh.models import Button, ColumnDataSource, Div, Slider

        self.of, self.folder = exploration, folder
        self.asked, self.busy = 0, False
        self.sliders = {control.path: _slider(control) for control in exploration.controls}
        self.spread = None
        if exploration.spread is not None:
            given = 100 * exploration.spread
            low, high = self.spreads = min(SPREADS[0], given), max(SPREADS[1], given)
            title = "spread of the machines [%]"
            self.spread = Slider(title=title, start=low, end=high, step=0.5, value=given)
        self.errors = ColumnDataSource({n: [] for n in ("j", "nominal", "low", "high", "worst")})
        self.size = ColumnDataSource({"f": [], "size": [], "worst": []})
        self.told, self.line = Div(text=""), Div(text="")
        self.button = Button(label="save as parameter file", width=200)
        self.button.on_click(self._save)
        first = exploration.outcome({})
        s = exploration.scenario
        self.unit = s.shown(s.judged_by)[1]
        self.factor, self.unit_of_e = shown_in(np.nanmax(np.abs(first.e)), s.shown_unit)
        self.signals = ColumnDataSource(self._signals(first))
        self.figures = self._figures(first)
        self.map: GridMap | None = None
        self.here = ColumnDataSource({"x": [], "y": []})
        if exploration.map is not None:
            self.figures = [self._map(*exploration.map), *self.figures]
        self._show(first)
        for widget in self.moved:
            widget.on_change("value", lambda attr, old, new: self._move())

    @property
    def moved(self) -> list[Slider]:
        """All sliders."""
        return [*self.sliders.values(), *([self.spread] if self.spread else [])]

    def values(self) -> dict[str, float]:
        """The values by path that the sliders have."""
        found = {}
        for control in self.of.controls:
            value = float(self.sliders[control.path].value)
            if control.log:  # before the power, which a browser's value may overflow
                value = 10.0 ** _held(value, math.log10(control.low), math.log10(control.high))
            found[control.path] = _held(value, control.low, control.high)
        return found

    def spread_asked(self) -> float | None:
        """The spread of the slider; None where it was not moved, or there is none."""
        if self.spread is None or self.of.spread is None:
            return None
        asked = _held(self.spread.value, *self.spreads)
        return None if math.isclose(asked, 100 * self.of.spread) else asked / 100

    def layout(self) -> LayoutDOM:
        """All of the page."""
        from bokeh.layouts import column
        from bokeh.models import Div, GlobalInlineStyleSheet

        title = Div(text=f"<h2>{escape(self.of.scenario.title)}: {escape(self.of.name)}</h2>")
        title.stylesheets = [GlobalInlineStyleSheet(css=AROUND)]
        beside = column(*self.moved, self.button, self.line, self.told, width=320)
        shown = column(*self.figures, width=960)
        both = side_by_side(beside, shown)
        return column(title, both, sizing_mode="stretch_width", margin=(0, 16, 0, 16),
                      stylesheets=[WITHIN])  # fmt: skip

    def _map(self, dataset: xr.Dataset, best: BestPoint) -> Plot:
        """The map of a grid, on which a click moves the sliders, and a ring says where they are."""
        self.map = drawn = live_map(dataset, best, height=300, **self.of.scenario.look)
        drawn.points.selected.indices = []
        drawn.points.selected.on_change("indices", lambda attr, old, new: self._go(new))
        drawn.figure.scatter(
            "x", "y", source=self.here, size=20, line_color="black", line_width=2, fill_color=None,
        )  # fmt: skip
        return drawn.figure

    def _go(self, chosen: list[int]) -> None:
        """Move the sliders to a point of the map; what no slider moves is there already."""
        if self.map is None or not chosen:
            return
        logs = {control.path: control.log for control in self.of.controls}
        for name, value in self.map.at(chosen[0]).items():
            path = name.removeprefix(f"{self.of.name}.")
            if path in self.sliders:
                self.sliders[path].value = math.log10(value) if logs[path] else value
        self.map.points.selected.indices = []  # so that the same point can be chosen again

    def _move(self) -> None:
        """Answer a slider beside the server: of the values that it passes only the latest."""
        from bokeh.document import without_document_lock

        self.asked += 1
        document = self.told.document
        if document is None:
            self._show(self.of.outcome(self.values(), self.spread_asked()))
        elif not self.busy:
            self.busy, answer = True, without_document_lock(self._answer)
            document.add_next_tick_callback(answer)

    async def _answer(self) -> None:
        """Answer until nothing new is asked: the nominal machine at first, then all machines."""
        band_at, answered, alone = time.monotonic(), -1, self.of.machines > 1
        try:
            while answered != self.asked:
                answered = self.asked
                shown = await self._computed(alone=alone)
                late = answered == self.asked or time.monotonic() - band_at > LATEST
                if shown and alone and late:
                    await self._computed(alone=False)
                    band_at = time.monotonic()
        finally:
            self.busy = False

    async def _computed(self, *, alone: bool) -> bool:
        """Compute beside the server, and show; a value that is not allowed is told instead."""
        if self.told.document is None:  # the page was closed
            return False
        values, spread = self.values(), self.spread_asked()
        work = functools.partial(self.of.outcome, values, spread, alone=alone)
        loop = asyncio.get_running_loop()
        try:
            found = await loop.run_in_executor(BESIDE, work)
        except ValueError as error:
            show = functools.partial(self.told.update, text=escape(str(error)))
        else:
            show = functools.partial(self._show, found)
        document = self.told.document
        if document is not None:  # the page may have been closed
            document.add_next_tick_callback(show)
        return show.func == self._show

    def _save(self) -> None:
        values = self.values()
        told = f"written: {self.of.save(values, self.folder / 'params.json')}, for --params"
        of_machine = {path: x for path, x in values.items() if path.startswith(MACHINE)}
        if besides := self.of.settings(of_machine, self.spread_asked()):
            told += f"; beside it {shlex.join(besides)}, which it does not hold"
        self.told.text = escape(told)

    def _show(self, found: Outcome) -> None:
        """Give the figures their data, and the text its numbers."""
        self._show_errors(found.errors)
        self.signals.data = self._signals(found)
        self.size.data = {"f": found.f, "size": found.size[0], "worst": np.max(found.size, axis=0)}
        self._tell(found)

    def _signals(self, found: Outcome) -> dict[str, np.ndarray]:
        """The columns of the last trial, of each output, with their extremes."""
        signals = {"r": found.r, "y": found.y, "e": self.factor * found.e}
        columns = {"t": thinned(self.of.scenario.task.time, POINTS, times=True)}
        for name, of in signals.items():
            columns |= {f"{name}_{c}": thinned(one, POINTS) for c, one in enumerate(of.T)}
        return columns

    def _show_errors(self, errors: np.ndarray) -> None:
        """(S, J) errors by trial, or those of the nominal machine alone beside what was shown.

        The band begins at the least error that is shown where machines have none, and ends at
        `TALLEST` where they diverge.
        """
        first = errors[:, 0]
        top = TALLEST * np.max(first, where=np.isfinite(first), initial=0.0)
        lines = {"nominal": errors[0], "worst": np.max(errors, axis=0)}
        shown = {n: np.where((v > 0) & (v < top), v, np.nan) for n, v in lines.items()}
        if len(errors) == 1 < self.of.machines:
            self.errors.data = dict(self.errors.data) | {"nominal": shown["nominal"]}
            return
        band = np.quantile(errors, (0.05, 0.95), axis=0, method="inverted_cdf")
        least = np.nanmin([*shown.values(), *np.where(band > 0, band, np.nan)], initial=top)
        shown |= zip(("low", "high"), np.clip(band, least, top), strict=True)
        self.errors.data = {"j": np.arange(1, errors.shape[1] + 1)} | shown

    def _tell(self, found: Outcome) -> None:
        """The numbers, and the command line that leads to them."""
        self._stand(found)
        last, worst = (
            f"{x:.4g} {self.unit}".rstrip() if x < np.inf else "diverged"
            for x in (found.errors[0, -1], np.max(found.errors[:, -1]))
        )
        said, several = [f"last trial: {last}"], len(found.errors) > 1
        if several:
            said[0] += f"; worst of {len(found.errors)}: {worst}"
        if found.size.size:
            largest = float(np.max(found.size))
            safe = "below 1" if largest < 1 else "not safe"
            among = f" of {len(found.errors)} machines" if several else ""
            said.append(
                f"largest |Q (1 − L P)|{among} at {len(found.f)} frequencies: {largest:.4g}, {safe}"
            )
        if self.of.draws:
            said.append("the noise of each machine is that of a sweep; run draws another")
        self.told.text = "<br/>".join(map(escape, said))
        words = escape(self.of.command(self.values(), self.spread_asked())).split(" ")
        whole = (f'<span style="white-space: nowrap">{word}</span>' for word in words)
        self.line.text = f"<code>{' '.join(whole)}</code>"

    def _stand(self, found: Outcome) -> None:
        """Move the ring on the map to where the sliders are."""
        if self.map is None:
            return
        s, values = self.of.scenario, self.values()
        at = [values[name.removeprefix(f"{self.of.name}.")] for name in self.map.values[0]]
        high = np.quantile(found.errors[:, -1], 0.95, method="inverted_cdf")
        at.append(high * self.map.factor / s.shown(s.judged_by)[0])  # the height on a line
        self.here.data = {"x": at[:1], "y": at[1:2]}

    def _figures(self, first: Outcome) -> list[Plot]:
        """The figures of errors by trial, of the last trial, and over frequency."""
        s = self.of.scenario
        errors = plot("", "trial", labelled(s.judged_by, self.unit), height=260)
        errors.varea("j", "low", "high", source=self.errors, fill_alpha=0.2, color=COLOURS[0],
                     legend_label="5 to 95 % of the machines")  # fmt: skip
        errors.line("j", "nominal", source=self.errors, line_width=2, color=COLOURS[0],
                    legend_label="nominal machine")  # fmt: skip
        errors.line("j", "worst", source=self.errors, line_dash="dotted", color=COLOURS[1],
                    legend_label="worst machine")  # fmt: skip
        errors.legend.location, errors.legend.label_text_font_size = "top_right", "8pt"
        output = labelled("output", s.task.unit)
        track = plot("last trial of the nominal machine", "", output, log=False, height=180)
        of_e = labelled("error", self.unit_of_e)
        error = plot("", "time [s]", of_e, log=False, height=180, x_range=track.x_range)
        several = s.task.outputs > 1
        for c, label in enumerate(s.task.labels):
            named = (
                {"legend_label": label if s.task.names else f"output {label}"} if several else {}
            )
            of_y, of_e = (colour_of(c), colour_of(c)) if several else COLOURS[:2]
            track.line("t", f"r_{c}", source=self.signals, line_width=4, color=PALE)
            track.line("t", f"y_{c}", source=self.signals, line_width=1.5, color=of_y, **named)
            error.line("t", f"e_{c}", source=self.signals, color=of_e, **named)
        for one in (track, error):
            legend(one)
        if not first.size.size:
            return [errors, track, error]
        from bokeh.models import Span

        size = plot("dotted: the largest of all machines", "frequency [Hz]", "|Q (1 − L P)|",
                    log=False, height=220, x_axis_type="log", y_range=(0, 2))  # fmt: skip
        size.line("f", "worst", source=self.size, line_dash="dotted", color=COLOURS[1])
        size.line("f", "size", source=self.size, line_width=2, color=COLOURS[0])
        size.add_layout(Span(location=1.0, dimension="width", line_color="black"))
        return [errors, track, error, size]


def explore(
    scenario: Scenario, scheme: str | None = None, *, folder: str | Path = "out/explore", **options
) -> Callable[[Document], None]:
    """An application of Bokeh with sliders for the weights of a scheme.

    In a notebook, `bokeh.io.output_notebook(bokeh.resources.INLINE)` and
    `bokeh.io.show(explore(scenario), notebook_url="localhost:8888")` show it, with the address of
    the notebook as the browser has it: a page of another address gets nothing.

    folder: where a parameter file is saved
    scheme, options: as for `Exploration`
    Returns a function of a document of Bokeh, which `bokeh.io.show` and servers take.
    """
    shared = Exploration(scenario, scheme, **options)
    for alone in (True, False):
        shared.outcome({}, alone=alone)  # compiled once, before anyone waits for it

    from bokeh.models import CustomJS

    def application(document: Document) -> None:
        document.title = f"jaxilc: {scenario.name}"
        document.add_root(Explorer(shared, Path(folder)).layout())
        document.js_on_event("document_ready", CustomJS(code=spoken()))

    return application


def _slider(control: Control) -> Slider:
    """A slider; one that is logarithmic has the power of ten as its value."""
    from bokeh.models import CustomJSTickFormatter, Slider

    unit = UNITS.get(control.path.rpartition(".")[2])
    title = control.path + (f" [{unit}]" if unit else "")
    if control.whole:
        return Slider(title=title, start=control.low, end=control.high, step=1, value=control.value)
    low, high, value = (
        (math.log10(x) if control.log else x) for x in (control.low, control.high, control.value)
    )
    power = CustomJSTickFormatter(code="return (10 ** tick).toPrecision(3)")
    return Slider(
        title=title, start=low, end=high, value=value, step=(high - low) / STEPS,
        format=power if control.log else "0[.]000",
    )  # fmt: skip


def _held(value: float, low: float, high: float) -> float:
    """A value within its ends, which are not those of a slider: a browser may move them too."""
    return min(max(value, low), high) if math.isfinite(value) else low
