"""Objectives, risks and weights from the text of an option.

For example, `final:20 + 0.3*final@max_error` is an objective, `cvar:0.9` is a risk, and
`lam=0.01:10` is a weight with bounds.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING

from ..pytree.closest import closest

if TYPE_CHECKING:
    from ..pytree.aliases import Value
    from ..scenarios import Scenario
    from ..tuning.objectives import Objective
    from ..tuning.problem import Tuning
    from ..tuning.risks import Risk
    from ..tuning.weights import Tuned

TERMS = (
    "final[:trial]",
    "every-trial",
    "holding[:trial]",
    "trials-to:tolerance",
    "growth[:trial]",
    "effort[:scale]",
    "input-rate[:scale]",
)
OBJECTIVES = ", ".join((*TERMS, "contraction[:sigma]", "d2[:limit]"))
LIMITED, STRICT = ("d2", "contraction"), 100  # what can be limited, and the weight of the penalty
UNLEARNED = (
    "; it says how a change of the disturbance grows in the error of the next trial, and no law "
    "with a low-pass Q comes clearly below 1, as that does not learn beyond its cutoff: filter and "
    "certify judge such laws"
)
ROUNDING = 1e-9  # by which a limit may be exceeded, relatively
RISKS = "mean, worst, cvar[:alpha], smooth-max[:temperature]"


def objective_for(chosen: Scenario, text: str) -> Objective:
    """The objective of a text; a term that names no metric has that which judges the scenario."""
    return objective_of(text, chosen.judged_by, lambda metric: chosen.shown(metric)[0])


def objective_of(text: str, metric: str, scale: Callable[[str], float]) -> Objective:
    """An objective from a text such as `final:20 + 0.3*final@max_error`.

    metric: metric of the terms that name none
    scale: by which factor a metric is shown; a tolerance in the text is of what is shown
    Raises ValueError naming what is allowed.
    """
    from ..tuning import objectives as o

    kinds = {
        "final": lambda m, x: o.Final(m, x and _whole("final", x)),
        "every-trial": lambda m, _: o.EveryTrial(m),
        "holding": lambda m, x: o.Holding(_whole("holding", x or "1"), m),
        "trials-to": lambda m, x: o.TrialsTo(_positive("trials-to", x) / scale(m), m),
        "growth": lambda m, x: o.Growth(m, _whole("growth", x or "1")),
        "effort": lambda _, x: o.Effort(_positive("effort", x or "1")),
        "input-rate": lambda _, x: o.InputRate(_positive("input-rate", x or "1")),
        "contraction": lambda _, x: o.Contraction(_positive("contraction", x or "1")),
        "d2": lambda _, x: o.D2(_positive("d2", x or "1")),
    }
    total: o.Objective = o.Sum(())
    for term in re.split(r"(?<![\d.][eE])\+", text):  # a number may be 1e+3
        weight, star, rest = term.strip().rpartition("*")
        rest, _, named = rest.partition("@")
        name, _, number = rest.strip().partition(":")
        if name not in kinds:
            raise ValueError(_unknown(f"--objective: {name!r}", name, OBJECTIVES))
        one = kinds[name](named.strip() or metric, number or None)
        total = total + (_positive(f"weight of {name}", weight) if star else 1.0) * one
    return total


def with_limits(objective: str, limits: Sequence[str]) -> str:
    """The text of an objective with a penalty for each limit, a text as `d2=0.95`."""
    for name, largest in _limits(limits):
        objective += f" + {STRICT}*{name}:{largest:.17g}"
    return objective


def limits_not_met(problem: Tuning, tuned: Tuned, limits: Sequence[str]) -> list[str]:
    """A sentence for each limit that the tuned weights exceed on a machine that it is asked of."""
    import jax

    said, population = [], problem.population
    for name, largest in _limits(limits):
        term = objective_of(f"{name}:{largest:.17g}", "rms", lambda _: 1.0)
        who, machines = "one of the machines tuned on", population.batch()
        if not population.uncertainty or all(one.nominal for _, one in term.terms):
            who, machines = "the nominal machine", jax.tree.map(lambda x: x[:1], machines)

        def above_of(drawn: Value, term: Objective = term) -> Value:
            return problem.loss_of(population.one_of(drawn)[0], tuned.values, term)

        above = float(jax.lax.map(above_of, machines).max())
        if above > ROUNDING:
            found = largest * math.exp(above)
            said.append(
                f"the limit is not met: {who} has {name} = {found:.6g}, and allowed was {largest:g}"
                + UNLEARNED * (name == "contraction")
            )
    return said


def _limits(given: Sequence[str]) -> Iterator[tuple[str, float]]:
    for limit in given:
        name, equals, number = (part.strip() for part in limit.partition("="))
        if not equals:
            raise ValueError(f"--limit {limit!r} is not NAME=NUMBER")
        if name not in LIMITED:
            raise ValueError(_unknown(f"--limit: {name!r}", name, ", ".join(LIMITED)))
        yield name, _positive(name, number)


def risk_of(text: str) -> Risk:
    """A risk from a text such as `cvar:0.9`; raises ValueError naming what is allowed."""
    from ..tuning import risks

    name, _, number = text.strip().partition(":")
    match name, number:
        case "mean", "":
            return risks.Mean()
        case "worst", "":
            return risks.Worst()
        case "cvar", _:
            return risks.CVaR(_number("cvar", number)) if number else risks.CVaR()
        case "smooth-max", _:
            return risks.SmoothMax(_number("smooth-max", number)) if number else risks.SmoothMax()
    raise ValueError(_unknown(f"--risk {text!r}", name, RISKS))


def weights_of(text: str) -> dict[str, tuple[float, float] | None]:
    """The weights from a text such as `lam=0.01:10,phi0[0]`, with their bounds.

    A weight without bounds has None, which stands for the range that the leaf allows.
    Raises ValueError for bounds that are not NAME=LOW:HIGH, and for a weight that is given twice.
    """
    weights: dict[str, tuple[float, float] | None] = {}
    for one in text.split(","):
        name, equals, ends = (part.strip() for part in one.partition("="))
        low, colon, high = ends.partition(":")
        if equals and not (name and colon):
            raise ValueError(f"--weights {one.strip()!r} is not NAME=LOW:HIGH")
        if name in weights:
            raise ValueError(f"--weights: {name} is given more than once")
        if name:
            weights[name] = (_number(name, low), _number(name, high)) if equals else None
    return weights


def numbers_of(option: str, text: str, *, whole: bool = False) -> list[float]:
    """The numbers, all different, of an option's text such as `0.1,0.3`; or numbers of trials."""
    items = [item.strip() for item in text.split(",")]
    numbers = [
        float(item) if whole and item.isdecimal() else _number(option, item) for item in items
    ]
    for item, value in zip(items, numbers, strict=True):
        if whole and not (item.isdecimal() and value >= 1):
            raise ValueError(f"{option}: {item!r} is not a number of trials")
        if numbers.count(value) > 1:
            raise ValueError(f"{option}: {item} is given more than once")
    return numbers


def _unknown(what: str, name: str, listed: str) -> str:
    """The message that a name is none of those listed, such as `cvar[:alpha]`; closest first."""
    forms = {re.split(r"[\[:]", form)[0]: form for form in listed.split(", ")}
    near = [forms[one] for one in closest(name, forms)]
    if not near:
        return f"{what} is not one of {listed}"
    return f"{what} is unknown; did you mean {' or '.join(near)}? Known: {listed}"


def _number(name: str, text: str | None) -> float:
    try:
        return float(text or "")
    except ValueError:
        raise ValueError(f"{name}: {text!r} is not a number") from None


def _positive(name: str, text: str | None) -> float:
    value = _number(name, text)
    if not 0 < value < math.inf:
        raise ValueError(f"{name}: {value:g} is outside its allowed range (0, inf)")
    return value


def _whole(name: str, text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise ValueError(f"{name}: {text!r} is not the number of a trial")
    return int(text)
