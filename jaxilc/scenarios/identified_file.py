"""The plant file that `jaxilc identify` writes: the fitted numbers, a task and a law to start with.

The file holds numbers, so that no command that takes it fits the record again.

The plant file of a campaign gets another plant, fitted to the campaign's own trials: the tables
`[plant]` and `[uncertainty]` are replaced, and a table `[grid]`, whose axes may be those of the
plant, is left out. Task, machine, schemes and comments stay as they are, so that the campaign can
go on with the new file, and its predictions are those of the fitted plant.
"""

from __future__ import annotations

import dataclasses
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple, TypeAlias, cast

import numpy as np

from ..filters import ZeroPhaseButterworth
from ..identification import Estimate, Identified, Record, not_significant
from ..learning.machine import Machine
from ..plants import ModalModel, Plant, ProcessModel
from ..pytree.aliases import Value
from ..pytree.named_paths import interval_at
from ..schemes import Filtered, PIDType
from ..signals.task import Task
from ..storage.files import write_file
from ..storage.reading import LARGEST_TREE, printable, read_text, tree_of
from ..theory.frequency import Largest, Loop, grid, largest_of
from ..theory.law import law_of
from ..theory.loop import loops_of, minimal, responses
from ..theory.on_lines import Lines, MeasuredResponse, low_pass, rounded, widest
from ..uncertainty import Population, Uncertainty, Uniform
from .design_file import toml_lines, toml_value, without_tables
from .file_task import distributions_in

# The law to start with
# --------------------------------------------------------------------------------------------------


ORDER = 2  # of the filter, in one pass
LARGEST = (0.9, 0.97)  # values of |Q (1 - L P)| that are allowed; the second if the first fails
SHARES = (0.15, 0.25, 0.4, 0.6, 0.8, 1.0)  # of the inverse of the DC gain, tried as learning gain
CORNERS = 8  # parameters up to which all corners of their intervals are taken
DRAWN = 129  # machines that are taken for more parameters
NEAREST = 4  # of the worst machines on the grid, whose largest value is enclosed
Fittable: TypeAlias = ProcessModel | ModalModel


class StartingLaw(NamedTuple):
    """A learning law, and what the theory says about it.

    gamma_p: learning gain [unit of u per unit of y]
    lead: samples of look-ahead
    cutoff: of the robustness filter [Hz]
    machines: number of machines for which it was chosen, the fitted one included
    nominal, worst: sup |Q (1 - L P)| of the fitted plant and of the worst of these machines
    at: frequency of the worst value [Hz]
    within: whether it learns within all intervals that it was looked for in
    """

    gamma_p: float
    lead: int
    cutoff: float
    machines: int
    nominal: float
    worst: float
    at: float
    within: bool = True

    @property
    def scheme(self) -> Filtered:
        learning = PIDType(gamma_p=self.gamma_p, lead=self.lead)
        return Filtered(learning, ZeroPhaseButterworth(cutoff=self.cutoff, order=ORDER))

    @property
    def told(self) -> str:
        """The law and what the theory says about it, in words."""
        over = f"at worst of {self.machines} machines"
        return (
            f"P-type learning with gamma_p = {self.gamma_p:g}, lead = {self.lead} and a cutoff of "
            f"{self.cutoff:g} Hz; sup |Q (1 - L P)| = {self.worst:.3f} "
            + (over if self.machines > 1 else "on the fitted plant only")
            + "; within all intervals of the file no such law was found" * (not self.within)
        )


class StartingTask(NamedTuple):
    """A sinusoid from rest to 2 amplitude and back, which the law learns.

    amplitude: [unit of y];  frequency: [Hz];  duration: [s], two periods
    """

    amplitude: float
    frequency: float
    duration: float


