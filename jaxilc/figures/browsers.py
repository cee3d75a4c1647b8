"""Interactive figures with a choice: a trial by a slider, a machine by its parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import groupby
from typing import TYPE_CHECKING

import numpy as np

from .description import tips_of
from .page import Live, hover, model_of, plot, shown_in, side_by_side, thinned
from .published import numbers_of_paper
from .style import COLOURS, PALE, labelled, names_of
from .within_trial import outputs_of

if TYPE_CHECKING:
    import xarray as xr
    from bokeh.models import ColumnDataSource
    from bokeh.plotting import figure as Plot
    from numpy.typing import ArrayLike

    from ..pytree.aliases import Value
    from ..signals.task import Task

ROOM = 200_000  # numbers that the signals of all trials may have on a page
TRIALS = 25  # trials that can be chosen at most
POINTS = 100, 600  # of a signal, the fewest and the most
BARS = (
    "The bars say how much of the spread of the errors (of their ranks) each parameter explains "
    "alone; what is missing to 100 % comes from several together, or noise."
)
FEW = "Of fewer than {} machines it cannot be said which parameter explains the spread."

CHOOSE = """
const k = schemes.indexOf(scheme.value), c = outputs.indexOf(output.value), j = slider.value;
const key = [k, j, c].join("_"), of_u = [k, j, inputs.indexOf(input.value)].join("_");
shown.data = {t: all.data["t"], r: all.data["r_" + c] ?? all.data["r_" + [j, c].join("_")],
              y: all.data["y_" + key], e: all.data["e_" + key],
              u: all.data["u_" + of_u]};
