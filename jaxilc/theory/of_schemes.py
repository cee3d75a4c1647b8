"""What theory says of each scheme of a scenario that learns, over machines that were drawn."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from ..learning.machine import Machine
from ..schemes import FFDLMFAILC, Scheme
from ..signals.task import Task
from ..uncertainty import Uncertainty
from .bounds_of_machines import Checked, checked_machines
from .certificates import Certificate, certify

NEEDED = 2  # trials: the bounds compare one with the one before it


class OfScheme(NamedTuple):
    """What theory says of one scheme.

    certificate: of each machine
    checked: the bounds of Cao 2019 and their premises; None for a scheme that has no such bounds
    seconds: that the certificate took
    """

    certificate: Certificate
    checked: Checked | None
    seconds: float


def certify_schemes(
    machine: Machine,
    schemes: Mapping[str, Scheme],
    task: Task,
    trials: int,
    uncertainty: Uncertainty,
    drawn: Mapping[str, Any],
    *,
    progress: Callable[[int, str], object] | None = None,
) -> dict[str, OfScheme]:
    """The certificate of every scheme that learns, with the premises of its bounds, by name.

    drawn: machines of `uncertainty.draw`
    progress: called with the number of schemes done and the name of the next one
    Raises ValueError, before anything runs, where no scheme learns, or where the trials are too few
    for bounds to be checked, and whatever `certify` raises.
    """
    learning = {name: scheme for name, scheme in schemes.items() if scheme.learns}
    if not learning:
        raise ValueError(
            f"certify: none of {', '.join(schemes)} learns; there is nothing to certify"
        )
    for name, scheme in learning.items():
        if isinstance(scheme, FFDLMFAILC) and trials < NEEDED:
            allowed = f"[{NEEDED}, inf) of {name}, whose bounds are checked"
            raise ValueError(f"--trials {trials} is outside its allowed range {allowed}")
    found = {}
    for name, scheme in learning.items():
        if progress is not None:
            progress(len(found), name)
        start = time.perf_counter()
        certificate = certify(machine, scheme, task, trials, uncertainty, drawn)
        seconds, bounds = time.perf_counter() - start, None
        if isinstance(scheme, FFDLMFAILC):
            bounds = checked_machines(machine, scheme, task, trials, uncertainty, drawn)
        found[name] = OfScheme(certificate, bounds, seconds)
    return found
