"""What a campaign should measure if the machine is as its file says: a band of errors by trial.

Machines are drawn from the uncertainty of the file. Each learns by itself, with its noise, from the
memory with which the campaign started. So the band of trial j holds what the law has learned from
the trials before on a machine of this kind, and a machine that learns well is not outside it.

A campaign computes its prediction once and keeps it as a file in its folder. The file has a
checksum and names what it was computed from. One that is missing, damaged, of another machine or
too short is computed again; nothing else depends on it.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from functools import reduce
from itertools import accumulate
from pathlib import Path
from typing import NamedTuple, cast

import numpy as np

from ..learning.machine import Machine
from ..pytree.aliases import Value
from ..pytree.ranges import is_number, is_whole
from ..runtime.lanes import usual_lanes
from ..runtime.provenance import checksum_of, describe
from ..schemes import Scheme
from ..signals.task import Task
from ..storage.sealed import Damaged, read_json, sealed, unsealed, write_json
from ..sweeps.host import Host
from ..sweeps.plan import Chunk, Plan
from ..uncertainty import Population, Uncertainty
from .journal import Manifest, is_part

FILE, FORMAT = "prediction.json", 1
MACHINES, SEED = 256, 20250  # drawn machines, and the seed of their draw and of their noise
OUTSIDE = 0.025  # share of the machines that lies beyond each side of the band
RARE = 0.01  # share of the machines whose whole course goes further out than the band of a course
SAME = 0.01  # share by which an error may differ from the median without meaning anything
SMALLEST = 1e-12  # share of the largest reference; errors below it are rounding
# What a machine may draw for each trial, with the number of each by which nothing is drawn.
STILL = {"scatter": 0, "shortest": 1, "dropped": 0, "late": 0, "delayed": 0}
WORK = 1e8  # samples that are simulated at most, of all machines and trials


class Subject(NamedTuple):
    """What is predicted: a machine with its uncertainty, the scheme that learns, and its task."""

    machine: Machine
    scheme: Scheme
    task: Task
    uncertainty: Uncertainty

    @property
    def noisy(self) -> bool:
        """Whether the file gives the machine any noise."""
        sensor, disturbance = self.machine.sensor, self.machine.disturbance
        found = (
            getattr(sensor, "noise", None),
            getattr(disturbance, "input_noise", None),
            getattr(disturbance, "output_noise", None),
        )
        return any(noise is not None and bool(np.any(np.asarray(noise) > 0)) for noise in found)

    @property
    def machines(self) -> int:
        """The number of machines to draw; one where all of them would be the same."""
        values = {name: getattr(self.machine.variation, name, None) for name in STILL}
        varied = (v is not None and np.any(np.asarray(v) != STILL[n]) for n, v in values.items())
        return MACHINES if self.noisy or self.uncertainty or any(varied) else 1


class Band(NamedTuple):
    """The ends of the 95 % band and the median of an error by trial, each (J,) [unit of y].

    An end is infinite where more than 2.5 % of the drawn machines diverge.
    """

    low: np.ndarray
    median: np.ndarray
    high: np.ndarray


class Prediction(NamedTuple):
    """The predicted errors of the trials 1 .. J.

    machines: number of drawn machines, 1 where the file gives neither uncertainty nor noise, and
        draws nothing for each trial
    noisy: whether the file gives the machine noise
    rms: band of the RMS error over all outputs
    largest: band of the largest error of all outputs
    course: how far out, in the measure of `distance`, 99 % of the drawn machines stay in all J
        trials and in both errors
    smallest: errors below this are counted as this [unit of y]
    """

    machines: int
    noisy: bool
    rms: Band
    largest: Band
    course: float
    smallest: float

    @property
    def trials(self) -> int:
        """The number J of predicted trials."""
        return len(self.rms.median)

    @property
    def certain(self) -> bool:
        """Whether there is no band, because the file gives nothing that is drawn."""
        return self.machines == 1

    def bands(self) -> dict[str, dict[str, list[float]]]:
        """The ends and medians of both errors, as JSON."""
        return as_lists(self.rms, self.largest)

    def as_json(self) -> dict[str, Value]:
        """The prediction as its file and manifests keep it."""
        return {**self._asdict(), **self.bands()}

    def at(self, step: int, manifest: Manifest | None = None) -> Prediction | None:
        """The prediction of one trial, None where there is none.

        manifest: that of the trial, if it is stored; it keeps what was predicted when it was
            measured, of whatever plant file
        """
        kept = (manifest or {}).get("predicted")
        found = _from_json(kept) if isinstance(kept, dict) else None
        if found is not None or not 1 <= step <= self.trials:
            return found
        rms, largest = (
            Band(*(x[step - 1 : step] for x in band)) for band in (self.rms, self.largest)
        )
        return self._replace(rms=rms, largest=largest)


def as_lists(rms: Band, largest: Band) -> dict[str, dict[str, list[float]]]:
    """The bands of both errors, as JSON."""
    return {
        name: {end: values.tolist() for end, values in band._asdict().items()}
        for name, band in (("rms", rms), ("largest", largest))
    }


class Place(NamedTuple):
    """Where a measured trial lies on its prediction.

    step: number of the predicted trial: 1 + the trials that were learned from before, 0 if one of
        these ended early
    rms, largest: (low, high) of the two bands [unit of y]
    distance: `distance` of the error that lies further out; its sign is that of the side
    error: the error that lies further out, `RMS error` or `largest error`
    level: `within` the band; `slight`, outside it, but no further than 99 % of the drawn machines
        go in some trial; or `clear`, further out than that
    """

    step: int
    rms: tuple[float, float]
    largest: tuple[float, float]
    distance: float
    error: str
    level: str


def predict(subject: Subject, trials: int) -> Prediction:
    """The band of errors by trial, from the simulation of drawn machines.

    trials: J >= 1; fewer are predicted where their simulation would take long, see `WORK`
    Raises ValueError where the uncertainty does not fit the machine, or the task does not fit RAM.
    """
    return prediction_of(*simulated(subject, trials), subject)


def longest(subject: Subject) -> int:
    """The number of trials that are predicted at most."""
    return max(1, int(WORK / (subject.machines * subject.task.N)))


def simulated(subject: Subject, trials: int) -> tuple[np.ndarray, np.ndarray]:
    """(S, J) the RMS errors over all outputs, and the largest errors, of drawn machines."""
    machine, scheme, task, uncertainty = subject
    machines = subject.machines
    plan = Plan(
        Population(machine, uncertainty, count=machines + 1, seed=SEED),
        {"law": scheme},
        task,
        min(trials, longest(subject)),
        chunk=machines,
        lanes=usual_lanes(),  # ty: ignore[invalid-argument-type]  None is what the backend holds
        first=1,  # the nominal machine is no draw
    )
    found = Host(plan, shared=True).compute(Chunk(0, "law", 0, 0, machines))
    rms, largest = (
        np.asarray(found[name], float).reshape(machines, plan.trials, -1)
        for name in ("rms", "max_error")
    )
    return np.sqrt(np.mean(rms**2, axis=2)), np.max(largest, axis=2)


def prediction_of(errors: np.ndarray, largest: np.ndarray, subject: Subject) -> Prediction:
    """The prediction that simulated errors give.

    errors, largest: (S, J) RMS error and largest error of S machines; not finite where one diverged
    """
    smallest = max(SMALLEST * float(np.max(np.abs(subject.task.reference))), 1e-300)
    both = [np.maximum(np.where(np.isnan(x), np.inf, x), smallest) for x in (errors, largest)]
    bands = [_band(values) for values in both]
    out = np.max(
        [
            np.max(np.abs(distance(band, values, smallest)), axis=1)
            for band, values in zip(bands, both, strict=True)
        ],
        axis=0,
    )
    # The machine is one more draw. It goes further out than the k-th largest of S draws with the
    # chance k / (S + 1), in any of the J trials.
    course = np.sort(out)[-max(1, int(RARE * (len(out) + 1)))]
    return Prediction(
        len(errors), subject.noisy, bands[0], bands[1], float(max(1.0, course)), smallest
    )


def _band(values: np.ndarray) -> Band:
    """The band of each trial; at least `SAME` of the median to each side."""
    ordered = np.sort(values, axis=0)
    count = len(ordered)
    beyond = max(1, int(OUTSIDE * (count + 1))) - 1
    median = ordered[(count - 1) // 2]
    low = np.minimum(ordered[beyond], median / (1 + SAME))
    return Band(low, median, np.maximum(ordered[count - 1 - beyond], median * (1 + SAME)))


def distance(band: Band, values: np.ndarray, smallest: float = 0.0) -> np.ndarray:
    """How far out errors lie on a band: 0 at its median, 1 at its upper and -1 at its lower end.

        log(error / median) / |log(end / median)|,  end: that of the side on which the error lies

    values: (..., J) errors [unit of y];  smallest: errors below it are counted as this
    An error below an upper end that is infinite has the distance 0.
    """
    values = np.maximum(np.where(np.isnan(values), np.inf, values), smallest)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        log, low, median, high = (np.log(x) for x in (values, *band))
        up, down = (log - median) / (high - median), (log - median) / (median - low)
    up = np.where(np.isinf(high), 0.0, up)
    return np.where(np.isinf(median), 0.0, np.where(log >= median, up, down))


def steps(live: list[Manifest]) -> list[int]:
    """The predicted trial that each measured trial is compared with; 0 where there is none.

    A trial that was not learned from leaves the memory as it is, so the next one repeats its step.
    What the part of a trial teaches is not predicted: after it there is none.

    live: manifests of the start and of the measured trials, see `Journal.live`
    """
    return [*accumulate(live[1:], _step_after, initial=1)][:-1]


def next_step(live: list[Manifest]) -> int:
    """The predicted trial that the next measured one is compared with, as `steps`."""
    return reduce(_step_after, live[1:], 1)


def _step_after(step: int, manifest: Manifest) -> int:
    """The predicted trial after one that is compared with `step`."""
    if not manifest["learned"]:
        return step
    return 0 if is_part(manifest) or not step else step + 1


def place_of(
    prediction: Prediction,
    step: int,
    error: float,
    largest: float,
    manifest: Manifest | None = None,
) -> Place | None:
    """Where a measured trial lies on its prediction; None beyond the predicted trials.

    error: RMS error over all outputs;  largest: largest error of all outputs [unit of y]
    manifest: see `Prediction.at`
    """
    of = prediction.at(step, manifest)
    if of is None:
        return None
    return place_in(step, (of.rms, of.largest), of.course, error, largest, of.smallest)


def place_in(
    step: int,
    bands: Sequence[Band],
    course: float,
    error: float,
    largest: float,
    smallest: float = 0.0,
) -> Place:
    """Where a measured trial lies in the bands of its two errors, each of one row.

    course: distance beyond which it lies clearly outside
    """
    far = [
        float(distance(band, np.array([value]), smallest)[0])
        for band, value in zip(bands, (error, largest), strict=True)
    ]
    which = int(abs(far[1]) > abs(far[0]))
    level = "within"
    if abs(far[which]) > 1:
        level = "slight" if abs(far[which]) <= course else "clear"
    (rms, most) = ((float(band.low[0]), float(band.high[0])) for band in bands)
    name = ("RMS error", "largest error")[which]
    return Place(step, rms, most, far[which], name, level)


# As a file
# --------------------------------------------------------------------------------------------------


def of_campaign(
    folder: Path,
    subject: Subject,
    needed: int,
    *,
    expected: int,
    configuration: str,
    store: bool = True,
) -> Prediction:
    """The prediction of a campaign, from its folder, or computed and stored there.

    needed: number of trials that it must reach
    expected: number of trials that the scenario expects; it is doubled until it reaches `needed`
    configuration: hash of the campaign's configuration, for `kept`
    store: whether the folder may be written to
    Raises ValueError as `predict` does.
    """
    key, needed = key_of(subject), min(needed, longest(subject))
    before = kept(folder, configuration, key)
    if before is not None and before.trials >= needed and before.machines == subject.machines:
        return before
    trials = max(1, expected)
    while trials < needed:
        trials *= 2
    prediction = predict(subject, trials)
    if store:
        content = {"format": FORMAT, **prediction.as_json()}
        content |= {"of": key, "configuration": configuration}
        with contextlib.suppress(OSError):  # it is computed again at the next call
            write_json(folder / FILE, sealed(content))
    return prediction


def kept(folder: Path, configuration: str, key: str | None = None) -> Prediction | None:
    """The stored prediction of a campaign, None where there is none that can be used.

    configuration: hash of the campaign's configuration
    key: `key_of` what it must be computed from, None if that is not known
    """
    try:
        content = unsealed(read_json(folder / FILE))
    except (OSError, Damaged):
        return None
    of = {"format": FORMAT, "configuration": configuration} | ({"of": key} if key else {})
    if any(content.get(name) != value for name, value in of.items()):
        return None
    return _from_json(content)


def key_of(subject: Subject) -> str:
    """A hash of all that the prediction depends on, besides the number of trials."""
    return checksum_of(describe([*subject, MACHINES, SEED]))


def _from_json(content: dict[str, Value]) -> Prediction | None:
    """The prediction; None for content that somebody made by hand and that does not fit."""
    bands = [band_of(content.get(name)) for name in ("rms", "largest")]
    machines, course, smallest = (content.get(n) for n in ("machines", "course", "smallest"))
    known = is_whole(machines) and is_number(course) and is_number(smallest)
    rms, largest = bands
    if not known or rms is None or largest is None or len(rms.low) != len(largest.low):
        return None
    course, smallest = (float(cast(float, x)) for x in (course, smallest))
    noisy = content.get("noisy") is True
    return Prediction(int(cast(int, machines)), noisy, rms, largest, course, smallest)


def band_of(content: Value) -> Band | None:
    """The band that JSON holds; None where it holds none."""
    ends = [content.get(end) if isinstance(content, dict) else None for end in Band._fields]
    lists = [end for end in ends if isinstance(end, list) and end and all(map(is_number, end))]
    if len(lists) < len(ends) or len({len(end) for end in lists}) > 1:
        return None
    return Band(*(np.array(end, float) for end in lists))
