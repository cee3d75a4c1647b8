"""Conditions on the frequency response: what learning does to each frequency of the error, trial after trial.

    |Q (keep - L P)| < 1        P(z) from the feedforward to y, L(z) from e to the next input: z^(1+m) gamma for a P-type law of lead m

P is that of the simulator's own sample-to-sample step, machine and feedback together, linearised at rest and solved as
(z I - A) X = B; so any plant has one, differentiable in every leaf. Frequencies are in Hz throughout.
"""

from __future__ import annotations

import dataclasses
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jax import lax
from jax.flatten_util import ravel_pytree

from ..batch import tiled
from ..filters import Filter, ZeroPhaseButterworth, ZeroPhaseFIR, ZeroPhaseIIR, butterworth_sections
from ..learning import check
from ..machine import Machine
from ..schemes import CFDLMFAILC, ErrorFiltered, Filtered, Ladder, MultivariableILC, OnReference, PIDType, Scheme, StopWhen, WithFeedback
from ..signals import Sample, Task
from ..switching import SwitchableFilter
from ..uncertainty import Uncertainty, draw, drawn_machine
from .condition import Condition, Premise, condition, learner, linear, linear_law, next_input, premise, ratio
from .lifted import input_map, learning_law, lifted_plant, noiseless, played_trial, sigma_max

LEARNING = (
    "sup |Q (keep - L P)| < 1: far from the ends of a long trial each frequency of the error falls by this factor or more in every trial "
    "(Norrlöf, Gunnarsson 2002; Bristow 2006; Li 2020, eq. 9 for Q = keep = 1); with causal L and Q, the 2-norm of any trial does"
)
ROBUST = "sup |Q| (|keep - L P| + |L P W|) < 1: as sup |Q (keep - L P)| < 1, for every plant P (1 + W D) with |D| <= 1 (Bristow 2006)"
NORM_OPTIMAL = (
    "|W_D + W_e G* (G - G_t)| < W_e |G|^2 + W_u + W_D: far from the ends of a long trial, norm-optimal learning with the model G "
    "contracts each frequency on the plant G_t (MILC 2024, eq. 7 and 8, frequency by frequency)"
)
ENDS = 256  # samples of the trial at which the ends are looked at
CHUNK = 256  # frequencies computed at a time


class Loop(NamedTuple):
    """x[k+1] = A x[k] + B w[k], y[k] = C x[k]. A: (n, n), B: (n, n_w), C: (n_y, n)"""

    A: jax.Array
    B: jax.Array
    C: jax.Array


def linear_loop(machine: Machine, scheme: Scheme | None, task: Task) -> Loop:
    """Machine and feedback from an added feedforward w to y, linearised at rest: one sample of the simulator, differentiated.

    scheme: as for `lifted_plant`: feedback, or learning over feedback, which then sees its closed loop; None for the machine alone;
            of `OnReference` w corrects the reference
    Pure: to be vmapped and differentiated. Raises ValueError for OnReference over a feedback that previews more than one sample, and
    for MultivariableILC.
    """
    if isinstance(scheme, MultivariableILC):
        raise ValueError("linear_loop: MultivariableILC learns input and reference; allowed are the conditions of `theory.lifted`")
    machine, dt = noiseless(machine).sampled(task.dt), task.dt
    series = isinstance(scheme, OnReference)
    if series and scheme.preview > 1:
        raise ValueError(f"linear_loop: OnReference with preview = {scheme.preview}; allowed is a feedback of preview 1")
    r, width = jnp.zeros(task.outputs), task.outputs if series else task.inputs
    row: Any = None if scheme is None else jax.tree.map(lambda rows: rows[0], scheme.table(scheme.memory(task), task))
    rest = (machine.plant.init(), None if scheme is None else scheme.init(task), jnp.zeros(task.inputs), jnp.zeros(width))
    flat, unravel = ravel_pytree(rest)

    def output(x):
        return machine.measure(machine.plant.output(unravel(x)[0]), None)

    def tick(x, w):
        plant_state, state, v_last, w_last = unravel(x)
        u = jnp.zeros(task.inputs)
        if scheme is not None:
            seen = row._replace(u=w, now=w_last, ahead=w[None]) if series else row
            state, u = scheme.act(state, Sample(r, jnp.zeros((scheme.preview, task.outputs)), output(x), seen, dt))
        v, u = machine.actuate(u if series else u + w, v_last, dt)
        return ravel_pytree((machine.plant.step(plant_state, u, dt), state, v, w))[0]

    A, B = jax.jacfwd(tick, argnums=(0, 1))(flat, jnp.zeros(width))
    return Loop(A, B, jax.jacfwd(output)(flat))


