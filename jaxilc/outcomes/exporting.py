"""`export`: a law as a program for a controller, with its certificate; and the proof of both."""

from __future__ import annotations

import dataclasses
import shlex
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import jax
import numpy as np

from ..pytree.aliases import Tree, Value
from ..pytree.named_paths import named_leaves
from ..storage.files import write_file
from ..storage.sealed import as_json, seal_of, write_json
from .certifying import certificate_numbers, certificate_sentence, reason_lines
from .outcome import Numbers, Outcome, Progress, Verdict, silent
from .request import Request

if TYPE_CHECKING:
    from ..export.guard import Trials
    from ..export.law import Law
    from ..hardware import Campaign
    from ..scenarios import Scenario

NUMBERS = ("double", "float")
TESTED = 4  # trials of the test program, the last one with an output that is not a number
APART = 0.1  # share of the largest input by which single precision may change one
PLAYED = 1000  # samples of the trials in which that is seen, of which there are two at least


def export(
    request: Request | str | None = None,
    *,
    folder: str | Path,
    format: str = "c",
    state: str | Path | None = None,
    limit: float | None = None,
    number: str = "double",
    machines: int = 64,
    seed: int = 0,
    progress: Progress = silent,
) -> Outcome:
    """A learning law as a program for a controller, with its test program and its certificate.

    request: scenario or plant file, with one scheme that learns; None for that of the campaign
    folder: where the files are written
    format: of `export.formats.FORMATS`
    state: folder of a campaign, whose memory the law starts with
    limit: largest |u| that the law plays; that of the campaign or of the actuator if not given
    number: of `NUMBERS`
    machines, seed: of the machines for which the law is certified, as for `Sweep`
    Raises ValueError naming what is allowed, and what of a law cannot be exported, and for an input
    to begin with that is beyond a limit.
    """
    from ..export import law_of
    from ..export.c_files import cost
    from ..export.certificate import CERTIFICATE, WRITTEN, certificate_of, of_others
    from ..export.formats import FORMATS, Asked
    from ..hardware.checks import Rules, beyond_limits
    from ..learning.playback import schedules
    from ..native.program import Unknown
    from ..scenarios.campaigns import need_one_reference

    for name, value, allowed in (("format", format, FORMATS), ("number", number, NUMBERS)):
        if value not in allowed:
            raise ValueError(f"--{name} {value} is not known; allowed are {', '.join(allowed)}")
    for file in sorted({CERTIFICATE, *WRITTEN}):
        if Path(folder, file).is_dir():
            raise ValueError(f"{Path(folder, file)} is a folder, in the place of a file of --out")
    chosen, name, memory, kept = _chosen(request, state)
    need_one_reference("an exported law", chosen.machine)
    scheme, actuator = chosen.schemes[name], chosen.machine.actuator
    goes_on = scheme.initial_state(chosen.task), getattr(actuator, "rate", None)
    if chosen.machine.carries and jax.tree.leaves(goes_on):
        raise ValueError(
            f"{name} cannot be exported: machine.variation.carried makes its feedback and the rate "
            "of the actuator go on from trial to trial, and the code begins each at rest"
        )
    for option in ("dropped", "shortest"):
        chance = getattr(chosen.machine.variation, option, None)
        if chance is not None:
            raise ValueError(
                f"{name} cannot be exported: machine.variation.{option} = {float(chance):g}, and "
                "the code learns from a trial only where each of its samples was measured; leave "
                "it out where the controller measures them all"
            )
    largest = kept.get("limit", getattr(actuator, "limit", None)) if limit is None else limit
    if largest is None or not _positive(largest, number):
        raise ValueError(
            f"--limit {limit} is no largest input; allowed are finite numbers above 0, in the type "
            "of --number, which the law does not exceed, or a limit of the actuator in the plant "
            "file"
        )
    begun = schedules(scheme, scheme.initial_memory(chosen.task) if memory is None else memory,
                      chosen.task)  # fmt: skip
    for _, text in beyond_limits(begun, chosen.task, None, Rules(largest, kept.get("correction"))):
        told = text.replace("campaign.limit", "--limit")
        raise ValueError(f"the law begins beyond a limit: {told}")
    progress("trace")
    try:
        law = law_of(scheme, chosen.task, largest, actuator=actuator, memory=memory,
                     correction=kept.get("correction"), trials=kept.get("seen"))  # fmt: skip
    except Unknown as error:
        raise ValueError(f"{name} cannot be exported: {error}") from None
    progress("certify")
    claimed = _claimed(chosen, name, law, machines, seed)
    source = kept["source"]
    claims = as_json(
        {
            "scheme": name,
            "class": type(scheme).__name__,
            "weights": _weights(scheme),
            "samples": chosen.task.N,
            "sample_time": chosen.task.dt,
            "units": {"y": chosen.task.unit, "u": chosen.task.input_unit},
            "limit": np.broadcast_to(np.asarray(largest, float), (chosen.task.inputs,)).tolist(),
            "format": format,
            "number": number,
            "trials_learned_from": kept["seen"].learned if "seen" in kept else 0,
            **claimed,
            "plant_file": _plant_file(source),
        }
    )
    digest = seal_of(claims)
    progress("print")
    about = [
        f"{name}: a learning law of jaxilc, from {Path(source).name}.",
        *claimed["verdict"],
        "Weights: " + "; ".join(f"{path} = {value}" for path, value in claims["weights"].items()),
    ]
    try:
        single = number == "float"
        asked = Asked(law, chosen.machine, about, digest, trials_of_test(law), single)
        made = FORMATS[format].make(asked)
    except Unknown as error:
        raise ValueError(f"{name} cannot be exported: {error}") from None
    if single:
        progress("single precision")
        need_single(law, name)
    whole = certificate_of(claims, made.files)
    of = {function.name: cost(function.program) for function in law.functions}
    costs = {
        "operations_a_sample": of["sample"],
        "operations_between_trials": of["end"],
        "bytes": made.bytes,
    }
    return Outcome(
        command="export",
        numbers=claims | {"certificate": digest} | costs,
        verdict=Verdict((
            f"{name} is {FORMATS[format].said}: at most {costs['operations_a_sample']} operations "
            f"a sample and {costs['operations_between_trials']} between two trials, and "
            f"{costs['bytes']} bytes of memory.",
            *claimed["verdict"],
        ), "prove that the files belong together",
            shlex.join(["jaxilc", "export", "--check", str(folder)])),
        lines=claimed["reasons"],
        warnings=(
            *made.warnings,
            *(f"{text}; remove it" for text in of_others(Path(folder), made.files)),
        ),
        folder=Path(folder),
        files={file: partial(write_file, content=text) for file, text in made.files.items()}
        | {CERTIFICATE: lambda path: write_json(path, whole)},
    )  # fmt: skip


