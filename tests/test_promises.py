"""Each sentence of the start page and the guide that promises something is held by something.

A sentence promises where it says never, always, each, all or every, or where it has a number.
Blocks of code, formulae and numbers in tables are left out: `test_examples.py` runs the code.
`promises.toml` says for each sentence, and each such row of a table, what holds it; NUMBERS, below,
has the numbers that follow from the package.
"""

import functools
import importlib
import math
import re
import tomllib
from pathlib import Path

import numpy as np
import pytest
import turns
from typer.main import get_command

from jaxilc import scenarios
from jaxilc.cli import app
from jaxilc.scenarios.published import KINDS, agreement_of

ROOT = Path(__file__).parents[1]
PAGES = {p.name: p for p in [ROOT / "README.md", *sorted((ROOT / ".ci/docs/guide").glob("*.md"))]}
LEDGER = tomllib.loads((ROOT / "tests/promises.toml").read_text(encoding="utf-8"))
BLOCKS = re.compile(
    r"^```.*?^```$|^\$\$.*?\$\$|^\|[^\n]*$|^!\[[^\n]*$|^    [^\n]* → [^\n]*$",
    re.MULTILINE | re.DOTALL,
)
HEADING = re.compile(r"^##+ (.*)$", re.MULTILINE)
PIECE = re.compile(r"\n\s*\n|^#.*$|^(?:- |\d+\. )", re.MULTILINE)  # paragraphs, headings, items
END = re.compile(r"(?<=[.:;?!])\s+(?=[A-Z`*|\[(])")
NAMES = re.compile(r"`[^`]*`|\$[^$]*\$|[A-Z][\w-]+ (?:19|20)\d\d\b")
WORD = re.compile(r"\b(never|always|each|all|every)\b", re.IGNORECASE)
FIRST, REPEATED, DERIVED = KINDS  # what a printed number is
NUMBER = re.compile(r"(?<![\w.^/(=\[-])\d")
TEST = re.compile(r"(tests/[\w/]+\.py)::(test_\w+)")
TO_TWENTY = re.findall(
    r"\w+",
    "zero one two three four five six seven eight nine ten eleven twelve thirteen fourteen fifteen "
    "sixteen seventeen eighteen nineteen twenty",
)
WORDS = {"three quarters": 0.75, "hundred": 100} | {word: n for n, word in enumerate(TO_TWENTY)}


def prose_of(page: str) -> str:
    """Return the text of a page without blocks, tables and the targets of links."""
    text = BLOCKS.sub("\n\n", PAGES[page].read_text(encoding="utf-8"))
    return re.sub(r"\]\([^)\s]*\)", "]", text)


def sentences_of(page: str) -> list[tuple[str, str]]:
    """Return each sentence of a page with the heading that it stands under."""
    _, *parts = HEADING.split(f"## \n{prose_of(page)}")
    found = []
    for heading, text in zip(parts[::2], parts[1::2], strict=True):
        for piece in PIECE.split(text):
            found += [(heading, one) for one in END.split(" ".join(piece.split())) if one]
    return found


def rows_of(page: str) -> list[tuple[str, str]]:
    """Return each row of a table of a page that has one of the words, with its heading."""
    heading, found = "", []
    for line in PAGES[page].read_text(encoding="utf-8").splitlines():
        if line.startswith("#"):
            heading = HEADING.sub(r"\1", line) if line.startswith("##") else ""
        elif line.startswith("|") and WORD.search(line):
            found.append((heading, line))
    return found


def numbers_without_a_reason(page: str, heading: str, sentence: str) -> bool:
    """Whether a sentence has a number that is no name, and that nothing holds."""
    if not NUMBER.search(NAMES.sub("", sentence)) or f"## {heading}" in LEDGER.get(page, {}):
        return False
    return not any(re.search(pattern, sentence) for pattern in NUMBERS.get(page, {}))