def response(loop: Loop, frequencies, dt: float) -> jax.Array:
    """(F, n_y, n_w) P(z) = C (z I - A)^-1 B at frequencies (F,) [Hz]."""
    z = _z(frequencies, dt)[:, None, None]
    return loop.C @ jnp.linalg.solve(z * jnp.eye(len(loop.A)) - loop.A, jnp.broadcast_to(loop.B, (len(z), *loop.B.shape)) + 0j)


class LawResponse(NamedTuple):
    """u_{j+1} = Q (keep u_j + L e_j). keep: (F or 1, n_u, n_u);  L: (F, n_u, n_y), its lead included;  Q: (F,)"""

    keep: jax.Array
    L: jax.Array
    Q: jax.Array


def law_response(scheme: Scheme, task: Task, frequencies) -> LawResponse:
    """The learning law at frequencies (F,) [Hz]: PIDType and CFDL-MFAILC (frozen at phi0) in closed form, others by an impulse.

    The impulse lies in the middle of a trial, so a law of its own must forget within half a trial. At f = 0 gamma_i makes L infinite.
    Pure. Raises ValueError for a scheme that learns no feedforward.
    """
    z, channels = _z(frequencies, task.dt)[:, None], jnp.eye(task.inputs)
    match scheme:
        case WithFeedback():
            return law_response(scheme.learning, task, frequencies)
        case OnReference():
            return law_response(scheme.learning, dataclasses.replace(task, inputs=task.outputs), frequencies)
        case Filtered():
            inner = law_response(scheme.scheme, task, frequencies)
            return inner._replace(Q=filter_response(scheme.filter, task, frequencies) * inner.Q)
        case StopWhen():
            return law_response(scheme.scheme, task, frequencies)
        case Ladder():
            inner = law_response(scheme.scheme, task, frequencies)
            return inner if scheme.slow is None else inner._replace(L=scheme.largest * inner.L)
        case ErrorFiltered():
            inner = law_response(scheme.scheme, task, frequencies)
            return inner._replace(L=filter_response(scheme.filter, task, frequencies)[:, None, None] * inner.L)
        case PIDType():
            gain = (scheme.gamma_p * z + scheme.gamma_d * (z - 1)) * z**scheme.lead
            gain = gain + jnp.where(scheme.gamma_i == 0, 0.0, scheme.gamma_i * z**2 / (z - 1))
            return LawResponse((1 - scheme.leak) * channels[None], gain[..., None] * channels, jnp.ones(len(z)))
        case CFDLMFAILC():
            gamma = scheme.rho * scheme.phi0 / (scheme.lam + scheme.phi0**2)
            return LawResponse(channels[None], (gamma * z ** (1 + scheme.lead))[..., None] * channels, jnp.ones(len(z)))
    law = next_input(scheme, task, scheme.memory(task))
    at = (jnp.zeros((task.N, task.inputs)), jnp.zeros((task.N, task.outputs)))

    def column(argument, channel):
        direction = [jnp.zeros_like(a) for a in at]
        direction[argument] = direction[argument].at[task.N // 2, channel].set(1.0)
        return jax.jvp(law, at, tuple(direction))[1]

    def transform(argument):
        impulses = jnp.stack([column(argument, c) for c in range(at[argument].shape[1])], axis=-1)
        return jnp.tensordot(z ** -(jnp.arange(task.N) - task.N // 2 - argument), impulses, axes=1)  # e[k+1] belongs to row k

    return LawResponse(transform(0), transform(1), jnp.ones(len(z)))


def filter_response(q: Filter, task: Task, frequencies) -> jax.Array:
    """(F,) Q, real and of zero phase: taps_0 + 2 sum taps_i cos(i w), or |H|^2 of what runs both ways; others by an impulse in mid-trial.

    Of a switchable filter it is the largest of its segments.
    """
    z = _z(frequencies, task.dt)[:, None]
    match q:
        case ZeroPhaseFIR():
            return jnp.asarray(q.taps)[0] + 2 * jnp.real(z ** jnp.arange(1, len(q.taps))) @ jnp.asarray(q.taps)[1:]
        case ZeroPhaseButterworth():
            b0, b1, b2, a1, a2 = butterworth_sections(q.cutoff, task.dt, q.order).T
            return jnp.prod(jnp.abs((b0 * z**2 + b1 * z + b2) / (z**2 + a1 * z + a2)) ** 2, axis=1)
        case ZeroPhaseIIR():
            powers = z ** -jnp.arange(max(len(q.a), len(q.b)))
            return jnp.abs((powers[:, : len(q.b)] @ q.b) / (powers[:, : len(q.a)] @ q.a)) ** 2
        case SwitchableFilter():
            of_segment = [ZeroPhaseButterworth(cutoff, order=q.order) for cutoff in q.cutoff]
            return jnp.max(jnp.stack([filter_response(one, task, frequencies) for one in of_segment]), axis=0)
    impulse = q(jnp.zeros((task.N, 1)).at[task.N // 2].set(1.0), task.dt)
    return jnp.real(z ** -(jnp.arange(task.N) - task.N // 2) @ impulse[:, 0])


class FrequencyTest(NamedTuple):
    """A condition with the curve behind it.

    condition: on the supremum;  frequencies: (F,) [Hz];  magnitude: (F,) what must stay below 1
    worst: frequency of the supremum [Hz];  critical: first frequency at which the magnitude reaches 1 [Hz], inf if none does
    """

    condition: Condition
    frequencies: np.ndarray
    magnitude: np.ndarray
    worst: float
    critical: float


def learning_condition(machine: Machine, scheme: Scheme, task: Task, *, frequencies=None) -> FrequencyTest:
    """sup_w |Q (keep - L P)| < 1, with the critical frequency; of Li 2020, eq. 9, |1 - phi z G/(1 + C G)| < 1, for P-type over feedback.

    frequencies: (F,) [Hz] ascending, None for `grid`, refined at the peak and at the crossing. Several channels: the largest
    singular value. Raises ValueError where machine, scheme and task do not fit.
    """
    evaluate = _magnitudes(machine, scheme, task)
    return _tested(lambda f: evaluate(f)[0], LEARNING, machine, scheme, task, frequencies)


def robust_condition(machine: Machine, scheme: Scheme, task: Task, weight, *, frequencies=None) -> FrequencyTest:
    """sup_w |Q| (|keep - L P| + |L P W|) < 1, for all plants P (1 + W D), |D| <= 1. weight: |W|, a number or a function of f [Hz]"""
    evaluate = _magnitudes(machine, scheme, task)

    def magnitude(f):
        nominal, filtered_gain = evaluate(f)
        return nominal + filtered_gain * _weight(weight, f)

    return _tested(magnitude, ROBUST, machine, scheme, task, frequencies)


def norm_optimal_condition(
    model: Machine, machine: Machine, scheme: Scheme | None, task: Task, *, w_e, w_u, w_delta, frequencies=None
) -> FrequencyTest:
    """sup_w |W_D + W_e G* (G - G_t)| / (W_e |G|^2 + W_u + W_D) < 1 for norm-optimal learning with the model G of the plant G_t.

    Frequency by frequency J = W_e |e|^2 + W_u |u|^2 + W_D |u - u_j|^2 is least at u_{j+1} = (W_e |G|^2 + W_u + W_D)^-1
    ((W_D + W_e |G|^2) u_j + W_e G* e_j), and e_j = r - G_t u_j. Several channels: the norm of H^-1 (W_D I + W_e G^H (G - G_t)).
    model, machine: G and G_t, both under the feedback of `scheme` (None: none);  w_e, w_u, w_delta: numbers or functions of f [Hz]
    """
    loops = [_compiled_loop(m, scheme, task) for m in (model, machine)]

    def magnitude(f):
        return _in_chunks(lambda part: _norm_optimal(*loops, task.dt, part, *(_weight(w, part) for w in (w_e, w_u, w_delta))), f)

    return _tested(magnitude, NORM_OPTIMAL, machine, scheme, task, frequencies, learns=False)


class FamilyTest(NamedTuple):
    """A condition over a parametric set of plants.

    condition: on the supremum over plants and frequencies;  at: the worst plant's numbers;  worst: its frequency [Hz]
    values, critical: (S,) supremum and critical frequency [Hz] of each plant tried;  drawn: {name: (S,)} their numbers
    """

    condition: Condition
    at: dict[str, float]
    worst: float
    values: np.ndarray
    critical: np.ndarray
    drawn: dict[str, np.ndarray]


def family_condition(
    machine: Machine,
    uncertainty: Uncertainty,
    scheme: Scheme,
    task: Task,
    *,
    samples: int = 128,
    sampling: str = "latin-hypercube",
    seed: int = 0,
    climbers: int = 8,
    steps: int = 60,
    frequencies=None,
) -> FamilyTest:
    """sup |Q (keep - L P)| over the box that the distributions' corners span: by sampling, then by gradient ascent from the worst.

        p <- clip(p + h g / |g|),  g = d/dp max_w |Q (keep - L P(p))|    (h grows by 1.5 after a gain and is halved after a loss)

    The maximum over frequency is exact at each step, so its gradient is that at the worst frequency (Danskin); the ascent only keeps
    what is better, so its result is never below that of the samples.
    samples, sampling, seed: as for `uncertainty.draw`, moved into the box where a normal distribution leaves it
    climbers: how many of the worst samples ascend, 0 for sampling alone;  steps: of each
    The poles are looked at for every plant tried, the other premises at the worst. Raises ValueError as `draw` does.
    """
    check(machine, scheme, task)
    names = tuple(uncertainty.items())
    low, high = (np.array([end(d.corners()) for _, d in names]) for end in (min, max))
    drawn = draw(machine, uncertainty, samples, seed=seed, sampling=sampling)
    points = np.clip(np.stack([drawn[name] for name, _ in names], axis=1), low, high)
    common = (machine, scheme, task, jnp.asarray(_grid_for(machine, scheme, task, frequencies)), jnp.asarray(low), jnp.asarray(high))
    look = _look(names)
    found = [np.asarray(x) for x in look(common, jnp.asarray(points))]
    if climbers:
        start = points[np.argsort(-found[0])[:climbers]]
        climbed = np.asarray(_climbing(names, steps)(common, jnp.asarray(start)))
        points = np.concatenate([points, climbed])
        found = [np.concatenate([a, b]) for a, b in zip(found, look(common, jnp.asarray(climbed)), strict=True)]
    values, critical, *loops = found
    at = {name: float(v) for (name, _), v in zip(names, points[np.argmax(values)], strict=True)}
    test = learning_condition(drawn_machine(machine, uncertainty, at), scheme, task, frequencies=np.asarray(common[3]))
    radii = np.array([pole_radius(Loop(*one)) for one in zip(*loops, strict=True)])
    of_loop, _, _, *of_learning = test.condition.premises
    held = condition(max(test.condition.value, np.max(values)), LEARNING, premises=(of_loop, *_of_poles(radii, task), *of_learning))
    return FamilyTest(held, at, test.worst, values, critical, {name: points[:, i] for i, (name, _) in enumerate(names)})


def grid(task: Task, *, points: int = 1000, near=()) -> np.ndarray:
    """(F,) frequencies [Hz], equidistant in the logarithm from 0.001 / duration to the Nyquist frequency, and denser around poles z."""
    nyquist, near = 0.5 / task.dt, np.asarray(near, complex)
    near = near[np.abs(near) > 1e-3]
    centre, width = np.abs(np.angle(near)), np.abs(np.log(np.abs(near)))
    around = (centre[:, None] + width[:, None] * np.linspace(-3, 3, 31)).ravel() / (2 * np.pi * task.dt)
    lowest = 1e-3 / task.duration
    return np.unique(np.concatenate([np.geomspace(lowest, nyquist, points), around[(around > lowest) & (around < nyquist)]]))


def pole_radius(loop: Loop) -> float:
    """Largest |pole| of P, that is of the part of the loop which w reaches and y shows: an unused integrator of a PID is no pole."""
    A, (scale, _) = scipy.linalg.matrix_balance(loop.A, permute=False, separate=True)
    B, C = np.asarray(loop.B) / scale[:, None], np.asarray(loop.C) * scale
    for _ in range(2):  # the reachable part, then the observable part, as the reachable part of the transposed system
        V = _reachable(A, B)
        A, B, C = (V.T @ A @ V).T, (C @ V).T, (V.T @ B).T
    return float(np.max(np.abs(np.linalg.eigvals(A)), initial=0.0))


# How it is done ------------------------------------------------------------------------------------------------------------


def _z(frequencies, dt):
    return jnp.exp(2j * jnp.pi * dt * jnp.asarray(frequencies))


def _norm(M):
    """(F,) largest singular value of (F, n, m)."""
    return jnp.abs(M[:, 0, 0]) if M.shape[1:] == (1, 1) else jnp.linalg.svd(M, compute_uv=False)[:, 0]


def _weight(weight, f):
    return np.broadcast_to(weight(f) if callable(weight) else weight, f.shape).astype(float)


def _parts(loop, scheme, task, f):
    """(F,) |Q| |keep - L P| and |Q| |L P|."""
    law = law_response(scheme, task, f)
    gain = law.L @ response(loop, f, task.dt)
    return jnp.abs(law.Q) * _norm(law.keep - gain), jnp.abs(law.Q) * _norm(gain)


_compiled_loop = jax.jit(linear_loop)
_compiled_parts = jax.jit(_parts)


@jax.jit
def _norm_optimal(model, loop, dt, f, w_e, w_u, w_delta):
    """(F,) ||H^-1 (W_D I + W_e G^H (G - G_t))||"""
    G, G_t = response(model, f, dt), response(loop, f, dt)
    e, u, delta = (w[:, None, None] for w in (w_e, w_u, w_delta))
    unit, adjoint = jnp.eye(G.shape[-1]), jnp.conj(jnp.swapaxes(G, -1, -2))
    return _norm(jnp.linalg.solve(e * adjoint @ G + (u + delta) * unit, delta * unit + e * adjoint @ (G - G_t)))


def _magnitudes(machine, scheme, task):
    """The function of f (F,) that gives both parts, (2, F)."""
    check(machine, scheme, task)
    loop = _compiled_loop(machine, scheme, task)
    return lambda f: _in_chunks(lambda part: jnp.stack(_compiled_parts(loop, scheme, task, part)), f)


def _in_chunks(function, f):
    """function(f) in chunks of one length, so that it is compiled once, whatever the number of frequencies."""
    padded = np.pad(f, (0, -len(f) % CHUNK), mode="edge").reshape(-1, CHUNK)
    return np.concatenate([np.asarray(function(part)) for part in padded], axis=-1)[..., : len(f)]


def _grid_for(machine, scheme, task, frequencies):
    if frequencies is None:
        return grid(task, near=np.linalg.eigvals(_compiled_loop(machine, scheme, task).A))
    f = np.asarray(frequencies, float)
    if f.ndim != 1 or len(f) < 2 or f[0] <= 0 or f[-1] > 0.5 / task.dt * (1 + 1e-9) or np.any(np.diff(f) <= 0):
        raise ValueError(f"frequencies = {f} must ascend within (0, {0.5 / task.dt:g}] Hz, Nyquist at dt = {task.dt:g} s")
    return f


def _tested(magnitude, theorem, machine, scheme, task, frequencies, learns=True) -> FrequencyTest:
    f = _grid_for(machine, scheme, task, frequencies)
    curve, peak, worst, critical = _extremes(lambda f: np.nan_to_num(magnitude(f), nan=np.inf, posinf=np.inf), f)
    invariant = linear("loop linear and time invariant", _loop_departure(machine, scheme, task), "a trial of random input from rest")
    premises = (invariant, *_of_poles(pole_radius(_compiled_loop(machine, scheme, task)), task))
    if learns:
        premises = (*premises, linear_law(scheme, task), _ends(machine, scheme, task, peak))
    return FrequencyTest(condition(peak, theorem, premises=premises), f, curve, worst, critical)


def _ends(machine, scheme, task, peak) -> Premise:
    """That the ends of the trial learn too. A lead finds no error beyond the end, and a zero-phase filter no signal: with the ends pinned
    (odd extension of a Butterworth) learning may grow there, slowly and without bound, where the frequency response promises the contrary.
    """
    name, (filters, law, *_) = "the ends of the trial learn like its middle", learner(scheme, task)
    parts = jax.tree.leaves(scheme, is_leaf=lambda part: isinstance(part, SwitchableFilter))
    if any(isinstance(part, SwitchableFilter) for part in parts):
        return premise("filter the same throughout the trial", False, "its cutoff switches")
    if not filters and isinstance(law, PIDType | CFDLMFAILC) and law.lead == 0:
        return premise(name, True, "law and filter are causal")
    samples = ENDS if task.N > ENDS and all(_serves(q, ENDS, task.dt) for q in filters) else task.N
    short = dataclasses.replace(task, reference=np.asarray(task.reference)[: samples + 1], settle=None)
    machine, law = dataclasses.replace(machine, disturbance=None), learning_law(scheme, short)
    value = float(sigma_max(input_map(lifted_plant(machine, scheme, short), law.L, Q=law.Q, keep=law.keep)))
    return premise(name, value < 1 or peak >= 1, f"largest singular value {value:.6g} for a trial of {samples} samples")


def _serves(q, samples, dt) -> bool:
    try:
        q.check(samples, dt)
    except ValueError:
        return False
    return True


def _of_poles(radius, task) -> tuple[Premise, Premise]:
    """Stability, and a trial longer than the time in which the slowest mode decays to 1 %."""
    slowest = np.log(0.01) / np.log(np.clip(radius, 1e-9, 1 - 1e-15))
    stable = premise("loop stable", np.asarray(radius) < 1 - 1e-9, f"largest |pole| {np.max(radius):.6g}")
    detail = f"the slowest mode takes {np.max(slowest):.3g} samples to fall to 1 %, the trial has {task.N}"
    return stable, premise("trial longer than the memory of the loop", slowest <= task.N, detail)


def _extremes(magnitude, f):
    """The curve, its peak, where that is, and where the curve first reaches 1; both narrowed down between the grid's frequencies."""
    curve = magnitude(f)
    top, low, high = np.argmax(curve), f[max(np.argmax(curve) - 1, 0)], f[min(np.argmax(curve) + 1, len(f) - 1)]
    peak, worst = curve[top], f[top]
    for _ in range(4):
        fine = np.linspace(low, high, 33)
        values = magnitude(fine)
        i = np.argmax(values)
        peak, worst = (values[i], fine[i]) if values[i] > peak else (peak, worst)
        low, high = fine[max(i - 1, 0)], fine[min(i + 1, 32)]
    if not np.any(curve >= 1):
        return curve, float(peak), float(worst), float(worst) if peak >= 1 else np.inf
    i = np.argmax(curve >= 1)
    low, high = f[max(i - 1, 0)], f[i]
    for _ in range(4 if i else 0):
        fine = np.linspace(low, high, 33)
        i = max(np.argmax(magnitude(fine) >= 1), 1)
        low, high = fine[i - 1], fine[i]
    return curve, float(peak), float(worst), float(high)


@jax.jit
def _loop_departure(machine, scheme, task):
    """|observed - predicted| / |observed| of a trial with random feedforward."""
    loop = linear_loop(machine, scheme, task)
    played = partial(played_trial, noiseless(machine), scheme, task, None if scheme is None else scheme.memory(task))
    w = jax.random.normal(jax.random.key(3), (task.N, loop.B.shape[1]))
    predicted = lax.scan(lambda x, w: (loop.A @ x + loop.B @ w, loop.C @ (loop.A @ x + loop.B @ w)), jnp.zeros(len(loop.A)), w)[1]
    observed = played(w) - played(jnp.zeros_like(w))
    return ratio(jnp.linalg.norm(observed - predicted), jnp.linalg.norm(observed))


@lru_cache(maxsize=16)  # what `tiled` returns compiles anew each time it is made
def _look(names):
    return tiled(partial(_worst_of, names=names))


@lru_cache(maxsize=16)
def _climbing(names, steps):
    return tiled(partial(_climb, names=names, steps=steps))


def _worst_of(common, point, *, names):
    """Supremum, critical frequency and loop of one plant, on the grid."""
    machine, scheme, task, f, _, _ = common
    loop = linear_loop(drawn_machine(machine, dict(names), {name: point[i] for i, (name, _) in enumerate(names)}), scheme, task)
    curve = jnp.nan_to_num(_parts(loop, scheme, task, f)[0], nan=jnp.inf, posinf=jnp.inf)
    i = jnp.argmax(curve >= 1)
    before, after = curve[jnp.maximum(i - 1, 0)], curve[i]
    share = jnp.where(i > 0, (1 - before) / jnp.where(after > before, after - before, 1.0), 1.0)
    crossing = f[jnp.maximum(i - 1, 0)] * (1 - share) + f[i] * share
    return jnp.max(curve), jnp.where(jnp.any(curve >= 1), crossing, jnp.inf), *loop


def _climb(common, start, *, names, steps):
    """Where projected gradient ascent from `start` ends, both in the units of the numbers drawn; it runs in the unit box."""
    machine, scheme, task, f, low, high = common

    def peak(x):
        values = {name: low[i] + (high[i] - low[i]) * x[i] for i, (name, _) in enumerate(names)}
        return jnp.max(_parts(linear_loop(drawn_machine(machine, dict(names), values), scheme, task), scheme, task, f)[0])

    def ascend(_, now):
        x, value, g, h = now
        free = jnp.where(((x <= 0) & (g < 0)) | ((x >= 1) & (g > 0)), 0.0, g)
        moved = jnp.clip(x + h * free / jnp.maximum(jnp.linalg.norm(free), jnp.finfo(float).tiny), 0.0, 1.0)
        there, slope = jax.value_and_grad(peak)(moved)
        better = there > value
        return jnp.where(better, moved, x), jnp.maximum(there, value), jnp.where(better, slope, g), h * jnp.where(better, 1.5, 0.5)

    x = (start - low) / (high - low)
    x = lax.fori_loop(0, steps, ascend, (x, *jax.value_and_grad(peak)(x), jnp.asarray(0.1)))[0]
    return low + (high - low) * x


def _reachable(A, B):
    """Orthonormal basis (n, r) of span(B, A B, A^2 B, ...)."""
    V = np.zeros((len(A), 0))
    fresh = B
    while True:
        for _ in range(2):
            fresh = fresh - V @ (V.T @ fresh)
        U, s, _ = np.linalg.svd(fresh, full_matrices=False)
        U = U[:, s > 1e-10 * max(np.linalg.norm(A), np.linalg.norm(B), 1e-300)]
        if U.shape[1] == 0 or V.shape[1] == len(A):
            return V
        V, fresh = np.hstack([V, U]), A @ U
