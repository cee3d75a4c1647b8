"""The interactive figures of searches and of published numbers show the numbers put in."""

import json
import shutil
import subprocess
import warnings
from types import SimpleNamespace

import numpy as np
import pytest
from bokeh.models import CustomJS, HoverTool
from browser import needs_chromium, opened
from made_datasets import run_of, sweep_of

from jaxilc.figures import browsers, certificate, searches
from jaxilc.figures.by_trial import band_together
from jaxilc.figures.description import Axis, Band, Curve, Panel
from jaxilc.figures.page import NUMBER, panel_of
from jaxilc.figures.page import live as page_of
from jaxilc.figures.report import html_report, write_report
from jaxilc.figures.style import COLOURS, luminance, readable
from jaxilc.sweeps.summary import summarise
from jaxilc.tuning.worst_case import Search, WorstCase, WorstMachine

DRAWN = np.array([3.0, 1.0, np.inf, 2.0])


def search(value, course, each):
    case = WorstCase({"plant.gain": 1.25}, None, 0.1, each * len(course), None, None)
    return Search(case, value, each, None, np.asarray(course, float))


def chance(worst, **of):
    """The drawn machines of a search beside those that it found, on a page."""
    values = {name: one.value for name, one in worst.searches.items()}
    machines = {name: one.case.values for name, one in worst.searches.items()}
    described = searches.worst_against_chance.described
    return page_of(
        described(worst.by_chance, values, nominal=worst.nominal, machines=machines, **of)
    )


def columns(live, *names):
    """The columns of all sources of a figure that have these names."""
    found = (r.data_source.data for r in live.model.renderers)
    return [tuple(np.asarray(d[n]) for n in names) for d in found if all(n in d for n in names)]


def test_the_worst_machine_stands_beside_those_drawn():
    found = {"gradient": search(4.0, [1.0, 4.0, 4.0], 8), "chance": search(3.0, [3.0] * 24, 1)}
    of = {"metric": "rms", "unit": "mm"}
    lines = columns(chance(WorstMachine(1.5, found, DRAWN), **of), "x")
    np.testing.assert_allclose(lines[0][0], [1.0, 2.0, 3.0])
    assert [x[0] for (x,) in lines if len(x) == 1] == [1.5, 4.0, 3.0]
    shares = columns(chance(WorstMachine(1.5, found, DRAWN), **of), "x", "y")
    np.testing.assert_allclose(shares[0], [[1.0, 2.0, 3.0], [25.0, 50.0, 75.0]])  # of four
    described = searches.worst_against_chance.described
    for all_of, said in ((DRAWN, ""), ([*DRAWN, np.nan, np.nan], ", 2 without a number")):
        (panel,) = described(all_of, {}, nominal=np.nan).panels
        drawn, nominal = (layer.name for layer in (panel.layers[0], panel.layers[-1]))
        assert drawn == f"{len(all_of)} machines drawn, 1 diverged{said}: share that errs less"
        assert nominal == "nominal machine: without a number"
    steps = columns(page_of(searches.worst_by_effort.described(found, **of)), "x", "y")
    np.testing.assert_allclose(steps[0], [[8, 16, 24], [1.0, 4.0, 4.0]])
    np.testing.assert_allclose(steps[2], [[1, 24], [3.0, 3.0]])


def test_a_machine_that_diverged_has_its_place_in_the_legend():
    worst = WorstMachine(np.inf, {"gradient": search(np.inf, [1.0, np.inf], 8)}, DRAWN)
    said = [item.label.value for item in chance(worst).model.legend[0].items]
    assert said[1:] == ["nominal machine: diverged", "gradient: diverged"]
    ax = searches.worst_against_chance(DRAWN, {"gradient": np.inf}, nominal=1.5)
    on_paper = [text.get_text() for text in ax.get_legend().get_texts()]
    assert on_paper[1:] == ["nominal machine: 1.5", "gradient: diverged"]


