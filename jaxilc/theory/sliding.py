"""Conditions of Xu 2024 on sliding mode control: does learning over it contract, and does it slide.

    rho = 1 - (K_P + s K_D) exp(lam0 t) / (s (s + lam1 + lam2 / s)),    e_{j+1} = rho e_j + ...

The paper takes |rho| to be below 1. Here rho is evaluated, and beside it the factor that the
sampled loop really has. Whether sigma slides along a simulated or a measured trial is told by

    sigma' = f - eta_hat s(sigma) - k_n sigma,    V = sigma^2 / 2

s is sgn, or sat(sigma / Delta) with a boundary layer. The paper takes the disturbance f to be
bounded. Here f is computed from the trial.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..learning.machine import Machine
from ..learning.over_trials import check
from ..plants import StateSpace
from ..pytree.aliases import Leaf, Value
from ..pytree.fields import pytree
from ..pytree.named_paths import named_leaves, replaced
from ..schemes import ASMC, SMC, ExponentialPD, Filtered, Scheme, WithFeedback
from ..schemes.compose import signals_of_part
from ..signals.task import Task, Trial
from ..uncertainty import drawn_machines
from .condition import Condition, Premise, condition, premise
from .frequency import learning_condition
from .outlook import WHOLE, decays

SAMPLED = "the loop as it is sampled agrees"
PRINTED = (
    "sup |1 - (K_P + s K_D) exp(lam0 t) / ((s + K) (s + lam1 + lam2 / s))| < 1: the error falls in "
    "every trial (Xu 2024, eq. 36)"
)
SLIDING = (
    "|f| < eta_hat + k_n Delta: V falls outside the boundary layer, so that sigma reaches it and "
    "stays (Xu 2024, eq. 9 and 17, without the k_n Delta by which the reaching law helps at the "
    "edge of the layer; Delta = 0 for sgn, sampled: a band in proportion to dt)"
)
RISE = 1e-9  # a relative rise of V that rounding explains


class ExponentialTest(NamedTuple):
    """A condition over frequency and over the time within the trial.

    As |1 - g x| is convex in the gain g = exp(lam0 t), it is greatest at one of the trial's ends,
    so only these are looked at.

    condition:   with its premises
    frequencies: (F,) [Hz]
    curves:      (2, F) at the trial's start and at its end
    worst:       frequency of the supremum [Hz]
    time:        time within the trial of the supremum [s]
    """

    condition: Condition
    frequencies: np.ndarray
    curves: np.ndarray
    worst: float
    time: float


def printed_condition(
    scheme: WithFeedback, task: Task, *, reaching: float = 0.0, frequencies=None
) -> ExponentialTest:
    """|rho| < 1 of Xu 2024, eq. 36, in continuous time.

    scheme:   `WithFeedback(ExponentialPD(...), SMC(...) or ASMC(...))`
    reaching: K [1/s], 0 as printed. The proof counts k_n sigma + eta_hat sat(sigma) as part of the
              disturbance and takes it to be unchanged from trial to trial. But sigma changes, so
              the premise is broken unless both gains are zero. K = k_n + eta / Delta puts them
              where they belong, into the loop, as long as sigma stays within the boundary layer
    frequencies: (F,) [Hz]; None for 2000 from 1 / duration to Nyquist

    With w = 2 pi f, G = exp(lam0 t) and K = 0, |rho| < 1 means

        G (K_P^2 + w^2 K_D^2) < 2 (K_P lam2 + w^2 (K_D lam1 - K_P))

    so that with lam2 = 0.3 slow frequencies admit hardly any K_P.

    Raises ValueError for another scheme, several channels, or frequencies that are not positive.
    """
    name, f = "printed_condition", np.geomspace(1 / task.duration, 0.5 / task.dt, 2000)
    law, feedback = _learning(name, scheme), sliding_mode_of(name, scheme)
    K_P, K_D, lam0, b_law = (_number(name, v) for v in (law.K_P, law.K_D, law.lam0, law.b))
    of_feedback = feedback.b, feedback.lam1, feedback.lam2, feedback.k_n
    b, lam1, lam2, k_n = (_number(name, v) for v in of_feedback)
    f = f if frequencies is None else np.asarray(frequencies, float)
    if f.ndim != 1 or not f.size or np.any(f <= 0):
        raise ValueError(f"printed_condition: frequencies = {f} must be positive numbers [Hz]")
    s = 2j * np.pi * f
    gain = (K_P + s * K_D) * (b / b_law) / ((s + reaching) * (s + lam1 + lam2 / s))
    curves = np.abs(1 - np.exp(lam0 * task.duration * np.arange(2))[:, None] * gain)
    in_loop = k_n + np.max(feedback.eta / feedback.Delta) if isinstance(feedback, ASMC) else k_n
    adapting = isinstance(feedback, ASMC) and np.any(np.asarray(feedback.phi) > 0)
    switching = not isinstance(feedback, ASMC) and np.any(np.asarray(feedback.eta) > 0)
    unchanged = not adapting and not switching and np.isclose(in_loop, reaching)
    detail = (
        f"sigma changes, and with it {in_loop:.4g} sigma, of which {reaching:.4g} sigma is in the "
        f"loop; eta_hat adapts: {adapting}"
    )
    premises = (
        premise("w_{j+1} = w_j: the same disturbance in each trial", unchanged, detail),
        premise("learning without a lead, as printed", law.lead == 0, f"lead = {law.lead}"),
        _sampled_too(scheme, feedback, task, np.max(curves)),
    )
    end, at = np.unravel_index(np.argmax(curves), curves.shape)
    held = condition(curves[end, at], PRINTED, premises=premises)
    return ExponentialTest(held, f, curves, float(f[at]), float(end * task.duration))


def _sampled_too(scheme: WithFeedback, feedback: SMC, task: Task, value: float) -> Premise:
    """The premise that the loop as it is sampled confirms the inequality in continuous time.

    It is looked at on the nominal model.
    """
    if value >= 1:
        return premise(SAMPLED, True, "not asked, as the inequality fails")
    a1, a2, b = (_number("printed_condition", v) for v in (feedback.a1, feedback.a2, feedback.b))
    model = Machine(StateSpace([[0.0, 1.0], [-a1, -a2]], [[0.0], [b]], [[1.0, 0.0]]))
    found = sampled_condition(model, scheme, task).condition
    said = f"sup |1 - L P| = {found.value:.4g} of the model, {found.verdict}"
    return premise(SAMPLED, found.holds, said)


@pytree
class Reaching(SMC):
    """`SMC` that only reaches and never switches.

    This linear law is what is left of sliding mode control within a boundary layer.
    """

    def switching(self, sigma) -> jax.Array:
        return jnp.zeros_like(sigma)


def within_layer(scheme: Scheme, eta_hat=None) -> Scheme:
    """The scheme with its `ASMC` as it acts within the boundary layer.

    It becomes the linear `Reaching` with k_n + eta_hat / Delta in place of k_n. An `SMC` loses its
    switching.

    eta_hat: () or (n,) value at which the adaptation is frozen; None for its start value

    Raises ValueError for a scheme that is neither of them, nor `WithFeedback` over one.
    """
    if isinstance(scheme, WithFeedback):
        return dataclasses.replace(scheme, feedback=within_layer(scheme.feedback, eta_hat))
    feedback = sliding_mode_of("within_layer", scheme)
    own = {field.name: getattr(feedback, field.name) for field in dataclasses.fields(SMC)}
    steep = 0.0
    if isinstance(feedback, ASMC):
        steep = (feedback.eta if eta_hat is None else eta_hat) / feedback.Delta
    changed: dict[str, Leaf] = own | {"eta": 0.0, "k_n": feedback.k_n + steep}
    return Reaching(**changed)


def sampled_condition(
    machine: Machine,
    scheme: WithFeedback,
    task: Task,
    *,
    trial: Trial | None = None,
    frequencies=None,
) -> ExponentialTest:
    """sup |Q (1 - L P)| < 1 of the loop as it is sampled and acts within the boundary layer.

    It is looked at for the least and the largest gain of the trial. These curves are of a gain that
    is frozen in time. That the gain grows along the trial is looked at as well: the whole trial
    must converge.

    trial:       on which to look whether sigma stays within the layer, and whose last eta_hat
                 counts; None for the start value of eta_hat
    frequencies: as for `learning_condition`

    Raises ValueError for another scheme, or where machine, scheme and task do not fit.
    """
    name = "sampled_condition"
    law, feedback = _learning(name, scheme, filtered=True), sliding_mode_of(name, scheme)
    check(machine, scheme, task)
    eta_hat, premises = None, ()
    if trial is not None:
        run = sliding(scheme, trial)
        eta_hat, layer = run.eta_hat[-1], np.asarray(getattr(feedback, "Delta", 0.0))
        size = np.sqrt(2 * run.V)
        said = f"|sigma| up to {np.max(size):.4g}, layer {layer}"
        at_rest = f"{np.min(run.eta_hat):.4g} to {np.max(eta_hat):.4g}"
        premises = (
            premise("sigma within the boundary layer", size <= layer, said),
            premise("eta_hat at rest", run.eta_hat == eta_hat, at_rest),
        )
    linear: Value = within_layer(scheme, eta_hat)
    leaves = named_leaves(linear.learning)
    path = next(name for name in leaves if name.split(".")[-1] == "lam0").removesuffix("lam0")
    tests, found = [], {}
    for t in (0.0, task.duration):
        gain = np.exp(np.asarray(law.lam0) * t)
        changes = {
            f"{path}K_P": law.K_P * gain,
            f"{path}K_D": law.K_D * gain,
            f"{path}lam0": 0.0 * gain,
        }
        frozen = dataclasses.replace(linear, learning=replaced(linear.learning, changes))
        tests.append(learning_condition(machine, frozen, task, frequencies=frequencies))
        found |= {
            p.name: p for p in tests[-1].condition.premises if p.name not in found or not p.held
        }
    decay = decays(drawn_machines(machine, {}, {}), linear, task)
    fails = max(test.condition.value for test in tests) >= 1
    growing = decay.of_whole(fails)._replace(name=f"{WHOLE}, with a gain that grows along it")
    first, last = tests
    worse = last if last.condition.value > first.condition.value else first
    premises = *found.values(), growing, *premises
    held = condition(worse.condition.value, worse.condition.theorem, premises=premises)
    curves, time = np.stack([first.magnitude, last.magnitude]), task.duration * (worse is last)
    return ExponentialTest(held, first.frequencies, curves, worse.worst, time)


def _learning(name: str, scheme: Scheme, *, filtered: bool = False) -> ExponentialPD:
    parts = [scheme]
    if isinstance(scheme, WithFeedback):
        parts.append(scheme.learning)
        while filtered and isinstance(parts[-1], Filtered):
            parts.append(parts[-1].scheme)
    law = parts[-1]
    if not isinstance(law, ExponentialPD):
        what = " -> ".join(type(part).__name__ for part in parts)
        allowed = f"WithFeedback(ExponentialPD(...), SMC(...)){', filtered or not' * filtered}"
        raise ValueError(f"{name}: {what} is not {allowed}")
    return law


def _number(name: str, value) -> float:
    if np.size(value) != 1:
        raise ValueError(f"{name}: a weight has shape {np.shape(value)}; allowed is one number")
    return float(np.reshape(value, ()))


# Along a run
# --------------------------------------------------------------------------------------------------


class Sliding(NamedTuple):
    """How a trial slid.

    V:           (N, n) sigma^2 / 2 [y^2/s^2]
    eta_hat:     (N, n) switching gain [y/s^2]
    disturbance: (N-1, n) realised f[k], k = 1..N-1 [y/s^2]: all that the law did not foresee, such
                 as mismatch, loads, the half sample by which u acts late, limits, and b times a
                 learned part of u
    band:        (n,) Delta, or the overshoot (eta_hat + 2 |f|) (dt + tau) of an input that is held,
                 if that is wider [y/s]
    error_band:  (n,) largest |e| that a sigma within the band can bring about [y]
    towards:     share of samples, of those outside the layer, with sigma[k] (sigma[k+1] - sigma[k])
                 <= 0
    falling:     the same with V[k+1] <= V[k]
    dominated:   share of all samples with eta_hat > |f|
    reached:     first sample from which on sigma stays in the band; N if it does not
    condition:   |f| / (eta_hat + k_n Delta) < 1 at every sample
    """

    V: np.ndarray
    eta_hat: np.ndarray
    disturbance: np.ndarray
    band: np.ndarray
    error_band: np.ndarray
    towards: float
    falling: float
    dominated: float
    reached: int
    condition: Condition


def sliding(scheme: Scheme, trial: Trial) -> Sliding:
    """The sliding condition along a trial of `SMC` or `ASMC`, alone or within `WithFeedback`.

        f[k] = e'' + lam1 e' + lam2 e + mean_{i=k-1,k} (eta_hat[i] s(sigma[i]) + k_n sigma[i])

    with central differences of e = y - r. The mean is over the two intervals that the second
    difference spans.

    trial: simulated, or measured with the signals `sigma` and `eta_hat` (of WithFeedback:
           `feedback`, `feedback.sigma`, `feedback.eta_hat`)

    Raises ValueError for another scheme, or a trial without these signals or of one sample.
    """
    law, signals, u, dt = sliding_mode_of("sliding", scheme), trial.signals, trial.u, trial.dt
    if isinstance(scheme, WithFeedback):
        u, signals = signals.get("feedback", u), signals_of_part("feedback", signals)
    missing = [name for name in ("sigma", "eta_hat") if name not in signals]
    if missing:
        raise ValueError(
            f"sliding: the trial has no signal {' and '.join(map(repr, missing))} (N, n_u)"
        )
    if len(trial.u) < 2:
        raise ValueError("sliding: the trial has N = 1 sample; allowed are 2 or more")
    read = signals["sigma"], signals["eta_hat"], -trial.e
    sigma, eta_hat, e = (np.asarray(x, float) for x in read)
    layer = np.broadcast_to(getattr(law, "Delta", 0.0), sigma.shape[1:])
    acted = eta_hat * np.asarray(law.switching(sigma)) + law.k_n * sigma
    f = (
        np.diff(e, 2, axis=0) / dt**2
        + law.lam1 * (e[2:] - e[:-2]) / (2 * dt)
        + law.lam2 * e[1:-1]
        + (acted[1:] + acted[:-1]) / 2
    )
    size, gain, reserve = np.abs(f), eta_hat[1:], law.k_n * layer
    none, all_ = np.where(size > 0, np.inf, 0.0), gain + reserve
    value = np.max(np.divide(size, all_, out=none, where=all_ > 0))
    band = np.maximum(layer, np.max(gain + 2 * size, axis=0) * (dt + law.tau))
    now, V, step = sigma[:-1], sigma**2 / 2, np.diff(sigma, axis=0)
    outside, beyond = np.abs(now) > layer, np.flatnonzero(np.any(np.abs(sigma) > band, axis=1))
    of_layer = np.max(eta_hat, axis=0) / layer if isinstance(law, ASMC) else 0.0
    steepest = law.lam1 + law.k_n + of_layer
    within = True if law.limit is None else np.abs(np.asarray(u)) < law.limit
    found = (
        f"|f| up to {np.max(size):.4g}, eta_hat {np.min(eta_hat):.4g} to {np.max(eta_hat):.4g}, "
        f"k_n Delta up to {np.max(reserve):.4g}"
    )
    error_band, inside = band * _error_of_sigma(law), np.abs(sigma) <= band
    left = inside[:-1] & ~inside[1:]
    risen = ~inside[:-1] & (V[1:] > V[:-1] * (1 + RISE))
    of_error = (
        f"within it |e| may be up to {np.max(error_band):.4g}, and was up to "
        f"{np.max(np.abs(e)):.4g}"
    )
    premises = (
        premise("u within its limit", within, f"limit {law.limit}; {found}"),
        premise(
            "sampled fast enough: (lam1 + k_n + eta_hat / Delta) dt < 2",
            steepest * dt < 2,
            f"{np.max(steepest) * dt:.3g}",
        ),
        premise(
            "sigma, once in its band, is seen to stay",
            ~left | (value >= 1),
            f"it leaves it {int(np.sum(left))} times; {of_error}",
        ),
        premise(
            "sigma, beyond its band, is seen to fall",
            ~risen | (value >= 1),
            f"it rises {int(np.sum(risen))} times, as it can where the trial starts off its path",
        ),
    )
    return Sliding(
        V=V,
        eta_hat=eta_hat,
        disturbance=f,
        band=band,
        error_band=error_band,
        towards=_share(now * step <= 0, outside),
        falling=_share(V[1:] <= V[:-1], outside),
        dominated=float(np.mean(gain > size)),
        reached=int(beyond[-1]) + 1 if beyond.size else 0,
        condition=condition(value, SLIDING, premises=premises),
    )


def sliding_mode_of(name: str, scheme: Scheme) -> SMC:
    feedback = scheme.feedback if isinstance(scheme, WithFeedback) else scheme
    if not isinstance(feedback, SMC):
        raise ValueError(
            f"{name}: {type(feedback).__name__} is no sliding mode control; allowed are SMC and "
            "ASMC, also within WithFeedback"
        )
    return feedback


def _error_of_sigma(law: SMC):
    """(n,) sup |e| / sup |sigma| of sigma = e' + lam1 e + lam2 int e.

    It is the area under |the impulse response|; 1 / lam1 for lam2 = 0. The step response (exp(-slow
    t) - exp(-fast t)) / (fast - slow) has one hump if the roots are real. If they are complex it
    has many, and each is smaller than the one before by the same factor. The area is its total
    variation, twice the sum of the humps.
    """
    lam1, lam2 = np.broadcast_arrays(np.asarray(law.lam1, float), np.asarray(law.lam2, float))
    # moved off the double root, where the quotients below are 0 / 0
    root = np.sqrt(lam1**2 * (1 + 1e-12) - 4 * lam2 + 0j)
    fast, slow = (lam1 + root) / 2, np.where(lam2 > 0, (lam1 - root) / 2, 1.0)
    top = np.real(np.log(fast / slow) / (fast - slow))
    hump = np.abs((np.exp(-slow * top) - np.exp(-fast * top)) / (fast - slow))
    following = np.exp(-np.pi * lam1 / np.maximum(np.abs(root.imag), 1e-3 * lam1))
    return np.where(lam2 > 0, 2 * hump / (1 - following), 1 / lam1)


def _share(holds, among) -> float:
    """The share of the samples in question for which it holds; 1 if there are none."""
    return float(np.mean(holds[among])) if np.any(among) else 1.0
