"""The tables of `jaxilc bench` fit 80 columns without being divided."""

import pytest

from jaxilc.bench.ours_alone import GRADIENT, Alone
from jaxilc.bench.timing import OURS, Cost, Row
from jaxilc.cli import bench_tables as tables
from jaxilc.cli.titled_table import Console


def row(name, seconds=0.02):
    turns = (seconds, 1.1 * seconds, 1.2 * seconds)
    return Row(name, 1024, 80, 1e-12, 12.34, turns, turns, 1234 * 10**6, 163_840_000)


def rows(**seconds):
    return {name: row(name, s) for name, s in ({OURS: 0.2} | seconds).items()}


TIMES = Alone({OURS: row(OURS), GRADIENT: row(GRADIENT, 2.0)}, 0.0305, ("lam",) * 33)
SHOWN = {
    "of a contest": (
        tables.contest_table(
            "cfdl, 1024 plants",
            rows(**{"NumPy batch": 1234.5, "python-control": 4321.0, "C limit": 0.05}),
            "times ours",
        ),
        ["NumPy batch", "1024 x 80", "7535", "6172", "12", "1234"],
    ),
    "of gradients": (
        tables.contest_table(
            "gradient of ffdl, 1024 plants, in runs of jaxilc without it",
            rows(**{"8 weights reverse": 1.2345, "Numba, P+1 runs": 2.5}),
            "runs",
        ),
        ["8 weights reverse", "7.53", "6.17-6.17"],
    ),
    "of schemes": (
        tables.alone_table(
            "li-2020: 1024 machines, 40 trials of 9998 samples",
            {"fixed-filter": TIMES, "stop": Alone({OURS: row(OURS)}, 0.1)},
        ),
        ["fixed-filter", "0.122", "0.0305", "4", "100 runs", "33", "12 + 12", "1234"],
    ),
    "of sizes": (
        tables.cost_table("cfdl", {"samples": ({500: 0.05, 2000: 0.1634}, Cost(0.01, 8e-5, 0.04))}),
        ["samples", "500, 2000", "50, 163", "10", "80", "4 %"],
    ),
}


@pytest.mark.parametrize("name", SHOWN)
def test_a_table_is_one_and_no_name_or_number_is_broken(name):
    table, cells = SHOWN[name]
    console = Console(width=80)
    with console.capture() as captured:
        console.print(table)
    text = captured.get()
    assert max(map(len, text.splitlines())) <= 80
    assert text.count("┏") == 1
    assert any(all(cell in line for cell in cells) for line in text.splitlines()), text
