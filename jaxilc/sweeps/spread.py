"""How much of the spread of the errors over the machines each uncertain parameter explains."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.stats import rankdata

FEWEST, MOST = 3, 20  # groups of machines with nearly the same value


def explained_shares(parameters: Mapping[str, np.ndarray], errors) -> dict[str, float]:
    """The share of the variance of the errors' ranks that each parameter explains by itself.

        eta^2 = sum_g n_g (m_g - m)^2 / sum_i (rank_i - m)^2,   1 - (1 - eta^2) (S - 1) / (S - G)

    The machines are put into G groups of nearly the same value of the parameter; m_g is the mean
    rank of group g. The second formula takes away what chance gives G groups of S machines. It is
    the first-order sensitivity index of the rank (Pearson's correlation ratio), and holds for
    any shape of the dependence. Ranks are used since errors differ by decades, and one that
    diverged has a rank, too.

    parameters: (S,) values by name
    errors: (S,) errors, inf for a machine that diverged
    Returns shares from 0 to 1; 0 where all errors are equal, or there are fewer than 12 machines.
    Raises ValueError for numbers of machines that differ.
    """
    errors = np.asarray(errors, float)
    ranks, machines = rankdata(np.nan_to_num(errors, nan=np.inf)), len(errors)
    whole = np.sum((ranks - ranks.mean()) ** 2)
    groups = int(np.clip(np.sqrt(machines) / 2, FEWEST, MOST))
    shares = {}
    for name, values in parameters.items():
        if len(values) != machines:
            raise ValueError(
                f"explained_shares: {name} has {len(values)} values; allowed are {machines}"
            )
        if whole == 0 or machines < 4 * FEWEST or np.ptp(values) == 0:
            shares[name] = 0.0
            continue
        parts = np.array_split(ranks[np.argsort(values, kind="stable")], groups)
        between = sum(len(part) * (part.mean() - ranks.mean()) ** 2 for part in parts)
        rest = (1.0 - between / whole) * (machines - 1) / (machines - groups)
        shares[name] = float(np.clip(1.0 - rest, 0.0, 1.0))
    return shares
