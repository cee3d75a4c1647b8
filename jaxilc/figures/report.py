"""One self-contained HTML page of a command: what it found, what was asked, figures and tables.

The page begins with its conclusion in sentences. It can be read offline and printed. It is
well-formed XML, and nothing in it refers to anything outside of it: figures and scripts are within
the page, and a content security policy makes the browser refuse everything else. The layout is in
`report.html.jinja2`, the style in `report.css`.
"""

from __future__ import annotations

import base64
import datetime
import io
import math
import platform
import re
import shlex
import sys
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, TypeAlias

import numpy as np
from rich.table import Table

from ..runtime.provenance import describe, environment
from ..storage.files import write_file

if TYPE_CHECKING:
    from jinja2 import Template

    from ..scenarios import Scenario
    from .description import Figure
    from .page import Live
    from .paper import Drawing

NOT_IN_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
MEDIA = {".png": "image/png", ".svg": "image/svg+xml"}
DPI = 120  # resolution of axes that are drawn for the page
ROOM = 4_800_000  # bytes of a page; figures beyond are named and left out
POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"
# The scripts of the figures stand in the page; they may not load or send anything.
LIVE_POLICY = f"{POLICY}; script-src 'unsafe-inline' 'unsafe-eval'"

Rows = tuple[str, Sequence[Mapping[str, object]]]
Picture: TypeAlias = "str | Path | Drawing"


class Said(Protocol):
    """The verdict of a command: sentences, and the command to type next, with what it does."""

    @property
    def said(self) -> Sequence[str]: ...
    @property
    def what(self) -> str: ...
    @property
    def following(self) -> str: ...


def html_report(
    title: str,
    asked: Mapping[str, object],
    tables: Sequence[Table | Rows] = (),
    figures: Sequence[Picture | tuple[str, Picture]] = (),
    configuration: Mapping[str, object] | None = None,
    notes: Mapping[str, Sequence[str]] | None = None,
    *,
    verdict: Said | None = None,
    live: Sequence[Live] = (),
) -> str:
    """The page as text.

    asked: arguments of the command or call, by name
    tables: tables of `rich`, whose texts are taken as they are, or pairs (caption, rows by column)
    figures: PNG or SVG files or axes, or pairs (caption, one of these)
    configuration: all that determines the numbers
    notes: paragraphs by heading
    verdict: what was found; it stands first
    live: interactive figures
    Raises ValueError naming a figure that is neither PNG nor SVG, and FileNotFoundError for a file
    that does not exist.
    """
    library, script, places, left_out = _scripts(live)
    pictures, others = _pictures(figures, ROOM - len(library) - len(script))
    text = _template("report").render(
        title=title,
        policy=LIVE_POLICY if places else POLICY,
        style=Path(__file__).with_name("report.css").read_text("utf-8"),
        library=library,
        script=script,
        date=f"{datetime.datetime.now().astimezone():%d %B %Y, %H:%M %Z}",
        verdict=verdict,
        asked=asked,
        live=places,
        figures=pictures,
        left_out=", ".join([*left_out, *others]),
        tables=[_of_rich(t) if isinstance(t, Table) else _of_rows(*t) for t in tables],
        notes=notes or {},
        versions=_versions(),
        settings=dict(_flat(configuration or {})),
    )
    return text.strip() + "\n"


def fragment(
    verdict: Said,
    tables: Sequence[Table],
    lines: Sequence[str],
    figures: Sequence[tuple[str, Picture]],
) -> str:
    """Verdict, tables, lines and figures as a part of a page, for a notebook."""
    return _template("fragment").render(
        verdict=verdict,
        tables=[_of_rich(table) for table in tables],
        lines=lines,
        figures=_pictures(figures, math.inf)[0],
    )


def _template(name: str) -> Template:
    """A layout, in which every value is a text that is escaped; `sentence` escapes its own."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    made = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        finalize=_text_of,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=StrictUndefined,
    )
    made.filters["sentence"] = _sentence
    return made.get_template(f"{name}.html.jinja2")


def _scripts(live: Sequence[Live]) -> tuple[str, str, list[dict[str, str]], list[str]]:
    """The library, the figures that fit as a script, their places with captions, and others."""
    if not live:
        return "", "", [], []
    from bokeh.resources import Resources

    resources = Resources(mode="inline", components=["bokeh", "bokeh-widgets"])
    library = "\n".join(resources.js_raw).replace("]]>", "]] >")  # which would end a section of XML
    room, kept = ROOM - len(library), [*live]
    script, places = _embedded(kept)
    if len(script) > room:
        kept = []
        for one in live:
            if len(_embedded([*kept, one])[0]) <= room:
                kept.append(one)
        script, places = _embedded(kept)
    found = [
        {"place": place, "caption": one.caption} for place, one in zip(places, kept, strict=True)
    ]
    left_out = [one.caption.partition(".")[0] for one in live if one not in kept]
    return library if kept else "", script, found, left_out


def _embedded(live: Sequence[Live]) -> tuple[str, Sequence[str]]:
    """Figures as a script, and the place of each."""
    if not live:
        return "", ()
    from bokeh.embed import components

    from .page import spoken

    script, places = components(tuple(one.model for one in live), wrap_script=False)
    return script.replace("]]>", "]] >") + spoken(), places


def _pictures(
    figures: Sequence[Picture | tuple[str, Picture]], room: float
) -> tuple[list[dict[str, str]], list[str]]:
    """The pictures with their captions, as long as they fit, and the captions of the others."""
    found: list[dict[str, str]] = []
    left_out: list[str] = []
    for one in figures:
        caption, drawing = one if isinstance(one, tuple) else (_caption_of(one), one)
        kind, data = _picture(drawing)
        source = f"data:{kind};base64,{base64.b64encode(data).decode()}"
        room -= len(source)
        if room < 0:
            left_out.append(str(drawing) if isinstance(drawing, str | Path) else caption)
        else:
            found.append({"source": source, "caption": caption})
    return found, left_out


def _caption_of(drawing: Picture) -> str:
    """The caption of a drawing without one: the name of its file in words, or the axes' title."""
    if isinstance(drawing, str | Path):
        return Path(drawing).stem.replace("-", " ")
    return np.ravel(drawing)[0].get_title()


