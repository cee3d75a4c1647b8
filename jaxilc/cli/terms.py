"""What is tuned for, as one writes it on the command line: `final:20 + 0.3*final@max_error`,
`cvar:0.9`, `lam=0.01:10`.
"""

from __future__ import annotations

TERMS = (
    "final[:trial]",
    "every-trial",
    "holding[:trial]",
    "trials-to:tolerance",
    "growth[:trial]",
    "effort[:scale]",
    "input-rate[:scale]",
)
OBJECTIVES = ", ".join((*TERMS, "contraction[:sigma]"))
RISKS = "mean, worst, cvar[:alpha], smooth-max[:temperature]"


def objective_of(text: str, figure: str, scale: float, option: str = "--objective"):
    """An objective from `final:20 + 0.3*final@max_error`.

    figure: where none is named;  scale: of tolerances as shown;  option: of the command line that
    it was given to
    Raises ValueError naming what is allowed.
    """
    from ..tuning import objectives as o

    kinds = {
        "final": lambda f, x: o.Final(f, None if x is None else _whole("final", x)),
        "every-trial": lambda f, x: o.EveryTrial(f),
        "holding": lambda f, x: o.Holding(1 if x is None else _whole("holding", x), f),
        "trials-to": lambda f, x: o.TrialsTo(_positive("trials-to", x) / scale, f),
        "growth": lambda f, x: o.Growth(f, 1 if x is None else _whole("growth", x)),
        "effort": lambda f, x: o.Effort(1.0 if x is None else _positive("effort", x)),
        "input-rate": lambda f, x: o.InputRate(1.0 if x is None else _positive("input-rate", x)),
        "contraction": lambda f, x: o.Contraction(
            1.0 if x is None else _positive("contraction", x)
        ),
    }
    total = o.Sum(())
    for term in text.split("+"):
        weight, star, rest = term.strip().rpartition("*")
        rest, _, named = rest.partition("@")
        name, _, number = rest.strip().partition(":")
        if name not in kinds:
            raise ValueError(f"{option}: {name!r} is not one of {OBJECTIVES}")
        one = kinds[name](named.strip() or figure, number or None)
        total = total + (_positive(f"weight of {name}", weight) if star else 1.0) * one
    return total


def risk_of(text: str):
    """A risk from `cvar:0.9`. Raises ValueError naming what is allowed."""
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
    raise ValueError(f"--risk {text!r} is not one of {RISKS}")


def weights_of(text: str, bounds: list[str] | None) -> dict[str, tuple[float, float] | None]:
    """Names with their bounds, None for all that a leaf allows. Raises ValueError for bounds that
    are none or of no weight.
    """
    weights: dict[str, tuple[float, float] | None] = {
        name.strip(): None for name in text.split(",") if name.strip()
    }
    for bound in bounds or []:
        name, equals, ends = bound.partition("=")
        low, colon, high = ends.partition(":")
        if not (equals and colon):
            raise ValueError(f"--bounds {bound!r} is not NAME=LOW:HIGH")
        if name.strip() not in weights:
            raise ValueError(
                f"--bounds: {name.strip()!r} is not one of the weights {', '.join(weights)}"
            )
        weights[name.strip()] = (_number(name, low), _number(name, high))
    return weights


def numbers_of(option: str, text: str, *, whole: bool = False) -> list[float]:
    """Different numbers from `0.1,0.3`. Raises ValueError naming the option for what is no number,
    or is there twice.
    """
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


def _number(name: str, text: str | None) -> float:
    try:
        return float(text or "")
    except ValueError:
        raise ValueError(f"{name}: {text!r} is not a number") from None


def _positive(name: str, text: str | None) -> float:
    value = _number(name, text)
    if not value > 0:
        raise ValueError(f"{name}: {value:g} is outside its allowed range (0, inf)")
    return value


def _whole(name: str, text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise ValueError(f"{name}: {text!r} is not the number of a trial")
    return int(text)
