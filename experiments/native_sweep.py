"""Where the time of a sweep goes, by XLA and by programs compiled for this processor.

    python experiments/native_sweep.py cao-2019 [PICTURE.svg]

Each of both runs in a process of its own that finds nothing on disk, in one that finds what the
first left there, and there once more, when its programs are in the RAM. Times are wall-clock, with
one compiler at a time, so that no two of them overlap.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import jax
import matplotlib
from matplotlib.figure import Figure

import jaxilc
from jaxilc import scenarios
from jaxilc.native import run
from jaxilc.runtime.start import keep_programs
from jaxilc.sweeps import Sweep, host

MACHINES = 1024
OF_JAX = {  # names of stages, by JAX's own
    "/jax/core/compile/jaxpr_trace_duration": "trace",
    "/jax/core/compile/jaxpr_to_mlir_module_duration": "trace",
    "/jax/core/compile/backend_compile_duration": "XLA compiles",
}
STAGES = ("trace", "plan and LLVM", "XLA compiles", "learning", "the rest")
COLOURS = ("#9ecae1", "#3182bd", "#fdae6b", "#31a354", "#bdbdbd")


def measured(name: str, native: str) -> dict:
    """Return the seconds of each stage of the first run, and those of the second run."""
    jaxilc.setup(native=native == "on")
    keep_programs()
    host.COMPILERS = 1
    spent = Counter()
    jax.monitoring.register_event_duration_secs_listener(
        lambda event, seconds, **_: spent.update({OF_JAX.get(event): seconds})
    )
    make = run.Compiled.__init__

    def made(*arguments, **options):
        begun, before = time.perf_counter(), spent["trace"] + spent["XLA compiles"]
        make(*arguments, **options)
        others = spent["trace"] + spent["XLA compiles"] - before
        spent["plan and LLVM"] += time.perf_counter() - begun - others

    run.Compiled.__init__ = made
    run.Compiled.compile = lambda *_: None  # beside the comparison; the first call compiles then
    of = scenarios.load(name)
    sweep = Sweep(
        of.machine, of.schemes, of.task, of.trials, uncertainty=of.uncertainty, machines=MACHINES
    )
    took, first = [], {}
    for _ in range(2):
        begun = time.perf_counter()
        sweep.run()
        took.append(time.perf_counter() - begun)
        first = first or dict(spent)
    stages = {stage: first.get(stage, 0.0) for stage in STAGES} | {"learning": took[1]}
    return {"first": stages | {"the rest": took[0] - sum(stages.values())}, "again": took[1]}


def compared(name: str) -> dict[str, dict[str, float]]:
    """Return the seconds of each stage by row of the picture."""
    rows: dict[str, dict[str, float]] = {}
    for native, by in (("off", "XLA"), ("on", "native")):
        with tempfile.TemporaryDirectory() as folder:
            for state in ("nothing on disk", "programs on disk"):
                done = subprocess.run(
                    [sys.executable, __file__, name, "--one", native],
                    env=os.environ | {"JAXILC_CACHE": folder},
                    check=True, capture_output=True, text=True,
                )  # fmt: skip
                found = json.loads(done.stdout.splitlines()[-1])
                rows[f"{by}, {state}"] = found["first"]
        rows[f"{by}, again"] = dict.fromkeys(STAGES, 0.0) | {"learning": found["again"]}
    return rows


def draw(rows: dict[str, dict[str, float]], path: Path) -> None:
    """Draw a bar for each row, of the stages one after the other."""
    axes = (figure := Figure(figsize=(8, 3.2), layout="constrained")).subplots()
    for number, of in enumerate(rows.values()):
        left = 0.0
        for stage, colour in zip(STAGES, COLOURS, strict=True):
            label = stage if number == 0 else None
            axes.barh(number, of[stage], left=left, color=colour, label=label)
            left += of[stage]
        axes.text(left, number, f" {left:.1f} s", va="center")
    axes.set_yticks(range(len(rows)), [*rows])
    axes.invert_yaxis()
    axes.set_xlabel("time [s]")
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(loc="outside upper center", ncols=len(STAGES), frameon=False)
    axes.margins(x=0.08)
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": "jaxilc"}):
        figure.savefig(path, metadata={"Date": None})


def main(name: str, *options: str) -> None:
    """Print the seconds by stage, and draw them where a picture is named."""
    if options[:1] == ("--one",):
        print(json.dumps(measured(name, options[1])))
        return
    rows = compared(name)
    for row, of in rows.items():
        stages = ", ".join(f"{stage} {of[stage]:.2f}" for stage in STAGES if of[stage])
        print(f"{row}: {sum(of.values()):.1f} s ({stages})")
    if options:
        draw(rows, Path(options[0]))


if __name__ == "__main__":
    main(*sys.argv[1:])
