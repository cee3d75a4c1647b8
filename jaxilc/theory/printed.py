"""The conditions that papers print for a scheme, asked of the scheme and not of a machine."""

from __future__ import annotations

from ..schemes import ASMC, SMC, ExponentialPD, NormOptimal, Scheme, WithFeedback
from ..signals.task import Task
from .condition import Condition
from .lifted import weights_condition
from .sliding import printed_condition


def printed_conditions(scheme: Scheme, task: Task) -> dict[str, Condition]:
    """The conditions by their places in the papers; empty for a scheme of which none speaks.

    MILC 2024, Theorem 2, of norm-optimal learning, see `weights_condition`, and Xu 2024, eq. 36, of
    learning over sliding mode, see `printed_condition`. That of Cao 2019 needs a plant, see
    `bounds_of`.
    """
    law = scheme
    while (inner := getattr(law, "learning", getattr(law, "scheme", None))) is not None:
        law = inner
    if isinstance(law, NormOptimal):
        return {"MILC 2024, Theorem 2": weights_condition(law)}
    over_sliding = isinstance(scheme, WithFeedback) and isinstance(scheme.feedback, SMC | ASMC)
    if isinstance(law, ExponentialPD) and over_sliding:
        return {"Xu 2024, eq. 36": printed_condition(scheme, task).condition}
    return {}
