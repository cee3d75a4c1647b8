"""The plant file that `jaxilc identify` writes: the fitted numbers, a task and a law to start with.

The file holds numbers, so that no command that takes it fits the record again.

The plant file of a campaign gets another plant, fitted to the campaign's own trials: the tables
`[plant]` and `[uncertainty]` are replaced, and a table `[grid]`, whose axes may be those of the
plant, is left out. Task, machine, schemes and comments stay as they are, so that the campaign can
go on with the new file, and its predictions are those of the fitted plant.
"""

from __future__ import annotations

import dataclasses
import json
import re
import tomllib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias, cast

import numpy as np

from ..identification import Estimate, Identified, Record, not_significant
from ..plants import ModalModel, Plant, ProcessModel
from ..pytree.named_paths import interval_at
from ..storage.files import atomically
from ..storage.printable import printable
from ..storage.reading import LARGEST_TREE, read_text, tree_of
from ..theory.on_lines import MeasuredResponse
from ..uncertainty import Uniform
from .starting_law import ORDER, StartingLaw, StartingTask, starting_law, starting_task

TRIALS = 20
RATES = ("poles", "frequencies", "dampings")
REPLACED = ("plant", "uncertainty", "grid")
STALE = (  # beginnings of the comments of a file that `identify` wrote, which hold for its fit only
    "# Plant fitted by `jaxilc identify`", "# Record: ", "# Response: ", "# Order ", "# Fit ",
    "# The output at rest was", "# The residual is not white", "# are too narrow.",
    "# widened to what its", "# Its zeros are at", "# The fit did not meet", "# Fitted: [plant]",
    "# Chosen for ",
    "# sup |Q (1 - L P)|", "# learning is stable where it is", "# fitted plant.",
)  # fmt: skip
_BARE = re.compile(r"[A-Za-z0-9_-]+")
_HEADER = re.compile(r"""^\s*\[{1,2}\s*(["']?)([\w-]+)\1\s*(?:\.[^\]]*)?\]{1,2}\s*(?:\#.*)?$""")
Fittable: TypeAlias = ProcessModel | ModalModel


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
    learning is stable on the fitted plant and at the ends of the intervals (`starting_law`).
    Comments say what was fitted.

    measured: the record or the response that was fitted
    dt: sample time with which a response was fitted [s]
    source: name of the record, for the comments
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
    law = starting_law(plant, uncertainty, facts.dt, facts.samples)
    over = "the ends of these intervals"
    if law is None and uncertainty:
        law, over = starting_law(plant, {}, facts.dt, facts.samples), "the fitted plant only"
    lines = [
        *_heading(found, facts, source),
        f"trials = {TRIALS}",
        *_plant(plant, facts.dt, found.parameters.get("delay")),
        *_uncertainty(uncertainty, left_out, found.apart is not None),
        *_task(law, plant, facts, units),
        *_scheme(law, over, plant),
    ]
    text = "\n".join(lines) + "\n"
    atomically(path, lambda file: file.write(text.encode()))
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


# The tables
# --------------------------------------------------------------------------------------------------


def _heading(found: Identified, facts: Experiment, source: str) -> Iterator[str]:
    plant = cast(Fittable, found.plant)
    poles, pairs = np.size(plant.poles), np.size(plant.frequencies)
    validation = float(found.validation_fit[0])
    yield f"# Plant fitted by `jaxilc identify` to {comment(source)}."
    yield f"# {facts.said}."
    if isinstance(plant, ProcessModel):
        counts = f"real poles {poles}, pairs of poles {pairs}, zeros {np.size(plant.zeros)}"
    else:
        counts = f"lags {poles}, modes {pairs}, integrators {plant.order - poles - 2 * pairs}"
    yield f"# Order {plant.order}: {counts}."
    if isinstance(plant, ModalModel):
        places = ", ".join(f"{zero:.4g}" for zero in plant.all_zeros() if zero.imag >= 0)
        yield f"# Its zeros are at {places or 'none'} rad/s (and their conjugates)."
    residual = (
        "residual over scatter" if found.of_response else "standard deviation of the residual"
    )
    yield (
        f"# Fit {found.fit[0]:.4g} %"
        + (f", of the validation part {validation:.4g} %" if np.isfinite(validation) else "")
        + f"; {residual} {found.residual_std[0]:.4g}."
    )
    if "bias" in found.parameters:
        at_rest = found.parameters["bias"].value
        yield f"# The output at rest was {at_rest:.6g}; the plant starts at 0."
    if not found.white:
        yield "# The residual is not white: another structure may fit better. The intervals are"
        yield "# widened to what its spectrum says."
    yield from (f"# {sentence}." for sentence in not_significant(found))
    if not found.converged:
        yield "# The fit did not meet its tolerances: the structure may be too large."
    yield "# Fitted: [plant] and [uncertainty]. Chosen, to be changed: the other tables."