def starting_law(
    plant: Fittable,
    uncertainty: Uncertainty,
    dt: float,
    samples: int,
    *,
    highest: float = np.inf,
    without: Uncertainty | None = None,
) -> StartingLaw | None:
    """The filtered P-type law of the largest cutoff that learns on every plant of the intervals.

        u_{j+1} = Q (u_j + gamma_p e_j[k+1+lead]),    sup_w |Q (1 - gamma_p z^(1+lead) P)| <= 0.9

    The largest value of the condition is looked for over the corners of the intervals (over draws
    where there are many parameters), on a grid of frequencies; those of the fitted plant and of the
    worst corners are then enclosed between the lines of the grid, with the law of the scheme's own
    program. Among laws whose cutoff is at least 0.7 of the largest possible one, the fastest at
    low frequencies is taken. Where 0.9 cannot be reached, 0.97 is allowed.

    uncertainty: distributions of leaves, named as in a plant file, such as `plant.gain`
    dt: sample time [s]
    samples: length of the record, which limits lead and cutoff
    highest: largest cutoff [Hz]
    without: distributions that are taken where there is no such law with those of `uncertainty`
    The result is None where there is no such law, for instance where the sign of the DC gain is
    not known.
    """
    machine, long = Machine(plant), Task(np.zeros(max(samples, 16)), dt=dt)
    corners = "corners" if len(uncertainty) <= CORNERS else "sobol"
    machines = Population(machine, uncertainty, count=DRAWN, sampling=corners).machines
    f = grid(long, points=300, near=np.exp(np.asarray(plant.all_poles) * dt))
    loops = loops_of(machines, None, Task(np.zeros(16), dt=dt))
    P = responses(loops, f, dt)
    for largest in LARGEST:
        law = _largest_cutoff(P, f, dt, long, largest, round(plant.delay / dt))
        law = law and law._replace(cutoff=min(law.cutoff, rounded(highest, 2)))
        for _ in range(4):
            if law is None:
                break
            kept = 1 - law.gamma_p * np.exp(2j * np.pi * f * dt * (1 + law.lead)) * P
            sizes = np.max(low_pass(f, law.cutoff, dt, ORDER) * np.abs(kept), axis=1)
            nominal, *others = _enclosed(loops, [0, *np.argsort(-sizes)[:NEAREST]], law, dt)
            worst = max(others, key=lambda one: one.value)
            law = law._replace(
                nominal=float(nominal.value), worst=float(worst.value), at=float(worst.worst)
            )
            if law.worst < (1 + largest) / 2:
                return law
            law = law._replace(cutoff=rounded(0.7 * law.cutoff, 2))
    if without is None or without == uncertainty:
        return None
    law = starting_law(plant, without, dt, samples, highest=highest)
    return law and law._replace(within=False)


def starting_task(
    law: StartingLaw | None, plant: Fittable, largest_input: float | None, dt: float
) -> StartingTask:
    """Two periods of a sinusoid at a fifth of the law's cutoff, or slower.

    Its amplitude needs at most half of the largest input of the record, by the fitted gain. Where
    there is no law there are 1000 samples; where there is none or no such input, it is 1.
    """
    if law is None:
        return StartingTask(1.0, 2 / (1000 * dt), 1000 * dt)
    samples = int(np.clip(round(10 / (law.cutoff * dt)), max(100, 8 * law.lead), 20000))
    frequency = 2 / (samples * dt)
    if largest_input is None:
        return StartingTask(1.0, frequency, samples * dt)
    slowest = 1e-3 * frequency  # for the gain at rest, also where the plant integrates
    gain = np.abs([_response_of(plant, 2j * np.pi * f) for f in (slowest, frequency)])
    allowed = 0.5 * largest_input / np.sum(1 / gain)
    return StartingTask(rounded(float(allowed), 1), float(frequency), samples * dt)


# How it is done
# --------------------------------------------------------------------------------------------------


