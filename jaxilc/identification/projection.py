"""Least squares that are linear in some of their unknowns: only the others are searched for.

The residual of y = X(theta) N is that of the best N at theta (variable projection; Golub, Pereyra
1973), with the Jacobian of Kaufman (1975): the derivatives of X N by theta, without what the
columns of X span.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ..pytree.aliases import Numbers
from .problem import unit_columns


class Projected(NamedTuple):
    """A place of the search.

    theta: what is searched for;  N: (c,) or (c, n_y) the best linear unknowns there
    Q: (rows, c) orthonormal basis of the columns
    left: (rows,) or (rows, n_y) residual;  cost: its sum of squares
    """

    theta: Numbers
    Q: Numbers
    N: Numbers
    left: Numbers
    cost: float


def projected(theta: Numbers, X: Numbers, y: Numbers) -> Projected:
    """The best N of the columns X (rows, c), and what it leaves of y (rows,) or (rows, n_y)."""
    scaled, length = unit_columns(X)
    Q, R = np.linalg.qr(scaled)
    b = Q.T @ y
    N = (np.linalg.lstsq(R, b, rcond=1e-13)[0].T / length).T
    left = y - Q @ b
    return Projected(theta, Q, N, left, float(np.vdot(left, left)))


def searched(
    at: Callable[[Numbers], Projected],
    slopes: Callable[[Projected], Numbers],
    theta: Numbers,
    bounds: tuple[Numbers, Numbers],
    *,
    steps: int,
    tolerance: float,
    eased: float,
    furthest: float | Numbers = 1.0,
) -> tuple[Projected, bool]:
    """The minimum near theta by Levenberg-Marquardt steps within bounds, and whether it is one.

    slopes: (rows, [n_y,] theta) derivatives of the residual at constant N
    tolerance: relative decrease of the cost below which a step ends the search
    eased: what the damping is divided by after a step; it is multiplied by 6 where one fails
    furthest: by which an element moves at a step, at most
    """
    low, high = bounds
    now, damping = at(np.clip(theta, low, high)), 1e-3
    for _ in range(steps if len(theta) else 0):
        J = slopes(now)
        J = J - np.tensordot(now.Q, np.tensordot(now.Q.T, J, 1), 1)
        J, size = unit_columns(J.reshape(-1, len(theta)))
        g, H = J.T @ now.left.ravel(), J.T @ J
        at_bound = ((now.theta <= low) & (g > 0)) | ((now.theta >= high) & (g < 0))
        free = np.flatnonzero(~at_bound)
        for _ in range(8):
            step = np.zeros(len(g))
            damped = H[np.ix_(free, free)] + damping * np.eye(len(free))
            step[free] = -np.linalg.solve(damped, g[free])
            new = at(np.clip(now.theta + np.clip(step / size, -furthest, furthest), low, high))
            if new.cost < now.cost:
                break
            damping *= 6
        else:
            return now, True
        gained = (now.cost - new.cost) / now.cost
        now, damping = new, max(damping / eased, 1e-9)
        if gained < tolerance:
            return now, True
    return now, False