def write_report(
    path: str | Path, title: str, asked: Mapping[str, object], *parts, **named
) -> Path:
    """Write the page of `html_report`, completely or not at all, and make its folder if needed."""
    page = html_report(title, asked, *parts, **named)
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    write_file(path, page)
    return Path(path)


def command_report(
    path: str | Path,
    command: str,
    tables: Sequence[Table],
    figures: Sequence[tuple[str, Picture]] = (),
    *,
    verdict: Said,
    scenario: Scenario | None = None,
    configuration: Mapping[str, object] | None = None,
    lines: Sequence[str] = (),
    asked: Mapping[str, object] | None = None,
    live: Sequence[Figure | Live | None] = (),
) -> Path:
    """Write the page of a command of the command line, and return its path.

    tables, lines: that were printed;  asked: further rows below the name of the command
    figures: pairs of a caption and axes or a file; a PDF is named on the page
    scenario: that was run, None for a command without one
    configuration: all that determines the numbers, None for that of the scenario
    live: interactive figures, or descriptions of them; None for one that has nothing to show
    """
    from . import page

    rows: dict[str, object] = {"command": shlex.join(["jaxilc", *sys.argv[1:]])}
    if scenario is not None:
        rows |= {
            "scenario": scenario.name,
            **scenario.options,
            "schemes": ", ".join(scenario.schemes),
            "trials": scenario.trials,
        }
        parts = ("machine", "schemes", "task", "trials", "uncertainty")
        configuration = configuration or {name: describe(getattr(scenario, name)) for name in parts}
    of_pdf = [str(one) for _, one in figures if isinstance(one, Path) and one.suffix == ".pdf"]
    return write_report(
        path,
        f"jaxilc {command}" + (f": {scenario.title}" if scenario is not None else ""),
        rows | dict(asked or {}),
        tables,
        [(caption, one) for caption, one in figures if str(one) not in of_pdf],
        configuration,
        {
            "Figures in files of their own": of_pdf,
            "In words": lines,
            "Chosen where the paper leaves it open": scenario.chosen if scenario else (),
        },
        verdict=verdict,
        live=[page.live(one) for one in live if one is not None],
    )


def _versions() -> dict[str, object]:
    found = environment()
    own = {"Python": platform.python_version(), "system": platform.platform()}
    known = {name: value for name, value in found.items() if name != "versions"}
    return found["versions"] | own | known


def _picture(drawing: Picture) -> tuple[str, bytes]:
    """The media type and the bytes of a file or of axes."""
    if isinstance(drawing, str | Path):
        kind = MEDIA.get(Path(drawing).suffix)
        if kind is None:
            raise ValueError(f"html_report: figure {drawing} is not one of {', '.join(MEDIA)}")
        return kind, Path(drawing).read_bytes()
    file = io.BytesIO()
    np.ravel(drawing)[0].figure.savefig(file, format="png", dpi=DPI)
    return MEDIA[".png"], file.getvalue()


# Values and tables as texts
# --------------------------------------------------------------------------------------------------


def _flat(value: object, path: str = "") -> list[tuple[str, object]]:
    """Nested settings as pairs of a path and a value."""
    if isinstance(value, Mapping):
        return [
            pair
            for name, of in value.items()
            for pair in _flat(of, f"{path}.{name}" if path else str(name))
        ]
    if isinstance(value, list | tuple):
        if all(not isinstance(of, Mapping | list | tuple) for of in value):
            return [(path, ", ".join(str(_text_of(of)) for of in value))]
        return [pair for i, of in enumerate(value) for pair in _flat(of, f"{path}[{i}]")]
    return [(path, value)]


def _of_rich(table: Table) -> dict[str, object]:
    """The caption, the headers, which columns hold numbers, and the rows of a table."""
    return {
        "caption": _plain(table.title),
        "headers": [_plain(column.header) for column in table.columns],
        "numeric": [column.justify == "right" for column in table.columns],
        "rows": zip(*(map(_plain, column.cells) for column in table.columns), strict=True),
    }


def _of_rows(caption: str, rows: Sequence[Mapping[str, object]]) -> dict[str, object]:
    names = list(dict.fromkeys(name for row in rows for name in row))
    return {
        "caption": caption,
        "headers": names,
        "numeric": [any(_is_number(row.get(name)) for row in rows) for name in names],
        "rows": [[row.get(name) for name in names] for row in rows],
    }


def _plain(cell: object) -> str:
    """The text of a cell of a table of `rich`, where a bracket that is escaped is a unit."""
    if isinstance(cell, str):
        return cell.replace("\\[", "[")
    return getattr(cell, "plain", "" if cell is None else str(cell))


def _is_number(value: object) -> bool:
    return isinstance(value, int | float | np.number) and not isinstance(value, bool)


def _sentence(text: object) -> str:
    """The markup of a sentence, in which what stands between backticks is code."""
    return re.sub("`([^`]+)`", r"<code>\1</code>", escape(str(_text_of(text))))


def _text_of(value: object) -> object:
    """A value as text without what XML does not allow; what is markup already stays as it is."""
    if hasattr(value, "__html__"):
        return value
    if _is_number(value) and not isinstance(value, int | np.integer):
        return f"{value:.6g}"
    return "" if value is None else NOT_IN_XML.sub("\ufffd", str(value))
