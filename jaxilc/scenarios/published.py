"""Numbers to compare with, of papers and of other software, and what was fitted to them."""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from decimal import Decimal
from functools import cache
from importlib import resources
from typing import TYPE_CHECKING, NamedTuple, TypeVar

from ..pytree.closest import not_one_of
from .catalogue import LISTED

if TYPE_CHECKING:
    from ..pytree.aliases import Value

T = TypeVar("T")


class Fit(NamedTuple):
    """The numbers that were fitted to printed ones before a row could be simulated.

    names: names of the free numbers, empty if nothing was fitted
    to: printed numbers to which they were fitted
    among: whether the row is one of these, so that its agreement proves nothing
    """

    names: tuple[str, ...] = ()
    to: str = ""
    among: bool = False

    def __str__(self) -> str:
        if not self.names:
            return "nothing fitted"
        free = (
            f"{len(self.names)} free number{'s' * (len(self.names) > 1)} ({', '.join(self.names)})"
        )
        return (
            f"{free} fitted to {self.to}; this row "
            f"{'is among them' if self.among else 'is predicted'}"
        )


NOTHING = Fit()

SHARED = ("scheme", "quantity", "options")  # fields that the sides of a conclusion take over
NAN = float("nan")
FILES = resources.files("jaxilc.scenarios") / "printed"

# Quantities of the first j trials of a scheme, see `reproduction`, besides `best_trial`.
OVER_TRIALS = ("rms_rise", "rms_spread")
# What a printed number is: printed for the first time; printed again, as in "no change"; or
# computed by the paper from printed ones, as a percentage is. Only the first are counted.
NUMBER, REPEATED, DERIVED = KINDS = ("number", "repeated", "derived")
# How the numbers of the sides of a conclusion follow each other.
FALLS, NO_RISE, ALIKE = ORDERS = ("falls", "does not rise", "alike")
# Endings of quantities that compare two schemes in percent: by how much smaller the error of the
# first is than that of the second, and its share of it.
COMPARED = ("_improvement", "_share")


class Published(NamedTuple):
    """A number to compare with, of a paper or of other software; no simulation uses it.

    scheme: name of the scheme
    trial: number of the trial, None for a scheme that does not learn
    quantity: `settled_error`, `max_error`, `rms`, `best_trial` (the best of the first `trial` ones)
        or a quantity of the scenario; one of `OVER_TRIALS`; or one of these with an ending of
        `COMPARED`, such as `rms_improvement`
    value: the printed number [the unit in which the quantity is shown]
    source: place in the paper
    options: options of the scenario with which the number was obtained
    reading: what the paper leaves open at this place, and how it was read
    at_most: whether it is printed as a bound, "less than"; the bound is met where it is kept
    fitted: what was fitted to printed numbers for it, `NOTHING` if nothing was, None if unknown
    agreement: for a number that other software computed from the same equations, the relative
        difference within which ours agrees with it; None for a number of a paper
    against: the scheme with which `scheme` is compared, for a quantity with an ending of
        `COMPARED`, else empty
    searched: the experiment that searched a space of readings for this row, empty if none did
    words: the printed words, or the place in a table
    kind: one of `KINDS`
    set: values of the scenario that are not those of the paper, by path, for a conclusion
    """

    scheme: str
    trial: int | None
    quantity: str
    value: float
    source: str
    options: tuple[tuple[str, object], ...] = ()
    reading: str = ""
    at_most: bool = False
    fitted: Fit | None = None
    agreement: float | None = None
    against: str = ""
    searched: str = ""
    words: str = ""
    kind: str = NUMBER
    set: tuple[tuple[str, object], ...] = ()

    @property
    def base(self) -> str:
        """The quantity that is compared with that of another scheme, or the quantity itself."""
        for ending in COMPARED if self.against else ():
            if self.quantity.endswith(ending):
                return self.quantity.removesuffix(ending)
        return self.quantity

    @property
    def of_one_run(self) -> bool:
        """Whether the number can be read off a trial of one scheme, so that `run` shows it."""
        return not self.against and self.quantity not in OVER_TRIALS


class Conclusion(NamedTuple):
    """A sentence that a paper concludes with, as numbers of ours that have an order.

    says: what the paper concludes, in our words
    source, words: place in the paper, and its words
    order: `falls`, each side is smaller than the one before; `does not rise`, none is larger;
        `alike`, the largest is at most twice the smallest
    sides: what is simulated for each side, or a number
    """

    says: str
    source: str
    words: str
    order: str
    sides: tuple[Published | float, ...]


def agreement_of(printed: str) -> float:
    """The `agreement` of a number that other software prints as this text, such as "0.0040917".

    It is 1e-6, or half a unit of the last printed digit where the print is coarser.
    """
    half = Decimal(1).scaleb(int(Decimal(printed).as_tuple().exponent)) / 2
    return max(1e-6, float(half / abs(Decimal(printed))))


