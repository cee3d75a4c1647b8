"""The papers' advice on their parameters, on a grid around the printed numbers.

Each row is one sentence of a paper about one number, and what the simulation does where this number
alone is multiplied by the factors of `FACTORS`, with the nominal machine of the scenario. `error`
is the metric of the scenario in the last trial, in its unit, and `last / best` how far the error
has grown again above its best trial. What is said counts as seen

    lively          the error at the largest factor is more than 10 times the printed one
    alike           half and twice the number, if allowed, change the error by less than 10 %
    falls           the error does so at each step from a quarter to 4 times
    diverges more   `last / best` grows from each factor to the next, where it is above 1
    stays           `last / best` is 1 at each factor
    slower          the error of trial 2 grows at each step from a quarter to 4 times
    quicker         the error of trial 2 falls at each of these steps

The windows of FFDL-MFAILC are no number by itself, since the pseudo gradient is as long as both:
all of `WINDOWS` are a grid of their own. A component that the scenario does not have starts at 0.
`left_out` is the share of the variance of D y that a window cannot explain, whatever its gradient.

    python experiments/advice_on_grids.py

Writes rows.csv and a line for each number as a figure, windows.csv and a map of the windows to
out/experiments/advice_on_grids.
"""

import dataclasses
from itertools import product
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import output
import pandas as pd
import xarray as xr

import jaxilc
from jaxilc import figures
from jaxilc.pytree.named_paths import get_at, interval_at
from jaxilc.sweeps.summary import errors_of
from jaxilc.theory import bounds_of

WINDOWS = [*product(range(4), range(1, 4))]  # L_y and L_u
FACTORS = np.array([0.25, 0.5, 0.9, 1.0, 1.1, 2.0, 4.0])


class Advice(NamedTuple):
    """What a paper says of a number.

    path: the number, with its scheme before it
    said: the sentence, as printed or in short
    rule: how it is judged, see the docstring of this module
    given: options of the scenario
    settings: values by path that the advice is about
    """

    scenario: str
    path: str
    said: str
    rule: str
    given: dict[str, str] = {}  # noqa: RUF012
    settings: dict[str, float] = {}  # noqa: RUF012


ADVICE = (
    Advice("cao-2019", "cfdl-mfailc.lam",
           "should not be too large, which will cause violent vibration", "lively"),
    Advice("cao-2019", "cfdl-mfailc.phi0",
           "too large, it will also cause violent oscillation", "lively"),
    *(Advice("cao-2019", f"cfdl-mfailc.{name}", "has little effect on the error",
             "alike") for name in ("mu", "eta", "rho")),
    Advice("dai-2014", "cfdl-mfapc.lam",
           "performance is very insensitive to the variation of lambda", "alike",
           {"plant": "printed"}),
    Advice("li-2020", "p-type.feedback.kp",
           "the larger the position loop, the more divergent the error",
           "diverges more"),
    Advice("li-2020", "fixed-filter.learning.filter.cutoff",
           "a filter removes what makes the error diverge", "stays"),
    Advice("li-2020", "p-type.learning.gamma_p",
           "if the error attenuates too slowly, increase the learning gain", "quicker"),
    Advice("li-2020", "ladder.growth_of_gain",
           "the same, between the mean trials of the ladder", "falls", {}, {"ladder.slow": 0.5}),
    Advice("xu-2024", "asmc.phi", "the larger phi, the faster the adaptation",
           "falls"),
    Advice("milc-2024", "milc.learning.w_r",
           "a smaller W_r: more sensitive to the error of the trial before", "slower"),
    Advice("milc-2024", "milc.learning.w_s", "a larger W_s slows down convergence",
           "slower"),
)  # fmt: skip


def swept(chosen, name: str, grid: dict) -> tuple[xr.Dataset, xr.DataArray]:
    """The sweep of a scheme of a scenario on its nominal machine, and its errors as shown."""
    dataset = jaxilc.Sweep(
        chosen.machine,
        {name: chosen.schemes[name]},
        chosen.task,
        chosen.trials,
        uncertainty={},
        machines=1,
        quantities=chosen.functions,
        grid=grid,
    ).run()
    scale, _ = chosen.shown(chosen.judged_by)
    return dataset, scale * errors_of(dataset, chosen.judged_by).isel(scheme=0, sample=0)


def errors_at(advice: Advice) -> tuple[np.ndarray, str]:
    """(factors, trials) the metric of the scenario in its unit, and this unit.

    NaN at factors with which the number would leave its range.
    """
    given = output.FIRST_READINGS.get(advice.scenario, {}) | advice.given
    chosen = jaxilc.scenarios.load(advice.scenario, **given).with_values(advice.settings)
    scheme, _, path = advice.path.partition(".")
    printed = float(get_at(chosen.schemes[scheme], path))
    allowed = interval_at(chosen.schemes[scheme], path)
    inside = [i for i, x in enumerate(printed * FACTORS) if allowed is None or allowed.contains(x)]
    _, found = swept(chosen, scheme, {advice.path: printed * FACTORS[inside]})
    errors = np.full((len(FACTORS), found.sizes["trial"]), np.nan)
    errors[inside] = found.transpose(advice.path, "trial").values
    return errors, chosen.shown(chosen.judged_by)[1]


