"""The result of identification and its reliability: confidence intervals, poles, whiteness."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy

from ..plants import ModalModel, Plant, ProcessModel
from ..pytree.in_short import in_short
from .problem import Minimum, Problem, poles_at, unit_columns

CONFIDENCE, WIDE = 0.95, 1.96  # of the intervals; half of one of 95 % in standard deviations
LAGS = 20  # lags of the residual's autocorrelation that are tested
WHITE = 0.8  # share of autocorrelations within their bounds from which on a residual is white
NEAR, LEFT = 1.2, 0.5  # ratio of frequencies taken together; share of the output left at them
GOOD, NOISE = 90.0, 1.5  # fit [%] from which on a residual may be noise, and its factor at most
DRAWS = 4000  # draws of the parameters, for the intervals of the poles


class Estimate(NamedTuple):
    """A number with its 95 % confidence interval.

    Of a fit to a record the noise may have a colour, which is found from the residual. Then the
    interval holds the true number in 90 to 97 of 100 records of at least 120 samples where noise
    goes on for 3 samples, or of 500 where it does for 20; of 120 samples with the latter, in 80.

    low, high: ends of the interval, infinite where the record does not determine the number
    """

    value: float
    low: float
    high: float


class PoleEstimate(NamedTuple):
    """A pole [rad/s] with 95 % intervals of its real and of its imaginary part."""

    value: complex
    real: Estimate
    imag: Estimate


class Identified(NamedTuple):
    """The result of an identification.

    plant: the plant with the fitted values
    parameters: the estimates by the path of the parameter, and `bias`, the output at rest
        (`bias[i]` of several outputs)
    covariance: (P, P) covariance of the parameters in this order; inf on the diagonal for a
        parameter that the record does not determine
    poles: poles of a ProcessModel or a ModalModel; the intervals are quantiles over draws of the
        parameters, since a double pole is not a smooth function of them
    samples: the output samples 0 .. samples-1 were fitted, the others validate the fit
    simulated: (N+1, n_y) the plant's output, with the bias
    fit: (n_y,) 100 (1 - |y - simulated| / |y - mean y|) [%] over the fitted part; 100 is perfect
    validation_fit: (n_y,) the same over the validation part [%]; nan if all samples were fitted,
        and where the output rests in that part, but for noise
    residual_std: (n_y,) standard deviation of y - simulated over the fitted part, with the degrees
        of freedom that are left
    whiteness: (n_y,) share of the residual's autocorrelations at lags 1 .. 20 that lie within
        +-1.96 / sqrt(samples); 0.95 is expected of white noise
    white: whether all shares reach 0.8, which white noise misses once in 400 times. If false, the
        structure is too simple, or the noise is coloured, or rounding is the only noise: the
        plant may still be good. The intervals are widened to what its spectrum says in any case
    converged: whether the optimiser met its tolerances; with too many parameters for the record it
        may make ever smaller progress without meeting them
    of_response: whether lines of a frequency response were fitted. Then `samples` counts them,
        `simulated` is the complex response, `fit` is 100 (1 - |measured - fit| / |measured|) of
        numbers divided by std, and `residual_std` is the residual divided by std: 1 is expected.
        Where no std is known, it is the relative residual
    std_known: whether the standard deviations of these lines were known
    apart: intervals for machines whose parameters are drawn as if they were independent; None where
        they are those of `parameters`. They spread the response of the machines as far as the fit
        is uncertain and the lines are from it
    from_rest: whether the machine rested when the record began; if not, `simulated` holds what the
        state at the start adds
    """

    plant: Plant
    parameters: dict[str, Estimate]
    covariance: np.ndarray
    poles: tuple[PoleEstimate, ...]
    samples: int
    simulated: np.ndarray
    fit: np.ndarray
    validation_fit: np.ndarray
    residual_std: np.ndarray
    whiteness: np.ndarray
    white: bool
    converged: bool
    of_response: bool = False
    std_known: bool = False
    apart: dict[str, Estimate] | None = None
    from_rest: bool = True
    __repr__ = in_short

    def summary(self) -> list[tuple[str, float, float, float]]:
        """Rows (quantity, value, low, high) to print; low and high are nan without an interval."""
        units = {"delay": "delay [s]"}
        rows = [(units.get(name, name), *of) for name, of in self.parameters.items()]
        for i, pole in enumerate(self.poles, 1):
            rows += [
                (f"pole {i}, real part", *pole.real),
                (f"pole {i}, imaginary part", *pole.imag),
            ]
        delay = getattr(self.plant, "delay", 0.0)
        if delay and "delay" not in self.parameters:
            rows.append(("delay [s]", delay, np.nan, np.nan))
        metrics = {"fit [%]": self.fit}
        if not self.of_response:
            metrics["fit of the validation part [%]"] = self.validation_fit
        kind = "residual / std" if self.std_known else "residual, relative"
        metrics[kind if self.of_response else "residual std"] = self.residual_std
        metrics["residual white, share of lags"] = self.whiteness
        several = len(self.fit) > 1
        return rows + [
            (n + f", output {i}" * several, float(v), np.nan, np.nan)
            for n, vs in metrics.items()
            for i, v in enumerate(vs)
        ]


def judged(problem: Problem, found: Minimum) -> Identified:
    """The result at the minimum, with its intervals, poles and tests of the residual."""
    theta, samples, y = found.theta, problem.samples, problem.record.y
    n_y = problem.plant.n_y
    residual, J = problem.residual(theta), problem.sensitivity(theta) / problem.scale[:, None]
    of_start = 0 if problem.from_rest else problem.parameters_of_start(theta)
    freedom = samples * n_y - of_start - len(theta)
    power = np.sum((residual[:samples] / problem.scale) ** 2) / freedom
    covariance = power * inverse_of_normal(J.reshape(-1, len(theta)))
    whiteness = whiteness_of(residual[:samples])
    plain = np.diag(covariance)
    covariance = widened(covariance, J, residual[:samples] / problem.scale)
    variance = np.diag(covariance)
    known = np.isfinite(variance) & (variance > 0)
    share = np.divide(plain, variance, out=np.ones(len(plain)), where=known)  # independent samples
    wide = scipy.special.stdtrit(np.maximum(freedom * share, 2.0), 0.5 + CONFIDENCE / 2)
    half = wide * np.sqrt(variance)
    wide = wide / scipy.special.ndtri(0.5 + CONFIDENCE / 2)
    biases = ["bias"] if n_y == 1 else [f"bias[{i}]" for i in range(n_y)]
    modelled = isinstance(problem.plant, ProcessModel | ModalModel)
    spread = covariance * np.outer(wide, wide)
    poles = poles_of(problem.plant, problem.names, theta, spread) if modelled else ()
    fit = fit_of(y[:samples], residual[:samples])
    std = np.sqrt(np.sum(residual[:samples] ** 2, axis=0) * n_y / freedom)
    error = np.where(fit > GOOD, NOISE * std, 0.0)
    noise = np.minimum(error, NOISE * unforeseen(residual[:samples]))
    return Identified(
        plant=problem.plant_at(theta),
        parameters=estimates((*problem.names, *biases), theta, half),
        covariance=covariance,
        poles=poles,
        samples=samples,
        simulated=y - residual,
        fit=fit,
        validation_fit=fit_of(y[samples:], residual[samples:], noise, error),
        residual_std=std,
        whiteness=whiteness,
        white=bool(np.all(whiteness >= WHITE)),
        converged=found.converged,
        from_rest=problem.from_rest,
    )


def inverse_of_normal(J):
    """(J^T J)^-1 from the singular values of J, whose columns are scaled to length 1.

    A parameter that takes part in a direction without effect on the output gets inf on the diagonal
    and 0 in the rest of its row and column.
    """
    scaled, length = unit_columns(J)
    _, s, directions = np.linalg.svd(np.linalg.qr(scaled, mode="r"))
    dead = s < 1e-10 * s[0]
    undetermined = np.any(np.abs(directions[dead]) > 1e-3, axis=0)
    kept = directions[~dead] / s[~dead, None]
    inverse = kept.T @ kept / np.outer(length, length)
    inverse[undetermined] = inverse[:, undetermined] = 0.0
    inverse[undetermined, undetermined] = np.inf
    return inverse


def widened(covariance, J, residual):
    """The covariance of least squares where the residual is not white, nowhere less than it was.

        (J^T J)^-1 (sum_f S(f) J(f)^* J(f)^T) (J^T J)^-1

    S is the spectrum of an autoregression of the residual, of the order of least BIC, 0 for white
    noise: slow parts of the sensitivity meet slow noise, of which a record has few independent
    values. A short record shows it too fast, by (1 + 3 a) / n of one number a (Kendall 1954), which
    is added to the first.

    covariance: (P, P) for white noise;  J: (n, n_y, P);  residual: (n, n_y)
    """
    n, _, P = J.shape
    inverse = inverse_of_normal(J.reshape(-1, P))
    known = np.isfinite(np.diag(inverse))
    inverse = np.where(np.outer(known, known), inverse, 0.0)
    middle, power = np.zeros((P, P)), 0.0
    for i in range(residual.shape[1]):
        _, r = autoregression(residual[:, i])
        if not r[0] > 0:  # an output without a residual
            continue
        a = of_least_bic(r, n)
        left = max(r[0] - a @ r[1 : len(a) + 1], 0.0)
        if len(a):
            a[0] += max(min((n * np.sum(a) + 1) / (n - 3), 1 - 1 / n) - np.sum(a), 0.0)
        lines = np.fft.rfftfreq(n)
        whitening = 1 - np.exp(-2j * np.pi * np.outer(lines, np.arange(1, len(a) + 1))) @ a
        S = left / np.abs(whitening) ** 2
        J_f = np.fft.rfft(J[:, i], axis=0)
        twice = np.where((lines == 0) | (lines == 0.5), 1.0, 2.0) / n
        middle += np.real((J_f.conj().T * (twice * S)) @ J_f)
        power += r[0] / residual.shape[1]
    if not power > 0:
        return covariance
    coloured = np.diag(inverse @ middle @ inverse)
    plain = power * np.diag(inverse)
    factor = np.sqrt(np.maximum(np.where(known, coloured, 1.0) / np.where(known, plain, 1.0), 1.0))
    return covariance * np.outer(factor, factor)


def of_least_bic(r, n) -> np.ndarray:
    """The autoregression of (n,) samples with covariances r, of the order of least BIC."""
    fits = [scipy.linalg.solve_toeplitz(r[:m], r[1 : m + 1]) for m in range(1, len(r))]
    fits = [np.zeros(0), *fits]
    left = np.maximum([r[0] - a @ r[1 : len(a) + 1] for a in fits], 1e-15 * r[0])
    return fits[int(np.argmin(n * np.log(left) + np.log(n) * np.arange(len(fits))))]


def autoregression(residual) -> tuple[np.ndarray, np.ndarray]:
    """The numbers a_j that predict a residual from its past, and its covariances r_i.

        r_i = sum_j a_j r_|i-j|,    i = 1 .. LAGS below n / 4    (Yule and Walker)

    residual: (n,), of any mean
    """
    e = residual - np.mean(residual)
    lags = min(LAGS, len(e) // 4)
    r = np.array([e[lag:] @ e[: len(e) - lag] for lag in range(lags + 1)]) / len(e)
    if not r[0] > 0:
        return np.zeros(lags), r
    r[0] *= 1 + 1e-9  # of a residual that an autoregression predicts without an error
    return scipy.linalg.solve_toeplitz(r[:-1], r[1:]), r


def unforeseen(residual):
    """(n_y,) rms of what an autoregression does not predict of residuals (n, n_y).

    It is the noise: of a white residual all, of what a model errs in a motion next to nothing.
    """
    fits = [autoregression(one) for one in residual.T]
    return np.sqrt([max(r[0] - a @ r[1:], 0.0) for a, r in fits])


def fit_of(y, residual, noise=0.0, error=0.0):
    """(n_y,) fit of each output, 100 (1 - |residual| / |y - mean y|) [%]; nan where it rests.

    noise: rms about its mean up to which an output rests, and the residual does not wander
    error: rms of the residual up to which the model rests where the output does
    """
    if len(y) < 2:
        return np.full(y.shape[1], np.nan)
    root, left = np.sqrt(len(y)), np.linalg.norm(residual, axis=0)
    about, wanders = (np.linalg.norm(x - np.mean(x, axis=0), axis=0) for x in (y, residual))
    moves = (np.maximum(about, wanders) > noise * root) | (left > error * root)
    return 100 * (1 - left / np.where(moves & (np.ptp(y, axis=0) > 0), about, np.nan))


def explained_up_to(y, residual, dt: float) -> float:
    """The frequency up to which a fit explains an output [Hz], inf if it does everywhere.

    From there on half of the output or more is left, by spectra of all of a record: it moves too
    little there for what it says of the plant. They are those of differences, which end as they
    begin where the motion rests, so that slow parts do not hide the fast ones.

    y, residual: (n,) the output and what is left of it
    """
    lines = np.arange(1, len(y) // 2)
    low, high = (lines / NEAR).astype(int), np.ceil(NEAR * lines).astype(int) + 1

    def power(signal):
        size = np.abs(np.fft.rfft(np.diff(signal) * np.hanning(len(signal) - 1)))
        total = np.cumsum(np.append(0.0, size**2))
        return total[np.minimum(high, len(size))] - total[low]

    left = lines[power(residual) > LEFT**2 * power(y)]
    return float(left[0] / ((len(y) - 1) * dt)) if len(left) else np.inf


def whiteness_of(residual) -> np.ndarray:
    """(n_y,) share of autocorrelations of (n, n_y) within the 95 % bounds of white noise."""
    found = [correlations(one - np.mean(one)) for one in residual.T]
    return np.array([np.mean(np.abs(r) <= WIDE / np.sqrt(len(residual))) for r in found])


def correlations(e) -> np.ndarray:
    """(lags,) the correlations of a signal (n,) with itself, at the lags 1 .. LAGS below n / 4."""
    power = max(float(np.real(np.vdot(e, e))), np.finfo(float).tiny)
    lags = range(1, min(LAGS, len(e) // 4) + 1)
    return np.array([np.vdot(e[:-lag], e[lag:]) for lag in lags]) / power


def estimates(names, values, half) -> dict[str, Estimate]:
    """Values with their intervals by name, from the half widths."""
    named = zip(names, values, half, strict=True)
    return {name: Estimate(float(v), float(v - h), float(v + h)) for name, v, h in named}


def poles_of(plant: Plant, names, theta, covariance) -> tuple[PoleEstimate, ...]:
    """The poles, with quantiles over draws from the normal distribution of their parameters."""
    which = [
        i for i, name in enumerate(names) if name.startswith(("poles", "frequencies", "dampings"))
    ]
    names, covariance = tuple(names[i] for i in which), covariance[np.ix_(which, which)]
    known = bool(np.all(np.isfinite(covariance)))
    draws = np.zeros((DRAWS, len(which)))
    if known:
        std = np.sqrt(np.diag(covariance))
        unit = np.where(std > 0, std, 1.0)  # an exact fit has no spread
        size, directions = np.linalg.eigh(covariance / np.outer(unit, unit))
        root = directions * np.sqrt(np.maximum(size, 0.0))
        draws = np.random.default_rng(0).normal(size=draws.shape) @ root.T * std
    poles = np.asarray(
        poles_at(theta[which] + np.vstack([np.zeros(len(which)), draws]), names, plant)
    )

    def of_part(part):
        tails = np.quantile(part[1:], (0.5 - CONFIDENCE / 2, 0.5 + CONFIDENCE / 2), axis=0).T
        return [
            Estimate(v, *(tail if known else (-np.inf, np.inf)))
            for v, tail in zip(part[0].tolist(), tails.tolist(), strict=True)
        ]

    return tuple(
        PoleEstimate(*row)
        for row in zip(poles[0].tolist(), of_part(poles.real), of_part(poles.imag), strict=True)
    )
