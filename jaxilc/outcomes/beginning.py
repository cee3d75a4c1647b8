"""What one begins with: `list`, the scenarios or all that can be set in one; `init`, a plant file.

JAX is imported for the settings of a scenario and for a recorded drive alone; the rest is there at
once.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING

from ..scenarios.catalogue import LISTED
from ..storage.files import write_file
from .outcome import Outcome, Table, Verdict
from .request import Request

if TYPE_CHECKING:
    from ..identification import Identified, Record
    from ..pytree.aliases import Leaf
    from ..scenarios import Scenario
    from .words import Case

# What `--set-point` puts in place of parts of the file: its scheme then learns from u = r on.
SET_POINT = {
    'class = "Filtered"\n': (
        'class = "WarmStart"             # the first trial plays the reference: u = 1.0 r\n'
        "theta = [1.0]\n"
        'basis = { class = "PolynomialBasis", orders = [0] }\n'
        '[schemes.ilc.scheme]\nclass = "Filtered"\n'
    ),
    "[plant]\n": (
        "# Here u is the set-point of a closed drive; `jaxilc init --set-point --record FILE.csv`\n"
        "# writes this file for a drive of which one move was recorded.\n"
        "[plant]\n"
    ),
    '#input_unit = "mm"': 'input_unit = "mm"',
    '"ilc.filter.cutoff"': '"ilc.scheme.filter.cutoff"',
    '"ilc.scheme.lead"': '"ilc.scheme.scheme.lead"',
}
AT_REST = 0.01  # of the stroke of a set-point, by which its first value may miss 0
_OF_DRIVE = re.compile(r"(?<=\[plant\]\n)kind.*?\n(?=\n)", re.DOTALL)
_UNCERTAINTY = re.compile(r"(?<=\n)\[uncertainty\..*?\n(?=\n)", re.DOTALL)
_REFERENCE = re.compile(r"(?<=\n)reference = .*")


def scenarios() -> Outcome:
    """The scenarios of papers and of other software."""
    table = Table("scenario", "title", "schemes", "trials", "samples N")
    for name, (title, schemes, trials, samples) in LISTED.items():
        table.add_row(name, title, ", ".join(schemes), str(trials), str(samples))
    said = f"{len(LISTED)} scenarios of papers and other software; a plant file has your machine."
    verdict = Verdict((said,), "a plant file", "jaxilc init axis.toml")
    return Outcome(command="list", numbers={}, verdict=verdict, tables=[table])


def settings(source: str) -> Outcome:
    """All that can be set in a scenario or a plant file, with values and allowed ranges."""
    from ..scenarios.from_file import load_scenario
    from .words import Case

    chosen = load_scenario(source)
    values = chosen.settable()
    return Outcome(
        command="list",
        numbers={},
        verdict=list_verdict(
            Case.of(chosen, Request(source)),
            values,
            [*chosen.options],
            lambda settings: chosen.with_values(settings).check(),
        ),
        scenario=chosen,
        tables=[settable_table(chosen)],
    )


def settable_table(scenario: Scenario) -> Table:
    """The table of all that `--set` can set in a scenario, with values and allowed ranges."""
    table = Table(title=scenario.title)
    table.add_column("--set", whole=True)
    table.add_column("value")
    table.add_column("allowed")
    for option, default in scenario.options.items():
        table.add_row(option, str(default), "option of the scenario")
    for path, value in scenario.settable().items():
        table.add_row(path, _brief(value), scenario.allowed(path))
    return table


def _brief(value: object) -> str:
    import numpy as np

    if value is None or isinstance(value, str | int | tuple):
        return str(value)
    return np.array2string(np.asarray(value), precision=6, threshold=6)


def list_verdict(
    case: Case,
    values: Mapping[str, Leaf],
    options: Sequence[str],
    tried: Callable[[dict[str, object]], object],
) -> Verdict:
    """How much can be set, and a run with half of a value that is `tried` without a ValueError."""
    import numpy as np

    said = (f"{len(values) + len(options)} values can be set in {case.request.source}.",)
    if not case.learns:
        return Verdict(said, *(case.remedy("") if case.designable else ()))
    heads = [f"{name}." for name in sorted(case.learns, key=lambda name: not case.learns[name])]
    single = [path for path, value in values.items() if np.asarray(value).shape == ()]
    floats = [path for path in single if np.asarray(values[path]).dtype.kind == "f"]
    floats.sort(key=lambda path: ".model." in path)  # weights first
    for path in (p for head in heads for p in floats if p.startswith(head)):
        half = f"{0.5 * float(values[path]):.6g}"
        with suppress(ValueError):
            if 0 < abs(float(half)) < np.inf:
                tried({path: half})
                changed = case.request.following("run", set=(f"{path}={half}",))
                return Verdict(said, f"with half of {path.rpartition('.')[2]}", changed)
    return Verdict(said, "as it stands", case.request.following("run"))


def init(
    file: str | Path = "axis.toml",
    *,
    set_point: bool = False,
    record: str | Path | None = None,
    time: str = "t",
    input: str = "u",
    output: str = "y",
    force: bool = False,
) -> Outcome:
    """Write a plant file with comments: a machine, its task, schemes and uncertainty.

    set_point: the input is the set-point of a closed drive, which plays the reference in trial 1
    record: with `set_point`: file of a recorded move of the drive, to which the machine is fitted;
        its set-point is the task, and the law is one that learns on the drive
    time, input, output: columns of the record
    force: whether a file that exists is replaced
    Raises ValueError or FileExistsError, naming what is allowed, before anything is written.
    """
    file, record = Path(file), None if record is None else Path(record)
    if file.suffix != ".toml":
        raise ValueError(f"{file} is not a name that ends with .toml")
    if file.exists() and not force:
        raise FileExistsError(f"{file} exists already; add --force to replace it")
    columns = (("--time", time, "t"), ("--input", input, "u"), ("--output", output, "y"))
    for option, name, usual in columns:
        if record is None and name != usual:
            raise ValueError(f"{option} {name} names a column of --record, which is not given")
    content = (resources.files("jaxilc.scenarios") / "axis.toml").read_text("utf-8")
    content = _replaced(content, SET_POINT if set_point else {})
    own, of_law = "plant, task and uncertainty", list[str]()
    if record is not None:
        if not set_point:
            raise ValueError("--record is for --set-point; otherwise: jaxilc identify RECORD")
        content, *of_law = _of_record(content, record, file, (time, input, output))
        own = "uncertainty"
    file.parent.mkdir(parents=True, exist_ok=True)
    write_file(file, content)
    said = f"{file} runs as it is; put your own {own} into it."
    following = Request(str(file)).following("run")
    verdict = Verdict((said, *of_law), "its first trials", following)
    return Outcome(command="init", numbers={}, verdict=verdict, kept=[file])


def _of_record(
    content: str, record: Path, file: Path, names: tuple[str, str, str]
) -> tuple[str, ...]:
    """The file for a drive of which a move was recorded, in columns of these names.

    Further texts tell how well the drive was fitted, its law, and a unit that is assumed.
    """
    from ..identification import identify
    from ..identification.record_files import read_record_file
    from ..identification.sentences import verdict
    from ..scenarios.design_file import toml_lines
    from ..scenarios.identified_file import comment, plant_values
    from ..storage.columns import plain_unit

    time, set_point, position = names
    read = read_record_file(record, time=time, input=set_point, output=position)
    values = read.record.u[:, 0].tolist()
    first = values[0]
    if abs(first) > AT_REST * (max(values) - min(values)):
        raise ValueError(
            f"{record}: {set_point} begins at {first:.6g}, where the move must begin at 0, as the "
            f"plant does; subtract {first:.6g} from {set_point} and {position}, in each trial, too"
        )
    of_set_point, told = (of[0] for of in (read.input_units, read.output_units))
    if of_set_point and told and plain_unit(of_set_point) != plain_unit(told):
        raise ValueError(
            f"{record}: {set_point} is in {of_set_point!r} and {position} in {told!r}; allowed is "
            "one unit for both, and nothing is converted"
        )
    columns = (os.path.relpath(record, file.parent), set_point, time)
    place, column, of_time = map(json.dumps, columns)
    unit = told or of_set_point or "mm"
    parts = {
        "dt = 0.001\n": f"dt = {read.record.dt!r}\n",
        '\nunit = "mm"': f"\nunit = {json.dumps(unit)}",
        'input_unit = "mm"': f"input_unit = {json.dumps(unit)}",
    }
    content = _replaced(content, parts)
    timed = "" if time == "t" else f", time = {of_time}"
    moved = f"reference = {{ csv = {place}, column = {column}{timed} }}"
    content = _REFERENCE.sub(lambda _: moved, content)
    found = identify(read.record, poles=2)
    fitted = verdict(found, read.record.dt)
    comments = "".join(f"# {comment(text)}\n" for text in (f"Fitted to {record.name}.", *fitted))
    content = _OF_DRIVE.sub(lambda _: comments + toml_lines(plant_values(found.plant)), content)
    made = _with_law(content, record, found, read.record)
    assumed = f"{record} gives no unit of {position}; {unit} is assumed, which each trial must say."
    return made[0], *fitted, *made[1:], *([] if told else [assumed])


def _with_law(content: str, path: Path, found: Identified, record: Record) -> tuple[str, ...]:
    """The text of a file with a law that learns on its drive, and what that is.

    path: of the record, to which the drive was fitted
    """
    import numpy as np

    from ..identification import not_significant
    from ..identification.verdict import explained_up_to
    from ..plants import ProcessModel
    from ..scenarios.design_file import toml_lines
    from ..scenarios.identified_file import intervals, starting_law
    from ..uncertainty import Uniform

    plant, doubts = found.plant, " ".join(not_significant(found))
    assert isinstance(plant, ProcessModel)
    # a zero and a pole that may cancel do so in all machines: apart, they would tell of none
    certain = intervals(found)[0].items()
    known = {name: of for name, of in certain if name.removeprefix("plant.") not in doubts}
    gain, tenth = float(plant.gain), 0.1 * abs(float(plant.gain))
    fitted = known.get("plant.gain", Uniform(gain - tenth, gain + tenth))
    known["plant.gain"] = Uniform(min(fitted.low, gain - tenth), max(fitted.high, gain + tenth))
    y = np.reshape(record.y, (len(found.simulated), -1))[:, 0]
    highest = explained_up_to(y, y - found.simulated[:, 0], record.dt)
    law = starting_law(plant, known, record.dt, len(record.u), highest=highest, without={})
    if law is None:
        raise ValueError(
            f"{path}: no filtered P-type law learns on the drive that was fitted; "
            "`jaxilc identify` tells how well the plant fits"
        )
    tables = {
        name: {"distribution": "uniform", "low": one.low, "high": one.high}
        for name, one in known.items()
    }
    ends = "[uncertainty]  # the 95 % intervals of the fit, of the gain 10 % at least\n"
    content = _UNCERTAINTY.sub(lambda _: ends + toml_lines(tables), content)
    gamma, lead, cutoff = f"{law.gamma_p:g}", str(law.lead), f"{law.cutoff:g}"
    parts = {
        "0.8 of the error, 15 samples": f"{gamma} of the error, {lead} samples",
        "gamma_p = 0.8, lead = 15": f"gamma_p = {gamma}, lead = {lead}",
        "cutoff = 50.0": f"cutoff = {cutoff}",
        "20:80:4": f"{0.4 * law.cutoff:g}:{law.cutoff:g}:4",
        "[5, 15]": f"{sorted({law.lead // 3, law.lead})}",
    }
    said = [f"Chosen for the fitted drive: {law.told}."]
    if law.cutoff > 0.9 * highest:
        said.append(
            f"The cutoff stays where the record shows what the drive does, up to {highest:.3g} Hz. "
            "Before a larger one, measure its frequency response: jaxilc filter T.csv "
            f"--gain {gamma} --lead {lead} --cutoff HERTZ --dt {record.dt:g}"
        )
    return _replaced(content, parts), *said


def _replaced(content: str, parts: Mapping[str, str]) -> str:
    """The text with other words in place of some; those that it has not are left."""
    for part, other in parts.items():
        content = content.replace(part, other)
    return content
