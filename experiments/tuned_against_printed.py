"""Printed weights against tuned ones, for each scenario, on machines not used in the tuning.

`python tuned_against_printed.py NAME ...` runs the cases of these names, and all for no name.
Settings without a gradient (a lead, a horizon, a stop rule) are fixed before tuning. The column
`structure` has these settings with the printed weights, at which the tuning starts.

The targets are: CFDL 10 times better at trial 20, FFDL 0.3 µm by trial 15, every other scheme
2 times better at its last trial. For CFDL and FFDL the table also says whether the median and the
worst error stay below their targets in every later trial, and for how many machines the error is
larger at the last trial than at the trial of the target; there are such machines. Where a target is
missed, the lowest error found is given.

Tuning draws its machines from seed 0 and selects its best iterate with those of seed 1. The
settings of the cases were chosen with machines of seed 2. The table is made with machines of
JUDGED_SEED, which was chosen once and not used before all settings were final. No setting was
changed after that.
"""

import dataclasses
import sys
import time
from collections.abc import Callable

import jax.numpy as jnp
import li_2020_tuning
import milc_2024_weights
import numpy as np
import output
from lowest_error import best_of_one_move, lowest_of
from tuned_rows import rows_of, verdict_of

import jaxilc
from jaxilc.pytree import replaced
from jaxilc.schemes import Scheme, StopWhen
from jaxilc.tuning import Tuned, Tuning
from jaxilc.tuning.objectives import Final, Growth, Holding, Objective
from jaxilc.tuning.risks import CVaR, Mean

JUDGED_SEED = 20261121
FINE = 1e-4  # floor relative to the reference's peak; errors below it count as equal
MFAILC = {"lam": (1e-2, 1e2), "eta": None, "mu": (1e-3, 1e4)}


@dataclasses.dataclass(frozen=True)
class Case:
    """A case of the comparison.

    scenario, scheme: names of the printed scenario and scheme
    problem: function from a scenario to the tuning, whose scheme has the printed weights
    judged: the metric, and the trials that the table shows
    target: a trial, and the factor by which it shall be better than printed; a negative number is
        minus the target error
    finish: function that adds the wrappers of the tuned scheme
    holds: whether the trials after that of the target are judged too
    unseen: number of machines that were not used in the tuning, with the nominal one
    lowest: number of machines for the search for the lowest error, 0 for no such search
    lowest_over: changes of the tuned scheme over which the lowest error is searched
    """

    scenario: str
    scheme: str
    problem: Callable[[jaxilc.scenarios.Scenario], Tuning]
    judged: tuple[str, tuple[int, ...]]
    target: tuple[int, float]
    finish: Callable[[Scheme], Scheme] = lambda scheme: scheme
    holds: bool = False
    unseen: int = 257
    lowest: int = 0
    lowest_over: tuple[dict[str, float], ...] = ({},)


def tuning(s, scheme, weights, objective: Objective, trials, **options) -> Tuning:
    options = {
        "machines": 16,
        "held_out": 16,
        "mode": "reverse",
        "validate_every": 2,
        "patience": 15,
        "risk": CVaR(0.7),
    } | options
    return Tuning(s.machine, scheme, s.task, trials, weights, s.uncertainty, objective, **options)


def cfdl(s):
    scheme = dataclasses.replace(s.schemes["cfdl-mfailc"], lead=4)
    objective = (
        Holding(20, floor=FINE)
        + Growth("settled_error", 20, floor=FINE)
        + 0.3 * Growth("max_error", 20)
    )
    return tuning(s, scheme, MFAILC | {"phi0": (-0.5, -0.003)}, objective, 100, steps=50, rate=0.2)


def ffdl(s):
    objective = Holding(15, floor=FINE) + 0.3 * Holding(15, "max_error") + Growth("max_error", 15)
    weights = MFAILC | {"rho": (0.01, 1.0), "phi0": None}
    return tuning(
        s,
        s.schemes["ffdl-mfailc"],
        weights,
        objective,
        40,
        machines=24,
        held_out=24,
        steps=60,
        rate=0.15,
    )


