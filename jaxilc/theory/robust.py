"""Learning on every plant P (1 + W D) with a stable D of |D| <= 1.

Frequency by frequency, |Q (keep - L P)| + |Q L P W| < 1 is enough: far from the ends of a long
trial, and everywhere for a causal law. With a lead or a zero-phase filter the ends need a proof of
their own. On a trial of N samples M = X + Y D with

    X = Q (keep - L G),   Y = -Q L G W,   D lower triangular and Toeplitz, |D v| <= |v| for each v

where W is the causal operator of minimum phase. D commutes with each causal Psi, so that |Psi D v|
<= |Psi v|. If a matrix R fulfils

    R >= Psi'Psi + X'R X + X'R Y (Psi'Psi - Y'R Y)^-1 Y'R X,    Psi'Psi > Y'R Y

then |M v|_R <= |v|_R for all those D at once (S-procedure). If the inequality is strict, learning
converges on each plant. |Psi|^2 is taken as the share |Y| / (|X| + |Y|) of each frequency, and R is
found by iterating the right-hand side from the identity.
"""

from __future__ import annotations

import numpy as np
import scipy

from ..learning.machine import Machine
from ..schemes import Scheme
from ..signals.task import Task
from ..uncertainty import drawn_machines
from .affine import limit_names
from .condition import Premise, premise
from .enclosure import size
from .law import learning_law
from .law_and_loop import parts_of
from .lifted import lifted_plant
from .outlook import WHOLE
from .over_frequency import FrequencyTest, on_supremum, weight_on
from .trials import shortened

ROBUST = (
    "sup |Q| (|keep - L P| + |L P W|) < 1, for every plant P (1 + W D) with a stable |D| <= 1: far "
    "from the ends of a long trial each "
    "frequency comes nearer to its limit by this factor or more in every trial (Bristow 2006); the "
    "whole trial as its premise says"
)
NO_LIMIT = "machine and scheme have no limit"
DENSE = 256  # samples of the trial at which the ends are looked at
POINTS = 2048  # frequencies of a spectral factor
FADED = 1e-6  # share of a response that counts as forgotten
SLACK = 1e-3  # by which R is made larger in each iteration
ITERATIONS = 200


def robust_condition(
    machine: Machine, scheme: Scheme, task: Task, weight, *, frequencies=None
) -> FrequencyTest:
    """sup_w |Q| (|keep - L P| + |L P W|) < 1, for all plants P (1 + W D) with |D| <= 1.

    weight:      |W|, a number or a function of f [Hz], taken as constant from line to line of the
                 grid
    frequencies: as for `learning_condition`

    Raises ValueError where machine, scheme and task do not fit, or for a weight that is negative.
    """
    parts = parts_of(machine, scheme, task)
    lines = weight_on(weight, np.linspace(0, np.pi, POINTS + 1), 0.0, task.dt)
    if not np.all(lines >= 0):
        raise ValueError(
            f"robust_condition: weight is {np.min(lines):g} at some frequency; allowed is [0, inf)"
        )

    def bounds(centre, h):
        nominal, gain = parts.nominal(centre, h), parts.gain(centre, h)
        W = weight_on(weight, centre, h, task.dt)
        at_ends = np.max(nominal.ends(h) + W * gain.ends(h), axis=0)
        return size(nominal.value) + W * size(gain.value), at_ends + h**2 * (
            nominal.curve + W * gain.curve
        )

    limits = limit_names(drawn_machines(machine, {}, {}), scheme, task)
    unlimited = premise(
        NO_LIMIT,
        not limits,
        f"{', '.join(limits)}: whether one is met depends on the plant" if limits else "none",
    )

    def of_whole():
        return [
            premise(WHOLE, True, "law and loop are causal")
            if parts.causal
            else _whole_trial(machine, scheme, task, parts, lines)
        ]

    return on_supremum(
        bounds, ROBUST, [parts.loop], task, [*parts.premises, unlimited], of_whole, frequencies
    )