@pytest.mark.parametrize("page", PAGES)
def test_each_sentence_that_promises_is_in_the_ledger(page):
    parts = [part for part in LEDGER.get(page, {}) if not part.startswith("## ")]
    open_ = []
    for heading, sentence in sentences_of(page):
        if not any(part in sentence for part in parts) and (
            WORD.search(sentence) or numbers_without_a_reason(page, heading, sentence)
        ):
            open_.append(sentence)
    for heading, row in rows_of(page):
        if f"## {heading}" not in LEDGER.get(page, {}) and not any(part in row for part in parts):
            open_.append(row)
    assert not open_, "\n".join(["what holds these? Say it in tests/promises.toml:", *open_])


@pytest.mark.parametrize("page", LEDGER)
def test_the_ledger_names_sentences_and_tests_that_exist(page):
    found = [*sentences_of(page), *rows_of(page)]
    for part, held in LEDGER[page].items():
        if part.startswith("## "):
            assert part[3:] in {heading for heading, _ in found}, f"{page} has no heading {part}"
        else:
            places = sum(part in sentence for _, sentence in found)
            assert places == 1, f"{part!r} is in {places} sentences of {page}, not in one"
        assert stands(held), f"{page}: {part!r} is held by {held!r}, which is not there"


def stands(held: str) -> bool:
    """Whether what holds a sentence is there: a test, a command, or a word on what it is about."""
    if named := TEST.fullmatch(held):
        file, test = named.groups()
        return (ROOT / file).exists() and f"def {test}(" in (ROOT / file).read_text("utf-8")
    if not held.startswith("measured: "):
        return held.startswith("about: ")
    command, *words = held.removeprefix("measured: ").split()
    if command == "jaxilc":
        return words[0] in get_command(app).commands
    if command == "make":
        return f"\n{words[0]}:" in (ROOT / "Makefile").read_text(encoding="utf-8")
    return command in ("pytest", "du") or (command[-3:] == ".py" and (ROOT / command).exists())


def test_make_test_leaves_no_test_out():
    """What one of its two runs of pytest leaves out the other one has."""
    made = (ROOT / "Makefile").read_text(encoding="utf-8")
    target = re.search(r"^test: .*\n((?:\t.*\n)+)", made, re.MULTILINE)[1]
    assert re.findall(r"pytest -n 2 -m (.*)", target) == ['"not shipped"', "shipped"]


def test_a_thorough_test_has_a_turn_in_one_of_sixteen_commits_or_so(monkeypatch):
    rng = np.random.default_rng(1)
    turns_of = dict.fromkeys((f"tests/a.py::test_{i}" for i in range(50)), 0)
    for _ in range(800):
        monkeypatch.setattr(turns, "_head", functools.partial(str, rng.bytes(20).hex()))
        for name in turns_of:
            turns_of[name] += turns.drawn(name)
    assert 25 < min(turns_of.values()) < max(turns_of.values()) < 85
    assert np.mean([*turns_of.values()]) == pytest.approx(800 / turns.SHARE, rel=0.1)


def test_thorough_tests_of_a_family_are_due_where_the_package_changes_there(monkeypatch):
    changed = "jaxilc/outcomes/words.py\njaxilc/uncertainty.py\ntests/theory/test_bounds.py\n"
    monkeypatch.setattr(turns, "_head", lambda: "0" * 40)
    monkeypatch.setattr(turns, "git", lambda *_: changed)
    monkeypatch.setattr(turns, "_changed", turns._changed.__wrapped__)
    tests = {
        family: [f"tests/{family}/test_a.py::test_{i}" for i in range(50)]
        for family in ("outcomes", "cli", "theory")
    }
    due = {family: sum(map(turns.drawn, names)) for family, names in tests.items()}
    assert due["outcomes"] == due["cli"] == 50
    assert due["theory"] < 15


# Numbers
# --------------------------------------------------------------------------------------------------


def of(name: str):
    """Return a constant, by its module and name; `experiments` are modules of their own."""
    module, _, constant = name.rpartition(".")
    return getattr(importlib.import_module(module), constant)


def default(command: str, option: str):
    """Return what an option of a command is if it is not given."""
    options = get_command(app).commands[command].params
    return next(one.default for one in options if f"--{option}" in one.opts)


@functools.cache
def rows(name: str) -> tuple:
    """Return the numbers of a scenario that `reproduce` compares, without computing ours."""
    return scenarios.load(name).published


