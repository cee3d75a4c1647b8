"""The HTML report is parsed with the standard library and shown in a browser.

Its numbers and pictures are compared with what was put in.
"""

import base64
import dataclasses
import http.server
import io
import struct
import sys
import threading
import xml.etree.ElementTree as ET
from html.parser import HTMLParser

import numpy as np
import pytest
import xarray as xr
from browser import needs_chromium, opened, photographed
from made_datasets import run_of, sweep_of
from matplotlib.figure import Figure
from rich.table import Table

from jaxilc import learn, scenarios
from jaxilc.figures import browsers
from jaxilc.figures.by_trial import band_together, error_by_trial
from jaxilc.figures.page import live as page_of
from jaxilc.figures.report import LIVE_POLICY, POLICY, command_report, html_report, write_report
from jaxilc.outcomes.outcome import Verdict
from jaxilc.outcomes.running import run_numbers, run_table
from jaxilc.sweeps import runs
from jaxilc.sweeps.summary import summarise

NASTY = "<script>alert('1')</script> & \"quotes\" \x1b[31mred\x1b[0m ]]> <!-- µm"
VOID = {"meta", "img"}
REFERRING = {"src", "href", "data", "action", "poster", "srcset", "background", "xlink:href"}


class Page(HTMLParser):
    """The elements and the references of a page, and whether each is closed in order."""

    def __init__(self, text):
        super().__init__()
        self.open, self.tags, self.references, self.balanced = [], [], [], True
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attributes):
        self.tags.append(tag)
        self.references += [value for name, value in attributes if name in REFERRING]
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.handle_starttag(tag, attributes)
        if tag not in VOID:
            self.open.pop()

    def handle_endtag(self, tag):
        self.balanced &= bool(self.open) and self.open.pop() == tag


def parsed(text):
    """Return the tree of the page, after the checks that every page must pass."""
    page = Page(text)
    assert page.balanced
    assert not page.open
    assert not {"script", "link", "iframe", "object", "embed", "base"} & set(page.tags)
    assert all(value.startswith("data:image/") for value in page.references)
    tree = ET.fromstring(text.removeprefix("<!DOCTYPE html>"))
    style = tree.find("head/style").text
    assert "url(" not in style
    assert "@import" not in style
    return tree


def cells(table):
    """Return headers and rows of a table element, as text."""
    head = [c.text or "" for c in table.findall("thead/tr/th")]
    return head, [[c.text or "" for c in row] for row in table.findall("tbody/tr")]


def picture(image):
    """Return the media type and the bytes of an embedded figure."""
    kind, data = image.get("src").removeprefix("data:").split(";base64,")
    return kind, base64.b64decode(data, validate=True)


def drawn_axes():
    ax = Figure(figsize=(2.0, 1.0), dpi=50).subplots()
    ax.plot([0, 1], [0, 1])
    ax.set_title("error by trial")
    return ax


def table_of(tree, caption):
    return next(t for t in tree.iter("table") if (t.findtext("caption") or "") == caption)


def test_page_is_well_formed_and_escaped():
    rows = (NASTY, [{NASTY: NASTY, "value": 1.5}])
    configuration, notes = {NASTY: [NASTY, 1.5]}, {NASTY: [NASTY]}
    tree = parsed(
        html_report(NASTY, {NASTY: NASTY}, [rows], [(NASTY, drawn_axes())], configuration, notes)
    )
    shown = NASTY.replace("\x1b", "\ufffd")
    assert tree.findtext("head/title") == tree.findtext("body/h1") == shown
    assert table_of(tree, shown) is not None
    assert [i.get("alt") for i in tree.iter("img")] == [shown]
    assert tree.findtext(".//figcaption") == tree.findtext(".//li") == shown
    settings = {row[0].text: row[1].text for row in tree.find(".//details").iter("tr")}
    assert settings == {shown: f"{shown}, 1.5"}


def test_what_stands_between_backticks_in_a_sentence_is_code():
    said = Verdict(("`a < b` holds", "one ` alone"))
    tree = parsed(html_report("t", {}, notes={"Chosen": ["it is the option `plant=exact`"]},
                              verdict=said))  # fmt: skip
    assert [code.text for code in tree.iter("code")] == ["a < b", "plant=exact"]
    assert "".join(tree.itertext()).count("`") == 1


