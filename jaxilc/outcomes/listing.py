"""`list`: the scenarios, or all that can be set in one.

This module does not import JAX for the list of all scenarios, so that it is there at once.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING

from ..scenarios.catalogue import LISTED
from .outcome import Outcome, Table, Verdict
from .request import Request

if TYPE_CHECKING:
    from ..pytree.aliases import Leaf
    from ..scenarios import Scenario
    from .words import Case


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