@pytest.mark.thorough
@pytest.mark.parametrize("inputs", [1, 2, 3])
def test_each_output_of_a_trial_has_its_own_input(inputs):
    """Of as many inputs as outputs the output's own is shown, of others a menu chooses."""
    u = np.random.default_rng(0).normal(size=(2, 3, 40, inputs))
    within = browsers.trials(run_of(np.ones((2, 3, 41, 2)), None, u, schemes=("a", "b"))).model
    (react,) = within.select({"type": CustomJS})
    for k, j, c in np.ndindex(2, 3, inputs):
        kept = react.args["all"].data[f"u_{k}_{j}_{c}"]
        np.testing.assert_allclose(kept, [*u[k, j, :, c], u[k, j, -1, c]], rtol=1e-6)
    _, *menus = within.children[0].children
    assert [menu.title for menu in menus] == ["scheme", "output"] + ["input"] * (inputs == 3)
    chosen_by, names = react.args["input"], react.args["inputs"]
    assert (chosen_by is react.args["output"]) == (inputs == 2)
    assert chosen_by.options == names
    assert len(names) == inputs


def test_what_is_not_finite_makes_no_page_fail():
    lost = WorstMachine(np.inf, {"gradient": search(np.inf, [np.inf], 4)}, np.array([np.inf]))
    row = {"first": np.nan, "second": np.inf, "weights": {"a": 1.0}}
    live = [
        chance(lost, metric="rms"),
        page_of(searches.worst_by_effort.described(lost.searches, metric="rms")),
        front_of({"given": row, "0.5": row}),
        page_of(
            searches.final_error_by_trials.described(
                [3], [[0.0, np.nan]], [[0.0, np.inf]], metric="rms", weights={"a": [1.0]}
            )
        ),
        browsers.papers([published("a", np.inf)]),
    ]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert len(html_report("t", {}, live=live)) < 5_000_000


def front_of(rows):
    """The front of two objectives on a page, from the numbers of its points."""
    points = [
        SimpleNamespace(share=float(share), **row)
        for share, row in rows.items()
        if share != "given"
    ]
    weights = {None if s == "given" else float(s): row["weights"] for s, row in rows.items()}
    given = (rows["given"]["first"], rows["given"]["second"])
    of = {"first": "final", "second": "effort", "given": given, "weights": weights}
    return page_of(searches.pareto_front.described(points, **of))


def published(scenario, ratio, **changed):
    return {
        "scenario": scenario, "scheme": "p-type", "trial": 5, "quantity": "rms", "unit": "mm",
        "options": {}, "value": 2.0, "ours": 2.0 * ratio, "ratio": ratio, "verdict": "met",
        "at_most": False, "source": "Table 1", "reading": "as printed", "reason": "",
    } | changed  # fmt: skip


def test_a_front_has_its_weights_under_the_pointer():
    rows = {"given": {"first": 3.0, "second": 3.0, "weights": {"lam": 1.0, "eta": 0.9}}}
    rows |= {
        str(share): {"first": 1 + share, "second": 2 - share, "weights": {"lam": share, "eta": 0.5}}
        for share in (0.9, 0.1)
    }
    front = front_of(rows)
    tuned, _, given = columns(front, "x", "t0", "t1")
    np.testing.assert_allclose(tuned, [[1.1, 1.9], [0.1, 0.9], [0.1, 0.9]])
    np.testing.assert_allclose(given, [[3.0], [1.0], [0.9]])


def test_a_machine_has_its_claim_and_its_parameters_under_the_pointer():
    simulated = np.array([[3.0, 1.0], [2.0, np.inf], [1.0, 0.5]])
    found = SimpleNamespace(claim=np.array(["monotone", "diverges", "monotone"]),
                            predicted=simulated, simulated=simulated)  # fmt: skip
    described = certificate.described(found, unit="mm", parameters={"gain": np.arange(3.0)})
    live = page_of(described)
    assert page_of(live) is live
    errors, claims = live.model.children
    lines = [r.data_source.data for r in errors.renderers if "xs" in r.data_source.data]
    assert [of["t0"].tolist() for of in lines] == [[0, 2], [1]]  # machines
    assert [of["t1"].tolist() for of in lines] == [[0.0, 2.0], [1.0]]  # their gains
    np.testing.assert_allclose(lines[1]["ys"][0], [2.0, np.nan])
    assert claims.renderers[0].data_source.data["right"] == [2, 1]


