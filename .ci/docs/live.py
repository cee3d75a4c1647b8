"""The page of a sweep, as `--report` writes it, within the first page of the site."""

from pathlib import Path

NAME = "live.html"
MACHINES, TRIALS = 128, 40
SHOWN = f"""
A page that `jaxilc sweep cao-2019 --report page.html` writes, of {MACHINES} motors: point at a
line, choose a parameter, move the slider. It needs no network.

```{{raw}} html
<iframe class="live" src="{NAME}#explore" title="A sweep over {MACHINES} motors" loading="lazy">
</iframe>
```
"""


def write(folder: Path) -> None:
    """Write the page."""
    from jaxilc import outcomes, setup
    from jaxilc.outcomes import Request

    setup()
    asked = Request("cao-2019", ("pid", "cfdl-mfailc", "ffdl-mfailc"), trials=TRIALS)
    outcomes.sweep(asked, machines=MACHINES, folder=folder.parent / "live").page(folder / NAME)
