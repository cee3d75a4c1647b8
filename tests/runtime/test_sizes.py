"""Sizes are computed before anything is drawn; one too large is refused with what would fit."""

import dataclasses
import json
import re
import subprocess
import sys
from functools import partial

import numpy as np
import pytest
from cases import case, first_order
from gain_case import GAINS, PROBLEM, STATIC
from sweep_case import PLAN

from jaxilc import plants
from jaxilc.identification import Record, identify
from jaxilc.learning import learn
from jaxilc.plants import InBlocks
from jaxilc.runtime import capacity
from jaxilc.schemes import CFDLMFAPC
from jaxilc.signals import Task, references
from jaxilc.sweeps import run_schemes
from jaxilc.theory import certify
from jaxilc.tuning import monte_carlo_search, worst_case_search
from jaxilc.tuning.trade_off import by_trials
from jaxilc.uncertainty import draw

ROOM = 2 * 10**9
HUGE = 10**12
LONG = {"duration": 1e9, "dt": 1e-3}
MACHINE, SCHEME, TASK = case("cfdl_sign")
RECORD = Record(np.sin(np.arange(400.0))[:, None], np.sin(np.arange(401.0))[:, None], 1e-3)


def of_problem(**options):
    return partial(dataclasses.replace, PROBLEM, **options)


def of_sweep(**options):
    return partial(dataclasses.replace, PLAN, **options)


