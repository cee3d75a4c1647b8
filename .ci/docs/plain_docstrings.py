"""Docstrings in plain text as reStructuredText: formulas stay as written, fields become a list."""

import inspect
import re

NAME = r"\**[A-Za-z_][\w.]*(?:\[[^\]]*\])?(?: \([^)]*\))?"
FIELD = re.compile(rf"^({NAME}(?:(?:, | and ){NAME})*): +(\S.*)$")
SPECIAL = re.compile(r"([\\*|])")
CODE = re.compile(r"(`[^`\n]+`)")


def escaped(text: str) -> str:
    """Text in which nothing but `code` is interpreted."""
    parts = CODE.split(text)
    for i, part in enumerate(parts):
        if i % 2:
            parts[i] = f"``{part.strip('`')}``"
            continue
        part = SPECIAL.sub(r"\\\1", part).replace("`", "\\`")
        parts[i] = re.sub(r"(?<=\w)_(?!\w)", r"\\_", part)
        if i and parts[i][:1].isalnum():  # a letter right after code
            parts[i] = "\\ " + parts[i]
        if i + 1 < len(parts) and re.search(r"[^\s(\[{'\"/-]$", part):
            parts[i] += "\\ "
    return "".join(parts)


def blocks_of(lines: list[str]) -> list[list[str]]:
    """The lines between blank ones; fields end where a line is neither a field nor indented."""
    found: list[list[str]] = [[]]
    for line in lines:
        last = found[-1]
        of_text = line.strip() and not line.startswith(" ") and not FIELD.match(line)
        if last and (not line.strip() or (of_text and len(found) > 1 and FIELD.match(last[0]))):
            found.append([])
        if line.strip():
            found[-1].append(line.rstrip())
    return [block for block in found if block]


def fields_of(block: list[str]) -> list[tuple[str, str]] | None:
    """Names and texts of a block such as `dt: sample time [s]`; None for another block."""
    found: list[tuple[str, str]] = []
    for line in block:
        match = FIELD.match(line)
        if match and not line.startswith(" "):
            found.append((match.group(1), match.group(2)))
        elif found and line.startswith(" "):
            name, text = found[-1]
            found[-1] = (name, f"{text} {line.strip()}")
        else:
            return None
    return found


def as_rst(docstring: str) -> list[str]:
    """A docstring of the package as reStructuredText."""
    written: list[str] = []
    for i, block in enumerate(blocks_of(inspect.cleandoc(docstring).splitlines())):
        fields = fields_of(block) if i else None  # the first lines are a sentence
        if all(line.startswith(" ") for line in block):
            written += ["::", "", *(f"    {line}" for line in block)]
        elif fields:
            for name, text in fields:
                written += [f"``{name}``", f"    {escaped(text)}"]
        else:
            text = [escaped(line.strip()) for line in block]
            # a line of text is neither a heading nor a list, whatever it begins with
            written += [re.sub(r"^([-+•#>.]|\w+[.)])(?=\s)", r"\\\1", line) for line in text]
        written.append("")
    return written


def setup(app) -> None:
    """Have each docstring that autodoc reads converted."""

    def process(app, what, name, obj, options, lines):
        del app, options
        text = "\n".join(lines)
        if text.startswith("Alias for field number") or (what == "attribute" and not text.strip()):
            lines[:] = []
            return
        lines[:] = as_rst(text)

    app.connect("autodoc-process-docstring", process)