def test_the_worst_machine_has_its_unit_under_the_pointer():
    """The axis is in nm, the numbers in mm: the text has a unit of its own."""
    errors = np.array([[[5e-5, 2e-5], [8e-5, 3e-5], [6e-4, np.inf]]])
    rows = summarise(sweep_of(errors), None, metric="rms")
    live = page_of(band_together(rows, metric="rms", unit="mm"))
    y, worst = columns(live, "y", "t0")[0]
    assert live.model.yaxis[0].axis_label == "rms [nm]"
    np.testing.assert_allclose(y, [80.0, 30.0])
    assert worst.tolist() == ["600 nm", "diverged"]
    tools = live.model.select({"type": HoverTool})
    assert sum("worst:</span> @t0</div>" in tool.tooltips for tool in tools) == 1


def test_a_band_ends_where_there_is_none_and_reaches_down_to_zero():
    """Of five points the third has no end, and the fourth begins at zero, below a log axis."""
    low, high = [1.0, 2.0, np.nan, 0.0, 1.0], [3.0, 4.0, 5.0, 50.0, 2.0]
    for log, end in ((False, 0.0), (True, 1.0 / 1.5)):
        panel = Panel(Axis("x"), Axis("y", log=log), [Band([1, 2, 3, 4, 5], low, high, name="b")])
        made = panel_of(panel)
        one, other = (r.data_source.data for r in made.renderers)
        assert [one["x"].tolist(), other["x"].tolist()] == [[1, 2], [4, 5]]
        assert [one["y1"].tolist(), one["y2"].tolist()] == [[1, 2], [3, 4]]
        assert other["y2"].tolist() == [50, 2]
        assert other["y1"][0] == 0 if not log else 0 < other["y1"][0] < end
        assert other["y1"][1] == 1
        assert len(made.legend[0].items) == 1  # a click hides both
    made = panel_of(Panel(Axis("x"), Axis("y", log=True), [Band([1, 2], [0, 0], [0, 0])]))
    assert [r.data_source.data["x"].size for r in made.renderers] == [0]


def test_a_single_trial_has_its_points_and_its_band():
    """A line through the points of several machines would connect them at the same trial."""
    lines = Curve([1], np.array([[2.0], [3.0]]), tips={"machine": [0, 1]})
    made = panel_of(Panel(Axis("trial"), Axis("error"), [lines, Band([1], [2.0], [4.0])]))
    points, bar = made.renderers
    assert (points.glyph.__view_model__, bar.glyph.__view_model__) == ("Scatter", "Segment")
    assert points.data_source.data["y"].tolist() == [2.0, 3.0]
    assert [bar.data_source.data[of].tolist() for of in ("y0", "y1")] == [[2.0], [4.0]]


def test_a_machine_has_its_own_error_under_the_pointer():
    """Those that diverge stand above all others, and one without an error far below them."""
    last = np.array([[2.0, 0.0, np.inf, 4.0], [np.inf, 8.0, 6.0, np.inf]])
    seen = browsers.machines(
        sweep_of(last[..., None], ("a", "b")), {"gain": np.arange(4.0)}, metric="rms", unit="mm"
    ).model
    (react,) = seen.select({"type": CustomJS})
    shown = react.args["shown"].data
    assert shown["told"] == shown["t0"] == ["2 mm", "0 mm", "diverged", "4 mm"]
    assert shown["t1"] == ["diverged", "8 mm", "6 mm", "diverged"]
    assert shown["y"][2] > 4
    assert 'data["told"] = all.data["t" + k];' in react.code
    (tool,) = seen.select({"type": HoverTool})
    assert "rms of the last trial:</span> @told</div>" in tool.tooltips


