"""The conditions that papers print for a scheme, asked of its nominal model and not of a trial."""

from __future__ import annotations

import numpy as np

from ..learning.machine import Machine
from ..schemes import ASMC, SMC, ExponentialPD, NormOptimal, PIDType, Scheme, WithFeedback
from ..signals.task import Task
from .condition import Condition
from .frequency import learning_condition
from .lifted import weights_condition
from .sliding import printed_condition


def printed_conditions(
    scheme: Scheme, task: Task, machine: Machine | None = None
) -> dict[str, Condition]:
    """The conditions by their places in the papers; empty for a scheme of which none speaks.

    MILC 2024, Theorem 2, of norm-optimal learning, see `weights_condition`, and Xu 2024, eq. 36, of
    learning over sliding mode, see `printed_condition`. With a machine also Li 2020, eq. 9, of
    P-type learning over feedback, see `learning_condition`. That of Cao 2019 has many premises of a
    trial, see `bounds_of`.
    """
    law = scheme
    while (inner := getattr(law, "learning", getattr(law, "scheme", None))) is not None:
        law = inner
    if isinstance(law, NormOptimal):
        return {"MILC 2024, Theorem 2": weights_condition(law)}
    over_sliding = isinstance(scheme, WithFeedback) and isinstance(scheme.feedback, SMC | ASMC)
    if isinstance(law, ExponentialPD) and over_sliding:
        return {"Xu 2024, eq. 36": printed_condition(scheme, task).condition}
    if machine is not None and isinstance(scheme, WithFeedback) and _p_type(scheme.learning):
        return {"Li 2020, eq. 9": learning_condition(machine, scheme, task).condition}
    return {}


def _p_type(law: Scheme) -> bool:
    """Whether a law is w_{j+1} = w_j + phi e_j, with nothing else."""
    if not isinstance(law, PIDType) or law.lead or law.limit is not None:
        return False
    return not np.any([np.any(x) for x in (law.gamma_i, law.gamma_d, law.leak)])