told.text = scheme.value + ", trial " + trials[j];
"""
PARAMETER = """
const k = schemes.indexOf(scheme.value), p = names.indexOf(parameter.value);
const data = Object.assign({}, shown.data);
data["x"] = all.data["p" + p];
data["y"] = all.data["e" + k];
data["colour"] = all.data["c" + k];
data["told"] = all.data["t" + k];
shown.data = data;
axis.axis_label = parameter.value;
told.text = scheme.value;
bars.data = {name: bars.data["name"], share: shares.data["s" + k]};
"""


PAPER = "figures.forEach((one, i) => { one.visible = names[i] === select.value; });"


def trials(dataset: xr.Dataset, *, scale: float = 1.0, unit: str = "") -> Live:
    """Output, error and input of a trial that a slider chooses, of a scheme and an output.

    Of as many inputs as outputs the one of the same number is shown, of others a menu chooses.
    """
    from bokeh.layouts import column
    from bokeh.models import ColumnDataSource, CustomJS, CustomJSTickFormatter, Div, Select, Slider

    schemes, count = names_of(dataset), dataset.sizes["trial"]
    outputs, inputs = outputs_of(dataset), [f"input {i}" for i in range(dataset["u"].shape[-1])]
    chosen = np.arange(count)
    of_a_trial = len(schemes) * (2 * len(outputs) + len(inputs))
    of_a_trial += len(outputs) * (dataset["r"].ndim > 2)
    most = int(np.clip(ROOM // (POINTS[0] * of_a_trial), 1, TRIALS))
    if count > most:
        chosen = np.unique(np.round(np.geomspace(count, 1, most)).astype(int)) - 1
    points = int(np.clip(ROOM // (len(chosen) * of_a_trial), *POINTS))
    last = np.fmax.reduce(np.abs(dataset["e"].isel(trial=-1).values), axis=None)
    factor, unit = shown_in(scale * last, unit)
    columns = {"t": thinned(dataset["time"].values, points, times=True)}
    r = dataset["r"].values
    for c in range(len(outputs)):
        of_trials = {f"r_{i}_{c}": r[j, :, c] for i, j in enumerate(chosen)} if r.ndim > 2 else {}
        for name, values in (of_trials or {f"r_{c}": r[:, c]}).items():
            columns[name] = thinned(values, points)
    for name, times in (("y", 1.0), ("e", factor * scale), ("u", 1.0)):
        values = dataset[name].values
        for k, i, c in np.ndindex(len(schemes), len(chosen), values.shape[-1]):
            x = times * values[k, chosen[i], :, c]
            held = np.append(x, x[-1]) if name == "u" else x  # up to the end of the trial
            columns[f"{name}_{k}_{i}_{c}"] = thinned(held, points)
    last = len(chosen) - 1
    every = ColumnDataSource(columns)
    of_r = "r_0" if r.ndim == 2 else f"r_{last}_0"
    begin = {"t": "t", "r": of_r, "y": f"y_0_{last}_0", "e": f"e_0_{last}_0", "u": f"u_0_{last}_0"}
    shown = ColumnDataSource({name: columns[of] for name, of in begin.items()})
    numbers = dataset["trial"].values[chosen].tolist()
    of_trial = CustomJSTickFormatter(args={"trials": numbers}, code="return String(trials[tick])")
    slider = Slider(start=0, end=max(last, 1), value=last, step=1, title="trial", format=of_trial)
    slider.disabled = last == 0
    scheme = Select(title="scheme", value=schemes[0], options=[*schemes], width=220)
    output = Select(title="output", value=outputs[0], options=[*outputs], width=160)
    menus, both = [scheme, output], ""
    if len(inputs) == len(outputs):
        of_u, inputs = output, outputs
        both = " The input is the one with the number of the output." * (len(inputs) > 1)
    else:
        of_u = Select(title="input", value=inputs[0], options=[*inputs], width=160)
        menus.append(of_u)
    told = Div(text=f"{schemes[0]}, trial {numbers[-1]}", styles={"font-weight": "600"})
    drawn = _three(dataset, shown, unit)
    react = CustomJS(
        args={
            "all": every, "shown": shown, "slider": slider, "scheme": scheme, "output": output,
            "schemes": schemes, "outputs": outputs, "trials": numbers, "told": told,
            "input": of_u, "inputs": inputs,
        },
        code=CHOOSE,
    )  # fmt: skip
    for widget in (slider, *menus):
        widget.js_on_change("value", react)
    some = [menu for menu in menus if len(menu.options) > 1]
    layout = column(side_by_side(slider, *some), told, *drawn, sizing_mode="stretch_width")
    which = "each trial" if len(chosen) == count else f"{len(chosen)} of the {count} trials"
    return Live(
        f"Output, error and input within a trial. The slider goes through {which}; the axes of the "
        f"three figures move together.{both}",
        layout,
    )


def measured_trials(task: Task, measured: Mapping[int, Mapping[str, np.ndarray]]) -> Live:
    """The same of measured trials: y (N+1, n_y) and u (N, n_u) by the number of the trial."""
    import xarray as xr

    r = np.asarray(task.reference, float).reshape(len(np.asarray(task.time)), -1)
    y, u = (
        np.stack([np.asarray(of[n], float).reshape(len(of[n]), -1) for of in measured.values()])
        for n in ("y", "u")
    )
    dims = ("scheme", "trial", "time", "channel")
    dataset = xr.Dataset(
        {
            "r": (dims[2:], r),
            "y": (dims, y[None], {"units": task.unit}),
            "e": (dims, r - y[None], {"units": task.unit}),
            "u": (("scheme", "trial", "input_time", "input"), u[None], {"units": task.input_unit}),
        },
        coords={"scheme": ["measured"], "trial": list(measured), "time": np.asarray(task.time)},
    )
    return trials(dataset, unit=task.unit)


def _three(dataset: xr.Dataset, shown: ColumnDataSource, unit: str) -> list[Plot]:
    """Figures of output, error and input against time, over the same source."""
    of_y, of_u = (dataset[n].attrs.get("units", "") for n in ("y", "u"))
    made: list[Plot] = []
    for name, label, lines in (
        ("output", of_y, (("r", PALE, 4), ("y", COLOURS[0], 1.5))),
        ("error", unit, (("e", COLOURS[1], 1.5),)),
        ("input", of_u, (("u", COLOURS[2], 1.5),)),
    ):
        time = "time [s]" if name == "input" else ""
        share = {"x_range": made[0].x_range} if made else {}
        one = plot("", time, labelled(name, label), log=False, height=200, **share)
        for of, colour, width in lines:
            said = {"r": "reference", "y": "output"}.get(of)
            named = {"legend_label": said} if said else {}
            one.line("t", of, source=shown, line_width=width, color=colour, **named)
        made.append(one)
    return made


def machines(
    dataset: xr.Dataset,
    drawn: Mapping[str, ArrayLike],
    *,
    metric: str,
    tolerance: float | None = None,
    scale: float = 1.0,
    unit: str = "",
) -> Live | None:
    """The last error of each machine against a parameter, and what each parameter explains.

    drawn: (S,) values of the uncertain parameters, by path; None is returned where none varies
    tolerance: largest error that passes [unit of the dataset]
    """
    from bokeh.layouts import column
    from bokeh.models import ColumnDataSource, CustomJS, Div, FactorRange, Select

    from ..sweeps.summary import FEWEST, errors_by_scheme, explained_shares, learned_errors

    columns = tips_of(drawn)
    if not columns:
        return None
    by_scheme = errors_by_scheme(dataset, metric)
    last = scale * np.array([learned_errors(of)[:, -1] for of in by_scheme])
    factor, unit = shown_in(last, unit)
    last, limit = factor * last, None if tolerance is None else scale * factor * tolerance
    schemes, names = names_of(dataset), list(columns)
    shares = [explained_shares(columns, of) for of in last]
    best = int(np.argmin(np.median(last, axis=1)))
    first = max(range(len(names)), key=lambda i: shares[best][names[i]])
    known: dict[str, np.ndarray | list[str]] = {
        f"p{i}": values for i, values in enumerate(columns.values())
    }
    for k, errors in enumerate(last):
        known[f"e{k}"], known[f"c{k}"] = _drawn_errors(errors, limit)
        known[f"t{k}"] = [
            f"{x:.4g} {unit}".rstrip() if np.isfinite(x) else "diverged" for x in errors
        ]
    every = ColumnDataSource(known)
    shown = ColumnDataSource(
        known | {"x": known[f"p{first}"], "y": known[f"e{best}"], "colour": known[f"c{best}"],
                 "told": known[f"t{best}"], "machine": np.arange(last.shape[1])}
    )  # fmt: skip
    word = f"{metric.replace('_', ' ')} of the last trial"
    made = plot("", names[first], labelled(word, unit), width=560)
    dots = made.scatter("x", "y", source=shown, color="colour", size=6, alpha=0.7)
    tips = [("machine", "@machine"), (word, "@told")]
    hover(made, [dots], tips + [(name, f"@p{i}{{g}}") for i, name in enumerate(columns)])
    if limit is not None:
        made.hspan(y=[limit], line_dash="dashed", line_color="black")
    ordered = sorted(names, key=lambda name: shares[best][name])
    bars = ColumnDataSource({"name": ordered, "share": [100 * shares[best][n] for n in ordered]})
    by_scheme = ColumnDataSource(
        {f"s{k}": [100 * of[n] for n in ordered] for k, of in enumerate(shares)}
    )
    beside = plot(
        "share of the spread that it explains", "[%]", "", log=False, width=300,
        y_range=FactorRange(factors=ordered), x_range=(0, 100),
    )  # fmt: skip
    thick = min(0.7, 0.12 * len(names))
    beside.hbar(y="name", right="share", height=thick, source=bars, color="#0072b2")
    scheme = Select(title="scheme", value=schemes[best], options=[*schemes], width=220)
    parameter = Select(title="parameter", value=names[first], options=[*names], width=260)
    told = Div(text=schemes[best], styles={"font-weight": "600"})
    react = CustomJS(
        args={
            "all": every, "shown": shown, "scheme": scheme, "parameter": parameter,
            "schemes": schemes, "names": names, "axis": made.xaxis[0], "told": told,
            "bars": bars, "shares": by_scheme,
        },
        code=PARAMETER,
    )  # fmt: skip
    for widget in (scheme, parameter):
        widget.js_on_change("value", react)
    few = last.shape[1] < FEWEST
    layout = column(
        side_by_side(scheme, parameter), told, side_by_side(made, *([] if few else [beside])),
        sizing_mode="stretch_width",
    )  # fmt: skip
    return Live(
        "Each dot is a machine: its last error against the chosen parameter. Orange dots are "
        "beyond the tolerance; black ones, at the top, diverged. Under the pointer stand all of "
        f"its parameters. {FEW.format(FEWEST) if few else BARS}",
        layout,
    )


def _drawn_errors(errors: np.ndarray, limit: float | None) -> tuple[np.ndarray, list[str]]:
    """Heights and colours of machines; those that diverged stand above all others."""
    finite = np.isfinite(errors)
    top = 3 * np.max(errors, where=finite, initial=0.0) or 1.0
    heights = np.where(finite, np.maximum(errors, 1e-12 * top), top)
    colours = np.where(heights <= (np.inf if limit is None else limit), "#0072b2", "#d55e00")
    return heights, np.where(finite, colours, "#000000").tolist()


def papers(numbers: Sequence[Mapping[str, Value]]) -> Live:
    """The printed numbers and ours; a menu chooses the paper."""
    from bokeh.layouts import column
    from bokeh.models import CustomJS, Select

    groups = groupby(numbers, lambda row: str(row["scenario"]))
    found = {name: numbers_of_paper(list(rows)) for name, rows in groups}
    shown = {name: model_of(figure) for name, figure in found.items()}
    first, *others = shown
    caption = found[first].caption
    if not others:
        return Live(caption, shown[first])
    for name in others:
        shown[name].visible = False
    select = Select(title="paper", value=first, options=[*shown], width=220)
    args = {"select": select, "names": [*shown], "figures": [*shown.values()]}
    select.js_on_change("value", CustomJS(args=args, code=PAPER))
    layout = column(select, *shown.values(), sizing_mode="stretch_width")
    return Live(f"{caption} The menu chooses the paper.", layout)