@pytest.mark.parametrize("machines", [11, 12])
def test_of_few_machines_no_bar_says_that_a_parameter_explains_nothing(machines):
    gain = np.arange(1.0, machines + 1)
    seen = browsers.machines(sweep_of([gain[:, None]]), {"gain": gain}, metric="rms")
    *_, drawn = seen.model.children
    assert len(drawn.children) == (1 if machines < 12 else 2)
    assert ("Of fewer than 12 machines it cannot be said" in seen.caption) == (machines < 12)
    assert ("The bars say" in seen.caption) == (machines == 12)


@pytest.mark.skipif(shutil.which("node") is None, reason="needs node, which runs scripts of pages")
@pytest.mark.parametrize(
    ("ticks", "shown"),
    [
        ([1e-17, 1e-15, 1e-13], ["1e-17", "1e-15", "1e-13"]),  # errors down to rounding
        ([-2e-17, 0.0, 2e-17], ["-2e-17", "0", "2e-17"]),
        ([-0.1, 5.6e-17, 0.1], ["-0.1", "0", "0.1"]),  # rounded while ticks are counted
        ([1e-9, 1.0, 1e9], ["1e-9", "1", "1e+9"]),
        ([0.0], ["0"]),
        ([1e-16], ["1e-16"]),
    ],
)
def test_a_tick_is_0_only_where_it_is_that_beside_the_others(ticks, shown):
    of_each = f"new Function('tick', 'ticks', {json.dumps(NUMBER)})"
    program = f"console.log(JSON.stringify({ticks}.map((x) => {of_each}(x, {ticks}))))"
    said = subprocess.run(["node", "-e", program], check=True, capture_output=True, text=True)
    assert json.loads(said.stdout) == shown


def test_a_unit_is_no_markup_under_the_pointer():
    curve = Curve([1.0, 2.0], [1.0, 2.0], name="a")
    made = panel_of(Panel(Axis("x_1", "<b>@y"), Axis("y", "mm"), [curve]))
    (tool,) = made.select({"type": HoverTool})
    assert "x 1:</span> @x{%.4g} &lt;b&gt;&#64;y</div>" in tool.tooltips
    assert "y:</span> @y{%.4g} mm</div>" in tool.tooltips


def test_text_can_be_read_on_its_ground():
    """Contrasts by the formula of WCAG 2.2; black on white has 21."""
    assert luminance("white") == pytest.approx(1.0)
    assert luminance("#777777") == pytest.approx((1.05 / 4.478) - 0.05, rel=1e-3)
    for colour in COLOURS:
        assert 1.05 / (luminance(readable(colour)) + 0.05) >= 4.5
        dark = luminance("#14171c") + 0.05
        assert (luminance(readable(colour, "#14171c")) + 0.05) / dark >= 4.5


@needs_chromium
def test_a_reader_chooses_a_paper(tmp_path):
    """The menu is moved in a browser; the rows of the other paper are then shown."""
    rows = [published("a", 1.1), published("b", 0.5), published("b", 40.0, verdict="open")]
    live = [browsers.papers(rows)]
    page = write_report(tmp_path / "page.html", "t", {}, live=live)
    said = opened(
        page,
        tmp_path,
        """
        const all = Bokeh.documents.flatMap((d) => [...d._all_models.values()]);
        const menu = all.find((m) => m.type === "Select");
        const seen = () => all.filter((m) => m.type === "Row").map((m) => m.visible);
        const before = seen();
        menu.value = "b";
        await new Promise((resolve) => setTimeout(resolve, 500));
        return {before, after: seen()};
        """,
    )
    assert isinstance(said, dict), said
    assert (said["before"], said["after"]) == ([True, False], [False, True])
    second = live[0].model.children[2].children[1]
    drawn = [r.data_source.data for r in second.renderers if "t0" in r.data_source.data]
    assert [[*of["x"]] for of in drawn] == [[0.5], [10.0]]
    assert [of["t3"].tolist() for of in drawn] == [["0.5"], ["40"]]