def mfapc(s):
    # With one move, the input is the integral of the mean previewed reference minus the output;
    # `best_of_one_move` gives its least error. The first of two moves gives r(k+1) its own weight
    # besides a long horizon, which fits the phase and magnitude of the loop at 0.5 Hz.
    scheme = dataclasses.replace(s.schemes["cfdl-mfapc"], P=470, P_u=2, phi0=-40.0, lam=100.0)
    weights = {"lam": (10.0, 1e3), "phi0": (-100.0, -10.0)}
    return tuning(
        s, scheme, weights, Final(), 1, machines=8, held_out=8, steps=20, rate=0.1, mode="forward"
    )


def rig(s):
    weights = {
        "learning.filter.cutoff": (1.0, 60.0),
        "learning.scheme.lam": (1e-2, 1e2),
        "learning.scheme.phi0": (0.05, 5.0),
    }
    weights |= {"feedback.kp": (0.03, 1.5)}
    objective = (
        Final("settled_rms", floor=1e-5) + 0.3 * Final(floor=FINE) + 0.1 * Final("max_error")
    )
    quantities = {"settled_rms": lambda trial: jnp.sqrt(jnp.mean(trial.e[s.task.settled] ** 2))}
    return tuning(
        s,
        s.schemes["cfdl-mfailc"],
        weights,
        objective,
        8,
        machines=8,
        held_out=8,
        steps=26,
        rate=0.3,
        quantities=quantities,
    )


def servo(s):
    weights = {
        "learning.K_P": (1e4, 1e7),
        "learning.K_D": (50.0, 2e4),
        "feedback.k_n": (200.0, 1e4),
        "feedback.phi": (1e4, 1e7),
    }
    return tuning(
        s,
        s.schemes["ilc-asmc"],
        weights,
        Final() + 0.3 * Final("max_error"),
        10,
        steps=50,
        risk=Mean(),
    )


CASES = {
    "cfdl": Case(
        "cao-2019",
        "cfdl-mfailc",
        cfdl,
        ("settled_error", (20, 40, 80, 120, 200)),
        (20, 10.0),
        holds=True,
    ),
    "ffdl": Case(
        "cao-2019",
        "ffdl-mfailc",
        ffdl,
        ("settled_error", (10, 15, 50, 80, 200)),
        (15, -0.3),
        # without it the error at the start of the trial grows after trial 80, see max_error
        finish=lambda scheme: StopWhen(scheme, growth=0.02),
        holds=True,
    ),
    "mfapc": Case("dai-2014", "cfdl-mfapc", mfapc, ("settled_error", (1,)), (1, 2.0)),
    "rig": Case(
        "cao-2019-rig",
        "cfdl-mfailc",
        rig,
        ("settled_error", (8, 40)),
        (40, 2.0),
        finish=lambda scheme: StopWhen(scheme, growth=0.02),  # for the same reason
        unseen=33,
        lowest=8,
        # with 1.2 learning is unstable
        lowest_over=tuple({"feedback.kp": kp} for kp in (0.29, 0.5, 0.7, 0.8, 0.9, 1.0, 1.1)),
    ),
    "li": Case(
        "li-2020",
        "switchable",
        li_2020_tuning.problem,
        ("rms", (5, 10, 20)),
        (20, 2.0),
        unseen=65,
        lowest=8,
    ),
    **{
        name: Case(
            "milc-2024",
            name,
            milc_2024_weights.problem_of(name),
            ("table_rms", (2, 6, 11)),
            (11, 2.0),
            unseen=65,
            lowest=8,
        )
        for name in ("dilc", "milc")
    },
    "servo": Case("xu-2024", "ilc-asmc", servo, ("settled_error", (2, 10, 40)), (10, 2.0)),
}


