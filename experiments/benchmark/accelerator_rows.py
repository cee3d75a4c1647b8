"""The rows of `accelerator.py`: which there are, what they will cost, and their table.

Nothing here uses JAX.
"""

from __future__ import annotations

import math
import textwrap
from typing import Any, NamedTuple

FIRST_GRADIENT = 12  # cost of a gradient in forward runs, until one is measured
MEASURED = "measured"
FAILED = "failed"  # the first word of a status other than for lack of time or memory
UNMEASURED = "NO ACCELERATOR: run on CPU devices in small sizes; unmeasured on accelerators."


class Sizes(NamedTuple):
    """The sizes of the rows.

    samples: number of samples of a trial
    few, trials: numbers of trials, of rows that vary lanes or unrolling and of the others
    machines, lanes, unroll: the numbers that are varied, in rising order
    """

    samples: int
    few: int
    trials: int
    machines: tuple[int, ...]
    lanes: tuple[int, ...]
    unroll: tuple[int, ...]


ACCELERATOR = Sizes(
    samples=2000,
    few=8,
    trials=80,
    machines=(1024, 10**4, 10**5, 10**6),
    lanes=tuple(2**i for i in range(12, 19)),
    unroll=(1, 4, 16, 64),
)
CPU = Sizes(200, 2, 4, (100, 1000), (16, 64, 256), (1, 2, 4))


class Row(NamedTuple):
    """What is timed; the lanes are None for those that jaxilc takes."""

    what: str
    machines: int
    trials: int
    lanes: int | None = None
    unroll: int = 1
    precision: str = "float64"


