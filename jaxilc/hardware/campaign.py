"""A learning campaign on a real machine: what was learned from each measured trial, kept in a
journal, and the next input.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..learning.machine import Actuator
from ..learning.metrics import measure
from ..learning.over_trials import check_length, measured_trial
from ..learning.playback import replay, schedules
from ..pytree.named_paths import named_leaves
from ..runtime.provenance import describe, differences, environment
from ..schemes import Scheme
from ..signals.task import Task, Trial
from ..storage.sealed import as_json
from . import checks as checks
from .checks import Finding, Rules
from .journal import BACK, Journal
from .trial_files import Measured

MEMORY, TRIAL = "memory.npz", "trial.npz"


class Turn(NamedTuple):
    """A measured trial and what follows from it; nothing is stored yet.

    trial: its number;  record: with the signals of the scheme;  memory, schedules: of the next trial;
    figures: of this one
    hashes: of what was measured and of what was played;  findings: what the checks found, refusals
    among them
    learned: False for a trial that was only looked at;  source: its file
    """

    trial: int
    record: Trial
    memory: Any
    schedules: dict[str, np.ndarray]
    figures: dict[str, Any]
    hashes: dict[str, str]
    findings: list[Finding]
    learned: bool
    source: str

    @property
    def refusals(self) -> list[str]:
        return [f.text for f in self.findings if f.kind == "refusal"]


@dataclasses.dataclass(frozen=True)
class Campaign:
    """What is learned, for which task and actuator, and the journal. See `start` and `open`.

    rules: what is refused;  recipe: JSON, how scheme, task and rules were made, kept for whoever
    goes on
    """

    journal: Journal
    scheme: Scheme
    task: Task
    actuator: Actuator | None = None
    rules: Rules = dataclasses.field(default_factory=Rules)
    recipe: dict[str, Any] = dataclasses.field(default_factory=dict)

    @classmethod
    def start(
        cls,
        path: str | Path,
        scheme: Scheme,
        task: Task,
        *,
        actuator: Actuator | None = None,
        rules: Rules | None = None,
        recipe: dict[str, Any] | None = None,
        dry_run: bool = False,
    ) -> Campaign:
        """A new campaign, before its first trial, in a folder of its own. dry_run: check, and store
        nothing

        Raises FileExistsError if something is there; ValueError where scheme and task do not fit,
        and for a first schedule beyond a limit.
        """
        check_length(task, scheme)
        scheme.check(task)
        campaign = cls(
            Journal(Path(path)), scheme, task, actuator, (rules or Rules()).checked(), recipe or {}
        )
        refuse(checks.beyond_limits(campaign.first_schedules(), task, actuator, campaign.rules))
        if not dry_run:
            campaign.journal.create()
            campaign._append(
                {"event": "start", "trial": 0, "parent": None},
                {MEMORY: _arrays(scheme.initial_memory(task))},
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
        recipe: dict[str, Any] | None = None,
    ) -> Campaign:
        """The campaign in a folder, to go on with. Raises ValueError if it was started with another
        configuration, naming what differs.

        recipe: None keeps the one that is there
        """
        journal = Journal(Path(path))
        last = journal.last_known()
        campaign = cls(
            journal,
            scheme,
            task,
            actuator,
            (rules or Rules()).checked(),
            last["recipe"] if recipe is None else recipe,
        )
        found = differences(as_json(last["configuration"]), campaign.configuration)
        if found:
            raise ValueError(
                f"{path} was started with another configuration; it differs in: {'; '.join(found)}"
            )
        return campaign

    @property
    def configuration(self) -> dict[str, Any]:
        """What is learned depends on this: scheme, task and actuator; long arrays by their hash."""
        return as_json(
            {name: describe(getattr(self, name)) for name in ("scheme", "task", "actuator")}
        )

    @property
    def trials(self) -> int:
        """Trials measured, without what was undone."""
        return self.journal.live()[-1]["trial"]

    def memory(self, trial: int | None = None) -> Any:
        """What the scheme knew after a trial, None for the last one. Raises ValueError for a trial
        that does not lie behind.
        """
        template, entry = self.scheme.initial_memory(self.task), self._after(trial)
        found, needed = self.journal.arrays(entry, MEMORY), _arrays(template)
        if _shapes(found) != _shapes(needed):
            raise ValueError(
                f"{self.journal.path}: the memory holds {_shapes(found)}; this scheme needs {_shapes(needed)}; {BACK}"
            )
        wrong = _not_a_number(found)
        if wrong:
            raise ValueError(
                f"{self.journal.path}: the memory after trial {entry['trial']} is not a number in {wrong}; {BACK}"
            )
        return jax.tree.unflatten(
            jax.tree.structure(template), [jnp.asarray(found[name]) for name in needed]
        )

    def schedules(self, trial: int | None = None) -> dict[str, np.ndarray]:
        """What the machine plays after a trial, None for the last one; see `playback.schedules`."""
        return schedules(self.scheme, self.memory(trial), self.task)

    def first_schedules(self) -> dict[str, np.ndarray]:
        """What the machine plays in the first trial."""
        return schedules(self.scheme, self.scheme.initial_memory(self.task), self.task)

    def recordable(self) -> dict[str, tuple[int, int]]:
        """The signals besides y and u that a measured trial may hold: the feedback's share, and the
        schedules as they were played.
        """
        return {"feedback": (self.task.N, self.task.inputs)} | {
            name: t.shape for name, t in self.schedules().items() if name != "u"
        }

    def turn(self, measured: Measured, *, learn: bool = True, replay_input: bool = False) -> Turn:
        """What a measured trial leads to, checked by the rules; nothing is stored until `keep`.

        learn: False looks at the trial only, and has the same schedule played again
        replay_input: take the scheme's input over the measured output where the file has none
        The feedback's share is `feedback` of the file if it has it, else the scheme's own law over
        the measured output (`replay`), as the other signals of the scheme always are.
        Raises ValueError for a trial without an input, and for one that was measured already,
        however its file was rounded.
        """
        scheme, task, live, rules, actuator = (
            self.scheme,
            self.task,
            self.journal.live(),
            self.rules,
            self.actuator,
        )
        memory, number = self.memory(), live[-1]["trial"] + 1
        played = schedules(scheme, memory, task)
        commanded, signals = replay(scheme, task, memory, measured.y, actuator)
        if measured.u is None and not replay_input:
            raise ValueError(
                f"{measured.source} has no input u; record it, or add --replayed-input where the controller runs this scheme"
            )
        u = np.asarray(commanded) if measured.u is None else measured.u
        given = {
            name: jnp.asarray(measured.others[name])
            for name in ("feedback",)
            if name in measured.others
        }
        record = measured_trial(task, measured.y, u)._replace(signals={**signals, **given})
        hashes = {"measured": _hash(measured.y, u), "played": _hash(*played.values())}
        error = checks.rms_over_all(record)
        for entry in live[1:]:
            if self._is_measured(entry, record, error, with_input=measured.u is not None):
                raise ValueError(
                    f"{measured.source} is trial {entry['trial']}, {_known(entry)} measure trial {number}"
                )

        findings = checks.saturation(u, actuator, rules) + checks.as_played(
            measured.others, played, actuator
        )
        if not given:
            findings += checks.as_commanded(u, commanded, actuator, task)
        if len(live) > 1 and live[-1]["hashes"].get("played") == hashes["played"]:
            findings += checks.repeated(
                record, self.journal.arrays(live[-1], TRIAL)["y"], rules, task.unit
            )
        findings += checks.grown(
            error, [(m["trial"], m["figures"]["error"]) for m in live[1:]], rules, task.unit
        )
        following = _learned(scheme, task, memory, record) if learn else memory
        wrong = _not_a_number(_arrays(following))
        if wrong:
            findings.append(Finding("refusal", f"what would be learned is not a number in {wrong}"))
        following_schedules = schedules(scheme, following, task)
        findings += checks.beyond_limits(following_schedules, task, actuator, rules)
        figures = {"error": error} | {
            name: np.asarray(value).tolist()
            for name, value in measure(record, task)._asdict().items()
        }
        return Turn(
            number,
            record,
            following,
            following_schedules,
            figures,
            hashes,
            findings,
            learn,
            measured.source,
        )

    def keep(self, turn: Turn) -> None:
        """Store a turn; the campaign goes on from it. Raises ValueError if it has refusals, or does
        not follow on what is stored.
        """
        refuse(turn.findings)
        parent = self.journal.live()[-1]
        if turn.trial != parent["trial"] + 1:
            raise ValueError(
                f"{self.journal.path}: trial {turn.trial} does not follow on trial {parent['trial']}"
            )
        manifest = {
            name: getattr(turn, name)
            for name in ("trial", "learned", "source", "hashes", "figures", "findings")
        }
        record = {"y": turn.record.y, "u": turn.record.u} | {
            f"signals {name}": s for name, s in turn.record.signals.items()
        }
        self._append(
            {"event": "trial", "parent": parent["serial"], **manifest},
            {MEMORY: _arrays(turn.memory), TRIAL: record},
        )

    def undo(self, trial: int) -> None:
        """Go back to what was known after a trial, 0 for the start. Raises ValueError for one that
        does not lie behind.
        """
        self._append(
            {"event": "undo", "trial": trial, "parent": None, "to": self._after(trial)["serial"]},
            {},
        )

    def _after(self, trial: int | None) -> dict[str, Any]:
        """The entry after a trial that lies behind, or where the campaign stands."""
        if trial is None:
            return self.journal.live()[-1]
        behind = {m["trial"]: m for m in self.journal.behind()}
        if trial not in behind:
            last = max(behind, default=-1) + 1
            raise ValueError(
                f"trial = {trial} is not one to go back to; allowed are those before the last one, {last}"
            )
        return behind[trial]

    def _is_measured(
        self, entry: dict[str, Any], record: Trial, error: float, *, with_input: bool
    ) -> bool:
        """Whether a measured trial is that of an entry, up to the digits that a file may lose.

        error: its RMS error, which tells most trials apart without their file;  with_input: the
        input was measured, too
        """
        if abs(entry["figures"]["error"] - error) > checks.same_up_to(record.y):
            return False
        found = self.journal.arrays(entry, TRIAL)
        return checks.same(found["y"], record.y) and (
            not with_input or checks.same(found["u"], record.u)
        )

    def _append(self, manifest: dict[str, Any], arrays: dict[str, dict[str, Any]]) -> None:
        configuration = self.configuration
        digest = hashlib.sha256(json.dumps(configuration, sort_keys=True).encode()).hexdigest()
        known = {
            "recipe": self.recipe,
            "configuration": configuration,
            "configuration_hash": digest,
            "environment": environment(),
        }
        self.journal.append(manifest | known, arrays)


def refuse(findings: list[Finding]) -> None:
    """Raises ValueError with what the checks refuse, if anything."""
    texts = [f.text for f in findings if f.kind == "refusal"]
    if texts:
        raise ValueError("; ".join(texts))


def _arrays(tree: Any) -> dict[str, Any]:
    return {f"{i:03d} {name}": leaf for i, (name, leaf) in enumerate(named_leaves(tree).items())}


def _shapes(arrays: dict[str, Any]) -> str:
    return ", ".join(f"{name} {np.shape(values)}" for name, values in arrays.items())


def _not_a_number(arrays: dict[str, Any]) -> str:
    """The first array that holds NaN, by name; infinite is what was never seen, such as the best
    error before the first trial.
    """
    return next(
        (name for name, values in arrays.items() if np.any(np.isnan(np.asarray(values)))), ""
    )


def _known(entry: dict[str, Any]) -> str:
    """How a trial is known already."""
    if entry["learned"]:
        return "which was learned from already;"
    return f"which was looked at already; --undo {entry['trial'] - 1} forgets it, so that it can be learned from; or"


def _hash(*arrays) -> str:
    return hashlib.sha256(
        b"".join(np.ascontiguousarray(a, dtype=float).tobytes() for a in arrays)
    ).hexdigest()


@jax.jit
def _learned(scheme: Scheme, task: Task, memory: Any, trial: Trial):
    return scheme.prepared(task).learn(memory, trial)