def printed() -> list:
    """Return the numbers of papers."""
    return [row for name in scenarios.SCENARIOS for row in rows(name) if row.agreement is None]


def independent() -> list:
    """Return the numbers that the papers print for the first time."""
    return [row for row in printed() if row.kind == FIRST]


def concluded() -> list:
    """Return what each comparison with a conclusion of a paper is about, and where it stands."""
    of = {name: scenarios.load(name).conclusions for name in scenarios.SCENARIOS}
    return [(name, one.source, one.says) for name in of for one in of[name]]


def pinned(file: str, *packages: str) -> tuple[str, ...]:
    """Return the versions of packages in a list, in as many digits as the pages have them."""
    text = (ROOT / ".ci" / file).read_text(encoding="utf-8")
    found = [re.search(rf"^{one}==([\d.]+)", text, re.MULTILINE)[1] for one in packages]
    return tuple(
        ".".join(version.split(".")[: 3 if one == "jax" else 2])
        for one, version in zip(packages, found, strict=True)
    )


def left_by(page: str, heading: str, law: str, column: str) -> float:
    """Return a number of a table of a page."""
    text = PAGES[page].read_text(encoding="utf-8").partition(f"## {heading}\n")[2]
    head, _, *table = re.findall(r"^\|(.*)\|$", text.partition("\n## ")[0], re.MULTILINE)
    at = [cell.strip() for cell in head.split(" | ")].index(column)
    line = next(row for row in table if row.strip().startswith(f"{law} |"))
    return float(line.split(" | ")[at].split("[")[0])


def more(heading: str, law: str, than: str, column: str = "trial 100") -> float:
    """Return how many times the error of a law another one has, in a table of learned laws."""
    one, other = (left_by("learned_laws.md", heading, x, column) for x in (law, than))
    return one / other