REFUSED = {
    "learn": (lambda: learn(MACHINE, SCHEME, TASK, 10**18), "trials"),
    "learn by NumPy": (lambda: learn(MACHINE, SCHEME, TASK, np.int32(2 * 10**9)), "trials"),
    "run": (lambda: run_schemes(MACHINE, {"a": SCHEME}, TASK, 10**9), "trials"),
    "sweep of machines": (of_sweep(machines=10**9), "machines"),
    "sweep of trials": (of_sweep(trials=HUGE), "trials"),
    "sweep without a draw": (of_sweep(machines=10**18, uncertainty={}), "machines"),
    "tuning on machines": (of_problem(machines=10**9), "machines"),
    "tuning held out": (of_problem(held_out=10**9), "held_out"),
    "tuning from starts": (of_problem(starts=10**9), "starts"),
    "tuning of steps": (of_problem(steps=HUGE), "steps"),
    "tuning of trials": (of_problem(trials=HUGE), "trials"),
    "comparison of machines": (lambda: PROBLEM.comparison(machines=10**9), "machines"),
    "comparison of trials": (lambda: PROBLEM.comparison(trials=HUGE), "trials"),
    "budgets": (lambda: by_trials(PROBLEM, (2, HUGE)), "trials"),
    "monte-carlo": (lambda: draw(STATIC, GAINS, 10**9), "machines"),
    "sobol": (lambda: draw(STATIC, GAINS, 10**9, sampling="sobol"), "machines"),
    "latin-hypercube": (lambda: draw(STATIC, GAINS, 10**9, sampling="latin-hypercube"), "machines"),
    "certify": (lambda: certify(MACHINE, SCHEME, TASK, HUGE, {}, {}), "trials"),
    "climbs from starts": (lambda: worst_case_search(None, STATIC, GAINS, starts=10**9), "starts"),
    "climbs of steps": (lambda: worst_case_search(None, STATIC, GAINS, steps=HUGE), "steps"),
    "search by chance": (lambda: monte_carlo_search(None, STATIC, GAINS, HUGE), "evaluations"),
    "sinusoid": (lambda: references.sinusoid(1.0, 1.0, **LONG), "samples"),
    "sinusoid without end": (
        lambda: references.sinusoid(1.0, 1.0, duration=1e300, dt=1e-300),
        "samples",
    ),
    "multisine": (
        lambda: references.multisine(np.ones(400), np.ones(400), duration=1000.0, dt=1e-3),
        "samples",
    ),
    "chirp": (lambda: references.chirp(1.0, 1.0, 2.0, **LONG), "samples"),
    "s_curve": (
        lambda: references.s_curve([0, 1], velocity=1e-9, acceleration=1.0, jerk=1.0, dt=1e-3),
        "samples",
    ),
    "m_sequence": (lambda: references.m_sequence(32, hold=1000), "samples"),
    "preview": (
        lambda: learn(MACHINE, CFDLMFAPC(P=10**6), Task(np.zeros(400), dt=1e-3), 1),
        "preview",
    ),
    "fits from starts": (lambda: identify(RECORD, starts=10**9), "starts"),
    "blocks": (
        lambda: learn(
            dataclasses.replace(
                MACHINE, plant=InBlocks(plants.voice_coil("printed").sampled(1e-3), 10**4)
            ),
            SCHEME,
            TASK,
            1,
        ),
        "length",
    ),
    "a long task": (lambda: learn(MACHINE, SCHEME, Task(np.zeros(10**7), dt=1e-3), 1), "samples"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_a_size_that_does_not_fit_is_refused_with_what_would(monkeypatch, name):
    monkeypatch.setattr(capacity, "host_bytes", lambda: ROOM)
    call, parameter = REFUSED[name]
    with pytest.raises(
        ValueError, match=rf"of memory, where 2 GB are available; .*\b{parameter} = \d+.* would fit"
    ) as refusal:
        call()
    assert "\n" not in str(refusal.value)


def test_more_parameters_than_a_record_tells_are_refused_before_they_are_made():
    record = Record(np.ones((400, 1)), np.arange(401.0)[:, None], 1e-3)
    with pytest.raises(
        ValueError, match="the record is too short: 281 samples to fit 153 parameters"
    ):
        identify(record, poles=50, pairs=50)
    with pytest.raises(ValueError, match=r"poles = 1e\+09 is outside its allowed range \[0, 50\]"):
        identify(record, poles=10**9)


def test_a_program_that_does_not_fit_is_refused_before_it_runs(monkeypatch, tmp_path):
    monkeypatch.setattr(capacity, "host_bytes", lambda: 2000)
    problem = dataclasses.replace(PROBLEM, uncertainty={}, machines=1, held_out=0, steps=1)
    with pytest.raises(
        ValueError,
        match=r"a step of all starts takes .* of memory, where 2 kB are available; "
        r"take fewer trials",
    ):
        problem.run(tmp_path / "state")
    assert not (tmp_path / "state").exists()


def test_what_would_fit_fits_and_no_more(monkeypatch):
    monkeypatch.setattr(capacity, "host_bytes", lambda: 1000)

    def need(plants, trials):
        return 3 * plants * trials + 7 * trials + 20

    with pytest.raises(
        ValueError,
        match=r"a: plants = 90 and trials = 5 take 1.41 kB of memory, where 1 kB are available",
    ) as refusal:
        capacity.check_size("a", need, plants=90, trials=5)
    fits = {
        name: int(value)
        for name, value in re.findall(r"(\w+) = (\d+)", str(refusal.value).split(";")[1])
    }
    assert fits == {"plants": 63, "trials": 3}
    capacity.check_size("a", need, plants=63, trials=5)
    capacity.check_size("a", need, plants=90, trials=3)
    for counts in ({"plants": 64, "trials": 5}, {"plants": 90, "trials": 4}):
        with pytest.raises(ValueError, match="would fit"):
            capacity.check_size("a", need, **counts)
    with pytest.raises(ValueError, match="not even 1 would fit"):
        capacity.check_size("a", lambda plants: 2000 + plants, plants=3)


def test_the_limits_of_control_groups_count(monkeypatch, tmp_path):
    groups, process = tmp_path / "cgroup", tmp_path / "self"
    process.mkdir()
    monkeypatch.setattr(capacity, "GROUPS", groups)
    monkeypatch.setattr(capacity, "OF_PROCESS", process)
    (process / "cgroup").write_text("4:memory:/job/step\n3:cpuset:/\n0::/job/step\n")
    assert list(capacity._of_groups()) == []
    for folder, names, limit in (
        ("memory/job", capacity.OF_GROUP_1, "5000"),
        ("job", capacity.OF_GROUP_2, "9000"),
        ("job/step", capacity.OF_GROUP_2, "max"),
    ):
        (groups / folder).mkdir(parents=True)
        for name, value in zip(names, (limit, "1000"), strict=True):
            (groups / folder / name).write_text(value + "\n")
    (groups / "job" / "memory.stat").write_text("anon 300\ninactive_file 50\n")
    assert list(capacity._of_groups()) == [4000, 8050]
    assert capacity.host_bytes() == 4000


def test_the_last_cache_is_shared_by_cores(monkeypatch, tmp_path):
    monkeypatch.setattr(capacity, "CACHES", tmp_path)
    assert capacity.cache_bytes() is None
    for name, level, size, shared in (("0", 1, "48K", "1"), ("3", 3, "32768K", "0000,000000ff"),
                                      ("2", 2, "1024K", "3")):  # fmt: skip
        (folder := tmp_path / f"index{name}").mkdir()
        for file, text in (("level", level), ("size", size), ("shared_cpu_map", shared)):
            (folder / file).write_text(f"{text}\n")
    assert capacity.cache_bytes() == 4 * 2**20
    (folder / "level").write_text("4\n")
    (folder / "size").write_text("64M\n")
    assert capacity.cache_bytes() is None


COMMANDS = """
sweep cao-2019 --samples 300000
sweep cao-2019 --samples 300000 --sampling latin-hypercube
sweep cao-2019 --trials 20000
run cao-2019 --trials 20000
run long.toml
certify cao-2019 --scheme cfdl-mfailc --trials 1000000
tune cao-2019 --scheme cfdl-mfailc --weights lam --samples 100000000
tune cao-2019 --scheme cfdl-mfailc --weights lam --steps 100000000
tune cao-2019 --scheme cfdl-mfailc --weights lam --starts 1000000
tune cao-2019 --scheme cfdl-mfailc --weights lam --unseen 1000000
tune cao-2019 --scheme cfdl-mfailc --weights lam --compare-trials 1000000
pareto cao-2019 --scheme cfdl-mfailc --weights lam --budgets 5,1000000000000
pareto cao-2019 --scheme cfdl-mfailc --weights lam --second effort --samples 100000000
worst-case cao-2019 --scheme cfdl-mfailc --starts 100000000
worst-case cao-2019 --scheme cfdl-mfailc --draws 1000000000
worst-case cao-2019 --scheme cfdl-mfailc --evaluations 1000000000
next --state campaign --scenario long.toml --out next.csv
"""
PLANT = (
    first_order()
    + """[task.reference]
function = "sinusoid"
amplitude = 1.0
frequency = 1.0
duration = {}
[schemes.ilc]
class = "PIDType"
"""
)
LIMITED = """
import json, resource, sys, time
import jax
from jaxilc.cli import entry
from jaxilc.runtime import capacity, start
start.setup()
jax.numpy.zeros(3).block_until_ready()
limit = capacity._status("VmSize") + capacity.SPARE + 10**9  # of which 10^9 bytes are for us
resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
assert capacity.host_bytes() <= 10**9
start.setup = lambda **_: None
said = []
class Said:
    is_terminal = False
    def print(self, text, **_):
        said.append(text)
entry.err = Said()
for command in sys.stdin.read().split("\\n"):
    sys.argv, start = ["jaxilc", *command.split()], time.perf_counter()
    code = 0
    try:
        entry.main()
    except SystemExit as stop:
        code = stop.code
    found = [command, code, said.pop() if said else "", time.perf_counter() - start]
    print(json.dumps(found), file=sys.stderr, flush=True)
"""


@pytest.mark.thorough
def test_every_command_reckons_within_the_limit_of_the_process(tmp_path):
    """Each size would fit into 16 GB or no machine, and not here; a small sweep does."""
    for name, duration in (("long", 10000.0), ("short", 0.01)):
        (tmp_path / f"{name}.toml").write_text(PLANT.format(duration))
    commands = [*COMMANDS.strip().split("\n"), "sweep short.toml --samples 4 --trials 2"]
    done = subprocess.run(
        [sys.executable, "-c", LIMITED], input="\n".join(commands), cwd=tmp_path,
        capture_output=True, text=True,
    )  # fmt: skip
    rows = [json.loads(line) for line in done.stderr.splitlines() if line.startswith("[")]
    assert [row[0] for row in rows] == commands, done.stderr[-2000:]
    for command, code, said, _ in rows[:-1]:
        assert code == 2, (command, said)
        assert re.search(r"of memory, where \S+ \w+ are available; .* would fit", said), (
            command,
            said,
        )
    assert rows[-1][1] == 0, rows[-1]
    assert {path.name for path in tmp_path.iterdir()} == {"long.toml", "short.toml", "out"}
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["sweep-short"]
