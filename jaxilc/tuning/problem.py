"""Weights tuned by gradients through the whole learning process, over many uncertain machines.

    minimise over w:   risk(l_1, ..., l_S) + nominal terms,   l_s = objective(learn(machine_s, w))

Loss and slope of each machine are computed in tiles, and only these numbers are kept; the slopes
are then weighted by the derivatives of the risk by the losses. Smooth maps from the real line keep
the weights inside their ranges.

How learning affects the gradients:

    clips, quantisers, resets     Their docstrings say what the gradient is: zero, straight-through,
                                  or that of the branch that was taken. `reset="smooth"` has the
                                  whole gradient (`schemes.mfac`).
    a diverging learning process  `objectives.Bounded` limits its error to a ceiling. The gradient
                                  is that of the trial that reached the ceiling.
    many trials                   Where learning amplifies, the slope of log e grows with the number
                                  of trials. `clip` bounds the slope of each machine. `truncate`
                                  takes the slope through the last trials only, which is not the
                                  slope of the loss.
    a settled metric              It does not include the start of a trial, where errors may grow:
                                  add a term of `max_error`.
    a slope that is not finite    The slope of that machine is left out of the step, which follows
                                  the worst of the others where the risk asks for the worst. Its
                                  loss still counts, and `dropped` says how many there were.
"""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, cast

import jax
import jax.numpy as jnp
import numpy as np
import optax

from ..learning.divergence import CEILING
from ..learning.known_metrics import bytes_of_metrics
from ..learning.machine import Machine
from ..learning.metrics import Keep
from ..learning.over_trials import check
from ..learning.within_trial import bytes_of_trial
from ..native.run import fastest
from ..pytree.aliases import Value
from ..pytree.closest import not_one_of
from ..pytree.in_short import in_short
from ..pytree.named_paths import replaced
from ..pytree.ranges import SEEDS, brief, fits, require
from ..pytree.ranges import allowed as allowed_kind
from ..runtime.capacity import check_program, check_size
from ..runtime.earlier_names import takes_also
from ..runtime.lanes import fitting_lanes, usual_lanes
from ..runtime.provenance import describe, environment
from ..runtime.tiles import tiled
from ..schemes import Scheme
from ..schemes.scheme import need_learned_at_last
from ..signals.task import Task, Trial
from ..storage.files import need_free
from ..sweeps.sweep import Sweep
from ..uncertainty import Population, Uncertainty, takes_population
from .descent import (
    OPTIMISERS,
    Evaluation,
    Folder,
    State,
    Step,
    Z,
    counted,
    descended,
    for_starts,
    method_of,
    over_starts,
    repaired,
    stored_lanes,
)
from .objectives import Final, Objective, Sum, judge
from .risks import Mean, Risk
from .weights import Bijection, NamesOrBounds, Tuned, Weights

if TYPE_CHECKING:
    import xarray as xr

# What the settings of a tuning may be.
WHOLE = dict.fromkeys(("trials", "machines"), "[1, inf)") | {"held_out": "[0, inf)"}
WHOLE |= dict.fromkeys(("steps", "starts", "validate_every", "lanes", "truncate"), "[1, inf)")
OPTIONAL = ("lanes", "truncate")
WHOLE |= {"patience": "[0, inf)", "seed": SEEDS}
REAL = {"rate": "(0, inf)", "clip": "(0, inf]", "ceiling": "(0, inf)", "scatter": "[0, inf)"}
CHOICES = {"mode": ("auto", "forward", "reverse"), "optimiser": OPTIMISERS}
KINDS = {"objective": Objective, "risk": Risk, "optimiser": str | optax.GradientTransformation}
FORWARD_UP_TO = 2  # weights
COPIES = 6  # in RAM, of the record of each step: in the state, in its file, and while it is written