SERVO, RIGHT = "A servo with an uncertain resonance", "A zero in the right half-plane"
COIL, BALL = "The voice coil of cao-2019", "The ball screw of milc-2024"
THEORY, DESIGN, BAND = "jaxilc.theory", "jaxilc.design", "jaxilc.hardware.prediction"
NUMBERS = {  # by page: a pattern with numbers in brackets, and the constants that they are
    "README.md": {
        r"sweeps over (\d+) uncertain motors": lambda: default("sweep", "machines"),
        r"sets (\d+) independent printed numbers": lambda: len(independent()),
        r"\(within (\d+) %, a bound kept\)": lambda: 100 * of("jaxilc.scenarios.reproduction.MET"),
        r"of the (\d+) that nothing": lambda: sum(not row.fitted.among for row in independent()),
        r"Of (\d+) comparisons with what": lambda: len(concluded()),
        r"(\d+) numbers of other software": lambda: len(others()),
        r"with Python ([\d.]+) and JAX ([\d.]+),": lambda: (
            "3.11",
            *pinned("requirements.txt", "jax"),
        ),
        r"and with ([\d.]+) and ([\d.]+)\.": lambda: (
            "3.13",
            *pinned("requirements-newest.txt", "jax"),
        ),
        r"\[(\w+) notebooks\]": lambda: len(list(ROOT.glob("notebooks/*.py"))),
    },
    "command_line.md": {
        r"http://127\.0\.0\.1:(\d+)/": lambda: default("explore", "port"),
        r"the band over (\d+) machines": lambda: default("explore", "machines"),
        r"and all (\d+) machines 40 ms": lambda: default("explore", "machines"),
        r"is followed for up to (\d+) inputs: `certify`": f"{THEORY}.rounding.LARGEST",
        r"and what (\d+) simulated runs do": f"{THEORY}.certificates.SEEDS",
        r"Up to (\d+) inputs are followed": f"{THEORY}.rounding.LARGEST",
        r"on (\d+) random machines under each of (\d+) laws, over (\d+) trials": lambda: (
            of("certificates_under_attack.MACHINES"),
            len(of("certificates_under_attack.laws")(1)),
            of("certificates_under_attack.TRIALS"),
        ),
        r"(\w+) of these laws were written a second time": lambda: len(
            of("certificates_under_attack.matrices")()
        ),
        r"some (\d+) frequencies, on (\d+) machines of the uncertainty and, up to (\w+) ": (
            f"{DESIGN}.responses.LINES",
            f"{DESIGN}.responses.MACHINES",
            f"{DESIGN}.responses.CORNERS",
        ),
        r"law the (\d+) with the least predicted": f"{DESIGN}.candidates.SIMULATED",
        r"learning, on (\d+) machines, with a penalty where step 1": f"{DESIGN}.search.TUNED_ON",
        r"From the best of them a law of (\d+) and (\d+) taps": lambda: of(f"{DESIGN}.search.TAPS"),
        r"run on (\d+) machines, the nominal .* has seen, for at least (\d+) trials": lambda: (
            default("design", "machines"),
            of(f"{DESIGN}.judging.judged_trials")(1),
        ),
        r"by the error that (\d+) % of them do not exceed": lambda: (
            100 * of("jaxilc.sweeps.summary.QUANTILES")[-1]
        ),
        r"nominal machine and of the (\w+) that are worst": f"{DESIGN}.judging.ENCLOSED",
        r"nominal machine and the (\w+) that are worst": f"{DESIGN}.judging.ENCLOSED",
        r"looked at on (\d+) other mach.* at most (\w+) times, until none of (\d+) ": (
            f"{DESIGN}.learned.WATCH",
            f"{DESIGN}.by_response.ROUNDS",
            f"{DESIGN}.learned.WATCH",
        ),
        r"least mean log e_J \+ 1/(\d) log": lambda: 1 / of(f"{DESIGN}.learned.RISE"),
        r"some (\d+) frequencies, on (\d+) machines and, up to (\w+) ": (
            f"{DESIGN}.learned.CLOSE",
            f"{DESIGN}.learned.DENSE",
            f"{DESIGN}.responses.CORNERS",
        ),
        r"on (\d+) machines that they have not seen, over (\d+) trials, with the (\w+) laws": (
            lambda: (
                of("designs_judged.JUDGED_ON"),
                of("designs_judged.LONG"),
                len(of(f"{DESIGN}.candidates.LAWS")),
            )
        ),
        r"best of (\d+) P-type laws": lambda: (
            len(of("designs_judged.GAINS"))
            * len(of("designs_judged.CUTOFFS"))
            * of("designs_judged.LEADS")
        ),
        r"drawn ones and, up to (\w+) uncertain": f"{THEORY}.frequency.CORNERS",
        r"affine in each of up to (\w+) uncertain": f"{THEORY}.frequency.CORNERS",
        r"up to (\w+) of its zeros, poles": f"{THEORY}.frequency.MOST_NUMBERS",
        r"At the start, (\d+) machines are drawn": f"{BAND}.MACHINES",
        r"band of a trial holds (\d+) % of them": lambda: 100 * (1 - 2 * of(f"{BAND}.OUTSIDE")),
        r"outside its band in one trial of (\w+),": lambda: 0.5 / of(f"{BAND}.OUTSIDE"),
        r"further out than (\d+) % of the drawn": lambda: 100 * (1 - of(f"{BAND}.RARE")),
        r"one campaign of a (\w+),": lambda: 1 / of(f"{BAND}.RARE"),
        r"(\d+) million samples are .* which is (\d+) trials of (\d+) samples": lambda: (
            of(f"{BAND}.WORK") / 1e6,
            of(f"{BAND}.WORK") // (of(f"{BAND}.MACHINES") * 2000),
            2000,
        ),
        r"more than ([\d,]+) samples together": "jaxilc.hardware.campaign.MOST_SAMPLES",
        r"It is under (\d) MB": lambda: math.ceil(of("jaxilc.figures.report.ROOM") / 1e6),
        r"more than ([\d.]+) times its least": lambda: 1 + of("jaxilc.learning.divergence.GROWTH"),
        r"(\w+) at least\) is more than (\d) % below .* at most (\d) % less": lambda: (
            of("jaxilc.outcomes.words.WINDOW"),
            *[100 * of("jaxilc.outcomes.words.CHANGE")] * 2,
        ),
    },
    "design.md": {
        r"tiles of (\d+) machines, or of (\d+) .*\((\d) MiB\)": lambda: (
            of("jaxilc.runtime.lanes.LANES")["cpu"],
            of("jaxilc.runtime.lanes.LANES")["cpu"] // 2,
            of("jaxilc.runtime.lanes.CACHE")["cpu"] / 2**20,
        ),
        r"as many machines as (three quarters) of": "jaxilc.runtime.lanes.SHARE",
        r"At most (\d+) machines make a tile": "jaxilc.runtime.lanes.WIDE",
        r"plants, (\d+) trials of (\d+) samples": lambda: (
            of("compare.Programme")((1,)).trials,
            of("compare.Programme")((1,)).samples,
        ),
        r"`Tuning` goes forward for up to (\w+)\)": "jaxilc.tuning.problem.FORWARD_UP_TO",
        r"for the weights `(\w+)`, `(\w+)`, `(\w+)`, `(\w+)` and `(\w+)`:": lambda: of(
            "gradients.WEIGHTS"
        ),
        r"agree to (\S+) of the largest slope, .* agrees to (\S+) ": lambda: (
            of("gradients.DIFFERENCES"),
            of("timing.TOLERANCE")["float64"],
        ),
        r"on Linux with Python 3.11, JAX ([\d.]+) and NumPy ([\d.]+),": lambda: pinned(
            "requirements.txt", "jax", "numpy"
        ),
        r"with Python 3.13, JAX ([\d.]+) and NumPy ([\d.]+);": lambda: pinned(
            "requirements-newest.txt", "jax", "numpy"
        ),
        r"JAX ([\d.]+) takes time quadratic": lambda: re.search(
            r"jax>=[\d.]+,!=([\d.]+)", (ROOT / "pyproject.toml").read_text(encoding="utf-8")
        ).groups(),
    },
    "differing.md": {
        r"beside it stand (\d+) simulated runs": f"{THEORY}.certificates.SEEDS",
        r"learning moves more than (\d+) numbers": f"{THEORY}.learning_map.DENSE",
        r"the input has more than (\d+) values": f"{THEORY}.learning_map.DENSE",
    },
    "library.md": {
        r"compares (\d+) such derivatives": lambda: math.prod(
            len(x) if isinstance(x, (tuple, dict)) else x
            for x in (
                of("gradients_under_attack.configurations")(),
                of("gradients_under_attack.METRICS"),
                of("gradients_under_attack.LOSSES"),
                of("gradients_under_attack.MACHINES"),
            )
        )
    },
    "papers.md": {
        r"sets (\d+) printed numbers": lambda: len(printed()),
        r"Counted are the (\d+) that": lambda: len(independent()),
        r"(\d+) repeat a number": lambda: sum(row.kind == REPEATED for row in printed()),
        r"and (\d+) are percentages": lambda: sum(row.kind == DERIVED for row in printed()),
        r"of (\d+) printed bounds": lambda: sum(row.at_most for row in independent()),
        r"Of the (\d+) that are no": lambda: sum(not row.at_most for row in independent()),
        r"To (\d+) of them a number": lambda: sum(row.fitted.among for row in independent()),
        r"The other (\d+) are\s+predicted": lambda: sum(
            not row.fitted.among for row in independent()
        ),
        r"(\d+) of them are compared as an order": lambda: len({*concluded()}),
        r"of these (\d+) comparisons": lambda: len(concluded()),
        r"Of (\d+) comparisons": lambda: len(concluded()),
        r"order within a factor of (\w+)": "jaxilc.scenarios.reproduction.SHAPE",
        r"(\w+) scenarios have two readings": lambda: sum(
            "reading" in scenarios.options(name) for name in scenarios.SCENARIOS
        ),
        r"`cao-2019` \| .*? of (\d+) .*? of (\d+) \|": lambda: [len(rows("cao-2019"))] * 2,
        r"`cao-2019-rig` \| .*? of (\d+) .*? of (\d+) \|": lambda: [len(rows("cao-2019-rig"))] * 2,
        r"`milc-2024` \| .*? of (\d+) .*? of (\d+) \|": lambda: [len(rows("milc-2024"))] * 2,
        r"`xu-2024` \| .*? of (\d+) .*? of (\d+) \|": lambda: [len(rows("xu-2024"))] * 2,
        r"differs by no more than (\S+) of it": lambda: agreement_of("1.0000000000"),
    },
    "paths.md": {
        r"at each corner of (\d) degree": lambda: math.degrees(
            of("jaxilc.signals.tool_path.SMOOTH")
        ),
        r"corner of more than (\d+) degrees": lambda: math.degrees(
            of("jaxilc.signals.tool_path.REVERSAL")
        ),
        r"path of up to ([\d.]+) s \((\d+) samples at least\)": (
            "jaxilc.learning.quantities.LAG",
            "jaxilc.learning.quantities.LEAST",
        ),
        r"In trial (\d+), 95 % of (\d+) machines": (
            "contour_learning.LONG",
            "contour_learning.JUDGED_ON",
        ),
    },
    "theory.md": {
        r"to \$10\^\{(-\d)\}\$ of their size": lambda: math.log10(
            of(f"{THEORY}.enclosure.TOLERANCE")
        ),
        r"up to (\d) MiB for a machine": lambda: of("jaxilc.runtime.lanes.STORED")["cpu"] / 2**20,
    },
    "learned_laws.md": {
        r"learns a law of (\d+) and (\d+) taps": lambda: of(f"{DESIGN}.learned.LearnedLaw").taps,
        r"without a notch has (\d+) times as much error": lambda: more(SERVO, "p-type", "learned"),
        r"ends (\d+) % above the learned law with its weights from a grid, and (\d+) %": lambda: [
            100 * more(SERVO, law, "learned") - 100
            for law in ("p-type-notch, grid", "p-type-notch")
        ],
        r"comes next: ([\d.]+) times as much in the median, (\d+) times on": lambda: (
            more(SERVO, "ffdl-mfailc", "learned"),
            more(SERVO, "ffdl-mfailc", "learned", "worst, 10"),
        ),
        r": (\d) % more for P-type learning with a notch, (\d) % for the .* (\d) % for FFDL": (
            lambda: [
                100 * more(RIGHT, law, "learned", "trial 10") - 100
                for law in ("p-type-notch", "norm-optimal", "ffdl-mfailc")
            ]
        ),
        r"takes (\d+) % of the error of trial 10 away, but norm": lambda: (
            100 - 100 * more(COIL, "learned", "by response", "trial 10")
        ),
        r"for the first 100 samples gain (\d) %": lambda: (
            100 - 100 * more(COIL, "learned, two segments", "learned", "trial 500")
        ),
        r"FFDL-MFAILC has (\d+) times the noise by trial 500": lambda: (
            left_by("learned_laws.md", BALL, "ffdl-mfailc", "trial 500") / 5.2e-4
        ),
    },
}


