"""Conditions of Xu 2024 on learning over sliding mode control: does learning contract.

    rho = 1 - (K_P + s K_D) exp(lam0 t) / (s (s + lam1 + lam2 / s)),    e_{j+1} = rho e_j + ...

The paper takes |rho| to be below 1. Here rho is evaluated, and beside it the factor that the
sampled loop really has. Whether sigma slides on a run is for `sliding_run`, whose names are
reachable here.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..learning.machine import Machine
from ..learning.over_trials import check
from ..plants import StateSpace
from ..pytree.fields import pytree
from ..pytree.named_paths import named_leaves, replaced
from ..schemes import ASMC, SMC, ExponentialPD, Filtered, Scheme, WithFeedback
from ..signals.task import Task, Trial
from ..uncertainty import drawn_machines
from .by_frequency import learning_condition
from .condition import Condition, Premise, condition, premise
from .outlook import WHOLE, decays
from .sliding_run import Sliding, sliding, sliding_mode_of

__all__ = [
    "ExponentialTest",
    "Reaching",
    "Sliding",
    "printed_condition",
    "sampled_condition",
    "sliding",
    "within_layer",
]

SAMPLED = "the loop as it is sampled agrees"
PRINTED = (
    "sup |1 - (K_P + s K_D) exp(lam0 t) / ((s + K) (s + lam1 + lam2 / s))| < 1: the error falls in "
    "every trial (Xu 2024, eq. 36)"
)


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
    law, feedback = (
        _learning("printed_condition", scheme, task),
        sliding_mode_of("printed_condition", scheme),
    )
    K_P, K_D, lam0, b_law, b, lam1, lam2, k_n = (
        _number("printed_condition", v)
        for v in (
            law.K_P,
            law.K_D,
            law.lam0,
            law.b,
            feedback.b,
            feedback.lam1,
            feedback.lam2,
            feedback.k_n,
        )
    )
    f = (
        np.geomspace(1 / task.duration, 0.5 / task.dt, 2000)
        if frequencies is None
        else np.asarray(frequencies, float)
    )
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
    return _worst(f, curves, task, PRINTED, premises)


def _sampled_too(scheme: WithFeedback, feedback: SMC, task: Task, value: float) -> Premise:
    """The premise that the loop as it is sampled confirms the inequality in continuous time.

    It is looked at on the nominal model.
    """
    if value >= 1:
        return premise(SAMPLED, True, "not asked, as the inequality fails")
    a1, a2, b = (_number("printed_condition", v) for v in (feedback.a1, feedback.a2, feedback.b))
    model = Machine(StateSpace([[0.0, 1.0], [-a1, -a2]], [[0.0], [b]], [[1.0, 0.0]]))
    found = sampled_condition(model, scheme, task).condition
    return premise(
        SAMPLED, found.holds, f"sup |1 - L P| = {found.value:.4g} of the model, {found.verdict}"
    )


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
    steep = (
        0.0
        if not isinstance(feedback, ASMC)
        else (feedback.eta if eta_hat is None else eta_hat) / feedback.Delta
    )
    changed: dict[str, Any] = own | {"eta": 0.0, "k_n": feedback.k_n + steep}
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
    law, feedback = (
        _learning("sampled_condition", scheme, task, filtered=True),
        sliding_mode_of("sampled_condition", scheme),
    )
    check(machine, scheme, task)
    eta_hat, premises = None, ()
    if trial is not None:
        run = sliding(scheme, trial)
        eta_hat, layer = run.eta_hat[-1], np.asarray(getattr(feedback, "Delta", 0.0))
        size = np.sqrt(2 * run.V)
        premises += (
            premise(
                "sigma within the boundary layer",
                size <= layer,
                f"|sigma| up to {np.max(size):.4g}, layer {layer}",
            ),
        )
        premises += (
            premise(
                "eta_hat at rest",
                run.eta_hat == eta_hat,
                f"{np.min(run.eta_hat):.4g} to {np.max(eta_hat):.4g}",
            ),
        )
    linear: Any = within_layer(scheme, eta_hat)
    path = next(
        name for name in named_leaves(linear.learning) if name.split(".")[-1] == "lam0"
    ).removesuffix("lam0")
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
    growing = premise(
        f"{WHOLE}, with a gain that grows along it", fails or decay.trials[0] > 0, decay.told(0)
    )
    first, last = tests
    worse = last if last.condition.value > first.condition.value else first
    held = condition(
        worse.condition.value,
        worse.condition.theorem,
        premises=(*found.values(), growing, *premises),
    )
    curves = np.stack([first.magnitude, last.magnitude])
    return ExponentialTest(
        held, first.frequencies, curves, worse.worst, task.duration if worse is last else 0.0
    )


def _worst(f, curves, task, theorem, premises) -> ExponentialTest:
    end, at = np.unravel_index(np.argmax(curves), curves.shape)
    return ExponentialTest(
        condition(curves[end, at], theorem, premises=premises),
        f,
        curves,
        float(f[at]),
        end * task.duration,
    )


def _learning(name: str, scheme: Scheme, task: Task, *, filtered: bool = False) -> ExponentialPD:
    parts = [scheme]
    if isinstance(scheme, WithFeedback):
        parts.append(scheme.learning)
        while filtered and isinstance(parts[-1], Filtered):
            parts.append(parts[-1].scheme)
    law = parts[-1]
    if not isinstance(law, ExponentialPD):
        what = " -> ".join(type(part).__name__ for part in parts)
        allowed = "WithFeedback(ExponentialPD(...), SMC(...))" + (
            ", filtered or not" if filtered else ""
        )
        raise ValueError(f"{name}: {what} is not {allowed}")
    return law


def _number(name: str, value) -> float:
    if np.size(value) != 1:
        raise ValueError(f"{name}: a weight has shape {np.shape(value)}; allowed is one number")
    return float(np.reshape(value, ()))
