"""The interactive figures of searches and of published numbers show the numbers put in."""

import warnings

import numpy as np
import pytest
from browser import needs_chromium, opened

from jaxilc.figures import live_published, live_searches
from jaxilc.figures.report import html_report, write_report
from jaxilc.figures.style import COLOURS, luminance, readable
from jaxilc.tuning.worst_case import WorstCase
from jaxilc.tuning.worst_machine import Search, WorstMachine

DRAWN = np.array([3.0, 1.0, np.inf, 2.0])


def search(value, course, each):
    case = WorstCase({"plant.gain": 1.25}, None, 0.1, each * len(course), None, None)
    return Search(case, value, each, None, np.asarray(course, float))


def columns(live, *names):
    """The columns of all sources of a figure that have these names."""
    found = (r.data_source.data for r in live.model.renderers)
    return [tuple(np.asarray(d[n]) for n in names) for d in found if all(n in d for n in names)]


def test_the_worst_machine_stands_beside_those_drawn():
    searches = {"gradient": search(4.0, [1.0, 4.0, 4.0], 8), "chance": search(3.0, [3.0] * 24, 1)}
    worst = WorstMachine(1.5, searches, DRAWN)
    shares = columns(live_searches.chance(worst, metric="rms", unit="mm"), "x", "y")
    np.testing.assert_allclose(shares[0], [[1.0, 2.0, 3.0], [25.0, 50.0, 75.0]])  # of four
    assert [x[0] for x, y in shares if len(x) == 1] == [1.5, 4.0, 3.0]
    steps = columns(live_searches.climbing(worst, metric="rms", unit="mm"), "x", "y")
    np.testing.assert_allclose(steps[0], [[8, 16, 24], [1.0, 4.0, 4.0]])
    np.testing.assert_allclose(steps[2], [[1, 24], [3.0, 3.0]])


def test_what_is_not_finite_makes_no_page_fail():
    lost = WorstMachine(np.inf, {"gradient": search(np.inf, [np.inf], 4)}, np.array([np.inf]))
    row = {"first": np.nan, "second": np.inf, "weights": {"a": 1.0}}
    quantiles = {"median": 0.0, "high": np.inf, "worst": np.nan}
    budgets = {"3": {"given": quantiles, "tuned": quantiles, "weights": {"a": 1.0}}}
    live = [
        live_searches.chance(lost, metric="rms"),
        live_searches.climbing(lost, metric="rms"),
        live_searches.front({"given": row, "0.5": row}, first="final", second="effort"),
        live_searches.budgets(budgets, metric="rms", unit="mm"),
        live_published.printed_and_ours([published("a", np.inf)]),
    ]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert len(html_report("t", {}, live=live)) < 5_000_000


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
    found = columns(live_searches.front(rows, first="final", second="effort"), "name", "w0", "x")
    assert [f[0].tolist() for f in found] == [["0.1", "0.9"], ["given"]]
    np.testing.assert_allclose(found[0][1:], [[0.1, 0.9], [1.1, 1.9]])


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
    live = [live_published.printed_and_ours(rows)]
    page = write_report(tmp_path / "page.html", "t", {}, live=live)
    said = opened(
        page,
        tmp_path,
        """
        const all = Bokeh.documents.flatMap((d) => [...d._all_models.values()]);
        const menu = all.find((m) => m.type === "Select");
        const shown = all.find((m) => m.type === "ColumnDataSource" && !("paper" in m.data));
        const before = [...shown.data.exact];
        menu.value = "b";
        await new Promise((resolve) => setTimeout(resolve, 500));
        const rows = all.find((m) => m.type === "FactorRange");
        return {before, after: [...shown.data.exact], drawn: [...shown.data.ratio],
                factors: [...rows.factors]};
        """,
    )
    assert isinstance(said, dict), said
    assert (said["before"], said["after"], said["drawn"]) == ([1.1], [0.5, 40.0], [0.5, 10.0])
    name = "p-type, trial 5, rms [mm]"
    assert said["factors"] == [f"{name} #2", name]