def errors_of(s, case: Case, problem: Tuning, tuned: Tuned):
    """Errors (scheme, sample, trial) by metric [shown unit]; infinite where not finite."""
    metric, trials = case.judged
    schemes = {
        "printed": s.schemes[case.scheme],
        "structure": problem.scheme,
        "tuned": case.finish(tuned.scheme),
    }
    options = {"machines": case.unseen, "seed": JUDGED_SEED, "quantities": s.functions}
    dataset = jaxilc.Sweep(
        problem.machine, schemes, problem.task, max(trials), problem.uncertainty, **options
    ).run()
    return {
        f: s.shown_scale * dataset[f].where(~dataset["diverged"], np.inf)
        for f in dict.fromkeys((metric, "max_error"))
    }


def main(names: list[str]) -> None:
    folder = output.folder(__file__)
    chosen = {name: CASES[name] for name in output.asked(names, CASES)}
    axes = np.atleast_1d(output.axes(1, len(chosen), size=(4.2 * len(chosen), 3.6)))
    rows, verdicts = [], []
    for ax, (name, case) in zip(axes, chosen.items(), strict=True):
        began = time.perf_counter()
        s = jaxilc.scenarios.load(case.scenario, **output.FIRST_READINGS.get(case.scenario, {}))
        problem = case.problem(s)
        tuned = problem.run()
        seconds = time.perf_counter() - began
        errors = errors_of(s, case, problem, tuned)
        rows += rows_of(case, errors)
        lowest = left = None
        if case.lowest:
            lowest, left = min(
                lowest_of(s, case.judged, problem, scheme, case.lowest, JUDGED_SEED)
                for scheme in (replaced(tuned.scheme, values) for values in case.lowest_over)
            )
        row = {
            "case": name,
            "metric": f"{case.judged[0]} [{s.shown_unit}]",
            "trial": case.target[0],
        } | verdict_of(case, errors, lowest)
        row |= {
            "of the ideal input": ""
            if lowest is None
            else f"{lowest:.3g} ({left:.2g} without noise and steps)"
        }
        if lowest and "rms" in case.judged[0]:
            medians = [
                float(errors[case.judged[0]].sel(scheme=w, trial=case.target[0]).median())
                for w in ("printed", "tuned")
            ]
            row |= {
                "beyond that": "{:.3g} -> {:.3g}".format(
                    *np.sqrt(np.maximum(np.square(medians) - lowest**2, 0.0))
                )
            }
        row |= (
            {"P_u = 1 at best (theory, median)": f"{best_of_one_move(s, JUDGED_SEED):.3g}"}
            if name == "mfapc"
            else {}
        )
        verdicts.append(row)
        print("  ".join(f"{k} {v}" for k, v in row.items()))
        print(
            f"  {seconds:.0f} s, held-out loss {tuned.before:.3f} -> {tuned.after:.3f} at step "
            f"{tuned.step} ({tuned.reason}), of"
        )
        print(f"  {time.perf_counter() - began:.0f} s altogether; weights:", end=" ")
        print(
            {
                k: (float(f"{tuned.start[k]:.4g}"), float(f"{v:.4g}"))
                for k, v in tuned.values.items()
            },
            flush=True,
        )
        draw_curves(ax, s, case, errors[case.judged[0]])
    output.save(axes, folder / "tuned.png", fontsize="small")
    print()
    output.write_rows(folder / "rows.csv", rows)
    print()
    output.write_rows(folder / "targets.csv", output.filled(verdicts, ""))


def draw_curves(ax, s, case: Case, errors) -> None:
    """Draw the medians as solid lines and the worst machines as dashed lines over the trials."""
    marker = "o" if max(case.judged[1]) == 1 else None
    for which in ("printed", "structure", "tuned"):
        line = ax.semilogy(
            errors["trial"], errors.sel(scheme=which).median("sample"), marker=marker, label=which
        )[0]
        ax.semilogy(
            errors["trial"],
            errors.sel(scheme=which).max("sample"),
            "--",
            marker=marker,
            linewidth=0.8,
            color=line.get_color(),
        )
    ax.set(
        title=f"{case.scenario}, {case.scheme}",
        xlabel="trial",
        ylabel=f"{case.judged[0]} [{s.shown_unit}]",
    )


if __name__ == "__main__":
    jaxilc.setup()
    main(sys.argv[1:])
