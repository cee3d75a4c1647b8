"""What is left when the machine stops a command at a random instant, and what its repetition gives.

`run`, `worst-case`, `learn-law`, `design` and `next` work on a small plant. Each attack makes the
command in a process of its own, kills it (SIGKILL) at a random instant of its usual time, and calls
it again: `design` and `learn-law` with `--resume`. Counted is whether the kill hit, whether all
files that have their final names are whole, and whether the repetition gives the same numbers, the
same files and the same exit code as the command that nothing stopped. The compiled programs are
kept in one folder, which is empty at first, so that early kills stop their writing, too.
"""

import contextlib
import importlib
import json
import os
import re
import shutil
import signal
import sys
import tempfile
import time
import tomllib
import traceback
from pathlib import Path

import numpy as np
import output
from campaigns_with_faults import call

PLANT = """trials = 4
[plant]
kind = "state_space"
A = [[0.6]]
B = [[0.4]]
C = [[1.0]]
dt = 0.001
[machine.sensor]
noise = 1e-3
[task]
dt = 0.001
reference = { function = "sinusoid", amplitude = 1.0, frequency = 50.0, duration = 0.06 }
[schemes.ilc]
class = "PIDType"
gamma_p = 0.8
[uncertainty."plant.B"]
distribution = "uniform"
low = 0.9
high = 1.1
relative = true
"""
WRITTEN = ("--report", "report.json", "--out")
NEXT = ("next", "--state", "campaign", "--measured", "trial.csv", "--out", "next.csv")
COMMANDS = {
    "run": ("run", "axis.toml", *WRITTEN, "out"),
    "worst-case": ("worst-case", "axis.toml", "--scheme", "ilc", "--starts", "3", "--steps", "4",
                   "--draws", "20", *WRITTEN, "out"),
    "learn-law": ("learn-law", "axis.toml", "--taps", "5,3", "--machines", "9", "--steps", "6",
                  "--state", "out", *WRITTEN, "law.toml"),
    "design": ("design", "axis.toml", "--law", "p-type", "--law", "pd-type", "--machines", "9",
               "--steps", "4", "--state", "out", *WRITTEN, "law.toml"),
    "next": (*NEXT, "--report", "report.json"),
}  # fmt: skip
RESUMED = ("learn-law", "design")
KILLS = {"run": 70, "worst-case": 60, "learn-law": 10, "design": 10, "next": 50}  # by their time
# Loaded once; the processes that are killed are forks of this one.
LOADED = ("scipy.signal", *(f"jaxilc.outcomes.{x}" for x in ("designing", "running", "tuning")))
# Numbers of a report that are other ones at each call: times, and the versions and files of it.
TIMES = re.compile(r"time|second|took|date|duration|environment|version|path|file|folder")


