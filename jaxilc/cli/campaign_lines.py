"""Sentences on a campaign: the trial on its prediction, the verdict, and what to do next."""

from __future__ import annotations

import re
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..hardware.checks import Finding
from ..hardware.journal import METRICS

if TYPE_CHECKING:
    from ..hardware.campaign import Campaign
    from ..hardware.prediction import Place, Prediction
    from ..hardware.turn import Turn

LITTLE = 0.02  # share by which the error falls at least in `PATIENCE` trials while it is learned
PATIENCE = 3
_LAST_NUMBER = re.compile(r"^(.*?)(\d+)(\D*)$")


def against_prediction(
    now: Campaign, turn: Turn, prediction: Prediction | None
) -> tuple[str, list[Finding]]:
    """The sentence on what was predicted for a trial, and a finding where it lies outside.

    prediction: prediction of the campaign, None without one; both are then empty, as they are for a
        trial that ended early, whose error is that of a part
    """
    from ..hardware.prediction import next_step

    if prediction is None or turn.record.weight is not None:
        return "", []
    live, unit = now.journal.live(), now.task.unit
    place = _place(prediction, next_step(live), turn.metrics)
    if place is None:
        return "", []
    if prediction.certain:
        median = f"{_median(prediction, place):.3g} {unit}".strip()
        return f"predicted: RMS error {median}; the file gives no uncertainty and no noise", []
    return f"predicted: {_range(place, unit)}, 95 % of {prediction.machines} drawn machines", (
        [] if place.level == "within" else [_outside(now, turn.trial, place, prediction)]
    )


def _outside(now: Campaign, trial: int, place: Place, prediction: Prediction) -> Finding:
    """The finding of a trial outside the 95 % band, with what it means and what to do."""
    above = place.distance > 0
    side = "above" if above else "below"
    if place.level == "slight":
        text = (
            f"trial {trial}: the {place.error} lies slightly {side} the 95 % band, as that of one "
            "trial in twenty does on a machine that is as the file says; look at the next trials"
        )
        return Finding("note", text)
    text = (
        f"trial {trial} lies outside the 95 % band: its {place.error} is {side} it, further out "
        f"than 99 % of the drawn machines come in any of {prediction.trials} trials. The plant "
        "differs from the file"
    )
    if not above:
        text += ": it learns faster, so the margin to instability is not that of the file either"
    elif not prediction.noisy:
        text += (
            ", or it is the noise, of which the file states none: measure a trial twice "
            "(--no-learn) and give the noise under [machine.sensor]"
        )
    state = shlex.quote(str(now.journal.path))
    what_next = "Re-identify" if not above else "Stop and look for the cause, or re-identify"
    return Finding(
        "warning",
        f"{text}. {what_next}: jaxilc identify --state {state} --out {new_plant_file(now.recipe)}",
    )


def new_plant_file(recipe: dict[str, Any]) -> str:
    """A name for a plant file that is fitted to the trials of a campaign: axis.toml, axis-2.toml.

    recipe: recipe of the campaign
    """
    file = recipe.get("file")
    given = Path(str(file.get("given"))) if isinstance(file, dict) else Path("axis.toml")
    found = _LAST_NUMBER.match(given.stem)
    numbered = found is not None and found[1].endswith("-") and not found[3]
    stem = f"{found[1]}{int(found[2]) + 1}" if found and numbered else f"{given.stem}-2"
    return shlex.quote(str(given.with_name(f"{stem}.toml")))


def coming(live: list[dict[str, Any]], prediction: Prediction | None, trial: int, unit: str) -> str:
    """A sentence on what is predicted for the next trial, empty without a band."""
    from ..hardware.prediction import next_step

    step = next_step(live) if live else 1
    if prediction is None or prediction.certain or step > prediction.trials:
        return ""
    low, _, high = (float(end[step - 1]) for end in prediction.rms)
    return f"trial {trial} is predicted to have an RMS error of {low:.3g} to {high:.3g} {unit}"