def others() -> list:
    """Return the numbers of other software."""
    return [row for name in scenarios.SCENARIOS for row in rows(name) if row.agreement is not None]


def number(text: str) -> float | str:
    """Return a number that a page says, in digits or as a word; the text if it is none."""
    try:
        return float(WORDS.get(text.lower(), text.replace(",", "")))
    except ValueError:
        return text


def several(found) -> tuple | list:
    """Return what is one or several as several."""
    return found if isinstance(found, tuple | list) else (found,)


@pytest.mark.parametrize(
    ("page", "pattern"), [(page, pattern) for page in NUMBERS for pattern in NUMBERS[page]]
)
def test_a_number_is_that_of_the_package(page, pattern):
    text = " ".join(PAGES[page].read_text(encoding="utf-8").split())
    found = re.findall(pattern, text)
    assert len(found) == 1, f"{page} says {pattern!r} {len(found)} times, not once"
    named = NUMBERS[page][pattern]
    computed = named() if callable(named) else [*map(of, several(named))]
    for one, value in zip(several(found[0]), several(computed), strict=True):
        if isinstance(value, str):
            assert one == value
        elif page == "learned_laws.md":  # ratios of rounded numbers, in digits of their own
            assert number(one) == pytest.approx(value, abs=0.6 / 10 ** len(one.partition(".")[2]))
        else:
            assert number(one) == pytest.approx(value, rel=1e-9)
