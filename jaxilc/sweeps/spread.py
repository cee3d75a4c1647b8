"""How much of the spread of the errors over the machines each uncertain parameter explains."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.stats import rankdata

FEWEST = 12  # machines


def explained_shares(parameters: Mapping[str, np.ndarray], errors) -> dict[str, float]:
    """The share of the variance of the errors' ranks that each parameter explains by itself.

        1 - sum_i (R_{i+1} - R_i)^2 / (2 (S - 1) var(R))

    R_i is the rank of the error of the i-th machine in the order of the parameter: if the parameter
    explains everything, neighbours have nearly the same rank. It estimates the first-order
    sensitivity index (Gamboa, Gremaud, Klein, Lagnoux 2022) for any shape of the dependence. Ranks
    are used since errors differ by decades, and one that diverged has a rank, too. Without any
    effect the standard deviation of the estimate is about 1 / S^(1/2).

    parameters: (S,) values by name
    errors: (S,) errors, inf for a machine that diverged
    Returns shares from 0 to 1; 0 where all errors are equal, or there are fewer than 12 machines.
    Raises ValueError for numbers of machines that differ.
    """
    errors = np.asarray(errors, float)
    ranks, machines = rankdata(np.nan_to_num(errors, nan=np.inf)), len(errors)
    # machines with equal values, such as corners, stand in no order among themselves
    shuffled = np.random.default_rng(0).permutation(machines)
    shares = {}
    for name, values in parameters.items():
        if len(values) != machines:
            raise ValueError(
                f"explained_shares: {name} has {len(values)} values; allowed are {machines}"
            )
        if machines < FEWEST or np.ptp(ranks) == 0 or np.ptp(values) == 0:
            shares[name] = 0.0
            continue
        order = shuffled[np.argsort(np.asarray(values)[shuffled], kind="stable")]
        steps = np.sum(np.diff(ranks[order]) ** 2) / (2 * (machines - 1) * np.var(ranks))
        shares[name] = float(np.clip(1.0 - steps, 0.0, 1.0))
    return shares
