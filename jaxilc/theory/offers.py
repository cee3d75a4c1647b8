"""How far a law may go with a margin: the largest cutoff, the largest gain, the best lead."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..filters import ZeroPhaseButterworth
from ..learning.machine import Machine
from ..pytree.named_paths import get_at
from ..schemes import Scheme
from ..signals.task import Task
from .by_frequency import largest_of
from .filtered_law import Change, Lines, best_lead, largest_cutoff, largest_gain
from .law import law_of
from .loop import Loop
from .over_frequency import lines
from .parts_of_law import Places, rounded, with_change, with_low_pass
from .q_filter import Offer, Question, curves_of, floor_of, law_on

CUTOFF, GAIN, LEAD = "largest cutoff", "largest gain", "best lead, largest cutoff"
ATTEMPTS = 5  # to keep the margin between the lines too
FINENESS = 1e-4
NEAREST = 4  # of the worst plants on the grid, whose largest value is enclosed for an offer
LEADS = 30  # longest change of the lead that is tried, at least [samples]


def offers_of(
    found: Question, inner: Lines, machine: Machine, scheme: Scheme, task: Task, margin: float
) -> list[Offer]:
    """The largest cutoff, the largest gain and the best lead that keep a margin.

    Each is changed alone, except that the best lead comes with the largest cutoff that it allows.
    Where the scheme has no filter, one is offered on top of it. What the lines of the grid allow is
    enclosed between them on the worst plants, and reduced until the margin is kept there too.
    """
    offers, lead, allowed = [], _lead(scheme, found.places), 1 - margin
    for what in kinds(found.places):
        target = allowed
        for _ in range(ATTEMPTS):
            change = changed(what, [inner], found.now.change, target, 2 / task.duration, lead)
            if change is None:
                break
            offer = _offer(what, change, found, inner, machine, scheme, task)
            if offer.peak <= allowed:
                top = offer.peak
                scheme_then = scheme_of(scheme, found.places, change)
                offers.append(offer._replace(floor=floor_of(machine, scheme_then, task, top)))
                break
            target -= 2 * (offer.peak - allowed) + FINENESS
    return offers


def kinds(places: Places | None = None) -> list[str]:
    """What can be changed in a law."""
    if places is None:
        return [CUTOFF, GAIN, LEAD]
    filtered = bool(places.cutoff or places.gains)
    return [CUTOFF] * filtered + [GAIN] * bool(places.gains) + [LEAD] * bool(places.lead)


def changed(
    what: str, several: Sequence[Lines], now: Change, allowed: float, lowest: float, lead: int
) -> Change | None:
    """The change that is offered, on lines of laws without their filter; None if there is none.

    what:   CUTOFF, GAIN or LEAD
    lowest: [Hz] least cutoff that is offered
    lead:   of the law as it is, which the change must not make negative [samples]
    """
    if what == GAIN:
        gain = largest_gain(several, now, allowed)
        return None if gain is None else now._replace(gain=rounded(gain))
    if what == CUTOFF:
        cutoff = largest_cutoff(several, now, allowed, lowest)
        return None if cutoff is None else now._replace(cutoff=rounded(cutoff))
    tried = range(-lead, max(LEADS, 2 * lead) + 1)
    best = best_lead(several, now, allowed, tried, lowest)
    return None if best is None else now._replace(lead=best[0], cutoff=rounded(best[1]))


def scheme_of(scheme: Scheme, places: Places, change: Change) -> Scheme:
    """The scheme with a change; with a filter around its learning part where it has none."""
    made = with_change(scheme, places.of(scheme, change))
    if places.cutoff or not np.isfinite(change.cutoff):
        return made
    return with_low_pass(made, ZeroPhaseButterworth(change.cutoff, order=change.order)) or made


# How it is done
# --------------------------------------------------------------------------------------------------


def _offer(what, change: Change, found: Question, inner: Lines, machine, scheme, task) -> Offer:
    """The offer of a change, without its floor."""
    made = scheme_of(scheme, found.places, change)
    law, (keep, L) = law_of(made, task), law_on(made, task, inner.f)
    sizes = np.max(np.abs(keep - L * inner.P), axis=1)
    worst = {0, *np.argsort(-sizes)[:NEAREST].tolist()}
    top = max(_enclosed(law, found.tried.loops[i], task) for i in worst)
    reach = curves_of(inner._replace(keep=keep, L=L)).learned_up_to
    settings = found.places.of(scheme, change)
    adds = not found.places.cutoff and bool(np.isfinite(change.cutoff))
    return Offer(what, settings, change, top, reach, np.nan, adds)


def _enclosed(law, loop: Loop, task: Task) -> float:
    return float(largest_of(law, loop, task, lines(task, None, [loop])).value)


def _lead(scheme: Scheme, places: Places) -> int:
    return int(get_at(scheme, places.lead)) if places.lead else 0
