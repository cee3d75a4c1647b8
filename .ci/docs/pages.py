"""The guide: the project's Markdown files as pages beside those of the modules.

`PAGES` lists the files. A link from one of them to another leads to the other's page; a link to any
other file of the repository stays as text, since the pages do not hold that file. A link that leads
nowhere raises ValueError.
"""

import posixpath
import re
from collections.abc import Sequence
from pathlib import Path

import pdoc.render
import pdoc.render_helpers

ROOT = Path(__file__).parents[2]
PAGES = {  # file of the repository: page
    "README.md": "index.html",
    ".ci/docs/guide/command_line.md": "guide/command_line.html",
    ".ci/docs/guide/library.md": "guide/library.html",
    ".ci/docs/guide/paths.md": "guide/paths.html",
    ".ci/docs/guide/contents.md": "guide/contents.html",
    ".ci/docs/guide/learned_laws.md": "guide/learned_laws.html",
    ".ci/docs/guide/many_hosts.md": "guide/many_hosts.html",
    ".ci/docs/guide/papers.md": "guide/papers.html",
    ".ci/docs/guide/notebooks.md": "guide/notebooks.html",
    ".ci/docs/guide/design.md": "guide/design.html",
    "jaxilc/README.md": "guide/map.html",
    ".github/CONTRIBUTING.md": "guide/contributing.html",
    "CHANGELOG.md": "guide/changelog.html",
}
LINK = re.compile(r"(?<!!)\[([^\]]+)\]\(([^)\s]+)\)")
OUTSIDE = re.compile(r"[a-z]+:")
FENCED = re.compile(r"^```.*?^```$", re.MULTILINE | re.DOTALL)
HEADING = re.compile(r"^#+ +(.*)$", re.MULTILINE)


def anchors(text: str) -> set[str]:
    """The anchors of a Markdown text: one for each heading, in lower case, spaces as hyphens."""
    headings = HEADING.findall(FENCED.sub("", text))
    return {re.sub(r"[^\w\- ]", "", h).strip().lower().replace(" ", "-") for h in headings}


def links(file: str) -> list[tuple[str, str, str]]:
    """(target as written, file of the repository, anchor) of each link of a file to the repository.

    Raises ValueError for a link to a file or a heading that is not there.
    """
    found = []
    for _, target in LINK.findall(FENCED.sub("", (ROOT / file).read_text(encoding="utf-8"))):
        if OUTSIDE.match(target):
            continue
        path, _, anchor = target.partition("#")
        leads = posixpath.normpath(posixpath.join(posixpath.dirname(file), path)) if path else file
        if not (ROOT / leads).exists():
            raise ValueError(f"{file}: the link {target} leads to {leads}, which is not there")
        if anchor and anchor not in anchors((ROOT / leads).read_text(encoding="utf-8")):
            raise ValueError(f"{file}: the link {target} leads to a heading that is not there")
        found.append((target, leads, anchor))
    return found


def linked(file: str) -> str:
    """The text of a file, its links leading to pages."""
    here = posixpath.dirname(PAGES[file])
    leads = {target: (to, anchor) for target, to, anchor in links(file)}

    def to_page(link: re.Match) -> str:
        name, target = link.groups()
        if target not in leads:
            return link.group()
        to, anchor = leads[target]
        if to not in PAGES:
            return name
        address = posixpath.relpath(PAGES[to], here or ".")
        return f"[{name}]({address}{'#' * bool(anchor)}{anchor})"

    return LINK.sub(to_page, (ROOT / file).read_text(encoding="utf-8"))


def title_of(file: str) -> str:
    """The first heading of a file."""
    found = HEADING.search((ROOT / file).read_text(encoding="utf-8"))
    if found is None:
        raise ValueError(f"{file} has no heading")
    return found.group(1)


def write(folder: Path, modules: Sequence[str]) -> None:
    """Write all pages of the guide into the folder that has the pages of the modules.

    Raises ValueError for a broken link.
    """
    for file, page in PAGES.items():
        here = posixpath.dirname(page) or "."
        html = pdoc.render.env.get_template("guide.html.jinja2").render(
            title=title_of(file),
            text=pdoc.render_helpers.to_html(linked(file)),
            pages=[(title_of(f), posixpath.relpath(p, here)) for f, p in PAGES.items()],
            modules=[(m, posixpath.relpath(m.replace(".", "/") + ".html", here)) for m in modules],
        )
        (folder / page).parent.mkdir(exist_ok=True)
        (folder / page).write_text(html, encoding="utf-8")
    check_pages(folder)


def check_pages(folder: Path) -> None:
    """Raises ValueError for a link from a page of the guide to a page or an anchor not there."""
    for page in PAGES.values():
        for target in re.findall(r'href="([^"]+)"', (folder / page).read_text(encoding="utf-8")):
            if OUTSIDE.match(target):
                continue
            path, _, anchor = target.partition("#")
            leads = (folder / page).parent / path if path else folder / page
            if not leads.exists():
                raise ValueError(f"{page}: the link {target} leads nowhere")
            if anchor and f'id="{anchor}"' not in leads.read_text(encoding="utf-8"):
                raise ValueError(f"{page}: the link {target} leads to an anchor that is not there")
