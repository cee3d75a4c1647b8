"""|Q (1 - L P)| of a P-type law on measured frequency responses, line by line.

On the line k of a record the plant lies within s_k = sigmas std_k of what was measured, and

    |Q (1 - L P_k)| + |Q L| s_k < 1

is enough for all these plants. Between the lines, below the first and above the last, nothing is
proved: a resonance that is narrower than the spacing of the lines does not show.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.signal import find_peaks

from ..filters import ZeroPhaseButterworth
from ..pytree.ranges import require
from ..schemes import Filtered, PIDType
from .filtered_law import Change, Lines, low_pass
from .measured import MeasuredResponse
from .offers import changed, kinds
from .q_filter import Curves, Offer, curves_of

LINES_IN_WIDTH = 4  # lines within the half-power width of a resonance that show it well
HEIGHT = 3.0  # dB by which a peak stands out
UNSEEN = 0.05  # |Q| above the last line that is worth a warning
FEWEST = 3  # lines below the cutoff


class PLaw(NamedTuple):
    """u_{j+1} = Q (u_j + gain e_j[k+1+lead]), with Q as `ZeroPhaseButterworth`.

    gain:   [unit of u per unit of y]
    lead:   [samples]
    cutoff: [Hz]
    order:  of one pass of Q
    dt:     sample time [s]
    """

    gain: float
    lead: int
    cutoff: float
    order: int
    dt: float

    @property
    def scheme(self) -> Filtered:
        learning = PIDType(gamma_p=self.gain, lead=self.lead)
        return Filtered(learning, ZeroPhaseButterworth(self.cutoff, order=self.order))

    def check(self) -> None:
        """Raises ValueError for a number that is not allowed."""
        require("", "dt", self.dt, "(0, inf)")
        require("", "lead", self.lead, "[0, inf)", whole=True)
        require("", "order", self.order, "[1, 100]", whole=True)
        if not np.isfinite(self.gain) or self.gain == 0:
            raise ValueError(f"gain = {self.gain:g} is not allowed; allowed is any other number")
        if not 0 < self.cutoff < 0.5 / self.dt:
            raise ValueError(
                f"cutoff = {self.cutoff:g} Hz is outside its allowed range (0, {0.5 / self.dt:g}), "
                f"Nyquist at dt = {self.dt:g} s"
            )


class Spacing(NamedTuple):
    """A resonance of a record, and how many of its lines lie within its half-power width.

    frequency, width: [Hz]
    lines: number of lines within the width
    """

    frequency: float
    width: float
    lines: float

    @property
    def fine(self) -> bool:
        return self.lines >= LINES_IN_WIDTH


class RecordTest(NamedTuple):
    """The answer for one record.

    curves: on its lines; `high` is the robust value |Q (1 - L P)| + |Q L| s
    peak:   the largest robust value
    worst:  its frequency [Hz]
    resonances: of the record
    ends:   first and last line [Hz]
    unseen: largest |Q| beyond the last line
    """

    curves: Curves
    peak: float
    worst: float
    resonances: list[Spacing]
    ends: tuple[float, float]
    unseen: float


class MeasuredQuestion(NamedTuple):
    """The answer over several records: a test of each, the largest of them, and offers."""

    tests: list[RecordTest]
    offers: list[Offer]
    now: Offer

    @property
    def peak(self) -> float:
        return max(test.peak for test in self.tests)

    @property
    def top(self) -> int:
        """The index of the worst record."""
        return int(np.argmax([test.peak for test in self.tests]))


def measured_question(
    records: Sequence[MeasuredResponse], law: PLaw, *, sigmas: float = 3.0, margin: float = 0.1
) -> MeasuredQuestion:
    """The test of a law on records, and how far it may go with a margin on every line.

    sigmas: s_k in units of the standard deviation of a line. For a complex normal scatter a line
            lies further away with the probability exp(-sigmas^2)

    Raises ValueError for a number outside its range, a line above the Nyquist frequency, and a
    record that starts above the cutoff or has fewer than 3 lines below it.
    """
    law.check()
    require("", "sigmas", sigmas, "[0, inf)")
    for i, record in enumerate(records):
        need_lines(record, law, f"record {i + 1}" if len(records) > 1 else "the record")
    inner = [lines_of(record, law, sigmas) for record in records]
    tests = [_tested(lines, law, record) for lines, record in zip(inner, records, strict=True)]
    now = Change(1.0, 0, law.cutoff, law.order)
    lowest = max(float(record.frequencies[0]) for record in records)
    offers = []
    for what in kinds():
        change = changed(what, inner, now, 1 - margin, lowest, law.lead)
        if change is not None:
            offers.append(_offer(what, change, law, records, sigmas))
    peak = max(test.peak for test in tests)
    reach = min(test.curves.learned_up_to for test in tests)
    return MeasuredQuestion(tests, offers, Offer("as it is", {}, now, peak, reach, np.nan))


def need_lines(record: MeasuredResponse, law: PLaw, name: str) -> None:
    """Raises ValueError where a record has no lines that a law can be tested on."""
    f, nyquist = record.frequencies, 0.5 / law.dt
    if f[-1] > nyquist * (1 + 1e-9):
        raise ValueError(
            f"{name} has a line at {f[-1]:g} Hz; allowed is up to {nyquist:g} Hz, Nyquist at dt = "
            f"{law.dt:g} s"
        )
    below = int(np.sum(f <= law.cutoff))
    if below < FEWEST:
        raise ValueError(
            f"{name} starts at {f[0]:g} Hz and has {below} lines up to the cutoff of "
            f"{law.cutoff:g} Hz; needed are {FEWEST} at least"
        )


def lines_of(record: MeasuredResponse, law: PLaw, sigmas: float) -> Lines:
    """The lines of a record with the law without its filter."""
    f = np.asarray(record.frequencies, float)
    L = law.gain * np.exp(2j * np.pi * f * law.dt * (1 + law.lead))
    P, scatter = np.asarray(record.response)[None], sigmas * np.asarray(record.std)[None]
    return Lines(f, P, scatter, np.ones(len(f), complex), L, law.dt)


def spacings(record: MeasuredResponse) -> list[Spacing]:
    """The resonances of a record, by peaks of |P| that stand out by 3 dB, with their widths."""
    f, size = record.frequencies, np.abs(record.response)
    level = 20 * np.log10(np.maximum(size, 1e-300))
    peaks, _ = find_peaks(level, prominence=HEIGHT)
    if not len(peaks):
        return []
    left, right = np.array([_half_power(size**2, peak) for peak in peaks]).T
    at = np.arange(len(f))
    return [
        Spacing(float(f[p]), float(np.interp(b, at, f) - np.interp(a, at, f)), float(b - a))
        for p, a, b in zip(peaks, left, right, strict=True)
    ]


# How it is done
# --------------------------------------------------------------------------------------------------


def _tested(inner: Lines, law: PLaw, record: MeasuredResponse) -> RecordTest:
    Q = low_pass(inner.f, law.cutoff, law.dt, law.order)
    curves = curves_of(inner._replace(keep=Q * inner.keep, L=Q * inner.L))
    top = int(np.argmax(curves.high))
    ends = float(inner.f[0]), float(inner.f[-1])
    unseen = float(Q[-1]) if ends[1] < 0.499 / law.dt else 0.0
    return RecordTest(
        curves, float(curves.high[top]), float(inner.f[top]), spacings(record), ends, unseen
    )


def _half_power(power, peak: int) -> tuple[float, float]:
    """Where the power first falls to half of a peak on either side, in units of lines."""
    ends = []
    for step in (-1, 1):
        i = peak
        while 0 <= i + step < len(power) and power[i] > power[peak] / 2:
            i += step
        above, below = power[i - step], power[i]
        share = (above - power[peak] / 2) / (above - below) if below < above else 1.0
        ends.append(i - step + step * min(share, 1.0))
    return ends[0], ends[1]


def _offer(what, change: Change, law: PLaw, records, sigmas: float) -> Offer:
    made = law._replace(
        gain=law.gain * change.gain, lead=law.lead + change.lead, cutoff=change.cutoff
    )
    tests = [_tested(lines_of(record, made, sigmas), made, record) for record in records]
    now = {"gain": law.gain, "lead": law.lead, "cutoff": law.cutoff}
    then = {"gain": made.gain, "lead": made.lead, "cutoff": made.cutoff}
    settings = {name: value for name, value in then.items() if value != now[name]}
    reach = min(test.curves.learned_up_to for test in tests)
    return Offer(what, settings, change, max(test.peak for test in tests), reach, np.nan)
