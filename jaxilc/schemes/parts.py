"""What is asked of all parts of a scheme: experiments between trials, comparing within a trial.

Some schemes make experiments on the machine between the trials that play what they learned. Others
compare the output of the running trial with that of the last one, which a wrapper may have changed.
"""

from __future__ import annotations

from collections.abc import Iterator

import jax

from ..signals.task import Task
from .scheme import UNASKED, Memory, Part, Scheme


def with_all_parts(scheme: Scheme, task: Task, memory: Memory = UNASKED) -> Iterator[Part]:
    """The scheme, its parts, the parts of these parts, and so on."""
    yield Part(scheme, task, memory)
    for part in scheme.parts(task, memory).values():
        yield from with_all_parts(*part)


def trials_of_step(scheme: Scheme, task: Task) -> int:
    """The number of trials of a learning step of which the first alone plays what was learned.

    It is 1 for a scheme that makes no experiments.
    """
    experiments = any(part.scheme.experiments for part in with_all_parts(scheme, task))
    return scheme.trials_a_step if experiments else 1


def growth_of(scheme: Scheme, task: Task) -> float:
    """The most by which a part makes what is learned grow faster than j / (j - 1), see `Law`."""
    return max(part.scheme.grows for part in with_all_parts(scheme, task))


def need_learned_at_last(owner: str, scheme: Scheme, task: Task, trials: int) -> None:
    """Raises ValueError where the last trial is an experiment, which says nothing of learning."""
    each = trials_of_step(scheme, task)
    if (trials - 1) % each:
        raise ValueError(
            f"{owner}: trials = {trials} ends with an experiment, whose error says nothing of what "
            f"was learned; allowed are 1, {1 + each}, {1 + 2 * each} and so on"
        )


def need_no_experiments(wrapper: Scheme, task: Task, why: str) -> None:
    """Raises ValueError where a part of the scheme makes experiments between its steps."""
    for scheme, _, _ in with_all_parts(wrapper, task):
        if scheme.experiments:
            raise ValueError(
                f"{type(wrapper).__name__}: {type(scheme).__name__} makes experiments between its "
                f"steps, {why}"
            )


def need_no_comparing(wrapper: Scheme, task: Task, found: str = "", instead: str = "is") -> None:
    """Raises ValueError where a part of the scheme compares outputs within the trial.

    found: what of the wrapper does not allow it, at the start of the message
    instead: what is allowed instead, before the field of the part that has to be zero
    """
    for scheme, _, _ in with_all_parts(wrapper, task):
        for name in scheme.compares:
            if getattr(scheme, name):
                raise ValueError(
                    f"{type(wrapper).__name__}: {found}{name} = {getattr(scheme, name)} of "
                    f"{type(scheme).__name__}, which compares outputs within the trial; allowed "
                    f"{instead} {name} = 0"
                )


def need_second_derivatives(scheme: Scheme) -> None:
    """Raises ValueError where a part of the scheme has first derivatives only."""

    def first_only(one: object) -> bool:
        return isinstance(one, Scheme) and one.first_derivatives_only

    for one in filter(first_only, jax.tree.leaves(scheme, is_leaf=first_only)):
        raise ValueError(
            "Contraction: the slope of a contraction needs second derivatives, and "
            f"{type(one).__name__} has first ones only; allowed are other objectives"
        )
