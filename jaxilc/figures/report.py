"""One self-contained HTML page of a run, a sweep, a certificate or a tuning.

The page can be read offline and printed. It is well-formed XML, and nothing in it refers to
anything outside of it: figures are embedded, the style is inline, and a content security policy
makes the browser refuse everything else.
"""

from __future__ import annotations

import base64
import html
import io
import json
import platform
import re
import shlex
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.table import Table

from ..runtime.provenance import describe, environment
from ..storage.files import atomically
from .page_style import STYLE

if TYPE_CHECKING:
    from ..scenarios import Scenario

MEDIA = {".png": "image/png", ".svg": "image/svg+xml"}
DPI = 200  # resolution of axes that are drawn for the page
NOT_IN_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"

Rows = tuple[str, Sequence[Mapping[str, object]]]
Drawing = Any  # a file, or axes, or an array of axes of one figure


def html_report(
    title: str,
    asked: Mapping[str, object],
    tables: Sequence[Table | Rows] = (),
    figures: Sequence[Drawing | tuple[str, Drawing]] = (),
    configuration: Mapping[str, object] | None = None,
    notes: Mapping[str, Sequence[str]] | None = None,
) -> str:
    """The page as text.

    title: title of the page
    asked: arguments of the command or call, by name
    tables: tables of `rich`, whose texts are taken as they are, or pairs (caption, rows by column)
    figures: PNG or SVG files or axes, or pairs (caption, one of these)
    configuration: all that determines the numbers, as JSON
    notes: paragraphs by heading
    Raises ValueError naming a figure that is neither PNG nor SVG, and FileNotFoundError for a file
    that does not exist.
    """
    sections = [
        ("What was asked", [_named(asked)]),
        (
            "Tables",
            [_table(*(_of_rich(t) if isinstance(t, Table) else _of_rows(*t))) for t in tables],
        ),
        ("Figures", [_figure(*(f if isinstance(f, tuple) else (_caption(f), f))) for f in figures]),
        *(
            (
                heading,
                [_element("ul", *(_element("li", _text(line)) for line in lines))] if lines else [],
            )
            for heading, lines in (notes or {}).items()
        ),
        ("Versions", [_named(_versions())]),
        (
            "Configuration",
            [_element("pre", _text(json.dumps(configuration, indent=1, ensure_ascii=False)))]
            if configuration
            else [],
        ),
    ]
    body = [_element("h1", _text(title))]
    for heading, parts in sections:
        if parts:
            body.append(_element("section", _element("h2", _text(heading)), *parts))
    head = (
        '<meta charset="utf-8"/>',
        f'<meta http-equiv="Content-Security-Policy" content="{POLICY}"/>',
        '<meta name="viewport" content="width=device-width, initial-scale=1"/>',
        _element("title", _text(title)),
        _element("style", STYLE),
    )
    page = _element("html", _element("head", *head), _element("body", *body)).replace(
        "<html>", '<html lang="en">', 1
    )
    return f"<!DOCTYPE html>\n{page}\n"


def write_report(
    path: str | Path, title: str, asked: Mapping[str, object], *parts, **named
) -> Path:
    """Write the page of `html_report`, completely or not at all, and make its folder if needed.

    parts, named: the further arguments of `html_report`
    """
    page = html_report(title, asked, *parts, **named).encode()
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    atomically(path, lambda file: file.write(page))
    return Path(path)


def command_report(
    path: str | Path | None,
    command: str,
    tables: Sequence[Table | Rows],
    figures: Sequence[Drawing] = (),
    *,
    scenario: Scenario | None = None,
    configuration: Mapping[str, object] | None = None,
    lines: Sequence[str] = (),
    asked: Mapping[str, object] | None = None,
) -> list[Path]:
    """Write the page of a command of the command line, and return a list with its file.

    path: path of the page; None writes nothing, and the list is empty
    command: name of the command
    tables: tables that were printed
    figures: axes or files; files that are not pictures are left out
    scenario: the scenario that was run, None for a command without one
    configuration: all that determines the numbers, None for that of the scenario
    lines: lines that were printed besides the tables
    asked: further rows below the name of the command
    """
    if path is None:
        return []
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
    return [
        write_report(
            path,
            f"jaxilc {command}" + (f": {scenario.title}" if scenario is not None else ""),
            rows | dict(asked or {}),
            tables,
            [f for f in figures if not isinstance(f, str | Path) or Path(f).suffix in MEDIA],
            configuration,
            {
                "Also": lines,
                "Chosen where the paper leaves it open": scenario.chosen
                if scenario is not None
                else (),
            },
        )
    ]