def _largest_cutoff(P, f, dt, task, largest, delay: int) -> StartingLaw | None:
    """The law that is chosen on the grid, whose largest values are not known yet, or None.

    P: (S, F) responses of the machines at frequencies f (F,) [Hz]
    delay: of the plant, in samples
    """
    steady = P[:, 0].real
    if np.any(steady * steady[0] <= 0) or not np.all(np.isfinite(P)):
        return None
    leads = np.r_[0, np.geomspace(1, max(1, min(500, task.N // 8)), 40).astype(int)]
    leads = np.unique(np.r_[leads, delay + leads])
    unit = 1 / np.max(np.abs(steady))
    gains = [rounded(share * unit, 3) * np.sign(steady[0]) for share in SHARES]
    lowest = min(2 / task.duration, 0.1 / dt)
    ahead = np.exp(2j * np.pi * f * dt)  # of a law of gain 1 and lead 0
    lines = Lines(f, P, np.zeros(P.shape), np.ones(len(f)), ahead, dt)
    law = widest([lines], ORDER, gains, leads, largest, lowest)
    if law is None:
        return None
    cutoff = rounded(min(law.cutoff, 0.4 / dt), 2)
    return StartingLaw(law.gain, law.lead, cutoff, len(P), np.inf, np.inf, np.nan)


def _enclosed(loops: list[Loop], which, law: StartingLaw, dt: float) -> list[Largest]:
    """sup |Q (1 - L P)| of some of the loops, enclosed over all frequencies."""
    task = Task(np.zeros(max(64, 2 * law.lead)), dt=dt)
    taps = law_of(law.scheme, task)
    reduced = [minimal(loops[i], task.N) for i in which]
    return [largest_of(taps, loop, task) for loop in reduced]


def _response_of(plant: Fittable, s: complex) -> complex:
    """G(s) without the delay, of which the size does not depend."""
    if isinstance(plant, ModalModel):
        return complex(np.asarray(plant.transfer(np.array([s])))[0, 0, 0])
    zeros, poles, w, zeta = (
        np.asarray(x) for x in (plant.zeros, plant.poles, plant.frequencies, plant.dampings)
    )
    slow = np.prod(1 + s / poles) * np.prod(1 + 2 * zeta * s / w + (s / w) ** 2)
    return complex(float(plant.gain) * np.prod(1 - s / zeros) / slow)


# The plant file
# --------------------------------------------------------------------------------------------------


TRIALS = 20
RATES = ("poles", "frequencies", "dampings")
REPLACED = ("plant", "uncertainty", "grid")
STALE = (  # beginnings of the comments of a file that `identify` wrote, which hold for its fit only
    "# Plant fitted by `jaxilc identify`", "# Record: ", "# Response: ", "# Order ", "# Fit ",
    "# The output at rest was", "# The residual is not white", "# are too narrow.",
    "# widened to what its", "# Its zeros are at", "# The fit did not meet", "# Fitted: [plant]",
    "# Chosen for ", "# no such law was found within",
    "# The file states no noise.", "#[machine.sensor]", "#noise = ",
    "# sup |Q (1 - L P)|", "# learning is stable where it is", "# fitted plant.",
)  # fmt: skip


class Experiment(NamedTuple):
    """What a plant file tells of the experiment to which its plant was fitted.

    dt: sample time [s]
    said: sentence on what was measured and fitted
    samples: length of trials that the law is chosen for
    largest_input: largest |u|; None where it is not known
    """

    dt: float
    said: str
    samples: int
    largest_input: float | None

    @classmethod
    def of(cls, measured: Record | MeasuredResponse, found: Identified, dt: float) -> Experiment:
        """The facts of a record, or of a response whose lines were fitted with sample time dt."""
        if isinstance(measured, MeasuredResponse):
            f = measured.frequencies
            said = (
                f"Response: {len(f)} lines from {f[0]:.4g} to {f[-1]:.4g} Hz, as sampled every "
                f"{dt:g} s behind a hold"
            )
            return cls(dt, said, int(np.clip(round(1 / (f[0] * dt)), 16, 20000)), None)
        said = (
            f"Record: {len(measured.y)} samples of {measured.dt:g} s; {found.samples} were fitted, "
            "the others validate the fit"
        )
        largest = float(np.max(np.abs(np.asarray(measured.u))))
        return cls(measured.dt, said, len(measured.u), largest)


def write_plant_file(
    path: str | Path,
    found: Identified,
    measured: Record | MeasuredResponse,
    *,
    dt: float | None = None,
    source: str,
    units: tuple[str, str] = ("", ""),
    force: bool = False,
) -> StartingLaw | None:
    """Write a fitted plant as a file that stands in a scenario's place.

    The table `[plant]` is the `ProcessModel` or `ModalModel` with the fitted numbers,
    `[uncertainty]` has their 95 % intervals, and `[task]` and `[schemes.ilc]` are chosen so that
    learning is stable on the fitted plant and at the ends of the intervals (`starting_law`). Where
    there is no such law, it is one for the fitted plant only, as `within` of the result says.
    Comments say what was fitted.

    measured: the record or the response that was fitted
    dt: sample time with which a response was fitted [s]
    units: units of input and output, as the record names them
    force: whether a file of this name is replaced
    The result is the law, or None where there is none; the file then has no scheme.
    Raises FileExistsError for a file that exists, and ValueError for a plant of another class.
    """
    if Path(path).exists() and not force:
        raise FileExistsError(f"{path} exists already; add --force to replace it")
    plant = found.plant
    if not isinstance(plant, ProcessModel | ModalModel) or plant.n_u * plant.n_y > 1:
        raise ValueError(
            f"write_plant_file: the plant is a {type(plant).__name__}; allowed are a ProcessModel "
            "and a ModalModel of one input and one output"
        )
    if dt is None and isinstance(measured, MeasuredResponse):
        raise ValueError(
            "write_plant_file: dt = None; allowed is the sample time with which the response was "
            "fitted (--dt): a plant file has samples"
        )
    facts = Experiment.of(measured, found, dt or 0.0)
    uncertainty, left_out = intervals(found)
    law = starting_law(plant, uncertainty, facts.dt, facts.samples, without={})
    input_unit, unit = map(_text, units)
    text = _text_of(
        found, facts, law, uncertainty=uncertainty, left_out=left_out,
        source=comment(source), unit=unit, input_unit=input_unit,
    )  # fmt: skip
    write_file(path, text)
    return law


def intervals(found: Identified) -> tuple[dict[str, Uniform], dict[str, Estimate]]:
    """The 95 % intervals of the fitted leaves as distributions, by their names in a plant file.

    The second result has the leaves that get none: an interval that is not finite, of no width, or
    that reaches 0 or beyond the range of the leaf. Numerators of a sum of parts may change sign.
    """
    plant, certain, left_out = found.plant, {}, {}
    for name, estimate in (found.apart or found.parameters).items():
        if name.startswith(("bias", "delay")):  # no leaves of the plant
            continue
        value, low, high = estimate
        allowed = interval_at(plant, name)
        summed = isinstance(plant, ModalModel) and not name.startswith(RATES)
        sound = np.isfinite([low, high]).all() and low < value < high
        sound = sound and (summed or low * high > 0)
        if sound and (allowed is None or allowed.contains(np.array([low, high]))):
            certain[f"plant.{name}"] = Uniform(low, high)
        else:
            left_out[f"plant.{name}"] = estimate
    return certain, left_out


# What a key of [plant] is, for the comment behind it.
NOTES = {
    "gain": "DC gain [unit per input_unit]",
    "zeros": "[rad/s], positive: non-minimum phase",
    "poles": "[rad/s], positive: stable",
    "pole_gains": "DC gain of each of these lags [unit per input_unit]",
    "frequencies": "of the pairs of poles [rad/s]",
    "dampings": "of the pairs of poles",
    "mode_gains": "DC gain of each pair",
    "mode_rates": "what each pair gives of its rate",
    "integrator": "[unit per input_unit and s]",
    "double_integrator": "[unit per input_unit and s^2]",
    "direct": "direct feedthrough, seen a sample later",
}


def _text_of(found: Identified, facts: Experiment, law: StartingLaw | None, **more: object) -> str:
    """The content of the file, by the layout in `identified.toml.jinja2`."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    plant = cast(Fittable, found.plant)
    lags, pairs, modal = np.size(plant.poles), np.size(plant.frequencies), False
    if isinstance(plant, ProcessModel):
        counts = f"real poles {lags}, pairs of poles {pairs}, zeros {np.size(plant.zeros)}"
    else:
        modal, integrators = True, plant.order - lags - 2 * pairs
        counts = f"lags {lags}, modes {pairs}, integrators {integrators}"
        more["zeros"] = ", ".join(f"{z:.4g}" for z in plant.all_zeros() if z.imag >= 0)
        more["integrates"] = integrators > 0
    validation = float(found.validation_fit[0])
    validated = f", of the validation part {validation:.4g} %" if np.isfinite(validation) else ""
    made = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        undefined=StrictUndefined,
    )
    made.filters |= {"g4": "{:.4g}".format, "g6": "{:.6g}".format, "toml": toml_value}
    return made.get_template("identified.toml.jinja2").render(
        **{"integrates": False} | more,
        found=found,
        facts=facts,
        plant=plant,
        law=law,
        start=starting_task(law, plant, facts.largest_input, facts.dt),
        modal=modal,
        counts=counts,
        validated=validated,
        residual="residual over scatter"
        if found.of_response
        else "standard deviation of the residual",
        bias=found.parameters.get("bias"),
        doubts=not_significant(found),
        trials=TRIALS,
        formula="a sum of lags and modes"
        if modal
        else "gain prod(1 - s / zeros) / (prod(1 + s / poles) ...)",
        values=plant_values(plant),
        notes=NOTES,
        delay=found.parameters.get("delay"),
        phase=-np.pi / 2,
        order=ORDER,
    )


def comment(text: str) -> str:
    """The text on one line, for a comment."""
    return printable(text).replace("\n", " ")


def _text(unit: str) -> str:
    """A unit as a string of TOML, without what a scenario does not allow in one."""
    plain = "".join(c for c in comment(unit) if c not in '[],;$"\\').replace("*/", "/")
    return toml_value(plain)


# The file of a campaign
# --------------------------------------------------------------------------------------------------


def write_refitted(
    path: Path,
    source: Path,
    found: Identified,
    *,
    fitted_to: str,
    noise: float | None = None,
    notes: Sequence[str] = (),
) -> Path:
    """Write the plant file of a campaign with the fitted plant in place of its own.

    noise: standard deviation of the noise of the sensor [unit of y], None to state none; it is left
        out where the file has a table `[machine]` with a sensor or a disturbance
    notes: sentences on the fit, for comments; those of an earlier fit go
    Intervals of leaves that are not of the plant stay in `[uncertainty]`.
    Raises ValueError for a file that cannot be changed in this way, with the reason.
    """
    text = read_text(source, LARGEST_TREE)
    before = tree_of(text, tomllib.loads, source)
    if path.absolute().parent != source.absolute().parent and _names_files(before):
        raise ValueError(
            f"{source} names files relative to its folder; write the new plant file there"
        )
    rest = _without_stale(without_tables(text, REPLACED).rstrip().splitlines())
    if noise and not {"sensor", "disturbance"} & before.get("machine", {}).keys():
        rest += ["", "[machine.sensor]", f"noise = {float(noise)!r}  # of the residual of the fit"]
    lines = [
        *rest,
        "",
        f"[plant]  # fitted to {comment(fitted_to)} by `jaxilc identify`; "
        f"fit {float(np.min(found.fit)):.4g} %",
        *(f"# {comment(note)}" for note in notes),
        toml_lines(plant_values(found.plant)),
        "[uncertainty]  # of the plant: the 95 % intervals of the fit",
        toml_lines(_interval_values(found, before)),
    ]
    new = "\n".join(lines).strip("\n") + "\n"
    try:
        tomllib.loads(new)
    except tomllib.TOMLDecodeError:
        raise ValueError(
            f"{source}: its table `machine` cannot get a sensor as it is written; write it under a "
            "heading of its own, such as [machine]"
        ) from None
    write_file(path, new)
    return path


def plant_values(plant: Plant) -> dict[str, Value]:
    """The keys of `[plant]`; those of features that the plant does not have are left out."""
    there = {f.name: getattr(plant, f.name) for f in dataclasses.fields(plant)}
    values = {n: np.asarray(v, float).tolist() for n, v in there.items() if v is not None}
    if not values["delay"]:
        del values["delay"]
    return {"kind": type(plant).__name__, **values}


def _interval_values(found: Identified, before: dict[str, Value]) -> dict[str, Value]:
    """The intervals of the fit, and those of the file that are not of the plant."""
    given = distributions_in(before.get("uncertainty", {}), "uncertainty")
    kept = {name: of for name, _, of in given if name.partition(".")[0] != "plant"}
    return kept | {
        name: {"distribution": "uniform", "low": one.low, "high": one.high}
        for name, one in intervals(found)[0].items()
    }


def _without_stale(lines: list[str]) -> list[str]:
    """The lines without the comments in which `identify` told of an earlier fit and its law."""
    if not any(line.startswith(STALE[0]) for line in lines):
        return lines
    return [line for line in lines if not line.startswith(STALE)]


def _names_files(value: object) -> bool:
    """Whether a part of a plant file that stays names another file."""
    if isinstance(value, list):
        return any(map(_names_files, value))
    if not isinstance(value, dict):
        return False
    return "csv" in value or any(
        _names_files(of) for name, of in value.items() if name not in REPLACED
    )