def _plant(plant: Fittable, dt: float, delay: Estimate | None) -> Iterator[str]:
    product = "gain prod(1 - s / zeros) / (prod(1 + s / poles) ...)"
    what = product if isinstance(plant, ProcessModel) else "a sum of lags and modes"
    yield f"\n[plant]                        # {what}"
    notes = {
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
    for name, value in _plant_values(plant).items():
        if name != "delay":
            yield f"{name} = {_value(value)}" + f"  # {notes.get(name)}" * (name in notes)
    if plant.delay:
        yield f"delay = {float(plant.delay)!r}  # dead time [s], {plant.delay / dt:.4g} samples"
    if delay is not None:
        yield f"# delay: 95 % interval {delay.low:.6g} .. {delay.high:.6g} s; it is not drawn"


def _uncertainty(
    uncertainty: dict[str, Uniform], left_out: dict[str, Estimate], apart: bool
) -> Iterator[str]:
    yield "\n[uncertainty]                  # the 95 % intervals, as if independent of each other"
    if apart:
        yield "# As wide as independent draws of them need to be, to spread the response as far as"
        yield "# the fit is uncertain and the lines are from it."
    for name, (value, low, high) in left_out.items():
        yield (
            f"# {name} = {value:.6g} has none: the record leaves it between {low:.4g} and "
            f"{high:.4g}"
        )
    for name, uniform in uncertainty.items():
        yield (
            f'"{name}" = {{ distribution = "uniform", low = {uniform.low!r}, '
            f"high = {uniform.high!r} }}"
        )


def _task(
    law: StartingLaw | None, plant: Fittable, facts: Experiment, units: tuple[str, str]
) -> Iterator[str]:
    input_unit, unit = units
    yield "\n[task]"
    yield f"dt = {float(facts.dt)!r}  # of the record [s]"
    yield f"unit = {_text(unit)}"
    yield f"input_unit = {_text(input_unit)}"
    start = StartingTask(1.0, 2 / (1000 * facts.dt), 1000 * facts.dt)
    if law is not None:
        start = starting_task(law, plant, facts.largest_input or np.inf, facts.dt)
        if facts.largest_input is None:
            start = start._replace(amplitude=1.0)
    yield "\n[task.reference]               # put your own motion here"
    yield 'function = "sinusoid"'
    yield f"amplitude = {start.amplitude!r}  # with the offset: from 0 to twice this, and back"
    yield f"offset = {start.amplitude!r}"
    yield f"phase = {-np.pi / 2!r}"
    yield f"frequency = {start.frequency!r}  # [Hz]"
    yield f"duration = {start.duration!r}  # [s]"


def _scheme(law: StartingLaw | None, over: str, plant: Fittable) -> Iterator[str]:
    if law is None:
        yield "\n# There is no [schemes.ilc]: no filtered P-type law was found that learns on the"
        yield "# fitted plant."
        if isinstance(plant, ModalModel) and plant.order > 2 * plant.frequencies.size + np.size(
            plant.poles
        ):
            yield "# It integrates: close a loop around it first, by a scheme of"
            yield '# class = "WithFeedback" whose feedback, such as a PID, makes it stable.'
        return
    yield f"\n# Chosen for {over} ({law.machines} machines):"
    yield (
        f"# sup |Q (1 - L P)| is {law.nominal:.3f} on the fitted plant and {law.worst:.3f} at worst"
        f" ({law.at:.3g} Hz);"
    )
    yield "# learning is stable where it is below 1."
    yield "[schemes.ilc]"
    yield 'class = "Filtered"'
    yield f'scheme = {{ class = "PIDType", gamma_p = {law.gamma_p!r}, lead = {law.lead} }}'
    yield (
        f'filter = {{ class = "ZeroPhaseButterworth", cutoff = {law.cutoff!r}, order = {ORDER} }}'
    )


def comment(text: str) -> str:
    """The text on one line, for a comment."""
    return printable(text).replace("\n", " ")


def _text(unit: str) -> str:
    """A unit as a string of TOML, without what a scenario does not allow in one."""
    plain = "".join(c for c in comment(unit) if c not in '[],;$"\\').replace("*/", "/")
    return json.dumps(plain, ensure_ascii=False)


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

    path: file to write, in TOML
    source: plant file of the campaign, in TOML
    fitted_to: what the plant was fitted to, for a comment
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
    wanted = {name: value for name, value in before.items() if name not in REPLACED}
    wanted |= {"plant": _plant_values(found.plant), "uncertainty": _interval_values(found, before)}
    rest = _without_stale(_without(text, REPLACED))
    machine = before.get("machine", {})
    if noise and not {"sensor", "disturbance"} & set(machine):
        wanted["machine"] = {**machine, "sensor": {"noise": float(noise)}}
        rest += ["", "[machine.sensor]", f"noise = {float(noise)!r}  # of the residual of the fit"]
    lines = [
        *rest,
        "",
        f"[plant]  # fitted to {comment(fitted_to)} by `jaxilc identify`; "
        f"fit {float(np.min(found.fit)):.4g} %",
        *(f"# {comment(note)}" for note in notes),
        *(f"{key} = {_value(value)}" for key, value in wanted["plant"].items()),
        "",
        "[uncertainty]  # of the plant: the 95 % intervals of the fit",
        *(f"{_key(name)} = {_value(of)}" for name, of in wanted["uncertainty"].items()),
    ]
    new = "\n".join(lines).strip("\n") + "\n"
    try:
        sound = tomllib.loads(new) == wanted
    except tomllib.TOMLDecodeError:
        sound = False
    if not sound:
        raise ValueError(
            f"{source}: its tables [plant] and [uncertainty] cannot be replaced as they are "
            "written; write each under a heading of its own, such as [plant]"
        )
    atomically(path, lambda file: file.write(new.encode()))
    return path


def _plant_values(plant: Plant) -> dict[str, Any]:
    """The keys of `[plant]`; those of features that the plant does not have are left out."""
    there = {f.name: getattr(plant, f.name) for f in dataclasses.fields(plant)}
    values = {n: np.asarray(v, float).tolist() for n, v in there.items() if v is not None}
    if not values["delay"]:
        del values["delay"]
    return {"kind": type(plant).__name__, **values}


def _interval_values(found: Identified, before: dict[str, Any]) -> dict[str, Any]:
    """The intervals of the fit, and those of the file that are not of the plant."""
    kept = {
        name: of
        for name, of in dict(before.get("uncertainty", {})).items()
        if name.partition(".")[0] != "plant"
    }
    return kept | {
        name: {"distribution": "uniform", "low": one.low, "high": one.high}
        for name, one in intervals(found)[0].items()
    }


def _without(text: str, tables: tuple[str, ...]) -> list[str]:
    """The lines of a TOML text that do not stand in these tables."""
    kept, within = [], False
    for line in text.splitlines():
        header = _HEADER.match(line)
        if header:
            within = header[2] in tables
        if not within:
            kept.append(line)
    return kept


def _without_stale(lines: list[str]) -> list[str]:
    """The lines without the comments in which `identify` told of an earlier fit and its law."""
    if not any(line.startswith(STALE[0]) for line in lines):
        return lines
    return [line for line in lines if not line.startswith(STALE)]


def _names_files(value: Any) -> bool:
    """Whether a part of a plant file that stays names another file."""
    if isinstance(value, list):
        return any(map(_names_files, value))
    if not isinstance(value, dict):
        return False
    return "csv" in value or any(
        _names_files(of) for name, of in value.items() if name not in REPLACED
    )


def _key(name: str) -> str:
    return name if _BARE.fullmatch(name) else json.dumps(name, ensure_ascii=False)


def _value(value: Any) -> str:
    """A value of a plant file as TOML."""
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{_key(k)} = {_value(v)}" for k, v in value.items()) + " }"
    if isinstance(value, list):
        return "[" + ", ".join(map(_value, value)) + "]"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)
    return json.dumps(value) if isinstance(value, bool) else repr(value)
