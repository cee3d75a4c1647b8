"""The gallery: each figure with the code that draws it, which is executed here.

The code of a figure is what its page shows. A picture is drawn twice, for a light and for a dark
page; small ones at the top lead to the sections.
"""

import re
import time
from pathlib import Path
from typing import Any

from pages import anchor_of

PAGE = Path(__file__).parent / "gallery.md"
BLOCK = re.compile(r"^```python\n(.*?)^```$|^## ([^\n]*)$", re.MULTILINE | re.DOTALL)
OVERVIEW = "<!-- pictures -->"


def write(folder: Path) -> list[str]:
    """Execute the blocks of the page in order, and write it with a picture above each of them.

    A block that makes `axes` has a figure. Returns the name of the page.
    """
    import matplotlib.pyplot as plt

    (folder / "gallery").mkdir()
    known: dict[str, Any] = {}
    text, parts, last, small = PAGE.read_text(encoding="utf-8"), [], 0, []
    title = ""
    for number, block in enumerate(BLOCK.finditer(text)):
        if block.group(2):
            title = block.group(2)
            continue
        known.pop("axes", None)
        begun = time.perf_counter()
        exec(compile(block.group(1), f"gallery, {title}, block {number}", "exec"), known)
        print(f"gallery: {title or 'begin'} {time.perf_counter() - begun:.0f} s", flush=True)
        parts.append(text[last : block.start()])
        if "axes" in known:
            name = f"gallery/{number}"
            _draw(known["axes"], folder / name)
            parts.append(shown(name, title))
            small.append(thumb(name, title))
        parts.append(block.group())
        last = block.end()
        plt.close("all")
    whole = "".join(parts) + text[last:]
    (folder / "gallery.md").write_text(
        whole.replace(OVERVIEW, ":::{container} thumbs\n" + "".join(small) + ":::"),
        encoding="utf-8",
    )
    return ["gallery"]


def _draw(axes: Any, place: Path) -> None:
    import numpy as np

    from jaxilc.figures.paper import darken

    figure = np.ravel(axes)[0].figure
    figure.savefig(f"{place}.png", dpi=90)
    darken(figure)
    figure.savefig(f"{place}-dark.png", dpi=90)


def shown(name: str, title: str) -> str:
    """A picture of Markdown, one for a light and one for a dark page."""
    return "".join(
        f"```{{image}} {name}{of}.png\n:alt: {title}\n:class: {page}\n```\n"
        for page, of in (("only-light", ""), ("only-dark", "-dark"))
    )


def thumb(name: str, title: str) -> str:
    """A small picture, from where Sphinx copies it to, that leads to its section."""
    place = name.replace("gallery/", "_images/")
    pictures = "".join(
        f'<img class="{page}" src="{place}{of}.png" alt="{title}">'
        for page, of in (("only-light", ""), ("only-dark", "-dark"))
    )
    return f'<a href="#{anchor_of(title)}">{pictures}</a>\n'