@cache
def file_of(name: str) -> dict[str, Value]:
    """The file `printed/NAME.toml` of a scenario, lists as tuples. Its tables are

    chosen: texts on what the paper leaves open, and what was chosen
    [readings.READING]: more such texts, and the numbers of a reading of the paper
    [fits.FIT]: `names` of free numbers, and printed numbers `to` which they were fitted
    [every_row], [[rows]]: fields of `Published`, where `how` is its reading, `fit` one or several
        fits, and `among` whether they were fitted to this row. The rows of `each` share the others.
        A value that is text is given as printed, with the agreement of its digits. A field that
        depends on the reading is a table of values by reading.
    [[conclusions]]: fields of `Conclusion`; those of `Published` hold for each of its `sides`,
        which may have others, and further options. The conclusions of `each` share the others.
    """
    text = (FILES / f"{name}.toml").read_text("utf-8")
    return _with_tuples(tomllib.loads(text))


def _with_tuples(of: Value) -> Value:
    if isinstance(of, dict):
        return {key: _with_tuples(value) for key, value in of.items()}
    return tuple(_with_tuples(value) for value in of) if isinstance(of, list) else of


class Readings(dict[str, T]):
    """The readings of a paper by name, as objects of a kind made of their numbers.

    A reading that is not there raises ValueError naming those that are.
    """

    def __init__(self, name: str, kind: Callable[..., T]):
        self.paper = name
        for reading, of in file_of(name)["readings"].items():
            self[reading] = kind(**{key: value for key, value in of.items() if key != "chosen"})

    def __missing__(self, reading: str) -> T:
        raise ValueError(not_one_of(f"{self.paper}: reading = {reading!r}", reading, self))


def published(name: str, reading: str = "") -> tuple[Published, ...]:
    """The printed rows of a scenario, under a reading if the paper has several."""
    found = file_of(name)
    rows = [
        found.get("every_row", {}) | {k: v for k, v in several.items() if k != "each"} | one
        for several in found["rows"]
        for one in several.get("each", ({},))
    ]
    return tuple(_row(found, fields, reading) for fields in rows)


def conclusions(name: str, reading: str = "") -> tuple[Conclusion, ...]:
    """What a paper concludes, under a reading if the paper has several."""
    found = file_of(name)
    several: list[Conclusion] = []
    usual = {k: of for k, of in found.get("every_row", {}).items() if k in SHARED}
    for of in found.get("conclusions", ()):
        own = {name: of[name] for name in ("says", "source", "words")}
        common = {name: value for name, value in of.items() if name in (*SHARED, "trial")}
        for one in of.get("each", ({},)):
            sides = []
            for side in of["sides"]:
                layers = (usual, common, one, side)
                options = {k: v for layer in layers for k, v in layer.get("options", {}).items()}
                fields = {"source": of["source"], "value": NAN} | usual | common | one | side
                fields |= {"options": options}
                sides.append(side["value"] if "value" in side else _row(found, fields, reading))
            several.append(Conclusion(**own, order=of.get("order", FALLS), sides=tuple(sides)))
    return tuple(several)


def printed(name: str, reading: str = "", **others: Value) -> dict[str, Value]:
    """The fields of the scenario of a paper that follow from its file and from the list.

    These are its name, title and number of trials, its printed rows, its conclusions, and what was
    chosen where it is open.

    others: values that fields have in place of these
    """
    found = file_of(name)
    of_reading = found["readings"][reading]["chosen"] if reading else ()
    return {
        "name": name,
        "title": LISTED[name].title,
        "trials": LISTED[name].trials,
        "published": published(name, reading),
        "conclusions": conclusions(name, reading),
        "chosen": (*found["chosen"], *of_reading),
    } | others


def _row(found: dict[str, Value], fields: dict[str, Value], reading: str) -> Published:
    """A row of a file, with the fields of a reading."""
    for key, value in list(fields.items()):
        if isinstance(value, dict) and value.keys() <= found.get("readings", {}).keys():
            fields.pop(key)
            fields |= {key: value[reading]} if reading in value else {}
    fits, printed = fields.pop("fit", ()), fields.pop("value")
    used = [found["fits"][fit] for fit in ((fits,) if isinstance(fits, str) else fits)]
    fit = Fit(
        sum((one["names"] for one in used), ()),
        " and ".join(one["to"] for one in used),
        fields.pop("among", False),
    )
    options = fields.pop("options", {}) | ({"reading": reading} if reading else {})
    if isinstance(printed, str):
        fields["agreement"], printed = agreement_of(printed), float(printed)
    return Published(
        trial=fields.pop("trial", None), value=printed, options=tuple(options.items()),
        set=tuple(fields.pop("set", {}).items()), reading=fields.pop("how", ""), fitted=fit,
        **fields,
    )  # fmt: skip