def _whole_trial(machine: Machine, scheme: Scheme, task: Task, parts, lines) -> Premise:
    """The premise, by the matrix R, that learning converges on every plant over a whole trial."""
    short = shortened(task, min(task.N, DENSE))
    try:
        scheme.check(short)
    except ValueError as error:
        return premise(WHOLE, False, f"looked at in {short.N} samples, where {error}")
    memory = _memory(parts)
    if short.N < task.N and memory > short.N // 2:
        return premise(
            WHOLE,
            False,
            f"looked at in {short.N} samples, but loop and law take {memory} to forget",
        )
    machine, scheme = machine.unlimited(), scheme.unlimited()
    G, law = lifted_plant(machine, scheme, short), learning_law(scheme, short)
    width = G.shape[1] // short.N
    W = _causal(lines, short.N, width)
    X, Y = law.keep - law.L @ G, law.L @ G @ W
    steps = _iterated(X, Y, _causal(np.sqrt(_shares(parts, lines)), short.N, width))
    found = (
        f"a norm that falls on every plant was {'found' if steps else 'not found'} for a trial of "
        f"{short.N} samples"
    )
    return premise(WHOLE, steps > 0, found)


def _memory(parts) -> int:
    """The number of samples in which the responses of loop and law fade."""
    radius = np.max(np.abs(np.linalg.eigvals(parts.loop.A)), initial=0.0)
    of_loop = int(np.ceil(np.log(FADED) / np.log(np.clip(radius, 1e-6, 1 - 1e-12))))
    reach = [of_loop]
    for taps in (parts.law.keep, parts.law.L):
        counts = size(taps.taps) > FADED * np.max(size(taps.taps), initial=0.0)
        reach.append(int(np.max(np.abs(taps.powers[counts]), initial=0)))
    return max(reach)


def _shares(parts, lines):
    """(POINTS+1,) |Y| / (|X| + |Y|) of each frequency, kept away from 0 and 1."""
    angle = np.linspace(0, np.pi, POINTS + 1)
    nominal, gain = (
        size(arc.value)
        for arc in (
            parts.nominal(angle, np.zeros_like(angle)),
            parts.gain(angle, np.zeros_like(angle)),
        )
    )
    total = nominal + lines * gain
    return np.clip(lines * gain / np.maximum(total, 1e-300), SLACK, 1 - SLACK) * np.max(total) ** 2


def _causal(magnitude, N: int, width: int):
    """(N width, N width) the lower triangular operator of minimum phase with a given magnitude.

    The magnitude (POINTS+1,) is given at equidistant angles.
    """
    cepstrum = np.fft.irfft(np.log(np.maximum(magnitude, 1e-9 * np.max(magnitude, initial=1e-200))))
    folded = np.concatenate(
        [cepstrum[:1], 2 * cepstrum[1:POINTS], cepstrum[POINTS : POINTS + 1], np.zeros(POINTS - 1)]
    )
    taps = np.fft.irfft(np.exp(np.fft.rfft(folded)))[:N]
    return np.kron(scipy.linalg.toeplitz(taps, np.zeros(N)), np.eye(width))


def _iterated(X, Y, Psi) -> int:
    """The number of iterations after which R fulfils its inequality; 0 if it is not seen to."""
    share, R = Psi.T @ Psi, np.eye(len(X))
    for i in range(ITERATIONS):
        RX, RY = R @ X, R @ Y
        try:
            factor = scipy.linalg.cho_factor(share - Y.T @ RY)
        except scipy.linalg.LinAlgError:
            return 0
        wanted = share + X.T @ RX + RX.T @ Y @ scipy.linalg.cho_solve(factor, Y.T @ RX)
        wanted = (wanted + wanted.T) / 2
        if _positive(R - wanted):
            return i + 1
        R = (1 + SLACK) * wanted
    return 0


def _positive(M) -> bool:
    try:
        np.linalg.cholesky(M - 1e-9 * np.max(np.abs(np.diag(M))) * np.eye(len(M)))
    except np.linalg.LinAlgError:
        return False
    return True