def check_export(folder: str | Path) -> Outcome:
    """What is claimed of an exported law; raises ValueError naming each file that was changed."""
    from ..export import check

    claims = check(folder)
    said = f"{folder}: code, vectors and certificate belong together."
    verdict = Verdict((said, *claims["verdict"]))
    return Outcome(command="export", numbers=claims, verdict=verdict)


def _positive(limit: Value, number: str) -> bool:
    """Whether all limits are above 0 and finite as the law holds them."""
    with np.errstate(over="ignore"):
        held = np.asarray(limit).astype("f4" if number == "float" else "f8")
    return bool(np.all(np.isfinite(held) & np.greater(held, 0)))


def need_single(law: Law, name: str) -> None:
    """Raises ValueError for a law that plays other inputs in the first trials as `float`.

    It has the roundings that it allows for from double precision, in which it was traced.
    """
    trials = trials_of_test(law)[: max(2, PLAYED // law.task.N)]
    u, other = (
        np.array([played.trial(y)[0] for y in trials])
        for played in (law.played(np.float64), law.played(np.float32))
    )
    off, largest = np.max(np.abs(other - u)), np.max(np.abs(u))
    if not off <= APART * largest:
        raise ValueError(
            f"--number float: in single precision inputs of {name} are off by up to {off:.3g}, and "
            f"the largest is {largest:.3g}; allowed is --number double"
        )


def trials_of_test(law: Law) -> list[np.ndarray]:
    """The outputs of the trials of the test program: ever nearer to the reference, with noise."""
    r, draw = np.asarray(law.task.reference), np.random.default_rng(0)
    noise = 0.01 * (np.ptp(r) or 1.0)
    trials = [r * (1 - 0.5**j) + noise * draw.normal(size=r.shape) for j in range(TESTED)]
    trials[-1][len(r) // 2] = np.nan
    return trials


def _chosen(
    request: Request | str | None, state: str | Path | None
) -> tuple[Scenario, str, Tree, Numbers]:
    """The scenario, the name of the scheme, the memory, and what a campaign keeps."""
    if state is not None:
        from ..scenarios.campaigns import Given, open_campaign

        if request is not None:
            raise ValueError(
                "a scenario and --state exclude each other; a campaign has its own scheme, weights"
            )
        opened = open_campaign(Path(state), Given(), new=False)
        campaign, recipe = opened.campaign, opened.recipe
        rules = {key: value for key, value in recipe["rules"].items() if value is not None}
        kept = {"source": recipe["scenario"], "seen": _seen(campaign)} | rules
        return opened.scenario, recipe["scheme"], campaign.memory(), kept
    if request is None:
        raise ValueError("export needs a scenario or a plant file, or --state of a campaign")
    asked = Request.of(request)
    chosen = asked.scenario()
    learning = [name for name, scheme in chosen.schemes.items() if scheme.learns]
    if len(learning) != 1:
        raise ValueError(
            f"export takes one scheme that learns, named by --scheme; {chosen.name} has "
            f"{', '.join(learning) or 'none'}"
        )
    return chosen, learning[0], None, {"source": asked.source}


def _seen(campaign: Campaign) -> Trials:
    """What the guard of the law knows of the trials of a campaign."""
    from ..export.guard import Trials, still
    from ..hardware.campaign import TRIAL
    from ..hardware.checks import learned_so_far, of_learning
    from ..hardware.journal import whole_trials

    live, task = campaign.journal.live(), campaign.task
    errors = [e for _, e in of_learning(campaign.scheme, task, live)]
    whole = whole_trials(live)
    y = campaign.journal.arrays(whole[-1], TRIAL)["y"] if whole else np.zeros_like(task.reference)
    moved = ~np.asarray(still(task, y))
    return Trials(min(errors, default=float("inf")), *learned_so_far(live), moved)


def _claimed(chosen: Scenario, name: str, law: Law, machines: int, seed: int) -> Numbers:
    """What theory claims of the law up to the largest |u| that it plays, and on which machines.

    And which trials of the nominal machine the guard refuses, of which theory does not know.
    """
    from ..export.guard import MEANINGS
    from ..learning import Actuator
    from ..runtime.provenance import describe
    from ..theory.certificates import certify_schemes
    from ..uncertainty import draw

    actuator = chosen.machine.actuator or Actuator()
    least = law.limit if actuator.limit is None else np.minimum(actuator.limit, law.limit)
    machine = dataclasses.replace(
        chosen.machine, actuator=dataclasses.replace(actuator, limit=least)
    )
    drawn = draw(machine, chosen.uncertainty, machines, seed=seed)
    one = certify_schemes(machine, {name: chosen.schemes[name]}, chosen.task, chosen.trials,
                          chosen.uncertainty, drawn)[name]  # fmt: skip
    numbers = certificate_numbers(one)
    sigma = np.asarray(one.certificate.sigma, float)
    said = certificate_sentence(name, chosen.trials, numbers, chosen.shown_scale, chosen.shown_unit)
    codes = law.codes(machine, chosen.trials, jax.random.key(seed))
    refused = np.flatnonzero(codes)
    of_guard = [
        f"The guard refuses {refused.size} of {codes.size} trials of the nominal machine, trial "
        f"{refused[0] + 1} as the first ({MEANINGS[codes[refused[0]]]}): what is claimed holds of "
        "the law without its guard."
    ] if refused.size else []  # fmt: skip
    return {
        "verdict": [said, *of_guard],
        "refused_trials": (refused + 1).tolist(),
        "claims": numbers["claims"],
        "premises": numbers.get("premises", []),
        "reasons": reason_lines(name, numbers),
        "margin": float(1 - np.max(sigma)) if np.all(np.isfinite(sigma)) else None,
        "family": {
            "machines": len(sigma),
            "seed": seed,
            "uncertainty": describe(chosen.uncertainty),
        },
        "resolution": {
            "sensor": describe(chosen.machine.sensor),
            "actuator": describe(chosen.machine.actuator),
        },
    }


def _weights(scheme: Tree) -> Numbers:
    """The weights by their paths; of long ones the shape."""
    found: Numbers = {}
    for path, value in named_leaves(scheme).items():
        array = np.asarray(value)
        found[path] = array.tolist() if array.size <= 8 else f"{array.shape} numbers"
    return found


def _plant_file(source: str) -> dict[str, str] | None:
    from ..scenarios.campaign_source import digest_of

    path = Path(source)
    return {"path": str(path), "sha256": digest_of(path)} if path.is_file() else None
