"""Numbers to compare with, of papers and of other software, and what was fitted to them."""

from __future__ import annotations

from decimal import Decimal
from typing import NamedTuple


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

# Quantities of the first j trials of a scheme, see `reproduction`, besides `best_trial`.
OVER_TRIALS = ("rms_rise", "rms_spread")
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


def agreement_of(printed: str, rtol: float = 1e-6) -> float:
    """The `agreement` of a number that other software prints as this text, such as "0.0040917".

    It is rtol, or half a unit of the last printed digit where the print is coarser.
    """
    half = Decimal(1).scaleb(int(Decimal(printed).as_tuple().exponent)) / 2
    return max(rtol, float(half / abs(Decimal(printed))))