def planned(sizes: Sizes, devices: int = 1, usual: int = 1) -> list[Row]:
    """All rows, the most important first.

    Lanes grow by a factor of four from row to row, so that the cost of a row follows from the one
    before. The lanes between come later, and so does unrolling by the largest number, which takes
    long to compile.

    devices: number of devices, each of which has the lanes of a row
    usual: samples in a pass of the rows that do not vary them
    """
    coarse, fine, middle = sizes.lanes[::2], sizes.lanes[1::2], sizes.lanes[len(sizes.lanes) // 2]
    ends, between = (sizes.machines[0], sizes.machines[-1]), sizes.machines[1:-1]
    single: dict[str, Any] = {"precision": "float32"}

    def by_lanes(what, lanes, **options):
        return [Row(what, n * devices, sizes.few, n, usual, **options) for n in lanes]

    def by_machines(what, machines, **options):
        return [Row(what, n, sizes.trials, None, usual, **options) for n in machines]

    def by_unroll(what, unroll, **options):
        return [Row(what, middle * devices, sizes.few, middle, n, **options) for n in unroll]

    rows = [
        *by_lanes("forward", coarse),
        *by_machines("forward", ends),
        *by_unroll("forward", sizes.unroll[:-1]),
        *by_lanes("gradient", coarse),
        *by_machines("gradient", ends[:1]),
        *by_lanes("forward", coarse, **single),
        *by_machines("forward", ends, **single),
        *by_unroll("gradient", sizes.unroll[:-1]),
        *by_machines("forward", between),
        *by_machines("gradient", between),
        *by_lanes("gradient", coarse, **single),
        *by_unroll("forward", sizes.unroll[:-1], **single),
        *by_lanes("forward", fine),
        *by_lanes("gradient", fine),
        *by_unroll("forward", sizes.unroll[-1:]),
        *by_machines("gradient", ends[1:]),
        *by_unroll("gradient", sizes.unroll[-1:]),
    ]
    return list(dict.fromkeys(rows))


def nearest(row: Row, rows: list[dict[str, Any]]) -> dict[str, Any] | None:
    """The measured row that is most alike; None where nothing was measured.

    What is computed counts first, then the precision, and then lanes (or machines, for a row
    without) and unrolling.
    """

    def unlike(other):
        far = abs(math.log2((row.lanes or row.machines) / other["lanes"]))
        far += abs(math.log2(row.unroll / other["unroll"]))
        return row.what != other["what"], row.precision != other["precision"], far

    return min((r for r in rows if r["status"] == MEASURED), key=unlike, default=None)


def predicted(row: Row, lanes: int, passes: int, near: dict[str, Any] | None) -> float:
    """The seconds to compile a row and to run it twice; 0 where nothing was measured.

    Each pass of the loop takes as long as in the measured row `near`, and longer in proportion to
    the lanes where there are more.
    """
    if near is None:
        return 0.0
    first = row.what == "gradient" != near["what"]
    a_pass = near["seconds_a_pass"] * max(1.0, lanes / near["lanes"])
    compiling = near["compile_seconds"] * max(1.0, row.unroll / near["unroll"])
    chosen = 2 if row.lanes is None else 1  # a program is compiled to choose the lanes
    return chosen * compiling * (4 if first else 1) + 2 * passes * a_pass * (
        FIRST_GRADIENT if first else 1
    )


def failed(found: dict[str, Any]) -> bool:
    """Whether nothing was checked, or a check or row failed, not for lack of time or memory."""
    checks = [check["held"] for check in found["checks"]]
    rows = [row["status"].startswith(FAILED) for row in found["rows"]]
    return not checks or not all(checks) or any(rows)


def best_unroll(rows: list[dict[str, Any]], what: str, precision: str) -> tuple[int, float] | None:
    """The samples in a pass that took least time, and how many times as fast as one sample it is.

    None where fewer than two were measured.
    """
    by: dict[tuple[int, ...], dict[int, float]] = {}
    for row in rows:
        if row["status"] == MEASURED and (row["what"], row["precision"]) == (what, precision):
            alike = by.setdefault((row["machines"], row["lanes"], row["trials"]), {})
            alike[row["unroll"]] = row["ns_a_step"]
    most = max(by.values(), key=len, default={})
    if len(most) < 2 or 1 not in most:
        return None
    best = min(most, key=lambda unroll: most[unroll])
    return best, most[1] / most[best]


COLUMNS = "{:<8} {:>8} {:>3} {:>7} {:>3} {:>2} {:>9} {:>8} {:>6} {:>7} {:>6}"
HEADER = ("", "machines", "J", "lanes", "un", "b", "run s", "ns/step", "band %", "MB", "comp s")
LEGEND = """\
J trials; un: samples in a pass of the loop; b: bytes of a number; ns/step: of
one sample of one trial of one machine; band: share of the bandwidth; MB on one
device; comp: compiling"""


def table(found: dict[str, Any]) -> str:
    """The results as text of at most 80 columns."""
    lines = [] if found.get("accelerator", True) else [UNMEASURED]
    lines += [f"{name}: {found[name]}" for name in ("device", "ended") if name in found]
    if "copy_gb_a_second" in found:
        copied = f"a copy moves {found['copy_gb_a_second']:.4g} GB/s"
        lines.append(f"{copied}; an empty pass of a loop takes {found['pass_us']:.3g} us")
    lines += [_check(check) for check in found["checks"]] or ["The numbers were not checked."]
    timed = [row for row in found["rows"] if row["status"] == MEASURED]
    if timed:
        lines += ["", COLUMNS.format(*HEADER), *(_line(row) for row in timed), LEGEND]
    left = [row for row in found["rows"] if row["status"] != MEASURED]
    if left:
        lines += ["", "Not measured:", *map(in_words, left)]
    return "\n".join([*lines, "", *_findings(found)]).rstrip()


def in_words(row: dict[str, Any]) -> str:
    """A check or a row in one line, to follow the progress."""
    if "check" in row:
        return _check(row)
    if row["status"] == MEASURED:
        return _line(row)
    return textwrap.fill(f"{_name(row)}: {row['status']}", 80, subsequent_indent="    ")


def _check(check: dict[str, Any]) -> str:
    held = "ok" if check["held"] else "WRONG"
    off = "not known" if check["off_by"] is None else f"off by {check['off_by']:.1e}"
    against = f"{check['check']:<17} against {check['against']:<12}"
    return f"{held:<6}{against} {off}, allowed {check['allowed']:.0e}"


def _line(row: dict[str, Any]) -> str:
    size = 8 if row["precision"] == "float64" else 4
    return COLUMNS.format(
        row["what"],
        row["machines"],
        row["trials"],
        row["lanes"],
        row["unroll"],
        size,
        f"{row['seconds']:.3g}",
        f"{row['ns_a_step']:.3g}",
        f"{100 * row['share_of_bandwidth']:.1f}",
        f"{row['bytes'] / 1e6:.4g}",
        f"{row['compile_seconds']:.1f}",
    )


def _name(row: dict[str, Any]) -> str:
    lanes = "" if row["lanes"] is None else f", {row['lanes']} lanes"
    unrolled = "" if row["unroll"] == 1 else f", unroll {row['unroll']}"
    of = f"{row['machines']} x {row['trials']}"
    return f"  {row['what']} {row['precision']}, {of}{lanes}{unrolled}"


def _findings(found: dict[str, Any]) -> list[str]:
    """What the rows say about the table of unrolling and about the CPU, line by line."""
    lines = []
    for precision in ("float64", "float32"):
        same = [r for r in found["rows"] if r["precision"] == precision]
        off = [r["off_by"] for r in same if r.get("off_by") is not None]
        if off:
            lines.append(f"{precision}: results of rows of a kind differ by {max(off):.1e} at most")
    for what in ("forward", "gradient"):
        best = best_unroll(found["rows"], what, "float64")
        if best is not None:
            count, times = f"{best[0]} samples in a pass", f"{best[1]:.3g} times"
            lines += [
                f"{what}: {count} are fastest, {times} as fast as 1",
                f"  jaxilc takes {found['usual_unroll']} (UNROLL in jaxilc/runtime/lanes.py)",
            ]
    if "cpu_seconds_1024" in found:
        seconds = f"{found['cpu_seconds_1024']:.3g} s"
        lines.append(f"1024 machines x 80 x 2000 take {seconds} on {found['cpu_cores']} CPU cores")
    return lines