@takes_also(samples="machines")
@takes_population
@dataclasses.dataclass(frozen=True)
class Tuning:
    """A fully specified tuning problem, which `run` solves.

    machine, scheme, task, trials: as for `learn`; a `Population` may take the place of the machine
    weights: names of float leaves of the scheme, or of elements (`phi0[0]`), with (low, high)
        bounds, or None for the range that the leaf allows. An array stands for all of its elements.
        The ends of a range are excluded, so a weight whose range has one sign keeps that sign.
    uncertainty, machines, seed, sampling: which machines are drawn, see `uncertainty.draw`. The
        first is nominal; `samples` is an earlier name of `machines`.
    objective, risk: number of one machine, and how the numbers of all machines are combined
    quantities: further metrics of a trial, by name, for the objective
    held_out: number of machines, drawn with seed + 1, whose loss selects the best iterate; with 0,
        the machines that are trained on select it
    optimiser: `adam` (its rate falls to zero over the steps, by a cosine), `lbfgs` (with line
        search), any optax transformation (a configuration identifies its functions by their code
        and closures, not by what they read from a module), or `least-squares`: Levenberg-Marquardt
        on the losses of the machines; it minimises their mean square, not the risk, and needs
        losses >= 0
    rate: rate of adam on the real line: 0.1 is 10 % of a positive weight, and 0.1 in its own unit
        of one that starts at 0, unless it has a finite range, whose width is its size
    steps: largest number of steps
    starts: number K of starts; the first has the scheme's own values, the others lie around it with
        the standard deviation `scatter` on the real line
    validate_every: steps from one computation of the held-out loss to the next; also the last step
        is judged, and one between, which may be better by some per cent, is not
    patience: number of these computations without improvement that are allowed
    mode: `forward` or `reverse` differentiation; `auto` is forward for up to FORWARD_UP_TO weights.
        On a CPU, a forward gradient took as long as 5, 7 and 12 runs without one for 1, 2 and 3
        weights (CFDL-MFAILC, 80 trials of 2000 samples; FFDL: 3, 5, 6). A reverse gradient took as
        long as 10 runs (FFDL: 7) for any number, and needs RAM for what is learned, see `learn`.
    truncate: number of last trials through which slopes are computed, None for all. The effect of
        the weights on earlier trials is then missing in the slope, but not in the loss.
    clip: largest length of a machine's slope, in units of the median length over the machines, or
        of 1 if the median is less; inf for no bound
    ceiling: largest error, relative to the peak of the reference, see `Bounded`
    lanes: machines vectorised together, over all starts; None for what suits this backend: 16 or 8
        on a CPU, by its cache; on an accelerator what its memory holds, see `runtime.lanes`. With
        None, a tuning that is resumed keeps those that it was begun with.

    Raises ValueError, before anything is compiled, also where the last trial is an experiment.
    """

    machine: Machine | Population
    scheme: Scheme
    task: Task
    trials: int
    weights: NamesOrBounds
    uncertainty: Uncertainty = dataclasses.field(default_factory=dict)
    objective: Objective = dataclasses.field(default_factory=Final)
    risk: Risk = dataclasses.field(default_factory=Mean)
    machines: int = 32
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
    lanes: int | None = None
    quantities: Mapping[str, Callable[[Trial], jax.Array]] = dataclasses.field(default_factory=dict)
    __repr__ = in_short

    def __post_init__(self):
        machine = cast("Machine", self.machine)
        check(machine, self.scheme, self.task)
        self._check_settings()
        self._weights.need_room(machine, self.scheme, self.task)
        self._need_room()
        _ = self.population.drawn  # which cannot be drawn where a number leaves its range
        jax.eval_shape(lambda: self.loss_of(machine, {}))
        _ = self._lanes

    def __getstate__(self) -> dict[str, Value]:
        """The fields alone: what follows from them may be a compiled program, which has no copy."""
        return {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}

    def _check_settings(self) -> None:
        """Raises ValueError naming a setting, its value and what is allowed."""
        for name, allowed in WHOLE.items():
            if name not in OPTIONAL or getattr(self, name) is not None:
                require("Tuning", name, getattr(self, name), allowed, whole=True)
        for name, allowed in REAL.items():
            require("Tuning", name, getattr(self, name), allowed)
        for name, kind in KINDS.items():
            if not fits(value := getattr(self, name), kind):
                raise ValueError(f"Tuning: {name} = {brief(value)}; {allowed_kind(kind)}")
        for name, choices in CHOICES.items():
            value = getattr(self, name)
            if value not in choices if isinstance(value, str) else name not in KINDS:
                raise ValueError(not_one_of(f"Tuning: {name} = {brief(value)}", value, choices))
        need_learned_at_last("Tuning", self.scheme, self.task, self.trials)

    def _need_room(self) -> None:
        """Raises ValueError, saying how many fit, where trials, machines, starts or steps do not.

        Nothing is drawn or compiled for it. An uncertainty that does not fit the machine is
        refused, too.
        """
        population, weights, starts = self.population, len(self.start), self.starts
        together = min((self.lanes or 1) * jax.device_count(), self.machines)
        of_a_trial = COPIES * bytes_of_metrics(self.task) * together

        def of_machines(machines: float, starts: float) -> float:
            return population.bytes_drawn(machines) + COPIES * 8 * (weights + 1) * machines * starts

        def of_steps(starts: float, steps: float) -> float:
            return COPIES * 8 * (weights + 4) * starts * (steps + 1)

        check_size("Tuning", of_a_trial, trials=self.trials)
        for name in ("machines", "held_out"):
            counts = {name: getattr(self, name), "starts": starts}
            check_size(
                "Tuning", lambda starts, **of: of_machines(sum(of.values()), starts), **counts
            )
        check_size("Tuning", of_steps, starts=starts, steps=self.steps)

    @cached_property
    def population(self) -> Population:
        """The machines that the tuning is on."""
        of = self.machine, self.uncertainty, {}, self.machines, self.seed, self.sampling
        return Population(*of)

    @cached_property
    def _weights(self) -> Weights:
        return Weights.of(self.scheme, self.weights)

    @cached_property
    def _lanes(self) -> int:
        """The lanes; where they were left open, those that suit the backend and fit with slopes.

        They are for all machines at each start.
        Raises ValueError where a single machine does not fit on a device.
        """
        size = bytes_of_trial(self.scheme, self.task)
        lanes = self.lanes or usual_lanes(size, backward=not self._forward)
        if lanes is not None:
            return lanes
        of_one = partial(self._slope_of_one, objective=split(self.objective)[0])
        batch, z = self.population.batch(), jnp.zeros(len(self.start))
        every = max(self.machines, self.held_out) * self.starts
        return fitting_lanes(of_one, z, batch, every, held=every, what="Tuning")

    @property
    def _forward(self) -> bool:
        """Whether slopes are computed forward, which costs less for few weights."""
        few = self.mode == "auto" and len(self.start) <= FORWARD_UP_TO
        return self.mode == "forward" or few

    @property
    def start(self) -> dict[str, float]:
        """The weights by name, as given."""
        return self._weights.start

    @property
    def bijections(self) -> dict[str, Bijection]:
        """The smooth maps of the real line onto the ranges of the weights, by name."""
        return self._weights.bijections

    def configuration(self) -> dict[str, object]:
        """All that determines the numbers, as JSON."""
        described = {f.name: describe(getattr(self, f.name)) for f in dataclasses.fields(self)}
        native = self.evaluation[1]
        around = environment("optax", *["llvmlite"] * native)
        if native:
            around["native"] = True
        return described | {"lanes": int(self._lanes), "environment": around}

    def scheme_of(self, values: Mapping[str, Value]) -> Scheme:
        """The scheme with these values of the weights by name; also usable inside `jit`."""
        return replaced(self.scheme, values)

    def loss_of(
        self,
        machine: Machine,
        values: Mapping[str, Value],
        objective: Objective | None = None,
        *,
        key=None,
    ) -> jax.Array:
        """() the objective of one machine with these weights, a pure function."""
        last = None if self.truncate is None else min(self.truncate, self.trials)
        return judge(
            machine, self.scheme_of(values), self.task, self.trials, objective or self.objective,
            key=key, ceiling=self.ceiling, save=Keep.of(self.quantities), last=last,
        )  # fmt: skip

    def held_out_loss(
        self, values: Mapping[str, Value], objective: Objective | None = None
    ) -> jax.Array:
        """() the risk over the held-out machines plus the nominal terms, a pure function."""
        population, first = self.population, 0
        if self.held_out:  # the nominal machine is one of those that are trained on
            population, first = population.others(self.seed + 1, self.held_out + 1), 1
        of_machines, of_nominal = split(objective or self.objective)
        batch = population.batch(first)
        run = tiled(
            lambda values, one: self._of_one(values, one, of_machines, population),
            lanes=self._lanes_of(batch),
        )
        risk = self.risk(counted(run(values, batch)))
        if not of_nominal.parts:
            return risk
        return risk + self.loss_of(population.machine, values, of_nominal)

    def run(
        self,
        out: str | Path | None = None,
        *,
        resume: bool = False,
        progress: Callable[[int, np.ndarray, float], None] | None = None,
    ) -> Tuned:
        """Tune, and return that of the judged iterates with the least loss on held-out machines.

        Where none of them has less than the weights as given, these are returned.

        A run that was killed at any moment and resumed ends with the numbers of an uninterrupted
        one, bit for bit. Where the newest state is damaged, it continues from the one before.

        out: folder for the state after each step, None to keep it in the RAM only
        progress: function that is called after each step with its number, the (K,) training losses
            and the best held-out loss so far
        Raises FileExistsError for an `out` that exists without `resume`; ValueError for one that is
        in use, has no undamaged state, or was made with another configuration, and for a step that
        the RAM cannot hold.
        """
        if out is not None and not resume:
            need_free(out)
        if resume and out is not None and self.lanes is None:
            begun = stored_lanes(Path(out)) or self._lanes
            if begun != self._lanes:
                again = dataclasses.replace(self, lanes=begun)
                return again.run(out, resume=True, progress=progress)
        z = self._weights.starts(self.starts, self.scatter, self.seed)
        init, step, _ = self._programs
        with ExitStack() as opened:
            place = None
            if resume and out is not None and Path(out).exists():  # refused before it is compiled
                place = opened.enter_context(Folder(Path(out), self.configuration(), resume))
            self._compile(z)
            if out is not None and place is None:
                place = opened.enter_context(Folder(Path(out), self.configuration(), resume))
            now = State.start(z, jax.device_get(init(z)), self.steps)

            def after_step(now: State, record: Step) -> None:
                if place is not None:
                    place.write(now)
                if progress is not None:
                    progress(int(now.step), np.asarray(record.loss), float(now.best))

            now, reason = descended(
                step,
                now if place is None else place.latest(now),
                self._held_out_at,
                validate_every=self.validate_every,
                patience=self.patience,
                after_step=after_step,
            )
        path = np.append(now.path[: int(now.step)], now.z[None], axis=0)
        looked_at = path[np.isinf(now.held_out[: len(path)])]  # before it was resumed, too
        if why := next(filter(None, map(self._refusal, looked_at)), ""):
            said = f"Tuning: weights that the scheme refuses together are not chosen: {why}"
            warnings.warn(f"{said}. Give narrower bounds", RuntimeWarning, stacklevel=2)
        best = self._weights.at(now.best_z)
        both = {name: np.array([self.start[name], best[name]], z.dtype) for name in best}
        before, after = self.held_out_losses(both).tolist()
        return Tuned.of(now, self._weights, self.scheme, before, after, reason)

    def _held_out_at(self, z: Z) -> np.ndarray:
        """(K,) the held-out losses at z (K, P), infinite where the scheme refuses the weights."""
        losses = np.array(self._programs[2](self._weights.at(z)))
        refused = [
            bool(np.isfinite(of) and self._refusal(one)) for of, one in zip(losses, z, strict=True)
        ]
        return np.where(refused, np.inf, losses)

    def _refusal(self, z: Z) -> str:
        """Why the scheme refuses the weights at z (P,), empty where it does not.

        Each weight is allowed by itself, but two may not be so together.
        """
        values = {name: float(of) for name, of in self._weights.at(z).items()}
        try:
            check(self.population.machine, self.scheme_of(values), self.task)
        except ValueError as error:
            return str(error)
        return ""

    def held_out_losses(self, rows: Mapping[str, np.ndarray]) -> np.ndarray:
        """(n,) the held-out losses of n values of each weight, by the program that `run` uses."""
        return in_rounds(self._programs[2], rows, self.starts)

    def _compile(self, z: np.ndarray) -> None:
        """Compile both programs; raises ValueError for a step that the RAM cannot hold."""
        init, step, held_out = self._programs
        # Python traces one program at a time, and this one takes longer to compile than the other
        state = jax.eval_shape(init, z)
        strong = jax.tree.map(lambda s: jax.ShapeDtypeStruct(s.shape, s.dtype), state)
        given = jax.eval_shape(self._weights.at, z)
        with ThreadPoolExecutor(1) as compiler:
            compiled = compiler.submit(lambda: held_out.lower(given).compile())
            check_program(
                "Tuning: a step of all starts",
                "take fewer trials, starts or lanes, or a shorter trial",
                step.lower(z, strong),
            )
        compiled.result()

    def compare(
        self,
        tuned: Tuned,
        *,
        trials: int | None = None,
        machines: int = 257,
        seed: int | None = None,
    ) -> xr.Dataset:
        """The dataset of a sweep of the scheme as given and as tuned, for `summarise`.

        Its machines but the nominal one were not used in the tuning, nor to select the iterate.

        trials: number of trials, None for that of the tuning
        machines: number of machines; machine 0 is the nominal one
        seed: seed of the machines, None for that of the tuning + 2; after a change of the tuning
            that was based on a comparison, the next comparison needs another seed
        Raises ValueError for the seeds of machines that were used.
        """
        schemes = {"given": self.scheme, "tuned": tuned.scheme}
        return self.comparison(schemes, trials=trials, machines=machines, seed=seed).run()

    def comparison(
        self,
        schemes: Mapping[str, Scheme] | None = None,
        *,
        trials: int | None = None,
        machines: int = 257,
        seed: int | None = None,
    ) -> Sweep:
        """The sweep of `compare`, not run yet, for any schemes by name.

        schemes: None for two copies of the given one, to check before a long tuning whether the RAM
            can hold the comparison after it
        Raises as `compare` does, and ValueError for more machines or trials than the RAM can hold.
        """
        schemes = {"given": self.scheme, "tuned": self.scheme} if schemes is None else schemes
        if seed in (self.seed, self.seed + 1):
            raise ValueError(
                f"compare: seed = {seed} is one of {self.seed} and {self.seed + 1}, whose plants "
                "tuning or choosing has seen"
            )
        planned = Sweep(
            self.machine,
            schemes,
            self.task,
            self.trials if trials is None else trials,
            self.uncertainty,
            machines=machines,
            seed=self.seed + 2 if seed is None else seed,
            quantities=self.quantities,
        )
        planned.need_room(copies=2)  # without a store, the dataset is in the RAM twice
        return planned

    @cached_property
    def _programs(self) -> tuple[jax.stages.Wrapped, ...]:
        """Both functions of the optimiser, and the held-out losses, compiled once for a problem."""
        method = method_of(self.optimiser, self.evaluation[0], self.rate, self.steps)
        return *for_starts(method), jax.jit(over_starts(self.held_out_loss))

    # The losses over the machines, and their slopes
    # ----------------------------------------------------------------------------------------------

    @cached_property
    def evaluation(self) -> tuple[Callable[[jax.Array], Evaluation], bool]:
        """A function that evaluates the loss over the machines of the population at z (P,).

        The second result is whether a program compiled for this processor does, see `native`.

            value = risk(l_1, ..., l_S) + nominal terms
            slope = sum_s (d risk / d l_s) (d l_s / d z) + slope of the nominal terms
        """
        of_machines, of_nominal = split(self.objective)
        batch, nominal = self.population.batch(), self.population.machine
        of_one = partial(self._slope_of_one, objective=of_machines)
        z = jnp.asarray(self._weights.starts(1, 0.0, 0)[0])
        runs = self.steps * self.starts * len(jax.tree.leaves(batch)[0]) * self.trials
        over_machines, native = fastest(
            of_one, z, batch, lanes=self._lanes_of(batch), steps=lambda: runs * self.task.N
        )

        def evaluate(z) -> Evaluation:
            losses, slopes, good = repaired(*over_machines(z, batch), self.clip)
            behind = jnp.min(losses) - 1.0  # where a machine without a slope takes no share of one
            omega = self.risk.weights(jnp.where(good, losses, behind)) * good
            omega = omega / jnp.where(jnp.sum(omega) > 0, jnp.sum(omega), 1.0)
            value, gradient = self.risk(losses), omega @ slopes
            residuals, jacobian = losses / len(losses) ** 0.5, slopes / len(losses) ** 0.5
            if of_nominal.parts:
                term, slope = jax.value_and_grad(
                    lambda z: self.loss_of(nominal, self._weights.at(z), of_nominal)
                )(z)
                value, gradient = value + term, gradient + slope
                residuals, jacobian = jnp.append(residuals, term), jnp.vstack([jacobian, slope])
            dropped = jnp.sum(~good).astype(losses.dtype)
            return Evaluation(value, gradient, residuals, jacobian, dropped)

        return evaluate, native

    def _lanes_of(self, batch) -> int:
        """The lanes of `tiled` over a batch and, under `vmap`, over all starts."""
        of_a_device = -(-len(batch[0]) // jax.device_count())
        wide = usual_lanes() is None  # all machines of all starts in one tile, if they fit
        lanes = self._lanes if wide else min(self._lanes, of_a_device)
        return max(1, lanes // self.starts)

    def _slope_of_one(self, z, one, *, objective: Objective):
        """The loss of one machine of a batch at z (P,), and its slope."""

        def loss(z, one):
            return self._of_one(self._weights.at(z), one, objective, self.population)

        return value_and_slope(loss, z, one, forward=self._forward)

    def _of_one(self, values, one, objective: Objective, population: Population):
        """The objective of one machine of a batch."""
        machine, key = population.one_of(one)
        return self.loss_of(machine, values, objective, key=key)


def in_rounds(
    f: Callable[[dict[str, np.ndarray]], jax.Array], rows: Mapping[str, np.ndarray], size: int
) -> np.ndarray:
    """The (n,) results of f for n rows, of which it takes `size` at a time.

    So a function that is compiled for `size` rows need not be compiled again. The last row is
    repeated to fill up the last round.

    rows: (n,) values by name
    """
    n = len(next(iter(rows.values())))
    rounds = np.minimum(np.arange(-(-n // size) * size), n - 1).reshape(-1, size)
    results = [f({name: of[k] for name, of in rows.items()}) for k in rounds]
    return np.concatenate(results)[:n]


def split(objective: Objective) -> tuple[Sum, Sum]:
    """The terms of an objective for every machine, and its terms for the nominal machine alone."""
    of_machines, of_nominal = (
        Sum(tuple(t for t in objective.terms if t[1].nominal is nominal))
        for nominal in (False, True)
    )
    return of_machines, of_nominal


def value_and_slope(f: Callable, z, *arguments, forward: bool):
    """f(z, *arguments) and its (P,) gradient, by P forward derivatives at once or one reverse pass.

    Under `vmap` over the arguments, the P forward derivatives stay outside of the batch, so that
    those of all members for one weight are adjacent in RAM, as the members themselves are.
    """
    return _forward(f)(z, arguments) if forward else jax.value_and_grad(f)(z, *arguments)


def _forward(f: Callable) -> Callable:
    def slopes(of, z):
        """The values of a function, any shape, and its derivatives, with P as the last axis."""
        if z.size == 1:
            value, slope = jax.jvp(of, (z,), (jnp.ones_like(z),))
            return value, slope[..., None]
        return jax.vmap(lambda tangent: jax.jvp(of, (z,), (tangent,)), out_axes=(None, -1))(
            jnp.eye(z.size, dtype=z.dtype)
        )

    def alone(z, arguments):
        return slopes(lambda z: f(z, *arguments), z)

    of_one = jax.custom_batching.custom_vmap(alone)

    @of_one.def_vmap
    def of_batch(axis_size, batched, z, arguments):
        axes = jax.tree.map(lambda is_batched: 0 if is_batched else None, batched)
        if axes[0] == 0:
            both = jax.vmap(alone, in_axes=axes)(z, arguments)
        else:
            both = slopes(lambda z: jax.vmap(lambda one: f(z, *one), axes[1:])(arguments), z)
        return both, (True, True)

    return of_one
