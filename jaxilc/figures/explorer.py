"""The page of an exploration: sliders, and figures that follow them; for a server or a notebook."""

from __future__ import annotations

import asyncio
import functools
import math
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from .exploration import Control, Exploration, Outcome
from .live_grid import map_of
from .page import plot, shown_in, side_by_side, spoken
from .style import COLOURS

if TYPE_CHECKING:
    import xarray as xr

    from ..scenarios import Scenario
    from ..sweeps.points import BestPoint

POINTS = 1200  # of a signal
SPREADS = (1.0, 60.0)  # ends of the slider of the spread [%]
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
    """The widgets and figures of one reader, beside the computation that all readers share.

    exploration: what is computed
    folder: where `save` writes `params.json`
    """

    def __init__(self, exploration: Exploration, folder: Path):
        from bokeh.models import Button, ColumnDataSource, Div, Slider

        self.of, self.folder = exploration, folder
        self.asked, self.busy = 0, False
        self.sliders = {control.path: _slider(control) for control in exploration.controls}
        self.spread = None
        if exploration.spread is not None:
            self.spread = Slider(
                title="spread of the machines [%]", start=SPREADS[0], end=SPREADS[1], step=0.5,
                value=_held(100 * exploration.spread, *SPREADS),
            )  # fmt: skip
        self.errors = ColumnDataSource({n: [] for n in ("j", "nominal", "low", "high", "worst")})
        self.signals = ColumnDataSource({n: [] for n in ("t", "r", "y", "e")})
        self.size = ColumnDataSource({"f": [], "size": [], "worst": []})
        self.told, self.line = Div(text=""), Div(text="")
        self.button = Button(label="save as parameter file", width=200)
        self.button.on_click(self._save)
        first = exploration.outcome({})
        s = exploration.scenario
        self.unit = s.shown(s.judged_by)[1]
        self.factor, self.unit_of_e = shown_in(np.nanmax(np.abs(first.e)), s.shown_unit)
        self.figures = self._figures(first)
        self.map, self.here = None, ColumnDataSource({"x": [], "y": []})
        if exploration.map is not None:
            self.figures = [self._map(*exploration.map), *self.figures]
        self._show(first)
        for widget in [*self.sliders.values(), *([self.spread] if self.spread else [])]:
            widget.on_change("value", lambda attr, old, new: self._move())

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
        asked = _held(float(self.spread.value), *SPREADS) / 100
        return None if math.isclose(asked, self.of.spread, abs_tol=2e-3) else asked

    def layout(self) -> Any:
        """All of the page."""
        from bokeh.layouts import column
        from bokeh.models import Div, GlobalInlineStyleSheet

        title = Div(text=f"<h2>{_escaped(self.of.scenario.title)}: {_escaped(self.of.name)}</h2>")
        title.stylesheets = [GlobalInlineStyleSheet(css=AROUND)]
        sliders = [*self.sliders.values(), *([self.spread] if self.spread else [])]
        beside = column(*sliders, self.button, self.line, self.told, width=320)
        shown = column(*self.figures, width=960)
        both = side_by_side(beside, shown)
        return column(title, both, sizing_mode="stretch_width", margin=(0, 16, 0, 16),
                      stylesheets=[WITHIN])  # fmt: skip

    def _map(self, dataset: xr.Dataset, best: BestPoint) -> Any:
        """The map of a grid, on which a click moves the sliders, and a ring says where they are."""
        s = self.of.scenario
        scale, unit = s.shown(s.judged_by)
        self.map = map_of(
            dataset, best, metric=s.judged_by, scale=scale, unit=unit, height=300,
            tolerance=None if s.tolerance is None else s.tolerance / scale,
        )  # fmt: skip
        self.map.points.selected.indices = []
        self.map.points.selected.on_change("indices", lambda attr, old, new: self._go(new))
        self.map.figure.scatter(
            "x", "y", source=self.here, size=20, line_color="black", line_width=2, fill_color=None,
        )  # fmt: skip
        return self.map.figure

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
        """Answer a slider: the nominal machine at first, then the band over all machines.

        It is computed beside the server, which goes on taking what sliders say. Of the values that
        a slider passes meanwhile only the last ones are answered, so that the figures do not fall
        behind the hand.
        """
        from bokeh.document import without_document_lock

        self.asked += 1
        document = self.told.document
        if document is None:
            self._show(self.of.outcome(self.values(), self.spread_asked()))
        elif not self.busy:
            self.busy, answer = True, without_document_lock(self._answer)
            document.add_next_tick_callback(answer)  # ty: ignore[invalid-argument-type]

    async def _answer(self) -> None:
        """Answer until nothing new is asked."""
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
            show = functools.partial(self.told.update, text=_escaped(str(error)))
        else:
            show = functools.partial(self._show, found)
        document = self.told.document
        if document is not None:  # the page may have been closed
            document.add_next_tick_callback(show)
        return show.func == self._show

    def _save(self) -> None:
        path = self.of.save(self.values(), self.folder / "params.json")
        self.told.text = f"written: {_escaped(str(path))}, for --params"

    def _show(self, found: Outcome) -> None:
        """Give the figures their data, and the text its numbers."""
        errors = np.where(found.errors > 0, found.errors, np.nan)
        self._show_signals(found)
        if len(errors) == 1 < self.of.machines:
            nominal = np.where(errors[0] < TALLEST * errors[0, 0], errors[0], np.nan)
            self.errors.data = dict(self.errors.data) | {"nominal": nominal}
            self._tell(found)
            return
        low, high = np.quantile(errors, (0.05, 0.95), axis=0, method="inverted_cdf")
        finite = {
            "nominal": errors[0], "low": low, "high": high, "worst": np.max(errors, axis=0),
        }  # fmt: skip
        top = TALLEST * np.nanmax(
            np.where(np.isfinite(errors[:, 0]), errors[:, 0], np.nan), initial=0
        )
        shown = {n: np.where(np.isfinite(v) & (v < top), v, np.nan) for n, v in finite.items()}
        shown["high"] = np.fmin(np.where(np.isnan(high), top, high), top)
        self.errors.data = {"j": np.arange(1, errors.shape[1] + 1)} | shown
        self._tell(found)

    def _show_signals(self, found: Outcome) -> None:
        """The last trial of the nominal machine, and |Q (1 - L P)|."""
        every = max(len(found.y) // POINTS, 1)
        time = np.asarray(self.of.scenario.task.time)[::every]
        self.signals.data = {
            "t": time, "r": found.r[::every], "y": found.y[::every],
            "e": self.factor * found.e[::every],
        }  # fmt: skip
        self.size.data = {"f": found.f, "size": found.size[0], "worst": np.max(found.size, axis=0)}

    def _tell(self, found: Outcome) -> None:
        """The numbers, and the command line that leads to them."""
        last, worst = found.errors[0, -1], np.max(found.errors[:, -1])
        self._stand(found)
        largest = float(np.max(found.size)) if found.size.size else None
        size = [
            f"{x:.4g} {self.unit}".rstrip() if x < np.inf else "diverged" for x in (last, worst)
        ]
        said = [f"last trial: {size[0]}"]
        if len(found.errors) > 1:
            said[0] += f"; worst of {len(found.errors)}: {size[1]}"
        if largest is not None:
            safe = "monotone at all frequencies" if largest < 1 else "not safe"
            among = f" of {len(found.errors)} machines" if len(found.errors) > 1 else ""
            said.append(f"largest |Q (1 − L P)|{among}: {largest:.4g}, {safe}")
        self.told.text = "<br/>".join(map(_escaped, said))
        words = _escaped(self.of.command(self.values(), self.spread_asked())).split(" ")
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

    def _figures(self, first: Outcome) -> list[Any]:
        """The figures of errors by trial, of the last trial, and over frequency."""
        s = self.of.scenario
        word = s.judged_by.replace("_", " ")
        errors = plot("", "trial", f"{word} [{self.unit}]" if self.unit else word, height=260)
        errors.varea("j", "low", "high", source=self.errors, fill_alpha=0.2, color=COLOURS[0],
                     legend_label="5 to 95 % of the machines")  # fmt: skip
        errors.line("j", "nominal", source=self.errors, line_width=2, color=COLOURS[0],
                    legend_label="nominal machine")  # fmt: skip
        errors.line("j", "worst", source=self.errors, line_dash="dotted", color=COLOURS[1],
                    legend_label="worst machine")  # fmt: skip
        errors.legend.location, errors.legend.label_text_font_size = "top_right", "8pt"
        unit = s.task.unit
        output = f"output [{unit}]" if unit else "output"
        track = plot("last trial of the nominal machine", "", output, log=False, height=180)
        track.line("t", "r", source=self.signals, line_width=4, color="#999999")
        track.line("t", "y", source=self.signals, line_width=1.5, color=COLOURS[0])
        error = plot("", "time [s]", f"error [{self.unit_of_e}]" if self.unit_of_e else "error",
                     log=False, height=180, x_range=track.x_range)  # fmt: skip
        error.line("t", "e", source=self.signals, color=COLOURS[1])
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
) -> Any:
    """An application of Bokeh with sliders for the weights of a scheme.

    In a notebook, `bokeh.io.output_notebook(bokeh.resources.INLINE)` and
    `bokeh.io.show(explore(scenario), notebook_url="localhost:8888")` show it, with the address of
    the notebook as the browser has it: a page of another address gets nothing.

    scenario: what is simulated
    scheme: name of the scheme; None for the first one that learns
    folder: where a parameter file is saved
    options: further arguments of `Exploration`
    Returns a function of a document of Bokeh, which `bokeh.io.show` and servers take.
    """
    shared = Exploration(scenario, scheme, **options)
    for alone in (True, False):
        shared.outcome({}, alone=alone)  # compiled once, before anyone waits for it

    from bokeh.models import CustomJS

    def application(document: Any) -> None:
        document.title = f"jaxilc: {scenario.name}"
        document.add_root(Explorer(shared, Path(folder)).layout())
        document.js_on_event("document_ready", CustomJS(code=spoken()))

    return application


def _slider(control: Control) -> Any:
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
        title=title, start=low, end=high, value=value, step=(high - low) / 400,
        format=power if control.log else "0[.]000",
    )  # fmt: skip


def _held(value: float, low: float, high: float) -> float:
    """A value within its ends, which are not those of a slider: a browser may move them too."""
    return min(max(value, low), high) if math.isfinite(value) else low


def _escaped(text: str) -> str:
    from html import escape

    return escape(text)
