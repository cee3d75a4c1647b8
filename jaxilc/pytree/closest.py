"""The known names that are closest to an unknown one, for messages: did you mean ...?"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Sequence
from itertools import accumulate

CUTOFF = 0.65  # least share of equal characters, by difflib, of a name that is suggested
MOST = 3  # names that a message suggests, and further texts of which it gives the first
LISTED = 12  # names that a message still lists after its suggestion
ROOM = 600  # characters of a list of names, at most; further names are counted
SHORTEST, LONGEST = 3, 100  # characters of a text to find within names, and to compare with them


def closest(given: object, known: Iterable[str]) -> list[str]:
    """The known names that are closest to a given text, at most `MOST`, the closest first.

    Upper and lower case, and `_` and `-`, count as equal. The text may also be the end of a path,
    such as `plant.gian` for `machine.plant.gain`, or a part of a name, such as `ffdl`.
    Returns no name for what is not text.
    """
    wanted, names = _plain(given) if isinstance(given, str) else "", list(known)
    if not 0 < len(wanted) <= LONGEST:
        return []
    forms: dict[str, list[str]] = {}
    for name in names:
        for form in dict.fromkeys((_plain(name), _end(_plain(name), wanted.count(".")))):
            forms.setdefault(form, []).append(name)
    close = difflib.get_close_matches(wanted, forms, MOST, CUTOFF)
    near = [name for form in close for name in forms[form]]
    if len(wanted) >= SHORTEST:
        near += [name for name in names if wanted in _plain(name)]
    return list(dict.fromkeys(near))[:MOST]


def known_names(given: object, known: Iterable[str], said: str = "known:") -> str:
    """The end of a message on an unknown name: the closest names first, then all known names.

    After a suggestion, more than `LISTED` names are counted in place of a list.

    said: words before the list of all names
    """
    names = list(known)
    all_names = f"{said} {listed(names)}"
    near = closest(given, names)
    if not near:
        return all_names
    if len(names) > LISTED:
        all_names = f"{len(names)} names are known"
    return f"did you mean {' or '.join(near)}? {all_names[0].upper()}{all_names[1:]}"


def not_one_of(what: str, given: object, known: Iterable[str]) -> str:
    """The message that a name is not one of those known, with the closest names first.

    what: the parameter and its value, such as `scheme = 'ffdl'`
    """
    names = list(known)
    if not closest(given, names):
        return f"{what} is not one of {listed(names)}"
    return f"{what} is unknown; {known_names(given, names)}"


def need_known(what: str, given: object, known: Iterable[str]) -> None:
    """Raises ValueError for a name that is not one of those known; what: as for `not_one_of`."""
    names = list(known)
    if given not in names:
        raise ValueError(not_one_of(what, given, names))


def listed(names: Iterable[object]) -> str:
    """Names with commas between them; where they would fill pages, the first and how many follow.

    It is `none` for no names.
    """
    texts = [text if len(text) <= LONGEST else f"{text[:LONGEST]} ..." for text in map(str, names)]
    ends = list(accumulate(len(text) + 2 for text in texts))
    return first_of(texts, max(1, sum(end <= ROOM for end in ends))) or "none"


def first_of(texts: Sequence[str], most: int = MOST, between: str = ", ") -> str:
    """The first of several texts, at most `most`, and how many follow."""
    left = len(texts) - most
    return between.join(texts[:most]) + (f" and {left} more" if left > 0 else "")


def _plain(name: str) -> str:
    return name.casefold().replace("_", "-")


def _end(path: str, dots: int) -> str:
    """The last parts of a path, as many as a text with this number of dots has."""
    return ".".join(path.split(".")[-dots - 1 :])
