"""The rows of `tuned_against_printed`: errors by trial, and whether the target is met."""

import numpy as np


def rows_of(case, errors) -> list[dict]:
    """A row for each metric and trial: median, 95 % quantile and worst of each scheme."""
    rows = []
    for metric, values in errors.items():
        for j in case.judged[1]:
            row = {"case": f"{case.scenario} {case.scheme}", "metric": metric, "trial": j}
            for which in ("printed", "structure", "tuned"):
                of = values.sel(scheme=which, trial=j).values
                row |= {
                    f"{which} median": float(np.median(of)),
                    "95 %": float(np.quantile(of, 0.95, method="higher")),
                }
                row[f"{which} 95 %"], row[f"{which} worst"] = row.pop("95 %"), float(np.max(of))
            rows.append(row)
    return rows


def verdict_of(case, errors, lowest: float | None) -> dict:
    """The row with the errors at the trial of the target, printed and tuned, and the verdict.

    An error is the median and, in brackets, that of the worst machine. The row also has the largest
    later value and the last one of the tuned curves.

    lowest: lowest error found, None where it was not searched for
    """
    (j, wanted), last_trial = case.target, max(case.judged[1])
    values = errors[case.judged[0]]
    curves = {
        which: [f(values.sel(scheme=which).values, axis=0) for f in (np.median, np.max)]
        for which in ("printed", "tuned")
    }
    printed, tuned = ([float(c[j - 1]) for c in curves[which]] for which in ("printed", "tuned"))
    later, last = (
        [float(f(c[j - 1 :])) for c in curves["tuned"]] for f in (np.max, lambda c: c[-1])
    )
    goals = [-wanted if wanted < 0 else p / wanted for p in printed]
    met = [t <= goal for t, goal in zip(tuned, goals, strict=True)]
    verdict = (
        "met by the worst machine" if all(met) else "met in the median" if met[0] else "missed"
    )
    if not met[0] and lowest is not None:
        verdict += f"; the lowest found is {min(lowest, tuned[0]) / printed[0]:.2f} of the printed"
    ratio = [p / t for p, t in zip(printed, tuned, strict=True)]
    named = {
        "printed": printed,
        "tuned": tuned,
        "goal": goals,
        "times better": ratio,
        "largest later": later,
        "last": last,
    }
    row = {name: "{:.3g} ({:.3g})".format(*pair) for name, pair in named.items()} | {
        "verdict": verdict
    }
    if case.holds:
        below = ["yes" if x <= goal else "no" for x, goal in zip(later, goals, strict=True)]
        row[f"below the goal to trial {last_trial}"] = "{} ({})".format(*below)
        for which in ("printed", "tuned"):
            of = values.sel(scheme=which)
            grown = int((of.sel(trial=last_trial) > of.sel(trial=j)).sum())
            row[f"{which}: machines worse at trial {last_trial}"] = (
                f"{grown} of {of.sizes['sample']}"
            )
    return row
