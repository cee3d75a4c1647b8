"""The gallery: each figure with the code that draws it, which is executed here.

The code of a figure is what its page shows. All figures share two small data sets, whose code
stands at the top of the page.
"""

import re
from pathlib import Path

PAGE = Path(__file__).parent / "gallery.md"
BLOCK = re.compile(r"^```python\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def write(folder: Path) -> bool:
    """Execute the blocks of the page in order, and write it with a picture below each figure.

    A block whose last value is named `axes` has a figure. Returns that there is a page.
    """
    import numpy as np

    (folder / "gallery").mkdir()
    known: dict = {}
    text, parts, last = PAGE.read_text(encoding="utf-8"), [], 0
    for number, block in enumerate(BLOCK.finditer(text)):
        known.pop("axes", None)
        exec(compile(block.group(1), f"gallery, block {number}", "exec"), known)
        parts.append(text[last : block.end()])
        last = block.end()
        if "axes" in known:
            figure = np.ravel(known["axes"])[0].figure
            figure.savefig(folder / "gallery" / f"{number}.png", dpi=90)
            parts.append(f"\n\n![The figure that this code draws](gallery/{number}.png)")
    (folder / "gallery.md").write_text("".join(parts) + text[last:], encoding="utf-8")
    return True