def test_rows_hold_the_numbers():
    rows = [
        {"name": "a", "x": 1.25e-7, "n": 3},
        {"name": "b", "x": float("nan"), "n": np.int64(-4), "late": np.float64(1 / 3)},
    ]
    tree = parsed(html_report("t", {}, [("numbers", rows)]))
    table = table_of(tree, "numbers")
    head, body = cells(table)
    assert head == ["name", "x", "n", "late"]
    assert [row[0] for row in body] == ["a", "b"]
    assert float(body[0][1]) == 1.25e-7
    assert np.isnan(float(body[1][1]))
    assert [int(row[2]) for row in body] == [3, -4]
    assert body[0][3] == ""
    assert abs(float(body[1][3]) - 1 / 3) < 1e-6
    assert [c.get("class") for c in table.find("thead/tr")] == [None, "n", "n", "n"]


def test_brackets_of_a_rich_table_are_units_not_markup():
    table = Table("median [mm]", "escaped \\[mm]", title="error [nm] by trial")
    table.add_column("n", justify="right")
    table.add_row("[1, 2]", "a", "7")
    found = table_of(parsed(html_report("t", {}, [table])), "error [nm] by trial")
    assert cells(found) == (["median [mm]", "escaped [mm]", "n"], [["[1, 2]", "a", "7"]])


def test_every_figure_is_embedded(tmp_path):
    ax = drawn_axes()
    ax.figure.savefig(tmp_path / "error-band.png")
    ax.figure.savefig(tmp_path / "second.svg")
    pair = Figure().subplots(2, 1)
    figures = [tmp_path / "error-band.png", ("a caption", str(tmp_path / "second.svg")), ax, pair]
    tree = parsed(html_report("t", {}, figures=figures))
    pictures = [picture(image) for image in tree.iter("img")]
    assert [kind for kind, _ in pictures] == [
        "image/png", "image/svg+xml", "image/png", "image/png",
    ]  # fmt: skip
    assert pictures[0][1] == (tmp_path / "error-band.png").read_bytes()
    assert pictures[1][1] == (tmp_path / "second.svg").read_bytes()
    # The header of a PNG file holds its size: 2 in by 1 in at 120 dots per inch.
    assert struct.unpack(">II", pictures[2][1][16:24]) == (240, 120)
    assert [f.text for f in tree.iter("figcaption")] == [
        "error band", "a caption", "error by trial", None,
    ]  # fmt: skip


def test_figures_that_cannot_be_embedded_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"figure .*a\.pdf is not one of \.png, \.svg"):
        html_report("t", {}, figures=[tmp_path / "a.pdf"])
    with pytest.raises(FileNotFoundError):
        html_report("t", {}, figures=[tmp_path / "a.png"])


def test_versions_are_those_installed():
    import jax

    tables = parsed(html_report("t", {})).iter("table")
    rows = {row[0].text: row[1].text for table in tables for row in table.iter("tr")}
    assert rows["jax"] == jax.__version__
    assert rows["numpy"] == np.__version__
    assert rows["Python"] == sys.version.split()[0]
    assert rows["precision"] == "float64"


def test_a_run_reported_as_the_command_line_does(tmp_path, monkeypatch):
    chosen = dataclasses.replace(scenarios.load("dai-2014").select(("pid",)), trials=1)
    dataset, _ = runs.run_schemes(chosen.machine, chosen.schemes, chosen.task, 1)
    numbers = run_numbers(chosen, dataset)
    drawn_axes().figure.savefig(tmp_path / "error-by-trial.png")
    monkeypatch.setattr(sys, "argv", ["/somewhere/jaxilc", "run", "dai-2014", "--set", "name=a b"])
    path = tmp_path / "new folder" / "report.html"
    figures = [("a caption", tmp_path / name) for name in ("error-by-trial.png", "of-print.pdf")]
    found = {"verdict": Verdict(("a sentence",)), "lines": ["a line"]}
    tables = [run_table(chosen, numbers)]
    assert command_report(path, "run", tables, figures, scenario=chosen, **found) == path
    tree = parsed(path.read_text(encoding="utf-8"))
    sections = {one.findtext("h2"): one for one in tree.findall("body/section")}
    assert [*sections][:2] == ["Conclusion", "What was asked"]
    assert sections["Conclusion"].findtext("p") == "a sentence"
    asked = {row[0].text: row[1].text for row in sections["What was asked"].iter("tr")}
    assert asked["command"] == "jaxilc run dai-2014 --set 'name=a b'"
    assert (asked["plant"], asked["schemes"], asked["trials"]) == ("printed", "pid", "1")
    head, (row,) = cells(sections["Tables"].find(".//table"))
    assert head == ["trial", "pid"]
    # The same number is computed in another way, by learning without the dataset; three digits are
    # shown.
    alone = learn(chosen.machine, chosen.schemes["pid"], chosen.task, 1)
    error = float(np.max(np.asarray(alone.settled_error)))
    assert row[0] == "1"
    assert abs(float(row[1]) / error - 1) < 5e-3
    assert len(list(tree.iter("img"))) == 1
    lines = ["".join(li.itertext()) for li in tree.iter("li")]
    notes = [line.replace("`", "") for line in chosen.chosen]
    assert lines == [str(tmp_path / "of-print.pdf"), "a line", *notes]
    settings = {row[0].text: row[1].text for row in tree.find(".//details").iter("tr")}
    poles = [float(text) for text in settings["machine.plant.poles"].split(", ")]
    np.testing.assert_allclose(poles, chosen.machine.plant.poles, rtol=1e-3)


