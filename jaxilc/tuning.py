"""Weights tuned by gradients through the whole learning process, over many uncertain plants.

    minimise over w:   risk( objective(learn(plant_1, scheme(w))), ..., objective(learn(plant_S, scheme(w))) ) + nominal terms

Loss and slope of each plant are computed in tiles, and only numbers leave them; the risk's derivatives by the plants' losses then
weigh their slopes. The weights move through smooth maps of the real line onto their allowed ranges. What the loop does to gradients:

    clips, quantisers, resets     their docstrings say what the gradient is: zero, straight-through, or that of the branch taken
    a diverging learning process  `objectives.Bounded` holds it at a ceiling; the gradient is that of the trial that reached it
    long learning                 a slope of log e grows with the number of trials where learning amplifies; `clip` bounds each plant's
    a settled figure              does not see the start of a trial, where errors may grow unseen: add a term of `max_error`
    a slope that is not finite    that plant's slope is left out of the step, its loss counts, `dropped` says how many there were
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from .batch import LANES, tiled
from .descent import (
    Bijection,
    Evaluation,
    Folder,
    Method,
    State,
    by_gradient,
    by_least_squares,
    counted,
    for_starts,
    repaired,
    value_and_slope,
)
from .learning import check
from .machine import Machine
from .metrics import Keep
from .objectives import CEILING, Final, Objective, Sum, judge
from .pytree import get_at, interval_at, named_leaves, replaced
from .results import describe, environment
from .risks import Mean, Risk
from .schemes import Scheme
from .signals import Task, Trial
from .sweep import Sweep
from .uncertainty import Uncertainty, draw, drawn_machine

if TYPE_CHECKING:
    import xarray as xr

FORWARD_UP_TO = 3  # weights
OPTIMISERS = ("adam", "lbfgs", "least-squares")
FAR = 12.0  # on the real line: where a weight might go, e^12 or 6e-6 from an end


@dataclasses.dataclass(frozen=True)
class Tuned:
    """What tuning found.

    values: by name, of the iterate with the best held-out loss;  scheme: with them;  start: by name, as given
    loss, slope, dropped: (steps, K) training loss, length of its gradient, plants without a finite one, of each step and start
    weights: by name, (steps, K) the values they belong to;  held_out: (steps + 1, K) held-out loss where it was looked at, else NaN
    before, after: held-out loss with `start` and with `values`;  step: of the best iterate
    nudged: values of `start` that lay on an end of their range, and where they were moved to;  reason: why it stopped
    """

    values: dict[str, float]
    scheme: Scheme
    start: dict[str, float]
    loss: np.ndarray
    slope: np.ndarray
    dropped: np.ndarray
    weights: dict[str, np.ndarray]
    held_out: np.ndarray
    before: float
    after: float
    step: int
    nudged: dict[str, float]
    reason: str


@dataclasses.dataclass(frozen=True)
class Tuning:
    """A tuning problem, fully specified: `run` it.

    machine, scheme, task, trials: as for `learn`
    weights: names of float leaves of the scheme, or elements (`phi0[0]`), with (low, high) bounds or None for the range that the leaf
             allows; an array stands for all of its elements. A range of one sign keeps it. Ends are open, by a hair
    uncertainty, samples, seed, sampling: the plants, see `uncertainty.draw`; the first is nominal
    objective, risk: what is minimised;  quantities: further figures of a trial, by name, for the objective
    held_out: plants drawn with seed + 1 that choose among the iterates, 0 to choose by the training loss
    optimiser: adam (rate falls to zero over the steps, cosine), lbfgs (with line search), any optax transformation (a configuration
               knows it by name only), or least-squares: Levenberg-Marquardt on the plants' losses, which minimises their mean square,
               not the risk; needs losses >= 0
    rate: of adam, in units of the real line: 0.1 is 10 % of a positive weight;  steps: at most
    starts: K, the first is the scheme's own values, the others lie around it with standard deviation `scatter` on the real line
    validate_every: steps from one look at the held-out plants to the next;  patience: looks without improvement until it stops
    mode: forward or reverse differentiation; auto takes forward for up to FORWARD_UP_TO weights. Over 20 trials of 2000 samples on a
          CPU, a forward gradient cost 1 + 2 P (CFDL-MFAILC) to 1 + 4 P (FFDL) runs without one; reverse 5 to 10 of any P, and memory
          for what is learned in each trial
    clip: largest length of one plant's slope;  ceiling: of the error, relative to the peak of the reference, see `Bounded`
    lanes: samples vectorised together, over all starts
    Raises ValueError, before anything is compiled, naming a weight that does not exist, is absent or static, bounds that are empty or
    not allowed, a start outside them.
    """

    machine: Machine
    scheme: Scheme
    task: Task
    trials: int
    weights: Mapping[str, tuple[float, float] | None] | Sequence[str]
    uncertainty: Uncertainty = dataclasses.field(default_factory=dict)
    objective: Objective = dataclasses.field(default_factory=Final)
    risk: Risk = dataclasses.field(default_factory=Mean)
    samples: int = 32
    seed: int = 0
    sampling: str = "sobol"
    held_out: int = 32
    optimiser: str | optax.GradientTransformation = "adam"
    rate: float = 0.1
    steps: int = 100
    starts: int = 1
    scatter: float = 0.5
    validate_every: int = 5
    patience: int = 6
    mode: str = "auto"
    clip: float = 1e3
    ceiling: float = CEILING
    lanes: int = LANES
    quantities: Mapping[str, Callable[[Trial], jax.Array]] = dataclasses.field(default_factory=dict)

    def __post_init__(self):
        for name, low in (("trials", 1), ("samples", 1), ("held_out", 0), ("steps", 1), ("starts", 1), ("validate_every", 1), ("lanes", 1)):
            if getattr(self, name) < low:
                raise ValueError(f"Tuning: {name} = {getattr(self, name)} is outside its allowed range [{low}, inf)")
        for name in ("rate", "clip", "ceiling"):
            if not getattr(self, name) > 0:
                raise ValueError(f"Tuning: {name} = {getattr(self, name)} is outside its allowed range (0, inf)")
        for name, choices in (("mode", ("auto", "forward", "reverse")), ("optimiser", OPTIMISERS)):
            if isinstance(getattr(self, name), str) and getattr(self, name) not in choices:
                raise ValueError(f"Tuning: {name} = {getattr(self, name)!r} is not one of {', '.join(choices)}")
        check(self.machine, self.scheme, self.task)
        given = self.weights if isinstance(self.weights, Mapping) else dict.fromkeys(self.weights)
        if not given:
            raise ValueError("Tuning: weights is empty; at least one is needed")
        bounds = {element: b for name, of in given.items() for element, b in _elements(self.scheme, name, of).items()}
        start = {name: float(get_at(self.scheme, name)) for name in bounds}
        bijections = {name: Bijection(*b, abs(start[name]) or 1.0) for name, b in bounds.items()}
        for name, bijection in bijections.items():
            _need_room(self, name, bijection)
        object.__setattr__(self, "bijections", bijections)
        object.__setattr__(self, "start", start)
        draw(self.machine, self.uncertainty, self.samples, seed=self.seed, sampling=self.sampling)
        jax.eval_shape(lambda: self.loss_of(self.machine, {}))

    def configuration(self) -> dict[str, Any]:
        """All that determines the numbers, as JSON."""
        return {f.name: describe(getattr(self, f.name)) for f in dataclasses.fields(self)} | {"environment": environment()}

    def scheme_of(self, values: Mapping[str, Any]) -> Scheme:
        """The scheme with the weights of these names; also inside `jit`."""
        return replaced(self.scheme, values)

    def loss_of(self, machine: Machine, values: Mapping[str, Any], objective: Objective | None = None, *, key=None) -> jax.Array:
        """() the objective of one plant with these weights: what is differentiated. Pure."""
        objective = self.objective if objective is None else objective
        scheme = self.scheme_of(values)
        return judge(machine, scheme, self.task, self.trials, objective, key=key, ceiling=self.ceiling, save=Keep.of(self.quantities))

    def held_out_loss(self, values: Mapping[str, Any], objective: Objective | None = None) -> jax.Array:
        """() risk of the objective over the held-out plants with these weights, nominal terms included. Pure."""
        of_plants, of_nominal = _split(self.objective if objective is None else objective)
        seed, size = (self.seed + 1, self.held_out) if self.held_out else (self.seed, self.samples)
        plants = self._plants(seed, size, nominal=not self.held_out)
        losses = self._tiled(lambda values, one: self._loss(values, one, of_plants, seed), plants)(values, plants)
        return self.risk(counted(losses)) + (self.loss_of(self.machine, values, of_nominal) if of_nominal.parts else 0.0)

    def run(
        self, out: str | Path | None = None, *, resume: bool = False, progress: Callable[[int, np.ndarray, float], None] | None = None
    ) -> Tuned:
        """Tune, and return the iterate that does best on the held-out plants.

        out: a folder for the state after each step, None for memory only;  resume: go on with the state at `out`
        progress: called after each step with its number, the (K,) training losses and the best held-out loss so far
        Killed at any moment, a resumed run ends with the numbers of an uninterrupted one, bit for bit. Raises FileExistsError for an
        `out` that exists without `resume`, ValueError for one made with another configuration.
        """
        inside = {name: b.inside(self.start[name]) for name, b in self.bijections.items()}
        scattered = self.scatter * np.random.default_rng(self.seed).standard_normal((self.starts, len(inside)))
        scattered[0] = 0.0
        z = np.array([b.inverse(inside[name]) for name, b in self.bijections.items()]) + scattered
        z = z.astype(jnp.result_type(float))
        method = for_starts(self._method())
        held_out = jax.jit(jax.vmap(self.held_out_loss))
        now, reason = State.start(z, method.init(z), self.steps), ""
        folder = None if out is None else Folder(Path(out), self.configuration(), resume)
        now = now if folder is None else folder.latest(now)
        while not reason:
            if now.step % self.validate_every == 0 or now.step == self.steps:
                now = now.validated(jax.device_get(held_out(self._natural(now.z))))
            if now.step == self.steps or now.stale > self.patience:
                reason = "steps" if now.step == self.steps else "patience"
                continue
            z, inner, record = method.step(now.z, now.inner)
            if not np.any(np.isfinite(record.loss)):
                reason = "no plant has a finite loss"
                continue
            now = now.advanced(z, inner, record)
            if folder is not None:
                folder.write(now)
            if progress is not None:
                progress(int(now.step), np.asarray(record.loss), float(now.best))
        done = int(now.step)
        values = {name: float(value) for name, value in self._natural(now.best_z).items()}
        before, after = held_out({name: jnp.asarray([self.start[name], values[name]]) for name in values})
        return Tuned(
            values=values,
            scheme=self.scheme_of(values),
            start=dict(self.start),
            loss=now.loss[:done],
            slope=now.slope[:done],
            dropped=now.dropped[:done],
            weights={name: np.asarray(value) for name, value in self._natural(now.path[:done]).items()},
            held_out=now.held_out[: done + 1],
            before=float(before),
            after=float(after),
            step=int(now.best_step),
            nudged={name: value for name, value in inside.items() if value != self.start[name]},
            reason=reason,
        )

    def compare(self, tuned: Tuned, *, trials: int | None = None, samples: int = 257) -> xr.Dataset:
        """The scheme as given and as tuned, on plants that neither tuning nor choosing has seen (seed + 2): a sweep's dataset, for
        `summarise`. trials: None for those of the tuning; sample 0 is the nominal plant."""
        schemes = {"given": self.scheme, "tuned": tuned.scheme}
        options = {"samples": samples, "seed": self.seed + 2, "quantities": self.quantities}
        return Sweep(self.machine, schemes, self.task, trials or self.trials, self.uncertainty, **options).run()

    def _method(self) -> Method:
        """The optimiser on the training loss."""
        forward = self.mode == "forward" or (self.mode == "auto" and len(self.bijections) <= FORWARD_UP_TO)
        of_plants, of_nominal = _split(self.objective)

        def of_one(z, one):
            return value_and_slope(lambda z: self._loss(self._natural(z), one, of_plants, self.seed), z, forward=forward)

        plants = self._plants(self.seed, self.samples, nominal=True)
        over_plants = self._tiled(of_one, plants)

        def evaluate(z) -> Evaluation:
            losses, slopes, good = repaired(*over_plants(z, plants), self.clip)
            omega = self.risk.weights(losses) * good
            omega = omega / jnp.where(jnp.sum(omega) > 0, jnp.sum(omega), 1.0)
            value, gradient = self.risk(losses), omega @ slopes
            residuals, jacobian = losses / len(losses) ** 0.5, slopes / len(losses) ** 0.5
            if of_nominal.parts:
                term, slope = jax.value_and_grad(lambda z: self.loss_of(self.machine, self._natural(z), of_nominal))(z)
                value, gradient = value + term, gradient + slope
                residuals, jacobian = jnp.append(residuals, term), jnp.vstack([jacobian, slope])
            return Evaluation(value, gradient, residuals, jacobian, jnp.sum(~good).astype(losses.dtype))

        if self.optimiser == "least-squares":
            return by_least_squares(evaluate)
        named = {"adam": lambda: optax.adam(optax.cosine_decay_schedule(self.rate, self.steps)), "lbfgs": optax.lbfgs}
        return by_gradient(evaluate, named[self.optimiser]() if isinstance(self.optimiser, str) else self.optimiser)

    def _natural(self, z) -> dict[str, jax.Array]:
        """The weights by name of z (..., P)."""
        return {name: b(z[..., i]) for i, (name, b) in enumerate(self.bijections.items())}

    def _loss(self, values, one, objective: Objective, seed: int):
        """The objective of one of `_plants`."""
        index, drawn = one
        machine = drawn_machine(self.machine, self.uncertainty, drawn)
        return self.loss_of(machine, values, objective, key=jax.random.fold_in(jax.random.key(seed), index))

    def _tiled(self, of_one, plants):
        """Over the plants and, under `vmap`, all starts; no wider than there are plants for each device."""
        lanes = min(self.lanes, -(-len(plants[0]) // jax.device_count()))
        return tiled(of_one, lanes=max(1, lanes // self.starts))

    def _plants(self, seed: int, size: int, *, nominal: bool):
        """Indices and drawn numbers of `size` plants, the nominal one among them or not: a batch for `tiled`."""
        skipped = 0 if nominal else 1
        sampling = "sobol" if self.sampling == "corners" and seed != self.seed else self.sampling  # there are no other corners
        drawn = draw(self.machine, self.uncertainty, size + skipped, seed=seed, sampling=sampling)
        count = len(next(iter(drawn.values()))) if drawn else size + skipped
        return jnp.arange(skipped, count), {name: jnp.asarray(values[skipped:]) for name, values in drawn.items()}


def _split(objective: Objective) -> tuple[Sum, Sum]:
    """What is asked of each plant, and what of the nominal one alone."""
    terms = objective.terms
    return tuple(Sum(tuple(t for t in terms if t[1].nominal is nominal)) for nominal in (False, True))


def _elements(scheme: Scheme, name: str, bounds: tuple[float, float] | None) -> dict[str, tuple[float, float]]:
    """The elements of a leaf by name, with their bounds. Raises ValueError as `Tuning` says."""
    try:
        value = get_at(scheme, name)
    except KeyError as error:
        raise ValueError(f"weights: {error.args[0]}") from None
    if not any(name == of or name.startswith(f"{of}[") for of in named_leaves(scheme)):
        raise ValueError(f"weights: {name} = {value!r} is not a float leaf of this scheme and cannot be tuned")
    allowed = interval_at(scheme, name)
    low, high = (allowed.low, allowed.high) if bounds is None else map(float, bounds)
    if not low < high:
        raise ValueError(f"weights: the bounds ({low:g}, {high:g}) of {name} are empty")
    if low < allowed.low or high > allowed.high:
        raise ValueError(f"weights: the bounds ({low:g}, {high:g}) of {name} leave its allowed range {allowed}")
    if not np.all((low <= np.asarray(value)) & (np.asarray(value) <= high)):
        raise ValueError(f"weights: the start {name} = {np.asarray(value)} is outside its bounds ({low:g}, {high:g})")
    return {name + "".join(f"[{i}]" for i in index): (low, high) for index in np.ndindex(np.shape(value))}


def _need_room(problem: Tuning, name: str, bijection: Bijection) -> None:
    """Raises ValueError if the scheme refuses what the bounds of a weight allow, a filter a cutoff beyond Nyquist."""
    for z in (-FAR, FAR):
        value = float(bijection(z))
        try:
            check(problem.machine, problem.scheme_of({name: value}), problem.task)
        except ValueError as error:
            raise ValueError(f"weights: within its bounds {name} may become {value:g}; {error}. Give narrower bounds") from None
