"""Sums of parts with shared poles on the lines of a measured response: values, and least squares.

The numerators are linear in the response, so that they are eliminated (variable projection: Golub,
Pereyra 1973; Kaufman 1975): the search is one over poles and delay only. Everything is NumPy on
lines of one input and one output; nothing compiles.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..plants import ModalModel
from ..plants.process_model import samples_of
from ..pytree.aliases import Numbers

STEP = 1e-6  # of a logarithm, in central differences
UNIT = 2 * np.pi  # [rad/s] by which integrators are scaled, so that columns have like sizes
DAMPINGS = (1e-4, 30.0)  # that are looked for; from 1 on, a mode is two real poles
BESIDE = 1e-7  # of damping 1, where the two poles of a mode coincide, in which 1 is not taken
BELOW, ABOVE = 1 / 30, 4.0  # times the first and the last line, rates that are looked for
SHARE = 0.95  # of half the sample rate, up to which rates are looked for


class Parts(NamedTuple):
    """Which parts a model has.

    The values theta of its poles and delay are the logarithms of the rates of the lags, of the
    frequencies and of the dampings of the modes, and the delay [s].
    """

    lags: int = 0
    modes: int = 0
    integrators: int = 0
    direct: bool = False

    @property
    def order(self) -> int:
        return self.lags + 2 * self.modes + self.integrators

    @property
    def numerators(self) -> int:
        return self.integrators + self.lags + 2 * self.modes + self.direct

    @property
    def numbers(self) -> int:
        """Values that are fitted, the delay among them."""
        return self.numerators + self.lags + 2 * self.modes + 1


def columns(theta: Numbers, parts: Parts, f: Numbers, dt: float | None) -> Numbers:
    """(F, numerators) responses of the parts: integrators, lags, modes (a and b by turns), direct.

    They are those of `ModalModel`, in units of 1 / (2 pi s) for integrators: in s without dt, else
    of `sampled(dt)`.
    """
    s, delay = (2j * np.pi * f)[:, None], float(theta[-1])
    p, w, zeta = np.split(np.exp(theta[:-1]), np.cumsum([parts.lags, parts.modes]))
    if dt is None:
        late = np.exp(-s * delay)
        integrators = late * (UNIT / s) ** np.arange(1, 1 + parts.integrators)
        lags, direct = late / (1 + s / p), late
        mode = late / (1 + 2 * zeta * s / w + (s / w) ** 2)
        modes = mode, s / w * mode
    else:
        whole, rest = samples_of(delay, dt, "ModalModel")
        z, now = np.exp(s * dt), dt - rest
        late = z**-whole
        first = (now + rest / z) / (z - 1)
        second = (dt * first + rest * (dt - rest / 2) / z + now**2 / 2) / (z - 1)
        both = np.hstack([late * UNIT * first, late * UNIT**2 * second])
        integrators, direct = both[:, : parts.integrators], late / z
        lags = late * p * _held(-p, z, dt, rest)
        apart = zeta + BESIDE * (np.abs(zeta - 1) < BESIDE)
        root = w * np.sqrt(apart**2 - 1 + 0j)
        one, other = -apart * w + root, -apart * w - root
        of_one, of_other = _held(one, z, dt, rest), _held(other, z, dt, rest)
        scaled = late * w / (one - other)
        modes = scaled * w * (of_one - of_other), scaled * (one * of_one - other * of_other)
    turns = np.stack(modes, axis=2).reshape(len(f), -1)
    return np.hstack([integrators, lags, turns, direct[:, : int(parts.direct)]])


def _held(pole: Numbers, z: Numbers, dt: float, rest: float) -> Numbers:
    """(F, poles) 1 / (s - pole) behind a hold, delayed by a part of a sample."""
    now = dt - rest
    after = np.exp(pole * now) * np.expm1(pole * rest) / pole
    return (np.expm1(pole * now) / pole + after / z) / (z - np.exp(pole * dt))


def slopes(theta: Numbers, parts: Parts, f: Numbers, dt: float | None, numerators: Numbers):
    """(F, theta) derivatives of the response by theta, by differences of the part that moves."""
    found = np.empty((len(f), len(theta)), complex)
    lags, modes = parts.lags, parts.modes
    for i in range(len(theta)):
        if i < lags:
            own, at, first, of = Parts(lags=1), [i, -1], parts.integrators + i, 0
        elif i < len(theta) - 1:
            mode = (i - lags) % modes
            own, at = Parts(modes=1), [lags + mode, lags + modes + mode, -1]
            first, of = parts.integrators + lags + 2 * mode, (i - lags) // modes
        else:
            own, at, first, of = parts, list(range(len(theta))), 0, i
        step = STEP if own is not parts else STEP / f[-1]
        ahead, behind = theta[at], theta[at]
        ahead[of] += step
        behind[of] -= step if own is not parts else min(step, theta[-1])
        moved = columns(ahead, own, f, dt) - columns(behind, own, f, dt)
        N = numerators[first : first + own.numerators]
        found[:, i] = moved @ N / (ahead[of] - behind[of])
    return found


class Problem(NamedTuple):
    """Weighted least squares on lines.

    f, G: (F,) frequencies [Hz] and measured response
    weights: (F,) by which complex residuals are multiplied
    dt: sample time of the hold [s]; None for continuous time
    longest: the longest delay that is allowed [s]
    delay: where it is fixed [s]; None where it is fitted
    """

    f: Numbers
    G: Numbers
    weights: Numbers
    dt: float | None
    longest: float
    delay: float | None

    def bounds(self, parts: Parts) -> tuple[Numbers, Numbers]:
        """The least and largest theta."""
        rates = 2 * np.pi * np.array([BELOW * self.f[0], ABOVE * self.f[-1]])
        if self.dt is not None:
            rates[1] = min(rates[1], SHARE * np.pi / self.dt)
        late = (0.0, self.longest) if self.delay is None else (self.delay, self.delay)
        both = [np.repeat(rates[i], parts.lags + parts.modes) for i in (0, 1)]
        low, high = (
            np.append(np.log([*both[i], *[DAMPINGS[i]] * parts.modes]), late[i]) for i in (0, 1)
        )
        return low, high

    def projected(self, theta: Numbers, parts: Parts) -> Projected:
        """The best numerators at theta, and what they leave."""
        A = stacked(self.weights[:, None] * columns(theta, parts, self.f, self.dt))
        y = stacked(self.weights * self.G)
        length = np.linalg.norm(A, axis=0)
        length[length == 0] = 1.0
        Q, U = np.linalg.qr(A / length)
        numerators = np.linalg.lstsq(U, Q.T @ y, rcond=1e-13)[0] / length
        left = y - Q @ (Q.T @ y)
        return Projected(theta, Q, numerators, left, float(left @ left))

    def least_squares(
        self, theta: Numbers, parts: Parts, steps: int = 40, tolerance: float = 1e-6
    ) -> tuple[Projected, bool]:
        """The minimum near theta by Levenberg-Marquardt steps within the bounds, and if it is one.

        tolerance: relative decrease of the cost below which a step ends the search
        """
        low, high = self.bounds(parts)
        now = self.projected(np.clip(theta, low, high), parts)
        mu = 1e-3
        for _ in range(steps):
            J = -stacked(self.weights[:, None] * slopes(now.theta, parts, self.f, self.dt, now.N))
            J = J - now.Q @ (now.Q.T @ J)
            size = np.linalg.norm(J, axis=0)
            size[size == 0] = 1.0
            g, H = (J / size).T @ now.left, (J / size).T @ (J / size)
            at_bound = ((now.theta <= low) & (g > 0)) | ((now.theta >= high) & (g < 0))
            free = np.flatnonzero(~at_bound)
            for _ in range(8):
                step = np.zeros(len(g))
                step[free] = -np.linalg.solve(
                    H[np.ix_(free, free)] + mu * np.eye(len(free)), g[free]
                )
                step = step / size
                step[:-1] = np.clip(step[:-1], -1.0, 1.0)
                new = self.projected(np.clip(now.theta + step, low, high), parts)
                if new.cost < now.cost:
                    break
                mu *= 6
            else:
                return now, True
            gained = (now.cost - new.cost) / now.cost
            now, mu = new, max(mu / 5, 1e-9)
            if gained < tolerance:
                return now, True
        return now, False


class Projected(NamedTuple):
    """A place of the search.

    theta: poles and delay;  N: numerators
    Q: orthonormal basis of the weighted columns, (2 F, numerators)
    left: (2 F,) weighted residual, real parts first;  cost: its sum of squares
    """

    theta: Numbers
    Q: Numbers
    N: Numbers
    left: Numbers
    cost: float


def stacked(values: Numbers) -> Numbers:
    """Real parts, then imaginary parts."""
    return np.concatenate([values.real, values.imag])


def jacobian(at: Projected, parts: Parts, f: Numbers, dt: float | None) -> Numbers:
    """(F, numbers) derivatives by what `values_of` answers, the delay last."""
    d_theta = slopes(at.theta, parts, f, dt, at.N)
    values = np.exp(at.theta[:-1])
    scaled = np.append(values, 1.0)
    d_numerators = columns(at.theta, parts, f, dt) / _units(parts)
    return np.hstack([d_theta[:, :-1] / scaled[:-1], d_numerators, d_theta[:, -1:]])


def _units(parts: Parts) -> Numbers:
    """What each numerator is multiplied by, in a ModalModel."""
    return np.append(
        UNIT ** np.arange(1.0, 1 + parts.integrators),
        np.ones(parts.numerators - parts.integrators),
    )


def values_of(at: Projected, parts: Parts) -> Numbers:
    """Rates, frequencies, dampings, numerators and delay as a ModalModel has them."""
    return np.concatenate([np.exp(at.theta[:-1]), at.N * _units(parts), at.theta[-1:]])


def names_of(parts: Parts) -> tuple[str, ...]:
    """The paths of these values in a ModalModel."""
    n, q = parts.lags, parts.modes
    poles = [f"poles[{i}]" for i in range(n)]
    poles += [f"{name}[{i}]" for name in ("frequencies", "dampings") for i in range(q)]
    single = ["integrator", "double_integrator"][: parts.integrators]
    gains = [f"pole_gains[{i}]" for i in range(n)]
    gains += [f"{name}[{i}]" for i in range(q) for name in ("mode_gains", "mode_rates")]
    return (*poles, *single, *gains, *["direct"] * parts.direct, "delay")


def model_of(values: Numbers, parts: Parts) -> ModalModel:
    """The plant of these values."""
    n, q, i = parts.lags, parts.modes, parts.integrators
    p, w, zeta, single, R, modes, direct, delay = np.split(
        values, np.cumsum([n, q, q, i, n, 2 * q, parts.direct])
    )
    return ModalModel(
        p,
        R,
        w,
        zeta,
        modes[::2],
        modes[1::2],
        *(float(single[k]) if k < i else None for k in (0, 1)),
        float(direct[0]) if parts.direct else None,
        delay=float(delay[0]),
    )