def begun(command: str, folder: Path) -> None:
    """Make the files that a command needs; the folder becomes the current one."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    os.chdir(folder)
    Path("axis.toml").write_text(PLANT)
    if command == "next":
        code, said = call(
            "next", "--state", "campaign", "--scenario", "axis.toml", "--out", "u.csv"
        )
        assert code == 0, said
        k = np.arange(61)
        rows = [f"{t:.9g},{y:.9g},0" for t, y in zip(k * 1e-3, np.sin(k) * 1e-3, strict=True)]
        Path("trial.csv").write_text("t,y,u\n" + "\n".join(rows) + "\n")


def forked(make) -> int:
    """The number of a process that calls `make` and ends with its exit code."""
    child = os.fork()
    if not child:
        code = 1
        try:
            null = os.open("said.txt", os.O_WRONLY | os.O_CREAT | os.O_APPEND)
            for stream in (1, 2):
                os.dup2(null, stream)
            code = make()
        except BaseException:
            traceback.print_exc()
        os._exit(code)
    return child


def ended(child: int, limit: float = 600.0) -> int | None:
    """The exit code of a process; None where it was killed, which happens after `limit` seconds."""
    until = time.monotonic() + limit
    while time.monotonic() < until:
        found, status = os.waitpid(child, os.WNOHANG)
        if found:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.002)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return None


def made(words) -> int:
    code, said = call(*words)
    print(said)
    return code


def again(command: str, words) -> int:
    """The exit code of a command after one that was killed."""
    code, said = call(*words, *(("--resume",) if command in RESUMED else ()))
    if command == "next" and code == 2 and "is trial 1, which was learned from already" in said:
        code, said = call(*NEXT[:3], *NEXT[5:])  # the trial is there; the input is written again
    print(said)
    return code


def plain(value):
    """JSON without the entries that `TIMES` names."""
    if isinstance(value, dict):
        return {k: plain(v) for k, v in value.items() if not TIMES.search(k)}
    return [plain(v) for v in value] if isinstance(value, list) else value


def answer(command: str) -> dict:
    """What a command has left, without what is different at each call."""
    found = {}
    if command == "next":
        trial = json.loads(Path("campaign/000001/manifest.json").read_text())
        return {"errors": trial["figures"], "next": Path("next.csv").read_text()}
    for file in (Path("law.toml"), Path("report.json")):
        if file.exists():
            text = file.read_text()
            found[file.name] = plain(json.loads(text)) if file.suffix == ".json" else text
    return found


def whole() -> list[str]:
    """The files of the current folder that have their final names and cannot be read."""
    wrong = []
    for file in Path().rglob("*"):
        if not file.is_file() or "unfinished" in str(file) or file.name == "said.txt":
            continue
        try:
            if file.suffix == ".json":
                json.loads(file.read_text())
            elif file.suffix == ".toml":
                tomllib.loads(file.read_text())
            elif file.suffix == ".npz":
                with np.load(file) as arrays:
                    [arrays[name] for name in arrays]
            elif file.suffix == ".csv":
                assert file.read_text().endswith("\n")
            elif file.suffix == ".png":
                assert file.read_bytes().endswith(b"IEND\xaeB`\x82")
        except (ValueError, AssertionError, OSError, EOFError) as error:
            wrong.append(f"{file}: {error}")
    return wrong


def attacked(command: str, kills: int, root: Path, rng) -> dict:
    """The row of one command."""
    words, folder = COMMANDS[command], root / command
    usual = []
    for _ in range(2):  # the first one compiles
        begin(command, folder)
        start = time.monotonic()
        code = ended(forked(lambda: made(words)))
        usual.append(time.monotonic() - start)
        assert code == 0, (folder / "said.txt").read_text()
        expected = answer(command)
        assert len(expected) == (1 if command in ("run", "worst-case") else 2), expected
    row = {"command": command, "time": usual[1], "kills": 0, "went on or began again, same": 0}
    row |= {"half-written": 0, "other": 0}
    while row["kills"] < kills:
        begin(command, folder)
        child = forked(lambda: made(words))
        time.sleep(rng.uniform(0.02, 1.0) * usual[1])
        if os.waitpid(child, os.WNOHANG)[0]:
            continue  # it had ended
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        row["kills"] += 1
        broken = whole()
        code = ended(forked(lambda: again(command, words)))
        found = answer(command) if code == 0 else code
        row["half-written"] += bool(broken)
        same = found == expected
        row["went on or began again, same"] += same
        row["other"] += not same
        if broken or not same:
            print(command, broken, found, (folder / "said.txt").read_text()[-500:], flush=True)
    return row


def begin(command: str, folder: Path) -> None:
    code = ended(forked(lambda: begun(command, folder) or 0))
    os.chdir(folder)
    assert code == 0, Path("said.txt").read_text()


def main(*commands: str) -> None:
    for name in LOADED:
        importlib.import_module(name)
    rng, rows = np.random.default_rng(42), []
    with tempfile.TemporaryDirectory() as name, contextlib.chdir(name):
        os.environ["JAXILC_CACHE"] = f"{name}/programs"
        for command in commands or COMMANDS:
            rows.append(attacked(command, KILLS[command], Path(name), rng))
            print(rows[-1], flush=True)
    output.write_rows(output.folder(__file__) / "kills.csv", rows)


if __name__ == "__main__":
    main(*sys.argv[1:])
