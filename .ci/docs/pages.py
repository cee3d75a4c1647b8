"""The guide: the project's Markdown files as pages beside those of the modules.

`PAGES` lists the files. A link from one of them to another leads to the other's page; a link to any
other file of the repository stays as text, since the pages do not hold that file. A link that leads
nowhere raises ValueError.
"""

import posixpath
import re
import shutil
from pathlib import Path

ROOT = Path(__file__).parents[2]
GUIDE = ".ci/docs/guide/"
CHAPTERS = {  # title of a part: files of the repository
    "Begin here": ("five_minutes", "which_scheme", "coming_from", "glossary"),
    "How to": (
        "how_to",
        "command_line",
        "library",
        "grids",
        "paths",
        "potential",
        "differing",
        "export",
        "many_hosts",
    ),
    "Reference": ("plant_file", "theory", "contents", "notebooks", "citation"),
    "Findings": ("papers", "learned_laws", "printer"),
}
INSIDE = {
    f"{GUIDE}design.md": "guide/design",
    "jaxilc/README.md": "guide/map",
    ".github/CONTRIBUTING.md": "guide/contributing",
    "CHANGELOG.md": "guide/changelog",
}
PAGES = (
    {"README.md": "index"}
    | {f"{GUIDE}{name}.md": f"guide/{name}" for names in CHAPTERS.values() for name in names}
    | INSIDE
)  # file of the repository: page without its ending
PICTURES = ".github/pictures"
LINK = re.compile(r"(!?)\[([^\]]*)\]\(([^)\s]+)\)")
PICTURE = re.compile(r'<picture>.*?<img src="([^"]+)" alt="([^"]*)".*?</picture>', re.DOTALL)
DARK = re.compile(r'\(prefers-color-scheme: dark\)" srcset="([^"]+)"')  # the last one moves
AFTER = "[ILC in five minutes]"  # of the start page: the live page stands before it
OUTSIDE = re.compile(r"[a-z]+:")
SCRIPT = re.compile(r"<script\b.*?</script>", re.DOTALL)  # which may write links of its own
FENCED = re.compile(r"^```.*?^```$", re.MULTILINE | re.DOTALL)
HEADING = re.compile(r"^#+ +(.*)$", re.MULTILINE)
COMMENT = re.compile(r"^[ >*+-]*%.*$", re.MULTILINE)  # also amid a paragraph, or in a list


def anchor_of(heading: str) -> str:
    """The anchor of a heading: in lower case, spaces as hyphens."""
    return re.sub(r"[^\w\- ]", "", heading).strip().lower().replace(" ", "-")


def need_whole(file: str, text: str) -> str:
    """The text; raises ValueError for a line that the page would lose, since MyST omits it."""
    if lost := COMMENT.search(FENCED.sub("", text)):
        raise ValueError(
            f"{file}: the line {lost.group()!r} begins with %, and pages take it for a comment; "
            "put the word before it on the line"
        )
    return text


def written(file: str) -> str:
    """The text of a file of the repository, pictures of HTML as such of Markdown."""

    def both(picture: re.Match) -> str:
        light, says = picture.groups()
        dark = DARK.findall(picture.group())
        if not dark:
            return f"![{says}]({light})"
        return f"![{says}]({light}){{.only-light}}\n![{says}]({dark[-1]}){{.only-dark}}"

    return PICTURE.sub(both, (ROOT / file).read_text(encoding="utf-8"))


def links(file: str) -> list[tuple[str, str, str]]:
    """(target as written, file of the repository, anchor) of each link of a file to the repository.

    Raises ValueError for a link to a file or a heading that is not there.
    """
    found = []
    for _, _, target in LINK.findall(FENCED.sub("", written(file))):
        if OUTSIDE.match(target):
            continue
        path, _, anchor = target.partition("#")
        leads = posixpath.normpath(posixpath.join(posixpath.dirname(file), path)) if path else file
        if not (ROOT / leads).exists():
            raise ValueError(f"{file}: the link {target} leads to {leads}, which is not there")
        text = (ROOT / leads).read_text(encoding="utf-8") if anchor else ""
        if anchor and anchor not in map(anchor_of, HEADING.findall(FENCED.sub("", text))):
            raise ValueError(f"{file}: the link {target} leads to a heading that is not there")
        found.append((target, leads, anchor))
    return found


def linked(file: str) -> str:
    """The text of a file, its links leading to pages, its pictures to the copied ones.

    Raises ValueError for a broken link, and for a line that the page would lose.
    """
    here = posixpath.dirname(PAGES[file])
    leads = {target: (to, anchor) for target, to, anchor in links(file)}

    def to_page(link: re.Match) -> str:
        picture, name, target = link.groups()
        if target not in leads:
            return link.group()
        to, anchor = leads[target]
        if picture:
            place = posixpath.relpath(f"pictures/{posixpath.basename(to)}", here or ".")
            return f"![{name}]({place})"
        if to not in PAGES:
            return name
        address = posixpath.relpath(PAGES[to] + ".md", here or ".")
        return f"[{name}]({address}{'#' * bool(anchor)}{anchor})"

    return LINK.sub(to_page, need_whole(file, written(file)))


def write(folder: Path, made: dict[str, list[str]], live: str) -> None:
    """Write all pages of the guide as sources into a folder, the start page with the contents.

    made: names of further pages by the title of their part
    live: what the start page shows of the live page
    Raises ValueError as `linked`.
    """
    for file, page in PAGES.items():
        path = folder / f"{page}.md"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(linked(file), encoding="utf-8")
    shutil.copytree(ROOT / PICTURES, folder / "pictures", dirs_exist_ok=True)
    trees = {title: [f"guide/{name}" for name in names] for title, names in CHAPTERS.items()}
    trees |= made | {"Inside": [*INSIDE.values()]}
    start = folder / "index.md"
    text = start.read_text(encoding="utf-8")
    start.write_text(text.replace(AFTER, f"{live}\n{AFTER}", 1), encoding="utf-8")
    with start.open("a", encoding="utf-8") as index:
        for title, names in trees.items():
            if names:
                listed = "\n".join(names)
                index.write(f"\n```{{toctree}}\n:hidden:\n:caption: {title}\n\n{listed}\n```\n")


def check_built(folder: Path) -> None:
    """Raises ValueError for a page that refers to another site, or to a page or anchor not there.

    A link that a reader may click (`<a href>`) may lead to another site; what a page loads by
    itself may not.
    """
    texts = {path: path.read_text(encoding="utf-8") for path in folder.rglob("*.html")}
    loads = re.compile(r"<(?:script|img|link|iframe|source)\b[^>]*?(?:src|href)=\"([^\"]+)\"")
    for path, text in texts.items():
        for target in loads.findall(text):
            if re.match(r"(https?:)?//", target):
                raise ValueError(f"{path.name} loads {target} from elsewhere")
        for target in re.findall(r"<a\b[^>]*?href=\"([^\"]+)\"", SCRIPT.sub("", text)):
            if OUTSIDE.match(target):
                continue
            name, _, anchor = target.partition("#")
            leads = (path.parent / name).resolve() if name else path.resolve()
            if not leads.exists():
                raise ValueError(f"{path.name}: the link {target} leads nowhere")
            if anchor and leads.suffix == ".html" and f'id="{anchor}"' not in leads.read_text():
                raise ValueError(f"{path.name}: the link {target} leads to an anchor not there")
