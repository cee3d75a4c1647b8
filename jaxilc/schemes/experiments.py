"""Schemes that make experiments on the machine between the trials that play what they learned."""

from __future__ import annotations

from typing import Any

from ..signals.task import Task
from .scheme import Scheme, with_all_parts


def trials_of_step(scheme: Scheme, task: Task) -> int:
    """The number of trials of a learning step of which the first alone plays what was learned.

    It is 1 for a scheme that makes no experiments.
    """
    experiments = any(part.scheme.experiments for part in with_all_parts(scheme, task))
    return scheme.trials_a_step if experiments else 1


def need_no_experiments(wrapper: Any, task: Task, why: str) -> None:
    """Raises ValueError where a part of the scheme makes experiments between its steps."""
    for scheme, _, _ in with_all_parts(wrapper.scheme, task):
        if scheme.experiments:
            raise ValueError(
                f"{type(wrapper).__name__}: {type(scheme).__name__} makes experiments between its "
                f"steps, {why}"
            )