def _versions() -> dict[str, object]:
    found = environment()
    known = {name: value for name, value in found.items() if name != "versions"}
    return (
        found["versions"]
        | {"Python": platform.python_version(), "system": platform.platform()}
        | known
    )


def _of_rich(table: Table) -> tuple[str, list[str], list[bool], list[list[str]]]:
    """The caption, the headers, which columns hold numbers, and the rows of a table."""
    rows = zip(*([_plain(cell) for cell in column.cells] for column in table.columns), strict=True)
    return (
        _plain(table.title),
        [_plain(c.header) for c in table.columns],
        [c.justify == "right" for c in table.columns],
        list(map(list, rows)),
    )


def _of_rows(
    caption: str, rows: Sequence[Mapping[str, object]]
) -> tuple[str, list[str], list[bool], list[list[str]]]:
    names = list(dict.fromkeys(name for row in rows for name in row))
    numeric = [any(_is_number(row.get(name)) for row in rows) for name in names]
    return caption, names, numeric, [[_value(row.get(name)) for name in names] for row in rows]


def _table(
    caption: str, headers: Sequence[str], numeric: Sequence[bool], rows: Sequence[Sequence[str]]
) -> str:
    def row(tag, cells):
        opened = (f'<{tag} class="n">' if right else f"<{tag}>" for right in numeric)
        return _element(
            "tr",
            *(f"{start}{_text(cell)}</{tag}>" for start, cell in zip(opened, cells, strict=True)),
        )

    parts = [_element("caption", _text(caption))] if caption else []
    parts += [
        _element("thead", row("th", headers)),
        _element("tbody", *(row("td", cells) for cells in rows)),
    ]
    return f'<div class="wide">{_element("table", *parts)}</div>'


def _named(values: Mapping[str, object]) -> str:
    """A table with the columns name and value, as text."""
    rows = (
        _element("tr", _element("th", _text(name)), _element("td", _text(_value(value))))
        for name, value in values.items()
    )
    return f'<div class="wide">{_element("table", _element("tbody", *rows))}</div>'


def _figure(caption: str, drawing: Drawing) -> str:
    kind, data = _picture(drawing)
    source = f"data:{kind};base64,{base64.b64encode(data).decode()}"
    return _element(
        "figure",
        f'<img src="{source}" alt="{_text(caption)}"/>',
        _element("figcaption", _text(caption)),
    )


def _picture(drawing: Drawing) -> tuple[str, bytes]:
    """The media type and the bytes of a file or of axes."""
    if isinstance(drawing, str | Path):
        kind = MEDIA.get(Path(drawing).suffix)
        if kind is None:
            raise ValueError(f"html_report: figure {drawing} is not one of {', '.join(MEDIA)}")
        return kind, Path(drawing).read_bytes()
    file = io.BytesIO()
    _first(drawing).figure.savefig(file, format="png", dpi=DPI)
    return MEDIA[".png"], file.getvalue()


def _caption(drawing: Drawing) -> str:
    """The caption of a drawing: the name of a file, or the title of axes."""
    return (
        Path(drawing).stem.replace("-", " ")
        if isinstance(drawing, str | Path)
        else _first(drawing).get_title()
    )


def _first(axes) -> Any:
    return np.ravel(axes)[0]


def _plain(cell: object) -> str:
    """The text of a cell of a table of `rich`.

    Brackets are units, not markup. Where they are escaped, the backslash is removed.
    """
    return (
        cell.replace("\\[", "[")
        if isinstance(cell, str)
        else getattr(cell, "plain", "" if cell is None else str(cell))
    )


def _value(value: object) -> str:
    if value is None:
        return ""
    return (
        f"{value:.6g}"
        if _is_number(value) and not isinstance(value, int | np.integer)
        else str(value)
    )


def _is_number(value: object) -> bool:
    return isinstance(value, int | float | np.number) and not isinstance(value, bool)


def _text(text: str) -> str:
    """The escaped text; a character that XML does not allow becomes a replacement character."""
    return html.escape(NOT_IN_XML.sub("\ufffd", text))


def _element(tag: str, *inside: str) -> str:
    return f"<{tag}>{''.join(inside)}</{tag}>"
