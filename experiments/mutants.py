"""How many small mistakes in the package the tests catch.

Lines are drawn at random, and on each an operator or a constant is changed, in a copy of the
repository. Files of tests run until one fails, for a given time: those first that name most of what
the module defines. `--out` writes what was found; `--again` reads such a file and
makes the same mistakes, so that the tests of two versions can be compared.

    python experiments/mutants.py --count 60 --seed 1 --seconds 120 --out mutants.json
"""

import argparse
import ast
import json
import os
import random
import re
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
OTHER = {
    ast.Add: ("+", "-"),
    ast.Sub: ("-", "+"),
    ast.Mult: ("*", "/"),
    ast.Div: ("/", "*"),
    ast.Lt: ("<", ">="),
    ast.LtE: ("<=", "<"),
    ast.Gt: (">", "<="),
    ast.GtE: (">=", ">"),
    ast.Eq: ("==", "!="),
    ast.NotEq: ("!=", "=="),
    ast.And: ("and", "or"),
    ast.Or: ("or", "and"),
}
NOT_RUN = ("test_notebooks.py", "test_examples.py", "test_promises.py", "test_guide.py")


def mistakes_in(text: str) -> dict[int, list]:
    """Return for each line of a module what can be changed there: (line, start, end, new)."""
    found: dict[int, list] = {}
    lines = text.splitlines()

    def between(left: ast.expr, right: ast.expr, kind: type) -> None:
        old, new = OTHER.get(kind, (None, None))
        if old is None or left.end_lineno != right.lineno:
            return
        row = left.end_lineno
        start = len(lines[row - 1].encode()[: left.end_col_offset].decode())
        end = len(lines[row - 1].encode()[: right.col_offset].decode())
        at = re.search(rf"(?<= ){re.escape(old)}(?= )", lines[row - 1][start:end])
        if at:
            change = (row, start + at.start(), start + at.end(), new)
            found.setdefault(row, []).append(change)

    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.BinOp):
            between(node.left, node.right, type(node.op))
        elif isinstance(node, ast.BoolOp):
            between(node.values[0], node.values[1], type(node.op))
        elif isinstance(node, ast.Compare):
            between(node.left, node.comparators[0], type(node.ops[0]))
        elif isinstance(node, ast.Constant) and node.lineno == node.end_lineno:
            if isinstance(node.value, bool):
                new = str(not node.value)
            elif isinstance(node.value, int | float):
                new = repr(node.value + 1 if isinstance(node.value, int) else 2 * node.value + 1)
            else:
                continue
            line = lines[node.lineno - 1].encode()
            start, end = (
                len(line[:n].decode()) for n in (node.col_offset, node.end_col_offset or 0)
            )
            found.setdefault(node.lineno, []).append((node.lineno, start, end, new))
    return found


def drawn(count: int, seed: int) -> list[dict]:
    """Draw lines of the package, each line as likely as any other, and a change on each."""
    rng, lines = random.Random(seed), []
    for path in sorted((ROOT / "jaxilc").rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        where = path.relative_to(ROOT).as_posix()
        lines += [(where, text.splitlines(), c) for c in mistakes_in(text).values()]
    chosen = []
    for where, text, changes in rng.sample(lines, count):
        row, start, end, new = rng.choice(changes)
        line = text[row - 1]
        changed = line[:start] + new + line[end:]
        chosen.append({"file": where, "row": row, "line": line, "changed": changed})
    return chosen


def tests_of(where: str, root: Path) -> list[str]:
    """Return the files of tests that name what a module defines, those with most names first."""
    module, text = Path(where), (root / where).read_text(encoding="utf-8")
    defined = re.findall(r"^(?:def|class) (\w+)|^([A-Z]\w+) = ", text, re.MULTILINE)
    names = sorted({"".join(one) for one in defined} | {module.stem})
    family = f"tests/{module.parts[1].removesuffix('.py')}/"
    ranked = []
    for path in (root / "tests").rglob("test_*.py"):
        test = path.relative_to(root).as_posix()
        of_family = test.startswith(family) or test == f"tests/test_{module.stem}.py"
        words = re.findall(r"\w+", path.read_text(encoding="utf-8"))
        there = len(set(words) & set(names))
        if path.name not in NOT_RUN and (there or of_family):
            own = module.stem in path.stem
            ranked.append((-own, -(2 * there + of_family), path.stat().st_size, test))
    return [test for *_, test in sorted(ranked)]


def catcher(root: Path, where: str, seconds: float) -> tuple[str | None, float]:
    """Return the first file of tests that fails, or None within this time, and the time taken.

    Both are seconds of a processor, which others may use, too.
    """
    begun, environment = used(), {**os.environ, "PYTHONPATH": str(root)}
    for test in tests_of(where, root):
        left = int(seconds - (used() - begun))
        if left < 5:
            break
        limited = f"ulimit -t {left}; exec {sys.executable} -m pytest -x -p no:cacheprovider {test}"
        done = subprocess.run(
            ["bash", "-c", limited], cwd=root, env=environment, capture_output=True
        )
        if done.returncode not in (0, 5, -signal.SIGKILL, -signal.SIGXCPU):
            return test, used() - begun
    return None, used() - begun


def used() -> float:
    """Return the processor time of all processes that have been started here and have ended."""
    return sum(resource.getrusage(resource.RUSAGE_CHILDREN)[:2])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=60)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=120.0, help="of tests for each mistake")
    parser.add_argument("--again", type=Path, help="make the mistakes of this file")
    parser.add_argument("--out", type=Path, help="write what was found")
    given = parser.parse_args()
    if given.again:
        mistakes = json.loads(given.again.read_text(encoding="utf-8"))
    else:
        mistakes = drawn(given.count, given.seed)
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True)
    with tempfile.TemporaryDirectory() as folder:
        for name in listed.stdout.splitlines():
            (Path(folder) / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, Path(folder) / name)
        for mistake in mistakes:
            path = Path(folder) / mistake["file"]
            whole = path.read_text(encoding="utf-8")
            rows = whole.split("\n")
            at = [i for i, line in enumerate(rows) if line == mistake["line"]]
            if not at:
                print(f"gone      {mistake['file']}: {mistake['line'].strip()}", flush=True)
                mistake["caught"] = "gone"
                continue
            rows[min(at, key=lambda i: abs(i + 1 - mistake["row"]))] = mistake["changed"]
            path.write_text("\n".join(rows), encoding="utf-8")
            test, took = catcher(Path(folder), mistake["file"], given.seconds)
            path.write_text(whole, encoding="utf-8")
            mistake["caught"] = test
            what = f"{mistake['file']}:{mistake['row']}: {mistake['changed'].strip()}"
            print(f"{'caught  ' if test else 'survived'} {took:4.0f} s  {what}  {test}", flush=True)
            if given.out:
                given.out.write_text(json.dumps(mistakes, indent=1), encoding="utf-8")
    left = [m for m in mistakes if m["caught"] != "gone"]
    print(f"{sum(bool(m['caught']) for m in left)} of {len(left)} caught")


if __name__ == "__main__":
    main()
