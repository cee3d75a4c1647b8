"""Which notebooks and pages the tests of a commit execute, as all of them would take minutes."""

import os
import random
import subprocess
from pathlib import Path

ROOT = Path(__file__).parents[1]
COMMITS = 5  # a file that one of these changed is executed


def git(*words: str) -> str:
    """Return what git prints; nothing where there is no git, or not enough of its history."""
    try:
        done = subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True)
    except OSError:
        return ""
    return done.stdout if done.returncode == 0 else ""


def due(paths: list[Path], count: int) -> list[Path]:
    """Return those that changed lately, and as many others, which the commit draws.

    All of them are due outside of git and with JAXILC_ALL=1, by which `make docs` runs the pages;
    it executes all notebooks itself.
    """
    head = git("rev-parse", "HEAD")
    if not head or os.environ.get("JAXILC_ALL") == "1":
        return paths
    changed = git("diff", "--name-only", f"HEAD~{COMMITS}").splitlines()
    drawn = random.Random(head).sample(paths, count)
    return [p for p in paths if p in drawn or p.relative_to(ROOT).as_posix() in changed]
