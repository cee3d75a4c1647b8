"""Weights tuned by gradients through the whole learning process, over many uncertain plants.

    minimise over w:   risk( objective(learn(plant_1, scheme(w))), ..., objective(learn(plant_S,
    scheme(w))) ) + nominal terms

Loss and slope of each plant are computed in tiles, and only numbers leave them; the risk's
derivatives by the plants' losses then weigh their slopes. The weights move through smooth maps of
the real line onto their allowed ranges. What the loop does to gradients:

    clips, quantisers, resets     their docstrings say what the gradient is: zero, straight-through,
    or that of the branch taken;
                                  `reset="smooth"` has the whole one (`schemes.pseudo_gradient`)
    a diverging learning process  `objectives.Bounded` holds it at a ceiling; the gradient is that
    of the trial that reached it
    long learning                 a slope of log e grows with the number of trials where learning
    amplifies; `clip` bounds each plant's,
                                  `truncate` takes that of the last trials alone, which is another
                                  one
    a settled figure              does not see the start of a trial, where errors may grow unseen:
    add a term of `max_error`
    a slope that is not finite    that plant's slope is left out of the step, its loss counts,
    `dropped` says how many there were
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from ..learning.divergence import CEILING
from ..learning.machine import Machine
from ..learning.metrics import Keep
from ..learning.over_trials import check, truncated
from ..pytree.named_paths import replaced
from ..pytree.ranges import SEEDS, require
from ..runtime.capacity import check_program
from ..runtime.provenance import environment
from ..runtime.recipe import describe
from ..runtime.tiles import OPEN, tiled, usual_lanes
from ..schemes import Scheme
from ..signals.task import Task, Trial
from ..sweeps.sweep import Sweep
from ..uncertainty import Uncertainty, draw, drawn_machine
from .descent import (
    Bijection,
    Evaluation,
    Method,
    State,
    arguments_like,
    by_gradient,
    by_least_squares,
    counted,
    for_starts,
    repaired,
    value_and_slope,
)
from .objectives import Bounded, Final, Objective, Run, Sum, judge
from .risks import Mean, Risk
from .sizes import need_room
from .states import Folder
from .weights import Asked, Tuned, Weights

if TYPE_CHECKING:
    import xarray as xr

FORWARD_UP_TO = 3  # weights
OPTIMISERS = ("adam", "lbfgs", "least-squares")


@dataclasses.dataclass(frozen=True)
class Tuning:
    """A tuning problem, fully specified: `run` it.

    machine, scheme, task, trials: as for `learn`
    weights: names of float leaves of the scheme, or elements (`phi0[0]`), with (low, high) bounds
    or None for the range that the leaf
             allows; an array stands for all of its elements. A range of one sign keeps it. Ends are
             open, by a hair
    uncertainty, samples, seed, sampling: the plants, see `uncertainty.draw`; the first is nominal
    objective, risk: what is minimised;  quantities: further figures of a trial, by name, for the
    objective
    held_out: plants drawn with seed + 1 that choose among the iterates, 0 to choose by the training
    loss
    optimiser: adam (rate falls to zero over the steps, cosine), lbfgs (with line search), any optax
    transformation (a configuration
               knows its functions by their code and what they close over, not by what they read
               from a module), or least-squares: Levenberg-Marquardt on the plants' losses, which
               minimises their mean square, not the risk; needs losses >= 0
    rate: of adam, in units of the real line: 0.1 is 10 % of a positive weight;  steps: at most
    starts: K, the first is the scheme's own values, the others lie around it with standard
    deviation `scatter` on the real line
    validate_every: steps from one look at the held-out plants to the next;  patience: looks without
    improvement until it stops
    mode: forward or reverse differentiation; auto takes forward for up to FORWARD_UP_TO weights.
    Over 80 trials of 2000 samples on a
          CPU, a forward gradient cost 5, 8 and 13 runs without one for 1, 2 and 3 weights
          (CFDL-MFAILC; FFDL: 3, 6, 9), reverse 9 to 12 of any number, and memory for what is
          learned, see `learn`
    truncate: K, slopes go through the last K trials alone, None for all; the weights' part in what
    was learned before them is then left
              out of the slope, not of the loss
    clip: longest slope of one plant, in units of the median length over the plants, or of 1 if that
    is less; inf for no bound
    ceiling: of the error, relative to the peak of the reference, see `Bounded`
    lanes: samples vectorised together, over all starts; None for what suits this backend
    Raises ValueError, before anything is compiled, naming a weight that does not exist, is absent
    or static, bounds that are empty or not allowed, a start outside them.
    """

    machine: Machine
    scheme: Scheme
    task: Task
    trials: int
    weights: Asked
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
    truncate: int | None = None
    clip: float = 3.0
    ceiling: float = CEILING
    lanes: int = OPEN
    quantities: Mapping[str, Callable[[Trial], jax.Array]] = dataclasses.field(default_factory=dict)

    def __post_init__(self):
        object.__setattr__(self, "lanes", usual_lanes() if self.lanes is None else self.lanes)
        for name, low in (
            ("trials", 1),
            ("samples", 1),
            ("held_out", 0),
            ("steps", 1),
            ("starts", 1),
            ("validate_every", 1),
            ("lanes", 1),
        ):
            require("Tuning", name, getattr(self, name), f"[{low}, inf)", whole=True)
        for name, allowed in (
            ("rate", "(0, inf)"),
            ("clip", "(0, inf]"),
            ("ceiling", "(0, inf)"),
            ("scatter", "[0, inf)"),
        ):
            require("Tuning", name, getattr(self, name), allowed)
        require("Tuning", "patience", self.patience, "[0, inf)", whole=True)
        require("Tuning", "seed", self.seed, SEEDS, whole=True)
        if self.truncate is not None:
            require("Tuning", "truncate", self.truncate, "[1, inf)", whole=True)
        for name, choices in (("mode", ("auto", "forward", "reverse")), ("optimiser", OPTIMISERS)):
            if isinstance(getattr(self, name), str) and getattr(self, name) not in choices:
                raise ValueError(
                    f"Tuning: {name} = {getattr(self, name)!r} is not one of {', '.join(choices)}"
                )
        check(self.machine, self.scheme, self.task)
        self._weights.need_room(self.machine, self.scheme, self.task)
        need_room(self)
        draw(self.machine, self.uncertainty, self.samples, seed=self.seed, sampling=self.sampling)
        jax.eval_shape(lambda: self.loss_of(self.machine, {}))

    @cached_property
    def _weights(self) -> Weights:
        return Weights.of(self.scheme, self.weights)

    @property
    def start(self) -> dict[str, float]:
        """The weights by name, as given."""
        return self._weights.start

    @property
    def bijections(self) -> dict[str, Bijection]:
        """The smooth maps of the real line onto the ranges of the weights, by name."""
        return self._weights.bijections

    def configuration(self) -> dict[str, Any]:
        """All that determines the numbers, as JSON."""
        described = {f.name: describe(getattr(self, f.name)) for f in dataclasses.fields(self)}
        return described | {"environment": environment("optax")}

    def scheme_of(self, values: Mapping[str, Any]) -> Scheme:
        """The scheme with the weights of these names; also inside `jit`."""
        return replaced(self.scheme, values)

    def loss_of(
        self,
        machine: Machine,
        values: Mapping[str, Any],
        objective: Objective | None = None,
        *,
        key=None,
    ) -> jax.Array:
        """() the objective of one plant with these weights: what is differentiated. Pure."""
        objective = self.objective if objective is None else objective
        scheme, options = self.scheme_of(values), {"key": key, "save": Keep.of(self.quantities)}
        if self.truncate is None or self.truncate >= self.trials:
            return judge(
                machine, scheme, self.task, self.trials, objective, ceiling=self.ceiling, **options
            )
        bounded = Bounded.around(scheme, self.task, self.ceiling)
        history = truncated(machine, bounded, self.task, self.trials, self.truncate, **options)
        return objective(Run(machine, scheme, self.task, history, self.ceiling))

    def held_out_loss(
        self, values: Mapping[str, Any], objective: Objective | None = None
    ) -> jax.Array:
        """() risk of the objective over the held-out plants with these weights, nominal terms
        included. Pure.
        """
        of_plants, of_nominal = _split(self.objective if objective is None else objective)
        seed, size = (self.seed + 1, self.held_out) if self.held_out else (self.seed, self.samples)
        plants = self._plants(seed, size, nominal=not self.held_out)
        losses = self._tiled(lambda values, one: self._loss(values, one, of_plants, seed), plants)(
            values, plants
        )
        return self.risk(counted(losses)) + (
            self.loss_of(self.machine, values, of_nominal) if of_nominal.parts else 0.0
        )

    def run(
        self,
        out: str | Path | None = None,
        *,
        resume: bool = False,
        progress: Callable[[int, np.ndarray, float], None] | None = None,
    ) -> Tuned:
        """Tune, and return the iterate that does best on the held-out plants.

        out: a folder for the state after each step, None for memory only;  resume: go on with the
        state at `out`
        progress: called after each step with its number, the (K,) training losses and the best
        held-out loss so far Killed at any moment, a resumed run ends with the numbers of an
        uninterrupted one, bit for bit; a damaged state is left for the one before it. Raises
        FileExistsError for an `out` that exists without `resume`, ValueError for one that is in
        use, is damaged
        beyond that, or was made with another configuration, and for a step that memory cannot hold.
        """
        z, (method, held_out) = (
            self._weights.starts(self.starts, self.scatter, self.seed),
            self._programs,
        )
        fewer = "take fewer trials, starts or lanes, or a shorter trial"
        check_program(
            "Tuning: a step of all starts", fewer, method.programs[1], *arguments_like(method, z)
        )
        with (
            nullcontext()
            if out is None
            else Folder(Path(out), self.configuration(), resume) as folder
        ):
            now, reason = State.start(z, method.init(z), self.steps), ""
            now = now if folder is None else folder.latest(now)
            while not reason:
                if now.step % self.validate_every == 0 or now.step == self.steps:
                    now = now.validated(jax.device_get(held_out(self._weights.at(now.z))))
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
        values = {name: float(value) for name, value in self._weights.at(now.best_z).items()}
        before, after = held_out(
            {name: jnp.asarray([self.start[name], values[name]]) for name in values}
        )
        return Tuned.of(now, self._weights, self.scheme, float(before), float(after), reason)

    def compare(
        self,
        tuned: Tuned,
        *,
        trials: int | None = None,
        samples: int = 257,
        seed: int | None = None,
    ) -> xr.Dataset:
        """The scheme as given and as tuned, on plants that neither tuning nor choosing has seen: a
        sweep's dataset, for `summarise`.

        trials: None for those of the tuning;  samples: sample 0 is the nominal plant
        seed: of the plants, None for that of the tuning + 2. Whoever changes a tuning after looking
        at a comparison has seen its plants
        Raises ValueError for the seeds of the plants that were seen.
        """
        return self.comparison(
            {"given": self.scheme, "tuned": tuned.scheme}, trials=trials, samples=samples, seed=seed
        ).run()

    def comparison(
        self,
        schemes: Mapping[str, Scheme] | None = None,
        *,
        trials: int | None = None,
        samples: int = 257,
        seed: int | None = None,
    ) -> Sweep:
        """The sweep of schemes over plants that nobody has seen, as `compare` has it; None for the
        one given and another like it.

        Raises as `compare` does, and ValueError for more plants or trials than fit into memory: ask
        before tuning for hours.
        """
        if seed in (self.seed, self.seed + 1):
            raise ValueError(
                f"compare: seed = {seed} is one of {self.seed} and {self.seed + 1}, whose plants tuning or choosing has seen"
            )
        schemes = {"given": self.scheme, "tuned": self.scheme} if schemes is None else schemes
        options: dict[str, Any] = {
            "seed": self.seed + 2 if seed is None else seed,
            "quantities": self.quantities,
        }
        planned = Sweep(
            self.machine,
            schemes,
            self.task,
            trials or self.trials,
            self.uncertainty,
            samples=samples,
            **options,
        )
        planned.need_room(copies=2)  # in memory the dataset is there twice
        return planned

    @cached_property
    def _programs(self) -> tuple[Method, Callable]:
        """The optimiser for all starts, and the held-out losses; what is compiled is kept with the
        problem.
        """
        return for_starts(self._method()), jax.jit(jax.vmap(self.held_out_loss))

    def _method(self) -> Method:
        """The optimiser on the training loss."""
        forward = self.mode == "forward" or (
            self.mode == "auto" and len(self.bijections) <= FORWARD_UP_TO
        )
        of_plants, of_nominal = _split(self.objective)

        def of_one(z, one):
            return value_and_slope(
                lambda z: self._loss(self._weights.at(z), one, of_plants, self.seed),
                z,
                forward=forward,
            )

        plants = self._plants(self.seed, self.samples, nominal=True)
        over_plants = self._tiled(of_one, plants)

        def evaluate(z) -> Evaluation:
            losses, slopes, good = repaired(*over_plants(z, plants), self.clip)
            omega = self.risk.weights(losses) * good
            omega = omega / jnp.where(jnp.sum(omega) > 0, jnp.sum(omega), 1.0)
            value, gradient = self.risk(losses), omega @ slopes
            residuals, jacobian = losses / len(losses) ** 0.5, slopes / len(losses) ** 0.5
            if of_nominal.parts:
                term, slope = jax.value_and_grad(
                    lambda z: self.loss_of(self.machine, self._weights.at(z), of_nominal)
                )(z)
                value, gradient = value + term, gradient + slope
                residuals, jacobian = jnp.append(residuals, term), jnp.vstack([jacobian, slope])
            return Evaluation(
                value, gradient, residuals, jacobian, jnp.sum(~good).astype(losses.dtype)
            )

        if self.optimiser == "least-squares":
            return by_least_squares(evaluate)
        named = {
            "adam": lambda: optax.adam(optax.cosine_decay_schedule(self.rate, self.steps)),
            "lbfgs": optax.lbfgs,
        }
        return by_gradient(
            evaluate, named[self.optimiser]() if isinstance(self.optimiser, str) else self.optimiser
        )

    def _loss(self, values, one, objective: Objective, seed: int):
        """The objective of one of `_plants`."""
        index, drawn = one
        machine = drawn_machine(self.machine, self.uncertainty, drawn)
        return self.loss_of(
            machine, values, objective, key=jax.random.fold_in(jax.random.key(seed), index)
        )

    def _tiled(self, of_one, plants):
        """Over the plants and, under `vmap`, all starts."""
        return tiled(
            of_one,
            lanes=max(1, min(self.lanes, -(-len(plants[0]) // jax.device_count())) // self.starts),
        )

    def _plants(self, seed: int, size: int, *, nominal: bool):
        """Indices and drawn numbers of `size` plants, the nominal one among them or not: a batch
        for `tiled`.
        """
        skipped = 0 if nominal else 1
        sampling = (
            "sobol" if self.sampling == "corners" and seed != self.seed else self.sampling
        )  # there are no other corners
        drawn = draw(self.machine, self.uncertainty, size + skipped, seed=seed, sampling=sampling)
        count = len(next(iter(drawn.values()))) if drawn else size + skipped
        return jnp.arange(skipped, count), {
            name: jnp.asarray(values[skipped:]) for name, values in drawn.items()
        }


def _split(objective: Objective) -> tuple[Sum, Sum]:
    """What is asked of each plant, and what of the nominal one alone."""
    of_plants, of_nominal = (
        Sum(tuple(t for t in objective.terms if t[1].nominal is nominal))
        for nominal in (False, True)
    )
    return of_plants, of_nominal
