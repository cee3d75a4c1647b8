"""What the tests of a commit leave for others: notebooks, pages, and tests marked `thorough`."""

import os
import random
import subprocess
import zlib
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[1]
COMMITS = 5  # a file that one of these changed is executed
SHARE = 16  # of the `thorough` tests, one in so many is run


def git(*words: str) -> str:
    """Return what git prints; nothing where there is no git, or not enough of its history."""
    try:
        done = subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True)
    except OSError:
        return ""
    return done.stdout if done.returncode == 0 else ""


@cache
def _head() -> str:
    """Return the commit; nothing where all is due: outside of git, and with JAXILC_ALL=1."""
    return "" if os.environ.get("JAXILC_ALL") == "1" else git("rev-parse", "HEAD")


@cache
def _changed() -> set[str]:
    """Return the families of the package that the commit, or what is not committed yet, changes.

    The commands change with what they find.
    """
    files = map(Path, git("diff", "--name-only", "HEAD~1").splitlines())
    changed = {file.parts[1] for file in files if file.parts[0] == "jaxilc"}
    return changed | {"cli"} if "outcomes" in changed else changed


def drawn(test: str) -> bool:
    """Return whether a `thorough` test is due: its family changes, or the commit draws it.

    It is drawn by one in `SHARE` commits.
    """
    if not _head() or Path(test).parts[1] in _changed():
        return True
    return zlib.crc32((_head() + test).encode()) % SHARE == 0


def due(paths: list[Path], count: int) -> list[Path]:
    """Return those that changed lately, and as many others, which the commit draws.

    All of them are due outside of git and with JAXILC_ALL=1, by which `make docs` runs the pages;
    it executes all notebooks itself.
    """
    if not _head():
        return paths
    changed = git("diff", "--name-only", f"HEAD~{COMMITS}").splitlines()
    picked = random.Random(_head()).sample(paths, count)
    return [p for p in paths if p in picked or p.relative_to(ROOT).as_posix() in changed]
