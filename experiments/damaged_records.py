"""What becomes of damaged trial files and design files: put to `next`, `certify` and `design`.

A campaign on a simulated drive has learned from two trials; the file of the third one is damaged,
as by a bit, a lost end, lines that are exchanged, doubled or lost, columns with each other's names,
numbers that are none, another encoding, or it is the file of another drive, trial or kind. A plant
file that `design` wrote, and the state that it left, are damaged likewise. Right is the answer to
the whole file; or, where a plain reader finds other numbers in a file, the answer to these, which
is counted apart, with the largest change that it makes to the next input. All else is a refusal in
one line. `silent` counts other answers.
"""

import contextlib
import csv
import functools
import io
import json
import math
import shutil
import tempfile
import tomllib
from pathlib import Path

import numpy as np
import output
from campaigns_with_faults import PLANT, begun, call
from exchanged_entries import attacks
from kills import COMMANDS, plain
from kills import PLANT as SMALL
from two_mass_rig import Rig, read_schedule, stroke, write_trial

LARGE = 0.01  # of the largest next input: a change that a damage may not make without a word


def flipped(rng, text: bytes, other: bytes) -> bytes:
    changed, bit = bytearray(text), int(rng.integers(8 * len(text)))
    changed[bit // 8] ^= 1 << bit % 8
    return bytes(changed)


def cut(rng, text: bytes, other: bytes) -> bytes:
    return text[: int(rng.integers(len(text) - 1))]


def _lines(change):
    @functools.wraps(change)
    def damaged(rng, text: bytes, other: bytes) -> bytes:
        lines = text.split(b"\n")
        change(rng, lines, *sorted(rng.choice(len(lines) - 1, 2, replace=False)))
        return b"\n".join(lines)

    return damaged


@_lines
def exchanged(rng, lines, a, b):
    lines[a], lines[b] = lines[b], lines[a]


@_lines
def doubled(rng, lines, a, b):
    lines.insert(b, lines[a])


@_lines
def lost(rng, lines, a, b):
    del lines[a : a + int(rng.integers(1, 4))]


@_lines
def no_number(rng, lines, a, b):
    cells = lines[b].split(b",")
    word = rng.choice([b"nan", b"inf", b"-inf", b"1e999", b"", b"#N/A", b"--", b"1,5", b"0x1p3"])
    cells[rng.integers(len(cells))] = bytes(word)
    lines[b] = b",".join(cells)


@_lines
def other_columns(rng, lines, a, b):
    cells = lines[0].split(b",")
    i, j = rng.choice(len(cells), 2, replace=False) if len(cells) > 1 else (0, 0)
    cells[i], cells[j] = cells[j], cells[i]
    lines[0] = b",".join(cells)


def encoded(rng, text: bytes, other: bytes) -> bytes:
    codes = ("utf-16", "utf-16-le", "utf-32", "cp037", "utf-7", "utf-8-sig", "latin-1")
    return ("µ" * int(rng.integers(2)) + text.decode()).encode(codes[rng.integers(7)], "replace")


def of_another(rng, text: bytes, other: bytes) -> bytes:
    return other


OF_TRIALS = {
    flipped: 60, cut: 25, exchanged: 20, doubled: 20, lost: 15, no_number: 25, other_columns: 10,
    encoded: 10, of_another: 15,
}  # fmt: skip
OF_PLANTS = {flipped: 30, cut: 8, exchanged: 8, doubled: 6, lost: 6, no_number: 6, encoded: 6}


def columns_of(text: bytes) -> dict | None:
    """The columns of a file as a plain reader finds them; None where it finds none."""
    try:
        header, *rows = csv.reader(io.StringIO(text.decode("utf-8-sig")))
        found = [[float(cell) if cell else None for cell in row] for row in rows if row]
        if len({len(row) for row in [header, *found]}) > 1:
            return None
        return dict(zip(header, zip(*found, strict=True), strict=True))
    except (ValueError, UnicodeDecodeError, csv.Error):
        return None


def tables_of(text: bytes) -> dict | None:
    """The tables of a plant file; None where there are none, or a number is none."""
    try:
        return tomllib.loads(text.decode("utf-8-sig"))
    except (ValueError, UnicodeDecodeError):
        return None


def refused_in_a_line(said: str) -> bool:
    return "Traceback" not in said and said.rstrip().split("\n")[-1].startswith("error: ")


def counted(rows: list, where: str, kind: str, outcome: str, change: float = math.nan) -> None:
    """Add an outcome to the row of its kind."""
    row = next((r for r in rows if (r["file"], r["damage"]) == (where, kind)), None)
    if row is None:
        row = {"file": where, "damage": kind, "tried": 0, "right": 0, "refused": 0}
        row |= {"as its numbers say": 0, "largest change": 0.0, "silent": 0, "traceback": 0}
        rows.append(row)
    row["tried"] += 1
    row[outcome] += 1
    row["largest change"] = float(np.fmax(row["largest change"], change))


def trials(folder: Path, rows: list, rng) -> None:
    """Attack the third trial of a campaign."""
    r, state, schedule = stroke(), folder / "state", folder / "next.csv"
    trial, files = folder / "trial.csv", []
    code, said = begun(folder, PLANT, state, schedule)
    for j in range(1, 4):
        assert code == 0, said
        u = read_schedule(schedule)
        write_trial(trial, r, Rig().play(u, j), u)
        files.append(trial.read_bytes())
        if j == 3:
            shutil.copytree(state, folder / "before")
            write_trial(folder / "other.csv", r, Rig(position_gain=30.0, delay=9).play(u, j), u)
        code, said = call("next", "--state", state, "--measured", trial, "--out", schedule)
    assert code == 0, said
    right, whole = read_schedule(schedule), columns_of(files[2])
    others = [files[0], files[1], b"", b"\x00" * 999, (folder / "reference.csv").read_bytes()]
    others += [(folder / "other.csv").read_bytes(), schedule.read_bytes(), PLANT.encode()]
    for damage, times in OF_TRIALS.items():
        for i in range(times):
            text = damage(rng, files[2], others[i % len(others)])
            trial.write_bytes(text)
            shutil.rmtree(state)
            shutil.copytree(folder / "before", state)
            schedule.unlink(missing_ok=True)
            code, said = call("next", "--state", state, "--measured", trial, "--out", schedule)
            change = math.nan
            if code:
                line = refused_in_a_line(said) and not schedule.exists()
                outcome = "refused" if line else "traceback"
            else:
                change = float(np.max(np.abs(read_schedule(schedule) - right)) / np.max(right))
                same = columns_of(text) in (None, whole)
                outcome = "as its numbers say"
                if change == 0 or same or change > LARGE:
                    outcome = "right" if change == 0 else "silent"
            counted(rows, "trial", damage.__name__, outcome, change)
            if outcome in ("silent", "traceback"):
                place = next((k for k, (a, b) in enumerate(zip(text, files[2], strict=False))
                              if a != b), -1)  # fmt: skip
                print(outcome, damage.__name__, change, text[place - 20 : place + 20], said[-600:])


def answers(file: Path, command: str) -> tuple[int, object]:
    """What a plant file gives: the first input of a campaign, or what `certify` claims."""
    report, state = file.with_name("report.json"), file.parent / "state"
    shutil.rmtree(state, ignore_errors=True)
    words = ("next", "--state", state, "--scenario", file, "--out", file.parent / "u.csv")
    if command == "certify":
        words = ("certify", file, "--machines", "4", "--trials", "4", "--out", file.parent / "c")
    code, said = call(*words, "--report", report)
    if code:
        return code, said
    numbers = plain(json.loads(report.read_text()))
    return 0, {k: v for k, v in numbers.items() if k not in ("source", "said")}  # its checksum


def plants(folder: Path, rows: list, rng, text: bytes) -> None:
    """Attack a plant file that `design` wrote."""
    file, whole = folder / "law.toml", tables_of(text)
    expected = {}
    for command in ("next", "certify"):
        file.write_bytes(text)
        expected[command] = answers(file, command)
        assert expected[command][0] == 0, expected[command]
    k = 0
    for damage, times in OF_PLANTS.items():
        for _ in range(times):
            file.write_bytes(changed := damage(rng, text, b""))
            command = "certify" if (k := k + 1) % 4 == 0 else "next"
            code, said = answers(file, command)
            if code:
                outcome = "refused" if refused_in_a_line(said) else "traceback"
            elif tables_of(changed) == whole:
                outcome = "right" if said == expected[command][1] else "silent"
            else:
                outcome = "silent" if tables_of(changed) is None else "as its numbers say"
            counted(rows, f"plant file, {command}", damage.__name__, outcome)
            if outcome in ("silent", "traceback"):
                print(outcome, damage.__name__, command, changed[:60], said, flush=True)


def states(folder: Path, rows: list, rng, times: int = 30) -> None:
    """Attack the state that `design` goes on from."""
    whole, law = folder / "out", folder / "law.toml"
    words = [str(w) for w in (*COMMANDS["design"][:-4], "--out", law, "--resume")]
    shutil.copytree(whole, folder / "whole")
    expected = law.read_text()
    listed = list(attacks(folder / "whole" / "state", folder / "whole" / "state"))
    files = [f for f in (folder / "whole" / "state").rglob("*") if f.is_file()]
    for i in range(times):
        shutil.rmtree(whole)
        shutil.copytree(folder / "whole", whole)
        law.unlink(missing_ok=True)
        if i % 2:
            target, source = listed[rng.integers(len(listed))]
            place = whole / target.relative_to(folder / "whole")
            (shutil.rmtree if place.is_dir() else Path.unlink)(place)
            if source is not None:
                shutil.copyfile(source, place)
        else:
            damaged = files[rng.integers(len(files))]
            place = whole / damaged.relative_to(folder / "whole")
            place.write_bytes((flipped, cut)[i % 4 // 2](rng, damaged.read_bytes(), b""))
        code, said = call(*words)
        if code:
            outcome = "refused" if refused_in_a_line(said) else "traceback"
        else:
            outcome = "right" if law.read_text() == expected else "silent"
        counted(rows, "state, design --resume", "exchanged" if i % 2 else "damaged", outcome)
        if outcome in ("silent", "traceback"):
            print(outcome, place, said[-900:], flush=True)


def main() -> None:
    rng, rows = np.random.default_rng(42), []
    with tempfile.TemporaryDirectory() as name:
        trials(Path(name), rows, rng)
    print(*rows, sep="\n", flush=True)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "axis.toml").write_text(SMALL)
        with contextlib.chdir(folder):
            code, said = call(*COMMANDS["design"])
            assert code == 0, said
            states(folder, rows, rng)
            plants(folder, rows, rng, (folder / "law.toml").read_bytes())
    output.write_rows(output.folder(__file__) / "damaged.csv", rows)


if __name__ == "__main__":
    main()
