"""The reference of plant files: every class that a file may name, with its fields and units."""

import dataclasses
import inspect
from pathlib import Path

from plain_docstrings import blocks_of, fields_of

from jaxilc.filters.zero_phase import Filter
from jaxilc.plants import Plant
from jaxilc.scenarios.specification import HIDDEN, classes
from jaxilc.schemes import Scheme

NEEDED = 'In the tables below, "needed" is a field without a default.'
KINDS = {"Plants": Plant, "Schemes": Scheme, "Filters": Filter}


def extend(page: Path) -> None:
    """Append the reference to the page."""
    left, parts = dict(sorted(classes().items())), []
    for title, base in [*KINDS.items(), ("Parts of these", object)]:
        chosen = [name for name, cls in left.items() if issubclass(cls, base)]
        parts += [f"## {title}\n", *(_of_class(name, left.pop(name)) for name in chosen)]
    with page.open("a", encoding="utf-8") as file:
        file.write(f"\n{NEEDED}\n\n" + "\n".join(parts))


def _of_class(name: str, cls: type) -> str:
    """A heading, the first sentence, and a table of the fields with defaults and meanings."""
    documentation = inspect.getdoc(cls) or ""
    meanings: dict[str, str] = {}
    for block in blocks_of(documentation.splitlines()):
        for names, text in fields_of(block) or ():
            meanings |= {one.strip(): text for one in names.split(",")}
    first = " ".join(blocks_of(documentation.splitlines())[0]) if documentation else ""
    rows = []
    for field in dataclasses.fields(cls):
        if field.init and field.name not in HIDDEN:
            default = "needed" if field.default is dataclasses.MISSING else f"`{field.default}`"
            rows.append(f"| `{field.name}` | {default} | {_cell(meanings.get(field.name, ''))} |")
    table = "\n".join(["| field | if not given | meaning [unit] |", "|---|---|---|", *rows])
    return f"### {name}\n\n{_cell(first)}\n\n{table if rows else ''}\n"


def _cell(text: str) -> str:
    """Plain text for a cell of Markdown."""
    for character in "\\*_<>[]$":
        text = text.replace(character, "\\" + character)
    return text.replace("|", "\\|")
