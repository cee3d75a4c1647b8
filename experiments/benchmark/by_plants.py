"""The benchmark at 1 to 65,536 plants: nanoseconds per sample-step, ratios, compile time, memory.

Each row is written when it is measured. The whole takes three quarters of an hour on two cores.
Numba is an opponent where it is installed, and the C programs where there is a compiler. Gradients
are timed for up to 1024 plants; their ratios are to a run without one.
"""

import csv
import sys
from pathlib import Path

import jaxilc

PLANTS, TRIALS, SAMPLES = (1, 16, 1024, 65_536), 80, 2000
WHOLE = 1024  # largest number of plants with more than two turns


def rows(plants):
    from jaxilc import bench
    from jaxilc.bench import timing
    from jaxilc.bench.computer import computer, in_words

    print(in_words(computer()))
    opponents, notes = bench.opponents()
    for note in notes:
        print(note)
    of_gradients, notes = bench.gradient_opponents(opponents)
    for note in notes:
        print(note)
    for size in plants:
        repeats = 5 if size <= WHOLE else 2
        found = {
            name: bench.compare(
                bench.setting(name, size, TRIALS, SAMPLES), opponents, repeats=repeats
            )
            for name in bench.SCHEMES
        }
        if size <= WHOLE:
            found |= {
                f"{name} gradient": bench.compare_gradients(
                    bench.setting(name, size, TRIALS, SAMPLES), of_gradients, repeats=repeats
                )
                for name in bench.SCHEMES
            }
            found |= {name: bench.alone(name, size, repeats=repeats).rows for name in bench.ALONE}
        found["plant"] = bench.compare_plant(
            bench.setting("cfdl", size, 1, SAMPLES), repeats=repeats
        )
        for what, contenders in found.items():
            for name, row in timing.as_json(contenders).items():
                ratios = sorted(row["cpu_ratio"])
                yield {
                    "what": what,
                    "contender": name,
                    "plants": size,
                    "ran": f"{row['plants']} x {row['trials']}",
                    "ns best": row["ns_best"],
                    "ns median": row["ns_median"],
                    "cpu ns": row["ns_cpu"],
                    "times ours, median": sorted(row["ratio"])[len(ratios) // 2],
                    "times ours by cpu, median": ratios[len(ratios) // 2],
                    "compile s": row["compile_seconds"],
                    "peak bytes": row["peak_bytes"],
                    "load": computer()["load"][0],
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
