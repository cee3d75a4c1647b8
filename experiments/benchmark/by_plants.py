"""The benchmark at 1 to 65,536 plants: nanoseconds per sample-step, ratios, compile time, memory.

The rows of a number of plants are written when all of them are measured. The whole takes three
quarters of an hour on two cores. Numba is an opponent where it is installed, and the C programs
where there is a compiler. Gradients and schemes alone are timed for up to 1024 plants; the ratios
of a gradient are to a run without one.
"""

import csv
import sys
from pathlib import Path
from statistics import median

import jaxilc

PLANTS = (1, 16, 1024, 65_536)
WHOLE = 1024  # largest number of plants with more than two turns


def rows(plants):
    import contests
    import ours
    from compare import Programme, measure

    for size in plants:
        whole = size <= WHOLE
        numbers = measure(
            Programme(
                (size,),
                schemes=(*contests.SCHEMES, *(ours.ALONE if whole else ())),
                long=0,
                repeats=5 if whole else 2,
                gradients=whole,
                costs=False,
            )
        )
        for what, contenders in numbers["rows"].items():
            for name, row in contenders.items():
                yield {
                    "what": what.rpartition("/")[0],
                    "contender": name,
                    "plants": size,
                    "ran": f"{row['plants']} x {row['trials']}",
                    "ns best": row["ns_best"],
                    "ns median": row["ns_median"],
                    "cpu ns": row["ns_cpu"],
                    "times ours, median": median(row["ratio"]),
                    "times ours by cpu, median": median(row["cpu_ratio"]),
                    "compile s": row["compile_seconds"],
                    "peak bytes": row["peak_bytes"],
                    "load": numbers["machine_after"]["load"][0],
                }


def main(plants=PLANTS):
    jaxilc.setup()
    path = Path("out") / "experiments" / "benchmark" / "by-plants.csv"
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        for i, row in enumerate(rows(plants)):
            writer = csv.DictWriter(file, list(row), lineterminator="\n")
            if i == 0:
                writer.writeheader()
            writer.writerow(row)
            file.flush()
    print(f"written: {path}")


if __name__ == "__main__":
    main(tuple(map(int, sys.argv[1:])) or PLANTS)