def verdict(
    live: list[dict[str, Any]],
    turn: Turn | None,
    prediction: Prediction | None,
    unit: str,
    growth: float,
    experiments: Sequence[int] = (),
) -> list[str]:
    """One or two sentences on what the campaign has reached.

    live: manifests of the start and of the trials that count, see `Journal.live`
    turn: the trial of this call, None without one; it counts if it is not among the manifests
    growth: share by which an error may grow without a warning
    experiments: see `checks.experiment_numbers`; empty where no trial is an experiment
    """
    errors = [(m["trial"], m[METRICS]["error"]) for m in live[1:]]
    if turn is not None and (not errors or errors[-1][0] < turn.trial):
        errors.append((turn.trial, turn.metrics["error"]))
    if not errors:
        if prediction is None or prediction.certain:
            return ["no trial is measured yet"]
        low, _, high = (float(end[-1]) for end in prediction.rms)
        after = f"an RMS error of {low:.3g} to {high:.3g} {unit}".rstrip()
        last = prediction.trials
        return [f"no trial is measured yet; the plant file predicts {after} for trial {last}"]
    numbers, last = list(experiments)[: len(errors)] or [0] * len(errors), errors[-1][0]
    errors = [one for one, number in zip(errors, numbers, strict=True) if not number]
    (first, begun), (trial, error) = errors[0], errors[-1]
    if numbers[-1]:
        said = (
            f"verdict: trial {last} is experiment {numbers[-1]} between two learning steps, whose "
            f"error says nothing of them; trial {trial} had an RMS error of {error:.4g} {unit}"
        )
        return [said.rstrip()]
    best, least = min(errors, key=lambda one: one[1])
    said = f"verdict: trial {trial} has an RMS error of {error:.4g} {unit}".rstrip()
    if len(errors) > 1:
        said += f", {_share(error, begun)} of that of trial {first}"
    if error > (1 + growth) * least:
        return [f"{said}; the best was trial {best} with {least:.4g} {unit}".rstrip()]
    before = [value for _, value in errors[:-PATIENCE]]
    if before and least > (1 - LITTLE) * min(before):
        return [
            f"{said}; it has not fallen by {LITTLE:.0%} in the last {PATIENCE} trials: learning "
            f"has ended, and the input of trial {best} may be played from now on"
        ]
    return [said]


def _share(error: float, begun: float) -> str:
    return f"{error / begun:.3g} times" if error > begun else f"{error / begun:.2%}"


def next_command(
    state: Path,
    trial: int,
    measured: Path | None,
    out_file: Path | None,
    columns: Mapping[str, str] | None = None,
) -> str:
    """What to do next: play, record, and the command that takes the record.

    trial: number of the next trial
    measured, out_file: files of this call; the names of the next ones follow them
    columns: options that name columns of the record, with their values
    """
    played = out_file or Path("next.csv")
    record = Path(f"trial-{trial}.csv") if measured is None else _with_number(measured, trial)
    after = _numbered_on(played, trial)
    words = ["jaxilc", "next", "--state", state, "--measured", record]
    words += [word for option in (columns or {}).items() for word in option]
    command = shlex.join(map(str, [*words, "--out", after]))
    return f"play {played}, record it, then: {command}"


def _with_number(path: Path, trial: int) -> Path:
    """The name of the record of a trial after that of another one: trial-3.csv, trial-4.csv."""
    found = _LAST_NUMBER.match(path.stem)
    stem = f"{found[1]}{trial}{found[3]}" if found else f"{path.stem}-{trial}"
    return path.with_name(stem + path.suffix)


def _numbered_on(path: Path, trial: int) -> Path:
    """The name of the file with the next input; its number goes on if it is that of the trial."""
    found = _LAST_NUMBER.match(path.stem)
    if found is None or int(found[2]) != trial:
        return path
    return path.with_name(f"{found[1]}{trial + 1}{found[3]}{path.suffix}")


def turn_numbers(
    live: list[dict[str, Any]], turn: Turn | None, prediction: Prediction | None
) -> dict[str, Any]:
    """The trial of a call and its prediction, for the file of `--json`."""
    from ..hardware.prediction import next_step

    if turn is None:
        return {}
    kept = live[:-1] if live and live[-1]["trial"] == turn.trial else live
    place = None if prediction is None else _place(prediction, next_step(kept), turn.metrics)
    found: dict[str, Any] = {
        "trial": turn.trial,
        "metrics": turn.metrics,
        "findings": [f._asdict() for f in turn.findings],
    }
    return found if place is None else found | {"predicted": place._asdict()}


def _place(prediction: Prediction, step: int, metrics: dict[str, Any]) -> Place | None:
    from ..hardware.prediction import place_of

    return place_of(prediction, step, metrics["error"], max(metrics["max_error"]))


def _median(prediction: Prediction, place: Place) -> float:
    return float(prediction.rms.median[place.step - 1])


def _range(place: Place, unit: str) -> str:
    rms, most = (" to ".join(f"{end:.3g}" for end in band) for band in (place.rms, place.largest))
    return f"RMS error {rms} {unit}".rstrip() + f", largest {most} {unit}".rstrip()
