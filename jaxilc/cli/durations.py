"""How long commands took on this computer, so that the time left is known before a part is done."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

WRITTEN = ("--out", "--json", "--report", "--figures", "--seed")  # take no time of their own
KEPT = 200  # commands
# Seconds of a command the first time, measured on an axis as `init` writes it (`identify`: 5000
# samples): two cores, nothing compiled.
USUAL = {"run": 6.0, "certify": 16.0, "identify": 6.0, "filter": 11.0, "export": 28.0,
         "worst-case": 7.0, "tune": 8.0, "design": 62.0, "learn-law": 66.0}  # fmt: skip


def file() -> Path | None:
    """The file of durations, in the user's cache or JAXILC_CACHE; None where that is `off`."""
    chosen = os.environ.get("JAXILC_CACHE", "")
    if chosen == "off":
        return None
    with suppress(RuntimeError):  # a user without a home folder
        cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "jaxilc"
        return Path(chosen or cache) / "durations.json"
    return None


def key_of(arguments: Sequence[str]) -> str:
    """A short name for what a command computes, whatever files it writes."""
    words, skipped = [], False
    for word in arguments:
        if skipped or word.partition("=")[0] in WRITTEN:
            skipped = not skipped and "=" not in word
        else:
            words.append(word)
    return hashlib.sha256(json.dumps(words).encode()).hexdigest()[:16]


def expected(key: str) -> float | None:
    """The seconds that it took the last time; None if it was never run, or nothing is kept."""
    return _known().get(key)


def remember(key: str, seconds: float) -> None:
    """Keep the seconds that it took; where no file can be written, nothing is kept."""
    from ..storage.sealed import write_json

    path, known = file(), _known()
    if path is None:
        return
    known.pop(key, None)
    known[key] = round(seconds, 2)
    with suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        write_json(path, dict(list(known.items())[-KEPT:]))


def _known() -> dict[str, float]:
    """All durations; none where the file is missing or is not what was written."""
    path = file()
    if path is None:
        return {}
    try:
        found = json.loads(path.read_bytes())
        return {str(key): float(seconds) for key, seconds in found.items()}
    except (OSError, ValueError, TypeError, AttributeError):
        return {}