def seen(rule: str, errors: np.ndarray, grown: np.ndarray) -> bool:
    last = errors[:, -1]
    known = ~np.isnan(last)
    at = dict(zip(FACTORS[known], last[known], strict=True))
    if rule == "lively":
        return bool(last[known][-1] > 10 * at[1.0])
    if rule == "alike":
        near = [at[factor] / at[1.0] for factor in (0.5, 2.0) if factor in at]
        return bool(np.all(np.abs(np.subtract(near, 1)) < 0.1))
    if rule == "diverges more":
        above = grown[grown > 1.0]
        return bool(len(above) > 1 and np.all(np.diff(above) > 0))
    if rule == "stays":
        return bool(np.all(grown == 1))
    if rule in ("slower", "quicker"):
        return bool(np.all(np.diff(errors[:, 1]) * (1 if rule == "slower" else -1) > 0))
    return bool(np.all(np.diff(last[known]) < 0))


def windows() -> tuple[xr.Dataset, list[dict[str, float]]]:
    """A sweep of FFDL-MFAILC over its windows, and a row for each with its errors [µm]."""
    chosen = jaxilc.scenarios.load("cao-2019", reading="amplitude", plant="exact")
    name, law = "ffdl-mfailc", chosen.schemes["ffdl-mfailc"]
    of_y, of_u = np.split(np.asarray(law.phi0), [law.L_y])
    starts = [(*of_y, 0.0, 0.0)[:L_y] + (*of_u, 0.0, 0.0)[:L_u] for L_y, L_u in WINDOWS]
    parts = {"phi0": starts, "L_y": [L for L, _ in WINDOWS], "L_u": [L for _, L in WINDOWS]}
    names = tuple(f"{name}.{part}" for part in parts)
    dataset, errors = swept(chosen, name, {names: list(parts.values())})
    rows = []
    for (L_y, L_u), phi0, error in zip(WINDOWS, starts, errors.values, strict=True):
        scheme = dataclasses.replace(law, L_y=L_y, L_u=L_u, phi0=jnp.asarray(phi0))
        left_out = float(bounds_of(chosen.machine, scheme, chosen.task).left_out)
        rows.append({"L_y": L_y, "L_u": L_u, "left_out": left_out, "trial 20": float(error[19])}
                    | {"best": float(error.min()), "last": float(error[-1])})  # fmt: skip
    pairs = pd.MultiIndex.from_tuples(WINDOWS, names=names[1:])
    flat = dataset.drop_vars(names).rename_dims({names[0]: "window"})
    flat = flat.assign_coords(xr.Coordinates.from_pandas_multiindex(pairs, "window"))
    return flat.unstack("window"), rows


def main() -> None:
    jaxilc.setup()
    folder, rows = output.folder(__file__), []
    axes = output.axes(5, 3, size=(10, 13)).ravel()
    for advice, ax in zip(ADVICE, axes, strict=False):
        errors, unit = errors_at(advice)
        last, best, last_trial = errors[:, -1], errors.min(axis=1), errors.shape[1] - 1
        grown = np.where(np.isinf(last), np.inf, last / np.where(np.isinf(best), 1.0, best))
        rows.append(
            {"scenario": advice.scenario, "number": advice.path, "said": advice.said}
            | {f"x {factor:g}": float(value) for factor, value in zip(FACTORS, last, strict=True)}
            | {"unit": unit, "rule": advice.rule, "seen": seen(advice.rule, errors, grown)}
            | {"last / best": " ".join(f"{ratio:.3g}" for ratio in grown)}
            | {"trial 2": " ".join(f"{error:.4g}" for error in errors[:, min(1, last_trial)])}
        )
        ax.loglog(FACTORS, last, "o-", label="last trial")
        ax.loglog(FACTORS, best, "--", label="best trial")
        ax.set_title(f"{advice.scenario}\n{advice.path}", fontsize="small")
        ax.set_ylabel(f"error [{unit}]")
    axes[0].legend(fontsize="small")
    axes[0].figure.savefig(folder / "lines.png")
    output.write_rows(folder / "rows.csv", rows)
    dataset, rows = windows()
    printed = {"as printed": {"ffdl-mfailc.L_y": 2, "ffdl-mfailc.L_u": 2}}
    drawn = figures.grid_map(dataset, scale=1e3, unit="µm", marks=printed)
    figures.save(drawn, folder / "windows.png")
    output.write_rows(folder / "windows.csv", rows)


if __name__ == "__main__":
    main()
