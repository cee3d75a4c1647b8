"""The documentation: guide, tutorials, gallery of figures, papers, and the API, by Sphinx.

`render.py FOLDER` writes it, with executed notebooks. Without a folder it only checks that it can
be made: nothing is executed and no page is drawn. With JAXILC_FAST=1 in the environment the
notebooks are not executed. A warning of Sphinx, a broken link, and a page
that loads something from elsewhere are errors.
"""

import os
import shutil
import sys
import tempfile
from pathlib import Path

import api
import gallery
import jupytext
import live
import nbclient
import pages
import papers
import plant_file
import printer
from sphinx.cmd.build import build_main

HERE, ROOT = Path(__file__).parent, Path(__file__).parents[2]


def notebooks_in(folder: Path, *, execute: bool) -> list[str]:
    """Write the notebooks as .ipynb, executed if asked for; return the names of their pages."""
    (folder / "tutorials").mkdir(parents=True)
    names = []
    for path in sorted((ROOT / "notebooks").glob("*.py")):
        notebook = jupytext.read(path)
        for cell in notebook.cells:
            if cell.cell_type == "markdown":
                pages.need_whole(path.name, cell.source)
        notebook.metadata.setdefault(
            "kernelspec", {"name": "python3", "display_name": "Python 3", "language": "python"}
        )
        if execute:
            print(f"executing {path.name}", flush=True)
            with tempfile.TemporaryDirectory() as here:
                about = {"metadata": {"path": here}}
                nbclient.NotebookClient(notebook, timeout=600, resources=about).execute()
        jupytext.write(notebook, folder / "tutorials" / f"{path.stem}.ipynb")
        names.append(f"tutorials/{path.stem}")
    return names


def main(out: Path | None) -> int:
    """Gather the sources in a folder of their own, and build them."""
    drawn = out is not None
    with tempfile.TemporaryDirectory() as staged:
        source = Path(staged) / "source"
        source.mkdir()
        sys.path.insert(0, str(HERE))
        shutil.copy(HERE / "conf.py", source / "conf.py")
        (source / "_static").mkdir()
        for name in ("pages.css", "pages.js"):
            shutil.copy(HERE / name, source / "_static")
        (source / "_extra").mkdir()
        if drawn:
            live.write(source / "_extra")
        figures = gallery.write(source) if drawn else []
        made = {
            "Tutorials": notebooks_in(source, execute=drawn and "JAXILC_FAST" not in os.environ),
            "Papers": papers.write(source) if drawn else [],
            "Figures": figures,
            "API": api.write(source),
        }
        pages.write(source, made, live.SHOWN if drawn else "")
        plant_file.extend(source / "guide" / "plant_file.md")
        if drawn:
            printer.extend(source / "guide" / "printer.md")
        built = Path(staged) / "built"
        kind = ["html", "-t", "pages"] if drawn else ["dummy"]
        code = build_main(["-b", *kind, "-q", "-W", "--keep-going", str(source), str(built)])
        if code == 0 and out is not None:
            pages.check_built(built)
            shutil.rmtree(out, ignore_errors=True)
            shutil.copytree(
                built, out, ignore=shutil.ignore_patterns(".doctrees", ".buildinfo", "_sources")
            )
    return code


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]) if len(sys.argv) > 1 else None))