def test_writing_is_all_or_nothing(tmp_path):
    path = write_report(tmp_path / "report.html", "first", {"a": 1})
    before = path.read_text(encoding="utf-8")
    with pytest.raises(FileNotFoundError):
        write_report(path, "second", {}, figures=[tmp_path / "missing.png"])
    assert path.read_text(encoding="utf-8") == before
    assert [p.name for p in tmp_path.iterdir()] == ["report.html"]
    assert ET.parse(io.StringIO(before)).findtext("body/h1") == "first"


# In a real browser
# --------------------------------------------------------------------------------------------------

BLUE = (12, 34, 210)  # no style and no other figure has this colour


@pytest.fixture
def server():
    """Return the address of a server on this machine, and the paths that were requested from it."""
    asked = []

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self):
            asked.append(self.path)
            self.send_error(404)

        def log_message(self, *_):
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler) as running:
        thread = threading.Thread(target=running.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{running.server_port}", asked
        running.shutdown()
        thread.join()


def lively(tmp_path):
    """Return a page with a trial slider and with machines, and the data it was made from."""
    rng = np.random.default_rng(0)
    e = rng.normal(size=(2, 3, 41, 1)) * np.array([1.0, 0.1, 0.01])[None, :, None, None]
    r, schemes = np.sin(np.linspace(0, 6, 41))[:, None], ("one", "two")
    run = run_of(e, r, e[:, :, :-1], dt=1e-2, schemes=schemes)
    gain, other = rng.uniform(size=(2, 50))
    last = np.stack([1 + gain, 1 + other])
    many = sweep_of(np.repeat(last[..., None], 3, axis=2), schemes)
    of = {"metric": "rms", "unit": "mm"}
    live = [
        page_of(error_by_trial.described(run, **of)),
        browsers.trials(run, unit="mm"),
        browsers.machines(many, {"plant.gain": gain, "plant.other": other}, tolerance=1.5, **of),
        page_of(band_together(summarise(many, 1.5, metric="rms"), **of)),
    ]
    page = write_report(tmp_path / "live.html", NASTY, {"a": NASTY}, live=live)
    return page, run, last, other


def test_a_page_is_small_whatever_it_shows():
    """Of many schemes fewer trials can be chosen; what would still not fit is named instead."""
    rng = np.random.default_rng(1)
    e = rng.normal(size=(49, 12, 101, 3))
    names = [f"scheme-{i}" for i in range(49)]
    run = run_of(e, e[0, 0], e[:, :, :-1], schemes=names, channel=["x", "y", "z"])
    long = xr.Dataset(
        {"rms": (("scheme", "trial"), rng.uniform(size=(6, 50_000)))},
        coords={"scheme": names[:6], "trial": np.arange(1, 50_001)},
    )
    within = browsers.trials(run, unit="mm")
    errors = page_of(error_by_trial.described(long, metric="rms"))
    assert "4 of the 12 trials" in within.caption
    text = html_report("a", {}, live=[errors, within])
    assert len(text) < 5_000_000
    assert "left out to keep this page small: The rms of each trial." in text
    assert text.count('<figure class="live">') == 1


def test_a_live_page_is_whole_and_small(tmp_path):
    """Every script is within the page; it is well formed, small, and shows no JSON as text."""
    text = lively(tmp_path)[0].read_text(encoding="utf-8")
    assert len(text) < 5_000_000
    page = Page(text)
    assert page.balanced
    assert not page.open
    assert page.references == []
    tree = ET.fromstring(text.removeprefix("<!DOCTYPE html>"))
    assert [f.text.endswith(".") for f in tree.iter("figcaption")] == [True] * 4
    meta = [m.get("content") for m in tree.iter("meta") if m.get("http-equiv")]
    assert meta == [LIVE_POLICY]
    assert meta[0].startswith("default-src 'none'")
    assert "{" not in "".join(t for s in tree.findall("body/section") for t in s.itertext())


@pytest.mark.thorough
@needs_chromium
def test_a_reader_moves_the_slider_and_chooses_a_parameter(tmp_path):
    """The widgets are moved in a browser; the figures then show the numbers that were put in."""
    page, run, last, other = lively(tmp_path)
    said = opened(
        page,
        tmp_path,
        """
        const all = Bokeh.documents.flatMap((d) => [...d._all_models.values()]);
        const of = (type) => all.filter((m) => m.type === type);
        const by = (title) => of("Select").filter((m) => m.title === title);
        const column = (name) => of("ColumnDataSource").filter((s) => name in s.data);
        const slider = Bokeh.index.find_one(of("Slider")[0]).shadow_el;
        const handle = slider.querySelector(".noUi-handle");
        handle.dispatchEvent(new KeyboardEvent("keydown", {key: "ArrowLeft"}));  // from the last
        for (const select of by("scheme")) select.value = "two";
        by("parameter")[0].value = "plant.other";
        await new Promise((resolve) => setTimeout(resolve, 1000));  // what is called runs later
        const trial = column("t").find((s) => "r" in s.data && !("r_0" in s.data));
        const dots = column("machine")[0];
        return {errors: [...trial.data.e], x: [...dots.data.x], y: [...dots.data.y],
                canvases: of("Plot").length + of("Figure").length,
                spoken: ["aria-label", "aria-valuetext"].map((name) => handle.getAttribute(name)),
                bars: [...column("share")[0].data.share], told: of("Div").map((d) => d.text)};
        """,
    )
    assert isinstance(said, dict), said
    assert "two, trial 2" in said["told"]
    assert said["spoken"] == ["trial", "2"]  # to a screen reader
    shown = run["e"].sel(scheme="two", trial=2).values[:, 0]
    ratio = np.asarray(said["errors"]) / shown  # in another unit, that of the last trial
    np.testing.assert_allclose(ratio, ratio[0], rtol=1e-5)
    assert ratio[0] in (pytest.approx(1.0), pytest.approx(1e3))
    np.testing.assert_allclose(said["x"], other)
    np.testing.assert_allclose(said["y"], last[1])
    assert max(said["bars"]) > 90  # what the other parameter explains of the other scheme
    assert said["canvases"] >= 7


@pytest.mark.thorough
@needs_chromium
def test_a_browser_shows_every_figure_and_asks_nobody(tmp_path, server):
    """If a page had a reference to another site, its policy would block it."""
    address, asked = server
    axes = [
        Figure(figsize=(2.0, 1.0), dpi=100, facecolor=tuple(c / 255 for c in BLUE)).subplots()
        for _ in range(2)
    ]
    for kind, ax in zip(("a.png", "b.svg"), axes, strict=True):
        ax.figure.savefig(tmp_path / kind)
    text = html_report("t", {"a": 1}, figures=[tmp_path / "a.png", tmp_path / "b.svg"])
    foreign = (
        f'<img src="{address}/picture"/><script src="{address}/script"></script>'
        f'<link rel="stylesheet" href="{address}/style"/></body>'
    )
    (tmp_path / "page.html").write_text(text.replace("</body>", foreign), encoding="utf-8")
    blue = np.all(photographed(tmp_path / "page.html", tmp_path) == BLUE, axis=2)
    rows = np.flatnonzero(blue.any(axis=1))
    assert len(np.flatnonzero(np.diff(rows) > 20)) == 1, "two figures, one below the other"
    assert asked == []
    (tmp_path / "bare.html").write_text(
        text.replace("</body>", foreign).replace(POLICY, "default-src *"), encoding="utf-8"
    )
    photographed(tmp_path / "bare.html", tmp_path)
    assert {"/picture", "/script", "/style"} <= set(asked), "or this test says nothing"
