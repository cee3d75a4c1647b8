"""A learning campaign on a real machine.

A journal stores what was learned from each measured trial, which determines the next input.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from contextlib import nullcontext
from itertools import pairwise, takewhile
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..identification import Record, Repeats
from ..learning.machine import Actuator, Machine
from ..learning.metrics import measure
from ..learning.over_trials import check_length, measured_trial, need_kinds
from ..learning.playback import applied, replay, schedules
from ..learning.within_trial import run_trial
from ..pytree.aliases import Leaf, Value
from ..pytree.in_short import in_short
from ..pytree.named_paths import named_leaves
from ..runtime.provenance import checksum_of, describe, environment, need_same
from ..schemes import Scheme
from ..schemes.scheme import Memory, growth_of, trials_of_step
from ..signals.task import Task, Trial
from ..storage.files import only_one
from ..storage.sealed import as_json, checksum
from . import calibration, checks
from .calibration import Expected
from .checks import Finding, Rules
from .journal import BACK, DAMAGED, METRICS, Journal, Manifest, is_part, whole_trials
from .prediction import Prediction, next_step
from .trial_files import Measured, completed, ended, keeping, stored, told_of_end

MEMORY, TRIAL = "memory.npz", "trial.npz"
FED = "signals feedback"  # that of the feedback in the arrays of a trial
AGAIN = "nothing was learned or written; wait for its end, and call again"
PAST = 20  # trials whose inputs are compared with a recorded one that is not that to play, and
# whose outputs say what to expect of the next


class Turn(NamedTuple):
    """A measured trial and the results that follow from it, before they are stored.

    record: the trial with the signals of the scheme
    memory, schedules: memory and schedules for the next trial
    metrics: metrics of this trial by name: those of `Metrics`, and `error`, the RMS error over all
        outputs
    hashes: hashes of the measured signals, of the schedules that were played, and under a law of
        several trials a step of the file with its path and the time when it was written
    learned: False for a trial that was only inspected
    input: `measured`, or `replayed` where the file had no u and the scheme's law gave it
    peaks: the largest value of each schedule that was played in this trial
    expected: what the trials before expected of this one, None before the third
    last_digit: that of the measured output, see `checks.last_digit`
    after: serial of the entry whose memory was played and learned from
    predicted: what the plant file predicts of this trial, None without it
    """

    trial: int
    record: Trial
    memory: Memory
    schedules: dict[str, np.ndarray]
    metrics: dict[str, Value]
    hashes: dict[str, str]
    findings: list[Finding]
    learned: bool
    source: str
    input: str = "measured"
    peaks: dict[str, float] = {}  # noqa: RUF012  the largest value of each schedule played
    expected: Expected | None = None
    last_digit: float = 0.0
    after: int = 0
    predicted: Prediction | None = None
    __repr__ = in_short

    @property
    def refusals(self) -> list[str]:
        """The texts of the findings for which the trial is refused."""
        return [f.text for f in self.findings if f.kind == "refusal"]


@dataclasses.dataclass(frozen=True)
class Campaign:
    """A campaign with its scheme, task, actuator and journal, made by `start` or `open`.

    scheme, task, actuator: those of the real machine
    recipe: how scheme, task and rules were made, as JSON, stored for a later continuation
    """

    journal: Journal
    scheme: Scheme
    task: Task
    actuator: Actuator | None = None
    rules: Rules = dataclasses.field(default_factory=Rules)
    recipe: dict[str, Value] = dataclasses.field(default_factory=dict)
    __repr__ = in_short

    @classmethod
    def start(
        cls,
        path: str | Path,
        scheme: Scheme,
        task: Task,
        *,
        actuator: Actuator | None = None,
        rules: Rules | None = None,
        recipe: dict[str, Value] | None = None,
        dry_run: bool = False,
    ) -> Campaign:
        """A new campaign, before its first trial, in a folder of its own.

        dry_run: whether only to check, and to store nothing
        Raises FileExistsError if the folder is not empty, and ValueError where scheme and task do
        not fit, and for a first schedule beyond a limit.
        """
        need_kinds(scheme=scheme, task=task)
        check_length(task, scheme)
        scheme.check(task)
        campaign = cls(
            Journal(Path(path)), scheme, task, actuator, (rules or Rules()).checked(), recipe or {}
        )
        refuse(checks.beyond_limits(campaign.first_schedules(), task, actuator, campaign.rules))
        if not dry_run:
            campaign.journal.create()
            with only_one(campaign.journal.path, AGAIN):
                campaign.journal.create()  # another process may have begun a campaign meanwhile
                campaign._append(
                    {"event": "start", "trial": 0, "parent": None},
                    {MEMORY: _arrays_of(scheme.initial_memory(task))},
                )
        return campaign

    @classmethod
    def open(
        cls,
        path: str | Path,
        scheme: Scheme,
        task: Task,
        *,
        actuator: Actuator | None = None,
        rules: Rules | None = None,
        recipe: dict[str, Value] | None = None,
    ) -> Campaign:
        """The campaign in a folder, to continue it.

        recipe: new recipe, None to keep the stored one
        Raises ValueError if it was started with another configuration, naming what differs.
        """
        need_kinds(scheme=scheme, task=task)
        journal = Journal(Path(path))
        last = journal.last_known()
        recipe = last["recipe"] if recipe is None else recipe
        campaign = cls(journal, scheme, task, actuator, (rules or Rules()).checked(), recipe)
        made = "started with another configuration"
        then = "; go on with that one, or start a campaign in another folder"
        need_same(path, as_json(last["configuration"]), campaign.configuration, made, then)
        return campaign

    @property
    def configuration(self) -> dict[str, Value]:
        """Scheme, task and actuator, which determine learning; long arrays as their hash."""
        return as_json(
            {name: describe(getattr(self, name)) for name in ("scheme", "task", "actuator")}
        )

    @property
    def configuration_hash(self) -> str:
        return checksum_of(self.configuration)

    @property
    def trials(self) -> int:
        """The number of trials measured, without those that were undone."""
        return self.journal.live()[-1]["trial"]

    def memory(self, trial: int | None = None) -> Memory:
        """The memory after a trial, None for the last one.

        Raises ValueError for a trial that is not one of the past, and for a damaged memory.
        """
        return self.memory_of(self._after(trial))

    def memory_of(self, entry: Manifest) -> Memory:
        """The memory after an entry; raises ValueError where it is damaged."""
        template = self.scheme.initial_memory(self.task)
        found, needed = self.journal.arrays(entry, MEMORY), _arrays_of(template)
        if _shapes_of(found) != _shapes_of(needed):
            raise ValueError(
                f"{self.journal.path}: the memory holds {_shapes_of(found)}; "
                f"this scheme needs {_shapes_of(needed)}; {BACK}"
            )
        wrong = _not_a_number(found)
        if wrong:
            raise ValueError(
                f"{self.journal.path}: the memory after trial {entry['trial']} "
                f"is not a number in {wrong}; {BACK}"
            )
        return jax.tree.unflatten(
            jax.tree.structure(template), [jnp.asarray(found[name]) for name in needed]
        )

    def expected(self, machine: Machine) -> Expected | None:
        """What the campaign expects of its next trial; None before it has two whole trials.

        machine: the nominal machine of the plant file
        """
        live = self.journal.live()
        key = jax.random.key(0)  # one noise for all, which the differences do not hold
        past = live[-PAST - 1 :]
        whole = _whole_trials(self.journal, past[1:])
        if len(whole) < 2:
            return None
        before = [entry for entry, now in pairwise(past) if now["trial"] in whole]
        memories = map(self.memory_of, [*before, live[-1]])
        simulated = [_output(machine, self.scheme, self.task, memory, key) for memory in memories]
        measured = np.array([of["y"] for of in whole.values()])
        return calibration.expected(measured, np.array(simulated), self.task, next_step(live))

    def of_other_sign(self, record: Trial, machine: Machine) -> list[Finding]:
        """The refusal of a whole trial that is the nominal machine's but for the sign.

        machine: the nominal machine of the plant file
        """
        memory = self.memory_of(self.journal.live()[-1])
        nominal = np.asarray(_output(machine, self.scheme, self.task, memory, jax.random.key(0)))
        accept = self.rules.accept
        return checks.of_other_sign(record.y, nominal, self.task.reference, accept, self.task.unit)

    def schedules(self, trial: int | None = None) -> dict[str, np.ndarray]:
        """The schedules to play after a trial, None for the last one; see `playback.schedules`."""
        return schedules(self.scheme, self.memory(trial), self.task)

    def first_schedules(self) -> dict[str, np.ndarray]:
        """The schedules that the machine plays in the first trial."""
        return schedules(self.scheme, self.scheme.initial_memory(self.task), self.task)

    def recordable(self) -> dict[str, tuple[int, int]]:
        """The shapes, by name, of the signals besides y and u that a measured trial may hold.

        These are the share of the feedback in the input, and the schedules as they were played.
        """
        return {"feedback": (self.task.N, self.task.inputs)} | {
            name: t.shape for name, t in self.schedules().items() if name != "u"
        }

    def turn(
        self,
        measured: Measured,
        *,
        learn: bool = True,
        replay_input: bool = False,
        expected: Expected | None = None,
    ) -> Turn:
        """The result of a measured trial, checked by the rules; `keep` stores it.

        The share of the feedback in the input is `feedback` of the file. If the file does not have
        it, it is computed by the scheme's law from the measured output (see `replay`). The other
        signals of the scheme are always computed that way.

        learn: False only inspects the trial; the same schedule is then played again
        replay_input: whether to compute an input that the file lacks by the scheme's law
        expected: what the trials before expect of this one, see `calibration`
        Raises ValueError for a trial without an input, for one that was measured already, even if
        its file was rounded to four digits, unless a law that takes several trials a step plays its
        schedule again and the file was written anew, for one that ended early under such a law:
        what its trials have in common, or how they differ, is not known of its rest, and for one
        whose error is not finite.
        """
        scheme, task, live = self.scheme, self.task, self.journal.live()
        memory, number = self.memory_of(live[-1]), live[-1]["trial"] + 1
        played = schedules(scheme, memory, task)
        # NumPy's arrays are used from here on: every operation on JAX's would be compiled.
        commanded, signals = jax.device_get(replay(scheme, task, memory, measured.y, self.actuator))
        if measured.u is None and not replay_input:
            raise ValueError(
                f"{measured.source} has no input u; record it, name it by --input, or add "
                "--set campaign.replayed_input=true where the controller runs this scheme"
            )
        if learn and measured.samples is not None and scheme.trials_a_step > 1:
            raise ValueError(
                f"{measured.source} ended after {measured.samples} of {task.N} samples, and "
                f"{type(scheme).__name__} learns from {scheme.trials_a_step} trials at a time, all "
                "of them whole; play the same schedule again, or look at the trial by --no-learn"
            )
        measured, u, signals = completed(measured, commanded, signals, played)
        record = jax.device_get(measured_trial(task, measured.y, u))._replace(signals=signals)
        record = ended(record, measured)
        hashes = {"measured": _hash_of(measured.y, u), "played": _hash_of(*played.values())}
        if scheme.trials_a_step > 1 and (file := Path(measured.source).resolve()).is_file():
            written = f"{file} {file.stat().st_mtime_ns}".encode()
            hashes["file"] = checksum(written + file.read_bytes())
        error = checks.rms_over_all(record)
        if not np.isfinite(error):
            largest = np.max(np.abs(measured.y))
            raise ValueError(f"{measured.source}: y is up to {largest:.3g}, whose rms is infinite")
        last_digit = checks.last_digit(measured.y[: measured.end + 1])
        findings = list[Finding]()
        for entry in live[1:]:
            if self._is_measured(entry, measured, error, last_digit):
                repeats = entry["hashes"].get("played") == hashes["played"]
                repeats &= scheme.trials_a_step > 1
                if repeats and not _same_file(entry, measured.source, hashes):
                    text = f"the record is that of trial {entry['trial']}, whose schedule the law "
                    text += "has played again, up to the resolution of the encoder; a copy of its "
                    text += "file under another name would teach nothing, so look whether it is one"
                    findings.append(Finding("warning", text))
                    continue
                known = "which was learned from already;"
                again = "whose input a call without --measured writes once more"
                if not entry["learned"]:
                    undo = f"--undo {entry['trial'] - 1} forgets it, so that it can be learned from"
                    known = f"which was looked at already; {undo}; or"
                    again += (
                        "; leave out a new trial that is the same up to the resolution of the "
                        "encoder: it tells nothing more"
                    )
                text = f"{measured.source} is trial {entry['trial']}, {known}"
                raise ValueError(f"{text} measure trial {number}, {again}")
        findings += checks.saturation(u[: measured.samples], self.actuator, self.rules)
        findings += checks.as_played(measured.others, played, self.actuator)
        if "feedback" not in measured.others:
            findings += checks.as_commanded(u, commanded, self.actuator, task)
        findings += self._against_those_before(record, error, hashes["played"], expected)
        learned_before = checks.learned_so_far(live)[0] > 0
        law = scheme if measured.samples is None else keeping(scheme, begun=learned_before)
        following = learned(law, task, memory, record) if learn else memory
        following_schedules = schedules(scheme, following, task)
        findings += told_of_end(measured, played, following_schedules, task)
        if wrong := _not_a_number(_arrays_of(following)):
            text = f"what would be learned is not a number in {wrong}"
            findings.append(Finding("refusal", text))
        findings += checks.beyond_limits(following_schedules, task, self.actuator, self.rules)
        findings += checks.too_fast(following_schedules, task, self.actuator)
        peaks = {name: float(checks.peak(name, of, task)) for name, of in played.items()}
        if measured.u is not None:
            findings += self._as_the_machine_can(record, commanded, played, live, measured)
        if learn:
            trials, largest, begun = checks.learned_so_far(live, peaks)
            findings += checks.larger(
                following_schedules, trials // scheme.trials_a_step, largest, begun, task,
                self.rules.accept, growth_of(scheme, task),
            )  # fmt: skip
        metrics = {
            name: np.asarray(of).tolist() for name, of in _measured(record, task)._asdict().items()
        }
        return Turn(
            number,
            record,
            following,
            following_schedules,
            {"error": error, **metrics},
            hashes,
            findings,
            learn,
            measured.source,
            "replayed" if measured.u is None else "measured",
            peaks,
            expected,
            last_digit,
            live[-1]["serial"],
        )

    def _as_the_machine_can(
        self,
        record: Trial,
        commanded: np.ndarray,
        played: dict[str, np.ndarray],
        live: list[Manifest],
        measured: Measured,
    ) -> list[Finding]:
        """Whether the channels of a trial move, as a machine can, and belong to this trial.

        commanded: (N, n_u) input of the scheme over the measured output
        """
        accept, r = self.rules.accept, np.asarray(record.r)
        y, u = np.asarray(record.y)[: measured.end + 1], np.asarray(record.u)
        whole, findings = whole_trials(live), list[Finding]()
        before = self.journal.arrays(whole[-1], TRIAL) if whole else {}
        last, alone, share = before.get("y"), set(played) == {"u"}, 1.0
        now, was = (np.ptp(x, axis=0) for x in (u, before.get("u", 0 * u)))
        if alone and np.any(was):  # as of an experiment
            share = min(1.0, np.max(now[was > 0] / was[was > 0]))
        against = [(r, {"still": checks.DEAD})]  # where nothing moved the machine before
        if last is not None and np.any(np.ptp(last, axis=0) > 0):  # it may be a flickering count
            rested = bool(np.all(was < checks.TRAVEL * now))
            against = [(last, {"share": share}), *against[:rested]]
        # What the part of a trial has taught may move the machine little, and steps at its end.
        by_part = any(m["learned"] for m in takewhile(is_part, reversed(live[1:])))
        if whole or not by_part or not alone:
            found = [checks.frozen("y", y[1:], x[1:], u, accept, **how) for x, how in against]
            findings += found[0] or found[-1]
        findings += checks.frozen("u", u, commanded, commanded, accept)
        commands = {"the reference": r, "the input": u}
        commands |= {f"the schedule {name}": played[name] for name in {*played} - {"u"}}
        taught = last if any(m["learned"] for m in live[1:]) else None
        findings += checks.as_the_command(y, taught, commands, accept)
        findings += checks.exchanged(y, r, accept)
        if not by_part:
            findings += checks.jumped(y, r, last, accept, self.task.unit)
        beside = 0.0  # else the input depends on y, unless its share of the feedback was recorded
        if closed := "feedforward" in played and "feedback" in measured.others:
            beside = measured.others["feedback"]
            commanded = beside + played["feedforward"]
            if self.actuator is not None:
                commanded = np.asarray(applied(self.actuator, commanded, self.task.dt))
        if (closed or alone) and not findings:
            past = {m["trial"]: self.journal.arrays(m, TRIAL) for m in live[-PAST:] if m["trial"]}
            others = {j: of["u"] - closed * of.get(FED, 0.0) + beside for j, of in past.items()}
            findings += checks.misplayed(u, commanded, others, accept)
            if closed and not findings:
                of = self.actuator, self.task, checks.OF_FEEDBACK
                findings += checks.as_commanded(u, commanded, *of)
        return findings

    def _against_those_before(
        self, record: Trial, error: float, played: str, expected: Expected | None
    ) -> list[Finding]:
        """Compare a trial with the last one, if both played one schedule, and with all errors.

        A trial that ended early, whose error is that of a part, is compared with none.

        error: RMS error over all outputs [unit of y]
        played: hash of the schedule
        """
        if record.weight is not None:
            return []
        findings, unit, live = [], self.task.unit, self.journal.live()
        whole = whole_trials(live)
        if whole and whole[-1]["hashes"].get("played") == played:
            last_y = self.journal.arrays(whole[-1], TRIAL)["y"]
            findings += checks.repeated(record, last_y, self.rules, unit)
        errors = checks.comparable(self.scheme, self.task, live)
        return findings + (
            self.grown_beyond(record, error, checks.GROWN, expected)
            or checks.grown(error, errors, self.rules, unit)
        )

    def grown_beyond(
        self, record: Trial, error: float, times: float, expected: Expected | None = None
    ) -> list[Finding]:
        """The refusal of a trial whose error is more than some times the best, and what changed.

        The best is that since the last trial that was accepted in spite of it: from a changed
        machine, learning leads to the best again. It is no less than a count of the encoder.

        error: RMS error over all outputs [unit of y]
        """
        task = self.task
        errors = [e for _, e in checks.comparable(self.scheme, task, self.journal.live())]
        best = max(min(errors, default=np.inf), checks.LEAST * np.ptp(task.reference))
        if not best or error <= times * best or record.weight is not None:
            return []
        last = self.journal.arrays(whole_trials(self.journal.live())[-1], TRIAL)["y"]
        best = max(best, checks.count_of(last))  # of a record that may be broken it says nothing
        if error <= times * best:
            return []
        changed = self.what_changed(record, expected)
        return checks.grown_beyond(error, best, changed, self.rules.accept, task.unit)

    def what_changed(self, record: Trial, expected: Expected | None) -> checks.Change:
        """What explains a whole trial that is not as expected, or not as the last whole one."""
        last = whole_trials(self.journal.live())[-1]
        output = self.journal.arrays(last, TRIAL)["y"] if expected is None else expected.output
        return checks.what_changed(np.asarray(record.y), output, self.task.dt)

    def keep(self, turn: Turn, *, alone: bool = False) -> None:
        """Store a turn; the campaign then continues from it.

        alone: whether the caller holds the folder already, see `storage.files.only_one`
        Raises ValueError if it has refusals, if another process has stored a trial or an undo since
        the turn was made, and while one does.
        """
        refuse(turn.findings)
        plain = ("trial", "learned", "source", "input", "hashes", "peaks", "last_digit")
        manifest = {name: getattr(turn, name) for name in plain} | {METRICS: turn.metrics}
        manifest["findings"] = turn.findings
        if turn.expected is not None:
            manifest["expected"] = turn.expected.as_json()
        elif turn.predicted is not None:
            manifest["predicted"] = turn.predicted.as_json()
        arrays = {MEMORY: _arrays_of(turn.memory), TRIAL: stored(turn.record)}
        with nullcontext() if alone else only_one(self.journal.path, AGAIN):
            parent = self.journal.live()[-1]
            if turn.after != parent["serial"]:
                said = f"trial {turn.trial} does not follow on trial {parent['trial']}"
                by = "which another process has made meanwhile; nothing was learned or written"
                raise ValueError(f"{self.journal.path}: {said}, {by}")
            self._append({"event": "trial", "parent": parent["serial"], **manifest}, arrays)

    def undo(self, trial: int, *, alone: bool = False) -> None:
        """Go back to the memory after a trial; 0 stands for the start.

        alone: as of `keep`
        Raises ValueError for a trial that is not one of the past, and while another process stores
        one.
        """
        with nullcontext() if alone else only_one(self.journal.path, AGAIN):
            to = self._after(trial)["serial"]
            self._append({"event": "undo", "trial": trial, "parent": None, "to": to}, {})

    def doubt(self, trial: int) -> str:
        """Why a trial to go back to may have been undone before; else an empty text."""
        return str(self._after(trial).get("wrong", ""))

    def _after(self, trial: int | None) -> Manifest:
        """The entry after an earlier trial, or the last entry for None."""
        if trial is None:
            return self.journal.live()[-1]
        behind = {m["trial"]: m for m in self.journal.behind()}
        if trial not in behind:
            said = "there is none before the start"
            if behind:
                said = f"allowed are {min(behind)} to {max(behind)}, after which a call without "
                said += "--undo goes on"
            elif any(m["event"] == DAMAGED for m in self.journal.manifests()):
                said = "none can be read; start a campaign in another folder"
            raise ValueError(f"trial = {trial} is not one to go back to; {said}")
        return behind[trial]

    def _is_measured(
        self, entry: Manifest, measured: Measured, error: float, last_digit: float
    ) -> bool:
        """Whether a measured trial is that of an entry, up to its end and the rounding of a file.

        A damaged trial of another error is passed by.

        error: RMS error of the trial, which distinguishes most trials without reading their files
        last_digit: that of its output; older entries have none and count as of as many digits
        """
        off = abs(entry[METRICS]["error"] - error)
        if off > checks.same_up_to(measured.y, entry.get("last_digit", last_digit), last_digit):
            return False
        try:
            known = self.journal.arrays(entry, TRIAL)
        except ValueError:
            if off <= checks.same_up_to(measured.y):
                raise
            return False
        end = measured.end
        return checks.same(known["y"][: end + 1], measured.y[: end + 1]) and (
            measured.u is None or checks.same(known["u"][:end], measured.u[:end])
        )

    def _append(self, manifest: Manifest, arrays: dict[str, dict[str, Leaf]]) -> None:
        known = {
            "recipe": self.recipe,
            "configuration": self.configuration,
            "configuration_hash": self.configuration_hash,
            "trials_of_step": trials_of_step(self.scheme, self.task),
            "environment": environment(),
        }
        self.journal.append(manifest | known, arrays)


def refuse(findings: list[Finding]) -> None:
    """Raises ValueError with the refusals among the findings, if there are any."""
    texts = [f.text for f in findings if f.kind == "refusal"]
    if texts:
        raise ValueError("; ".join(texts))


def _same_file(entry: Manifest, source: str, hashes: dict[str, str]) -> bool:
    """Whether an entry is of the file of a trial, which was not written anew since.

    Older entries do not know their file, and count as of one of the same path and signals.
    """
    known, name = entry["hashes"], "file"
    if name not in known or name not in hashes:
        name = "measured"
        if Path(entry["source"]).resolve() != Path(source).resolve():
            return False
    return known.get(name) == hashes[name]


def _hash_of(*arrays) -> str:
    """The checksum of the values of arrays, in double precision."""
    return checksum(b"".join(np.ascontiguousarray(a, dtype=float).tobytes() for a in arrays))


_measured = jax.jit(measure)  # one program instead of one for each operation


@jax.jit
def learned(scheme: Scheme, task: Task, memory: Memory, trial: Trial):
    """The memory after a trial."""
    trial = trial._replace(dt=task.dt)  # a number, by which a law may sample its model
    return scheme.prepared(task).learn(memory, trial)


@jax.jit
def _output(machine: Machine, scheme: Scheme, task: Task, memory: Memory, key: jax.Array):
    return run_trial(machine, scheme.prepared(task), task, memory, key).y


def _arrays_of(tree: Memory) -> dict[str, Leaf]:
    """The leaves in order; each name is a running number and the path of the leaf."""
    return {f"{i:03d} {name}": leaf for i, (name, leaf) in enumerate(named_leaves(tree).items())}


def _shapes_of(arrays: Mapping[str, Leaf]) -> str:
    """The names and shapes of arrays, as text for a message."""
    return ", ".join(f"{name} {np.shape(values)}" for name, values in arrays.items())


def _not_a_number(arrays: Mapping[str, Leaf]) -> str:
    """The name of the first array that holds NaN, an empty text if there is none.

    Infinite values are allowed: they stand for values that are not known yet, such as the best
    error before the first trial.
    """
    return next(
        (name for name, values in arrays.items() if np.any(np.isnan(np.asarray(values)))), ""
    )


# The trials as one record
# --------------------------------------------------------------------------------------------------

MOST_SAMPLES = 200_000  # of all trials together; more would take long and tell little more


class CampaignRecord(NamedTuple):
    """The record of a campaign.

    record: the trials below each other, each from rest
    trials: the numbers of the trials that it holds
    measured: number of trials that the campaign has; more than `trials` where they are many
    closed: whether the machine's controller closed a loop in these trials, so that the noise of the
        output was in the input
    """

    record: Record
    trials: tuple[int, ...]
    measured: int
    closed: bool


def repeats_of(campaign: Campaign) -> Repeats:
    """The errors of the trials of a campaign that played the same schedule most often.

    Trials that ended early are left out; of several outputs the first one is taken.
    Raises ValueError where no schedule was played twice.
    """
    journal, task = campaign.journal, campaign.task
    played: dict[str, list[Manifest]] = {}
    for one in journal.live()[1:]:
        played.setdefault(str(one["hashes"].get("played")), []).append(one)
    whole = _whole_trials(journal, max(played.values(), key=len, default=[]))
    if len(whole) < 2:
        raise ValueError(
            f"no schedule of {journal.path} was played twice; measure trials without learning in "
            "between: jaxilc next --no-learn"
        )
    outputs = np.stack([of["y"] for of in whole.values()])
    e = (np.asarray(task.reference) - outputs)[:, :, 0]
    names = tuple(f"trial {trial}" for trial in whole)
    return Repeats(e, task.dt, task.unit, names, outputs[0, :, 0])


def _whole_trials(journal: Journal, live: list[Manifest]) -> dict[int, dict[str, np.ndarray]]:
    """The signals of trials by number, without those that ended early."""
    read = {one["trial"]: journal.arrays(one, TRIAL) for one in live}
    return {trial: of for trial, of in read.items() if "weight" not in of}


def record_of(campaign: Campaign, machine: Machine) -> CampaignRecord:
    """The input and the output of all trials of a campaign that were not undone.

    Of many trials some are taken, spread evenly from the first one to the last one. Trials that
    ended early are left out.

    Raises ValueError where there are no trials, and where the recorded u is not what acted on the
    plant: an input that was not measured but computed, in a closed loop, and a machine with a
    repetitive disturbance.
    """
    journal, live = campaign.journal, campaign.journal.live()[1:]
    if not live:
        raise ValueError(f"{journal.path} has no measured trial yet; there is nothing to fit")
    disturbance = machine.disturbance
    if disturbance is not None and not (disturbance.input is None and disturbance.output is None):
        raise ValueError(
            f"the machine of {journal.path} has a repetitive disturbance, so that u is not all "
            "that acts on its plant; record an experiment without it, and fit that"
        )
    closed = set(campaign.first_schedules()) != {"u"}
    computed = [m["trial"] for m in live if m.get("input") == "replayed"]
    if closed and computed:
        raise ValueError(
            f"the input of trial {computed[0]} was not measured but computed by the scheme's law "
            "(--set campaign.replayed_input=true). In a closed loop it is then not known what "
            "acted on the plant: record u, or fit an experiment (jaxilc identify RECORD)"
        )
    most = min(len(live), max(1, MOST_SAMPLES // (campaign.task.N + 1)))
    taken = np.unique(np.linspace(0, len(live) - 1, most).round().astype(int))
    whole = _whole_trials(journal, [live[i] for i in taken])
    if not whole:
        raise ValueError(f"each trial of {journal.path} ended early; there is nothing to fit")
    u, y = (np.concatenate([of[name] for of in whole.values()]) for name in "uy")
    record = Record(u, y, campaign.task.dt, len(whole))
    return CampaignRecord(record, tuple(whole), len(live), closed)
